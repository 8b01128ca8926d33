"""Sequential quadratic programming for commands: the search under `reach`.

Of all commands within bounds at which a measure of the equilibrium meets its target, find the one of least effort
(Nocedal and Wright 2006, Numerical Optimization, ch. 18). Slopes and curvatures of the measure come from the implicit
derivative, exact, from the factor of the one solve that each step costs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxbeam.core.compiling import choose, compiled, zeros_like_result
from jaxbeam.core.tree import pytree, replace, unlock
from jaxbeam.linear.layout import Layout
from jaxbeam.scene.scene import Scene, command
from jaxbeam.solve.continuation import follow
from jaxbeam.solve.implicit import attach_derivative
from jaxbeam.solve.newton import Newton
from jaxbeam.solve.predictor import start_trail
from jaxbeam.solve.solution import Solution

Measure = Callable[[Scene, jax.Array], jax.Array]


# The largest change of a ratio in one step, and the change that counts as rest: as steps converge quadratically, the
# answer is within about its square.
RADIUS = 0.3


REST = 1e-6


@pytree
class History:
    """What was tried, in order; NaN (status -1) beyond what was needed.

    theta: `(K, ...)` parameters. loss: `(K,)`. status: `(K,)` of their equilibria; one that is not `OK` was skipped.
    """

    theta: Any
    loss: jax.Array
    status: jax.Array


@pytree
class Problem:
    """What is the same for every target. `low`, `high` `(m,)`."""

    scene: Scene
    layout: Layout
    low: jax.Array
    high: jax.Array
    tolerance: jax.Array


class Stand(NamedTuple):
    """Where a search stands: a command that was solved, the model of the measure there, and the step to try next."""

    theta: jax.Array
    solution: Solution
    miss: jax.Array  # (p,) measure minus target
    slope: jax.Array  # (p, m)
    bend: jax.Array  # (p, m, m)
    drift: jax.Array  # (n, 2, m) derivative of the positions
    funnel: jax.Array  # how far from the target a step may lead that goes away from it
    scale: jax.Array  # largest squared norm of the slope so far
    step: jax.Array
    held: jax.Array
    radius: jax.Array
    seen: jax.Array  # (m,) commands of which an effect was seen, or that were shortened as far as they go
    probing: jax.Array  # the step looks for an effect of those that have none
    solves: jax.Array
    resting: jax.Array
    history: History


@compiled("solver")
def approach(
    scene: Scene, layout: Layout, before: jax.Array, theta: jax.Array, x: jax.Array, ahead: jax.Array, solver: Newton
) -> tuple[Solution, Any]:
    """The equilibrium of the command `theta`, from `x` in equilibrium at `before`, and its factor.

    The first attempt starts at `x + ahead`, or as far along as no element inverts. A jitted function of its own, so
    that it is traced once however often it is used.
    """
    way = lambda s: command(scene, (1 - s) * before + s * theta)
    path, factor, _ = follow(way, layout, start_trail(x, ahead), jnp.ones(1, x.dtype), solver)
    return jax.tree.map(lambda leaf: leaf[0], path), factor


def search(
    problem: Problem,
    target: jax.Array,
    theta: jax.Array,
    step: jax.Array,
    x: jax.Array,
    measure: Measure,
    max_solves: int,
    solver: Newton,
) -> Stand:
    """Sequential quadratic programming from the command `theta + step`, which is approached from `theta`, in
    equilibrium at `x`.

    A command that has no effect, to first or second order, may have one elsewhere: a tendon that is slack, or a measure
    that is flat. Where the search would end short of the target, such commands are shortened until an effect is seen.
    """
    goal, dtype, m = jnp.ravel(target), x.dtype, theta.size
    p = goal.size

    def look(at: Stand) -> Stand:
        """Solve the command that is tried next. Slopes and bends come from the factor of that solve."""
        theta = jnp.clip(at.theta + at.step, problem.low, problem.high)
        x, ahead = at.solution.x, at.drift @ (theta - at.theta)
        solution, factor = approach(unlock(problem.scene), problem.layout, at.theta, theta, x, ahead, solver)

        def outcome(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
            scene = command(problem.scene, theta)
            x = attach_derivative(
                solver.linear, unlock(scene), problem.layout, solution.x, factor, solution.status == 0
            )
            return jnp.ravel(measure(scene, x)) - goal, x

        slopes = jax.jacfwd(outcome)
        slope, drift = slopes(theta)
        bend = jax.jacfwd(lambda theta: slopes(theta)[0])(theta)
        return at._replace(theta=theta, solution=solution, miss=outcome(theta)[0], slope=slope, bend=bend, drift=drift)

    def body(at: Stand) -> Stand:
        first, new = at.solves == 0, look(at)
        theta, miss = new.theta, new.miss
        good = (new.solution.status == 0) & jnp.all(jnp.isfinite(new.bend)) & jnp.all(jnp.isfinite(new.slope))
        # Where commands have no effect there is nothing to follow: what they were shortened to is a start like any.
        first |= at.probing
        # Nearer to the target, or no farther than solves can tell; or cheaper, and not too far from it, which is
        # allowed less and less.
        far, before = jnp.linalg.norm(miss), jnp.linalg.norm(at.miss)
        nearer = far <= before + 0.1 * problem.tolerance
        cheaper = (far <= at.funnel) & (jnp.sum((1 - theta) ** 2) < jnp.sum((1 - at.theta) ** 2))
        # Where all commands had an effect somewhere, one at which none has any is a step too far.
        lost = jnp.all(at.seen) & jnp.any(effects(at, goal)) & ~jnp.any(effects(new, goal))
        lost &= jnp.max(jnp.abs(miss)) > problem.tolerance
        taken = good & (first | nearer | cheaper) & ~lost
        funnel = jnp.where(first, 0.1 * far, jnp.where(taken & ~nearer, 0.5 * at.funnel, at.funnel))
        here = choose(taken, new, at)
        scale = jnp.maximum(at.scale, jnp.where(taken, jnp.sum(new.slope**2), 0))
        radius = jnp.where(taken, jnp.minimum(RADIUS, 4 * at.radius), 0.25 * jnp.max(jnp.abs(at.step)))
        step, held = _program(here, problem, scale, radius)
        entry = History(theta, far, new.solution.status)
        near = jnp.max(jnp.abs(here.miss)) <= problem.tolerance
        still = jnp.max(jnp.abs(here.slope @ step)) <= 0.5 * problem.tolerance
        rest = (jnp.max(jnp.abs(step)) <= REST) & (radius > 10 * REST) & (near | still)
        room = here.theta - problem.low
        seen = at.seen | (taken & effects(here, goal)) | (room <= REST)
        probing = (rest | at.probing) & ~near & jnp.any(~seen)
        step = jnp.where(probing, jnp.where(seen, 0, -jnp.minimum(room, radius)), step)
        return here._replace(
            funnel=funnel,
            scale=scale,
            step=step,
            held=held,
            radius=radius,
            seen=seen,
            probing=probing,
            solves=at.solves + 1,
            resting=rest & ~probing,
            history=jax.tree.map(lambda all, one: all.at[at.solves].set(one), at.history, entry),
        )

    zeros = lambda *shape: jnp.zeros(shape, dtype)
    nothing = zeros_like_result(
        lambda: approach(unlock(problem.scene), problem.layout, theta, theta, x, zeros(*x.shape), solver)[0]
    )
    begin = Stand(
        theta=theta,
        solution=replace(nothing, x=x),
        miss=jnp.full(p, jnp.inf, dtype),
        slope=zeros(p, m),
        bend=zeros(p, m, m),
        drift=zeros(*x.shape, m),
        funnel=zeros(),
        scale=zeros(),
        step=step,
        held=jnp.zeros(m, jnp.int32),
        radius=jnp.asarray(RADIUS, dtype),
        seen=jnp.zeros(m, bool),
        probing=jnp.asarray(False),
        solves=jnp.zeros((), jnp.int32),
        resting=jnp.asarray(False),
        history=History(
            theta=jnp.full((max_solves, m), jnp.nan, dtype),
            loss=jnp.full(max_solves, jnp.nan, dtype),
            status=jnp.full(max_solves, -1, jnp.int32),
        ),
    )
    going = lambda at: (
        ~at.resting
        & (at.solves < max_solves)
        & (at.radius > REST * 1e-3)
        & ((at.solves == 0) | jnp.all(jnp.isfinite(at.miss)))
    )
    return lax.while_loop(going, body, begin)


def effects(at: Stand, goal: jax.Array) -> jax.Array:
    """Which commands `(m,)` have an effect on the measure, to first or second order: more than its round-off."""
    round_off = jnp.finfo(at.theta.dtype).eps * (jnp.abs(goal) + jnp.abs(at.miss))
    bends = jnp.max(jnp.abs(at.bend), axis=2)
    return jnp.any(jnp.maximum(jnp.abs(at.slope), bends) > round_off[:, None], axis=0)


def _program(at: Stand, problem: Problem, scale: jax.Array, radius: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The step of least effort that takes the linearised measure to its target, within bounds and radius.

    Minimises `1/2 s^T A s + (theta - 1)^T s + |slope s + miss|^2 / (2 soft)` over a box by an active set: bounds that
    are overstepped are taken up, the worst first, and those that pull the wrong way are let go. The last term is
    so steep that it is a constraint where that can be met. Its quasi-definite system (Vanderbei 1995) has a
    solution also where it cannot, and where the slope vanishes. Returns the step and the bounds that hold.
    """
    soft = jnp.finfo(at.theta.dtype).eps ** 0.75 * jnp.where(scale > 0, scale, 1)
    low = jnp.maximum(problem.low - at.theta, -radius)
    high = jnp.minimum(problem.high - at.theta, radius)
    # Multipliers that balance the effort of the free commands; and those of a target that stays out of reach.
    free = jnp.where(at.held == 0, at.slope, 0)
    gram = free @ free.T + soft * jnp.eye(at.miss.size, dtype=soft.dtype)
    prices = jnp.stack([jnp.linalg.solve(gram, free @ (1 - at.theta)), at.miss / soft])
    curvatures = jnp.einsum("qp,pij->qij", prices, at.bend)
    steep = 10 * jnp.linalg.norm(curvatures[0]) / jnp.maximum(jnp.sum(at.slope**2), soft)
    weights = jnp.stack([steep, 1 / soft])
    steps, helds = lax.map(lambda each: _box_program(at, each[0], each[1], low, high, soft), (curvatures, weights))
    left = jnp.linalg.norm(at.slope @ steps[0] + at.miss)
    best = jnp.where(left <= 0.5 * jnp.linalg.norm(at.miss), 0, 1)
    step, held = steps[best], helds[best]
    # A command held by the radius alone is not held by a bound.
    bounded = jnp.where(held < 0, problem.low - at.theta >= -radius, problem.high - at.theta <= radius)
    return step, jnp.where(bounded, held, 0)


def _box_program(
    at: Stand, curvature: jax.Array, weight: jax.Array, low: jax.Array, high: jax.Array, soft: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Step and active bounds of the quadratic program with a `curvature` `(m, m)` beside that of the effort.

    What must be convex is their sum with `weight` times the squared slope, over the commands that no bound held last:
    the target takes care of the rest.
    """
    m, p, dtype = at.theta.size, at.miss.size, at.theta.dtype
    free = at.held == 0
    square = weight * jnp.where(free[:, None] & free, at.slope.T @ at.slope, 0)
    whole = jnp.eye(m, dtype=dtype) + jnp.where(free[:, None] & free, curvature, 0) + square
    values, vectors = jnp.linalg.eigh(whole)
    convex = (vectors * jnp.maximum(jnp.abs(values), 0.01)) @ vectors.T - square
    matrix = jnp.block([[convex, at.slope.T], [at.slope, -soft * jnp.eye(p, dtype=dtype)]])
    rhs = jnp.concatenate([1 - at.theta, -at.miss])

    def solve(held: jax.Array) -> jax.Array:
        fixed = jnp.append(held != 0, jnp.zeros(p, bool))
        bound = jnp.append(jnp.where(held < 0, low, high), jnp.zeros(p, dtype))
        rows = jnp.where(fixed[:, None], jnp.eye(m + p, dtype=dtype), matrix)
        return jnp.linalg.solve(rows, jnp.where(fixed, bound, rhs))

    def improve(carry: Any) -> Any:
        held, turns, _ = carry
        both = solve(held)
        step = both[:m]
        over = jnp.where(held == 0, jnp.maximum(step - high, low - step), 0)
        # What the bound has to push with: negative where it would have to pull.
        push = jnp.where(held == 0, 0, -held * (matrix[:m] @ both - rhs[:m]))
        worst, wrong = jnp.argmax(over), jnp.argmin(push)
        slack = 16 * jnp.finfo(dtype).eps
        take, drop = over[worst] > slack, push[wrong] < -slack * (jnp.abs(matrix[wrong]) @ jnp.abs(both) + 1)
        side = jnp.where(step[worst] > high[worst], 1, -1).astype(jnp.int32)
        taken = held.at[worst].set(side)
        dropped = held.at[wrong].set(0)
        return jnp.where(take, taken, jnp.where(drop, dropped, held)), turns + 1, take | drop

    begin = (jnp.zeros(m, jnp.int32), jnp.zeros((), jnp.int32), jnp.asarray(True))
    held, _, _ = lax.while_loop(lambda c: c[2] & (c[1] < 6 * m + 6), improve, begin)
    step = jnp.clip(solve(held)[:m], low, high)
    return jnp.where(held == 0, step, jnp.where(held < 0, low, high)), held
