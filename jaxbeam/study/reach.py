"""Inverse design by commands: of all that make a measure what it should be, those of least effort."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core import checks
from jaxbeam.core.compiling import choose, usual_rules, zeros_like_result
from jaxbeam.core.tree import Numbers, is_concrete, replace
from jaxbeam.scene.measures import tip_angle
from jaxbeam.scene.scene import Scene, tendon_count
from jaxbeam.scene.supports import check_held
from jaxbeam.solve.newton import Newton, check_scene_and_solver, topology
from jaxbeam.study.design import Design, DesignStatus
from jaxbeam.study.optimum import Answer, move_answer
from jaxbeam.study.search import Measure, Problem, Stand, effects, search

# ------------------------------------------------------------------------------------------------ reach


@usual_rules
def reach(
    scene: Scene,
    target: Numbers,
    measure: Measure = tip_angle,
    *,
    bounds: tuple[Numbers, Numbers] = (0.4, 1.0),
    starts: Numbers | None = None,
    tolerance: float | None = None,
    max_solves: int = 40,
    solver: Newton = Newton(),
) -> Design:
    """Commands within `bounds` at which `measure` of the equilibrium is `target`.

    Of all that reach it, the one of least effort `sum (1 - ratio)^2`; if none does, the one nearest to it. Found by
    sequential quadratic programming (Nocedal and Wright 2006, ch. 18) with exact first and second derivatives: each
    step is a small quadratic program in the commands. The search is local: where a target is reached in several
    ways, or on several branches, give several `starts`, and the best answer is taken.

    Args:
        scene: with `m` tendons.
        target: `()` or `(p,)`, what the measure should be.
        measure: `(scene, x)` to `()` or `(p,)`, such as `tip_angle` (degrees), `tip_position` (length), or a
            function of your own at module level. Components are weighed as they are: scale those of different units.
        bounds: lowest and highest ratio, each `()` or `(m,)`.
        starts: `(S, m)` commands to start from; by default ratio 1, at rest.
        tolerance: largest deviation from the target that counts as reached, in its unit: by default 1e-8, in
            float32 1e-3.
        max_solves: equilibria to solve at most, from each start.
        solver: settings of each solve.

    Returns:
        A `Design` of status `REACHED`, or `UNREACHABLE`: then `value` is the nearest that was found, and `held` says
        which bounds are in the way, or `NOT_CONVERGED`: also where no command has an effect on the measure, at the
        start and as they are shortened.

    `theta`, `solution` (as that of `equilibrium`), `value` and `loss` are differentiable in `target`, `bounds` and
    every float of the scene, forward, reverse and to any order, by the conditions that an optimum satisfies (see
    `jaxbeam.study.optimum`); not in `starts`. `history` is a record and does not move. The derivative is NaN where the
    status is `NOT_CONVERGED`, where the optimum is not isolated, and where a command lies at a bound that does not hold
    it, for it moves to one side only: so for a target that is met at rest, if ratio 1 is the upper bound.

    Raises:
        ValueError: if bounds are not `0 < low <= high`, or an argument has another shape, or as `equilibrium` does.
    """
    problem, begin = _problem(scene, bounds, starts, tolerance, max_solves, solver)
    shape = _shape(measure, scene)
    goal = checks.numbers("target", target)
    if goal.shape != shape:
        raise ValueError(f"target: expected the shape {shape} of the measure, got {goal.shape}")
    goal, most = jnp.asarray(goal, scene.mesh.nodes.dtype), int(max_solves)
    found = _reach(*lax.stop_gradient((problem, goal, begin)), measure, most, solver)
    if is_concrete(*jax.tree.leaves((problem, goal))):
        return found
    return _moving(problem, goal, found, measure, solver)


@usual_rules
def reach_each(
    scene: Scene,
    targets: Numbers,
    measure: Measure = tip_angle,
    *,
    bounds: tuple[Numbers, Numbers] = (0.4, 1.0),
    starts: Numbers | None = None,
    tolerance: float | None = None,
    max_solves: int = 40,
    solver: Newton = Newton(),
) -> Design:
    """Commands for each of a sequence of targets `(T,)` or `(T, p)`, each started from the answer before.

    So a tip draws a path, in one `lax.scan`: neighbouring targets take few solves each. The first is found as by
    `reach`. Arguments, errors, answer and derivatives are those of `reach`, with leading axis `T`.
    """
    problem, begin = _problem(scene, bounds, starts, tolerance, max_solves, solver)
    shape = _shape(measure, scene)
    goals = checks.numbers("targets", targets)
    if goals.ndim != len(shape) + 1 or goals.shape[1:] != shape or not goals.shape[0]:
        rows = f"(T, {shape[0]})" if shape else "(T,)"
        raise ValueError(f"targets: expected shape {rows}, a row for each target, got {goals.shape}")
    goals, most = jnp.asarray(goals, scene.mesh.nodes.dtype), int(max_solves)
    found = _reach_each(*lax.stop_gradient((problem, goals, begin)), measure, most, solver)
    if is_concrete(*jax.tree.leaves((problem, goals))):
        return found
    return _moving_each(problem, goals, found, measure, solver)


def _problem(
    scene: Scene,
    bounds: tuple[Numbers, Numbers],
    starts: Numbers | None,
    tolerance: float | None,
    max_solves: int,
    solver: Newton,
) -> tuple[Problem, jax.Array]:
    """The checked problem, and the commands `(S, m)` to start from."""
    check_scene_and_solver(scene, solver)
    checks.count("max_solves", max_solves, 1)
    check_held(scene)
    dtype = scene.mesh.nodes.dtype
    count = tendon_count(scene)
    if not count:
        raise ValueError("scene: expected at least one tendon to command, got none")
    if tolerance is None:
        tolerance = 1e-8 if jnp.finfo(dtype).eps < 1e-10 else 1e-3
    tolerance = checks.number("tolerance", tolerance, checks.POSITIVE)
    if not isinstance(bounds, tuple | list) or len(bounds) != 2:
        raise ValueError(f"bounds: expected the lowest and the highest ratio, (low, high), got {bounds!r}")
    ends = []
    for name, bound in zip(("low", "high"), bounds, strict=True):
        end = checks.numbers(f"bounds, {name}", bound)
        if end.shape not in ((), (count,)):
            raise ValueError(f"bounds: expected {name} of shape () or ({count},), got {end.shape}")
        ends.append(jnp.broadcast_to(jnp.asarray(end, dtype), (count,)))
    low, high = ends
    if is_concrete(low, high) and not ((np.asarray(low) > 0) & (np.asarray(low) <= np.asarray(high))).all():
        raise ValueError(f"bounds: expected 0 < low <= high, got low {low.tolist()} and high {high.tolist()}")
    begin = jnp.asarray(np.ones((1, count)) if starts is None else checks.numbers("starts", starts), dtype)
    if begin.ndim != 2 or begin.shape[1] != count or not begin.shape[0]:
        raise ValueError(f"starts: expected shape (S, {count}), a row for each start, got {begin.shape}")
    problem = Problem(scene, solver.linear.layout(topology(scene)), low, high, jnp.asarray(tolerance, dtype))
    return problem, jnp.clip(begin, low, high)


def _shape(measure: Measure, scene: Scene) -> tuple[int, ...]:
    """The shape of a measure's value, checked."""
    checks.function("measure", measure, "(scene, x) to shape () or (p,)")
    shape = jax.eval_shape(measure, scene, scene.mesh.nodes).shape
    if len(shape) > 1:
        raise ValueError(f"measure: expected a function (scene, x) to shape () or (p,), got shape {shape}")
    return shape


@partial(jax.jit, static_argnames=("measure", "max_solves", "solver"))
def _reach(
    problem: Problem, target: jax.Array, begin: jax.Array, measure: Measure, max_solves: int, solver: Newton
) -> Design:
    rest, ones = problem.scene.mesh.nodes, jnp.ones_like(problem.low)

    def once(theta: jax.Array) -> Design:
        return _design(problem, target, search(problem, target, ones, theta - 1, rest, measure, max_solves, solver))

    def attempt(carry: tuple[jax.Array, jax.Array, Design]) -> tuple[jax.Array, jax.Array, Design]:
        turn, theta, best = carry
        found = once(theta)
        solves = best.solves + found.solves
        better = (turn == 0) | ((found.status != DesignStatus.NOT_CONVERGED) & (found.loss < best.loss))
        return turn + 1, found.theta, replace(choose(better, found, best), solves=solves)

    def going(carry: tuple[jax.Array, jax.Array, Design]) -> jax.Array:
        turn, _, best = carry
        return (turn == 0) | ((turn == 1) & (best.status == DesignStatus.UNREACHABLE))

    def from_start(theta: jax.Array) -> Design:
        # What cannot be reached is searched once more from there, approached from rest: the search may have come
        # to it by way of a state that a beam pulled straight to it does not take.
        return lax.while_loop(going, attempt, (jnp.zeros((), jnp.int32), theta, zeros_like_result(once, theta)))[2]

    found = lax.map(from_start, begin)
    # The nearest; among those that reach the target the one of least effort.
    reached = found.status == DesignStatus.REACHED
    effort = jnp.sum((1 - found.theta) ** 2, axis=1)
    nearness = jnp.where(reached, -1, jnp.where(jnp.isfinite(found.loss), found.loss, jnp.inf))
    best = jnp.lexsort((effort, nearness, found.status == DesignStatus.NOT_CONVERGED))[0]
    return jax.tree.map(lambda leaf: leaf[best], found)


@partial(jax.jit, static_argnames=("measure", "max_solves", "solver"))
def _reach_each(
    problem: Problem, targets: jax.Array, begin: jax.Array, measure: Measure, max_solves: int, solver: Newton
) -> Design:
    first = _reach(problem, targets[0], begin, measure, max_solves, solver)

    def following(carry: tuple[jax.Array, jax.Array], target: jax.Array) -> tuple[Any, Design]:
        theta, x = carry
        at = search(problem, target, theta, jnp.zeros_like(theta), x, measure, max_solves, solver)
        found = _design(problem, target, at)
        return (found.theta, found.solution.x), found

    return lax.scan(following, (first.theta, first.solution.x), targets)[1]


@partial(jax.jit, static_argnames=("measure", "solver"))
def _moving(problem: Problem, target: jax.Array, found: Design, measure: Measure, solver: Newton) -> Design:
    """The design as a function of the problem and the target. `history` and whole numbers do not move."""
    answer = Answer(
        theta=found.theta,
        x=found.solution.x,
        held=found.held,
        reached=found.status == DesignStatus.REACHED,
        trusted=(found.status != DesignStatus.NOT_CONVERGED) & (found.solution.status == 0),
    )
    theta, solution, value = move_answer(measure, solver, problem, target, answer, found.solution)
    # The slope of the distance exists nowhere at zero, where it stays.
    miss, away = jnp.ravel(value - target), found.loss != 0
    loss = jnp.where(away, jnp.linalg.norm(jnp.where(away, miss, 1)), 0 * jnp.sum(miss))
    return replace(found, theta=theta, solution=solution, value=value, loss=loss)


@partial(jax.jit, static_argnames=("measure", "solver"))
def _moving_each(problem: Problem, targets: jax.Array, found: Design, measure: Measure, solver: Newton) -> Design:
    # Factors are not kept, as in `differentiable_rows`.
    each = jax.checkpoint(lambda row: _moving(problem, *row, measure, solver))
    return lax.map(each, (targets, found))


def _design(problem: Problem, target: jax.Array, at: Stand) -> Design:
    """The report of a search."""
    close = jnp.max(jnp.abs(at.miss)) <= problem.tolerance
    # Without any effect of any command there is no telling what is in reach.
    known = close | jnp.any(effects(at, jnp.ravel(target)))
    ended = jnp.where(close, DesignStatus.REACHED, DesignStatus.UNREACHABLE)
    return Design(
        theta=at.theta,
        solution=at.solution,
        value=at.miss.reshape(target.shape) + target,
        loss=jnp.linalg.norm(at.miss),
        held=at.held,
        solves=at.solves,
        history=at.history,
        status=jnp.where(at.resting & known, ended, DesignStatus.NOT_CONVERGED).astype(jnp.int32),
    )
