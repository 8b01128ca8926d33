"""Meshes of a rectangle, uniform or graded.

Uniform meshes with one-sided diagonals are those of the reference scene. `"crossed"` diagonals favour no direction and
lock less; `"mirrored"` ones keep the symmetry about mid-height at half the triangles. For accuracy take `order=2` and
`graded="proportional"`, if the beam is clamped at its left edge and steered from its middle.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, namespace
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import quadratic

Diagonals = Literal["one-sided", "mirrored", "crossed"]
Grading = bool | Literal["proportional"]

# In a proportional mesh the size of a cell is in proportion to its distance from the clamp, from the middle or from a
# face, plus these shares of the height.
CLAMP, ANCHOR, FACE = 0.03, 0.2, 0.06


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
    graded: Grading = False,
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
        graded: how columns and rows are spaced, for a beam that is clamped at its left edge and steered from its
            middle (see `middle_column`). `False`: evenly. `True`: in the left half, the distance of a column from the
            left edge goes with the power 3/2 of its number. In the right half, the distance from the middle goes with a
            hyperbolic sine. Rows are denser at both faces. `"proportional"`: columns of density
            `1 / (x + 0.03 H) + 1 / (m - x + 0.2 H)` in the left half, and `1 / (x - m + 0.2 H)` in the right half, with
            `x` the distance from the left edge, `m` that of the middle and `H` the height; rows of density
            `1 / (y + 0.06 H) + 1 / (H - y + 0.06 H)`, with `y` the distance from the lower face.

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
    extents = [checks.number(name, value, checks.POSITIVE) for name, value in (("length", length), ("height", height))]
    graded, dtype = _grading(graded), checks.float_dtype("dtype", dtype)
    if not isinstance(diagonals, str) or diagonals not in ("one-sided", "mirrored", "crossed"):
        raise ValueError(f"diagonals: expected 'one-sided', 'mirrored' or 'crossed', got {diagonals!r}")
    if diagonals == "mirrored" and ny % 2 == 0:
        raise ValueError(
            f"ny: expected an odd number for mirrored diagonals, got {ny}: no row of nodes lies at mid-height; "
            f"use {ny + 1}, or crossed diagonals, which are symmetric for any ny"
        )
    xp = namespace(*extents)
    unit, elements = _unit_square(*_spacing(nx, ny, graded, extents[0] / extents[1]), diagonals)
    extent = xp.stack([xp.asarray(value, dtype) for value in extents])
    mesh = Mesh(xp.asarray(unit, dtype) * extent, elements)
    return quadratic(mesh) if order == 2 else mesh


def _grading(graded: Any) -> Grading:
    """Check how columns and rows are to be spaced."""
    if isinstance(graded, str) and graded == "proportional":
        return "proportional"
    if isinstance(graded, bool | np.bool_):
        return bool(graded)
    raise ValueError(f"graded: expected True or False, got {graded!r}; the third choice is 'proportional'")


def _spacing(nx: int, ny: int, graded: Grading, aspect: Any) -> tuple[Any, np.ndarray]:
    """Columns `(nx,)` and rows `(ny,)` of a square of side 1 about the origin, that is stretched to this length over
    height. The aspect may be traced.
    """
    columns, rows = np.linspace(-0.5, 0.5, nx), np.linspace(-0.5, 0.5, ny)
    if not graded:
        return columns, rows
    middle = middle_column(nx, graded)
    left, right = np.arange(middle + 1) / middle, np.arange(1, nx - middle) / (nx - 1 - middle)
    if graded is True:
        # Of the factors 2.5, 3 and 3.5, the last gave the least error of the reference beam on most meshes.
        columns = 0.5 * np.append(left**1.5, 1 + np.sinh(3.5 * right) / np.sinh(3.5)) - 0.5
        return columns, 0.6 * rows + 0.2 * np.sin(np.pi * rows)
    xp = namespace(aspect)
    clamp, anchor = CLAMP / aspect, ANCHOR / aspect
    within = _between(left[1:-1], 0.5, clamp, anchor) - 0.5
    beyond = anchor * ((1 + 0.5 / anchor) ** right[:-1] - 1)
    columns = xp.concatenate([np.array([-0.5]), within, np.array([0.0]), beyond, np.array([0.5])])
    rows = _between(np.arange(ny) / (ny - 1), 1.0, FACE, FACE)
    return columns, 0.5 * (rows - rows[::-1])


def _between(shares: np.ndarray, length: float, first: Any, last: Any) -> Any:
    """Places `0 <= x <= length` before which lie these shares of points of density
    `1 / (x + first) + 1 / (length - x + last)`.

    Its integral is `log((x + first) / (length - x + last))` and a constant, which is solved for `x`.
    """
    start, end = first / (length + last), (length + first) / last
    quotient = start * (end / start) ** shares
    return (quotient * (length + last) - first) / (1 + quotient)


def _unit_square(columns: Any, rows: np.ndarray, diagonals: Diagonals) -> tuple[Any, np.ndarray]:
    """Corners `(n, 2)` and triangles `(t, 3)` of the mesh of a square of side 1."""
    nx, ny, xp = len(columns), len(rows), namespace(columns)
    unit_x, unit_y = xp.meshgrid(columns, rows, indexing="ij")
    unit = xp.stack([unit_x.ravel(), unit_y.ravel()], axis=1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nx - 1), np.arange(ny - 1), indexing="ij"))
    lower_left = i * ny + j
    upper_left, lower_right, upper_right = lower_left + 1, lower_left + ny, lower_left + ny + 1
    if diagonals == "crossed":
        centre = nx * ny + np.arange(lower_left.size)
        unit = xp.concatenate([unit, (unit[lower_left] + unit[upper_right]) / 2])
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


def middle_column(nx: int, graded: Grading) -> int:
    """Number of the column of corners of a `rectangle` that lies in the middle of its length.

    Of the cells of a graded mesh two thirds, rounded up, lie in the left half.

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
