"""Values at the nodes: stress recovered there, and values of elements carried there."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import MATERIALS

import jaxbeam as jb
from jaxbeam.physics.energy import Term

nodal_stress = jax.jit(jb.nodal_stress)


def block(n=1, degree=None, density=jb.neo_hookean):
    mesh = jb.rectangle(3.0, 1.0, 6 * n + 1, 2 * n + 1, order=2)
    return jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3), density, degree),), jb.clamped(mesh, [0]))


@pytest.mark.parametrize("degree", [2, 4, 5])
@pytest.mark.parametrize("density", [jb.linear_elastic, jb.neo_hookean])
def test_linear_stress_is_recovered_exactly(degree, density):
    """At rest the stress changes as `lam tr e I + 2 mu e`, linear in the place for quadratic displacements."""
    scene = block(degree=degree, density=density)
    X, Y = np.asarray(scene.mesh.nodes).T
    u = np.stack([X**2 - 0.5 * X * Y + 0.3 * Y**2 + Y, 0.2 * X**2 + X * Y - 0.7 * Y**2], axis=1)
    _, stress = jax.jvp(lambda x: nodal_stress(scene, x), (scene.mesh.nodes,), (jnp.asarray(u),))
    H = np.stack([[2 * X - 0.5 * Y, 0.6 * Y - 0.5 * X + 1], [0.4 * X + Y, X - 1.4 * Y]]).transpose(2, 0, 1)
    strain = (H + H.transpose(0, 2, 1)) / 2
    material = jb.lame(1.0, 0.3)
    pressure = material.lam * np.trace(strain, axis1=1, axis2=2)
    expected = pressure[:, None, None] * np.eye(2) + 2 * material.mu * strain
    np.testing.assert_allclose(stress, expected, atol=1e-12)


def test_stress_of_three_node_triangles_is_the_mean_by_area():
    mesh = jb.Mesh(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 3.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)),), jb.clamped(mesh, [0]))
    x = mesh.nodes * jnp.array([1.1, 1.0]) + 0.1 * mesh.nodes[:, ::-1] ** 2
    one, other = jb.cauchy_stress(scene, x)
    mean = (0.5 * one + 1.5 * other) / 2
    np.testing.assert_allclose(nodal_stress(scene, x), [mean, one, mean, other], rtol=1e-12)


def wound(X):
    turn, radius = 0.6 * X[0], 1 / 0.6 - X[1]
    return jnp.stack([radius * jnp.sin(turn), 1 / 0.6 - radius * jnp.cos(turn)])


def errors(n):
    """Largest error of the stress of a strongly bent beam: recovered at the nodes, and as the element has it there."""
    scene = block(n)
    mu, lam = (float(value) for value in jax.tree.leaves(jb.lame(1.0, 0.3)))
    piola = MATERIALS[jb.neo_hookean]
    gradients = np.asarray(jax.vmap(jax.jacfwd(wound))(scene.mesh.nodes))
    exact = np.stack([piola(F, mu, lam) @ F.T / np.linalg.det(F) for F in gradients])
    x = jax.vmap(wound)(scene.mesh.nodes)
    element = np.asarray(jb.cauchy_stress(scene, x))[:, None] - exact[scene.mesh.elements]
    return np.abs(nodal_stress(scene, x) - exact).max(), np.abs(element).max()


def test_recovered_stress_of_a_bent_beam_converges_faster_than_that_of_elements():
    coarse, fine = np.array([errors(2), errors(4)])
    nodal, element = np.log2(coarse / fine)
    assert nodal > 1.7 and element < 1.1  # of second and of first order
    assert (coarse[0] < 0.1 * coarse[1]) and (fine[0] < 0.05 * fine[1])


def test_recovered_stress_differentiates_and_keeps_its_dtype():
    scene = block()
    x = jax.vmap(wound)(scene.mesh.nodes)
    direction = jnp.asarray(np.random.default_rng(0).normal(size=x.shape))
    _, slope = jax.jvp(lambda x: nodal_stress(scene, x), (x,), (direction,))
    h = 1e-6
    difference = (nodal_stress(scene, x + h * direction) - nodal_stress(scene, x - h * direction)) / (2 * h)
    np.testing.assert_allclose(slope, difference, atol=1e-7 * float(jnp.abs(slope).max()))
    mesh = jb.rectangle(3.0, 1.0, 7, 3, dtype=np.float32)
    small = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)),), jb.clamped(mesh, [0]))
    assert nodal_stress(small, mesh.nodes).dtype == np.float32


def test_recovered_stress_needs_a_solid_and_a_known_rule():
    scene = block()
    load = jb.Scene(scene.mesh, (jb.dead_load(scene.mesh, [3], [0.0, 1.0]),), scene.fixed)
    with pytest.raises(ValueError, match="scene: expected a solid term, got none"):
        nodal_stress(load, scene.mesh.nodes)
    body = scene.terms[0]
    params = dataclasses.replace(
        body.params, gradients=body.params.gradients[:, :2], weights=body.params.weights[:, :2]
    )
    odd = jb.Scene(scene.mesh, (dataclasses.replace(body, params=params),), scene.fixed)
    with pytest.raises(
        ValueError, match=r"expected a solid with \[1, 3, 6, 7\] quadrature points in an element, got 2"
    ):
        nodal_stress(odd, scene.mesh.nodes)


def test_stress_is_zero_where_no_solid_reaches():
    scene = block()
    body = scene.terms[0]
    part = Term(body.energy, body.nodes[:1], jax.tree.map(lambda leaf: leaf[:1], body.params))
    stress = nodal_stress(jb.Scene(scene.mesh, (part,), scene.fixed), 1.1 * scene.mesh.nodes)
    reached = np.isin(np.arange(len(stress)), body.nodes[0])
    assert (np.abs(stress[reached]).max(axis=(1, 2)) > 0.1).all() and not np.any(stress[~reached])


# ---------------------------------------------------------------------------------------- von Mises stress

MU, LAM = 3.0, 5.0


def uniform(order, density, F):
    mesh = jb.rectangle(2.0, 1.0, 4, 3, order=order)
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.Lame(MU, LAM), density),), jb.clamped(mesh, [0]))
    return scene, jnp.asarray(np.asarray(mesh.nodes) @ np.asarray(F).T)


@pytest.mark.parametrize("order", [1, 2])
def test_von_mises_stress_under_a_uniform_stretch_is_the_closed_form(order):
    """Neo-Hookean: `s_i = (mu (F_i^2 - 1) + lam ln J) / J` in the plane, and `lam ln J / J` out of it."""
    a, b = 1.3, 0.9
    J = a * b
    xx, yy, zz = ((MU * (s**2 - 1) + LAM * np.log(J)) / J for s in (a, b, 1.0))
    expected = np.sqrt(((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) / 2)
    scene, x = uniform(order, jb.neo_hookean, np.diag([a, b]))
    np.testing.assert_allclose(jb.nodal_von_mises_stress(scene, x), np.full(len(x), expected), rtol=1e-12)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("density", MATERIALS)
def test_von_mises_stress_agrees_with_that_of_elements_in_uniform_states(order, density):
    scene, x = uniform(order, density, [[1.1, 0.2], [-0.05, 0.95]])
    of_elements = np.asarray(jb.von_mises_stress(scene, x))
    assert of_elements[0] > 0.5
    expected = np.full(len(x), of_elements[0])
    np.testing.assert_allclose(jb.nodal_von_mises_stress(scene, x), expected, rtol=1e-12)


def test_von_mises_stress_is_of_the_recovered_stress_and_not_a_mean_of_its_values():
    """In pure bending it vanishes on the neutral line, where a mean of values that are not negative does not. The line
    runs through the elements."""
    mesh = jb.rectangle(3.0, 1.0, 7, 2, order=2)
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3), jb.linear_elastic),), jb.clamped(mesh, [0]))
    X, Y = np.asarray(scene.mesh.nodes).T
    small = 1e-6
    x = jnp.stack([X + small * X * Y, Y - 0.5 * small * (X**2 + 0.3 / 0.7 * Y**2)], axis=1)
    stress = np.asarray(jb.nodal_von_mises_stress(scene, x))
    on_line, at_face = np.abs(Y) < 1e-9, np.abs(Y) > 0.5 - 1e-9
    assert stress[on_line].max() < 1e-4 * stress[at_face].min()


# ----------------------------------------------------------------------------------------- from elements


def split(scene, count):
    """The scene with its body in two solids: `count` elements, and the others."""
    body = scene.terms[0]
    parts = [
        Term(body.energy, body.nodes[some], jax.tree.map(lambda leaf, some=some: leaf[some], body.params))
        for some in (np.s_[:count], np.s_[count:])
    ]
    return jb.Scene(scene.mesh, tuple(parts), scene.fixed)


@pytest.mark.parametrize("order", [1, 2])
def test_constants_are_carried_exactly(order):
    scene, _ = uniform(order, jb.neo_hookean, np.eye(2))
    values = np.tile([[1.5, -2.0]], (len(scene.mesh.elements), 1))
    np.testing.assert_allclose(
        jb.to_nodes(scene, values), np.tile([[1.5, -2.0]], (len(scene.mesh.nodes), 1)), rtol=1e-14
    )


def test_linear_functions_are_carried_exactly_to_inner_nodes_of_a_regular_mesh():
    """There the six elements around a node lie symmetric about it."""
    scene, _ = uniform(1, jb.neo_hookean, np.eye(2))
    nodes = np.asarray(scene.mesh.nodes)
    linear = lambda points: 2.0 + points @ [3.0, -1.0]
    found = jb.to_nodes(scene, linear(nodes[scene.mesh.elements].mean(axis=1)))
    inner = (np.abs(nodes) < [0.99, 0.49]).all(axis=1)
    assert inner.sum() == 2
    np.testing.assert_allclose(found[inner], linear(nodes[inner]), rtol=1e-13)


def test_means_are_weighted_by_area_at_rest_also_over_several_solids():
    mesh = jb.Mesh(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 3.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)),), jb.clamped(mesh, [0]))
    mean = (0.5 * 4.0 + 1.5 * 8.0) / 2
    for each in (scene, split(scene, 1)):
        np.testing.assert_allclose(jb.to_nodes(each, np.array([4.0, 8.0])), [mean, 4.0, mean, 8.0], rtol=1e-14)


def test_values_are_in_the_order_of_the_terms():
    scene, _ = uniform(1, jb.neo_hookean, np.eye(2))
    values = np.random.default_rng(0).normal(size=len(scene.mesh.elements))
    parted = split(scene, 5)
    swapped = jb.Scene(scene.mesh, parted.terms[::-1], scene.fixed)
    expected = jb.to_nodes(scene, values)
    np.testing.assert_allclose(jb.to_nodes(parted, values), expected, rtol=1e-13)
    np.testing.assert_allclose(jb.to_nodes(swapped, np.roll(values, -5)), expected, rtol=1e-13)


def test_carrying_is_differentiable_also_in_the_mesh():
    scene, _ = uniform(1, jb.neo_hookean, np.eye(2))
    values, weights = (np.random.default_rng(k).normal(size=n) for k, n in enumerate((12, 12)))
    body, energy = scene.terms[0].params, scene.terms[0].energy

    def loss(values, weights):
        params = dataclasses.replace(body, weights=body.weights * jnp.exp(weights)[:, None])
        term = Term(energy, scene.terms[0].nodes, params)
        return jnp.sum(jb.to_nodes(jb.Scene(scene.mesh, (term,), scene.fixed), values) ** 2)

    arguments = jnp.asarray(values), jnp.asarray(0.1 * weights)
    slopes = jax.jit(jax.grad(loss, argnums=(0, 1)))(*arguments)
    h = 1e-6
    for k, slope in enumerate(slopes):
        for entry in (0, 7):
            low, high = (
                loss(*(each.at[entry].add(sign * h) if j == k else each for j, each in enumerate(arguments)))
                for sign in (-1, 1)
            )
            np.testing.assert_allclose(slope[entry], (high - low) / (2 * h), rtol=1e-7, atol=1e-9)


def test_wrong_values_and_scenes_without_a_solid_are_refused():
    scene, _ = uniform(1, jb.neo_hookean, np.eye(2))
    with pytest.raises(ValueError, match=r"values: expected shape \(12, \.\.\.\), one for each element, got \(11,\)"):
        jb.to_nodes(scene, np.zeros(11))
    with pytest.raises(ValueError, match=r"values: expected shape \(12, \.\.\.\).*, got \(\)"):
        jb.to_nodes(scene, np.zeros(()))
    load = jb.Scene(scene.mesh, (jb.dead_load(scene.mesh, [3], [0.0, 1.0]),), scene.fixed)
    with pytest.raises(ValueError, match="scene: expected a solid term, got none"):
        jb.to_nodes(load, np.zeros(12))


# ------------------------------------------------------------------------------------------ energy density


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("density", MATERIALS)
def test_energy_density_times_area_is_the_energy(order, density):
    mesh = jb.rectangle(2.0, 1.0, 4, 3, "crossed", order=order)
    mesh = jb.mapped(mesh, lambda x, y: (x * (1 + 0.3 * y), y + 0.1 * x))
    solid = jb.solid(mesh, jb.Lame(np.linspace(1.0, 2.0, len(mesh.elements)), LAM), density)
    scene = jb.Scene(mesh, (solid,), jb.clamped(mesh, [0]))
    x = np.asarray(mesh.nodes) * [1.1, 0.95] + 0.05 * np.asarray(mesh.nodes)[:, ::-1] ** 2
    areas = np.asarray(solid.params.weights).sum(axis=1)
    assert np.ptp(areas) > 0.2 * areas.max()
    np.testing.assert_allclose(
        np.asarray(jb.strain_energy_density(scene, x)) * areas, jb.strain_energy(scene, x), rtol=1e-12, atol=1e-14
    )
