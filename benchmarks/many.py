"""Many scenes: a sweep of 1,024 asymmetries, and the reachable set of 64 x 64 commands.

    python -m benchmarks.many [--repeats 5] [--out out/benchmarks]

The sweep takes ratios (1 + d, 1 - d) with d in [-0.4, 0.4], each to a relative residual of 1e-9. In turn with it, in
the same process: `lax.map` over `equilibrium` on every 16th of them, and simkit, which ramps each one in 28 steps, on
four of them (see `benchmarks/simkit_peer.py`). Sweeps of 64 and of 4,096 asymmetries show whether a scene costs as
much in a batch of any size, and what memory that takes. One thread, but for a table with all cores. Every answer is
verified by code that shares nothing with the solvers.
"""

from __future__ import annotations

import benchmarks.one_thread  # isort: skip # noqa: F401

import json
import os
import subprocess
import sys
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from benchmarks import reference, report, simkit_peer
from benchmarks.timing import medians, seconds

CORES = os.cpu_count() or 1
SAMPLE = slice(None, None, 16)
SOLVER = jb.Newton(rtol=reference.RTOL)


def asymmetries(count: int) -> np.ndarray:
    """The ratios `(count, 2)`."""
    d = np.linspace(-0.4, 0.4, count)
    return np.stack([1 + d, 1 - d], axis=1)


def on(cores: int, scene: jb.Scene, rows: np.ndarray) -> jb.Solution:
    """A sweep on so many cores."""
    count, os.cpu_count = os.cpu_count, lambda: cores
    try:
        return jb.sweep(scene, rows, SOLVER)
    finally:
        os.cpu_count = count


def sweeps(repeats: int) -> dict[str, Any]:
    """Seconds a scene of each way to solve many."""
    scene = jb.tendon_beam()
    raw, rows = reference.problem(scene), asymmetries(1024)
    mapped = jax.jit(
        lambda rows: jax.lax.map(lambda row: jb.equilibrium(jb.command(scene, row), solver=SOLVER), rows),
        compiler_options={"xla_cpu_use_fusion_emitters": False},  # as the library's own
    )
    few = jnp.asarray(rows[SAMPLE])
    simkit_peer.build()
    four = rows[[0, 300, 700, 1023]]
    runs = {
        "sweep of 1,024": (partial(on, 1, scene, rows), rows),
        "sweep of 64": (partial(on, 1, scene, asymmetries(64)), asymmetries(64)),
        "sweep of 4,096": (partial(on, 1, scene, asymmetries(4096)), asymmetries(4096)),
        "lax.map over equilibrium": (lambda: mapped(few), rows[SAMPLE]),
    }
    residuals: dict[str, float] = {}
    steps: dict[str, float] = {}

    def check(name: str, way: np.ndarray, found: jb.Solution) -> None:
        steps[name] = float(np.mean(found.steps))
        if name not in residuals:
            residuals[name] = reference.verified(raw, way, found)

    checks = [partial(check, name, way) for name, (_, way) in runs.items()]
    times = medians(*(run for run, _ in runs.values()), repeats=repeats, checks=checks)
    simkit = []
    for row in four:
        start = time.perf_counter()
        simkit_peer.follow(tuple(row))
        simkit.append(time.perf_counter() - start)
    peer = float(np.median(simkit))
    each = {name: timing.median / len(way) for (name, (_, way)), timing in zip(runs.items(), times, strict=True)}
    base, own = each["sweep of 1,024"], each["lax.map over equilibrium"]
    results = [
        {
            "way": name,
            "ms a scene": 1e3 * seconds,
            "steps": steps[name],
            "residual": residuals[name],
            "simkit over it": peer / seconds,
            "lax.map over it": own / seconds,
            "one thread over it": base / seconds,
        }
        for name, seconds in each.items()
    ]
    results.append({"way": "simkit, 28-step ramps (4)", "ms a scene": 1e3 * peer})
    return {"sweeps": results, "peak memory": report.peak_memory()}


def threads(repeats: int) -> dict[str, float]:
    """Seconds of the sweep on one core and on all, in turn, where XLA may use them. The gain is a median of ratios."""
    scene, rows = jb.tendon_beam(), asymmetries(1024)
    runs = [partial(on, cores, scene, rows) for cores in (1, CORES)]
    for run in runs:
        run()
    times = np.array([[seconds(run) for run in runs] for _ in range(repeats)])
    one, all = np.median(times, axis=0)
    return {"one thread": one, f"{CORES} threads": all, "gain": float(np.median(times[:, 0] / times[:, 1]))}


def threads_apart(repeats: int) -> dict[str, float]:
    """The same in a new process: this one is kept to one thread."""
    script = f"import json; from benchmarks import many; print(json.dumps(many.threads({repeats})))"
    script = f"import jax; jax.config.update('jax_enable_x64', True); {script}"
    settings = {"OPENBLAS_NUM_THREADS": "1", "NPROC": str(CORES)}
    process = subprocess.run(
        [sys.executable, "-c", script], env=dict(os.environ) | settings, stdout=subprocess.PIPE, check=True, text=True
    )
    return json.loads(process.stdout.splitlines()[-1])


def reachable(repeats: int, side: int = 64) -> tuple[dict[str, Any], Figure]:
    """The map of a grid of commands, and what it took."""
    scene = jb.tendon_beam()
    values = np.linspace(0.4, 1.0, side)
    rows = np.stack([a.ravel() for a in np.meshgrid(values, values, indexing="ij")], axis=1)
    kept: list[jb.Solution] = []
    (timing,) = medians(partial(on, 1, scene, rows), repeats=repeats, checks=[kept.append])
    found = kept[-1]
    good = np.asarray(found.status) == 0
    raw = reference.problem(scene)
    worst = max(reference.residual(raw, rows[k], np.asarray(found.x[k])) for k in np.flatnonzero(good)[::7])
    angles = np.asarray(jax.vmap(lambda x: jb.tip_angle(scene, x))(found.x))
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    for ax, field, label, colours in (
        (figure.add_subplot(1, 2, 1), np.where(good, angles, np.nan), "tip angle (degrees)", "RdBu_r"),
        (figure.add_subplot(1, 2, 2), np.asarray(found.steps, float), "Newton steps", "viridis"),
    ):
        limits = {"vmin": -38, "vmax": 38} if colours == "RdBu_r" else {"vmin": 0, "vmax": 10}
        shades = ax.pcolormesh(values, values, field.reshape(side, side).T, cmap=colours, **limits)
        ax.set(xlabel="ratio of the top tendon", ylabel="ratio of the bottom tendon", aspect="equal")
        figure.colorbar(shades, label=label, extend="neither" if colours == "RdBu_r" else "max")
    outcome = {
        "commands": len(rows),
        "seconds, one thread": timing.median,
        "solved": float(good.mean()),
        "steps a scene": float(np.mean(found.steps)),
        "residual": worst,
    }
    return outcome, figure


def main(arguments: list[str] | None = None) -> None:
    """Print the tables, draw the map."""
    parser = report.options(__doc__)
    parser.add_argument("--repeats", type=int, default=5, help="timed calls of each")
    options = parser.parse_args(arguments)
    report.head("Many scenes")
    found = sweeps(options.repeats)
    keys = list(found["sweeps"][0])
    report.table(("", *keys[1:]), [tuple(row.get(key) for key in keys) for row in found["sweeps"]])
    print(f"peak memory {found['peak memory'] / 2**20:.0f} MB\n")
    found["threads"] = threads_apart(options.repeats)
    report.table(tuple(found["threads"]), [tuple(found["threads"].values())])
    outcome, figure = reachable(max(1, options.repeats // 2))
    report.table(tuple(outcome), [tuple(outcome.values())])
    report.save(options.out, "many", found | {"reachable set": outcome})
    report.save_figure(options.out, "reachable_set", figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
