"""The predictor: it extrapolates to the next equilibrium on a branch from the last few and their tangents.

It evaluates the polynomial that interpolates positions and slopes of these states: Hermite's interpolation, in
Lagrange's form (Stoer and Bulirsch 2002, section 2.1.5). With `q` states its error is of order `2 q` in the spacing;
that of the tangent is of order 2. On the ramp of the reference scene the error is 1e-7 of the body's length instead of
1e-2, and Newton's method takes one step instead of three.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

# Number of states that are stored.
STATES = 4

# Largest allowed difference between the polynomial's prediction and the tangent's, and between solution and prediction,
# over the length of the step. If it is larger the stored states are of no use: the branch turns, or the beam has
# snapped to another one.
TRUST = 0.25


class Trail(NamedTuple):
    """The last states on a branch, newest first.

    s: `(q,)` parameters.
    x: `(q, n, d)` positions; those of the newest state are always known.
    slope: `(q, n, d)` derivatives of the positions in `s`.
    depth: `()` int32, number of states, counted from the newest, that are known with their slope.
    """

    s: jax.Array
    x: jax.Array
    slope: jax.Array
    depth: jax.Array


def start_trail(x: jax.Array, slope: jax.Array | None = None) -> Trail:
    """A trail of one state, at `s = 0`.

    Args:
        x: `(n, d)` positions.
        slope: `(n, d)` their derivative in `s`, if known.
    """
    zeros = jnp.zeros((STATES, *x.shape), x.dtype)
    depth = jnp.asarray(slope is not None, jnp.int32)
    slopes = zeros if slope is None else zeros.at[0].set(slope)
    return Trail(jnp.zeros(STATES, x.dtype), zeros.at[0].set(x), slopes, depth)


def predict(trail: Trail, s: jax.Array) -> jax.Array:
    """Predicted displacement `(n, d)` from the newest state to the one at `s`; zero while no slope is known.

    The interpolating polynomial gives it, or the tangent if the two differ by more than `TRUST`.
    """
    known = jnp.arange(STATES, dtype=jnp.int32) < trail.depth
    other = known[:, None] & known & ~jnp.eye(STATES, dtype=bool)
    gap = jnp.where(other, trail.s[:, None] - trail.s, 1)
    lagrange_squared = jnp.prod(jnp.where(other, (s - trail.s) / gap, 1), axis=1) ** 2
    lagrange_slope = jnp.sum(jnp.where(other, 1 / gap, 0), axis=1)
    of_values = jnp.where(known, (1 - 2 * lagrange_slope * (s - trail.s)) * lagrange_squared, 0)
    of_slopes = jnp.where(known, (s - trail.s) * lagrange_squared, 0)
    tangent = jnp.where(trail.depth > 0, (s - trail.s[0]) * trail.slope[0], 0)
    polynomial = jnp.tensordot(of_values, trail.x - trail.x[0], 1) + jnp.tensordot(of_slopes, trail.slope, 1)
    return jnp.where(_close(polynomial, tangent, tangent), polynomial, tangent)


def extend(trail: Trail, s: jax.Array, x: jax.Array, slope: jax.Array, predicted: jax.Array, known: jax.Array) -> Trail:
    """The trail with a new state.

    Older states are dropped if the new one is far from where they predicted it, or if its slope is unknown.

    Args:
        trail: so far.
        s: `()` parameter of the new state.
        x: `(n, d)` its positions.
        slope: `(n, d)` their derivative in `s`.
        predicted: `(n, d)` the displacement from the newest state of `trail` that had been predicted.
        known: `()` whether the slope is known.
    """
    on_branch = known & _close(x - trail.x[0], predicted, predicted)
    push = lambda all, new: jnp.concatenate([new[None], all[:-1]])
    depth = jnp.where(on_branch, jnp.minimum(trail.depth + 1, STATES), known.astype(jnp.int32))
    return Trail(push(trail.s, s), push(trail.x, x), push(trail.slope, slope), depth)


def _close(a: jax.Array, b: jax.Array, length: jax.Array) -> jax.Array:
    """Whether two displacements `(n, d)` differ by at most `TRUST` times the length of a third."""
    return jnp.max(jnp.abs(a - b)) <= TRUST * jnp.max(jnp.abs(length))
