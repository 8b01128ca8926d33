"""How wrong an answer is: the error that the mesh leaves in a measure, and an answer as exact as is asked for.

The solution of a scene is carried over to a finer mesh that contains it (triangles of six nodes in the place of three;
four triangles in the place of one that has six). There it is not in balance. The forces `g` that are left, weighted by
the adjoint `z` of the measure `M`,

    K z = dM/dx,     M(finer) - M(coarse) = -z . g + ...,

tell what the finer mesh would change (the dual-weighted residual method: Becker and Rannacher, Acta Numerica 10, 2001,
1-102). Where that is so much that the first order does not do, it is repeated from where it leads. The finer mesh is
not the continuum either, so the change is scaled up by what is left after it; by how much is measured
(`benchmarks/accuracy.py`).
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
from jaxbeam.core.tree import is_concrete, unlock
from jaxbeam.linear.layout import Layout, assemble, expand, gather
from jaxbeam.mesh.elements import element_of
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import Finer, enriched_elements
from jaxbeam.mesh.surface import surface
from jaxbeam.physics.energy import NotRefinable, Term
from jaxbeam.scene.scene import Scene, check_scene, evaluate, stencil_hessians
from jaxbeam.solve.equilibrium import equilibrium
from jaxbeam.solve.newton import Newton, check_scene_and_solver, topology
from jaxbeam.solve.solution import Solution

Measure = Callable[[Scene, jax.Array], jax.Array]


# What the estimate is multiplied by to bound the error.
SAFETY = 1.5


# Share added of what cancels: parts of the error that have opposite signs do not shrink alike.
UNLIKE = 0.25


# The estimate is repeated from where it leads until it changes by less than this share of it.
SETTLED = 0.1


MOST_STEPS = 6


# A factor serves the next step too after one under this share of the body, and by so much shorter than the one before.
SMALL = 0.01


SHRINKING = 0.3


class ErrorEstimate(NamedTuple):
    """What is known of the error of a measure.

    value: the measure of the solution. discretisation: estimate of what the mesh leaves, signed: value + discretisation
    is a better value. algebraic: estimate of what the solver leaves. bar: bound of the error of the value; infinite if
    there is nothing to be said: the solution is not `OK`, the answer has no limit as the mesh is refined, or a term
    does not say what it is on a finer mesh. reason: why that is, or empty.
    """

    value: float
    discretisation: float
    algebraic: float
    bar: float
    reason: str = ""


class Answer(NamedTuple):
    """The answer of `solve_to`: the value with its error estimate, and the scene and solution it was measured on.

    rung: how often the mesh was made finer. met: whether the bar is under the tolerance.
    """

    value: float
    estimate: ErrorEstimate
    met: bool
    rung: int
    scene: Scene
    solution: Solution


@usual_rules
def estimate_error(scene: Scene, solution: Solution, measure: Measure, solver: Newton = Newton()) -> ErrorEstimate:
    """The error of a measure of a solution, by the dual-weighted residual method on a finer mesh.

    It costs one to three Newton steps on the finer mesh, of about four times as many unknowns. Errors of the model (the
    material, plane strain, the width of the anchors) are no part of it.

    Args:
        scene: a concrete one, with its command.
        solution: of it.
        measure: `(scene, x) -> ()`, such as `jb.tip_angle` or `lambda s, x: jb.tendon_tensions(s, x)[0]`.
        solver: its linear solver is used.

    Raises:
        ValueError: if the scene is traced or has no triangles, or the measure returns anything but a scalar.
    """
    check_scene_and_solver(scene, solver)
    checks.instance("solution", solution, Solution, "give what equilibrium(scene) returned")
    checks.function("measure", measure, "(scene, x) -> scalar")
    return _estimate(scene, solution, measure, solver)[0]


@usual_rules
def solve_to(scene: Scene, measure: Measure, tolerance: float, most: int = 20_000, solver: Newton = Newton()) -> Answer:
    """A measure to a tolerance: from the scene's own mesh to finer ones, until the error bar is below it.

    Each mesh starts from what the error estimate of the one before says about it, so that two or three Newton steps are
    left to take. Begin with a coarse mesh: rungs that suffice are never refined. A tolerance below the round-off of the
    value is not met on any mesh, and none is refined for it.

    Args:
        scene: a concrete one, with its command.
        measure: as for `estimate_error`.
        tolerance: positive, in the unit of the measure.
        most: unknowns of the largest mesh to solve on.
        solver: settings.

    Raises:
        ValueError: if the tolerance is not positive and finite, or as `estimate_error` does.
    """
    check_scene_and_solver(scene, solver)
    checks.function("measure", measure, "(scene, x) -> scalar")
    tolerance = checks.setting("tolerance", tolerance, checks.POSITIVE, "it is in the unit of the measure")
    checks.count("most", most, 1)
    rung, start = 0, None
    while True:
        solution = equilibrium(scene, start, solver)
        estimate, finer, ahead = _estimate(scene, solution, measure, solver)
        met = estimate.bar <= tolerance
        stuck = bool(solution.status != 0) or not np.isfinite(estimate.bar)
        hopeless = tolerance < float(jnp.finfo(solution.x.dtype).eps) * abs(estimate.value)
        if met or stuck or hopeless or not np.count_nonzero(~finer.fixed) <= most:
            return Answer(estimate.value, estimate, met, rung, scene, solution)
        rung, scene, start = rung + 1, finer, ahead


@usual_rules
def enriched(scene: Scene) -> tuple[Scene, Finer]:
    """The scene on a finer mesh that contains every displacement of its own, and how nodal fields are carried over.

    Triangles of three nodes become triangles of six, and triangles of six nodes are cut in four. Nodes keep their
    numbers, so that terms that act on nodes stay as they are.

    Raises:
        NotRefinable: a `ValueError` that names a term which cannot be refined.
        ValueError: if the scene is traced or its mesh has no triangles.
    """
    check_scene(scene)
    if not is_concrete(*jax.tree.leaves(scene)):
        raise ValueError("scene: expected concrete numbers to refine a mesh of, got traced ones; call outside jit")
    elements, count = scene.mesh.elements, scene.mesh.nodes.shape[0]
    if scene.mesh.radian is not None:
        raise ValueError("scene: expected a mesh of triangles to refine, got a rod, whose error is that of its model")
    finer = enriched_elements(elements, count)
    mesh = Mesh(finer.carry(np.asarray(scene.mesh.nodes)), finer.elements)
    used = finer.weights != 0
    # A new node is fixed, or of the tip, if it lies on the surface between nodes that are.
    outside = np.isin(np.arange(len(used)), surface(mesh))
    inherit = lambda nodes: np.all(np.asarray(nodes)[finer.nodes] | ~used, axis=1)
    new = np.arange(len(used)) >= count
    may = outside | ~new
    fixed = np.stack([inherit(column) & may for column in scene.fixed.T], axis=1)
    tip = np.append(scene.tip, np.flatnonzero(inherit(np.isin(np.arange(count), scene.tip)) & outside & new))
    terms = tuple(_refined(k, term, mesh, len(finer.elements) // len(elements)) for k, term in enumerate(scene.terms))
    return Scene(mesh, terms, fixed, tip), finer


def _refined(number: int, term: Term, mesh: Mesh, parts: int) -> Term:
    """A term on the finer mesh, where each element has become `parts`."""
    try:
        return term.kind.refined(term, mesh, parts)
    except NotRefinable as error:
        raise NotRefinable(f"terms[{number}] ({term.kind.name}) has no form on a finer mesh: {error}") from None


def _estimate(scene: Scene, solution: Solution, measure: Measure, solver: Newton) -> tuple[ErrorEstimate, Scene, Any]:
    """The estimate, the finer scene, and where its own solution is expected."""
    if (shape := jax.eval_shape(measure, scene, solution.x).shape) != ():
        raise ValueError(f"measure: expected a function that returns a scalar, got shape {shape}")
    own = _change(scene, solution.x, measure, solver)
    value, algebraic = own.value, own.total
    try:
        finer, way = enriched(scene)
    except NotRefinable as error:
        return ErrorEstimate(value, np.nan, algebraic, np.inf, str(error)), scene, solution.x
    start = way.carry(np.asarray(solution.x))
    step = _change(finer, start, measure, solver, way)
    change, cancelled = step.total, min(step.parts[step.parts > 0].sum(), -step.parts[step.parts < 0].sum())
    near = SMALL * np.ptp(np.asarray(scene.mesh.nodes), axis=0).max()
    for _ in range(MOST_STEPS):
        if not abs(step.total) > SETTLED * abs(change):
            break
        factor = step.factor if step.length < near else None
        near, step = min(near, SHRINKING * step.length), _change(finer, step.x, measure, solver, factor=factor)
        # A measure such as the mean over the tip may weigh nodes differently on another mesh.
        change = step.value - value + step.total
    moved = step.x
    if not np.isfinite(change):
        # Too far for bare steps: it takes a solve.
        found = equilibrium(finer, start, solver)
        moved, change = np.asarray(found.x), float(measure(finer, found.x)) - value if found.status == 0 else np.nan
    left = change * element_of(scene.mesh.elements).shortfall
    reason = _doubt(scene, solution, change)
    bar = np.inf if reason else SAFETY * abs(left) + UNLIKE * cancelled + abs(algebraic)
    return ErrorEstimate(value, left, algebraic, bar, reason), finer, moved


def _doubt(scene: Scene, solution: Solution, change: float) -> str:
    """Why nothing can be said about the error, or nothing."""
    if solution.status != 0:
        return "the solution is not OK"
    free = np.logical_not(scene.fixed.all(axis=1))
    for term in scene.terms:
        if reason := term.kind.without_limit(term, free):
            return reason
    return "" if np.isfinite(change) else "the finer mesh has no stable equilibrium near"


class _Change(NamedTuple):
    """The value of a measure at a state; where one Newton step from there leads, `x`, and its length; by how much that
    changes the measure, to first order; and of that, what each coordinate's force and adjoint contribute, `parts`
    `(n, 2)`. `factor` is that of the stiffness that was used."""

    value: float
    x: np.ndarray
    length: float
    total: float
    parts: np.ndarray
    factor: Any


def _change(
    scene: Scene, x: Any, measure: Measure, solver: Newton, way: Finer | None = None, factor: Any = None
) -> _Change:
    """What a Newton step from `x` would change, by its own stiffness unless the factor of one near is given.

    If the state was carried over from a coarser mesh, the adjoint is taken less its own interpolation on that: the
    forces do no work on that, and what is left is local.
    """
    value, slope = _value_and_slope(scene, x, measure)
    layout = solver.linear.layout(topology(scene))
    factor = _factor(unlock(scene), layout, x, solver) if factor is None else factor
    found = _newton_step(unlock(scene), layout, factor, x, slope, solver)
    slope, step, adjoint, forces = (np.asarray(each) for each in (slope, *found))
    local = adjoint if way is None else adjoint - way.carry(adjoint)
    return _Change(
        float(value), x + step, float(np.abs(step).max()), float(np.sum(slope * step)), -local * forces, factor
    )


@compiled("solver")
def _factor(scene: Scene, layout: Layout, x: jax.Array, solver: Newton) -> tuple[Any, jax.Array]:
    """A factor of the stiffness, and whether that is positive definite."""
    return solver.linear.factor(layout, assemble(layout, stencil_hessians(scene, x)))


@compiled("solver")
def _newton_step(
    scene: Scene, layout: Layout, factor: tuple[Any, jax.Array], x: jax.Array, slope: jax.Array, solver: Newton
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The step to balance, the adjoint of a measure of this slope, and the unbalanced forces, `(n, 2)` each; NaN where
    the stiffness is not positive definite."""
    forces = jnp.where(scene.fixed, 0, evaluate(scene, x).gradient)
    sides = jnp.stack([gather(layout, -forces), gather(layout, slope)], axis=1)
    step, adjoint = (expand(layout, side, x.shape) for side in solver.linear.solve(layout, factor[0], sides).T)
    return jnp.where(factor[1], step, jnp.nan), adjoint, forces


@partial(jax.jit, static_argnames="measure")
def _value_and_slope(scene: Scene, x: jax.Array, measure: Measure) -> tuple[jax.Array, jax.Array]:
    return jax.value_and_grad(lambda x: measure(scene, x))(x)
