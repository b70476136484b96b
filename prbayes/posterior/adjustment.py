"""Adjustment of a pseudo-posterior's draws, so that their width is that of the metric's own estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from prbayes._checks import Floats, positive_integer
from prbayes.estimate.data_sets import observed_set, simulated_sets
from prbayes.estimate.refit import Neighbourhood, inapplicable
from prbayes.model.evaluator import Evaluator

_FEWEST = 50  # draws of a mode below which it is left as it is
_APART = 1.5  # ratio of distances to two modes below which a draw is between them
_BETWEEN = 0.05  # share of such draws above which modes are not separate
_FAR = 6.0  # standard deviations to which draws farther out are drawn in
_REACH = 3.0  # standard errors beyond which a refit counts as so far away, and no farther
_WEAKEST = 2.0  # standard error, in units of the prior's spread, up to which refits follow a direction
_WIDTH = 3.2  # of the middle 89% of a normal distribution, in standard deviations


@dataclass(frozen=True)
class Affine:
    r"""An affine map of the draws, in unconstrained space, to the covariance and centre that the data warrant.

    Data sets are drawn from the model at the optimum, and each is fitted anew. The covariance of the minimisers is the
    inverse of A, the (Godambe) information in the data, and their median shift is the bias b of the minimiser; those
    that run away, as where a scale may be zero, count as three standard errors off. With prior mean :math:`\theta_0`
    and precision P the draws get covariance :math:`(A + P)^{-1}` and median
    :math:`(A + P)^{-1} (A (\hat\theta - b) + P \theta_0)`, in the directions about which the data tell at least a
    quarter of what the prior does; along the others they keep their distribution given those.

    Parameters
    ----------
    n_sets : int
        Number of data sets drawn and fitted.
    random_seed : int

    References
    ----------
    .. [1] Shaby, B. A. (2014), The open-faced sandwich adjustment for MCMC using estimating functions,
       J. Comput. Graph. Stat. 23, 853-876, doi:10.1080/10618600.2013.842174.

    Examples
    --------
    >>> Affine()
    Affine(n_sets=200, random_seed=0)
    """

    n_sets: int = 200
    random_seed: int = 0

    def __post_init__(self) -> None:
        positive_integer(self.n_sets, "Affine: n_sets", minimum=20)
        positive_integer(self.random_seed, "Affine: random_seed", minimum=0)

    def target(self, hood: Neighbourhood) -> tuple[Floats, Floats]:
        """Return the centre (r,) and covariance (r, r) that draws should have, in the coordinates of ``hood``."""
        evaluator, r = hood.evaluator, hood.sd.size
        (center,), _ = hood.refit(observed_set(evaluator))
        x, ok = hood.refit(simulated_sets(evaluator, hood.thetas(center), self.n_sets, self.random_seed))
        shifts = np.clip(x[ok] - center, -_REACH, _REACH)
        information = np.linalg.inv(np.cov(shifts, rowvar=False).reshape(r, r))
        bias = np.median(shifts, axis=0)  # the same in every parametrisation, as where a scale comes near zero
        prior, _ = hood.coordinates(evaluator.prior_thetas(1024, self.random_seed))
        precision = np.linalg.inv(np.cov(prior, rowvar=False).reshape(r, r))
        covariance = np.linalg.inv(information + precision)
        return covariance @ (information @ (center - bias) + precision @ prior.mean(axis=0)), covariance

    def __call__(self, evaluator: Evaluator, thetas: Floats, optima: Sequence[Floats]) -> tuple[Floats, str]:
        """Map draws of the pseudo-posterior, each mode by itself.

        Parameters
        ----------
        evaluator : Evaluator
            With the epsilons of the draws.
        thetas : ndarray, shape (..., d)
        optima : sequence of ndarray, shapes (d,)
            The best one first; draws belong to the nearest, in its own standard errors.

        Returns
        -------
        thetas : ndarray, shape (..., d)
        note : str
            What was done, or why nothing.
        """
        reason = inapplicable(evaluator)
        if reason:
            return thetas, f"none: {reason}"
        flat, scale = thetas.reshape(-1, thetas.shape[-1]), evaluator.prior_sd
        hoods = [Neighbourhood.of(evaluator, theta, evaluator.epsilon, scale, _WEAKEST) for theta in optima]
        hoods = [h for h in hoods if h.sd.size]
        if not hoods:
            return thetas, "none: the data tell less than the prior about every hyperparameter"
        distances = np.array([np.linalg.norm(h.coordinates(flat)[0], axis=-1) / np.sqrt(h.sd.size) for h in hoods])
        nearest = distances.argmin(axis=0)
        if len(hoods) > 1:
            first, second = np.sort(distances, axis=0)[:2]
            if np.mean(second < _APART * first) > _BETWEEN:
                return thetas, "none: the posterior has modes that run into each other"
        out = flat.copy()
        count, far = 0, 0
        for m, hood in enumerate(hoods):
            mine = nearest == m
            if mine.sum() >= _FEWEST:
                hood = _among(hood, flat[mine])
                x, rest = hood.coordinates(flat[mine])
                out[mine] = moved(hood, x, rest, *self.target(hood))
                far += int((_drawn_in(x, _FAR) != x).any(axis=1).sum())
                count += 1
        if not count:
            return thetas, f"none: there are fewer than {_FEWEST} draws of a mode"
        modes = "" if len(hoods) == 1 else f", {count} modes each by itself"
        drawn_in = f", {far / len(flat):.1%} of the draws drawn in to {_FAR:.0f} standard deviations" if far else ""
        return out.reshape(thetas.shape), f"{self!r}{modes}{drawn_in}"


def moved(hood: Neighbourhood, x: Floats, rest: Floats, center: Floats, covariance: Floats) -> Floats:
    """Move draws to a median and covariance along the frame; what is left follows as its regression on them says.

    Draws count as refits do: their median, and no farther from it than three standard deviations.
    """
    r = hood.sd.size
    x = _drawn_in(x, _FAR)
    root = _root(np.cov(_drawn_in(x, _REACH), rowvar=False).reshape(r, r))
    inverse = np.linalg.inv(root)
    to = center + (x - np.median(x, axis=0)) @ (inverse @ _root(root @ covariance @ root) @ inverse).T
    apart = x - x.mean(axis=0)
    slopes = np.linalg.solve(apart.T @ apart, apart.T @ (rest - rest.mean(axis=0)))
    return hood.thetas(to, rest + (to - x) @ slopes)


def _among(hood: Neighbourhood, thetas: Floats) -> Neighbourhood:
    """Return the neighbourhood at the median of draws, (n, d), along the blind directions.

    The optimum is anywhere along them, where the prior may hardly be; refits hold them at one place.
    """
    local = hood.local
    if not local.blind.size:
        return hood
    t = (np.median(thetas, axis=0) - hood.theta) / local.scale
    place = hood.theta + (t - local.directions @ (local.directions.T @ t)) * local.scale
    found = Neighbourhood.of(hood.evaluator, place, hood.scales, local.scale, _WEAKEST)
    return found if found.sd.size == hood.sd.size else hood


def _drawn_in(x: Floats, most: float) -> Floats:
    """Return draws, (n, r), at most so many standard deviations from the median, as the middle 89% tells them.

    A few in a thousand far out, as where a bounded parameter comes near its bound, would otherwise decide how
    all others are moved.
    """
    low, middle, high = np.quantile(x, [0.055, 0.5, 0.945], axis=0)
    far = most * (high - low) / _WIDTH
    return np.clip(x, middle - far, middle + far)


def _root(matrix: Floats) -> Floats:
    """Return the symmetric square root."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T)
