"""The states of a solution, one by one: each with the scene under its commands."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.tree import is_concrete
from jaxbeam.scene.scene import Scene, check_scene, command, command_count, commanded_terms
from jaxbeam.solve.solution import Solution, Status


def check_solution(scene: Scene, solution: Solution) -> None:
    """Check that a solution, of one state or of many along a leading axis, is concrete and belongs to the scene."""
    check_scene(scene)
    checks.instance("solution", solution, Solution, "give what equilibrium, ramp or sweep returned")
    if not is_concrete(*jax.tree.leaves((scene, solution))):
        raise ValueError("scene, solution: expected concrete values, got traced ones; write them outside jit and vmap")
    shape, batch = scene.mesh.nodes.shape, np.shape(solution.status)
    wanted = [(*batch, *shape), (*batch, command_count(scene))]
    got = [np.shape(solution.x), np.shape(solution.ratios)]
    if len(batch) > 1 or got != wanted:
        raise ValueError(
            f"solution: expected x of shape {shape} and {command_count(scene)} commands, or many of them along one "
            f"leading axis, got x {got[0]} and commands {got[1]}; give a solution of this scene"
        )


def each_state(scene: Scene, solution: Solution) -> Iterator[tuple[Scene, jax.Array, int]]:
    """The states of a solution in order: the scene under its commands, positions `(n, d)`, and the status.

    The solution is checked when the first state is asked for.
    """
    check_solution(scene, solution)
    several = np.ndim(solution.status) == 1
    rows = range(len(solution.status)) if several else [...]
    for k in rows:
        commanded = command(scene, solution.ratios[k]) if command_count(scene) else scene
        yield commanded, solution.x[k], int(solution.status[k])


def command_names(scene: Scene) -> list[str]:
    """A name for each command: the word for its term, and a number from 0 for each word."""
    counts: dict[str, int] = {}
    names = []
    for term in commanded_terms(scene):
        word = term.kind.name
        for _ in range(term.command_count):
            names.append(f"{word}_{counts.get(word, 0)}")
            counts[word] = counts.get(word, 0) + 1
    return names


def status_name(status: int) -> str:
    """Flags of a status in words, such as `OK` or `INVERTED|OVERLAPPING`."""
    return Status(status).name or str(status)
