"""Quasistatic equilibrium: what is asked, what is answered, and how far the answer can be trusted.

At equilibrium the gradient of the energy vanishes at every free coordinate. It is stable if the Hessian
there is positive definite. One Newton solve (`jaxbeam.newton`) is an attempt; `follow` makes as many as it
takes to get along a path of scenes, and a single equilibrium is the shortest of paths.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam._tree import Numbers, blank, choose, is_concrete, pytree, replace, unlock
from jaxbeam.held import check_held
from jaxbeam.implicit import follow_scene
from jaxbeam.linear import Layout, expand, gather
from jaxbeam.newton import INACCURATE, Newton, State, correction, newton, no_factor, topology
from jaxbeam.scene import (
    Evaluation,
    Scene,
    energy,
    evaluate,
    is_valid,
    largest_step,
    partway,
    ratios_of,
    smallest_jacobian,
    worst_element,
)


class Status(enum.IntFlag):
    """What is wrong with an answer; `OK` is zero. Flags combine."""

    OK = 0
    NOT_CONVERGED = 1
    NONFINITE = 2
    INVERTED = 4
    UNSTABLE = 8
    INVALID = 16
    INACCURATE = 32


REMEDIES = {
    Status.NOT_CONVERGED: "no equilibrium was reached: approach the command by ramp(scene, ratios, steps) with more "
    "steps, raise Newton.max_steps, or command less; x is the last state that was in balance, not the answer",
    Status.NONFINITE: "energy or forces are not finite: check parameters and x0, which must not invert an element "
    "of a logarithmic material",
    Status.INVERTED: "an element is turned inside out (J <= 0): command less, approach it by ramp, use a finer mesh "
    "or a material that resists it, such as neo_hookean",
    Status.UNSTABLE: "the equilibrium is a saddle, which a real beam leaves: set Newton(escape=True), or start from "
    "x0 = x + a little of lowest_mode(scene, x)",
    Status.INACCURATE: "forces balance to round-off, but that leaves positions uncertain by more than a thousandth of "
    "the body (see correction), or whether the equilibrium is stable: use float64; in float64 the command is at a "
    "limit of stability, such as a fold, where no derivative exists: see lowest_mode",
    Status.INVALID: "a parameter is out of its range (ratios and moduli must be positive, Poisson's ratio in "
    "(-1, 0.5), all finite): build the scene outside jit to be told which",
}


class EquilibriumError(RuntimeError):
    """Raised by `check` for a solution that cannot be trusted; says what is wrong and what to try."""


@pytree
class Solution:
    """An equilibrium and how far to trust it. `ramp` and `sweep` return one with a leading axis.

    x: `(n, 2)` node positions.
    energy: `()` total energy.
    residual: `()` largest unbalanced force on a free coordinate, over the force scale.
    tolerance: `()` what the residual had to reach.
    correction: `()` what one more Newton step would move, over the size of the body: how far round-off leaves
        `x` from the equilibrium, along its softest directions.
    steps: `()` Newton steps taken, all attempts together.
    projected: `()` how many of them used projected Hessians.
    halvings: `()` line-search halvings in all.
    attempts: `()` Newton solves; more than 1 when a first one failed or ended on a saddle.
    smallest_jacobian: `()` smallest `J = det F` over the solids; infinite without one.
    worst_element: `()` the element where it is.
    ratios: `(m,)` commanded ratio of each tendon.
    reached: `()` how far `x` got: 1 at the command itself; less where the way to it broke off, and then `x`
        is the equilibrium at that fraction of the way.
    status: `()` int32 of or-ed `Status` flags; 0 is `OK`.
    """

    x: jax.Array
    energy: jax.Array
    residual: jax.Array
    tolerance: jax.Array
    correction: jax.Array
    steps: jax.Array
    projected: jax.Array
    halvings: jax.Array
    attempts: jax.Array
    smallest_jacobian: jax.Array
    worst_element: jax.Array
    ratios: jax.Array
    reached: jax.Array
    status: jax.Array


def equilibrium(scene: Scene, x0: Numbers | None = None, solver: Newton = Newton()) -> Solution:
    """Node positions at which all forces balance.

    Newton's method starts at `x0`. If it fails, the actuation is approached from rest in steps as small as it
    takes; if it ends on a saddle, it leaves for the stable state beside it (unless `solver.escape` is false).

    `x`, `energy`, `smallest_jacobian` and `ratios` are differentiable in every float of the scene, forward, reverse
    and to any order, by one back-substitution (see `jaxbeam.implicit`); not in `x0`. The derivative is NaN where the
    status is not `OK`, and does not exist at a fold.

    Args:
        scene: what to solve.
        x0: `(n, 2)` start; by default the rest positions. Fixed coordinates are put at rest.
        solver: settings.

    Returns:
        A `Solution`. It never raises for a solve that fails: its `status` says so, and `check` raises.

    Raises:
        ValueError: if `x0` has another shape, or is concrete and not finite or inverts an element, or if a
            piece of the mesh is not held and moves as a rigid body.
    """
    check_held(scene)
    layout = solver.linear.layout(topology(scene))
    open_scene = unlock(scene)
    solution, factor = _equilibrium(*lax.stop_gradient((open_scene, layout, start(scene, x0))), solver)
    if is_concrete(*jax.tree.leaves(scene)):
        return solution
    return differentiable(open_scene, layout, solution, factor, solver)


@partial(jax.jit, static_argnames="solver")
def _equilibrium(scene: Scene, layout: Layout, x: jax.Array, solver: Newton) -> tuple[Solution, Any]:
    path, factor = follow(lambda s: partway(scene, s), layout, x, jnp.ones(1, x.dtype), solver)
    return jax.tree.map(lambda leaf: leaf[0], path), factor


@partial(jax.jit, static_argnames="solver")
def differentiable(scene: Scene, layout: Layout, solution: Solution, factor: Any, solver: Newton) -> Solution:
    """The solution as a function of the scene: `x`, `energy`, `smallest_jacobian` and `ratios` move with it."""
    x = follow_scene(solver.linear, scene, layout, solution.x, factor, solution.status == 0)
    return replace(
        solution, x=x, energy=energy(scene, x), smallest_jacobian=smallest_jacobian(scene, x), ratios=ratios_of(scene)
    )


def check(solution: Solution) -> Solution:
    """The solution itself if its status is `OK` throughout.

    Raises:
        EquilibriumError: otherwise. Says which flags, which members of a batch, residual against
            tolerance, steps, smallest `J` and where, the command, and what to try.
        ValueError: if the solution is traced: statuses have no value inside jit.
    """
    if not is_concrete(solution.status):
        raise ValueError("solution: expected concrete values, got traced ones; call check outside jit, vmap and grad")
    status = np.asarray(solution.status)
    lines = []
    for flag in Status:
        members = np.flatnonzero(status.ravel() & flag)
        if not members.size:
            continue
        where = ""
        if status.ndim:
            shown = ", ".join(str(m) for m in members[:8]) + (", ..." if members.size > 8 else "")
            where = f" in {members.size} of {status.size} members ({shown}), the first of them"
        lines.append(f"{flag.name}{where}: {_describe(solution, members[0])}. {REMEDIES[flag]}.")
    if lines:
        raise EquilibriumError("\n".join(lines))
    return solution


def _describe(solution: Solution, member: int) -> str:
    """The figures of one member of a batch, for an error's text."""

    def of(field: jax.Array, rank: int = 0) -> np.ndarray:
        array = np.asarray(field)
        batch = array.shape[: array.ndim - rank]
        return array[np.unravel_index(member, batch)] if batch else array

    text = (
        f"residual {of(solution.residual):.3g} (tolerance {of(solution.tolerance):.3g}) after {of(solution.steps)} "
        f"Newton steps in {of(solution.attempts)} attempts, smallest J {of(solution.smallest_jacobian):.3g} in element "
        f"{of(solution.worst_element)}"
    )
    ratios = of(solution.ratios, 1)
    if ratios.size:
        text += f", command {[float(f'{r:.6g}') for r in ratios]}"
    if of(solution.reached) < 1:
        text += f", broken off at {of(solution.reached):.4g} of the way to it"
    return text


def start(scene: Scene, x0: Numbers | None) -> jax.Array:
    """`x0` `(n, 2)` in the scene's dtype, with fixed coordinates at rest."""
    rest = scene.mesh.nodes
    if x0 is None:
        return rest
    if np.shape(x0) != rest.shape:
        raise ValueError(f"x0: expected node positions of shape {rest.shape}, got {np.shape(x0)}")
    x = jnp.where(scene.fixed, rest, jnp.asarray(x0, rest.dtype))
    if is_concrete(x0, rest):
        finite = np.isfinite(np.asarray(x0)).all(axis=1)
        if not finite.all():
            node = np.flatnonzero(~finite)[0]
            raise ValueError(f"x0: expected finite positions, got {np.asarray(x0)[node].tolist()} at node {node}")
        volume, element = _worst_element(unlock(scene), x)
        # Inside jit it is traced although all that it is made of is not.
        if is_concrete(volume) and not volume > 0:
            raise ValueError(
                f"x0: element {element} is inverted (J = {float(volume):.3g}); start from rest, or from a "
                f"state in which every J is positive"
            )
    return x


_worst_element = jax.jit(worst_element)


# --------------------------------------------------------------------------------- along a path of scenes

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


class Walk(NamedTuple):
    """Where `follow` stands. The path's parameter is `s`; `x` is the equilibrium found last, at `s`."""

    leg: jax.Array  # index of the target walked to
    s: jax.Array
    x: jax.Array
    factor: Any
    usable: jax.Array  # whether factor is that of a stable tangent at x
    trial: jax.Array  # parameter tried next
    start: jax.Array  # positions it starts from
    increment: jax.Array
    cuts: jax.Array  # failures on the way to this target
    escapes: jax.Array
    spent: Solution  # counters of the attempts at this target so far
    path: Solution
    running: jax.Array


def follow(
    scene_at: Callable[[jax.Array], Scene],
    layout: Layout,
    x: jax.Array,
    targets: jax.Array,
    solver: Newton,
    origin: jax.Array | None = None,
) -> tuple[Solution, Any]:
    """Equilibria of `scene_at(s)` at each of the increasing `targets` `(S,)`, each started from the one before.

    The first attempt goes from `x` straight to the first target. One that fails is made in smaller steps, from
    the last good state (at first: `origin` at `s = 0`, by default the rest positions), along the tangent of the
    branch; steps grow again while they succeed. When they have become too small the walk ends: what remains is reported
    `NOT_CONVERGED`, at the last good state. Returned with them is the factor of the stiffness at the last.
    """
    count = jnp.zeros((), jnp.int32)
    rest = scene_at(targets[0])
    empty = blank(lambda: _report(rest, newton(rest, layout, x, count, count, solver), solver))
    path = jax.tree.map(lambda leaf: jnp.zeros((targets.shape[0], *leaf.shape), leaf.dtype), empty)
    zero, no = jnp.zeros((), x.dtype), jnp.asarray(False)
    noise = jnp.asarray(np.random.default_rng(0).standard_normal(x.shape), x.dtype)
    factor = no_factor(layout, x.dtype, solver)
    origin = rest.mesh.nodes if origin is None else origin
    walk = Walk(count, zero, origin, factor, no, targets[0], x, targets[0], count, count, empty, path, ~no)

    def attempt(walk: Walk) -> Walk:
        scene = scene_at(walk.trial)
        target = targets[walk.leg]
        budget = jnp.minimum(ATTEMPT_STEPS * (1 + walk.cuts), solver.max_steps - walk.spent.steps)
        state = newton(scene, layout, walk.start, budget, jnp.where(walk.usable, FREE_STEPS, 0), solver)
        found = _add_counters(_report(scene, state, solver), walk.spent)
        valid = is_valid(scene_at(target))
        found = replace(found, status=found.status | jnp.where(valid, 0, jnp.int32(Status.INVALID)))
        converged = (found.status & (Status.NOT_CONVERGED | Status.NONFINITE | Status.INVALID)) == 0
        saddle = converged & ~state.definite & ~state.marginal & (walk.escapes < (MAX_ESCAPES if solver.escape else 0))
        spent_out = (found.steps >= solver.max_steps) | (found.attempts >= MAX_ATTEMPTS) | ~valid
        may_cut = (walk.cuts < MAX_CUTS) & (walk.trial > walk.s) & ~spent_out
        # An inverted state may be a jump too far: it is kept only when smaller steps lead there too.
        good = converged & ~saddle & ~((found.smallest_jacobian <= 0) & may_cut)
        landed = good & (walk.trial == target)
        failed = ~good & ~saddle
        over = (~landed & spent_out) | (failed & ~may_cut)

        s, x = choose(good, (walk.trial, state.x), (walk.s, walk.x))
        factor = choose(good, state.factor, walk.factor)
        usable = jnp.where(good, state.definite, walk.usable)
        increment = jnp.where(good, 2 * walk.increment, jnp.where(saddle, walk.increment, 0.5 * (walk.trial - walk.s)))
        # A target reached at once invites to walk straight to the next one.
        easy = landed & ((found.attempts == 1) | (walk.increment <= 0))
        increment = jnp.where(easy, 1.0, increment).astype(x.dtype)
        leg = jnp.minimum(walk.leg + landed.astype(jnp.int32), targets.shape[0] - 1)
        # Landing a hair short of the target would leave a step of no length.
        ahead = jnp.where(over | (s + 1.01 * increment >= targets[leg]), targets[leg], s + increment)
        trial = jnp.where(saddle & ~over, walk.trial, ahead)

        following = scene_at(trial)
        at = evaluate(following, x)
        entry = choose(over, _broken_off(following, found, x, at, s / jnp.where(target > 0, target, 1)), found)
        here = jnp.arange(targets.shape[0], dtype=jnp.int32)
        write = jnp.where(over, here >= walk.leg, landed & (here == walk.leg))
        path = jax.tree.map(lambda all, new: jnp.where(write.reshape(-1, *[1] * new.ndim), new, all), walk.path, entry)

        # From a saddle along its soft modes, as the factor of the Hessian there filters them out of noise; else along
        # the tangent: the forces left unbalanced at x are the increment of the next scene.
        direction = jnp.where(saddle, noise, at.gradient)
        chosen = choose(saddle, state.factor, factor)
        step = expand(layout, -solver.linear.solve(layout, chosen, gather(layout, direction)), x.shape)
        step = jnp.where(saddle, ESCAPE * jnp.max(jnp.abs(x)) / jnp.max(jnp.abs(step)), 1.0) * step
        base = jnp.where(saddle, state.x, x)
        length = jnp.minimum(1.0, largest_step(following, base, step, solver.keep_volume)).astype(x.dtype)
        move = (saddle | usable) & jnp.all(jnp.isfinite(step))
        return Walk(
            leg=leg,
            s=s,
            x=x,
            factor=factor,
            usable=usable,
            trial=trial,
            start=jnp.where(move, base + length * step, base),
            increment=increment,
            cuts=jnp.where(landed & (found.status == 0), 0, walk.cuts + failed.astype(jnp.int32)),
            escapes=jnp.where(good, 0, walk.escapes + saddle.astype(jnp.int32)),
            spent=choose(landed, empty, found),
            path=path,
            running=~over & ~(landed & (walk.leg == targets.shape[0] - 1)),
        )

    walk = lax.while_loop(lambda walk: walk.running, attempt, walk)
    return walk.path, walk.factor


def _report(scene: Scene, state: State, solver: Newton) -> Solution:
    """The `Solution` of one attempt."""
    rtol = solver.tolerance(state.x.dtype)
    converged = state.residual <= rtol
    finite = jnp.isfinite(state.at.energy) & jnp.all(jnp.isfinite(state.at.gradient))
    volume, element = worst_element(scene, state.x)
    left = correction(state.x, state.step)
    raised = {
        Status.NOT_CONVERGED: ~converged,
        Status.NONFINITE: ~finite,
        Status.INVERTED: ~(volume > 0),
        Status.UNSTABLE: converged & ~state.definite & ~state.marginal,
        Status.INACCURATE: converged & (state.marginal | (state.definite & (left > INACCURATE))),
    }
    return Solution(
        x=state.x,
        energy=state.at.energy,
        residual=state.residual,
        tolerance=jnp.full((), rtol, state.x.dtype),
        correction=left,
        steps=state.steps,
        projected=state.projected,
        halvings=state.halvings,
        attempts=jnp.ones((), jnp.int32),
        smallest_jacobian=volume,
        worst_element=element,
        ratios=ratios_of(scene),
        reached=jnp.ones((), state.x.dtype),
        status=sum((jnp.where(up, jnp.int32(flag), 0) for flag, up in raised.items()), jnp.zeros((), jnp.int32)),
    )


def _broken_off(scene: Scene, found: Solution, x: jax.Array, at: Evaluation, reached: jax.Array) -> Solution:
    """The report of a target that was not reached: the last good state `x`, judged by the target's own forces."""
    volume, element = worst_element(scene, x)
    return replace(
        found,
        x=x,
        energy=at.energy,
        residual=jnp.max(jnp.where(scene.fixed, 0, jnp.abs(at.gradient))) / jnp.max(at.gradient_scale),
        smallest_jacobian=volume,
        worst_element=element,
        ratios=ratios_of(scene),
        reached=reached,
        status=(found.status & ~jnp.int32(Status.UNSTABLE | Status.INVERTED))
        | Status.NOT_CONVERGED
        | jnp.where(volume > 0, 0, jnp.int32(Status.INVERTED)),
    )


def _add_counters(found: Solution, spent: Solution) -> Solution:
    names = ("steps", "projected", "halvings", "attempts")
    return replace(found, **{name: getattr(found, name) + getattr(spent, name) for name in names})
