"""Supports: coordinates of nodes that are moved by a command, such as those of a grip.

Use a support where a displacement is given and its force is asked for. For what never moves use `clamped`.

The displacement of a held coordinate is its motion times the command. Such a coordinate is no unknown: it is where its
support puts it, and the force that this takes is its reaction (`jaxbeam.reactions`). So a support has no energy.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, namespace, pytree, replace, spread
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import Finer, heirs
from jaxbeam.physics.energy import Energy, Term, check_nodes


@pytree
class SupportParams:
    """Parameters of `m` nodes.

    motion: `(m, d)` displacement for each unit of the command; zero for coordinates that are not held.
    moved: `(m,)` the command, the same for all.
    """

    motion: Any
    moved: Any


@dataclasses.dataclass(frozen=True)
class SupportEnergy(Energy):
    """A support. It has no energy; its command says how far it is moved.

    holds: which coordinates of its nodes it holds.
    """

    holds: tuple[bool, ...]
    name: ClassVar[str] = "support"
    rest_command: ClassVar[float | None] = 0.0
    shared_command = True
    command_hint: ClassVar[str] = "it is how far the support is moved, in multiples of its motion"

    def __call__(self, x: jax.Array, params: SupportParams) -> jax.Array:
        return jnp.zeros((), x.dtype)

    def displacements(self, params: SupportParams) -> jax.Array:
        return (params.moved[:, None] * params.motion)[:, None]

    def command(self, params: SupportParams, values: jax.Array) -> SupportParams:
        return replace(params, moved=spread(values, params.moved))

    def command_of(self, params: SupportParams) -> jax.Array:
        return params.moved[:1]

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        nodes = heirs(finer, mesh, np.asarray(term.nodes)[:, 0])
        # Row of each coarse node in `motion`; heirs have no share of nodes that are not held.
        row = np.zeros(finer.coarse, int)
        row[np.asarray(term.nodes)[:, 0]] = np.arange(len(term.nodes))
        motion, moved = finer.carry(term.params.motion[row])[nodes], term.params.moved
        moved = namespace(moved).broadcast_to(moved[:1], (len(nodes),))
        return Term(self, nodes[:, None], SupportParams(motion.astype(mesh.nodes.dtype), moved))


@usual_rules
def support(
    mesh: Mesh,
    nodes: Numbers,
    x: Numbers | None = None,
    y: Numbers | None = None,
    angle: Numbers | None = None,
    value: Numbers = 0.0,
) -> Term:
    """Prescribed displacements of some nodes, moved by one command. Coordinates that are not given stay free.

    `support(mesh, right, x=1.0)` moves the nodes `right` in x by the command, and lets them slide in y;
    `x=1.0, y=0.0` holds them in y. A coordinate that never moves belongs in `Scene.fixed`, which costs less.

    Args:
        mesh: of triangles, or the line of a rod.
        nodes: `(m,)` node numbers, each once.
        x: displacement in x for each unit of the command; a number, or `(m,)`; differentiable.
        y: the same in y.
        angle: of a rod, the turn in radians for each unit of the command.
        value: the command, as set by `command`; differentiable.

    Raises:
        ValueError: if a node is out of range or repeated, no coordinate is given, an argument has another shape or is
            not finite, or `angle` is given for triangles. `Scene` raises it if another support or `fixed` holds a
            coordinate too.
    """
    chosen = check_nodes("nodes", mesh, nodes, ndim=1)
    if len(np.unique(chosen)) < len(chosen):
        raise ValueError(f"nodes: expected each node once, got {chosen.tolist()}")
    given: dict[str, Any] = {"x": x, "y": y, "angle": angle}
    if angle is not None and not mesh.is_line:
        raise ValueError("angle: the nodes of triangles do not turn; give x and y, for a small turn -Y and X")
    names = list(given)[: mesh.nodes.shape[1]]
    holds = tuple(given[name] is not None for name in names)
    if not any(holds):
        raise ValueError("x, y: expected the motion of at least one coordinate, such as x=1.0, got none")
    count, dtype = len(chosen), mesh.nodes.dtype
    columns = []
    for name in names:
        column = checks.numbers(name, 0.0 if given[name] is None else given[name], shapes=((), (count,)))
        scale = mesh.radian if name == "angle" else 1.0
        xp = namespace(column, scale)
        columns.append(xp.broadcast_to(xp.asarray(column, dtype) * xp.asarray(scale, dtype), (count,)))
    motion = namespace(*columns).stack(columns, axis=1)
    xp, value = namespace(value), checks.number("value", value)
    moved = xp.broadcast_to(xp.asarray(value, dtype), (count,))
    return Term(SupportEnergy(holds), chosen[:, None], SupportParams(motion, moved))
