"""The README's code runs as printed, and the numbers of the reference scene are what the code gives."""

import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb

NUMBERS = jb.tendon_beam.__doc__
README = (Path(__file__).parents[2] / "README.md").read_text()


def test_code_runs_as_printed(tmp_path):
    """In a folder of its own, where it writes its picture."""
    code = "\n".join(re.findall(r"```python\n(.*?)```", README, re.DOTALL))
    assert len(code.strip().splitlines()) < 45
    run = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert "tip angle 35.5153 degrees" in run.stdout
    assert "REACHED" in run.stdout
    assert (tmp_path / "finger.png").stat().st_size > 10_000


def test_set_up_commands_are_two():
    commands = re.findall(r"```bash\n(.*?)\n```", README, re.DOTALL)
    assert len(commands) == 2
    assert "examples/01_steer_beam.py" in commands[0]
    assert "pytest" in commands[1]


def test_picture_exists():
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", README):
        assert (Path(__file__).parents[2] / picture).stat().st_size > 10_000


@pytest.mark.parametrize(
    "row", re.findall(r"^ *\| (\d\.\d), (\d\.\d) \| ([+-]\S+) \| (\S+), (\S+) \|$", NUMBERS, re.MULTILINE)
)
def test_table(row):
    ratios = jnp.array([float(v) for v in row[:2]])
    scene = jb.command(jb.tendon_beam(), ratios)
    x = jb.check(jb.equilibrium(scene)).x
    digits = len(row[2].split(".")[1])
    assert abs(jb.tip_angle(scene, x) - float(row[2])) < 0.6 * 10**-digits
    # Half a unit of the last printed digit, and a little for its own rounding.
    np.testing.assert_allclose(jb.tendon_lengths(scene, x), [float(v) for v in row[3:]], atol=0.6e-7)
    assert jax.config.jax_enable_x64


def test_table_is_whole():
    assert len(re.findall(r"^ *\| \d\.\d, \d\.\d ", NUMBERS, re.MULTILINE)) == 7
