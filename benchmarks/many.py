"""Many scenes: a sweep of 1,024 asymmetries, beside other ways to solve them.

    python -m benchmarks.many [--repeats 5]

The sweep takes ratios (1 + d, 1 - d) with d in [-0.4, 0.4], each to a relative residual of 1e-9. In turn with it, in
the same process: `lax.map` over `equilibrium` on every 16th of them. After them simkit ramps four of them in 28 steps
each (see `benchmarks/simkit_peer.py`). The same sweep by `corrected`, with an error bar on every answer, is set beside
sweeps on each of its two meshes. Sweeps of 64 and of 4,096 asymmetries show whether a scene costs as much in a
batch of any size. One thread, but for a table with all cores. Every answer of jaxbeam is verified by code that shares
nothing with its solver.
"""

from __future__ import annotations

import benchmarks.one_thread  # isort: skip # noqa: F401

import json
import os
import subprocess
import sys
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from benchmarks import reference, report, simkit_peer
from benchmarks.timing import in_turn

CORES = os.cpu_count() or 1
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


def sweeps(repeats: int) -> None:
    """Print the time a scene of each way to solve many."""
    scene = jb.tendon_beam()
    raw, ways = reference.problem(scene), {count: asymmetries(count) for count in (1024, 64, 4096)}
    mapped = jax.jit(
        lambda rows: jax.lax.map(lambda row: jb.equilibrium(jb.command(scene, row), solver=SOLVER), rows),
        compiler_options={"xla_cpu_use_fusion_emitters": False},  # as the library's own
    )
    few = ways[1024][::16]
    runs = {f"sweep of {count:,}": (partial(on, 1, scene, way), way) for count, way in ways.items()}
    runs["lax.map over equilibrium"] = (partial(mapped, jnp.asarray(few)), few)
    residuals: dict[str, float] = {}
    steps: dict[str, float] = {}

    def check(name: str, way: np.ndarray, found: jb.Solution) -> None:
        steps[name] = float(np.mean(found.steps))
        if name not in residuals:
            residuals[name] = reference.verified(raw, way, found)

    checks = [partial(check, name, way) for name, (_, way) in runs.items()]
    times = in_turn(*(run for run, _ in runs.values()), repeats=repeats, checks=checks)
    simkit_peer.build()
    simkit = []
    for row in ways[1024][[0, 300, 700, 1023]]:
        start = time.perf_counter()
        simkit_peer.follow(tuple(row))
        simkit.append(time.perf_counter() - start)
    peer = float(np.median(simkit))
    each = {name: timing.median / len(way) for (name, (_, way)), timing in zip(runs.items(), times, strict=True)}
    own = each["lax.map over equilibrium"]
    lines = [(n, 1e3 * s, steps[n], residuals[n], peer / s, own / s) for n, s in each.items()]
    lines.append(("simkit, 28-step ramps (4)", 1e3 * peer, None, None, None, None))
    report.table(("", "ms a scene", "steps", "residual", "simkit over it", "lax.map over it"), lines)


def with_bars(repeats: int) -> None:
    """Print the time a scene of sweeps on two meshes with a bar on every answer, and of sweeps on each mesh alone."""
    meshes = jb.two_meshes(
        jb.tendon_beam(7, 5, order=2, graded="proportional", diagonals="mirrored", anchor_width=0.25)
    )
    rows = asymmetries(1024)
    runs = {
        "sweep on the coarse mesh, 7 x 5": lambda: jb.sweep(meshes.coarse, rows),
        "sweep on the finer mesh": lambda: jb.sweep(meshes.fine, rows),
        "corrected, with a bar on every answer": lambda: jb.corrected(meshes, rows, jb.tip_angle),
    }
    times = in_turn(*runs.values(), repeats=repeats)
    bars = np.asarray(runs["corrected, with a bar on every answer"]().bar)
    lines = [(name, 1e3 * own.median / len(rows), own.over(times[1])) for name, own in zip(runs, times, strict=True)]
    report.table(("", "ms a scene", "over the finer sweep"), lines)
    print(f"finite bars: {np.isfinite(bars).sum()} of {len(rows)}")


def threads(repeats: int) -> tuple[float, float, float]:
    """Seconds of the sweep on one core and on all, in turn, where XLA may use them, and the gain."""
    scene, rows = jb.tendon_beam(), asymmetries(1024)
    one, every = in_turn(*(partial(on, cores, scene, rows) for cores in (1, CORES)), repeats=repeats)
    return one.median, every.median, one.over(every)


def threads_apart(repeats: int) -> tuple[float, float, float]:
    """The same in a new process: this one is kept to one thread."""
    script = f"import json; from benchmarks import many; print(json.dumps(many.threads({repeats})))"
    script = f"import jax; jax.config.update('jax_enable_x64', True); {script}"
    settings = {"OPENBLAS_NUM_THREADS": "1", "NPROC": str(CORES)}
    process = subprocess.run(
        [sys.executable, "-c", script], env=dict(os.environ) | settings, stdout=subprocess.PIPE, check=True, text=True
    )
    return tuple(json.loads(process.stdout.splitlines()[-1]))


def main() -> None:
    """Print the tables."""
    parser = report.options(__doc__)
    parser.add_argument("--repeats", type=int, default=5, help="timed calls of each")
    options = parser.parse_args()
    report.head("Many scenes")
    with_bars(options.repeats)
    sweeps(options.repeats)
    report.table(("", "one thread, s", f"{CORES} threads", "gain"), [("sweep", *threads_apart(options.repeats))])


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
