"""Second-order expansion of a measure in the commands, at a solved equilibrium.

The positions `x(theta)` are in balance, `g(theta, x) = 0`, and a factor of the tangent stiffness `K` is known from the
solve. For a measure `q(theta, x)`,

    drift   dx/dtheta = -K^-1 dg/dtheta
    slope   derivative of  q  along (1, drift)
    bend    second derivative along (1, drift) of  q + price . g,  with multipliers  price = -K^-1 dq/dx

`bend` is the adjoint formula for second derivatives (Nocedal and Wright 2006, section 12.5): with these multipliers the
second derivative of `x` drops out. The expansion takes one solve, with a right-hand side for each command and for each
component of the measure.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxbeam.core.compiling import compiled
from jaxbeam.linear.layout import Layout, LinearSolver, expand, gather
from jaxbeam.scene.scene import Scene, at_places, command, has_supports
from jaxbeam.solve.implicit import energy_gradient

Measure = Callable[[Scene, jax.Array], jax.Array]


class Expansion(NamedTuple):
    """A measure of `p` components around `m` commands.

    value: `(p,)` of the measure.
    slope: `(p, m)` first derivatives in the commands.
    bend: `(p, m, m)` second derivatives in the commands.
    drift: `(n, 2, m)` derivative of the positions in the commands.
    """

    value: Any
    slope: Any
    bend: Any
    drift: Any


@compiled("measure", "linear")
def expand_measure(
    scene: Scene, layout: Layout, theta: jax.Array, x: jax.Array, factor: Any, measure: Measure, linear: LinearSolver
) -> Expansion:
    """The measure around the commands `theta`. If `x` is not an equilibrium, only `value` is meaningful.

    Args:
        scene: under any commands.
        layout: of its stiffness.
        theta: `(m,)` commands.
        x: `(n, 2)` their equilibrium.
        factor: of the stiffness there.
        measure: `(scene, x)` to `()` or `(p,)`.
        linear: the linear solver that made the factor.
    """
    m = theta.size
    placed = lambda theta, x: at_places(command(scene, theta), x)
    outcome = lambda theta, x: jnp.ravel(measure(command(scene, theta), placed(theta, x)))
    unbalanced = lambda theta, x: energy_gradient(command(scene, theta), placed(theta, x))

    dg_dtheta = jax.jacfwd(unbalanced)(theta, x)
    dq_dx = jnp.moveaxis(jax.jacrev(outcome, argnums=1)(theta, x), 0, -1)
    columns = partial(jax.vmap, in_axes=-1, out_axes=-1)
    rhs = columns(partial(gather, layout))(jnp.concatenate([dg_dtheta, dq_dx], axis=-1))
    moved = columns(lambda v: expand(layout, v, x.shape))(-linear.solve(layout, factor, rhs))
    drift, price = moved[..., :m], moved[..., m:]
    if has_supports(scene):
        drift += jax.jacfwd(placed)(theta, x)

    def along(step: jax.Array) -> jax.Array:
        return outcome(theta + step, x + drift @ step)

    def lagrangian(step: jax.Array) -> jax.Array:
        force = unbalanced(theta + step, x + drift @ step)
        return along(step) + jnp.tensordot(price, force, axes=((0, 1), (0, 1)))

    zero = jnp.zeros_like(theta)
    return Expansion(outcome(theta, x), jax.jacfwd(along)(zero), jax.jacfwd(jax.jacfwd(lagrangian))(zero), drift)
