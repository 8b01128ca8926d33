"""Weight, contact and cables under tension against beam theory.

The solutions of beam theory are worked out here, without jaxbeam. Lengths are in units of the height `H = 1`, and the
thickness is 1. In plane strain the bending stiffness is `EI = E / (1 - nu^2) H^3 / 12`. Shear, stretch and finite
strain separate a solid from a slender beam by a few times `(H / L)^2`. A test therefore either adds the shear
(Timoshenko), or takes two lengths and extrapolates to the slender beam.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

import jaxbeam as jb

YOUNG = 1e6


def bending_stiffness(poisson):
    """`EI`."""
    return YOUNG / (1 - poisson**2) / 12


def beam(length, nx, ny, poisson, *others):
    """A beam of six-node triangles, held at its left end, with the body and the terms that `others` make of its mesh.

    At Poisson's ratio 0 the end is clamped. At another the middle of the end is fixed, and its other nodes may move
    along the end: it contracts as any section does. A clamp that prevents this stiffens the beam near the clamp, an
    error of first order in `H / L`.
    """
    mesh = jb.rectangle(length, 1.0, nx, ny, "crossed", order=2)
    left, right = (jb.nodes_where(mesh, lambda x, y, s=s: s * x > length / 2 - 1e-9) for s in (-1, 1))
    fixed = np.zeros(mesh.nodes.shape, bool)
    fixed[left, 0] = True
    fixed[left if poisson == 0 else middle(mesh, left), 1] = True
    body = jb.solid(mesh, jb.lame(YOUNG, poisson), jb.neo_hookean)
    return jb.Scene(mesh, (body, *(make(mesh) for make in others)), fixed, right)


def middle(mesh, nodes):
    """The node at mid-height."""
    return nodes[np.argmin(np.abs(np.asarray(mesh.nodes)[nodes, 1]))]


def extrapolated(short, long):
    """The limit of a slender beam, from two lengths of which one is twice the other: their error falls fourfold."""
    return (4 * long - short) / 3


# -------------------------------------------------------------------------------------------------- weight


def sag(length, nx, ny, poisson, force):
    """A cantilever under `force` per length, downwards: how far the middle of the tip moves back and down, over the
    length; and the turn of the tip section in radians."""
    scene = beam(length, nx, ny, poisson, lambda mesh: jb.weight(mesh, [0.0, -force]))
    found = jb.check(jb.equilibrium(scene))
    tip = middle(scene.mesh, scene.tip)
    moved = np.asarray(found.x - scene.mesh.nodes)[tip] / length
    return np.array([-moved[0], -moved[1], -np.deg2rad(jb.section_rotation(scene, found.x))])


def timoshenko_error(nx, ny, length=20.0):
    """Relative error of a small deflection against `q L^4 / 8 EI + q L^2 / (2 kappa G A)`, at Poisson's ratio 0.

    There all theories of shear agree on `kappa = 10 (1 + nu) / (12 + 11 nu) = 5/6`, and `G = E / 2`.
    """
    stiffness, shear = bending_stiffness(0.0), 5 / 6 * YOUNG / 2
    # The tip moves by 1e-5 of the length, so curvature matters by 1e-10.
    force = 8e-5 * stiffness / length**3
    theory = force * length**4 / (8 * stiffness) + force * length**2 / (2 * shear)
    assert theory > (1 + 1.99e-3) * 1e-5 * length
    return sag(length, nx, ny, 0.0, force)[1] * length / theory - 1


def test_weight_bends_a_beam_as_timoshenko_says():
    """Shear is 2.0e-3 of the deflection. The mesh leaves 2.3e-5, too stiff: a hundredth of the shear."""
    assert -3e-5 < timoshenko_error(81, 3) < 0


@pytest.mark.slow
def test_the_error_against_timoshenko_is_that_of_the_mesh():
    """It falls more than tenfold on each mesh of half the size, to the limit -0.026 `(H / L)^3`: the clamp keeps its
    section from warping, which Timoshenko's beam knows nothing of."""
    limit = -0.026 / 20**3
    left = [timoshenko_error(20 * n + 1, 2 * n + 1) - limit for n in (1, 2, 4)]
    assert left[0] < 10 * left[1] < 100 * left[2] < 0
    assert left[2] > -6e-7
    np.testing.assert_allclose(timoshenko_error(81, 9, 10.0), -0.026 / 10**3, rtol=0.05)


def heavy_elastica(load):
    """Tip of the inextensible cantilever with `q L^3 / EI = load`: how far it moves back and down, and its turn.

    The turn `t` of a section downwards obeys `t'' = -load (1 - s) cos t`, `t(0) = 0`, `t'(1) = 0`, by shooting.
    """
    slopes = lambda s, y: [y[1], -load * (1 - s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]
    shoot = lambda k: solve_ivp(slopes, (0, 1), [0, k, 0, 0], method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    turn, _, along, down = shoot(brentq(lambda k: shoot(k)[1], 0, load / 2, xtol=1e-14))
    return np.array([1 - along, down, turn])


@pytest.mark.parametrize("poisson", [0.0, 0.3])
def test_heavy_elastica(poisson):
    """The tip hangs down by 0.64 of the length. Shear, stretch and finite strain leave up to 5.4e-3 at `L / H = 20`
    and a quarter of that at 40; the mesh leaves 3e-5 of the limit."""
    exact = heavy_elastica(8.0)
    assert exact[1] > 0.6
    force = lambda length: 8.0 * bending_stiffness(poisson) / length**3
    short, long = (sag(length, 81, 3, poisson, force(length)) for length in (20.0, 40.0))
    errors = np.array([short, long]) / exact - 1
    assert (np.abs(errors[0]) < 5.5e-3).all()
    np.testing.assert_allclose(errors[0] / errors[1], 4, rtol=0.05)
    np.testing.assert_allclose(extrapolated(short, long), exact, rtol=5e-5)


# ----------------------------------------------------------------------------------- a beam laid on a floor

# Length `a` of the free part of a beam without shear, and height `h` of its lower side above the floor.
FREE, HEIGHT = 20.0, 0.05
# `EI w'''' = q` with `w = w' = 0` at the clamp and `w = h`, `w' = w'' = 0` at touch-down gives `q a^4 / 72 EI = h`.
# The clamp carries `2 q a / 3` and the moment `q a^2 / 6`. The floor carries the other third of the weight of the free
# part, in one point.
WEIGHT = 72 * bending_stiffness(0.0) * HEIGHT / FREE**4
# The transition is a twentieth of the depth in the stiffest floor, `q / k = 1.9e-7`.
TRANSITION = 1e-8
# The length `sqrt(EI / kappa G A)` over which shear acts.
LAYER = (bending_stiffness(0.0) / (5 / 6 * YOUNG / 2)) ** 0.5


def laid(stiffness, nx, ny):
    """A clamped beam, twice as long as its free part, and its equilibrium."""
    floor = lambda mesh: jb.contact(
        mesh,
        jb.nodes_where(mesh, lambda x, y: y < -0.5 + 1e-9),
        jb.half_plane([0.0, -0.5 - HEIGHT], [0.0, 1.0]),
        stiffness,
        TRANSITION,
    )
    scene = beam(2 * FREE, nx, ny, 0.0, lambda mesh: jb.weight(mesh, [0.0, -WEIGHT]), floor)
    return scene, jb.check(jb.equilibrium(scene))


def touched_down(lam):
    """Force and moment of the clamp, and the free length, of Timoshenko's beam, without jaxbeam.

    Shear keeps the force at touch-down from being one in a point. It sets in over the length `lam`, where the turn of
    the section dies away as `exp(-s / lam)`. With `Q = q / EI`, the clamp's force `q c` and its moment `m EI`,

        psi' = m - Q (c s - s^2 / 2),   w' = psi + Q lam^2 (c - s),

    and at the free length `s = a`: `w = h`, `w' = 0`, `psi' = -psi / lam`.
    """
    load = WEIGHT / bending_stiffness(0.0)

    def at(a):
        """`c` and `m` from the last two conditions, and `w(a)`."""
        turn, bend = np.array([-load * a**2 / 2, a]), np.array([-load * a, 1.0])
        rows = [turn + np.array([load * lam**2, 0]), bend + turn / lam]
        right = [load * (lam**2 * a - a**3 / 6), -load * (a**2 / 2 + a**3 / (6 * lam))]
        c, m = np.linalg.solve(rows, right)
        down = m * a**2 / 2 - load * (c * a**3 / 6 - a**4 / 24) + load * lam**2 * (c * a - a**2 / 2)
        return c, m, down

    a = brentq(lambda a: at(a)[2] - HEIGHT, 0.5 * FREE, 1.5 * FREE, xtol=1e-13)
    c, m, _ = at(a)
    return np.array([WEIGHT * c, m * bending_stiffness(0.0), a])


def clamp(scene, x):
    """Force and moment of the clamp."""
    force, arm = np.asarray(jb.reactions(scene, x)), np.asarray(x) - [-FREE, 0.0]
    return force[:, 1].sum(), np.sum(arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0])


def touch_down_error(stiffness, nx, ny):
    """Relative errors of force and moment of the clamp against Timoshenko's beam."""
    scene, found = laid(stiffness, nx, ny)
    return np.array(clamp(scene, found.x)) / touched_down(LAYER)[:2] - 1


def test_touch_down():
    """The closed form, with what shear adds to it; a solid lies 8e-5 beside it, by its mesh (see below).

    Shear lowers the force of the clamp by `4.5 (lam / a)^2 = 2.2e-3` and its moment by `8 (lam / a)^2 = 4.0e-3`.
    """
    third = WEIGHT * FREE / 3
    slender = np.array([2 * third, third * FREE / 2, FREE])
    np.testing.assert_allclose(touched_down(1e-4), slender, rtol=1e-5)
    sheared = slender[:2] * (1 - np.array([4.5, 8.0]) * (LAYER / FREE) ** 2)
    np.testing.assert_allclose(touched_down(LAYER)[:2], sheared, rtol=2e-5)
    scene, found = laid(1e7, 81, 3)
    force, moment = clamp(scene, found.x)
    np.testing.assert_allclose([force, moment], touched_down(LAYER)[:2], rtol=1e-4)
    # The floor carries the rest of the weight: that of the part that lies, and a third of that of the free part within
    # four heights of touch-down. As the clamp carries less by 2.2e-3, it is more by twice that.
    floor = np.asarray(jb.contact_forces(scene, found.x))
    np.testing.assert_allclose(floor.sum(axis=0), [0, WEIGHT * 2 * FREE - force], atol=1e-7)
    x = np.asarray(scene.mesh.nodes)[scene.terms[2].nodes[:, 2], 0] + FREE
    near = np.abs(x - FREE) < 4
    np.testing.assert_allclose(floor[near, 1].sum() - 4 * WEIGHT, third, rtol=5e-3)
    first = x[np.asarray(jb.penetration(scene, found.x)) > 0].min()
    # The edges are 0.5 long.
    assert abs(first - touched_down(LAYER)[2]) < 0.5


@pytest.mark.parametrize(("stiffness", "rest"), [(1e5, 2.5e-3), (1e6, 2e-5), (1e7, 5e-7)])
def test_depth_on_the_floor(stiffness, rest):
    """Where the beam lies, it is `q / k + w / 2` deep in a floor of stiffness `k` and transition `w`.

    So the depth falls as one over the stiffness. The ends of the part that lies are 8 heights away. On a soft floor
    their effect dies away as `exp(-beta s)`, `beta = (k / 4 EI)^(1/4)`: to 3e-3 and 3e-5. On the hard one it leaves
    what dies away in the solid.
    """
    scene, found = laid(stiffness, 81, 3)
    x = np.asarray(scene.mesh.nodes)[scene.terms[2].nodes[:, 2], 0]
    depth = np.asarray(jb.penetration(scene, found.x))[(x > 8) & (x < 12)]
    np.testing.assert_allclose(depth, WEIGHT / stiffness + 0.5 * TRANSITION, rtol=rest)


@pytest.mark.slow
def test_the_error_at_touch_down_is_that_of_mesh_and_floor():
    """Meshes of half the size leave less than half of it, and 2e-5 at last, a hundredth of what shear does. A floor
    ten times as stiff leaves less than a quarter, of 1e-4."""
    errors = [touch_down_error(1e7, 40 * n + 1, 2 * n + 1) for n in (1, 2, 4)]
    assert (errors[0] > 2 * errors[1]).all() and (errors[1] > 2 * errors[2]).all() and (errors[2] > 0).all()
    np.testing.assert_allclose(errors[2], 0, atol=2e-5)
    floors = [touch_down_error(stiffness, 161, 9) - errors[2] for stiffness in (1e5, 1e6)]
    assert (np.abs(floors[0]) < 1e-4).all() and (4 * np.abs(floors[1]) < np.abs(floors[0])).all()


# ------------------------------------------------------------------- a column under a cable to its own foot


def column(length, nx, ny, poisson):
    """A column and a cable from the middle of its tip to the middle of its foot.

    The line of the cable passes through the foot. So with `v` the deflection of the tip `EI w'' = T (v x / L - w)`,
    and with `w(0) = w'(0) = 0` it is `w = v (x / L - sin(k x) / (k L))`, `k^2 = T / EI`. Then `w(L) = v` asks for
    `sin(k L) = 0`: the column buckles at `T = pi^2 EI / L^2`, four times the dead weight that it can carry.
    """
    foot, tip = ny // 2, (nx - 1) * ny + ny // 2
    return beam(length, nx, ny, poisson, lambda mesh: jb.pulls(mesh, [[tip, foot]], width=[[0.4, 0.0]]))


def euler(length, poisson):
    return np.pi**2 * bending_stiffness(poisson) / length**2


def critical_tension(length, nx, ny=3, poisson=0.0):
    """Over Euler's: where an eigenvalue of the tangent passes through zero."""
    load = euler(length, poisson)
    branch = jb.trace_branch(column(length, nx, ny, poisson), [1.02 * load], step=0.5)
    (critical,) = branch.critical
    assert critical.kind == "bifurcation" and branch.stable[: critical.after + 1].all() and not branch.stable[-1]
    return critical.ratios[0] / load


# Shear lowers it by `Pe / kappa G A`, compression raises it by `Pe / E A`, and since neo-Hookean rubber is stiffer in
# compression, by `1 + Pe / E A`, the latter counts twice: together, at `nu = 0`, `1 - pi^2 / 30 (H / L)^2`.
SECOND_ORDER = np.pi**2 * (2 / 12 - 0.2)


@pytest.mark.parametrize("poisson", [pytest.param(0.0, marks=pytest.mark.slow), 0.3])
def test_a_cable_buckles_a_column_at_eulers_load(poisson):
    """At `L / H = 60` within 1e-4. At `nu = 0` it is known to second order, and the mesh leaves 2.7e-5."""
    found = critical_tension(60.0, 61, poisson=poisson)
    np.testing.assert_allclose(found, 1.0, rtol=1e-4)
    if poisson == 0:
        assert 0 < found - (1 + SECOND_ORDER / 60**2) < 3e-5


@pytest.mark.slow
def test_the_error_of_the_critical_tension_is_that_of_the_mesh():
    """On meshes of half the size it falls at least sevenfold, to 4e-6: 2.8e-4, 2.7e-5, 3.5e-6."""
    errors = [critical_tension(60.0, 30 * n + 1, n + 1 + n % 2) - 1 - SECOND_ORDER / 60**2 for n in (1, 2, 4)]
    assert errors[0] > 7 * errors[1] > 49 * abs(errors[2])
    assert abs(errors[2]) < 4e-6


def half_wave(degrees):
    """Tension, over Euler's, that turns the tip of the elastica by an angle, and the chord over the length.

    Neither end carries a moment about the cable: the column is half a wave of the elastica, and its ends are turned
    against the chord by half of the angle. With `k = sin(angle / 4)`: `T = 4 K(k)^2 EI / L^2`, and the chord is
    `2 E(k) / K(k) - 1` (Timoshenko and Gere 1961, Theory of Elastic Stability, section 2.7).
    """
    m = np.sin(np.deg2rad(degrees) / 4) ** 2
    return (2 * ellipk(m) / np.pi) ** 2, 2 * ellipe(m) / ellipk(m) - 1


def bent(length, nx, degrees):
    """Turn of the tip and length of the cable, over those of the elastica, less 1. Started straight, on the saddle."""
    scene = column(length, nx, 3, 0.0)
    load, cable = half_wave(degrees)
    pulled = jb.command(scene, [load * euler(length, 0.0)])
    found = jb.check(jb.equilibrium(pulled))
    turn, now = abs(jb.section_rotation(scene, found.x)), jb.tendon_lengths(pulled, found.x)[0]
    return np.array([turn / degrees, now / (cable * length)]) - 1


def test_a_buckled_column_is_half_a_wave_of_the_elastica():
    """Turned by 80 degrees at `L / H = 60`, within 0.17 %, which shear and compression make (see below)."""
    np.testing.assert_allclose(bent(60.0, 61, 80.0), 0, atol=1.7e-3)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [80.0, 120.0, 160.0])
def test_a_more_slender_column_is_closer_to_the_elastica(degrees):
    """Twice as long it is so fourfold; the limit of a slender one is the elastica to 1e-5."""
    short, long = bent(60.0, 61, degrees), bent(120.0, 121, degrees)
    np.testing.assert_allclose(short / long, 4, rtol=0.02)
    np.testing.assert_allclose(extrapolated(short, long), 0, atol=1e-5)
