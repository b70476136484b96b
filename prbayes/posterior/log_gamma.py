"""A distribution with one parameter of shape, from the normal to logarithms of gamma variables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import digamma, gammainc, gammaincc, gammaln, polygamma

from prbayes._checks import Floats

# Shape at which it is that of the logarithm of a chi-squared variable with one degree of freedom,
# the most skewed that a variance has.
_MOST_SKEWED = 2**0.5
# Shape that stands for zero, the normal: their densities differ by a thousandth.
_NEARLY_NORMAL = 0.01


@dataclass(frozen=True)
class LogGamma:
    """The generalised log-gamma distribution, with mean zero and standard deviation one.

    Plus or minus the logarithm of a gamma variable, standardised. Estimates of scales have it:
    of a standard deviation from normal data exactly, with shape minus the root of two over the
    degrees of freedom.

    References
    ----------
    .. [1] Prentice, R. L. (1974), A log gamma model and its maximum likelihood estimation,
       Biometrika 61, 539-544, doi:10.1093/biomet/61.3.539.
    """

    shape: float  # zero is the normal; negative ones have the longer tail on the left

    @classmethod
    def fit(cls, z: Floats, side: Floats, weights: Floats) -> LogGamma:
        """Return the most likely one for standardised numbers, (n,), or sides of them."""
        from scipy.optimize import minimize_scalar

        def unlikelihood(shape: float) -> float:
            return -float(weights @ cls(shape).log_likelihood(z, side))

        # To a hundredth, which nothing depends on.
        options = {"xatol": 0.01}
        bounds = (-_MOST_SKEWED, _MOST_SKEWED)
        found = minimize_scalar(unlikelihood, bounds=bounds, method="bounded", options=options)
        return cls(float(found.x))

    def log_likelihood(self, z: Floats, side: Floats) -> Floats:
        """Return the log-density at z, (n,), or the log probability of a side of it.

        ``side`` is 0 for the density, -1 for what is below and 1 for what is above.
        """
        k = max(abs(self.shape), _NEARLY_NORMAL) ** -2
        sign = -1.0 if self.shape < 0 else 1.0
        spread = np.sqrt(polygamma(1, k))
        logarithm = digamma(k) - sign * spread * z
        # Where the gamma variable were larger its density is nothing.
        logarithm = np.minimum(logarithm, 600.0)
        gamma = np.exp(logarithm)
        density = k * logarithm - gamma - gammaln(k) + np.log(spread)
        known = side == 0
        if known.all():
            return np.asarray(density)
        # A long tail on the right is the gamma variable's lower one.
        probability = np.where(side == sign, gammainc(k, gamma), gammaincc(k, gamma))
        logarithms = np.log(np.maximum(probability, 1e-300))
        return np.asarray(np.where(known, density, logarithms))
