"""Nearest positive semidefinite matrices in the Frobenius norm (Higham 1988): negative eigenvalues are set to 0.

Where the energy is not convex, Newton's method blends the Hessian with a projected one. For a solid, what is projected
is the second derivative of the density in `H = F - I`, four by four at each quadrature point (Teran, Sifakis, Irving
and Fedkiw 2005). For any other term it is the Hessian of the whole stencil.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

# Jacobi's method makes this many more sweeps over all pairs of rows than the matrix has rows. Its convergence is
# quadratic, but sets in later for larger matrices. Matrices of four by four reach round-off in six sweeps.
SWEEPS = 2


def project_each(matrices: jax.Array) -> jax.Array:
    """Projections of symmetric matrices `(m, s, s)` of any size, one by one."""

    def one(matrix: jax.Array) -> jax.Array:
        values, vectors = jnp.linalg.eigh(matrix)
        return (vectors * jnp.maximum(values, 0)) @ vectors.T

    # Not a batched eigh: it distributes its matrices over XLA's threads and waits for these. Two programs that run side
    # by side, as in a sweep, can then wait for each other for ever (jaxlib 0.10 on a processor of two cores).
    return lax.map(one, matrices)


def project_many(matrices: jax.Array) -> jax.Array:
    """Projections of many small symmetric matrices `(s, s, m)` at once, `s` even, by Jacobi's method.

    Each step rotates `s / 2` disjoint pairs of rows together. Then the rows change places, so that each pair is rotated
    once in `s - 1` steps (Brent and Luk 1985, SIAM J. Sci. Stat. Comput. 6). Matrices are the last axis, so a step is a
    few vectorised loops over them. This takes a tenth of the time of calls to LAPACK.
    """
    s = len(matrices)
    upper, lower = np.arange(0, s, 2), np.arange(1, s, 2)
    if s > 2:
        upper, lower = np.array([0, lower[0], *upper[1:-1]]), np.array([*lower[1:], upper[-1]])
    places = np.stack([upper, lower], axis=1).ravel()

    def turn(_: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        a, v = carry
        first, second, both = (
            jnp.stack([a[i + p, i + q] for i in range(0, s, 2)]) for p, q in ((0, 0), (1, 1), (0, 1))
        )
        gap = second - first
        reach = jnp.abs(gap) + jnp.sqrt(gap**2 + 4 * both**2)
        tangent = jnp.where(reach > 0, 2 * both * jnp.where(gap < 0, -1, 1) / jnp.where(reach > 0, reach, 1), 0)
        cosine = (1 / jnp.sqrt(1 + tangent**2))[:, None]
        sine = tangent[:, None] * cosine

        def rotated(rows: jax.Array) -> jax.Array:
            p, q = rows[0::2], rows[1::2]
            return jnp.stack([cosine * p - sine * q, sine * p + cosine * q], axis=1).reshape(rows.shape)[places]

        return rotated(rotated(a).swapaxes(0, 1)), rotated(v)

    vectors = jnp.broadcast_to(jnp.eye(s, dtype=matrices.dtype)[:, :, None], matrices.shape)
    values, vectors = lax.fori_loop(0, (SWEEPS + s) * (s - 1), turn, (matrices, vectors))
    kept = jnp.maximum(jnp.stack([values[i, i] for i in range(s)]), 0)
    return jnp.sum(vectors[:, :, None] * (kept[:, None] * vectors)[:, None], axis=0)
