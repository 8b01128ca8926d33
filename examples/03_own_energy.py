"""How do I add physics of my own?

As an energy, which is a function of positions. Here there are two: soft ground under the beam, and a wire whose tension
is commanded.

The ground is a bare function. It pushes back on every node that sinks below its level, and does nothing otherwise.
Forces, Hessians and the solver follow from the energy. Compares the beam steered down with and without ground.

The wire says more of itself: what its command is, what is measured on it, how it is drawn. So it is commanded, ramped
and drawn like a tendon. One wire along the bottom of the beam bends it down by its tension alone.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from jaxbeam import plot

jax.config.update("jax_enable_x64", True)

RATIOS = (1.0, 0.4)
LEVEL, STIFFNESS = -0.8, 1000.0
TENSION = 150.0


def ground(x: jax.Array, params: dict[str, jax.Array]) -> jax.Array:
    """Energy of one node over soft ground: `1/2 k depth^2` where it is below the level, else zero."""
    depth = jnp.maximum(params["level"] - x[0, 1], 0)
    return 0.5 * params["stiffness"] * depth**2


def with_ground(scene: jb.Scene) -> jb.Scene:
    """The scene with ground below the nodes of its lower edge."""
    edge = jb.nodes_where(scene.mesh, lambda x, y: y == y.min())
    params = {"level": jnp.full(edge.size, LEVEL), "stiffness": jnp.full(edge.size, STIFFNESS)}
    return jb.Scene(scene.mesh, (*scene.terms, jb.Term(ground, edge[:, None], params)), scene.fixed, scene.tip)


@dataclasses.dataclass(frozen=True)
class Wire(jb.Energy):
    """A wire between two nodes, under a tension `T` that is commanded: its energy is `T` times its length."""

    name: ClassVar[str] = "wire"
    rest_command: ClassVar[float | None] = 0.0

    def __call__(self, x: jax.Array, tension: jax.Array) -> jax.Array:
        return tension * jnp.linalg.norm(x[1] - x[0])

    def command(self, params: jax.Array, values: jax.Array) -> Any:
        return values

    def command_of(self, params: jax.Array) -> jax.Array:
        return params

    def measured(self, x: jax.Array, tension: jax.Array) -> dict[str, jax.Array]:
        return {"length": jnp.linalg.norm(x[:, 1] - x[:, 0], axis=-1), "tension": tension}

    def line(self, x: jax.Array, params: jax.Array) -> jax.Array:
        return x


def wired() -> jb.Scene:
    """The reference beam with one wire, from the bottom of the clamp to the bottom of the tip, and no tendons."""
    beam = jb.tendon_beam()
    ends = [jb.nearest_node(beam.mesh, corner) for corner in ((-1.75, -0.4), (1.75, -0.4))]
    wire = jb.Term(Wire(), np.array([ends]), jnp.zeros(1))
    return jb.Scene(beam.mesh, (beam.terms[0], wire), beam.fixed, beam.tip)


def main(out: Path) -> dict[str, float]:
    """Solve, print, draw into the folder `out`; return the tip angles in degrees."""
    out.mkdir(parents=True, exist_ok=True)
    free = jb.tendon_beam()
    scenes = {"without ground": free, "with ground": with_ground(free)}
    ramps, angles = [], {}
    for name, scene in scenes.items():
        print(f"solving {name} ...", flush=True)
        path = jb.check(jb.ramp(scene, RATIOS))
        ramps.append(plot.States(scene, jb.commands(RATIOS), path.x, name))
        angles[name] = float(jb.tip_angle(scene, path.x[-1]))
        held = jb.reactions(jb.command(scene, RATIOS), path.x[-1]).sum(axis=0)[1]
        print(f"  tip angle {angles[name]:+.4f} degrees, vertical force of the clamp {held:+.4f} force units")

    print("drawing ground.png ...", flush=True)
    bounds = plot.limits(*(ramp.x[-1] for ramp in ramps), free.mesh.nodes)
    figure = Figure(figsize=(7.2, 3.6), layout="compressed")
    for ax, ramp in zip(figure.subplots(1, 2, sharey=True), ramps, strict=True):
        plot.beam(jb.command(ramp.scene, RATIOS), ramp.x[-1], ax=ax, bounds=bounds)
        ax.set_title(f"{ramp.title}: ${angles[ramp.title]:+.1f}$°", fontsize="medium")
        ax.legend(loc="lower right", fontsize="small", frameon=False)
        ax.label_outer()
    ax.axhspan(bounds[1][0], LEVEL, color="#E8DFD0", zorder=0)
    figure.savefig(out / "ground.png", dpi=200)

    print("solving the wire ...", flush=True)
    scene = wired()
    path = jb.check(jb.ramp(scene, [TENSION], steps=8))
    pulled = jb.command(scene, [TENSION])
    angles["wire"] = float(jb.tip_angle(scene, path.x[-1]))
    print(f"  tip angle {angles['wire']:+.4f} degrees, wire {float(jb.tendon_lengths(pulled, path.x[-1])[0]):.4f} long")
    print("drawing wire.png ...", flush=True)
    figure = Figure(figsize=(5, 3), layout="constrained")
    plot.beam(pulled, path.x[-1], ax=figure.add_subplot()).legend(loc="lower left", frameon=False)
    figure.savefig(out / "wire.png", dpi=200)
    print(f"pictures are in {out}")
    return angles


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/own_energy"), help="folder for the pictures")
    main(parser.parse_args().out)
