"""Still pictures: a beam, fields on it, curves of measures, branches of equilibria, and galleries of states.

`jaxbeam.plot` describes what all pictures have in common.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from jaxbeam.core.tree import Numbers
from jaxbeam.plot.acting import Acting
from jaxbeam.plot.drawing import (
    MARKERS,
    OUTLINE,
    PALETTE,
    PAPER,
    UNSTABLE,
    Limits,
    _Beam,
    _commands,
    _doing,
    _fit,
    _legend,
    _panels,
    _positions,
    _prepare,
    limits,
)
from jaxbeam.plot.lines import elements_of, extremes
from jaxbeam.plot.loads import draw_acting
from jaxbeam.plot.states import States
from jaxbeam.scene.measures import tip_angle
from jaxbeam.scene.scene import Scene
from jaxbeam.study.branch import Branch

# ----------------------------------------------------------------------------------------------- stills


def beam(scene: Scene, x: Numbers, *, ax: Axes | None = None, bounds: Limits | None = None) -> Axes:
    """The beam with its mesh, tendons, guides and anchors, clamp, what acts on it, and its outline at rest.

    Args:
        scene: under the commands of this state, which decide which tendons push and where obstacles are.
        x: `(n, 2)` node positions.
        ax: where to draw (`ax.legend()` names what is there); by default a new figure with a legend.
        bounds: axis limits, by default those that hold the beam here and at rest, and what acts on it.

    Raises:
        ValueError: if `x` has another shape or is not finite.
    """
    positions = _positions(scene, x)
    acting = Acting(scene, positions[None])
    bounds = bounds or limits(*extremes(scene, positions[None]), *acting.extremes())
    figure, axes = (None, [_prepare(ax, bounds)]) if ax else _panels(1, [bounds])
    doing = np.asarray(_doing(scene, jnp.asarray(positions)))
    _Beam(axes[0], scene).move(positions, doing)
    draw_acting(axes[0], acting)(0)
    if figure:
        _legend(figure, [acting], [doing])
        _fit(figure, axes)
    return axes[0]


def field(
    scene: Scene,
    x: Numbers,
    values: Numbers,
    label: str,
    *,
    centre: float | None = None,
    colours: tuple[float, float] | None = None,
    ax: Axes | None = None,
    bounds: Limits | None = None,
) -> Axes:
    """One value for each element in colour, with a colour bar.

    Sequential colours (viridis), or diverging ones (red above, blue below) about `centre`.

    Args:
        scene: what the values were measured on, under the commands of this state.
        x: `(n, 2)` node positions.
        values: `(t,)`, one for each element of the solids, such as `jacobians(scene, x)`.
        label: text of the colour bar: quantity and unit.
        centre: value at which diverging colours change hue; by default 0 if the values have both signs.
        colours: values at the two ends of the colour bar. By default they are the 1st and 99th percentile, because the
            peak beside a node that carries a point load depends on the mesh. Pointed ends of the bar tell that there
            are values beyond.
        ax: where to draw; by default a new figure.
        bounds: axis limits, by default those that hold the beam here and at rest.

    Raises:
        ValueError: if `x` or `values` has another shape or is not finite.
    """
    positions, numbers = _positions(scene, x), np.asarray(values)
    count = len(elements_of(scene))
    if numbers.shape != (count,):
        raise ValueError(f"values: expected shape ({count},), one for each element, got {numbers.shape}")
    if not np.isfinite(numbers).all():
        raise ValueError(f"values: element {np.flatnonzero(~np.isfinite(numbers))[0]} is not finite")
    if centre is None and numbers.min() < 0 < numbers.max():
        centre = 0.0
    low, high = colours or np.quantile(numbers, [0.01, 0.99])
    if centre is not None:
        reach = max(abs(low - centre), abs(high - centre))
        low, high = centre - reach, centre + reach
    extend = ("neither", "min", "max", "both")[int(numbers.min() < low) + 2 * int(numbers.max() > high)]
    acting = Acting(scene, positions[None])
    bounds = bounds or limits(*extremes(scene, positions[None]), *acting.extremes())
    figure, axes = (None, [_prepare(ax, bounds)]) if ax else _panels(1, [bounds])
    artists = _Beam(axes[0], scene, tendon_colours=(OUTLINE,))
    artists.move(positions, np.zeros(len(artists.tendons), int))
    draw_acting(axes[0], acting)(0)
    for line in artists.tendons:
        line.set(linewidth=1.2, markersize=3, path_effects=[withStroke(linewidth=2.8, foreground="white")])
    artists.body.set(array=numbers, cmap="viridis" if centre is None else "RdBu_r", norm=Normalize(low, high))
    artists.body.set(edgecolor="face", linewidth=5.0 if artists.rod else 0.2)
    artists.outline.set_visible(not artists.rod)
    # An inset is as high as the panel, whatever the aspect of the panel.
    bar = axes[0].inset_axes((1.03, 0.0, 0.035, 1.0))
    axes[0].figure.colorbar(artists.body, cax=bar, label=label, extend=extend)
    if figure:
        _fit(figure, axes)
    return axes[0]


def curves(
    states: Sequence[States],
    measure: Callable[[Scene, jax.Array], jax.Array] = tip_angle,
    label: str = "tip angle (degrees)",
    *,
    ax: Axes | None = None,
) -> Axes:
    """A measure against actuation: the ratio of the tendon whose command varies most, falling to the right.

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
    _name_actuation_axes(ax, label)
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
    shown = {}
    for number, branch in enumerate(traced):
        colour, critical = PALETTE[number % len(PALETTE)], branch.critical
        # Each critical point goes between its neighbours and counts as stable: the line changes its style there.
        order = np.argsort([*range(len(branch.x)), *(each.after + 0.5 for each in critical)])
        commands = np.concatenate([branch.ratios, *(each.ratios[None] for each in critical)])
        x = np.concatenate([branch.x, *(np.asarray(each.x)[None] for each in critical)])
        states = States(scene, commands, x)
        along, values = states.actuation, states.measure(measure)
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
    _name_actuation_axes(ax, label)
    ax.legend(handles=list(shown.values()), frameon=False, fontsize="small")
    return ax


def gallery(states: States, titles: Sequence[str] | None = None, columns: int = 3) -> Figure:
    """A panel for each state, all to one scale.

    Args:
        states: the states to show, such as a sweep over asymmetric commands.
        titles: one for each state; by default its ratios.
        columns: number of panels in a row.

    Raises:
        ValueError: if the titles are not one for each state, or `columns` is less than 1.
    """
    titles = [_commands(states.scene, row) for row in states.commands] if titles is None else titles
    if len(titles) != len(states):
        raise ValueError(f"titles: expected {len(states)}, one for each state, got {len(titles)}")
    if columns < 1:
        raise ValueError(f"columns: expected at least 1, got {columns}")
    columns = min(columns, len(states))
    acting = Acting(states.scene, states.x, states.commands)
    hold = lambda shown: limits(*extremes(states.scene, states.x[shown]), *acting.extremes(shown))
    every = range(len(states))
    across = hold(every)[0]
    rows = [(across, hold(every[k : k + columns])[1]) for k in every[::columns]]
    figure, axes = _panels(columns, rows)
    for k in range(len(states), len(axes)):
        axes[k].remove()
        axes[k - columns].tick_params(labelbottom=True)
        axes[k - columns].set_xlabel("x (length units)")
    doing = states.measure(_doing)
    for k, (ax, title) in enumerate(zip(axes, titles, strict=False)):
        ax.set_title(title, fontsize="medium")
        _Beam(ax, states.scene).move(states.x[k], doing[k])
        draw_acting(ax, acting)(k)
    _legend(figure, [acting], [doing])
    _fit(figure, axes[::columns])
    return figure


def _name_actuation_axes(ax: Axes, label: str) -> None:
    """Label the axes of a measure against actuation, which grows to the right as the ratio falls."""
    ax.set(xlabel="commanded ratio (dimensionless)", ylabel=label)
    if not ax.xaxis_inverted():
        ax.invert_xaxis()
    ax.grid(color="0.9", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
