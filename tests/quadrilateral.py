"""Quadrilaterals of nine nodes (Q2).

Nodes 0 to 3 are the corners, counter-clockwise, nodes 4 to 7 lie between corners (0, 1), (1, 2), (2, 3) and (3, 0), and
node 8 is the centre. The reference element is the unit square with coordinates `(s, t)`. The weights of its corners are
`((1 - s)(1 - t), s (1 - t), s t, (1 - s) t)`.

Source: Zienkiewicz and Taylor, "The Finite Element Method", vol. 1, 2000, sections 8.6 and 9.8 (Gauss's rules).
"""

from __future__ import annotations

from typing import Any

import numpy as np

import jaxbeam as jb
from jaxbeam.mesh.bernstein import array_module
from jaxbeam.mesh.element import Determinant, Element

# Where the nodes are on the unit square.
_NODES = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0], [1, 0.5], [0.5, 1], [0, 0.5], [0.5, 0.5]])


def _weights(square: np.ndarray) -> np.ndarray:
    """Weights of the corners `(..., 4)` at points `(..., 2)` of the unit square."""
    s, t = np.moveaxis(square, -1, 0)
    return np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=-1)


def _square(place: Any) -> list[Any]:
    """`[s, t]` of a point `(4, ...)`."""
    return [place[1] + place[2], place[2] + place[3]]


def _along(xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic functions `(q, 3)` of one coordinate that are 1 at 0, 1/2 and 1 in turn, and their slopes."""
    return (
        np.stack([(1 - xi) * (1 - 2 * xi), 4 * xi * (1 - xi), xi * (2 * xi - 1)], axis=1),
        np.stack([4 * xi - 3, 4 - 8 * xi, 4 * xi - 1], axis=1),
    )


# The number of the function along each coordinate that makes a node's shape function.
_FACTORS = np.round(2 * _NODES).astype(int).T


def _shape(points: np.ndarray) -> np.ndarray:
    (s, _), (t, _) = (_along(xi) for xi in _square(points.T))
    return s[:, _FACTORS[0]] * t[:, _FACTORS[1]]


def _slopes(points: np.ndarray) -> np.ndarray:
    (s, ds), (t, dt) = (_along(xi) for xi in _square(points.T))
    i, j = _FACTORS
    return np.stack([ds[:, i] * t[:, j], s[:, i] * dt[:, j]], axis=-1)


def _rule(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss's rule with `count` points along each side."""
    xi, shares = np.polynomial.legendre.leggauss(count)
    s, t = np.meshgrid((1 + xi) / 2, (1 + xi) / 2, indexing="ij")
    return _weights(np.stack([s.ravel(), t.ravel()], axis=-1)), np.outer(shares, shares).ravel() / 4


# ----------------------------------------------------------------------------------- how the map stretches area

# The determinant is a cubic polynomial in `s` and in `t`. Its coefficients are those of products of Bernstein
# polynomials (Farin, "Curves and Surfaces for CAGD", 2002), found from its values at four points along each.
_BINOMIALS = (1.0, 3.0, 3.0, 1.0)


def _cubics(xi: Any) -> list[Any]:
    return [c * xi**k * (1 - xi) ** (3 - k) for k, c in enumerate(_BINOMIALS)]


_THIRDS = np.arange(4) / 3
_GRID = _weights(np.stack(np.meshgrid(_THIRDS, _THIRDS, indexing="ij"), axis=-1).reshape(-1, 2))
_FIT = np.linalg.inv(np.stack(_cubics(_THIRDS), axis=1))
_TO_COEFFICIENTS = np.einsum("ai,bj->abij", _FIT, _FIT).reshape(16, 16)
_AT_GRID = _slopes(_GRID)
_SAMPLES = _weights(np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 7)], indexing="ij"), axis=-1).reshape(-1, 2))


def _map_slopes(x: Any) -> Any:
    """Derivatives `(2, 16, 2, ...)` in `s` and `t` of the map with nodes `x` `(9, 2, ...)`, on the grid of 16."""
    xp = array_module(x)
    return xp.einsum("qkd,ki...->dqi...", xp.asarray(_AT_GRID, x.dtype), x)


def _coefficients(left: Any, right: Any) -> Any:
    xp = array_module(left)
    crossed = left[0][:, 0] * right[1][:, 1] - left[0][:, 1] * right[1][:, 0]
    return xp.einsum("bq,q...->b...", xp.asarray(_TO_COEFFICIENTS, crossed.dtype), crossed)


def _basis(place: Any) -> Any:
    s, t = (_cubics(xi) for xi in _square(place))
    return array_module(place).stack([a * b for a in s for b in t])


def _minimiser(c: Any) -> Any:
    """The least of 49 samples, and from there Newton's method on the square. It may miss a narrow minimum."""
    xp = array_module(c)
    values = xp.einsum("bq,b...->q...", xp.asarray(_basis(_SAMPLES.T), c.dtype), c)
    at = [xp.asarray(xi, c.dtype)[xp.argmin(values, axis=0)] for xi in _square(_SAMPLES.T)]
    grid = c.reshape(4, 4, *c.shape[1:])
    for _ in range(6):
        at = _newton_step(xp, grid, at)
    return xp.stack([(1 - at[0]) * (1 - at[1]), at[0] * (1 - at[1]), at[0] * at[1], (1 - at[0]) * at[1]])


def _newton_step(xp: Any, grid: Any, at: list[Any]) -> list[Any]:
    """One step of Newton's method towards the minimum of the polynomial with coefficients `(4, 4, ...)`."""
    values = [_cubics(xi) for xi in at]
    first = [[-3 * (1 - x) ** 2, 3 * (1 - x) * (1 - 3 * x), 3 * x * (2 - 3 * x), 3 * x**2] for x in at]
    second = [[6 * (1 - x), 18 * x - 12, 6 - 18 * x, 6 * x] for x in at]
    of = lambda a, b: sum(grid[i, j] * a[i] * b[j] for i in range(4) for j in range(4))
    g = [of(first[0], values[1]), of(values[0], first[1])]
    h = [of(second[0], values[1]), of(values[0], second[1])]
    both = of(first[0], first[1])
    # Held at a side that the gradient presses against.
    free = [((x > 0) | (slope < 0)) & ((x < 1) | (slope > 0)) for x, slope in zip(at, g, strict=True)]
    both = xp.where(free[0] & free[1], both, 0)
    h, g = ([xp.where(f, a, other) for f, a in zip(free, each, strict=True)] for each, other in ((h, 1), (g, 0)))
    determinant = h[0] * h[1] - both * both
    convex = (h[0] > 0) & (determinant > 0)
    determinant = xp.where(convex, determinant, 1)
    step = [(both * g[1] - h[1] * g[0]) / determinant, (both * g[0] - h[0] * g[1]) / determinant]
    return [xp.clip(x + xp.where(convex, d, 0), 0, 1) for x, d in zip(at, step, strict=True)]


_EDGES = ((0, 1, 4), (1, 2, 5), (2, 3, 6), (3, 0, 7))
_PLACES = _weights(_NODES)
_FOUR = _PLACES[np.array([[0, 4, 8, 7], [4, 1, 5, 8], [8, 5, 2, 6], [7, 8, 6, 3]])]

QUADRILATERAL = Element(
    name="quadrilateral",
    places=_PLACES,
    edges=_EDGES,
    shape=_shape,
    slopes=_slopes,
    area=1.0,
    rules={3: _rule(2), 5: _rule(3)},
    degree=5,
    determinant=Determinant(_map_slopes, _coefficients, _basis, _minimiser),
    children=_FOUR,
    enriched=None,
    shortfall=1.5,
    gains=(0.73, 0.1),
    spread=0.33,
)


def quadrilaterals(mesh: jb.Mesh) -> jb.Mesh:
    """A mesh of six-node triangles, two in each cell, as one of quadrilaterals with the same nodes."""
    lower, upper = np.asarray(mesh.elements)[::2].T, np.asarray(mesh.elements)[1::2].T
    corners, between = [lower[0], lower[1], lower[2], upper[2]], [lower[3], lower[4], upper[4], upper[5]]
    return jb.Mesh(np.asarray(mesh.nodes), np.stack([*corners, *between, lower[5]], axis=1))
