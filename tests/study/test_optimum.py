"""The derivative of `reach`: against differences of searches, and where there is none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb

REACHED, UNREACHABLE, NOT_CONVERGED = jb.DesignStatus
# Differences divide the error of a search, up to 1e-11 in a command, by a step of about 1e-3.
TIGHT = jb.Newton(rtol=1e-14, linear=jb.Dense())
FIRST, SECOND = 1e-7, 1e-5

BEAM = jb.tendon_beam(3, 2)


def differences(f, v, h=1e-3):
    """Slope of `f` by each entry of `v`, by the central stencil of order 6, whose truncation is about `h^6`."""
    stencil = ((1, 45), (2, -9), (3, 1))
    along = lambda e: sum(w * (np.asarray(f(v + k * e)) - np.asarray(f(v - k * e))) for k, w in stencil) / (60 * h)
    return np.stack([along(h * e) for e in np.eye(len(v))], axis=-1)


def beam_of(v):
    """The beam with the modulus of its first tendon, Young's modulus and length scaled."""
    scaled = jnp.stack([v[0], 1.0])
    return jb.tendon_beam(3, 2, young=1e4 * v[1], tendon_modulus=2e3 * scaled, length=3.5 * v[2])


def both(scene, x):
    return jnp.stack([jb.tip_angle(scene, x), 10 * jb.tip_position(scene, x)[0]])


def outcome(design):
    """All of a design that moves, in one row."""
    at = design.solution
    parts = (design.theta, jnp.ravel(design.value), design.loss[None], at.x[-1], at.energy[None], at.ratios)
    return jnp.concatenate(parts)


# Measure, target, bounds, status and bounds that hold.
CASES = {
    "two commands, one target": (jb.tip_angle, 4.0, (0.4, 1.6), REACHED, [0, 0]),
    "a bound at rest": (jb.tip_angle, 4.0, (0.4, 1.0), REACHED, [0, 1]),
    "a bound on the way": (jb.tip_angle, 1.2, ([0.95, 0.4], [1.0, 1.6]), REACHED, [-1, 0]),
    "equal bounds": (jb.tip_angle, 4.0, ([0.4, 0.95], [1.6, 0.95]), REACHED, None),
    "two commands, two targets": (both, [1.65, 16.85], (0.4, 1.6), REACHED, [0, 0]),
    "out of reach": (jb.tip_angle, 60.0, (0.4, 1.6), UNREACHABLE, [-1, 1]),
    "two targets out of reach": (both, [1.65, 17.3], (0.4, 1.01), UNREACHABLE, [0, 1]),
}


def moved(name):
    """The design as a function of the target, factors of the bounds and of properties of the beam; and where it is."""
    measure, target, (low, high), _, _ = CASES[name]
    target = np.ravel(np.asarray(target))
    count = target.size

    def design(v):
        goal = v[:count] if count > 1 else v[0]
        bounds = (jnp.asarray(low) * v[count], jnp.asarray(high) * v[count + 1])
        return jb.reach(beam_of(v[count + 2 :]), goal, measure, bounds=bounds, solver=TIGHT)

    return design, jnp.asarray(np.append(target, np.ones(5)))


# These share one search, which is what takes time to compile.
FAST = [name for name, case in CASES.items() if case[0] is jb.tip_angle]


@pytest.mark.parametrize(
    "name", [*FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in CASES if name not in FAST)]
)
def test_first_derivatives(name):
    """By the target, by bounds and by the scene; the answer itself is that of a search alone."""
    design, v = moved(name)
    plain = design(v)
    assert int(plain.status) == CASES[name][3]
    if CASES[name][4] is not None:
        np.testing.assert_array_equal(plain.held, CASES[name][4])
    rows = lambda v: (row := outcome(design(v)), row)
    slope, row = jax.jacrev(rows, has_aux=True)(v)
    np.testing.assert_allclose(row, outcome(plain), rtol=1e-12, atol=1e-12)
    # Equal bounds can only move together.
    along = np.eye(len(v)) if name != "equal bounds" else np.array([[1, 0, 0, 0, 0, 0], [0, 1, 1, 0, 0, 0]])
    truth = differences(lambda steps: outcome(design(v + steps @ along)), np.zeros(len(along)))
    np.testing.assert_allclose(slope @ along.T, truth, rtol=0, atol=FIRST * np.abs(truth).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_forward_is_reverse(name):
    design, v = moved(name)
    forward = jax.jacfwd(lambda v: outcome(design(v)))(v)
    reverse = jax.jacrev(lambda v: outcome(design(v)))(v)
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-10 * np.abs(forward).max())


PLAIN = jnp.array([4.0, 1.0, 1.0, 1.0])


def commands(v):
    """The commands that reach an angle, with both free."""
    return jb.reach(beam_of(v[1:]), v[0], bounds=(0.4, 1.6), solver=TIGHT).theta


@pytest.mark.slow
@pytest.mark.parametrize("modes", ["ff", "fr", "rf", "rr"])
def test_second_derivatives(modes):
    f = commands
    for mode in modes[::-1]:
        f = {"f": jax.jacfwd, "r": jax.jacrev}[mode](f)
    truth = differences(jax.jacfwd(commands), np.asarray(PLAIN))
    np.testing.assert_allclose(f(PLAIN), truth, rtol=0, atol=SECOND * np.abs(truth).max())


@pytest.mark.slow
def test_a_peak_between_bounds():
    """Of a measure that is largest in between: its place moves with the scene and not with the target."""
    free = lambda v: jb.reach(beam_of(v[1:]), v[0], bent, bounds=(0.4, 1.6), solver=TIGHT)
    design = free(PLAIN)
    assert int(design.status) == UNREACHABLE and not np.asarray(design.held).any()
    slope = jax.jacrev(lambda v: free(v).theta)(PLAIN)
    # The slope of the measure is as small as the search left it.
    np.testing.assert_allclose(slope[:, 0], 0, atol=1e-8)
    # The search rests where a step is below 1e-6.
    truth = differences(lambda v: free(jnp.asarray(v)).theta, np.asarray(PLAIN))
    np.testing.assert_allclose(slope, truth, rtol=0, atol=1e-6 * np.abs(truth).max())


def bent(scene, x):
    """Largest, 1, at an angle of 0.96 degrees and a tip at 1.7174, which are those of the ratios 0.8 and 0.95."""
    return 1 - (jb.tip_angle(scene, x) - 0.96) ** 2 - 400 * (jb.tip_position(scene, x)[0] - 1.7174) ** 2


@pytest.mark.slow
def test_through_each():
    """Through `reach_each`, and through several calls of `reach`, the slope is that of searches alone."""
    goals = jnp.array([3.0, 4.0])
    theta = lambda goal, factor: commands(jnp.stack([goal, factor, 1.0, 1.0]))[0]
    slope = lambda f: jax.grad(lambda factor: f(factor)[1] + 2 * f(factor)[0])(1.0)
    alone = [jax.grad(theta, argnums=(0, 1))(goal, 1.0) for goal in goals]
    expected = 2 * alone[0][1] + alone[1][1]
    each = lambda factor: jb.reach_each(
        beam_of(jnp.stack([factor, 1.0, 1.0])), goals, bounds=(0.4, 1.6), solver=TIGHT
    ).theta[:, 0]
    found = {
        "each": slope(each),
        "loop": slope(lambda factor: jnp.stack([theta(goal, factor) for goal in goals])),
    }
    for name, value in found.items():
        np.testing.assert_allclose(value, expected, rtol=1e-8, err_msg=name)


@pytest.mark.slow
def test_no_derivative():
    """NaN where the search fails (a number that is refused unless it is traced), and at rest, where either command may
    be the one to move."""
    theta = lambda goal: jb.reach(BEAM, goal, bounds=(0.4, 1.0), solver=TIGHT).theta
    assert np.isnan(jax.jacfwd(theta)(np.nan)).all()
    assert np.isnan(jax.jacfwd(theta)(0.0)).all()
    assert np.isfinite(jax.jacfwd(theta)(1.0)).all()


@pytest.mark.slow
def test_no_derivative_without_convergence():
    few = lambda goal: jb.reach(BEAM, goal, max_solves=2)
    assert int(few(8.0).status) == NOT_CONVERGED
    assert np.isnan(jax.jacfwd(lambda goal: outcome(few(goal)))(8.0)[:4]).all()
    assert np.isnan(jax.grad(lambda goal: few(goal).theta[0])(8.0))


@pytest.mark.slow
def test_two_targets_and_one_command_that_is_free():
    """A target that is reached by chance has no slope: moved, it is out of reach."""
    scene = jb.command(BEAM, [0.8, 1.0])
    target = both(scene, jb.equilibrium(scene, solver=TIGHT).x)
    reach = lambda target: jb.reach(BEAM, target, both, bounds=([0.4, 1.0], 1.0), solver=TIGHT)
    if int(reach(target).status) == REACHED:
        assert np.isnan(jax.jacfwd(lambda target: reach(target).theta[0])(target)).all()


@pytest.mark.slow
def test_a_bad_member_harms_no_other():
    """What the loss does not look at has no part in the slope of what all share."""

    def loss(factor, weights):
        # NaN is refused unless it is traced.
        goals = jnp.array([4.0, jnp.nan]) + 0 * factor
        scene = beam_of(jnp.stack([factor, 1.0, 1.0]))
        found = jb.reach_each(scene, goals, bounds=(0.4, 1.6), solver=TIGHT)
        return jnp.sum(jnp.where(weights > 0, found.theta[:, 0], 0))

    slope = jax.grad(loss)
    alone = jax.grad(lambda factor: commands(jnp.stack([4.0, factor, 1.0, 1.0]))[0])(1.0)
    np.testing.assert_allclose(slope(1.0, jnp.array([1.0, 0.0])), alone, rtol=1e-8)
    assert np.isnan(slope(1.0, jnp.array([1.0, 1.0])))
