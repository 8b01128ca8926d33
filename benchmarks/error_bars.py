"""Do the error bars hold? `estimate_error` and `solve_to` against solutions on a much finer mesh.

    python -m benchmarks.error_bars [--quick]

1. 108 scenes: six meshes of three- and six-node triangles, ratios 0.95, 0.8 and 0.6, Poisson's ratios 0.3, 0.45 and
   0.49, anchors of width 0.25 and 0.5; the tip angle and the tension of each. How often the true error is below the
   bar, and how often the estimate over the true error lies between 0.5 and 2. Errors that are no larger than that of
   the finest mesh itself tell nothing and are left out.
2. 40 scenes that took no part in choosing any constant: `solve_to` from 7 x 3 corners to a random tolerance. How often
   it is met in truth, on how fine a rung and in what time.
"""

from __future__ import annotations

import benchmarks.one_thread  # isort: skip # noqa: F401

import time
from typing import Any

import jax
import numpy as np

import jaxbeam as jb
from benchmarks import report
from benchmarks.accuracy import FINEST

MESHES: dict[str, dict[str, Any]] = {
    "P1 15 x 4": {"nx": 15, "ny": 4},
    "P1 29 x 7 crossed": {"nx": 29, "ny": 7, "diagonals": "crossed"},
    "P2 7 x 3": {"nx": 7, "ny": 3, "order": 2},
    "P2 15 x 5": {"nx": 15, "ny": 5, "order": 2},
    "P2 11 x 5 graded": {"nx": 11, "ny": 5, "order": 2, "graded": True},
    "P2 9 x 4 crossed graded": {"nx": 9, "ny": 4, "order": 2, "graded": True, "diagonals": "crossed"},
}
RATIOS = (0.95, 0.8, 0.6)
# Relative error of the finest mesh, see `benchmarks.accuracy`.
REFERENCE = 1.1e-4


def tension(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """Of the top tendon."""
    return jb.tendon_tensions(scene, x)[0]


MEASURES = {"tip angle": jb.tip_angle, "tension": tension}


def truths(poisson: float, width: float) -> dict[tuple[float, str], float]:
    """Measures at every ratio on the finest mesh, along one ramp."""
    scene = jb.tendon_beam(poisson=poisson, anchor_width=width, **FINEST)
    path = jb.check(jb.ramp(scene, [0.6, 1.0], steps=9))
    found = {}
    for ratio in RATIOS:
        k = int(np.argmin(np.abs(np.asarray(path.ratios)[:, 0] - ratio)))
        for name, measure in MEASURES.items():
            found[ratio, name] = float(measure(jb.command(scene, [ratio, 1.0]), path.x[k]))
    return found


def bars(quick: bool) -> list[dict[str, Any]]:
    """Estimates and true errors of every scene and measure."""
    rows = []
    for width in (0.25, 0.5)[: 1 if quick else 2]:
        for poisson in (0.3, 0.45, 0.49)[1 if quick else 0 : 2 if quick else 3]:
            exact = truths(poisson, width)
            for mesh, settings in MESHES.items():
                base = jb.tendon_beam(poisson=poisson, anchor_width=width, **settings)
                for ratio in RATIOS:
                    scene = jb.command(base, [ratio, 1.0])
                    solution = jb.equilibrium(scene)
                    for name, measure in MEASURES.items():
                        found = jb.estimate_error(scene, solution, measure)
                        row = {"mesh": mesh, "poisson": poisson, "width": width, "ratio": ratio, "measure": name}
                        true = exact[ratio, name] - found.value
                        rows.append(row | {"true": true, "exact": exact[ratio, name], **found._asdict()})
    return rows


def print_bars(rows: list[dict[str, Any]]) -> None:
    """Shares of bars that hold and of estimates that are near, for each mesh and over all."""
    lines = []
    for mesh in [*MESHES, "all"]:
        own = [row for row in rows if mesh in ("all", row["mesh"])]
        told = [row for row in own if abs(row["true"]) > 3 * REFERENCE * abs(row["exact"])]
        held = np.mean([abs(row["true"]) <= row["bar"] + REFERENCE * abs(row["exact"]) for row in own])
        ratio = np.array([abs(row["discretisation"] / row["true"]) for row in told])
        near = np.mean((ratio >= 0.5) & (ratio <= 2))
        error = np.median([abs(row["true"] / row["exact"]) for row in own])
        lines.append((mesh, len(own), 100 * error, 100 * held, len(told), 100 * near, np.median(ratio)))
    report.table(("mesh", "bars", "median error %", "hold %", "told", "near %", "median estimate / true"), lines)
    for row in rows:
        if abs(row["true"]) > row["bar"] + REFERENCE * abs(row["exact"]):
            print({key: row[key] for key in ("mesh", "poisson", "width", "ratio", "measure", "value", "true", "bar")})


def climbs(count: int) -> list[dict[str, Any]]:
    """`solve_to` for random scenes, tolerances and measures; second calls are timed."""
    rng, rows = np.random.default_rng(5), []
    for _ in range(count):
        ratio, poisson = rng.uniform(0.55, 0.97), rng.uniform(0.3, 0.49)
        name = ("tip angle", "tension")[rng.integers(2)]
        settings = {"poisson": poisson, "anchor_width": 0.25}
        scene = jb.command(jb.tendon_beam(7, 3, order=2, graded=True, **settings), [ratio, 1.0])
        fine = jb.command(jb.tendon_beam(**FINEST, **settings), [ratio, 1.0])
        exact = float(MEASURES[name](fine, jb.check(jb.equilibrium(fine)).x))
        tolerance = abs(exact) * 10 ** rng.uniform(-2.7, -1.0)
        jb.solve_to(scene, MEASURES[name], tolerance)
        start = time.perf_counter()
        answer = jb.solve_to(scene, MEASURES[name], tolerance)
        elapsed = time.perf_counter() - start
        row = {"ratio": ratio, "poisson": poisson, "measure": name, "tolerance": tolerance / abs(exact)}
        row |= {"met": answer.met, "rung": answer.rung, "bar": answer.estimate.bar / abs(exact)}
        rows.append(row | {"error": abs(answer.value / exact - 1), "seconds": elapsed})
    return rows


def main() -> None:
    parser = report.options(__doc__)
    parser.add_argument("--quick", action="store_true", help="a sixth of the scenes")
    options = parser.parse_args()
    report.head("Do the error bars hold?")
    rows = bars(options.quick)
    print_bars(rows)
    found = climbs(6 if options.quick else 40)
    met = np.mean([row["met"] and row["error"] <= row["tolerance"] + REFERENCE for row in found])
    report.table(
        ("tolerance %", "bar %", "error %", "rung", "ms"),
        [
            (*(100 * row[key] for key in ("tolerance", "bar", "error")), row["rung"], 1e3 * row["seconds"])
            for row in found
        ],
    )
    mean, rungs = np.mean([row["seconds"] for row in found]), np.bincount([row["rung"] for row in found])
    print(f"tolerance met in truth: {100 * met:.1f} %; rungs {rungs.tolist()}; {1e3 * mean:.1f} ms on average")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
