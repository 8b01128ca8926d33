"""Follower pressure against closed forms: resultants, a thick ring, reactions, and the transformations it must bear."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import annulus, central_difference, disturbed

import jaxbeam as jb
from jaxbeam.mesh.elements import element_of

YOUNG, POISSON = 1e4, 0.3


def arch(order=1, value=0.0):
    """A beam clamped at both ends, with pressure on its upper side."""
    mesh = jb.rectangle(4.0, 0.4, 13, 3, "crossed", order=order)
    upper = jb.nodes_where(mesh, lambda x, y: y > 0.1999)
    ends = jb.nodes_where(mesh, lambda x, y: abs(x) > 1.9999)
    terms = jb.solid(mesh, jb.lame(YOUNG, POISSON), jb.neo_hookean), jb.pressure(mesh, upper, value)
    middle = jb.nodes_where(mesh, lambda x, y: (abs(x) < 1e-9) & (abs(y) < 1e-9))
    return jb.Scene(mesh, terms, jb.clamped(mesh, ends), middle)


def edges_of(mesh):
    """The edges of all elements, as corner, corner and the node between."""
    edges = np.asarray(mesh.elements)[:, np.array(element_of(mesh.elements).edges)]
    return np.unique(edges.reshape(-1, 3), axis=0)


def ring(order=1, inner=1.0, outer=2.0, around=48, across=9):
    """A ring with pressure on its inside, held so that it may only widen."""
    mesh = annulus(around, across)
    unit = np.asarray(mesh.nodes)
    radius = np.linalg.norm(unit, axis=1)
    low, high = radius.min(), radius.max()
    nodes = unit / radius[:, None] * (inner + (radius - low) / (high - low) * (outer - inner))[:, None]
    mesh = jb.Mesh(nodes, mesh.elements)
    if order == 2:
        mesh = jb.quadratic(mesh)
        # Nodes between others lie on the circle, too.
        nodes = np.array(mesh.nodes)
        for a, b, m in edges_of(mesh):
            middle = nodes[a] + nodes[b]
            nodes[m] = middle / np.linalg.norm(middle) * (np.linalg.norm(nodes[a]) + np.linalg.norm(nodes[b])) / 2
        mesh = jb.Mesh(nodes, mesh.elements)
    place = np.asarray(mesh.nodes)
    fixed = np.zeros(place.shape, bool)
    fixed[(np.abs(place[:, 1]) < 1e-9), 1] = True
    fixed[(np.abs(place[:, 0]) < 1e-9), 0] = True
    inside = np.flatnonzero(np.linalg.norm(place, axis=1) < inner + 1e-9)
    body = jb.solid(mesh, jb.lame(YOUNG, POISSON), jb.linear_elastic)
    return jb.Scene(mesh, (body, jb.pressure(mesh, inside)), fixed), inside


@pytest.mark.parametrize("order", [1, 2])
def test_forces_are_those_of_the_energy(order):
    """On nodes that move, in a deformed state, they are minus the slope of the energy; all together they are pressure
    times the chord, turned by a right angle; and a motion of everything changes none."""
    scene = arch(order, 3.0)
    x = np.asarray(scene.mesh.nodes)
    x = x + 0.05 * np.sin(3 * x[:, ::-1]) * ~scene.fixed
    bare = jb.Scene(scene.mesh, scene.terms[1:], scene.fixed)
    found = np.asarray(jb.forces(bare, x))
    slope = np.asarray(jax.grad(lambda x: jb.energy(bare, x))(jnp.asarray(x)))
    np.testing.assert_allclose(found[~scene.fixed], -slope[~scene.fixed], atol=1e-13)
    np.testing.assert_allclose(found.sum(axis=0), [0, -3.0 * 4.0], atol=1e-12)
    np.testing.assert_allclose(jb.forces(bare, x + np.array([1e3, -2e3])), found, atol=1e-11)


def test_reactions_balance_it():
    """Of a clamped arch, that has sagged: each end carries half of pressure times chord."""
    scene = jb.command(arch(), [40.0])
    found = jb.check(jb.equilibrium(scene))
    assert float(jb.tip_position(scene, found.x)[1]) < -0.2
    reactions = np.asarray(jb.reactions(scene, found.x))
    np.testing.assert_allclose(reactions.sum(axis=0), [0, 160.0], atol=1e-7)
    left = np.asarray(scene.mesh.nodes)[:, 0] < 0
    np.testing.assert_allclose(reactions[left].sum(axis=0)[1], 80.0, rtol=0.02)  # diagonals are not quite symmetric


@pytest.mark.parametrize(("order", "error"), [(1, 2e-2), pytest.param(2, 5e-4, marks=pytest.mark.slow)])
def test_thick_ring(order, error):
    """Lame's solution in plane strain: `u(a) = p a (1 + nu) / E (a^2 (1 - 2 nu) + b^2) / (b^2 - a^2)`.

    At a pressure of 1e-7 E, where that it follows the surface does not matter."""
    scene, inside = ring(order)
    found = jb.check(jb.equilibrium(jb.command(scene, [1e-3])))
    moved = np.asarray(found.x - scene.mesh.nodes)[inside]
    place = np.asarray(scene.mesh.nodes)[inside]
    out = np.sum(moved * place, axis=1) / np.linalg.norm(place, axis=1)
    exact = 1e-3 / YOUNG * (1 + POISSON) * ((1 - 2 * POISSON) + 4.0) / 3.0
    corners = np.isin(inside, np.asarray(scene.mesh.elements)[:, :3])
    np.testing.assert_allclose(out[corners], exact, rtol=error)


def test_one_command_for_all_edges():
    """Ramped like a tendon."""
    scene = arch()
    assert "commands [0]" in repr(scene)
    sag = lambda scene, x: jb.tip_position(scene, x)[1]
    path = jb.check(jb.ramp(scene, [20.0], 5))
    np.testing.assert_allclose(path.ratios[:, 0], np.linspace(0, 20, 5))
    assert (np.diff([sag(scene, x) for x in path.x]) < 0).all()


@pytest.mark.slow
def test_swept_and_differentiated():
    """The slope through equilibrium is that of differences."""
    scene = arch()
    sag = lambda scene, x: jb.tip_position(scene, x)[1]
    path = jb.ramp(scene, [20.0], 5)
    swept = jb.check(jb.sweep(scene, np.array([[5.0], [10.0]])))
    np.testing.assert_allclose(swept.x[1], path.x[2], atol=1e-8)
    of_pressure = lambda p: sag(scene, jb.equilibrium(jb.command(scene, p)).x)
    np.testing.assert_allclose(
        jax.grad(of_pressure)(jnp.array([10.0])), central_difference(of_pressure, [10.0], 1e-3), rtol=1e-6
    )


@pytest.mark.slow
def test_reached_and_bounded():
    """A wanted sag is reached, and its error estimated on a finer surface."""
    scene = arch()
    sag = lambda scene, x: jb.tip_position(scene, x)[1]
    found = jb.equilibrium(jb.command(scene, [10.0]))
    depth = float(sag(scene, found.x))
    design = jb.reach(scene, depth, sag, bounds=(0.0, 30.0))
    np.testing.assert_allclose(design.theta, [10.0], rtol=1e-6)
    estimate = jb.estimate_error(jb.command(scene, [10.0]), found, sag)
    assert abs(estimate.discretisation) < estimate.bar < 0.5 * abs(depth)


def test_no_potential():
    """A line with an end that moves is refused, and so is a choice of nodes without an edge."""
    mesh = disturbed(jb.rectangle(2.0, 1.0, 5, 3), 0.0)
    upper = jb.nodes_where(mesh, lambda x, y: y > 0.4999)
    left = jb.clamped(mesh, jb.nodes_where(mesh, lambda x, y: x < -0.9999))
    terms = jb.solid(mesh, jb.lame(YOUNG, POISSON)), jb.pressure(mesh, upper)
    with pytest.raises(ValueError, match=r"terms\[1\]: the line it acts on ends at node 14, which moves"):
        jb.Scene(mesh, terms, left)
    whole = jb.pressure(mesh, np.arange(15))
    assert len(whole.nodes) == 12
    jb.Scene(mesh, (terms[0], whole), left)
    with pytest.raises(ValueError, match="nodes: expected the corners of at least one edge of the surface"):
        jb.pressure(mesh, [0, 4])
    with pytest.raises(ValueError, match="value: expected"):
        jb.pressure(mesh, upper, np.inf)
