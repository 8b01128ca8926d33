"""Dead loads on area and on edges: weight and traction, forces that keep their size and direction.

Use `weight` for gravity and `traction` for a force along a side. `dead_load` is for forces on single nodes, and
`pressure` for a load that turns with the surface.

The shape functions `N_a` of an element or an edge share the load out to its nodes:

    f_a = force int N_a

The corners of a six-node triangle with straight edges carry no weight. Source: Zienkiewicz and Taylor, "The Finite
Element Method", vol. 1, 2000, section 2.3.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, namespace, pytree, replace
from jaxbeam.mesh.element import edge_functions, edge_rule
from jaxbeam.mesh.elements import element_of
from jaxbeam.mesh.mesh import Mesh, check_triangles
from jaxbeam.mesh.refinement import Finer
from jaxbeam.mesh.surface import edges_between, finer_edges
from jaxbeam.physics.energy import Energy, Term, check_nodes
from jaxbeam.physics.quadrature import edge_lengths, mapped

# Quadrature points of each edge. On a curved edge the element of length is no polynomial.
POINTS = 5


@pytree
class DistributedParams:
    """Parameters of elements or edges with `k` nodes.

    rest: `(m, k, 2)` rest positions.
    shares: `(m, k)` integral of each shape function at rest: an area or a length.
    force: `(m, 2)` per area or length at rest.
    """

    rest: jax.Array
    shares: jax.Array
    force: jax.Array


@dataclasses.dataclass(frozen=True)
class DistributedEnergy(Energy):
    """`-force . sum_a shares_a (x_a - X_a)`: the potential of a constant force on one element or edge."""

    coordinates: ClassVar[int | None] = 2

    def __call__(self, x: jax.Array, params: DistributedParams) -> jax.Array:
        return -jnp.sum(params.shares[:, None] * (x - params.rest) * params.force)

    def partway(self, params: DistributedParams, share: jax.Array) -> DistributedParams:
        return replace(params, force=share * params.force)


@dataclasses.dataclass(frozen=True)
class WeightEnergy(DistributedEnergy):
    """The energy of a constant force on the area of one element."""

    name: ClassVar[str] = "weight"

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        force = term.params.force
        return weight(mesh, namespace(force).repeat(force, finer.parts, axis=0))

    def point_loads(self, x: jax.Array, params: DistributedParams) -> jax.Array:
        """The total weight, at the centre of gravity."""
        heaviness = params.shares * jnp.linalg.norm(params.force, axis=1)[:, None]
        whole = jnp.sum(heaviness)
        centre = jnp.einsum("mk,mkd->d", heaviness, x) / jnp.where(whole > 0, whole, 1)
        return jnp.stack([centre, jnp.einsum("mk,md->d", params.shares, params.force)])[None]


@dataclasses.dataclass(frozen=True)
class TractionEnergy(DistributedEnergy):
    """The energy of a constant force on the length of one edge of the surface."""

    name: ClassVar[str] = "traction"

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        edges, parents = finer_edges(mesh, term.nodes)
        return _on_edges(mesh, edges, term.params.force[parents])

    def edge_loads(self, x: jax.Array, params: DistributedParams, xi: np.ndarray) -> jax.Array:
        return params.force


@usual_rules
def weight(mesh: Mesh, force: Numbers) -> Term:
    """A constant force on all area of a body, such as its density times gravity.

    Args:
        mesh: of triangles; differentiable in its nodes.
        force: per area at rest (thickness 1), `(2,)` everywhere or `(t, 2)` on each element, such as
            `[0, -density * 9.81]`; differentiable.

    Raises:
        ValueError: if `force` has another shape or is not finite, or the mesh is the line of a rod.
    """
    check_triangles(mesh)
    count = len(mesh.elements)
    force = checks.numbers("force", force, shapes=((2,), (count, 2)))
    element, dtype = element_of(mesh.elements), mesh.nodes.dtype
    # The shape functions times the determinant of a curved element are of degree 4.
    degree = max(element.rules)
    rest, _, weights = mapped(mesh.nodes, mesh.elements, degree)
    shares = weights @ namespace(weights).asarray(element.shape(element.rule(degree)[0]), dtype)
    return Term(WeightEnergy(), mesh.elements, DistributedParams(rest, shares, _rows(force, count, dtype)))


@usual_rules
def traction(mesh: Mesh, nodes: Numbers, force: Numbers) -> Term:
    """A constant force on edges of the surface. It keeps its direction; `pressure` turns with the surface.

    Args:
        mesh: of triangles; differentiable in its nodes.
        nodes: `(m,)` node numbers. It acts on the edges of the surface of which both corners are among them.
        force: per length at rest (thickness 1), `(2,)`; differentiable.

    Raises:
        ValueError: if a node is out of range, no edge of the surface lies between the nodes, `force` has another shape
            or is not finite, or the mesh is the line of a rod.
    """
    edges = edges_between(mesh, check_nodes("nodes", mesh, nodes, ndim=1))
    return _on_edges(mesh, edges, checks.numbers("force", force, shapes=((2,),)))


def _on_edges(mesh: Mesh, edges: np.ndarray, force: Any) -> Term:
    """Traction on edges `(m, k)`; `force` is `(2,)` or `(m, 2)`."""
    xp, dtype = namespace(mesh.nodes), mesh.nodes.dtype
    functions = edge_functions(edges.shape[1], edge_rule(POINTS)[0])
    shares = edge_lengths(mesh.nodes, edges, POINTS) @ xp.asarray(functions, dtype)
    rest = xp.asarray(mesh.nodes)[edges]
    return Term(TractionEnergy(), edges, DistributedParams(rest, shares, _rows(force, len(edges), dtype)))


def _rows(force: Any, count: int, dtype: Any) -> Any:
    """The force of each of `count` elements or edges, `(count, 2)`."""
    xp = namespace(force)
    return xp.broadcast_to(xp.asarray(force, dtype), (count, 2))
