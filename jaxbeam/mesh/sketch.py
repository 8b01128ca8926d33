"""Small pictures as inline SVG, in which scenes and solutions show themselves in a notebook. They need no matplotlib.

A picture is a list of strokes, each a set of lines in the user's coordinates with one look. `svg` scales them to
pixels. Larger pictures, with axes and legends, are drawn by `jaxbeam.plot`, in the same colours.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from jaxbeam.mesh.element import edge_functions

# Colours of the body, its outline, tendons, what is rigid, and warnings.
BODY, OUTLINE, RIGID, WARNING = "#DCE5EE", "#33414E", "#9A9A9A", "#B3261E"
PALETTE = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
# Width of a picture in pixels, the range of its height, and the margin inside.
WIDTH, LOWEST, TALLEST, MARGIN = 360, 60, 200, 12
# Points of a curved edge.
POINTS = 7


class Stroke(NamedTuple):
    """Lines of one look.

    lines: points `(p, 2)` of each. A line of a single point is a dot.
    colour: of the line, or `none`.
    width: of the line, or of the dot, in pixels.
    fill: colour inside, or `none`; lines with a fill are closed.
    opacity: of all of it, from 0 to 1.
    """

    lines: Sequence[np.ndarray]
    colour: str
    width: float = 1.2
    fill: str = "none"
    opacity: float = 1.0


def chains(edges: np.ndarray) -> list[np.ndarray]:
    """Edges `(e, k)` joined end to end: for each line the numbers of its edges in order.

    A line begins where no edge ends, if it is open. Where two parts of a body touch at a node, it may change parts.
    """
    starts, ends = edges[:, 0].tolist(), edges[:, 1].tolist()
    leaving: dict[int, list[int]] = {}
    for number, node in enumerate(starts):
        leaving.setdefault(node, []).append(number)
    arrived, found = set(ends), []
    for first in [*(node for node in starts if node not in arrived), *starts]:
        line, here = [], first
        while leaving.get(here):
            line.append(leaving[here].pop())
            here = ends[line[-1]]
        if line:
            found.append(np.array(line))
    return found


def body_lines(x: np.ndarray, edges: np.ndarray) -> list[np.ndarray]:
    """Points `(p, 2)` of each of the lines that edges `(e, k)` make at node positions `x` `(n, d)`."""
    xi = np.linspace(0, 1, POINTS if edges.shape[1] == 3 else 2)
    curves = edge_functions(edges.shape[1], xi) @ x[edges, :2]
    # Each edge begins where the one before it ends.
    return [np.concatenate([curves[line[0], :1], *curves[line, 1:]]) for line in chains(edges)]


def body_strokes(x: np.ndarray, edges: np.ndarray, filled: bool, colour: str, opacity: float = 1.0) -> list[Stroke]:
    """A body with the outline `edges` `(e, k)` at `x` `(n, d)`; of a rod, which is not `filled`, its line."""
    lines = body_lines(x, edges)
    if not filled:
        return [Stroke(lines, colour, 3.0, opacity=opacity)]
    return [Stroke(lines, colour, 1.2, BODY, opacity)]


def finite(strokes: Iterable[Stroke]) -> list[Stroke]:
    """The strokes without lines that have a point that is not finite."""
    return [stroke._replace(lines=[line for line in stroke.lines if np.isfinite(line).all()]) for stroke in strokes]


def bounds(strokes: Iterable[Stroke]) -> np.ndarray | None:
    """Lowest and highest coordinates `(2, 2)` of all points; None if there is no point."""
    points = [line for stroke in strokes for line in stroke.lines if len(line)]
    if not points:
        return None
    every = np.concatenate(points)
    return np.stack([every.min(axis=0), every.max(axis=0)])


def svg(strokes: Iterable[Stroke], window: np.ndarray | None = None) -> str:
    """The picture as an SVG element, of width `WIDTH`; empty if nothing can be drawn.

    Args:
        strokes: drawn one over the other; lines with points that are not finite are left out.
        window: `(2, 2)` lowest and highest coordinates shown; by default those of all points.
    """
    kept = finite(strokes)
    box = bounds(kept) if window is None else window
    if box is None:
        return ""
    # Divided by the largest number, so that no difference overflows.
    largest = np.abs(box).max() or 1.0
    low, high = box / largest
    wide, tall = high - low
    room = WIDTH - 2 * MARGIN, TALLEST - 2 * MARGIN
    scale = min(room[0] / wide if wide > 0 else np.inf, room[1] / tall if tall > 0 else np.inf)
    scale = scale if np.isfinite(scale) else 1.0
    height = int(np.clip(np.ceil(tall * scale) + 2 * MARGIN, LOWEST, TALLEST))
    middle, centre = np.array([WIDTH, height]) / 2, (low + high) / 2
    place = lambda line: middle + scale * np.array([1, -1]) * (line / largest - centre)
    paths = "".join(_path(stroke, [place(line) for line in stroke.lines]) for stroke in kept)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{height}" viewBox="0 0 {WIDTH} {height}" '
        f'style="background:white;max-width:100%" stroke-linecap="round" stroke-linejoin="round">{paths}</svg>'
    )


def _path(stroke: Stroke, lines: Sequence[np.ndarray]) -> str:
    """An SVG path through points in pixels."""
    steps = []
    for line in lines:
        if not len(line):
            continue
        points = np.round(line, 1) + 0.0
        # Of points that fall together one is enough.
        points = points[np.append(True, (points[1:] != points[:-1]).any(axis=1))]
        first, *others = (f"{x:g},{y:g}" for x, y in points)
        closing = "Z" if stroke.fill != "none" else ""
        steps.append(f"M{first}L{' '.join(others)}{closing}" if others else f"M{first}h0")
    if not steps:
        return ""
    faint = f' opacity="{stroke.opacity:g}"' if stroke.opacity < 1 else ""
    look = f'stroke="{stroke.colour}" stroke-width="{stroke.width:g}" fill="{stroke.fill}"{faint}'
    return f'<path d="{"".join(steps)}" {look}/>'


def page(picture: str, lines: Iterable[str], warning: str = "") -> str:
    """HTML of a picture with lines of text below it; the first line begins with the `warning`, in colour."""
    alert = f'<b style="color:{WARNING}">{html.escape(warning)}</b>' if warning else ""
    rows = "<br>".join(html.escape(line) for line in lines)
    text = f'<div style="font-size:90%">{" &middot; ".join(part for part in (alert, rows) if part)}</div>'
    return f"<div>{picture}{text}</div>"
