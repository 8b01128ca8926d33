"""Stress out of the plane, von Mises stress and principal stretches, against energies in space written anew."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import MATERIALS, affine, lateral_stretch, rotation

import jaxbeam as jb

MU, LAM = 3.0, 5.0
MESHES = {1: jb.rectangle(2.0, 1.0, 3, 2), 2: jb.rectangle(2.0, 1.0, 3, 2, order=2)}


def scene_of(density, mesh=MESHES[1]):
    return jb.Scene(mesh, (jb.solid(mesh, jb.Lame(MU, LAM), density),), jb.clamped(mesh, [0, 1]))


def in_space(density):
    """The energy in three dimensions of `F` `(3, 3)`, from its source."""

    def energy(F):
        J, square = np.linalg.det(F), np.sum(F * F)
        strain = 0.5 * (F.T @ F - np.eye(3)) if density is jb.saint_venant_kirchhoff else 0.5 * (F + F.T) - np.eye(3)
        if density is jb.macklin_mueller:
            # Macklin and Mueller 2021: neo-Hookean with the rest volume moved by mu / lam.
            return MU / 2 * (square - 3) + LAM / 2 * (J - 1 - MU / LAM) ** 2
        if density is jb.neo_hookean:
            return MU / 2 * (square - 3) - MU * np.log(J) + LAM / 2 * np.log(J) ** 2
        return MU * np.sum(strain * strain) + LAM / 2 * np.trace(strain) ** 2

    return energy


def cauchy(density, F):
    """Cauchy stress `(3, 3)` by central differences of the energy in space."""
    whole, h, P = np.eye(3), 1e-6, np.zeros((3, 3))
    whole[:2, :2] = F
    for i in range(3):
        for k in range(3):
            change = np.zeros((3, 3))
            change[i, k] = h
            P[i, k] = (in_space(density)(whole + change) - in_space(density)(whole - change)) / (2 * h)
    return P @ whole.T / np.linalg.det(whole)


def von_mises(s):
    """From the deviator: `sqrt(3/2 s:s)`."""
    deviator = 0.5 * (s + s.T) - np.trace(s) / 3 * np.eye(3)
    return np.sqrt(1.5 * np.sum(deviator**2))


@pytest.mark.parametrize("density", MATERIALS)
def test_stress_in_space(density):
    """Of random deformations, everywhere the same: all that the energies in space tell, also in the plane."""
    rng = np.random.default_rng(0)
    scene = scene_of(density)
    for _ in range(5):
        F = np.eye(2) + rng.uniform(-0.3, 0.3, (2, 2))
        s, x = cauchy(density, F), affine(scene.mesh, F)
        # Round-off and truncation of the differences.
        np.testing.assert_allclose(jb.cauchy_stress(scene, x), np.broadcast_to(s[:2, :2], (4, 2, 2)), atol=1e-7)
        np.testing.assert_allclose(jb.out_of_plane_stress(scene, x), np.full(4, s[2, 2]), atol=1e-7)
        np.testing.assert_allclose(jb.von_mises_stress(scene, x), np.full(4, von_mises(s)), atol=1e-7)


@pytest.mark.parametrize("order", [1, 2])
def test_uniaxial_tension_in_plane_strain(order):
    """Neo-Hookean, pulled to `a` with sides free: `s_xx = (mu (a^2 - 1) + lam ln J) / J`, `s_zz = lam ln J / J`."""
    scene, a = scene_of(jb.neo_hookean, MESHES[order]), 1.4
    J = a * lateral_stretch(jb.neo_hookean, a, MU, LAM)
    x = affine(scene.mesh, np.diag([a, J / a]))
    xx, zz = (MU * (a**2 - 1) + LAM * np.log(J)) / J, LAM * np.log(J) / J
    np.testing.assert_allclose(jb.cauchy_stress(scene, x)[:, 0, 0], np.full(4, xx), rtol=1e-12)
    np.testing.assert_allclose(jb.out_of_plane_stress(scene, x), np.full(4, zz), rtol=1e-12)
    np.testing.assert_allclose(jb.von_mises_stress(scene, x), np.full(4, np.sqrt(xx**2 - xx * zz + zz**2)), rtol=1e-12)
    np.testing.assert_allclose(jb.principal_stretches(scene, x), np.tile([a, J / a], (4, 1)), rtol=1e-12)


def test_lame_cylinder():
    """A thick cylinder under pressure inside: `s_zz = nu (s_r + s_t)` is the same everywhere, and `s_t - s_r` goes with
    `1 / r^2`. The exact displacements (Timoshenko and Goodier 1970, section 28, in plane strain) are imposed."""
    young, poisson, inner, outer, load = 100.0, 0.3, 1.0, 2.0, 1e-6
    bend = lambda x, y: ((inner + y + 0.5) * np.cos(-x), (inner + y + 0.5) * np.sin(-x))
    mesh = jb.mapped(jb.rectangle(1.0, 1.0, 9, 9, order=2), lambda x, y: bend(x, y))
    body = jb.solid(mesh, jb.lame(young, poisson), jb.linear_elastic)
    scene = jb.Scene(mesh, (body,), jb.clamped(mesh, [0]))
    rest = np.asarray(mesh.nodes)
    A = load * inner**2 / (outer**2 - inner**2)
    radius = np.linalg.norm(rest, axis=1)
    u = (1 + poisson) / young * A * ((1 - 2 * poisson) * radius + outer**2 / radius)
    x = jnp.asarray(rest * (1 + u / radius)[:, None])
    # Parabolas interpolate the field: strains err by (h / r)^2 / 12 or so, with h = 1 / 8.
    np.testing.assert_allclose(jb.out_of_plane_stress(scene, x), np.full(128, 2 * poisson * A), rtol=0.01)
    centre = np.linalg.norm(rest[mesh.elements[:, :3]].mean(axis=1), axis=1)
    radial, hoop = A * (1 - (outer / centre) ** 2), A * (1 + (outer / centre) ** 2)
    exact = [von_mises(np.diag([r, t, poisson * (r + t)])) for r, t in zip(radial, hoop, strict=True)]
    np.testing.assert_allclose(jb.von_mises_stress(scene, x), exact, rtol=0.01)


def test_stretches_are_singular_values():
    rng = np.random.default_rng(1)
    scene = scene_of(jb.macklin_mueller)
    for _ in range(20):
        F = rng.normal(size=(2, 2))
        found = np.asarray(jb.principal_stretches(scene, affine(scene.mesh, F)))
        large, small = np.linalg.svd(F, compute_uv=False)
        np.testing.assert_allclose(found, np.tile([large, np.sign(np.linalg.det(F)) * small], (4, 1)), atol=1e-13)


def test_rigid_turns_change_nothing():
    scene, F = scene_of(jb.macklin_mueller), np.array([[1.2, 0.3], [-0.1, 0.9]])
    measures = jb.out_of_plane_stress, jb.von_mises_stress, jb.principal_stretches
    for measure in measures:
        before, after = (measure(scene, affine(scene.mesh, R @ F, shift=(3, -2))) for R in (np.eye(2), rotation(2.0)))
        np.testing.assert_allclose(after, before, rtol=1e-12)


@pytest.mark.parametrize("measure", [jb.out_of_plane_stress, jb.von_mises_stress, jb.principal_stretches])
def test_measures_differentiate_and_map(measure):
    scene = scene_of(jb.neo_hookean)
    states = jnp.stack([affine(scene.mesh, np.diag([a, 0.9])) for a in (1.1, 1.3)])
    many = jax.jit(jax.vmap(measure, in_axes=(None, 0)))(scene, states)
    np.testing.assert_allclose(many, [measure(scene, x) for x in states], rtol=1e-14)

    def of_stretch(a):
        return jnp.sum(measure(scene, scene.mesh.nodes * jnp.stack([a, jnp.asarray(0.9)])))

    value_and_slope, h = jax.jit(jax.value_and_grad(of_stretch)), 1e-6
    difference = (value_and_slope(1.2 + h)[0] - value_and_slope(1.2 - h)[0]) / (2 * h)
    np.testing.assert_allclose(value_and_slope(1.2)[1], difference, rtol=1e-8)
    # At rest, where roots have no derivative.
    assert np.isfinite(jax.jit(jax.grad(lambda x: jnp.sum(measure(scene, x))))(scene.mesh.nodes)).all()


def test_rest():
    scene = scene_of(jb.macklin_mueller)
    x = scene.mesh.nodes
    np.testing.assert_array_equal(jb.out_of_plane_stress(scene, x), np.zeros(4))
    np.testing.assert_array_equal(jb.von_mises_stress(scene, x), np.zeros(4))
    np.testing.assert_array_equal(jb.principal_stretches(scene, x), np.ones((4, 2)))


def my_own(H, params):
    return params.mu * jnp.sum(H * H)


def test_a_density_of_the_users_own_is_refused():
    scene = scene_of(my_own)
    for measure in (jb.out_of_plane_stress, jb.von_mises_stress):
        with pytest.raises(ValueError, match=r"scene: expected solids of macklin_mueller, .* got the density 'my_own'"):
            measure(scene, scene.mesh.nodes)
    assert jb.principal_stretches(scene, scene.mesh.nodes).shape == (4, 2)
    mesh = MESHES[1]
    load = jb.Scene(mesh, (jb.dead_load(mesh, [3], [0.0, 1.0]),), jb.clamped(mesh, [0]))
    with pytest.raises(ValueError, match="scene: expected a solid term, got none"):
        jb.von_mises_stress(load, mesh.nodes)
