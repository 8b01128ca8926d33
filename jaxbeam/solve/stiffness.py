"""The tangent stiffness as Newton's method uses it: a positive definite Cholesky factor.

The factor of the true Hessian is used whenever it exists. Otherwise the Hessian is blended with a projected one
(`jaxbeam.physics.projection`) or its diagonal is shifted, by about as little as makes it positive definite. To project
always would make convergence linear, and a fully projected Hessian is far too stiff along the soft modes of a snap.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core.compiling import compute_if, zeros_like_result
from jaxbeam.linear.layout import Layout, LinearSolver, assemble, gather
from jaxbeam.scene.evaluation import stencil_hessians
from jaxbeam.scene.scene import Scene
from jaxbeam.solve.residual import row_magnitudes, rows_may_decide

# Pivots of a singular stiffness come out at 0.1 to 2.8 eps sqrt(N) times the diagonal on bodies that float free, and at
# 2.7 and more on slender beams in float32. The sign of a pivot below this many eps sqrt(N) is unknown.
PIVOT_ROUND_OFF = 2.0

# The sign of an eigenvalue is unknown if it is below this many eps times the largest diagonal entry.
SINGULAR = 2.0

# Far from the origin the rounding of positions strains stiff elements, and the tension in these stiffens or softens the
# body across them. So the sign of an eigenvalue is unknown too if it is below this many `eps max|x| / size` times the
# largest diagonal entry. Measured on rods and beams in float32, up to 3,000 lengths from the origin, in units of
# `eps max|x| / size` times the longest row, which in rods is 3 times that entry: every state more than 2e-3 of the body
# from its equilibrium was below 0.1, and every state above 0.3 was within 1.1e-3.
FAR = 0.4

# If the lowest eigenvalue of a matrix is `t` times its largest diagonal entry, a pivot is less than 1,800 sqrt(t)
# times that entry. Measured with the longest row, of 2 to 3 times the entry, for `t` from 1e-15 to 1e-3, on beams and
# rods held in five ways, also with elements a million times softer than others. So the lowest eigenvalue is computed
# only if the smallest pivot is less than this many sqrt(t) times the entry.
SOFT_PIVOT = 1e4

# Share of the projected Hessian in the first blend. It is tripled until it is one. Then shifts are added, each ten
# times the one before. `MAX_BLENDS` of these modifications are tried.
FIRST_SHARE = 0.01
MAX_BLENDS = 16

# Near a bifurcation the negative eigenvalue is tiny, and even the first blend would be thousands of times as stiff. So
# when leaving a saddle this many shifts are tried before any blend, each ten times the one before. They go from ten
# times the round-off of a pivot to about a millionth of the stiffness, where the lowest eigenvalues of a beam lie.
GENTLE_SHIFTS = 8


class Stiffness(NamedTuple):
    """The tangent stiffness, factorised.

    factor: positive definite Cholesky factor: of the true Hessian if `definite`, else of a modified one.
    definite: `()` whether the true Hessian is positive definite.
    marginal: `()` whether round-off of the factor decided `definite`, so that stability is unknown.
    near_zero: `()` whether the true Hessian is not positive definite, but becomes so when its diagonal is shifted by
        round-off or by `far_share`.
    pivot: `()` the smallest pivot of the factor.
    largest: `()` the largest magnitude on the diagonal of the true Hessian.
    rows: `(n, d)` sums of magnitudes in each row, from `row_magnitudes`; zero if they are not needed (see
        `rows_may_decide`).
    """

    factor: Any
    definite: jax.Array
    marginal: jax.Array
    near_zero: jax.Array
    pivot: jax.Array
    largest: jax.Array
    rows: jax.Array


def zero_factor(layout: Layout, dtype: Any, linear: LinearSolver) -> Any:
    """A factor of zeros, the initial value of a loop."""
    storage = jax.ShapeDtypeStruct(layout.empty.shape, dtype)
    return zeros_like_result(linear.factor, layout, storage)[0]


def largest_diagonal(layout: Layout, storage: jax.Array) -> jax.Array:
    """The largest magnitude on the diagonal of a matrix, without its padding, `()`."""
    unknown = layout.slots < layout.position.size
    return jnp.max(jnp.where(unknown, jnp.abs(storage[layout.diagonal]), 0))


@partial(jax.jit, static_argnames="linear")
def factorise(
    scene: Scene,
    layout: Layout,
    x: jax.Array,
    size: jax.Array,
    unbalanced: jax.Array,
    allowed: jax.Array,
    leaving_saddle: jax.Array,
    linear: LinearSolver,
) -> Stiffness:
    """The stiffness at `x`, with a positive definite factor.

    The matrices tried are, in this order: the true Hessian; the true Hessian shifted by round-off, or far from the
    origin by `far_share`; when leaving a saddle, the true Hessian with larger shifts; blends with the projected
    Hessian, with a growing share; the projected Hessian, shifted.

    Args:
        scene: the scene to solve.
        layout: layout of the matrix.
        x: `(n, d)` positions.
        size: `()` size of the body.
        unbalanced: `()` the largest unbalanced force at `x`. If it is not finite, only one factorisation is tried.
        allowed: `()` the largest unbalanced force that is tolerated without any allowance for round-off.
        leaving_saddle: `()` whether shifts are tried before projections.
        linear: the linear solver.
    """
    hessians = stencil_hessians(scene, x)
    storage = assemble(layout, hessians)
    diagonal, largest = storage[layout.diagonal], largest_diagonal(layout, storage)
    round_off = float(jnp.finfo(storage.dtype).eps) * layout.slots.size**0.5
    unknown = jnp.maximum(round_off, far_share(x, size))
    finite = jnp.isfinite(unbalanced) & jnp.isfinite(largest)
    projected_at = lambda x: assemble(layout, stencil_hessians(scene, x, convex=True))
    first_blend = jnp.where(leaving_saddle, 2 + GENTLE_SHIFTS, 2)

    def attempt(carry: Any) -> Any:
        tries, _, _, projected = carry
        projected = compute_if(tries == first_blend, projected_at, projected, x)
        share, shift = _modification(tries, first_blend, round_off, unknown)
        matrix = ((1 - share) * storage + share * projected).at[layout.diagonal].add(shift * largest)
        factor, done = linear.factor(layout, matrix)
        return tries + 1, factor, done, projected

    begin = (jnp.zeros((), jnp.int32), zero_factor(layout, storage.dtype, linear), ~finite, jnp.zeros_like(storage))
    going = lambda c: (c[0] == 0) | (~c[2] & finite & (c[0] < first_blend + MAX_BLENDS))
    tries, factor, done, _ = lax.while_loop(going, attempt, begin)
    pivots = jnp.where(layout.slots < layout.position.size, linear.pivots(layout, factor), jnp.inf)
    small = jnp.min(pivots / diagonal) <= PIVOT_ROUND_OFF * round_off
    near_zero = done & (tries == 2)
    marginal = (near_zero & (unknown <= round_off)) | (done & (tries == 1) & small)
    rows = compute_if(
        rows_may_decide(unbalanced, allowed, largest, x), partial(row_magnitudes, scene), jnp.zeros_like(x), hessians
    )
    return Stiffness(factor, done & (tries == 1), marginal, near_zero, jnp.min(pivots), largest, rows)


def far_share(x: jax.Array, size: jax.Array) -> jax.Array:
    """Bound of eigenvalues whose sign is unknown because the body is far from the origin (see `FAR`).

    It is given as a share `()` of the largest diagonal entry.

    Args:
        x: `(n, d)` positions.
        size: `()` size of the body.
    """
    return FAR * float(jnp.finfo(x.dtype).eps) * jnp.max(jnp.abs(x)) / size


def is_singular(
    scene: Scene, layout: Layout, x: jax.Array, size: jax.Array, stiffness: Stiffness, linear: LinearSolver
) -> jax.Array:
    """Whether the sign of the lowest eigenvalue of a stiffness is unknown, `()`: by round-off or by `far_share`.

    Args:
        scene: the scene of the stiffness.
        layout: layout of the matrix.
        x: `(n, d)` positions.
        size: `()` size of the body.
        stiffness: stiffness at `x`.
        linear: the linear solver.
    """
    signs = jnp.asarray(np.random.default_rng(1).choice([-1.0, 1.0], x.shape), x.dtype)
    load = gather(layout, jnp.where(scene.held, 0, signs))

    def softest(factor: Any) -> jax.Array:
        """Rayleigh quotient of one inverse iteration: near a limit of stability it is the lowest eigenvalue."""
        move = linear.solve(layout, factor, load)
        return jnp.sum(load * move) / jnp.sum(move**2)

    share = jnp.maximum(SINGULAR * float(jnp.finfo(x.dtype).eps), far_share(x, size))
    largest = stiffness.largest
    soft = stiffness.definite & (stiffness.pivot <= SOFT_PIVOT * jnp.sqrt(share) * largest)
    lowest = compute_if(soft, softest, jnp.asarray(jnp.inf, x.dtype), stiffness.factor)
    return stiffness.near_zero | (lowest <= share * largest)


def _modification(
    tries: jax.Array, first_blend: jax.Array, round_off: float, unknown: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """How the matrix is modified after `tries` `()` failed factorisations (order as in `factorise`).

    Args:
        tries: `()` number of failed factorisations.
        first_blend: `()` number of failed factorisations before the first blend.
        round_off: round-off of a pivot, over the diagonal entry.
        unknown: `()` the first shift, over the largest diagonal entry.

    Returns:
        The share `()` of the projected Hessian, and the shift `()` of the diagonal over its largest entry.
    """
    blends = (tries - first_blend).astype(unknown.dtype)
    share = jnp.where(blends >= 0, jnp.minimum(1.0, FIRST_SHARE * 3.0**blends), 0.0)
    gentle = jnp.maximum(unknown, round_off * 10.0 ** (tries - 1).astype(unknown.dtype))
    gentle = jnp.where(tries > 0, gentle, 0.0)
    return share, jnp.where(blends < 0, gentle, jnp.where(share < 1, 0.0, 10.0 ** (blends - MAX_BLENDS)))
