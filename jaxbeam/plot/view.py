"""What is seen in the window: the picture with its tip, sliders, texts, and how a frame is drawn.

A frame redraws what moves on a stored background: all of a figure would take several times as long.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.widgets import Button, Slider

from jaxbeam.core.tree import Numbers
from jaxbeam.plot.drawing import OUTLINE, PALETTE, WRONG, Limits, limits
from jaxbeam.plot.fields import Field
from jaxbeam.plot.lines import command_names, extremes
from jaxbeam.plot.picture import Picture
from jaxbeam.plot.steering import Shown, Steering
from jaxbeam.scene.scene import Scene

HINT = "drag the circle; keys: 1 stress, 2 J, 3 energy, 0 plain, r rest"
# Room around the body, as a share of its size.
ROOM = 0.12
# A colour scale is made anew if the field goes less far, or farther, than these shares of what it was made for.
FADED, GLARING = 0.5, 1.4
# Inches: width and height of a window without sliders, and height of a row with a slider.
WIDTH, HEIGHT, ROW = 10.5, 5.4, 0.34
# Characters of a line of text.
LINE = 38
GOOD = "#1B7F3B"


class View:
    """The picture, sliders and texts of a window, on a figure that is empty.

    `frames` counts how often it was drawn.
    """

    def __init__(self, figure: Figure, steering: Steering, bounds: Limits | None) -> None:
        self.figure, self.canvas, self.steering, self.frames = figure, figure.canvas, steering, 0
        self.field: Field | None = None
        self._background: Any = None
        names = command_names(steering.scene)
        height = float(figure.get_size_inches()[1])
        rows = len(names) * ROW / height
        self.axes = figure.add_axes((0.075, rows + 0.65 / height, 0.565, 1 - rows - 0.8 / height))
        left, top = 0.765, 1 - 0.2 / height
        look: dict[str, Any] = {"va": "top", "fontsize": 9, "linespacing": 1.5}
        self._names = figure.text(left, top, "", **look)
        self._facts = figure.text(left + 0.095, top, "", animated=True, **look)
        self._status = figure.text(left, top - 1.7 / height, "", **look)
        figure.text(0.985, 0.08 / height, HINT, fontsize=7.5, color="0.4", va="bottom", ha="right")
        self.sliders = [
            self._slider(k, name, rows - (k + 0.8) * ROW / height + 0.08 / height) for k, name in enumerate(names)
        ]
        self._held = np.zeros(len(names), int)
        self.button = Button(figure.add_axes((left, 0.4 / height, 0.09, 0.3 / height)), "rest")
        rest = np.asarray(steering.scene.mesh.nodes)
        self._grows = bounds is None
        self._bounds = bounds or self._filled(limits(*extremes(steering.scene, rest[None]), margin=ROOM))
        self.draw_anew(steering.scene, rest)

    def _slider(self, k: int, name: str, bottom: float) -> Slider:
        """The slider of command `k`, at this height of the figure."""
        height = 0.5 * ROW / float(self.figure.get_size_inches()[1])
        ax, ends = self.figure.add_axes((0.14, bottom, 0.49, height)), (self.steering.low[k], self.steering.high[k])
        look: dict[str, Any] = {"valfmt": "%.4g", "color": PALETTE[k % len(PALETTE)], "initcolor": "none"}
        slider = Slider(ax, name, *map(float, ends), valinit=float(self.steering.start[k]), **look)
        slider.drawon = False
        for artist in (slider.poly, slider.valtext, *ax.lines):
            artist.set_animated(True)
        return slider

    @property
    def tip(self) -> np.ndarray | None:
        """Where the point is that can be dragged, `(2,)`; None before the first solve, or if there is none."""
        points = np.asarray(self._tip.get_xydata())
        return points[0] if len(points) else None

    def on_slide(self, call: Callable[[np.ndarray], None]) -> None:
        """Call this with all commands `(m,)` when a user has moved a slider."""
        for slider in self.sliders:
            slider.on_changed(lambda value: call(np.array([each.val for each in self.sliders])))

    def set_sliders(self, commands: Numbers) -> None:
        """Move the sliders without calling anything."""
        for slider, value in zip(self.sliders, np.asarray(commands), strict=True):
            slider.eventson = False
            slider.set_val(float(value))
            slider.eventson = True

    def show(self, shown: Shown, sliders: bool) -> None:
        """Draw a state, and set the sliders to its commands if asked to."""
        x, trusted = np.asarray(shown.solution.x), not int(shown.solution.status)
        if not np.isfinite(x).all():
            self.say("\n".join(shown.reasons), wrong=True)
            return
        self._fit(shown.scene, x)
        self.picture.move(x, shown.commands, trusted=trusted)
        if self.field and not FADED * self._reach <= self._reach_of_field() <= GLARING * self._reach:
            self.draw_anew(shown.scene, x)
            self.picture.move(x, shown.commands, trusted=trusted)
        if self.steering.measure is not None:
            self._tip.set_data(*np.asarray(self.steering.measure(shown.scene, shown.solution.x))[:, None])
        self._wish.set_data(*(np.zeros((2, 0)) if shown.target is None else shown.target[:, None]))
        self._light(shown.held)
        if sliders:
            self.set_sliders(shown.commands)
        self._facts.set_text("\n".join(text for _, text in shown.facts))
        names = "\n".join(name + "\n" * text.count("\n") for name, text in shown.facts)
        if names != self._names.get_text():
            self._names.set_text(names)
            self._background = None
        if shown.reasons:
            self.say("\n".join(shown.reasons), wrong=True)
        else:
            self.say("OK: converged, stable, not inverted", good=True)

    def _light(self, held: np.ndarray) -> None:
        """Show the sliders of bounds that are in the way, where `held` `(m,)` is not 0, in red."""
        if np.array_equal(held, self._held):
            return
        self._held, self._background = held, None
        for k, slider in enumerate(self.sliders):
            slider.label.set(color=WRONG if held[k] else "black", fontweight="bold" if held[k] else "normal")
            slider.track.set_facecolor(WRONG if held[k] else "lightgrey")
            slider.poly.set_facecolor(WRONG if held[k] else PALETTE[k % len(PALETTE)])

    def say(self, text: str, *, good: bool = False, wrong: bool = False) -> None:
        """Show a text beside the picture."""
        lines = "\n".join(wrapped for line in text.split("\n") for wrapped in textwrap.wrap(line, LINE))
        if lines != self._status.get_text():
            self._status.set(text=lines, color=WRONG if wrong else GOOD if good else OUTLINE)
            self._background = None
        self.redraw()

    @property
    def said(self) -> str:
        """The text beside the picture, on one line."""
        return self._status.get_text().replace("\n", " ")

    def draw_anew(self, scene: Scene, x: np.ndarray) -> None:
        """Make the picture, with the field that is wanted now."""
        self.axes.clear()
        self.picture = Picture(scene, x, field=self.field, ax=self.axes, bounds=self._bounds)
        circle: dict[str, Any] = {"color": OUTLINE, "markerfacecolor": "none", "markersize": 13, "markeredgewidth": 1.6}
        (self._tip,) = self.axes.plot([], [], "o", **circle)
        (self._wish,) = self.axes.plot([], [], "x", color=WRONG, markersize=9, markeredgewidth=2)
        self._reach = self._reach_of_field()
        self._background = None

    def _reach_of_field(self) -> float:
        """How far the field that is drawn goes from its centre; zero without a field."""
        values, field = self.picture.values, self.field
        return 0.0 if values is None or field is None else float(np.abs(values - (field.centre or 0)).max())

    def _fit(self, scene: Scene, x: np.ndarray) -> None:
        """Let the axes grow if the body does not fit."""
        (x0, x1), (y0, y1) = self.axes.get_xlim(), self.axes.get_ylim()
        low, high = np.array([x0, y0]), np.array([x1, y1])
        points = np.concatenate([each.reshape(-1, 2) for each in extremes(scene, x[None])])
        beyond = np.maximum(low - points.min(axis=0), points.max(axis=0) - high).max()
        if self._grows and beyond > 0:
            self._bounds = self._filled(limits(points, [low, high]))
            self.axes.set(xlim=self._bounds[0], ylim=self._bounds[1])
            self._background = None

    def _filled(self, bounds: Limits) -> Limits:
        """These limits, widened so that a picture to scale fills its axes."""
        shape = self.axes.get_position().size * self.figure.get_size_inches()
        extent = np.ptp(bounds, axis=1)
        more = (shape * (extent / shape).max() - extent) / 2
        (x0, x1), (y0, y1) = bounds
        return (float(x0 - more[0]), float(x1 + more[0])), (float(y0 - more[1]), float(y1 + more[1]))

    def _moving(self) -> list[Artist]:
        """What is drawn anew in each frame, from the lowest to the highest."""
        found: list[Artist] = [*self.picture.artists, self._tip, self._wish, self._facts]
        for artist in found:
            artist.set_animated(True)
        for slider in self.sliders:
            found += [slider.poly, *slider.ax.lines, slider.valtext]
        return found

    def redraw(self) -> None:
        """Draw a frame."""
        moving = self._moving()
        self.frames += 1
        canvas: Any = self.canvas
        if self._background is None:
            canvas.draw()
            return
        canvas.restore_region(self._background)
        for artist in moving:
            artist.draw(canvas.get_renderer())
        canvas.blit(self.figure.bbox)

    def on_draw(self, event: Any) -> None:
        """After all else was drawn: keep it as the background, and draw what moves on top."""
        canvas: Any = self.canvas
        if canvas.is_saving():  # then axes have drawn all that is theirs
            self._facts.draw(event.renderer)
            return
        if isinstance(canvas, FigureCanvasAgg) and event.canvas is canvas:
            self._background = canvas.copy_from_bbox(self.figure.bbox)
        for artist in self._moving():
            artist.draw(event.renderer)
