"""What an energy says of itself: a user's own kind, defined here, has the rights of those of the package."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam import plot
from jaxbeam.core.tree import replace
from jaxbeam.physics.tendon import polyline_length
from jaxbeam.plot.lines import line_names
from jaxbeam.scene.evaluation import largest_step, worst_element
from jaxbeam.scene.scene import commands_of, is_valid, partway, rest_commands

BEAM = jb.tendon_beam(5, 3)


@dataclasses.dataclass(frozen=True)
class Wire(jb.Energy):
    """A wire under a tension that is commanded: the energy is the tension times the length."""

    name: ClassVar[str] = "wire"
    rest_command: ClassVar[float | None] = 0.0

    def __call__(self, x, params):
        return params["tension"] * polyline_length(x)

    def command(self, params, values):
        return params | {"tension": jnp.asarray(values)}

    def command_of(self, params):
        return params["tension"]

    def valid(self, params):
        return jnp.all(params["tension"] < 1e3)

    def margin(self, x, params):
        return params["room"] - jax.vmap(polyline_length)(x)

    def longest_step(self, x, dx, params, keep):
        return jnp.full(len(x), 0.25)

    def measured(self, x, params):
        return {"length": jax.vmap(polyline_length)(x), "tension": params["tension"]}

    def line(self, x, params):
        return x


def with_wire(energy=Wire(), room=10.0):
    """The small beam with its top tendon replaced by a wire along the top."""
    body, pulls = BEAM.terms
    bottom = jb.tendons(BEAM.mesh, pulls.nodes[1:], 2e3)
    wire = jb.Term(energy, pulls.nodes[:1], {"tension": np.zeros(1), "room": np.full(1, room)})
    return jb.Scene(BEAM.mesh, (body, wire, bottom), BEAM.fixed, BEAM.tip)


SCENE = with_wire()


def test_commands_of_several_kinds_are_numbered_through():
    np.testing.assert_array_equal(rest_commands(SCENE), [0, 1])
    pulled = jb.command(SCENE, [40.0, 0.9])
    np.testing.assert_allclose(commands_of(pulled), [40, 0.9], rtol=1e-15)
    np.testing.assert_allclose(commands_of(partway(pulled, 0.25)), [10, 0.975], rtol=1e-15)
    with pytest.raises(ValueError, match=r"positive finite numbers.*natural length"):
        jb.command(SCENE, [40.0, -0.9])
    jb.command(SCENE, [-40.0, 0.9])  # a wire may be told to push


def test_a_wire_pulls_with_its_command():
    """It is solved, ramped from rest and measured like a tendon; the energy's slope in the command is its length."""
    pulled = jb.command(SCENE, [40.0, 1.0])
    found = jb.check(jb.equilibrium(pulled))
    path = jb.check(jb.ramp(SCENE, [40.0, 1.0], steps=3))
    np.testing.assert_allclose(path.x[-1], found.x, atol=1e-9)
    np.testing.assert_array_equal(path.x[0], BEAM.mesh.nodes)
    np.testing.assert_allclose(path.ratios, [[0, 1], [20, 1], [40, 1]])
    np.testing.assert_allclose(jb.tendon_tensions(pulled, found.x)[0], 40)
    length = jb.tendon_lengths(pulled, found.x)[0]
    slope = jax.grad(lambda t: jb.equilibrium(jb.command(SCENE, jnp.stack([t, 1.0]))).energy)(40.0)
    # The force balance of the solve leaves the energy's slope off by its square.
    np.testing.assert_allclose(slope, length, rtol=1e-9)
    assert float(jb.tip_angle(pulled, found.x)) > 0.1


def test_what_it_says_of_ranges_and_bounds_is_heard():
    assert bool(is_valid(jb.command(SCENE, [40.0, 1.0]))) and not bool(is_valid(jb.command(SCENE, [2e3, 1.0])))
    tight = with_wire(room=1.0)
    margin, number = worst_element(tight, BEAM.mesh.nodes)
    assert float(margin) == pytest.approx(-0.75) and int(number) == len(BEAM.mesh.elements)
    assert float(largest_step(SCENE, BEAM.mesh.nodes, 1e-9 * BEAM.mesh.nodes, 0.1)) == 0.25


def test_bounds_of_commands_are_in_the_range_of_each_kind():
    with pytest.raises(ValueError, match=r"expected 0 < low <= high, got low \[-5.0, -0.5\]"):
        jb.reach(SCENE, 1.0, bounds=([-5.0, -0.5], [50.0, 1.0]))


def test_it_is_drawn_under_its_own_name():
    assert line_names(SCENE) == ["wire 1", "tendon 2"]
    ax = plot.beam(SCENE, BEAM.mesh.nodes)
    ends = np.asarray(BEAM.mesh.nodes)[SCENE.terms[1].nodes[0]]
    assert any(np.array_equal(np.transpose(line.get_data()), ends) for line in ax.get_lines())


@dataclasses.dataclass(frozen=True)
class RefinableWire(Wire):
    """The same, tied to nodes that a finer mesh has too."""

    def refined(self, term, mesh, finer):
        return term


def test_a_term_that_cannot_be_refined_is_named():
    scene = jb.command(with_wire(), [5.0, 1.0])
    estimate = jb.estimate_error(scene, jb.equilibrium(scene), jb.tip_angle)
    assert estimate.bar == np.inf and estimate.reason.startswith("terms[1] (wire) has no form on a finer mesh")
    with pytest.raises(jb.NotRefinable, match=r"terms\[1\] \(wire\)"):
        jb.enriched(scene)
    assert not jb.solve_to(scene, jb.tip_angle, 1.0).met
    finer, _ = jb.enriched(jb.command(with_wire(RefinableWire()), [5.0, 1.0]))
    np.testing.assert_array_equal(commands_of(finer), [5, 1])


def bare(x, params):
    return params["pull"] * x[0, 0]


def test_a_bare_function_has_safe_defaults():
    term = jb.Term(bare, [[12]], {"pull": np.ones(1)})
    scene = jb.Scene(BEAM.mesh, (*BEAM.terms, term), BEAM.fixed, BEAM.tip)
    np.testing.assert_array_equal(rest_commands(scene), [1, 1])
    assert line_names(scene) == ["tendon 1", "tendon 2"]
    assert "terms[2] (term)" in jb.estimate_error(scene, jb.equilibrium(scene), jb.tip_angle).reason


# ------------------------------------------------------------------------------------------------ cables


def cabled(transition=0.01):
    body, pulls = BEAM.terms
    cables = jb.cables(BEAM.mesh, pulls.nodes, 2e3, transition=transition)
    return jb.Scene(BEAM.mesh, (body, cables), BEAM.fixed, BEAM.tip)


@pytest.fixture(scope="module")
def reference():
    """The reference scene with cables, which become taut over a thousandth of their length."""
    plain = jb.tendon_beam()
    cables = jb.cables(plain.mesh, plain.terms[1].nodes, 2e3, transition=1e-3)
    return jb.Scene(plain.mesh, (plain.terms[0], cables), plain.fixed, plain.tip)


def test_a_slack_cable_does_nothing():
    """Longer than its ends are apart: no energy, no force, exactly. A two-way tendon would push."""
    scene = jb.command(cabled(), [1.2, 1.1])
    found = jb.check(jb.equilibrium(scene))
    np.testing.assert_array_equal(found.x, BEAM.mesh.nodes)
    np.testing.assert_array_equal(jb.tendon_tensions(scene, found.x), 0)
    assert float(found.energy) == 0
    pushed = jb.command(BEAM, [1.2, 1.1])
    assert (np.asarray(jb.tendon_tensions(pushed, jb.equilibrium(pushed).x)) < 0).all()


def test_the_reference_beam_with_cables(reference):
    """At (0.6, 1.4) the slack one reads exactly zero, and the angle is 24.06 degrees.

    Two-way tendons give 27.345: there the longer one pushes."""
    scene = jb.command(reference, [0.6, 1.4])
    found = jb.check(jb.equilibrium(scene))
    tensions = np.asarray(jb.tendon_tensions(scene, found.x))
    assert tensions[1] == 0 and tensions[0] > 500
    assert abs(float(jb.tip_angle(scene, found.x)) - 24.06) < 0.01


@pytest.mark.parametrize("target", [10.0, -10.0])
def test_reach_from_rest_where_no_cable_pulls_yet(reference, target):
    """Where a cable begins to pull, the angle has no slope in the ratio. One of them pulls in the end."""
    found = jb.reach(reference, target)
    assert found.status == jb.DesignStatus.REACHED and found.solves <= 8
    np.testing.assert_allclose(found.value, target, atol=1e-8)
    assert np.sort(np.asarray(found.theta))[1] == 1 and 0.7 < np.min(found.theta) < 0.8


def test_a_taut_cable_is_a_tendon_of_a_longer_command():
    """Beyond the transition `w` its tension is `k (l - l* - w / 2)`."""
    scene = jb.command(cabled(), [0.8, 1.0])
    x = jb.check(jb.equilibrium(scene)).x
    params, length = scene.terms[1].params, jb.tendon_lengths(scene, x)
    k = params.modulus / params.commanded**2
    taut = k * (length - params.commanded - params.transition / 2)
    tension = jb.tendon_tensions(scene, x)
    np.testing.assert_allclose(tension[0], taut[0], rtol=1e-12)
    assert float(tension[1]) >= 0


def test_energy_tension_and_stiffness_of_a_cable_are_continuous():
    """The tension is the slope of the energy, on both sides of both ends of the transition."""
    term = cabled(0.1).terms[1]
    params = jax.tree.map(lambda leaf: leaf[0], term.params)
    # From slack to taut along a straight cable; the natural length is 1.75, so the transition is 0.175.
    ends = lambda s: jnp.array([[0.0, 0.0], [params.commanded + s, 0.0]])
    energy = lambda s: term.kind(ends(s), params)
    for s in (-0.1, 0.0, 0.05, 0.175, 0.3):
        np.testing.assert_allclose(jax.grad(energy)(s), term.kind.tension(ends(s), params), rtol=1e-13, atol=1e-15)
    stiffness = jax.grad(jax.grad(energy))
    k = float(params.modulus / params.commanded**2)
    for s, expected in ((-1e-9, 0), (1e-9, 0), (0.0875, k / 2), (0.175 - 1e-9, k), (0.175 + 1e-9, k)):
        np.testing.assert_allclose(stiffness(s), expected, rtol=1e-7, atol=1e-5)


def test_a_cable_is_refined_as_a_cable():
    mesh = jb.rectangle(3.5, 0.8, 5, 3)
    body = jb.solid(mesh, jb.lame(1e4, 0.45))
    pulls = jb.cables(mesh, [[2, 8]], 2e3, width=0.4, transition=0.02)
    scene = jb.command(jb.Scene(mesh, (body, pulls), jb.clamped(mesh, [0, 1, 2]), [12, 13, 14]), [0.9])
    finer = jb.enriched(scene)[0].terms[1]
    assert type(finer.kind) is type(pulls.kind)
    np.testing.assert_allclose(finer.params.transition, pulls.params.transition)
    np.testing.assert_allclose(finer.params.commanded, scene.terms[1].params.commanded)


def test_a_traced_transition_out_of_range_is_invalid():
    term = cabled().terms[1]
    broken = replace(term, params=replace(term.params, transition=jnp.full(2, -1.0)))
    assert not bool(is_valid(replace(BEAM, terms=(BEAM.terms[0], broken))))


# --------------------------------------------------------------------------- studies speak of any command


def tip(scene, x):
    return jb.tip_angle(scene, x)


def test_reach_finds_a_tension():
    """The wire is pulled as little as bends the beam by half a degree. Bounds of a tension must be given."""
    with pytest.raises(ValueError, match="bounds: only ratios"):
        jb.reach(SCENE, 0.5, tip)
    found = jb.reach(SCENE, 0.5, tip, bounds=([-100.0, 1.0], [100.0, 1.0]))
    assert int(found.status) == jb.DesignStatus.REACHED
    solved = jb.command(SCENE, found.theta)
    np.testing.assert_allclose(tip(solved, jb.equilibrium(solved).x), 0.5, atol=1e-8)


@pytest.mark.slow
def test_sweep_and_branch_of_a_tension():
    rows = np.array([[-20.0, 1.0], [0.0, 0.9], [30.0, 1.0]])
    batch = jb.check(jb.sweep(SCENE, rows))
    for row, x in zip(rows, batch.x, strict=True):
        np.testing.assert_allclose(x, jb.equilibrium(jb.command(SCENE, row)).x, atol=1e-9)
    with pytest.raises(ValueError, match=r"ratios\[1:2\]: expected positive"):
        jb.sweep(SCENE, [[-20.0, -1.0]])
    branch = jb.trace_branch(SCENE, [30.0, 1.0], step=0.5)
    np.testing.assert_allclose(branch.ratios[0], [0, 1])
    np.testing.assert_allclose(branch.ratios[:, 0], 30 * branch.parameter)
