"""The window in a real browser: matplotlib's WebAgg serves it, and headless Chromium moves the mouse."""

import io

import numpy as np
import pytest
from browser import missing, report, shown
from PIL import Image

import jaxbeam as jb

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())

# A pixel of the window's axes, in units of length; positions of the mouse are whole pixels.
PIXEL = 0.012


def beam():
    return jb.tendon_beam(9, 3)


def window():
    """The window on a beam; every state that it shows is reported, with the place of the tip on the canvas."""
    import jax
    import matplotlib.pyplot as plt

    from jaxbeam import plot
    from jaxbeam.plot.view import HEIGHT, WIDTH

    jax.config.update("jax_enable_x64", True)
    figure = plt.figure(figsize=(WIDTH, HEIGHT), dpi=90)
    opened = plot.Window(figure, beam())
    show = opened.view.show

    def told(state, sliders):
        show(state, sliders)
        view, to_pixels = opened.view, opened.view.axes.transData.transform
        sliders = [slider.ax.bbox.extents.tolist() for slider in view.sliders]
        report(
            name="shown",
            tip=view.tip.tolist(),
            pixel=to_pixels(view.tip).tolist(),
            unit=float(to_pixels((1, 0))[0] - to_pixels((0, 0))[0]),
            commands=state.commands.tolist(),
            x=np.asarray(state.solution.x).tolist(),
            said=view.said,
            field=view.picture.values is not None,
            frames=view.frames,
            sliders=sliders,
            loop=[timer is not None for timer in [opened._timer]],
        )

    opened.view.show = told
    figure.window = opened


@pytest.fixture(scope="module")
def page():
    with shown(__file__, "window", width=1100, height=800) as page:
        state(page, lambda event: event["said"].startswith("OK"), seconds=60)
        yield page


def state(page, found, seconds=10):
    """The next state that is shown and has what is looked for."""
    return page.wait_for(lambda event: event["name"] == "shown" and found(event), seconds)


def at_rest(page):
    """Press r; the state at rest."""
    page.press("r")
    return state(page, lambda event: event["commands"] == [1, 1])


def picture(page):
    return np.array(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)


def count_of(pixels, colour, off=30):
    return int((np.abs(pixels - colour).max(axis=-1) < off).sum())


def test_a_slider_sets_its_command(page):
    rest = at_rest(page)
    left, bottom, right, top = rest["sliders"][0]
    # The slider runs from 0.4 to 1.
    place = lambda ratio: page.place(left + (right - left) * (ratio - 0.4) / 0.6, (bottom + top) / 2)
    page.drag(place(0.98), place(0.7), steps=8)
    found = state(page, lambda event: abs(event["commands"][0] - 0.7) < 0.002)
    expected = jb.check(jb.equilibrium(jb.command(beam(), found["commands"]))).x
    np.testing.assert_allclose(found["x"], expected, atol=1e-6)


def test_the_tip_is_dragged_and_out_of_reach_stays_at_the_nearest_point(page):
    rest = at_rest(page)
    start = np.array(rest["pixel"])
    goal = start + rest["unit"] * np.array([-0.4, 0.7])
    page.drag(page.place(*start), page.place(*goal), steps=20)
    found = state(page, lambda event: np.abs(np.array(event["pixel"]) - goal).max() < 1.5)
    assert found["said"].startswith("OK")
    assert found["frames"] - rest["frames"] > 5
    expected = jb.check(jb.equilibrium(jb.command(beam(), found["commands"]))).x
    np.testing.assert_allclose(found["x"], expected, atol=1e-6)
    start = np.array(found["pixel"])
    page.drag(page.place(*start), page.place(*(start + found["unit"] * np.array([0.3, 0.6]))), steps=10)
    far = state(page, lambda event: event["said"].startswith("UNREACHABLE"))
    assert "is at its bound" in far["said"]
    assert count_of(picture(page), [0xC1, 0x12, 0x1F]) > 300  # the slider of the bound in the way, and the cross


def test_a_key_shows_the_stress(page):
    at_rest(page)
    assert not state_after_key(page, "0")["field"]
    plain = count_of(picture(page), [0xDC, 0xE5, 0xEE], 8)
    assert state_after_key(page, "1")["field"]
    coloured = picture(page)
    assert plain > 5000 > 500 > count_of(coloured, [0xDC, 0xE5, 0xEE], 8)
    assert not state_after_key(page, "0")["field"]


def state_after_key(page, key):
    page.press(key)
    return state(page, lambda event: True)


def test_waits_have_an_end(page):
    with pytest.raises(TimeoutError, match="wrote nothing that was waited for"):
        page.wait_for(lambda event: event["name"] == "nothing", seconds=0.2)
    with pytest.raises(RuntimeError, match="javascript error"):
        page.run("return nothing.at.all")
