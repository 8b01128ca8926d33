"""What acts on a body is drawn where it acts, in its direction and to one scale. States are made by hand."""

import numpy as np
import pytest
from pictures import HEIGHT, LENGTH, arrows, at, beam_mesh, frames_of, inside, legend, scene_of, upper

import jaxbeam as jb
from jaxbeam import plot
from jaxbeam.mesh.surface import surface
from jaxbeam.plot.acting import ARROW, ROOM, ROW, SPACING


@pytest.fixture(scope="module")
def mesh():
    return beam_mesh()


def inflated(mesh, value=0.0):
    """Clamped at both ends, with a pressure on the upper side."""
    fixed = jb.clamped(mesh, jb.nodes_where(mesh, lambda x, y: abs(x) > LENGTH / 2 - 1e-9))
    terms = jb.solid(mesh, jb.lame(1.0, 0.3)), jb.pressure(mesh, upper(mesh), value)
    return jb.Scene(mesh, terms, fixed, [at(mesh, 0.0, 0.0)])


def bent(nodes):
    """Nodes wound around a circle of radius 2.5, whose centre is (0, 2.5)."""
    nodes = np.asarray(nodes)
    turn, radius = 0.4 * nodes[:, 0], 2.5 - nodes[:, 1]
    return np.stack([radius * np.sin(turn), 2.5 - radius * np.cos(turn)], axis=1)


def joined(ax):
    """The lines that join the arrows of rows."""
    (lines,) = (c for c in ax.collections if c.get_zorder() == 8 and c.get_linewidths()[0] == 0.7)
    return lines.get_segments()


# ------------------------------------------------------------------------------------------- forces on nodes


def test_a_dead_load_lies_outside_the_body_and_is_as_long_as_its_force(mesh):
    """Head at the node where it pushes, tail where it pulls, and inside the body the tail."""
    places = [(-1.0, 0.5), (1.0, 0.5), (0.0, -0.5), (0.5, 0.0)]
    nodes = [at(mesh, *place) for place in places]
    forces = np.array([[0.0, -8.0], [1.0, 3.0], [0.0, -4.0], [2.0, 0.0]])
    x = np.asarray(mesh.nodes) + np.array([3.0, -2.0])
    ax = plot.beam(scene_of(mesh, jb.dead_load(mesh, nodes, forces)), x)
    tails, heads = arrows(ax)
    np.testing.assert_allclose(heads - tails, forces / 8.0 * ARROW * LENGTH, atol=1e-12)
    np.testing.assert_allclose(heads[0], x[nodes[0]], atol=1e-12)
    np.testing.assert_allclose(tails[1:], x[nodes[1:]], atol=1e-12)
    assert inside(tails, ax) and inside(heads, ax)
    assert legend(ax) == ["load", "at rest"]


def test_a_load_of_zero_is_not_drawn(mesh):
    loads = jb.dead_load(mesh, upper(mesh)[:2], np.array([[0.0, 0.0], [0.0, -1.0]]))
    tails, _ = arrows(plot.beam(scene_of(mesh, loads), mesh.nodes))
    assert len(tails) == 1
    ax = plot.beam(scene_of(mesh, jb.dead_load(mesh, upper(mesh), [0.0, 0.0])), mesh.nodes)
    assert legend(ax) == ["at rest"]
    assert not any(c.get_zorder() > 7 for c in ax.collections)


def test_weight_is_its_total_at_the_centre_of_gravity_and_in_scale_with_loads(mesh):
    middles = np.asarray(mesh.nodes)[mesh.elements].mean(axis=1)
    force = np.where(middles[:, :1] > 0, [0.0, -3.0], [0.0, -1.0])  # the right half weighs 6, the left half 2
    push = jb.dead_load(mesh, [at(mesh, 2.0, 0.5)], [2.0, 0.0])
    x = np.asarray(mesh.nodes) * [1.5, 1.0] + [0.0, 0.7]
    ax = plot.beam(scene_of(mesh, jb.weight(mesh, force), push), x)
    tails, heads = arrows(ax)
    centre = [1.5 * (1.0 * 6 - 1.0 * 2) / 8, 0.7]
    np.testing.assert_allclose(tails[0], centre, atol=1e-12)
    np.testing.assert_allclose(heads - tails, [[0.0, -ARROW * LENGTH], [ARROW * LENGTH / 4, 0.0]], atol=1e-12)
    assert legend(ax) == ["weight, load", "at rest"]


def test_a_rod_draws_the_forces_and_leaves_out_the_moment():
    rod = jb.rod_beam(5, length=LENGTH)
    load = jb.dead_load(rod.mesh, [4, 2], np.array([[0.0, -3.0, 50.0], [1.5, 0.0, 0.0]]))
    x = np.asarray(rod.mesh.nodes) + np.array([0.0, 0.2, 0.1])
    tails, heads = arrows(plot.beam(jb.Scene(rod.mesh, (*rod.terms, load), rod.fixed), x))
    np.testing.assert_allclose(tails, x[[4, 2], :2], atol=1e-12)
    np.testing.assert_allclose(heads - tails, ARROW * LENGTH * np.array([[0, -1], [0.5, 0]]), atol=1e-12)


# ------------------------------------------------------------------------------------------------------ rows


def test_traction_is_an_even_row_along_the_edges(mesh):
    """From end to end, with heads at the surface and a line through the tails."""
    scene = scene_of(mesh, jb.traction(mesh, upper(mesh), [0.0, -5.0]))
    x = np.asarray(mesh.nodes) + np.array([0.0, 0.3])
    ax = plot.beam(scene, x)
    tails, heads = arrows(ax, row=True)
    order = np.argsort(heads[:, 0])
    count = round(1 / SPACING) + 1
    np.testing.assert_allclose(heads[order, 0], np.linspace(-2, 2, count), atol=1e-12)
    np.testing.assert_allclose(heads[:, 1], 0.8, atol=1e-12)
    np.testing.assert_allclose(heads - tails, np.tile([0.0, -ROW * LENGTH], (count, 1)), atol=1e-12)
    np.testing.assert_allclose(joined(ax)[0], tails, atol=1e-12)
    assert inside(tails, ax) and legend(ax) == ["traction", "at rest"]


def test_traction_that_pulls_has_its_tails_at_the_surface_and_one_along_it_lies_beside_it(mesh):
    tails, heads = arrows(plot.beam(scene_of(mesh, jb.traction(mesh, upper(mesh), [0.0, 5.0])), mesh.nodes), row=True)
    np.testing.assert_allclose(tails[:, 1], 0.5, atol=1e-12)
    assert (heads[:, 1] > 0.5).all()
    ax = plot.beam(scene_of(mesh, jb.traction(mesh, upper(mesh), [5.0, 0.0])), mesh.nodes)
    tails, heads = arrows(ax, row=True)
    assert (tails[:, 1] > 0.5).all() and (tails[:, 1] < 0.6).all() and not joined(ax)
    order = np.argsort(tails[:, 0])
    assert (heads[order][:-1, 0] < tails[order][1:, 0]).all()  # none runs into the next


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_pressure_is_normal_to_the_surface_as_it_is_now(order, sign):
    """On the inner side of the circle: towards the body, or away from it if it is negative."""
    mesh = jb.rectangle(LENGTH, HEIGHT, 9, 3, order=order)
    scene = inflated(mesh, sign * 7.0)
    x = bent(mesh.nodes)
    ax = plot.beam(scene, x)
    tails, heads = arrows(ax, row=True)
    on, off = (heads, tails) if sign > 0 else (tails, heads)
    out = np.array([0.0, 2.5]) - on
    distance = np.linalg.norm(out, axis=1)
    # Chords of an angle of 0.2 are 1 % inside the circle, and their normals within 0.1 of the radius.
    np.testing.assert_allclose(distance, 2.0, atol=0.011 if order == 1 else 1e-3)
    np.testing.assert_allclose(np.linalg.norm(off - on, axis=1), ROW * LENGTH, rtol=1e-12)
    turned = off - on - ROW * LENGTH * out / distance[:, None]
    assert np.abs(turned).max() < ROW * LENGTH * (0.11 if order == 1 else 0.01)
    np.testing.assert_allclose(joined(ax)[0], off, atol=1e-12)
    if order == 1:  # exactly normal to the chord that it stands on
        edges = surface(mesh)
        starts, ends = (x[edges[:, k]] for k in (0, 1))
        run = ends - starts
        for place, arrow in zip(on, off - on, strict=True):
            t = np.clip(np.sum((place - starts) * run, axis=1) / np.sum(run**2, axis=1), 0, 1)
            near = np.linalg.norm(starts + t[:, None] * run - place, axis=1)
            assert near.min() < 1e-12
            assert min(abs(arrow @ run[k]) for k in np.flatnonzero(near < 1e-12)) < 1e-12


def cavity(half):
    """A beam with a slit, and the pressure in it."""
    plain = jb.rectangle(LENGTH, HEIGHT, 9, 11)
    middles = np.asarray(plain.nodes)[plain.elements].mean(axis=1)
    kept = np.asarray(plain.elements)[(np.abs(middles[:, 0]) > 1) | (np.abs(middles[:, 1]) > half)]
    used, elements = np.unique(kept, return_inverse=True)
    mesh = jb.Mesh(np.asarray(plain.nodes)[used], elements.reshape(kept.shape))
    rim = jb.nodes_where(mesh, lambda x, y: (abs(x) < 1 + 1e-9) & (abs(y) < half + 1e-9))
    return scene_of(mesh, jb.pressure(mesh, rim, 2.0))


@pytest.mark.parametrize("half", [0.1, 0.3])
def test_rows_in_a_cavity_do_not_cross_it(half):
    ax = plot.beam(cavity(half), cavity(half).mesh.nodes)
    tails, heads = arrows(ax, row=True)
    on_rim = np.isclose(np.abs(heads), [1.0, half], atol=1e-9).any(axis=1)
    assert on_rim.all() and len(joined(ax)) == 4
    assert (np.abs(tails) < [1.0, half]).all()
    length = np.linalg.norm(heads - tails, axis=1)
    np.testing.assert_allclose(length, min(ROW * LENGTH, ROOM * 2 * half), rtol=1e-9)


def test_rows_follow_the_state_and_grow_with_the_command(mesh):
    """Under pressures 0, 5, 10; an animation keeps one scale, and its limits hold all of it."""
    fixed = np.zeros(mesh.nodes.shape, bool)
    fixed[np.abs(np.asarray(mesh.nodes)[:, 0]) > 2 - 1e-9] = True
    scene = jb.Scene(
        mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)), jb.pressure(mesh, upper(mesh))), fixed, [at(mesh, 0.0, 0.0)]
    )
    x = np.stack([np.asarray(mesh.nodes), mesh.nodes + np.array([0.0, 0.5]), bent(mesh.nodes)])
    states = plot.States(scene, [[0.0], [5.0], [10.0]], x)
    for frame, (ax,) in frames_of(plot.animate_ramp(states)):
        tails, heads = arrows(ax, row=True)
        assert (len(tails) > 0) == (frame > 0) and inside(tails, ax)
        if frame:
            np.testing.assert_allclose(np.linalg.norm(heads - tails, axis=1), frame / 2 * ROW * LENGTH, rtol=1e-12)
        if frame == 1:
            np.testing.assert_allclose(heads[:, 1], 1.0, atol=1e-12)
            np.testing.assert_allclose(heads[:, 0], tails[:, 0], atol=1e-12)
        if frame == 2:
            np.testing.assert_allclose(np.linalg.norm(heads - [0.0, 2.5], axis=1), 2.0, atol=0.011)
    figure = plot.gallery(states)
    lengths = [np.linalg.norm(np.subtract(*arrows(ax, row=True)), axis=1) for ax in figure.axes]
    np.testing.assert_allclose(lengths[2].max(), 2 * lengths[1].max(), rtol=1e-12)
    assert legend(figure.axes[0]) == ["pressure", "at rest"]


def test_panels_of_a_gallery_hold_their_arrows(mesh):
    scene = inflated(mesh)
    states = plot.States(scene, [[0.0], [10.0]], np.stack([mesh.nodes] * 2))
    first, second = plot.gallery(states, columns=1).axes
    assert inside(arrows(second, row=True)[0], second)
    assert second.get_ylim()[1] > first.get_ylim()[1]


def test_bodies_side_by_side_have_one_scale(mesh):
    x = np.asarray(mesh.nodes)[None]
    top = [at(mesh, 1.0, 0.5)]
    each = [
        plot.States(scene_of(mesh, jb.dead_load(mesh, top, [0.0, -force])), np.zeros((1, 0)), x) for force in (1.0, 4.0)
    ]
    (_, axes), *_ = frames_of(plot.animate_beams(each))
    short, long = (np.linalg.norm(np.subtract(*arrows(ax)), axis=1) for ax in axes)
    np.testing.assert_allclose([short, long], [[ARROW * LENGTH / 4], [ARROW * LENGTH]], rtol=1e-12)
