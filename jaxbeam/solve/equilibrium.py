"""Quasistatic equilibrium of one scene, its linear approximation, and the derivatives of both.

At equilibrium the gradient of the energy vanishes at every free coordinate. The equilibrium is stable if the Hessian
there is positive definite. `follow` (`jaxbeam.solve.continuation`) makes as many Newton solves as it takes to follow a
path of scenes. A single equilibrium is a path with one target.

For many commands use `sweep`, for the way to one `ramp`; both cost less than as many calls of `equilibrium`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core.compiling import compiled, usual_rules
from jaxbeam.core.derivative import custom_derivative
from jaxbeam.core.tree import Numbers, is_concrete, replace, unlock
from jaxbeam.linear.layout import Layout, LinearSolver, assemble, expand, gather
from jaxbeam.linear.tridiagonal import BlockTridiagonal
from jaxbeam.scene.evaluation import energy, evaluate, smallest_jacobian, stencil_hessians, worst_element
from jaxbeam.scene.rigid import check_held
from jaxbeam.scene.scene import Scene, at_places, check_scene, command, commands_of, has_supports, placed, rest_commands
from jaxbeam.solve.actuation import Origin, from_rest, scene_between
from jaxbeam.solve.continuation import follow
from jaxbeam.solve.implicit import attach_derivative, attach_derivative_of_root, linear_gradient
from jaxbeam.solve.newton import Newton, check_linear, check_scene_and_solver, topology
from jaxbeam.solve.predictor import start_trail
from jaxbeam.solve.solution import Solution, outlined


@usual_rules
def equilibrium(scene: Scene, x0: Numbers | None = None, solver: Newton = Newton()) -> Solution:
    """Node positions at which all forces balance.

    Newton's method starts at `x0`. If it fails, commands and loads are increased from rest in steps as small as needed.
    If it converges to a saddle, it goes on to the stable state beside it (unless `solver.escape` is false).

    `x`, `energy`, `smallest_jacobian` and `ratios` are differentiable in every float of the scene, forward, reverse
    and to any order, but not in `x0`. The derivative takes one back-substitution (see `jaxbeam.solve.implicit`). It is
    NaN where the status is not `OK`, and does not exist at a fold.

    Args:
        scene: what to solve.
        x0: `(n, d)` start positions; by default the rest positions. Fixed coordinates are put at rest.
        solver: settings.

    Returns:
        A `Solution`. A solve that fails raises no error: `status` tells that it failed, and `check` raises.

    Raises:
        ValueError: if `x0` has another shape, or is concrete and not finite or inverts an element, or if a
            piece of the mesh is not held and moves as a rigid body.
    """
    check_scene_and_solver(scene, solver)
    check_held(scene)
    layout = solver.linear.layout(topology(scene))
    open_scene, x = unlock(scene), start(scene, x0)
    if is_concrete(x, *jax.tree.leaves(scene)):
        return outlined(solve_from(from_rest(open_scene, x), open_scene, layout, solver)[0], scene.mesh)
    still, layout, x = lax.stop_gradient((open_scene, layout, x))
    solution, factor = solve_from(from_rest(still, x), still, layout, solver)
    return outlined(differentiable(open_scene, layout, solution, factor, solver), scene.mesh)


@usual_rules
def linear_response(scene: Scene, linear: LinearSolver = BlockTridiagonal()) -> jax.Array:
    """Node positions `(n, d)` by linear elasticity: the solution of a single linear system.

    The energy of all terms, tendons included, is expanded to second order about rest, so displacements are proportional
    to small commands and loads. The result is cheap, and exact for small ones. For larger ones it does not tell how
    wrong it is: on the reference beam with its top tendon pulled to 0.95, 0.8, 0.65 and 0.5 the angle is 7, 24, 36 and
    37 % too small, and the tension 3, 13, 30 and 67 % too large.

    Args:
        scene: what to solve.
        linear: the linear solver.

    Raises:
        ValueError: if a piece of the mesh is not held, or if the scene is not stable at rest, so that a small command
            or load does not lead to a state near rest. Inside jit an unstable scene gives free coordinates of NaN
            instead.
    """
    check_scene(scene)
    check_linear("linear", linear)
    check_held(scene)
    layout, open_scene = linear.layout(topology(scene)), unlock(scene)
    x, stable, factor = _linear_response(*lax.stop_gradient((open_scene, layout)), linear)
    if is_concrete(stable) and not stable:
        raise ValueError(
            "scene: it is not stable at rest, its stiffness there is not positive definite, so no linear response "
            "exists; see lowest_mode(scene, scene.mesh.nodes), and solve it with equilibrium"
        )
    if is_concrete(*jax.tree.leaves(scene)):
        return x
    return _moving_response(open_scene, layout, x, stable, factor, linear)


@compiled("linear")
def _linear_response(scene: Scene, layout: Layout, linear: LinearSolver) -> tuple[jax.Array, jax.Array, Any]:
    """One Newton step from rest, where the actuated terms and the loads are out of balance.

    Returns:
        Positions `(n, d)`; whether the stiffness at rest is positive definite, a boolean `()`; and the factor of that
        stiffness. If it is not positive definite, the factor contains NaN, and so do the free coordinates of the
        positions. Fixed coordinates stay at rest.
    """
    rest = scene.mesh.nodes
    factor, stable = linear.factor(layout, assemble(layout, stencil_hessians(scene, rest)))
    start = at_places(scene, rest)
    gradient = linear_gradient(scene, start) if has_supports(scene) else evaluate(scene, rest).gradient
    step = linear.solve(layout, factor, gather(layout, gradient))
    return start - expand(layout, step, rest.shape), stable, factor


@partial(jax.jit, static_argnames="linear")
def _moving_response(
    scene: Scene, layout: Layout, x: jax.Array, stable: jax.Array, factor: Any, linear: LinearSolver
) -> jax.Array:
    """The linear response `x`, with its derivative in the scene attached."""
    # The NaN of an unstable scene is added at the end. As part of a derivative it would spread to results that do not
    # depend on this one.
    finite = jnp.where(stable, x, lax.stop_gradient(scene.mesh.nodes))
    moving = attach_derivative_of_root(linear, linear_gradient, scene, layout, finite, factor, stable)
    return moving + jnp.where(stable | scene.held, 0, jnp.nan).astype(x.dtype)


@compiled("solver")
def solve_from(origin: Origin, scene: Scene, layout: Layout, solver: Newton) -> tuple[Solution, Any]:
    """The equilibrium of an unlocked scene and the factor of its stiffness.

    The first attempt starts at `origin.first + origin.ahead`. If it fails, the scene is approached from `origin` in
    smaller increments. The origin is data, not structure: `equilibrium` and the searches of `reach` run the same
    compiled program.
    """
    trail = start_trail(origin.x, origin.ahead)._replace(depth=origin.known)
    scene_at = lambda s: scene_between(origin, scene, s)
    targets = jnp.ones(1, scene.mesh.nodes.dtype)
    path, factor, _ = follow(scene_at, layout, trail, targets, solver, origin.first, origin.ahead)
    return jax.tree.map(lambda leaf: leaf[0], path), factor


@partial(jax.jit, static_argnames="solver")
def differentiable(scene: Scene, layout: Layout, solution: Solution, factor: Any, solver: Newton) -> Solution:
    """The solution, with derivatives in the scene attached to `x`, `energy`, `smallest_jacobian` and `ratios`.

    `factor` is as in `attach_derivative`.
    """
    x = attach_derivative(solver.linear, scene, layout, solution.x, factor, solution.status == 0)
    return replace(
        solution, x=x, energy=energy(scene, x), smallest_jacobian=smallest_jacobian(scene, x), ratios=commands_of(scene)
    )


@custom_derivative
def _sane(commands: jax.Array, rest: jax.Array, good: jax.Array) -> jax.Array:
    """`commands` `(m,)` if `good` `()`, else `rest` `(m,)`; in both cases the derivative is that of `commands`.

    A bad row may be NaN. If the loss does not depend on it, its cotangent is zero; but zero times the derivative at NaN
    commands is NaN, and would spread to the parameters that all rows share.
    """
    return jnp.where(good, commands, rest)


@_sane.defjvp
def _sane_jvp(primals: tuple[jax.Array, ...], tangents: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
    return _sane(*primals), tangents[0]


@partial(jax.jit, static_argnames="solver")
def differentiable_rows(scene: Scene, layout: Layout, rows: jax.Array, found: Solution, solver: Newton) -> Solution:
    """Solutions `(B, ...)` of the commands `rows` `(B, m)`, with derivatives in the commands and the scene attached.

    The factors of all rows would not fit in memory. Each row is factorised anew when it is differentiated.
    """

    @jax.checkpoint
    def one(row_and_solution: tuple[jax.Array, Solution]) -> Solution:
        ratios, solution = row_and_solution
        good = solution.status == 0
        commanded = command(scene, _sane(ratios, rest_commands(scene), good))
        moved = differentiable(commanded, layout, solution, None, solver)
        return replace(moved, ratios=ratios, energy=jnp.where(good, moved.energy, solution.energy))

    return lax.map(one, (rows, found))


def start(scene: Scene, x0: Numbers | None) -> jax.Array:
    """`x0` `(n, d)` in the scene's dtype, with fixed coordinates at rest; the rest positions if it is None."""
    rest = scene.mesh.nodes
    if x0 is None:
        return rest
    x0 = placed(scene, x0, "x0")
    x = jnp.where(scene.fixed, rest, x0.astype(rest.dtype))
    if is_concrete(x0, rest):
        finite = np.isfinite(np.asarray(x0)).all(axis=1)
        if not finite.all():
            node = np.flatnonzero(~finite)[0]
            raise ValueError(f"x0: expected finite positions, got {np.asarray(x0)[node].tolist()} at node {node}")
        volume, element = _worst_element(unlock(scene), x)
        # Inside jit a jitted function returns a tracer even for concrete arguments.
        if is_concrete(volume) and not volume > 0:
            raise ValueError(
                f"x0: element {element} is inverted (J = {float(volume):.3g}); start from rest, or from a "
                f"state in which every J is positive"
            )
    return x


_worst_element = jax.jit(worst_element)
