"""Dense Cholesky: for tests and tiny scenes."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.linear.blocks import Topology
from jaxbeam.linear.layout import Layout, _inverse, _layout, _mirrored


@dataclasses.dataclass(frozen=True)
class Dense:
    """Dense Cholesky: for tests and tiny scenes. Time grows with the cube of the number of unknowns."""

    def layout(self, topology: Topology) -> Layout:
        return _dense_layout(topology)

    def factor(self, layout: Layout, storage: jax.Array) -> tuple[jax.Array, jax.Array]:
        size = layout.blocks[1]
        factor = jnp.linalg.cholesky(storage.reshape(size, size), symmetrize_input=False)
        return factor, jnp.isfinite(factor[-1, -1])

    def pivots(self, layout: Layout, factor: jax.Array) -> jax.Array:
        return jnp.diagonal(factor) ** 2

    def solve(self, layout: Layout, factor: jax.Array, rhs: jax.Array) -> jax.Array:
        half = lax.linalg.triangular_solve(factor, rhs.reshape(len(rhs), -1), left_side=True, lower=True)
        whole = lax.linalg.triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)
        return whole.reshape(rhs.shape)

    def factor_indefinite(self, layout: Layout, storage: jax.Array) -> tuple[jax.Array, jax.Array]:
        size = layout.blocks[1]
        return _inverse(_mirrored(storage.reshape(size, size)))

    def solve_indefinite(self, layout: Layout, factor: jax.Array, rhs: jax.Array) -> jax.Array:
        return factor @ rhs


@lru_cache(maxsize=32)
def _dense_layout(topology: Topology) -> Layout:
    fixed = topology.fixed.array.ravel()
    slots = np.flatnonzero(~fixed)
    size = slots.size
    position = np.full(fixed.size, size)
    position[slots] = np.arange(size)
    diagonal = np.arange(size) * (size + 1)
    return _layout(topology, slots, position, diagonal, size * size, (1, size, 0, 0, 0), lambda p, q: p * size + q)
