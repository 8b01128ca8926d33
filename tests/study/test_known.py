"""What Jacobians of known structure determine, in numbers and in words."""

import numpy as np
import pytest

from jaxbeam.study.known import is_hidden, scales_of, what_is_known

NAMES = ["a", "b", "c", "d"]
THETA = np.array([3.0, 200.0, 0.4, 5e4])


def known(J, scales=THETA, free=None, positive=None, variance=1.0):
    count = J.shape[1]
    given = lambda mask: np.ones(count, bool) if mask is None else np.array(mask)
    return what_is_known(J, scales[:count], given(free), given(positive), NAMES[:count], variance)


def relative(*rows):
    """A Jacobian whose rows are derivatives by relative changes, in random proportions of ten residuals."""
    mixed = 100 * np.random.default_rng(0).normal(size=(10, len(rows))) @ np.array(rows, float)
    return mixed / THETA[: mixed.shape[1]]


def test_all_determined():
    J = relative([1, 0, 0, 0], [0, 1, 0, 0], [1, 0, 1, 0], [0, 2, 0, 1])
    found = known(J)
    covariance = np.linalg.inv(J.T @ J)
    errors = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-9)
    np.testing.assert_allclose(found.errors, errors, rtol=1e-9)
    np.testing.assert_allclose(found.correlations, covariance / np.outer(errors, errors), atol=1e-12)
    np.testing.assert_allclose(found.singular_values, np.linalg.svd(J * THETA, compute_uv=False), rtol=1e-9)
    assert found.words == []
    np.testing.assert_allclose(known(J, variance=9.0).errors, 3 * errors, rtol=1e-9)


@pytest.mark.parametrize(
    ("rows", "words", "lost"),
    [
        ([[1, -1, 0], [0, 0, 1]], ["a and b only as a ratio"], "ab"),
        ([[1, 1, 0], [0, 0, 1]], ["a and b only as a product"], "ab"),
        ([[1, -1, 0], [0, 1, -1]], ["a, b and c only as ratios of each other"], "abc"),
        ([[1, 0, 0], [0, 1, 0]], ["c is not determined"], "c"),
        ([[1, 0, 0]], ["b is not determined", "c is not determined"], "bc"),
        ([[1, -1, 0, 0], [0, 0, 1, -1]], ["a and b only as a ratio", "c and d only as a ratio"], "abcd"),
        ([[1, -1, 0, 0], [0, 0, 1, 1]], ["a and b only as a ratio", "c and d only as a product"], "abcd"),
        (
            [[1, 2, 0], [0, 0, 1]],
            [
                "a and b only in a combination: changing a by +1 of itself, b by -0.5 of itself, in this proportion, "
                "does not show in the data"
            ],
            "ab",
        ),
        (
            [[1, 2, 0], [0, 1, 1]],
            [
                "a, b and c only in a combination: changing a by +1 of itself, b by -0.5 of itself, c by +0.5 of "
                "itself, in this proportion, does not show in the data"
            ],
            "abc",
        ),
    ],
)
def test_words(rows, words, lost):
    found = known(relative(*rows))
    assert sorted(found.words) == sorted(words)
    assert "".join(name for name, error in zip(NAMES, found.errors, strict=False) if np.isnan(error)) == lost
    assert np.isnan(found.correlations[np.isnan(found.errors)]).all()


def test_a_parameter_tied_to_an_unknown_one_is_not_determined():
    """b is known to 0.1 % if a is, but 1 % of a is worth 0.04 % of b, and nothing tells a."""
    found = known(relative([0.04, -1]))
    assert np.isnan(found.errors).all()
    (words,) = found.words
    assert words.startswith("a and b only in a combination: changing a by +1 of itself, b by +0.04 of itself")


def test_amounts_of_what_may_be_negative_are_not_relative():
    found = known(relative([1, -2, 0], [0, 0, 1]), positive=[False, True, True])
    assert "changing a by +3, b by +0.5 of itself" in found.words[0]
    ratio = known(relative([1, -1, 0], [0, 0, 1]), positive=[False, True, True])
    assert "ratio" not in ratio.words[0]


def test_held_parameters_are_left_out():
    J = relative([1, -1, 0], [0, 0, 1])
    found = known(J, free=[False, True, True])
    assert found.words == [] and np.isnan(found.errors[0]) and (found.covariance[0] == 0).all()
    np.testing.assert_allclose(found.errors[1:], np.sqrt(np.diag(np.linalg.inv(J[:, 1:].T @ J[:, 1:]))), rtol=1e-9)
    none = known(J, free=[False] * 3)
    assert none.words == [] and len(none.singular_values) == 0 and np.isnan(none.errors).all()


@pytest.mark.parametrize(("size", "told"), [(0.5, False), (0.99, False), (1.01, True), (3.0, True)])
def test_less_than_its_own_magnitude(size, told):
    """A parameter that is known to within its magnitude has an error, any other has none."""
    J = np.diag([100.0, size]) / THETA[:2]
    found = known(J)
    np.testing.assert_allclose(found.errors[0], THETA[0] / 100)
    assert (found.words == []) is told is bool(np.isfinite(found.errors[1]))
    if told:
        np.testing.assert_allclose(found.errors[1], THETA[1] / size)


def test_a_weak_combination_leaves_the_others_alone():
    """Where a direction of little effect has a small part in a parameter, its variance counts in full."""
    directions = np.linalg.qr(np.array([[1, 1, 0.01], [1, -1, 0], [0, 0, 1.0]]).T)[0].T
    J = np.array([0.5, 300, 20])[:, None] * directions / THETA[:3]
    found = known(J)
    assert found.words == ["a and b only as a ratio"] and np.isnan(found.errors[:2]).all()
    np.testing.assert_allclose(found.errors[2], np.sqrt(np.linalg.inv(J.T @ J)[2, 2]), rtol=1e-9)


def test_predictions_of_what_is_known():
    found = known(relative([1, -1, 0], [0, 0, 1]))
    slopes = np.array([[1.0, -1, 0], [0, 0, 1], [1, 0, 0], [1, -1.001, 0]])
    assert is_hidden(slopes, found.singular_values, found.directions).tolist() == [False, False, True, True]


def test_scales():
    """The magnitude; of what started at zero or changed its sign a hundred of its own standard deviations."""
    J = np.diag([0.0, 4.0, 2.0, 5.0])
    scales = scales_of(np.array([0.0, 3.0, -1.0, -7.0]), np.array([0.0, 0.0, 1.0, -1.0]), J)
    np.testing.assert_allclose(scales, [1, 25, 50, 7])
