"""Pictures and animations of beams. The only file that needs matplotlib: import it by name.

Every function draws into the `ax` it is given or into a new `Figure`, and leaves pyplot, its backend and
`rcParams` alone, so that it works without a display. Save a still with `ax.figure.savefig(path)` and an
animation with `save_animation`. Lengths, forces and stresses are in the user's units.

A tendon that pulls is drawn solid and one that pushes dashed; the patch of surface that an anchor of finite width pulls
on is a heavier line in its colour. A rod, whose nodes are `(n, 3)`, is drawn as its centre line. Colours are those of
Okabe and Ito (2008), which survive colour blindness; several curves also differ in their markers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from jaxbeam._tree import Numbers
from jaxbeam.branch import Branch
from jaxbeam.measures import tendon_tensions, tip_angle
from jaxbeam.outlines import arms, edge_curves, elements_of, extremes, outline, patches, rings, tendon_points
from jaxbeam.scene import Scene, command, placed, tendon_count

Limits: TypeAlias = tuple[tuple[float, float], tuple[float, float]]

PALETTE = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "^", "D", "v", "P")
BODY, MESH, OUTLINE, GHOST = "#DCE5EE", "#B4C2CF", "#33414E", "#9A9A9A"
PUSHING = (0, (2.2, 1.3))
UNSTABLE = (0, (3.0, 1.8))
# Width of a figure in inches: the text width of a paper.
PAPER = 7.2
# Frames for which an animation rests on its last state.
HOLD = 6


class States:
    """States of one scene under `s` commands: a ramp, or a sweep.

    Args:
        scene: with `n` nodes and `m` tendons.
        commands: `(s, m)` ratios, dimensionless: `commands(ratios, steps)` for a ramp.
        x: `(s, n, 2)` node positions: `Solution.x` of that ramp or sweep.
        title: what to call them in pictures.

    Raises:
        ValueError: if a shape is wrong, there is no state, or a position is not finite.
    """

    def __init__(self, scene: Scene, commands: Numbers, x: Numbers, title: str = "") -> None:
        count = tendon_count(scene)
        self.scene, self.commands, self.x, self.title = scene, np.asarray(commands), np.asarray(x), title
        if self.commands.ndim != 2 or self.commands.shape[0] == 0 or self.commands.shape[1] != count:
            raise ValueError(f"commands: expected shape (s, {count}), a row for each state, got {self.commands.shape}")
        expected = (len(self.commands), *scene.mesh.nodes.shape)
        if self.x.shape != expected:
            raise ValueError(f"x: expected shape {expected}, one entry for each command, got {self.x.shape}")
        broken = np.flatnonzero(~np.isfinite(self.x).all(axis=(1, 2)))
        if broken.size:
            raise ValueError(f"x: state {broken[0]} is not finite and cannot be drawn; see check(solution)")

    def __len__(self) -> int:
        return len(self.x)

    def measure(self, function: Callable[[Scene, jax.Array], jax.Array]) -> np.ndarray:
        """`function(scene, x)` of every state, such as `tip_angle` or `tendon_tensions`: leading axis `s`."""
        one = lambda ratios, x: function(command(self.scene, ratios), x)
        return np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(self.commands), jnp.asarray(self.x)))

    @property
    def actuation(self) -> np.ndarray:
        """`(s,)` ratio of the tendon whose command varies most; of the first of those that vary alike."""
        return self.commands[:, np.argmax(np.ptp(self.commands, axis=0).round(6))]


def limits(*positions: Numbers, margin: float = 0.05) -> Limits:
    """Axis limits `((x0, x1), (y0, y1))` that hold all points of `positions`, arrays `(..., 2)` or `(..., 3)` of a rod.

    Those that pictures choose by default hold, besides the nodes, what lies outside them: curved edges, and tendons
    beside a rod.

    Args:
        positions: in the user's length unit.
        margin: added on each side, as a fraction of the larger extent.

    Raises:
        ValueError: if there is no point or one is not finite.
    """
    points = np.concatenate([np.zeros((0, 2)), *(np.asarray(p)[..., :2].reshape(-1, 2) for p in positions)])
    if not points.size or not np.isfinite(points).all():
        raise ValueError("positions: expected at least one point, all of them finite; see check(solution)")
    low, high = points.min(axis=0), points.max(axis=0)
    pad = margin * (high - low).max()
    return (float(low[0] - pad), float(high[0] + pad)), (float(low[1] - pad), float(high[1] + pad))


# ----------------------------------------------------------------------------------------------- stills


def beam(scene: Scene, x: Numbers, *, ax: Axes | None = None, bounds: Limits | None = None) -> Axes:
    """The beam with its mesh, tendons, guides and anchors, clamp, and its outline at rest.

    Args:
        scene: as commanded: its commands decide which tendons push.
        x: `(n, 2)` node positions.
        ax: where to draw (`ax.legend()` names what is there); by default a new figure with a legend.
        bounds: axis limits, by default those that hold the beam here and at rest.

    Raises:
        ValueError: if `x` has another shape or is not finite.
    """
    positions = _positions(scene, x)
    bounds = bounds or limits(*extremes(scene, positions[None]))
    figure, axes = (None, [_prepare(ax, bounds)]) if ax else _panels(1, [bounds])
    pushing = np.asarray(_pushing(scene, jnp.asarray(positions)))
    _Beam(axes[0], scene).move(positions, pushing)
    if figure:
        _legend(figure, [pushing])
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
        scene: what the values were measured on.
        x: `(n, 2)` node positions.
        values: `(t,)`, one for each element of the solids, such as `jacobians(scene, x)`.
        label: of the colour bar: quantity and unit.
        centre: where diverging colours change hue; by default 0 if the values have both signs.
        colours: values at the two ends of the colour bar. By default the 1st and 99th percentile, since the
            peak beside a node that carries a point load is a matter of mesh; pointed ends tell of values beyond.
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
    bounds = bounds or limits(*extremes(scene, positions[None]))
    figure, axes = (None, [_prepare(ax, bounds)]) if ax else _panels(1, [bounds])
    artists = _Beam(axes[0], scene, tendon_colours=(OUTLINE,))
    artists.move(positions, np.zeros(len(artists.tendons), bool))
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
        states: ramps or sweeps; each has a marker of its own, for every state.
        measure: `(scene, x)` to a scalar, drawn once for each of `states`, or to `(m,)`, drawn for each tendon.
        label: of the vertical axis: quantity and unit.
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
    """A measure along branches of equilibria: stable full, unstable dashed, folds and bifurcations marked.

    Args:
        scene: that was traced.
        traced: of `trace_branch`; each has a colour of its own.
        measure: `(scene, x)` to a scalar.
        label: of the vertical axis: quantity and unit.
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
        # Critical points go between their neighbours: there a line changes from full to dashed.
        order = np.argsort([*range(len(branch.x)), *(each.after + 0.5 for each in critical)])
        commands = np.concatenate([branch.ratios, *(each.ratios[None] for each in critical)])
        x = np.concatenate([branch.x, *(np.asarray(each.x)[None] for each in critical)])
        states = States(scene, commands, x)
        along, values = states.actuation, states.measure(measure)
        negative = np.append(branch.negative, np.zeros(len(critical), int))[order]
        stable = np.maximum(negative[:-1], negative[1:]) == 0
        for run in np.split(np.arange(stable.size), np.flatnonzero(np.diff(stable)) + 1):
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
        states: such as a sweep over asymmetric commands.
        titles: one for each state; by default its ratios.
        columns: panels in a row.

    Raises:
        ValueError: if the titles are not one for each state, or `columns` is less than 1.
    """
    titles = [_ratios(ratios) for ratios in states.commands] if titles is None else titles
    if len(titles) != len(states):
        raise ValueError(f"titles: expected {len(states)}, one for each state, got {len(titles)}")
    if columns < 1:
        raise ValueError(f"columns: expected at least 1, got {columns}")
    columns = min(columns, len(states))
    hold = lambda x: limits(*extremes(states.scene, x))
    across = hold(states.x)[0]
    rows = [(across, hold(states.x[k : k + columns])[1]) for k in range(0, len(states), columns)]
    figure, axes = _panels(columns, rows)
    for k in range(len(states), len(axes)):
        axes[k].remove()
        axes[k - columns].tick_params(labelbottom=True)
        axes[k - columns].set_xlabel("x (length units)")
    pushing = states.measure(_pushing)
    for ax, title, x, push in zip(axes, titles, states.x, pushing, strict=False):
        ax.set_title(title, fontsize="medium")
        _Beam(ax, states.scene).move(x, push)
    _legend(figure, [pushing])
    _fit(figure, axes[::columns])
    return figure


# ------------------------------------------------------------------------------------------- animations


def animate_ramp(
    states: States,
    measure: Callable[[Scene, jax.Array], jax.Array] = tip_angle,
    label: str = "tip angle (degrees)",
) -> FuncAnimation:
    """A beam in motion, and beside it the curve that it traces.

    Args:
        states: such as a ramp.
        measure: as in `curves`.
        label: of the curve's vertical axis: quantity and unit.
    """
    figure = Figure(figsize=(PAPER, 0.5 * PAPER), layout="constrained")
    left, right = figure.subplots(1, 2)
    _prepare(left, limits(*extremes(states.scene, states.x)))
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

    return _play(figure, [left], [states], trace)


def animate_beams(states: Sequence[States]) -> FuncAnimation:
    """Several beams side by side, to one scale and in step.

    Args:
        states: one for each panel, all with the same number of states.

    Raises:
        ValueError: if `states` is empty or the numbers of states differ.
    """
    if not states:
        raise ValueError("states: expected at least one States, got none")
    if len({len(each) for each in states}) > 1:
        raise ValueError(f"states: expected as many states in each, got {[len(each) for each in states]}")
    bounds = limits(*(points for each in states for points in extremes(each.scene, each.x)))
    figure, axes = _panels(len(states), [bounds])
    return _play(figure, axes, states)


def save_animation(animation: FuncAnimation, path: str | Path, fps: int = 12, dpi: float = 110) -> None:
    """Write an animation as `.gif`, which needs no other program, or as `.mp4`, which needs ffmpeg.

    Args:
        animation: of `animate_ramp` or `animate_beams`.
        path: where to; its ending decides the format.
        fps: frames a second.
        dpi: pixels an inch.

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


# --------------------------------------------------------------------------------------------- internals


class _Beam:
    """The artists of one beam; `move` puts them where the nodes are."""

    def __init__(self, ax: Axes, scene: Scene, tendon_colours: Sequence[str] = PALETTE) -> None:
        self.scene, self.elements, self.edges = scene, elements_of(scene), outline(scene)
        self.patches, self.shares, pulling = patches(scene)
        self.rod = self.elements.shape[1] == 2
        rest = np.asarray(scene.mesh.nodes)
        dotted = {"colors": GHOST, "linewidths": 0.9, "linestyles": "dotted"}
        ghost = LineCollection(list(edge_curves(rest, self.edges)), label="at rest", zorder=1, **dotted)
        self.body = PolyCollection([], facecolor=BODY, edgecolor=MESH, linewidth=0.35, capstyle="round", zorder=2)
        width = 2.6 if self.rod else 0.9
        self.outline = LineCollection([], colors=OUTLINE, linewidths=width, capstyle="round", zorder=3)
        colours = [tendon_colours[number % len(tendon_colours)] for number in range(tendon_count(scene))]
        # What tendons are held by, other than nodes: a patch of surface, or an arm of the rod.
        width = 0.9 if self.rod else 2.8
        self.held = LineCollection([], colors=[colours[k] for k in pulling] or OUTLINE, linewidths=width, zorder=4)
        for collection in (ghost, self.body, self.outline, self.held):
            ax.add_collection(collection, autolim=False)
        _draw_clamp(ax, scene, self.edges)
        self.tendons: list[Line2D] = []
        for colour in colours:
            self.tendons += ax.plot([], [], color=colour, linewidth=2.0, marker="o", markersize=4, zorder=5)
        (self.guides,) = ax.plot([], [], "o", color=OUTLINE, markerfacecolor="white", markersize=4, zorder=6)

    def move(self, x: np.ndarray, pushing: np.ndarray) -> None:
        """Draw the beam at `x` `(n, 2)`; tendons that push, `pushing` `(m,)`, are dashed."""
        around: Any = rings(x, self.elements)  # matplotlib is far quicker with an array than with the list it asks for
        self.body.set_verts(around, closed=not self.rod)
        self.outline.set_segments(list(edge_curves(x, self.edges)))
        self.held.set_segments(list(arms(self.scene, x) if self.rod else edge_curves(x, self.patches, self.shares)))
        paths = tendon_points(self.scene, x)
        self.guides.set_data(*np.concatenate([np.zeros((0, 2)), *(path[1:-1] for path in paths)]).T)
        for number, (line, path, push) in enumerate(zip(self.tendons, paths, pushing, strict=True)):
            line.set_data(*path.T)
            line.set(linestyle=PUSHING if push else "-", label=f"tendon {number + 1}" + " (pushing)" * bool(push))


def _name_actuation_axes(ax: Axes, label: str) -> None:
    """Axes of a measure against actuation, which grows to the right as the ratio falls."""
    ax.set(xlabel="commanded ratio (dimensionless)", ylabel=label)
    if not ax.xaxis_inverted():
        ax.invert_xaxis()
    ax.grid(color="0.9", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def _pushing(scene: Scene, x: jax.Array) -> jax.Array:
    """`(m,)`: which tendons push. One at its commanded length, but for round-off, does neither."""
    return tendon_tensions(scene, x.at[:, :2].multiply(1 + 1e-5)) < 0


def _positions(scene: Scene, x: Numbers) -> np.ndarray:
    positions = np.asarray(placed(scene, x))
    if not np.isfinite(positions).all():
        raise ValueError("x: some positions are not finite and cannot be drawn; see check(solution)")
    return positions


def _draw_clamp(ax: Axes, scene: Scene, edges: np.ndarray) -> None:
    """Hatching outside every boundary edge whose ends are fixed, and a square on every other fixed node."""
    rest = np.asarray(scene.mesh.nodes)
    walls = edges[scene.fixed[edges].all(axis=(1, 2))]
    lonely = np.setdiff1d(np.flatnonzero(scene.fixed.any(axis=1)), walls)
    ax.plot(*rest[lonely, :2].T, "s", color=OUTLINE, markersize=4, zorder=7)
    lines = edge_curves(rest, walls)
    along = np.gradient(lines, axis=1)
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    outward *= 0.025 * np.ptp(rest[:, :2], axis=0).max() / np.linalg.norm(outward, axis=-1, keepdims=True)
    strips = np.concatenate([lines, (lines + outward)[:, ::-1]], axis=1)
    hatching = PolyCollection(list(strips), facecolor="none", edgecolor=OUTLINE, linewidth=0, hatch="//////", zorder=1)
    ax.add_collection(hatching, autolim=False)
    ax.add_collection(LineCollection(list(lines), colors=OUTLINE, linewidths=2.2, zorder=4), autolim=False)


def _prepare(ax: Axes, bounds: Limits) -> Axes:
    ax.set(xlim=bounds[0], ylim=bounds[1], xlabel="x (length units)", ylabel="y (length units)")
    ax.set_aspect("equal")
    return ax


def _panels(columns: int, rows: Sequence[Limits]) -> tuple[Figure, list[Axes]]:
    """A figure with a row of panels for each of `rows`, the limits of its panels; only the outer ones are labelled."""
    heights = [y1 - y0 for _, (y0, y1) in rows]
    # The padding keeps the last tick label of one panel apart from the first of the next.
    figure = Figure(figsize=(PAPER, PAPER), layout=ConstrainedLayoutEngine(w_pad=0.08))
    grid = figure.subplots(len(rows), columns, squeeze=False, sharex=True, sharey="row", height_ratios=heights)
    for panels, bounds in zip(grid, rows, strict=True):
        for ax in panels:
            _prepare(ax, bounds).label_outer()
    if len(rows) > 1:  # one label for all rows: a flat panel has no room for its own
        figure.supylabel("y (length units)", fontsize="medium")
        for ax in grid[:, 0]:
            ax.set_ylabel("")
    return figure, list(grid.ravel())


def _fit(figure: Figure, axes: Sequence[Axes]) -> None:
    """Make the figure as high as `axes`, one panel of each row, need, so that none floats in empty space."""
    for ax in axes:
        ax.set_aspect("auto")
    for _ in range(2):  # tick labels depend on the height: the second pass measures them at nearly the last one
        figure.draw_without_rendering()
        excess = 0.0
        for ax in axes:
            (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
            width, height = ax.get_position().size * figure.get_size_inches()
            excess += height - width * (y1 - y0) / (x1 - x0)
        figure.set_figheight(figure.get_figheight() - excess)
    for ax in axes:
        ax.set_aspect("equal")


def _legend(figure: Figure, pushing: Sequence[np.ndarray]) -> None:
    """One legend below all panels; `pushing`, of each beam, is `(..., m)`: whether a tendon ever pushes."""
    tendons = range(max(each.shape[-1] for each in pushing))
    handles = [Line2D([], [], color=PALETTE[k % len(PALETTE)], lw=2, label=f"tendon {k + 1}") for k in tendons]
    if any(each.any() for each in pushing):
        handles.append(Line2D([], [], color="0.3", lw=2, linestyle=PUSHING, label="pushing"))
    handles.append(Line2D([], [], color=GHOST, linestyle="dotted", label="at rest"))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 6), frameon=False)


def _ratios(ratios: np.ndarray) -> str:
    return "ratios " + ", ".join(f"{ratio:.2f}" for ratio in ratios)


def _play(
    figure: Figure, axes: Sequence[Axes], states: Sequence[States], trace: Callable[[int], None] = lambda frame: None
) -> FuncAnimation:
    """Animate each of `states` on its axes; `trace` draws what else changes."""
    beams = [_Beam(ax, each.scene) for ax, each in zip(axes, states, strict=True)]
    pushing = [each.measure(_pushing) for each in states]
    _legend(figure, pushing)

    def draw(frame: int) -> None:
        for ax, artists, each, push in zip(axes, beams, states, pushing, strict=True):
            artists.move(each.x[frame], push[frame])
            ax.set_title("\n".join(filter(None, [each.title, _ratios(each.commands[frame])])), fontsize="medium")
        trace(frame)

    # Laid out once: a layout of its own for every frame would be slow, and the panels would jitter.
    draw(0)
    _fit(figure, axes[:1])
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    last = len(states[0]) - 1
    return FuncAnimation(figure, draw, frames=[*range(last), *[last] * HOLD], interval=80, cache_frame_data=False)
