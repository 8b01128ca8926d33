"""Triangles of three nodes (P1) and of six (P2).

Nodes 0, 1 and 2 are the corners, counter-clockwise; nodes 3, 4 and 5 lie between corners (0, 1), (1, 2) and (2, 0).
Points are given by their barycentric coordinates `(l0, l1, l2)`, and slopes are taken in `l1` and `l2`, with
`l0 = 1 - l1 - l2`.

Sources: shape functions, Zienkiewicz and Taylor, "The Finite Element Method", vol. 1, 2000, section 8.9; rules,
Strang and Fix (1973) and Dunavant, Int. J. Numer. Methods Eng. 21 (1985), 1129-1148.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxbeam.mesh.bernstein import EDGES, array_module, basis, minimiser
from jaxbeam.mesh.element import Determinant, Element

# The orbits of each rule, by its degree: the weight of a point, and the one of its three coordinates that differs from
# the two others. An orbit has three points, or one if that coordinate is 1/3.
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


def _rule(degree: int) -> tuple[np.ndarray, np.ndarray]:
    points, weights = [], []
    for weight, single in _ORBITS[degree]:
        other = (1 - single) / 2
        turns = 1 if single == 1 / 3 else 3
        points += [[single if i == k else other for i in range(3)] for k in range(turns)]
        weights += [weight] * turns
    return np.array(points), np.array(weights)


RULES = {degree: _rule(degree) for degree in _ORBITS}


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


# ----------------------------------------------------------------------- determinant of the map of six-node triangles


def corner_slopes(x: Any) -> list[list[Any]]:
    """For each corner, the derivatives `(2, ...)` in `l1` and in `l2` of the map with nodes `x` `(6, 2, ...)`.

    Between corners the derivatives are linear in the barycentric coordinates.
    """
    slopes = _quadratic_slopes(_CORNERS)
    # Python floats do not change the dtype of the positions.
    sums = lambda factors: sum(f * x[k] for k, f in enumerate(factors.tolist()) if f)
    return [[sums(slopes[c, :, d]) for d in range(2)] for c in range(3)]


def coefficients(left: list[list[Any]], right: list[list[Any]]) -> Any:
    """Bernstein coefficients `(6, ...)` of the determinant of two maps, from the `corner_slopes` of each.

    The determinant takes the derivative in `l1` from the `left` map and the derivative in `l2` from the `right` one.
    """
    crossed = lambda a, b: left[a][0][0] * right[b][1][1] - left[a][0][1] * right[b][1][0]
    found = [crossed(a, a) for a in range(3)] + [(crossed(a, b) + crossed(b, a)) / 2 for a, b in EDGES]
    return array_module(found[0]).stack(found)


# ------------------------------------------------------------------------------------------------ records

_CORNERS = np.eye(3)
_MIDDLES = np.array([(_CORNERS[a] + _CORNERS[b]) / 2 for a, b in EDGES])
# The corners of the four triangles that result from cutting a triangle at the middles of its edges.
_FOUR = np.concatenate([_CORNERS, _MIDDLES])[np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])]

# `shortfall`: the change from three nodes to six is about the true error. From six-node triangles to smaller ones the
# change is smaller than the error, because of the infinite stress at the corners of the clamp.
QUADRATIC_TRIANGLE = Element(
    name="triangle",
    places=np.concatenate([_CORNERS, _MIDDLES]),
    edges=tuple((a, b, 3 + k) for k, (a, b) in enumerate(EDGES)),
    shape=_quadratic_shape,
    slopes=_quadratic_slopes,
    area=0.5,
    rules=RULES,
    degree=2,
    determinant=Determinant(corner_slopes, coefficients, basis, minimiser),
    children=_FOUR,
    enriched=None,
    shortfall=1.5,
    gains=(0.73, 0.1),
    spread=0.33,
)
TRIANGLE = Element(
    name="triangle",
    places=_CORNERS,
    edges=EDGES,
    shape=np.array,
    slopes=_linear_slopes,
    area=0.5,
    rules=RULES,
    degree=1,
    determinant=None,
    children=_FOUR,
    enriched=QUADRATIC_TRIANGLE,
    shortfall=1.0,
    gains=(0.0, 0.0),
    spread=0.12,
)
