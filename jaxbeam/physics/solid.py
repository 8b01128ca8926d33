"""Solids: the energy density of a material, summed over the quadrature points of each element.

A body of several materials is one `solid` with parameters for each element. `elements_where` finds those of a segment.
"""

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
from jaxbeam.mesh.refinement import Finer
from jaxbeam.physics import quadrature
from jaxbeam.physics.energy import Energy, Term
from jaxbeam.physics.materials import check_density, macklin_mueller, material_is_valid
from jaxbeam.physics.quadrature import Density, SolidParams, mapped
from jaxbeam.physics.volume import admissible_step, rest_is_sound, smallest_ratios

# An element whose `J` is at most this may pass through `J = 0`, if its density is finite there. If it were held back,
# steps towards `J = 0` would get ever smaller. The element may recover later. If it does not, the solution reports it.
# Between the quadrature points the density is not evaluated, so every density allows `J = 0` there.
RELEASED = 0.1


@dataclasses.dataclass(frozen=True)
class SolidEnergy(Energy):
    """Energy of one element: the density summed over its quadrature points. Its margin is the smallest `J`."""

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
        """The largest `t` `(m,)` for which `x + t dx` keeps the fraction `keep` of `J`.

        A quadrature point is ignored if its `J` is at most `RELEASED`, unless the density forbids inversion. The rest
        of an element is ignored if its smallest `J` is at most `RELEASED`.
        """
        bound = 0.0 if forbids_inversion(self.density, params) else RELEASED
        return admissible_step(x, dx, params, keep, bound, RELEASED)

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        material = jax.tree.map(lambda leaf: namespace(leaf).repeat(leaf, finer.parts, axis=0), term.params.material)
        degree = element_of(term.nodes).degree_of(term.params.weights.shape[1])
        return solid(mesh, material, self.density, max(degree, element_of(mesh.elements).degree))

    def at_points(self, x: jax.Array, params: SolidParams, measure: Callable[..., jax.Array]) -> jax.Array:
        def one(x: jax.Array, params: SolidParams) -> jax.Array:
            of_point = lambda H: measure(H, self.density, params.material)
            return jax.vmap(of_point)(displacement_gradients(x, params))

        return jax.vmap(one)(x, params)


def forbids_inversion(density: Density, params: SolidParams) -> bool:
    """Whether the density is infinite or NaN in an inverted element, as a logarithmic density is."""
    ones = jax.tree.map(lambda leaf: np.ones(leaf.shape[1:], leaf.dtype), params.material)
    inverted = np.array([[-1.5, 0.0], [0.0, 0.0]], params.rest.dtype)
    # A NaN is an expected result here, so `jax_debug_nans` must not raise.
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
    """The elastic body.

    The default density is that of the reference scene. With `lame(young, poisson)` it is softer at small strain than
    they say, the more so the smaller Poisson's ratio is: for (1e4, 0.3) it shows 8974 and 0.167. For a body of your own
    take `neo_hookean`, or `lame_macklin_mueller`.

    Args:
        mesh: mesh of triangles with nodes `(n, 2)`; differentiable in them.
        params: the density's parameters, such as `lame(young, poisson)`: a pytree whose leaves are scalars
            or have leading axis `t`, one entry for each element. Cast to the dtype of the nodes.
        density: `(H, params) -> scalar`, one of `jaxbeam.physics.materials` or your own module-level function.
        degree: degree of polynomials that the quadrature integrates exactly; triangles have rules for 1, 2, 4 and 5. By
            default 1 (one point) for triangles of three nodes, where that is exact for any density, and 2 (three
            points) for triangles of six.

    Raises:
        ValueError: if a parameter is neither a scalar nor of leading axis `t` or is not finite, there is no rule of
            that degree, or the density returns no scalar or is not written in `H = F - I`.
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
