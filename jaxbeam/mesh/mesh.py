"""Triangle meshes: rest positions of the nodes and the triangles that join them.

Triangles have three nodes (P1) or six (P2, in the order of `jaxbeam.mesh.triangle`) and are counter-clockwise. Lengths
are in the user's unit. A mesh is checked once, here, on the host. The rest of the package trusts a `Mesh`.

Make a `Mesh` of nodes and triangles of your own where neither `rectangle` nor `jaxbeam.files.read_mesh` will do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.tree import Numbers, index_field, is_concrete, pytree, to_device
from jaxbeam.mesh.elements import ELEMENTS, element_of
from jaxbeam.mesh.geometry import SLIVER, _areas, _check_geometry, _check_overlaps, _check_topology, _surface_of


@pytree
class Mesh:
    """Nodes and triangles of a body at rest.

    Args:
        nodes: `(n, 2)` rest positions, in the user's length unit. Their dtype is the dtype of every
            computation on the mesh. May be traced: results are differentiable in the shape.
        elements: `(t, 3)` or `(t, 6)` node numbers of each triangle: its corners, counter-clockwise, and then the
            nodes between corners 0 and 1, 1 and 2, 2 and 0. Always concrete.

    Raises:
        ValueError: if a shape or dtype is wrong, an index is out of range, a triangle repeats a node, is
            listed twice, is inverted somewhere or has no area, a node is unused, two nodes coincide, a
            coordinate is not finite, or two triangles overlap. In a mesh with curved edges, overlaps are found only
            between triangles that share an edge. If `nodes` is traced, a node that is not finite or a triangle that is
            inverted or has no area turns all nodes to NaN, and every solution computed from them is `INVALID`. Traced
            nodes that coincide, and traced triangles that overlap without sharing an edge, are not detected.
    """

    nodes: jax.Array
    elements: np.ndarray = index_field()
    # None on triangles. On a `Line` it is a length: the third coordinate of a node is this length times an angle.
    radian: ClassVar[Any] = None

    def __post_init__(self) -> None:
        shapes = " or ".join(f"(t, {nodes})" for nodes in ELEMENTS)
        elements = checks.whole_numbers("elements", self.elements, shapes, tuple(ELEMENTS))
        nodes = float_nodes(self.nodes, 2, "(x, y)")
        _check_topology(nodes.shape[0], elements)
        if is_concrete(nodes):
            positions = np.asarray(nodes, dtype=np.float64)
            _check_geometry(positions, elements)
            _check_overlaps(positions, elements, _surface_of(elements))
        else:
            _surface_of(elements)
            upright = _areas(nodes, elements) > SLIVER * jnp.max(jnp.ptp(nodes, axis=0)) ** 2
            nodes = checks.poisoned(nodes, jnp.all(upright))
        object.__setattr__(self, "nodes", to_device(nodes))
        object.__setattr__(self, "elements", elements)

    @property
    def is_line(self) -> bool:
        """Whether it is the centre line of a rod (see `jaxbeam.mesh.line.Line`) instead of triangles."""
        return self.radian is not None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.summary()})"

    def summary(self) -> str:
        """The numbers of nodes and elements, and the dtype, in words."""
        if not all(hasattr(each, "shape") for each in (self.nodes, self.elements)):
            return "a tree of other values"
        count, nodes = self.elements.shape
        kind = element_of(self.elements).name if not self.is_line else "element"
        return f"{self.nodes.shape[-2]} nodes, {count} {kind}s of {nodes} nodes, {self.nodes.dtype}"


def with_middles(mesh: Mesh, corners: np.ndarray) -> np.ndarray:
    """The `corners`, in the order given, and then the nodes on the edges between two of them."""
    among, found = np.isin(mesh.elements, corners), [np.zeros(0, int)]
    for first, second, *between in element_of(mesh.elements).edges:
        found.append(mesh.elements[among[:, first] & among[:, second]][:, between].ravel())
    return np.concatenate([corners, np.unique(np.concatenate(found))]).astype(int)


def nodes_where(mesh: Mesh, predicate: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """Numbers of the nodes whose rest position satisfies `predicate(x, y)`, in increasing order.

    Args:
        mesh: with concrete nodes.
        predicate: takes the coordinates `x` and `y`, each `(n,)`, and returns `(n,)` booleans.

    Raises:
        ValueError: if the predicate returns another shape or selects nothing, or the nodes are traced.

    >>> import jaxbeam as jb
    >>> left = nodes_where(jb.rectangle(2.0, 1.0, 3, 2), lambda x, y: x < -0.99)
    >>> [int(i) for i in left]
    [0, 1]
    """
    checks.function("predicate", predicate, "(x, y) -> booleans")
    return _selected(predicate, _concrete_nodes(mesh), "node")


def elements_where(mesh: Mesh, predicate: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """Numbers of the elements whose centre satisfies `predicate(x, y)`, in increasing order.

    They select entries of what is given for each element, such as Young's modulus in `lame`.

    Args:
        mesh: of triangles, with concrete nodes.
        predicate: takes the coordinates `x` and `y` of the centres, each `(t,)`, and returns `(t,)` booleans. The
            centre is the mean of the corners at rest.

    Raises:
        ValueError: if the predicate returns another shape or selects nothing, the nodes are traced, or `mesh` is the
            line of a rod.

    >>> import jaxbeam as jb
    >>> beam, young = jb.rectangle(4.0, 1.0, 5, 2), np.full(8, 1e4)
    >>> young[elements_where(beam, lambda x, y: x > 0)] = 1e3
    >>> [float(modulus) for modulus in young]
    [10000.0, 10000.0, 10000.0, 10000.0, 1000.0, 1000.0, 1000.0, 1000.0]
    """
    checks.function("predicate", predicate, "(x, y) -> booleans")
    check_triangles(mesh)
    nodes, corners = _concrete_nodes(mesh), element_of(mesh.elements).corners
    return _selected(predicate, nodes[mesh.elements[:, :corners]].mean(axis=1), "element")


def _selected(predicate: Callable[..., Any], points: np.ndarray, what: str) -> np.ndarray:
    """Numbers of the points that satisfy a predicate; `what` they stand for, for the message."""
    x, y = points.T
    mask = np.asarray(predicate(x, y))
    if mask.shape != x.shape or mask.dtype != bool:
        raise ValueError(f"predicate: expected {x.shape} booleans, got shape {mask.shape} of dtype {mask.dtype}")
    if not mask.any():
        raise ValueError(
            f"predicate: selects no {what}; x spans [{x.min():g}, {x.max():g}], y spans [{y.min():g}, {y.max():g}]"
        )
    return np.flatnonzero(mask)


def nearest_node(mesh: Mesh, point: Numbers) -> Any:
    """Number of the node nearest to a point at rest; of nodes equally near, the lowest number.

    Args:
        mesh: with known nodes.
        point: `(2,)`, or `(..., 2)` for many: `nearest_node(mesh, [[(0, 1), (2, 1)], [(0, 0), (2, 0)]])` gives the
            nodes `(2, 2)` of two tendons.

    Returns:
        An int, or `(...)` node numbers for many points.

    Raises:
        ValueError: if a point is not two finite numbers, or the nodes are traced.

    >>> import jaxbeam as jb
    >>> nearest_node(jb.rectangle(2.0, 1.0, 3, 2), [[-1.0, 0.5], [0.1, 0.4]]).tolist()
    [1, 3]
    """
    if not is_concrete(point):
        raise ValueError("point: expected known coordinates, got traced ones; select nodes outside jit and grad")
    target = checks.numbers("point", point)
    if target.ndim == 0 or target.shape[-1] != 2:
        raise ValueError(f"point: expected shape (2,), or (..., 2) for many points, got {target.shape}")
    nodes = _concrete_nodes(mesh)
    found = [int(np.argmin(np.sum((nodes - each) ** 2, axis=1))) for each in target.reshape(-1, 2)]
    return found[0] if target.ndim == 1 else np.array(found, np.int32).reshape(target.shape[:-1])


def pieces(elements: np.ndarray, count: int) -> np.ndarray:
    """For each of `count` nodes, the number `(count,)`, from 0, of the connected piece that it belongs to."""
    label = np.arange(count)
    while True:
        lowest = label[elements].min(axis=1)
        lower = label.copy()
        np.minimum.at(lower, elements, lowest[:, None])
        lower = lower[lower]
        if (lower == label).all():
            return np.unique(label, return_inverse=True)[1].ravel()
        label = lower


def _concrete_nodes(mesh: Mesh) -> np.ndarray:
    checks.instance("mesh", mesh, Mesh, "a scene has it as scene.mesh")
    if not is_concrete(mesh.nodes):
        raise ValueError(
            "mesh: its nodes are traced, so nodes cannot be selected by position; select before jit or grad"
        )
    return np.asarray(mesh.nodes, dtype=np.float64)


def check_triangles(mesh: Mesh) -> None:
    """Raise `ValueError` if `mesh` is not a mesh of triangles."""
    checks.instance("mesh", mesh, Mesh, "make one with rectangle(length, height, nx, ny) or Mesh(nodes, elements)")
    if mesh.is_line:
        raise ValueError("mesh: expected triangles, got the Line of a rod, whose body is rod(line, height, params)")


def float_nodes(value: Any, columns: int, row: str) -> Any:
    """Check rest positions `(n, columns)` and return them as floats; JAX arrays are returned as they are.

    Args:
        value: the positions.
        columns: number of coordinates of a node.
        row: names of the coordinates, for the message.
    """
    array = checks.real("nodes", value)
    if array.dtype.kind != "f":
        if isinstance(value, jax.Array):
            raise ValueError(f"nodes: expected floats, got dtype {array.dtype}; convert them with .astype(float)")
        array = array.astype(float)
    if array.ndim != 2 or array.shape[1] != columns:
        raise ValueError(f"nodes: expected shape (n, {columns}), got {array.shape}; give one {row} row for each node")
    return value if isinstance(value, jax.Array) else array
