"""Sparse factorisation of large meshes: multifrontal Cholesky on a nested dissection (Duff and Reid 1983).

The nodes form a tree of fronts (`jaxbeam.ordering`). A front is a dense symmetric matrix of its own unknowns, the
pivots, and of the later ones that they or anything below them couple to:

    P = [ A   B^T ]    A = L L^T,  H = B L^-T,  S = C - H H^T.
        [ B   C   ]

`S` is added to the front above. Each front is cut into square tiles; the last one of the pivots is filled up with a
unit matrix. Tiles are eliminated one by one in loops whose lengths are data, so the program is the same for all meshes
and small enough to compile in seconds. Only tiles of the lower triangle are kept, column by column; on the diagonal of
the pivots it is the inverse `W` of the tile's Cholesky factor. Above the diagonal, tiles hold anything.

Time grows as `N^1.5` and storage as `N log N`, against `N^2` and `N^1.5` of a block-tridiagonal matrix.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam import checks
from jaxbeam._tree import pytree, static_field, to_device
from jaxbeam.chain import Topology, chain_of, multiplications
from jaxbeam.linear import BlockTridiagonal
from jaxbeam.ordering import TILE, Couplings, Fronts, couplings, fronts, running

# Work of the block-tridiagonal solver, in multiplications, above which nested dissection is faster. See
# `choose_solver`.
CROSSOVER = 0.3e9
# Triangular tiles up to this size are inverted by LAPACK, larger ones by halves.
SMALL = 16
# Place of what a front below has not: past the end of the room for `S`, which is read as its last number, a zero.
NONE = 2**29
AREA = TILE * TILE
# XLA 0.10 subtracts arrays of this many columns in a quarter of the time that square tiles take.
LANES = 8
# Columns of `DissectionLayout.front`.
PIVOTS, TILES, FACTOR, UPDATE, ROWS, FIRST, LAST = range(7)


@pytree
class DissectionLayout:
    """As `jaxbeam.linear.Layout`, with fronts of tiles instead of blocks.

    place `(size,)`: where in the factor each stored entry goes.
    front `(fronts, 7)`: tiles of pivots and of all; where its factor, `S` and `rows` begin; range of `edge`.
    rows: unknown of each row of each front; `N` in the padding.
    edge: of each front that has one above, grouped by the front above it, where its part of `row` begins.
    row, column: for each row of the front above, what to add to find it as row or as column of `S` below.
    sizes: of the factor, of the room for `S` and of a row of tiles of pivots.
    """

    slots: jax.Array
    position: jax.Array
    scatter: tuple[jax.Array, ...]
    diagonal: jax.Array
    empty: jax.Array
    place: jax.Array
    front: jax.Array
    rows: jax.Array
    edge: jax.Array
    row: jax.Array
    column: jax.Array
    sizes: tuple[int, int, int] = static_field()


class Factor(NamedTuple):
    """Tiles of all fronts, and signs `(N,)` of the eigenvalues of pivot tiles (none if it is definite)."""

    tiles: jax.Array
    sign: jax.Array | None


@dataclasses.dataclass(frozen=True)
class NestedDissection:
    """Multifrontal Cholesky over a nested dissection of the mesh: for meshes of many thousand unknowns.

    leaf: about how many unknowns a part has that is not split further.
    join: join small parts again where that is expected to save time.
    """

    leaf: int = 48
    join: bool = True

    def __post_init__(self) -> None:
        checks.count("leaf", self.leaf, 1)
        checks.flag("join", self.join)

    def layout(self, topology: Topology) -> DissectionLayout:
        return _layout(topology, self.leaf, self.join)

    def factor(self, layout: DissectionLayout, storage: jax.Array) -> tuple[Factor, jax.Array]:
        factor, bad = _factor(layout, storage, True)
        return factor, bad == 0

    def pivots(self, layout: DissectionLayout, factor: Factor) -> jax.Array:
        # Pivot tiles are stored inverted, where the stiffness was.
        return factor.tiles[layout.place[layout.diagonal]] ** -2

    def solve(self, layout: DissectionLayout, factor: Factor, rhs: jax.Array) -> jax.Array:
        return _solve(layout, factor, rhs)

    def factor_indefinite(self, layout: DissectionLayout, storage: jax.Array) -> tuple[Factor, jax.Array]:
        """Pivot tiles are inverted through their eigenvalues; the inertia is the sum of theirs (Haynsworth 1968)."""
        return _factor(layout, storage, False)

    def solve_indefinite(self, layout: DissectionLayout, factor: Factor, rhs: jax.Array) -> jax.Array:
        return _solve(layout, factor, rhs)


# ------------------------------------------------------------------------------------------- numbers


def _tile(pool: jax.Array, at: jax.Array) -> jax.Array:
    return lax.dynamic_slice_in_dim(pool, at, AREA).reshape(TILE, TILE)


def _put(pool: jax.Array, tile: jax.Array, at: jax.Array) -> jax.Array:
    return lax.dynamic_update_slice_in_dim(pool, tile.ravel(), at, 0)


def _loop(first: Any, last: Any, body: Any, carry: Any) -> Any:
    return lax.fori_loop(jnp.int32(first), jnp.int32(last), body, carry)


def _at(i: Any, j: Any, tiles: Any) -> Any:
    """Number of tile `(i, j)` of a lower triangle of so many rows of tiles, stored by columns."""
    return j * tiles - j * (j + 1) // 2 + i


def _inverse_triangle(lower: jax.Array) -> jax.Array:
    size = len(lower)
    if size <= SMALL:
        eye = jnp.eye(size, dtype=lower.dtype)
        return lax.linalg.triangular_solve(lower, eye, left_side=True, lower=True)
    half = size // 2
    first, second = _inverse_triangle(lower[:half, :half]), _inverse_triangle(lower[half:, half:])
    return jnp.block([[first, jnp.zeros_like(first)], [-second @ (lower[half:, :half] @ first), second]])


def _cholesky_pivot(a: jax.Array) -> tuple[jax.Array, None, jax.Array]:
    """`W` with `a^-1 = W^T W`, and 1 if there is none; the lower triangle is read."""
    w = _inverse_triangle(jnp.linalg.cholesky(a, symmetrize_input=False))
    return w, None, (~jnp.isfinite(w[-1, -1])).astype(jnp.int32)


def _any_pivot(a: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`W` and signs `d` with `a^-1 = W^T d W`, and the number of negative ones."""
    values, vectors = jnp.linalg.eigh(a, symmetrize_input=False)
    sign = jnp.where(values < 0, -1, 1).astype(a.dtype)
    return (vectors / jnp.sqrt(jnp.abs(values))).T, sign, jnp.sum(values < 0, dtype=jnp.int32)


def _factor(layout: DissectionLayout, storage: jax.Array, definite: bool) -> tuple[Factor, jax.Array]:
    """The factor, and how many pivot tiles failed or, if it may be indefinite, eigenvalues are negative."""
    tiles = jnp.zeros(layout.sizes[0], storage.dtype).at[layout.place].set(storage, mode="drop", unique_indices=True)
    updates = jnp.zeros(layout.sizes[1], storage.dtype)
    sign = None if definite else jnp.ones(layout.slots.size, storage.dtype)
    work = jnp.zeros(layout.sizes[2], storage.dtype)
    carry = (tiles, updates, work, sign, jnp.int32(0))
    tiles, _, _, sign, count = _loop(0, len(layout.front), partial(_eliminate, layout, definite), carry)
    return Factor(tiles, sign), count


def _eliminate(layout: DissectionLayout, definite: bool, f: jax.Array, carry: Any) -> Any:
    """Eliminate the pivots of a front."""
    info = layout.front[f]
    pivots, total = info[PIVOTS], info[TILES]
    place = lambda i, j: info[FACTOR] + AREA * _at(i, j, total)

    def right(j: jax.Array, columns: jax.Array, carry: Any) -> Any:
        """Transpose row `j` of tiles once for all products with it."""
        tiles, updates, work, sign, count = carry

        def put(q: jax.Array, work: jax.Array) -> jax.Array:
            tile = _tile(tiles, place(j, q)).T
            if not definite:
                tile = tile * lax.dynamic_slice_in_dim(sign, layout.rows[info[ROWS] + q * TILE], TILE)[:, None]
            return _put(work, tile, AREA * q)

        return tiles, updates, _loop(0, columns, put, work), sign, count

    def reduced(a: jax.Array, i: jax.Array, j: jax.Array, columns: jax.Array, carry: Any) -> jax.Array:
        """Tile `a` with what the fronts below pass on, less the products of the columns before it."""
        tiles, updates, work, _, _ = carry
        a = _loop(info[FIRST], info[LAST], lambda e, a: a + _extend(layout, updates, e, i, j), a)
        product = lambda q: (_tile(tiles, place(i, q)) @ _tile(work, AREA * q)).reshape(-1, LANES)
        return _loop(0, columns, lambda q, a: a - product(q), a.reshape(-1, LANES)).reshape(TILE, TILE)

    def pivot(j: jax.Array, carry: Any) -> Any:
        tiles, updates, work, sign, count = carry = right(j, j, carry)
        a = reduced(_tile(tiles, place(j, j)), j, j, j, carry)
        w, d, bad = (_cholesky_pivot if definite else _any_pivot)(a)
        tiles, work = _put(tiles, w, place(j, j)), _put(work, w.T, AREA * j)
        if d is not None:
            sign = lax.dynamic_update_slice_in_dim(sign, d, layout.rows[info[ROWS] + j * TILE], 0)

        def below(i: jax.Array, carry: Any) -> Any:
            a = reduced(_tile(carry[0], place(i, j)), i, j, j, carry)
            return (_put(carry[0], a @ _tile(carry[2], AREA * j), place(i, j)), *carry[1:])

        return _loop(j + 1, total, below, (tiles, updates, work, sign, count + bad))

    def rest(j: jax.Array, carry: Any) -> Any:
        carry = right(j, pivots, carry)

        def row(i: jax.Array, carry: Any) -> Any:
            a = reduced(jnp.zeros((TILE, TILE), carry[0].dtype), i, j, pivots, carry)
            at = info[UPDATE] + AREA * _at(i - pivots, j - pivots, total - pivots)
            return (carry[0], _put(carry[1], a, at), *carry[2:])

        return _loop(j, total, row, carry)

    return _loop(pivots, total, rest, _loop(0, pivots, pivot, carry))


def _extend(layout: DissectionLayout, updates: jax.Array, e: jax.Array, i: jax.Array, j: jax.Array) -> jax.Array:
    """What a front below adds to tile `(i, j)`."""
    row = lax.dynamic_slice_in_dim(layout.row, layout.edge[e] + i * TILE, TILE)
    column = lax.dynamic_slice_in_dim(layout.column, layout.edge[e] + j * TILE, TILE)
    return updates.at[row[:, None] + column].get(mode="promise_in_bounds")


def _solve(layout: DissectionLayout, factor: Factor, rhs: jax.Array) -> jax.Array:
    x = jnp.pad(rhs.reshape(len(rhs), -1), ((0, 1), (0, 0)))
    count = len(layout.front)
    x = _loop(0, count, partial(_forward, layout, factor), x)
    x = _loop(0, count, lambda t, x: _backward(layout, factor, count - 1 - t, x), x)
    return x[:-1].reshape(rhs.shape)


def _parts(layout: DissectionLayout, factor: Factor, f: jax.Array) -> Any:
    """Numbers of tiles of a front, and functions for its tile `(i, j)`, its rows and the pivots' signs."""
    info = layout.front[f]
    tile = lambda i, j: _tile(factor.tiles, info[FACTOR] + AREA * _at(i, j, info[TILES]))
    rows = lambda i: lax.dynamic_slice_in_dim(layout.rows, info[ROWS] + i * TILE, TILE)
    signed = lambda j, y: y if factor.sign is None else y * factor.sign[rows(j)][:, None]
    return info[PIVOTS], info[TILES], tile, rows, signed


def _forward(layout: DissectionLayout, factor: Factor, f: jax.Array, x: jax.Array) -> jax.Array:
    pivots, total, tile, rows, signed = _parts(layout, factor, f)
    own = lambda j, x: lax.dynamic_slice_in_dim(x, rows(j)[0], TILE)

    def known(i: jax.Array, last: jax.Array, x: jax.Array) -> jax.Array:
        start = jnp.zeros((TILE, x.shape[1]), x.dtype)
        return _loop(0, last, lambda j, y: y + tile(i, j) @ signed(j, own(j, x)), start)

    def pivot(j: jax.Array, x: jax.Array) -> jax.Array:
        y = tile(j, j) @ (own(j, x) - known(j, j, x))
        return lax.dynamic_update_slice_in_dim(x, y, rows(j)[0], 0)

    def row(i: jax.Array, x: jax.Array) -> jax.Array:
        return x.at[rows(i)].add(-known(i, pivots, x), mode="promise_in_bounds")

    return _loop(pivots, total, row, _loop(0, pivots, pivot, x))


def _backward(layout: DissectionLayout, factor: Factor, f: jax.Array, x: jax.Array) -> jax.Array:
    pivots, total, tile, rows, signed = _parts(layout, factor, f)

    def pivot(t: jax.Array, x: jax.Array) -> jax.Array:
        j = pivots - 1 - t
        known = lambda i, y: y + tile(i, j).T @ x.at[rows(i)].get(mode="promise_in_bounds")
        later = _loop(j + 1, total, known, jnp.zeros((TILE, x.shape[1]), x.dtype))
        own = lax.dynamic_slice_in_dim(x, rows(j)[0], TILE)
        return lax.dynamic_update_slice_in_dim(x, tile(j, j).T @ signed(j, own - later), rows(j)[0], 0)

    return _loop(0, pivots, pivot, x)


# -------------------------------------------------------------------------------------------- layout


class _Plan(NamedTuple):
    """Of each front: how many tiles hold pivots and further unknowns, and where its factor, `S`, rows and first
    unknown are. Of each node: its first row in its front. Of each head: its first row in `S`. Then the sizes of
    the factor, of the room for `S`, of all rows, and the number of unknowns."""

    pivots: np.ndarray
    rest: np.ndarray
    factor: np.ndarray
    update: np.ndarray
    rows: np.ndarray
    unknown: np.ndarray
    within: np.ndarray
    inside: np.ndarray
    totals: tuple[int, int, int, int]


@lru_cache(maxsize=16)
def _layout(topology: Topology, leaf: int, join: bool) -> DissectionLayout:
    fixed = topology.fixed.array
    n, d = fixed.shape
    pairs = couplings(topology)
    tree = fronts(topology, leaf, join, pairs)
    plan = _plan(tree, (~fixed).sum(axis=1))
    size = plan.totals[3]
    coordinate = np.cumsum(~fixed, axis=1) - 1  # of a node's free coordinates
    unknown = np.where(fixed, size, (plan.unknown[tree.front] + plan.within)[:, None] + coordinate)
    position = unknown.ravel()
    slots = np.full(size, n * d)
    slots[position[position < size]] = np.flatnonzero(position < size)

    place, filling = _places(plan, tree, pairs, fixed, coordinate, slots == n * d)
    stored = place.size - filling.size
    diagonal = np.zeros(size, int)
    same = np.flatnonzero(pairs.first == pairs.later)
    blocks = (same * d * d)[:, None] + np.arange(d) * (d + 1)
    own = unknown[pairs.first[same]]
    diagonal[own[own < size]] = blocks[own < size]
    diagonal[filling] = stored + np.arange(filling.size)
    empty = np.arange(place.size) >= stored

    scatter = []
    for stencil, use in zip(topology.stencils, pairs.uses, strict=True):
        i, j = np.tril_indices(stencil.array.shape[1] * d)
        moving = ~fixed[stencil.array].reshape(len(use), -1)
        rank = tree.rank[stencil.array]
        block = use[:, i // d, j // d] * (d * d)
        within = np.where(rank[:, i // d] >= rank[:, j // d], i % d * d + j % d, j % d * d + i % d)
        scatter.append(np.where(moving[:, i] & moving[:, j], block + within, place.size))
    return _device_layout(slots, position, scatter, diagonal, empty, place, plan, tree, _rows(plan, tree, unknown))


def _plan(tree: Fronts, dofs: np.ndarray) -> _Plan:
    count, free = tree.parent.size, np.flatnonzero(tree.front >= 0)
    by_front = free[np.argsort(tree.rank[free])]
    within = np.zeros(tree.front.size, int)
    within[by_front] = running(tree.front[by_front], dofs[by_front])
    inside = running(tree.head_front, dofs[tree.head_node])
    s = np.bincount(tree.front[free], dofs[free], minlength=count).astype(int)
    u = np.bincount(tree.head_front, dofs[tree.head_node], minlength=count).astype(int)
    p, q = -(-s // TILE), -(-u // TILE)
    factor, rows, unknown = (np.cumsum(np.append(0, a)) for a in (_at(p, p, p + q) * AREA, (p + q) * TILE, p * TILE))
    update, room = _stacks(tree, _at(q, q, q) * AREA)
    # At least one tile, so that slices of it fit.
    totals = (max(int(factor[-1]), AREA), room + AREA, int(rows[-1]), int(unknown[-1]))
    return _Plan(p, q, factor[:-1], update, rows[:-1], unknown[:-1], within, inside, totals)


def _stacks(tree: Fronts, amount: np.ndarray) -> tuple[np.ndarray, int]:
    """Where `S` of each front begins, and how much room all need.

    Fronts come in postorder, so two stacks do, for even and odd levels of the tree: `S` is put on one while those of
    the fronts below are on top of the other.
    """
    count = amount.size
    level, first = [0] * count, [-1] * count  # and the first front below
    for f in range(count - 1, -1, -1):
        if tree.parent[f] >= 0:
            level[f], first[tree.parent[f]] = level[tree.parent[f]] + 1, f
    at, top, most = np.zeros(count, int), [0, 0], [0, 0]
    for f in range(count):
        k = level[f] % 2
        at[f] = top[k]
        top[k] += int(amount[f])
        most[k] = max(most[k], top[k])
        if first[f] >= 0:
            top[1 - k] = int(at[first[f]])
    return at + np.array([0, most[0]])[np.array(level) % 2], sum(most)


def _places(
    plan: _Plan, tree: Fronts, pairs: Couplings, fixed: np.ndarray, coordinate: np.ndarray, pad: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where in the factor the stored entries go: `d x d` for each pair of nodes, then the diagonal of the padding.

    Returns with it the unknowns of the padding.
    """
    swap = tree.rank[pairs.first] > tree.rank[pairs.later]
    first, later = np.where(swap, pairs.later, pairs.first), np.where(swap, pairs.first, pairs.later)
    f = tree.front[first]
    row = plan.within[later]
    far = (tree.front[later] != f) & (tree.rank[later] < tree.rank.size)
    row[far] = _head_rows(plan, tree, f[far], later[far])
    row = row[:, None, None] + coordinate[later][:, :, None]
    column = (plan.within[first][:, None] + coordinate[first])[:, None, :]
    known = ~(fixed[later][:, :, None] | fixed[first][:, None, :])
    place = np.where(known, _address(plan, f[:, None, None], row, column), plan.totals[0])
    filling = np.flatnonzero(pad)
    g = np.searchsorted(plan.unknown, filling, side="right") - 1
    c = filling - plan.unknown[g]
    return np.append(place.ravel(), _address(plan, g, c, c)), filling


def _address(plan: _Plan, f: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    tile = _at(row // TILE, column // TILE, (plan.pivots + plan.rest)[f])
    return plan.factor[f] + tile * AREA + row % TILE * TILE + column % TILE


def _head_rows(plan: _Plan, tree: Fronts, front: np.ndarray, node: np.ndarray) -> np.ndarray:
    """First row in a front of one of its further nodes."""
    n = tree.rank.size
    at = np.searchsorted(tree.head_front * n + tree.rank[tree.head_node], front * n + tree.rank[node])
    return plan.pivots[front] * TILE + plan.inside[at]


class _Rows(NamedTuple):
    """The index arrays of `DissectionLayout` of the same names."""

    rows: np.ndarray
    edge: np.ndarray
    ranges: np.ndarray
    row: np.ndarray
    column: np.ndarray


def _rows(plan: _Plan, tree: Fronts, unknown: np.ndarray) -> _Rows:
    """Unknown of each row of the fronts, and how rows of `S` correspond to those of the front above."""
    size = plan.totals[3]
    total = plan.pivots + plan.rest
    rows = np.full(plan.totals[2], size)
    own = np.repeat(plan.rows - plan.unknown, plan.pivots * TILE) + np.arange(size)
    rows[own] = np.arange(size)
    below = np.flatnonzero(tree.parent >= 0)
    below = below[np.argsort(tree.parent[below], kind="stable")]
    above = tree.parent[below]
    at = np.cumsum(np.append(0, total[above] * TILE))
    edge_of = np.zeros(total.size, int)
    edge_of[below] = np.arange(below.size)

    f, node = tree.head_front, tree.head_node
    p = tree.parent[f]
    up = plan.within[node]
    far = tree.front[node] != p
    up[far] = _head_rows(plan, tree, p[far], node[far])
    # At least one tile, so that slices of it fit.
    row, column = (np.full(max(int(at[-1]), TILE), NONE) for _ in range(2))
    number = np.zeros(f.size, int)
    for c in range(unknown.shape[1]):
        k = np.flatnonzero(unknown[node, c] < size)
        inner = plan.inside[k] + number[k]
        rows[plan.rows[f[k]] + (plan.pivots * TILE)[f[k]] + inner] = unknown[node[k], c]
        to = at[edge_of[f[k]]] + up[k] + number[k]
        row[to] = inner * TILE
        column[to] = plan.update[f[k]] + _at(0, inner // TILE, plan.rest[f[k]]) * AREA + inner % TILE
        number[k] += 1
    ranges = np.searchsorted(above, np.stack([np.arange(total.size), np.arange(total.size) + 1], axis=1))
    return _Rows(rows, at, ranges, row, column)


def _device_layout(
    slots: np.ndarray,
    position: np.ndarray,
    scatter: list[np.ndarray],
    diagonal: np.ndarray,
    empty: np.ndarray,
    place: np.ndarray,
    plan: _Plan,
    tree: Fronts,
    rows: _Rows,
) -> DissectionLayout:
    if max(plan.totals[0] // 4, plan.totals[1]) >= NONE:
        raise ValueError(f"mesh: its factor would hold {plan.totals[0]} numbers, too many; use a coarser mesh")
    front = np.stack([plan.pivots, plan.pivots + plan.rest, plan.factor, plan.update, plan.rows], axis=1)
    signed = lambda a: to_device(a, np.int32)
    # Unsigned, so that JAX does not look for negative ones.
    unsigned = lambda a: to_device(a, np.uint32)
    return DissectionLayout(
        signed(slots),
        signed(position),
        tuple(signed(a.T) for a in scatter),
        signed(diagonal),
        to_device(empty),
        unsigned(place),
        signed(np.concatenate([front, rows.ranges], axis=1)),
        signed(rows.rows),
        signed(rows.edge),
        unsigned(rows.row),
        unsigned(rows.column),
        (*plan.totals[:2], max(int(plan.pivots.max()), 1) * AREA),
    )


@lru_cache(maxsize=64)
def choose_solver(topology: Topology) -> BlockTridiagonal | NestedDissection:
    """The solver that is faster for a topology, by the `multiplications` of the block-tridiagonal one.

    Assembly, factor and solve on one core, in milliseconds (`python -m benchmarks.scaling`):

        beam         unknowns   multiplications   BlockTridiagonal   NestedDissection
        57 x 13      1,456      1.6e6             1.9                3.3
        113 x 25     5,600      2.3e7             12                 14
        225 x 49     21,952     3.5e8             137                69

    Compilation takes about 1.1 s for the first and 2.4 s for the second, and the layout of the largest 0.1 and 0.3 s.
    At the crossover, about 20,000 unknowns of a beam, 20 steps repay that.
    """
    chains = BlockTridiagonal()
    work = multiplications(chain_of(topology, chains.joined).shape)
    return chains if work < CROSSOVER else NestedDissection()


@dataclasses.dataclass(frozen=True)
class Automatic:
    """The default: `BlockTridiagonal` or `NestedDissection`, whichever is faster for the scene (`choose_solver`)."""

    def layout(self, topology: Topology) -> Any:
        return choose_solver(topology).layout(topology)

    def factor(self, layout: Any, storage: jax.Array) -> tuple[Any, jax.Array]:
        return _made(layout).factor(layout, storage)

    def pivots(self, layout: Any, factor: Any) -> jax.Array:
        return _made(layout).pivots(layout, factor)

    def solve(self, layout: Any, factor: Any, rhs: jax.Array) -> jax.Array:
        return _made(layout).solve(layout, factor, rhs)

    def factor_indefinite(self, layout: Any, storage: jax.Array) -> tuple[Any, jax.Array]:
        return _made(layout).factor_indefinite(layout, storage)

    def solve_indefinite(self, layout: Any, factor: Any, rhs: jax.Array) -> jax.Array:
        return _made(layout).solve_indefinite(layout, factor, rhs)


def _made(layout: Any) -> Any:
    """The solver that a layout is of."""
    return NestedDissection() if isinstance(layout, DissectionLayout) else BlockTridiagonal()
