"""Counts of events at a rate that is the response."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import gammaln

from prbayes._validate import Floats
from prbayes.readings.base import Count


@dataclass(frozen=True)
class Poisson(Count):
    """Counts of events with a Poisson distribution.

    The mean of a count is the exposure times the response, such as hours times a rate.

    Parameters
    ----------
    exposure : float or array_like
        One number, one for each output, (m,), or one for each count, (N,) or (N, m).

    Raises
    ------
    TypeError, ValueError
        If the exposure is no positive number.

    References
    ----------
    .. [1] Gaver, D. P. and I. G. O'Muircheartaigh (1987), Robust empirical Bayes analyses of event
       rates, Technometrics 29, 1-15, doi:10.1080/00401706.1987.10488178.

    Examples
    --------
    >>> import prbayes as prb
    >>> prb.LogLikelihood(error=prb.readings.Poisson(exposure=[94.3, 15.7]))
    LogLikelihood(error=Poisson(exposure=(94.3, 15.7)))
    """

    exposure: Any = 1.0

    @property
    def size(self) -> Any:
        """The exposure."""
        return self.exposure

    @staticmethod
    def sd(count: Floats, size: Floats, parameter: Floats) -> Floats:
        """Return the standard deviation of the mean given a count, that of a gamma density."""
        return np.sqrt(count + 1)

    @staticmethod
    def log_density(count: Floats, mean: Any, size: Floats, parameter: Any, xp: Any) -> Any:
        """Return the log-probability of counts, as an array or a graph."""
        mean = xp.maximum(mean, 1e-300)
        return count * xp.log(mean) - mean - gammaln(count + 1)

    @staticmethod
    def draw(rng: np.random.Generator, mean: Floats, size: Floats, parameter: Floats) -> Floats:
        """Draw counts with the given means."""
        return rng.poisson(np.maximum(mean, 0)).astype(np.float64)
