"""Bodies made of a rectangle by a map, with holes, and several side by side, against closed forms and by parts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, areas

import jaxbeam as jb

LENGTH, HEIGHT = 3.5, 0.8


def taper(slope):
    """Sections as high as `1 - slope x` times those of the rectangle."""
    return lambda x, y: (x, y * (1 - slope * x))


def sector(x, y):
    """The rectangle bent to an arc of middle radius 2 and angle `x / 2`, in the sense of its upper side."""
    return (2 - y) * jnp.sin(x / 2), 2 - (2 - y) * jnp.cos(x / 2)


def rest_area(mesh):
    """Area of the body, with curved edges: by the trapezoidal rule along polylines of 200 chords for each edge."""
    area, xi = 0.0, np.linspace(0, 1, 201)[:, None]
    for line in jb.surface_lines(mesh):
        nodes = np.asarray(mesh.nodes)[np.append(line, line[0])]
        if mesh.elements.shape[1] == 6:
            ends, middles = nodes[::2], nodes[1::2]
            parts = [
                a * (1 - xi) * (1 - 2 * xi) + m * 4 * xi * (1 - xi) + b * xi * (2 * xi - 1)
                for a, m, b in zip(ends, middles, ends[1:], strict=False)
            ]
            nodes = np.concatenate(parts)
        area += 0.5 * np.sum(nodes[:-1, 0] * nodes[1:, 1] - nodes[1:, 0] * nodes[:-1, 1])
    return area


# ------------------------------------------------------------------------------------------------ mapped


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("graded", [False, True])
def test_area_of_a_tapered_beam(order, graded):
    """A trapezium, whatever the mesh: length times the mean of the heights of its ends."""
    mesh = jb.mapped(jb.rectangle(LENGTH, HEIGHT, 7, 4, order=order, graded=graded), taper(0.2))
    ends = [HEIGHT * (1 - 0.2 * x) for x in (-LENGTH / 2, LENGTH / 2)]
    np.testing.assert_allclose(rest_area(mesh), LENGTH * np.mean(ends), rtol=1e3 * EPS)


@pytest.mark.parametrize(("order", "rate"), [(1, 2), (2, 4)])
def test_area_of_a_sector_of_an_annulus(order, rate):
    """`(R^2 - r^2) / 2` times the angle. Chords leave out a share of `h^2`, parabolas one of `h^4`."""
    exact = 0.5 * (LENGTH / 2) * ((2 + HEIGHT / 2) ** 2 - (2 - HEIGHT / 2) ** 2)
    error = [
        abs(rest_area(jb.mapped(jb.rectangle(LENGTH, HEIGHT, nx, 3, order=order), sector)) - exact) for nx in (5, 9)
    ]
    assert error[0] < 0.04 * exact
    # The trapezoidal rule of `rest_area` is exact to 1e-6 of what a parabola adds to its chord.
    assert np.log2(error[0] / error[1]) > rate - 0.3


def test_quadrature_sees_the_curved_body():
    mesh = jb.mapped(jb.rectangle(LENGTH, HEIGHT, 9, 3, order=2), sector)
    weights = jb.solid(mesh, jb.lame(1e4, 0.3)).params.weights
    np.testing.assert_allclose(weights.sum(), rest_area(mesh), rtol=1e-6)


def test_numbers_and_dtype_stay():
    flat = jb.rectangle(2.0, 1.0, 4, 3, "crossed", jnp.float32, order=2)
    mesh = jb.mapped(flat, lambda x, y: (np.float64(2) * x, y))
    np.testing.assert_array_equal(mesh.elements, flat.elements)
    np.testing.assert_array_equal(mesh.nodes, flat.nodes * np.array([2, 1], np.float32))
    assert mesh.nodes.dtype == jnp.float32
    # A function may return one array of two rows, and may change its arguments in place.
    assert np.array_equal(jb.mapped(flat, lambda x, y: np.stack([2 * x, y])).nodes, mesh.nodes)

    def in_place(x, y):
        x *= 2
        return x, y

    assert np.array_equal(jb.mapped(flat, in_place).nodes, mesh.nodes)
    np.testing.assert_array_equal(flat.nodes[:, 0] * 2, mesh.nodes[:, 0])


def test_area_differentiates_in_the_taper_and_in_the_mesh():
    def area(slope, length):
        mesh = jb.mapped(jb.rectangle(length, HEIGHT, 5, 3), lambda x, y: (x + 1.0, y * (2 - slope * (x + 1.0))))
        a, b, c = jnp.moveaxis(mesh.nodes[mesh.elements], 1, 0)
        return 0.5 * jnp.sum((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])

    # The area is length x height x (2 - slope), of x from 1 - length / 2 to 1 + length / 2.
    slopes = jax.jit(jax.grad(area, argnums=(0, 1)))(0.3, 2.0)
    np.testing.assert_allclose(slopes, [-2.0 * HEIGHT, HEIGHT * 1.7], rtol=1e-12)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        (3, r"shape: expected a function \(x, y\) -> \(x, y\)"),
        (
            lambda x, y: x,
            r"shape: .* returns a pair \(x, y\) of arrays of shape \(15,\), got an array of shape \(15,\)",
        ),
        (lambda x, y: None, r"shape: .* got a NoneType; end it with `return x, y`"),
        (lambda x, y: (x, y, x), r"shape: .* got 3 values"),
        (lambda x, y: (x, 0.0), r"shape: .* got y of shape \(\); .* a constant with `0 \* x \+ constant`"),
        (lambda x, y: (x[1:], y), r"shape: .* got x of shape \(14,\)"),
        (lambda x, y: (x, y + 1j), r"shape: .* got dtype complex128; take the real part"),
        (lambda x, y: (x / (x > 0), y), r"shape: expected finite positions, got .* at rest at \(-1, -0.5\) \(9 such\)"),
        (lambda x, y: (x, -y), r"shape: it makes a mirror image, .*; change the sign of one"),
        (lambda x, y: (0 * x, y), r"shape: it turns 16 of 16 triangles inside out or flat"),
        (lambda x, y: (x, y * (0.75 - x)), r"shape: it turns 2 of 16 .* triangle 12 .*positive determinant everywhere"),
    ],
)
def test_mapped_refuses(shape, message):
    with np.errstate(divide="ignore", invalid="ignore"), pytest.raises(ValueError, match=message):
        jb.mapped(jb.rectangle(2.0, 1.0, 5, 3), shape)


def test_mapped_refuses_a_body_that_folds_or_overlaps():
    ring = lambda x, y: ((2 - y) * np.sin(x), -(2 - y) * np.cos(x))
    with pytest.raises(ValueError, match=r"shape: the body .* not a sound one.* triangles overlap"):
        jb.mapped(jb.rectangle(7.0, 1.0, 30, 3), ring)
    # It moves the nodes in the middle of edges along them, by more than a quarter of their length.
    wavy = lambda x, y: (x + 0.1 * np.sin(4.5 * np.pi * (x + 1)), y)
    with pytest.raises(ValueError, match=r"shape: the body .* folds over"):
        jb.mapped(jb.rectangle(2.0, 0.1, 10, 2, order=2), wavy)
    with pytest.raises(ValueError, match=r"mesh: expected triangles, got the Line of a rod"):
        jb.mapped(jb.rod_beam(3).mesh, lambda x, y: (x, y))


def test_a_traced_shape_that_turns_triangles_over_is_nan():
    nodes = jax.jit(lambda slope: jb.mapped(jb.rectangle(2.0, 1.0, 5, 3), taper(slope)).nodes)
    assert np.isfinite(nodes(0.9)).all()
    assert np.isnan(nodes(1.5)).all()


# ------------------------------------------------------------------------------------- the shaped beam


@pytest.mark.parametrize("settings", [{}, {"order": 2, "graded": True, "diagonals": "crossed"}])
def test_a_shaped_beam_is_held_and_steered_by_the_same_nodes(settings):
    plain, bent = (jb.tendon_beam(7, 4 - 1, shape=shape, **settings) for shape in (None, sector))
    np.testing.assert_array_equal(bent.fixed, plain.fixed)
    np.testing.assert_array_equal(bent.tip, plain.tip)
    np.testing.assert_array_equal(bent.terms[1].nodes, plain.terms[1].nodes)
    np.testing.assert_allclose(np.stack(sector(*plain.mesh.nodes.T), axis=1), bent.mesh.nodes, atol=4 * EPS)
    # Chords of circles of radius 2 -+ 0.4, over the angle of half the length.
    chords = 2 * np.array([1.6, 2.4]) * np.sin(LENGTH / 8)
    np.testing.assert_allclose(jb.tendon_lengths(bent, bent.mesh.nodes), chords, rtol=1e-14)


def test_a_shape_that_moves_nothing_changes_nothing():
    plain, same = (jb.tendon_beam(5, 3, shape=shape, anchor_width=0.3) for shape in (None, lambda x, y: (x, y)))
    assert jax.tree.structure(plain) == jax.tree.structure(same)
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(same), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_wide_anchor_needs_a_concrete_shape():
    with pytest.raises(ValueError, match=r"anchor_width: expected 0 on a body whose .* shape is traced, got 0\.3"):
        jax.jit(lambda slope: jb.tendon_beam(5, 3, shape=taper(slope), anchor_width=0.3).mesh.nodes)(0.1)


def test_tip_angle_differentiates_in_the_taper():
    """Against differences of solutions of meshes that are built anew."""

    @jax.jit
    @jax.value_and_grad
    def angle(slope):
        scene = jb.command(jb.tendon_beam(5, 3, shape=taper(slope)), [0.8, 1.0])
        return jb.tip_angle(scene, jb.equilibrium(scene, solver=jb.Newton(rtol=1e-12)).x)

    (value, slope), h = angle(0.1), 1e-5
    assert value > 1
    np.testing.assert_allclose(slope, (angle(0.1 + h)[0] - angle(0.1 - h)[0]) / (2 * h), rtol=1e-6)


# ------------------------------------------------------------------------------------------------- holes


@pytest.mark.parametrize("order", [1, 2])
def test_without_cuts_a_hole(order):
    square = jb.rectangle(4.0, 4.0, 5, 5, order=order)
    hole = jb.elements_where(square, lambda x, y: (abs(x) < 1) & (abs(y) < 1))
    mesh, old = jb.without(square, hole)
    np.testing.assert_allclose(rest_area(mesh), 16 - 4, rtol=1e-13)
    np.testing.assert_array_equal(mesh.nodes, square.nodes[old])
    np.testing.assert_array_equal(old[mesh.elements], np.delete(square.elements, hole, axis=0))
    assert len(jb.surface_lines(mesh)) == 2
    assert set(range(len(square.nodes))) - set(old) == set(
        jb.nodes_where(square, lambda x, y: (abs(x) < 0.99) & (abs(y) < 0.99))
    )


def test_without_differentiates():
    def second_moment(side):
        mesh, _ = jb.without(jb.rectangle(side, 1.0, 4, 2), [0, 1])
        return jnp.sum(mesh.nodes[:, 0] ** 2)

    # Columns at -1/6, 1/6 and 1/2 of the length stay, of two nodes each.
    np.testing.assert_allclose(
        jax.jit(jax.grad(second_moment))(3.0), 2 * 2 * 3.0 * (1 / 36 + 1 / 36 + 1 / 4), rtol=1e-13
    )


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        (range(8), r"elements: all 8 elements are removed, and no body is left"),
        ([8], r"elements: 8 is out of range, elements are numbered 0 to 7"),
        ([-1], r"elements: -1 is out of range"),
        (
            np.ones(8, bool),
            r"elements: expected whole numbers of shape \(m,\), got .* bool; find them with elements_wh",
        ),
        ([], r"elements: expected whole numbers"),
        ([[0, 1]], r"elements: expected whole numbers of shape \(m,\), got shape \(1, 2\)"),
    ],
)
def test_without_refuses(elements, message):
    with pytest.raises(ValueError, match=message):
        jb.without(jb.rectangle(2.0, 1.0, 3, 3), elements)


def test_pressure_in_a_chamber():
    """The force on a node of the wall is half the pressure times the chord between its neighbours, turned outwards."""
    flat = jb.rectangle(4.0, 2.0, 9, 7)
    hole = jb.elements_where(flat, lambda x, y: (abs(x) < 1) & (abs(y) < 0.6))
    mesh, _ = jb.without(flat, hole)
    outside, wall = jb.surface_lines(mesh)
    assert 0 in outside and 0 not in wall
    rest = np.asarray(mesh.nodes)
    chord = rest[np.roll(wall, -1)] - rest[np.roll(wall, 1)]
    body, blown = jb.solid(mesh, jb.lame(1e4, 0.3)), jb.pressure(mesh, wall, 3.0)
    left = jb.nodes_where(mesh, lambda x, y: x < -1.99)
    scene = jb.Scene(mesh, (body, blown), jb.clamped(mesh, left))
    found = np.asarray(jb.forces(scene, scene.mesh.nodes))
    expected = np.zeros_like(rest)
    # Along the wall the body lies on the left: so do the forces.
    expected[wall] = 1.5 * np.stack([-chord[:, 1], chord[:, 0]], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    # The chamber pushes outwards: to the right on its right wall.
    assert (expected[wall][rest[wall, 0] > 0.99, 0] > 0).all()


# ------------------------------------------------------------------------------------------- two bodies


def fingers(mesh, nodes, crossing=()):
    """A scene of bodies with these nodes: each clamped at its left edge, with a tendon along half of its lower side."""
    clamp = np.concatenate([each[:3] for each in nodes])
    terms = [jb.solid(mesh, jb.lame(1e4, 0.4)), jb.tendons(mesh, [each[[0, 6]] for each in nodes], 2e2)]
    terms += [jb.cables(mesh, [crossing], 2e2)] if len(crossing) else []
    return jb.Scene(mesh, tuple(terms), jb.clamped(mesh, clamp), nodes[-1][12:])


def test_two_fingers_are_solved_as_if_alone():
    one = jb.mapped(jb.rectangle(2.0, 0.4, 5, 3, "mirrored"), taper(0.2))
    other = jb.mapped(one, lambda x, y: (x, y + 2.0))
    mesh, nodes, elements = jb.joined([one, other])
    assert mesh.nodes.shape == (30, 2)
    np.testing.assert_array_equal(mesh.nodes[nodes[1]], other.nodes)
    np.testing.assert_array_equal(mesh.elements[elements[1]], nodes[1][other.elements])
    alone = [jb.command(fingers(m, [np.arange(15)]), [r]) for m, r in ((one, 0.8), (other, 0.9))]
    tips = [each[13] for each in nodes]
    pair = fingers(mesh, nodes, tips)
    x = jb.check(jb.equilibrium(jb.command(pair, [0.8, 0.9, 2.0]))).x
    for body, scene in zip(nodes, alone, strict=True):
        # The cable between them is slack. The residual is relative to the largest force of both.
        np.testing.assert_allclose(x[body], jb.check(jb.equilibrium(scene)).x, atol=1e-7)

    # The cable pulls the tips together. Without the tendons below, each finger is the mirror image of the other.
    sides = jb.tendons(mesh, [nodes[0][[0, 6]], nodes[1][[2, 8]]], 2e2)
    grip = jb.Scene(mesh, (pair.terms[0], sides, pair.terms[2]), pair.fixed, pair.tip)
    x = jb.check(jb.equilibrium(jb.command(grip, [1.0, 1.0, 0.8]))).x
    rise = np.asarray(x - mesh.nodes)[tips, 1]
    assert rise[0] > 0.01
    np.testing.assert_allclose(rise[1], -rise[0], rtol=1e-6)
    np.testing.assert_allclose(jb.tendon_lengths(grip, x)[2], 2.0 - 2 * rise[0], rtol=1e-6)


def test_joined_differentiates_in_each_body():
    def width(gap):
        one = jb.rectangle(1.0, 1.0, 2, 2)
        mesh, nodes, _ = jb.joined([one, jb.mapped(one, lambda x, y: (x + gap, y))])
        return jnp.sum(mesh.nodes[nodes[1], 0])

    np.testing.assert_allclose(jax.jit(jax.grad(width))(2.0), 4.0, rtol=1e-15)


ONE = jb.rectangle(1.0, 1.0, 2, 2)


@pytest.mark.parametrize(
    ("meshes", "message"),
    [
        ([], r"meshes: expected a list of meshes"),
        (ONE, r"meshes: expected a list of meshes, got a Mesh; give joined\(\[one, other\]\)"),
        ([ONE, ONE.nodes], r"meshes\[1\]: expected a Mesh"),
        ([ONE, jb.quadratic(ONE)], r"meshes\[1\]: expected elements of 3 nodes .*, got 6; use quadratic"),
        ([ONE, jb.rectangle(1.0, 1.0, 2, 2, dtype=np.float32)], r"meshes\[1\]: expected nodes of float64 .* float32"),
        ([ONE, jb.mapped(ONE, lambda x, y: (x + 1, y))], r"meshes: the bodies touch or overlap.* nodes 2 and 4 coin"),
        ([ONE, jb.mapped(ONE, lambda x, y: (x + 0.5, y + 0.5))], r"meshes: the bodies touch or overlap.*overlap"),
    ],
)
def test_joined_refuses(meshes, message):
    with pytest.raises(ValueError, match=message):
        jb.joined(meshes)


def test_random_cuts_and_joins_keep_the_area():
    """Of any elements taken away from a body, area and values per element are those of the elements that stay."""
    rng = np.random.default_rng(0)
    mesh = jb.mapped(jb.rectangle(4.0, 2.0, 7, 5), sector)
    for _ in range(20):
        gone = rng.choice(len(mesh.elements), rng.integers(1, 30), replace=False)
        cut, old = jb.without(mesh, gone)
        np.testing.assert_allclose(areas(cut), np.delete(areas(mesh), gone), rtol=1e-12)
        assert (np.diff(old) > 0).all()
        pair, nodes, elements = jb.joined([cut, jb.mapped(mesh, lambda x, y: (x, y + 9.0))])
        np.testing.assert_allclose(areas(pair)[elements[1]], areas(mesh), rtol=1e-12)
        assert sorted(np.concatenate(nodes)) == list(range(len(pair.nodes)))
