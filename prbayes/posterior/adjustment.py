"""Adjustment of a pseudo-posterior's draws to the width of the metric's own estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats, called, positive_integer
from prbayes.estimate.data_sets import observed_set, simulated_sets
from prbayes.estimate.measured import drawn_in
from prbayes.estimate.obstacles import refit_obstacle
from prbayes.estimate.refit import SamplingDistribution
from prbayes.model.evaluator import Evaluator
from prbayes.model.hyperparameters import THETAS

# Standard errors from which on a minimiser is elsewhere than where its sampling distribution was
# taken: an optimum by itself is within a hundredth of one, one that the prior held may be far off.
# By judgement.
_ELSEWHERE = 1.0
# Times that it is followed; one or two arrive.
_STEPS = 5
# Draws of a mode below which it is left as it is: standard deviations from 50 have an error of a
# tenth. With 25 a mode that has 36 of 400 draws is mapped as well (docs/constants.md).
_FEWEST = 50
# Standard deviations to which draws farther out are drawn in. Half or twice moves a mean by .012
# standard deviations at most (docs/constants.md).
_FAR = 6.0
# Standard errors beyond which a refit counts as so far away, and no farther. Twice changes means by
# .016 standard deviations and spreads by 2% at most; with half, where refits within are cut as
# well, spreads shrink by up to 7% (docs/constants.md).
_REACH = 3.0
# Standard error, in units of the prior's spread, up to which refits follow a direction. Twice
# changes nothing; with half, directions about which data and prior tell as much are left to draws
# of exp(-d / epsilon), whose spread differs by a third there (docs/constants.md).
_WEAKEST = 2.0


def refuse_adjustment(adjust: object) -> None:
    """Raise if it is neither an adjustment nor whether there is to be one."""
    if not isinstance(adjust, Affine | bool):
        raise TypeError(
            f"adjust: got {called(adjust)}, expected prb.posterior.Affine(), True or False"
        )


@dataclass(frozen=True, eq=False)
class Adjusted:
    """What an adjustment made of draws."""

    thetas: Floats  # (..., d): the draws; the given ones if nothing was done
    done: str = ""  # what was done; empty if nothing
    reason: str | None = None  # why nothing was done, None if something was

    @property
    def note(self) -> str:
        """What was done, or why nothing, as results state it."""
        return self.done if self.reason is None else f"none: {self.reason}"


@dataclass(frozen=True)
class Affine:
    r"""An affine map of the draws of theta to the covariance and centre that the data warrant.

    Data sets are drawn from the model at the optimum, and each is fitted anew. The covariance of
    the minimisers is the inverse of A, the (Godambe) information in the data, and their median
    shift is the bias b of the minimiser; those that run away, as where a scale may be zero, count
    as three standard errors off. With prior mean :math:`\theta_0` and precision P the draws get
    covariance :math:`(A + P)^{-1}` and median
    :math:`(A + P)^{-1} (A (\hat\theta - b) + P \theta_0)`, in the directions about which the data
    tell at least a quarter of what the prior does; along the others they keep their distribution
    given those.

    Parameters
    ----------
    n_sets : int
        Number of data sets drawn and fitted.
    random_seed : int

    References
    ----------
    .. [1] Shaby, B. A. (2014), The open-faced sandwich adjustment for MCMC using estimating
       functions, J. Comput. Graph. Stat. 23, 853-876, doi:10.1080/10618600.2013.842174.

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

    def target(self, sampling: SamplingDistribution) -> tuple[Floats, Floats]:
        """Return the centre (r,) and covariance (r, r) that draws should have, in coordinates."""
        evaluator = sampling.evaluator
        r = sampling.stderr.size
        # Where the minimiser is, and data sets drawn from the model there.
        (center,), _ = sampling.refit(observed_set(evaluator))
        at = sampling.thetas(center)
        sets = simulated_sets(evaluator, at, self.n_sets, self.random_seed)
        # What the data tell: the minimiser's information and its bias, which as a median is the
        # same in every parametrisation, as where a scale comes near zero.
        x, converged = sampling.refit(sets)
        away = x[converged] - center
        shifts = np.clip(away, -_REACH, _REACH)
        information = _precision(shifts, r)
        bias = np.median(shifts, axis=0)
        # What the prior tells.
        draws = evaluator.prior_thetas(4 * THETAS, self.random_seed)
        prior, _ = sampling.coordinates(draws)
        precision = _precision(prior, r)
        # Both together.
        covariance = np.linalg.inv(information + precision)
        from_data = information @ (center - bias)
        from_prior = precision @ prior.mean(axis=0)
        return covariance @ (from_data + from_prior), covariance

    def __call__(self, evaluator: Evaluator, thetas: Floats, optima: Sequence[Floats]) -> Adjusted:
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
        Adjusted
        """
        obstacle = refit_obstacle(evaluator)
        if obstacle is not None:
            return Adjusted(thetas, reason=obstacle)
        draws = thetas.reshape(-1, thetas.shape[-1])
        modes = _identified_modes(evaluator, optima)
        if not modes:
            reason = "the data tell less than the prior about every hyperparameter"
            return Adjusted(thetas, reason=reason)
        distances = np.array([_distance(mode, draws) for mode in modes])
        if _run_together(distances):
            return Adjusted(thetas, reason="the posterior has modes that run into each other")
        nearest = distances.argmin(axis=0)
        out = draws.copy()
        count = 0
        far = 0
        for m, mode in enumerate(modes):
            own = nearest == m
            if own.sum() < _FEWEST:
                continue
            mapped, outside = self._mapped(mode, draws[own])
            out[own] = mapped
            far += int(outside.sum())
            count += 1
        if not count:
            return Adjusted(thetas, reason=f"there are fewer than {_FEWEST} draws of a mode")
        done = f"{self!r}"
        if len(modes) > 1:
            done += f", {count} modes each by itself"
        if far:
            share = far / len(draws)
            done += f", {share:.1%} of the draws drawn in to {_FAR:.0f} standard deviations"
        return Adjusted(out.reshape(thetas.shape), done)

    def _mapped(
        self, sampling: SamplingDistribution, draws: Floats
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the draws of one mode where they should be, and which of them were far out."""
        sampling = _among(sampling, draws)
        x, remainder = sampling.coordinates(draws)
        center, covariance = self.target(sampling)
        out = transported(sampling, x, remainder, center, covariance)
        outside = drawn_in(x, _FAR) != x
        return out, outside.any(axis=1)


def _identified_modes(evaluator: Evaluator, optima: Sequence[Floats]) -> list[SamplingDistribution]:
    """Return the sampling distributions at optima about which the data tell something."""
    scales = evaluator.epsilon
    found = []
    for theta in optima:
        sampling = _at_minimiser(SamplingDistribution.of(evaluator, theta, scales, _WEAKEST))
        if sampling.stderr.size:
            found.append(sampling)
    return found


def _at_minimiser(sampling: SamplingDistribution) -> SamplingDistribution:
    """Return the distribution at the metric's own minimiser, along what the data identify.

    An optimum that the prior held is elsewhere.
    """
    for _ in range(_STEPS):
        if not sampling.stderr.size:
            break
        (center,), _ = sampling.refit(observed_set(sampling.evaluator))
        if not np.abs(center).max() > _ELSEWHERE:
            break
        place = sampling.thetas(center)
        sampling = SamplingDistribution.of(sampling.evaluator, place, sampling.scales, _WEAKEST)
    return sampling


def _distance(sampling: SamplingDistribution, draws: Floats) -> Floats:
    """Return how far draws, (n, d), are from an optimum, in its standard errors, shape (n,)."""
    x, _ = sampling.coordinates(draws)
    length = np.linalg.norm(x, axis=-1)
    return np.asarray(length / np.sqrt(sampling.stderr.size))


def _run_together(distances: Floats) -> bool:
    """Return whether too many draws are between modes; distances have shape (modes, n)."""
    if len(distances) < 2:
        return False
    first, second = np.sort(distances, axis=0)[:2]
    # Half or twice of either changes nothing where modes are apart (docs/constants.md).
    between = second < 1.5 * first
    return bool(np.mean(between) > 0.05)


def transported(
    sampling: SamplingDistribution,
    x: Floats,
    remainder: Floats,
    center: Floats,
    covariance: Floats,
) -> Floats:
    """Map draws to a median and covariance along the axes as one normal distribution to another.

    What remains follows as its regression on them says. Draws count as refits do: their median, and
    no farther from it than three standard deviations.
    """
    r = sampling.stderr.size
    x = drawn_in(x, _FAR)
    # The symmetric map between two normal distributions.
    counted = drawn_in(x, _REACH)
    before = np.cov(counted, rowvar=False).reshape(r, r)
    root = _root(before)
    inverse = np.linalg.inv(root)
    between = _root(root @ covariance @ root)
    matrix = inverse @ between @ inverse
    shifts = x - np.median(x, axis=0)
    to = center + shifts @ matrix.T
    # The regression of the remainder on the coordinates.
    apart = x - x.mean(axis=0)
    response = remainder - remainder.mean(axis=0)
    slopes = np.linalg.solve(apart.T @ apart, apart.T @ response)
    follows = (to - x) @ slopes
    return sampling.thetas(to, remainder + follows)


def _among(sampling: SamplingDistribution, thetas: Floats) -> SamplingDistribution:
    """Return the distribution at the median of draws, (n, d), along directions not identified.

    The optimum is anywhere along them, where the prior may hardly be; refits hold them at one
    place.
    """
    local = sampling.local
    if not local.unidentified.size:
        return sampling
    middle = np.median(thetas, axis=0)
    shift = (middle - sampling.theta) / local.prior_sd
    along = local.identified @ (local.identified.T @ shift)
    place = sampling.theta + (shift - along) * local.prior_sd
    found = SamplingDistribution.of(
        sampling.evaluator,
        place,
        sampling.scales,
        _WEAKEST,
    )
    # Where more or fewer directions are identified there, the coordinates would not be the same.
    same = found.stderr.size == sampling.stderr.size
    return found if same else sampling


def _precision(points: Floats, r: int) -> Floats:
    """Return the inverse of the covariance of points, (n, r), as (r, r) for r = 1 as well."""
    covariance = np.cov(points, rowvar=False).reshape(r, r)
    return np.linalg.inv(covariance)


def _root(matrix: Floats) -> Floats:
    """Return the symmetric square root."""
    values, vectors = np.linalg.eigh(matrix)
    roots = np.sqrt(np.maximum(values, 0))
    return np.asarray((vectors * roots) @ vectors.T)
