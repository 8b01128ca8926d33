"""Cables: tendons that only pull. A slack cable has no force and no energy.

Use them for threads, and `tendons` for springs. At rest all cables are slack. Where `reach` finds no way from there,
give it `starts` at which some are taut.

With the length `l`, the commanded length `l*` and the stretch `s = l - l*` of a cable, the energy is

    k w^2 h(s / w)

with the one-sided law `h` of `jaxbeam.physics.one_sided`. Over the transition width `w` the stiffness rises linearly
from 0 to `k`.
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
from jaxbeam.core.tree import Numbers, namespace, pytree
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import Finer
from jaxbeam.physics.energy import Term
from jaxbeam.physics.one_sided import one_sided, one_sided_slope
from jaxbeam.physics.tendon import TendonEnergy, TendonParams, inverse_square_stiffness, tendons


@pytree
class CableParams(TendonParams):
    """Parameters of cables: those of tendons and one more.

    transition: `(m,)` stretch `w`, a length, over which a slack cable becomes taut.
    """

    transition: Any = None


@dataclasses.dataclass(frozen=True)
class CableEnergy(TendonEnergy):
    """A tendon that pulls and does not push."""

    name: ClassVar[str] = "cable"

    def __call__(self, x: jax.Array, params: Any) -> jax.Array:
        stiffness = self.stiffness(params.modulus, params.commanded)
        return stiffness * params.transition**2 * one_sided(self._stretch(x, params))

    def tension(self, x: jax.Array, params: Any) -> jax.Array:
        """`dE/dl` `()`: zero when slack, else positive."""
        stiffness = self.stiffness(params.modulus, params.commanded)
        return stiffness * params.transition * one_sided_slope(self._stretch(x, params))

    def _stretch(self, x: jax.Array, params: Any) -> jax.Array:
        """Stretch beyond the commanded length, relative to the transition width: `s / w` `()`."""
        return (self.length(x, params) - params.commanded) / params.transition

    def valid(self, params: Any) -> jax.Array:
        return super().valid(params) & jnp.all(params.transition > 0)

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        same = super().refined(term, mesh, finer)
        return same if same is term else _as_cables(same, self.stiffness, term.params.transition)


@usual_rules
def cables(
    mesh: Mesh,
    nodes: Numbers,
    modulus: Numbers,
    stiffness: Callable[[jax.Array, jax.Array], jax.Array] = inverse_square_stiffness,
    width: Numbers = 0.0,
    transition: Numbers = 0.01,
    shared: bool = False,
    natural: Numbers | None = None,
) -> Term:
    """Tendons that only pull, at their natural length (ratio 1); `command` shortens them.

    Args:
        mesh: as for `tendons`.
        nodes: as for `tendons`.
        modulus: as for `tendons`.
        stiffness: as for `tendons`.
        width: as for `tendons`.
        transition: stretch over which a slack cable becomes taut, relative to the natural length, positive; scalar or
            `(m,)`; differentiable. If it is small, the stiffness changes sharply, which is hard for Newton's method.
        shared: as for `tendons`.
        natural: as for `tendons`; a cable with slack is longer than its ends are apart.

    Raises:
        ValueError: as `tendons` does, or if a transition is not positive and finite.
    """
    term = tendons(mesh, nodes, modulus, stiffness, width, shared, natural)
    shares = checks.numbers("transition", transition, checks.POSITIVE, ((), (len(term.nodes),)), "one for each cable")
    lengths = term.params.natural
    xp = namespace(shares, lengths)
    return _as_cables(term, stiffness, xp.asarray(shares, mesh.nodes.dtype) * xp.asarray(lengths))


def _as_cables(term: Term, stiffness: Callable[[jax.Array, jax.Array], jax.Array], transition: Any) -> Term:
    """A term of cables with the nodes and parameters of two-way tendons. `transition` `(m,)` is a length."""
    shared = {field.name: getattr(term.params, field.name) for field in dataclasses.fields(TendonParams)}
    energy = CableEnergy(stiffness, term.kind.points, term.kind.shared_command)  # type: ignore[attr-defined]
    return Term(energy, np.asarray(term.nodes), CableParams(**shared, transition=transition))
