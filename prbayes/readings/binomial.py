"""Numbers of events in trials, with a probability that is the response."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import gammaln

from prbayes._validate import Floats
from prbayes.readings.base import Count


@dataclass(frozen=True)
class Binomial(Count):
    """Numbers of events among n trials, whose probability is the response.

    Parameters
    ----------
    n : int or array_like
        Number of trials: one number, one for each output, (m,), or one for each count, (N,) or
        (N, m).

    Raises
    ------
    TypeError, ValueError
        If the number is not positive.

    Examples
    --------
    >>> import prbayes as prb
    >>> prb.LogLikelihood(error=prb.readings.Binomial([20, 30]))
    LogLikelihood(error=Binomial(n=(20.0, 30.0)))
    """

    n: Any

    @property
    def size(self) -> Any:
        """The number of trials."""
        return self.n

    @staticmethod
    def sd(count: Floats, size: Floats, parameter: Floats) -> Floats:
        """Return the standard deviation of the mean given a count, that of a beta density."""
        a, b = count + 1, size - count + 1
        total = a + b
        sd = np.sqrt(a * b / (total + 1)) / total
        return np.asarray(size * sd)

    @staticmethod
    def log_density(count: Floats, mean: Any, size: Floats, parameter: Any, xp: Any) -> Any:
        """Return the log-probability of counts, as an array or a graph."""
        share = xp.clip(mean / size, 1e-300, 1 - 1e-16)
        rest = size - count
        constant = gammaln(size + 1) - gammaln(count + 1) - gammaln(rest + 1)
        logs = count * xp.log(share) + rest * xp.log1p(-share)
        return constant + logs

    @staticmethod
    def draw(rng: np.random.Generator, mean: Floats, size: Floats, parameter: Floats) -> Floats:
        """Draw counts with the given means."""
        share = np.clip(mean / size, 0, 1)
        trials = np.round(size).astype(np.intp)
        return np.asarray(rng.binomial(trials, share), dtype=np.float64)

    @staticmethod
    def highest(size: Floats) -> Floats:
        """Return the numbers of trials."""
        return size
