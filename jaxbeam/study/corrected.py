"""Measures with error bars, from equilibria on two meshes (`jaxbeam.study.two_meshes`).

Use `corrected` where many answers need a bar, inside jit, or with derivatives; its value is better than that of either
mesh. `estimate_error` judges a solution that is there already, and `solve_to` finds the mesh for a tolerance.

Let `c` and `f` be the measure on the coarse and on the finer mesh. The change `f - c` consists of parts. With the
adjoint `z` of the measure on the finer mesh, its interpolation `z_c` on the coarse mesh, and the gradient `g` of the
energy at the coarse positions, carried over,

    f - c = -(z - z_c) . g + ...

where each coordinate contributes a term (the dual-weighted residual method: Becker and Rannacher, Acta Numerica 10,
2001, 1-102). Let `s` be the sum of those in the elements at corners where strains are infinite. On each finer mesh that
part is a fixed share of the one before, as the exponent of the corner tells: with six-node triangles `2^-1.24` at the
clamped corner of a beam of Poisson's ratio 0.44 (Williams 1952, J. Appl. Mech. 19, 526-528). The rest shrinks faster.
So the value is extrapolated with two gains (`Element.gains`), as in Richardson's method:

    value = f + gain_corner s + gain_rest (f - c - s)

Parts of different elements may cancel in the change, but need not shrink alike. So the bar is a share,
`Element.spread`, of the sum of the magnitudes of the parts of each coarse element, and of what the change has beyond
the parts.
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
from jaxbeam.core.progress import Progress, Report, check_progress
from jaxbeam.core.tree import Numbers, is_concrete, namespace, replace, unlock
from jaxbeam.linear.layout import Layout, LinearSolver, assemble, expand, gather
from jaxbeam.mesh.elements import element_of
from jaxbeam.scene.evaluation import energy, smallest_jacobian, stencil_hessians
from jaxbeam.scene.rigid import check_held
from jaxbeam.scene.scene import Scene, check_commands, checked_commands, command, extent
from jaxbeam.solve.implicit import attach_derivative, energy_gradient
from jaxbeam.solve.newton import Newton, check_scene_and_solver, topology
from jaxbeam.solve.solution import Solution, outlined
from jaxbeam.solve.sweep import assembled, partition, sweep
from jaxbeam.study.doubt import SOFT, Doubt, doubts, softest, squashed
from jaxbeam.study.two_meshes import States, TwoMeshes, solve_both

Measure = Callable[[Scene, jax.Array], jax.Array]

# Number of neighbouring commands in a block of a sweep. Their adjoints may share a factor of the finer stiffness if no
# node lies farther from its place in the state of the factor than this share of the body.
BLOCK = 64
NEAR = 0.01


class Corrected(NamedTuple):
    """A measure of an equilibrium, with its error bar. For `B` commands each entry has a leading axis `B`.

    value: `(...)` the best value: the one on the finer mesh with the estimate of its error taken off.
    bar: `(...)` bound of the error of `value`; infinite if the solution is not `OK`, or no bound is known.
    doubt: `(...)` int32 of or-ed `Doubt` flags: why no bound is known; 0 is `NONE`.
    coarse: `(...)` the measure on the coarse mesh.
    fine: `(...)` the measure on the finer mesh.
    algebraic: `(...)` by how much the last step changed it, which bounds what the solver leaves; part of `bar`.
    steps: `(2,)` Newton steps on the coarse and on the finer mesh.
    solution: on the finer mesh; its `status` has the flags of both meshes. Residual and correction are those before the
        last steps, which reuse a factor.
    """

    value: jax.Array
    bar: jax.Array
    doubt: jax.Array
    coarse: jax.Array
    fine: jax.Array
    algebraic: jax.Array
    steps: jax.Array
    solution: Solution


@usual_rules
def corrected(
    meshes: TwoMeshes,
    ratios: Numbers,
    measure: Measure,
    solver: Newton = Newton(),
    progress: bool | Callable[[int, int], None] | None = None,
) -> Corrected:
    """A measure of the equilibrium under commands, with an error bar, by a solve on two meshes.

    It costs a solve on the coarse mesh and two or three Newton steps on the finer one. `value`, `coarse`, `fine` and
    `solution.x` are differentiable in the commands and in all floats of `meshes`, as a solution of `equilibrium` is.

    Many commands are solved by a `sweep` on each mesh, on all cores. Inside jit they are solved one after the other.

    Args:
        meshes: from `two_meshes`.
        ratios: `(m,)` commands, or `(B, m)`, a row for each of `B` answers.
        measure: `(scene, x)` to `()` or `(p,)`, such as `jb.tip_angle`. It is called on both meshes.
        solver: settings of the solves. Its `rtol` is used only where it is larger than those of this method.
        progress: `True` draws a line of progress on stderr, if that is a terminal. A function is called after each
            chunk, as `progress(done, all)`. It counts each of many commands three times: its solves on both meshes and
            its bar. With a single command and inside jit there is no progress.

    Raises:
        ValueError: if the commands have another shape or are out of range, or as `equilibrium` does.
    """
    checks.instance("meshes", meshes, TwoMeshes, "make it with two_meshes(scene)")
    check_scene_and_solver(meshes.coarse, solver)
    checks.function("measure", measure, "(scene, x) -> scalar or (p,)")
    check_progress(progress, "(done, all)")
    check_held(meshes.coarse)
    values = checks.shaped("ratios", ratios, None)
    if values.ndim not in (1, 2) or not all(values.shape[:-1]):
        raise ValueError(f"ratios: expected shape (m,), or (B, m) with a row for each command, got {values.shape}")
    checked_commands("ratios", meshes.coarse, values if values.ndim == 1 else values[0])
    check_commands("ratios", meshes.coarse, values)
    rows = namespace(values).asarray(values, meshes.coarse.mesh.nodes.dtype)
    layout_of = lambda scene: solver.linear.layout(topology(scene))
    layouts = layout_of(meshes.coarse), layout_of(meshes.fine)
    if is_concrete(rows, *jax.tree.leaves(meshes)):
        if rows.ndim == 2:
            return _outlined(_in_blocks(meshes, layouts, rows, measure, solver, progress), meshes)
        states = solve_both(unlock(meshes), layouts, rows, solver)
        return _outlined(_values(meshes, layouts, rows, states, measure, solver.linear), meshes)

    def one(row: jax.Array) -> Corrected:
        still, fixed_layouts, at = lax.stop_gradient((meshes, layouts, row))
        states = solve_both(unlock(still), fixed_layouts, at, solver)
        # The derivative of the adjoint needs the factor at the state itself.
        return _moving_values(meshes, layouts, row, states._replace(factor=None), measure, solver.linear)

    return _outlined(lax.map(one, rows) if rows.ndim == 2 else one(rows), meshes)


def _outlined(found: Corrected, meshes: TwoMeshes) -> Corrected:
    return found._replace(solution=outlined(found.solution, meshes.fine.mesh))


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
    good, element, places = states.fine.status == 0, element_of(meshes.coarse.mesh.elements), meshes.places
    x = attach_derivative(linear, meshes.fine, layouts[1], states.fine.x, None, good)
    at_coarse = attach_derivative(linear, meshes.coarse, layouts[0], states.coarse.x, None, good)
    fine, coarse = measure(meshes.fine, x), measure(meshes.coarse, at_coarse)
    start, slopes = meshes.carry(at_coarse), _slopes(meshes.fine, x, measure)
    parts = _parts(meshes, layouts[1], x, start, states.factor, slopes, linear)
    whole, corner = (jnp.sum(each, axis=0).reshape(fine.shape) for each in (parts, parts[places.beside]))
    change = fine - coarse
    # Of a measure that is stationary at equilibrium, such as the energy, all of the change is beyond first order.
    gross = jnp.sum(jnp.abs(meshes.by_element(parts)), axis=0).reshape(fine.shape) + jnp.abs(change - whole)
    still, at, there, begin, slopes = lax.stop_gradient((meshes, at_coarse, x, start, slopes))
    doubt = _doubts(still, at, there, begin, slopes, measure).reshape(fine.shape)
    algebraic = jnp.abs(jnp.tensordot(slopes, states.step, 2)).reshape(fine.shape)
    bar = meshes.widening * element.spread * lax.stop_gradient(gross) + algebraic
    return Corrected(
        value=fine + element.gains[0] * corner + element.gains[1] * (change - corner),
        bar=jnp.where(good & (doubt == 0), bar, jnp.inf).astype(fine.dtype),
        doubt=doubt,
        coarse=coarse,
        fine=fine,
        algebraic=algebraic,
        steps=jnp.stack([states.coarse.steps, states.fine.steps]),
        solution=replace(
            states.fine, x=x, energy=energy(meshes.fine, x), smallest_jacobian=smallest_jacobian(meshes.fine, x)
        ),
    )


_values = compiled("measure", "linear")(_corrected)
_moving_values = jax.jit(_corrected, static_argnames=("measure", "linear"))


def _slopes(scene: Scene, x: jax.Array, measure: Measure) -> jax.Array:
    """Derivative `(p, n, d)` of each of `p` measures in the positions."""
    return jax.jacrev(lambda x: jnp.ravel(measure(scene, x)))(x)


def _parts(
    meshes: TwoMeshes,
    layout: Layout,
    x: jax.Array,
    start: jax.Array,
    factor: Any,
    slopes: jax.Array,
    linear: LinearSolver,
) -> jax.Array:
    """The parts `(n, p)` of the change of `p` measures at the nodes of the finer mesh; differentiable.

    Args:
        meshes: under the commands.
        layout: of the stiffness on the finer mesh.
        x: `(n, d)` positions on the finer mesh.
        start: `(n, d)` the coarse positions, carried over.
        factor: of the stiffness near `x`; None: it is made at `x`.
        slopes: `(p, n, d)` derivatives of the measures at `x`.
        linear: the linear solver.
    """
    scene, count = meshes.fine, meshes.coarse.mesh.nodes.shape[0]
    if factor is None:
        hessians = stencil_hessians(*lax.stop_gradient((scene, x)))
        factor, _ = linear.factor(layout, assemble(layout, hessians))
    factor = lax.stop_gradient(factor)

    def product(v: jax.Array) -> jax.Array:
        """The stiffness times a vector of unknowns `(N,)`."""
        return gather(layout, jax.jvp(partial(energy_gradient, scene), (x,), (expand(layout, v, x.shape),))[1])

    def part(slope: jax.Array) -> jax.Array:
        rhs = gather(layout, slope)
        solved = lax.custom_linear_solve(product, rhs, lambda _, b: linear.solve(layout, factor, b), symmetric=True)
        adjoint = expand(layout, solved, x.shape)
        return -jnp.sum((adjoint - meshes.carry(adjoint[:count])) * unbalanced, axis=1)

    unbalanced = jnp.where(scene.held, 0, energy_gradient(scene, start))
    return jnp.stack([part(slope) for slope in slopes], axis=1)


def _doubts(
    meshes: TwoMeshes, at_coarse: jax.Array, x: jax.Array, start: jax.Array, slopes: jax.Array, measure: Measure
) -> jax.Array:
    """Flags `(p,)` of the doubts about each measure, whose derivatives on the finer mesh are `slopes` `(p, n, d)`."""
    scene, places = meshes.fine, meshes.places
    others = _slopes(scene, squashed(places.finer_corners, scene, start), measure)
    reads = jax.vmap(partial(doubts, places, meshes.coarse, at_coarse, scene))
    flags = reads(_slopes(meshes.coarse, at_coarse, measure), slopes, others) | int(Doubt.SCENE if meshes.doubt else 0)
    soft = softest(places.finer_corners, scene, x).share < SOFT
    return flags | jnp.where(soft, int(Doubt.CREASE), 0).astype(flags.dtype)


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

    A factor serves the adjoints of all states within `NEAR` of its own. They enter the bars, and of the values the
    small correction at corners.
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
    meshes: TwoMeshes,
    layouts: tuple[Layout, Layout],
    rows: np.ndarray,
    measure: Measure,
    solver: Newton,
    progress: Progress,
) -> Corrected:
    """The results for commands `rows` `(B, m)`: a sweep on each mesh, then the bars in blocks of neighbours."""
    count, stages = len(rows), ("coarse mesh", "finer mesh", "error bars")
    parts = partition(rows, np.arange(count), BLOCK)

    def tell(stage: int, done: int, total: int) -> None:
        # A sweep counts the commands of this process, the blocks are those of all.
        done = stage * count + count * done // total
        report(done, stages[stage], call=(done, len(stages) * count))

    def solve(part: np.ndarray) -> Corrected:
        padded = np.resize(part, BLOCK)
        known = jax.tree.map(lambda leaf: leaf[padded], solutions)
        return jax.device_get(_block(meshes, layouts, rows[padded], *known, measure, solver.linear))

    with Report(progress, "solves and bars", len(stages) * count) as report:
        both = enumerate((meshes.coarse, meshes.fine))
        solutions = [jax.device_get(sweep(scene, rows, solver, partial(tell, stage))) for stage, scene in both]
        # The first block compiles the program; otherwise each thread would compile it.
        results = [solve(parts[0])]
        tell(2, len(parts[0]), count)
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            for found in pool.map(solve, parts[1:]):
                results.append(found)
                tell(2, sum(map(len, parts[: len(results)])), count)
    return assembled(parts, results)
