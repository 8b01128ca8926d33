"""Tendons whose natural length is not that of the line at rest, as one that was never measured."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb

MESH = jb.rectangle(2.0, 0.8, 7, 3)
LINES = jb.nearest_node(MESH, [[(-1, 0.4), (0, 0.4)], [(-1, -0.4), (0, -0.4)]])  # of length 1
CLAMP = jb.clamped(MESH, jb.nodes_where(MESH, lambda x, y: x < -0.99))


def scene(build, natural, **options):
    body = jb.solid(MESH, jb.lame(1e3, 0.3), jb.neo_hookean)
    return jb.Scene(MESH, (body, build(MESH, LINES, 100.0, natural=natural, **options)), CLAMP)


@pytest.mark.parametrize("build", [jb.tendons, jb.cables])
def test_ratios_are_of_the_natural_length(build):
    """A tendon of natural length 1.2 at ratio 0.7 is one of length 1 at 0.84: its law knows the commanded length."""
    # The stretch over which a cable becomes taut is a share of its natural length.
    alike = {"transition": np.array([0.01 / 1.2, 0.01])} if build is jb.cables else {}
    given = jb.command(scene(build, [1.2, 1.0], **alike), [0.7, 1.0])
    usual = jb.command(scene(build, None), [0.84, 1.0])
    x = jb.check(jb.equilibrium(usual)).x
    np.testing.assert_allclose(jb.check(jb.equilibrium(given)).x, x, atol=1e-9)
    np.testing.assert_allclose(jb.tendon_tensions(given, x), jb.tendon_tensions(usual, x), rtol=1e-12)


def test_a_cable_that_is_longer_than_its_way_is_slack_and_one_that_is_shorter_pulls():
    loose = scene(jb.cables, 1.1)
    np.testing.assert_allclose(jb.check(jb.equilibrium(loose)).x, MESH.nodes, atol=1e-12)
    tight = scene(jb.cables, [0.9, 1.1], stiffness=jb.constant_stiffness)
    # A cable pulls less by its stiffness times half of the stretch over which it becomes taut, 0.01 x 0.9.
    np.testing.assert_allclose(jb.tendon_tensions(tight, MESH.nodes), [100 * (0.1 - 0.0045), 0.0], rtol=1e-9)
    assert jb.tendon_tensions(tight, jb.check(jb.equilibrium(tight)).x)[0] > 0


def test_it_is_differentiable_and_carried_to_a_finer_mesh():
    def height(natural):
        made = with_tip(scene(jb.tendons, natural))
        return jb.tip_position(made, jb.equilibrium(made).x)[1]

    at, h = jnp.array([0.8, 1.0]), 1e-5
    slopes = jax.grad(height)(at)
    for k in range(2):
        step = h * jnp.eye(2)[k]
        np.testing.assert_allclose(slopes[k], (height(at + step) - height(at - step)) / (2 * h), rtol=1e-6)
    finer, _ = jb.enriched(with_tip(scene(jb.tendons, [0.8, 1.1])))
    np.testing.assert_allclose(finer.terms[1].params.natural, [0.8, 1.1])


def with_tip(found):
    tip = jb.nodes_where(MESH, lambda x, y: x > 0.99)
    return jb.Scene(found.mesh, found.terms, found.fixed, tip)


@pytest.mark.parametrize("build", [jb.tendons, jb.cables])
@pytest.mark.parametrize(
    ("natural", "message"),
    [
        ([1.0, 1.0, 1.0], r"natural: expected .* one for each tendon, got .*3"),
        (-1.0, "natural: expected .*positive"),
        ([1.0, np.nan], "natural: expected .*positive"),
    ],
)
def test_wrong_lengths_are_refused(build, natural, message):
    with pytest.raises(ValueError, match=message):
        scene(build, natural)
