"""Tables of comma-separated values (RFC 4180): a row for each state of a solution."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from jaxbeam.core import checks
from jaxbeam.files import disk
from jaxbeam.files.states import check_solution, command_names, each_state, status_name
from jaxbeam.scene.scene import Scene
from jaxbeam.solve.solution import Solution

Measure = Callable[[Scene, jax.Array], Any]


def write_csv(
    path: disk.PathLike, scene: Scene, solution: Solution, measures: Mapping[str, Measure] | None = None
) -> None:
    """Write commands, status and measures of every state of a ramp or sweep.

    The first row names the columns: each command by its term, such as `tendon_0`; `status`, as `OK` or
    `NOT_CONVERGED|UNSTABLE`; and the measures. A measure of several entries has a column for each, `name_0` and on,
    row by row of an array. Numbers have all their digits: they read back to the same bits. The text is UTF-8.

    Args:
        path: the file. One that is there is replaced.
        scene: the scene that was solved. Each state is measured under its own commands.
        solution: from `ramp`, `sweep` or `equilibrium`. Of a state that is not `OK`, `x` is the last one in balance,
            and what is measured there is not the answer at the command.
        measures: functions `(scene, x) -> numbers` by name, such as `{"angle": jaxbeam.tip_angle}`.

    Raises:
        ValueError: if the folder of the path is missing, the solution is not one of this scene, a measure is no
            function or does not return real numbers, always as many, or two columns have one name.
    """
    file = disk.target(path)
    check_solution(scene, solution)
    measures = dict(measures or {})
    for name, function in measures.items():
        checks.function(f"measures[{name!r}]", function, "(scene, x) -> numbers")
    commands = np.atleast_2d(np.asarray(solution.ratios))
    rows: list[list[str]] = []
    head: list[str] = []
    for ratios, (commanded, x, status) in zip(commands, each_state(scene, solution), strict=True):
        found = {name: _numbers(name, function(commanded, x)) for name, function in measures.items()}
        names = [*command_names(scene), "status", *(column for name in found for column in _columns(name, found[name]))]
        head = head or _checked(names)
        if names != head:
            raise ValueError(f"measures: expected as many numbers of every state, got columns {names} after {head}")
        values = [value for array in found.values() for value in array.ravel().tolist()]
        rows.append([*map(repr, ratios.tolist()), status_name(status), *map(repr, values)])
    with disk.whole(file) as temporary, open(temporary, "w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerows([head, *rows])


def _numbers(name: str, value: Any) -> np.ndarray:
    array = checks.plain(f"measures[{name!r}]", value, "a function that returns real numbers")
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
        raise ValueError(f"measures[{name!r}]: expected a function that returns real numbers, got {value!r}")
    return array


def _columns(name: str, values: np.ndarray) -> list[str]:
    return [name] if values.ndim == 0 else [f"{name}_{k}" for k in range(values.size)]


def _checked(names: list[str]) -> list[str]:
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(f"measures: two columns would be called {twice[0]!r}; name the measure otherwise")
    return names
