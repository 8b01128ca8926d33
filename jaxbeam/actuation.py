"""Actuation: a command approached step by step (`ramp`), and many commands at once (`sweep`)."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam._tree import Numbers, is_concrete, replace, unlock
from jaxbeam.equilibrium import Solution, _equilibrium, differentiable, follow
from jaxbeam.held import check_held
from jaxbeam.linear import Layout
from jaxbeam.newton import Newton, topology
from jaxbeam.scene import Scene, command


def commands(ratios: Numbers, steps: int = 28) -> jax.Array:
    """The commands `(steps, m)` of a ramp: evenly spaced from ratio 1 to `ratios` `(m,)`.

    Raises:
        ValueError: if `steps` is not a whole number of at least 2.

    >>> [float(r) for r in commands([0.5], steps=3)[:, 0]]
    [1.0, 0.75, 0.5]
    """
    if not isinstance(steps, int | np.integer) or steps < 2:
        raise ValueError(f"steps: expected a whole number of at least 2, got {steps!r}")
    end = jnp.asarray(ratios)
    end = end if end.dtype.kind == "f" else end.astype(float)
    way = jnp.linspace(0.0, 1.0, steps, dtype=end.dtype)[:, None]
    # Weighted, not 1 + way * (end - 1), so that the last command is `ratios` to the last bit.
    return (1 - way) + way * end


def ramp(scene: Scene, ratios: Numbers, steps: int = 28, solver: Newton = Newton()) -> Solution:
    """Equilibria on the way from ratio 1 to `ratios`, each started from the one before.

    What a beam does when its tendons are pulled slowly: where an equilibrium depends on the path, this is
    the one a user sees. Each start is moved along the tangent of the branch (one back-substitution with
    the factor at hand).

    Args:
        scene: with `m` tendons.
        ratios: `(m,)` at the end, positive.
        steps: how many commands to solve, `commands(ratios, steps)`: the first at ratio 1; at least 2.
        solver: settings of each solve.

    Returns:
        A `Solution` with leading axis `steps`; each step has its own status.

    Raises:
        ValueError: as `command` and `equilibrium` do, or if `steps` is not a whole number of at least 2.
    """
    check_held(scene)
    command(scene, ratios)  # checks the ratios
    way = commands(jnp.asarray(ratios, scene.mesh.nodes.dtype), steps)
    end = way[-1]
    layout, open_scene = solver.linear.layout(topology(scene)), unlock(scene)
    path = _ramp(*lax.stop_gradient((open_scene, layout, end)), steps, solver)
    if is_concrete(end, *jax.tree.leaves(scene)):
        return path
    return _differentiable_rows(open_scene, layout, way, path, solver)


@partial(jax.jit, static_argnames=("steps", "solver"))
def _ramp(scene: Scene, layout: Layout, end: jax.Array, steps: int, solver: Newton) -> Solution:
    targets = jnp.linspace(0.0, 1.0, steps, dtype=end.dtype)
    return follow(lambda s: command(scene, (1 - s) + s * end), layout, scene.mesh.nodes, targets, solver)[0]


def sweep(scene: Scene, ratios: Numbers, solver: Newton = Newton()) -> Solution:
    """The equilibrium of each of many commands, each solved from rest.

    Args:
        scene: with `m` tendons.
        ratios: `(B, m)`, positive.
        solver: settings of each solve.

    Returns:
        A `Solution` with leading axis `B`.

    Raises:
        ValueError: if the shape is wrong, a concrete ratio is not positive and finite, or as `equilibrium` does.
    """
    shape = np.shape(ratios)
    if len(shape) != 2 or shape[0] == 0:
        raise ValueError(f"ratios: expected shape (B, m), a row for each command, got {shape}")
    if is_concrete(ratios):
        array = np.asarray(ratios, float)
        bad = np.flatnonzero(~(np.isfinite(array) & (array > 0)).all(axis=1))
        if bad.size:
            raise ValueError(f"ratios: expected positive finite numbers, got {array[bad[0]].tolist()} in row {bad[0]}")
    check_held(scene)
    jax.eval_shape(command, scene, jax.ShapeDtypeStruct(shape[1:], scene.mesh.nodes.dtype))  # checks the count
    rows = jnp.asarray(ratios, scene.mesh.nodes.dtype)
    layout, open_scene = solver.linear.layout(topology(scene)), unlock(scene)
    batch = _sweep(*lax.stop_gradient((open_scene, layout, rows)), solver)
    if is_concrete(rows, *jax.tree.leaves(scene)):
        return batch
    return _differentiable_rows(open_scene, layout, rows, batch, solver)


@partial(jax.jit, static_argnames="solver")
def _sweep(scene: Scene, layout: Layout, rows: jax.Array, solver: Newton) -> Solution:
    return lax.map(lambda ratios: _equilibrium(command(scene, ratios), layout, scene.mesh.nodes, solver)[0], rows)


@jax.custom_jvp
def _sane(ratios: jax.Array, good: jax.Array) -> jax.Array:
    """The command of a good row; ratio 1 in place of a bad one, which may be 0 or NaN. Derivatives pass through.

    What nobody looks at has cotangent zero; times the slope of a bad command that would still be NaN, and spread
    from one row to the parameters that all rows share.
    """
    return jnp.where(good, ratios, 1)


@_sane.defjvp
def _sane_jvp(primals: tuple[jax.Array, ...], tangents: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
    return _sane(*primals), tangents[0]


@partial(jax.jit, static_argnames="solver")
def _differentiable_rows(scene: Scene, layout: Layout, rows: jax.Array, found: Solution, solver: Newton) -> Solution:
    """Solutions `(B, ...)` of the commands `rows` `(B, m)` as functions of these and of the scene.

    Factors are not kept, they would outgrow any memory: one is made anew for each row that is differentiated.
    """

    @jax.checkpoint
    def one(row_and_solution: tuple[jax.Array, Solution]) -> Solution:
        ratios, solution = row_and_solution
        good = solution.status == 0
        moved = differentiable(command(scene, _sane(ratios, good)), layout, solution, None, solver)
        return replace(moved, ratios=ratios, energy=jnp.where(good, moved.energy, solution.energy))

    return lax.map(one, (rows, found))
