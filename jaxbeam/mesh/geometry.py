"""Checks of a mesh: connectivity, areas, curved edges, overlaps. All run on the host."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from jaxbeam.mesh.element import Determinant
from jaxbeam.mesh.elements import element_of

# An area of at most this fraction of the squared extent of the body counts as zero.
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
    # Nodes that round to the same point of a grid of 1e-9 times the extent coincide. Mesh generators merge such nodes.
    # A real gap is far wider.
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
    """Signed area `(t,)` of the polygon of each element's corners."""
    first, *others = (nodes[elements[:, k]] for k in range(element_of(elements).corners))
    spans = [corner - first for corner in others]
    return 0.5 * sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] for a, b in itertools.pairwise(spans))


def _check_curves(determinant: Determinant, nodes: np.ndarray, elements: np.ndarray, area: np.ndarray) -> None:
    """Refuse elements that fold over somewhere. Their corners enclose `area` `(t,)`, which is positive."""
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
    """Edges `(b, 2)` of the surface, with the body on their left. All edges of the mesh are checked on the way.

    Raises:
        ValueError: if two elements lie on the same side of an edge. Elements are counter-clockwise, so the two elements
            of an edge must run along it in opposite directions.
    """
    kind = element_of(elements).name
    corners = elements[:, : element_of(elements).corners]
    a, b = elements[:, element_of(elements).sides].reshape(-1, 2).T.astype(np.int64)
    total = int(elements.max()) + 1
    # One number encodes both ends of a side and its direction. After sorting, the sides of one edge are neighbours.
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
    """Refuse counter-clockwise elements that overlap. Only the `edges` of their surface are looked at.

    The winding number of the surface about a point is the number of elements that cover the point. It changes only
    across the surface. So no point is covered twice if no two edges of the surface cross and the winding number is 1
    beside each edge. Meshes with curved edges are not checked.
    """
    kind = element_of(elements).name
    # Positions relative to one node of the surface, so that the origin may be far from the body.
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
    """Indices `(i, j)` of all pairs of edges that cross between their ends. `axis` is the coordinate to sort by."""
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    order = np.argsort(low[:, axis])
    last = np.searchsorted(low[order, axis], high[order, axis])
    i, j = (order[k] for k in _ranges(np.arange(1, len(order) + 1), last))
    near = (low[i, 1 - axis] < high[j, 1 - axis]) & (low[j, 1 - axis] < high[i, 1 - axis])
    i, j = i[near], j[near]
    # Edges that cross by no more than round-off only touch.
    noise = 1e-12 * np.abs(end).max()

    def apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        along = end[one] - begin[one]
        least = noise * np.linalg.norm(along, axis=1)
        sides = [_cross(along, point[other] - begin[one]) for point in (begin, end)]
        return (np.minimum(*sides) < -least) & (np.maximum(*sides) > least)

    crossed = apart(i, j) & apart(j, i)
    return i[crossed], j[crossed]


def _windings(begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Winding numbers `(b,)` of the edges about points, one just to the left of the middle of each edge."""
    along = end - begin
    point = (begin + end) / 2 + 1e-6 * np.stack([-along[:, 1], along[:, 0]], axis=1)
    order = np.argsort(point[:, 1])
    heights = point[order, 1]
    first, last = (np.searchsorted(heights, of(begin[:, 1], end[:, 1])) for of in (np.minimum, np.maximum))
    edge, k = _ranges(first, last)
    beside = order[k]
    side = np.sign(_cross(along[edge], point[beside] - begin[edge]))
    # A ray from the point in the direction of x crosses an upward edge if the point is on the left of that edge, and a
    # downward edge if the point is on its right.
    up = np.sign(along[edge, 1])
    return np.bincount(beside, up * (side == up), minlength=len(begin))


def _ranges(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of whole numbers `(i, k)` with `first[i] <= k < last[i]`, as two arrays."""
    lengths = np.maximum(last - first, 0)
    i = np.repeat(np.arange(len(first)), lengths)
    return i, np.arange(len(i)) + np.repeat(first - np.cumsum(lengths) + lengths, lengths)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
