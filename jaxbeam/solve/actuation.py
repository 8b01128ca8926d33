"""What drives a scene, as data: where the way to an equilibrium begins, and the scenes on that way."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxbeam.core.tree import replace
from jaxbeam.physics.load import dead_load_energy
from jaxbeam.physics.tendon import TendonEnergy
from jaxbeam.scene.scene import Scene


def actuation(scene: Scene) -> tuple[Any, ...]:
    """What drives a scene: the commanded lengths of its tendons and its dead loads, an array for each such term."""
    driven = []
    for term in scene.terms:
        if isinstance(term.energy, TendonEnergy):
            driven.append(term.params.commanded)
        elif term.energy is dead_load_energy:
            driven.append(term.params.value)
    return tuple(driven)


def actuated(scene: Scene, values: tuple[Any, ...]) -> Scene:
    """The scene with another `actuation`."""
    left, terms = list(values), []
    for term in scene.terms:
        if isinstance(term.energy, TendonEnergy):
            term = replace(term, params=replace(term.params, commanded=left.pop(0)))
        elif term.energy is dead_load_energy:
            term = replace(term, params=replace(term.params, value=left.pop(0)))
        terms.append(term)
    return replace(scene, terms=tuple(terms))


class Origin(NamedTuple):
    """Where the way to an equilibrium begins: a state of the same scene under another actuation.

    actuation: as `actuation` gives it. x: `(n, 2)` positions of that state. ahead: `(n, 2)` how far the equilibrium is
    predicted to lie from it. known: `()` int32, 1 where there is such a prediction, else 0. first: `(n, 2)` where
    Newton's method starts, before `ahead` is added.
    """

    actuation: tuple[Any, ...]
    x: Any
    ahead: Any
    known: Any
    first: Any


def from_rest(scene: Scene, x: Any = None) -> Origin:
    """The origin without any actuation: ratio 1 and no dead load. The first attempt starts at `x`, by default at rest.

    It is made of arrays that are there already: arithmetic with JAX would compile a program for each shape.
    """
    rest = scene.mesh.nodes
    idle = []
    for term in scene.terms:
        if isinstance(term.energy, TendonEnergy):
            idle.append(term.params.natural)
        elif term.energy is dead_load_energy:
            idle.append(np.zeros(term.params.value.shape, term.params.value.dtype))
    return Origin(tuple(idle), rest, np.zeros(rest.shape, rest.dtype), np.int32(0), rest if x is None else x)


def from_neighbour(scene: Scene, x: Any, ahead: Any) -> Origin:
    """The origin in the equilibrium `x` of a `scene`, with a prediction `ahead` of it."""
    return Origin(actuation(scene), x, ahead, np.int32(1), x)
