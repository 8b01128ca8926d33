"""Sequential quadratic programming for commands: the search under `reach`, on the host.

Of all commands within bounds at which a measure of the equilibrium meets its target, find those of least effort
(Nocedal and Wright 2006, Numerical Optimization, ch. 18). Each iteration runs two compiled programs: the solve of
`equilibrium`, and the expansion of the measure with the factor of that solve. Everything between them is NumPy.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxbeam.core.tree import unlock
from jaxbeam.linear.layout import Layout
from jaxbeam.scene.scene import Scene, command
from jaxbeam.solve.actuation import from_neighbour, from_rest
from jaxbeam.solve.equilibrium import solve_from
from jaxbeam.solve.newton import Newton
from jaxbeam.solve.solution import Solution
from jaxbeam.study.design import DesignStatus
from jaxbeam.study.expansion import Measure, expand_measure
from jaxbeam.study.quadratic import Program, best_step, softness

# Largest radius of the trust region: the largest change of a ratio in one step.
RADIUS = 0.3
# Largest change that counts as converged. Steps converge quadratically, so the answer is within about its square.
REST = 1e-6
# The most trials with a slack command shortened, until one is nearer to the target.
TIGHTENED = 8


class Task(NamedTuple):
    """What is searched for, in NumPy arrays of float64. Commands, also those of trials, are in multiples of `unit`.

    scene: under any commands.
    layout: of its stiffness.
    unit: `(m,)` unit of each command.
    rest: `(m,)` commands of no effort.
    target: `(p,)` value that the measure should have.
    low: `(m,)` lower bounds of the commands.
    high: `(m,)` upper bounds.
    tolerance: largest deviation from the target that counts as reached.
    measure: `(scene, x)` to `()` or `(p,)`.
    max_solves: largest number of equilibria to solve.
    solver: settings of each solve.
    report: called after each solve with the distance from the target.
    """

    scene: Scene
    layout: Layout
    unit: np.ndarray
    rest: np.ndarray
    target: np.ndarray
    low: np.ndarray
    high: np.ndarray
    tolerance: float
    measure: Measure
    max_solves: int
    solver: Newton
    report: Callable[[float], None]


class Trial(NamedTuple):
    """Commands that were solved, and the measure around them. Derivatives are by commands in multiples of `Task.unit`.

    task: that it belongs to.
    theta: `(m,)` commands.
    solution: their equilibrium.
    value: `(p,)` of the measure.
    slope: `(p, m)` as in `Expansion`.
    bend: `(p, m, m)` as in `Expansion`.
    drift: `(n, 2, m)` as in `Expansion`.
    """

    task: Task
    theta: np.ndarray
    solution: Solution
    value: np.ndarray
    slope: np.ndarray
    bend: np.ndarray
    drift: np.ndarray

    @property
    def miss(self) -> np.ndarray:
        """Measure minus target `(p,)`."""
        return self.value - self.task.target

    @property
    def distance(self) -> float:
        """Euclidean distance of the measure from the target."""
        return float(np.linalg.norm(self.miss))

    @property
    def deviation(self) -> float:
        """Largest deviation of a component of the measure from the target."""
        return float(np.max(np.abs(self.miss)))

    @property
    def effort(self) -> float:
        """Sum of the squared distances of the commands from rest."""
        return float(np.sum((self.task.rest - self.theta) ** 2))

    @property
    def good(self) -> bool:
        """Whether the search can continue from it: status `OK` and finite derivatives."""
        return int(self.solution.status) == 0 and bool(np.isfinite(self.slope).all() and np.isfinite(self.bend).all())


class Known(NamedTuple):
    """A state that a search starts from: commands `(m,)` as the scene takes them, and positions `(n, d)`."""

    commands: Any
    x: Any


@dataclasses.dataclass
class SearchState:
    """The state of a search.

    step: `(m,)` to try next.
    held: `(m,)` the bounds that hold the step, as in `Design`.
    seen: `(m,)` whether an effect of the command was seen, or the command was shortened to its lower bound.
    last: the latest trial.
    here: the latest trial that was accepted; None before the first.
    radius: of the trust region: largest change of a ratio in a step.
    funnel: largest distance from the target for a trial that is accepted although it is farther from it.
    scale: largest squared norm of a slope so far.
    probing: whether the step looks for an effect of commands that have none.
    resting: whether the search has converged.
    rested: distance from the target where it last converged short of it, and slack commands were tried.
    solves: number of equilibria solved.
    tried: commands, distance and status of each trial.
    status: how the search ends.
    """

    step: np.ndarray
    held: np.ndarray
    seen: np.ndarray
    last: Trial | None = None
    here: Trial | None = None
    radius: float = RADIUS
    funnel: float = 0.0
    scale: float = 0.0
    probing: bool = False
    resting: bool = False
    rested: float = np.inf
    solves: int = 0
    tried: list[tuple[np.ndarray, float, int]] = dataclasses.field(default_factory=list)
    status: DesignStatus = DesignStatus.NOT_CONVERGED


def search(task: Task, start: np.ndarray | Trial | Known) -> SearchState:
    """Search by sequential quadratic programming.

    A command without an effect, to first and second order, may have one elsewhere: its tendon may be slack here, or the
    measure flat. If the search would end short of the target, such commands are shortened until an effect is seen. One
    that pulled before may have gone slack on the way: each is tried once more (see `_tightened`).

    Args:
        task: what to search for.
        start: commands `(m,)`, which are approached from rest; or a known state, or the trial of another target.
    """
    m = task.rest.size
    state = SearchState(step=np.zeros(m), held=np.zeros(m, np.int32), seen=np.zeros(m, bool))
    if isinstance(start, Trial):
        trial = start._replace(task=task)
    elif isinstance(start, Known):
        trial = _tried(task, state, np.clip(start.commands / task.unit, task.low, task.high), start)
    else:
        trial = _tried(task, state, start, None)
    while True:
        state.last = trial
        _judge(task, state, trial)
        if state.here is None or not np.isfinite(state.here.miss).all():
            break
        _plan(task, state)
        small = not state.radius > 1e-3 * REST
        if state.resting and (tightened := _tightened(task, state)) is not None:
            trial, state.resting, state.radius, state.probing = tightened, False, RADIUS, True
            continue
        if state.resting or small or state.solves >= task.max_solves or not np.isfinite(state.step).all():
            break
        trial = _tried(task, state, np.clip(state.here.theta + state.step, task.low, task.high), state.here)
    state.status = _status(task, state)
    return state


def solve_trial(task: Task, theta: np.ndarray, before: Trial | Known | None) -> Trial:
    """The equilibrium under commands `theta` `(m,)`, and the measure around it.

    The solve is approached from the state `before`, along its drift if that is known, or from rest if there is none.
    """
    dtype, linear = task.scene.mesh.nodes.dtype, task.solver.linear
    theta, commands = theta.astype(dtype), (theta * task.unit).astype(dtype)
    scene = unlock(command(task.scene, commands))
    if before is None:
        origin = from_rest(scene)
    elif isinstance(before, Known):
        origin = from_neighbour(before.commands.astype(dtype), before.x, np.zeros(before.x.shape, dtype))
    else:
        ahead = before.drift @ (theta - before.theta)
        origin = from_neighbour((before.theta * task.unit).astype(dtype), before.solution.x, ahead.astype(dtype))
    solution, factor = solve_from(origin, scene, task.layout, task.solver)
    around = expand_measure(task.scene, task.layout, commands, solution.x, factor, task.measure, linear)
    value, slope, bend, drift = (each.astype(float) for each in jax.device_get(around))
    slope, bend, drift = slope * task.unit, bend * task.unit * task.unit[:, None], drift * task.unit
    return Trial(task, theta.astype(float), solution, value, slope, bend, drift)


def _tried(task: Task, state: SearchState, theta: np.ndarray, before: Trial | Known | None) -> Trial:
    """Solve a new trial, and record it in the state."""
    trial = solve_trial(task, theta, before)
    state.solves += 1
    state.tried.append((trial.theta, trial.distance, int(trial.solution.status)))
    task.report(trial.distance)
    return trial


def _judge(task: Task, state: SearchState, new: Trial) -> None:
    """Accept or reject the new trial, and update the trust region and the funnel."""
    old = state.here
    # A probing step changes commands that have no effect, so there is nothing to compare: its trial is a new start.
    first = old is None or state.probing
    # Accept a trial that is nearer to the target, or as near up to the accuracy of the solves. Accept also one of less
    # effort within the funnel, which narrows each time.
    nearer = old is None or new.distance <= old.distance + 0.1 * task.tolerance
    cheaper = old is not None and new.distance <= state.funnel and new.effort < old.effort
    # If all commands had an effect somewhere and none has one at the new trial, the step was too long.
    lost = old is not None and state.seen.all() and effects(task, old).any() and not effects(task, new).any()
    lost = lost and new.deviation > task.tolerance
    taken = new.good and (first or nearer or cheaper) and not lost
    if first:
        state.funnel = 0.1 * new.distance
    elif taken and not nearer:
        state.funnel *= 0.5
    if taken:
        state.here = new
        state.scale = max(state.scale, float(np.sum(new.slope**2)))
        state.radius = min(RADIUS, 4 * state.radius)
        state.seen = state.seen | moved_by(task, new)
    else:
        state.radius = 0.25 * float(np.max(np.abs(state.step)))


def _plan(task: Task, state: SearchState) -> None:
    """Set the step to try next, and whether the search has converged."""
    here, radius = state.here, state.radius
    assert here is not None
    room, above = here.theta - task.low, task.high - here.theta
    low, high = np.maximum(-room, -radius), np.minimum(above, radius)
    soft = softness(state.scale)
    program = Program(here.theta, task.rest, here.miss, here.slope, here.bend, state.held, low, high, soft)
    step, held = best_step(program)
    # A command held by the radius alone is not held by a bound.
    state.held = np.where(np.where(held < 0, room <= radius, above <= radius), held, 0)
    near = here.deviation <= task.tolerance
    still = np.max(np.abs(here.slope @ step)) <= 0.5 * task.tolerance
    rest = np.max(np.abs(step)) <= REST and radius > 10 * REST and bool(near or still)
    state.seen = state.seen | (room <= REST)
    state.probing = (rest or state.probing) and not near and not state.seen.all()
    state.step = np.where(state.seen, 0, -np.minimum(room, radius)) if state.probing else step
    state.resting = rest and not state.probing


def _tightened(task: Task, state: SearchState) -> Trial | None:
    """A trial nearer to the target than where the search rests short of it, with a slack command shortened; or None."""
    here = state.here
    if here is None or here.deviation <= task.tolerance or not here.distance < 0.999 * state.rested:
        return None
    state.rested = here.distance
    for k in np.flatnonzero(~moved_by(task, here) & (here.theta - task.low > REST)):
        if (nearer := _tighten(task, state, here, int(k))) is not None:
            return nearer
    return None


def _tighten(task: Task, state: SearchState, here: Trial, k: int) -> Trial | None:
    """A trial nearer to the target than `here`, with the slack command `k` shortened; None if that brings it no nearer.

    Beyond the command at which it begins to act, the measure is nearly linear in it. So a trial there, at which the
    measure has changed by `change` and has the slope `s`, tells both where it begins to act, `change . s / s . s`
    before that trial, and how far beyond it is best shortened, `-miss . s / s . s`.
    """
    slack, acting, wanted = here.theta[k], None, task.low[k]
    for _ in range(TIGHTENED):
        if state.solves >= task.max_solves:
            return None
        trial = _tried(task, state, np.where(np.arange(here.theta.size) == k, wanted, here.theta), here)
        if trial.good and trial.distance < here.distance:
            return trial
        if not trial.good:
            acting = wanted
        elif not moved_by(task, trial)[k]:
            if acting is None:
                return None
            slack = wanted
        else:
            acting, slope = wanted, trial.slope[:, k]
            begins = acting - (trial.value - here.value) @ slope / (slope @ slope)
            wanted = begins - here.miss @ slope / (slope @ slope)
            if wanted >= begins:
                return None
        if not acting < wanted < slack:
            wanted = 0.5 * (acting + slack)
    return None


def moved_by(task: Task, at: Trial) -> np.ndarray:
    """Which commands, `(m,)`, move the measure by more than its round-off, to first order.

    An effect of second order alone tells no way: where a cable begins to pull, the slope is zero, and the search would
    rest there.
    """
    return (np.abs(at.slope) > _round_off(task, at)[:, None]).any(axis=0)


def effects(task: Task, at: Trial) -> np.ndarray:
    """Which commands, `(m,)`, have an effect on the measure above its round-off, to first or second order."""
    most = np.maximum(np.abs(at.slope), np.max(np.abs(at.bend), axis=2))
    return (most > _round_off(task, at)[:, None]).any(axis=0)


def _round_off(task: Task, at: Trial) -> np.ndarray:
    """Round-off `(p,)` of the measure."""
    return np.finfo(task.scene.mesh.nodes.dtype).eps * (np.abs(task.target) + np.abs(at.miss))


def _status(task: Task, state: SearchState) -> DesignStatus:
    """The status of the design that a search ended with."""
    if not state.resting or state.here is None:
        return DesignStatus.NOT_CONVERGED
    if state.here.deviation <= task.tolerance:
        return DesignStatus.REACHED
    # If no command has an effect, it is unknown what can be reached.
    return DesignStatus.UNREACHABLE if effects(task, state.here).any() else DesignStatus.NOT_CONVERGED
