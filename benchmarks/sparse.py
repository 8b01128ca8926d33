"""Sparse direct solvers of others, on the stiffness matrices of jaxbeam's scenes.

    python -m benchmarks.sparse [--out out/benchmarks]

Each is made from a matrix, which does its ordering and symbolic analysis, once for a sparsity pattern. `load` takes the
values of another matrix of that pattern into the form that the library wants, `factor` is the numeric factorisation and
`solve` the two substitutions: these two are what a Newton step costs, and only they are timed.

- `SuperLU` (SciPy): an LU with partial pivoting. SciPy cannot keep its analysis, so its ordering is found once and the
  matrix permuted beforehand. Without pivoting, on the pattern of `A + A^T`, it is fastest for these matrices.
- `Cholmod` (cvxopt): supernodal Cholesky, with the ordering AMD, the only one in cvxopt's wheels.
- `Pardiso` (MKL, pypardiso): supernodal Cholesky, phases 11 (analysis), 22 and 33, with METIS; through the library's
  own call, for pypardiso's `solve` compares the matrix with the one before.

Run as a program, it prints what the orderings of each cost.
"""

from __future__ import annotations

import benchmarks.one_thread  # isort: skip # noqa: F401

import ctypes
import os
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import cvxopt
import cvxopt.cholmod
import jax
import numpy as np
import scipy.sparse
from scipy.sparse.linalg import splu

import jaxbeam as jb
from benchmarks import report
from benchmarks.timing import medians
from jaxbeam.core.tree import unlock
from jaxbeam.scene.scene import stencil_hessians

Matrix = scipy.sparse.csc_matrix


try:
    import pypardiso
except ImportError:
    # MKL exists for x86 alone.
    pypardiso = None


class System(NamedTuple):
    """A stiffness matrix over the free coordinates, `(f, f)`, and which of the `n d` coordinates these are, `(f,)`."""

    matrix: Matrix
    free: np.ndarray


_hessians = jax.jit(stencil_hessians)


def stiffness(scene: jb.Scene, x: jax.Array) -> System:
    """The true Hessian of the energy at node positions `x` `(n, 2)`, without the fixed coordinates."""
    d = x.shape[1]
    free = np.flatnonzero(~scene.fixed.ravel())
    unknown = np.full(x.size, -1)
    unknown[free] = np.arange(free.size)
    rows, columns, values = [], [], []
    for term, hessian in zip(scene.terms, _hessians(unlock(scene), x), strict=True):
        where = unknown[(np.asarray(term.nodes)[..., None] * d + np.arange(d)).reshape(len(term.nodes), -1)]
        size = where.shape[1]
        rows.append(np.repeat(where, size, axis=1).ravel())
        columns.append(np.tile(where, (1, size)).ravel())
        values.append(np.moveaxis(hessian, -1, 0).ravel())
    row, column, value = (np.concatenate(parts) for parts in (rows, columns, values))
    kept = (row >= 0) & (column >= 0)
    shape = (free.size, free.size)
    matrix = scipy.sparse.coo_matrix((value[kept], (row[kept], column[kept])), shape).tocsc()
    matrix.sort_indices()
    return System(matrix, free)


class SuperLU:
    """SciPy's SuperLU."""

    name = "SuperLU"

    def __init__(self, matrix: Matrix, ordering: str = "MMD_AT_PLUS_A", symmetric: bool = True) -> None:
        self.symmetric = symmetric
        # perm_c[j] is the new place of column j.
        place = self._splu(matrix, ordering).perm_c
        self.old = np.argsort(place)
        numbered = matrix.copy()
        numbered.data = np.arange(matrix.nnz, dtype=np.float64)
        self.permuted = numbered[self.old][:, self.old].tocsc()
        self.permuted.sort_indices()
        self.source = self.permuted.data.astype(np.int64)
        self.load(matrix)

    def load(self, matrix: Matrix) -> None:
        self.permuted.data = matrix.data[self.source]

    def _splu(self, matrix: Matrix, ordering: str) -> Any:
        if self.symmetric:
            # A positive definite matrix needs no pivoting.
            return splu(matrix, ordering, diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        return splu(matrix, ordering)

    def factor(self) -> None:
        self.lu = self._splu(self.permuted, "NATURAL")

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        x = np.empty_like(rhs)
        x[self.old] = self.lu.solve(rhs[self.old])
        return x

    def numbers(self) -> int:
        """How many numbers the factor holds."""
        return int(self.lu.nnz)


class Cholmod:
    """CHOLMOD's supernodal Cholesky, through cvxopt."""

    name = "CHOLMOD"

    def __init__(self, matrix: Matrix, supernodal: int = 2) -> None:
        self.supernodal = supernodal
        lower = scipy.sparse.tril(matrix, format="coo")
        self.kept = np.flatnonzero(matrix.indices >= np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr)))
        self.lower = cvxopt.spmatrix(lower.data, lower.row, lower.col, matrix.shape)
        cvxopt.cholmod.options["supernodal"] = supernodal
        self.symbolic = cvxopt.cholmod.symbolic(self.lower, uplo="L")
        self.load(matrix)

    def load(self, matrix: Matrix) -> None:
        # Both hold the lower triangle by columns, rows increasing.
        self.lower.V = cvxopt.matrix(matrix.data[self.kept])

    def factor(self) -> None:
        cvxopt.cholmod.options["supernodal"] = self.supernodal
        cvxopt.cholmod.numeric(self.lower, self.symbolic)

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        x = cvxopt.matrix(rhs)
        cvxopt.cholmod.solve(self.symbolic, x)
        return np.array(x).ravel()

    def numbers(self) -> int:
        """How many numbers the factor holds."""
        return len(cvxopt.cholmod.getfactor(self.symbolic).V)


class Pardiso:
    """MKL's PARDISO for symmetric positive definite matrices."""

    name = "PARDISO"

    def __init__(self, matrix: Matrix, ordering: int = 2) -> None:
        self.solver = pypardiso.PyPardisoSolver(mtype=2)
        # Else each new solver searches the folders anew for the library.
        os.environ.setdefault("PYPARDISO_MKL_RT", self.solver.libmkl._name)
        set_one = self.solver.set_iparm
        # 1: these settings, not the defaults; 2: ordering (0 minimum degree, 2 METIS); 10: unused for this type, its
        # default; 18: count the numbers of the factor; 35: indices from zero.
        for number, value in ((1, 1), (2, ordering), (10, 8), (18, -1), (35, 1)):
            set_one(number, value)
        # The upper triangle by rows is the lower one by columns.
        lower = scipy.sparse.tril(matrix, format="csc")
        lower.sort_indices()
        self.kept = np.flatnonzero(matrix.indices >= np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr)))
        self.indptr, self.indices = lower.indptr.astype(np.int32), lower.indices.astype(np.int32)
        self.load(matrix)
        self.rhs = self.x = np.zeros(matrix.shape[0])
        self._call(11)

    def load(self, matrix: Matrix) -> None:
        self.values = matrix.data[self.kept]

    def _call(self, phase: int) -> None:
        number = lambda value: ctypes.byref(ctypes.c_int32(value))
        pointer = lambda array, kind=ctypes.c_int32: array.ctypes.data_as(ctypes.POINTER(kind))
        s, error = self.solver, ctypes.c_int32(0)
        s._mkl_pardiso(
            pointer(s.pt, ctypes.c_int64),
            number(1),
            number(1),
            number(s.mtype),
            number(phase),
            number(len(self.indptr) - 1),
            pointer(self.values, ctypes.c_double),
            pointer(self.indptr),
            pointer(self.indices),
            pointer(s.perm),
            number(1),
            pointer(s.iparm),
            number(0),
            pointer(self.rhs, ctypes.c_double),
            pointer(self.x, ctypes.c_double),
            ctypes.byref(error),
        )
        if error.value:
            raise RuntimeError(f"PARDISO: error {error.value} in phase {phase}")

    def factor(self) -> None:
        self._call(22)

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        self.rhs, self.x = np.ascontiguousarray(rhs), np.empty_like(rhs)
        self._call(33)
        return self.x

    def numbers(self) -> int:
        """How many numbers the factor holds."""
        return int(self.solver.get_iparm(18))

    def close(self) -> None:
        """Give its memory back."""
        self._call(-1)


PEERS: tuple[Callable[[Matrix], Any], ...] = (SuperLU, Cholmod, *([Pardiso] if pypardiso else []))


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    options = report.options(__doc__).parse_args(arguments)
    report.head("Orderings of the sparse direct solvers")
    rows = []
    for nx, ny in ((29, 7), (113, 25), (225, 49)):
        scene = jb.tendon_beam(nx, ny)
        system = stiffness(scene, scene.mesh.nodes)
        rhs = np.ones(len(system.free))
        choices = {
            "SuperLU, COLAMD, pivoting": SuperLU(system.matrix, "COLAMD", symmetric=False),
            "SuperLU, A + A^T, no pivoting": SuperLU(system.matrix),
            "CHOLMOD, simplicial": Cholmod(system.matrix, 0),
            "CHOLMOD, supernodal": Cholmod(system.matrix),
        }
        if pypardiso:
            choices["PARDISO, minimum degree"] = Pardiso(system.matrix, 0)
            choices["PARDISO, METIS"] = Pardiso(system.matrix)
        for name, peer in choices.items():
            factor, solve = medians(peer.factor, partial(peer.solve, rhs), repeats=5)
            off = np.abs(system.matrix @ peer.solve(rhs) - rhs).max()
            rows.append((len(rhs), name, 1e3 * factor.median, 1e3 * solve.median, peer.numbers(), off))
    header = ("unknowns", "solver", "factor, ms", "solve, ms", "numbers in factor", "residual")
    report.table(header, rows)
    report.save(options.out, "sparse", [dict(zip(header, row, strict=True)) for row in rows])


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
