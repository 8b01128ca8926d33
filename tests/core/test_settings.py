"""Whatever a user has set in JAX, the library works, or says in one sentence why not."""

import contextlib
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

import jaxbeam as jb

BEAM = jb.tendon_beam(3, 2)
BENT = np.array([0.8, 1.0])


def angle(ratios):
    return jb.tip_angle(BEAM, jb.equilibrium(jb.command(BEAM, ratios)).x)


@contextlib.contextmanager
def strict():
    """Everything forbidden that can be done without being asked for."""
    with (
        jax.numpy_rank_promotion("raise"),
        jax.numpy_dtype_promotion("strict"),
        jax.transfer_guard("disallow"),
    ):
        yield


# In jit, because `jax.grad` by itself sends a 1 to the device.
STRICT = {
    "gradient": lambda r: jax.jit(jax.grad(angle))(r),
    "modes": lambda r: jb.lowest_mode(jb.command(BEAM, r), BEAM.mesh.nodes).values,
    "linear": lambda r: jb.linear_response(jb.command(BEAM, r)),
    "measures": lambda r: [jb.section_rotation(BEAM, BEAM.mesh.nodes), jb.nodal_stress(BEAM, BEAM.mesh.nodes)],
    "ramp": lambda r: jax.jit(jax.grad(lambda r: jb.ramp(BEAM, r, 3).energy[-1]))(r),
    "sweep": lambda r: jb.sweep(BEAM, r.reshape(1, 2)).x,
    "reach": lambda r: jb.reach(BEAM, 5.0).theta,
    "branch": lambda r: jb.trace_branch(BEAM, r, step=0.5).x,
}


@pytest.mark.parametrize(
    "solver",
    [*list(STRICT)[:3], *(pytest.param(name, marks=pytest.mark.slow) for name in list(STRICT)[3:])],
)
def test_under_strict_settings(solver):
    ratios = jax.device_put(BENT)
    expected = STRICT[solver](ratios)
    with strict():
        found = STRICT[solver](ratios)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_a_gradient_without_jit():
    with jax.disable_jit():
        found = jax.grad(angle)(jnp.asarray(BENT))
    # Other orders of summation.
    np.testing.assert_allclose(found, jax.grad(angle)(jnp.asarray(BENT)), rtol=1e-9)


def test_debug_nans():
    """Whether a density forbids inversion is asked by a value that may be NaN. That must not count as a mistake."""
    beam = jb.command(jb.tendon_beam(3, 2, density=jb.neo_hookean), BENT)
    with jax.debug_nans(True):
        jax.eval_shape(jb.equilibrium, beam)


@pytest.mark.slow
def test_debug_nans_while_solving():
    beam = jb.command(jb.tendon_beam(3, 2, density=jb.neo_hookean), BENT)
    with jax.debug_nans(True):
        jb.check(jb.equilibrium(beam))


def spread(**how):
    mesh = jax.make_mesh((1,), ("d",), axis_types=(jax.sharding.AxisType.Auto,))
    rows = PartitionSpec("d")
    return jax.shard_map(jax.vmap(angle), mesh=mesh, in_specs=rows, out_specs=rows, **how)


def test_shard_map():
    """With its check of varying values the answer is an error that names the cure; without it, it traces."""
    rows = jnp.asarray(BENT[None])
    with pytest.raises(ValueError, match="check_vma=False"):
        jax.eval_shape(spread(), rows)
    assert jax.eval_shape(spread(check_vma=False), rows).shape == (1,)


@pytest.mark.slow
def test_shard_map_is_right():
    rows = jnp.asarray(BENT[None])
    np.testing.assert_allclose(spread(check_vma=False)(rows), angle(rows[0])[None], rtol=1e-12)


def test_float64_where_it_is_switched_off():
    with jax.enable_x64(False), pytest.raises(ValueError, match=r"scene: .* jax_enable_x64"):
        jb.equilibrium(BEAM)


def test_a_mesh_of_another_dtype():
    with pytest.raises(ValueError, match=r"terms\[0\]\.params.*: expected float32, .* got float64"):
        dataclasses.replace(BEAM, mesh=jb.rectangle(3.5, 0.8, 3, 2, dtype=jnp.float32))
