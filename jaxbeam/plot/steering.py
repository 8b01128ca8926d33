"""A beam steered by hand, without its window: commands are set or the tip is moved, each from the last good state."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxbeam.core.tree import Numbers, unlock
from jaxbeam.plot.lines import command_names
from jaxbeam.scene.measures import tendon_lengths, tendon_tensions, tip_angle
from jaxbeam.scene.scene import Scene, command, commands_of, rest_commands
from jaxbeam.solve.actuation import Origin, from_neighbour, from_rest
from jaxbeam.solve.equilibrium import solve_from
from jaxbeam.solve.newton import Newton, topology
from jaxbeam.solve.solution import REMEDIES, Solution, Status
from jaxbeam.study.design import DesignStatus
from jaxbeam.study.expansion import Measure
from jaxbeam.study.reach import command_bounds, reach

# Largest distance of the tip from where it is dragged to, as a share of the body, and in units of round-off.
FOLLOWS, ROUNDED = 1e-8, 100
# Numbers in a line of facts.
ROW = 4


class Shown(NamedTuple):
    """What a window shows.

    scene: under the commands of this state.
    commands: `(m,)`.
    solution: the last solve. If its status is not `OK`, `reasons` says why.
    held: `(m,)` -1 or 1 where the lower or upper bound keeps the tip from where it was dragged to, else 0.
    target: `(2,)` where the tip was dragged to, or None.
    facts: names and texts of what was measured.
    reasons: what is wrong and what to try, one for each flag; empty if nothing is.
    """

    scene: Scene
    commands: np.ndarray
    solution: Solution
    held: np.ndarray
    target: np.ndarray | None
    facts: list[tuple[str, str]]
    reasons: list[str]


@dataclasses.dataclass
class Steering:
    """A beam whose commands are set, or whose tip is dragged.

    Args:
        scene: with `m` commands, at least one.
        bounds: lowest and highest command, as in `reach`.
        measure: `(scene, x)` to the point `(2,)` that is dragged, or None.
        solver: settings of each solve.

    Raises:
        ValueError: if the bounds are wrong, as `reach` does, or do not hold the present commands of the scene.
    """

    scene: Scene
    bounds: tuple[Numbers, Numbers] | None
    measure: Measure | None
    solver: Newton

    def __post_init__(self) -> None:
        self.low, self.high = (np.asarray(end) for end in command_bounds(self.scene, self.bounds))
        self.start = np.asarray(commands_of(self.scene))
        if not ((self.low <= self.start) & (self.start <= self.high)).all():
            raise ValueError(
                f"bounds: expected some that hold the commands of the scene {self.start.tolist()}, got low "
                f"{self.low.tolist()} and high {self.high.tolist()}; widen them, or command the scene first"
            )
        self.layout = self.solver.linear.layout(topology(self.scene))
        rest = np.asarray(self.scene.mesh.nodes)
        self.size = float(np.ptp(rest[:, :2], axis=0).max())
        self.tolerance = max(FOLLOWS, ROUNDED * float(np.finfo(rest.dtype).eps)) * self.size
        self.last: Solution | None = None  # the last one that is OK: the next one is approached from it

    def begin(self) -> Shown:
        """The equilibrium under the commands that the scene came with, approached from rest."""
        self.last = None
        return self.set(self.start)

    def rest(self) -> Shown:
        """The equilibrium under commands of no effort, or the nearest within the bounds, approached from rest."""
        self.last = None
        return self.set(np.clip(rest_commands(self.scene), self.low, self.high))

    def set(self, commands: np.ndarray) -> Shown:
        """The equilibrium under commands `(m,)`, approached from the last good state."""
        scene = command(self.scene, commands)
        solution, _ = solve_from(self._origin(scene), unlock(scene), self.layout, self.solver)
        self._keep(solution)
        return self._shown(solution, np.zeros(len(commands), int), None, [])

    def drag(self, target: np.ndarray) -> Shown:
        """The state with the dragged point at `target` `(2,)`, or as near as the bounds let it come."""
        assert self.measure is not None
        found = reach(
            self.scene,
            target,
            self.measure,
            bounds=(self.low, self.high),
            starts=self.last,
            tolerance=self.tolerance,
            solver=self.solver,
        )
        status, held = DesignStatus(int(found.status)), np.asarray(found.held)
        if status == DesignStatus.NOT_CONVERGED:
            shown = found.solution if self.last is None else self.last
            text = "the search for commands broke off; the last good state is shown. Drag in smaller steps"
            return self._shown(shown, np.zeros_like(held), target, [f"NOT_CONVERGED: {text}"])
        self._keep(found.solution)
        if status == DesignStatus.REACHED:
            return self._shown(found.solution, np.zeros_like(held), None, [])
        ends = np.where(held < 0, self.low, self.high)
        names = command_names(self.scene)
        ways = [f"{names[k]} is at its bound {ends[k]:g}" for k in np.flatnonzero(held)]
        why = ", ".join(ways) or "no command brings it nearer"
        return self._shown(found.solution, held, target, [f"UNREACHABLE: this is the nearest point; {why}"])

    def stay(self) -> Shown:
        """A drag to where the point is already: it compiles the search. A state that is not OK is shown again."""
        assert self.measure is not None
        if self.last is None:
            return self.begin()
        return self.drag(np.asarray(self.measure(self.scene, self.last.x)))

    def _origin(self, scene: Scene) -> Origin:
        """The last good state to approach `scene` from; rest if there is none."""
        if self.last is None:
            return from_rest(unlock(scene))
        x = self.last.x
        return from_neighbour(np.asarray(self.last.ratios), x, np.zeros(x.shape, x.dtype))

    def _keep(self, solution: Solution) -> None:
        """Go on from this state if it is OK. One that overlaps, say, may lie on a branch that no beam comes to."""
        self.last = self.last if int(solution.status) else solution

    def _shown(self, solution: Solution, held: np.ndarray, target: np.ndarray | None, reasons: list[str]) -> Shown:
        scene = command(self.scene, solution.ratios)
        flags = Status(int(solution.status))
        reasons = reasons + [f"{flag.name}: {REMEDIES[flag]}" for flag in flags]
        facts = _facts(scene, solution.x)
        facts.append(("smallest J", f"{float(solution.smallest_jacobian):.3f}"))
        facts.append(("Newton steps", f"{int(solution.steps)}"))
        return Shown(scene, np.asarray(solution.ratios), solution, held, target, facts, reasons)


def _facts(scene: Scene, x: jax.Array) -> list[tuple[str, str]]:
    """What can be measured of this scene, in words and numbers."""
    words = lambda values: [f"{float(value):.4g}" for value in np.ravel(values)]
    rows = lambda values: ",\n".join(", ".join(words(values)[k : k + ROW]) for k in range(0, values.size, ROW))
    measures: list[tuple[str, Callable[..., Any], Callable[..., str]]] = [
        ("lengths", tendon_lengths, rows),
        ("tensions", tendon_tensions, rows),
    ]
    if scene.tip.size and scene.fixed.all(axis=1).any() and not scene.fixed[scene.tip][:, :2].all():
        measures.insert(0, ("tip angle", tip_angle, lambda angle: f"{float(angle):+.3f}°"))
    found = [(name, text(measure(scene, x))) for name, measure, text in measures]
    return [(name, text) for name, text in found if text]
