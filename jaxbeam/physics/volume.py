"""`J = det F` of elements: its smallest value anywhere, and how far a step may go before it falls too low.

In a triangle of three nodes `J` is one number. In other elements it is a ratio of two polynomials, whose smallest value
`jaxbeam.mesh.element` finds. The quadrature points alone do not suffice: an element may be inverted between them.
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
    """The smallest `J` `(m,)` anywhere in each element, not only at quadrature points, at positions `x` `(m, k, 2)`.

    If `J` varies on an element, it is the ratio of two polynomials: the determinants of the maps from the reference
    element to `x` and to the rest positions. The result is positive if and only if no part of the element is inverted.
    """
    determinant = element_of(x).determinant
    if determinant is None:
        return jnp.min(volume_ratios(x, params), axis=0)
    return least_ratio(determinant, *(_stretch(determinant, places, params) for places in (x, params.rest)))


def rest_is_sound(params: SolidParams) -> jax.Array:
    """Whether each element `(m,)` has positive area and no inverted part at rest."""
    positive = jnp.all(params.weights > 0, axis=1)
    determinant = element_of(params.rest).determinant
    if determinant is None:
        return positive
    return positive & (determinant.least(_stretch(determinant, params.rest, params)) > 0)


def _stretch(determinant: Determinant, x: jax.Array, params: SolidParams) -> jax.Array:
    """Coefficients `(b, m)` of the determinant of the map to `x` `(m, k, 2)`, divided by its mean at rest."""
    slopes = determinant.slopes(jnp.moveaxis(x, 0, -1))
    return determinant.coefficients(slopes, slopes) / _rest_stretch(params)


def _rest_stretch(params: SolidParams) -> jax.Array:
    """The mean determinant `(1, m)` of the map of each element at rest.

    Determinants divided by it are of order 1 in any unit of length.
    """
    return jnp.sum(params.weights, axis=1)[None] / element_of(params.rest).area


def admissible_step(
    x: jax.Array, dx: jax.Array, params: SolidParams, keep: float, bound: float = 0.0, inside: float = 0.0
) -> jax.Array:
    """Largest `t` `(m,)` for which `J` stays at least `keep` times its value at `x`, from `x` to `x + t dx`.

    This holds at every point of an element. `t` is infinite if `J` never falls so far. There are two exceptions for
    elements on which `J` varies. `t` is at most 1. Between the quadrature points `J` may be lower, by half of `keep`
    times the smallest `J` of the element.

    Args:
        x: `(m, k, 2)` positions of the nodes of each element.
        dx: `(m, k, 2)` the step.
        params: parameters of the elements.
        keep: the fraction of `J`.
        bound: quadrature points with `J` of at most `bound` at `x` are ignored.
        inside: in elements whose smallest `J` is at most `inside` at `x`, only the quadrature points are checked.
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
    """`admissible_step` for elements on which `J` varies, with all their points: at most `start` and at most 1.

    At each point `J(t) = J + b t + c t^2`. For `t` from 0 to `T`, a lower bound of `J(t)` is the smallest of its
    Bernstein coefficients: `J`, `J + b T / 2` and `J(T)`. The last two are polynomials on the element.

    `T` is cut repeatedly, until neither polynomial falls below `keep J` anywhere by more than half of `keep` times the
    smallest `J`. For a cut, find for each polynomial the point at which it is lowest relative to `keep J`. Then reduce
    `T` to where the polynomial reaches `keep J` there. A cut is at least 2 %, so that round-off cannot keep the loop
    from ending.

    Args:
        determinant: of the elements.
        start: `(m,)` the largest `t` by the quadrature points.
        x: as for `admissible_step`.
        dx: as for `admissible_step`.
        params: as for `admissible_step`.
        keep: as for `admissible_step`.
        bound: elements whose smallest `J` is at most `bound` are ignored.
    """
    scale, of, value = _rest_stretch(params), determinant.coefficients, determinant.value
    now, step = (determinant.slopes(jnp.moveaxis(places, 0, -1)) for places in (x, dx))
    j, c = (of(slopes, slopes) / scale for slopes in (now, step))
    b = (of(now, step) + of(step, now)) / scale
    # `left`: the two Bernstein coefficients minus `keep J`, on the axis before the elements.
    gap, b, c = (1 - keep) * j[:, None], jnp.stack([b / 2, b], axis=1), jnp.stack([jnp.zeros_like(c), c], axis=1)
    left = lambda t: gap + t[None, None] * (b + t[None, None] * c)

    def cut(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        _, t = carry
        # The smallest `J` and the two coefficients at once: a program with one search for a minimum compiles sooner.
        three = jnp.concatenate([j[:, None], left(t)], axis=1)
        place = determinant.minimiser(three)
        (least, *lowest), place = value(three, place), place[:, 1:]
        low = jnp.stack(lowest) < jnp.where(least > bound, -0.5 * keep * least, -jnp.inf)[None]
        crossing = _first_crossing(value(gap, place), value(b, place), value(c, place), low)
        return jnp.any(low), jnp.where(jnp.any(low, axis=0), jnp.minimum(0.98 * t, crossing), t)

    start = jnp.minimum(start, 1)
    # The smallest coefficient of a polynomial is a lower bound. For most steps none is negative, and no cut is needed.
    doubtful = jnp.any(left(start) < 0)
    return lax.while_loop(lambda carry: carry[0], cut, (doubtful, start))[1]


def _first_crossing(gap: jax.Array, b: jax.Array, c: jax.Array, counts: jax.Array) -> jax.Array:
    """The smallest `t > 0` `(m,)` at which `gap + b t + c t^2` `(q, m)` is zero at a point that counts; else infinite.

    In the plane `J` is quadratic along a step, with `b = cof F : dH` and `c = det dH`. The first of the two roots is
    computed in the form without cancellation.

    Args:
        gap: `(q, m)` value at `t = 0`.
        b: `(q, m)` coefficient of `t`.
        c: `(q, m)` coefficient of `t^2`.
        counts: `(q, m)` which points count.
    """
    discriminant = b**2 - 4 * c * gap
    denominator = jnp.sqrt(jnp.maximum(discriminant, 0)) - b
    crosses = counts & (discriminant >= 0) & (denominator > 0)
    return jnp.min(jnp.where(crosses, 2 * gap / jnp.where(crosses, denominator, 1), jnp.inf), axis=0)
