"""Weight and traction against closed forms and against integrals of random fields."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, disturbed

import jaxbeam as jb

FORCE = np.array([0.4, -2.0])


def curved(order):
    """A rectangle whose nodes are moved, so that edges of six-node triangles are curved."""
    mesh = jb.rectangle(2.0, 1.0, 5, 3, "crossed", order=order)
    moved = 0.01 * np.random.default_rng(0).normal(size=mesh.nodes.shape)
    return jb.Mesh(np.asarray(mesh.nodes) + moved, mesh.elements)


def forces_of(term, count):
    """Forces `(n, 2)` of a term on the nodes at rest."""
    total = np.zeros((count, 2))
    _, slopes = term.kind.gradients(term.params.rest, term.params)
    np.add.at(total, term.nodes, -np.asarray(slopes))
    return total


@pytest.mark.parametrize("order", [1, 2])
def test_forces_do_the_work_of_the_weight(order):
    """`sum f . u = force . int u dA`, the integral by a fan of many small triangles in each element."""
    mesh = curved(order)
    u = np.random.default_rng(1).normal(size=mesh.nodes.shape)
    forces = forces_of(jb.weight(mesh, FORCE), len(u))
    n = 120
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    inside = i + j < n
    l1, l2 = (i[inside] + 1 / 3) / n, (j[inside] + 1 / 3) / n
    more = i + j < n - 1
    l1, l2 = np.append(l1, (i[more] + 2 / 3) / n), np.append(l2, (j[more] + 2 / 3) / n)
    l0 = 1 - l1 - l2
    if order == 1:
        shape, by = np.stack([l0, l1, l2], 1), np.array([[-1.0, -1], [1, 0], [0, 1]])[None] + 0 * l0[:, None, None]
    else:
        corners = np.stack([l0 * (2 * l0 - 1), l1 * (2 * l1 - 1), l2 * (2 * l2 - 1)], 1)
        shape = np.concatenate([corners, np.stack([4 * l0 * l1, 4 * l1 * l2, 4 * l2 * l0], 1)], axis=1)
        zero = 0 * l0
        first = np.stack([1 - 4 * l0, 4 * l1 - 1, zero, 4 * (l0 - l1), 4 * l2, -4 * l2], 1)
        second = np.stack([1 - 4 * l0, zero, 4 * l2 - 1, -4 * l1, 4 * l1, 4 * (l0 - l2)], 1)
        by = np.stack([first, second], axis=2)
    nodes = np.asarray(mesh.nodes)[mesh.elements]
    area = np.linalg.det(np.einsum("qkd,mki->mqid", by, nodes)) / (2 * n * n)
    work = np.einsum("mq,qk,mki,i->", area, shape, u[mesh.elements], FORCE)
    np.testing.assert_allclose(np.sum(forces * u), work, rtol=1e-12 if order == 1 else 3e-5)


def test_six_nodes_carry_it_between_corners():
    """On straight edges: a third of the weight of its triangle on each of the three, nothing on corners."""
    mesh = jb.rectangle(2.0, 1.0, 5, 3, order=2)
    forces = forces_of(jb.weight(mesh, [0.0, -3.0]), len(mesh.nodes))
    np.testing.assert_allclose(forces[:15], 0, atol=1e-14)
    np.testing.assert_allclose(forces.sum(axis=0), [0, -6], atol=1e-13)
    np.testing.assert_allclose(np.unique(np.round(forces[15:, 1], 12)), [-0.25, -0.125])


def test_a_hanging_bar():
    """Linear elasticity, Poisson's ratio 0: `u = w (L s - s^2 / 2) / E` at `s` below the clamp, exact on six nodes."""
    length, young, w = 3.0, 1e4, 20.0
    mesh = jb.rectangle(0.5, length, 2, 5, order=2)
    top = jb.nodes_where(mesh, lambda x, y: y > length / 2 - 1e-9)
    body = jb.solid(mesh, jb.lame(young, 0.0), jb.linear_elastic)
    scene = jb.Scene(mesh, (body, jb.weight(mesh, [0.0, -w])), jb.clamped(mesh, top))
    found = jb.check(jb.equilibrium(scene))
    s = length / 2 - np.asarray(mesh.nodes)[:, 1]
    moved = np.asarray(found.x - mesh.nodes)
    np.testing.assert_allclose(moved[:, 1], -w * (length * s - s**2 / 2) / young, atol=1e-13)
    np.testing.assert_allclose(moved[:, 0], 0, atol=1e-13)
    np.testing.assert_allclose(jb.reactions(scene, found.x).sum(axis=0), [0, w * length * 0.5], atol=1e-9)


@pytest.fixture(scope="module")
def beam():
    """A cantilever that sags under its weight."""
    plain = jb.tendon_beam(9, 3, order=2)
    return jb.Scene(plain.mesh, (*plain.terms, jb.weight(plain.mesh, [0.0, -20.0])), plain.fixed, plain.tip)


def test_it_is_ramped_refined_and_differentiable(beam):
    sagging = jb.check(jb.ramp(beam, [0.9, 1.0], 4))
    angle = np.array([jb.tip_angle(beam, x) for x in sagging.x])
    # It hangs at rest, and its top tendon lifts it.
    assert angle[0] < -5 and (np.diff(angle) > 0.3).all()
    np.testing.assert_allclose(angle[0], jb.tip_angle(beam, jb.equilibrium(beam).x), rtol=1e-8)
    last = jax.tree.map(lambda leaf: leaf[-1], sagging)
    estimate = jb.estimate_error(jb.command(beam, [0.9, 1.0]), last, jb.tip_angle)
    finer, _ = jb.enriched(jb.command(beam, [0.9, 1.0]))
    fine = float(jb.tip_angle(finer, jb.check(jb.equilibrium(finer)).x))
    np.testing.assert_allclose(fine - angle[-1], estimate.discretisation, rtol=0.6)

    def sag(w):
        terms = (*beam.terms[:2], jb.weight(beam.mesh, jnp.stack([jnp.zeros_like(w), w])))
        scene = jb.Scene(beam.mesh, terms, beam.fixed, beam.tip)
        return jb.tip_angle(scene, jb.equilibrium(scene).x)

    slope = jax.grad(lambda w: sag(w[0]))(jnp.array([-20.0]))
    np.testing.assert_allclose(slope, central_difference(lambda w: sag(w[0]), jnp.array([-20.0]), 1e-3), rtol=1e-7)
    # Tendons on single nodes have no limit: the bar is infinite for them, and not for the weight.
    assert "single node" in estimate.reason


def test_bad_weights_are_refused():
    mesh = disturbed(jb.rectangle(2.0, 1.0, 3, 2))
    with pytest.raises(ValueError, match=r"force: expected shape \(2,\) or \(4, 2\), got \(3,\)"):
        jb.weight(mesh, [0.0, 1.0, 2.0])
    with pytest.raises(ValueError, match="force"):
        jb.weight(mesh, [0.0, np.nan])
    with pytest.raises(ValueError, match="expected triangles, got the Line of a rod"):
        jb.weight(jb.rod_beam(5).mesh, [0.0, -1.0])


# ------------------------------------------------------------------------------------------------ traction


@pytest.mark.parametrize("order", [1, 2])
def test_traction_does_the_work_of_its_force(order):
    """`sum f . u = force . int u ds` along the curved upper side, the integral by many short chords."""
    mesh = curved(order)
    upper = jb.nodes_where(jb.rectangle(2.0, 1.0, 5, 3, "crossed", order=order), lambda x, y: y > 0.49)
    term = jb.traction(mesh, upper, FORCE)
    u = np.random.default_rng(1).normal(size=mesh.nodes.shape)
    xi = np.linspace(0, 1, 4001)
    if order == 1:
        shape = np.stack([1 - xi, xi], axis=1)
    else:
        shape = np.stack([(1 - xi) * (1 - 2 * xi), xi * (2 * xi - 1), 4 * xi * (1 - xi)], axis=1)
    assert len(term.nodes) == 4
    work = 0.0
    for edge in term.nodes:
        x, moved = shape @ np.asarray(mesh.nodes)[edge], shape @ u[edge]
        work += np.linalg.norm(np.diff(x, axis=0), axis=1) @ (0.5 * (moved[1:] + moved[:-1])) @ FORCE
    np.testing.assert_allclose(np.sum(forces_of(term, len(u)) * u), work, rtol=1e-6)


def test_a_bar_under_traction():
    """Linear elasticity, Poisson's ratio 0: `u = t s / E`, on the refined mesh too."""
    mesh = jb.rectangle(3.0, 0.5, 5, 3)
    left, right = (jb.nodes_where(mesh, lambda x, y, s=s: s * x > 1.49) for s in (-1, 1))
    body = jb.solid(mesh, jb.lame(1e4, 0.0), jb.linear_elastic)
    scene = jb.Scene(mesh, (body, jb.traction(mesh, right, [50.0, 0.0])), jb.clamped(mesh, left), right)
    for each in (scene, jb.enriched(scene)[0]):
        found = jb.check(jb.equilibrium(each))
        stretch = 50.0 * (np.asarray(each.mesh.nodes)[:, 0] + 1.5) / 1e4
        np.testing.assert_allclose(np.asarray(found.x - each.mesh.nodes)[:, 0], stretch, atol=1e-12)


def test_bad_tractions_are_refused():
    mesh = jb.rectangle(2.0, 1.0, 3, 2)
    with pytest.raises(ValueError, match="at least one edge of the surface, got"):
        jb.traction(mesh, [0, 5], [0.0, 1.0])
    with pytest.raises(ValueError, match=r"force: expected shape \(2,\), got \(3,\)"):
        jb.traction(mesh, [1, 3, 5], [0.0, 1.0, 2.0])
