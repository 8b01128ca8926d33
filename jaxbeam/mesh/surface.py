"""The anchor of a tendon on a body: a node, or a patch of the surface.

A force on one node is a point load. The displacement of a continuum under a point load is infinite, so the answer grows
without bound as the mesh is refined. With a patch of finite width the answer has a limit. The position of the anchor is
the mean of the surface positions `x(s)`, weighted by a tent function of the arc length `s` from the anchor's node:

    p = int w(s) x(s) ds / int w(s) ds,     w = max(0, 1 - |s| / width).

`x(s)` is interpolated by the shape functions, so `p` is a weighted mean of nodes, with weights of sum 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from jaxbeam.core.tree import Key, is_concrete, key_of, read_only
from jaxbeam.mesh.element import edge_functions
from jaxbeam.mesh.elements import element_of
from jaxbeam.mesh.mesh import Mesh

# Gauss's rule of two points on (0, 1): exact for a shape function times the tent function.
_POINTS = 0.5 + np.array([-0.5, 0.5]) / 3**0.5


def patch(mesh: Mesh, node: int, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes `(k,)` of the patch of surface about a corner `node`, `node` first, and their weights `(k,)`.

    The patch reaches the arc length `width` to either side, also round corners of the body. Edges are taken as straight
    to measure it. A patch of width 0 is the node alone.

    Raises:
        ValueError: if the nodes are traced, the node is not a corner of a triangle on the surface, or the surface
            within `width` closes on itself.
    """
    if width == 0:
        return np.array([node]), np.ones(1)
    if not is_concrete(mesh.nodes):
        raise ValueError("width: an anchor of finite width needs concrete nodes; build the mesh outside jit and grad")
    positions = np.asarray(mesh.nodes, float)
    weights = {node: 0.0}
    for line, s, length, share in walk(positions, surface(mesh), node, width):
        xi = share * _POINTS
        tent = 0.5 * share * length * (1 - (s + length * xi) / width)
        for number, values in zip(line, edge_functions(len(line), xi).T, strict=True):
            weights[number] = weights.get(number, 0.0) + float(tent @ values)
    nodes, values = np.array(list(weights)), np.array(list(weights.values()))
    return nodes, values / values.sum()


def walk(
    positions: np.ndarray, edges: np.ndarray, node: int, width: float
) -> Iterator[tuple[list[int], float, float, float]]:
    """The edges of a surface within the arc length `width` of a node: first one way round the body, then the other.

    Yields:
        For each edge: its nodes in the direction of the walk; the arc length at its beginning; its length; and the
        fraction of it, from its beginning, that lies within `width`.

    Raises:
        ValueError: if the node is not a corner on the surface, or the surface closes on itself within `width`.
    """
    for ways in (edges, edges[:, [1, 0, 2][: edges.shape[1]]]):
        following = {line[0]: line for line in ways.tolist()}
        here, s, left = node, 0.0, len(ways)
        while s < (1 - 1e-9) * width:
            # `left` ends a walk that never comes back: where two parts of a body touch at a node, it may go round the
            # other part for ever.
            if here not in following or (s > 0 and here == node) or left == 0:
                problem = "is not a corner on the surface" if s == 0 else "has a surface shorter than the width"
                raise ValueError(f"width: node {node} {problem}, so it has no patch of width {width:g}")
            line = following[here]
            length = float(np.linalg.norm(positions[line[1]] - positions[line[0]]))
            yield line, s, length, min(1.0, (width - s) / length)
            here, s, left = line[1], s + length, left - 1


def surface(mesh: Mesh) -> np.ndarray:
    """The edges `(b, 2)` or `(b, 3)` of the surface: first and second corner, and the node between if there is one.

    The corners are in counter-clockwise order around the body.
    """
    return surface_of((key_of(mesh, "elements"),))


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


def edges_between(mesh: Mesh, nodes: np.ndarray) -> np.ndarray:
    """The edges `(m, k)` of the surface of which both corners are among `nodes`.

    Raises:
        ValueError: if there is none.
    """
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
    following = {line[0]: line for line in surface(mesh).tolist()}
    found, parents = [], []
    for parent, (start, end) in enumerate(edges[:, :2].tolist()):
        here = start
        while here != end:
            found.append(following[here])
            parents.append(parent)
            here = following[here][1]
    return np.array(found), np.array(parents)
