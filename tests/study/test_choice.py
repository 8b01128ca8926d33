"""The choice of model and mesh for an error."""

from __future__ import annotations

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.study.choice import AXES, TABLE

# Tip angle and tension of the top tendon of the reference beam with anchors of 0.25, extrapolated from three fine
# meshes to within 0.002 %.
EXACT = {0.95: (2.048370, 42.74352), 0.8: (10.143806, 209.72102), 0.5: (32.168650, 684.0265)}


def test_the_table_has_an_error_for_every_value():
    for row in TABLE:
        for key, axis in AXES.items():
            assert len(getattr(row, key)) == len(axis.values) - 1
    assert [row.time for row in TABLE] == sorted(row.time for row in TABLE)


@pytest.mark.parametrize("error", [0.1, 0.01, 0.001, pytest.param(0.0001, marks=pytest.mark.slow)])
def test_what_is_chosen_errs_by_no_more(error):
    choice = jb.choose(error)
    assert choice.error <= error and choice.doubt == ""
    scene = choice.scene()
    meshes = jb.two_meshes(scene) if choice.two_meshes else None
    for ratio, exact in EXACT.items():
        off = []
        for measure in (jb.tip_angle, lambda s, x: jb.tendon_tensions(s, x)[0]):
            if meshes is None:
                pulled = jb.command(scene, [ratio, 1.0])
                off.append(measure(pulled, jb.check(jb.equilibrium(pulled)).x))
            else:
                off.append(jb.corrected(meshes, [ratio, 1.0], measure).value)
        assert np.max(np.abs(np.array(off) / exact - 1)) <= 1.02 * choice.error + 2e-5


def test_a_beam_that_is_harder_costs_more():
    assert jb.choose(0.001).time < jb.choose(0.001, poisson=0.499).time
    assert jb.choose(0.01, both=True).error >= jb.choose(0.01).error
    halfway = jb.choose(0.03, length=0.8 * 8)
    assert halfway.doubt == "" and halfway.error > jb.choose(0.03, length=0.8 * 6).error
    # Only proportions count.
    scaled = jb.choose(0.01, length=35.0, height=8.0, young=1e6, tendon_modulus=2e7, anchor_width=2.5)
    assert scaled == jb.choose(0.01)


def test_outside_of_the_table_it_says_so():
    assert "length / height 12.5" in jb.choose(0.05, length=10.0).doubt
    assert "Poisson's ratio 0.2" in jb.choose(0.05, poisson=0.2).doubt


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"error": 1e-6}, "error: expected at least"),
        ({"error": 0.0}, "error"),
        ({"error": 0.01, "length": -1.0}, "length"),
        ({"error": 0.01, "poisson": 0.5}, "poisson"),
        ({"error": 0.01, "both": 1}, "both"),
    ],
)
def test_refusals(arguments, words):
    with pytest.raises(ValueError, match=words):
        jb.choose(**arguments)
