"""Checks of a mesh: what joins what, areas, curved edges, overlaps. All on the host."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from jaxbeam.mesh.element import Determinant
from jaxbeam.mesh.elements import element_of

# An element of no more area than this share of the square of the body's extent has none.
SLIVER = 1e-14


def _check_topology(count: int, elements: np.ndarray) -> None:
    kind = element_of(elements).name
    outside = np.flatnonzero(((elements < 0) | (elements >= count)).any(axis=1))
    if outside.size:
        k = outside[0]
        raise ValueError(f"elements: {kind} {k} is {elements[k].tolist()}, but nodes are numbered 0 to {count - 1}")
    ordered = np.sort(elements, axis=1)
    repeated = np.flatnonzero((np.diff(ordered, axis=1) == 0).any(axis=1))
    if repeated.size:
        k = repeated[0]
        raise ValueError(f"elements: {kind} {k} repeats a node: {elements[k].tolist()}; remove it")
    used = np.zeros(count, bool)
    used[elements] = True
    if not used.all():
        unused = np.flatnonzero(~used)
        raise ValueError(
            f"nodes: {unused.size} belong to no {kind}, the first is node {unused[0]}; remove them and renumber"
        )


def _check_geometry(nodes: np.ndarray, elements: np.ndarray) -> None:
    kind = element_of(elements).name
    if not np.isfinite(nodes).all():
        k = np.flatnonzero(~np.isfinite(nodes).all(axis=1))[0]
        raise ValueError(f"nodes: node {k} is not finite: {nodes[k].tolist()}")
    extent = np.ptp(nodes, axis=0).max()
    # Merging nodes closer than this is what mesh generators do; a real gap is far wider.
    grid = np.round(nodes / (1e-9 * extent if extent > 0 else 1.0))
    _, first, inverse = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    original = first[inverse.ravel()]
    copies = np.flatnonzero(original != np.arange(len(nodes)))
    if copies.size:
        k = copies[0]
        raise ValueError(
            f"nodes: nodes {original[k]} and {k} coincide at {nodes[k].tolist()}; merge them, or the body is torn there"
        )
    area = _areas(nodes, elements)
    bad = np.flatnonzero(area <= SLIVER * extent**2)
    if bad.size:
        k = bad[0]
        cure = "list its corners counter-clockwise" if area[k] < 0 else "remove it, or move its nodes off one line"
        raise ValueError(
            f"elements: {kind} {k}, {elements[k].tolist()}, has area {area[k]:g}, expected positive; {cure}"
            f" ({bad.size} such)"
        )
    determinant = element_of(elements).determinant
    if determinant is not None:
        _check_curves(determinant, nodes, elements, area)


def _areas(nodes: Any, elements: np.ndarray) -> Any:
    """Signed area `(t,)` of each element between its corners."""
    first, *others = (nodes[elements[:, k]] for k in range(element_of(elements).corners))
    spans = [corner - first for corner in others]
    return 0.5 * sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] for a, b in itertools.pairwise(spans))


def _check_curves(determinant: Determinant, nodes: np.ndarray, elements: np.ndarray, area: np.ndarray) -> None:
    """Refuse elements that fold over somewhere, between corners that enclose a positive `area` `(t,)`."""
    kind = element_of(elements).name
    slopes = determinant.slopes(np.moveaxis(nodes[elements], 0, -1))
    stretch = determinant.coefficients(slopes, slopes) * element_of(elements).area / area
    place = determinant.minimiser(stretch)
    least = determinant.value(stretch, place)
    bad = np.flatnonzero(least <= 1e-12)
    if bad.size:
        k = bad[0]
        where = ", ".join(f"{coordinate:.3g}" for coordinate in place[:, k])
        raise ValueError(
            f"elements: {kind} {k}, {elements[k].tolist()}, folds over: its edges are curved so much that the "
            f"determinant of its map is {least[k]:.3g} times that of straight edges at the mean of its corners "
            f"weighted by ({where}), expected positive; move the nodes between its corners towards the middles of its "
            f"edges ({bad.size} such)"
        )


# ----------------------------------------------------------------------------------------------- overlaps


def _surface_of(elements: np.ndarray) -> np.ndarray:
    """Edges `(b, 2)` of the surface, the body on their left, after a check of all edges.

    Raises:
        ValueError: if two elements lie on the same side of an edge: if each is counter-clockwise, an edge runs one way
            in one of its elements and the other way in the other.
    """
    kind = element_of(elements).name
    corners = elements[:, : element_of(elements).corners]
    a, b = elements[:, element_of(elements).sides].reshape(-1, 2).T.astype(np.int64)
    total = int(elements.max()) + 1
    # One number tells both ends of a side and its direction; those of one edge are neighbours when sorted.
    sides = np.sort((np.minimum(a, b) * total + np.maximum(a, b)) * 2 + (a > b))
    edge = sides >> 1
    twice = np.flatnonzero(sides[1:] == sides[:-1])
    if twice.size:
        ends = divmod(int(edge[twice[0]]), total)
        those = np.flatnonzero(np.isin(corners, ends).sum(axis=1) == 2)
        if len(np.unique(np.sort(corners[those], axis=1), axis=0)) < len(those):
            k = those[0]
            raise ValueError(
                f"elements: {kind} {k}, {elements[k].tolist()}, is listed more than once; remove the copies"
            )
        raise ValueError(
            f"elements: {kind}s {those.tolist()} meet in the edge between nodes {ends[0]} and {ends[1]}, and two of "
            f"them lie on the same side of it; {kind}s must not overlap"
        )
    shared = np.append(edge[1:] == edge[:-1], False)
    alone = ~(shared | np.roll(shared, 1))
    low, high = np.divmod(edge[alone], total)
    turned = (sides[alone] & 1).astype(bool)
    return np.stack([np.where(turned, high, low), np.where(turned, low, high)], axis=1)


def _check_overlaps(nodes: np.ndarray, elements: np.ndarray, edges: np.ndarray) -> None:
    """Refuse elements that overlap, from the surface `edges` alone, of elements that are counter-clockwise.

    So many elements lie over a point as the surface winds round it. That number changes only across the surface: it is
    at most 1 if no two edges of the surface cross, and it is 1 beside each of them.
    """
    kind = element_of(elements).name
    # Measured from one of its nodes, wherever the body lies.
    begin, end = (nodes[edges[:, k]] - nodes[edges[0, 0]] for k in (0, 1))
    extent = np.ptp(begin, axis=0)
    for edge in element_of(elements).edges:
        bulge = nodes[elements[:, edge[2:]]] - nodes[elements[:, edge[:2]]].mean(axis=1, keepdims=True)
        if np.abs(bulge).max(initial=0) > 1e-9 * extent.max():
            return
    first, second = _crossing(begin, end, int(np.argmax(extent)))
    if first.size:
        here, there = edges[first[0]].tolist(), edges[second[0]].tolist()
        raise ValueError(
            f"elements: {kind}s overlap: the edge between nodes {here[0]} and {here[1]} of the surface crosses that "
            f"between nodes {there[0]} and {there[1]}"
        )
    covered = np.flatnonzero(_windings(begin, end) > 1)
    if covered.size:
        a, b = edges[covered[0]].tolist()
        raise ValueError(f"elements: {kind}s overlap: others lie over that at the edge between nodes {a} and {b}")


def _crossing(begin: np.ndarray, end: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of edges, as numbers of the first and of the second, that cross each other between their ends."""
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    order = np.argsort(low[:, axis])
    last = np.searchsorted(low[order, axis], high[order, axis])
    i, j = (order[k] for k in _ranges(np.arange(1, len(order) + 1), last))
    near = (low[i, 1 - axis] < high[j, 1 - axis]) & (low[j, 1 - axis] < high[i, 1 - axis])
    i, j = i[near], j[near]
    # What is no more than round-off counts as touching.
    noise = 1e-12 * np.abs(end).max()

    def apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        along = end[one] - begin[one]
        least = noise * np.linalg.norm(along, axis=1)
        sides = [_cross(along, point[other] - begin[one]) for point in (begin, end)]
        return (np.minimum(*sides) < -least) & (np.maximum(*sides) > least)

    crossed = apart(i, j) & apart(j, i)
    return i[crossed], j[crossed]


def _windings(begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """How often the edges wind round the point just left of the middle of each."""
    along = end - begin
    point = (begin + end) / 2 + 1e-6 * np.stack([-along[:, 1], along[:, 0]], axis=1)
    order = np.argsort(point[:, 1])
    heights = point[order, 1]
    first, last = (np.searchsorted(heights, of(begin[:, 1], end[:, 1])) for of in (np.minimum, np.maximum))
    edge, k = _ranges(first, last)
    beside = order[k]
    side = np.sign(_cross(along[edge], point[beside] - begin[edge]))
    # A ray to the right of the point meets the edges on that side: upward ones, or downward ones.
    up = np.sign(along[edge, 1])
    return np.bincount(beside, up * (side == up), minlength=len(begin))


def _ranges(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All pairs `(i, k)` with `first[i] <= k < last[i]`."""
    lengths = np.maximum(last - first, 0)
    i = np.repeat(np.arange(len(first)), lengths)
    return i, np.arange(len(i)) + np.repeat(first - np.cumsum(lengths) + lengths, lengths)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
