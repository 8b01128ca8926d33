"""Contact of the surface of a body with rigid obstacles, without friction.

Use it where the body may touch an obstacle and leave it. Where nodes are held all the time, use `clamped` or `support`.

An obstacle is a function of a point that is its distance from the obstacle, negative inside. Where the surface of the
body is at the distance `g`, the obstacle pushes with the pressure

    p = k w h'(-g / w)

with the one-sided law `h` of `jaxbeam.physics.one_sided`. It is zero outside, and deep inside it grows by the stiffness
`k` with each unit of depth. Over the transition width `w` it sets in smoothly. Its potential is `k w^2 h(-g / w)` on
each length of the surface at rest.

This is the penalty method (Wriggers, "Computational Contact Mechanics", 2006, section 6.3): the surface sinks in by
about `p / k`, a depth that falls as one over the stiffness.

There is no friction, and a body does not touch itself or another body.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, is_concrete, namespace, pytree, replace, spread, static_field
from jaxbeam.mesh.element import edge_functions, edge_rule, edge_slopes
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import Finer
from jaxbeam.mesh.surface import edges_between, finer_edges
from jaxbeam.physics.energy import Energy, Term, check_nodes
from jaxbeam.physics.one_sided import one_sided, one_sided_slope
from jaxbeam.physics.quadrature import edge_lengths

# Quadrature points of each edge.
POINTS = 3

Distance = Callable[[jax.Array, Any], jax.Array]


@pytree
class Obstacle:
    """A rigid shape.

    distance: `(point, params) -> ()`, the signed distance of a point `(2,)`, negative inside; a function of a module.
    params: its parameters, a pytree of arrays; differentiable.
    stride: `()` how far it may move from one solved state to the next, a quarter of its thickness; None: any. If it
        moved farther, the body could come out on its other side.
    """

    distance: Distance = static_field()
    params: Any
    stride: Any = None


def half_plane(point: Numbers, normal: Numbers) -> Obstacle:
    """All points behind the line through `point` `(2,)`. `normal` `(2,)`, of any length, points out of it."""
    place = namespace(point).asarray(checks.numbers("point", point, shapes=((2,),)))
    return Obstacle(_behind_line, (place, _unit("normal", normal)))


def _unit(name: str, vector: Numbers) -> Any:
    """The unit vector `(2,)` along a vector of any length but 0."""
    xp = namespace(vector)
    along = xp.asarray(checks.numbers(name, vector, shapes=((2,),)))
    length = xp.sqrt(xp.sum(along**2))
    if is_concrete(length) and not length > 0:
        raise ValueError(f"{name}: expected a vector of positive length, got [0, 0]")
    return along / length


def disk(centre: Numbers, radius: Numbers) -> Obstacle:
    """A disk with its centre `(2,)` and its radius, positive."""
    xp = namespace(centre, radius)
    place = xp.asarray(checks.numbers("centre", centre, shapes=((2,),)))
    size = xp.asarray(checks.number("radius", radius, checks.POSITIVE))
    return Obstacle(_from_disk, (place, size), 0.5 * size)


def box(centre: Numbers, size: Numbers, angle: Numbers = 0.0) -> Obstacle:
    """A rectangle with its centre `(2,)`, its width and height `(2,)`, and its angle in degrees, anticlockwise."""
    xp = namespace(centre, size, angle)
    place = xp.asarray(checks.numbers("centre", centre, shapes=((2,),)))
    sides = xp.asarray(checks.numbers("size", size, checks.POSITIVE, ((2,),)))
    turn = xp.deg2rad(xp.asarray(checks.number("angle", angle)))
    return Obstacle(_from_box, (place, 0.5 * sides, turn), 0.25 * xp.min(sides))


def _behind_line(point: jax.Array, params: Any) -> jax.Array:
    place, normal = params
    return jnp.sum((point - place) * normal)


def _from_disk(point: jax.Array, params: Any) -> jax.Array:
    centre, radius = params
    return _length(point - centre) - radius


def _from_box(point: jax.Array, params: Any) -> jax.Array:
    centre, half, angle = params
    x, y = point - centre
    turned = jnp.stack([jnp.cos(angle) * x + jnp.sin(angle) * y, jnp.cos(angle) * y - jnp.sin(angle) * x])
    beyond = jnp.abs(turned) - half
    return _length(jnp.maximum(beyond, 0)) + jnp.minimum(jnp.max(beyond), 0)


def _length(vector: jax.Array) -> jax.Array:
    """Length `()`, with derivatives of zero, and not NaN, where it is zero."""
    squared = jnp.sum(vector**2)
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)


@pytree
class ContactParams:
    """Parameters of `m` edges.

    shape: parameters of the obstacle, each with leading axis `m`, all alike.
    lengths: `(m, q)` length at rest of each quadrature point's part of the edge.
    stiffness: `(m,)` pressure per depth.
    transition: `(m,)` depth over which the pressure sets in.
    moved: `(m,)` how far the obstacle is moved along its direction, all alike.
    direction: `(m, 2)` unit vector, all alike.
    stride: `(m,)` as of the `Obstacle`, all alike; or None.
    """

    shape: Any
    lengths: jax.Array
    stiffness: jax.Array
    transition: jax.Array
    moved: jax.Array
    direction: jax.Array
    stride: Any = None


@dataclasses.dataclass(frozen=True)
class ContactEnergy(Energy):
    """Potential of the pressure of one obstacle on one edge. Its command moves the obstacle along a direction.

    distance: as of the `Obstacle`.
    """

    distance: Distance
    name: ClassVar[str] = "contact"
    coordinates: ClassVar[int | None] = 2
    rest_command: ClassVar[float | None] = 0.0
    shared_command = True
    command_hint: ClassVar[str] = "it is how far the obstacle is moved along its direction"

    def __call__(self, x: jax.Array, params: ContactParams) -> jax.Array:
        shape = one_sided(-self.gaps(x, params) / params.transition)
        return params.stiffness * params.transition**2 * jnp.sum(params.lengths * shape)

    def gaps(self, x: jax.Array, params: ContactParams) -> jax.Array:
        """Distance of the edge from the obstacle at its quadrature points, `(q,)`."""
        return jax.vmap(self.distance, in_axes=(0, None))(self._points(x, params), params.shape)

    def pressures(self, x: jax.Array, params: ContactParams) -> jax.Array:
        """Pressure at the quadrature points of the edge, `(q,)`."""
        return params.stiffness * params.transition * one_sided_slope(-self.gaps(x, params) / params.transition)

    def _points(self, x: jax.Array, params: ContactParams) -> jax.Array:
        """The quadrature points `(q, 2)`, as seen from the obstacle before it was moved."""
        xi, _ = edge_rule(POINTS)
        return jnp.asarray(edge_functions(len(x), xi), x.dtype) @ x - params.moved * params.direction

    def command(self, params: ContactParams, values: jax.Array) -> ContactParams:
        return replace(params, moved=spread(values, params.moved))

    def command_of(self, params: ContactParams) -> jax.Array:
        return params.moved[:1]

    def stride(self, params: ContactParams) -> jax.Array | None:
        return None if params.stride is None else params.stride[0]

    def longest_step(self, x: jax.Array, dx: jax.Array, params: ContactParams, keep: float) -> jax.Array | None:
        """No node of the surface moves farther than the stride in one step of Newton's method."""
        if params.stride is None:
            return None
        farthest = jnp.max(jnp.abs(dx), axis=(1, 2))
        return params.stride / jnp.where(farthest > 0, farthest, 1)

    def margin(self, x: jax.Array, params: ContactParams) -> jax.Array:
        """Negative where the surface has come out on the other side of the obstacle, which is then inside the body."""

        def of_edge(x: jax.Array, params: ContactParams) -> jax.Array:
            along = jnp.asarray(edge_slopes(len(x), edge_rule(POINTS)[0]), x.dtype) @ x
            outward = jnp.stack([along[:, 1], -along[:, 0]], axis=1)
            both = jax.vmap(jax.value_and_grad(self.distance), in_axes=(0, None))
            gaps, away = both(self._points(x, params), params.shape)
            facing = jnp.sum(outward * away, axis=1) / jnp.linalg.norm(outward, axis=1)
            return jnp.min(jnp.where((gaps < 0) & (facing > 0), -facing, jnp.inf))

        return jax.vmap(of_edge)(x, params)

    def surrounded(self, x: jax.Array, points: jax.Array, params: ContactParams) -> jax.Array | None:
        """The body lies deeper in the obstacle than its surface does. What has no thickness cannot be passed."""
        if params.stride is None:
            return None
        surface = jnp.append(jax.vmap(self.gaps)(x, params), self.obstacle(x.reshape(-1, 2), params))
        return jnp.min(self.obstacle(points, params)) < jnp.minimum(jnp.min(surface), 0)

    def valid(self, params: ContactParams) -> jax.Array:
        return jnp.all((params.stiffness > 0) & (params.transition > 0))

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        edges, parents = finer_edges(mesh, term.nodes)
        params = jax.tree.map(lambda leaf: leaf[parents], term.params)
        return Term(self, edges, replace(params, lengths=edge_lengths(mesh.nodes, edges, POINTS)))

    def obstacle(self, points: jax.Array, params: ContactParams) -> jax.Array:
        shape = jax.tree.map(lambda leaf: leaf[0], params.shape)
        moved = params.moved[0] * params.direction[0]
        return jax.vmap(self.distance, in_axes=(0, None))(points - moved, shape)

    def measured(self, x: jax.Array, params: ContactParams) -> dict[str, jax.Array]:
        gaps = jax.vmap(self.gaps)(x, params)
        return {
            "penetration": jnp.maximum(-jnp.min(gaps, axis=1), 0),
            "contact_pressure": jnp.max(jax.vmap(self.pressures)(x, params), axis=1),
            "contact_force": -jnp.sum(self.gradients(x, params)[1], axis=1),
        }


@usual_rules
def contact(
    mesh: Mesh,
    nodes: Numbers,
    obstacle: Obstacle,
    stiffness: Numbers,
    transition: Numbers,
    direction: Numbers = (0.0, 1.0),
) -> Term:
    """Contact of part of the surface with a rigid obstacle, without friction. `command` moves the obstacle.

    Args:
        mesh: of triangles; differentiable in its nodes.
        nodes: `(m,)` node numbers. The edges of the surface of which both corners are among them may touch it.
        obstacle: `half_plane(...)`, `disk(...)`, `box(...)`, or an `Obstacle` with a distance of your own. Without a
            `stride` one of your own must be moved in small steps: moved far in one call, it may end up inside the body.
        stiffness: pressure per depth (force per volume, thickness 1), positive; differentiable. The body sinks in by
            about the pressure over the stiffness.
        transition: depth over which the pressure sets in, a length, positive; differentiable.
        direction: `(2,)` along which a command moves the obstacle, of any length; one command for all edges.

    Raises:
        ValueError: if a node is out of range, no edge of the surface lies between the nodes, an argument has another
            shape or is out of its range, the body and the obstacle overlap at rest, or the obstacle is thinner than an
            edge is long.
    """
    edges = edges_between(mesh, check_nodes("nodes", mesh, nodes, ndim=1))
    checks.instance("obstacle", obstacle, Obstacle, "make one with half_plane, disk or box")
    numbers = [checks.number("stiffness", stiffness, checks.POSITIVE)]
    numbers.append(checks.number("transition", transition, checks.POSITIVE))
    toward, dtype, count = _unit("direction", direction), mesh.nodes.dtype, len(edges)
    every = lambda value: namespace(value).broadcast_to(
        namespace(value).asarray(value, dtype), (count, *np.shape(value))
    )
    params = ContactParams(
        shape=jax.tree.map(every, obstacle.params),
        lengths=edge_lengths(mesh.nodes, edges, POINTS),
        stiffness=every(numbers[0]),
        transition=every(numbers[1]),
        moved=every(0.0),
        direction=every(toward),
        stride=None if obstacle.stride is None else every(obstacle.stride),
    )
    term = Term(ContactEnergy(obstacle.distance), edges, params)
    _check_outside(mesh, term)
    return term


@partial(jax.jit, static_argnums=0)
def _distances(energy: ContactEnergy, points: jax.Array, params: ContactParams) -> jax.Array:
    """Distances `(p,)` of `points` `(p, 2)` from the obstacle."""
    return energy.obstacle(points, params)


@partial(jax.jit, static_argnums=0)
def _gaps(energy: ContactEnergy, x: jax.Array, params: ContactParams) -> jax.Array:
    """Distances `(m, q)` of edges at `x` `(m, k, 2)` from the obstacle."""
    return jax.vmap(energy.gaps)(x, params)


def _check_outside(mesh: Mesh, term: Term) -> None:
    """Refuse an obstacle that at rest holds part of the surface inside, or lies in the body, or is too thin."""
    if not is_concrete(mesh.nodes, *jax.tree.leaves(term.params)):
        return
    rest = np.asarray(mesh.nodes)
    gaps = np.asarray(_gaps(term.energy, rest[term.nodes], term.params))
    # A surface that lies on the obstacle touches it up to round-off.
    size = np.ptp(rest, axis=0).max()
    if gaps.min() < -1e-6 * size:
        k = int(np.argmin(gaps.min(axis=1)))
        raise ValueError(
            f"obstacle: the edge between nodes {term.nodes[k, 0]} and {term.nodes[k, 1]} lies {-gaps.min():.3g} inside "
            f"it at rest; place it outside, and move it in by its command"
        )
    stride, longest = term.params.stride, float(np.sum(np.asarray(term.params.lengths), axis=1).max())
    if stride is None:
        return
    # What has no thickness, such as a half-plane, may cut through parts of the body that it is not to touch.
    points = np.concatenate([rest, rest[mesh.elements].mean(axis=1)])
    within = -np.asarray(_distances(term.energy, points, term.params))
    if within.max() > 1e-6 * size:
        x, y = points[int(np.argmax(within))]
        raise ValueError(
            f"obstacle: at rest it lies in the body, at ({x:.4g}, {y:.4g}); place it outside, and move it in by its "
            f"command"
        )
    if 4 * float(stride[0]) < (1 - 1e-6) * longest:
        raise ValueError(
            f"obstacle: its thickness is {4 * float(stride[0]):.3g}, less than the longest edge that may touch it, "
            f"{longest:.3g}, between whose points it could pass; refine the mesh there"
        )
