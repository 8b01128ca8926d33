"""A smooth one-sided law: what pulls only when it is taut, or pushes only when it is touched.

With `t` the stretch or depth over the width of the transition, the energy is

    h(t) = 0 (t <= 0),   t^3 / 6 (0 < t < 1),   (t - 1/2)^2 / 2 + 1/24 (t >= 1).

Its second derivative rises linearly from 0 to 1 over the transition. So energy, force and stiffness are continuous, as
Newton's method needs.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def one_sided(t: jax.Array) -> jax.Array:
    """The energy `h(t)`, of the shape of `t`."""
    rising, full = jnp.clip(t, 0, 1), jnp.maximum(t, 1)
    return jnp.where(t < 1, rising**3 / 6, 0.5 * (full - 0.5) ** 2 + 1 / 24)


def one_sided_slope(t: jax.Array) -> jax.Array:
    """The force `h'(t)`, of the shape of `t`."""
    return jnp.where(t < 1, 0.5 * jnp.clip(t, 0, 1) ** 2, jnp.maximum(t, 1) - 0.5)
