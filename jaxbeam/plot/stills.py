"""Curves of measures, branches of equilibria, and galleries of states.

`jaxbeam.plot` describes what all pictures have in common.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxbeam.plot.acting import Acting
from jaxbeam.plot.drawing import (
    MARKERS,
    OUTLINE,
    PALETTE,
    PAPER,
    UNSTABLE,
    add_legend,
    command_title,
    doing_of,
    fit_height,
    limits,
    panels,
)
from jaxbeam.plot.fields import Field, Function, field_of, scales_of
from jaxbeam.plot.lines import extremes
from jaxbeam.plot.picture import Panel, add_colour_bar
from jaxbeam.plot.states import States
from jaxbeam.scene.measures import tip_angle
from jaxbeam.scene.scene import Scene
from jaxbeam.study.branch import Branch

# Number of characters of titles side by side.
CHARACTERS = 72


def curves(
    states: Sequence[States],
    measure: Callable[[Scene, jax.Array], jax.Array] = tip_angle,
    label: str = "tip angle (degrees)",
    *,
    ax: Axes | None = None,
) -> Axes:
    """A measure against the command that varies most, such as the ratio of a tendon, which falls to the right.

    Args:
        states: ramps or sweeps; every state is marked, and each ramp or sweep has a marker of its own.
        measure: `(scene, x)` to a scalar, drawn once for each of `states`, or to `(m,)`, drawn for each tendon.
        label: text of the vertical axis: quantity and unit.
        ax: where to draw; by default a new figure.

    Raises:
        ValueError: if `states` is empty.
    """
    if not states:
        raise ValueError("states: expected at least one States, got none")
    if ax is None:
        ax = Figure(figsize=(0.62 * PAPER, 0.42 * PAPER), layout="constrained").add_subplot()
    for number, each in enumerate(states):
        values = each.measure(measure)
        for tendon, line in enumerate(values.reshape(len(each), -1).T):
            many = values.ndim > 1
            names = [each.title] * (len(states) > 1 or not many) + [f"tendon {tendon + 1}"] * many
            ax.plot(
                each.actuation,
                line,
                color=PALETTE[(tendon if many else number) % len(PALETTE)],
                marker=MARKERS[(tendon if many and len(states) == 1 else number) % len(MARKERS)],
                markersize=3.2,
                linewidth=1.2,
                label=", ".join(filter(None, names)),
            )
    _name_actuation_axes(ax, label, all(each.by_ratio for each in states))
    if len(ax.lines) > 1:
        ax.legend(frameon=False, fontsize="small")
    return ax


def branches(
    scene: Scene,
    traced: Sequence[Branch],
    measure: Callable[[Scene, jax.Array], jax.Array] = tip_angle,
    label: str = "tip angle (degrees)",
    *,
    ax: Axes | None = None,
) -> Axes:
    """A measure of branches of equilibria against actuation. Stable parts are full lines, unstable ones dashed.

    A circle marks a fold, and a diamond a bifurcation.

    Args:
        scene: the scene whose branches were traced.
        traced: branches from `trace_branch`, each in the next colour.
        measure: `(scene, x)` to a scalar.
        label: text of the vertical axis: quantity and unit.
        ax: where to draw; by default a new figure.

    Raises:
        ValueError: if `traced` is empty.
    """
    if not traced:
        raise ValueError("traced: expected at least one Branch, got none")
    if ax is None:
        ax = Figure(figsize=(0.62 * PAPER, 0.42 * PAPER), layout="constrained").add_subplot()
    shown, by_ratio = {}, []
    for number, branch in enumerate(traced):
        colour, critical = PALETTE[number % len(PALETTE)], branch.critical
        # Each critical point goes between its neighbours and counts as stable: the line changes its style there.
        order = np.argsort([*range(len(branch.x)), *(each.after + 0.5 for each in critical)])
        commands = np.concatenate([branch.ratios, *(each.ratios[None] for each in critical)])
        x = np.concatenate([branch.x, *(np.asarray(each.x)[None] for each in critical)])
        states = States(scene, commands, x)
        along, values = states.actuation, states.measure(measure)
        by_ratio.append(states.by_ratio)
        negative = np.append(branch.negative, np.zeros(len(critical), int))[order]
        stable = np.maximum(negative[:-1], negative[1:]) == 0
        for run in np.split(np.arange(stable.size), np.flatnonzero(np.diff(stable)) + 1):
            if not run.size:  # a branch of one point has no line
                continue
            points = order[[*run, run[-1] + 1]]
            name = "stable" if stable[run[0]] else "unstable"
            style: Any = "-" if stable[run[0]] else UNSTABLE
            ax.plot(along[points], values[points], color=colour, linestyle=style, linewidth=1.4)
            shown[name] = Line2D([], [], color=OUTLINE, linestyle=style, linewidth=1.4, label=name)
        for place, each in enumerate(critical, len(branch.x)):
            look: dict[str, Any] = {"linestyle": "", "color": OUTLINE, "markersize": 5, "zorder": 4}
            look |= {"marker": "D"} if each.kind == "bifurcation" else {"marker": "o", "markerfacecolor": "white"}
            ax.plot(along[place], values[place], **look)
            shown[each.kind] = Line2D([], [], label=each.kind, **look)
    _name_actuation_axes(ax, label, all(by_ratio))
    ax.legend(handles=list(shown.values()), frameon=False, fontsize="small")
    return ax


def gallery(
    states: States, titles: Sequence[str] | None = None, columns: int = 3, *, field: Field | Function | None = None
) -> Figure:
    """A panel for each state, all to one scale.

    Args:
        states: the states to show, such as a sweep over asymmetric commands.
        titles: one for each state; by default its ratios.
        columns: number of panels in a row.
        field: what to show in colour: a function `(scene, x)`, or a `Field` of one. All panels have one colour scale.

    Raises:
        ValueError: if the titles are not one for each state, `columns` is less than 1, or the field is not one of a
            function or has values that cannot be drawn.
    """
    if titles is None:
        wide = int(CHARACTERS / min(max(columns, 1), len(states)))
        titles = [textwrap.fill(command_title(states.scene, row), wide) for row in states.commands]
    if len(titles) != len(states):
        raise ValueError(f"titles: expected {len(states)}, one for each state, got {len(titles)}")
    if columns < 1:
        raise ValueError(f"columns: expected at least 1, got {columns}")
    columns = min(columns, len(states))
    acting = Acting(states.scene)
    seen = acting.see_all(states.commands, states.x)
    hold = lambda shown: limits(*extremes(states.scene, states.x[shown]), *acting.extremes([seen[k] for k in shown]))
    every = range(len(states))
    across = hold(every)[0]
    rows = [(across, hold(every[k : k + columns])[1]) for k in every[::columns]]
    figure, axes = panels(columns, rows)
    for k in range(len(states), len(axes)):
        axes[k].remove()
        axes[k - columns].tick_params(labelbottom=True)
        axes[k - columns].set_xlabel("x (length units)")
    field = field_of(field)
    doing, values = states.measure(doing_of), states.values(field)
    (scale,) = scales_of(field, [(states.scene, values)]) if field else (None,)
    beams = [Panel(ax, acting, scale) for ax in axes[: len(states)]]
    for panel, title, *each in zip(beams, titles, seen, doing, values, strict=True):
        panel.ax.set_title(title, fontsize="medium")
        panel.show(*each)
    if field and scale:
        add_colour_bar(figure, axes[: len(states)], beams, field.label, scale)
    add_legend(figure, [acting], [doing])
    fit_height(figure, axes[::columns])
    return figure


def _name_actuation_axes(ax: Axes, label: str, by_ratio: bool) -> None:
    """Label the axes of a measure against a command. Ratios fall to the right, so that actuation grows."""
    ax.set(xlabel="commanded ratio (dimensionless)" if by_ratio else "command (its unit)", ylabel=label)
    if by_ratio and not ax.xaxis_inverted():
        ax.invert_xaxis()
    ax.grid(color="0.9", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
