"""Branches between two scenes, and from a bifurcation to the branch that crosses it, against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.physics.energy import Term

END = np.array([0.3, 0.3])


# ---------------------------------------------------------------------------------- between two scenes


def truss(load, height=0.5, stiffness=3.0):
    """Two springs from (-1, 0) and (1, 0) up to node 2, which a load pushes down: von Mises' truss."""
    mesh = jb.Mesh(np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, height], [0.0, -1.0]]), [[0, 3, 2], [3, 1, 2]])
    pair = jb.tendons(mesh, [[0, 2], [2, 1]], stiffness, jb.constant_stiffness)
    fixed = jb.clamped(mesh, [0, 1, 3])
    fixed[2, 0] = True
    return jb.Scene(mesh, (pair, jb.dead_load(mesh, [2], [0.0, -load])), fixed)


def test_a_truss_snaps_at_the_load_of_its_closed_form():
    """At the height y the load is `2 k y (l0 / l - 1)`, with `l^2 = 1 + y^2`. It is largest where `l^3 = l0`."""
    branch = jb.trace_branch(truss(0.0), truss(1.0), step=0.02, interval=(-1.0, 1.0))
    l0 = np.sqrt(1.25)
    y = np.asarray(branch.x)[:, 2, 1]
    np.testing.assert_allclose(branch.parameter, 6 * y * (l0 / np.sqrt(1 + y**2) - 1), atol=1e-8)
    assert branch.ended == "left" and y[-1] < -0.5
    down, up = branch.critical
    assert down.kind == up.kind == "fold"
    length = l0 ** (1 / 3)
    height = np.sqrt(length**2 - 1)
    np.testing.assert_allclose([down.x[2, 1], up.x[2, 1]], [height, -height], rtol=1e-6)
    np.testing.assert_allclose(down.parameter, 6 * height * (l0 / length - 1), rtol=1e-9)
    np.testing.assert_allclose(up.parameter, -down.parameter, rtol=1e-9)
    assert branch.ratios.shape == (len(y), 2) and (branch.ratios == 1).all()


def test_a_branch_along_the_shape_of_the_body():
    """Not only loads: the truss under a load is flattened, at a stiffness that grows, until it has snapped."""
    branch = jb.trace_branch(truss(0.1), truss(0.1, height=0.2, stiffness=6.0), step=0.05, interval=(0.0, 1.0))
    for s, x in zip(branch.parameter, branch.x, strict=True):
        height, stiffness = 0.5 - 0.3 * s, 3 + 3 * s
        y = float(x[2, 1])
        # The natural lengths are linear in `s` too.
        l0 = (1 - s) * np.sqrt(1.25) + s * np.sqrt(1.04)
        load = 2 * stiffness * y * (l0 / np.sqrt(1 + y**2) - 1)
        np.testing.assert_allclose(load, 0.1, atol=1e-8, err_msg=f"{height}")


def test_commands_are_those_of_the_scene_at_each_point():
    scene = jb.tendon_beam(5, 3)
    by_commands = jb.trace_branch(scene, [0.8, 1.0], step=0.3)
    by_scenes = jb.trace_branch(scene, jb.command(scene, [0.8, 1.0]), step=0.3)
    np.testing.assert_allclose(by_scenes.x, by_commands.x, atol=1e-12)
    np.testing.assert_allclose(by_scenes.ratios, by_commands.ratios, rtol=1e-14)
    np.testing.assert_allclose(by_scenes.ratios, 1 + by_scenes.parameter[:, None] * [-0.2, 0], rtol=1e-14)


# ------------------------------------------------------------------------------ from a bifurcation


def valley(x, params):
    """`a x^2 / 2 - x^3 / 3`, whose equilibria are 0 and `a`; stiff across."""
    return params * x[0, 0] ** 2 / 2 - x[0, 0] ** 3 / 3 + 5 * x[0, 1] ** 2


def rolling(a):
    mesh = jb.Mesh(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), [[0, 1, 2]])
    return jb.Scene(mesh, (Term(valley, np.array([[0]]), jnp.array([a])),), jb.clamped(mesh, [1, 2]))


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("slope", [0.05, 1.0, 4.0])
def test_two_branches_that_cross_at_a_slant(slope, direction):
    """`a` goes from `slope` to `-slope`; the branch `x = 0` loses its stability where `x = a` crosses it."""
    path = (rolling(slope), rolling(-slope))
    traced = jb.trace_branch(*path, step=0.1)
    (fork,) = traced.critical
    assert fork.kind == "bifurcation" and fork.parameter == pytest.approx(0.5, abs=1e-9)
    assert (np.abs(traced.x[:, 0]) < 1e-12).all()
    crossing = jb.trace_branch(*path, through=fork, direction=direction, step=0.1)
    x, a = crossing.x[:, 0, 0], slope * (1 - 2 * crossing.parameter)
    np.testing.assert_allclose(x, a, atol=1e-9)
    assert (np.diff(np.abs(x)) > 0).all() and len(x) > 3
    assert (np.sign(x[1:]) == direction * np.sign(fork.shape[0, 0])).all()
    # The curvature at `x = a` is `-a`.
    np.testing.assert_array_equal(crossing.stable[1:], a[1:] < 0)


def test_both_bent_branches_of_the_beam(mirrored):
    straight = jb.trace_branch(mirrored, END)
    (fork,) = straight.critical
    up, down = (
        jb.trace_branch(mirrored, END, through=fork, direction=side, step=0.01, max_points=30) for side in (1, -1)
    )
    for bent in (up, down):
        np.testing.assert_array_equal(bent.x[0], fork.x)
        assert bent.parameter[0] == fork.parameter and (bent.residual <= 1e-10).all()
    # They are mirror images, and do not run back through the bifurcation.
    angles = [np.array([float(jb.tip_angle(mirrored, jnp.asarray(x))) for x in bent.x]) for bent in (up, down)]
    np.testing.assert_allclose(angles[0], -angles[1], atol=1e-6)
    assert np.ptp(np.sign(angles[0][1:])) == 0 and abs(angles[0][-1]) > 5
    # A state of the branch by another way: a stable one, from a state of the branch at another command.
    last = int(np.flatnonzero(up.stable)[-1])
    again = jb.equilibrium(jb.command(mirrored, up.ratios[last]), up.x[last] + 1e-3 * np.sin(up.x[last]))
    np.testing.assert_allclose(again.x, up.x[last], atol=1e-7)


def test_what_is_refused(mirrored):
    scene = jb.tendon_beam(5, 3)
    branch = jb.trace_branch(truss(0.0), truss(1.0), step=0.02)
    fold = branch.critical[0]
    with pytest.raises(ValueError, match="through: expected a bifurcation, got a fold"):
        jb.trace_branch(truss(0.0), truss(1.0), through=fold)
    with pytest.raises(ValueError, match="through: expected"):
        jb.trace_branch(scene, [0.9, 0.9], through=fold.x)
    traced = jb.trace_branch(rolling(1.0), rolling(-1.0), step=0.1)
    with pytest.raises(ValueError, match="through: expected neither x0 nor parameter"):
        jb.trace_branch(rolling(1.0), rolling(-1.0), through=traced.critical[0], parameter=0.5)
    with pytest.raises(ValueError, match="through: expected positions of this scene"):
        jb.trace_branch(scene, [0.9, 0.9], through=traced.critical[0])
    with pytest.raises(ValueError, match="ratios: expected commands, or a scene that differs"):
        jb.trace_branch(scene, mirrored)
