"""How far must a gripper close to hold with a given force?

By `reach`, with the contact force as its measure: it finds the shortening at which two fingers press on a disk with the
force asked for. It starts from open fingers, where the force has no slope.

One motor shortens the cables along the inner sides of both fingers: one command, `shared=True`. A ramp shows the force
growing from the first touch.

The disk is rigid and held where it is. It is lifted in the picture, not in the model: there is no friction.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

import jaxbeam as jb
from jaxbeam import plot

jax.config.update("jax_enable_x64", True)

LENGTH, HEIGHT, APART = 3.0, 0.4, 0.75  # of the fingers; the distance of their axes from the middle
DISK, RADIUS = np.array([0.0, -2.35]), 0.4
FORCE = 20.0
STIFFNESS, TRANSITION = 1e5, 1e-3  # of the contact
FRAMES, LIFT = 14, 0.6
# The outline of the ground, from which a pedestal rises to the disk.
RIGHT = np.array([[0.13, 0.0], [0.13, -0.4], [1.5, -0.4], [1.5, -2.0]])
GROUND = DISK - [0.0, RADIUS] + np.concatenate([RIGHT, RIGHT[::-1] * [-1, 1]])


def gripper() -> jb.Scene:
    """Two fingers that hang from their upper ends, with cables and the disk between them."""
    flat = jb.rectangle(LENGTH, HEIGHT, 19, 4, "crossed")
    left, right = (lambda x, y: (y - APART, -x - 0.5 * LENGTH)), (lambda x, y: (y + APART, -x - 0.5 * LENGTH))
    mesh, nodes, _ = jb.joined([jb.mapped(flat, left), jb.mapped(flat, right)])
    x, y = np.asarray(mesh.nodes).T
    inner = np.flatnonzero(np.abs(np.abs(x) - (APART - 0.5 * HEIGHT)) < 1e-9)
    guides = [0.0, -0.5, -1.0, -1.5, -2.0, -2.5]
    lines = [[jb.nearest_node(mesh, [side * (APART - 0.5 * HEIGHT), h]) for h in guides] for side in (-1, 1)]
    widths = np.tile([0.0, *[0.15] * 5], (2, 1))
    terms = (
        jb.solid(mesh, jb.lame(1e4, 0.45), jb.neo_hookean),
        jb.cables(mesh, lines, 2e3, jb.inverse_stiffness, width=widths, shared=True),
        jb.contact(mesh, inner, jb.disk(DISK, RADIUS), STIFFNESS, TRANSITION),
    )
    return jb.Scene(mesh, terms, jb.clamped(mesh, np.flatnonzero(y > -1e-9)), nodes[0][-4:])


def grip(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """Half the sum of the sideways forces on both fingers."""
    return 0.5 * jnp.sum(jnp.abs(jb.contact_forces(scene, x)[:, 0]))


def draw(scene: jb.Scene, x: jax.Array, ax: Axes) -> tuple[plot.Picture, Polygon]:
    """The gripper, and a pedestal on the ground below the disk."""
    ground = Polygon(GROUND, facecolor="#F0E6D2", edgecolor="0.4", linewidth=0.8, zorder=0)
    ax.add_patch(ground)
    return plot.Picture(scene, x, ax=ax, bounds=((-1.5, 1.5), (-3.4, 0.2))), ground


def animate(scene: jb.Scene, path: jb.Solution) -> FuncAnimation:
    """The fingers close, and the disk is lifted off the ground."""
    figure = Figure(figsize=(3.6, 4.4), layout="constrained")
    ax = figure.add_subplot()
    picture, ground = draw(scene, path.x[0], ax)

    def frame(k: int) -> None:
        closed = min(k, len(path.x) - 1)
        picture.move(path.x[closed], path.ratios[closed])
        # Seen by the gripper: when it is lifted, the ground sinks.
        ground.set_xy(GROUND - [0.0, LIFT * (k - closed) / FRAMES])

    # Laid out once, not for every frame.
    frame(0)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    return FuncAnimation(figure, frame, frames=len(path.x) + FRAMES, cache_frame_data=False)


def main(out: Path) -> dict[str, float]:
    """Solve, print, draw into the folder `out`; return the ratio of the cables, and the force at first touch."""
    out.mkdir(parents=True, exist_ok=True)
    scene = gripper()
    print(f"searching the ratio that grips with {FORCE:g} (the first time compiles) ...", flush=True)
    # The second command would move the disk. Its bounds keep it where it is.
    found = jb.reach(scene, FORCE, grip, bounds=([0.7, 0.0], [1.0, 0.0]), progress=True)
    jb.check(found.solution)
    if found.status != jb.DesignStatus.REACHED or abs(float(found.value) - FORCE) > 1e-6:
        raise RuntimeError(f"the force was missed: {found}")
    closed, x = jb.command(scene, found.theta), found.solution.x
    bar = jb.estimate_error(closed, found.solution, grip)
    print(f"  ratio {float(found.theta[0]):.5f}, in {int(found.solves)} solves")
    print(f"  tension of each cable {float(jb.tendon_tensions(closed, x)[0]):.2f}")
    print(f"  depth of the disk in the fingers {float(jb.penetration(closed, x).max()):.1e}")
    print(f"  the mesh changes the force by {bar.discretisation:+.3f}, at most {bar.bar:.3f}")

    path = jb.check(jb.ramp(scene, found.theta, 25))
    forces = jax.jit(jax.vmap(lambda r, x: grip(jb.command(scene, r), x)))(path.ratios, path.x)
    touch = float(path.ratios[np.argmax(forces > 0), 0])
    print(f"  the fingers touch the disk from ratio {touch:.3f} on")

    print("\ndrawing gripper.png and gripper.gif ...", flush=True)
    figure = Figure(figsize=(7.2, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.2))
    draw(closed, x, left)
    right.plot(path.ratios[:, 0], forces, color=plot.PALETTE[0], marker="o", markersize=3)
    right.axhline(FORCE, color="0.4", linestyle=":", linewidth=0.8)
    right.set(xlabel="ratio of the cables (dimensionless)", ylabel="grip force (force units)", xlim=(1.005, 0.84))
    figure.savefig(out / "gripper.png", dpi=200)
    plot.save_animation(animate(scene, path), out / "gripper.gif", fps=8)
    print(f"pictures are in {out}")
    return {"ratio": float(found.theta[0]), "tension": float(jb.tendon_tensions(closed, x)[0])}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/gripper"), help="folder for the pictures")
    main(parser.parse_args().out)
