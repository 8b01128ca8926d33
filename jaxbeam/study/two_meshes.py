"""Equilibria on two meshes: most of the way on a coarse mesh, the last steps on a finer one that contains it.

Make `two_meshes(scene)` once, and give it to `corrected` for each command or for many.

The solution of the coarse mesh is carried over to the finer mesh. From there Newton's method takes one to three steps
where a solve from rest takes ten. Then follow *short steps* with the last factor, which cost a fifth of a Newton step,
until they are small beside the change from the coarse mesh to the finer one, which estimates the error of the mesh.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core.compiling import compiled, usual_rules
from jaxbeam.core.tree import index_field, pytree, replace, static_field
from jaxbeam.linear.layout import Layout, expand, gather
from jaxbeam.scene.evaluation import evaluate, smallest_jacobian
from jaxbeam.scene.scene import Scene, at_places, command
from jaxbeam.solve.actuation import from_rest
from jaxbeam.solve.equilibrium import solve_from
from jaxbeam.solve.newton import Newton
from jaxbeam.solve.solution import Solution, Status
from jaxbeam.study.accuracy import enriched
from jaxbeam.study.doubt import Places, places_of, scene_doubt, widening

# Relative residuals at which the solves on the coarse and on the finer mesh end, unless the solver asks for a larger
# one.
COARSE = 1e-6
FINE = 0.05
# Short steps end when one moves no node by more than this share of the largest change since the coarse mesh, or by
# round-off. After `MOST_STEPS` the state counts as not converged.
SETTLED = 1e-3
ROUND_OFF = 16.0
MOST_STEPS = 20


@pytree
class TwoMeshes:
    """A scene on its own mesh and on a finer one; made by `two_meshes`.

    coarse: the scene.
    fine: the same scene on the finer mesh.
    nodes: `(n, k)` for each finer node, numbers of the coarse nodes whose mean it is.
    weights: `(n, k)` their weights in the mean.
    members: `(t, j)` the finer nodes in each coarse element.
    places: nodes at which a measure has no error bar.
    doubt: why no error bar is known, whatever the commands; empty if one is.
    widening: factor of the error bars for narrow anchors.
    """

    coarse: Scene
    fine: Scene
    nodes: np.ndarray = index_field()
    weights: np.ndarray = index_field()
    members: np.ndarray = index_field()
    places: Places
    doubt: str = static_field(default="")
    widening: float = static_field(default=1.0)

    def __repr__(self) -> str:
        return f"TwoMeshes({self.coarse!r}, {self.fine!r})"

    def carry(self, field: jax.Array) -> jax.Array:
        """A field `(m, d)` at the nodes of the coarse mesh, at those of the finer one `(n, d)`."""
        return jnp.einsum("nk,nkd->nd", jnp.asarray(self.weights, field.dtype), field[self.nodes])

    def by_element(self, parts: jax.Array) -> jax.Array:
        """Values `(n, p)` at the nodes of the finer mesh, shared out among the coarse elements `(t, p)` around each."""
        around = np.bincount(np.asarray(self.members).ravel())[:, None]
        return jnp.sum((parts / around)[self.members], axis=1)

    def commanded(self, ratios: jax.Array) -> TwoMeshes:
        """Both scenes under the commands `ratios` `(m,)`."""
        return replace(self, coarse=command(self.coarse, ratios), fine=command(self.fine, ratios))


@usual_rules
def two_meshes(scene: Scene) -> TwoMeshes:
    """The scene on its own mesh and on a finer one, for `corrected`. Make it once and command it often.

    Triangles of three nodes become triangles of six, and triangles of six nodes are cut in four (see `enriched`).
    Differentiable in the parameters of the terms; the mesh and the widths of anchors must be known.

    Args:
        scene: under any commands.

    Raises:
        ValueError: as `enriched` does, such as for a term that has no form on a finer mesh.
    """
    fine, way = enriched(scene)
    whole = fine.mesh.elements.reshape(len(scene.mesh.elements), -1)
    members = np.array([np.unique(nodes) for nodes in whole])
    places = places_of(scene, fine)
    return TwoMeshes(scene, fine, way.nodes, way.weights, members, places, scene_doubt(scene), widening(scene))


class States(NamedTuple):
    """Equilibria on both meshes.

    coarse: solution on the coarse mesh.
    fine: solution on the finer mesh; `x` is that after the short steps, and `status` has the flags of both.
    start: `(n, d)` the coarse positions, carried over.
    step: `(n, d)` the last short step; `fine.x` includes it.
    factor: of the stiffness on the finer mesh at a state near `fine.x`.
    """

    coarse: Solution
    fine: Solution
    start: jax.Array
    step: jax.Array
    factor: Any


@compiled("solver")
def solve_both(meshes: TwoMeshes, layouts: tuple[Layout, Layout], ratios: jax.Array, solver: Newton) -> States:
    """Equilibria on both meshes, without derivatives.

    Args:
        meshes: with unlocked indices.
        layouts: of the stiffness on each mesh.
        ratios: `(m,)` commands.
        solver: settings.
    """
    meshes = meshes.commanded(ratios)
    coarse, _ = solve_from(from_rest(meshes.coarse), meshes.coarse, layouts[0], _loosely(solver, COARSE))
    start = meshes.carry(coarse.x)
    origin = from_rest(meshes.fine, at_places(meshes.fine, start))
    fine, factor = solve_from(origin, meshes.fine, layouts[1], _loosely(solver, FINE))
    return _settled(meshes.fine, layouts[1], coarse, fine, start, factor, solver)


def _loosely(solver: Newton, rtol: float) -> Newton:
    """The solver with this relative residual, or its own if that is larger."""
    return dataclasses.replace(solver, rtol=max(rtol, solver.rtol or 0.0))


def _settled(
    scene: Scene, layout: Layout, coarse: Solution, fine: Solution, start: jax.Array, factor: Any, solver: Newton
) -> States:
    """The states after short steps from `fine.x`, which solve with a factor that is not renewed.

    Args:
        scene: on the finer mesh, with unlocked indices.
        layout: of its stiffness.
        coarse: solution on the coarse mesh.
        fine: solution on the finer mesh, to the residual `FINE`.
        start: `(n, d)` the coarse positions, carried over.
        factor: of the stiffness at `fine.x`.
        solver: its linear solver is used.
    """
    floor = ROUND_OFF * jnp.finfo(start.dtype).eps * jnp.max(jnp.abs(start))

    def step_from(x: jax.Array) -> jax.Array:
        unbalanced = jnp.where(scene.held, 0, evaluate(scene, x).gradient)
        return -expand(layout, solver.linear.solve(layout, factor, gather(layout, unbalanced)), x.shape)

    def is_short(x: jax.Array, step: jax.Array) -> jax.Array:
        change = jnp.max(jnp.abs(x + step - start))
        return jnp.max(jnp.abs(step)) <= jnp.maximum(SETTLED * change, floor)

    def going(carry: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        count, x, step = carry
        return ~is_short(x, step) & (count < MOST_STEPS) & jnp.all(jnp.isfinite(step))

    def again(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        count, x, step = carry
        return count + 1, x + step, step_from(x + step)

    _, x, step = lax.while_loop(going, again, (jnp.zeros((), jnp.int32), fine.x, step_from(fine.x)))
    converged = is_short(x, step)
    x = jnp.where(converged, x + step, fine.x)
    volume = smallest_jacobian(scene, x)
    unsettled, inverted = (
        jnp.where(fails, int(flag), 0)
        for fails, flag in ((~converged, Status.NOT_CONVERGED), (~(volume > 0), Status.INVERTED))
    )
    status = (coarse.status | fine.status | unsettled | inverted).astype(jnp.int32)
    return States(coarse, replace(fine, x=x, status=status), start, step, factor)
