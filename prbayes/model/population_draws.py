"""Draws of the hyperparameters given importance points of the specimens.

The draws need no gradient: adaptive importance sampling with a multivariate t proposal. They give
the population in which the fibres of specimens are covered, and the unit of Monte Carlo errors.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from scipy.special import chdtri, ndtri

from prbayes._validate import IN_CACHE, Floats
from prbayes.model.parameters import Hyperparameters
from prbayes.numerics.log_sum_exp import log_sum_exp
from prbayes.numerics.points import sobol
from prbayes.propagation.coordinates import Coordinates
from prbayes.propagation.population_density import PopulationDensity, WeightedPoints
from prbayes.propagation.response_share import ResponseShare
from prbayes.response.groups import is_group
from prbayes.response.inputs import Inputs


@dataclass(frozen=True, eq=False)
class Populations:
    """Populations of a model's hyperparameters, evaluated at points of specimens.

    Attributes
    ----------
    model : weak reference to a pymc.Model
    inputs : Inputs
    coordinates : Coordinates
    groups : ndarray of int, shape (N,), or None
    density : PopulationDensity, optional
        Of the same inputs, as far as it is compiled.
    evaluated : weak reference to Hyperparameters, optional
        Those of the model, where an evaluator has compiled them.
    """

    model: weakref.ref[pm.Model]
    inputs: Inputs
    coordinates: Coordinates
    groups: NDArray[np.intp] | None
    density: PopulationDensity | None = None
    evaluated: weakref.ref[Hyperparameters] | None = None

    @cached_property
    def _density(self) -> PopulationDensity:
        return PopulationDensity(self.inputs) if self.density is None else self.density

    @cached_property
    def hyperparameters(self) -> Hyperparameters:
        """The hyperparameters of the model."""
        evaluated = None if self.evaluated is None else self.evaluated()
        if evaluated is not None:
            return evaluated
        model = self.model()
        if model is None:
            raise RuntimeError("got a simulator whose model is gone; build the model again")
        return Hyperparameters.of(model)

    def _roots(self, thetas: Floats, group: int) -> list[Floats]:
        """Return the roots of the inputs at thetas, shapes (S, *shape)."""
        values = self.hyperparameters.constrained(thetas)
        return [
            np.full(len(thetas), group) if is_group(root) else values[str(root.name)]
            for root in self.inputs.roots
        ]

    def log_likelihoods(
        self, thetas: Floats, z: Floats, log_a: Floats, smoothing: Floats | None = None
    ) -> Floats:
        """Return log p(y_i | theta), (S, N), from points (N, K, d) and their numbers (N, K).

        With `smoothing`, a covariance (d, d), populations are normal with the moments of the
        coordinates z, and wider by it: points that lie farther apart than a population is wide
        have a smooth log-likelihood.
        """
        n, count, d = z.shape
        x = self.coordinates.inputs(z)
        weights = log_a if smoothing is not None else log_a + self.coordinates.log_jacobian(z)
        result = np.empty((len(thetas), n))
        groups = np.zeros(n, dtype=np.intp) if self.groups is None else self.groups
        for group in np.unique(groups):
            rows = np.flatnonzero(groups == group)
            of_rows = [v[rows] for v in x]
            if smoothing is None:
                roots = self._roots(thetas, int(group))
                points = WeightedPoints.of(self.inputs, of_rows, weights[rows])
                result[:, rows] = self._density.log_likelihoods(roots, points)
                continue
            step = max(1, IN_CACHE // (len(rows) * count))
            for first in range(0, len(thetas), step):
                some = slice(first, first + step)
                roots = self._roots(thetas[some], int(group))
                logs = self._normal_log_density(roots, z[rows].reshape(-1, d), smoothing)
                logs = np.where(np.isnan(logs), -np.inf, logs)
                logs = logs.reshape(-1, len(rows), count)
                result[some, rows] = log_sum_exp(logs + weights[rows])
        return result

    def prior_specimens(self) -> Floats:
        """Return coordinates of specimens of the prior predictive population, (n, d)."""
        return specimens_of(self, self.hyperparameters.prior_thetas(2048, 0), 1)

    def log_share(self, thetas: Floats, share: ResponseShare, size: int) -> Floats:
        """Return log S of the population of each of N specimens, summed over them, (S,)."""
        groups = np.zeros(size, dtype=np.intp) if self.groups is None else self.groups
        result = np.zeros(len(thetas))
        for group, count in zip(*np.unique(groups, return_counts=True), strict=True):
            roots = self._roots(thetas, int(group))
            result += count * share.of_populations(self._density, roots, self.coordinates)
        return result

    def _normal_log_density(
        self, roots: Sequence[Floats], z: Floats, smoothing: Floats, specimens: int = 256
    ) -> Floats:
        """Return the log-density of points (n, d) in smoothed normal populations, (S, n)."""
        drawn, _ = self._density.sampler(roots, specimens, np.random.default_rng(0))
        sample = self.coordinates.of(drawn, 2)
        mean = sample.mean(axis=1, keepdims=True)
        centred = sample - mean
        root = np.linalg.cholesky(centred.swapaxes(1, 2) @ centred / specimens + smoothing)
        inverse = np.linalg.inv(root)
        log_det = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1, keepdims=True)
        constant = z.shape[1] / 2 * np.log(2 * np.pi)
        result = np.zeros((len(mean), len(z)))
        for axis in inverse.swapaxes(0, 1):
            standard = axis @ z.T
            standard -= (axis * mean[:, 0]).sum(axis=1, keepdims=True)
            result += np.square(standard, out=standard)
        result *= -0.5
        result -= log_det + constant
        return result

    def posterior(
        self,
        z: Floats,
        log_a: Floats,
        smoothing: Floats | None = None,
        share: ResponseShare | None = None,
        seed: int = 0,
    ) -> PopulationDraws:
        """Return draws of the posterior of the hyperparameters given points of the specimens.

        Weights are tempered until their effective sample size is ten times the number of
        hyperparameters, so that a few draws do not decide the next proposal.

        Parameters
        ----------
        z, log_a : ndarray, shapes (N, K, d) and (N, K)
        smoothing : ndarray, shape (d, d), optional
            As in `log_likelihoods`.
        share : ResponseShare, optional
            Points of the share of a population that has a response.
        seed : int
        """
        names = self.hyperparameters
        d = names.size

        def log_likelihood(thetas: Floats) -> Floats:
            total = self.log_likelihoods(thetas, z, log_a, smoothing).sum(axis=1)
            return total if share is None else total - self.log_share(thetas, share, len(z))

        thetas = names.prior_points(2048, seed)
        log_weights = names.log_posterior(thetas, log_likelihood) - names.log_prior(thetas)
        weights, _ = _tempered(log_weights, 10 * d)
        for attempt in range(12):
            mean = weights @ thetas
            away = thetas - mean
            covariance = (away.T * weights) @ away + 1e-12 * np.diag(names.prior_sd**2)
            root = np.linalg.cholesky(1.2 * covariance)
            u = sobol(1024, d + 1, seed + 1 + attempt)
            radius = np.sqrt(5 / chdtri(5, u[:, d]))
            standard = ndtri(u[:, :d]) * radius[:, None]
            thetas = mean + standard @ root.T
            log_proposal = -(5 + d) / 2 * np.log1p((standard**2).sum(axis=1) / 5)
            log_density = names.log_posterior(thetas, log_likelihood)
            weights, temper = _tempered(log_density - log_proposal, 10 * d)
            if temper == 1.0 and attempt >= 2 and 1 / (weights**2).sum() > 200:
                break
        rng = np.random.default_rng([seed, 5])
        chosen = thetas[rng.choice(len(thetas), 256, p=weights)]
        return PopulationDraws(self, chosen, len(z))


def _tempered(log_weights: Floats, least: int) -> tuple[Floats, float]:
    """Return normalised weights, tempered to an effective sample size, and the temper."""
    if not np.isfinite(log_weights).any():
        raise ValueError(
            "log-likelihood: got no population of the prior that reaches the specimens, expected "
            "one at least; look at the priors and at the data's units"
        )
    temper = 1.0
    while True:
        scaled = temper * (log_weights - log_weights.max())
        weights = np.exp(np.nan_to_num(scaled, nan=-np.inf))
        weights /= weights.sum()
        if 1 / (weights**2).sum() >= least or temper < 1e-6:
            return weights, temper
        temper *= 0.7


@dataclass(frozen=True, eq=False)
class PopulationDraws:
    """Draws of the hyperparameters.

    Attributes
    ----------
    populations : Populations
    thetas : ndarray, shape (S, d)
    size : int
        Number of measured specimens.
    """

    populations: Populations
    thetas: Floats
    size: int

    def log_likelihoods(self, z: Floats, log_a: Floats) -> Floats:
        """Return log p(y_i | theta) at the draws, (S, N)."""
        return self.populations.log_likelihoods(self.thetas, z, log_a)

    def log_share(self, share: ResponseShare) -> Floats:
        """Return the sum over the specimens of log S, the log share with a response, (S,)."""
        return self.populations.log_share(self.thetas, share, self.size)

    def specimens(self, each: int = 16, seed: int = 0) -> Floats:
        """Return coordinates of specimens of all groups and draws, (n, d)."""
        return specimens_of(self.populations, self.thetas, each, seed)


def specimens_of(populations: Populations, thetas: Floats, each: int, seed: int = 0) -> Floats:
    """Return coordinates of specimens of the populations at thetas, (n, d)."""
    rng = np.random.default_rng([seed, 3])
    groups: Sequence[int] = [0]
    if populations.groups is not None:
        groups = np.unique(populations.groups).tolist()
    parts = []
    for group in groups:
        drawn, _ = populations._density.sampler(populations._roots(thetas, group), each, rng)
        z = populations.coordinates.of(drawn, 2)
        parts.append(z.reshape(-1, z.shape[-1]))
    z = np.concatenate(parts)
    return z[np.isfinite(z).all(axis=1)]
