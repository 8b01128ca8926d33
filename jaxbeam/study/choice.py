"""Which model and mesh of the tendon beam to use for an error: a table that was measured.

The errors are those of `python -m benchmarks.accuracy --conditions`: of tip angle and tension of the top tendon, the
larger, over ratios from 0.95 to 0.5. Each condition differs from the reference beam in one thing. Times are those of
one solve after compiling, over that of one jump of the reference scene, by `python -m benchmarks.accuracy`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.scene.beams import rod_beam, tendon_beam
from jaxbeam.scene.scene import Scene


class Row(NamedTuple):
    """Of one way to solve: the measured time, and the measured errors in percent.

    name: what it is.
    scene: `tendon_beam` or `rod_beam` with its mesh.
    two_meshes: whether it is a solve on two meshes by `corrected`.
    time: over that of one jump of the reference scene.
    reference: error on the reference beam, with one tendon pulled.
    both: with both tendons pulled.
    slenderness: at length over height 2, 3, 6 and 10.
    poisson: at Poisson's ratio 0.3, 0.49 and 0.499.
    stiff: with tendons five times as stiff.
    width: with anchors of 0.125 and 0.5.
    """

    name: str
    scene: Callable[..., Scene]
    two_meshes: bool
    time: float
    reference: float
    both: float
    slenderness: tuple[float, float, float, float]
    poisson: tuple[float, float, float]
    stiff: float
    width: tuple[float, float]


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
