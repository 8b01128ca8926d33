"""The scenes between a known state and the scene to be solved, and how forces and supports change on the way."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core.tree import to_device
from jaxbeam.scene.evaluation import energy
from jaxbeam.scene.scene import Scene, at_places, command, commands_of, partway, places, rest_commands


class Origin(NamedTuple):
    """A known state of the scene under other commands, from which the equilibrium is approached.

    commands: `(m,)` commands of that state.
    loaded: `()` share of the loads that acts in it.
    x: `(n, d)` its positions.
    ahead: `(n, d)` predicted displacement from `x` to the equilibrium; zero if there is no prediction.
    known: `()` int32, 1 if `ahead` is a prediction, else 0.
    first: `(n, d)` positions that the first attempt starts from, before `ahead` is added.
    """

    commands: Any
    loaded: Any
    x: Any
    ahead: Any
    known: Any
    first: Any


def from_rest(scene: Scene, x: Any = None) -> Origin:
    """The origin at rest, without actuation or loads. The first attempt starts at `x` `(n, d)`, by default at rest.

    The arrays are made without JAX arithmetic, which would compile a program for each shape.
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
    """Constants on the device, cached: sending them there anew took a third of the time until a call returns."""
    return to_device(np.broadcast_to(np.asarray(values, dtype), shape))


def from_neighbour(commands: Any, x: Any, ahead: Any) -> Origin:
    """The origin at the equilibrium under other commands.

    Args:
        commands: `(m,)` the other commands.
        x: `(n, d)` positions of their equilibrium.
        ahead: `(n, d)` predicted displacement from `x` to the equilibrium to be solved for.
    """
    return Origin(commands, np.ones((), commands.dtype), x, ahead, np.int32(1), x)


def scene_between(origin: Origin, scene: Scene, s: jax.Array) -> Scene:
    """The scene at `s` `()`: commands and loads change linearly from the origin (`s = 0`) to `scene` (`s = 1`)."""
    commands = (1 - s) * origin.commands + s * commands_of(scene)
    between = command(partway(scene, (1 - s) * origin.loaded + s), commands)
    # At `s = 1` take the leaves of `scene`, to the last bit. A leaf that no command or load changes is the same array
    # in both.
    return jax.tree.map(lambda own, other: own if own is other else jnp.where(s == 1, own, other), scene, between)


def force_rate(scene_at: Callable[[jax.Array], Scene], s: jax.Array, x: jax.Array) -> jax.Array:
    """Derivative `(n, d)` in `s` of the energy's gradient at the state `x`, whose supports move with `s`."""

    def gradient(s: jax.Array) -> jax.Array:
        scene = scene_at(s)
        return jax.grad(energy, argnums=1)(scene, at_places(scene, x))

    return jax.jvp(gradient, (s,), (jnp.ones_like(s),))[1]


def support_rate(scene_at: Callable[[jax.Array], Scene], s: jax.Array) -> jax.Array:
    """Derivative `(n, d)` in `s` of the places of held coordinates; zero for the others."""
    return jax.jvp(lambda s: jnp.where(scene_at(s).held, places(scene_at(s)), 0), (s,), (jnp.ones_like(s),))[1]
