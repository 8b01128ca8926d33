"""Pictures hold what they should show, and leave the program around them alone.

Looks are judged by eye; what is tested is what a glance can miss: limits, shapes, frames, labels, errors.
"""

import dataclasses
import itertools
import subprocess
import sys
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.animation import FFMpegWriter
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from pictures import frames_of, triangles
from PIL import Image

import jaxbeam as jb
from jaxbeam import plot
from jaxbeam.mesh.surface import patch, surface
from jaxbeam.plot.animations import HOLD
from jaxbeam.plot.lines import outline
from jaxbeam.plot.supports import SECTION

STEPS = 5


@pytest.fixture(scope="module")
def scene():
    return jb.tendon_beam(nx=7, ny=3)


@pytest.fixture(scope="module")
def states(scene):
    """A bent ramp, made by hand: pictures need no equilibrium."""
    ratios = jb.commands([0.4, 1.3], STEPS)
    rest = np.asarray(scene.mesh.nodes)
    bend = np.linspace(0, 0.25, STEPS)[:, None] * (rest[:, 0] + 1.75) ** 2
    return plot.States(scene, ratios, np.stack([rest[:, 0] - 0.3 * bend, rest[:, 1] + bend], axis=2), "bent")


def inside(points, bounds):
    (x0, x1), (y0, y1) = bounds
    x, y = np.asarray(points).reshape(-1, 2).T
    return (x0 < x).all() and (x < x1).all() and (y0 < y).all() and (y < y1).all()


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_importing_jaxbeam_does_not_import_matplotlib():
    assert run("import sys, jaxbeam; print('matplotlib' in sys.modules)").strip() == "False"


def test_drawing_leaves_pyplot_and_settings_alone():
    code = """if True:
        import sys, matplotlib as mpl
        settings = lambda: [mpl.rcParams[k] for k in mpl.rcParams if k != "backend"]  # asked for, it imports pyplot
        before = settings()
        import jaxbeam as jb
        from jaxbeam import plot
        scene = jb.tendon_beam(nx=5, ny=3)
        plot.beam(scene, scene.mesh.nodes).figure.canvas.draw()
        print('matplotlib.pyplot' in sys.modules, settings() == before)
    """
    assert run(code).split() == ["False", "True"]


def test_limits_hold_all_points_with_a_margin():
    points = np.array([[0.0, -1.0], [4.0, 0.5]])
    (x0, x1), (y0, y1) = plot.limits(points[:1], points[1:], margin=0.1)
    np.testing.assert_allclose([x0, x1, y0, y1], [-0.4, 4.4, -1.4, 0.9], atol=1e-12)


@pytest.mark.parametrize("points", [np.zeros((0, 2)), np.array([[0.0, np.nan]])])
def test_limits_refuse_nothing_and_nan(points):
    with pytest.raises(ValueError, match="positions: expected at least one point, all of them finite"):
        plot.limits(points)


def test_beam_holds_the_beam_at_one_scale(scene, states):
    ax = plot.beam(jb.command(scene, states.commands[-1]), states.x[-1])
    assert inside(states.x[-1], (ax.get_xlim(), ax.get_ylim()))
    assert inside(scene.mesh.nodes, (ax.get_xlim(), ax.get_ylim()))
    assert ax.get_aspect() == 1
    assert ax.get_xlabel() == "x (length units)"
    # The panel fills its slot: an aspect that the figure does not suit would leave empty space.
    ax.figure.draw_without_rendering()
    np.testing.assert_allclose(ax.get_position().bounds, ax.get_position(original=True).bounds, atol=0.02)


def test_beam_draws_into_given_axes(scene):
    ax = Figure().add_subplot()
    assert plot.beam(scene, scene.mesh.nodes, ax=ax) is ax
    assert ax.figure.legends == []


def test_pushing_is_told_by_more_than_colour(scene, states):
    x = np.asarray(scene.mesh.nodes)
    ratios = [0.5, 1.5]
    pulling, pushing = (line for line in plot.beam(jb.command(scene, ratios), x).lines if "tendon" in line.get_label())
    assert pulling.get_label() == "tendon 1" and pulling.get_linestyle() == "-"
    assert pushing.get_label() == "tendon 2 (pushing)" and pushing.get_linestyle() == "--"
    legend = plot.gallery(plot.States(scene, [ratios], x[None])).legends[0]
    assert "pushing" in [text.get_text() for text in legend.get_texts()]
    # At its own length a tendon does neither, whatever the sign of the round-off.
    nudged = x * (1 - 1e-15)
    assert "pushing" not in str([line.get_label() for line in plot.beam(scene, nudged).lines])


def test_tendon_runs_through_its_guides(scene):
    nodes = np.array([[2, 8, 14]])
    guided = jb.Scene(scene.mesh, (scene.terms[0], jb.tendons(scene.mesh, nodes, 2e3)), scene.fixed, scene.tip)
    x = np.asarray(scene.mesh.nodes) + np.array([0.0, 0.1])
    lines = {line.get_label(): line for line in plot.beam(guided, x).lines}
    np.testing.assert_array_equal(lines["tendon 1"].get_xydata(), x[nodes[0]])
    assert any(line.get_marker() == "o" and np.array_equal(line.get_xydata(), x[[8]]) for line in lines.values())


def test_boundary_is_the_outline_with_the_body_on_the_left(scene):
    edges = outline(scene)
    assert len(edges) == 2 * (6 + 2)
    start, end = np.asarray(scene.mesh.nodes)[edges.T]
    twice_area = np.sum(start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0])
    np.testing.assert_allclose(twice_area, 2 * 3.5 * 0.8, rtol=1e-12)


def test_field_has_a_labelled_colour_bar_and_the_values_in_order(scene, states):
    x = jnp.asarray(states.x[-1])
    values = np.linspace(1, 2, len(scene.mesh.elements))
    ax = plot.field(scene, x, values, "volume (dimensionless)")
    (bar,) = ax.child_axes
    assert bar.get_ylabel() == "volume (dimensionless)"
    (body,) = (c for c in ax.collections if c.get_array() is not None)
    np.testing.assert_array_equal(body.get_array(), values)
    np.testing.assert_array_equal(body.get_paths()[3].vertices[:3], x[scene.mesh.elements[3]])
    assert body.get_cmap().name == "viridis"


@pytest.mark.parametrize(("shift", "centre", "middle"), [(-0.4, None, 0.0), (0.0, 0.7, 0.7)])
def test_diverging_colours_are_even_about_the_centre(scene, shift, centre, middle):
    values = np.linspace(0.01, 1, len(scene.mesh.elements)) + shift
    ax = plot.field(scene, scene.mesh.nodes, values, "", centre=centre)
    (body,) = (c for c in ax.collections if c.get_array() is not None)
    assert body.get_cmap().name == "RdBu_r"
    np.testing.assert_allclose((body.norm.vmin + body.norm.vmax) / 2, middle, atol=1e-12)


def test_a_solution_holds_its_states(scene):
    path = jb.check(jb.ramp(scene, [0.9, 1.0], 4))
    states = plot.States(scene, path, title="slowly")
    assert states.title == "slowly"
    np.testing.assert_array_equal(states.x, path.x)
    np.testing.assert_array_equal(states.commands, path.ratios)
    with pytest.raises(ValueError, match="x: expected the positions of each state"):
        plot.States(scene, path.ratios)
    with pytest.raises(ValueError, match=r"commands: expected shape \(s, 2\)"):
        plot.States(scene, jb.equilibrium(scene))


def test_curve_is_the_measure_against_the_ratio_that_varies_most(scene, states):
    ax = plot.curves([states])
    (line,) = ax.lines
    expected = [jb.tip_angle(scene, jnp.asarray(x)) for x in states.x]
    np.testing.assert_allclose(line.get_ydata(), expected, rtol=1e-12)
    np.testing.assert_allclose(line.get_xdata(), states.commands[:, 0], rtol=1e-12)
    assert ax.xaxis_inverted() and ax.get_ylabel() == "tip angle (degrees)" and "dimensionless" in ax.get_xlabel()


def test_a_curve_against_another_command_than_a_ratio_says_so_and_rises_to_the_right(scene, states):
    tip = jb.dead_load(scene.mesh, scene.tip, [0.0, 0.0])
    grip = jb.support(scene.mesh, scene.tip, y=1.0)
    held = jb.Scene(scene.mesh, (*scene.terms, tip, grip), scene.fixed, scene.tip)
    moved = plot.States(held, np.linspace([1.0, 1.0, 0.0], [0.9, 1.0, 0.5], STEPS), states.x)
    ax = plot.curves([moved])
    assert not ax.xaxis_inverted() and ax.get_xlabel() == "command (its unit)"
    np.testing.assert_allclose(ax.lines[0].get_xdata(), np.linspace(0, 0.5, STEPS), atol=1e-12)
    pulled = plot.States(held, np.linspace([1.0, 1.0, 0.0], [0.4, 1.0, 0.5], STEPS), states.x)
    ax = plot.curves([pulled])
    assert ax.xaxis_inverted() and ax.get_xlabel() == "commanded ratio (dimensionless)"


def test_titles_of_a_gallery_do_not_run_into_each_other(scene, states):
    grips = [jb.support(scene.mesh, [node], y=1.0) for node in scene.tip]
    held = jb.Scene(scene.mesh, (*scene.terms, *grips), scene.fixed, scene.tip)
    figure = plot.gallery(plot.States(held, np.full((3, 5), 0.77), states.x[:3]))
    figure.draw_without_rendering()
    extents = [ax.title.get_window_extent() for ax in figure.axes]
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(extents))
    assert figure.axes[0].get_title().split() == ["commands", "0.77,", "0.77,", "0.77,", "0.77,", "0.77"]


def test_curves_of_tensions_are_those_of_each_command(scene, states):
    ax = plot.curves([states], jb.tendon_tensions, "tension (force units)")
    drawn = np.stack([line.get_ydata() for line in ax.lines], axis=1)
    expected = [
        jb.tendon_tensions(jb.command(scene, r), jnp.asarray(x)) for r, x in zip(states.commands, states.x, strict=True)
    ]
    np.testing.assert_allclose(drawn, expected, rtol=1e-12, atol=1e-9)
    assert [line.get_label() for line in ax.lines] == ["tendon 1", "tendon 2"]
    assert len({line.get_marker() for line in ax.lines}) == len({line.get_color() for line in ax.lines}) == 2


@pytest.mark.parametrize("columns", [1, 3])
def test_gallery_has_a_panel_for_each_state_to_one_scale(states, columns):
    figure = plot.gallery(states, columns=columns)
    assert len(figure.axes) == STEPS
    figure.draw_without_rendering()
    scales = []
    for ax, x in zip(figure.axes, states.x, strict=True):
        assert inside(x, (ax.get_xlim(), ax.get_ylim())) and ax.get_aspect() == 1
        scales.append(ax.get_window_extent().width / np.ptp(ax.get_xlim()))
    np.testing.assert_allclose(scales, scales[0], rtol=0.02)  # of a layout rounded to pixels
    assert figure.axes[-1].get_title() == "ratios 0.40, 1.30"


def test_frames_of_a_ramp_keep_limits_that_hold_them(states):
    animation = plot.animate_ramp(states)
    seen = set()
    for frame, (ax,) in frames_of(animation):
        bounds = (ax.get_xlim(), ax.get_ylim())
        seen.add((*bounds, tuple(ax.get_position().bounds)))
        assert inside(states.x[frame], bounds)
        assert f"{states.commands[frame, 0]:.2f}" in ax.get_title()
        shown = [line.get_xydata() for line in ax.lines if "tendon" in line.get_label()]
        assert all(inside(path, bounds) for path in shown)
    assert len(seen) == 1
    curve = animation._fig.axes[1]
    assert len(curve.lines[1].get_xdata()) == STEPS  # the trace is whole at the end


def test_beams_are_in_step_and_to_one_scale(scene, states):
    other = plot.States(scene, states.commands, states.x * [1, -1], "mirrored")
    for frame, axes in frames_of(plot.animate_beams([states, other])):
        assert len(axes) == 2 and axes[0].get_ylim() == axes[1].get_ylim()
        for ax, each in zip(axes, (states, other), strict=True):
            assert inside(each.x[frame], (ax.get_xlim(), ax.get_ylim()))
            assert ax.get_title().startswith(each.title)


def test_gif_has_every_frame_and_rests_on_the_last(states, tmp_path):
    path = tmp_path / "ramp.gif"
    plot.save_animation(plot.animate_ramp(states), path, fps=10, dpi=40)
    with Image.open(path) as image:
        assert image.n_frames == STEPS
        durations = []
        for frame in range(STEPS):
            image.seek(frame)
            durations.append(image.info["duration"])
    assert durations == [100] * (STEPS - 1) + [100 * HOLD]


def test_saving_names_the_cure(states, tmp_path, monkeypatch):
    animation = plot.animate_beams([states])
    animation._draw_was_started = True
    with pytest.raises(ValueError, match=r"path: expected an ending of \.gif or \.mp4, got .*a\.avi"):
        plot.save_animation(animation, tmp_path / "a.avi")
    monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: False)
    with pytest.raises(ValueError, match=r"a\.mp4 needs ffmpeg, which is not installed; install it or save as \.gif"):
        plot.save_animation(animation, tmp_path / "a.mp4")


@pytest.mark.skipif(not FFMpegWriter.isAvailable(), reason="needs ffmpeg")
def test_mp4_is_written(states, tmp_path):
    plot.save_animation(plot.animate_beams([states]), tmp_path / "a.mp4", dpi=40)
    assert (tmp_path / "a.mp4").stat().st_size > 1000


def test_any_mesh_without_tendons_or_solid(scene):
    mesh = jb.Mesh(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    springs = jb.penalty_springs(mesh, np.arange(4), 1.0)
    fixed = np.zeros((4, 2), bool)
    fixed[1, 1] = True  # a roller: no edge is clamped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ax = plot.beam(jb.Scene(mesh, (springs,), fixed), mesh.nodes)
        ax.figure.canvas.draw()
    np.testing.assert_allclose(triangles(ax)[0], [mesh.nodes[1]], atol=1e-12)


# ------------------------------------------------------------------------------ six nodes, wide anchors

WIDTH = 0.6


@pytest.fixture(scope="module", params=[1, 2])
def anchored(request):
    """A beam whose tendons end on patches that reach over parts of edges."""
    return jb.tendon_beam(nx=9, ny=3, order=request.param, anchor_width=WIDTH)


@pytest.fixture(scope="module")
def curved():
    """A beam of six-node triangles, one of them curved at rest at the clamp, and a bent state of it."""
    mesh = jb.tendon_beam(nx=5, ny=3, order=2).mesh
    left = np.flatnonzero(mesh.nodes[:, 0] < -1.74)
    nodes = np.array(mesh.nodes)
    nodes[left, 0] -= 0.1 * np.cos(5 * nodes[left, 1])
    mesh = jb.Mesh(nodes, mesh.elements)
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)),), jb.clamped(mesh, left))
    return scene, bent(nodes)


def bent(nodes):
    """Nodes wound around a circle."""
    turn, radius = 0.5 * nodes[:, 0], 2.0 - nodes[:, 1]
    return np.stack([radius * np.sin(turn), 2.0 - radius * np.cos(turn)], axis=1)


def collections(ax):
    """The fill, and the lines by their widths: the outline, 0.9, comes after what is at rest."""
    (body,) = (c for c in ax.collections if c.get_zorder() == 2)
    lines = {float(c.get_linewidths()[0]): c.get_segments() for c in ax.collections if hasattr(c, "get_segments")}
    return body, lines


def quadratic(ends_and_middle):
    """Nine points of the parabola that passes through first end, second end and, half-way, the middle."""
    a, b, middle = ends_and_middle
    xi = np.linspace(0, 1, 9)[:, None]
    return a + xi * (b - a) + 4 * xi * (1 - xi) * (middle - (a + b) / 2)


def lengths(lines):
    return [float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) for line in lines]


def distance(point, lines):
    """From a point to the nearest of several lines."""
    starts, ends = (np.concatenate([line[s] for line in lines]) for s in (np.s_[:-1], np.s_[1:]))
    along = np.sum((point - starts) * (ends - starts), axis=1) / np.sum((ends - starts) ** 2, axis=1)
    return np.linalg.norm(starts + np.clip(along, 0, 1)[:, None] * (ends - starts) - point, axis=1).min()


def test_edges_of_six_node_triangles_are_parabolas_through_all_six_nodes(curved):
    scene, x = curved
    body, lines = collections(plot.beam(scene, x))
    assert len(body.get_paths()) == len(scene.mesh.elements)
    for path, k in zip(body.get_paths(), scene.mesh.elements, strict=True):
        sides = [quadratic(x[k[[a, b, c]]])[:-1] for a, b, c in [(0, 1, 3), (1, 2, 4), (2, 0, 5)]]
        np.testing.assert_allclose(path.vertices[:-1], np.concatenate(sides), atol=1e-14)
    edges = surface(scene.mesh)
    assert len(edges) == 2 * (4 + 2)
    for drawn, edge in zip(lines[0.9], edges, strict=True):
        np.testing.assert_allclose(drawn, quadratic(x[edge]), atol=1e-14)
        np.testing.assert_allclose(drawn[4], x[edge[2]], atol=1e-14)


def test_clamp_follows_a_curved_edge_and_is_hatched_outside(curved):
    scene, x = curved
    ax = plot.beam(scene, x)
    _, lines = collections(ax)
    walls = [edge for edge in surface(scene.mesh) if scene.fixed[edge].all()]
    assert len(lines[2.2]) == len(walls) == 2
    for drawn, edge in zip(lines[2.2], walls, strict=True):
        np.testing.assert_allclose(drawn, quadratic(np.asarray(scene.mesh.nodes)[edge]), atol=1e-14)
    (hatching,) = (c for c in ax.collections if c.get_hatch())
    for strip, wall in zip(hatching.get_paths(), lines[2.2], strict=True):
        outer = strip.vertices[9:18][::-1]
        assert (outer[:, 0] < wall[:, 0] - 0.05).all()


def test_field_fills_curved_elements(curved):
    scene, x = curved
    values = np.linspace(1, 2, len(scene.mesh.elements))
    body, _ = collections(plot.field(scene, x, values, ""))
    np.testing.assert_array_equal(body.get_array(), values)
    np.testing.assert_allclose(
        body.get_paths()[5].vertices[[0, 4, 8, 12, 16, 20]], x[scene.mesh.elements[5]][[0, 3, 1, 4, 2, 5]]
    )


def test_three_node_triangles_cost_what_they_did(scene):
    body, lines = collections(plot.beam(scene, scene.mesh.nodes))
    assert {len(path.vertices) for path in body.get_paths()} == {4}
    assert {len(line) for line in lines[0.9]} == {2}


def test_limits_hold_an_edge_that_bulges_past_its_nodes(curved):
    scene, x = curved
    top = surface(scene.mesh)[np.argmax(x[surface(scene.mesh)][:, :, 1].max(axis=1))]
    far = np.array(x)
    far[top] = [[0.0, 0.0], [0.0, 4.0], [0.0, 4.0]]
    ax = plot.beam(scene, far)
    bounds = (ax.get_xlim(), ax.get_ylim())
    assert quadratic(far[top])[:, 1].max() == pytest.approx(4.5, abs=0.02)
    assert inside(quadratic(far[top]), bounds)


def test_tendon_ends_at_the_weighted_mean_of_its_patch(anchored):
    x = bent(np.asarray(anchored.mesh.nodes))
    lines = [line for line in plot.beam(anchored, x).lines if "tendon" in line.get_label()]
    for line, (first, last) in zip(lines, anchored.terms[1].params.ends, strict=True):
        members, weights = patch(anchored.mesh, int(last), WIDTH)
        np.testing.assert_allclose(line.get_xydata(), [x[first], weights @ x[members]], atol=1e-13)
        assert line.get_marker() == "o"


def test_patch_is_drawn_along_the_surface_as_far_as_it_reaches(anchored):
    """Twice the width at rest, half of it on each side of the anchor, in the colour of the tendon."""
    rest = np.asarray(anchored.mesh.nodes)
    ax = plot.beam(anchored, rest)
    (held,) = (c for c in ax.collections if c.get_linewidths()[0] == 2.8)
    parts = held.get_segments()
    colours = [line.get_color() for line in ax.lines if "tendon" in line.get_label()]
    assert len(parts) == len(held.get_colors()) == 2 * 2 * 2  # tendons, sides, edges: one and a part of the next
    for _, last in anchored.terms[1].params.ends:
        mine = [part for part in parts if part[0, 1] * rest[last, 1] > 0]
        np.testing.assert_allclose(sum(lengths(mine)), 2 * WIDTH, rtol=1e-12)
        points = np.concatenate(mine)
        np.testing.assert_allclose(
            [points[:, 0].min(), points[:, 0].max()], rest[last, 0] + [-WIDTH, WIDTH], atol=1e-12
        )
        np.testing.assert_allclose(points[:, 1], rest[last, 1], atol=1e-12)
    assert {tuple(c) for c in held.get_colors()} == {tuple(to_rgba(colour)) for colour in colours}
    # In another state it lies on the surface: on the parabolas, or on the chords, that are drawn of it.
    moved = collections(plot.beam(anchored, bent(rest)))[1]
    for part, before in zip(moved[2.8], parts, strict=True):
        np.testing.assert_allclose(part[0], bent(before[:1])[0], atol=1e-12)  # starts at a node
        assert max(distance(point, moved[0.9]) for point in part) < 1e-3  # chords of a parabola of an edge of 0.44


def test_patch_runs_round_a_corner(scene):
    pulls = jb.tendons(scene.mesh, [[2, 20]], 1.0, width=np.array([[0.0, 0.5]]))
    cornered = jb.Scene(scene.mesh, (scene.terms[0], pulls), scene.fixed)
    _, lines = collections(plot.beam(cornered, scene.mesh.nodes))
    np.testing.assert_allclose(sorted(lengths(lines[2.8])), [0.1, 0.4, 0.5], rtol=1e-12)


def test_patches_and_curved_edges_move_in_animations(anchored):
    rest = np.asarray(anchored.mesh.nodes)
    x = np.stack([rest + t * (bent(rest) - rest) for t in (0.0, 0.5, 1.0)])
    states = plot.States(anchored, jb.commands([0.4, 1.0], 3), x)
    ends = anchored.terms[1].params.ends[:, 1]
    for frame, (ax,) in frames_of(plot.animate_ramp(states)):
        body, lines = collections(ax)
        bounds = (ax.get_xlim(), ax.get_ylim())
        assert all(inside(path.vertices, bounds) for path in body.get_paths())
        np.testing.assert_allclose([lines[2.8][0][0], lines[2.8][4][0]], x[frame][ends], atol=1e-12)
        assert len(lines[2.8]) == 8
        assert len(ax.collections) == 6  # at rest, body, outline, patches, hatching and line of the clamp


# --------------------------------------------------------------------------------------------- rods


@pytest.fixture(scope="module")
def rod():
    """A rod with a tendon on either side of its first half, wound around a circle in three states."""
    scene = jb.rod_beam(7, length=3.0, height=0.8)
    along = np.asarray(scene.mesh.nodes)[:, 0] + 1.5
    curvature = np.array([1e-9, 0.25, 0.5])[:, None]
    turn = curvature * along
    x = np.stack([np.sin(turn) / curvature - 1.5, (1 - np.cos(turn)) / curvature, 0.8 * turn], axis=2)
    return plot.States(scene, jb.commands([0.4, 1.0], 3), x, "rod")


def test_rod_is_its_centre_line_with_tendons_on_arms(rod):
    x = rod.x[-1]
    ax = plot.beam(jb.command(rod.scene, [0.4, 1.0]), x)
    segments = [c.get_segments() for c in ax.collections if hasattr(c, "get_segments")]
    centre, arms = (next(s for s in segments if len(s) == n and s[-1][-1, 1] > 0) for n in (6, 4))
    np.testing.assert_allclose(centre, x[rod.scene.mesh.elements, :2])
    np.testing.assert_allclose(lengths(arms), 0.4, rtol=1e-12)
    first, second = (line for line in ax.lines if "tendon" in line.get_label())
    ends = [[-1.5, 0.4], [1.6 * np.sin(0.75) - 1.5, 2 - 1.6 * np.cos(0.75)]]
    np.testing.assert_allclose(first.get_xydata(), ends, atol=1e-12)
    # The second lies on the far side of the rod: limits of the nodes alone would cut it off.
    assert inside(second.get_xydata(), (ax.get_xlim(), ax.get_ylim()))
    (wall,) = (c.get_segments() for c in ax.collections if c.get_linewidths()[0] == 2.2)
    np.testing.assert_allclose(np.sort(wall[0], axis=0), [[-1.5, -SECTION * 3], [-1.5, SECTION * 3]], atol=1e-12)


def test_rod_in_animations_galleries_and_fields(rod):
    for frame, (ax,) in frames_of(plot.animate_ramp(rod)):
        segments = [c.get_segments() for c in ax.collections if hasattr(c, "get_segments")]
        assert any(np.array_equal(s, rod.x[frame][rod.scene.mesh.elements, :2]) for s in segments if len(s) == 6)
        assert inside(rod.x[frame][:, :2], (ax.get_xlim(), ax.get_ylim()))
    assert len(plot.gallery(rod).axes) == 3
    turns = np.diff(rod.x[-1][:, 2]) * np.arange(1, 7)
    body, _ = collections(plot.field(rod.scene, rod.x[-1], turns, "turn"))
    np.testing.assert_array_equal(body.get_array(), turns)
    assert body.get_linewidths()[0] > 3


def test_errors_name_the_argument(scene, states):
    with pytest.raises(ValueError, match=r"x: expected node positions of shape \(21, 2\), got \(3, 2\)"):
        plot.beam(scene, np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"x: expected .*, got a Solution; give its positions, solution.x"):
        plot.beam(scene, jb.Solution(*[scene.mesh.nodes] * len(dataclasses.fields(jb.Solution))))
    with pytest.raises(ValueError, match="x: some positions are not finite"):
        plot.beam(scene, np.full((21, 2), np.nan))
    with pytest.raises(
        ValueError, match=r"values: expected shape \(21,\), one for each node or \(24,\), .*, got \(22,\)"
    ):
        plot.field(scene, scene.mesh.nodes, np.zeros(22), "")
    with pytest.raises(ValueError, match="values: element 5 is not finite"):
        plot.field(scene, scene.mesh.nodes, np.where(np.arange(24) == 5, np.inf, 0.0), "")
    with pytest.raises(ValueError, match=r"commands: expected shape \(s, 2\), a row for each state, got \(5,\)"):
        plot.States(scene, states.commands[:, 0], states.x)
    with pytest.raises(ValueError, match=r"x: expected shape \(5, 21, 2\), one entry for each command"):
        plot.States(scene, states.commands, states.x[:3])
    with pytest.raises(ValueError, match="x: state 2 is not finite"):
        plot.States(scene, states.commands, np.where(np.arange(5)[:, None, None] == 2, np.nan, states.x))
    with pytest.raises(ValueError, match="states: expected at least one"):
        plot.curves([])
    with pytest.raises(ValueError, match="states: expected at least one"):
        plot.animate_beams([])
    shorter = plot.States(scene, states.commands[:3], states.x[:3])
    with pytest.raises(ValueError, match=r"states: expected as many states in each, got \[5, 3\]"):
        plot.animate_beams([states, shorter])
    with pytest.raises(ValueError, match="titles: expected 5, one for each state, got 1"):
        plot.gallery(states, ["one"])
    with pytest.raises(ValueError, match="columns: expected at least 1, got 0"):
        plot.gallery(states, columns=0)


def test_a_branch_of_one_point_is_drawn():
    """It has no line, and does not stop others from being drawn."""
    scene = jb.tendon_beam(5, 3)
    short = jb.trace_branch(scene, [0.8, 1.0], max_points=1)
    longer = jb.trace_branch(scene, [0.8, 1.0], step=0.5)
    ax = plot.branches(scene, [short, longer])
    assert len(ax.lines) == 1
