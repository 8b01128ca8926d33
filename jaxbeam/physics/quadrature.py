"""Derivatives of energies that are a density summed over quadrature points.

Such an energy depends on positions only through `H = F - I`, four numbers at each quadrature point. So the density
`psi` is differentiated in these four numbers, and the chain rule gives

    dE/dx_ai = sum_q w g_ak P_ik,     d2E/dx_ai dx_bj = sum_q w g_ak D_ikjl g_bl,

with `P = d psi / d H`, `D = d2 psi / d H2`, `w` the weights and `g` the gradients of the shape functions (summed over
`k`, `l`). Each component is a separate scalar until the end, and elements are the last axis of every array. XLA makes a
few vectorised loops of this, more than ten times as fast as derivatives by the six coordinates of a triangle.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core.tree import namespace, pytree
from jaxbeam.mesh.element import edge_rule, edge_slopes
from jaxbeam.mesh.elements import element_of
from jaxbeam.physics.projection import project_many


@pytree
class SolidParams:
    """Parameters of `m` elements with `k` nodes and `q` quadrature points.

    rest: `(m, k, 2)` rest positions.
    gradients: `(m, q, k, 2)` gradients of the shape functions in the rest positions.
    weights: `(m, q)` quadrature weight times rest area.
    material: pytree of the density's parameters with leading axis `m`.
    """

    rest: jax.Array
    gradients: jax.Array
    weights: jax.Array
    material: Any


Density = Callable[[jax.Array, Any], jax.Array]


def mapped(nodes: Any, elements: np.ndarray, degree: int) -> tuple[Any, Any, Any]:
    """Shape-function gradients and weights at the quadrature points of elements. Differentiable in the nodes.

    Args:
        nodes: `(n, 2)` rest positions.
        elements: `(m, k)` node numbers.
        degree: degree of the polynomials on the reference element that the quadrature rule integrates exactly.

    Returns:
        The `rest`, `gradients` and `weights` of `SolidParams`.
    """
    xp, element = namespace(nodes), element_of(elements)
    points, shares = element.rule(degree)
    rest = xp.asarray(nodes)[elements]
    # Derivative of the map from the reference element at each point, and its inverse. Positions are relative to the
    # first node, so that a body far from the origin loses no digits.
    slopes = xp.asarray(element.slopes(points), nodes.dtype)
    map_ = xp.einsum("mkd,qki->mqdi", rest - rest[:, :1], slopes)
    determinant = map_[..., 0, 0] * map_[..., 1, 1] - map_[..., 0, 1] * map_[..., 1, 0]
    inverse = xp.stack([map_[..., 1, 1], -map_[..., 0, 1], -map_[..., 1, 0], map_[..., 0, 0]], axis=-1)
    inverse = inverse.reshape(map_.shape) / determinant[..., None, None]
    gradients = xp.einsum("qki,mqid->mqkd", slopes, inverse)
    return rest, gradients, element.area * xp.asarray(shares, nodes.dtype) * determinant


def edge_lengths(nodes: Any, edges: np.ndarray, points: int) -> Any:
    """Weights times length at rest `(m, q)`, by `edge_rule(points)`, of edges `(m, k)`. Differentiable in the nodes."""
    xp = namespace(nodes)
    (xi, shares), rest = edge_rule(points), xp.asarray(nodes)[edges]
    along = xp.einsum("qk,mkd->mqd", xp.asarray(edge_slopes(edges.shape[1], xi), nodes.dtype), rest - rest[:, :1])
    return xp.sqrt(xp.sum(along**2, axis=2)) * xp.asarray(shares, nodes.dtype)


def energies_and_gradients(density: Density, x: jax.Array, params: SolidParams) -> tuple[jax.Array, jax.Array]:
    """Energies `(m,)` of elements at positions `x` `(m, k, 2)`, and their gradients `(m, k, 2)`."""
    gradients, weights, (values, *stress) = _at_points(_value_and_stress, density, x, params)
    first = weights * jnp.stack(stress).reshape(2, 2, *weights.shape)
    forces = gradients[:, 0, None] * first[None, :, 0] + gradients[:, 1, None] * first[None, :, 1]
    return _over_points(weights * values), jnp.moveaxis(_over_points(forces), -1, 0)


def hessians(density: Density, x: jax.Array, params: SolidParams, convex: bool) -> jax.Array:
    """Hessians `(2 k, 2 k, m)` of elements at positions `x` `(m, k, 2)`.

    If `convex`, the second derivatives of the density at each point are projected, so the Hessians are positive
    semidefinite.
    """
    m, k, d = x.shape
    gradients, weights, stiffness = _at_points(_stiffness, density, x, params)
    second = jnp.stack(stiffness)
    if convex:
        second = project_many(second.reshape(4, 4, -1))
    second = weights * second.reshape(2, 2, 2, 2, *weights.shape)
    # Axes (a, i, j, l) of `half` and (a, i, b, j) of `whole`, each followed by the points and the elements.
    left, right = gradients[:, :, None, None, None], gradients[None, None, :, None]
    half = left[:, 0] * second[None, :, 0] + left[:, 1] * second[None, :, 1]
    whole = half[:, :, None, :, 0] * right[:, :, :, :, 0] + half[:, :, None, :, 1] * right[:, :, :, :, 1]
    return _over_points(whole).reshape(k * d, k * d, m)


def _at_points(
    derivative: Callable[..., list[jax.Array]], density: Density, x: jax.Array, params: SolidParams
) -> tuple[jax.Array, jax.Array, list[jax.Array]]:
    """Shape-function gradients `(k, 2, q, m)`, weights `(q, m)`, and the components `(q, m)` of a derivative.

    Args:
        derivative: `(density, H, material) -> components`, at one point.
        density: as in `SolidEnergy`.
        x: `(m, k, 2)` positions.
        params: parameters of the elements.
    """
    gradients = shape_gradients(params)
    H = interpolated(gradients, x - params.rest)
    components = [H[i, k] for i in range(2) for k in range(2)]
    of_one = lambda H, material: derivative(density, H, material)
    each = jax.vmap(jax.vmap(of_one), in_axes=(0, None))(components, params.material)
    return gradients, params.weights.T, each


def shape_gradients(params: SolidParams) -> jax.Array:
    """Gradients `(k, 2, q, m)` of the shape functions, with elements last."""
    return jnp.transpose(params.gradients, (2, 3, 1, 0))


def interpolated(gradients: jax.Array, field: jax.Array) -> jax.Array:
    """Gradient `(2, 2, q, m)` of a nodal `field` `(m, k, 2)`, from the `shape_gradients` `(k, 2, q, m)`."""
    nodes = zip(jnp.moveaxis(field, 0, -1), gradients, strict=True)
    return functools.reduce(jnp.add, (values[:, None, None] * slopes for values, slopes in nodes))


def _over_points(values: jax.Array) -> jax.Array:
    """Sum of `(..., q, m)` over the quadrature points, written out: XLA's own sum takes several times as long."""
    return functools.reduce(jnp.add, (values[..., q, :] for q in range(values.shape[-2])))


@functools.lru_cache(maxsize=64)
def _of_components(density: Callable[[jax.Array, Any], jax.Array]) -> Callable[[list[jax.Array], Any], jax.Array]:
    """The density as a function of the four components of `H`.

    It is jitted, so that it is traced only once for all of its derivatives.
    """
    return jax.jit(lambda H, material: density(jnp.stack([jnp.stack(H[:2]), jnp.stack(H[2:])]), material))


def _unit(H: list[jax.Array], which: int) -> list[jax.Array]:
    return [jnp.ones_like(h) if i == which else jnp.zeros_like(h) for i, h in enumerate(H)]


def _value_and_stress(density: Callable[..., jax.Array], H: list[jax.Array], material: Any) -> list[jax.Array]:
    """The density and its four first derivatives at one point."""
    value, change = jax.linearize(lambda H: _of_components(density)(H, material), H)
    return [value, *(change(_unit(H, i)) for i in range(4))]


def _stiffness(density: Callable[..., jax.Array], H: list[jax.Array], material: Any) -> list[jax.Array]:
    """The sixteen second derivatives of the density at one point."""
    _, change = jax.linearize(lambda H: _value_and_stress(density, H, material)[1:], H)
    columns = [change(_unit(H, j)) for j in range(4)]
    return [columns[max(i, j)][min(i, j)] for i in range(4) for j in range(4)]
