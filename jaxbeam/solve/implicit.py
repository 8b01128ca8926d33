"""The derivative of an equilibrium with respect to the scene, by the implicit function theorem.

At equilibrium the unbalanced forces vanish, `g(scene, x) = 0` on the free coordinates, so

    K dx = -dg

where `K = dg/dx` is the true tangent stiffness, not projected to be positive definite, and `dg` is the change of `g` by
the scene at fixed `x`. This takes one back-substitution with a factor of `K`. The iterations of the solver are not
differentiated, and the derivative does not depend on where they started. Both sides of the equation are functions of
the scene and of `x`, so JAX can differentiate them again: forward, reverse and to any order.

The derivative exists where `K` is not singular: at every stable solution, but not at a fold. A solution whose status is
not `OK` is not `trusted`. Its derivative is NaN, because zero could be mistaken for an answer. A loss that does not
depend on such a solution passes it a cotangent of exactly zero. For that the rule returns zero, so a failed member of a
batch does not spoil the derivatives of the others.
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
from jaxbeam.scene.evaluation import energy, stencil_hessians
from jaxbeam.scene.scene import Scene, places

Gradient = Callable[[Scene, jax.Array], jax.Array]


@lru_cache(maxsize=32)
def _solve(linear: LinearSolver) -> Callable[[Layout, Any, jax.Array], jax.Array]:
    """`linear.solve` with its own rule for `vmap`.

    Right-hand sides of one factor become columns of one solve. Those of many factors are solved one after the other,
    because batched triangular solves are slow.
    """
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
    """Gradient `(n, d)` at `x` of the energy expanded to second order about rest."""
    rest = scene.mesh.nodes
    force, change = jax.jvp(partial(energy_gradient, scene), (rest,), (x - rest,))
    return force + change


def attach_derivative(
    linear: LinearSolver, scene: Scene, layout: Layout, x: jax.Array, factor: Any, trusted: jax.Array
) -> jax.Array:
    """`x` itself, an equilibrium of the scene, with its derivative: see `attach_derivative_of_root`."""
    return attach_derivative_of_root(linear, energy_gradient, scene, layout, x, factor, trusted)


@partial(custom_derivative, static=2)
def attach_derivative_of_root(
    linear: LinearSolver,
    gradient: Gradient,
    scene: Scene,
    layout: Layout,
    x: jax.Array,
    factor: Any,
    trusted: jax.Array,
) -> jax.Array:
    """`x` itself, as the root of `gradient(scene, x) = 0` on free coordinates: its derivative keeps it a root.

    Args:
        linear: the linear solver.
        gradient: `energy_gradient`, or `linear_gradient` for the linear response.
        scene: with unlocked indices; differentiable in all its floats.
        layout: layout of the stiffness matrix.
        x: `(n, d)` the root. A tangent of `x` itself is ignored.
        factor: factor of `K = d gradient / dx` at `x`. With None the rule factorises the stiffness of the scene at `x`,
            which is the `K` of `energy_gradient` alone.
        trusted: `()` whether `x` is a root with positive definite `K`. If not, the derivative is NaN.
    """
    return x  # the derivative is in the rule below


@attach_derivative_of_root.defjvp
def _attach_derivative_jvp(
    linear: LinearSolver, gradient: Gradient, primals: Any, tangents: Any
) -> tuple[jax.Array, jax.Array]:
    scene, layout, found, factor, trusted = primals
    scene_dot = tangents[0]
    x = attach_derivative_of_root(linear, gradient, *primals)
    # The derivative of a failed solution is NaN. Keep it out of second derivatives that do not depend on `x`.
    at = jnp.where(trusted, x, found)
    if factor is None:
        factor, _ = linear.factor(layout, assemble(layout, stencil_hessians(*lax.stop_gradient((scene, found)))))
    factor = lax.stop_gradient(factor)

    def product(v: jax.Array) -> jax.Array:
        """The stiffness times a vector of unknowns `(N,)`."""
        return gather(layout, jax.jvp(lambda y: gradient(scene, y), (at,), (expand(layout, v, x.shape),))[1])

    def solve(_: Any, b: jax.Array) -> jax.Array:
        y = _solve(linear)(layout, factor, b)
        # NaN if not trusted, except for a zero right-hand side: that of a loss that does not depend on this solution.
        return jnp.where(trusted, y, jnp.where(jnp.all(b == 0), 0.0, jnp.nan).astype(y.dtype))

    # Held coordinates are at their places, and have the tangent of these.
    held_dot = jnp.where(scene.held, jax.jvp(places, (scene,), (scene_dot,))[1], 0)
    gradient_dot = jax.jvp(gradient, (scene, at), (scene_dot, held_dot))[1]
    free_dot = lax.custom_linear_solve(product, -gather(layout, gradient_dot), solve, symmetric=True)
    return x, expand(layout, free_dot, x.shape) + held_dot
