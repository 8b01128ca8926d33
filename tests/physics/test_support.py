"""Supports: prescribed displacements, their reactions and derivatives, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, lateral_stretch, piola_neo_hookean

import jaxbeam as jb
from jaxbeam.mesh.line import straight
from jaxbeam.physics.rod import rod
from jaxbeam.scene.scene import places

MESH = jb.rectangle(3.0, 1.0, 7, 3)
NODES = np.asarray(MESH.nodes)
LEFT, RIGHT, BOTTOM = NODES[:, 0] == -1.5, np.flatnonzero(NODES[:, 0] == 1.5), NODES[:, 1] == -0.5
BODY = jb.solid(MESH, jb.lame(1e4, 0.3), jb.neo_hookean)


def gripped(*terms, mesh=MESH, left=LEFT):
    """A beam clamped at its left, with a grip at its right that moves in x and holds y."""
    terms = terms or (jb.support(mesh, RIGHT, x=1.0, y=0.0),)
    return jb.Scene(mesh, (BODY, *terms), jb.clamped(mesh, np.flatnonzero(left)), RIGHT)


SCENE = gripped()


def solve(command, scene=SCENE, **kwargs):
    return jb.equilibrium(jb.command(scene, command), **kwargs)


# ------------------------------------------------------------------------------------- what is right


@pytest.mark.parametrize("stretch", [0.6, 1.4, 3.0])
def test_a_stretched_block_has_its_closed_form(stretch):
    fixed = np.zeros(NODES.shape, bool)
    fixed[LEFT, 0] = fixed[BOTTOM, 1] = True
    scene = jb.command(jb.Scene(MESH, (BODY, jb.support(MESH, RIGHT, x=3.0)), fixed), [stretch - 1])
    found = jb.check(jb.equilibrium(scene, solver=jb.Newton(escape=False)))
    mu, lam = 1e4 / 2.6, 3e3 / (1.3 * 0.4)
    across = lateral_stretch(jb.neo_hookean, stretch, mu, lam)
    force = piola_neo_hookean(np.diag([stretch, across]), mu, lam)[0, 0]
    expected = (NODES - [-1.5, -0.5]) * [stretch, across] + [-1.5, -0.5]
    np.testing.assert_allclose(found.x, expected, atol=1e-9)
    pulled = np.asarray(jb.reactions(scene, found.x))
    np.testing.assert_allclose(pulled[RIGHT, 0].sum(), force, rtol=1e-8)
    np.testing.assert_allclose(pulled[RIGHT, 1][1:], 0, atol=1e-8)
    assert int(found.attempts) == 1 and int(found.steps) <= 12


@pytest.mark.parametrize("angle", [0.5, 3.0, -3.0])
def test_a_turned_rod_is_an_arc(angle):
    """Turned at its end and free to move, a rod bends to an arc of its length; the moment is `EI angle / length`."""
    line, radian = straight(10.0, 0.1, 21), 0.1
    body = rod(line, 0.1, jb.lame(1e4, 0.3), jb.linear_elastic)
    held = jb.support(line, [20], angle=1.0)
    scene = jb.command(jb.Scene(line, (body, held), jb.clamped(line, [0])), [angle])
    found = jb.check(jb.equilibrium(scene))
    end = found.x[20, :2] - found.x[0, :2]
    # Elements of two nodes inscribe a polygon in the arc: each chord is shorter by (angle / 20)^2 / 24.
    radius = 10.0 / angle
    np.testing.assert_allclose(end, [radius * np.sin(angle), radius * (1 - np.cos(angle))], atol=0.01)
    moment = jb.reactions(scene, found.x)[20, 2] * radian
    np.testing.assert_allclose(moment, 1e4 / (1 - 0.3**2) * 0.1**3 / 12 * angle / 10, rtol=1e-6)
    assert float(found.x[20, 2]) == radian * angle


def test_the_same_equilibrium_as_with_stiff_springs():
    """Springs from the displaced places pull the nodes there but for `force / stiffness`."""
    command = 0.8
    found = jb.check(solve([command]))
    pulled = np.asarray(jb.reactions(jb.command(SCENE, [command]), found.x))[RIGHT]
    for stiffness in (1e6, 1e7):
        shift = np.where(np.isin(np.arange(len(NODES)), RIGHT), command, 0)
        moved = jb.Mesh(NODES + shift[:, None] * [1, 0], MESH.elements)
        springs = jb.penalty_springs(moved, RIGHT, stiffness)
        soft = jb.check(jb.equilibrium(jb.Scene(MESH, (BODY, springs), SCENE.fixed), jnp.asarray(found.x)))
        gap = np.asarray(found.x - soft.x)[RIGHT]
        np.testing.assert_allclose(gap * stiffness, pulled, rtol=2e4 / stiffness, atol=1e-3 * abs(pulled).max())


def test_held_coordinates_are_at_their_places_to_the_last_digits():
    for command in (1e-9, 0.3, -0.7, 4.0):
        found = jb.check(solve([command]))
        np.testing.assert_array_equal(found.x[RIGHT], NODES[RIGHT] + [command, 0])
        np.testing.assert_array_equal(np.asarray(found.x)[LEFT], NODES[LEFT])


def test_the_reactions_are_the_slope_of_the_energy():
    def energy(command):
        return solve(command).energy

    at = jnp.array([0.4])
    scene = jb.command(SCENE, at)
    reaction = jb.reactions(scene, jb.equilibrium(scene).x)[RIGHT, 0].sum()
    np.testing.assert_allclose(jax.grad(energy)(at)[0], reaction, rtol=1e-12)
    np.testing.assert_allclose(central_difference(energy, at, 1e-5)[0], reaction, rtol=1e-8)


# ------------------------------------------------------------------------------ derivatives, batches


def shape(command, factor=1.0):
    """A scene of two supports whose motions are differentiable."""
    upper, lower = RIGHT[2:], RIGHT[:2]
    more = (jb.support(MESH, upper, x=factor, y=0.3 * factor), jb.support(MESH, lower, y=np.array([0.0, 1.0])))
    return jb.command(gripped(*more), command)


def test_derivatives_by_command_and_motion_to_second_order():
    def middle(z):
        return jb.equilibrium(shape(z[:2], z[2])).x[10]

    z = jnp.array([0.3, -0.2, 1.1])
    forward, reverse = jax.jacfwd(middle)(z), jax.jacrev(middle)(z)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(forward, central_difference(middle, z, 1e-5), rtol=1e-6, atol=1e-8)
    second = jax.jit(jax.jacfwd(jax.jacrev(middle)))(z)
    slopes = jax.jit(jax.jacrev(middle))
    np.testing.assert_allclose(second, central_difference(slopes, z, 1e-5), rtol=1e-5, atol=1e-7)


def test_ramp_sweep_and_vmap_give_the_same_states():
    commands = np.linspace(-0.3, 0.9, 7)[:, None]
    rows = jb.check(jb.sweep(SCENE, commands))
    mapped = jax.vmap(lambda c: jb.equilibrium(jb.command(SCENE, c)).x)(jnp.asarray(commands))
    path = jb.check(jb.ramp(SCENE, [0.9], 7))
    np.testing.assert_allclose(rows.x, mapped, atol=1e-9)
    np.testing.assert_allclose(path.x[-1], rows.x[-1], atol=1e-9)
    # The predictor moves with the support, so hardly more than a step is left for each state.
    assert int(path.steps.sum()) <= 18
    np.testing.assert_allclose(path.x[:, RIGHT, 0], 1.5 + np.linspace(0, 0.9, 7)[:, None].repeat(3, 1), atol=1e-14)


def test_linear_response_is_the_slope_at_rest():
    slope = jax.jacfwd(lambda c: solve(c).x)(jnp.zeros(1))[..., 0]
    moved = jb.linear_response(jb.command(SCENE, [1e-3])) - NODES
    np.testing.assert_allclose(moved, 1e-3 * slope, atol=1e-12)
    response = lambda c: jb.linear_response(jb.command(SCENE, c))
    np.testing.assert_allclose(jax.jacrev(lambda c: response(c)[10])(jnp.array([0.2]))[:, 0], slope[10], atol=1e-12)


def test_a_start_near_the_answer_keeps_what_it_has():
    found = jb.check(solve([0.8]))
    again = jb.check(solve([0.8], x0=found.x))
    assert int(again.steps) == 0
    np.testing.assert_array_equal(again.x, found.x)


def test_single_precision():
    mesh = jb.rectangle(3.0, 1.0, 7, 3, dtype=jnp.float32)
    body = jb.solid(mesh, jb.lame(1e4, 0.3), jb.neo_hookean)
    scene = jb.Scene(mesh, (body, jb.support(mesh, RIGHT, x=1.0, y=0.0)), SCENE.fixed)
    found = jb.check(jb.equilibrium(jb.command(scene, [0.8])))
    assert found.x.dtype == jnp.float32
    np.testing.assert_allclose(found.x, solve([0.8]).x, atol=1e-5)


def test_a_force_is_reached_by_moving_a_support():
    def force(scene, x):
        return jb.reactions(scene, x)[RIGHT, 0].sum()

    found = jb.reach(SCENE, 2000.0, force, bounds=(-1.0, 2.0), tolerance=1e-6)
    assert found.status == jb.DesignStatus.REACHED
    scene = jb.command(SCENE, found.theta)
    np.testing.assert_allclose(force(scene, jb.equilibrium(scene).x), 2000.0, atol=1e-6)


def test_on_the_finer_mesh_new_nodes_between_are_held():
    scene = shape([0.3, -0.2])
    finer, way = jb.enriched(scene)
    np.testing.assert_allclose(
        np.where(finer.held, places(finer), 0),
        np.where(finer.held, way.carry(np.asarray(places(scene))), 0),
        atol=1e-14,
    )
    right = np.flatnonzero(np.asarray(finer.mesh.nodes)[:, 0] == 1.5)
    # The lower support holds y of two nodes, and so of the one between; the upper holds x and y of its only node.
    assert finer.held[right].sum(axis=0).tolist() == [1, 4] and len(right) == 5
    solution = jb.check(jb.equilibrium(scene))
    estimate = jb.estimate_error(scene, solution, jb.energy)
    true = jb.energy(finer, jb.check(jb.equilibrium(finer)).x) - estimate.value
    np.testing.assert_allclose(estimate.discretisation, true, rtol=0.05)


def test_a_pushed_column_buckles_and_is_never_called_stable_while_it_is_not():
    line = straight(10.0, 0.2, 41)
    body = rod(line, 0.2, jb.lame(1e4, 0.3), jb.linear_elastic)
    scene = jb.Scene(line, (body, jb.support(line, [40], x=-1.0, y=0.0, angle=0.0)), jb.clamped(line, [0]))
    load = 4 * np.pi**2 * 1e4 / (1 - 0.3**2) * 0.2**3 / 12 / 10**2
    branch = jb.trace_branch(scene, [0.04], step=0.002)
    assert [c.kind for c in branch.critical] == ["bifurcation"] * 2
    pushes = [-jb.reactions(jb.command(scene, c.ratios), c.x)[40, 0] for c in branch.critical]
    # The second mode has `tan(u) = u` at half the length: 8.183 pi^2 EI / L^2. Shortening, shear and the elements'
    # length leave 0.1 and 0.2 %.
    np.testing.assert_allclose(pushes, [load, 8.1830 / 4 * load], rtol=2e-3)
    fork = branch.critical[0]
    assert branch.stable[: fork.after + 1].all() and not branch.stable[fork.after + 1 :].any()
    bent = jb.trace_branch(scene, [0.04], through=fork, step=0.005, interval=(0.0, 1.0))
    assert bent.stable[2:].all()
    # A deflection of half a cosine wave, as deep as `a`, takes up the length `pi^2 a^2 / (4 L)`.
    depth = np.sqrt(4 * 10 * (bent.ratios[-1, 0] - fork.ratios[0]) / np.pi**2)
    np.testing.assert_allclose(np.abs(bent.x[-1][:, 1]).max(), depth, rtol=0.02)
    straight_on = jb.equilibrium(jb.command(scene, [0.04]), solver=jb.Newton(escape=False))
    assert int(straight_on.status) & jb.Status.UNSTABLE
    escaped = jb.check(jb.equilibrium(jb.command(scene, [0.04])))
    np.testing.assert_allclose(abs(np.asarray(escaped.x[:, 1])).max(), abs(bent.x[-1][:, 1]).max(), rtol=0.05)


# ------------------------------------------------------------------------------------------- refused


def test_what_is_refused():
    support = lambda *args, **kwargs: jb.support(MESH, *args, **kwargs)
    for build, message in [
        (lambda: support([0, 0], x=1.0), "nodes: expected each node once"),
        (lambda: support([99], x=1.0), "nodes: 99 is out of range"),
        (lambda: support(RIGHT), "x, y: expected the motion of at least one coordinate"),
        (lambda: support(RIGHT, angle=1.0), "angle: the nodes of triangles do not turn"),
        (lambda: support(RIGHT, x=[1.0, 2.0]), "x: expected"),
        (lambda: support(RIGHT, x=np.nan), "x: expected"),
        (lambda: support(RIGHT, x=1.0, value=np.inf), "value: expected"),
        (lambda: jb.command(SCENE, [np.nan]), "it is how far the support is moved"),
        (
            lambda: gripped(support(RIGHT, x=1.0, y=0.0), support(RIGHT[:1], y=1.0)),
            rf"terms\[2\]: another support holds y of node {RIGHT[0]} too",
        ),
        (
            lambda: gripped(support(np.append(RIGHT, np.flatnonzero(LEFT)[0]), x=1.0)),
            rf"terms\[1\]: `fixed` holds x of node {np.flatnonzero(LEFT)[0]} too",
        ),
        (
            lambda: jb.Scene(MESH, (BODY, support(np.arange(21), x=1.0, y=1.0)), np.zeros(NODES.shape, bool)),
            "every coordinate is fixed",
        ),
    ]:
        with pytest.raises(ValueError, match=message):
            build()


def test_a_body_that_only_supports_hold_is_held():
    left = jb.support(MESH, np.flatnonzero(LEFT), x=1.0, y=0.0)
    scene = jb.Scene(MESH, (BODY, left, jb.support(MESH, RIGHT, x=1.0)), np.zeros(NODES.shape, bool))
    found = jb.check(jb.equilibrium(jb.command(scene, [0.5, 0.5])))
    np.testing.assert_allclose(found.x - NODES, np.tile([0.5, 0.0], (21, 1)), atol=1e-12)
    with pytest.raises(ValueError, match="translation in y"):
        jb.equilibrium(jb.Scene(MESH, (BODY, jb.support(MESH, RIGHT, x=1.0)), np.zeros(NODES.shape, bool)))


def test_a_scene_without_supports_traces_nothing_of_them(monkeypatch):
    monkeypatch.setattr("jaxbeam.solve.newton._gap", None)
    plain = jb.tendon_beam(7, 2)  # of a shape that no other test has, so it is traced here
    assert jb.equilibrium(jb.command(plain, [0.9, 1.0])).status == 0


def test_the_message_about_commands_counts_each_kind():
    scene = gripped(jb.support(MESH, RIGHT, x=1.0), jb.cables(MESH, [[0, 9], [2, 11]], 1.0))
    with pytest.raises(ValueError, match=r"ratios: expected shape \(3,\), for 1 x support, 2 x cable, got \(2,\)"):
        jb.command(scene, [1.0, 1.0])
