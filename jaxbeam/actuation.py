"""Actuation: a command approached step by step (`ramp`), and many commands at once (`sweep`)."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam._tree import Numbers, is_concrete, unlock
from jaxbeam.equilibrium import Newton, Solution, newton, report, topology
from jaxbeam.linear import Layout, expand, gather
from jaxbeam.scene import Scene, command, evaluate, largest_step


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
        ValueError: as `command` does, or if `steps` is not a whole number of at least 2.
    """
    command(scene, ratios)  # checks the ratios
    way = commands(jnp.asarray(ratios, scene.mesh.nodes.dtype), steps)
    layout = solver.linear.layout(topology(scene))
    return _ramp(unlock(scene), layout, scene.mesh.nodes, way, solver)


@partial(jax.jit, static_argnames="solver")
def _ramp(scene: Scene, layout: Layout, x: jax.Array, way: jax.Array, solver: Newton) -> Solution:
    storage = jax.ShapeDtypeStruct(layout.empty.shape, x.dtype)
    factor, _ = jax.eval_shape(solver.linear.factor, layout, storage)
    factor = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), factor)

    def advance(carry: Any, ratios: jax.Array) -> Any:
        x, factor, usable = carry
        scene_now = command(scene, ratios)
        state = newton(scene_now, layout, predict(scene_now, layout, x, factor, usable, solver), solver)
        solution = report(scene_now, state, solver)
        return (state.x, state.factor, solution.status == 0), solution

    return lax.scan(advance, (x, factor, jnp.asarray(False)), way)[1]


def predict(scene: Scene, layout: Layout, x: jax.Array, factor: Any, usable: jax.Array, solver: Newton) -> jax.Array:
    """Start for a new command, from the equilibrium `x` of the last one and the factor of its Hessian.

    The forces that the new command leaves unbalanced at `x` are its force increment, so this is the
    tangent predictor with the increment taken exactly. Shortened where an element would invert.
    """
    step = expand(layout, -solver.linear.solve(layout, factor, gather(layout, evaluate(scene, x).gradient)), x.shape)
    length = jnp.minimum(1.0, largest_step(scene, x, step, solver.keep_volume)).astype(x.dtype)
    usable = usable & jnp.all(jnp.isfinite(step))
    return jnp.where(usable, x + length * step, x)


def sweep(scene: Scene, ratios: Numbers, solver: Newton = Newton()) -> Solution:
    """The equilibrium of each of many commands, each solved from rest.

    Args:
        scene: with `m` tendons.
        ratios: `(B, m)`, positive.
        solver: settings of each solve.

    Returns:
        A `Solution` with leading axis `B`.

    Raises:
        ValueError: if the shape is wrong, or a concrete ratio is not positive and finite.
    """
    shape = np.shape(ratios)
    if len(shape) != 2 or shape[0] == 0:
        raise ValueError(f"ratios: expected shape (B, m), a row for each command, got {shape}")
    if is_concrete(ratios):
        array = np.asarray(ratios, float)
        bad = np.flatnonzero(~(np.isfinite(array) & (array > 0)).all(axis=1))
        if bad.size:
            raise ValueError(f"ratios: expected positive finite numbers, got {array[bad[0]].tolist()} in row {bad[0]}")
    jax.eval_shape(command, scene, jax.ShapeDtypeStruct(shape[1:], scene.mesh.nodes.dtype))  # checks the count
    rows = jnp.asarray(ratios, scene.mesh.nodes.dtype)
    return _sweep(unlock(scene), solver.linear.layout(topology(scene)), rows, solver)


@partial(jax.jit, static_argnames="solver")
def _sweep(scene: Scene, layout: Layout, rows: jax.Array, solver: Newton) -> Solution:
    def solve(ratios: jax.Array) -> Solution:
        scene_now = command(scene, ratios)
        return report(scene_now, newton(scene_now, layout, scene.mesh.nodes, solver), solver)

    return lax.map(solve, rows)
