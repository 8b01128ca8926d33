"""What is measured on a beam: angles, positions, lengths, tensions, stresses, energies.

Each takes the scene and node positions `x` `(n, 2)`, of a rod `(n, 3)`, is pure, and is differentiable in both. An `x`
of another shape is refused: for many states use `jax.vmap`. Any function of your own of this form serves `reach`,
`estimate_error` and `corrected` as well.

`tip_angle` is how far the tip has moved aside, and stays below 90 degrees. Where a beam curls, use `section_rotation`.
`cauchy_stress` jumps between elements. For the stress at a place use `nodal_stress`.

Angles are in degrees, everything else in the user's units.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core.compiling import one_program
from jaxbeam.physics.energy import Term
from jaxbeam.scene.scene import Scene, placed


@one_program
def tip_angle(scene: Scene, x: jax.Array) -> jax.Array:
    """Deflection of the tip `()` in degrees, `atan2(mean transverse displacement of the tip, length)`.

    The beam's axis runs from the centroid of the clamped nodes to that of the tip nodes, both at rest;
    length is their distance, and transverse is to its left. For the reference scene this is
    `atan2(mean over the right edge of (y - y_rest), length)`.

    Raises:
        ValueError: if `x` has another shape, the scene has no tip or no clamped node, or its whole tip is clamped.
    """
    x = placed(scene, x)
    if scene.fixed[_tip(scene)][:, :2].all():
        raise ValueError(
            "scene: its tip is clamped, so the tip angle is always 0; give Scene(..., tip=nodes) that move"
        )
    along, length = _axis(scene)
    moved = jnp.mean((x - scene.mesh.nodes)[scene.tip, :2], axis=0)
    return jnp.rad2deg(jnp.arctan2(along[0] * moved[1] - along[1] * moved[0], length))


@one_program
def tip_position(scene: Scene, x: jax.Array) -> jax.Array:
    """Mean position `(2,)` of the tip nodes.

    Raises:
        ValueError: if `x` has another shape, or the scene has no tip.
    """
    return jnp.mean(placed(scene, x)[_tip(scene)][:, :2], axis=0)


@one_program
def section_rotation(scene: Scene, x: jax.Array) -> jax.Array:
    """Rotation `()` of the tip section in degrees, anticlockwise: the rigid turn that fits it best.

    By least squares in the plane (Kabsch 1976) it is `atan2(sum cross(X, y), sum dot(X, y))`, with `X` the rest
    positions of the tip nodes less their mean and `y` the present ones less theirs. It lies between -180 and 180. Of a
    rod it is the mean turn of the tip nodes, which may exceed 360.

    Raises:
        ValueError: if `x` has another shape, the scene has no tip, or the tip of a solid has fewer than two nodes.
    """
    x = placed(scene, x)
    tip = _tip(scene)
    if scene.mesh.is_line:
        return jnp.rad2deg(jnp.mean((x - scene.mesh.nodes)[tip, 2]) / scene.mesh.radian)
    if tip.shape[0] < 2:
        raise ValueError(f"scene: expected at least two tip nodes to measure a rotation, got {tip.shape[0]}")
    before, after = scene.mesh.nodes[tip], x[tip]
    before, after = before - before.mean(axis=0), after - after.mean(axis=0)
    sine = jnp.sum(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0])
    return jnp.rad2deg(jnp.arctan2(sine, jnp.sum(before * after)))


@one_program
def tendon_lengths(scene: Scene, x: jax.Array) -> jax.Array:
    """Present length of each tendon, `(m,)`."""
    return _measured(scene, x, "length")


@one_program
def tendon_tensions(scene: Scene, x: jax.Array) -> jax.Array:
    """Force `dE/dl = k (l - l*)` of each tendon, `(m,)`; positive when it pulls its ends together."""
    return _measured(scene, x, "tension")


@one_program
def tendon_slack(scene: Scene, x: jax.Array) -> jax.Array:
    """Whether each tendon is slack, `(m,)` booleans: a cable without tension. A two-way tendon never is; it pushes."""
    return tendon_tensions(scene, x) == 0


@one_program
def guide_forces(scene: Scene, x: jax.Array) -> list[jax.Array]:
    """Forces of tendons and cables on the body at each of their points: their ends and guides.

    Returns:
        For each term of tendons or cables `(m, p, 2)`. Those of one tendon balance. A row that was given with fewer
        points than others ends in zeros, after its last end.
    """
    x = placed(scene, x)
    found = [term.kind.line_forces(x[term.nodes], term.params) for term in scene.terms]
    return [forces for forces in found if forces is not None]


@one_program
def contact_forces(scene: Scene, x: jax.Array) -> jax.Array:
    """Force of the obstacle on each edge that may touch one, `(m, 2)`, over all terms of contact."""
    return _measured(scene, x, "contact_force", (2,))


@one_program
def contact_pressures(scene: Scene, x: jax.Array) -> jax.Array:
    """Largest pressure on each edge that may touch an obstacle, `(m,)`, of those at its quadrature points."""
    return _measured(scene, x, "contact_pressure")


@one_program
def penetration(scene: Scene, x: jax.Array) -> jax.Array:
    """How deep each edge that may touch an obstacle lies inside it, `(m,)`; zero outside."""
    return _measured(scene, x, "penetration")


@one_program
def cauchy_stress(scene: Scene, x: jax.Array) -> jax.Array:
    """Cauchy stress `(t, 2, 2)` in the plane, one for each element of the solid: `P F^T / J`.

    `P = d psi / d H` is the first Piola-Kirchhoff stress (Bonet and Wood 2008, eq. 5.49). Averaged over
    an element's quadrature points.
    """
    return over_elements(scene, x, stress_of)


@one_program
def strain_energy(scene: Scene, x: jax.Array) -> jax.Array:
    """Elastic energy `(t,)` of each element of solids and rods, in the order of the terms; sum it for the body's."""
    x = placed(scene, x)
    found = [jax.vmap(t.energy)(x[t.nodes], t.params) for t in scene.terms if t.kind.body]
    return jnp.concatenate([*found, jnp.zeros(0, x.dtype)])


@one_program
def jacobians(scene: Scene, x: jax.Array) -> jax.Array:
    """`J = det F` `(t,)` of each element of the solid, averaged over its quadrature points."""
    return over_elements(scene, x, lambda H, density, material: jnp.linalg.det(H + jnp.eye(2, dtype=H.dtype)))


def stress_of(H: jax.Array, density: Callable[..., jax.Array], material: Any) -> jax.Array:
    """Cauchy stress `(2, 2)` at a point: `P F^T / J`, as in `cauchy_stress`."""
    F = H + jnp.eye(2, dtype=H.dtype)
    return jax.grad(density)(H, material) @ F.T / jnp.linalg.det(F)


def at_points_of(scene: Scene, x: jax.Array, measure: Callable[..., jax.Array]) -> list[tuple[Term, jax.Array]]:
    """For each solid, `measure(H, density, material)` at the quadrature points of its elements, `(m, q, ...)`."""
    x = placed(scene, x)
    asked = [(term, term.kind.at_points(x[term.nodes], term.params, measure)) for term in scene.terms]
    found = [(term, values) for term, values in asked if values is not None]
    if not found:
        raise ValueError("scene: expected a solid term, got none; stress and J are measured on solids")
    return found


def over_elements(scene: Scene, x: jax.Array, measure: Callable[..., jax.Array]) -> jax.Array:
    """`measure(H, density, material)` on every element of the solids, averaged with the quadrature weights."""
    mean = jax.vmap(lambda weights, values: jnp.tensordot(weights / jnp.sum(weights), values, axes=1))
    return jnp.concatenate([mean(term.params.weights, values) for term, values in at_points_of(scene, x, measure)])


def _measured(scene: Scene, x: jax.Array, name: str, shape: tuple[int, ...] = ()) -> jax.Array:
    """What the terms measure under this name, `(m, *shape)`, in their order."""
    x = placed(scene, x)
    found = [term.kind.measured(x[term.nodes], term.params) for term in scene.terms]
    return jnp.concatenate([*(each[name] for each in found if name in each), jnp.zeros((0, *shape), x.dtype)])


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
    span = tip_position(scene, rest) - jnp.mean(rest[np.flatnonzero(held)][:, :2], axis=0)
    length = jnp.sqrt(jnp.sum(span**2))
    return span / length, length
