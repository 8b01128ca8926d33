"""Dead loads: forces on nodes that keep their size and direction."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, namespace, pytree
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.physics.energy import Term, check_nodes

# ---------------------------------------------------------------------------------- loads and springs


@pytree
class PointParams:
    """Rest position `(m, 2)` and a vector or scalar `value` for each loaded node."""

    rest: jax.Array
    value: jax.Array


def dead_load_energy(x: jax.Array, params: PointParams) -> jax.Array:
    """`-f . (x - X)`: a force of constant size and direction on one node."""
    return -jnp.sum(params.value * (x[0] - params.rest))


@usual_rules
def dead_load(mesh: Mesh, nodes: Numbers, force: Numbers) -> Term:
    """Constant forces on nodes.

    Args:
        mesh: its rest positions are the zero of the load's energy.
        nodes: `(m,)` node numbers.
        force: `(2,)` on each of them, or `(m, 2)`; on a rod `(3,)` or `(m, 3)`, the third a moment over `radian`
            (see `jaxbeam.rod`); differentiable.

    Raises:
        ValueError: if a node is out of range or `force` has another shape or is not finite.
    """
    where = check_nodes("nodes", mesh, nodes, ndim=1)
    d = mesh.nodes.shape[1]
    force = checks.numbers("force", force, shapes=((d,), (where.size, d)))
    xp, rest = namespace(force), namespace(mesh.nodes).asarray(mesh.nodes)[where]
    values = xp.broadcast_to(xp.asarray(force, mesh.nodes.dtype), (where.size, d))
    return Term(dead_load_energy, where[:, None], PointParams(rest, values))
