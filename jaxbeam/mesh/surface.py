"""The anchor of a tendon on a body: a node, or a patch of the surface.

A force on one node is a point load. The displacement of a continuum under a point load is infinite, so the answer grows
without bound as the mesh is refined. With a patch of finite width the answer has a limit. The position of the anchor is
a weighted mean of the surface positions `x(s)`, where `s` is the arc length from the anchor's node:

    p = int w(s) x(s) ds,     w = max(0, 1 - |s| / width) (a + b . (X(s) - X(0))).

At rest `p` is the node itself: `a` and `b` are such that the weights have the sum 1 and the mean `X(0)`. In the middle
of a straight side `b` is zero, and the weights are a tent. At the end of a side, where a tent has its mean inside the
body, some weights are negative: together the forces on the patch are the force at the node, and have no moment about
it. (Such weights are those of the reproducing kernel method, Liu, Jun and Zhang 1995, Int. J. Numer. Methods Fluids 20,
1081-1106.) On a surface that bends gently the mean keeps the small distance that the bend makes.

`x(s)` is interpolated by the shape functions, so `p` is a weighted mean of nodes, with weights of sum 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from jaxbeam.core.tree import Key, is_concrete, key_of, read_only
from jaxbeam.mesh.element import edge_functions, edge_rule
from jaxbeam.mesh.elements import element_of
from jaxbeam.mesh.mesh import Mesh, check_triangles

# Gauss's rule of three points on (0, 1): exact for a shape function times the weights, on a straight edge.
_POINTS, _SHARES = edge_rule(3)
# Cosine of the turn from one edge to the next, here 45 degrees, at which a patch ends: a corner of the body.
CORNER = 0.7
# Variances of the patch below this share of the largest are those of a gentle bend, along which the mean is not moved.
BEND = 1e-2


def patch(mesh: Mesh, node: int, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes `(k,)` of the patch of surface about a corner `node`, `node` first, and their weights `(k,)`.

    The patch reaches the arc length `width` to either side, but not round a corner of the body, where the surface turns
    by more than 45 degrees. At such a corner it lies on both sides of it. Edges are taken as straight to measure arc
    length. A patch of width 0 is the node alone.

    Raises:
        ValueError: if the nodes are traced, the node is not a corner of a triangle on the surface, or the surface
            within `width` closes on itself.
    """
    if width == 0:
        return np.array([node]), np.ones(1)
    if not is_concrete(mesh.nodes):
        raise ValueError("width: an anchor of finite width needs concrete nodes; build the mesh outside jit and grad")
    positions = np.asarray(mesh.nodes, float)
    # At each quadrature point of each edge: the tent times the length, the values of the shape functions, the place.
    lines, tents, values, places = [], [], [], []
    for line, s, length, share in walk(positions, surface(mesh), node, width):
        xi = share * _POINTS
        lines.append(line)
        tents.append(share * length * _SHARES * (1 - (s + length * xi) / width))
        values.append(edge_functions(len(line), xi))
        places.append(values[-1] @ (positions[line] - positions[node]) / width)
    factors = _balancing(np.concatenate(tents), np.concatenate(places)).reshape(len(lines), -1)
    weights = {node: 0.0}
    for line, tent, factor, functions in zip(lines, tents, factors, values, strict=True):
        for number, weight in zip(line, (tent * factor) @ functions, strict=True):
            weights[number] = weights.get(number, 0.0) + float(weight)
    return np.array(list(weights)), np.array(list(weights.values()))


def _balancing(tents: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Factors `a + b . place` `(q,)` of the weights `tents` `(q,)`: their sum becomes 1, the mean of `places` 0."""
    mean = tents @ places / tents.sum()
    away = places - mean
    variances, axes = np.linalg.eigh((tents[:, None] * away).T @ away / tents.sum())
    kept = axes[:, variances > BEND * variances[-1]]
    # Along the axes that are kept the mean moves to 0.
    slope = kept @ ((kept.T @ -mean) / variances[variances > BEND * variances[-1]])
    return (1 + away @ slope) / tents.sum()


def walk(
    positions: np.ndarray, edges: np.ndarray, node: int, width: float
) -> Iterator[tuple[list[int], float, float, float]]:
    """The edges of a surface within the arc length `width` of a node: first one way round the body, then the other.

    Each way ends at the first corner of the body.

    Yields:
        For each edge: its nodes in the direction of the walk; the arc length at its beginning; its length; and the
        fraction of it, from its beginning, that lies within `width`.

    Raises:
        ValueError: if the node is not a corner on the surface, or the surface closes on itself within `width`.
    """
    for ways in (edges, edges[:, [1, 0, 2][: edges.shape[1]]]):
        following = {line[0]: line for line in ways.tolist()}
        here, s, left, before = node, 0.0, len(ways), np.zeros(2)
        while s < (1 - 1e-9) * width:
            # `left` ends a walk that never comes back: where two parts of a body touch at a node, it may go round the
            # other part for ever.
            if here not in following or (s > 0 and here == node) or left == 0:
                problem = "is not a corner on the surface" if s == 0 else "has a surface shorter than the width"
                raise ValueError(f"width: node {node} {problem}, so it has no patch of width {width:g}")
            line = following[here]
            chord = positions[line[1]] - positions[line[0]]
            length = float(np.linalg.norm(chord))
            if s > 0 and chord @ before < CORNER * length:
                break
            before = chord / length
            yield line, s, length, min(1.0, (width - s) / length)
            here, s, left = line[1], s + length, left - 1


def surface(mesh: Mesh) -> np.ndarray:
    """The edges `(b, 2)` or `(b, 3)` of the surface: first and second corner, and the node between if there is one.

    The corners are in counter-clockwise order around the body.
    """
    return surface_of((key_of(mesh, "elements"),))


def outline(mesh: Mesh) -> np.ndarray:
    """The edges `(e, k)` that a mesh is drawn with, sorted: those of its surface, or the elements of a rod.

    Sorted, they are the same for meshes that differ inside only, such as in their diagonals.
    """
    return _sorted(key_of(mesh, "elements"), mesh.is_line)


@lru_cache(maxsize=32)
def _sorted(elements: Key, is_line: bool) -> np.ndarray:
    edges = elements.array if is_line else surface_of((elements,))
    return read_only(edges[np.lexsort(edges.T[::-1])], np.int32)


@lru_cache(maxsize=32)
def surface_of(bodies: tuple[Key, ...]) -> np.ndarray:
    """The edges of the surface, as `surface` returns them.

    Args:
        bodies: the triangles `(t, k)` of each body; without bodies there are no edges.
    """
    if not bodies:
        return read_only(np.zeros((0, 2)), np.int32)
    triangles = np.concatenate([body.array for body in bodies])
    edges = element_of(triangles).edges
    every = triangles[:, edges].reshape(-1, len(edges[0]))
    low, high = np.sort(every[:, :2].astype(np.int64), axis=1).T
    _, number, count = np.unique(low * (triangles.max() + 1) + high, return_inverse=True, return_counts=True)
    return read_only(every[count[number] == 1])


def node_spacing(mesh: Mesh, node: int) -> float:
    """The largest distance of neighbouring nodes of the surface, beside a corner `node` on it, measured straight."""
    edges, positions = surface(mesh), np.asarray(mesh.nodes, float)
    ends = positions[edges[(edges[:, :2] == node).any(axis=1), :2]]
    return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max()) / (edges.shape[1] - 1)


def edges_between(mesh: Mesh, nodes: np.ndarray) -> np.ndarray:
    """The edges `(m, k)` of the surface of which both corners are among `nodes`.

    Raises:
        ValueError: if there is none, or `mesh` is the line of a rod.
    """
    check_triangles(mesh)
    edges = surface(mesh)
    chosen = edges[np.isin(edges[:, :2], nodes).all(axis=1)]
    if not len(chosen):
        raise ValueError(
            f"nodes: expected the corners of at least one edge of the surface, got {nodes.tolist()}; "
            f"choose them with nodes_where(mesh, ...)"
        )
    return chosen


def finer_edges(mesh: Mesh, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges of the surface of a finer mesh that lie on `edges` `(m, k)` of a coarser one.

    Returns:
        The edges, in order; and for each the index of the coarse edge on which it lies.
    """
    following: dict[int, list[list[int]]] = {}
    for line in surface(mesh).tolist():
        following.setdefault(line[0], []).append(line)
    found, parents = [], []
    for parent, (start, end) in enumerate(edges[:, :2].tolist()):
        # Where two parts of the surface touch at a node, two edges begin there. The shortest way is that of the edge.
        ways = [[line] for line in following[start]]
        while not (whole := [way for way in ways if way[-1][1] == end]):
            ways = [[*way, line] for way in ways for line in following[way[-1][1]]]
        found += whole[0]
        parents += [parent] * len(whole[0])
    return np.array(found), np.array(parents)
