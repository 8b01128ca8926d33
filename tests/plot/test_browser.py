"""The harness that drives figures in a real browser, on a figure of its own."""

import io
import json

import numpy as np
import pytest
from browser import missing, report, shown
from PIL import Image

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())


def figure():
    """Axes from (0, 0) to (4, 2), and a slider from 0 to 10 below; every event is reported."""
    import matplotlib.pyplot as plt
    from matplotlib.widgets import Slider

    fig = plt.figure(figsize=(6, 4), dpi=100)
    axes, below = fig.add_axes((0.1, 0.3, 0.8, 0.6)), fig.add_axes((0.1, 0.1, 0.7, 0.05))
    axes.set(xlim=(0, 4), ylim=(0, 2))
    (dot,) = axes.plot([], [], "o", color="red", markersize=20)
    fig.slider = Slider(below, "value", 0, 10, valinit=2)
    fig.slider.on_changed(lambda value: report(name="slider", value=float(value)))

    def moved(event):
        if event.inaxes is axes:
            dot.set_data([event.xdata], [event.ydata])
            fig.canvas.draw_idle()
            report(name="moved", at=[float(event.xdata), float(event.ydata)], pressed=bool(event.buttons))

    fig.canvas.mpl_connect("motion_notify_event", moved)
    fig.canvas.mpl_connect("key_press_event", lambda event: report(name="key", key=event.key))
    report(name="boxes", axes=list(axes.bbox.extents), slider=list(below.bbox.extents))


@pytest.fixture(scope="module")
def page():
    with shown(__file__, "figure") as page:
        yield page


def boxes(page):
    """Boxes of the axes and of the slider on the canvas, in pixels: left, bottom, right, top."""
    found = next(json.loads(line) for line in page.figure.lines if '"boxes"' in line)
    return found["axes"], found["slider"]


def inside(page, box, x, y):
    """The place on the page of shares `x` and `y` of the width and height of a box."""
    left, bottom, right, top = box
    return page.place(left + x * (right - left), bottom + y * (top - bottom))


def test_a_slider_follows_the_mouse(page):
    slider = boxes(page)[1]
    page.drag(inside(page, slider, 0.2, 0.5), inside(page, slider, 0.7, 0.5))
    event = page.wait_for(lambda event: event["name"] == "slider" and event["value"] > 6.9)
    # A pixel of the slider is 0.024.
    assert event["value"] == pytest.approx(7, abs=0.03)


def test_a_drag_arrives_in_data_coordinates(page):
    axes = boxes(page)[0]
    page.drag(inside(page, axes, 0.25, 0.25), inside(page, axes, 0.75, 0.5), steps=5)
    event, passed = None, []
    while event is None or event["at"][0] < 2.99:
        event = page.wait_for(lambda event: event["name"] == "moved")
        passed.append(event["at"])
    assert event["pressed"] and event["at"] == pytest.approx([3, 1], abs=0.01)
    assert len(passed) >= 5 and (np.diff(np.array(passed), axis=0) >= 0).all()
    page.move(inside(page, axes, 0.5, 0.5))
    event = page.wait_for(lambda event: event["name"] == "moved" and event["at"][0] < 2.1)
    assert not event["pressed"] and event["at"] == pytest.approx([2, 1], abs=0.01)


def test_keys_arrive(page):
    page.click(inside(page, boxes(page)[0], 0.5, 0.9))
    page.press("a", "left")
    for key in ("a", "left"):
        assert page.wait_for(lambda event: event["name"] == "key")["key"] == key


def test_the_picture_shows_what_happened(page):
    """The red dot is drawn where the mouse is, on the screen itself."""
    x, y = (round(value) for value in inside(page, boxes(page)[0], 0.8, 0.2))
    page.move((x, y))
    page.wait_until(
        "const c = document.querySelector('canvas.mpl-canvas'), r = c.getBoundingClientRect();"
        "const [red, green] = c.getContext('2d').getImageData(arguments[0] - r.left, arguments[1] - r.top, 1, 1).data;"
        "return red > 200 && green < 50",
        x,
        y,
    )
    picture = np.array(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
    red = (picture[..., 0] > 200) & (picture[..., 1:] < 50).all(axis=-1)
    # A disk of 20 points at 100 dots an inch.
    centre = np.argwhere(red[y - 20 : y + 20, x - 20 : x + 20]).mean(axis=0) - 20
    np.testing.assert_allclose(centre, 0, atol=1.5)
    assert picture.shape[1] == 1000 and 500 < red.sum() < 1000


def test_waits_have_an_end(page):
    with pytest.raises(TimeoutError, match="wrote nothing that was waited for"):
        page.wait_for(lambda event: event["name"] == "nothing", seconds=0.2)
    with pytest.raises(RuntimeError, match="javascript error"):
        page.run("return nothing.at.all")
