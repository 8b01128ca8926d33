"""Meshes: patterns, selection, what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, areas, disturbed, l_shape, shuffled, total_area

import jaxbeam as jb
from jaxbeam.mesh.rectangle import middle_column

PATTERNS = ["one-sided", "mirrored", "crossed"]
SQUARE = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
HALVES = [[0, 1, 2], [0, 2, 3]]


def triangle_set(nodes, elements):
    """The triangles as a set of sets of points, to compare meshes whatever their numbering."""
    points = np.round(np.asarray(nodes), 9) + 0.0  # + 0.0 turns -0 into 0
    return {frozenset(map(tuple, points[e])) for e in elements}


@pytest.mark.parametrize("diagonals", PATTERNS)
@pytest.mark.parametrize(("nx", "ny"), [(2, 3), (5, 3), (4, 5)])
def test_rectangle_covers_its_area(diagonals, nx, ny):
    mesh = jb.rectangle(3.0, 0.7, nx, ny, diagonals=diagonals)
    cells = (nx - 1) * (ny - 1)
    crossed = diagonals == "crossed"
    assert mesh.nodes.shape == (nx * ny + crossed * cells, 2)
    assert mesh.elements.shape == (cells * (4 if crossed else 2), 3)
    # All areas equal and positive, and their sum right: no overlap, no gap. Round-off of a sum.
    np.testing.assert_allclose(areas(mesh), 3.0 * 0.7 / len(mesh.elements), rtol=1e3 * EPS)
    corners = np.array([[-1.5, -0.35], [1.5, 0.35]])
    np.testing.assert_array_equal([mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)], corners)


def test_reference_mesh_is_the_stated_one():
    mesh = jb.rectangle(3.5, 0.8, 29, 7)
    assert mesh.nodes.shape == (203, 2)
    assert mesh.elements.shape == (336, 3)
    # Numbered along the short side.
    np.testing.assert_allclose(mesh.nodes[7 * 3 + 2], [-1.75 + 3 * 0.125, -0.4 + 2 * 0.8 / 6], atol=4 * EPS)
    # The diagonal of the first cell, from lower left (0) to upper right (8), belongs to two triangles.
    assert sum({0, 8} <= set(e) for e in mesh.elements.tolist()) == 2
    assert sum({1, 7} <= set(e) for e in mesh.elements.tolist()) == 0


@pytest.mark.parametrize(("diagonals", "symmetric"), [("one-sided", False), ("mirrored", True), ("crossed", True)])
def test_symmetry_about_mid_height(diagonals, symmetric):
    mesh = jb.rectangle(2.0, 1.0, 4, 5, diagonals=diagonals)
    nodes = np.asarray(mesh.nodes)
    mirror = triangle_set(nodes * [1, -1], mesh.elements)
    assert (triangle_set(nodes, mesh.elements) == mirror) is symmetric


def test_lower_half_of_mirrored_is_one_sided():
    one, two = (jb.rectangle(2.0, 1.0, 4, 5, diagonals=d) for d in ("one-sided", "mirrored"))
    lower = [{*e} for e in one.elements.tolist() if all(one.nodes[n, 1] < 1e-9 for n in e)]
    assert len(lower) == 12
    assert all(triangle in [{*e} for e in two.elements.tolist()] for triangle in lower)


def test_rectangle_differentiates_in_its_extents():
    area = lambda extent: jnp.sum(jb.rectangle(extent[0], extent[1], 3, 3).nodes ** 2)
    length, height = 2.0, 1.0
    # sum of squares is proportional to the square of each extent: x in {-1/2, 0, 1/2} thrice.
    np.testing.assert_allclose(jax.grad(area)(jnp.array([length, height])), [3 * length, 3 * height], rtol=10 * EPS)
    np.testing.assert_allclose(jax.jit(area)(jnp.array([length, height])), 1.5 * (length**2 + height**2), rtol=10 * EPS)


@pytest.mark.parametrize(
    ("nodes", "dtype"),
    [
        (SQUARE, jnp.float64),
        ([[0, 0], [1, 0], [1, 1], [0, 1]], jnp.float64),
        (np.array(SQUARE, np.float32), jnp.float32),
        (jnp.asarray(SQUARE), jnp.float64),
        (np.array(SQUARE).astype(int), jnp.float64),
    ],
    ids=["list", "whole numbers", "numpy float32", "jax", "numpy int"],
)
@pytest.mark.parametrize("elements", [HALVES, np.array(HALVES, np.uint8), jnp.asarray(HALVES)], ids=type)
def test_accepts(nodes, dtype, elements):
    mesh = jb.Mesh(nodes, elements)
    assert isinstance(mesh.nodes, jax.Array)
    assert mesh.nodes.dtype == dtype
    assert total_area(mesh) == 1
    assert not mesh.elements.flags.writeable


def test_elements_are_copied():
    """A caller who changes his array afterwards does not change the mesh, whose layout is cached."""
    elements = np.array(HALVES)
    mesh = jb.Mesh(SQUARE, elements)
    elements[0] = 0
    assert mesh.elements.tolist() == HALVES


def changed(k, value):
    nodes = np.array(SQUARE)
    nodes[k] = value
    return nodes


@pytest.mark.parametrize(
    ("nodes", "elements", "message"),
    [
        (np.zeros((4, 3)), HALVES, r"nodes: expected shape \(n, 2\), got \(4, 3\)"),
        (np.zeros(8), HALVES, r"nodes: expected shape \(n, 2\), got \(8,\)"),
        (np.array(SQUARE, complex), HALVES, r"nodes: expected real numbers, got dtype complex128"),
        (np.array(SQUARE, str), HALVES, r"nodes: expected real numbers, got dtype"),
        (SQUARE, [[0, 1], [2, 3]], r"elements: expected shape \(t, 3\) or \(t, 6\) with t >= 1, got \(2, 2\)"),
        (SQUARE, np.zeros((0, 3), int), r"elements: expected shape \(t, 3\) or \(t, 6\) with t >= 1, got \(0, 3\)"),
        (SQUARE, np.array(HALVES, float), r"elements: expected whole numbers, got dtype float64"),
        (SQUARE, [[0, 1, 2], [0, 2, 4]], r"elements: triangle 1 is \[0, 2, 4\], but nodes are numbered 0 to 3"),
        (SQUARE, [[0, 1, 2], [0, 2, -1]], r"elements: triangle 1 is \[0, 2, -1\], but nodes are numbered 0 to 3"),
        (SQUARE, [[0, 1, 2], [0, 2, 2**31]], r"elements: node numbers must fit 32 bits, got 2147483648"),
        (SQUARE, [[0, 1, 2], [0, 3, 3]], r"elements: triangle 1 repeats a node: \[0, 3, 3\]"),
        (SQUARE, [*HALVES, [2, 0, 1]], r"elements: triangle 0, \[0, 1, 2\], is listed more than once"),
        (SQUARE, [[0, 1, 2]], r"nodes: 1 belong to no triangle, the first is node 3; remove"),
        (changed(2, [np.nan, 0]), HALVES, r"nodes: node 2 is not finite: \[nan, 0.0\]"),
        (changed(1, [np.inf, 0]), HALVES, r"nodes: node 1 is not finite"),
        (changed(3, [1, 0]), HALVES, r"nodes: nodes 1 and 3 coincide at \[1.0, 0.0\]; merge"),
        (SQUARE, [[0, 1, 2], [0, 3, 2]], r"triangle 1, \[0, 3, 2\], has area -0.5, expected positive; .*counter-clock"),
        (changed(3, [0.5, 0.5]), HALVES, r"triangle 1, \[0, 2, 3\], has area 0, expected positive; remove it"),
    ],
)
def test_refuses(nodes, elements, message):
    with pytest.raises(ValueError, match=message):
        jb.Mesh(nodes, elements)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"nx": 1}, r"nx: expected a whole number of at least 2, got 1"),
        ({"ny": 1}, r"ny: expected a whole number of at least 2, got 1"),
        ({"nx": 3.0}, r"nx: expected a whole number of at least 2, got 3\.0"),
        ({"ny": True}, r"ny: expected a whole number of at least 2, got True"),
        ({"length": 0.0}, r"length: expected a positive finite number, got 0\.0"),
        ({"length": np.inf}, r"length: expected a positive finite number, got inf"),
        ({"height": -1.0}, r"height: expected a positive finite number, got -1\.0"),
        ({"height": np.nan}, r"height: expected a positive finite number, got nan"),
        ({"height": [1.0, 2.0]}, r"height: expected a positive finite number, got \[1\.0, 2\.0\]"),
        ({"diagonals": "alternate"}, r"diagonals: expected 'one-sided', 'mirrored' or 'crossed', got 'alternate'"),
        ({"nx": 2, "graded": True}, r"nx: expected at least 3 for a graded mesh, got 2: no node .*; use 3"),
        ({"nx": 2, "graded": "proportional"}, r"nx: expected at least 3 for a graded mesh, got 2: no node .*; use 3"),
        ({"graded": "linear"}, r"graded: expected True or False, got 'linear'; the third choice is 'proportional'"),
        ({"graded": 1}, r"graded: expected True or False, got 1; the third choice is 'proportional'"),
        ({"diagonals": "mirrored", "ny": 4}, r"ny: expected an odd number for mirrored diagonals, got 4.*use 5"),
    ],
)
def test_rectangle_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        jb.rectangle(**({"length": 2.0, "height": 1.0, "nx": 3, "ny": 3} | arguments))


@pytest.mark.parametrize("nx", [3, 4, 9, 30])
def test_graded_columns_crowd_at_the_edge_and_in_the_middle(nx):
    mesh = jb.rectangle(2.0, 1.0, nx, 4, graded=True)
    columns, rows = np.unique(mesh.nodes[:, 0]), np.unique(mesh.nodes[:, 1])
    assert len(columns) == nx and len(rows) == 4
    np.testing.assert_allclose([*columns[[0, -1]], *rows[[0, -1]]], [-1, 1, -0.5, 0.5])
    middle = int(np.flatnonzero(columns == 0)[0])
    assert nx - 1 - middle <= middle <= 2 * (nx - 1 - middle) + 2
    for half in (columns[: middle + 1], columns[middle:]):
        assert (np.diff(np.diff(half)) > 0).all()
    assert rows[1] - rows[0] < rows[2] - rows[1]


def counted(density, places):
    """The integral of a density between places that follow each other, by Gauss's rule."""
    at, weights = np.polynomial.legendre.leggauss(40)
    middles, halves = (places[1:] + places[:-1]) / 2, np.diff(places) / 2
    return halves * (density(middles[:, None] + halves[:, None] * at) @ weights)


@pytest.mark.parametrize("nx", [3, 4, 9, 30])
@pytest.mark.parametrize(("length", "height"), [(2.0, 2.0), (3.5, 0.8), (8000.0, 800.0)])
def test_proportional_cells_have_their_density(nx, length, height):
    """Between two neighbours lies the same share of the density, as the docstring of `rectangle` gives it."""
    mesh = jb.rectangle(length, height, nx, 6, graded="proportional")
    columns, rows = np.unique(mesh.nodes[:, 0]), np.unique(mesh.nodes[:, 1])
    assert len(columns) == nx and len(rows) == 6
    np.testing.assert_array_equal(columns[[0, -1]], [-length / 2, length / 2])
    middle = int(np.flatnonzero(columns == 0)[0])
    assert middle == middle_column(nx, "proportional")
    clamp, anchor, face = (share * height for share in (0.03, 0.2, 0.06))
    left = lambda x: 1 / (x + length / 2 + clamp) + 1 / (anchor - x)
    across = lambda y: 1 / (y + height / 2 + face) + 1 / (height / 2 + face - y)
    for density, places in (
        (left, columns[: middle + 1]),
        (lambda x: 1 / (x + anchor), columns[middle:]),
        (across, rows),
    ):
        shares = counted(density, places)
        np.testing.assert_allclose(shares, shares.mean(), rtol=1e-9)


@pytest.mark.parametrize("diagonals", ["mirrored", "crossed"])
def test_proportional_rows_are_symmetric(diagonals):
    """To the last bit, so that a beam whose tendons are pulled alike does not choose a side."""
    mesh = jb.rectangle(3.5, 0.8, 5, 7, diagonals, graded="proportional", order=2)
    nodes = {tuple(node) for node in mesh.nodes.tolist()}
    assert {(x, -y) for x, y in nodes} == nodes


def test_proportional_mesh_is_differentiable_in_its_extents():
    place = lambda extents: jb.rectangle(*extents, 6, 4, "crossed", graded="proportional", order=2).nodes
    extents = jnp.array([3.5, 0.8])
    np.testing.assert_allclose(
        jax.jit(place)(extents),
        jb.rectangle(3.5, 0.8, 6, 4, "crossed", graded="proportional", order=2).nodes,
        rtol=1e-12,
        atol=1e-14,
    )
    slopes = jax.jacfwd(place)(extents)
    for k, step in enumerate(np.eye(2) * 1e-5):
        np.testing.assert_allclose(slopes[..., k], (place(extents + step) - place(extents - step)) / 2e-5, atol=1e-9)
    np.testing.assert_allclose(jax.jacrev(place)(extents), slopes, atol=1e-12)


def test_traced_topology_is_refused():
    with pytest.raises(ValueError, match="elements: expected concrete node numbers, got a traced array"):
        jax.jit(lambda elements: jb.Mesh(SQUARE, elements).nodes)(jnp.asarray(HALVES))


def test_selection():
    mesh = jb.rectangle(2.0, 1.0, 3, 2)
    assert jb.nodes_where(mesh, lambda x, y: y > 0).tolist() == [1, 3, 5]
    assert jb.nodes_where(mesh, lambda x, y: (x > 0.9) & (y < 0)).tolist() == [4]
    assert jb.nearest_node(mesh, [0.2, 0.3]) == 3
    assert jb.nearest_node(mesh, (0, 0)) == 2  # nodes 2 and 3 are equally near: the lower number
    assert isinstance(jb.nearest_node(mesh, np.zeros(2)), int)


@pytest.mark.parametrize("irregular", [disturbed(jb.rectangle(2.0, 1.0, 5, 4)), shuffled(l_shape())[0]])
def test_nearest_is_nearest(irregular):
    for point in np.random.default_rng(0).uniform(-1, 1, (20, 2)):
        chosen = jb.nearest_node(irregular, point)
        distance = np.hypot(*(np.asarray(irregular.nodes) - point).T)
        assert distance[chosen] == distance.min()
    many = np.random.default_rng(1).uniform(-1, 1, (3, 4, 2))
    each = [[jb.nearest_node(irregular, point) for point in row] for row in many]
    np.testing.assert_array_equal(jb.nearest_node(irregular, many), each)


@pytest.mark.parametrize(
    ("predicate", "message"),
    [
        (lambda x, y: x > 5, r"predicate: selects no node; x spans \[-1, 1\], y spans \[-0.5, 0.5\]"),
        (lambda x, y: x, r"predicate: expected \(6,\) booleans, got shape \(6,\) of dtype float64"),
        (lambda x, y: True, r"predicate: expected \(6,\) booleans, got shape \(\) of dtype bool"),
    ],
)
def test_selection_refuses(predicate, message):
    with pytest.raises(ValueError, match=message):
        jb.nodes_where(jb.rectangle(2.0, 1.0, 3, 2), predicate)


@pytest.mark.parametrize("point", [[0.0], [0.0, np.nan], [[0.0, 0.0, 1.0]], 1.0])
def test_nearest_refuses(point):
    with pytest.raises(ValueError, match=r"point: expected (shape|finite)"):
        jb.nearest_node(jb.rectangle(2.0, 1.0, 3, 2), point)


@pytest.mark.parametrize("select", [lambda m: jb.nearest_node(m, [0, 0]), lambda m: jb.nodes_where(m, np.greater)])
def test_selection_by_traced_positions_is_refused(select):
    with pytest.raises(ValueError, match="mesh: its nodes are traced"):
        jax.jit(lambda length: select(jb.rectangle(length, 1.0, 3, 2)))(2.0)
