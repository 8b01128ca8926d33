"""Stress out of the plane, von Mises stress, stretches and energy density of each element of the solids.

Use `von_mises_stress` for yielding, and `principal_stretches` for how far a soft material is stretched. The stress in
the plane is in `cauchy_stress` and `nodal_stress`.

Each takes the scene and node positions `x` `(n, 2)`, is pure, differentiable in both, and runs under `jit` and `vmap`.
Values are means over the quadrature points of an element, in the order of the terms, as those of `cauchy_stress`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxbeam.core.compiling import one_program
from jaxbeam.physics.plane_strain import out_of_plane
from jaxbeam.scene.measures import over_elements, stress_of
from jaxbeam.scene.scene import Scene


@one_program
def out_of_plane_stress(scene: Scene, x: jax.Array) -> jax.Array:
    """Cauchy stress `sigma_zz` `(t,)` out of the plane, one for each element of the solid, in the unit of stress.

    In plane strain nothing moves in z, and this is the stress that holds it so. Its formula for each density is in
    `jaxbeam.physics.plane_strain`. For `linear_elastic` it is divided by `J`, like the rest of `cauchy_stress`.

    Raises:
        ValueError: if `x` has another shape, the scene has no solid, or a solid has a density of your own: the energy
            in the plane does not tell this stress.
    """
    return over_elements(scene, x, lambda H, density, material: out_of_plane(density)(H, material))


@one_program
def von_mises_stress(scene: Scene, x: jax.Array) -> jax.Array:
    """Von Mises stress `(t,)`, one for each element of the solid, not negative, in the unit of stress.

    `sqrt(((s_xx - s_yy)^2 + (s_yy - s_zz)^2 + (s_zz - s_xx)^2) / 2 + 3 s_xy^2)` of the Cauchy stress with
    `s_zz` the `out_of_plane_stress` (von Mises 1913; any textbook). It is a mean of the values at quadrature points.
    Where the stress is a pressure alone, as at rest, it has no derivative, and this one is 0.

    Raises:
        ValueError: as `out_of_plane_stress` does.
    """

    return over_elements(scene, x, lambda *point: von_mises(stress_with_normal(*point)))


@one_program
def principal_stretches(scene: Scene, x: jax.Array) -> jax.Array:
    """Principal stretches `(t, 2)` in the plane, the larger first, one pair for each element of the solid.

    They are the singular values of `F`; their product is `J`, and in an inverted element the smaller is negative. With
    `q = |(F_11 + F_22, F_21 - F_12)|` and `r = |(F_11 - F_22, F_12 + F_21)|` they are `(q + r) / 2` and `(q - r) / 2`
    (Blinn 1996, IEEE Computer Graphics and Applications 16(2), 82-88). Where both are equal, as at rest, they have no
    derivative, and that of their mean is returned for both.

    Raises:
        ValueError: if `x` has another shape, or the scene has no solid.
    """

    def measure(H: jax.Array, density: Any, material: Any) -> jax.Array:
        a, b, c, d = H[0, 0], H[0, 1], H[1, 0], H[1, 1]
        q, r = _root((2 + a + d) ** 2 + (c - b) ** 2), _root((a - d) ** 2 + (b + c) ** 2)
        return 0.5 * jnp.stack([q + r, q - r])

    return over_elements(scene, x, measure)


@one_program
def strain_energy_density(scene: Scene, x: jax.Array) -> jax.Array:
    """Elastic energy `(t,)` of each element of the solid by its area at rest, in the unit of stress.

    Unlike `strain_energy` it does not depend on the size of the elements.

    Raises:
        ValueError: if `x` has another shape, or the scene has no solid.
    """
    return over_elements(scene, x, lambda H, density, material: density(H, material))


def stress_with_normal(H: jax.Array, density: Any, material: Any) -> jax.Array:
    """Cauchy stresses `s_xx, s_yy, s_xy, s_zz` `(4,)` at a point."""
    s = stress_of(H, density, material)
    return jnp.stack([s[0, 0], s[1, 1], 0.5 * (s[0, 1] + s[1, 0]), out_of_plane(density)(H, material)])


def von_mises(stress: jax.Array) -> jax.Array:
    """Von Mises stress `()` of the stresses `(4,)` of `stress_with_normal`."""
    xx, yy, shear, zz = stress
    return _root(0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) + 3 * shear**2)


def _root(value: jax.Array) -> jax.Array:
    """The square root of a number that is not negative, with derivative 0 at 0."""
    positive = value > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1)), 0)
