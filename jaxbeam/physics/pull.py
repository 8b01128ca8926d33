"""Cables commanded by their tension, as by a weight on a pulley or a force-controlled motor.

With the tension `T` and the present length `l` the energy is `T l`. Its slope in `l` is the tension, whatever the
length. Without tension there is no energy and no force.

Use `pulls` where the force is known, and `cables` or `tendons` where the length that is wound in is known. Under a
given force a body may snap where under a given length it would not.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, index_field, namespace, pytree, replace, spread, to_device
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import Finer
from jaxbeam.physics.energy import Term
from jaxbeam.physics.tendon import LineEnergy, tendons, without_filling


@pytree
class PullParams:
    """Parameters of `m` cables: `tension` `(m,)`, differentiable, and the others as in `TendonParams`."""

    tension: jax.Array
    attachment: Any = None
    width: Any = None
    ends: Any = index_field(default=None)


@dataclasses.dataclass(frozen=True)
class PullEnergy(LineEnergy):
    """Energy `T l` of one cable. Its command is the tension `T`."""

    points: Callable[[jax.Array, Any], jax.Array]
    shared_command: bool = False
    name: ClassVar[str] = "cable"
    rest_command: ClassVar[float | None] = 0.0
    commands: ClassVar[checks.Range] = checks.NOT_NEGATIVE
    command_hint: ClassVar[str] = "it is a tension, and a cable only pulls"

    def __call__(self, x: jax.Array, params: PullParams) -> jax.Array:
        return params.tension * self.length(x, params)

    def tension(self, x: jax.Array, params: PullParams) -> jax.Array:
        return params.tension

    def command(self, params: PullParams, values: jax.Array) -> PullParams:
        return replace(params, tension=to_device(spread(values, params.tension)))

    def command_of(self, params: PullParams) -> jax.Array:
        return params.tension[:1] if self.shared_command else params.tension

    def valid(self, params: PullParams) -> jax.Array:
        return jnp.all(params.tension >= 0)

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        params = term.params
        if params.width is None:
            return term
        tension = params.tension[0] if self.shared_command else params.tension
        return pulls(mesh, without_filling(params.ends), tension, np.asarray(params.width), self.shared_command)


@usual_rules
def pulls(mesh: Mesh, nodes: Numbers, tension: Numbers = 0.0, width: Numbers = 0.0, shared: bool = False) -> Term:
    """Cables under a tension that `command` sets, without tension at rest. They mix with tendons of any kind.

    Args:
        mesh: as for `tendons`.
        nodes: as for `tendons`.
        tension: force, not negative; scalar or `(m,)`; differentiable.
        width: as for `tendons`.
        shared: whether one tension commands all of them, such as that of one motor; then give one `tension`.

    Raises:
        ValueError: as `tendons` does, or if a tension is negative or not finite.
    """
    like = tendons(mesh, nodes, 1.0, width=width, shared=shared)
    shapes, meaning = (((),), "one for all") if shared else (((), (len(like.nodes),)), "one for each cable")
    tension = checks.numbers("tension", tension, checks.NOT_NEGATIVE, shapes, meaning)
    xp = namespace(tension)
    values = xp.broadcast_to(xp.asarray(tension, mesh.nodes.dtype), (len(like.nodes),))
    params = PullParams(values, like.params.attachment, like.params.width, like.params.ends)
    return Term(PullEnergy(like.kind.points, shared), np.asarray(like.nodes), params)  # type: ignore[attr-defined]
