"""Shape functions and quadrature of triangles with three nodes (P1) and with six (P2).

Nodes 0, 1 and 2 are the corners, counter-clockwise; nodes 3, 4 and 5 lie between corners (0, 1), (1, 2) and (2, 0).
Points are given by their barycentric coordinates `(l0, l1, l2)`.

Sources: shape functions, Zienkiewicz and Taylor, "The Finite Element Method", vol. 1, 2000, section 8.9; rules,
Strang and Fix (1973) and Dunavant, Int. J. Numer. Methods Eng. 21 (1985), 1129-1148.
"""

from __future__ import annotations

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


def shape_functions(nodes: int, points: np.ndarray) -> np.ndarray:
    """Values `(q, k)` of the `k` shape functions at barycentric points `(q, 3)`."""
    if nodes == 3:
        return np.array(points)
    corners = points * (2 * points - 1)
    between = [4 * points[:, a] * points[:, b] for a, b in EDGES]
    return np.concatenate([corners, np.stack(between, axis=1)], axis=1)


def shape_slopes(nodes: int, points: np.ndarray) -> np.ndarray:
    """Derivatives `(q, k, 2)` of the shape functions in `l1` and `l2`, with `l0 = 1 - l1 - l2`."""
    by_l = np.zeros((len(points), nodes, 3))
    for c in range(3):
        by_l[:, c, c] = 1 if nodes == 3 else 4 * points[:, c] - 1
    for k, (a, b) in enumerate(EDGES if nodes == 6 else ()):
        by_l[:, 3 + k, a], by_l[:, 3 + k, b] = 4 * points[:, b], 4 * points[:, a]
    return by_l[:, :, 1:] - by_l[:, :, :1]


# --------------------------------------------------------------------------- how the map of an element stretches area


def is_affine(nodes: int) -> bool:
    """Whether the map from the reference triangle to such an element has the same slopes, and so `J`, everywhere."""
    return nodes == 3


def corner_slopes(x: Any) -> list[list[Any]]:
    """Derivatives `(2, ...)` in `l1` and `l2`, at each corner, of the map with six nodes at `x` `(6, 2, ...)`.

    In between they are linear in the barycentric coordinates.
    """
    slopes = shape_slopes(6, np.eye(3))
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
