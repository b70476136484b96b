"""How a metric's estimate is distributed, as a function of the hyperparameters: fitted to refits.

The density of the estimate that was found, at any hyperparameters, is then a likelihood of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from prbayes._checks import Floats
from prbayes.posterior.log_gamma import LogGamma

# Refits for each coefficient of a mean, from which on it has squares and products.
_PER_COEFFICIENT = 10
# Standard deviations of the hyperparameters within which means are curved and spreads change;
# beyond, means are straight and spreads the same. A spread that grew on would make estimates likely
# from hyperparameters far out, where hardly a refit tells what it is.
_BENT = 2.0
# Rounds of weighted least squares and of its weights, and the change of a log standard deviation
# at which they end: a thousandth of the width.
_WEIGHINGS = 50
_STILL = 1e-3
# Squared residuals, in variances, beyond which they count as that much: one refit far out does not
# decide the spread. Five standard deviations.
_SQUARED = 25.0


@dataclass(frozen=True, eq=False)
class _Terms:
    """Polynomials in standardised coordinates."""

    middle: Floats  # (d,)
    spread: Floats  # (d,)
    pairs: NDArray[np.intp]  # (p, 2): products of two coordinates

    @classmethod
    def of(cls, points: Floats, weights: Floats) -> _Terms:
        """Return those that so many points, (n, d), can tell: linear, squares, and products."""
        n, d = points.shape
        share = weights / weights.sum()
        middle = share @ points
        variance = share @ (points - middle) ** 2
        spread = np.sqrt(np.maximum(variance, 1e-300))
        every = np.column_stack(np.triu_indices(d))
        twice = every[:, 0] == every[:, 1]
        squares = every[twice]
        for pairs in (every, squares):
            if n >= _PER_COEFFICIENT * (1 + d + len(pairs)):
                return cls(middle, spread, pairs)
        return cls(middle, spread, every[:0])

    def linear(self, points: Floats) -> Floats:
        """Return one, and the coordinates, (n, 1 + d)."""
        standardised = (points - self.middle) / self.spread
        return np.column_stack([np.ones(len(points)), standardised])

    def near(self, points: Floats) -> Floats:
        """Return these, (n, 1 + d), of coordinates drawn in from far out."""
        return np.clip(self.linear(points), -_BENT, _BENT)

    def all(self, points: Floats) -> Floats:
        """Return one, the coordinates, and squares and products of those drawn in from far out.

        A parabola would bend back there.
        """
        near = self.near(points)[:, 1:]
        first, second = self.pairs.T
        products = near[:, first] * near[:, second]
        linear = self.linear(points)
        return np.column_stack([linear, products])


@dataclass(frozen=True, eq=False)
class Sight:
    """The part of each element's line in which an estimate counts as a number, (r,) each.

    Beyond it counts only that it is there, as where an estimate ran away.
    """

    low: Floats
    high: Floats

    def seen(self, estimates: Floats) -> tuple[Floats, Floats]:
        """Return estimates, (n, r), drawn in to their bounds, and the side on which they are."""
        above = np.maximum(estimates - self.high, 0)
        below = np.maximum(self.low - estimates, 0)
        side = np.sign(above - below)
        inside = np.clip(estimates, self.low, self.high)
        return inside, side


@dataclass(frozen=True, eq=False)
class _Element:
    """One element of the estimate, given those before it."""

    terms: int  # which coordinates its terms are of
    mean: Floats  # coefficients of the terms, and of the residuals of elements before
    log_sd: Floats  # (1 + d,): of the linear terms, drawn in from far out
    noise: LogGamma
    log_likelihood: float  # of the estimates that it was fitted to


@dataclass(frozen=True, eq=False)
class SamplingModel:
    """The distribution of an estimate, element by element, given hyperparameters.

    An element has a mean, which is a polynomial of the hyperparameters and a multiple of the
    residuals of the elements before it, and noise, whose spread changes with the hyperparameters,
    and which is a `LogGamma`. The polynomial is of those coordinates, of several, that make
    the estimates most likely.

    References
    ----------
    .. [1] Drovandi, C. C., A. N. Pettitt and M. J. Faddy (2011), Approximate Bayesian computation
       using indirect inference, J. R. Stat. Soc. C 60, 317-337,
       doi:10.1111/j.1467-9876.2010.00747.x.
    .. [2] Wood, S. N. (2010), Statistical inference for noisy nonlinear ecological dynamic systems,
       Nature 466, 1102-1104, doi:10.1038/nature09319.
    """

    sight: Sight
    terms: list[_Terms]  # by kind of coordinates
    elements: list[_Element]

    @classmethod
    def fit(
        cls,
        points: Sequence[Floats],
        estimates: Floats,
        weights: Floats,
        sight: Sight,
        like: SamplingModel | None = None,
    ) -> SamplingModel:
        """Fit it to the estimates of data sets.

        Parameters
        ----------
        points : sequence of ndarray, shapes (n, d)
            The hyperparameters that data sets were drawn at, in coordinates of several kinds.
        estimates : ndarray, shape (n, r)
        weights : ndarray, shape (n,)
        sight : Sight
        like : SamplingModel, optional
            One that was fitted to about the same: to begin with, and whose coordinates are taken.
        """
        terms = [_Terms.of(kind, weights) for kind in points]
        seen, side = sight.seen(estimates)
        before = np.empty((len(estimates), 0))
        elements = []
        for k in range(estimates.shape[1]):
            start = None if like is None else like.elements[k]
            tried = range(len(terms)) if start is None else [start.terms]
            fits = []
            for which in tried:
                own = terms[which]
                kind = points[which]
                mean = np.column_stack([own.all(kind), before])
                spread = own.near(kind)
                fit = _Fit(mean, spread, seen[:, k], side[:, k], weights)
                found = fit.element(which, start)
                fits.append(found)
            element, residuals = max(fits, key=_how_likely)
            elements.append(element)
            before = np.column_stack([before, residuals])
        return cls(sight, terms, elements)

    def _along(
        self, points: Sequence[Floats], estimate: Floats, variance: float
    ) -> tuple[Floats, Floats]:
        """Return the noise that makes an estimate, (r,), of points, and its log-likelihood.

        By element, shapes (n, r).
        """
        (seen,), (side,) = self.sight.seen(estimate[None])
        every = []
        near = []
        for own, kind in zip(self.terms, points, strict=True):
            every.append(own.all(kind))
            near.append(own.near(kind))
        before = np.empty((len(points[0]), 0))
        noise = []
        known = []
        for k, element in enumerate(self.elements):
            terms = np.column_stack([every[element.terms], before])
            fitted = terms @ element.mean
            residuals = seen[k] - fitted
            log_sd = near[element.terms] @ element.log_sd
            by_design = variance * np.exp(-2 * log_sd)
            log_sd = log_sd + 0.5 * np.log1p(by_design)
            z = residuals * np.exp(-log_sd)
            sides = np.full(len(z), side[k])
            density = element.noise.log_likelihood(z, sides)
            if side[k] == 0:  # a probability has no unit
                density = density - log_sd
            known.append(density)
            noise.append(z)
            expected, _ = _expected(z, sides)
            sd = np.exp(log_sd)
            completed = expected * sd
            before = np.column_stack([before, completed])
        return np.column_stack(noise), np.column_stack(known)

    def log_likelihood(
        self, points: Sequence[Floats], estimate: Floats, variance: float = 0.0
    ) -> Floats:
        """Return the log-density of an estimate, (r,), at points of all kinds, shape (n,).

        With ``variance``, the estimate is off by as much besides.
        """
        _, known = self._along(points, estimate, variance)
        return np.asarray(known.sum(axis=1))

    def strain(self, points: Sequence[Floats], estimate: Floats) -> Floats:
        """Return how far out an estimate is, in standard deviations of its worst element, (n,)."""
        noise, _ = self._along(points, estimate, 0.0)
        return np.asarray(np.abs(noise).max(axis=1))


@dataclass(frozen=True, eq=False)
class _Fit:
    """What one element is fitted to."""

    every: Floats  # (n, c): all terms of the mean
    near: Floats  # (n, 1 + d): those of the log standard deviation
    seen: Floats  # (n,): estimates, or the bound beyond which they are
    side: Floats  # (n,)
    weights: Floats  # (n,)

    def element(self, which: int, start: _Element | None) -> tuple[_Element, Floats]:
        """Return the model, and residuals of its mean, (n,), expected ones where out of sight."""
        log_sd = np.zeros(self.near.shape[1])
        spread = max(self.seen.std(), 1e-300)
        log_sd[0] = np.log(spread)
        values = self.seen
        if start is not None:
            log_sd = start.log_sd
            values, _ = self._completed(self.every @ start.mean, log_sd)
        for _ in range(_WEIGHINGS):
            before = log_sd
            weights = self.weights * np.exp(-2 * self.near @ log_sd)
            mean = _least_squares(self.every, values, weights)
            fitted = self.every @ mean
            values, squared = self._completed(fitted, log_sd)
            log_sd = self._log_sd(squared, log_sd)
            if np.abs(log_sd - before).max() < _STILL:
                break
        residuals = values - fitted
        log_spread = self.near @ log_sd
        z = (self.seen - fitted) * np.exp(-log_spread)
        noise = LogGamma.fit(z, self.side, self.weights) if start is None else start.noise
        density = noise.log_likelihood(z, self.side)
        in_sight = self.side == 0
        known = density - np.where(in_sight, log_spread, 0.0)
        total = float(self.weights @ known)
        element = _Element(which, mean, log_sd, noise, total)
        return element, residuals

    def _completed(self, fitted: Floats, log_sd: Floats) -> tuple[Floats, Floats]:
        """Return estimates, expected ones where out of sight, and their squared noise, (n,)."""
        spread = np.exp(self.near @ log_sd)
        residuals = self.seen - fitted
        z, squared = _expected(residuals / spread, self.side)
        return fitted + spread * z, squared

    def _log_sd(self, squared: Floats, before: Floats) -> Floats:
        """Return coefficients of the noise's log standard deviation, by a scoring step.

        Of the normal likelihood (Harvey 1976, doi:10.2307/1913974).
        """
        counted = np.minimum(squared, _SQUARED)
        excess = self.weights * (counted - 1)
        slope = self.near.T @ excess
        twice = 2 * self.weights[:, None]
        information = self.near.T @ (twice * self.near)
        step = np.linalg.solve(information, slope)
        return np.asarray(before + step)


def _expected(z: Floats, side: Floats) -> tuple[Floats, Floats]:
    """Return expectations of noise and its square; of that beyond z, as of a normal variable."""
    in_sight = side == 0
    log_density = -0.5 * (z**2 + np.log(2 * np.pi))
    log_beyond = log_ndtr(-side * z)
    ratio = np.exp(log_density - log_beyond)
    signed = side * ratio
    mean = np.where(in_sight, z, signed)
    square = np.where(in_sight, z**2, 1 + z * signed)
    return mean, square


def _how_likely(fitted: tuple[_Element, Floats]) -> float:
    """Return the log-likelihood of an element that was fitted."""
    element, _ = fitted
    return element.log_likelihood


def _least_squares(terms: Floats, values: Floats, weights: Floats) -> Floats:
    """Return coefficients by weighted least squares."""
    root = np.sqrt(weights)
    left = terms * root[:, None]
    return np.asarray(np.linalg.lstsq(left, values * root, rcond=None)[0])
