"""A measure as a function of the commands, to second order, at an equilibrium that was solved.

With the positions `x(theta)` in balance, `g(theta, x) = 0`, and `K` the tangent stiffness, whose factor is at hand:

    drift   dx/dtheta = -K^-1 dg/dtheta
    slope   dq/dtheta along (1, drift)
    bend    second derivative along (1, drift) of  q + price . g,  with  price = -K^-1 dq/dx

The last is the adjoint formula for second derivatives (Nocedal and Wright 2006, section 12.5): with this price the
second derivative of `x` itself drops out. All takes one solve with as many right-hand sides as there are commands and
components of the measure.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxbeam.core.compiling import compiled
from jaxbeam.linear.layout import Layout, LinearSolver, expand, gather
from jaxbeam.scene.scene import Scene, command
from jaxbeam.solve.implicit import energy_gradient

Measure = Callable[[Scene, jax.Array], jax.Array]


class Expansion(NamedTuple):
    """A measure around a command: `value` `(p,)`, `slope` `(p, m)`, `bend` `(p, m, m)`; and `drift` `(n, 2, m)`, the
    derivative of the positions."""

    value: Any
    slope: Any
    bend: Any
    drift: Any


@compiled("measure", "linear")
def expand_measure(
    scene: Scene, layout: Layout, theta: jax.Array, x: jax.Array, factor: Any, measure: Measure, linear: LinearSolver
) -> Expansion:
    """The measure around the commands `theta` `(m,)`, in equilibrium at `x` `(n, 2)` with this `factor` of the
    stiffness. It means nothing where `x` is no equilibrium, except for the value."""
    m = theta.size
    outcome = lambda theta, x: jnp.ravel(measure(command(scene, theta), x))
    unbalanced = lambda theta, x: energy_gradient(command(scene, theta), x)

    pull = jax.jacfwd(unbalanced)(theta, x)
    sight = jnp.moveaxis(jax.jacrev(outcome, argnums=1)(theta, x), 0, -1)
    columns = partial(jax.vmap, in_axes=-1, out_axes=-1)
    rhs = columns(partial(gather, layout))(jnp.concatenate([pull, sight], axis=-1))
    moved = columns(lambda v: expand(layout, v, x.shape))(-linear.solve(layout, factor, rhs))
    drift, price = moved[..., :m], moved[..., m:]

    def along(step: jax.Array) -> jax.Array:
        return outcome(theta + step, x + drift @ step)

    def lagrangian(step: jax.Array) -> jax.Array:
        force = unbalanced(theta + step, x + drift @ step)
        return along(step) + jnp.tensordot(price, force, axes=((0, 1), (0, 1)))

    zero = jnp.zeros_like(theta)
    return Expansion(outcome(theta, x), jax.jacfwd(along)(zero), jax.jacfwd(jax.jacfwd(lagrangian))(zero), drift)
