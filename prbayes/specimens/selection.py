r"""Selection of specimens by their readings: only those within limits were measured.

With limits l and u of a reading y = f(x) + e the density of a measured specimen is

.. math:: p(y \mid \theta) / P(\theta), \qquad
    P(\theta) = \int p(x \mid \theta)\, P(l < f(x) + e < u)\, dx.

`prbayes.specimens.response_share` computes P from points that contain no hyperparameter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._validate import Bools, Floats
from prbayes.metrics.readings import log_interval_probability
from prbayes.numerics.points import farthest_rows
from prbayes.specimens.emulation import Emulation


@dataclass(frozen=True, eq=False)
class Selection:
    """Limits within which a specimen was measured, and errors of readings, (M,) each."""

    low: Floats  # lower limits, -inf without a limit
    high: Floats  # upper limits, inf without a limit
    error: Floats  # standard deviation of the reading's error
    relative: Floats  # further standard deviation, as a share of the output
    bias: Floats  # mean of the reading's error

    def is_seen(self, readings: Floats) -> Bools:
        """Return whether all readings of a specimen are within the limits, (..., M) -> (...)."""
        is_outside = (readings < self.low) | (readings > self.high)
        return np.asarray(~is_outside.any(axis=-1))

    def log_probability(self, outputs: Floats, emulator_error: Floats) -> Floats:
        """Return the log-probability that specimens with these outputs are measured, (..., M)."""
        mean = outputs + self.bias
        variance = emulator_error**2 + self.error**2 + (self.relative * outputs) ** 2
        sd = np.sqrt(variance)
        sd = np.maximum(sd, 1e-12 * np.abs(mean) + 1e-300)
        low = (self.low - mean) / sd
        high = (self.high - mean) / sd
        with np.errstate(divide="ignore"):
            logs = log_interval_probability(low, high)
        return np.asarray(np.minimum(logs, 0.0).sum(axis=-1))

    def uncertain_points(
        self, emulation: Emulation, z: Floats, count: int, largest: float = 0.01
    ) -> Floats:
        """Return points for runs, at most (count, d), among specimens z, (n, d), of populations.

        A quarter of them are the farthest from all runs. The others are where the probability of
        being measured changes by more than ``largest`` within two standard deviations of the
        emulator's prediction.
        """
        values = emulation.surface.values(z)
        deviation = np.sqrt(emulation.surface.variance(z))
        at_ends = [
            np.exp(self.log_probability(values + shift * deviation, emulation.error))
            for shift in (-2.0, 0.0, 2.0)
        ]
        is_uncertain = np.ptp(at_ends, axis=0) > largest
        width = emulation.box[1] - emulation.box[0]
        runs, parts = emulation.z, []
        for rows, size in ((is_uncertain, count - count // 4), (~is_uncertain, count // 4)):
            candidates = z[rows] / width
            squares = np.full(len(candidates), np.inf)
            for run in runs / width:
                squares = np.minimum(squares, ((candidates - run) ** 2).sum(axis=1))
            farthest = farthest_rows(candidates, min(size, len(candidates)), squares)
            parts.append(z[rows][farthest])
            runs = np.concatenate([runs, parts[-1]])
        return np.concatenate(parts)
