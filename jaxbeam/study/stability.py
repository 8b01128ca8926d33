"""Stability: the lowest modes of the tangent stiffness.

An equilibrium is stable if every eigenvalue of the tangent stiffness, over the free coordinates, is positive.
The stiffness is that of the nodes, so an eigenvalue (force / length) depends on the mesh; its sign does not,
nor does the command at which it is zero.

`status` says already whether a solution is stable. Use `lowest_mode` to see how near it is to a snap and in which shape
it would go, and `trace_branch` to find the command at which it does.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules, zeros_like_result
from jaxbeam.core.derivative import custom_derivative
from jaxbeam.core.tree import Numbers, is_concrete, pytree, replace, unlock
from jaxbeam.linear.layout import Layout, LinearSolver, assemble, expand
from jaxbeam.scene.evaluation import stencil_hessians
from jaxbeam.scene.scene import Scene, placed
from jaxbeam.solve.implicit import energy_gradient
from jaxbeam.solve.newton import Newton, check_scene_and_solver, topology

# Subspace iteration: number of vectors beyond the wanted ones, and largest number of iterations.
GUARD = 4
MAX_TURNS = 300
# Eigenvalues closer to each other than this many times their round-off do not count as simple: their derivative is NaN.
SEPARATE = 100.0


@pytree
class Modes:
    """The lowest modes of a state.

    values: `(count,)` eigenvalues, ascending (force / length).
    shapes: `(count, n, 2)` nodal displacements of unit Euclidean norm, zero where fixed. The component of largest
        magnitude is positive.
    negative: `()` number of negative eigenvalues of the whole stiffness.
    """

    values: jax.Array
    shapes: jax.Array
    negative: jax.Array


@usual_rules
def lowest_mode(scene: Scene, x: Numbers, count: int = 1, solver: Newton = Newton()) -> Modes:
    """The lowest eigenvalues of the tangent stiffness at `x`, and their shapes.

    Args:
        scene: under its commands.
        x: `(n, 2)` node positions, an equilibrium or not.
        count: number of modes.
        solver: its linear solver is used.

    Returns:
        `Modes`. If `x` is an equilibrium and the first eigenvalue is negative, it is unstable.

    `values` are differentiable once in every float of the scene and in `x`, forward and reverse. The derivative is NaN
    where an eigenvalue is not simple up to round-off. Second derivatives and those of `shapes` are NaN.

    Raises:
        ValueError: if `count` is not between 1 and the number of free coordinates, or `x` has another shape.
    """
    check_scene_and_solver(scene, solver)
    checks.count("count", count, 1, int(np.sum(~scene.held)), "the free coordinates")
    x = placed(scene, x)
    layout = solver.linear.layout(topology(scene))
    x = x.astype(scene.mesh.nodes.dtype)
    open_scene = unlock(scene)
    modes, simple = _lowest_mode(*lax.stop_gradient((open_scene, layout, x)), int(count), solver.linear)
    if is_concrete(x, *jax.tree.leaves(scene)):
        return modes
    values, shapes = _moving_modes(open_scene, x, modes.values, modes.shapes, simple)
    return replace(modes, values=values, shapes=shapes)


@partial(jax.jit, static_argnames=("count", "linear"))
def _lowest_mode(
    scene: Scene, layout: Layout, x: jax.Array, count: int, linear: LinearSolver
) -> tuple[Modes, jax.Array]:
    """The modes, and which of their eigenvalues `(count,)` are simple."""
    storage = assemble(layout, stencil_hessians(scene, x))
    values, vectors, simple = lowest_pairs(layout, storage, count, linear)
    peak = jnp.take_along_axis(vectors, jnp.argmax(jnp.abs(vectors), axis=0)[None], axis=0)
    shapes = jax.vmap(lambda v: expand(layout, v, x.shape), in_axes=1)(vectors * jnp.sign(peak))
    return Modes(values, shapes, linear.factor_indefinite(layout, storage)[1]), simple


@custom_derivative
def _follow_modes(
    scene: Scene, x: jax.Array, values: jax.Array, shapes: jax.Array, simple: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """`values` and `shapes`, with derivatives in the scene and in `x` attached. Their own tangents are ignored."""
    return values, shapes


@_follow_modes.defjvp
def _follow_modes_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """With a unit eigenvector `v` of a simple eigenvalue, `d lambda = v . dK v`.

    `dv` would take a solve with a singular matrix. It is set to NaN, and so the second derivative of `lambda` is NaN.
    """
    scene, x, _, _, simple = primals
    values, shapes = _follow_modes(*primals)

    def moved(shape: jax.Array, simple: jax.Array) -> tuple[jax.Array, jax.Array]:
        product = lambda scene, x: jax.jvp(partial(energy_gradient, scene), (x,), (shape,))[1]
        change = jnp.where(scene.held, 0, jax.jvp(product, (scene, x), tangents[:2])[1])
        return jnp.sum(shape * _unless(simple, change)), _unless(jnp.asarray(False), change)

    return (values, shapes), jax.vmap(moved)(shapes, simple)


def _unless(good: jax.Array, change: jax.Array) -> jax.Array:
    """`change` if it is good or zero, else NaN; linear in it, so that a cotangent of zero stays zero."""

    def solve(_: Any, b: jax.Array) -> jax.Array:
        return jnp.where(good | jnp.all(b == 0), b, jnp.nan)

    return lax.custom_linear_solve(lambda v: v, change, solve, symmetric=True)


_moving_modes = jax.jit(_follow_modes)


def lowest_pairs(layout: Layout, storage: jax.Array, count: int, linear: LinearSolver) -> tuple[jax.Array, ...]:
    """Lowest eigenpairs of an assembled matrix, by inverse subspace iteration (Bathe 1973).

    It uses the Cholesky factor of the matrix, shifted by just enough to make it positive definite, and ends when the
    eigenvalues no longer change.

    Returns:
        Eigenvalues `(count,)`, unit eigenvectors `(N, count)`, and which eigenvalues are simple, `(count,)`: those that
        differ from every other one of the iteration by more than round-off.
    """
    stiffness = jnp.max(jnp.abs(storage[layout.diagonal]))
    eps = jnp.finfo(storage.dtype).eps

    def grow(carry: Any) -> Any:
        tries, _, _, _ = carry
        # Try no shift first, then shifts a quarter of a decade apart, from far below any stiffness that matters.
        shift = jnp.where(tries > 0, stiffness * eps * 10.0 ** (1 + tries / 4), 0).astype(storage.dtype)
        factor, done = linear.factor(layout, storage.at[layout.diagonal].add(shift))
        return tries + 1, shift, factor, done

    no_factor = zeros_like_result(linear.factor, layout, storage)[0]
    start = (jnp.zeros((), jnp.int32), jnp.zeros((), storage.dtype), no_factor, jnp.asarray(False))
    _, shift, factor, _ = lax.while_loop(lambda c: ~c[3] & (c[0] < 80), grow, start)
    solve = jax.vmap(lambda column: linear.solve(layout, factor, column), in_axes=1, out_axes=1)
    unknown = (layout.slots < layout.position.size)[:, None]

    def turn(carry: Any) -> Any:
        turns, old, _, vectors = carry
        basis, _ = jnp.linalg.qr(vectors)
        image = jnp.where(unknown, solve(basis), 0)
        inverse, rotation = jnp.linalg.eigh(0.5 * (basis.T @ image + image.T @ basis))
        values = 1 / inverse[::-1] - shift
        moved = jnp.max(jnp.abs(values - old)[:count])
        return turns + 1, values, moved, (image @ rotation)[:, ::-1]

    width = min(count + GUARD, layout.slots.size)
    vectors = jnp.where(unknown, jax.random.normal(jax.random.key(0), (layout.slots.size, width), storage.dtype), 0)
    begin = (jnp.zeros((), jnp.int32), jnp.zeros(width, storage.dtype), jnp.asarray(jnp.inf, storage.dtype), vectors)
    # The round-off of the factor's entries is eps * stiffness. A value below it cannot be told from zero.
    round_off = lambda values: eps * (100 * jnp.abs(values[0]) + stiffness)
    going = lambda c: (c[0] < MAX_TURNS) & ~(c[2] <= round_off(c[1]))
    _, values, _, vectors = lax.while_loop(going, turn, begin)
    gaps = jnp.abs(values[:, None] - values) + jnp.diag(jnp.full(width, jnp.inf, values.dtype))
    simple = jnp.min(gaps, axis=1) > SEPARATE * round_off(values)
    vectors = vectors[:, :count]
    return values[:count], vectors / jnp.linalg.norm(vectors, axis=0), simple[:count]
