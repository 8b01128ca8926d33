"""States as VTU files, which ParaView and meshio read.

The points are those of the body at rest, and `displacement` is the way from there ("warp by vector" in ParaView shows
the state). At nodes there are `stress_xx`, `stress_yy` and `stress_xy`, the Cauchy stress of `nodal_stress`; on
elements there are `strain_energy` and `J`. All are in the user's units. Vectors have three components, of which the
third is zero. A rod is its centre line, with `rotation` in radians at its nodes and `strain_energy` on its elements.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import escape

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core.tree import Numbers, is_concrete
from jaxbeam.files import disk
from jaxbeam.files.groups import PREFIX
from jaxbeam.files.states import check_solution, each_state
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.physics.energy import Term, check_nodes
from jaxbeam.scene.measures import jacobians, strain_energy
from jaxbeam.scene.nodal import nodal_stress
from jaxbeam.scene.scene import Scene, placed
from jaxbeam.solve.solution import Solution

# Names in meshio of elements, by their number of nodes.
KINDS = {2: "line", 3: "triangle", 6: "triangle6"}


def write_vtu(path: disk.PathLike, scene: Scene, x: Numbers, groups: Mapping[str, Numbers] | None = None) -> None:
    """Write one state: displacement, stress, strain energy and `J`, to the last bit (see `jaxbeam.files.vtu`).

    Args:
        path: the file, which ends in `.vtu`. One that is there is replaced.
        scene: of triangles or a rod.
        x: `(n, d)` node positions, such as `solution.x`.
        groups: node numbers `(q,)` by name, such as `MeshFile.nodes`. They become data at nodes, 1 in the group and 0
            elsewhere, and `read_mesh` finds them again.

    Raises:
        ValueError: if the path has another suffix or its folder is missing, `x` has another shape or is traced, or a
            group holds a number that is no node.
        ImportError: if meshio is not installed.
    """
    file, x = disk.target(path, ".vtu"), placed(scene, x)
    if not is_concrete(x, *jax.tree.leaves(scene)):
        raise ValueError("scene, x: expected concrete values, got traced ones; write files outside jit and grad")
    _write(file, scene, x, _marks(scene.mesh, groups), {})


def write_path(
    path: disk.PathLike, scene: Scene, solution: Solution, groups: Mapping[str, Numbers] | None = None
) -> list[Path]:
    """Write every state of a ramp or sweep, as `write_vtu` does, and a PVD file that lists them in order.

    The states stand beside the PVD file: `bend.pvd` lists `bend_0000.vtu` and on. In each the scene is under the
    commands of that state, and `status` on the elements is its status; 0 is `OK`. The PVD file is written last.

    Args:
        path: the PVD file, which ends in `.pvd`.
        scene: of triangles or a rod.
        solution: from `ramp`, `sweep` or `equilibrium`.
        groups: as for `write_vtu`.

    Returns:
        The paths of the VTU files.

    Raises:
        ValueError: as `write_vtu`, or if the solution is not one of this scene.
        ImportError: if meshio is not installed.
    """
    file = disk.target(path, ".pvd")
    check_solution(scene, solution)
    marks, files = _marks(scene.mesh, groups), []
    for k, (commanded, x, status) in enumerate(each_state(scene, solution)):
        files.append(file.with_name(f"{file.stem}_{k:04}.vtu"))
        _write(files[-1], commanded, x, marks, {"status": np.full(len(scene.mesh.elements), status, np.int32)})
    rows = (f'<DataSet timestep="{k}" part="0" file="{_attribute(each.name)}"/>\n' for k, each in enumerate(files))
    head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'
    with disk.whole(file) as temporary:
        temporary.write_text(f"{head}{''.join(rows)}</Collection>\n</VTKFile>\n", encoding="ascii")
    return files


def _write(
    file: Path, scene: Scene, x: jax.Array, marks: dict[str, np.ndarray], on_elements: dict[str, np.ndarray]
) -> None:
    meshio = disk.meshio()
    at_nodes, of_elements = _fields(scene, x)
    mesh = meshio.Mesh(
        _in_space(np.asarray(scene.mesh.nodes)[:, :2]),
        [(KINDS[scene.mesh.elements.shape[1]], scene.mesh.elements)],
        point_data=at_nodes | marks,
        cell_data={name: [values] for name, values in (of_elements | on_elements).items()},
    )
    with disk.whole(file) as temporary:
        meshio.write(temporary, mesh, file_format="vtu")


def _fields(scene: Scene, x: jax.Array) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """What is written of a state: data at nodes, and data on elements."""
    moved = np.asarray(x) - np.asarray(scene.mesh.nodes)
    at_nodes = {"displacement": _in_space(moved[:, :2])}
    if scene.mesh.is_line:
        at_nodes["rotation"] = moved[:, 2] / np.asarray(scene.mesh.radian)
    bodies = [term for term in scene.terms if term.kind.body]
    energies = np.zeros(len(scene.mesh.elements), np.asarray(x).dtype)
    numbers = _element_numbers(scene.mesh, bodies)
    np.add.at(energies, numbers[numbers >= 0], np.asarray(strain_energy(scene, x))[numbers >= 0])
    on_elements = {"strain_energy": energies}
    solids = [term for term in scene.terms if _has_points(term, x)]
    if solids:
        stress = np.asarray(nodal_stress(scene, x))
        at_nodes |= {f"stress_{name}": stress[:, i, k] for name, i, k in (("xx", 0, 0), ("yy", 1, 1), ("xy", 0, 1))}
        # Elements that no solid covers have none.
        volumes = np.full_like(energies, np.nan)
        numbers = _element_numbers(scene.mesh, solids)
        volumes[numbers[numbers >= 0]] = np.asarray(jacobians(scene, x))[numbers >= 0]
        on_elements["J"] = volumes
    return {name: np.ascontiguousarray(values) for name, values in at_nodes.items()}, on_elements


def _has_points(term: Term, x: jax.Array) -> bool:
    """Whether stress and `J` are measured on a term. It is traced, not run."""
    asked = lambda x, params: term.kind.at_points(x, params, lambda H, density, material: jnp.trace(H))
    return jax.eval_shape(asked, x[term.nodes], term.params) is not None


def _element_numbers(mesh: Mesh, terms: list[Term]) -> np.ndarray:
    """The number of the element that each stencil of these terms is, in one array; -1 if it is none."""
    found = []
    for term in terms:
        if np.array_equal(term.nodes, mesh.elements):
            found.append(np.arange(len(mesh.elements)))
        else:
            number = {row.tobytes(): k for k, row in enumerate(mesh.elements)}
            found.append(np.array([number.get(row.tobytes(), -1) for row in np.ascontiguousarray(term.nodes)]))
    return np.concatenate([*found, np.zeros(0, int)])


def _marks(mesh: Mesh, groups: Mapping[str, Numbers] | None) -> dict[str, np.ndarray]:
    marks = {}
    for name, numbers in (groups or {}).items():
        values = np.zeros(len(mesh.nodes), np.int8)
        values[check_nodes(f"groups[{name!r}]", mesh, numbers, ndim=1)] = 1
        marks[_attribute(f"{PREFIX}{name}")] = values
    return marks


def _in_space(vectors: np.ndarray) -> np.ndarray:
    """Vectors `(n, 2)` as `(n, 3)`, in the plane z = 0."""
    return np.concatenate([vectors, np.zeros_like(vectors[:, :1])], axis=1)


def _attribute(text: str) -> str:
    """Text for an attribute of XML, in ASCII. meshio writes names as they are, in an encoding that depends on where."""
    return escape(text, {'"': "&quot;"}).encode("ascii", "xmlcharrefreplace").decode()
