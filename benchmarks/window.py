"""Frames a second of the window on the reference scene, without a screen: the tip is dragged, and a slider moved.

Each frame waits for its solve. In a browser the frame is also sent, and the browser draws it on the same cores.
"""

from __future__ import annotations

import statistics
import time

import jax
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import jaxbeam as jb
from benchmarks.report import head, options, table
from jaxbeam import plot
from jaxbeam.plot.view import HEIGHT, ROW, WIDTH

jax.config.update("jax_enable_x64", True)


def rate(window, moves):
    """Frames a second while the moves are made one after the other."""
    before, begun = window.view.frames, time.perf_counter()
    for move in moves:
        move()
        window.wait()
    return (window.view.frames - before) / (time.perf_counter() - begun)


def main():
    parser = options(__doc__)
    parser.add_argument("--rounds", type=int, default=5, help="of which the median is printed")
    rounds = parser.parse_args().rounds
    head("The window on the reference scene")
    figure = Figure(figsize=(WIDTH, HEIGHT + 2 * ROW), dpi=100)
    FigureCanvasAgg(figure)
    begun = time.perf_counter()
    window = plot.Window(figure, jb.tendon_beam()).wait()
    print(f"ready, compiled: {time.perf_counter() - begun:.1f} s")
    path = np.linspace([1.75, 0.0], [1.3, 0.75], 60)
    far = np.linspace([1.3, 0.75], [1.6, 1.5], 60)
    there_and_back = [*path, *path[::-1]]
    rows = []
    for name, key in (("plain", "0"), ("stress in colour", "1")):
        window.colour(key)
        window.wait()
        found = {"drag": [], "out of reach": [], "slider": []}
        for _ in range(rounds):
            found["drag"].append(rate(window, [lambda at=at: window.drag(at) for at in there_and_back]))
            window.drag(path[-1])
            window.wait()
            found["out of reach"].append(rate(window, [lambda at=at: window.drag(at) for at in far]))
            ratios = np.linspace([1.0, 1.0], [0.5, 0.9], 60)
            found["slider"].append(rate(window, [lambda each=each: window.pull(each) for each in ratios]))
            window.rest()
            window.wait()
        rows.append((name, *(f"{statistics.median(rates):.0f}" for rates in found.values())))
    table(("frames a second", "tip dragged", "dragged out of reach", "slider moved"), rows)


if __name__ == "__main__":
    main()
