"""Curvature of lines of nodes, and markers anywhere in the body."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import affine, disturbed, rotation

import jaxbeam as jb

BEND = lambda x, y: ((2 - y) * np.sin(x / 1.2), 2 - (2 - y) * np.cos(x / 1.2))


def scene_of(mesh):
    return jb.Scene(mesh, (jb.solid(mesh, jb.lame(1e4, 0.3)),), jb.clamped(mesh, [0]))


FLAT = jb.rectangle(3.0, 1.0, 7, 3, order=2)
BENT = jb.mapped(FLAT, BEND)
SCENES = {"straight": scene_of(disturbed(jb.rectangle(3.0, 1.0, 7, 3))), "curved": scene_of(BENT)}

# --------------------------------------------------------------------------------------------- curvature


def test_curvature_of_a_circle():
    """Exact, however unevenly the nodes are spaced; positive where the line turns to the left."""
    mesh = jb.rectangle(3.0, 1.0, 7, 3, graded=True)
    scene, lower, upper = scene_of(mesh), jb.side(mesh, 0, 18), jb.side(mesh, 20, 2)
    x = jnp.stack(BEND(*np.asarray(mesh.nodes).T), axis=1)
    np.testing.assert_allclose(jb.curvature(scene, x, lower), np.full(5, 1 / 2.5), rtol=1e-12)
    np.testing.assert_allclose(jb.curvature(scene, x, upper), np.full(5, -1 / 1.5), rtol=1e-12)
    np.testing.assert_allclose(jb.curvature(scene, mesh.nodes, lower), np.zeros(5), atol=1e-12)


def test_curvature_of_the_reference_beam(steered):
    """Along the middle line the tangent turns by the curvature: at the tip, where there is no shear, to the rotation of
    the section there."""
    scene, x = steered[0], steered[1].x
    line = 7 * np.arange(29) + 3
    place = np.asarray(x)[line]
    steps = np.diff(place, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    turn = np.sum(np.asarray(jb.curvature(scene, x, line)) * (lengths[1:] + lengths[:-1]) / 2)
    start = np.arctan2(steps[0, 1], steps[0, 0])
    # The sum takes angles for their tangents.
    np.testing.assert_allclose(np.degrees(start + turn), jb.section_rotation(scene, x), rtol=2e-3)


def test_curvature_of_a_rod_and_of_a_closed_line():
    scene = jb.rod_beam(9, length=4.0)
    angle = scene.mesh.nodes[:, 0] / 3
    x = jnp.stack([3 * jnp.sin(angle), -3 * jnp.cos(angle), 0.8 * angle], axis=1)
    np.testing.assert_allclose(jb.curvature(scene, x, np.arange(9)), np.full(7, 1 / 3), rtol=1e-12)
    around = jb.surface_lines(FLAT)[0]
    closed = jb.curvature(scene_of(FLAT), FLAT.nodes, np.append(around, around[:2]))
    assert closed.shape == around.shape
    # Corners stand out: the circle through a corner and nodes 0.25 beside it on each side has the chord as diameter.
    assert (np.asarray(closed) > -1e-12).all() and np.count_nonzero(np.asarray(closed) > 1e-9) == 4


def test_curvature_differentiates_and_maps():
    scene, line = SCENES["curved"], jb.side(BENT, 0, 18)
    size = lambda s: jb.curvature(scene, scene.mesh.nodes * s, line)
    value, slope = jax.jit(lambda s: jax.jvp(size, (s,), (1.0,)))(2.0)
    # Curvature is 1 / length.
    np.testing.assert_allclose(slope, -value / 2, rtol=1e-10)
    many = jax.vmap(size)(jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(many[0], 2 * many[1], rtol=1e-12)


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([0, 1], r"nodes: expected at least three nodes of a line, got 2"),
        ([0, 1, 1], r"nodes: \[0, 1, 1\] follow each other, expected three different nodes"),
        ([3, 0, 1, 0], r"nodes: \[0, 1, 0\] follow each other"),
        ([0, 1, 99], r"nodes: 99 is out of range"),
    ],
)
def test_curvature_refuses(nodes, message):
    with pytest.raises(ValueError, match=message):
        jb.curvature(SCENES["curved"], BENT.nodes, nodes)


# ----------------------------------------------------------------------------------------------- markers


def points_in(name, count=100, seed=0):
    """Random points of the bodies: the straight one fills its rectangle, the curved one nearly."""
    rng = np.random.default_rng(seed)
    if name == "straight":
        return rng.uniform([-1.4, -0.4], [1.4, 0.4], (count, 2))
    # Parabolas leave the arcs by up to 3e-5.
    return np.stack(BEND(*rng.uniform([-1.4999, -0.4999], [1.4999, 0.4999], (count, 2)).T), axis=1)


@pytest.mark.parametrize("name", SCENES)
def test_markers_are_where_they_are_put(name):
    scene, points = SCENES[name], points_in(name)
    many = jb.marker(scene, points)
    np.testing.assert_allclose(many(scene, scene.mesh.nodes), points, atol=1e-14)
    # A linear field is represented exactly, on curved elements too.
    F = 2 * rotation(1.0)
    np.testing.assert_allclose(many(scene, affine(scene.mesh, F, (1, 2))), points @ F.T + [1, 2], atol=1e-13)
    _, weights = many.weights(scene.mesh)
    np.testing.assert_allclose(weights.sum(axis=1), np.ones(100), rtol=1e-14)
    assert np.asarray(many.places).min() > -1e-9
    assert jb.marker(scene, points[3])(scene, scene.mesh.nodes).shape == (2,)


def test_a_quadratic_field_is_followed_exactly():
    """On straight six-node triangles, of an irregular mesh."""
    mesh = jb.quadratic(disturbed(jb.rectangle(3.0, 1.0, 7, 3)))
    points = points_in("straight")
    field = lambda x, y: np.stack([x + 0.2 * x * y - 0.1 * y**2, y + 0.3 * x**2], axis=-1)
    x = jnp.asarray(field(*np.asarray(mesh.nodes).T))
    scene = scene_of(mesh)
    np.testing.assert_allclose(jb.marker(scene, points)(scene, x), field(*points.T), atol=1e-14)


@pytest.mark.parametrize("name", SCENES)
def test_nodes_and_edges_are_points_of_the_body(name):
    scene = SCENES[name]
    rest = np.asarray(scene.mesh.nodes)
    x = jnp.asarray(rest + np.random.default_rng(0).normal(size=rest.shape))
    np.testing.assert_allclose(jb.marker(scene, rest)(scene, x), x, atol=1e-8)
    if name == "straight":
        line = jb.surface_lines(scene.mesh)[0]
        middles = lambda places: (places[line] + places[np.roll(line, 1)]) / 2
        np.testing.assert_allclose(jb.marker(scene, middles(rest))(scene, x), middles(np.asarray(x)), atol=1e-8)


@pytest.mark.parametrize("name", SCENES)
def test_a_marker_stays_on_finer_meshes(name):
    scene, points = SCENES[name], points_in(name)
    many = jb.marker(scene, points)
    for finer in (jb.refined(jb.refined(scene.mesh)), jb.enriched(scene)[0].mesh):
        np.testing.assert_allclose(many(scene_of(finer), finer.nodes), points, atol=1e-14)


def test_a_marker_serves_a_traced_body():
    """It is the same place of the same element: of a tapered body, the image of the point of the rectangle."""
    flat = scene_of(FLAT)
    point = jb.marker(flat, [0.3, 0.25])

    def height(slope):
        mesh = jb.mapped(FLAT, lambda x, y: (x, y * (1 - slope * x)))
        return point(scene_of(mesh), mesh.nodes)[1]

    value, slope = jax.jit(jax.value_and_grad(height))(0.2)
    np.testing.assert_allclose([value, slope], [0.25 * (1 - 0.06), -0.25 * 0.3], rtol=1e-13)


def test_a_marker_is_compared_by_value_and_maps():
    scene = SCENES["curved"]
    one, same = (jb.marker(scene, points_in("curved")[0]) for _ in range(2))
    assert one == same and hash(one) == hash(same)
    states = jnp.stack([scene.mesh.nodes, 2 * scene.mesh.nodes])
    found = jax.jit(jax.vmap(lambda x: one(scene, x)))(states)
    np.testing.assert_allclose(found[1], 2 * found[0], rtol=1e-14)
    slope = jax.jit(jax.jacfwd(lambda x: one(scene, x)))(scene.mesh.nodes)
    # Linear in the positions, with weights of sum 1.
    np.testing.assert_allclose(slope.sum(axis=1), np.eye(2), atol=1e-14)


def test_digits_far_from_the_origin():
    mesh = jb.mapped(FLAT, lambda x, y: (x + 1e6, y))
    scene = scene_of(mesh)
    found = jb.marker(scene, [1e6 + 0.125, 0.2])(scene, mesh.nodes)
    np.testing.assert_allclose(found, [1e6 + 0.125, 0.2], atol=2e-10)


def test_float32():
    mesh = jb.mapped(jb.rectangle(3.0, 1.0, 7, 3, dtype=np.float32, order=2), BEND)
    scene, points = scene_of(mesh), points_in("curved", 20)
    found = jb.marker(scene, points)(scene, mesh.nodes)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, points, atol=1e-6)
    corner = np.stack(BEND(-1.5, -0.5))
    np.testing.assert_allclose(jb.marker(scene, corner)(scene, mesh.nodes), corner, atol=1e-6)


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ([1.7, 0.2], r"point: expected a point of the body at rest, got \(1\.7, 0\.2\), .* at a distance of 0\.2 from"),
        ([[0.0, 0.0], [-1.8, 0.9]], r"point\[1\]: .* outside at a distance of 0\.5 from .* x spans \[-1\.5, 1\.5\]"),
        ([0.0, np.nan], r"point: expected finite numbers"),
        ([0.0], r"point: expected shape \(2,\) or \(m, 2\), got \(1,\)"),
        ("here", r"point: expected real numbers"),
    ],
)
def test_marker_refuses(point, message):
    with pytest.raises(ValueError, match=message):
        jb.marker(scene_of(FLAT), point)


def test_the_distance_from_a_curved_body_and_from_a_hole():
    # The centre of the arcs is 1.5 from the inner one.
    with pytest.raises(ValueError, match=r"outside at a distance of 1\.5 from its surface"):
        jb.marker(SCENES["curved"], [0.0, 2.0])
    square = jb.rectangle(3.0, 3.0, 4, 4)
    ring, _ = jb.without(square, jb.elements_where(square, lambda x, y: (abs(x) < 0.5) & (abs(y) < 0.5)))
    with pytest.raises(ValueError, match=r"outside at a distance of 0\.4 from its surface"):
        jb.marker(scene_of(ring), [0.1, 0.0])


def test_a_marker_refuses_other_meshes():
    point = jb.marker(scene_of(FLAT), [0.0, 0.0])
    other = scene_of(jb.rectangle(3.0, 1.0, 4, 3))
    with pytest.raises(ValueError, match=r"scene: expected the mesh of 24 elements .*, got 12 elements; make another"):
        point(other, other.mesh.nodes)
    with pytest.raises(ValueError, match="scene: expected a body of triangles, got a rod"):
        jb.marker(jb.rod_beam(3), [0.0, 0.0])
    with pytest.raises(ValueError, match="scene, point: expected known positions at rest"):
        jax.jit(lambda p: jb.marker(scene_of(FLAT), p)(scene_of(FLAT), FLAT.nodes))(jnp.zeros(2))


@pytest.mark.slow
def test_a_marker_is_a_measure():
    """`reach` finds the commands for the place of a point of the body."""
    scene = jb.tendon_beam(5, 3)
    point = jb.marker(scene, [1.2, 0.1])
    goal = point(scene, jb.equilibrium(jb.command(scene, [0.8, 1.0])).x)
    found = jb.reach(scene, goal, point)
    np.testing.assert_allclose(found.theta, [0.8, 1.0], atol=1e-5)


@pytest.mark.slow
def test_an_error_bar_for_a_marker():
    """The bar holds what four times as many elements change."""
    height = lambda scene, x: point(scene, x)[1]
    scenes = [jb.command(jb.tendon_beam(nx, ny, order=2, anchor_width=0.3), [0.8, 1.0]) for nx, ny in ((9, 3), (33, 9))]
    point = jb.marker(scenes[0], [1.2, 0.1])
    coarse, fine = (jb.check(jb.equilibrium(scene)) for scene in scenes)
    estimate = jb.estimate_error(scenes[0], coarse, height)
    point_of_fine = jb.marker(scenes[1], [1.2, 0.1])
    error = abs(point_of_fine(scenes[1], fine.x)[1] - estimate.value)
    assert 0 < error < estimate.bar < 10 * error
