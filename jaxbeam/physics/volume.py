"""`J = det F` of elements: its smallest value anywhere, and how far a step may go before it falls too low.

In an element of three nodes `J` is one number. In one of six it is a ratio of quadratic polynomials, whose smallest
value is found exactly (`jaxbeam.mesh.bernstein`): quadrature points alone do not show that an element is turned inside
out between them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from jaxbeam.mesh.bernstein import least_ratio, minimiser, value
from jaxbeam.mesh.elements import corner_slopes, determinants, element_of
from jaxbeam.physics.quadrature import SolidParams, interpolated, shape_gradients


def volume_ratios(x: jax.Array, params: SolidParams) -> jax.Array:
    """`J = det F` `(q, m)` at the quadrature points of elements at positions `x` `(m, k, 2)`."""
    H = interpolated(shape_gradients(params), x - params.rest)
    return 1 + H[0, 0] + H[1, 1] + (H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0])


def smallest_ratios(x: jax.Array, params: SolidParams) -> jax.Array:
    """The smallest `J` `(m,)` anywhere in each element, quadrature point or not, at positions `x` `(m, k, 2)`.

    With six nodes it is the smallest ratio of two quadratic polynomials: by how much the present map and that of the
    rest positions stretch area. Positive just when no part of the element is turned inside out.
    """
    if element_of(x).affine:
        return jnp.min(volume_ratios(x, params), axis=0)
    area = _rest_areas(params)
    present, rest = (corner_slopes(jnp.moveaxis(places, 0, -1)) for places in (x, params.rest))
    return least_ratio(*(jnp.stack(determinants(slopes, slopes)) / area for slopes in (present, rest)))


def rest_is_sound(params: SolidParams) -> jax.Array:
    """Whether each element `(m,)` has positive area, and none of it is turned inside out, at rest."""
    positive = jnp.all(params.weights > 0, axis=1)
    if element_of(params.rest).affine:
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
    gradients = shape_gradients(params)
    H, D = interpolated(gradients, x - params.rest), interpolated(gradients, dx)
    F00, F11 = 1 + H[0, 0], 1 + H[1, 1]
    j = F00 * F11 - H[0, 1] * H[1, 0]
    b = F11 * D[0, 0] + F00 * D[1, 1] - H[1, 0] * D[0, 1] - H[0, 1] * D[1, 0]
    c = D[0, 0] * D[1, 1] - D[0, 1] * D[1, 0]
    at_points = _first_crossing((1 - keep) * j, b, c, j > bound)
    return at_points if element_of(x).affine else _step_within(at_points, x, dx, params, keep, inside)


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
