"""The discretisation error of a measure, and refinement until the error is below a tolerance.

`estimate_error` judges a solution that is there already. `solve_to` finds the mesh for a tolerance. For many commands,
inside jit or for derivatives use `corrected`.

The solution of a scene is carried over to a finer mesh that contains it. There triangles of six nodes replace those of
three, and four triangles replace each one of six nodes. On the finer mesh the solution is not in balance. The
unbalanced forces `g`, weighted by the adjoint `z` of the measure `M`,

    K z = dM/dx,     M(finer) - M(coarse) = -z . g + ...,

estimate by how much the finer mesh changes the measure (the dual-weighted residual method: Becker and Rannacher, Acta
Numerica 10, 2001, 1-102). If the change is too large for the first order, the estimate is repeated after a Newton step.
The finer mesh has an error too, so the change is multiplied by `Element.shortfall`: the ratio of the true error to the
change, measured by `benchmarks/accuracy.py`. `jaxbeam.study.doubt` says where such a change bounds no error. The
constants of the bar were chosen on random beams and judged on others, see `benchmarks/error_bars.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import compiled, usual_rules
from jaxbeam.core.progress import Report, check_progress
from jaxbeam.core.tree import is_concrete, unlock
from jaxbeam.linear.layout import Layout, assemble, expand, gather
from jaxbeam.mesh.elements import element_of
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import Finer, enriched_elements, heirs
from jaxbeam.physics.energy import NotRefinable, Term
from jaxbeam.scene.evaluation import evaluate, smallest_jacobian, stencil_hessians
from jaxbeam.scene.scene import Scene, check_scene
from jaxbeam.solve.equilibrium import equilibrium
from jaxbeam.solve.newton import Newton, check_scene_and_solver, topology
from jaxbeam.solve.solution import Solution
from jaxbeam.study.doubt import (
    REASONS,
    SOFT,
    Doubt,
    Places,
    Softest,
    doubts,
    places_of,
    scene_doubt,
    softest,
    squashed,
    widening,
)

Measure = Callable[[Scene, jax.Array], jax.Array]


# Safety factor: the error bar over the estimated error.
SAFETY = 1.5
# Share of the parts of the estimate that cancel, added to the bar: parts of opposite sign need not shrink alike.
UNLIKE = 0.5
# The estimate is repeated, each time after a Newton step, until that step changes the measure by at most this share of
# the whole change, but not more than `MOST_STEPS` times.
SETTLED = 0.1
MOST_STEPS = 6
# Reuse the factor if the last step was below `SMALL` times the body and below `SHRINKING` times the one before.
SMALL = 0.01
SHRINKING = 0.3


class ErrorEstimate(NamedTuple):
    """What is known of the error of a measure, in the unit of the measure.

    value: the measure of the solution.
    discretisation: signed estimate of the error of the mesh: value + discretisation is a better value.
    algebraic: signed estimate of the error that the solver leaves.
    bar: bound of the error of `value`. It is infinite if the solution is not `OK`, if a term does not say what it
        becomes on a finer mesh, if that has no stable equilibrium near, or for a reason of `jaxbeam.study.doubt`: point
        loads and narrow anchors, measures of a place where strains are infinite, a surface that may crease.
    reason: why the bar is infinite; empty if it is finite.
    """

    value: float
    discretisation: float
    algebraic: float
    bar: float
    reason: str = ""


class Answer(NamedTuple):
    """The answer of `solve_to`.

    value: the measure on the last mesh.
    estimate: of its error.
    met: whether the error bar is within the tolerance.
    rung: how often the mesh was refined.
    scene: on the last mesh.
    solution: of that scene.
    reason: why the tolerance was not met; empty if it was.
    """

    value: float
    estimate: ErrorEstimate
    met: bool
    rung: int
    scene: Scene
    solution: Solution
    reason: str = ""


@usual_rules
def estimate_error(scene: Scene, solution: Solution, measure: Measure, solver: Newton = Newton()) -> ErrorEstimate:
    """The error of a measure of a solution, by the dual-weighted residual method on a finer mesh.

    It costs two to seven Newton steps on the finer mesh, which has about four times as many unknowns; while the steps
    are short they share one factor. Errors of the model (the material, plane strain, the width of the anchors) are not
    included.

    Args:
        scene: under its commands; concrete.
        solution: of that scene.
        measure: `(scene, x) -> ()`, such as `jb.tip_angle` or `lambda s, x: jb.tendon_tensions(s, x)[0]`.
        solver: its linear solver is used; the other settings only where the scene must be solved on the finer mesh.

    Raises:
        ValueError: if the scene is traced or has no triangles, or the measure returns anything but a scalar.
    """
    check_scene_and_solver(scene, solver)
    checks.instance("solution", solution, Solution, "give what equilibrium(scene) returned")
    checks.function("measure", measure, "(scene, x) -> scalar")
    return _estimate(scene, solution, measure, solver)[0]


@usual_rules
def solve_to(
    scene: Scene,
    measure: Measure,
    tolerance: float,
    most: int = 20_000,
    solver: Newton = Newton(),
    progress: bool | Callable[[int, float], None] | None = None,
) -> Answer:
    """Solve a scene, and refine its mesh until the error bar of a measure is within a tolerance.

    The solve on a finer mesh starts from the positions that the error estimate on the mesh before predicts, so that two
    or three Newton steps are left. Begin with a coarse mesh: refinement stops at the first mesh that suffices. Where it
    stops before, `Answer.reason` says why: the bar is infinite, the next mesh would be too large, or the tolerance is
    below the round-off of the value.

    Args:
        scene: under its commands; concrete.
        measure: as for `estimate_error`.
        tolerance: positive, in the unit of the measure.
        most: number of unknowns of the largest mesh to solve on.
        solver: settings of each solve.
        progress: `True` draws a line of progress on stderr, if that is a terminal. A function is called after each
            mesh, as `progress(meshes, bar)`, with the number of meshes so far and the error bar on the last one.

    Raises:
        ValueError: if the tolerance is not positive and finite, or as `estimate_error` does.
    """
    check_scene_and_solver(scene, solver)
    checks.function("measure", measure, "(scene, x) -> scalar")
    tolerance = checks.setting("tolerance", tolerance, checks.POSITIVE, "it is in the unit of the measure")
    checks.count("most", most, 1)
    check_progress(progress, "(meshes, bar)")
    rung, start = 0, None
    with Report(progress, "meshes") as report:
        while True:
            solution = equilibrium(scene, start, solver)
            estimate, finer, ahead = _estimate(scene, solution, measure, solver)
            report(rung + 1, f"error bar {estimate.bar:.2e}", call=(rung + 1, estimate.bar))
            met = estimate.bar <= tolerance
            reason = "" if met else _stop(estimate, tolerance, float(jnp.finfo(solution.x.dtype).eps), finer, most)
            if met or reason:
                return Answer(estimate.value, estimate, met, rung, scene, solution, reason)
            rung, scene, start = rung + 1, finer, ahead


def _stop(estimate: ErrorEstimate, tolerance: float, eps: float, finer: Scene, most: int) -> str:
    """Why the mesh is not refined although the bar is above the tolerance; empty if it is."""
    if not np.isfinite(estimate.bar):
        return estimate.reason
    if tolerance < (least := eps * abs(estimate.value)):
        return f"the tolerance {tolerance:.3g} is below the round-off of the value, {least:.3g}"
    if (count := np.count_nonzero(~finer.held)) > most:
        return f"the next mesh has {count} unknowns, more than the {most} of `most`"
    return ""


@usual_rules
def enriched(scene: Scene) -> tuple[Scene, Finer]:
    """The scene on a finer mesh, and the map of nodal fields to that mesh.

    The finer mesh can represent every displacement of the coarse one. Triangles of three nodes become triangles of six,
    and triangles of six nodes are cut in four. Nodes keep their numbers, so terms that act on nodes stay as they are.

    Differentiable in the parameters of the terms.

    Raises:
        NotRefinable: a `ValueError` that names a term which cannot be refined.
        ValueError: if the mesh or the width of an anchor is traced, or the mesh has no triangles.
    """
    check_scene(scene)
    if not is_concrete(scene.mesh.nodes):
        raise ValueError("scene: expected a mesh of known nodes, got traced ones; refine the mesh outside jit")
    elements, count = scene.mesh.elements, scene.mesh.nodes.shape[0]
    if scene.mesh.is_line:
        raise ValueError("scene: expected a mesh of triangles to refine, got a rod, whose error is that of its model")
    finer = enriched_elements(elements, count)
    mesh = Mesh(finer.carry(np.asarray(scene.mesh.nodes)), finer.elements)
    fixed = np.zeros(mesh.nodes.shape, bool)
    for coordinate, column in enumerate(scene.fixed.T):
        fixed[heirs(finer, mesh, np.flatnonzero(column)), coordinate] = True
    terms = tuple(_refined(k, term, mesh, finer) for k, term in enumerate(scene.terms))
    tip = heirs(finer, mesh, scene.tip)
    return Scene(mesh, terms, fixed, tip), finer


def _refined(number: int, term: Term, mesh: Mesh, finer: Finer) -> Term:
    """Term `number` of the scene on the finer mesh."""
    try:
        return term.kind.refined(term, mesh, finer)
    except NotRefinable as error:
        raise NotRefinable(f"terms[{number}] ({term.kind.name}) has no form on a finer mesh: {error}") from None


def _estimate(scene: Scene, solution: Solution, measure: Measure, solver: Newton) -> tuple[ErrorEstimate, Scene, Any]:
    """The estimate, the finer scene, and the positions at which its equilibrium is expected.

    Without a finer scene, the bar is infinite, and the given scene and positions are returned.
    """
    if not is_concrete(*jax.tree.leaves(scene)):
        raise ValueError("scene: expected concrete numbers, got traced ones; inside jit use corrected")
    if (shape := jax.eval_shape(measure, scene, solution.x).shape) != ():
        raise ValueError(f"measure: expected a function that returns a scalar, got shape {shape}")
    own = _change(scene, solution.x, measure, solver)
    value, algebraic = own.value, own.total
    try:
        finer, way = enriched(scene)
    except NotRefinable as error:
        return ErrorEstimate(value, np.nan, algebraic, np.inf, str(error)), scene, solution.x
    start = way.carry(np.asarray(solution.x))
    first = step = _change(finer, start, measure, solver, way)
    change, cancelled = step.total, min(step.parts[step.parts > 0].sum(), -step.parts[step.parts < 0].sum())
    near = SMALL * np.ptp(np.asarray(scene.mesh.nodes), axis=0).max()
    for _ in range(MOST_STEPS):
        if not abs(step.total) > SETTLED * abs(change):
            break
        factor = step.factor if step.length < near else None
        near, step = min(near, SHRINKING * step.length), _change(finer, step.x, measure, solver, factor=factor)
        # The value before the step differs from `value` too: a mean over the tip weighs other nodes on the finer mesh.
        change = step.value - value + step.total
    moved = step.x
    if not np.isfinite(change) and solution.status == 0:
        # Newton steps without a line search failed, so solve the finer scene.
        found = equilibrium(finer, start, solver)
        moved, change = np.asarray(found.x), float(measure(finer, found.x)) - value if found.status == 0 else np.nan
    left = change * element_of(scene.mesh.elements).shortfall
    reason = _doubt(scene, solution, change)
    if not reason:
        places = places_of(scene, finer)
        other = _value_and_slope(finer, squashed(places.finer_corners, finer, start), measure)[1]
        reason = _doubt_of_state(*_state(places, scene, solution.x, finer, moved, own.slope, first.slope, other))
    bar = np.inf if reason else widening(scene) * (SAFETY * abs(left) + UNLIKE * cancelled) + abs(algebraic)
    return ErrorEstimate(value, left, algebraic, bar, reason), finer, _usable(finer, moved, start)


def _usable(scene: Scene, moved: np.ndarray, carried: np.ndarray) -> np.ndarray:
    """Positions `(n, 2)` to start a solve from: after Newton steps, unless these inverted an element; else carried over
    from the coarser mesh, whose elements keep their `J`."""
    sound = np.isfinite(moved).all() and float(smallest_jacobian(scene, jnp.asarray(moved))) > 0
    return moved if sound else carried


def _doubt(scene: Scene, solution: Solution, change: float) -> str:
    """Why no error bound is known of any measure of a solution; empty if one is."""
    if solution.status != 0:
        return "the solution is not OK"
    if reason := scene_doubt(scene):
        return reason
    return "" if np.isfinite(change) else "the finer mesh has no stable equilibrium near"


def _doubt_of_state(flags: jax.Array, soft: Softest) -> str:
    """Why the change to the finer mesh bounds no error; empty if it does."""
    for flag in Doubt(int(flags)):
        return REASONS[flag]
    if not soft.share < SOFT:
        return ""
    place = ", ".join(f"{value:.3g}" for value in soft.place)
    return (
        f"the surface may crease: at ({place}) it is compressed to {float(soft.stretch):.2f} of its length and has "
        f"{max(float(soft.share), 0):.0%} of its stiffness left, and a finer mesh may give another answer"
    )


@jax.jit
def _state(
    places: Places,
    scene: Scene,
    x: jax.Array,
    finer: Scene,
    moved: jax.Array,
    slope: jax.Array,
    fine: jax.Array,
    other: jax.Array,
) -> tuple[jax.Array, Softest]:
    """Flags of what the measure reads (arguments as of `doubts`), and the softest piece of the surface at the positions
    `moved` `(N, 2)` of the finer mesh."""
    flags = doubts(places, scene, x, finer, slope, fine, other)
    return flags, softest(places.finer_corners, finer, moved)


class _Change(NamedTuple):
    """One Newton step from a state, and the change of a measure by it.

    value: the measure at the state.
    x: `(n, 2)` positions after the step.
    length: largest component of the step.
    total: change of the measure by the step, to first order.
    parts: `(n, 2)` contribution of the force and the adjoint at each coordinate to that change.
    slope: `(n, 2)` derivative of the measure in the positions.
    factor: of the stiffness that was used, and whether that is positive definite.
    """

    value: float
    x: np.ndarray
    length: float
    total: float
    parts: np.ndarray
    slope: np.ndarray
    factor: Any


def _change(
    scene: Scene, x: Any, measure: Measure, solver: Newton, way: Finer | None = None, factor: Any = None
) -> _Change:
    """The change of a measure by one Newton step from `x`.

    Args:
        scene: of the state.
        x: `(n, 2)` positions.
        measure: `(scene, x) -> ()`.
        solver: its linear solver is used.
        way: the map from the coarser mesh, if `x` was carried over from one. Then the interpolation of the adjoint on
            that mesh is subtracted from the adjoint. The forces do no work on it, and what is left is local.
        factor: of the stiffness at a nearby state; by default the stiffness at `x` is factorised.
    """
    value, slope = _value_and_slope(scene, x, measure)
    layout = solver.linear.layout(topology(scene))
    factor = _factor(unlock(scene), layout, x, solver) if factor is None else factor
    found = _newton_step(unlock(scene), layout, factor, x, slope, solver)
    slope, step, adjoint, forces = (np.asarray(each) for each in (slope, *found))
    local = adjoint if way is None else adjoint - way.carry(adjoint)
    length, total = float(np.abs(step).max()), float(np.sum(slope * step))
    return _Change(float(value), x + step, length, total, -local * forces, slope, factor)


@compiled("solver")
def _factor(scene: Scene, layout: Layout, x: jax.Array, solver: Newton) -> tuple[Any, jax.Array]:
    """A factor of the stiffness at `x`, and whether the stiffness is positive definite."""
    return solver.linear.factor(layout, assemble(layout, stencil_hessians(scene, x)))


@compiled("solver")
def _newton_step(
    scene: Scene, layout: Layout, factor: tuple[Any, jax.Array], x: jax.Array, slope: jax.Array, solver: Newton
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The Newton step, the adjoint of a measure with derivative `slope`, and the unbalanced forces, each `(n, 2)`.

    The step is NaN if the stiffness is not positive definite.
    """
    forces = jnp.where(scene.held, 0, evaluate(scene, x).gradient)
    sides = jnp.stack([gather(layout, -forces), gather(layout, slope)], axis=1)
    step, adjoint = (expand(layout, side, x.shape) for side in solver.linear.solve(layout, factor[0], sides).T)
    return jnp.where(factor[1], step, jnp.nan), adjoint, forces


@partial(jax.jit, static_argnames="measure")
def _value_and_slope(scene: Scene, x: jax.Array, measure: Measure) -> tuple[jax.Array, jax.Array]:
    """The measure `()` at `x`, and its derivative `(n, 2)` in `x`."""
    return jax.value_and_grad(lambda x: measure(scene, x))(x)
