"""A cantilever under a tip load beside FElupe: Newton steps and time of one load step on four meshes.

    python -m benchmarks.peers [--repeats 5]

The beam, 3.5 x 0.8, is clamped at its left edge. A traction on the right edge lowers the tip by about 1.0. Both solve
the same mesh, with the same quadrature and the same compressible neo-Hookean material in plane strain,
`mu/2 (|F|^2 - 2) - mu ln J + lambda/2 (ln J)^2`, from rest in one load step, on one thread, in turn in one process.
FElupe's Newton takes full steps, with SciPy's SuperLU. What is timed is the solve: its mesh, regions and items are
built before. jaxbeam's compile time is in its first call, which is told apart. The benchmark fails if the deflections
of the tip differ by more than 1e-6 of themselves.
"""

from __future__ import annotations

import benchmarks.one_thread  # isort: skip # noqa: F401

import sys
from collections.abc import Callable
from functools import partial

import jax
import numpy as np

import jaxbeam as jb
from benchmarks import report
from benchmarks.timing import in_turn

LENGTH, HEIGHT, YOUNG, POISSON = 3.5, 0.8, 1e4, 0.45
# Corners along and across, order of the triangles, and the force that lowers the tip by about 1.0.
MESHES = ((29, 7, 1, 47.5), (29, 7, 2, 39.3), (57, 13, 2, 39.2), (113, 25, 2, 39.2))
# Relative difference of the deflections, which both solve for to far more digits.
AGREEMENT = 1e-6


def tip_load(nx: int, ny: int, order: int, force: float) -> jb.Scene:
    """The cantilever under a total force downwards on its right edge."""
    mesh = jb.rectangle(LENGTH, HEIGHT, nx, ny, order=order)
    x = np.asarray(mesh.nodes)[:, 0]
    left, right = (np.flatnonzero(np.isclose(x, side * LENGTH / 2)) for side in (-1, 1))
    solid = jb.solid(mesh, jb.lame(YOUNG, POISSON), jb.neo_hookean)
    load = jb.traction(mesh, right, [0.0, -force / HEIGHT])
    return jb.Scene(mesh, (solid, load), jb.clamped(mesh, left), right)


def deflection(scene: jb.Scene, x: np.ndarray) -> float:
    """How far the tip has sunk, the mean over the right edge."""
    return -float(np.mean((np.asarray(x) - np.asarray(scene.mesh.nodes))[scene.tip, 1]))


def by_felupe(scene: jb.Scene) -> Callable[[], tuple[np.ndarray, int]]:
    """A function that solves the scene by FElupe: positions, and the number of Newton steps."""
    try:
        import felupe
    except ImportError:
        raise SystemExit("benchmarks.peers: FElupe is missing; pip install -e '.[bench]'") from None
    nodes, elements = np.asarray(scene.mesh.nodes), np.asarray(scene.mesh.elements)
    if elements.shape[1] == 3:
        region = felupe.RegionTriangle(felupe.Mesh(nodes, elements, "triangle"))
    else:
        # Its own gradient of the last shape function is wrong in 11.3.0: `4 (t1 - t2)` stands for `4 (t1 - t3)`.
        class Triangle(felupe.QuadraticTriangle):
            def gradient(self, rs: np.ndarray) -> np.ndarray:
                r, s = rs
                return super().gradient(rs) + np.array([[0, w * (r - s)] for w in (-2, 0, -2, 0, 0, 4)])

        mesh, rule = felupe.Mesh(nodes, elements, "triangle6"), felupe.TriangleQuadrature(order=2)
        region = felupe.Region(mesh, Triangle(), rule)
    field = felupe.FieldContainer([felupe.FieldPlaneStrain(region, dim=2)])
    mu, lam = YOUNG / (2 * (1 + POISSON)), YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    body = felupe.SolidBody(felupe.NeoHookeCompressible(mu, lam), field)
    # At rest the traction is all there is to the forces.
    forces = np.asarray(jb.forces(scene, nodes))
    loaded = np.flatnonzero(np.any(np.abs(forces) > 1e-9 * np.abs(forces).max(), axis=1))
    load = felupe.PointLoad(field, loaded, values=forces[loaded])
    held = {"clamp": felupe.Boundary(field[0], mask=np.asarray(scene.fixed).all(axis=1))}
    free_dof, fixed_dof = felupe.dof.partition(field, held)[::-1]
    there = felupe.dof.apply(field, held, fixed_dof)

    def solve() -> tuple[np.ndarray, int]:
        field[0].values[:] = 0
        found = felupe.newtonraphson(
            items=[body, load], dof0=fixed_dof, dof1=free_dof, ext0=there, tol=1e-9, verbose=False
        )
        return nodes + field[0].values, int(found.iterations)

    return solve


def compare(nx: int, ny: int, order: int, force: float, repeats: int) -> list[tuple]:
    """Rows of the table for one mesh.

    Raises:
        ValueError: if the deflections differ.
    """
    scene = tip_load(nx, ny, order, force)
    found: dict[str, tuple[float, int]] = {}

    def ours(solution: jb.Solution) -> None:
        jb.check(solution)
        found["jaxbeam"] = deflection(scene, solution.x), int(solution.steps)

    def theirs(result: tuple[np.ndarray, int]) -> None:
        found["FElupe"] = deflection(scene, result[0]), result[1]

    runs = [partial(jb.equilibrium, scene), by_felupe(scene)]
    times = dict(zip(("jaxbeam", "FElupe"), in_turn(*runs, repeats=repeats, checks=[ours, theirs]), strict=True))
    sunk = [value for value, _ in found.values()]
    if not np.ptp(sunk) <= AGREEMENT * sunk[0]:
        raise ValueError(f"{nx} x {ny}, order {order}: deflections of the tip {sunk} differ by more than {AGREEMENT:g}")
    mesh = f"{nx} x {ny}, {3 * order} nodes"
    return [
        (mesh, name, str(time), time.over(times["jaxbeam"]), found[name][1], f"{found[name][0]:.8f}")
        for name, time in times.items()
    ]


def main() -> None:
    """Print the table."""
    parser = report.options(__doc__)
    parser.add_argument("--repeats", type=int, default=5, help="timed calls of each")
    repeats = parser.parse_args().repeats
    report.head("A tip load beside FElupe")
    rows = [row for mesh in MESHES for row in compare(*mesh, repeats)]
    report.table(("mesh", "", "time (quartiles)", "over jaxbeam", "Newton steps", "deflection"), rows)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.exit(main())
