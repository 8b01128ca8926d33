"""How do I design the shape of a body?

By `minimise`, over the parameters of the shape and here also the command: a tapered beam that one tendon curls along a
drawn spiral.

The curve is a clothoid: its curvature grows evenly along its length. A beam of uniform thickness under a tendon along
its upper edge bends nearly into an arc of a circle, whatever the command. Where it should bend more it must be
thinner. Six control values of a Bezier profile set its thickness, and one more parameter the command. `minimise` finds
all seven by L-BFGS, with the exact gradient of the equilibrium in the rest positions of the nodes and in the ratio.

The loss is the mean squared distance of each node on the centre line from the point of the curve that is as far along:
the beam has to lie on the curve, and may be of any length. The search begins at the best of the uniform beams.

A thin beam would have curvature `6 T (1 - nu^2) / (E h^2)` under the tension `T`: a line in the picture, to compare.
"""

import argparse
from functools import partial
from math import comb
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from matplotlib.figure import Figure

import jaxbeam as jb
from jaxbeam import plot

jax.config.update("jax_enable_x64", True)

NX, NY, LENGTH, HEIGHT = 29, 7, 3.5, 0.5
YOUNG, POISSON, MODULUS = 1e4, 0.45, 2e3
CONTROLS = 6
# Thickness over `HEIGHT`, and ratio of the tendon.
THICKNESS, RATIOS = (0.4, 1.6), (0.4, 1.0)
START, END = 0.1, 1.5  # curvature of the clothoid at 0 and at LENGTH, per length unit
GOAL = 2e-3  # root mean square distance from the curve, over LENGTH

REST = jb.rectangle(LENGTH, HEIGHT, NX, NY, "mirrored")
ALONG = np.asarray(REST.nodes[:, 0] - REST.nodes[:, 0].min()) / LENGTH
BASIS = np.stack([comb(CONTROLS - 1, k) * ALONG**k * (1 - ALONG) ** (CONTROLS - 1 - k) for k in range(CONTROLS)], 1)
CENTRE, UPPER = np.arange(NX) * NY + NY // 2, np.arange(0, NX, 2) * NY + NY - 1


def clothoid() -> tuple[np.ndarray, np.ndarray]:
    """Arc lengths `(k,)` and points `(k, 2)` of the curve, its direction integrated by the midpoint rule."""
    way = np.linspace(0, 1.3 * LENGTH, 4001)
    middle = 0.5 * (way[1:] + way[:-1])
    direction = START * middle + 0.5 * (END - START) / LENGTH * middle**2
    steps = np.diff(way)[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    return way, np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


WAY, CURVE = clothoid()


def between(bounds: tuple[float, float], theta: jax.Array) -> jax.Array:
    """A value within bounds, for any number."""
    return bounds[0] + (bounds[1] - bounds[0]) * jax.nn.sigmoid(theta)


def number(bounds: tuple[float, float], value: float) -> np.ndarray:
    """The number that `between` takes to `value`."""
    return np.log((value - bounds[0]) / (bounds[1] - value))


def design(theta: Any) -> jb.Scene:
    """The beam of a thickness profile, `theta["controls"]`, under a command, `theta["ratio"]`."""
    thickness = BASIS @ between(THICKNESS, theta["controls"])
    mesh = jb.Mesh(jnp.stack([LENGTH * ALONG, thickness * REST.nodes[:, 1]], axis=1), REST.elements)
    terms = (jb.solid(mesh, jb.lame(YOUNG, POISSON)), jb.tendons(mesh, [UPPER], MODULUS))
    scene = jb.Scene(mesh, terms, jb.clamped(REST, np.arange(NY)), (NX - 1) * NY + np.arange(NY))
    return jb.command(scene, between(RATIOS, theta["ratio"])[None])


def arc_lengths(x: jax.Array) -> jax.Array:
    """How far along the centre line each of its nodes is `(NX,)`."""
    edges = jnp.diff(x[CENTRE], axis=0)
    return jnp.concatenate([jnp.zeros(1), jnp.cumsum(jnp.sqrt(jnp.sum(edges**2, axis=1)))])


def distance(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """Mean squared distance of the centre line from the curve, over the squared length."""
    way = arc_lengths(x)
    on_curve = jnp.stack([jnp.interp(way, WAY, CURVE[:, k]) for k in range(2)], axis=1)
    return jnp.mean(jnp.sum((x[CENTRE] - on_curve) ** 2, axis=1)) / LENGTH**2


def draw(before: tuple[jb.Scene, jax.Array], after: tuple[jb.Scene, jax.Array], losses: np.ndarray) -> Figure:
    """Both beams with the curve, the thickness that was found, and the loss on the way to it."""
    figure = Figure(figsize=(7.2, 5.3), layout="constrained")
    (*beams, profile, history) = figure.subplots(2, 2, height_ratios=(1.05, 1)).ravel()
    drawn = CURVE[WAY <= LENGTH]
    bounds = plot.limits(before[1], after[1], drawn, before[0].mesh.nodes, after[0].mesh.nodes, margin=0.03)
    for ax, (scene, x), name in zip(beams, (before, after), ("uniform", "designed"), strict=True):
        plot.beam(scene, x, ax=ax, bounds=bounds)
        ax.plot(*np.asarray(x)[CENTRE].T, color="#009E73", linewidth=2.2, label="centre line", zorder=8)
        ax.plot(*drawn.T, color="black", linewidth=1.4, linestyle=(0, (3, 2)), label="curve", zorder=9)
        off = 100 * float(distance(scene, x)) ** 0.5
        ax.set_title(f"{name}: {off:.2f} % off the curve", fontsize="medium")
    beams[1].set_ylabel("")
    beams[1].legend(frameon=False, fontsize="small", loc="upper right")

    scene, x = after
    thickness = np.ptp(np.asarray(scene.mesh.nodes[:, 1]).reshape(NX, NY), axis=1)
    curvature = START + (END - START) / LENGTH * np.asarray(arc_lengths(x))
    tension = float(jb.tendon_tensions(scene, x)[0])
    thin = np.sqrt(6 * tension * (1 - POISSON**2) / (YOUNG * curvature))
    profile.axhline(HEIGHT, color="0.55", linewidth=1.2, linestyle=":", label="uniform")
    profile.plot(LENGTH * ALONG[CENTRE], thickness, color="#0072B2", linewidth=1.8, label="designed")
    profile.plot(LENGTH * ALONG[CENTRE], thin, color="#D55E00", linewidth=1.2, linestyle="--", label="thin beam")
    for bound, label in zip(THICKNESS, ("bounds", None), strict=True):
        profile.axhline(bound * HEIGHT, color="0.75", linewidth=0.8, label=label)
    profile.set(xlabel="x at rest (length units)", ylabel="thickness (length units)", ylim=(0, 1.15))
    profile.legend(frameon=False, fontsize="small", ncols=2, loc="upper right", borderaxespad=0)
    history.semilogy(100 * np.sqrt(losses), "o-", color="#0072B2", markersize=3, linewidth=1.2)
    history.axhline(100 * GOAL, color="0.4", linewidth=0.8, linestyle=":")
    history.annotate("goal", (0, 100 * GOAL), (0, 3), textcoords="offset points", fontsize="small")
    history.set(xlabel="steps of L-BFGS", ylabel="off the curve (% of length)", ylim=(0.15, 9))
    history.set_yticks(ticks := [0.2, 0.5, 1, 2, 5], [str(tick) for tick in ticks])
    history.minorticks_off()
    for ax in (profile, history):
        ax.spines[["top", "right"]].set_visible(False)
    return figure


def main(out: Path) -> dict[str, float]:
    """Design, print, draw into the folder `out`; return the distance before, over the length, and the solves."""
    out.mkdir(parents=True, exist_ok=True)
    print("pulling the uniform beam (compiles first) ...", flush=True)
    theta = {"controls": np.full(CONTROLS, number(THICKNESS, 1.0)), "ratio": number(RATIOS, 0.5)}
    ramp = jb.check(jb.ramp(design(theta), [0.45]))
    losses = np.asarray(jax.jit(jax.vmap(partial(distance, design(theta))))(ramp.x))
    best = int(np.argmin(losses))
    theta["ratio"] = number(RATIOS, float(ramp.ratios[best, 0]))
    before = (design(theta), ramp.x[best])

    print("designing (compiles first) ...", flush=True)
    found = jb.minimise(distance, theta, optax.lbfgs(), 60, design=design, goal=GOAL**2, progress=True)
    jb.check(found.solution)
    after, history = (design(found.theta), found.solution.x), np.asarray(found.history.loss)
    if int(found.status) != jb.DesignStatus.REACHED:
        raise RuntimeError(f"the goal was not reached: {float(found.loss) ** 0.5:.2e}, not {GOAL:.0e}")
    print("\nsteps   root mean square distance from the curve, over the length")
    for step in sorted({*range(0, len(history), 5), len(history) - 1}):
        print(f"{step:5d}   {history[step] ** 0.5:.6f}")
    profile = ", ".join(f"{value:.3f}" for value in HEIGHT * between(THICKNESS, found.theta["controls"]))
    print(f"\nloss {history[0]:.3e} before, {float(found.loss):.3e} after {int(found.solves)} solves")
    print(f"ratio {float(ramp.ratios[best, 0]):.4f} before, {float(found.solution.ratios[0]):.4f} after")
    print(f"control values of the thickness: {profile} length units, {HEIGHT} before")
    print(f"length of the centre line: {float(arc_lengths(after[1])[-1]):.4f} length units")

    print("\ndrawing design.png ...", flush=True)
    draw(before, after, history).savefig(out / "design.png", dpi=200)
    print(f"pictures are in {out}")
    return {"before": float(history[0]) ** 0.5}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/design_shape"), help="folder for the pictures")
    main(parser.parse_args().out)
