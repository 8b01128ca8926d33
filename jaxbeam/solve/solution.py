"""The result of a solve, with flags and figures that tell how far to trust it.

Outside jit, pass each solution through `check`, which raises unless the status is `OK`. Inside jit, look at `status`
yourself: 0 is `OK`.
"""

from __future__ import annotations

import enum
from typing import Any

import jax
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.tree import index_field, is_concrete, pytree, replace, why_unknown
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.sketch import OUTLINE, WARNING, Stroke, body_strokes, page, svg
from jaxbeam.mesh.surface import outline


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

# The most states of a batch that its picture shows, and how pale all but the last are.
SHOWN, PALE = 16, 0.3


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
    outline: `(e, k)` the edges that it is drawn with, by node numbers (see `jaxbeam.mesh.surface.outline`), the same
        for all states; None: it is drawn as dots at its nodes.
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
    outline: Any = index_field(default=None)

    def __repr__(self) -> str:
        status, *figures = _facts(self)
        return f"Solution({'; '.join([status, ', '.join(figures)] if figures else [status])})"

    def __str__(self) -> str:
        facts = _facts(self)
        return "\n  ".join([f"Solution: {facts[0]}", *facts[1:], *_remedies(self)])

    def _repr_html_(self) -> str:
        """A small picture of the body in its shape, and the facts: what a notebook shows."""
        first, *others = _facts(self)
        remedies = _remedies(self)
        figures = ", ".join(others)
        if remedies:
            return page(_picture(self), [figures, *remedies], first)
        return page(_picture(self), [f"{first}; {figures}" if figures else first])


def outlined(solution: Solution, mesh: Mesh) -> Solution:
    """The solution with the outline of its mesh, for the functions that give a solution to the user.

    The outline is structure. The solver's own programs, which are compiled once for all topologies of a shape, work on
    solutions without one.
    """
    return replace(solution, outline=outline(mesh))


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
        lines.append(f"{flag.name}{where}: {', '.join(_describe(solution, members[0]))}. {REMEDIES[flag]}.")
    if lines:
        raise EquilibriumError("\n".join(lines))
    return solution


def _describe(solution: Solution, member: int) -> list[str]:
    """The figures of one member of a batch in words."""

    def of(field: jax.Array, rank: int = 0) -> np.ndarray:
        array = np.asarray(field)
        batch = array.shape[: array.ndim - rank]
        return array[np.unravel_index(member, batch)] if batch else array

    attempts = f" in {of(solution.attempts)} attempts" if of(solution.attempts) > 1 else ""
    found = [
        f"residual {of(solution.residual):.3g} (tolerance {of(solution.tolerance):.3g}) after "
        f"{_steps(of(solution.steps))}{attempts}"
    ]
    if of(solution.worst_element) >= 0:
        found.append(f"smallest J {of(solution.smallest_jacobian):.3g} in element {of(solution.worst_element)}")
    crossing = of(solution.crossing, 2)
    if (crossing >= 0).all():
        (a, b), (c, d) = crossing
        found.append(f"surface edge {a}-{b} crosses {c}-{d}")
    ratios = of(solution.ratios, 1)
    if ratios.size:
        found.append(f"command {[float(f'{r:.6g}') for r in ratios]}")
    if of(solution.reached) < 1:
        found.append(f"broken off at {of(solution.reached):.4g} of the way to it")
    return found


# ------------------------------------------------------------------------------------------------ how it shows itself


def _unknown(solution: Solution) -> str:
    """Why no figures can be told; empty if they can."""
    found = why_unknown(solution, solution.status)
    return found if found or solution.status.dtype.kind in "iu" else "a tree of other values"


def _facts(solution: Solution) -> list[str]:
    """Status and figures of a solution in words; of a batch the counts of each status, ranges and totals."""
    if unknown := _unknown(solution):
        return [unknown]
    flags = [Status(int(flag)) for flag in np.ravel(solution.status)]
    if np.ndim(solution.status) == 0:
        return [flags[0].name or str(int(flags[0])), *_describe(solution, 0)]
    counts = {flag.name: flags.count(flag) for flag in sorted(set(flags))}
    facts = [f"{len(flags)} states: {', '.join(f'{count} {name}' for name, count in counts.items())}"]
    volumes = np.asarray(solution.smallest_jacobian)[np.asarray(solution.worst_element) >= 0]
    if volumes.size:
        facts.append(f"smallest J {volumes.min():.3g} to {volumes.max():.3g}")
    return [*facts, _steps(np.sum(solution.steps))]


def _steps(count: Any) -> str:
    return "1 Newton step" if count == 1 else f"{count} Newton steps"


def _remedies(solution: Solution) -> list[str]:
    """What to do about each flag that some state has."""
    if _unknown(solution):
        return []
    flags = np.bitwise_or.reduce(np.ravel(solution.status), initial=0)
    return [f"{flag.name}: {REMEDIES[flag]}" for flag in Status if flag & flags]


def _picture(solution: Solution) -> str:
    """SVG of the body in its states, of many at most `SHOWN`, the last one strong; empty if none can be drawn."""
    if _unknown(solution) or np.ndim(solution.x) != np.ndim(solution.status) + 2:
        return ""
    states = np.asarray(solution.x, float).reshape(-1, *solution.x.shape[-2:])
    status = np.ravel(solution.status)
    strokes: list[Stroke] = []
    for k in np.unique(np.linspace(0, len(states) - 1, min(len(states), SHOWN)).round().astype(int)):
        colour, last = OUTLINE if status[k] == 0 else WARNING, k == len(states) - 1
        strokes += _state(states[k], solution.outline, colour, 1.0 if last else PALE)
    return svg(strokes)


def _state(x: np.ndarray, edges: Any, colour: str, opacity: float) -> list[Stroke]:
    """One state `x` `(n, d)`; none if a position is not finite. A solution made by hand has no outline, but dots."""
    if not np.isfinite(x).all():
        return []
    known = isinstance(edges, np.ndarray) and edges.dtype.kind == "i" and edges.ndim == 2
    if not known or not 0 <= edges.max(initial=-1) < len(x):
        return [Stroke(list(x[:, None, :2]), colour, 3.0, opacity=opacity)]
    # The nodes of a rod have three coordinates, and the third is an angle.
    return body_strokes(x, edges, x.shape[1] == 2, colour, opacity)
