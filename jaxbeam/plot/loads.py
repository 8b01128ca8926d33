"""The artists of what acts on a body from outside: arrows, springs and rigid obstacles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from jaxbeam.plot.acting import Acting, Distance

# Colours of forces, of springs, and of an obstacle and its boundary.
FORCE, SPRING, RIGID, RIM = "#111111", "#33414E", "#E6E6E6", "#7A7A7A"
# Length of the head of an arrow and half its width, and depth of the hatching of an obstacle, relative to the body.
HEAD, HALF, HATCHED = 0.026, 0.34, 0.025
# Points of the grid on which an obstacle is found, along the longer side of the axes.
GRID = 400


class _Arrows:
    """Arrows of one kind; `move` places them."""

    def __init__(self, ax: Axes, label: str, width: float, head: float) -> None:
        self.head = head
        effects: Any = [withStroke(linewidth=width + 1.6, foreground="white")]
        self.shafts = LineCollection([], colors=FORCE, linewidths=width, label=label, path_effects=effects, zorder=8)
        self.heads = PolyCollection([], facecolor=FORCE, edgecolor="white", linewidth=0.4, zorder=8.1)
        for collection in (self.shafts, self.heads):
            ax.add_collection(collection, autolim=False)

    def move(self, arrows: np.ndarray) -> None:
        """Draw `arrows` `(q, 2, 2)`, each from tail to head. The head of a short arrow is smaller."""
        tail, tip = arrows[:, 0], arrows[:, 1]
        length = np.linalg.norm(tip - tail, axis=1, keepdims=True)
        along = (tip - tail) / length
        head = np.minimum(self.head, 0.6 * length)
        across = HALF * head * np.stack([-along[:, 1], along[:, 0]], axis=1)
        neck = tip - head * along
        heads: Any = np.stack([tip, neck + across, neck - across], axis=1)
        self.shafts.set_segments(list(np.stack([tail, tip - 0.8 * head * along], axis=1)))
        self.heads.set_verts(heads)


def draw_acting(ax: Axes, acting: Acting) -> Callable[[int], None]:
    """Make the artists of what acts on a body, none if nothing does, and return the function that draws a state."""
    moves: list[Callable[[int], None]] = []
    label = ", ".join(acting.names)
    if acting.rigid:
        moves.append(_Rigid(ax, acting).move)
    if len(acting.tied):
        moves.append(_draw_springs(ax, acting))
    if acting.loaded and label:
        single = _Arrows(ax, label, 1.4, HEAD * acting.size)
        moves.append(lambda k: single.move(acting.arrows(k)))
    if acting.rows and label:
        row = _Arrows(ax, "_" if acting.loaded else label, 0.9, 0.7 * HEAD * acting.size)
        joining = LineCollection([], colors=FORCE, linewidths=0.7, zorder=8)
        ax.add_collection(joining, autolim=False)

        def move(k: int) -> None:
            combs = acting.combs(k)
            row.move(np.concatenate([np.zeros((0, 2, 2)), *(arrows for arrows, _ in combs)]))
            joining.set_segments([line for _, line in combs if len(line)])

        moves.append(move)

    def draw(k: int) -> None:
        for each in moves:
            each(k)

    return draw


def _draw_springs(ax: Axes, acting: Acting) -> Callable[[int], None]:
    springs = LineCollection([], colors=SPRING, linewidths=0.9, joinstyle="round", zorder=3.5)
    ax.add_collection(springs, autolim=False)
    ax.plot(*acting.bases.T, linestyle="", marker="s", markersize=2.5, color=SPRING, zorder=3.5)
    return lambda k: springs.set_segments(list(acting.zigzags(k)))


class _Rigid:
    """Obstacles: grey inside, a line at distance zero, and hatching along it. They are made anew for each state."""

    def __init__(self, ax: Axes, acting: Acting) -> None:
        self.ax, self.acting = ax, acting
        self.artists: list[Artist] = []

    def move(self, k: int) -> None:
        for artist in self.artists:
            artist.remove()
        self.artists = [artist for distance in self.acting.obstacles(k) for artist in self._drawn(distance)]

    def _drawn(self, distance: Distance) -> list[Artist]:
        sides = [np.sort(limits) for limits in (self.ax.get_xlim(), self.ax.get_ylim())]
        step = max(float(np.ptp(side)) for side in sides) / GRID
        x, y = np.meshgrid(*(np.linspace(side[0], side[1], 2 + int(np.ptp(side) / step)) for side in sides))
        d = distance(np.stack([x, y], axis=-1))
        if not d.min() < 0 < d.max():
            return []
        fill = self.ax.contourf(x, y, d, [d.min() - 1, 0], colors=[RIGID], zorder=0.4)
        depth = -HATCHED * self.acting.size
        hatch = self.ax.contourf(x, y, d, [depth, 0], colors="none", hatches=["//////"], zorder=0.5)
        hatch.set(edgecolor=RIM, linewidth=0)
        line = self.ax.contour(x, y, d, [0], colors=[RIM], linewidths=1.4, zorder=0.6)
        return [fill, hatch, line]


def force_handle(each: Sequence[Acting]) -> list[Line2D]:
    """The entry of a legend for arrows, which names the loads; empty without loads."""
    names = ", ".join(dict.fromkeys(name for acting in each for name in acting.names))
    look: dict[str, Any] = {"linestyle": "", "marker": r"$\rightarrow$", "markersize": 13, "color": FORCE}
    return [Line2D([], [], label=names, markeredgewidth=0.3, **look)] if names else []
