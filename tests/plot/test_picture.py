"""A picture that is moved shows what a picture made anew would show. States are made by hand."""

import itertools

import numpy as np
import pytest
from matplotlib.animation import FuncAnimation
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import TriMesh
from pictures import BOUNDS, LENGTH, arrows, at, beam_mesh, moved, scene_of, triangles, upper

import jaxbeam as jb
from jaxbeam import plot
from jaxbeam.mesh.surface import surface
from jaxbeam.plot.acting import ROW


@pytest.fixture(scope="module")
def mesh():
    return beam_mesh()


def loaded(mesh):
    """Whatever can act on a body, with the commands: two tendons, pressure, support, obstacle."""
    lines = np.array([[at(mesh, x, y) for x in (-2.0, -1.0, 1.0)] for y in (0.5, -0.5)])
    whole = np.unique(surface(mesh)[:, :2])
    terms = (
        jb.tendons(mesh, lines, 1.0),
        jb.dead_load(mesh, [at(mesh, 1.0, 0.5), at(mesh, 0.0, -0.5)], np.array([[0.0, -2.0], [1.0, 0.0]])),
        jb.weight(mesh, [0.0, -0.1]),
        jb.pressure(mesh, whole),
        jb.support(mesh, jb.nodes_where(mesh, lambda x, y: x > LENGTH / 2 - 1e-9), x=1.0, y=0.0),
        jb.support(mesh, [at(mesh, 0.5, 0.5)], y=1.0),
        jb.penalty_springs(mesh, [at(mesh, 0.0, -0.5), at(mesh, 0.5, -0.5)], 1.0),
        jb.contact(mesh, upper(mesh), jb.disk([1.0, 1.5], 0.4), 1e3, 1e-3),
    )
    return scene_of(mesh, *terms)


FIRST, SECOND = [1.0, 1.0, 1.0, 0.0, 0.0, 0.0], [0.8, 1.2, 2.0, 0.3, -0.1, -0.2]


def shown(ax):
    """What each artist shows, by artist: points, colours of a field and texts."""
    found = {}
    for artist in ax.collections:
        values = artist.get_array()
        if isinstance(artist, TriMesh):
            points = np.stack([artist._triangulation.x, artist._triangulation.y], axis=1)
        else:
            points = np.concatenate([np.zeros((0, 2)), *(path.vertices for path in artist.get_paths())])
        found[artist] = points, np.zeros(0) if values is None else np.asarray(values), artist.get_label()
    for line in ax.lines:
        found[line] = line.get_xydata(), np.zeros(0), f"{line.get_label()} {line.get_linestyle()}"
    return found


def in_order(ax):
    """The same in an order that does not depend on when an artist was made."""
    named = lambda text: "" if text.startswith("_") else text
    found = [((a.get_zorder(), len(s[0]), type(a).__name__), *s[:2], named(s[2])) for a, s in shown(ax).items()]
    return sorted(found, key=lambda each: (each[0], each[1].tolist()))


def assert_same(ax, other):
    for mine, its in zip(in_order(ax), in_order(other), strict=True):
        assert mine[0] == its[0] and mine[3] == its[3]
        for one, two in zip(mine[1:3], its[1:3], strict=True):
            np.testing.assert_allclose(one, two, atol=1e-12)


# ---------------------------------------------------------------------------------------------------- moving


def test_a_moved_picture_is_that_of_its_state(mesh):
    """Everything lies where a picture of the second state has it; and where it should be, by numbers."""
    scene, x = loaded(mesh), moved(mesh)
    picture = plot.Picture(jb.command(scene, FIRST), mesh.nodes, bounds=BOUNDS)
    before = {artist: each[0].copy() for artist, each in shown(picture.ax).items()}
    picture.move(x, SECOND)
    ax = picture.ax
    assert_same(ax, plot.Picture(jb.command(scene, SECOND), x, bounds=BOUNDS).ax)

    (body,) = (c for c in ax.collections if c.get_zorder() == 2)
    for path, nodes in zip(body.get_paths(), mesh.elements, strict=True):
        np.testing.assert_allclose(path.vertices[:3], x[nodes], atol=1e-12)
    (outline,) = (c for c in ax.collections if c.get_zorder() == 3)
    np.testing.assert_allclose(np.array(outline.get_segments()), x[surface(mesh)], atol=1e-12)
    tendons = {line.get_label(): line.get_xydata() for line in ax.lines if "tendon" in line.get_label()}
    np.testing.assert_allclose(tendons["tendon 1"], x[scene.terms[1].nodes[0]], atol=1e-12)
    np.testing.assert_allclose(tendons["tendon 2 (pushing)"], x[scene.terms[1].nodes[1]], atol=1e-12)
    (guides,) = (line.get_xydata() for line in ax.lines if line.get_zorder() == 6)
    np.testing.assert_allclose(guides, x[scene.terms[1].nodes[:, 1]], atol=1e-12)
    np.testing.assert_allclose(triangles(ax)[0], x[[at(mesh, 0.5, 0.5)]], atol=1e-12)
    tails, heads = arrows(ax)
    at_node = np.minimum(*(np.linalg.norm(each - x[at(mesh, 1.0, 0.5)], axis=1) for each in (tails, heads)))
    assert at_node.min() < 1e-12
    (springs,) = (c.get_segments() for c in ax.collections if c.get_zorder() == 3.5)
    np.testing.assert_allclose([line[-1] for line in springs], x[scene.terms[7].nodes[:, 0]], atol=1e-12)
    (disk,) = (c for c in ax.collections if c.get_zorder() == 0.6)
    points = np.concatenate([path.vertices for path in disk.get_paths()])
    np.testing.assert_allclose(np.linalg.norm(points - [1.0, 1.5 + SECOND[-1]], axis=1), 0.4, atol=1e-3)
    still = [
        artist for artist, points in before.items() if artist.axes and np.array_equal(points, shown(ax)[artist][0])
    ]
    assert {artist.get_zorder() for artist in still} <= {1, 4, 7}  # at rest, the clamp and a fixed node


def test_the_artists_returned_are_those_that_moved(mesh):
    scene = loaded(mesh)
    picture = plot.Picture(jb.command(scene, FIRST), mesh.nodes, bounds=BOUNDS)
    before = shown(picture.ax)
    returned = picture.move(moved(mesh), SECOND)
    after = shown(picture.ax)
    assert len(set(returned)) == len(returned) and set(returned) <= set(after)
    new = {artist for artist in after if artist not in before}
    changed = {a for a in after if a in before and not np.array_equal(after[a][0], before[a][0])}
    assert new | changed <= set(returned)
    assert len(new) == 3 and len(changed) > 12  # the obstacle has moved
    levels = [artist.get_zorder() for artist in returned]
    assert levels == sorted(levels)
    still = set(after) - set(returned)
    assert still and all(np.array_equal(after[a][0], before[a][0]) for a in still)


def test_a_picture_can_be_blitted(mesh):
    scene = jb.command(loaded(mesh), FIRST)
    picture = plot.Picture(scene, mesh.nodes, field=plot.Field(lambda scene, x: x[:, 0], "x"))
    figure = picture.ax.figure
    canvas = FigureCanvasAgg(figure)
    states = [moved(mesh, far) for far in (0.0, 0.5, 1.0)]
    commands = [[1.0, 1.0, far, 0.0, 0.0, -0.1 * far] for far in (0.0, 0.5, 1.0)]
    animation = FuncAnimation(figure, lambda k: picture.move(states[k], commands[k]), frames=3, blit=True)
    animation._draw_was_started = True
    assert animation._blit
    frames = []
    for frame in animation.new_frame_seq():
        animation._draw_frame(frame)  # raises if it was not given artists
        assert all(artist.get_animated() for artist in picture.artists)
        canvas.draw()
        for artist in picture.artists:
            picture.ax.draw_artist(artist)
        frames.append(np.asarray(canvas.buffer_rgba()).copy())
    assert all((one != two).any() for one, two in itertools.pairwise(frames))


def test_moving_there_and_back_leaves_nothing_behind(mesh):
    """With forces that do not grow and springs that do not reach farther, it is as it was."""
    scene = jb.command(loaded(mesh), SECOND)
    picture = plot.Picture(scene, moved(mesh), bounds=BOUNDS)
    count = len(picture.ax.get_children())
    picture.move(mesh.nodes, FIRST)
    picture.move(moved(mesh))
    assert len(picture.ax.get_children()) == count
    assert_same(picture.ax, plot.Picture(scene, moved(mesh), bounds=BOUNDS).ax)


def test_rods_move(mesh):
    rod = jb.rod_beam(9, length=LENGTH)
    load = jb.dead_load(rod.mesh, [8], [0.0, -1.0, 0.0])
    scene = jb.Scene(rod.mesh, (*rod.terms, load, jb.support(rod.mesh, [4], y=1.0)), rod.fixed)
    x = np.asarray(rod.mesh.nodes) + 0.1 * np.arange(9)[:, None] * [0.0, 1.0, 0.2]
    field = plot.Field(lambda scene, x: x[:, 1], "y")
    picture = plot.Picture(scene, field=plot.Field(field.values, "y", colours=(0.0, 1.0)), bounds=BOUNDS)
    picture.move(x, [0.8, 1.0, 0.4])
    other = plot.Field(field.values, "y", colours=(0.0, 1.0))
    assert_same(picture.ax, plot.Picture(jb.command(scene, [0.8, 1.0, 0.4]), x, field=other, bounds=BOUNDS).ax)
    (body,) = (c for c in picture.ax.collections if c.get_zorder() == 2)
    np.testing.assert_allclose(body.get_array(), 0.5 * (x[1:, 1] + x[:-1, 1]), atol=1e-12)
    np.testing.assert_allclose(triangles(picture.ax)[0], x[[4], :2], atol=1e-12)


# ------------------------------------------------------------------------------------------ what acts later


def test_arrows_appear_when_a_pressure_sets_in(mesh):
    scene = loaded(mesh)
    picture = plot.Picture(jb.command(scene, [1.0, 1.0, 0.0, 0.0, 0.0, 0.0]), mesh.nodes)
    rows = lambda: [c for c in picture.ax.collections if c.get_zorder() == 8 and c.get_linewidths()[0] == 0.9]
    assert not rows() or not len(rows()[0].get_paths())
    picture.move(mesh.nodes, FIRST)
    tails, heads = arrows(picture.ax, row=True)
    assert len(tails) > 20
    np.testing.assert_allclose(np.linalg.norm(heads - tails, axis=1), ROW * LENGTH, rtol=1e-9)
    picture.move(mesh.nodes, [1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    assert not len(arrows(picture.ax, row=True)[0])


def test_a_picture_without_any_force_at_first_shows_the_first_one(mesh):
    fixed = jb.clamped(mesh, jb.nodes_where(mesh, lambda x, y: abs(x) > LENGTH / 2 - 1e-9))
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)), jb.pressure(mesh, upper(mesh))), fixed)
    picture = plot.Picture(scene, bounds=BOUNDS)
    count = len(picture.artists)
    returned = picture.move(mesh.nodes, [3.0])
    assert len(returned) == count + 3  # shafts, heads and the line that joins them
    assert len(arrows(picture.ax, row=True)[0]) > 20


def test_arrows_become_shorter_when_a_larger_force_is_seen(mesh):
    fixed = jb.clamped(mesh, jb.nodes_where(mesh, lambda x, y: abs(x) > LENGTH / 2 - 1e-9))
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)), jb.pressure(mesh, upper(mesh))), fixed)
    picture = plot.Picture(jb.command(scene, [1.0]), bounds=BOUNDS)
    lengths = []
    for value in (1.0, 4.0, 1.0, 2.0):
        picture.move(mesh.nodes, [value])
        lengths.append(np.linalg.norm(np.subtract(*arrows(picture.ax, row=True)), axis=1).max())
    np.testing.assert_allclose(lengths, ROW * LENGTH * np.array([1.0, 1.0, 0.25, 0.5]), rtol=1e-12)


def test_obstacles_are_made_anew_only_if_they_or_the_axes_have_changed(mesh):
    scene = loaded(mesh)
    picture = plot.Picture(jb.command(scene, FIRST), mesh.nodes, bounds=BOUNDS)
    rigid = lambda: [c for c in picture.ax.collections if c.get_zorder() < 1]
    first = rigid()
    assert len(first) == 3
    picture.move(moved(mesh), FIRST)
    picture.move(mesh.nodes, [0.9, 1.0, 2.0, 0.1, 0.0, 0.0])
    assert rigid() == first
    picture.move(mesh.nodes, SECOND)
    second = rigid()
    assert len(second) == 3 and not set(second) & set(first)
    picture.ax.set_xlim(-3.0, 3.0)
    picture.move(mesh.nodes, SECOND)
    assert len(rigid()) == 3 and not set(rigid()) & set(second)
