"""Obstacles, springs, slack cables and what an own energy says of itself are drawn. States are made by hand."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.path import Path
from pictures import arrows, at, beam_mesh, frames_of, inside, legend, scene_of, upper

import jaxbeam as jb
from jaxbeam import plot
from jaxbeam.plot.acting import Acting


@pytest.fixture(scope="module")
def mesh():
    return beam_mesh()


# -------------------------------------------------------------------------------------------------- obstacles


def valley(point, depth):
    """A user's own distance: above a parabola."""
    return point[1] + depth - 0.1 * point[0] ** 2


def from_disk(points):
    return np.linalg.norm(points - [1.0, 1.0], axis=-1) - 0.4


def from_box(points):
    beyond = np.abs(points - [1.0, 1.0]) - [0.3, 0.4]
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)


OBSTACLES = {
    "half plane": (jb.half_plane([0.0, 0.6], [0.0, -1.0]), lambda points: 0.6 - points[..., 1]),
    "disk": (jb.disk([1.0, 1.0], 0.4), from_disk),
    "box": (jb.box([1.0, 1.0], [0.6, 0.8]), from_box),
    "own": (jb.Obstacle(valley, 0.95), lambda points: points[..., 1] + 0.95 - 0.1 * points[..., 0] ** 2),
}


def obstacle_parts(ax):
    """Vertices of the boundary, and the fill as a function that tells which points are in it."""
    (line,) = (c for c in ax.collections if c.get_zorder() == 0.6)
    (fill,) = (c for c in ax.collections if c.get_zorder() == 0.4)
    vertices = np.concatenate([path.vertices for path in line.get_paths()])
    return vertices, lambda points: np.any([path.contains_points(points) for path in fill.get_paths()], axis=0)


@pytest.mark.parametrize("name", OBSTACLES)
@pytest.mark.parametrize("moved", [0.0, -0.25])
def test_an_obstacle_is_drawn_where_its_command_has_moved_it(mesh, name, moved):
    obstacle, distance = OBSTACLES[name]
    nodes = jb.nodes_where(mesh, lambda x, y: abs(y) > 0.4999)
    scene = jb.command(scene_of(mesh, jb.contact(mesh, nodes, obstacle, 1e3, 1e-3, [3.0, 4.0])), [moved])
    ax = plot.beam(scene, mesh.nodes)
    shift = moved * np.array([0.6, 0.8])
    vertices, filled = obstacle_parts(ax)
    assert len(vertices) > 20
    np.testing.assert_allclose(distance(vertices - shift), 0, atol=0.01)
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    points = np.random.default_rng(0).uniform([x0, y0], [x1, y1], (500, 2))
    clear = np.abs(distance(points - shift)) > 0.02
    np.testing.assert_array_equal(filled(points[clear]), distance(points[clear] - shift) < 0)
    assert inside(mesh.nodes, ax)
    hatching = [c for c in ax.collections if c.get_zorder() == 0.5]
    assert len(hatching) == 1 and hatching[0].hatches == ["//////"]


def test_limits_hold_a_small_obstacle_and_a_strip_of_a_large_one(mesh):
    ax = plot.beam(scene_of(mesh, jb.contact(mesh, upper(mesh), OBSTACLES["disk"][0], 1e3, 1e-3)), mesh.nodes)
    assert ax.get_ylim()[1] > 1.3
    ground = jb.half_plane([0.0, -0.5], [0.0, 1.0])
    below = jb.nodes_where(mesh, lambda x, y: y < -0.4999)
    ax = plot.beam(scene_of(mesh, jb.contact(mesh, below, ground, 1e3, 1e-3)), mesh.nodes)
    assert -1.2 < ax.get_ylim()[0] < -0.7
    assert ax.get_xlim()[0] > -2.5


def test_an_obstacle_moves_in_an_animation_and_leaves_nothing_behind(mesh):
    scene = scene_of(mesh, jb.contact(mesh, upper(mesh), OBSTACLES["disk"][0], 1e3, 1e-3))
    x = np.stack([np.asarray(mesh.nodes)] * 3)
    commands = np.array([[0.0], [-0.2], [-0.3]])
    counts = set()
    for frame, (ax,) in frames_of(plot.animate_ramp(plot.States(scene, commands, x))):
        vertices, _ = obstacle_parts(ax)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        np.testing.assert_allclose((low + high) / 2, [1.0, 1.0 + commands[frame, 0]], atol=0.01)
        np.testing.assert_allclose(high - low, 0.8, atol=0.02)
        counts.add(len(ax.collections))
    assert len(counts) == 1
    for ax, (moved,) in zip(plot.gallery(plot.States(scene, commands, x)).axes, commands, strict=True):
        assert abs(obstacle_parts(ax)[0][:, 1].mean() - 1.0 - moved) < 0.05


def test_a_field_and_given_axes_show_what_acts(mesh):
    load = jb.dead_load(mesh, [at(mesh, 0.0, 0.5)], [0.0, -1.0])
    scene = scene_of(mesh, load, jb.contact(mesh, upper(mesh), OBSTACLES["disk"][0], 1e3, 1e-3))
    values = np.linspace(1, 2, len(mesh.elements))
    for ax in (plot.field(scene, mesh.nodes, values, ""), plot.beam(scene, mesh.nodes, ax=Figure().add_subplot())):
        np.testing.assert_allclose(arrows(ax)[1], [[0.0, 0.5]], atol=1e-12)
        assert len(obstacle_parts(ax)[0])
    assert "load" in ax.get_legend_handles_labels()[1]


# ------------------------------------------------------------------------------------------- springs, slack


def zigzags(ax):
    (springs,) = (c for c in ax.collections if c.get_zorder() == 3.5)
    return springs.get_segments()


def test_springs_reach_from_outside_the_body_to_their_nodes(mesh):
    """Off the edge between them. One whose node has moved starts beyond the node, and is compressed."""
    left = jb.nodes_where(mesh, lambda x, y: x < -2 + 1e-9)
    lone = at(mesh, 1.0, -0.5)
    stiff, soft = jb.penalty_springs(mesh, left, 1e9), jb.penalty_springs(mesh, [lone], 1.0)
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)), stiff, soft), np.zeros(mesh.nodes.shape, bool))
    x = np.array(mesh.nodes)
    x[lone] += [0.0, -0.5]
    ax = plot.beam(scene, x)
    *held, last = zigzags(ax)
    for line, node in zip(held, left, strict=True):
        np.testing.assert_allclose(line[-1], x[node], atol=1e-12)
        assert line[0, 0] < -2.1 and abs(line[0, 1] - x[node, 1]) < 1e-9
        assert (line[:-1, 0] < -2).all() and np.ptp(line[:, 1]) > 0.02
    np.testing.assert_allclose(last[-1], x[lone], atol=1e-12)
    assert last[0, 1] < x[lone, 1] - 0.1 and abs(last[0, 0] - 1.0) < 1e-6
    assert (last[:-1, 1] < x[lone, 1]).all()
    assert inside(np.concatenate([*held, last]), ax)


def test_a_spring_at_a_corner_lies_along_the_motion(mesh):
    """Below a tip that sinks; out of both sides where nothing moves."""
    corner = at(mesh, 2.0, -0.5)
    scene = scene_of(mesh, jb.penalty_springs(mesh, [corner], 1.0))
    x = np.array(mesh.nodes)
    base = zigzags(plot.beam(scene, x))[0][0]
    assert base[0] > 2.1 and base[1] < -0.6
    x[corner] += [0.0, -0.3]
    base = zigzags(plot.beam(scene, x))[0][0]
    assert abs(base[0] - 2.0) < 0.01 and base[1] < -0.9


@pytest.mark.parametrize("turn", [2.2, -2.2])
def test_springs_do_not_run_through_a_body_that_has_turned(mesh, turn):
    """About the end that they hold: off the surface as it was they would cross it. Nor do they when it is back."""
    end = jb.nodes_where(mesh, lambda x, y: x > 2 - 1e-9)
    terms = jb.solid(mesh, jb.lame(1.0, 0.3)), jb.penalty_springs(mesh, end, 1.0)
    scene = jb.Scene(mesh, terms, np.zeros(mesh.nodes.shape, bool))
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    x = (np.asarray(mesh.nodes) - [2.0, 0.0]) @ rotation + np.array([2.0, 0.0])
    picture = plot.Picture(scene)
    corners = [at(mesh, *corner) for corner in [(-2.0, -0.5), (2.0, -0.5), (2.0, 0.5), (-2.0, 0.5)]]
    for state in (x, np.asarray(mesh.nodes)):
        picture.move(state)
        body = Path(state[corners])
        for line, node in zip(zigzags(picture.ax), end, strict=True):
            np.testing.assert_allclose(line[-1], state[node], atol=1e-12)
            assert not body.contains_points(line[0] + np.linspace(0, 0.97, 50)[:, None] * (line[-1] - line[0])).any()
    assert inside(zigzags(plot.beam(scene, x)), plot.beam(scene, x))


def test_springs_stand_on_ground_with_hatching(mesh):
    lone = at(mesh, 1.0, -0.5)
    ax = plot.beam(scene_of(mesh, jb.penalty_springs(mesh, [lone], 1.0)), mesh.nodes)
    (grounds,) = (c.get_segments() for c in ax.collections if c.get_zorder() == 3.4)
    base = zigzags(ax)[0][0]
    bar, *strokes = grounds
    np.testing.assert_allclose(bar.mean(axis=0), base, atol=1e-12)
    np.testing.assert_allclose(bar[:, 1], base[1], atol=1e-12)
    assert len(strokes) == 4 and all(stroke[1, 1] < stroke[0, 1] for stroke in strokes)


def test_a_slack_cable_is_thinner_and_named(mesh):
    """A two-way tendon at its natural length is not slack, though it has no tension."""
    lines = np.array([[at(mesh, -2.0, y), at(mesh, 0.0, y)] for y in (0.5, -0.5)])
    cables, tendons = jb.cables(mesh, lines, 1.0), jb.tendons(mesh, lines, 1.0)
    ax = plot.beam(jb.command(scene_of(mesh, cables), [1.0, 0.8]), mesh.nodes)
    slack, taut = (line for line in ax.lines if "cable" in line.get_label())
    assert slack.get_label() == "cable 1 (slack)" and taut.get_label() == "cable 2"
    assert slack.get_linewidth() < 0.6 * taut.get_linewidth() and slack.get_alpha() < 1
    assert legend(ax) == ["cable 1", "cable 2", "slack", "at rest"]
    assert "slack" not in str(legend(plot.beam(scene_of(mesh, tendons), mesh.nodes)))
    pulled = jb.command(scene_of(mesh, jb.pulls(mesh, lines)), [0.0, 2.0])
    labels = [line.get_label() for line in plot.beam(pulled, mesh.nodes).lines]
    assert "cable 1 (slack)" in labels and "cable 2" in labels
    states = plot.States(scene_of(mesh, cables), [[1.0, 1.0], [0.8, 1.0]], np.stack([mesh.nodes] * 2))
    for frame, (ax,) in frames_of(plot.animate_ramp(states)):
        widths = [line.get_linewidth() for line in ax.lines if "cable" in line.get_label()]
        assert widths[1] < 1 and (widths[0] < 1) == (frame == 0)


# ------------------------------------------------------------------------------------------- own energies


@dataclasses.dataclass(frozen=True)
class Wind(jb.Energy):
    """A user's own load, obstacle and spring in one."""

    name: ClassVar[str] = "wind"

    def __call__(self, x, params):
        return -jnp.sum(params * x[0])

    def point_loads(self, x, params):
        return jnp.stack([x[:, 0], params], axis=1)

    def obstacle(self, points, params):
        return points[:, 1] + 0.7

    def springs(self, params):
        return jnp.array([[2.0, 0.5]])


def test_an_own_energy_is_drawn_as_it_says(mesh):
    corner = at(mesh, 2.0, 0.5)
    scene = scene_of(mesh, jb.Term(Wind(), [[corner]], np.array([[3.0, 0.0]])))
    ax = plot.beam(scene, mesh.nodes)
    np.testing.assert_allclose(arrows(ax)[0], [[2.0, 0.5]], atol=1e-12)
    np.testing.assert_allclose(obstacle_parts(ax)[0][:, 1], -0.7, atol=0.01)
    np.testing.assert_allclose(zigzags(ax)[0][-1], [2.0, 0.5], atol=1e-12)
    assert legend(ax) == ["wind", "at rest"]


def test_nothing_that_acts_costs_nothing(monkeypatch):
    """No artist is made, the scene is not commanded for each state, and limits are those of the body."""
    scene = jb.tendon_beam(5, 3)
    monkeypatch.setattr("jaxbeam.plot.acting.command", None)
    acting = Acting(scene)
    seen = acting.see_all(np.ones((3, 2)), np.stack([scene.mesh.nodes] * 3))
    assert not acting.any and not acting.names and not acting.extremes(seen)
    ax = plot.beam(scene, scene.mesh.nodes)
    assert len(ax.collections) == 6
