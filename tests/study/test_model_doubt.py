"""Cheaper models tell where their error is not known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.physics.rod_tendon import rod_tendons
from jaxbeam.study.model_doubt import BY_HAND, ROD

# The reference beam, from the truth of `python -m benchmarks accuracy`, within 0.01 %: ratios of the top and the
# bottom tendon, tip angle, tensions.
FINITE_ELEMENTS = [
    (0.95, 1.0, 2.04837, 42.7436),
    (0.8, 1.0, 10.1438, 209.721),
    (0.65, 1.0, 21.1094, 440.112),
    (0.5, 1.0, 32.1686, 684.027),
]
FAR = [(0.65, 0.825, 14.1899, 498.253), (0.5, 0.75, 25.9758, 777.078)]


def by_hand(ratios):
    found = jb.euler_bernoulli(ratios)
    return found.warning, [found.tip_angle, found.tensions[0]]


def as_rod(ratios):
    scene = jb.command(jb.rod_beam(), ratios)
    x = jb.check(jb.equilibrium(scene)).x
    return jb.model_doubt(scene), [jb.tip_angle(scene, x), jb.tendon_tensions(scene, x)[0]]


@pytest.mark.parametrize(("model", "measured"), [(by_hand, BY_HAND), (as_rod, ROD)])
def test_silent_models_are_as_good_as_they_say(model, measured):
    """Where a model has no doubt its error is below the one it names; where it is larger, there is a doubt."""
    silent = 0
    for *ratios, angle, tension in FINITE_ELEMENTS + FAR:
        doubt, found = model(ratios)
        off = 100 * np.abs(np.array(found) / [angle, tension] - 1).max()
        assert doubt or off < measured.error
        silent += not doubt
    assert silent == sum(row[0] >= measured.ratio for row in FINITE_ELEMENTS)


@pytest.mark.parametrize(
    ("arguments", "doubt"),
    [
        ({"ratios": [0.4, 1.0]}, "a tendon at ratio 0.4 (known down to 0."),
        ({"ratios": [1.0, 0.4]}, "a tendon at ratio 0.4 (known down to 0."),
        ({"ratios": [0.9, 0.99]}, "both tendons are shortened (errors of up to"),
        ({"ratios": [0.9, 1.06]}, "a tendon that is commanded to be longer, at ratio 1.06"),
        ({"length": 1.2}, "length / height 1.5 (known from"),
        ({"height": 0.1}, "length / height 35 (known from"),
        ({"poisson": 0.3}, "Poisson's ratio 0.3 (known from 0.45 to 0.49)"),
        ({"tendon_modulus": [2e3, 4e3]}, "stiffness of the tendons, k a^2 / (E H^2), 0.625 (known from"),
        ({"young": 1e5}, "stiffness of the tendons, k a^2 / (E H^2), 0.03125 (known from"),
        ({"stiffness": jb.constant_stiffness}, "stiffness of the tendons, k a^2 / (E H^2), 0.957 (known from"),
    ],
)
def test_each_doubt(arguments, doubt):
    arguments = {"ratios": [0.9, 1.0]} | arguments
    ratios = arguments.pop("ratios")
    warning = jb.euler_bernoulli(ratios, **arguments).warning
    told = jb.model_doubt(jb.command(jb.rod_beam(**arguments), ratios))
    for words, measured in ((warning, BY_HAND), (told, ROD)):
        assert words.startswith(f"the error is not known to stay below {measured.error} %: ")
        assert doubt in words


def test_no_doubt_changes_with_units():
    """At the ends of the ranges, in metres and newtons or in millimetres and meganewtons; also in float32."""
    for scale, stress in ((1.0, 1.0), (1e3, 1e-12)):
        young, modulus = 1e4 * stress, 2e3 * stress * scale**2
        given = {"length": 4.8 * scale, "height": 0.8 * scale, "young": young, "tendon_modulus": modulus}
        assert jb.euler_bernoulli([0.8, 1.1], **given).warning == ""
        assert jb.model_doubt(jb.command(jb.rod_beam(dtype=jnp.float32, **given), [0.5, 1.25])) == ""


def test_doubts_add_up():
    words = jb.euler_bernoulli([0.5, 0.5], poisson=0.2).warning
    assert words.count(";") == 2 and words.index("ratio 0.5") < words.index("both") < words.index("Poisson's ratio 0.2")


def test_a_rod_of_another_kind_is_doubted():
    beam = jb.rod_beam()
    line, body, pull = beam.mesh, *beam.terms
    loaded = jb.Scene(line, (body, pull, jb.dead_load(line, [8], [0.0, -1.0, 0.0])), beam.fixed, beam.tip)
    longer = rod_tendons(line, [[0, 6]] * 2, np.array([[0.4, 0.4], [-0.4, -0.4]]), 2e3)
    inner = rod_tendons(line, [[0, 4]] * 2, np.array([[0.2, 0.2], [-0.2, -0.2]]), 2e3)
    others = [loaded, *(jb.Scene(line, (body, each), beam.fixed, beam.tip) for each in (longer, inner))]
    for scene in others:
        assert jb.model_doubt(scene).startswith(
            "its error was measured only on a straight rod with a tendon along half"
        )
    assert "only with the material macklin_mueller" in jb.model_doubt(jb.rod_beam(density=jb.neo_hookean))


def test_triangles_are_not_doubted():
    assert jb.model_doubt(jb.command(jb.tendon_beam(5, 3), [0.4, 1.0])) == ""


def test_traced_models():
    """The hand calculation cannot judge traced numbers, and returns no words; a traced rod is refused."""
    found = jax.jit(jb.euler_bernoulli)(jnp.array([0.4, 1.0]))
    assert found.warning == ""
    np.testing.assert_allclose(found.tip_angle, jb.euler_bernoulli([0.4, 1.0]).tip_angle, rtol=1e-12)
    with pytest.raises(ValueError, match="scene: expected concrete numbers, got traced ones"):
        jax.jit(lambda ratios: len(jb.model_doubt(jb.command(jb.rod_beam(), ratios))))(jnp.array([0.4, 1.0]))
