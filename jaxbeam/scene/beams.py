"""The reference scenes: the tendon beam made of triangles, and as a rod.

The defaults of `tendon_beam` are the reference scene, to compare with other codes: at ratio 0.8 its angle is 13 % too
small. For accurate answers set `order=2`, `graded="proportional"` and an `anchor_width`, or let `choose` do so.
`rod_beam` takes half of the time, and `model_doubt` says where its error is not known.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, is_concrete, namespace
from jaxbeam.mesh.bodies import Shape, mapped
from jaxbeam.mesh.line import straight
from jaxbeam.mesh.mesh import with_middles
from jaxbeam.mesh.rectangle import Diagonals, Grading, middle_column, rectangle
from jaxbeam.physics.materials import lame, macklin_mueller
from jaxbeam.physics.rod import rod
from jaxbeam.physics.rod_tendon import rod_tendons
from jaxbeam.physics.solid import solid
from jaxbeam.physics.tendon import inverse_square_stiffness, tendons
from jaxbeam.scene.scene import Scene, clamped


@usual_rules
def tendon_beam(
    nx: int = 29,
    ny: int = 7,
    length: Numbers = 3.5,
    height: Numbers = 0.8,
    young: Numbers = 1e4,
    poisson: Numbers = 0.45,
    tendon_modulus: Numbers = 2e3,
    *,
    order: int = 1,
    degree: int | None = None,
    anchor_width: float = 0.0,
    graded: Grading = False,
    diagonals: Diagonals = "one-sided",
    density: Callable[[jax.Array, Any], jax.Array] = macklin_mueller,
    stiffness: Callable[[jax.Array, jax.Array], jax.Array] = inverse_square_stiffness,
    dtype: Any = None,
    shape: Shape | None = None,
) -> Scene:
    """The reference scene: a cantilever clamped at its left edge, with a tendon along half of each side.

    The first tendon joins the top-left and the top-middle node, the second the bottom-left and the
    bottom-middle node. Both are at their natural length, which is half the length of the beam.

    Tip angle in degrees and tendon lengths of the default scene, found by two independent codes that agree to 1e-6
    degrees:

    | ratios (top, bottom) | tip angle | top, bottom length |
    |---|---|---|
    | 0.4, 1.0 | +35.5152802 | 0.9342211, 1.9252493 |
    | 1.0, 0.4 | -34.9502718 | 1.9273442, 0.9245819 |
    | 0.4, 0.4 by a 28-step ramp | -5.0890962 | 1.1427431, 1.1117417 |
    | 0.6, 1.4 | +27.34482 | 1.3535891, 1.9618369 |
    | 0.8, 1.2 | +13.35328 | 1.5992734, 1.8613796 |
    | 1.2, 0.8 | -13.39917 | 1.8621798, 1.5956198 |
    | 1.4, 0.6 | -27.24722 | 1.9664928, 1.3406140 |

    They are the answers of this mesh, whose triangles lock: at 0.8 the converged angle is 13 % larger. A ramp to
    (0.4, 0.4) crosses a fold, and the beam jumps. A code that stops Newton's method at a cap of steps reports -3.4
    degrees there, which is no equilibrium. The tendons are two-way: at (1.2, 1) the top one pushes with 125. `cables`
    of the same nodes and modulus do not push: at (0.6, 1.4) the slack one has no tension, and the angle is 24.06.

    Args:
        nx: number of triangle corners along the length. It must be odd unless `graded`, so that one lies in the middle.
        ny: number of corners along the height.
        length: of the beam, positive.
        height: of the beam, positive.
        young: Young's modulus, scalar or one for each triangle. Forces come out in its unit x length.
        poisson: Poisson's ratio, scalar or one for each triangle; `lame` turns both into Lame parameters.
        tendon_modulus: scalar or `(2,)`; its unit depends on `stiffness`.
        order: 1 for triangles of three nodes, which lock as `poisson` nears 0.5; 2 for six nodes (see `rectangle`).
        degree: of the quadrature, see `solid`.
        anchor_width: width of the surface patches that the unclamped ends of the tendons pull on, see `tendons`. At 0
            they pull on single nodes, and the answer drifts as the mesh is refined: with the top tendon at ratio 0.8,
            six-node triangles on 15 x 5, 29 x 7 and 57 x 13 corners give 9.77, 9.68 and 9.46 degrees. With a width of
            0.25 they give 10.14 on each.
        graded: True or "proportional" to crowd nodes at the clamp, the faces and the middle, where the tendons end; see
            `rectangle`. The second converges faster.
        diagonals: see `rectangle`.
        density: the material, see `jaxbeam.physics.materials`.
        stiffness: the law of the tendons, see `tendons`.
        dtype: of everything computed; by default JAX's float.
        shape: a map `(x, y) -> (x, y)` from the rectangle, which is centred on the origin, to the body at rest, such as
            a taper (see `mapped`). Clamp, tip and the ends of the tendons move with it. A tendon is a straight line
            between its ends also in a bent body; for guides along the surface use `side`, `along` and `tendons`.

    Returns:
        A `Scene`, differentiable in every real argument, and in all that `shape` uses.

    Raises:
        ValueError: if `nx` is even and the mesh not graded, an anchor of finite width is asked for on a body whose
            length, height or shape is traced, or as `rectangle`, `mapped`, `lame` and `tendons` do.
    """
    mesh = rectangle(length, height, nx, ny, diagonals, dtype, order=order, graded=graded)
    mesh = mesh if shape is None else mapped(mesh, shape)
    anchor_width = checks.setting("anchor_width", anchor_width, checks.NOT_NEGATIVE)
    if anchor_width and not is_concrete(mesh.nodes):
        raise ValueError(
            f"anchor_width: expected 0 on a body whose length, height or shape is traced, got {anchor_width:g}: an "
            f"anchor of finite width needs concrete nodes; build the scene outside jit and grad, or use 0"
        )
    bottom_left, top_left = 0, ny - 1
    bottom_middle = middle_column(nx, graded) * ny
    body = solid(mesh, lame(young, poisson), density, degree)
    pair = [[top_left, bottom_middle + ny - 1], [bottom_left, bottom_middle]]
    left, right = (with_middles(mesh, corners) for corners in (np.arange(ny), (nx - 1) * ny + np.arange(ny)))
    pulls = tendons(mesh, pair, tendon_modulus, stiffness, np.array([[0.0, anchor_width]] * 2))
    return Scene(mesh, (body, pulls), clamped(mesh, left), right)


@usual_rules
def rod_beam(
    nodes: int = 9,
    length: Numbers = 3.5,
    height: Numbers = 0.8,
    young: Numbers = 1e4,
    poisson: Numbers = 0.45,
    tendon_modulus: Numbers = 2e3,
    *,
    density: Callable[[jax.Array, Any], jax.Array] = macklin_mueller,
    stiffness: Callable[[jax.Array, jax.Array], jax.Array] = inverse_square_stiffness,
    dtype: Any = None,
) -> Scene:
    """The reference scene as a rod (see `jaxbeam.physics.rod`): a cantilever with a tendon along half of each side.

    It has the error of its assumptions beside that of its nodes: sections stay plane, and a tendon pulls on all of a
    section. Against converged triangles with anchors of width 0.25, nine nodes are within 8 % in the tip angle and in
    the tension of the shortened tendon, if one tendon is shortened, to 0.5 or more, length over height is 4 to 10,
    Poisson's ratio 0.45 to 0.49, and `tendon_modulus / (young height^2)` 0.06 to 0.32. Outside they were found off by
    up to 41 % in angle on the reference beam with both tendons shortened nearly alike, by 24 % in tension at length
    over height 2 and Poisson's ratio 0.49, and by 18 % with tendons five times as stiff. The tension of the other
    tendon, which is small, is worse: 25 % off at length over height 2, and more where it is nearly slack. `model_doubt`
    tells what of a scene lies outside that range.

    Args:
        nodes: number of nodes along the axis, odd, so that one lies in the middle. With one tendon shortened to 0.5 or
            more, nine are within 0.6 % of the angle of many on the reference beam, and within 1.6 % at length over
            height 10. With both shortened nearly alike, at ratios (0.5, 0.55), they are 15 % off. The error falls with
            the square of the number.
        length: of the beam, positive.
        height: of the beam, positive.
        young: Young's modulus, scalar or one for each element. Forces come out in its unit x length.
        poisson: Poisson's ratio, scalar or one for each element; `lame` turns both into Lame parameters.
        tendon_modulus: scalar or `(2,)`; its unit depends on `stiffness`.
        density: the material, see `jaxbeam.physics.materials`. In the default, as in `tendon_beam`, Young's modulus
            1e4 and Poisson's ratio 0.45 behave as 9962 and 0.4444 at small strain; `neo_hookean` keeps 1e4 and 0.45.
            `linear_elastic` makes Simo's rod, whose forces are linear in its strains.
        stiffness: the law of the tendons, see `tendons`.
        dtype: of everything computed; by default JAX's float.

    Returns:
        A `Scene`, differentiable in every real argument. Positions `x` are `(n, 3)`. The third column is the height
        times the angle of the section in radians.

    Raises:
        ValueError: if `nodes` is even, or as `lame`, `rod` and `rod_tendons` do.
    """
    height = checks.number("height", height, checks.POSITIVE)
    line = straight(length, height, nodes, dtype)
    if nodes % 2 == 0:
        raise ValueError(
            f"nodes: expected an odd number, got {nodes}: no node lies in the middle, where the tendons end; use "
            f"{max(nodes - 1, 3)} or {nodes + 1}"
        )
    body = rod(line, height, lame(young, poisson), density)
    xp = namespace(height)
    sides = xp.asarray([[0.5, 0.5], [-0.5, -0.5]]) * height
    pulls = rod_tendons(line, [[0, (nodes - 1) // 2]] * 2, sides, tendon_modulus, stiffness)
    return Scene(line, (body, pulls), clamped(line, [0]), np.array([nodes - 1]))
