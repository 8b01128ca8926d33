"""How the benchmarks measure time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np


class Timing(NamedTuple):
    """Seconds of each of the repeated calls of one function; `first`, which may compile, is not among them."""

    calls: np.ndarray
    first: float

    @property
    def median(self) -> float:
        return float(np.median(self.calls))

    def over(self, other: Timing) -> float:
        """The median ratio of the calls to those of `other` in turn with them: what slows both cancels."""
        return float(np.median(self.calls / other.calls))

    def __str__(self) -> str:
        lower, upper = np.quantile(self.calls, [0.25, 0.75])
        return f"{1e3 * self.median:.3f} ms ({1e3 * lower:.3f} to {1e3 * upper:.3f})"


def in_turn(*runs: Callable[[], Any], repeats: int, checks: Sequence[Callable[[Any], object]] = ()) -> list[Timing]:
    """Times of each of several functions, called in turn so that all meet the same machine.

    Args:
        runs: functions without arguments.
        repeats: timed calls of each; a first call of each comes before and is reported apart.
        checks: one for each function: it gets every result, outside the timing, and raises if that is wrong.
    """

    def once(number: int) -> float:
        start = time.perf_counter()
        result = jax.block_until_ready(runs[number]())
        elapsed = time.perf_counter() - start
        if checks:
            checks[number](result)
        return elapsed

    first = [once(k) for k in range(len(runs))]
    times = np.array([[once(k) for k in range(len(runs))] for _ in range(repeats)])
    return [Timing(calls, begin) for calls, begin in zip(times.T, first, strict=True)]
