"""Line search: a step is halved until it lowers the energy.

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
    initial: jax.Array,
    full: jax.Array,
    keep_volume: float,
) -> SearchResult:
    """Take a step, halved until the energy falls and the body does not close around an obstacle.

    The first length tried is the largest, up to 1, at which no element loses more volume than `keep_volume` allows.

    Args:
        scene: the scene to solve.
        x: `(n, d)` positions.
        evaluation: energy and gradient at `x`.
        step: `(n, d)` the full step.
        initial: `()` whether this step leads to the start of Newton's method. Then `evaluation` is not known yet, and
            the first length is accepted whatever the energy.
        full: `()` whether the energy may rise. Then the first length with a finite energy is accepted.
        keep_volume: fraction of its `J` that every element keeps (for exceptions see `largest_step`).
    """
    slope = jnp.sum(evaluation.gradient * step)
    # Round-off of the energy comes from the summation and from the round-off of the positions.
    magnitude = evaluation.energy_scale + jnp.max(jnp.abs(x)) * jnp.sum(evaluation.gradient_scale)
    round_off = ENERGY_ROUND_OFF * jnp.finfo(step.dtype).eps * magnitude
    longest = jnp.minimum(1.0, largest_step(scene, x, step, keep_volume)).astype(step.dtype)
    downhill = initial | (jnp.isfinite(slope) & (slope < 0))

    def try_length(carry: Any) -> Any:
        count, _, _, _ = carry
        length = longest * 0.5 ** count.astype(step.dtype)
        new_x = x + length * step
        new = evaluate(scene, new_x)
        new_slope = jnp.sum(new.gradient * step)
        armijo = new.energy <= evaluation.energy + ARMIJO * length * slope
        flat = (new.energy <= evaluation.energy + round_off) & (new_slope <= (2 * APPROXIMATE_WOLFE - 1) * slope)
        finite = jnp.isfinite(new.energy) & jnp.isfinite(new_slope)
        accepted = initial | ((armijo | flat | full) & finite)
        if (inside := surrounded(scene, new_x)) is not None:
            # The body may not pass an obstacle. Of the way to the start of the method the least is accepted all the
            # same, because there is no evaluation before it.
            accepted &= ~inside | (initial & (count == MAX_HALVINGS))
        return count + 1, new_x, new, accepted

    begin = (jnp.zeros((), jnp.int32), x, evaluation, ~downhill)
    going = lambda carry: ~carry[3] & (carry[0] <= MAX_HALVINGS)
    count, new_x, new, accepted = lax.while_loop(going, try_length, begin)
    moved = downhill & accepted
    new_x, new = choose(moved, (new_x, new), (x, evaluation))
    return SearchResult(new_x, new, jnp.maximum(count - 1, 0), moved)
