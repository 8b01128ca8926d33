"""Pictures hold what they should show, and leave the program around them alone.

Looks are judged by eye; what is tested is what a glance can miss: limits, shapes, frames, labels, errors.
"""

import subprocess
import sys
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.animation import FFMpegWriter
from matplotlib.figure import Figure
from PIL import Image

import jaxbeam as jb
from jaxbeam import plot

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


def frames_of(animation):
    """Axis limits of the panels, frame by frame, as the animation is drawn."""
    animation._draw_was_started = True  # it is not saved here, and matplotlib warns of that
    for frame in animation.new_frame_seq():
        animation._draw_frame(frame)
        yield frame, [ax for ax in animation._fig.axes if ax.get_aspect() == 1]


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
    edges = plot._boundary(scene.mesh.elements)
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


def test_curve_is_the_measure_against_the_ratio_that_varies_most(scene, states):
    ax = plot.curves([states])
    (line,) = ax.lines
    expected = [jb.tip_angle(scene, jnp.asarray(x)) for x in states.x]
    np.testing.assert_allclose(line.get_ydata(), expected, rtol=1e-12)
    np.testing.assert_allclose(line.get_xdata(), states.commands[:, 0], rtol=1e-12)
    assert ax.xaxis_inverted() and ax.get_ylabel() == "tip angle (degrees)" and "dimensionless" in ax.get_xlabel()


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
    assert durations == [100] * (STEPS - 1) + [100 * plot.HOLD]


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
    assert any(line.get_marker() == "s" and len(line.get_xdata()) == 1 for line in ax.lines)


def test_errors_name_the_argument(scene, states):
    with pytest.raises(ValueError, match=r"x: expected node positions of shape \(21, 2\), got \(3, 2\)"):
        plot.beam(scene, np.zeros((3, 2)))
    with pytest.raises(ValueError, match="x: some positions are not finite"):
        plot.beam(scene, np.full((21, 2), np.nan))
    with pytest.raises(ValueError, match=r"values: expected shape \(24,\), one for each element, got \(21,\)"):
        plot.field(scene, scene.mesh.nodes, np.zeros(21), "")
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
