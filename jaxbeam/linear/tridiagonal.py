"""Block-tridiagonal Cholesky with a border, over the levels of the mesh.

Nodes form a chain of blocks in which each is coupled to its neighbours only (`jaxbeam.linear.blocks`). Nodes that
couple distant blocks form a border, which is eliminated last:

    K = [ T   E ]     T block tridiagonal, S the border's own block.
        [ E^T S ]

A low-rank (Woodbury) correction would solve the same equations. It would need a stiffness that is definite without the
tendons, and it would lose digits by cancellation when a tendon is stiff. The Cholesky factor here exists if and only if
`K` is positive definite.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core import checks
from jaxbeam.linear.blocks import Topology, chain_of, coupled
from jaxbeam.linear.layout import Layout, _inverse, _layout, _mirrored


class BorderedFactor(NamedTuple):
    """Blocks of the Cholesky factor `L` in `K = L L^T`.

    pivot: `(b, w, w)`, diagonal blocks of `L`, transposed, because LAPACK reads them in this order.
    beside: `(b, tall, head + r)`, blocks of `L` below the diagonal, transposed. The first `head` columns belong to the
        next block, the others to the border. The rows are all `w` of the block if there is a border. Otherwise they are
        the last `tail`, the only ones that are coupled to the next block.
    corner: `(r, r)`, diagonal block of `L` for the border, not transposed.

    `factor_indefinite` returns `K = L D L^T` in the same fields: `pivot` and `corner` are the inverses of the blocks of
    `D`, and `beside` holds the blocks of `L D` below the diagonal, transposed.
    """

    pivot: jax.Array
    beside: jax.Array
    corner: jax.Array


@dataclasses.dataclass(frozen=True)
class BlockTridiagonal:
    """Bordered block-tridiagonal Cholesky over the levels of the mesh.

    Each of `b` blocks has `w` unknowns. The first `head` of them are coupled to the last `tail` of the block before. A
    factor holds `b (w^2 + tail head)` numbers, or `b (w^2 + w (head + r)) + r^2` with a border of `r` columns. For its
    time see `multiplications`.

    joined: several levels of the mesh may make a block of up to this many unknowns. As long as blocks are small, fewer
        and wider ones take more arithmetic but less time.
    """

    joined: int = 32

    def __post_init__(self) -> None:
        checks.count("joined", self.joined, 0)

    def layout(self, topology: Topology) -> Layout:
        return _bordered_layout(topology, self.joined)

    def factor(self, layout: Layout, storage: jax.Array) -> tuple[BorderedFactor, jax.Array]:
        skip = layout.blocks[1] - coupled(layout.blocks)[0]

        def eliminate(diagonal: jax.Array, beside: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            pivot = jnp.linalg.cholesky(diagonal, symmetrize_input=False).T
            # One call for the next block and the border: a call costs more than its arithmetic.
            beside = lax.linalg.triangular_solve(pivot[skip:, skip:].T, beside, left_side=True, lower=True)
            return pivot, beside, beside.T @ beside

        (pivot, beside), corner = _eliminate_blocks(layout, storage, eliminate)
        r = len(corner)
        corner = jnp.linalg.cholesky(corner, symmetrize_input=False) if r else corner
        # A block that fails is NaN. The NaN spreads to the blocks after it and to the border, unless no two blocks are
        # coupled.
        last = corner[None] if r else pivot[-1:] if layout.blocks[2] else pivot
        ok = jnp.all(jnp.isfinite(last[:, -1, -1]))
        return BorderedFactor(pivot, beside, corner), ok

    def pivots(self, layout: Layout, factor: BorderedFactor) -> jax.Array:
        inner = jnp.diagonal(factor.pivot, axis1=1, axis2=2).ravel()
        return jnp.concatenate([inner, jnp.diagonal(factor.corner)]) ** 2

    def solve(self, layout: Layout, factor: BorderedFactor, rhs: jax.Array) -> jax.Array:
        b, w, head, _, r = layout.blocks
        tall, _ = coupled(layout.blocks)
        # Right-hand sides are rows here, so that the products below can be plain loops.
        k = rhs.size // len(rhs)
        inner, outer = rhs[: b * w].reshape(b, w, k).swapaxes(1, 2), rhs[b * w :].reshape(r, k)
        solve = lambda pivot, y, transpose: (
            lax.linalg.triangular_solve(pivot.T, y.T, left_side=True, lower=True, transpose_a=transpose).T
        )

        def forward(carry: Any, block: Any) -> Any:
            passed, outer = carry
            pivot, beside, right = block
            y = solve(pivot, right - jnp.pad(passed, ((0, 0), (0, w - head))), False)
            passed = _times(y[:, w - tall :], beside)
            return (passed[:, :head], outer - passed[:, head:]), y

        none = jnp.zeros((k, head), rhs.dtype)
        (_, outer), inner = lax.scan(forward, (none, outer.T), (factor.pivot, factor.beside, inner))
        if r:
            outer = solve(factor.corner.T, solve(factor.corner.T, outer, False), True)

        def backward(after: jax.Array, block: Any) -> Any:
            pivot, beside, right = block
            known = _times(jnp.concatenate([after, outer], axis=1), beside.T)
            y = solve(pivot, right - jnp.pad(known, ((0, 0), (w - tall, 0))), True)
            return y[:, :head], y

        _, inner = lax.scan(backward, none, (factor.pivot, factor.beside, inner), reverse=True)
        return jnp.concatenate([inner.swapaxes(1, 2).reshape(b * w, k), outer.T]).reshape(rhs.shape)

    def factor_indefinite(self, layout: Layout, storage: jax.Array) -> tuple[BorderedFactor, jax.Array]:
        """Block `L D L^T`. The blocks of `D` are inverted through their eigenvalues.

        The inertia of the matrix is the sum of the inertias of these blocks (Haynsworth 1968).
        """
        skip = layout.blocks[1] - coupled(layout.blocks)[0]

        def eliminate(diagonal: jax.Array, beside: jax.Array) -> tuple[Any, jax.Array, jax.Array]:
            inverse, negative = _inverse(_mirrored(diagonal))
            return (inverse, negative), beside, beside.T @ inverse[skip:, skip:] @ beside

        ((inverse, negative), beside), corner = _eliminate_blocks(layout, storage, eliminate)
        corner, last = _inverse(_mirrored(corner))
        return BorderedFactor(inverse, beside, corner), jnp.sum(negative, dtype=jnp.int32) + last

    def solve_indefinite(self, layout: Layout, factor: BorderedFactor, rhs: jax.Array) -> jax.Array:
        b, w, head, _, _ = layout.blocks
        tall, _ = coupled(layout.blocks)

        def forward(carry: Any, block: Any) -> Any:
            passed, outer = carry
            inverse, beside, right = block
            y = right.at[:head].add(-passed)
            passed = (inverse @ y)[w - tall :] @ beside
            return (passed[:head], outer - passed[head:]), y

        none = jnp.zeros(head, rhs.dtype)
        blocks = (factor.pivot, factor.beside, rhs[: b * w].reshape(b, w))
        (_, outer), inner = lax.scan(forward, (none, rhs[b * w :]), blocks)
        outer = factor.corner @ outer

        def backward(after: jax.Array, block: Any) -> Any:
            inverse, beside, right = block
            y = inverse @ right.at[w - tall :].add(-beside @ jnp.concatenate([after, outer]))
            return y[:head], y

        _, inner = lax.scan(backward, none, (factor.pivot, factor.beside, inner), reverse=True)
        return jnp.concatenate([inner.reshape(b * w), outer])


def _eliminate_blocks(
    layout: Layout,
    storage: jax.Array,
    eliminate: Callable[[jax.Array, jax.Array], tuple[Any, jax.Array, jax.Array]],
) -> tuple[tuple[Any, jax.Array], jax.Array]:
    """Eliminate one block after another.

    Args:
        layout: of the matrix.
        storage: `(size,)`, the assembled matrix.
        eliminate: from `diagonal` `(w, w)` and `beside` `(tall, wide)` of a block to its `pivot`, its `beside` and a
            product `(wide, wide)`, which is subtracted from the next block and the border.

    Returns:
        `(pivot, beside)` of all blocks, with leading axis `b`, and the Schur complement `(r, r)` of the border.
    """
    b, w, head, _, r = layout.blocks
    tall, wide = coupled(layout.blocks)
    diagonal, beside, corner = jnp.split(storage, np.cumsum([b * w * w, b * tall * wide]))

    def step(carry: Any, block: Any) -> Any:
        passed, corner = carry
        diagonal, beside = block
        diagonal = diagonal - jnp.pad(passed[:, :head], ((0, w - head), (0, w - head)))
        if r:
            beside = beside - jnp.pad(passed[:, head:], ((0, tall - head), (head, 0)))
        pivot, beside, product = eliminate(diagonal, beside)
        return (product[:head], corner - product[head:, head:]), (pivot, beside)

    start = jnp.zeros((head, wide), storage.dtype), corner.reshape(r, r)
    (_, corner), found = lax.scan(step, start, (diagonal.reshape(b, w, w), beside.reshape(b, tall, wide)))
    return found, corner


# Up to this many rows of the matrix, a loop is faster than a call of a matrix product.
LOOPED = 64


def _times(rows: jax.Array, matrix: jax.Array) -> jax.Array:
    """The product of a few rows `(k, p)` with a matrix `(p, q)`."""
    if len(matrix) > LOOPED:
        return rows @ matrix
    return jnp.sum(rows[:, :, None] * matrix, axis=1)


@lru_cache(maxsize=32)
def _bordered_layout(topology: Topology, joined: int) -> Layout:
    fixed = topology.fixed.array
    count, d = fixed.shape
    chain = chain_of(topology, joined)
    (b, w, head, tail, r), slots = chain.shape, chain.slots
    size, taken = slots.size, slots < count * d
    position = np.full(count * d, size)
    position[slots[taken]] = np.flatnonzero(taken)

    tall, wide = coupled(chain.shape)
    beside_at = b * w * w
    corner_at = beside_at + b * tall * wide

    def place(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        bp, bq, sp, sq = p // w, q // w, p % w, q % w
        inside = p < b * w
        under = inside & (bp > bq)
        if (under & ((bp - bq > 1) | (sp >= head) | (sq < w - tail))).any():
            raise AssertionError("a stencil couples unknowns that are not neighbours")
        beside = beside_at + (bq * tall + sq - (w - tall)) * wide
        at = np.where(under, beside + sp, (bp * w + sp) * w + sq)
        at = np.where(inside, at, beside + head + p - b * w)
        return np.where(q < b * w, at, corner_at + (p - b * w) * r + (q - b * w))

    inner = np.arange(b * w)
    diagonal = np.concatenate([inner * w + inner % w, corner_at + np.arange(r) * (r + 1)])
    return _layout(topology, slots, position, diagonal, corner_at + r * r, chain.shape, place)
