"""Weight: a force per area, such as gravity, which keeps its size and direction.

The shape functions `N_a` of an element distribute the force to its nodes: `f_a = force int N_a dA`. On a six-node
triangle with straight edges, only the nodes between corners carry it. Source: Zienkiewicz and Taylor, "The Finite
Element Method", vol. 1, 2000, section 2.3.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, namespace, pytree, replace
from jaxbeam.mesh.elements import element_of
from jaxbeam.mesh.mesh import Mesh, check_triangles
from jaxbeam.physics.energy import Energy, Term
from jaxbeam.physics.quadrature import mapped


@pytree
class WeightParams:
    """Parameters of the elements.

    rest: `(m, k, 2)` rest positions.
    shares: `(m, k)` share of the rest area of each node, `int N_a dA`.
    force: `(m, 2)` force per area at rest.
    """

    rest: jax.Array
    shares: jax.Array
    force: jax.Array


@dataclasses.dataclass(frozen=True)
class WeightEnergy(Energy):
    """`- force . sum_a (int N_a dA) (x_a - X_a)`: the potential of a constant force per area of one element."""

    name: ClassVar[str] = "weight"
    coordinates: ClassVar[int | None] = 2

    def __call__(self, x: jax.Array, params: WeightParams) -> jax.Array:
        return -jnp.sum(params.shares[:, None] * (x - params.rest) * params.force)

    def partway(self, params: WeightParams, share: jax.Array) -> WeightParams:
        return replace(params, force=share * params.force)

    def refined(self, term: Term, mesh: Mesh, parts: int) -> Term:
        return weight(mesh, np.repeat(np.asarray(term.params.force), parts, axis=0))


@usual_rules
def weight(mesh: Mesh, force: Numbers) -> Term:
    """A constant force per area on the whole body, such as its density times gravity.

    Args:
        mesh: mesh of triangles; differentiable in its nodes.
        force: force per area at rest (thickness 1), such as `[0, -density * 9.81]`; `(2,)`, the same everywhere, or
            `(t, 2)`, one for each element; differentiable.

    Raises:
        ValueError: if `force` has another shape or is not finite, or the mesh is the line of a rod.
    """
    check_triangles(mesh)
    count = len(mesh.elements)
    force = checks.numbers("force", force, shapes=((2,), (count, 2)))
    xp, dtype = namespace(mesh.nodes, force), mesh.nodes.dtype
    element = element_of(mesh.elements)
    # In a curved element, a shape function times the determinant is a polynomial of degree 4.
    degree = max(element.rules)
    rest, _, weights = mapped(mesh.nodes, mesh.elements, degree)
    shares = weights @ xp.asarray(element.shape(element.rule(degree)[0]), dtype)
    return Term(
        WeightEnergy(), mesh.elements, WeightParams(rest, shares, xp.broadcast_to(xp.asarray(force, dtype), (count, 2)))
    )
