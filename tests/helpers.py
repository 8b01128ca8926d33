"""What several test files need: meshes, random scenes, finite differences, closed forms, independent assembly."""

from __future__ import annotations

import dataclasses
import io
import os
import subprocess
import sys
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import lambertw

import jaxbeam as jb
from jaxbeam.linear.blocks import Topology
from jaxbeam.mesh.line import Line
from jaxbeam.physics.rod import rod
from jaxbeam.physics.rod_tendon import rod_tendons
from tests.actions import Action, Cables, Pressure, Pulls, Support, Traction, Weight
from tests.energies import Problem
from tests.obstacles import Contact

EPS = np.finfo(np.float64).eps


class Terminal(io.StringIO):
    """Holds what is written to it, and passes for a terminal."""

    def isatty(self) -> bool:
        return True

    def lines(self) -> list[str]:
        """What stands in each line at last, without spaces at its end. A carriage return goes back to its beginning."""
        found = []
        for line in self.getvalue().split("\n"):
            seen = ""
            for part in line.split("\r"):
                seen = part + seen[len(part) :]
            found.append(seen.rstrip())
        return found


# ---------------------------------------------------------------------------------------------- meshes


def disturbed(mesh: jb.Mesh, size: float = 0.2, seed: int = 0) -> jb.Mesh:
    """The mesh with every node moved by up to `size` of the shortest edge: irregular but valid."""
    nodes = np.asarray(mesh.nodes)
    corners = nodes[mesh.elements]
    shortest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min()
    offset = np.random.default_rng(seed).uniform(-size, size, nodes.shape)
    return jb.Mesh(nodes + shortest * offset, mesh.elements)


def shuffled(mesh: jb.Mesh, seed: int = 0) -> tuple[jb.Mesh, np.ndarray]:
    """The mesh with its nodes numbered at random, and the new number of each old node."""
    order = np.random.default_rng(seed).permutation(mesh.nodes.shape[0])
    number = np.argsort(order)
    return jb.Mesh(np.asarray(mesh.nodes)[order], number[mesh.elements]), number


def l_shape() -> jb.Mesh:
    """A square of 6 x 6 nodes without its upper right quarter."""
    square = jb.rectangle(2.0, 2.0, 7, 7)
    centres = np.asarray(square.nodes)[square.elements].mean(axis=1)
    return part(square, ~((centres > 0).all(axis=1)))


def part(mesh: jb.Mesh, keep: np.ndarray) -> jb.Mesh:
    """The mesh of some of the elements, with unused nodes removed."""
    used, elements = np.unique(mesh.elements[keep], return_inverse=True)
    return jb.Mesh(np.asarray(mesh.nodes)[used], elements.reshape(-1, 3))


def annulus(around: int = 12, across: int = 3) -> jb.Mesh:
    """A closed ring: its breadth-first levels run both ways round and meet."""
    angle, radius = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.linspace(1.0, 2.0, across), indexing="ij")
    nodes = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=2).reshape(-1, 2)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(around), np.arange(across - 1), indexing="ij"))
    near, far = i * across + j, (i + 1) % around * across + j
    triangles = np.concatenate([np.stack([near, near + 1, far + 1], 1), np.stack([near, far + 1, far], 1)])
    return jb.Mesh(nodes, triangles)


def macneal_harder() -> jb.Mesh:
    """The irregular 8-node patch of MacNeal and Harder (1985), Finite Elem. Anal. Des. 1, fig. 1, in triangles.

    A rectangle 0.24 x 0.12 of five quadrilaterals, each split by a diagonal. Nodes 0 to 3 are inside.
    """
    nodes = [[0.04, 0.02], [0.18, 0.03], [0.16, 0.08], [0.08, 0.08], [0, 0], [0.24, 0], [0.24, 0.12], [0, 0.12]]
    quadrilaterals = [[0, 1, 2, 3], [4, 5, 1, 0], [5, 6, 2, 1], [6, 7, 3, 2], [7, 4, 0, 3]]
    triangles = [[q[i] for i in half] for q in quadrilaterals for half in ((0, 1, 2), (0, 2, 3))]
    return jb.Mesh(np.array(nodes), np.array(triangles))


# ---------------------------------------------------------------------------------------------- scenes

PAIR_NODES = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, -1.0]])


def spring_pair(ratio: float) -> jb.Scene:
    """Two springs in line, from (-1, 0) and (1, 0) to node 2 between them, at `ratio` of their length.

    The only free node is node 2. Across the line its stiffness is `2 k (1 - ratio)`: at a ratio above 1
    the midpoint is a saddle, and the stable states are at height `sqrt(ratio^2 - 1)` on either side.
    """
    mesh = jb.Mesh(PAIR_NODES, [[0, 3, 2], [3, 1, 2]])
    pair = jb.tendons(mesh, [[0, 2], [2, 1]], 3.0, jb.constant_stiffness)
    return jb.command(jb.Scene(mesh, (pair,), jb.clamped(mesh, [0, 1, 3])), [ratio, ratio])


# How often `counted` was traced. Compiled code does not run it again.
traces: Counter[str] = Counter()


def counted(H: jax.Array, params: jb.Lame) -> jax.Array:
    """The default material, counting its traces."""
    traces["density"] += 1
    return jb.macklin_mueller(H, params)


def small_beam(**kwargs) -> jb.Scene:
    """A beam of 5 x 3 nodes with a material that counts its traces: one shape for all that is not accuracy."""
    return jb.tendon_beam(5, 3, density=counted, **kwargs)


def slender_beam(nx: int) -> jb.Scene:
    """A slender beam with a tendon from end to end on either side, on a mesh that is symmetric about mid-height."""
    mesh = jb.rectangle(4.0, 0.3, nx, 3, diagonals="mirrored")
    ends = jb.nearest_node(mesh, [[(-2.0, y), (2.0, y)] for y in (0.15, -0.15)])
    left, right = (jb.nodes_where(mesh, lambda x, y, sign=sign: sign * x > 1.99) for sign in (-1, 1))
    terms = jb.solid(mesh, jb.lame(1e4, 0.3)), jb.tendons(mesh, ends, 2e3)
    return jb.Scene(mesh, terms, jb.clamped(mesh, left), right)


def supports(mesh: jb.Mesh, kind: str) -> np.ndarray:
    """`fixed` of a kind: left edge, both ends, a roller (one coordinate of some nodes) or one node only."""
    x = np.asarray(mesh.nodes)[:, 0]
    left, right = (np.abs(x - end) < 0.01 * np.ptp(x) for end in (x.min(), x.max()))
    fixed = np.zeros((x.size, 2), bool)
    if kind == "left":
        fixed[left] = True
    elif kind == "both ends":
        fixed[left | right] = True
    elif kind == "roller":
        fixed[left, 0] = True
        fixed[np.argmin(x), 1] = True
        fixed[right, 1] = True
    elif kind == "one node":
        fixed[x.size // 2] = True
    else:
        assert kind == "none"
    return fixed


def random_scene(mesh: jb.Mesh, lines: list[list[int]], kind: str = "left", seed: int = 0) -> jb.Scene:
    """A solid with random stiffness, tendons of random moduli along `lines`, and loads on random nodes."""
    rng = np.random.default_rng(seed)
    count = mesh.elements.shape[0]
    body = jb.solid(mesh, jb.lame(rng.uniform(1, 3, count), rng.uniform(0.2, 0.4, count)), jb.neo_hookean)
    loaded = rng.choice(mesh.nodes.shape[0], 3, replace=False)
    threads = [jb.tendons(mesh, [line], rng.uniform(1, 5), jb.inverse_stiffness) for line in lines]
    load = jb.dead_load(mesh, loaded, 0.01 * rng.normal(size=(3, 2)))
    return jb.Scene(mesh, (body, *threads, load), supports(mesh, kind))


LAWS = {
    "inverse-square": jb.inverse_square_stiffness,
    "inverse": jb.inverse_stiffness,
    "constant": jb.constant_stiffness,
}


def scene_of(raw: Problem, tip: np.ndarray | None = None) -> jb.Scene:
    """The library's scene of the judge's raw arrays, at natural lengths. By default its tip are the nodes farthest from
    the clamp, which are as far in any frame."""
    material, density = jb.lame(raw.young, raw.poisson), getattr(jb, raw.material)
    if raw.is_rod:
        mesh: jb.Mesh = Line(raw.nodes, raw.elements, raw.radian)
        body = rod(mesh, raw.height, material, density)
        pulls = [rod_tendons(mesh, t.lines, t.aside, t.modulus, LAWS[t.law]) for t in raw.tendons]
    else:
        mesh = jb.Mesh(raw.nodes, raw.elements)
        body = jb.solid(mesh, material, density)
        pulls = [jb.tendons(mesh, t.lines, t.modulus, LAWS[t.law], t.widths, t.shared) for t in raw.tendons]
    loaded = np.flatnonzero(np.zeros(len(raw.nodes)) if raw.load is None else raw.load.any(axis=1))
    loads = [jb.dead_load(mesh, loaded, raw.load[loaded])] if loaded.size else []
    if tip is None:
        away = np.linalg.norm((raw.rest - raw.rest[raw.fixed[:, 0]].mean(axis=0))[:, :2], axis=1)
        tip = np.flatnonzero(away > (1 - 1e-4) * away.max())
    return jb.Scene(mesh, (body, *pulls, *loads, *(term_of(mesh, action) for action in raw.actions)), raw.fixed, tip)


def term_of(mesh: jb.Mesh, action: Action) -> jb.Term:
    """The library's term of what acts on a body, under the commands at which it does nothing."""
    match action:
        case Cables():
            law = LAWS[action.law]
            return jb.cables(mesh, action.lines, action.modulus, law, action.widths, action.transition, action.shared)
        case Pulls():
            return jb.pulls(mesh, action.lines, width=action.widths, shared=action.shared)
        case Weight():
            return jb.weight(mesh, action.per_area)
        case Traction():
            return jb.traction(mesh, action.nodes, action.per_length)
        case Pressure():
            return jb.pressure(mesh, action.nodes)
        case Contact():
            shapes = {"half-plane": jb.half_plane, "disk": jb.disk, "box": lambda place, m: jb.box(place, m[:2], m[2])}
            obstacle = shapes[action.shape](action.place, action.more)
            return jb.contact(mesh, action.nodes, obstacle, action.stiffness, action.transition, action.direction)
        case Support():
            names = ("x", "y", "angle")[: action.motion.shape[1]]
            columns = zip(names, action.motion.T, strict=True)
            held = {name: column for name, column in columns if not np.isnan(column).any()}
            return jb.support(mesh, action.nodes, **held)
    raise TypeError(action)


# --------------------------------------------------------------------------- references made otherwise


def solution_of(scene: jb.Scene, ratios: np.ndarray, x: np.ndarray, status: np.ndarray) -> jb.Solution:
    """A solution made by hand, for what needs no equilibrium: of one state, or of many along a leading axis."""
    batch, dtype = np.shape(status), scene.mesh.nodes.dtype
    fields = {field.name: jnp.zeros(batch, dtype) for field in dataclasses.fields(jb.Solution)}
    for name in ("steps", "projected", "halvings", "attempts", "worst_element"):
        fields[name] = jnp.ones(batch, jnp.int32)
    fields |= {"crossing": jnp.full((*batch, 2, 2), -1, jnp.int32), "status": jnp.asarray(status, jnp.int32)}
    return jb.Solution(**fields | {"ratios": jnp.asarray(ratios, dtype), "x": jnp.asarray(x, dtype)})


def central_difference(f, x: np.ndarray, h: float) -> np.ndarray:
    """Derivative of `f` in every entry of `x` by central differences; the axes of `x` come last."""
    x = np.asarray(x)
    columns = []
    for k in range(x.size):
        step = np.zeros(x.size)
        step[k] = h
        step = step.reshape(x.shape)
        columns.append((np.asarray(f(x + step)) - np.asarray(f(x - step))) / (2 * h))
    return np.stack(columns, axis=-1).reshape(*np.shape(columns[0]), *x.shape)


def assembled(topology: Topology, hessians: list[np.ndarray]) -> np.ndarray:
    """Matrix over all coordinates of a sum of stencil matrices `(s, s, m)`, entry by entry in NumPy."""
    size = topology.fixed.array.size
    matrix = np.zeros((size, size))
    for stencil, hessian in zip(topology.stencils, hessians, strict=True):
        for nodes, block in zip(stencil.array, np.moveaxis(hessian, -1, 0), strict=True):
            places = (2 * nodes[:, None] + np.arange(2)).ravel()
            np.add.at(matrix, np.ix_(places, places), block)
    return matrix


def affine(mesh: jb.Mesh, F: np.ndarray, shift=(0.0, 0.0)) -> jax.Array:
    """Every node moved to `F X + shift`."""
    return jnp.asarray(np.asarray(mesh.nodes) @ np.asarray(F).T + np.asarray(shift))


def rotation(angle: float) -> np.ndarray:
    """Anticlockwise by `angle` in radians."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def mean_piola(scene: jb.Scene, x: jax.Array) -> np.ndarray:
    """Mean first Piola-Kirchhoff stress of a body from its nodal forces: `P = -sum f_k X_k^T / area`.

    The virial theorem (Bonet and Wood 2008, eq. 5.24, with div P = 0); exact where P is the same everywhere.
    """
    rest = np.asarray(scene.mesh.nodes)
    return -np.asarray(jb.forces(scene, x)).T @ rest / total_area(scene.mesh)


def areas(mesh: jb.Mesh) -> np.ndarray:
    """Signed area of each triangle."""
    a, b, c = np.moveaxis(np.asarray(mesh.nodes)[mesh.elements], 1, 0)
    return 0.5 * np.linalg.det(np.stack([b - a, c - a], axis=1))


def total_area(mesh: jb.Mesh) -> float:
    return float(areas(mesh).sum())


# Stress `P = d psi / d F` in closed form, worked by hand from each energy with `d J / d F = cof F`,
# `d ln J / d F = F^-T` (Bonet and Wood 2008, section 2.3; `S` there is eq. 6.28 for both of the first two).


def cofactor(F: np.ndarray) -> np.ndarray:
    return np.array([[F[1, 1], -F[1, 0]], [-F[0, 1], F[0, 0]]])


def piola_macklin_mueller(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    return mu * F + (lam * (np.linalg.det(F) - 1) - mu) * cofactor(F)


def piola_neo_hookean(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    return mu * F + (lam * np.log(np.linalg.det(F)) - mu) * np.linalg.inv(F).T


def piola_saint_venant_kirchhoff(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    green = 0.5 * (F.T @ F - np.eye(2))
    return F @ (lam * np.trace(green) * np.eye(2) + 2 * mu * green)


def piola_linear_elastic(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    strain = 0.5 * (F + F.T) - np.eye(2)
    return lam * np.trace(strain) * np.eye(2) + 2 * mu * strain


MATERIALS = {
    jb.macklin_mueller: piola_macklin_mueller,
    jb.neo_hookean: piola_neo_hookean,
    jb.saint_venant_kirchhoff: piola_saint_venant_kirchhoff,
    jb.linear_elastic: piola_linear_elastic,
}


def lateral_stretch(density, a: float, mu: float, lam: float) -> float:
    """`b` at which `F = diag(a, b)` in plane strain has no stress across (`P_22 = 0`), solved by hand.

    Macklin-Mueller: `mu b + (lam (a b - 1) - mu) a = 0` is linear in b.
    Neo-Hookean: `mu (b^2 - 1) + lam ln(a b) = 0`; with `u = b^2`, `c = lam / (2 mu)` it is
    `u + c ln u = r`, whose solution is `u = c W(exp(r / c) / c)` with Lambert's W.
    Saint Venant-Kirchhoff and linear: `(lam + 2 mu) e_2 + lam e_1 = 0` in Green's and in linear strain.
    """
    if density is jb.macklin_mueller:
        return (lam + mu) * a / (mu + lam * a**2)
    if density is jb.neo_hookean:
        c, r = lam / (2 * mu), 1 - lam / mu * np.log(a)
        return float(np.sqrt(c * lambertw(np.exp(r / c) / c).real))
    ratio = lam / (lam + 2 * mu)
    if density is jb.saint_venant_kirchhoff:
        return float(np.sqrt(1 - ratio * (a**2 - 1)))
    assert density is jb.linear_elastic
    return 1 - ratio * (a - 1)


# ------------------------------------------------------------------------------------------ subprocess


def run_python(code: str, **environment: str) -> str:
    """Output of `code` in a new interpreter where warnings are errors and x64 is off unless asked for."""
    variables = {key: value for key, value in os.environ.items() if not key.startswith("JAX_ENABLE_X64")}
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, env=variables | environment
    )
    assert run.returncode == 0, run.stderr
    return run.stdout
