"""What a derivative through equilibrium costs, beside the solve itself and beside finite differences.

    python -m benchmarks.gradient

The tip angle of the reference beam at (0.4, 1.0), by both commands and the Young's moduli of all 336 elements. The
solve, and value and gradient, are timed alternately in one run; finite differences take one solve for each
parameter and one more. Medians; compile time apart.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from benchmarks.timing import seconds

REPEATS = 51
STEP = 1e-6


def angle(ratios: jax.Array, young: jax.Array) -> jax.Array:
    """Tip angle in degrees of the reference beam, from rest."""
    scene = jb.command(jb.tendon_beam(young=young), ratios)
    return jb.tip_angle(scene, jb.equilibrium(scene).x)


def main() -> None:
    """Print the table."""
    point = jnp.array([0.4, 1.0]), jnp.full(336, 1e4)
    solve = jax.jit(angle)
    gradient = jax.jit(jax.value_and_grad(angle, argnums=(0, 1)))
    flat = lambda both: angle(both[:2], 1e4 * both[2:])

    @jax.jit
    def differences(point: tuple[jax.Array, jax.Array]) -> jax.Array:
        base = jnp.concatenate([point[0], point[1] / 1e4])
        moved = base + STEP * jnp.concatenate([jnp.zeros((1, base.size)), jnp.eye(base.size)])
        values = jax.lax.map(flat, moved)
        return (values[1:] - values[0]) / STEP

    compiling = [seconds(solve, *point), seconds(gradient, *point), seconds(differences, point)]
    times = np.array([[seconds(solve, *point), seconds(gradient, *point)] for _ in range(REPEATS)])
    by_differences = min(seconds(differences, point) for _ in range(3))
    exact = jnp.concatenate([gradient(*point)[1][0], 1e4 * gradient(*point)[1][1]])
    apart = float(jnp.abs(differences(point) - exact).max() / jnp.abs(exact).max())
    alone, both = np.median(times, axis=0)
    print(f"first call, compile included: solve {compiling[0]:.1f} s, value and gradient {compiling[1]:.1f} s")
    print(f"solve                    {1e3 * alone:9.3f} ms")
    print(f"value and gradient       {1e3 * both:9.3f} ms, {np.median(times[:, 1] / times[:, 0]):.3f} solves")
    print(f"finite differences (339) {1e3 * by_differences:9.3f} ms, {by_differences / alone:.0f} solves")
    print(f"largest difference of the two gradients: {apart:.1e} of the largest entry")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
