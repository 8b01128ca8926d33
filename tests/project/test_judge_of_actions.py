"""The judge of answers on cables, loads, contact and supports: it agrees with the library, and finds what is false."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import part, scene_of

import jaxbeam as jb
from tests.actions import Action, Cables, Pressure, Pulls, Support, Tendons, Traction, Weight
from tests.energies import Problem, facts
from tests.obstacles import DISTANCES, Contact
from tests.verify import refuted_slope, verify

TOP, BOTTOM = [2, 8], [0, 6]


def beam(*actions: Action, order: int = 1, bent: float = 0.0, tendons: tuple[Tendons, ...] = ()) -> Problem:
    """A beam of 5 x 3 corners, clamped at its left end, away from the origin; `bent` makes its edges curved."""
    mesh = jb.rectangle(3.5, 0.8, 5, 3, "crossed", order=order)
    nodes = np.asarray(mesh.nodes)
    fixed = np.repeat(nodes[:, :1] < -1.7, 2, axis=1)
    nodes = nodes + bent * np.stack([0 * nodes[:, 0], nodes[:, 0] ** 2], axis=1) + np.array([2.0, -1.0])
    return Problem(nodes, mesh.elements, fixed, 1e4, 0.45, "macklin_mueller", tendons, actions=actions)


def on(order: int, *sides: str) -> np.ndarray:
    """Nodes on sides of the beam."""
    x, y = (beam(order=order).nodes - [2.0, -1.0]).T
    where = {"top": y > 0.39, "bottom": y < -0.39, "tip": x > 1.74}
    return np.flatnonzero(np.any([where[side] for side in sides], axis=0))


def cables(order: int = 1) -> tuple[Problem, np.ndarray]:
    """One that is taut and one that is slack."""
    raw = beam(Cables(np.array([TOP, BOTTOM]), [2e3, 1e3], "inverse-square", transition=0.02), order=order)
    return raw, np.array([0.7, 1.05])


def pulls(order: int = 1) -> tuple[Problem, np.ndarray]:
    """Beside a tendon."""
    wide = Pulls(np.array([TOP, BOTTOM]), [[0.0, 0.9]] * 2)
    raw = beam(wide, order=order, tendons=(Tendons(np.array([[1, 7, 10]]), 1e3, "constant"),))
    return raw, np.array([0.9, 300.0, 0.0])


def loads(order: int = 1) -> tuple[Problem, np.ndarray]:
    """Pressure acts from the clamp round the tip to the clamp."""
    around, tip = on(order, "top", "bottom", "tip"), on(order, "tip")
    actions = (Weight([10.0, -30.0]), Traction(tip, [-5.0, 20.0]), Pressure(around))
    return beam(*actions, order=order, bent=0.02), np.array([500.0])


def cavity(order: int = 1) -> tuple[Problem, np.ndarray]:
    """Pressure on a hole."""
    mesh = jb.rectangle(3.5, 0.8, 7, 4)
    centres = np.asarray(mesh.nodes)[mesh.elements].mean(axis=1)
    mesh = part(mesh, ~(np.abs(centres) < [0.6, 0.13]).all(axis=1))
    mesh = jb.quadratic(mesh) if order == 2 else mesh
    nodes = np.asarray(mesh.nodes)
    hole = np.flatnonzero((np.abs(nodes) < [0.7, 0.2]).all(axis=1))
    fixed = np.repeat(nodes[:, :1] < -1.7, 2, axis=1)
    raw = Problem(nodes, mesh.elements, fixed, 1e4, 0.45, "macklin_mueller", (), actions=(Pressure(hole),))
    return raw, np.array([800.0])


def contact(shape: str, order: int = 1) -> tuple[Problem, np.ndarray]:
    """An obstacle that presses from below, beside a tendon."""
    place, more = {
        "half-plane": ([2.0, -1.7], [-0.1, 1.0]),
        "disk": ([3.0, -2.2], 0.75),
        "box": ([3.2, -2.2], [1.1, 1.0, 20.0]),
    }[shape]
    touching = Contact(on(order, "bottom", "tip"), shape, place, more, 1e5, 0.02, (0.1, 2.0))
    return beam(touching, order=order, tendons=(Tendons(np.array([TOP]), 2e3, "inverse-square"),)), np.array([0.9, 0.4])


def supports(order: int = 1) -> tuple[Problem, np.ndarray]:
    """One holds the tip in x; the other moves a node both ways."""
    tip = on(order, "tip")
    grip = Support(tip, np.stack([np.linspace(1.0, 1.2, len(tip)), np.full(len(tip), np.nan)], axis=1))
    more = Support(np.array([7]), np.array([[0.5, 1.0]]))
    return beam(grip, more, order=order, bent=0.02), np.array([0.5, 0.2])


def turned(order: int = 1) -> tuple[Problem, np.ndarray]:
    """A rod whose end is turned, and lifted."""
    nodes, fixed = np.zeros((5, 3)), np.zeros((5, 3), bool)
    nodes[:, 0], fixed[0] = np.linspace(0, 4, 5), True
    pairs, end = np.stack([np.arange(4), np.arange(1, 5)], axis=1), Support(np.array([4]), np.array([[np.nan, 0.5, 1]]))
    raw = Problem(nodes, pairs, fixed, 1e4, 0.3, "macklin_mueller", (), height=0.5, radian=0.5, actions=(end,))
    return raw, np.array([0.4])


def everything(order: int = 1) -> tuple[Problem, np.ndarray]:
    """Commands of all kinds in one scene, some for several lines."""
    disk, moved = contact("disk", order)[0].actions[0], supports(order)[0].actions[1]
    lines = np.array([TOP, BOTTOM])
    actions = (Pulls(lines, shared=True), *loads(order)[0].actions, Cables(lines, 1e3, "inverse"), disk, moved)
    raw = beam(*actions, order=order, tendons=(Tendons(lines, 1e3, "constant", shared=True),))
    return raw, np.array([0.9, 50.0, 100.0, 0.8, 0.9, 0.35, 0.1])


SCENES = {
    "cables": cables,
    "pulls": pulls,
    "loads": loads,
    "cavity": cavity,
    **{shape: lambda order=1, shape=shape: contact(shape, order) for shape in DISTANCES},
    "supports": supports,
    "turned": turned,
    "everything": everything,
}


# --------------------------------------------------------------------------- the judge and the library agree


def deformed(raw: Problem, ratios: np.ndarray, size: float, seed: int) -> np.ndarray:
    """A random state whose held coordinates are at their places."""
    moved = size * np.random.default_rng(seed).normal(size=raw.nodes.shape)
    return raw.nodes + np.where(raw.held, raw.displacements(ratios), moved)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("name", SCENES)
def test_energy_and_its_derivatives_are_the_librarys(name, order):
    raw, ratios = SCENES[name](order)
    scene = jb.command(scene_of(raw), ratios)
    np.testing.assert_array_equal(raw.held, scene.held)
    np.testing.assert_array_equal(raw.rest_commands, jb.scene.scene.rest_commands(scene))
    both = jax.jit(lambda x: (jax.value_and_grad(jb.energy, argnums=1)(scene, x), jax.hessian(jb.energy, 1)(scene, x)))
    free = ~raw.held.ravel()
    for seed, size in enumerate((0.01, 0.05)):
        x = deformed(raw, ratios, size, seed)
        (energy, gradient), hessian = jax.tree.map(np.asarray, both(jnp.asarray(x)))
        true = facts(raw, ratios, x)
        np.testing.assert_allclose(true.energy, energy, rtol=1e-10)
        np.testing.assert_allclose(true.gradient, gradient.ravel()[free], atol=1e-10 * true.scale)
        rows = hessian.reshape(x.size, x.size)[free]
        np.testing.assert_allclose(true.rows.toarray(), rows, atol=1e-10 * true.stiffest)
        np.testing.assert_allclose(true.hessian, rows[:, free], atol=1e-10 * true.stiffest)


# Dear to compile; the order of its commands is compared above.
COSTLY = ("everything", "turned", "box", "half-plane")
DEAR = [pytest.param(name, marks=pytest.mark.slow) if name in COSTLY else name for name in SCENES]


@pytest.mark.parametrize("name", DEAR)
def test_an_honest_answer_and_its_slope_are_accepted(name):
    raw, ratios = SCENES[name]()
    scene = scene_of(raw)
    answer = jb.check(jb.equilibrium(jb.command(scene, ratios)))
    verdict = verify(raw, ratios, answer)
    assert verdict.refuted == [] and verdict.off < 1e-6
    place = lambda r: jb.tip_position(scene, jb.equilibrium(jb.command(scene, r)).x)
    slope = np.asarray(jax.jacfwd(place)(jnp.asarray(ratios)))
    assert refuted_slope(raw, ratios, answer.x, scene.tip, slope) == []
    for k in np.flatnonzero(np.abs(slope).max(axis=0) > 0):
        wrong = slope.copy()
        wrong[:, k] *= 1.0001
        assert "slope off" in refuted_slope(raw, ratios, answer.x, scene.tip, wrong)[0]


# ---------------------------------------------------------------------------------------- planted errors


def solve(raw: Problem, ratios: np.ndarray, **options) -> jb.Solution:
    return jb.equilibrium(jb.command(scene_of(raw), ratios), **options)


def words(raw: Problem, command: np.ndarray, answer: jb.Solution, /, **claims) -> str:
    """What is refuted of an answer that claims something else."""
    told = dataclasses.replace(jax.tree.map(np.asarray, answer), **{k: np.asarray(v) for k, v in claims.items()})
    return " ".join(verify(raw, command, told).refuted)


def restated(raw: Problem, ratios: np.ndarray, x: np.ndarray, **more) -> dict:
    """Claims about the state `x` that are true, beside those given."""
    true = facts(raw, ratios, x, dense=False)
    return {"x": x, "energy": true.energy, "smallest_jacobian": true.volumes.min(), "ratios": ratios, **more}


def test_a_slack_cable_that_pushes_is_refuted():
    raw, ratios = cables()
    (ropes,) = raw.actions
    two_way = dataclasses.replace(raw, tendons=(Tendons(ropes.lines, ropes.modulus, ropes.law),), actions=())
    wrong = np.asarray(jb.check(solve(two_way, ratios)).x)
    answer = solve(raw, ratios)
    assert words(raw, ratios, answer) == ""
    assert "over the tolerance" in words(raw, ratios, answer, **restated(raw, ratios, wrong))


def test_another_tension_is_refuted():
    raw, ratios = pulls()
    more = ratios + np.array([0.0, 0.01, 0.0])
    answer = solve(raw, ratios)
    assert "over the tolerance" in words(raw, more, answer, **restated(raw, more, np.asarray(answer.x)))
    # A command of zero has no tolerance.
    assert "are not the command" in words(raw, ratios, answer, ratios=ratios + np.array([0.0, 0.0, 1e-12]))
    assert "are not the command" not in words(raw, ratios, answer, ratios=ratios * (1 + 2e-16))


def test_a_pressure_that_does_not_follow_the_surface_is_refuted():
    """It is a dead load: the forces of the pressure at rest."""
    raw, ratios = loads()
    pushed = facts(dataclasses.replace(raw, actions=raw.actions[2:]), ratios, raw.nodes, dense=False)
    dead = np.zeros(raw.nodes.shape)
    dead[~raw.held] = -pushed.gradient
    wrong = solve(dataclasses.replace(raw, load=dead, actions=raw.actions[:2]), ratios[:0])
    answer = solve(raw, ratios)
    found = words(raw, ratios, answer, **restated(raw, ratios, np.asarray(jb.check(wrong).x)))
    assert "over the tolerance" in found and "of the body away" in found


@pytest.mark.parametrize("name", ["pulls", "loads", "disk", "supports"])
def test_a_wrong_energy_is_refuted(name):
    raw, ratios = SCENES[name]()
    answer = solve(raw, ratios)
    assert "energy" in words(raw, ratios, answer, energy=answer.energy * (1 + 1e-9))


def test_a_support_off_its_place_is_refuted():
    raw, ratios = supports()
    answer, off = solve(raw, ratios), np.zeros(raw.nodes.shape)
    off[on(1, "tip")[0], 0] = 1e-12
    assert "is not where" in words(raw, ratios, answer, x=np.asarray(answer.x) + off)
    # What it leaves free balances.
    assert "over the tolerance" in words(raw, ratios, answer, x=np.asarray(answer.x) + 1e6 * np.roll(off, 1, axis=1))


def test_a_saddle_between_supports_is_refuted():
    """A straight beam, pressed together."""
    mesh = jb.rectangle(3.5, 0.2, 9, 3, "mirrored")
    nodes, fixed = np.asarray(mesh.nodes), np.zeros(mesh.nodes.shape, bool)
    fixed[:3] = True
    grip = Support(np.arange(24, 27), np.tile([-1.0, 0.0], (3, 1)))
    raw = Problem(nodes, mesh.elements, fixed, 1e4, 0.3, "macklin_mueller", (), actions=(grip,))
    answer = solve(raw, np.array([0.4]), solver=jb.Newton(escape=False))
    assert answer.status & jb.Status.UNSTABLE and words(raw, np.array([0.4]), answer) == ""
    assert "but an eigenvalue is -" in words(raw, np.array([0.4]), answer, status=0)


@pytest.mark.parametrize("shape", DISTANCES)
def test_an_obstacle_in_the_body_is_refuted(shape):
    """The lower side of the beam looks along the way out."""
    raw, ratios = contact(shape)
    answer = solve(raw, ratios)
    (touching,) = raw.actions
    place = {"half-plane": [2.0, -1.6], "disk": [2.5, -1.0], "box": [2.5, -1.0]}[shape]
    more = {"half-plane": [0.0, -1.0], "disk": 0.6, "box": [1.5, 1.0, 5.0]}[shape]
    raw = dataclasses.replace(raw, actions=(dataclasses.replace(touching, place=place, more=more, direction=(0, 1)),))
    ratios = np.array([0.9, 0.0])
    true = restated(raw, ratios, raw.nodes)
    found = words(raw, ratios, answer, **true)
    assert "but not INVERTED" in found and "smallest J 1, but it is -" in found
    cosines = {"half-plane": 1.0, "disk": None, "box": np.cos(np.deg2rad(5.0))}
    if cosines[shape] is not None:
        true["smallest_jacobian"] = -cosines[shape]
        found = words(raw, ratios, answer, status=jb.Status.INVERTED, **true)
        assert "INVERTED" not in found and "smallest J" not in found


@pytest.mark.parametrize(("shape", "more"), [("disk", 0.25), ("box", [0.4, 0.3, 5.0])])
def test_an_obstacle_that_the_body_has_closed_about_is_refuted(shape, more):
    """No point of the surface is in it, and nothing pushes."""
    raw, ratios = contact(shape)
    answer = solve(raw, ratios)
    small = dataclasses.replace(raw.actions[0], place=[2.5, -1.0], more=more)
    raw, ratios = dataclasses.replace(raw, actions=(small,)), np.array([1.0, 0.0])
    true = restated(raw, ratios, raw.nodes, reached=1.0)
    assert words(raw, ratios, answer, **true) == f"the {shape} lies in the body, but not INVERTED"
    # Beside the body it is no matter.
    raw = dataclasses.replace(raw, actions=(dataclasses.replace(small, place=[2.5, -0.2]),))
    assert words(raw, ratios, answer, **restated(raw, ratios, raw.nodes)) == ""


def test_what_is_untouched_is_not_inverted():
    raw, ratios = contact("disk")
    answer = solve(raw, ratios)
    assert "INVERTED, but the smallest J" in words(raw, ratios, answer, status=jb.Status.INVERTED)


@pytest.mark.parametrize("name", ["pulls", "loads", "supports"])
def test_a_walk_that_broke_off_halfway_is_an_equilibrium_there(name):
    """At half of the way from the commands of rest, with half of the dead loads, and supports half of the way."""
    raw, ratios = SCENES[name]()
    halved = [
        dataclasses.replace(a, per_area=np.array(a.per_area) / 2) if isinstance(a, Weight) else a for a in raw.actions
    ]
    halved = [
        dataclasses.replace(a, per_length=np.array(a.per_length) / 2) if isinstance(a, Traction) else a for a in halved
    ]
    way = (raw.rest_commands + ratios) / 2
    x = np.asarray(jb.check(solve(dataclasses.replace(raw, actions=tuple(halved)), way)).x)
    broken = {"status": jb.Status.NOT_CONVERGED, "reached": 0.5}
    answer = solve(raw, ratios)
    assert words(raw, ratios, answer, **restated(raw, ratios, x, **broken)) == ""
    found = words(raw, ratios, answer, **restated(raw, ratios, x, **broken | {"reached": 0.4}))
    assert ("is not where" if name == "supports" else "of the way") in found
