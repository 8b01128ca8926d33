"""Energy, forces and Hessians of a scene, and the margin of its elements, summed or taken over its terms.

`energy` and `forces` read any positions, in balance or not: to test a term of your own, or for a loss. What holds the
body in equilibrium is in `reactions`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxbeam.core.compiling import one_program
from jaxbeam.scene.scene import Scene, placed


class Evaluation(NamedTuple):
    """Energy and its gradient, each with a scale: the sum of the magnitudes of the numbers that were added up.

    The scales tell how large the round-off is. The relative residual is relative to the scale of the gradient.

    energy: `()` energy of all terms.
    energy_scale: `()` sum of the magnitudes of the stencil energies.
    gradient: `(n, d)` derivative of the energy in the positions.
    gradient_scale: `(n, d)` sum of the magnitudes of the stencil gradients at each coordinate.
    """

    energy: jax.Array
    energy_scale: jax.Array
    gradient: jax.Array
    gradient_scale: jax.Array


# Jitted, so that programs of the same scene share its trace.
@jax.jit
def evaluate(scene: Scene, x: jax.Array) -> Evaluation:
    """Energy and gradient at node positions `x` `(n, d)`."""
    energy = energy_scale = jnp.zeros((), x.dtype)
    both = jnp.zeros((*x.shape, 2), x.dtype)
    for term in scene.terms:
        energies, gradients = term.kind.gradients(x[term.nodes], term.params)
        energy += jnp.sum(energies)
        energy_scale += jnp.sum(jnp.abs(energies))
        both = both.at[term.nodes].add(jnp.stack([gradients, jnp.abs(gradients)], axis=-1))
    return Evaluation(energy, energy_scale, both[..., 0], both[..., 1])


@one_program
def energy(scene: Scene, x: jax.Array) -> jax.Array:
    """Total energy `()` at node positions `x` `(n, 2)`; differentiable in the scene and in `x`."""
    x = placed(scene, x)
    return sum((jnp.sum(jax.vmap(t.energy)(x[t.nodes], t.params)) for t in scene.terms), jnp.zeros((), x.dtype))


@one_program
def forces(scene: Scene, x: jax.Array) -> jax.Array:
    """Force `(n, 2)` of all terms on each node: minus the gradient of the energy."""
    return -evaluate(scene, placed(scene, x)).gradient


@one_program
def reactions(scene: Scene, x: jax.Array) -> jax.Array:
    """Force `(n, 2)` of clamps and supports on each node, zero for coordinates that are free.

    At equilibrium the reactions balance the external loads. Tendons are part of the body: they act on it at both ends,
    so that their forces cancel in this balance.
    """
    return jnp.where(scene.held, -forces(scene, x), 0)


@jax.jit
def second_change(scene: Scene, x: jax.Array, dx: jax.Array) -> jax.Array:
    """Second derivative `(n, d)` of the gradient of the energy along `dx` `(n, d)`, at positions `x` `(n, d)`."""
    total = jnp.zeros_like(x)
    for term in scene.terms:
        along = dx[term.nodes]
        gradient = lambda at, term=term: term.kind.gradients(at, term.params)[1]
        change = lambda at, gradient=gradient, along=along: jax.jvp(gradient, (at,), (along,))[1]
        total = total.at[term.nodes].add(jax.jvp(change, (x[term.nodes],), (along,))[1])
    return total


def stencil_hessians(scene: Scene, x: jax.Array, convex: bool = False) -> list[jax.Array]:
    """For each term, the Hessians `(k d, k d, m)` of its stencils; with `convex`, positive semidefinite ones."""
    return [term.kind.hessians(x[term.nodes], term.params, convex) for term in scene.terms]


@one_program
def smallest_jacobian(scene: Scene, x: jax.Array) -> jax.Array:
    """Smallest `J = det F` `()` anywhere in the solids at `x`, or stretch of a fibre of the rods, whichever is less.

    It is the smallest over whole elements, not only over quadrature points. Infinite in a scene without either.
    """
    return worst_element(scene, placed(scene, x))[0]


def worst_element(scene: Scene, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """What `smallest_jacobian` returns, `()`, and the number `()` of the element where it lies.

    In a scene without solids and rods they are infinity and -1.
    """
    found = [term.kind.margin(x[term.nodes], term.params) for term in scene.terms]
    margins = [each for each in found if each is not None]
    if not margins:
        return jnp.asarray(jnp.inf, x.dtype), jnp.asarray(-1, jnp.int32)
    every = jnp.concatenate(margins)
    element = jnp.argmin(every)
    return every[element], element.astype(jnp.int32)


def surrounded(scene: Scene, x: jax.Array) -> jax.Array | None:
    """Whether, `()`, the body has closed around an obstacle that it touches; None if there is none."""
    centres = jnp.mean(x[scene.mesh.elements], axis=1)
    asked = [term.kind.surrounded(x[term.nodes], centres, term.params) for term in scene.terms]
    found = [each for each in asked if each is not None]
    return jnp.any(jnp.stack(found)) if found else None


def largest_step(scene: Scene, x: jax.Array, dx: jax.Array, keep: float) -> jax.Array:
    """Largest `t` `()` for which every element keeps the fraction `keep` of its `J` on the way to `x + t dx`.

    Each energy gives its own limit, and may allow `J` to pass through zero (see `Energy.longest_step`).
    """
    limits = [jnp.asarray(jnp.inf, x.dtype)]
    for term in scene.terms:
        steps = term.kind.longest_step(x[term.nodes], dx[term.nodes], term.params, keep)
        if steps is not None:
            limits.append(jnp.min(steps))
    return jnp.min(jnp.stack(limits))
