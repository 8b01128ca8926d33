"""Contact with rigid obstacles: distances, forces, Hertz's pressure, and what a command does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference

import jaxbeam as jb

SHAPES = {
    "half-plane": jb.half_plane([0.3, -0.2], [1.0, 2.0]),
    "disk": jb.disk([0.3, -0.2], 0.7),
    "box": jb.box([0.3, -0.2], [1.0, 0.6], 30.0),
}


def sampled_distance(shape, point):
    """Signed distance from a point to the outline of a shape, from 100,000 points of the outline."""
    t = np.linspace(0, 1, 100_001)
    if shape == "half-plane":
        along = np.array([-2.0, 1.0]) / 5**0.5
        outline, inside = np.array([0.3, -0.2]) + 40 * (t[:, None] - 0.5) * along, (point - [0.3, -0.2]) @ [1, 2] < 0
    elif shape == "disk":
        outline = np.array([0.3, -0.2]) + 0.7 * np.stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t)], axis=1)
        inside = np.linalg.norm(point - [0.3, -0.2]) < 0.7
    else:
        corners = np.array([[-0.5, -0.3], [0.5, -0.3], [0.5, 0.3], [-0.5, 0.3], [-0.5, -0.3]])
        turn = np.array([[np.cos(np.pi / 6), -np.sin(np.pi / 6)], [np.sin(np.pi / 6), np.cos(np.pi / 6)]])
        local = np.stack([np.interp(4 * t, range(5), corners[:, k]) for k in (0, 1)], axis=1)
        outline, own = local @ turn.T + [0.3, -0.2], turn.T @ (point - [0.3, -0.2])
        inside = (np.abs(own) < [0.5, 0.3]).all()
    return np.linalg.norm(outline - point, axis=1).min() * (-1 if inside else 1)


@pytest.mark.parametrize("name", SHAPES)
def test_distances(name):
    shape = SHAPES[name]
    for point in np.random.default_rng(0).uniform(-1.5, 1.5, (40, 2)):
        found = float(shape.distance(jnp.asarray(point), shape.params))
        np.testing.assert_allclose(found, sampled_distance(name, point), atol=1e-3)
        slope = jax.grad(shape.distance)(jnp.asarray(point), shape.params)
        np.testing.assert_allclose(jnp.linalg.norm(slope), 1, rtol=1e-12)


# ------------------------------------------------------------------------------------------------- a beam on a floor


def weighed_down(stiffness=1e5, order=1, floor=-0.45):
    """A clamped beam that its weight presses on a floor below it."""
    mesh = jb.rectangle(3.5, 0.8, 15, 5, order=order)
    below = jb.nodes_where(mesh, lambda x, y: y < -0.3999)
    left = jb.nodes_where(mesh, lambda x, y: x < -1.7499)
    ground = jb.contact(mesh, below, jb.half_plane([0.0, floor], [0.0, 1.0]), stiffness, 1e-4)
    terms = jb.solid(mesh, jb.lame(1e4, 0.45)), jb.weight(mesh, [0.0, -200.0]), ground
    tip = jb.nodes_where(mesh, lambda x, y: x > 1.7499)
    return jb.Scene(mesh, terms, jb.clamped(mesh, left), tip)


@pytest.mark.parametrize("order", [1, 2])
def test_the_floor_carries_what_the_clamp_does_not(order):
    scene = weighed_down(order=order)
    found = jb.check(jb.equilibrium(scene))
    floor, clamp = np.sum(jb.contact_forces(scene, found.x), axis=0), np.sum(jb.reactions(scene, found.x), axis=0)
    np.testing.assert_allclose(floor + clamp, [0, 200 * 3.5 * 0.8], atol=1e-6)
    assert floor[1] > 100 and abs(floor[0]) < 1e-9
    depth = float(jnp.max(jb.penetration(scene, found.x)))
    pressure = float(jnp.max(jb.contact_pressures(scene, found.x)))
    assert 0 < depth < 0.05
    # Beyond the transition it grows by the stiffness with each unit of depth.
    np.testing.assert_allclose(pressure, 1e5 * (depth - 0.5e-4), rtol=1e-9)


def test_depth_falls_as_one_over_the_stiffness():
    """Newton's method needs no more steps for a stiffer floor, up to 1e9."""
    depths, steps = [], []
    for stiffness in (1e5, 1e6, 1e7, 1e9):
        scene = weighed_down(stiffness)
        found = jb.check(jb.equilibrium(scene))
        depths.append(float(jnp.max(jb.penetration(scene, found.x))))
        steps.append(int(found.steps))
    # Less the half of the transition; the pressure itself grows a little as the floor hardens.
    assert depths[1] < 0.2 * depths[0] and depths[2] < 0.02 * depths[0] + 1e-4 and depths[3] < 1e-4
    assert max(steps) < 40


def test_forces_and_stiffness_are_derivatives():
    scene = weighed_down()
    x = np.asarray(scene.mesh.nodes) - np.array([0.0, 0.05])
    x = jnp.asarray(x + 0.002 * np.random.default_rng(0).normal(size=x.shape))
    term = scene.terms[2]
    total = lambda x: jnp.sum(jax.vmap(term.energy)(x[term.nodes], term.params))
    force = np.zeros(x.shape)
    np.add.at(force, term.nodes, np.asarray(term.kind.gradients(x[term.nodes], term.params)[1]))
    assert np.abs(force).max() > 1
    np.testing.assert_allclose(jax.grad(total)(x), force, atol=1e-10)
    some = np.unique(term.nodes[:4])
    at = lambda v: total(x.at[some, 1].set(v))
    np.testing.assert_allclose(force[some, 1], central_difference(at, x[some, 1], 1e-7), rtol=1e-5, atol=1e-6)


# ------------------------------------------------------------------------------------------ an obstacle that moves


def pressed(stiffness=1e7, radius=1.0):
    """A block under a disk, finer where they touch, of six nodes and linear elasticity."""
    plain = jb.rectangle(4.0, 2.0, 17, 9, "crossed")
    x, y = np.asarray(plain.nodes).T
    nodes = np.stack([2 * np.sign(x) * np.abs(x / 2) ** 2.2, 1 - 2 * ((1 - y) / 2) ** 2.2], axis=1)
    mesh = jb.quadratic(jb.Mesh(nodes, plain.elements))
    top, bottom = (jb.nodes_where(mesh, lambda x, y, s=s: s * y > 1 - 1e-9) for s in (1, -1))
    block = jb.solid(mesh, jb.lame(1e4, 0.3), jb.linear_elastic)
    return jb.Scene(
        mesh,
        (block, jb.contact(mesh, top, jb.disk(jnp.array([0.0, 1.0 + radius]), radius), stiffness, 1e-4)),
        jb.clamped(mesh, bottom),
        top,
    )


@pytest.fixture(scope="module")
def block():
    return pressed()


def test_pressure_of_hertz(block):
    """Peak pressure `sqrt(P E' / (pi R))` of a line load `P`, with `E' = E / (1 - nu^2)` (Johnson, "Contact Mechanics",
    1985, section 4.2)."""
    scene = jb.command(block, [-0.03])
    found = jb.check(jb.equilibrium(scene))
    load = -float(jnp.sum(jb.contact_forces(scene, found.x), axis=0)[1])
    peak = (load * 1e4 / (1 - 0.3**2) / np.pi) ** 0.5
    np.testing.assert_allclose(jnp.max(jb.contact_pressures(scene, found.x)), peak, rtol=0.03)


def test_an_obstacle_that_is_moved(block):
    """At rest it touches without force. A ramp, a sweep and slopes follow its command."""
    still = jb.check(jb.equilibrium(block))
    np.testing.assert_array_equal(still.x, block.mesh.nodes)
    load = lambda c: jnp.sum(jb.contact_forces(jb.command(block, c), jb.equilibrium(jb.command(block, c)).x), axis=0)[1]
    at = jnp.array([-0.03])
    np.testing.assert_allclose(jax.grad(load)(at), central_difference(load, at, 1e-6), rtol=1e-5)
    path = jb.check(jb.ramp(block, at, 3))
    batch = jb.check(jb.sweep(block, np.array([[0.0], [-0.03]])))
    expected = jb.equilibrium(jb.command(block, at)).x
    for x in (path.x[-1], batch.x[1]):
        np.testing.assert_allclose(x, expected, atol=1e-8)


def under(obstacle, nx=15):
    """A cantilever under an obstacle that touches it near its tip."""
    mesh = jb.rectangle(3.5, 0.8, nx, 5)
    top, left, tip = (
        jb.nodes_where(mesh, where)
        for where in (lambda x, y: y > 0.3999, lambda x, y: x < -1.7499, lambda x, y: x > 1.7499)
    )
    terms = jb.solid(mesh, jb.lame(1e4, 0.45)), jb.contact(mesh, top, obstacle, 1e5, 1e-4)
    return jb.Scene(mesh, terms, jb.clamped(mesh, left), tip)


@pytest.mark.parametrize(
    ("obstacle", "ways"),
    [
        (jb.disk([1.0, 0.7], 0.3), {-0.3: -6.0, -1.0: -20.0}),
        pytest.param(jb.box([1.0, 0.7], [0.5, 0.6]), {-0.3: -6.0, -0.7: -15.0}, marks=pytest.mark.slow),
    ],
    ids=["disk", "box"],
)
def test_a_long_way_in_one_call(obstacle, ways):
    """Moved by as much as its size, and by more than that, it pushes the beam down as in small steps. In one step the
    beam would come out above it, or not see it at all."""
    scene = under(obstacle)
    for way, least in ways.items():
        found = jb.check(jb.equilibrium(jb.command(scene, [way])))
        path = jb.check(jb.ramp(scene, [way], 20))
        np.testing.assert_allclose(found.x, path.x[-1], atol=1e-8)
        assert float(jb.tip_angle(scene, found.x)) < least
        assert float(jb.sweep(scene, np.array([[way]])).x[0, -1, 1]) == pytest.approx(float(found.x[-1, 1]), abs=1e-8)


def test_the_wrong_side_is_told():
    """Where the upper side of the beam lies beyond the centre of the disk, the disk would push it up."""
    for way, wrong in ((-0.25, False), (-0.35, True)):
        scene = jb.command(under(jb.disk([1.0, 0.7], 0.3)), [way])
        assert (float(jb.smallest_jacobian(scene, scene.mesh.nodes)) < 0) == wrong
    with pytest.raises(ValueError, match=r"x0: element .* is inverted"):
        jb.equilibrium(scene, scene.mesh.nodes + 1e-9)


@pytest.mark.parametrize(
    ("stiffness", "way", "far"), [(3000.0, 1.2, 2.0), pytest.param(30.0, 0.4, 1.0, marks=pytest.mark.slow)]
)
def test_an_obstacle_does_not_pass_through_the_body(stiffness, way, far):
    """A disk pushed in so far that the body would rather let it through: the answer at rest, with the disk in the body
    or on its other side, is no answer. It breaks off where the body gives way."""
    mesh = jb.rectangle(3.5, 0.8, 7, 4, order=2)
    nodes = np.asarray(mesh.nodes)
    below, left = np.flatnonzero(nodes[:, 1] < -0.3999), np.flatnonzero(nodes[:, 0] < -1.7499)
    push = jb.contact(mesh, below, jb.disk([0.875, -0.85], 0.4), stiffness, 1e-3, direction=[-0.5, 0.866])
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1e4, 0.45)), push), jb.clamped(mesh, left))
    near = jb.check(jb.equilibrium(jb.command(scene, [way])))
    assert float(near.x[-1, 1] - nodes[-1, 1]) > 0.03
    for found in (jb.equilibrium(jb.command(scene, [far])), jax.tree.map(lambda a: a[-1], jb.ramp(scene, [far], 28))):
        assert int(found.status) & jb.Status.NOT_CONVERGED and way / far < float(found.reached) < 1
        assert np.abs(np.asarray(found.x) - nodes).max() > 0.03


def test_slope_in_the_radius():
    load = lambda r: (
        -jnp.sum(jb.contact_forces(s := jb.command(pressed(1e6, r[0]), [-0.02]), jb.equilibrium(s).x), axis=0)[1]
    )
    at = jnp.array([1.0])
    np.testing.assert_allclose(jax.grad(load)(at), central_difference(load, at, 1e-5), rtol=1e-5)


def valley(point, depth):
    """A user's own distance: above a parabola."""
    return point[1] + depth - 0.1 * point[0] ** 2


def test_a_users_own_shape_and_an_error_bar():
    mesh = jb.rectangle(3.5, 0.8, 9, 3)
    below = jb.nodes_where(mesh, lambda x, y: y < -0.3999)
    ends = jb.nodes_where(mesh, lambda x, y: x < -1.7499)
    ground = jb.contact(mesh, below, jb.Obstacle(valley, 0.75), 1e5, 1e-3)
    terms = jb.solid(mesh, jb.lame(1e4, 0.3)), jb.weight(mesh, [0.0, -300.0]), ground
    scene = jb.Scene(mesh, terms, jb.clamped(mesh, ends), [mesh.nodes.shape[0] - 1])
    found = jb.check(jb.equilibrium(scene))
    assert float(jnp.max(jb.penetration(scene, found.x))) > 0
    estimate = jb.estimate_error(scene, found, jb.tip_angle)
    finer, _ = jb.enriched(scene)
    true = float(jb.tip_angle(finer, jb.check(jb.equilibrium(finer)).x)) - float(jb.tip_angle(scene, found.x))
    assert abs(true) < estimate.bar < np.inf


def test_bad_obstacles_are_refused():
    square = jb.rectangle(4.0, 4.0, 9, 9)
    with pytest.raises(ValueError, match=r"obstacle: at rest it lies in the body, at \(0, 0\)"):
        jb.contact(square, np.arange(81), jb.disk([0.0, 0.0], 0.6), 1.0, 0.1)
    with pytest.raises(ValueError, match="direction: expected a vector of positive length"):
        jb.contact(jb.rectangle(1.0, 1.0, 3, 3), [0, 3, 6], jb.disk([0.0, -2.0], 0.5), 1.0, 0.1, direction=[0.0, 0.0])
    mesh = jb.rectangle(3.5, 0.8, 9, 3)
    below = jb.nodes_where(mesh, lambda x, y: y < -0.3999)
    with pytest.raises(ValueError, match=r"lies 0.1 inside it at rest; place it outside"):
        jb.contact(mesh, below, jb.half_plane([0.0, -0.3], [0.0, 1.0]), 1e5, 1e-3)
    with pytest.raises(ValueError, match=r"obstacle: .*half_plane"):
        jb.contact(mesh, below, [0.0, 1.0], 1e5, 1e-3)
    with pytest.raises(ValueError, match="normal: expected a vector of positive length"):
        jb.half_plane([0.0, 0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match="stiffness: expected a positive"):
        jb.contact(mesh, below, jb.disk([0.0, -2.0], 1.0), -1.0, 1e-3)
    with pytest.raises(ValueError, match=r"thickness is 0.04, less than the longest edge .* 0.438"):
        jb.contact(mesh, below, jb.disk([0.0, -2.0], 0.02), 1.0, 1e-3)
    with pytest.raises(ValueError, match="at least one edge of the surface"):
        jb.contact(mesh, [4], jb.disk([0.0, -2.0], 1.0), 1.0, 1e-3)
