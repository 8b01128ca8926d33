"""Bodies that pass through themselves, judged beside a crossing test written in exact rational arithmetic."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import annulus, l_shape, rotation

import jaxbeam as jb
from jaxbeam.mesh.surface import surface
from jaxbeam.scene.overlap import crossing

crossed = jax.jit(crossing)


def cross_exactly(p, q, r, s) -> bool:
    """Whether the open segments `p q` and `r s` cross, without round-off."""
    p, q, r, s = ([Fraction(float(c)) for c in point] for point in (p, q, r, s))
    side = lambda a, b, c: (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    return side(p, q, r) * side(p, q, s) < 0 and side(r, s, p) * side(r, s, q) < 0


def pairs_that_cross(scene, x) -> set:
    edges = surface(scene.mesh)[:, :2]
    x = np.asarray(x)
    found = set()
    for i, (a, b) in enumerate(edges):
        for c, d in edges[:i]:
            if len({a, b, c, d}) == 4 and cross_exactly(x[a], x[b], x[c], x[d]):
                found.add(frozenset([frozenset([int(a), int(b)]), frozenset([int(c), int(d)])]))
    return found


@pytest.mark.parametrize("mesh", [jb.rectangle(3.5, 0.8, 9, 3), l_shape(), annulus()], ids=["beam", "L", "ring"])
def test_random_states_agree_with_exact_arithmetic(mesh):
    body = jb.solid(mesh, jb.lame(1.0, 0.3))
    scene = jb.Scene(mesh, (body,), jb.clamped(mesh, [0, 1]))
    rng = np.random.default_rng(3)
    seen = []
    for size in np.repeat([0.0, 0.05, 0.2, 0.5, 1.0], 8):
        x = np.asarray(mesh.nodes) + size * rng.standard_normal(mesh.nodes.shape)
        expected, found = pairs_that_cross(scene, x), np.asarray(crossed(scene, jnp.asarray(x)))
        seen.append(bool(expected))
        if expected:
            assert frozenset(frozenset(edge) for edge in found.tolist()) in expected
        else:
            np.testing.assert_array_equal(found, -1)
    assert 8 <= sum(seen) <= 32


@pytest.mark.parametrize("order", [1, 2])
def test_a_rolled_up_beam(order):
    """Rolled to an arc of `turn`: the ends meet at a full turn of the inner face."""
    scene = jb.tendon_beam(9, 5, order=order)
    rest = np.asarray(scene.mesh.nodes)

    def rolled(turn: float, shift: float = 0.0) -> np.ndarray:
        angle = turn * rest[:, 0] / 3.5
        radius = 3.5 / turn - rest[:, 1]
        return np.stack([radius * np.sin(angle), -radius * np.cos(angle) + shift * rest[:, 0]], axis=1)

    # The faces are polygons, whose chords lie inside the circle by less than a per cent here.
    assert (np.asarray(crossed(scene, jnp.asarray(rolled(0.97 * 2 * np.pi)))) == -1).all()
    assert (np.asarray(crossed(scene, jnp.asarray(rolled(1.05 * 2 * np.pi)))) >= 0).all()


def test_where_the_body_lies_and_how_it_is_turned_does_not_matter():
    # On a straight face round-off alone decides on which side of an edge the next but one lies.
    scene = jb.tendon_beam(29, 3)
    rest = np.asarray(scene.mesh.nodes)
    for angle in np.linspace(0, 6, 13):
        for shift in (0.0, 1e3, -1e6):
            for dtype in (np.float32, np.float64):
                x = rest @ rotation(angle).T + (shift if dtype == np.float64 else 1e-3 * shift)
                assert (np.asarray(crossed(scene, jnp.asarray(x, dtype))) == -1).all(), (angle, shift)


def test_the_curve_between_two_nodes_counts():
    """A middle node pushed through the opposite face, corners left in place."""
    mesh = jb.rectangle(4.0, 0.5, 3, 2, order=2)
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)),), jb.clamped(mesh, [0, 1]))
    x = np.asarray(mesh.nodes).copy()
    (edge,) = (e for e in surface(mesh) if np.allclose(x[e[2]], [-1, 0.25]))
    x[edge[2], 1] = -0.6
    found = np.asarray(crossed(scene, jnp.asarray(x)))
    assert {int(edge[0]), int(edge[1])} in [set(each) for each in found.tolist()]


def test_two_pieces():
    """Two separate squares: apart at rest, one moved into the other."""
    square = jb.rectangle(1.0, 1.0, 2, 2)
    nodes = np.asarray(square.nodes)
    mesh = jb.Mesh(
        np.concatenate([nodes, nodes + np.array([2.0, 0.1])]), np.concatenate([square.elements, square.elements + 4])
    )
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)),), jb.clamped(mesh, [0, 1, 4, 5]))
    assert (np.asarray(crossed(scene, mesh.nodes)) == -1).all()
    # Side by side: their faces lie in one line and touch, and corners of the one are on an edge of the other.
    beside = np.asarray(mesh.nodes) - np.repeat([[0.0, 0.0], [1.0, 0.0]], 4, axis=0)
    assert (np.asarray(crossed(scene, jnp.asarray(beside))) == -1).all()
    moved = np.asarray(mesh.nodes) - np.repeat([[0.0, 0.0], [1.5, 0.0]], 4, axis=0)
    assert (np.asarray(crossed(scene, jnp.asarray(moved))) >= 0).all()


def test_a_rod_that_runs_over_itself():
    scene = jb.rod_beam(33, height=0.2)
    rest = np.asarray(scene.mesh.nodes)

    def rolled(turn: float) -> jax.Array:
        s, radius = (rest[:, 0] + 1.75) / 3.5, 3.5 / turn
        return jnp.asarray(np.stack([radius * np.sin(turn * s), radius * (1 - np.cos(turn * s)), 0.2 * turn * s], 1))

    assert (np.asarray(crossed(scene, rolled(0.95 * 2 * np.pi))) == -1).all()
    assert (np.asarray(crossed(scene, rolled(1.08 * 2 * np.pi))) >= 0).all()


def test_a_scene_without_a_body_has_no_surface():
    from helpers import spring_pair

    assert int(jb.equilibrium(spring_pair(1.2)).status) == 0


# ------------------------------------------------------------------------------------------- in a solution


def test_the_reference_beam_from_ratio_02_down(beam):
    """Its end folds onto its root; the equilibrium stays the one that is known."""
    rows = jnp.array([[0.3, 1.0], [0.2, 1.0], [0.01, 1.0]])
    found = jb.sweep(beam, rows)
    np.testing.assert_array_equal(found.status, [0, jb.Status.OVERLAPPING, jb.Status.OVERLAPPING])
    np.testing.assert_allclose([jb.tip_angle(beam, x) for x in found.x[::2]], [37.2808447, 30.1032816], atol=1e-6)
    for x, edges in zip(found.x[1:], np.asarray(found.crossing)[1:], strict=True):
        assert frozenset(frozenset(edge) for edge in edges.tolist()) in pairs_that_cross(beam, x)
    (a, b), (c, d) = np.asarray(found.crossing)[1].tolist()
    with pytest.raises(jb.EquilibriumError, match=rf"OVERLAPPING in 2 of 3 .*edge {a}-{b} crosses {c}-{d}.*contact"):
        jb.check(found)


def test_an_overlapping_state_has_no_derivative_and_is_no_design(beam):
    slope = jax.grad(lambda r: jb.tip_angle(beam, jb.equilibrium(jb.command(beam, r)).x))(jnp.array([0.1, 1.0]))
    assert np.isnan(np.asarray(slope)).all()
    # 33 degrees are reached at ratio 0.443, and again at 0.1, where the body overlaps.
    found = jb.reach(beam, 33.0, bounds=((0.05, 1.0), (0.3, 1.0)), starts=[[0.1, 1.0]])
    assert found.status != jb.DesignStatus.REACHED or int(found.solution.status) == 0
