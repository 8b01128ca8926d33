"""How does a beam bend when its tendons are pulled?

`ramp` pulls the top tendon of the reference beam, the bottom one, and both, each in 28 steps. `sweep` solves a gallery,
in which one tendon is shortened by d and the other lengthened by d. Each answer is printed beside the reference number
for this mesh, and drawn in stills and animations.
"""

import argparse
import time
from pathlib import Path

import jax
import numpy as np

import jaxbeam as jb
from jaxbeam import plot

jax.config.update("jax_enable_x64", True)

STEPS = 28
PATTERNS = {"top pulled": (0.4, 1.0), "bottom pulled": (1.0, 0.4), "both pulled": (0.4, 0.4)}
ASYMMETRIES = np.linspace(-0.4, 0.4, 9)
# Tip angle in degrees and tendon lengths, found by two independent codes.
REFERENCE = {
    (0.4, 1.0): (35.5152802, (0.9342211, 1.9252493)),
    (1.0, 0.4): (-34.9502718, (1.9273442, 0.9245819)),
    (0.4, 0.4): (-5.0890962, (1.1427431, 1.1117417)),
    (0.6, 1.4): (27.34482, None),
    (0.8, 1.2): (13.35328, None),
    (1.2, 0.8): (-13.39917, None),
    (1.4, 0.6): (-27.24721, None),
}


def print_row(scene: jb.Scene, ratios: tuple[float, float], solution: jb.Solution) -> float:
    """Print the last state of a solution with leading axis, below it the reference; return the tip angle."""
    x = solution.x[-1]
    angle = float(jb.tip_angle(scene, x))
    lengths = ", ".join(f"{length:.7f}" for length in jb.tendon_lengths(scene, x))
    tensions = ", ".join(f"{tension:8.2f}" for tension in jb.tendon_tensions(jb.command(scene, ratios), x))
    status = jb.Status(int(np.bitwise_or.reduce(solution.status)))
    print(
        f"{ratios[0]:.1f}, {ratios[1]:.1f}    {angle:+12.7f}   {lengths}   {tensions}   {solution.residual.max():8.1e}"
        f"   {solution.steps.sum():5d}   {solution.smallest_jacobian.min():10.4f}   {status.name}"
    )
    if ratios in REFERENCE:
        angle_known, lengths_known = REFERENCE[ratios]
        known = f"{angle_known:+12.7f}" if lengths_known else f"{angle_known:+10.5f}  "
        print(f"  reference {known}   " + ", ".join(f"{length:.7f}" for length in lengths_known or ()))
    return angle


def main(out: Path) -> dict[str, float]:
    """Solve, print, draw into the folder `out`; return the tip angles in degrees."""
    out.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    scene = jb.tendon_beam()

    paths, asymmetric = {}, np.stack([1 - ASYMMETRIES, 1 + ASYMMETRIES], axis=1)
    for name, ratios in PATTERNS.items():
        print(f"solving {name}, {STEPS} steps ...", flush=True)
        paths[name] = jax.block_until_ready(jb.check(jb.ramp(scene, ratios, STEPS)))
    print(f"solving the gallery, {len(asymmetric)} commands ...", flush=True)
    gallery = jax.block_until_ready(jb.check(jb.sweep(scene, asymmetric)))
    solved = time.perf_counter()

    print("\nratios      tip angle, deg   tendon lengths         true tensions         ", end="")
    print("  residual   steps   smallest J   status")
    angles = {name: print_row(scene, PATTERNS[name], path) for name, path in paths.items()}
    for k, (top, bottom) in enumerate(asymmetric.round(9).tolist()):
        one = jax.tree.map(lambda leaf, k=k: leaf[k : k + 1], gallery)
        angles[f"d = {ASYMMETRIES[k]:+.1f}"] = print_row(scene, (top, bottom), one)
    print("(residual and smallest J: the worst of a ramp; steps: Newton steps in all)\n")

    ramps = [plot.States(scene, jb.commands(PATTERNS[name], STEPS), path.x, name) for name, path in paths.items()]
    print("drawing steer_beam.png ...", flush=True)
    top, bottom, both = ramps
    rest = plot.States(scene, top.commands[:1], top.x[:1])
    shown = [rest, top, both, bottom]
    ends = plot.States(scene, np.stack([s.commands[-1] for s in shown]), np.stack([s.x[-1] for s in shown]))
    titles = [
        f"{s.title or 'at rest'}: ${angle:+.2f}$°" for s, angle in zip(shown, ends.measure(jb.tip_angle), strict=True)
    ]
    plot.gallery(ends, titles, columns=2).savefig(out / "steer_beam.png", dpi=200)

    print("drawing gallery.png ...", flush=True)
    deflections = plot.States(scene, asymmetric, gallery.x)
    titles = [f"$d = {d:+.1f}$: ${angles[f'd = {d:+.1f}']:+.1f}$°" for d in ASYMMETRIES]
    plot.gallery(deflections, titles).savefig(out / "gallery.png", dpi=200)

    print("drawing steer_top.gif ...", flush=True)
    plot.save_animation(plot.animate_ramp(top), out / "steer_top.gif")
    print("drawing steer_three.gif ...", flush=True)
    plot.save_animation(plot.animate_beams(ramps), out / "steer_three.gif")

    end = time.perf_counter()
    print(f"\ncompiled and solved in {solved - begin:.1f} s, printed and drew in {end - solved:.1f} s")
    print(f"pictures are in {out}")
    return angles


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/steer_beam"), help="folder for the pictures")
    main(parser.parse_args().out)
