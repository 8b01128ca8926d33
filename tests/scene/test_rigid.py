"""What holds a body against rigid motion: clamps, springs, tendons from another piece, loads. And what does not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.mesh.line import straight
from jaxbeam.physics.rod import rod
from jaxbeam.physics.rod_tendon import rod_tendons
from jaxbeam.scene.rigid import check_held

ROTATION = r"fixed: the body is not held, it moves rigidly without resistance: rotation about \(-1.75, -0.4\)"


def pinned(nodes=(0,), ratios=None, more=lambda mesh: (), **kwargs):
    """The small beam with both coordinates of a few nodes fixed, and more terms."""
    beam = jb.tendon_beam(5, 3, **kwargs)
    beam = beam if ratios is None else jb.command(beam, ratios)
    fixed = np.isin(np.arange(15), nodes)[:, None].repeat(2, axis=1)
    return jb.Scene(beam.mesh, (*beam.terms, *more(beam.mesh)), fixed, beam.tip)


# ---------------------------------------------------------------------------------- clamps and tendons


def test_two_clamped_nodes_hold_a_body_and_one_does_not():
    check_held(pinned([0, 7]))
    body = pinned().terms[:1]
    mesh = pinned().mesh
    with pytest.raises(ValueError, match=ROTATION):
        check_held(jb.Scene(mesh, body, jb.clamped(mesh, [0])))


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("ratios", [None, (0.4, 1.0), (0.7, 1.6)])
@pytest.mark.parametrize("modulus", [2e3, 1e12])
def test_tendons_inside_a_body_do_not_hold_it(ratios, modulus, dtype):
    """At rest, pulling and pushing: a rotation costs no energy, whatever it does along a straight line."""
    with pytest.raises(ValueError, match=ROTATION):
        jb.equilibrium(pinned(ratios=ratios, tendon_modulus=modulus, dtype=dtype))


def test_anchors_of_finite_width_do_not_hold_it_far_from_the_origin():
    beam = jb.tendon_beam(5, 3, anchor_width=0.3)
    mesh = jb.Mesh(beam.mesh.nodes + np.array([1e4, -3e3]), beam.mesh.elements)
    threads = jb.tendons(mesh, [[2, 8], [0, 6]], 2e3, width=[[0.0, 0.3]] * 2)
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1e4, 0.3)), threads), jb.clamped(mesh, [0]))
    with pytest.raises(ValueError, match=r"not held, .* rotation about"):
        check_held(jb.command(scene, [0.4, 1.3]))


# ------------------------------------------------------------------------------------------- springs


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("stiffness", [1e-3, 1e9])
def test_springs_hold_a_body(stiffness, dtype):
    """A weak one too, beside a tendon of 1e12 that is pulled; but not at the node that the body turns about."""
    kind = {"ratios": [0.4, 1.0], "tendon_modulus": 1e12, "dtype": dtype}
    check_held(pinned(more=lambda mesh: (jb.penalty_springs(mesh, [14], stiffness),), **kind))
    with pytest.raises(ValueError, match=ROTATION):
        check_held(pinned(more=lambda mesh: (jb.penalty_springs(mesh, [0], stiffness),), **kind))


def test_springs_alone_hold_a_body():
    """Two nodes, of stiffnesses 1e9 apart, in either precision; one node leaves a rotation about it."""
    for dtype in (jnp.float64, jnp.float32):
        check_held(pinned((), more=lambda mesh: (jb.penalty_springs(mesh, [0, 14], [1e9, 1.0]),), dtype=dtype))
        with pytest.raises(ValueError, match=ROTATION):
            check_held(pinned((), more=lambda mesh: (jb.penalty_springs(mesh, [0, 0], [1e9, 1.0]),), dtype=dtype))


def test_inside_jit_a_constant_scene_is_checked():
    def checked(x, scene):
        check_held(scene)
        return x

    spring = pinned(more=lambda mesh: (jb.penalty_springs(mesh, [14], 1.0),))
    jax.jit(lambda x: checked(x, spring))(1.0)
    with pytest.raises(ValueError, match=ROTATION):
        jax.jit(lambda x: checked(x, pinned()))(1.0)


# ------------------------------------------------------------------------------------------- pieces


def two_pieces(lines, ratios):
    """Two squares side by side, the left one clamped, joined by tendons."""
    left, right = jb.rectangle(1.0, 1.0, 3, 3), jb.rectangle(1.0, 1.0, 3, 3)
    nodes = np.concatenate([left.nodes, right.nodes + np.array([2.0, 0.0])])
    mesh = jb.Mesh(nodes, np.concatenate([left.elements, right.elements + 9]))
    terms = (jb.solid(mesh, jb.lame(1e4, 0.3)), jb.tendons(mesh, lines, 1e3))
    return jb.command(jb.Scene(mesh, terms, jb.clamped(mesh, [0, 1, 2]), [17]), ratios)


LEVEL = [[8, 11], [6, 9]]  # from the right edge of the one square to the left edge of the other
CROSSED = [*LEVEL, [8, 9]]


def test_tendons_between_pieces():
    """Three whose lines do not meet hold a piece. Two that are parallel let it move across, unless they are taut; and
    those inside a piece change nothing."""
    check_held(two_pieces(CROSSED, [1.0] * 3))
    within = [[9, 17], [11, 15]]
    for lines, ratios in ((LEVEL, [1.0] * 2), (LEVEL + within, [1.0, 1.0, 0.4, 1.5])):
        message = r"the mesh is in 2 pieces, and the one with node 9 is not held, .*: translation in y;"
        with pytest.raises(ValueError, match=message):
            check_held(two_pieces(lines, ratios))
    check_held(two_pieces(LEVEL, [0.9, 0.9]))


# ------------------------------------------------------------------------------------------- loads


def load(node, force):
    return lambda mesh: (jb.dead_load(mesh, [node], force),)


def test_a_pendulum_is_held_by_its_load():
    """Hinged at the middle of the left edge and pulled to the right at that of the right one: it hangs straight."""
    scene = pinned([1], more=load(13, [1.0, 0.0]))
    hanging = jb.check(jb.equilibrium(scene))
    assert abs(float(hanging.x[13, 1])) < 1e-9 and float(hanging.x[13, 0]) > 1.75
    # Pulled aside as well, it turns to where the load points.
    aside = jb.check(jb.equilibrium(pinned([1], more=load(13, [1.0, 0.5]))))
    arm = np.asarray(aside.x[13] - aside.x[1])
    assert arm[1] / arm[0] == pytest.approx(0.5, abs=1e-6) and arm[0] > 0


@pytest.mark.parametrize(
    ("nodes", "loads", "message"),
    [
        ((), load(13, [1.0, 0.0]), "translation in x and translation in y"),
        ((), load(13, [0.0, -1.0]), "translation in x and translation in y and rotation"),
        ((1,), load(1, [1.0, 0.0]), r"rotation about \(-1.75, 0\)"),
        # The same on either side of a hinge in the middle: what the one holds the other drives.
        ((7,), lambda mesh: (jb.dead_load(mesh, [1, 13], [0.3, -1.0]),), "without resistance: rotation;"),
    ],
)
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_a_dead_load_alone_does_not_hold(nodes, loads, message, dtype):
    with pytest.raises(ValueError, match=message):
        check_held(pinned(nodes, more=loads, dtype=dtype))


# -------------------------------------------------------------------------------------------- rods


def hinged_rod(*terms, ratios=None):
    """A rod whose first node keeps its place and may turn."""
    line = straight(2.0, 0.5, 3)
    fixed = np.zeros((3, 3), bool)
    fixed[0, :2] = True
    pulls = rod_tendons(line, [[0, 2], [0, 2]], [[0.2, 0.2], [-0.2, -0.1]], 1e3)
    made = (term(line) for term in terms)
    scene = jb.Scene(line, (rod(line, 0.5, jb.lame(1e4, 0.3)), pulls, *made), fixed, [2])
    return scene if ratios is None else jb.command(scene, ratios)


def test_rods():
    message = r"not held, .*: rotation about \(-1, 0\)"
    moment = lambda line: jb.dead_load(line, [2], [0.0, 0.0, 1.0])
    for loose in (hinged_rod(), hinged_rod(ratios=[0.6, 1.2]), hinged_rod(moment, ratios=[0.6, 1.2])):
        with pytest.raises(ValueError, match=message):
            check_held(loose)
    check_held(hinged_rod(lambda line: jb.dead_load(line, [2], [1.0, 0.0, 0.0]), ratios=[0.6, 1.2]))
    check_held(hinged_rod(lambda line: jb.penalty_springs(line, [0], 1.0)))  # it acts on the angle too
