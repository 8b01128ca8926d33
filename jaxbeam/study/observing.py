"""What a design predicts for many observations: the measures of their equilibria, and exact derivatives by parameters.

Observations are solved in blocks, by one compiled program whatever their number. Each is approached from a state that
is known, and one Newton solve is enough if the parameters have changed a little. The Jacobian comes from the factor of
that solve, forward or in reverse, whichever needs fewer back-substitutions.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core.compiling import compiled
from jaxbeam.core.tree import unlock
from jaxbeam.linear.layout import Layout, expand, gather
from jaxbeam.scene.scene import Scene, command
from jaxbeam.solve.actuation import from_neighbour
from jaxbeam.solve.equilibrium import solve_from
from jaxbeam.solve.implicit import attach_derivative, energy_gradient
from jaxbeam.solve.newton import Newton, topology
from jaxbeam.study.expansion import Measure

# Observations in a block: enough that calling the program costs little, few enough that all cores get some.
BLOCK = 8

Design = Callable[[Any], Scene]


class Predicted(NamedTuple):
    """What is predicted for `N` observations of `p` components, by `q` parameters.

    x: `(N, n, d)` equilibria.
    values: `(N, p)` measures.
    slopes: `(N, p, q)` their derivatives; NaN where the status is not `OK`.
    status: `(N,)` of the equilibria.
    """

    x: Any
    values: Any
    slopes: Any
    status: Any


class Model(NamedTuple):
    """A design with flat parameters.

    design: `theta` to a scene.
    unravel: from `(q,)` to `theta`.
    solver: settings of each solve.
    layout: of the stiffness.
    """

    design: Design
    unravel: Callable[[jax.Array], Any]
    solver: Newton
    layout: Layout

    def scene(self, flat: Any) -> Scene:
        """The scene of parameters `(q,)`."""
        return self.design(self.unravel(flat))


def model_of(design: Design, unravel: Callable[[jax.Array], Any], flat: Any, solver: Newton) -> Model:
    """The model of a design around parameters `flat` `(q,)`."""
    return Model(design, unravel, solver, solver.linear.layout(topology(design(unravel(flat)))))


def predict_all(
    model: Model,
    flat: np.ndarray,
    commands: np.ndarray,
    x: Any,
    measure: Measure,
) -> Predicted:
    """What is predicted by parameters `flat` `(q,)` under commands `(N, m)`, on all cores.

    Args:
        model: the design.
        flat: parameters.
        commands: one row for each observation.
        x: `(N, n, d)` states to start from, such as those of nearby parameters.
        measure: `(scene, x)` to `()` or `(p,)`.
    """
    count, starts = len(commands), np.asarray(x)
    blocks = [np.minimum(np.arange(k, k + BLOCK), count - 1) for k in range(0, count, BLOCK)]
    theta = jnp.asarray(flat, starts.dtype)

    def solve(block: np.ndarray) -> Predicted:
        found = _solve_block(
            model.layout, theta, commands[block], starts[block], model.design, model.unravel, measure, model.solver
        )
        return jax.device_get(found)

    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        # The first block compiles the program: otherwise each thread would.
        found = [solve(blocks[0]), *pool.map(solve, blocks[1:])]
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *found)


@compiled("design", "unravel", "measure", "solver")
def _solve_block(
    layout: Layout,
    flat: jax.Array,
    commands: jax.Array,
    x: jax.Array,
    design: Design,
    unravel: Callable[[jax.Array], Any],
    measure: Measure,
    solver: Newton,
) -> Predicted:
    """What is predicted for one block of observations."""

    def one(row_and_start: tuple[jax.Array, jax.Array]) -> Predicted:
        row, start = row_and_start
        scene = unlock(command(design(unravel(flat)), row))
        solution, factor = solve_from(from_neighbour(row, start, jnp.zeros_like(start)), scene, layout, solver)
        good = solution.status == 0
        # One step more, with the factor that is there: else a search ends in what the solver leaves of the forces.
        left = gather(layout, energy_gradient(scene, solution.x))
        nearer = solution.x - expand(layout, solver.linear.solve(layout, factor, left), solution.x.shape)
        found = jnp.where(good, nearer, solution.x)

        def outcome(flat: jax.Array) -> jax.Array:
            moved = command(design(unravel(flat)), row)
            x = attach_derivative(solver.linear, unlock(moved), layout, found, factor, good)
            return jnp.ravel(measure(moved, x))

        values = outcome(flat)
        slopes = (jax.jacfwd if len(flat) <= len(values) else jax.jacrev)(outcome)(flat)
        return Predicted(found, values, slopes, solution.status)

    return lax.map(one, (commands, x))
