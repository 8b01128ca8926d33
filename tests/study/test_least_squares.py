"""The search by itself, on formulas: against SciPy, at bounds, where residuals do not exist, in any units."""

import numpy as np
import pytest
from scipy import optimize

from jaxbeam.study.design import DesignStatus
from jaxbeam.study.least_squares import Residuals, least_squares

FREE = (np.full(3, -np.inf), np.full(3, np.inf))
TIMES = np.linspace(0, 2, 12)


def decay(theta, data, units=1.0):
    """Residuals of `a exp(-b t) + c`, and their derivatives by `theta` in these units."""
    a, b, c = theta * units
    e = np.exp(-b * TIMES)
    return a * e + c - data, np.stack([e, -a * TIMES * e, np.ones_like(e)], axis=1) * units


def search(function, start, low, high, max_steps=100):
    residuals = lambda theta, before: Residuals(*function(theta), None)
    return least_squares(residuals, np.array(start, float), low, high, max_steps, lambda *told: None)


@pytest.mark.parametrize("seed", [*range(20), 140, 157])
def test_minimum_within_bounds_is_that_of_scipy(seed):
    """With random bounds, of which some hold. In the last two, full steps go back and forth about the minimum."""
    rng = np.random.default_rng(seed)
    data = decay(np.array([2.0, 1.5, 0.5]), 0)[0] + 0.1 * rng.normal(size=12)
    low, high = np.array([2.0, 1.5, 0.5]) + np.sort(rng.normal(size=(2, 3)), axis=0)
    start = low + (high - low) * rng.uniform(size=3)
    found = search(lambda theta: decay(theta, data), start, low, high)
    theirs = optimize.least_squares(
        lambda theta: decay(theta, data)[0],
        start,
        lambda theta: decay(theta, data)[1],
        bounds=(low, high),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        max_nfev=2000,
    )
    assert found.status == DesignStatus.REACHED and found.trials <= 40
    assert (low <= found.theta).all() and (found.theta <= high).all()
    assert found.here.cost <= 2 * theirs.cost * (1 + 1e-9)  # theirs is half of the sum
    # Karush, Kuhn and Tucker: downhill is only out of the bounds that hold.
    slope = found.here.jacobian.T @ found.here.values
    assert np.abs(slope[found.held == 0]).max(initial=0) < 1e-5
    assert (slope * found.held <= 0).all() and (found.held != 0).tolist() == (
        ((found.theta == low) & (slope > 0)) | ((found.theta == high) & (slope < 0))
    ).tolist()


def test_bounds_do_hold_in_these():
    held = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        data = decay(np.array([2.0, 1.5, 0.5]), 0)[0] + 0.1 * rng.normal(size=12)
        low, high = np.array([2.0, 1.5, 0.5]) + np.sort(rng.normal(size=(2, 3)), axis=0)
        start = low + (high - low) * rng.uniform(size=3)
        held += (search(lambda theta, data=data: decay(theta, data), start, low, high).held != 0).sum()
    assert held > 10


def test_costs_fall_and_calls_are_counted():
    calls = []

    def function(theta):
        calls.append(theta)
        return decay(theta, decay(np.array([2.0, 1.5, 0.5]), 0)[0])

    found = search(function, [20.0, 0.1, -3.0], *FREE)
    assert found.trials == len(calls) and (np.diff(found.costs) < 0).all()
    np.testing.assert_allclose(found.theta, [2.0, 1.5, 0.5], rtol=1e-9)
    stopped = search(function, [20.0, 0.1, -3.0], *FREE, max_steps=2)
    assert stopped.status == DesignStatus.NOT_CONVERGED and stopped.trials == 3


def test_units_change_no_step():
    """To round-off: units of powers of two leave every digit."""
    data = decay(np.array([2.0, 1.5, 0.5]), 0)[0] + 0.1 * np.random.default_rng(0).normal(size=12)
    units = np.array([2.0**-20, 2.0**10, 2.0**30])
    plain = search(lambda theta: decay(theta, data), [5.0, 0.5, 0.0], *FREE)
    other = search(lambda theta: decay(theta, data, units), np.array([5.0, 0.5, 0.0]) / units, *FREE)
    np.testing.assert_allclose(other.theta * units, plain.theta, rtol=1e-9)
    assert other.trials == plain.trials and np.allclose(other.costs, plain.costs, rtol=1e-10)


def test_where_residuals_do_not_exist_a_shorter_step_is_tried():
    """Those of log(theta) - 1 from afar: the first full step goes to a negative number."""
    failed = []

    def residuals(theta, before):
        if theta[0] <= 0:
            failed.append(theta)
            return None
        return Residuals(np.log(theta) - 1, 1 / theta[None], None)

    one = np.full(1, np.inf)
    found = least_squares(residuals, np.array([20.0]), -one, one, 50, lambda *told: None)
    assert failed and found.status == DesignStatus.REACHED
    np.testing.assert_allclose(found.theta, np.e, rtol=1e-9)


def test_what_changes_nothing_is_not_moved():
    """Of a product the factors move in proportion, in their own units; a parameter without effect stays."""

    def function(theta):
        a, b, _ = theta
        return np.array([a * b - 6, 2 * a * b - 12.5]), np.array([[b, a, 0], [2 * b, 2 * a, 0]])

    found = search(function, [1.0, 2.0, 7.0], *FREE)
    np.testing.assert_allclose(found.theta[0] * found.theta[1], 6.2, rtol=1e-9)
    np.testing.assert_allclose(found.theta[1] / found.theta[0], 2, rtol=0.05)
    assert found.theta[2] == 7 and found.status == DesignStatus.REACHED


def test_an_exact_zero():
    """A parameter that ends at zero: no share of it tells when to stop."""
    data = decay(np.array([2.0, 1.5, 0.0]), 0)[0]
    found = search(lambda theta: decay(theta, data), [3.0, 1.0, 0.0], *FREE)
    assert found.status == DesignStatus.REACHED and found.trials < 15
    np.testing.assert_allclose(found.theta, [2.0, 1.5, 0.0], atol=1e-10)


def test_noisy_residuals_end_the_search():
    """Where the sum of squares is uncertain in its tenth digit the search ends there, and wastes few trials."""
    data = decay(np.array([2.0, 1.5, 0.5]), 0)[0] + 0.1 * np.cos(9 * TIMES)
    exact = search(lambda theta: decay(theta, data), [5.0, 0.5, 0.0], *FREE)
    for seed in range(10):
        rng = np.random.default_rng(seed)

        def function(theta, rng=rng):
            r, J = decay(theta, data)
            return r * (1 + 1e-9 * rng.normal(size=len(r))), J

        found = search(function, [5.0, 0.5, 0.0], *FREE)
        assert found.status == DesignStatus.REACHED and found.trials <= exact.trials + 2
        np.testing.assert_allclose(found.theta, exact.theta, rtol=1e-4)
