"""Contact with rigid obstacles for the judge of answers, as `tests/actions.py` has the other kinds."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tests.actions import Action, along, between, one_sided, told
from tests.geometry import polylines, surface


@lru_cache
def contact_of(shape: str) -> Callable[..., jax.Array]:
    """The energy of an edge: `k w^2 h(-g / w)` at three points, as the package has them, weighted by length at rest."""

    def energy(
        x: jax.Array, rest: Any, place: Any, more: Any, way: Any, stiffness: Any, width: Any, moved: Any
    ) -> jax.Array:
        values, slopes, shares = along(len(x), 3)
        lengths = shares * jnp.linalg.norm(slopes @ rest, axis=1)
        gaps = jnp.stack([DISTANCES[shape](point, place + moved * way, more) for point in values @ x])
        return stiffness * width**2 * jnp.sum(lengths * one_sided(-gaps / width))

    return energy


def from_half_plane(point: jax.Array, place: jax.Array, normal: jax.Array) -> jax.Array:
    return (point - place) @ normal / jnp.linalg.norm(normal)


def from_disk(point: jax.Array, place: jax.Array, radius: jax.Array) -> jax.Array:
    return jnp.linalg.norm(point - place) - radius


def from_box(point: jax.Array, place: jax.Array, numbers: jax.Array) -> jax.Array:
    """The distance from the nearest point of the outline, on one of four sides."""
    width, height, angle = numbers[0], numbers[1], jnp.deg2rad(numbers[2])
    ways = jnp.stack([jnp.stack([jnp.cos(angle), jnp.sin(angle)]), jnp.stack([-jnp.sin(angle), jnp.cos(angle)])])
    a, b = ways @ (point - place)
    right, up = jnp.abs(a) - width / 2, jnp.abs(b) - height / 2
    corner = jnp.hypot(jnp.where(right > 0, right, 1.0), jnp.where(up > 0, up, 1.0))
    return jnp.where((right > 0) & (up > 0), corner, jnp.where(right > up, right, up))


DISTANCES = {"half-plane": from_half_plane, "disk": from_disk, "box": from_box}


@dataclasses.dataclass(frozen=True)
class Contact(Action):
    """Contact of the edges of the surface between `nodes` with an obstacle that a command moves along `direction`.

    shape, place, more: `half-plane`, a point of its line and its normal; `disk`, centre and radius; `box`, centre and
    width, height and angle in degrees. stiffness: pressure per depth. transition: a length.
    """

    nodes: np.ndarray
    shape: str
    place: Any
    more: Any
    stiffness: Any
    transition: Any
    direction: Any = (0.0, 1.0)
    rest: ClassVar[float | None] = 0.0

    @property
    def energy(self) -> Callable[..., jax.Array]:
        return contact_of(self.shape)

    @property
    def reach(self) -> float:
        """The largest number that distances from the obstacle are computed with."""
        return float(max(np.abs(self.place).max(), np.abs(self.more).max() if self.shape == "disk" else 0.0))

    def attached(self, problem: Any) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        edges = between(problem, self.nodes)
        each = lambda value: np.tile(value, (len(edges), *[1] * np.ndim(value)))
        place = told(problem, self.place) - np.asarray(problem.nodes, np.float64)[0]
        way, numbers = (
            np.asarray(self.direction, float),
            (told(problem, self.stiffness), told(problem, self.transition)),
        )
        obstacle = (place, told(problem, self.more), way / np.linalg.norm(way))
        return edges, (problem.rest[edges], *(each(value) for value in (*obstacle, *numbers)))


class Sides(NamedTuple):
    """Of the points `(m, 3)` of edges: the distance from an obstacle, the cosine between the outward normal of the
    surface and the way out of the obstacle, and by how much a unit of displacement may change it."""

    gaps: np.ndarray
    cosines: np.ndarray
    turns: np.ndarray


def sides(problem: Any, contact: Contact, moved: float, y: np.ndarray) -> Sides:
    """On which side of the obstacle the surface is. Positions `y` `(n, 2)` are from the first node.

    A surface that is pressed in looks into the obstacle, against the shortest way out of it. One that looks along that
    way has come through, and the obstacle lies in the body.
    """
    edges, (_, place, more, way, _, _) = contact.attached(problem)
    values, slopes, _ = along(edges.shape[1], 3)
    points, tangents = (np.einsum("qk,mkd->mqd", table, y[edges]) for table in (values, slopes))
    both = jax.vmap(jax.value_and_grad(DISTANCES[contact.shape]), in_axes=(0, None, None))
    gaps, out = (np.asarray(each) for each in both(points.reshape(-1, 2), place[0] + moved * way[0], more[0]))
    speeds = np.linalg.norm(tangents, axis=2)
    normals = np.stack([tangents[..., 1], -tangents[..., 0]], axis=2) / speeds[..., None]
    turns = 2 / speeds
    if contact.shape == "disk":
        turns = turns + 1 / (gaps.reshape(turns.shape) + more[0])
    return Sides(gaps.reshape(turns.shape), np.sum(normals * out.reshape(points.shape), axis=2), turns)


def swallowed(problem: Any, contact: Contact, moved: float, y: np.ndarray) -> bool:
    """Whether the surface goes round the centre of a disk or a box.

    It has come in through the surface that it may touch. If that has closed behind it, `sides` has nothing to see.
    """
    if contact.shape == "half-plane":
        return False
    place, way = (contact.attached(problem)[1][k][0] for k in (1, 3))
    lines = polylines(y, surface(problem.elements)) - (place + moved * way)
    (ax, ay), (bx, by) = np.moveaxis(lines[:, :-1], 2, 0), np.moveaxis(lines[:, 1:], 2, 0)
    return bool(np.arctan2(ax * by - ay * bx, ax * bx + ay * by).sum() > np.pi)
