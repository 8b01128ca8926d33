"""Equilibria against published and closed-form answers, and what is said of those that are none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import PAIR_NODES, affine, macneal_harder, small_beam, spring_pair, traces

import jaxbeam as jb
from jaxbeam.core.tree import unlock
from jaxbeam.linear.layout import assemble
from jaxbeam.scene.evaluation import stencil_hessians
from jaxbeam.solve.newton import Policy, newton, topology

# Converged answers of two independent codes: ratios, tip angle in degrees and lengths of the tendons where known.
REFERENCE = [
    ([0.4, 1.0], 35.5152802, [0.9342211, 1.9252493]),
    ([1.0, 0.4], -34.9502718, [1.9273442, 0.9245819]),
    ([0.6, 1.4], 27.34482, None),
    ([0.8, 1.2], 13.35328, None),
    ([1.2, 0.8], -13.39917, None),
    ([1.4, 0.6], -27.24721, None),
]
ANGLE, LENGTH, BALANCE = 1e-6, 1e-7, 1e-9  # demanded of the reference scene: degrees, length, share of the largest


def check_reference(scene, solution, angle, lengths):
    jb.check(solution)
    # Angles printed with five digits are known to one unit of the last: -27.24721 is -27.2472165, cut off.
    tolerance = ANGLE if lengths else 1e-5
    assert abs(jb.tip_angle(scene, solution.x) - angle) < tolerance
    if lengths:
        np.testing.assert_allclose(jb.tendon_lengths(scene, solution.x), lengths, rtol=0, atol=LENGTH)
    assert solution.residual < BALANCE
    assert solution.residual <= solution.tolerance
    assert int(solution.status) == jb.Status.OK
    check_balance(scene, solution.x)


def check_balance(scene, x, load=(0.0, 0.0, 0.0), share=BALANCE):
    """Free coordinates are in balance; reactions balance a load (force and moment) from outside."""
    fixed, x = scene.fixed, np.asarray(x)
    nodal, held = np.asarray(jb.forces(scene, x)), np.asarray(jb.reactions(scene, x))
    largest = np.abs(held).max()
    assert np.abs(nodal[~fixed]).max() < share * largest
    np.testing.assert_array_equal(held[fixed], -nodal[fixed])
    assert not held[~fixed].any()
    moment = np.sum(x[:, 0] * held[:, 1] - x[:, 1] * held[:, 0])
    extent = np.abs(x).max()
    np.testing.assert_allclose(
        [*held.sum(axis=0), moment / extent], -np.array(load) / [1, 1, extent], atol=share * largest
    )


@pytest.mark.parametrize(("ratios", "angle", "lengths"), REFERENCE, ids=str)
def test_reference(beam, ratios, angle, lengths):
    scene = jb.command(beam, ratios)
    solution = jb.equilibrium(scene)
    check_reference(scene, solution, angle, lengths)
    assert solution.steps <= 20  # in one jump, from rest


def test_reference_ramp(beam, bent_path):
    final = jax.tree.map(lambda leaf: leaf[-1], bent_path)
    check_reference(jb.command(beam, [0.4, 1.0]), final, 35.5152802, [0.9342211, 1.9252493])


def test_reference_fold(beam, folded_path):
    """Both tendons to 0.4: past the fold, where a solver that stops early prints -3.4."""
    final = jax.tree.map(lambda leaf: leaf[-1], folded_path)
    check_reference(jb.command(beam, [0.4, 0.4]), final, -5.0890962, [1.1427431, 1.1117417])


def test_solution_fields(steered):
    scene, solution = steered
    np.testing.assert_allclose(solution.energy, jax.jit(jb.energy)(scene, solution.x), rtol=1e-12)
    np.testing.assert_array_equal(solution.x[scene.fixed], scene.mesh.nodes[scene.fixed])
    assert solution.status.dtype == jnp.int32
    assert 0 < solution.smallest_jacobian < 1
    assert 0 <= solution.projected <= solution.steps
    # Unpulled tendons and a body at rest: nothing to do, and found out in no step.
    rest = jb.equilibrium(jb.command(scene, [1.0, 1.0]))
    assert (int(rest.steps), float(rest.residual), float(rest.energy)) == (0, 0.0, 0.0)
    np.testing.assert_array_equal(rest.x, scene.mesh.nodes)


def test_residual_is_what_it_says():
    """Where no step is allowed: the unbalanced force over the sum of the magnitudes that meet there."""
    scene = jb.command(spring_pair(1.0), [0.9, 0.8])
    solution = jb.equilibrium(scene, solver=jb.Newton(max_steps=0))
    # Springs of stiffness 3 pull by 0.3 to the left and 0.6 to the right. The round-off term adds 1e-4 at most:
    # 4 eps times a stiffness of 6 and a length of 1, over rtol 1e-10, next to 0.9.
    np.testing.assert_allclose(solution.residual, 0.3 / 0.9, rtol=1e-4)
    assert int(solution.status) == jb.Status.NOT_CONVERGED
    assert solution.steps == 0
    np.testing.assert_array_equal(solution.x, PAIR_NODES)


# ------------------------------------------------------------------------------- symmetry and units


def test_symmetric_pull_does_not_bend(mirrored):
    scene = jb.command(mirrored, [0.7, 0.7])
    solution = jb.check(jb.equilibrium(scene))
    assert abs(jb.tip_angle(scene, solution.x)) < 1e-9


def test_symmetric_pull_past_the_fold_is_straight_and_stable(mirrored):
    """What the one-sided mesh does at (0.4, 0.4) comes from its diagonals alone."""
    path = jb.check(jb.ramp(mirrored, [0.4, 0.4], steps=28))
    assert abs(jb.tip_angle(mirrored, path.x[-1])) < 1e-9


def test_mirror_images(mirrored):
    up, down = (jb.check(jb.equilibrium(jb.command(mirrored, r))).x for r in ([0.4, 1.0], [1.0, 0.4]))
    image = np.arange(203).reshape(29, 7)[:, ::-1].ravel()
    np.testing.assert_allclose(up[image] * jnp.array([1.0, -1.0]), down, rtol=0, atol=1e-9)
    assert round(float(jb.tip_angle(mirrored, up)), 3) == 34.957


@pytest.mark.parametrize(("length_unit", "force_unit"), [(1e3, 1.0), (1e3, 1e-3), (39.37, 0.2248)])
def test_unit_invariance(steered, length_unit, force_unit):
    """Young's modulus is a force per length (thickness is 1), the tendon's modulus a force times a length."""
    scene = jb.tendon_beam(
        length=3.5 * length_unit,
        height=0.8 * length_unit,
        young=1e4 * force_unit / length_unit,
        tendon_modulus=2e3 * force_unit * length_unit,
    )
    solution = jb.equilibrium(jb.command(scene, [0.4, 1.0]))
    original = steered[1]
    # Both stop at a residual of 1e-10 or less; another rounding leads them to points 1e-10 apart, not more.
    assert abs(jb.tip_angle(scene, solution.x) - jb.tip_angle(steered[0], original.x)) < 1e-9
    assert (int(solution.steps), int(solution.status)) == (int(original.steps), int(original.status))
    np.testing.assert_allclose(solution.energy, original.energy * force_unit * length_unit, rtol=1e-9)


# ------------------------------------------------------------------------------- known solutions


@pytest.mark.parametrize("F", [[[1.3, 0.4], [-0.2, 0.8]], [[0.6, 0.0], [0.3, 1.1]]])
def test_displacement_patch(F):
    """The patch of MacNeal and Harder (1985): with its edge moved linearly, its inside follows linearly."""
    mesh = macneal_harder()
    moved = affine(mesh, F)
    body = jb.solid(mesh, jb.lame(1e6, 0.25), jb.neo_hookean)
    # The edge is fixed where the scene's own nodes are: there, and stretched from the rest shape of the body.
    scene = jb.Scene(jb.Mesh(moved, mesh.elements), (body,), jb.clamped(mesh, [4, 5, 6, 7]))
    x0 = moved.at[:4].add(0.01 * jnp.array([[0.5, -0.3], [-0.4, 0.2], [0.3, 0.5], [0.1, -0.5]]))
    solution = jb.check(jb.equilibrium(scene, x0))
    assert solution.steps > 0
    # 1e-9 of the patch's length: the residual of 1e-10, over a stiffness matrix of condition below 10.
    np.testing.assert_allclose(solution.x, moved, rtol=0, atol=1e-9 * 0.24)


@pytest.mark.slow
def test_slender_cantilever():
    """Against Euler and Bernoulli in plane strain, `F L^3 / (3 E' I)`, `E' = E / (1 - nu^2)`, `I = h^3 / 12`.

    The load bends the tip by 1e-4 of the length, so curvature effects are 1e-8. The theory has no shear:
    Timoshenko's correction is `3 E' I / (5/6 G h L^2)`, 0.2 % here. Triangles are too stiff by an error of
    second order in their size, which must shrink, until at 8 cells across less than 1 % is left.
    """
    length, height, young, poisson = 20.0, 1.0, 1e5, 0.3
    plane = young / (1 - poisson**2)
    load = 1e-4 * length * 3 * plane * height**3 / 12 / length**3
    errors = []
    for cells in (4, 8):
        mesh = jb.rectangle(length, height, 20 * cells + 1, cells + 1, diagonals="crossed")
        left, right = (jb.nodes_where(mesh, lambda x, y, e=e: np.abs(x - e) < 1e-9) for e in (-10, 10))
        body = jb.solid(mesh, jb.lame(young, poisson), jb.neo_hookean)
        pull = jb.dead_load(mesh, right, [0.0, -load / right.size])
        scene = jb.Scene(mesh, (body, pull), jb.clamped(mesh, left), right)
        solution = jb.check(jb.equilibrium(scene))
        moment = -load * float(jb.tip_position(scene, solution.x)[0])
        # Positions near 10 carry errors of 1e-15, which a stiffness of 3e5 turns into 3e-10, of reactions of 0.1.
        check_balance(scene, solution.x, load=(0.0, -load, moment), share=1e-7)
        deflection = float(mesh.nodes[right, 1].mean() - jb.tip_position(scene, solution.x)[1])
        errors.append(deflection / (1e-4 * length) - 1)
    size = np.abs(errors)
    assert size[0] > 3 * size[1]
    assert size[1] < 0.01
    # Second order, so the limit can be told (Richardson); what is left is the theory's own error.
    assert abs((4 * errors[1] - errors[0]) / 3) < 0.004


@pytest.mark.slow
def test_penalty_clamp(beam, steered):
    """The published clamp, springs of 1e9 on the left edge, gives the eliminated clamp's answer to 1e-5 degrees."""
    exact, solution = steered
    left = np.flatnonzero(exact.fixed.all(axis=1))
    springs = jb.penalty_springs(exact.mesh, left, 1e9)
    scene = jb.Scene(exact.mesh, (*exact.terms, springs), np.zeros_like(exact.fixed), exact.tip)
    soft = jb.check(jb.equilibrium(scene))
    shift = float(jb.tip_angle(exact, soft.x) - jb.tip_angle(exact, solution.x))
    assert 0 < abs(shift) < 1e-5
    # The springs carry what the clamp carries, to the share that a shift of 1e-6 makes.
    carried = -1e9 * (soft.x - exact.mesh.nodes)[left]
    held = jb.reactions(exact, solution.x)[left]
    np.testing.assert_allclose(carried, held, atol=1e-4 * np.abs(held).max())


def test_dense_gives_the_same(beam):
    scene = jb.command(small_beam(), [0.5, 1.0])
    banded, dense = (
        jb.check(jb.equilibrium(scene, solver=jb.Newton(linear=s))) for s in (jb.BlockTridiagonal(), jb.Dense())
    )
    np.testing.assert_allclose(banded.x, dense.x, atol=1e-10)
    assert banded.steps == dense.steps


# --------------------------------------------------------------------------------------- start


def test_start(beam, steered):
    """From the answer: no step. Fixed coordinates of a start are put at rest. NumPy and lists are taken."""
    scene, solution = steered
    again = jb.check(jb.equilibrium(scene, np.asarray(solution.x)))
    assert again.steps == 0
    np.testing.assert_array_equal(again.x, solution.x)
    pushed = jnp.where(scene.fixed, solution.x + 5.0, solution.x).tolist()
    same = jb.check(jb.equilibrium(scene, pushed))
    np.testing.assert_array_equal(same.x, solution.x)


@pytest.mark.parametrize(
    ("x0", "message"),
    [
        (np.zeros((4, 2)), r"x0: expected node positions of shape \(15, 2\), got \(4, 2\)"),
        (np.zeros(30), r"x0: expected node positions of shape \(15, 2\), got \(30,\)"),
        (
            np.where(np.arange(30).reshape(15, 2) == 7, np.nan, 0),
            r"x0: expected finite positions, got \[0.0, nan\] at node 3",
        ),
        (np.full((15, 2), np.inf), r"x0: expected finite positions, got \[inf, inf\] at node 0"),
    ],
)
def test_start_refuses(x0, message):
    with pytest.raises(ValueError, match=message):
        jb.equilibrium(small_beam(), x0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"max_steps": -1}, "max_steps: expected a whole number of at least 0, got -1"),
        ({"max_steps": 2.0}, r"max_steps: expected a whole number of at least 0, got 2\.0"),
        ({"rtol": 0.0}, r"rtol: expected a number between 0 and 1, got 0\.0"),
        ({"rtol": 1.0}, r"rtol: expected a number between 0 and 1, got 1\.0"),
        ({"rtol": np.nan}, "rtol: expected a number between 0 and 1, got nan"),
        ({"keep_volume": 0.0}, r"keep_volume: expected a number between 0 and 1, got 0\.0"),
        ({"keep_volume": 1.5}, r"keep_volume: expected a number between 0 and 1, got 1\.5"),
    ],
)
def test_newton_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        jb.Newton(**arguments)


def test_newton_is_a_value():
    assert jb.Newton() == jb.Newton()
    assert hash(jb.Newton(rtol=1e-8)) == hash(jb.Newton(rtol=1e-8))
    assert jb.Newton(rtol=1e-8) != jb.Newton()
    assert jb.Newton(rtol=1e-8).tolerance(jnp.float32) == 1e-8
    assert jb.Newton().tolerance(jnp.float32) > jb.Newton().tolerance(jnp.float64)


# -------------------------------------------------------------------------------------- status


# A solver that reports a saddle instead of leaving it.
STAY = jb.Newton(escape=False)


def test_saddle_is_unstable():
    """Two compressed springs in line balance at their midpoint, and are not held there."""
    solution = jb.equilibrium(spring_pair(1.2), solver=STAY)
    assert int(solution.status) == jb.Status.UNSTABLE
    assert (int(solution.steps), float(solution.residual)) == (0, 0.0)
    np.testing.assert_array_equal(solution.x, PAIR_NODES)


def test_saddle_is_left_for_a_stable_neighbour():
    """By default the midpoint is left along its soft mode, to one side or the other."""
    solution = jb.check(jb.equilibrium(spring_pair(1.2)))
    assert solution.attempts == 2
    np.testing.assert_allclose(solution.x[2, 0], 0, atol=1e-9)
    np.testing.assert_allclose(jnp.abs(solution.x[2, 1]), np.sqrt(1.2**2 - 1), atol=1e-9)


@pytest.mark.parametrize("side", [1, -1])
def test_snapped_state_is_stable(side):
    x0 = PAIR_NODES.copy()
    x0[2, 1] = side * 1e-3
    solution = jb.check(jb.equilibrium(spring_pair(1.2), x0))
    np.testing.assert_allclose(solution.x[2], [0, side * np.sqrt(1.2**2 - 1)], atol=1e-9)
    assert solution.projected >= 1  # beside the saddle the true Hessian is indefinite
    assert solution.energy < 1e-15


def test_taut_springs_are_stable():
    solution = jb.check(jb.equilibrium(spring_pair(0.9)))
    assert solution.steps == 0
    assert np.isinf(solution.smallest_jacobian)  # no solid, so nothing is inverted


def test_limit_of_stability_is_inaccurate():
    """At their natural length the springs hold the midpoint along the line and not across: no sign can be told."""
    solution = jb.equilibrium(spring_pair(1.0))
    assert int(solution.status) == jb.Status.INACCURATE
    assert abs(float(jb.lowest_mode(spring_pair(1.0), solution.x).values[0])) < 1e-15
    with pytest.raises(jb.EquilibriumError, match=r"INACCURATE: .* whether the equilibrium is stable: use float64"):
        jb.check(solution)
    # The stiffness across is 6 times the distance from ratio 1, and its round-off is eps times 6.
    nearly = jb.equilibrium(spring_pair(np.nextafter(1.0, 0.0)))
    assert int(nearly.status) == jb.Status.INACCURATE
    for ratio in (1 - 1e-9, 1 + 1e-9):
        assert not int(jb.equilibrium(spring_pair(ratio), solver=STAY).status) & jb.Status.INACCURATE


def test_softer_than_round_off_is_inaccurate():
    """A slender beam in float32: the forces balance to the last bit, and positions are still not known."""
    thin = lambda dtype: jb.tendon_beam(5, 3, height=1e-3, tendon_modulus=2.0, dtype=dtype)
    single, double = (jb.equilibrium(jb.command(thin(dtype), [0.7, 1.0])) for dtype in (jnp.float32, jnp.float64))
    assert int(single.status) == jb.Status.INACCURATE
    assert single.residual <= single.tolerance
    assert np.abs(np.asarray(single.x) - np.asarray(jb.check(double).x)).max() > 1e-3


def test_traced_scene_that_is_not_held_is_flagged():
    """Concrete, it is refused before any solve; traced, its rigid motions leave the stability open."""
    mesh = jb.rectangle(2.0, 1.0, 5, 3)

    def status(nodes, load):
        loose = jb.Mesh(nodes, mesh.elements)
        terms = (jb.solid(loose, jb.lame(1.0, 0.3)), jb.dead_load(loose, [14], jnp.array([1.0, 0.0]) * load))
        return jb.equilibrium(jb.Scene(loose, terms, np.zeros((15, 2), bool))).status

    traced = jax.jit(status)
    for load in (0.0, 1e-3):
        assert int(traced(mesh.nodes, load)) & (jb.Status.INACCURATE | jb.Status.NOT_CONVERGED)
        with pytest.raises(ValueError, match="fixed: the body is not held"):
            status(mesh.nodes, load)


def triangle(density, load=0.0):
    """One triangle, its base clamped, its apex free."""
    mesh = jb.Mesh([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [[0, 1, 2]])
    terms = (jb.solid(mesh, jb.Lame(3.0, 7.0), density), jb.dead_load(mesh, [2], jnp.array([0.0, 1.0]) * load))
    return jb.Scene(mesh, terms, jb.clamped(mesh, [0, 1]))


TURNED_OVER = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, -1.0]])


def test_inverted_start_is_refused():
    """Saint Venant-Kirchhoff turned inside out is at rest, stable, and nonsense: only J tells."""
    for density in (jb.saint_venant_kirchhoff, jb.neo_hookean):
        with pytest.raises(ValueError, match=r"x0: element 0 is inverted \(J = -1\); start from rest"):
            jb.equilibrium(triangle(density), TURNED_OVER)


def test_inverted_equilibrium_is_not_ok():
    """The same start where it cannot be refused, inside jit."""
    scene = triangle(jb.saint_venant_kirchhoff)
    solve = jax.jit(lambda x0: jb.equilibrium(scene, x0, jb.Newton(max_steps=0)))
    solution = solve(TURNED_OVER)
    assert int(solution.status) & jb.Status.INVERTED
    assert int(solve(np.asarray(scene.mesh.nodes)).status) == jb.Status.OK
    with pytest.raises(jb.EquilibriumError, match=r"INVERTED: residual .* in element 0.*an element is turned"):
        jb.check(solution)


def test_inverted_equilibrium_is_left_for_the_one_from_rest():
    """It balances at once; with steps to spend, it is kept only if a shorter way leads there too."""
    scene = triangle(jb.saint_venant_kirchhoff)
    found = jb.check(jax.jit(lambda x0: jb.equilibrium(scene, x0))(TURNED_OVER))
    np.testing.assert_allclose(found.x[2], [0, 1], atol=1e-9)


def test_logarithm_stays_on_its_side():
    """Started inside out where that cannot be refused, it is recovered from rest; no step crosses J = 0."""
    solve = jax.jit(lambda x0, load: jb.equilibrium(triangle(jb.neo_hookean, load), x0))
    np.testing.assert_allclose(jb.check(solve(TURNED_OVER, 0.0)).x[2], [0, 1], atol=1e-9)
    pressed = jb.check(solve(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), -30.0))
    d = float(pressed.x[2, 1])
    # By hand, F = diag(1, d), area 1/2: (mu d + (lam ln d - mu) / d) / 2 = load.
    np.testing.assert_allclose((3 * d + (7 * np.log(d) - 3) / d) / 2, -30.0, rtol=1e-9)


def test_poisoned_parameter_is_nonfinite(steered):
    """A NaN is reported, and the answer is where it started: nothing is made up."""
    poison = lambda path, leaf: leaf * jnp.nan if "modulus" in jax.tree_util.keystr(path) else leaf
    scene = jax.tree_util.tree_map_with_path(poison, steered[0])
    solution = jb.equilibrium(scene)
    assert int(solution.status) == jb.Status.NONFINITE | jb.Status.NOT_CONVERGED | jb.Status.INVALID
    np.testing.assert_array_equal(solution.x, scene.mesh.nodes)
    for message in (r"INVALID: .* a parameter is out of its range", "NONFINITE: .* energy or forces are not finite"):
        with pytest.raises(jb.EquilibriumError, match=message):
            jb.check(solution)


def test_traced_commands_and_poissons_out_of_range_are_flagged():
    """Where a value is traced there is no `ValueError`; the status says it."""
    solve = jax.jit(lambda r, nu: jb.equilibrium(jb.command(jb.tendon_beam(5, 3, poisson=nu), r)).status)
    assert int(solve(jnp.array([0.9, 1.0]), 0.3)) == jb.Status.OK
    for ratios in ([-0.4, 1.0], [0.0, 1.0], [np.nan, 1.0], [np.inf, 1.0]):
        assert int(solve(jnp.array(ratios), 0.3)) & jb.Status.INVALID, ratios
    for poisson in (0.5, 0.7, -1.0, -1.3):
        assert int(solve(jnp.array([0.9, 1.0]), poisson)) & jb.Status.INVALID, poisson


def test_load_beyond_the_material_is_inverted():
    """Macklin-Mueller yields at a finite load: beyond it the one equilibrium is inside out, and is not called OK."""
    # By hand: F = diag(1, d), area 1/2, (mu + lam)(d - 1) / 2 = load, so d < 0 for a load below -5.
    scene = triangle(jb.macklin_mueller, load=-6.0)
    beyond = jb.equilibrium(scene)
    assert int(beyond.status) & jb.Status.INVERTED
    assert not beyond.smallest_jacobian > 0
    below = jb.check(jb.equilibrium(triangle(jb.macklin_mueller, load=-4.0)))
    np.testing.assert_allclose(below.x[2, 1], 1 - 8 / 10, rtol=1e-9)


def test_status_is_a_flag():
    assert jb.Status.OK == 0
    assert not jb.Status(0)
    assert [int(flag) for flag in jb.Status] == [1, 2, 4, 8, 16, 32, 64]


def test_a_state_on_the_way_keeps_its_stiffness_for_a_step_of_a_millionth():
    """As `ramp` says of states on the way. A longer last step has it made anew, however well the forces balance."""
    mesh, solver = spring_pair(1.0).mesh, jb.Newton(rtol=1e-8, linear=jb.Dense())
    springs = jb.tendons(mesh, [[0, 2], [2, 1], [3, 2]], 3.0, jb.constant_stiffness)
    scene = jb.command(jb.Scene(mesh, (springs,), jb.clamped(mesh, [0, 1, 3])), [0.9, 0.9, 1.0])
    layout, no = solver.linear.layout(topology(scene)), jnp.asarray(False)

    @jax.jit
    def off(scene, aside):
        """How far the stiffness is from that at the end of Newton's method, and the number of its steps."""
        x = scene.mesh.nodes
        start = x.at[2].add(jnp.stack([0.6 * aside, 0.8 * aside]))
        policy = Policy(jnp.asarray(9), 0, ~no, no, lambda x, definite: 0 * x)
        state = newton(scene, layout, start, 0 * x, policy, solver)
        true, _ = solver.linear.factor(layout, assemble(layout, stencil_hessians(scene, state.x)))
        return jnp.max(jnp.abs(state.stiffness.factor - true)) / jnp.max(true), state.counts.steps

    # One step each. The third spring, without tension, is strained by the share that the node moves: stiffer across.
    near, far = off(unlock(scene), 1e-7), off(unlock(scene), 1e-5)
    assert int(near[1]) == int(far[1]) == 1
    assert 1e-8 < near[0] < 1e-6
    assert far[0] < 1e-14


# --------------------------------------------------------------------------------------- check


def stacked(*ratios):
    solutions = [jb.equilibrium(spring_pair(ratio), solver=STAY) for ratio in ratios]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *solutions)


def test_check_returns_the_solution(steered):
    assert jb.check(steered[1]) is steered[1]
    good = stacked(0.9, 0.8)
    assert jb.check(good) is good


def test_check_says_which_members():
    message = (
        r"^UNSTABLE in 2 of 4 members \(1, 3\), the first of them: residual 0 \(tolerance 1e-10\) after 0 Newton steps"
        r".*, command \[1.2, 1.2\]\. .*saddle"
    )
    with pytest.raises(jb.EquilibriumError, match=message):
        jb.check(stacked(0.9, 1.2, 0.8, 1.3))


def test_check_shortens_long_lists():
    with pytest.raises(jb.EquilibriumError, match=r"in 10 of 11 members \(1, 2, 3, 4, 5, 6, 7, 8, \.\.\.\)"):
        jb.check(stacked(0.9, *[1.2] * 10))


def test_check_needs_values(steered):
    message = "solution: expected concrete values, got traced ones; call check outside jit, vmap and grad"
    with pytest.raises(ValueError, match=message):
        jax.jit(lambda solution: jb.check(solution).x)(steered[1])
    with pytest.raises(ValueError, match=message):
        jax.vmap(lambda solution: jb.check(solution).x)(stacked(0.9, 0.8))


# ---------------------------------------------------------------------------------- compilation


def test_new_values_compile_nothing():
    """Command, moduli, lengths, start, and another topology of the same shape: traced once, for all of them."""
    scene = small_beam()
    assert jax.tree.leaves(jb.equilibrium(scene))
    before = traces["density"]
    assert before > 0
    other = small_beam(diagonals="mirrored", young=np.linspace(1e4, 2e4, 16), length=3.0, tendon_modulus=[1e3, 2e3])
    for changed in (jb.command(scene, [0.5, 1.0]), jb.command(other, np.array([0.8, 0.9])), other):
        solution = jb.check(jb.equilibrium(changed))
        jb.check(jb.equilibrium(changed, x0=np.asarray(solution.x)))
    assert traces["density"] == before


def test_a_solution_prints_as_a_summary(beam, steered, bent_path):
    _, solution = steered
    assert repr(solution).startswith("Solution(OK; residual ") and "command [0.4, 1.0])" in repr(solution)
    assert repr(bent_path).startswith("Solution(28 states: 28 OK; ")
    assert repr(jax.tree.map(lambda leaf: None, solution)) == "Solution(a tree of other values)"
    said = []
    jax.eval_shape(lambda solution: said.append(repr(solution)), solution)
    assert said == ["Solution(traced)"]
