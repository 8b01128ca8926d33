"""The relative residual: how far the forces are from balance.

It is the largest unbalanced force on a free coordinate, divided by the *force scale*: the largest sum of the
magnitudes of the stencil forces that meet at a free coordinate. A change of units does not change it. A force smaller
than the round-off at its own coordinate counts as balanced.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from jaxbeam.scene.evaluation import Evaluation
from jaxbeam.scene.scene import Scene

# Round-off of the force at a coordinate, over `eps max|x|` times the sum of the magnitudes in its row of the stiffness.
# Measured: below 0.53 for triangles of three and six nodes, all materials and stiffnesses, and slender beams.
FORCE_ROUND_OFF = 0.75

# Assumed upper bound of the sum of the magnitudes in a row, over the largest diagonal entry. Measured: 2 to 4 on meshes
# of all kinds, up to 10 beside wide anchors.
LONGEST_ROW = 100.0


def force_scale(scene: Scene, evaluation: Evaluation) -> jax.Array:
    """The largest sum of the magnitudes of the stencil forces at one free coordinate, `()`."""
    return jnp.max(jnp.where(scene.held, 0, evaluation.gradient_scale))


def row_magnitudes(scene: Scene, hessians: list[jax.Array]) -> jax.Array:
    """For each coordinate, the sum of the magnitudes of the entries in its row of every stencil Hessian, `(n, d)`.

    It is at least the sum over the row of the assembled stiffness, where entries of several stencils may cancel.

    Args:
        scene: the scene to whose terms the Hessians belong.
        hessians: `(k d, k d, m)` stencil Hessians of each term.
    """
    n, d = scene.mesh.nodes.shape
    total = jnp.zeros((n, d), scene.mesh.nodes.dtype)
    for term, hessian in zip(scene.terms, hessians, strict=True):
        # Written as single additions, which take less time than the library call that XLA makes of `jnp.sum`.
        rows = functools.reduce(jnp.add, jnp.abs(hessian.swapaxes(0, 1))).reshape(-1, d, hessian.shape[-1])
        total = total.at[term.nodes].add(jnp.moveaxis(rows, -1, 0))
    return total


def rows_may_decide(unbalanced: jax.Array, allowed: jax.Array, largest: jax.Array, x: jax.Array) -> jax.Array:
    """Whether the round-off of forces may decide if a state counts as balanced, `()`.

    If not, `row_magnitudes` need not be computed.

    Args:
        unbalanced: `()` the largest unbalanced force.
        allowed: `()` the largest unbalanced force that is tolerated without any allowance for round-off.
        largest: `()` the largest diagonal entry of the stiffness.
        x: `(n, d)` positions.
    """
    return (unbalanced > allowed) & (unbalanced <= allowed + force_round_off(LONGEST_ROW * largest, x))


def force_round_off(rows: jax.Array, x: jax.Array) -> jax.Array:
    """Round-off of the force at each coordinate, `(n, d)`.

    Positions carry a relative error eps. Row `i` of the stiffness turns it into a force of up to
    `eps max|x| sum_j |K_ij|`, which no iteration can remove. This is local: a stiff tendon makes the forces on its own
    nodes uncertain, and no others.

    Args:
        rows: `(n, d)` from `row_magnitudes`.
        x: `(n, d)` positions.
    """
    return FORCE_ROUND_OFF * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x)) * rows


def relative_residual(scene: Scene, evaluation: Evaluation, round_off: jax.Array, rtol: float) -> jax.Array:
    """The largest relative residual of a free coordinate, `()`.

    Each unbalanced force is divided by the force scale plus `round_off / rtol`. The second term makes a force that is
    no larger than its round-off pass the test `residual <= rtol`.

    Args:
        scene: the scene to solve.
        evaluation: its energy and gradient.
        round_off: `(n, d)` from `force_round_off`.
        rtol: the relative residual to reach.
    """
    scale = force_scale(scene, evaluation) + round_off / rtol
    # A coordinate on which no force acts is in balance.
    return jnp.max(
        jnp.where(scene.held | (scale == 0), 0, jnp.abs(evaluation.gradient) / jnp.where(scale == 0, 1, scale))
    )
