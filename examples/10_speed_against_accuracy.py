"""How fast is an answer, and how right?

One command is solved by hand, as a rod, on one mesh and on two, and each answer is timed and compared.

The top tendon is pulled to 0.8 of its length, its free end spread over the surface within 0.25, so that there is an
answer to converge to. Every way to solve is timed, after compiling, and set against a fine mesh: the error is that of
the tip angle or of the tension, the larger of the two. Meshes come with an error bar, which knows nothing of that
answer: `jb.estimate_error` for one mesh, `jb.corrected` for two. Triangles have six nodes unless said otherwise. At
last `jb.choose` names the cheapest way for an error, and `jb.solve_to` refines until the angle is known to a hundredth
of a degree.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb

RATIOS = [0.8, 1.0]
WIDTH = 0.25
NEAR: dict[str, Any] = {"graded": "proportional"}
# Corners of triangles along and across, of six nodes unless said otherwise.
ONE: dict[str, dict[str, Any]] = {
    "29 x 7, three nodes": {"nx": 29, "ny": 7},
    "57 x 13, three nodes": {"nx": 57, "ny": 13},
    "29 x 7": {"nx": 29, "ny": 7, "order": 2},
    "9 x 5": {"nx": 9, "ny": 5, "order": 2, "diagonals": "mirrored", **NEAR},
    "17 x 9": {"nx": 17, "ny": 9, "order": 2, "diagonals": "mirrored", **NEAR},
}
TWO: dict[str, dict[str, Any]] = {
    "5 x 3": {"nx": 5, "ny": 3, "order": 2, "diagonals": "mirrored", **NEAR},
    "7 x 5": {"nx": 7, "ny": 5, "order": 2, "diagonals": "mirrored", **NEAR},
    "13 x 7": {"nx": 13, "ny": 7, "order": 2, "diagonals": "mirrored", **NEAR},
}
STYLES = {"model": ("0.4", "D"), "one mesh": ("C0", "o"), "two meshes": ("C3", "s")}


class Point(NamedTuple):
    """A way to solve: what it is, its error and its bar in percent, and its time in milliseconds."""

    kind: str
    name: str
    error: float
    bar: float | None
    ms: float


def tension(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """Of the top tendon."""
    return jb.tendon_tensions(scene, x)[0]


def measures(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """Tip angle and tension."""
    return jnp.stack([jb.tip_angle(scene, x), tension(scene, x)])


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """A result, and the median of the milliseconds that some calls take after the first, which compiles."""
    result, times = jax.block_until_ready(run()), []
    for _ in range(9):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return result, 1e3 * float(np.median(times))


def percent(values: Any, exact: np.ndarray) -> float:
    """The larger of two magnitudes, in percent of the exact measures."""
    return 100 * float(np.max(np.abs(values) / exact))


def models(exact: np.ndarray) -> list[Point]:
    """By hand, and as a rod. Neither has a bar: their error is that of the model."""
    hand, ms = timed(lambda: jb.euler_bernoulli(RATIOS))
    found = [Point("model", "by hand", percent(np.array([hand.tip_angle, hand.tensions[0]]) - exact, exact), None, ms)]
    rod = jb.command(jb.rod_beam(), RATIOS)
    solution, ms = timed(lambda: jb.equilibrium(rod))
    off = measures(rod, jb.check(solution).x) - exact
    return [*found, Point("model", "rod", percent(off, exact), None, ms)]


def one_mesh(name: str, exact: np.ndarray) -> Point:
    """A solve on one mesh, with the bars of `estimate_error`."""
    scene = jb.command(jb.tendon_beam(**ONE[name], anchor_width=WIDTH), RATIOS)
    solution, ms = timed(lambda: jb.equilibrium(scene))
    bars = [jb.estimate_error(scene, solution, measure).bar for measure in (jb.tip_angle, tension)]
    off = measures(scene, jb.check(solution).x) - exact
    return Point("one mesh", name, percent(off, exact), percent(np.array(bars), exact), ms)


def two_meshes(name: str, exact: np.ndarray) -> Point:
    """A solve on two meshes, whose bars come with it."""
    meshes = jb.two_meshes(jb.tendon_beam(**TWO[name], anchor_width=WIDTH))
    found, ms = timed(lambda: jb.corrected(meshes, RATIOS, measures))
    jb.check(found.solution)
    return Point("two meshes", name, percent(found.value - exact, exact), percent(found.bar, exact), ms)


def draw(points: list[Point]) -> Figure:
    """Error against time; a line leads to the bar that was told without the answer."""
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    ax = figure.add_subplot(xscale="log", yscale="log", xlabel="milliseconds of one solve", ylabel="error (%)")
    for kind, (colour, marker) in STYLES.items():
        own = [point for point in points if point.kind == kind]
        ax.plot([p.ms for p in own], [p.error for p in own], marker, color=colour, label=kind)
        for p in own:
            ax.annotate(p.name, (p.ms, p.error), xytext=(7, -9), textcoords="offset points", fontsize="x-small")
            if p.bar is not None and np.isfinite(p.bar):
                ax.plot([p.ms, p.ms], [p.error, p.bar], color=colour, lw=0.8)
                ax.plot(p.ms, p.bar, "_", color=colour, ms=12)
    ax.set_title(f"Tip angle and tension at ratio {RATIOS[0]}: error, and the bar told beforehand", fontsize="small")
    ax.set_xlim(right=ax.get_xlim()[1] * 4)
    ax.grid(alpha=0.3, lw=0.4, which="both")
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize="small", loc="lower left")
    return figure


def main(out: Path = Path("out/speed_against_accuracy")) -> dict[str, float]:
    out.mkdir(parents=True, exist_ok=True)
    finest = jb.tendon_beam(25, 13, order=2, diagonals="mirrored", anchor_width=WIDTH, **NEAR)
    truth = jb.corrected(jb.two_meshes(finest), RATIOS, measures)
    jb.check(truth.solution)
    exact = np.asarray(truth.value)
    print(f"fine meshes: {exact[0]:.4f} degrees, tension {exact[1]:.3f}; bar {percent(truth.bar, exact):.4f} %\n")

    points = [*models(exact), *(one_mesh(name, exact) for name in ONE), *(two_meshes(name, exact) for name in TWO)]
    print(f"{'':30}{'error %':>10}{'bar %':>10}{'ms':>10}")
    for p in points:
        print(f"{p.kind + ', ' + p.name:30}{p.error:10.4f}{'' if p.bar is None else f'{p.bar:.4f}':>10}{p.ms:10.2f}")
    draw(points).savefig(out / "speed_against_accuracy.png", dpi=150)

    print()
    for error in (0.1, 0.01, 0.001):
        choice = jb.choose(error)
        print(f"within {100 * error:g} %: {choice.name}, expected error {100 * choice.error:.2g} %")
    coarse = jb.command(jb.tendon_beam(7, 3, order=2, anchor_width=WIDTH, **NEAR), RATIOS)
    answer = jb.solve_to(coarse, jb.tip_angle, 0.01, progress=True)
    count = np.count_nonzero(~answer.scene.fixed)
    print(f"to 0.01 degrees: {answer.value:.4f} +- {answer.estimate.bar:.4f} with {count} unknowns")
    held = [p.error <= p.bar for p in points if p.bar is not None]
    return {
        "exact": float(exact[0]),
        "answer": answer.value,
        "bar held": float(abs(answer.value - exact[0]) <= answer.estimate.bar),
        "bars held": float(np.mean(held)),
        "two meshes": points[-1].error,
    }


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("out/speed_against_accuracy"), help="folder for the picture")
    sys.exit(0 if main(parser.parse_args().out) else 1)
