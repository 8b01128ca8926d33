"""Values at the nodes from values in the elements: smoother to look at and, of stress, more accurate.

Where two materials meet, stress and strain jump, and a value at the nodes is a mean of both sides. At a node that no
solid reaches it is zero.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import one_program
from jaxbeam.mesh.element import Element
from jaxbeam.mesh.elements import element_of
from jaxbeam.physics.energy import Term
from jaxbeam.scene.measures import at_points_of, stress_of
from jaxbeam.scene.scene import Scene, check_scene, placed
from jaxbeam.scene.stress import stress_with_normal, von_mises


@one_program
def nodal_stress(scene: Scene, x: jax.Array) -> jax.Array:
    """Cauchy stress `(n, 2, 2)` in the plane, recovered at the nodes: smoother than `cauchy_stress`, and more accurate.

    In each element a field that is linear in the weights of its corners is fitted to the stress at the quadrature
    points, by least squares with their weights, and carried to the nodes. At a node the elements that meet there are
    averaged, weighted by area at rest (local smoothing: Hinton and Campbell 1974, Int. J. Numer. Methods Eng. 8,
    461-480).

    Raises:
        ValueError: if the scene has no solid, or a solid has quadrature points of a rule that is not in
            `jaxbeam.mesh.elements`.
    """
    return _recovered(scene, x, stress_of)


@one_program
def nodal_von_mises_stress(scene: Scene, x: jax.Array) -> jax.Array:
    """Von Mises stress `(n,)` at the nodes: of the stress that is recovered there as by `nodal_stress`, and of
    `out_of_plane_stress` recovered likewise.

    Raises:
        ValueError: as `nodal_stress` and `out_of_plane_stress` do.
    """
    return jax.vmap(von_mises)(_recovered(scene, x, stress_with_normal))


@one_program
def to_nodes(scene: Scene, values: jax.Array) -> jax.Array:
    """Values of the elements carried to the nodes, such as `J` or energy density for a smooth picture.

    At a node the elements that meet there are averaged, weighted by area at rest. Of six-node triangles this is a value
    for each element; `nodal_stress` also uses how the stress changes within them.

    Args:
        scene: with `n` nodes.
        values: `(t, ...)`, one for each element of the solids, in the order of the terms; differentiable.

    Returns:
        `(n, ...)`.

    Raises:
        ValueError: if the scene has no solid, or `values` has another shape.
    """
    check_scene(scene)
    solids = [term for term in scene.terms if term.kind.fills]
    if not solids:
        raise ValueError("scene: expected a solid term, got none; values of elements are those of solids")
    found, count = jnp.asarray(checks.real("values", values)), sum(len(term.nodes) for term in solids)
    if found.shape[:1] != (count,):
        raise ValueError(f"values: expected shape ({count}, ...), one for each element, got {found.shape}")
    ends = np.cumsum([len(term.nodes) for term in solids])[:-1]
    each = [
        jnp.broadcast_to(part[:, None], (*term.nodes.shape, *part.shape[1:]))
        for term, part in zip(solids, jnp.split(found, ends), strict=True)
    ]
    return _averaged(len(scene.mesh.nodes), list(zip(solids, each, strict=True)))


def _recovered(scene: Scene, x: jax.Array, measure: Callable[..., jax.Array]) -> jax.Array:
    """`measure(H, density, material)` `(n, ...)` at the nodes, as `nodal_stress` recovers it."""
    x = placed(scene, x)
    parts = []
    for term, values in at_points_of(scene, x, measure):
        recover = jnp.asarray(points_to_nodes(element_of(term.nodes), values.shape[1]), x.dtype)
        parts.append((term, jnp.einsum("kq,mq...->mk...", recover, values)))
    return _averaged(len(x), parts)


def points_to_nodes(element: Element, points: int) -> np.ndarray:
    """The matrix `(k, q)` from values at `q` quadrature points to those of the field that fits them best, at the `k`
    nodes of the element. The field is linear in the weights of the corners. Too few points do not fix it: of those
    that fit the least is taken, which for one point is constant."""
    places, shares = element.rule(element.degree_of(points))
    root = np.sqrt(shares)
    return element.places @ (np.linalg.pinv(root[:, None] * places) * root)


def _averaged(count: int, parts: list[tuple[Term, jax.Array]]) -> jax.Array:
    """Means `(n, ...)` at `n` nodes of values `(m, k, ...)` at the nodes of the elements of each term."""
    first = parts[0][1]
    total, area = jnp.zeros((count, *first.shape[2:]), first.dtype), jnp.zeros(count, first.dtype)
    for term, values in parts:
        areas = jnp.sum(term.params.weights, axis=1)
        total = total.at[term.nodes].add(jnp.einsum("m,m...->m...", areas, values))
        area = area.at[term.nodes].add(areas[:, None])
    return jnp.einsum("n,n...->n...", 1 / jnp.where(area > 0, area, 1), total)
