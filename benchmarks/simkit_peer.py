"""The reference ramp in simkit 0.1.8: its own energies, its own Newton solver and line search.

The scene is that of simkit's tutorial 16, and it is built as that tutorial builds it: operators precomputed, the left
edge held by simkit's penalty of 1e9, a ramp of 28 poses whose first is the rest state, each of the others solved by
`simkit.solvers.newton_solver` from the one before, at most 40 iterations, projected Hessians, line search on, the
default tolerance 1e-6 (on the length of a step; simkit does not look at forces). Two things differ:

- simkit's spring has a constant stiffness. The reference tendon's grows as it is shortened: here each command sets
  `k = 2e3 / l*^2` at its rest length `l*`, through simkit's own arguments.
- Both springs are one term of two edges with a prebuilt operator (simkit's `_z` functions), which is faster than the
  tutorial's two terms.

What is timed, by `benchmarks.single` and `benchmarks.many`, is the solve alone. Each pose is judged by code that shares
nothing with either library: its residual, and whether it stopped at the cap or because the line search cut the step.
Stopping there is not converging, and simkit says nothing about it: the penalty leaves energies of 1e10 whose round-off
hides the descent. Its exact Hessians (`psd=False`, which the tutorial offers for comparison) with full steps
(`do_line_search=False`) reach 1e-9. The penalty moves the tip by about 2e-6 degrees.
"""

from __future__ import annotations

import warnings
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.sparse

with warnings.catch_warnings():
    # It warns of its optional parts, which are not needed here.
    warnings.simplefilter("ignore")
    import simkit
from simkit import energies
from simkit.solvers import newton_solver

import jaxbeam as jb
from benchmarks import reference

MATERIAL = "macklin-mueller-neo-hookean"
PENALTY = 1e9


class Settings(NamedTuple):
    """Of simkit's Newton solver, by default those of its tutorial. `exact` uses true Hessians, not projected ones."""

    tolerance: float = 1e-6
    max_iterations: int = 40
    exact: bool = False
    line_search: bool = True


class Beam(NamedTuple):
    """simkit's operators, all constant: built once, outside the timing."""

    raw: reference.Problem
    gradient: scipy.sparse.csc_matrix
    volume: np.ndarray
    mu: np.ndarray
    lam: np.ndarray
    clamp: scipy.sparse.csc_matrix
    clamp_force: np.ndarray
    clamp_energy: float
    edges: scipy.sparse.csc_matrix
    weights: np.ndarray


@lru_cache(maxsize=4)
def build(nx: int = reference.NX, ny: int = reference.NY) -> Beam:
    """The operators of the reference beam on `nx` x `ny` nodes."""
    raw = reference.problem(jb.tendon_beam(nx, ny))
    nodes, elements = raw.nodes, np.asarray(raw.elements)
    mu, lam = simkit.ympr_to_lame(reference.YOUNG, reference.POISSON)
    held = np.flatnonzero(np.asarray(raw.fixed).all(axis=1))
    clamp, clamp_force = simkit.dirichlet_penalty(held, nodes[held], len(nodes), PENALTY)
    edges = simkit.edge_displacement_jacobian(nodes, raw.tendons[0].lines)
    return Beam(
        raw=raw,
        gradient=simkit.deformation_jacobian(nodes, elements),
        volume=simkit.volume(nodes, elements),
        mu=np.full((len(elements), 1), mu),
        lam=np.full((len(elements), 1), lam),
        clamp=clamp,
        clamp_force=clamp_force,
        clamp_energy=0.5 * PENALTY * float(np.sum(nodes[held] ** 2)),
        edges=scipy.sparse.kron(edges, scipy.sparse.identity(2)).tocsc(),
        weights=np.ones((len(raw.tendons[0].lines), 1)),
    )


def solve(beam: Beam, rest_lengths: np.ndarray, x: np.ndarray, settings: Settings) -> tuple[np.ndarray, dict]:
    """One pose from the start `x` `(2 n, 1)`, for tendons commanded to `rest_lengths` `(m,)`; simkit's report too."""
    b = beam
    rest = rest_lengths[:, None]
    stiffness = reference.TENDON_MODULUS / rest**2
    projected = not settings.exact

    def energy(x: np.ndarray) -> float:
        return (
            energies.elastic_energy_x(x.reshape(-1, 2), b.gradient, b.mu, b.lam, b.volume, MATERIAL)
            + energies.mass_springs_energy_z(x, b.edges, stiffness, b.weights, rest)
            + energies.quadratic_energy(x, b.clamp, b.clamp_force)
            + b.clamp_energy
        )

    def gradient(x: np.ndarray) -> np.ndarray:
        return (
            energies.elastic_gradient_x(x.reshape(-1, 2), b.gradient, b.mu, b.lam, b.volume, MATERIAL)
            + energies.mass_springs_gradient_z(x, b.edges, stiffness, b.weights, rest)
            + energies.quadratic_gradient(x, b.clamp, b.clamp_force)
        )

    def hessian(x: np.ndarray) -> scipy.sparse.spmatrix:
        u = x.reshape(-1, 2)
        return (
            energies.elastic_hessian_x(u, b.gradient, b.mu, b.lam, b.volume, MATERIAL, psd=projected)
            + energies.mass_springs_hessian_z(x, b.edges, stiffness, b.weights, rest, psd=projected)
            + energies.quadratic_hessian(b.clamp)
        )

    return newton_solver(
        x,
        energy,
        gradient,
        hessian,
        settings.tolerance,
        settings.max_iterations,
        settings.line_search,
        return_info=True,
    )


class Path(NamedTuple):
    """What simkit returned: positions `(2 n, 1)` of each of `S` poses, and its report on each but the first."""

    states: list[np.ndarray]
    reports: list[dict]


def follow(ratios: tuple[float, ...], steps: int = reference.STEPS, settings: Settings = Settings()) -> Path:
    """The solve alone, pose by pose, of a ramp from rest to `ratios`: what is timed."""
    beam = build()
    nodes, lines = beam.raw.nodes, beam.raw.tendons[0].lines
    natural = np.linalg.norm(nodes[lines[:, 0]] - nodes[lines[:, 1]], axis=1)
    x = nodes.reshape(-1, 1).copy()
    states, reports = [x], []
    for row in reference.commands(ratios, steps)[1:]:
        x, info = solve(beam, row * natural, x, settings)
        states.append(x)
        reports.append(info)
    return Path(states, reports)


def judge(path: Path, ratios: tuple[float, ...], settings: Settings) -> dict[str, float]:
    """Iterations of all poses, how many stopped at the cap or were stalled by the line search, the largest residual and
    the tip angle at the end."""
    raw = build().raw
    states = [state.reshape(-1, 2) for state in path.states]
    # The last step of each pose: how long it was wanted, and how much of it the line search let through.
    wanted = np.array([np.linalg.norm(r["dx"][-1]) for r in path.reports])
    taken = wanted * np.array([r["alphas"][-1] for r in path.reports])
    way = reference.commands(ratios, len(states))
    return {
        "steps": sum(len(r["dx"]) for r in path.reports),
        "capped": int(np.sum(taken >= settings.tolerance)),
        "stalled": int(np.sum((taken < settings.tolerance) & (wanted >= settings.tolerance))),
        "residual": max(reference.residual(raw, row, x) for row, x in zip(way, states, strict=True)),
        "tip angle": reference.tip_angle(raw, states[-1]),
    }
