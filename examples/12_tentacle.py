"""How do I steer a tentacle that has more cables than it needs?

By `reach_each`: of all commands that bring the tip to a point it finds those of least effort. The tentacle is tapered,
has six cables that only pull, and draws a figure of eight with its tip.

Three cables run along each side, through a guide at every sixth of the length. They end at a third, at two thirds and
at the end. Where the figure crosses the axis, the tip is drawn back by a sixth of the length. So cables of both sides
pull at once, and bend the tentacle to the shape of an S. Three of the six are shortened; the others stay at their
natural lengths.

The search is local: each point starts from the answer before. The tentacle and the figure are symmetric, but the
commands at the top and at the bottom are not. Those of the bottom take more effort than the mirror image of the top's.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxbeam as jb
from jaxbeam import plot

jax.config.update("jax_enable_x64", True)

LENGTH, HEIGHT, TIP = 6.0, 1.0, 0.3
YOUNG, POISSON, CABLE = 1e4, 0.4, 1e4
WIDTH, TRANSITION = 0.2, 0.05  # of anchors and guides; from slack to taut
BOUNDS = (0.3, 1.0)
START = [0.95, 0.95, 0.95, 1.0, 1.0, 1.0]  # at rest all cables are slack, and no way is better than its mirror image
POINTS, DRAWN = 48, (0, 6, 12, 24, 36)
ENDS = [f"{side}, to {end}" for side in ("upper", "lower") for end in ("1/3", "2/3", "the tip")]


def tentacle() -> jb.Scene:
    """The tentacle, clamped at `x = 0`, with its cables at their natural lengths."""
    plate = jb.quadratic(jb.rectangle(LENGTH, HEIGHT, 25, 4, "crossed"))
    mesh = jb.mapped(plate, lambda x, y: (x + 0.5 * LENGTH, y * (1 - (1 - TIP) * (x / LENGTH + 0.5))))
    lines = []
    for sign in (1, -1):
        clamp, tip = (jb.nearest_node(mesh, [x, sign * y]) for x, y in ((0.0, 0.5 * HEIGHT), (LENGTH, 0.5 * TIP)))
        line = jb.side(mesh, tip, clamp)[::-1] if sign > 0 else jb.side(mesh, clamp, tip)
        sixths = jb.along(mesh, line, np.linspace(0, 1, 7) * jb.arc_lengths(mesh, line)[-1], corners=True)
        lines += [sixths[:3], sixths[:5], sixths]
    widths = np.tile([0.0, *[WIDTH] * 6], (6, 1))
    cables = jb.cables(mesh, lines, CABLE, jb.inverse_stiffness, width=widths, transition=TRANSITION)
    left, right = jb.nodes_where(mesh, lambda x, y: x == 0), jb.nodes_where(mesh, lambda x, y: x == LENGTH)
    body = jb.solid(mesh, jb.lame(YOUNG, POISSON), jb.neo_hookean)
    return jb.Scene(mesh, (body, cables), jb.clamped(mesh, left), right)


def figure_of_eight() -> np.ndarray:
    """Points `(POINTS, 2)` of an eight that is bent like the way of the tip; the first is its top."""
    s = 2 * np.pi * np.arange(POINTS) / POINTS
    y = 2.0 * np.cos(s)
    return np.stack([5.0 - 0.14 * y**2 - 0.25 * np.sin(2 * s), y], axis=1)


def draw(ax: Axes, scene: jb.Scene, path: jb.Design, targets: np.ndarray) -> Callable[[int], None]:
    """The tentacle and the figure. The function returned moves it to point `k`, and draws the way of the tip."""
    tips, bounds = np.asarray(path.value), plot.limits(scene.mesh.nodes, path.solution.x, margin=0.04)
    picture = plot.Picture(scene, ax=ax, bounds=bounds)
    ax.plot(*targets[[*range(POINTS), 0]].T, color="0.55", linewidth=0.9, zorder=7, label="figure")
    (way,) = ax.plot([], [], color="black", linewidth=1.8, zorder=8, label="way of the tip")
    (tip,) = ax.plot([], [], "o", color="black", markeredgecolor="white", markersize=6, zorder=9)

    def to_point(k: int) -> None:
        ax.set_title(f"{100 * k / POINTS:.0f} % of the way", fontsize="medium")
        picture.move(path.solution.x[k % POINTS], path.theta[k % POINTS])
        way.set_data(*tips[np.arange(k + 1) % POINTS].T)
        tip.set_data(*tips[[k % POINTS]].T)

    return to_point


def main(out: Path) -> dict[str, float]:
    """Solve, print, draw into the folder `out`; return the lowest ratio, and the efforts at top and bottom."""
    out.mkdir(parents=True, exist_ok=True)
    scene, targets = tentacle(), figure_of_eight()
    print(f"following {POINTS} points (compiles first) ...", flush=True)
    path = jb.reach_each(scene, targets, jb.tip_position, bounds=BOUNDS, starts=[START], progress=True)
    jb.check(path.solution)
    error, ratios = np.abs(path.value - targets).max(), np.asarray(path.theta)
    if (np.asarray(path.status) != jb.DesignStatus.REACHED).any() or error > 1e-6:
        raise RuntimeError(f"points were missed, the worst by {error:.1e}: {path.status}")
    tensions = jax.vmap(lambda r, x: jb.tendon_tensions(jb.command(scene, r), x))(path.theta, path.solution.x)
    print(f"  all within {error:.1e}; {int(path.solves.sum())} solves, at most {int(path.solves.max())} for a point")
    for name, ratio, tension in zip(ENDS, ratios.min(axis=0), np.max(tensions, axis=0), strict=True):
        print(f"  {name:17} lowest ratio {ratio:.4f}, largest tension {tension:6.1f}")
    above, below = np.sum((1 - ratios[[0, POINTS // 2]]) ** 2, axis=1)
    print(f"  effort {above:.4f} at the top, {below:.4f} at the bottom")
    top = jb.command(scene, path.theta[0]), jax.tree.map(lambda rows: rows[0], path.solution)
    for name, measure in (("x", lambda s, x: jb.tip_position(s, x)[0]), ("y", lambda s, x: jb.tip_position(s, x)[1])):
        bar = jb.estimate_error(*top, measure)
        print(f"  {name} at the top: the mesh shifts it by {bar.discretisation:+.5f}, at most {bar.bar:.5f}")

    print("\ndrawing tentacle.png and tentacle.gif ...", flush=True)
    figure = Figure(figsize=(9.0, 5.4), layout="constrained")
    *panels, last = figure.subplots(2, 3).flat
    for ax, k in zip(panels, DRAWN, strict=True):
        draw(ax, scene, path, targets)(k)
        ax.set_ylabel(ax.get_ylabel() if ax in (panels[0], panels[3]) else "")
    lines = last.plot(100 * np.arange(POINTS + 1) / POINTS, ratios[[*range(POINTS), 0]], linewidth=1.6)
    for line, colour, name in zip(lines, plot.PALETTE, ENDS, strict=True):
        line.set(color=colour, label=name)
    last.set(xlabel="way along the figure (%)", ylabel="ratio (dimensionless)", xlim=(0, 100))
    last.set_title("commands (three stay at 1)", fontsize="medium")
    figure.legend(
        handles=[*lines, *panels[0].lines[-3:-1]], loc="outside lower center", ncols=4, frameon=False, fontsize="small"
    )
    figure.savefig(out / "tentacle.png", dpi=200)

    moving = Figure(figsize=(5.0, 4.4), layout="constrained")
    frame = draw(moving.add_subplot(), scene, path, targets)
    # Laid out once, not for every frame.
    frame(0)
    moving.draw_without_rendering()
    moving.set_layout_engine("none")
    plot.save_animation(FuncAnimation(moving, frame, frames=POINTS + 1), out / "tentacle.gif", fps=10)
    print(f"pictures are in {out}")
    return {"lowest ratio": float(ratios.min()), "top": float(above), "bottom": float(below)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/tentacle"), help="folder for the pictures")
    main(parser.parse_args().out)
