"""Time of the linear algebra of a Newton step against the number of unknowns, beside sparse direct solvers.

    python -m benchmarks.scaling [--most 200000] [--only NAME] [--no-memory] [--out out/benchmarks]

Meshes of the reference beam from 400 to 200,000 unknowns, in a gently bent state (an arc of 0.1 radians, in which the
true stiffness is positive definite), with one right-hand side. Every solver gets the same matrix, called in turn:
jaxbeam's own, and SuperLU, CHOLMOD and PARDISO (see `benchmarks/sparse.py`). One thread; `analysis` (ordering, layout)
and compilation are once for a topology and apart. The solutions are compared with each other.

Printed: milliseconds of each part of a step, the growth exponent of factor and solve beyond 5,000 unknowns, the numbers
that a factor holds, and the peak memory of a process that does nothing but this. A solver is left out where its last
two times say that it would take over a minute.
"""

from __future__ import annotations

import benchmarks.one_thread  # isort: skip # noqa: F401

import importlib
import json
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import jaxbeam as jb
from benchmarks import report, sparse
from benchmarks.timing import medians, seconds
from jaxbeam.core.tree import unlock
from jaxbeam.linear.layout import assemble, expand, gather
from jaxbeam.scene.scene import stencil_hessians
from jaxbeam.solve.newton import topology

MESHES = ((29, 7), (57, 13), (113, 25), (225, 49), (337, 73), (449, 97), (673, 149))
ARC = 0.1
LIMIT = 60.0
# Growth is fitted over meshes with at least this many unknowns, memory is measured on these.
LARGE = 5000


def linear_solvers() -> dict[str, Any]:
    """jaxbeam's linear solvers for many unknowns."""
    found = {"block tridiagonal": jb.BlockTridiagonal()}
    if importlib.util.find_spec("jaxbeam.dissection"):
        found["nested dissection"] = importlib.import_module("jaxbeam.dissection").NestedDissection()
    return found


class Case(NamedTuple):
    """A scene in a bent state `x` `(n, 2)`, its stencil Hessians there and a right-hand side `(n, 2)`."""

    scene: jb.Scene
    x: jax.Array
    hessians: list[jax.Array]
    rhs: jax.Array

    @property
    def unknowns(self) -> int:
        return int((~self.scene.fixed).sum())


hessians_of = jax.jit(stencil_hessians)


def case(nx: int, ny: int) -> Case:
    """The reference beam on `nx` x `ny` nodes, bent to an arc whose mid-line keeps its length."""
    scene = jb.tendon_beam(nx, ny)
    rest = np.asarray(scene.mesh.nodes)
    along, across = rest[:, 0] - rest[:, 0].min(), rest[:, 1]
    radius = np.ptp(rest[:, 0]) / ARC
    angle = along / radius
    bent = np.stack([(radius - across) * np.sin(angle), radius - (radius - across) * np.cos(angle)], axis=1)
    bent[:, 0] += rest[:, 0].min()
    x = jnp.where(scene.fixed, rest, bent)
    rhs = np.where(scene.fixed, 0, np.random.default_rng(0).standard_normal(rest.shape))
    return Case(scene, x, hessians_of(unlock(scene), x), jnp.asarray(rhs))


class Ours:
    """One of jaxbeam's linear solvers, with the methods of those in `benchmarks.sparse`."""

    def __init__(self, linear: Any, case: Case) -> None:
        self.layout = linear.layout(topology(case.scene))
        self.shape = case.x.shape
        self.free = np.flatnonzero(~case.scene.fixed.ravel())
        self.assemble, self._factor, self._solve = _jitted(linear)

    def load(self, hessians: list[jax.Array]) -> jax.Array:
        self.storage = self.assemble(self.layout, hessians)
        return self.storage

    def factor(self) -> Any:
        self.kept, self.definite = self._factor(self.layout, self.storage)
        return self.kept

    def solve(self, rhs: jax.Array) -> jax.Array:
        return self._solve(self.layout, self.kept, rhs)

    def numbers(self) -> int:
        """How many numbers the factor holds, padding included."""
        return sum(leaf.size for leaf in jax.tree.leaves(self.kept))

    def gathered(self, field: jax.Array) -> jax.Array:
        return gather(self.layout, field)

    def expanded(self, unknowns: jax.Array) -> np.ndarray:
        return np.asarray(expand(self.layout, unknowns, self.shape)).ravel()[self.free]


_programs: dict[Any, tuple[Any, Any, Any]] = {}


def _jitted(linear: Any) -> tuple[Any, Any, Any]:
    """Compiled once for each solver and shape."""
    if linear not in _programs:
        _programs[linear] = jax.jit(assemble), jax.jit(linear.factor), jax.jit(linear.solve)
    return _programs[linear]


class Prepared(NamedTuple):
    """A solver that has done its analysis, its right-hand side and how long the analysis took."""

    solver: Any
    rhs: Any
    analysis: float


def prepare(name: str, case: Case, system: sparse.System | None) -> Prepared:
    """Analysis of a case by the solver of that name."""
    start = time.perf_counter()
    linear = linear_solvers().get(name)
    if linear is not None:
        ours = Ours(linear, case)
        analysis = time.perf_counter() - start
        ours.load(case.hessians)
        return Prepared(ours, ours.gathered(case.rhs), analysis)
    peer = next(peer for peer in sparse.PEERS if peer.name == name)
    return Prepared(peer(system.matrix), np.asarray(case.rhs).ravel()[system.free], time.perf_counter() - start)


def names() -> list[str]:
    """All solvers, jaxbeam's first."""
    return [*linear_solvers(), *(peer.name for peer in sparse.PEERS)]


def measure(nx: int, ny: int, chosen: list[str]) -> dict:
    """Times of each part of a step, of each solver, on one mesh."""
    problem = case(nx, ny)
    system = sparse.stiffness(problem.scene, problem.x)
    ready = {name: prepare(name, problem, system) for name in chosen}
    runs = {("all", "hessians"): partial(hessians_of, unlock(problem.scene), problem.x)}
    for name, (solver, rhs, _) in ready.items():
        if isinstance(solver, Ours):
            runs[name, "assemble"] = partial(solver.load, problem.hessians)
        runs[name, "factor"] = solver.factor
        runs[name, "solve"] = partial(solver.solve, rhs)
    # A first round compiles; the second tells how many more there is time for.
    begin = {key: seconds(run) for key, run in runs.items()}
    round_time = sum(seconds(run) for run in runs.values())
    timings = medians(*runs.values(), repeats=int(np.clip(20 / round_time, 3, 31)))
    times = {key: timing.median for key, timing in zip(runs, timings, strict=True)}
    results = qualities(problem, system, ready)
    for name, result in results.items():
        factor, solve = times[name, "factor"], times[name, "solve"]
        compiling = begin[name, "factor"] + begin[name, "solve"] - factor - solve
        result["compile"] = max(0.0, compiling) if isinstance(ready[name].solver, Ours) else None
        result |= {"assemble": times.get((name, "assemble")), "factor": factor, "solve": solve}
        result["factor and solve"] = factor + solve
    hessians = times["all", "hessians"]
    return {"mesh": (nx, ny), "unknowns": problem.unknowns, "hessians": hessians, "solvers": results}


def qualities(problem: Case, system: sparse.System, ready: dict[str, Prepared]) -> dict[str, dict]:
    """How far each solution is from the first solver's and from balance, and what its factor holds."""
    right = np.asarray(problem.rhs).ravel()[system.free]
    scale = np.abs(system.matrix).sum(axis=1).max()
    results, first = {}, None
    for name, (solver, rhs, analysis) in ready.items():
        x = solver.solve(rhs)
        if isinstance(solver, Ours):
            if not solver.definite:
                raise RuntimeError(f"{name}: the stiffness of {problem.unknowns} unknowns is not positive definite")
            x = solver.expanded(x)
        first = x if first is None else first
        results[name] = {
            "analysis": analysis,
            "numbers": solver.numbers(),
            "apart": float(np.abs(x - first).max() / np.abs(first).max()),
            "backward error": float(np.abs(system.matrix @ x - right).max() / (scale * np.abs(x).max())),
        }
        if isinstance(solver, sparse.Pardiso):
            solver.close()
    return results


def predicted(name: str, results: list[dict], unknowns: int) -> float:
    """Seconds that factor and solve would take, from the growth between the last two sizes."""
    past = [(r["unknowns"], r["solvers"][name]["factor and solve"]) for r in results if name in r["solvers"]]
    if len(past) < 2:
        return 0.0
    (n0, t0), (n1, t1) = past[-2:]
    return t1 * (unknowns / n1) ** max(1.0, np.log(t1 / t0) / np.log(n1 / n0))


def exponent(name: str, results: list[dict]) -> float | None:
    """Growth exponent of factor and solve, fitted over the large meshes."""
    points = [
        (r["unknowns"], r["solvers"][name]["factor and solve"])
        for r in results
        if r["unknowns"] >= LARGE and name in r["solvers"]
    ]
    if len(points) < 2:
        return None
    n, t = np.log(np.array(points)).T
    return float(np.polyfit(n, t, 1)[0])


def peak(name: str, nx: int, ny: int) -> int:
    """Peak bytes of a new process that factors and solves once; without a solver of that name, of the case alone."""
    command = [sys.executable, "-m", "benchmarks.scaling", "--alone", name, str(nx), str(ny)]
    output = subprocess.run(
        command, cwd=Path(__file__).parents[1], stdout=subprocess.PIPE, check=True, text=True
    ).stdout
    return json.loads(output.splitlines()[-1])


def alone(name: str, nx: int, ny: int) -> None:
    """What `peak` runs."""
    problem = case(nx, ny)
    if name in names():
        system = None if name in linear_solvers() else sparse.stiffness(problem.scene, problem.x)
        solver, rhs, _ = prepare(name, problem, system)
        solver.factor()
        jax.block_until_ready(solver.solve(rhs))
    print(report.peak_memory())


def rows_of(result: dict) -> list[tuple]:
    """The lines of the table for one mesh."""
    ms = lambda value: None if value is None else 1e3 * value
    return [
        (
            result["unknowns"],
            name,
            r["analysis"],
            r["compile"],
            ms(result["hessians"]) if r["assemble"] else None,
            ms(r["assemble"]),
            ms(r["factor"]),
            ms(r["solve"]),
            ms(r["factor and solve"]),
            8e-6 * r["numbers"],
            r.get("peak", 0) / 1e6 or None,
            r["apart"],
            r["backward error"],
        )
        for name, r in result["solvers"].items()
    ]


HEADER = (
    "unknowns",
    "solver",
    "analysis, s",
    "compile, s",
    "hessians, ms",
    "assemble",
    "factor",
    "solve",
    "factor + solve",
    "factor, MB",
    "peak, MB",
    "apart",
    "backward error",
)


def plot(results: list[dict], folder: Path) -> None:
    """Factor and solve against unknowns, and numbers in the factor."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5))
    for name in names():
        points = [(r["unknowns"], r["solvers"][name]) for r in results if name in r["solvers"]]
        if not points:
            continue
        style = "o-" if name in linear_solvers() else "s--"
        n = [unknowns for unknowns, _ in points]
        left.loglog(n, [1e3 * r["factor and solve"] for _, r in points], style, label=name)
        right.loglog(n, [8e-6 * r["numbers"] for _, r in points], style, label=name)
    left.set(xlabel="unknowns", ylabel="factor and solve, ms")
    right.set(xlabel="unknowns", ylabel="factor, MB")
    left.legend()
    for axes in (left, right):
        axes.grid(True, which="both", alpha=0.3)
    report.save_figure(folder, "scaling", figure)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    """Print the table, mesh by mesh."""
    parser = report.options(__doc__)
    parser.add_argument("--most", type=int, default=300_000, help="largest number of unknowns")
    parser.add_argument("--only", nargs="+", default=names(), help="names of solvers", metavar="NAME")
    parser.add_argument("--no-memory", action="store_true", help="leave out peak memory")
    parser.add_argument("--alone", nargs=3, help="for its own use: one solver on one mesh, prints peak memory")
    options = parser.parse_args(arguments)
    if options.alone:
        name, nx, ny = options.alone
        return alone(name, int(nx), int(ny))
    report.head("Linear algebra of a Newton step")
    results: list[dict] = []
    for nx, ny in MESHES:
        unknowns = 2 * (nx - 1) * ny
        if unknowns > options.most:
            break
        chosen = [name for name in options.only if predicted(name, results, unknowns) < LIMIT]
        for name in sorted(set(options.only) - set(chosen)):
            print(f"{name} left out at {unknowns}: {predicted(name, results, unknowns):.0f} s to be expected")
        result = measure(nx, ny, chosen)
        if unknowns >= LARGE and not options.no_memory:
            result["peak without solver"] = peak("none", nx, ny)
            for name in chosen:
                result["solvers"][name]["peak"] = peak(name, nx, ny)
        results.append(result)
        report.table(HEADER, rows_of(result))
        if "peak without solver" in result:
            print(f"peak without any solver: {result['peak without solver'] / 1e6:.0f} MB\n")
    growth = {name: exponent(name, results) for name in options.only}
    print(f"growth exponent of factor and solve, from {LARGE} unknowns")
    report.table(("solver", "exponent"), list(growth.items()))
    report.save(options.out, "scaling", {"meshes": results, "exponents": growth})
    plot(results, options.out)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
