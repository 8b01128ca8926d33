"""A kind of element: one record with all that meshes, energies, measures and pictures need to know of it.

A point of an element with `c` corners is given by weights `(c,)` of the corners, of sum 1. On a triangle they are the
barycentric coordinates.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core.derivative import custom_derivative


@dataclasses.dataclass(frozen=True, eq=False)
class Determinant:
    """The Jacobian determinant of the map from the reference element: a polynomial with `b` coefficients.

    Its mean is the area of the element over that of the reference element. The functions take NumPy or JAX arrays. The
    last axes of these are the elements.

    slopes: from the nodes `(k, 2, ...)` of a map, its derivatives in the form that `coefficients` takes.
    coefficients: from the slopes of two maps, the coefficients `(b, ...)` of the determinant whose columns are the
        derivative of the first map in the first reference coordinate and that of the second map in the second one. The
        smallest coefficient is a lower bound of the polynomial.
    basis: from a point `(c, ...)`, the values `(b, ...)` of the polynomials that the coefficients multiply.
    minimiser: from coefficients `(b, ...)`, the point `(c, ...)` of the element at which the polynomial is smallest.
        Differentiable where the point moves smoothly with the coefficients.
    """

    slopes: Callable[[Any], Any]
    coefficients: Callable[[Any, Any], Any]
    basis: Callable[[Any], Any]
    minimiser: Callable[[Any], Any]

    def value(self, c: Any, place: Any) -> Any:
        """The polynomial `(...)` with coefficients `c` `(b, ...)` at a point `(c, ...)`."""
        return (c * self.basis(place)).sum(axis=0)

    def least(self, c: Any) -> Any:
        """The smallest value `(...)` of the polynomial with coefficients `c` `(b, ...)`."""
        return self.value(c, self.minimiser(c))


@dataclasses.dataclass(frozen=True, eq=False)
class Element:
    """A kind of element with `k` nodes and `c` corners. The corners are the first nodes, counter-clockwise.

    name: the word for one element in messages.
    places: `(k, c)` points at which the nodes lie.
    edges: the nodes of each edge: its first end, its second end, counter-clockwise, then the nodes between them.
    shape: from points `(q, c)`, the values `(q, k)` of the shape functions.
    slopes: from points `(q, c)`, the derivatives `(q, k, 2)` of the shape functions in two reference coordinates.
    area: area of the reference element in these coordinates.
    rules: quadrature rules by the degree of polynomials they integrate exactly: points `(q, c)` and weights `(q,)` of
        sum 1.
    degree: degree of the default rule.
    determinant: of the map from the reference element; None if it is constant on the element.
    children: `(p, c, c)` corners of each of the parts into which refinement cuts the element.
    enriched: the element of the same shape with more nodes that the error estimate uses; None: it uses the children.
    shortfall: ratio of the true error to the change that the finer elements make, measured by
        `benchmarks/accuracy.py`.
    gains: what still finer elements would add to that change: shares of its part beside corners with infinite strains,
        and of the rest; used by `jaxbeam.study.corrected`.
    spread: bound of the error that is then left, as a share of the magnitudes of the parts of each element.
    """

    name: str
    places: np.ndarray
    edges: tuple[tuple[int, ...], ...]
    shape: Callable[[np.ndarray], np.ndarray]
    slopes: Callable[[np.ndarray], np.ndarray]
    area: float
    rules: dict[int, tuple[np.ndarray, np.ndarray]]
    degree: int
    determinant: Determinant | None
    children: np.ndarray
    enriched: Element | None
    shortfall: float
    gains: tuple[float, float]
    spread: float

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return len(self.places)

    @property
    def corners(self) -> int:
        """Number of corners."""
        return len(self.edges)

    @cached_property
    def sides(self) -> np.ndarray:
        """The two end corners `(c, 2)` of each edge."""
        return np.array([edge[:2] for edge in self.edges])

    def rule(self, degree: int) -> tuple[np.ndarray, np.ndarray]:
        """Points `(q, c)` and weights `(q,)`, of sum 1, that integrate polynomials up to `degree` exactly.

        Raises:
            ValueError: if there is no such rule.
        """
        if degree not in self.rules:
            raise ValueError(f"degree: expected one of {tuple(self.rules)}, got {degree!r}")
        return self.rules[degree]

    def degree_of(self, points: int) -> int:
        """The degree of the rule with this number of points.

        Raises:
            ValueError: if there is no such rule.
        """
        degrees = {len(weights): degree for degree, (_, weights) in self.rules.items()}
        if points not in degrees:
            raise ValueError(
                f"scene: expected a solid with {sorted(degrees)} quadrature points in an element, got {points}"
            )
        return degrees[points]


# Number of further steps of `least_ratio`. Its first two steps reach round-off if the denominator varies by less than
# the square root of eps. If it varies more, this many steps follow. They converge superlinearly, and they suffice where
# the denominator falls to a thousandth of its mean.
FURTHER = 8


@partial(custom_derivative, static=1)
def least_ratio(determinant: Determinant, p: jax.Array, q: jax.Array) -> jax.Array:
    """The smallest ratio `p / q` `(...)` of two polynomials on an element.

    Dinkelbach's method (1967, Management Science 13, 492-498) starts from `r = 0`. Each step replaces `r` by the ratio
    at the point where `p - r q` is smallest. After the first step, `r` is negative if and only if `p` is negative
    somewhere.

    Args:
        determinant: of the element.
        p: `(b, ...)` coefficients.
        q: `(b, ...)` coefficients of a polynomial that is positive on the element.
    """

    def step(_: int, ratio: jax.Array) -> jax.Array:
        place = determinant.minimiser(p - ratio[None] * q)
        return determinant.value(p, place) / determinant.value(q, place)

    varies = jnp.any(jnp.ptp(q, axis=0) > jnp.finfo(q.dtype).eps ** 0.5 * q[0])
    # One loop for all steps: written out they take most of the time of compiling a solve.
    return lax.fori_loop(0, jnp.where(varies, 2 + FURTHER, 2), step, jnp.zeros_like(p[0]))


@least_ratio.defjvp
def _(
    determinant: Determinant, primals: tuple[jax.Array, ...], tangents: tuple[jax.Array, ...]
) -> tuple[jax.Array, jax.Array]:
    """Differentiate at the point of the smallest ratio, held fixed: to first order its motion changes nothing."""
    (p, q), (dp, dq) = primals, tangents
    ratio = least_ratio(determinant, p, q)
    place = determinant.minimiser(p - ratio[None] * q)
    change = determinant.value(dp - ratio[None] * dq, place) / determinant.value(q, place)
    return ratio, change


# ------------------------------------------------------------------------------------------------ edges


def edge_functions(nodes: int, xi: np.ndarray) -> np.ndarray:
    """Shape functions `(..., nodes)` of an edge of two or three nodes, at `xi` from 0 at its first end to 1."""
    if nodes == 2:
        return np.stack([1 - xi, xi], axis=-1)
    return np.stack([(1 - xi) * (1 - 2 * xi), xi * (2 * xi - 1), 4 * xi * (1 - xi)], axis=-1)


def edge_rule(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss's rule on (0, 1): points and weights `(points,)`."""
    xi, weights = np.polynomial.legendre.leggauss(points)
    return (1 + xi) / 2, weights / 2


def edge_slopes(nodes: int, xi: np.ndarray) -> np.ndarray:
    """Slopes `(..., nodes)` of the `edge_functions` in `xi`."""
    if nodes == 2:
        return np.stack([np.full_like(xi, -1.0), np.full_like(xi, 1.0)], axis=-1)
    return np.stack([4 * xi - 3, 4 * xi - 1, 4 - 8 * xi], axis=-1)


def edge_products(nodes: int) -> np.ndarray:
    """Integrals `(nodes, nodes)` along an edge, `int N_a (dN_b/dxi) dxi`, of its shape functions `N`."""
    if nodes == 2:
        return np.array([[-1, 1], [-1, 1]]) / 2
    return np.array([[-3, -1, 4], [1, 3, -4], [-4, 4, 0]]) / 6
