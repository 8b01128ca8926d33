"""Newton's method for the unknown node positions of one scene, inside jit.

A step takes the true Hessian whenever its Cholesky factor exists, and only where it does not one blended with
a projected Hessian (`jaxbeam.physics.projection`): always projecting would make convergence linear. At a solution the
true factor exists if and only if the equilibrium is stable.

The residual is relative: the largest unbalanced force on a free coordinate over the *force scale*, the largest
sum of the magnitudes of the stencil forces that meet at a free coordinate. So a change of units changes nothing.
Forces smaller than the round-off at their own coordinate count as balanced: see `relative_residual`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core import checks
from jaxbeam.core.compiling import blank, choose, once
from jaxbeam.core.tree import key_of
from jaxbeam.linear.blocks import Topology
from jaxbeam.linear.layout import Layout, LinearSolver, assemble, expand, gather
from jaxbeam.linear.tridiagonal import BlockTridiagonal
from jaxbeam.scene.scene import Evaluation, Scene, check_scene, evaluate, extent, largest_step, stencil_hessians


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


def check_asked(scene: Scene, solver: Newton) -> None:
    """Refuse what is not a scene to solve, or not a solver."""
    check_scene(scene)
    checks.instance("solver", solver, Newton, "make one with Newton(...)")


# Line search. Armijo's constant is the usual one; `APPROXIMATE` is delta of Hager and Zhang (2005).
ARMIJO = 1e-4


APPROXIMATE = 0.1


MAX_HALVINGS = 40


# Round-off of an energy is taken as this many eps times the magnitudes in it. That of the force at a coordinate is
# measured to stay under 0.53 eps max|x| times the sum of the magnitudes in its row of the stiffness, for meshes of
# either order, materials, stiffnesses and slender beams.
# Pivots of a singular stiffness come out at 0.1 to 2.8 eps sqrt(N) times the diagonal on bodies that float free; on
# slender beams in float32 at 2.7 and more.
ENERGY_ROUND_OFF = 4.0


FORCE_ROUND_OFF = 0.75


PIVOT_ROUND_OFF = 2.0


SINGULAR = 1.0


# Share of the projected Hessian tried first where the true one is not definite; tripled until it is one, then
# shifts are added, each ten times the one before.
FIRST_SHARE = 0.01


MAX_BLENDS = 16


# Shifts tried before any projection on the way from a saddle, each ten times the one before: from ten times the
# round-off of a pivot to about a millionth of the stiffness, where the lowest eigenvalues of a beam lie. Near a
# bifurcation the negative eigenvalue is tiny, and the smallest projected share would be thousands of times as stiff.
GENTLE_SHIFTS = 8


# A step no longer than this, over the size of the body, leaves the stiffness as good as it was: what it changes of
# the softest mode is as small a share.
NEAR = 1e-6


# A correction that makes an answer inaccurate, and how many steps are spent on a smaller one.
INACCURATE = 1e-3


POLISH = 10


def topology(scene: Scene) -> Topology:
    """The structure of a scene, on which the layout of its matrix depends."""
    nodes = tuple(key_of(term, "nodes") for term in scene.terms)
    return Topology(key_of(scene.mesh, "elements"), key_of(scene, "fixed"), nodes)


# What `State.counts` counts.
STEPS, PROJECTED, HALVINGS, POLISHED = range(4)


class Stiffness(NamedTuple):
    """The Hessian, as far as it is kept.

    `factor` is that of the true one if `definite`, else of one made so; `marginal` if round-off decided which of the
    two, which leaves its sign open. `rows` are those of `row_magnitudes`.
    """

    factor: Any
    definite: jax.Array
    marginal: jax.Array
    rows: jax.Array


class State(NamedTuple):
    """Where Newton's method stands.

    `stiffness` is that at `x`. `step` `(n, 2)` is the step to take next and `aside` `(n, 2)` how `x` would move under
    the probe. `correction` `()` is the longest move of a node in `step`, over the size of the body. `singular` `()` is
    true where the lowest eigenvalue of the stiffness is within its round-off.
    """

    x: jax.Array
    at: Evaluation
    stiffness: Stiffness
    step: jax.Array
    aside: jax.Array
    correction: jax.Array
    singular: jax.Array
    residual: jax.Array
    counts: jax.Array
    fresh: jax.Array
    running: jax.Array


def newton(
    scene: Scene,
    layout: Layout,
    x: jax.Array,
    ahead: jax.Array,
    budget: jax.Array,
    free: jax.Array,
    passing: jax.Array | None,
    leaving: jax.Array,
    probe: Callable[[jax.Array, jax.Array], jax.Array],
    solver: Newton,
) -> State:
    """Newton's method from `x + ahead`, for a scene with unlocked indices; to be called inside jit.

    It starts as far along `ahead` as no element inverts, and takes at most `budget` steps. The first `free` of them
    need not lower the energy, as long as the true Hessian is positive definite. `probe(x, definite)` are nodal forces
    `(n, 2)` that are solved for beside the unbalanced ones: a column more costs next to nothing.

    The state it ends in holds the stiffness at `x`. While `passing`, in an intermediate state of a path, the stiffness
    at the start of the last step is kept if that step was shorter than `NEAR`: most states of a path end so, and it
    saves them half the work. `leaving` says that it starts beside a saddle, where shifts are tried before projections.
    """
    rtol, size = solver.tolerance(x.dtype), extent(scene)
    # A load on all modes. What it moves tells how soft the softest is.
    noise = jnp.where(scene.fixed, 0, jnp.asarray(np.random.default_rng(1).choice([-1.0, 1.0], x.shape), x.dtype))
    zero, nothing, yes = jnp.zeros((), x.dtype), jnp.zeros_like(x), jnp.asarray(True)
    first = State(
        x=x,
        at=Evaluation(zero, zero, nothing, nothing),
        stiffness=Stiffness(no_factor(layout, x.dtype, solver), yes, ~yes, nothing),
        step=ahead,
        aside=nothing,
        correction=zero,
        singular=~yes,
        residual=jnp.asarray(jnp.inf, x.dtype),
        counts=jnp.zeros(4, jnp.int32),
        fresh=yes,
        running=yes,
    )

    def stiffness_at(x: jax.Array, finite: jax.Array) -> Stiffness:
        return factorise(scene, layout, x, finite, leaving, solver)

    def turned(x: jax.Array, aside: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(lambda x: evaluate(scene, x).gradient, (x,), (aside,))[1], aside

    def body(state: State) -> State:
        bold = state.fresh | (state.stiffness.definite & (state.counts[STEPS] < free))
        x, at, halvings, moved = line_search(scene, state, bold, solver)
        unbalanced = jnp.max(jnp.abs(jnp.where(scene.fixed, 0, at.gradient)))
        balanced = unbalanced <= rtol * force_scale(scene, at)
        near = ~state.fresh & (jnp.max(jnp.abs(state.step)) <= NEAR * size)
        sure = state.stiffness.definite & ~state.stiffness.marginal
        keep = None if passing is None else passing & near & balanced & sure
        renew = True if keep is None else ~keep
        stiffness = once(renew, stiffness_at, state.stiffness, x, jnp.isfinite(unbalanced))
        round_off = force_round_off(stiffness.rows, x)
        residual = relative_residual(scene, at, round_off, rtol)
        # Within round-off a step that halves the residual is still worth taking; one that does not is noise.
        rough = ~balanced & (residual < 0.5 * state.residual)
        # What was found with a stiffness that is kept is wrong by as little as that is; it is refined, not found anew.
        held, aside = once(False if keep is None else keep, turned, (nothing, nothing), x, state.aside)
        pulls = jnp.stack([at.gradient, probe(x, stiffness.definite) + held, noise])
        pulls = jax.vmap(gather, in_axes=(None, 0), out_axes=1)(layout, pulls)
        moves = solver.linear.solve(layout, stiffness.factor, pulls)
        moves = jax.vmap(lambda move: expand(layout, -move, x.shape), in_axes=1)(moves)
        left = jnp.max(jnp.abs(moves[0])) / size
        # Rayleigh quotient of one inverse iteration: near a limit of stability, the lowest eigenvalue.
        softest = -jnp.sum(noise * moves[2]) / jnp.sum(moves[2] ** 2)
        # In balance, but a step would still move it: rounding the positions is what keeps it from rest along a soft
        # mode, and it rounds anew with each step.
        vague = (residual <= rtol) & (left > INACCURATE) & (state.counts[POLISHED] < POLISH)
        taken = moved & ~state.fresh
        counted = jnp.stack([taken, taken & ~state.stiffness.definite, halvings, vague], dtype=jnp.int32)
        counts = state.counts + counted
        # False for NaN: there is nothing to go on from.
        wanted = ((residual > rtol) | rough | vague) & (counts[STEPS] < budget)
        return State(
            x=x,
            at=at,
            stiffness=stiffness,
            step=moves[0],
            aside=aside + moves[1],
            correction=left,
            singular=softest <= SINGULAR * float(jnp.finfo(x.dtype).eps) * jnp.max(stiffness.rows),
            residual=residual,
            counts=counts,
            fresh=~yes,
            running=moved & wanted,
        )

    return lax.while_loop(lambda state: state.running, body, first)


def no_factor(layout: Layout, dtype: Any, solver: Newton) -> Any:
    """Zeros in the shape of a factor, to start a loop with."""
    storage = jax.ShapeDtypeStruct(layout.empty.shape, dtype)
    return blank(solver.linear.factor, layout, storage)[0]


def stiffest(layout: Layout, storage: jax.Array) -> jax.Array:
    """The largest entry of the diagonal, `()`."""
    unknown = layout.slots < layout.position.size
    return jnp.max(jnp.where(unknown, jnp.abs(storage[layout.diagonal]), 0))


def force_scale(scene: Scene, at: Evaluation) -> jax.Array:
    """The largest sum of magnitudes of the stencil forces at one free coordinate, `()`."""
    return jnp.max(jnp.where(scene.fixed, 0, at.gradient_scale))


def force_round_off(rows: jax.Array, x: jax.Array) -> jax.Array:
    """Round-off of the force at each coordinate `(n, d)`, from the `rows` of `row_magnitudes`.

    Positions carry a relative error eps, which row `i` of the stiffness turns into a force of up to
    `eps max |x| sum_j |K_ij|` that no iteration can remove. It is local: a stiff tendon makes the forces on its own
    nodes uncertain, and no others.
    """
    return FORCE_ROUND_OFF * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x)) * rows


def relative_residual(scene: Scene, at: Evaluation, round_off: jax.Array, rtol: float) -> jax.Array:
    """The largest unbalanced force on a free coordinate over what it is compared with, `()`.

    That is the force scale, plus what makes `rtol` times it no smaller than the round-off at this coordinate.
    """
    compared = force_scale(scene, at) + round_off / rtol
    # A coordinate without any force at all is in balance.
    return jnp.max(
        jnp.where(scene.fixed | (compared == 0), 0, jnp.abs(at.gradient) / jnp.where(compared == 0, 1, compared))
    )


def row_magnitudes(scene: Scene, hessians: list[jax.Array]) -> jax.Array:
    """Sums `(n, d)` of the magnitudes in each row of the stiffness, taken stencil by stencil."""
    n, d = scene.mesh.nodes.shape
    total = jnp.zeros((n, d), scene.mesh.nodes.dtype)
    for term, hessian in zip(scene.terms, hessians, strict=True):
        rows = jnp.sum(jnp.abs(hessian), axis=1).reshape(-1, d, hessian.shape[-1])
        total = total.at[term.nodes].add(jnp.moveaxis(rows, -1, 0))
    return total


def factorise(
    scene: Scene, layout: Layout, x: jax.Array, finite: jax.Array, leaving: jax.Array, solver: Newton
) -> Stiffness:
    """A positive definite factor: of the true Hessian if it has one, else of one that is blended with the projected
    Hessian or, when `leaving` a saddle, shifted.

    The smallest share of projection that will do is taken: a fully projected Hessian is far too stiff along the soft
    modes of a snap. A projected one that is singular is shifted as well. Returned with it is whether the factor is that
    of the true Hessian; and whether round-off decided that: it is so after a shift by no more, which is tried first, or
    a pivot is no more. One that is not `finite` is tried once.
    """
    hessians = stencil_hessians(scene, x)
    storage = assemble(layout, hessians)
    diagonal, largest = storage[layout.diagonal], stiffest(layout, storage)
    noise = float(jnp.finfo(storage.dtype).eps) * layout.slots.size**0.5
    finite = finite & jnp.isfinite(largest)
    convex_at = lambda x: assemble(layout, stencil_hessians(scene, x, convex=True))
    first_blend = jnp.where(leaving, 2 + GENTLE_SHIFTS, 2)

    def attempt(carry: Any) -> Any:
        tries, _, _, convex = carry
        convex = once(tries == first_blend, convex_at, convex, x)
        count = (tries - first_blend).astype(storage.dtype)
        share = jnp.where(count >= 0, jnp.minimum(1.0, FIRST_SHARE * 3.0**count), 0.0)
        gentle = jnp.where(tries > 0, noise * 10.0 ** (tries - 1).astype(storage.dtype), 0.0)
        shift = jnp.where(count < 0, gentle, jnp.where(share < 1, 0.0, 10.0 ** (count - 16))) * largest
        blend = ((1 - share) * storage + share * convex).at[layout.diagonal].add(shift)
        factor, done = solver.linear.factor(layout, blend)
        return tries + 1, factor, done, convex

    begin = (jnp.zeros((), jnp.int32), no_factor(layout, storage.dtype, solver), ~finite, jnp.zeros_like(storage))
    going = lambda c: (c[0] == 0) | (~c[2] & finite & (c[0] < first_blend + MAX_BLENDS))
    tries, factor, done, _ = lax.while_loop(going, attempt, begin)
    blunt = jnp.min(solver.linear.pivots(layout, factor) / diagonal) <= PIVOT_ROUND_OFF * noise
    marginal = done & ((tries == 2) | ((tries == 1) & blunt))
    return Stiffness(factor, done & (tries == 1), marginal, row_magnitudes(scene, hessians))


def line_search(
    scene: Scene, state: State, free: jax.Array, solver: Newton
) -> tuple[jax.Array, Evaluation, jax.Array, jax.Array]:
    """Halve the pending step until the energy falls; `(x, evaluation, halvings, moved)`.

    Near the solution differences of energy drown in round-off. There the slope decides: the approximate
    Wolfe condition of Hager and Zhang (2005), SIAM J. Optim. 16, eq. 4.1, holds for an energy that rises
    by no more than its round-off. A `free` step is taken at full length, and so is that of a fresh state, which
    leads to where Newton's method starts.
    """
    step = state.step
    slope = jnp.sum(state.at.gradient * step)
    # Round-off of the energy: of its sum, and of the positions it is evaluated at.
    magnitude = state.at.energy_scale + jnp.max(jnp.abs(state.x)) * jnp.sum(state.at.gradient_scale)
    noise = ENERGY_ROUND_OFF * jnp.finfo(step.dtype).eps * magnitude
    length = jnp.minimum(1.0, largest_step(scene, state.x, step, solver.keep_volume)).astype(step.dtype)
    downhill = state.fresh | (jnp.isfinite(slope) & (slope < 0))

    def trial(carry: Any) -> Any:
        count, _, _, _ = carry
        t = length * 0.5 ** count.astype(step.dtype)
        x = state.x + t * step
        at = evaluate(scene, x)
        end_slope = jnp.sum(at.gradient * step)
        falls = at.energy <= state.at.energy + ARMIJO * t * slope
        flat = (at.energy <= state.at.energy + noise) & (end_slope <= (2 * APPROXIMATE - 1) * slope)
        finite = jnp.isfinite(at.energy) & jnp.isfinite(end_slope)
        return count + 1, x, at, state.fresh | ((falls | flat | free) & finite)

    carry = (jnp.zeros((), jnp.int32), state.x, state.at, ~downhill)
    count, x, at, accepted = lax.while_loop(lambda c: ~c[3] & (c[0] <= MAX_HALVINGS), trial, carry)
    moved = downhill & accepted
    x, at = choose(moved, (x, at), (state.x, state.at))
    return x, at, jnp.maximum(count - 1, 0), moved
