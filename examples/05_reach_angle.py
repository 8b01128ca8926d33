"""How do I find the commands that bend the tip to an angle?

By `reach`, here for a fan of targets from -34 to 34 degrees and for one that is out of reach. It finds, of all commands
within the bounds, those of least effort `sum (1 - ratio)^2` at which the tip angle is the target. Exact first and
second derivatives of the equilibrium take it from rest to within 1e-8 degrees in a handful of solves. One tendon pulls
and the other stays at its natural length: to pull both for the same angle would cost more effort. A target of 50
degrees cannot be met, and `reach` says so: with the nearest angle, and the bounds in the way.

`minimise` can do the same by any optimiser of optax, on the squared deviation. It is made for designs of other kinds
(07_design_shape.py); here it shows what the second derivatives are worth.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
import optax
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

import jaxbeam as jb
from jaxbeam import plot

jax.config.update("jax_enable_x64", True)

TARGETS = np.linspace(-34, 34, 33)
EVERY = 4  # of the targets is drawn as a beam
FAR, COMPARED = 50.0, 20.0
LOW, HIGH = 0.4, 1.0
NX, NY, LENGTH = 29, 7, 3.5
# Blue where tendon 2 pulls, orange where tendon 1 does.
COLOURS = LinearSegmentedColormap.from_list("sides", ["#56B4E9", "#0072B2", "#33414E", "#D55E00", "#E69F00"])

scene = jb.tendon_beam(NX, NY, LENGTH)


def commanded(theta: jax.Array) -> jb.Scene:
    """The beam under ratios that a sigmoid keeps within the bounds, whatever `theta` `(2,)` is."""
    return jb.command(scene, LOW + (HIGH - LOW) * jax.nn.sigmoid(theta))


def deviation(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """Squared deviation from the angle that is compared, in square degrees."""
    return (jb.tip_angle(scene, x) - COMPARED) ** 2


def draw_fan(found: list[jb.Design]) -> Figure:
    """The beams of some targets in one frame. The tip of each is at the height that the target asks for."""
    numbers = np.arange(NX * NY).reshape(NX, NY)
    around = np.concatenate([numbers[:, 0], numbers[-1], numbers[::-1, -1], numbers[0, ::-1]])
    shown = list(zip(TARGETS, found, strict=True))[::EVERY]
    (x0, x1), (y0, y1) = plot.limits(scene.mesh.nodes, *(design.solution.x for _, design in shown), margin=0.03)
    figure = Figure(figsize=(5.2, 5.6), layout="compressed")
    ax = figure.add_subplot(xlim=(x0, x1), ylim=(y0, y1), xlabel="x (length units)", ylabel="y (length units)")
    ax.set_aspect("equal")
    for target, design in sorted(shown, key=lambda pair: -abs(pair[0])):
        colour = COLOURS((target - TARGETS[0]) / np.ptp(TARGETS))
        x = np.asarray(design.solution.x)
        ax.add_patch(Polygon(x[around], facecolor=(*colour[:3], 0.10), edgecolor=colour, linewidth=1.4))
        tip = np.asarray(jb.tip_position(scene, design.solution.x))
        ax.plot([tip[0], x1], [tip[1], tip[1]], color=colour, linewidth=0.8, linestyle=(0, (4, 3)))
        ax.plot(*tip, "o", color=colour, markersize=4.5, markeredgecolor="white", markeredgewidth=0.6, zorder=5)
    left = float(scene.mesh.nodes[:, 0].min())
    ax.add_patch(Rectangle((left, -0.4), -0.09, 0.8, facecolor="none", edgecolor="0.2", linewidth=0, hatch="//////"))
    ax.plot([left, left], [-0.4, 0.4], color="0.2", linewidth=2.2)
    height = lambda angle: LENGTH * np.tan(np.deg2rad(angle))
    angle = lambda height: np.rad2deg(np.arctan2(height, LENGTH))
    scale = ax.secondary_yaxis("right", functions=(angle, height))
    scale.set_yticks(TARGETS[::EVERY], [f"${target:+.1f}$°" if target else "0°" for target in TARGETS[::EVERY]])
    scale.set_ylabel("target of the tip angle (degrees)")
    return figure


def draw_commands(found: list[jb.Design]) -> Figure:
    """Ratios, what is left of the deviation, and solves, against the target."""
    figure = Figure(figsize=(4.9, 5.6), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, height_ratios=(1.5, 1, 0.8))
    for number, (ratios, marker) in enumerate(zip(np.array([d.theta for d in found]).T, "os", strict=True)):
        style = {"color": plot.PALETTE[number], "marker": marker, "markersize": 3.5, "linewidth": 1.2}
        axes[0].plot(TARGETS, ratios, label=f"tendon {number + 1}", **style)
    axes[0].set(ylabel="ratio (dimensionless)", ylim=(0.37, 1.05))
    axes[0].axhline(LOW, color="0.4", linewidth=0.8, linestyle=":", label="lower bound")
    axes[0].legend(frameon=False, fontsize="small", loc="lower center")
    left = np.abs([float(d.value) - target for d, target in zip(found, TARGETS, strict=True)])
    axes[1].semilogy(TARGETS, np.where(left > 0, left, np.nan), "D", color=plot.PALETTE[2], markersize=3.5)
    axes[1].axhline(1e-8, color="0.4", linewidth=0.8, linestyle=":")
    axes[1].annotate("tolerance", (0, 1e-8), (0, 3), textcoords="offset points", ha="center", fontsize="small")
    axes[1].set(ylabel="deviation (degrees)", ylim=(1e-12, 2e-7), yticks=10.0 ** np.arange(-12, -6))
    axes[1].annotate("0 exactly", (0, 1e-12), (0, 4), textcoords="offset points", ha="center", fontsize="small")
    axes[2].bar(TARGETS, [int(d.solves) for d in found], width=1.3, color="#7A8B9A")
    axes[2].set(ylabel="solves", xlabel="target of the tip angle (degrees)", xticks=np.arange(-30, 31, 10))
    for ax in axes:
        ax.grid(color="0.9", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
    figure.align_ylabels(axes)
    return figure


def main(out: Path) -> dict[str, float]:
    """Reach, print, draw into the folder `out`; return the angle nearest to 50 degrees, and the ratio for 34."""
    out.mkdir(parents=True, exist_ok=True)
    print(f"reaching {len(TARGETS)} tip angles, each from rest (the first compiles) ...", flush=True)
    found = [jb.reach(scene, target, bounds=(LOW, HIGH)) for target in TARGETS]
    print("\ntarget, deg   ratios                   deviation, deg   solves   status")
    for target, design in zip(TARGETS, found, strict=True):
        jb.check(design.solution)
        top, bottom = design.theta
        miss, name = float(design.value) - target, jb.DesignStatus(int(design.status)).name
        print(f"{target:+11.3f}   {top:.8f}, {bottom:.8f}   {miss:+14.1e}   {int(design.solves):6d}   {name}")
        if name != "REACHED" or abs(miss) > 1e-8:
            raise RuntimeError(f"{target} degrees should have been reached")
    print(f"{sum(int(design.solves) for design in found)} solves in all")

    far = jb.reach(scene, FAR, bounds=(LOW, HIGH))
    print(f"\n{FAR:g} degrees: {jb.DesignStatus(int(far.status)).name}, the nearest is {float(far.value):.7f} degrees")
    for number, (ratio, held) in enumerate(zip(far.theta, far.held, strict=True), 1):
        where = {-1: "held by the lower bound", 0: "free", 1: "held by the upper bound"}[int(held)]
        print(f"  tendon {number}: ratio {ratio:.4f}, {where}")

    print(f"\n{COMPARED:g} degrees by other means (they compile) ...", flush=True)
    line = "  {:12} {:4d} solves, deviation {:.1e} degrees".format
    direct = jb.reach(scene, COMPARED, bounds=(LOW, HIGH))
    print(line("reach", int(direct.solves), float(direct.loss)))
    for name, optimiser, steps in [("optax.lbfgs", optax.lbfgs(), 50), ("optax.adam", optax.adam(0.1), 200)]:
        design = jb.minimise(deviation, np.full(2, 2.0), optimiser, steps, design=commanded, goal=1e-16, progress=True)
        print(line(name, int(design.solves), float(design.loss) ** 0.5))

    print("\ndrawing fan.png and commands.png ...", flush=True)
    draw_fan(found).savefig(out / "fan.png", dpi=200)
    draw_commands(found).savefig(out / "commands.png", dpi=200)
    print(f"pictures are in {out}")
    return {"nearest to 50": float(far.value), "ratio for 34": float(found[-1].theta[0])}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/reach_angle"), help="folder for the pictures")
    main(parser.parse_args().out)
