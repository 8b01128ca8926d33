"""Where the way to an equilibrium begins, as data, and the scenes on that way."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core.tree import to_device
from jaxbeam.scene.scene import Scene, command, commands_of, partway, rest_commands


class Origin(NamedTuple):
    """A state of the same scene under other commands, from which its equilibrium is approached.

    commands: `(m,)` of that state.
    loaded: `()` the share of the loads that acts on it.
    x: `(n, d)` its positions.
    ahead: `(n, d)` how far the equilibrium is predicted to lie from it.
    known: `()` int32, 1 where there is such a prediction, else 0.
    first: `(n, d)` where Newton's method starts, before `ahead` is added.
    """

    commands: Any
    loaded: Any
    x: Any
    ahead: Any
    known: Any
    first: Any


def from_rest(scene: Scene, x: Any = None) -> Origin:
    """The origin without any actuation or load. The first attempt starts at `x`, by default at rest.

    It is made without arithmetic, for which JAX would compile a program for each shape.
    """
    rest = scene.mesh.nodes
    at_rest = rest_commands(scene)
    return Origin(
        commands=_kept(tuple(at_rest.tolist()), at_rest.shape, rest.dtype),
        loaded=_kept(0, (), rest.dtype),
        x=rest,
        ahead=_kept(0, rest.shape, rest.dtype),
        known=_kept(0, (), np.dtype(np.int32)),
        first=rest if x is None else x,
    )


@lru_cache(maxsize=64)
def _kept(values: float | tuple[float, ...], shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
    """Numbers on the device, kept: to send NumPy's there took a third of the time in which a call returns."""
    return to_device(np.broadcast_to(np.asarray(values, dtype), shape))


def from_neighbour(commands: Any, x: Any, ahead: Any) -> Origin:
    """The origin in the equilibrium `x` of other `commands` `(m,)`, with a prediction `ahead` of it."""
    return Origin(commands, np.ones((), commands.dtype), x, ahead, np.int32(1), x)


def scene_between(origin: Origin, scene: Scene, s: jax.Array) -> Scene:
    """The scene at the share `s` of the way from the origin, 0, to the scene itself, 1."""
    commands = (1 - s) * origin.commands + s * commands_of(scene)
    between = command(partway(scene, (1 - s) * origin.loaded + s), commands)
    # At the end it is the scene to the last bit. What no command changes is the same array in both.
    return jax.tree.map(lambda own, other: own if own is other else jnp.where(s == 1, own, other), scene, between)
