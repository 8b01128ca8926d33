"""Finer meshes that can represent every displacement field of a coarser one.

For accuracy take `quadratic` first and `refined` next. They change the mesh alone, before a scene is made of it.
`jaxbeam.enriched` refines a scene with all its terms.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import namespace
from jaxbeam.mesh.element import Element
from jaxbeam.mesh.elements import element_of
from jaxbeam.mesh.mesh import Mesh, check_triangles
from jaxbeam.mesh.surface import surface


@usual_rules
def quadratic(mesh: Mesh) -> Mesh:
    """The mesh of the same triangles with six nodes each. The new nodes are numbered after the old ones.

    Differentiable in the nodes.

    Raises:
        ValueError: if the triangles have six nodes already, or `mesh` is the line of a rod.
    """
    check_triangles(mesh)
    element = element_of(mesh.elements)
    if element.enriched is None:
        raise ValueError(
            f"mesh: there is no {element.name} with more than its {element.nodes} nodes; use refined(mesh)"
        )
    return _finer_mesh(mesh, enriched_elements(mesh.elements, len(mesh.nodes)))


@usual_rules
def refined(mesh: Mesh) -> Mesh:
    """The mesh with every element cut into four at the middles of its edges. The four follow each other in `elements`.

    Nodes keep their numbers, and curved edges keep their shape. Differentiable in the nodes.

    Raises:
        ValueError: if `mesh` is the line of a rod.
    """
    check_triangles(mesh)
    return _finer_mesh(mesh, cut_elements(mesh.elements, len(mesh.nodes)))


class Finer(NamedTuple):
    """A finer mesh and its nodes as weighted means of the nodes of a coarse mesh.

    Displacements are carried to the finer mesh in the same way as positions.

    elements: node numbers of the elements of the finer mesh.
    parts: number of them for each coarse element.
    nodes: `(n, k)` for each of the `n` finer nodes, numbers of coarse nodes.
    weights: `(n, k)` their weights in the mean.
    """

    elements: np.ndarray
    parts: int
    nodes: np.ndarray
    weights: np.ndarray

    @property
    def coarse(self) -> int:
        """Number of coarse nodes. They are the first of the finer ones."""
        return int(self.nodes.max()) + 1

    def carry(self, field: Any) -> Any:
        """A nodal field of the coarse mesh, with `d` values at a node, on the finer mesh: `(n, d)`."""
        xp = namespace(field)
        return xp.sum(self.weights[:, :, None].astype(field.dtype) * xp.asarray(field)[self.nodes], axis=1)


def heirs(finer: Finer, mesh: Mesh, nodes: np.ndarray) -> np.ndarray:
    """Nodes of the finer `mesh` that inherit a role of coarse `nodes` `(m,)`: these, and new ones between them.

    A new node inherits if it lies on the surface. Inside, an edge may join two clamps, and its middle is free.
    """
    every = np.isin(finer.nodes, nodes) | (finer.weights == 0)
    outside = np.isin(np.arange(len(finer.nodes)), surface(mesh))
    old = np.arange(len(finer.nodes)) < finer.coarse
    return np.flatnonzero(every.all(axis=1) & (outside | old))


def cut_elements(elements: np.ndarray, count: int) -> Finer:
    """Each element of a mesh of `count` nodes, cut into its children."""
    element = element_of(elements)
    return _divided(elements, count, element, element.children)


def enriched_elements(elements: np.ndarray, count: int) -> Finer:
    """The finer elements that the error estimate uses: with more nodes if the kind has an enriched one, else cut."""
    element = element_of(elements)
    if element.enriched is None:
        return cut_elements(elements, count)
    return _divided(elements, count, element.enriched, np.eye(element.corners)[None])


def _divided(elements: np.ndarray, count: int, target: Element, parts: np.ndarray) -> Finer:
    """Each element of a mesh of `count` nodes, divided into parts. Nodes keep their numbers, and new ones follow.

    Args:
        elements: node numbers of the mesh.
        count: number of nodes of the mesh.
        target: the kind of element that each part becomes.
        parts: `(p, c, c)` corners of each part, as points of the divided element.
    """
    old = element_of(elements)
    places = np.einsum("kp,cpl->ckl", target.places, parts).reshape(-1, old.corners)
    # Parts share nodes with each other and with parts of neighbouring elements. So a new node is identified by the
    # element corners of nonzero weight and their weights. These are multiples of a quarter on triangles and of a
    # sixteenth on quadrilaterals.
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
    return Finer(whole.reshape(-1, target.nodes), len(parts), nodes, weights)


def _finer_mesh(mesh: Mesh, finer: Finer) -> Mesh:
    return Mesh(finer.carry(namespace(mesh.nodes).asarray(mesh.nodes)), finer.elements)
