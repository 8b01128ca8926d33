"""What holds a body is drawn as text-books draw it, where it is now."""

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from pictures import HEIGHT, LENGTH, at, beam_mesh, frames_of, inside, scene_of, triangles, upper

import jaxbeam as jb
from jaxbeam import plot
from jaxbeam.plot.supports import BLOCK, GAP, SECTION


@pytest.fixture(scope="module")
def mesh():
    return beam_mesh()


def right(mesh):
    return jb.nodes_where(mesh, lambda x, y: x > LENGTH / 2 - 1e-9)


def with_fixed(mesh, *held):
    """Held coordinates `(node, x, y)`, and a load."""
    fixed = np.zeros(mesh.nodes.shape, bool)
    for node, *coordinates in held:
        fixed[node] = coordinates
    return jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)),), fixed)


def grounds(ax):
    """The line below each triangle, `(q, 2, 2)`."""
    (lines,) = (c.get_segments() for c in ax.collections if c.get_zorder() == 7 and hasattr(c, "get_segments"))
    return np.array(lines[: len(triangles(ax)[0])])


def blocks(ax):
    """The hatched polygons `(e, 2 p, 2)` that move, and the lines around them."""
    (hatched,) = (c for c in ax.collections if c.get_hatch() == "xxxx")
    (rims,) = (c for c in ax.collections if c.get_zorder() == 4 and hasattr(c, "get_segments") and is_rim(c))
    return [path.vertices[:-1] for path in hatched.get_paths()], rims.get_segments()


def is_rim(lines):
    return lines.get_linewidths()[0] == 1.1


def test_a_simply_supported_beam_has_a_pin_and_a_roller(mesh):
    """The pin stands on the ground. The roller is above it, and follows its node, which slides."""
    left, other = at(mesh, -2.0, -0.5), at(mesh, 2.0, -0.5)
    x = np.asarray(mesh.nodes) * [0.9, 1.0] - np.array([0.2, 0.0])
    ax = plot.beam(with_fixed(mesh, (left, True, True), (other, False, True)), x)
    tips, away = triangles(ax)
    np.testing.assert_allclose(tips, x[[left, other]], atol=1e-12)
    np.testing.assert_allclose(away, [[0, -1], [0, -1]], atol=1e-12)
    (drawn,) = (c for c in ax.collections if c.get_zorder() == 7 and isinstance(c, PolyCollection))
    lower = [path.vertices[:, 1].min() for path in drawn.get_paths()]
    gap = np.array(lower) - grounds(ax)[:, :, 1].mean(axis=1)
    np.testing.assert_allclose(gap, [0.0, GAP * LENGTH], atol=1e-12)
    assert inside(grounds(ax), ax)


def test_rollers_are_outside_the_body_along_what_they_hold(mesh):
    top = at(mesh, 0.0, 0.5)
    scene = with_fixed(mesh, (top, False, True), (at(mesh, -2.0, 0.0), True, False), (at(mesh, 2.0, 0.0), True, False))
    tips, away = triangles(plot.beam(scene, mesh.nodes))
    order = np.argsort(tips[:, 0])
    np.testing.assert_allclose(tips[order], [[-2, 0], [0, 0.5], [2, 0]], atol=1e-12)
    np.testing.assert_allclose(away[order], [[-1, 0], [0, 1], [1, 0]], atol=1e-12)


def test_a_face_held_along_itself_is_guided_at_its_ends(mesh):
    """As between two rollers; a face that is held across itself has one roller for each node."""
    scene = scene_of(mesh, jb.support(mesh, right(mesh), y=1.0))
    tips, away = triangles(plot.beam(scene, mesh.nodes))
    np.testing.assert_allclose(tips[np.argsort(tips[:, 1])], [[2, -0.5], [2, 0.5]], atol=1e-12)
    np.testing.assert_allclose(away[np.argsort(tips[:, 1])], [[0, -1], [0, 1]], atol=1e-12)
    tips, away = triangles(plot.beam(scene_of(mesh, jb.support(mesh, right(mesh), x=1.0)), mesh.nodes))
    assert len(tips) == 3
    np.testing.assert_allclose(away, [[1, 0]] * 3, atol=1e-12)


def test_rollers_do_not_overlap_on_a_fine_mesh():
    fine = jb.rectangle(LENGTH, HEIGHT, 161, 3)
    tips, _ = triangles(plot.beam(scene_of(fine, jb.support(fine, upper(fine)[1:], y=1.0)), fine.nodes))
    gaps = np.diff(np.sort(tips[:, 0]))
    assert 15 < len(tips) < 25 and gaps.min() > 0.04 * LENGTH and gaps.max() < 0.08 * LENGTH


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("size", [1.0, 1e-3])
def test_a_grip_is_a_hatched_block_that_moves_with_the_body(order, size):
    mesh = jb.rectangle(size * LENGTH, size * HEIGHT, 9, 3, order=order)
    left, grip = (jb.nodes_where(mesh, lambda x, y, s=s: s * x > 0.499 * size * LENGTH) for s in (-1, 1))
    terms = jb.solid(mesh, jb.lame(1.0, 0.3)), jb.support(mesh, grip, x=1.0, y=0.0)
    scene = jb.Scene(mesh, terms, jb.clamped(mesh, left))
    rest = np.asarray(mesh.nodes)
    picture = plot.Picture(scene, rest)
    for turn in (0.0, 0.6):
        along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
        x = rest @ np.stack([along, across])
        picture.move(x)
        polygons, rims = blocks(picture.ax)
        assert len(polygons) == 2
        points = np.concatenate(polygons)
        np.testing.assert_allclose((points @ along).min(), size * LENGTH / 2, rtol=1e-12)
        np.testing.assert_allclose((points @ along).max(), size * LENGTH * (0.5 + BLOCK), rtol=1e-12)
        np.testing.assert_allclose(np.ptp(points @ across), size * HEIGHT, rtol=1e-12)
        caps = [rim for rim in rims if abs(np.ptp(rim @ across)) < 1e-9 * size]
        assert len(caps) == 2 and len(rims) == 6  # closed at its ends, and not between its edges


def test_supports_move_in_an_animation(mesh):
    scene = scene_of(mesh, jb.support(mesh, right(mesh), x=1.0, y=0.0))
    rest = np.asarray(mesh.nodes)
    x = np.stack([rest + 0.1 * k * (rest + np.array([2.0, 0.0])) * [1.0, 0.0] for k in range(3)])
    for frame, (ax,) in frames_of(plot.animate_ramp(plot.States(scene, [[0.0], [0.4], [0.8]], x))):
        polygons, _ = blocks(ax)
        np.testing.assert_allclose(np.concatenate(polygons)[:, 0].min(), 2.0 + 0.4 * frame, rtol=1e-12)
        assert inside(np.concatenate(polygons), ax)


def test_inner_nodes_are_squares_white_if_they_move(mesh):
    inner, moved = at(mesh, 0.5, 0.0), at(mesh, 1.0, 0.0)
    terms = jb.solid(mesh, jb.lame(1.0, 0.3)), jb.support(mesh, [moved], y=1.0)
    x = np.asarray(mesh.nodes) + np.array([0.0, 0.3])
    ax = plot.beam(jb.Scene(mesh, terms, jb.clamped(mesh, [inner])), x)
    squares = {line.get_markerfacecolor(): line.get_xydata() for line in ax.lines if line.get_marker() == "s"}
    np.testing.assert_allclose(squares.pop("white"), [x[moved]], atol=1e-12)
    np.testing.assert_allclose(*squares.values(), [x[inner]], atol=1e-12)


def test_a_rod_is_clamped_across_itself():
    """At its ends by a wall or a block, in between on a roller, and where only the turn is held by a square."""
    rod = jb.rod_beam(9, length=LENGTH)
    mesh, grip = rod.mesh, jb.support(rod.mesh, [8], x=0.0, y=0.0, angle=1.0)
    x = np.asarray(mesh.nodes) + np.array([0.0, 0.1, 0.0]) * np.arange(9)[:, None] ** 2 / 8
    ax = plot.beam(jb.Scene(mesh, (rod.terms[0], grip, jb.support(mesh, [4], y=1.0)), rod.fixed), x)
    (polygon,), _ = blocks(ax)
    run = (x[8] - x[7])[:2] / np.linalg.norm((x[8] - x[7])[:2])
    beyond = (polygon - x[8, :2]) @ run
    np.testing.assert_allclose(np.sort(beyond), np.array([0, 0, BLOCK, BLOCK]) * LENGTH, atol=1e-12)
    aside = (polygon - x[8, :2]) @ [-run[1], run[0]]
    np.testing.assert_allclose(np.abs(aside), SECTION * LENGTH, atol=1e-12)
    tips, away = triangles(ax)
    np.testing.assert_allclose(tips, x[[4], :2], atol=1e-12)
    np.testing.assert_allclose(away, [[0, -1]], atol=1e-12)
    ax = plot.beam(jb.Scene(mesh, (rod.terms[0], jb.support(mesh, [8], angle=1.0)), rod.fixed), x)
    (square,) = (line for line in ax.lines if line.get_marker() == "s")
    np.testing.assert_allclose(square.get_xydata(), x[[8], :2], atol=1e-12)
