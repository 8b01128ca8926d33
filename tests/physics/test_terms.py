"""Terms: the element itself, tendons and their laws, loads, springs, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, MATERIALS, affine, annulus, central_difference, disturbed, l_shape, macneal_harder, shuffled
from jax.flatten_util import ravel_pytree

import jaxbeam as jb
from jaxbeam.physics.solid import displacement_gradients
from jaxbeam.physics.volume import admissible_step, volume_ratios

MESHES = {
    "rectangle": disturbed(jb.rectangle(2.0, 1.0, 5, 4)),
    "crossed": disturbed(jb.rectangle(2.0, 1.0, 4, 3, diagonals="crossed")),
    "L": disturbed(l_shape()),
    "annulus": annulus(),
    "shuffled": shuffled(disturbed(jb.rectangle(2.0, 1.0, 5, 4)))[0],
    "patch": macneal_harder(),
}
LAWS = {
    jb.constant_stiffness: lambda modulus, commanded: modulus,
    jb.inverse_stiffness: lambda modulus, commanded: modulus / commanded,
    jb.inverse_square_stiffness: lambda modulus, commanded: modulus / commanded**2,
}
each_law = pytest.mark.parametrize("law", LAWS, ids=lambda f: f.__name__)
UNIT = jb.rectangle(2.0, 1.0, 3, 2)


gradients = jax.jit(jax.vmap(displacement_gradients))
jacobians = jax.jit(lambda x, params: volume_ratios(x, params).T)
longest_step = jax.jit(admissible_step)


def one_stencil(term):
    """Parameters of the first stencil of a term."""
    return jax.tree.map(lambda leaf: leaf[0], term.params)


# ---------------------------------------------------------------------------------------------- solid


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)
def test_linear_displacement_gives_its_gradient(mesh):
    G = np.array([[0.3, -0.2], [0.5, -0.1]])
    x = affine(mesh, np.eye(2) + G, shift=(0.4, -0.3))
    term = jb.solid(mesh, jb.Lame(1.0, 1.0))
    H = gradients(x[term.nodes], term.params)
    np.testing.assert_allclose(H, np.broadcast_to(G, H.shape), atol=1e-12)
    J = jacobians(x[term.nodes], term.params)
    np.testing.assert_allclose(J, np.linalg.det(np.eye(2) + G), atol=1e-12)


@pytest.mark.parametrize("density", MATERIALS, ids=lambda f: f.__name__)
def test_force_patch(density):
    """Under any constant stress P, inner nodes are in balance, and each edge sends half `P N` to its ends.

    The patch test of MacNeal and Harder (1985) in the form of nodal forces, at finite strain.
    """
    mesh = macneal_harder()
    F = np.array([[1.1, 0.2], [-0.1, 0.9]])
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1e6, 0.25), density),), np.zeros((8, 2), bool))
    nodal = np.asarray(jb.forces(scene, affine(mesh, F)))
    params = jb.lame(1e6, 0.25)
    P = MATERIALS[density](F, float(params.mu), float(params.lam))
    expected = np.zeros((8, 2))
    nodes = np.asarray(mesh.nodes)
    for start, end in ((4, 5), (5, 6), (6, 7), (7, 4)):
        along = nodes[end] - nodes[start]
        expected[[start, end]] -= 0.5 * P @ np.array([along[1], -along[0]])
    np.testing.assert_allclose(nodal, expected, atol=1e-12 * np.abs(expected).max())


def test_parameters_per_element():
    """Each triangle obeys its own modulus: an array equals the sum of scenes that hold one triangle each."""
    mesh = MESHES["rectangle"]
    count = len(mesh.elements)
    young = np.linspace(1.0, 3.0, count)
    x = affine(mesh, np.diag([1.2, 0.9]))
    term = jb.solid(mesh, jb.lame(young, 0.3))
    energies = jax.jit(jax.vmap(term.energy))
    each = energies(x[term.nodes], term.params)
    one = jb.solid(mesh, jb.lame(1.0, 0.3))
    np.testing.assert_allclose(each, young * energies(x[one.nodes], one.params), rtol=1e-12)
    same = jb.solid(mesh, jb.lame(np.full(count, 2.0), 0.3))
    scalar = jb.solid(mesh, jb.lame(2.0, 0.3))
    jax.tree.map(np.testing.assert_array_equal, same.params, scalar.params)


def test_solid_takes_any_parameters():
    """A density of one's own, with parameters in a dict; only the energy sees them."""
    params = {"stiffness": 2.0, "offset": np.tile([1.0, 0.0], (4, 1))}
    term = jb.solid(UNIT, params, lambda H, p: p["stiffness"] * p["offset"][0])
    assert term.params.material["stiffness"].shape == (4,)
    assert term.params.material["offset"].shape == (4, 2)
    energies = jax.jit(jax.vmap(term.energy))(UNIT.nodes[term.nodes], term.params)
    np.testing.assert_allclose(energies, 2.0 * 0.5, rtol=4 * EPS)


def test_admissible_step_is_where_j_reaches_its_share():
    """Against the exact J along the step; infinite when no element shrinks that far."""
    mesh, keep = MESHES["rectangle"], 0.1
    term = jb.solid(mesh, jb.Lame(1.0, 1.0))
    rng = np.random.default_rng(1)
    x = mesh.nodes
    dx = jnp.asarray(rng.normal(size=x.shape))
    steps = np.asarray(longest_step(x[term.nodes], dx[term.nodes], term.params, keep))
    ratios = lambda t: np.asarray(jacobians((x + t * dx)[term.nodes], term.params)).ravel()
    assert np.isfinite(steps).any()
    for k in np.flatnonzero(np.isfinite(steps)):
        np.testing.assert_allclose(ratios(steps[k])[k], keep, atol=1e-9)  # J varies by up to 1e3 per unit step here
        assert all(ratios(t)[k] > keep for t in np.linspace(0, steps[k], 20)[:-1])
    for k in np.flatnonzero(np.isinf(steps)):
        assert all(ratios(t)[k] > keep for t in np.geomspace(1e-3, 1e3, 50))
    growing = longest_step(x[term.nodes], x[term.nodes], term.params, keep)
    assert np.isinf(growing).all()


# -------------------------------------------------------------------------------------------- tendons


@each_law
@pytest.mark.parametrize("ratio", [0.6, 1.0, 1.5])
def test_tendon_law(law, ratio):
    """Energy, tension and nodal forces of one tendon, against `1/2 k (l - l*)^2`; above 1 it pushes."""
    modulus, natural = 5.0, 2.0
    scene = jb.Scene(UNIT, (jb.tendons(UNIT, [[0, 4]], modulus, law),), jb.clamped(UNIT, [0]))
    scene = jb.command(scene, [ratio])
    commanded = ratio * natural
    k = LAWS[law](modulus, commanded)
    x = UNIT.nodes.at[4, 0].add(-0.3)
    length = natural - 0.3
    np.testing.assert_allclose(jb.energy(scene, x), 0.5 * k * (length - commanded) ** 2, rtol=1e-13, atol=1e-14)
    tension = float(jb.tendon_tensions(scene, x)[0])
    np.testing.assert_allclose(tension, k * (length - commanded), rtol=1e-13)
    assert (tension > 0) == (ratio < 0.85)
    expected = np.zeros((6, 2))
    expected[0, 0], expected[4, 0] = tension, -tension  # positive pulls the ends together
    np.testing.assert_allclose(jb.forces(scene, x), expected, atol=1e-13 * abs(tension))


@each_law
def test_stiffness_agrees_at_any_command_when_told_to(law):
    """The three laws differ only in the power of the commanded length: k l*^p is the modulus."""
    power = {jb.constant_stiffness: 0, jb.inverse_stiffness: 1, jb.inverse_square_stiffness: 2}[law]
    lengths = jnp.array([0.5, 1.0, 3.0])
    np.testing.assert_allclose(law(jnp.full(3, 7.0), lengths) * lengths**power, 7.0, rtol=4 * EPS)


def test_reference_tendon_stiffness():
    """Of the reference scene: 653 at rest and 4082 at ratio 0.4 (the printed digits)."""
    k = jb.inverse_square_stiffness(2e3, 1.75 * np.array([1.0, 0.4]))
    assert [round(v) for v in k.tolist()] == [653, 4082]


def test_guides():
    """A tendon through a guide feels the length of the whole line, and pulls equally on both sides of it."""
    scene = jb.Scene(UNIT, (jb.tendons(UNIT, [[0, 3, 4]], 5.0, jb.constant_stiffness),), jb.clamped(UNIT, [0]))
    natural = 2 * np.sqrt(2.0)
    np.testing.assert_allclose(scene.terms[0].params.natural, [natural], rtol=4 * EPS)
    scene = jb.command(scene, [0.5])
    tension = 5.0 * 0.5 * natural
    nodal = np.asarray(jb.forces(scene, UNIT.nodes))
    unit = np.array([1.0, 1.0]) / np.sqrt(2)
    expected = np.zeros((6, 2))
    expected[0], expected[4] = tension * unit, tension * unit * [-1, 1]
    expected[3] = [0, -2 * tension * unit[1]]
    np.testing.assert_allclose(nodal, expected, atol=1e-13 * tension)


@each_law
@pytest.mark.parametrize("line", [[0, 4], [0, 3, 4]], ids=["two nodes", "guide"])
def test_no_length_is_finite(law, line):
    """All points of a tendon in one place: energy, force and Hessian are finite, not NaN."""
    term = jb.tendons(UNIT, [line], 5.0, law)
    x = jnp.zeros((len(line), 2))
    params = one_stencil(term)
    natural = float(params.natural)
    value, (force, slope) = jax.jit(jax.value_and_grad(term.energy, argnums=(0, 1)))(x, params)
    np.testing.assert_allclose(value, 0.5 * LAWS[law](5.0, natural) * natural**2, rtol=1e-13)
    assert np.isfinite(force).all()
    assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(slope))
    assert np.isfinite(jax.jit(jax.hessian(term.energy))(x, params)).all()


def test_one_segment_without_length_leaves_the_other():
    term = jb.tendons(UNIT, [[0, 3, 4]], 5.0, jb.constant_stiffness)
    params = one_stencil(term)
    x = jnp.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    pull = -float(term.energy.tension(x, params))
    assert pull > 0  # shorter than natural: it pushes
    np.testing.assert_allclose(jax.grad(term.energy)(x, params), [[0, 0], [pull, 0], [-pull, 0]], atol=1e-14)


# ---------------------------------------------------------------------- derivatives, for every energy


STENCILS = {
    "macklin_mueller": lambda m: jb.solid(m, jb.Lame(3.0, 7.0), jb.macklin_mueller),
    "neo_hookean": lambda m: jb.solid(m, jb.Lame(3.0, 7.0), jb.neo_hookean),
    "saint_venant_kirchhoff": lambda m: jb.solid(m, jb.Lame(3.0, 7.0), jb.saint_venant_kirchhoff),
    "linear_elastic": lambda m: jb.solid(m, jb.Lame(3.0, 7.0), jb.linear_elastic),
    "constant": lambda m: jb.tendons(m, [[0, 3, 4]], 5.0, jb.constant_stiffness),
    "inverse": lambda m: jb.tendons(m, [[0, 3, 4]], 5.0, jb.inverse_stiffness),
    "inverse square": lambda m: jb.tendons(m, [[0, 3, 4]], 5.0, jb.inverse_square_stiffness),
    "dead load": lambda m: jb.dead_load(m, [2], [3.0, -4.0]),
    "penalty": lambda m: jb.penalty_springs(m, [2], 6.0),
}


@pytest.mark.parametrize("build", STENCILS.values(), ids=STENCILS)
def test_force_and_hessian_are_derivatives_of_energy(build):
    """In positions and in every parameter, to second order, against central differences."""
    term = build(UNIT)
    x = UNIT.nodes[term.nodes[0]]
    x = x + 0.1 * jnp.asarray(np.random.default_rng(0).normal(size=x.shape))
    flat, restore = ravel_pytree((x, one_stencil(term)))
    value = lambda z: term.energy(*restore(z))
    both = jax.jit(lambda z: jnp.append(jax.grad(value)(z), value(z)))
    differences = central_difference(both, flat, 1e-5)
    gradient, hessian = both(flat)[:-1], jax.jit(jax.hessian(value))(flat)
    # Truncation h^2 and round-off eps / h are both near 1e-10 for h = 1e-5, of values up to 1e2.
    scale = 1e-7 * max(1, np.abs(hessian).max())
    np.testing.assert_allclose(gradient, differences[-1], atol=scale)
    np.testing.assert_allclose(hessian, differences[:-1], atol=scale)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12 * max(1, np.abs(hessian).max()))
    assert np.abs(gradient).max() > 0


# --------------------------------------------------------------------------------- loads and springs


def test_dead_load():
    scene = jb.Scene(UNIT, (jb.dead_load(UNIT, [3, 4], [[1.0, 2.0], [-3, 0.5]]),), jb.clamped(UNIT, [0]))
    expected = np.zeros((6, 2))
    expected[3], expected[4] = [1, 2], [-3, 0.5]
    x = affine(UNIT, np.diag([2.0, 3.0]))
    np.testing.assert_array_equal(jb.forces(scene, x), expected)
    np.testing.assert_array_equal(jb.forces(scene, UNIT.nodes), expected)
    assert jb.energy(scene, UNIT.nodes) == 0
    np.testing.assert_allclose(jb.energy(scene, x), -np.sum(expected * (x - UNIT.nodes)), rtol=4 * EPS)


def test_dead_load_shared_and_repeated():
    """One force for all nodes; a node listed twice is loaded twice."""
    scene = jb.Scene(UNIT, (jb.dead_load(UNIT, [3, 4, 4], [0, -1]),), jb.clamped(UNIT, [0]))
    np.testing.assert_array_equal(jb.forces(scene, UNIT.nodes)[:, 1], [0, 0, 0, -1, -2, 0])


@pytest.mark.parametrize("stiffness", [4.0, [4.0, 0.0], np.array([4, 2]), jnp.array([1.0, 2.0])])
def test_penalty_springs(stiffness):
    scene = jb.Scene(UNIT, (jb.penalty_springs(UNIT, [1, 2], stiffness),), jb.clamped(UNIT, [0]))
    moved = np.random.default_rng(0).normal(size=(6, 2))
    k = np.zeros(6)
    k[[1, 2]] = stiffness
    x = UNIT.nodes + moved
    np.testing.assert_allclose(jb.forces(scene, x), -k[:, None] * moved, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(jb.energy(scene, x), 0.5 * np.sum(k * np.sum(moved**2, axis=1)), rtol=1e-14)


# ---------------------------------------------------------------------------------- what is refused


def bending(x, params):
    return params * jnp.sum(x[0] - 2 * x[1] + x[2]) ** 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("stiff", [[0]], ()), r"energy: expected a function \(x, params\) -> scalar, got 'stiff'"),
        ((bending, [0, 1, 2], ()), r"nodes: expected concrete whole numbers of shape \(m, k\), got shape \(3,\)"),
        ((bending, [[0.0, 1.0]], ()), r"nodes: expected concrete whole numbers .* of dtype float64"),
        ((bending, np.zeros((0, 3), int), ()), r"nodes: expected concrete whole numbers .* got shape \(0, 3\)"),
        ((bending, [[0, 1, 2]], 1.0), r"params: expected leading axis 1, .* got shape \(\); use jnp.broadcast_to"),
        ((bending, [[0, 1, 2]], {"k": np.ones(2)}), r"params\['k'\]: expected leading axis 1, .* got shape \(2,\)"),
    ],
)
def test_term_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        jb.Term(*arguments)


def test_term_refuses_traced_nodes():
    with pytest.raises(ValueError, match=r"nodes: expected concrete whole numbers .* got a traced array"):
        jax.jit(lambda nodes: jb.Term(bending, nodes, jnp.ones(1)).params)(jnp.array([[0, 1, 2]]))


@pytest.mark.parametrize(
    "nodes", [[[0, 1, 2]], np.array([[0, 1, 2]], np.uint8), jnp.array([[0, 1, 2]])], ids=lambda n: type(n).__name__
)
def test_term_accepts(nodes):
    term = jb.Term(bending, nodes, np.array([2.0]))
    assert term.nodes.dtype == np.int32
    assert not term.nodes.flags.writeable


def two(value):
    return {"nodes": [[0, 4], [1, 5]], "modulus": value}


MESSAGES = {
    "tendons": [
        ({"nodes": [0, 4]}, r"nodes: expected whole numbers of shape \(m, k\), got shape \(2,\)"),
        ({"nodes": [[0.0, 4.0]]}, r"nodes: expected whole numbers of shape \(m, k\), got .*float64"),
        ({"nodes": [[0]]}, r"nodes: expected at least two nodes for each tendon, got \[0\] for tendon 0"),
        ({"nodes": [[0, 6]]}, r"nodes: 6 is out of range, nodes are numbered 0 to 5"),
        ({"nodes": [[-1, 4]]}, r"nodes: -1 is out of range"),
        ({"nodes": [[0, 4], [3, 3]]}, r"nodes: tendon 1 repeats a node: \[3, 3\]"),
        (two(0.0), r"modulus: expected positive finite numbers, got 0\.0"),
        (two([1.0, -1.0]), r"modulus: expected positive finite numbers, got \[1\.0, -1\.0\]"),
        (two(np.nan), r"modulus: expected positive finite numbers, got nan"),
        (two([1.0, 2.0, 3.0]), r"modulus: expected a scalar or 2 entries, got shape \(3,\)"),
    ],
    "dead_load": [
        ({"nodes": [[3]]}, r"nodes: expected whole numbers of shape \(m,\), got shape \(1, 1\)"),
        ({"nodes": []}, r"nodes: expected whole numbers of shape \(m,\), got shape \(0,\)"),
        ({"nodes": [6]}, r"nodes: 6 is out of range"),
        ({"force": 1.0}, r"force: expected shape \(2,\) or \(1, 2\), got \(\)"),
        ({"force": [[1.0, 0.0], [1.0, 0.0]]}, r"force: expected shape \(2,\) or \(1, 2\), got \(2, 2\)"),
        ({"force": [np.inf, 0.0]}, r"force: expected finite numbers, got \[inf, 0\.0\]"),
    ],
    "penalty_springs": [
        ({"nodes": [6]}, r"nodes: 6 is out of range"),
        ({"stiffness": [1.0, 2.0]}, r"stiffness: expected a scalar or 1 entries, got shape \(2,\)"),
        ({"stiffness": -1.0}, r"stiffness: expected finite numbers of at least 0, got -1\.0"),
        ({"stiffness": np.nan}, r"stiffness: expected finite numbers of at least 0, got nan"),
    ],
}
VALID = {
    "tendons": {"nodes": [[0, 4]], "modulus": 1.0},
    "dead_load": {"nodes": [3], "force": [1.0, 0.0]},
    "penalty_springs": {"nodes": [3], "stiffness": 1.0},
}


@pytest.mark.parametrize(
    ("builder", "arguments", "message"), [(name, *case) for name, cases in MESSAGES.items() for case in cases]
)
def test_builders_refuse(builder, arguments, message):
    build = getattr(jb, builder)
    build(UNIT, **VALID[builder])  # the rest of the arguments is not at fault
    with pytest.raises(ValueError, match=message):
        build(UNIT, **(VALID[builder] | arguments))


@pytest.mark.parametrize("builder", VALID)
def test_builders_refuse_traced_nodes(builder):
    arguments = dict(VALID[builder])
    nodes = jnp.asarray(arguments.pop("nodes"))
    with pytest.raises(ValueError, match="nodes: expected concrete node numbers, got a traced array"):
        jax.jit(lambda n: getattr(jb, builder)(UNIT, n, **arguments).params)(nodes)


def test_solid_refuses():
    with pytest.raises(
        ValueError, match=r"params\.mu: expected a scalar or 4 entries, one for each triangle, .*\(3,\)"
    ):
        jb.solid(UNIT, jb.lame(np.ones(3), 0.3))


def test_a_mesh_without_shared_stencils_is_refused_by_the_scene():
    """A term made for another mesh does not fit."""
    term = jb.solid(jb.rectangle(2.0, 1.0, 4, 3), jb.lame(1.0, 0.3))
    with pytest.raises(ValueError, match=r"terms\[0\]\.nodes: \d+ is out of range, nodes are numbered 0 to 5"):
        jb.Scene(UNIT, (term,), jb.clamped(UNIT, [0]))
