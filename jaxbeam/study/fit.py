"""Fitting a design to measurements: least squares, what the data determine, and what they do not.

`fit` finds the parameters of a design, such as moduli and rest lengths, at which its equilibria come nearest to what
was measured. Then `predict` tells a measure under new commands with its standard error, and `next_experiment` which
commands are best measured next (`jaxbeam.study.experiments`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.progress import Progress, Report, check_progress
from jaxbeam.core.tree import Numbers
from jaxbeam.scene.rigid import check_held
from jaxbeam.scene.scene import Scene
from jaxbeam.solve.newton import Newton, check_scene_and_solver
from jaxbeam.solve.solution import EquilibriumError, Solution, check
from jaxbeam.solve.sweep import sweep
from jaxbeam.study.design import DesignStatus
from jaxbeam.study.expansion import Measure
from jaxbeam.study.fit_data import bounds_of, data_of, parameters_of
from jaxbeam.study.known import ROUNDED, Known, scales_of, what_is_known
from jaxbeam.study.least_squares import Residuals, least_squares
from jaxbeam.study.observing import Design, Model, Predicted, model_of, predict_all
from jaxbeam.study.outliers import outliers

# Normal standard deviations beyond which a sum of squares is not called chance.
CHANCE = 3.5

Prior = Callable[[Any], jax.Array]


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """A design fitted to `N` observations of `p` components, with `q` parameters.

    theta: the parameters.
    errors: standard error of each, in the same structure; NaN where the data do not determine it, or a bound holds it.
        One that a bound holds is taken as exact for the errors of the others.
    not_determined: what the data do not determine, in words; empty if they determine all.
    correlations: `(q, q)` of the parameters, in the order of `names`.
    singular_values: of the scaled Jacobian: by how many standard deviations the residuals change when a combination of
        parameters changes by all of its magnitude (see `jaxbeam.study.known`).
    names: of the parameters, such as `young` or `young[3]`.
    values: `(N, p)` predictions.
    residuals: `(N, p)` predictions minus measurements, over their standard deviations; 0 for missing values.
    outliers: `(k, 2)` observation and component of residuals that are too large to be chance, the largest first. A
        huge one bends the fit so far that others look wrong: leave it out (infinite `sd`), and fit again.
    reduced_chi_square: sum of squared residuals over the degrees of freedom; near 1 if the model is right and the
        standard deviations are. If these are not known it is the variance of a measurement.
    degrees_of_freedom: number of data and priors less that of parameters that are determined.
    held: `(q,)` -1 or 1 where the lower or upper bound holds a parameter, else 0.
    blocked: `(N,)` for how many of the parameter sets tried an observation had no equilibrium that is `OK`. Where that
        stops a search, fit without these observations first, and start from what that finds.
    steps: number of parameter sets tried.
    solves: number of equilibria solved.
    status: `REACHED` at a minimum, else `NOT_CONVERGED`.
    x: `(N, n, d)` equilibria.
    """

    theta: Any
    errors: Any
    not_determined: list[str]
    correlations: np.ndarray
    singular_values: np.ndarray
    names: list[str]
    values: np.ndarray
    residuals: np.ndarray
    outliers: np.ndarray
    reduced_chi_square: float
    degrees_of_freedom: int
    held: np.ndarray
    blocked: np.ndarray
    steps: int
    solves: int
    status: DesignStatus
    x: np.ndarray
    basis: Basis = dataclasses.field(repr=False)

    def __str__(self) -> str:
        flat, errors = (np.ravel(ravel_pytree(tree)[0]) for tree in (self.theta, self.errors))
        width = max(map(len, self.names))
        lines = [f"Fit: {self.status.name} in {self.steps} steps, {self.solves} solves"]
        for name, value, error, held in zip(self.names[:12], flat, errors, self.held, strict=False):
            known = f"+- {error:.3g}" if np.isfinite(error) else "held at its bound" if held else "not determined"
            known = "not converged" if self.status else known
            lines.append(f"{name:<{width}}  {_as_exact(value, error)} {known}")
        if len(self.names) > 12:
            lines.append(f"... and {len(self.names) - 12} other parameters")
        lines += [f"not determined: {words}" for words in self.not_determined]
        lines.append(
            f"reduced chi-square {self.reduced_chi_square:.4g} of {self.degrees_of_freedom} degrees of freedom"
            + _judged(self.reduced_chi_square, self.degrees_of_freedom) * self.basis.known_sd
        )
        if len(self.outliers):
            each = ", ".join(f"{k} (component {j}, {self.residuals[k, j]:+.3g})" for k, j in self.outliers[:8].tolist())
            lines.append(f"outliers: observation {each}" + ", ..." * (len(self.outliers) > 8))
        if self.status and self.blocked.any():
            stuck = np.argsort(-self.blocked, kind="stable")[: min(8, np.count_nonzero(self.blocked))]
            each = ", ".join(f"{k} ({self.blocked[k]} times)" for k in stuck)
            lines.append(f"no equilibrium for what was tried: observation {each}; fit without, and start from that")
        return "\n  ".join(lines)


def _as_exact(value: float, error: float) -> str:
    """A value to the digits of its error, which has three; to four digits if there is no error."""
    if not (np.isfinite(error) and error > 0 and value != 0):
        return f"{value:.4g}"
    digits = int(np.floor(np.log10(abs(value))) - np.floor(np.log10(error))) + 3
    return f"{value:#.{min(max(digits, 3), 15)}g}".rstrip(".")


@dataclasses.dataclass(frozen=True, eq=False)
class Basis:
    """What a fit was made of, for predictions from it.

    model: the design.
    measure: of the observations.
    sd: `(p,)` median standard deviations of the components, infinite for one that was not measured.
    flat: `(q,)` parameters.
    jacobian: `(r, q)` of all residuals, priors included.
    scales, free, positive, variance: as in `what_is_known`.
    known_sd: whether standard deviations were given.
    known: what is known of the parameters.
    """

    model: Model
    measure: Measure
    sd: np.ndarray
    flat: np.ndarray
    jacobian: np.ndarray
    scales: np.ndarray
    free: np.ndarray
    positive: np.ndarray
    variance: float
    known_sd: bool
    known: Known


def _judged(reduced_chi_square: float, freedom: int) -> str:
    """What its size tells, in words, where it is too far from 1 to be chance (Wilson and Hilferty 1931)."""
    if freedom <= 0:
        return ""
    spread = 2 / (9 * freedom)
    away = (reduced_chi_square ** (1 / 3) - (1 - spread)) / spread**0.5
    if away > CHANCE:
        return ": too large for chance, so the model is wrong, or values or sd are, and errors are too small"
    return ": too small for chance, so sd is too large, and errors are too" if away < -CHANCE else ""


@usual_rules
def fit(
    design: Design,
    theta0: Any,
    commands: Numbers,
    values: Numbers,
    measure: Measure,
    *,
    sd: Numbers | None = None,
    bounds: tuple[Any, Any] | None = None,
    prior: Prior | None = None,
    max_steps: int = 50,
    solver: Newton = Newton(),
    progress: Progress = None,
) -> Fit:
    """The parameters of a design at which its equilibria come nearest to what was measured.

    The sum of squares of `(measure - value) / sd` over all observations, and of the residuals of the prior, is
    minimised (see `jaxbeam.study.least_squares`). Jacobians are exact, by the implicit derivative. Each observation is
    continued from its last state. The search goes downhill from `theta0`: start from a guess of the right magnitude.

    Args:
        design: `theta` to a scene; its commands are replaced by those of each observation.
        theta0: parameters to start from, any pytree of floats. A dict gives them names: `{"young": 1e4}`. Start one
            that may be zero, such as an offset, at zero.
        commands: `(N, m)` a row for each observation.
        values: `(N,)` or `(N, p)` what was measured there.
        measure: `(scene, x)` to `()` or `(p,)`: what was measured, such as `tip_position`, or markers and tensions in
            one array; a function at module level.
        sd: standard deviations of the values: `()`, `(p,)` or `(N, p)`, infinite for a value that is missing. If they
            are not known, all are taken alike, and the residuals tell their size; a prior needs them.
        bounds: lowest and highest parameters, each as `theta0` or as one number.
        prior: `theta` to `(k,)`: residuals of what is known beforehand, over their standard deviations, such as
            `lambda theta: (theta["poisson"] - 0.45) / 0.02`.
        max_steps: the most parameter sets to try.
        solver: settings of each solve.
        progress: `True` draws a line of progress on stderr, if that is a terminal. A function is called after each
            step, as `progress(steps, sum_of_squares)`.

    Returns:
        A `Fit`, which `print` shows. It holds no error for a parameter that the data do not determine, and says in
        `not_determined` which those are. Errors are those of the linearised model, without that of the mesh.

    Raises:
        ValueError: if a shape is wrong, a value is not finite, an `sd` is not positive, commands are out of range,
            `theta0` is not within the bounds, the measure or the prior has no derivative there, there are fewer data
            than parameters and no prior, or no more and no `sd`.
        EquilibriumError: if an observation has no equilibrium that is `OK` at `theta0`. It names the observations.
    """
    checks.function("design", design, "(theta) -> scene")
    checks.function("measure", measure, "(scene, x) to shape () or (p,)")
    checks.count("max_steps", max_steps, 1)
    check_progress(progress, "(steps, sum_of_squares)")
    start, unravel, names = parameters_of(theta0)
    low, high = bounds_of(bounds, theta0, start, names)
    scene = design(unravel(jnp.asarray(start)))
    check_scene_and_solver(scene, solver)
    check_held(scene)
    rows, data, deviations = data_of(scene, commands, values, measure, sd)
    count = int(np.isfinite(deviations).sum())
    if sd is None and prior is not None:
        raise ValueError(
            "sd: expected standard deviations beside a prior, got None; give them, so that both have weights"
        )
    if sd is None and count <= len(start):
        raise ValueError(
            f"values: expected more than parameters, {len(start)}, got {count}: nothing tells their error; measure "
            f"more, fit fewer parameters, or give sd"
        )
    if count < len(start) and prior is None:
        raise ValueError(
            f"values: expected at least as many as parameters, {len(start)}, got {count}; measure more, fit fewer "
            f"parameters, or give a prior"
        )
    model, beliefs = model_of(design, unravel, start, solver), _beliefs(prior, unravel)
    solves, blocked = 0, np.zeros(len(rows), int)
    with Report(progress, f"steps of at most {max_steps}") as report:
        first = _first_states(scene, rows, solver)

        def residuals(flat: np.ndarray, before: Residuals | None) -> Residuals | None:
            nonlocal solves, blocked
            found = predict_all(model, flat, rows, first.x if before is None else before.other.x, measure)
            solves, blocked = solves + len(rows), blocked + (found.status != 0)
            here = _residuals(found, data, deviations, *beliefs(flat))
            if before is None:
                _check_start(here, names)
            return here if _is_good(here) else None

        tell = lambda steps, cost: report(steps, f"sum of squares {cost:.4e}", (steps, cost))
        ended = least_squares(residuals, start, low, high, max_steps, tell)
    known_sd = sd is not None
    return _fit(ended, model, measure, deviations, known_sd, start, names, unravel, solves, blocked)


def _first_states(scene: Scene, rows: np.ndarray, solver: Newton) -> Solution:
    """The equilibria of all observations at `theta0`."""
    try:
        return check(sweep(scene, rows, solver=solver))
    except EquilibriumError as error:
        raise EquilibriumError(
            f"{error}\nThese are observations at theta0: start from other parameters, or leave them out."
        ) from None


def _beliefs(prior: Prior | None, unravel: Callable[[jax.Array], Any]) -> Callable[[np.ndarray], tuple[Any, Any]]:
    """From parameters `(q,)` the residuals `(k,)` of the prior and their Jacobian `(k, q)`."""
    if prior is None:
        return lambda flat: (np.zeros(0), np.zeros((0, len(flat))))
    checks.function("prior", prior, "(theta) to shape () or (k,)")
    values = jax.jit(lambda flat: jnp.ravel(jnp.asarray(prior(unravel(flat)))))
    slopes = jax.jit(jax.jacfwd(values))
    return lambda flat: (np.asarray(values(jnp.asarray(flat))), np.asarray(slopes(jnp.asarray(flat))))


# --------------------------------------------------------------------------------------------------- residuals


def _residuals(found: Predicted, data: np.ndarray, sd: np.ndarray, prior: np.ndarray, slopes: np.ndarray) -> Residuals:
    """All residuals over their standard deviations, those of the prior last."""
    misses = ((found.values - data) / sd).ravel()
    jacobian = (found.slopes / sd[..., None]).reshape(len(misses), -1)
    return Residuals(np.concatenate([misses, prior]), np.concatenate([jacobian, slopes]), found)


def _is_good(here: Residuals) -> bool:
    """Whether all equilibria are `OK`, and all residuals and their derivatives finite."""
    return bool(not here.other.status.any() and np.isfinite(here.values).all() and np.isfinite(here.jacobian).all())


def _check_start(here: Residuals, names: list[str]) -> None:
    """Refuse a start that a search cannot leave."""
    if _is_good(here):
        return
    found, size = here.other, here.other.values.size
    bad = ~(np.isfinite(found.values).all(axis=1) & np.isfinite(found.slopes).all(axis=(1, 2)))
    if bad.any():
        k = int(np.argmax(bad))
        slopes = np.where(np.isfinite(found.slopes[k]).all(axis=0), "", names)
        raise ValueError(
            f"measure: expected finite values and derivatives at theta0, got {found.values[k].tolist()} for "
            f"observation {k}, with no derivative by {', '.join(slopes[slopes != '']) or 'none'}; a square root or a "
            f"norm has none at zero"
        )
    raise ValueError(f"prior: expected finite residuals and derivatives at theta0, got {here.values[size:].tolist()}")


def _fit(
    ended: Any,
    model: Model,
    measure: Measure,
    sd: np.ndarray,
    known_sd: bool,
    start: np.ndarray,
    names: list[str],
    unravel: Callable[[jax.Array], Any],
    solves: int,
    blocked: np.ndarray,
) -> Fit:
    """The report of a search."""
    here, found, free = ended.here, ended.here.other, ended.held == 0
    positive = (ended.theta > 0) & (start > 0)
    scales = scales_of(ended.theta, start, here.jacobian)
    count = int(np.isfinite(sd).sum()) + len(here.values) - sd.size
    rank = int(np.linalg.matrix_rank(here.jacobian[:, free] * scales[free], rtol=ROUNDED)) if free.any() else 0
    freedom = count - rank
    chi_square = here.cost / freedom if freedom > 0 else np.nan
    variance = 1.0 if known_sd or not chi_square > 0 else chi_square
    # A bound that holds what the data do not determine is no knowledge of it, and lends none to the others.
    unbound = what_is_known(here.jacobian, scales, np.ones(len(free), bool), positive, names, variance)
    free |= np.isnan(unbound.errors)
    known = what_is_known(here.jacobian, scales, free, positive, names, variance)
    residuals = here.values[: sd.size].reshape(sd.shape)
    typical = [np.median(part[np.isfinite(part)]) if np.isfinite(part).any() else np.inf for part in sd.T]
    basis = Basis(
        model,
        measure,
        np.array(typical),
        ended.theta,
        here.jacobian,
        scales,
        free,
        positive,
        variance,
        known_sd,
        known,
    )
    return Fit(
        theta=unravel(jnp.asarray(ended.theta)),
        errors=jax.tree.map(np.asarray, unravel(jnp.asarray(known.errors))),
        not_determined=known.words,
        correlations=known.correlations,
        singular_values=known.singular_values,
        names=names,
        values=found.values,
        residuals=residuals,
        outliers=_outliers(here, scales * free, sd, known_sd),
        reduced_chi_square=float(chi_square),
        degrees_of_freedom=freedom,
        held=ended.held,
        blocked=blocked,
        steps=ended.trials,
        solves=solves,
        status=ended.status,
        x=found.x,
        basis=basis,
    )


def _outliers(here: Residuals, scales: np.ndarray, sd: np.ndarray, known_sd: bool) -> np.ndarray:
    """Observation and component `(k, 2)` of residuals that are too large to be chance, the largest first."""
    found, count = here.other, np.zeros(len(here.values), bool)
    count[: sd.size] = np.isfinite(sd).ravel()
    least = np.zeros(len(here.values))
    least[: sd.size] = (np.sqrt(np.finfo(found.x.dtype).eps) * np.abs(found.values).max(axis=0) / sd).ravel()
    named = outliers(here.values, here.jacobian * scales, count, least, known_sd)
    return np.stack(np.unravel_index(named, sd.shape), axis=1)
