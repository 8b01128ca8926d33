"""Single precision: with the dtype asked for, and with x64 off as JAX starts."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import run_python

import jaxbeam as jb
from jaxbeam.solve.actuation import from_rest
from jaxbeam.solve.equilibrium import solve_from
from jaxbeam.solve.newton import topology

ANGLE = 0.01  # degrees, demanded of float32 against float64


@pytest.fixture(scope="module")
def single():
    return jb.tendon_beam(dtype=jnp.float32)


def test_dtype_follows_the_nodes(single):
    assert {leaf.dtype for leaf in jax.tree.leaves(single)} == {jnp.dtype("float32")}
    commanded = jb.command(single, np.array([0.4, 1.0]))
    assert {leaf.dtype for leaf in jax.tree.leaves(commanded)} == {jnp.dtype("float32")}


@pytest.fixture(scope="module")
def single_path(single):
    return jb.ramp(single, [0.4, 1.0], steps=28)


def test_reference_ramp_converges(single_path):
    path = jb.check(single_path)
    assert {leaf.dtype for leaf in jax.tree.leaves(path)} == {jnp.dtype("float32"), jnp.dtype("int32")}
    assert (np.asarray(path.tolerance) == np.float32(jb.Newton().tolerance(jnp.float32))).all()  # its own default
    assert (np.asarray(path.residual) <= np.asarray(path.tolerance)).all()


def test_reference_angle(single, single_path, bent_path, beam):
    assert abs(jb.tip_angle(single, single_path.x[-1]) - float(jb.tip_angle(beam, bent_path.x[-1]))) < ANGLE


def test_angle_all_along_the_ramp(single, single_path, bent_path, beam):
    """At every step of the ramp, not only where it ends."""
    angles = [jax.vmap(lambda x, s=s: jb.tip_angle(s, x))(p.x) for s, p in ((single, single_path), (beam, bent_path))]
    np.testing.assert_allclose(*angles, rtol=0, atol=ANGLE)


def test_nothing_is_promoted_in_silence(single):
    """Traced under JAX's strict promotion: no float32 meets a float64, and no integer or boolean turns into a float."""
    solver = jb.Newton()
    layout = solver.linear.layout(topology(single))
    solve = lambda scene, x: solve_from.__wrapped__(from_rest(scene, x), scene, layout, solver)
    with jax.numpy_dtype_promotion("strict"):
        jaxpr = str(jax.make_jaxpr(solve)(single, single.mesh.nodes))
    assert "f32[203,2]" in jaxpr
    assert not re.search(r"f64\[\d", jaxpr)  # Python numbers, which give way to any dtype, are f64[]


def test_x64_off(bent_path, beam):
    """A new interpreter as JAX starts it: the reference ramp converges by its own default tolerance."""
    code = """
import jax, jaxbeam as jb
scene = jb.tendon_beam()
path = jb.check(jb.ramp(scene, [0.4, 1.0], steps=28))
assert not jax.config.jax_enable_x64
assert {str(leaf.dtype) for leaf in jax.tree.leaves((scene, path))} == {"float32", "int32"}
print(float(jb.tip_angle(scene, path.x[-1])), int(path.steps.sum()))
"""
    angle, steps = run_python(code).split()
    assert abs(float(angle) - float(jb.tip_angle(beam, bent_path.x[-1]))) < ANGLE
    assert int(steps) <= 120
