"""Branches of equilibria, followed through folds, with the points where stability is lost and regained.

Pseudo-arclength continuation (Keller 1977): a branch is a curve `(x(t), s(t))`, with `s` the parameter of the path: 0
at rest (ratio 1) and 1 at the command asked for. The predictor goes along the tangent, and the corrector is Newton's
method in the plane normal to the tangent. So a fold, where the branch turns back in `s`, is an ordinary point. The
tangent stiffness is factorised unmodified, indefinite or not; the number of its negative eigenvalues tells stability.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core import checks
from jaxbeam.core.compiling import compiled, usual_rules
from jaxbeam.core.tree import Numbers, unlock
from jaxbeam.linear.layout import Layout, assemble, expand, gather
from jaxbeam.scene.overlap import crossing
from jaxbeam.scene.scene import Scene, command, evaluate, extent, rest_commands, smallest_jacobian, stencil_hessians
from jaxbeam.solve.equilibrium import equilibrium
from jaxbeam.solve.newton import Newton, check_scene_and_solver, topology
from jaxbeam.solve.residual import force_round_off, relative_residual, row_magnitudes
from jaxbeam.solve.solution import Status, check
from jaxbeam.study.stability import lowest_mode

# Limit of the corrections per step. A step that does not converge within it is halved.
MAX_CORRECTIONS = 12
# The next step may be longer only after one that took at most this many corrections.
EASY = 4


@dataclasses.dataclass(frozen=True)
class Critical:
    """A point where an eigenvalue of the tangent stiffness is zero.

    kind: `"fold"`, where the branch turns back, or `"bifurcation"`, where another branch crosses it.
    parameter: `s` at the point.
    ratios: `(m,)` commands at the point.
    x: `(n, 2)` positions.
    shape: `(n, 2)` mode that belongs to the eigenvalue.
    eigenvalue: its computed value, zero up to round-off.
    after: index of the last point of the branch before it.
    """

    kind: str
    parameter: float
    ratios: np.ndarray
    x: jax.Array
    shape: jax.Array
    eigenvalue: float
    after: int


@dataclasses.dataclass(frozen=True)
class Branch:
    """A traced branch of `P` equilibria.

    parameter: `(P,)` position `s` on the way from rest (ratio 1) to the command.
    ratios: `(P, m)` commands.
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


class Point(NamedTuple):
    """A point on a branch.

    x: `(n, d)` positions.
    s: `()` parameter.
    dx: `(n, d)` positions' part of the unit tangent.
    ds: `()` parameter's part of the unit tangent.
    negative: `()` number of negative eigenvalues of the tangent stiffness.
    residual: `()` relative residual; infinite if the corrector did not converge.
    corrections: `()` corrections taken to get there.
    """

    x: Any
    s: Any
    dx: Any
    ds: Any
    negative: Any
    residual: Any
    corrections: Any


@usual_rules
def trace_branch(
    scene: Scene,
    ratios: Numbers,
    *,
    x0: Numbers | None = None,
    parameter: float = 0.0,
    direction: int = 1,
    interval: tuple[float, float] = (0.0, 1.0),
    step: float = 0.02,
    max_points: int = 1000,
    solver: Newton = Newton(),
    progress: Callable[[int, float], None] | None = None,
) -> Branch:
    """Follow one branch of equilibria of the commands `rest + s (ratios - rest)`, through its folds.

    At rest the ratio of a tendon is 1. At a fold a real beam jumps to another branch; this function stays on the same
    one. It runs on the host, one jitted step after the other.

    Args:
        scene: with `m` tendons.
        ratios: `(m,)` the command at `s = 1`.
        x0: `(n, 2)` positions of the start: an equilibrium, or near one; by default the rest positions.
        parameter: `s` of the start.
        direction: `1` to start towards larger `s`, `-1` towards smaller.
        interval: range of `s`; the branch is followed until `s` leaves it.
        step: largest arclength of a step: the root of `(rms displacement / size)^2 + (change of s)^2`.
        max_points: largest number of points.
        solver: tolerance and linear solver.
        progress: called with the number of points and `s` after each step.

    Returns:
        A `Branch`.

    Raises:
        ValueError: as `command` does, or if an argument is out of its range.
        EquilibriumError: if there is no equilibrium at the start.
    """
    check_scene_and_solver(scene, solver)
    interval, parameter, step = _check_way(direction, interval, parameter, step)
    checks.count("max_points", max_points, 1)
    dtype = scene.mesh.nodes.dtype
    command(scene, ratios)  # checks the ratios
    path = Path(scene, np.asarray(ratios, dtype), solver.linear.layout(topology(scene)), solver)
    x = np.asarray(_first_state(path, parameter, x0))
    # Of the dtypes that `_advance` returns, so that it is compiled once.
    count, residual = np.zeros((), np.int32), np.zeros((), dtype)
    here = Point(x, dtype.type(parameter), np.zeros_like(x), dtype.type(direction), count, residual, count)
    points, critical, ended = _walk(path, path.advance(here, 0.0), interval, step, max_points, progress)
    return _branch(path, points, critical, ended)


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


def on_the_way(scene: Scene, end: Any, s: Any) -> Any:
    """The commands `rest + s (end - rest)`."""
    rest = rest_commands(scene)
    return rest + s * (end - rest)


class Path(NamedTuple):
    """The scenes whose equilibria are traced: those under the commands `rest + s (end - rest)`.

    scene: any of them.
    end: `(m,)` commands at `s = 1`.
    layout: of their stiffness.
    solver: tolerance and linear solver.
    """

    scene: Scene
    end: np.ndarray
    layout: Layout
    solver: Newton

    def scene_at(self, s: jax.Array | float) -> Scene:
        return command(self.scene, self.commands_at(s))

    def commands_at(self, s: Any) -> Any:
        """The commands `(..., m)` at parameters `s` `()` or `(P, 1)`."""
        return on_the_way(self.scene, self.end, s)

    def advance(self, here: Point, length: float) -> Point:
        """The point of the branch at arclength `length` along the tangent of `here`."""
        arclength = here.s.dtype.type(length)
        return jax.device_get(_advance(unlock(self.scene), self.layout, self.end, here, arclength, self.solver))


def _first_state(path: Path, parameter: float, x0: Numbers | None) -> jax.Array:
    """The equilibrium `(n, 2)` to start at."""
    found = equilibrium(path.scene_at(parameter), x0, dataclasses.replace(path.solver, escape=False))
    # A branch may start at a saddle, at a critical point, or where the body overlaps itself.
    if found.status & (Status.NOT_CONVERGED | Status.NONFINITE | Status.INVALID):
        check(found)
    return found.x


def _walk(
    path: Path,
    first: Point,
    interval: tuple[float, float],
    step: float,
    max_points: int,
    progress: Callable[[int, float], None] | None,
) -> tuple[list[Point], list[Critical], str]:
    """The points from `first` on, the critical points between them, and why the walk ended (as in `Branch`)."""
    tolerance, size = path.solver.tolerance(first.x.dtype), float(extent(path.scene))
    points, length = [first], step
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
        if progress is not None:
            progress(len(points), float(new.s))
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
    smallest, overlapping = jax.device_get(_looked_at(path.scene, x))
    return Branch(
        parameter=s,
        ratios=np.asarray(path.commands_at(s[:, None])),
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
    return bool((np.sqrt(offset) > MAX_OFFSET * length) | (cosine < MIN_COSINE))


@compiled("solver")
def _advance(scene: Scene, layout: Layout, end: jax.Array, here: Point, length: jax.Array, solver: Newton) -> Point:
    """The point of the branch at arclength `length` along the tangent of `here`."""
    rtol = solver.tolerance(here.x.dtype)
    # Weight of the inner product of displacements: their mean square, over the square of the body's size.
    weight = 1 / (here.x.size * extent(scene) ** 2)

    def linearise(x: jax.Array, s: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """The Newton step at fixed `s`, the derivative of the positions in `s`, the residual, and the inertia."""
        scene_at = lambda s: command(scene, on_the_way(scene, end, s))
        at = evaluate(scene_at(s), x)
        hessians = stencil_hessians(scene_at(s), x)
        storage = assemble(layout, hessians)
        rate = jax.jvp(lambda s: evaluate(scene_at(s), x).gradient, (s,), (jnp.ones_like(s),))[1]
        factor, negative = solver.linear.factor_indefinite(layout, storage)
        gradient = gather(layout, at.gradient)
        solve = lambda v: expand(layout, -solver.linear.solve_indefinite(layout, factor, v), x.shape)
        residual = relative_residual(scene, at, force_round_off(row_magnitudes(scene, hessians), x), rtol)
        return solve(gradient), solve(gather(layout, rate)), residual, negative

    def correct(carry: tuple[Point, jax.Array]) -> tuple[Point, jax.Array]:
        """One Newton step of the corrector, unless the point has converged; and whether it has."""
        point, _ = carry
        balance, along, residual, negative = linearise(point.x, point.s)
        miss = weight * jnp.sum(here.dx * (point.x - here.x)) + here.ds * (point.s - here.s) - length
        ds = -(miss + weight * jnp.sum(here.dx * balance)) / (here.ds + weight * jnp.sum(here.dx * along))
        norm = jnp.sqrt(weight * jnp.sum(along**2) + 1)
        sign = jnp.sign(here.ds + weight * jnp.sum(here.dx * along))
        done = (residual <= rtol) & (jnp.abs(miss) <= 1e-6 * jnp.abs(length) + jnp.finfo(length.dtype).eps * 100)
        moved = Point(
            x=jnp.where(done, point.x, point.x + balance + ds * along),
            s=jnp.where(done, point.s, point.s + ds),
            dx=sign * along / norm,
            ds=sign / norm,
            negative=negative,
            residual=residual,
            corrections=point.corrections + ~done,
        )
        return moved, done

    guess = Point(
        here.x + length * here.dx, here.s + length * here.ds, here.dx, here.ds,
        jnp.zeros((), jnp.int32), jnp.asarray(jnp.inf, here.x.dtype), jnp.zeros((), jnp.int32),
    )  # fmt: skip
    going = lambda carry: ~carry[1] & (carry[0].corrections <= MAX_CORRECTIONS)
    point, done = lax.while_loop(going, correct, (guess, jnp.asarray(False)))
    return point._replace(residual=jnp.where(done, point.residual, jnp.inf))


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

    low, high = 0.0, length
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
    ratios = np.asarray(path.commands_at(point.s))
    kind = "fold" if float(old.ds) * float(new.ds) < 0 else "bifurcation"
    return Critical(kind, float(point.s), ratios, jnp.asarray(point.x), shape, value, after)
