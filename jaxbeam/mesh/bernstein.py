"""Quadratic polynomials on a triangle in Bernstein form, and their smallest values.

A polynomial is `sum_i c_i B_i` with `B = (l0^2, l1^2, l2^2, 2 l0 l1, 2 l1 l2, 2 l2 l0)` in the barycentric coordinates
`l`. The first three of its coefficients `(6, ...)` are its values at the corners. The last three belong to the edges of
`EDGES`. The `B_i` are not negative and sum to 1, so the smallest coefficient is a lower bound of the polynomial. Its
smallest value may be well above that bound. Source: Farin, "Curves and Surfaces for CAGD", 2002, chapter 17.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

# The two corners of each edge of a triangle.
EDGES = ((0, 1), (1, 2), (2, 0))


def array_module(c: Any) -> Any:
    """NumPy if `c` is a NumPy array, so that a mesh is checked on the host; else `jax.numpy`."""
    return np if isinstance(c, np.ndarray) else jnp


def basis(place: Any) -> Any:
    """The values `(6, ...)` of `B` at points with barycentric coordinates `place` `(3, ...)`."""
    xp = array_module(place)
    return xp.stack([place[a] * place[a] for a in range(3)] + [2 * place[a] * place[b] for a, b in EDGES])


def minimiser(c: Any) -> Any:
    """The point `(3, ...)` of the triangle at which the polynomial with coefficients `c` `(6, ...)` is smallest.

    It is a stationary point inside, a stationary point along an edge, or a corner. Differentiable where the point moves
    smoothly with the coefficients.
    """
    xp = array_module(c)
    along, least = _on_edges(c)
    place, inside = _inside(c)
    lower = inside & ((c * basis(place)).sum(axis=0) < least)
    return xp.where(lower[None], place, along)


def _on_edges(c: Any) -> tuple[Any, Any]:
    """The point `(3, ...)` of the three edges at which the polynomial is smallest, and its value `(...)` there."""
    xp = array_module(c)
    # Of each edge: the coefficients of its first corner, of the edge itself and of its second corner.
    first, middle, second = c[:3], c[3:], xp.concatenate([c[1:3], c[:1]])
    fall, rise = first - middle, second - middle
    between = (fall > 0) & (rise > 0)
    # Share of the edge from its first corner to the point; 0 if the polynomial is smallest at an end of the edge.
    share = xp.where(between, fall / xp.where(between, fall + rise, 1), 0)
    values = first * (1 - share) ** 2 + 2 * middle * share * (1 - share) + second * share**2
    number = xp.arange(3).reshape(3, *[1] * (c.ndim - 1))
    best = number == xp.argmin(values, axis=0)[None]
    share = xp.where(best, share, 0).sum(axis=0)[None]
    after = xp.concatenate([best[2:], best[:2]])
    return xp.where(best, 1 - share, xp.where(after, share, 0)), values.min(axis=0)


def _inside(c: Any) -> tuple[Any, Any]:
    """The stationary point `(3, ...)` of the polynomial, and whether it is a minimum inside the triangle `(...)`.

    With `y = (l1, l2)` the polynomial is `c0 + 2 g y + y D y`. Cramer's rule solves `D y = -g`. Where there is no such
    minimum the point is corner 0.
    """
    xp = array_module(c)
    g1, g2, rise = c[3] - c[0], c[5] - c[0], c[4] - c[3]
    d11, d22, d12 = (c[1] - c[3]) - g1, (c[2] - c[5]) - g2, rise - g2
    determinant = d11 * d22 - d12 * d12
    y1, y2 = d12 * g2 - d22 * g1, d12 * g1 - d11 * g2
    inside = (determinant > 0) & (d11 > 0) & (y1 > 0) & (y2 > 0) & (y1 + y2 < determinant)
    y1, y2 = (xp.where(inside, y / xp.where(inside, determinant, 1), 0) for y in (y1, y2))
    return xp.stack([1 - y1 - y2, y1, y2]), inside
