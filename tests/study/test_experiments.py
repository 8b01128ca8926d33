"""Predictions have the errors that fits of many data sets show, and experiments add what their data would."""

import numpy as np
import pytest
from fitting import HIGH, LOW, NAMES, ROWS, SD, START, TRUTH, Judge, measured, moduli, noisy, tip_and_tensions

import jaxbeam as jb

NEW = np.array([[0.6, 1.0], [0.75, 0.9], [1.0, 0.65]])
flat = lambda theta: np.array([float(theta[name]) for name in NAMES])


@pytest.fixture(scope="module")
def exact():
    return measured(moduli, TRUTH, ROWS, tip_and_tensions)


@pytest.fixture(scope="module")
def fitted(exact):
    return jb.fit(moduli, START, ROWS, noisy(exact, SD), tip_and_tensions, sd=SD, bounds=(LOW, HIGH))


@pytest.fixture(scope="module")
def positions(exact):
    """Positions alone: Young's modulus and that of the tendons only as a ratio."""
    return jb.fit(moduli, START, ROWS, noisy(exact, SD)[:, :2], jb.tip_position, sd=SD[:2], bounds=(LOW, HIGH))


@pytest.fixture(scope="module")
def judge():
    return Judge(moduli, tip_and_tensions, NAMES)


def slopes(judge, theta, rows):
    """Derivatives of tip and tensions `(4 K, q)` by differences."""
    return judge.jacobian(theta, rows, np.zeros((len(rows), 4)), 1.0)


# ------------------------------------------------------------------------------------------------ predictions


def test_prediction_and_its_error(fitted, judge):
    """By the delta method, with derivatives by differences and a covariance of them."""
    theta = flat(fitted.theta)
    J = slopes(judge, theta, ROWS) / np.tile(SD, len(ROWS))[:, None]
    new = slopes(judge, theta, NEW)
    found = jb.predict(fitted, NEW, tip_and_tensions)
    assert found.values.shape == found.errors.shape == (3, 4) and found.bars is None
    np.testing.assert_allclose(found.values.ravel(), judge.residuals(theta, NEW, np.zeros((3, 4)), 1.0), rtol=1e-8)
    expected = np.sqrt(np.einsum("ki,ij,kj->k", new, np.linalg.inv(J.T @ J), new))
    np.testing.assert_allclose(found.errors.ravel(), expected, rtol=1e-5)


@pytest.mark.slow
def test_errors_of_predictions_are_the_scatter_of_fits(exact, fitted):
    """Of 60 fits a standard deviation is known to 9 %; 35 % are four of these."""
    found = jb.predict(fitted, NEW, jb.tip_angle)
    assert found.values.shape == found.errors.shape == (3,)
    again = [
        jb.fit(moduli, TRUTH, ROWS, noisy(exact, SD, seed), tip_and_tensions, sd=SD, bounds=(LOW, HIGH))
        for seed in range(100, 160)
    ]
    angles = np.stack([jb.predict(each, NEW, jb.tip_angle).values for each in again])
    np.testing.assert_allclose(angles.std(axis=0), found.errors, rtol=0.35)
    scatter = np.std([flat(each.theta) for each in again], axis=0)
    np.testing.assert_allclose(scatter, flat(fitted.errors), rtol=0.35)


def test_what_hangs_on_a_ratio_is_known_if_only_the_ratio_is(positions, judge):
    """Positions are known, with the error of a fit with one of the two given; tensions are not."""
    found = jb.predict(positions, NEW, tip_and_tensions)
    assert np.isinf(found.errors[:, 2:]).all()
    theta = flat(positions.theta)
    at = lambda rows: slopes(judge, theta, rows).reshape(-1, 4, 3)[:, :2][..., [0, 2]].reshape(-1, 2)
    J = at(ROWS) / np.tile(SD[:2], len(ROWS))[:, None]
    expected = np.sqrt(np.einsum("ki,ij,kj->k", at(NEW), np.linalg.inv(J.T @ J), at(NEW)))
    np.testing.assert_allclose(found.errors[:, :2].ravel(), expected, rtol=1e-5)


@pytest.mark.slow
def test_bars_of_the_mesh_stand_beside(fitted):
    """They are those of `estimate_error`, component by component."""
    found = jb.predict(fitted, NEW[:2], tip_and_tensions, bars=True)
    assert found.bars.shape == (2, 4)
    scene = jb.command(moduli(fitted.theta), NEW[1])
    solution = jb.check(jb.equilibrium(scene))
    tension = jb.estimate_error(scene, solution, lambda scene, x: jb.tendon_tensions(scene, x)[0])
    np.testing.assert_allclose(found.bars[1, 2], tension.bar, rtol=1e-6)


@pytest.mark.parametrize(
    ("commands", "measure", "words"),
    [
        ([[0.5, -1.0]], jb.tip_angle, "commands: expected positive finite numbers"),
        ([[0.5]], jb.tip_angle, r"commands: expected shape \(K, 2\), .*, got \(1, 1\)"),
        ([0.5, 1.0], jb.tip_angle, r"commands: expected shape \(K, 2\)"),
        (NEW, 3, "measure"),
    ],
)
def test_bad_predictions(fitted, commands, measure, words):
    with pytest.raises(ValueError, match=words):
        jb.predict(fitted, commands, measure)


def test_predictions_are_of_fits():
    with pytest.raises(ValueError, match="fitted"):
        jb.predict(TRUTH, NEW, jb.tip_angle)


# ------------------------------------------------------------------------------------------------ experiments


def fit_with(fitted, exact, row, values, sd):
    """The fit with one more observation, which is as it was predicted, so that the parameters stay."""
    data = np.concatenate([noisy(exact, SD), values[None]])
    sds = np.concatenate([np.tile(SD, (len(ROWS), 1)), sd[None]])
    return jb.fit(moduli, fitted.theta, np.vstack([ROWS, row]), data, tip_and_tensions, sd=sds, bounds=(LOW, HIGH))


def test_errors_after_an_experiment_are_those_of_a_fit_with_it(fitted, exact):
    found = jb.next_experiment(fitted, NEW, "young")
    assert found.errors.shape == (3, 3) and found.best == np.argmin(found.errors[:, 2])
    values = jb.predict(fitted, NEW, tip_and_tensions).values
    for row, value, errors in zip(NEW, values, found.errors, strict=True):
        after = fit_with(fitted, exact, row, value, SD)
        np.testing.assert_allclose(flat(after.errors), errors, rtol=1e-6)


def test_the_volume_of_the_region_shrinks_as_told(fitted, exact):
    """With its prior to within the magnitude of each parameter, and as good as without where all are known well."""
    found = jb.next_experiment(fitted, NEW)
    scaled = fitted.basis.jacobian * flat(fitted.theta)
    values = jb.predict(fitted, NEW, tip_and_tensions).values
    for k in range(3):
        after = fit_with(fitted, exact, NEW[k], values[k], SD).basis.jacobian * flat(fitted.theta)
        for more, tolerance in ((np.eye(3), 1e-6), (0 * np.eye(3), 0.01)):
            volume = lambda J, more=more: np.linalg.slogdet(more + J.T @ J)[1] / 2
            np.testing.assert_allclose(found.information[k], volume(after) - volume(scaled), rtol=tolerance)
    assert found.best == np.argmax(found.information)


def test_an_experiment_with_other_instruments(positions, fitted, exact):
    """Tensions determine what positions do not. Their errors are those of a fit with them."""
    found = jb.next_experiment(positions, NEW, "tendon", measure=tip_and_tensions, sd=SD)
    assert np.isfinite(found.errors).all() and (found.information > 1).all()
    with pytest.raises(ValueError, match="candidates: none of them determines tendon"):
        jb.next_experiment(positions, NEW, "tendon")
    everywhere = jb.next_experiment(positions, NEW)
    assert np.isnan(everywhere.errors[:, 1:]).all() and np.isfinite(everywhere.errors[:, 0]).all()
    assert (everywhere.information > 0).all() and (everywhere.information < found.information).all()
    values = jb.predict(positions, NEW, tip_and_tensions).values
    sd = np.tile(np.array([*SD[:2], np.inf, np.inf]), (len(ROWS) + 1, 1))
    sd[-1] = SD
    data = np.concatenate([noisy(exact, SD), values[1][None]])
    rows = np.vstack([ROWS, NEW[1]])
    after = jb.fit(moduli, positions.theta, rows, data, tip_and_tensions, sd=sd, bounds=(LOW, HIGH))
    np.testing.assert_allclose(flat(after.errors), found.errors[1], rtol=1e-5)


def test_a_batch_of_candidates_is_solved_as_one_by_one(fitted):
    many = np.random.default_rng(3).uniform(0.7, 1.1, (19, 2))
    found = jb.next_experiment(fitted, many, "poisson")
    alone = np.stack([jb.next_experiment(fitted, row[None], "poisson").errors[0] for row in many[::6]])
    np.testing.assert_allclose(found.errors[::6], alone, rtol=1e-7)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"parameter": "yong"}, "parameter: expected one of poisson, tendon, young, got 'yong'"),
        ({"measure": jb.tip_angle}, "sd: expected the standard deviations of the new measure"),
        ({"sd": np.ones(3)}, r"sd: expected positive numbers of shape \(\) or \(4,\)"),
        ({"sd": -1.0}, "sd: expected positive numbers"),
        ({"candidates": NEW[:, :1]}, r"candidates: expected shape \(K, 2\)"),
        ({"fitted": TRUTH}, "fitted: "),
    ],
)
def test_bad_experiments(fitted, change, words):
    with pytest.raises(ValueError, match=words):
        jb.next_experiment(**{"fitted": fitted, "candidates": NEW} | change)


# ---------------------------------------------------------------------------------------------------- coverage


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say(exact):
    """95 % intervals of three parameters and of a prediction: in 200 data sets 92 to 98 % hold it.

    The share has a standard deviation of 1.5 %, so that this is two of them on either side.
    """
    new = np.array([[0.6, 1.0]])
    truth = np.array([*flat(TRUTH), measured(moduli, TRUTH, new, jb.tip_angle)[0]])
    inside = []
    for seed in range(1000, 1200):
        found = jb.fit(moduli, START, ROWS, noisy(exact, SD, seed), tip_and_tensions, sd=SD, bounds=(LOW, HIGH))
        told = jb.predict(found, new, jb.tip_angle)
        off = np.array([*flat(found.theta), told.values[0]]) - truth
        inside.append(np.abs(off) <= 1.96 * np.array([*flat(found.errors), told.errors[0]]))
    share = np.mean(inside, axis=0)
    print(f"coverage of {', '.join(NAMES)} and the tip angle: {share.tolist()}")
    assert (share >= 0.92).all() and (share <= 0.98).all()
