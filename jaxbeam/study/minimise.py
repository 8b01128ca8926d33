"""Inverse design by any loss of any scene that is a function of parameters, with any optax optimiser."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.scene.scene import Scene
from jaxbeam.scene.supports import check_held
from jaxbeam.solve.equilibrium import equilibrium
from jaxbeam.solve.newton import Newton, check_scene_and_solver
from jaxbeam.solve.solution import Solution
from jaxbeam.study.design import Design, DesignStatus
from jaxbeam.study.search import History

# --------------------------------------------------------------------------------------------- minimise

# Steps in a row that may be taken back because there is no equilibrium where they lead.
MAX_SKIPS = 20


@usual_rules
def minimise(
    loss: Callable[[Scene, jax.Array], jax.Array],
    theta0: Any,
    optimiser: optax.GradientTransformation,
    steps: int = 200,
    *,
    design: Callable[[Any], Scene],
    tolerance: float = 1e-8,
    goal: float | None = None,
    solver: Newton = Newton(),
    progress: Callable[[int, float], None] | None = None,
) -> Design:
    """Parameters that make a loss of the equilibrium least, by any optimiser of optax.

    Each equilibrium is started from the one before. Where the status of one is not `OK` the step that led there is
    halved, back towards the last good parameters, and the optimiser does not see it. Parameters are not bounded:
    let `design` map them to what is, for example `ratios = 0.4 + 0.6 * jax.nn.sigmoid(theta)`.

    Args:
        loss: `(scene, x)` to `()`.
        theta0: any pytree of float arrays.
        optimiser: such as `optax.adam(1e-2)` or `optax.lbfgs()`, whose line search solves equilibria of its own.
        steps: at most so many.
        design: `theta` to a scene: commands, moduli, stiffness fields, rest positions, whatever it is made of.
        tolerance: it stops where the largest component of the gradient has fallen to this fraction of the first.
        goal: it stops at a loss no larger than this. Without one every stationary point is a success.
        solver: settings of each solve.
        progress: called with the number of steps and the loss.

    Returns:
        A `Design`: `REACHED` at the goal, or without one at a stationary point; `UNREACHABLE` at a stationary point
        over the goal; else `NOT_CONVERGED`. `theta` is the best that was seen.

    Raises:
        ValueError: if `steps` is not a whole number of at least 0, `theta0` holds no floats, or as `design` does.
    """
    for name, value, form in (("loss", loss, "(scene, x) -> scalar"), ("design", design, "(theta) -> scene")):
        checks.function(name, value, form)
    if not hasattr(optimiser, "update"):
        raise ValueError(f"optimiser: expected one of optax, such as optax.adam(1e-2), got {optimiser!r}")
    checks.count("steps", steps, 0)
    tolerance = checks.setting("tolerance", tolerance, checks.NOT_NEGATIVE)
    goal = None if goal is None else checks.setting("goal", goal)
    # A weak dtype turns strong in the first update, and all would be compiled again.
    strong = partial(jax.tree.map, lambda leaf: jnp.asarray(leaf, jnp.asarray(leaf).dtype))
    theta = strong(theta0)
    leaves = jax.tree.leaves(theta)
    if not leaves or not all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves):
        raise ValueError(f"theta0: expected a pytree of float arrays, got {theta0!r}")
    first = design(theta)
    check_scene_and_solver(first, solver)
    check_held(first)

    def objective(theta: Any, x: jax.Array) -> tuple[jax.Array, Solution]:
        scene = design(theta)
        solution = equilibrium(scene, x, solver)
        return loss(scene, solution.x), solution

    evaluate = jax.jit(jax.value_and_grad(objective, has_aux=True))

    def finite_loss(theta: Any, x: jax.Array) -> jax.Array:
        """What a line search sees: no loss at all where there is no equilibrium."""
        value, solution = objective(theta, x)
        return jnp.where(solution.status == 0, value, jnp.inf)

    transform = optax.with_extra_args_support(optimiser)

    @jax.jit
    def advance(theta: Any, state: Any, grad: Any, value: jax.Array, x: jax.Array) -> tuple[Any, Any]:
        value_fn = partial(finite_loss, x=x)
        updates, state = transform.update(grad, state, theta, value=value, grad=grad, value_fn=value_fn)
        return optax.apply_updates(theta, updates), state

    halfway = jax.jit(lambda a, b: jax.tree.map(lambda x, y: 0.5 * (x + y), a, b))
    state, x = strong(transform.init(theta)), first.mesh.nodes
    tried: list[tuple[Any, float, int]] = []
    best: tuple[Any, Solution, float] | None = None
    last, first_slope, solves, skips, status = theta, 0.0, 0, 0, DesignStatus.NOT_CONVERGED
    for count in range(steps + 1):
        (value, solution), grad = evaluate(theta, x)
        number = float(value)
        slope = max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(grad))
        solves += 1
        tried.append((theta, number, int(solution.status)))
        if progress:
            progress(count, number)
        good = int(solution.status) == 0 and np.isfinite(number) and np.isfinite(slope)
        if best is None or (good and number < best[2]):
            best = (theta, solution, number if good else np.inf)
        if not good:
            skips += 1
            if count == 0 or skips > MAX_SKIPS:
                break
            theta = halfway(last, theta)
            continue
        last, x, skips = theta, solution.x, 0
        first_slope = first_slope or slope
        if goal is not None and number <= goal:
            status = DesignStatus.REACHED
            break
        if slope <= tolerance * first_slope:
            status = DesignStatus.REACHED if goal is None else DesignStatus.UNREACHABLE
            break
        if count < steps:
            theta, state = advance(theta, state, grad, value, x)
            solves += int(optax.tree_utils.tree_get(state, "num_linesearch_steps", default=0))
    assert best is not None
    thetas, losses, statuses = zip(*tried, strict=True)
    return Design(
        theta=best[0],
        solution=best[1],
        value=jnp.asarray(best[2]),
        loss=jnp.asarray(best[2]),
        held=jnp.zeros(0, jnp.int32),
        solves=jnp.asarray(solves, jnp.int32),
        history=History(
            jax.tree.map(lambda *each: jnp.stack(each), *thetas),
            jnp.asarray(losses),
            jnp.asarray(statuses, jnp.int32),
        ),
        status=jnp.asarray(status, jnp.int32),
    )
