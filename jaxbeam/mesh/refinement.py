"""Finer meshes that contain every displacement of a coarser one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import namespace
from jaxbeam.mesh.elements import EDGES, shape_functions
from jaxbeam.mesh.mesh import Mesh, check_triangles


@usual_rules
def quadratic(mesh: Mesh) -> Mesh:
    """The mesh of the same triangles with six nodes each: those between corners follow after the corners.

    Differentiable in the nodes.

    Raises:
        ValueError: if the triangles have six nodes already, or it is not made of triangles.
    """
    check_triangles(mesh)
    if mesh.elements.shape[1] != 3:
        raise ValueError("mesh: its triangles have six nodes already")
    return _made(mesh, with_middle_nodes(mesh.elements, len(mesh.nodes)))


@usual_rules
def refined(mesh: Mesh) -> Mesh:
    """The mesh with every triangle cut into four by the middles of its edges, four in the place of one.

    Nodes keep their numbers. Six-node triangles keep the shape of their edges. Differentiable in the nodes.

    Raises:
        ValueError: if it is not made of triangles.
    """
    check_triangles(mesh)
    return _made(mesh, cut_in_four(mesh.elements, len(mesh.nodes)))


class Finer(NamedTuple):
    """How a finer mesh comes from a coarse one: its `elements`, and each of its nodes as a mean of coarse `nodes`
    `(n, k)` with `weights` `(n, k)`. Displacements are carried over as positions are."""

    elements: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray

    def carry(self, field: Any) -> Any:
        """The nodal field `(n, d)` of the coarse mesh on the finer one."""
        xp = namespace(field)
        return xp.sum(self.weights[:, :, None].astype(field.dtype) * xp.asarray(field)[self.nodes], axis=1)


def with_middle_nodes(elements: np.ndarray, count: int) -> Finer:
    """Triangles of three nodes as triangles of six."""
    pairs = np.sort(elements[:, EDGES].reshape(-1, 2), axis=1)
    ends, number = np.unique(pairs, axis=0, return_inverse=True)
    old = np.repeat(np.arange(count)[:, None], 2, axis=1)
    weights = np.concatenate([np.tile([1.0, 0.0], (count, 1)), np.full((len(ends), 2), 0.5)])
    whole = np.concatenate([elements, count + number.reshape(-1, 3)], axis=1)
    return Finer(whole, np.concatenate([old, ends]), weights)


def cut_in_four(elements: np.ndarray, count: int) -> Finer:
    """Each triangle as four of the same number of nodes, at the corners and in the middle."""
    if elements.shape[1] == 3:
        six = with_middle_nodes(elements, count)
        four = six.elements[:, _PARTS[:, :3]]
        return Finer(four.reshape(-1, 3), six.nodes, six.weights)
    inside = np.stack([(_PLACES[part[a]] + _PLACES[part[b]]) / 2 for part in _PARTS for a, b in EDGES])
    # Parts share nodes with each other and triangles with their neighbours: one is known by its corners, weighted.
    quarters = np.round(4 * inside).astype(np.int64)
    corners = elements[:, None, :3].astype(np.int64)
    keys = np.sort(np.where(quarters > 0, corners * 4 + quarters, -1), axis=2).reshape(-1, 3)
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    whole = np.concatenate([elements[:, _PARTS], (count + number).reshape(-1, 4, 3)], axis=2)
    values = shape_functions(6, inside)
    old = np.repeat(np.arange(count)[:, None], 6, axis=1)
    own = np.tile(np.eye(1, 6), (count, 1))
    nodes = np.concatenate([old, elements[first // 12]])
    return Finer(whole.reshape(-1, 6), nodes, np.concatenate([own, values[first % 12]]))


# The places of the six nodes of a triangle, and those of the corners and middles of its four parts that are among them.
_PLACES = np.concatenate([np.eye(3), [[0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]]])


_PARTS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])


def _made(mesh: Mesh, finer: Finer) -> Mesh:
    return Mesh(finer.carry(namespace(mesh.nodes).asarray(mesh.nodes)), finer.elements)
