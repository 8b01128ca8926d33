"""The order of unknowns for `BlockTridiagonal`: a chain of blocks in which each is coupled to its neighbours only.

Breadth-first levels of nodes from the clamp make the Hessian of any mesh block tridiagonal (the level structure of
Cuthill and McKee, 1969). Narrow levels are joined into one block. Unknowns that couple distant blocks, such as the free
ends of a long tendon, are moved to a border of a few columns. Plain NumPy, run once for each topology.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from jaxbeam.core.tree import Key


class Topology(NamedTuple):
    """What a layout depends on. Hashable.

    elements: `(t, k)`, nodes of each element.
    fixed: `(n, d)` booleans, true for coordinates that are held.
    stencils: for each term, `(m, k)`, nodes of each stencil.
    """

    elements: Key
    fixed: Key
    stencils: tuple[Key, ...]


# Blocks that a node is coupled to: the one before, neither, both, the one after. Unknowns of a block are in this order.
BEFORE, NEITHER, BOTH, AFTER = range(4)


class Chain(NamedTuple):
    """A chain of blocks and its border.

    slots: `(N,)`, flat coordinate of each unknown, as in `Layout`.
    shape: `(b, w, head, tail, r)`, as `blocks` in `Layout`.
    """

    slots: np.ndarray
    shape: tuple[int, int, int, int, int]


# Cost of a block that does not depend on its width, in multiplications: LAPACK calls and loop steps. Measured.
PER_BLOCK = 40_000


def coupled(shape: tuple[int, int, int, int, int]) -> tuple[int, int]:
    """Rows and columns `(tall, wide)` of the coupling of a block to what is eliminated after it.

    The rows are the last `tail` of the block, or all `w` if there is a border. The columns are the first `head` of the
    next block and the `r` of the border.
    """
    _, w, head, tail, r = shape
    return (w if r else tail), head + r


def multiplications(shape: tuple[int, int, int, int, int]) -> float:
    """Multiplications of a factorisation with blocks of this shape (`Layout.blocks`).

    They are a Cholesky factorisation of each block, a triangular solve and a product for its coupling, and a Cholesky
    factorisation of the border.
    """
    b, w, _, _, r = shape
    tall, wide = coupled(shape)
    return b * (w**3 / 6 + tall**2 * wide / 2 + tall * wide**2) + r**3 / 6


@lru_cache(maxsize=32)
def chain_of(topology: Topology, joined: int) -> Chain:
    """The cheapest of several chains, made of breadth-first levels from a few roots.

    Args:
        topology: elements, fixed coordinates and stencils.
        joined: several levels may make a block of up to this many unknowns.
    """
    weight = (~topology.fixed.array).sum(axis=1)
    best = min(
        _level_structures(topology), key=lambda level: (level.max() + 1.0) * np.bincount(level, weight).max() ** 3
    )
    widest = int(np.bincount(best, weight).max())
    limits = {widest, *range(2 * widest, joined + 1, widest)}
    blocks = [_joined(best, weight, limit) for limit in limits]
    # Try both directions: two blocks may be coupled through few unknowns of one and all unknowns of the other.
    chains = [_chain(topology, each) for block in blocks for each in (block, block.max() - block)]
    return min(chains, key=lambda chain: multiplications(chain.shape) + PER_BLOCK * chain.shape[0])


def _level_structures(topology: Topology) -> list[np.ndarray]:
    """Breadth-first level of each node, for several roots.

    The roots are all held nodes; each of the first four connected groups of held nodes, if there are several; one node
    at an end of the mesh; and all nodes at that end.
    """
    fixed = topology.fixed.array
    neighbours = _adjacency(fixed.shape[0], topology.elements.array)
    roots: list[np.ndarray] = []
    held = np.flatnonzero(fixed.any(axis=1))
    if held.size:
        pieces = _components(held, neighbours)
        roots += [held, *pieces[:4]] if len(pieces) > 1 else [held]
    far = breadth_first_levels(np.array([0]), neighbours)
    end = breadth_first_levels(np.flatnonzero(far == far.max())[:1], neighbours)
    roots += [np.flatnonzero(end == end.max())[:1], np.flatnonzero(end == end.max())]
    return [breadth_first_levels(root, neighbours) for root in roots]


def _joined(level: np.ndarray, weight: np.ndarray, limit: float) -> np.ndarray:
    """Block of each node. Consecutive levels share a block while their weights add up to at most `limit`."""
    widths = np.bincount(level, weight)
    block, filled = np.zeros(len(widths), int), 0.0
    for k, width in enumerate(widths):
        fits = filled + width <= limit
        block[k] = (block[k - 1] if k else 0) + (0 if fits else 1)
        filled = filled + width if fits else width
    return block[level]


def _chain(topology: Topology, block: np.ndarray) -> Chain:
    """The chain for the given block of each node: chooses the border and orders the unknowns of each block."""
    free = np.logical_not(topology.fixed.array)
    inner: np.ndarray = free.any(axis=1)
    border = _border(topology, block)
    inner[border] = False
    # Number the blocks anew, without those that hold no unknown.
    _, numbered = np.unique(block[inner], return_inverse=True)
    block = np.full(inner.size, -1)
    block[inner] = numbered
    before, after = np.zeros_like(inner), np.zeros_like(inner)
    for stencil in topology.stencils:
        nodes, there = stencil.array, inner[stencil.array]
        low = np.where(there, block[nodes], inner.size).min(axis=1, keepdims=True)
        high = block[nodes].max(axis=1, keepdims=True)
        spanning = there & (high > low)
        after[nodes[spanning & (block[nodes] == low)]] = True
        before[nodes[spanning & (block[nodes] == high)]] = True
    part = np.where(before, np.where(after, BOTH, BEFORE), np.where(after, AFTER, NEITHER))

    unknown, outer = (free & inner[:, None]).ravel(), np.zeros_like(free)
    outer[border] = free[border]
    used = np.flatnonzero(unknown)
    owner, part = (np.repeat(of_node, free.shape[1])[used] for of_node in (block, part))
    order = np.lexsort((used, part, owner))
    used, owner, part = used[order], owner[order], part[order]
    b = int(owner.max(initial=0)) + 1
    amount = np.bincount(owner, minlength=b)
    w = max(int(amount.max()), 1)
    # Padding is placed before the unknowns that are coupled to the next block: these are the last rows of their block.
    within = np.arange(used.size) - np.repeat(np.cumsum(amount) - amount, amount)
    within = np.where(part >= BOTH, within + w - amount[owner], within)
    head = int(within[(part == BEFORE) | (part == BOTH)].max(initial=-1)) + 1
    tail = w - int(within[part >= BOTH].min(initial=w))
    r = int(outer.sum())
    slots = np.full(b * w + r, free.size)
    slots[owner * w + within] = used
    slots[b * w :] = np.flatnonzero(outer)
    return Chain(slots, (b, w, head, tail, r))


def _adjacency(count: int, elements: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours `neighbour[start[i] : start[i + 1]]` of each node `i`, as compressed rows `(start, neighbour)`."""
    k = elements.shape[1]
    i, j = np.nonzero(~np.eye(k, dtype=bool))
    pairs = np.unique(elements[:, i].ravel().astype(np.int64) * count + elements[:, j].ravel())
    return np.searchsorted(pairs // count, np.arange(count + 1)), pairs % count


def breadth_first_levels(root: np.ndarray, neighbours: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Breadth-first level of each node. Levels of a disconnected piece of the mesh continue the count."""
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
    """Connected groups of a subset of the nodes."""
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
    """Nodes of the border. The other free nodes of each stencil lie in one block or in two neighbouring ones."""
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
