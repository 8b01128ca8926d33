"""What a fit is good for: predictions with their errors, and the experiment that is best done next.

Both linearise the model about the fitted parameters. A prediction has the variance `g C g^T`, with `g` its derivatives
by the parameters and `C` their covariance (the delta method). A new experiment adds its rows to the Jacobian, so what
would be known after it is known before it is done (Atkinson, Donev and Tobias 2007, Optimum Experimental Designs, ch. 9
and 17).
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers
from jaxbeam.scene.scene import Scene, check_commands, command, command_count
from jaxbeam.solve.equilibrium import equilibrium
from jaxbeam.solve.solution import check
from jaxbeam.solve.sweep import sweep
from jaxbeam.study.accuracy import estimate_error
from jaxbeam.study.expansion import Measure
from jaxbeam.study.fit import Fit
from jaxbeam.study.known import is_hidden, what_is_known
from jaxbeam.study.observing import Predicted, predict_all


@dataclasses.dataclass(frozen=True, eq=False)
class Prediction:
    """A measure of `p` components under `K` commands, as a fit predicts it.

    values: `(K, p)`, or `(K,)` of a measure that is a scalar.
    errors: standard errors from those of the parameters, in the same shape; infinite where the prediction depends on
        what the data did not determine.
    bars: error bars of the mesh from `estimate_error`, in the same shape; None if they were not asked for.
    """

    values: np.ndarray
    errors: np.ndarray
    bars: np.ndarray | None


@usual_rules
def predict(fitted: Fit, commands: Numbers, measure: Measure, *, bars: bool = False) -> Prediction:
    """A measure under new commands, with its standard error.

    The error is that of the parameters alone: not that of a measurement, which adds its own variance, and not that of
    the model. A parameter that a bound holds is taken as exact. `bars=True` tells the error of the mesh.

    Args:
        fitted: from `fit`.
        commands: `(K, m)`.
        measure: `(scene, x)` to `()` or `(p,)`; any, not only what was measured.
        bars: whether to estimate the error of the mesh too, which compiles once and solves each state again.

    Raises:
        ValueError: if commands are of another shape or out of range, or `measure` is no function.
        EquilibriumError: if a command has no equilibrium that is `OK`.
    """
    checks.instance("fitted", fitted, Fit, "give what fit returned")
    rows, found = _solved("commands", fitted, commands, measure)
    known, basis = fitted.basis.known, fitted.basis
    scene = basis.model.scene(jnp.asarray(basis.flat))
    shape = (len(rows), *jax.eval_shape(measure, scene, scene.mesh.nodes).shape)
    variances = np.einsum("kpi,ij,kpj->kp", found.slopes, known.covariance, found.slopes)
    hidden = is_hidden(found.slopes * basis.scales, known.singular_values, known.directions)
    errors = np.where(hidden, np.inf, np.sqrt(variances))
    told = None
    if bars:
        parts = [Component(measure, j) for j in range(found.values.shape[1])]
        told = np.array([_bars(command(scene, row), x, parts) for row, x in zip(rows, found.x, strict=True)])
        told = told.reshape(shape)
    return Prediction(found.values.reshape(shape), errors.reshape(shape), told)


@dataclasses.dataclass(frozen=True)
class Component:
    """One component of a measure; equal to another of the same, so that programs are compiled once."""

    measure: Measure
    number: int

    def __call__(self, scene: Scene, x: jax.Array) -> jax.Array:
        return jnp.ravel(self.measure(scene, x))[self.number]


def _bars(scene: Scene, x: np.ndarray, parts: list[Component]) -> list[float]:
    """The error bar of the mesh of each component at the equilibrium nearest to `x` `(n, d)`."""
    solution = check(equilibrium(scene, x))
    return [float(estimate_error(scene, solution, part).bar) for part in parts]


@dataclasses.dataclass(frozen=True, eq=False)
class Experiments:
    """What each of `K` candidate experiments would add to a fit.

    best: number of the candidate that adds most.
    errors: `(K, q)` standard errors of the parameters after it; NaN for those that are not determined even then.
    information: `(K,)` by how much it shrinks the logarithm of the volume of the confidence region. Each scaled
        parameter is taken as known beforehand to within its scale, so that there is one also of what is not determined.
    """

    best: int
    errors: np.ndarray
    information: np.ndarray


@usual_rules
def next_experiment(
    fitted: Fit,
    candidates: Numbers,
    parameter: str | None = None,
    *,
    measure: Measure | None = None,
    sd: Numbers | None = None,
) -> Experiments:
    """Of candidate commands the one whose measurement tells most about a parameter, or about all.

    Args:
        fitted: from `fit`.
        candidates: `(K, m)` commands that could be measured next.
        parameter: its name in `fitted.names`: the candidate is best that makes its error smallest (c-optimal). By
            default the one that makes the volume of the confidence region smallest (D-optimal).
        measure: what would be measured; by default what was.
        sd: standard deviations `()` or `(p,)` it would have; by default the median ones of the fit.

    Raises:
        ValueError: if `parameter` is no name of a parameter, `sd` is missing for another `measure`, a shape is wrong,
            or no candidate determines the parameter.
        EquilibriumError: if a candidate has no equilibrium that is `OK`.
    """
    checks.instance("fitted", fitted, Fit, "give what fit returned")
    basis = fitted.basis
    if parameter is not None and parameter not in fitted.names:
        raise ValueError(f"parameter: expected one of {', '.join(fitted.names)}, got {parameter!r}")
    if measure is not None and sd is None:
        raise ValueError("sd: expected the standard deviations of the new measure, got none")
    _, found = _solved("candidates", fitted, candidates, basis.measure if measure is None else measure)
    deviations = basis.sd if sd is None else checks.real("sd", sd)
    if deviations.shape not in ((), found.values.shape[1:]) or not (deviations > 0).all():
        raise ValueError(f"sd: expected positive numbers of shape () or {found.values.shape[1:]}, got {deviations}")
    rows = found.slopes / np.broadcast_to(deviations, found.values.shape[1:])[:, None]
    known = lambda J: what_is_known(J, basis.scales, basis.free, basis.positive, fitted.names, basis.variance)
    after = [known(np.concatenate([basis.jacobian, new])) for new in rows]
    errors = np.stack([each.errors for each in after])
    # Half of the logarithm of the determinant of 1 + J^T J (Chaloner and Verdinelli 1995, Statist. Sci. 10, 273-304).
    volume = lambda sizes: float(np.sum(np.log1p(sizes**2)) / 2)
    information = np.array([volume(each.singular_values) for each in after]) - volume(basis.known.singular_values)
    merit = -information if parameter is None else errors[:, fitted.names.index(parameter)]
    if np.isnan(merit).all():
        raise ValueError(
            f"candidates: none of them determines {parameter}; measure something else, or at other commands"
        )
    return Experiments(int(np.nanargmin(merit)), errors, information)


def _solved(name: str, fitted: Fit, commands: Numbers, measure: Measure) -> tuple[np.ndarray, Predicted]:
    """Commands `(K, m)`, the argument of this name, checked, and what is predicted under them."""
    basis = fitted.basis
    checks.function("measure", measure, "(scene, x) to shape () or (p,)")
    scene = basis.model.scene(jnp.asarray(basis.flat))
    rows = checks.numbers(name, commands)
    if rows.ndim != 2 or rows.shape[1] != command_count(scene) or not len(rows):
        raise ValueError(f"{name}: expected shape (K, {command_count(scene)}), a row for each, got {rows.shape}")
    check_commands(name, scene, rows)
    start = check(sweep(scene, rows, solver=basis.model.solver))
    return rows, predict_all(basis.model, basis.flat, rows, start.x, measure)
