"""What is written for ParaView is what was computed, to the last bit, and it is read back as the same body."""

import xml.etree.ElementTree as ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import part, solution_of

import jaxbeam as jb
from jaxbeam import files

meshio = pytest.importorskip("meshio", reason="meshio is not installed: pip install 'jaxbeam[files]'")


def bent(scene, size=0.02):
    """Positions of a bent body, made by hand: files need no equilibrium."""
    x, y = np.asarray(scene.mesh.nodes).T[:2]
    moved = np.array(scene.mesh.nodes)
    moved[:, 1] += size * (x - x.min()) ** 2
    moved[:, 0] -= 2 * size * (x - x.min()) * y
    return jnp.asarray(moved)


def same(array, expected):
    assert array.dtype == np.asarray(expected).dtype
    np.testing.assert_array_equal(array, expected)


def path_of(scene, states=3):
    ratios = np.linspace(1, 0.9, states)[:, None] * [1.0, 1.0]
    return solution_of(scene, ratios, [bent(scene, 0.01 * k) for k in range(states)], [0, 1, 64])


@pytest.fixture(params=["linear", "quadratic", "float32"])
def scene(request):
    dtype = jnp.float32 if request.param == "float32" else jnp.float64
    return jb.tendon_beam(nx=5, ny=3, order=2 if request.param == "quadratic" else 1, dtype=dtype)


def test_numbers_read_back(tmp_path, scene):
    x = bent(scene)
    files.write_vtu(tmp_path / "a.vtu", scene, x)
    found = meshio.read(tmp_path / "a.vtu")
    (block,) = found.cells
    assert block.type == {3: "triangle", 6: "triangle6"}[scene.mesh.elements.shape[1]]
    np.testing.assert_array_equal(block.data, scene.mesh.elements)
    same(found.points[:, :2], scene.mesh.nodes)
    assert set(found.point_data) == {"displacement", "stress_xx", "stress_yy", "stress_xy"}
    assert set(found.cell_data) == {"strain_energy", "J"}
    assert found.points.shape == found.point_data["displacement"].shape == (len(x), 3)
    assert not found.points[:, 2].any() and not found.point_data["displacement"][:, 2].any()
    same(found.point_data["displacement"][:, :2], np.asarray(x) - np.asarray(scene.mesh.nodes))
    stress = np.asarray(jb.nodal_stress(scene, x))
    for name, i, k in (("xx", 0, 0), ("yy", 1, 1), ("xy", 0, 1)):
        same(found.point_data[f"stress_{name}"], stress[:, i, k])
    same(found.cell_data["strain_energy"][0], jb.strain_energy(scene, x))
    same(found.cell_data["J"][0], jb.jacobians(scene, x))
    assert [path.name for path in tmp_path.iterdir()] == ["a.vtu"]


def test_the_body_and_its_groups_read_back(tmp_path, scene):
    groups = {"clamp": [0, 2, 1], 'tip <"é">': scene.tip}
    files.write_vtu(tmp_path / "a.vtu", scene, scene.mesh.nodes, groups)
    found = files.read_mesh(tmp_path / "a.vtu", dtype=scene.mesh.nodes.dtype)
    same(np.asarray(found.mesh.nodes), scene.mesh.nodes)
    same(found.mesh.elements, scene.mesh.elements)
    assert set(found.nodes) == set(groups)
    for name, nodes in groups.items():
        np.testing.assert_array_equal(found.nodes[name], np.sort(nodes))


def test_elements_that_a_solid_does_not_cover(tmp_path):
    mesh = jb.rectangle(2.0, 1.0, 3, 2)
    half = jb.solid(part(mesh, [0, 1]), jb.lame(1e3, 0.3))
    number = np.unique(mesh.elements[[0, 1]])
    # The other way round, so that stencils and elements are in different orders.
    reverse = jax.tree.map(lambda leaf: leaf[::-1], half.params)
    term = jb.Term(half.energy, number[half.nodes][::-1], reverse)
    scene = jb.Scene(mesh, (term,), jb.clamped(mesh, [0, 1, *np.setdiff1d(np.arange(6), number)]))
    x = bent(scene)
    files.write_vtu(tmp_path / "a.vtu", scene, x)
    found = meshio.read(tmp_path / "a.vtu").cell_data
    same(found["strain_energy"][0], [*np.asarray(jb.strain_energy(scene, x))[::-1], 0.0, 0.0])
    same(found["J"][0], [*np.asarray(jb.jacobians(scene, x))[::-1], np.nan, np.nan])


def test_a_rod(tmp_path):
    scene = jb.rod_beam(nodes=5)
    x = scene.mesh.nodes + jnp.array([0.0, 0.1, 0.2])
    files.write_vtu(tmp_path / "a.vtu", scene, x)
    found = meshio.read(tmp_path / "a.vtu")
    assert found.cells[0].type == "line"
    np.testing.assert_allclose(found.point_data["rotation"], 0.2 / float(scene.mesh.radian), rtol=1e-12)
    same(found.cell_data["strain_energy"][0], jb.strain_energy(scene, x))
    with pytest.raises(ValueError, match="holds no triangles, only 4 of type line"):
        files.read_mesh(tmp_path / "a.vtu")


def test_a_path(tmp_path):
    scene = jb.tendon_beam(nx=5, ny=3)
    path = path_of(scene)
    written = files.write_path(tmp_path / "be&nd.pvd", scene, path, {"tip": scene.tip})
    assert [each.name for each in written] == [f"be&nd_000{k}.vtu" for k in range(3)]
    rows = ElementTree.parse(tmp_path / "be&nd.pvd").getroot().findall("./Collection/DataSet")
    assert [row.get("file") for row in rows] == [each.name for each in written]
    assert [float(row.get("timestep")) for row in rows] == [0, 1, 2]
    for k, each in enumerate(written):
        found = meshio.read(each)
        same(found.point_data["displacement"][:, :2], np.asarray(path.x[k]) - np.asarray(scene.mesh.nodes))
        same(found.cell_data["status"][0], np.full(len(scene.mesh.elements), [0, 1, 64][k], np.int32))
        assert found.point_data["group:tip"].sum() == len(scene.tip)
    assert len(list(tmp_path.iterdir())) == 4


def test_the_commands_of_each_state_are_applied(tmp_path, monkeypatch):
    scene = jb.tendon_beam(nx=5, ny=3)
    path, seen = path_of(scene), []
    monkeypatch.setattr(files.vtu, "_write", lambda file, scene, *rest: seen.append(scene))
    files.write_path(tmp_path / "a.pvd", scene, path)
    for commanded, ratios in zip(seen, path.ratios, strict=True):
        expected = jb.command(scene, ratios)
        same(commanded.terms[1].params.commanded, expected.terms[1].params.commanded)


def test_one_state_is_a_path_of_one(tmp_path):
    scene = jb.tendon_beam(nx=5, ny=3)
    one = solution_of(scene, [1.0, 1.0], scene.mesh.nodes, 0)
    assert len(files.write_path(tmp_path / "a.pvd", scene, one)) == 1


def test_errors(tmp_path):
    scene = jb.tendon_beam(nx=5, ny=3)
    rest = scene.mesh.nodes
    for call, text in [
        (lambda: files.write_vtu(tmp_path / "a.vtk", scene, rest), r"path: expected a name that ends in \.vtu, got"),
        (lambda: files.write_vtu(tmp_path / "no" / "a.vtu", scene, rest), r"path: there is no folder .*no .*make it"),
        (lambda: files.write_vtu(tmp_path, scene, rest), "path: expected the name of a file, got the folder"),
        (lambda: files.write_vtu(tmp_path / "a.vtu", scene, rest[None]), "x: expected node positions of shape"),
        (lambda: files.write_vtu(tmp_path / "a.vtu", rest, rest), "scene: expected a Scene"),
        (lambda: files.write_vtu(tmp_path / "a.vtu", scene, rest, {"g": [99]}), r"groups\['g'\]: 99 is out of range"),
        (lambda: files.write_path(tmp_path / "a.vtu", scene, rest), r"expected a name that ends in \.pvd"),
        (lambda: files.write_path(tmp_path / "a.pvd", scene, rest), "solution: expected a Solution"),
        (lambda: jax.jit(lambda x: files.write_vtu(tmp_path / "a.vtu", scene, x))(rest), "scene, x: expected concrete"),
    ]:
        with pytest.raises(ValueError, match=text):
            call()
    other = path_of(jb.tendon_beam(nx=7, ny=3))
    with pytest.raises(ValueError, match=r"solution: expected x of shape .* give a solution of this scene"):
        files.write_path(tmp_path / "a.pvd", scene, other)
    assert not list(tmp_path.iterdir())


def test_a_write_that_fails_leaves_the_earlier_file(tmp_path, monkeypatch):
    scene = jb.tendon_beam(nx=5, ny=3)
    files.write_vtu(tmp_path / "a.vtu", scene, scene.mesh.nodes)
    before = (tmp_path / "a.vtu").read_bytes()

    def broken(path, *rest, **options):
        path.write_text("half")
        raise OSError("no space left on device")

    monkeypatch.setattr(meshio, "write", broken)
    with pytest.raises(OSError, match="no space"):
        files.write_vtu(tmp_path / "a.vtu", scene, bent(scene))
    assert (tmp_path / "a.vtu").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1
