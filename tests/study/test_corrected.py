"""Measures corrected by a solve on two meshes: values, bars, derivatives, batches and refusals."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.mesh.surface import outline

CROSSED = partial(jb.tendon_beam, 7, 3, graded=True, diagonals="crossed", anchor_width=0.25)
CURVED = partial(jb.tendon_beam, 5, 3, order=2, graded=True, anchor_width=0.25)


def angle_and_tension(scene: jb.Scene, x: jax.Array) -> jax.Array:
    return jnp.stack([jb.tip_angle(scene, x), jb.tendon_tensions(scene, x)[0]])


@pytest.mark.parametrize(
    ("build", "ratios"), [pytest.param(CROSSED, [0.9, 1.0], marks=pytest.mark.slow), (CURVED, [0.5, 0.75])]
)
def test_fine_values_are_those_of_an_equilibrium_on_the_finer_mesh(build, ratios):
    meshes = jb.two_meshes(build())
    found = jb.corrected(meshes, ratios, angle_and_tension)
    scene = jb.command(meshes.fine, ratios)
    exact = jb.check(jb.equilibrium(scene))
    jb.check(found.solution)
    assert int(found.steps[1]) < int(exact.steps)
    np.testing.assert_allclose(found.fine, angle_and_tension(scene, exact.x), rtol=2e-5)
    assert np.all(np.abs(found.fine - angle_and_tension(scene, exact.x)) <= 2 * found.algebraic + 1e-9)
    assert np.isclose(found.solution.energy, jb.energy(scene, found.solution.x), rtol=1e-12)


@pytest.mark.parametrize("build", [CROSSED, pytest.param(CURVED, marks=pytest.mark.slow)])
def test_derivatives_are_those_of_differences(build):
    @jax.jit
    def value(theta):
        scene = build(young=1e4 * theta[2], tendon_modulus=2e3 * theta[3])
        return jb.corrected(jb.two_meshes(scene), theta[:2], angle_and_tension).value

    theta, h = jnp.array([0.7, 0.9, 1.1, 0.9]), 1e-3
    slopes = jax.jit(jax.jacrev(value))(theta)
    differences = [
        (8 * (value(theta + e) - value(theta - e)) - value(theta + 2 * e) + value(theta - 2 * e)) / (12 * h)
        for e in h * np.eye(4)
    ]
    np.testing.assert_allclose(slopes, np.stack(differences, axis=1), rtol=2e-4)


@pytest.mark.slow
def test_forward_and_reverse_derivatives_agree():
    value = lambda ratios: jb.corrected(jb.two_meshes(CURVED()), ratios, angle_and_tension).value
    reverse, forward = (jax.jit(jacobian(value))(jnp.array([0.7, 0.9])) for jacobian in (jax.jacrev, jax.jacfwd))
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)


def test_many_commands_are_each_like_one(terminal):
    meshes = jb.two_meshes(CROSSED())
    # A line of neighbours, and some far from each other.
    line = np.linspace([0.8, 1.0], [0.7, 0.95], 14)
    rows = np.concatenate([line, np.random.default_rng(2).uniform(0.5, 1.1, (6, 2))])
    calls = []
    many = jb.corrected(meshes, rows, angle_and_tension, progress=lambda *call: calls.append(call))
    assert calls == [(20, 60), (40, 60), (60, 60)] and terminal.getvalue() == ""
    jb.check(many.solution)
    # They draw themselves on the finer mesh.
    assert np.array_equal(many.solution.outline, outline(meshes.fine.mesh))
    for k in (0, 7, 19):
        one = jb.corrected(meshes, rows[k], angle_and_tension)
        assert np.array_equal(one.solution.outline, many.solution.outline)
        np.testing.assert_allclose(many.value[k], one.value, rtol=1e-4)
        np.testing.assert_allclose(many.bar[k], one.bar, rtol=0.1)
    jb.corrected(meshes, rows, angle_and_tension, progress=True)
    line, cursor = terminal.lines()
    assert "] 60 of 60 solves and bars, error bars, 0:" in line and cursor == ""


@pytest.mark.slow
def test_many_commands_inside_jit():
    meshes = jb.two_meshes(CROSSED())
    rows = np.array([[0.9, 1.0], [0.7, 0.8]])
    loss = lambda rows: jnp.sum(jb.corrected(meshes, rows, jb.tip_angle).value)
    slopes = jax.jit(jax.grad(loss))(rows)
    single = jax.grad(lambda row: jb.corrected(meshes, row, jb.tip_angle).value)(jnp.asarray(rows[1]))
    np.testing.assert_allclose(slopes[1], single, rtol=1e-9)
    mapped = jax.vmap(lambda row: jb.corrected(meshes, row, jb.tip_angle).value)(jnp.asarray(rows))
    assert np.isclose(jnp.sum(mapped), loss(rows), rtol=1e-5)


FEW = jb.Newton(max_steps=12)


def test_a_failed_solve_has_no_bar():
    found = jb.corrected(jb.two_meshes(CROSSED()), [0.02, 0.02], jb.tip_angle, FEW)
    assert found.solution.status & jb.Status.NOT_CONVERGED and np.isinf(found.bar)


@pytest.mark.slow
def test_a_failed_solve_spoils_no_other():
    meshes, rows = jb.two_meshes(CROSSED()), jnp.array([[0.9, 1.0], [0.02, 0.02]])
    found = jb.corrected(meshes, rows, jb.tip_angle, FEW)
    assert found.solution.status[0] == 0 and np.isfinite(found.bar[0]) and np.isinf(found.bar[1])
    slope = jax.grad(lambda rows: jb.corrected(meshes, rows, jb.tip_angle, FEW).value[0])(rows)
    assert np.all(np.isfinite(slope[0])) and np.all(slope[1] == 0)


@pytest.mark.slow
def test_other_kinds_of_physics():
    """Weight and contact, and a cable through a guide in small units, against a mesh twice as fine as the finer one."""
    for scene, ratios in (leaning(), guided()):
        meshes = jb.two_meshes(scene)
        found = jb.corrected(meshes, ratios, jb.tip_angle)
        jb.check(found.solution)
        finest = jb.command(jb.enriched(meshes.fine)[0], ratios)
        exact = jb.tip_angle(finest, jb.check(jb.equilibrium(finest)).x)
        assert abs(found.value - exact) < found.bar < 0.1 * abs(exact)
        assert abs(found.value - exact) < 0.2 * abs(found.coarse - exact)


def leaning() -> tuple[jb.Scene, list[float]]:
    """A cantilever under its weight, whose tip lies on a half-plane."""
    mesh = jb.rectangle(3.5, 0.8, 15, 5, order=2)
    left, right = (jb.nodes_where(mesh, lambda x, y, s=s: s * x > 1.74) for s in (-1, 1))
    lower = jb.nodes_where(mesh, lambda x, y: y < -0.399)
    floor = jb.contact(mesh, lower, jb.half_plane([0.0, -0.6], [0.0, 1.0]), 1e5, 0.01)
    terms = jb.solid(mesh, jb.lame(1e4, 0.45)), jb.weight(mesh, [0.0, -14.0]), floor
    return jb.Scene(mesh, terms, jb.clamped(mesh, left), right), [0.0]


def guided() -> tuple[jb.Scene, list[float]]:
    """A cantilever of 35 mm, in metres, with a cable through a guide."""
    mesh = jb.rectangle(0.035, 0.008, 15, 5, "crossed")
    left, right = (jb.nodes_where(mesh, lambda x, y, s=s: s * x > 0.0174) for s in (-1, 1))
    line = [jb.nearest_node(mesh, [x, 0.004]) for x in (-0.0175, 0.0, 0.0125)]
    cable = jb.cables(mesh, [line], 40.0, width=np.array([[0.0, 0.0025, 0.0025]]))
    return jb.Scene(mesh, (jb.solid(mesh, jb.lame(1e6, 0.45)), cable), jb.clamped(mesh, left), right), [0.8]


def test_point_anchors_have_no_bar():
    meshes = jb.two_meshes(jb.tendon_beam(7, 3))
    assert "single node" in meshes.doubt
    found = jb.corrected(meshes, [0.9, 1.0], jb.tip_angle)
    assert np.isinf(found.bar) and found.solution.status == 0 and found.doubt & jb.Doubt.SCENE


def test_each_measure_has_its_own_doubts():
    meshes = jb.two_meshes(CURVED())
    measure = lambda scene, x: jnp.stack([jb.tip_angle(scene, x), jb.smallest_jacobian(scene, x)])
    found = jb.corrected(meshes, [0.8, 1.0], measure)
    assert found.doubt[0] == jb.Doubt.NONE and np.isfinite(found.bar[0])
    assert jb.Doubt(int(found.doubt[1])) & (jb.Doubt.WORST | jb.Doubt.CORNER) and np.isinf(found.bar[1])


@pytest.mark.slow
def test_a_surface_that_may_crease_has_no_bar():
    scene = jb.tendon_beam(9, 5, order=2, graded=True, length=1.6, anchor_width=0.25)
    found = jb.corrected(jb.two_meshes(scene), [[0.95, 1.0], [0.6, 1.0]], jb.tip_angle)
    assert found.doubt.tolist() == [jb.Doubt.NONE, jb.Doubt.CREASE] and np.isinf(found.bar[1])


@pytest.mark.slow
def test_float32():
    meshes = jb.two_meshes(CROSSED(dtype=jnp.float32))
    found = jb.corrected(meshes, [0.6, 1.0], jb.tip_angle)
    jb.check(found.solution)
    assert found.value.dtype == found.bar.dtype == jnp.float32
    exact = jb.corrected(jb.two_meshes(CROSSED()), [0.6, 1.0], jb.tip_angle)
    assert np.isclose(found.value, exact.value, rtol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((jb.tendon_beam(5, 3), [1.0, 1.0], jb.tip_angle), "meshes: .*two_meshes"),
        ((None, [1.0], jb.tip_angle), "2"),
        ((None, [[-0.5, 1.0]], jb.tip_angle), "ratios"),
        ((None, np.ones((2, 2, 2)), jb.tip_angle), "ratios: expected shape"),
        ((None, [1.0, 1.0], 3), "measure"),
    ],
)
def test_refusals(arguments, words):
    meshes, *rest = arguments
    with pytest.raises(ValueError, match=words):
        jb.corrected(meshes if meshes is not None else jb.two_meshes(CROSSED()), *rest)


def test_a_rod_has_no_finer_mesh():
    with pytest.raises(ValueError, match="rod"):
        jb.two_meshes(jb.rod_beam())


def test_traced_nodes_are_refused():
    scene = CROSSED()
    with pytest.raises(ValueError, match="known nodes"):
        jax.eval_shape(jb.two_meshes, scene)
