"""Animations of ramps and of beams side by side."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
from matplotlib import rc_context
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxbeam.plot.acting import Acted, Acting, to_one_scale
from jaxbeam.plot.drawing import (
    OUTLINE,
    PAPER,
    add_legend,
    command_title,
    doing_of,
    fit_height,
    limits,
    panels,
    prepare,
)
from jaxbeam.plot.fields import Field, Function, Scale, field_of, scales_of
from jaxbeam.plot.lines import extremes
from jaxbeam.plot.picture import Panel, add_colour_bar
from jaxbeam.plot.states import States
from jaxbeam.plot.stills import curves
from jaxbeam.scene.measures import tip_angle
from jaxbeam.scene.scene import Scene

# Number of frames for which an animation shows its last state.
HOLD = 6


# ------------------------------------------------------------------------------------------- animations


def animate_ramp(
    states: States,
    measure: Callable[[Scene, jax.Array], jax.Array] = tip_angle,
    label: str = "tip angle (degrees)",
    *,
    field: Field | Function | None = None,
) -> FuncAnimation:
    """A beam in motion, and beside it the curve that it traces.

    Args:
        states: the states to show in order, such as a ramp.
        measure: as in `curves`.
        label: text of the curve's vertical axis: quantity and unit.
        field: what to show in colour: a function `(scene, x)`, or a `Field` of one.
    """
    figure = Figure(figsize=(PAPER, 0.5 * PAPER), layout="constrained")
    left, right = figure.subplots(1, 2)
    acting = Acting(states.scene)
    seen = acting.see_all(states.commands, states.x)
    prepare(left, limits(*extremes(states.scene, states.x), *acting.extremes(seen)))
    curves([states], measure, label, ax=right)
    # The whole curve stays as a pale trace, so that the axes do not move, and one line on top of it grows.
    traced = []
    for line in right.get_lines():
        traced.append((right.plot([], [], color=line.get_color(), linewidth=2.0)[0], np.transpose(line.get_data())))
        line.set(alpha=0.3)
    (head,) = right.plot([], [], "o", color=OUTLINE, markersize=6)

    def trace(frame: int) -> None:
        for line, points in traced:
            line.set_data(*points[: frame + 1].T)
        head.set_data(*np.transpose([points[frame] for _, points in traced]))

    return _play(figure, [left], [states], [acting], [seen], field, trace)


def animate_beams(states: Sequence[States], *, field: Field | Function | None = None) -> FuncAnimation:
    """Several beams side by side, to one scale and in step.

    Args:
        states: one for each panel, all with the same number of states.
        field: what to show in colour: a function `(scene, x)`, or a `Field` of one. All panels have one colour scale.

    Raises:
        ValueError: if `states` is empty, the numbers of states differ, or the field is not one of a function or has
            values that cannot be drawn.
    """
    if not states:
        raise ValueError("states: expected at least one States, got none")
    if len({len(each) for each in states}) > 1:
        raise ValueError(f"states: expected as many states in each, got {[len(each) for each in states]}")
    acting = [Acting(each.scene) for each in states]
    seen = [outer.see_all(each.commands, each.x) for outer, each in zip(acting, states, strict=True)]
    to_one_scale(acting)
    points = [extremes(each.scene, each.x) for each in states]
    points += [outer.extremes(shown) for outer, shown in zip(acting, seen, strict=True)]
    figure, axes = panels(len(states), [limits(*itertools.chain(*points))])
    return _play(figure, axes, states, acting, seen, field)


def save_animation(animation: FuncAnimation, path: str | Path, fps: int = 12, dpi: float = 110) -> None:
    """Write an animation as `.gif`, which needs no other program, or as `.mp4`, which needs ffmpeg.

    Args:
        animation: from `animate_ramp` or `animate_beams`.
        path: of the file; its ending decides the format.
        fps: frames per second.
        dpi: pixels per inch.

    Raises:
        ValueError: if the ending is another one, or ffmpeg is needed and not installed.
    """
    ending = Path(path).suffix.lower()
    writer: AbstractMovieWriter
    if ending == ".gif":
        writer = PillowWriter(fps=fps)
    elif ending == ".mp4":
        if not FFMpegWriter.isAvailable():
            raise ValueError(f"path: {path} needs ffmpeg, which is not installed; install it or save as .gif")
        writer = FFMpegWriter(fps=fps)
    else:
        raise ValueError(f"path: expected an ending of .gif or .mp4, got {str(path)!r}")
    animation.save(path, writer=writer, dpi=dpi)


def _play(
    figure: Figure,
    axes: Sequence[Axes],
    states: Sequence[States],
    acting: Sequence[Acting],
    seen: Sequence[Sequence[Acted]],
    field: Field | Function | None,
    trace: Callable[[int], None] = lambda frame: None,
) -> FuncAnimation:
    """Animate each of `states`, and what acts on it, on its axes.

    `trace(frame)` draws whatever else changes from frame to frame.
    """
    field = field_of(field)
    doing, values = [each.measure(doing_of) for each in states], [each.values(field) for each in states]
    drawn = zip((each.scene for each in states), values, strict=True)
    scales: Sequence[Scale | None] = scales_of(field, list(drawn)) if field else [None] * len(states)
    beams = [Panel(*each) for each in zip(axes, acting, scales, strict=True)]
    if field and scales[-1]:
        add_colour_bar(figure, axes, beams, field.label, scales[-1])
    add_legend(figure, acting, doing)

    def draw(frame: int) -> None:
        for panel, shown, each, does, colours in zip(beams, seen, states, doing, values, strict=True):
            panel.show(shown[frame], does[frame], colours[frame])
            title = "\n".join(filter(None, [each.title, command_title(each.scene, each.commands[frame])]))
            panel.ax.set_title(title, fontsize="medium")
        trace(frame)

    # Lay out the panels once: a new layout for every frame would be slow, and the panels would jitter.
    draw(0)
    fit_height(figure, axes[:1])
    figure.draw_without_rendering()
    # Give None, not "none": that sets a placeholder, with which each frame is drawn twice. None stands for the engine
    # that `rcParams` ask for, so they must ask for none here.
    with rc_context({"figure.autolayout": False, "figure.constrained_layout.use": False}):
        figure.set_layout_engine(None)
    last = len(states[0]) - 1
    return FuncAnimation(figure, draw, frames=[*range(last), *[last] * HOLD], interval=80, cache_frame_data=False)
