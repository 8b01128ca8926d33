"""Reports: what a continuation has found at each target, while it runs.

They become a `Solution` at the end. Until then they are packed in few arrays, because a loop that carries many arrays
compiles slowly. Only `pack` and `unpack` know the order of the entries.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Report(NamedTuple):
    """What is found at one target. Fields are as in `Solution`; `x` is `(n, d)`, every other one `()`.

    `steps`, `projected`, `halvings` and `attempts` are totals over all attempts at the target.
    """

    x: jax.Array
    energy: jax.Array
    residual: jax.Array
    correction: jax.Array
    smallest_jacobian: jax.Array
    reached: jax.Array
    steps: jax.Array
    projected: jax.Array
    halvings: jax.Array
    attempts: jax.Array
    worst_element: jax.Array
    status: jax.Array


FLOATS = ("energy", "residual", "correction", "smallest_jacobian", "reached")
INTEGERS = ("steps", "projected", "halvings", "attempts", "worst_element", "status")


class PackedReport(NamedTuple):
    """A `Report` in three arrays instead of twelve: the program is smaller and compiles faster.

    x: `(n, d)` positions.
    floats: `(5,)` in the order of `FLOATS`.
    integers: `(6,)` in the order of `INTEGERS`.
    """

    x: jax.Array
    floats: jax.Array
    integers: jax.Array


def pack(report: Report) -> PackedReport:
    """A report in few arrays."""
    floats = jnp.stack([getattr(report, name) for name in FLOATS])
    integers = jnp.stack([getattr(report, name) for name in INTEGERS], dtype=jnp.int32)
    return PackedReport(report.x, floats, integers)


def unpack(packed: PackedReport) -> Report:
    """The report from its packed form; leading axes are kept."""
    floats = {name: packed.floats[..., k] for k, name in enumerate(FLOATS)}
    integers = {name: packed.integers[..., k] for k, name in enumerate(INTEGERS)}
    return Report(x=packed.x, **floats, **integers)


def zeros(count: int, x: jax.Array) -> PackedReport:
    """Packed reports of zeros, with leading axis `count`, for positions like `x` `(n, d)`."""
    return PackedReport(
        x=jnp.zeros((count, *x.shape), x.dtype),
        floats=jnp.zeros((count, len(FLOATS)), x.dtype),
        integers=jnp.zeros((count, len(INTEGERS)), jnp.int32),
    )


def write(path: PackedReport, number: jax.Array, report: Report, final: jax.Array) -> PackedReport:
    """The packed reports of all targets, with the one of target `number` `()` written if it is `final` `()`."""
    put = lambda all, new: all.at[number].set(jnp.where(final, new, all[number]))
    return jax.tree.map(put, path, pack(report))
