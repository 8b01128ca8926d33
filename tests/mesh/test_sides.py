"""Lines along the surface: their order, their lengths against closed forms, and places on them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import annulus, areas, disturbed, l_shape, part, shuffled

import jaxbeam as jb
from jaxbeam.mesh.surface import finer_edges, surface

FLAT = jb.rectangle(4.0, 1.0, 5, 3)
CURVED = jb.rectangle(4.0, 1.0, 5, 3, order=2)


def signed_area(mesh, line):
    """Area to the left of a closed line of corners."""
    x, y = np.asarray(mesh.nodes)[line].T
    return 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)


def touching():
    """A square of 5 x 5 nodes without two cells that touch at its centre, and the number of that node."""
    square = jb.rectangle(4.0, 4.0, 5, 5)
    mesh, old = jb.without(square, jb.elements_where(square, lambda x, y: (x * y > 0) & (abs(x) < 1) & (abs(y) < 1)))
    return mesh, int(np.flatnonzero(old == 12)[0])


# --------------------------------------------------------------------------------------- surface lines


def test_the_surface_of_a_rectangle():
    (line,) = jb.surface_lines(FLAT)
    assert line.tolist() == [0, 3, 6, 9, 12, 13, 14, 11, 8, 5, 2, 1]
    (line,) = jb.surface_lines(CURVED)
    assert line[::2].tolist() == [0, 3, 6, 9, 12, 13, 14, 11, 8, 5, 2, 1]
    nodes = np.asarray(CURVED.nodes)
    np.testing.assert_array_equal(nodes[line[1::2]], (nodes[line[::2]] + nodes[np.roll(line[::2], -1)]) / 2)


@pytest.mark.parametrize("mesh", [annulus(), shuffled(annulus())[0]])
def test_a_ring_has_two_lines(mesh):
    """Twelve corners on radius 1 and on radius 2, the inner ones clockwise."""
    lines = jb.surface_lines(mesh)
    assert [len(line) for line in lines] == [12, 12]
    assert [line[0] for line in lines] == sorted(line.min() for line in lines)
    found = sorted(signed_area(mesh, line) for line in lines)
    np.testing.assert_allclose(found, 6 * np.sin(np.pi / 6) * np.array([-1, 4]), rtol=1e-13)


def test_lines_of_random_bodies_go_once_round_each_part():
    """All edges of the surface, each once; and to their left just the area of the body, whatever was cut away."""
    rng, whole = np.random.default_rng(0), disturbed(jb.rectangle(3.0, 2.0, 8, 6))
    for number in range(40):
        mesh = part(whole, rng.uniform(size=len(whole.elements)) < rng.uniform(0.3, 1))
        lines = jb.surface_lines(mesh)
        edges = [pair for line in lines for pair in zip(line.tolist(), np.roll(line, -1).tolist(), strict=True)]
        assert sorted(edges) == sorted(map(tuple, surface(mesh).tolist())), number
        np.testing.assert_allclose(sum(signed_area(mesh, line) for line in lines), areas(mesh).sum(), rtol=1e-12)


def test_bodies_that_touch_at_a_node_have_a_line_each():
    nodes = [[0, 0], [1, 0], [1, 1], [0, 1], [2, 1], [2, 2], [1, 2]]
    mesh = jb.Mesh(np.array(nodes, float), [[0, 1, 2], [0, 2, 3], [2, 4, 5], [2, 5, 6]])
    assert [line.tolist() for line in jb.surface_lines(mesh)] == [[0, 1, 2, 3], [2, 4, 5, 6]]


def test_traced_nodes_have_the_same_lines():
    found = []
    jax.eval_shape(lambda length: found.append(jb.surface_lines(jb.rectangle(length, 1.0, 5, 3))), 1.0)
    np.testing.assert_array_equal(found[0][0], jb.surface_lines(FLAT)[0])


def test_edges_of_a_finer_mesh_where_the_surface_touches_itself():
    """Two edges begin at the node where holes touch; the way along one of them must not take the other."""
    mesh, centre = touching()
    edges, finer = surface(mesh), jb.refined(mesh)
    (around,) = (line for line in jb.surface_lines(mesh) if centre in line)
    chosen = edges[np.isin(edges[:, 0], around)]
    found, parents = finer_edges(finer, chosen)
    assert len(found) == 2 * len(chosen) == 16
    np.testing.assert_array_equal(found[::2, 0], chosen[:, 0])
    np.testing.assert_array_equal(found[1::2, 1], chosen[:, 1])
    np.testing.assert_array_equal(parents, np.repeat(np.arange(8), 2))


# ------------------------------------------------------------------------------------------------ sides


def test_sides_of_a_rectangle():
    corner = lambda mesh, x, y: jb.nearest_node(mesh, (x, y))
    right_up = corner(FLAT, 2, 0.5)
    assert jb.side(FLAT, right_up, corner(FLAT, -2, 0.5)).tolist() == [14, 11, 8, 5, 2]
    assert jb.side(FLAT, np.int32(2), jnp.array(0)).tolist() == [2, 1, 0]
    assert jb.side(FLAT, 12, 14).tolist() == [12, 13, 14]
    assert jb.side(FLAT, 0, 12).tolist() == [0, 3, 6, 9, 12]
    # The long way round, and all of it.
    assert jb.side(FLAT, 12, 0).tolist() == [12, 13, 14, 11, 8, 5, 2, 1, 0]
    assert jb.side(FLAT, 6, 6).tolist() == [6, 9, 12, 13, 14, 11, 8, 5, 2, 1, 0, 3]
    lower = jb.side(CURVED, 0, 12)
    assert lower[::2].tolist() == [0, 3, 6, 9, 12]
    np.testing.assert_allclose(CURVED.nodes[lower], np.stack([np.linspace(-2, 2, 9), np.full(9, -0.5)], 1))


def test_side_of_a_hole_is_clockwise():
    mesh, _ = jb.without(jb.rectangle(3.0, 3.0, 4, 4), [8, 9])
    at = lambda x, y: jb.nearest_node(mesh, (x, y))
    upper = jb.side(mesh, at(-0.5, 0.5), at(0.5, 0.5))
    np.testing.assert_allclose(mesh.nodes[upper], [[-0.5, 0.5], [0.5, 0.5]])


TOUCHING, CENTRE = touching()


@pytest.mark.parametrize(
    ("mesh", "start", "end", "message"),
    [
        (FLAT, 7, 0, r"start: expected a node that the surface passes through once, got 7: it is inside the body"),
        (FLAT, 0, 4, r"end: .* got 4: it is inside the body; choose one of surface_lines"),
        (FLAT, 0, 15, r"end: 15 is out of range, nodes are numbered 0 to 14"),
        (FLAT, -1, 0, r"start: expected a whole number of at least 0, got -1"),
        (FLAT, 0.5, 0, r"start: expected a whole number"),
        (annulus(), 0, 2, r"end: expected a node of the closed line of the surface that 0 is on, got 2"),
        (TOUCHING, CENTRE, 0, r"start: .*: the surface passes through it more than once"),
        (jb.rod_beam(3).mesh, 0, 1, r"mesh: expected triangles, got the Line of a rod"),
    ],
)
def test_side_refuses(mesh, start, end, message):
    with pytest.raises(ValueError, match=message):
        jb.side(mesh, start, end)


def test_pressure_on_a_side():
    """The edges between the corners of a side are those of the side, and their total force is pressure times chord."""
    mesh = jb.mapped(CURVED, lambda x, y: (x, y + 0.1 * x**2))
    upper = jb.side(mesh, 14, 2)
    scene = jb.Scene(mesh, (jb.pressure(mesh, upper, 2.0),), jb.clamped(mesh, [14, 2]))
    np.testing.assert_allclose(jb.forces(scene, scene.mesh.nodes).sum(axis=0), [0, -2 * 4], atol=1e-12)


# ------------------------------------------------------------------------------------------ arc lengths


def test_arc_length_of_a_circle():
    """Arcs of 0.125 radians by parabolas: their length errs by a share of angle^4 / 2880 or so."""
    bend = lambda x, y: ((2 - y) * np.sin(x / 2), (y - 2) * np.cos(x / 2))
    mesh = jb.mapped(jb.rectangle(2.0, 0.5, 9, 3, order=2), bend)
    upper = jb.side(mesh, 26, 2)
    np.testing.assert_allclose(jb.arc_lengths(mesh, upper), 1.75 * np.linspace(0, 1, 17), atol=1e-6)
    straight = jb.side(mesh, 2, 0)
    np.testing.assert_allclose(jb.arc_lengths(mesh, straight), [0, 0.125, 0.25, 0.375, 0.5], atol=1e-15)


def test_arc_length_of_a_parabola():
    """Six-node triangles represent `y = x^2 / 4` exactly. With t = x / 2 its arc is `t sqrt(1 + t^2) + asinh t`."""
    mesh = jb.mapped(CURVED, lambda x, y: (x, y + x**2 / 4))
    t = np.linspace(-1, 1, 9)
    exact = t * np.sqrt(1 + t**2) + np.arcsinh(t)
    lower = jb.side(mesh, 0, 12)
    np.testing.assert_allclose(jb.arc_lengths(mesh, lower), exact - exact[0], atol=1e-12)
    # Backwards, and along the middle of the body, inside.
    np.testing.assert_allclose(jb.arc_lengths(mesh, lower[::-1]), exact[-1] - exact[::-1], atol=1e-12)
    middle = jb.nodes_where(CURVED, lambda x, y: y == 0)
    middle = middle[np.argsort(CURVED.nodes[middle, 0])]
    np.testing.assert_allclose(jb.arc_lengths(mesh, middle), exact - exact[0], atol=1e-12)


def test_arc_length_of_closed_lines_and_its_derivative():
    mesh = annulus()
    for line in jb.surface_lines(mesh):
        radius = np.linalg.norm(mesh.nodes[line[0]])
        around = jb.arc_lengths(mesh, np.append(line, line[0]))
        np.testing.assert_allclose(around, radius * 2 * np.sin(np.pi / 12) * np.arange(13), rtol=1e-13)
    assert jb.arc_lengths(mesh, [3]).tolist() == [0]

    # The sloping side of a wedge: sqrt(16 + s^2) has the derivative s / sqrt(16 + s^2).
    def length(slope):
        return jb.arc_lengths(jb.mapped(FLAT, lambda x, y: (x, y + slope * x / 4)), jb.side(FLAT, 0, 12))[-1]

    value, slope = jax.jit(jax.value_and_grad(length))(3.0)
    np.testing.assert_allclose([value, slope], [5.0, 0.6], rtol=1e-14)


@pytest.mark.parametrize(
    ("mesh", "nodes", "message"),
    [
        (FLAT, [0, 6], r"nodes: nodes 0 and 6 follow each other, but are not neighbours on an edge"),
        (CURVED, [0, 3], r"nodes: nodes 0 and 3 follow each other"),
        (FLAT, [0, 0], r"nodes: nodes 0 and 0 follow each other"),
        (FLAT, [0, 15], r"nodes: 15 is out of range"),
        (FLAT, [], r"nodes: expected whole numbers of shape \(m,\)"),
    ],
)
def test_arc_lengths_refuses(mesh, nodes, message):
    with pytest.raises(ValueError, match=message):
        jb.arc_lengths(mesh, nodes)


# ----------------------------------------------------------------------------------------- along a line


def test_along_finds_the_nearest_nodes():
    upper = jb.side(CURVED, 14, 2)
    assert jb.along(CURVED, upper, [0, 1.2, 4.0], corners=True).tolist() == [14, 11, 2]
    found = jb.along(CURVED, upper, [0.0, 1.4, 2.8])
    np.testing.assert_allclose(CURVED.nodes[found, 0], [2, 0.5, -1])
    # Equally near to two: the first. One distance gives one node.
    assert jb.along(FLAT, jb.side(FLAT, 0, 12), 1.5) == 3
    mesh = jb.mapped(CURVED, lambda x, y: (x, y + x**2 / 4))
    assert jb.along(mesh, jb.side(mesh, 0, 12), np.sqrt(2) + np.arcsinh(1)) == 6


def test_along_gives_anchors_of_finite_width():
    mesh = jb.mapped(jb.rectangle(4.0, 1.0, 9, 3, order=2), lambda x, y: (x, y * (1 - 0.1 * x)))
    upper = jb.side(mesh, 26, 2)[::-1]
    guides = jb.along(mesh, upper, [0.1, 1.1, 2.0], corners=True)
    term = jb.tendons(mesh, [guides], 1e3, width=0.4)
    np.testing.assert_allclose(term.params.natural, 2 * np.hypot(1, 0.05), rtol=1e-12)


@pytest.mark.parametrize(
    ("distances", "message"),
    [
        ([1.0, 4.1], r"distances: expected numbers from 0 to 4, the length of the line, got 4\.1"),
        (-0.1, r"distances: .* got -0\.1"),
        ([[1.0]], r"distances: .* got shape \(1, 1\)"),
        ([np.nan], r"distances: expected finite numbers"),
        ("1", r"distances: expected real numbers"),
    ],
)
def test_along_refuses(distances, message):
    with pytest.raises(ValueError, match=message):
        jb.along(FLAT, jb.side(FLAT, 0, 12), distances)


def test_along_refuses_what_is_traced():
    line = jb.side(FLAT, 0, 12)
    with pytest.raises(ValueError, match="mesh: its nodes are traced"):
        jax.jit(lambda length: jb.along(jb.rectangle(length, 1.0, 5, 3), line, [0.1]))(4.0)
    with pytest.raises(ValueError, match="distances: they are traced"):
        jax.jit(lambda s: jb.along(FLAT, line, s))(1.0)
    with pytest.raises(ValueError, match="nodes: expected at least one corner"):
        jb.along(CURVED, jb.side(CURVED, 0, 12)[1:2], 0.0, corners=True)


# ---------------------------------------------------------------------------------------- elements_where


@pytest.mark.parametrize("mesh", [FLAT, CURVED, l_shape()])
def test_elements_where_goes_by_centres(mesh):
    corners = np.asarray(mesh.nodes)[mesh.elements[:, :3]]
    right = [k for k, three in enumerate(corners) if sum(three[:, 0]) / 3 > 0]
    np.testing.assert_array_equal(jb.elements_where(mesh, lambda x, y: x > 0), right)


def test_elements_where_refuses():
    with pytest.raises(ValueError, match=r"predicate: selects no element; x spans \[-1\.66"):
        jb.elements_where(FLAT, lambda x, y: x > 5)
    with pytest.raises(ValueError, match=r"predicate: expected \(16,\) booleans, got shape \(16,\) of dtype float64"):
        jb.elements_where(FLAT, lambda x, y: x)
    with pytest.raises(ValueError, match="mesh: its nodes are traced"):
        jax.jit(lambda length: jb.elements_where(jb.rectangle(length, 1.0, 5, 3), lambda x, y: x > 0))(1.0)
    with pytest.raises(ValueError, match="mesh: expected triangles, got the Line of a rod"):
        jb.elements_where(jb.rod_beam(3).mesh, lambda x, y: x > 0)
