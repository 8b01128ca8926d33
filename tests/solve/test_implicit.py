"""The derivative through equilibrium: against differences of converged solves, and where there is none."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import counted, spring_pair, traces

import jaxbeam as jb

# Differences divide the error of a solve by a step of about 1e-3, so solves go as far down as round-off lets them.
TIGHT = jb.Newton(rtol=1e-14)
# Demanded: implicit first derivatives against differences, second against differences of the first.
FIRST, SECOND = 1e-7, 1e-6
# Most of the time here is compilation. Unoptimised it takes less than half as long, and the programs run as fast.
QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
jit = partial(jax.jit, compiler_options=QUICK)


def differences(f, h):
    """Slope of `f` at 0 by the central stencil of order 6, whose truncation is about `h^6`."""
    return sum(w * (np.asarray(f(k * h)) - np.asarray(f(-k * h))) for k, w in ((1, 45), (2, -9), (3, 1))) / (60 * h)


def to_second_order(f):
    """Of `f(v) -> (scalar, solution)`: value, gradient in both modes, Hessian and solution, from a single solve."""

    def first(v):
        (value, solution), reverse = jax.value_and_grad(f, has_aux=True)(v)
        return (value, reverse), (value, reverse, solution)

    def expanded(v):
        (forward, hessian), (value, reverse, solution) = jax.jacfwd(first, has_aux=True)(v)
        return {"value": value, "forward": forward, "reverse": reverse, "hessian": hessian, "solution": solution}

    return expanded


# ------------------------------------------------------- a beam with every kind of parameter


def strap(x, params):
    """A user's own term: a spring in the square of the distance of two nodes."""
    return params["stiffness"] * (jnp.sum((x[1] - x[0]) ** 2) - params["length"] ** 2) ** 2


def parameters(beam, ratios):
    """Those of a `tendon_beam`, of a load on its tip and of a strap; the last two of no strength."""
    count = len(beam.mesh.elements)
    return {
        "ratios": np.asarray(ratios),
        "modulus": np.full(2, 2e3),
        "young": np.full(count, 1e4),
        "poisson": np.full(count, 0.45),
        "load": np.zeros((beam.tip.size, 2)),
        "nodes": np.asarray(beam.mesh.nodes),
        "strap": {"stiffness": np.zeros(1), "length": np.ones(1)},
    }


def built(beam, theta):
    """The scene of these parameters on the topology of `beam`."""
    mesh = jb.Mesh(theta["nodes"], beam.mesh.elements)
    terms = (
        jb.solid(mesh, jb.lame(theta["young"], theta["poisson"]), counted),
        jb.tendons(mesh, beam.terms[1].nodes, theta["modulus"]),
        jb.dead_load(mesh, beam.tip, theta["load"]),
        jb.Term(strap, [[0, beam.tip[-1]]], theta["strap"]),
    )
    return jb.command(jb.Scene(mesh, terms, beam.fixed, beam.tip), theta["ratios"])


def changes(beam, seed=0):
    """A change of the parameters of each kind, in a random direction if of an array. A step of 1 is a large one."""
    rng = np.random.default_rng(seed)
    count = len(beam.mesh.elements)
    corner, above = np.asarray(beam.mesh.nodes[:2])
    shape = lambda: (above - corner)[1] * rng.standard_normal(beam.mesh.nodes.shape)
    return {
        "top command": {"ratios": np.array([1.0, 0.0])},
        "bottom command": {"ratios": np.array([0.0, 1.0])},
        "top modulus": {"modulus": np.array([2e3, 0.0])},
        "bottom modulus": {"modulus": np.array([0.0, 2e3])},
        "each Young's modulus": {"young": 1e4 * rng.standard_normal(count)},
        "all Young's moduli": {"young": np.full(count, 1e4)},
        "each Poisson's ratio": {"poisson": 0.1 * rng.standard_normal(count)},
        "all Poisson's ratios": {"poisson": np.full(count, 0.1)},
        "load": {"load": 50 * rng.standard_normal((beam.tip.size, 2))},
        "shape": {"nodes": shape()},
        "shape of the clamp": {"nodes": shape() * beam.fixed},
        "own stiffness": {"strap": {"stiffness": np.array([10.0]), "length": np.zeros(1)}},
        "own length": {"strap": {"stiffness": np.zeros(1), "length": np.ones(1)}},
    }


def directions(beam):
    """All the `changes`, stacked."""
    zero = jax.tree.map(np.zeros_like, parameters(beam, [1.0, 1.0]))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *(zero | change for change in changes(beam).values()))


def moved(theta, along, steps):
    """The parameters after `steps` `(k,)` along the `k` directions."""
    return jax.tree.map(lambda value, change: value + jnp.tensordot(steps, change, 1), theta, along)


# ------------------------------------------------------------------------ the reference scene

REFERENCE = jb.tendon_beam()
KINDS = list(changes(REFERENCE))
each_kind = pytest.mark.parametrize("kind", KINDS)
REFERENCE_THETA, REFERENCE_ALONG = parameters(REFERENCE, [0.4, 1.0]), directions(REFERENCE)


def reference_angle(steps):
    scene = built(REFERENCE, moved(REFERENCE_THETA, REFERENCE_ALONG, steps))
    solution = jb.equilibrium(scene, None, TIGHT)
    return jb.tip_angle(scene, solution.x), solution


expansion = jit(to_second_order(reference_angle))
AT_COMMANDS = {"(0.4, 1.0)": np.zeros(len(KINDS)), "(0.6, 1.0)": 0.2 * np.eye(len(KINDS))[0]}
each_command = pytest.mark.parametrize("steps", AT_COMMANDS.values(), ids=AT_COMMANDS)


@pytest.mark.slow
def test_reference_lengths():
    """By the commanded lengths, degrees per length, as central differences of another code give them."""
    at = expansion(np.zeros(len(KINDS)))
    assert abs(at["value"] - 35.5152802) < 1e-6  # it is the reference scene
    np.testing.assert_allclose(at["reverse"][:2] / 1.75, [-21.18765, 3.82786], rtol=1e-5)


@each_kind
def test_reference_differences(kind):
    """At (0.4, 1.0): first derivatives against differences of values, second ones against differences of the first."""
    axis = np.eye(len(KINDS))[KINDS.index(kind)]
    column = lambda t: np.append((at := expansion(t * axis))["value"], at["reverse"])
    at, found = expansion(0 * axis), differences(column, 1e-3)
    assert int(at["solution"].status) == jb.Status.OK
    np.testing.assert_allclose(at["reverse"][KINDS.index(kind)], found[0], rtol=FIRST)
    hessian = at["hessian"][KINDS.index(kind)]
    np.testing.assert_allclose(hessian, found[1:], rtol=0, atol=SECOND * np.abs(hessian).max())


@each_command
def test_forward_is_reverse(steps):
    at = expansion(steps)
    np.testing.assert_allclose(at["forward"], at["reverse"], rtol=1e-10)
    np.testing.assert_allclose(at["hessian"], at["hessian"].T, rtol=0, atol=1e-10 * np.abs(at["hessian"]).max())


@each_command
def test_taylor_remainders(steps):
    """What the linear and the quadratic model leave is of order 2 and 3, over two decades of step."""
    d = np.random.default_rng(1).uniform(-1, 1, len(KINDS))
    at = expansion(steps)
    slope, curvature = d @ at["reverse"], d @ at["hessian"] @ d
    sizes = np.geomspace(4e-5, 4e-3, 9)
    change = np.array([expansion(steps + h * d)["value"] - at["value"] for h in sizes])
    linear = np.abs(change - sizes * slope)
    quadratic = np.abs(change - sizes * slope - 0.5 * sizes**2 * curvature)
    order = lambda remainder: np.polyfit(np.log(sizes), np.log(remainder), 1)[0]
    assert order(linear) == pytest.approx(2, abs=0.02)
    assert order(quadratic) == pytest.approx(3, abs=0.02)


# ---------------------------------------------------------------------------- ten random scenes

SMALL = jb.tendon_beam(7, 5)
SMALL_ALONG = directions(SMALL)
COUNT = 10


def small_measures(theta, x0):
    """Angle, energy, smallest J and first ratio of the small beam, to differentiate; the same again, and solution."""
    scene = built(SMALL, theta)
    solution = jb.equilibrium(scene, x0, TIGHT)
    angle = jb.tip_angle(scene, solution.x)
    values = jnp.stack([angle, solution.energy, solution.smallest_jacobian, solution.ratios[0]])
    return values, (values, solution)


# Of `COUNT` stacked parameters and starts: derivatives by both, and `(values, solution)`.
slopes = jit(jax.vmap(jax.jacrev(small_measures, argnums=(0, 1), has_aux=True)))


def stacked(thetas):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *thetas)


def with_commands(theta, rows):
    """The parameters stacked `COUNT` times, with these commands; the last one fills what is left."""
    filled = [*rows, *[rows[-1]] * (COUNT - len(rows))]
    return stacked([theta | {"ratios": np.asarray(row)} for row in filled])


def random_parameters(seed):
    rng = np.random.default_rng(seed)
    theta = parameters(SMALL, rng.uniform(0.6, 1.2, 2))
    spacing = float(SMALL.mesh.nodes[1, 1] - SMALL.mesh.nodes[0, 1])
    return theta | {
        "modulus": rng.uniform(1e3, 3e3, 2),
        "young": rng.uniform(0.5e4, 2e4, theta["young"].shape),
        "poisson": rng.uniform(0.2, 0.45, theta["poisson"].shape),
        "load": 10 * rng.standard_normal(theta["load"].shape),
        "nodes": theta["nodes"] + 0.15 * spacing * rng.uniform(-1, 1, theta["nodes"].shape),
        "strap": {"stiffness": rng.uniform(0.1, 1, 1), "length": rng.uniform(3, 4, 1)},
    }


THETA = random_parameters(0)


@pytest.fixture(scope="module")
def random_scenes():
    """Parameters of ten random scenes, and what `slopes` finds of them from rest."""
    thetas = stacked([random_parameters(seed) for seed in range(COUNT)])
    return thetas, slopes(thetas, thetas["nodes"])


def directional(kind, thetas, found):
    """Derivatives of angle, energy, smallest J and ratio in a kind of parameter; the same by differences of solves."""
    (by_theta, _), (_, solution) = found
    np.testing.assert_array_equal(solution.status, jb.Status.OK)
    change = jax.tree.map(lambda leaf: leaf[KINDS.index(kind)], SMALL_ALONG)
    shifted = lambda t: slopes(jax.tree.map(lambda v, d: v + t * d, thetas, change), solution.x)[1][0]
    product = lambda slope, d: np.asarray(slope).reshape(COUNT, 4, -1) @ d.ravel()
    return sum(jax.tree.leaves(jax.tree.map(product, by_theta, change))), differences(shifted, 2e-3)


@each_kind
def test_random_differences(kind, random_scenes):
    slope, found = directional(kind, *random_scenes)
    np.testing.assert_allclose(slope[:, :3], found[:, :3], rtol=FIRST)


def test_rest_is_no_singular_point():
    """No NaN where tendons have no force and the singular values of F are equal, nor beside it."""
    thetas = with_commands(parameters(SMALL, [1.0, 1.0]), [[1.0, 1.0], [1.0, 1.0 - 1e-9]])
    found = slopes(thetas, thetas["nodes"])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found[0]))
    for kind in ("top command", "bottom command", "load"):  # the others do nothing here
        slope, expected = directional(kind, thetas, found)
        np.testing.assert_allclose(slope[:, 0], expected[:, 0], rtol=FIRST)
    assert np.isfinite(expansion(0.6 * np.eye(len(KINDS))[0])["hessian"]).all()


def test_energy_by_the_envelope_theorem(random_scenes):
    """A stationary energy changes as it would at fixed positions, but for the clamp, which the rest positions carry."""
    thetas, ((by_theta, _), (_, solution)) = random_scenes
    partial_slopes = jit(jax.vmap(jax.grad(lambda theta, x: jb.energy(built(SMALL, theta), x), argnums=(0, 1))))
    expected, by_x = partial_slopes(thetas, solution.x)
    expected["nodes"] += jnp.where(SMALL.fixed, by_x, 0)
    for got, wanted in zip(jax.tree.leaves(by_theta), jax.tree.leaves(expected), strict=True):
        # A first-order change of x that meets forces balanced to 1e-14 of the largest.
        np.testing.assert_allclose(got[:, 1], wanted, rtol=0, atol=1e-10 * np.abs(wanted).max())


def test_ratios_are_differentiable(random_scenes):
    _, ((by_theta, _), _) = random_scenes
    np.testing.assert_allclose(by_theta["ratios"][:, 3], np.tile([1.0, 0.0], (COUNT, 1)), rtol=1e-14)
    # Rest positions change natural and commanded length alike.
    np.testing.assert_allclose(by_theta["nodes"][:, 3], 0, atol=1e-14)
    assert not by_theta["young"][:, 3].any()


def test_start_has_no_influence(random_scenes):
    _, ((_, by_start), _) = random_scenes
    assert not by_start.any()


# ------------------------------------------------------------------------------ many commands

# Another linear solver than `slopes` uses, with which they are compared; and it compiles faster.
DENSE = jb.Newton(rtol=1e-14, linear=jb.Dense())
ROWS = [[0.7, 1.0], [1.0, 0.8], [0.9, 1.1]]
tip_angles = jax.vmap(jb.tip_angle, in_axes=(None, 0))


@jit
@partial(jax.jacrev, argnums=(0, 1), has_aux=True)
def ramp_slopes(theta, end):
    scene = built(SMALL, theta)
    path = jb.ramp(scene, end, len(ROWS), DENSE)
    return tip_angles(scene, path.x), path


@jit
@partial(jax.grad, argnums=(0, 1), has_aux=True)
def sweep_slopes(theta, rows, weights, masked):
    """Derivatives of a weighted sum of angles, by parameters and commands; and the solutions."""
    scene = built(SMALL, theta)
    batch = jb.sweep(scene, rows, DENSE)
    return jnp.where((batch.status == 0) | ~masked, tip_angles(scene, batch.x), 0) @ weights, batch


def close(got, expected):
    """Two solvers agree in the derivatives to what their round-off leaves."""
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * np.abs(b).max())


def angle_slopes(theta, rows, starts):
    """From `slopes`, a row for each command: derivatives of the angle by all but the command, and by the command."""
    starts = np.concatenate([starts, np.repeat(starts[-1:], COUNT - len(rows), axis=0)])
    (by_theta, _), _ = slopes(with_commands(theta, rows), starts)
    by_theta = jax.tree.map(lambda leaf: leaf[: len(rows), 0], by_theta)
    return by_theta, by_theta.pop("ratios")


@pytest.mark.slow
def test_ramp_step_by_step():
    """Each step's derivative is that of the equilibrium there; by the end command, its share of the way."""
    end = jnp.array([0.6, 0.9])
    (by_theta, by_end), path = ramp_slopes(THETA, end)
    np.testing.assert_array_equal(path.status, jb.Status.OK)
    expected, by_command = angle_slopes(THETA, jb.commands(end, len(ROWS)), path.x)
    assert not by_theta.pop("ratios").any()  # the ramp commands others
    close(by_theta, expected)
    close(by_end, by_command * np.linspace(0, 1, len(ROWS))[:, None])


@pytest.mark.slow
def test_sweep_lane_by_lane():
    for lane in range(len(ROWS)):
        (by_theta, by_rows), batch = sweep_slopes(THETA, jnp.array(ROWS), jnp.eye(len(ROWS))[lane], True)
        expected, by_command = angle_slopes(THETA, ROWS, batch.x)
        by_theta.pop("ratios")
        close(by_theta, jax.tree.map(lambda leaf, lane=lane: leaf[lane], expected))
        close(by_rows, np.eye(len(ROWS))[lane][:, None] * by_command)


@pytest.mark.parametrize("bad", [[value, 1.0] for value in (-0.5, 0.0, np.nan, np.inf)], ids=str)
def test_masked_sweep(bad):
    """A lane that failed and is not looked at leaves the gradient of the others; looked at, it is NaN."""
    rows, weights = jnp.array([ROWS[0], bad, ROWS[2]]), jnp.ones(len(ROWS))
    (by_theta, by_rows), batch = sweep_slopes(THETA, rows, weights, True)
    assert [bool(status) for status in batch.status] == [False, True, False]
    (expected, expected_rows), _ = sweep_slopes(THETA, jnp.array(ROWS), jnp.array([1.0, 0, 1]), True)
    close(by_theta, expected)
    close(by_rows[::2], expected_rows[::2])
    (by_theta, by_rows), _ = sweep_slopes(THETA, rows, weights, False)
    assert np.isnan(by_theta["young"]).all()
    assert np.isnan(by_rows[1]).all()


# ------------------------------------------------------------------------ outside jit, and float32


def scalar_angle(scalars):
    """Tip angle from one number for each property, all of it outside jit."""
    scene = built(SMALL, THETA | scalars)
    solution = jb.equilibrium(scene, None, DENSE)
    return jb.tip_angle(scene, solution.x), solution


@pytest.mark.slow
def test_scalars_outside_jit():
    """One Young's modulus, Poisson's ratio and tendon modulus for all."""
    scalars = {"young": 1e4, "poisson": 0.4, "modulus": 2e3}
    (_, solution), slope = jax.value_and_grad(scalar_angle, has_aux=True)(scalars)
    assert int(jb.check(solution).status) == jb.Status.OK
    for name, value in scalars.items():
        found = differences(
            lambda t, name=name, value=value: scalar_angle(scalars | {name: value + t})[0], 2e-3 * value
        )
        np.testing.assert_allclose(slope[name], found, rtol=FIRST)


def test_new_values_compile_nothing():
    """Gradients at other commands, moduli, and on another topology of the same shape: traced once, for all of them."""
    slope = lambda beam, theta: jax.grad(
        lambda young: jb.equilibrium(built(beam, theta | {"young": young}), None, DENSE).x[-1, 1]
    )(theta["young"])
    slope(SMALL, THETA)
    before = traces["density"]
    mirrored = jb.tendon_beam(7, 5, diagonals="mirrored")
    for beam, theta in ((SMALL, THETA | {"ratios": np.array([0.8, 0.9])}), (mirrored, random_parameters(1))):
        assert np.isfinite(slope(beam, theta)).all()
    assert traces["density"] == before


def test_a_gradient_takes_no_newton_steps():
    """Of a sweep, as many as of the same one without a derivative, compiled alike: round-off decides the last step."""
    rows = jnp.array(ROWS)
    _, batch = sweep_slopes(THETA, rows, jnp.ones(len(ROWS)), True)
    plain = jit(lambda theta: jb.sweep(built(SMALL, theta), rows, DENSE))(THETA)
    np.testing.assert_array_equal(batch.steps, plain.steps)


def single_slope(theta):
    """The gradient of the tip angle of a float32 scene."""
    single = jb.tendon_beam(7, 5, dtype=jnp.float32)

    def angle(theta):
        scene = built(single, theta)
        return jb.tip_angle(scene, jb.equilibrium(scene, None, jb.Newton(linear=jb.Dense())).x)

    return jax.grad(angle)(theta)


SINGLE_THETA = jax.tree.map(lambda leaf: leaf.astype(np.float32), THETA)


@pytest.mark.slow
def test_float32_of_a_beam():
    """The gradient of a float32 scene is near that of the same scene in float64."""
    by_theta = jit(single_slope)(SINGLE_THETA)
    (expected, _), _ = slopes(stacked([THETA] * COUNT), stacked([THETA["nodes"]] * COUNT))
    for got, wanted in zip(jax.tree.leaves(by_theta), jax.tree.leaves(expected), strict=True):
        assert got.dtype == jnp.float32
        np.testing.assert_allclose(got, wanted[0, 0], rtol=0, atol=1e-3 * np.abs(wanted[0, 0]).max())


# ------------------------------------------------- two springs: closed form, and no derivative

PAIR = spring_pair(1.0)
ABOVE = PAIR.mesh.nodes.at[2, 1].set(0.5)
IMPATIENT = jb.Newton(max_steps=1, escape=False, linear=jb.Dense())


def hung(ratios, x0, solver=DENSE):
    """Where the free node comes to rest, `x + 2 y`."""
    solution = jb.equilibrium(jb.command(PAIR, ratios), x0, solver)
    return solution.x[2] @ jnp.array([1.0, 2.0]), solution


def apex(ratios):
    """The same, of a triangle over the base 2 whose sides have the commanded lengths."""
    across = (ratios[0] ** 2 - ratios[1] ** 2) / 4
    return across + 2 * jnp.sqrt(ratios[0] ** 2 - (1 + across) ** 2)


@partial(jit, static_argnames="solver")
def hung_slopes(ratios, x0, solver=DENSE):
    return to_second_order(lambda ratios: hung(ratios, x0, solver))(ratios)


TAUT = np.array([1.2, 1.1])


def test_closed_form():
    at = hung_slopes(TAUT, ABOVE)
    assert at["value"] == pytest.approx(float(apex(TAUT)), rel=1e-12)
    for name in ("forward", "reverse"):
        np.testing.assert_allclose(at[name], jit(jax.grad(apex))(TAUT), rtol=1e-10)
    np.testing.assert_allclose(at["hessian"], jit(jax.hessian(apex))(TAUT), rtol=1e-10)


def test_float32():
    """The gradient of a float32 scene is float32: of a beam by its shapes, of the springs also near the closed form."""
    assert {leaf.dtype for leaf in jax.tree.leaves(jax.eval_shape(single_slope, SINGLE_THETA))} == {jnp.float32.dtype}
    pair = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), PAIR)

    @jit
    @jax.grad
    def slope(ratios):
        solution = jb.equilibrium(jb.command(pair, ratios), ABOVE.astype(jnp.float32), jb.Newton(linear=jb.Dense()))
        return solution.x[2] @ jnp.array([1.0, 2.0], jnp.float32)

    found = slope(TAUT.astype(np.float32))
    assert found.dtype == jnp.float32
    # Forces balance to 1e-6.
    np.testing.assert_allclose(found, jit(jax.grad(apex))(TAUT), rtol=1e-5)


@pytest.mark.slow
def test_compositions():
    """The other orders in which to differentiate twice, and one in which to do so thrice, against the closed form."""

    @jit
    def composed(ratios, x0):
        value = lambda ratios: hung(ratios, x0)[0]
        reverse = lambda ratios: (both := jax.jacrev(jax.jacrev(value))(ratios), both)
        thrice, both = jax.jacfwd(reverse, has_aux=True)(ratios)
        return [both, jax.jacfwd(jax.jacfwd(value))(ratios), jax.jacrev(jax.jacfwd(value))(ratios)], thrice

    twice, thrice = composed(TAUT, ABOVE)
    for hessian in twice:
        np.testing.assert_allclose(hessian, jit(jax.hessian(apex))(TAUT), rtol=1e-10)
    np.testing.assert_allclose(thrice, jit(jax.jacfwd(jax.hessian(apex)))(TAUT), rtol=1e-9)


def test_ends_of_a_tendon_nearly_meet():
    """2e-6 apart: the node moves along the line by half the difference of the commands."""
    at = hung_slopes(np.array([1e-6, 2 - 3e-6]), PAIR.mesh.nodes)
    assert int(at["solution"].status) == jb.Status.OK
    assert 1 + at["solution"].x[2, 0] == pytest.approx(2e-6, rel=1e-6)
    np.testing.assert_allclose(at["reverse"], [0.5, -0.5], rtol=1e-6)
    np.testing.assert_allclose(at["forward"], [0.5, -0.5], rtol=1e-6)


NOWHERE = {
    "limit of stability": ([1.0, 1.0], PAIR.mesh.nodes, DENSE, jb.Status.INACCURATE),
    "negative command": ([-1.0, 1.0], PAIR.mesh.nodes, DENSE, jb.Status.INVALID),
    "saddle": ([1.1, 1.1], PAIR.mesh.nodes, IMPATIENT, jb.Status.UNSTABLE),
    "one Newton step": ([1.1, 1.1], ABOVE, IMPATIENT, jb.Status.NOT_CONVERGED),
}


@pytest.mark.parametrize(("ratios", "x0", "solver", "flag"), NOWHERE.values(), ids=NOWHERE)
def test_no_derivative_without_an_answer(ratios, x0, solver, flag):
    at = hung_slopes(np.array(ratios), x0, solver)
    assert int(at["solution"].status) & flag
    assert all(np.isnan(at[name]).all() for name in ("forward", "reverse", "hessian"))


def test_vmap_is_a_loop():
    """Of the derivatives, too: a lane without one is NaN, and its neighbours do not notice."""
    rows = jnp.array([[1.2, 1.1], [0.9, 0.8], [-1.0, 1.0], [1.1, 1.2]])
    many = jit(jax.vmap(jax.value_and_grad(hung, has_aux=True), in_axes=(0, None)))(rows, ABOVE)
    for lane, row in enumerate(rows):
        one = hung_slopes(row, ABOVE)
        (value, solution), slope = jax.tree.map(lambda leaf, lane=lane: leaf[lane], many)
        assert (solution.status == 0) == (one["solution"].status == 0)
        np.testing.assert_allclose(value, one["value"], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(slope, one["reverse"], rtol=1e-12, atol=1e-12)


def test_start_may_be_a_constant_inside_jit():
    jax.eval_shape(lambda ratios: hung(ratios, np.asarray(ABOVE)), TAUT)


def test_sweep_in_forward_mode():
    """The lanes do not mix: each moves with its own command, by half the difference, or is NaN."""
    rows = np.array([[0.8, 0.9], [-1.0, 1.0], [0.9, 0.7]])
    across = jit(jax.jacfwd(lambda rows: jb.sweep(PAIR, rows, DENSE).x[:, 2, 0]))(rows)
    expected = np.eye(3)[:, :, None] * np.array([0.5, -0.5])
    expected[1, 1] = np.nan
    np.testing.assert_allclose(across, expected, rtol=1e-12, atol=1e-12)


# ------------------------------------------------- every solver, every order, every transformation

TINY = jb.tendon_beam(3, 2)
BENT = np.array([0.8, 1.0])


def tip(scene, x):
    return jb.tip_angle(scene, x)


# Each is the tip angle at a command, by another solver or inside another transformation. `ramp` and `sweep` run the
# body of a scan, and JAX partially evaluates that when it is differentiated in reverse.
SOLVED = {
    "equilibrium": lambda r: tip(TINY, jb.equilibrium(jb.command(TINY, r), solver=TIGHT).x),
    "ramp": lambda r: tip(TINY, jb.ramp(TINY, r, 3, TIGHT).x[-1]),
    "sweep": lambda r: tip(TINY, jb.sweep(TINY, jnp.stack([r, 1.1 * r]), TIGHT).x[0]),
    "map": lambda r: jax.lax.map(SOLVED["equilibrium"], jnp.stack([r, 0.9 * r]))[0],
    "scan": lambda r: jax.lax.scan(lambda sum, q: (sum + SOLVED["equilibrium"](q), None), 0.0, r[None])[0],
    "checkpoint": lambda r: jax.checkpoint(SOLVED["equilibrium"])(r),
    "vmap": lambda r: jax.vmap(SOLVED["equilibrium"])(jnp.stack([r, 0.9 * r]))[0],
    "checkpointed map": lambda r: jax.lax.map(jax.checkpoint(SOLVED["equilibrium"]), r[None])[0],
    "map of ramps": lambda r: jax.lax.map(SOLVED["ramp"], r[None])[0],
    "vmap of ramps": lambda r: jax.vmap(SOLVED["ramp"])(r[None])[0],
}
MODES = {"f": jax.jacfwd, "r": jax.jacrev}


@pytest.fixture(scope="module")
def expected():
    """Derivatives of the tip angle to third order: the first is implicit, the others are differences of it."""
    slope = jit(jax.grad(SOLVED["equilibrium"]))
    at = lambda u: differences(lambda t: slope(jnp.asarray(BENT + t * u)), 0.01)
    second = np.stack([at(u) for u in np.eye(2)])
    # Second differences of the slope, along both axes and the diagonal.
    bend = lambda u: (
        sum(
            w * np.asarray(slope(jnp.asarray(BENT + 0.01 * k * u)))
            for k, w in ((-3, 2), (-2, -27), (-1, 270), (0, -490), (1, 270), (2, -27), (3, 2))
        )
        / (180 * 0.01**2)
    )
    x, y, both = (bend(np.array(u)) for u in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0)))
    mixed = (both - x - y) / 2
    return {1: np.asarray(slope(jnp.asarray(BENT))), 2: second, 3: np.array([[x, mixed], [mixed, y]])}


# A ramp and a sweep are differentiated by the same function. Third derivatives compile for half a minute; in default
# runs the rule under them is differentiated thrice in tests/core/test_derivative.py.
FAST = [("sweep", "fr")]
ALL = [(solver, modes) for solver in SOLVED for modes in ("ff", "fr", "rf", "rr", "frr", "rrr", "fff")]


@pytest.mark.parametrize(
    ("solver", "modes"), [*FAST, *(pytest.param(*each, marks=pytest.mark.slow) for each in ALL if each not in FAST)]
)
def test_derivatives_of_every_solver(expected, solver, modes):
    f = SOLVED[solver]
    for mode in modes[::-1]:
        f = MODES[mode](f)
    truth = expected[len(modes)]
    np.testing.assert_allclose(jit(f)(jnp.asarray(BENT)), truth, rtol=0, atol=SECOND * np.abs(truth).max())


@pytest.mark.slow
@pytest.mark.parametrize("scene", [jb.rod_beam(3), jb.rod_beam(3, density=jb.neo_hookean)], ids=["rod", "logarithmic"])
def test_second_derivatives_of_a_ramped_rod(scene):
    """The fibres of a rod are implicit functions too."""
    one = jax.hessian(lambda r: tip(scene, jb.equilibrium(jb.command(scene, r), solver=TIGHT).x))
    ramped = jax.hessian(lambda r: tip(scene, jb.ramp(scene, r, 3, TIGHT).x[-1]))
    truth = jit(one)(jnp.asarray(BENT))
    np.testing.assert_allclose(jit(ramped)(jnp.asarray(BENT)), truth, rtol=0, atol=1e-9 * np.abs(truth).max())


# ------------------------------------------------------------------------------------ the linear response


def response(v):
    """The tip angle by linear elasticity, at a command, with a Young's modulus, a length and a load."""
    mesh = jb.rectangle(3.5 * v[3], 0.8, 3, 2)
    pulls = jb.tendons(mesh, [[1, 3], [0, 2]], 2e3)
    load = jb.dead_load(mesh, [5], 10 * jnp.stack([v[3], v[4]])[None])
    terms = (jb.solid(mesh, jb.lame(1e4 * v[2], 0.4)), pulls, load)
    scene = jb.command(jb.Scene(mesh, terms, jb.clamped(mesh, [0, 1]), np.array([4, 5])), v[:2])
    return jb.tip_angle(scene, jb.linear_response(scene))


LINEAR = jnp.array([0.8, 1.0, 1.0, 1.0, 0.5])


@pytest.mark.slow
def test_slopes_of_the_linear_response():
    """To second order; the value is that outside of any transformation."""
    v = LINEAR
    first, second = jit(jax.grad(response)), jit(jax.hessian(response))(v)
    truth = differences_along(response, v)
    np.testing.assert_allclose(jax.jvp(response, (v,), (jnp.ones(5),))[0], response(v), rtol=1e-12)
    np.testing.assert_allclose(first(v), truth, rtol=0, atol=FIRST * np.abs(truth).max())
    truth = differences_along(first, v)
    np.testing.assert_allclose(second, truth, rtol=0, atol=SECOND * np.abs(truth).max())


@pytest.mark.slow
@pytest.mark.parametrize("mapped", [jax.lax.map, lambda f, rows: jax.vmap(f)(rows)], ids=["map", "vmap"])
def test_second_derivatives_of_mapped_linear_responses(mapped):
    second = jit(jax.hessian(response))(LINEAR)
    lanes = lambda v: mapped(response, jnp.stack([v, 1.1 * v]))[0]
    for twice in (jax.jacrev(jax.jacrev(lanes)), jax.jacfwd(jax.jacfwd(lanes))):
        np.testing.assert_allclose(jit(twice)(LINEAR), second, rtol=0, atol=1e-9 * np.abs(second).max())


def differences_along(f, v):
    return np.stack([differences(lambda t, e=e: f(v + t * e), 1e-3) for e in np.eye(len(v))], axis=-1)


def test_no_slope_of_a_linear_response_that_is_unstable():
    """NaN, and under `vmap` its neighbours do not notice."""
    place = lambda ratio: jb.linear_response(jb.command(PAIR, jnp.stack([ratio, 0.9 * ratio])))[2, 0]
    both = jnp.array([0.9, 1.3])
    np.testing.assert_array_equal(np.isnan(jit(jax.vmap(jax.value_and_grad(place)))(both)), [[False, True]] * 2)
    shared = jit(jax.grad(lambda factor: jax.vmap(place)(factor * both)[0]))(1.0)
    np.testing.assert_allclose(shared, 0.9 * jit(jax.grad(place))(0.9), rtol=1e-12)
    assert np.isfinite(shared)


def test_slopes_of_a_linear_response_of_springs():
    """To second order, and `lax.map` changes nothing."""
    place = lambda ratio: jb.linear_response(jb.command(PAIR, jnp.stack([ratio, 0.9 * ratio])))[2, 0]
    slope = jit(jax.grad(place))
    assert slope(0.8) == pytest.approx(differences(lambda t: place(0.8 + t), 1e-3), rel=FIRST)
    curvature = jit(jax.grad(jax.grad(lambda ratio: jax.lax.map(place, ratio[None])[0])))(jnp.asarray(0.8))
    assert curvature == pytest.approx(differences(lambda t: slope(0.8 + t), 1e-3), rel=SECOND)
