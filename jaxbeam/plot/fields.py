"""Fields in colour: what is shown, its colour scale, and the artist of a field that is smooth between nodes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import TriMesh
from matplotlib.colors import Normalize
from matplotlib.tri import Triangulation

from jaxbeam.core.tree import Numbers
from jaxbeam.mesh.element import Element
from jaxbeam.mesh.elements import element_of
from jaxbeam.plot.lines import elements_of
from jaxbeam.scene.scene import Scene

Function = Callable[[Scene, jax.Array], jax.Array]

# Straight pieces of each curved edge of an element whose colours are smooth.
PIECES = 4


@dataclasses.dataclass(frozen=True, eq=False)
class Field:
    """What to show in colour.

    Values at nodes are drawn smooth, those of elements each in one colour. Colours are sequential (viridis), or
    diverging (red above, blue below) about `centre`.

    Args:
        values: `(n,)`, one for each node, such as `nodal_von_mises_stress(scene, x)`; `(t,)`, one for each
            element of the solids, such as `jacobians(scene, x)`; or a function `(scene, x)` that returns one of them,
            which animations and galleries need.
        label: text of the colour bar: quantity and unit.
        centre: value at which diverging colours change hue; by default 0 if the values have both signs.
        colours: values at the two ends of the colour bar. By default they are the 1st and 99th percentile, because the
            peak beside a node that carries a point load depends on the mesh. Pointed ends of the bar tell that there
            are values beyond.
        at_nodes: whether the values are those of nodes; only needed where a mesh has as many nodes as elements.
    """

    values: Numbers | Callable[[Scene, jax.Array], jax.Array]
    label: str
    centre: float | None = None
    colours: tuple[float, float] | None = None
    at_nodes: bool | None = None

    @cached_property
    def compiled(self) -> Callable[[Scene, jax.Array], jax.Array]:
        """The function as a compiled program."""
        return jax.jit(self.function())

    def function(self) -> Callable[[Scene, jax.Array], jax.Array]:
        """The values as a function.

        Raises:
            ValueError: if they are those of one state.
        """
        if not callable(self.values):
            raise ValueError(
                "field: expected a Field of a function (scene, x), because several states are drawn, got one of values "
                "of a single state"
            )
        return self.values


def field_of(field: Field | Function | None) -> Field | None:
    """A field; of a bare function the field with its name as label.

    Raises:
        ValueError: if it is neither.
    """
    if field is None or isinstance(field, Field):
        return field
    if callable(field):
        return Field(field, getattr(field, "__name__", "field").replace("_", " "))
    raise ValueError(f"field: expected a function (scene, x), or a Field with a label, got {type(field).__name__}")


class Scale(NamedTuple):
    """A colour scale: colours, the values at its ends, where values lie beyond them, and whether they are at nodes."""

    cmap: str
    norm: Normalize
    extend: str
    at_nodes: bool


def scales_of(field: Field, drawn: Sequence[tuple[Scene, np.ndarray]]) -> list[Scale]:
    """For each scene, with values `(s, n)` or `(s, t)` of the field in `s` states, one and the same colour scale.

    Raises:
        ValueError: if the values have another shape or are not finite.
    """
    places = [check_values(field, scene, values) for scene, values in drawn]
    every = np.concatenate([values.ravel() for _, values in drawn])
    centre = field.centre
    if centre is None and every.min() < 0 < every.max():
        centre = 0.0
    low, high = field.colours or np.quantile(every, [0.01, 0.99])
    if centre is not None:
        reach = max(abs(low - centre), abs(high - centre))
        low, high = centre - reach, centre + reach
    extend = ("neither", "min", "max", "both")[int(every.min() < low) + 2 * int(every.max() > high)]
    cmap = "viridis" if centre is None else "RdBu_r"
    return [Scale(cmap, Normalize(low, high), extend, at_nodes) for at_nodes in places]


def check_values(field: Field, scene: Scene, values: np.ndarray) -> bool:
    """Whether values `(s, n)` or `(s, t)` of a field in `s` states are those of nodes.

    Raises:
        ValueError: if they have another shape or are not finite.
    """
    at_nodes = _at_nodes(field, scene, values.shape[1:])
    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        raise ValueError(f"values: {'node' if at_nodes else 'element'} {bad[0, -1]} is not finite")
    return at_nodes


def _at_nodes(field: Field, scene: Scene, shape: tuple[int, ...]) -> bool:
    nodes, elements = len(scene.mesh.nodes), len(elements_of(scene))
    places = {True: (nodes,), False: (elements,)}
    if field.at_nodes is not None:
        places = {field.at_nodes: places[field.at_nodes]}
    fits = [at_nodes for at_nodes, expected in places.items() if shape == expected]
    if not fits:
        wanted = " or ".join(f"{places[at]}, one for each {'node' if at else 'element'}" for at in places)
        raise ValueError(f"values: expected shape {wanted}, got {shape}")
    if len(fits) > 1:
        raise ValueError(
            f"at_nodes: the mesh has {nodes} nodes and as many elements; expected True or False, to tell of which the "
            f"values are"
        )
    return fits[0]


class Smooth:
    """The artist of a field that is smooth between nodes; `move` places and colours it."""

    def __init__(self, ax: Axes, elements: np.ndarray, scale: Scale) -> None:
        places, pieces = _pieces(element_of(elements))
        self.elements, self.shapes = elements, element_of(elements).shape(places)
        starts = len(places) * np.arange(len(elements))
        count = len(places) * len(elements)
        triangles = (starts[:, None, None] + pieces).reshape(-1, 3)
        self.triangulation = Triangulation(np.arange(count), np.zeros(count), triangles)
        self.mesh = TriMesh(self.triangulation, cmap=scale.cmap, norm=scale.norm, zorder=2)
        ax.add_collection(self.mesh, autolim=False)

    def move(self, x: np.ndarray, values: Any) -> None:
        """Draw the values `(n,)` on the body at `x` `(n, d)`."""
        points = self.shapes @ x[self.elements, :2]
        self.triangulation.x, self.triangulation.y = points.reshape(-1, 2).T
        self.mesh.set_array((values[self.elements] @ self.shapes.T).ravel())


def _pieces(element: Element) -> tuple[np.ndarray, np.ndarray]:
    """Points `(q, c)` of an element and the triangles `(p, 3)` between them that it is drawn as.

    A triangle with straight edges is itself. Any other element is a fan about its centre.
    """
    corners = np.eye(element.corners)
    if element.nodes == 3:
        return corners, np.array([[0, 1, 2]])
    xi = np.arange(PIECES)[:, None] / PIECES
    ring = np.concatenate([(1 - xi) * corners[a] + xi * corners[b] for a, b in element.sides])
    around = np.arange(len(ring))
    fan = np.stack([around, np.roll(around, -1), np.full(len(ring), len(ring))], axis=1)
    return np.concatenate([ring, np.full((1, element.corners), 1 / element.corners)]), fan
