"""What is measured on a beam: angles, positions, lengths, tensions, stresses, energies.

Each takes the scene and node positions `x` `(n, 2)`, is pure, and is differentiable in both.
Angles are in degrees, everything else in the user's units.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.scene import Scene, solid_terms, tendon_terms
from jaxbeam.scene import smallest_jacobian as smallest_jacobian
from jaxbeam.terms import SolidEnergy, SolidParams, TendonEnergy, displacement_gradients


def tip_angle(scene: Scene, x: jax.Array) -> jax.Array:
    """Deflection of the tip `()` in degrees, `atan2(mean transverse displacement of the tip, length)`.

    The beam's axis runs from the centroid of the clamped nodes to that of the tip nodes, both at rest;
    length is their distance, and transverse is to its left. For the reference scene this is
    `atan2(mean over the right edge of (y - y_rest), length)`.

    Raises:
        ValueError: if the scene has no tip or no clamped node.
    """
    along, length = _axis(scene)
    moved = tip_position(scene, x) - tip_position(scene, scene.mesh.nodes)
    return jnp.rad2deg(jnp.arctan2(along[0] * moved[1] - along[1] * moved[0], length))


def tip_position(scene: Scene, x: jax.Array) -> jax.Array:
    """Mean position `(2,)` of the tip nodes.

    Raises:
        ValueError: if the scene has no tip.
    """
    return jnp.mean(x[_tip(scene)], axis=0)


def section_rotation(scene: Scene, x: jax.Array) -> jax.Array:
    """Rotation of the tip section `()` in degrees, anticlockwise: the rigid turn that fits it best.

    Least squares in the plane (Kabsch 1976): `atan2(sum X x y, sum X . y)` about the centroids.

    Raises:
        ValueError: if the scene has fewer than two tip nodes.
    """
    tip = _tip(scene)
    if tip.shape[0] < 2:
        raise ValueError(f"scene: expected at least two tip nodes to measure a rotation, got {tip.shape[0]}")
    before, after = scene.mesh.nodes[tip], x[tip]
    before, after = before - before.mean(axis=0), after - after.mean(axis=0)
    sine = jnp.sum(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0])
    return jnp.rad2deg(jnp.arctan2(sine, jnp.sum(before * after)))


def tendon_lengths(scene: Scene, x: jax.Array) -> jax.Array:
    """Present length of each tendon, `(m,)`."""
    return _over_tendons(scene, x, lambda energy: energy.length)


def tendon_tensions(scene: Scene, x: jax.Array) -> jax.Array:
    """Force `dE/dl = k (l - l*)` of each tendon, `(m,)`; positive when it pulls its ends together."""
    return _over_tendons(scene, x, lambda energy: energy.tension)


def cauchy_stress(scene: Scene, x: jax.Array) -> jax.Array:
    """Cauchy stress `(t, 2, 2)` in the plane, one for each element of the solid: `P F^T / J`.

    `P = d psi / d H` is the first Piola-Kirchhoff stress (Bonet and Wood 2008, eq. 5.49). Averaged over
    an element's quadrature points.
    """
    return _over_elements(scene, x, _stress)


def strain_energy(scene: Scene, x: jax.Array) -> jax.Array:
    """Elastic energy `(t,)` of each element of the solid; sum it for the body's."""
    found = [jax.vmap(t.energy)(x[t.nodes], t.params) for t in solid_terms(scene)]
    return jnp.concatenate([*found, jnp.zeros(0, x.dtype)])


def jacobians(scene: Scene, x: jax.Array) -> jax.Array:
    """`J = det F` `(t,)` of each element of the solid, averaged over its quadrature points."""
    return _over_elements(scene, x, lambda H, density, material: jnp.linalg.det(H + jnp.eye(2, dtype=H.dtype)))


def _stress(H: jax.Array, density: Callable[..., jax.Array], material: Any) -> jax.Array:
    F = H + jnp.eye(2, dtype=H.dtype)
    return jax.grad(density)(H, material) @ F.T / jnp.linalg.det(F)


def _over_elements(scene: Scene, x: jax.Array, measure: Callable[..., jax.Array]) -> jax.Array:
    """`measure(H, density, material)` on every element of the solids, averaged with the quadrature weights."""
    found = []
    for term in solid_terms(scene):
        assert isinstance(term.energy, SolidEnergy)
        density = term.energy.density

        def one(positions: jax.Array, params: SolidParams, density: Callable = density) -> jax.Array:
            values = jax.vmap(lambda H: measure(H, density, params.material))(displacement_gradients(positions, params))
            return jnp.tensordot(params.weights / jnp.sum(params.weights), values, axes=1)

        found.append(jax.vmap(one)(x[term.nodes], term.params))
    if not found:
        raise ValueError("scene: expected a solid term, got none; stress and J are measured on solids")
    return jnp.concatenate(found)


def _over_tendons(scene: Scene, x: jax.Array, measure: Callable[[TendonEnergy], Callable[..., jax.Array]]) -> jax.Array:
    """A measure of each tendon, `(m,)`."""
    found = []
    for term in tendon_terms(scene):
        assert isinstance(term.energy, TendonEnergy)
        found.append(jax.vmap(measure(term.energy))(x[term.nodes], term.params))
    return jnp.concatenate([*found, jnp.zeros(0, x.dtype)])


def _tip(scene: Scene) -> np.ndarray:
    if scene.tip.shape[0] == 0:
        raise ValueError("scene: its tip is empty; give Scene(..., tip=nodes) the nodes of the end section")
    return scene.tip


def _axis(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """Unit vector `(2,)` from clamp to tip at rest, and their distance `()`."""
    held = scene.fixed.all(axis=1)
    if not held.any():
        raise ValueError("scene: no node is clamped, so the beam has no axis to measure its angle from")
    rest = scene.mesh.nodes
    span = tip_position(scene, rest) - jnp.mean(rest[np.flatnonzero(held)], axis=0)
    length = jnp.sqrt(jnp.sum(span**2))
    return span / length, length
