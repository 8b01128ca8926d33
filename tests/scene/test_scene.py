"""Scenes: what is summed, what is refused, scenes as data, reactions; importing changes nothing."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import affine, rotation, run_python, small_beam, spring_pair

import jaxbeam as jb
from jaxbeam.core.tree import replace

UNIT = jb.rectangle(2.0, 1.0, 3, 2)
BODY = jb.solid(UNIT, jb.lame(10.0, 0.3))
LEFT = jb.clamped(UNIT, [0, 1])


@pytest.fixture(scope="module")
def small():
    return small_beam()


def test_reference_scene(beam):
    """The scene as published: where the tendons end, what is clamped, and the natural lengths."""
    nodes = np.asarray(beam.mesh.nodes)
    _, threads = beam.terms
    expected = [[[-1.75, 0.4], [0, 0.4]], [[-1.75, -0.4], [0, -0.4]]]
    np.testing.assert_allclose(nodes[threads.nodes], expected, atol=1e-15)
    np.testing.assert_allclose(threads.params.natural, 1.75, rtol=1e-15)
    np.testing.assert_array_equal(threads.params.modulus, 2e3)
    np.testing.assert_array_equal(beam.fixed.all(axis=1), nodes[:, 0] == -1.75)
    np.testing.assert_array_equal(beam.fixed.any(axis=1), nodes[:, 0] == -1.75)
    np.testing.assert_array_equal(np.sort(beam.tip), np.flatnonzero(nodes[:, 0] == 1.75))
    assert jb.energy(beam, beam.mesh.nodes) == 0
    assert np.abs(jb.forces(beam, beam.mesh.nodes)).max() == 0


def test_energy_sums_the_terms(small):
    x = small.mesh.nodes + 0.02 * np.random.default_rng(0).normal(size=small.mesh.nodes.shape)
    scene = jb.command(small, [0.7, 1.1])
    alone = [jb.Scene(scene.mesh, (term,), scene.fixed) for term in scene.terms]
    np.testing.assert_allclose(jb.energy(scene, x), sum(float(jb.energy(s, x)) for s in alone), rtol=1e-14)
    # The forces of a body free in space sum to nothing, and turn it nowhere; reactions are theirs at the clamp.
    nodal = np.asarray(jb.forces(scene, x))
    size = np.abs(nodal).max()
    np.testing.assert_allclose(nodal.sum(axis=0), 0, atol=1e-13 * size)
    assert abs(np.sum(x[:, 0] * nodal[:, 1] - x[:, 1] * nodal[:, 0])) < 1e-12 * size
    np.testing.assert_array_equal(jb.reactions(scene, x), np.where(scene.fixed, -nodal, 0))


def test_rotated_scene_has_rotated_forces(small):
    """Tendons and body together have no preferred direction."""
    scene = jb.command(small, [0.7, 1.1])
    x = affine(scene.mesh, [[1.1, 0.2], [-0.1, 0.9]])
    R = rotation(1.0)
    turned = jb.forces(scene, jnp.asarray(np.asarray(x) @ R.T))
    np.testing.assert_allclose(turned, jb.forces(scene, x) @ R.T, atol=1e-12 * np.abs(turned).max())


# --------------------------------------------------------------------------------------- scenes as data


def test_leaves_are_floats_only(small):
    """Index arrays are structure: gradients and stacks of scenes meet only floats."""
    leaves = jax.tree.leaves(small)
    assert leaves
    assert all(leaf.dtype == jnp.float64 for leaf in leaves)
    same = jax.tree.map(lambda leaf: leaf, small)
    assert isinstance(same, jb.Scene)
    assert same.terms[0].nodes is small.terms[0].nodes
    assert jax.tree.structure(same) == jax.tree.structure(small) == jax.tree.structure(small_beam())
    other = small_beam(diagonals="mirrored")
    assert jax.tree.structure(other) != jax.tree.structure(small)


def test_stacked_scenes(small):
    """Scenes on one mesh stack, and `vmap` maps over them as a loop does."""
    scenes = [jb.command(small_beam(young=young), ratios) for young, ratios in ((1e4, [0.5, 1.0]), (2e4, [1.0, 0.8]))]
    x = affine(small.mesh, np.diag([0.9, 1.05]))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    together = jax.jit(jax.vmap(jb.energy, in_axes=(0, None)))(stacked, x)
    np.testing.assert_allclose(together, [float(jb.energy(s, x)) for s in scenes], rtol=1e-14)


def test_gradient_in_a_scene(small):
    """A scene is an argument that `jax.grad` understands; the energy is linear in the moduli."""
    x = affine(small.mesh, np.diag([0.9, 1.05]))
    slope = jax.jit(jax.grad(jb.energy))(small, x)
    assert isinstance(slope, jb.Scene)
    material = slope.terms[0].params.material
    params = small.terms[0].params.material
    parts = sum(float(jnp.sum(getattr(material, k) * getattr(params, k))) for k in ("mu", "lam"))
    parts += float(jnp.sum(slope.terms[1].params.modulus * small.terms[1].params.modulus))
    np.testing.assert_allclose(parts, jb.energy(small, x), rtol=1e-13)


def test_differentiable_in_every_real_argument():
    """A design is an ordinary function: differentiate energy at a fixed strain through the builder."""
    values = {"length": 3.5, "height": 0.8, "young": 1e4, "poisson": 0.45, "tendon_modulus": 2e3}

    @jax.jit
    def stretched(values):
        scene = jb.tendon_beam(5, 3, **values)
        return jb.energy(scene, scene.mesh.nodes * jnp.array([1.1, 0.95]))

    slopes = jax.jit(jax.grad(stretched))(values)
    for name, start in values.items():
        h = 1e-5 * start
        ahead, behind = (stretched(values | {name: start + step}) for step in (h, -h))
        # Relative step 1e-5: truncation 1e-10, round-off eps / 1e-5, times how fast 1 / (1 - 2 nu) varies (100).
        np.testing.assert_allclose(slopes[name], (ahead - behind) / (2 * h), rtol=1e-6)
        assert slopes[name] != 0


# ---------------------------------------------------------------------------------------------- command


@pytest.mark.parametrize("ratios", [[0.4, 1], (0.4, 1.0), np.array([0.4, 1.0], np.float32), jnp.array([0.4, 1.0])])
def test_command(small, ratios):
    scene = jb.command(small, ratios)
    np.testing.assert_allclose(scene.terms[1].params.commanded, [0.7, 1.75], rtol=1e-7)  # float32 0.4 is 6e-9 off
    np.testing.assert_array_equal(small.terms[1].params.commanded, [1.75, 1.75])  # a new scene, the old one as it was
    assert scene.terms[0] is small.terms[0]
    again = jb.command(scene, [1.0, 1.0])  # ratios are of the natural length, not of the last command
    np.testing.assert_array_equal(again.terms[1].params.commanded, small.terms[1].params.natural)


def test_command_numbers_tendons_through_all_terms():
    pair = jb.tendons(UNIT, [[0, 4], [1, 5]], 1.0)
    lone = jb.tendons(UNIT, [[0, 2]], 1.0, jb.constant_stiffness)
    scene = jb.command(jb.Scene(UNIT, (pair, BODY, lone), LEFT), [0.5, 0.6, 0.7])
    np.testing.assert_allclose(scene.terms[0].params.commanded, [1.0, 1.2])
    np.testing.assert_allclose(scene.terms[2].params.commanded, [0.7])


def test_command_without_tendons():
    scene = jb.Scene(UNIT, (BODY,), LEFT)
    assert jb.command(scene, np.zeros(0)).terms[0] is scene.terms[0]
    with pytest.raises(ValueError, match=r"ratios: expected shape \(0,\)"):
        jb.command(scene, [1.0])


@pytest.mark.parametrize(
    ("ratios", "message"),
    [
        ([0.4], r"ratios: expected shape \(2,\), one for each tendon, got \(1,\)"),
        (0.4, r"ratios: expected shape \(2,\), one for each tendon, got \(\)"),
        ([[0.4, 1.0]], r"ratios: expected shape \(2,\), one for each tendon, got \(1, 2\)"),
        ([0.4, 0.0], r"ratios: expected positive finite numbers, got \[0.4, 0.0\]; 1 is the natural length"),
        ([0.4, -1.0], r"ratios: expected positive finite numbers, got \[0.4, -1.0\]"),
        ([np.nan, 1.0], r"ratios: expected positive finite numbers, got \[nan, 1.0\]"),
        ([np.inf, 1.0], r"ratios: expected positive finite numbers, got \[inf, 1.0\]"),
    ],
)
def test_command_refuses(small, ratios, message):
    with pytest.raises(ValueError, match=message):
        jb.command(small, ratios)


# ---------------------------------------------------------------------------------------------- refused


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"fixed": np.zeros((6, 2))}, r"fixed: expected booleans of shape \(6, 2\), got .* float64; .*clamped"),
        ({"fixed": np.zeros(6, bool)}, r"fixed: expected booleans of shape \(6, 2\), got shape \(6,\)"),
        ({"fixed": np.ones((6, 2), bool)}, r"fixed: every coordinate is fixed, nothing is left to solve for"),
        ({"terms": ()}, r"terms: expected a tuple of at least one Term, got \(\)"),
        ({"terms": [BODY, 1]}, r"terms: expected a tuple of at least one Term, got \("),
        ({"terms": (BODY, jb.energy)}, r"terms: expected a tuple of at least one Term"),
        ({"tip": [6]}, r"tip: 6 is out of range, nodes are numbered 0 to 5"),
        ({"tip": [[4]]}, r"tip: expected whole numbers of shape \(m,\), got shape \(1, 1\)"),
        ({"tip": [4.0]}, r"tip: expected whole numbers of shape \(m,\), got .*float64"),
    ],
)
def test_scene_refuses(arguments, message):
    valid = {"mesh": UNIT, "terms": (BODY,), "fixed": LEFT, "tip": [4, 5]}
    jb.Scene(**valid)
    with pytest.raises(ValueError, match=message):
        jb.Scene(**(valid | arguments))


@pytest.mark.parametrize("fixed", [LEFT, LEFT.tolist(), jnp.asarray(LEFT)], ids=["numpy", "list", "jax"])
def test_scene_accepts(fixed):
    scene = jb.Scene(UNIT, (BODY,), fixed, tip=jnp.array([4, 5]))
    np.testing.assert_array_equal(scene.fixed, LEFT)
    assert scene.tip.dtype == np.int32
    assert not scene.fixed.flags.writeable
    assert not scene.tip.flags.writeable


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([6], r"nodes: 6 is out of range, nodes are numbered 0 to 5"),
        ([], r"nodes: expected whole numbers of shape \(m,\)"),
        ([0.0], r"nodes: expected whole numbers of shape \(m,\), got .*float64"),
    ],
)
def test_clamped_refuses(nodes, message):
    with pytest.raises(ValueError, match=message):
        jb.clamped(UNIT, nodes)


@pytest.mark.parametrize("graded", [True, "proportional"])
@pytest.mark.parametrize("nx", [3, 8, 11])
def test_tendons_of_a_graded_beam_end_in_the_middle(nx, graded):
    scene = jb.tendon_beam(nx, 5, graded=graded)
    ends = np.asarray(scene.mesh.nodes)[scene.terms[1].nodes]
    np.testing.assert_allclose(ends, [[[-1.75, 0.4], [0, 0.4]], [[-1.75, -0.4], [0, -0.4]]], atol=1e-15)


@pytest.mark.parametrize("nx", [2, 4, 28])
def test_beam_refuses_even_nx(nx):
    lower = nx - 1 if nx > 2 else 3
    with pytest.raises(ValueError, match=rf"nx: expected an odd number, got {nx}: no node .* use {lower} or {nx + 1}"):
        jb.tendon_beam(nx=nx)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ny": 1}, "ny: expected a whole number of at least 2, got 1"),
        ({"length": -1.0}, "length: expected a positive finite number"),
        ({"poisson": 0.5}, "poisson: expected a value in"),
        ({"young": 0.0}, "young: expected positive finite numbers"),
        (
            {"young": np.ones(3)},
            r"params\.mu: expected a scalar or 16 entries, one for each triangle, got shape \(3,\)",
        ),
        ({"tendon_modulus": 0.0}, "modulus: expected positive finite numbers"),
        ({"tendon_modulus": [1.0, 2.0, 3.0]}, "modulus: expected a scalar or 2 entries"),
        ({"diagonals": "both"}, "diagonals: expected 'one-sided', 'mirrored' or 'crossed', got 'both'"),
        ({"diagonals": "mirrored", "ny": 4}, "ny: expected an odd number for mirrored diagonals"),
    ],
)
def test_beam_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        jb.tendon_beam(**({"nx": 5, "ny": 3} | arguments))


# ------------------------------------------------------------------------------------------------ units


@pytest.mark.parametrize(
    ("law", "power"), [(jb.constant_stiffness, -1), (jb.inverse_stiffness, 0), (jb.inverse_square_stiffness, 1)]
)
@pytest.mark.parametrize(("length_unit", "force_unit"), [(1e3, 1.0), (39.37, 0.2248)])
def test_units(law, power, length_unit, force_unit):
    """Force scales as the force unit in every law, with the modulus in its documented unit (force x length^power)."""
    ratios = [0.7, 1.1]
    one = jb.command(jb.tendon_beam(5, 3, stiffness=law), ratios)
    two = jb.command(
        jb.tendon_beam(
            5,
            3,
            length=3.5 * length_unit,
            height=0.8 * length_unit,
            young=1e4 * force_unit / length_unit,
            tendon_modulus=2e3 * force_unit * length_unit**power,
            stiffness=law,
        ),
        ratios,
    )
    F = [[1.1, 0.2], [-0.1, 0.9]]
    first, second = jb.forces(one, affine(one.mesh, F)), jb.forces(two, affine(two.mesh, F))
    np.testing.assert_allclose(second, force_unit * first, atol=1e-12 * force_unit * np.abs(first).max())


# ----------------------------------------------------------------------------------------------- import


def test_import_changes_no_global_state():
    """Not JAX's configuration, not warnings, and matplotlib is not imported."""
    code = """
import jax, sys, warnings
before, filters = dict(jax.config.values), list(warnings.filters)
import jaxbeam
changed = {k for k, v in jax.config.values.items() if before.get(k, v) != v}
assert not changed, changed
assert warnings.filters == filters
assert not any(m.split(".")[0] == "matplotlib" for m in sys.modules)
jaxbeam.tendon_beam(5, 3)
assert dict(jax.config.values) == before
assert jaxbeam.tendon_beam(5, 3).mesh.nodes.dtype == "float32"
print("unchanged")
"""
    assert run_python(code) == "unchanged\n"


class Ground(NamedTuple):
    """Parameters of a user's own term, as a plain tuple with names."""

    stiffness: jax.Array
    height: jax.Array


def ground(x, params):
    return 0.5 * params.stiffness * jnp.sum((x[:, 1] - params.height) ** 2)


def test_parameters_may_be_any_pytree():
    """A named tuple and a dictionary in the place of a dataclass, as far as an equilibrium."""
    base = spring_pair(0.9)
    found = []
    values = {"stiffness": jnp.array([50.0]), "height": jnp.array([0.1])}
    for params in (Ground(**values), values):
        energy = ground if isinstance(params, Ground) else lambda x, p: ground(x, Ground(**p))
        own = jb.Term(energy, [[2]], params)
        scene = replace(base, terms=(*base.terms, own))
        found.append(jb.check(jb.equilibrium(scene, solver=jb.Newton(linear=jb.Dense()))).x)
    np.testing.assert_array_equal(*found)
    assert abs(found[0] - base.mesh.nodes).max() > 1e-3


def test_a_scene_prints_as_a_summary(beam):
    assert repr(jb.command(beam, [0.4, 1.0])) == (
        "Scene(3.5 x 0.8, 203 nodes, 336 triangles of 3 nodes, float64; 336 x solid (macklin_mueller), 2 x tendon; "
        "392 of 406 coordinates free; commands [0.4, 1])"
    )
    assert repr(beam.mesh) == "Mesh(203 nodes, 336 triangles of 3 nodes, float64)"
    assert "8 elements of 2 nodes" in repr(jb.rod_beam())
    said = []
    jax.eval_shape(lambda scene: said.append(repr(scene)), beam)
    assert "commands traced" in said[0]
    assert repr(jax.tree.map(lambda leaf: None, beam)) == "Scene(a tree of other values)"
