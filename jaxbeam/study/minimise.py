"""Inverse design with any loss, any scene that is a function of parameters, and any optax optimiser.

Use it for shapes, materials, loads and fits to data. To bring the tip of the reference beam to 20 degrees,
`optax.lbfgs()` takes 14 solves and `optax.adam(0.1)` more than 200. For commands that bring a measure to a value use
`reach`, which takes 5 and keeps bounds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.progress import Report, check_progress
from jaxbeam.scene.rigid import check_held
from jaxbeam.scene.scene import Scene
from jaxbeam.solve.equilibrium import equilibrium
from jaxbeam.solve.newton import Newton, check_scene_and_solver
from jaxbeam.solve.solution import Solution
from jaxbeam.study.design import Design, DesignStatus, History

# optax takes as long to import as all of jaxbeam, so only `minimise` imports it.
if TYPE_CHECKING:
    import optax

# --------------------------------------------------------------------------------------------- minimise

# How often in a row a step may be halved because no equilibrium is found where it leads.
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
    progress: bool | Callable[[int, float], None] | None = None,
) -> Design:
    """Minimise a loss of the equilibrium over parameters, with any optimiser of optax.

    Each solve starts from the equilibrium before. If its status is not `OK`, the step that led there is halved, back
    towards the last good parameters; the optimiser does not see the failed trial. Parameters are not bounded: let
    `design` map them to quantities that are, for example `ratios = 0.4 + 0.6 * jax.nn.sigmoid(theta)`.

    Args:
        loss: `(scene, x)` to `()`.
        theta0: parameters to start from, any pytree of float arrays.
        optimiser: such as `optax.adam(1e-2)` or `optax.lbfgs()`, whose line search solves equilibria of its own.
        steps: largest number of steps, halvings included.
        design: `theta` to a scene. Anything in a scene may depend on `theta`: commands, moduli, stiffness fields, rest
            positions.
        tolerance: stop when the largest component of the gradient is at most this fraction of that of the first one.
        goal: stop at a loss of at most this. Without a goal every stationary point counts as a success.
        solver: settings of each solve.
        progress: `True` draws a line of progress on stderr, if that is a terminal. A function is called after each
            trial, as `progress(steps, loss)`, with the number of steps and the loss.

    Returns:
        A `Design`. Its status is `REACHED` at the goal, or without a goal at a stationary point; `UNREACHABLE` at a
        stationary point above the goal; else `NOT_CONVERGED`. `theta` is the best of all trials.

    Raises:
        ValueError: if `steps` is not a whole number of at least 0, `theta0` holds no floats, or as `design` does.
    """
    tolerance, goal = _check_arguments(loss, design, optimiser, steps, tolerance, goal)
    check_progress(progress, "(steps, loss)")
    theta = _strong(theta0)
    leaves = jax.tree.leaves(theta)
    if not leaves or not all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves):
        raise ValueError(f"theta0: expected a pytree of float arrays, got {theta0!r}")
    first = design(theta)
    check_scene_and_solver(first, solver)
    check_held(first)
    programs = _programs(loss, design, optimiser, solver)
    state = DescentState(theta, first.mesh.nodes, _strong(programs.init(theta)), last=theta)
    with Report(progress, f"steps of at most {steps}") as report:
        _descend(state, programs, steps, tolerance, goal, report)
    return _report(state)


def _check_arguments(
    loss: Any, design: Any, optimiser: Any, steps: int, tolerance: float, goal: float | None
) -> tuple[float, float | None]:
    """Check the arguments of `minimise`, and return the tolerance and the goal."""
    for name, value, form in (("loss", loss, "(scene, x) -> scalar"), ("design", design, "(theta) -> scene")):
        checks.function(name, value, form)
    if not hasattr(optimiser, "update"):
        raise ValueError(f"optimiser: expected one of optax, such as optax.adam(1e-2), got {optimiser!r}")
    checks.count("steps", steps, 0)
    tolerance = checks.setting("tolerance", tolerance, checks.NOT_NEGATIVE)
    return tolerance, None if goal is None else checks.setting("goal", goal)


def _strong(tree: Any) -> Any:
    """The tree with leaves of a strong dtype.

    A weakly typed leaf would become strong in the first update, and every program would be compiled again.
    """
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.asarray(leaf).dtype), tree)


# ---------------------------------------------------------------------------------------------- the loop


class Programs(NamedTuple):
    """The compiled functions for one loss, design, optimiser and solver.

    evaluate: `(theta, x)` to `((loss, solution), gradient)`; the solve starts at `x`.
    init: `theta` to the optimiser's state.
    advance: `(theta, state, gradient, loss, x)` to the next `theta` and state.
    """

    evaluate: Callable[..., Any]
    init: Callable[..., Any]
    advance: Callable[..., Any]


def _programs(loss: Any, design: Any, optimiser: optax.GradientTransformation, solver: Newton) -> Programs:
    """The functions that `minimise` calls in its loop."""
    import optax

    def objective(theta: Any, x: jax.Array) -> tuple[jax.Array, Solution]:
        scene = design(theta)
        solution = equilibrium(scene, x, solver)
        return loss(scene, solution.x), solution

    def finite_loss(theta: Any, x: jax.Array) -> jax.Array:
        """The loss for the optimiser's line search: infinite where the solve fails."""
        value, solution = objective(theta, x)
        return jnp.where(solution.status == 0, value, jnp.inf)

    transform = optax.with_extra_args_support(optimiser)

    @jax.jit
    def advance(theta: Any, state: Any, grad: Any, value: jax.Array, x: jax.Array) -> tuple[Any, Any]:
        value_fn = partial(finite_loss, x=x)
        updates, state = transform.update(grad, state, theta, value=value, grad=grad, value_fn=value_fn)
        return optax.apply_updates(theta, updates), state

    return Programs(jax.jit(jax.value_and_grad(objective, has_aux=True)), transform.init, advance)


@dataclasses.dataclass
class DescentState:
    """The state of a minimisation.

    theta: parameters to try next.
    x: `(n, 2)` equilibrium to start the next solve from.
    optimiser: the optimiser's state.
    last: parameters of the last good trial.
    first_slope: largest component of the first gradient.
    solves: number of equilibria solved.
    skips: number of failed trials in a row.
    best: parameters, solution and loss of the best trial.
    tried: parameters, loss and status of each trial.
    status: how the minimisation ends.
    """

    theta: Any
    x: jax.Array
    optimiser: Any
    last: Any
    first_slope: float = 0.0
    solves: int = 0
    skips: int = 0
    best: tuple[Any, Solution, float] | None = None
    tried: list[tuple[Any, float, int]] = dataclasses.field(default_factory=list)
    status: DesignStatus = DesignStatus.NOT_CONVERGED


def _descend(
    state: DescentState,
    programs: Programs,
    steps: int,
    tolerance: float,
    goal: float | None,
    report: Report,
) -> None:
    """Take steps until the loss is at the goal or stationary, no steps are left, or too many trials fail in a row."""
    from optax import tree_utils

    for count in range(steps + 1):
        (value, solution), grad = programs.evaluate(state.theta, state.x)
        slope = max(float(np.max(np.abs(leaf))) for leaf in jax.tree.leaves(grad))
        good = _record(state, solution, float(value), slope)
        report(count, f"loss {float(value):.4g}", call=(count, float(value)))
        if not good:
            state.skips += 1
            if count == 0 or state.skips > MAX_SKIPS:
                return
            state.theta = _halfway(state.last, state.theta)
            continue
        state.last, state.x, state.skips = state.theta, solution.x, 0
        state.first_slope = state.first_slope or slope
        if goal is not None and float(value) <= goal:
            state.status = DesignStatus.REACHED
            return
        if slope <= tolerance * state.first_slope:
            state.status = DesignStatus.REACHED if goal is None else DesignStatus.UNREACHABLE
            return
        if count < steps:
            state.theta, state.optimiser = programs.advance(state.theta, state.optimiser, grad, value, state.x)
            state.solves += int(tree_utils.tree_get(state.optimiser, "num_linesearch_steps", default=0))


def _record(state: DescentState, solution: Solution, loss: float, slope: float) -> bool:
    """Record the trial of `state.theta`. Returns whether it is good: status `OK`, finite loss and gradient."""
    status = int(solution.status)
    state.solves += 1
    state.tried.append((state.theta, loss, status))
    good = status == 0 and bool(np.isfinite(loss)) and bool(np.isfinite(slope))
    if state.best is None or (good and loss < state.best[2]):
        state.best = (state.theta, solution, loss if good else np.inf)
    return good


@jax.jit
def _halfway(a: Any, b: Any) -> Any:
    """The mean of two trees."""
    return jax.tree.map(lambda x, y: 0.5 * (x + y), a, b)


def _report(state: DescentState) -> Design:
    """The `Design` made from the final state."""
    assert state.best is not None
    theta, solution, loss = state.best
    thetas, losses, statuses = zip(*state.tried, strict=True)
    return Design(
        theta=theta,
        solution=solution,
        value=jnp.asarray(loss),
        loss=jnp.asarray(loss),
        held=jnp.zeros(0, jnp.int32),
        solves=jnp.asarray(state.solves, jnp.int32),
        history=History(
            jax.tree.map(lambda *each: jnp.stack(each), *thetas),
            jnp.asarray(losses),
            jnp.asarray(statuses, jnp.int32),
        ),
        status=jnp.asarray(state.status, jnp.int32),
    )
