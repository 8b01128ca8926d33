"""Branches of the reference beam through folds and bifurcations, checked by means that know nothing of arclength."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assembled, spring_pair

import jaxbeam as jb
from jaxbeam.scene.evaluation import evaluate, stencil_hessians
from jaxbeam.solve.newton import topology

END = np.array([0.3, 0.3])
SADDLES = jb.Newton(escape=False)  # the setting that trace_branch starts with: compiled once
tip_angle = jax.jit(jb.tip_angle)
evaluated = jax.jit(evaluate)
hessians = jax.jit(stencil_hessians)
pushed = jax.jit(lambda scene, x, shape: jax.jvp(lambda y: jb.forces(scene, y), (x,), (shape,))[1])


@pytest.fixture(scope="module")
def straight(mirrored):
    """The symmetric branch of the mirrored beam."""
    return jb.trace_branch(mirrored, END)


@pytest.fixture(scope="module")
def folded(beam):
    """The branch of the one-sided beam from rest, to some way past its third fold."""
    return jb.trace_branch(beam, END, max_points=90)


@pytest.fixture(scope="module")
def fork(straight):
    (critical,) = straight.critical
    return critical


def angles(scene, branch):
    return np.array([float(tip_angle(scene, x)) for x in branch.x])


def symmetric(scene, x):
    """The mean of a state and its mirror image; node 7 i + j is in row j."""
    x = np.asarray(x).reshape(29, 7, 2)
    return jnp.asarray((0.5 * (x + x[:, ::-1] * [1, -1])).reshape(-1, 2))


def at(scene, ratio):
    return jb.command(scene, [ratio, ratio])


def straight_state(scene, straight, ratio):
    """The symmetric equilibrium at one ratio, stable or not, and its dense stiffness: plain Newton in NumPy.

    It keeps the symmetry exactly: a solver that lowers the energy would leave the state by round-off alone.
    """
    nearest = np.argmin(np.abs(straight.ratios[:, 0] - ratio))
    x, free = symmetric(scene, straight.x[nearest]), ~scene.fixed
    for _ in range(8):
        found = evaluated(at(scene, ratio), x)
        stiffness = assembled(topology(scene), hessians(at(scene, ratio), x))[np.ix_(free.ravel(), free.ravel())]
        step = np.zeros(x.shape)
        step[free] = np.linalg.solve(stiffness, -np.asarray(found.gradient)[free])
        x = symmetric(scene, x + step)
        if np.abs(step).max() < 1e-13:
            break
    # The last term is the round-off of forces, eps times stiffness times |x|, for states without force.
    round_off = np.finfo(float).eps * np.abs(stiffness).max() * np.abs(x).max()
    assert np.abs(np.asarray(found.gradient))[free].max() <= 1e-10 * float(found.gradient_scale.max()) + round_off
    return x, stiffness


# ---------------------------------------------------------------------------------- mirrored: a fork


def test_symmetric_state_loses_stability_between_039_and_038(mirrored, straight, fork):
    assert fork.kind == "bifurcation" and straight.ended == "left"
    assert 0.38 < fork.ratios[0] < 0.39
    np.testing.assert_array_equal(straight.stable, straight.ratios[:, 0] > fork.ratios[0])
    np.testing.assert_array_equal(straight.negative, (straight.ratios[:, 0] < fork.ratios[0]).astype(int))
    np.testing.assert_allclose(angles(mirrored, straight), 0, atol=1e-8)
    assert straight.ratios[fork.after, 0] > fork.ratios[0] > straight.ratios[fork.after + 1, 0]
    assert 1 + fork.parameter * (END[0] - 1) == pytest.approx(fork.ratios[0], rel=1e-12)


@pytest.mark.slow
def test_critical_ratio_by_bisection(mirrored, straight, fork):
    """At each ratio the symmetric state is solved for, and its lowest eigenvalue found, both densely."""
    low, high = 0.38, 0.39
    lowest = lambda ratio: np.linalg.eigvalsh(straight_state(mirrored, straight, ratio)[1])[0]
    assert lowest(low) < 0 < lowest(high)
    while high - low > 1e-8:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if lowest(middle) < 0 else (low, middle)
    assert 0.5 * (low + high) == pytest.approx(fork.ratios[0], abs=1e-6)


def test_saddle_is_flagged_and_left(mirrored, straight, fork):
    ratios = [fork.ratios[0] + d for d in (-0.0025, 0.0025)]
    states = [straight_state(mirrored, straight, ratio)[0] for ratio in ratios]
    below, above = (jb.equilibrium(at(mirrored, r), x, SADDLES) for r, x in zip(ratios, states, strict=True))
    assert int(below.status) == jb.Status.UNSTABLE and abs(float(tip_angle(mirrored, below.x))) < 1e-8
    assert int(above.status) == jb.Status.OK and abs(float(tip_angle(mirrored, above.x))) < 1e-8
    with pytest.raises(jb.EquilibriumError, match=r"UNSTABLE: residual .* the equilibrium is a saddle"):
        jb.check(below)
    scene = at(mirrored, ratios[0])
    left = jb.equilibrium(scene, below.x)
    assert int(left.status) == jb.Status.OK and left.energy < below.energy
    mode = jb.lowest_mode(scene, below.x)
    assert float(mode.values[0]) < 0 and int(mode.negative) == 1
    # The pair: pushed off to either side it ends in states that are mirror images; the escape found one of them.
    pair = [jb.equilibrium(scene, below.x + side * 0.02 * mode.shapes[0]) for side in (1, -1)]
    up, down = (float(tip_angle(mirrored, jb.check(state).x)) for state in pair)
    assert up > 1 and up == pytest.approx(-down, abs=1e-6)
    assert abs(float(tip_angle(mirrored, left.x))) == pytest.approx(up, abs=1e-6)
    np.testing.assert_allclose(pair[0].energy, pair[1].energy, rtol=1e-9)
    assert all(float(jb.lowest_mode(scene, state.x).values[0]) > 0 for state in pair)


def test_bent_pair_is_one_curve_through_the_fork(mirrored, fork):
    """Traced from one side it passes the fork and comes out on the other: a mirror image, folds and all."""
    s = fork.parameter + 0.003
    scene = jb.command(mirrored, 1 + s * (END - 1))
    begin = jb.check(jb.equilibrium(scene, fork.x + 0.02 * fork.shape, SADDLES))
    branch = jb.trace_branch(mirrored, END, x0=begin.x, parameter=s, direction=-1, interval=(0.5, 1.0), max_points=20)
    first, second = branch.critical[:2]
    assert first.kind == second.kind == "fold"
    # The fork leans: the pair turns back towards larger ratios first, and both folds are at the same command.
    assert first.ratios[0] == pytest.approx(second.ratios[0], abs=1e-8)
    assert fork.ratios[0] < first.ratios[0] < fork.ratios[0] + 1e-3
    one, other = float(tip_angle(mirrored, first.x)), float(tip_angle(mirrored, second.x))
    assert abs(one) > 0.1 and one == pytest.approx(-other, abs=1e-5)
    np.testing.assert_array_equal(branch.negative[first.after + 1 : second.after + 1], 1)
    assert branch.stable[: first.after + 1].all() and branch.stable[second.after + 1]


def test_bending_stiffens_while_the_anchors_soften(mirrored, straight, fork):
    """Told apart by shape: bending is the mode most like the softest one at rest."""
    rest = jb.lowest_mode(mirrored, mirrored.mesh.nodes, 3).shapes[0]
    bending = []
    for ratio in (1.0, 0.7, 0.5, 0.36, 0.3):
        x, stiffness = straight_state(mirrored, straight, ratio)
        modes = jb.lowest_mode(at(mirrored, ratio), x, 3)
        np.testing.assert_allclose(modes.values, np.linalg.eigvalsh(stiffness)[:3], rtol=1e-6)
        alike = np.abs(np.einsum("knd,nd->k", modes.shapes, rest))
        assert alike.max() > 0.95
        bending.append(float(modes.values[np.argmax(alike)]))
        if ratio < fork.ratios[0]:
            assert float(modes.values[0]) < 0 and alike[0] < 0.3
        else:
            assert np.argmax(alike) == 0
    assert (np.diff(bending) > 0).all()


def test_start_and_direction(mirrored, straight):
    """From a state half way, back to rest: the same branch, until it leaves the interval."""
    middle = np.argmin(np.abs(straight.parameter - 0.5))
    seen = []
    back = jb.trace_branch(
        mirrored,
        END,
        x0=straight.x[middle],
        parameter=float(straight.parameter[middle]),
        direction=-1,
        interval=(0.3, 1.0),
        progress=lambda count, s: seen.append((count, s)),
    )
    assert back.ended == "left" and back.parameter[-1] < 0.3 and back.critical == ()
    assert (np.diff(back.parameter) < 0).all() and back.stable.all()
    np.testing.assert_allclose(back.x[0], straight.x[middle], atol=1e-9)
    assert seen == [(k + 1, s) for k, s in enumerate(back.parameter.tolist())][1:]
    np.testing.assert_allclose(back.ratios, 1 + back.parameter[:, None] * (END - 1), rtol=1e-14)


def test_line_of_progress(mirrored, straight, terminal):
    branch = jb.trace_branch(mirrored, END, max_points=3, progress=True)
    np.testing.assert_array_equal(branch.parameter, straight.parameter[:3])
    line, cursor = terminal.lines()
    assert line.startswith(f"3 points, s = {branch.parameter[-1]:.4f}, 0:") and cursor == ""


# ------------------------------------------------------------------------------- one-sided: folds


def test_folds_of_the_one_sided_beam(beam, folded):
    assert [c.kind for c in folded.critical] == ["fold"] * 3 and folded.ended == "points"
    first, second, third = folded.critical
    assert 0.408 < first.ratios[0] < 0.409 and 0.412 < second.ratios[0] < 0.413
    # Unstable, with one negative eigenvalue, between the first two and beyond the third; stable elsewhere.
    expected = np.zeros(len(folded.negative), int)
    expected[first.after + 1 : second.after + 1] = 1
    expected[third.after + 1 :] = 1
    np.testing.assert_array_equal(folded.negative, expected)
    assert second.after - first.after >= 3 and third.after - second.after >= 5
    turns = np.flatnonzero(np.diff(np.sign(np.diff(folded.parameter))))
    assert len(turns) == 3
    assert all(abs(turn - c.after) <= 1 for turn, c in zip(turns, folded.critical, strict=True))


@pytest.mark.slow
def test_folds_by_the_turning_point(beam, folded):
    """The extreme of a polynomial through the branch's points near each fold: no eigenvalue in it."""
    for fold, step in zip(folded.critical, (0.001, 0.002, 0.001), strict=True):
        nearby = jb.trace_branch(
            beam, END, x0=folded.x[fold.after], parameter=float(folded.parameter[fold.after]),
            direction=int(np.sign(folded.parameter[fold.after] - folded.parameter[fold.after - 1])),
            step=step, max_points=60,
        )  # fmt: skip
        angle = angles(beam, nearby)
        there = float(tip_angle(beam, fold.x))
        near = np.argsort(np.abs(angle - there))[:9]
        assert angle[near].min() < there < angle[near].max()
        width = np.ptp(angle[near])
        curve = np.polynomial.Polynomial.fit(angle[near], nearby.ratios[near, 0], 6)
        roots = curve.deriv().roots()
        roots = roots[(np.abs(roots.imag) < 1e-9) & (np.abs(roots.real - there) < width)].real
        root = roots[np.argmin(np.abs(roots - there))]
        assert curve(root) == pytest.approx(fold.ratios[0], abs=1e-6)
        assert root == pytest.approx(there, abs=0.01 * width + 1e-4)


@pytest.mark.parametrize(("which", "side"), [(0, 1), (1, -1)])
def test_beam_snaps_a_millionth_past_a_fold(beam, folded, which, side):
    """Newton's method at fixed commands: on one side of the fold a state is near, on the other none."""
    fold = folded.critical[which]
    there = float(tip_angle(beam, fold.x))
    before, past = (jb.equilibrium(at(beam, fold.ratios[0] + sign * side * 1e-6), fold.x, SADDLES) for sign in (1, -1))
    assert abs(float(tip_angle(beam, before.x)) - there) < 0.1
    assert abs(float(tip_angle(beam, past.x)) - there) > 0.3


def test_every_point_is_in_balance(beam, folded, mirrored, straight):
    for scene, branch in ((beam, folded), (mirrored, straight)):
        assert (branch.residual <= 1e-10).all()
        for ratios, x, volume in zip(branch.ratios, branch.x, branch.smallest_jacobian, strict=True):
            found = evaluated(jb.command(scene, ratios), jnp.asarray(x))
            unbalanced = np.abs(np.asarray(found.gradient))[~scene.fixed].max()
            assert unbalanced <= 1.1e-10 * float(found.gradient_scale.max())
            corners = np.asarray(x)[scene.mesh.elements]
            rest = np.asarray(scene.mesh.nodes)[scene.mesh.elements]
            area = lambda t: np.linalg.det(np.stack([t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]], axis=1))
            assert volume == pytest.approx((area(corners) / area(rest)).min(), abs=1e-12)


def test_critical_points_are_equilibria_with_a_null_mode(beam, folded, mirrored, straight):
    for scene, branch in ((beam, folded), (mirrored, straight)):
        for point in branch.critical:
            commanded = jb.command(scene, point.ratios)
            found = evaluated(commanded, point.x)
            assert np.abs(np.asarray(found.gradient))[~scene.fixed].max() < 1.1e-10 * float(found.gradient_scale.max())
            assert abs(point.eigenvalue) < 1e-6
            # What is left is the eigenvalue, against a largest one of some 1e4.
            assert np.abs(np.asarray(pushed(commanded, point.x, point.shape)))[~scene.fixed].max() < 1e-4


@pytest.mark.slow
def test_coarse_steps_stay_on_the_branch(beam, folded, mirrored, straight):
    for scene, fine in ((beam, folded), (mirrored, straight)):
        last = fine.critical[-1]
        coarse = jb.trace_branch(scene, END, step=0.04, max_points=len(fine.x))
        assert len(coarse.critical) >= len(fine.critical)
        for a, b in zip(coarse.critical, fine.critical, strict=False):
            assert a.kind == b.kind
            np.testing.assert_allclose(a.ratios, b.ratios, atol=1e-8)
            np.testing.assert_allclose(a.x, b.x, atol=1e-5)
        assert coarse.critical[len(fine.critical) - 1].after < last.after


# ------------------------------------------------------------------------------------------ errors


def test_errors(beam):
    with pytest.raises(ValueError, match="direction: expected 1 or -1, got 0"):
        jb.trace_branch(beam, END, direction=0)
    with pytest.raises(ValueError, match=r"step: expected a positive finite number, got -1"):
        jb.trace_branch(beam, END, step=-1)
    with pytest.raises(ValueError, match=r"got interval \(1.0, 0.0\), parameter 0.0"):
        jb.trace_branch(beam, END, interval=(1.0, 0.0))
    with pytest.raises(ValueError, match=r"interval\[0\] <= parameter <= interval\[1\], .* parameter 2"):
        jb.trace_branch(beam, END, parameter=2)
    with pytest.raises(ValueError, match=r"ratios: expected shape \(2,\), one for each tendon, got \(1,\)"):
        jb.trace_branch(beam, [0.3])
    with pytest.raises(ValueError, match="ratios: expected positive finite numbers"):
        jb.trace_branch(beam, [0.3, -1.0])


def test_a_step_without_end_is_broken_off():
    """It is halved no more often than another: half of infinity is no shorter. Or it is refused."""
    scene = spring_pair(0.9)
    with contextlib.suppress(ValueError):
        branch = jb.trace_branch(scene, [0.8, 0.8], parameter=0.5, step=np.inf)
        assert branch.ended == "step" and len(branch.x) == 1


def test_no_equilibrium_at_the_start():
    scene = spring_pair(1.0)
    with pytest.raises(jb.EquilibriumError, match="NOT_CONVERGED"):
        jb.trace_branch(
            scene, [1.3, 1.3], x0=scene.mesh.nodes + np.array([[0, 0], [0, 0], [0.3, 0.4], [0, 0]]), solver=jb.Newton(0)
        )
