"""The artists of one beam, its axes and its legend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import Collection, LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from jaxbeam.core.compiling import one_program
from jaxbeam.core.tree import Numbers
from jaxbeam.mesh.sketch import BODY, OUTLINE, PALETTE
from jaxbeam.plot.acting import Acting
from jaxbeam.plot.fields import Scale, Smooth
from jaxbeam.plot.lines import (
    arms,
    drawn_terms,
    edge_curves,
    elements_of,
    line_names,
    outline,
    patches,
    rings,
    term_lines,
)
from jaxbeam.plot.loads import force_handle
from jaxbeam.plot.supports import Supports
from jaxbeam.scene.scene import Scene, commanded_terms, placed

Limits: TypeAlias = tuple[tuple[float, float], tuple[float, float]]


# Markers of curves.
MARKERS = ("o", "s", "^", "D", "v", "P")
# Colours of the edges of elements, and of the outline at rest.
MESH, GHOST = "#B4C2CF", "#9A9A9A"
# Dashes of a tendon that pushes, and of the unstable part of a branch.
PUSHING = (0, (2.2, 1.3))
# What a tendon does beside pulling, numbered as `doing_of` has it, and how it looks then.
DOING = ("", "pushing", "slack")
LOOKS: tuple[dict[str, Any], ...] = (
    {"linestyle": "-", "linewidth": 2.0, "alpha": None},
    {"linestyle": PUSHING, "linewidth": 2.0, "alpha": None},
    {"linestyle": "-", "linewidth": 0.8, "alpha": 0.6},
)
UNSTABLE = (0, (3.0, 1.8))
# Colour and dashes of the outline in a state that cannot be trusted.
WRONG, WRONG_DASHES = "#C1121F", (0, (4.0, 2.0))
# Width of a figure in inches: the text width of a paper.
PAPER = 7.2


def limits(*positions: Numbers, margin: float = 0.05) -> Limits:
    """Axis limits `((x0, x1), (y0, y1))` that contain all points of `positions`.

    The default limits of pictures also contain what lies outside the nodes: curved edges, and tendons beside a rod.

    Args:
        positions: arrays `(..., 2)`, or `(..., 3)` for a rod, in the user's length unit.
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


# --------------------------------------------------------------------------------------------- internals


class Body:
    """The artists of one beam; `move` places them for given positions of the nodes.

    The attribute `artists` lists those that move.
    """

    def __init__(self, ax: Axes, scene: Scene, scale: Scale | None = None) -> None:
        self.scene, self.elements, self.edges = scene, elements_of(scene), outline(scene)
        self.patches, self.shares, pulling = patches(scene)
        self.rod, self.names = scene.mesh.is_line, line_names(scene)
        rest = np.asarray(scene.mesh.nodes)
        dotted = {"colors": GHOST, "linewidths": 0.9, "linestyles": "dotted"}
        ghost = LineCollection(list(edge_curves(rest, self.edges)), label="at rest", zorder=1, **dotted)
        self.body = PolyCollection([], facecolor=BODY, edgecolor=MESH, linewidth=0.35, capstyle="round", zorder=2)
        width = 2.6 if self.rod else 0.9
        self.outline = LineCollection([], colors=OUTLINE, linewidths=width, capstyle="round", zorder=3)
        colours = [PALETTE[number % len(PALETTE)] for number in range(len(self.names))]
        # What holds a tendon that is not attached to a node: a patch of surface, or an arm of the rod.
        width = 0.9 if self.rod else 2.8
        self.held = LineCollection([], colors=[colours[k] for k in pulling] or OUTLINE, linewidths=width, zorder=4)
        for collection in (ghost, self.body, self.outline, self.held):
            ax.add_collection(collection, autolim=False)
        self.supports = Supports(ax, scene, self.edges)
        self.tendons: list[Line2D] = []
        for colour in colours:
            self.tendons += ax.plot([], [], color=colour, linewidth=2.0, marker="o", markersize=4, zorder=5)
        (self.guides,) = ax.plot([], [], "o", color=OUTLINE, markerfacecolor="white", markersize=4, zorder=6)
        self.artists: list[Artist] = [self.body, self.outline, self.held, *self.tendons, self.guides]
        self.artists += self.supports.artists
        self.smooth: Smooth | None = None
        self.trusted, self.bare = True, False
        if scale:
            self._colour(ax, scale)

    def _colour(self, ax: Axes, scale: Scale) -> None:
        """Prepare for a field in colour. A white rim keeps tendons apart from the colours below them."""
        self.bare = self.rod  # its colours are its outline
        self.outline.set_visible(not self.bare)
        self.body.set(edgecolor="face", linewidth=5.0 if self.rod else 0.2, cmap=scale.cmap, norm=scale.norm)
        for line in self.tendons:
            line.set_path_effects([withStroke(linewidth=4.0, foreground="white")])
        if scale.at_nodes and not self.rod:
            self.smooth = Smooth(ax, self.elements, scale)
            self.artists[0] = self.smooth.mesh
            self.body.set_visible(False)

    @property
    def coloured(self) -> Collection:
        """What carries the colours of a field."""
        return self.smooth.mesh if self.smooth else self.body

    def mark(self, trusted: bool) -> None:
        """Draw the outline red and dashed if the state cannot be trusted."""
        if trusted != self.trusted:
            style: Any = "-" if trusted else WRONG_DASHES
            self.outline.set(color=OUTLINE if trusted else WRONG, linestyle=style, visible=not (trusted and self.bare))
            self.trusted = trusted

    def move(self, x: np.ndarray, doing: np.ndarray, values: np.ndarray | None = None) -> None:
        """Draw the beam at `x` `(n, d)`.

        Tendons that push or are slack, by `doing` `(m,)`, look different. `values` are those of the field, if any.
        """
        if self.smooth:
            self.smooth.move(x, values)
        else:
            around: Any = rings(x, self.elements)  # matplotlib is far quicker with an array than with a list
            self.body.set_verts(around, closed=not self.rod)
            if values is not None:
                at_nodes = self.rod and len(values) == len(x)
                self.body.set_array(values[self.elements].mean(axis=1) if at_nodes else values)
        self.outline.set_segments(list(edge_curves(x, self.edges)))
        self.held.set_segments(list(arms(self.scene, x) if self.rod else edge_curves(x, self.patches, self.shares)))
        self.supports.move(x)
        paths = term_lines(self.scene, x)
        # A line with fewer points than others repeats its end, which is no guide.
        guides = [path[1:-1][(path[1:-1] != path[-1]).any(axis=1)] for path in paths]
        self.guides.set_data(*np.concatenate([np.zeros((0, 2)), *guides]).T)
        for name, line, path, what in zip(self.names, self.tendons, paths, doing, strict=True):
            line.set_data(*path.T)
            line.set(label=name + f" ({DOING[what]})" * bool(what), **LOOKS[what])


@one_program
def doing_of(scene: Scene, x: jax.Array) -> jax.Array:
    """What each of the drawn lines, such as tendons, does, `(m,)`: 0 if it pulls, 1 if it pushes, 2 if it is slack.

    Positions are scaled by 1 + 1e-5, so that round-off does not make a line at its commanded length look compressed. A
    line is slack if it has no tension at all when it is a little shorter than it is: a two-way tendon would push.
    """
    found = []
    for term, lines in drawn_terms(scene):
        scaled = (x.at[:, :2].multiply(by)[term.nodes] for by in (1 + 1e-5, 1 - 1e-5))
        tensions = [term.kind.measured(here, term.params).get("tension") for here in scaled]
        longer, shorter = (jnp.ones(len(lines)) if each is None else each for each in tensions)
        found.append(jnp.where(longer < 0, 1, jnp.where(shorter == 0, 2, 0)))
    return jnp.concatenate([*found, jnp.zeros(0, int)])


def positions_of(scene: Scene, x: Numbers) -> np.ndarray:
    """Node positions as a NumPy array, checked to be finite."""
    positions = np.asarray(placed(scene, x))
    if not np.isfinite(positions).all():
        raise ValueError("x: some positions are not finite and cannot be drawn; see check(solution)")
    return positions


def prepare(ax: Axes, bounds: Limits) -> Axes:
    """Set limits, labels and equal scales of axes for a beam."""
    ax.set(xlim=bounds[0], ylim=bounds[1], xlabel="x (length units)", ylabel="y (length units)")
    ax.set_aspect("equal")
    return ax


def panels(columns: int, rows: Sequence[Limits]) -> tuple[Figure, list[Axes]]:
    """A figure of equally wide panels on one scale, and their axes, row by row. Only the outer panels have labels.

    Args:
        columns: number of columns.
        rows: limits of the panels of each row, from the top; the limits in x are those of all.
    """
    heights = [y1 - y0 for _, (y0, y1) in rows]
    # The padding keeps the last tick label of one panel apart from the first of the next.
    figure = Figure(figsize=(PAPER, PAPER), layout=ConstrainedLayoutEngine(w_pad=0.08))
    grid = figure.subplots(len(rows), columns, squeeze=False, sharex=True, sharey="row", height_ratios=heights)
    for panels, bounds in zip(grid, rows, strict=True):
        for ax in panels:
            prepare(ax, bounds).label_outer()
    if len(rows) > 1:  # one label for all rows: a flat panel has no room for its own
        figure.supylabel("y (length units)", fontsize="medium")
        for ax in grid[:, 0]:
            ax.set_ylabel("")
    return figure, list(grid.ravel())


def fit_height(figure: Figure, axes: Sequence[Axes]) -> None:
    """Set the height of the figure to what its panels need, so that none floats in empty space.

    Args:
        figure: to set.
        axes: one panel of each row.
    """
    for ax in axes:
        ax.set_aspect("auto")
    for _ in range(2):  # tick labels depend on the height: the second pass measures them at nearly the final height
        figure.draw_without_rendering()
        excess = 0.0
        for ax in axes:
            (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
            width, height = ax.get_position().size * figure.get_size_inches()
            excess += height - width * (y1 - y0) / (x1 - x0)
        figure.set_figheight(figure.get_figheight() - excess)
    for ax in axes:
        ax.set_aspect("equal")


def add_legend(figure: Figure, acting: Sequence[Acting], doing: Sequence[np.ndarray]) -> None:
    """One legend below all panels.

    Args:
        figure: of the panels.
        acting: what acts on each beam.
        doing: for each beam, `(..., m)` numbers from `doing_of`, of one state or of several.
    """
    names = max((line_names(each.scene) for each in acting), key=len)
    handles = [Line2D([], [], color=PALETTE[k % len(PALETTE)], lw=2, label=name) for k, name in enumerate(names)]
    for what in (1, 2):
        if any((each == what).any() for each in doing):
            handles.append(Line2D([], [], color="0.3", label=DOING[what], **LOOKS[what]))
    handles += force_handle(acting)
    handles.append(Line2D([], [], color=GHOST, linestyle="dotted", label="at rest"))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 6), frameon=False)


def command_title(scene: Scene, commands: np.ndarray) -> str:
    """A title that states the commands `(m,)` of a scene, as ratios if all of them are."""
    ratios = all(term.kind.command_unit == 1 for term in commanded_terms(scene))
    return ("ratios " if ratios else "commands ") + ", ".join(f"{command:.2f}" for command in commands)
