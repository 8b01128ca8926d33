"""Finer meshes that contain every displacement of a coarser one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import namespace
from jaxbeam.mesh.element import Element
from jaxbeam.mesh.elements import element_of
from jaxbeam.mesh.mesh import Mesh, check_triangles


@usual_rules
def quadratic(mesh: Mesh) -> Mesh:
    """The mesh of the same triangles with six nodes each: those between corners follow after the corners.

    Differentiable in the nodes.

    Raises:
        ValueError: if the elements have so many nodes already, or it is the line of a rod.
    """
    check_triangles(mesh)
    element = element_of(mesh.elements)
    if element.enriched is None:
        raise ValueError(
            f"mesh: there is no {element.name} with more than its {element.nodes} nodes; use refined(mesh)"
        )
    return _made(mesh, enriched_elements(mesh.elements, len(mesh.nodes)))


@usual_rules
def refined(mesh: Mesh) -> Mesh:
    """The mesh with every element cut into four by the middles of its edges, four in the place of one.

    Nodes keep their numbers, and curved edges their shape. Differentiable in the nodes.

    Raises:
        ValueError: if it is the line of a rod.
    """
    check_triangles(mesh)
    return _made(mesh, cut_elements(mesh.elements, len(mesh.nodes)))


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


def cut_elements(elements: np.ndarray, count: int) -> Finer:
    """The elements of `count` nodes, each cut into its children."""
    element = element_of(elements)
    return _divided(elements, count, element, element.children)


def enriched_elements(elements: np.ndarray, count: int) -> Finer:
    """The finer elements by which the error of a mesh is estimated: with more nodes, or else cut into children."""
    element = element_of(elements)
    if element.enriched is None:
        return cut_elements(elements, count)
    return _divided(elements, count, element.enriched, np.eye(element.corners)[None])


def _divided(elements: np.ndarray, count: int, target: Element, parts: np.ndarray) -> Finer:
    """Elements of `count` nodes cut into `parts` `(p, c, c)`, given by their corners, each of the kind `target`.

    Nodes keep their numbers, and new ones follow.
    """
    old = element_of(elements)
    places = np.einsum("kp,cpl->ckl", target.places, parts).reshape(-1, old.corners)
    # Parts share nodes with each other, and elements with their neighbours. A node is known by the corners of its
    # element that it lies between, with their weights: multiples of a quarter on triangles,
    # and of a sixteenth on quadrilaterals.
    shares, corners = np.round(64 * places).astype(np.int64), elements[:, None, : old.corners].astype(np.int64)
    keys = np.sort(np.where(shares > 0, corners * 128 + shares, -1), axis=2)
    same = (np.abs(places[:, None] - old.places).max(axis=2) < 1e-3).T
    known, which = same.any(axis=0), same.argmax(axis=0)
    whole = np.empty((len(elements), len(places)), np.int64)
    whole[:, known] = elements[:, which[known]]
    rows = keys[:, ~known].reshape(-1, old.corners)
    _, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    new = int((~known).sum())
    whole[:, ~known] = count + number.reshape(-1, new)
    nodes = np.concatenate([np.repeat(np.arange(count)[:, None], old.nodes, axis=1), elements[first // new]])
    own = np.tile(np.eye(1, old.nodes), (count, 1))
    weights = np.concatenate([own, old.shape(places[~known])[first % new]])
    return Finer(whole.reshape(-1, target.nodes), nodes, weights)


def _made(mesh: Mesh, finer: Finer) -> Mesh:
    return Mesh(finer.carry(namespace(mesh.nodes).asarray(mesh.nodes)), finer.elements)
