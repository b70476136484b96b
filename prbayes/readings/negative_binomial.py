"""Counts that scatter more than those of a Poisson distribution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytensor.tensor as pt
from scipy.special import gammaln

from prbayes._validate import Floats
from prbayes.readings.base import Count


@dataclass(frozen=True)
class NegativeBinomial(Count):
    r"""Counts of events with a negative binomial distribution.

    The mean :math:`\mu` of a count is the exposure times the response, and its variance
    :math:`\mu + \mu^2 / \alpha`, as in `pymc.NegativeBinomial`.

    Parameters
    ----------
    alpha : float, array_like or model variable
        The smaller it is, the more counts scatter. One number, one for each output, (m,), or one
        for each count, (N,) or (N, m). A variable of the model is estimated.
    exposure : float or array_like
        As for `Poisson`.

    Raises
    ------
    TypeError, ValueError
        If a number is not positive.

    Examples
    --------
    >>> import prbayes as prb
    >>> prb.LogLikelihood(error=prb.readings.NegativeBinomial(3.0))
    LogLikelihood(error=NegativeBinomial(alpha=3.0, exposure=1.0))
    """

    alpha: Any
    exposure: Any = 1.0
    widens: ClassVar[bool] = False

    @property
    def size(self) -> Any:
        """The exposure."""
        return self.exposure

    @property
    def roles(self) -> dict[str, Any]:
        """The parameter by its role."""
        return {"error": self.alpha}

    @staticmethod
    def sd(count: Floats, size: Floats, parameter: Floats) -> Floats:
        """Return the standard deviation of the mean given a count."""
        mean = count + 1
        return np.sqrt(mean + mean**2 / parameter)

    @staticmethod
    def log_density(count: Floats, mean: Any, size: Floats, parameter: Any, xp: Any) -> Any:
        """Return the log-probability of counts, as an array or a graph."""
        log_gamma = gammaln if xp is np else pt.gammaln
        mean = xp.maximum(mean, 1e-300)
        constant = log_gamma(count + parameter) - log_gamma(parameter)
        constant = constant - gammaln(count + 1)
        # log1p keeps the digits of large parameters, near the Poisson distribution.
        excess = parameter * xp.log1p(mean / parameter)
        log_share = xp.log(mean) - xp.log(mean + parameter)
        return constant + count * log_share - excess

    @staticmethod
    def draw(rng: np.random.Generator, mean: Floats, size: Floats, parameter: Floats) -> Floats:
        """Draw counts with the given means."""
        factor = rng.gamma(parameter, 1 / parameter, mean.shape)
        rate = np.maximum(mean, 0) * factor
        return rng.poisson(rate).astype(np.float64)
