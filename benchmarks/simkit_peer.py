"""The reference ramp in simkit 0.1.8: its own energies, its own Newton solver and line search.

    python -m benchmarks.simkit_peer [--out out/benchmarks]

The scene is that of simkit's tutorial 16, and it is built as that tutorial builds it: operators precomputed, the left
edge held by simkit's penalty of 1e9, a ramp of 28 poses whose first is the rest state, each of the others solved by
`simkit.solvers.newton_solver` from the one before, at most 40 iterations, projected Hessians, line search on, the
default tolerance 1e-6 (on the length of a step; simkit does not look at forces). Two things differ:

- simkit's spring has a constant stiffness. The reference tendon's grows as it is shortened: here each command sets
  `k = 2e3 / l*^2` at its rest length `l*`, through simkit's own arguments.
- Both springs are one term of two edges with a prebuilt operator (simkit's `_z` functions), which is faster than the
  tutorial's two terms.

What is timed is the solve alone. Printed for several settings of its solver: seconds, iterations, poses that stopped
at the cap, poses that stopped because the line search cut the step, and residuals, by code that shares nothing with
either library. Stopping there is not converging, and simkit says nothing about it: the penalty leaves energies of 1e10
whose round-off hides the descent. Its exact Hessians (`psd=False`, which the tutorial offers for comparison) and full
steps (`do_line_search=False`) reach 1e-9; both are reported.
"""

from __future__ import annotations

import benchmarks.one_thread  # isort: skip # noqa: F401

import time
import warnings
from functools import lru_cache
from typing import NamedTuple

import jax
import numpy as np
import scipy.sparse

with warnings.catch_warnings():
    # It warns of its optional parts, which are not needed here.
    warnings.simplefilter("ignore")
    import simkit
from simkit import energies
from simkit.solvers import newton_solver

import jaxbeam as jb
from benchmarks import reference, report

MATERIAL = "macklin-mueller-neo-hookean"
PENALTY = 1e9


class Settings(NamedTuple):
    """Of simkit's Newton solver, by default those of its tutorial. `exact` uses true Hessians, not projected ones."""

    tolerance: float = 1e-6
    max_iterations: int = 40
    exact: bool = False
    line_search: bool = True


class Ramp(NamedTuple):
    """What a ramp gave, with `S` poses (the first is at rest, and is not solved).

    seconds: of the solve alone. iterations: of Newton's method, for each pose. capped: whether it stopped at the
    cap. stalled: whether it stopped because the line search cut a step that was still too long to stop at.
    residuals: of each pose. x: `(n, 2)` at the end.
    """

    seconds: float
    iterations: list[int]
    capped: list[bool]
    stalled: list[bool]
    residuals: list[float]
    x: np.ndarray
    tip_angle: float
    tendon_lengths: np.ndarray


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


def judge(path: Path, ratios: tuple[float, ...], seconds: float, settings: Settings = Settings()) -> Ramp:
    """How far each pose is from balance, and how its solve ended."""
    raw = build().raw
    states = [state.reshape(-1, 2) for state in path.states]
    # The last step of each pose: how long it was wanted, and how much of it the line search let through.
    wanted = np.array([np.linalg.norm(r["dx"][-1]) for r in path.reports])
    taken = wanted * np.array([r["alphas"][-1] for r in path.reports])
    way = reference.commands(ratios, len(states))
    end = states[-1]
    return Ramp(
        seconds=seconds,
        iterations=[0, *(len(r["dx"]) for r in path.reports)],
        capped=[False, *(taken >= settings.tolerance).tolist()],
        stalled=[False, *((taken < settings.tolerance) & (wanted >= settings.tolerance)).tolist()],
        residuals=[reference.residual(raw, row, x) for row, x in zip(way, states, strict=True)],
        x=end,
        tip_angle=reference.tip_angle(raw, end),
        tendon_lengths=np.linalg.norm(end[raw.tendons[0].lines[:, 0]] - end[raw.tendons[0].lines[:, 1]], axis=1),
    )


def ramp(ratios: tuple[float, ...], steps: int = reference.STEPS, settings: Settings = Settings()) -> Ramp:
    """Pull the tendons from rest to `ratios` in `steps` poses, the first at rest."""
    build()
    start = time.perf_counter()
    path = follow(ratios, steps, settings)
    return judge(path, ratios, time.perf_counter() - start, settings)


CHOICES = {
    "as its tutorial": Settings(),
    "exact Hessians": Settings(exact=True),
    "exact, full steps": Settings(exact=True, line_search=False),
    "exact, full steps, tolerance 1e-9": Settings(1e-9, exact=True, line_search=False),
    "tolerance 1e-9, cap 200": Settings(1e-9, 200),
}


def row(name: str, found: Ramp) -> tuple:
    """One line of the table."""
    return (
        name,
        found.seconds,
        sum(found.iterations),
        max(found.iterations),
        sum(found.capped),
        sum(found.stalled),
        max(found.residuals),
        found.residuals[-1],
        f"{found.tip_angle:.7f}",
    )


HEADER = ("simkit", "seconds", "iterations", "most", "capped", "stalled", "residual, worst", "at the end", "tip angle")


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    options = report.options(__doc__).parse_args(arguments)
    report.head("The reference ramp in simkit")
    ramp(reference.COMMAND, 2)
    found = {name: ramp(reference.COMMAND, settings=settings) for name, settings in CHOICES.items()}
    report.table(HEADER, [row(name, f) for name, f in found.items()])
    print(f"the converged tip angle is {reference.TIP_ANGLE}; the penalty moves it by about 2e-6")
    report.save(options.out, "simkit_peer", {name: f._asdict() for name, f in found.items()})


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
