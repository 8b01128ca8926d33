"""What acts on a body, written anew for the judge of answers: tendons, cables, loads and supports.

It shares no code with the package. Each kind is a dataclass of raw numbers. It says at which command it does nothing
(`rest`; None: it takes none), how many commands it takes (`count`), and what it is made of on a given body
(`attached`): nodes `(m, k)` and parameters of `m` stencils. Its `energy(x, *params, last)` is that of one stencil with
nodes `x` `(k, d)`. `last` is the command, or for dead loads the share of them that acts. Positions are taken from the
first node of the body at rest.

Numbers of a scene are those that the dtype of its nodes can hold: the package is told no others. Contact is in
`tests/obstacles.py`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tests.geometry import SIDES, determinants, patch, surface

POWERS = {"constant": 0.0, "inverse": 1.0, "inverse-square": 2.0}


class Stencils(NamedTuple):
    """Stencils of one energy `(x, *params) -> scalar`: their nodes `(m, k)`, and parameters with leading axis `m`.

    force: `(x, *params) -> (k, d)`, the gradient of the energy where autodiff of one stencil would not give it.
    """

    energy: Callable[..., jax.Array]
    nodes: np.ndarray
    params: tuple[np.ndarray, ...]
    force: Callable[..., jax.Array] | None = None


class Action:
    """What all kinds have in common."""

    rest: ClassVar[float | None] = None
    force: ClassVar[Callable[..., jax.Array] | None] = None
    energy: Callable[..., jax.Array]

    @property
    def count(self) -> int:
        """Number of commands."""
        return 0 if self.rest is None else 1

    def attached(self, problem: Any) -> tuple[np.ndarray, tuple[np.ndarray, ...]] | None:
        """Nodes `(m, k)` and parameters but the last; None if it stores no energy."""
        raise NotImplementedError


def told(problem: Any, value: Any) -> np.ndarray:
    """Numbers as the dtype of the nodes holds them, in float64."""
    return np.asarray(np.asarray(value, problem.nodes.dtype), np.float64)


# ------------------------------------------------------------------------------------- tendons and cables


def length_of(x: jax.Array, weights: Any, aside: Any, radian: Any) -> jax.Array:
    """Length of the line through its points: means of its nodes, and on a rod beside the axis. A segment of no length
    has no direction, and none is given."""
    points = weights @ x
    if x.shape[1] == 3:
        angle = points[:, 2] / radian
        points = points[:, :2] + aside[:, None] * jnp.stack([-jnp.sin(angle), jnp.cos(angle)], axis=1)
    edge = jnp.diff(points, axis=0)
    meet = jnp.all(edge == 0, axis=1)
    return jnp.sum(jnp.where(meet, 0, jnp.linalg.norm(jnp.where(meet[:, None], 1.0, edge), axis=1)))


_lengths = jax.jit(jax.vmap(length_of))


def tendon_energy(
    x: jax.Array, weights: Any, aside: Any, radian: Any, modulus: Any, natural: Any, power: Any, ratio: Any
) -> jax.Array:
    """`1/2 k (l - l*)^2`."""
    wanted = ratio * natural
    return modulus / wanted**power / 2 * (length_of(x, weights, aside, radian) - wanted) ** 2


def cable_energy(
    x: jax.Array,
    weights: Any,
    aside: Any,
    radian: Any,
    modulus: Any,
    natural: Any,
    power: Any,
    transition: Any,
    ratio: Any,
) -> jax.Array:
    """`k w^2 h((l - l*) / w)`."""
    wanted, width = ratio * natural, transition * natural
    stretch = length_of(x, weights, aside, radian) - wanted
    return modulus / wanted**power * width**2 * one_sided(stretch / width)


def pull_energy(x: jax.Array, weights: Any, aside: Any, radian: Any, tension: Any) -> jax.Array:
    """`T l`."""
    return tension * length_of(x, weights, aside, radian)


def one_sided(t: jax.Array) -> jax.Array:
    """The second integral of a stiffness that is 0 below 0, `t` up to 1, and 1 above."""
    return jnp.where(t <= 0, 0.0, jnp.where(t < 1, t**3 / 6, t**2 / 2 - t / 2 + 1 / 6))


@dataclasses.dataclass(frozen=True)
class Tendons(Action):
    """A group of `m` tendons through `p` points each, of one stiffness law, `k = modulus / wanted length ** power`.

    lines: `(m, p)` node numbers. modulus: `(m,)` or scalar. widths: `(m, p)` or scalar, of the patches of surface that
    points stand for. aside: `(m, p)` or scalar, on a rod the distance of points from the axis, to its left. shared:
    whether one command is that of all.
    """

    lines: np.ndarray
    modulus: Any
    law: str
    widths: Any = 0.0
    aside: Any = 0.0
    shared: bool = False
    rest: ClassVar[float | None] = 1.0
    energy = staticmethod(tendon_energy)

    @property
    def count(self) -> int:
        return 1 if self.shared else len(self.lines)

    def attached(self, problem: Any) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        nodes, points, natural = _line(problem, self.lines, self.widths, self.aside)
        modulus = np.broadcast_to(np.asarray(self.modulus, np.float64), natural.shape)
        return nodes, (*points, modulus, natural, np.full(len(nodes), POWERS[self.law]))


@dataclasses.dataclass(frozen=True)
class Cables(Tendons):
    """Tendons that only pull. transition: stretch over which one becomes taut, over its natural length."""

    transition: Any = 0.01

    energy = staticmethod(cable_energy)

    def attached(self, problem: Any) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        nodes, params = super().attached(problem)
        return nodes, (*params, np.broadcast_to(told(problem, self.transition), len(nodes)))


@dataclasses.dataclass(frozen=True)
class Pulls(Action):
    """Cables under a commanded tension. Fields as of `Tendons`."""

    lines: np.ndarray
    widths: Any = 0.0
    shared: bool = False
    rest: ClassVar[float | None] = 0.0
    energy = staticmethod(pull_energy)

    @property
    def count(self) -> int:
        return 1 if self.shared else len(self.lines)

    def attached(self, problem: Any) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        return _line(problem, self.lines, self.widths, 0.0)[:2]


def _line(problem: Any, lines: Any, widths: Any, aside: Any) -> tuple[np.ndarray, tuple[np.ndarray, ...], np.ndarray]:
    """Nodes `(m, k)` of lines, what makes points of them (weights, `aside` and the radian), and natural lengths."""
    lines = np.asarray(lines)
    widths, aside = (np.broadcast_to(np.asarray(v, float), lines.shape) for v in (widths, aside))
    if widths.any():
        ends = zip(lines.ravel(), widths.ravel(), strict=True)
        dense = np.stack([patch(problem.rest, problem.elements, *pair) for pair in ends])
        dense = dense.reshape(*lines.shape, -1)
        nodes = np.argsort(-np.any(dense, axis=1).astype(int), axis=1, kind="stable")
        nodes = nodes[:, : int(np.any(dense, axis=1).sum(axis=1).max())]
        weights = np.take_along_axis(dense, nodes[:, None], axis=2)
    else:
        nodes, weights = lines, np.tile(np.eye(lines.shape[1]), (len(lines), 1, 1))
    points = (weights, aside, np.full(len(lines), float(problem.radian)))
    return nodes, points, np.asarray(_lengths(problem.rest[nodes], *points))


# ---------------------------------------------------------------------------------------------- dead loads


def load_energy(x: jax.Array, rest: jax.Array, shares: jax.Array, force: jax.Array, loaded: jax.Array) -> jax.Array:
    """`-f . sum_a shares_a (x_a - X_a)`, of which a share acts."""
    return -loaded * jnp.sum(force * (shares @ (x - rest)))


@dataclasses.dataclass(frozen=True)
class DeadLoads(Action):
    """Forces `(n, d)` on nodes."""

    forces: np.ndarray

    energy = staticmethod(load_energy)

    def attached(self, problem: Any) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        loaded = np.flatnonzero(np.any(self.forces, axis=1))
        force = np.asarray(self.forces, np.float64)[loaded]
        return loaded[:, None], (problem.rest[loaded[:, None]], np.ones((len(loaded), 1)), force)


@dataclasses.dataclass(frozen=True)
class Weight(Action):
    """A force per area at rest, `(2,)` or `(t, 2)`."""

    per_area: Any

    energy = staticmethod(load_energy)

    def attached(self, problem: Any) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """Gauss's rule of four points each way on a square that is mapped to the triangle: exact to degree 6."""
        elements = np.asarray(problem.elements)
        t, share = np.polynomial.legendre.leggauss(4)
        t, share = (1 + t) / 2, share / 2
        a, b = (each.ravel() for each in np.meshgrid(t, t))
        l = np.stack([(1 - a) * (1 - b), a, (1 - a) * b], axis=1)  # noqa: E741
        weights = np.outer(share, share).ravel() * (1 - a) * determinants(problem.rest[elements], l)
        values = l
        if elements.shape[1] == 6:
            values = np.concatenate([l * (2 * l - 1), np.stack([4 * l[:, i] * l[:, j] for i, j in SIDES], 1)], axis=1)
        force = np.broadcast_to(np.asarray(self.per_area, np.float64), (len(elements), 2))
        return elements, (problem.rest[elements], weights @ values, force)


@dataclasses.dataclass(frozen=True)
class Traction(Action):
    """A force `(2,)` per length at rest on the edges of the surface between `nodes`."""

    nodes: np.ndarray
    per_length: Any

    energy = staticmethod(load_energy)

    def attached(self, problem: Any) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """Five points, as the package has them: on a curved edge no rule is exact."""
        edges = between(problem, self.nodes)
        values, slopes, shares = along(edges.shape[1], 5)
        rest = problem.rest[edges]
        lengths = shares * np.linalg.norm(np.einsum("qk,mkd->mqd", slopes, rest), axis=2)
        return edges, (rest, lengths @ values, np.tile(np.asarray(self.per_length, np.float64), (len(edges), 1)))


def between(problem: Any, nodes: Any) -> np.ndarray:
    """The edges `(m, k)` of the surface of which both corners are among `nodes`, the body to their left."""
    edges = surface(problem.elements)
    return edges[np.isin(edges[:, :2], nodes).all(axis=1)]


def along(count: int, points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of an edge of `count` nodes at Gauss's points on (0, 1): shape functions and their slopes `(q, k)`, weights."""
    t, shares = np.polynomial.legendre.leggauss(points)
    t = (1 + t) / 2
    # Lagrange's polynomials through the ends, and the middle of three nodes.
    places = np.array([0.0, 1.0, 0.5])[:count]
    basis = np.linalg.inv(places[:, None] ** np.arange(count))
    powers = t[:, None] ** np.arange(count)
    slopes = np.arange(count) * t[:, None] ** np.maximum(np.arange(count) - 1, 0)
    return powers @ basis, slopes @ basis, shares / 2


# ------------------------------------------------------------------------------------------------ pressure


def pressure_energy(x: jax.Array, centre: jax.Array, pressure: jax.Array) -> jax.Array:
    """`p / 2 int (x - c) cross dx`: three points are exact for degree 5, and 3 is that of a curved edge."""
    values, slopes, shares = along(len(x), 3)
    (a, b), (da, db) = (values @ (x - centre)).T, (slopes @ x).T
    return pressure / 2 * jnp.sum(shares * (a * db - b * da))


def pressure_force(x: jax.Array, centre: jax.Array, pressure: jax.Array) -> jax.Array:
    """Minus the force of the pressure, `p int N (dy, -dx)`. The gradient of the energy of one edge has terms of its
    ends besides, which cancel between neighbours."""
    values, slopes, shares = along(len(x), 3)
    da, db = (slopes @ x).T
    return pressure * jnp.einsum("q,qk,qd->kd", shares, values, jnp.stack([db, -da], axis=1))


@dataclasses.dataclass(frozen=True)
class Pressure(Action):
    """Pressure on the edges of the surface between `nodes`, which close a loop or end at nodes that are held."""

    nodes: np.ndarray
    rest: ClassVar[float | None] = 0.0
    energy = staticmethod(pressure_energy)
    force = staticmethod(pressure_force)

    def attached(self, problem: Any) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """The energy is defined up to a constant on a line. The package measures areas from the mean of the edges'
        first corners."""
        edges = between(problem, self.nodes)
        return edges, (np.tile(problem.rest[edges[:, 0]].mean(axis=0), (len(edges), 1)),)


# ------------------------------------------------------------------------------------------------ supports


@dataclasses.dataclass(frozen=True)
class Support(Action):
    """Prescribed displacements of `nodes` `(m,)`: `motion` `(m, d)` times the command; NaN where it holds nothing. The
    third column of a rod is in radians."""

    nodes: np.ndarray
    motion: np.ndarray
    rest: ClassVar[float | None] = 0.0

    def attached(self, problem: Any) -> None:
        return None

    def held(self, problem: Any) -> np.ndarray:
        """Whether it holds each coordinate, `(n, d)`."""
        found = np.zeros(np.shape(problem.nodes), bool)
        found[self.nodes] = ~np.isnan(self.motion)
        return found

    def motions(self, problem: Any) -> np.ndarray:
        """Displacements `(n, d)` for each unit of the command."""
        found = np.zeros(np.shape(problem.nodes))
        found[self.nodes] = np.nan_to_num(np.asarray(self.motion, float))
        if found.shape[1] == 3:
            found[:, 2] *= problem.radian
        return found
