"""Progress of long work: a function of the user's own that is called on the way, or a line on stderr.

The line is redrawn in place, at most ten times a second. It is drawn on terminals only: where stderr is a file, a pipe
or the cell of a notebook, nothing is written.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxbeam.core import checks

Progress = bool | Callable[..., None] | None

# Seconds between two drawings of a line.
INTERVAL = 0.1
# Most and least characters of the bar in front of the figures. Where fewer are left in the terminal, there is no bar.
BAR, LEAST = 24, 8


def check_progress(progress: Any, form: str) -> None:
    """Check the argument `progress` of a public function. `form` shows the arguments of a function in the message."""
    if progress is not None and not isinstance(progress, bool | np.bool_):
        checks.function("progress", progress, f"{form}, or True or False")


class Report:
    """Reports the progress of the work in its context: draws the line, or calls the function.

    The line is drawn when the work begins. When it ends, also by an exception, the line is drawn with the last figures
    and a new line is begun.
    """

    def __init__(self, progress: Progress, unit: str, total: int | None = None) -> None:
        """Of work whose steps are counted in `unit`, such as "commands"; `total` of them if that is known."""
        self.function = progress if callable(progress) else None
        self.stream = None if progress is None or self.function or not progress else _terminal()
        self.unit, self.total = unit, total
        self.done, self.figure = 0, ""
        self.begun, self.drawn, self.length = time.monotonic(), 0.0, 0

    def __enter__(self) -> Report:
        self._draw()
        return self

    def __call__(self, done: int, figure: str = "", call: tuple[Any, ...] | None = None) -> None:
        """Report that `done` steps are taken.

        Args:
            done: number of steps.
            figure: how the work stands beside their number, in words; for the line.
            call: arguments of the function. Without them it is not called.
        """
        self.done, self.figure = done, figure
        if self.function and call is not None:
            self.function(*call)
        if time.monotonic() - self.drawn >= INTERVAL:
            self._draw()

    def __exit__(self, *error: object) -> None:
        self._draw("\n")

    def _draw(self, end: str = "") -> None:
        """Draw the line over the one before."""
        if self.stream is None:
            return
        line = self._line(_columns(self.stream) - 1)
        # Spaces cover what is left of a longer line.
        self.stream.write(f"\r{line}{' ' * (self.length - len(line))}{end}")
        self.stream.flush()
        self.drawn, self.length = time.monotonic(), len(line)

    def _line(self, width: int) -> str:
        """The figures, with a bar in front if the total is known; of at most `width` characters."""
        seconds = int(time.monotonic() - self.begun)
        hours, minutes = seconds // 3600, seconds // 60 % 60
        elapsed = f"{hours}:{minutes:02}:{seconds % 60:02}" if hours else f"{minutes}:{seconds % 60:02}"
        known = "" if self.total is None else f" of {self.total}"
        line = ", ".join(part for part in (f"{self.done}{known} {self.unit}", self.figure, elapsed) if part)
        size = min(BAR, width - len(line) - len("[] "))
        if self.total and size >= LEAST:
            full = size * self.done // self.total
            line = f"[{'#' * full}{'-' * (size - full)}] {line}"
        return line[:width]


def _terminal() -> Any:
    """Stderr if it is a terminal, else None. Python has none at all where a program runs without a console."""
    return sys.stderr if sys.stderr is not None and sys.stderr.isatty() else None


def _columns(stream: Any) -> int:
    """Characters in a line of a terminal, 80 if it does not say."""
    try:
        return os.get_terminal_size(stream.fileno()).columns or 80
    except (OSError, ValueError, AttributeError):
        return 80
