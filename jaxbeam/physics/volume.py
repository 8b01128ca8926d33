"""`J = det F` of elements: its smallest value anywhere, and how far a step may go before it falls too low.

In a triangle of three nodes `J` is one number. In other elements it is a ratio of two polynomials, whose smallest value
the element's record finds (`jaxbeam.mesh.element`). The quadrature points alone do not show that an element is turned
inside out between them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from jaxbeam.mesh.element import Determinant, least_ratio
from jaxbeam.mesh.elements import element_of
from jaxbeam.physics.quadrature import SolidParams, interpolated, shape_gradients


def volume_ratios(x: jax.Array, params: SolidParams) -> jax.Array:
    """`J = det F` `(q, m)` at the quadrature points of elements at positions `x` `(m, k, 2)`."""
    H = interpolated(shape_gradients(params), x - params.rest)
    return 1 + H[0, 0] + H[1, 1] + (H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0])


def smallest_ratios(x: jax.Array, params: SolidParams) -> jax.Array:
    """The smallest `J` `(m,)` anywhere in each element, quadrature point or not, at positions `x` `(m, k, 2)`.

    Unless `J` is constant on an element, it is the smallest ratio of two polynomials: by how much the present map and
    that of the rest positions stretch area. Positive just when no part of the element is turned inside out.
    """
    determinant = element_of(x).determinant
    if determinant is None:
        return jnp.min(volume_ratios(x, params), axis=0)
    return least_ratio(determinant, *(_stretch(determinant, places, params) for places in (x, params.rest)))


def rest_is_sound(params: SolidParams) -> jax.Array:
    """Whether each element `(m,)` has positive area, and none of it is turned inside out, at rest."""
    positive = jnp.all(params.weights > 0, axis=1)
    determinant = element_of(params.rest).determinant
    if determinant is None:
        return positive
    return positive & (determinant.least(_stretch(determinant, params.rest, params)) > 0)


def _stretch(determinant: Determinant, x: jax.Array, params: SolidParams) -> jax.Array:
    """Coefficients `(b, m)` of the determinant of the map at `x` `(m, k, 2)`, over its mean at rest."""
    slopes = determinant.slopes(jnp.moveaxis(x, 0, -1))
    return determinant.coefficients(slopes, slopes) / _rest_stretch(params)


def _rest_stretch(params: SolidParams) -> jax.Array:
    """The mean determinant `(1, m)` of the map of each element at rest. Divided by it, others are of order 1 whatever
    the unit of length."""
    return jnp.sum(params.weights, axis=1)[None] / element_of(params.rest).area


def admissible_step(
    x: jax.Array, dx: jax.Array, params: SolidParams, keep: float, bound: float = 0.0, inside: float = 0.0
) -> jax.Array:
    """Largest `t` `(m,)` for which no point of an element falls below `keep` times its present `J` on `x + t dx`.

    Infinite where `J` never falls so far. Elements on which `J` varies are not looked at beyond `t = 1`, and away from
    their quadrature points `J` may fall somewhat lower: to half of `keep` times the smallest `J` in the element.

    Args:
        x: `(m, k, 2)` positions of the nodes of each element.
        dx: `(m, k, 2)` the step.
        params: of the elements.
        keep: fraction of `J`.
        bound: quadrature points where `J` is at or under it already are left out.
        inside: of elements whose smallest `J` is at or under it only the quadrature points are looked at.
    """
    gradients = shape_gradients(params)
    H, D = interpolated(gradients, x - params.rest), interpolated(gradients, dx)
    F00, F11 = 1 + H[0, 0], 1 + H[1, 1]
    j = F00 * F11 - H[0, 1] * H[1, 0]
    b = F11 * D[0, 0] + F00 * D[1, 1] - H[1, 0] * D[0, 1] - H[0, 1] * D[1, 0]
    c = D[0, 0] * D[1, 1] - D[0, 1] * D[1, 0]
    at_points = _first_crossing((1 - keep) * j, b, c, j > bound)
    determinant = element_of(x).determinant
    return at_points if determinant is None else _step_within(determinant, at_points, x, dx, params, keep, inside)


def _step_within(
    determinant: Determinant,
    start: jax.Array,
    x: jax.Array,
    dx: jax.Array,
    params: SolidParams,
    keep: float,
    bound: float,
) -> jax.Array:
    """The largest `t` `(m,)`, up to `start` and 1, by all points of elements on which `J` varies.

    At each point `J(t) = J + b t + c t^2` is no less than the smallest of `J`, `J + b T / 2` and `J(T)` for `t` up to
    `T`, its Bernstein coefficients. The last two are polynomials on the element. `T` is cut to where they
    reach `keep J` at the point where they are below it most, again and again, until they are nowhere below by more than
    half of `keep` times the smallest `J`. Each cut is 2 % at least, so that round-off does not keep it from ending.
    """
    scale, of, value = _rest_stretch(params), determinant.coefficients, determinant.value
    now, step = (determinant.slopes(jnp.moveaxis(places, 0, -1)) for places in (x, dx))
    j, c = (of(slopes, slopes) / scale for slopes in (now, step))
    b = (of(now, step) + of(step, now)) / scale
    # The axis before the elements: the two coefficients, less `keep J`.
    gap, b, c = (1 - keep) * j[:, None], jnp.stack([b / 2, b], axis=1), jnp.stack([jnp.zeros_like(c), c], axis=1)
    left = lambda t: gap + t[None, None] * (b + t[None, None] * c)

    def cut(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        _, t = carry
        least = determinant.least(j)
        place = determinant.minimiser(left(t))
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
