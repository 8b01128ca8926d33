"""Line search: a step is shortened until it lowers the energy.

Steps may be bent: of length `t` they lead from `x` to `x + t step + t^2 bend` (`jaxbeam.solve.newton` says why).

A length is accepted by one of two conditions. Far from the solution Armijo's condition decides. Near it differences of
energy are smaller than their round-off, and the slope decides, by the approximate Wolfe condition of Hager and Zhang
(2005), SIAM J. Optim. 16, eq. 4.1: it accepts an energy that rises by no more than its round-off.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxbeam.core.compiling import choose
from jaxbeam.scene.evaluation import Evaluation, evaluate, largest_step, surrounded
from jaxbeam.scene.scene import Scene

# Armijo's condition asks for this share of the decrease that the slope predicts.
ARMIJO = 1e-4

# The constant delta of the approximate Wolfe condition.
APPROXIMATE_WOLFE = 0.1

MAX_HALVINGS = 40

# A length is too long if its limit is less than this share of it. The limit is known within round-off only.
WITHIN = 0.99

# Round-off of an energy, over eps times its `magnitude` in `line_search`.
ENERGY_ROUND_OFF = 4.0


class SearchResult(NamedTuple):
    """Where a line search ends.

    x: `(n, d)` positions; the old ones if no length was accepted.
    evaluation: energy and gradient there.
    halvings: `()` how often the step was halved.
    moved: `()` whether a length was accepted.
    """

    x: jax.Array
    evaluation: Evaluation
    halvings: jax.Array
    moved: jax.Array


@partial(jax.jit, static_argnames="keep_volume")
def line_search(
    scene: Scene,
    x: jax.Array,
    evaluation: Evaluation,
    step: jax.Array,
    bend: jax.Array,
    initial: jax.Array,
    full: jax.Array,
    keep_volume: float,
) -> SearchResult:
    """Take a step, halved until the energy falls and the body does not close around an obstacle.

    A length is too long if an element loses more volume than `keep_volume` allows, on the straight way to where it
    leads. Then a bent step is tried straight, and a straight one at its largest length that is not too long.

    Args:
        scene: the scene to solve.
        x: `(n, d)` positions.
        evaluation: energy and gradient at `x`.
        step: `(n, d)` the full step.
        bend: `(n, d)` its bend; zero for a straight step.
        initial: `()` whether this step leads to the start of Newton's method. Then `evaluation` is not known yet, and
            the first length that keeps volume is accepted whatever the energy.
        full: `()` whether the energy may rise. Then the first such length with a finite energy is accepted.
        keep_volume: fraction of its `J` that every element keeps (for exceptions see `largest_step`).
    """
    slope = jnp.sum(evaluation.gradient * step)
    # Round-off of the energy comes from the summation and from the round-off of the positions.
    magnitude = evaluation.energy_scale + jnp.max(jnp.abs(x)) * jnp.sum(evaluation.gradient_scale)
    round_off = ENERGY_ROUND_OFF * jnp.finfo(step.dtype).eps * magnitude
    downhill = initial | (jnp.isfinite(slope) & (slope < 0))

    def try_length(carry: Any) -> Any:
        count, halvings, length, bend, _, _, _ = carry
        move = length * (step + length * bend)
        new_x = x + move
        new = evaluate(scene, new_x)
        new_slope = jnp.sum(new.gradient * (step + 2 * length * bend))
        armijo = new.energy <= evaluation.energy + ARMIJO * length * slope
        flat = (new.energy <= evaluation.energy + round_off) & (new_slope <= (2 * APPROXIMATE_WOLFE - 1) * slope)
        finite = jnp.isfinite(new.energy) & jnp.isfinite(new_slope)
        accepted = initial | ((armijo | flat | full) & finite)
        if (inside := surrounded(scene, new_x)) is not None:
            # The body may not pass an obstacle. Of the way to the start of the method the least is accepted all the
            # same, because there is no evaluation before it.
            accepted &= ~inside | (initial & (count == MAX_HALVINGS))
        room, bent = largest_step(scene, x, move, keep_volume).astype(step.dtype), jnp.any(bend != 0)
        long = (room < WITHIN) & (bent | (length == 1))
        shorter = jnp.where(long, jnp.where(bent, length, room), 0.5 * length)
        halved = (~long & ~accepted).astype(jnp.int32)
        return count + 1, halvings + halved, shorter, jnp.where(long, 0, bend), new_x, new, accepted & ~long

    none = jnp.zeros((), jnp.int32)
    begin = (none, none, jnp.ones((), step.dtype), bend, x, evaluation, ~downhill)
    going = lambda carry: ~carry[-1] & (carry[0] <= MAX_HALVINGS)
    _, halvings, _, _, new_x, new, accepted = lax.while_loop(going, try_length, begin)
    moved = downhill & accepted
    new_x, new = choose(moved, (new_x, new), (x, evaluation))
    return SearchResult(new_x, new, halvings, moved)
