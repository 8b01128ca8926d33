"""Order of elimination of a mesh's nodes: nested dissection (George 1973) and the fronts it leads to.

A separator splits the nodes in two parts that do not couple; it is eliminated after both, and each part is split again,
down to leaves of a few nodes. So the nodes form a binary tree. Small nodes of the tree are then joined with those above
where that is expected to save time.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from jaxbeam.chain import Topology, breadth_first_levels

# Rows of a tile. Microseconds to subtract a product of tiles, to invert a tile, to add to one what a front below passes
# on, and that a front costs besides (one core of a Xeon of 2023). A second, larger size for large fronts gains a tenth
# at 200,000 unknowns, but compiles for twice as long.
TILE = 32
PRODUCT, PIVOT, EXTEND, FRONT = 4.5, 13.0, 1.5, 4.0
# Directions of the cuts tried, from the longest axis of a region, and shares of its nodes on one side.
ANGLES = np.linspace(-0.8, 0.8, 9)
SHARES = (0.5, 0.46, 0.54)


class Fronts(NamedTuple):
    """Fronts in order of elimination: each after all below it, those of a part of the tree together.

    front, rank `(n,)`: front and place in the order of elimination of each node; -1 and `n` if it is fixed.
    parent: front above each front; -1 if none.
    head_front, head_node: the further nodes of all fronts, sorted by front and rank.
    """

    front: np.ndarray
    rank: np.ndarray
    parent: np.ndarray
    head_front: np.ndarray
    head_node: np.ndarray


class Couplings(NamedTuple):
    """Pairs of nodes `first <= later` that couple, each node with itself too.

    uses: for each term, the pairs `(m, k, k)` of its stencils.
    """

    first: np.ndarray
    later: np.ndarray
    uses: list[np.ndarray]


def fronts(topology: Topology, leaf: int, join: bool, pairs: Couplings) -> Fronts:
    """Fronts of all nodes that are not fixed."""
    fixed = topology.fixed.array
    n = len(fixed)
    dofs = (~fixed).sum(axis=1)
    level, index, depth = _dissect(topology, leaf)
    free = level >= 0
    heap = np.where(free, 2 ** np.maximum(level, 0) - 1 + index, -1)
    rank = _rank(np.lexsort((np.arange(n), index, -level)), free)
    head_heap, head_node = _heads(heap, level, rank, depth, pairs)
    count = 2 ** (depth + 1) - 1
    s = np.bincount(heap[free], dofs[free], minlength=count).astype(int)
    u = np.bincount(head_heap, dofs[head_node], minlength=count).astype(int)
    into, parent = _join(s, u, join)
    tier = np.floor(np.log2(np.arange(count) + 1.5)).astype(int)
    end = (np.arange(count) + 2 - 2**tier) << (depth - tier)
    order = np.lexsort((-tier, end))
    order = order[into[order] == order]
    number = np.full(count + 1, -1)
    number[order] = np.arange(order.size)
    front = np.where(free, number[into[heap]], -1)
    rank = _rank(np.lexsort((np.arange(n), front)), free)
    kept = into[head_heap] == head_heap
    head_front, head_node = number[head_heap[kept]], head_node[kept]
    sort = np.lexsort((rank[head_node], head_front))
    return Fronts(front, rank, number[parent[order]], head_front[sort], head_node[sort])


def running(group: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """Sum of the amounts before each item in its group; groups are contiguous."""
    if not group.size:
        return np.zeros(0, int)
    total = np.cumsum(amount) - amount
    new = np.flatnonzero(np.append(True, group[1:] != group[:-1]))
    return total - np.repeat(total[new], np.diff(np.append(new, group.size)))


def _rank(order: np.ndarray, free: np.ndarray) -> np.ndarray:
    order = order[free[order]]
    rank = np.full(free.size, free.size)
    rank[order] = np.arange(order.size)
    return rank


def couplings(topology: Topology) -> Couplings:
    """The pairs of nodes that share a stencil, and where each stencil's are among them."""
    n = topology.fixed.array.shape[0]
    keys = [np.arange(n) * (n + 1)]
    for stencil in topology.stencils:
        row, column = np.broadcast_arrays(stencil.array[:, :, None], stencil.array[:, None, :])
        keys.append((np.minimum(row, column).astype(np.int64) * n + np.maximum(row, column)).ravel())
    key, inverse = np.unique(np.concatenate(keys), return_inverse=True)
    parts = np.split(inverse, np.cumsum([a.size for a in keys]))[1:-1]
    shapes = [(*stencil.array.shape, stencil.array.shape[1]) for stencil in topology.stencils]
    return Couplings(key // n, key % n, [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)])


def _heads(
    heap: np.ndarray, level: np.ndarray, rank: np.ndarray, depth: int, pairs: Couplings
) -> tuple[np.ndarray, np.ndarray]:
    """The later nodes that a front or anything below it couples to: pairs `(front, node)`, sorted by front."""
    n = rank.size
    node = np.full(n + 1, n)
    node[rank] = np.arange(n)
    swap = rank[pairs.first] > rank[pairs.later]
    first, later = np.where(swap, pairs.later, pairs.first), np.where(swap, pairs.first, pairs.later)
    outer = (heap[first] != heap[later]) & (rank[later] < n)
    first, later = first[outer], later[outer]
    passed = np.zeros(0, int)
    parts = []
    for tier in range(depth, -1, -1):
        here = level[first] == tier
        head = np.unique(np.concatenate([passed, heap[first[here]] * n + rank[later[here]]]))
        parts.append((head // n, node[head % n]))
        front, to = parts[-1]
        up = level[to] < tier - 1
        passed = (front[up] - 1) // 2 * n + rank[to[up]]
    return np.concatenate([f for f, _ in reversed(parts)]), np.concatenate([v for _, v in reversed(parts)])


def _join(s: np.ndarray, u: np.ndarray, save: bool) -> tuple[np.ndarray, np.ndarray]:
    """Join fronts of `s` pivots and `u` further unknowns with the one above while that saves time.

    Without `save`, only empty ones are joined. Returns the front that each becomes part of, and the front above it, -1
    if none.
    """
    count = s.size
    pivots, rest = s.tolist(), u.tolist()
    into, above = np.arange(count), np.full(count, -1)
    below: list[list[int]] = [[] for _ in range(count)]
    for f in range(count - 1, -1, -1):
        below[f] = [c for c in (2 * f + 1, 2 * f + 2) if c < count]
        waiting = sorted(below[f], key=lambda c: rest[c])
        while waiting:
            c = waiting.pop(0)
            apart = _cost(pivots[f], rest[f]) + _cost(pivots[c], rest[c])
            if pivots[c] and not (save and _cost(pivots[f] + pivots[c], rest[f]) <= apart):
                continue
            pivots[f] += pivots[c]
            into[c] = f
            below[f] = [b for b in below[f] if b != c] + below[c]
            waiting += below[c]
    for f in range(count):
        if into[f] == f:
            above[below[f]] = f
        else:
            into[f] = into[into[f]]
    return into, above


@cache
def _cost(s: int, u: int) -> float:
    """Time to eliminate a front."""
    p, q = -(-s // TILE), -(-u // TILE)
    # A product for each tile below a pivot, for each column before one, and for each pivot and tile of the rest.
    products = p * (p - 1) // 2 + p * q + (p - 1) * p * (p + 1) // 6 + q * p * (p - 1) // 2 + p * q * (q + 1) // 2
    return FRONT + PRODUCT * products + PIVOT * p + EXTEND * (q + 1) ** 2


def _dissect(topology: Topology, leaf: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Level and place in it of the tree's node that each node belongs to (-1 if it is fixed), and the depth."""
    fixed = topology.fixed.array
    n = fixed.shape[0]
    free = np.flatnonzero(~fixed.all(axis=1))
    number = np.full(n, -1)
    number[free] = np.arange(free.size)
    k = topology.elements.array.shape[1]
    a, b = np.nonzero(~np.eye(k, dtype=bool))
    elements = number[topology.elements.array]
    i, j = elements[:, a].ravel(), elements[:, b].ravel()
    keep = (i >= 0) & (j >= 0)
    key = np.unique(i[keep].astype(np.int64) * free.size + j[keep])
    i, j = key // free.size, key % free.size
    unknowns = int((~fixed).sum())
    depth = max(0, round(np.log2(max(unknowns, 1) / leaf)))
    places = _embed(free.size, i, j)
    level, index = _bisect(places, i, j, depth)
    levels, indices = np.full(n, -1), np.zeros(n, int)
    levels[free], indices[free] = level, index
    _raise_far(topology, levels, indices)
    return levels, indices, depth


def _embed(n: int, i: np.ndarray, j: np.ndarray, pivots: int = 10) -> np.ndarray:
    """Coordinates `(n, pivots)` of the nodes of a graph: distances to a few far nodes (Harel and Koren 2002)."""
    start = np.searchsorted(i, np.arange(n + 1))
    distances = lambda root: breadth_first_levels(np.array([root]), (start, j))
    root = int(distances(0).argmax())
    nearest = np.full(n, n + 1)
    columns = []
    for _ in range(pivots):
        columns.append(distances(root))
        nearest = np.minimum(nearest, columns[-1])
        root = int(nearest.argmax())
    return np.stack(columns, axis=1).astype(float)


def _bisect(places: np.ndarray, i: np.ndarray, j: np.ndarray, depth: int) -> tuple[np.ndarray, np.ndarray]:
    """Level and index of the front of each node; all regions of one level of the tree are split at a time."""
    n = len(places)
    i, j = i[i < j], j[i < j]
    level, region, index = np.full(n, depth), np.zeros(n, int), np.zeros(n, int)
    for tier in range(depth):
        active = np.flatnonzero(level == depth)
        inside = (level[i] == depth) & (level[j] == depth)
        inside &= region[i] == region[j]
        i, j = i[inside], j[inside]
        mine = region[active]
        size = np.bincount(mine, minlength=2**tier)
        begin = np.cumsum(size) - size
        plane = _principal(places[active], mine, size)
        least = np.full(2**tier, np.inf)
        side, cut = np.zeros(n, int), np.zeros(n, bool)
        for angle in ANGLES:
            along = plane @ np.array([np.cos(angle), np.sin(angle)])
            order = active[np.lexsort((along, mine))]
            rank = np.arange(order.size) - begin[region[order]]
            for share in SHARES:
                half = np.zeros(n, int)
                half[order] = rank >= share * size[region[order]]
                touched = np.zeros(n, bool)
                crossing = half[i] != half[j]
                touched[i[crossing]] = touched[j[crossing]] = True
                for which in (0, 1):
                    separator = touched & (half == which)
                    number = np.bincount(region[separator], minlength=2**tier)
                    cost = number * (1 + 0.5 * abs(share - 0.5))
                    better = (cost < least)[region]
                    least = np.minimum(cost, least)
                    side[better], cut[better] = half[better], separator[better]
        chosen = cut & (level == depth)
        level[chosen], index[chosen] = tier, region[chosen]
        region = 2 * region + side
    rest = level == depth
    index[rest] = region[rest]
    return level, index


def _principal(places: np.ndarray, region: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Coordinates `(n, 2)` along the two principal axes of each region."""
    dimensions = places.shape[1]
    total = lambda values: np.bincount(region, values, minlength=size.size)
    mean = np.stack([total(column) for column in places.T], axis=1) / np.maximum(size, 1)[:, None]
    offset = places - mean[region]
    inertia = np.empty((size.size, dimensions, dimensions))
    for a in range(dimensions):
        for b in range(a + 1):
            inertia[:, a, b] = total(offset[:, a] * offset[:, b])
    axes = np.linalg.eigh(inertia)[1][:, :, :-3:-1]
    return np.einsum("nk,nka->na", offset, axes[region])


def _raise_far(topology: Topology, level: np.ndarray, index: np.ndarray) -> None:
    """Move nodes to the root so that the nodes of each stencil lie on one path from it."""
    for stencil in topology.stencils:
        nodes = stencil.array
        if nodes.shape[1] < 2:
            continue
        rows = np.arange(len(nodes))
        deepest = nodes[rows, level[nodes].argmax(axis=1)]
        low, at = level[deepest][:, None], index[deepest][:, None]
        off = (level[nodes] >= 0) & ((at >> np.maximum(low - level[nodes], 0)) != index[nodes])
        level[nodes[off]], index[nodes[off]] = 0, 0
