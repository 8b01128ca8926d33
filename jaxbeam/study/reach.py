"""Inverse design by commands: of all commands that bring a measure to a target, those of least effort.

Use `reach` for one target and `reach_each` for a path. Where the unknowns are not commands, or there is a loss to lower
and no value to meet, use `minimise`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core import checks
from jaxbeam.core.compiling import is_outermost, usual_rules
from jaxbeam.core.progress import Progress, Report, check_progress
from jaxbeam.core.tree import Numbers, is_concrete, namespace, replace, to_device
from jaxbeam.scene.measures import tip_angle
from jaxbeam.scene.rigid import check_held
from jaxbeam.scene.scene import Scene, command_count, command_units, commanded_terms, rest_commands
from jaxbeam.solve.newton import Newton, check_scene_and_solver, topology
from jaxbeam.solve.solution import Solution, outlined
from jaxbeam.study.design import Design, DesignStatus, History
from jaxbeam.study.expansion import Measure
from jaxbeam.study.optimum import Answer, Problem, move_answer
from jaxbeam.study.search import Known, SearchState, Task, Trial, search

# ------------------------------------------------------------------------------------------------ reach

# Default bounds of the ratios of tendons.
RATIOS = (0.4, 1.0)


@usual_rules
def reach(
    scene: Scene,
    target: Numbers,
    measure: Measure = tip_angle,
    *,
    bounds: tuple[Numbers, Numbers] | None = None,
    starts: Numbers | Solution | None = None,
    tolerance: float | None = None,
    max_solves: int = 40,
    solver: Newton = Newton(),
    progress: bool | Callable[[int, float], None] | None = None,
) -> Design:
    """Commands within `bounds` at which `measure` of the equilibrium is `target`.

    Of all commands that reach the target, it finds those of least effort `sum (1 - ratio)^2`; if none reach it, those
    that come nearest. For a command that is not a ratio, the effort is its squared distance from rest over the squared
    width of its bounds. The method is sequential quadratic programming (Nocedal and Wright 2006, ch. 18) with exact
    first and second derivatives: each step is a small quadratic program in the commands. The search is local. Where a
    target is reached in several ways, or on several branches, give several `starts`; the best answer is returned.

    Args:
        scene: with `m` tendons.
        target: `()` or `(p,)` value that the measure should have.
        measure: `(scene, x)` to `()` or `(p,)`, such as `tip_angle` (degrees), `tip_position` (length), or a
            function of your own at module level. Components are weighed as they are: scale those of different units.
        bounds: lowest and highest command, each `()` or `(m,)`; by default 0.4 and 1 for ratios of tendons.
        starts: `(S, m)` commands to start from; by default those at rest, which are ratios of 1 for tendons. Or a
            `Solution` of the scene, such as `solution` of an earlier answer: the search goes on from its state, and so
            stays on its branch. Two or three solves are left to take if the new target is near.
        tolerance: largest deviation from the target that counts as reached, in the unit of the target; by default 1e-8,
            in float32 1e-3.
        max_solves: largest number of equilibria to solve from each start.
        solver: settings of each solve.
        progress: `True` draws a line of progress on stderr, if that is a terminal. A function is called after each
            solve, as `progress(solves, distance)`, with the number of solves so far and the distance from the target.

    Returns:
        A `Design`. If its status is `REACHED`, the target is met. If it is `UNREACHABLE`, `value` is the nearest value
        that was found, and `held` says which bounds are in the way. Otherwise it is `NOT_CONVERGED`, also if no command
        has an effect on the measure, neither at the start nor when shortened.

    `theta`, `solution` (as that of `equilibrium`), `value` and `loss` are differentiable in `target`, `bounds` and
    every float of the scene, but not in `starts`: forward, reverse and to any order, by the optimality conditions (see
    `jaxbeam.study.optimum`). `history` is a record without derivatives. The derivative is NaN where the status is
    `NOT_CONVERGED`, where the optimum is not isolated, and where a command lies at a bound that does not hold it,
    because it can move to one side only. An example of the last is a target that is met at rest, with ratio 1 as the
    upper bound.

    Raises:
        ValueError: if bounds are not `low <= high` in the range of the commands, an argument has another shape, as
            `equilibrium` does, or if it is called inside `jit` or `vmap`: the search is a loop on the host.
    """
    check_progress(progress, "(solves, distance)")
    problem, begin = _problem(scene, bounds, starts, tolerance, max_solves, solver)
    shape = _shape(measure, scene)
    goal = _known_or_traced("target", target)
    if goal.shape != shape:
        raise ValueError(f"target: expected the shape {shape} of the measure, got {goal.shape}")
    goal = jnp.asarray(goal, scene.mesh.nodes.dtype)
    task, goals, begin = _on_host(problem, goal[None], begin, measure, int(max_solves), solver)
    found = _each_in_turn(task, goals, begin, progress)[0]
    if not is_concrete(*jax.tree.leaves((problem, goal))):
        found = _moving(problem, goal, found, measure, solver)
    return replace(found, solution=outlined(found.solution, scene.mesh))


@usual_rules
def reach_each(
    scene: Scene,
    targets: Numbers,
    measure: Measure = tip_angle,
    *,
    bounds: tuple[Numbers, Numbers] | None = None,
    starts: Numbers | Solution | None = None,
    tolerance: float | None = None,
    max_solves: int = 40,
    solver: Newton = Newton(),
    progress: bool | Callable[[int, float], None] | None = None,
) -> Design:
    """Commands for each of a sequence of targets `(T,)` or `(T, p)`, such as points of a path that the tip draws.

    The search for each target starts from the answer before, so neighbouring targets take few solves each. The first is
    found as by `reach`. Arguments, errors, answer and derivatives are those of `reach`, with leading axis `T`.
    A function `progress` counts the solves of all targets.
    """
    check_progress(progress, "(solves, distance)")
    problem, begin = _problem(scene, bounds, starts, tolerance, max_solves, solver)
    shape = _shape(measure, scene)
    goals = _known_or_traced("targets", targets)
    if goals.ndim != len(shape) + 1 or goals.shape[1:] != shape or not goals.shape[0]:
        rows = f"(T, {shape[0]})" if shape else "(T,)"
        raise ValueError(f"targets: expected shape {rows}, a row for each target, got {goals.shape}")
    goals = jnp.asarray(goals, scene.mesh.nodes.dtype)
    task, targets, begin = _on_host(problem, goals, begin, measure, int(max_solves), solver)
    each = _each_in_turn(task, targets, begin, progress)
    found = jax.tree.map(lambda *rows: to_device(np.stack(rows)), *each)
    if not is_concrete(*jax.tree.leaves((problem, goals))):
        found = _moving_each(problem, goals, found, measure, solver)
    return replace(found, solution=outlined(found.solution, scene.mesh))


def _problem(
    scene: Scene,
    bounds: tuple[Numbers, Numbers] | None,
    starts: Numbers | Solution | None,
    tolerance: float | None,
    max_solves: int,
    solver: Newton,
) -> tuple[Problem, Any]:
    """The checked problem, and the commands `(S, m)` or the state to start from."""
    check_scene_and_solver(scene, solver)
    checks.count("max_solves", max_solves, 1)
    check_held(scene)
    dtype = scene.mesh.nodes.dtype
    count = command_count(scene)
    if tolerance is None:
        tolerance = 1e-8 if jnp.finfo(dtype).eps < 1e-10 else 1e-3
    tolerance = checks.number("tolerance", tolerance, checks.POSITIVE)
    low, high = command_bounds(scene, bounds)
    problem = Problem(scene, solver.linear.layout(topology(scene)), low, high, jnp.asarray(tolerance, dtype))
    if isinstance(starts, Solution):
        return problem, _known(scene, starts, count)
    begin = rest_commands(scene)[None].astype(float) if starts is None else checks.numbers("starts", starts)
    if begin.ndim != 2 or begin.shape[1] != count or not begin.shape[0]:
        raise ValueError(f"starts: expected shape (S, {count}), a row for each start, got {begin.shape}")
    return problem, begin


def command_bounds(scene: Scene, bounds: tuple[Numbers, Numbers] | None) -> tuple[Any, Any]:
    """The lowest and the highest commands, `(m,)` each, checked; by default `RATIOS` if all are ratios of tendons."""
    count = command_count(scene)
    if not count:
        raise ValueError("scene: expected at least one tendon to command, got none")
    if bounds is None and (rest_commands(scene) != 1).any():
        raise ValueError("bounds: only ratios of tendons have default bounds; give the lowest and the highest commands")
    bounds = RATIOS if bounds is None else bounds
    if not isinstance(bounds, tuple | list) or len(bounds) != 2:
        raise ValueError(f"bounds: expected the lowest and the highest ratio, (low, high), got {bounds!r}")
    ends = []
    for name, bound in zip(("low", "high"), bounds, strict=True):
        end = checks.numbers(f"bounds, {name}", bound)
        if end.shape not in ((), (count,)):
            raise ValueError(f"bounds: expected {name} of shape () or ({count},), got {end.shape}")
        xp = namespace(end)
        ends.append(to_device(xp.broadcast_to(xp.asarray(end, scene.mesh.nodes.dtype), (count,))))
    low, high = ends
    if is_concrete(low, high):
        ranges = [term.kind.commands for term in commanded_terms(scene) for _ in range(term.command_count)]
        for within, lowest, highest in zip(ranges, np.asarray(low), np.asarray(high), strict=True):
            if not (within.holds(lowest) and lowest <= highest):
                floor = "" if np.isneginf(within.low) else f"{within.low:g} {'<=' if within.closed else '<'} "
                raise ValueError(
                    f"bounds: expected {floor}low <= high, got low {low.tolist()} and high {high.tolist()}"
                )
    return low, high


def _known(scene: Scene, start: Solution, count: int) -> Known:
    """The state of a solution, to start from."""
    if np.shape(start.ratios) != (count,) or np.shape(start.x) != scene.mesh.nodes.shape:
        raise ValueError(
            f"starts: expected a Solution of one state of this scene, with commands ({count},) and positions "
            f"{scene.mesh.nodes.shape}, got {np.shape(start.ratios)} and {np.shape(start.x)}"
        )
    if is_concrete(start.status) and int(start.status):
        raise ValueError(f"starts: expected a Solution whose status is OK, got {start!r}; give commands instead")
    return Known(start.ratios, start.x)


def _known_or_traced(name: str, target: Numbers) -> Any:
    """Targets, checked. A traced one may be NaN: its search fails, and the derivatives of others are unharmed."""
    return checks.numbers(name, target) if is_concrete(target) else checks.real(name, target)


def _shape(measure: Measure, scene: Scene) -> tuple[int, ...]:
    """The shape of a measure's value, checked."""
    checks.function("measure", measure, "(scene, x) to shape () or (p,)")
    leaves, structure = jax.tree.flatten(scene)
    shape = _traced_shape(measure, structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves))
    if len(shape) > 1:
        raise ValueError(f"measure: expected a function (scene, x) to shape () or (p,), got shape {shape}")
    return shape


@lru_cache(maxsize=64)
def _traced_shape(measure: Measure, structure: Any, leaves: tuple[Any, ...]) -> tuple[int, ...]:
    """The shape of a measure's value, for a scene of this structure; cached, because a trace takes a millisecond."""
    scene = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*leaf) for leaf in leaves])
    return jax.eval_shape(measure, scene, scene.mesh.nodes).shape


@partial(jax.jit, static_argnames=("measure", "solver"))
def _moving(problem: Problem, target: jax.Array, found: Design, measure: Measure, solver: Newton) -> Design:
    """The design, differentiable in the problem and the target, except for `history` and whole numbers."""
    answer = Answer(
        theta=found.theta,
        x=found.solution.x,
        held=found.held,
        reached=found.status == DesignStatus.REACHED,
        trusted=(found.status != DesignStatus.NOT_CONVERGED) & (found.solution.status == 0),
    )
    theta, solution, value = move_answer(measure, solver, problem, target, answer, found.solution)
    miss = jnp.ravel(value - target)
    moving = answer.trusted & (found.loss != 0)
    distance = jnp.linalg.norm(jnp.where(moving, miss, 1))
    # A distance of zero has no derivative and gets zero. A failed search gets the NaN derivative of `theta`, and not
    # that of the distance, which may be NaN itself: zero times NaN would reach a loss that does not depend on it.
    failed = found.loss + jnp.sum(theta - lax.stop_gradient(theta))
    loss = jnp.where(moving, distance, jnp.where(answer.trusted, 0 * jnp.sum(miss), failed))
    return replace(found, theta=theta, solution=solution, value=value, loss=loss)


@partial(jax.jit, static_argnames=("measure", "solver"))
def _moving_each(problem: Problem, targets: jax.Array, found: Design, measure: Measure, solver: Newton) -> Design:
    """`_moving` for each of the targets `(T, ...)`."""
    # As in `differentiable_rows`, factors are made anew for each row instead of stored for all.
    each = jax.checkpoint(lambda row: _moving(problem, *row, measure, solver))
    return lax.map(each, (targets, found))


# ------------------------------------------------------------------------------------------ on the host


def _on_host(
    problem: Problem,
    targets: Any,
    begin: Any,
    measure: Measure,
    max_solves: int,
    solver: Newton,
) -> tuple[Task, np.ndarray, Any]:
    """The task, the targets `(T, ...)` and the starts, with values on the host.

    The target of the task is still empty, and it reports nothing.

    Raises:
        ValueError: if a value is traced by anything but derivatives.
    """
    values = problem, targets, begin
    if not is_concrete(*jax.tree.leaves(values)):
        values = lax.stop_gradient(values)
    if not is_concrete(*jax.tree.leaves(values)) or not is_outermost():
        raise ValueError(
            "scene, target, bounds: expected concrete values, got traced ones; reach and reach_each run on the host: "
            "call them outside jit, vmap and scan; jax.grad, jax.jacfwd and jax.jacrev of them work outside jit"
        )
    known, goals, starts = values
    unit = np.asarray(command_units(known.scene, known.low, known.high), float)
    low, high = np.asarray(known.low, float) / unit, np.asarray(known.high, float) / unit
    task = Task(
        scene=known.scene,
        layout=known.layout,
        unit=unit,
        rest=rest_commands(known.scene) / unit,
        target=np.zeros(0),
        low=low,
        high=high,
        tolerance=float(known.tolerance),
        measure=measure,
        max_solves=max_solves,
        solver=solver,
        report=lambda distance: None,
    )
    if isinstance(starts, Known):
        starts = Known(np.asarray(starts.commands), starts.x)
    else:
        starts = np.clip(np.asarray(starts, float) / unit, low, high)
    return task, np.asarray(goals, float), starts


def _each_in_turn(task: Task, targets: np.ndarray, begin: np.ndarray | Known, progress: Progress) -> list[Design]:
    """The design of each of the targets `(T, ...)`. Each search but the first starts from the answer before."""
    before: Trial | None = None
    designs: list[Design] = []
    several, solves = len(targets) > 1, 0
    unit, total = ("targets", len(targets)) if several else ("solves", None)

    def tell(distance: float) -> None:
        nonlocal solves
        solves += 1
        figure, call = f"distance {distance:.2e}", (solves, distance)
        if several:
            report(len(designs), f"{solves} solves, {figure}", call)
        else:
            report(solves, figure, call)

    with Report(progress, unit, total) as report:
        for target in targets:
            one = task._replace(target=np.ravel(target), report=tell)
            state = _search_all(one, begin) if before is None else search(one, before)
            before = before if state.here is None else state.here
            designs.append(_design(one, state, target.shape))
            if several:
                report(len(designs), f"{solves} solves")
    return designs


def _search_all(task: Task, begin: np.ndarray | Known) -> SearchState:
    """The best answer from all the starts: commands `(S, m)`, or a state."""
    if isinstance(begin, Known):
        return search(task, begin)
    found = [_search_twice(task, theta) for theta in begin]

    def rank(state: SearchState) -> tuple[bool, float, float]:
        """Sort key: the nearest answer is best; among those that reach the target, the one of least effort."""
        if state.here is None:
            return True, np.inf, np.inf
        nearness = -1.0 if state.status == DesignStatus.REACHED else state.here.distance
        return state.status == DesignStatus.NOT_CONVERGED, nearness, state.here.effort

    return min(found, key=rank)


def _search_twice(task: Task, theta: np.ndarray) -> SearchState:
    """A search from the commands `theta` `(m,)`, and if the target is out of reach, a second one from its answer.

    The second search approaches the commands of that answer straight from rest. The first one came to them by way of
    other commands, and its state may be one that a beam pulled straight to them does not take.
    """
    found = search(task, theta)
    if found.status != DesignStatus.UNREACHABLE or found.here is None:
        return found
    again = search(task, found.here.theta)
    solves = found.solves + again.solves
    if again.status != DesignStatus.NOT_CONVERGED and again.here is not None:
        found = again if again.here.distance < found.here.distance else found
    found.solves = solves
    return found


def _design(task: Task, state: SearchState, shape: tuple[int, ...]) -> Design:
    """The report of a search, with a value of this `shape`."""
    dtype, most = task.scene.mesh.nodes.dtype, task.max_solves
    # If no trial was accepted, report the last one.
    at = state.last if state.here is None else state.here
    assert at is not None
    miss = at.miss if state.here is not None else np.full(at.miss.shape, np.inf)
    theta, loss = np.full((most, at.theta.size), np.nan, dtype), np.full(most, np.nan, dtype)
    status = np.full(most, -1, np.int32)
    for k, each in enumerate(state.tried):
        tried, loss[k], status[k] = each
        theta[k] = tried * task.unit
    # One transfer for all arrays.
    command, value, distance, held, solves, ended, history = jax.device_put(
        (
            (at.theta * task.unit).astype(dtype),
            (miss + task.target).astype(dtype).reshape(shape),
            np.asarray(np.linalg.norm(miss), dtype),
            state.held,
            np.int32(state.solves),
            np.int32(state.status),
            (theta, loss, status),
        )
    )
    return Design(command, at.solution, value, distance, held, solves, History(*history), ended)
