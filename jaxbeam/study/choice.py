"""Which model and mesh of the tendon beam to use for an error: a table that was measured.

Ask `choose` first if the body is a tendon beam; for other bodies there is no table, and `solve_to` finds the mesh.

The errors are those of `python -m benchmarks.accuracy --conditions`: of tip angle and tension of the top tendon, the
larger, over ratios from 0.95 to 0.5. Each condition differs from the reference beam in one thing. Times are those of
one solve after compiling, over that of one jump of the reference scene, by `python -m benchmarks.accuracy`.

Largest errors of angle and tension over the ratios 0.95, 0.8, 0.65 and 0.5, in percent. Meshes have six-node triangles,
mirrored diagonals and proportional grading; the tension of the other tendon is smaller and less certain.

| | by hand | rod, 9 nodes | one mesh, 9 x 5 | two, from 7 x 5 | two, from 13 x 7 |
|---|---|---|---|---|---|
| top tendon alone | 9.5 / 24.7 | 1.8 / 5.0 | 0.33 / 0.83 | 0.04 / 0.05 | 0.004 / 0.009 |
| both, at (r, (1 + r) / 2) | 4.2 / 24.9 | 4.7 / 1.3 | 0.57 / 0.73 | 0.08 / 0.06 | 0.02 / 0.009 |
| both, at (r, 0.1 + 0.9 r), to 0.65 | 10.0 / 1.5 | 10.8 / 2.8 | 0.92 / 0.91 | 0.11 / 0.12 | 0.008 / 0.02 |
| length / height 2, to 0.65 | 7.8 / 2.6 | 2.1 / 7.1 | 0.39 / 2.1 | 0.09 / 0.34 | 0.13 / 0.14 |
| length / height 3, to 0.65 | 6.0 / 1.5 | 2.5 / 2.6 | 0.44 / 1.1 | 0.02 / 0.1 | 0.02 / 0.04 |
| length / height 6 | 12.5 / 50 | 1.1 / 6.4 | 0.21 / 0.98 | 0.07 / 0.06 | 0.001 / 0.006 |
| length / height 10 | 28 / 105 | 0.60 / 8.0 | 0.07 / 2.4 | 0.1 / 0.06 | 0.005 / 0.03 |
| Poisson's ratio 0.3, to 0.65 | 10.2 / 34 | 0.39 / 5.7 | 0.29 / 0.43 | 0.04 / 0.05 | 0.004 / 0.005 |
| Poisson's ratio 0.49 | 9.9 / 18.2 | 2.5 / 3.0 | 0.42 / 1.7 | 0.06 / 0.1 | 0.009 / 0.03 |
| tendons 5 times as stiff, to 0.65 | 7.7 / 28 | 2.5 / 2.4 | 0.55 / 1.1 | 0.05 / 0.12 | 0.007 / 0.02 |
| anchors of width 0.125 | 12.0 / 28 | 4.3 / 7.5 | 1.1 / 1.6 | 0.42 / 0.46 | 0.06 / 0.05 |

What else was measured:

- Linear elasticity (`linear_response`) is 24 % off in angle at 0.8. In float32 a residual of 1e-2 is not enough: with
  `Newton(rtol=1e-2)` an angle was 2.1 % off at 0.95.
- At a Poisson's ratio of 0.4999 triangles of three nodes do not bend at all. `tendon_beam(15, 5, order=2, graded=True,
  diagonals="crossed")` is within 0.1 % there. A jump takes a hundred Newton steps, and a `ramp` about twenty in all.
- With point anchors six-node triangles let the jump and the ramp to (0.4, 1.0) end in different stable states.
- Below a ratio of about 0.43 the surface under a tendon creases on fine meshes, a true instability of the material: the
  tension jumps by a half, and no answer is independent of the mesh. It creases earlier on stubby beams (at 0.6 at
  length over height 2), and where the corner of the clamp is resolved to less than a hundredth of the height.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.physics.materials import POISSON
from jaxbeam.scene.beams import rod_beam, tendon_beam
from jaxbeam.scene.scene import Scene
from jaxbeam.study.model_doubt import beyond

# Relative difference up to which a value counts as one that was measured.
NEAR = 1e-6


class Row(NamedTuple):
    """Of one way to solve: the measured time, and the measured errors in percent.

    name: what it is.
    scene: `tendon_beam` or `rod_beam` with its mesh.
    two_meshes: whether it is a solve on two meshes by `corrected`.
    time: over that of one jump of the reference scene.
    reference: error on the reference beam, with one tendon pulled.
    both: with both tendons pulled.
    slenderness, poisson, stiffness, width: at the values of `AXES` that are not those of the reference beam.
    """

    name: str
    scene: Callable[..., Scene]
    two_meshes: bool
    time: float
    reference: float
    both: float
    slenderness: tuple[float, ...]
    poisson: tuple[float, ...]
    stiffness: tuple[float, ...]
    width: tuple[float, ...]


class Axis(NamedTuple):
    """One thing in which beams differ.

    name: in words.
    values: at which errors were measured, increasing.
    reference: which of them is that of the reference beam.
    """

    name: str
    values: tuple[float, ...]
    reference: int

    def factor(self, of_reference: float, elsewhere: tuple[float, ...], value: float) -> float:
        """The larger of the errors measured at the two values around `value`, over that of the reference beam."""
        errors = [*elsewhere[: self.reference], of_reference, *elsewhere[self.reference :]]
        above = min(bisect_left(self.values, value * (1 - NEAR)), len(errors) - 1)
        exact = abs(self.values[above] - value) <= NEAR * value
        return max(errors[above if exact else max(above - 1, 0)], errors[above]) / of_reference


AXES = {
    "slenderness": Axis("length / height", (2, 3, 4.375, 6, 10), 2),
    "poisson": Axis("Poisson's ratio", (0.3, 0.45, 0.49, 0.499), 1),
    "stiffness": Axis("tendon_modulus / (young height^2)", (0.3125, 1.5625), 0),
    "width": Axis("anchor_width / height", (0.15625, 0.3125, 0.625), 1),
}


def _rod(anchor_width: float = 0.0, **description: Any) -> Scene:
    """The rod beam of a description, whose anchors have no width."""
    return rod_beam(9, **description)


SIX = partial(tendon_beam, order=2, graded="proportional", diagonals="mirrored", anchor_width=0.25)
TABLE = (
    Row(
        "a rod of 9 nodes",
        _rod,
        two_meshes=False,
        time=0.45,
        reference=5.0,
        both=11.0,
        slenderness=(7.2, 2.6, 6.4, 8.0),
        poisson=(5.7, 3.0, 2.4),
        stiffness=(2.5,),
        width=(7.5, 2.8),
    ),
    Row(
        "one mesh of six-node triangles, 9 x 5",
        partial(SIX, 9, 5),
        two_meshes=False,
        time=1.3,
        reference=0.83,
        both=0.92,
        slenderness=(2.1, 1.1, 0.98, 2.4),
        poisson=(0.43, 1.7, 1.2),
        stiffness=(1.1,),
        width=(1.6, 0.81),
    ),
    Row(
        "one mesh of six-node triangles, 11 x 5",
        partial(SIX, 11, 5),
        two_meshes=False,
        time=1.8,
        reference=0.61,
        both=0.62,
        slenderness=(1.6, 0.81, 0.68, 1.5),
        poisson=(0.23, 1.5, 0.83),
        stiffness=(0.73,),
        width=(1.0, 0.63),
    ),
    Row(
        "two meshes of six-node triangles, from 7 x 5",
        partial(SIX, 7, 5),
        two_meshes=True,
        time=2.5,
        reference=0.054,
        both=0.12,
        slenderness=(0.34, 0.1, 0.071, 0.1),
        poisson=(0.046, 0.1, 0.18),
        stiffness=(0.12,),
        width=(0.46, 0.028),
    ),
    Row(
        "two meshes of six-node triangles, from 13 x 7",
        partial(SIX, 13, 7),
        two_meshes=True,
        time=6.8,
        reference=0.0087,
        both=0.025,
        slenderness=(0.14, 0.036, 0.0056, 0.034),
        poisson=(0.0052, 0.031, 0.049),
        stiffness=(0.017,),
        width=(0.063, 0.0073),
    ),
)


class Choice(NamedTuple):
    """A way to solve the tendon beam.

    name: what it is, in words.
    scene: builds the scene on its mesh; give it the description of the beam, as `tendon_beam` takes it.
    two_meshes: whether the measured error is that of `corrected(two_meshes(scene), ...)`. If not, of `equilibrium`.
    error: largest relative error of tip angle and tension expected for the description.
    time: expected time of one solve after compiling, over that of the reference scene.
    doubt: where the description lies outside what was measured; empty if it does not.
    """

    name: str
    scene: Callable[..., Scene]
    two_meshes: bool
    error: float
    time: float
    doubt: str


@usual_rules
def choose(
    error: float,
    length: float = 3.5,
    height: float = 0.8,
    young: float = 1e4,
    poisson: float = 0.45,
    tendon_modulus: float = 2e3,
    anchor_width: float = 0.25,
    both: bool = False,
) -> Choice:
    """The cheapest way to solve a tendon beam to an error of its tip angle and tension.

    It reads a table that was measured; nothing is solved. The other arguments describe the beam as those of
    `tendon_beam` do. Where the beam differs from the reference in several things, their effects are multiplied.

    Args:
        error: largest relative error of tip angle and tension that you can live with, such as 0.01.
        length: of the beam.
        height: of the beam.
        young: Young's modulus.
        poisson: Poisson's ratio.
        tendon_modulus: of the law `modulus / l*^2`.
        anchor_width: width of the patch of surface that the free end of a tendon pulls on.
        both: whether both tendons are pulled.

    Raises:
        ValueError: if a number is out of its range, or no measured setting is expected to err by so little.
    """
    error = checks.setting("error", error, checks.POSITIVE)
    described = {"length": length, "height": height, "young": young, "tendon_modulus": tendon_modulus}
    for name, value in described.items():
        checks.setting(name, value, checks.POSITIVE)
    poisson = checks.setting("poisson", poisson, POISSON)
    anchor_width = checks.setting("anchor_width", anchor_width, checks.NOT_NEGATIVE)
    checks.flag("both", both)
    asked = {
        "slenderness": length / height,
        "poisson": poisson,
        "stiffness": tendon_modulus / (young * height**2),
        "width": anchor_width / height,
    }
    outside = [
        words for key, axis in AXES.items() for words in beyond(axis.name, asked[key], axis.values[0], axis.values[-1])
    ]
    doubt = f"outside of what was measured: {'; '.join(outside)}" if outside else ""
    expected = [(_expected(row, asked, both), row) for row in TABLE]
    fit = [(row.time, found, row) for found, row in expected if found <= 100 * error]
    if not fit:
        least = min(found for found, _ in expected)
        raise ValueError(
            f"error: expected at least {least / 100:.2g} for this beam, got {error:g}: no setting that was measured "
            f"errs by less; refine with solve_to, which tells its own error bar"
        )
    time, found, row = min(fit, key=lambda each: each[0])
    return Choice(row.name, row.scene, row.two_meshes, found / 100, time, doubt)


def _expected(row: Row, asked: dict[str, float], both: bool) -> float:
    """The error in percent of a way to solve, for a beam that differs from the reference."""
    error = row.both if both else row.reference
    for key, axis in AXES.items():
        error *= axis.factor(row.reference, getattr(row, key), asked[key])
    return error
