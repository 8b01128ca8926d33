"""Dead loads: forces on nodes that keep their size and direction.

Use them on rods, where the third component is a moment, and to compare with other codes. On triangles a force on a node
is a point load: displacements there grow without limit as the mesh is refined, and have no error bar. `traction` and
`weight` are spread out.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, namespace, pytree, replace
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import Finer
from jaxbeam.physics.energy import Energy, Term, check_nodes


@pytree
class PointParams:
    """Parameters of loaded nodes or of springs.

    rest: `(m, d)` rest positions of the nodes.
    value: `(m, d)` force on each node, or `(m,)` stiffness of each spring.
    """

    rest: jax.Array
    value: jax.Array


@dataclasses.dataclass(frozen=True)
class DeadLoadEnergy(Energy):
    """`-f . (x - X)`: a force `f` of constant size and direction on one node, with rest position `X`."""

    name: ClassVar[str] = "load"
    pointwise: ClassVar[bool] = True

    def __call__(self, x: jax.Array, params: PointParams) -> jax.Array:
        return -jnp.sum(params.value * (x[0] - params.rest))

    def partway(self, params: PointParams, share: jax.Array) -> PointParams:
        return replace(params, value=share * params.value)

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        return term

    def point_loads(self, x: jax.Array, params: PointParams) -> jax.Array:
        return jnp.stack([x[:, 0, :2], params.value[:, :2]], axis=1)


@usual_rules
def dead_load(mesh: Mesh, nodes: Numbers, force: Numbers) -> Term:
    """Constant forces on nodes.

    Args:
        mesh: at its rest positions the energy of the load is zero.
        nodes: `(m,)` node numbers.
        force: `(2,)`, the same on each node, or `(m, 2)`; on a rod `(3,)` or `(m, 3)`, where the third component is a
            moment divided by `radian` (see `jaxbeam.mesh.line`); differentiable.

    Raises:
        ValueError: if a node is out of range or `force` has another shape or is not finite.
    """
    where = check_nodes("nodes", mesh, nodes, ndim=1)
    d = mesh.nodes.shape[1]
    force = checks.numbers("force", force, shapes=((d,), (where.size, d)))
    xp, rest = namespace(force), namespace(mesh.nodes).asarray(mesh.nodes)[where]
    values = xp.broadcast_to(xp.asarray(force, mesh.nodes.dtype), (where.size, d))
    return Term(DeadLoadEnergy(), where[:, None], PointParams(rest, values))
