"""Linear algebra of Newton's method: assembly and symmetric positive definite factorisation.

A linear solver is a value with three methods, `layout`, `factor` and `solve`. `Dense` and
`BlockTridiagonal` share the assembly and differ in where an entry of the matrix is stored.

Nodes are ordered by breadth-first levels from the clamp, which makes the Hessian of any mesh block
tridiagonal (the level structure of Cuthill and McKee, 1969). Unknowns that couple far levels, such as
the free ends of a long tendon, are moved to a border of a few columns that is eliminated last:

    K = [ T   E ]     T block tridiagonal, S the border's own block.
        [ E^T S ]

This is the exact counterpart of a low-rank (Woodbury) correction. It needs no `T` that is definite by
itself and has no cancellation when a tendon is stiff: the Cholesky factor exists if and only if `K` is
positive definite.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam._tree import Key, pytree, static_field, to_device


@pytree
class Layout:
    """Where unknowns and matrix entries are stored, for one topology.

    slots `(N,)`: flat coordinate (node * d + axis) of each unknown; the value `n d` marks padding.
    position `(n d,)`: unknown of each flat coordinate; the value `N` marks a fixed one.
    scatter: for each term, `(s (s + 1) / 2, m)` places in the storage of the lower triangles of its stencil Hessians,
        `s = k d`, row by row; entries that are fixed point past the end and are dropped.
    diagonal `(N,)`: places of the diagonal.
    empty `(size,)`: storage before assembly, as booleans: true on the diagonal of the padding.
    blocks: number of blocks, their width and that of the border.
    """

    slots: jax.Array
    position: jax.Array
    scatter: tuple[jax.Array, ...]
    diagonal: jax.Array
    empty: jax.Array
    blocks: tuple[int, int, int] = static_field()


class LinearSolver(Protocol):
    """What `Newton` asks of a linear solver."""

    def __hash__(self) -> int: ...

    def layout(self, topology: Topology) -> Layout: ...

    def factor(self, layout: Layout, storage: jax.Array) -> tuple[Any, jax.Array]:
        """Factor, and whether the matrix is positive definite to working precision."""
        ...

    def solve(self, layout: Layout, factor: Any, rhs: jax.Array) -> jax.Array:
        """Solution for `rhs` `(N,)`, or for each column of one `(N, k)`."""
        ...

    def factor_indefinite(self, layout: Layout, storage: jax.Array) -> tuple[Any, jax.Array]:
        """Factor of a matrix of any inertia, and how many of its eigenvalues are negative."""
        ...

    def solve_indefinite(self, layout: Layout, factor: Any, rhs: jax.Array) -> jax.Array: ...


class Topology(NamedTuple):
    """What a layout depends on, hashable: elements, fixed coordinates and the nodes of every term."""

    elements: Key
    fixed: Key
    stencils: tuple[Key, ...]


def assemble(layout: Layout, hessians: list[jax.Array]) -> jax.Array:
    """Storage of the sum of stencil Hessians `(k d, k d, m)`, one array for each term."""
    storage = layout.empty.astype(hessians[0].dtype)
    for places, hessian in zip(layout.scatter, hessians, strict=True):
        storage = storage.at[places].add(hessian[np.tril_indices(len(hessian))], mode="drop")
    return storage


def gather(layout: Layout, field: jax.Array) -> jax.Array:
    """Vector of unknowns `(N,)` of a nodal field `(n, d)`; zero in the padding."""
    return jnp.append(field.ravel(), 0)[layout.slots]


def expand(layout: Layout, unknowns: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Nodal field `(n, d)` of a vector of unknowns `(N,)`; zero where fixed."""
    return jnp.append(unknowns, 0)[layout.position].reshape(shape)


# ---------------------------------------------------------------------------------------------- dense


@dataclasses.dataclass(frozen=True)
class Dense:
    """Dense Cholesky: for tests and tiny scenes. Time grows with the cube of the unknowns."""

    def layout(self, topology: Topology) -> Layout:
        return _dense_layout(topology)

    def factor(self, layout: Layout, storage: jax.Array) -> tuple[jax.Array, jax.Array]:
        size = layout.blocks[1]
        factor = jnp.linalg.cholesky(storage.reshape(size, size), symmetrize_input=False)
        return factor, jnp.isfinite(factor[-1, -1])

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
    scatter = []
    for stencil in topology.stencils:
        rows, columns = _stencil_pairs(position[_coordinates(stencil.array, topology)])
        scatter.append(np.where(rows < size, rows * size + columns, size * size))
    return _device_layout(
        slots, position, scatter, np.arange(size) * (size + 1), np.zeros(size * size, bool), (1, size, 0)
    )


# --------------------------------------------------------------------------------- block tridiagonal


class BorderedFactor(NamedTuple):
    """`K = L L^T` by blocks: `pivot (b, w, w)` lower triangular diagonal blocks, `lower (b, w, w)` the blocks
    left of them, `border (b, w, r)` the transposed rows of the border and `corner (r, r)` its own pivot."""

    pivot: jax.Array
    lower: jax.Array
    border: jax.Array
    corner: jax.Array


@dataclasses.dataclass(frozen=True)
class BlockTridiagonal:
    """Bordered block-tridiagonal Cholesky over the levels of the mesh.

    `b` blocks of width `w` with `r` border columns take about `b w (7/3 w^2 + 2 w r + r^2)` multiplications,
    and `2 b w^2` numbers of storage.
    """

    def layout(self, topology: Topology) -> Layout:
        return _bordered_layout(topology)

    def factor(self, layout: Layout, storage: jax.Array) -> tuple[BorderedFactor, jax.Array]:
        w, r = layout.blocks[1:]
        diagonal, lower, border, corner = _pieces(layout, storage)

        def eliminate(carry: Any, block: Any) -> Any:
            pivot, above, schur = carry
            diagonal, lower, border = block
            lower = lax.linalg.triangular_solve(pivot, lower, left_side=False, lower=True, transpose_a=True)
            pivot = jnp.linalg.cholesky(diagonal - lower @ lower.T, symmetrize_input=False)
            if r:
                border = lax.linalg.triangular_solve(pivot, border - lower @ above, left_side=True, lower=True)
                schur = schur - border.T @ border
            return (pivot, border, schur), (pivot, lower, border)

        start = (jnp.eye(w, dtype=storage.dtype), jnp.zeros((w, r), storage.dtype), corner)
        (_, _, schur), (pivot, lower, border) = lax.scan(eliminate, start, (diagonal, lower, border))
        corner = jnp.linalg.cholesky(schur, symmetrize_input=False) if r else schur
        # A failed block is NaN, and so is everything after it.
        ok = jnp.isfinite(corner[-1, -1]) if r else jnp.isfinite(pivot[-1, -1, -1])
        return BorderedFactor(pivot, lower, border, corner), ok

    def solve(self, layout: Layout, factor: BorderedFactor, rhs: jax.Array) -> jax.Array:
        b, w, r = layout.blocks
        # Right-hand sides are rows here, so that the products below can be plain loops.
        k = rhs.size // len(rhs)
        inner, outer = rhs[: b * w].reshape(b, w, k).swapaxes(1, 2), rhs[b * w :].reshape(r, k)
        solve = lambda pivot, y, transpose: (
            lax.linalg.triangular_solve(pivot, y.T, left_side=True, lower=True, transpose_a=transpose).T
        )

        def forward(above: jax.Array, block: Any) -> Any:
            pivot, lower, right = block
            y = solve(pivot, right - _times(above, lower.T), False)
            return y, y

        start = jnp.zeros((k, w), rhs.dtype)
        _, inner = lax.scan(forward, start, (factor.pivot, factor.lower, inner))
        if r:
            outer = outer - jnp.einsum("bwr,bkw->rk", factor.border, inner)
            outer = lax.linalg.triangular_solve(factor.corner, outer, left_side=True, lower=True)
            outer = lax.linalg.triangular_solve(factor.corner, outer, left_side=True, lower=True, transpose_a=True)
            inner = inner - jnp.einsum("bwr,rk->bkw", factor.border, outer)

        def backward(carry: jax.Array, block: Any) -> Any:
            pivot, lower, right = block
            y = solve(pivot, right - carry, True)
            return _times(y, lower), y

        _, inner = lax.scan(backward, start, (factor.pivot, factor.lower, inner), reverse=True)
        return jnp.concatenate([inner.swapaxes(1, 2).reshape(b * w, k), outer]).reshape(rhs.shape)

    def factor_indefinite(self, layout: Layout, storage: jax.Array) -> tuple[BorderedFactor, jax.Array]:
        """Block `L D L^T` with the pivots `D` inverted through their eigenvalues.

        The inertia of the matrix is the sum of its pivots' (Haynsworth 1968).
        """
        w, r = layout.blocks[1:]
        diagonal, lower, border, corner = _pieces(layout, storage)

        def eliminate(carry: Any, block: Any) -> Any:
            above, border_above, schur, count = carry
            diagonal, lower, border = block
            ahead = lower @ above
            inverse, negative = _inverse(_mirrored(diagonal) - ahead @ lower.T)
            border = border - ahead @ border_above
            schur = schur - border.T @ inverse @ border
            return (inverse, border, schur, count + negative), (inverse, border)

        zeros = jnp.zeros((w, w + r), storage.dtype)
        carry = (zeros[:, :w], zeros[:, w:], _mirrored(corner), jnp.zeros((), jnp.int32))
        (_, _, schur, count), (inverse, border) = lax.scan(eliminate, carry, (diagonal, lower, border))
        corner, negative = _inverse(schur)
        return BorderedFactor(inverse, lower, border, corner), count + negative

    def solve_indefinite(self, layout: Layout, factor: BorderedFactor, rhs: jax.Array) -> jax.Array:
        b, w, _ = layout.blocks
        inner, outer = rhs[: b * w].reshape(b, w), rhs[b * w :]

        def forward(above: jax.Array, block: Any) -> Any:
            inverse, lower, right = block
            y = right - lower @ above
            return inverse @ y, y

        _, inner = lax.scan(forward, jnp.zeros(w, rhs.dtype), (factor.pivot, factor.lower, inner))
        outer = outer - jnp.einsum("bwr,bwv,bv->r", factor.border, factor.pivot, inner)
        outer = factor.corner @ outer
        inner = inner - factor.border @ outer

        def backward(carry: jax.Array, block: Any) -> Any:
            inverse, lower, right = block
            y = inverse @ (right - carry)
            return lower.T @ y, y

        _, inner = lax.scan(backward, jnp.zeros(w, rhs.dtype), (factor.pivot, factor.lower, inner), reverse=True)
        return jnp.concatenate([inner.reshape(b * w), outer])


def _pieces(layout: Layout, storage: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Diagonal and lower blocks `(b, w, w)`, border `(b, w, r)` and corner `(r, r)` of a stored matrix."""
    b, w, r = layout.blocks
    diagonal, lower, border, corner = jnp.split(storage, np.cumsum([b * w * w, b * w * w, b * w * r]))
    return diagonal.reshape(b, w, w), lower.reshape(b, w, w), border.reshape(b, w, r), corner.reshape(r, r)


# Up to this width a loop is faster than a call of a matrix product.
LOOPED = 64


def _times(rows: jax.Array, matrix: jax.Array) -> jax.Array:
    """The product of a few rows `(k, w)` with a square matrix."""
    if len(matrix) > LOOPED:
        return rows @ matrix
    return jnp.sum(rows[:, :, None] * matrix, axis=1)


def _mirrored(matrix: jax.Array) -> jax.Array:
    """A symmetric matrix of which the lower triangle is stored."""
    return jnp.tril(matrix) + jnp.tril(matrix, -1).T


def _inverse(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Inverse of a symmetric matrix, and how many of its eigenvalues are negative."""
    values, vectors = jnp.linalg.eigh(matrix)
    return (vectors / values) @ vectors.T, jnp.sum(values < 0, dtype=jnp.int32)


@lru_cache(maxsize=32)
def _bordered_layout(topology: Topology) -> Layout:
    fixed = topology.fixed.array
    count, d = fixed.shape
    free = np.logical_not(fixed.all(axis=1))
    block = _blocks(topology)
    border_nodes = _border(topology, block)
    on_border = np.zeros(count, bool)
    on_border[border_nodes] = True
    inner = free & ~on_border

    coordinate_block = np.repeat(np.where(inner, block, -1), d)
    coordinate_block[fixed.ravel()] = -1
    order = np.argsort(coordinate_block, kind="stable")
    order = order[coordinate_block[order] >= 0]
    owner = coordinate_block[order]
    starts = np.searchsorted(owner, np.arange(owner.max() + 1)) if owner.size else np.zeros(1, int)
    within = np.arange(owner.size) - starts[owner]
    b, w = (int(owner.max()) + 1, int(within.max()) + 1) if owner.size else (1, 1)
    outer = np.flatnonzero(np.repeat(on_border, d) & ~fixed.ravel())
    r = outer.size

    size = b * w + r
    slots = np.full(size, count * d)
    slots[owner * w + within] = order
    slots[b * w :] = outer
    position = np.full(count * d, size)
    used = slots < count * d
    position[slots[used]] = np.flatnonzero(used)

    total = 2 * b * w * w + b * w * r + r * r
    lower_at, border_at, corner_at = b * w * w, 2 * b * w * w, 2 * b * w * w + b * w * r
    scatter = []
    for stencil in topology.stencils:
        p, q = _stencil_pairs(position[_coordinates(stencil.array, topology)])
        bp, bq, sp, sq = p // w, q // w, p % w, q % w
        inside = p < b * w
        if (inside & (bp - bq > 1)).any():
            raise AssertionError("a stencil couples blocks that are not neighbours")
        place = np.where(bp == bq, 0, lower_at) + (bp * w + sp) * w + sq
        place = np.where(inside, place, border_at + q * r + (p - b * w))
        place = np.where(q < b * w, place, corner_at + (p - b * w) * r + (q - b * w))
        scatter.append(np.where(p < size, place, total))
    inner_slot = np.arange(b * w)
    diagonal = np.concatenate([inner_slot * w + inner_slot % w, corner_at + np.arange(r) * (r + 1)])
    empty = np.zeros(total, bool)
    empty[diagonal[~used]] = True
    return _device_layout(slots, position, scatter, diagonal, empty, (b, w, r))


@lru_cache(maxsize=32)
def _blocks(topology: Topology) -> np.ndarray:
    """Block of each node: breadth-first levels, narrow neighbours merged. The cheapest of a few roots."""
    fixed = topology.fixed.array
    neighbours = _adjacency(fixed.shape[0], topology.elements.array)
    weight = (~fixed).sum(axis=1)
    roots: list[np.ndarray] = []
    held = np.flatnonzero(fixed.any(axis=1))
    if held.size:
        pieces = _components(held, neighbours)
        roots += [held, *pieces[:4]] if len(pieces) > 1 else [held]
    far = _levels(np.array([0]), neighbours)
    end = _levels(np.flatnonzero(far == far.max())[:1], neighbours)
    roots += [np.flatnonzero(end == end.max())[:1], np.flatnonzero(end == end.max())]
    best, best_cost = np.zeros(0, int), np.inf
    for root in roots:
        block = _merge(_levels(root, neighbours), weight)
        width = np.bincount(block, weight).max()
        cost = (block.max() + 1) * width**3
        if cost < best_cost:
            best, best_cost = block, cost
    return best


def _merge(level: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Join neighbouring levels while they fit the width of the widest, so that less is padding."""
    widths = np.bincount(level, weight)
    limit, block, filled = widths.max(), np.zeros(len(widths), int), 0.0
    for k, width in enumerate(widths):
        fits = filled + width <= limit
        block[k] = (block[k - 1] if k else 0) + (0 if fits else 1)
        filled = filled + width if fits else width
    return block[level]


def _adjacency(count: int, elements: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours of each node in compressed rows: `(start, neighbour)`."""
    k = elements.shape[1]
    i, j = np.nonzero(~np.eye(k, dtype=bool))
    pairs = np.unique(elements[:, i].ravel().astype(np.int64) * count + elements[:, j].ravel())
    return np.searchsorted(pairs // count, np.arange(count + 1)), pairs % count


def _levels(root: np.ndarray, neighbours: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Breadth-first level of each node; a further piece of the mesh continues the count."""
    start, neighbour = neighbours
    level = np.full(start.size - 1, -1)
    front, depth, seen = np.asarray(root), 0, 0
    while True:
        level[front] = depth
        depth += 1
        degree = start[front + 1] - start[front]
        at = np.repeat(start[front] - np.cumsum(degree) + degree, degree) + np.arange(degree.sum())
        reached = neighbour[at]
        front = np.unique(reached[level[reached] < 0])
        if not front.size:
            while seen < level.size and level[seen] >= 0:
                seen += 1
            if seen == level.size:
                return level
            front = np.array([seen])


def _components(nodes: np.ndarray, neighbours: tuple[np.ndarray, np.ndarray]) -> list[np.ndarray]:
    """The connected groups of a subset of the nodes."""
    start, neighbour = neighbours
    left, groups = set(nodes.tolist()), []
    while left:
        stack, group = [min(left)], []
        left.discard(stack[0])
        while stack:
            node = stack.pop()
            group.append(node)
            found = left.intersection(neighbour[start[node] : start[node + 1]].tolist())
            left -= found
            stack.extend(found)
        groups.append(np.array(sorted(group)))
    return groups


def _border(topology: Topology, block: np.ndarray) -> np.ndarray:
    """Nodes to eliminate last, so that every stencil keeps to two neighbouring blocks."""
    free = np.logical_not(topology.fixed.array.all(axis=1))
    border: set[int] = set()
    for stencil in topology.stencils:
        nodes = stencil.array
        low = np.where(free[nodes], block[nodes], np.iinfo(np.int64).max).min(axis=1)
        high = np.where(free[nodes], block[nodes], -1).max(axis=1)
        for k in np.flatnonzero(high - low > 1):
            members = [n for n in dict.fromkeys(nodes[k].tolist()) if free[n] and n not in border]
            # Keep the pair of blocks that holds most of the stencil; the others go to the border.
            owner = {n: int(block[n]) for n in members}
            pairs = ([n for n in members if first <= owner[n] <= first + 1] for first in sorted(set(owner.values())))
            kept = max(pairs, key=len, default=[])
            border.update(set(members) - set(kept))
    return np.array(sorted(border), int)


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


def _device_layout(
    slots: np.ndarray,
    position: np.ndarray,
    scatter: list[np.ndarray],
    diagonal: np.ndarray,
    empty: np.ndarray,
    blocks: tuple[int, int, int],
) -> Layout:
    if empty.size >= 2**31 - 1:
        raise ValueError(
            f"mesh: its factor would hold {empty.size} numbers, more than 32-bit indices address; use a coarser mesh"
        )
    index = lambda a: to_device(a, np.int32)
    places = tuple(index(s.T) for s in scatter)
    return Layout(index(slots), index(position), places, index(diagonal), to_device(empty), blocks)
