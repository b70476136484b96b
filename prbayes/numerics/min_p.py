"""Min-P combination of several statistics (Westfall and Young 1993)."""

from __future__ import annotations

import numpy as np

from prbayes._validate import Floats


def upper_p_values(statistics: Floats, null: Floats) -> Floats:
    """Return p-values of C statistics of S data sets, (S, C), large values rejecting.

    ``null``, (B, C), has the statistics of bootstrap samples.
    """
    sorted_null = np.sort(null, axis=0)
    smaller = [
        np.searchsorted(column, values)
        for column, values in zip(sorted_null.T, statistics.T, strict=True)
    ]
    return (len(null) - np.stack(smaller, axis=-1) + 1) / (len(null) + 1)


def adjusted_p_values(observed: Floats, null: Floats) -> Floats:
    """Return p-values adjusted for the choice among the statistics, (C,).

    The smallest is the p-value of the combined test: the share of bootstrap samples whose smallest
    p-value is as small.
    """
    p_values = upper_p_values(observed[None], null)[0]
    smallest = np.sort(upper_p_values(null, null).min(axis=1))
    adjusted: Floats = (np.searchsorted(smallest, p_values, side="right") + 1) / (len(null) + 1)
    return adjusted
