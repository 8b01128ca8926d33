"""Verification of answers by code that shares nothing with the solver.

The energy is written anew from raw arrays, in the deformation gradient `F` and not in `H = F - I`, always in
float64; forces and the dense Hessian follow by automatic differentiation, stability by a dense Cholesky
factorisation, `J` from areas of triangles. `refutations` lists what an answer claims and does not keep.

What counts as round-off, with `eps` that of the dtype of the solve and `K` the dense Hessian:

- forces: the library's own definition, `1.5 eps max |x| max K_ii`; the tolerance is met within `FACTOR`, for a
  different order of summation;
- eigenvalues: a Cholesky factorisation of `N` unknowns is exact for a matrix that differs by about
  `eps sqrt(N) max K_ii`, so `EIGEN eps sqrt(N) max K_ii` cannot be told from zero;
- energies: `16 eps` of the magnitudes added up and of forces times positions, and, as the form in `F` cancels where
  that in `H` does not, `16 eps` of float64 of the moduli times areas;
- `J`: positions are rounded by `eps max |x|`, which moves `J` by that over the height of the element.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

import jaxbeam as jb

FACTOR = 2.0
EIGEN = 4.0
FORCE = 1.5
RTOL = {"float32": 1e-6, "float64": 1e-10}


@dataclasses.dataclass(frozen=True)
class Problem:
    """A scene as raw arrays: `n` nodes, `t` triangles, `m` tendons through `k` nodes each.

    young, poisson: `(t,)` or scalars. modulus: `(m,)` or scalar. corrected: whether `lam` is raised by `mu`.
    """

    nodes: np.ndarray
    elements: np.ndarray
    fixed: np.ndarray
    young: Any
    poisson: Any
    material: str
    tendons: np.ndarray
    modulus: Any
    law: str
    corrected: bool = False

    def arrays(self, ratios: np.ndarray) -> Arrays:
        """What the energy needs, in float64."""
        nodes = np.asarray(self.nodes, np.float64)
        count, lines = len(self.elements), np.asarray(self.tendons)
        young, poisson = (np.broadcast_to(np.asarray(v, np.float64), count) for v in (self.young, self.poisson))
        mu = young / 2 / (1 + poisson)
        lam = 2 * mu * poisson / (1 - 2 * poisson) + (mu if self.corrected else 0)
        natural = np.linalg.norm(np.diff(nodes[lines], axis=1), axis=2).sum(axis=1)
        wanted = np.asarray(ratios, np.float64) * natural
        power = {"constant": 0, "inverse": 1, "inverse-square": 2}[self.law]
        stiffness = np.asarray(self.modulus, np.float64) / wanted**power
        return Arrays(nodes, np.asarray(self.elements), mu, lam, lines, stiffness, wanted)


class Arrays(NamedTuple):
    nodes: np.ndarray
    elements: np.ndarray
    mu: np.ndarray
    lam: np.ndarray
    lines: np.ndarray
    stiffness: np.ndarray
    wanted: np.ndarray


# --------------------------------------------------------------------------------- the energy, anew


def density(F: jax.Array, mu: jax.Array, lam: jax.Array, material: str) -> jax.Array:
    """Energy per area at rest, from the deformation gradient `F` `(2, 2)`."""
    J, C = jnp.linalg.det(F), F.T @ F
    if material == "macklin_mueller":
        return mu / 2 * (jnp.trace(C) - 2) - mu * (J - 1) + lam / 2 * (J - 1) ** 2
    if material == "neo_hookean":
        return mu / 2 * (jnp.trace(C) - 2) - mu * jnp.log(J) + lam / 2 * jnp.log(J) ** 2
    strain = {"saint_venant_kirchhoff": (C - jnp.eye(2)) / 2, "linear_elastic": (F + F.T) / 2 - jnp.eye(2)}[material]
    return mu * jnp.trace(strain @ strain) + lam / 2 * jnp.trace(strain) ** 2


def triangle_energy(x: jax.Array, rest: jax.Array, mu: jax.Array, lam: jax.Array, material: str) -> jax.Array:
    """Energy of one triangle at corners `x` `(3, 2)`."""
    edges, rest_edges = (x[1:] - x[0]).T, (rest[1:] - rest[0]).T
    F = edges @ jnp.linalg.inv(rest_edges)
    return jnp.linalg.det(rest_edges) / 2 * density(F, mu, lam, material)


def tendon_energy(x: jax.Array, stiffness: jax.Array, wanted: jax.Array) -> jax.Array:
    """Energy of one tendon through `x` `(k, 2)`. A segment of no length has no direction, and none is given."""
    edge = jnp.diff(x, axis=0)
    meet = jnp.all(edge == 0, axis=1)
    length = jnp.sum(jnp.where(meet, 0, jnp.linalg.norm(jnp.where(meet[:, None], 1.0, edge), axis=1)))
    return stiffness / 2 * (length - wanted) ** 2


def total_energy(x: jax.Array, a: Arrays, material: str) -> jax.Array:
    """Energy of everything at node positions `x` `(n, 2)`."""
    solid = jax.vmap(partial(triangle_energy, material=material))(x[a.elements], a.nodes[a.elements], a.mu, a.lam)
    return jnp.sum(solid) + jnp.sum(jax.vmap(tendon_energy)(x[a.lines], a.stiffness, a.wanted))


@partial(jax.jit, static_argnames="material")
def _stencils(x: jax.Array, a: Arrays, material: str) -> Any:
    """Energy, gradient, and for each kind of stencil its energies, gradients and Hessians."""
    a = Arrays(*(jnp.asarray(field) for field in a))
    triangle = partial(triangle_energy, material=material)
    out = []
    for energy, corners, params in (
        (triangle, x[a.elements], (a.nodes[a.elements], a.mu, a.lam)),
        (tendon_energy, x[a.lines], (a.stiffness, a.wanted)),
    ):
        both, hessian = jax.value_and_grad(energy), jax.hessian(energy)
        out.append((jax.vmap(both)(corners, *params), jax.vmap(hessian)(corners, *params)))
    return jax.value_and_grad(total_energy)(x, a, material), out


class Facts(NamedTuple):
    """What is true at `x`. energy_scale and scale are sums of magnitudes; hessian is over free coordinates."""

    energy: float
    energy_scale: float
    cancelled: float
    unbalanced: float
    gradient: np.ndarray
    scale: float
    scale_sum: float
    hessian: np.ndarray | None
    stiffest: float
    volumes: np.ndarray
    heights: np.ndarray


def facts(problem: Problem, ratios: np.ndarray, x: np.ndarray, dense: bool = True) -> Facts:
    """Energy, forces and, if asked for, the dense Hessian at `x` `(n, 2)`."""
    a, x = problem.arrays(ratios), np.asarray(x, np.float64)
    free = ~np.asarray(problem.fixed).ravel()
    (energy, gradient), stencils = jax.tree.map(np.asarray, _stencils(x, a, problem.material))
    scale, diagonal = np.zeros(x.shape), np.zeros(x.size)
    hessian = np.zeros((x.size, x.size)) if dense else None
    energy_scale = 0.0
    for lines, ((energies, gradients), hessians) in zip((a.elements, a.lines), stencils, strict=True):
        energy_scale += np.abs(energies).sum()
        np.add.at(scale, lines, np.abs(gradients))
        unknowns = (2 * lines[..., None] + np.arange(2)).reshape(len(lines), -1)
        size = unknowns.shape[1]
        hessians = hessians.reshape(-1, size, size)
        np.add.at(diagonal, unknowns, np.diagonal(hessians, axis1=1, axis2=2))
        if dense:
            np.add.at(hessian, (unknowns[:, :, None], unknowns[:, None, :]), hessians)
    rest_areas, areas = signed_areas(a.nodes[a.elements]), signed_areas(x[a.elements])
    longest = np.linalg.norm(a.nodes[a.elements] - np.roll(a.nodes[a.elements], 1, axis=1), axis=2).max(axis=1)
    gradient = gradient.ravel()[free]
    return Facts(
        energy=float(energy),
        energy_scale=float(energy_scale),
        cancelled=16
        * np.finfo(np.float64).eps
        * float(np.sum((2 * a.mu + np.abs(a.lam)) * (rest_areas + np.abs(areas)))),
        unbalanced=float(np.abs(gradient).max()),
        gradient=gradient,
        scale=float(scale.max()),
        scale_sum=float(scale.sum()),
        hessian=hessian[np.ix_(free, free)] if dense else None,
        stiffest=float(np.abs(diagonal[free]).max()),
        volumes=areas / rest_areas,
        heights=rest_areas / longest,
    )


def signed_areas(corners: np.ndarray) -> np.ndarray:
    """Twice the areas of triangles `(t, 3, 2)`."""
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    return ax * by - ay * bx


def definite(matrix: np.ndarray, shift: float) -> np.ndarray | None:
    """Cholesky factor of `matrix + shift I`, or None if that is not positive definite."""
    shifted = matrix.copy()
    shifted[np.diag_indices_from(shifted)] += shift
    try:
        return scipy.linalg.cholesky(shifted, lower=True, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError:
        return None


# --------------------------------------------------------------------------------- claims against facts


class Verdict(NamedTuple):
    """refuted: claims that do not hold, in words. residual: unbalanced force over the force scale. volume: smallest
    `J`. off: how far Newton's step, exact in float64, would still move a node, over the size of the body (an
    estimate of the error of `x`; NaN where the Hessian is not definite). marginal: stable only within round-off."""

    refuted: list[str]
    residual: float
    volume: float
    off: float
    marginal: bool


def verify(problem: Problem, ratios: np.ndarray, answer: Any, stability: bool = True) -> Verdict:
    """Compare one `Solution` (no leading axis) with the facts at its `x` under the command `ratios` `(m,)`.

    A claim of `OK` is refuted by a residual over the tolerance, an eigenvalue below zero, `J <= 0` or anything that
    is not finite; a flag by its contrary. Round-off is allowed as this module's head says.
    """
    dtype = np.asarray(answer.x).dtype
    eps, rtol = float(np.finfo(dtype).eps), RTOL[dtype.name]
    ratios = np.asarray(ratios, dtype)
    status, x = jb.Status(int(answer.status)), np.asarray(answer.x, np.float64)
    refuted = []
    if jb.Status.INVALID in status:
        refuted.append("INVALID, but every parameter is in its range")
    if not np.allclose(np.asarray(answer.ratios), ratios, rtol=4 * eps, atol=0):
        refuted.append(f"ratios {np.asarray(answer.ratios)} are not the command {ratios}")
    numbers = [np.asarray(getattr(answer, name)) for name in ("energy", "residual", "smallest_jacobian", "reached")]
    finite = all(np.isfinite(n).all() for n in [x, *numbers])
    if not finite:
        if not status & (jb.Status.NONFINITE | jb.Status.NOT_CONVERGED):
            refuted.append(f"{status!r} with numbers that are not finite")
        return Verdict(refuted, np.nan, np.nan, np.nan, False)
    rest, fixed = np.asarray(problem.nodes, np.float64), np.asarray(problem.fixed)
    if not np.array_equal(x[fixed], rest[fixed]):
        refuted.append("a fixed coordinate has moved")

    settled = not status & (jb.Status.NOT_CONVERGED | jb.Status.NONFINITE)
    true = facts(problem, ratios, x, dense=stability and settled)
    reach = np.abs(x).max()
    floor = FORCE * eps * true.stiffest * reach
    residual = true.unbalanced / (true.scale + floor / rtol)
    volume = float(true.volumes.min())
    volume_slack = 16 * eps * float(np.max(reach / true.heights * np.maximum(1, np.sqrt(np.abs(true.volumes)))))
    energy_slack = 16 * eps * (true.energy_scale + reach * true.scale_sum) + true.cancelled

    claimed = float(answer.smallest_jacobian)
    if not abs(claimed - volume) <= volume_slack * max(1, abs(volume)):
        refuted.append(f"smallest J {claimed:.6g}, but it is {volume:.6g}")
    if not abs(float(answer.energy) - true.energy) <= energy_slack:
        refuted.append(f"energy {float(answer.energy):.9g}, but it is {true.energy:.9g}")
    if jb.Status.NONFINITE in status and np.isfinite(true.energy) and np.isfinite(true.gradient).all():
        refuted.append("NONFINITE, but energy and forces are finite")
    if jb.Status.INVERTED in status and not volume <= volume_slack:
        refuted.append(f"INVERTED, but the smallest J is {volume:.3g}")
    if jb.Status.INVERTED not in status and not volume > -volume_slack:
        refuted.append(f"J = {volume:.3g}, but not INVERTED")
    reached = float(answer.reached)
    if jb.Status.NOT_CONVERGED in status:
        if residual < rtol / FACTOR and reached == 1:
            refuted.append(f"NOT_CONVERGED, but the residual is {residual:.3g}")
        if reached < 1 and not residual_partway(problem, ratios, x, reached, eps, rtol) <= FACTOR * rtol:
            refuted.append(f"x is no equilibrium at {reached:.4g} of the way")
    elif not residual <= FACTOR * rtol:
        refuted.append(f"residual {residual:.3g}, over the tolerance {rtol:.0e}")
    elif reached != 1:
        refuted.append(f"reached {reached} without NOT_CONVERGED")

    off, marginal = np.nan, False
    if true.hessian is not None and np.isfinite(true.hessian).all():
        slack = EIGEN * eps * np.sqrt(len(true.hessian)) * true.stiffest
        if jb.Status.UNSTABLE in status:
            if definite(true.hessian, -slack) is not None:
                refuted.append("UNSTABLE, but the Hessian is positive definite")
        else:
            factor = definite(true.hessian, 0.0)
            marginal = factor is None
            if marginal and definite(true.hessian, slack) is None:
                lowest = scipy.linalg.eigvalsh(true.hessian, subset_by_index=[0, 0])[0]
                refuted.append(f"not UNSTABLE, but an eigenvalue is {lowest:.3g} (stiffest {true.stiffest:.3g})")
            if factor is not None:
                step = scipy.linalg.cho_solve((factor, True), true.gradient)
                off = float(np.abs(step).max() / np.ptp(rest, axis=0).max())
    return Verdict(refuted, residual, volume, off, marginal)


def residual_partway(
    problem: Problem, ratios: np.ndarray, x: np.ndarray, reached: float, eps: float, rtol: float
) -> float:
    """Residual of `x` under the fraction `reached` of the command."""
    true = facts(problem, 1 + reached * (np.asarray(ratios, np.float64) - 1), x, dense=False)
    return true.unbalanced / (true.scale + FORCE * eps * true.stiffest * np.abs(x).max() / rtol)
