"""What acts on a body from outside, in numbers: where arrows, springs and obstacles lie in each state of a picture.

All forces of a picture have one scale. Forces per length, which are in another unit, have one of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.mesh.element import edge_functions, edge_slopes
from jaxbeam.mesh.surface import CORNER
from jaxbeam.physics.energy import Term
from jaxbeam.plot.lines import edge_curves, extremes, outline
from jaxbeam.scene.scene import Scene, command

# Lengths relative to the extent of the body: the longest arrow of a force, the longest one of a row, the distance of
# arrows in a row, and the gap between a row of arrows along the surface and the surface.
ARROW, ROW, SPACING, GAP = 0.1, 0.06, 0.04, 0.015
# How much of the distance to the next part of the body, as across a cavity, the longest arrow of a row takes. The
# distance is the quantile of those of all arrows: at the ends of a cavity some are short.
ROOM, QUANTILE = 0.33, 0.2
# Cosine of the angle between force and surface normal below which arrows lie along the surface.
ALONG = 0.3
# Springs: length of one whose node stays, times the displacement that is added, longest; width and number of teeth.
SPRING, FURTHER, LONGEST, TOOTH, TEETH = 0.055, 1.5, 0.4, 0.011, 4
# How much of an obstacle limits of axes hold, relative to the body: it is looked for up to this far away, and shown
# between these depths.
REACH, SHALLOW, DEEP = 0.2, 0.02, 0.08

Distance = Callable[[np.ndarray], np.ndarray]


class Row(NamedTuple):
    """Arrows evenly spaced along one smooth run of edges of a term: on its stencils `(r,)`, at `xi` `(r,)` of each."""

    term: int
    stencils: np.ndarray
    xi: np.ndarray


class Acted(NamedTuple):
    """One state of a picture: where the body is, and what acts on it.

    scene: under the commands of this state.
    x: `(n, d)` positions.
    at, force: `(q, 2)` each: the forces on points.
    rows: for each row the points, the forces per length and the outward normals, `(r, 2)` each.
    """

    scene: Scene
    x: np.ndarray
    at: np.ndarray
    force: np.ndarray
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]]


class Acting:
    """What acts on a body in the states of a picture: arrows, springs and obstacles.

    Show each state to `see` before it is drawn. Arrows then have one scale, and springs one base, for all states that
    were seen. A state that is seen later can only make the arrows shorter.

    Args:
        scene: of the body.

    The attribute `scales` `(2,)` holds the length of the arrow of a unit force, and that of a unit force per length;
    infinite if there is none. `to_one_scale` makes them the same in several.
    """

    def __init__(self, scene: Scene) -> None:
        rest = np.asarray(scene.mesh.nodes)
        self.scene, self.rest, self.edges = scene, rest[:, :2], outline(scene)
        self.size = float(np.ptp(self.rest, axis=0).max())
        self.loaded = [k for k, term in enumerate(scene.terms) if _point_loads(term, rest) is not None]
        self.rows = [row for k, term in enumerate(scene.terms) for row in _rows(k, term, rest, SPACING * self.size)]
        probe = jnp.zeros((1, 2), rest.dtype)
        self.rigid = [k for k, term in enumerate(scene.terms) if term.kind.obstacle(probe, term.params) is not None]
        self.tied, self.tied_to, self.tooth = _tied(scene, self.size)
        self.bases, self.farthest = np.zeros((0, 2)), np.zeros((len(self.tied), 2))
        self.scales = np.full(2, np.inf)

    @property
    def any(self) -> bool:
        """Whether anything acts, so that states must be seen."""
        return bool(self.loaded or self.rows or self.rigid or len(self.tied))

    def see(self, scene: Scene, x: np.ndarray) -> Acted:
        """What acts in a state: the scene under the commands of this state, and positions `(n, d)`."""
        found = [_point_loads(scene.terms[k], x) for k in self.loaded]
        at, force = np.concatenate([np.zeros((0, 2, 2)), *(each for each in found if each is not None)]).swapaxes(0, 1)
        state = Acted(scene, x, at, force, [self._row(scene.terms[row.term], x, row) for row in self.rows])
        self._rescale(state)
        if len(self.tied):
            moved = x[self.tied, :2] - self.tied_to
            farther = np.linalg.norm(moved, axis=1) >= np.linalg.norm(self.farthest, axis=1)
            self.farthest = np.where(farther[:, None], moved, self.farthest)
            long = SPRING * self.size + FURTHER * np.linalg.norm(self.farthest, axis=1)
            long = np.minimum(long, LONGEST * self.size)
            self.bases = self.tied_to + long[:, None] * _outward(self.rest, self.edges, self.tied, self.farthest)
        return state

    def see_all(self, commands: np.ndarray, x: np.ndarray) -> list[Acted]:
        """The states with commands `(s, m)` and positions `(s, n, d)`."""
        scenes = [command(self.scene, row) for row in commands] if self.any else [self.scene] * len(x)
        return [self.see(scene, here) for scene, here in zip(scenes, x, strict=True)]

    def _row(self, term: Term, x: np.ndarray, row: Row) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        nodes, k = x[term.nodes[row.stencils]], term.nodes.shape[1]
        ends = nodes[..., :2]
        params = jax.tree.map(lambda leaf: np.asarray(leaf)[row.stencils], term.params)
        along = np.einsum("mk,mkd->md", edge_slopes(k, row.xi), ends)
        outward = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
        at = np.einsum("mk,mkd->md", edge_functions(k, row.xi), ends)
        return at, np.asarray(term.kind.edge_loads(nodes, params, row.xi)), outward

    def _rescale(self, state: Acted) -> None:
        """Shorten the arrows if the longest one of a force, or of a row, is now longer than it may be."""
        most = np.linalg.norm(state.force, axis=1).max(initial=0.0)
        rooms = [(0, ARROW * self.size, most)]
        for at, load, outward in state.rows:
            clear = ROOM * _quantile(_clearance(at, outward, self._pieces(state)))
            rooms.append((1, min(ROW * self.size, clear), np.linalg.norm(load, axis=1).max()))
        for k, room, most in rooms:
            self.scales[k] = min(self.scales[k], room / most if most > 0 else np.inf)

    def _pieces(self, state: Acted) -> np.ndarray:
        """Segments `(e, 2, 2)` of the outline."""
        curves = edge_curves(state.x, self.edges)
        return np.stack([curves[:, :-1], curves[:, 1:]], axis=2).reshape(-1, 2, 2)

    @property
    def names(self) -> list[str]:
        """What to call the terms that have an arrow in some state."""
        drawn = [self.loaded, [row.term for row in self.rows]]
        some = [k for terms, scale in zip(drawn, self.scales, strict=True) if np.isfinite(scale) for k in terms]
        return list(dict.fromkeys(self.scene.terms[k].kind.name for k in some))

    def arrows(self, state: Acted) -> np.ndarray:
        """Arrows `(q, 2, 2)` of the forces on points: tail and head of each that is not zero.

        The tail is at the point where the force acts, or the head if less of the arrow then lies in the body.
        """
        at, force = state.at, state.force
        some = force.any(axis=1)
        at, long = at[some], self.scales[0] * force[some] if some.any() else force[some]
        if not len(at) or self.scene.mesh.is_line:
            return np.stack([at, at + long], axis=1)
        samples = np.array([0.3, 0.6, 0.95])[:, None, None] * long
        pulled, pushed = (_inside(at + sign * samples, self._pieces(state)).sum(axis=0) for sign in (1, -1))
        tails = at - np.where((pushed < pulled)[:, None], long, 0)
        return np.stack([tails, tails + long], axis=1)

    def combs(self, state: Acted) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each row its arrows `(r, 2, 2)`, and the points `(r, 2)` of the line that joins them.

        The arrows lie outside the body: heads at the surface where the force pushes, tails where it pulls. They are
        joined if all push or all pull. Of arrows along the surface every other one is left out, so that there are
        gaps between them.
        """
        found = []
        for at, force, outward in state.rows:
            norm = np.linalg.norm(force, axis=1, keepdims=True)
            some = norm[:, 0] > 0
            if not some.any():
                continue
            normal, long = np.sum(force * outward, axis=1, keepdims=True), self.scales[1] * force
            pushes = normal < 0
            if np.abs(normal).sum() < ALONG * norm.sum():
                tails, some[1::2] = at - 0.5 * long + GAP * self.size * outward, False
            else:
                tails = np.where(pushes, at - long, at)
            plain = some.all() and (pushes.all() or not pushes.any())
            joined = np.where(pushes, tails, tails + long) if plain else np.zeros((0, 2))
            found.append((np.stack([tails, tails + long], axis=1)[some], joined))
        return found

    def obstacles(self, state: Acted) -> list[Distance]:
        """For each obstacle the distance from it, a function of points `(..., 2)`."""
        return [partial(_distance, state.scene.terms[k], state.x.dtype) for k in self.rigid]

    def zigzags(self, state: Acted) -> np.ndarray:
        """Points `(q, p, 2)` of each spring, from its base outside the body to its node."""
        start, run = self.bases, state.x[self.tied, :2] - self.bases
        across = np.stack([-run[:, 1], run[:, 0]], axis=1)
        across = self.tooth * across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
        along = np.array([0.0, *np.linspace(0.2, 0.8, 2 * TEETH + 1), 1.0])
        side = np.array([0.0, 0.0, *np.resize([1.0, -1.0], 2 * TEETH - 1), 0.0, 0.0])
        return start[:, None] + along[:, None] * run[:, None] + side[:, None] * across[:, None]

    def extremes(self, states: Sequence[Acted]) -> list[np.ndarray]:
        """Points `(..., 2)` that span all of this in these states; of obstacles, what is near."""
        if not self.any:
            return []
        found = [self.bases, *self._rims(states)]
        for state in states:
            found += [self.arrows(state), *(arrows for arrows, _ in self.combs(state))]
        return found

    def _rims(self, states: Sequence[Acted]) -> list[np.ndarray]:
        """Points of each obstacle a little inside its boundary, straight beside, below or above the body."""
        if not self.rigid:
            return []
        body = np.concatenate([p.reshape(-1, 2) for p in extremes(self.scene, np.stack([s.x for s in states]))])
        low, high = body.min(axis=0), body.max(axis=0)
        size = (high - low).max()
        grid = np.meshgrid(*np.linspace(low - REACH * size, high + REACH * size, 61).T)
        points = np.stack([each.ravel() for each in grid], axis=1)
        points = points[((low <= points) & (points <= high)).any(axis=1)]
        depths = [-distance(points) / size for state in states for distance in self.obstacles(state)]
        return [points[(depth > SHALLOW) & (depth < DEEP)] for depth in depths]


def to_one_scale(each: Sequence[Acting]) -> Sequence[Acting]:
    """Set the arrows of several bodies to the smallest of their scales."""
    scales = np.min([acting.scales for acting in each], axis=0)
    for acting in each:
        acting.scales = scales
    return each


def _point_loads(term: Term, x: np.ndarray) -> np.ndarray | None:
    found = term.kind.point_loads(x[term.nodes], term.params)
    return None if found is None else np.asarray(found)


def _distance(term: Term, dtype: Any, points: np.ndarray) -> np.ndarray:
    flat = jnp.asarray(points.reshape(-1, 2), dtype)
    return np.asarray(term.kind.obstacle(flat, term.params)).reshape(points.shape[:-1])


def _rows(number: int, term: Term, rest: np.ndarray, spacing: float) -> list[Row]:
    """The rows of arrows of a term: one for each run of its edges that has no corner."""
    half = np.full(len(term.nodes), 0.5)
    if term.kind.edge_loads(rest[term.nodes], term.params, half) is None:
        return []
    starts, ends = np.asarray(term.nodes)[:, :2].T
    chords = rest[ends, :2] - rest[starts, :2]
    length = np.linalg.norm(chords, axis=1)
    at_end = {node: k for k, node in enumerate(ends.tolist())}
    before = [at_end.get(node, -1) for node in starts.tolist()]
    smooth = [p >= 0 and chords[k] @ chords[p] > CORNER * length[k] * length[p] for k, p in enumerate(before)]
    following = {p: k for k, p in enumerate(before) if smooth[k]}
    left, found = set(range(len(starts))), []
    for start in [*(k for k in range(len(starts)) if not smooth[k]), *range(len(starts))]:  # then the closed runs
        run, k = [], start
        while k in left:
            left.remove(k)
            run.append(k)
            k = following.get(k, -1)
        if not run:
            continue
        passed = np.cumsum([0.0, *length[run]])
        count = max(1, round(passed[-1] / spacing))
        # Arrows at both ends of an open line; at a corner they would cross those of the next run.
        free = before[run[0]] < 0 and ends[run[-1]] not in starts
        s = passed[-1] * (np.linspace(0, 1, count + 1) if free else (np.arange(count) + 0.5) / count)
        where = np.clip(np.searchsorted(passed, s, side="right") - 1, 0, len(run) - 1)
        stencils = np.array(run)[where]
        found.append(Row(number, stencils, (s - passed[where]) / length[stencils]))
    return found


def _inside(points: np.ndarray, pieces: np.ndarray) -> np.ndarray:
    """Whether points `(..., 2)` lie inside the closed lines that segments `(e, 2, 2)` make, by crossings of a ray."""
    (ax, ay), (bx, by) = pieces.transpose(1, 2, 0)
    px, py = points[..., :1], points[..., 1:]
    crossed = (ay > py) != (by > py)
    rise = np.where(by == ay, 1, by - ay)
    return np.count_nonzero(crossed & (px < ax + (py - ay) * (bx - ax) / rise), axis=-1) % 2 == 1


def _clearance(at: np.ndarray, outward: np.ndarray, pieces: np.ndarray) -> np.ndarray:
    """How far `(r,)` the body is away from points `at` of its surface, seen along the normals; infinite if it is not.

    Solves `at + t outward = start + s run` for each of the segments `pieces` `(e, 2, 2)`.
    """
    cross = lambda a, b: a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    run, gap = pieces[:, 1] - pieces[:, 0], pieces[:, 0] - at[:, None]
    turn = cross(outward[:, None], run)
    faces = turn < 0  # it shows its outer side, as those of the same surface do not
    safe = np.where(faces, turn, 1)
    t, s = cross(gap, run) / safe, cross(gap, outward[:, None]) / safe
    small = 1e-6 * np.ptp(pieces[:, 0], axis=0).max()
    return np.where(faces & (t > small) & (s >= 0) & (s <= 1), t, np.inf).min(axis=1)


def _quantile(lengths: np.ndarray) -> float:
    return float(np.sort(lengths)[int(QUANTILE * len(lengths))])  # np.quantile turns infinite ones into NaN


def _tied(scene: Scene, size: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Nodes `(q,)` that springs hold, the points `(q, 2)` they are tied to, and how far the teeth stand out."""
    found = [(np.asarray(term.nodes)[:, 0], term.kind.springs(term.params)) for term in scene.terms]
    held = [(nodes, np.asarray(points)) for nodes, points in found if points is not None]
    if not held:
        return np.zeros(0, int), np.zeros((0, 2)), 0.0
    points = np.concatenate([each for _, each in held])
    gaps = np.linalg.norm(points[:, None] - points, axis=2)
    nearest = gaps[gaps > 1e-9 * size].min(initial=np.inf)
    return np.concatenate([each for each, _ in held]), points, float(min(TOOTH * size, 0.3 * nearest))


def _outward(rest: np.ndarray, edges: np.ndarray, nodes: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Unit vectors `(q, 2)` out of the body at `nodes`, for springs that hold them while they have `moved` `(q, 2)`.

    They are normal to the edges between the nodes, or to all edges of a node that is alone. At a corner the edge
    that moves along its normal counts more. At a node inside the body they are down.
    """
    along = rest[edges[:, 1]] - rest[edges[:, 0]]
    normals = np.stack([along[:, 1], -along[:, 0]], axis=1)
    units = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    motion, every, between = np.zeros_like(rest), np.zeros_like(rest), np.zeros_like(rest)
    motion[nodes] = moved
    both = np.isin(edges[:, :2], nodes).all(axis=1)
    for node in edges.T:
        across = 1e-3 * np.ptp(rest, axis=0).max() + np.abs(np.sum(units * motion[node], axis=1))
        weighted = across[:, None] ** 2 * normals
        np.add.at(every, node, weighted)
        np.add.at(between, node[both], weighted[both])
    found = np.broadcast_to(np.array([0.0, -1.0]), (len(nodes), 2))
    for better in (every[nodes], between[nodes]):
        length = np.linalg.norm(better, axis=1, keepdims=True)
        there = length > 1e-12 * length.max()
        found = np.where(there, better / np.where(there, length, 1), found)
    return found
