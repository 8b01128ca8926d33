"""Energy densities against closed forms, their small-strain limits, and their digits."""

from decimal import Decimal, localcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, MATERIALS, affine, disturbed, lateral_stretch, mean_piola, rotation, total_area

import jaxbeam as jb
from jaxbeam.physics.materials import _less_log1p

MU, LAM = 3.0, 7.0
STRETCHES = [0.7, 0.95, 1.0, 1.4]
# Closed forms and autodiff do the same few operations in another order: some round-offs of MU and LAM.
CLOSED_FORM = {"rtol": 1e-12, "atol": 1e-12}

at_rest = jax.jit(lambda density, params: jax.hessian(density)(jnp.zeros((2, 2)), params), static_argnums=0)
value_and_stress = jax.jit(lambda density, H, params: jax.value_and_grad(density)(H, params), static_argnums=0)

each_material = pytest.mark.parametrize("density", MATERIALS, ids=lambda f: f.__name__)


@pytest.fixture(scope="module")
def patches():
    """For each material an irregular patch of it, with nothing else in the scene."""
    mesh = disturbed(jb.rectangle(1.3, 1.0, 4, 3))
    params = jb.Lame(MU, LAM)
    return {f: jb.Scene(mesh, (jb.solid(mesh, params, f),), np.zeros((12, 2), bool)) for f in MATERIALS}


def check_stress(scene, density, F):
    """Nodal forces give P, and Cauchy's stress is `P F^T / J`, both as worked by hand."""
    x = affine(scene.mesh, F)
    P = MATERIALS[density](F, MU, LAM)
    np.testing.assert_allclose(mean_piola(scene, x), P, **CLOSED_FORM)
    cauchy = np.broadcast_to(P @ F.T / np.linalg.det(F), (len(scene.mesh.elements), 2, 2))
    np.testing.assert_allclose(jb.cauchy_stress(scene, x), cauchy, **CLOSED_FORM)
    return P


@each_material
@pytest.mark.parametrize("a", STRETCHES)
def test_uniaxial(patches, density, a):
    b = lateral_stretch(density, a, MU, LAM)
    P = check_stress(patches[density], density, np.diag([a, b]))
    assert abs(P[1, 1]) < 1e-13  # the lateral stretch was found right: nothing across
    assert np.sign(P[0, 0]) == np.sign(round(a - 1, 12)) or abs(P[0, 0]) < 1e-13
    if density in (jb.saint_venant_kirchhoff, jb.linear_elastic):
        # Both are linear in a strain, with the modulus of plane strain E / (1 - nu^2).
        plane_modulus = 4 * MU * (LAM + MU) / (LAM + 2 * MU)
        expected = a * (a**2 - 1) / 2 if density is jb.saint_venant_kirchhoff else a - 1
        np.testing.assert_allclose(P[0, 0], plane_modulus * expected, **CLOSED_FORM)


@each_material
@pytest.mark.parametrize("a", STRETCHES)
def test_equibiaxial(patches, density, a):
    P = check_stress(patches[density], density, np.diag([a, a]))
    expected = {
        jb.macklin_mueller: LAM * a * (a**2 - 1),
        jb.neo_hookean: MU * (a - 1 / a) + 2 * LAM * np.log(a) / a,
        jb.saint_venant_kirchhoff: (LAM + MU) * a * (a**2 - 1),
        jb.linear_elastic: 2 * (LAM + MU) * (a - 1),
    }[density]
    np.testing.assert_allclose(P, expected * np.eye(2), **CLOSED_FORM)


@each_material
@pytest.mark.parametrize("shear", [-0.6, 0.1, 1.5])
def test_simple_shear(patches, density, shear):
    F = np.array([[1.0, shear], [0.0, 1.0]])
    P = check_stress(patches[density], density, F)
    cauchy = P @ F.T
    if density in (jb.macklin_mueller, jb.neo_hookean):
        # Exactly mu gamma, and normal stress mu gamma^2 along the shear only (Bonet and Wood 2008, eq. 6.29).
        np.testing.assert_allclose(cauchy, MU * np.array([[shear**2, shear], [shear, 0]]), **CLOSED_FORM)
    elif density is jb.saint_venant_kirchhoff:
        along = (LAM / 2 + MU) * shear**3 + MU * shear
        np.testing.assert_allclose([P[0, 1], P[1, 1]], [along, (LAM / 2 + MU) * shear**2], **CLOSED_FORM)
    else:
        np.testing.assert_allclose(P, MU * shear * np.array([[0, 1], [1, 0]]), **CLOSED_FORM)


@each_material
def test_general_state(patches, density):
    check_stress(patches[density], density, np.array([[1.2, 0.3], [-0.2, 0.8]]))


@each_material
def test_energy_in_closed_form(patches, density):
    F = np.array([[1.2, 0.3], [-0.2, 0.8]])
    J, green = np.linalg.det(F), 0.5 * (F.T @ F - np.eye(2))
    strain = 0.5 * (F + F.T) - np.eye(2)
    psi = {
        jb.macklin_mueller: MU / 2 * (np.sum(F**2) - 2) - MU * (J - 1) + LAM / 2 * (J - 1) ** 2,
        jb.neo_hookean: MU / 2 * (np.sum(F**2) - 2) - MU * np.log(J) + LAM / 2 * np.log(J) ** 2,
        jb.saint_venant_kirchhoff: MU * np.sum(green**2) + LAM / 2 * np.trace(green) ** 2,
        jb.linear_elastic: MU * np.sum(strain**2) + LAM / 2 * np.trace(strain) ** 2,
    }[density]
    scene = patches[density]
    np.testing.assert_allclose(jb.energy(scene, affine(scene.mesh, F)), psi * total_area(scene.mesh), rtol=1e-13)


@each_material
def test_stress_derivative_in_both_moduli(density):
    """P is linear in the moduli, so its derivatives are the closed form at (1, 0) and (0, 1)."""
    F = np.diag([1.3, 0.9])
    piola = lambda params: jax.grad(density)(jnp.asarray(F - np.eye(2)), params)
    derivative = jax.jit(jax.jacfwd(piola))(jb.Lame(jnp.asarray(MU), jnp.asarray(LAM)))
    np.testing.assert_allclose(derivative.mu, MATERIALS[density](F, 1.0, 0.0), **CLOSED_FORM)
    np.testing.assert_allclose(derivative.lam, MATERIALS[density](F, 0.0, 1.0), **CLOSED_FORM)


@each_material
@pytest.mark.parametrize("angle", [0.3, 2.0, np.pi])
def test_rigid_motion_costs_nothing(patches, density, angle):
    scene = patches[density]
    turned = rotation(0.0 if density is jb.linear_elastic else angle)  # linear elasticity: translation only
    x = affine(scene.mesh, turned, shift=(5.0, -2.0))
    # Strains are a few eps off, of positions near 5; an energy linear in them (mu tr H) would still show.
    assert abs(jb.energy(scene, x)) < 100 * EPS * LAM
    assert np.abs(jb.forces(scene, x)).max() < 1e3 * EPS * LAM


@each_material
def test_energy_is_objective(patches, density):
    """A rotation after a deformation changes nothing; linear elasticity is documented not to have that."""
    scene, F = patches[density], np.array([[1.2, 0.3], [-0.2, 0.8]])
    before, after = (jb.energy(scene, affine(scene.mesh, R @ F)) for R in (np.eye(2), rotation(1.0)))
    if density is jb.linear_elastic:
        assert abs(after - before) > 0.1 * before
    else:
        np.testing.assert_allclose(after, before, rtol=1e-13)


@each_material
def test_linearisation(density):
    """At rest every material is linear elastic; Macklin-Mueller with `lam - mu` for its first parameter."""
    tangent = at_rest(density, jb.Lame(MU, LAM))
    first = LAM - MU if density is jb.macklin_mueller else LAM
    linear = at_rest(jb.linear_elastic, jb.Lame(MU, first))
    np.testing.assert_allclose(tangent, linear, atol=1e-13)
    if density is jb.macklin_mueller:
        young, poisson = 1e4, 0.3
        corrected = at_rest(density, jb.lame_macklin_mueller(young, poisson))
        exact = at_rest(jb.linear_elastic, jb.lame(young, poisson))
        np.testing.assert_allclose(corrected, exact, rtol=1e-13)


def effective(young, poisson):
    """Young's modulus and Poisson's ratio that Macklin-Mueller has at small strain, given plain constants."""
    params = jb.lame(young, poisson)
    mu, first = float(params.mu), float(params.lam - params.mu)
    return mu * (3 * first + 2 * mu) / (first + mu), first / (2 * (first + mu))


@pytest.mark.parametrize(("poisson", "young_seen", "poisson_seen"), [(0.45, 9962, 0.4444), (0.3, 8974, 0.167)])
def test_effective_constants_as_documented(poisson, young_seen, poisson_seen):
    young, ratio = effective(1e4, poisson)
    assert round(young) == young_seen
    # Half a unit of the documented last digit.
    assert abs(ratio - poisson_seen) < (5e-5 if poisson == 0.45 else 5e-4)


def test_macklin_mueller_at_small_poisson():
    assert effective(1e4, 0.2)[1] < 0
    # At Poisson's ratio 0 a uniform expansion costs nothing to second order: no in-plane bulk modulus.
    bulk = lambda e, density, params: density(e * jnp.eye(2), params)
    curvature = jax.jit(jax.grad(jax.grad(bulk)), static_argnums=1)
    assert abs(curvature(0.0, jb.macklin_mueller, jb.lame(1e4, 0.0))) < 1e-9
    assert curvature(0.0, jb.macklin_mueller, jb.lame_macklin_mueller(1e4, 0.0)) > 1e4


@each_material
@pytest.mark.parametrize("size", [1e-3, 1e-5, 1e-7])
def test_digits_at_small_strain_in_float32(density, size):
    """Written in `F`, `|F|^2 - 2` would lose every digit in float32 at strain 1e-7; written in `H`, none."""
    H = size * np.array([[0.7, 0.4], [-0.3, -0.5]])
    value = {}
    for dtype in (jnp.float32, jnp.float64):
        params = jb.Lame(jnp.asarray(MU, dtype), jnp.asarray(LAM, dtype))
        value[dtype] = value_and_stress(density, jnp.asarray(H, dtype), params)
        assert {leaf.dtype for leaf in jax.tree.leaves(value[dtype])} == {jnp.dtype(dtype)}
    single, double = value[jnp.float32], value[jnp.float64]
    # A dozen float32 operations of terms that partly cancel (tr H is 0.2 of the largest entry).
    bound = 50 * np.finfo(np.float32).eps
    np.testing.assert_allclose(single[0], double[0], rtol=bound)
    np.testing.assert_allclose(single[1], double[1], atol=bound * np.abs(double[1]).max())


@pytest.mark.parametrize("density", [jb.macklin_mueller, jb.neo_hookean, jb.saint_venant_kirchhoff])
@pytest.mark.parametrize("angle", [0.3, 1.5, 3.0])
def test_digits_of_a_small_strain_in_a_turned_body_in_float32(density, angle):
    """Summed up term by term, `|H|^2 / 2 - det H` would be off by eps of 1 and not of the strain: ten times the energy
    at a strain of 1e-4, and negative for some."""
    F = rotation(angle) @ (np.eye(2) + 1e-4 * np.array([[0.7, 0.4], [0.4, -0.5]]))
    H = jnp.asarray(F - np.eye(2), jnp.float32)
    single, double = (
        density(jnp.asarray(H, dtype), jb.Lame(jnp.asarray(MU, dtype), jnp.asarray(LAM, dtype)))
        for dtype in (jnp.float32, jnp.float64)
    )
    # `J - 1` and the strains are off by some eps, the energy by that times its slope.
    assert abs(float(single) - float(double)) < 10 * np.finfo(np.float32).eps * LAM * 1e-4


def test_neo_hookean_keeps_digits_of_ln_j():
    """At strain 1e-9 in float64, the volume part of the energy is right to round-off against a series."""
    e = 1e-9
    psi = jb.neo_hookean(e * jnp.eye(2), jb.Lame(0.0, 1.0))
    log_j = 2 * (e - e**2 / 2)
    np.testing.assert_allclose(psi, 0.5 * log_j**2, rtol=10 * EPS)


def test_volume_term_to_round_off():
    """`v - ln(1 + v)` over all that its series serves, and beside it, against sixty digits."""
    inside = np.nextafter(0.25, 0)
    v = np.concatenate([np.linspace(-inside, inside, 101), [-1e-3, 1e-6, -1e-9], [-0.25, 0.25, -0.26, 0.26, 0.5, 3.0]])
    with localcontext(prec=60):
        exact = np.array([float(Decimal(value) - (1 + Decimal(value)).ln()) for value in v.tolist()])
    found = jax.jit(_less_log1p)(v)
    # The subtraction that serves beyond the series loses two bits at its end.
    np.testing.assert_allclose(found, exact, rtol=5 * EPS)


def test_domain_of_each():
    """Inverted: Macklin-Mueller is finite, the logarithm is not; near `J = 0` the logarithm grows without end."""
    params, inverted = jb.Lame(MU, LAM), jnp.diag(jnp.array([0.0, -2.0]))
    assert np.isfinite(jb.macklin_mueller(inverted, params))
    assert np.isnan(jb.neo_hookean(inverted, params))
    flat = [float(jb.neo_hookean(jnp.diag(jnp.array([0.0, d - 1])), params)) for d in (1e-2, 1e-4, 1e-8)]
    assert flat[0] < flat[1] < flat[2]
    assert jb.macklin_mueller(jnp.diag(jnp.array([0.0, -1.0])), params) < MU + LAM


@pytest.mark.parametrize("poisson", [0.0, 0.45, -0.5])
@pytest.mark.parametrize("build", [jb.lame, jb.lame_macklin_mueller])
def test_lame(build, poisson):
    params = build(1e4, poisson)
    mu = 1e4 / (2 * (1 + poisson))
    lam = 1e4 * poisson / ((1 + poisson) * (1 - 2 * poisson))
    np.testing.assert_allclose(params.mu, mu, rtol=4 * EPS)
    np.testing.assert_allclose(params.lam, lam + (mu if build is jb.lame_macklin_mueller else 0), rtol=8 * EPS)


@pytest.mark.parametrize(
    ("young", "poisson"),
    [(10000, 0), ([1e4, 2e4], [0.3, 0.4]), (np.array([1e4, 2e4]), 0.3), (jnp.full(2, 1e4), jnp.full(2, 0.3))],
)
def test_lame_accepts(young, poisson):
    params = jb.lame(young, poisson)
    assert params.mu.dtype == params.lam.dtype == jnp.float64
    expected = np.asarray(young) / (2 * (1 + np.asarray(poisson)))
    np.testing.assert_allclose(params.mu, expected, rtol=4 * EPS)


def test_lame_differentiates():
    slope = jax.grad(lambda p: jb.lame(p[0], p[1]).mu)(jnp.array([1e4, 0.25]))
    np.testing.assert_allclose(slope, [1 / 2.5, -1e4 / (2 * 1.25**2)], rtol=10 * EPS)


@pytest.mark.parametrize("build", [jb.lame, jb.lame_macklin_mueller])
@pytest.mark.parametrize(
    ("young", "poisson", "message"),
    [
        (0.0, 0.3, r"young: expected positive finite numbers, got 0\.0; a stiffness is positive"),
        (-1.0, 0.3, "young: expected positive finite numbers, got -1"),
        (np.inf, 0.3, "young: expected positive finite numbers, got inf"),
        (np.nan, 0.3, "young: expected positive finite numbers, got nan"),
        ("soft", 0.3, "young: expected real numbers, got 'soft'; convert"),
        ([1.0, -2.0], 0.3, r"young: expected positive finite numbers, got \[1\.0, -2\.0\]"),
        (1.0 - 3 * (np.arange(9) == 4), 0.3, r"young: expected positive finite numbers, got -2\.0 at entry 4"),
        (
            1.0,
            0.5,
            r"poisson: expected a value in \(-1, 0.5\), got 0.5; 0.5 is incompressible.*use 0.49, and triangles",
        ),
        (1.0, -1.0, r"poisson: expected a value in \(-1, 0.5\), got -1"),
        (1.0, np.array([0.3, 0.7]), r"poisson: expected a value in \(-1, 0.5\), got \[0.3, 0.7\]"),
        (np.ones(3), np.full(2, 0.3), r"poisson: expected a scalar or the shape of young, \(3,\), got \(2,\)"),
    ],
)
def test_lame_refuses(build, young, poisson, message):
    with pytest.raises(ValueError, match=message):
        build(young, poisson)
