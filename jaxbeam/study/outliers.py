"""Which residuals of a fit are too large to be chance."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from jaxbeam.study.known import ROUNDED

# Probability that of good residuals none is called an outlier.
SURE = 0.99
# The median of the magnitude of a normal variable of unit variance, and its efficiency as a measure of size (Huber
# 1981, Robust Statistics, ch. 5).
MEDIAN, WORTH = 0.6745, 0.37


def outliers(
    residuals: np.ndarray, jacobian: np.ndarray, count: np.ndarray, least: np.ndarray, known_sd: bool
) -> np.ndarray:
    """Numbers `(k,)` of residuals that are too large to be chance, the largest first.

    One after the other is left out, and the linearised residuals are fitted to the others: a large one pulls the fit
    away from these. A residual is divided by its own standard deviation, which the fit makes smaller: `sqrt(1 - h)`,
    with `h` the diagonal of the hat matrix (Cook and Weisberg 1982). Their size is taken from the median of the
    magnitudes, which outliers hardly change; but where standard deviations are known it is not less than these, and if
    all of them were given too small, no value is worse than the others. The median tells a size as well as `WORTH` of
    all residuals would by their squares: where sizes are not known, the limit is that of Student's distribution.

    Args:
        residuals: `(r,)` over their standard deviations.
        jacobian: `(r, q)` of the residuals, by scaled parameters.
        count: `(r,)` which of them may be outliers.
        least: `(r,)` magnitude below which a residual is round-off.
        known_sd: whether standard deviations are known.
    """
    there, named = count.copy(), []
    while there.any():
        u, sizes, _ = np.linalg.svd(np.where((there | ~count)[:, None], jacobian, 0), full_matrices=False)
        u = u[:, sizes > ROUNDED * sizes.max(initial=0)]
        hat = np.sum(u**2, axis=1)
        kept = np.where(there | ~count, residuals, 0)
        own = np.where(there, np.abs(kept - u @ (u.T @ kept)) / np.sqrt(np.maximum(1 - hat, 1e-6)), 0)
        size = max(float(known_sd), float(np.median(own[there])) / MEDIAN)
        limit = NormalDist().inv_cdf(1 - (1 - SURE) / (2 * there.sum()))
        if not known_sd:
            limit = _student(limit, WORTH * max(1.0, float(there.sum() - hat[there].sum())))
        own = np.where(own > least, own, 0)
        k = int(np.argmax(own))
        if own[k] <= limit * size:
            break
        named.append(k)
        there[k] = False
    return np.array(named, int)


def _student(z: float, freedom: float) -> float:
    """The quantile of Student's distribution where the normal one is `z` (Abramowitz and Stegun 1972, 26.7.5)."""
    terms = ((z**3 + z) / 4, (5 * z**5 + 16 * z**3 + 3 * z) / 96, (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384)
    return z + sum(term / freedom**k for k, term in enumerate(terms, 1))
