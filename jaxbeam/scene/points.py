"""Points and lines that follow the body: markers anywhere in it, and the curvature of lines of nodes.

Use a `marker` for a place that is no node. The position of a node is in `solution.x`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import one_program
from jaxbeam.core.tree import Numbers, is_concrete
from jaxbeam.mesh.element import Element, edge_functions
from jaxbeam.mesh.elements import element_of
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.surface import surface
from jaxbeam.physics.energy import check_nodes
from jaxbeam.scene.scene import Scene, check_scene, placed

# Steps of Newton's method from each start to a point of a curved element. It takes about five.
STEPS = 30
# A point this far outside an element, in weights of its corners, counts as on its edge.
ON_EDGE = 1e-9
# Chords of a curved edge, to tell the distance to it.
CHORDS = 16


# --------------------------------------------------------------------------------------------- curvature


def curvature(scene: Scene, x: jax.Array, nodes: Numbers) -> jax.Array:
    """Curvature of the line through `nodes`, at each of them but the first and the last: 1 over the radius.

    It is that of the circle through a node and its two neighbours, `2 a cross b / (|a| |b| |a + b|)` with `a` and `b`
    the vectors to the node and on from it (Menger 1930; Calabi et al. 1998, Int. J. Comput. Vision 26, 107-135). It is
    exact on a circle, and otherwise an approximation of second order if nodes are evenly spaced, else of first.

    Args:
        scene: whose nodes they are; also of a rod.
        x: `(n, 2)`, or `(n, 3)` of a rod: positions. At `scene.mesh.nodes` this is the curvature at rest.
        nodes: `(k,)` at least three node numbers in order, such as those of `side`. Of a closed line repeat the first
            two at the end.

    Returns:
        `(k - 2,)`, in 1 / length, positive where the line turns anticlockwise. Differentiable in the scene and `x`.

    Raises:
        ValueError: if `x` has another shape, a node is out of range, there are fewer than three, or one follows itself
            directly or after one other.
    """
    check_scene(scene)
    line = check_nodes("nodes", scene.mesh, nodes, ndim=1)
    if len(line) < 3:
        raise ValueError(f"nodes: expected at least three nodes of a line, got {len(line)}; give more of them")
    repeated = np.flatnonzero((line[1:-1] == line[:-2]) | (line[1:-1] == line[2:]) | (line[:-2] == line[2:]))
    if repeated.size:
        three = line[repeated[0] : repeated[0] + 3].tolist()
        raise ValueError(f"nodes: {three} follow each other, expected three different nodes; give each point once")
    return _curvature(placed(scene, x), line)


@one_program
def _curvature(x: jax.Array, nodes: Any) -> jax.Array:
    steps = jnp.diff(x[nodes, :2], axis=0)
    a, b = steps[:-1], steps[1:]
    length = lambda vectors: jnp.sqrt(jnp.sum(vectors**2, axis=1))
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return 2 * cross / (length(a) * length(b) * length(a + b))


# ----------------------------------------------------------------------------------------------- markers


@dataclasses.dataclass(frozen=True)
class Marker:
    """A material point, or several: `marker(scene, x)` is where it is at positions `x`. Made by `marker`.

    It is known by its element and by the weights of the element's corners, so it follows the body in any scene on the
    mesh, also one whose nodes are traced or moved, and on meshes that `refined`, `enriched` or `estimate_error` make of
    it. Hashable and compared by value, so it may be the measure of `reach` and is compiled once.

    elements: number of the element of each point.
    places: for each point the weights of the corners of its element, of sum 1.
    total: number of elements of the mesh.
    single: whether it is one point rather than a list of points.
    """

    elements: tuple[int, ...]
    places: tuple[tuple[float, ...], ...]
    total: int
    single: bool

    def __call__(self, scene: Scene, x: jax.Array) -> jax.Array:
        """Position `(2,)` of the point, or `(m, 2)` of several, at node positions `x` `(n, 2)`.

        Differentiable in `x`, and linear in it.

        Raises:
            ValueError: if `x` has another shape, or the mesh of the scene is not that of the marker or a refined one.
        """
        x = placed(scene, x)
        nodes, weights = self.weights(scene.mesh)
        found = _weighted(x, nodes, weights.astype(x.dtype))
        return found[0] if self.single else found

    def weights(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
        """Node numbers `(m, k)` of the element of each point, and the weights `(m, k)` of sum 1 of their positions.

        Raises:
            ValueError: if the mesh is neither that of the marker nor a refined one.
        """
        elements, places, total = np.array(self.elements), np.array(self.places), self.total
        kind = element_of(mesh.elements) if not mesh.is_line else None
        while kind is not None and total < len(mesh.elements):
            elements, places = _in_parts(kind, elements, places)
            total *= len(kind.children)
        if kind is None or total != len(mesh.elements):
            raise ValueError(
                f"scene: expected the mesh of {self.total} elements on which the marker was found, or a refined one, "
                f"got {len(mesh.elements)} elements; make another with marker(scene, point)"
            )
        return mesh.elements[elements], kind.shape(places)


def _in_parts(kind: Element, elements: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of elements as points of the parts into which refinement cuts these: the part, and the place in it."""
    local = np.einsum("mc,pcd->mpd", places, np.linalg.inv(kind.children))
    inside = local.min(axis=2).argmax(axis=1)
    return len(kind.children) * elements + inside, local[np.arange(len(local)), inside]


@one_program
def _weighted(x: jax.Array, nodes: Any, weights: Any) -> jax.Array:
    # Relative to the first node of each element: far from the origin no digits are lost.
    first = x[nodes[:, :1]]
    return first[:, 0] + jnp.sum(weights[:, :, None] * (x[nodes] - first), axis=1)


def marker(scene: Scene, point: Numbers) -> Marker:
    """The material point that is at `point` when the body is at rest, as a function `(scene, x) -> position`.

    Its element and its place in it are found by Newton's method on the map of the element, which is curved if its edges
    are. Positions between nodes are those of the shape functions: exact for a field that these represent.

    Args:
        scene: with triangles, whose nodes are concrete.
        point: `(2,)` a point of the body, or `(m, 2)` several.

    Returns:
        A `Marker`. It may serve as the measure of `reach`, or of `estimate_error` if one of its coordinates is taken.

    Raises:
        ValueError: if a point is not finite or lies outside the body, the scene has a rod, or the nodes are traced.

    >>> import jaxbeam as jb
    >>> scene = jb.tendon_beam(3, 2, order=2)
    >>> centre = marker(scene, [0.1, 0.2])
    >>> [round(float(c), 6) for c in centre(scene, scene.mesh.nodes + 1.0)]
    [1.1, 1.2]
    """
    check_scene(scene)
    mesh = scene.mesh
    if mesh.is_line:
        raise ValueError("scene: expected a body of triangles, got a rod; take its nodes, and beside them the height")
    if not is_concrete(mesh.nodes, point):
        raise ValueError(
            "scene, point: expected known positions at rest, got traced ones; find the marker before jit or grad, it "
            "serves every scene of the same mesh, also one whose nodes are traced"
        )
    points = np.asarray(checks.real("point", point), float)
    if points.ndim not in (1, 2) or points.shape[-1] != 2 or not points.size:
        raise ValueError(f"point: expected shape (2,) or (m, 2), got {points.shape}")
    checks.inside("point", points, checks.FINITE)
    rest, single = np.asarray(mesh.nodes, float), points.ndim == 1
    names = ["point"] if single else [f"point[{k}]" for k in range(len(points))]
    found = [_located(mesh, rest, *each) for each in zip(points.reshape(-1, 2), names, strict=True)]
    return Marker(tuple(e for e, _ in found), tuple(p for _, p in found), len(mesh.elements), single)


def _located(mesh: Mesh, rest: np.ndarray, point: np.ndarray, name: str) -> tuple[int, tuple[float, ...]]:
    """The element that holds a point, and the weights of its corners there."""
    kind, size = element_of(mesh.elements), np.ptp(rest, axis=0).max()
    # As exactly as the nodes tell where the surface is.
    near = max(1e-9, 32 * float(np.finfo(mesh.nodes.dtype).eps)) * size
    low, high = _boxes(kind, rest[mesh.elements])
    candidates = np.flatnonzero(((low - near <= point) & (point <= high + near)).all(axis=1))
    numbers, places = _inverted(kind, mesh.elements[candidates], rest, point)
    margins = places.min(axis=1)
    best = int(np.argmax(margins)) if len(margins) else -1
    if best < 0 or (margins[best] < -ON_EDGE and _distance(mesh, rest, point) > near):
        distance, (x, y) = _distance(mesh, rest, point), point
        raise ValueError(
            f"{name}: expected a point of the body at rest, got ({x:g}, {y:g}), which lies outside at a distance of "
            f"{distance:.4g} from its surface; x spans [{rest[:, 0].min():g}, {rest[:, 0].max():g}], y spans "
            f"[{rest[:, 1].min():g}, {rest[:, 1].max():g}]"
        )
    return int(candidates[numbers[best]]), tuple(places[best].tolist())


def _boxes(kind: Element, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corners `(m, 2)` of boxes that hold elements with nodes `(m, k, 2)`.

    A curved edge lies within the triangle of its two ends and the point where its tangents there meet.
    """
    hull = [nodes[:, : kind.corners]]
    for first, last, *between in kind.edges:
        hull += [(2 * nodes[:, k] - (nodes[:, first] + nodes[:, last]) / 2)[:, None] for k in between]
    points = np.concatenate(hull, axis=1)
    return points.min(axis=1), points.max(axis=1)


def _inverted(
    kind: Element, elements: np.ndarray, rest: np.ndarray, point: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where maps of triangles take the value `point`, by Newton's method from each node and from the centre.

    Returns:
        For each start that led to a solution: the triangle `(q,)`, and the weights `(q, 3)` of its corners.
    """
    starts = np.concatenate([np.full((1, kind.corners), 1 / kind.corners), kind.places])
    which = np.repeat(np.arange(len(elements)), len(starts))
    places = np.tile(starts, (len(elements), 1))
    # Relative to the point, in units of the element.
    nodes = rest[elements] - point
    nodes = (nodes / np.ptp(nodes, axis=1).max(axis=1)[:, None, None])[which]
    for _ in range(STEPS if kind.determinant is not None else 2):
        error = np.einsum("qk,qkd->qd", kind.shape(places), nodes)
        a, b = np.moveaxis(np.einsum("qki,qkd->qid", kind.slopes(places), nodes), 1, 0)
        determinant = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        safe = np.where(np.abs(determinant) > 1e-12, determinant, 1e-12)
        first = (error[:, 0] * b[:, 1] - error[:, 1] * b[:, 0]) / safe
        second = (a[:, 0] * error[:, 1] - a[:, 1] * error[:, 0]) / safe
        # A step that leaves the triangle far behind is cut short.
        step = np.clip(np.stack([first, second], axis=1), -1, 1)
        places = places - np.stack([-step.sum(axis=1), *step.T], axis=1)
    error = np.einsum("qk,qkd->qd", kind.shape(places), nodes)
    solved = np.abs(error).max(axis=1) < 1e-11
    return which[solved], places[solved]


def _distance(mesh: Mesh, rest: np.ndarray, point: np.ndarray) -> float:
    """Distance of a point from the surface of a body at rest."""
    edges = surface(mesh)
    xi = np.linspace(0, 1, 2 if edges.shape[1] == 2 else CHORDS + 1)
    places = np.einsum("sk,ekd->esd", edge_functions(edges.shape[1], xi), rest[edges] - point)
    begin, chord = places[:, :-1], np.diff(places, axis=1)
    share = np.clip(-np.sum(begin * chord, axis=2) / np.sum(chord**2, axis=2), 0, 1)
    return float(np.linalg.norm(begin + share[:, :, None] * chord, axis=2).min())
