"""Normal copula of draws: an element given the rest, and the rest given an element."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtr, ndtri
from scipy.stats import rankdata

from prbayes._validate import Floats

# Normal scores of the quantiles between which a margin is linear. Variances of a normal margin are
# then right to half a percent; closer quantiles follow the noise of 4000 draws.
_SCORES = np.linspace(-2.75, 2.75, 23)


@dataclass(frozen=True, eq=False)
class Copula:
    """Theta as a monotone function of each element of a normal vector z."""

    quantiles: Floats  # (q, d): of each element, at `_SCORES`; extrapolated linearly
    correlation: Floats  # (d, d): of z

    @classmethod
    def of(cls, thetas: Floats) -> Copula:
        """Fit draws, (k, d): margins by quantiles, correlation by normal scores."""
        quantiles = np.quantile(thetas, ndtr(_SCORES), axis=0)
        scores = ndtri((rankdata(thetas, axis=0) - 0.5) / len(thetas))
        d = thetas.shape[1]
        return cls(quantiles, np.corrcoef(scores, rowvar=False).reshape(d, d))

    def thetas(self, z: Floats) -> Floats:
        """Return the thetas of normal vectors, (..., d)."""
        position = (z - _SCORES[0]) / (_SCORES[1] - _SCORES[0])
        below = np.clip(np.floor(position), 0, len(_SCORES) - 2).astype(int)
        columns = np.arange(z.shape[-1])
        low, high = self.quantiles[below, columns], self.quantiles[below + 1, columns]
        return np.asarray(low + (position - below) * (high - low))

    @cached_property
    def root(self) -> Floats:
        """The lower Cholesky factor of the correlation, (d, d)."""
        return np.linalg.cholesky(self.correlation)

    @cached_property
    def _precision(self) -> Floats:
        return np.linalg.inv(self.correlation)

    @cached_property
    def conditional_sd(self) -> Floats:
        """The standard deviation of each element of z given all others, (d,)."""
        return 1 / np.sqrt(np.diag(self._precision))

    def element_given_rest(self, z: Floats, normal: Floats, i: int) -> Floats:
        """Return z with a new i-th element given the rest, from independent normals (..., d)."""
        sd = self.conditional_sd[i]
        mean = z[..., i] - (z @ self._precision[:, i]) * sd**2
        result = z.copy()
        result[..., i] = mean + sd * normal[..., i]
        return result

    def rest_given_element(self, z: Floats, independent: Floats, i: int) -> Floats:
        """Return the i-th element of z with a new rest, from an independent draw of z (..., d)."""
        shift = z[..., i] - independent[..., i]
        return independent + shift[..., None] * self.correlation[:, i]
