"""Derivatives of the energies of stencils, with respect to the positions of their nodes.

Any energy is differentiated as it is. That of a solid depends on positions through `H = F - I` alone, four numbers a
quadrature point, so its density is differentiated in these and the chain rule does the rest:

    dE/dx_ai = sum_q w g_ak P_ik,     d2E/dx_ai dx_bj = sum_q w g_ak D_ikjl g_bl,

with `P = d psi / d H`, `D = d2 psi / d H2` and `g` the gradients of the shape functions (summed over `k`, `l`). Each
component is a separate scalar until the end, and elements are the last axis of every array: XLA makes a few vectorised
loops of it, more than ten times as fast as derivatives by six coordinates.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxbeam.mesh.bernstein import least_ratio, minimiser, value
from jaxbeam.mesh.elements import corner_slopes, determinants, is_affine
from jaxbeam.physics.energy import Term
from jaxbeam.physics.projection import project_each, project_many
from jaxbeam.physics.solid import SolidEnergy, SolidParams


def stencil_gradients(term: Term, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Energies `(m,)` of the stencils of a term at node positions `x` `(n, 2)`, and their gradients `(m, k, 2)`."""
    positions = x[term.nodes]
    if not isinstance(term.energy, SolidEnergy):
        return jax.vmap(jax.value_and_grad(term.energy))(positions, term.params)
    gradients, weights, (density, *stress) = _at_points(_value_and_stress, term.energy, positions, term.params)
    first = weights * jnp.stack(stress).reshape(2, 2, *weights.shape)
    forces = gradients[:, 0, None] * first[None, :, 0] + gradients[:, 1, None] * first[None, :, 1]
    return _over_points(weights * density), jnp.moveaxis(_over_points(forces), -1, 0)


def stencil_hessian(term: Term, x: jax.Array, convex: bool = False) -> jax.Array:
    """Hessians `(2 k, 2 k, m)` of the stencils of a term at node positions `x` `(n, 2)`.

    With `convex`, positive semidefinite ones near them (see `jaxbeam.physics.projection`).
    """
    positions = x[term.nodes]
    m, k, d = positions.shape
    if not isinstance(term.energy, SolidEnergy):
        of_one = lambda flat, params: term.energy(flat.reshape(k, d), params)
        hessians = jax.vmap(jax.hessian(of_one))(positions.reshape(m, k * d), term.params)
        return jnp.moveaxis(project_each(hessians) if convex else hessians, 0, -1)
    gradients, weights, stiffness = _at_points(_stiffness, term.energy, positions, term.params)
    second = jnp.stack(stiffness)
    if convex:
        second = project_many(second.reshape(4, 4, -1))
    second = weights * second.reshape(2, 2, 2, 2, *weights.shape)
    # (a, i, j, l) and then (a, i, b, j); the last two axes are the points and the elements.
    left, right = gradients[:, :, None, None, None], gradients[None, None, :, None]
    half = left[:, 0] * second[None, :, 0] + left[:, 1] * second[None, :, 1]
    whole = half[:, :, None, :, 0] * right[:, :, :, :, 0] + half[:, :, None, :, 1] * right[:, :, :, :, 1]
    return _over_points(whole).reshape(k * d, k * d, m)


def _at_points(
    derivative: Callable[..., list[jax.Array]], energy: SolidEnergy, x: jax.Array, params: SolidParams
) -> tuple[jax.Array, jax.Array, list[jax.Array]]:
    """Shape-function gradients `(k, 2, q, m)`, weights `(q, m)`, and a derivative of the density at each point."""
    gradients = _shape_gradients(params)
    H = _interpolated(gradients, x - params.rest)
    components = [H[i, k] for i in range(2) for k in range(2)]
    of_one = lambda H, material: derivative(energy.density, H, material)
    each = jax.vmap(jax.vmap(of_one), in_axes=(0, None))(components, params.material)
    return gradients, params.weights.T, each


def _shape_gradients(params: SolidParams) -> jax.Array:
    """Gradients `(k, 2, q, m)` of the shape functions, with elements last."""
    return jnp.transpose(params.gradients, (2, 3, 1, 0))


def _interpolated(gradients: jax.Array, field: jax.Array) -> jax.Array:
    """Gradient `(2, 2, q, m)` of a field `(m, k, 2)`, from those of the shape functions `(k, 2, q, m)`."""
    nodes = zip(jnp.moveaxis(field, 0, -1), gradients, strict=True)
    return functools.reduce(jnp.add, (values[:, None, None] * slopes for values, slopes in nodes))


def _over_points(values: jax.Array) -> jax.Array:
    """The sum over quadrature points of `(..., q, m)`. Written out: XLA's own takes several times as long."""
    return functools.reduce(jnp.add, (values[..., q, :] for q in range(values.shape[-2])))


def volume_ratios(x: jax.Array, params: SolidParams) -> jax.Array:
    """`J = det F` `(q, m)` at the quadrature points of elements at positions `x` `(m, k, 2)`."""
    H = _interpolated(_shape_gradients(params), x - params.rest)
    return 1 + H[0, 0] + H[1, 1] + (H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0])


def smallest_ratios(x: jax.Array, params: SolidParams) -> jax.Array:
    """The smallest `J` `(m,)` anywhere in each element, quadrature point or not, at positions `x` `(m, k, 2)`.

    With six nodes it is the smallest ratio of two quadratic polynomials: by how much the present map and that of the
    rest positions stretch area. Positive just when no part of the element is turned inside out.
    """
    if is_affine(x.shape[1]):
        return jnp.min(volume_ratios(x, params), axis=0)
    area = _rest_areas(params)
    present, rest = (corner_slopes(jnp.moveaxis(places, 0, -1)) for places in (x, params.rest))
    return least_ratio(*(jnp.stack(determinants(slopes, slopes)) / area for slopes in (present, rest)))


def rest_is_sound(params: SolidParams) -> jax.Array:
    """Whether each element `(m,)` has positive area, and none of it is turned inside out, at rest."""
    positive = jnp.all(params.weights > 0, axis=1)
    if is_affine(params.rest.shape[1]):
        return positive
    slopes = corner_slopes(jnp.moveaxis(params.rest, 0, -1))
    stretch = jnp.stack(determinants(slopes, slopes)) / _rest_areas(params)
    return positive & (value(stretch, minimiser(stretch)) > 0)


def _rest_areas(params: SolidParams) -> jax.Array:
    """Twice the area `(1, m)` of each element at rest: of the size of what is divided by it, whatever the unit."""
    return 2 * jnp.sum(params.weights, axis=1)[None]


def admissible_step(
    x: jax.Array, dx: jax.Array, params: SolidParams, keep: float, bound: float = 0.0, inside: float = 0.0
) -> jax.Array:
    """Largest `t` `(m,)` for which no point of an element falls below `keep` times its present `J` on `x + t dx`.

    Infinite where `J` never falls so far. Elements of six nodes are not looked at beyond `t = 1`, and away from their
    quadrature points `J` may fall somewhat lower: to half of `keep` times the smallest `J` in the element.

    Args:
        x: `(m, k, 2)` positions of the nodes of each element.
        dx: `(m, k, 2)` the step.
        params: of the elements.
        keep: fraction of `J`.
        bound: quadrature points where `J` is at or under it already are left out.
        inside: of elements of six nodes whose smallest `J` is at or under it only the quadrature points are looked at.
    """
    gradients = _shape_gradients(params)
    H, D = _interpolated(gradients, x - params.rest), _interpolated(gradients, dx)
    F00, F11 = 1 + H[0, 0], 1 + H[1, 1]
    j = F00 * F11 - H[0, 1] * H[1, 0]
    b = F11 * D[0, 0] + F00 * D[1, 1] - H[1, 0] * D[0, 1] - H[0, 1] * D[1, 0]
    c = D[0, 0] * D[1, 1] - D[0, 1] * D[1, 0]
    at_points = _first_crossing((1 - keep) * j, b, c, j > bound)
    return at_points if is_affine(x.shape[1]) else _step_within(at_points, x, dx, params, keep, inside)


def _step_within(
    start: jax.Array, x: jax.Array, dx: jax.Array, params: SolidParams, keep: float, bound: float
) -> jax.Array:
    """The largest `t` `(m,)`, up to `start` and 1, by all points of elements of six nodes.

    At each point `J(t) = J + b t + c t^2` is no less than the smallest of `J`, `J + b T / 2` and `J(T)` for `t` up to
    `T`, its Bernstein coefficients. The last two are quadratic polynomials on the element. `T` is cut to where they
    reach `keep J` at the point where they are below it most, again and again, until they are nowhere below by more than
    half of `keep` times the smallest `J`. Each cut is 2 % at least, so that round-off does not keep it from ending.
    """
    area = _rest_areas(params)
    now, step = (corner_slopes(jnp.moveaxis(places, 0, -1)) for places in (x, dx))
    j, c = (jnp.stack(determinants(slopes, slopes)) / area for slopes in (now, step))
    b = (jnp.stack(determinants(now, step)) + jnp.stack(determinants(step, now))) / area
    # The axis before the elements: the two coefficients, less `keep J`.
    gap, b, c = (1 - keep) * j[:, None], jnp.stack([b / 2, b], axis=1), jnp.stack([jnp.zeros_like(c), c], axis=1)
    left = lambda t: gap + t[None, None] * (b + t[None, None] * c)

    def cut(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        _, t = carry
        least = value(j, minimiser(j))
        place = minimiser(left(t))
        low = value(left(t), place) < jnp.where(least > bound, -0.5 * keep * least, -jnp.inf)[None]
        crossing = _first_crossing(value(gap, place), value(b, place), value(c, place), low)
        return jnp.any(low), jnp.where(jnp.any(low, axis=0), jnp.minimum(0.98 * t, crossing), t)

    start = jnp.minimum(start, 1)
    # Most steps are short enough by the coefficients on the element alone, which are no more than what they bound.
    doubtful = jnp.any(left(start) < 0)
    return lax.while_loop(lambda carry: carry[0], cut, (doubtful, start))[1]


def _first_crossing(gap: jax.Array, b: jax.Array, c: jax.Array, counts: jax.Array) -> jax.Array:
    """The smallest `t > 0` `(m,)` at which any `gap + b t + c t^2` `(q, m)` that counts is zero; infinite if none is.

    That is how `J` varies in the plane: with `b = cof F : dH` and `c = det dH`. The first of the two roots is taken in
    the form that does not cancel.
    """
    discriminant = b**2 - 4 * c * gap
    denominator = jnp.sqrt(jnp.maximum(discriminant, 0)) - b
    crosses = counts & (discriminant >= 0) & (denominator > 0)
    return jnp.min(jnp.where(crosses, 2 * gap / jnp.where(crosses, denominator, 1), jnp.inf), axis=0)


@functools.lru_cache(maxsize=64)
def _of_components(density: Callable[[jax.Array, Any], jax.Array]) -> Callable[[list[jax.Array], Any], jax.Array]:
    """The density as a function of the four components of `H`. Jitted, so that it is traced once for all of its
    derivatives."""
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
