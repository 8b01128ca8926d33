"""Meshes of a rectangle, uniform or graded."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, namespace
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import quadratic

Diagonals = Literal["one-sided", "mirrored", "crossed"]


@usual_rules
def rectangle(
    length: Numbers,
    height: Numbers,
    nx: int,
    ny: int,
    diagonals: Diagonals = "one-sided",
    dtype: Any = None,
    *,
    order: int = 1,
    graded: bool = False,
) -> Mesh:
    """Mesh of a rectangle centred on the origin: a grid of `nx` x `ny` corners, whose cells are split into triangles.

    The corner in column `i` from the left and row `j` from below is node `i * ny + j`. The cell centres of crossed
    diagonals follow after the corners, and then, if `order` is 2, the nodes between corners.

    Args:
        length: extent in x, positive; may be traced.
        height: extent in y, positive; may be traced.
        nx: corners along the length, at least 2.
        ny: corners along the height, at least 2.
        diagonals: how a cell is split. `"one-sided"`: two triangles, by the diagonal from lower left to
            upper right. `"mirrored"`: the same below mid-height and its mirror image above, so the mesh is
            symmetric about mid-height (`ny` must be odd). `"crossed"`: four triangles about the centre.
        dtype: dtype of the nodes; by default JAX's float.
        order: order of the shape functions: 1 for triangles of three nodes, 2 for six (see `quadratic`).
        graded: space columns and rows unevenly, for a beam that is clamped at its left edge and steered from its
            middle. In the left half, the distance of a column from the left edge goes with the power 3/2 of its
            number. In the right half, the distance from the middle goes with a hyperbolic sine. Two thirds of the
            columns are in the left half (see `middle_column`). Rows are denser at both faces.

    Returns:
        A `Mesh`, differentiable in `length` and `height`.

    Raises:
        ValueError: if a count is not a whole number of at least 2, an extent is not positive and finite,
            `diagonals` or `order` is unknown, a mirrored mesh is asked for with an even `ny`, or a graded one with an
            `nx` of 2.
    """
    if not isinstance(order, int | np.integer) or isinstance(order, bool) or order not in (1, 2):
        raise ValueError(f"order: expected 1 (triangles of three nodes) or 2 (of six), got {order!r}")
    checks.count("nx", nx, 2)
    checks.count("ny", ny, 2)
    length, height = (
        checks.number(name, value, checks.POSITIVE) for name, value in (("length", length), ("height", height))
    )
    graded, dtype = checks.flag("graded", graded), checks.float_dtype("dtype", dtype)
    if not isinstance(diagonals, str) or diagonals not in ("one-sided", "mirrored", "crossed"):
        raise ValueError(f"diagonals: expected 'one-sided', 'mirrored' or 'crossed', got {diagonals!r}")
    if diagonals == "mirrored" and ny % 2 == 0:
        raise ValueError(
            f"ny: expected an odd number for mirrored diagonals, got {ny}: no row of nodes lies at mid-height; "
            f"use {ny + 1}, or crossed diagonals, which are symmetric for any ny"
        )
    unit, elements = _unit_square(nx, ny, diagonals, graded)
    xp = namespace(length, height)
    extent = xp.stack([xp.asarray(length, dtype), xp.asarray(height, dtype)])
    mesh = Mesh(xp.asarray(unit, dtype) * extent, elements)
    return quadratic(mesh) if order == 2 else mesh


def _unit_square(nx: int, ny: int, diagonals: Diagonals, graded: bool) -> tuple[np.ndarray, np.ndarray]:
    """Corners `(n, 2)` and triangles `(t, 3)` of the mesh of a square of side 1."""
    columns, rows = np.linspace(0, 1, nx), np.linspace(-0.5, 0.5, ny)
    if graded:
        middle = middle_column(nx, graded)
        left, right = np.arange(middle + 1) / middle, np.arange(1, nx - middle) / (nx - 1 - middle)
        # Of the factors 2.5, 3 and 3.5, the last gave the least error of the reference beam on most meshes.
        columns = 0.5 * np.append(left**1.5, 1 + np.sinh(3.5 * right) / np.sinh(3.5))
        rows = 0.6 * rows + 0.2 * np.sin(np.pi * rows)
    unit_x, unit_y = np.meshgrid(columns - 0.5, rows, indexing="ij")
    unit = np.stack([unit_x.ravel(), unit_y.ravel()], axis=1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nx - 1), np.arange(ny - 1), indexing="ij"))
    lower_left = i * ny + j
    upper_left, lower_right, upper_right = lower_left + 1, lower_left + ny, lower_left + ny + 1
    if diagonals == "crossed":
        centre = nx * ny + np.arange(lower_left.size)
        unit = np.concatenate([unit, (unit[lower_left] + unit[upper_right]) / 2])
        corners = [lower_left, lower_right, upper_right, upper_left]
        triangles = [(corners[k], corners[(k + 1) % 4], centre) for k in range(4)]
    else:
        falling = (diagonals == "mirrored") & (j >= (ny - 1) // 2)
        triangles = [
            (lower_left, lower_right, np.where(falling, upper_left, upper_right)),
            (np.where(falling, lower_right, lower_left), upper_right, upper_left),
        ]
    elements = np.stack([np.stack(t, axis=1) for t in triangles], axis=1).reshape(-1, 3)
    return unit, elements


def middle_column(nx: int, graded: bool) -> int:
    """Number of the column of corners of a `rectangle` that lies in the middle of its length.

    Raises:
        ValueError: if no column lies there.
    """
    if graded and nx < 3:
        raise ValueError(f"nx: expected at least 3 for a graded mesh, got {nx}: no node lies in the middle; use 3")
    if graded:
        return min(-(-2 * (nx - 1) // 3), nx - 2)
    if nx % 2 == 0:
        raise ValueError(
            f"nx: expected an odd number, got {nx}: no node lies in the middle, where the tendons end; "
            f"use {nx - 1 if nx > 2 else 3} or {nx + 1}"
        )
    return (nx - 1) // 2
