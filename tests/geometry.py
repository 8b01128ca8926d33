"""Geometry of meshes for the judge of answers: shape functions, the surface, patches of it, `J` and crossings.

Written anew from raw arrays, in NumPy and float64: it shares no code with the package.

A six-node triangle has `det dx/dl` quadratic in its barycentric coordinates `l`, so six values fix it and its minimum
over the triangle is at a corner, at a critical point of an edge or at one inside. `J` is the ratio of that to the same
at rest. Where the element is curved at rest, Dinkelbach's iteration (Management Science 13 (1967), 492-498) finds the
minimum of the ratio `N / D`: the argument of the least `N - t D` gives the next `t`.
"""

from __future__ import annotations

from collections import Counter
from functools import lru_cache
from typing import NamedTuple

import numpy as np

SIDES = ((0, 1), (1, 2), (2, 0))
# Barycentric coordinates of the six nodes.
PLACES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]])
# A curved edge is looked at as this many straight pieces. Whether edges cross is left open within `GRAZE` of their
# length and within this share of their bulge, for a judged code that takes fewer pieces.
PIECES, GRAZE, BULGE = 8, 1e-3, 1 / 8


def slopes(count: int, l: np.ndarray) -> np.ndarray:  # noqa: E741
    """Derivatives `(..., k, 2)` of the shape functions in `l1` and `l2`, with `l0 = 1 - l1 - l2`, at `l` `(..., 3)`."""
    corner, by = np.eye(3), np.zeros((*l.shape[:-1], count, 3))
    for a in range(3):
        by[..., a, :] = corner[a] if count == 3 else (4 * l[..., a] - 1)[..., None] * corner[a]
    for k, (a, b) in enumerate(SIDES if count == 6 else ()):
        by[..., 3 + k, :] = 4 * (l[..., b, None] * corner[a] + l[..., a, None] * corner[b])
    return by[..., 1:] - by[..., :1]


def determinants(corners: np.ndarray, l: np.ndarray) -> np.ndarray:  # noqa: E741
    """`det dx/dl` `(t, q)` of triangles with nodes `(t, k, 2)` at `l` `(q, 3)`; twice the area for three nodes."""
    x = corners - corners[:, :1]
    (ax, ay), (bx, by) = np.moveaxis(np.einsum("tkd,qki->iqtd", x, slopes(x.shape[1], l)), 3, 1)
    return (ax * by - ay * bx).T


# ------------------------------------------------------------------------------------------------ J


class Volumes(NamedTuple):
    """`J` of each element `(t,)`: its minimum, and a bound under it from Bernstein coefficients."""

    least: np.ndarray
    bound: np.ndarray


def volumes(x: np.ndarray, rest: np.ndarray) -> Volumes:
    """`J = det dx/dX` of triangles with nodes `x` `(t, k, 2)`, at rest `rest`."""
    if x.shape[1] == 3:
        ratio = (determinants(x, PLACES[:1]) / determinants(rest, PLACES[:1]))[:, 0]
        return Volumes(ratio, ratio)
    now, before = determinants(x, PLACES), determinants(rest, PLACES)
    ratio = np.min(now / before, axis=1)
    for _ in range(50):
        place = lowest_place(now - ratio[:, None] * before)
        better = np.minimum(ratio, quadratic(now, place) / quadratic(before, place))
        if np.array_equal(better, ratio):
            break
        ratio = better
    low, high = bernstein(now).min(axis=1), bernstein(before)
    return Volumes(ratio, np.minimum(ratio, low / np.where(low > 0, high.max(axis=1), high.min(axis=1))))


def quadratic(values: np.ndarray, l: np.ndarray) -> np.ndarray:  # noqa: E741
    """The quadratic with `values` `(t, 6)` at `PLACES`, at one place `l` `(t, 3)` of each triangle."""
    corners = np.sum(values[:, :3] * l * (2 * l - 1), axis=1)
    return corners + sum(4 * values[:, 3 + k] * l[:, a] * l[:, b] for k, (a, b) in enumerate(SIDES))


def bernstein(values: np.ndarray) -> np.ndarray:
    """Bernstein coefficients `(t, 6)` of quadratics; the quadratic lies between their extremes."""
    middles = [2 * values[:, 3 + k] - 0.5 * (values[:, a] + values[:, b]) for k, (a, b) in enumerate(SIDES)]
    return np.concatenate([values[:, :3], np.stack(middles, axis=1)], axis=1)


def lowest_place(values: np.ndarray) -> np.ndarray:
    """Where in its triangle `(t, 3)` the quadratic with `values` `(t, 6)` is least."""
    places = [np.tile(place, (len(values), 1)) for place in PLACES]
    for k, (a, b) in enumerate(SIDES):
        # Along an edge, from its first corner: f(s) = f0 + slope s + bend s^2.
        first, second, middle = values[:, a], values[:, b], values[:, 3 + k]
        slope, bend = 4 * middle - 3 * first - second, 2 * first + 2 * second - 4 * middle
        s = np.clip(-slope / np.where(bend > 0, 2 * bend, np.inf), 0, 1)[:, None]
        places.append((1 - s) * PLACES[a] + s * PLACES[b])
    # Inside, where both derivatives vanish: they are linear in l, so three values of them are enough.
    by = np.einsum("tk,qki->tqi", values, slopes(6, PLACES[:3]))
    change = np.stack([by[:, 1] - by[:, 0], by[:, 2] - by[:, 0]], axis=2)
    det = change[:, 0, 0] * change[:, 1, 1] - change[:, 0, 1] * change[:, 1, 0]
    safe = np.where(det > 0, det, np.inf)
    one = (change[:, 0, 1] * by[:, 0, 1] - change[:, 1, 1] * by[:, 0, 0]) / safe
    two = (change[:, 1, 0] * by[:, 0, 0] - change[:, 0, 0] * by[:, 0, 1]) / safe
    inside = np.stack([1 - one - two, one, two], axis=1)
    places.append(np.where((inside >= 0).all(axis=1, keepdims=True), inside, PLACES[0]))
    found = np.stack([quadratic(values, place) for place in places])
    return np.stack(places)[np.argmin(found, axis=0), np.arange(len(values))]


# ------------------------------------------------------------------------------------------- the surface


def surface(elements: np.ndarray) -> np.ndarray:
    """The edges `(b, 2)` or `(b, 3)` that one triangle alone has: first corner, second corner, node between them."""
    elements = np.ascontiguousarray(elements, np.int64)
    return _surface(elements.tobytes(), elements.shape[1])


@lru_cache(maxsize=32)
def _surface(content: bytes, count: int) -> np.ndarray:
    elements = np.frombuffer(content, np.int64).reshape(-1, count).tolist()
    shared = Counter(frozenset((t[a], t[b])) for t in elements for a, b in SIDES)
    single = [(t, k, a, b) for t in elements for k, (a, b) in enumerate(SIDES) if shared[frozenset((t[a], t[b]))] == 1]
    return np.array([[t[a], t[b], *t[3 + k : 4 + k]] for t, k, a, b in single])


def patch(rest: np.ndarray, elements: np.ndarray, node: int, width: float) -> np.ndarray:
    """Weights `(n,)` of the surface about a corner node, as `jaxbeam.mesh.surface` says what they are.

    A tent of half-width `width` of the arc length along straight edges, up to turns of more than 45 degrees, times a
    linear function by which their mean is the node, except across a gentle bend.
    """
    weights, (points, shares) = np.zeros(len(rest)), np.polynomial.legendre.leggauss(4)
    if width == 0:
        weights[node] = 1
        return weights
    edges, rows, tents = surface(elements), [], []
    for way in (0, 1):
        here, s, heading = node, 0.0, None
        while s < width * (1 - 1e-12):
            (edge,) = edges[edges[:, way] == here]
            there = edge[1 - way]
            length = float(np.linalg.norm(rest[there] - rest[here]))
            direction = (rest[there] - rest[here]) / length
            if heading is not None and np.degrees(np.arccos(np.clip(direction @ heading, -1, 1))) > 45.573:
                break
            part = min(1.0, (width - s) / length)
            for t, share in zip(part * (1 + points) / 2, shares, strict=True):
                row = np.zeros(len(rest))
                if len(edge) == 2:
                    row[[here, there]] = 1 - t, t
                else:
                    row[[here, there, edge[2]]] = (1 - t) * (1 - 2 * t), t * (2 * t - 1), 4 * t * (1 - t)
                rows.append(row)
                tents.append(share * part / 2 * length * (1 - (s + t * length) / width))
            here, s, heading = there, s + length, direction
    matrix, tent = np.array(rows), np.array(tents) / np.sum(tents)
    mean = tent @ matrix @ rest
    away = np.sqrt(tent)[:, None] * (matrix @ rest - mean)
    left, sizes, right = np.linalg.svd(away, full_matrices=False)
    shift = np.zeros(len(tent))
    for k in (0, 1):
        if sizes[k] ** 2 > 0.01 * sizes[0] ** 2:
            shift += left[:, k] * (right[k] @ (rest[node] - mean)) / sizes[k]
    return (tent + np.sqrt(tent) * shift) @ matrix


# -------------------------------------------------------------------------------------------- crossings


class Crossings(NamedTuple):
    """Pairs `(c, 2)` of edges of the surface, as rows of `surface`, that cross for sure; whether any others might."""

    sure: np.ndarray
    possible: bool


def crossings(x: np.ndarray, elements: np.ndarray) -> Crossings:
    """Which edges of the surface cross at node positions `x` `(n, 2)`.

    A crossing is sure if every end of the two edges is farther from the other edge than the band that is left open.
    None is possible if none is found and no two edges without a common corner are that close.
    """
    edges = surface(elements)
    lines = polylines(x, edges)
    chord = (lines[:, 0] + lines[:, -1]) / 2
    length = np.linalg.norm(np.diff(lines, axis=1), axis=2).sum(axis=1)
    band = GRAZE * length + BULGE * np.linalg.norm(lines[:, lines.shape[1] // 2] - chord, axis=1) * (edges.shape[1] - 2)
    low, high = lines.min(axis=1) - band[:, None], lines.max(axis=1) + band[:, None]
    near = np.all((low[:, None] <= high[None]) & (low[None] <= high[:, None]), axis=2)
    i, j = np.nonzero(np.triu(near, 1))
    joined = (edges[i][:, :2, None] == edges[j][:, None, :2]).any(axis=(1, 2))
    cut = cross(lines[i], lines[j])
    # Of the ends of either edge, the one that is nearest to the other edge.
    first = np.minimum(distance(lines[i][:, 0], lines[j]), distance(lines[i][:, -1], lines[j]))
    second = np.minimum(distance(lines[j][:, 0], lines[i]), distance(lines[j][:, -1], lines[i]))
    width = np.maximum(band[i], band[j])
    sure = cut & ~joined & (np.minimum(first, second) > width)
    inner = lambda a, b: np.min([distance(a[:, k], b) for k in range(a.shape[1])], axis=0)
    apart = np.minimum(inner(lines[i], lines[j]), inner(lines[j], lines[i])) if len(i) else np.zeros(0)
    return Crossings(np.stack([i, j], axis=1)[sure], bool((cut | (~joined & (apart <= width))).any()))


def polylines(x: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Points `(b, p, 2)` along each edge: its ends, and points between them if it may be curved."""
    ends = x[edges[:, :2]]
    if edges.shape[1] == 2:
        return ends
    t = np.linspace(0, 1, PIECES + 1)
    values = np.stack([(1 - t) * (1 - 2 * t), t * (2 * t - 1), 4 * t * (1 - t)])
    lines = np.einsum("kp,bkd->bpd", values, x[edges])
    # To the last bit, so that neighbours meet.
    lines[:, 0], lines[:, -1] = ends[:, 0], ends[:, 1]
    return lines


def cross(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Whether `(K,)` the lines `(K, p, 2)` cross: some piece of each has the ends of the other on either side."""
    a, b, c, d = one[:, :-1, None], one[:, 1:, None], two[:, None, :-1], two[:, None, 1:]
    side = lambda p, q, r: (q - p)[..., 0] * (r - p)[..., 1] - (q - p)[..., 1] * (r - p)[..., 0]
    both = (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)
    return both.any(axis=(1, 2))


def distance(points: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Distance `(K,)` of one point `(K, 2)` from each line `(K, p, 2)`."""
    start, way, to = lines[:, :-1], np.diff(lines, axis=1), points[:, None] - lines[:, :-1]
    squared = np.sum(way**2, axis=2)
    t = np.clip(np.sum(to * way, axis=2) / np.where(squared > 0, squared, 1), 0, 1)
    return np.linalg.norm(points[:, None] - start - t[..., None] * way, axis=2).min(axis=1)
