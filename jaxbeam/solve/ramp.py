"""Ramps: a command is approached from rest in even steps.

Use a ramp for what happens on the way, and where the state depends on the path. Steps that are too long are cut. More
of them give smoother curves, and cost about one Newton step each.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core import checks
from jaxbeam.core.compiling import compiled, usual_rules
from jaxbeam.core.tree import Numbers, is_concrete, to_device, unlock
from jaxbeam.linear.layout import Layout
from jaxbeam.scene.rigid import check_held
from jaxbeam.scene.scene import Scene, checked_commands, command, rest_commands
from jaxbeam.solve.continuation import follow
from jaxbeam.solve.equilibrium import differentiable_rows
from jaxbeam.solve.newton import Newton, check_scene_and_solver, topology
from jaxbeam.solve.predictor import start_trail
from jaxbeam.solve.solution import Solution, outlined


@usual_rules
def commands(ratios: Numbers, steps: int = 28, start: Numbers | None = None) -> jax.Array:
    """The commands `(steps, m)` of a ramp: evenly spaced from `start` to `ratios` `(m,)`.

    Args:
        ratios: `(m,)` the last command.
        steps: number of commands, at least 2.
        start: `()` or `(m,)` the first command; by default ratio 1, at which tendons are at rest.

    Raises:
        ValueError: if `steps` is not a whole number of at least 2, or a concrete ratio is not positive and finite (not
            finite, if a start is given).

    >>> [float(r) for r in commands([0.5], steps=3)[:, 0]]
    [1.0, 0.75, 0.5]
    """
    checks.count("steps", steps, 2)
    end = checks.numbers("ratios", ratios, checks.POSITIVE if start is None else checks.FINITE)
    if end.ndim != 1:
        raise ValueError(f"ratios: expected shape (m,), one for each tendon, got {end.shape}")
    end = end if end.dtype.kind == "f" else end.astype(jnp.result_type(float))
    first = np.ones((), end.dtype) if start is None else checks.numbers("start", start, shapes=((), end.shape))
    way = np.linspace(0.0, 1.0, steps).astype(end.dtype)[:, None]
    # A weighted sum instead of start + way * (end - start), so that the last command is `ratios` to the last bit.
    return to_device((1 - way) * first.astype(end.dtype) + way * end)


@usual_rules
def ramp(scene: Scene, ratios: Numbers, steps: int = 28, solver: Newton = Newton()) -> Solution:
    """Equilibria on the way from rest to the command `ratios`, each started from the one before.

    This is what a beam does when its tendons are pulled slowly: where a command has several equilibria, a ramp finds
    the one that is reached on this path. Each start is predicted from the states before it and their tangents.

    The stability of the last state is decided by the stiffness at that state. For an intermediate state, the stiffness
    where its last Newton step began may decide, if that step was shorter than a millionth of the body.

    Args:
        scene: with `m` tendons.
        ratios: `(m,)` commands at the end, positive.
        steps: number of commands to solve, at least 2: evenly spaced as by `commands`, the first at rest.
        solver: settings of each solve.

    Returns:
        A `Solution` with leading axis `steps`; each step has its own status.

    Raises:
        ValueError: as `command` and `equilibrium` do, or if `steps` is not a whole number of at least 2.
    """
    check_scene_and_solver(scene, solver)
    checks.count("steps", steps, 2)
    check_held(scene)
    end = to_device(checked_commands("ratios", scene, ratios), scene.mesh.nodes.dtype)
    layout, open_scene = solver.linear.layout(topology(scene)), unlock(scene)
    if is_concrete(end, *jax.tree.leaves(scene)):
        return outlined(_ramp(open_scene, layout, end, steps, solver), scene.mesh)
    path = _ramp(*lax.stop_gradient((open_scene, layout, end)), steps, solver)
    rows = commands(end, steps, rest_commands(scene))
    return outlined(differentiable_rows(open_scene, layout, rows, path, solver), scene.mesh)


@compiled("steps", "solver")
def _ramp(scene: Scene, layout: Layout, end: jax.Array, steps: int, solver: Newton) -> Solution:
    """The solutions, with leading axis `steps`, on the way from rest to the commands `end` `(m,)`."""
    targets = jnp.linspace(0.0, 1.0, steps, dtype=end.dtype)
    rest = rest_commands(scene)
    return follow(
        lambda s: command(scene, (1 - s) * rest + s * end), layout, start_trail(scene.mesh.nodes), targets, solver
    )[0]
