"""Projection, layout, factorisation: the block-tridiagonal solver against NumPy on every kind of topology."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    EPS,
    annulus,
    assembled,
    central_difference,
    disturbed,
    l_shape,
    part,
    random_scene,
    shuffled,
    supports,
)

import jaxbeam as jb
from jaxbeam.core.tree import Key
from jaxbeam.linear.blocks import Topology
from jaxbeam.linear.layout import assemble, expand, gather
from jaxbeam.physics.projection import project_each, project_many
from jaxbeam.scene.evaluation import stencil_hessians
from jaxbeam.solve.newton import topology

# ----------------------------------------------------------------------------------------- projection


def project_together(matrices):
    return jnp.moveaxis(project_many(jnp.moveaxis(matrices, 0, -1)), -1, 0)


@pytest.fixture(scope="module", params=[(project_each, 6), (project_together, 4), (project_together, 6)])
def projected(request):
    """A projection, random symmetric matrices of mixed sign and size, and what it makes of them."""
    project, s = request.param
    rng = np.random.default_rng(0)
    matrices = rng.normal(size=(12, s, s)) * np.geomspace(1e-3, 1e3, 12)[:, None, None]
    matrices = matrices + np.swapaxes(matrices, 1, 2)
    return project, matrices, np.asarray(project(jnp.asarray(matrices)))


def norms(matrices):
    return np.linalg.norm(matrices, axis=(1, 2))


def test_projection_is_semidefinite(projected):
    _, matrices, nearest = projected
    assert (np.linalg.eigvalsh(matrices)[:, 0] < 0).all()
    # LAPACK's eigenvalues are right to a few eps of the norm.
    assert (np.linalg.eigvalsh(nearest)[:, 0] > -100 * EPS * norms(matrices)).all()
    np.testing.assert_allclose(nearest, np.swapaxes(nearest, 1, 2), atol=100 * EPS * norms(matrices).max())


def test_projection_is_the_nearest(projected):
    """Three ways: the distance of Higham (1988), the inequality that marks the nearest point, brute force."""
    _, matrices, nearest = projected
    negative = np.minimum(np.linalg.eigvalsh(matrices), 0)
    np.testing.assert_allclose(norms(matrices - nearest), np.sqrt(np.sum(negative**2, axis=1)), rtol=1e-12)
    rng = np.random.default_rng(1)
    for matrix, point in zip(matrices, nearest, strict=True):
        distance, size = np.linalg.norm(matrix - point), np.linalg.norm(matrix)
        for scale in np.geomspace(1e-4, 1, 200):
            # A random semidefinite matrix, from far away to beside the projection; of any rank.
            root = rng.normal(size=(len(point), rng.integers(1, 7)))
            other = (1 - scale) * point + scale * size * (root @ root.T) / np.linalg.norm(root) ** 2
            assert np.linalg.norm(matrix - other) >= distance * (1 - 1e-12)
            # The nearest point of a convex set: no other point lies on the matrix's side of it.
            assert np.sum((matrix - point) * (other - point)) <= 1e-12 * size**2


def test_projection_is_idempotent_and_leaves_definite_alone(projected):
    project, matrices, nearest = projected
    again = project(jnp.asarray(nearest))
    np.testing.assert_allclose(norms(again - nearest) / norms(matrices), 0, atol=100 * EPS)
    definite = nearest + 0.1 * norms(matrices)[:, None, None] * np.eye(nearest.shape[1])
    same = project(jnp.asarray(definite))
    np.testing.assert_allclose(norms(same - definite) / norms(definite), 0, atol=100 * EPS)
    opposite = np.asarray(project(jnp.asarray(-definite)))
    np.testing.assert_allclose(norms(opposite) / norms(definite), 0, atol=100 * EPS)


def with_eigenvalues(*values):
    """Matrices with these eigenvalues, turned at random."""
    turns = np.linalg.qr(np.random.default_rng(2).normal(size=(200, 4, 4)))[0]
    matrices = (turns * np.array(values)) @ np.swapaxes(turns, 1, 2)
    return 0.5 * (matrices + np.swapaxes(matrices, 1, 2))


def random_symmetric():
    matrices = np.random.default_rng(0).normal(size=(200, 4, 4))
    return matrices + np.swapaxes(matrices, 1, 2)


GRADES = np.geomspace(1.0, 1e-8, 4)


@pytest.mark.parametrize(
    "matrices",
    [
        random_symmetric(),
        GRADES[:, None] * random_symmetric() * GRADES,
        with_eigenvalues(1.0, 1.0, -1.0, -1.0),
        with_eigenvalues(2.0, -1.0, -1.0, -1.0),
        with_eigenvalues(1.0, 1.0 + 1e-9, -1.0, -1.0 - 1e-9),
        with_eigenvalues(1e8, 1.0, -1.0, -1e-8),
        with_eigenvalues(0.0, 0.0, 0.0, -1.0),
    ],
    ids=["random", "graded", "two pairs", "a triple", "nearly pairs", "wide", "singular"],
)
def test_jacobi_sweeps_reach_round_off(matrices):
    """As many sweeps as every kind of matrix needs: what is left is the round-off of LAPACK's own projection."""
    values, vectors = np.linalg.eigh(matrices)
    expected = (vectors * np.maximum(values, 0)[:, None]) @ np.swapaxes(vectors, 1, 2)
    assert (norms(project_together(jnp.asarray(matrices)) - expected) < 100 * EPS * norms(matrices)).all()


# ------------------------------------------------------------------------------------- linear solvers

LONG = jb.rectangle(4.0, 1.0, 9, 3)
SHUFFLED, NUMBER = shuffled(disturbed(LONG))
TWO_PIECES = part(LONG, np.abs(np.asarray(LONG.nodes)[LONG.elements, 0].mean(axis=1)) > 0.5)
# Each: mesh, tendons, kind of support. In LONG node (i, j) is 3 i + j, and the left edge is 0, 1, 2.
CASES = {
    "no tendon": (LONG, [], "left"),
    "both ends free, far apart": (LONG, [[4, 25]], "left"),
    "several far and crossing": (LONG, [[3, 26], [5, 24], [9, 20]], "left"),
    "guides over many levels": (LONG, [[4, 22, 7, 19, 13]], "left"),
    "both ends clamped": (LONG, [[0, 26], [4, 22]], "both ends"),
    "roller": (LONG, [[4, 22], [0, 24]], "roller"),
    "one node": (LONG, [[0, 24]], "one node"),
    "crossed": (jb.rectangle(2.0, 1.0, 5, 3, diagonals="crossed"), [[3, 13]], "left"),
    "any numbering": (SHUFFLED, [NUMBER[[4, 25]].tolist(), NUMBER[[2, 13, 24]].tolist()], "left"),
    "L": (l_shape(), [[0, 36]], "left"),
    "annulus": (annulus(), [[1, 19], [4, 22]], "one node"),
    "annulus, held on one side": (annulus(14, 4), [[0, 28, 42]], "left"),
    "two pieces and a tendon": (TWO_PIECES, [[4, 20]], "both ends"),
    "two triangles": (jb.rectangle(1.0, 1.0, 2, 2), [[0, 3]], "left"),
    "six nodes": (jb.rectangle(2.0, 1.0, 7, 3, order=2), [[1, 19]], "left"),
}
# Each level of these small meshes a block, as in large ones; and several, as it is by default.
LEVELS = jb.BlockTridiagonal(joined=0)


def structure_of(name):
    """Topology of a case: elements, one term for each tendon, and loads, which are stencils of one node."""
    mesh, lines, kind = CASES[name]
    stencils = [mesh.elements, *lines, np.arange(3)[:, None]]
    keys = tuple(Key(np.array(s, ndmin=2)) for s in stencils)
    return Topology(Key(mesh.elements), Key(supports(mesh, kind)), keys)


def case(name):
    """A topology, random positive definite stencil matrices, and the free part of their sum, made in NumPy."""
    structure = structure_of(name)
    rng = np.random.default_rng(len(name))
    hessians = []
    for stencil in structure.stencils:
        m, k = stencil.array.shape
        root = rng.normal(size=(m, 2 * k, 2 * k))
        hessians.append(np.moveaxis(root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(2 * k), 0, -1))
    free = np.flatnonzero(~structure.fixed.array.ravel())
    return structure, hessians, free, assembled(structure, hessians)[np.ix_(free, free)]


@partial(jax.jit, static_argnames="solver")
def solve(solver, layout, hessians, field, shifts):
    """Solution with the matrix plus each of several multiples of the unit matrix, and whether that is definite."""
    storage = assemble(layout, hessians)
    unknown = layout.slots < layout.position.size  # padding keeps its own diagonal

    def one(shift):
        factor, definite = solver.factor(layout, storage.at[layout.diagonal].add(jnp.where(unknown, shift, 0)))
        return expand(layout, solver.solve(layout, factor, gather(layout, field)), field.shape), definite

    return jax.lax.map(one, shifts)


@pytest.mark.parametrize("name", CASES)
def test_solution_and_definiteness(name):
    """The solution is NumPy's; the factor exists if and only if the least eigenvalue is positive."""
    check_solver(LEVELS, *case(name))


@pytest.mark.parametrize("name", ["several far and crossing", "L", "six nodes"])
def test_solution_with_joined_levels(name):
    check_solver(jb.BlockTridiagonal(), *case(name))


@pytest.mark.parametrize("name", ["no tendon", "guides over many levels", "two triangles"])
def test_dense_is_the_same_interface(name):
    check_solver(jb.Dense(), *case(name))


@pytest.mark.parametrize("solver", [LEVELS, jb.Dense()])
def test_pivots_multiply_to_the_determinant(solver):
    structure, hessians, _, matrix = case("several far and crossing")
    layout = solver.layout(structure)
    factor, _ = solver.factor(layout, assemble(layout, [jnp.asarray(h) for h in hessians]))
    pivots = np.asarray(solver.pivots(layout, factor))
    assert pivots.shape == layout.slots.shape
    np.testing.assert_allclose(np.sum(np.log(pivots)), np.linalg.slogdet(matrix)[1], rtol=1e-12)


def check_solver(solver, structure, hessians, free, matrix):
    field = np.random.default_rng(2).normal(size=structure.fixed.array.shape)
    values = np.linalg.eigvalsh(matrix)
    # Just short of and just past the least eigenvalues: by 1e-9 of the largest, far above round-off.
    margin = 1e-9 * values[-1]
    shifts = np.array([0, margin - values[0], -margin - values[0], -margin - values[1], -margin - values[-1]])
    arrays = [jnp.asarray(h) for h in hessians]
    answers, definite = solve(solver, solver.layout(structure), arrays, jnp.asarray(field), jnp.asarray(shifts))
    answer = np.asarray(answers[0])
    expected = np.zeros(field.size)
    expected[free] = np.linalg.solve(matrix, field.ravel()[free])
    # Backward stable: the error is eps times the condition number, times the size of the matrix.
    bound = 10 * matrix.shape[0] * EPS * values[-1] / values[0]
    assert bound < 1e-7
    assert np.linalg.norm(answer.ravel() - expected) < bound * np.linalg.norm(expected)
    assert not answer[structure.fixed.array].any()
    assert np.asarray(definite).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize("solver", [LEVELS, jb.BlockTridiagonal()])
@pytest.mark.parametrize("name", CASES)
def test_layout_holds_every_unknown_once(name, solver):
    structure = structure_of(name)
    layout = solver.layout(structure)
    slots, position = np.asarray(layout.slots), np.asarray(layout.position)
    free = np.flatnonzero(~structure.fixed.array.ravel())
    b, w, head, tail, r = layout.blocks
    assert max(head, tail) <= w
    assert slots.size == b * w + r
    assert sorted(slots[slots < structure.fixed.array.size].tolist()) == free.tolist()
    np.testing.assert_array_equal(slots[position[free]], free)
    held = np.flatnonzero(structure.fixed.array.ravel())
    assert (position[held] == slots.size).all()
    field = np.random.default_rng(0).normal(size=structure.fixed.array.shape)
    expected = np.where(structure.fixed.array, 0, field)
    np.testing.assert_array_equal(expand(layout, gather(layout, jnp.asarray(field)), field.shape), expected)


def blocks(name):
    layout = LEVELS.layout(structure_of(name))
    return layout, layout.blocks


def test_cases_reach_what_they_are_for():
    """There is a border with far tendons only, padding where levels differ in width, and more than one block."""
    assert blocks("no tendon")[1] == (8, 6, 6, 6, 0)
    assert blocks("both ends free, far apart")[1][-1] == 2  # one end of it, two coordinates
    assert blocks("guides over many levels")[1][-1] >= 6
    assert blocks("both ends clamped")[1][-1] == 2
    assert blocks("six nodes")[1][:4] == (6, 20, 10, 20)  # a column of corners is coupled to the two columns before
    assert jb.BlockTridiagonal().layout(structure_of("no tendon")).blocks == (2, 24, 6, 6, 0)
    layout, (b, w, *_) = blocks("L")
    assert b > 2
    padding = np.asarray(layout.slots) == 2 * len(l_shape().nodes)
    assert 0 < padding.sum() < b * w
    assert np.asarray(layout.empty).sum() == padding.sum()


def test_reference_beam_has_narrow_blocks(beam):
    """Numbered along the short side: 14 blocks of two levels of 14, and no border, as each tendon has a clamped end."""
    assert jb.BlockTridiagonal().layout(topology(beam)).blocks == (14, 28, 14, 14, 0)


def test_bad_numbering_costs_nothing(beam):
    mesh, _ = shuffled(beam.mesh)
    elements = Key(mesh.elements)
    structure = Topology(elements, Key(supports(mesh, "left")), (elements,))
    assert jb.BlockTridiagonal().layout(structure).blocks == (14, 28, 14, 14, 0)


def test_layout_is_computed_once_for_equal_structure(beam):
    again = jb.tendon_beam()
    for solver in (jb.BlockTridiagonal(), jb.Dense()):
        assert solver.layout(topology(beam)) is solver.layout(topology(again))


# ------------------------------------------------------------------------------------------- Hessians


@pytest.mark.parametrize("name", ["guides over many levels", "roller"])
def test_stencil_hessians_sum_to_the_derivative_of_the_forces(name):
    mesh, lines, kind = CASES[name]
    scene = random_scene(mesh, lines, kind)
    shape = mesh.nodes.shape
    x = mesh.nodes + 0.05 * np.random.default_rng(3).normal(size=shape)
    stencils = jax.jit(stencil_hessians)(scene, x)
    K = assembled(topology(scene), stencils)
    differences = -central_difference(lambda y: jb.forces(scene, jnp.asarray(y)), x, 1e-5).reshape(K.shape)
    # Central differences with h = 1e-5: truncation h^2 f''' (lengths near 0.5) and round-off eps / h.
    np.testing.assert_allclose(K, differences, atol=1e-7 * np.abs(K).max())
    for hessian in stencils:
        bound = 1e-13 * max(1.0, np.abs(hessian).max())
        np.testing.assert_allclose(hessian, np.swapaxes(hessian, 0, 1), atol=bound)


def test_supports_are_what_they_say():
    """The kinds of support used above."""
    held = {kind: supports(LONG, kind) for kind in ("left", "both ends", "roller", "one node", "none")}
    assert {kind: int(fixed.sum()) for kind, fixed in held.items()} == {
        "left": 6,
        "both ends": 12,
        "roller": 7,
        "one node": 2,
        "none": 0,
    }
