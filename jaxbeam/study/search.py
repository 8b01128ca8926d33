"""Sequential quadratic programming for commands: the search under `reach`, on the host.

Of all commands within bounds at which a measure of the equilibrium meets its target, find the one of least effort
(Nocedal and Wright 2006, Numerical Optimization, ch. 18). Each turn of the loop runs two compiled programs: the solve
of `equilibrium`, and the expansion of the measure from the factor of that solve. What decides between them is NumPy.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

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

# The largest change of a ratio in one step, and the change that counts as rest: as steps converge quadratically, the
# answer is within about its square.
RADIUS = 0.3


REST = 1e-6


class Task(NamedTuple):
    """What is searched for, in NumPy arrays of float64. Commands, also those of trials, are in multiples of `unit`.

    unit: `(m,)` of each command. rest: `(m,)` commands of no effort.
    target: `(p,)`. low, high: `(m,)` bounds. tolerance: largest deviation that counts as reached.
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
    """A command that was solved, and the measure around it.

    theta: `(m,)`. value: `(p,)` of the measure. slope, bend, drift: as in `Expansion`.
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
        """How far the measure is from the target."""
        return float(np.linalg.norm(self.miss))

    @property
    def deviation(self) -> float:
        """Largest deviation of a component of the measure."""
        return float(np.max(np.abs(self.miss)))

    @property
    def effort(self) -> float:
        """Sum of the squared distances of the commands from rest."""
        return float(np.sum((self.task.rest - self.theta) ** 2))

    @property
    def good(self) -> bool:
        """Whether it can be gone on from."""
        return int(self.solution.status) == 0 and bool(np.isfinite(self.slope).all() and np.isfinite(self.bend).all())


@dataclasses.dataclass
class SearchState:
    """Where a search is. `step`, `held`, `seen` are `(m,)`.

    last: the trial made last. here: the last one that was accepted; None before the first.
    step: to try next. held: the bounds that hold it, as in `Design`. radius: largest change of a ratio in a step.
    funnel: how far from the target a step may lead that goes away from it. scale: largest squared slope so far.
    seen: commands of which an effect was seen, or that were shortened as far as they go.
    probing: the step looks for an effect of commands that have none. resting: the search has converged.
    solves: equilibria solved. tried: theta, distance and status of each of them.
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
    solves: int = 0
    tried: list[tuple[np.ndarray, float, int]] = dataclasses.field(default_factory=list)
    status: DesignStatus = DesignStatus.NOT_CONVERGED


def search(task: Task, start: np.ndarray | Trial) -> SearchState:
    """Sequential quadratic programming from a command `(m,)`, approached from rest, or from a trial of another target.

    A command that has no effect, to first or second order, may have one elsewhere: a tendon that is slack, or a measure
    that is flat. Where the search would end short of the target, such commands are shortened until an effect is seen.
    """
    m = task.rest.size
    state = SearchState(step=np.zeros(m), held=np.zeros(m, np.int32), seen=np.zeros(m, bool))
    trial = start._replace(task=task) if isinstance(start, Trial) else _tried(task, state, start, None)
    while True:
        state.last = trial
        _judge(task, state, trial)
        if state.here is None or not np.isfinite(state.here.miss).all():
            break
        _plan(task, state)
        small = not state.radius > 1e-3 * REST
        if state.resting or small or state.solves >= task.max_solves or not np.isfinite(state.step).all():
            break
        trial = _tried(task, state, np.clip(state.here.theta + state.step, task.low, task.high), state.here)
    state.status = _status(task, state)
    return state


def solve_trial(task: Task, theta: np.ndarray, before: Trial | None) -> Trial:
    """The equilibrium of the command `theta`, approached from `before` along its drift, and the measure around it."""
    dtype, linear = task.scene.mesh.nodes.dtype, task.solver.linear
    theta, here = theta.astype(dtype), (theta * task.unit).astype(dtype)
    scene = unlock(command(task.scene, here))
    if before is None:
        origin = from_rest(scene)
    else:
        ahead = before.drift @ (theta - before.theta)
        origin = from_neighbour((before.theta * task.unit).astype(dtype), before.solution.x, ahead.astype(dtype))
    solution, factor = solve_from(origin, scene, task.layout, task.solver)
    around = expand_measure(task.scene, task.layout, here, solution.x, factor, task.measure, linear)
    value, slope, bend, drift = (each.astype(float) for each in jax.device_get(around))
    slope, bend, drift = slope * task.unit, bend * task.unit * task.unit[:, None], drift * task.unit
    return Trial(task, theta.astype(float), solution, value, slope, bend, drift)


def _tried(task: Task, state: SearchState, theta: np.ndarray, before: Trial | None) -> Trial:
    """A new trial, recorded."""
    trial = solve_trial(task, theta, before)
    state.solves += 1
    state.tried.append((trial.theta, trial.distance, int(trial.solution.status)))
    task.report(trial.distance)
    return trial


def _judge(task: Task, state: SearchState, new: Trial) -> None:
    """Accept the new trial or not."""
    old = state.here
    # Where commands have no effect there is nothing to follow: what they were shortened to is a start like any.
    first = old is None or state.probing
    # Nearer to the target, or no farther than solves can tell; or cheaper, and not too far from it, which is allowed
    # less and less.
    nearer = old is None or new.distance <= old.distance + 0.1 * task.tolerance
    cheaper = old is not None and new.distance <= state.funnel and new.effort < old.effort
    # Where all commands had an effect somewhere, one at which none has any is a step too far.
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
        state.seen = state.seen | effects(task, new)
    else:
        state.radius = 0.25 * float(np.max(np.abs(state.step)))


def _plan(task: Task, state: SearchState) -> None:
    """The step to try next, and whether the search rests."""
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


def effects(task: Task, at: Trial) -> np.ndarray:
    """Which commands `(m,)` have an effect on the measure, to first or second order: more than its round-off."""
    eps = np.finfo(task.scene.mesh.nodes.dtype).eps
    round_off = eps * (np.abs(task.target) + np.abs(at.miss))
    most = np.maximum(np.abs(at.slope), np.max(np.abs(at.bend), axis=2))
    return (most > round_off[:, None]).any(axis=0)


def _status(task: Task, state: SearchState) -> DesignStatus:
    if not state.resting or state.here is None:
        return DesignStatus.NOT_CONVERGED
    if state.here.deviation <= task.tolerance:
        return DesignStatus.REACHED
    # Without any effect of any command there is no telling what is in reach.
    return DesignStatus.UNREACHABLE if effects(task, state.here).any() else DesignStatus.NOT_CONVERGED
