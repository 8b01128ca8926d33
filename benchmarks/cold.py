"""The first result of a new process, for `benchmarks.single`: import, trace, compile and solve the reference scene.

    python -m benchmarks.cold equilibrium|ramp

Prints one line of JSON: `result` is the time of day at which the answer was there, the rest are seconds. What JAX
reports of its own compilation is taken from it; `trace` is what remains of the first call.
"""

from __future__ import annotations

import json
import sys
import time

EVENTS = {
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
}


def main() -> None:
    """Solve and report."""
    began = time.perf_counter()
    import jax

    jax_there = time.perf_counter()
    import jaxbeam as jb

    jaxbeam_there = time.perf_counter()
    spent = {"lower": 0.0, "compile": 0.0}

    def listen(event: str, duration: float, **_: object) -> None:
        if event in EVENTS:
            spent[EVENTS[event]] += duration

    jax.monitoring.register_event_duration_secs_listener(listen)
    jax.config.update("jax_enable_x64", True)
    solver = jb.Newton(rtol=1e-9)

    def solve() -> jb.Solution:
        scene = jb.tendon_beam()
        if sys.argv[1] == "ramp":
            return jax.block_until_ready(jb.ramp(scene, [0.4, 1.0], solver=solver))
        return jax.block_until_ready(jb.equilibrium(jb.command(scene, [0.4, 1.0]), solver=solver))

    start = time.perf_counter()
    solution = solve()
    first = time.perf_counter() - start
    result = time.time()
    compiling = dict(spent)
    start = time.perf_counter()
    solve()
    run = time.perf_counter() - start
    jb.check(solution)
    times = {
        "import jax": jax_there - began,
        "import jaxbeam": jaxbeam_there - jax_there,
        "trace": first - run - compiling["lower"] - compiling["compile"],
        **compiling,
        "run": run,
    }
    print(json.dumps({"result": result, **times}))


if __name__ == "__main__":
    main()
