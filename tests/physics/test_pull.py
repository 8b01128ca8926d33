"""Cables commanded by tension, and lines with different numbers of guides."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference

import jaxbeam as jb

BEAM = jb.tendon_beam(9, 5)
TOP, BOTTOM = np.asarray(BEAM.terms[1].nodes)


def with_terms(*terms):
    return jb.Scene(BEAM.mesh, (BEAM.terms[0], *terms), BEAM.fixed, BEAM.tip)


@pytest.fixture(scope="module")
def mixed():
    """The top line pulled by tension, the bottom one a tendon commanded by length."""
    return with_terms(jb.pulls(BEAM.mesh, TOP[None]), jb.tendons(BEAM.mesh, BOTTOM[None], 2e3))


def test_tension_and_length_agree_at_the_same_state(mixed):
    by_length = jb.command(BEAM, [0.7, 1.0])
    found = jb.check(jb.equilibrium(by_length))
    tension = float(jb.tendon_tensions(by_length, found.x)[0])
    pulled = jb.command(mixed, [tension, 1.0])
    for x in (jb.check(jb.equilibrium(pulled)).x, jb.check(jb.ramp(mixed, [tension, 1.0], 3)).x[-1]):
        np.testing.assert_allclose(x, found.x, atol=1e-10)
    np.testing.assert_allclose(jb.tendon_tensions(pulled, found.x), jb.tendon_tensions(by_length, found.x), rtol=1e-9)
    np.testing.assert_allclose(jb.tendon_lengths(pulled, found.x), jb.tendon_lengths(by_length, found.x), rtol=1e-14)


def test_without_tension_nothing_happens(mixed):
    found = jb.check(jb.equilibrium(mixed))
    np.testing.assert_array_equal(found.x, BEAM.mesh.nodes)
    assert found.energy == 0 and jb.tendon_tensions(mixed, found.x)[0] == 0


def test_its_slopes_and_sweep(mixed):
    angle = lambda c: jb.tip_angle(mixed, jb.equilibrium(jb.command(mixed, c)).x)
    at = jnp.array([150.0, 0.9])
    np.testing.assert_allclose(jax.grad(angle)(at), central_difference(angle, at, 1e-4), rtol=1e-6)
    # From rest, where a cable without tension begins to pull.
    slope = jax.grad(angle)(jnp.array([0.0, 1.0]))[0]
    np.testing.assert_allclose(slope, (angle(jnp.array([1e-3, 1.0])) - 0) / 1e-3, rtol=1e-4)
    rows = np.array([[0.0, 1.0], [100.0, 0.9], [200.0, 1.0]])
    batch = jb.check(jb.sweep(mixed, rows))
    for row, x in zip(rows, batch.x, strict=True):
        np.testing.assert_allclose(x, jb.equilibrium(jb.command(mixed, row)).x, atol=1e-9)


def test_reach_finds_a_tension_from_rest(mixed):
    found = jb.reach(mixed, 6.0, bounds=([0.0, 0.5], [500.0, 1.0]))
    assert found.status == jb.DesignStatus.REACHED
    np.testing.assert_allclose(found.value, 6.0, atol=1e-7)


def test_bad_tensions_are_refused(mixed):
    with pytest.raises(ValueError, match=r"at least 0.*a cable only pulls"):
        jb.command(mixed, [-1.0, 1.0])
    with pytest.raises(ValueError, match=r"tension: expected .* at least 0"):
        jb.pulls(BEAM.mesh, TOP[None], -1.0)
    with pytest.raises(ValueError, match=r"bounds: expected 0 <= low <= high"):
        jb.reach(mixed, 1.0, bounds=([-1.0, 0.5], [500.0, 1.0]))
    status = jax.jit(lambda t: jb.equilibrium(jb.command(mixed, jnp.stack([t, 1.0]))).status)
    assert int(status(-1.0)) & jb.Status.INVALID and int(status(1.0)) == 0


# ------------------------------------------------------------------------------------------------- guides

# Node `(i, j)` of the beam is `5 i + j`.
GUIDES = [[4, 14, 24], [0, 20], [3, 9, 13, 23]]


@pytest.mark.parametrize(
    "build", [lambda rows: jb.tendons(BEAM.mesh, rows, 2e3), lambda rows: jb.pulls(BEAM.mesh, rows)]
)
def test_lines_of_different_lengths_in_one_term(build):
    """As a term for each line."""
    together = with_terms(build(GUIDES))
    apart = with_terms(*(build([row]) for row in GUIDES))
    commands = np.array([0.8, 0.9, 0.95]) if build(GUIDES).kind.rest_command else np.array([120.0, 40.0, 60.0])
    one, other = (jb.command(scene, commands) for scene in (together, apart))
    found, expected = jb.check(jb.equilibrium(one)), jb.check(jb.equilibrium(other))
    np.testing.assert_allclose(found.x, expected.x, atol=1e-11)
    for measure in (jb.tendon_lengths, jb.tendon_tensions):
        np.testing.assert_allclose(measure(one, found.x), measure(other, found.x), rtol=1e-12)


def test_lines_of_different_lengths_with_widths():
    rows = [[4, 24], [0, 10, 20]]
    scene = with_terms(jb.tendons(BEAM.mesh, rows, 2e3, width=0.2))
    apart = with_terms(*(jb.tendons(BEAM.mesh, [row], 2e3, width=0.2) for row in rows))
    np.testing.assert_allclose(jb.tendon_lengths(scene, BEAM.mesh.nodes), jb.tendon_lengths(apart, BEAM.mesh.nodes))


@pytest.mark.parametrize("build", [jb.tendons, jb.cables, jb.pulls])
def test_lines_of_different_lengths_are_refined(build):
    rows, width = [[4, 24, 34], [0, 20]], [[0.0, 0.2, 0.2], [0.0, 0.3, 0.3]]
    term = build(BEAM.mesh, rows, 50.0, width=width)
    scene = jb.Scene(BEAM.mesh, (BEAM.terms[0], term), BEAM.fixed, BEAM.tip)
    finer, _ = jb.enriched(scene)
    x = scene.mesh.nodes
    np.testing.assert_allclose(jb.tendon_lengths(finer, finer.mesh.nodes), jb.tendon_lengths(scene, x), rtol=1e-12)


def test_a_cable_through_guides_on_its_way_is_the_straight_one():
    """Guides on the line between its ends, at rest and while it is moved as a whole."""
    straight, guided = jb.tendons(BEAM.mesh, [[4, 24]], 2e3), jb.tendons(BEAM.mesh, [[4, 9, 14, 19, 24]], 2e3)
    np.testing.assert_allclose(guided.params.natural, straight.params.natural, rtol=1e-14)
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    x = np.asarray(BEAM.mesh.nodes) @ (1.3 * turn.T)
    lengths = [float(jb.tendon_lengths(with_terms(term), x)[0]) for term in (straight, guided)]
    np.testing.assert_allclose(lengths[1], lengths[0], rtol=1e-13)


def test_forces_on_guides():
    """They balance, and turn a line of one tension: at an end it is the tension, at a guide the sum of two pulls."""
    scene = jb.command(with_terms(jb.tendons(BEAM.mesh, GUIDES, 2e3)), [0.8, 0.9, 0.95])
    found = jb.check(jb.equilibrium(scene))
    (forces,), tension = jb.guide_forces(scene, found.x), np.asarray(jb.tendon_tensions(scene, found.x))
    assert forces.shape == (3, 4, 2)
    np.testing.assert_allclose(np.sum(forces, axis=1), 0, atol=1e-11)
    for line, row, pull in zip(GUIDES, np.asarray(forces), tension, strict=True):
        points = np.asarray(found.x)[line]
        units = np.diff(points, axis=0)
        units = pull * units / np.linalg.norm(units, axis=1, keepdims=True)
        expected = np.zeros((4, 2))
        expected[: len(line)] = np.concatenate([units, np.zeros((1, 2))]) - np.concatenate([np.zeros((1, 2)), units])
        np.testing.assert_allclose(row, expected, atol=1e-10 * pull)
    # They are what the tendons do to the nodes.
    total = np.zeros(found.x.shape)
    for line, row in zip(GUIDES, np.asarray(forces), strict=True):
        np.add.at(total, line, row[: len(line)])
    tendons = scene.terms[1]
    other = np.zeros(found.x.shape)
    np.add.at(other, tendons.nodes, -np.asarray(tendons.kind.gradients(found.x[tendons.nodes], tendons.params)[1]))
    np.testing.assert_allclose(total, other, atol=1e-10)
