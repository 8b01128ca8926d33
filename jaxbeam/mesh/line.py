"""The line of a rod: nodes with a position and the angle of their section, joined by elements of two nodes."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.tree import Numbers, index_field, is_concrete, namespace, pytree, to_device
from jaxbeam.mesh.mesh import Mesh, float_nodes

# Least cosine of the angle at rest between an element and its direction by the mean angle of its two nodes.
ALIGNED = 0.9


@pytree
class Line(Mesh):
    """Nodes and elements of a rod at rest. It may be straight or curved, and is free of stress in this shape.

    Args:
        nodes: `(n, 3)`: x, y, and `radian` times the angle of the axis, anticlockwise from x. Their dtype is the dtype
            of every computation on the line. May be traced.
        elements: `(m, 2)` node numbers of each element, in the direction of the axis. Always concrete.
        radian: `()` the length that stands for one radian in the third column, positive, such as the height.

    Raises:
        ValueError: if a shape or dtype is wrong, an index is out of range, a node is unused, a coordinate is not
            finite, `radian` is not positive, or an element has no length or does not run along its angle. Traced
            numbers with such a fault become NaN, and every solution computed from them is `INVALID`.
    """

    nodes: jax.Array
    elements: np.ndarray = index_field()
    radian: jax.Array  # type: ignore[misc]

    def __post_init__(self) -> None:
        nodes = float_nodes(self.nodes, 3, "(x, y, radian * angle)")
        radian = to_device(checks.number("radian", self.radian, checks.POSITIVE), nodes.dtype)
        elements = _checked_pairs(self.elements, nodes.shape[0])
        if is_concrete(nodes, radian):
            _check_line(np.asarray(nodes, float), elements, float(radian))
        else:
            length, along, _ = _run(nodes, elements, radian)
            nodes = checks.poisoned(jnp.asarray(nodes), jnp.all(along > ALIGNED * length))
        object.__setattr__(self, "nodes", to_device(nodes))
        object.__setattr__(self, "elements", elements)
        object.__setattr__(self, "radian", radian)


def _checked_pairs(elements: Any, total: int) -> np.ndarray:
    array = checks.whole_numbers("elements", elements, "(m, 2)", (2,))
    bad = np.flatnonzero(((array < 0) | (array >= total)).any(axis=1))
    if bad.size:
        raise ValueError(
            f"elements: element {bad[0]} is {array[bad[0]].tolist()}, but nodes are numbered 0 to {total - 1}"
        )
    unused = np.setdiff1d(np.arange(total), array)
    if unused.size:
        raise ValueError(
            f"nodes: {unused.size} belong to no element, the first is node {unused[0]}; remove them and renumber"
        )
    return array


def _run(nodes: Any, elements: np.ndarray, radian: Any) -> tuple[Any, Any, Any]:
    """Of each element `(m,)`: its length, its extent in the direction of its angle, and that angle.

    The angle is the mean of those of its two nodes.
    """
    xp = namespace(nodes, radian)
    first, second = (xp.asarray(nodes)[elements[:, k]] for k in (0, 1))
    chord, angle = (second - first)[:, :2], (first + second)[:, 2] / (2 * radian)
    return xp.sqrt(xp.sum(chord**2, axis=1)), chord[:, 0] * xp.cos(angle) + chord[:, 1] * xp.sin(angle), angle


def _check_line(nodes: np.ndarray, elements: np.ndarray, radian: float) -> None:
    wild = np.flatnonzero(~np.isfinite(nodes).all(axis=1))
    if wild.size:
        raise ValueError(f"nodes: node {wild[0]} is not finite: {nodes[wild[0]].tolist()}")
    length, along, angle = _run(nodes, elements, radian)
    bad = np.flatnonzero(~(along > ALIGNED * length))
    if bad.size:
        k = bad[0]
        chord = nodes[elements[k, 1]] - nodes[elements[k, 0]]
        turn = np.arctan2(chord[1], chord[0])
        problem = f"runs at {turn:.4g} radians, but its angle is {angle[k]:.4g}" if length[k] > 0 else "has no length"
        raise ValueError(
            f"nodes: element {k} {problem}; the third column is radian times the angle of the axis, and nodes must be "
            f"so close that it turns little from one to the next"
        )


def straight(length: Numbers, radian: Numbers, nodes: int, dtype: Any = None) -> Line:
    """A straight line of evenly spaced nodes along x, centred on the origin.

    Args:
        length: length of the rod, positive; may be traced.
        radian: see `Line`; may be traced.
        nodes: number of nodes, at least 2.
        dtype: dtype of the nodes; by default JAX's float.

    Raises:
        ValueError: if `nodes` is not a whole number of at least 2, or a length is not positive and finite.
    """
    checks.count("nodes", nodes, 2)
    length, radian = (
        checks.number(name, value, checks.POSITIVE) for name, value in (("length", length), ("radian", radian))
    )
    dtype = checks.float_dtype("dtype", dtype)
    unit = np.linspace(-0.5, 0.5, nodes)[:, None] * [1.0, 0.0, 0.0]
    pairs = np.stack([np.arange(nodes - 1), np.arange(1, nodes)], axis=1)
    return Line(unit.astype(dtype) * namespace(length).asarray(length, dtype), pairs, to_device(radian, dtype))


def beside(x: Any, offset: Any, radian: Any) -> Any:
    """Points `(..., k, 2)` on the sections of the nodes of a line: `(x - e sin theta, y + e cos theta)`.

    Args:
        x: `(..., k, 3)` coordinates of the nodes, as in `Line`.
        offset: `(..., k)` distance `e` from the node, along the section to the left of the axis.
        radian: `(...)` as in `Line`.
    """
    xp = namespace(x, offset, radian)
    theta = x[..., 2] / radian[..., None]
    normal = xp.stack([-xp.sin(theta), xp.cos(theta)], axis=-1)
    return x[..., :2] + offset[..., None] * normal
