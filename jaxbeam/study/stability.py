"""Stability: the lowest modes of the tangent stiffness.

An equilibrium is stable if every eigenvalue of the tangent stiffness, over the free coordinates, is positive.
The stiffness is that of the nodes, so an eigenvalue (force / length) depends on the mesh; its sign does not,
nor does the command at which it is zero.
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
from jaxbeam.scene.scene import Scene, placed, stencil_hessians
from jaxbeam.solve.implicit import energy_gradient
from jaxbeam.solve.newton import Newton, check_scene_and_solver, topology

# Subspace iteration: extra vectors beside the wanted ones, and the most turns it may take.
GUARD = 4


MAX_TURNS = 300


# Eigenvalues nearer to each other than this many times their round-off have no derivative that can be told.
SEPARATE = 100.0


@pytree
class Modes:
    """The lowest modes of a state. `values`: `(count,)` eigenvalues, ascending (force / length). `shapes`:
    `(count, n, 2)` nodal displacements of unit Euclidean norm, zero where fixed; the largest component is positive.
    `negative`: `()` how many eigenvalues of the whole stiffness are negative."""

    values: jax.Array
    shapes: jax.Array
    negative: jax.Array


@usual_rules
def lowest_mode(scene: Scene, x: Numbers, count: int = 1, solver: Newton = Newton()) -> Modes:
    """The lowest eigenvalues of the tangent stiffness at `x`, and their shapes.

    Args:
        scene: with its command.
        x: `(n, 2)` node positions, an equilibrium or not.
        count: how many modes.
        solver: its linear solver is used.

    Returns:
        `Modes`. A first eigenvalue that is negative means that an equilibrium `x` is unstable.

    `values` are differentiable in every float of the scene and in `x`, forward and reverse, once. The derivative is NaN
    where an eigenvalue is not simple, to round-off. So are second derivatives and those of `shapes`.

    Raises:
        ValueError: if `count` is not between 1 and the number of free coordinates, or `x` has another shape.
    """
    check_scene_and_solver(scene, solver)
    checks.count("count", count, 1, int(np.sum(~scene.fixed)), "the free coordinates")
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
    """`values` and `shapes` themselves, which move with the scene and with `x`. Their own tangents are ignored."""
    return values, shapes


@_follow_modes.defjvp
def _follow_modes_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """With a unit eigenvector `v` of a simple eigenvalue, `d lambda = v . dK v`.

    `dv` would take a solve with a singular matrix; it is NaN, and with it the second derivative of `lambda`.
    """
    scene, x, _, _, simple = primals
    values, shapes = _follow_modes(*primals)

    def moved(shape: jax.Array, simple: jax.Array) -> tuple[jax.Array, jax.Array]:
        product = lambda scene, x: jax.jvp(partial(energy_gradient, scene), (x,), (shape,))[1]
        change = jnp.where(scene.fixed, 0, jax.jvp(product, (scene, x), tangents[:2])[1])
        return jnp.sum(shape * _unless(simple, change)), _unless(jnp.asarray(False), change)

    return (values, shapes), jax.vmap(moved)(shapes, simple)


def _unless(good: jax.Array, change: jax.Array) -> jax.Array:
    """A change, linearly; NaN unless it is good or zero. A cotangent of zero stays zero."""

    def solve(_: Any, b: jax.Array) -> jax.Array:
        return jnp.where(good | jnp.all(b == 0), b, jnp.nan)

    return lax.custom_linear_solve(lambda v: v, change, solve, symmetric=True)


_moving_modes = jax.jit(_follow_modes)


def lowest_pairs(layout: Layout, storage: jax.Array, count: int, linear: LinearSolver) -> tuple[jax.Array, ...]:
    """Lowest eigenvalues `(count,)` and unit eigenvectors `(N, count)` of an assembled matrix, and which eigenvalues
    `(count,)` are simple: no other one that was iterated is as near as round-off.

    Inverse subspace iteration (Bathe 1973) on the Cholesky factor, of the matrix shifted by as little as makes
    it positive definite, until the eigenvalues stand still.
    """
    stiffness = jnp.max(jnp.abs(storage[layout.diagonal]))
    eps = jnp.finfo(storage.dtype).eps

    def grow(carry: Any) -> Any:
        tries, _, _, _ = carry
        # Quarter decades from far below any stiffness that matters.
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
    # Round-off of the factor's entries is eps * stiffness; nothing below it can be told from zero.
    round_off = lambda values: eps * (100 * jnp.abs(values[0]) + stiffness)
    going = lambda c: (c[0] < MAX_TURNS) & ~(c[2] <= round_off(c[1]))
    _, values, _, vectors = lax.while_loop(going, turn, begin)
    gaps = jnp.abs(values[:, None] - values) + jnp.diag(jnp.full(width, jnp.inf, values.dtype))
    simple = jnp.min(gaps, axis=1) > SEPARATE * round_off(values)
    vectors = vectors[:, :count]
    return values[:count], vectors / jnp.linalg.norm(vectors, axis=0), simple[:count]
