"""Least squares within bounds by the method of Levenberg and Marquardt, on the host.

Each step minimises the linearised residuals with a penalty on its length, in units of the column norms of the Jacobian
(Moré 1978, Lecture Notes in Mathematics 630, 105-116). Parameters at a bound that the gradient pushes against stay
there. Those that a step would take past a bound go to the bound, and the step of the others is found anew with them
there (active sets: Nocedal and Wright 2006, Numerical Optimization, ch. 16.5). A direction in which the residuals do
not change is not moved along at all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxbeam.study.design import DesignStatus

# First damping, by what it is divided after a step as good as predicted and multiplied after a bad one, and its range.
# After others it depends on how good they were, and each further bad step in a row multiplies it by twice as much as
# the one before (Nielsen 1999, report IMM-REP-1999-05).
DAMPING, EASED, RAISED, LOWEST, HIGHEST = 1e-3, 8.0, 4.0, 1e-12, 1e12
# Singular values below this share of the largest count as zero: derivatives are no more exact.
BLIND = 1e-8
# The search has converged if the next step changes each parameter by less than this share of it, or the residuals by
# less than this share of what all of the parameters do; or if it would lower the sum of squares by less than this
# share of it.
SHORT, SLIGHT, FLAT = 1e-9, 1e-12, 1e-14
# A predicted fall below this share that does not come is lost in the round-off of the residuals.
LOST = 1e-8
# Share of the predicted fall of the sum of squares that a step must reach.
WORTH = 1e-4


class Residuals(NamedTuple):
    """Residuals `(r,)`, their Jacobian `(r, q)`, and what else came with them."""

    values: np.ndarray
    jacobian: np.ndarray
    other: Any

    @property
    def cost(self) -> float:
        """The sum of squares."""
        return float(self.values @ self.values)


@dataclasses.dataclass
class Search:
    """Where a search ended.

    theta: `(q,)` parameters.
    here: the residuals there.
    held: `(q,)` -1 or 1 where a lower or upper bound holds a parameter, else 0.
    costs: sum of squares of each point that was accepted, the start first.
    trials: number of points at which residuals were asked for.
    status: `REACHED` at a minimum, else `NOT_CONVERGED`.
    """

    theta: np.ndarray
    here: Residuals
    held: np.ndarray
    costs: list[float]
    trials: int = 1
    status: DesignStatus = DesignStatus.NOT_CONVERGED


def least_squares(
    residuals: Callable[[np.ndarray, Residuals | None], Residuals | None],
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    max_steps: int,
    report: Callable[[int, float], None],
) -> Search:
    """The parameters of least squares nearest to the start, downhill.

    Args:
        residuals: from parameters `(q,)`, and the residuals of the last accepted point, those there; None where they
            do not exist.
        start: `(q,)` parameters within the bounds, at which residuals exist.
        low: lower bounds.
        high: upper bounds.
        max_steps: the most trials.
        report: called after each trial with their number and the sum of squares.
    """
    first = residuals(start, None)
    assert first is not None
    state = Search(start, first, np.zeros(len(start), int), [first.cost])
    damping, raised, norms = DAMPING, RAISED, np.zeros(len(start))
    while True:
        J, r = state.here.jacobian, state.here.values
        norms = np.maximum(norms, np.linalg.norm(J, axis=0))
        slope = J.T @ r
        state.held = np.where(
            (state.theta <= low) & (slope > 0), -1, np.where((state.theta >= high) & (slope < 0), 1, 0)
        )
        trial = _trial(state, J, norms, damping, low, high)
        step = trial - state.theta
        fall = state.here.cost - float(np.sum((r + J @ step) ** 2))
        slight = SLIGHT * np.linalg.norm(norms * state.theta)
        short = (np.abs(step) <= SHORT * np.abs(state.theta)) | (norms * np.abs(step) <= slight)
        if short.all() or abs(fall) <= FLAT * state.here.cost:
            state.status = DesignStatus.REACHED
            return state
        if state.trials > max_steps or damping > HIGHEST:
            return state
        # A step to several bounds may lead uphill. A shorter one does not.
        new = residuals(trial, state.here) if fall > 0 else None
        state.trials += fall > 0
        gain = (state.here.cost - new.cost) / fall if new is not None else -1.0
        if new is not None and gain >= WORTH:
            damping = max(damping * max(1 / EASED, 1 - (2 * gain - 1) ** 3), LOWEST)
            state.theta, state.here, raised = trial, new, RAISED
            state.costs.append(new.cost)
        elif new is not None and fall <= LOST * state.here.cost:
            state.status = DesignStatus.REACHED
            return state
        else:
            damping, raised = damping * raised, 2 * raised
        report(state.trials, state.here.cost)


def _trial(
    state: Search, J: np.ndarray, norms: np.ndarray, damping: float, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """The next parameters `(q,)` to try, within the bounds."""
    free, trial = state.held == 0, state.theta.copy()
    while True:
        r = state.here.values + J @ (trial - state.theta)
        wanted = state.theta + _step(J, r, norms, free, damping)
        past = free & ((wanted < low) | (wanted > high))
        trial = np.where(free, np.clip(wanted, low, high), trial)
        if not past.any():
            return trial
        free &= ~past
        trial = np.where(free, state.theta, trial)


def _step(J: np.ndarray, r: np.ndarray, norms: np.ndarray, free: np.ndarray, damping: float) -> np.ndarray:
    """The step `(q,)` of the free parameters that minimises `|r + J step|^2 + damping |norms step|^2`."""
    step, units = np.zeros(len(norms)), np.where(norms > 0, norms, 1)
    if not free.any():
        return step
    u, sizes, v = np.linalg.svd(J[:, free] / units[free], full_matrices=False)
    seen = sizes > BLIND * sizes.max(initial=0.0)
    along = np.where(seen, sizes / np.where(seen, sizes**2 + damping, 1), 0)
    step[free] = -(v.T @ (along * (u.T @ r))) / units[free]
    return step
