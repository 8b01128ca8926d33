"""Measures on states whose answer is known by hand, and on the reference solution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import affine, rotation, small_beam

import jaxbeam as jb
from jaxbeam.scene.evaluation import smallest_jacobian

UNIT = jb.rectangle(2.0, 1.0, 3, 2)
BODY = jb.solid(UNIT, jb.lame(10.0, 0.3))
LEFT = jb.clamped(UNIT, [0, 1])
BARE = jb.Scene(UNIT, (BODY,), LEFT)


@pytest.fixture(scope="module")
def small():
    return small_beam()


@pytest.mark.parametrize("rise", [-3.0, 0.0, 0.5, 4.0])
def test_tip_angle(small, rise):
    """By definition `atan2(mean rise of the right edge, length)`; moving along the beam does not count."""
    x = np.array(small.mesh.nodes)
    x[small.tip, 1] += rise + np.array([-0.1, 0.0, 0.1])
    x[small.tip, 0] -= 0.7
    expected = np.degrees(np.arctan2(rise, 3.5))
    np.testing.assert_allclose(jb.tip_angle(small, jnp.asarray(x)), expected, atol=1e-12)


@pytest.mark.parametrize("name", ["tip_angle", "tendon_tensions", "cauchy_stress", "nodal_stress", "reactions"])
def test_a_measure_is_one_program(name, caplog):
    """Of a shape that no other test has. Operation by operation there would be ten and more of them."""
    scene = jb.tendon_beam(9, 2)
    x = jnp.asarray(scene.mesh.nodes)
    jb.tip_position(scene, x)
    with jax.log_compiles():
        getattr(jb, name)(scene, x)
    compiled = [record.getMessage() for record in caplog.records if "Finished XLA compilation" in record.getMessage()]
    assert len(compiled) == 1
    assert name in compiled[0]


@pytest.mark.parametrize("angle", [0.5, np.pi / 2, -2.5])
def test_measures_turn_with_the_scene(angle):
    """A beam that points anywhere: the tip angle is measured from its own axis."""
    R = rotation(angle)
    mesh = jb.Mesh(np.asarray(UNIT.nodes) @ R.T, UNIT.elements)
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(10.0, 0.3)),), LEFT, tip=np.array([4, 5]))
    moved = np.array(UNIT.nodes)
    moved[4:] += [-0.2, 0.9]
    x = jnp.asarray(moved @ R.T)
    np.testing.assert_allclose(jb.tip_angle(scene, x), np.degrees(np.arctan2(0.9, 2.0)), atol=1e-12)
    np.testing.assert_allclose(jb.tip_position(scene, x), R @ [0.8, 0.9], atol=1e-14)


@pytest.mark.parametrize("angle", [-170.0, -1e-3, 0.0, 35.0, 179.0])
def test_section_rotation_of_rigid_turn(small, angle):
    x = affine(small.mesh, rotation(np.radians(angle)), shift=(3.0, -1.0))
    np.testing.assert_allclose(jb.section_rotation(small, x), angle, atol=1e-11)
    stretched = affine(small.mesh, rotation(np.radians(angle)) @ np.diag([1.3, 0.6]))
    np.testing.assert_allclose(jb.section_rotation(small, stretched), angle, atol=1e-11)


def test_section_rotation_is_least_squares(small):
    """No other rigid turn of the tip fits its nodes better."""
    rng = np.random.default_rng(0)
    x = np.asarray(affine(small.mesh, rotation(0.4))) + 0.05 * rng.normal(size=small.mesh.nodes.shape)
    rest, tip = np.asarray(small.mesh.nodes)[small.tip], x[small.tip]
    rest, tip = rest - rest.mean(axis=0), tip - tip.mean(axis=0)
    misfit = lambda degrees: np.sum((rest @ rotation(np.radians(degrees)).T - tip) ** 2)
    best = float(jb.section_rotation(small, jnp.asarray(x)))
    assert all(misfit(best) < misfit(best + d) for d in (-90, -1, -0.01, 0.01, 1, 90))


def test_lengths_and_tensions(small):
    scene = jb.command(small, [0.4, 1.2])
    x = affine(scene.mesh, np.diag([0.8, 1.0]))
    length = 0.8 * 1.75
    np.testing.assert_allclose(jb.tendon_lengths(scene, x), [length, length], rtol=1e-14)
    commanded = np.array([0.4, 1.2]) * 1.75
    np.testing.assert_allclose(jb.tendon_tensions(scene, x), 2e3 / commanded**2 * (length - commanded), rtol=1e-13)


def test_tension_is_the_derivative_of_the_energy(steered):
    """Of the whole scene's energy, in the length: reel in the anchor node along the tendon."""
    scene, solution = steered
    line = scene.terms[1].nodes[0]
    direction = solution.x[line[1]] - solution.x[line[0]]
    unit = direction / jnp.linalg.norm(direction)
    thread = jb.Scene(scene.mesh, (scene.terms[1],), scene.fixed)
    other = jb.tendon_tensions(scene, solution.x)[1]
    assert abs(other) > 1
    h = 1e-6
    end = int(line[1])
    shifted = [jb.energy(thread, solution.x.at[end].add(s * h * unit)) for s in (1, -1)]
    tension = (shifted[0] - shifted[1]) / (2 * h)
    np.testing.assert_allclose(jb.tendon_tensions(scene, solution.x)[0], tension, rtol=1e-7)


def test_reference_tension(steered):
    """956.0 at ratio 0.4, to its printed digit; the stiffness at rest would give 153."""
    scene, solution = steered
    assert round(float(jb.tendon_tensions(scene, solution.x)[0]), 1) == 956.0


def test_stress_is_symmetric_and_turns(small):
    x = affine(small.mesh, [[1.1, 0.2], [-0.1, 0.9]])
    R = rotation(0.7)
    stress = np.asarray(jb.cauchy_stress(small, x))
    assert stress.shape == (16, 2, 2)
    size = np.abs(stress).max()
    np.testing.assert_allclose(stress, np.swapaxes(stress, 1, 2), atol=1e-13 * size)
    turned = np.asarray(jb.cauchy_stress(small, jnp.asarray(np.asarray(x) @ R.T)))
    np.testing.assert_allclose(turned, R @ stress @ R.T, atol=1e-12 * size)


def test_energies_add_up(steered):
    scene, solution = steered
    elastic = jax.jit(jb.strain_energy)(scene, solution.x)
    assert elastic.shape == (336,)
    assert (np.asarray(elastic) > 0).all()
    stretch = jb.tendon_lengths(scene, solution.x) - scene.terms[1].params.commanded
    in_tendons = 0.5 * jb.tendon_tensions(scene, solution.x) * stretch
    np.testing.assert_allclose(elastic.sum() + in_tendons.sum(), solution.energy, rtol=1e-12)


def test_jacobians(steered):
    scene, solution = steered
    J = jax.jit(jb.jacobians)(scene, solution.x)
    np.testing.assert_allclose(J.min(), smallest_jacobian(scene, solution.x), rtol=1e-14)
    np.testing.assert_allclose(J.min(), solution.smallest_jacobian, rtol=1e-14)
    # J is the area ratio of each triangle.
    areas = [np.linalg.det(x[:, 1:] - x[:, :1]) for x in (solution.x[scene.mesh.elements],)]
    rest = scene.mesh.nodes[scene.mesh.elements]
    np.testing.assert_allclose(J, areas[0] / np.linalg.det(rest[:, 1:] - rest[:, :1]), rtol=1e-12)


def test_several_solids_are_joined():
    """Measures per element run through all solid terms, in order."""
    scene = jb.Scene(UNIT, (BODY, jb.solid(UNIT, jb.lame(5.0, 0.3))), LEFT)
    x = affine(UNIT, np.diag([1.1, 1.0]))
    one = jb.cauchy_stress(BARE, x)
    np.testing.assert_allclose(jb.cauchy_stress(scene, x), np.concatenate([one, 0.5 * one]), rtol=1e-13)


def test_nothing_to_measure():
    x = UNIT.nodes
    assert jb.tendon_lengths(BARE, x).shape == jb.tendon_tensions(BARE, x).shape == (0,)
    load = jb.Scene(UNIT, (jb.dead_load(UNIT, [3], [0.0, 1.0]),), LEFT)
    assert jb.strain_energy(load, x).shape == (0,)
    assert np.isinf(smallest_jacobian(load, x))
    for measure in (jb.cauchy_stress, jb.jacobians):
        with pytest.raises(ValueError, match="scene: expected a solid term, got none"):
            measure(load, x)


@pytest.mark.parametrize("measure", [jb.tip_angle, jb.tip_position, jb.section_rotation])
def test_tip_measures_refuse_a_scene_without_tip(measure):
    with pytest.raises(ValueError, match=r"scene: its tip is empty; give Scene\(\.\.\., tip=nodes\)"):
        measure(BARE, UNIT.nodes)


def test_tip_angle_refuses_a_scene_without_clamp():
    scene = jb.Scene(UNIT, (BODY,), np.zeros((6, 2), bool), tip=np.array([4, 5]))
    with pytest.raises(ValueError, match="scene: no node is clamped, so the beam has no axis"):
        jb.tip_angle(scene, UNIT.nodes)


def test_section_rotation_refuses_one_node():
    scene = jb.Scene(UNIT, (BODY,), LEFT, tip=np.array([4]))
    with pytest.raises(ValueError, match="scene: expected at least two tip nodes to measure a rotation, got 1"):
        jb.section_rotation(scene, UNIT.nodes)


@pytest.mark.parametrize("measure", [jb.tip_angle, jb.section_rotation])
def test_measures_differentiate_at_rest(small, measure):
    """The slope of an angle in the rise of the tip, at rest where naive formulas divide by zero."""
    rise = jnp.zeros(small.mesh.nodes.shape).at[small.tip, 1].set(1.0)
    turn = affine(small.mesh, rotation(np.pi / 2))  # X -> perpendicular, an infinitesimal turn
    direction = rise if measure is jb.tip_angle else turn
    _, slope = jax.jvp(lambda x: measure(small, x), (small.mesh.nodes,), (direction,))
    expected = np.degrees(1 / 3.5) if measure is jb.tip_angle else np.degrees(1.0)
    np.testing.assert_allclose(slope, expected, rtol=1e-12)
