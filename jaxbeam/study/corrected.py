"""Measures with error bars, from equilibria on two meshes (`jaxbeam.study.two_meshes`).

Let `c` and `f` be the measure on the coarse and on the finer mesh, and `s` the shortfall of the coarse element: the
ratio of its error to the change `f - c`. Then

    value = f + (s - 1) (f - c)

is better than `f`, as in Richardson's extrapolation. The bar comes from the parts of the change. With the adjoint `z`
of the measure on the finer mesh, its interpolation `z_c` on the coarse mesh, and the gradient `g` of the energy at the
coarse positions, carried over,

    f - c = -(z - z_c) . g + ...

The terms of this scalar product are contributions of single coordinates (the dual-weighted residual method: Becker and
Rannacher, Acta Numerica 10, 2001, 1-102). Many cancel in the change, but need not shrink alike on finer meshes. So the
bar is a share, `Element.spread`, of the sum of their magnitudes.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core import checks
from jaxbeam.core.compiling import compiled, compute_if, usual_rules, zeros_like_result
from jaxbeam.core.tree import Numbers, is_concrete, replace, to_device, unlock
from jaxbeam.linear.layout import Layout, LinearSolver, assemble, expand, gather
from jaxbeam.mesh.elements import element_of
from jaxbeam.scene.evaluation import energy, evaluate, smallest_jacobian, stencil_hessians
from jaxbeam.scene.rigid import check_held
from jaxbeam.scene.scene import Scene, check_commands, checked_commands, command, extent
from jaxbeam.solve.implicit import attach_derivative
from jaxbeam.solve.newton import Newton, check_scene_and_solver, topology
from jaxbeam.solve.solution import Solution
from jaxbeam.solve.sweep import partition, sweep
from jaxbeam.study.two_meshes import States, TwoMeshes, solve_both

Measure = Callable[[Scene, jax.Array], jax.Array]

# Number of neighbouring commands in a block of a sweep. Their bars may share a factor of the finer stiffness if no node
# lies farther from its place in the state of the factor than this share of the body.
BLOCK = 64
NEAR = 0.02


class Corrected(NamedTuple):
    """A measure of an equilibrium, with its error bar. For `B` commands each entry has a leading axis `B`.

    value: `(...)` the best value: the one on the finer mesh with the estimate of its error taken off.
    bar: `(...)` bound of the error of `value`; infinite if the solution is not `OK`, or no bound is known.
    coarse: `(...)` the measure on the coarse mesh.
    fine: `(...)` the measure on the finer mesh.
    algebraic: `(...)` by how much the last step changed it, which bounds what the solver leaves; part of `bar`.
    steps: `(2,)` Newton steps on the coarse and on the finer mesh.
    solution: on the finer mesh; its `status` has the flags of both meshes.
    """

    value: jax.Array
    bar: jax.Array
    coarse: jax.Array
    fine: jax.Array
    algebraic: jax.Array
    steps: jax.Array
    solution: Solution


@usual_rules
def corrected(meshes: TwoMeshes, ratios: Numbers, measure: Measure, solver: Newton = Newton()) -> Corrected:
    """A measure of the equilibrium under commands, with an error bar, by a solve on two meshes.

    It costs a solve on the coarse mesh and two or three Newton steps on the finer one. `value`, `coarse`, `fine` and
    `solution.x` are differentiable in the commands and in all floats of `meshes`, as a solution of `equilibrium` is.

    Many commands are solved by a `sweep` on each mesh, on all cores. Inside jit they are solved one after the other.

    Args:
        meshes: from `two_meshes`.
        ratios: `(m,)` commands, or `(B, m)`, a row for each of `B` answers.
        measure: `(scene, x)` to `()` or `(p,)`, such as `jb.tip_angle`. It is called on both meshes.
        solver: settings of the solves. Its `rtol` is used only where it is larger than those of this method.

    Raises:
        ValueError: if the commands have another shape or are out of range, or as `equilibrium` does.
    """
    checks.instance("meshes", meshes, TwoMeshes, "make it with two_meshes(scene)")
    check_scene_and_solver(meshes.coarse, solver)
    checks.function("measure", measure, "(scene, x) -> scalar or (p,)")
    check_held(meshes.coarse)
    values = checks.shaped("ratios", ratios, None)
    if values.ndim not in (1, 2) or not all(values.shape[:-1]):
        raise ValueError(f"ratios: expected shape (m,), or (B, m) with a row for each command, got {values.shape}")
    checked_commands("ratios", meshes.coarse, values if values.ndim == 1 else values[0])
    check_commands("ratios", meshes.coarse, values)
    rows = to_device(values, meshes.coarse.mesh.nodes.dtype)
    layout_of = lambda scene: solver.linear.layout(topology(scene))
    layouts = layout_of(meshes.coarse), layout_of(meshes.fine)
    if is_concrete(rows, *jax.tree.leaves(meshes)):
        if rows.ndim == 2:
            return _in_blocks(meshes, layouts, np.asarray(rows), measure, solver)
        states = solve_both(unlock(meshes), layouts, rows, solver)
        return _values(meshes, layouts, rows, states, measure, solver.linear)

    def one(row: jax.Array) -> Corrected:
        still, fixed_layouts, at = lax.stop_gradient((meshes, layouts, row))
        states = solve_both(unlock(still), fixed_layouts, at, solver)
        return _moving_values(meshes, layouts, row, states, measure, solver.linear)

    return lax.map(one, rows) if rows.ndim == 2 else one(rows)


# ------------------------------------------------------------------------------------------------ one command


def _corrected(
    meshes: TwoMeshes,
    layouts: tuple[Layout, Layout],
    ratios: jax.Array,
    states: States,
    measure: Measure,
    linear: LinearSolver,
) -> Corrected:
    """The result, from the states on both meshes; differentiable in `meshes` and `ratios`."""
    meshes = meshes.commanded(ratios)
    element, good = element_of(meshes.coarse.mesh.elements), states.fine.status == 0
    x = attach_derivative(linear, meshes.fine, layouts[1], states.fine.x, None, good)
    at_coarse = attach_derivative(linear, meshes.coarse, layouts[0], states.coarse.x, None, good)
    fine, coarse = measure(meshes.fine, x), measure(meshes.coarse, at_coarse)
    gross, algebraic = lax.stop_gradient(_parts(lax.stop_gradient(meshes), layouts[1], states, measure, linear))
    bar = jnp.where(good & (not meshes.doubt), element.spread * gross + algebraic, jnp.inf).reshape(fine.shape)
    return Corrected(
        value=fine + (element.shortfall - 1) * (fine - coarse),
        bar=bar.astype(fine.dtype),
        coarse=coarse,
        fine=fine,
        algebraic=algebraic.reshape(fine.shape),
        steps=jnp.stack([states.coarse.steps, states.fine.steps]),
        solution=replace(
            states.fine, x=x, energy=energy(meshes.fine, x), smallest_jacobian=smallest_jacobian(meshes.fine, x)
        ),
    )


_values = compiled("measure", "linear")(_corrected)
_moving_values = jax.jit(_corrected, static_argnames=("measure", "linear"))


def _parts(
    meshes: TwoMeshes, layout: Layout, states: States, measure: Measure, linear: LinearSolver
) -> tuple[jax.Array, jax.Array]:
    """Of each of `p` measures: the sum of the magnitudes of the parts of its change, and the change by the last step.

    Both are `(p,)`.
    """
    scene, x = meshes.fine, states.fine.x
    slopes = jnp.moveaxis(jax.jacrev(lambda x: jnp.ravel(measure(scene, x)))(x), 0, -1)
    columns = partial(jax.vmap, in_axes=-1, out_axes=-1)
    solved = linear.solve(layout, states.factor, columns(partial(gather, layout))(slopes))
    adjoint = columns(lambda v: expand(layout, v, x.shape))(solved)
    local = adjoint - columns(meshes.carry)(adjoint[: meshes.coarse.mesh.nodes.shape[0]])
    unbalanced = jnp.where(scene.held, 0, evaluate(scene, states.start).gradient)
    gross = jnp.sum(jnp.abs(local * unbalanced[..., None]), axis=(0, 1))
    return gross, jnp.abs(jnp.tensordot(states.step, slopes, 2))


# ------------------------------------------------------------------------------------------------ many commands


@compiled("measure", "linear")
def _block(
    meshes: TwoMeshes,
    layouts: tuple[Layout, Layout],
    rows: jax.Array,
    coarse: Solution,
    fine: Solution,
    measure: Measure,
    linear: LinearSolver,
) -> Corrected:
    """The results for a block of commands `rows` `(C, m)`, whose solutions on both meshes are known.

    A factor serves the adjoints of all states within `NEAR` of its own. They enter the bars alone.
    """
    size = extent(meshes.fine)

    def factorise(row: jax.Array, x: jax.Array) -> Any:
        hessians = stencil_hessians(command(meshes.fine, row), x)
        return linear.factor(layouts[1], assemble(layouts[1], hessians))[0], x

    def one(carry: Any, known: tuple[jax.Array, Solution, Solution]) -> tuple[Any, Corrected]:
        row, coarse, fine = known
        far = ~(jnp.max(jnp.abs(fine.x - carry[1])) <= NEAR * size)
        factor, at = compute_if(far, factorise, carry, row, fine.x)
        both = replace(fine, status=fine.status | coarse.status)
        states = States(coarse, both, meshes.carry(coarse.x), jnp.zeros_like(fine.x), factor)
        return (factor, at), _corrected(meshes, layouts, row, states, measure, linear)

    factor, x = zeros_like_result(factorise, rows[0], fine.x[0])
    return lax.scan(one, (factor, jnp.full_like(x, jnp.inf)), (rows, coarse, fine))[1]


def _in_blocks(
    meshes: TwoMeshes, layouts: tuple[Layout, Layout], rows: np.ndarray, measure: Measure, solver: Newton
) -> Corrected:
    """The results for commands `rows` `(B, m)`: a sweep on each mesh, then the bars in blocks of neighbours."""
    solutions = [jax.device_get(sweep(scene, rows, solver)) for scene in (meshes.coarse, meshes.fine)]
    parts = partition(rows, np.arange(len(rows)), BLOCK)

    def solve(part: np.ndarray) -> Corrected:
        padded = np.resize(part, BLOCK)
        known = jax.tree.map(lambda leaf: leaf[padded], solutions)
        found = _block(meshes, layouts, rows[padded], *known, measure, solver.linear)
        return jax.device_get(jax.tree.map(lambda leaf: leaf[: len(part)], found))

    # The first block compiles the program; otherwise each thread would compile it.
    results = [solve(parts[0])]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        results += pool.map(solve, parts[1:])
    order = np.argsort(np.concatenate(parts))
    return jax.tree.map(lambda *leaves: to_device(np.concatenate(leaves)[order]), *results)
