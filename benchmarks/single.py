"""One scene: the reference ramp beside simkit's, one jump, its derivative, and the first result of a new process.

    python -m benchmarks.single [--repeats 9] [--processes 3]

The ramp takes 28 steps to (0.4, 1.0), each to a relative residual of 1e-9. simkit solves the same scene in the same
process, in turn with it (see `benchmarks/simkit_peer.py`): with its tutorial's settings, which stop at a looser
residual, and with the fastest of its settings that reach 1e-9. One thread; compile time apart. Each timed answer is
verified by code that shares nothing with the solvers.

The derivative is that of the tip angle after one jump to the same command, by both commands and the Young's moduli of
all 336 elements: value and gradient in turn with the value alone.

The new processes have all cores, as a user's would: one set with an empty persistent compilation cache, one with it
filled. Their time is from the start of the process to the answer.
"""

from __future__ import annotations

import benchmarks.one_thread  # isort: skip # noqa: F401

import json
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from benchmarks import one_thread, reference, report, simkit_peer
from benchmarks.timing import Timing, in_turn

PARTS = ("import jax", "import jaxbeam", "trace", "lower", "compile", "run")
SIMKIT = {
    "simkit, as its tutorial": simkit_peer.Settings(),
    "simkit, exact, full steps": simkit_peer.Settings(exact=True, line_search=False),
}
RAMP, JUMP = "jaxbeam ramp", "jaxbeam equilibrium"
# The commands that each is verified at.
WAYS = {RAMP: reference.commands(reference.COMMAND), JUMP: np.array([reference.COMMAND])}


def warm(repeats: int) -> dict[str, Timing]:
    """Print a table of ramps of both in turn, and one jump; their times."""
    scene, solver = jb.tendon_beam(), jb.Newton(rtol=reference.RTOL)
    raw, ratios = reference.problem(scene), reference.COMMAND
    simkit_peer.build()
    runs = {
        RAMP: lambda: jb.ramp(scene, ratios, reference.STEPS, solver),
        **{name: partial(simkit_peer.follow, ratios, settings=s) for name, s in SIMKIT.items()},
        JUMP: lambda: jb.equilibrium(jb.command(scene, ratios), solver=solver),
    }
    judged: dict[str, dict[str, float]] = {}

    def check(name: str, result: jb.Solution | simkit_peer.Path) -> None:
        if isinstance(result, jb.Solution):
            end = np.asarray(result.x).reshape(-1, *raw.nodes.shape)[-1]
            judged[name] = {
                "steps": int(np.sum(result.steps)),
                "residual": reference.verified(raw, WAYS[name], result),
                "tip angle": reference.tip_angle(raw, end),
            }
        elif name not in judged:
            judged[name] = simkit_peer.judge(result, ratios, SIMKIT[name])

    processor_time, start = time.process_time(), time.perf_counter()
    timings = in_turn(*runs.values(), repeats=repeats, checks=[partial(check, name) for name in runs])
    busy = (time.process_time() - processor_time) / (time.perf_counter() - start)
    times = dict(zip(runs, timings, strict=True))
    keys = ("steps", "capped", "stalled", "residual")
    rows = []
    for name, timing in times.items():
        found = judged[name]
        compiling = timing.first - timing.median if name in WAYS else None
        cells = (found.get(key) for key in keys)
        rows.append((name, str(timing), timing.over(times[RAMP]), compiling, *cells, f"{found['tip angle']:.7f}"))
    report.table(("", "time (quartiles)", f"over {RAMP}", "compile, s", *keys, "tip angle"), rows)
    print(f"processor time over wall time: {busy:.2f}\n")
    return times


def gradient(repeats: int) -> None:
    """Print what value and gradient of the tip angle take over the value alone."""

    def angle(ratios: jax.Array, young: jax.Array) -> jax.Array:
        scene = jb.command(jb.tendon_beam(young=young), ratios)
        return jb.tip_angle(scene, jb.equilibrium(scene).x)

    point = jnp.array(reference.COMMAND), jnp.full(336, reference.YOUNG)
    value, both = jax.jit(angle), jax.jit(jax.value_and_grad(angle, argnums=(0, 1)))
    alone, together = in_turn(partial(value, *point), partial(both, *point), repeats=repeats)
    print(f"value {alone}, value and gradient {together}: {together.over(alone):.3f} solves\n")


def cold(kind: str, folder: str) -> dict[str, float]:
    """Seconds of the parts of one new process that uses the compilation cache in `folder`."""
    settings = {
        "JAX_COMPILATION_CACHE_DIR": folder,
        # By default what compiles in under a second is not kept.
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    start = time.time()
    process = subprocess.run(
        [sys.executable, "-m", "benchmarks.cold", kind],
        env=one_thread.cleared() | settings,
        cwd=Path(__file__).parents[1],
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    parts = json.loads(process.stdout.splitlines()[-1])
    return {"total": parts.pop("result") - start, **parts}


def cold_starts(repeats: int) -> dict[str, dict[str, float]]:
    """Medians of new processes, with the compilation cache empty and filled."""
    results = {}
    for kind in ("equilibrium", "ramp"):
        empty, filled = [], []
        for _ in range(repeats):
            with tempfile.TemporaryDirectory() as folder:
                empty.append(cold(kind, folder))
                filled.append(cold(kind, folder))
        for name, runs in (("empty", empty), ("filled", filled)):
            results[f"{kind}, cache {name}"] = {key: float(np.median([r[key] for r in runs])) for key in runs[0]}
    return results


def main() -> None:
    """Print the tables."""
    parser = report.options(__doc__)
    parser.add_argument("--repeats", type=int, default=9, help="timed calls of each")
    parser.add_argument("--processes", type=int, default=3, help="new processes of each kind")
    options = parser.parse_args()
    report.head("One scene")
    times = warm(options.repeats)
    # The difference is of one percent: it takes more calls.
    gradient(5 * options.repeats)
    print(f"First result of a new process, seconds ({os.cpu_count()} cores)")
    rows = []
    for name, parts in cold_starts(options.processes).items():
        over = (parts["total"] / times[peer].median for peer in SIMKIT)
        rows.append((name, *(parts[key] for key in ("total", *PARTS)), *over))
    report.table(("", "total", *PARTS, *(f"over {peer}" for peer in SIMKIT)), rows)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
