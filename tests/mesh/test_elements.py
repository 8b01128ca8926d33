"""Elements of six nodes: `J` in their inside, against samples of their maps that share no code with the package."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, central_difference

import jaxbeam as jb
from jaxbeam.mesh.elements import ELEMENTS
from jaxbeam.mesh.triangle import RULES, TRIANGLE
from jaxbeam.physics.volume import admissible_step, smallest_ratios, volume_ratios
from jaxbeam.scene.scene import is_valid

# ------------------------------------------------------------------------------- rules and shape functions


@pytest.mark.parametrize("degree", RULES)
def test_rule_is_exact_up_to_its_degree(degree):
    """Against `int l0^a l1^b l2^c = a! b! c! 2 A / (a + b + c + 2)!`, and not beyond."""
    from math import factorial

    points, weights = TRIANGLE.rule(degree)
    assert weights.sum() == pytest.approx(1, abs=1e-14) and (weights > 0).all()
    off = {}
    for total in range(degree + 2):
        for a in range(total + 1):
            b = total - a
            exact = 2 * factorial(a) * factorial(b) / factorial(total + 2)
            off[total] = max(off.get(total, 0), abs(weights @ (points[:, 0] ** a * points[:, 1] ** b) - exact))
    assert max(off[total] for total in range(degree + 1)) < 1e-14 < 1e-5 < off[degree + 1]


@pytest.mark.parametrize("element", ELEMENTS.values(), ids=ELEMENTS)
def test_shape_functions(element):
    """One at their own node and zero at the others; they add up to 1; slopes are those of the functions."""
    np.testing.assert_allclose(element.shape(element.places), np.eye(element.nodes), atol=1e-15)
    points = np.random.default_rng(0).dirichlet(np.ones(3), 20)
    np.testing.assert_allclose(element.shape(points).sum(axis=1), 1, atol=1e-14)
    h = 1e-6
    for axis, step in enumerate(np.array([[-1, 1, 0], [-1, 0, 1]]) * h):
        slope = (element.shape(points + step) - element.shape(points - step)) / (2 * h)
        np.testing.assert_allclose(element.slopes(points)[:, :, axis], slope, atol=1e-9)


@pytest.mark.parametrize("element", ELEMENTS.values(), ids=ELEMENTS)
def test_edges_go_round_the_element(element):
    """Each begins where the one before ended, and what lies between its ends is half-way."""
    for edge, following in zip(element.edges, element.edges[1:] + element.edges[:1], strict=True):
        assert edge[1] == following[0]
        for node in edge[2:]:
            np.testing.assert_array_equal(element.places[node], element.places[list(edge[:2])].mean(axis=0))


smallest = jax.jit(smallest_ratios)
longest_step = jax.jit(admissible_step)

# ------------------------------------------------------------------------------- maps as polynomials, and their samples

# Where the six nodes lie on the reference triangle, in the coordinates `(u, v)` of corners 1 and 2.
PLACES = np.array([[0, 0], [1, 0], [0, 1], [0.5, 0], [0.5, 0.5], [0, 0.5]])


def powers(points):
    """The monomials `1, u, v, u^2, u v, v^2` `(s, 6)` at points `(s, 2)`, and their derivatives in `u` and in `v`."""
    u, v = np.moveaxis(points, -1, 0)
    one, zero = np.ones_like(u), np.zeros_like(u)
    of = lambda *columns: np.stack(columns, axis=-1)
    return of(one, u, v, u * u, u * v, v * v), of(zero, one, zero, 2 * u, v, zero), of(zero, zero, one, zero, u, 2 * v)


def stretch(nodes, points):
    """The determinant of the map with nodes `(m, 6, 2)` at points `(s, 2)` or `(m, s, 2)`, `(m, s)`."""
    coefficients = np.linalg.solve(powers(PLACES)[0], nodes)
    by_u, by_v = (derivative @ coefficients for derivative in powers(points)[1:])
    return by_u[..., 0] * by_v[..., 1] - by_u[..., 1] * by_v[..., 0]


def triangle_grid(n):
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    return np.stack([i, j], axis=-1)[i + j <= n] / n


GRID = triangle_grid(60)


def sampled_minimum(nodes, rest):
    """The smallest `J` `(m,)` of elements found by sampling, ever more closely about the smallest sample."""
    points = np.broadcast_to(GRID, (len(nodes), *GRID.shape))
    width, around = 1 / 60, 2 * np.stack(np.meshgrid(*[np.linspace(-1, 1, 21)] * 2), axis=-1).reshape(-1, 2)
    for _ in range(7):
        ratio = stretch(nodes, points) / stretch(rest, points)
        best = np.take_along_axis(points, np.argmin(ratio, axis=1)[:, None, None], axis=1)
        points = np.clip(best + width * around, 0, 1)
        points /= np.maximum(points.sum(axis=-1, keepdims=True), 1)
        points, width = np.concatenate([best, points], axis=1), width / 10
    return ratio.min(axis=1)


def random_elements(count=40):
    """Rest positions `(3 count, 6, 2)`: with straight edges and nodes in the middle, with these elsewhere on the edges,
    with curved edges."""
    rng = np.random.default_rng(0)
    found = []
    for spread, bulge in ((0.0, 0.0), (0.2, 0.0), (0.0, 0.12)):
        corners = np.array([[0, 0], [1, 0], [0.3, 0.9]]) + 0.2 * rng.normal(size=(40 * count, 3, 2))
        share = 0.5 + rng.uniform(-spread, spread, (40 * count, 3, 1))
        between = share * corners + (1 - share) * np.roll(corners, -1, axis=1)
        nodes = np.concatenate([corners, between + bulge * rng.normal(size=between.shape)], axis=1)
        found.append(nodes[stretch(nodes, GRID).min(axis=1) > 0.03][:count])
    return np.concatenate(found)


REST = random_elements()


def body_of(rest):
    """A solid of elements that have no node in common."""
    mesh = jb.Mesh(rest.reshape(-1, 2), np.arange(rest.size // 2).reshape(-1, 6))
    return mesh, jb.solid(mesh, jb.Lame(1.0, 1.0))


MESH, BODY = body_of(REST)
SCENE = jb.Scene(MESH, (BODY,), np.zeros(MESH.nodes.shape, bool))


def deformed(size, seed=0):
    rng = np.random.default_rng(seed)
    return REST @ (np.eye(2) + 0.5 * size * rng.normal(size=(len(REST), 2, 2))) + 0.2 * size * rng.normal(
        size=REST.shape
    )


# --------------------------------------------------------------------------------------------------- the smallest J


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.1, 0.3, 1.0, 10.0])
def test_smallest_j_is_that_of_the_whole_element(size):
    """As far below `J` at the quadrature points as it may be; neither above the samples nor below the least of them."""
    x = deformed(size)
    found, sampled = np.asarray(smallest(x, BODY.params)), sampled_minimum(x, REST)
    # Of `J`: that of a part of it, which may be larger, over the smallest determinant at rest.
    scale = np.abs(stretch(x, GRID)).max(axis=1) / stretch(REST, GRID).min(axis=1)
    assert (found <= sampled + 20 * EPS * scale).all()
    assert (found >= sampled - 1e-10 * scale).all()
    at_points = np.asarray(volume_ratios(x, BODY.params)).min(axis=0)
    if size >= 0.1:
        assert (found < at_points - 1e-3).mean() > 0.9


def test_smallest_j_in_float32_and_any_unit():
    x = deformed(0.3)
    expected = np.asarray(smallest(x, BODY.params))
    for unit in (1e-12, 1.0, 1e12):
        _, body = body_of((unit * REST).astype(np.float32))
        found = smallest((unit * x).astype(np.float32), body.params)
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.slow
def test_smallest_jacobian_differentiates():
    """First and second derivatives in positions and rest positions against differences, forward and reverse; where `J`
    is the same everywhere, at rest, they are finite."""
    rng = np.random.default_rng(3)
    along = (rng.normal(size=REST.shape), 0.3 * rng.normal(size=REST.shape))

    def each(x, rest):
        mesh = jb.Mesh(rest.reshape(-1, 2), MESH.elements)
        return smallest_ratios(x, jb.solid(mesh, jb.Lame(1.0, 1.0)).params)

    at = lambda t, x: each(x + t * along[0], REST + t * along[1])
    value = jax.jit(at)
    first = jax.jit(jax.jacfwd(at))
    second = jax.jit(jax.jacfwd(jax.jacfwd(at)))
    x = deformed(0.3)
    for t in (0.0, 1e-3):
        h = 1e-6
        by_first = (value(t + h, x) - value(t - h, x)) / (2 * h)
        by_second = (first(t + h, x) - first(t - h, x)) / (2 * h)
        scale, scales = 1 + np.abs(first(t, x)), 1 + np.abs(second(t, x))
        # A few elements change, within the difference, the edge or corner where J is smallest.
        assert (np.abs(by_first - first(t, x)) < 1e-6 * scale).mean() > 0.97
        assert (np.abs(by_second - second(t, x)) < 1e-4 * scales).mean() > 0.97
    by_both = jax.jit(jax.grad(lambda x, rest: jnp.sum(each(x, rest)), argnums=(0, 1)))
    slope = sum(np.sum(a * b) for a, b in zip(by_both(x, REST), along, strict=True))
    np.testing.assert_allclose(slope, np.sum(first(0.0, x)), rtol=1e-9)
    for x in (REST, 2 * REST, REST @ np.array([[1.2, 0.1], [-0.2, 0.8]])):
        assert all(np.isfinite(part).all() for part in by_both(x, REST))
    # Any place will do for the derivative by a growth that is the same everywhere.
    _, growth = jax.jvp(lambda x: smallest_ratios(x, BODY.params), (jnp.asarray(REST),), (jnp.asarray(REST),))
    np.testing.assert_allclose(growth, 2, rtol=1e-9)


def test_smallest_jacobian_maps_over_states():
    """One scene, several states: `vmap` is a loop."""
    states = np.stack([deformed(size).reshape(-1, 2) for size in (0.0, 0.1, 0.3)])
    together = jax.jit(jax.vmap(lambda x: jb.smallest_jacobian(SCENE, x)))(states)
    one = jax.jit(lambda x: jb.smallest_jacobian(SCENE, x))
    np.testing.assert_allclose(together, [one(x) for x in states], rtol=1e-13)
    gradient = jax.jit(jax.grad(lambda x: jb.smallest_jacobian(SCENE, x)))(states[2])
    direction = np.random.default_rng(0).normal(size=states[2].shape)
    slope = central_difference(lambda t: one(states[2] + t[0] * direction), np.zeros(1), 1e-6)[0]
    np.testing.assert_allclose(np.sum(gradient * direction), slope, rtol=1e-6)


# --------------------------------------------------------------------------------------------------------- the step


@pytest.mark.parametrize("size", [1.0, *(pytest.param(size, marks=pytest.mark.slow) for size in (0.1, 10.0))])
def test_no_part_of_an_element_is_turned_over_within_a_step(size):
    """From any sound state, along any step; and steps are not cut to less than they must be."""
    keep = 0.1
    for seed, start in ((0, 0.0), (1, 0.1), (2, 0.3)):
        x = deformed(start, seed)
        least = sampled_minimum(x, REST)
        sound = least > 0
        dx = size * np.random.default_rng(seed).normal(size=REST.shape)
        steps = np.asarray(longest_step(x, dx, BODY.params, keep))
        assert (steps[sound] > 0).all()
        t = np.minimum(steps, 1)[:, None, None]
        lows = [sampled_minimum(x + s * t * dx, REST) for s in np.linspace(0, 1, 15)]
        assert (np.min(lows, axis=0) > 0.49 * keep * least)[sound].all()
        # Where a step is cut, going on by as much again would leave little of some J, or the element is turned by more
        # than a right angle within it.
        cut = sound & (steps < 1)
        on = [stretch(x + s * t * dx, GRID) / stretch(x, GRID) for s in np.linspace(0, 2, 41)]
        assert (np.min(on, axis=(0, 2)) < 0.2)[cut].mean() > 0.95
        assert cut.sum() > 5 if size < 1 else cut.sum() > 50


def test_an_element_that_is_turned_over_is_let_go():
    """Inside out away from its quadrature points it is limited by these alone: it must be able to come back."""
    x = deformed(0.3)
    bent = (np.asarray(smallest(x, BODY.params)) < 0) & (np.asarray(volume_ratios(x, BODY.params)).min(axis=0) > 0.2)
    assert bent.sum() > 5
    steps = np.asarray(longest_step(x, REST - x, BODY.params, 0.1))
    assert (steps[bent] >= 1).any() and (steps[bent] > 0.2).all()


# ------------------------------------------------------------------------------------------------ scenes and meshes

# The determinant of its map is 0.4 to 3.2 at its nodes, and -0.1415 in between.
FOLDED = np.array([[0, 0], [1, 0], [0, 1], [0.2, -0.1], [0.8, 0.8], [0.3, 0.2]])
SOUND = PLACES + np.array([[0, 0], [0, 0], [0, 0], [0, -0.1], [0.1, 0.1], [0.1, 0]])


def test_rest_mesh_that_folds_over_between_nodes_is_refused():
    assert stretch(FOLDED[None], PLACES).min() > 0.3 and stretch(FOLDED[None], GRID).min() < -0.1
    jb.Mesh(SOUND, [[0, 1, 2, 3, 4, 5]])
    for unit in (1e-9, 1.0, 1e9):
        with pytest.raises(ValueError, match=r"triangle 0, \[0, 1, 2, 3, 4, 5\], folds over: .* is -0.14. times"):
            jb.Mesh(unit * FOLDED, [[0, 1, 2, 3, 4, 5]])


def element(nodes, density=jb.macklin_mueller):
    mesh = jb.Mesh(nodes, [[0, 1, 2, 3, 4, 5]])
    return jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3), density),), jb.clamped(mesh, [0, 1]))


def test_traced_rest_mesh_that_folds_over_is_invalid():
    """Its quadrature points are sound."""
    valid = jax.jit(lambda nodes: (is_valid(element(nodes)), jnp.min(element(nodes).terms[0].params.weights)))
    sound, folded = valid(SOUND), valid(FOLDED)
    assert sound[0] and sound[1] > 0
    assert not folded[0] and folded[1] > 0


def test_start_that_folds_over_between_quadrature_points_is_refused():
    scene = element(PLACES)
    x0 = np.where(scene.fixed, PLACES, FOLDED)
    assert volume_ratios(x0[None], scene.terms[0].params).min() > 0.05
    with pytest.raises(ValueError, match=r"x0: element 0 is inverted \(J = -0.14.\)"):
        jb.equilibrium(scene, x0)


def test_beam_that_is_inverted_inside_an_element_is_not_ok():
    """Pulled far enough on both sides a beam has an element that is turned inside out, but not at quadrature points;
    pulled on less it has not, and is solved in as many steps as when no more than those points was looked at."""
    scene = jb.tendon_beam(9, 5, order=2, graded=True, anchor_width=0.25)
    params, nodes = scene.terms[0].params, scene.terms[0].nodes
    rest = np.asarray(scene.mesh.nodes)[nodes]
    solution = jb.equilibrium(jb.command(scene, [0.3, 0.3]))
    x = np.asarray(solution.x)[nodes]
    sampled = sampled_minimum(x, rest)
    assert np.asarray(volume_ratios(x, params)).min() > 0.5 and sampled.min() < -0.01
    assert jb.Status.INVERTED in jb.Status(int(solution.status))
    np.testing.assert_allclose(solution.smallest_jacobian, sampled.min(), atol=1e-9)
    assert solution.smallest_jacobian <= sampled.min() + 1e-12
    assert int(solution.worst_element) == np.argmin(sampled)
    for ratio, steps in ((0.8, 8), (0.6, 12), (0.5, 14)):
        sane = jb.check(jb.equilibrium(jb.command(scene, [ratio, 1.0])))
        np.testing.assert_allclose(
            sane.smallest_jacobian, sampled_minimum(np.asarray(sane.x)[nodes], rest).min(), atol=1e-9
        )
        assert int(sane.steps) <= steps
