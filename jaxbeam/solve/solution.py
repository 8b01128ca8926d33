"""The result of a solve, with flags and figures that tell how far to trust it.

Outside jit, pass each solution through `check`, which raises unless the status is `OK`. Inside jit, look at `status`
yourself: 0 is `OK`.
"""

from __future__ import annotations

import enum

import jax
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.tree import holds_arrays, is_concrete, pytree


class Status(enum.IntFlag):
    """What is wrong with a solution, as flags that combine. `check` tells them with what to try.

    OK: nothing: it converged, and is stable and not inverted.
    NOT_CONVERGED: no equilibrium was reached. `x` is the last state that was in balance, and `reached` says how far
        along the way to the command it is.
    NONFINITE: energy or forces are not finite at the start.
    INVERTED: an element is turned inside out (`J <= 0`), or an obstacle lies within the body.
    UNSTABLE: the equilibrium is a saddle. Only with `Newton(escape=False)`: else it is left for a stable one.
    INVALID: a traced parameter is out of its range. One that is known raises a `ValueError` at once.
    INACCURATE: round-off leaves positions uncertain by more than a thousandth of the body, or the stability: use
        float64.
    OVERLAPPING: the body passes through itself, which nothing models: the reference beam does from a ratio of 0.2 down.
    """

    OK = 0
    NOT_CONVERGED = 1
    NONFINITE = 2
    INVERTED = 4
    UNSTABLE = 8
    INVALID = 16
    INACCURATE = 32
    OVERLAPPING = 64


REMEDIES = {
    Status.NOT_CONVERGED: "no equilibrium was found, and x is the last state that was in balance, not the answer: "
    "approach the command by ramp(scene, ratios, steps) with more steps, raise Newton.max_steps, or command less",
    Status.NONFINITE: "energy or forces are not finite: check parameters and x0, which must not invert an element "
    "of a logarithmic material",
    Status.INVERTED: "an element is turned inside out (J <= 0), or an obstacle lies within the body: command less, "
    "approach it by ramp, use a finer mesh, a material that resists it, such as neo_hookean, or stiffer contact",
    Status.UNSTABLE: "the equilibrium is a saddle, which a real beam leaves: set Newton(escape=True), or start from "
    "x0 = x + a little of lowest_mode(scene, x)",
    Status.INACCURATE: "forces balance to round-off, but positions are still uncertain by more than a thousandth of "
    "the body (see correction), or it is unknown whether the equilibrium is stable: use float64; in float64 the "
    "command is at a limit of stability, such as a fold, where no derivative exists: see lowest_mode",
    Status.OVERLAPPING: "the body passes through itself, because contact is not modelled: two edges of its "
    "surface cross (see crossing); command less, or start from another state",
    Status.INVALID: "a parameter is out of its range (ratios and moduli must be positive, Poisson's ratio in "
    "(-1, 0.5), all finite): build the scene outside jit to be told which",
}


class EquilibriumError(RuntimeError):
    """Raised by `check` for a solution that cannot be trusted. It says what is wrong and what to try."""


@pytree
class Solution:
    """An equilibrium, and how far to trust it. `ramp` and `sweep` return one with a leading axis.

    x: `(n, d)` node positions.
    energy: `()` total energy.
    residual: `()` largest unbalanced force on a free coordinate, over the force scale.
    tolerance: `()` the residual that had to be reached.
    correction: `()` the most that one further Newton step would move a node, over the size of the body. It estimates
        how far round-off leaves `x` from the equilibrium, along the softest directions.
    steps: `()` Newton steps taken, all attempts together.
    projected: `()` how many of them used a modified Hessian.
    halvings: `()` halvings of the line search, all steps together.
    attempts: `()` Newton solves; more than 1 when the first failed or ended on a saddle.
    smallest_jacobian: `()` smallest `J = det F` anywhere in the solids, or stretch of a fibre of the rods; infinite
        without either.
    worst_element: `()` number of the element where that is; -1 without either.
    crossing: `(2, 2)` int32, two edges of the surface that cross, each by the numbers of its end nodes; -1 if none do.
    ratios: `(m,)` commands in the order of the terms: ratios of tendons, tensions, pressures and others.
    reached: `()` fraction of the way to the command that was covered: 1 at the command itself. If it is less, `x` is
        the equilibrium at that fraction of the way.
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
    crossing: jax.Array
    ratios: jax.Array
    reached: jax.Array
    status: jax.Array

    def __repr__(self) -> str:
        known = holds_arrays(self, self.status)
        if not known or not is_concrete(self.status):
            return f"Solution({'traced' if known else 'a tree of other values'})"
        flags = [Status(int(flag)) for flag in np.ravel(self.status)]
        if np.ndim(self.status) == 0:
            return f"Solution({flags[0].name}; {_describe(self, 0)})"
        counts = {flag.name: flags.count(flag) for flag in sorted(set(flags))}
        words = ", ".join(f"{count} {name}" for name, count in counts.items())
        return f"Solution({len(flags)} states: {words}; {int(np.sum(self.steps))} Newton steps)"


def check(solution: Solution) -> Solution:
    """Return the solution if its status is `OK`, in every member of a batch.

    Args:
        solution: from `equilibrium`, `ramp` or `sweep`.

    Raises:
        EquilibriumError: otherwise. It names the flags and the members of the batch that raise them, residual and
            tolerance, steps, smallest `J` and its element, the command, and what to try.
        ValueError: if the solution is traced: a status has no value inside jit.
    """
    checks.instance("solution", solution, Solution, "give what equilibrium, ramp or sweep returned")
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
    """The figures of one member of a batch, for the text of an error."""

    def of(field: jax.Array, rank: int = 0) -> np.ndarray:
        array = np.asarray(field)
        batch = array.shape[: array.ndim - rank]
        return array[np.unravel_index(member, batch)] if batch else array

    text = (
        f"residual {of(solution.residual):.3g} (tolerance {of(solution.tolerance):.3g}) after {of(solution.steps)} "
        f"Newton steps in {of(solution.attempts)} attempts, smallest J {of(solution.smallest_jacobian):.3g} in element "
        f"{of(solution.worst_element)}"
    )
    crossing = of(solution.crossing, 2)
    if (crossing >= 0).all():
        (a, b), (c, d) = crossing
        text += f", surface edge {a}-{b} crosses {c}-{d}"
    ratios = of(solution.ratios, 1)
    if ratios.size:
        text += f", command {[float(f'{r:.6g}') for r in ratios]}"
    if of(solution.reached) < 1:
        text += f", broken off at {of(solution.reached):.4g} of the way to it"
    return text
