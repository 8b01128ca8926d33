"""Where along a branch the next equilibrium lies, from the last few states on it and their tangents.

The polynomial that takes their positions and their slopes is continued: Hermite's interpolation, in Lagrange's form
(Stoer and Bulirsch 2002, section 2.1.5). With `q` states the error is of order `2 q` in the spacing, where the tangent
alone has order 2: on the ramp of the reference scene 1e-7 of the body's length instead of 1e-2, so that one Newton
step is left to take where there were three.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

# States that are remembered.
STATES = 4


# The most that a prediction may differ from the tangent's, and a solution from its prediction, over the length of the
# step: beyond it the states are no guide, because the branch turns or the beam has snapped to another one.
TRUST = 0.25


class Trail(NamedTuple):
    """The last states on a branch, newest first: parameters `s` `(q,)`, positions `x` `(q, n, 2)` and `slope`
    `(q, n, 2)`, their derivatives in `s`. The first `depth` `()` have a slope; the newest always has a position."""

    s: jax.Array
    x: jax.Array
    slope: jax.Array
    depth: jax.Array


def begin(x: jax.Array, slope: jax.Array | None = None) -> Trail:
    """The trail of one state `x` `(n, 2)` at `s = 0`, with its slope if that is known."""
    first = jnp.zeros((STATES, *x.shape), x.dtype)
    known = jnp.asarray(slope is not None, jnp.int32)
    slopes = first if slope is None else first.at[0].set(slope)
    return Trail(jnp.zeros(STATES, x.dtype), first.at[0].set(x), slopes, known)


def ahead(trail: Trail, s: jax.Array) -> jax.Array:
    """How far `(n, 2)` the state at `s` lies from the newest one; zero while no slope is known."""
    known = jnp.arange(STATES, dtype=jnp.int32) < trail.depth
    other = known[:, None] & known & ~jnp.eye(STATES, dtype=bool)
    gap = jnp.where(other, trail.s[:, None] - trail.s, 1)
    basis = jnp.prod(jnp.where(other, (s - trail.s) / gap, 1), axis=1) ** 2
    tilt = jnp.sum(jnp.where(other, 1 / gap, 0), axis=1)
    of_values = jnp.where(known, (1 - 2 * tilt * (s - trail.s)) * basis, 0)
    of_slopes = jnp.where(known, (s - trail.s) * basis, 0)
    straight = jnp.where(trail.depth > 0, (s - trail.s[0]) * trail.slope[0], 0)
    curved = jnp.tensordot(of_values, trail.x - trail.x[0], 1) + jnp.tensordot(of_slopes, trail.slope, 1)
    return jnp.where(_near(curved, straight, straight), curved, straight)


def extend(trail: Trail, s: jax.Array, x: jax.Array, slope: jax.Array, guess: jax.Array, known: jax.Array) -> Trail:
    """The trail with a new state. Older ones are forgotten where it does not lie where they led to, at `guess` from the
    newest one, and where its own slope is not `known`."""
    leads = known & _near(x - trail.x[0], guess, guess)
    push = lambda all, new: jnp.concatenate([new[None], all[:-1]])
    depth = jnp.where(leads, jnp.minimum(trail.depth + 1, STATES), known.astype(jnp.int32))
    return Trail(push(trail.s, s), push(trail.x, x), push(trail.slope, slope), depth)


def _near(a: jax.Array, b: jax.Array, length: jax.Array) -> jax.Array:
    """Whether two displacements differ by little, compared with a third."""
    return jnp.max(jnp.abs(a - b)) <= TRUST * jnp.max(jnp.abs(length))
