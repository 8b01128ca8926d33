"""How do tip angle and tensions grow as the tendons are pulled, and where is the stress?

`ramp` solves the way for three ways to pull. Curves show tip angle, tensions and tendon lengths against actuation, and
pictures of two end states show Cauchy stress, J and strain energy.

Tensions are true forces, the derivative of a tendon's energy in its length. With both tendons pulled the branch from
rest folds back near ratio 0.41 and the beam jumps: the last step of that curve is the jump.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxbeam as jb
from jaxbeam import plot

jax.config.update("jax_enable_x64", True)

STEPS = 28
PATTERNS = {"top pulled": (0.4, 1.0), "bottom pulled": (1.0, 0.4), "both pulled": (0.4, 0.4)}


def draw_fields(ramp: plot.States) -> Figure:
    """Stress and volume ratio at the nodes, at the end of a ramp."""
    scene, x = jb.command(ramp.scene, ramp.commands[-1]), jnp.asarray(ramp.x[-1])
    stress, volume = jb.nodal_stress(scene, x), jb.to_nodes(scene, jb.jacobians(scene, x))
    bounds = plot.limits(scene.mesh.nodes, x)
    (x0, x1), (y0, y1) = bounds
    figure = Figure(figsize=(8.2, 4.5 * (y1 - y0) / (x1 - x0) + 1.6), layout="compressed")
    figure.suptitle(ramp.title)
    fields = [
        ("Cauchy stress along x", stress[:, 0, 0], r"$\sigma_{xx}$ (unit of $E$)", None),
        ("Cauchy stress, shear", stress[:, 0, 1], r"$\sigma_{xy}$ (unit of $E$)", None),
        ("von Mises stress", jb.nodal_von_mises_stress(scene, x), r"$\sigma_\mathrm{M}$ (unit of $E$)", None),
        ("volume ratio", volume, "$J$ (dimensionless)", 1.0),
    ]
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    for ax, (title, values, label, centre) in zip(axes.ravel(), fields, strict=True):
        plot.field(scene, x, values, label, centre=centre, ax=ax, bounds=bounds)
        ax.set_title(title, fontsize="medium")
        ax.label_outer()
    return figure


def main(out: Path) -> dict[str, float]:
    """Solve, print, draw into the folder `out`; return the largest tension of each pattern in force units."""
    out.mkdir(parents=True, exist_ok=True)
    scene = jb.tendon_beam()
    ramps = []
    for name, ratios in PATTERNS.items():
        print(f"solving {name}, {STEPS} steps ...", flush=True)
        ramps.append(plot.States(scene, jb.commands(ratios, STEPS), jb.check(jb.ramp(scene, ratios, STEPS)).x, name))

    largest = {}
    for ramp in ramps:
        angles, tensions = ramp.measure(jb.tip_angle), ramp.measure(jb.tendon_tensions)
        largest[ramp.title] = float(tensions.max())
        print(f"\n{ramp.title}\n  ratios      tip angle, deg     tensions, force units")
        for k in range(0, STEPS, 3):
            print(
                f"  {ramp.commands[k, 0]:.2f}, {ramp.commands[k, 1]:.2f}   {angles[k]:+13.4f}    "
                f"{tensions[k, 0]:9.2f}, {tensions[k, 1]:9.2f}"
            )

    print("\ndrawing tip_angle.png ...", flush=True)
    figure = Figure(figsize=(4.6, 3.2), layout="constrained")
    plot.curves(ramps, ax=figure.add_subplot())
    figure.savefig(out / "tip_angle.png", dpi=200)

    print("drawing tendons.png ...", flush=True)
    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    axes = figure.subplots(2, len(ramps), sharex=True, sharey="row")
    for column, ramp in zip(axes.T, ramps, strict=True):
        column[0].set_title(ramp.title, fontsize="medium")
        plot.curves([ramp], jb.tendon_tensions, "tension (force units)", ax=column[0])
        plot.curves([ramp], jb.tendon_lengths, "length (length units)", ax=column[1])
        for ax in column:
            ax.set_xlabel("")
            ax.label_outer()
    for ax in axes.ravel()[1:]:
        ax.get_legend().remove()
    figure.supxlabel("commanded ratio (dimensionless)", fontsize="medium")
    figure.savefig(out / "tendons.png", dpi=200)

    for ramp in (ramps[0], ramps[2]):
        name = f"fields_{ramp.title.split()[0]}.png"
        print(f"drawing {name} ...", flush=True)
        draw_fields(ramp).savefig(out / name, dpi=200)
    print(f"pictures are in {out}")
    return largest


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/ramp_curves"), help="folder for the pictures")
    main(parser.parse_args().out)
