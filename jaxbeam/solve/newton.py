"""Newton's method for the unknown node positions of one scene, inside jit.

A step solves `K dx = -g`, with the gradient `g` of the energy and a positive definite stiffness `K`
(`jaxbeam.solve.stiffness`), and is shortened by a line search (`jaxbeam.solve.line_search`). It ends when the relative
residual (`jaxbeam.solve.residual`) is small. At a solution the Cholesky factor of the true Hessian exists if and only
if the equilibrium is stable.
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
from jaxbeam.scene.scene import Evaluation, Scene, check_scene, evaluate, extent
from jaxbeam.solve.line_search import line_search
from jaxbeam.solve.residual import force_round_off, force_scale, relative_residual
from jaxbeam.solve.stiffness import Stiffness, factorise, is_singular, zero_factor

# A step shorter than this, over the size of the body, changes the stiffness of the softest mode by as small a share, so
# its factor may be reused.
NEAR = 1e-6


# A solution is inaccurate if one more step would move a node by more than this, over the size of the body. Up to
# `POLISH` steps are spent on making it accurate.
INACCURATE = 1e-3


POLISH = 10


@dataclasses.dataclass(frozen=True)
class Newton:
    """Settings of the equilibrium solver. Hashable: a change compiles anew.

    max_steps: Newton steps before giving up on one equilibrium, all attempts at it together.
    rtol: relative residual to reach; by default 1e-10 in float64 and 1e-6 in float32.
    linear: the linear solver, `BlockTridiagonal()` or, for tiny scenes, `Dense()`.
    keep_volume: no element falls below this fraction of its `J` in one step. It keeps elements from
        inverting within a step, and logarithmic energies finite.
    escape: leave a saddle along its lowest mode for the stable equilibrium beside it. Without it a saddle
        is returned as it is found, flagged `UNSTABLE`.
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
    return Topology(key_of(scene.mesh, "elements"), key_of(scene, "fixed"), nodes)


# --------------------------------------------------------------------------------- what the method works with


class Policy(NamedTuple):
    """What one run of Newton's method may do, and what it computes beside.

    max_steps: `()` the most steps it may take.
    full_steps: `()` number of first steps that need not lower the energy while the true Hessian is definite.
    reuse_factor: `()` whether the last step, if it is shorter than `NEAR`, reuses the factor of the step before. Most
        intermediate states of a ramp end so, and it saves them half the work. None if never; then it is not traced.
    leaving_saddle: `()` whether it starts beside a saddle, where shifts are tried before projections.
    probe: `(x, definite)` to nodal forces `(n, d)` that are solved for beside the unbalanced ones. One right-hand side
        more costs next to nothing.
    """

    max_steps: jax.Array
    full_steps: jax.Array | int
    reuse_factor: jax.Array | None
    leaving_saddle: jax.Array
    probe: Callable[[jax.Array, jax.Array], jax.Array]


class Counts(NamedTuple):
    """What one run of Newton's method has counted so far, each an int32 `()`.

    steps: steps taken.
    projected: steps taken with a modified stiffness.
    halvings: halvings of the line search, all steps together.
    polished: steps wanted for accuracy alone, in balance.
    """

    steps: jax.Array
    projected: jax.Array
    halvings: jax.Array
    polished: jax.Array


class State(NamedTuple):
    """State of Newton's method.

    x: `(n, d)` positions.
    evaluation: energy and gradient at `x`.
    stiffness: at `x`; at the start of the last step if its factor was reused.
    step: `(n, d)` the step to take next.
    response: `(n, d)` displacement under the forces of the probe, at `x`.
    correction: `()` largest move of a node in `step`, over the size of the body.
    singular: `()` whether the lowest eigenvalue of the stiffness is within round-off of zero. Known at the end only.
    residual: `()` relative residual at `x`.
    counts: what was counted.
    initial: `()` whether `step` leads to the start of the method; such a step is not counted.
    running: `()` whether another step is to be taken.
    """

    x: jax.Array
    evaluation: Evaluation
    stiffness: Stiffness
    step: jax.Array
    response: jax.Array
    correction: jax.Array
    singular: jax.Array
    residual: jax.Array
    counts: Counts
    initial: jax.Array
    running: jax.Array


class Problem(NamedTuple):
    """What does not change during one run.

    scene: to be solved, with unlocked indices.
    layout: of its matrix.
    policy: what the run may do.
    solver: settings.
    size: `()` of the body.
    """

    scene: Scene
    layout: Layout
    policy: Policy
    solver: Newton
    size: jax.Array


# --------------------------------------------------------------------------------- init, step, terminate


def newton(
    scene: Scene, layout: Layout, x: jax.Array, displacement: jax.Array, policy: Policy, solver: Newton
) -> State:
    """Newton's method from `x + displacement`; to be called inside jit.

    It starts as far along the displacement as no element inverts.

    Args:
        scene: to be solved, with unlocked indices.
        layout: of its matrix.
        x: `(n, d)` positions without an inverted element.
        displacement: `(n, d)` from there to the start.
        policy: what the run may do.
        solver: settings.

    Returns:
        The state it ends in. `running` is false; the residual tells whether it converged.
    """
    problem = Problem(scene, layout, policy, solver, extent(scene))
    begin = init(problem, x, displacement)
    end = lax.while_loop(lambda state: state.running, partial(step, problem), begin)
    return end._replace(singular=is_singular(scene, layout, end.x, problem.size, end.stiffness, solver.linear))


def init(problem: Problem, x: jax.Array, displacement: jax.Array) -> State:
    """The state before the initial step, `displacement`: nothing is evaluated yet."""
    zero, zeros, yes = jnp.zeros((), x.dtype), jnp.zeros_like(x), jnp.asarray(True)
    none = jnp.zeros((), jnp.int32)
    factor = zero_factor(problem.layout, x.dtype, problem.solver.linear)
    return State(
        x=x,
        evaluation=Evaluation(zero, zero, zeros, zeros),
        stiffness=Stiffness(factor, yes, ~yes, ~yes, zero, zero, zeros),
        step=displacement,
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
    x, evaluation, halvings, moved = line_search(
        scene, state.x, state.evaluation, state.step, state.initial, full, solver.keep_volume
    )
    unbalanced = jnp.max(jnp.abs(jnp.where(scene.fixed, 0, evaluation.gradient)))
    allowed = rtol * force_scale(scene, evaluation)
    balanced = unbalanced <= allowed

    reuse, renew = _reuse(problem, state, balanced)
    stiffness_at = lambda x, unbalanced, allowed: factorise(
        scene, problem.layout, x, problem.size, unbalanced, allowed, policy.leaving_saddle, solver.linear
    )
    stiffness = compute_if(renew, stiffness_at, state.stiffness, x, unbalanced, allowed)
    residual = relative_residual(scene, evaluation, force_round_off(stiffness.rows, x), rtol)
    next_step, response = _solve(problem, state, x, evaluation, stiffness, reuse)
    correction = jnp.max(jnp.abs(next_step)) / problem.size
    # In balance, but a step would still move it: rounding keeps the positions from rest along a soft mode, and each
    # step rounds them anew.
    polish = (residual <= rtol) & (correction > INACCURATE) & (state.counts.polished < POLISH)
    taken = moved & ~state.initial
    after = State(
        x=x,
        evaluation=evaluation,
        stiffness=stiffness,
        step=next_step,
        response=response,
        correction=correction,
        singular=state.singular,
        residual=residual,
        counts=_count(state, taken, halvings, polish),
        initial=jnp.asarray(False),
        running=moved,
    )
    return after._replace(running=moved & ~terminate(problem, state, after, balanced, polish))


def terminate(problem: Problem, before: State, after: State, balanced: jax.Array, polish: jax.Array) -> jax.Array:
    """Whether to end after a step, `()`.

    Args:
        problem: what does not change.
        before: state before the step.
        after: state after it.
        balanced: `()` whether the forces balance to `rtol`, without any allowance for round-off.
        polish: `()` whether they balance and the positions are still inaccurate.
    """
    rtol = problem.solver.tolerance(after.x.dtype)
    # Within round-off a step that halves the residual is still worth taking; one that does not is noise.
    improving = ~balanced & (after.residual < 0.5 * before.residual)
    # False for a residual of NaN: there is nothing to go on from.
    wanted = (after.residual > rtol) | improving | polish
    return ~(wanted & (after.counts.steps < problem.policy.max_steps))


# --------------------------------------------------------------------------------- pieces of a step


def _reuse(problem: Problem, state: State, balanced: jax.Array) -> tuple[jax.Array | bool, jax.Array | bool]:
    """Whether the factor of the step before is reused, and whether a new one is made; plain booleans if never."""
    if problem.policy.reuse_factor is None:
        return False, True
    short = ~state.initial & (jnp.max(jnp.abs(state.step)) <= NEAR * problem.size)
    sure = state.stiffness.definite & ~state.stiffness.marginal
    reuse = problem.policy.reuse_factor & short & balanced & sure
    return reuse, ~reuse


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
        """Forces that the response found last leaves unbalanced at `x`, beside those of the probe."""
        return jax.jvp(lambda x: evaluate(problem.scene, x).gradient, (x,), (response,))[1], response

    # With a reused factor, refine the response by one residual correction instead of finding it anew.
    zeros = jnp.zeros_like(x)
    left, response = compute_if(reuse, refinement, (zeros, zeros), x, state.response)
    probe = problem.policy.probe(x, stiffness.definite)
    loads = jnp.stack([evaluation.gradient, probe + left])
    loads = jax.vmap(gather, in_axes=(None, 0), out_axes=1)(problem.layout, loads)
    moves = problem.solver.linear.solve(problem.layout, stiffness.factor, loads)
    moves = jax.vmap(lambda move: expand(problem.layout, -move, x.shape), in_axes=1)(moves)
    return moves[0], response + moves[1]


def _count(state: State, taken: jax.Array, halvings: jax.Array, polish: jax.Array) -> Counts:
    """The counts after a step: whether it was `taken`, its `halvings`, and whether the next one is to `polish`."""
    counts, one = state.counts, lambda condition: condition.astype(jnp.int32)
    return Counts(
        steps=counts.steps + one(taken),
        projected=counts.projected + one(taken & ~state.stiffness.definite),
        halvings=counts.halvings + halvings,
        polished=counts.polished + one(polish),
    )
