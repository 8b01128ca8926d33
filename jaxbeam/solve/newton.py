"""Newton's method for the unknown node positions of one scene, inside jit.

`Newton` holds its settings, and the defaults are for all scenes. Change `escape` to keep a saddle, `max_steps` where a
solve runs out of them, and `rtol` where a rougher answer will do.

A step solves `K dx = -g`, with the gradient `g` of the energy and a positive definite stiffness `K`
(`jaxbeam.solve.stiffness`), and is shortened by a line search (`jaxbeam.solve.line_search`). The iteration ends when
the relative residual (`jaxbeam.solve.residual`) is small. At a solution the Cholesky factor of the true Hessian exists
if and only if the equilibrium is stable.

A straight step stretches what it turns. So the energy rises, and the step is cut where nothing else is wrong with it.
Long steps are therefore bent, where `K` is the true Hessian. They follow the Newton path `g(x(t)) = (1 - t) g(x)`, on
which all unbalanced forces fall alike (Deuflhard 2004, Newton Methods for Nonlinear Problems, section 3.1.4), to
second order: `x(t) = x + t dx + t^2 c` with `K c = -1/2 D^3 E[dx, dx]`. A full one is a step of Chebyshev's method, of
third order.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxbeam.core import checks
from jaxbeam.core.compiling import compute_if
from jaxbeam.core.tree import key_of
from jaxbeam.linear.blocks import Topology
from jaxbeam.linear.layout import Layout, LinearSolver, expand, gather
from jaxbeam.linear.tridiagonal import BlockTridiagonal
from jaxbeam.scene.evaluation import Evaluation, evaluate, second_change
from jaxbeam.scene.scene import Scene, check_scene, extent, has_supports, places
from jaxbeam.solve.line_search import line_search
from jaxbeam.solve.residual import force_round_off, force_scale, relative_residual
from jaxbeam.solve.stiffness import Stiffness, factorise, is_singular, zero_factor

# A step shorter than this, over the size of the body, changes the stiffness of the softest mode by as small a fraction,
# so the factor may be reused.
NEAR = 1e-6

# Steps that move a node by more than this, over the size of the body, are bent. Shorter ones gain nothing by it.
BENT = 1e-4

# A solution is inaccurate if one more step would move a node by more than this, over the size of the body. Up to
# `POLISH` steps are spent on making it accurate.
INACCURATE = 1e-3
POLISH = 10


@dataclasses.dataclass(frozen=True)
class Newton:
    """Settings of the equilibrium solver. Hashable; other settings compile the solver anew.

    max_steps: most Newton steps for one equilibrium, all attempts at it together.
    rtol: relative residual to reach; by default 1e-10 in float64 and 1e-6 in float32.
    linear: the linear solver, `BlockTridiagonal()` or, for tiny scenes, `Dense()`.
    keep_volume: fraction of its `J` that every element keeps in one step. So no element inverts within a step, and
        logarithmic energies stay finite. Elements of small `J` are exempt where their energy allows inversion.
    escape: leave a saddle along a soft mode for the stable equilibrium beside it. If false, the saddle is returned,
        flagged `UNSTABLE`.
    """

    max_steps: int = 2000
    rtol: float | None = None
    linear: LinearSolver = BlockTridiagonal()
    keep_volume: float = 0.1
    escape: bool = True

    def __post_init__(self) -> None:
        checks.count("max_steps", self.max_steps, 0)
        if self.rtol is not None:
            checks.setting("rtol", self.rtol, checks.SHARE)
        checks.setting("keep_volume", self.keep_volume, checks.SHARE)
        checks.flag("escape", self.escape)
        check_linear("linear", self.linear)

    def tolerance(self, dtype: Any) -> float:
        """The relative residual to reach in this dtype."""
        if self.rtol is not None:
            return self.rtol
        return 1e-10 if jnp.finfo(dtype).eps < 1e-10 else 1e-6


def check_linear(name: str, linear: Any) -> None:
    """Refuse what is not a linear solver."""
    if isinstance(linear, type) or not callable(getattr(linear, "factor_indefinite", None)):
        raise ValueError(f"{name}: expected a linear solver, such as BlockTridiagonal() or Dense(), got {linear!r}")


def check_scene_and_solver(scene: Scene, solver: Newton) -> None:
    """Refuse what is not a scene to solve, or not a solver."""
    check_scene(scene)
    checks.instance("solver", solver, Newton, "make one with Newton(...)")


def topology(scene: Scene) -> Topology:
    """The structure of a scene, on which the layout of its matrix depends."""
    nodes = tuple(key_of(term, "nodes") for term in scene.terms)
    return Topology(key_of(scene.mesh, "elements"), key_of(scene, "held"), nodes)


# --------------------------------------------------------------------------------- data of the method


class Policy(NamedTuple):
    """What one run of Newton's method is allowed to do, and a second right-hand side that it solves for.

    max_steps: `()` most steps of the run.
    full_steps: `()` number of first steps that may raise the energy while the true Hessian is positive definite.
    reuse_factor: `()` whether a state in balance reuses the last factor if the step to it was shorter than `NEAR`. Most
        intermediate states of a ramp end with such a step, and reuse saves them half the work. None: never, and nothing
        is traced for it.
    leaving_saddle: `()` whether the run starts beside a saddle. Then shifts of the stiffness are tried before
        projections.
    probe: function `(x, definite)` that returns a second right-hand side `(n, d)` at positions `x`; `definite` `()`
        tells whether the true Hessian is positive definite there. It costs almost nothing beside the first.
    """

    max_steps: jax.Array
    full_steps: jax.Array | int
    reuse_factor: jax.Array | None
    leaving_saddle: jax.Array
    probe: Callable[[jax.Array, jax.Array], jax.Array]


class Counts(NamedTuple):
    """Counts of one run of Newton's method so far; each an int32 `()`.

    steps: steps taken.
    projected: steps taken with a modified stiffness.
    halvings: halvings of the line search, all steps together.
    polished: steps ordered for accuracy alone, in states that are in balance.
    """

    steps: jax.Array
    projected: jax.Array
    halvings: jax.Array
    polished: jax.Array


class State(NamedTuple):
    """State of Newton's method.

    x: `(n, d)` positions.
    evaluation: energy and gradient at `x`.
    stiffness: stiffness at `x`, or where the last step began if its factor was reused.
    step: `(n, d)` the step to take next.
    bend: `(n, d)` second-order term of the way there; zero for a straight step.
    response: `(n, d)` solution of `K response = -probe` at `x`.
    correction: `()` largest component of `step`, over the size of the body.
    singular: `()` whether the lowest eigenvalue of the stiffness is within round-off of zero. Known at the end only.
    residual: `()` relative residual at `x`.
    counts: counts of the run so far.
    initial: `()` whether `step` is the displacement to the start of the method, which is not counted as a step.
    running: `()` whether another step is to be taken.
    """

    x: jax.Array
    evaluation: Evaluation
    stiffness: Stiffness
    step: jax.Array
    bend: jax.Array
    response: jax.Array
    correction: jax.Array
    singular: jax.Array
    residual: jax.Array
    counts: Counts
    initial: jax.Array
    running: jax.Array


class Problem(NamedTuple):
    """The inputs of one run, which do not change.

    scene: the scene to solve, with unlocked indices.
    layout: layout of the stiffness matrix.
    policy: what the run is allowed to do.
    solver: settings.
    size: `()` size of the body.
    places: `(n, d)` where held coordinates are to be, if there are supports; else None.
    """

    scene: Scene
    layout: Layout
    policy: Policy
    solver: Newton
    size: jax.Array
    places: jax.Array | None


# --------------------------------------------------------------------------------- init, step, terminate


def newton(
    scene: Scene, layout: Layout, x: jax.Array, displacement: jax.Array, policy: Policy, solver: Newton
) -> State:
    """Newton's method from `x + displacement`; to be called inside jit.

    If an element would invert on the way there, the method starts at a shorter displacement.

    Args:
        scene: the scene to solve, with unlocked indices.
        layout: layout of the stiffness matrix.
        x: `(n, d)` positions without an inverted element.
        displacement: `(n, d)` from `x` to the start.
        policy: what the run is allowed to do.
        solver: settings.

    Returns:
        The final state. `running` is false; the residual tells whether the method converged.
    """
    problem = Problem(scene, layout, policy, solver, extent(scene), places(scene) if has_supports(scene) else None)
    begin = init(problem, x, displacement)
    end = lax.while_loop(lambda state: state.running, partial(step, problem), begin)
    return end._replace(singular=is_singular(scene, layout, end.x, problem.size, end.stiffness, solver.linear))


def init(problem: Problem, x: jax.Array, displacement: jax.Array) -> State:
    """The state before the initial `displacement` is taken. Nothing is evaluated yet."""
    zero, zeros, yes = jnp.zeros((), x.dtype), jnp.zeros_like(x), jnp.asarray(True)
    none = jnp.zeros((), jnp.int32)
    factor = zero_factor(problem.layout, x.dtype, problem.solver.linear)
    return State(
        x=x,
        evaluation=Evaluation(zero, zero, zeros, zeros),
        stiffness=Stiffness(factor, yes, ~yes, ~yes, zero, zero, zeros),
        step=displacement,
        bend=zeros,
        response=zeros,
        correction=zero,
        singular=~yes,
        residual=jnp.asarray(jnp.inf, x.dtype),
        counts=Counts(none, none, none, none),
        initial=yes,
        running=yes,
    )


def step(problem: Problem, state: State) -> State:
    """Take the pending step, evaluate the stiffness where it ends, and solve for the next one."""
    scene, policy, solver = problem.scene, problem.policy, problem.solver
    rtol = solver.tolerance(state.x.dtype)
    full = state.initial | (state.stiffness.definite & (state.counts.steps < policy.full_steps))
    # A step that moves supports does work, so it may raise the energy.
    forced = state.initial if problem.places is None else state.initial | jnp.any(_gap(problem, state.x) != 0)
    x, evaluation, halvings, moved = line_search(
        scene, state.x, state.evaluation, state.step, state.bend, forced, full, solver.keep_volume
    )
    if problem.places is not None:
        x = jnp.where(scene.held & (_gap(problem, x) == 0), problem.places, x)
    unbalanced = jnp.max(jnp.abs(jnp.where(scene.held, 0, evaluation.gradient)))
    allowed = rtol * force_scale(scene, evaluation)
    balanced = unbalanced <= allowed

    reuse, renew = _reuse(problem, state, balanced)
    stiffness_at = lambda x, unbalanced, allowed: factorise(
        scene, problem.layout, x, problem.size, unbalanced, allowed, policy.leaving_saddle, solver.linear
    )
    stiffness = compute_if(renew, stiffness_at, state.stiffness, x, unbalanced, allowed)
    residual = relative_residual(scene, evaluation, force_round_off(stiffness.rows, x), rtol)
    if problem.places is not None:
        gap = jnp.max(jnp.abs(_gap(problem, x))) / problem.size
        residual = jnp.maximum(residual, jnp.where(gap > 0, gap + 2 * rtol, 0))
    next_step, response = _solve(problem, state, x, evaluation, stiffness, reuse)
    correction = jnp.max(jnp.abs(next_step)) / problem.size
    # The forces balance, but a step would still move the body: rounding of the positions keeps them off equilibrium
    # along a soft mode. Each further step rounds them anew.
    polish = (residual <= rtol) & (correction > INACCURATE) & (state.counts.polished < POLISH)
    taken = moved & ~state.initial
    after = State(
        x=x,
        evaluation=evaluation,
        stiffness=stiffness,
        step=next_step,
        bend=jnp.zeros_like(x),
        response=response,
        correction=correction,
        singular=state.singular,
        residual=residual,
        counts=_count(state, taken, halvings, polish),
        initial=jnp.asarray(False),
        running=moved,
    )
    running = moved & ~terminate(problem, state, after, balanced, polish)
    bent = running & stiffness.definite & (correction > BENT)
    bend = compute_if(bent, partial(_bend, problem), after.bend, x, stiffness.factor, next_step)
    return after._replace(bend=bend, running=running)


def terminate(problem: Problem, before: State, after: State, balanced: jax.Array, polish: jax.Array) -> jax.Array:
    """Whether to end after a step, `()`.

    Args:
        problem: what does not change.
        before: state before the step.
        after: state after it.
        balanced: `()` whether the forces balance to `rtol`, without any allowance for round-off.
        polish: `()` whether the residual is small enough but the positions are still inaccurate.
    """
    rtol = problem.solver.tolerance(after.x.dtype)
    # Within the allowance for round-off go on as long as a step halves the residual. A smaller change is noise.
    improving = ~balanced & (after.residual < 0.5 * before.residual)
    # False for a residual of NaN, from which no step can be computed.
    wanted = (after.residual > rtol) | improving | polish
    return ~(wanted & (after.counts.steps < problem.policy.max_steps))


# --------------------------------------------------------------------------------- pieces of a step


def _reuse(problem: Problem, state: State, balanced: jax.Array) -> tuple[jax.Array | bool, jax.Array | bool]:
    """Whether to reuse the last factor, and whether to make a new one; plain booleans if it may never be reused."""
    if problem.policy.reuse_factor is None:
        return False, True
    short = ~state.initial & (jnp.max(jnp.abs(state.step)) <= NEAR * problem.size)
    sure = state.stiffness.definite & ~state.stiffness.marginal
    reuse = problem.policy.reuse_factor & short & balanced & sure
    return reuse, ~reuse


def _gap(problem: Problem, x: jax.Array) -> jax.Array:
    """What is left, `(n, d)`, until held coordinates are at their places; zero where it is round-off."""
    assert problem.places is not None
    gap = jnp.where(problem.scene.held, problem.places - x, 0)
    return jnp.where(jnp.abs(gap) <= 4 * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x)), 0, gap)


def _solve(
    problem: Problem,
    state: State,
    x: jax.Array,
    evaluation: Evaluation,
    stiffness: Stiffness,
    reuse: jax.Array | bool,
) -> tuple[jax.Array, jax.Array]:
    """Solve for two right-hand sides: the unbalanced forces and those of the probe.

    Returns:
        The next step `(n, d)`, and the response `(n, d)` to the probe.
    """

    def refinement(x: jax.Array, response: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The stiffness at `x` times the last response, and that response."""
        return jax.jvp(lambda x: evaluate(problem.scene, x).gradient, (x,), (response,))[1], response

    # With a reused factor, refine the last response by one residual correction instead of solving for it anew.
    zeros, gradient = jnp.zeros_like(x), evaluation.gradient
    gap = zeros
    if problem.places is not None:
        gap = _gap(problem, x)
        # The forces change as supports move.
        change = lambda x, gap: jax.jvp(lambda x: evaluate(problem.scene, x).gradient, (x,), (gap,))[1]
        gradient += compute_if(jnp.any(gap != 0), change, zeros, x, gap)
    left, response = compute_if(reuse, refinement, (zeros, zeros), x, state.response)
    probe = problem.policy.probe(x, stiffness.definite)
    loads = jnp.stack([gradient, probe + left])
    loads = jax.vmap(gather, in_axes=(None, 0), out_axes=1)(problem.layout, loads)
    moves = problem.solver.linear.solve(problem.layout, stiffness.factor, loads)
    moves = jax.vmap(lambda move: expand(problem.layout, -move, x.shape), in_axes=1)(moves)
    return moves[0] + gap, response + moves[1]


def _bend(problem: Problem, x: jax.Array, factor: Any, step: jax.Array) -> jax.Array:
    """The bend `(n, d)` of a step, zero where it is longer than the step: the series is of no use there.

    Args:
        problem: what does not change.
        x: `(n, d)` positions.
        factor: factor of the true Hessian there.
        step: `(n, d)` the step.
    """
    load = gather(problem.layout, second_change(problem.scene, x, step))
    bend = expand(problem.layout, -0.5 * problem.solver.linear.solve(problem.layout, factor, load), x.shape)
    short = jnp.max(jnp.abs(bend)) <= jnp.max(jnp.abs(step))
    return jnp.where(short, bend, 0)


def _count(state: State, taken: jax.Array, halvings: jax.Array, polish: jax.Array) -> Counts:
    """The counts after a step.

    Args:
        state: state before the step.
        taken: `()` whether the step was taken.
        halvings: `()` how often the line search halved it.
        polish: `()` whether the next step is for accuracy alone.
    """
    counts, one = state.counts, lambda condition: condition.astype(jnp.int32)
    return Counts(
        steps=counts.steps + one(taken),
        projected=counts.projected + one(taken & ~state.stiffness.definite),
        halvings=counts.halvings + halvings,
        polished=counts.polished + one(polish),
    )
