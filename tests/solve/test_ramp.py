"""Ramps and sweeps: the path that is followed, what each step reports, batches against loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import small_beam, spring_pair, traces

import jaxbeam as jb
from jaxbeam.scene.scene import partway

ROWS = np.array([[0.5, 1.0], [1.2, 0.8], [0.9, 0.7]])


@pytest.fixture(scope="module")
def small():
    return small_beam()


def member(solution, k):
    return jax.tree.map(lambda leaf: leaf[k], solution)


def loop(scene, rows):
    return [jb.check(jb.equilibrium(jb.command(scene, row))) for row in rows]


def check_same(batch, alone):
    """A batch holds what a loop finds. Another order of rounding moves the answer by what the tolerance allows."""
    for k, solution in enumerate(alone):
        # Residual 1e-10 of the tendon's force, over the stiffness of a beam that it bends by order 1.
        np.testing.assert_allclose(batch.x[k], solution.x, rtol=0, atol=1e-9)
        assert int(batch.status[k]) == int(solution.status)


# ----------------------------------------------------------------------------------------------- partway


def test_partway_is_a_fraction_of_the_actuation(small):
    """Of each tendon's shortening and of each dead load; springs stay as they are, and so does what is at rest."""
    terms = (jb.dead_load(small.mesh, [13], [3.0, -5.0]), jb.penalty_springs(small.mesh, [7], 10.0))
    scene = jb.command(jb.Scene(small.mesh, (*small.terms, *terms), small.fixed, small.tip), [0.6, 1.2])
    for share in (0.0, 0.25, 1.0):
        body, pulls, load, springs = partway(scene, share).terms
        np.testing.assert_allclose(pulls.params.commanded / pulls.params.natural, 1 + share * np.array([-0.4, 0.2]))
        np.testing.assert_allclose(load.params.value, [[share * 3.0, share * -5.0]], rtol=1e-15)
        for same, whole in ((body, scene.terms[0]), (springs, scene.terms[3])):
            for a, b in zip(jax.tree.leaves(same), jax.tree.leaves(whole), strict=True):
                np.testing.assert_array_equal(a, b)


# ------------------------------------------------------------------------------------------------ ramp


def test_commands():
    way = np.asarray(jb.commands([0.4, 1.3], steps=28))
    np.testing.assert_allclose(way, 1 + np.linspace(0, 1, 28)[:, None] * [-0.6, 0.3], rtol=1e-15)
    assert (way[0] == 1).all()
    assert way[-1].tolist() == [0.4, 1.3]  # to the last bit
    assert jb.commands([2, 1], steps=2).tolist() == [[1, 1], [2, 1]]
    assert jb.commands(np.array([0.4], np.float32), steps=np.int64(3)).dtype == jnp.float32


@pytest.mark.parametrize("steps", [1, 0, -3, 2.0, None])
def test_steps_are_refused(small, steps):
    for call in (lambda: jb.commands([0.4, 1.0], steps), lambda: jb.ramp(small, [0.4, 1.0], steps=steps)):
        with pytest.raises(ValueError, match="steps: expected a whole number of at least 2, got"):
            call()


@pytest.mark.parametrize("ratios", [[0.4], 0.4, [0.4, 0.0], [0.4, np.nan]])
def test_ramp_refuses_ratios(small, ratios):
    with pytest.raises(ValueError, match="ratios: expected"):
        jb.ramp(small, ratios)


def test_ramp_starts_at_rest(beam, bent_path):
    assert bent_path.x.shape == (28, 203, 2)
    np.testing.assert_array_equal(bent_path.x[0], beam.mesh.nodes)
    assert int(bent_path.steps[0]) == 0


def test_ramp_takes_few_steps(bent_path):
    jb.check(bent_path)
    assert (np.asarray(bent_path.residual) < 1e-9).all()
    assert int(bent_path.steps.sum()) <= 35


@pytest.mark.parametrize("path", ["bent_path", "folded_path"])
def test_states_on_the_way_are_stable_by_a_stiffness_of_their_own(beam, path, request):
    """They may have been judged by that of the state their last step started from."""
    found = jb.check(request.getfixturevalue(path))
    for ratios, x in zip(found.ratios, found.x, strict=True):
        assert float(jb.lowest_mode(jb.command(beam, ratios), x).values[0]) > 0


def test_every_step_is_an_equilibrium_of_its_command(beam, bent_path):
    way = jb.commands([0.4, 1.0], steps=28)
    for k in (1, 13, 27):
        scene = jb.command(beam, way[k])
        again = jb.check(jb.equilibrium(scene, bent_path.x[k]))
        assert again.steps == 0
        np.testing.assert_allclose(again.energy, bent_path.energy[k], rtol=1e-12)


def test_ramp_follows_the_branch(beam, bent_path):
    """Small steps, no jumps: the angle grows at every step, by about the same amount (0.6 to 1.8 degrees)."""
    angles = jax.vmap(lambda x: jb.tip_angle(beam, x))(bent_path.x)
    rises = np.diff(angles)
    assert (rises > 0).all()
    assert rises.max() < 3 * rises.min()


def test_ramp_ignores_the_command_it_is_given(beam, bent_path):
    """It starts at ratio 1 and ends at its own ratios, whatever the scene was commanded before."""
    path = jb.ramp(jb.command(beam, [0.9, 1.3]), [0.4, 1.0], steps=28)
    np.testing.assert_array_equal(path.x, bent_path.x)


def test_path_decides_at_the_fold(beam, folded_path):
    """At (0.4, 0.4) several stable equilibria exist; the one the ramp reaches is not the lowest in energy."""
    jb.check(folded_path)
    jump = np.asarray(jb.tip_angle(beam, folded_path.x[-1]) - jb.tip_angle(beam, folded_path.x[-2]))
    assert abs(jump) > 1
    scene = jb.command(beam, [0.4, 0.4])
    other = jb.equilibrium(scene, jb.ramp(beam, [0.3, 0.5]).x[-1])
    # Stable, but bent so far that the beam passes through itself.
    assert int(other.status) == jb.Status.OVERLAPPING
    assert float(other.energy) < 0.99 * float(folded_path.energy[-1])
    assert float(jb.tip_angle(beam, other.x)) > 10  # the ramp's is at -5.09 degrees


def test_stopping_early_is_not_called_converged(beam):
    """With three steps allowed Newton cannot pass the fold; it must not call the place where it stops an answer."""
    path = jb.ramp(beam, [0.4, 0.4], steps=28, solver=jb.Newton(max_steps=3))
    last = member(path, -1)
    assert int(last.status) & jb.Status.NOT_CONVERGED
    assert last.residual > last.tolerance
    assert abs(jb.tip_angle(beam, last.x) + 5.0890962) > 0.1  # that is the equilibrium, and this is not
    assert (np.asarray(path.steps) <= 3).all()
    ok = np.asarray(path.status) == 0
    assert ok[:20].all()  # before the fold three steps are enough
    np.testing.assert_array_equal(ok, np.asarray(path.residual) <= np.asarray(path.tolerance))
    with pytest.raises(jb.EquilibriumError, match=r"NOT_CONVERGED in \d+ of 28 members .*approach the command by ramp"):
        jb.check(path)


# ----------------------------------------------------------------------------------------------- sweep


def test_sweep_equals_loop(small):
    batch = jb.check(jb.sweep(small, ROWS))
    assert batch.x.shape == (3, 15, 2)
    check_same(batch, loop(small, ROWS))


def test_sweep_reports_each_member():
    scene = spring_pair(1.0)
    batch = jb.sweep(scene, [[0.9, 0.9], [1.2, 1.2], [0.5, 0.9]], jb.Newton(escape=False))
    assert np.asarray(batch.status).tolist() == [jb.Status.OK, jb.Status.UNSTABLE, jb.Status.OK]
    # Springs of equal stiffness: the node sits where both are stretched alike, l - 0.5 = (2 - l) - 0.9.
    np.testing.assert_allclose(batch.x[2, 2], [-1 + 0.8, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("ratios", "message"),
    [
        ([0.4, 1.0], r"ratios: expected shape \(B, m\), a row for each command, got \(2,\)"),
        (np.zeros((0, 2)), r"ratios: expected shape \(B, m\), a row for each command, got \(0, 2\)"),
        ([[0.4, 1.0, 1.0]], r"ratios: expected shape \(2,\), one for each tendon, got \(3,\)"),
        ([[1.0, 1.0], [0.4, -1.0]], r"ratios: expected positive finite numbers, got \[\[1.0, 1.0\], \[0.4, -1.0\]\]"),
        ([[np.nan, 1.0]], r"ratios: expected positive finite numbers, got \[\[nan, 1.0\]\]"),
    ],
)
def test_sweep_refuses(small, ratios, message):
    with pytest.raises(ValueError, match=message):
        jb.sweep(small, ratios)


# ------------------------------------------------------------------------------- transforms, compilation


def test_vmap_of_equilibrium_equals_loop(small):
    """Mapped over commands, with a scene that is an argument of jit."""
    solve = jax.jit(lambda scene, rows: jax.vmap(lambda row: jb.equilibrium(jb.command(scene, row)))(rows))
    check_same(jb.check(solve(small, jnp.asarray(ROWS))), loop(small, ROWS))


def test_new_values_compile_nothing(small):
    other = small_beam(diagonals="mirrored", young=2e4, tendon_modulus=[1e3, 2e3])
    calls = (
        lambda scene, end: jb.ramp(scene, end, steps=5),
        lambda scene, end: jb.sweep(scene, np.array([end, [1.0, 1.0], [0.8, 1.1]])),
    )
    for call in calls:
        call(small, [0.6, 1.0])
        before = traces["density"]
        assert before > 0
        for scene, end in ((small, [0.7, 1.2]), (jb.command(small, [0.9, 0.9]), [0.5, 1.0]), (other, [0.8, 0.8])):
            jb.check(call(scene, end))
        assert traces["density"] == before
