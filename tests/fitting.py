"""A design, data and a judge for tests of fitting. They are shared: a new design or measure compiles for seconds."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

import jaxbeam as jb

TRUTH = {"young": 1e4, "poisson": 0.4, "tendon": 2e3}
START = {"young": 5e3, "poisson": 0.3, "tendon": 3e3}
LOW, HIGH = {"young": 1.0, "poisson": 0.0, "tendon": 1.0}, {"young": 1e6, "poisson": 0.495, "tendon": 1e6}
NAMES = ["poisson", "tendon", "young"]
SD = np.array([0.005, 0.005, 3.0, 3.0])
ROWS = np.random.default_rng(0).uniform(0.7, 1.1, (10, 2))

# How often `moduli` was traced: once for each program that is compiled with it.
traced = []


def moduli(theta):
    """A small beam of three parameters."""
    if isinstance(theta["young"], jax.core.Tracer):
        traced.append(theta)
    return jb.tendon_beam(7, 3, young=theta["young"], poisson=theta["poisson"], tendon_modulus=theta["tendon"])


def tip_and_tensions(scene, x):
    return jnp.concatenate([jb.tip_position(scene, x), jb.tendon_tensions(scene, x)])


def measured(design, truth, rows, measure):
    """What is measured `(N, ...)` without errors."""
    scene = design(truth)
    found = jb.check(jb.sweep(scene, rows))
    return np.stack([np.asarray(measure(jb.command(scene, row), x)) for row, x in zip(rows, found.x, strict=True)])


def noisy(values, sd, seed=0):
    return values + np.random.default_rng(seed).normal(size=values.shape) * sd


class Judge:
    """Least squares by SciPy: residuals of `equilibrium` from rest alone, and derivatives by differences."""

    def __init__(self, design, measure, names):
        def values(flat, rows):
            scene = design(dict(zip(names, flat, strict=True)))
            # Tighter than by default, for the differences.
            solve = lambda row: jb.equilibrium(jb.command(scene, row), solver=jb.Newton(rtol=1e-13))
            return jax.lax.map(lambda row: jnp.ravel(measure(jb.command(scene, row), solve(row).x)), rows)

        self.values = jax.jit(values)

    def residuals(self, flat, rows, data, sd):
        return np.ravel((np.asarray(self.values(jnp.asarray(flat), rows)) - data) / sd)

    def jacobian(self, flat, *data):
        """Central differences with one extrapolation: their error is of fourth order."""
        columns = []
        for k, size in enumerate(1e-3 * np.abs(flat)):
            change = size * np.eye(len(flat))[k]
            slope = lambda h, change=change, size=size: (
                (self.residuals(flat + h * change, *data) - self.residuals(flat - h * change, *data)) / (2 * h * size)
            )
            columns.append((4 * slope(0.5) - slope(1.0)) / 3)
        return np.stack(columns, axis=1)

    def fit(self, start, *data, low=-np.inf, high=np.inf, more=lambda flat: np.zeros(0)):
        """The parameters `(q,)` of least squares; `more` are residuals of a prior."""
        return optimize.least_squares(
            lambda flat: np.concatenate([self.residuals(flat, *data), more(flat)]),
            start,
            jac="3-point",
            bounds=(low, high),
            x_scale=np.abs(start),
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        ).x
