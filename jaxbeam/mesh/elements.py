"""Kinds of elements: a record for each, with all that is asked of an element.

Triangles have three nodes (P1) or six (P2). Nodes 0, 1 and 2 are the corners, counter-clockwise; nodes 3, 4 and 5 lie
between corners (0, 1), (1, 2) and (2, 0). Points are given by their barycentric coordinates `(l0, l1, l2)`.

Sources: shape functions, Zienkiewicz and Taylor, "The Finite Element Method", vol. 1, 2000, section 8.9; rules,
Strang and Fix (1973) and Dunavant, Int. J. Numer. Methods Eng. 21 (1985), 1129-1148.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

# The corners that each node between corners lies between.
EDGES = ((0, 1), (1, 2), (2, 0))


# Of each rule: weight, and the coordinate that differs from the two others, of every orbit of three points.
_ORBITS = {
    1: [(1.0, 1 / 3)],
    2: [(1 / 3, 2 / 3)],
    4: [(0.2233815896780115, 0.1081030181680702), (0.1099517436553219, 0.8168475729804585)],
    5: [
        (0.225, 1 / 3),
        ((155 + 15**0.5) / 1200, (9 - 2 * 15**0.5) / 21),
        ((155 - 15**0.5) / 1200, (9 + 2 * 15**0.5) / 21),
    ],
}


DEGREES = tuple(_ORBITS)


def rule(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Points `(q, 3)` and weights `(q,)`, of sum 1, that integrate polynomials up to a degree exactly.

    Raises:
        ValueError: if there is no such rule here; they have 1, 3, 6 and 7 points.
    """
    if degree not in _ORBITS:
        raise ValueError(f"degree: expected one of {DEGREES}, got {degree!r}")
    points, weights = [], []
    for weight, single in _ORBITS[degree]:
        other = (1 - single) / 2
        turns = 1 if single == 1 / 3 else 3
        points += [[single if i == k else other for i in range(3)] for k in range(turns)]
        weights += [weight] * turns
    return np.array(points), np.array(weights)


def degree_of(points: int) -> int:
    """The degree of the rule with so many points.

    Raises:
        ValueError: if there is none here.
    """
    degrees = {len(rule(degree)[1]): degree for degree in DEGREES}
    if points not in degrees:
        raise ValueError(
            f"scene: expected a solid with {sorted(degrees)} quadrature points in an element, got {points}"
        )
    return degrees[points]


# ------------------------------------------------------------------------------------------------ records


@dataclasses.dataclass(frozen=True, eq=False)
class Element:
    """A kind of element with `k` nodes.

    places: `(k, 3)` barycentric coordinates of its nodes.
    shape: values `(q, k)` of the shape functions at points `(q, 3)`.
    slopes: their derivatives `(q, k, 2)` in `l1` and `l2`, with `l0 = 1 - l1 - l2`.
    edges: of each edge the nodes: its first and its second end, counter-clockwise, and then those between.
    affine: whether the map from the reference element has the same slopes, and so `J`, everywhere.
    degree: of the quadrature that is used unless another is asked for.
    shortfall: the error of an answer over the change that `enriched` elements make, measured by
        `benchmarks/accuracy.py`.
    """

    places: np.ndarray
    shape: Callable[[np.ndarray], np.ndarray]
    slopes: Callable[[np.ndarray], np.ndarray]
    edges: tuple[tuple[int, ...], ...]
    affine: bool
    degree: int
    shortfall: float

    @property
    def nodes(self) -> int:
        """How many nodes it has."""
        return len(self.places)


def _linear_slopes(points: np.ndarray) -> np.ndarray:
    return np.broadcast_to([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]], (len(points), 3, 2))


def _quadratic_shape(points: np.ndarray) -> np.ndarray:
    corners = points * (2 * points - 1)
    between = [4 * points[:, a] * points[:, b] for a, b in EDGES]
    return np.concatenate([corners, np.stack(between, axis=1)], axis=1)


def _quadratic_slopes(points: np.ndarray) -> np.ndarray:
    by_l = np.zeros((len(points), 6, 3))
    for c in range(3):
        by_l[:, c, c] = 4 * points[:, c] - 1
    for k, (a, b) in enumerate(EDGES):
        by_l[:, 3 + k, a], by_l[:, 3 + k, b] = 4 * points[:, b], 4 * points[:, a]
    return by_l[:, :, 1:] - by_l[:, :, :1]


_CORNERS = np.eye(3)
_MIDDLES = np.array([(_CORNERS[a] + _CORNERS[b]) / 2 for a, b in EDGES])
# The corners of the four parts into which the middles of its edges cut a triangle.
FOUR_PARTS = np.concatenate([_CORNERS, _MIDDLES])[np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])]

# From three nodes to six the change falls hardly short of the error. From six-node triangles to smaller ones it falls
# short by what the corners of the clamp leave, where the stress is infinite.
TRIANGLE = Element(_CORNERS, np.array, _linear_slopes, EDGES, affine=True, degree=1, shortfall=1.0)
QUADRATIC_TRIANGLE = Element(
    np.concatenate([_CORNERS, _MIDDLES]),
    _quadratic_shape,
    _quadratic_slopes,
    tuple((a, b, 3 + k) for k, (a, b) in enumerate(EDGES)),
    affine=False,
    degree=2,
    shortfall=1.5,
)
ELEMENTS = {element.nodes: element for element in (TRIANGLE, QUADRATIC_TRIANGLE)}


def element_of(elements: Any) -> Element:
    """The kind of elements whose node numbers `(t, k)` these are."""
    return ELEMENTS[elements.shape[1]]


def edge_functions(nodes: int, xi: np.ndarray) -> np.ndarray:
    """Shape functions `(..., nodes)` along an edge of two or three nodes, at `xi` from its first end, 0, to 1."""
    if nodes == 2:
        return np.stack([1 - xi, xi], axis=-1)
    return np.stack([(1 - xi) * (1 - 2 * xi), xi * (2 * xi - 1), 4 * xi * (1 - xi)], axis=-1)


def edge_products(nodes: int) -> np.ndarray:
    """Integrals `(nodes, nodes)` along an edge of each shape function times the slope of each."""
    if nodes == 2:
        return np.array([[-1, 1], [-1, 1]]) / 2
    return np.array([[-3, -1, 4], [1, 3, -4], [-4, 4, 0]]) / 6


# --------------------------------------------------------------------------- how the map of an element stretches area


def corner_slopes(x: Any) -> list[list[Any]]:
    """Derivatives `(2, ...)` in `l1` and `l2`, at each corner, of the map with six nodes at `x` `(6, 2, ...)`.

    In between they are linear in the barycentric coordinates.
    """
    slopes = _quadratic_slopes(_CORNERS)
    # Python's own numbers leave the dtype of the positions as it is.
    sums = lambda factors: sum(f * x[k] for k, f in enumerate(factors.tolist()) if f)
    return [[sums(slopes[c, :, d]) for d in range(2)] for c in range(3)]


def determinants(left: list[list[Any]], right: list[list[Any]]) -> list[Any]:
    """Bernstein coefficients (see `jaxbeam.mesh.bernstein`) of the determinant of two slopes from `corner_slopes`.

    They are the first slope of one map and the second of another. If both maps are the same, it tells by how much
    that map stretches area: its mean is twice the area of the element.
    """
    crossed = lambda a, b: left[a][0][0] * right[b][1][1] - left[a][0][1] * right[b][1][0]
    return [crossed(a, a) for a in range(3)] + [(crossed(a, b) + crossed(b, a)) / 2 for a, b in EDGES]
