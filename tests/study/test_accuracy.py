"""Triangles of six nodes, anchors of finite width, finer meshes and error estimates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import annulus, disturbed, l_shape

import jaxbeam as jb
from jaxbeam.core.tree import replace
from jaxbeam.mesh.surface import patch, surface
from jaxbeam.mesh.triangle import TRIANGLE
from jaxbeam.physics.volume import volume_ratios

MESHES = {
    "rectangle": lambda: jb.rectangle(3.0, 1.0, 4, 3),
    "crossed": lambda: jb.rectangle(3.0, 1.0, 3, 3, "crossed"),
    "irregular": lambda: disturbed(jb.rectangle(3.0, 1.0, 4, 3)),
    "L": l_shape,
}


def tension(scene, x):
    return jb.tendon_tensions(scene, x)[0]


def area(mesh):
    return float(np.sum(jb.solid(mesh, jb.lame(1.0, 0.3)).params.weights))


# --------------------------------------------------------------------------------------- finer meshes


@pytest.mark.parametrize("name", MESHES)
def test_quadratic_mesh_holds_every_quadratic_displacement(name):
    """Patch test: the energy of a quadratic field in linear elasticity is its integral."""
    mesh = jb.quadratic(MESHES[name]())
    X = mesh.nodes
    u = jnp.stack([0.3 * X[:, 0] ** 2 - X[:, 0] * X[:, 1], 0.2 * X[:, 1] ** 2 + X[:, 0] * X[:, 1]], axis=1)
    term = jb.solid(mesh, jb.lame(1.0, 0.3), jb.linear_elastic)
    scene = jb.Scene(mesh, (term,), jb.clamped(mesh, [0]))

    def density(x):
        H = jax.jacfwd(lambda p: jnp.stack([0.3 * p[0] ** 2 - p[0] * p[1], 0.2 * p[1] ** 2 + p[0] * p[1]]))(x)
        return jb.linear_elastic(H, jb.lame(1.0, 0.3))

    points, shares = TRIANGLE.rule(4)
    corners = np.asarray(X)[mesh.elements[:, :3]]
    at = np.einsum("qk,mkd->mqd", points, corners).reshape(-1, 2)
    areas = np.asarray(term.params.weights).sum(axis=1)
    exact = np.sum(np.asarray(jax.vmap(density)(at)).reshape(-1, len(shares)) @ shares * areas)
    assert float(jb.energy(scene, X + u)) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("order", [1, 2])
def test_finer_mesh_contains_the_coarse(name, order):
    """Same area, positive elements, and a displacement carried over has the same energy and forces in it."""
    coarse = MESHES[name]() if order == 1 else jb.quadratic(MESHES[name]())
    fine = jb.refined(coarse)
    assert fine.elements.shape == (4 * len(coarse.elements), coarse.elements.shape[1])
    assert area(fine) == pytest.approx(area(coarse), rel=1e-13)
    np.testing.assert_array_equal(fine.nodes[: len(coarse.nodes)], coarse.nodes)
    pull = jb.dead_load(coarse, [1], [0.0, 1.0])
    # Degree 4 integrates the energy of a quadratic displacement exactly.
    body = jb.solid(coarse, jb.lame(1.0, 0.3), degree=1 if order == 1 else 4)
    scene = jb.Scene(coarse, (body, pull), jb.clamped(coarse, [0]))
    finer, way = jb.enriched(scene)
    x = coarse.nodes + 0.05 * np.random.default_rng(1).normal(size=coarse.nodes.shape)
    if order == 1:
        finer = jb.Scene(finer.mesh, (jb.solid(finer.mesh, jb.lame(1.0, 0.3), degree=4), pull), finer.fixed)
    assert float(jb.energy(finer, way.carry(x))) == pytest.approx(float(jb.energy(scene, x)), rel=1e-12)
    # What the finer forces do to a coarse displacement is what the coarse ones do.
    dx = np.random.default_rng(2).normal(size=coarse.nodes.shape)
    states = (scene, x, dx), (finer, way.carry(x), way.carry(dx))
    work = [float(jnp.sum(jb.forces(s, y) * d)) for s, y, d in states]
    assert work[1] == pytest.approx(work[0], rel=1e-10)


def test_enriched_scene_is_fixed_where_the_coarse_one_is():
    scene = jb.tendon_beam(5, 3, order=1, anchor_width=0.5)
    for _ in range(2):
        finer, _ = jb.enriched(scene)
        x = np.asarray(finer.mesh.nodes)
        np.testing.assert_array_equal(finer.fixed.all(axis=1), x[:, 0] < x[:, 0].min() + 1e-9)
        np.testing.assert_array_equal(np.isin(np.arange(len(x)), finer.tip), x[:, 0] > x[:, 0].max() - 1e-9)
        assert not finer.fixed[:, 0].any() ^ finer.fixed[:, 1].any()
        scene = finer


# ---------------------------------------------------------------------------------------------- anchors


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("width", [0.1, 0.25, 0.7])
def test_patch_is_the_mean_of_the_surface(order, width):
    """Weights add up to 1; a position, and for six nodes a quadratic of it, has the mean of the tent."""
    mesh = jb.rectangle(3.0, 1.0, 13, 3, order=order)
    node = jb.nearest_node(mesh, [0.25, 0.5])
    nodes, weights = patch(mesh, node, width)
    assert nodes[0] == node and weights.sum() == pytest.approx(1, abs=1e-14)
    X = np.asarray(mesh.nodes)[nodes]
    assert (X[:, 1] == 0.5).all() and (np.abs(X[:, 0] - 0.25) < width + 0.25).all()
    assert weights @ X[:, 0] == pytest.approx(0.25, abs=1e-14)
    if order == 2:
        # The second moment of the tent over (-w, w) is w^2 / 6.
        assert weights @ (X[:, 0] - 0.25) ** 2 == pytest.approx(width**2 / 6, rel=1e-12)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("place", [[1.0, 0.5], [1.0, -0.5], [0.5, 0.5], [1.0, 0.0], [0.0, -0.5]])
@pytest.mark.parametrize("width", [0.3, 0.6, 0.9, 100.0])
def test_an_anchor_is_at_its_node(order, place, width):
    """At a corner, beside one and in the middle of a side, whether the patch ends at a corner or not: the weighted mean
    is the node, and a force at the anchor has the moment of one at the node."""
    mesh = jb.rectangle(2.0, 1.0, 9, 5, order=order)
    node = jb.nearest_node(mesh, place)
    nodes, weights = patch(mesh, node, width)
    at = np.asarray(mesh.nodes)[nodes]
    np.testing.assert_allclose(weights.sum(), 1, rtol=1e-13)
    np.testing.assert_allclose(weights @ at, place, atol=1e-13)
    # It lies on the sides that the node is on, and on no other.
    sides = [np.abs(at[:, k] - place[k]) < 1e-12 for k in (0, 1) if abs(place[k]) == (1.0, 0.5)[k]]
    assert np.any(sides, axis=0).all()


def test_a_patch_on_a_gentle_bend_is_a_tent():
    """On a ring of 96 edges it has positive weights, and its mean lies inside by the bend alone."""
    mesh = annulus(96, 3)
    rest = np.asarray(mesh.nodes)
    node = int(np.argmax(np.linalg.norm(rest, axis=1)))
    radius = np.linalg.norm(rest[node])
    nodes, weights = patch(mesh, node, 0.25 * radius)
    assert (weights > 0).all() and len(nodes) > 5
    # `s^2 / (2 R)` under a tent; the rest is that the ring is a polygon.
    inside = radius - np.linalg.norm(weights @ rest[nodes])
    np.testing.assert_allclose(inside, 0.25**2 / 12 * radius, rtol=0.1)
    with pytest.raises(ValueError, match="shorter than the width"):
        patch(mesh, node, 100.0)


def test_patches_are_refused_off_the_surface():
    mesh = jb.rectangle(2.0, 1.0, 5, 3)
    assert len(surface(mesh)) == 2 * (4 + 2)
    with pytest.raises(ValueError, match="not a corner on the surface"):
        patch(mesh, jb.nearest_node(mesh, [0.0, 0.0]), 0.1)
    with pytest.raises(ValueError, match="anchor_width: expected a finite number of at least 0"):
        jb.tendon_beam(5, 3, anchor_width=-1.0)


def test_patch_of_two_triangles_that_touch_at_a_node():
    """It stays on the sides of its own corner."""
    nodes = np.array([[0.0, 0.0], [-2.0, 1.0], [-2.0, -1.0], [2.0, -1.0], [2.0, 1.0]])
    mesh = jb.Mesh(nodes, [[0, 1, 2], [0, 3, 4]])
    for node, own in ((1, {0, 1, 2}), (3, {0, 3, 4})):
        members, weights = patch(mesh, node, 1e3)
        assert set(members.tolist()) == own
        np.testing.assert_allclose(weights @ nodes[members], nodes[node], atol=1e-12)


def test_no_width_is_a_point():
    """As it was: a term of two nodes, without weights."""
    term = jb.tendon_beam(5, 3).terms[1]
    assert term.nodes.shape == (2, 2) and term.params.attachment is None
    narrow, wide = (jb.tendon_beam(5, 3, anchor_width=w) for w in (1e-9, 0.3))
    x = narrow.mesh.nodes + 0.01 * np.random.default_rng(0).normal(size=narrow.mesh.nodes.shape)
    close = jb.energy(jb.tendon_beam(5, 3), x)
    assert float(jb.energy(narrow, x)) == pytest.approx(float(close), rel=1e-8)
    assert float(jb.energy(wide, x)) != pytest.approx(float(close), rel=1e-8)


@pytest.mark.slow
def test_wide_anchors_settle_and_points_drift():
    """The angle at ratio 0.8 on six-node triangles: settled with a width, falling without."""
    settled, drifting = [], []
    for nx, ny in ((15, 5), (29, 7)):
        for width, out in ((0.25, settled), (0.0, drifting)):
            scene = jb.command(jb.tendon_beam(nx, ny, order=2, graded=True, anchor_width=width), [0.8, 1.0])
            out.append(float(jb.tip_angle(scene, jb.check(jb.equilibrium(scene)).x)))
    np.testing.assert_allclose(settled, 10.142, rtol=1e-3)
    assert drifting[0] - drifting[1] > 10 * abs(settled[0] - settled[1])


# ------------------------------------------------------------------------------------- error estimates


@pytest.fixture(scope="module")
def coarse():
    scene = jb.command(jb.tendon_beam(7, 3, order=2, anchor_width=0.25), [0.8, 1.0])
    return scene, jb.check(jb.equilibrium(scene))


@pytest.mark.parametrize(("measure", "exact"), [(jb.tip_angle, 10.142), (tension, 209.72)])
def test_estimate(coarse, measure, exact):
    """Converged values from graded meshes of up to 57 x 13 corners."""
    found = jb.estimate_error(*coarse, measure)
    true = exact - found.value
    assert found.reason == "" and abs(found.algebraic) < 1e-6 * abs(true)
    assert 0.5 < found.discretisation / true < 2
    assert abs(true) < found.bar < 3 * abs(true)


def test_algebraic_part_is_what_newton_left(coarse):
    """Of a state that is a little out of balance, in a direction that turns the tip."""
    scene, exact = coarse
    aside = 1e-4 * np.where(scene.fixed, 0, np.asarray(exact.x) - scene.mesh.nodes)
    loose = replace(exact, x=exact.x + aside)
    found = jb.estimate_error(scene, loose, jb.tip_angle)
    left = float(jb.tip_angle(scene, exact.x) - jb.tip_angle(scene, loose.x))
    assert abs(left) > 1e-6 and found.algebraic == pytest.approx(left, rel=0.2)


def test_solve_to_climbs_as_far_as_it_must(coarse, terminal):
    scene, _ = coarse
    easy = jb.solve_to(scene, jb.tip_angle, 1.0, progress=True)
    line, cursor = terminal.lines()
    assert line.startswith(f"1 meshes, error bar {easy.estimate.bar:.2e}, 0:") and cursor == ""
    assert easy.met and easy.rung == 0 and easy.scene is scene
    calls = []
    hard = jb.solve_to(scene, jb.tip_angle, 0.1, progress=lambda *call: calls.append(call))
    assert calls == [(1, easy.estimate.bar), (2, hard.estimate.bar)]
    assert hard.met and hard.rung == 1 and hard.estimate.bar <= 0.1
    assert abs(hard.value - 10.142) <= hard.estimate.bar
    assert int(hard.solution.steps) < int(coarse[1].steps)
    never = jb.solve_to(scene, jb.tip_angle, 1e-9, most=100)
    assert not never.met and never.rung == 0 and never.estimate.bar > 1e-9


def test_no_mesh_is_refined_for_a_tolerance_below_round_off(coarse):
    scene, _ = coarse
    for tolerance in (1e-300, 1e-15):
        never = jb.solve_to(scene, jb.tip_angle, tolerance)
        assert not never.met and never.rung == 0 and never.scene is scene


def test_nothing_is_certified_that_has_no_limit(coarse):
    scene, solution = coarse
    # The equilibrium of the wide anchors does as well: what is said is by the scene.
    point = jb.command(jb.tendon_beam(7, 3, order=2), [0.8, 1.0])
    found = jb.estimate_error(point, solution, jb.tip_angle)
    assert found.bar == np.inf and "single node" in found.reason
    failed = replace(solution, status=jnp.int32(jb.Status.NOT_CONVERGED))
    found = jb.estimate_error(scene, failed, jb.tip_angle)
    assert found.bar == np.inf and "not OK" in found.reason
    with pytest.raises(ValueError, match="measure: expected a function that returns a scalar"):
        jb.estimate_error(scene, solution, jb.tendon_tensions)
    with pytest.raises(ValueError, match="tolerance: expected a positive finite number"):
        jb.solve_to(scene, jb.tip_angle, 0.0)
    with pytest.raises(ValueError, match="scene: expected a mesh of known nodes"):
        jax.jit(lambda s: jb.enriched(s)[1].weights)(scene)
    with pytest.raises(ValueError, match="inside jit use corrected"):
        jax.jit(lambda s: jb.estimate_error(s, solution, jb.tip_angle).bar)(scene)


# ----------------------------------------------------------------------------------------------- locking


def mean_pressures(scene, x):
    """`lam (J - 1)` averaged over each element, and its steps from each element to its neighbours."""
    params, nodes = scene.terms[0].params, scene.terms[0].nodes
    ratios = np.asarray(volume_ratios(x[nodes], params)).T
    shares = np.asarray(params.weights / params.weights.sum(axis=1, keepdims=True))
    pressure = np.asarray(params.material.lam) * np.sum(shares * (ratios - 1), axis=1)
    sides = np.sort(nodes[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, number, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    shared = np.flatnonzero(count[number.ravel()] == 2)
    pairs = shared[np.argsort(number.ravel()[shared], kind="stable")].reshape(-1, 2) // 3
    return pressure, np.abs(pressure[pairs[:, 0]] - pressure[pairs[:, 1]])


@pytest.mark.slow
def test_six_nodes_do_not_lock():
    """At Poisson's ratio 0.4999, where three nodes do not bend at all: within 0.5 % of the limit 9.640, with a pressure
    that is smooth from element to element and of the size of that on the finest meshes, -800 to 300."""
    angles, pressures = [], []
    for mesh in ({"nx": 29, "ny": 7}, {"nx": 15, "ny": 5, "order": 2, "graded": True, "diagonals": "crossed"}):
        scene = jb.tendon_beam(**mesh, poisson=0.4999, anchor_width=0.25)
        path = jb.check(jb.ramp(scene, [0.8, 1.0], steps=9))
        angles.append(float(jb.tip_angle(scene, path.x[-1])))
        pressures.append(mean_pressures(scene, path.x[-1]))
    assert angles[0] < 0 and angles[1] == pytest.approx(9.640, rel=5e-3)
    low, high = np.percentile(pressures[1][0], [2, 98])
    assert -900 < low < -400 and 100 < high < 400
    assert np.median(pressures[1][1]) < 0.05 * (high - low)
    assert np.ptp(np.percentile(pressures[0][0], [2, 98])) > 5 * (high - low)


@pytest.mark.slow
def test_linear_response_is_the_slope_at_rest():
    scene = jb.tendon_beam(5, 3, order=2, anchor_width=0.3)
    bent = lambda ratio: jb.tip_angle(scene, jb.linear_response(jb.command(scene, jnp.array([ratio, 1.0]))))
    exact = lambda ratio: jb.tip_angle(scene, jb.equilibrium(jb.command(scene, jnp.array([ratio, 1.0]))).x)
    assert float(bent(0.9999)) == pytest.approx(float(exact(0.9999)), rel=1e-3)
    assert float(bent(1.0)) == 0
