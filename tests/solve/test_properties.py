"""Random scenes: every claim of an answer holds, and nothing depends on frame, numbering, mirror or units.

Compiling takes longer than solving, so the examples share a few programs: a mesh size, a material, a tendon law, a
dtype and a linear solver. All else is drawn: shape, jitter, diagonals, numbering, anchors, moduli, commands.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from helpers import scene_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jaxbeam as jb
from tests.verify import Problem, Tendons, density, facts, total_energy, verify


@dataclasses.dataclass(frozen=True)
class Program:
    """What is compiled once. `guides` nodes lie on each tendon between its ends. A banded matrix has a layout that
    depends on diagonals and anchors, so these are free only where the matrix is dense."""

    nx: int
    ny: int
    material: str
    law: str
    dtype: str = "float64"
    guides: int = 0
    dense: bool = True
    ramp: int = 0

    @property
    def solver(self) -> jb.Newton:
        return jb.Newton(linear=jb.Dense() if self.dense else jb.BlockTridiagonal())


BANDED = Program(7, 4, "neo_hookean", "inverse-square", dense=False)
PROGRAMS = (
    BANDED,
    Program(5, 3, "macklin_mueller", "inverse-square"),
    Program(5, 3, "macklin_mueller", "inverse-square", "float32"),
    Program(5, 3, "saint_venant_kirchhoff", "inverse", guides=1),
)
SLOW_PROGRAMS = (
    *PROGRAMS,
    Program(5, 3, "neo_hookean", "constant", "float32"),
    Program(5, 3, "neo_hookean", "inverse-square", ramp=7),
    Program(7, 4, "linear_elastic", "inverse", guides=1),
    Program(7, 4, "macklin_mueller", "inverse-square", dense=False),
)


@dataclasses.dataclass(frozen=True)
class Drawn:
    """One scene of a program. `seed` draws what has no scale: jitter, diagonals, numbering, anchors."""

    program: Program
    seed: int
    ratios: tuple[float, float]
    height: float = 0.25
    poisson: float = 0.45
    factor: float = 1.0
    spread: float = 0.0
    jitter: float = 0.0


def logarithmic(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers evenly spread in their logarithm; they shrink towards 1."""
    return st.floats(np.log10(low), np.log10(high)).map(lambda power: float(10**power))


def scenes(programs: tuple[Program, ...]) -> st.SearchStrategy[Drawn]:
    ratio = logarithmic(0.02, 3)
    return st.builds(
        Drawn,
        program=st.sampled_from(programs),
        seed=st.integers(0, 2**31 - 1),
        ratios=st.tuples(ratio, ratio),
        height=logarithmic(0.02, 1),
        poisson=st.one_of(st.floats(0, 0.49), st.sampled_from([0.499, 0.4999])),
        factor=logarithmic(1e-3, 1e6),
        spread=st.floats(0, 1),
        jitter=st.floats(0, 0.2),
    )


def problem(drawn: Drawn) -> Problem:
    """The raw arrays of a random scene of unit length, clamped along its left side."""
    program, rng = drawn.program, np.random.default_rng(drawn.seed)
    nx, ny = program.nx, program.ny
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"))
    grid = np.stack([i, j], axis=1).astype(float)
    inner = (i > 0) & (i < nx - 1) & (j > 0) & (j < ny - 1)
    grid[inner] += drawn.jitter * rng.uniform(-1, 1, (inner.sum(), 2))
    nodes = grid / [nx - 1, ny - 1] * [1, drawn.height]

    low = (i * ny + j)[(i < nx - 1) & (j < ny - 1)]
    a, b, c, d = low, low + ny, low + ny + 1, low + 1
    falling = rng.random(low.size) < 0.5 if program.dense else np.zeros(low.size, bool)
    first = np.stack([a, b, np.where(falling, d, c)], axis=1)
    second = np.stack([np.where(falling, b, a), c, d], axis=1)
    elements = np.concatenate([first, second])
    middle = (nx - 1) // 2 * ny
    lines = np.array([[ny - 1, middle + ny - 1], [0, middle]])
    if program.dense:
        lines = np.stack([rng.choice(len(nodes), 2 + program.guides, replace=False) for _ in range(2)])

    # A renumbering of the nodes, of the triangles, and of the corners of each triangle.
    number = rng.permutation(len(nodes))
    elements = number[elements][rng.permutation(len(elements))]
    elements = np.stack([np.roll(e, rng.integers(3)) for e in elements])
    order = np.argsort(number)
    young = 10 ** (drawn.spread * rng.uniform(-1, 1, len(elements)))
    poisson = drawn.poisson * (1 - drawn.spread * rng.random(len(elements)))
    # Of the order of the reference's: the force that shortens the beam by as much as the tendon.
    modulus = drawn.factor * 0.2 * drawn.height * np.ones(2)
    return Problem(
        nodes[order].astype(program.dtype),
        elements,
        np.repeat((i == 0)[order][:, None], 2, axis=1),
        young,
        poisson,
        program.material,
        (Tendons(number[lines], modulus, program.law),),
    )


def assert_claims_hold(drawn: Drawn) -> None:
    """Every answer ends `OK` or with a flag, and what it says is true."""
    raw, program = problem(drawn), drawn.program
    # The right side as tip, whose nodes are as many in each example: another number of them is compiled anew.
    scene, ratios = scene_of(raw, np.flatnonzero(raw.nodes[:, 0] > 0.999)), np.array(drawn.ratios)
    if not program.ramp:
        answer = jb.equilibrium(jb.command(scene, ratios), solver=program.solver)
        assert not verify(raw, ratios, answer).refuted
        return
    path = jb.ramp(scene, ratios, program.ramp, program.solver)
    for k, command in enumerate(np.asarray(jb.commands(ratios, program.ramp))):
        step = jax.tree.map(lambda leaf, k=k: leaf[k], path)
        assert not verify(raw, command, step).refuted
        if step.status & jb.Status.NOT_CONVERGED:
            break


QUIET = {"deadline": None, "derandomize": True, "suppress_health_check": list(HealthCheck), "database": None}


@settings(max_examples=200, **QUIET)
@given(scenes(PROGRAMS))
def test_claims_of_random_scenes_hold(drawn):
    assert_claims_hold(drawn)


@pytest.mark.slow
@settings(max_examples=5000, **QUIET)
@given(scenes(SLOW_PROGRAMS))
def test_claims_of_many_random_scenes_hold(drawn):
    assert_claims_hold(drawn)


# ------------------------------------------------------------------------------------------ invariance

# Two answers that ought to be the same differ by what the tolerance and round-off allow.
SAME = 1e-9
MODERATE = st.builds(
    Drawn,
    program=st.just(BANDED),
    seed=st.integers(0, 2**31 - 1),
    ratios=st.tuples(st.floats(0.7, 1.4), st.just(1.0)),
    height=st.floats(0.2, 0.5),
    spread=st.floats(0, 0.5),
    jitter=st.floats(0, 0.2),
)


def solved(raw: Problem, ratios: tuple[float, float]) -> tuple[jb.Scene, np.ndarray]:
    """Scene and positions at equilibrium, which has to be found."""
    scene = scene_of(raw)
    return scene, np.asarray(jb.check(jb.equilibrium(jb.command(scene, np.array(ratios)), solver=BANDED.solver)).x)


@settings(max_examples=20, **QUIET)
@given(MODERATE, st.floats(-np.pi, np.pi), st.floats(-10, 10), st.floats(-10, 10))
def test_answer_does_not_depend_on_the_frame(drawn, angle, right, up):
    raw = problem(drawn)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    moved = dataclasses.replace(raw, nodes=raw.nodes @ turn + [right, up])
    scene, x = solved(raw, drawn.ratios)
    scene_moved, x_moved = solved(moved, drawn.ratios)
    np.testing.assert_allclose(x_moved, x @ turn + [right, up], rtol=0, atol=SAME)
    np.testing.assert_allclose(jb.tip_angle(scene_moved, x_moved), jb.tip_angle(scene, x), rtol=0, atol=1e2 * SAME)


@settings(max_examples=20, **QUIET)
@given(MODERATE, st.integers(0, 2**31 - 1))
def test_answer_does_not_depend_on_the_numbering(drawn, seed):
    raw, rng = problem(drawn), np.random.default_rng(seed)
    number, triangles = rng.permutation(len(raw.nodes)), rng.permutation(len(raw.elements))
    order = np.argsort(number)
    shuffled = dataclasses.replace(
        raw,
        nodes=raw.nodes[order],
        elements=number[raw.elements][triangles],
        fixed=raw.fixed[order],
        young=raw.young[triangles],
        poisson=raw.poisson[triangles],
        tendons=tuple(dataclasses.replace(t, lines=number[t.lines][::-1]) for t in raw.tendons),
    )
    _, x = solved(raw, drawn.ratios)
    _, x_shuffled = solved(shuffled, drawn.ratios[::-1])
    np.testing.assert_allclose(x_shuffled[number], x, rtol=0, atol=SAME)


@settings(max_examples=20, **QUIET)
@given(MODERATE)
def test_mirror_image_of_a_scene_has_the_mirror_image_of_its_answer(drawn):
    raw = problem(drawn)
    mirrored = dataclasses.replace(raw, nodes=raw.nodes * [1, -1], elements=raw.elements[:, ::-1])
    scene, x = solved(raw, drawn.ratios)
    scene_mirrored, x_mirrored = solved(mirrored, drawn.ratios)
    np.testing.assert_allclose(x_mirrored, x * [1, -1], rtol=0, atol=SAME)
    np.testing.assert_allclose(
        jb.tip_angle(scene_mirrored, x_mirrored), -jb.tip_angle(scene, x), rtol=0, atol=1e2 * SAME
    )


@settings(max_examples=20, **QUIET)
@given(MODERATE, logarithmic(1e-6, 1e6), logarithmic(1e-6, 1e6))
def test_answer_does_not_depend_on_units(drawn, length, stress):
    raw = problem(drawn)
    # The modulus of the inverse-square law is a force times a length, and a force is a stress times a length.
    pulls = tuple(dataclasses.replace(t, modulus=t.modulus * stress * length**2) for t in raw.tendons)
    other = dataclasses.replace(raw, nodes=raw.nodes * length, young=raw.young * stress, tendons=pulls)
    _, x = solved(raw, drawn.ratios)
    _, x_other = solved(other, drawn.ratios)
    np.testing.assert_allclose(x_other / length, x, rtol=0, atol=SAME)


# ---------------------------------------------------------------------------------- the verifier itself


def test_verifier_has_the_hessian_of_its_own_energy():
    raw, ratios = problem(Drawn(PROGRAMS[3], 1, (0.5, 1.2), spread=0.5, jitter=0.1)), np.array([0.5, 1.2])
    x = raw.nodes + 0.01 * np.random.default_rng(0).normal(size=raw.nodes.shape) * ~raw.fixed
    # Positions are taken from the first node: the energy does not depend on the origin.
    kinds, y = raw.stencils(ratios), raw.relative(x)
    flat = lambda y: total_energy(y.reshape(raw.nodes.shape), kinds)
    free = ~raw.fixed.ravel()
    true = facts(raw, ratios, x)
    hessian = jax.jit(jax.hessian(flat))(y.ravel())[np.ix_(free, free)]
    np.testing.assert_allclose(true.hessian, hessian, atol=1e-12 * true.stiffest)
    np.testing.assert_allclose(true.gradient, jax.jit(jax.grad(flat))(y.ravel())[free], atol=1e-12 * true.scale)


@pytest.mark.parametrize("material", ["macklin_mueller", "neo_hookean", "saint_venant_kirchhoff", "linear_elastic"])
def test_verifier_agrees_with_the_library_on_the_material(material):
    H = 0.3 * np.random.default_rng(0).normal(size=(2, 2))
    mine, theirs = density(H + np.eye(2), 3.0, 5.0, material), getattr(jb, material)(H, jb.Lame(3.0, 5.0))
    np.testing.assert_allclose(mine, theirs, rtol=1e-12)


def false(answer: jb.Solution, **claims) -> jb.Solution:
    """An answer that claims something else."""
    return dataclasses.replace(jax.tree.map(np.asarray, answer), **{k: np.asarray(v) for k, v in claims.items()})


def test_verifier_refutes_false_claims():
    drawn = Drawn(BANDED, 0, (0.7, 1.0))
    raw, ratios = problem(drawn), np.array(drawn.ratios)
    answer = jb.equilibrium(jb.command(scene_of(raw), ratios), solver=BANDED.solver)
    words = lambda **claims: " ".join(verify(raw, ratios, false(answer, **claims)).refuted)
    assert words() == ""
    nudged = np.asarray(answer.x) + 1e-6 * ~raw.fixed * np.cos(np.arange(len(raw.nodes)))[:, None]
    folded = np.where(raw.fixed, raw.nodes, -np.asarray(answer.x))
    assert "over the tolerance" in words(x=nudged)
    assert "but not INVERTED" in words(x=folded)
    assert "a fixed coordinate has moved" in words(x=np.asarray(answer.x) + 1e-3)
    assert "not finite" in words(x=np.full(raw.nodes.shape, np.nan))
    assert "are not the command" in words(ratios=[0.5, 1.0])
    assert "but it is" in words(energy=2 * float(answer.energy))
    assert "but it is" in words(smallest_jacobian=0.1)
    assert "Hessian is positive definite" in words(status=int(jb.Status.UNSTABLE))
    assert "NOT_CONVERGED, but" in words(status=int(jb.Status.NOT_CONVERGED))
    assert "NONFINITE, but" in words(status=int(jb.Status.NONFINITE))
    assert "INVERTED, but" in words(status=int(jb.Status.INVERTED))
    assert "INVALID, but" in words(status=int(jb.Status.INVALID))
    assert "no equilibrium at" in words(status=int(jb.Status.NOT_CONVERGED), reached=0.5)
