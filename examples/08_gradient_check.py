"""Are the derivatives right?

Taylor remainders and central differences of the steered reference beam tell.

The tip angle is a function of 746 parameters: both commands, both tendon moduli, a Young's modulus for each triangle
and the rest position of each node. Along a random direction its gradient must predict a small change up to an error
of order 2 in the step, and gradient and Hessian together up to one of order 3, until that drowns in round-off. Each
kind of parameter is then compared with central differences by itself.
"""

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import tree_map
from matplotlib.figure import Figure

import jaxbeam as jb
from jaxbeam import plot

jax.config.update("jax_enable_x64", True)

RATIOS = (0.4, 1.0)
BEAM = jb.tendon_beam()
# Differences show the error of a solve: forces are balanced as far as round-off lets them.
SOLVER = jb.Newton(rtol=1e-14)
STEPS = np.logspace(-6, -1, 21)
# The two decades in which the order is measured: above round-off, below terms of higher order.
MEASURED = slice(8, 17)
# Central differences of order 4: the step, and the weights at one and two steps to either side.
STEP, WEIGHTS = 1e-3, {1: 8, 2: -1, -1: -8, -2: 1}
NAMES = ("change of the angle", "what the gradient leaves of it", "what gradient and Hessian leave")

Parameters = dict[str, Any]


def built(theta: Parameters) -> jb.Scene:
    """The reference beam with these parameters."""
    mesh = jb.Mesh(theta["rest positions"], BEAM.mesh.elements)
    body = jb.solid(mesh, jb.lame(theta["Young's moduli"], 0.45))
    pair = jb.tendons(mesh, BEAM.terms[1].nodes, theta["tendon moduli"])
    commands = jnp.stack([theta["top command"], theta["bottom command"]])
    return jb.command(jb.Scene(mesh, (body, pair), BEAM.fixed, BEAM.tip), commands)


def tip_angle(theta: Parameters) -> tuple[jax.Array, jb.Solution]:
    """In degrees, and the solution."""
    scene = built(theta)
    solution = jb.equilibrium(scene, solver=SOLVER)
    return jb.tip_angle(scene, solution.x), solution


@jax.jit
def expand(theta: Parameters, d: Parameters) -> tuple[jax.Array, Parameters, jax.Array, jb.Solution]:
    """Angle, gradient, second derivative `d^T H d` along `d` and solution: forward over reverse mode, one solve."""
    first = jax.value_and_grad(tip_angle, has_aux=True)
    ((angle, solution), gradient), (_, turned) = jax.jvp(first, (theta,), (d,))
    return angle, gradient, product(d, turned), solution


def product(a: Parameters, b: Parameters) -> jax.Array:
    """The inner product of two sets of parameters."""
    return sum(jax.tree.leaves(tree_map(lambda x, y: jnp.sum(x * y), a, b)), jnp.zeros(()))


def angle_at(theta: Parameters, d: Parameters, h: float) -> float:
    """The angle after a step along `d`, solved anew."""
    angle, _, _, solution = expand(tree_map(lambda value, change: value + h * change, theta, d), d)
    jb.check(solution)
    return float(angle)


def draw(remainders: list[np.ndarray], round_off: float) -> Figure:
    """Remainders against the step, with lines of the slopes that they must have."""
    figure = Figure(figsize=(4.9, 4.2), layout="constrained")
    ax = figure.add_subplot(xscale="log", yscale="log", xlim=(7e-7, 0.14), ylim=(1e-16, 10))
    for order, (left, name, k) in enumerate(zip(remainders, NAMES, (5, 5, 9), strict=True), 1):
        colour, marker = plot.PALETTE[order - 1], plot.MARKERS[order - 1]
        ax.plot(STEPS, left, marker, color=colour, markersize=4.5, markerfacecolor="none", label=name)
        ax.plot(STEPS, left[10] * (STEPS / STEPS[10]) ** order, color=colour, linewidth=0.8)
        ax.annotate(f"slope {order}", (STEPS[k], left[k]), (6, -12), textcoords="offset points", color=colour)
    ax.axhspan(0, round_off, color="0.92", zorder=0)
    ax.annotate("round-off of the angle", (0.1, round_off), (0, -11), textcoords="offset points", ha="right")
    ax.set(xlabel="step h along a random direction (dimensionless)", ylabel="tip angle (degrees)")
    ax.grid(color="0.9", linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize="small", loc="upper left")
    return figure


def main(out: Path) -> dict[str, float]:
    """Solve, print, draw into the folder `out`; return the orders and the derivatives by the commands, in degrees."""
    out.mkdir(parents=True, exist_ok=True)
    nodes, count = np.asarray(BEAM.mesh.nodes), len(BEAM.mesh.elements)
    theta: Parameters = {"top command": RATIOS[0], "bottom command": RATIOS[1], "tendon moduli": np.full(2, 2e3)}
    theta |= {"Young's moduli": np.full(count, 1e4), "rest positions": nodes}
    # A step of 1 is large: it changes commands and moduli by about themselves, positions by a tenth of a cell.
    sizes = {name: np.mean(value) for name, value in theta.items()} | {"rest positions": 0.1 * (nodes[1] - nodes[0])[1]}
    rng = np.random.default_rng(0)
    d = {name: size * rng.standard_normal(np.shape(theta[name])) for name, size in sizes.items()}

    print("solving (the first time compiles) ...", flush=True)
    angle, gradient, curvature, solution = expand(theta, d)
    jb.check(solution)
    print(f"tip angle {angle:.7f} degrees, a function of {sum(map(np.size, theta.values()))} parameters\n")
    change = np.array([angle_at(theta, d, h) for h in STEPS]) - float(angle)
    linear = STEPS * float(product(gradient, d))
    remainders = [np.abs(change - part) for part in (0, linear, linear + 0.5 * STEPS**2 * float(curvature))]
    orders = [np.diff(np.log(left)) / np.diff(np.log(STEPS)) for left in remainders]
    print("step h     |f(x + h d) - f(x)|   less gradient   order   less Hessian   order")
    for k, (h, a, b, c) in enumerate(zip(STEPS, *remainders, strict=True)):
        first, second = (f"{order[k - 1]:5.2f}" if k else "     " for order in orders[1:])
        print(f"{h:.2e}   {a:19.3e}   {b:13.3e}   {first}   {c:12.3e}   {second}")
    first, second = (np.polyfit(np.log(STEPS[MEASURED]), np.log(left[MEASURED]), 1)[0] for left in remainders[1:])
    low, high = STEPS[MEASURED][[0, -1]]
    print(f"order from {low:.0e} to {high:.0e}: {first:.4f} with the gradient, {second:.4f} with the Hessian\n")

    print("along a random direction   implicit, deg    differences, deg   relative difference")
    apart = []
    for name in theta:
        alone = tree_map(np.zeros_like, theta) | {name: d[name]}
        found = sum(weight * angle_at(theta, alone, k * STEP) for k, weight in WEIGHTS.items()) / (12 * STEP)
        implicit = float(product(gradient, alone))
        apart.append(abs(implicit / found - 1))
        print(f"{name} ({np.size(theta[name])})".ljust(24), f"{implicit:+16.10f}   {found:+16.10f}   {apart[-1]:19.1e}")

    print("\ndrawing gradient_check.png ...", flush=True)
    draw(remainders, float(np.spacing(angle))).savefig(out / "gradient_check.png", dpi=200)
    print(f"pictures are in {out}")
    numbers = {"gradient's order": first, "Hessian's order": second, "relative difference": max(apart)}
    return numbers | {name: float(gradient[name]) for name in ("top command", "bottom command")}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/gradient_check"), help="folder for the picture")
    main(parser.parse_args().out)
