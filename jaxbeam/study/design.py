"""What inverse design answers."""

from __future__ import annotations

import enum
from typing import Any

import jax
import numpy as np

from jaxbeam.core.tree import holds_arrays, is_concrete, pytree
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

    def __repr__(self) -> str:
        known = holds_arrays(self, self.status)
        if not known or not is_concrete(self.status):
            return f"Design({'traced' if known else 'a tree of other values'})"
        if np.ndim(self.status):
            flags = [DesignStatus(int(flag)).name for flag in self.status]
            words = ", ".join(f"{flags.count(name)} {name}" for name in dict.fromkeys(flags))
            return f"Design({len(flags)} targets: {words}; {int(np.sum(self.solves))} solves)"
        count = sum(leaf.size for leaf in jax.tree.leaves(self.theta))
        theta = jax.tree.map(lambda leaf: leaf.tolist(), self.theta) if count <= 8 else f"of {count} numbers"
        status = DesignStatus(int(self.status)).name
        return f"Design({status}; value {self.value.tolist()}, theta {theta}, {int(self.solves)} solves)"
