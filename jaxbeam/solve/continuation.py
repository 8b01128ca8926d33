"""Continuation: equilibria along a path of scenes, by as many Newton solves as it takes.

The path has a parameter `s`; an equilibrium is asked for at each of a few targets. A single equilibrium is a path with
one target. The compiled program has a single Newton loop, which all solves share.

An *attempt* is one Newton solve from a predicted start. Its state is *accepted* if it converged, unless it is a saddle
or the increment may have been too long (see `_judge`). A failed attempt halves the increment, an
accepted one doubles it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core.compiling import choose
from jaxbeam.linear.layout import Layout
from jaxbeam.scene.evaluation import surrounded, worst_element
from jaxbeam.scene.overlap import crossing
from jaxbeam.scene.scene import Scene, commands_of, extent, has_supports, is_valid, longest_increment
from jaxbeam.solve import newton
from jaxbeam.solve.actuation import force_rate, support_rate
from jaxbeam.solve.newton import INACCURATE, Newton
from jaxbeam.solve.predictor import Trail, extend, predict
from jaxbeam.solve.report import PackedReport, Report, unpack, write, zeros
from jaxbeam.solve.solution import Solution, Status
from jaxbeam.solve.stiffness import zero_factor

# The most Newton steps of the first attempt at a target. If it needs more, a shorter increment is quicker. Each failed
# attempt allows the next one this many more, because past a fold no increment is short enough.
ATTEMPT_STEPS = 60

# In an attempt from a predicted start this many first steps need not lower the energy. Beside a stiff tendon the energy
# has a curved valley, along which a line search advances very slowly.
FULL_STEPS = 8

# Failed attempts, since a target was last reached with status `OK`, before a target is given up.
MAX_CUTS = 20
# Consecutive saddles that are left before one is accepted.
MAX_ESCAPES = 4
# Largest component of the displacement away from a saddle, over the size of the body.
ESCAPE = 1e-3
# The most attempts at one target, however few steps they take.
MAX_ATTEMPTS = 100


# ---------------------------------------------------------------------------------- state of a continuation


class Problem(NamedTuple):
    """The inputs of a continuation, which do not change while it runs.

    scene_at: function of the parameter `s` that returns the scene, with unlocked indices.
    layout: layout of the stiffness matrix.
    targets: `(S,)` parameters at which an equilibrium is asked for, increasing.
    valid: `(S,)` whether every parameter of the scene is in its range at each target.
    noise: `(n, d)` random forces; the response to them shows the soft modes.
    solver: settings of Newton's method.
    longest: `()` the largest increment; None: any.
    """

    scene_at: Callable[[jax.Array], Scene]
    layout: Layout
    targets: jax.Array
    valid: jax.Array
    noise: np.ndarray
    solver: Newton
    longest: jax.Array | None


class Spent(NamedTuple):
    """Totals over the attempts at the present target so far; each an int32 `()`.

    steps: number of Newton steps.
    projected: number of Newton steps with a modified stiffness.
    halvings: number of halvings of the line search.
    attempts: number of attempts.
    status: flags of the last attempt, no total.
    """

    steps: jax.Array
    projected: jax.Array
    halvings: jax.Array
    attempts: jax.Array
    status: jax.Array


class Continuation(NamedTuple):
    """State of a continuation.

    target: `()` index of the present target.
    trail: the last accepted states with their parameters, newest first.
    accepted: `(n, d)` positions of the newest accepted state as solved for. `trail` stores them with the last Newton
        step added (see `_extend`).
    parameter: `()` value of `s` at the next attempt.
    start: `(n, d)` positions that the next attempt starts from, before `displacement` is added.
    displacement: `(n, d)` prediction from `start`, or the displacement away from a saddle.
    factor: factor of the stiffness at the end of the last attempt.
    increment: `()` continuation step in `s` from the newest accepted state.
    cuts: `()` number of failed attempts since the last target that was reached with status `OK`.
    escapes: `()` number of saddles left since the newest accepted state.
    spent: totals over the attempts at the present target.
    path: packed reports of all targets, with leading axis `S`.
    given_up: `()` whether the target is given up. Then the next attempt takes no step: it only evaluates the newest
        accepted state with the forces of the target.
    running: `()` whether another attempt is to be made.
    """

    target: jax.Array
    trail: Trail
    accepted: jax.Array
    parameter: jax.Array
    start: jax.Array
    displacement: jax.Array
    factor: Any
    increment: jax.Array
    cuts: jax.Array
    escapes: jax.Array
    spent: Spent
    path: PackedReport
    given_up: jax.Array
    running: jax.Array


class Verdict(NamedTuple):
    """How an attempt ended; each a boolean `()`.

    accepted: the continuation goes on from its state.
    landed: it is accepted, and its parameter is that of the target.
    saddle: it converged to a saddle, which the next attempt leaves.
    failed: it is neither accepted nor such a saddle.
    give_up: the target is not reached, and no further attempt is allowed.
    """

    accepted: jax.Array
    landed: jax.Array
    saddle: jax.Array
    failed: jax.Array
    give_up: jax.Array


# ---------------------------------------------------------------------------------- init and step


def follow(
    scene_at: Callable[[jax.Array], Scene],
    layout: Layout,
    trail: Trail,
    targets: jax.Array,
    solver: Newton,
    x: jax.Array | None = None,
    displacement: jax.Array | None = None,
) -> tuple[Solution, Any, Trail]:
    """Equilibria of `scene_at(s)` at each of the targets, each started from the one before.

    The first attempt goes straight to the first target, if it may (see `longest_increment`). Others start from the
    newest accepted state. When none is allowed any more (see `_judge`), the other targets are `NOT_CONVERGED`.

    Args:
        scene_at: function of the parameter `s` that returns the scene, with unlocked indices.
        layout: layout of the stiffness matrix.
        trail: known states; the newest one, at `s = 0`, is in equilibrium or at rest.
        targets: `(S,)` increasing parameters.
        solver: settings of Newton's method.
        x: `(n, d)` positions that the first attempt starts from; by default the newest state of `trail`.
        displacement: `(n, d)` added to `x`; by default the tangent predictor of `trail`, or zero if `x` is given.

    Returns:
        The solutions, with leading axis `S`; the factor of the stiffness at the last one; and the trail that ends
        there.
    """
    valid = jax.vmap(lambda s: is_valid(scene_at(s)))(targets)
    noise = np.random.default_rng(0).standard_normal(trail.x[0].shape).astype(trail.x.dtype)
    longest = longest_increment(*(scene_at(jnp.asarray(s, targets.dtype)) for s in (0, 1)))
    problem = Problem(scene_at, layout, targets, valid, noise, solver, longest)
    begin = init(problem, trail, x, displacement)
    state = lax.while_loop(lambda state: state.running, partial(step, problem), begin)
    return _solutions(problem, state), state.factor, state.trail


def init(problem: Problem, trail: Trail, x: jax.Array | None, displacement: jax.Array | None) -> Continuation:
    """The state before the first attempt; arguments as in `follow`."""
    targets, newest = problem.targets, trail.x[0]
    if displacement is None:
        displacement = jnp.where((trail.depth > 0) & (x is None), targets[0] * trail.slope[0], 0)
    zero, no, first = jnp.zeros((), jnp.int32), jnp.asarray(False), targets[0]
    if problem.longest is not None:
        # A start of the user's own is near the target, so it is tried there.
        first = jnp.where(x is None or jnp.all(x == newest), jnp.minimum(first, problem.longest), first)
        displacement = displacement * jnp.where(targets[0] > 0, first / targets[0], 1)
    return Continuation(
        target=zero,
        trail=trail,
        accepted=newest,
        parameter=first,
        start=newest if x is None else x,
        displacement=displacement,
        factor=zero_factor(problem.layout, newest.dtype, problem.solver.linear),
        increment=first,
        cuts=zero,
        escapes=zero,
        spent=Spent(zero, zero, zero, zero, zero),
        path=zeros(len(targets), newest),
        given_up=no,
        running=~no,
    )


def step(problem: Problem, state: Continuation) -> Continuation:
    """Make one attempt, judge it, and choose the next one."""
    scene = problem.scene_at(state.parameter)
    max_steps = jnp.minimum(ATTEMPT_STEPS * (1 + state.cuts), problem.solver.max_steps - state.spent.steps)
    attempt = _attempt(problem, state, scene, max_steps)
    report = _report(problem, state, scene, attempt)
    verdict = _judge(problem, state, attempt, report, max_steps)
    trail = _extend(state, attempt, verdict)
    accepted = jnp.where(verdict.accepted, attempt.x, state.accepted)
    target, parameter, increment = _next_parameter(problem, state, verdict, report, trail)
    start, displacement = _next_start(state, scene, attempt, verdict, trail, accepted, parameter)
    spent = Spent(*(getattr(report, name) for name in Spent._fields))
    return Continuation(
        target=target,
        trail=trail,
        accepted=accepted,
        parameter=parameter,
        start=start,
        displacement=displacement,
        factor=attempt.stiffness.factor,
        increment=increment,
        cuts=jnp.where(verdict.landed & (report.status == 0), 0, state.cuts + verdict.failed.astype(jnp.int32)),
        escapes=jnp.where(verdict.accepted, 0, state.escapes + verdict.saddle.astype(jnp.int32)),
        spent=jax.tree.map(lambda count: jnp.where(verdict.landed, 0, count), spent),
        path=write(state.path, state.target, report, verdict.landed | state.given_up),
        given_up=verdict.give_up,
        running=~state.given_up & ~(verdict.landed & (state.target == len(problem.targets) - 1)),
    )


# ---------------------------------------------------------------------------------- pieces of a step


def _attempt(problem: Problem, state: Continuation, scene: Scene, max_steps: jax.Array) -> newton.State:
    """One Newton solve of the scene at the present parameter.

    The response to its probe is the tangent of the branch. At a saddle it is a soft mode, along which the next attempt
    leaves.
    """
    policy = newton.Policy(
        max_steps=jnp.where(state.given_up, 0, max_steps),
        full_steps=jnp.where(state.trail.depth > 0, FULL_STEPS, 0),
        # Allowed at the intermediate states of a ramp: at all but the last.
        reuse_factor=state.parameter < problem.targets[-1] if len(problem.targets) > 1 else None,
        leaving_saddle=state.escapes > 0,
        # At a saddle the response to random forces consists mostly of soft modes.
        probe=lambda x, definite: jnp.where(definite, force_rate(problem.scene_at, state.parameter, x), problem.noise),
    )
    found = newton.newton(scene, problem.layout, state.start, state.displacement, policy, problem.solver)
    if has_supports(scene):
        carried = jnp.where(found.stiffness.definite, support_rate(problem.scene_at, state.parameter), 0)
        found = found._replace(response=found.response + carried)
    return found


def _report(problem: Problem, state: Continuation, scene: Scene, attempt: newton.State) -> Report:
    """The report of an attempt; its counts include the earlier attempts at the same target.

    For a target that is given up, the final evaluation is not counted as an attempt, the flags `NONFINITE` and
    `INVALID` of the last attempt are kept, and `reached` is the fraction of the way to the target that was covered.
    """
    spent, counts, given_up = state.spent, attempt.counts, state.given_up
    volume, element = worst_element(scene, attempt.x)
    target, covered = problem.targets[state.target], state.trail.s[0]
    last_flags = jnp.where(given_up, spent.status & (Status.NONFINITE | Status.INVALID), 0)
    return Report(
        x=attempt.x,
        energy=attempt.evaluation.energy,
        residual=attempt.residual,
        correction=attempt.correction,
        smallest_jacobian=volume,
        reached=jnp.where(given_up, covered / jnp.where(target > 0, target, 1), 1),
        steps=spent.steps + counts.steps,
        projected=spent.projected + counts.projected,
        halvings=spent.halvings + counts.halvings,
        attempts=spent.attempts + jnp.where(given_up, 0, 1),
        worst_element=element,
        status=_flags(problem, state, scene, attempt, volume) | last_flags,
    )


def _flags(problem: Problem, state: Continuation, scene: Scene, attempt: newton.State, volume: jax.Array) -> jax.Array:
    """Status flags `()` of an attempt, or-ed; `volume` `()` is the smallest `J`."""
    converged = (attempt.residual <= problem.solver.tolerance(attempt.x.dtype)) & ~state.given_up
    if (inside := surrounded(scene, attempt.x)) is not None:
        # No state to go on from: the obstacle might leave the body on its other side. The state of a target that is
        # given up belongs to other commands, under which the obstacle was elsewhere.
        converged, volume = converged & ~inside, jnp.where(inside & ~state.given_up, -jnp.inf, volume)
    finite = jnp.isfinite(attempt.evaluation.energy) & jnp.all(jnp.isfinite(attempt.evaluation.gradient))
    definite, marginal = attempt.stiffness.definite, attempt.stiffness.marginal
    inaccurate = marginal | attempt.singular | (definite & (attempt.correction > INACCURATE))
    raised = {
        Status.NOT_CONVERGED: ~converged,
        Status.NONFINITE: ~finite,
        # True for a `volume` of NaN too.
        Status.INVERTED: ~(volume > 0),
        Status.UNSTABLE: converged & ~definite & ~marginal,
        Status.INACCURATE: converged & inaccurate,
        Status.INVALID: ~problem.valid[state.target],
    }
    flags, are_raised = jnp.array([int(flag) for flag in raised], jnp.int32), jnp.stack(list(raised.values()))
    return jnp.sum(jnp.where(are_raised, flags, 0), dtype=jnp.int32)


def _judge(
    problem: Problem, state: Continuation, attempt: newton.State, report: Report, max_steps: jax.Array
) -> Verdict:
    """The verdict on an attempt of at most `max_steps` `()` steps.

    A target is given up when the solver's Newton steps or `MAX_ATTEMPTS` are used up, when a parameter of its scene is
    out of range, or when an attempt fails and the increment may not be halved again.
    """
    solver, status = problem.solver, report.status
    converged = (status & (Status.NOT_CONVERGED | Status.NONFINITE | Status.INVALID)) == 0
    unstable = (status & Status.UNSTABLE) != 0
    saddle = converged & unstable & (state.escapes < (MAX_ESCAPES if solver.escape else 0))
    used_up = (report.steps >= solver.max_steps) | (report.attempts >= MAX_ATTEMPTS) | ~problem.valid[state.target]
    may_cut = (state.cuts < MAX_CUTS) & (state.parameter > state.trail.s[0]) & ~used_up
    # An inverted state may come of too long an increment. It counts as failed as long as the increment may be halved,
    # and is accepted only if shorter increments lead to it too.
    inverted = (status & Status.INVERTED) != 0
    # The same holds for a state that uses up the steps of its attempt and is in balance with almost no stiffness left:
    # past a fold Newton's method creeps through such states.
    creeping = (attempt.counts.steps >= max_steps) & (attempt.correction > INACCURATE)
    accepted = converged & ~saddle & ~((inverted | creeping) & may_cut) & ~state.given_up
    landed = accepted & (state.parameter == problem.targets[state.target])
    failed = ~accepted & ~saddle
    return Verdict(accepted, landed, saddle, failed, (~landed & used_up) | (failed & ~may_cut))


def _extend(state: Continuation, attempt: newton.State, verdict: Verdict) -> Trail:
    """The trail, with the state of the attempt added if it is accepted.

    The last Newton step, which was computed but not taken, is added to the positions. It doubles the number of correct
    digits; without it the predictor's polynomial would amplify the error that the residual leaves in them.
    """
    known = attempt.stiffness.definite & jnp.all(jnp.isfinite(attempt.response))
    corrected = attempt.x + jnp.where(known & (attempt.correction <= INACCURATE), attempt.step, 0)
    longer = extend(state.trail, state.parameter, corrected, attempt.response, state.displacement, known)
    return choose(verdict.accepted, longer, state.trail)


def _next_parameter(
    problem: Problem, state: Continuation, verdict: Verdict, report: Report, trail: Trail
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The index of the next target, the parameter of the next attempt, and the increment; each `()`.

    A failed attempt leaves half the distance that it tried. From a saddle the same parameter is tried again.
    """
    shorter = jnp.where(verdict.saddle, state.increment, 0.5 * (state.parameter - trail.s[0]))
    # If one attempt reached the target, the next target is tried in one attempt: the whole path has length 1.
    in_one = verdict.landed & ((report.attempts == 1) | (state.increment <= 0))
    increment = jnp.where(in_one, 1.0, jnp.where(verdict.accepted, 2 * state.increment, shorter)).astype(trail.x.dtype)
    if problem.longest is not None:
        increment = jnp.minimum(increment, problem.longest)
    target = jnp.minimum(state.target + verdict.landed.astype(jnp.int32), len(problem.targets) - 1)
    # Do not stop just short of the target: the increment left would be almost zero.
    to_target = verdict.give_up | (trail.s[0] + 1.01 * increment >= problem.targets[target])
    parameter = jnp.where(to_target, problem.targets[target], trail.s[0] + increment)
    escaping = verdict.saddle & ~verdict.give_up
    return target, jnp.where(escaping, state.parameter, parameter), increment


def _next_start(
    state: Continuation,
    scene: Scene,
    attempt: newton.State,
    verdict: Verdict,
    trail: Trail,
    accepted: jax.Array,
    parameter: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Positions `(n, d)` that the next attempt, at `parameter`, starts from, and the displacement added to them."""
    escaping = verdict.saddle & ~verdict.give_up
    start = jnp.where(escaping, attempt.x, jnp.where(verdict.give_up, accepted, trail.x[0]))
    scale = ESCAPE * extent(scene) / jnp.max(jnp.abs(attempt.response))
    escape = jnp.where(jnp.isfinite(scale), scale * attempt.response, 0)
    predicted = jnp.where(verdict.give_up, 0, predict(trail, parameter))
    return start, jnp.where(escaping, escape, predicted)


def _solutions(problem: Problem, state: Continuation) -> Solution:
    """The solutions at all targets, with leading axis `S`, from the final state of a continuation."""
    scene_at, targets = problem.scene_at, problem.targets
    # Targets after one that was given up get its report.
    row = jnp.minimum(jnp.arange(len(targets), dtype=jnp.int32), state.target)
    path = jax.tree.map(lambda all: all[row], state.path)
    ratios = jax.vmap(lambda s: commands_of(scene_at(s)))(targets)
    crossings = lax.map(lambda x: crossing(scene_at(targets[0]), x), path.x)
    fields = unpack(path)._asdict()
    fields["status"] |= jnp.where(crossings[:, 0, 0] >= 0, int(Status.OVERLAPPING), 0).astype(jnp.int32)
    tolerance = jnp.full(len(ratios), problem.solver.tolerance(path.x.dtype), path.x.dtype)
    return Solution(tolerance=tolerance, crossing=crossings, ratios=ratios, **fields)
