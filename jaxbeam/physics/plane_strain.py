"""Stress out of the plane, `sigma_zz`, of each density of `jaxbeam.physics.materials`.

In plane strain nothing moves out of the plane and `F_zz = 1`. The stress there is a reaction to that, and the energy in
the plane does not tell it: it is the derivative of the energy in three dimensions,

    sigma_zz = F_zz / J  d psi / d F_zz     at F_zz = 1,

from the Cauchy stress `P F^T / J` with `P = d psi / d F`, as in `cauchy_stress`. With `|F|^2` and `J` those in the
plane, each energy in three dimensions is that of its source (see `jaxbeam.physics.materials`) with
`|F3|^2 = |F|^2 + F_zz^2` and `J3 = J F_zz`. At `F_zz = 1` each is the density in the plane, as it must be.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxbeam.physics.materials import (
    Lame,
    distortion_and_volume,
    linear_elastic,
    macklin_mueller,
    neo_hookean,
    saint_venant_kirchhoff,
)


def _macklin_mueller(H: jax.Array, params: Lame) -> jax.Array:
    """`mu/2 (|F3|^2 - 3) - mu (J3 - 1) + lam/2 (J3 - 1)^2`, so `sigma_zz = (J - 1)(lam - mu / J)`.

    Source: Macklin and Mueller 2021, where this is `mu/2 (|F3|^2 - 3) + lam/2 (J3 - 1 - mu/lam)^2` less a constant.
    """
    _, volume = distortion_and_volume(H)
    return volume * (params.lam - params.mu / (1 + volume))


def _neo_hookean(H: jax.Array, params: Lame) -> jax.Array:
    """`mu/2 (|F3|^2 - 3) - mu ln J3 + lam/2 (ln J3)^2`, so `sigma_zz = lam ln J / J`."""
    _, volume = distortion_and_volume(H)
    return params.lam * jnp.log1p(volume) / (1 + volume)


def _saint_venant_kirchhoff(H: jax.Array, params: Lame) -> jax.Array:
    """`mu E:E + lam/2 (tr E)^2`, so `S_zz = lam tr E` and `sigma_zz = S_zz / J`."""
    _, volume = distortion_and_volume(H)
    return params.lam * (jnp.trace(H) + 0.5 * jnp.sum(H * H)) / (1 + volume)


def _linear_elastic(H: jax.Array, params: Lame) -> jax.Array:
    """`mu e:e + lam/2 (tr e)^2`, so `P_zz = lam tr e`, and like the stress in the plane it is divided by `J`."""
    _, volume = distortion_and_volume(H)
    return params.lam * jnp.trace(H) / (1 + volume)


_KNOWN: dict[Any, Callable[[jax.Array, Any], jax.Array]] = {
    macklin_mueller: _macklin_mueller,
    neo_hookean: _neo_hookean,
    saint_venant_kirchhoff: _saint_venant_kirchhoff,
    linear_elastic: _linear_elastic,
}


def out_of_plane(density: Callable[[jax.Array, Any], jax.Array]) -> Callable[[jax.Array, Any], jax.Array]:
    """The function `(H, params) -> sigma_zz` that belongs to a density `(H, params) -> psi`.

    Raises:
        ValueError: if the density is not one of `jaxbeam.physics.materials`.
    """
    if density not in _KNOWN:
        names = ", ".join(known.__name__ for known in _KNOWN)
        raise ValueError(
            f"scene: expected solids of {names} to tell the stress out of the plane, got the density "
            f"{getattr(density, '__name__', density)!r}. The energy of H in the plane does not tell it; use "
            f"cauchy_stress and principal_stretches, and add sigma_zz by your own formula"
        )
    return _KNOWN[density]
