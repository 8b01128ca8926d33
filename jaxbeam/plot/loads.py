"""The artists of what acts on a body from outside: arrows, springs and rigid obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from jaxbeam.mesh.sketch import OUTLINE
from jaxbeam.plot.acting import Acted, Acting, Distance

# Colours of forces, and of an obstacle and its boundary.
FORCE, RIGID, RIM = "#111111", "#E6E6E6", "#7A7A7A"
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


class Outside:
    """The artists of what acts on a body from outside; `move` places them. An artist is made when it is first needed.

    The attribute `artists` lists those that there are now.
    """

    def __init__(self, ax: Axes, acting: Acting) -> None:
        self.ax, self.acting = ax, acting
        self.single: _Arrows | None = None
        self.row: _Arrows | None = None
        self.joining, self.springs = LineCollection([]), LineCollection([])
        self.kept: list[Artist] = []
        self.rigid: list[Artist] = []
        self.place: Any = None
        if len(acting.springs.nodes):
            self.springs = self._keep(LineCollection([], colors=OUTLINE, linewidths=0.9, joinstyle="round", zorder=3.5))
            self.grounds = self._keep(LineCollection([], colors=OUTLINE, linewidths=0.8, zorder=3.4))

    @property
    def artists(self) -> list[Artist]:
        """All artists."""
        return [*self.kept, *self.rigid]

    def move(self, state: Acted) -> None:
        """Draw a state that the `Acting` has seen."""
        acting, label = self.acting, ", ".join(self.acting.names)
        self._move_obstacles(state)
        if len(acting.springs.nodes):
            self.springs.set_segments(list(acting.springs.zigzags(state.x)))
            self.grounds.set_segments(list(acting.springs.grounds()))
        if acting.loaded and label:
            self.single = self.single or self._arrows(label, 1.4, HEAD)
            self.single.move(acting.arrows(state))
        if acting.rows and label:
            if self.row is None:
                self.row = self._arrows("_" if acting.loaded else label, 0.9, 0.7 * HEAD)
                self.joining = self._keep(LineCollection([], colors=FORCE, linewidths=0.7, zorder=8))
            combs = acting.combs(state)
            self.row.move(np.concatenate([np.zeros((0, 2, 2)), *(arrows for arrows, _ in combs)]))
            self.joining.set_segments([line for _, line in combs if len(line)])

    def _keep(self, lines: LineCollection) -> LineCollection:
        self.ax.add_collection(lines, autolim=False)
        self.kept.append(lines)
        return lines

    def _arrows(self, label: str, width: float, head: float) -> _Arrows:
        made = _Arrows(self.ax, label, width, head * self.acting.size)
        self.kept += [made.shafts, made.heads]
        return made

    def _move_obstacles(self, state: Acted) -> None:
        """Draw the obstacles anew if they, or the limits of the axes, have changed: that takes ten milliseconds."""
        params = [state.scene.terms[k].params for k in self.acting.rigid]
        place = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(params)], self.ax.viewLim.bounds
        if place == self.place or not self.acting.rigid:
            return
        self.place = place
        for artist in self.rigid:
            artist.remove()
        self.rigid = [artist for distance in self.acting.obstacles(state) for artist in self._obstacle(distance)]

    def _obstacle(self, distance: Distance) -> list[Artist]:
        """An obstacle: grey inside, a line at distance zero, and hatching along it."""
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
