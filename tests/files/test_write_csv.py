"""Tables follow RFC 4180, and their numbers read back to the same bits."""

import csv

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import solution_of

import jaxbeam as jb
from jaxbeam import files
from jaxbeam.core.tree import replace


@pytest.fixture(scope="module")
def scene():
    beam = jb.tendon_beam(nx=5, ny=3)
    return replace(beam, terms=(*beam.terms, jb.pulls(beam.mesh, [[0, 6], [2, 8]]), jb.pulls(beam.mesh, [[0, 9]])))


@pytest.fixture(scope="module")
def path(scene):
    """States made by hand, with numbers of all kinds: tables need no equilibrium."""
    rng = np.random.default_rng(0)
    ratios = rng.uniform(0.5, 1.5, (4, 5))
    ratios[1, 2:] = [1e-300, 0.1, 1e22]
    x = np.asarray(scene.mesh.nodes) + 1e-3 * rng.normal(size=(4, *scene.mesh.nodes.shape))
    return solution_of(scene, ratios, x, [0, 1, 4 + 64, 0])


def table(file):
    with open(file, newline="", encoding="utf-8") as stream:
        return list(csv.reader(stream, strict=True))


def sides(scene, x):
    return jnp.stack([x[0] / 3, x[1] / 0])


QUOTED = 'a "quoted", é\nname'
MEASURES = {"angle": jb.tip_angle, "tension": jb.tendon_tensions, QUOTED: sides, "slack": jb.tendon_slack}


def test_every_number_reads_back(tmp_path, scene, path):
    files.write_csv(tmp_path / "a.csv", scene, path, MEASURES)
    head, *rows = table(tmp_path / "a.csv")
    numbered = lambda name, count: [f"{name}_{k}" for k in range(count)]
    measured = ["angle", *numbered("tension", 5), *numbered(QUOTED, 4), *numbered("slack", 5)]
    assert head == [*numbered("tendon", 2), *numbered("cable", 3), "status", *measured]
    assert [row[5] for row in rows] == ["OK", "NOT_CONVERGED", "INVERTED|OVERLAPPING", "OK"]
    for k, row in enumerate(rows):
        commanded, x = jb.command(scene, path.ratios[k]), path.x[k]
        numbers = [jb.tip_angle(commanded, x), *jb.tendon_tensions(commanded, x), *sides(commanded, x).ravel()]
        expected = np.array([*path.ratios[k], *numbers], np.float64)
        found = np.array([float(word) for word in row[:5] + row[6:16]])
        assert found.tobytes() == expected.tobytes()
        assert row[16:] == [str(bool(value)) for value in jb.tendon_slack(commanded, x)]


def test_lines_end_as_the_standard_says(tmp_path, scene, path):
    files.write_csv(tmp_path / "a.csv", scene, path, {"angle": jb.tip_angle})
    text = (tmp_path / "a.csv").read_bytes()
    assert text.endswith(b"\r\n") and text.count(b"\r\n") == text.count(b"\n") == 5


def test_one_state_without_measures(tmp_path):
    beam = jb.tendon_beam(nx=5, ny=3)
    files.write_csv(tmp_path / "a.csv", beam, solution_of(beam, [1.0, 1.0], beam.mesh.nodes, 0))
    assert table(tmp_path / "a.csv") == [["tendon_0", "tendon_1", "status"], ["1.0", "1.0", "OK"]]


def test_no_commands(tmp_path):
    mesh = jb.rectangle(2.0, 1.0, 3, 2)
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1e3, 0.3)),), jb.clamped(mesh, [0, 1]))
    files.write_csv(tmp_path / "a.csv", scene, solution_of(scene, [], mesh.nodes, 0), {"x": lambda scene, x: x[0, 0]})
    assert table(tmp_path / "a.csv") == [["status", "x"], ["OK", repr(float(mesh.nodes[0, 0]))]]


def test_float32(tmp_path):
    beam = jb.tendon_beam(nx=5, ny=3, dtype=jnp.float32)
    solution = solution_of(beam, [0.9, 1.0], 0.7 * beam.mesh.nodes, 0)
    files.write_csv(tmp_path / "a.csv", beam, solution, {"third": lambda scene, x: x[3] / 3})
    (_, row) = table(tmp_path / "a.csv")
    assert np.array(row[3:], np.float32).tobytes() == np.asarray(solution.x[3] / 3).tobytes()


def test_errors(tmp_path, scene, path):
    growing = iter(range(1, 9))
    for measures, text in [
        ({"a": 3}, r"measures\['a'\]: expected a function \(scene, x\) -> numbers, got 3"),
        ({"a": lambda scene, x: "high"}, r"measures\['a'\]: expected a function that returns real numbers, got 'high'"),
        ({"a": lambda scene, x: x[0] + 1j}, r"measures\['a'\]: expected a function that returns real numbers"),
        ({"a": lambda scene, x: x[: next(growing), 0]}, r"measures: expected as many numbers of every state"),
        ({"status": jb.tip_angle}, r"measures: two columns would be called 'status'"),
        ({"a_0": jb.tip_angle, "a": jb.tip_position}, r"measures: two columns would be called 'a_0'"),
    ]:
        with pytest.raises(ValueError, match=text):
            files.write_csv(tmp_path / "a.csv", scene, path, measures)
    with pytest.raises(ValueError, match="solution: expected a Solution, got a"):
        files.write_csv(tmp_path / "a.csv", scene, path.x)
    with pytest.raises(ValueError, match="solution: expected x of shape"):
        files.write_csv(tmp_path / "a.csv", jb.tendon_beam(nx=5, ny=3), path)
    assert not list(tmp_path.iterdir())
