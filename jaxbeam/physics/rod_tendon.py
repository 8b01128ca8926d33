"""Tendons beside the axis of a rod."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, namespace, pytree, replace
from jaxbeam.mesh.line import Line, beside
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import Finer
from jaxbeam.physics.energy import NotRefinable, Term
from jaxbeam.physics.tendon import (
    TendonEnergy,
    TendonParams,
    from_first,
    inverse_square_stiffness,
    polyline_length,
    tendons,
)


@pytree
class Offsets:
    """Positions of the points of tendons on the sections of a rod.

    eccentricity: `(m, k)` distance of each point from its node, along the section to the left of the axis.
    radian: `(m,)` as in `Line`.
    """

    eccentricity: jax.Array
    radian: jax.Array


def at_offsets(x: jax.Array, attachment: Offsets) -> jax.Array:
    """The points `(..., k, 2)` of a tendon whose nodes have coordinates `x` `(..., k, 3)`."""
    return beside(x, attachment.eccentricity, attachment.radian)


@dataclasses.dataclass(frozen=True)
class RodTendonEnergy(TendonEnergy):
    """A tendon whose points lie beside the nodes of a rod, on their sections."""

    points: Callable[[jax.Array, Any], jax.Array] = at_offsets
    coordinates: ClassVar[int | None] = 3

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        raise NotRefinable("it is tied to the sections of a rod")

    def without_limit(self, term: Term, mesh: Mesh, free: np.ndarray) -> str:
        return ""

    def resolution(self, term: Term, mesh: Mesh, free: np.ndarray) -> dict[int, float]:
        return {}

    def arms(self, x: jax.Array, params: TendonParams) -> jax.Array:
        return jnp.stack([x[..., :2], self.line(x, params)], axis=-2)


@usual_rules
def rod_tendons(
    line: Line,
    nodes: Numbers,
    eccentricity: Numbers,
    modulus: Numbers,
    stiffness: Callable[[jax.Array, jax.Array], jax.Array] = inverse_square_stiffness,
) -> Term:
    """Tendons beside the axis of a rod, at their natural length (ratio 1); `command` shortens them.

    Args:
        line: its rest positions determine the natural lengths, which are differentiable in them.
        nodes: `(m, k)` node numbers: for each tendon its first end, any guides, and its second end.
        eccentricity: distance of each point from its node, to the left of the axis; scalar or `(m, k)`; differentiable.
        modulus: as for `tendons`.
        stiffness: as for `tendons`.

    Raises:
        ValueError: if `eccentricity` has another shape or is not finite, or as `tendons` does.
    """
    checks.instance("line", line, Line, "on a mesh of triangles use tendons")
    # `tendons` checks the nodes and the modulus. Its lengths, measured between nodes, are replaced below.
    plain = tendons(line, nodes, modulus, stiffness)
    eccentricity = checks.numbers(
        "eccentricity", eccentricity, shapes=((), plain.nodes.shape), each="one for each point"
    )
    dtype, xp = line.nodes.dtype, namespace(line.nodes, line.radian, eccentricity)
    offsets = Offsets(
        xp.broadcast_to(xp.asarray(eccentricity, dtype), plain.nodes.shape),
        xp.broadcast_to(xp.asarray(line.radian), plain.nodes.shape[:1]),
    )
    natural = polyline_length(at_offsets(from_first(xp.asarray(line.nodes)[plain.nodes]), offsets))
    return Term(
        RodTendonEnergy(stiffness),
        plain.nodes,
        replace(plain.params, natural=natural, commanded=natural, attachment=offsets),
    )
