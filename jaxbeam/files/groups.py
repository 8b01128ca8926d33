"""Named groups of a mesh file: its nodes on points and lines, and its triangles.

Gmsh calls them physical groups. Names may be used for several dimensions at once, and one line may be in several
groups. In format 4 meshio reports all groups of a line (`cell_sets`), but a name that is used in two dimensions only
once; in format 2 it reports numbers alone. So the names are read here, from the file itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxbeam.mesh.elements import element_of

# Names of data at nodes that stand for a group, as `write_vtu` writes them.
PREFIX = "group:"

_DIMENSIONS = ("point", "line", "surface", "volume")


def parts(found: Any, names: dict[tuple[int, int], str]) -> Iterator[tuple[str, int, np.ndarray]]:
    """The groups of what meshio read, in parts.

    Yields:
        The name of a group, the index of a block of cells, and the indices of the cells of that block in the group.
    """
    for name, chosen in found.cell_sets.items():
        # A set of Abaqus may have no name.
        if not str(name).startswith("gmsh:"):
            for block, cells in enumerate(chosen):
                if cells is not None and len(cells):
                    yield str(name), block, np.asarray(cells, dtype=np.int64)
    for block, tags in enumerate(found.cell_data.get("gmsh:physical", [])):
        dimension = found.cells[block].dim
        for tag in np.unique(tags).tolist():
            if tag:
                name = names.get((dimension, tag), f"{_DIMENSIONS[dimension]} {tag}")
                yield name, block, np.flatnonzero(np.asarray(tags) == tag)


def node_parts(found: Any) -> Iterator[tuple[str, np.ndarray]]:
    """Groups of nodes that the file holds as such: their names and node numbers."""
    for name, nodes in found.point_sets.items():
        yield str(name), np.asarray(nodes, dtype=np.int64).ravel()
    for name, values in found.point_data.items():
        if name.startswith(PREFIX) and np.ndim(values) == 1:
            yield name.removeprefix(PREFIX), np.flatnonzero(values)


def gathered(members: list[tuple[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """One sorted array of numbers for each name. Numbers of -1, of what was dropped, are left out."""
    joined: dict[str, list[np.ndarray]] = {}
    for name, numbers in members:
        joined.setdefault(name, []).append(numbers[numbers >= 0])
    return {name: np.unique(np.concatenate(numbers)) for name, numbers in joined.items()}


def nodes_on(lines: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """The nodes of points, or of lines of two or three nodes.

    A line of two nodes may be an edge of a triangle of six. Then the node between them is on it too.
    """
    own = lines.ravel()
    if lines.shape[1] != 2 or not element_of(elements).determinant:
        return own
    edges = elements[:, np.array(element_of(elements).edges)].reshape(-1, 3)
    total = 1 + max(int(elements.max()), int(lines.max()))
    code = lambda pairs: pairs.min(axis=1) * total + pairs.max(axis=1)
    between = edges[np.isin(code(edges[:, :2].astype(np.int64)), code(lines.astype(np.int64))), 2]
    return np.concatenate([own, between])
