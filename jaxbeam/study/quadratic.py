"""The quadratic program of one step of a search, on the host.

Of all steps `s` within a box, find the one of least effort that brings the linearised measure to its target:

    minimise  1/2 s^T A s + (theta - rest)^T s + |slope s + miss|^2 / (2 soft)

The last term is a penalty so steep that it acts as the constraint `slope s + miss = 0` where that can be met. The
quasi-definite system of this problem (Vanderbei 1995) has a solution also where the constraint cannot be met, and where
the slope vanishes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

EPS = float(np.finfo(np.float64).eps)


class Program(NamedTuple):
    """The data of the quadratic program. Commands are in multiples of their unit.

    theta: `(m,)` commands.
    rest: `(m,)` commands of no effort.
    miss: `(p,)` measure minus target.
    slope: `(p, m)` first derivatives of the measure.
    bend: `(p, m, m)` second derivatives of the measure.
    held: `(m,)` bounds that held the commands at the last step: -1 the lower, 1 the upper, 0 none.
    low: `(m,)` lower sides of the box of the step.
    high: `(m,)` upper sides of the box.
    soft: `()` softness of the constraint, in the unit of a squared slope.
    """

    theta: np.ndarray
    rest: np.ndarray
    miss: np.ndarray
    slope: np.ndarray
    bend: np.ndarray
    held: np.ndarray
    low: np.ndarray
    high: np.ndarray
    soft: float


def softness(scale: float) -> float:
    """`soft` for a search whose slopes had at most the squared norm `scale` so far."""
    return EPS**0.75 * (scale if scale > 0 else 1.0)


def best_step(program: Program) -> tuple[np.ndarray, np.ndarray]:
    """The step `(m,)` and the sides of its box that hold it, `(m,)`: -1 for the lower one, 1 for the upper, else 0.

    `A` is the Hessian of a Lagrangian. The multipliers tried first balance the effort of the free commands. If the step
    with these does not halve the miss, the multipliers `miss / soft` of a target out of reach are used.
    """
    theta, miss, slope, soft = program.theta, program.miss, program.slope, program.soft
    free = np.where(program.held == 0, slope, 0)
    price = np.linalg.solve(free @ free.T + soft * np.eye(miss.size), free @ (program.rest - theta))
    curvature = _weighted(price, program.bend)
    steepness = 10 * np.linalg.norm(curvature) / max(np.sum(slope**2), soft)
    step, held = _step_in_box(program, curvature, steepness)
    if np.linalg.norm(slope @ step + miss) <= 0.5 * np.linalg.norm(miss):
        return step, held
    return _step_in_box(program, _weighted(miss / soft, program.bend), 1 / soft)


def _weighted(price: np.ndarray, bend: np.ndarray) -> np.ndarray:
    """Sum `(m, m)` of the second derivatives `bend` of the measure, weighted by the multipliers `price` `(p,)`."""
    return (price @ bend.reshape(len(price), -1)).reshape(bend.shape[1:])


def _step_in_box(program: Program, curvature: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray]:
    """The step `(m,)` and the sides that hold it `(m,)`, by an active-set method.

    A side that the step violates enters the active set, the most violated first. A side whose multiplier is negative
    leaves it.

    Args:
        program: to solve.
        curvature: `(m, m)` of the weighted measure, added to that of the effort.
        weight: of the squared slope, see `_convex`.
    """
    m, p = program.theta.size, program.miss.size
    low, high = program.low, program.high
    matrix = np.zeros((m + p, m + p))
    matrix[:m, :m] = _convex(program, curvature, weight)
    matrix[:m, m:], matrix[m:, :m] = program.slope.T, program.slope
    matrix[m:, m:] = -program.soft * np.eye(p)
    rhs = np.append(program.rest - program.theta, -program.miss)

    def solve(held: np.ndarray) -> np.ndarray:
        """Step and multipliers `(m + p,)` if the active sides are equations."""
        rows, right = matrix.copy(), rhs.copy()
        for k in np.flatnonzero(held):
            rows[k], rows[k, k] = 0, 1
            right[k] = low[k] if held[k] < 0 else high[k]
        return np.linalg.solve(rows, right)

    held = np.zeros(m, np.int32)
    for _ in range(6 * m + 6):
        both = solve(held)
        step = both[:m]
        over = np.where(held == 0, np.maximum(step - high, low - step), 0)
        # Multipliers of the active sides. A side pushes the step into the box; one with a negative sign would pull.
        push = np.where(held == 0, 0, -held * (matrix[:m] @ both - rhs[:m]))
        worst, wrong = np.argmax(over), np.argmin(push)
        if over[worst] > 16 * EPS:
            held[worst] = 1 if step[worst] > high[worst] else -1
        elif push[wrong] < -16 * EPS * (np.abs(matrix[wrong]) @ np.abs(both) + 1):
            held[wrong] = 0
        else:
            break
    else:
        step = solve(held)[:m]
    return np.where(held == 0, np.clip(step, low, high), np.where(held < 0, low, high)), held


def _convex(program: Program, curvature: np.ndarray, weight: float) -> np.ndarray:
    """`A` `(m, m)`: the `curvature` plus that of the effort, made convex.

    Only the sum of `A` and `weight` times `slope^T slope` is made positive definite, over the commands that no bound
    held at the last step. In the directions of the slope the constraint makes the problem convex.
    """
    free = (program.held == 0)[:, None] & (program.held == 0)
    square = weight * np.where(free, program.slope.T @ program.slope, 0)
    values, vectors = np.linalg.eigh(np.eye(program.theta.size) + np.where(free, curvature, 0) + square)
    return (vectors * np.maximum(np.abs(values), 0.01)) @ vectors.T - square
