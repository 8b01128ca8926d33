"""Finer meshes that contain every displacement of a coarser one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import namespace
from jaxbeam.mesh.elements import FOUR_PARTS, QUADRATIC_TRIANGLE, TRIANGLE, Element, element_of
from jaxbeam.mesh.mesh import Mesh, check_triangles


@usual_rules
def quadratic(mesh: Mesh) -> Mesh:
    """The mesh of the same triangles with six nodes each: those between corners follow after the corners.

    Differentiable in the nodes.

    Raises:
        ValueError: if the triangles have six nodes already, or it is not made of triangles.
    """
    check_triangles(mesh)
    if element_of(mesh.elements) is not TRIANGLE:
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
    return _divided(elements, count, QUADRATIC_TRIANGLE, np.eye(3)[None])


def cut_in_four(elements: np.ndarray, count: int) -> Finer:
    """Each triangle as four of the same kind, cut by the middles of its edges."""
    return _divided(elements, count, element_of(elements), FOUR_PARTS)


def enriched_elements(elements: np.ndarray, count: int) -> Finer:
    """The finer elements by which the error of a mesh is estimated: six nodes in place of three, or four parts."""
    return with_middle_nodes(elements, count) if element_of(elements) is TRIANGLE else cut_in_four(elements, count)


def _divided(elements: np.ndarray, count: int, target: Element, parts: np.ndarray) -> Finer:
    """Elements of `count` nodes cut into `parts` `(c, 3, 3)`, given by their corners, each of the kind `target`.

    Nodes keep their numbers, and new ones follow.
    """
    old = element_of(elements)
    places = np.einsum("kp,cpl->ckl", target.places, parts).reshape(-1, 3)
    # Parts share nodes with each other, and elements with their neighbours. A node is known by the corners of its
    # element that it lies between, with their weights in quarters.
    quarters = np.round(4 * places).astype(np.int64)
    keys = np.sort(np.where(quarters > 0, elements[:, None, :3].astype(np.int64) * 4 + quarters, -1), axis=2)
    same = (np.abs(places[:, None] - old.places).max(axis=2) < 0.125).T
    known, which = same.any(axis=0), same.argmax(axis=0)
    whole = np.empty((len(elements), len(places)), np.int64)
    whole[:, known] = elements[:, which[known]]
    rows = keys[:, ~known].reshape(-1, 3)
    _, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    new = int((~known).sum())
    whole[:, ~known] = count + number.reshape(-1, new)
    nodes = np.concatenate([np.repeat(np.arange(count)[:, None], old.nodes, axis=1), elements[first // new]])
    own = np.tile(np.eye(1, old.nodes), (count, 1))
    weights = np.concatenate([own, old.shape(places[~known])[first % new]])
    return Finer(whole.reshape(-1, target.nodes), nodes, weights)


def _made(mesh: Mesh, finer: Finer) -> Mesh:
    return Mesh(finer.carry(namespace(mesh.nodes).asarray(mesh.nodes)), finer.elements)
