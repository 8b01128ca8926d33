"""Where does a beam snap, and where to?

`trace_branch` follows the equilibria from rest through their folds, as both tendons are pulled together from ratio 1.0
to 0.3, on two meshes. `lowest_mode` shows which shape becomes unstable.

On a mesh that is symmetric about mid-height ("mirrored") the beam stays straight until it loses stability at ratio
0.38258; from there a pair of bent states branches off, one on each side. It first turns back, by less than 1e-4 in the
ratio, and is stable only behind its fold. One-sided diagonals spoil the symmetry: the branch folds back already at
0.40874, is unstable up to 0.41207, and goes on, stable, to a last fold at 0.37390.

The instability begins at the anchors, where the body is squeezed to half its area: `modes.png` colours the modes by
how much they strain each element. The critical mode strains the elements beside the anchors, and the free half of the
beam merely turns with them. It comes down through the other modes as the body is squeezed. The bending mode strains
the half between the tendons, and its eigenvalue rises, from 1.15 to 2.3, until the local mode meets it.

A figure of -3.4 degrees has been published for one-sided diagonals and both ratios at 0.4. It is no equilibrium.
Beyond the first fold, at 0.40874, there is none beside the one before: the beam must snap from 0.0 to below
-2.4 degrees, and Newton's method follows it in many short steps. One that stops at its cap on iterations reports
where it happens to be. At -3.4 degrees the unbalanced force is still 23.6; the snap ends at -5.089 degrees.

Nor is that the only stable equilibrium at (0.4, 0.4). Others are found by search: commands drawn at random, with a
fixed seed, from [0.2, 1.0] for either tendon, are solved from rest in one jump, and from each state the beam jumps to
(0.4, 0.4). What is found is listed by energy; a search shows what exists, never that there is no more. In most of
these states the body passes through itself: they are equilibria of this model, which knows no contact, and not of a
real beam. Their status is `OVERLAPPING`, and the list says so.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import jaxbeam as jb
from jaxbeam import plot

jax.config.update("jax_enable_x64", True)

END = (0.3, 0.3)
GOAL = (0.4, 0.4)
STEPS, SEARCHES, SEED = 28, 150, 0
# Published for (0.4, 0.4), and not an equilibrium.
PUBLISHED = -3.4
# One setting throughout, so that everything is compiled once: saddles are wanted here.
SOLVER = jb.Newton(escape=False)


def trace(scene: jb.Scene, **start: Any) -> jb.Branch:
    """A branch towards `END`, up to where it would go on with an element turned inside out."""
    branch = jb.trace_branch(scene, END, solver=SOLVER, progress=True, **start)
    inverted = np.flatnonzero(branch.smallest_jacobian <= 0)
    end = int(inverted[0]) if inverted.size else len(branch.x)
    names = ("parameter", "ratios", "x", "negative", "residual", "smallest_jacobian", "overlapping")
    parts = {name: getattr(branch, name)[:end] for name in names}
    return dataclasses.replace(branch, **parts, critical=tuple(c for c in branch.critical if c.after < end - 1))


def trace_pair(scene: jb.Scene, fork: jb.Critical) -> list[jb.Branch]:
    """The two bent branches of a bifurcation, each from the bifurcation on."""
    return [
        trace(scene, through=fork, direction=side, interval=(0.5, 1.0), step=0.01, max_points=140) for side in (1, -1)
    ]


def pull(scene: jb.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Ratios and tip angles of a beam that is pulled to `GOAL` step by step, each from the state before."""
    ratios, angles, x = np.linspace(1.0, GOAL[0], STEPS), [], scene.mesh.nodes
    for ratio in ratios:
        x = jb.check(jb.equilibrium(jb.command(scene, [ratio, ratio]), x, SOLVER)).x
        angles.append(float(jb.tip_angle(scene, x)))
    return ratios, np.array(angles)


def search(scene: jb.Scene) -> list[tuple[jb.Solution, np.ndarray, int]]:
    """Stable equilibria at `GOAL` by energy, each with a command it was reached from, and how often it was."""
    found: dict[float, tuple[jb.Solution, np.ndarray, int]] = {}
    balanced = lambda solution: int(solution.status) in (jb.Status.OK, jb.Status.OVERLAPPING)
    goal = jb.command(scene, GOAL)
    for count, ratios in enumerate(np.random.default_rng(SEED).uniform(0.2, 1.0, (SEARCHES, 2)), 1):
        first = jb.equilibrium(jb.command(scene, ratios), None, SOLVER)
        state = jb.equilibrium(goal, first.x, SOLVER) if balanced(first) else first
        if balanced(first) and balanced(state):
            key = round(float(state.energy), 6)
            known = found.get(key, (state, ratios, 0))
            found[key] = (*known[:2], known[2] + 1)
        if count % 50 == 0:
            print(f"  {count} of {SEARCHES} starts, {len(found)} equilibria", flush=True)
    return [found[key] for key in sorted(found)]


def mode_strain(scene: jb.Scene, x: jax.Array, shape: jax.Array) -> jax.Array:
    """How much a mode strains each element `(t,)`: norm of the rate of Green's strain, over the largest."""

    def green(x: jax.Array) -> jax.Array:
        rest, now = (nodes[scene.mesh.elements] for nodes in (scene.mesh.nodes, x))
        across = lambda corners: jnp.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        F = across(now) @ jnp.linalg.inv(across(rest))
        return 0.5 * (jnp.swapaxes(F, 1, 2) @ F - jnp.eye(2))

    norms = jnp.linalg.norm(jax.jvp(green, (x,), (shape,))[1], axis=(1, 2))
    return norms / norms.max()


def draw_diagram(lopsided: jb.Scene, folded: jb.Branch, pulled: tuple, mirrored: jb.Scene, fork: list) -> Figure:
    """Both branch diagrams, whole and where stability is lost."""
    figure = Figure(figsize=(7.2, 5.6), layout="constrained")
    axes = figure.subplots(2, 2)
    rows = [
        (lopsided, [folded], "one-sided", ((0.4145, 0.3990), (-5.6, 0.9))),
        (mirrored, fork, "mirrored", ((0.38270, 0.38245), (-1.3, 1.3))),
    ]
    for (whole, close), (scene, traced, name, (across, up)) in zip(axes, rows, strict=True):
        for ax in (whole, close):
            plot.branches(scene, traced, ax=ax).set_xlabel("")
        whole.set_title(f"{name} diagonals", fontsize="medium")
        close.set_title("where stability is lost", fontsize="medium")
        whole.set_xlim(1.0, 0.3)
        close.set(xlim=across, ylim=up, ylabel="")
        width, height = across[0] - across[1], up[1] - up[0]
        box = Rectangle((across[1], up[0]), width, height, fill=False, edgecolor="0.35", linewidth=0.8, zorder=5)
        whole.add_patch(box)
        close.get_legend().remove()
        whole.get_legend().set_loc("lower left" if scene is lopsided else "upper left")
    close = axes[0, 1]
    close.plot(*pulled, "s", color="#0072B2", markersize=4, markerfacecolor="none", label="pulled in 28 steps")
    close.plot([GOAL[0]], [PUBLISHED], "x", color="black", markersize=7, markeredgewidth=1.6, label="no equilibrium")
    close.legend(frameon=False, fontsize="small", loc="lower left")
    close.set_xticks([0.412, 0.408, 0.404, 0.4])
    axes[1, 1].ticklabel_format(axis="x", useOffset=False)
    axes[1, 1].set_xticks([0.3827, 0.3826, 0.3825])
    figure.supxlabel("commanded ratio of both tendons (dimensionless)", fontsize="medium")
    return figure


def draw_modes(scene: jb.Scene, straight: jb.Branch) -> tuple[Figure, np.ndarray]:
    """The lowest eigenvalues of the straight beam, and two modes on it; and bending's first and highest eigenvalue.

    Each eigenvalue is coloured by how much of its mode's strain lies beside the anchors. Bending, little strained
    there, rises; a local mode comes down through the others, meets it and becomes unstable.
    """
    (fork,) = straight.critical
    centres = np.asarray(scene.mesh.nodes)[scene.mesh.elements].mean(axis=1)
    anchors = np.asarray(scene.mesh.nodes)[scene.terms[1].nodes[:, 1]]
    near = np.linalg.norm(centres[:, None] - anchors, axis=2).min(axis=1) < 0.25

    @jax.jit
    def share(x: jax.Array, shape: jax.Array) -> jax.Array:
        squares = mode_strain(scene, x, shape) ** 2
        return 100 * jnp.sum(jnp.where(near, squares, 0)) / jnp.sum(squares)

    keep = (straight.ratios[:, 0] < 1) & (straight.ratios[:, 0] > 0.35)
    ratios, states = straight.ratios[keep, 0], jnp.asarray(straight.x[keep])
    modes = [jb.lowest_mode(jb.command(scene, [r, r]), x, 4, SOLVER) for r, x in zip(ratios, states, strict=True)]
    values = np.array([m.values for m in modes])
    local = np.array([[share(x, shape) for shape in m.shapes] for x, m in zip(states, modes, strict=True)])
    rest = jb.lowest_mode(scene, scene.mesh.nodes, 4, SOLVER)

    figure = Figure(figsize=(7.2, 5.2), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(1.25, 1))
    curve = figure.add_subplot(grid[0, :])
    dots = curve.scatter(
        np.repeat(ratios, 4), np.ravel(values), c=np.ravel(local), s=11, cmap="viridis", vmin=0, vmax=100, zorder=3
    )
    figure.colorbar(dots, ax=curve, label="strain beside the anchors (%)")
    curve.axhline(0, color="0.4", linewidth=0.8)
    curve.axvline(fork.ratios[0], color="0.4", linewidth=0.8, linestyle=":")
    curve.annotate(
        f"critical, {fork.ratios[0]:.4f}", (fork.ratios[0], 200), (-6, 0), textcoords="offset points", ha="right"
    )
    curve.annotate("bending", (0.8, float(rest.values[0])), (0, 7), textcoords="offset points", ha="center")
    curve.set(xlim=(1.01, 0.355), ylim=(-500, 500), xlabel="commanded ratio of both tendons (dimensionless)")
    curve.set_yscale("symlog", linthresh=5)
    curve.set_yticks(ticks := [-100, -10, -5, 0, 5, 10, 100], [str(tick) for tick in ticks])
    curve.set_ylabel("lowest eigenvalues (force / length)")
    curve.grid(color="0.9", linewidth=0.6)
    curve.spines[["top", "right"]].set_visible(False)
    pictures = [
        (scene.mesh.nodes, rest.shapes[0], f"bending at rest, {float(rest.values[0]):.2f}"),
        (fork.x, fork.shape, f"critical mode at {fork.ratios[0]:.4f}, 0.00"),
    ]
    drawn = [(x, x + 0.3 * shape / jnp.abs(shape).max(), shape, title) for x, shape, title in pictures]
    bounds = plot.limits(*(moved for _, moved, _, _ in drawn), *(x for x, _, _, _ in drawn))
    for column, (x, moved, shape, title) in enumerate(drawn):
        ax = figure.add_subplot(grid[1, column])
        plot.field(scene, moved, mode_strain(scene, x, shape), "strain of the mode", ax=ax, bounds=bounds)
        ax.set_title(title, fontsize="medium")
    highest = np.argmax(values[ratios > fork.ratios[0], 0])
    return figure, np.array([values[0, 0], values[highest, 0], ratios[highest]])


def main(out: Path) -> dict[str, float]:
    """Trace, search, print, draw into the folder `out`; return the critical ratios and the lowest energy at `GOAL`."""
    out.mkdir(parents=True, exist_ok=True)
    lopsided, mirrored = jb.tendon_beam(), jb.tendon_beam(diagonals="mirrored")
    print("tracing the beam with one-sided diagonals (the first time compiles) ...", flush=True)
    folded = trace(lopsided, step=0.008, max_points=240)
    print("tracing the beam with mirrored diagonals ...", flush=True)
    straight = trace(mirrored, step=0.01)
    (fork,) = straight.critical
    pair = trace_pair(mirrored, fork)

    numbers = {}
    print("\ncritical points\n  diagonals    kind           ratio        tip angle, deg")
    for scene, name, branch in [(lopsided, "one-sided", folded), (mirrored, "mirrored", straight), *(
        (mirrored, "bent pair", each) for each in pair
    )]:  # fmt: skip
        for number, point in enumerate(branch.critical, 1):
            angle = float(jb.tip_angle(scene, point.x))
            print(f"  {name:12} {point.kind:12} {point.ratios[0]:.8f}  {angle:+12.5f}")
            if name != "bent pair":
                numbers[f"{name} {point.kind} {number}"] = float(point.ratios[0])

    print("\npulling the one-sided beam, and searching at (0.4, 0.4) ...", flush=True)
    pulled = pull(lopsided)
    found = search(lopsided)
    print(
        "\nstable equilibria at (0.4, 0.4)\n"
        "  energy        tip angle, deg   smallest J   found   first from       status"
    )
    for state, ratios, count in found:
        angle = float(jb.tip_angle(lopsided, state.x))
        mark = "   <- pulled in steps" if abs(angle - pulled[1][-1]) < 1e-6 else ""
        print(
            f"  {float(state.energy):11.5f}  {angle:+13.5f}   {float(state.smallest_jacobian):10.4f}   {count:5}   "
            f"({ratios[0]:.3f}, {ratios[1]:.3f})   {jb.Status(int(state.status)).name}{mark}"
        )
    numbers |= {"pulled in steps": float(pulled[1][-1]), "lowest energy": float(found[0][0].energy)}

    print("\ndrawing branches.png ...", flush=True)
    draw_diagram(lopsided, folded, pulled, mirrored, [straight, *pair]).savefig(out / "branches.png", dpi=200)
    print("drawing modes.png ...", flush=True)
    figure, bending = draw_modes(mirrored, straight)
    figure.savefig(out / "modes.png", dpi=200)
    print(f"bending eigenvalue: {bending[0]:.3f} at first, {bending[1]:.3f} at ratio {bending[2]:.3f}, its highest")
    print("drawing equilibria.png ...", flush=True)
    kinds = ["overlapping" if int(s.status) else f"energy {float(s.energy):.1f}" for s, _, _ in found]
    titles = [
        f"{float(jb.tip_angle(lopsided, s.x)):+.2f}°, {kind}" for (s, _, _), kind in zip(found, kinds, strict=True)
    ]
    states = plot.States(lopsided, np.tile(GOAL, (len(found), 1)), np.stack([s.x for s, _, _ in found]))
    plot.gallery(states, titles).savefig(out / "equilibria.png", dpi=200)
    print(f"pictures are in {out}")
    return numbers


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/buckling"), help="folder for the pictures")
    main(parser.parse_args().out)
