"""The distribution of draws as a normal copula: draws of one element given the others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri
from scipy.stats import rankdata

from prbayes._validate import Floats

# Standard normal levels of the quantiles between which a margin is straight. Of a normal margin,
# variances are then right to half a percent; closer ones follow the noise of four thousand draws.
_SCORES = np.linspace(-2.75, 2.75, 23)


@dataclass(frozen=True, eq=False)
class Copula:
    """Draws of theta as a monotone function of each element of a normal vector z.

    Attributes
    ----------
    quantiles : ndarray, shape (q, d)
        Of each element, at levels evenly spaced in z; straight on beyond the outermost.
    correlation : ndarray, shape (d, d)
        Of z.
    """

    quantiles: Floats
    correlation: Floats

    @classmethod
    def of(cls, thetas: Floats) -> Copula:
        """Read draws, (k, d): margins by quantiles, correlation by normal scores."""
        from scipy.special import ndtr

        quantiles = np.quantile(thetas, ndtr(_SCORES), axis=0)
        ranks = rankdata(thetas, axis=0)
        scores = ndtri((ranks - 0.5) / len(thetas))
        d = thetas.shape[1]
        return cls(quantiles, np.corrcoef(scores, rowvar=False).reshape(d, d))

    def thetas(self, z: Floats) -> Floats:
        """Return thetas, (..., d), of normal vectors (..., d)."""
        gap = _SCORES[1] - _SCORES[0]
        place = (z - _SCORES[0]) / gap
        below = np.clip(np.floor(place), 0, len(_SCORES) - 2).astype(int)
        columns = np.arange(z.shape[-1])
        low = self.quantiles[below, columns]
        high = self.quantiles[below + 1, columns]
        found = low + (place - below) * (high - low)
        return np.asarray(found)

    @property
    def root(self) -> Floats:
        """The lower root of the correlation: of independent normal numbers it makes z, (d, d)."""
        return np.linalg.cholesky(self.correlation)

    @property
    def conditional_sd(self) -> Floats:
        """The standard deviation of each element of z given all others, (d,)."""
        precision = np.linalg.inv(self.correlation)
        return 1 / np.sqrt(np.diag(precision))

    def redrawn(self, z: Floats, fresh: Floats, i: int) -> Floats:
        """Return z with a new i-th element given the others, of normal numbers (..., d)."""
        precision = np.linalg.inv(self.correlation)
        sd = self.conditional_sd[i]
        mean = z[..., i] - (z @ precision[:, i]) * sd**2
        found = z.copy()
        found[..., i] = mean + sd * fresh[..., i]
        return found

    def others_redrawn(self, z: Floats, fresh: Floats, i: int) -> Floats:
        """Return the i-th element of z with new others given it, of another draw of z."""
        away = z[..., i] - fresh[..., i]
        return fresh + away[..., None] * self.correlation[:, i]
