"""Bad input: refused in a sentence that names the argument when it is concrete, `INVALID` when it is traced."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import small_beam

import jaxbeam as jb
from jaxbeam.mesh.geometry import SLIVER
from jaxbeam.mesh.line import Line, straight
from jaxbeam.physics.rod import rod
from jaxbeam.physics.rod_tendon import rod_tendons
from jaxbeam.scene.scene import is_valid

MESH = jb.rectangle(2.0, 1.0, 3, 2)
BODY = jb.solid(MESH, jb.lame(1.0, 0.3))
BEAM = jb.command(jb.tendon_beam(5, 3), [0.9, 1.0])
REST = BEAM.mesh.nodes
LINE = straight(2.0, 0.5, 3)
ROD = jb.rod_beam(5)
RNG = np.random.default_rng(0)

# ------------------------------------------------------------------------------------- what is no number at all

NUMBERS = {
    "length": lambda v: jb.rectangle(v, 1.0, 3, 3),
    "height": lambda v: jb.tendon_beam(5, 3, height=v),
    "young": lambda v: jb.lame(v, 0.3),
    "poisson": lambda v: jb.tendon_beam(5, 3, poisson=v),
    "modulus": lambda v: jb.tendons(MESH, [[0, 4]], v),
    "width": lambda v: jb.tendons(MESH, [[0, 4]], 1.0, width=v),
    "anchor_width": lambda v: jb.tendon_beam(5, 3, anchor_width=v),
    "force": lambda v: jb.dead_load(MESH, [3], v),
    "stiffness": lambda v: jb.penalty_springs(MESH, [3], v),
    "params": lambda v: jb.solid(MESH, v),
    "params.lam": lambda v: jb.solid(MESH, jb.Lame(1.0, v)),
    "nodes": lambda v: jb.Mesh(v, MESH.elements),
    "radian": lambda v: Line(LINE.nodes, LINE.elements, v),
    "eccentricity": lambda v: rod_tendons(LINE, [[0, 2]], v, 1.0),
    "ratios": lambda v: jb.command(BEAM, v),
    "tendon_modulus": lambda v: jb.euler_bernoulli([0.9, 1.0], tendon_modulus=v),
    "x": lambda v: jb.tip_angle(BEAM, v),
    "x0": lambda v: jb.equilibrium(BEAM, v),
    "target": lambda v: jb.reach(BEAM, v),
    "starts": lambda v: jb.reach(BEAM, 1.0, starts=v),
    "tolerance": lambda v: jb.solve_to(BEAM, jb.tip_angle, v),
    "step": lambda v: jb.trace_branch(BEAM, [0.4, 0.4], step=v),
    "rtol": lambda v: jb.Newton(rtol=v),
    "keep_volume": lambda v: jb.Newton(keep_volume=v),
    "point": lambda v: jb.nearest_node(MESH, v),
}
NO_NUMBERS = {
    "None": None,
    "text": "0.5",
    "texts": ["0.5", "1.0"],
    "dict": {"a": 1.0},
    "object": object(),
    "complex": 1.0 + 0.5j,
    "complex array": jnp.array([1j, 1.0]),
    "boolean": True,
    "booleans": [True, 1.0],
    "ragged": [[1.0, 2.0], [3.0]],
    "masked": np.ma.masked_array([1.0, 2.0], [True, False]),
    "half": np.float16(0.5),
    "halves": jnp.array([0.5, 1.0], jnp.float16),
    "brain": jnp.array([0.5, 1.0], jnp.bfloat16),
}
MAY_BE_NONE = {"x0", "starts", "rtol"}


@pytest.mark.parametrize("value", NO_NUMBERS.values(), ids=NO_NUMBERS)
@pytest.mark.parametrize("name", NUMBERS)
def test_what_is_no_number_is_refused_by_name(name, value):
    if value is None and name in MAY_BE_NONE:
        pytest.skip("allowed")
    # Parameters are a pytree: a list or a dict in it is a branch, and what is wrong may be a leaf of that, or all.
    argument = "params" if name.startswith("params") else name
    with pytest.raises(ValueError, match=rf"^{argument}.*: expected .*, got "):
        NUMBERS[name](value)


# ------------------------------------------------------------------------------------------ what else is wrong


def energy_in_f(F, params):
    """Saint Venant-Kirchhoff: finite at F = 0."""
    strain = 0.5 * (F.T @ F - jnp.eye(2))
    return params.mu * jnp.sum(strain * strain)


def logarithm_in_f(F, params):
    return params.mu * (0.5 * jnp.sum(F * F) - 1 - jnp.log(jnp.linalg.det(F)))


def in_h(density):
    return lambda H, params: density(H + jnp.eye(2), params)


def both(x, params):
    return params * x[0]


def loose_edge(x, params):
    return params * jnp.sum(x**2)


SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.4, 0.6]])
GRID = jb.rectangle(1.0, 1.0, 4, 4)


def two_bodies(shift, scale=1.0):
    """A square of 4 x 4 nodes and another one, scaled and moved."""
    nodes, count = np.asarray(GRID.nodes), len(GRID.nodes)
    return jb.Mesh(
        np.concatenate([nodes, nodes * scale + shift]), np.concatenate([GRID.elements, GRID.elements + count])
    )


def twice_around():
    """Ten triangles about node 0 that go round it nearly twice."""
    angle, radius = 4 * np.pi * np.arange(11) / 12, 1 + 0.01 * np.arange(11)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return jb.Mesh(np.concatenate([np.zeros((1, 2)), ring]), [[0, k + 1, k + 2] for k in range(10)])


OTHER = jnp.zeros((3, 2))
SHAPE = r"x: expected node positions of shape \(15, 2\), got \(3, 2\)"
REFUSED = {
    # Measures of positions of another shape: JAX would clamp the indices.
    **{
        f"{measure.__name__} of another shape": (lambda measure=measure: measure(BEAM, OTHER), SHAPE)
        for measure in (
            jb.tip_angle,
            jb.tip_position,
            jb.section_rotation,
            jb.tendon_lengths,
            jb.tendon_tensions,
            jb.cauchy_stress,
            jb.nodal_stress,
            jb.jacobians,
            jb.strain_energy,
            jb.reactions,
            jb.forces,
            jb.energy,
            jb.smallest_jacobian,
            jb.lowest_mode,
        )
    },
    "many states": (
        lambda: jb.tip_angle(BEAM, jnp.stack([REST, REST])),
        r"got \(2, 15, 2\); .*jax.vmap\(lambda x: measure\(",
    ),
    "whole positions": (lambda: jb.energy(BEAM, jnp.zeros((15, 2), int)), "x: expected .*, got dtype int64; convert"),
    "solution for x": (
        lambda: jb.tip_angle(BEAM, SOLUTION),
        "x: expected .*, got a Solution; give its positions, solu",
    ),
    "solution for x0": (lambda: jb.equilibrium(BEAM, SOLUTION), "x0: expected .*, got a Solution; give its positions"),
    "x for solution": (lambda: jb.check(REST), "solution: expected a Solution, got a ArrayImpl"),
    "x to estimate": (lambda: jb.estimate_error(BEAM, REST, jb.tip_angle), "solution: expected a Solution, got"),
    # Objects of another kind.
    "mesh for scene": (lambda: jb.equilibrium(MESH), r"scene: expected a Scene, got a Mesh; make one with tendon_beam"),
    "text for scene": (lambda: jb.ramp("beam", [1.0, 1.0]), "scene: expected a Scene, got a str"),
    "text for solver": (
        lambda: jb.equilibrium(BEAM, solver="newton"),
        r"solver: expected a Newton, got a str; make one",
    ),
    "class for solver": (
        lambda: jb.sweep(BEAM, [[1.0, 1.0]], jb.Newton),
        "solver: expected a Newton, got the class Newt",
    ),
    "linear for solver": (
        lambda: jb.ramp(BEAM, [1.0, 1.0], solver=jb.Dense()),
        "solver: expected a Newton, got a Dense",
    ),
    "class for linear": (lambda: jb.Newton(linear=jb.Dense), "linear: expected a linear solver, such as BlockTridi"),
    "text for linear": (lambda: jb.linear_response(BEAM, "dense"), "linear: expected a linear solver"),
    "scene for mesh": (lambda: jb.solid(BEAM, jb.lame(1.0, 0.3)), "mesh: expected a Mesh, got a Scene"),
    "nodes for mesh": (lambda: jb.clamped(MESH.nodes, [0]), "mesh: expected a Mesh, got a ArrayImpl"),
    "line in solid": (
        lambda: jb.solid(LINE, jb.lame(1.0, 0.3)),
        r"mesh: expected triangles, got the Line.* is rod\(line",
    ),
    "line in quadratic": (lambda: jb.quadratic(LINE), "mesh: expected triangles, got the Line of a rod"),
    "mesh in rod": (
        lambda: rod(MESH, 1.0, jb.lame(1.0, 0.3)),
        "line: expected a Line, got a Mesh; make one with straig",
    ),
    "mesh in rod_tendons": (lambda: rod_tendons(MESH, [[0, 4]], 0.0, 1.0), "line: expected a Line, got a Mesh"),
    # Settings.
    "true steps": (lambda: jb.Newton(max_steps=True), "max_steps: expected a whole number of at least 0, got True"),
    "text to escape": (lambda: jb.Newton(escape="no"), "escape: expected True or False, got 'no'"),
    "text to grade": (lambda: jb.tendon_beam(5, 3, graded="yes"), "graded: expected True or False, got 'yes'"),
    "true order": (lambda: jb.rectangle(1.0, 1.0, 3, 3, order=True), r"order: expected 1 .* got True"),
    "no diagonals": (lambda: jb.rectangle(1.0, 1.0, 3, 3, None), "diagonals: expected 'one-sided', .* got None"),
    "true block": (lambda: jb.BlockTridiagonal(True), "joined: expected a whole number of at least 0, got True"),
    "true degree": (
        lambda: jb.tendon_beam(5, 3, degree=True),
        "degree: expected a whole number of at least 1",
    ),
    "half dtype": (lambda: jb.tendon_beam(5, 3, dtype=jnp.float16), "dtype: expected float32 or float64, got"),
    "whole dtype": (lambda: jb.rod_beam(5, dtype=int), "dtype: expected float32 or float64, got <class 'int'>"),
    "true count": (lambda: jb.lowest_mode(BEAM, REST, True), "count: expected a whole number from 1 to 24, .*got True"),
    "true steps of a ramp": (lambda: jb.ramp(BEAM, [1.0, 1.0], True), "steps: expected a whole number of at least 2"),
    "no solves": (
        lambda: jb.reach(BEAM, 1.0, max_solves=0),
        "max_solves: expected a whole number of at least 1, got 0",
    ),
    "endless step": (lambda: jb.trace_branch(BEAM, [0.4, 0.4], step=np.inf), "step: expected a positive finite number"),
    "endless interval": (
        lambda: jb.trace_branch(BEAM, [0.4, 0.4], interval=(0.0, np.inf)),
        "interval: expected finite",
    ),
    "no parameter": (
        lambda: jb.trace_branch(BEAM, [0.4, 0.4], parameter=np.nan),
        "parameter: expected a finite number",
    ),
    "true direction": (lambda: jb.trace_branch(BEAM, [0.4, 0.4], direction=True), "direction: expected 1 or -1, got T"),
    "no points": (lambda: jb.trace_branch(BEAM, [0.4, 0.4], max_points=0), "max_points: expected a whole number of at"),
    "no target": (lambda: jb.reach(BEAM, np.nan), "target: expected finite numbers, got nan"),
    "one bad target": (
        lambda: jb.reach_each(BEAM, [1.0, np.nan]),
        r"targets: expected finite numbers, got \[1.0, nan\]",
    ),
    "one bound": (
        lambda: jb.reach(BEAM, 1.0, bounds=0.4),
        r"bounds: expected the lowest and the highest ratio, .*got 0.4",
    ),
    "no bound": (lambda: jb.reach(BEAM, 1.0, bounds=(np.nan, 1.0)), "bounds, low: expected finite numbers, got nan"),
    "no start": (lambda: jb.reach(BEAM, 1.0, starts=[[np.nan, 1.0]]), r"starts: expected finite numbers, got \[\[nan"),
    "no tolerance": (
        lambda: jb.solve_to(BEAM, jb.tip_angle, np.nan),
        "tolerance: expected a positive finite number, got",
    ),
    "endless tolerance": (
        lambda: jb.reach(BEAM, 1.0, tolerance=np.inf),
        "tolerance: expected a positive finite number",
    ),
    "no measure": (lambda: jb.reach(BEAM, 1.0, "angle"), r"measure: expected a function \(scene, x\)"),
    "no optimiser": (
        lambda: jb.minimise(jb.tip_angle, 1.0, "adam", design=small_beam),
        "optimiser: expected one of optax",
    ),
    "no design": (
        lambda: jb.minimise(jb.tip_angle, jnp.ones(2), optax.sgd(1.0), design=lambda theta: theta),
        "scene: expected a Scene, got",
    ),
    "ratios of commands": (
        lambda: jb.commands([0.5, -1.0]),
        r"ratios: expected positive finite numbers, got \[0.5, -1",
    ),
    # Nodes and triangles.
    "ragged guides": (
        lambda: jb.tendons(MESH, [[0, 4], [1, 3, 99]], 1.0),
        r"nodes\[1\]: 99 is out of range",
    ),
    "a short row": (lambda: jb.tendons(MESH, [[0, 4], [1]], 1.0), "two nodes for each tendon, got .* for tendon 1"),
    "masked elements": (lambda: jb.Mesh(SQUARE, np.ma.masked_array([[0, 1, 2]])), "elements: .* got a masked array"),
    "masked clamp": (
        lambda: jb.Scene(MESH, (BODY,), np.ma.masked_array(jb.clamped(MESH, [0]))),
        "fixed: expected booleans of shape .* got a masked array",
    ),
    "masked tip": (
        lambda: jb.Scene(MESH, (BODY,), jb.clamped(MESH, [0, 1]), np.ma.masked_array([4])),
        "tip: .* got a masked array",
    ),
    "ragged stencils": (
        lambda: jb.Term(loose_edge, [[0, 1], [2]], np.ones(2)),
        "nodes: expected concrete whole num",
    ),
    "whole JAX nodes": (
        lambda: jb.Mesh(jnp.zeros((3, 2), int), [[0, 1, 2]]),
        "nodes: expected floats, got dtype int64",
    ),
    "same side": (
        lambda: jb.Mesh(SQUARE[[0, 1, 2, 4]], [[0, 1, 2], [0, 1, 3]]),
        r"triangles \[0, 1\] .* nodes 0 and 1, and two",
    ),
    "three on an edge": (
        lambda: jb.Mesh(np.append(SQUARE[[0, 1, 2, 4]], [[0.5, -1.0]], 0), [[0, 1, 2], [0, 1, 3], [1, 0, 4]]),
        r"elements: triangles \[0, 1, 2\] meet in the edge between nodes 0 and 1",
    ),
    "corners overlap": (
        lambda: two_bodies([0.5, 0.45]),
        r"elements: triangles overlap: the edge .* crosses that between",
    ),
    "one inside": (
        lambda: two_bodies([0.01, 0.02], 0.1),
        "elements: triangles overlap: others lie over that at the edge",
    ),
    "strip": (lambda: two_bodies([0.9, 0.0]), "elements: triangles overlap: others lie over that at the edge"),
    "twice around": (twice_around, "elements: triangles overlap"),
    # Functions.
    "density in F": (
        lambda: jb.solid(MESH, jb.lame(1.0, 0.3), energy_in_f),
        r"H = F - I, the displacement gradient, 0 at rest.*F = H \+",
    ),
    "logarithm in F": (lambda: jb.solid(MESH, jb.lame(1.0, 0.3), logarithm_in_f), "is inf at H = 0 and 0 at H = I"),
    "rod in F": (lambda: jb.rod_beam(5, density=logarithm_in_f), "density: expected the energy of H = F - I"),
    "no scalar": (
        lambda: jb.solid(MESH, jb.lame(1.0, 0.3), lambda H, p: H),
        "density: .* returns one real number, got Sh",
    ),
    "text for density": (lambda: jb.tendon_beam(5, 3, density="neo"), r"density: expected a function \(H, params\)"),
    "text for law": (
        lambda: jb.tendon_beam(5, 3, stiffness="constant"),
        r"stiffness: expected a function \(modulus, com",
    ),
    "law without value": (
        lambda: jb.tendons(MESH, [[0, 4]], 1.0, lambda m, c: None),
        "stiffness: .* returns one real num",
    ),
    "energy of two": (
        lambda: jb.Scene(MESH, (BODY, jb.Term(both, [[0]], np.ones(1))), jb.clamped(MESH, [0, 1])),
        r"terms\[1\].energy: expected a function \(x, params\) that returns one real number, got .*\(2,\)",
    ),
    "complex parameter": (
        lambda: jb.Term(loose_edge, [[0]], {"k": np.ones(1, complex)}),
        r"params\['k'\]: .* take the real",
    ),
    "half parameter": (
        lambda: jb.Term(loose_edge, [[0]], np.ones(1, np.float16)),
        "params: .* dtype float16; convert it",
    ),
    # What has no answer.
    "clamped tip": (
        lambda: jb.tip_angle(jb.Scene(MESH, (BODY,), jb.clamped(MESH, [0, 1, 4, 5]), [4, 5]), MESH.nodes),
        "scene: its tip is clamped, so the tip angle is always 0; give",
    ),
    "unstable rest": (lambda: jb.linear_response(SADDLE), "scene: it is not stable at rest"),
    "negative ratio by hand": (lambda: jb.euler_bernoulli([-0.5, 1.0]), "ratios: expected positive finite numbers"),
    "no ratio by hand": (lambda: jb.euler_bernoulli([np.nan, 1.0]), r"ratios: expected .*, got \[nan, 1.0\]"),
    "no modulus by hand": (
        lambda: jb.euler_bernoulli([0.9, 1.0], young=0.0),
        "young: expected a positive finite number",
    ),
    "no law by hand": (
        lambda: jb.euler_bernoulli([0.9, 1.0], tendon_modulus=-1.0),
        "tendon_modulus: expected positive",
    ),
    "incompressible by hand": (
        lambda: jb.euler_bernoulli([0.9, 1.0], poisson=1.0),
        r"poisson: expected a value in \(-1",
    ),
}
SOLUTION = jb.Solution(*[REST] * len(dataclasses.fields(jb.Solution)))
# Two springs in line, pushed: the node between them is at a saddle.
SADDLE_MESH = jb.Mesh(np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, -1.0]]), [[0, 3, 2], [3, 1, 2]])
PAIR = jb.tendons(SADDLE_MESH, [[0, 2], [2, 1]], 3.0, jb.constant_stiffness)
SADDLE = jb.command(jb.Scene(SADDLE_MESH, (PAIR,), jb.clamped(SADDLE_MESH, [0, 1, 3])), [1.3, 1.3])


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case):
    call, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(
    "build",
    [
        lambda: two_bodies([1.1, 0.0]),
        lambda: two_bodies([0.97, 0.0], 0.9),
        lambda: two_bodies([0.0, 1.35], 1.7),  # side by side, though no nodes are shared
        lambda: jb.solid(MESH, jb.lame(1.0, 0.3), in_h(energy_in_f)),
        lambda: jb.solid(MESH, jb.lame(1.0, 0.3), in_h(logarithm_in_f)),
        lambda: jb.solid(MESH, jb.lame(1.0, 0.3), lambda H, p: p.mu * jnp.sum(H * H)),
        lambda: jb.solid(MESH, jb.lame(1.0, 0.3), lambda H, p: jb.linear_elastic(H, p)),
        lambda: jb.solid(MESH, jb.lame(1.0, 0.3), lambda H, p: jb.neo_hookean(H, p) + p.mu * H[0, 0]),  # prestressed
        lambda: jb.solid(MESH, {"k": np.ones((4, 3))}, lambda H, p: jnp.sum(p["k"]) * jnp.sum(H * H)),
    ],
)
def test_accepted(build):
    build()


def test_a_density_in_f_is_refused_under_debug_nans_and_jit():
    with jax.debug_nans(True), pytest.raises(ValueError, match="seems to be written in F"):
        jb.solid(MESH, jb.lame(2.0, 0.3), logarithm_in_f)
    with pytest.raises(ValueError, match="seems to be written in F"):
        jax.jit(lambda young: jb.solid(MESH, jb.lame(young, 0.3), energy_in_f).params.rest)(1.0)


def test_a_list_may_hold_traced_numbers():
    slope = jax.grad(lambda r: jnp.sum(jb.command(BEAM, [r, 1.0]).terms[1].params.commanded))(0.9)
    np.testing.assert_allclose(slope, 1.75)


# --------------------------------------------------------------------------------------- traced: INVALID


def scene_of(*terms, mesh=MESH):
    body = BODY if mesh is MESH else jb.solid(mesh, jb.lame(1.0, 0.3))
    return jb.Scene(mesh, (body, *terms), jb.clamped(mesh, [0, 1]))


def line_of(*terms, line=LINE, height=0.5):
    return jb.Scene(line, (rod(line, height, jb.lame(1.0, 0.3)), *terms), jb.clamped(line, [0]))


def bent_triangle(v):
    """A triangle of six nodes, whose fourth lies `v` below the middle of its edge."""
    corners = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5]])
    return scene_of(mesh=jb.Mesh(corners.at[3, 1].add(-v), [[0, 1, 2, 3, 4, 5]]))


# How a scene depends on a number: a value in its range, and values outside.
TRACED = {
    "length": (lambda v: jb.rod_beam(5, length=v), 3.0, (-3.0, 0.0, np.inf, np.nan)),
    "height of a rod": (lambda v: jb.rod_beam(5, height=v), 0.8, (-0.8, 0.0)),
    "both extents": (lambda v: jb.tendon_beam(5, 3, 3.5 * v, 0.8 * v), 1.0, (-1.0, 0.0)),
    "extents of six nodes": (lambda v: scene_of(mesh=jb.rectangle(v, v, 3, 2, order=2)), 1.0, (-1.0, 0.0)),
    "young": (lambda v: jb.tendon_beam(5, 3, young=v), 1e4, (-1e4, 0.0)),
    "poisson": (lambda v: jb.tendon_beam(5, 3, poisson=v), 0.3, (0.5, 0.7, -1.0)),
    "one young": (lambda v: jb.tendon_beam(5, 3, young=v * jnp.ones(16).at[3].set(1e4)), 1e4, (-1.0,)),
    "corrected lame": (lambda v: scene_of(jb.solid(MESH, jb.lame_macklin_mueller(1.0, v))), 0.3, (0.5, -1.0)),
    "modulus": (lambda v: scene_of(jb.tendons(MESH, [[0, 4]], v)), 1.0, (-1.0, 0.0, np.inf)),
    "force": (lambda v: scene_of(jb.dead_load(MESH, [4], jnp.stack([v, 0 * v]))), 1.0, (np.inf, np.nan)),
    "springs": (lambda v: scene_of(jb.penalty_springs(MESH, [4, 5], v)), 50.0, (-50.0, np.inf)),
    "one spring": (lambda v: scene_of(jb.penalty_springs(MESH, [4, 5], jnp.stack([v, 1.0 + v]))), 0.5, (-0.5,)),
    "material": (lambda v: scene_of(jb.solid(MESH, jb.Lame(v, 1.0))), 1.0, (np.inf, np.nan)),
    "ratio": (lambda v: jb.command(BEAM, jnp.stack([v, v])), 0.5, (-0.5, 0.0, np.nan)),
    "nodes": (lambda v: scene_of(mesh=jb.Mesh(MESH.nodes.at[2, 0].add(v), MESH.elements)), 0.1, (1.5, -1.5, np.nan)),
    "six nodes": (bent_triangle, 0.1, (-0.4,)),
    "radian": (lambda v: line_of(line=Line(LINE.nodes, LINE.elements, v)), 0.5, (-0.5, 0.0, np.nan)),
    "nodes of a line": (lambda v: line_of(line=Line(LINE.nodes.at[1, 0].add(v), LINE.elements, 0.5)), 0.1, (1.5, -1.5)),
    "height": (lambda v: line_of(height=v), 0.5, (-0.5, 0.0)),
    "eccentricity": (lambda v: line_of(rod_tendons(LINE, [[0, 2]], v, 1.0)), 0.1, (np.inf, np.nan)),
}


@pytest.mark.parametrize("name", TRACED)
def test_what_is_refused_when_concrete_is_invalid_when_traced(name):
    build, good, bad = TRACED[name]
    values = jnp.array([good, *bad])
    wanted = [True] + [False] * len(bad)
    valid = jax.jit(lambda v: is_valid(build(v)))
    assert [bool(valid(v)) for v in values] == wanted
    assert jax.jit(jax.vmap(lambda v: is_valid(build(v))))(values).tolist() == wanted
    build(good)
    for value in bad:
        with pytest.raises(ValueError):
            build(value)


@pytest.mark.parametrize("name", TRACED)
def test_derivatives_pass_through_the_checks(name):
    build, good, _ = TRACED[name]

    def total(v):
        leaves = jax.tree.leaves(build(v))
        return sum(jnp.sum(jnp.log1p(leaf**2)) for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating))

    of = jax.jit(total)
    slope, h = jax.jit(jax.grad(total))(good), 1e-5 * good
    assert slope != 0
    np.testing.assert_allclose(slope, (of(good + h) - of(good - h)) / (2 * h), rtol=1e-6)


def test_traced_by_hand_is_nan():
    names = ("ratios", "length", "height", "young", "poisson", "tendon_modulus")
    good = (jnp.array([0.9, 1.0]), 3.5, 0.8, 1e4, 0.45, 2e3)
    by_hand = jax.jit(lambda *values: jb.euler_bernoulli(*values).tip_angle)
    assert np.isfinite(by_hand(*good))
    for k, name in enumerate(names):
        bad = [*good[:k], -1.0 * good[k] - (name == "poisson"), *good[k + 1 :]]
        assert np.isnan(by_hand(*bad)), name
        with pytest.raises(ValueError, match=f"^{name}: expected"):
            jb.euler_bernoulli(*bad)


SOLVED = {
    "length of a rod": (lambda v: jb.rod_beam(5, length=v), (3.5, -3.0)),
    "springs": (lambda v: scene_of(jb.penalty_springs(MESH, [4, 5], v)), (50.0, -50.0)),
    "both extents": (lambda v: jb.tendon_beam(5, 3, 3.5 * v, 0.8 * v), (1.0, -1.0)),
}


# A rod compiles for longest; by what it is invalid is told by `TRACED`.
@pytest.mark.parametrize("name", [pytest.param("length of a rod", marks=pytest.mark.slow), "springs", "both extents"])
def test_a_solve_out_of_range_is_invalid_and_its_derivative_nan(name):
    build, values = SOLVED[name]

    def outcome(v):
        solution = jb.equilibrium(build(v))
        return jnp.sum(solution.x**2), solution.status

    (_, status), slope = jax.jit(jax.vmap(jax.value_and_grad(outcome, has_aux=True)))(jnp.array(values))
    assert int(status[0]) == jb.Status.OK
    assert int(status[1]) & jb.Status.INVALID
    assert np.isfinite(slope[0]) and not np.isfinite(slope[1])


def test_linear_response_at_a_saddle_is_nan_inside_jit():
    assert np.isnan(jax.jit(jb.linear_response)(SADDLE)[2]).all()
    held = jb.command(SADDLE, [0.9, 0.9])
    assert np.isfinite(jb.linear_response(held)).all()


def test_a_sliver_is_refused_at_the_same_area_traced_or_not():
    nodes = lambda v: jnp.array([[0.0, 0.0], [1.0, 0.0], [0.5, 0.0]]).at[2, 1].set(v)
    build = lambda v: jb.Mesh(nodes(v), [[0, 1, 2]]).nodes
    assert np.isfinite(jax.jit(build)(4 * SLIVER)).all()
    assert np.isnan(jax.jit(build)(SLIVER)).all()
    with pytest.raises(ValueError, match="has area"):
        build(SLIVER)
