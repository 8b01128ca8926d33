"""How far from what the core can do: the rate of factorisations, and a Newton step over the time of its arithmetic.

    python -m benchmarks.floor [--most 100000] [--out out/benchmarks]

The core's rate is that of its best product of two square float64 matrices, 128 to 2048 wide, by XLA or by NumPy's BLAS.
One thread, medians.

- Factorisation: operations of a block-tridiagonal Cholesky by its own formula, two for each multiplication, over time
  and rate, for each mesh of `benchmarks.scaling`.
- Newton step: operations of each part of one step of the reference scene: stencil Hessians, the evaluation of energy
  and forces that a line search makes at least once, and assembly, as XLA counts them in the compiled programs;
  factorisation and solve by formula. Their sum over the core's rate is the floor. Against it stands the time of a step
  inside the jitted solver: of the 28-step ramp to (0.4, 1.0), of one jump, and of a sweep, all over the number of their
  steps, every answer verified. Beside it the parts, each called alone, a call of Python included.
"""

from __future__ import annotations

import benchmarks.one_thread  # isort: skip # noqa: F401

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import jaxbeam as jb
from benchmarks import reference, report, scaling
from benchmarks.timing import medians
from jaxbeam.core.tree import unlock
from jaxbeam.linear.blocks import multiplications
from jaxbeam.linear.layout import Layout, assemble
from jaxbeam.scene.scene import evaluate, stencil_hessians
from jaxbeam.solve.newton import topology

SIZES = (128, 256, 512, 1024, 2048)
BATCH = 64


def product_rates() -> list[tuple[int, float, float]]:
    """Operations a second of the product of two `n x n` matrices by XLA and by NumPy, for each `n`."""
    rows = []
    product = jax.jit(jnp.matmul)
    for n in SIZES:
        a, b = np.random.default_rng(0).standard_normal((2, n, n))
        ours, theirs = jnp.asarray(a), jnp.asarray(b)
        xla, blas = medians(partial(product, ours, theirs), partial(np.matmul, a, b), repeats=max(5, 2048 // n))
        rows.append((n, 2 * n**3 / xla.smallest, 2 * n**3 / blas.smallest))
    return rows


def factor_operations(layout: Layout) -> float:
    """Of a block-tridiagonal Cholesky: two for each multiplication."""
    return 2 * multiplications(layout.blocks)


def solve_operations(layout: Layout) -> float:
    """Of its two substitutions: half of each pivot, all of the blocks beside it and of the border, twice."""
    b, w, head, tail, r = layout.blocks
    return 2 * 2 * b * (w * w / 2 + head * tail + w * r)


def counted(function: Callable[..., Any], *arguments: Any) -> float:
    """Operations of a function as XLA counts them in its compiled program; those inside LAPACK are not among them."""
    analysis = jax.jit(function).lower(*arguments).compile().cost_analysis()
    return float((analysis[0] if isinstance(analysis, list) else analysis)["flops"])


def factor_rates(rate: float, most: int) -> list[dict]:
    """Operations and time of a factorisation on each mesh, and the fraction of the core's rate."""
    rows = []
    for nx, ny in scaling.MESHES:
        problem = scaling.case(nx, ny)
        if problem.unknowns > most:
            break
        solver = scaling.Ours(jb.BlockTridiagonal(), problem)
        solver.load(problem.hessians)
        (timing,) = medians(solver.factor, repeats=int(np.clip(50_000 // problem.unknowns, 3, 31)))
        operations = factor_operations(solver.layout)
        reached = operations / timing.median
        b, w, head, tail, r = solver.layout.blocks
        rows.append(
            {
                "unknowns": problem.unknowns,
                "blocks": f"{b} x {w}, {head} x {tail} + {r}",
                "Mflop": operations / 1e6,
                "ms": 1e3 * timing.median,
                "Gflop/s": reached / 1e9,
                "fraction": reached / rate,
            }
        )
    return rows


def parts_of_step() -> list[tuple[str, float, float]]:
    """Name, operations and seconds of each part of a Newton step of the reference scene, called alone."""
    problem = scaling.case(reference.NX, reference.NY)
    scene, linear = unlock(problem.scene), jb.BlockTridiagonal()
    layout = linear.layout(topology(problem.scene))
    solver = scaling.Ours(linear, problem)
    solver.load(problem.hessians)
    solver.factor()
    right = solver.gathered(problem.rhs)
    evaluation = jax.jit(evaluate)
    runs = (
        partial(evaluation, scene, problem.x),
        partial(scaling.hessians_of, scene, problem.x),
        partial(solver.load, problem.hessians),
        solver.factor,
        partial(solver.solve, right),
    )
    operations = (
        counted(evaluate, scene, problem.x),
        counted(stencil_hessians, scene, problem.x),
        # A scatter is not counted: one addition for each entry.
        max(counted(assemble, layout, problem.hessians), float(sum(h.size for h in problem.hessians))),
        factor_operations(layout),
        solve_operations(layout),
    )
    times = [t.median for t in medians(*runs, repeats=101)]
    names = ("energy and forces", "stencil Hessians", "assembly", "factor", "solve")
    return list(zip(names, operations, times, strict=True))


def steps_in_solver() -> dict[str, dict]:
    """Seconds for each Newton step inside the jitted solver: of a ramp, a jump and a sweep."""
    scene, solver = jb.tendon_beam(), jb.Newton(rtol=reference.RTOL)
    raw, ratios = reference.problem(scene), reference.COMMAND
    pulls = np.linspace(-0.4, 0.4, BATCH)
    batch = np.stack([1 + pulls, 1 - pulls], axis=1)
    jump = jb.command(scene, ratios)
    runs = {
        "ramp": (partial(jb.ramp, scene, ratios, reference.STEPS, solver), reference.commands(ratios)),
        "jump": (partial(jb.equilibrium, jump, solver=solver), np.array([ratios])),
        f"sweep of {BATCH}": (partial(jb.sweep, scene, batch, solver), batch),
    }
    steps: dict[str, int] = {}

    def check(name: str, found: jb.Solution) -> None:
        reference.verified(raw, runs[name][1], found)
        steps[name] = int(np.sum(found.steps))

    checks = [partial(check, name) for name in runs]
    times = medians(*(run for run, _ in runs.values()), repeats=9, checks=checks)
    return {
        name: {"seconds": t.median, "steps": steps[name], "per step": t.median / steps[name]}
        for name, t in zip(runs, times, strict=True)
    }


def plot(rows: list[dict], folder: Any) -> None:
    """The fraction of the core's rate against unknowns."""
    figure, axes = plt.subplots(figsize=(6, 4))
    axes.semilogx([row["unknowns"] for row in rows], [100 * row["fraction"] for row in rows], "o-")
    axes.set(xlabel="unknowns", ylabel="factorisation, % of matrix-product rate", ylim=(0, 100))
    axes.grid(True, which="both", alpha=0.3)
    report.save_figure(folder, "floor", figure)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    """Print the tables."""
    parser = report.options(__doc__)
    parser.add_argument("--most", type=int, default=100_000, help="largest number of unknowns")
    options = parser.parse_args(arguments)
    report.head("What the core can do")
    products = product_rates()
    report.table(("matrix product", "XLA, Gflop/s", "NumPy"), [(n, x / 1e9, b / 1e9) for n, x, b in products])
    rate = max(max(xla, blas) for _, xla, blas in products)

    rows = factor_rates(rate, options.most)
    print("Block-tridiagonal factorisation")
    report.table(tuple(rows[0]), [tuple(row.values()) for row in rows])

    parts = parts_of_step()
    floor = sum(operations for _, operations, _ in parts) / rate
    print(
        f"A Newton step of the reference scene; its arithmetic takes {1e6 * floor:.1f} us at {rate / 1e9:.1f} Gflop/s"
    )
    total = ("sum", *(sum(part[k] for part in parts) for k in (1, 2)))
    header = ("part", "kflop", "floor, us", "alone, us")
    report.table(header, [(name, ops / 1e3, 1e6 * ops / rate, 1e6 * t) for name, ops, t in (*parts, total)])

    inside = steps_in_solver()
    header = ("inside the solver", "ms", "steps", "us per step", "over the floor")
    report.table(
        header,
        [(n, 1e3 * r["seconds"], r["steps"], 1e6 * r["per step"], r["per step"] / floor) for n, r in inside.items()],
    )
    results = {
        "products": products,
        "rate": rate,
        "factorisation": rows,
        "parts": parts,
        "floor": floor,
        "steps": {name: r | {"over the floor": r["per step"] / floor} for name, r in inside.items()},
    }
    report.save(options.out, "floor", results)
    plot(rows, options.out)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
