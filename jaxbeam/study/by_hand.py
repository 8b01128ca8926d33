"""The tendon beam by a hand calculation: linear beam theory, to compare models with.

Its formulas show how the answer scales with each number. Where its `warning` is not empty, use `rod_beam` or
`tendon_beam`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, is_concrete, namespace, pytree, replace, static_field
from jaxbeam.physics.materials import POISSON
from jaxbeam.physics.tendon import check_law, inverse_square_stiffness
from jaxbeam.study.model_doubt import BY_HAND, outside

# ------------------------------------------------------------------------------------ the hand calculation


@pytree
class Estimate:
    """The result of the hand calculation.

    tip_angle: `()` in degrees.
    lengths: `(2,)` of the tendons, in the unit of length.
    tensions: `(2,)` of the tendons, in the unit of force.
    warning: what lies outside the range in which the error was measured, in words; empty if nothing does, or if an
        argument is traced.
    """

    tip_angle: jax.Array
    lengths: jax.Array
    tensions: jax.Array
    warning: str = static_field(default="")


@usual_rules
def euler_bernoulli(
    ratios: Numbers,
    length: Numbers = 3.5,
    height: Numbers = 0.8,
    young: Numbers = 1e4,
    poisson: Numbers = 0.45,
    tendon_modulus: Numbers = 2e3,
    *,
    stiffness: Callable[[jax.Array, jax.Array], jax.Array] = inverse_square_stiffness,
) -> Estimate:
    """The tendon beam by hand: linear Euler-Bernoulli theory in plane strain, with eccentric tendons.

    Over the half with tendons the axial strain `eps` and the curvature `kappa` are constant. With `a = length / 2`,
    eccentricities `e = +H/2` (top) and `-H/2` (bottom), tendon lengths `l = a (1 + eps - e kappa)`, commanded lengths
    `l*` and tensions `T = k (l - l*)`, equilibrium gives two linear equations,

        E' H eps + sum T = 0,     E' H^3/12 kappa - sum e T = 0,     E' = E / (1 - nu^2).

    The other half stays straight, so the tip rises by `kappa a^2 / 2 + kappa a a`.

    Against converged triangles of `macklin_mueller` with the same constants, the tip angle and the tension of the
    shortened tendon are within 6 %, if one tendon is shortened, to 0.8 or more, length over height is 2 to 6, Poisson's
    ratio 0.45 to 0.49, and `tendon_modulus / (young height^2)` 0.06 to 0.32. On the reference beam at ratio 0.5 the
    tension is 25 % off. At length over height 10 the angle is 16 % off at 0.8, and the tension twice what it should be
    at 0.5. The `warning` tells what lies outside that range.

    Args:
        ratios: `(2,)` commanded ratios of the top and the bottom tendon.
        length: of the beam.
        height: of the beam.
        young: Young's modulus, scalar. To compare with `macklin_mueller`, give what that is at small strain: for its
            Young's modulus 1e4 and Poisson's ratio 0.45, give 9962 and 0.4444.
        poisson: Poisson's ratio, scalar.
        tendon_modulus: scalar or `(2,)`.
        stiffness: the law of the tendons, see `tendons`.

    Returns:
        An `Estimate`, differentiable in every real argument.

    Raises:
        ValueError: if an argument has another shape, or a concrete one is out of range; ranges are those of `rod_beam`.
            A traced argument that is out of range makes the result NaN.
    """
    values = (
        checks.numbers("ratios", ratios, checks.POSITIVE, ((2,),), "of the top and the bottom tendon"),
        checks.number("length", length, checks.POSITIVE),
        checks.number("height", height, checks.POSITIVE),
        checks.number("young", young, checks.POSITIVE),
        checks.number("poisson", poisson, POISSON),
        checks.numbers("tendon_modulus", tendon_modulus, checks.POSITIVE, ((), (2,))),
    )
    check_law(stiffness)
    xp = namespace(*values)
    found = _by_hand(*(xp.asarray(value) for value in values), stiffness)
    return replace(found, warning=_warning(*values, stiffness)) if is_concrete(*values) else found


def _warning(
    ratios: Any, length: Any, height: Any, young: Any, poisson: Any, modulus: Any, stiffness: Callable[..., Any]
) -> str:
    """What lies outside the range of `BY_HAND`, for concrete arguments."""
    half = length / 2
    k = np.asarray(stiffness(modulus, half), float)
    return outside(BY_HAND, ratios, length / height, poisson, k * half**2 / (young * height**2))


@partial(jax.jit, static_argnames="stiffness")
def _by_hand(
    ratios: jax.Array,
    length: jax.Array,
    height: jax.Array,
    young: jax.Array,
    poisson: jax.Array,
    tendon_modulus: jax.Array,
    stiffness: Callable[[jax.Array, jax.Array], jax.Array],
) -> Estimate:
    """`euler_bernoulli` for arrays that were checked."""
    half, plane = 0.5 * length, young / (1 - poisson**2)
    commanded = ratios * half
    k = stiffness(tendon_modulus, commanded)
    # Tensions are k (a - l* + a rows . (eps, kappa)).
    rows = jnp.stack([jnp.ones(2), height * jnp.array([-0.5, 0.5])], axis=1)
    section = jnp.stack([plane * height, plane * height**3 / 12])
    matrix = jnp.diag(section) + half * (rows.T * k) @ rows
    stretch, curvature = jnp.linalg.solve(matrix, -rows.T @ (k * (half - commanded)))
    lengths = half * (1 + rows @ jnp.stack([stretch, curvature]))
    angle = jnp.rad2deg(jnp.arctan2(1.5 * curvature * half**2, length))
    return Estimate(angle, lengths, k * (lengths - commanded))
