"""How fast, and how right? One command, solved by hand, as a rod and on meshes from coarse to fine.

The top tendon is pulled to 0.8 of its length, its free end spread over the surface within 0.25, so that there is an
answer to converge to. Every way to solve is timed, after compiling, and set against the solution on a fine mesh. For
the meshes the error bar is drawn too, which knows nothing of that solution: `jb.estimate_error` asks a mesh twice as
fine what it would change. At last `jb.solve_to` is asked for the angle to a hundredth of a degree.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb

RATIOS = [0.8, 1.0]
WIDTH = 0.25
MESHES: dict[str, dict[str, Any]] = {
    "three nodes, 15 x 5": {"nx": 15, "ny": 5},
    "three nodes, 29 x 7": {"nx": 29, "ny": 7},
    "three nodes, 29 x 7, crossed": {"nx": 29, "ny": 7, "diagonals": "crossed"},
    "six nodes, 7 x 3": {"nx": 7, "ny": 3, "order": 2},
    "six nodes, 15 x 5": {"nx": 15, "ny": 5, "order": 2},
    "six nodes, 9 x 5, graded": {"nx": 9, "ny": 5, "order": 2, "graded": True},
    "six nodes, 21 x 7, graded": {"nx": 21, "ny": 7, "order": 2, "graded": True},
}
STYLES = {"by": ("k", "*"), "rod": ("C2", "D"), "three": ("C0", "o"), "six": ("C3", "s")}


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """A result, and the median of the seconds that some calls take after the first, which compiles."""
    result, times = jax.block_until_ready(run()), []
    for _ in range(9):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return result, float(np.median(times))


def solve(scene: jb.Scene) -> tuple[float, jb.Solution, float]:
    """Tip angle, solution and seconds."""
    solution, seconds = timed(lambda: jb.equilibrium(scene))
    return float(jb.tip_angle(scene, jb.check(solution).x)), solution, seconds


def draw(rows: list[tuple[str, float, float, float | None]], exact: float) -> Figure:
    """Error against time, with the error bars that were told beforehand."""
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    ax = figure.add_subplot(xscale="log", yscale="log", xlabel="milliseconds of one solve", ylabel="error (degrees)")
    for name, angle, seconds, bar in rows:
        colour, marker = STYLES[name.split()[0]]
        error, ms = abs(angle - exact), 1e3 * seconds
        ax.plot(ms, error, marker, color=colour, ms=8 if marker == "*" else 6)
        if bar is not None:
            ax.plot(ms, bar, "_", color=colour, ms=14)
            ax.plot([ms, ms], [error, bar], color=colour, lw=0.8)
        ax.annotate(name, (ms, error), xytext=(8, -3), textcoords="offset points", fontsize="x-small")
    ax.set_title(
        f"Tip angle at ratio {RATIOS[0]}: error, and the bar that was told without the answer", fontsize="small"
    )
    ax.set_xlim(right=ax.get_xlim()[1] * 8)
    ax.grid(alpha=0.3, lw=0.4, which="both")
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def main(out: Path = Path("out/speed_against_accuracy")) -> dict[str, float]:
    out.mkdir(parents=True, exist_ok=True)
    beam = lambda **mesh: jb.command(jb.tendon_beam(**mesh, anchor_width=WIDTH), RATIOS)
    exact, _, seconds = solve(beam(nx=29, ny=9, order=2, graded=True, diagonals="crossed"))
    print(f"fine mesh: {exact:.4f} degrees, {1e3 * seconds:.0f} ms\n")

    hand, by_hand = timed(lambda: jb.euler_bernoulli(RATIOS))
    angle, _, as_rod = solve(jb.command(jb.rod_beam(), RATIOS))
    rows: list[tuple[str, float, float, float | None]] = [
        ("by hand", float(hand.tip_angle), by_hand, None),
        ("rod", angle, as_rod, None),
    ]
    for name, mesh in MESHES.items():
        scene = beam(**mesh)
        angle, solution, seconds = solve(scene)
        rows.append((name, angle, seconds, jb.estimate_error(scene, solution, jb.tip_angle).bar))
    print(f"{'':30}{'degrees':>10}{'error':>10}{'bar':>10}{'ms':>10}")
    for name, angle, seconds, bar in rows:
        told = "" if bar is None else f"{bar:.4f}"
        print(f"{name:30}{angle:10.4f}{angle - exact:10.4f}{told:>10}{1e3 * seconds:10.2f}")

    answer = jb.solve_to(beam(nx=7, ny=3, order=2, graded=True), jb.tip_angle, 0.01)
    count = np.count_nonzero(~answer.scene.fixed)
    print(f"\nto 0.01 degrees: {answer.value:.4f} +- {answer.estimate.bar:.4f} with {count} unknowns")
    draw(rows, exact).savefig(out / "speed_against_accuracy.png", dpi=150)
    return {"exact": exact, "answer": answer.value, "bar held": float(abs(answer.value - exact) <= answer.estimate.bar)}


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("out/speed_against_accuracy"), help="folder for the picture")
    sys.exit(0 if main(parser.parse_args().out) else 1)
