"""Springs from nodes to their rest positions.

They are for soft supports, and for comparison with codes that clamp by a penalty. To hold nodes use `clamped`, which is
exact, and to move them `support`.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, namespace
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import Finer
from jaxbeam.physics.energy import Energy, Term, check_nodes
from jaxbeam.physics.load import PointParams


@dataclasses.dataclass(frozen=True)
class SpringEnergy(Energy):
    """`1/2 k |x - X|^2`: a spring of stiffness `k` from one node to its rest position `X`."""

    name: ClassVar[str] = "spring"

    def __call__(self, x: jax.Array, params: PointParams) -> jax.Array:
        return 0.5 * params.value * jnp.sum((x[0] - params.rest) ** 2)

    def valid(self, params: PointParams) -> jax.Array:
        return jnp.all(params.value >= 0)

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        return term

    def springs(self, params: PointParams) -> jax.Array:
        return params.rest[:, :2]


@usual_rules
def penalty_springs(mesh: Mesh, nodes: Numbers, stiffness: Numbers) -> Term:
    """Springs that hold nodes near their rest positions: a soft clamp.

    A clamp in `Scene.fixed` is exact and cheaper. Springs of the usual stiffness 1e9 shift the reference angle by
    2e-6 degrees and rule out float32. They are meant for comparison with codes that clamp in this way.

    Args:
        mesh: gives the rest positions.
        nodes: `(m,)` node numbers.
        stiffness: force per length, not negative; scalar or `(m,)`; differentiable.

    Raises:
        ValueError: if a node is out of range, or `stiffness` has another shape or is negative or not finite.
    """
    where = check_nodes("nodes", mesh, nodes, ndim=1)
    stiffness = checks.numbers("stiffness", stiffness, checks.NOT_NEGATIVE, ((), (where.size,)))
    xp, rest = namespace(stiffness), namespace(mesh.nodes).asarray(mesh.nodes)[where]
    values = xp.broadcast_to(xp.asarray(stiffness, mesh.nodes.dtype), (where.size,))
    return Term(SpringEnergy(), where[:, None], PointParams(rest, values))
