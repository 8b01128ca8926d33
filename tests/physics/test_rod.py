"""Rods: section and strains against closed forms, the elastica, the tendon beam against finite elements."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import MATERIALS, central_difference, lateral_stretch, rotation
from scipy.special import ellipe, ellipk

import jaxbeam as jb
from jaxbeam.mesh.line import Line, straight
from jaxbeam.physics.rod import fibre_energy, rod, shear_modulus
from jaxbeam.physics.rod_tendon import rod_tendons
from jaxbeam.scene.evaluation import smallest_jacobian
from jaxbeam.scene.rigid import check_held
from jaxbeam.scene.scene import is_valid

smallest = jax.jit(smallest_jacobian)
MU, LAM = 3.0, 7.0
HEIGHT = 0.8
# Tendon beams of six-node triangles, converged under refinement, each tendon's free end widened (DESIGN.md, section 4):
# ratio of the top tendon, tip angle, length and tension of the top tendon.
FINITE_ELEMENTS = [(0.95, 2.048, 1.7216, 42.74), (0.8, 10.144, 1.6055, 209.7), (0.6, 25.06, 1.340, 526.0)]
FINITE_ELEMENTS.append((0.5, 32.17, 1.137, 684.0))


@pytest.fixture(scope="module")
def beam():
    """The reference scene as a rod."""
    return jb.rod_beam()


@pytest.fixture(scope="module")
def turned(beam):
    """Its equilibria at the ratios of `FINITE_ELEMENTS`."""
    found = [jb.check(jb.equilibrium(jb.command(beam, [row[0], 1.0]))) for row in FINITE_ELEMENTS]
    return [(jb.command(beam, [row[0], 1.0]), solution) for row, solution in zip(FINITE_ELEMENTS, found, strict=True)]


def arc(nodes: int = 5, radius: float = 2.0, angle: float = 1.5) -> Line:
    """An arc of a circle that starts at the origin along x."""
    theta = np.linspace(0.0, angle, nodes)
    rest = np.stack([radius * np.sin(theta), radius * (1 - np.cos(theta)), HEIGHT * theta], axis=1)
    return Line(rest, np.stack([np.arange(nodes - 1), np.arange(1, nodes)], axis=1), HEIGHT)


def cantilever(force, nodes: int = 129, height: float = 1e-3) -> jb.Scene:
    """A rod of length 1 and `EI = 1`, so slender that it hardly stretches, with a force on its end."""
    line = straight(1.0, height, nodes)
    body = rod(line, height, jb.lame(12 / height**3, 0.0), jb.linear_elastic)
    load = jb.dead_load(line, [nodes - 1], jnp.asarray(force))
    return jb.Scene(line, (body, load), jb.clamped(line, [0]), np.array([nodes - 1]))


def difference(f, value):
    """Derivative of `f` in a scalar or a vector by central differences, with a step of 1e-5 of it."""
    flat = lambda v: f(jnp.asarray(v).reshape(value.shape))
    return central_difference(flat, np.ravel(value), 1e-5 * float(value.max())).reshape(value.shape)


# ---------------------------------------------------------------------------------------- the section's law


@pytest.mark.parametrize("density", MATERIALS)
@pytest.mark.parametrize("stretch", [0.7, 0.95, 1.0, 1.1])
def test_fibre_is_free_to_contract(density, stretch):
    """Energy and stress are those of the density at the lateral stretch worked by hand."""
    b = lateral_stretch(density, stretch, MU, LAM)
    params = jb.Lame(jnp.asarray(MU), jnp.asarray(LAM))
    H = np.diag([stretch, b]) - np.eye(2)
    value, stress = jax.jit(jax.value_and_grad(fibre_energy, argnums=1), static_argnums=0)(
        density, jnp.asarray(stretch - 1), params
    )
    np.testing.assert_allclose(value, density(jnp.asarray(H), params), atol=1e-14 * MU)
    np.testing.assert_allclose(stress, MATERIALS[density](H + np.eye(2), MU, LAM)[0, 0], atol=1e-13 * LAM)


@pytest.mark.parametrize("poisson", [-0.5, -0.3, 0.0, 0.45])
def test_fibre_of_any_stretch_and_poisson_ratio(poisson):
    """Against a search for the least energy. At a negative ratio a pulled fibre widens, and one that is compressed much
    has no least energy: the density falls without end as `J` goes to 0."""
    lame = jb.lame(1.0, poisson)
    mu, lam = float(lame.mu), float(lame.lam)
    stretches = np.array([0.05, 0.3, 0.9, 1.5, 4.0, 6.0])[0 if poisson >= 0 else 2 :]
    of = lambda a, b: mu / 2 * (a**2 + b**2 - 2) - mu * np.log(a * b) + lam / 2 * np.log(a * b) ** 2
    least = [of(a, np.geomspace(0.1, 20, 200_001)).min() for a in stretches]
    params = jb.Lame(jnp.asarray(mu), jnp.asarray(lam))
    energy = jax.jit(jax.vmap(lambda e: fibre_energy(jb.neo_hookean, e, params)))
    np.testing.assert_allclose(energy(jnp.asarray(stretches - 1)), least, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_fibre_differentiates_to_third_order_and_in_the_material():
    """Against the same law with the contraction `(lam + mu) a / (mu + lam a^2)` put in."""

    def by_hand(e, params):
        a, mu, lam = 1 + e, params.mu, params.lam
        q = (lam + mu) * a / (mu + lam * a**2) - 1
        return jb.macklin_mueller(jnp.diag(jnp.stack([e, q])), params)

    def slopes(law):
        third = jax.grad(jax.grad(jax.grad(law)))
        return jax.jit(lambda e, p: (third(e, p), jax.grad(law, argnums=1)(e, p)))

    params = jb.Lame(jnp.asarray(MU), jnp.asarray(LAM))
    law = lambda e, params: fibre_energy(jb.macklin_mueller, e, params)
    for e in (-0.3, 0.0, 0.2):
        found, expected = slopes(law)(e, params), slopes(by_hand)(e, params)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-13 * LAM)


@pytest.mark.parametrize("density", MATERIALS)
def test_small_strain_constants(density):
    """`E' = E / (1 - nu^2)` and `G`; for Macklin-Mueller with the constants that it behaves as."""
    young, poisson = (9962, 0.4444) if density is jb.macklin_mueller else (1e4, 0.45)
    params = jb.lame(1e4, 0.45)
    plane = jax.grad(jax.grad(fibre_energy, argnums=1), argnums=1)
    both = jax.jit(lambda params: (plane(density, jnp.zeros(()), params), shear_modulus(density, params, float)))(
        params
    )
    # 9962 and 0.4444 are rounded.
    np.testing.assert_allclose(both, [young / (1 - poisson**2), 1e4 / 2.9], rtol=1e-4)


def test_linear_energy_is_simos():
    """`1/2 (EA eps^2 + GA gamma^2 + EI kappa^2) L` with the strains `R^T r' - e1` and `theta'` of the middle."""
    line, rng = straight(2.0, 0.3, 2), np.random.default_rng(0)
    x = np.asarray(line.nodes) + [[0, 0, 0.3 * 2.0]] + 0.1 * rng.normal(size=(2, 3))
    found = jb.energy(jb.Scene(line, (rod(line, 0.5, jb.Lame(MU, LAM), jb.linear_elastic),), jb.clamped(line, [0])), x)
    slope = (x[1] - x[0]) / 2.0
    eps, gamma = rotation(x[:, 2].mean() / 0.3).T @ slope[:2] - [1, 0]
    plane = 4 * MU * (LAM + MU) / (LAM + 2 * MU)
    strain = plane * 0.5 * eps**2 + 5 / 6 * MU * 0.5 * gamma**2 + plane * 0.5**3 / 12 * (slope[2] / 0.3) ** 2
    np.testing.assert_allclose(found, 0.5 * strain * 2.0, rtol=1e-13)


def test_rigid_motions_of_a_curved_rod_cost_nothing():
    line = arc()
    scene = jb.Scene(line, (rod(line, HEIGHT, jb.lame(1e4, 0.45)),), jb.clamped(line, [0]))
    assert jb.energy(scene, line.nodes) == 0
    for angle in (0.7, 8.0):
        moved = np.asarray(line.nodes) @ np.pad(rotation(angle).T, (0, 1)) + [1.0, -2.0, 0.0]
        moved[:, 2] = np.asarray(line.nodes)[:, 2] + HEIGHT * angle
        # Stiffness times round-off of positions.
        np.testing.assert_allclose(jb.forces(scene, jnp.asarray(moved)), 0, atol=1e4 * 1e-14)


def test_stretches_of_fibres():
    """By definition: those of the axis less height times curvature. They stand for `J` where sections overlap."""
    line = straight(1.0, HEIGHT, 2)
    scene = jb.Scene(line, (rod(line, HEIGHT, jb.lame(1e4, 0.3)),), jb.clamped(line, [0]))
    for curvature in (1.0, -1.0, 3.0):
        half = 0.5 * curvature
        # The section in the middle is upright.
        x = jnp.array([[0.0, 0.0, -HEIGHT * half], [0.9, 0.0, HEIGHT * half]])
        np.testing.assert_allclose(smallest(scene, x), 0.9 - 0.4 * abs(curvature), rtol=1e-14)
    with pytest.raises(ValueError, match="x0: element 0 is inverted"):
        jb.equilibrium(scene, [[-0.5, 0.0, 0.0], [0.4, 0.0, HEIGHT * 3.0]])


# -------------------------------------------------------------------------------------------- the elastica


@pytest.mark.parametrize(
    ("load", "down", "back"),
    [(1, 0.30172, 0.05643), (2, 0.49346, 0.16064), (5, 0.71379, 0.38763), (10, 0.81061, 0.55500)],
)
def test_elastica(load, down, back):
    """Mattiasson, Int. J. Numer. Methods Eng. 17 (1981), 145-153: the inextensible cantilever under a force."""
    scene = cantilever([0.0, -load, 0.0])
    x = jb.check(jb.equilibrium(scene)).x
    moved = x[-1] - scene.mesh.nodes[-1]
    # 128 elements leave 8e-6 in `back` at the largest load, which falls fourfold when they are halved.
    np.testing.assert_allclose([-moved[1], -moved[0]], [down, back], atol=2e-5)


def test_moment_bends_to_a_circle():
    """`M = 2 pi EI / L`: the end comes back to the start, after one full turn."""
    scene = cantilever([0.0, 0.0, 2 * np.pi / 1e-3])
    x = jb.check(jb.equilibrium(scene)).x
    np.testing.assert_allclose(x[-1, :2], x[0, :2], atol=1e-8)
    np.testing.assert_allclose(jb.section_rotation(scene, x), 360.0, rtol=1e-9)
    # The corners of a regular polygon of sides of their length at rest.
    radius = 0.5 / 128 / np.sin(np.pi / 128)
    np.testing.assert_allclose(np.ptp(np.asarray(x)[:, 1]), 2 * radius, rtol=1e-3)


def test_euler_buckling():
    """Straight under `0.99 pi^2 EI / 4 L^2`; beyond it the elastica with an end turned by 60 degrees.

    Timoshenko and Gere 1961, Theory of Elastic Stability, section 2.7: with `k = sin 30`, `P = K(k)^2 EI / L^2`,
    `x / L = 2 E(k) / K(k) - 1` and `y / L = 2 k / K(k)`.
    """
    straight_on = jb.check(jb.equilibrium(cantilever([-0.99 * np.pi**2 / 4, 0.0, 0.0], height=0.02)))
    np.testing.assert_allclose(straight_on.x[:, 1:], 0, atol=1e-12)
    k = np.sin(np.pi / 6)
    K, E = ellipk(k**2), ellipe(k**2)
    scene = cantilever([-(K**2), 0.0, 0.0], height=0.02)
    x = jb.check(jb.equilibrium(scene)).x
    end = np.abs(x[-1] - x[0])
    # It stretches and shears by about `P / EA = P height^2 / 12`, 1e-4.
    np.testing.assert_allclose(end[:2], [2 * E / K - 1, 2 * k / K], rtol=1e-3)
    np.testing.assert_allclose(abs(jb.section_rotation(scene, x)), 60.0, rtol=1e-3)


# ----------------------------------------------------------------------------------------- the tendon beam


def test_scene_at_rest(beam):
    threads = beam.terms[1]
    np.testing.assert_array_equal(beam.mesh.nodes[:, 0], np.linspace(-1.75, 1.75, 9))
    np.testing.assert_array_equal(beam.mesh.nodes[:, 1:], 0)
    np.testing.assert_array_equal(threads.nodes, [[0, 4], [0, 4]])
    np.testing.assert_array_equal(threads.params.attachment.eccentricity, [[0.4, 0.4], [-0.4, -0.4]])
    np.testing.assert_allclose(threads.params.natural, 1.75, rtol=1e-15)
    np.testing.assert_array_equal(beam.fixed, np.arange(9)[:, None] == [0, 0, 0])
    np.testing.assert_array_equal(beam.tip, [8])
    assert jb.energy(beam, beam.mesh.nodes) == 0
    assert np.abs(jb.forces(beam, beam.mesh.nodes)).max() == 0
    assert jax.tree.structure(beam) == jax.tree.structure(jb.rod_beam(length=2.0))


@pytest.mark.slow
def test_against_finite_elements(turned):
    """Angle within 2 %, length of the tendon within 1.5 % and tension within 6 %: measured 1.6, 1.2 and 5.0."""
    for (scene, solution), (_, angle, length, tension) in zip(turned, FINITE_ELEMENTS, strict=True):
        np.testing.assert_allclose(jb.tip_angle(scene, solution.x), angle, rtol=0.02)
        np.testing.assert_allclose(jb.tendon_lengths(scene, solution.x)[0], length, rtol=0.015)
        np.testing.assert_allclose(jb.tendon_tensions(scene, solution.x)[0], tension, rtol=0.06)


def test_mirrored_commands_bend_the_other_way(beam, turned):
    scene = jb.command(beam, [1.0, 0.8])
    solution = jb.check(jb.equilibrium(scene))
    np.testing.assert_allclose(solution.x, turned[1][1].x * np.array([1, -1, -1]), atol=1e-9)


@pytest.mark.slow
def test_few_nodes_suffice(turned):
    """The default is within 0.5 % of the limit (10.349 degrees), of second order in the length of elements."""
    angles = [float(jb.tip_angle(*at)) for at in [(turned[1][0], turned[1][1].x)]]
    fine = jb.command(jb.rod_beam(33), [0.8, 1.0])
    angles.append(float(jb.tip_angle(fine, jb.check(jb.equilibrium(fine)).x)))
    limit = angles[1] + (angles[1] - angles[0]) / 15
    np.testing.assert_allclose(limit, 10.349, atol=1e-3)
    np.testing.assert_allclose(angles[0], limit, rtol=5e-3)


def test_units(turned):
    """Another unit of length and of force: the same angle, from the same program."""
    scene = jb.rod_beam(length=3500.0, height=800.0, young=10.0, tendon_modulus=2e6)
    scene = jb.command(scene, [0.8, 1.0])
    solution = jb.check(jb.equilibrium(scene))
    np.testing.assert_allclose(jb.tip_angle(scene, solution.x), jb.tip_angle(turned[1][0], turned[1][1].x), rtol=1e-9)
    np.testing.assert_allclose(solution.x, 1e3 * turned[1][1].x, atol=1e-6)


def test_measures(turned):
    scene, solution = turned[2]
    x = solution.x
    np.testing.assert_array_equal(jb.tip_position(scene, x), x[-1, :2])
    np.testing.assert_allclose(jb.section_rotation(scene, x), np.degrees(x[-1, 2] / 0.8), rtol=1e-14)
    ends = np.asarray(x)[[0, 4]]
    normal = np.stack([-np.sin(ends[:, 2] / 0.8), np.cos(ends[:, 2] / 0.8)], axis=1)
    lengths = [np.linalg.norm(np.diff(ends[:, :2] + e * normal, axis=0)) for e in (0.4, -0.4)]
    np.testing.assert_allclose(jb.tendon_lengths(scene, x), lengths, rtol=1e-14)
    stretch = jb.tendon_lengths(scene, x) - scene.terms[1].params.commanded
    in_tendons = 0.5 * jb.tendon_tensions(scene, x) * stretch
    np.testing.assert_allclose(jb.strain_energy(scene, x).sum() + in_tendons.sum(), solution.energy, rtol=1e-12)
    assert 0 < solution.smallest_jacobian < 1
    for measure in (jb.cauchy_stress, jb.jacobians):
        with pytest.raises(ValueError, match="scene: expected a solid term, got none; stress and J are measured on s"):
            measure(scene, x)


def angle_of(values):
    scene = jb.rod_beam(**{name: value for name, value in values.items() if name != "ratios"})
    scene = jb.command(scene, values["ratios"])
    return jb.tip_angle(scene, jb.equilibrium(scene).x)


@pytest.mark.slow
def test_gradient_through_equilibrium():
    """In every real argument, against central differences."""
    values = {"length": 3.5, "height": 0.8, "young": 1e4, "poisson": 0.45, "tendon_modulus": 2e3}
    values = {name: jnp.asarray(value) for name, value in values.items()} | {"ratios": jnp.array([0.6, 1.1])}
    slopes = jax.jit(jax.grad(angle_of))(values)
    for name, start in values.items():
        # Relative step 1e-5: truncation 1e-10, and solves to 1e-10 over the step, 1e-5 of slopes of about 10.
        np.testing.assert_allclose(
            slopes[name], difference(lambda v, name=name: angle_of(values | {name: v}), start), rtol=2e-5
        )
        assert (np.asarray(slopes[name]) != 0).all()


@pytest.mark.slow
def test_sweep(beam, turned):
    rows = np.array([[row[0], 1.0] for row in FINITE_ELEMENTS])
    batch = jb.check(jb.sweep(beam, rows))
    for x, (_, solution) in zip(batch.x, turned, strict=True):
        np.testing.assert_allclose(x, solution.x, atol=1e-8)


@pytest.mark.slow
def test_ramp(beam, turned):
    path = jb.check(jb.ramp(beam, [0.5, 1.0], steps=6))
    np.testing.assert_array_equal(path.x[0], beam.mesh.nodes)
    np.testing.assert_allclose(path.x[-1], turned[3][1].x, atol=1e-8)


@pytest.mark.slow
def test_reach(beam):
    """Only the top tendon is pulled: the bottom one could help only by pushing, beyond its bound."""
    found = jb.reach(beam, 10.0)
    assert found.status == jb.DesignStatus.REACHED
    scene = jb.command(beam, found.theta)
    np.testing.assert_allclose(jb.tip_angle(scene, jb.equilibrium(scene).x), 10.0, atol=1e-7)
    assert 0.8 < found.theta[0] < 0.81
    assert found.theta[1] == 1.0


# ---------------------------------------------------------------------------------------- the hand calculation


def test_hand_calculation_balances():
    """Its lengths and tensions meet the two equations of equilibrium; the tip rises by `1.5 kappa a^2`."""
    ratios, plane = np.array([0.7, 1.1]), 1e4 / (1 - 0.45**2)
    found = jb.euler_bernoulli(ratios)
    np.testing.assert_allclose(found.tensions, 2e3 / (ratios * 1.75) ** 2 * (found.lengths - ratios * 1.75), rtol=1e-12)
    stretch = found.lengths.mean() / 1.75 - 1
    curvature = (found.lengths[1] - found.lengths[0]) / 1.75 / 0.8
    np.testing.assert_allclose(plane * 0.8 * stretch, -found.tensions.sum(), rtol=1e-12)
    moment = 0.4 * (found.tensions[0] - found.tensions[1])
    np.testing.assert_allclose(plane * 0.8**3 / 12 * curvature, moment, rtol=1e-12)
    np.testing.assert_allclose(found.tip_angle, np.degrees(np.arctan2(1.5 * curvature * 1.75**2, 3.5)), rtol=1e-12)


def test_hand_calculation_is_the_limit_of_small_pulls(beam):
    """With the constants that Macklin-Mueller has at small strain; what differs is of second order in the pull."""
    mu, lam = 1e4 / 2.9, 1e4 * 0.45 / 1.45 / 0.1 - 1e4 / 2.9
    constants = {"young": mu * (3 * lam + 2 * mu) / (lam + mu), "poisson": lam / (2 * (lam + mu))}
    scene = jb.command(beam, [0.9999, 1.0])
    x = jb.check(jb.equilibrium(scene)).x
    found = jb.euler_bernoulli([0.9999, 1.0], **constants)
    np.testing.assert_allclose(jb.tip_angle(scene, x), found.tip_angle, rtol=1e-4)
    np.testing.assert_allclose(jb.tendon_tensions(scene, x), found.tensions, rtol=1e-4)


def test_hand_calculation_is_close_and_differentiable():
    """Within 2 % of the angle of finite elements up to a ratio of 0.8."""
    for ratio, angle, *_ in FINITE_ELEMENTS[:2]:
        np.testing.assert_allclose(jb.euler_bernoulli([ratio, 1.0]).tip_angle, angle, rtol=0.02)
    of = jax.jit(lambda values: jb.euler_bernoulli(*values).tip_angle)
    values = [jnp.array([0.7, 1.1]), *(jnp.asarray(v) for v in (3.5, 0.8, 1e4, 0.45, 2e3))]
    for k, (slope, value) in enumerate(zip(jax.jit(jax.grad(of))(values), values, strict=True)):
        moved = lambda v, k=k: of([*values[:k], jnp.asarray(v), *values[k + 1 :]])
        np.testing.assert_allclose(slope, difference(moved, value), rtol=1e-6)
    with pytest.raises(ValueError, match=r"ratios: expected shape \(2,\), of the top .*, got \(3,\)"):
        jb.euler_bernoulli([1.0, 1.0, 1.0])


# ------------------------------------------------------------------------------------------------- refused

LINE = straight(2.0, HEIGHT, 3)
BODY = rod(LINE, HEIGHT, jb.lame(1e4, 0.3))


def test_one_clamped_node_holds_a_rod():
    fixed = np.zeros((3, 3), bool)
    fixed[0, :2] = True
    with pytest.raises(ValueError, match=r"fixed: the body is not held, .*: rotation about \(-1, 0\)"):
        check_held(jb.Scene(LINE, (BODY,), fixed))
    with pytest.raises(ValueError, match="translation in x and translation in y and rotation"):
        check_held(jb.Scene(LINE, (BODY,), np.zeros((3, 3), bool)))
    fixed[1, 1] = True
    springs = jb.penalty_springs(LINE, [2], 1.0)
    for held in (jb.Scene(LINE, (BODY,), fixed), jb.Scene(LINE, (BODY, springs), np.zeros((3, 3), bool))):
        check_held(held)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Line(np.zeros((3, 2)), [[0, 1]], 1.0), r"nodes: expected shape \(n, 3\), got \(3, 2\); give one"),
        (lambda: Line(jnp.zeros((3, 3), int), [[0, 1]], 1.0), r"nodes: expected floats, got dtype int64; convert"),
        (lambda: Line(LINE.nodes, [[0, 1, 2]], 1.0), r"elements: expected shape \(m, 2\) with m >= 1, got \(1, 3\)"),
        (lambda: Line(LINE.nodes, [[0, 3]], 1.0), r"elements: element 0 is \[0, 3\], but nodes are numbered 0 to 2"),
        (lambda: Line(LINE.nodes, [[0, 1]], 1.0), "nodes: 1 belong to no element, the first is node 2; remove"),
        (lambda: Line(LINE.nodes, LINE.elements, 0.0), "radian: expected a positive finite number, got 0.0"),
        (lambda: Line(LINE.nodes * np.nan, LINE.elements, 1.0), "nodes: node 0 is not finite"),
        (lambda: Line(LINE.nodes * 0, LINE.elements, 1.0), "nodes: element 0 has no length"),
        (lambda: Line(LINE.nodes[:, [1, 0, 2]], LINE.elements, 1.0), "element 0 runs at 1.571 radians, but its angle"),
        (lambda: straight(1.0, 1.0, 1), "nodes: expected a whole number of at least 2, got 1"),
        (lambda: straight(-1.0, 1.0, 2), "length: expected a positive finite number, got -1.0"),
        (lambda: rod(LINE, 0.0, jb.lame(1.0, 0.3)), "height: expected positive finite numbers, got 0.0"),
        (lambda: rod(LINE, np.ones(3), jb.lame(1.0, 0.3)), r"height: expected a scalar or 2 entries, .* \(3,\)"),
        (lambda: rod(LINE, 1.0, jb.lame(np.ones(3), 0.3)), r"params\.mu: expected a scalar or 2 entries, one for each"),
        (
            lambda: rod_tendons(LINE, [[0, 2]], [0.1], 1.0),
            r"eccentricity: expected a scalar or shape \(1, 2\)",
        ),
        (lambda: rod_tendons(LINE, [[0, 2]], np.nan, 1.0), "eccentricity: expected finite numbers, got nan"),
        (lambda: rod_tendons(LINE, [[0, 3]], 0.1, 1.0), "nodes: 3 is out of range"),
        (lambda: jb.rod_beam(8), "nodes: expected an odd number, got 8: no node .* use 7 or 9"),
        (lambda: jb.rod_beam(height=-1.0), "height: expected a positive finite number, got -1.0"),
        (lambda: jb.rod_beam(poisson=0.5), r"poisson: expected a value in \(-1, 0.5\)"),
        (lambda: jb.dead_load(LINE, [2], [0.0, 1.0]), r"force: expected shape \(3,\) or \(1, 3\), got \(2,\)"),
    ],
)
def test_refuses(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_terms_of_solids_are_refused_on_a_rod():
    """Tendons fixed to nodes would take the angle for a coordinate."""
    threads = jb.tendons(LINE, [[0, 2]], 1.0)
    with pytest.raises(
        ValueError, match=r"terms\[1\]: it is made for nodes of 2 coordinates, .* use rod and rod_tendons"
    ):
        jb.Scene(LINE, (BODY, threads), jb.clamped(LINE, [0]))


def test_traced_parameters_out_of_range_are_invalid():
    valid = jax.jit(lambda **values: is_valid(jb.rod_beam(**values)))
    assert valid(height=0.8, young=1e4)
    assert not valid(height=-0.8, young=1e4)
    assert not valid(height=0.8, young=-1e4)
