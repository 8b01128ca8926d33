"""The window is driven by the events that a mouse and a keyboard make; what it shows is judged by solves of its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slender_beam
from matplotlib.backend_bases import KeyEvent, MouseButton, MouseEvent
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from PIL import Image

import jaxbeam as jb
from jaxbeam import plot
from jaxbeam.plot.drawing import WRONG
from jaxbeam.plot.view import HEIGHT, WIDTH

# Solves stop at a relative residual of 1e-10, and the search for a tip at 1e-8 of the body.
SOLVED, FOLLOWED = 1e-8, 1e-6


def small_beam():
    return jb.tendon_beam(5, 3)


def window_on(scene, **options):
    figure = Figure(figsize=(WIDTH, HEIGHT))
    FigureCanvasAgg(figure)
    return plot.Window(figure, scene, **options)


@pytest.fixture(scope="module")
def opened():
    """A window on a small beam, compiled; each test begins at rest."""
    return window_on(small_beam()).wait()


@pytest.fixture
def window(opened):
    opened.colour("0")
    opened.wait()
    opened.rest()
    return opened.wait()


def mouse(window, name, place, axes=None, button=MouseButton.LEFT):
    """An event of the mouse near a place in the units of the axes; where it is, as events count whole pixels."""
    axes = axes or window.view.axes
    x, y = (int(pixel) for pixel in axes.transData.transform(place))
    button = None if name == "motion_notify_event" else button
    MouseEvent(name, window.view.canvas, x, y, button=button)._process()
    return axes.transData.inverted().transform((x, y))


def press(window, key):
    KeyEvent("key_press_event", window.view.canvas, key)._process()
    window.wait()


def take_tip(window, beside=(0.0, 0.0)):
    """Press at the tip or beside it; how far the tip is from the mouse."""
    tip = window.view.tip
    return tip - mouse(window, "button_press_event", tip + np.asarray(beside))


def drag_to(window, place):
    """Move the mouse there; where it is."""
    at = mouse(window, "motion_notify_event", place)
    window.wait()
    return at


def let_go(window):
    mouse(window, "button_release_event", window.view.tip)


def drawn(window):
    """Vertices of the elements that are drawn."""
    paths = window.view.picture.artists[0].get_paths()
    return np.array([path.vertices[:3] for path in paths])


def solved(scene, commands):
    return np.asarray(jb.check(jb.equilibrium(jb.command(scene, commands))).x)


# ------------------------------------------------------------------------------------------------ solves


def test_it_says_that_it_compiles():
    window = window_on(jb.tendon_beam(7, 3, young=2e4))
    assert window.view.said == "compiling: the solver ..." and window.view.frames == 1
    assert window.shown is None and window.view.tip is None
    window.wait()
    assert window.view.said == "OK: converged, stable, not inverted"
    np.testing.assert_allclose(window.view.tip, [1.75, 0.0], atol=1e-12)


def test_a_slider_sets_its_command(window):
    """By the mouse, at three places of the second slider."""
    scene, slider = small_beam(), window.view.sliders[1]
    middle = np.mean(slider.ax.get_ylim())
    mouse(window, "button_press_event", (0.9, middle), slider.ax)
    for value in (0.8, 0.65, 0.7):
        value, _ = mouse(window, "motion_notify_event", (value, middle), slider.ax)
        window.wait()
        np.testing.assert_allclose(window.shown.commands, [1.0, value], atol=1e-12)
        expected = solved(scene, [1.0, value])
        np.testing.assert_allclose(window.shown.solution.x, expected, atol=SOLVED)
        np.testing.assert_allclose(drawn(window), expected[scene.mesh.elements], atol=SOLVED)
        np.testing.assert_allclose(window.view.tip, expected[scene.tip].mean(axis=0), atol=SOLVED)
    mouse(window, "button_release_event", (0.7, middle), slider.ax)


def test_the_facts_are_those_of_the_state(window):
    window.pull([0.7, 0.9])
    window.wait()
    scene, x, facts = window.shown.scene, window.shown.solution.x, dict(window.shown.facts)
    assert facts["tip angle"] == f"{jb.tip_angle(scene, x):+.3f}°"
    assert facts["tensions"] == ", ".join(f"{each:.4g}" for each in jb.tendon_tensions(scene, x))
    assert facts["lengths"] == ", ".join(f"{each:.4g}" for each in jb.tendon_lengths(scene, x))
    assert facts["smallest J"] == f"{jb.smallest_jacobian(scene, x):.3f}"
    assert window.view._names.get_text().split("\n") == list(facts)
    assert window.view._facts.get_text().split("\n") == list(facts.values())
    assert [slider.val for slider in window.view.sliders] == [0.7, 0.9]


def test_the_tip_follows_the_mouse(window):
    """Along a path of twenty points, in a frame each; sliders and tendons follow."""
    scene = small_beam()
    path = [np.asarray(jb.tip_position(scene, solved(scene, [1 - 0.02 * k, 1 - 0.008 * k]))) for k in range(1, 21)]
    offset = take_tip(window)
    for place in path:
        before = window.view.frames
        target = drag_to(window, place - offset) + offset
        assert window.view.frames == before + 1
        np.testing.assert_allclose(window.view.tip, target, atol=FOLLOWED)
        np.testing.assert_allclose([slider.val for slider in window.view.sliders], window.shown.commands)
        expected = solved(scene, window.shown.commands)
        np.testing.assert_allclose(drawn(window), expected[scene.mesh.elements], atol=SOLVED)
        assert not window.shown.reasons and window.shown.target is None
    let_go(window)
    np.testing.assert_allclose(window.shown.commands, [0.6, 0.84], atol=0.01)  # a pixel is 0.008 wide
    before = window.view.frames
    mouse(window, "motion_notify_event", path[0])
    assert window.wait().view.frames == before


def test_only_the_circle_can_be_taken_and_not_while_zooming(window):
    tip, before = window.view.tip, window.view.frames
    up = tip + np.array([0.0, 0.3])
    take_tip(window, beside=(-0.5, -0.2))
    drag_to(window, up)
    mouse(window, "button_press_event", tip, button=MouseButton.RIGHT)
    drag_to(window, up)
    window.view.canvas.widgetlock(window)
    take_tip(window)
    window.view.canvas.widgetlock.release(window)
    drag_to(window, up)
    assert window.view.frames == before


def test_the_tip_keeps_its_distance_from_the_mouse(window):
    """Taken a little beside its middle, it does not jump."""
    tip, beside = window.view.tip, np.array([0.03, -0.02])
    offset = take_tip(window, beside)
    np.testing.assert_allclose(offset, -beside, atol=0.01)
    drag_to(window, tip - offset)
    np.testing.assert_allclose(window.view.tip, tip, atol=0.01)
    target = drag_to(window, tip + np.array([-0.2, 0.25])) + offset
    np.testing.assert_allclose(window.view.tip, target, atol=FOLLOWED)
    let_go(window)


def test_out_of_reach_the_tip_stays_at_the_nearest_point(window):
    """And the bound in the way lights up, until the mouse comes back."""
    scene = small_beam()
    offset = take_tip(window)
    drag_to(window, (1.6, 0.3))
    far = drag_to(window, (0.6, 1.5)) + offset
    shown, view = window.shown, window.view
    nearest = jb.reach(scene, far, jb.tip_position)
    np.testing.assert_allclose(view.tip, nearest.value, atol=FOLLOWED)
    np.testing.assert_array_equal(shown.held, nearest.held)
    held = shown.held != 0
    assert held.any() and not held.all()
    for slider, lit in zip(view.sliders, held, strict=True):
        assert (slider.label.get_color() == WRONG) == lit
        assert (slider.track.get_facecolor() == to_rgba(WRONG)) == lit
    np.testing.assert_allclose(view._wish.get_xydata(), [far])
    assert view.said.startswith("UNREACHABLE: this is the nearest point; tendon 1 is at its bound 0.4")
    drag_to(window, (1.6, 0.3))
    assert not window.shown.held.any() and not len(view._wish.get_xydata())
    assert all(slider.label.get_color() != WRONG for slider in view.sliders)
    let_go(window)


def test_of_what_waits_only_the_newest_is_done(window, monkeypatch):
    asked, solve = [], window.steering.set
    monkeypatch.setattr(window.steering, "set", lambda commands: asked.append(commands) or solve(commands))
    for k in range(50):
        window.pull([1 - 0.005 * k, 1.0])
    window.wait()
    np.testing.assert_allclose(window.shown.commands, [0.755, 1.0])
    assert len(asked) < 50
    np.testing.assert_allclose(window.shown.solution.x, solved(small_beam(), [0.755, 1.0]), atol=SOLVED)


def test_an_error_is_shown_and_the_window_lives_on(window, monkeypatch):
    def broken(commands):
        raise RuntimeError("the lamp went out")

    with monkeypatch.context() as patch:
        patch.setattr(window.steering, "set", broken)
        window.pull([0.9, 1.0])
        window.wait()
    assert window.view.said == "RuntimeError: the lamp went out"
    window.pull([0.9, 1.0])
    assert window.wait().view.said.startswith("OK")


# ------------------------------------------------------------------------------------------- what is shown


@pytest.mark.parametrize(
    ("key", "measure"),
    [
        ("1", jb.nodal_von_mises_stress),
        ("2", lambda scene, x: jb.to_nodes(scene, jb.jacobians(scene, x))),
        ("3", lambda scene, x: jb.to_nodes(scene, jb.strain_energy_density(scene, x))),
    ],
)
def test_a_key_shows_a_field(window, key, measure):
    """Its colours follow the state, and their scale what the field needs."""
    press(window, key)
    for commands in ([0.99, 1.0], [0.7, 1.0], [0.5, 0.9], [0.95, 1.0]):
        window.pull(commands)
        window.wait()
        expected = np.asarray(measure(window.shown.scene, window.shown.solution.x))
        mesh = window.view.picture.artists[0]
        np.testing.assert_allclose(window.view.picture.values, expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(mesh.get_array(), expected[small_beam().mesh.elements].ravel(), rtol=1e-9)
        spread, centre = mesh.norm.vmax - mesh.norm.vmin, 1.0 if key == "2" else 0.0
        reach = np.abs(expected - centre).max()
        assert 0.2 * reach < spread < 5 * reach
    press(window, "0")
    assert window.view.picture.values is None


def test_the_key_r_goes_back_to_rest(window):
    window.pull([0.6, 0.9])
    window.wait()
    press(window, "r")
    np.testing.assert_allclose(window.shown.commands, 1)
    np.testing.assert_allclose(window.shown.solution.x, small_beam().mesh.nodes, atol=1e-12)


def test_a_state_that_passes_through_itself_is_marked(window):
    """Its outline is red and dashed, and its remedy stands beside it. The next one is approached from before it."""
    odd = window_on(jb.tendon_beam(), bounds=(0.1, 1.0)).wait()
    for commands, overlaps in (([0.4, 1.0], False), ([0.12, 1.0], True), ([0.5, 1.0], False)):
        odd.pull(commands)
        odd.wait()
        assert bool(int(odd.shown.solution.status) & jb.Status.OVERLAPPING) == overlaps
        outline = next(each for each in odd.view.picture.artists if each.get_zorder() == 3)
        assert (to_rgba(WRONG) in map(tuple, outline.get_edgecolor())) == overlaps
        assert odd.view.said.startswith("OVERLAPPING: the body passes through itself" if overlaps else "OK")
    drag_to(odd, odd.view.tip - take_tip(odd))
    assert not odd.shown.reasons


def test_a_solve_that_fails_is_told_and_the_next_goes_on_from_the_last_good_state():
    window = window_on(small_beam(), solver=jb.Newton(max_steps=3)).wait()
    window.pull([0.95, 1.0])
    good = window.wait().shown
    assert not good.reasons
    window.pull([0.4, 0.5])
    failed = window.wait().shown
    assert int(failed.solution.status) & jb.Status.NOT_CONVERGED
    assert window.view.said.startswith("NOT_CONVERGED: no equilibrium was found")
    np.testing.assert_array_equal(window.steering.last.x, good.solution.x)
    window.pull([0.93, 1.0])
    np.testing.assert_allclose(window.wait().shown.solution.x, solved(small_beam(), [0.93, 1.0]), atol=SOLVED)


def test_a_window_may_begin_with_a_state_that_is_not_ok():
    """Its remedy is shown, and a command that is fine is then solved from rest."""
    window = window_on(jb.command(jb.tendon_beam(), [0.12, 1.0]), bounds=(0.1, 1.0)).wait()
    assert window.view.said.startswith("OVERLAPPING: the body passes through itself")
    window.pull([0.7, 1.0])
    assert window.wait().view.said.startswith("OK")
    np.testing.assert_allclose(window.shown.solution.x, solved(jb.tendon_beam(), [0.7, 1.0]), atol=SOLVED)


def test_an_unstable_state_is_marked():
    """A slender beam that is pulled alike on both sides stays straight if the solver may stay on a saddle."""
    window = window_on(slender_beam(13), solver=jb.Newton(escape=False)).wait()
    window.pull([0.8, 0.8])
    assert int(window.wait().shown.solution.status) == jb.Status.UNSTABLE
    assert window.view.said.startswith("UNSTABLE: the equilibrium is a saddle")


def test_the_axes_grow_with_the_body_and_a_saved_picture_shows_it(window, tmp_path):
    window.pull([0.4, 1.0])
    window.wait()
    (x0, x1), (y0, y1) = window.view.axes.get_xlim(), window.view.axes.get_ylim()
    low, high = np.min(window.shown.solution.x, axis=0), np.max(window.shown.solution.x, axis=0)
    assert x0 < low[0] < high[0] < x1 and y0 < low[1] < high[1] < y1
    window.view.figure.savefig(tmp_path / "window.png", dpi=50)
    pixels = np.asarray(Image.open(tmp_path / "window.png").convert("RGB"), int)
    body = np.abs(pixels - [0xDC, 0xE5, 0xEE]).max(axis=2) < 12
    window.view._facts.set_text("")
    window.view.figure.savefig(tmp_path / "bare.png", dpi=50)
    bare = np.asarray(Image.open(tmp_path / "bare.png").convert("RGB"), int)
    assert (bare != pixels).any(axis=2).sum() > 50  # the facts are in the picture too
    assert body.sum() > 500


@pytest.mark.slow
def test_a_beam_under_pressure_and_a_rod_are_steered_too():
    rod = window_on(jb.rod_beam(5)).wait()
    offset = take_tip(rod)
    target = drag_to(rod, (1.6, 0.4)) + offset
    np.testing.assert_allclose(rod.view.tip, target, atol=FOLLOWED)
    assert rod.view.said.startswith("OK")
    press(rod, "1")
    assert rod.view.said.startswith("no von Mises stress: scene: expected a solid term")
    mesh = jb.rectangle(4.0, 1.0, 9, 3)
    terms = jb.solid(mesh, jb.lame(1e3, 0.3)), jb.pressure(mesh, jb.nodes_where(mesh, lambda x, y: y > 0.49))
    ends = jb.clamped(mesh, jb.nodes_where(mesh, lambda x, y: abs(x) > 1.99))
    blown = window_on(jb.Scene(mesh, terms, ends), bounds=(0.0, 5.0)).wait()
    assert [slider.label.get_text() for slider in blown.view.sliders] == ["pressure"] and blown.view.tip is None
    blown.pull([2.0])
    blown.wait()
    np.testing.assert_allclose(blown.shown.solution.x, solved(blown.steering.scene, [2.0]), atol=SOLVED)


# ------------------------------------------------------------------------------------------------ the rest


def test_a_marker_can_be_dragged_instead_of_the_tip():
    scene = small_beam()
    place = jb.marker(scene, [0.9, 0.2])
    window = window_on(scene, measure=place).wait()
    np.testing.assert_allclose(window.view.tip, [0.9, 0.2], atol=1e-12)
    offset = take_tip(window)
    target = drag_to(window, place(scene, solved(scene, [0.8, 0.9]))) + offset
    np.testing.assert_allclose(place(scene, window.shown.solution.x), target, atol=FOLLOWED)


def test_what_cannot_be_steered_is_refused():
    bare = small_beam()
    with pytest.raises(ValueError, match="scene: expected at least one tendon to command"):
        window_on(jb.Scene(bare.mesh, bare.terms[:1], bare.fixed))
    with pytest.raises(ValueError, match=r"bounds: expected some that hold the commands of the scene \[0.3, 1.0\]"):
        window_on(jb.command(bare, [0.3, 1.0]))
    with pytest.raises(ValueError, match="backend: expected one of matplotlib's that opens a window, got 'agg'"):
        plot.interact(bare)


def test_a_closed_window_solves_nothing():
    window = window_on(small_beam()).wait()
    before = window.view.frames
    window.view.canvas.callbacks.process("close_event", None)
    take_tip(window)
    drag_to(window, window.view.tip + np.array([0.0, 0.2]))
    press(window, "1")
    assert window.view.frames == before


def test_float32_is_steered_without_float64():
    with jax.enable_x64(False):
        window = window_on(jb.tendon_beam(7, 3, dtype=jnp.float32)).wait()
        window.pull([0.8, 1.0])
        assert window.wait().shown.solution.x.dtype == jnp.float32 and window.view.said.startswith("OK")
        take_tip(window)
        drag_to(window, window.view.tip + np.array([-0.05, 0.05]))
        assert window.view.said.startswith("OK")
