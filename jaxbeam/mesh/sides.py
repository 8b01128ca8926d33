"""Lines of nodes along the surface of a body or other edges of its elements, and places on them by arc length.

They are for bodies whose sides are curved or slanted, where no condition on x and y picks the nodes: `side` gives the
line, `along` the guides of a cable on it, `surface_lines` the wall of each chamber.
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import Any

import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Key, Numbers, is_concrete, key_of, namespace, read_only
from jaxbeam.mesh.element import edge_rule, edge_slopes
from jaxbeam.mesh.elements import element_of
from jaxbeam.mesh.mesh import Mesh, check_triangles, nearest_node
from jaxbeam.mesh.surface import surface_of

# Points of Gauss's rule on each piece of an edge from one node to the next. The length of a straight piece is exact.
# That of a piece of an arc of 30 degrees is too, to round-off.
POINTS = 8


def surface_lines(mesh: Mesh) -> list[np.ndarray]:
    """The closed lines that bound a body: its outer surface, and that of each hole. Of several bodies, those of each.

    Args:
        mesh: of triangles; its nodes may be traced.

    Returns:
        For each line the numbers `(k,)` of its nodes in order, corners and nodes between them, each once. The body is
        on the left: the order is counter-clockwise around a body and clockwise around a hole. A line begins at its
        corner of lowest number, and lines are in the order of these. Close one with `np.append(line, line[0])`.

    Raises:
        ValueError: if `mesh` is the line of a rod.

    >>> import jaxbeam as jb
    >>> [line.tolist() for line in surface_lines(jb.rectangle(2.0, 1.0, 3, 2))]
    [[0, 2, 4, 5, 3, 1]]
    """
    check_triangles(mesh)
    return [np.array(loop) for loop in _loops(key_of(mesh, "elements"))]


@lru_cache(maxsize=32)
def _loops(body: Key) -> tuple[np.ndarray, ...]:
    """The nodes of each closed line of the surface of elements, as `surface_lines` returns them.

    Where parts of the body touch at a node, the line goes on along the part on which it came: about the node it turns
    through neighbouring elements. So the lines of two bodies that touch are two lines.
    """
    lines = {(row[0], row[1]): row for row in surface_of((body,)).tolist()}
    touching = np.isin(body.array, list(lines)).any(axis=1)
    # In its element the edge from a to b is followed by that from b to `ahead[a, b]`.
    ahead = {}
    for corners in body.array[touching, : element_of(body.array).corners].tolist():
        for k, corner in enumerate(corners):
            ahead[corners[k - 2], corners[k - 1]] = corner
    left, loops = dict(sorted(lines.items())), []
    while left:
        here, loop = next(iter(left)), []
        while here in left:
            first, _, *between = left.pop(here)
            loop += [first, *between]
            here = here[1], ahead[here]
            while here not in lines:
                here = here[0], ahead[here[::-1]]
        loops.append(read_only(loop))
    return tuple(loops)


def side(mesh: Mesh, start: Numbers, end: Numbers) -> np.ndarray:
    """A side of the body: the nodes of the surface from `start` to `end`, with the body on the left.

    This is counter-clockwise around a body, and clockwise around a hole. The upper side of a `rectangle` runs from its
    upper right corner to its upper left one.

    Args:
        mesh: of triangles; its nodes may be traced.
        start: number of a node on the surface, or a point `(2,)` at rest that stands for the nearest node.
        end: the same, on the same closed line of the surface. If it is `start`, the side is all of that line.

    Returns:
        `(k,)` node numbers in order, corners and nodes between them, both ends included.

    Raises:
        ValueError: if a node is not on the surface, they are on different lines of it, or the surface passes through
            one of them twice.

    >>> import jaxbeam as jb
    >>> side(jb.rectangle(2.0, 1.0, 3, 2), 5, 1).tolist()
    [5, 3, 1]
    >>> side(jb.rectangle(2.0, 1.0, 3, 2), (1.0, 0.5), (-1.0, 0.5)).tolist()
    [5, 3, 1]
    """
    check_triangles(mesh)
    loops = surface_lines(mesh)
    (first, place), (second, last) = (_on_surface(name, mesh, loops, n) for name, n in (("start", start), ("end", end)))
    if first != second:
        raise ValueError(
            f"end: expected a node of the closed line of the surface that {start} is on, got {end}, which is on "
            f"another one; choose both from one of surface_lines(mesh)"
        )
    length = (last - place) % len(loops[first])
    return np.roll(loops[first], -place)[: length + 1 if length else None]


def _on_surface(name: str, mesh: Mesh, loops: list[np.ndarray], value: Any) -> tuple[int, int]:
    """Which of the closed lines of the surface a node is on, and its place there."""
    if not is_concrete(value):
        raise ValueError(f"{name}: expected a node number, got a traced value; choose nodes outside jit and grad")
    value = nearest_node(mesh, value) if np.shape(value) == (2,) else value
    node = checks.count(name, value.item() if getattr(value, "shape", None) == () else value, 0)
    if node >= len(mesh.nodes):
        raise ValueError(f"{name}: {node} is out of range, nodes are numbered 0 to {len(mesh.nodes) - 1}")
    found = [(k, int(place)) for k, loop in enumerate(loops) for place in np.flatnonzero(loop == node)]
    if len(found) != 1:
        problem = "the surface passes through it more than once" if found else "it is inside the body"
        raise ValueError(
            f"{name}: expected a node that the surface passes through once, got {node}: {problem}; choose one of "
            f"surface_lines(mesh)"
        )
    return found[0]


@usual_rules
def arc_lengths(mesh: Mesh, nodes: Numbers) -> Any:
    """Arc length at rest of each node of a line, from its first one. Curved edges are measured as curves.

    Args:
        mesh: of triangles; its nodes may be traced.
        nodes: `(k,)` node numbers in order, such as those of `side` or `surface_lines`, or of a line inside the body
            that follows edges of elements. To tell the length of a closed line repeat its first node at the end.

    Returns:
        `(k,)` arc lengths, 0 for the first node, differentiable in the nodes of the mesh; a NumPy array unless these
        are traced.

    Raises:
        ValueError: if a node is out of range, or no edge joins two nodes that follow each other.
    """
    check_triangles(mesh)
    line = checks.node_numbers("nodes", len(mesh.nodes), nodes, 1)
    xp = namespace(mesh.nodes)
    if len(line) == 1:
        return xp.zeros(1, mesh.nodes.dtype)
    edges, pieces = _edges_along(mesh, line)
    (points, shares), parts = edge_rule(POINTS), edges.shape[1] - 1
    xi = (pieces[:, None] + points) / parts
    rest = xp.asarray(mesh.nodes)[edges]
    slopes = xp.asarray(edge_slopes(edges.shape[1], xi), mesh.nodes.dtype)
    along = xp.einsum("mqk,mkd->mqd", slopes, rest - rest[:, :1])
    speeds = xp.sqrt(xp.sum(along**2, axis=2))
    lengths = speeds @ xp.asarray(shares / parts, mesh.nodes.dtype)
    return xp.concatenate([xp.zeros(1, mesh.nodes.dtype), xp.cumsum(lengths)])


def _edges_along(mesh: Mesh, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges of elements that a line runs along.

    Returns:
        For each two nodes of the line that follow each other the nodes `(k - 1, e)` of the edge that holds both, and
        which of its pieces `(k - 1,)` between two nodes lies between them, counted from its first end.
    """
    kind, known = element_of(mesh.elements), {}
    for element in mesh.elements[np.isin(mesh.elements, line).sum(axis=1) > 1].tolist():
        for edge in kind.edges:
            first, last, *between = nodes = [element[k] for k in edge]
            chain = [first, *between, last]
            for piece, (a, b) in enumerate(itertools.pairwise(chain)):
                known[a, b] = known[b, a] = (nodes, piece)
    found = []
    for a, b in itertools.pairwise(line.tolist()):
        if (a, b) not in known:
            raise ValueError(
                f"nodes: nodes {a} and {b} follow each other, but are not neighbours on an edge; give the nodes of a "
                f"line in order, such as those of side(mesh, start, end)"
            )
        found.append(known[a, b])
    edges, pieces = zip(*found, strict=True)
    return np.array(edges), np.array(pieces)


def along(mesh: Mesh, nodes: Numbers, distances: Numbers, corners: bool = False) -> np.ndarray:
    """The nodes of a line that lie nearest to given distances from its beginning: guides of a tendon, or markers.

    Args:
        mesh: of triangles, with concrete nodes.
        nodes: `(k,)` node numbers in order, as for `arc_lengths`.
        distances: `(m,)` or `()` arc lengths at rest from the first node; at most the length of the line.
        corners: choose among the corners of elements alone. Anchors of finite width need corners.

    Returns:
        `(m,)` or `()` node numbers; of two nodes equally near, the first.

    Raises:
        ValueError: if a distance lies beyond an end of the line, the nodes of the mesh are traced, or as `arc_lengths`
            does.

    >>> import jaxbeam as jb
    >>> beam = jb.rectangle(4.0, 1.0, 5, 2)
    >>> along(beam, side(beam, 0, 8), [0.9, 3.2]).tolist()
    [2, 6]
    """
    check_triangles(mesh)
    checks.flag("corners", corners)
    if not is_concrete(mesh.nodes, distances):
        name = "mesh: its nodes are" if is_concrete(distances) else "distances: they are"
        raise ValueError(f"{name} traced, so nodes cannot be selected by position; select before jit or grad")
    arcs = np.asarray(arc_lengths(mesh, nodes), float)
    line = np.asarray(nodes)
    wanted = np.asarray(checks.numbers("distances", distances), float)
    # A distance that was computed may be longer than the line by round-off.
    outside = wanted[(wanted < 0) | (wanted > (1 + 1e-6) * arcs[-1])]
    if outside.size or wanted.ndim > 1:
        got = f"shape {wanted.shape}" if wanted.ndim > 1 else f"{outside[0]:g}"
        raise ValueError(f"distances: expected numbers from 0 to {arcs[-1]:g}, the length of the line, got {got}")
    if corners:
        kept = np.isin(line, mesh.elements[:, : element_of(mesh.elements).corners])
        line, arcs = line[kept], arcs[kept]
        if not line.size:
            raise ValueError("nodes: expected at least one corner of an element, got none; use corners=False")
    return line[np.argmin(np.abs(wanted[..., None] - arcs), axis=-1)]
