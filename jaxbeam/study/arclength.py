"""Steps along a branch of equilibria, by pseudo-arclength (Keller 1977).

A branch is a curve `(x(t), s(t))`, with `s` the parameter of a path of scenes. The predictor goes along the tangent,
and the corrector is Newton's method in the plane normal to the tangent. So a fold, where the branch turns back in `s`,
is an ordinary point. The tangent stiffness is factorised unmodified, indefinite or not.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core.compiling import compiled
from jaxbeam.core.tree import unlock
from jaxbeam.linear.layout import Layout, assemble, expand, gather
from jaxbeam.scene.evaluation import evaluate, stencil_hessians
from jaxbeam.scene.scene import Scene, at_places, commands_of, extent, has_supports
from jaxbeam.solve.actuation import force_rate, support_rate
from jaxbeam.solve.newton import Newton, topology
from jaxbeam.solve.residual import force_round_off, relative_residual, row_magnitudes

# Limit of the corrections per step. A step that does not converge within it is halved.
MAX_CORRECTIONS = 12


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


class Path(NamedTuple):
    """The scenes whose equilibria are traced: from `start` at `s = 0` to `end` at `s = 1`, linear in all numbers.

    start: a scene.
    end: the same scene with other commands, loads, or any other numbers.
    changes: for each leaf of the unlocked scenes, whether it differs between the two.
    layout: of their stiffness.
    solver: tolerance and linear solver.
    """

    start: Scene
    end: Scene
    changes: tuple[bool, ...]
    layout: Layout
    solver: Newton

    def scene_at(self, s: Any) -> Scene:
        """The scene at the parameter `s` `()`."""
        return jax.tree.map(lambda a, b: a if a is b else (1 - s) * a + s * b, self.start, self.end)

    def commands_at(self, s: np.ndarray) -> np.ndarray:
        """The commands `(P, m)` at parameters `s` `(P,)`."""
        return np.asarray(_commands(unlock(self.start), unlock(self.end), self.changes, s))

    def advance(self, here: Point, length: float) -> Point:
        """The point of the branch at arclength `length` along the tangent of `here`."""
        scenes, arclength = (unlock(self.start), unlock(self.end)), here.s.dtype.type(length)
        return jax.device_get(_advance(*scenes, self.changes, self.layout, here, arclength, self.solver))


def path_between(start: Scene, end: Scene, solver: Newton) -> Path:
    """The path between two scenes.

    Raises:
        ValueError: if they differ in more than numbers.
    """
    if len({jax.tree.structure(start), jax.tree.structure(end)}) > 1:
        raise ValueError(
            "ratios: expected commands, or a scene that differs from `scene` in numbers alone, got one with other "
            "terms, nodes or clamps; give both scenes all terms, such as a load of 0 in the first"
        )
    pairs = zip(*(jax.tree.leaves(unlock(scene)) for scene in (start, end)), strict=True)
    changes = tuple(a is not b and not np.array_equal(a, b) for a, b in pairs)
    return Path(start, end, changes, solver.linear.layout(topology(start)), solver)


def _between(start: Scene, end: Scene, changes: tuple[bool, ...], s: Any) -> Scene:
    """The unlocked scene at the parameter `s` `()`; `changes` as in `Path`. What does not change is not computed."""
    mixed = zip(jax.tree.leaves(start), jax.tree.leaves(end), changes, strict=True)
    leaves = [(1 - s) * a + s * b if change else a for a, b, change in mixed]
    scene: Scene = jax.tree.unflatten(jax.tree.structure(start), leaves)
    return scene


@partial(jax.jit, static_argnames="changes")
def _commands(start: Scene, end: Scene, changes: tuple[bool, ...], s: jax.Array) -> jax.Array:
    return jax.vmap(lambda s: commands_of(_between(start, end, changes, s)))(s)


@compiled("changes", "solver")
def _advance(
    start: Scene,
    end: Scene,
    changes: tuple[bool, ...],
    layout: Layout,
    here: Point,
    length: jax.Array,
    solver: Newton,
) -> Point:
    """The point of the branch at arclength `length` along the tangent of `here`."""
    rtol = solver.tolerance(here.x.dtype)
    scene_at = lambda s: _between(start, end, changes, s)
    # Weight of the inner product of displacements: their mean square, over the square of the body's size.
    weight = 1 / (here.x.size * extent(start) ** 2)

    def linearise(x: jax.Array, s: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """The Newton step at fixed `s`, the derivative of the positions in `s`, the residual, and the inertia."""
        scene = scene_at(s)
        at, hessians = evaluate(scene, x), stencil_hessians(scene, x)
        factor, negative = solver.linear.factor_indefinite(layout, assemble(layout, hessians))
        response = lambda load: expand(
            layout, -solver.linear.solve_indefinite(layout, factor, gather(layout, load)), x.shape
        )
        along = response(force_rate(scene_at, s, x))
        if has_supports(start):
            along += support_rate(scene_at, s)
        residual = relative_residual(scene, at, force_round_off(row_magnitudes(scene, hessians), x), rtol)
        return response(at.gradient), along, residual, negative

    def correct(carry: tuple[Point, jax.Array]) -> tuple[Point, jax.Array]:
        """One Newton step of the corrector, unless the point has converged; and whether it has."""
        point, _ = carry
        x = at_places(scene_at(point.s), point.x)
        balance, along, residual, negative = linearise(x, point.s)
        miss = weight * jnp.sum(here.dx * (x - here.x)) + here.ds * (point.s - here.s) - length
        ds = -(miss + weight * jnp.sum(here.dx * balance)) / (here.ds + weight * jnp.sum(here.dx * along))
        norm = jnp.sqrt(weight * jnp.sum(along**2) + 1)
        sign = jnp.sign(here.ds + weight * jnp.sum(here.dx * along))
        done = (residual <= rtol) & (jnp.abs(miss) <= 1e-6 * jnp.abs(length) + jnp.finfo(length.dtype).eps * 100)
        moved = Point(
            x=jnp.where(done, x, x + balance + ds * along),
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
