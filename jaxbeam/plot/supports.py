"""Supports as text-books draw them.

A clamp is a line with hatching on the side away from the body. A support that moves a part of the surface, such as a
grip, is a hatched block that moves with it. At a single node of the surface a triangle has its tip: on hatched ground
if the node is held in both coordinates, and a little above the ground, as if on rollers, if it is held in one. Held
nodes inside the body are squares, white if they move.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D

from jaxbeam.mesh.sketch import OUTLINE as INK
from jaxbeam.plot.lines import edge_curves
from jaxbeam.scene.scene import Scene

# Lengths relative to the body, within the margin of `limits`: depth of the hatching of a clamp and of a block, half the
# height of the clamp of a rod, height of a triangle and half its base, gap between it and the ground of a roller, half
# the width of the ground, its hatching, and least distance of triangles in a row.
WALL, BLOCK, SECTION = 0.025, 0.035, 0.04
HEIGHT, HALF, GAP, GROUND, STROKE, APART = 0.028, 0.016, 0.007, 0.024, 0.009, 0.05
# Cosine of the angle to the surface's normal below which a coordinate is held along the surface.
ALONG = 0.3


class Supports:
    """The artists of what holds a beam; `move` places those that move, which the attribute `artists` lists.

    Args:
        ax: where to draw.
        scene: the beam.
        edges: `(e, k)` of its surface with the body on their left, or of the centre line of a rod.
    """

    def __init__(self, ax: Axes, scene: Scene, edges: np.ndarray) -> None:
        self.rest, self.rod = np.asarray(scene.mesh.nodes), scene.mesh.is_line
        self.size = float(np.ptp(self.rest[:, :2], axis=0).max())
        fixed, held = (np.asarray(each.all(axis=1)) for each in (scene.fixed, scene.held))
        walls, blocks = self._sides(edges, fixed), self._sides(edges, held)
        blocks = blocks[~np.isin(blocks[:, 0], walls[:, 0])]
        self._draw_walls(ax, walls)
        self.artists: list[Artist] = []
        self.blocks = blocks
        if len(blocks):
            look: dict[str, Any] = {"facecolor": "white", "hatch": "xxxx", "edgecolor": INK, "linewidth": 0}
            self.hatching = PolyCollection([], zorder=3.2, **look)
            self.rims = LineCollection([], colors=INK, linewidths=1.1, capstyle="projecting", zorder=4)
            self._add(ax, self.hatching, self.rims)
        single = np.setdiff1d(np.flatnonzero(scene.held.any(axis=1)), np.concatenate([walls.ravel(), blocks.ravel()]))
        on_surface = single[np.isin(single, edges) & scene.held[single, :2].any(axis=1)]
        self.tips, self.away = _triangles(scene, edges, on_surface)
        self.gaps = np.where(scene.held[self.tips, :2].all(axis=1), 0, GAP)[:, None, None]
        inside = np.setdiff1d(single, on_surface)
        self.squares: list[tuple[Line2D, np.ndarray]] = []
        for nodes, face in ((inside[fixed[inside]], INK), (inside[~fixed[inside]], "white")):
            if len(nodes):
                (squares,) = ax.plot([], [], "s", color=INK, markerfacecolor=face, markersize=4, zorder=7)
                self.squares.append((squares, nodes))
                self.artists.append(squares)
        if len(self.tips):
            self.triangles = PolyCollection([], facecolor="white", edgecolor=INK, linewidth=0.9, zorder=7)
            self.ground = LineCollection([], colors=INK, linewidths=0.9, zorder=7)
            self._add(ax, self.triangles, self.ground)

    def move(self, x: np.ndarray) -> None:
        """Draw the supports of a beam at `x` `(n, d)`."""
        if len(self.blocks):
            lines = self._lines(x, self.blocks)
            outer = lines + self._outward(lines, BLOCK)
            self.hatching.set_verts(_strips(lines, outer))
            # A block is closed where no other one follows.
            first, last = (~np.isin(self.blocks[:, k], self.blocks[:, 1 - k]) | self.rod for k in (0, 1))
            ends = [np.stack([lines[some, k], outer[some, k]], axis=1) for some, k in ((first, 0), (last, -1))]
            self.rims.set_segments([*lines, *outer, *ends[0], *ends[1]])
        for squares, nodes in self.squares:
            squares.set_data(*x[nodes, :2].T)
        if len(self.tips):
            tips, away = x[self.tips, None, :2], self.away[:, None]
            across = np.stack([-away[..., 1], away[..., 0]], axis=-1)
            at = lambda down, aside: tips + self.size * (down * away + aside * across)
            verts: Any = np.concatenate([at(0, 0), at(HEIGHT, HALF), at(HEIGHT, -HALF)], axis=1)
            self.triangles.set_verts(verts)
            low, places = HEIGHT + self.gaps, np.linspace(STROKE - GROUND, GROUND, 5)
            strokes = [(at(low, place), at(low + STROKE, place - STROKE)) for place in places]
            pairs = [(at(low, -GROUND), at(low, GROUND)), *strokes]
            self.ground.set_segments([segment for pair in pairs for segment in np.concatenate(pair, axis=1)])

    def _add(self, ax: Axes, *collections: Any) -> None:
        for collection in collections:
            ax.add_collection(collection, autolim=False)
            self.artists.append(collection)

    def _draw_walls(self, ax: Axes, walls: np.ndarray) -> None:
        lines = self._lines(self.rest, walls)
        look: dict[str, Any] = {"facecolor": "none", "edgecolor": INK, "linewidth": 0, "hatch": "//////", "zorder": 1}
        strips = _strips(lines, lines + self._outward(lines, WALL))
        ax.add_collection(PolyCollection(list(strips), **look), autolim=False)
        ax.add_collection(LineCollection(list(lines), colors=INK, linewidths=2.2, zorder=4), autolim=False)

    def _sides(self, edges: np.ndarray, held: np.ndarray) -> np.ndarray:
        """The edges all of whose nodes are held; of a rod, for each held node it and the node that it is clamped from.

        A node of a rod comes first. The second one tells the direction of the rod there.
        """
        if not self.rod:
            return edges[held[edges].all(axis=1)]
        ends = edges[:, :2]
        both = np.concatenate([ends, ends[:, ::-1]])
        both = both[held[both[:, 0]]]
        return both[np.unique(both[:, 0], return_index=True)[1]]

    def _lines(self, x: np.ndarray, sides: np.ndarray) -> np.ndarray:
        """Points `(e, p, 2)` along sides, with the body on their left."""
        if not self.rod:
            return edge_curves(x, sides)
        node, other = x[sides[:, 0], :2], x[sides[:, 1], :2]
        run = (node - other) / np.linalg.norm(node - other, axis=1, keepdims=True)
        across = SECTION * self.size * np.stack([-run[:, 1], run[:, 0]], axis=1)
        return np.stack([node - across, node + across], axis=1)

    def _outward(self, lines: np.ndarray, depth: float) -> np.ndarray:
        """Vectors `(e, p, 2)` out of the body, as long as `depth` times the body, at points of lines along it."""
        along = np.gradient(lines, axis=1)
        out = np.stack([along[..., 1], -along[..., 0]], axis=-1)
        return np.asarray(depth * self.size * out / np.linalg.norm(out, axis=-1, keepdims=True))


def _strips(lines: np.ndarray, outer: np.ndarray) -> Any:
    """Polygons `(e, 2 p, 2)` between lines and outer lines."""
    return np.concatenate([lines, outer[:, ::-1]], axis=1)


def _triangles(scene: Scene, edges: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nodes `(q,)`, of these of the surface, that get a triangle, and the directions `(q, 2)` of its ground.

    A roller is along the coordinate that is held, on the outer side. Of a part of the surface that is held along itself
    the ends get a triangle, and of nodes that are close to each other only some.
    """
    rest, held = np.asarray(scene.mesh.nodes)[:, :2], scene.held[:, :2]
    pieces = np.concatenate([edges[:, [0, 2]], edges[:, [2, 1]]]) if edges.shape[1] == 3 else edges
    run = rest[pieces[:, 1]] - rest[pieces[:, 0]]
    units = np.stack([run[:, 1], -run[:, 0]], axis=1) / np.linalg.norm(run, axis=1, keepdims=True)
    units = units * (not scene.mesh.is_line)  # a rod has no side that is the outer one
    out, within = np.zeros(rest.shape), np.zeros(rest.shape, int)
    alike = (held[pieces[:, 0]] == held[pieces[:, 1]]).all(axis=1)[:, None] & held[pieces[:, 0]]
    for node in pieces.T:
        np.add.at(out, node, 0.5 * units)
        np.add.at(within, node, alike & (np.abs(units) < ALONG))
    size = np.ptp(rest, axis=0).max()
    tips: list[int] = []
    away: list[np.ndarray] = []
    for node in nodes:
        across = held[node, 0] and (not held[node, 1] or abs(out[node, 1]) < 0.5 * abs(out[node, 0]))
        axis = 0 if across else 1
        if within[node, axis] == 2 and held[node].sum() == 1 and not scene.mesh.is_line:
            continue
        direction = np.eye(2)[axis] * (1 if out[node, axis] > ALONG else -1)
        near = [np.linalg.norm(rest[node] - rest[k]) < APART * size for k in tips]
        if not any(close and (direction == other).all() for close, other in zip(near, away, strict=True)):
            tips.append(node)
            away.append(direction)
    return np.array(tips, int), np.reshape(away, (-1, 2))
