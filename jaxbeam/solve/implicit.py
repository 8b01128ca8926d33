"""The derivative through equilibrium: how a solution moves when the scene changes.

At equilibrium the unbalanced forces vanish, `g(scene, x) = 0` on the free coordinates, so

    K dx = -dg        K = dg/dx, the true (unprojected) tangent stiffness,

by the implicit function theorem: one back-substitution with a factor of `K`. The solve itself is not
differentiated, and where it started does not matter. Both sides of the equation are written as functions of the
scene and of `x`, so JAX can differentiate them again: forward, reverse and to any order.

The derivative exists where `K` is not singular, which a stable solution guarantees and a fold denies. Where the
status of the solution is not `OK` it is NaN: not zero, which would pass for an answer. A member of a batch that
the loss does not look at (its cotangent is exactly zero) harms no other.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxbeam.core.derivative import custom_derivative
from jaxbeam.linear.layout import Layout, LinearSolver, assemble, expand, gather
from jaxbeam.scene.scene import Scene, energy, stencil_hessians

Gradient = Callable[[Scene, jax.Array], jax.Array]


@lru_cache(maxsize=32)
def _solve(linear: LinearSolver) -> Callable[[Layout, Any, jax.Array], jax.Array]:
    """`linear.solve` that stays fast under `vmap`: right-hand sides of one factor become the columns of one, and those
    of many factors are solved in turn, for batched triangular solves are slow."""
    solve = jax.custom_batching.custom_vmap(linear.solve)

    @solve.def_vmap
    def _(size: int, batched: Any, layout: Layout, factor: Any, rhs: jax.Array) -> tuple[jax.Array, bool]:
        if not any(jax.tree.leaves(batched[:2])) and rhs.ndim == 2:
            return linear.solve(layout, factor, rhs.T).T, True
        each = lambda leaf, many: leaf if many else jnp.broadcast_to(leaf, (size, *leaf.shape))
        lanes = jax.tree.map(each, (layout, factor, rhs), tuple(batched))
        return lax.map(lambda lane: solve(*lane), lanes), True

    return solve


energy_gradient = jax.grad(energy, argnums=1)


def linear_gradient(scene: Scene, x: jax.Array) -> jax.Array:
    """Gradient `(n, 2)` at `x` of the energy expanded to second order about rest."""
    rest = scene.mesh.nodes
    force, change = jax.jvp(partial(energy_gradient, scene), (rest,), (x - rest,))
    return force + change


def follow_scene(
    linear: LinearSolver, scene: Scene, layout: Layout, x: jax.Array, factor: Any, trusted: jax.Array
) -> jax.Array:
    """`x` `(n, 2)` itself, which moves with the scene as its equilibrium does.

    Args:
        linear: the linear solver.
        scene: with unlocked indices; differentiable in all its floats.
        layout: of its matrix.
        x: an equilibrium of the scene. Its own tangent is ignored.
        factor: of the true stiffness at `x`; None to make one if it is asked for.
        trusted: `()` whether `x` is an equilibrium with a definite stiffness.
    """
    return follow_zero(linear, energy_gradient, scene, layout, x, factor, trusted)


@partial(custom_derivative, static=2)
def follow_zero(
    linear: LinearSolver,
    gradient: Gradient,
    scene: Scene,
    layout: Layout,
    x: jax.Array,
    factor: Any,
    trusted: jax.Array,
) -> jax.Array:
    """`x` `(n, 2)` itself, which moves with the scene so that `gradient(scene, x)` stays zero where it is free.

    `gradient` is `energy_gradient` or `linear_gradient`; otherwise as `follow_scene`. `factor` is that of its
    derivative by `x`, and None only for the first.
    """
    return x


@follow_zero.defjvp
def _follow_zero_jvp(
    linear: LinearSolver, gradient: Gradient, primals: Any, tangents: Any
) -> tuple[jax.Array, jax.Array]:
    scene, layout, found, factor, trusted = primals
    scene_dot = tangents[0]
    x = follow_zero(linear, gradient, *primals)
    # The slope of a bad solution is NaN: kept out of second derivatives that do not look at it.
    at = jnp.where(trusted, x, found)
    if factor is None:
        factor, _ = linear.factor(layout, assemble(layout, stencil_hessians(*lax.stop_gradient((scene, found)))))
    factor = lax.stop_gradient(factor)

    def product(v: jax.Array) -> jax.Array:
        """The stiffness times a vector of unknowns."""
        return gather(layout, jax.jvp(lambda y: gradient(scene, y), (at,), (expand(layout, v, x.shape),))[1])

    def solve(_: Any, b: jax.Array) -> jax.Array:
        y = _solve(linear)(layout, factor, b)
        return jnp.where(trusted, y, jnp.where(jnp.all(b == 0), 0.0, jnp.nan).astype(y.dtype))

    # Fixed coordinates are at rest, and move with the rest positions.
    carried = jnp.where(scene.fixed, scene_dot.mesh.nodes, 0)
    pull = jax.jvp(gradient, (scene, at), (scene_dot, carried))[1]
    moved = lax.custom_linear_solve(product, -gather(layout, pull), solve, symmetric=True)
    return x, expand(layout, moved, x.shape) + carried
