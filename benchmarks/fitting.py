"""Fits of moduli to measurements: how the time grows with observations and with parameters.

    python -m benchmarks.fitting [--repeats 5]

The data are those of equilibria of the reference scene, with errors of 5 mm in the position of the tip (of a beam of
3.5 m) and 3 in both tensions. Three moduli are fitted to 40, 400 and 4,000 observations; and the modulus of each of 336
triangles to 40, with a prior of 20 %. In turn with the fits: one jump to (0.4, 1.0). One core. The estimates are
compared with the truth.
"""

from __future__ import annotations

import benchmarks.one_thread  # isort: skip # noqa: F401

import os
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from benchmarks import report
from benchmarks.timing import in_turn

SD = np.array([0.005, 0.005, 3.0, 3.0])
TRUTH = {"young": 1e4, "poisson": 0.45, "tendon": 2e3}
START = {"young": 7e3, "poisson": 0.4, "tendon": 2.5e3}
BOUNDS = ({"young": 1.0, "poisson": 0.0, "tendon": 1.0}, {"young": 1e6, "poisson": 0.495, "tendon": 1e6})


def moduli(theta: Any) -> jb.Scene:
    """The reference scene with three moduli."""
    return jb.tendon_beam(young=theta["young"], poisson=theta["poisson"], tendon_modulus=theta["tendon"])


def elements(theta: Any) -> jb.Scene:
    """The reference scene with a modulus for each triangle, given by its logarithm."""
    return jb.tendon_beam(young=1e4 * jnp.exp(theta["log_young"]))


def belief(theta: Any) -> jax.Array:
    """Moduli are known to 20 % beforehand."""
    return theta["log_young"] / 0.2


def measure(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """The position of the tip and the tensions."""
    return jnp.concatenate([jb.tip_position(scene, x), jb.tendon_tensions(scene, x)])


def data(design: Any, truth: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Commands `(count, 2)`, and what is measured there `(count, 4)`."""
    rng = np.random.default_rng(count)
    rows, scene = rng.uniform(0.6, 1.1, (count, 2)), design(truth)
    found = jb.check(jb.sweep(scene, rows))
    values = jax.vmap(lambda row, x: measure(jb.command(scene, row), x))(rows, found.x)
    return rows, np.asarray(values) + rng.normal(size=(count, 4)) * SD


def fits(repeats: int) -> None:
    """Print the times, counts and errors of each fit."""
    rng = np.random.default_rng(0)
    own, start = {"log_young": 0.2 * rng.normal(size=336)}, {"log_young": np.zeros(336)}
    runs = {}
    for count in (40, 400, 4000):
        rows, values = data(moduli, TRUTH, count)
        given = partial(jb.fit, moduli, START, rows, values, measure, sd=SD, bounds=BOUNDS)
        runs[f"3 parameters, {count:,} observations"] = (given, TRUTH)
    rows, values = data(elements, own, 40)
    runs["336 parameters, 40 observations"] = (
        partial(jb.fit, elements, start, rows, values, measure, sd=SD, prior=belief),
        own,
    )
    scene = jb.command(jb.tendon_beam(), [0.4, 1.0])
    results: dict[str, jb.Fit] = {}
    checks = [lambda found, name=name: results.__setitem__(name, found) for name in runs]
    count, os.cpu_count = os.cpu_count, lambda: 1
    try:
        *times, jump = in_turn(
            *(run for run, _ in runs.values()),
            lambda: jb.equilibrium(scene),
            repeats=repeats,
            checks=[*checks, jb.check],
        )
    finally:
        os.cpu_count = count
    lines = []
    for (name, (_, truth)), time in zip(runs.items(), times, strict=True):
        found = results[name]
        off = jax.tree.map(lambda a, b, sd: np.ravel((np.asarray(a) - b) / sd), found.theta, truth, found.errors)
        worst = np.abs(np.concatenate(jax.tree.leaves(off))).max()
        each = 1e3 * time.median / found.solves
        lines.append((name, time.first, time.median, time.over(jump), found.steps, found.solves, each, worst))
    header = ("", "first call, s", "s", "over a jump", "steps", "solves", "ms a solve", "largest error, in errors")
    report.table(header, lines)
    print(f"one jump: {jump}")


def main() -> None:
    """Print the table."""
    parser = report.options(__doc__)
    parser.add_argument("--repeats", type=int, default=5, help="timed calls of each")
    options = parser.parse_args()
    report.head("Fits")
    fits(options.repeats)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
