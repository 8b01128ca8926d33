"""What data say about parameters: which are determined, their standard errors, and in words which are not.

Parameters are scaled, and residuals divided by their standard deviations. So a singular value of the Jacobian tells by
how many standard deviations the residuals change when a combination of parameters changes by its scale (Bates and Watts
1988, Nonlinear Regression Analysis, ch. 2; Brun, Reichert and Kuensch 2001, Water Resour. Res. 37, 1015-1030). A
combination whose change by all of its scale moves them by less than one standard deviation is not determined. Nothing
is told of it but that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# A combination of parameters is determined if its change by its scale changes the residuals by more than this many
# standard deviations, and by more than this share of what the best determined one does: below that is round-off.
LEAST, ROUNDED = 1.0, 1e-9
# Components of a combination that count; relative difference up to which components are alike.
COUNTS, ALIKE = 0.05, 0.02
# The most parameters that are named in a combination.
SHOWN = 6


class Known(NamedTuple):
    """What is known of `q` parameters.

    singular_values: `(f,)` of the scaled Jacobian of the `f` parameters that are free, largest first.
    covariance: `(q, q)` of the parameters, of what is determined of them alone; zero for those that are not free.
    errors: `(q,)` standard errors; NaN for a parameter that is not determined or not free.
    correlations: `(q, q)`; NaN where an error is.
    blind: `(u, q)` combinations of scaled parameters that are not determined.
    words: what is not determined, one entry for each combination.
    """

    singular_values: np.ndarray
    covariance: np.ndarray
    errors: np.ndarray
    correlations: np.ndarray
    blind: np.ndarray
    words: list[str]


def what_is_known(
    jacobian: np.ndarray, scales: np.ndarray, free: np.ndarray, positive: np.ndarray, names: list[str], variance: float
) -> Known:
    """What residuals say about parameters, from their Jacobian.

    Args:
        jacobian: `(r, q)` of the residuals over their standard deviations.
        scales: `(q,)` of the parameters, positive.
        free: `(q,)` which are not held by a bound.
        positive: `(q,)` whether the scale is the magnitude of the parameter, so that changes are relative ones.
        names: of the parameters.
        variance: of the residuals: 1 if their standard deviations are known.
    """
    q, where = len(scales), np.flatnonzero(free)
    scaled = jacobian[:, where] * scales[where] / np.sqrt(variance)
    # Rows of zeros make the singular vectors a basis of all parameters, also where residuals are fewer.
    padded = np.concatenate([scaled, np.zeros((max(0, len(where) - len(scaled)), len(where)))])
    _, sizes, rows = np.linalg.svd(padded, full_matrices=False)
    determined = (sizes > LEAST) & (sizes > ROUNDED * sizes.max(initial=0.0))
    blind = np.zeros((int((~determined).sum()), q))
    blind[:, where] = _sparse(rows[~determined])
    spread = np.zeros((q, int(determined.sum())))
    spread[where] = scales[where, None] * rows[determined].T / sizes[determined]
    covariance = spread @ spread.T
    lost = ~free | (np.abs(blind) > COUNTS).any(axis=0)
    errors = np.where(lost, np.nan, np.sqrt(np.diag(covariance)))
    # An error of zero belongs to a parameter without an effect, which is lost.
    correlations = covariance / np.outer(errors, errors)
    words = [_in_words(row, positive, names) for row in blind]
    return Known(sizes, covariance, errors, correlations, blind, words)


def _sparse(basis: np.ndarray) -> np.ndarray:
    """A basis `(u, f)` of the same space, of vectors with few components: reduced row echelon form, largest pivots
    first, each of length 1."""
    found = basis.copy()
    for k in range(len(found)):
        column = int(np.argmax(np.abs(found[k:]).max(axis=0)))
        row = k + int(np.argmax(np.abs(found[k:, column])))
        found[[k, row]] = found[[row, k]]
        found[k] /= found[k, column]
        others = np.arange(len(found)) != k
        found[others] -= found[others, column][:, None] * found[k]
    norms = np.linalg.norm(found, axis=1, keepdims=True)
    return found / np.where(norms > 0, norms, 1)


def _in_words(row: np.ndarray, positive: np.ndarray, names: list[str]) -> str:
    """A combination that is not determined, in words."""
    parts = np.flatnonzero(np.abs(row) > COUNTS)
    row = row / row[parts[np.argmax(np.abs(row[parts]))]]
    listed = [names[k] for k in parts]
    if len(parts) == 1:
        return f"{listed[0]} is not determined"
    several = " and ".join([", ".join(listed[:-1]), listed[-1]])
    if positive[parts].all() and np.allclose(row[parts], 1, atol=ALIKE):
        return f"{several} only as a ratio" if len(parts) == 2 else f"{several} only as ratios of each other"
    if positive[parts].all() and len(parts) == 2 and np.isclose(row[parts].sum(), 0, atol=ALIKE):
        return f"{several} only as a product"
    shown = parts[np.argsort(-np.abs(row[parts]))[:SHOWN]]
    changes = ", ".join(f"{names[k]} by {row[k]:+.3g}" + " of itself" * bool(positive[k]) for k in shown)
    others = f" and {len(parts) - len(shown)} others" if len(parts) > len(shown) else ""
    who = several if len(parts) <= SHOWN else f"{len(parts)} parameters"
    return f"{who} only in a combination: changing {changes}{others}, in this proportion, changes nothing measured"
