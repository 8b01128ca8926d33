"""Bodies made of other meshes: mapped to another shape, with holes, and several side by side.

Choose nodes and elements on the plain rectangle, where conditions are simple, and then map it: `mapped` keeps their
numbers. `without` and `joined` change numbers and return the new ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, is_concrete, namespace
from jaxbeam.mesh.elements import element_of
from jaxbeam.mesh.geometry import _areas
from jaxbeam.mesh.mesh import Mesh, check_triangles

Shape = Callable[[Any, Any], tuple[Any, Any]]


@usual_rules
def mapped(mesh: Mesh, shape: Shape) -> Mesh:
    """The mesh with its nodes moved to `shape(x, y)`: a tapered, bent or bulging body made of a rectangle, say.

    Nodes and elements keep their numbers. So nodes may be chosen on the first mesh and used on the second. The nodes
    between the corners of six-node triangles are moved like all others, and edges become curved. Between nodes the
    body is the interpolation of the map.

    Args:
        mesh: of triangles.
        shape: takes the rest positions `x` and `y`, each `(n,)`, and returns the new ones in the same form. They are
            NumPy arrays if the nodes of `mesh` are concrete, else JAX arrays. A shape that uses traced numbers needs
            the functions of `jax.numpy`. It must be one-to-one and keep the orientation: the determinant of its
            derivative is positive.

    Returns:
        A `Mesh` of the same dtype, differentiable in the nodes and in all that `shape` uses.

    Raises:
        ValueError: if `shape` returns anything else, or turns triangles inside out, folds them over or makes them
            overlap. Traced results with such a fault become NaN as in `Mesh`, and every solution is then `INVALID`. If
            results are traced or edges curved, overlaps of distant parts are found by solvers only (`OVERLAPPING`).

    >>> import jaxbeam as jb
    >>> tapered = mapped(jb.rectangle(2.0, 1.0, 3, 2), lambda x, y: (x, y * (1 - 0.2 * x)))
    >>> [round(float(y), 2) for y in tapered.nodes[:, 1]]
    [-0.6, 0.6, -0.5, 0.5, -0.4, 0.4]
    """
    check_triangles(mesh)
    checks.function("shape", shape, "(x, y) -> (x, y) of the rest positions")
    dtype, count = mesh.nodes.dtype, len(mesh.nodes)
    before = namespace(mesh.nodes).asarray(mesh.nodes)
    found: Any = shape(before[:, 0].copy(), before[:, 1].copy())
    wanted = f"a pair (x, y) of arrays of shape ({count},)"
    pair = isinstance(found, tuple | list) or getattr(found, "shape", None) == (2, count)
    if not pair or len(found) != 2:
        got = f"an array of shape {found.shape}" if hasattr(found, "shape") else f"a {type(found).__name__}"
        got = f"{len(found)} values" if isinstance(found, tuple | list) else got
        raise ValueError(f"shape: expected a function that returns {wanted}, got {got}; end it with `return x, y`")
    columns = [checks.real("shape", column, wanted) for column in found]
    for name, column in zip("xy", columns, strict=True):
        if column.shape != (count,):
            raise ValueError(
                f"shape: expected {wanted}, got {name} of shape {column.shape}; give one entry for each node, a "
                f"constant with `0 * x + constant`"
            )
    xp = namespace(*columns)
    nodes = xp.stack([xp.asarray(column, dtype) for column in columns], axis=1)
    if is_concrete(nodes):
        _check_mapped(np.asarray(before, float) if is_concrete(before) else None, np.asarray(nodes, float), mesh)
    try:
        return Mesh(nodes, mesh.elements)
    except ValueError as error:
        raise ValueError(f"shape: the body that it makes is not a sound one. Of its mesh, {error}") from None


def _check_mapped(before: np.ndarray | None, nodes: np.ndarray, mesh: Mesh) -> None:
    """Refuse a shape that is not finite or turns triangles over. `before`: rest positions, if they are known."""
    where = lambda k: "" if before is None else f", at rest at ({before[k, 0]:g}, {before[k, 1]:g})"
    wild = np.flatnonzero(~np.isfinite(nodes).all(axis=1))
    if wild.size:
        k = wild[0]
        raise ValueError(
            f"shape: expected finite positions, got {nodes[k].tolist()} for node {k}{where(k)} ({wild.size} such); "
            f"keep roots, logarithms and quotients in their range"
        )
    kind, area = element_of(mesh.elements).name, _areas(nodes, mesh.elements)
    turned = np.flatnonzero(area <= 0)
    if turned.size == len(area) and (area < 0).all():
        raise ValueError(
            f"shape: it makes a mirror image, in which every {kind} is inside out; change the sign of one of the two "
            f"coordinates that it returns"
        )
    if turned.size:
        k = mesh.elements[turned[0], 0]
        raise ValueError(
            f"shape: it turns {turned.size} of {len(area)} {kind}s inside out or flat, the first is {kind} {turned[0]} "
            f"with node {k}{where(k)}; expected a map whose derivative has a positive determinant everywhere: make it "
            f"change less steeply there"
        )


@usual_rules
def without(mesh: Mesh, elements: Numbers) -> tuple[Mesh, np.ndarray]:
    """The mesh without some of its elements, such as those of a chamber or a hinge; unused nodes are dropped.

    Args:
        mesh: of triangles.
        elements: `(m,)` numbers of the elements to remove, such as those of `elements_where`.

    Returns:
        The mesh, differentiable in the nodes; and `(n,)` the number that each of its nodes had before, increasing. The
        elements that are left keep their order, so `np.delete(values, elements)` are their values.

    Raises:
        ValueError: if a number is out of range, or no element is left.

    >>> import jaxbeam as jb
    >>> square = jb.rectangle(3.0, 3.0, 4, 4)
    >>> hole = jb.elements_where(square, lambda x, y: (abs(x) < 0.5) & (abs(y) < 0.5))
    >>> ring, old = without(square, hole)
    >>> len(ring.elements), len(old), len(jb.surface_lines(ring))
    (16, 16, 2)
    """
    check_triangles(mesh)
    total = len(mesh.elements)
    if not is_concrete(elements):
        raise ValueError("elements: expected concrete element numbers, got a traced array; choose them outside jit")
    gone = checks.plain("elements", elements, "whole numbers of shape (m,)")
    if gone.dtype.kind not in "iu" or gone.ndim != 1 or not gone.size:
        raise ValueError(
            f"elements: expected whole numbers of shape (m,), got shape {gone.shape} of dtype {gone.dtype}; find them "
            f"with elements_where(mesh, ...)"
        )
    outside = gone[(gone < 0) | (gone >= total)]
    if outside.size:
        raise ValueError(f"elements: {outside[0]} is out of range, elements are numbered 0 to {total - 1}")
    left = np.delete(mesh.elements, gone, axis=0)
    if not len(left):
        raise ValueError(f"elements: all {total} elements are removed, and no body is left; leave some out")
    old, numbers = np.unique(left, return_inverse=True)
    nodes = namespace(mesh.nodes).asarray(mesh.nodes)[old]
    return Mesh(nodes, numbers.reshape(left.shape)), old


@usual_rules
def joined(meshes: Sequence[Mesh]) -> tuple[Mesh, tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """One mesh of several bodies side by side, such as the fingers of a gripper. They share no nodes.

    Bodies move freely against each other: what joins them are terms, such as a tendon from one to the other.

    Args:
        meshes: of triangles with the same number of nodes, and of the same dtype. Move them apart with `mapped`.

    Returns:
        The mesh, differentiable in the nodes of each; for each body the numbers `(n,)` of its nodes, so that node `k`
        of body `b` is `nodes[b][k]`; and for each body the numbers `(t,)` of its elements.

    Raises:
        ValueError: if there is none, kinds of elements or dtypes differ, or bodies touch or overlap (between bodies
            with curved edges an overlap is not found, see `Mesh`).
    """
    if not isinstance(meshes, list | tuple) or not meshes:
        raise ValueError(f"meshes: expected a list of meshes, got a {type(meshes).__name__}; give joined([one, other])")
    for k, mesh in enumerate(meshes):
        checks.instance(f"meshes[{k}]", mesh, Mesh, "make one with rectangle(length, height, nx, ny)")
        check_triangles(mesh)
        per, first = mesh.elements.shape[1], meshes[0].elements.shape[1]
        if per != first:
            raise ValueError(
                f"meshes[{k}]: expected elements of {first} nodes like those of meshes[0], got {per}; use "
                f"quadratic(mesh) of the one with three"
            )
        if mesh.nodes.dtype != meshes[0].nodes.dtype:
            raise ValueError(
                f"meshes[{k}]: expected nodes of {meshes[0].nodes.dtype} like those of meshes[0], got "
                f"{mesh.nodes.dtype}; make both with the same dtype"
            )
    counts, totals = ([len(getattr(mesh, name)) for mesh in meshes] for name in ("nodes", "elements"))
    starts = np.cumsum([0, *counts])
    xp = namespace(*(mesh.nodes for mesh in meshes))
    nodes = xp.concatenate([xp.asarray(mesh.nodes) for mesh in meshes])
    elements = np.concatenate([mesh.elements + start for mesh, start in zip(meshes, starts, strict=False)])
    try:
        whole = Mesh(nodes, elements)
    except ValueError as error:
        raise ValueError(
            f"meshes: the bodies touch or overlap, where each must be apart from the others; move one with "
            f"mapped(mesh, lambda x, y: (x, y + distance)). Of the whole mesh, {error}"
        ) from None
    return whole, _runs(counts), _runs(totals)


def _runs(counts: list[int]) -> tuple[np.ndarray, ...]:
    """Whole numbers from 0, in runs of these lengths."""
    return tuple(np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1]))
