"""How the benchmarks measure time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax


def seconds(run: Callable[..., Any], *arguments: Any) -> float:
    """Time of one call, until its result is there."""
    start = time.perf_counter()
    jax.block_until_ready(run(*arguments))
    return time.perf_counter() - start
