"""Where can the tip go?

`sweep` solves a grid of commands, on one process or on several, on one machine or on many. It continues each command
from its nearest solved neighbour, so that one or two Newton steps are left to take, and uses all cores. Run as it is,
this script solves a 64 x 64 grid and draws two pictures: the tip angle over the commands, and the reachable set of the
tip.

On several processes it is the same script, started once for each, with their number, its own and the address of the
first (here two on one machine):

    python examples/09_sweep_many.py --processes 2 --process 0 --coordinator localhost:9876 &
    python examples/09_sweep_many.py --processes 2 --process 1 --coordinator localhost:9876

`jax.distributed` joins them, each solves its part, and all get the whole: the same to the last bit, which the
fingerprint shows. The first process draws.
"""

import argparse
import hashlib
import time
from pathlib import Path

import jax
import numpy as np
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

import jaxbeam as jb

LOW, HIGH = 0.4, 1.0
ANGLES = np.arange(-35, 36, 5)


def draw_map(ratios: np.ndarray, angles: np.ndarray, bad: np.ndarray) -> Figure:
    """The tip angle over the two commands, which are a grid."""
    side = np.unique(ratios[:, 0]).size
    grid = lambda values: np.asarray(values).reshape(side, side).T
    top, bottom = grid(ratios[:, 0]), grid(ratios[:, 1])
    figure = Figure(figsize=(5.6, 4.8), layout="constrained")
    ax = figure.add_subplot(xlabel="ratio of the top tendon", ylabel="ratio of the bottom tendon", aspect="equal")
    field = np.ma.masked_array(grid(angles), grid(bad))
    shades = ax.pcolormesh(top, bottom, field, cmap="RdBu_r", norm=TwoSlopeNorm(0, -38, 38), shading="nearest")
    lines = ax.contour(top, bottom, field, ANGLES, colors="0.15", linewidths=0.6)
    ax.clabel(lines, fmt="%d°", fontsize="x-small")
    figure.colorbar(shades, label="tip angle (degrees)", ticks=np.arange(-30, 31, 10))
    return figure


def draw_reach(scene: jb.Scene, tips: np.ndarray, angles: np.ndarray, bad: np.ndarray, x: np.ndarray) -> Figure:
    """The tip positions of all commands, with the beam at rest and at the two ends of its reach."""
    figure = Figure(figsize=(4.9, 5.2), layout="constrained")
    ax = figure.add_subplot(xlabel="x (length units)", ylabel="y (length units)", aspect="equal")
    corners = scene.mesh.elements[:, [0, 1, 2, 0]]
    for k in (int(np.argmin(angles)), int(np.argmax(angles))):
        ax.plot(*x[k][corners].transpose(2, 1, 0), color="0.82", linewidth=0.4, zorder=0)
    ax.plot(*np.asarray(scene.mesh.nodes)[corners].transpose(2, 1, 0), color="0.7", linewidth=0.4, zorder=0)
    across, up = tips[~bad].T
    dots = ax.scatter(across, up, c=angles[~bad], s=3, cmap="coolwarm", norm=TwoSlopeNorm(0, -38, 38), linewidths=0)
    figure.colorbar(dots, label="tip angle (degrees)", ticks=np.arange(-30, 31, 10), shrink=0.8)
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def main(out: Path, side: int = 64) -> dict[str, float]:
    """Sweep, print, and on the first process draw into the folder `out`; return what was found."""
    scene = jb.tendon_beam()
    values = np.linspace(LOW, HIGH, side)
    ratios = np.stack([a.ravel() for a in np.meshgrid(values, values, indexing="ij")], axis=1)
    first = jax.process_index() == 0
    if first:
        print(f"{len(ratios)} commands on {jax.process_count()} process(es) (the first chunk compiles) ...", flush=True)
    start = time.perf_counter()
    found = jb.sweep(scene, ratios, progress=first)
    seconds = time.perf_counter() - start
    x, bad = np.asarray(found.x), np.asarray(found.status) != 0
    fingerprint = hashlib.sha256(x.tobytes()).hexdigest()[:16]
    angles = np.asarray(jax.vmap(lambda x: jb.tip_angle(scene, x))(found.x))
    steps, solved = float(np.mean(found.steps)), float(np.mean(~bad))
    print(f"process {jax.process_index()}: fingerprint {fingerprint}", flush=True)
    if first:
        print(f"{seconds:.2f} s with compiling; {100 * solved:.2f} % solved, {steps:.2f} Newton steps a command")
        print(f"tip angles from {angles[~bad].min():.4f} to {angles[~bad].max():.4f} degrees")
        for flag in jb.Status:
            count = int(np.sum((np.asarray(found.status) & flag) != 0))
            if count:
                print(f"  {flag.name}: {count} commands, which the pictures leave out")
        out.mkdir(parents=True, exist_ok=True)
        tips = np.asarray(jax.vmap(lambda x: jb.tip_position(scene, x))(found.x))
        draw_map(ratios, angles, bad).savefig(out / "map.png", dpi=200)
        draw_reach(scene, tips, angles, bad, x).savefig(out / "reachable_set.png", dpi=200)
        print(f"pictures are in {out}")
    return {"solved": solved, "highest": float(angles[~bad].max()), "lowest": float(angles[~bad].min())}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/sweep_many"), help="folder for the pictures")
    parser.add_argument("--side", type=int, default=64, help="commands of each tendon")
    parser.add_argument("--processes", type=int, default=1, help="how many processes work together")
    parser.add_argument("--process", type=int, default=0, help="the number of this one, from 0")
    parser.add_argument("--coordinator", default="localhost:9876", help="address of the first process")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.processes > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(options.coordinator, options.processes, options.process)
    main(options.out, options.side)
