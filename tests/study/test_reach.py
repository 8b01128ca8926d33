"""Inverse design: targets that are hit, targets that cannot be, the least effort, and any loss by any optimiser."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import slender_beam, small_beam

import jaxbeam as jb
from jaxbeam.core.tree import replace
from jaxbeam.mesh.surface import outline
from jaxbeam.physics.tendon import TendonEnergy

REACHED, UNREACHABLE, NOT_CONVERGED = jb.DesignStatus


def solved(scene: jb.Scene, theta, measure=jb.tip_angle) -> np.ndarray:
    """The measure of an equilibrium found from rest, apart from any search."""
    commanded = jb.command(scene, theta)
    return np.asarray(measure(commanded, jb.check(jb.equilibrium(commanded)).x))


# --------------------------------------------------------------------------------------------- angles


@pytest.mark.parametrize("spacing", [4.0, pytest.param(0.5, marks=pytest.mark.slow)])
def test_every_angle_is_hit(beam, spacing):
    """From rest, to 1e-8 degrees, in at most 8 solves; the tendon that would only work against it stays at rest."""
    for target in np.arange(-34, 34.01, spacing):
        found = jb.reach(beam, target)
        assert int(found.status) == REACHED, target
        assert abs(float(found.value) - target) <= 1e-8
        assert abs(float(jb.tip_angle(beam, found.solution.x)) - target) <= 1e-8
        assert int(found.solves) <= 8
        assert float(found.theta[1 if target > 0 else 0]) == 1
        assert ((np.asarray(found.theta) >= 0.4) & (np.asarray(found.theta) <= 1)).all()


@pytest.mark.parametrize("target", [-30.0, -0.5, 0.0, 12.5, 34.0])
def test_the_answer_is_what_a_solve_from_rest_gives(beam, target):
    found = jb.reach(beam, target)
    np.testing.assert_allclose(solved(beam, found.theta), target, rtol=0, atol=2e-8)
    assert int(found.solution.status) == jb.Status.OK


def test_history_holds_every_solve(beam):
    found = jb.reach(beam, 20.0)
    count = int(found.solves)
    theta, loss, status = (
        np.asarray(field) for field in (found.history.theta, found.history.loss, found.history.status)
    )
    assert np.isfinite(theta[:count]).all() and np.isnan(theta[count:]).all()
    assert (status[:count] == 0).all() and (status[count:] == -1).all()
    np.testing.assert_allclose(theta[0], 1)
    np.testing.assert_allclose(loss[0], 20.0)
    np.testing.assert_array_equal(theta[count - 1], found.theta)
    np.testing.assert_allclose(loss[1], abs(solved(beam, theta[1]) - 20), atol=1e-8)


@pytest.fixture(scope="module")
def grid(beam):
    """Tip angles and tip positions over a dense grid of the commands in [0.4, 1] squared."""
    line = np.linspace(0.4, 1.0, 16)
    ratios = np.stack(np.meshgrid(line, line, indexing="ij"), axis=2).reshape(-1, 2)
    batch = jb.sweep(beam, ratios)
    good = np.asarray(batch.status) == 0
    x = batch.x[good]
    return ratios[good], np.asarray(jax.vmap(lambda x: jb.tip_angle(beam, x))(x)), tip_positions(beam, x)


def tip_positions(scene, x):
    return np.asarray(jax.vmap(lambda x: jb.tip_position(scene, x))(x))


@pytest.mark.parametrize(("target", "held"), [(50.0, [-1, 1]), (36.0, [-1, 1]), (-50.0, [1, -1]), (-35.0, [1, -1])])
def test_beyond_the_bounds(beam, grid, target, held):
    """The nearest angle is named, a dense grid of commands knows none nearer, and the bounds in the way are told."""
    found = jb.reach(beam, target)
    assert int(found.status) == UNREACHABLE
    assert abs(abs(grid[1] - target).min() - float(found.loss)) <= 0.01
    assert float(found.loss) <= abs(grid[1] - target).min() + 1e-8
    np.testing.assert_allclose(abs(float(found.value) - target), found.loss)
    np.testing.assert_array_equal(found.held, held)


def test_beyond_the_peak(beam):
    """With more room the angle has a peak inside the bounds: no bound is in the way of 50 degrees, and none holds."""
    found = jb.reach(beam, 50.0, bounds=(0.2, 1.0))
    ratios = np.linspace(0.25, 0.4, 61)  # at 0.2 the beam passes through itself
    swept = jb.check(jb.sweep(beam, np.stack([ratios, np.ones(61)], axis=1)))
    angles = np.asarray(jax.vmap(lambda x: jb.tip_angle(beam, x))(swept.x))
    assert int(found.status) == UNREACHABLE
    np.testing.assert_array_equal(found.held, [0, 1])
    assert abs(float(found.value) - max(angles)) <= 0.01
    # A sweep leaves forces unbalanced by 1e-10 of the largest.
    assert float(found.value) >= max(angles) - 1e-8
    assert abs(float(found.theta[0]) - ratios[np.argmax(angles)]) < 0.003


def test_one_of_two_answers(beam):
    """37 degrees is reached on either side of the peak; the smaller contraction is the answer."""
    found = jb.reach(beam, 37.0, bounds=(0.2, 1.0))
    assert int(found.status) == REACHED
    assert 0.31 < float(found.theta[0]) < 0.4
    np.testing.assert_allclose(solved(beam, found.theta), 37.0, atol=2e-8)


# ------------------------------------------------------------------------------------------ positions


@pytest.mark.parametrize("ratios", [(0.5, 0.9), (0.95, 0.6), (0.7, 0.75), (0.45, 1.0)])
def test_position_is_hit(beam, ratios):
    """Two commands, two coordinates: the command that made the position is found again."""
    target = solved(beam, ratios, jb.tip_position)
    found = jb.reach(beam, target, jb.tip_position)
    assert int(found.status) == REACHED
    np.testing.assert_allclose(found.value, target, rtol=0, atol=1e-8 * 3.5)
    np.testing.assert_allclose(found.theta, ratios, atol=1e-6)


@pytest.mark.parametrize("target", [(1.9, 0.5), (0.5, 1.8), (1.2, -1.9)])
def test_position_out_of_reach(beam, grid, target):
    """The nearest point: none of a dense grid is nearer."""
    found = jb.reach(beam, target, jb.tip_position)
    assert int(found.status) == UNREACHABLE
    nearest = np.linalg.norm(grid[2] - target, axis=1).min()
    assert float(found.loss) <= nearest + 1e-8
    assert float(found.loss) > nearest - 0.05
    assert np.asarray(found.held).any()


@pytest.mark.slow
def test_path_of_targets(beam):
    """Each target of a sequence is hit, in fewer solves than from rest."""
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    targets = solved(beam, (0.7, 0.75), jb.tip_position) + 0.06 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    found = jb.reach_each(beam, targets, jb.tip_position)
    assert (np.asarray(found.status) == REACHED).all()
    np.testing.assert_allclose(found.value, targets, rtol=0, atol=1e-8)
    np.testing.assert_allclose(tip_positions(beam, found.solution.x), targets, rtol=0, atol=1e-8)
    assert np.array_equal(found.solution.outline, outline(beam.mesh))
    assert np.asarray(found.solves)[1:].max() <= 4
    assert np.asarray(found.solution.steps)[1:].mean() < 6  # of Newton, in the last of these solves
    np.testing.assert_allclose(jb.reach(beam, targets[7], jb.tip_position).theta, found.theta[7], rtol=0, atol=1e-7)


# -------------------------------------------------------------------------------------- bounds that hold


@jax.jit
@partial(jax.grad, argnums=1)
def slope_of_angle(scene, theta):
    scene = jb.command(scene, theta)
    return jb.tip_angle(scene, jb.equilibrium(scene).x)


@pytest.mark.parametrize(
    ("target", "bounds", "held"),
    [
        (8.0, (0.4, 1.0), [0, 1]),
        (-8.0, (0.4, 1.0), [1, 0]),
        (8.0, (0.4, 1.6), [0, 0]),
        (4.0, ([0.95, 0.4], [1.0, 1.6]), [-1, 0]),
        (8.0, ([0.4, 1.2], 1.6), [0, -1]),
        (0.0, (0.4, 1.0), [0, 0]),
    ],
)
def test_bounds_that_hold_where_a_target_is_reached(beam, target, bounds, held):
    """By Lagrange's condition: with the price that balances the effort of the free commands, each command that is held
    would be moved out of its bounds. Commands at rest are at the bound of 1, and it does not hold them."""
    found = jb.reach(beam, target, bounds=bounds)
    assert int(found.status) == REACHED
    np.testing.assert_array_equal(found.held, held)
    slope, short = np.asarray(slope_of_angle(beam, found.theta)), 1 - np.asarray(found.theta)
    free = np.asarray(held) == 0
    price = short[free] @ slope[free] / (slope[free] @ slope[free])
    pull = short - price * slope
    np.testing.assert_allclose(pull[free], 0, atol=1e-6)
    np.testing.assert_array_equal(np.sign(pull[~free]), np.asarray(held)[~free])


@pytest.mark.parametrize("target", [2.0, 5.0, 8.0, 20.0])
def test_curvature_saves_solves(beam, target):
    """Where no bound holds, both commands are weighed: quadratic convergence needs the measure's own curvature."""
    found = jb.reach(beam, target, bounds=(0.4, 1.6))
    assert int(found.status) == REACHED and not np.asarray(found.held).any()
    assert int(found.solves) <= 7


# ------------------------------------------------------------------------------- where commands do nothing


@dataclasses.dataclass(frozen=True)
class PullOnly(TendonEnergy):
    """A thread: slack, and without energy, where it is longer than its ends are apart."""

    def __call__(self, x, params):
        stretch = self.length(x, params) - params.commanded
        return 0.5 * params.modulus * jnp.where(stretch > 0, stretch, 0) ** 2


def threaded(slack):
    """The small beam with threads that pull below the ratio `1 / slack`."""
    beam = jb.tendon_beam(5, 3)
    body, pulls = beam.terms
    longer = replace(pulls.params, natural=slack * pulls.params.natural, commanded=slack * pulls.params.commanded)
    threads = jb.Term(PullOnly(jb.constant_stiffness), pulls.nodes, longer)
    return jb.Scene(beam.mesh, (body, threads), beam.fixed, beam.tip)


@pytest.mark.parametrize(("slack", "target"), [(1.0, 4.0), (1.2, 4.0), (1.2, -4.0)])
def test_slack_tendons_are_shortened_until_they_pull(slack, target):
    """At rest the angle has no slope and no curvature, and that says nothing of what is in reach."""
    scene = threaded(slack)
    found = jb.reach(scene, target)
    assert int(found.status) == REACHED
    np.testing.assert_allclose(solved(scene, found.theta), target, atol=2e-8)
    working = 0 if target > 0 else 1
    assert float(found.theta[1 - working]) == 1 and float(found.theta[working]) < 1 / slack


@pytest.fixture(scope="module")
def small():
    return small_beam()


def over_two_degrees(scene, x):
    return jnp.maximum(jb.tip_angle(scene, x) - 2, 0)


def over_sixty_degrees(scene, x):
    return jnp.maximum(jb.tip_angle(scene, x) - 60, 0)


def test_no_slope_is_no_information(small):
    """A measure that is flat at the start, and stays so when both tendons are shortened alike: a target is reached by
    shortening one of them. Of a measure that is flat wherever it is looked for, nothing is claimed. From where it has
    a slope, a target out of reach is called so."""
    assert int(jb.reach(small, 1.0, over_two_degrees).status) == REACHED
    found = jb.reach(small, 1.0, over_sixty_degrees)
    assert int(found.status) == NOT_CONVERGED
    assert float(found.history.theta[: int(found.solves)].min()) < 0.41
    for target, status in ((1.0, REACHED), (60.0, UNREACHABLE)):
        assert int(jb.reach(small, target, over_two_degrees, starts=[[0.7, 1.0]]).status) == status


@pytest.mark.slow
def test_each_of_several_targets_with_slack_tendons():
    """One that is no number (refused unless it is traced) ends, and harms no other. The last asks for the tendon that
    is slack where the first ended, where only the other one has an effect."""
    targets = jnp.array([4.0, jnp.nan, -4.0])
    found, _ = jax.jvp(partial(jb.reach_each, threaded(1.2)), (targets,), (jnp.ones(3),))
    assert np.asarray(found.status).tolist() == [REACHED, NOT_CONVERGED, REACHED]


# ------------------------------------------------------------------------------------------ on the host


def test_progress(small):
    """Called after each solve with the number of all so far and the distance from the target."""
    calls = []
    found = jb.reach(small, 8.0, progress=lambda *call: calls.append(call))
    count = int(found.solves)
    assert [number for number, _ in calls] == list(range(1, count + 1))
    np.testing.assert_array_equal([loss for _, loss in calls], found.history.loss[:count])
    calls.clear()
    each = jb.reach_each(small, [8.0, 9.0], progress=lambda *call: calls.append(call))
    assert len(calls) == int(each.solves.sum()) and calls[-1][0] == len(calls)
    np.testing.assert_array_equal(calls[-1][1], each.loss[-1])


def test_line_of_progress(small, terminal):
    found = jb.reach(small, 8.0, progress=True)
    each = jb.reach_each(small, [8.0, 9.0], progress=True)
    first, second, cursor = terminal.lines()
    assert first.startswith(f"{int(found.solves)} solves, distance {float(found.loss):.2e}, 0:")
    assert f"] 2 of 2 targets, {int(each.solves.sum())} solves, 0:" in second and cursor == ""


@pytest.mark.parametrize(
    "call",
    [
        lambda scene: jax.jit(lambda target: jb.reach(scene, target).theta)(8.0),
        lambda scene: jax.jit(lambda: jb.reach(scene, 8.0).theta)(),
        lambda scene: jax.jit(lambda scene: jb.reach(scene, 8.0).theta)(scene),
        lambda scene: jax.jit(lambda low: jb.reach(scene, 8.0, bounds=(low, 1.0)).theta)(0.4),
        lambda scene: jax.jit(jax.grad(lambda target: jb.reach(scene, target).theta[0]))(8.0),
        lambda scene: jax.vmap(lambda target: jb.reach(scene, target).theta)(jnp.array([8.0, 9.0])),
        lambda scene: jax.lax.map(lambda target: jb.reach(scene, target).theta, jnp.array([8.0, 9.0])),
        lambda scene: jax.jit(lambda targets: jb.reach_each(scene, targets).theta)(jnp.array([8.0, 9.0])),
    ],
)
def test_reach_cannot_be_traced(small, call):
    with pytest.raises(ValueError, match=r"reach and reach_each run on the host: call them outside jit.*jax\.grad"):
        call(small)


# --------------------------------------------------------------------------------------- least effort


@pytest.fixture(scope="module")
def many():
    """A beam with two tendons on each side, so that an angle is reached in many ways."""
    mesh = jb.rectangle(3.0, 0.6, 9, 3)
    lines = [[2, 14], [2, 23], [0, 12], [0, 21]]
    left, right = np.arange(3), np.arange(24, 27)
    terms = (jb.solid(mesh, jb.lame(1e4, 0.3)), jb.tendons(mesh, lines, [2e3, 1e3, 2e3, 1e3]))
    return jb.Scene(mesh, terms, jb.clamped(mesh, left), right)


@pytest.mark.slow
@pytest.mark.parametrize("bounds", [(0.3, 1.0), (0.3, 3.0)])
def test_least_effort(many, bounds):
    """Where no bound holds, the contraction is along the slope of the angle: Lagrange's condition."""
    target = 8.0
    found = jb.reach(many, target, bounds=bounds)
    assert int(found.status) == REACHED

    def angle(theta):
        scene = jb.command(many, theta)
        return jb.tip_angle(scene, jb.equilibrium(scene).x)

    slope, short = np.asarray(jax.jit(jax.grad(angle))(found.theta)), 1 - np.asarray(found.theta)
    free = (np.asarray(found.theta) > bounds[0]) & (np.asarray(found.theta) < bounds[1])
    assert free.sum() == (2 if bounds[1] == 1 else 4)
    price = short[free] @ slope[free] / (slope[free] @ slope[free])
    np.testing.assert_allclose(short[free], price * slope[free], atol=1e-6)
    # A command at its bound would only be pushed further out.
    assert (np.sign(price * slope[~free] - short[~free]) <= 0).all()


@pytest.mark.slow
def test_starts(many):
    """The best answer over several starts is no worse than from any one of them."""
    starts = np.array([[1.0, 1.0, 1.0, 1.0], [0.5, 0.9, 1.0, 1.0], [0.9, 0.5, 1.0, 0.8]])
    effort = lambda found: float(jnp.sum((1 - found.theta) ** 2))
    together = jb.reach(many, 8.0, bounds=(0.3, 1.0), starts=starts)
    assert int(together.status) == REACHED
    assert effort(together) <= effort(jb.reach(many, 8.0, bounds=(0.3, 1.0))) + 1e-9


def test_a_search_goes_on_from_an_earlier_answer(beam):
    """Targets one by one, each from the answer before, give what the whole sequence gives, in few solves each."""
    targets = [[1.5, 0.3], [1.45, 0.4], [1.42, 0.45]]
    whole = jb.reach_each(beam, targets, jb.tip_position)
    found = jb.reach(beam, targets[0], jb.tip_position)
    for k, target in enumerate(targets):
        found = jb.reach(beam, target, jb.tip_position, starts=found.solution)
        assert int(found.status) == REACHED and int(found.solves) <= 5
        np.testing.assert_allclose(found.theta, whole.theta[k], atol=1e-6)


def test_a_search_stays_on_the_branch_that_it_starts_from():
    """A slender beam with tendons from end to end buckles up or down; pulled more at the top it can still hang down."""
    beam = slender_beam(21)
    pulled = jb.check(jb.equilibrium(jb.command(beam, [0.95, 0.9])))
    hanging = jb.check(jb.equilibrium(jb.command(beam, [0.9, 0.91]), pulled.x))
    target, bounds = float(jb.tip_angle(beam, hanging.x)) + 0.05, ([0.88, 0.905], [0.902, 0.92])
    assert target < -18
    assert int(jb.reach(beam, target, bounds=bounds).status) == UNREACHABLE
    found = jb.reach(beam, target, bounds=bounds, starts=hanging)
    assert int(found.status) == REACHED
    assert float(jnp.abs(found.solution.x - hanging.x).max()) < 0.05
    np.testing.assert_allclose(jb.tip_angle(beam, found.solution.x), target, atol=1e-8)


def test_a_start_must_be_one_good_state_of_the_scene(beam):
    pulled = jb.equilibrium(jb.command(beam, [0.8, 1.0]))
    with pytest.raises(ValueError, match=r"starts: expected a Solution of one state of this scene, .* got \(3, 2\)"):
        jb.reach(beam, 1.0, starts=jb.sweep(beam, np.full((3, 2), 0.9)))
    with pytest.raises(ValueError, match="starts: expected a Solution whose status is OK"):
        jb.reach(beam, 1.0, starts=replace(pulled, status=jnp.int32(1)))


@pytest.mark.slow
def test_solves_run_out(beam):
    found = jb.reach(beam, 30.0, max_solves=2)
    assert int(found.status) == NOT_CONVERGED
    assert int(found.solves) == 2


@pytest.mark.slow
def test_in_float32():
    scene = jb.tendon_beam(9, 3, dtype=jnp.float32)
    found = jb.reach(scene, 10.0)
    assert int(found.status) == REACHED
    assert found.theta.dtype == found.value.dtype == jnp.float32
    assert abs(float(found.value) - 10) <= 1e-3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"target": [1.0, 2.0]}, r"target: expected the shape \(\) of the measure, got \(2,\)"),
        ({"bounds": (0.0, 1.0)}, r"bounds: expected 0 < low <= high, got low \[0.0, 0.0\]"),
        ({"bounds": (0.9, 0.4)}, "bounds: expected 0 < low <= high"),
        ({"bounds": ([0.4, 0.4, 0.4], 1.0)}, r"bounds: expected low of shape \(\) or \(2,\), got \(3,\)"),
        ({"starts": [1.0, 1.0]}, r"starts: expected shape \(S, 2\), a row for each start, got \(2,\)"),
        ({"tolerance": 0.0}, "tolerance: expected a positive finite number, got 0.0"),
        ({"measure": jb.tendon_lengths}, r"target: expected the shape \(2,\) of the measure, got \(\)"),
        ({"measure": lambda scene, x: x}, r"measure: expected a function \(scene, x\) to shape \(\) or \(p,\)"),
    ],
)
def test_reach_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        jb.reach(small_beam(), **({"target": 1.0} | arguments))


def test_reach_each_refuses(beam):
    with pytest.raises(ValueError, match=r"targets: expected shape \(T, 2\), a row for each target, got \(2,\)"):
        jb.reach_each(beam, [1.0, 2.0], jb.tip_position)
    with pytest.raises(ValueError, match="expected at least one tendon to command"):
        mesh = jb.rectangle(1.0, 1.0, 3, 3)
        jb.reach(jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)),), jb.clamped(mesh, [0, 1, 2])), 1.0)


# ------------------------------------------------------------------------------------------- minimise

TARGET = 20.0


def squared(scene, x):
    return (jb.tip_angle(scene, x) - TARGET) ** 2


def bounded(beam):
    """Ratios between 0.4 and 1 from numbers without bounds."""
    return lambda theta: jb.command(beam, 0.4 + 0.6 * jax.nn.sigmoid(theta))


@pytest.mark.parametrize(
    ("optimiser", "steps", "most"),
    [
        pytest.param(optax.adam(0.1), 400, 350, id="adam", marks=pytest.mark.slow),
        pytest.param(optax.lbfgs(), 60, 30, id="lbfgs", marks=pytest.mark.slow),
    ],
)
def test_optax_reaches_the_angle(beam, optimiser, steps, most):
    """To 1e-6 degrees, with Adam and with L-BFGS and its line search."""
    found = jb.minimise(squared, jnp.array([0.0, 2.0]), optimiser, steps, design=bounded(beam), goal=1e-12)
    assert int(found.status) == REACHED
    assert abs(float(jb.tip_angle(beam, found.solution.x)) - TARGET) <= 1e-6
    assert int(found.solves) <= most
    assert len(found.history.loss) == len(found.history.status) == found.history.theta.shape[0]
    assert float(found.loss) == float(found.history.loss.min())


@pytest.mark.slow
def test_stationary_point_over_the_goal(beam):
    """A loss with a floor: its least value is found, and is not called the goal."""
    floor = lambda scene, x: squared(scene, x) + 3.0
    found = jb.minimise(floor, jnp.array([0.0, 2.0]), optax.lbfgs(), 60, design=bounded(beam), goal=1.0)
    assert int(found.status) == UNREACHABLE
    np.testing.assert_allclose(found.loss, 3.0, rtol=1e-12)
    free = jb.minimise(floor, jnp.array([0.0, 2.0]), optax.lbfgs(), 60, design=bounded(beam))
    assert int(free.status) == REACHED


def test_step_without_equilibrium_is_taken_back(terminal):
    """Poisson's ratio runs over 0.5: the step is skipped, reported and halved, and the search goes on."""
    scene = lambda theta: jb.command(small_beam(poisson=theta["poisson"]), jnp.array([0.8, 1.0]))
    stiff = lambda scene, x: -jb.tip_position(scene, x)[0]
    found = jb.minimise(stiff, {"poisson": 0.3}, optax.sgd(40.0), 12, design=scene, tolerance=1e-12, progress=True)
    line, cursor = terminal.lines()
    assert line.startswith(f"12 steps of at most 12, loss {float(found.history.loss[-1]):.4g}, 0:") and cursor == ""
    status = np.asarray(found.history.status)
    assert (status[1:] & jb.Status.INVALID).any() and (status == 0).sum() > 1
    assert int(found.solution.status) == jb.Status.OK
    assert np.array_equal(found.solution.outline, outline(small_beam().mesh))
    assert 0.3 < float(found.theta["poisson"]) < 0.5
    bad = int(np.argmax(status != 0))
    tried = np.asarray(found.history.theta["poisson"])
    np.testing.assert_allclose(tried[bad + 1], 0.5 * (tried[bad - 1] + tried[bad]))


def test_no_equilibrium_at_the_start():
    stuck = jb.Newton(max_steps=0)
    scene = lambda theta: jb.command(small_beam(), jnp.stack([theta, 1.0]))
    calls = []
    found = jb.minimise(
        jb.tip_angle, 0.7, optax.sgd(1.0), 5, design=scene, solver=stuck, progress=lambda *call: calls.append(call)
    )
    assert calls == [(0, float(found.history.loss[0]))]
    assert int(found.status) == NOT_CONVERGED
    assert int(found.solves) == 1
    assert np.isinf(found.loss)


def test_minimise_refuses(beam):
    with pytest.raises(ValueError, match="steps: expected a whole number of at least 0, got -1"):
        jb.minimise(squared, jnp.zeros(2), optax.sgd(1.0), -1, design=bounded(beam))
    with pytest.raises(ValueError, match="theta0: expected a pytree of float arrays"):
        jb.minimise(squared, jnp.zeros(2, int), optax.sgd(1.0), 1, design=bounded(beam))
