"""Triangle meshes: rest positions of the nodes and the triangles that join them.

Triangles have three nodes (P1) or six (P2, see `jaxbeam.elements` for their order) and are counter-clockwise, lengths
are in the user's unit. Everything is checked here, on the host, once; what follows trusts a `Mesh`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam import checks
from jaxbeam._tree import Numbers, index_field, is_concrete, namespace, pytree, to_device, usual_rules
from jaxbeam.bernstein import minimiser, value
from jaxbeam.elements import EDGES, corner_slopes, determinants, is_affine, shape_functions

Diagonals = Literal["one-sided", "mirrored", "crossed"]


@pytree
class Mesh:
    """Nodes and triangles of a body at rest.

    Args:
        nodes: `(n, 2)` rest positions, in the user's length unit. Their dtype is the dtype of every
            computation on the mesh. May be traced: shape is differentiable.
        elements: `(t, 3)` or `(t, 6)` node numbers of each triangle: its corners, counter-clockwise, and then the
            nodes between corners 0 and 1, 1 and 2, 2 and 0. Always concrete.

    Raises:
        ValueError: if a shape or dtype is wrong, an index is out of range, a triangle repeats a node, is
            listed twice, is inverted somewhere or has no area, a node is unused, two nodes coincide, a
            coordinate is not finite, or two triangles overlap. Where edges are curved, overlaps are found only
            between triangles that share an edge. While `nodes` is traced, a node that is not finite and a triangle that
            is inverted or has no area make it NaN, and whatever is solved on it `INVALID`; nodes that coincide and
            triangles that overlap without sharing an edge are not looked for.
    """

    nodes: jax.Array
    elements: np.ndarray = index_field()

    def __post_init__(self) -> None:
        elements = checks.whole_numbers("elements", self.elements, "(t, 3) or (t, 6)", (3, 6))
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


@usual_rules
def rectangle(
    length: Numbers,
    height: Numbers,
    nx: int,
    ny: int,
    diagonals: Diagonals = "one-sided",
    dtype: Any = None,
    *,
    order: int = 1,
    graded: bool = False,
) -> Mesh:
    """Mesh of a rectangle centred on the origin, whose triangles have `nx` x `ny` corners.

    Corner `(i, j)`, column `i` from the left and row `j` from below, has number `i * ny + j`; the cell
    centres of crossed diagonals follow after all of these, and then the nodes between corners, if `order` is 2.

    Args:
        length: extent in x, positive; may be traced.
        height: extent in y, positive; may be traced.
        nx: corners along the length, at least 2.
        ny: corners along the height, at least 2.
        diagonals: how a cell is split. `"one-sided"`: two triangles, by the diagonal from lower left to
            upper right. `"mirrored"`: the same below mid-height and its mirror image above, so the mesh is
            symmetric about mid-height (`ny` must be odd). `"crossed"`: four triangles about the centre.
        dtype: of the nodes; by default JAX's float.
        order: of the shape functions: 1 for triangles of three nodes, 2 for six (see `quadratic`).
        graded: crowd columns right of the left edge, by the power 3/2 of the distance, and of the middle, by a
            hyperbolic sine of it, with two thirds of the columns between these two (see `middle_column`); and rows at
            both faces. For a beam that is clamped at that edge and steered from its middle.

    Returns:
        A `Mesh`, differentiable in `length` and `height`.

    Raises:
        ValueError: if a count is not a whole number of at least 2, an extent is not positive and finite,
            `diagonals` or `order` is unknown, a mirrored mesh is asked for with an even `ny`, or a graded one with an
            `nx` of 2.
    """
    if not isinstance(order, int | np.integer) or isinstance(order, bool) or order not in (1, 2):
        raise ValueError(f"order: expected 1 (triangles of three nodes) or 2 (of six), got {order!r}")
    checks.count("nx", nx, 2)
    checks.count("ny", ny, 2)
    length, height = (
        checks.number(name, value, checks.POSITIVE) for name, value in (("length", length), ("height", height))
    )
    graded, dtype = checks.flag("graded", graded), checks.float_dtype("dtype", dtype)
    if not isinstance(diagonals, str) or diagonals not in ("one-sided", "mirrored", "crossed"):
        raise ValueError(f"diagonals: expected 'one-sided', 'mirrored' or 'crossed', got {diagonals!r}")
    if diagonals == "mirrored" and ny % 2 == 0:
        raise ValueError(
            f"ny: expected an odd number for mirrored diagonals, got {ny}: no row of nodes lies at mid-height; "
            f"use {ny + 1}, or crossed diagonals, which are symmetric for any ny"
        )
    across, along = np.linspace(0, 1, nx), np.linspace(-0.5, 0.5, ny)
    if graded:
        middle = middle_column(nx, graded)
        left, right = np.arange(middle + 1) / middle, np.arange(1, nx - middle) / (nx - 1 - middle)
        # Of 2.5, 3 and 3.5 the last left the reference beam the least error on most meshes.
        across = 0.5 * np.append(left**1.5, 1 + np.sinh(3.5 * right) / np.sinh(3.5))
        along = 0.6 * along + 0.2 * np.sin(np.pi * along)
    unit_x, unit_y = np.meshgrid(across - 0.5, along, indexing="ij")
    unit = np.stack([unit_x.ravel(), unit_y.ravel()], axis=1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nx - 1), np.arange(ny - 1), indexing="ij"))
    lower_left = i * ny + j
    upper_left, lower_right, upper_right = lower_left + 1, lower_left + ny, lower_left + ny + 1
    if diagonals == "crossed":
        centre = nx * ny + np.arange(lower_left.size)
        unit = np.concatenate([unit, (unit[lower_left] + unit[upper_right]) / 2])
        corners = [lower_left, lower_right, upper_right, upper_left]
        triangles = [(corners[k], corners[(k + 1) % 4], centre) for k in range(4)]
    else:
        falling = (diagonals == "mirrored") & (j >= (ny - 1) // 2)
        triangles = [
            (lower_left, lower_right, np.where(falling, upper_left, upper_right)),
            (np.where(falling, lower_right, lower_left), upper_right, upper_left),
        ]
    elements = np.stack([np.stack(t, axis=1) for t in triangles], axis=1).reshape(-1, 3)
    xp = namespace(length, height)
    extent = xp.stack([xp.asarray(length, dtype), xp.asarray(height, dtype)])
    mesh = Mesh(xp.asarray(unit, dtype) * extent, elements)
    return quadratic(mesh) if order == 2 else mesh


def middle_column(nx: int, graded: bool) -> int:
    """The column of corners of a `rectangle` that lies in the middle of its length.

    Raises:
        ValueError: if there is none.
    """
    if graded and nx < 3:
        raise ValueError(f"nx: expected at least 3 for a graded mesh, got {nx}: no node lies in the middle; use 3")
    if graded:
        return min(-(-2 * (nx - 1) // 3), nx - 2)
    if nx % 2 == 0:
        raise ValueError(
            f"nx: expected an odd number, got {nx}: no node lies in the middle, where the tendons end; "
            f"use {nx - 1 if nx > 2 else 3} or {nx + 1}"
        )
    return (nx - 1) // 2


@usual_rules
def quadratic(mesh: Mesh) -> Mesh:
    """The mesh of the same triangles with six nodes each: those between corners follow after the corners.

    Differentiable in the nodes.

    Raises:
        ValueError: if the triangles have six nodes already, or it is not made of triangles.
    """
    check_triangles(mesh)
    if mesh.elements.shape[1] != 3:
        raise ValueError("mesh: its triangles have six nodes already")
    return _made(mesh, with_middle_nodes(mesh.elements, len(mesh.nodes)))


@usual_rules
def refined(mesh: Mesh) -> Mesh:
    """The mesh with every triangle cut into four by the middles of its edges, four in the place of one.

    Nodes keep their numbers. Six-node triangles keep the shape of their edges. Differentiable in the nodes.

    Raises:
        ValueError: if it is not made of triangles.
    """
    check_triangles(mesh)
    return _made(mesh, cut_in_four(mesh.elements, len(mesh.nodes)))


class Finer(NamedTuple):
    """How a finer mesh comes from a coarse one: its `elements`, and each of its nodes as a mean of coarse `nodes`
    `(n, k)` with `weights` `(n, k)`. Displacements are carried over as positions are."""

    elements: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray

    def carry(self, field: Any) -> Any:
        """The nodal field `(n, d)` of the coarse mesh on the finer one."""
        xp = namespace(field)
        return xp.sum(self.weights[:, :, None].astype(field.dtype) * xp.asarray(field)[self.nodes], axis=1)


def with_middle_nodes(elements: np.ndarray, count: int) -> Finer:
    """Triangles of three nodes as triangles of six."""
    pairs = np.sort(elements[:, EDGES].reshape(-1, 2), axis=1)
    ends, number = np.unique(pairs, axis=0, return_inverse=True)
    old = np.repeat(np.arange(count)[:, None], 2, axis=1)
    weights = np.concatenate([np.tile([1.0, 0.0], (count, 1)), np.full((len(ends), 2), 0.5)])
    whole = np.concatenate([elements, count + number.reshape(-1, 3)], axis=1)
    return Finer(whole, np.concatenate([old, ends]), weights)


def cut_in_four(elements: np.ndarray, count: int) -> Finer:
    """Each triangle as four of the same number of nodes, at the corners and in the middle."""
    if elements.shape[1] == 3:
        six = with_middle_nodes(elements, count)
        four = six.elements[:, _PARTS[:, :3]]
        return Finer(four.reshape(-1, 3), six.nodes, six.weights)
    inside = np.stack([(_PLACES[part[a]] + _PLACES[part[b]]) / 2 for part in _PARTS for a, b in EDGES])
    # Parts share nodes with each other and triangles with their neighbours: one is known by its corners, weighted.
    quarters = np.round(4 * inside).astype(np.int64)
    corners = elements[:, None, :3].astype(np.int64)
    keys = np.sort(np.where(quarters > 0, corners * 4 + quarters, -1), axis=2).reshape(-1, 3)
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    whole = np.concatenate([elements[:, _PARTS], (count + number).reshape(-1, 4, 3)], axis=2)
    values = shape_functions(6, inside)
    old = np.repeat(np.arange(count)[:, None], 6, axis=1)
    own = np.tile(np.eye(1, 6), (count, 1))
    nodes = np.concatenate([old, elements[first // 12]])
    return Finer(whole.reshape(-1, 6), nodes, np.concatenate([own, values[first % 12]]))


# A triangle of no more area than this share of the square of the body's extent has none.
SLIVER = 1e-14
# The places of the six nodes of a triangle, and those of the corners and middles of its four parts that are among them.
_PLACES = np.concatenate([np.eye(3), [[0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]]])
_PARTS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])


def _made(mesh: Mesh, finer: Finer) -> Mesh:
    return Mesh(finer.carry(namespace(mesh.nodes).asarray(mesh.nodes)), finer.elements)


def with_middles(mesh: Mesh, corners: np.ndarray) -> np.ndarray:
    """Corner nodes, in the order given, and the nodes that lie between two of them."""
    among = np.isin(mesh.elements[:, :3], corners)
    found = (
        [mesh.elements[among[:, a] & among[:, b], 3 + k] for k, (a, b) in enumerate(EDGES)]
        if mesh.elements.shape[1] == 6
        else []
    )
    return np.concatenate([corners, np.unique(np.concatenate([*found, np.zeros(0, int)]))]).astype(int)


def nodes_where(mesh: Mesh, predicate: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """Numbers of the nodes whose rest position satisfies `predicate(x, y)`, in increasing order.

    Args:
        mesh: with concrete nodes.
        predicate: takes the `(n,)` coordinates and returns `(n,)` booleans.

    Raises:
        ValueError: if the predicate returns another shape or selects nothing, or the nodes are traced.

    >>> left = nodes_where(rectangle(2.0, 1.0, 3, 2), lambda x, y: x < -0.99)
    >>> [int(i) for i in left]
    [0, 1]
    """
    checks.function("predicate", predicate, "(x, y) -> booleans")
    x, y = _concrete_nodes(mesh).T
    mask = np.asarray(predicate(x, y))
    if mask.shape != x.shape or mask.dtype != bool:
        raise ValueError(f"predicate: expected {x.shape} booleans, got shape {mask.shape} of dtype {mask.dtype}")
    if not mask.any():
        raise ValueError(
            f"predicate: selects no node; x spans [{x.min():g}, {x.max():g}], y spans [{y.min():g}, {y.max():g}]"
        )
    return np.flatnonzero(mask)


def nearest_node(mesh: Mesh, point: Numbers) -> int:
    """Number of the node nearest to `point` `(2,)` at rest (the lowest number among equals).

    Raises:
        ValueError: if the point is not two finite numbers, or the nodes are traced.
    """
    if not is_concrete(point):
        raise ValueError("point: expected two known coordinates, got traced ones; select nodes outside jit and grad")
    target = checks.numbers("point", point, shapes=((2,),))
    return int(np.argmin(np.sum((_concrete_nodes(mesh) - target) ** 2, axis=1)))


def pieces(elements: np.ndarray, count: int) -> np.ndarray:
    """`(n,)` number, from 0, of the connected piece that each of `count` nodes belongs to."""
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
    """Refuse what is not a mesh of triangles."""
    checks.instance("mesh", mesh, Mesh, "make one with rectangle(length, height, nx, ny) or Mesh(nodes, elements)")
    if mesh.elements.shape[1] == 2:
        raise ValueError("mesh: expected triangles, got the Line of a rod, whose body is rod(line, height, params)")


def float_nodes(value: Any, columns: int, row: str) -> Any:
    """Rest positions `(n, columns)` as floats, each `row` of them; JAX arrays as they are."""
    array = checks.real("nodes", value)
    if array.dtype.kind != "f":
        if isinstance(value, jax.Array):
            raise ValueError(f"nodes: expected floats, got dtype {array.dtype}; convert them with .astype(float)")
        array = array.astype(float)
    if array.ndim != 2 or array.shape[1] != columns:
        raise ValueError(f"nodes: expected shape (n, {columns}), got {array.shape}; give one {row} row for each node")
    return value if isinstance(value, jax.Array) else array


def _check_topology(count: int, elements: np.ndarray) -> None:
    outside = np.flatnonzero(((elements < 0) | (elements >= count)).any(axis=1))
    if outside.size:
        k = outside[0]
        raise ValueError(f"elements: triangle {k} is {elements[k].tolist()}, but nodes are numbered 0 to {count - 1}")
    ordered = np.sort(elements, axis=1)
    repeated = np.flatnonzero((np.diff(ordered, axis=1) == 0).any(axis=1))
    if repeated.size:
        k = repeated[0]
        raise ValueError(f"elements: triangle {k} repeats a node: {elements[k].tolist()}; remove it")
    used = np.zeros(count, bool)
    used[elements] = True
    if not used.all():
        unused = np.flatnonzero(~used)
        raise ValueError(
            f"nodes: {unused.size} belong to no triangle, the first is node {unused[0]}; remove them and renumber"
        )


def _check_geometry(nodes: np.ndarray, elements: np.ndarray) -> None:
    if not np.isfinite(nodes).all():
        k = np.flatnonzero(~np.isfinite(nodes).all(axis=1))[0]
        raise ValueError(f"nodes: node {k} is not finite: {nodes[k].tolist()}")
    extent = np.ptp(nodes, axis=0).max()
    # Merging nodes closer than this is what mesh generators do; a real gap is far wider.
    grid = np.round(nodes / (1e-9 * extent if extent > 0 else 1.0))
    _, first, inverse = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    original = first[inverse.ravel()]
    copies = np.flatnonzero(original != np.arange(len(nodes)))
    if copies.size:
        k = copies[0]
        raise ValueError(
            f"nodes: nodes {original[k]} and {k} coincide at {nodes[k].tolist()}; merge them, or the body is torn there"
        )
    area = _areas(nodes, elements)
    bad = np.flatnonzero(area <= SLIVER * extent**2)
    if bad.size:
        k = bad[0]
        cure = "list its corners counter-clockwise" if area[k] < 0 else "remove it, or move its nodes off one line"
        raise ValueError(
            f"elements: triangle {k}, {elements[k].tolist()}, has area {area[k]:g}, expected positive; {cure}"
            f" ({bad.size} such triangles)"
        )
    if not is_affine(elements.shape[1]):
        _check_curves(nodes, elements, area)


def _areas(nodes: Any, elements: np.ndarray) -> Any:
    """Signed area `(t,)` of each triangle between its corners."""
    a, b, c = (nodes[elements[:, k]] for k in range(3))
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def _check_curves(nodes: np.ndarray, elements: np.ndarray, area: np.ndarray) -> None:
    """Refuse triangles of six nodes that fold over somewhere, between corners that enclose a positive `area` `(t,)`."""
    slopes = corner_slopes(np.moveaxis(nodes[elements], 0, -1))
    stretch = np.stack(determinants(slopes, slopes)) / (2 * area)
    place = minimiser(stretch)
    least = value(stretch, place)
    bad = np.flatnonzero(least <= 1e-12)
    if bad.size:
        k = bad[0]
        where = ", ".join(f"{coordinate:.3g}" for coordinate in place[:, k])
        raise ValueError(
            f"elements: triangle {k}, {elements[k].tolist()}, folds over: its edges are curved so much that the "
            f"determinant of its map is {least[k]:.3g} times that of the straight triangle at barycentric coordinates "
            f"({where}), expected positive; move its nodes 3 to 5 towards the middles of its edges ({bad.size} such "
            f"triangles)"
        )


# ----------------------------------------------------------------------------------------------- overlaps


def _surface_of(elements: np.ndarray) -> np.ndarray:
    """Edges `(b, 2)` of the surface, the body on their left, after a check of all edges.

    Raises:
        ValueError: if two triangles lie on the same side of an edge: if each is counter-clockwise, an edge runs one way
            in one of its triangles and the other way in the other.
    """
    a, b = elements[:, EDGES].reshape(-1, 2).T.astype(np.int64)
    total = int(elements.max()) + 1
    # One number tells both ends of a side and its direction; those of one edge are neighbours when sorted.
    sides = np.sort((np.minimum(a, b) * total + np.maximum(a, b)) * 2 + (a > b))
    edge = sides >> 1
    twice = np.flatnonzero(sides[1:] == sides[:-1])
    if twice.size:
        ends = divmod(int(edge[twice[0]]), total)
        those = np.flatnonzero(np.isin(elements[:, :3], ends).sum(axis=1) == 2)
        corners = np.sort(elements[those, :3], axis=1)
        if len(np.unique(corners, axis=0)) < len(those):
            k = those[0]
            raise ValueError(
                f"elements: triangle {k}, {elements[k].tolist()}, is listed more than once; remove the copies"
            )
        raise ValueError(
            f"elements: triangles {those.tolist()} meet in the edge between nodes {ends[0]} and {ends[1]}, and two of "
            f"them lie on the same side of it; triangles must not overlap"
        )
    shared = np.append(edge[1:] == edge[:-1], False)
    alone = ~(shared | np.roll(shared, 1))
    low, high = np.divmod(edge[alone], total)
    turned = (sides[alone] & 1).astype(bool)
    return np.stack([np.where(turned, high, low), np.where(turned, low, high)], axis=1)


def _check_overlaps(nodes: np.ndarray, elements: np.ndarray, edges: np.ndarray) -> None:
    """Refuse triangles that overlap, from the surface `edges` alone, of triangles that are counter-clockwise.

    So many triangles lie over a point as the surface winds round it. That number changes only across the surface: it is
    at most 1 if no two edges of the surface cross, and it is 1 beside each of them.
    """
    # Measured from one of its nodes, wherever the body lies.
    begin, end = (nodes[edges[:, k]] - nodes[edges[0, 0]] for k in (0, 1))
    extent = np.ptp(begin, axis=0)
    if elements.shape[1] == 6:
        bulge = nodes[elements[:, 3:]] - nodes[elements[:, EDGES]].mean(axis=2)
        if np.abs(bulge).max() > 1e-9 * extent.max():
            return
    first, second = _crossing(begin, end, int(np.argmax(extent)))
    if first.size:
        here, there = edges[first[0]].tolist(), edges[second[0]].tolist()
        raise ValueError(
            f"elements: triangles overlap: the edge between nodes {here[0]} and {here[1]} of the surface crosses that "
            f"between nodes {there[0]} and {there[1]}"
        )
    covered = np.flatnonzero(_windings(begin, end) > 1)
    if covered.size:
        a, b = edges[covered[0]].tolist()
        raise ValueError(f"elements: triangles overlap: others lie over that at the edge between nodes {a} and {b}")


def _crossing(begin: np.ndarray, end: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of edges, as numbers of the first and of the second, that cross each other between their ends."""
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    order = np.argsort(low[:, axis])
    last = np.searchsorted(low[order, axis], high[order, axis])
    i, j = (order[k] for k in _ranges(np.arange(1, len(order) + 1), last))
    near = (low[i, 1 - axis] < high[j, 1 - axis]) & (low[j, 1 - axis] < high[i, 1 - axis])
    i, j = i[near], j[near]
    # What is no more than round-off counts as touching.
    noise = 1e-12 * np.abs(end).max()

    def apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        along = end[one] - begin[one]
        least = noise * np.linalg.norm(along, axis=1)
        sides = [_cross(along, point[other] - begin[one]) for point in (begin, end)]
        return (np.minimum(*sides) < -least) & (np.maximum(*sides) > least)

    crossed = apart(i, j) & apart(j, i)
    return i[crossed], j[crossed]


def _windings(begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """How often the edges wind round the point just left of the middle of each."""
    along = end - begin
    point = (begin + end) / 2 + 1e-6 * np.stack([-along[:, 1], along[:, 0]], axis=1)
    order = np.argsort(point[:, 1])
    heights = point[order, 1]
    first, last = (np.searchsorted(heights, of(begin[:, 1], end[:, 1])) for of in (np.minimum, np.maximum))
    edge, k = _ranges(first, last)
    beside = order[k]
    side = np.sign(_cross(along[edge], point[beside] - begin[edge]))
    # A ray to the right of the point meets the edges on that side: upward ones, or downward ones.
    up = np.sign(along[edge, 1])
    return np.bincount(beside, up * (side == up), minlength=len(begin))


def _ranges(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All pairs `(i, k)` with `first[i] <= k < last[i]`."""
    lengths = np.maximum(last - first, 0)
    i = np.repeat(np.arange(len(first)), lengths)
    return i, np.arange(len(i)) + np.repeat(first - np.cumsum(lengths) + lengths, lengths)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
