"""Would a factor in float32 with residuals in float64 pay? Time of each precision, and what refinement adds.

    python -m benchmarks.precision

A Newton step in float64 costs one factorisation and one solve. With a factor in float32 it costs both in float32, and
as many further solves and products with the matrix as iterative refinement needs to reach the same direction to
1e-10. Timed alternately in one run, medians; on the reference beam at ratio (0.8, 1.0), solved, on finer and finer
meshes. `gain` is the time of the step in float64 over that in mixed precision: it pays where it is above 1.
"""

from __future__ import annotations

import os

# Set before JAX is imported: one thread, so that the ratios are those of one core.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from benchmarks.timing import seconds
from jaxbeam.core.tree import unlock
from jaxbeam.linear.layout import Layout, assemble
from jaxbeam.scene.scene import stencil_hessians
from jaxbeam.solve.newton import topology

LINEAR = jb.BlockTridiagonal()
factor, solve = jax.jit(LINEAR.factor), jax.jit(LINEAR.solve)
# Refinements after which it is given up.
MOST = 50
MESHES = ((29, 7, 101), (57, 13, 51), (113, 25, 21), (225, 49, 7))


@jax.jit
def product(scene: jb.Scene, layout: Layout, hessians: list[jax.Array], v: jax.Array) -> jax.Array:
    """The matrix times a vector of unknowns `(N,)`, stencil by stencil."""
    field = jnp.append(v, 0)[layout.position]
    out = jnp.zeros_like(field)
    for term, hessian in zip(scene.terms, hessians, strict=True):
        where = (2 * term.nodes[..., None] + jnp.arange(2)).reshape(term.nodes.shape[0], -1)
        out = out.at[where].add(jnp.einsum("ijm,mj->mi", hessian, field[where]))
    return jnp.append(out, 0)[layout.slots]


def measure(nx: int, ny: int, repeats: int) -> str:
    """One line of the table."""
    scene = jb.command(jb.tendon_beam(nx, ny), [0.8, 1.0])
    x, layout = jb.equilibrium(scene).x, LINEAR.layout(topology(scene))
    free, scene = int((~scene.fixed).sum()), unlock(scene)
    hessians = jax.jit(stencil_hessians)(scene, x)
    double = jax.jit(assemble)(layout, hessians)
    single = double.astype(jnp.float32)
    coarse, fine = factor(layout, single)[0], factor(layout, double)[0]

    rhs = product(scene, layout, hessians, (layout.slots < layout.position.size).astype(double.dtype))
    exact = solve(layout, fine, rhs)
    direction, refinements = jnp.zeros_like(rhs), -1
    while jnp.abs(direction - exact).max() > 1e-10 * jnp.abs(exact).max() and refinements < MOST:
        residual = rhs - product(scene, layout, hessians, direction)
        correction = solve(layout, coarse, residual.astype(jnp.float32))
        direction, refinements = direction + correction.astype(jnp.float64), refinements + 1

    calls = (
        (factor, layout, double),
        (factor, layout, single),
        (solve, layout, fine, rhs),
        (solve, layout, coarse, rhs.astype(jnp.float32)),
        (product, scene, layout, hessians, rhs),
    )
    times = [[seconds(*call) for call in calls] for _ in range(repeats + 1)][1:]
    factor64, factor32, solve64, solve32, times64 = 1e3 * np.median(times, axis=0)
    gain = (factor64 + solve64) / (factor32 + solve32 + refinements * (solve32 + times64))
    return (
        f"{free:8}  {factor64:8.3f}  {factor32:8.3f}  {solve64:7.3f}  {solve32:7.3f}  {times64:14.3f}  "
        f"{refinements:11}  {gain:4.2f}"
    )


def main() -> None:
    """Print the table."""
    print("unknowns  factor64  factor32  solve64  solve32  product64 (ms)  refinements  gain")
    for mesh in MESHES:
        print(measure(*mesh), flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
