"""What linear solvers share: the layout of a matrix, its assembly, and vectors of unknowns.

A linear solver is a value with the methods of `LinearSolver`. Solvers share the assembly and differ in where an entry
of the matrix is stored.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core.tree import pytree, static_field, to_device
from jaxbeam.linear.blocks import Topology


@pytree
class Layout:
    """Where unknowns and matrix entries are stored, for one topology.

    slots `(N,)`: flat coordinate (node * d + axis) of each unknown; the value `n d` marks padding.
    position `(n d,)`: unknown of each flat coordinate; the value `N` marks a fixed one.
    scatter: for each term, `(s (s + 1) / 2, m)` places in the storage of the lower triangles of its stencil Hessians,
        `s = k d`, row by row; entries that are fixed point past the end and are dropped.
    diagonal `(N,)`: places of the diagonal.
    empty `(size,)`: storage before assembly, as booleans: true on the diagonal of the padding.
    blocks: number of blocks, their width, how many rows and columns couple neighbours, and the width of the border.
    """

    slots: jax.Array
    position: jax.Array
    scatter: tuple[jax.Array, ...]
    diagonal: jax.Array
    empty: jax.Array
    blocks: tuple[int, int, int, int, int] = static_field()


class LinearSolver(Protocol):
    """What `Newton` asks of a linear solver."""

    def __hash__(self) -> int: ...

    def layout(self, topology: Topology) -> Layout: ...

    def factor(self, layout: Layout, storage: jax.Array) -> tuple[Any, jax.Array]:
        """Factor, and whether the matrix is positive definite to working precision."""
        ...

    def pivots(self, layout: Layout, factor: Any) -> jax.Array:
        """What was left of each diagonal entry `(N,)` when its turn came to be eliminated."""
        ...

    def solve(self, layout: Layout, factor: Any, rhs: jax.Array) -> jax.Array:
        """Solution for `rhs` `(N,)`, or for each column of one `(N, k)`."""
        ...

    def factor_indefinite(self, layout: Layout, storage: jax.Array) -> tuple[Any, jax.Array]:
        """Factor of a matrix of any inertia, and how many of its eigenvalues are negative."""
        ...

    def solve_indefinite(self, layout: Layout, factor: Any, rhs: jax.Array) -> jax.Array: ...


def assemble(layout: Layout, hessians: list[jax.Array]) -> jax.Array:
    """Storage of the sum of stencil Hessians `(k d, k d, m)`, one array for each term."""
    storage = layout.empty.astype(hessians[0].dtype)
    for places, hessian in zip(layout.scatter, hessians, strict=True):
        # In a few parts, so that XLA computes the Hessians before the loop: fused with what reads them, each entry
        # would be computed by itself.
        parts = next(n for n in (3, 2, 1) if len(places) % n == 0)
        rows, columns = (jnp.asarray(i.reshape(parts, -1)) for i in np.tril_indices(len(hessian)))
        add = lambda all, part, h=hessian: (all.at[part[0]].add(h[part[1], part[2]], mode="drop"), None)
        storage, _ = lax.scan(add, storage, (places.reshape(parts, -1, places.shape[1]), rows, columns))
    return storage


def gather(layout: Layout, field: jax.Array) -> jax.Array:
    """Vector of unknowns `(N,)` of a nodal field `(n, d)`; zero in the padding."""
    return jnp.append(field.ravel(), 0)[layout.slots]


def expand(layout: Layout, unknowns: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Nodal field `(n, d)` of a vector of unknowns `(N,)`; zero where fixed."""
    return jnp.append(unknowns, 0)[layout.position].reshape(shape)


def _mirrored(matrix: jax.Array) -> jax.Array:
    """A symmetric matrix of which the lower triangle is stored."""
    return jnp.tril(matrix) + jnp.tril(matrix, -1).T


def _inverse(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Inverse of a symmetric matrix, and how many of its eigenvalues are negative."""
    values, vectors = jnp.linalg.eigh(matrix)
    return (vectors / values) @ vectors.T, jnp.sum(values < 0, dtype=jnp.int32)


def _coordinates(stencil: np.ndarray, topology: Topology) -> np.ndarray:
    """Flat coordinates `(m, k d)` of the nodes `(m, k)` of stencils."""
    d = topology.fixed.array.shape[1]
    return (stencil.astype(np.int64)[..., None] * d + np.arange(d)).reshape(len(stencil), -1)


def _stencil_pairs(unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column `(m, s (s + 1) / 2)` in the lower triangle of the matrix of each entry in the lower triangle of
    stencil Hessians, from their unknowns `(m, s)`."""
    i, j = np.tril_indices(unknowns.shape[1])
    a, b = unknowns[:, i], unknowns[:, j]
    return np.maximum(a, b), np.minimum(a, b)


def _layout(
    topology: Topology,
    slots: np.ndarray,
    position: np.ndarray,
    diagonal: np.ndarray,
    total: int,
    blocks: tuple[int, int, int, int, int],
    place: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> Layout:
    """The layout of a storage of `total` numbers, in which row `p` and column `q <= p` have this `place`."""
    if total >= 2**31 - 1:
        raise ValueError(
            f"mesh: its factor would hold {total} numbers, more than 32-bit indices address; use a coarser mesh"
        )
    places = []
    for stencil in topology.stencils:
        p, q = _stencil_pairs(position[_coordinates(stencil.array, topology)])
        places.append(np.where(p < slots.size, place(p, q), total))
    empty = np.zeros(total, bool)
    empty[diagonal[slots == position.size]] = True
    index = lambda a: to_device(a, np.int32)
    return Layout(
        index(slots), index(position), tuple(index(p.T) for p in places), index(diagonal), to_device(empty), blocks
    )
