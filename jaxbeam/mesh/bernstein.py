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
    value = lambda place: (c * basis(place)).sum(axis=0)
    candidates = [_on_edge(c, 3 + k, a, b) for k, (a, b) in enumerate(EDGES)] + [_inside(c)]
    best, least = candidates[0], value(candidates[0])
    for place in candidates[1:]:
        here = value(place)
        lower = here < least
        best, least = xp.where(lower[None], place, best), xp.where(lower, here, least)
    return best


def _on_edge(c: Any, edge: int, a: int, b: int) -> Any:
    """The point between corners `a` and `b` at which the polynomial is smallest on their edge.

    Corner `a` if the polynomial is smallest at an end of the edge.
    """
    xp = array_module(c)
    at_a, at_b = c[a] - c[edge], c[b] - c[edge]
    between = (at_a > 0) & (at_b > 0)
    share = xp.where(between, at_a / xp.where(between, at_a + at_b, 1), 0)
    place = [xp.zeros_like(share)] * 3
    place[a], place[b] = 1 - share, share
    return xp.stack(place)


def _inside(c: Any) -> Any:
    """The stationary point of the polynomial; corner 0 if that point is outside the triangle or not a minimum.

    With `y = (l1, l2)` the polynomial is `c0 + 2 g y + y D y`. Cramer's rule solves `D y = -g`.
    """
    xp = array_module(c)
    g1, g2, rise = c[3] - c[0], c[5] - c[0], c[4] - c[3]
    d11, d22, d12 = (c[1] - c[3]) - g1, (c[2] - c[5]) - g2, rise - g2
    determinant = d11 * d22 - d12 * d12
    y1, y2 = d12 * g2 - d22 * g1, d12 * g1 - d11 * g2
    inside = (determinant > 0) & (d11 > 0) & (y1 > 0) & (y2 > 0) & (y1 + y2 < determinant)
    y1, y2 = (xp.where(inside, y / xp.where(inside, determinant, 1), 0) for y in (y1, y2))
    return xp.stack([1 - y1 - y2, y1, y2])
