"""Along a path of scenes: as many Newton solves as it takes to get from one target to the next.

A single equilibrium is the shortest of paths. One compiled program holds one Newton loop, whatever happens on the way.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core.compiling import choose
from jaxbeam.linear.layout import Layout
from jaxbeam.scene.overlap import crossing
from jaxbeam.scene.scene import Scene, commands_of, energy, extent, is_valid, worst_element
from jaxbeam.solve.newton import HALVINGS, INACCURATE, PROJECTED, STEPS, Newton, State, newton, no_factor
from jaxbeam.solve.predictor import Trail, ahead, extend
from jaxbeam.solve.solution import Solution, Status

# Newton steps that the first attempt at a target may take: beyond this a shorter way is quicker. Each failure allows
# the next as many more, for past a fold no way is short enough.
ATTEMPT_STEPS = 60


# Full steps at the beginning of an attempt from a predicted start, which need not lower the energy: beside a stiff
# tendon the way down is a curved valley, and a search for lower energy crawls along it.
FREE_STEPS = 8


# Times that the way to a target is halved before it is given up, and saddles are left before one is kept.
MAX_CUTS = 20


MAX_ESCAPES = 4


# How far a saddle is left at first, over the size of the body.
ESCAPE = 1e-3


# Attempts at one target, whatever they cost.
MAX_ATTEMPTS = 100


# What `Report.numbers` and `Report.counts` hold, in this order.
NUMBERS = ("energy", "residual", "correction", "smallest_jacobian", "reached")


COUNTS = ("steps", "projected", "halvings", "attempts", "worst_element", "status")


class Report(NamedTuple):
    """What is kept of an attempt: a `Solution` in few arrays, which make a small program."""

    x: jax.Array
    numbers: jax.Array
    counts: jax.Array


class Walk(NamedTuple):
    """Where `follow` stands. The path's parameter is `s`; `trail` ends with the equilibrium found last."""

    leg: jax.Array  # index of the target walked to
    trail: Trail
    kept: jax.Array  # positions of that equilibrium as they were solved for, where `trail` has it a step ahead
    trial: jax.Array  # parameter tried next
    start: jax.Array  # positions it starts from, and the way ahead of them
    way: jax.Array
    factor: Any  # of the last attempt
    increment: jax.Array
    cuts: jax.Array  # failures on the way to this target
    escapes: jax.Array
    spent: jax.Array  # counts of the attempts at this target so far, and the last one's status
    path: Report
    over: jax.Array  # given up: what is left is to judge the last good state by the target's forces
    running: jax.Array


def follow(
    scene_at: Callable[[jax.Array], Scene],
    layout: Layout,
    trail: Trail,
    targets: jax.Array,
    solver: Newton,
    x: jax.Array | None = None,
    way: jax.Array | None = None,
) -> tuple[Solution, Any, Trail]:
    """Equilibria of `scene_at(s)` at each of the increasing `targets` `(S,)`, each started from the one before.

    The first attempt goes straight to the first target: from `x`, or else from the end of `trail` and `way` ahead of
    it, by default along its tangent. One that fails is made in smaller steps, from the last good state (at first: the
    newest of `trail`, at `s = 0`), along the branch as it was so far; steps grow again while they succeed. When they
    have become too small the walk ends: what remains is reported `NOT_CONVERGED`, at the last good state. Returned with
    them are the factor of the stiffness at the last, and the trail that ends there.
    """
    last, rest = targets.shape[0] - 1, trail.x[0]
    count, zero, no = jnp.zeros((), jnp.int32), jnp.zeros((), rest.dtype), jnp.asarray(False)
    noise = np.random.default_rng(0).standard_normal(rest.shape).astype(rest.dtype)
    valid = jax.vmap(lambda s: is_valid(scene_at(s)))(targets)
    blank_path = lambda *shape, dtype: jnp.zeros((last + 1, *shape), dtype)
    path = Report(
        x=blank_path(*rest.shape, dtype=rest.dtype),
        numbers=blank_path(len(NUMBERS), dtype=rest.dtype),
        counts=blank_path(len(COUNTS), dtype=jnp.int32),
    )

    walk = Walk(
        leg=count,
        trail=trail,
        kept=rest,
        trial=targets[0],
        start=rest if x is None else x,
        way=jnp.where((trail.depth > 0) & (x is None), targets[0] * trail.slope[0], 0) if way is None else way,
        factor=no_factor(layout, rest.dtype, solver),
        increment=targets[0],
        cuts=count,
        escapes=count,
        spent=jnp.zeros(len(COUNTS), jnp.int32),
        path=path,
        over=no,
        running=~no,
    )

    def attempt(walk: Walk) -> Walk:
        trail, target, sound = walk.trail, targets[walk.leg], valid[walk.leg]
        scene = scene_at(walk.trial)
        budget = jnp.minimum(ATTEMPT_STEPS * (1 + walk.cuts), solver.max_steps - walk.spent[0])
        slope_at = lambda s, x: jax.grad(energy, argnums=1)(scene_at(s), x)
        rate = lambda x: jax.jvp(lambda s: slope_at(s, x), (walk.trial,), (zero + 1,))[1]
        # What gives the tangent of the branch; at a saddle its soft modes, which the factor there filters out of noise.
        probe = lambda x, definite: jnp.where(definite, rate(x), noise)
        free = jnp.where(trail.depth > 0, FREE_STEPS, 0)
        passing = walk.trial < targets[-1] if last else None
        allowed = jnp.where(walk.over, 0, budget)
        leaving = walk.escapes > 0
        state = newton(scene, layout, walk.start, walk.way, allowed, free, passing, leaving, probe, solver)
        numbers, counts = _report(scene, state, walk.spent, walk.over, sound, solver)
        attempts, status = counts[3], counts[-1]
        good, saddle, spent_out, may_cut = _judged(walk, state, counts, budget, sound, solver)
        landed = good & (walk.trial == target)
        failed = ~good & ~saddle
        over = (~landed & spent_out) | (failed & ~may_cut)

        known = state.stiffness.definite & jnp.all(jnp.isfinite(state.aside))
        # The step that is not taken any more still tells where the branch lies, to twice as many digits as `rtol` asks
        # for: a polynomial continued from there does not blow up what was left unbalanced.
        settled = state.x + jnp.where(known & (state.correction <= INACCURATE), state.step, 0)
        trail = choose(good, extend(trail, walk.trial, settled, state.aside, walk.way, known), trail)
        kept = jnp.where(good, state.x, walk.kept)
        cut = jnp.where(saddle, walk.increment, 0.5 * (walk.trial - trail.s[0]))
        # A target reached at once invites to walk straight to the next one.
        easy = landed & ((attempts == 1) | (walk.increment <= 0))
        increment = jnp.where(easy, 1.0, jnp.where(good, 2 * walk.increment, cut)).astype(rest.dtype)
        leg = jnp.minimum(walk.leg + landed.astype(jnp.int32), last)
        # Landing a hair short of the target would leave a step of no length.
        onward = trail.s[0] + increment
        far = over | (trail.s[0] + 1.01 * increment >= targets[leg])
        leave = saddle & ~over
        trial = jnp.where(leave, walk.trial, jnp.where(far, targets[leg], onward))
        off = ESCAPE * extent(scene) / jnp.max(jnp.abs(state.aside))
        way = jnp.where(
            leave, jnp.where(jnp.isfinite(off), off * state.aside, 0), jnp.where(over, 0, ahead(trail, trial))
        )

        # A target given up: where that is, as judged by the target's own forces.
        reached = trail.s[0] / jnp.where(target > 0, target, 1)
        entry = Report(state.x, jnp.append(numbers, jnp.where(walk.over, reached, 1)), counts)
        written = landed | walk.over
        path = jax.tree.map(
            lambda all, new: all.at[walk.leg].set(jnp.where(written, new, all[walk.leg])), walk.path, entry
        )
        return Walk(
            leg=leg,
            trail=trail,
            kept=kept,
            trial=trial,
            start=jnp.where(leave, state.x, jnp.where(over, kept, trail.x[0])),
            way=way,
            factor=state.stiffness.factor,
            increment=increment,
            cuts=jnp.where(landed & (status == 0), 0, walk.cuts + failed.astype(jnp.int32)),
            escapes=jnp.where(good, 0, walk.escapes + saddle.astype(jnp.int32)),
            spent=jnp.where(landed, 0, counts),
            path=path,
            over=over,
            running=~walk.over & ~(landed & (walk.leg == last)),
        )

    walk = lax.while_loop(lambda walk: walk.running, attempt, walk)
    # Where the walk ended before the last target, the targets after it are given up in the same state.
    row = jnp.minimum(jnp.arange(last + 1, dtype=jnp.int32), walk.leg)
    path = jax.tree.map(lambda all: all[row], walk.path)
    ratios = jax.vmap(lambda s: commands_of(scene_at(s)))(targets)
    crossed = lax.map(lambda x: crossing(scene_at(targets[0]), x), path.x)
    return _solutions(path, ratios, crossed, solver), walk.factor, walk.trail


class Verdict(NamedTuple):
    """What to make of an attempt: whether its state is `good` to go on from, or a `saddle` to leave; whether all that
    may be spent on the target is, and whether the way may be cut."""

    good: jax.Array
    saddle: jax.Array
    spent_out: jax.Array
    may_cut: jax.Array


def _judged(
    walk: Walk, state: State, counts: jax.Array, budget: jax.Array, sound: jax.Array, solver: Newton
) -> Verdict:
    """The verdict on an attempt of at most `budget` steps, by the `counts` of its report."""
    steps, attempts, status = counts[0], counts[3], counts[-1]
    converged = (status & (Status.NOT_CONVERGED | Status.NONFINITE | Status.INVALID)) == 0
    unstable = (status & Status.UNSTABLE) != 0
    saddle = converged & unstable & (walk.escapes < (MAX_ESCAPES if solver.escape else 0))
    spent_out = (steps >= solver.max_steps) | (attempts >= MAX_ATTEMPTS) | ~sound
    may_cut = (walk.cuts < MAX_CUTS) & (walk.trial > walk.trail.s[0]) & ~spent_out
    # An inverted state may be a jump too far: it is kept only when smaller steps lead there too.
    inverted = (status & Status.INVERTED) != 0
    # So may one that balances with next to no stiffness left, where steps ran out: past a fold a beam creeps by it.
    creeping = (state.counts[STEPS] >= budget) & (state.correction > INACCURATE)
    good = converged & ~saddle & ~((inverted | creeping) & may_cut) & ~walk.over
    return Verdict(good, saddle, spent_out, may_cut)


def _report(
    scene: Scene, state: State, spent: jax.Array, judging: jax.Array, sound: jax.Array, solver: Newton
) -> tuple[jax.Array, jax.Array]:
    """Numbers, without the last, and counts of one attempt, beside what others at the same target `spent`.

    One that is only `judging` the state of a target given up adds no attempt, and keeps what the last one was flagged.
    """
    converged = (state.residual <= solver.tolerance(state.x.dtype)) & ~judging
    finite = jnp.isfinite(state.at.energy) & jnp.all(jnp.isfinite(state.at.gradient))
    volume, element = worst_element(scene, state.x)
    left = state.correction
    vague = state.stiffness.marginal | (state.stiffness.definite & ((left > INACCURATE) | state.singular))
    raised = {
        Status.NOT_CONVERGED: ~converged,
        Status.NONFINITE: ~finite,
        Status.INVERTED: ~(volume > 0),
        Status.UNSTABLE: converged & ~state.stiffness.definite & ~state.stiffness.marginal,
        Status.INACCURATE: converged & vague,
        Status.INVALID: ~sound,
    }
    flags, up = jnp.array([int(flag) for flag in raised], jnp.int32), jnp.stack(list(raised.values()))
    blame = jnp.where(judging, spent[-1] & (Status.NONFINITE | Status.INVALID), 0)
    status = jnp.sum(jnp.where(up, flags, 0), dtype=jnp.int32) | blame
    own = [state.counts[STEPS], state.counts[PROJECTED], state.counts[HALVINGS], jnp.where(judging, 0, 1)]
    done = jnp.stack(own, dtype=jnp.int32)
    numbers = jnp.stack([state.at.energy, state.residual, left, volume])
    return numbers, jnp.concatenate([spent[:4] + done, jnp.stack([element, status], dtype=jnp.int32)])


def _solutions(path: Report, ratios: jax.Array, crossed: jax.Array, solver: Newton) -> Solution:
    """The solutions, with leading axis, of a path of reports, with the edges `(S, 2, 2)` that cross in each."""
    tolerance = jnp.full(len(ratios), solver.tolerance(path.x.dtype), path.x.dtype)
    numbers = {name: path.numbers[:, k] for k, name in enumerate(NUMBERS)}
    counts = {name: path.counts[:, k] for k, name in enumerate(COUNTS)}
    counts["status"] |= jnp.where(crossed[:, 0, 0] >= 0, int(Status.OVERLAPPING), 0).astype(jnp.int32)
    return Solution(x=path.x, tolerance=tolerance, crossing=crossed, ratios=ratios, **numbers, **counts)
