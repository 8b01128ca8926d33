"""`fit` finds the parameters that SciPy finds, and says of each what the data tell."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fitting import (
    HIGH,
    LOW,
    NAMES,
    ROWS,
    SD,
    START,
    TRUTH,
    Judge,
    measured,
    moduli,
    noisy,
    tip_and_tensions,
    traced,
)

import jaxbeam as jb
from jaxbeam.study import fit as fitting
from jaxbeam.study.design import DesignStatus

flat = lambda theta: np.array([float(theta[name]) for name in NAMES])
fit_moduli = partial(jb.fit, moduli, START, ROWS, measure=tip_and_tensions, sd=SD, bounds=(LOW, HIGH))


@pytest.fixture(scope="module")
def exact():
    return measured(moduli, TRUTH, ROWS, tip_and_tensions)


@pytest.fixture(scope="module")
def data(exact):
    return noisy(exact, SD)


@pytest.fixture(scope="module")
def fitted(data):
    return fit_moduli(values=data)


@pytest.fixture(scope="module")
def judge():
    return Judge(moduli, tip_and_tensions, NAMES)


# ---------------------------------------------------------------------------------------- against SciPy


def test_three_moduli_are_those_of_scipy(fitted, data, judge):
    """Positions and tensions together determine all three."""
    theirs = judge.fit(flat(START), ROWS, data, SD, low=flat(LOW), high=flat(HIGH))
    assert fitted.status == DesignStatus.REACHED and fitted.not_determined == [] and not fitted.held.any()
    np.testing.assert_allclose(flat(fitted.theta), theirs, rtol=1e-6)
    J = judge.jacobian(theirs, ROWS, data, SD)
    covariance = np.linalg.inv(J.T @ J)
    errors = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(flat(fitted.errors), errors, rtol=1e-5)
    np.testing.assert_allclose(fitted.correlations, covariance / np.outer(errors, errors), atol=1e-6)
    np.testing.assert_allclose(fitted.singular_values, np.linalg.svd(J * theirs, compute_uv=False), rtol=1e-5)
    assert fitted.names == NAMES


def test_residuals_are_those_of_equilibrium(fitted, data, judge):
    theirs = judge.residuals(flat(fitted.theta), ROWS, data, SD).reshape(data.shape)
    np.testing.assert_allclose(fitted.residuals, theirs, atol=1e-7)
    np.testing.assert_allclose(fitted.values, data + SD * theirs, rtol=1e-8)
    assert fitted.degrees_of_freedom == data.size - 3
    np.testing.assert_allclose(fitted.reduced_chi_square, np.sum(theirs**2) / (data.size - 3), rtol=1e-7)


def test_jacobian_is_that_of_differences(fitted, data, judge):
    theirs = judge.jacobian(flat(fitted.theta), ROWS, data, SD)
    np.testing.assert_allclose(fitted.basis.jacobian, theirs, atol=1e-7 * np.abs(theirs).max(axis=0).min(), rtol=1e-6)


def test_positions_alone_determine_a_ratio(data, judge):
    """Young's modulus over that of the tendons, and Poisson's ratio: those of a fit with one of the moduli given."""
    found = jb.fit(moduli, START, ROWS, data[:, :2], jb.tip_position, sd=SD[:2], bounds=(LOW, HIGH))
    assert found.not_determined == ["tendon and young only as a ratio"]
    assert np.isnan(found.errors["young"]) and np.isnan(found.errors["tendon"])
    assert found.degrees_of_freedom == 20 - 2
    positions = Judge(
        lambda theta: moduli(theta | {"tendon": 2e3, "young": 2e3 * theta["ratio"]}),
        jb.tip_position,
        ["poisson", "ratio"],
    )
    theirs = positions.fit(np.array([0.3, 4.0]), ROWS, data[:, :2], SD[:2], low=[0, 0], high=[0.495, np.inf])
    ours = [found.theta["poisson"], found.theta["young"] / found.theta["tendon"]]
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    J = positions.jacobian(theirs, ROWS, data[:, :2], SD[:2])
    np.testing.assert_allclose(found.errors["poisson"], np.sqrt(np.linalg.inv(J.T @ J)[0, 0]), rtol=1e-5)
    printed = str(found)
    assert "not determined: tendon and young only as a ratio" in printed and printed.count("+-") == 1


def test_a_bound_holds_a_parameter(data, judge):
    high = HIGH | {"poisson": 0.35}
    found = fit_moduli(values=data, bounds=(LOW, high))
    theirs = judge.fit(flat(START), ROWS, data, SD, low=flat(LOW), high=flat(high))
    np.testing.assert_allclose(flat(found.theta), theirs, rtol=1e-6)
    assert found.held.tolist() == [1, 0, 0] and np.isnan(found.errors["poisson"])
    # The sum of squares falls past the bound, and nowhere else.
    slope = found.basis.jacobian.T @ found.residuals.ravel() * flat(found.theta)
    assert slope[0] < -1 and np.abs(slope[1:]).max() < 1e-4 * abs(slope[0])
    J = judge.jacobian(theirs, ROWS, data, SD)[:, 1:]
    np.testing.assert_allclose(flat(found.errors)[1:], np.sqrt(np.diag(np.linalg.inv(J.T @ J))), rtol=1e-5)
    assert "held at its bound" in str(found) and found.not_determined == []


def test_a_bound_lends_no_knowledge(data):
    """Positions determine a ratio. Where a bound stops one of the two moduli, the other is known no better."""
    start, low = START | {"tendon": 3e3, "young": 1e3}, LOW | {"tendon": 2.9e3}
    found = jb.fit(moduli, start, ROWS, data[:, :2], jb.tip_position, sd=SD[:2], bounds=(low, HIGH))
    assert found.theta["tendon"] == 2.9e3 and found.not_determined == ["tendon and young only as a ratio"]
    assert np.isnan(found.errors["young"]) and np.isfinite(found.errors["poisson"])


def test_a_prior_is_further_residuals(data, judge):
    prior = lambda theta: jnp.stack([(theta["poisson"] - 0.45) / 0.01, jnp.log(theta["young"] / 9e3) / 0.1])
    found = fit_moduli(values=data, prior=prior)
    theirs = judge.fit(
        flat(START), ROWS, data, SD, more=lambda t: np.array([(t[0] - 0.45) / 0.01, np.log(t[2] / 9e3) / 0.1])
    )
    np.testing.assert_allclose(flat(found.theta), theirs, rtol=1e-6)
    assert found.degrees_of_freedom == data.size + 2 - 3
    # With one observation, of two positions, the prior determines what these do not.
    found = jb.fit(moduli, START, ROWS[:1], data[:1, :2], jb.tip_position, sd=SD[:2], bounds=(LOW, HIGH), prior=prior)
    assert found.not_determined == [] and np.isfinite(flat(found.errors)).all()


# --------------------------------------------------------------------------------------------- the search


@pytest.mark.parametrize(
    "start",
    [START, TRUTH, {"young": 1e2, "poisson": 0.0, "tendon": 3e5}, {"young": 1e6, "poisson": 0.1, "tendon": 30.0}],
)
def test_exact_data_give_the_truth_from_far(exact, start):
    """From moduli a hundred times too small and too large, and from a bound."""
    found = jb.fit(moduli, start, ROWS, exact, tip_and_tensions, sd=SD, bounds=(LOW, HIGH))
    assert found.status == DesignStatus.REACHED
    np.testing.assert_allclose(flat(found.theta), flat(TRUTH), rtol=1e-8)


def test_a_step_that_fails_is_not_taken(exact, monkeypatch):
    """Without bounds a step goes where a Poisson's ratio above 1/2 has no equilibrium."""
    statuses, predict_all = [], fitting.predict_all

    def spy(*arguments):
        found = predict_all(*arguments)
        statuses.append(int(np.max(found.status)))
        return found

    monkeypatch.setattr(fitting, "predict_all", spy)
    found = fit_moduli(values=exact, bounds=None)
    assert any(status & jb.Status.INVALID for status in statuses) and statuses[-1] == 0
    assert found.steps == len(statuses) and found.status == DesignStatus.REACHED
    np.testing.assert_allclose(flat(found.theta), flat(TRUTH), rtol=1e-8)


def test_counts(data, fitted):
    calls = []
    again = fit_moduli(values=data, progress=lambda *told: calls.append(told))
    assert [steps for steps, _ in calls] == list(range(2, again.steps + 1))
    assert again.steps == fitted.steps <= 12 and again.solves == again.steps * len(ROWS)
    assert sorted((cost for _, cost in calls), reverse=True) == [cost for _, cost in calls]
    few = fit_moduli(values=data, max_steps=3)
    assert few.status == DesignStatus.NOT_CONVERGED and few.steps == 4


def test_one_program(data, fitted):
    """Other values, other numbers of observations, another start: nothing is traced again."""
    before = len(traced)
    assert before > 0
    jb.fit(moduli, TRUTH, ROWS[:3], data[:3], tip_and_tensions, sd=2 * SD)
    jb.fit(moduli, TRUTH, np.tile(ROWS, (3, 1)), np.tile(data, (3, 1)), tip_and_tensions)
    sweeps = len(traced) - before
    jb.fit(moduli, START, ROWS[:7], data[:7], tip_and_tensions, sd=SD)
    assert len(traced) - before == sweeps == 0


def test_duplicates_halve_the_variance(data, fitted):
    found = jb.fit(moduli, START, np.tile(ROWS, (2, 1)), np.tile(data, (2, 1)), tip_and_tensions, sd=SD)
    np.testing.assert_allclose(flat(found.theta), flat(fitted.theta), rtol=1e-6)
    np.testing.assert_allclose(flat(found.errors), flat(fitted.errors) / np.sqrt(2), rtol=1e-5)


# ------------------------------------------------------------------------------------------ standard deviations


def test_shapes_of_sd(data, fitted):
    whole = np.broadcast_to(SD, data.shape)
    np.testing.assert_array_equal(flat(fit_moduli(values=data, sd=whole).theta), flat(fitted.theta))
    one, each = fit_moduli(values=data, sd=2.0), fit_moduli(values=data, sd=np.full(4, 2.0))
    np.testing.assert_array_equal(flat(one.theta), flat(each.theta))


def test_missing_values(data):
    """Infinite `sd` is the same as to leave out: a whole observation, or a component of all."""
    sd = np.broadcast_to(SD, data.shape).copy()
    sd[3] = np.inf
    gone, there = np.where(np.isinf(sd), 0.0, data), np.arange(len(ROWS)) != 3
    found = fit_moduli(values=gone, sd=sd)
    less = jb.fit(moduli, START, ROWS[there], data[there], tip_and_tensions, sd=SD, bounds=(LOW, HIGH))
    np.testing.assert_allclose(flat(found.theta), flat(less.theta), rtol=1e-8)
    np.testing.assert_allclose(flat(found.errors), flat(less.errors), rtol=1e-6)
    assert found.degrees_of_freedom == less.degrees_of_freedom == 36 - 3 and (found.residuals[3] == 0).all()
    positions = fit_moduli(values=data, sd=[*SD[:2], np.inf, np.inf])
    assert positions.not_determined == ["tendon and young only as a ratio"]


def test_unknown_sd(data):
    """All are taken alike. The variance of a measurement is that of the residuals."""
    found, unit = fit_moduli(values=data, sd=None), fit_moduli(values=data, sd=1.0)
    np.testing.assert_array_equal(flat(found.theta), flat(unit.theta))
    np.testing.assert_allclose(flat(found.errors), flat(unit.errors) * np.sqrt(unit.reduced_chi_square), rtol=1e-8)
    assert "chance" not in str(found)


def test_exact_data_with_unknown_sd_have_no_outliers(exact):
    found = fit_moduli(values=exact, sd=None)
    assert len(found.outliers) == 0 and flat(found.errors).max() < 1e-6


@pytest.mark.parametrize(("factor", "words"), [(0.1, "too large for chance"), (10.0, "too small for chance")])
def test_wrong_sd_is_told(data, fitted, factor, words):
    found = fit_moduli(values=data, sd=factor * SD)
    assert words in str(found) and "chance" not in str(fitted) and len(found.outliers) == 0


# ------------------------------------------------------------------------------------------------- outliers


def test_planted_outliers_are_named(data):
    wrong = data.copy()
    wrong[2, 1] += 8 * SD[1]
    wrong[7, 3] -= 20 * SD[3]
    found = fit_moduli(values=wrong)
    assert found.outliers.tolist() == [[7, 3], [2, 1]]
    # Predictions less measurements: of the other sign than the mistakes.
    assert re.search(r"outliers: observation 7 \(component 3, \+\d+\.\d\), 2 \(component 1, -\d+", str(found))


def test_a_huge_outlier_is_the_first(data):
    """It bends the fit so far that others look wrong, until it is left out."""
    wrong, sd = data.copy(), np.broadcast_to(SD, data.shape).copy()
    wrong[3, 2] += 3000
    found = fit_moduli(values=wrong)
    assert found.outliers[0].tolist() == [3, 2] and len(found.outliers) <= 3
    sd[3, 2] = np.inf
    assert fit_moduli(values=wrong, sd=sd).outliers.tolist() == []


def test_clean_data_have_no_outliers(exact):
    """One in a hundred data sets may: of thirty more than three once in 4,000 times."""
    named = [len(fit_moduli(values=noisy(exact, SD, seed)).outliers) > 0 for seed in range(1, 31)]
    assert sum(named) <= 3


# ------------------------------------------------------------------------------------- structure of parameters


def tree(theta):
    """Products of numbers, and some without any effect."""
    a, b = theta["tendon"]
    return jb.tendon_beam(
        7, 3, young=theta["solid"]["moduli"][0] * 1e3, poisson=theta["solid"]["moduli"][1], tendon_modulus=a * b
    )


def test_nested_parameters_a_product_and_one_without_effect(data, fitted):
    start = {"solid": {"moduli": np.array([8.0, 0.35])}, "spare": -2.0, "tendon": [40.0, 50.0]}
    found = jb.fit(tree, start, ROWS, data, tip_and_tensions, sd=SD)
    assert found.names == ["solid.moduli[0]", "solid.moduli[1]", "spare", "tendon[0]", "tendon[1]"]
    assert sorted(found.not_determined) == ["spare is not determined", "tendon[0] and tendon[1] only as a product"]
    a, b = found.theta["tendon"]
    ours = [found.theta["solid"]["moduli"][1], a * b, found.theta["solid"]["moduli"][0] * 1e3]
    np.testing.assert_allclose(ours, flat(fitted.theta), rtol=1e-6)
    np.testing.assert_allclose(found.errors["solid"]["moduli"] * [1e3, 1], flat(fitted.errors)[[2, 0]], rtol=1e-5)
    assert found.theta["spare"] == -2.0  # nothing moves it
    assert jax.tree.structure(found.errors) == jax.tree.structure(start) and np.isnan(found.errors["spare"])


def one_modulus(young):
    return jb.tendon_beam(7, 3, young=young)


def test_one_number_and_a_scalar_measure():
    values = measured(one_modulus, 1e4, ROWS, jb.tip_angle)
    found = jb.fit(one_modulus, 3e3, ROWS, noisy(values, 0.01), jb.tip_angle, sd=0.01)
    assert found.names == ["theta"] and found.values.shape == found.residuals.shape == (len(ROWS), 1)
    assert abs(found.theta - 1e4) < 4 * found.errors < 400


def sideways(theta):
    """A load at the tip that may be zero."""
    scene = jb.tendon_beam(7, 3, young=theta["young"])
    load = jb.dead_load(scene.mesh, np.asarray(scene.tip)[:1], jnp.stack([0 * theta["load"], theta["load"]]))
    return jb.Scene(scene.mesh, (*scene.terms, load), scene.held, scene.tip)


def test_what_may_be_zero_has_an_error():
    """A load of 0.2 that is known to 0.2 is determined: it is not large."""
    data = noisy(measured(sideways, {"young": 1e4, "load": 0.2}, ROWS, jb.tip_position), SD[:2])
    found = jb.fit(sideways, {"young": 8e3, "load": 0.0}, ROWS, data, jb.tip_position, sd=SD[:2])
    assert found.not_determined == [] and 0.1 < found.errors["load"] < 0.4
    assert abs(found.theta["load"] - 0.2) < 4 * found.errors["load"]


def in_millimetres(theta):
    """Lengths in mm and forces as they are."""
    young, tendon = theta["young"] * 1e-3, theta["tendon"] * 1e3
    return jb.tendon_beam(7, 3, 3500.0, 800.0, young=young, poisson=theta["poisson"], tendon_modulus=tendon)


def test_units_change_nothing(data, fitted):
    """The thickness stays 1: Young's modulus is a force over a length, that of the tendons a force times a length."""
    units = np.array([1e3, 1e3, 1.0, 1.0])
    found = jb.fit(in_millimetres, START, ROWS, data * units, tip_and_tensions, sd=SD * units, bounds=(LOW, HIGH))
    np.testing.assert_allclose(flat(found.theta), flat(fitted.theta), rtol=1e-8)
    np.testing.assert_allclose(flat(found.errors), flat(fitted.errors), rtol=1e-6)
    assert found.steps == fitted.steps


# ---------------------------------------------------------------------------------------------- bad input


def steep(scene, x):
    return jnp.sqrt(jnp.abs(jb.tip_position(scene, x)[0] * 0))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"values": "nan"}, r"values: observation 1 is not finite, .*; leave such rows out, .* infinity in sd"),
        ({"values": np.zeros((10, 3))}, r"values: expected shape \(10, 4\), .*, got \(10, 3\)"),
        ({"commands": ROWS[:, :1]}, r"commands: expected shape \(N, 2\), .*, got \(10, 1\)"),
        ({"commands": -ROWS}, "commands: expected positive finite numbers"),
        ({"sd": np.zeros(4)}, "sd: expected positive numbers, got 0.0 for observation 0, component 0"),
        ({"sd": np.ones(3)}, r"sd: expected shape \(\), \(4,\) or \(10, 4\), got \(3,\)"),
        (
            {"sd": np.where(np.arange(40).reshape(10, 4) < 2, 1, np.inf)},
            "values: expected at least as many .* 3, got 2",
        ),
        ({"sd": None, "prior": lambda theta: theta["young"]}, "sd: expected standard deviations beside a prior"),
        ({"prior": lambda theta: jnp.nan * theta["young"]}, r"prior: expected finite .* at theta0, got \[nan\]"),
        ({"bounds": (LOW, LOW)}, "bounds: expected low <= theta0 <= high, got 0, 0.3, 0 of poisson"),
        ({"bounds": ({"young": 1.0}, HIGH)}, "bounds, low: expected the structure of theta0"),
        ({"bounds": 3.0}, r"bounds: expected \(low, high\)"),
        ({"theta0": {}}, "theta0: expected a pytree of floats"),
        ({"theta0": {**START, "young": np.nan}}, "theta0"),
        ({"measure": lambda scene, x: x}, r"measure: expected a function \(scene, x\) to shape \(\) or \(p,\)"),
        ({"max_steps": 0}, "max_steps"),
        ({"design": 3}, "design"),
    ],
)
def test_bad_input(data, change, words):
    given = {
        "design": moduli, "theta0": START, "commands": ROWS, "values": data, "measure": tip_and_tensions, "sd": SD
    } | change  # fmt: skip
    if isinstance(given["values"], str):
        given["values"] = np.where(np.arange(10)[:, None] == 1, np.nan, data)
    with pytest.raises(ValueError, match=words):
        jb.fit(**given)


def test_unknown_sd_needs_more_data_than_parameters(data):
    with pytest.raises(ValueError, match=r"values: expected more than parameters, 3, got 2: .*or give sd"):
        jb.fit(moduli, START, ROWS[:1], data[:1, :2], jb.tip_position)


def test_a_measure_without_derivatives(data):
    with pytest.raises(ValueError, match=r"measure: expected finite .* observation 0, with no derivative by poisson"):
        jb.fit(moduli, START, ROWS, data[:, 0], steep, sd=1.0)


def test_a_start_without_equilibrium(data):
    """The beam would pass through itself there."""
    rows = np.where(np.arange(10)[:, None] == 4, [[0.001, 1.0]], ROWS)
    with pytest.raises(jb.EquilibriumError, match=r"(?s)OVERLAPPING.*\b4\b.*start from other parameters"):
        jb.fit(moduli, START, rows, data, tip_and_tensions, sd=SD)


@pytest.mark.parametrize(
    ("value", "error", "shown"),
    [
        (0.45754095, 0.00508, "0.45754"),
        (240.0, 0.273, "240.000"),
        (1234567.0, 5.4, "1234567.00"),
        (-2.5e-9, 3e-11, "-2.5000e-09"),
        (0.3, 20.0, "0.300"),
        (159.95814, np.nan, "160"),
        (0.0, 1.0, "0"),
    ],
)
def test_a_value_is_printed_to_the_digits_of_its_error(value, error, shown):
    assert fitting._as_exact(value, error) == shown
