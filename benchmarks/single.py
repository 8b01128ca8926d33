"""One scene: the reference ramp beside simkit's, one jump, and the first result of a new process.

    python -m benchmarks.single [--repeats 9] [--out out/benchmarks]

The ramp takes 28 steps to (0.4, 1.0), each to a relative residual of 1e-9. simkit solves the same scene in the same
process, in turn with it (see `benchmarks/simkit_peer.py`): with its tutorial's settings, which stop at a looser
residual, and with the fastest of its settings that reach 1e-9. One thread; compile time apart. Each timed answer is
verified by code that shares nothing with the solvers.

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
import numpy as np

import jaxbeam as jb
from benchmarks import one_thread, reference, report, simkit_peer
from benchmarks.timing import Timing, medians

PARTS = ("import jax", "import jaxbeam", "trace", "lower", "compile", "run")
SIMKIT = {
    "simkit, as its tutorial": simkit_peer.Settings(),
    "simkit, exact, full steps": simkit_peer.Settings(exact=True, line_search=False),
}


RAMP, JUMP = "jaxbeam ramp", "jaxbeam equilibrium"
# The commands that each is verified at.
WAYS = {RAMP: reference.commands(reference.COMMAND), JUMP: np.array([reference.COMMAND])}


def warm(repeats: int) -> dict:
    """Ramps of both in turn, and one jump."""
    scene, solver = jb.tendon_beam(), jb.Newton(rtol=reference.RTOL)
    raw, ratios = reference.problem(scene), reference.COMMAND
    simkit_peer.build()
    runs = {
        RAMP: lambda: jb.ramp(scene, ratios, reference.STEPS, solver),
        **{name: partial(simkit_peer.follow, ratios, settings=s) for name, s in SIMKIT.items()},
        JUMP: lambda: jb.equilibrium(jb.command(scene, ratios), solver=solver),
    }
    last: dict[str, jb.Solution | simkit_peer.Path] = {}

    def check(name: str, result: jb.Solution | simkit_peer.Path) -> None:
        last[name] = result
        if name in WAYS:
            reference.verified(raw, WAYS[name], result)

    checks = [partial(check, name) for name in runs]
    processor_time, start = time.process_time(), time.perf_counter()
    times = medians(*runs.values(), repeats=repeats, checks=checks)
    busy = (time.process_time() - processor_time) / (time.perf_counter() - start)
    results = {n: outcome(n, timing, last[n], raw) for n, timing in zip(runs, times, strict=True)}
    for result in results.values():
        result["over jaxbeam ramp"] = result["seconds"] / results[RAMP]["seconds"]
    return {"busy cores": busy, "runs": results}


def outcome(name: str, timing: Timing, result: jb.Solution | simkit_peer.Path, raw: reference.Problem) -> dict:
    """Time and quality of one run."""
    common = {"seconds": timing.median, "timing": timing._asdict(), "compile": None}
    if isinstance(result, simkit_peer.Path):
        judged = simkit_peer.judge(result, reference.COMMAND, timing.median, SIMKIT[name])
        return common | {
            "steps": sum(judged.iterations),
            "capped": sum(judged.capped),
            "stalled": sum(judged.stalled),
            "residual": max(judged.residuals),
            "tip angle": judged.tip_angle,
        }
    end = np.asarray(result.x).reshape(-1, *raw.nodes.shape)[-1]
    return common | {
        "compile": timing.first - timing.median,
        "steps": int(np.sum(result.steps)),
        "capped": 0,
        "stalled": 0,
        "residual": reference.verified(raw, WAYS[name], result),
        "tip angle": reference.tip_angle(raw, end),
    }


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


def main(arguments: list[str] | None = None) -> None:
    """Print the tables."""
    parser = report.options(__doc__)
    parser.add_argument("--repeats", type=int, default=9, help="timed calls of each")
    parser.add_argument("--processes", type=int, default=3, help="new processes of each kind")
    options = parser.parse_args(arguments)
    report.head("One scene")
    found = warm(options.repeats)
    keys = ("seconds", "over jaxbeam ramp", "compile", "steps", "capped", "stalled", "residual", "tip angle")
    rows = [(name, *(run[k] for k in keys[:-1]), f"{run['tip angle']:.7f}") for name, run in found["runs"].items()]
    report.table(("", *keys), rows)
    for name, run in found["runs"].items():
        print(f"{name}: {Timing(**run['timing'])}")
    print(f"processor time over wall time: {found['busy cores']:.2f}\n")
    processes = cold_starts(options.processes)
    print(f"First result of a new process, seconds ({os.cpu_count()} cores)")
    for parts in processes.values():
        for name in SIMKIT:
            parts[f"over {name}"] = parts["total"] / found["runs"][name]["seconds"]
    keys = ("total", *PARTS, *(f"over {name}" for name in SIMKIT))
    report.table(("", *keys), [(name, *(parts[k] for k in keys)) for name, parts in processes.items()])
    report.save(options.out, "single", found | {"processes": processes})


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
