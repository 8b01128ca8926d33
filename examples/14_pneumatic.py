"""How do I bend a body with chambers by pressure, on a mesh of my own?

`files.read_mesh` reads the mesh, here from Gmsh. `reach` finds the pressure in eight chambers at which the tip section
has turned by 40 degrees, and the shortening of a cable along the lower side that turns it as far.

The chambers lie in the upper half. Blown up, they stretch it, and the beam bends down. The two shapes differ: the
chambers make the beam longer, the cable makes it shorter.

`14_pneumatic.msh` holds six-node triangles and named groups: the clamp, the tip, the lower side and the chambers. Other
meshes of such groups, in any format that meshio reads, may take its place.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from jaxbeam import files, plot

jax.config.update("jax_enable_x64", True)

MESH = Path(__file__).with_suffix(".msh")
YOUNG, POISSON, CABLE = 1e4, 0.45, 1e4
TURN = -40.0  # degrees of the tip section
MOST = 1500.0  # pressure


def beams() -> tuple[jb.Scene, jb.Scene]:
    """The beam with pressure in its chambers, and with a cable instead."""
    read = files.read_mesh(MESH)
    mesh, groups = read.mesh, read.nodes
    body = jb.solid(mesh, jb.lame(YOUNG, POISSON), jb.neo_hookean)
    fixed = jb.clamped(mesh, groups["clamp"])
    below = jb.along(mesh, jb.side(mesh, *ends(mesh)), np.linspace(0.0, 3.5, 8), corners=True)
    cable = jb.cables(mesh, below[None], CABLE, jb.inverse_stiffness, width=[[0.0, *[0.2] * 6, 0.4]])
    blown = jb.Scene(mesh, (body, jb.pressure(mesh, groups["chambers"])), fixed, groups["tip"])
    return blown, jb.Scene(mesh, (body, cable), fixed, groups["tip"])


def ends(mesh: jb.Mesh) -> tuple[int, int]:
    """The nodes at the two ends of the lower side."""
    return jb.nearest_node(mesh, [0.0, 0.0]), jb.nearest_node(mesh, [4.0, 0.0])


def main(out: Path) -> dict[str, float]:
    """Solve, print, draw into the folder `out`; return the two commands, and how far the tips are apart."""
    out.mkdir(parents=True, exist_ok=True)
    found, tips = {}, []
    for name, scene, within in zip(("pressure", "ratio"), beams(), ((0.0, MOST), (0.4, 1.0)), strict=True):
        print(f"searching the {name} that turns the tip by {TURN:g} degrees (compiles first) ...", flush=True)
        design = jb.reach(scene, TURN, jb.section_rotation, bounds=within, progress=True)
        jb.check(design.solution)
        if design.status != jb.DesignStatus.REACHED or abs(float(design.value) - TURN) > 1e-6:
            raise RuntimeError(f"the angle was missed: {design}")
        commanded = jb.command(scene, design.theta)
        bar = jb.estimate_error(commanded, design.solution, jb.section_rotation)
        tips.append(np.asarray(jb.tip_position(commanded, design.solution.x)))
        stress = float(jb.von_mises_stress(commanded, design.solution.x).max())
        print(f"  {name} {float(design.theta[0]):.4f}, in {int(design.solves)} solves; tip at {tips[-1].round(3)}")
        print(f"  the mesh turns it by {bar.discretisation:+.3f} degrees, at most {bar.bar:.3f}")
        print(f"  largest von Mises stress {stress:.0f}")
        found[name] = (commanded, design)

    print("\ndrawing pneumatic.png and pneumatic.gif ...", flush=True)
    figure = Figure(figsize=(7.2, 2.9), layout="constrained")
    shown = [(commanded, design.solution.x) for commanded, design in found.values()]
    bounds = plot.limits(*(x for _, x in shown), shown[0][0].mesh.nodes, margin=0.12)
    for ax, (scene, x), title in zip(figure.subplots(1, 2, sharey=True), shown, ("pressure", "cable"), strict=True):
        plot.beam(scene, x, ax=ax, bounds=bounds)
        ax.set_title(title)
        ax.label_outer()
    figure.savefig(out / "pneumatic.png", dpi=200)
    paths = [
        plot.States(scene, path.ratios, path.x, title)
        for title, (scene, design) in found.items()
        for path in [jb.check(jb.ramp(scene, design.theta, 16))]
    ]
    plot.save_animation(plot.animate_beams(paths), out / "pneumatic.gif", fps=8)
    print(f"pictures are in {out}")
    apart = float(np.linalg.norm(tips[0] - tips[1]))
    return {name: float(design.theta[0]) for name, (_, design) in found.items()} | {"tips apart": apart}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/pneumatic"), help="folder for the pictures")
    main(parser.parse_args().out)
