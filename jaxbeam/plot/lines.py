"""The lines that a picture of a beam is made of: edges, curved as the shape functions have them, tendons and patches.

An edge is given by the numbers of its nodes: its first and second end, then the node between them if there is one.
Positions are `(n, 2)`, or `(n, 3)` for a rod, whose nodes also turn; of those the first two columns are drawn.
"""

from __future__ import annotations

import jax
import numpy as np

from jaxbeam.core.tree import Numbers
from jaxbeam.mesh.elements import EDGES, shape_functions
from jaxbeam.mesh.surface import surface, walk
from jaxbeam.physics.tendon import TendonEnergy
from jaxbeam.scene.scene import Scene, solid_terms, tendon_terms

# Points of a curved edge; an odd number, so that the node in the middle is one of them.
POINTS = 9


def elements_of(scene: Scene) -> np.ndarray:
    """`(t, k)` nodes of each element, in the order in which the measures number them."""
    solids = [np.asarray(term.nodes) for term in solid_terms(scene)]
    return np.concatenate(solids) if solids else np.asarray(scene.mesh.elements)


def outline(scene: Scene) -> np.ndarray:
    """The edges `(e, 2)` or `(e, 3)` of the surface, the body on their left; of a rod, those of its centre line."""
    return np.asarray(scene.mesh.elements) if scene.mesh.elements.shape[1] == 2 else surface(scene.mesh)


def edge_curves(x: np.ndarray, edges: np.ndarray, shares: Numbers = 1.0) -> np.ndarray:
    """Points `(e, p, 2)` along edges; of each, only along the first part of it if its share `(e,)` is less than 1."""
    nodes = edges.shape[1]
    xi = np.expand_dims(shares, -1) * np.linspace(0, 1, POINTS if nodes == 3 else 2)
    line = np.stack([1 - xi, xi, 0 * xi], axis=-1).reshape(-1, 3)
    functions = shape_functions(3 * nodes - 3, line)[:, [0, 1, 3][:nodes]]
    return functions.reshape(*xi.shape, nodes) @ x[edges, :2]


def rings(x: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Points `(t, p, 2)` around each element, in its order; of an element of two nodes, its ends."""
    nodes = elements.shape[1]
    if nodes == 2:
        return x[elements, :2]
    xi = np.linspace(0, 1, POINTS if nodes == 6 else 2)[:-1, None]
    corners = np.eye(3)
    around = np.concatenate([(1 - xi) * corners[a] + xi * corners[b] for a, b in EDGES])
    return shape_functions(nodes, around) @ x[elements, :2]


def tendon_points(scene: Scene, x: np.ndarray) -> list[np.ndarray]:
    """The points `(p, 2)` that each tendon runs through."""
    found: list[np.ndarray] = []
    for term in tendon_terms(scene):
        assert isinstance(term.energy, TendonEnergy)
        found += [*np.asarray(jax.vmap(term.energy.points)(x[term.nodes], term.params.attachment))[..., :2]]
    return found


def arms(scene: Scene, x: np.ndarray) -> np.ndarray:
    """Lines `(q, 2, 2)` from the nodes of a rod to the points beside it that its tendons run through."""
    nodes = [each for term in tendon_terms(scene) for each in np.asarray(term.nodes)]
    pairs = [(x[k, :2], points) for k, points in zip(nodes, tendon_points(scene, x), strict=True)]
    found = [np.stack(pair, axis=1) for pair in pairs if len(pair[0]) == len(pair[1])]
    return np.concatenate([np.zeros((0, 2, 2)), *found])


def extremes(scene: Scene, states: np.ndarray) -> list[np.ndarray]:
    """Points `(..., 2)` that span all that is drawn of a beam at rest and in states `(s, n, 2)`."""
    found, edges = [], outline(scene)
    for x in (np.asarray(scene.mesh.nodes), *states):
        # Curved edges bulge past their nodes, and the tendons of a rod run beside it.
        found += [x[:, :2], edge_curves(x, edges), *tendon_points(scene, x)]
    return found


def patches(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surface that anchors of finite width pull on, as first parts of edges.

    Returns:
        The edges `(q, k)`, which may run either way round the body; the share `(q,)` of each; and the number `(q,)` of
        the tendon that pulls on it.
    """
    edges, rest = outline(scene), np.asarray(scene.mesh.nodes)
    found: list[tuple[list[int], float, int]] = []
    first = 0
    for term in tendon_terms(scene):
        if term.params.ends is not None:
            anchors = [np.ravel(each) for each in (term.params.ends, term.params.width)]
            numbers = first + np.repeat(np.arange(len(term.nodes)), term.params.ends.shape[1])
            for node, width, number in zip(*anchors, numbers, strict=True):
                found += [(line, share, number) for line, _, _, share in walk(rest, edges, int(node), float(width))]
        first += len(term.nodes)
    columns = zip(*found, strict=True) if found else ([], [], [])
    reached, shares, numbers = (np.array(column) for column in columns)
    return reached.astype(int).reshape(-1, edges.shape[1]), shares, numbers.astype(int)
