"""The result of inverse design, by `reach`, `reach_each` and `minimise`.

Look at `status` first: only `REACHED` means that the target or the goal is met. `theta` is the answer, and `solution`
its equilibrium, ready to be drawn.
"""

from __future__ import annotations

import enum
from typing import Any

import jax
import numpy as np

from jaxbeam.core.tree import pytree, why_unknown
from jaxbeam.solve.solution import Solution


class DesignStatus(enum.IntEnum):
    """How a design ended.

    REACHED: the target or goal is met; or, for `minimise` without a goal, the loss is stationary.
    UNREACHABLE: the search converged to a stationary point away from the target or goal.
    NOT_CONVERGED: neither.
    """

    REACHED = 0
    UNREACHABLE = 1
    NOT_CONVERGED = 2


@pytree
class History:
    """The trials, in order. Entries after the last trial hold NaN, and status -1.

    theta: `(K, ...)` parameters of each trial.
    loss: `(K,)` their losses.
    status: `(K,)` status of their equilibria; a trial that is not `OK` was skipped.
    """

    theta: Any
    loss: jax.Array
    status: jax.Array


@pytree
class Design:
    """What a design found.

    theta: the parameters; for `reach` the commands `(m,)`.
    solution: their equilibrium.
    value: the measure of that equilibrium; for `minimise` the loss.
    loss: `()` Euclidean distance of the value from the target; for `minimise` the loss.
    held: `(m,)` -1 where the lower bound holds a command back, 1 where the upper does, else 0. Without a bound that
        holds, the answer would be nearer to the target, or as near with less effort.
    solves: `()` number of equilibria solved.
    history: record of all of them.
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

    def __repr__(self) -> str:
        if unknown := why_unknown(self, self.status):
            return f"Design({unknown})"
        if np.ndim(self.status):
            flags = [DesignStatus(int(flag)).name for flag in self.status]
            words = ", ".join(f"{flags.count(name)} {name}" for name in dict.fromkeys(flags))
            return f"Design({len(flags)} targets: {words}; {int(np.sum(self.solves))} solves)"
        count = sum(leaf.size for leaf in jax.tree.leaves(self.theta))
        theta = jax.tree.map(lambda leaf: leaf.tolist(), self.theta) if count <= 8 else f"of {count} numbers"
        status = DesignStatus(int(self.status))
        parts = [f"value {self.value.tolist()}", f"theta {theta}", f"{int(self.solves)} solves"]
        if status != DesignStatus.REACHED:
            parts.append(f"distance from the target {float(self.loss):.4g}")
        if self.held.any() and self.held.size <= 8:
            parts.append(f"held {self.held.tolist()}")
        return f"Design({status.name}; {', '.join(parts)})"
