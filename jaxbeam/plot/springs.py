"""Springs that tie nodes to their places, in numbers: zigzags from a base outside the body to the node."""

from __future__ import annotations

import numpy as np

from jaxbeam.plot.lines import inside, segments
from jaxbeam.scene.scene import Scene

# Relative to the body: length of a spring whose node stays, times the displacement that is added, longest; width and
# number of teeth.
SPRING, FURTHER, LONGEST, TOOTH, TEETH = 0.055, 1.5, 0.4, 0.011, 4


class Springs:
    """The springs of a scene. Show each state to `see` before it is drawn: bases lie right for all that were seen.

    Args:
        scene: of the body.
        rest: `(n, 2)` positions at rest.
        edges: of its surface, or of the centre line of a rod.

    The attributes are `nodes` `(q,)`, which springs hold, and `bases` `(q, 2)`, where the springs start.
    """

    def __init__(self, scene: Scene, rest: np.ndarray, edges: np.ndarray) -> None:
        self.rest, self.edges, self.size = rest, edges, float(np.ptp(rest, axis=0).max())
        self.nodes, self.places, self.tooth = _tied(scene, self.size)
        self.bases = self.away = self.farthest = np.zeros((len(self.nodes), 2))

    def see(self, x: np.ndarray) -> None:
        """Choose the bases of the springs anew if a node is now farther from its place than it was.

        They lie off the surface as it is at rest. Where the body has turned so far that springs would run through it,
        they lie off the surface as it is now, or between both.
        """
        moved = x[self.nodes, :2] - self.places
        farther = np.linalg.norm(moved, axis=1) >= np.linalg.norm(self.farthest, axis=1)
        if not farther.any():
            return
        self.farthest = np.where(farther[:, None], moved, self.farthest)
        long = SPRING * self.size + FURTHER * np.linalg.norm(self.farthest, axis=1, keepdims=True)
        before, now = (_outward(each, self.edges, self.nodes, self.farthest) for each in (self.rest, x[:, :2]))
        ways = np.stack([before, before + now, now])
        ways /= np.maximum(np.linalg.norm(ways, axis=2, keepdims=True), 1e-300)
        bases = self.places + np.minimum(long, LONGEST * self.size) * ways
        crossed = np.zeros(len(ways))
        for body in (self.rest, x[:, :2]):
            samples = np.linspace(0.1, 0.9, 9)[:, None, None, None] * (body[self.nodes] - bases) + bases
            crossed += inside(samples, segments(body, self.edges)).sum(axis=(0, 2))
        best = int(np.argmin(crossed))
        self.bases, self.away = bases[best], ways[best]

    def zigzags(self, x: np.ndarray) -> np.ndarray:
        """Points `(q, p, 2)` of each spring, from its base outside the body to its node."""
        start, run = self.bases, x[self.nodes, :2] - self.bases
        across = np.stack([-run[:, 1], run[:, 0]], axis=1)
        across = self.tooth * across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
        along = np.array([0.0, *np.linspace(0.2, 0.8, 2 * TEETH + 1), 1.0])
        side = np.array([0.0, 0.0, *np.resize([1.0, -1.0], 2 * TEETH - 1), 0.0, 0.0])
        return start[:, None] + along[:, None] * run[:, None] + side[:, None] * across[:, None]

    def grounds(self) -> np.ndarray:
        """Segments `(q, 2, 2)` of the ground that each spring stands on, with hatching."""
        across = np.stack([-self.away[:, 1], self.away[:, 0]], axis=1)
        at = lambda along, aside: self.bases + self.tooth * (along * self.away + aside * across)
        strokes = [(at(0, place), at(0.9, place - 0.9)) for place in (-0.6, 0.2, 1.0, 1.8)]
        return np.concatenate([np.stack(pair, axis=1) for pair in [(at(0, -1.8), at(0, 1.8)), *strokes]])


def _tied(scene: Scene, size: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Nodes `(q,)` that springs hold, the points `(q, 2)` they are tied to, and how far the teeth stand out."""
    found = [(np.asarray(term.nodes)[:, 0], term.kind.springs(term.params)) for term in scene.terms]
    held = [(nodes, np.asarray(points)) for nodes, points in found if points is not None]
    if not held:
        return np.zeros(0, int), np.zeros((0, 2)), 0.0
    points = np.concatenate([each for _, each in held])
    gaps = np.linalg.norm(points[:, None] - points, axis=2)
    nearest = gaps[gaps > 1e-9 * size].min(initial=np.inf)
    return np.concatenate([each for each, _ in held]), points, float(min(TOOTH * size, 0.3 * nearest))


def _outward(rest: np.ndarray, edges: np.ndarray, nodes: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Unit vectors `(q, 2)` out of the body at `nodes`, for springs that hold them while they have `moved` `(q, 2)`.

    They are normal to the edges between the nodes, or to all edges of a node that is alone. At a corner the edge
    that moves along its normal counts more. At a node inside the body they are down.
    """
    along = rest[edges[:, 1]] - rest[edges[:, 0]]
    normals = np.stack([along[:, 1], -along[:, 0]], axis=1)
    units = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    motion, every, between = np.zeros_like(rest), np.zeros_like(rest), np.zeros_like(rest)
    motion[nodes] = moved
    both = np.isin(edges[:, :2], nodes).all(axis=1)
    for node in edges.T:
        across = 1e-3 * np.ptp(rest, axis=0).max() + np.abs(np.sum(units * motion[node], axis=1))
        weighted = across[:, None] ** 2 * normals
        np.add.at(every, node, weighted)
        np.add.at(between, node[both], weighted[both])
    found = np.broadcast_to(np.array([0.0, -1.0]), (len(nodes), 2))
    for better in (every[nodes], between[nodes]):
        length = np.linalg.norm(better, axis=1, keepdims=True)
        there = length > 1e-12 * length.max()
        found = np.where(there, better / np.where(there, length, 1), found)
    return found
