"""Each example runs, checks its solutions, writes its pictures and finds the number it is about."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"

# Degrees: DESIGN's reference numbers for the first, our own converged results for the third.
NUMBERS = {
    "01_steer_beam": {"top pulled": 35.5152802, "bottom pulled": -34.9502718, "both pulled": -5.0890962},
    "02_ramp_curves": {"top pulled": 956.0045},
    "04_buckling": {"pulled in steps": -5.0890962},
    "03_own_energy": {"without ground": -34.9502718, "with ground": -7.8098, "wire": -11.1086},
    "05_reach_angle": {"nearest to 50": 35.5152802, "ratio for 34": 0.434703},
    "06_follow_path": {"lowest ratio": 0.4667},
    "07_design_shape": {"before": 0.060367},
    "08_gradient_check": {"top command": -37.0783, "bottom command": 6.6988, "Hessian's order": 3.00},
    "09_sweep_many": {"solved": 1.0, "highest": 35.5152802, "lowest": -34.9502718},
    "10_speed_against_accuracy": {"exact": 10.14, "bar held": 1.0},
    "11_finger": {"first": 0.6597, "second": 0.6692, "third": 0.6787, "curled tip missed by": 27.1},
    "12_tentacle": {"lowest ratio": 0.7177, "top": 0.0445, "bottom": 0.1042},
    "13_gripper": {"ratio": 0.84478, "tension": 196.60},
    "14_pneumatic": {"pressure": 1288.04, "ratio": 0.8196, "tips apart": 0.684},
    "15_fit": {
        "parameters within 3 errors": 4.0,
        "mistakes named": 1.0,
        "known only as a ratio": 1.0,
        "chi-square": 1.05,
        "chi-square of the rod": 5.46,
        "angles within": 11.0,
        "angles missed by the rod": 11.0,
        "next upper ratio": 0.75,
        "next lower ratio": 0.60,
    },
}
PICTURES = {
    "01_steer_beam": {"steer_beam.png", "gallery.png", "steer_top.gif", "steer_three.gif"},
    "02_ramp_curves": {"tip_angle.png", "tendons.png", "fields_top.png", "fields_both.png"},
    "03_own_energy": {"ground.png", "wire.png"},
    "04_buckling": {"branches.png", "modes.png", "equilibria.png"},
    "05_reach_angle": {"fan.png", "commands.png"},
    "06_follow_path": {"path.png", "path.gif"},
    "07_design_shape": {"design.png"},
    "08_gradient_check": {"gradient_check.png"},
    "09_sweep_many": {"map.png", "reachable_set.png"},
    "10_speed_against_accuracy": {"speed_against_accuracy.png"},
    "11_finger": {"finger.png", "finger.gif"},
    "12_tentacle": {"tentacle.png", "tentacle.gif"},
    "13_gripper": {"gripper.png", "gripper.gif"},
    "14_pneumatic": {"pneumatic.png", "pneumatic.gif"},
    "15_fit": {"fit.png", "next.png"},
}


def test_every_example_is_tested():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(NUMBERS)


# The others compile for half a minute or more each; what they show is tested in files of its own.
NAMES = [name if name == "01_steer_beam" else pytest.param(name, marks=pytest.mark.slow) for name in NUMBERS]


def loaded(name):
    """The module of an example."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", NAMES)
def test_example(name, tmp_path):
    found = loaded(name).main(tmp_path)
    for key, expected in NUMBERS[name].items():
        digits = len(str(expected).split(".")[1])
        assert found[key] == pytest.approx(expected, abs=10.0**-digits)
    assert {path.name for path in tmp_path.iterdir()} == PICTURES[name]
    assert all(path.stat().st_size > 10_000 for path in tmp_path.iterdir())


@pytest.mark.slow
def test_made_up_measurements_are_those_in_the_files(tmp_path):
    """To the last digit that is written: one more or less where a number lies between two."""
    example = loaded("15_fit")
    example.make(tmp_path / "data.csv", tmp_path / "angles.csv")
    for made, kept, digit in (("data.csv", example.DATA, 1e-2), ("angles.csv", example.TRUE_ANGLES, 1e-5)):
        made, kept = (np.loadtxt(path, delimiter=",") for path in (tmp_path / made, kept))
        np.testing.assert_allclose(made, kept, rtol=0, atol=1.01 * digit)
