"""A robot in twenty lines, as a user would write it: a tapered, jointed finger with tendons led along its sides."""

import numpy as np

import jaxbeam as jb


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
