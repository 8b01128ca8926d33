"""The judge of answers itself: its energies agree with the library's, and it finds every error that is planted."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import scene_of
from scipy.linalg import eigh

import jaxbeam as jb
from tests.energies import Problem, Tendons, facts
from tests.geometry import crossings, lowest_place, patch, quadratic, slopes, volumes
from tests.verify import OVERLAPPING, refuted_slope, verify

COMMAND = np.array([0.7, 1.0])


def beam(order: int = 1, bent: float = 0.0, diagonals: str = "one-sided", **changes) -> Problem:
    """A beam of 5 x 3 corners, clamped at its left end; `bent` makes an arch of it, with curved edges."""
    mesh = jb.rectangle(3.5, 0.8, 5, 3, diagonals, order=order)
    nodes = np.asarray(mesh.nodes)
    fixed = np.repeat(nodes[:, :1] < -1.7, 2, axis=1)
    nodes = nodes + bent * np.stack([0 * nodes[:, 0], nodes[:, 0] ** 2], axis=1)
    pulls = (Tendons(np.array([[2, 8], [0, 6]]), 2e3, "inverse-square"),)
    raw = Problem(nodes, mesh.elements, fixed, 1e4, 0.45, "macklin_mueller", pulls)
    return dataclasses.replace(raw, **changes)


def rod(material: str) -> Problem:
    """A curved rod of 5 nodes, turned and moved, with tendons beside its axis and a moment at its end."""
    turn = np.linspace(0.3, 1.1, 5)
    nodes = np.stack([2 * np.sin(turn), -2 * np.cos(turn), 0.5 * turn], axis=1) + np.array([3.0, 1.0, 0.0])
    pairs, fixed = np.stack([np.arange(4), np.arange(1, 5)], axis=1), np.zeros((5, 3), bool)
    fixed[0] = True
    pulls = (Tendons(np.array([[0, 2, 4], [0, 1, 3]]), [2e3, 1e3], "inverse", aside=[[0.3, 0.2, 0.3], [-0.3] * 3]),)
    load = np.zeros((5, 3))
    load[4] = [1.0, -2.0, 3.0]
    return Problem(nodes, pairs, fixed, 1e4, 0.3, material, pulls, load=load, height=0.7, radian=0.5)


def everything() -> Problem:
    """Curved six-node elements of different stiffness, wide anchors, groups of two laws, guides, loads, an offset."""
    raw = beam(2, 0.05)
    groups = (
        Tendons(np.array([[2, 8], [0, 6]]), [2e3, 1e3], "inverse-square", [[0.0, 1.1], [0.3, 0.9]]),
        Tendons(np.array([[1, 7, 13]]), 3e3, "constant"),
    )
    rng = np.random.default_rng(0)
    young, load = 10 ** rng.uniform(3, 5, len(raw.elements)), np.zeros(raw.nodes.shape)
    load[[9, 14]] = [[3.0, -5.0], [2.0, 0.0]]
    return dataclasses.replace(raw, nodes=raw.nodes + np.array([7.0, -5.0]), young=young, tendons=groups, load=load)


PROBLEMS = {"solid": everything, **{name: lambda name=name: rod(name) for name in ("macklin_mueller", "neo_hookean")}}


# Of the rods one is enough: the judge's densities are compared with the library's in test_properties.py.
@pytest.mark.parametrize("kind", ["solid", "macklin_mueller", pytest.param("neo_hookean", marks=pytest.mark.slow)])
def test_energy_and_forces_are_the_librarys(kind):
    raw = PROBLEMS[kind]()
    ratios = np.array([0.8, 1.1, 0.9])[: sum(len(t.lines) for t in raw.tendons)]
    scene = jb.command(scene_of(raw), ratios)
    x = raw.nodes + 0.03 * np.random.default_rng(1).normal(size=raw.nodes.shape) * ~raw.fixed
    true = facts(raw, ratios, x, dense=False)
    np.testing.assert_allclose(true.energy, jb.energy(scene, x), rtol=1e-12)
    gradient = np.asarray(jax.jit(jax.grad(jb.energy, argnums=1))(scene, jnp.asarray(x)))
    np.testing.assert_allclose(true.gradient, gradient[~raw.fixed], atol=1e-12 * true.scale_sum)
    if raw.is_rod:
        np.testing.assert_allclose(true.volumes.min(), jb.smallest_jacobian(scene, x), rtol=1e-12)


def test_patch_is_a_mean_under_a_tent():
    """On a straight side it is symmetric: the mean is the anchor, and that of squares is `width^2 / 6` more."""
    for order in (1, 2):
        mesh = jb.rectangle(4.0, 1.0, 9, 3, order=order)
        nodes = np.asarray(mesh.nodes)
        weights = patch(nodes, mesh.elements, 14, 1.0)
        # The shape function of the last corner is zero under the tent, on average.
        assert np.count_nonzero(np.abs(weights) > 1e-12) == (5 if order == 1 else 7)
        np.testing.assert_allclose(weights @ nodes, nodes[14], atol=1e-15)
        if order == 2:
            np.testing.assert_allclose(weights @ (nodes[:, 0] - nodes[14, 0]) ** 2, 1 / 6, rtol=1e-13)


# Barycentric coordinates of a fine grid on a triangle.
GRID = np.array([[1 - a - b, a, b] for a in np.linspace(0, 1, 101) for b in np.linspace(0, 1, 101) if a + b < 1 + 1e-9])


def test_least_of_a_quadratic_is_that_of_dense_samples():
    """Of random ones, some are least inside, some on an edge and some at a corner."""
    values = np.random.default_rng(0).normal(size=(100, 6))
    place = lowest_place(values)
    samples = np.stack([quadratic(values, np.tile(place, (100, 1))) for place in GRID])
    least = quadratic(values, place)
    assert (least <= samples.min(axis=0) + 1e-12).all()
    np.testing.assert_allclose(least, samples.min(axis=0), atol=1e-3)
    assert set(np.count_nonzero(place < 1e-9, axis=1)) == {0, 1, 2}


@pytest.mark.parametrize("curved", [0.0, 0.03])
def test_least_volume_is_that_of_dense_samples(curved):
    """No sample is below it, one is as near as the grid allows, and the bound is not above it."""
    rng = np.random.default_rng(0)
    corners = np.array([[0, 0], [1, 0], [0, 1], [0.5, 0], [0.5, 0.5], [0, 0.5]])
    rest = corners + curved * rng.normal(size=(100, 6, 2))
    x = rest + 0.15 * rng.normal(size=rest.shape)
    found, by = volumes(x, rest), slopes(6, GRID)
    det = lambda y: np.linalg.det(np.einsum("tkd,qki->tqdi", y, by))
    samples = (det(x) / det(rest)).min(axis=1)
    assert (found.least <= samples + 1e-12).all() and (found.bound <= found.least + 1e-12).all()
    np.testing.assert_allclose(found.least, samples, atol=1e-3)


# -------------------------------------------------------------------------------------------- crossings


def rolled(raw: Problem, turn: float, swell: float = 0.0) -> np.ndarray:
    """The beam bent into an arc of a circle of `turn` radians, whose radius grows by `swell` from end to end."""
    along, up = raw.nodes[:, 0] / 3.5 + 0.5, raw.nodes[:, 1]
    radius = 3.5 / turn + swell * along - up
    return np.stack([radius * np.sin(turn * along), -radius * np.cos(turn * along)], axis=1)


@pytest.mark.parametrize("order", [1, 2])
def test_crossings_of_a_beam_that_is_rolled_up(order):
    raw = beam(order)
    fine = dataclasses.replace(raw, **dict(zip(("nodes", "elements"), _long(order), strict=True)))
    for turn, sure, possible in ((0.1, False, False), (1.9 * np.pi, False, False), (2.1 * np.pi, True, True)):
        found = crossings(rolled(fine, turn, 0.1), fine.elements)
        assert (len(found.sure) > 0, found.possible) == (sure, possible), turn
    # The ends touch: left open.
    found = crossings(rolled(fine, 2 * np.pi * (1 - 1e-6)), fine.elements)
    assert not len(found.sure) and found.possible


def _long(order: int) -> tuple[np.ndarray, np.ndarray]:
    mesh = jb.rectangle(3.5, 0.2, 25, 3, order=order)
    return np.asarray(mesh.nodes), mesh.elements


# ---------------------------------------------------------------------------------------- planted errors


def claiming(answer: jb.Solution, **claims) -> jb.Solution:
    """An answer that claims something else."""
    return dataclasses.replace(jax.tree.map(np.asarray, answer), **{k: np.asarray(v) for k, v in claims.items()})


def words(raw: Problem, answer: jb.Solution, command: np.ndarray = COMMAND, **claims) -> str:
    return " ".join(verify(raw, command, claiming(answer, **claims)).refuted)


@pytest.fixture(scope="module")
def solved() -> tuple[Problem, jb.Solution]:
    raw = beam()
    return raw, jb.check(jb.equilibrium(jb.command(scene_of(raw), COMMAND)))


def test_honest_answers_are_not_refuted(solved):
    assert words(*solved) == ""
    raw = rod("macklin_mueller")
    ratios = np.array([0.9, 1.0])
    assert words(raw, jb.equilibrium(jb.command(scene_of(raw), ratios)), ratios) == ""


def test_an_equilibrium_elsewhere_is_refuted(solved):
    """A hundredth of the body along the softest mode, where the forces balance best."""
    raw, answer = solved
    free, hessian = ~raw.fixed, facts(raw, COMMAND, np.asarray(answer.x)).hessian
    mode = eigh(hessian, subset_by_index=[0, 0])[1][:, 0]
    x = np.asarray(answer.x).copy()
    x[free] += 1e-2 * raw.size * mode / np.abs(mode).max()
    found = words(raw, answer, x=x)
    assert "of the body away" in found and "over the tolerance" in found


def test_a_saddle_is_refuted():
    raw, ratios = beam(diagonals="mirrored"), np.array([0.3, 0.3])
    raw = dataclasses.replace(raw, nodes=raw.nodes * [1.0, 0.5])
    answer = jb.equilibrium(jb.command(scene_of(raw), ratios), solver=jb.Newton(escape=False))
    assert answer.status & jb.Status.UNSTABLE
    assert "but an eigenvalue is -" in words(raw, answer, ratios, status=0)


def test_an_element_inverted_inside_alone_is_refuted():
    raw = beam(2)
    answer = jb.equilibrium(jb.command(scene_of(raw), COMMAND))
    least = facts(raw, COMMAND, np.asarray(answer.x), dense=False).volumes.min()
    assert words(raw, answer, smallest_jacobian=least, status=0) == ""
    # The node between two corners at the tip, far towards one of them, where the map folds.
    x, edge = np.asarray(answer.x).copy(), raw.elements[-1, [1, 4, 2]]
    x[edge[1]] = x[edge[0]] + 0.2 * (x[edge[2]] - x[edge[0]])
    at_points = quadrature_volume(raw, x)
    assert at_points > 0
    assert "but not INVERTED" in words(raw, answer, x=x, smallest_jacobian=at_points, status=0)


def quadrature_volume(raw: Problem, x: np.ndarray) -> float:
    by = slopes(6, np.array([[2 / 3, 1 / 6, 1 / 6], [1 / 6, 2 / 3, 1 / 6], [1 / 6, 1 / 6, 2 / 3]]))
    det = lambda y: np.linalg.det(np.einsum("tkd,qki->tqdi", y[raw.elements], by))
    return float((det(x) / det(raw.nodes)).min())


def test_a_surface_that_crosses_itself_is_refuted(solved):
    raw, answer = solved
    assert "cross (" in words(raw, answer, x=rolled(raw, 2.3 * np.pi))
    assert "cross (" not in words(raw, answer, x=rolled(raw, 2.3 * np.pi), status=OVERLAPPING)
    assert "OVERLAPPING, but" in words(raw, answer, status=OVERLAPPING)


def test_a_wrong_slope_is_refuted(solved):
    raw, answer = solved
    scene = scene_of(raw)
    place = lambda r: jb.tip_position(scene, jb.equilibrium(jb.command(scene, r)).x)
    slope = np.asarray(jax.jacfwd(place)(jnp.asarray(COMMAND)))
    assert refuted_slope(raw, COMMAND, answer.x, scene.tip, slope) == []
    (found,) = refuted_slope(raw, COMMAND, answer.x, scene.tip, slope * 1.00001)
    assert "slope off by 1e-05" in found


def test_a_scale_of_what_is_clamped_hides_nothing(solved):
    """A tendon of modulus 1e12 between clamped nodes leaves the relative residual as it was."""
    raw, answer = solved
    wild = dataclasses.replace(raw, tendons=(*raw.tendons, Tendons(np.array([[0, 2]]), 1e12, "inverse-square")))
    ratios = np.append(COMMAND, 0.5)
    x = np.asarray(answer.x) + 1e-5 * ~raw.fixed * np.cos(np.arange(len(raw.nodes)))[:, None]
    held = facts(wild, ratios, x)
    energies = {"energy": held.energy, "smallest_jacobian": held.volumes.min(), "ratios": ratios}
    honest = {**energies, "energy": facts(wild, ratios, np.asarray(answer.x)).energy}
    honest["smallest_jacobian"] = answer.smallest_jacobian
    assert words(wild, answer, ratios, **honest) == ""
    assert "over the tolerance" in words(wild, answer, ratios, x=x, **energies)


@pytest.mark.parametrize("name", ["correction", "energy", "x"])
def test_a_silent_nan_is_refuted(solved, name):
    raw, answer = solved
    assert "not finite" in words(raw, answer, **{name: np.full(np.shape(getattr(answer, name)), np.nan)})


def test_quadratic_mesh_is_judged_by_the_same_order_of_nodes():
    """Nodes 3, 4 and 5 lie between corners (0, 1), (1, 2) and (2, 0): a straight element has `J = 1` everywhere."""
    mesh = jb.rectangle(2.0, 1.0, 3, 2, order=2)
    rest = np.asarray(mesh.nodes)[mesh.elements]
    np.testing.assert_allclose(volumes(2 * rest, rest), 4.0, rtol=1e-14)
