"""How the benchmarks measure time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np


def seconds(run: Callable[..., Any], *arguments: Any) -> float:
    """Time of one call, until its result is there."""
    start = time.perf_counter()
    jax.block_until_ready(run(*arguments))
    return time.perf_counter() - start


class Timing(NamedTuple):
    """Seconds of the repeated calls of one function; `first`, which may compile, is not among them."""

    median: float
    smallest: float
    lower: float
    upper: float
    first: float
    repeats: int

    def __str__(self) -> str:
        return f"{1e3 * self.median:.3f} ms ({1e3 * self.lower:.3f} to {1e3 * self.upper:.3f})"


def medians(*runs: Callable[[], Any], repeats: int, checks: Sequence[Callable[[Any], object]] = ()) -> list[Timing]:
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
    return [
        Timing(float(np.median(t)), float(t.min()), *(float(q) for q in np.quantile(t, [0.25, 0.75])), begin, repeats)
        for t, begin in zip(times.T, first, strict=True)
    ]
