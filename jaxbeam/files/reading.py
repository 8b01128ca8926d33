"""Meshes from files: triangles of three or six nodes, with their named groups, in any format that meshio reads.

Triangles of six nodes have the order of jaxbeam in Gmsh, VTK and meshio too: three corners, then the nodes between
corners 0 and 1, 1 and 2, 2 and 0.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.tree import to_device
from jaxbeam.files import disk, gmsh, groups
from jaxbeam.mesh.mesh import Mesh

# Nodes of each kind of triangle, by meshio's name for it.
TRIANGLES = {"triangle": 3, "triangle6": 6}
# The order of the nodes of a triangle that is turned over, by their number.
_TURNED = {3: [0, 2, 1], 6: [0, 2, 1, 5, 4, 3]}
# Heights that differ by at most this fraction of the extent of the body are one plane.
FLAT = 1e-9


@dataclass(frozen=True, eq=False)
class MeshFile:
    """What a mesh file holds.

    mesh: the triangles.
    nodes: the nodes of each named group, increasing: those on points and lines, also the nodes between corners. In
        Gmsh these are physical groups of points and curves. A group without a name is called `line 7` by its number.
    elements: the triangles of each named group, increasing: physical surfaces. One without a name is `surface 5`.
    cleaned: what was cleaned, a sentence for each kind of fault.
    """

    mesh: Mesh
    nodes: dict[str, np.ndarray]
    elements: dict[str, np.ndarray]
    cleaned: tuple[str, ...]

    def __repr__(self) -> str:
        counted = lambda groups: ", ".join(f"{name} ({len(numbers)})" for name, numbers in groups.items()) or "none"
        parts = [self.mesh.summary(), f"nodes: {counted(self.nodes)}", f"elements: {counted(self.elements)}"]
        return f"MeshFile({'; '.join(parts + list(self.cleaned))})"


def read_mesh(path: disk.PathLike, clean: bool = False, dtype: Any = None) -> MeshFile:
    """Read a plane mesh of triangles, and its named groups of nodes and triangles.

    Args:
        path: the file: Gmsh (`.msh`, formats 2 and 4), VTK, VTU, or another format that meshio reads. The body lies in
            the plane of x and y, at any constant z.
        clean: mend what is wrong in a way that leaves no choice: nodes that no triangle uses are dropped, triangles
            that are listed twice are kept once, and clockwise ones are turned over. The result tells each in words.
        dtype: dtype of the nodes; by default JAX's float.

    Returns:
        The mesh, its groups, and what was cleaned.

    Raises:
        ValueError: if there is no such file, or it is damaged, empty, three-dimensional, holds other elements than
            triangles, no triangles, or triangles of three and of six nodes; if nodes or triangles would have to be
            cleaned and `clean` is false; if two nodes lie at one place, which are never merged here, because they may
            be the two sides of a crack; or if the mesh is no body for another reason (see `Mesh`).
        ImportError: if meshio, or another package that it needs for this format, is not installed.
    """
    checks.flag("clean", clean)
    dtype = checks.float_dtype("dtype", dtype)
    file = disk.source(path)
    found = _parsed(file)
    blocks = _triangle_blocks(file, found)
    listed = np.concatenate([np.asarray(found.cells[block].data, dtype=np.int64) for block in blocks])
    points = np.asarray(found.points, dtype=np.float64)
    _check_within(file, "a triangle", listed, len(points), "node")
    _check_plane(file, points[np.unique(listed)])
    elements, element_number, node_number, faults = _cleaned(points[:, :2], listed)
    if faults and not clean:
        raise ValueError(
            f"path: {file.name} is no clean mesh, it has {' and '.join(faults)}; pass clean=True to have "
            f"{', '.join(faults.values())}"
        )
    nodes = points[node_number >= 0, :2]
    _check_apart(file, nodes)
    try:
        mesh = Mesh(to_device(nodes, dtype), elements)
    except ValueError as error:
        raise ValueError(f"path: {file.name} holds no mesh of a body: {error}") from error
    node_groups, element_groups = _groups(file, found, blocks, listed, node_number, element_number)
    cleaned = [f"{cure}: {fault}" for fault, cure in faults.items()]
    # Such as the centre of an arc, of which Gmsh saves the node if it is in a group.
    empty = [name for name, numbers in node_groups.items() if not numbers.size]
    cleaned += [f"groups left out: {name} has no node in a triangle" for name in empty]
    node_groups = {name: numbers for name, numbers in node_groups.items() if numbers.size}
    return MeshFile(mesh, node_groups, element_groups, tuple(cleaned))


# ------------------------------------------------------------------------------------------------- parsing


def _parsed(file: Path) -> Any:
    """What meshio makes of a file. It prints, warns and exits on faults: all of these become a `ValueError`."""
    meshio, said, trouble = disk.meshio(), io.StringIO(), ""
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # NumPy's word for text that breaks off, or is no number.
            warnings.filterwarnings("error", message=".*unmatched data")
            if gmsh.is_gmsh(file):
                gmsh.check_counts(file)
            found = meshio.read(file, "gmsh" if gmsh.is_gmsh(file) else None)
    except ImportError as error:
        # Formats on HDF5 need h5py, which meshio does not bring along.
        raise ImportError(f"reading {file.name} takes one more package: {error}; install it") from error
    except (Exception, SystemExit) as error:
        text = said.getvalue() if isinstance(error, SystemExit) else f"{type(error).__name__}: {error}"
        trouble = " ".join(text.split())[:200] or type(error).__name__
        if "gmsh:physical" in trouble:
            raise ValueError(
                f"path: {file.name} has physical groups for some of its parts only, which meshio cannot read; put the "
                f"body into a physical group too and save without Mesh.SaveAll, or save in format 2.2"
            ) from error
    if "not closed by" in said.getvalue():
        trouble = "a section has no end"
    if trouble:
        raise ValueError(
            f"path: {file.name} cannot be read as a mesh ({trouble}); it is damaged, or of another format than its "
            f"name says, so write it again"
        )
    return found


def _triangle_blocks(file: Path, found: Any) -> list[int]:
    """Indices of the blocks of triangles. Other elements of an area or a volume are refused."""
    counts = Counter(dict.fromkeys(TRIANGLES, 0))
    for block in found.cells:
        counts[block.type] += len(block.data)
    held = ", ".join(f"{count} of type {name}" for name, count in counts.items() if count) or "no elements"
    present = {block.type: block.dim for block in found.cells if len(block.data)}
    if any(dimension == 3 for dimension in present.values()):
        raise ValueError(f"path: {file.name} is three-dimensional, it holds {held}; give a plane mesh of triangles")
    others = [name for name, dimension in present.items() if dimension == 2 and name not in TRIANGLES]
    if others:
        kind = "quadrilaterals" if others[0].startswith("quad") else "elements that are not triangles of 3 or 6 nodes"
        cure = "mesh the body with triangles, in Gmsh without Recombine and with Mesh.ElementOrder 1 or 2"
        raise ValueError(f"path: {file.name} holds {kind} ({held}); {cure}")
    if not counts["triangle"] + counts["triangle6"]:
        raise ValueError(
            f"path: {file.name} holds no triangles, only {held}; mesh the surface of the body, and save it too "
            f"(in Gmsh it must be in a physical group if anything is)"
        )
    if counts["triangle"] and counts["triangle6"]:
        raise ValueError(
            f"path: {file.name} mixes {counts['triangle']} triangles of 3 nodes with {counts['triangle6']} of 6; give "
            f"all of them the same order"
        )
    return [number for number, block in enumerate(found.cells) if block.type in TRIANGLES and len(block.data)]


# -------------------------------------------------------------------------------------------------- checks


def _check_within(file: Path, what: str, numbers: np.ndarray, total: int, of: str) -> None:
    """Refuse numbers of nodes or cells that are not in the file, of which NumPy would count negative ones backwards."""
    outside = numbers[(numbers < 0) | (numbers >= total)]
    if outside.size:
        raise ValueError(
            f"path: {file.name} is damaged: {what} names the {of} {outside[0]}, expected 0 to {total - 1}; write it "
            f"again"
        )


def _check_plane(file: Path, used: np.ndarray) -> None:
    if used.shape[1] < 3:
        return
    low, high = used[:, 2].min(), used[:, 2].max()
    # What is not finite is refused by `Mesh`.
    if high - low > FLAT * np.ptp(used[:, :2], axis=0).max():
        raise ValueError(
            f"path: {file.name} is three-dimensional: z of its triangles is from {low:g} to {high:g}, expected the "
            f"same z everywhere; turn the body into the plane of x and y"
        )


def _check_apart(file: Path, nodes: np.ndarray) -> None:
    """Refuse nodes that lie at one place, as `Mesh` would, and say what to do about them in a file."""
    grid = np.round(nodes / (FLAT * max(float(np.ptp(nodes, axis=0).max()), np.finfo(float).tiny)))
    _, first, inverse = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    original = first[inverse.ravel()]
    copies = np.flatnonzero(original != np.arange(len(nodes)))
    if copies.size:
        k = copies[0]
        x, y = nodes[k]
        many = _count(copies.size, "node", "nodes")
        raise ValueError(
            f"path: {file.name} has {many} at the place of another, the first at ({x:g}, {y:g}), where the body is "
            f"torn; if it is to be whole there, merge them where the mesh is made (in Gmsh fragment the surfaces, or "
            f"use removeDuplicateNodes), and if it is a crack, move its sides apart"
        )


def _cleaned(points: np.ndarray, listed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, str]]:
    """Triangles without faults that have one cure.

    Args:
        points: `(n, 2)` all nodes of the file.
        listed: `(t, k)` its triangles.

    Returns:
        The triangles, in new node numbers; for each listed triangle its number among them; for each node of the file
        its new number, or -1; and the faults, in words, with what is done about each.
    """
    faults = {}
    _, first, inverse = np.unique(np.sort(listed, axis=1), axis=0, return_index=True, return_inverse=True)
    # Those that are kept stay in the order of the file.
    kept = np.sort(first)
    element_number = np.searchsorted(kept, first[inverse.ravel()])
    elements = listed[kept]
    if len(kept) < len(listed):
        copy = np.setdiff1d(np.arange(len(listed)), kept)[0]
        many = _count(len(listed) - len(kept), "copy", "copies")
        faults[f"{many} of triangles, the first is number {copy}"] = "copies dropped"
    used = np.zeros(len(points), bool)
    used[elements] = True
    node_number = np.where(used, np.cumsum(used) - 1, -1)
    if not used.all():
        node = np.flatnonzero(~used)[0]
        x, y = points[node]
        many = _count(int((~used).sum()), "node", "nodes")
        faults[f"{many} in no triangle, the first is number {node} at ({x:g}, {y:g})"] = "unused nodes dropped"
    a, b, c = (points[elements[:, k]] for k in range(3))
    clockwise = np.flatnonzero((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0] < 0)
    if clockwise.size:
        elements[clockwise] = elements[clockwise][:, _TURNED[elements.shape[1]]]
        many = _count(clockwise.size, "clockwise triangle", "clockwise triangles")
        faults[f"{many}, the first is number {kept[clockwise[0]]}"] = "triangles turned over"
    return node_number[elements], element_number, node_number, faults


def _count(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"


# -------------------------------------------------------------------------------------------------- groups


def _groups(
    file: Path,
    found: Any,
    blocks: list[int],
    listed: np.ndarray,
    node_number: np.ndarray,
    element_number: np.ndarray,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Named groups of nodes and of triangles, in the numbers of the mesh.

    Args:
        file: the file.
        found: what meshio read in it.
        blocks: the indices of its blocks of triangles.
        listed: `(t, k)` the triangles of these blocks, in node numbers of the file.
        node_number: new number of each node, or -1.
        element_number: new number of each listed triangle.
    """
    sizes = [len(found.cells[block].data) for block in blocks]
    start = dict(zip(blocks, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))
    nodes, elements = [], []
    for name, those in groups.node_parts(found):
        _check_within(file, f"the group {name}", those, len(node_number), "node")
        nodes.append((name, node_number[those]))
    for name, block, cells in groups.parts(found, gmsh.physical_names(file)):
        _check_within(file, f"the group {name}", cells, len(found.cells[block].data), "element")
        if block in start:
            elements.append((name, element_number[start[block] + cells]))
        elif found.cells[block].dim < 2:
            lines = np.asarray(found.cells[block].data, dtype=np.int64)[cells]
            _check_within(file, f"the group {name}", lines, len(node_number), "node")
            nodes.append((name, node_number[groups.nodes_on(lines, listed)]))
    return groups.gathered(nodes), groups.gathered(elements)
