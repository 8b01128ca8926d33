"""What every kind of action must allow: batches, sweeps, ramps, and derivatives by each parameter, also when idle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.core.tree import replace

BEAM = jb.tendon_beam(9, 3, length=3.0, height=0.8)
MESH, REST = BEAM.mesh, np.asarray(BEAM.mesh.nodes)
TOP, BOTTOM = (np.flatnonzero(np.abs(REST[:, 1] - y) < 1e-9) for y in (0.4, -0.4))
TIP = BEAM.tip
LINE = [TOP[0], TOP[3], TOP[6]]
BENT = [TOP[0], int(TIP[1]), BOTTOM[2]]
SEGMENTS = np.column_stack([TOP[:4], TOP[1:5]])
DISK = jb.disk([0.5, -0.7], 0.3)

# Terms of each kind, and commands: an active one, and the one at which it is idle, if there is such.
KINDS = {
    "tendon": (jb.tendons(MESH, [LINE, BENT], 2e3), [0.8, 0.9]),
    "cable": (jb.cables(MESH, [LINE, BENT], 2e3, transition=0.02), [0.8, 1.3]),
    "ragged": (jb.cables(MESH, [LINE, [BOTTOM[0], BOTTOM[4]]], 2e3), [0.8, 0.9]),
    "glued": (jb.tendons(MESH, SEGMENTS, 300.0, jb.inverse_stiffness, shared=True), [0.7]),
    "pull": (jb.pulls(MESH, [LINE, BENT], width=[[0.0, 0.3, 0.0]] * 2), [150.0, 40.0]),
    "shared pull": (jb.pulls(MESH, [LINE, BENT], shared=True), [120.0]),
    "weight": (jb.weight(MESH, [3.0, -20.0]), []),
    "traction": (jb.traction(MESH, TOP, [5.0, -20.0]), []),
    "load": (jb.dead_load(MESH, TIP, [10.0, -20.0]), []),
    "contact": (jb.contact(MESH, BOTTOM, DISK, 3e3, 0.02), [0.15]),
    "support": (jb.support(MESH, TIP, x=np.array([0.5, 1.0, 1.5]), y=1.0), [-0.3]),
}


def scene_of(kind):
    """A beam under this kind of action, and its active command."""
    term, command = KINDS[kind]
    return jb.Scene(MESH, (BEAM.terms[0], term), BEAM.fixed, TIP), np.array(command)


def pressed():
    """An arch between clamped ends, under a pressure on its top."""
    term = jb.pressure(MESH, TOP)
    return jb.Scene(MESH, (BEAM.terms[0], term), jb.clamped(MESH, [*range(3), *TIP.tolist()]), [12, 13, 14]), np.array(
        [300.0]
    )


def made(kind):
    return pressed() if kind == "pressure" else scene_of(kind)


def place(scene):
    return jb.equilibrium(scene).x[13]


def varied(scene, t):
    """The scene with every parameter of its second term changed by `t` times a fixed number, relative to its size."""
    rng = np.random.default_rng(3)
    body, term = scene.terms

    def change(leaf):
        scale = max(float(np.abs(np.asarray(leaf)).max()), 0.1)
        return leaf + t * scale * rng.uniform(0.2, 0.5, leaf.shape[1:])

    # What all stencils share is changed alike in all of them.
    return replace(scene, terms=(body, replace(term, params=jax.tree.map(change, term.params))))


EVERY = [*KINDS, "pressure"]


# Of kinds that are commanded alike, one is in the default run; contact and supports have tests of their own.
USUAL = ("cable", "pressure")
VARIED = ("cable", "pull", "weight", "contact", "support", "pressure")


@pytest.mark.parametrize("kind", [k if k in USUAL else pytest.param(k, marks=pytest.mark.slow) for k in EVERY])
def test_batches_sweeps_and_ramps(kind):
    scene, command = made(kind)
    alone = jb.check(jb.equilibrium(jb.command(scene, command)))
    assert np.abs(alone.x - REST).max() > 0.01
    if not command.size:
        path = jb.check(jb.ramp(scene, command, 3))
        np.testing.assert_allclose(path.x[-1], alone.x, atol=1e-8)
        return
    rest = np.array(jb.scene.scene.rest_commands(scene))
    rows = rest + np.linspace(0, 1, 3)[:, None] * (command - rest)
    swept, path = jb.check(jb.sweep(scene, rows)), jb.check(jb.ramp(scene, command, 3))
    mapped = jax.vmap(lambda c: jb.equilibrium(jb.command(scene, c)).x)(jnp.asarray(rows))
    np.testing.assert_allclose(swept.x, mapped, atol=1e-8)
    np.testing.assert_allclose(path.x[1:], swept.x[1:], atol=1e-8)
    np.testing.assert_allclose(swept.x[-1], alone.x, atol=1e-8)


@pytest.mark.parametrize("kind", [k if k in VARIED else pytest.param(k, marks=pytest.mark.slow) for k in EVERY])
def test_derivatives_by_every_parameter(kind):
    scene, command = made(kind)
    scene = jb.command(scene, command)
    along = lambda t: place(varied(scene, t))
    slope = jax.jacfwd(along)(0.0)
    h = 1e-6
    np.testing.assert_allclose(slope, (along(h) - along(-h)) / (2 * h), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(slope, jax.jacrev(along)(0.0), rtol=1e-9, atol=1e-12)
    assert np.abs(slope).max() > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("kind", EVERY)
def test_second_derivatives_by_every_parameter(kind):
    scene, command = made(kind)
    scene = jb.command(scene, command)
    slope = jax.jit(jax.jacrev(lambda t: place(varied(scene, t))))
    bend = jax.jit(jax.jacfwd(slope))(0.0)
    h = 1e-5
    np.testing.assert_allclose(bend, (slope(h) - slope(-h)) / (2 * h), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("kind", ["cable", "pull", "contact"])
def test_idle_derivatives_are_finite(kind):
    """A slack cable, no tension, an obstacle that is not touched: slopes of all parameters are finite, and zero."""
    scene, _ = made(kind)
    idle = {"cable": [1.2, 1.3], "pull": [0.0, 0.0], "contact": [-0.1]}[kind]
    scene = jb.command(scene, idle)
    found = jb.check(jb.equilibrium(scene))
    np.testing.assert_allclose(found.x, REST, atol=1e-13)
    slopes = jax.grad(lambda s: place(s).sum())(scene)
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(slopes.terms[1].params)]
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    if kind != "pull":
        assert all((leaf == 0).all() for leaf in leaves)


# --------------------------------------------------------------------------------- one command for several


def test_a_glued_tendon_has_a_tension_in_each_segment():
    """One command shortens all segments in proportion; each is a tendon of its own."""
    scene, _ = made("glued")
    apart = jb.tendons(MESH, SEGMENTS, 300.0, jb.inverse_stiffness)
    single = jb.Scene(MESH, (BEAM.terms[0], apart), BEAM.fixed, TIP)
    assert jb.scene.scene.command_count(scene) == 1
    found = jb.check(jb.equilibrium(jb.command(scene, [0.7])))
    other = jb.check(jb.equilibrium(jb.command(single, [0.7] * 4)))
    np.testing.assert_allclose(found.x, other.x, atol=1e-12)
    np.testing.assert_allclose(found.ratios, [0.7], rtol=1e-14)
    tensions = jb.tendon_tensions(jb.command(scene, [0.7]), found.x)
    assert tensions.shape == (4,) and np.ptp(tensions) > 1
    lengths = jb.tendon_lengths(scene, found.x)
    np.testing.assert_allclose(tensions, 300.0 / (0.7 * 0.375) * (lengths - 0.7 * 0.375), rtol=1e-10)


def test_what_shares_a_command_still_does_on_a_finer_mesh():
    for build in (
        lambda: jb.tendons(MESH, SEGMENTS, 300.0, width=0.1, shared=True),
        lambda: jb.cables(MESH, SEGMENTS, 300.0, width=0.1, shared=True),
        lambda: jb.pulls(MESH, SEGMENTS, 30.0, width=0.1, shared=True),
    ):
        scene = jb.Scene(MESH, (BEAM.terms[0], build()), BEAM.fixed, TIP)
        finer, _ = jb.enriched(scene)
        assert jb.scene.scene.command_count(finer) == 1 and len(finer.terms[1].nodes) == 4


def test_shared_wants_one_tension():
    with pytest.raises(ValueError, match="tension: expected"):
        jb.pulls(MESH, SEGMENTS, [1.0, 2.0, 3.0, 4.0], shared=True)
    with pytest.raises(ValueError, match="shared: expected True or False"):
        jb.tendons(MESH, SEGMENTS, 1.0, shared="yes")


def test_slack_and_taut():
    scene, command = made("cable")
    scene = jb.command(scene, command)
    x = jb.check(jb.equilibrium(scene)).x
    assert jb.tendon_slack(scene, x).tolist() == [False, True]
    two_way, _ = made("tendon")
    assert jb.tendon_slack(jb.command(two_way, [0.8, 1.3]), x).tolist() == [False, False]


@pytest.mark.parametrize("kind", EVERY)
def test_a_scene_is_built_where_rank_promotion_is_forbidden(kind):
    scene, _ = made(kind)
    jb.scene.scene._traced_once.cache_clear()
    with jax.numpy_rank_promotion("raise"):
        jb.Scene(scene.mesh, scene.terms, scene.fixed, scene.tip)
