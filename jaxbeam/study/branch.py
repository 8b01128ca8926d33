"""Branches of equilibria, followed through folds, with the points where stability is lost and regained.

A branch leads from one scene to another that differs in its commands, its loads or any other numbers. It is followed
step by step (`jaxbeam.study.arclength`). The number of negative eigenvalues of the tangent stiffness tells stability;
where it changes is a critical point, and from a bifurcation the branch that crosses there can be followed.

Use it to find where a beam snaps, and what states there are besides. A `ramp` tells where the beam ends up after the
snap, and `lowest_mode` how near one state is to it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.progress import Report, check_progress
from jaxbeam.core.tree import Numbers
from jaxbeam.scene.evaluation import smallest_jacobian
from jaxbeam.scene.overlap import crossing
from jaxbeam.scene.scene import Scene, command, extent, rest_commands
from jaxbeam.solve.equilibrium import equilibrium
from jaxbeam.solve.newton import Newton, check_scene_and_solver
from jaxbeam.solve.solution import EquilibriumError, Status, check
from jaxbeam.study.arclength import Path, Point, path_between
from jaxbeam.study.stability import lowest_mode

# A crossing branch is looked for at this arclength from its bifurcation, over the length of a step. It may deviate from
# the normal of the traced branch by this slope.
BESIDE = 1e-3
SLANT = 50.0
# The next step may be longer only after one that took at most this many corrections.
EASY = 4


@dataclasses.dataclass(frozen=True)
class Critical:
    """A point where an eigenvalue of the tangent stiffness is zero.

    kind: `"fold"`, where the branch turns back, or `"bifurcation"`, where another branch crosses it.
    parameter: `s` at the point.
    ratios: `(m,)` commands at the point, ratios of tendons and others.
    x: `(n, 2)` positions.
    shape: `(n, 2)` mode that belongs to the eigenvalue.
    eigenvalue: its computed value, zero up to round-off.
    after: index of the last point of the branch before it.
    residual: relative residual, as in `Solution`.
    tangent: positions' part `(n, 2)` and parameter's part of the unit tangent of the branch that was traced.
    """

    kind: str
    parameter: float
    ratios: np.ndarray
    x: jax.Array
    shape: jax.Array
    eigenvalue: float
    after: int
    residual: float
    tangent: tuple[np.ndarray, float]


@dataclasses.dataclass(frozen=True)
class Branch:
    """A traced branch of `P` equilibria.

    parameter: `(P,)` position `s` on the way: 0 at its start, 1 at its end.
    ratios: `(P, m)` commands, ratios of tendons and others.
    x: `(P, n, 2)` positions.
    negative: `(P,)` number of negative eigenvalues of the tangent stiffness; stable where it is 0.
    residual: `(P,)` relative residual, as in `Solution`.
    smallest_jacobian: `(P,)` smallest `J`, as in `Solution`.
    overlapping: `(P,)` booleans, true where the body passes through itself.
    critical: the folds and bifurcations on it, in order.
    ended: why it ends: `"left"` (it left the interval), `"points"` (as many as allowed) or `"step"` (steps failed until
        they were too short).
    """

    parameter: np.ndarray
    ratios: np.ndarray
    x: np.ndarray
    negative: np.ndarray
    residual: np.ndarray
    smallest_jacobian: np.ndarray
    overlapping: np.ndarray
    critical: tuple[Critical, ...]
    ended: str

    @property
    def stable(self) -> np.ndarray:
        """`(P,)` booleans, true where the equilibrium is stable."""
        return self.negative == 0


@usual_rules
def trace_branch(
    scene: Scene,
    ratios: Numbers | Scene,
    *,
    x0: Numbers | None = None,
    parameter: float = 0.0,
    through: Critical | None = None,
    direction: int = 1,
    interval: tuple[float, float] = (0.0, 1.0),
    step: float = 0.02,
    max_points: int = 1000,
    solver: Newton = Newton(),
    progress: bool | Callable[[int, float], None] | None = None,
) -> Branch:
    """Follow one branch of equilibria as commands, loads or other numbers change, through its folds.

    At a fold a real beam jumps to another branch; this function stays on the same one. It runs on the host, one jitted
    step after the other. From a bifurcation of a traced branch, `through=branch.critical[0]` follows the branch that
    crosses it there.

    Args:
        scene: with `m` commands.
        ratios: commands `(m,)` at `s = 1`. They grow from those at rest (ratio 1 of tendons) at `s = 0`, and all else
            stays as in `scene`. Or another scene, such as the same one under a larger load: then all numbers in which
            the two differ change in proportion, from `scene` at `s = 0` to it at `s = 1`.
        x0: `(n, 2)` positions of the start: an equilibrium, or near one; by default the rest positions.
        parameter: `s` of the start.
        through: a bifurcation at which to start, in place of `x0` and `parameter`, of a branch traced with the same
            `scene` and `ratios`. To follow both halves of the branch that crosses there, call it with both directions.
        direction: `1` to start towards larger `s`, `-1` towards smaller. From a bifurcation, `1` starts along its
            `shape`, and `-1` against it.
        interval: range of `s`; the branch is followed until `s` leaves it.
        step: largest arclength of a step: the root of `(rms displacement / size)^2 + (change of s)^2`.
        max_points: largest number of points.
        solver: tolerance and linear solver.
        progress: `True` draws a line of progress on stderr, if that is a terminal. A function is called after each
            step, as `progress(points, s)`, with the number of points and `s`.

    Returns:
        A `Branch`.

    Raises:
        ValueError: as `command` does, if an argument is out of its range, if `ratios` is a scene with other terms or
            nodes, or if `through` is not a bifurcation or given together with `x0` or `parameter`.
        EquilibriumError: if there is no equilibrium at the start, or no other branch is found at the bifurcation.
    """
    check_scene_and_solver(scene, solver)
    if through is not None:
        parameter = _check_bifurcation(scene, through, x0, parameter)
    interval, parameter, step = _check_way(direction, interval, parameter, step)
    checks.count("max_points", max_points, 1)
    check_progress(progress, "(points, s)")
    if isinstance(ratios, Scene):
        path = path_between(scene, ratios, solver)
    else:
        path = path_between(command(scene, rest_commands(scene)), command(scene, ratios), solver)
    with Report(progress, "points") as report:
        if through is None:
            x = _first_state(path, parameter, x0)
            points = [path.advance(_start(x, parameter, np.zeros_like(x), direction), 0.0)]
        else:
            points = _beside(path, through, direction, step)[:max_points]
        walked = _walk(path, points, interval, step, max_points, report)
    return _branch(path, *walked)


def _start(x: np.ndarray, s: float, dx: np.ndarray, ds: float) -> Point:
    """A point to start at, with its tangent, of the dtypes that a step returns, so that it is compiled once."""
    count, residual, dtype = np.zeros((), np.int32), np.zeros((), x.dtype), x.dtype.type
    return Point(x, dtype(s), dx.astype(x.dtype), dtype(ds), count, residual, count)


def _check_way(
    direction: int, interval: tuple[float, float], parameter: float, step: float
) -> tuple[tuple[float, float], float, float]:
    """Interval, parameter and step as plain numbers, checked with the direction."""
    if isinstance(direction, bool) or direction not in (1, -1):
        raise ValueError(f"direction: expected 1 or -1, got {direction!r}")
    step, parameter = checks.setting("step", step, checks.POSITIVE), checks.setting("parameter", parameter)
    low, high = checks.numbers("interval", interval, shapes=((2,),)).tolist()
    if not low <= parameter <= high or not low < high:
        raise ValueError(
            f"expected interval[0] <= parameter <= interval[1], got interval {interval!r}, parameter {parameter!r}"
        )
    return (low, high), parameter, step


def _first_state(path: Path, parameter: float, x0: Numbers | None) -> np.ndarray:
    """The equilibrium `(n, 2)` to start at."""
    found = equilibrium(path.scene_at(parameter), x0, dataclasses.replace(path.solver, escape=False))
    # A branch may start at a saddle, at a critical point, or where the body overlaps itself.
    if found.status & (Status.NOT_CONVERGED | Status.NONFINITE | Status.INVALID):
        check(found)
    return np.asarray(found.x)


def _check_bifurcation(scene: Scene, through: Critical, x0: Numbers | None, parameter: float) -> float:
    """The parameter of a bifurcation to start at."""
    checks.instance("through", through, Critical, "give one of branch.critical")
    if through.kind != "bifurcation":
        raise ValueError(f"through: expected a bifurcation, got a {through.kind}, at which no other branch crosses")
    if through.x.shape != scene.mesh.nodes.shape:
        shapes = f"shape {scene.mesh.nodes.shape}, got {through.x.shape}"
        raise ValueError(f"through: expected positions of this scene, {shapes}; give a point of a branch of it")
    if x0 is not None or parameter != 0:
        raise ValueError("through: expected neither x0 nor parameter beside it, because the branch starts at its point")
    return through.parameter


def _beside(path: Path, fork: Critical, direction: int, step: float) -> list[Point]:
    """A bifurcation, and the first point beside it on the branch that crosses there.

    The tangent of that branch lies in the plane of the traced branch's tangent and of the mode. The point is looked for
    in the direction of this plane that is normal to the traced branch, and near, because the traced branch is found
    again only where its bend leads as far: a distance of the order of the root.

    Raises:
        EquilibriumError: if no point is found.
    """
    x = np.asarray(fork.x)
    weight = 1 / (x.size * float(extent(path.start)) ** 2)
    mode, (dx, ds) = np.asarray(fork.shape, x.dtype), fork.tangent
    dot = weight * np.sum(mode * dx) / (weight * np.sum(dx**2) + ds**2)
    away, ds_away = mode - dot * dx, -dot * ds
    scale = direction / np.sqrt(weight * np.sum(away**2) + ds_away**2)
    here = _start(x, fork.parameter, scale * away, scale * ds_away)
    length, tolerance = BESIDE * step, path.solver.tolerance(x.dtype)
    while length > 1e-3 * BESIDE * step:
        point = path.advance(here, length)
        offset = weight * np.sum((point.x - x - length * here.dx) ** 2) + (point.s - here.s - length * here.ds) ** 2
        if point.residual <= tolerance and offset <= (SLANT * length) ** 2:
            residual = x.dtype.type(fork.residual)
            return [here._replace(negative=point.negative, residual=residual), point]
        length /= 2
    raise EquilibriumError(
        "through: no state of another branch was found beside the bifurcation; trace with a smaller step, or start "
        "from x0 = through.x + a little of through.shape"
    )


def _walk(
    path: Path,
    points: list[Point],
    interval: tuple[float, float],
    step: float,
    max_points: int,
    report: Report,
) -> tuple[list[Point], list[Critical], str]:
    """All points from the first ones on, critical points between them, and why the walk ended (as in `Branch`)."""
    tolerance, size, length = path.solver.tolerance(points[0].x.dtype), float(extent(path.start)), step
    critical: list[Critical] = []
    while len(points) < max_points:
        old, new = points[-1], path.advance(points[-1], length)
        if not float(new.residual) <= tolerance or _strays(old, new, length, size):
            length /= 2
            # An infinite `step` ends here too, because half of it is infinite as well.
            if not length > 1e-6 * step:
                return points, critical, "step"
            continue
        if int(new.negative) != int(old.negative):
            critical.append(_locate(path, old, new, length, len(points) - 1))
        points.append(new)
        if int(new.corrections) <= EASY:
            length = min(1.5 * length, step)
        report(len(points), f"s = {float(new.s):.4f}", call=(len(points), float(new.s)))
        if not interval[0] <= float(new.s) <= interval[1]:
            return points, critical, "left"
    return points, critical, "points"


def _branch(path: Path, points: list[Point], critical: list[Critical], ended: str) -> Branch:
    """The points of a branch that was followed, stacked into a `Branch`, and what is measured at each of them.

    Args:
        path: the path whose equilibria they are.
        points: at least one, in order.
        critical: folds and bifurcations between them.
        ended: why it ends, as in `Branch`.
    """
    stack = lambda name: np.stack([getattr(point, name) for point in points])
    s, x = stack("s"), stack("x")
    smallest, overlapping = jax.device_get(_looked_at(path.start, x))
    return Branch(
        parameter=s,
        ratios=path.commands_at(s),
        x=x,
        negative=stack("negative"),
        residual=stack("residual"),
        smallest_jacobian=smallest,
        overlapping=overlapping,
        critical=tuple(critical),
        ended=ended,
    )


@jax.jit
def _looked_at(scene: Scene, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The smallest `J`, and whether the body passes through itself, at each of the positions `(P, n, d)`."""
    # Of two edges that cross `crossing` gives the nodes, and -1 if none do.
    return lax.map(lambda y: (smallest_jacobian(scene, y), crossing(scene, y)[0, 0] >= 0), x)


# Largest distance of a new point from its prediction, over the length of the step, and least cosine of the angle
# between the tangents of neighbours. Wider limits let a step jump to another branch.
MAX_OFFSET = 0.1
MIN_COSINE = 0.9


def _strays(old: Point, new: Point, length: float, size: float) -> bool:
    """Whether the new point lies so far from the old tangent that it may be on another branch."""
    weight = 1 / (new.x.size * size**2)
    offset = weight * np.sum((new.x - old.x - length * old.dx) ** 2) + (new.s - old.s - length * old.ds) ** 2
    cosine = weight * np.sum(new.dx * old.dx) + new.ds * old.ds
    # Exactly at a critical point the tangent may be NaN: then a shorter step is taken too.
    return not (np.sqrt(offset) <= MAX_OFFSET * length and cosine >= MIN_COSINE)


def _locate(path: Path, old: Point, new: Point, length: float, after: int) -> Critical:
    """The critical point between two neighbours: where, along the branch, an eigenvalue changes sign.

    The root is found by regula falsi with the Illinois rule (Dowell and Jarratt 1971).

    Args:
        path: the scenes.
        old: point before it.
        new: point after it, at arclength `length` from `old`.
        length: arclength between them.
        after: index of `old` in the branch.
    """
    which = min(int(old.negative), int(new.negative))

    def eigen(point: Point) -> tuple[float, jax.Array]:
        """The eigenvalue that changes sign, and its mode `(n, 2)`."""
        modes = lowest_mode(path.scene_at(point.s), point.x, which + 1, path.solver)
        return float(modes.values[which]), modes.shapes[which]

    low, high, middle = 0.0, length, length
    point, (f_low, _), (f_high, shape) = new, eigen(old), eigen(new)
    scale, side, value = max(abs(f_low), abs(f_high)), 0, f_high
    for _ in range(60):
        middle = (low * f_high - high * f_low) / (f_high - f_low)
        point = path.advance(old, middle)
        value, shape = eigen(point)
        if abs(value) <= 1e-10 * scale or high - low <= 1e-13 * length:
            break
        if (value > 0) == (f_high > 0):
            high, f_high = middle, value
            f_low *= 0.5 if side == 1 else 1.0
            side = 1
        else:
            low, f_low = middle, value
            f_high *= 0.5 if side == -1 else 1.0
            side = -1
    share = middle / length
    dx, ds = ((1 - share) * a + share * b for a, b in ((old.dx, new.dx), (old.ds, new.ds)))
    return Critical(
        kind="fold" if float(old.ds) * float(new.ds) < 0 else "bifurcation",
        parameter=float(point.s),
        ratios=path.commands_at(point.s[None])[0],
        x=jnp.asarray(point.x),
        shape=shape,
        eigenvalue=value,
        after=after,
        residual=float(point.residual),
        tangent=(dx, float(ds)),
    )
