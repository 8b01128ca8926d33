"""How many steps Newton's method takes in one jump, and what makes them few: bent steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.core.tree import unlock
from jaxbeam.scene.evaluation import evaluate, largest_step, second_change
from jaxbeam.solve.line_search import line_search


def tip_load(nx, ny, order, length=3.5, young=1e4, poisson=0.45):
    """A cantilever under a traction on its right edge, which lowers the tip by two sevenths of the length."""
    mesh = jb.rectangle(length, 0.8 / 3.5 * length, nx, ny, order=order)
    x = np.asarray(mesh.nodes)[:, 0]
    left, right = (np.flatnonzero(np.isclose(x, side * length / 2)) for side in (-1, 1))
    down = (47.5 if order == 1 else 39.3) / 0.8 * young / 1e4 * (1 - 0.45**2) / (1 - poisson**2)
    solid = jb.solid(mesh, jb.lame(young, poisson), jb.neo_hookean)
    return jb.Scene(mesh, (solid, jb.traction(mesh, right, [0.0, -down])), jb.clamped(mesh, left), right)


def check_steps(scene, length, most):
    found = jb.check(jb.equilibrium(scene))
    sunk = -np.mean(np.asarray(found.x)[scene.tip, 1])
    assert 0.25 < sunk / length < 0.33
    assert int(found.attempts) == 1 and int(found.steps) <= most


@pytest.mark.parametrize(("nx", "ny", "order"), [(29, 7, 1), (29, 7, 2)])
def test_a_tip_load_takes_few_steps(nx, ny, order):
    check_steps(tip_load(nx, ny, order), 3.5, 6)


@pytest.mark.parametrize(("length", "young", "poisson"), [(3500.0, 1e-2, 0.3), (3.5, 1e4, 0.0)])
def test_so_it_does_in_other_units_and_materials(length, young, poisson):
    check_steps(tip_load(29, 7, 2, length, young, poisson), length, 6)


@pytest.mark.slow
@pytest.mark.parametrize(("nx", "ny"), [(57, 13), (113, 25)])
def test_so_it_does_on_finer_meshes(nx, ny):
    check_steps(tip_load(nx, ny, 2), 3.5, 6)


@pytest.mark.parametrize(("ratios", "most"), [([0.4, 1.0], 11), ([1.0, 0.4], 12), ([0.6, 1.4], 9), ([0.8, 1.0], 5)])
def test_a_pulled_tendon_takes_few_steps(beam, ratios, most):
    found = jb.check(jb.equilibrium(jb.command(beam, ratios)))
    assert int(found.attempts) == 1 and int(found.steps) <= most


def test_second_change_is_that_of_the_gradient(steered):
    scene, solution = steered
    scene, x = unlock(scene), solution.x
    dx = 0.1 * jnp.sin(3 * x)
    gradient = jax.jit(lambda t: evaluate(scene, x + t * dx).gradient)
    t = 1e-3
    change = (gradient(t) - 2 * gradient(0.0) + gradient(-t)) / t**2
    # The error of the difference is of order t^2.
    np.testing.assert_allclose(second_change(scene, x, dx), change, atol=1e-4 * np.abs(change).max())


def test_a_bend_that_would_invert_elements_is_dropped(beam):
    """Half of the body is shortened by a tenth, which is safe; the bend alone would turn it inside out."""
    scene = unlock(jb.command(beam, [0.6, 1.0]))
    x = jnp.asarray(scene.mesh.nodes)
    step = -0.1 * (x - x[0]).at[:, 1].set(0)
    begin = evaluate(scene, x)
    no, yes = jnp.asarray(False), jnp.asarray(True)
    assert largest_step(scene, x, 20 * step, 0.1) < 1
    bent = line_search(scene, x, begin, step, 19 * step, no, yes, 0.1)
    straight = line_search(scene, x, begin, step, jnp.zeros_like(x), no, yes, 0.1)
    assert bent.moved and straight.moved
    np.testing.assert_array_equal(bent.x, straight.x)
    np.testing.assert_array_equal(straight.x, x + step)


def test_a_straight_step_is_cut_to_what_keeps_volume(beam):
    """A uniform shortening by twice the length would turn the body inside out: `J = 1 - 2 t` is 0.1 at `t = 0.45`."""
    scene = unlock(beam)
    x = jnp.asarray(scene.mesh.nodes)
    step = -2 * (x - x[0]).at[:, 1].set(0)
    found = line_search(
        scene, x, evaluate(scene, x), step, jnp.zeros_like(x), jnp.asarray(True), jnp.asarray(False), 0.1
    )
    assert found.moved and found.halvings == 0
    np.testing.assert_allclose(found.x, x + 0.45 * step, atol=1e-12)
