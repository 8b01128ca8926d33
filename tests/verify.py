"""Verification of answers by code that shares nothing with the solver.

Energies are written anew in `tests/energies.py`, what acts on the body in `tests/actions.py` and `tests/obstacles.py`,
`J` and crossings of the surface in `tests/geometry.py`, always in float64; stability is a dense Cholesky factorisation
over the free coordinates. `verify` lists what an answer claims
and does not keep, `refuted_slope` compares a derivative.

What counts as round-off, with `eps` that of the dtype of the solve and `K` the dense Hessian over free coordinates:

- forces: positions are rounded independently by `eps max |x|`, which a row of `K` turns into a force of that times its
  Euclidean length: 1.5 times that of the longest row. The tolerance is met within `FACTOR`, for a different order of
  summation;
- positions: Newton's method in float64 from `x` settles within `OFF` of the body's size, whatever the forces;
- eigenvalues: a Cholesky factorisation of `N` unknowns is exact for a matrix that differs by about
  `eps sqrt(N) max K_ii`, so `EIGEN eps sqrt(N) max K_ii` cannot be told from zero;
- energies: `16 eps` of the magnitudes added up and of forces times positions, `max K_ii (eps max |x|)^2` for each
  coordinate, and, as the form in `F` cancels where that in `H` does not, `16 eps` of float64 of the moduli times areas;
- `J`: positions are rounded by `eps max |x|`, which moves `J` by that over the height of the element;
- slopes: `SLOPE`, and what positions are rounded by, over the size of the body, times the condition number of `K`;
- commands: one between rest and the last of a ramp is rounded by `eps` of the larger of them, four times;
- supports: a displacement is the product of two rounded numbers, added to a third, `2 eps` of the magnitudes;
- distances from an obstacle: differences of numbers as large as `max |x|`, its place and its radius, so that all that
  they decide is rounded by `eps` of the largest of these. A command may be that large too;
- the side of an obstacle on which the surface is: cosines turn by what positions are rounded by, over the lengths of
  edges and the radius of a disk;
- crossings: an end of an edge that is as near to the other as `tests/geometry.py` says leaves it open.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

import jaxbeam as jb
from tests.actions import Tendons
from tests.energies import Facts, Problem, command_forces, density, facts, facts_from_first, total_energy
from tests.geometry import crossings, surface
from tests.obstacles import sides, swallowed

__all__ = ("Facts", "Problem", "Tendons", "Verdict", "density", "facts", "refuted_slope", "total_energy", "verify")

FACTOR = 2.0
EIGEN = 4.0
FORCE = 1.5
OFF = 5e-3
SLOPE = 1e-6
RTOL = {"float32": 1e-6, "float64": 1e-10}
# Newton's method from `x`: how many steps it may take to settle, and what counts as settled.
STEPS, SETTLED = 30, 1e-6
# More unknowns than this, and one step of it is taken.
MOST = 1500
OVERLAPPING = getattr(jb.Status, "OVERLAPPING", 64)


class Verdict(NamedTuple):
    """refuted: claims that do not hold, in words. residual: unbalanced force over the force scale. volume: smallest
    `J`. off: how far Newton's method, in float64, still moves a node, over the size of the body (NaN where the Hessian
    is not definite). marginal: stable only within round-off."""

    refuted: list[str]
    residual: float
    volume: float
    off: float
    marginal: bool


class Claim(NamedTuple):
    """An answer under a command, with the round-off of its dtype."""

    problem: Problem
    ratios: np.ndarray
    answer: Any
    status: jb.Status
    x: np.ndarray
    eps: float
    rtol: float

    @property
    def reach(self) -> float:
        return float(np.abs(self.x).max())

    @property
    def span(self) -> float:
        """The largest number in differences of positions, also those from obstacles."""
        obstacles = [max(contact.reach, abs(moved)) for contact, moved in self.problem.contacts(self.ratios)]
        return max(self.reach, *obstacles, 0.0)

    def residual(self, true: Facts) -> float:
        """The largest unbalanced force over the force scale, which leaves room for round-off."""
        return true.unbalanced / (true.scale + FORCE * self.eps * true.longest_row * self.span / self.rtol)


def verify(problem: Problem, ratios: np.ndarray, answer: Any, stability: bool = True) -> Verdict:
    """Compare one `Solution` (no leading axis) with the facts at its `x` under the command `ratios` `(m,)`.

    A claim of `OK` is refuted by a residual over the tolerance, an equilibrium elsewhere, an eigenvalue below zero,
    `J <= 0`, edges that cross or anything that is not finite; a flag by its contrary. Round-off is allowed as this
    module's head says.
    """
    dtype = np.asarray(answer.x).dtype
    ratios = np.asarray(ratios, dtype)
    status, x = jb.Status(int(answer.status)), np.asarray(answer.x, np.float64)
    claim = Claim(problem, ratios, answer, status, x, float(np.finfo(dtype).eps), RTOL[dtype.name])
    refuted = _command(claim)
    if not _finite(claim):
        if not status & (jb.Status.NONFINITE | jb.Status.NOT_CONVERGED):
            refuted.append(f"{status!r} with numbers that are not finite")
        return Verdict(refuted, np.nan, np.nan, np.nan, False)
    settled = not status & (jb.Status.NOT_CONVERGED | jb.Status.NONFINITE)
    true = facts(problem, ratios, x, dense=stability and settled)
    refuted += _state(claim, true) + _volume(claim, true) + _overlap(claim) + _balance(claim, true)
    off, marginal = np.nan, False
    if true.hessian is not None and np.isfinite(true.hessian).all():
        unstable, off, marginal = _stability(claim, true)
        refuted += unstable
    return Verdict(refuted, claim.residual(true), float(true.volumes.min()), off, marginal)


def _command(claim: Claim) -> list[str]:
    """What is refuted by the input alone."""
    refuted, commanded = [], np.asarray(claim.answer.ratios)
    if jb.Status.INVALID in claim.status:
        refuted.append("INVALID, but every parameter is in its range")
    largest = np.maximum(np.abs(claim.ratios), np.abs(claim.problem.rest_commands))
    if not (np.abs(commanded - claim.ratios) <= 4 * claim.eps * largest).all():
        refuted.append(f"ratios {commanded} are not the command {claim.ratios}")
    return refuted


def _finite(claim: Claim) -> bool:
    """Whether every number of the answer is; of one that is not `OK` those that it must have."""
    names = ["x", "energy", "residual", "smallest_jacobian", "reached"]
    if claim.status == 0:
        names += ["correction", "tolerance", "ratios"]
    return all(np.isfinite(np.asarray(getattr(claim.answer, name))).all() for name in names)


def _state(claim: Claim, true: Facts) -> list[str]:
    """Supports, energy and what is finite."""
    refuted, x, fixed = [], np.asarray(claim.answer.x), np.asarray(claim.problem.fixed)
    if not np.array_equal(x[fixed], np.asarray(claim.problem.nodes, x.dtype)[fixed]):
        refuted.append("a fixed coordinate has moved")
    # A walk that broke off has moved its supports as far as it came.
    moves = float(claim.answer.reached) * claim.problem.displacements(claim.ratios)
    rest = np.asarray(claim.problem.nodes, np.float64)
    room = 2 * claim.eps * (np.abs(rest) + np.abs(moves))
    astray = np.abs(claim.x - rest - moves) > room
    if (astray & claim.problem.held & ~fixed).any():
        refuted.append("a support is not where its command puts it")
    rounded = claim.eps * claim.span
    slack = 16 * (claim.eps * true.energy_scale + rounded * true.scale_sum) + true.cancelled
    slack += x.size * true.stiffest * rounded**2
    if not abs(float(claim.answer.energy) - true.energy) <= slack:
        refuted.append(f"energy {float(claim.answer.energy):.9g}, but it is {true.energy:.9g}")
    # What is finite here may be too large for the dtype of the solve.
    largest = max(true.energy_scale, true.scale_sum, true.stiffest)
    fits = largest < 1e-4 * float(np.finfo(x.dtype).max) and np.isfinite(true.gradient).all()
    if jb.Status.NONFINITE in claim.status and np.isfinite(true.energy) and fits:
        refuted.append("NONFINITE, but energy and forces are finite")
    return refuted


def _volume(claim: Claim, true: Facts) -> list[str]:
    """`J`, of an element with six nodes anywhere in it. A bound under it may be claimed in its place."""
    refuted, (volume, bound) = [], _through(claim, float(true.volumes.min()), float(true.bounds.min()))
    slack = 16 * claim.eps * float(np.max(claim.reach / true.heights * np.maximum(1, np.sqrt(np.abs(true.volumes)))))
    claimed, room = float(claim.answer.smallest_jacobian), slack * max(1, abs(bound))
    if not bound - room <= claimed <= volume + room:
        refuted.append(f"smallest J {claimed:.6g}, but it is {volume:.6g}")
    if jb.Status.INVERTED in claim.status and not bound <= slack:
        refuted.append(f"INVERTED, but the smallest J is {volume:.3g}")
    if jb.Status.INVERTED not in claim.status and not volume > -slack:
        refuted.append(f"J = {volume:.3g}, but not INVERTED")
        return refuted
    y = claim.problem.relative(claim.x)
    inside = [c for c, moved in claim.problem.contacts(claim.ratios) if swallowed(claim.problem, c, moved, y)]
    if inside and jb.Status.INVERTED not in claim.status:
        refuted.append(f"the {inside[0].shape} lies in the body, but not INVERTED")
    return refuted


def _through(claim: Claim, volume: float, bound: float) -> tuple[float, float]:
    """The least `J` and the bound under it, where an obstacle in the body counts as a negative `J`.

    `Solution.smallest_jacobian` may then be minus the cosine between the outward normal of the surface and the way out
    of the obstacle, at the point of quadrature where that is largest. Points that are inside only within round-off
    lower the bound, and no others.
    """
    for contact, moved in claim.problem.contacts(claim.ratios):
        found, off = sides(claim.problem, contact, moved, claim.problem.relative(claim.x)), 4 * claim.eps * claim.span
        turned = off * found.turns
        sure = (found.gaps < -off) & (found.cosines > turned)
        maybe = (found.gaps < off) & (found.cosines > -turned)
        volume = min(volume, float(np.min(turned - found.cosines, where=sure, initial=np.inf)))
        bound = min(bound, float(np.min(-turned - found.cosines, where=maybe, initial=np.inf)))
    return volume, bound


def _overlap(claim: Claim) -> list[str]:
    """Edges of the surface that cross. A rod has none."""
    if claim.problem.is_rod:
        return []
    found = crossings(claim.problem.relative(claim.x), claim.problem.elements)
    if len(found.sure) and not claim.status & OVERLAPPING:
        pair = surface(claim.problem.elements)[found.sure[0]].tolist()
        return [f"edges {pair[0]} and {pair[1]} cross ({len(found.sure)} such pairs), but not OVERLAPPING"]
    if claim.status & OVERLAPPING and not found.possible:
        return ["OVERLAPPING, but no edges cross"]
    return []


def _balance(claim: Claim, true: Facts) -> list[str]:
    """Forces, under the command or under as much of it as was reached."""
    refuted, reached, residual = [], float(claim.answer.reached), claim.residual(true)
    if jb.Status.NOT_CONVERGED in claim.status:
        if residual < claim.rtol / FACTOR and reached == 1:
            refuted.append(f"NOT_CONVERGED, but the residual is {residual:.3g}")
        if reached < 1 and not _residual_partway(claim, reached) <= FACTOR * claim.rtol:
            refuted.append(f"x is no equilibrium at {reached:.4g} of the way")
    elif not residual <= FACTOR * claim.rtol:
        refuted.append(f"residual {residual:.3g}, over the tolerance {claim.rtol:.0e}")
    elif reached != 1:
        refuted.append(f"reached {reached} without NOT_CONVERGED")
    return refuted


def _residual_partway(claim: Claim, reached: float) -> float:
    """Residual under a fraction of the command. Dead loads grow with it in a single solve, and not in a ramp."""
    rest = claim.problem.rest_commands
    way = rest + reached * (np.asarray(claim.ratios, np.float64) - rest)
    shares = (reached, 1.0) if claim.problem.has_loads else (1.0,)
    return min(claim.residual(facts(claim.problem, way, claim.x, dense=False, loaded=s)) for s in shares)


def _stability(claim: Claim, true: Facts) -> tuple[list[str], float, bool]:
    """What is refuted by the Hessian, how far away the equilibrium is, and whether round-off decides the sign."""
    refuted: list[str] = []
    slack = EIGEN * claim.eps * np.sqrt(len(true.hessian)) * true.stiffest
    if jb.Status.UNSTABLE in claim.status:
        if definite(true.hessian, -slack) is not None:
            refuted.append("UNSTABLE, but the Hessian is positive definite")
        return refuted, np.nan, False
    factor = definite(true.hessian, 0.0)
    if factor is None:
        if definite(true.hessian, slack) is None:
            lowest = scipy.linalg.eigvalsh(true.hessian, subset_by_index=[0, 0])[0]
            refuted.append(f"not UNSTABLE, but an eigenvalue is {lowest:.3g} (stiffest {true.stiffest:.3g})")
        return refuted, np.nan, True
    off = _off(claim, true, factor)
    if claim.status == 0 and not off <= OFF:
        refuted.append(f"the equilibrium is {off:.3g} of the body away")
    return refuted, off, False


def _off(claim: Claim, true: Facts, factor: np.ndarray) -> float:
    """How far Newton's method moves a node from `x` until it settles, over the size of the body; infinite if it does
    not. One step tells where that is short, or many would take long."""
    problem, free = claim.problem, ~claim.problem.held
    start = claim.problem.relative(claim.x)
    x = start.copy()
    for _ in range(STEPS):
        step = scipy.linalg.cho_solve((factor, True), true.gradient)
        x[free] -= step
        last, off = (float(np.abs(move).max()) / problem.size for move in (step, x - start))
        if last <= SETTLED or claim.status != 0 or len(step) > MOST:
            return off
        true = facts_from_first(problem, claim.ratios, x)
        found = definite(true.hessian, 0.0) if np.isfinite(true.hessian).all() else None
        if found is None:
            break
        factor = found
    return np.inf


def definite(matrix: np.ndarray, shift: float) -> np.ndarray | None:
    """Cholesky factor of `matrix + shift I`, or None if that is not positive definite."""
    shifted = matrix.copy()
    shifted[np.diag_indices_from(shifted)] += shift
    try:
        return scipy.linalg.cholesky(shifted, lower=True, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError:
        return None


# -------------------------------------------------------------------------------------------- derivatives


def refuted_slope(problem: Problem, ratios: np.ndarray, x: np.ndarray, tip: np.ndarray, claimed: Any) -> list[str]:
    """Compare the derivative `(d, m)` of the mean position of the nodes `tip` in the commands with the exact one at
    `x`, `-K^-1 dg/dr` by the implicit function theorem. That `x` is an equilibrium is for `verify` to say."""
    dtype, free = np.asarray(claimed).dtype, ~problem.held
    claimed, ratios = np.asarray(claimed, np.float64), np.asarray(ratios, np.asarray(x).dtype)
    true = facts(problem, ratios, np.asarray(x, np.float64))
    factor = definite(true.hessian, 0.0)
    if factor is None:
        return []
    forces, moves = command_forces(problem, ratios, x, true.rows)
    moves[free] = -scipy.linalg.cho_solve((factor, True), forces)
    slope = moves[np.asarray(tip)].mean(axis=0)[: claimed.shape[0]]
    inverse, _ = scipy.linalg.lapack.dpocon(factor, np.abs(true.hessian).sum(axis=0).max(), uplo="L")
    rounded = float(np.finfo(dtype).eps) * max(1.0, float(np.abs(np.asarray(x)).max()) / problem.size)
    refuted, start = [], 0
    # Commands of different kinds have different units.
    for action, _, commands in problem.commanded(ratios):
        own = slice(start, start := start + len(commands))
        if own.start == own.stop:
            continue
        noise = rounded / inverse * np.abs(moves[..., own]).max()
        apart, largest = np.abs(claimed[:, own] - slope[:, own]).max(), np.abs(slope[:, own]).max()
        if not apart <= SLOPE * largest + noise:
            off, may = (value / largest if largest else np.inf for value in (apart, noise))
            kind = type(action).__name__.lower()
            refuted.append(f"slope off by {off:.3g} of itself, of which {may:.3g} may be round-off ({kind})")
    return refuted
