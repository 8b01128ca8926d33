"""The derivative of the answer of `reach` with respect to the target, the bounds and the scene.

The search is not differentiated. Its answer `theta` is a stationary point of a Lagrangian `L` over the commands that no
bound holds. `L` has one multiplier, `price`, for each component of the measure (Nocedal and Wright 2006, section 12.3):

    reached      L = 1/2 |(theta - rest) / unit|^2 + price . (measure - target)
    unreachable  L = 1/2 |measure - target|^2

By the implicit function theorem `z = (theta, price)` changes by `H dz = -d(grad L)`, with `H` the Hessian of `L` in
`z`. Commands that a bound holds change with the bound. `L` contains the equilibrium, whose derivative is implicit too
(see `jaxbeam.solve.implicit`).

The derivative is NaN where it does not exist or the theorem does not apply: where the search did not converge, where
`H` is singular, and where a command lies at a bound that does not hold it, because it can move to one side only.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxbeam.core.derivative import custom_derivative
from jaxbeam.core.tree import pytree, unlock
from jaxbeam.linear.layout import Layout, LinearSolver, assemble
from jaxbeam.scene.evaluation import stencil_hessians
from jaxbeam.scene.scene import Scene, command, command_units, rest_commands
from jaxbeam.solve.equilibrium import differentiable
from jaxbeam.solve.implicit import attach_derivative
from jaxbeam.solve.newton import Newton
from jaxbeam.solve.solution import Solution
from jaxbeam.study.expansion import Measure
from jaxbeam.study.search import REST


@pytree
class Problem:
    """The data that all targets share.

    scene: under any commands.
    layout: of its stiffness.
    low: `(m,)` lower bounds of the commands.
    high: `(m,)` upper bounds.
    tolerance: `()` largest deviation from a target that counts as reached.
    """

    scene: Scene
    layout: Layout
    low: jax.Array
    high: jax.Array
    tolerance: jax.Array


class Answer(NamedTuple):
    """What a search found.

    theta: `(m,)` commands.
    x: `(n, 2)` their equilibrium.
    held: `(m,)` the bounds that hold, as in `Design`.
    reached: `()` whether the target is met.
    trusted: `()` whether the search converged and its solve has status `OK`.
    factor: of the stiffness at `x`, made by `move_answer`. It is replaced by a finite one if the answer is not trusted.
    """

    theta: jax.Array
    x: jax.Array
    held: jax.Array
    reached: jax.Array
    trusted: jax.Array
    factor: Any = None


def move_answer(
    measure: Measure, solver: Newton, problem: Problem, target: jax.Array, answer: Answer, solution: Solution
) -> tuple[jax.Array, Solution, jax.Array]:
    """Commands, solution and value of an answer, with their derivatives in the problem and the target attached."""
    # A command with equal bounds is always held, whether or not it would gain without them.
    held = jnp.where(problem.low == problem.high, 1, answer.held)
    still = lax.stop_gradient(unlock(command(problem.scene, answer.theta)))
    # XLA removes this factorisation if nothing is differentiated.
    storage = assemble(problem.layout, stencil_hessians(still, answer.x))
    factor, _ = solver.linear.factor(problem.layout, storage)
    # Replace the factor of a failed search by a finite one: zero times NaN would reach a loss that does not depend
    # on the answer.
    sane = jax.tree.map(lambda leaf: jnp.where(answer.trusted, leaf, 1), factor)
    answer = answer._replace(held=held, factor=sane)
    theta, _ = follow_optimum(measure, solver.linear, problem, jnp.ravel(target), answer)
    scene = command(problem.scene, theta)
    moved = differentiable(unlock(scene), problem.layout, solution, factor, solver)
    return theta, moved, measure(scene, moved.x)


@partial(custom_derivative, static=2)
def follow_optimum(
    measure: Measure, linear: LinearSolver, problem: Problem, target: jax.Array, answer: Answer
) -> tuple[jax.Array, jax.Array]:
    """`theta` `(m,)` of the answer and the multipliers `price` `(p,)`, with their derivatives attached.

    They are differentiable in the problem and in the target `(p,)`. Tangents of the answer are ignored.
    """
    slope = jax.jacrev(lambda theta: _outcome(measure, linear, problem, theta, answer))(answer.theta)
    unit = command_units(problem.scene, problem.low, problem.high)
    slope = jnp.where(answer.held == 0, slope * unit, 0)
    gram = slope @ slope.T
    gap = (rest_commands(problem.scene) - answer.theta) / unit
    price = jnp.linalg.pinv(gram, hermitian=True) @ (slope @ gap)
    return answer.theta, jnp.where(answer.reached & answer.trusted, price, 0)


def _outcome(measure: Measure, linear: LinearSolver, problem: Problem, theta: jax.Array, answer: Answer) -> jax.Array:
    """The measure `(p,)` at commands `theta`."""
    scene = command(problem.scene, theta)
    x = attach_derivative(linear, unlock(scene), problem.layout, answer.x, answer.factor, jnp.asarray(True))
    return jnp.ravel(measure(scene, x))


@follow_optimum.defjvp
def _follow_optimum_jvp(measure: Measure, linear: LinearSolver, primals: Any, tangents: Any) -> tuple[Any, Any]:
    problem, target, answer = primals
    problem_dot, target_dot, _ = tangents
    m, p = answer.theta.size, target.size
    theta, price = follow_optimum(measure, linear, *primals)
    # Keep the NaN of a failed search out of derivatives of a loss that does not depend on it.
    unit = command_units(problem.scene, problem.low, problem.high)
    goal = jnp.where(answer.trusted, target, 0)
    theta = jnp.where(answer.trusted, theta, answer.theta)
    price = jnp.where(answer.trusted, price, 0)
    at = jnp.concatenate([theta, price])
    held = jnp.append((answer.held != 0) & answer.trusted, jnp.zeros(p, bool))
    bound_dot = jnp.where(answer.held < 0, problem_dot.low, problem_dot.high)
    carried = jnp.where(held, jnp.append(bound_dot, jnp.zeros(p, theta.dtype)), 0)

    def lagrangian(problem: Problem, target: jax.Array, z: jax.Array) -> jax.Array:
        theta, price = z[:m], z[m:]
        miss = _outcome(measure, linear, problem, theta, answer) - target
        effort = 0.5 * jnp.sum(((rest_commands(problem.scene) - theta) / unit) ** 2) + price @ miss
        return jnp.where(answer.reached, effort, 0.5 * jnp.sum(miss**2) + 0.5 * jnp.sum(price**2))

    slope = jax.grad(lagrangian, argnums=2)

    def product(v: jax.Array) -> jax.Array:
        """The Hessian of the Lagrangian times `v`; the unit matrix in its place for commands that a bound holds."""
        moved = jax.jvp(partial(slope, problem, goal), (at,), (jnp.where(held, 0, v),))[1]
        return jnp.where(held, v, moved)

    hessian = lax.stop_gradient(jax.vmap(product)(jnp.eye(m + p, dtype=at.dtype)))
    scale = _scales(hessian, held, answer.reached, m)
    scaled = hessian * scale[:, None] * scale
    values, vectors = jnp.linalg.eigh(scaled)
    small = jnp.sqrt(jnp.finfo(at.dtype).eps)
    sound = jnp.min(jnp.abs(values)) > small * jnp.max(jnp.abs(values))
    # There is no derivative if a command lies at a bound that does not hold it and is coupled to another unknown.
    near = REST * unit
    weak = (answer.held == 0) & ((theta - problem.low <= near) | (problem.high - theta <= near))
    coupled = jnp.max(jnp.abs(scaled - jnp.diag(jnp.diagonal(scaled))), axis=1) > small
    sound &= ~jnp.any(weak & coupled[:m])

    def solve(_: Any, b: jax.Array) -> jax.Array:
        y = scale * (vectors @ ((vectors.T @ (scale * b)) / values))
        return jnp.where(answer.trusted & sound, y, jnp.where(jnp.all(b == 0), 0.0, jnp.nan).astype(b.dtype))

    pull = jax.jvp(slope, (problem, goal, at), (problem_dot, target_dot, carried))[1]
    # If the commands have no effect, the right-hand side does not contain the target. Add it for a failed search, so
    # that its derivative is NaN all the same.
    pull = pull.at[m:].add(jnp.where(answer.trusted, 0, target_dot))
    moved = lax.custom_linear_solve(product, -jnp.where(held, 0, pull), solve, symmetric=True) + carried
    return (theta, price), (moved[:m], moved[m:])


def _scales(hessian: jax.Array, held: jax.Array, reached: jax.Array, m: int) -> jax.Array:
    """Scale `(m + p,)` of each unknown. The Hessian times the scales of row and column has no unit, and entries near 1.

    Args:
        hessian: `(m + p, m + p)` of the Lagrangian.
        held: `(m + p,)` whether a bound holds the unknown.
        reached: `()` whether the target is met.
        m: number of commands.
    """
    norm = lambda rows: jnp.sqrt(jnp.sum(rows**2, axis=-1))
    inverse = lambda size: jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)
    curvature = jnp.max(jnp.abs(jnp.where(held[:m, None], 0, hessian[:m, :m])))
    commands = jnp.where(reached | held[:m], 1, inverse(jnp.sqrt(curvature)))
    return jnp.append(commands, jnp.where(reached, inverse(norm(hessian[m:, :m])), 1))
