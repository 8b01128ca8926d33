"""How do I make the tip follow a path?

By `reach_each`, here along a figure of eight, with two tendons that only ever pull.

With two tendons the tip can be brought anywhere in a crescent, mapped here by a sweep over the commands. `reach_each`
walks along a closed curve in it. Each point starts from the answer before, and takes a few solves with the exact first
and second derivatives of the equilibrium. Two coordinates by two commands: nothing is left to save effort on.

Lines of constant ratio, drawn in the crescent, show why the commands of so plain a figure are not plain themselves.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

import jaxbeam as jb
from jaxbeam import plot

jax.config.update("jax_enable_x64", True)

BOUNDS = (0.45, 1.0)
NX, NY, LENGTH = 29, 7, 3.5
POINTS, GRID = 96, 12
DRAWN, OUTLINED = 24, (0, 72)  # points at which the picture shows the beam, and its outline
TOLERANCE = 1e-8  # of the length
CRESCENT, TRACE = "#F6E9CC", "#009E73"


def figure_of_eight() -> np.ndarray:
    """Points `(POINTS, 2)` of an eight that is bent like the crescent."""
    s = 2 * np.pi * np.arange(POINTS) / POINTS
    y = 1.25 * np.sin(s)
    return np.stack([1.575 - 0.21 * y**2 + 0.11 * np.sin(2 * s), y], axis=1)


def draw_crescent(ax: Axes, region: np.ndarray, edge: str = "face") -> None:
    """The tips `(GRID, GRID, 2)` of the sweep, as a patch for each cell of its grid."""
    corners = [region[:-1, :-1], region[1:, :-1], region[1:, 1:], region[:-1, 1:]]
    cells = np.stack(corners, axis=2).reshape(-1, 4, 2)
    ax.add_collection(PolyCollection(list(cells), facecolor=CRESCENT, edgecolor=edge, linewidth=0.5, zorder=0))


def draw_path(scene: jb.Scene, path: jb.Design, targets: np.ndarray, region: np.ndarray) -> Figure:
    """Crescent, target, tip and beams; a closer look; commands and error along the way."""
    states, tips = np.asarray(path.solution.x), np.asarray(path.value)
    around = np.arange(NX * NY).reshape(NX, NY)
    around = np.concatenate([around[:, 0], around[-1], around[::-1, -1], around[0, ::-1]])
    figure = Figure(figsize=(8.6, 4.0), layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=(2.75, 1.6, 2.1), height_ratios=(1.6, 1))
    whole, close = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[:, 1])
    bounds = plot.limits(scene.mesh.nodes, states[[DRAWN, *OUTLINED]], region, margin=0.03)
    plot.beam(jb.command(scene, path.theta[DRAWN]), states[DRAWN], ax=whole, bounds=bounds)
    for k in OUTLINED:
        whole.add_patch(Polygon(states[k][around], facecolor="none", edgecolor="#7A8B9A", linewidth=0.9, zorder=1))
    for ax in (whole, close):
        draw_crescent(ax, region)
        ax.plot(*targets[[*range(POINTS), 0]].T, color="black", linewidth=1.0, label="target", zorder=7)
    for number, lines in enumerate((region, region.transpose(1, 0, 2))):
        for line in lines:
            close.plot(*line.T, color=plot.PALETTE[number], linewidth=0.5)
        close.plot([], [], color=plot.PALETTE[number], linewidth=0.8, label=f"tendon {number + 1}\nconstant")
    close.plot(*tips.T, ".", color=TRACE, markersize=5, label="tip", zorder=8)
    arrow = {"arrowstyle": "-|>", "color": "black", "linewidth": 1.0, "mutation_scale": 15}
    close.annotate("", targets[7], targets[2], arrowprops=arrow, zorder=9)
    close.set(xlim=(0.88, 1.79), ylim=(-1.42, 1.42), xticks=(1.0, 1.25, 1.5, 1.75), xlabel="x (length units)")
    close.set_title("closer, x stretched", fontsize="medium")
    close.legend(frameon=False, fontsize="small", loc="center left", handlelength=1.1, borderaxespad=0.1)

    way = 100 * np.arange(POINTS) / POINTS
    above, below = figure.add_subplot(grid[0, 2]), figure.add_subplot(grid[1, 2])
    for number, ratios in enumerate(np.asarray(path.theta).T):
        above.plot(way, ratios, color=plot.PALETTE[number], linewidth=1.4, label=f"tendon {number + 1}")
    above.set(ylabel="ratio (dimensionless)", ylim=(BOUNDS[0] - 0.03, 1.06))
    above.legend(frameon=False, fontsize="small", ncols=2, loc="upper center", handlelength=1.2, columnspacing=1.2)
    below.semilogy(way, np.linalg.norm(tips - targets, axis=1) / LENGTH, ".", color=TRACE, markersize=4)
    below.axhline(TOLERANCE, color="0.4", linewidth=0.8, linestyle=":")
    below.set(ylabel="error / length", xlabel="way along the figure (%)", ylim=(1e-12, 1e-7))
    below.annotate("asked for", (50, TOLERANCE), (0, 3), textcoords="offset points", ha="center", fontsize="small")
    for ax in (above, below):
        ax.grid(color="0.9", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
    above.sharex(below)
    above.tick_params(labelbottom=False)
    return figure


def animate(scene: jb.Scene, path: jb.Design, targets: np.ndarray, region: np.ndarray) -> FuncAnimation:
    """The beam at every third point, and the tip's line as it grows."""
    states, tips = np.asarray(path.solution.x), np.asarray(path.value)
    bounds = plot.limits(scene.mesh.nodes, states, region, margin=0.03)
    figure = Figure(figsize=(4.0, 4.7), layout="compressed")
    ax = figure.add_subplot()
    draw_crescent(ax, region)
    picture = plot.Picture(scene, states[0], ax=ax, bounds=bounds)
    ax.plot(*targets[[*range(POINTS), 0]].T, color="0.45", linewidth=0.8, zorder=7)
    (way,) = ax.plot([], [], color=TRACE, linewidth=2.0, zorder=8)
    (tip,) = ax.plot([], [], "o", color=TRACE, markeredgecolor="white", markersize=6, zorder=9)

    def draw(frame: int) -> None:
        picture.move(states[frame % POINTS], path.theta[frame % POINTS])
        way.set_data(*tips[np.arange(frame + 1) % POINTS].T)
        tip.set_data(*tips[[frame % POINTS]].T)
        ax.set_title("ratios " + ", ".join(f"{r:.2f}" for r in path.theta[frame % POINTS]), fontsize="medium")

    # Laid out once, not for every frame.
    draw(0)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    return FuncAnimation(figure, draw, frames=range(0, POINTS + 1, 3), cache_frame_data=False)


def main(out: Path) -> dict[str, float]:
    """Solve, print, draw into the folder `out`; return the solves in all and the lowest ratio."""
    out.mkdir(parents=True, exist_ok=True)
    scene, targets = jb.tendon_beam(NX, NY, LENGTH), figure_of_eight()
    print(f"mapping what the tip can reach, {GRID**2} commands ...", flush=True)
    ratios = np.stack(np.meshgrid(*[np.linspace(*BOUNDS, GRID)] * 2, indexing="ij"), axis=-1)
    swept = jb.check(jb.sweep(scene, ratios.reshape(-1, 2), progress=True))
    tip = jax.jit(jax.vmap(lambda x: jb.tip_position(scene, x)))
    region = np.asarray(tip(swept.x)).reshape(GRID, GRID, 2)

    print(f"following {POINTS} points (compiles first) ...", flush=True)
    path = jb.reach_each(scene, targets, jb.tip_position, bounds=BOUNDS, progress=True)
    jb.check(path.solution)
    error = np.linalg.norm(path.value - targets, axis=1) / LENGTH
    tension = jax.jit(jax.vmap(lambda r, x: jb.tendon_tensions(jb.command(scene, r), x)))(path.theta, path.solution.x)
    missed = np.flatnonzero((np.asarray(path.status) != jb.DesignStatus.REACHED) | (error > TOLERANCE))
    if missed.size:
        raise RuntimeError(f"{missed.size} points were missed, the first of them is {missed[0]}")
    print(f"\nall {POINTS} points reached, the worst error is {error.max():.1e} of the length")
    print(f"{int(path.solves.sum())} solves in all, at most {int(path.solves.max())} for a point")
    print(f"ratios from {float(path.theta.min()):.4f} to {float(path.theta.max()):.4f}")
    if not tension.min() > 0:
        raise RuntimeError("a tendon pushes")
    print(f"tensions from {float(tension.min()):.1f} to {float(tension.max()):.1f} force units: no tendon ever pushes")

    print("\ndrawing path.png ...", flush=True)
    draw_path(scene, path, targets, region).savefig(out / "path.png", dpi=200)
    print("drawing path.gif ...", flush=True)
    plot.save_animation(animate(scene, path, targets, region), out / "path.gif", fps=10)
    print(f"pictures are in {out}")
    return {"solves": float(path.solves.sum()), "lowest ratio": float(path.theta.min())}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/follow_path"), help="folder for the pictures")
    main(parser.parse_args().out)
