"""Solids: the energy density of a material, summed over the quadrature points of each element."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, namespace
from jaxbeam.mesh.elements import element_of
from jaxbeam.mesh.mesh import Mesh, check_triangles
from jaxbeam.physics import quadrature
from jaxbeam.physics.energy import Energy, Term
from jaxbeam.physics.materials import check_density, macklin_mueller, material_is_valid
from jaxbeam.physics.quadrature import Density, SolidParams, mapped
from jaxbeam.physics.volume import admissible_step, rest_is_sound, smallest_ratios

# An element under this `J` is let through zero, where its energy allows that: held back, it would be approached in ever
# smaller steps. It may well come back, and if it does not, the solution says so. Away from the quadrature points every
# energy allows it.
RELEASED = 0.1


@dataclasses.dataclass(frozen=True)
class SolidEnergy(Energy):
    """Energy of one element: the density summed over its quadrature points. What must stay positive is `J`."""

    density: Density
    name: ClassVar[str] = "solid"
    body: ClassVar[bool] = True
    fills: ClassVar[bool] = True
    coordinates: ClassVar[int | None] = 2

    def __call__(self, x: jax.Array, params: SolidParams) -> jax.Array:
        densities = jax.vmap(lambda H: self.density(H, params.material))(displacement_gradients(x, params))
        return jnp.sum(params.weights * densities)

    def gradients(self, x: jax.Array, params: SolidParams) -> tuple[jax.Array, jax.Array]:
        return quadrature.energies_and_gradients(self.density, x, params)

    def hessians(self, x: jax.Array, params: SolidParams, convex: bool = False) -> jax.Array:
        return quadrature.hessians(self.density, x, params, convex)

    def valid(self, params: SolidParams) -> jax.Array:
        return jnp.all(rest_is_sound(params)) & material_is_valid(params.material)

    def margin(self, x: jax.Array, params: SolidParams) -> jax.Array:
        return smallest_ratios(x, params)

    def longest_step(self, x: jax.Array, dx: jax.Array, params: SolidParams, keep: float) -> jax.Array:
        """Quadrature points of a density that forbids inversion always keep their share; all else only while `J` is
        over `RELEASED`."""
        bound = 0.0 if forbids_inversion(self.density, params) else RELEASED
        return admissible_step(x, dx, params, keep, bound, RELEASED)

    def refined(self, term: Term, mesh: Mesh, parts: int) -> Term:
        material = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf), parts, axis=0), term.params.material)
        degree = element_of(term.nodes).degree_of(term.params.weights.shape[1])
        return solid(mesh, material, self.density, max(degree, element_of(mesh.elements).degree))

    def at_points(self, x: jax.Array, params: SolidParams, measure: Callable[..., jax.Array]) -> jax.Array:
        def one(x: jax.Array, params: SolidParams) -> jax.Array:
            of_point = lambda H: measure(H, self.density, params.material)
            return jax.vmap(of_point)(displacement_gradients(x, params))

        return jax.vmap(one)(x, params)


def forbids_inversion(density: Density, params: SolidParams) -> bool:
    """Whether the density is infinite or undefined for an inverted element, as a logarithmic one is."""
    ones = jax.tree.map(lambda leaf: np.ones(leaf.shape[1:], leaf.dtype), params.material)
    inverted = np.array([[-1.5, 0.0], [0.0, 0.0]], params.rest.dtype)
    # That it may be NaN is what is asked.
    with jax.ensure_compile_time_eval(), jax.debug_nans(False):
        return not np.isfinite(jax.jit(density)(inverted, ones))


def displacement_gradients(x: jax.Array, params: SolidParams) -> jax.Array:
    """`H = F - I` `(q, 2, 2)` of one element at its quadrature points."""
    return jnp.einsum("ki,qkj->qij", x - params.rest, params.gradients)


@usual_rules
def solid(
    mesh: Mesh,
    params: Any,
    density: Density = macklin_mueller,
    degree: int | None = None,
) -> Term:
    """The body itself.

    Args:
        mesh: with nodes `(n, 2)`; differentiable in them.
        params: the density's parameters, such as `lame(young, poisson)`: a pytree whose leaves are scalars
            or have leading axis `t`, one entry for each element. Cast to the dtype of the nodes.
        density: `(H, params) -> scalar`, one of `jaxbeam.physics.materials` or your own module-level function.
        degree: of the polynomials in the density that the quadrature takes exactly, one that the element has a rule
            for: 1, 2, 4 or 5. By default 1 (one point) for triangles of three nodes, where that is exact for any
            density, and 2 (three points) for six.

    Raises:
        ValueError: if a parameter is neither a scalar nor of leading axis `t` or is not finite, there is no rule of
            that degree, or the density returns no scalar or is not that of `H = F - I`.
    """
    check_triangles(mesh)
    element = element_of(mesh.elements)
    total, dtype = mesh.elements.shape[0], mesh.nodes.dtype
    xp = namespace(mesh.nodes, *jax.tree.leaves(params))

    def per_element(path: Any, value: Numbers) -> jax.Array:
        name = f"params{jax.tree_util.keystr(path)}"
        array = xp.asarray(checks.numbers(name, value), dtype)
        if array.ndim == 0:
            return xp.full((total,), array)
        if array.shape[0] != total:
            raise ValueError(
                f"{name}: expected a scalar or {total} entries, one for each {element.name}, got shape {array.shape}"
            )
        return array

    material = jax.tree_util.tree_map_with_path(per_element, params)
    check_density(density, material)
    degree = element.degree if degree is None else checks.count("degree", degree, 1)
    rest, gradients, weights = mapped(mesh.nodes, mesh.elements, degree)
    return Term(SolidEnergy(density), mesh.elements, SolidParams(rest, gradients, weights, material))
