"""The lines that a picture of a beam is made of: edges, curved as the shape functions have them, tendons and patches.

An edge is given by the numbers of its nodes: its first and second end, then the node between them if there is one.
Positions are `(n, 2)`, or `(n, 3)` for a rod, whose nodes also turn; of those the first two columns are drawn.
"""

from __future__ import annotations

import itertools

import numpy as np

from jaxbeam.core.tree import Numbers, is_concrete
from jaxbeam.mesh.element import edge_functions
from jaxbeam.mesh.elements import ELEMENTS, element_of
from jaxbeam.mesh.surface import surface, walk
from jaxbeam.physics.energy import Term
from jaxbeam.scene.scene import Scene, commanded_terms

# Points of a curved edge; an odd number, so that the node in the middle is one of them.
POINTS = 9


def elements_of(scene: Scene) -> np.ndarray:
    """`(t, k)` nodes of each element, in the order in which the measures number them."""
    solids = [np.asarray(term.nodes) for term in scene.terms if term.kind.fills]
    return np.concatenate(solids) if solids else np.asarray(scene.mesh.elements)


def outline(scene: Scene) -> np.ndarray:
    """The edges `(e, 2)` or `(e, 3)` of the surface, the body on their left; of a rod, those of its centre line."""
    return surface(scene.mesh) if not scene.mesh.is_line else np.asarray(scene.mesh.elements)


def edge_curves(x: np.ndarray, edges: np.ndarray, shares: Numbers = 1.0) -> np.ndarray:
    """Points `(e, p, 2)` along edges; of each, only along the first part of it if its share `(e,)` is less than 1."""
    xi = np.expand_dims(shares, -1) * np.linspace(0, 1, POINTS if edges.shape[1] == 3 else 2)
    return edge_functions(edges.shape[1], xi) @ x[edges, :2]


def rings(x: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Points `(t, p, 2)` around each element, in its order; of an element of two nodes, its ends."""
    if elements.shape[1] not in ELEMENTS:
        return x[elements, :2]
    edges = element_of(elements).edges
    xi = np.linspace(0, 1, POINTS if len(edges[0]) == 3 else 2)[:-1]
    # (t, e, p, 2): along each edge up to where the next begins.
    around = np.einsum("pk,tekd->tepd", edge_functions(len(edges[0]), xi), x[elements[:, edges], :2])
    return around.reshape(len(elements), -1, 2)


def drawn_terms(scene: Scene) -> list[tuple[Term, np.ndarray]]:
    """The terms that are drawn as lines, and for each the number, over all of them, of each of its lines."""
    rest = scene.mesh.nodes
    x = np.asarray(rest) if is_concrete(rest) else rest
    drawn = [term for term in scene.terms if term.kind.line(x[term.nodes], term.params) is not None]
    ends = np.cumsum([0, *(len(term.nodes) for term in drawn)])
    return [(term, np.arange(*pair)) for term, pair in zip(drawn, itertools.pairwise(ends), strict=True)]


def line_names(scene: Scene) -> list[str]:
    """What to call each of the lines, such as `tendon 1`."""
    return [f"{term.kind.name} {number + 1}" for term, lines in drawn_terms(scene) for number in lines]


def command_names(scene: Scene) -> list[str]:
    """What to call each of the commands: as the line that it changes, or as its term."""
    lines = {id(term): numbers for term, numbers in drawn_terms(scene)}
    found = []
    for term in commanded_terms(scene):
        name, numbers = term.kind.name, lines.get(id(term), np.arange(term.command_count))
        found += [name] if term.command_count == 1 != len(numbers) else [f"{name} {k + 1}" for k in numbers]
    return [name.removesuffix(" 1") if f"{name[:-1]}2" not in found else name for name in found]


def term_lines(scene: Scene, x: np.ndarray) -> list[np.ndarray]:
    """The points `(p, 2)` of each line that a term is drawn as, such as those that a tendon runs through."""
    each = [term.kind.line(x[term.nodes], term.params) for term in scene.terms]
    return [line for lines in each if lines is not None for line in np.asarray(lines)]


def arms(scene: Scene, x: np.ndarray) -> np.ndarray:
    """Segments `(q, 2, 2)` from the body to points of lines that are not nodes, as beside a rod."""
    found = [term.kind.arms(x[term.nodes], term.params) for term in scene.terms]
    return np.concatenate([np.zeros((0, 2, 2)), *(np.reshape(each, (-1, 2, 2)) for each in found if each is not None)])


def extremes(scene: Scene, states: np.ndarray) -> list[np.ndarray]:
    """Points `(..., 2)` that span all that is drawn of a beam at rest and in states `(s, n, 2)`."""
    found, edges = [], outline(scene)
    for x in (np.asarray(scene.mesh.nodes), *states):
        # Curved edges bulge past their nodes, and the tendons of a rod run beside it.
        found += [x[:, :2], edge_curves(x, edges), *term_lines(scene, x)]
    return found


def patches(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surface that anchors of finite width pull on, as first parts of edges.

    Returns:
        The edges `(q, k)`, which may run either way round the body; the share `(q,)` of each; and the number `(q,)` of
        the tendon that pulls on it.
    """
    edges, rest = outline(scene), np.asarray(scene.mesh.nodes)
    found: list[tuple[list[int], float, int]] = []
    for term, lines in drawn_terms(scene):
        anchors = term.kind.anchors(term.params)
        if anchors is None:
            continue
        each = [np.ravel(entries) for entries in anchors]
        numbers = np.repeat(lines, anchors[0].shape[1])
        for node, width, number in zip(*each, numbers, strict=True):
            found += [(line, share, number) for line, _, _, share in walk(rest, edges, int(node), float(width))]
    columns = zip(*found, strict=True) if found else ([], [], [])
    reached, shares, numbers = (np.array(column) for column in columns)
    return reached.astype(int).reshape(-1, edges.shape[1]), shares, numbers.astype(int)


def segments(x: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The straight segments `(e, 2, 2)` that edges are drawn as."""
    curves = edge_curves(x, edges)
    return np.stack([curves[:, :-1], curves[:, 1:]], axis=2).reshape(-1, 2, 2)


def inside(points: np.ndarray, pieces: np.ndarray) -> np.ndarray:
    """Whether points `(..., 2)` lie inside the closed lines that segments `(e, 2, 2)` make, by crossings of a ray."""
    (ax, ay), (bx, by) = pieces.transpose(1, 2, 0)
    px, py = points[..., :1], points[..., 1:]
    crossed = (ay > py) != (by > py)
    rise = np.where(by == ay, 1, by - ay)
    return np.count_nonzero(crossed & (px < ax + (py - ay) * (bx - ax) / rise), axis=-1) % 2 == 1


def clearance(at: np.ndarray, outward: np.ndarray, pieces: np.ndarray) -> np.ndarray:
    """How far `(r,)` the body is away from points `at` of its surface, seen along the normals; infinite if it is not.

    Solves `at + t outward = start + s run` for each of the segments `pieces` `(e, 2, 2)`.
    """
    cross = lambda a, b: a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    run, gap = pieces[:, 1] - pieces[:, 0], pieces[:, 0] - at[:, None]
    turn = cross(outward[:, None], run)
    faces = turn < 0  # it shows its outer side, as those of the same surface do not
    safe = np.where(faces, turn, 1)
    t, s = cross(gap, run) / safe, cross(gap, outward[:, None]) / safe
    small = 1e-6 * np.ptp(pieces[:, 0], axis=0).max()
    return np.where(faces & (t > small) & (s >= 0) & (s <= 1), t, np.inf).min(axis=1)
