"""Sweeps: chunks, neighbours, bad lanes, progress, threads, processes."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import small_beam, traces

import jaxbeam as jb
from jaxbeam.mesh.line import straight
from jaxbeam.physics.rod import rod
from jaxbeam.physics.rod_tendon import rod_tendons
from jaxbeam.solve.predictor import extend, predict, start_trail

# The package's name `sweep` is the function; its module is found through it.
module = sys.modules["jaxbeam.solve.sweep"]
LINE = np.stack([1 + np.linspace(-0.3, 0.3, 25), 1 - np.linspace(-0.3, 0.3, 25)], axis=1)


@pytest.fixture(scope="module")
def small():
    return small_beam()


@pytest.fixture
def chunks_of_five(monkeypatch):
    monkeypatch.setattr(module, "CHUNK", 5)


def test_neighbours_save_steps(small):
    """On a line of commands two steps are left to take, where a solve from rest takes several."""
    found = jb.check(jb.sweep(small, LINE))
    alone = [jb.equilibrium(jb.command(small, row)) for row in LINE]
    assert np.median(found.steps) <= 2 < 4 <= np.median([int(s.steps) for s in alone])
    np.testing.assert_allclose(found.x, [s.x for s in alone], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.ratios, LINE, rtol=1e-15)


def test_close_neighbours_leave_no_step(small):
    """A fine line of commands: once a branch is begun its polynomial is exact to the tolerance."""
    d = np.linspace(0, 0.2, 101)
    found = jb.check(jb.sweep(small, np.stack([1 + d, 1 - d], axis=1)))
    steps = np.asarray(found.steps)
    assert steps[10:].sum() <= 2 and steps.sum() < 12
    assert (np.asarray(found.residual) <= found.tolerance).all()


@pytest.fixture(scope="module")
def finer():
    """Its chunks of five are compiled once for two tests."""
    return jb.tendon_beam(15, 5)


def test_chunks_change_nothing_but_the_work(finer, chunks_of_five):
    seen = []
    whole = jb.sweep(finer, LINE, progress=lambda done, total: seen.append((done, total)))
    assert [done for done, _ in seen] == [5, 10, 15, 20, 25] and {total for _, total in seen} == {25}
    order = np.random.default_rng(0).permutation(25)
    shuffled = jb.sweep(finer, LINE[order])
    np.testing.assert_array_equal(shuffled.x, whole.x[order])  # to the last bit: chunks do not depend on the order


def test_line_of_progress(finer, chunks_of_five, terminal):
    jb.sweep(finer, LINE, progress=True)
    line, cursor = terminal.lines()
    assert "] 25 of 25 commands, 0:" in line and cursor == ""


def test_line_of_progress_ends_where_a_chunk_fails(finer, chunks_of_five, terminal, monkeypatch):
    solve = module._on_devices

    def fail_at_the_third(scene, layout, chunks, counts, *rest):
        if (chunks[0, :5] == LINE[10:15]).all():
            raise RuntimeError("out of memory")
        return solve(scene, layout, chunks, counts, *rest)

    monkeypatch.setattr(module, "_on_devices", fail_at_the_third)
    with pytest.raises(RuntimeError, match="out of memory"):
        jb.sweep(finer, LINE, progress=True)
    line, cursor = terminal.lines()
    assert "] 10 of 25 commands, 0:" in line and cursor == ""


def test_cores_change_nothing(finer, chunks_of_five, monkeypatch):
    """Also where Hessians are projected in several threads at once."""
    side = np.linspace(0.25, 0.6, 6)
    rows = np.stack([a.ravel() for a in np.meshgrid(side, side)], axis=1)
    results = []
    for cores in (1, 4):
        monkeypatch.setattr(os, "cpu_count", lambda cores=cores: cores)
        results.append(jb.sweep(finer, rows))
    assert int(np.sum(results[0].projected)) > 0
    for one, many in zip(jax.tree.leaves(results[0]), jax.tree.leaves(results[1]), strict=True):
        np.testing.assert_array_equal(one, many)


def test_a_bad_lane_harms_no_other(small):
    """Traced, for concrete commands out of range are refused at once."""
    rows = LINE.copy()
    rows[7], rows[11] = [np.nan, 1.0], [-1.0, 1.0]
    found = jax.jit(lambda rows: jb.sweep(small, rows))(jnp.asarray(rows))
    status = np.asarray(found.status)
    assert all(status[k] & jb.Status.INVALID for k in (7, 11))
    others = np.delete(np.arange(25), [7, 11])
    assert (status[others] == 0).all()
    np.testing.assert_allclose(found.x[others], jb.sweep(small, LINE).x[others], rtol=0, atol=1e-9)


def test_equal_commands_cost_nothing(small):
    found = jb.check(jb.sweep(small, np.repeat([[0.8, 1.0]], 4, axis=0)))
    assert np.sort(found.steps)[:3].tolist() == [0, 0, 0]


def test_any_size_compiles_once(small):
    jb.sweep(small, LINE[:3])
    before = traces["density"]
    for count in (1, 2, 24):
        assert jb.sweep(small, LINE[:count]).x.shape == (count, *small.mesh.nodes.shape)
    assert traces["density"] == before > 0


def test_traced_sweep_equals_concrete(small):
    traced = jax.jit(lambda rows: jb.sweep(small, rows))(jnp.asarray(LINE))
    np.testing.assert_allclose(traced.x, jb.sweep(small, LINE).x, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_dead_loads_are_applied(small):
    """At rest there is no load: the first lane of a chunk applies it, the others have it from the beginning."""
    load = jb.dead_load(small.mesh, small.tip, [0.0, -5.0])
    loaded = jb.Scene(small.mesh, (*small.terms, load), small.fixed, small.tip)
    found = jb.check(jb.sweep(loaded, LINE[::6]))
    for row, x in zip(LINE[::6], found.x, strict=True):
        np.testing.assert_allclose(x, jb.equilibrium(jb.command(loaded, row)).x, rtol=0, atol=1e-9)


def test_a_load_too_large_for_one_step_is_applied_in_parts():
    """A moment that bends a slender rod to a full circle takes 228 steps, of which the first half of it takes some 100.
    Were the whole load there from the beginning, each attempt would start at rest, and it would take 314."""
    line, height = straight(1.0, 0.01, 9), 0.01
    terms = (
        rod(line, height, jb.lame(12 / height**3, 0.0), jb.linear_elastic),  # EI = 1
        rod_tendons(line, [[0, 8]], [[height / 2, height / 2]], 1.0),
        jb.dead_load(line, [8], [0.0, 0.0, 2 * np.pi / height]),
    )
    scene = jb.Scene(line, terms, jb.clamped(line, [0]), [8])
    found = jb.sweep(scene, [[1.0]], jb.Newton(max_steps=240, linear=jb.Dense()))
    assert float(found.reached[0]) >= 0.5


def test_partition_is_of_near_ones():
    rows = np.random.default_rng(1).uniform(0.4, 1, (100, 2))
    parts = module.partition(rows, np.arange(100), 16)
    assert sorted(np.concatenate(parts).tolist()) == list(range(100))
    assert max(len(part) for part in parts) <= 16
    assert np.mean([np.ptp(rows[part], axis=0).max() for part in parts]) < 0.4


@pytest.mark.slow
def test_processes_change_nothing(tmp_path):
    """The example on one process and on two: the same results to the last bit."""
    script = Path(__file__).parents[2] / "examples" / "09_sweep_many.py"

    def start(*more):
        command = [sys.executable, str(script), "--out", str(tmp_path), "--side", "18", *more]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)

    def fingerprints(processes):
        texts = [process.communicate(timeout=600)[0] for process in processes]
        assert [process.returncode for process in processes] == [0] * len(processes)
        return [line.split()[-1] for text in texts for line in text.splitlines() if "fingerprint" in line]

    alone = fingerprints([start()])
    both = ["--processes", "2", "--coordinator", "localhost:19876"]
    together = fingerprints([start(*both, "--process", "0"), start(*both, "--process", "1")])
    assert len(set(alone + together)) == 1 and len(together) == 2


# ------------------------------------------------------------------------------------------- predictor


def trail_of(curve, at):
    """The trail of a curve `s -> (1, 2)` at the parameters `at`."""
    slope = jax.jacfwd(curve)
    trail = start_trail(curve(at[0]), slope(at[0]))
    trail = trail._replace(s=trail.s.at[0].set(at[0]))
    for s in at[1:]:
        trail = extend(trail, s, curve(s), slope(s), predict(trail, s), jnp.asarray(True))
    return trail


def test_prediction_is_exact_for_polynomials():
    """With q states, up to degree 2 q - 1, for any spacing."""
    coefficients = np.random.default_rng(2).normal(size=(8, 1, 2)) / np.arange(1, 9)[:, None, None] ** 3
    curve = lambda s: jnp.sum(jnp.asarray(coefficients) * s ** jnp.arange(8)[:, None, None], axis=0)
    trail = trail_of(curve, jnp.array([0.1, 0.25, 0.3, 0.42]))
    assert int(trail.depth) == 4
    np.testing.assert_allclose(predict(trail, jnp.asarray(0.5)), curve(0.5) - curve(0.42), rtol=1e-10)


def test_prediction_converges_with_its_order():
    curve = lambda s: jnp.stack([jnp.sin(2 * s), jnp.exp(s)])[None]
    errors = []
    for h in (0.1, 0.05):
        trail = trail_of(curve, 0.3 + h * jnp.arange(3))
        errors.append(float(jnp.abs(trail.x[0] + predict(trail, 0.3 + 3 * h) - curve(0.3 + 3 * h)).max()))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(6, abs=0.5)


def test_a_jump_is_forgotten():
    """A state that is not where the branch led begins a new trail."""
    curve = lambda s: jnp.stack([s, s**2])[None]
    trail = trail_of(curve, jnp.array([0.1, 0.2, 0.3]))
    s = jnp.asarray(0.4)
    guess = predict(trail, s)
    after = extend(trail, s, curve(s) + 1.0, jnp.ones((1, 2)), guess, jnp.asarray(True))
    assert int(after.depth) == 1
    unknown = extend(trail, s, curve(s), jnp.full((1, 2), jnp.nan), guess, jnp.asarray(False))
    assert int(unknown.depth) == 0
    np.testing.assert_array_equal(predict(unknown, jnp.asarray(0.5)), 0)
