"""The lowest modes and the inertia of the stiffness, against dense matrices and LAPACK's eigensolver."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assembled, central_difference, random_scene, shuffled, spring_pair, supports

import jaxbeam as jb
from jaxbeam.core.tree import Key
from jaxbeam.linear.blocks import Topology
from jaxbeam.linear.layout import assemble, expand, gather
from jaxbeam.scene.evaluation import stencil_hessians
from jaxbeam.solve.newton import topology

LONG = jb.rectangle(4.0, 1.0, 9, 3)
SHUFFLED, NUMBER = shuffled(LONG)
LEVELS = jb.BlockTridiagonal(joined=0)
COUNT = 3


def dense_modes(scene, x):
    """All eigenvalues and vectors of the free part of the stiffness, which is added up entry by entry."""
    free = np.flatnonzero(~scene.fixed.ravel())
    matrix = assembled(topology(scene), jax.jit(stencil_hessians)(scene, jnp.asarray(x)))[np.ix_(free, free)]
    return free, *np.linalg.eigh(0.5 * (matrix + matrix.T))


def compare(scene, x, modes, rtol):
    """Eigenvalues to `rtol` of the largest, shapes up to sign to `rtol` over the gap to the next; the count exactly."""
    free, values, vectors = dense_modes(scene, x)
    size, count = np.abs(values).max(), len(modes.values)
    np.testing.assert_allclose(modes.values, values[:count], rtol=0, atol=rtol * size)
    assert int(modes.negative) == np.sum(values < 0)
    flat = np.asarray(modes.shapes).reshape(count, -1)
    np.testing.assert_allclose(np.linalg.norm(flat, axis=1), 1, rtol=100 * rtol)
    assert not flat[:, scene.fixed.ravel()].any()
    for k in range(count):
        assert flat[k, np.argmax(np.abs(flat[k]))] > 0
        gap = np.abs(np.delete(values, k) - values[k]).min() / size
        sign = np.sign(flat[k, free] @ vectors[:, k])
        # An error in the eigenvalue is the square of one in the vector.
        bound = max(rtol / gap, np.sqrt(rtol / gap))
        assert bound < 0.1
        np.testing.assert_allclose(sign * flat[k, free], vectors[:, k], atol=bound)
    return values


@pytest.fixture(scope="module")
def far():
    """A body with three tendons between far levels, so that its stiffness has a border."""
    scene = random_scene(LONG, [[4, 25], [3, 26], [5, 13, 24]])
    assert LEVELS.layout(topology(scene)).blocks[-1] > 0
    return scene


def crumpled(scene, squeeze, seed=0):
    """Positions shortened along x by a fraction, and a little disturbed: not in balance, and of any inertia."""
    noise = np.random.default_rng(seed).normal(size=scene.mesh.nodes.shape)
    rest = np.asarray(scene.mesh.nodes)
    x = rest + 0.02 * noise - squeeze * (rest - rest.min(axis=0)) * [1, 0]
    return np.where(scene.fixed, rest, x)


@pytest.mark.parametrize("solver", [jb.Newton(linear=LEVELS), jb.Newton(linear=jb.Dense())], ids=["block", "dense"])
def test_modes_are_those_of_the_dense_matrix(far, solver):
    """Stable at rest; with one to many negative eigenvalues the more it is crumpled."""
    negative = []
    for squeeze in (0.0, 0.2, 0.3, 0.4):
        x = crumpled(far, squeeze)
        values = compare(far, x, jb.lowest_mode(far, x, COUNT, solver), 1e-10)
        negative.append(int(np.sum(values < 0)))
    assert negative[0] == 0 and len(set(negative)) > 2


def test_modes_of_the_reference_beam(beam):
    """Beside its clamp each tendon is short: the stiffest and the softest eigenvalue are 1e4 apart."""
    for x in (beam.mesh.nodes, crumpled(beam, 0.1)):
        scene = jb.command(beam, [0.6, 0.9])
        compare(scene, x, jb.lowest_mode(scene, x), 1e-11)


@pytest.mark.slow
def test_modes_in_float32(far):
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), far)
    for squeeze in (0.0, 0.3):
        x = crumpled(far, squeeze).astype(np.float32)
        modes = jb.lowest_mode(single, x, COUNT)
        assert modes.values.dtype == modes.shapes.dtype == jnp.float32
        # Round-off of the assembled stiffness, and of the factor that was shifted to be definite.
        compare(single, x, modes, 1.5e-5)


@pytest.mark.parametrize("ratio", [0.7, 1.3])
def test_mode_in_closed_form(ratio):
    """Two springs in line: the softest motion is across them, of stiffness `2 k (1 - ratio)`."""
    scene = spring_pair(ratio)
    modes = jb.lowest_mode(scene, scene.mesh.nodes)
    assert float(modes.values[0]) == pytest.approx(2 * 3.0 * (1 - ratio), rel=1e-9)
    expected = np.zeros((4, 2))
    expected[2, 1] = 1
    np.testing.assert_allclose(modes.shapes[0], expected, atol=1e-9)
    assert int(modes.negative) == (ratio > 1)


def test_mode_goes_through_vmap_and_jit(far):
    xs = np.stack([crumpled(far, 0.1 * seed, seed) for seed in range(3)])
    together = jax.jit(jax.vmap(lambda x: jb.lowest_mode(far, x, COUNT)))(jnp.asarray(xs))
    for k, x in enumerate(xs):
        one = jb.lowest_mode(far, x, COUNT)
        np.testing.assert_allclose(together.values[k], one.values, rtol=1e-8, atol=1e-8)
        assert int(together.negative[k]) == int(one.negative)


# ------------------------------------------------------------------------------------------ derivatives

TINY = jb.tendon_beam(3, 2)
DENSE = jb.Newton(rtol=1e-14, linear=jb.Dense())


def bent_values(v):
    """Two lowest eigenvalues at the equilibrium of a command, with a Young's modulus and a length."""
    scene = jb.command(jb.tendon_beam(3, 2, young=1e4 * v[2], length=3.5 * v[3]), v[:2])
    return jb.lowest_mode(scene, jb.equilibrium(scene, solver=DENSE).x, 2, DENSE).values


@pytest.mark.slow
def test_slopes_of_eigenvalues():
    """By the scene, through the equilibrium, against central differences of step 1e-4, whose truncation
    is about 1e-8. The eigenvectors are accurate to about 1e-7."""
    v = jnp.array([0.8, 1.0, 1.0, 1.0])
    expected = central_difference(bent_values, v, 1e-4)
    slope = jax.jacfwd(bent_values)(v)
    np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.slow
def test_slopes_of_eigenvalues_in_reverse():
    """The same as forward; second derivatives are NaN."""
    v = jnp.array([0.8, 1.0, 1.0, 1.0])
    slope = jax.jacfwd(bent_values)(v)
    np.testing.assert_allclose(jax.jit(jax.jacrev(bent_values))(v), slope, rtol=1e-10, atol=1e-10 * np.abs(slope).max())
    assert np.isnan(jax.hessian(lambda v: bent_values(v)[0])(v)).all()


def test_slope_of_an_eigenvalue_by_positions():
    """Positions that are fixed count too. Shapes have no derivative, and one that is not looked at harms nothing."""
    x = jnp.asarray(crumpled(TINY, 0.05))
    lowest = lambda x: jb.lowest_mode(TINY, x, solver=DENSE)
    expected = central_difference(lambda x: lowest(jnp.asarray(x)).values[0], x, 1e-5)
    slope = jax.grad(lambda x: lowest(x).values[0])(x)
    np.testing.assert_allclose(slope, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    mapped = jax.grad(lambda x: jax.lax.map(lambda x: lowest(x).values[0], jnp.stack([x, x]))[1])(x)
    np.testing.assert_allclose(mapped, slope, rtol=1e-9, atol=1e-9 * np.abs(slope).max())
    assert np.isnan(jax.grad(lambda x: lowest(x).shapes[0, -1, 1])(x)).all()
    assert np.isnan(jax.jacfwd(lambda x: lowest(x).shapes[0, -1, 1])(x)).any()


def test_slope_of_an_eigenvalue_in_closed_form():
    """Two springs in line, `2 k (1 - ratio)` across and `2 k` along: at ratio 0 they are equal, and have no slope."""
    value = lambda ratio: jb.lowest_mode(scene := spring_pair(ratio), scene.mesh.nodes).values[0]
    assert float(jax.grad(value)(0.7)) == pytest.approx(-6, rel=1e-9)
    assert np.isnan(jax.grad(value)(1e-14))


def test_errors(far):
    free = int((~far.fixed).sum())
    for count in (0, free + 1, 1.0):
        with pytest.raises(ValueError, match=f"count: expected a whole number from 1 to {free}, .*got {count}"):
            jb.lowest_mode(far, far.mesh.nodes, count)
    with pytest.raises(ValueError, match=r"x: expected node positions of shape \(27, 2\), got \(3, 2\)"):
        jb.lowest_mode(far, np.zeros((3, 2)))


# ------------------------------------------------------------------------------- indefinite factor

# Mesh, tendons, kind of support.
CASES = {
    "no tendon": (LONG, [], "left"),
    "far and crossing": (LONG, [[3, 26], [5, 24], [9, 20]], "left"),
    "guides over many levels": (LONG, [[4, 22, 7, 19, 13]], "left"),
    "roller": (LONG, [[4, 22], [0, 24]], "roller"),
    "any numbering": (SHUFFLED, [NUMBER[[4, 25]].tolist()], "left"),
}


@partial(jax.jit, static_argnames="solver")
def solve_indefinite(solver, layout, hessians, field, shifts):
    """Solution with the matrix plus each of several multiples of the unit matrix, and its negative eigenvalues."""
    storage = assemble(layout, hessians)
    unknown = layout.slots < layout.position.size  # padding keeps its own diagonal

    def one(shift):
        moved = storage.at[layout.diagonal].add(jnp.where(unknown, shift, 0))
        factor, negative = solver.factor_indefinite(layout, moved)
        answer = solver.solve_indefinite(layout, factor, gather(layout, field))
        return expand(layout, answer, field.shape), negative

    return jax.lax.map(one, shifts)


@pytest.mark.parametrize("name", CASES)
def test_indefinite_solution_and_inertia(name):
    """Random stencil matrices of no sign: NumPy's solution and its count, for matrices of every inertia."""
    mesh, lines, kind = CASES[name]
    stencils = [mesh.elements, *lines]
    keys = tuple(Key(np.array(s, ndmin=2)) for s in stencils)
    structure = Topology(Key(mesh.elements), Key(supports(mesh, kind)), keys)
    rng = np.random.default_rng(len(name))
    hessians = []
    for stencil in structure.stencils:
        m, k = stencil.array.shape
        root = rng.normal(size=(2 * k, 2 * k, m))
        hessians.append(root + np.swapaxes(root, 0, 1))
    free = np.flatnonzero(~structure.fixed.array.ravel())
    matrix = assembled(structure, hessians)[np.ix_(free, free)]
    values = np.linalg.eigvalsh(matrix)
    # Between neighbouring eigenvalues, a third of the way: none is near zero.
    places = np.linspace(0, len(values) - 2, 7).astype(int)
    shifts = np.array([*(-(2 * values[p] + values[p + 1]) / 3 for p in places), 1 - values[0], -1 - values[-1]])
    field = rng.normal(size=structure.fixed.array.shape)
    arrays = [jnp.asarray(h) for h in hessians]
    for solver in (jb.BlockTridiagonal(), LEVELS, jb.Dense()):
        layout = solver.layout(structure)
        answers, negative = solve_indefinite(solver, layout, arrays, jnp.asarray(field), jnp.asarray(shifts))
        assert negative.tolist() == [*(places + 1), 0, len(values)]
        for answer, shift in zip(answers, shifts, strict=True):
            moved = matrix + shift * np.eye(len(matrix))
            # There is no pivoting between blocks: a block may be far worse conditioned than the matrix.
            residual = moved @ np.asarray(answer).ravel()[free] - field.ravel()[free]
            assert np.linalg.norm(residual) < 1e-8 * np.linalg.norm(field)
            assert not np.asarray(answer)[structure.fixed.array].any()


def test_inertia_of_scenes_is_the_dense_count(far):
    """`negative` of many crumpled states: the border's share included."""
    counts = set()
    for seed in range(13):
        x = crumpled(far, 0.04 * seed, seed)
        _, values, _ = dense_modes(far, x)
        assert int(jb.lowest_mode(far, x, COUNT).negative) == np.sum(values < 0)
        counts.add(int(np.sum(values < 0)))
    assert len(counts) > 4
