"""The reference scene that the benchmarks share, and a check of answers that shares no code with any solver.

The check is `tests/verify.py`, which writes the energy anew. A residual is the largest unbalanced force on a free
coordinate over jaxbeam's force scale, for the peers too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

import jaxbeam as jb
from tests.verify import Problem, Tendons, facts

NX, NY, LENGTH, HEIGHT = 29, 7, 3.5, 0.8
YOUNG, POISSON, TENDON_MODULUS = 1e4, 0.45, 2e3
COMMAND = (0.4, 1.0)
STEPS = 28
RTOL = 1e-9
# Of the command above: the converged answer on this mesh, by two independent codes.
TIP_ANGLE = 35.5152802
TENDON_LENGTHS = (0.9342211, 1.9252493)
# Round-off of the forces over eps * stiffness * size, as in jaxbeam's force scale.
FORCE_ROUND_OFF = 1.5


def problem(scene: jb.Scene) -> Problem:
    """The raw arrays of a beam with the reference material and tendons, on any mesh of `tendon_beam`."""
    return Problem(
        nodes=np.asarray(scene.mesh.nodes, np.float64),
        elements=scene.mesh.elements,
        fixed=scene.fixed,
        young=YOUNG,
        poisson=POISSON,
        material="macklin_mueller",
        tendons=(Tendons(np.asarray(scene.terms[1].nodes), TENDON_MODULUS, "inverse-square"),),
    )


def residual(raw: Problem, ratios: np.ndarray, x: np.ndarray, rtol: float = RTOL) -> float:
    """Largest unbalanced force on a free coordinate at positions `x` `(n, 2)`, over the force scale."""
    true = facts(raw, ratios, x, dense=False)
    round_off = FORCE_ROUND_OFF * np.finfo(np.float64).eps * true.stiffest * float(np.abs(x).max())
    return true.unbalanced / (true.scale + round_off / rtol)


def commands(ratios: ArrayLike, steps: int = STEPS) -> np.ndarray:
    """The commands `(steps, 2)` of a ramp, the first at rest."""
    return 1 + np.linspace(0, 1, steps)[:, None] * (np.asarray(ratios, float) - 1)


def tip_angle(raw: Problem, x: np.ndarray) -> float:
    """Tip angle of the beam in degrees."""
    tip = raw.nodes[:, 0] >= raw.nodes[:, 0].max() - 1e-9
    rise = np.mean(x[tip, 1] - raw.nodes[tip, 1])
    return float(np.degrees(np.arctan2(rise, np.ptp(raw.nodes[:, 0]))))


def verified(raw: Problem, way: ArrayLike, found: jb.Solution, rtol: float = RTOL) -> float:
    """Check solutions of the commands `way` `(S, 2)`; the largest residual, computed anew.

    Raises:
        RuntimeError: if the forces of one do not balance: its time would mean nothing.
        jaxbeam.EquilibriumError: if one is not `OK`.
    """
    jb.check(found)
    states = np.asarray(found.x).reshape(-1, *raw.nodes.shape)
    worst = max(residual(raw, row, x, rtol) for row, x in zip(np.asarray(way), states, strict=True))
    if not worst <= 2 * rtol:
        raise RuntimeError(f"a timed answer has a residual of {worst:.3g}, over its tolerance {rtol:.0e}")
    return worst
