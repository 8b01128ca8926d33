"""What linear solvers share: the layout of a matrix, its assembly, and vectors of unknowns.

A linear solver is an object with the methods of `LinearSolver`. All solvers use the same assembly. They differ in where
they store an entry of the matrix.
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

    The storage is a flat array of `size` numbers with the lower triangle of the matrix. A place is an index into it.

    slots: `(N,)`, flat coordinate (node * d + axis) of each unknown; the value `n d` marks padding.
    position: `(n d,)`, unknown of each flat coordinate; the value `N` marks a fixed one.
    scatter: for each term, `(s (s + 1) / 2, m)`, places of the lower triangles of its stencil Hessians, row by row,
        where `s = k d`; entries of fixed coordinates have a place past the end, and assembly drops them.
    diagonal: `(N,)`, places of the diagonal.
    empty: `(size,)`, storage before assembly, as booleans: true on the diagonal of the padding.
    blocks: `(b, w, head, tail, r)`: `b` blocks of `w` unknowns, and `r` unknowns in the border. Of each block only the
        first `head` unknowns are coupled to the block before, and only the last `tail` to the block after.
    """

    slots: jax.Array
    position: jax.Array
    scatter: tuple[jax.Array, ...]
    diagonal: jax.Array
    empty: jax.Array
    blocks: tuple[int, int, int, int, int] = static_field()


class LinearSolver(Protocol):
    """The methods that `Newton` calls."""

    def __hash__(self) -> int: ...

    def layout(self, topology: Topology) -> Layout:
        """Where unknowns and matrix entries are stored."""
        ...

    def factor(self, layout: Layout, storage: jax.Array) -> tuple[Any, jax.Array]:
        """Cholesky factor, and `()` whether the matrix is positive definite to working precision."""
        ...

    def pivots(self, layout: Layout, factor: Any) -> jax.Array:
        """Pivots `(N,)`: squares of the diagonal of the Cholesky factor."""
        ...

    def solve(self, layout: Layout, factor: Any, rhs: jax.Array) -> jax.Array:
        """Solution for one right-hand side `(N,)`, or for each column of `(N, k)`. `factor` is from `factor`."""
        ...

    def factor_indefinite(self, layout: Layout, storage: jax.Array) -> tuple[Any, jax.Array]:
        """Factor of a matrix of any inertia, and `()` the number of its negative eigenvalues."""
        ...

    def solve_indefinite(self, layout: Layout, factor: Any, rhs: jax.Array) -> jax.Array:
        """Solution for one right-hand side `(N,)`. `factor` is from `factor_indefinite`."""
        ...


def assemble(layout: Layout, hessians: list[jax.Array]) -> jax.Array:
    """Storage of the sum of stencil Hessians `(k d, k d, m)`, one array for each term."""
    storage = layout.empty.astype(hessians[0].dtype)
    for places, hessian in zip(layout.scatter, hessians, strict=True):
        # A loop over a few parts makes XLA compute the Hessians before it. Without a loop XLA fuses them with the
        # scatter and computes each entry separately.
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
    """The full symmetric matrix of a lower triangle."""
    return jnp.tril(matrix) + jnp.tril(matrix, -1).T


def _inverse(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Inverse of a symmetric matrix, and the number of its negative eigenvalues."""
    values, vectors = jnp.linalg.eigh(matrix)
    return (vectors / values) @ vectors.T, jnp.sum(values < 0, dtype=jnp.int32)


def _coordinates(stencil: np.ndarray, topology: Topology) -> np.ndarray:
    """Flat coordinates `(m, k d)` of stencils with nodes `(m, k)`."""
    d = topology.fixed.array.shape[1]
    return (stencil.astype(np.int64)[..., None] * d + np.arange(d)).reshape(len(stencil), -1)


def _stencil_pairs(unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns `(m, s (s + 1) / 2)` in the matrix, for the lower triangles of stencil Hessians.

    `unknowns` `(m, s)` are those of each stencil. All results lie in the lower triangle of the matrix.
    """
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
    """The layout of a storage of `total` numbers, where `place(p, q)` is the place of row `p` and column `q <= p`."""
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
