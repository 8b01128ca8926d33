"""Quadratic polynomials on a triangle in Bernstein form, and their smallest values.

A polynomial is `sum_i c_i B_i` with `B = (l0^2, l1^2, l2^2, 2 l0 l1, 2 l1 l2, 2 l2 l0)` in the barycentric coordinates
`l`. Its coefficients `(6, ...)` are the values at the corners, and one for each edge of `jaxbeam.elements.EDGES`. The
`B_i` are positive and sum to 1, so the polynomial is nowhere less than its smallest coefficient. Its smallest value may
be well above that. Source: Farin, "Curves and Surfaces for CAGD", 2002, chapter 17.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core.derivative import custom_derivative
from jaxbeam.mesh.elements import EDGES

# Two steps to the smallest ratio of two quadratics leave round-off if the second varies by less than the root of eps.
# Where it varies more, further ones follow; they converge superlinearly, and these do if it falls to a thousandth.
FURTHER = 8


def _namespace(c: Any) -> Any:
    """NumPy for its own arrays, so that a mesh is checked on the host, else `jax.numpy`."""
    return np if isinstance(c, np.ndarray) else jnp


def basis(place: Any) -> Any:
    """The values `(6, ...)` of `B` at a place `(3, ...)`."""
    xp = _namespace(place)
    return xp.stack([place[a] * place[a] for a in range(3)] + [2 * place[a] * place[b] for a, b in EDGES])


def value(c: Any, place: Any) -> Any:
    """The polynomial `(...)` with coefficients `c` `(6, ...)` at a place `(3, ...)`."""
    return (c * basis(place)).sum(axis=0)


def minimiser(c: Any) -> Any:
    """Where `(3, ...)` on the triangle the polynomial with coefficients `c` `(6, ...)` is smallest.

    That is where it is stationary inside, or along an edge, or at a corner. Differentiable wherever the place moves
    smoothly.
    """
    xp = _namespace(c)
    candidates = [_on_edge(c, 3 + k, a, b) for k, (a, b) in enumerate(EDGES)] + [_inside(c)]
    best, least = candidates[0], value(c, candidates[0])
    for place in candidates[1:]:
        here = value(c, place)
        lower = here < least
        best, least = xp.where(lower[None], place, best), xp.where(lower, here, least)
    return best


def _on_edge(c: Any, edge: int, a: int, b: int) -> Any:
    """Where it is smallest on the edge from corner `a` to `b`; `a` where it is not smallest in between."""
    xp = _namespace(c)
    at_a, at_b = c[a] - c[edge], c[b] - c[edge]
    between = (at_a > 0) & (at_b > 0)
    share = xp.where(between, at_a / xp.where(between, at_a + at_b, 1), 0)
    place = [xp.zeros_like(share)] * 3
    place[a], place[b] = 1 - share, share
    return xp.stack(place)


def _inside(c: Any) -> Any:
    """Where it is stationary; corner 0 if that is outside the triangle or not a minimum.

    With `y = (l1, l2)` it is `c0 + 2 g y + y D y`, so `D y = -g`, by Cramer's rule.
    """
    xp = _namespace(c)
    g1, g2, rise = c[3] - c[0], c[5] - c[0], c[4] - c[3]
    d11, d22, d12 = (c[1] - c[3]) - g1, (c[2] - c[5]) - g2, rise - g2
    determinant = d11 * d22 - d12 * d12
    y1, y2 = d12 * g2 - d22 * g1, d12 * g1 - d11 * g2
    inside = (determinant > 0) & (d11 > 0) & (y1 > 0) & (y2 > 0) & (y1 + y2 < determinant)
    y1, y2 = (xp.where(inside, y / xp.where(inside, determinant, 1), 0) for y in (y1, y2))
    return xp.stack([1 - y1 - y2, y1, y2])


@custom_derivative
def least_ratio(p: jax.Array, q: jax.Array) -> jax.Array:
    """The smallest `p / q` `(...)` on the triangle, of polynomials with coefficients `(6, ...)`, `q` positive on it.

    By Dinkelbach's method (1967, Management Science 13, 492-498): with `r` the ratio where `p - r q` is smallest, from
    `r = 0` on. From the first step on the ratio is negative just when `p` is so somewhere.
    """

    def step(_: int, ratio: jax.Array) -> jax.Array:
        place = minimiser(p - ratio[None] * q)
        return value(p, place) / value(q, place)

    ratio = step(1, step(0, jnp.zeros_like(p[0])))
    varies = jnp.any(jnp.ptp(q, axis=0) > jnp.finfo(q.dtype).eps ** 0.5 * q[0])
    return lax.cond(varies, lambda ratio: lax.fori_loop(0, FURTHER, step, ratio), lambda ratio: ratio, ratio)


@least_ratio.defjvp
def _(primals: tuple[jax.Array, ...], tangents: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
    """At the place where the ratio is smallest: the place moves too, but to first order that changes nothing."""
    (p, q), (dp, dq) = primals, tangents
    ratio = least_ratio(p, q)
    place = minimiser(p - ratio[None] * q)
    return ratio, value(dp - ratio[None] * dq, place) / value(q, place)
