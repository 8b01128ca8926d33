"""Whether a body passes through itself.

Nothing here models contact, so two parts of a body may come to lie in one place: an equilibrium of the model, but of no
real beam. Where that happens two edges of its surface cross.

The surface is taken as straight segments. The edge of a six-node triangle is a parabola and is cut into `SEGMENTS` of
them. A rod's surface is the pair of lines at half its height on either side of each element.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core.compiling import compute_if
from jaxbeam.mesh.elements import edge_functions
from jaxbeam.scene.scene import Scene

# Segments of a curved edge.
SEGMENTS = 4


@jax.jit
def crossing(scene: Scene, x: jax.Array) -> jax.Array:
    """The first two edges of the surface that cross at `x` `(n, d)`, as node numbers `(2, 2)` of their ends; -1 if none
    do. Edges that share a node do not count: `J` says whether these fold over."""
    segments = [_of_solids(scene, x), *_of_sides(scene, x)]
    points, ids, edges = (jnp.concatenate(each) for each in zip(*segments, strict=True))
    none = jnp.full((2, 2), -1, jnp.int32)
    if not len(points):
        return none
    near = _near(jnp.min(points, axis=1), jnp.max(points, axis=1), ids)
    # In most states no boxes around two segments meet, and nothing else is computed.
    return compute_if(jnp.any(near), _first_crossing, none, points, edges, near)


def _near(low: jax.Array, high: jax.Array, ids: jax.Array) -> jax.Array:
    """The pairs of segments `(s, s)` that share no point and whose boxes, `low` to `high` `(s, 2)`, meet."""
    # Every state asks this of every pair: column by column it took a seventh less time than over short axes.
    near = jnp.ones((len(ids), len(ids)), bool)
    for axis in range(2):
        below = low[:, None, axis] <= high[None, :, axis]
        near &= below & below.T
    for mine, other in itertools.product(range(2), repeat=2):
        near &= ids[:, None, mine] != ids[None, :, other]
    return near


def _first_crossing(points: jax.Array, edges: jax.Array, near: jax.Array) -> jax.Array:
    """The edges of the first two segments that cross, of those pairs `(s, s)` that are `near`."""
    start, along = points[:, 0], points[:, 1] - points[:, 0]

    def sides(which: int) -> jax.Array:
        """On which side of each segment (rows) the start or the end of each segment (columns) lies."""
        gap = points[None, :, which] - start[:, None]
        return along[:, None, 0] * gap[..., 1] - along[:, None, 1] * gap[..., 0]

    apart = sides(0) * sides(1) < 0
    # Of segments in one line round-off decides the sides. Those that lie one after the other are not near.
    crossed = (apart & apart.T & near).ravel()
    first = jnp.argmax(crossed)
    pair = edges[jnp.stack([first // len(points), first % len(points)])]
    return jnp.where(crossed[first], pair, -1)


def _of_solids(scene: Scene, x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Segments of the surface: points `(s, 2, 2)`, the numbers `(s, 2)` of these, and the ends `(s, 2)` of its edge."""
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
    """The same for what terms without elements of area say that bounds them, such as both sides of a rod."""
    found = []
    for term in scene.terms:
        nodes = jnp.asarray(term.nodes)
        found += [(segments, nodes, nodes) for segments in term.kind.sides(x[nodes], term.params)]
    return found
