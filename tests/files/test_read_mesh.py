"""Meshes from files: the same nodes and triangles in every format, named groups, cleaning, and errors in one sentence.

`half_disk_2.msh` and `half_disk_4.msh` were written by Gmsh 4.15 in formats 2.2 and 4.1: a half disk of 7 triangles of
six nodes at z = 0.5, with the centre of its arc as a node of its own. "flat" names its straight side, and a point too.
"""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam import files

meshio = pytest.importorskip("meshio", reason="meshio is not installed: pip install 'jaxbeam[files]'")

HERE = Path(__file__).parent
FORMATS = [("msh", "gmsh", {}), ("msh", "gmsh22", {}), ("msh", "gmsh22", {"binary": False}), ("vtk", "vtk", {})]
FORMATS += [("vtu", "vtu", {}), ("inp", "abaqus", {})]


def fan(sectors, seed=0):
    """A disk of radius 1 in six-node triangles with curved outer edges: nodes, triangles.

    Each triangle begins at any of its corners, and half of them are clockwise.
    """
    turn = np.arange(sectors) * 2 * np.pi / sectors
    on_circle = lambda angle, radius: radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    half = np.pi / sectors
    # The nodes between corners stand off the middles of their edges, so that a wrong order is another body.
    nodes = [np.zeros((1, 2)), on_circle(turn, 1), on_circle(turn + 0.2 * half, 0.5), on_circle(turn + half, 1)]
    k, following = np.arange(sectors), (np.arange(sectors) + 1) % sectors
    columns = [0 * k, 1 + k, 1 + following, 1 + sectors + k, 1 + 2 * sectors + k, 1 + sectors + following]
    triangles, rng = np.stack(columns, axis=1), np.random.default_rng(seed)
    for row in triangles:
        shift = rng.integers(3)
        row[:] = np.concatenate([np.roll(row[:3], shift), np.roll(row[3:], shift)])
        if rng.integers(2):
            row[:] = row[[0, 2, 1, 5, 4, 3]]
    return np.concatenate(nodes), triangles


def in_space(nodes, z=0.0):
    return np.concatenate([nodes, np.full((len(nodes), 1), z)], axis=1)


def written(path, points, cells, file_format=None, **kwargs):
    meshio.write(path, meshio.Mesh(points, cells, **kwargs.pop("mesh", {})), file_format=file_format, **kwargs)
    return path


def area(mesh):
    """By the rule that is exact for the determinant of a quadratic map."""
    return float(np.sum(jb.solid(mesh, jb.lame(1.0, 0.3), degree=2).params.weights))


@pytest.fixture
def square(tmp_path):
    """Four triangles of three nodes, by meshio's names: points and cells."""
    mesh = jb.rectangle(2.0, 2.0, 3, 2)
    return in_space(np.asarray(mesh.nodes)), np.array(mesh.elements)


# ------------------------------------------------------------------------------------------------ contents


@pytest.mark.parametrize(("suffix", "kind", "options"), FORMATS)
def test_every_format_gives_the_same_body(tmp_path, suffix, kind, options):
    nodes, triangles = fan(8)
    path = written(tmp_path / f"disk.{suffix}", in_space(nodes, 3.0), [("triangle6", triangles)], kind, **options)
    with pytest.raises(ValueError, match=r"clockwise triangles, the first is number \d+; pass clean=True"):
        files.read_mesh(path)
    found = files.read_mesh(path, clean=True)
    np.testing.assert_array_equal(found.mesh.nodes, nodes)
    assert [line.split(":")[0] for line in found.cleaned] == ["triangles turned over"]
    # The same corners, and between each two of them the same node.
    for ours, theirs in zip(found.mesh.elements.tolist(), triangles.tolist(), strict=True):
        between = lambda row: {frozenset((row[a], row[b])): row[c] for a, b, c in ((0, 1, 3), (1, 2, 4), (2, 0, 5))}
        assert between(ours) == between(theirs)


def test_area_of_a_disk_converges_at_fourth_order(tmp_path):
    errors = []
    for sectors in (8, 16, 32):
        nodes, triangles = fan(sectors)
        path = written(tmp_path / "disk.msh", in_space(nodes), [("triangle6", triangles)], "gmsh")
        errors.append(np.pi - area(files.read_mesh(path, clean=True).mesh))
    # An arc interpolated by parabolas: the error falls by 16, and by a little more or less on coarse ones.
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 4, atol=0.1)
    assert 0 < errors[-1] < 1e-4


@pytest.mark.parametrize("version", [2, 4])
def test_groups_of_gmsh(version):
    found = files.read_mesh(HERE / f"half_disk_{version}.msh", clean=True)
    x, y = np.asarray(found.mesh.nodes).T
    top = int(np.flatnonzero((np.abs(x) < 1e-9) & (y > 0.9))[0])
    assert set(found.nodes) == {"arc", "flat", "first quarter", "point 77"}
    on_arc = np.abs(np.hypot(x, y) - 1) < 1e-9
    np.testing.assert_array_equal(found.nodes["arc"], np.flatnonzero(on_arc))
    np.testing.assert_array_equal(found.nodes["first quarter"], np.flatnonzero(on_arc & (x > -1e-9)))
    # Named twice: the straight side, and the point on top.
    np.testing.assert_array_equal(found.nodes["flat"], np.sort([*np.flatnonzero(np.abs(y) < 1e-9), top]))
    assert np.asarray(found.mesh.nodes)[found.nodes["point 77"]].round(9).tolist() == [[-1, 0]]
    np.testing.assert_array_equal(found.elements["body"], np.arange(7))
    # Parabolas through the ends and the middle of four arcs of 45 degrees enclose this much with their chords.
    half = np.pi / 8
    np.testing.assert_allclose(area(found.mesh), 2 * np.sin(2 * half) + 16 / 3 * np.sin(half) * (1 - np.cos(half)))
    assert found.cleaned == (
        "unused nodes dropped: 1 node in no triangle, the first is number 0 at (0, 0)",
        "groups left out: centre has no node in a triangle",
    )
    assert "flat (8)" in repr(found)


def test_a_body_from_a_file_is_solved():
    found = files.read_mesh(HERE / "half_disk_4.msh", clean=True)
    mesh = found.mesh
    terms = (jb.solid(mesh, jb.lame(1e4, 0.3)), jb.traction(mesh, found.nodes["first quarter"], [10.0, 0.0]))
    scene = jb.Scene(mesh, terms, jb.clamped(mesh, np.flatnonzero(np.abs(mesh.nodes[:, 1]) < 1e-9)))
    assert jb.check(jb.equilibrium(scene)).energy < 0


def test_lines_of_two_nodes_find_the_node_between(tmp_path):
    mesh = jb.rectangle(2.0, 1.0, 2, 2, order=2)
    lines = np.array([[0, 1]])
    (edge,) = [row for row in _edges(mesh) if set(row[:2]) == {0, 1}]
    sets = {"cell_sets": {"side": [np.zeros(0, int), np.zeros(1, int)]}}
    path = written(
        tmp_path / "a.inp", in_space(np.asarray(mesh.nodes)), [("triangle6", mesh.elements), ("line", lines)], mesh=sets
    )
    np.testing.assert_array_equal(files.read_mesh(path).nodes["side"], np.sort(edge))


def _edges(mesh):
    return [[row[a], row[b], row[c]] for row in mesh.elements.tolist() for a, b, c in ((0, 1, 3), (1, 2, 4), (2, 0, 5))]


def test_dtype(tmp_path, square):
    path = written(tmp_path / "a.vtk", square[0], [("triangle", square[1])])
    assert files.read_mesh(path).mesh.nodes.dtype == np.float64
    assert files.read_mesh(path, dtype=jnp.float32).mesh.nodes.dtype == np.float32
    assert isinstance(files.read_mesh(path).mesh.nodes, jax.Array)


# ------------------------------------------------------------------------------------------------ cleaning


def test_cleaning_is_told_and_groups_follow(tmp_path, square):
    points, triangles = square
    points = np.concatenate([[[9.0, 9, 0]], points, [[8.0, 8, 0]]])
    listed = np.concatenate([triangles, triangles[2:3]]) + 1
    listed[0] = listed[0, [0, 2, 1]]
    sets = {"point_sets": {"ends": [0, 1, 6]}, "cell_sets": {"twice": [np.array([0, 4])]}}
    path = written(tmp_path / "a.inp", points, [("triangle", listed)], mesh=sets)
    with pytest.raises(ValueError, match=r"1 copy of triangles, .* and 2 nodes in no triangle, .* and 1 clockwise"):
        files.read_mesh(path)
    found = files.read_mesh(path, clean=True)
    np.testing.assert_array_equal(found.mesh.nodes, square[0][:, :2])
    np.testing.assert_array_equal(found.mesh.elements, triangles)
    assert found.cleaned == (
        "copies dropped: 1 copy of triangles, the first is number 4",
        "unused nodes dropped: 2 nodes in no triangle, the first is number 0 at (9, 9)",
        "triangles turned over: 1 clockwise triangle, the first is number 0",
    )
    assert found.nodes["ends"].tolist() == [0, 5]
    assert found.elements["twice"].tolist() == [0, 2]


def test_a_clean_file_needs_no_cleaning(tmp_path, square):
    path = written(tmp_path / "a.vtu", square[0], [("triangle", square[1])])
    assert files.read_mesh(path, clean=True).cleaned == ()


@pytest.mark.parametrize("clean", [False, True])
def test_nodes_at_one_place_are_refused(tmp_path, square, clean):
    points, triangles = square
    torn = triangles.copy()
    torn[-1, torn[-1] == triangles[-2:].ravel()[0]] = len(points)
    points = np.concatenate([points, points[[triangles[-2:].ravel()[0]]]])
    path = written(tmp_path / "a.vtk", points, [("triangle", torn)])
    with pytest.raises(ValueError, match=r"a\.vtk has 1 node at the place of another.*removeDuplicateNodes"):
        files.read_mesh(path, clean=clean)


# -------------------------------------------------------------------------------------------------- errors


def test_files_that_hold_no_plane_triangles(tmp_path, square):
    points, triangles = square
    tilted = points + [[0, 0, 1e-3]] * (np.arange(len(points)) == 2)[:, None]
    quad = np.array([[0, 2, 3, 1]])
    cases = {
        "three-dimensional: z of its triangles is from 0 to 0.001": (tilted, [("triangle", triangles)]),
        "three-dimensional, it holds 1 of type tetra": (tilted, [("tetra", triangles[:1, [0, 1, 2, 2]])]),
        "quadrilaterals .1 of type quad.*Recombine": (points, [("quad", quad)]),
        "quadrilaterals .2 of type triangle, 1": (points, [("triangle", triangles[2:]), ("quad", quad)]),
        "no triangles, only 1 of type line": (points, [("line", quad[:, :2])]),
        "mixes 2 triangles of 3 nodes with 1 of 6": (points, [("triangle", triangles[:2]), ("triangle6", [range(6)])]),
    }
    for text, (nodes, cells) in cases.items():
        path = written(tmp_path / "a.vtk", nodes, cells)
        with pytest.raises(ValueError, match=rf"^path: a\.vtk .*{text}"):
            files.read_mesh(path)


def test_a_body_that_is_none(tmp_path, square):
    points, triangles = square
    points[0, 0] = np.nan
    path = written(tmp_path / "a.vtk", points, [("triangle", triangles)])
    with pytest.raises(ValueError, match=r"a\.vtk holds no mesh of a body: nodes: node 0 is not finite"):
        files.read_mesh(path)
    points[0] = 3 * points[1]
    path = written(tmp_path / "a.vtk", points, [("triangle", np.concatenate([triangles, [[0, 1, 2]]]))])
    with pytest.raises(ValueError, match=r"a\.vtk holds no mesh of a body: elements: "):
        files.read_mesh(path, clean=True)


def test_paths(tmp_path):
    empty, unknown = tmp_path / "empty.msh", tmp_path / "a.unknown"
    empty.touch()
    unknown.write_text("some text")
    for path, text in [
        (tmp_path / "missing.msh", r"there is no file .*missing\.msh"),
        (tmp_path, "expected a file, got the folder"),
        (empty, r"the file .*empty\.msh is empty"),
        (unknown, r"a\.unknown cannot be read as a mesh \(.*Could not deduce"),
        (3, "expected the name of a file, got 3"),
        ("", "expected the name of a file"),
    ]:
        with pytest.raises(ValueError, match=f"^path: {text}"):
            files.read_mesh(path)
    with pytest.raises(ValueError, match="clean: expected True or False"):
        files.read_mesh(empty, clean="yes")


@pytest.mark.parametrize("name", ["half_disk_2.msh", "half_disk_4.msh", "binary.msh", "disk.vtk", "disk.vtu"])
def test_damaged_files(tmp_path, capfd, name):
    """Of a file that is cut short, or has changed bytes, comes a `ValueError` or a mesh, and nothing is printed."""
    if name.startswith("half"):
        good = (HERE / name).read_bytes()
    else:
        nodes, triangles = fan(5)
        kind = "gmsh" if name.endswith("msh") else None
        good = written(tmp_path / name, in_space(nodes), [("triangle6", triangles)], kind).read_bytes()
    path, rng = tmp_path / name, np.random.default_rng(0)
    # The last bytes of a text are a line end, without which it is whole.
    for length in rng.integers(0, len(good) - 8, 40).tolist():
        path.write_bytes(good[:length])
        with pytest.raises(ValueError, match=r"^path: "):
            files.read_mesh(path, clean=True)
    for place in rng.integers(0, len(good), 40).tolist():
        path.write_bytes(good[:place] + bytes([good[place] ^ 0x11]) + good[place + 1 :])
        try:
            files.read_mesh(path, clean=True)
        except ValueError as error:
            assert str(error).startswith("path: ")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("version", "old", "new"),
    [
        (2, "\n5 0.707", "\n2000000000 0.707"),
        (4, "\n5\n6\n7\n0.707", "\n4000000000\n6\n7\n0.707"),
        (4, "\n8 23 1 23\n", "\n8 2300000000 1 23\n"),
        (4, "\n2 1 9 7\n", "\n2 1 9 700000000\n"),
    ],
)
def test_counts_and_tags_that_a_file_cannot_hold(tmp_path, version, old, new):
    """meshio would make arrays as long as these numbers say, of gigabytes."""
    text = (HERE / f"half_disk_{version}.msh").read_text()
    assert old in text
    (tmp_path / "a.msh").write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=r"a\.msh cannot be read as a mesh \(.*more than the file can hold"):
        files.read_mesh(tmp_path / "a.msh", clean=True)


def test_groups_of_some_parts_alone(tmp_path):
    text = (HERE / "half_disk_4.msh").read_text()
    # The surface loses its group, as Gmsh writes it with Mesh.SaveAll.
    path = tmp_path / "a.msh"
    path.write_text(text.replace("0.5 1 6 3 1 2 3", "0.5 0 3 1 2 3"))
    with pytest.raises(ValueError, match=r"has physical groups for some of its parts only.*Mesh\.SaveAll"):
        files.read_mesh(path)


def test_without_meshio(monkeypatch, tmp_path):
    (tmp_path / "a.msh").write_text("$MeshFormat")
    monkeypatch.setitem(sys.modules, "meshio", None)
    with pytest.raises(ImportError, match=r"needs meshio; install it with pip install 'jaxbeam\[files\]'"):
        files.read_mesh(tmp_path / "a.msh")


def test_without_h5py(monkeypatch, tmp_path):
    (tmp_path / "a.h5m").write_text("HDF")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match=r"reading a\.h5m takes one more package: .*h5py.*; install it"):
        files.read_mesh(tmp_path / "a.h5m")


def test_meshio_is_imported_when_it_is_needed():
    code = "import sys, jaxbeam; assert 'jaxbeam.files' not in sys.modules; import jaxbeam.files; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "meshio" not in run.stdout.split()
