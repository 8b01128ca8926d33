"""Nested dissection against NumPy and the block-tridiagonal solver, on every kind of topology."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, supports
from test_linear import CASES, case, check_solver, structure_of

import jaxbeam as jb
from jaxbeam._tree import Key
from jaxbeam.chain import Topology
from jaxbeam.dissection import NestedDissection, choose_solver
from jaxbeam.equilibrium import topology
from jaxbeam.linear import assemble, expand, gather

# Leaves of few unknowns that are not joined again, so that small meshes have trees of several levels.
SMALL = NestedDissection(leaf=8, join=False)
# Each compiles for seconds. The others are slow tests.
QUICK = {"several far and crossing", "two pieces and a tendon"}


def named(names):
    return [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in names]


@pytest.mark.parametrize("name", named(CASES))
def test_solution_and_definiteness(name):
    """The solution is NumPy's; the factor exists if and only if the least eigenvalue is positive."""
    check_solver(SMALL, *case(name))


@pytest.mark.parametrize("name", CASES)
def test_layout_holds_every_unknown_once(name):
    structure = structure_of(name)
    layout = SMALL.layout(structure)
    slots, position = np.asarray(layout.slots), np.asarray(layout.position)
    fixed = structure.fixed.array
    free = np.flatnonzero(~fixed.ravel())
    assert sorted(slots[slots < fixed.size].tolist()) == free.tolist()
    np.testing.assert_array_equal(slots[position[free]], free)
    assert (position[fixed.ravel()] == slots.size).all()
    # Ones on the diagonal of the padding, and nowhere else before assembly.
    empty, diagonal = np.asarray(layout.empty), np.asarray(layout.diagonal)
    assert np.unique(diagonal).size == slots.size
    np.testing.assert_array_equal(empty[diagonal], slots == fixed.size)
    assert empty.sum() == (slots == fixed.size).sum()


@partial(jax.jit, static_argnames="solver")
def solve(solver, layout, hessians, field):
    storage = assemble(layout, hessians)
    factor, ok = solver.factor(layout, storage)
    return expand(layout, solver.solve(layout, factor, gather(layout, field)), field.shape), ok


@partial(jax.jit, static_argnames="solver")
def solve_indefinite(solver, layout, hessians, field, shift):
    unknown = layout.slots < layout.position.size
    storage = assemble(layout, hessians).at[layout.diagonal].add(jnp.where(unknown, shift, 0))
    factor, negative = solver.factor_indefinite(layout, storage)
    return expand(layout, solver.solve_indefinite(layout, factor, gather(layout, field)), field.shape), negative


@pytest.mark.parametrize("name", ["several far and crossing", pytest.param("roller", marks=pytest.mark.slow)])
def test_any_inertia(name):
    """Solution and number of negative eigenvalues of a matrix of any inertia are NumPy's."""
    structure, hessians, free, matrix = case(name)
    values = np.linalg.eigvalsh(matrix)
    field = np.random.default_rng(3).normal(size=structure.fixed.array.shape)
    layout = SMALL.layout(structure)
    for wanted in (0, 1, 7, values.size):
        # Half way between two eigenvalues, so that the shifted matrix is not near a singular one.
        edges = np.concatenate([[0.5 * values[0]], 0.5 * (values[1:] + values[:-1]), [1.1 * values[-1]]])
        shift = -edges[wanted]
        arrays = [jnp.asarray(h) for h in hessians]
        answer, negative = solve_indefinite(SMALL, layout, arrays, jnp.asarray(field), shift)
        assert int(negative) == wanted
        expected = np.linalg.solve(matrix + shift * np.eye(values.size), field.ravel()[free])
        # Pivots are not exchanged: they may be nearer to singular than the matrix.
        scale = np.abs(expected).max()
        np.testing.assert_allclose(np.asarray(answer).ravel()[free], expected, atol=1e-9 * scale)


def mesh_case(diagonals, nx=17, ny=7):
    """A beam's stencil matrices: positive definite, on a mesh with a tree of several levels."""
    mesh = jb.rectangle(4.0, 1.0, nx, ny, diagonals=diagonals)
    count = mesh.nodes.shape[0]
    tendon = np.array([[ny // 2, count - 2], [3 * ny, count // 2]])
    keys = (Key(mesh.elements), Key(tendon))
    structure = Topology(Key(mesh.elements), Key(supports(mesh, "left")), keys)
    rng = np.random.default_rng(0)
    hessians = []
    for stencil in keys:
        m, k = stencil.array.shape
        root = rng.normal(size=(m, 2 * k, 2 * k))
        hessians.append(jnp.asarray(np.moveaxis(root @ np.swapaxes(root, 1, 2) + np.eye(2 * k), 0, -1)))
    field = jnp.asarray(rng.normal(size=mesh.nodes.shape))
    return structure, hessians, field


@pytest.mark.parametrize(
    "diagonals",
    ["one-sided", pytest.param("crossed", marks=pytest.mark.slow), pytest.param("mirrored", marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_agrees_with_block_tridiagonal(diagonals, dtype):
    structure, hessians, field = mesh_case(diagonals)
    hessians, field = [h.astype(dtype) for h in hessians], field.astype(dtype)
    ours, ok = solve(SMALL, SMALL.layout(structure), hessians, field)
    bands = jb.BlockTridiagonal()
    theirs, _ = solve(bands, bands.layout(structure), hessians, field)
    assert bool(ok) and ours.dtype == dtype
    tolerance = 1e-12 if dtype == "float64" else 1e-12 / EPS * np.finfo(np.float32).eps
    assert np.abs(ours - theirs).max() < tolerance * np.abs(theirs).max()


def test_not_definite_in_one_front_only():
    """A negative pivot in any front, leaf or root, makes `ok` false."""
    structure, hessians, _ = mesh_case("one-sided")
    layout = SMALL.layout(structure)
    factor = jax.jit(lambda storage: SMALL.factor(layout, storage)[1])
    storage = assemble(layout, hessians)
    unknown = np.flatnonzero(np.asarray(layout.slots) < layout.position.size)
    assert bool(factor(storage))
    for k in unknown[:: max(1, unknown.size // 20)]:
        assert not bool(factor(storage.at[layout.diagonal[k]].set(-1.0)))
    assert not bool(factor(storage.at[layout.diagonal[unknown[0]]].set(jnp.nan)))


def test_many_right_hand_sides():
    structure, hessians, field = mesh_case("one-sided")
    layout = SMALL.layout(structure)
    factor, _ = jax.jit(SMALL.factor)(layout, assemble(layout, hessians))
    columns = jnp.stack([gather(layout, field), gather(layout, field[::-1])], axis=1)
    one = jax.jit(partial(SMALL.solve, layout, factor))
    together = jax.jit(jax.vmap(one, in_axes=1, out_axes=1))(columns)
    for k in range(2):
        expected = one(columns[:, k])
        np.testing.assert_allclose(together[:, k], expected, atol=1e-13 * float(jnp.abs(expected).max()))


@pytest.mark.slow
def test_equilibrium_and_its_gradient(beam):
    """Newton's method finds the same equilibrium with it, and so does the derivative."""

    def angle(ratio, solver):
        scene = jb.command(beam, jnp.stack([ratio, jnp.ones_like(ratio)]))
        solution = jb.equilibrium(scene, solver=solver)
        return jb.tip_angle(scene, solution.x), solution

    results = []
    for linear in (jb.BlockTridiagonal(), NestedDissection()):
        solver = jb.Newton(linear=linear, rtol=1e-12)
        (value, solution), slope = jax.value_and_grad(partial(angle, solver=solver), has_aux=True)(jnp.asarray(0.8))
        assert int(solution.status) == 0
        results.append((value, solution.x, slope))
    for ours, theirs in zip(results[1], results[0], strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-10, rtol=1e-9)


def test_choice_by_size(beam):
    assert choose_solver(topology(beam)) == jb.BlockTridiagonal()
    assert choose_solver(topology(jb.tendon_beam(449, 97))) == NestedDissection()


def test_layout_is_computed_once_for_equal_structure(beam):
    solver = NestedDissection()
    assert solver.layout(topology(beam)) is solver.layout(topology(jb.tendon_beam()))
