"""What an element is: one record with all that meshes, energies, measures and pictures ask of it.

A point of an element with `c` corners is given by the weights `(c,)` of its corners. They add up to 1: on a triangle
they are the barycentric coordinates.
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
    """The determinant of the map from the reference element: a polynomial with `b` coefficients.

    Its mean is the area of the element over that of the reference element. The functions take NumPy or JAX arrays with
    elements on the last axes.

    slopes: of a map with nodes `(k, 2, ...)`, in whatever form `coefficients` takes them.
    coefficients: from the slopes of two maps, the coefficients `(b, ...)` of the determinant made of the first slope of
        one and the second slope of the other. The polynomial is nowhere less than its smallest coefficient.
    basis: the values `(b, ...)` by which the coefficients are weighted at a point `(c, ...)`.
    minimiser: where `(c, ...)` on the element the polynomial with coefficients `(b, ...)` is smallest. Differentiable
        wherever that point moves smoothly.
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
    """A kind of element with `k` nodes and `c` corners. Its corners come first, counter-clockwise.

    name: what to call one in messages.
    places: `(k, c)` where its nodes are.
    edges: of each edge the nodes: its first and its second end, counter-clockwise, and then those between.
    shape: values `(q, k)` of the shape functions at points `(q, c)`.
    slopes: their derivatives `(q, k, 2)` along two reference coordinates.
    area: of the reference element in these coordinates.
    rules: for each degree of polynomials that quadrature can take exactly, points `(q, c)` and weights `(q,)` of sum 1.
    degree: the one that is used unless another is asked for.
    determinant: of the map from the reference element; None if that is the same everywhere on the element.
    children: `(p, c, c)` the corners of each of the parts into which the element is cut.
    enriched: the element of the same shape with more nodes by which its error is estimated; None: its children.
    shortfall: the error of an answer over the change that the finer elements make, measured by
        `benchmarks/accuracy.py`.
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

    @property
    def nodes(self) -> int:
        """How many nodes it has."""
        return len(self.places)

    @property
    def corners(self) -> int:
        """How many corners it has."""
        return len(self.edges)

    @cached_property
    def sides(self) -> np.ndarray:
        """The corners `(c, 2)` that each edge lies between."""
        return np.array([edge[:2] for edge in self.edges])

    def rule(self, degree: int) -> tuple[np.ndarray, np.ndarray]:
        """Points `(q, c)` and weights `(q,)`, of sum 1, that integrate polynomials up to a degree exactly.

        Raises:
            ValueError: if there is no such rule.
        """
        if degree not in self.rules:
            raise ValueError(f"degree: expected one of {tuple(self.rules)}, got {degree!r}")
        return self.rules[degree]

    def degree_of(self, points: int) -> int:
        """The degree of the rule with so many points.

        Raises:
            ValueError: if there is none.
        """
        degrees = {len(weights): degree for degree, (_, weights) in self.rules.items()}
        if points not in degrees:
            raise ValueError(
                f"scene: expected a solid with {sorted(degrees)} quadrature points in an element, got {points}"
            )
        return degrees[points]


# Two steps to the smallest ratio of two polynomials leave round-off if the second varies by less than the root of eps.
# Where it varies more, further ones follow; they converge superlinearly, and these do if it falls to a thousandth.
FURTHER = 8


@partial(custom_derivative, static=1)
def least_ratio(determinant: Determinant, p: jax.Array, q: jax.Array) -> jax.Array:
    """The smallest `p / q` `(...)` on an element, of polynomials with coefficients `(b, ...)`, `q` positive on it.

    By Dinkelbach's method (1967, Management Science 13, 492-498): with `r` the ratio where `p - r q` is smallest, from
    `r = 0` on. From the first step on the ratio is negative just when `p` is so somewhere.
    """

    def step(_: int, ratio: jax.Array) -> jax.Array:
        place = determinant.minimiser(p - ratio[None] * q)
        return determinant.value(p, place) / determinant.value(q, place)

    ratio = step(1, step(0, jnp.zeros_like(p[0])))
    varies = jnp.any(jnp.ptp(q, axis=0) > jnp.finfo(q.dtype).eps ** 0.5 * q[0])
    return lax.cond(varies, lambda ratio: lax.fori_loop(0, FURTHER, step, ratio), lambda ratio: ratio, ratio)


@least_ratio.defjvp
def _(
    determinant: Determinant, primals: tuple[jax.Array, ...], tangents: tuple[jax.Array, ...]
) -> tuple[jax.Array, jax.Array]:
    """At the point where the ratio is smallest: the point moves too, but to first order that changes nothing."""
    (p, q), (dp, dq) = primals, tangents
    ratio = least_ratio(determinant, p, q)
    place = determinant.minimiser(p - ratio[None] * q)
    change = determinant.value(dp - ratio[None] * dq, place) / determinant.value(q, place)
    return ratio, change


# ------------------------------------------------------------------------------------------------ edges


def edge_functions(nodes: int, xi: np.ndarray) -> np.ndarray:
    """Shape functions `(..., nodes)` along an edge of two or three nodes, at `xi` from its first end, 0, to 1."""
    if nodes == 2:
        return np.stack([1 - xi, xi], axis=-1)
    return np.stack([(1 - xi) * (1 - 2 * xi), xi * (2 * xi - 1), 4 * xi * (1 - xi)], axis=-1)


def edge_products(nodes: int) -> np.ndarray:
    """Integrals `(nodes, nodes)` along an edge of each shape function times the slope of each."""
    if nodes == 2:
        return np.array([[-1, 1], [-1, 1]]) / 2
    return np.array([[-3, -1, 4], [1, 3, -4], [-4, 4, 0]]) / 6
