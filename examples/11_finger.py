"""How do I curl a jointed finger to a posture?

By `reach`: it finds the commands of least effort at which the three segments point where they should. Three cables,
which only pull, bend three soft joints.

The finger is a rectangle of stiff segments. At each joint it is soft, and notched from below, so that it bends there.
Three cables run along the lower side: the first ends behind the first joint, the second behind the second, the third at
the tip. One cable alone cannot do it: it bends all the joints that it passes.

The posture is within what cables can do, because each joint bends no more than the one before. Asked for a tip that
curls on its own, `reach` says `UNREACHABLE`, and how near it came.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from jaxbeam import plot

jax.config.update("jax_enable_x64", True)

LENGTH, HEIGHT = 5.0, 1.0
WIDE, DEPTH = 0.8, 0.7  # of the notches
JOINTS = np.array([-1.3, 0.2, 1.7])
GUIDES = (-2.1, -0.5, 1.0, 2.3)
STIFF, SOFT, CABLE = 5e4, 2e3, 2e3
POSTURE = np.array([-40.0, -72.0, -98.0])  # degrees of the three segments behind the joints
CURLED_TIP = np.array([-5.0, -10.0, -60.0])
BOUNDS = (0.5, 1.0)


def from_joint(x: np.ndarray) -> np.ndarray:
    """Distance along the finger from the nearest joint."""
    return np.abs(x[:, None] - JOINTS).min(axis=1)


def finger() -> jb.Scene:
    """The finger, clamped at its left end, with its cables at their natural lengths."""
    top = 0.5 * HEIGHT
    whole = jb.rectangle(LENGTH, HEIGHT, 51, 11, "crossed")
    notches = jb.elements_where(whole, lambda x, y: (y < DEPTH - top) & (from_joint(x) < 0.5 * WIDE))
    mesh, _ = jb.without(whole, notches)
    young = np.full(len(mesh.elements), STIFF)
    young[jb.elements_where(mesh, lambda x, y: from_joint(x) < 0.5 * WIDE)] = SOFT
    # The guides of the cables lie side by side, so that a picture tells them apart.
    lines = [
        [jb.nearest_node(mesh, [x + shift, -top]) for x in (-2.5 - shift, *GUIDES[: 2 + k])]
        for k, shift in enumerate((-0.1, 0.0, 0.1))
    ]
    widths = np.tile([0.0, *[0.2] * len(GUIDES)], (3, 1))
    cables = jb.cables(mesh, lines, CABLE, jb.inverse_stiffness, width=widths)
    body = jb.solid(mesh, jb.lame(young, 0.4), jb.neo_hookean)
    left = jb.nodes_where(mesh, lambda x, y: x == x.min())
    return jb.Scene(mesh, (body, cables), jb.clamped(mesh, left), jb.nodes_where(mesh, lambda x, y: x == x.max()))


SCENE = finger()
SEGMENTS = ((-0.9, -0.2), (0.6, 1.3), (2.1, 2.5))
TOP = np.array([[jb.nearest_node(SCENE.mesh, [x, 0.5 * HEIGHT]) for x in run] for run in SEGMENTS])


def posture(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """Direction in degrees `(3,)` of each segment behind a joint, along its upper side."""
    run = x[TOP[:, 1]] - x[TOP[:, 0]]
    return jnp.rad2deg(jnp.arctan2(run[:, 1], run[:, 0]))


def tip_segment(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """Direction of the last of them."""
    return posture(scene, x)[2]


def main(out: Path) -> dict[str, float]:
    """Solve, print, draw into the folder `out`; return the commands, and how near the curled tip comes."""
    out.mkdir(parents=True, exist_ok=True)
    print("searching the commands of the posture (the first time compiles) ...", flush=True)
    found = jb.reach(SCENE, POSTURE, posture, bounds=BOUNDS, progress=True)
    if found.status != jb.DesignStatus.REACHED or np.abs(found.value - POSTURE).max() > 1e-6:
        raise RuntimeError(f"the posture was missed: {found}")
    curled = jb.command(SCENE, found.theta)
    jb.check(found.solution)
    for name, values in (
        ("ratios", found.theta),
        ("tensions", jb.tendon_tensions(curled, found.solution.x)),
        ("segments, degrees", found.value),
    ):
        print(f"  {name:18}", "  ".join(f"{float(value):9.4f}" for value in values))
    bar = jb.estimate_error(curled, found.solution, tip_segment)
    print(f"  the mesh turns the tip by {bar.discretisation:+.2f} degrees, at most {bar.bar:.2f}")

    print("\nand with one cable alone, and of a tip that curls on its own ...", flush=True)
    alone = jb.check(jb.equilibrium(jb.command(SCENE, [1.0, 1.0, 0.75])))
    print("  third cable alone ", "  ".join(f"{float(value):9.4f}" for value in posture(SCENE, alone.x)), "degrees")
    nearest = jb.reach(SCENE, CURLED_TIP, posture, bounds=BOUNDS, progress=True)
    missed = float(np.linalg.norm(nearest.value - CURLED_TIP))
    print(f"  {jb.DesignStatus(int(nearest.status)).name}, {missed:.1f} degrees away")

    print("\ndrawing finger.png and finger.gif ...", flush=True)
    path = jb.check(jb.ramp(SCENE, found.theta, 17))
    bounds = plot.limits(SCENE.mesh.nodes, path.x)
    figure = Figure(figsize=(7.2, 5.4), layout="constrained")
    plot.beam(curled, found.solution.x, ax=figure.add_subplot(), bounds=bounds).legend(frameon=False, loc="right")
    figure.savefig(out / "finger.png", dpi=200)
    states = plot.States(SCENE, path.ratios, path.x)
    plot.save_animation(plot.animate_beams([states]), out / "finger.gif", fps=8)
    print(f"pictures are in {out}")
    names = ("first", "second", "third")
    return dict(zip(names, map(float, found.theta), strict=True)) | {"curled tip missed by": missed}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/finger"), help="folder for the pictures")
    main(parser.parse_args().out)
