"""First-order and total Sobol' indices from Saltelli's design."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.run.results import STATISTICS_LIMITS
from tkamb.studies.uncertainty.bands import varies

RESAMPLED = 200
"""Bootstrap samples for the standard errors."""


@dataclass(frozen=True)
class SobolIndex:
    """Share of an input in a result's variance.

    Args:
        result: column of results.csv.
        name: of the input.
        first: by itself: Var(E(y | x_i)) / Var(y).
        first_error: its standard error.
        total: with all its interactions: E(Var(y | all but x_i)) / Var(y).
        total_error: its standard error.
        rows: of the design in which every needed sample has a number.
    """

    result: str
    name: str
    first: float
    first_error: float
    total: float
    total_error: float
    rows: int


def sobol_indices(
    results: Sequence[str], inputs: Sequence[str], values: Array, count: int, seed: int
) -> list[SobolIndex]:
    """Return the indices of every input on every result, largest total first.

    With y_A, y_B and y_AB the results at A, at B, and at A with the input's column from B, less
    their mean, sums over the rows of the design:

        first = sum y_B (y_AB - y_A) / sum y²      (Saltelli et al. 2010)
        total = sum (y_A - y_AB)² / (2 sum y²)     (Jansen 1999)

    sum y² the mean over A and B. Of a result with many frames, numerators and denominators are
    summed over the frames (Gamboa et al. 2014): a frame counts with its variance. Rows where a
    needed sample failed are left out; the indices are then those among possible poses. Standard
    errors by bootstrap over the rows. A result without variance, or of fewer than
    `STATISTICS_LIMITS.min_samples` rows, has none.

    Args:
        results: (m,) names.
        inputs: (d,) names.
        values: (n (d + 2), m, f) in the order of
        `tkamb.studies.uncertainty.sampling.crossed_points`.
        count: n.
        seed: of the bootstrap.

    References:
        Saltelli et al., Comput Phys Commun 181:259 (2010), doi:10.1016/j.cpc.2009.09.018;
        Jansen, Comput Phys Commun 117:35 (1999), doi:10.1016/S0010-4655(98)00154-4;
        Gamboa, Janon, Klein & Lagnoux, Electron J Stat 8:575 (2014), doi:10.1214/14-EJS895.
    """
    indices: list[SobolIndex] = []
    picks = np.random.default_rng([seed, count]).integers(0, count, (RESAMPLED, count))
    weights = np.stack([np.bincount(pick, minlength=count) for pick in picks]).astype(float)
    weights = np.vstack([np.ones(count), weights])
    for m, result in enumerate(results):
        blocks = values[:, m].reshape(len(inputs) + 2, count, -1)
        rows = [
            row
            for i, name in enumerate(inputs)
            if (row := _index(result, name, blocks[0], blocks[1], blocks[2 + i], weights))
        ]
        indices += sorted(rows, key=lambda one: -one.total)
    return indices


def _index(
    result: str, name: str, a: Array, b: Array, crossed: Array, weights: Array
) -> SobolIndex | None:
    """Return one input's indices from (n, f) values; None where nothing can be said."""
    finite = np.isfinite(a) & np.isfinite(b) & np.isfinite(crossed)
    enough = finite.sum(axis=0) >= STATISTICS_LIMITS.min_samples
    if not enough.any():
        return None
    finite = finite[:, enough]
    square = np.where(finite, 0.5 * (a[:, enough] ** 2 + b[:, enough] ** 2), 0.0).sum()
    middle = np.where(finite, a[:, enough] + b[:, enough], 0.0).sum(axis=0) / (
        2 * finite.sum(axis=0)
    )
    a, b, crossed = (np.where(finite, one[:, enough] - middle, 0.0) for one in (a, b, crossed))
    variance = weights @ (0.5 * (a**2 + b**2)).sum(axis=1)
    if not varies(variance[0], square):
        return None
    first = weights @ (b * (crossed - a)).sum(axis=1) / variance
    total = weights @ (0.5 * (a - crossed) ** 2).sum(axis=1) / variance
    return SobolIndex(
        result,
        name,
        float(first[0]),
        float(first[1:].std(ddof=1)),
        float(total[0]),
        float(total[1:].std(ddof=1)),
        int(finite.any(axis=1).sum()),
    )
