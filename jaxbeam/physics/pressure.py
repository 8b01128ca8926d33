"""Pressure on the surface of a body: a follower load, which stays normal to the surface as the surface moves.

The body lies to the left of a piece `(dx, dy)` of its surface. A pressure `p` acts on it with the force `p (-dy, dx)`.
This force has a potential if the loaded line is closed or ends at nodes that do not move (Schweizerhof and Ramm,
Computers & Structures 18 (1984), 1099-1114). The potential is `p` times the area on the body's side,

    E = p / 2 int (x - c) cross dx,

with vectors `x` and `dx` and any point `c`. So the stiffness is symmetric, and the solver needs to know nothing of
pressure. On a line with an end that moves there is no potential.

So use it for chambers, and for sides whose ends are clamped. On a side with a free end use `traction`, which does not
turn.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, namespace, pytree, replace, spread
from jaxbeam.mesh.element import edge_products, edge_slopes
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import Finer
from jaxbeam.mesh.surface import edges_between, finer_edges
from jaxbeam.physics.energy import Energy, Term, check_nodes


@pytree
class PressureParams:
    """Parameters of the loaded edges.

    pressure: `(m,)` pressure, the same on all edges.
    centre: `(m, 2)` the point `c` from which areas are measured, the same for all edges.
    """

    pressure: jax.Array
    centre: jax.Array


@dataclasses.dataclass(frozen=True)
class PressureEnergy(Energy):
    """`p` times the signed area between one edge of the surface and the centre. The command is the pressure."""

    name: ClassVar[str] = "pressure"
    coordinates: ClassVar[int | None] = 2
    rest_command: ClassVar[float | None] = 0.0
    shared_command = True
    command_hint: ClassVar[str] = "a pressure pushes on the body, and a negative one pulls"

    def __call__(self, x: jax.Array, params: PressureParams) -> jax.Array:
        return 0.5 * params.pressure * jnp.sum((x - params.centre) * self._normals(x - params.centre))

    def gradients(self, x: jax.Array, params: PressureParams) -> tuple[jax.Array, jax.Array]:
        # The gradient of the energy of one edge contains terms that depend on the centre. They cancel between
        # neighbouring edges, but not at the ends of a line. So this returns minus the force of the pressure on the edge
        # instead. It has the true size, which residuals are relative to, and gives the right reactions at clamped ends.
        forces = params.pressure[:, None, None] * self._normals(x)
        return jax.vmap(self)(x, params), forces

    def _normals(self, x: jax.Array) -> jax.Array:
        """`int N_i (dy, -dx)` `(..., k, 2)` for each node `i` of an edge: its share of the edge's outward normal."""
        products = jnp.asarray(edge_products(x.shape[-2]), x.dtype)
        along = jnp.sum(products[:, :, None] * x[..., None, :, :], axis=-2)
        return jnp.stack([along[..., 1], -along[..., 0]], axis=-1)

    def command(self, params: PressureParams, values: jax.Array) -> PressureParams:
        return replace(params, pressure=spread(values, params.pressure))

    def command_of(self, params: PressureParams) -> jax.Array:
        return params.pressure[:1]

    def objection(self, term: Term, fixed: np.ndarray) -> str:
        starts, ends = (np.bincount(term.nodes[:, k], minlength=len(fixed)) for k in (0, 1))
        loose = np.flatnonzero((starts != ends) & ~fixed.all(axis=1))
        if not loose.size:
            return ""
        return (
            f"the line it acts on ends at node {loose[0]}, which moves, so that its force has no potential; choose "
            f"nodes whose edges close a loop, or end at clamped nodes"
        )

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        edges, _ = finer_edges(mesh, term.nodes)
        count = len(edges)
        centre = jnp.broadcast_to(term.params.centre[0], (count, 2))
        return Term(self, edges, PressureParams(jnp.broadcast_to(term.params.pressure[0], (count,)), centre))

    def edge_loads(self, x: jax.Array, params: PressureParams, xi: np.ndarray) -> jax.Array:
        along = jnp.einsum("mk,mkd->md", jnp.asarray(edge_slopes(x.shape[1], xi), x.dtype), x)
        inward = jnp.stack([-along[:, 1], along[:, 0]], axis=1)
        return params.pressure[:, None] * inward / jnp.linalg.norm(inward, axis=1, keepdims=True)


@usual_rules
def pressure(mesh: Mesh, nodes: Numbers, value: Numbers = 0.0) -> Term:
    """Pressure on part of the surface, such as that of a cavity or the upper side of a clamped arch.

    `command` sets it: one command for the whole term.

    Args:
        mesh: of triangles.
        nodes: `(m,)` node numbers. The pressure acts on the edges of the surface whose two corners are among them.
        value: force per length (thickness 1), positive if it pushes on the body; differentiable.

    Raises:
        ValueError: if a node is out of range, no edge of the surface lies between the nodes, or `value` is not a finite
            number. `Scene` raises it if the edges form a line with an end that moves.
    """
    chosen = check_nodes("nodes", mesh, nodes, ndim=1)
    value = checks.number("value", value)
    edges = edges_between(mesh, chosen)
    dtype, rest = mesh.nodes.dtype, namespace(mesh.nodes).asarray(mesh.nodes)
    xp = namespace(rest, value)
    centre = xp.broadcast_to(rest[edges[:, 0]].mean(axis=0), (len(edges), 2))
    return Term(PressureEnergy(), edges, PressureParams(xp.full(len(edges), xp.asarray(value, dtype)), centre))
