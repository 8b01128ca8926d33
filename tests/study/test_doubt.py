"""Where no bound of a discretisation error is known, it says so; where one is known, it holds."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import l_shape

import jaxbeam as jb
from jaxbeam.core.tree import replace
from jaxbeam.study import accuracy
from jaxbeam.study.doubt import SOFT, corners, scene_doubt, softest, stiffness_of_half_space, widening

CROSSED = {"order": 2, "graded": True, "diagonals": "crossed", "anchor_width": 0.25}


def tension(scene, x):
    return jb.tendon_tensions(scene, x)[0]


def largest_stress(scene, x):
    return jnp.max(jb.von_mises_stress(scene, x))


def strain_energy(scene, x):
    return jnp.sum(jb.strain_energy(scene, x))


def pulled(ratio, *size, **settings):
    scene = jb.command(jb.tendon_beam(*size, **settings), [ratio, 1.0])
    return scene, jb.check(jb.equilibrium(scene))


@pytest.fixture(scope="module")
def beam():
    return pulled(0.8, 9, 4, order=2, anchor_width=0.25)


# --------------------------------------------------------------------------------- bars that did not hold


@pytest.mark.parametrize(
    ("size", "settings", "ratio", "exact"),
    [
        ((17, 6), CROSSED, 0.8, 10.14404),
        pytest.param((13, 5), CROSSED, 0.95, 2.048405, marks=pytest.mark.slow),
        pytest.param((29, 7), {"order": 2, "anchor_width": 0.25}, 0.65, 21.11009, marks=pytest.mark.slow),
    ],
)
def test_bars_where_parts_of_opposite_sign_cancel(size, settings, ratio, exact):
    """The tip angle, against meshes of up to 48 x 32 cells that were extrapolated to within 0.0012 %."""
    scene, solution = pulled(ratio, *size, **settings)
    found = jb.estimate_error(scene, solution, jb.tip_angle)
    assert found.reason == "" and abs(exact - found.value) < found.bar < 4 * abs(exact - found.value)


# ------------------------------------------------------------------------------------- known from the scene


@pytest.mark.parametrize("width", [0.001, 0.005])
def test_an_anchor_that_is_narrow_beside_the_elements_has_no_bar(width):
    """The nodes on the surface of 15 columns are 0.125 apart; with 0.005 the angle is 8.71 degrees, not 9.78."""
    scene = jb.tendon_beam(15, 5, order=2, anchor_width=width)
    reason = scene_doubt(scene)
    assert "too narrow" in reason and f"{width:g}" in reason and "distances of 0.125" in reason
    # A mesh that is as fine as it asks for is fine enough.
    columns = 1 + 2 * int(np.ceil(3.5 / 2 / (9 * width)))
    assert scene_doubt(jb.tendon_beam(columns, 3, anchor_width=width)) == ""


def test_bars_of_anchors_narrower_than_the_nodes_are_apart_are_wider():
    """By once for each halving that it takes until the nodes are as close as the anchor is wide."""
    for width, factor in ((0.5, 1), (0.125, 1), (0.0625, 2), (0.03125, 3)):
        assert widening(jb.tendon_beam(15, 5, order=2, anchor_width=width)) == pytest.approx(factor)
    assert widening(jb.rod_beam()) == 1


def test_solve_to_says_that_an_anchor_is_too_narrow():
    scene = jb.command(jb.tendon_beam(7, 3, order=2, anchor_width=0.005), [0.8, 1.0])
    answer = jb.solve_to(scene, jb.tip_angle, 0.1)
    assert not answer.met and answer.estimate.bar == np.inf and answer.rung == 0
    assert answer.reason == answer.estimate.reason and "too narrow" in answer.reason


def test_a_guide_without_width_is_a_point_load():
    """Also where the end of the same tendon is wide."""
    mesh = jb.rectangle(3.5, 0.8, 15, 5)
    line = [jb.nearest_node(mesh, [x, 0.4]) for x in (-1.75, -0.75, 0.0)]
    clamp = jb.clamped(mesh, jb.nodes_where(mesh, lambda x, y: x < -1.7))
    body = jb.solid(mesh, jb.lame(1e4, 0.45))
    for width, reason in ((0.0, "single node"), (0.25, "")):
        scene = jb.Scene(mesh, (body, jb.tendons(mesh, [line], 2e3, width=[[0.0, width, 0.25]])), clamp)
        assert (reason in scene_doubt(scene)) if reason else scene_doubt(scene) == ""


# ---------------------------------------------------------------------------------- known from the measure


def test_measures_at_a_point_load_have_no_bar(beam):
    """The displacement there, the elastic energy and the energy; away from it there is a bar, and it holds."""
    scene, _ = beam
    node = jb.nearest_node(scene.mesh, [1.75, 0.4])
    loaded = lambda scene: replace(scene, terms=(*scene.terms, jb.dead_load(scene.mesh, [node], [0.0, -20.0])))
    heavy = loaded(scene)
    finest, _ = jb.enriched(jb.enriched(heavy)[0])
    solution, exact = (jb.check(jb.equilibrium(each)) for each in (heavy, finest))
    for measure in (lambda s, x: x[node, 1], strain_energy, jb.energy):
        found = jb.estimate_error(heavy, solution, measure)
        assert found.bar == np.inf and "point load" in found.reason
    for measure in (jb.tip_angle, tension):
        found = jb.estimate_error(heavy, solution, measure)
        assert found.reason == "" and abs(float(measure(finest, exact.x)) - found.value) < found.bar


def test_worst_values_in_the_body_have_no_bar(beam):
    """They lie at the clamp in the end. The stress at a node away from it has a bar, and so have means."""
    for measure in (jb.smallest_jacobian, largest_stress):
        found = jb.estimate_error(*beam, measure)
        assert found.bar == np.inf and "infinite" in found.reason
    scene, _ = beam
    corner, face = (jb.nearest_node(scene.mesh, place) for place in ([-1.75, 0.4], [-0.875, -0.4]))
    assert "an end of a clamp" in jb.estimate_error(*beam, lambda s, x: jb.nodal_stress(s, x)[corner, 0, 0]).reason
    for measure in (lambda s, x: jb.nodal_stress(s, x)[face, 0, 0], strain_energy, jb.energy, jb.section_rotation):
        assert jb.estimate_error(*beam, measure).reason == ""


def test_corners_are_ends_of_the_clamp_and_hollows_of_the_body():
    mesh = jb.rectangle(2.0, 1.0, 5, 3)
    held = jb.clamped(mesh, jb.nodes_where(mesh, lambda x, y: x < -0.9))
    body = jb.solid(mesh, jb.lame(1.0, 0.3))
    np.testing.assert_array_equal(np.flatnonzero(corners(jb.Scene(mesh, (body,), held))), [0, 2])
    mesh = l_shape()
    scene = jb.Scene(
        mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)),), jb.clamped(mesh, jb.nodes_where(mesh, lambda x, y: x < -0.9))
    )
    x = np.asarray(mesh.nodes)[corners(scene)]
    np.testing.assert_allclose(x[np.argsort(x[:, 0])], [[-1, -1], [-1, 1], [0, 0]], atol=1e-12)


# ------------------------------------------------------------------------------------------------ creases


def share(stretch, density, material):
    """Stiffness left on the surface of a half-space that is compressed along it and free across, by bisection."""
    stress = jax.jit(lambda b: jax.grad(density)(jnp.diag(jnp.stack([stretch - 1, b - 1])), material)[1, 1])
    low, high = 0.5, 4.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if stress(middle) > 0 else (middle, high)
    second, along = jax.jit(jax.hessian(density)), jnp.array([1.0, 0.0])
    moduli = [second(H, material) for H in (jnp.diag(jnp.array([stretch, middle])) - jnp.eye(2), jnp.zeros((2, 2)))]
    now, rest = (float(stiffness_of_half_space(A, along)) for A in moduli)
    return now / rest


@pytest.mark.parametrize("density", [jb.macklin_mueller, jb.neo_hookean])
def test_a_nearly_incompressible_surface_wrinkles_at_biots_stretch(density):
    """0.5437, where `s^3 + s^2 + 3 s = 1` for the square `s` of the stretch; a crease at 0.647 has 0.35 left."""
    material = jb.lame(1.0, 0.49999)
    square = next(root.real for root in np.roots([1, 1, 3, -1]) if abs(root.imag) < 1e-9)
    assert np.sqrt(square) == pytest.approx(0.5437, abs=1e-4)
    assert share(np.sqrt(square), density, material) == pytest.approx(0, abs=1e-3)
    assert share(0.647, density, material) == pytest.approx(0.35, abs=0.01)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49])
@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_stiffness_of_an_isotropic_half_space(poisson, turn):
    """In linear elasticity the eigenvalues are `2 mu` and `2 mu / (3 - 4 nu)`, whatever the direction."""
    material = jb.lame(1.0, poisson)
    A = jax.hessian(jb.linear_elastic)(jnp.zeros((2, 2)), material)
    found = stiffness_of_half_space(A, jnp.array([np.cos(turn), np.sin(turn)]))
    assert float(found) == pytest.approx(2 * float(material.mu) / (3 - 4 * poisson), rel=1e-9)


def test_a_crease_is_said():
    """A beam of two heights at ratio 0.6: a fine mesh has a tension of 604 where this one has 815."""
    scene, solution = pulled(0.6, 9, 5, length=1.6, order=2, graded=True, anchor_width=0.25)
    found = jb.estimate_error(scene, solution, tension)
    assert found.bar == np.inf and "may crease" in found.reason and "0.4)" in found.reason
    answer = jb.solve_to(scene, tension, 69.0)
    assert not answer.met and "may crease" in answer.reason
    scene = jb.command(scene, [0.75, 1.0])
    assert jb.estimate_error(scene, jb.check(jb.equilibrium(scene)), tension).reason == ""


@pytest.mark.slow
def test_the_softest_piece_is_the_same_on_every_mesh(beam):
    """Under the pulled tendon 0.830 and stretched by 0.881 on fine meshes; at rest all is stiff; a rod has none."""
    finer, _ = jb.enriched(beam[0])
    found = [softest(corners(scene), scene, jb.equilibrium(scene).x) for scene in (beam[0], finer)]
    for each in found:
        assert float(each.share) == pytest.approx(0.83, abs=0.05) and each.share > SOFT
        assert float(each.stretch) == pytest.approx(0.881, abs=0.04) and float(each.place[1]) == 0.4
    again = jax.jit(partial(softest, corners(beam[0])))(beam[0], beam[1].x)
    np.testing.assert_allclose(again.share, found[0].share, rtol=1e-12)
    assert float(softest(corners(finer), finer, finer.mesh.nodes).share) == pytest.approx(1, rel=1e-12)
    rod = jb.rod_beam()
    assert softest(corners(rod), rod, rod.mesh.nodes).share == np.inf


# ------------------------------------------------------------------------------------------------ solve_to


def test_solve_to_starts_from_no_inverted_element(beam):
    """Where a Newton step inverts an element, the positions carried over from the coarser mesh are taken."""
    scene, solution = beam
    finer, way = jb.enriched(scene)
    carried = way.carry(np.asarray(solution.x))
    moved = carried.copy()
    moved[finer.tip] -= 1.0
    assert float(jb.smallest_jacobian(finer, jnp.asarray(moved))) < 0
    assert accuracy._usable(finer, moved, carried) is carried
    assert accuracy._usable(finer, moved * np.nan, carried) is carried
    assert accuracy._usable(finer, 1.01 * carried, moved) is not moved


@pytest.mark.slow
def test_solve_to_goes_on_where_it_was_refused(monkeypatch):
    """At ratio 0.4, were it not for the crease, a step on the third mesh inverts an element: `J` is -0.025."""
    monkeypatch.setattr(accuracy, "_doubt_of_state", lambda *arguments: "")
    scene, _ = pulled(0.4, 9, 5, order=2, graded=True, anchor_width=0.25)
    answer = jb.solve_to(scene, tension, 40.0)
    assert answer.met or answer.reason


def test_solve_to_says_why_it_stops(beam):
    scene, _ = beam
    large = jb.solve_to(scene, jb.tip_angle, 1e-9, most=100)
    assert not large.met and "unknowns, more than the 100" in large.reason
    fine = jb.solve_to(scene, jb.tip_angle, 1e-300)
    assert not fine.met and "round-off" in fine.reason
    assert jb.solve_to(scene, jb.tip_angle, 10.0).reason == ""
