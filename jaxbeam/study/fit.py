"""Fitting a design to measurements: least squares, what the data determine, and what they do not.

`fit` finds the parameters of a design, such as moduli and rest lengths, at which its equilibria come nearest to what
was measured. Then `predict` tells a measure under new commands with its standard error, and `next_experiment` which
commands are best measured next (`jaxbeam.study.experiments`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from statistics import NormalDist
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
from jaxbeam.scene.scene import Scene, check_commands, command_count
from jaxbeam.solve.newton import Newton, check_scene_and_solver
from jaxbeam.solve.solution import check
from jaxbeam.solve.sweep import sweep
from jaxbeam.study.design import DesignStatus
from jaxbeam.study.expansion import Measure
from jaxbeam.study.known import Known, scales_of, what_is_known
from jaxbeam.study.least_squares import Residuals, least_squares
from jaxbeam.study.observing import Design, Model, Predicted, model_of, predict_all

# Probability that of good residuals none is called an outlier.
SURE = 0.99
# The median of the magnitude of a normal variable of unit variance.
MEDIAN = 0.6745

Prior = Callable[[Any], jax.Array]


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """A design fitted to `N` observations of `p` components, with `q` parameters.

    theta: the parameters.
    errors: standard error of each, in the same structure; NaN where the data do not determine it, or a bound holds it.
    not_determined: what the data do not determine, in words; empty if they determine all.
    correlations: `(q, q)` of the parameters, in the order of `names`.
    singular_values: of the scaled Jacobian: by how many standard deviations the residuals change when a combination of
        parameters changes by all of its magnitude (see `jaxbeam.study.known`).
    names: of the parameters, such as `young` or `young[3]`.
    values: `(N, p)` predictions.
    residuals: `(N, p)` predictions minus measurements, over their standard deviations; 0 for missing values.
    outliers: `(k, 2)` observation and component of residuals that are too large to be chance.
    reduced_chi_square: sum of squared residuals over the degrees of freedom; near 1 if the model is right and the
        standard deviations are. If these are not known it is the variance of a measurement.
    degrees_of_freedom: number of data and priors less that of parameters that are determined.
    held: `(q,)` -1 or 1 where the lower or upper bound holds a parameter, else 0.
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
            lines.append(f"{name:<{width}}  {value:.8g} {known}")
        if len(self.names) > 12:
            lines.append(f"... and {len(self.names) - 12} other parameters")
        lines += [f"not determined: {words}" for words in self.not_determined]
        lines.append(
            f"reduced chi-square {self.reduced_chi_square:.4g} of {self.degrees_of_freedom} degrees of freedom"
        )
        if len(self.outliers):
            each = ", ".join(f"{k} (component {j}, {self.residuals[k, j]:+.3g})" for k, j in self.outliers[:8].tolist())
            lines.append(f"outliers: observation {each}" + ", ..." * (len(self.outliers) > 8))
        return "\n  ".join(lines)


@dataclasses.dataclass(frozen=True, eq=False)
class Basis:
    """What a fit was made of, for predictions from it.

    model: the design.
    measure: of the observations.
    sd: `(p,)` median standard deviations of the components, infinite for one that was not measured.
    flat: `(q,)` parameters.
    jacobian: `(r, q)` of all residuals, priors included.
    scales, free, positive, variance: as in `what_is_known`.
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
    known: Known


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
        theta0: parameters to start from, any pytree of floats. A dict gives them names: `{"young": 1e4}`.
        commands: `(N, m)` a row for each observation.
        values: `(N,)` or `(N, p)` what was measured there.
        measure: `(scene, x)` to `()` or `(p,)`: what was measured, such as `tip_position`, or markers and tensions in
            one array; a function at module level.
        sd: standard deviations of the values: `()`, `(p,)` or `(N, p)`, infinite for a value that is missing. If they
            are not known, all are taken alike, and the residuals tell their size.
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
            `theta0` is not within the bounds, or there are fewer data than parameters and no prior.
        EquilibriumError: if an observation has no equilibrium that is `OK` at `theta0`. It names the observations.
    """
    checks.function("design", design, "(theta) -> scene")
    checks.function("measure", measure, "(scene, x) to shape () or (p,)")
    checks.count("max_steps", max_steps, 1)
    check_progress(progress, "(steps, sum_of_squares)")
    start, unravel, names = _parameters(theta0)
    low, high = _bounds(bounds, theta0, start, names)
    scene = design(unravel(jnp.asarray(start)))
    check_scene_and_solver(scene, solver)
    check_held(scene)
    rows, data, deviations = _data(scene, commands, values, measure, sd)
    if data.size - np.isinf(deviations).sum() < len(start) and prior is None:
        raise ValueError(
            f"values: expected at least as many as parameters, {len(start)}, got {np.isfinite(deviations).sum()}; "
            f"measure more, fit fewer parameters, or give a prior"
        )
    model, beliefs = model_of(design, unravel, start, solver), _beliefs(prior, unravel)
    solves = 0
    with Report(progress, f"steps of at most {max_steps}") as report:
        first = check(sweep(scene, rows, solver=solver))

        def residuals(flat: np.ndarray, before: Residuals | None) -> Residuals | None:
            nonlocal solves
            found = predict_all(model, flat, rows, first.x if before is None else before.other.x, measure)
            solves += len(rows)
            return None if found.status.any() else _residuals(found, data, deviations, *beliefs(flat))

        tell = lambda steps, cost: report(steps, f"sum of squares {cost:.4e}", (steps, cost))
        ended = least_squares(residuals, start, low, high, max_steps, tell)
    known_sd = sd is not None
    return _fit(ended, model, measure, deviations, known_sd, start, names, unravel, solves)


# -------------------------------------------------------------------------------------------------- arguments


def _parameters(theta0: Any) -> tuple[np.ndarray, Callable[[jax.Array], Any], list[str]]:
    """Flat parameters `(q,)`, their way back, and their names."""
    leaves = jax.tree_util.tree_leaves_with_path(theta0)
    if not leaves:
        raise ValueError(f"theta0: expected a pytree of floats, got {theta0!r}")
    names = []
    for path, leaf in leaves:
        array = checks.numbers("theta0" + jax.tree_util.keystr(path), leaf)
        word = (
            ".".join(str(getattr(key, "key", getattr(key, "name", getattr(key, "idx", key)))) for key in path)
            or "theta"
        )
        names += [word] if array.ndim == 0 else [f"{word}{list(place)}" for place in np.ndindex(array.shape)]
    flat, unravel = ravel_pytree(jax.tree.map(lambda leaf: jnp.asarray(leaf, float), theta0))
    return np.asarray(flat, float), unravel, names


def _bounds(
    bounds: tuple[Any, Any] | None, theta0: Any, start: np.ndarray, names: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest parameters `(q,)`."""
    if bounds is None:
        return np.full(len(start), -np.inf), np.full(len(start), np.inf)
    if not isinstance(bounds, tuple | list) or len(bounds) != 2:
        raise ValueError(f"bounds: expected (low, high), each as theta0 or one number, got {bounds!r}")
    ends = []
    for name, end in zip(("low", "high"), bounds, strict=True):
        try:
            whole = end if np.ndim(end) == 0 and not isinstance(end, dict) else None
            flat = np.full(len(start), whole, float) if whole is not None else np.asarray(ravel_pytree(end)[0], float)
        except (TypeError, ValueError):
            flat = np.zeros(0)
        same = whole is not None or str(jax.tree.structure(end)) == str(jax.tree.structure(theta0))
        if len(flat) != len(start) or not same:
            raise ValueError(f"bounds, {name}: expected the structure of theta0, or one number, got {end!r}")
        ends.append(flat)
    low, high = ends
    bad = np.flatnonzero(~((low <= start) & (start <= high)))
    if bad.size:
        k = bad[0]
        raise ValueError(
            f"bounds: expected low <= theta0 <= high, got {low[k]:g}, {start[k]:g}, {high[k]:g} of {names[k]}"
        )
    return low, high


def _data(
    scene: Scene, commands: Any, values: Any, measure: Measure, sd: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Commands `(N, m)`, values `(N, p)` and standard deviations `(N, p)`, checked."""
    rows, data, m = checks.real("commands", commands), checks.real("values", values), command_count(scene)
    if rows.ndim != 2 or rows.shape[1] != m or not len(rows):
        raise ValueError(f"commands: expected shape (N, {m}), a row for each observation, got {rows.shape}")
    shape = jax.eval_shape(measure, scene, scene.mesh.nodes).shape
    if len(shape) > 1:
        raise ValueError(f"measure: expected a function (scene, x) to shape () or (p,), got shape {shape}")
    if data.shape != (len(rows), *shape):
        raise ValueError(
            f"values: expected shape {(len(rows), *shape)}, what the measure gives for each of the commands, got "
            f"{data.shape}"
        )
    data = data.reshape(len(rows), -1).astype(float)
    for name, array in (("commands", rows), ("values", data)):
        bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
        if bad.size:
            others = f", and {bad.size - 1} others are not" if bad.size > 1 else ""
            raise ValueError(
                f"{name}: observation {bad[0]} is not finite, {array[bad[0]].tolist()}{others}; leave such rows out, "
                f"or where one value of a row is missing, put 0 there and infinity in sd"
            )
    check_commands("commands", scene, rows)
    deviations = checks.real("sd", 1.0 if sd is None else sd)
    if deviations.shape not in {(), shape, (len(rows), *shape)}:
        raise ValueError(f"sd: expected shape (), {shape} or {(len(rows), *shape)}, got {deviations.shape}")
    deviations = np.broadcast_to(deviations, (len(rows), *shape)).reshape(data.shape)
    if not (deviations > 0).all():
        k, j = np.argwhere(~(deviations > 0))[0]
        raise ValueError(f"sd: expected positive numbers, got {deviations[k, j]} for observation {k}, component {j}")
    return rows.astype(float), data, deviations.astype(float)


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
) -> Fit:
    """The report of a search."""
    here, found, free = ended.here, ended.here.other, ended.held == 0
    positive = (ended.theta > 0) & (start > 0)
    scales = scales_of(ended.theta, start, here.jacobian)
    count = int(np.isfinite(sd).sum()) + len(here.values) - sd.size
    rank = int(np.linalg.matrix_rank(here.jacobian[:, free] * scales[free])) if free.any() else 0
    freedom = count - rank
    chi_square = here.cost / freedom if freedom > 0 else np.nan
    variance = 1.0 if known_sd or not chi_square > 0 else chi_square
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
        outliers=_outliers(here, scales * free, np.isfinite(sd), known_sd),
        reduced_chi_square=float(chi_square),
        degrees_of_freedom=freedom,
        held=ended.held,
        steps=ended.trials,
        solves=solves,
        status=ended.status,
        x=found.x,
        basis=basis,
    )


def _outliers(here: Residuals, scales: np.ndarray, present: np.ndarray, known_sd: bool) -> np.ndarray:
    """Observation and component `(k, 2)` of residuals that are too large to be chance, the largest first.

    A residual is divided by its own standard deviation, which the fit makes smaller: `sqrt(1 - h)`, with `h` the
    diagonal of the hat matrix (Cook and Weisberg 1982). If standard deviations are not known, their size is taken from
    the median of the magnitudes, which outliers hardly change.
    """
    data = here.values[: present.size]
    u, sizes, _ = np.linalg.svd(here.jacobian * scales, full_matrices=False)
    hat = np.sum(u[: present.size, sizes > 1e-9 * sizes.max(initial=0)] ** 2, axis=1)
    own = np.abs(data) / np.sqrt(np.maximum(1 - hat, 1e-6))
    there = present.ravel()
    size = 1.0 if known_sd else float(np.median(own[there])) / MEDIAN
    limit = NormalDist().inv_cdf(1 - (1 - SURE) / (2 * there.sum()))
    large = np.flatnonzero(there & (own > limit * size)) if size > 0 else np.zeros(0, int)
    large = large[np.argsort(-own[large])]
    return np.stack(np.unravel_index(large, present.shape), axis=1)
