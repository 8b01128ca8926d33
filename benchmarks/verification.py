"""Is jaxbeam right? Published values, closed forms, other packages and a manufactured solution.

    python -m benchmarks.verification [ITEM ...]

Prints one table for each item, with the reference value, ours, the error and the source. Nothing is timed.

- `cook`: Cook's membrane of compressible neo-Hookean rubber, against the table of a deal.II program.
- `elastica`: a slender cantilever under a transverse dead load at its tip, against Mattiasson's elliptic integrals.
- `circle`: a slender strip that a moment bends to a full circle.
- `euler`: the axial load at which a slender column loses its stability.
- `packages`: the reference scene solved by scikit-fem and by FElupe, and by us, on the same meshes.
- `orders`: how fast the error of a manufactured solution falls as the mesh is refined.

Lengths of the slender beams are in units of their height; what separates them from beam theory, shear and finite
strain, falls as its square over the length, and the tables show that. `tests/project/test_verification.py` asserts the
figures that take seconds. scikit-fem and FElupe are installed by `pip install -e '.[bench]'`; without them `packages`
says so.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

import jaxbeam as jb
from benchmarks.report import options, table, version
from jaxbeam.mesh.elements import element_of

# --------------------------------------------------------------------------------- what several items need


def end_nodes(mesh: jb.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The nodes of the left end and those of the right end, each from below."""
    x, y = np.asarray(mesh.nodes).T
    near = 1e-9 * np.ptp(x)
    ends = (np.flatnonzero(np.abs(x - at) < near) for at in (x.min(), x.max()))
    left, right = (end[np.argsort(y[end])] for end in ends)
    return left, right


def edge_shares(count: int, order: int) -> np.ndarray:
    """Shares of a uniform traction on the `count` nodes along a straight, evenly divided edge: they add up to 1.

    The integrals of the shape functions: 1/2, 1/2 on each edge of a triangle of three nodes, 1/6, 4/6, 1/6 of six.
    """
    shares = np.ones(count) if order == 1 else np.where(np.arange(count) % 2, 4.0, 2.0)
    shares[[0, -1]] /= 2
    return shares / shares.sum()


def title(*lines: str) -> None:
    """Print what a table shows and where its reference values come from."""
    print(*lines, sep="\n", flush=True)


# ------------------------------------------------------------------------------------------ Cook's membrane

# J-P. V. Pelteret and A. McBride, "The deal.II code gallery: Quasi-Static Finite-Strain Compressible Elasticity", 2016,
# doi:10.5281/zenodo.1228964: material, dead traction and the table of the README. Its rows are elements per edge, here
# of quadratic quadrilaterals, Q2; the point is the middle of the loaded edge. The README's first versions have another
# table, which ends at 14.33: that is the corner (48, 60), with the faces free in z (ours in plane stress: 14.32).
COOK_TABLE = {2: 14.30, 4: 14.65, 8: 14.71, 16: 14.73, 32: 14.74, 64: 14.74}
COOK_LIMIT = COOK_TABLE[64]
COOK_MU, COOK_POISSON = 0.4225, 0.3
COOK_KAPPA = 2 * COOK_MU * (1 + COOK_POISSON) / (3 * (1 - 2 * COOK_POISSON))


def cook_density(H: jax.Array, params: dict[str, jax.Array]) -> jax.Array:
    """`mu/2 (tr b_bar - 3) + kappa/4 (J^2 - 1 - 2 ln J)`, with `b_bar = J^(-2/3) b` of three dimensions.

    In plane strain `tr b = |F|^2 + 1`. It loses the digits of small strains, which do not matter here.
    """
    volume = H[0, 0] + H[1, 1] + H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0]
    trace = 3 + 2 * (H[0, 0] + H[1, 1]) + jnp.sum(H * H)
    isochoric = 0.5 * params["mu"] * ((1 + volume) ** (-2 / 3) * trace - 3)
    return isochoric + 0.25 * params["kappa"] * (volume * (2 + volume) - 2 * jnp.log1p(volume))


def cook_deflection(cells: int, order: int) -> float:
    """Vertical displacement of the middle of the right edge, (48, 52), on a mesh of `cells` x `cells` cells."""
    square = jb.rectangle(1.0, 1.0, cells + 1, cells + 1, order=order)
    s, t = np.asarray(square.nodes).T + 0.5
    low, high = 44 * s, 44 + 16 * s
    mesh = jb.Mesh(np.stack([48 * s, low + t * (high - low)], axis=1), square.elements)
    left, right = end_nodes(mesh)
    load = jb.dead_load(mesh, right, np.outer(edge_shares(right.size, order), [0.0, 1.0]))
    body = jb.solid(mesh, {"mu": COOK_MU, "kappa": COOK_KAPPA}, cook_density)
    scene = jb.Scene(mesh, (body, load), jb.clamped(mesh, left), right)
    found = jb.check(jb.equilibrium(scene))
    middle = right[right.size // 2]
    return float(found.x[middle, 1] - mesh.nodes[middle, 1])


def cook() -> None:
    """Print the table of Cook's membrane."""
    title(
        "Cook's membrane: vertical displacement of (48, 52)",
        "source: Pelteret and McBride 2016, doi:10.5281/zenodo.1228964, whose elements are quadratic quadrilaterals",
    )
    rows = []
    for cells, published in COOK_TABLE.items():
        ours = {order: cook_deflection(cells, order) for order in (1, 2)}
        errors = (f"{value / COOK_LIMIT - 1:+.2%}" for value in ours.values())
        rows.append((cells, f"{published:.2f}", *(f"{value:.4f}" for value in ours.values()), *errors, COOK_LIMIT))
    header = ("cells per edge", "deal.II Q2", "ours P1", "ours P2", "error P1", "error P2", "limit")
    table(header, rows)


# -------------------------------------------------------------------------------------------- slender beams

# Corners along and across every slender beam, of six-node triangles.
ALONG, ACROSS = 321, 3
# I is that of the unit height; Poisson's ratio is 0 unless stated.
YOUNG, INERTIA = 1.0, 1 / 12
# A straight column stays an equilibrium beyond its critical load: it is what is examined there.
STRAIGHT = jb.Newton(escape=False)


def beam_mesh(length: float, along: int = ALONG) -> jb.Mesh:
    """A beam of unit height."""
    return jb.rectangle(length, 1.0, along, ACROSS, order=2)


def beam(mesh: jb.Mesh, load: jb.Term, poisson: float = 0.0) -> jb.Scene:
    """The beam clamped at its left end, under one load.

    All of the end is held along the beam, and its middle across: free to widen, as beam theory has it. Held across too,
    a beam of Poisson's ratio 0.3 is stiffer by some hundredths of H / L.
    """
    left, right = end_nodes(mesh)
    fixed = np.zeros(mesh.nodes.shape, bool)
    fixed[left, 0] = fixed[left[left.size // 2], 1] = True
    return jb.Scene(mesh, (jb.solid(mesh, jb.lame(YOUNG, poisson), jb.neo_hookean), load), fixed, right)


def tip_loaded(length: float, force: tuple[float, float], poisson: float = 0.0, along: int = ALONG) -> jb.Scene:
    """A cantilever under a dead force, spread evenly over its end section."""
    mesh = beam_mesh(length, along)
    _, right = end_nodes(mesh)
    return beam(mesh, jb.dead_load(mesh, right, np.outer(edge_shares(right.size, 2), force)), poisson)


def tip_centre(scene: jb.Scene, x: jax.Array) -> np.ndarray:
    """Displacement `(2,)` of the middle of the end section."""
    middle = scene.tip[scene.tip.size // 2]
    return np.asarray(x[middle] - scene.mesh.nodes[middle])


# K. Mattiasson, "Numerical results from large deflection beam and frame problems analysed by means of elliptic
# integrals", Int. J. Numer. Methods Eng. 17 (1981), 145-153: P L^2 / (E I), and how far the tip moves across, w / L,
# and along, u / L.
MATTIASSON = {1: (0.30172, 0.05643), 2: (0.49346, 0.16064), 5: (0.71379, 0.38763), 10: (0.81061, 0.55500)}


def elastica_deflection(load: float) -> tuple[float, float]:
    """`w / L` and `u / L` of an inextensible rod, by shooting: the table above with more digits.

    With the arc length `s` from the clamp over `L`, `theta'' = -load cos theta`, `theta(0) = 0`, `theta'(1) = 0`.
    """

    def from_tip(angle: float) -> np.ndarray:
        slope = lambda s, y: [y[1], -load * np.cos(y[0]), np.sin(y[0]), np.cos(y[0])]
        return solve_ivp(slope, (1, 0), [angle, 0, 0, 0], rtol=1e-12, atol=1e-13).y[:, -1]

    end = from_tip(brentq(lambda angle: from_tip(angle)[0], 1e-3, np.pi / 2 - 1e-3, xtol=1e-14))
    return -end[2], 1 + end[3]


def cantilever_deflection(load: float, length: float, poisson: float = 0.0, along: int = ALONG) -> tuple[float, float]:
    """`w / L` and `u / L` of the solid beam at `load = P L^2 / (E' I)`, `E' = E / (1 - poisson^2)`."""
    force = load * YOUNG / (1 - poisson**2) * INERTIA / length**2
    scene = tip_loaded(length, (0.0, force), poisson, along)
    across = tip_centre(scene, jb.check(jb.equilibrium(scene, solver=STRAIGHT)).x) / length
    return float(across[1]), float(-across[0])


def elastica() -> None:
    """Print the table of the tip-loaded cantilever."""
    title(
        "Slender cantilever under a dead load P at its tip: deflections over the length",
        "source: K. Mattiasson, Int. J. Numer. Methods Eng. 17 (1981), 145-153, without extension and shear; errors",
        "relative to the same solution with more digits; shear, extension and finite strain are of the size of (H/L)^2",
    )
    rows = []
    for load, published in MATTIASSON.items():
        exact = elastica_deflection(load)
        for length, poisson in ((25.0, 0.0), (50.0, 0.0), (100.0, 0.0), (100.0, 0.3)):
            ours = cantilever_deflection(load, length, poisson)
            errors = [a / b - 1 for a, b in zip(ours, exact, strict=True)]
            pairs = [(f"{p:.5f}", f"{o:.5f}", f"{e:+.1e}") for p, o, e in zip(published, ours, errors, strict=True)]
            rows.append((load, length, poisson, *pairs[0], *pairs[1], f"{length**-2:.1e}"))
    header = ("P L^2/(E'I)", "L/H", "nu", "w/L", "ours", "error", "u/L", "ours", "error", "(H/L)^2")
    table(header, rows)


def moment_energy(x: jax.Array, params: dict[str, jax.Array]) -> jax.Array:
    """`-M theta` of one end section: a moment that turns with it, and is conservative in the plane.

    The forces are distributed over the section as the stress of bending is: with `arms` the height of each node times
    its share, `sum(arms x)` is a line across the section, and `theta` its rotation. It is measured about a rotation
    `about` that it has nearly reached, so that it may grow past pi: only there does the energy jump.
    """
    line = jnp.sum(params["arms"][:, None] * x, axis=0)
    cosine, sine = jnp.cos(params["about"]), jnp.sin(params["about"])
    more = jnp.arctan2(-cosine * line[0] - sine * line[1], cosine * line[1] - sine * line[0])
    return -params["moment"] * (params["about"] + more)


def rolled_up(length: float, degrees: float, steps: int, along: int = ALONG) -> tuple[float, np.ndarray, float]:
    """Rotation of the end section and displacement `(2,)` of its centre, over the length, under the moment `M` of
    which beam theory says that it turns it by `degrees`; and `M L / (E I)`. Loaded in even steps."""
    mesh = beam_mesh(length, along)
    _, right = end_nodes(mesh)
    arms = edge_shares(right.size, 2) * np.asarray(mesh.nodes)[right, 1]
    turn, x = 0.0, None
    for angle in np.radians(degrees) * np.arange(1, steps + 1) / steps:
        moment = angle * YOUNG * INERTIA / length
        params = {"moment": np.array([moment]), "about": np.array([turn]), "arms": arms[None]}
        scene = beam(mesh, jb.Term(moment_energy, right[None], params))
        found = jb.equilibrium(scene, x, STRAIGHT)
        # At a full circle the free end lies in the clamp: theory has no contact either.
        assert not int(found.status) & ~jb.Status.OVERLAPPING
        x = found.x
        turn = -float(moment_energy(x[right], jax.tree.map(lambda leaf: leaf[0], params))) / moment
    return turn, tip_centre(scene, x) / length, float(angle)


def bending_rotation(reduced: float, length: float) -> float:
    """Rotation under the moment `reduced = M L / (E I)` with the first term that finite strain adds.

    Bent to a circle, the energy of a unit of length is the least of `integral psi(kappa r) + psi(r')` over the radii
    `r(Y)` of the fibres, `psi(stretch) = E/4 (stretch^2 - 1 - 2 ln stretch)` for the neo-Hookean density at Poisson's
    ratio 0. To fourth order in `kappa H` that is `E I kappa^2 / 2 (1 - (kappa H)^2 / 12)`, so that
    `M = E I kappa (1 - (kappa H)^2 / 6)`.
    """
    return brentq(lambda turn: turn * (1 - (turn / length) ** 2 / 6) - reduced, reduced, 1.1 * reduced, xtol=1e-14)


def circle() -> None:
    """Print the table of the strip under a moment."""
    title(
        "Slender strip under a moment M at its end, from rest to a full circle: rotation of the end section",
        "source: beam theory, kappa = M / (E I), any textbook. `finite strain`: M = E I kappa (1 - (kappa H)^2 / 6) of",
        "this material, worked out in `bending_rotation`. `apart`: how far the tip is from its place in theory, over L",
    )
    rows = []
    for degrees in (90.0, 180.0, 360.0):
        for length in (25.0, 50.0, 100.0):
            turn, moved, reduced = rolled_up(length, degrees, round(degrees / 45))
            finer = bending_rotation(reduced, length)
            end = np.array([np.sin(reduced) / reduced - 1, (1 - np.cos(reduced)) / reduced])
            error, rest, apart = turn / reduced - 1, turn / finer - 1, np.linalg.norm(moved - end)
            found = (f"{np.degrees(turn):.4f}", f"{error:+.1e}", f"{error * length**2:+.2f}")
            rows.append((length, degrees, *found, f"{np.degrees(finer):.4f}", f"{rest:+.1e}", f"{apart:.1e}"))
    header = ("L/H", "theory (deg)", "ours", "error", "error (L/H)^2", "finite strain", "error", "apart")
    table(header, rows)


def euler_load(length: float) -> float:
    """Euler's critical load of a cantilever, `pi^2 E I / (4 L^2)`."""
    return np.pi**2 * YOUNG * INERTIA / (4 * length**2)


def critical_load(length: float, along: int = ALONG) -> float:
    """The axial dead load, over Euler's, at which the lowest eigenvalue of the tangent stiffness is zero."""

    def lowest(load: float) -> float:
        scene = tip_loaded(length, (-load * euler_load(length), 0.0), along=along)
        found = jb.equilibrium(scene, solver=STRAIGHT)
        # Near the critical load, and beyond it, these two are what is looked for.
        assert not int(found.status) & ~(jb.Status.UNSTABLE | jb.Status.INACCURATE)
        return float(jb.lowest_mode(scene, found.x).values[0])

    return float(brentq(lowest, 0.9, 1.1, xtol=1e-12))


def euler() -> None:
    """Print the table of Euler's column."""
    title(
        "Axial load at which a slender cantilever loses its stability, over Euler's pi^2 E I / (4 L^2)",
        "source: L. Euler, De curvis elasticis, 1744; Timoshenko and Gere, Theory of Elastic Stability, 1961, ch. 2",
    )
    rows = []
    for length in (5.0, 10.0, 20.0, 40.0):
        error = critical_load(length) - 1
        rows.append((length, f"{euler_load(length):.6e}", f"{1 + error:.7f}", f"{error:+.1e}", error * length**2))
    table(("L/H", "Euler", "ours / Euler", "error", "error (L/H)^2"), rows)


# ------------------------------------------------------------------------------------------- other packages

# Internal forces `(n, 2)` and stiffness `(2n, 2n)` at displacements `(n, 2)`, all in our numbering of the nodes.
Assemble = Callable[[np.ndarray], tuple[np.ndarray, csr_array]]
# The reference scene: mesh, what is fixed and where the tendons end are data; the rest is written anew below.
PEER_YOUNG, PEER_POISSON, TENDON_MODULUS = 1e4, 0.45, 2e3
PEER_MU = PEER_YOUNG / (2 * (1 + PEER_POISSON))
PEER_LAM = PEER_YOUNG * PEER_POISSON / ((1 + PEER_POISSON) * (1 - 2 * PEER_POISSON))
PEER_RATIOS = ((0.8, 1.0), (0.4, 1.0))
# Forces are about 1e3. Steps from rest to a command, so that plain Newton's method gets there.
PEER_BALANCE, PEER_STEPS = 1e-9, 28


def cofactor(F: np.ndarray) -> np.ndarray:
    """`d det F / dF` of `(2, 2, ...)`."""
    return np.stack([np.stack([F[1, 1], -F[1, 0]]), np.stack([-F[0, 1], F[0, 0]])])


def peer_stress(F: np.ndarray) -> np.ndarray:
    """`dpsi / dF` of `psi = mu/2 (|F|^2 - 2) - mu (J - 1) + lam/2 (J - 1)^2`, by hand; `F` is `(2, 2, ...)`."""
    J = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
    return PEER_MU * F + (PEER_LAM * (J - 1) - PEER_MU) * cofactor(F)


def peer_tangent(F: np.ndarray) -> np.ndarray:
    """`d^2 psi / dF^2`, `(2, 2, 2, 2, ...)`, by hand. The cofactor is linear in `F`."""
    J, one = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0], np.ones(F.shape[2:])
    turned = np.array([[0.0, 1.0], [-1.0, 0.0]])
    isotropic = np.einsum("ik,jl,...->ijkl...", np.eye(2), np.eye(2), PEER_MU * one)
    geometric = np.einsum("ik,jl,...->ijkl...", turned, turned, PEER_LAM * (J - 1) - PEER_MU)
    return isotropic + geometric + PEER_LAM * np.einsum("ij...,kl...->ijkl...", cofactor(F), cofactor(F))


def by_scikit_fem(nodes: np.ndarray, elements: np.ndarray) -> Assemble:
    """Assembly by scikit-fem, of triangles of three or six nodes with straight edges."""
    from skfem import Basis, BilinearForm, ElementTriP1, ElementTriP2, ElementVector, LinearForm, MeshTri
    from skfem.helpers import ddot, grad

    corners = elements[:, :3]
    element = ElementVector(ElementTriP1() if elements.shape[1] == 3 else ElementTriP2())
    # Constant strain needs one point; on six-node triangles this is the rule of three points, as ours.
    basis = Basis(MeshTri(nodes[: corners.max() + 1].T, corners.T), element, intorder=2)
    dofs = np.zeros(nodes.shape, int)
    for component in range(2):
        found = np.concatenate([basis.nodal_dofs[component], *basis.facet_dofs[component : component + 1]])
        distance, node = cKDTree(nodes).query(basis.doflocs[:, found].T)
        assert distance.max() < 1e-9 and np.unique(node).size == len(nodes)
        dofs[node, component] = found
    order = dofs.ravel()
    gradient = lambda w: np.eye(2)[:, :, None, None] + grad(w["u"])
    pull = LinearForm(lambda v, w: ddot(peer_stress(gradient(w)), grad(v)))
    stiffen = BilinearForm(
        lambda du, v, w: np.einsum("ij...,ijkl...,kl...->...", grad(v), peer_tangent(gradient(w)), grad(du))
    )

    def assemble(u: np.ndarray) -> tuple[np.ndarray, csr_array]:
        values = np.zeros(basis.N)
        values[order] = u.ravel()
        field = basis.interpolate(values)
        stiffness = csr_array(stiffen.assemble(basis, u=field))
        return pull.assemble(basis, u=field)[order].reshape(u.shape), stiffness[order][:, order]

    return assemble


def by_felupe(nodes: np.ndarray, elements: np.ndarray) -> Assemble:
    """Assembly by FElupe, of triangles of three nodes.

    Not of six: the gradient of the last shape function of FElupe 11.3.0's `QuadraticTriangle` is wrong, `t1 - t2` in
    place of `t1 - t3`. With it the beam of 15 x 5 corners at (0.8, 1.0) has a tip angle of 9.078 degrees, where
    ours, scikit-fem's and FElupe's with that term put right are 9.770; at (0.4, 1.0) it finds no balance.
    """
    import felupe

    mesh = felupe.Mesh(nodes, elements, "triangle")
    field = felupe.FieldContainer([felupe.FieldPlaneStrain(felupe.RegionTriangle(mesh), dim=2)])

    def stress(x: list[Any]) -> list[Any]:
        P = np.zeros_like(x[0])
        P[:2, :2] = peer_stress(x[0][:2, :2])
        return [P, x[-1]]

    def elasticity(x: list[Any]) -> list[Any]:
        A = np.zeros((3, 3, *x[0].shape))
        A[:2, :2, :2, :2] = peer_tangent(x[0][:2, :2])
        return [A]

    body = felupe.SolidBody(felupe.Material(stress, elasticity), field)

    def assemble(u: np.ndarray) -> tuple[np.ndarray, csr_array]:
        field[0].values[:] = u
        forces = np.asarray(body.assemble.vector(field).todense()).reshape(u.shape)
        return forces, csr_array(body.assemble.matrix(field))

    return assemble


def add_tendons(
    x: np.ndarray, ends: np.ndarray, commanded: np.ndarray, forces: np.ndarray, stiffness: csr_array
) -> tuple[np.ndarray, csr_array]:
    """Forces and stiffness with those of springs of stiffness `modulus / commanded^2` added."""
    forces, entries = forces.copy(), []
    for (a, b), rest in zip(ends, commanded, strict=True):
        k, line = TENDON_MODULUS / rest**2, x[b] - x[a]
        length = np.linalg.norm(line)
        along = line / length
        forces[b] += k * (length - rest) * along
        forces[a] -= k * (length - rest) * along
        block = k * np.outer(along, along) + k * (1 - rest / length) * (np.eye(2) - np.outer(along, along))
        entries += [(p, q, sign * block) for p, q, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1))]
    rows = np.concatenate([np.repeat(2 * p + np.arange(2), 2) for p, _, _ in entries])
    columns = np.concatenate([np.tile(2 * q + np.arange(2), 2) for _, q, _ in entries])
    values = np.concatenate([block.ravel() for _, _, block in entries])
    return forces, stiffness + csr_array(coo_array((values, (rows, columns)), shape=stiffness.shape))


def peer_positions(scene: jb.Scene, assemble: Assemble, ratios: tuple[float, float]) -> np.ndarray:
    """Node positions `(n, 2)` of the scene pulled in steps from rest, by plain Newton's method with SciPy."""
    nodes, ends = np.asarray(scene.mesh.nodes), scene.terms[1].nodes
    natural = np.linalg.norm(nodes[ends[:, 1]] - nodes[ends[:, 0]], axis=1)
    free = np.flatnonzero(~scene.fixed.ravel())
    u = np.zeros_like(nodes)
    for part in np.arange(1, PEER_STEPS + 1) / PEER_STEPS:
        commanded = natural * (1 + part * (np.array(ratios) - 1))
        for _ in range(30):
            forces, stiffness = add_tendons(nodes + u, ends, commanded, *assemble(u))
            if np.abs(forces.ravel()[free]).max() < PEER_BALANCE:
                break
            u.ravel()[free] -= spsolve(stiffness[free][:, free], forces.ravel()[free])
        else:
            raise RuntimeError(f"no balance of the peer at {part:.3f} of the way to {ratios}")
    return nodes + u


def compare_packages(assemble_by: Callable[..., Assemble], order: int, ratios: tuple[float, float]) -> dict[str, Any]:
    """A peer's tip angle (degrees) and ours, largest distance of the nodes and difference of the tendons' lengths over
    the beam's length; of P1 on 29 x 7 corners or P2 on 15 x 5.

    Ours is pulled in steps too: at (0.4, 1.0) six-node triangles have a second stable state, of 34.21 degrees, higher
    in energy, where `equilibrium` ends that goes there in one call.
    """
    scene = jb.tendon_beam(29, 7) if order == 1 else jb.tendon_beam(15, 5, order=2)
    nodes = np.asarray(scene.mesh.nodes)
    theirs = jnp.asarray(peer_positions(scene, assemble_by(nodes, scene.mesh.elements), ratios))
    ours = jb.check(jb.ramp(scene, ratios, PEER_STEPS)).x[-1]
    measure = lambda of: [np.asarray(of(scene, x)) for x in (theirs, ours)]
    lengths, span = measure(jb.tendon_lengths), np.ptp(nodes[:, 0])
    return {
        "corners": "29 x 7" if order == 1 else "15 x 5",
        "angles": [float(angle) for angle in measure(jb.tip_angle)],
        "apart": float(np.linalg.norm(theirs - ours, axis=1).max() / span),
        "lengths": float(np.abs(lengths[0] - lengths[1]).max() / span),
    }


def packages() -> None:
    """Print the comparison with other packages."""
    title(
        "The reference scene by other packages on the same meshes; distances over the beam's length",
        "source: Gustafsson and McBain, J. Open Source Softw. 5 (2020), 2369 (scikit-fem); A. Dutzler, FElupe,",
        "doi:10.5281/zenodo.4817406; density, tendons and Newton's method are written anew",
    )
    rows = []
    for name, module, assemble_by, orders in (
        ("scikit-fem", "skfem", by_scikit_fem, (1, 2)),
        ("felupe", "felupe", by_felupe, (1,)),
    ):
        if find_spec(module) is None:
            print(f"{name} is not installed: pip install -e '.[bench]'")
            continue
        for order in orders:
            for ratios in PEER_RATIOS:
                found = compare_packages(assemble_by, order, ratios)
                theirs, ours = found["angles"]
                where = (f"{name} {version(name)}", f"P{order}", found["corners"], str(ratios))
                difference = (f"{ours - theirs:+.1e}", f"{found['apart']:.1e}", f"{found['lengths']:.1e}")
                rows.append((*where, f"{theirs:.8f}", f"{ours:.8f}", *difference))
    header = ("package", "element", "corners", "ratios", "tip angle", "ours", "difference", "nodes", "lengths")
    table(header, rows)


# ----------------------------------------------------------------------------------- a manufactured solution

# P. J. Roache, "Code verification by the method of manufactured solutions", J. Fluids Eng. 124 (2002), 4-10; the orders
# are those of linear elliptic problems, Strang and Fix, "An Analysis of the Finite Element Method", 1973, section 3.2.
AMPLITUDE = (0.05, 0.08)
MMS_MATERIAL = jb.lame(1.0, 0.3)
# Twice the degree of the shape functions is what the errors need, and the forces of the manufactured solution.
FINE = 5
ORDERS = {1: (2, 1), 2: (3, 2)}
MMS_CELLS = {1: (4, 8, 16, 32, 64), 2: (4, 8, 16, 32)}


def exact_displacement(X: jax.Array) -> jax.Array:
    """The displacement `(2,)` that is asked for at `X` `(2,)`; zero on the edges of the unit square about 0."""
    return jnp.asarray(AMPLITUDE, X.dtype) * jnp.cos(jnp.pi * X[0]) * jnp.cos(jnp.pi * X[1])


def body_force(X: jax.Array) -> jax.Array:
    """`-div P` `(2,)` of that displacement: what keeps it in balance."""
    material = jb.Lame(jnp.asarray(MMS_MATERIAL.mu, X.dtype), jnp.asarray(MMS_MATERIAL.lam, X.dtype))
    stress = lambda Y: jax.grad(jb.neo_hookean)(jax.jacfwd(exact_displacement)(Y), material)
    return -jnp.einsum("ijj->i", jax.jacfwd(stress)(X))


@jax.jit
def exact_fields(X: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Displacement `(..., 2)`, its gradient `(..., 2, 2)` and the body force `(..., 2)` at `X` `(t, q, 2)`."""
    each = lambda of: jax.vmap(jax.vmap(of))(X)
    return each(exact_displacement), each(jax.jacfwd(exact_displacement)), each(body_force)


def manufactured_errors(cells: int, order: int, solver: jb.Newton = jb.Newton()) -> tuple[float, float]:
    """Errors in the L2 norm and in the H1 seminorm, over the norms of the solution, on `cells` x `cells` cells."""
    mesh = jb.rectangle(1.0, 1.0, cells + 1, cells + 1, order=order)
    nodes, elements = np.asarray(mesh.nodes), mesh.elements
    fine = jb.solid(mesh, MMS_MATERIAL, degree=FINE).params
    weights, gradients = np.asarray(fine.weights), np.asarray(fine.gradients)
    element = element_of(elements)
    values = element.shape(element.rule(FINE)[0])
    at_points = lambda field: np.einsum("qk,tkd->tqd", values, field[elements])
    u, slope, force = (np.asarray(field) for field in exact_fields(jnp.asarray(at_points(nodes))))
    loads = np.zeros_like(nodes)
    np.add.at(loads, elements, np.einsum("tq,qk,tqd->tkd", weights, values, force))

    body = jb.solid(mesh, MMS_MATERIAL, jb.neo_hookean, degree=1 if order == 1 else 4)
    edge = np.flatnonzero(np.abs(nodes).max(axis=1) > 0.5 - 1e-9)
    scene = jb.Scene(mesh, (body, jb.dead_load(mesh, np.arange(len(nodes)), loads)), jb.clamped(mesh, edge))
    found = np.asarray(jb.check(jb.equilibrium(scene, solver=solver)).x) - nodes
    norm = lambda field: np.sqrt(np.sum(weights * np.sum(field**2, axis=tuple(range(2, field.ndim)))))
    slope_found = np.einsum("tki,tqkj->tqij", found[elements], gradients)
    return float(norm(at_points(found) - u) / norm(u)), float(norm(slope_found - slope) / norm(slope))


def orders() -> None:
    """Print the errors of the manufactured solution and their orders."""
    title(
        "Manufactured solution, neo-Hookean, unit square: relative errors and their orders between meshes",
        "source: Roache, J. Fluids Eng. 124 (2002), 4-10; orders: Strang and Fix 1973, section 3.2",
    )
    rows = []
    for order, cells in MMS_CELLS.items():
        errors = np.array([manufactured_errors(count, order) for count in cells])
        observed = np.log2(errors[:-1] / errors[1:])
        for k, (count, pair) in enumerate(zip(cells, errors, strict=True)):
            seen = [f"{value:.3f}" for value in observed[k - 1]] if k else [None, None]
            names = [f"{value:.3e}" for value in pair]
            rows.append((f"P{order}", count, names[0], seen[0], ORDERS[order][0], names[1], seen[1], ORDERS[order][1]))
    header = ("element", "cells per edge", "L2 error", "order", "expected", "H1 error", "order", "expected")
    table(header, rows)


ITEMS = {item.__name__: item for item in (cook, elastica, circle, euler, packages, orders)}


def main() -> None:
    """Print the tables of the items named, or of all."""
    parser = options(__doc__)
    parser.add_argument("items", nargs="*", metavar="ITEM", help=f"of {', '.join(ITEMS)}; by default all")
    names = parser.parse_args().items
    unknown = sorted(set(names) - set(ITEMS))
    if unknown:
        parser.error(f"no item is called {', '.join(unknown)}; there are {', '.join(ITEMS)}")
    for name in names or ITEMS:
        ITEMS[name]()


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
