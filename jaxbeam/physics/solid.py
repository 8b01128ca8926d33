"""Solids: the energy density of a material, summed over the quadrature points of each element."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, namespace, pytree
from jaxbeam.mesh.elements import rule, shape_slopes
from jaxbeam.mesh.mesh import Mesh, check_triangles
from jaxbeam.physics.energy import Term
from jaxbeam.physics.materials import check_density, macklin_mueller

# ---------------------------------------------------------------------------------------------- solid


@pytree
class SolidParams:
    """Parameters of elements with `k` nodes and `q` quadrature points (leading axis `m` in a `Term`).

    rest `(m, k, 2)`: rest positions. gradients `(m, q, k, 2)`: shape-function gradients in the rest frame.
    weights `(m, q)`: quadrature weight times rest area. material: pytree with leading axis `m`.
    """

    rest: jax.Array
    gradients: jax.Array
    weights: jax.Array
    material: Any


@dataclasses.dataclass(frozen=True)
class SolidEnergy:
    """Energy of one element: the density summed over its quadrature points. Hashable, so never retraced."""

    density: Callable[[jax.Array, Any], jax.Array]

    def __call__(self, x: jax.Array, params: SolidParams) -> jax.Array:
        densities = jax.vmap(lambda H: self.density(H, params.material))(displacement_gradients(x, params))
        return jnp.sum(params.weights * densities)


def forbids_inversion(energy: SolidEnergy, params: SolidParams) -> bool:
    """Whether the density is infinite or undefined for an inverted element, as a logarithmic one is."""
    ones = jax.tree.map(lambda leaf: np.ones(leaf.shape[1:], leaf.dtype), params.material)
    inverted = np.array([[-1.5, 0.0], [0.0, 0.0]], params.rest.dtype)
    # That it may be NaN is what is asked.
    with jax.ensure_compile_time_eval(), jax.debug_nans(False):
        return not np.isfinite(jax.jit(energy.density)(inverted, ones))


def displacement_gradients(x: jax.Array, params: SolidParams) -> jax.Array:
    """`H = F - I` `(q, 2, 2)` of one element at its quadrature points."""
    return jnp.einsum("ki,qkj->qij", x - params.rest, params.gradients)


@usual_rules
def solid(
    mesh: Mesh,
    params: Any,
    density: Callable[[jax.Array, Any], jax.Array] = macklin_mueller,
    degree: int | None = None,
) -> Term:
    """The body itself.

    Args:
        mesh: with nodes `(n, 2)`; differentiable in them.
        params: the density's parameters, such as `lame(young, poisson)`: a pytree whose leaves are scalars
            or have leading axis `t`, one entry for each triangle. Cast to the dtype of the nodes.
        density: `(H, params) -> scalar`, one of `jaxbeam.physics.materials` or your own module-level function.
        degree: of the polynomials in the density that the quadrature takes exactly, of `jaxbeam.elements.DEGREES`. By
            default 1 (one point) for triangles of three nodes, where that is exact for any density, and 2 (three
            points) for six.

    Raises:
        ValueError: if a parameter is neither a scalar nor of leading axis `t` or is not finite, there is no rule of
            that degree, or the density returns no scalar or is not that of `H = F - I`.
    """
    check_triangles(mesh)
    total, dtype = mesh.elements.shape[0], mesh.nodes.dtype
    xp = namespace(mesh.nodes, *jax.tree.leaves(params))

    def per_element(path: Any, value: Numbers) -> jax.Array:
        name = f"params{jax.tree_util.keystr(path)}"
        array = xp.asarray(checks.numbers(name, value), dtype)
        if array.ndim == 0:
            return xp.full((total,), array)
        if array.shape[0] != total:
            raise ValueError(
                f"{name}: expected a scalar or {total} entries, one for each triangle, got shape {array.shape}"
            )
        return array

    material = jax.tree_util.tree_map_with_path(per_element, params)
    check_density(density, material)
    rest = xp.asarray(mesh.nodes)[mesh.elements]
    usual = 1 if rest.shape[1] == 3 else 2
    points, shares = rule(usual if degree is None else checks.count("degree", degree, 1))
    # How a triangle is mapped from the reference one, and the inverse of that, at each point.
    slopes = xp.asarray(shape_slopes(rest.shape[1], points), dtype)
    map_ = xp.einsum("mkd,qki->mqdi", rest, slopes)
    determinant = map_[..., 0, 0] * map_[..., 1, 1] - map_[..., 0, 1] * map_[..., 1, 0]
    inverse = xp.stack([map_[..., 1, 1], -map_[..., 0, 1], -map_[..., 1, 0], map_[..., 0, 0]], axis=-1)
    inverse = inverse.reshape(map_.shape) / determinant[..., None, None]
    gradients = xp.einsum("qki,mqid->mqkd", slopes, inverse)
    weights = 0.5 * xp.asarray(shares, dtype) * determinant
    return Term(SolidEnergy(density), mesh.elements, SolidParams(rest, gradients, weights, material))
