"""Fits of other bodies, elements, actions and precisions, and past a fold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fitting import HIGH, LOW, NAMES, ROWS, SD, START, TRUTH, Judge, measured, moduli, noisy, tip_and_tensions

import jaxbeam as jb
from jaxbeam.study.design import DesignStatus

numbers = lambda theta, names: np.array([float(theta[name]) for name in names])


def six_nodes(theta):
    """A stubby beam of triangles of six nodes."""
    poisson, tendon = theta["poisson"], theta["tendon"]
    return jb.tendon_beam(5, 3, 2.0, 0.7, young=theta["young"], poisson=poisson, tendon_modulus=tendon, order=2)


def rod(theta):
    return jb.rod_beam(7, young=theta["young"], tendon_modulus=theta["tendon"])


def compressed(theta):
    """A pressure on all sides but the clamped one."""
    mesh = jb.rectangle(2.0, 1.0, 6, 4)
    nodes = np.asarray(mesh.nodes)
    sides = np.flatnonzero((np.abs(nodes[:, 1]) > 0.49) | (nodes[:, 0] > 0.99))
    body = jb.solid(mesh, jb.lame(theta["young"], theta["poisson"]), jb.neo_hookean)
    clamp, tip = np.flatnonzero(nodes[:, 0] < -0.99), np.flatnonzero(nodes[:, 0] > 0.99)
    return jb.Scene(mesh, (body, jb.pressure(mesh, sides)), jb.clamped(mesh, clamp), tip)


def corners(scene, x):
    """The upper and lower corner at the tip."""
    return x[np.asarray(scene.tip)[np.array([0, -1])]].ravel()


def cabled(theta):
    """Cables that go slack."""
    scene = jb.tendon_beam(7, 3, young=theta["young"], poisson=0.4)
    cables = jb.cables(scene.mesh, np.asarray(scene.terms[1].nodes), theta["tendon"])
    return jb.Scene(scene.mesh, (scene.terms[0], cables), scene.held, scene.tip)


SLACK = np.array([[1.0, 1.0], [0.9, 1.0], [0.8, 1.2], [1.2, 0.7], [1.1, 1.1], [1.3, 1.3], [0.7, 1.0]])
PRESSURES = np.linspace(200, 3000, 8)[:, None]
TWO = {"young": 1e4, "tendon": 2e3}
SOLID = {"young": 1e4, "poisson": 0.3}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("design", "truth", "rows", "measure", "sd"),
    [
        (six_nodes, TRUTH, ROWS, tip_and_tensions, SD),
        (rod, TWO, ROWS, tip_and_tensions, SD),
        (compressed, SOLID, PRESSURES, corners, np.full(4, 0.002)),
        (cabled, TWO, SLACK, tip_and_tensions, SD),
    ],
)
def test_other_bodies_and_actions(design, truth, rows, measure, sd):
    """Those of SciPy, from a start that is off by a half; the truth is within four standard errors."""
    names, start = sorted(truth), {name: value / 1.5 for name, value in truth.items()}
    data = noisy(measured(design, truth, rows, measure), sd)
    found = jb.fit(design, start, rows, data, measure, sd=sd)
    theirs = Judge(design, measure, names).fit(numbers(start, names), rows, data, sd)
    assert found.status == DesignStatus.REACHED and found.not_determined == []
    np.testing.assert_allclose(numbers(found.theta, names), theirs, rtol=1e-6)
    off = (numbers(found.theta, names) - numbers(truth, names)) / numbers(found.errors, names)
    assert np.abs(off).max() < 4


def test_slack_cables_determine_nothing():
    data = noisy(measured(cabled, TWO, np.full((4, 2), 1.3), tip_and_tensions), SD)
    found = jb.fit(cabled, {"young": 8e3, "tendon": 3e3}, np.full((4, 2), 1.3), data, tip_and_tensions, sd=SD)
    assert found.not_determined == ["tendon is not determined", "young is not determined"]
    assert found.theta == {"young": 8e3, "tendon": 3e3} and found.degrees_of_freedom == 16
    assert np.isinf(jb.predict(found, [[0.8, 1.0]], tip_and_tensions).errors).all()
    told = jb.next_experiment(found, [[1.3, 1.3], [0.8, 1.0]], "young")
    assert told.best == 1 and np.isnan(told.errors[0]).all() and np.isfinite(told.errors[1]).all()


def single(theta):
    return jb.tendon_beam(
        7, 3, young=theta["young"], poisson=theta["poisson"], tendon_modulus=theta["tendon"], dtype=np.float32
    )


@pytest.mark.slow
def test_single_precision():
    """The same as in double precision, to what float32 leaves; a ratio is still seen to be one."""
    data = noisy(measured(moduli, TRUTH, ROWS, tip_and_tensions), SD)
    double = jb.fit(moduli, START, ROWS, data, tip_and_tensions, sd=SD)
    found = jb.fit(single, START, ROWS, data, tip_and_tensions, sd=SD)
    assert found.x.dtype == np.float32 and found.status == DesignStatus.REACHED and found.steps < 20
    off = (numbers(found.theta, NAMES) - numbers(double.theta, NAMES)) / numbers(double.errors, NAMES)
    assert np.abs(off).max() < 0.02
    np.testing.assert_allclose(numbers(found.errors, NAMES), numbers(double.errors, NAMES), rtol=0.02)
    positions = jb.fit(single, START, ROWS, data[:, :2], jb.tip_position, sd=SD[:2], bounds=(LOW, HIGH))
    assert positions.not_determined == ["tendon and young only as a ratio"]


def reference(theta):
    """The reference beam, which folds and jumps aside where both tendons are pulled to 0.41."""
    poisson, tendon = theta["poisson"], theta["tendon"]
    return jb.tendon_beam(young=theta["young"], poisson=poisson, tendon_modulus=tendon)


FOLDING = np.array([[0.45, 0.45], [0.42, 0.42], [0.405, 0.405], [0.5, 0.5], [0.8, 1.0], [1.0, 0.7]])


@pytest.mark.slow
def test_past_a_fold():
    """One observation lies past the fold. Of other parameters it has no equilibrium: such steps are not taken."""
    truth = {"young": 1e4, "poisson": 0.45, "tendon": 2e3}
    data = noisy(measured(reference, truth, FOLDING, tip_and_tensions), SD)
    fit = lambda start, which=slice(None): jb.fit(
        reference, start, FOLDING[which], data[which], tip_and_tensions, sd=SD, bounds=(LOW, HIGH)
    )
    near = fit(truth | {"young": 1.05e4})
    assert near.status == DesignStatus.REACHED and near.blocked[2] > 0 and near.blocked.sum() == near.blocked[2]
    off = (numbers(near.theta, NAMES) - numbers(truth, NAMES)) / numbers(near.errors, NAMES)
    assert np.abs(off).max() < 4 and "not converged" not in str(near)
    # From further away the search stops where that observation ends it. It says so, and its cure works.
    start = {"young": 1.3e4, "poisson": 0.4, "tendon": 2e3}
    stopped = fit(start)
    assert stopped.status == DesignStatus.NOT_CONVERGED and np.argmax(stopped.blocked) == 2
    printed = str(stopped)
    assert "+-" not in printed and "no equilibrium for what was tried: observation 2 (" in printed
    again = fit(fit(start, np.array([0, 1, 3, 4, 5])).theta)
    np.testing.assert_allclose(numbers(again.theta, NAMES), numbers(near.theta, NAMES), rtol=1e-6)


def elements(theta):
    return jb.tendon_beam(7, 3, young=1e4 * jnp.exp(theta["log_young"]))


@pytest.mark.slow
def test_more_parameters_than_data():
    """A modulus of each triangle, with a prior: the linear Bayesian estimate about the minimum, from differences."""
    rows, prior = ROWS[:4], lambda theta: theta["log_young"] / 0.2
    truth = {"log_young": 0.2 * np.random.default_rng(5).normal(size=24)}
    data = noisy(measured(elements, truth, rows, tip_and_tensions), SD)
    found = jb.fit(elements, {"log_young": np.zeros(24)}, rows, data, tip_and_tensions, sd=SD, prior=prior)
    assert found.status == DesignStatus.REACHED and found.not_determined == []
    assert found.degrees_of_freedom == data.size + 24 - 24

    def residuals(log_young):
        scene = elements({"log_young": log_young})
        solve = lambda row: jb.equilibrium(jb.command(scene, row), solver=jb.Newton(rtol=1e-13)).x
        values = jax.lax.map(lambda row: tip_and_tensions(jb.command(scene, row), solve(row)), rows)
        return jnp.concatenate([jnp.ravel((values - data) / SD), log_young / 0.2])

    residuals, theta, h = jax.jit(residuals), np.asarray(found.theta["log_young"]), 1e-4
    J = np.stack([(residuals(theta + h * e) - residuals(theta - h * e)) / (2 * h) for e in np.eye(24)], axis=1)
    # At a minimum nothing is left to gain: the gradient, in units of the errors.
    covariance = np.linalg.inv(J.T @ J)
    errors = np.sqrt(np.diag(covariance))
    assert np.abs(covariance @ (J.T @ np.asarray(residuals(theta)))).max() < 1e-4 * errors.min()
    np.testing.assert_allclose(found.errors["log_young"], errors, rtol=1e-5)
    assert (errors < 0.2).all() and errors.min() < 0.15
