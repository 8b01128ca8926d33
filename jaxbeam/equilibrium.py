"""Quasistatic equilibrium by Newton's method, and what is said of the answer.

At equilibrium the gradient of the energy vanishes at every free coordinate. A Newton step takes the true
Hessian whenever its Cholesky factor exists, and the one projected element by element only where it does
not: always projecting would make convergence linear. At the solution the true factor exists if and only if the
equilibrium is stable.

The residual is relative: the largest unbalanced force on a free coordinate over the *force scale*, the
largest sum of the magnitudes of the stencil forces that meet at one coordinate. So a change of units
changes nothing. Forces smaller than round-off can tell apart count as balanced: see `force_scale`.
"""

from __future__ import annotations

import dataclasses
import enum
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam._tree import Key, Numbers, is_concrete, pytree, unlock
from jaxbeam.linear import BlockTridiagonal, Layout, LinearSolver, Topology, assemble, expand, gather
from jaxbeam.linear import project_semidefinite as project
from jaxbeam.scene import Evaluation, Scene, evaluate, largest_step, smallest_jacobian, stencil_hessians


class Status(enum.IntFlag):
    """What is wrong with an answer; `OK` is zero. Flags combine."""

    OK = 0
    NOT_CONVERGED = 1
    NONFINITE = 2
    INVERTED = 4
    UNSTABLE = 8


REMEDIES = {
    Status.NOT_CONVERGED: "Newton stopped short: approach the command by ramp(scene, ratios, steps), with more steps, "
    "or raise Newton.max_steps; the answer is not an equilibrium",
    Status.NONFINITE: "energy or forces are not finite at the start: check parameters and x0 (an element must not be "
    "inverted in a logarithmic material)",
    Status.INVERTED: "an element is turned inside out (J <= 0): command less, use smaller ramp steps, a finer mesh or "
    "a material that resists it, such as neo_hookean",
    Status.UNSTABLE: "the equilibrium is a saddle, which a real beam leaves: start from a disturbed x0 to find the "
    "stable states beside it",
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
    steps: `()` Newton steps taken.
    projected: `()` how many of them used projected Hessians.
    halvings: `()` line-search halvings in all.
    smallest_jacobian: `()` smallest `J = det F` over the solids; infinite without one.
    status: `()` int32 of or-ed `Status` flags; 0 is `OK`.
    """

    x: jax.Array
    energy: jax.Array
    residual: jax.Array
    tolerance: jax.Array
    steps: jax.Array
    projected: jax.Array
    halvings: jax.Array
    smallest_jacobian: jax.Array
    status: jax.Array


@dataclasses.dataclass(frozen=True)
class Newton:
    """Settings of the equilibrium solver. Hashable: a change compiles anew.

    max_steps: Newton steps before giving up.
    rtol: relative residual to reach; by default 1e-10 in float64 and 1e-5 in float32.
    linear: the linear solver, `BlockTridiagonal()` or `Dense()`.
    keep_volume: no element falls below this fraction of its `J` in one step. It keeps elements from
        inverting within a step, and logarithmic energies finite.
    """

    max_steps: int = 100
    rtol: float | None = None
    linear: LinearSolver = BlockTridiagonal()
    keep_volume: float = 0.1

    def __post_init__(self) -> None:
        if not isinstance(self.max_steps, int | np.integer) or self.max_steps < 0:
            raise ValueError(f"max_steps: expected a whole number of at least 0, got {self.max_steps!r}")
        if self.rtol is not None and not 0 < self.rtol < 1:
            raise ValueError(f"rtol: expected a number between 0 and 1, got {self.rtol!r}")
        if not 0 < self.keep_volume < 1:
            raise ValueError(f"keep_volume: expected a number between 0 and 1, got {self.keep_volume!r}")

    def tolerance(self, dtype: Any) -> float:
        """The relative residual to reach in this dtype."""
        if self.rtol is not None:
            return self.rtol
        return 1e-10 if jnp.finfo(dtype).eps < 1e-10 else 1e-5


# Line search. Armijo's constant is the usual one; `APPROXIMATE` is delta of Hager and Zhang (2005).
ARMIJO = 1e-4
APPROXIMATE = 0.1
MAX_HALVINGS = 40
# Round-off in a sum of `s` magnitudes is taken as this many eps * s.
ROUND_OFF = 4.0
# Shifts tried after the projected Hessian has failed, each ten times the one before.
MAX_SHIFTS = 16


def equilibrium(scene: Scene, x0: Numbers | None = None, solver: Newton = Newton()) -> Solution:
    """Node positions at which all forces balance, found by Newton's method from `x0`.

    Args:
        scene: what to solve.
        x0: `(n, 2)` start; by default the rest positions. Fixed coordinates are put at rest.
        solver: settings.

    Returns:
        A `Solution`. It never raises for a solve that fails: its `status` says so, and `check` raises.

    Raises:
        ValueError: if `x0` has another shape, or is concrete and not finite.
    """
    layout = solver.linear.layout(topology(scene))
    return _equilibrium(unlock(scene), layout, start(scene, x0), solver)


def check(solution: Solution) -> Solution:
    """The solution itself if its status is `OK` throughout.

    Raises:
        EquilibriumError: otherwise. Says which flags, which members of a batch, residual against
            tolerance, steps, smallest `J`, and what to try.
        ValueError: if the solution is traced: statuses have no value inside jit.
    """
    if not is_concrete(solution.status):
        raise ValueError("solution: expected concrete values, got traced ones; call check outside jit, vmap and grad")
    status = np.asarray(solution.status)
    bad = np.flatnonzero(status.ravel())
    if not bad.size:
        return solution
    lines = []
    for flag in Status:
        members = np.flatnonzero(status.ravel() & flag)
        if not members.size:
            continue
        worst = members[0]
        where = ""
        if status.ndim:
            shown = ", ".join(str(m) for m in members[:8]) + (", ..." if members.size > 8 else "")
            where = f" in {members.size} of {status.size} members ({shown}); the first of them:"
        value = lambda field, k=worst: np.asarray(field).ravel()[k]
        lines.append(
            f"{flag.name}{where} residual {value(solution.residual):.3g} (tolerance {value(solution.tolerance):.3g}), "
            f"{value(solution.steps)} steps, smallest J {value(solution.smallest_jacobian):.3g}. {REMEDIES[flag]}."
        )
    raise EquilibriumError("\n".join(lines))


def topology(scene: Scene) -> Topology:
    """The structure of a scene, on which the layout of its matrix depends."""
    return Topology(Key(scene.mesh.elements), Key(scene.fixed), tuple(Key(term.nodes) for term in scene.terms))


def start(scene: Scene, x0: Numbers | None) -> jax.Array:
    """`x0` `(n, 2)` in the scene's dtype, with fixed coordinates at rest."""
    rest = scene.mesh.nodes
    if x0 is None:
        return rest
    if np.shape(x0) != rest.shape:
        raise ValueError(f"x0: expected node positions of shape {rest.shape}, got {np.shape(x0)}")
    if is_concrete(x0) and not np.isfinite(np.asarray(x0)).all():
        node = np.flatnonzero(~np.isfinite(np.asarray(x0)).all(axis=1))[0]
        raise ValueError(f"x0: expected finite positions, got {np.asarray(x0)[node].tolist()} at node {node}")
    return jnp.where(scene.fixed, rest, jnp.asarray(x0, rest.dtype))


# ------------------------------------------------------------------------------------- Newton's method


class State(NamedTuple):
    """Where Newton's method stands; `factor` is that of the last Hessian, true if `definite`."""

    x: jax.Array
    at: Evaluation
    factor: Any
    definite: jax.Array
    residual: jax.Array
    steps: jax.Array
    projected: jax.Array
    halvings: jax.Array
    running: jax.Array


@partial(jax.jit, static_argnames="solver")
def _equilibrium(scene: Scene, layout: Layout, x: jax.Array, solver: Newton) -> Solution:
    return report(scene, newton(scene, layout, x, solver), solver)


def newton(scene: Scene, layout: Layout, x: jax.Array, solver: Newton) -> State:
    """Newton's method from `x`, for a scene with unlocked indices; to be called inside jit.

    The state it ends in holds the factor of the true Hessian at `x`, for derivatives and predictors.
    """
    rtol = solver.tolerance(x.dtype)
    empty = jnp.zeros(layout.empty.shape, x.dtype)
    factor, _ = jax.eval_shape(solver.linear.factor, layout, empty)
    factor = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), factor)
    count, no, inf = jnp.zeros((), jnp.int32), jnp.asarray(False), jnp.asarray(jnp.inf, x.dtype)
    first = State(x, evaluate(scene, x), factor, no, inf, count, count, count, ~no)

    def body(state: State) -> State:
        hessians = stencil_hessians(scene, state.x)
        storage = assemble(layout, hessians)
        gradient = gather(layout, state.at.gradient)
        residual = jnp.max(jnp.abs(gradient)) / force_scale(layout, storage, state.x, state.at, rtol)
        wanted = (residual > rtol) & (state.steps < solver.max_steps)  # false for NaN: nothing to go on from
        factor, definite = solver.linear.factor(layout, storage)
        factor, usable = convexify(layout, hessians, storage, factor, definite | ~wanted, solver)
        step = expand(layout, -solver.linear.solve(layout, factor, gradient), state.x.shape)
        x, at, halvings, moved = line_search(scene, state, step, wanted & usable, solver)
        return State(
            x=x,
            at=at,
            factor=factor,
            definite=definite,
            residual=residual,
            steps=state.steps + moved,
            projected=state.projected + (moved & ~definite),
            halvings=state.halvings + halvings,
            running=moved,
        )

    return lax.while_loop(lambda state: state.running, body, first)


def force_scale(layout: Layout, storage: jax.Array, x: jax.Array, at: Evaluation, rtol: float) -> jax.Array:
    """What an unbalanced force is compared with, `()`.

    The largest sum of magnitudes of the stencil forces at one coordinate, plus what makes `rtol` times the
    scale no smaller than the round-off of the forces: positions carry a relative error eps, which the
    stiffness turns into a force of `eps * max |x| * max K_ii` that no iteration can remove.
    """
    unknown = layout.slots < layout.position.size
    stiffness = jnp.max(jnp.where(unknown, jnp.abs(storage[layout.diagonal]), 0))
    round_off = ROUND_OFF * jnp.finfo(x.dtype).eps * stiffness * jnp.max(jnp.abs(x))
    return jnp.max(at.gradient_scale) + round_off / rtol


def convexify(
    layout: Layout, hessians: list[jax.Array], storage: jax.Array, factor: Any, done: jax.Array, solver: Newton
) -> tuple[Any, jax.Array]:
    """A positive definite factor where the true one failed: projected stencils, then shifted as well.

    A loop and not `lax.cond`: under `vmap` a cond becomes a select, and every lane would always pay.
    """
    stiffness = jnp.max(jnp.abs(storage[layout.diagonal]))

    def attempt(carry: Any) -> Any:
        # Tied to the loop's counter: XLA moves what does not change out of a loop, and the projection
        # would be computed in every Newton step, needed or not.
        tries, stencils = lax.optimization_barrier((carry[0], hessians))
        convex = assemble(layout, [project(h) for h in stencils])
        shift = jnp.where(tries > 0, stiffness * 10.0 ** (tries - 10), 0).astype(storage.dtype)
        factor, done = solver.linear.factor(layout, convex.at[layout.diagonal].add(shift))
        return tries + 1, factor, done

    carry = (jnp.zeros((), jnp.int32), factor, done)
    _, factor, done = lax.while_loop(lambda c: ~c[2] & (c[0] < MAX_SHIFTS), attempt, carry)
    return factor, done


def line_search(
    scene: Scene, state: State, step: jax.Array, wanted: jax.Array, solver: Newton
) -> tuple[jax.Array, Evaluation, jax.Array, jax.Array]:
    """Halve the step until the energy falls; `(x, evaluation, halvings, moved)`.

    Near the solution differences of energy drown in round-off. There the slope decides: the approximate
    Wolfe condition of Hager and Zhang (2005), SIAM J. Optim. 16, eq. 4.1, holds for an energy that rises
    by no more than its round-off.
    """
    slope = jnp.sum(state.at.gradient * step)
    # Round-off of the energy: of its sum, and of the positions it is evaluated at.
    magnitude = state.at.energy_scale + jnp.max(jnp.abs(state.x)) * jnp.sum(state.at.gradient_scale)
    noise = ROUND_OFF * jnp.finfo(step.dtype).eps * magnitude
    length = jnp.minimum(1.0, largest_step(scene, state.x, step, solver.keep_volume)).astype(step.dtype)
    wanted = wanted & jnp.isfinite(slope) & (slope < 0)

    def trial(carry: Any) -> Any:
        count, _, _, _ = carry
        t = length * 0.5 ** count.astype(step.dtype)
        x = state.x + t * step
        at = evaluate(scene, x)
        end_slope = jnp.sum(at.gradient * step)
        falls = at.energy <= state.at.energy + ARMIJO * t * slope
        flat = (at.energy <= state.at.energy + noise) & (end_slope <= (2 * APPROXIMATE - 1) * slope)
        finite = jnp.isfinite(at.energy) & jnp.isfinite(end_slope)
        return count + 1, x, at, (falls | flat) & finite

    carry = (jnp.zeros((), jnp.int32), state.x, state.at, ~wanted)
    count, x, at, accepted = lax.while_loop(lambda c: ~c[3] & (c[0] <= MAX_HALVINGS), trial, carry)
    moved = wanted & accepted
    keep = lambda new, old: jnp.where(moved, new, old)
    return keep(x, state.x), jax.tree.map(keep, at, state.at), jnp.maximum(count - 1, 0), moved


def report(scene: Scene, state: State, solver: Newton) -> Solution:
    """The `Solution` of a state that has come to rest."""
    rtol = solver.tolerance(state.x.dtype)
    converged = state.residual <= rtol
    finite = jnp.isfinite(state.at.energy) & jnp.all(jnp.isfinite(state.at.gradient))
    volume = smallest_jacobian(scene, state.x)

    def flag(raised: jax.Array, which: Status) -> jax.Array:
        return jnp.where(raised, jnp.int32(which), 0)

    status = (
        flag(~converged, Status.NOT_CONVERGED)
        | flag(~finite, Status.NONFINITE)
        | flag(~(volume > 0), Status.INVERTED)
        | flag(converged & ~state.definite, Status.UNSTABLE)
    )
    return Solution(
        x=state.x,
        energy=state.at.energy,
        residual=state.residual,
        tolerance=jnp.full((), rtol, state.x.dtype),
        steps=state.steps,
        projected=state.projected,
        halvings=state.halvings,
        smallest_jacobian=volume,
        status=status,
    )
