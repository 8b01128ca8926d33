"""Forces and stiffness of loads, cables and obstacles as derivatives of their energy, and Newton's method in contact.

Solids, tendons, dead loads and springs have such tests in `test_terms.py` and `tests/linear/test_linear.py`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assembled

import jaxbeam as jb
from jaxbeam.scene.evaluation import stencil_hessians
from jaxbeam.solve.newton import topology

MESH = jb.rectangle(2.0, 1.0, 5, 3, "crossed", order=2)
BELOW = jb.nodes_where(MESH, lambda x, y: y < -0.499)
# The upper side and both ends: a line between the nodes 0 and 12.
AROUND = jb.nodes_where(MESH, lambda x, y: (y > 0.499) | (np.abs(x) > 0.999))
# Nodes of the cables: a straight one, one through a guide, and one with wide anchors.
LINE, GUIDED, WIDE = [[2, 14]], [[2, 8, 14]], [[5, 11]]

hessians = jax.jit(stencil_hessians)


def touching(obstacle):
    """Contact of the lower side, some of which is in the transition of 0.05, some deeper, and some outside."""
    return jb.contact(MESH, BELOW, obstacle, 40.0, 0.05, direction=[0.3, 1.0])


# Each with its command, if it has one.
LOADS = {
    "weight": (jb.weight(MESH, np.random.default_rng(0).normal(size=(len(MESH.elements), 2))), []),
    "traction": (jb.traction(MESH, AROUND, [0.4, -2.0]), []),
    "pressure on a line": (jb.pressure(MESH, AROUND), [3.0]),
    "pressure on a loop": (jb.pressure(MESH, np.arange(15)), [3.0]),
    "pull": (jb.pulls(MESH, LINE), [5.0]),
    "pull through a guide": (jb.pulls(MESH, GUIDED), [5.0]),
    "pull, wide": (jb.pulls(MESH, WIDE, width=0.4), [5.0]),
    "cable, taut": (jb.cables(MESH, GUIDED, 5.0, transition=0.05), [0.7]),
    "cable, in transition": (jb.cables(MESH, GUIDED, 5.0, transition=0.5), [0.9]),
    "cable, wide": (jb.cables(MESH, WIDE, 5.0, width=0.4), [0.7]),
    "half-plane": (touching(jb.half_plane([0.0, -0.62], [0.1, 1.0])), [0.12]),
    "disk": (touching(jb.disk([0.3, -0.91], 0.4)), [0.12]),
    "box": (touching(jb.box([0.2, -0.97], [0.9, 0.6], 20.0)), [0.2]),
}
# Pressure on a line needs its ends to be fixed. Nothing else is.
FIXED = {"pressure on a line": [0, 12]}


@pytest.mark.parametrize("name", LOADS)
def test_forces_and_stiffness_are_derivatives_of_the_energy(name):
    """Along a random motion of the nodes that move, in a random state, against central differences."""
    term, commands = LOADS[name]
    fixed = np.zeros(MESH.nodes.shape, bool)
    fixed[FIXED.get(name, [])] = True
    scene = jb.Scene(MESH, (term,), fixed)
    scene = jb.command(scene, commands) if commands else scene
    rng = np.random.default_rng(1)
    x = np.asarray(MESH.nodes) + 0.03 * rng.normal(size=MESH.nodes.shape)
    v = rng.normal(size=x.shape) * ~fixed
    if name in ("half-plane", "disk", "box"):
        # All three pieces of the law are met: outside, in the transition, and deeper.
        depth = -np.asarray(jax.vmap(term.kind.gaps)(x[term.nodes], scene.terms[0].params)) / 0.05
        assert depth.min() < 0 and depth.max() > 1 and ((depth > 0) & (depth < 1)).any()
    # Truncation h^2 and round-off eps / h leave up to 2e-8, of forces near 1 and stiffnesses near 10.
    h = 1e-5
    force = np.asarray(jb.forces(scene, x))
    size = np.abs(force).max()
    assert size > 0.01
    slope = (jb.energy(scene, x + h * v) - jb.energy(scene, x - h * v)) / (2 * h)
    np.testing.assert_allclose(np.sum(force * v), -slope, atol=1e-7)
    stiffness = assembled(topology(scene), hessians(scene, jnp.asarray(x)))
    np.testing.assert_allclose(stiffness, stiffness.T, atol=1e-12)
    change = -(np.asarray(jb.forces(scene, x + h * v)) - np.asarray(jb.forces(scene, x - h * v))) / (2 * h)
    np.testing.assert_allclose((stiffness @ v.ravel()).reshape(x.shape)[~fixed], change[~fixed], atol=1e-7)


# ----------------------------------------------------------------------------------------- Newton's method in contact


TRANSITION = 0.004


@pytest.fixture(scope="module")
def lying():
    """A heavy cantilever on a slope: the depth passes through the transition to beyond it. And its equilibrium."""
    mesh = jb.rectangle(4.0, 0.5, 13, 3, "crossed")
    left, below = (jb.nodes_where(mesh, where) for where in (lambda x, y: x < -1.999, lambda x, y: y < -0.2499))
    slope = jb.contact(mesh, below, jb.half_plane([0.0, -0.45], [0.1, 1.0]), 2e4, TRANSITION)
    terms = jb.solid(mesh, jb.lame(1e4, 0.3), jb.neo_hookean), jb.weight(mesh, [0.0, -100.0]), slope
    scene = jb.Scene(mesh, terms, jb.clamped(mesh, left))
    return scene, jb.check(jb.equilibrium(scene))


def steps_by_hand(scene, x, count):
    """Lengths of Newton steps in full, solved in NumPy, and the positions that they lead to."""
    free, sizes = ~scene.fixed.ravel(), []
    for _ in range(count):
        stiffness = assembled(topology(scene), hessians(scene, jnp.asarray(x)))[np.ix_(free, free)]
        step = np.zeros(free.size)
        step[free] = np.linalg.solve(stiffness, np.asarray(jb.forces(scene, x)).ravel()[free])
        x = x + step.reshape(x.shape)
        sizes.append(np.abs(step).max())
    return np.array(sizes), x


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_newton_converges_quadratically_in_contact(lying, seed):
    """From a quarter of the transition `w` off, each step is shorter than the square of the one before, over `w`: in
    four steps from 1e-3 to round-off. The package needs no more.

    The stiffness of contact is continuous and has kinks, which is enough for quadratic convergence.
    """
    scene, found = lying
    depth = np.asarray(jb.penetration(scene, found.x)) / TRANSITION
    assert depth.min() == 0 and depth.max() > 1 and ((depth > 0) & (depth < 1)).any()
    off = 0.25 * TRANSITION * np.sin(3 * np.asarray(found.x)[:, ::-1] + seed) * ~scene.fixed
    sizes, x = steps_by_hand(scene, found.x + off, 5)
    assert sizes[0] > 0.2 * TRANSITION
    assert (TRANSITION * sizes[1:4] < sizes[:3] ** 2).all()
    assert sizes[4] < 1e-15
    again = jb.check(jb.equilibrium(scene, found.x + off))
    assert again.steps <= 4
    # The package stops at a residual of 1e-10.
    np.testing.assert_allclose(again.x, x, atol=1e-10)
