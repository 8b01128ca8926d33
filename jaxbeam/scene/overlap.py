"""Whether a body passes through itself.

Contact of a body with itself is not modelled, so two parts of it may overlap. Such a state can be an equilibrium of the
model, but not of a real beam. In such a state two edges of the surface cross.

The surface is treated as straight segments. The edge of a six-node triangle is a parabola and is cut into `SEGMENTS`
segments. The surface of a rod is a pair of lines, at half its height on either side of each element.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core.compiling import compute_if
from jaxbeam.mesh.element import edge_functions
from jaxbeam.scene.scene import Scene

# Segments of a curved edge.
SEGMENTS = 4


@jax.jit
def crossing(scene: Scene, x: jax.Array) -> jax.Array:
    """The first two edges of the surface that cross at positions `x` `(n, d)`.

    Edges that share a node are not tested against each other: `J` tells whether these fold over.

    Returns:
        Node numbers `(2, 2)` of the ends of the two edges; -1 if no edges cross.
    """
    segments = [_of_solids(scene, x), *_of_sides(scene, x)]
    points, ids, edges = (jnp.concatenate(each) for each in zip(*segments, strict=True))
    none = jnp.full((2, 2), -1, jnp.int32)
    if not len(points):
        return none
    near = _near(jnp.min(points, axis=1), jnp.max(points, axis=1), ids)
    # In most states no two bounding boxes meet, and nothing else is computed.
    return compute_if(jnp.any(near), _first_crossing, none, points, edges, near)


def _near(low: jax.Array, high: jax.Array, ids: jax.Array) -> jax.Array:
    """Which pairs of segments, `(s, s)`, share no end point and have bounding boxes that meet.

    Args:
        low: `(s, 2)` lower left corner of each box.
        high: `(s, 2)` upper right corner.
        ids: `(s, 2)` numbers of the end points of each segment.
    """
    # This runs for every state and every pair. Column by column it takes a seventh less time than over short axes.
    near = jnp.ones((len(ids), len(ids)), bool)
    for axis in range(2):
        below = low[:, None, axis] <= high[None, :, axis]
        near &= below & below.T
    for mine, other in itertools.product(range(2), repeat=2):
        near &= ids[:, None, mine] != ids[None, :, other]
    return near


def _first_crossing(points: jax.Array, edges: jax.Array, near: jax.Array) -> jax.Array:
    """Edges `(2, 2)` of the first two segments that cross, among the pairs `near` `(s, s)`; -1 if none cross."""
    start, along = points[:, 0], points[:, 1] - points[:, 0]

    def sides(which: int) -> jax.Array:
        """Side of each segment (row) on which end point `which` of each segment (column) lies; positive: left."""
        gap = points[None, :, which] - start[:, None]
        return along[:, None, 0] * gap[..., 1] - along[:, None, 1] * gap[..., 0]

    apart = sides(0) * sides(1) < 0
    # For segments on one line round-off decides the sides. If they lie one after the other they are not near.
    crossed = (apart & apart.T & near).ravel()
    first = jnp.argmax(crossed)
    pair = edges[jnp.stack([first // len(points), first % len(points)])]
    return jnp.where(crossed[first], pair, -1)


def _of_solids(scene: Scene, x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Segments of the surface of the solids.

    Returns:
        End points `(s, 2, 2)`, their numbers `(s, 2)`, and the end nodes `(s, 2)` of the edge that each belongs to.
    """
    edges = jnp.asarray(scene.surface)
    parts = 1 if edges.shape[1] == 2 else SEGMENTS
    xi = np.linspace(0, 1, parts + 1)
    functions = edge_functions(edges.shape[1], xi)
    curves = sum(
        function[:, None] * x[edges[:, k], :2][:, None] for k, function in enumerate(jnp.asarray(functions.T, x.dtype))
    )
    # Points between the ends of an edge are numbered after the nodes.
    between = len(x) + jnp.arange(len(edges) * (parts - 1), dtype=jnp.int32).reshape(len(edges), parts - 1)
    numbers = jnp.concatenate([edges[:, :1], between, edges[:, 1:2]], axis=1)
    pairs = lambda each: jnp.stack([each[:, :-1], each[:, 1:]], axis=2).reshape(-1, 2, *each.shape[2:])
    return pairs(curves), pairs(numbers), jnp.repeat(edges[:, :2], parts, axis=0)


def _of_sides(scene: Scene, x: jax.Array) -> list[tuple[jax.Array, jax.Array, jax.Array]]:
    """Segments, as from `_of_solids`, that bound a body without elements of area: an entry for each side of a rod."""
    found = []
    for term in scene.terms:
        nodes = jnp.asarray(term.nodes)
        found += [(segments, nodes, nodes) for segments in term.kind.sides(x[nodes], term.params)]
    return found
