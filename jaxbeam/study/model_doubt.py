"""Where the cheaper models of the tendon beam were measured, and what is to be doubted elsewhere.

Ask `model_doubt` of a rod before you rely on it. Of triangles `estimate_error` tells the error.

The hand calculation and the rod have the error of their assumptions, which no finer mesh shows. It was measured against
six-node triangles (19 x 9 corners, proportional, anchors of width 0.25) of the material `macklin_mueller`, on beams of
length over height 2, 3, 4, 4.375, 6 and 10, at Poisson's ratio 0.3, 0.45 and 0.49, with tendons of a fifth, once and
five times the modulus of the reference scene, and with one tendon shortened or both. The ranges below are those where
it stayed small.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import jax
import numpy as np

from jaxbeam.core.tree import is_concrete
from jaxbeam.physics.materials import Lame, macklin_mueller
from jaxbeam.physics.rod import RodEnergy
from jaxbeam.physics.rod_tendon import RodTendonEnergy
from jaxbeam.scene.scene import Scene, check_scene

# Ratios this near to 1 count as not pulled, and figures this near to the end of a range as within it.
NEAR = 1e-6


class Measured(NamedTuple):
    """The range in which the tip angle and the tension of the shortened tendon were measured to be within `error`.

    One tendon is shortened, at least to `ratio`. The other is at its natural length, or commanded to be longer by at
    most half as much.

    error: in percent.
    ratio: least ratio of the shortened tendon.
    slenderness: range of length over height.
    poisson: range of Poisson's ratio.
    stiffness: range of `k a^2 / (E H^2)`, with `k` the stiffness of a tendon at its natural length `a`. With the law
        `modulus / l*^2` it is `modulus / (E H^2)`.
    both: largest error, in percent, that was found on the reference beam with both tendons shortened.
    """

    error: float
    ratio: float
    slenderness: tuple[float, float]
    poisson: tuple[float, float]
    stiffness: tuple[float, float]
    both: float


ROD = Measured(8, 0.5, (4, 10), (0.45, 0.49), (0.06, 0.32), both=41)
BY_HAND = Measured(6, 0.8, (2, 6), (0.45, 0.49), (0.06, 0.32), both=26)


def outside(measured: Measured, ratios: Any, slenderness: Any, poisson: Any, stiffness: Any) -> str:
    """What lies outside the range, in words; empty if nothing does.

    Args:
        measured: the range.
        ratios: `(2,)` commands of both tendons.
        slenderness: length over height.
        poisson: Poisson's ratio, scalar or an array.
        stiffness: `k a^2 / (E H^2)`, scalar or an array.
    """
    least, other = np.sort(np.asarray(ratios, float))
    found = []
    if least < measured.ratio - NEAR:
        found.append(f"a tendon at ratio {least:.4g} (known down to {measured.ratio})")
    if other < 1 - NEAR:
        found.append(f"both tendons are shortened (errors of up to {measured.both} % were found)")
    if other - 1 > max((1 - least) / 2, 0) + NEAR:
        found.append(f"a tendon that is commanded to be longer, at ratio {other:.4g}")
    for name, values, (low, high) in (
        ("length / height", slenderness, measured.slenderness),
        ("Poisson's ratio", poisson, measured.poisson),
        ("stiffness of the tendons, k a^2 / (E H^2),", stiffness, measured.stiffness),
    ):
        found += beyond(name, values, low, high)
    return f"the error is not known to stay below {measured.error} %: {'; '.join(found)}" if found else ""


def beyond(name: str, values: Any, low: float, high: float) -> list[str]:
    """The first of some figures that lies outside a range, in words; empty if none does."""
    flat = np.ravel(np.asarray(values, float))
    off = flat[~((flat >= low - NEAR) & (flat <= high + NEAR))]
    return [f"{name} {off[0]:.4g} (known from {low} to {high})"] if off.size else []


def model_doubt(scene: Scene) -> str:
    """What speaks against trusting the model of a scene, in words; empty if nothing is known to.

    Of a rod it tells what lies outside the range in which its error was measured (see `rod_beam`). A scene of triangles
    is not a model to be doubted here: `estimate_error` tells the error of its mesh.

    Args:
        scene: under its commands; concrete.

    Raises:
        ValueError: if the scene is traced.
    """
    check_scene(scene)
    if not is_concrete(*jax.tree.leaves(scene)):
        raise ValueError("scene: expected concrete numbers, got traced ones; ask for doubts outside jit")
    if not scene.mesh.is_line:
        return ""
    kinds = [type(term.kind) for term in scene.terms]
    if kinds != [RodEnergy, RodTendonEnergy] or not _is_tendon_beam(scene):
        return "its error was measured only on a straight rod with a tendon along half of each side, as rod_beam makes"
    (body, rod), (pull, tendon) = ((term.params, cast(Any, term.kind)) for term in scene.terms)
    if rod.density is not macklin_mueller or not isinstance(body.material, Lame):
        return "its error was measured only with the material macklin_mueller"
    mu, lam, height = (np.asarray(each) for each in (body.material.mu, body.material.lam, body.height))
    young, poisson = mu * (3 * lam + 2 * mu) / (lam + mu), lam / (2 * (lam + mu))
    natural = np.asarray(pull.natural)
    k = np.asarray(jax.vmap(tendon.stiffness)(pull.modulus, pull.natural))
    stiffness = (k * natural**2)[:, None] / (young * height**2)
    return outside(ROD, pull.commanded / natural, 2 * natural[0] / height[0], poisson, stiffness)


def _is_tendon_beam(scene: Scene) -> bool:
    """Whether a rod with tendons is straight, of one height, clamped at one end, and steered as in `rod_beam`."""
    body, pull = scene.terms
    nodes, height = np.asarray(scene.mesh.nodes), np.asarray(body.params.height)
    natural, sides = np.asarray(pull.params.natural), np.asarray(pull.params.attachment.eccentricity)
    length, near = np.hypot(*np.ptp(nodes[:, :2], axis=0)), 1e-4
    return bool(
        np.flatnonzero(scene.held.any(axis=1)).tolist() == [0]
        and np.ptp(nodes[:, 2]) <= near * height[0]
        and np.ptp(height) <= near * height[0]
        and pull.nodes.shape == (2, 2)
        and (pull.nodes[:, 0] == 0).all()
        and np.allclose(natural, length / 2, rtol=near)
        and np.allclose(sides, height[0] / 2 * np.array([[1, 1], [-1, -1]]), rtol=near)
    )
