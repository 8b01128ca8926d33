"""Robots in twenty lines or fewer, as a user would write them."""

import inspect
from pathlib import Path

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam import files


def finger():
    flat = jb.rectangle(4.0, 0.8, 17, 5, order=2)
    corner = lambda x, y: jb.nearest_node(flat, (x, y))
    mesh = jb.mapped(flat, lambda x, y: (x, y * (0.8 - 0.1 * x)))
    young = np.full(len(mesh.elements), 1e5)
    young[jb.elements_where(flat, lambda x, y: abs(abs(x) - 0.75) < 0.25)] = 1e4
    upper = jb.side(mesh, corner(2, 0.4), corner(-2, 0.4))[::-1]
    lower = jb.side(mesh, corner(-2, -0.4), corner(2, -0.4))
    guides = [jb.along(mesh, line, [0.0, 1.0, 2.0, 3.0], corners=True) for line in (upper, lower)]
    body, pulls = jb.solid(mesh, jb.lame(young, 0.4)), jb.tendons(mesh, guides, 5e3)
    left = jb.side(mesh, corner(-2, 0.4), corner(-2, -0.4))
    right = jb.side(mesh, corner(2, -0.4), corner(2, 0.4))
    return jb.Scene(mesh, (body, pulls), jb.clamped(mesh, left), right), np.flatnonzero(young < 1e5)


def test_a_finger_bends_in_its_joints():
    scene, joints = finger()
    scene = jb.command(scene, [0.8, 1.0])
    x = jb.check(jb.equilibrium(scene)).x
    assert jb.section_rotation(scene, x) > 5
    middle = jb.nodes_where(scene.mesh, lambda x, y: abs(y) < 1e-9)
    middle = middle[np.argsort(scene.mesh.nodes[middle, 0])]
    place = np.asarray(scene.mesh.nodes)[middle[1:-1], 0]
    bent = np.asarray(jb.curvature(scene, x, middle))
    soft = np.abs(np.abs(place) - 0.75) < 0.2
    stiff = (np.abs(place) < 0.4) | (np.abs(place) > 1.1)
    # Ten times the modulus: about a tenth of the curvature.
    assert np.mean(bent[soft]) > 4 * np.mean(np.abs(bent[stiff]))
    stretched = np.ptp(np.asarray(jb.principal_stretches(scene, x)), axis=1)
    assert np.mean(stretched[joints]) > 4 * np.mean(np.delete(stretched, joints))


def guided_finger():
    """A finger of 5 x 1: a cable through four guides below, and a return spring above."""
    mesh = jb.rectangle(5.0, 1.0, 21, 5, order=2)
    lower = [jb.nearest_node(mesh, [x, -0.5]) for x in (-2.5, -1.5, -0.5, 0.5, 1.5, 2.25)]
    upper = [jb.nearest_node(mesh, [x, 0.5]) for x in (-2.5, 2.25)]
    terms = (
        jb.solid(mesh, jb.lame(1e4, 0.45), jb.neo_hookean),
        jb.cables(mesh, [lower], 5e3, jb.inverse_stiffness, width=[[0.0, *[0.25] * 5]]),
        jb.tendons(mesh, [upper], 100.0, jb.constant_stiffness, width=[[0.0, 0.25]]),
    )
    left = jb.nodes_where(mesh, lambda x, y: x == x.min())
    tip = jb.nodes_where(mesh, lambda x, y: x == x.max())
    return jb.Scene(mesh, terms, jb.clamped(mesh, left), tip)


def test_a_finger_with_guides_and_a_return_spring():
    scene = guided_finger()
    pulled = jb.command(scene, [0.8, 1.0])
    solution = jb.check(jb.equilibrium(pulled))
    assert -120 < float(jb.section_rotation(pulled, solution.x)) < -30
    cable, spring = jb.tendon_tensions(pulled, solution.x)
    assert cable > 100 and spring > 0
    assert np.isfinite(jb.estimate_error(pulled, solution, jb.tip_angle).bar)


def l_shape():
    """A bracket from a Gmsh file, held above, pulled down at its end, with a cable across its corner."""
    read = files.read_mesh(Path(__file__).parents[1] / "files" / "l_shape.msh")
    mesh, groups = read.mesh, read.nodes
    across = [[jb.nearest_node(mesh, [1.0, 3.0]), jb.nearest_node(mesh, [3.0, 1.0])]]
    terms = (
        jb.solid(mesh, jb.lame(1e4, 0.3), jb.neo_hookean),
        jb.traction(mesh, groups["tip"], [0.0, -20.0]),
        jb.cables(mesh, across, 500.0, jb.inverse_stiffness),
    )
    return jb.Scene(mesh, terms, jb.clamped(mesh, groups["clamp"]), groups["tip"])


def test_an_l_shape_from_a_gmsh_file():
    pytest.importorskip("meshio")
    scene = l_shape()
    hanging, held = (jb.command(scene, [ratio]) for ratio in (1.3, 0.9))
    low, high = (float(jb.tip_position(s, jb.check(jb.equilibrium(s)).x)[1]) for s in (hanging, held))
    assert low < 0.5 - 0.01 and high > low + 0.05


def test_they_are_short():
    for robot, most in ((finger, 20), (guided_finger, 20), (l_shape, 15)):
        assert len(inspect.getsource(robot).rstrip().splitlines()) <= most, robot
