"""The small picture of a scene for a notebook: the body at rest, what holds it and what acts on it (`Scene` shows it).

It is made of the mesh and the terms. What a term looks like it says itself (see `jaxbeam.physics.energy.Energy`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.sketch import OUTLINE, PALETTE, RIGID, Stroke, body_lines, body_strokes, bounds, finite, svg
from jaxbeam.mesh.surface import outline
from jaxbeam.physics.energy import Energy, Term

FORCE = "#111111"
# Lengths relative to the body: the longest arrow, its head, and the depth and spacing of the hatching of a clamp.
ARROW, HEAD, CLAMP, SPACING = 0.14, 0.035, 0.035, 0.025
# The most arrows of a term.
ARROWS = 15
# Obstacles are sought on a grid of this many points each way, up to this far from the body, and shown this deep.
GRID, REACH, DEEP = 97, 0.2, 0.1


def picture(mesh: Mesh, terms: Sequence[Term], fixed: np.ndarray, held: np.ndarray) -> str:
    """SVG of a scene of concrete numbers; empty if its nodes are not those of a body at rest.

    The nodes of a gradient by a scene, or of the difference of two, are none.
    """
    rest = np.asarray(mesh.nodes, float)
    if not _is_body(rest, mesh):
        return ""
    edges, size = outline(mesh), float(np.ptp(rest[:, :2], axis=0).max())
    strokes = body_strokes(rest, edges, not mesh.is_line, OUTLINE)
    strokes += _supports(rest, edges, fixed, held, size)
    strokes += _lines(rest, terms)
    for term in terms:
        strokes += _forces(rest, term, size)
    obstacles, near = _obstacles(rest, terms, size)
    window = bounds(finite([*strokes, near]))
    return svg([*obstacles, *strokes], window)


def _is_body(rest: np.ndarray, mesh: Mesh) -> bool:
    """Whether all nodes are finite, and the corners of all elements in counter-clockwise order; of a rod, all apart."""
    if not np.isfinite(rest).all():
        return False
    first, second = (rest[mesh.elements[:, k], :2] for k in (0, 1))
    along = second - first
    if mesh.is_line:
        return bool(along.any(axis=1).all())
    across = rest[mesh.elements[:, 2]] - first
    return bool((along[:, 0] * across[:, 1] > along[:, 1] * across[:, 0]).all())


def _supports(rest: np.ndarray, edges: np.ndarray, fixed: np.ndarray, held: np.ndarray, size: float) -> list[Stroke]:
    """Hatching outside the edges whose ends are fixed; dots on other fixed nodes, and rings where a support holds."""
    walls = edges[fixed[edges].all(axis=(1, 2))]
    lonely = np.setdiff1d(np.flatnonzero(fixed.any(axis=1)), walls)
    moved = np.flatnonzero((held & ~fixed).any(axis=1))
    lines = body_lines(rest, walls)
    teeth = [tooth for line in lines for tooth in _hatched(line, size)]
    dots = lambda nodes: list(rest[nodes, None, :2])
    return [
        Stroke(teeth, OUTLINE, 0.8),
        Stroke(lines, OUTLINE, 2.4),
        Stroke(dots(lonely), OUTLINE, 6),
        Stroke(dots(moved), OUTLINE, 7),
        Stroke(dots(moved), "white", 4),
    ]


def _hatched(line: np.ndarray, size: float) -> list[np.ndarray]:
    """Short slanted segments `(2, 2)` on the right of a line `(p, 2)`, where the body is not."""
    along = np.diff(line, axis=0)
    length = np.linalg.norm(along, axis=1)
    passed = np.append(0.0, np.cumsum(length))
    count = int(np.ceil(passed[-1] / (SPACING * size)))
    s = (np.arange(count) + 0.5) / count * passed[-1]
    edge = np.clip(np.searchsorted(passed, s, side="right") - 1, 0, len(along) - 1)
    unit = along[edge] / length[edge, None]
    feet = line[edge] + (s - passed[edge])[:, None] * unit
    out = np.stack([unit[:, 1] - unit[:, 0], -unit[:, 0] - unit[:, 1]], axis=1)
    return list(np.stack([feet, feet + CLAMP * size * out], axis=1))


def _lines(rest: np.ndarray, terms: Sequence[Term]) -> list[Stroke]:
    """The lines of terms, such as tendons, each in a colour of its own, with dots at their points."""
    strokes: list[Stroke] = []
    number = 0
    for term in terms:
        x = rest[term.nodes].astype(_dtype(term, rest))
        arms, lines = term.kind.arms(x, term.params), term.kind.line(x, term.params)
        for k, line in enumerate(() if lines is None else np.asarray(lines, float)):
            colour = PALETTE[number % len(PALETTE)]
            number += 1
            if arms is not None:
                strokes.append(Stroke(list(np.asarray(arms, float)[k]), colour, 0.8))
            strokes += [Stroke([line], colour, 2), Stroke(list(line[:, None]), colour, 5)]
    return strokes


def _dtype(term: Term, rest: np.ndarray) -> Any:
    """The dtype of the floats of a term, so that none is promoted."""
    return next((leaf.dtype for leaf in jax.tree.leaves(term.params) if leaf.dtype.kind == "f"), rest.dtype)


def _forces(rest: np.ndarray, term: Term, size: float) -> list[Stroke]:
    """Arrows of the outer forces of a term, the longest of length `ARROW`, and dots where springs hold the body."""
    x, nodes = rest[term.nodes].astype(_dtype(term, rest)), np.asarray(term.nodes)
    strokes, arrows = [], []
    points = term.kind.point_loads(x, term.params)
    if points is not None:
        at, force = np.asarray(points, float).swapaxes(0, 1)
        arrows.append((at, force, np.zeros(len(at), bool)))
    half = np.full(len(nodes), 0.5)
    loads = term.kind.edge_loads(x, term.params, half)
    if loads is not None:
        force, (begin, end) = np.asarray(loads, float), (rest[nodes[:, k], :2] for k in (0, 1))
        along = end - begin
        # A force into the body has its head at the surface, where the body lies on the left of the edge.
        pushes = along[:, 1] * force[:, 0] - along[:, 0] * force[:, 1] < 0
        arrows.append(((begin + end) / 2, force, pushes))
    for at, force, pushes in arrows:
        largest = np.linalg.norm(force, axis=1).max(initial=0)
        if np.isfinite(largest) and largest > 0:
            chosen = _evenly(len(at), ARROWS)
            long = ARROW * size * force[chosen] / largest
            tails = at[chosen] - np.where(pushes[chosen, None], long, 0)
            strokes += _arrows(tails, long, HEAD * size)
    if term.kind.springs(term.params) is not None:
        tied = list(rest[nodes[:, 0], None, :2])
        strokes += [Stroke(tied, OUTLINE, 7), Stroke(tied, "white", 4)]
    return strokes


def _evenly(count: int, most: int) -> np.ndarray:
    """At most `most` numbers below `count`, evenly spaced, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _arrows(tails: np.ndarray, long: np.ndarray, head: float) -> list[Stroke]:
    """Arrows from `tails` `(q, 2)` of the lengths `long` `(q, 2)`; the head of a short one is smaller."""
    norm = np.linalg.norm(long, axis=1, keepdims=True)
    tails, long, norm = tails[norm[:, 0] > 0], long[norm[:, 0] > 0], norm[norm[:, 0] > 0]
    tips, along = tails + long, np.minimum(head, 0.6 * norm) * long / norm
    across = 0.4 * np.stack([-along[:, 1], along[:, 0]], axis=1)
    heads = np.stack([tips, tips - along + across, tips - along - across], axis=1)
    return [Stroke(list(np.stack([tails, tips - along], axis=1)), FORCE, 1.2), Stroke(list(heads), FORCE, 0.5, FORCE)]


# ------------------------------------------------------------------------------------------------ obstacles


def _obstacles(rest: np.ndarray, terms: Sequence[Term], size: float) -> tuple[list[Stroke], Stroke]:
    """Boundaries and hatching of the obstacles, and points of them beside, below or above the body, to be shown."""
    low, high = rest[:, :2].min(axis=0), rest[:, :2].max(axis=0)
    half = (0.5 + REACH) * size * np.linspace(-1, 1, GRID)
    grid = (low + high) / 2 + np.stack(np.meshgrid(half, half), axis=-1)
    beside = ((low <= grid) & (grid <= high)).any(axis=-1)
    strokes, near = [], []
    for term in terms:
        if term.kind.obstacle(jnp.zeros((1, 2), _dtype(term, rest)), term.params) is None:
            continue
        flat = jnp.asarray(grid.reshape(-1, 2), _dtype(term, rest))
        distance = np.asarray(_distances(term.kind, flat, term.params), float).reshape(grid.shape[:2])
        strokes += [Stroke(_hatching(grid, distance), RIGID, 0.8), Stroke(_boundary(grid, distance), RIGID, 2)]
        near += list(grid[beside & (distance < 0) & (distance > -DEEP * size)][:, None])
    return strokes, Stroke(near, RIGID)


@partial(jax.jit, static_argnums=0)
def _distances(kind: Energy, points: jax.Array, params: Any) -> jax.Array | None:
    return kind.obstacle(points, params)


def _hatching(grid: np.ndarray, distance: np.ndarray) -> list[np.ndarray]:
    """The parts with negative distance of every third diagonal of a grid."""
    found = []
    for offset in range(2 - GRID, GRID - 1, 3):
        points, d = np.diagonal(grid, offset).T, np.diagonal(distance, offset)
        inside = d < 0
        changes = np.flatnonzero(inside[1:] != inside[:-1])
        share = (d[changes] / (d[changes] - d[changes + 1]))[:, None]
        crossings = points[changes] + share * (points[changes + 1] - points[changes])
        ends = [*points[:1][inside[:1]], *crossings, *points[-1:][inside[-1:]]]
        found += [np.stack(pair) for pair in zip(ends[::2], ends[1::2], strict=True)]
    return found


def _boundary(grid: np.ndarray, distance: np.ndarray) -> list[np.ndarray]:
    """Where the distance is zero, as segments `(2, 2)`: it is linear on each half of a cell of the grid."""
    corner = lambda a: (a[:-1, :-1], a[:-1, 1:], a[1:, 1:], a[1:, :-1])
    halves = [(0, 1, 2), (0, 2, 3)]
    points = np.concatenate([np.stack([corner(grid)[k] for k in h], axis=2).reshape(-1, 3, 2) for h in halves])
    d = np.concatenate([np.stack([corner(distance)[k] for k in h], axis=2).reshape(-1, 3) for h in halves])
    other = np.roll(d, -1, axis=1)
    crossed = (d < 0) != (other < 0)
    cut = crossed.any(axis=1)
    share = np.where(crossed, d / np.where(crossed, d - other, 1), 0)[..., None]
    crossings = points + share * (np.roll(points, -1, axis=1) - points)
    return list(crossings[cut][crossed[cut]].reshape(-1, 2, 2))
