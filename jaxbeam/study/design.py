"""What inverse design answers."""

from __future__ import annotations

import enum
from typing import Any

import jax

from jaxbeam.core.tree import pytree
from jaxbeam.solve.solution import Solution


class DesignStatus(enum.IntEnum):
    """How a design ended."""

    REACHED = 0
    UNREACHABLE = 1
    NOT_CONVERGED = 2


@pytree
class History:
    """What was tried, in order; NaN (status -1) beyond what was needed.

    theta: `(K, ...)` parameters. loss: `(K,)`. status: `(K,)` of their equilibria; one that is not `OK` was skipped.
    """

    theta: Any
    loss: jax.Array
    status: jax.Array


@pytree
class Design:
    """What a design found.

    theta: the parameters: for `reach` `(m,)` commanded ratios.
    solution: their equilibrium.
    value: the measure there; for `minimise` the loss.
    loss: `()` distance from the target, Euclidean; for `minimise` the loss.
    held: `(m,)` -1 where the lower bound holds a command back, 1 where the upper does, else 0: without that bound the
        answer would be nearer to the target, or as near with less effort.
    solves: `()` equilibria solved.
    history: of all of them.
    status: `()` int32 of a `DesignStatus`.
    """

    theta: Any
    solution: Solution
    value: jax.Array
    loss: jax.Array
    held: jax.Array
    solves: jax.Array
    history: History
    status: jax.Array
