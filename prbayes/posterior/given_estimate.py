"""The posterior given the metric's own estimate: ABC whose summary is the estimate."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats, positive_integer
from prbayes._threads import one_thread
from prbayes.estimate.data_sets import observed_set, sets_along
from prbayes.estimate.prepared_anew import as_prepared_anew, of_few_pairs
from prbayes.estimate.prior_ends import at_prior_ends
from prbayes.estimate.refit import ARRIVED, SamplingDistribution
from prbayes.model.evaluator import Evaluator
from prbayes.model.support import TOLERABLE, supports_each
from prbayes.posterior.adjustment import (
    WEAKEST,
    Affine,
    Mapped,
    UnsettledError,
    among,
)
from prbayes.posterior.sampling_model import SamplingModel, Sight
from prbayes.posterior.walk import REMEMBERED, WALK, walked

# How much wider than the draws so far the hyperparameters are spread that data sets are drawn at:
# the model of the estimates has to hold in the tails of the posterior as well.
_SPREAD_OUT = 1.5
# Standard deviations of the draws within which refits count for most.
_NEARBY = 2.0
# The same of the refits' hyperparameters, beyond which the model is not believed at all.
_BEYOND = 5.0
# Standard deviations of the draws that their middle may have moved since data sets were drawn.
_MOVED = 1.0
# Standard deviations of the draws around the estimate within which estimates count as numbers, and
# the share of draws beyond which an estimate is none.
_IN_SIGHT = 4.0
_OUTERMOST = 0.01
# Times more that data sets are drawn, where the draws have moved.
_FOLLOWED = 4
# Standard deviations that an estimate may be from where it is expected, for a typical draw: as far
# as the outermost of so many refits.
_STRAINED = 3.5
# Resamples of the refits that tell the Monte Carlo error, and draws that they are told on.
_RESAMPLED = 30
_TOLD_ON = 500


@dataclass(frozen=True)
class GivenEstimate(Affine):
    r"""Draws from the posterior of theta given the estimate of the metric.

    The draws of the pseudo-posterior, mapped as `Affine` does, say where to look. Hyperparameters
    are drawn there, more widely; a data set is drawn at each, on stored responses, and fitted. What
    these estimates tell is how the estimate is distributed as a function of the hyperparameters:
    its bias, spread and skewness, each changing with them. The density of the estimate that was
    found is a likelihood, to which the prior is added exactly, and draws are made from both.

    A metric of several outputs takes from the data in which coordinates it looks at them. Some of
    the data sets are fitted by the metric as it is prepared for each of them, and tell where the
    estimates of all are; of metrics whose minimum declares nothing it is not known.

    By ``random_seed`` the width of the draws varies by 2 to 6% where a response is folded
    (``benchmarks/folded.py``), and more where prior and data contradict each other.

    Where responses are not stored, the optimum is at an edge, as where a standard deviation is
    about zero, or too few of these fits arrive, the draws are those of `Affine`, and the result
    says so.

    Parameters
    ----------
    n_sets : int
        Number of data sets drawn and fitted at the optimum, which `Affine` needs.
    random_seed : int
    n_fits : int
        Number of data sets drawn and fitted along the posterior.

    References
    ----------
    .. [1] Drovandi, C. C., A. N. Pettitt and M. J. Faddy (2011), Approximate Bayesian computation
       using indirect inference, J. R. Stat. Soc. C 60, 317-337,
       doi:10.1111/j.1467-9876.2010.00747.x.

    Examples
    --------
    >>> GivenEstimate()
    GivenEstimate(n_sets=200, random_seed=0, n_fits=2000)
    """

    n_fits: int = 2000

    def __post_init__(self) -> None:
        super().__post_init__()
        positive_integer(self.n_fits, "GivenEstimate: n_fits", minimum=200)

    @property
    def _refits(self) -> str:
        return f"GivenEstimate(n_fits={self.n_fits})"

    def _serving(self, evaluator: Evaluator, design_error: float) -> Affine:
        """Return this, or `Affine` where data sets along the posterior would cost responses."""
        if all(node.bound.stored for node in evaluator.nodes):
            return self
        return Affine(self.n_sets, self.random_seed)

    def _said(self, mapped: list[Mapped], modes: int, draws: int, design_variance: float) -> str:
        """Return what was done, in words."""
        done = super()._said(mapped, modes, draws, design_variance)
        if all(mode.given for mode in mapped):
            return done
        return f"{done}, as Affine does where refits tell no density of the estimate"

    @one_thread()
    def _mapped(
        self, sampling: SamplingDistribution, draws: Floats, design_variance: float
    ) -> Mapped:
        """Return the draws of one mode where they should be."""
        ends = at_prior_ends(sampling)
        sampling = among(sampling, draws)
        first = self._by_refits(sampling, draws, design_variance)
        rng = np.random.default_rng([self.random_seed, 7])
        try:
            if ends:
                raise UnsettledError(
                    f"the data push {' and '.join(map(str, ends))}, where estimates pile up"
                )
            look = _Look.at(sampling, draws, design_variance)
            found = self._followed(look, first.draws, rng)
        except (UnsettledError, np.linalg.LinAlgError) as error:
            doubt = f"{error}; the draws are those of prb.posterior.Affine()"
            return replace(first, doubts=(*first.doubts, doubt))
        center_error, width_error = look.errors(found, rng)
        return replace(
            first,
            given=True,
            outside=0,
            draws=found.draws,
            center_error=center_error,
            width_error=width_error,
            doubts=self._doubts(look, found),
            log_likelihood=look.log_likelihood(found.model, found.draws),
        )

    def _followed(self, look: _Look, draws: Floats, rng: np.random.Generator) -> _Found:
        """Draw data sets where the draws are, until these stay there."""
        refits = look.refits(draws, self.n_fits // 2, rng)
        for _ in range(1 + _FOLLOWED):
            before = draws
            model = look.model(refits, draws)
            draws, _ = look.drawn(model, refits, draws, rng)
            refits = refits.and_more(look.refits(draws, self.n_fits // 2, rng))
            moved = _motion(look.points(before), look.points(draws))
            if moved < _MOVED:
                break
        model = look.model(refits, draws)
        draws, memory = look.drawn(model, refits, draws, rng)
        return _Found(draws, model, refits, moved, memory)

    def _doubts(self, look: _Look, found: _Found) -> tuple[str, ...]:
        """Say what speaks against the draws."""
        doubts = []
        if look.sampling.prepares:
            doubts += of_few_pairs(found.refits.anew)
        strain = look.strain(found.model, found.draws)
        if strain > _STRAINED:
            doubts.append(
                f"for a typical draw the estimate of the data is {strain:.1f} standard deviations "
                f"from where it is expected, of which {_STRAINED} can be told from {self.n_fits} "
                "refits: prior and data probably contradict each other, and the draws rest on an "
                "extrapolation; look at the prior"
            )
        if not found.moved < _MOVED:
            doubts.append(
                f"the draws still moved by {found.moved:.1f} of their standard deviations in the "
                f"last of {1 + _FOLLOWED} rounds of refits, expected less than {_MOVED}; pass "
                f"adjust=prb.posterior.GivenEstimate(n_fits={2 * self.n_fits}), or look at the "
                "prior"
            )
        if found.memory > REMEMBERED:
            doubts.append(
                f"after {WALK} steps the draws still have a correlation of {found.memory:.2f} "
                f"with where they began, expected at most {REMEMBERED}, so that they are not yet "
                "those of the posterior given the estimate; compare with adjust="
                "prb.posterior.Affine()"
            )
        return tuple(doubts)


@dataclass(frozen=True, eq=False)
class _Refits:
    """Estimates of data sets, and the hyperparameters that these were drawn at."""

    thetas: Floats  # (n, d)
    points: Floats  # (n, r): their coordinates
    minimisers: Floats  # (n, r): of the metric as it is prepared for the data
    # (n, r): of the metric prepared for the data set; NaN of most, and where that is the same.
    anew: Floats
    luck: Floats  # (n,): as `as_prepared_anew` has it

    @cached_property
    def estimates(self) -> Floats:
        """Those of the metric prepared for each data set, told from some of them, (n, r)."""
        away = self.minimisers - self.points
        return self.points + as_prepared_anew(away, self.anew - self.points, self.luck)

    def and_more(self, other: _Refits) -> _Refits:
        """Return these and others."""
        pairs = [(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)]
        return _Refits(*map(np.concatenate, pairs))

    def rows(self, chosen: NDArray[np.intp]) -> _Refits:
        """Return some of them, which may be the same more than once."""
        return _Refits(*(getattr(self, f.name)[chosen] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class _Found:
    """The posterior given the estimate, and what it was found by."""

    draws: Floats  # (n, d)
    model: SamplingModel
    refits: _Refits
    moved: float  # in the last round, in standard deviations
    memory: float  # correlation of the draws with where their walk began


@dataclass(frozen=True, eq=False)
class _Look:
    """What is looked at: the estimate of the data, along what they identify."""

    sampling: SamplingDistribution
    estimate: Floats  # (r,): in coordinates
    variance: float  # of the estimate, by the design's error
    bounded: bool  # whether the users' own values are others than unconstrained ones

    @classmethod
    def at(cls, sampling: SamplingDistribution, draws: Floats, variance: float) -> _Look:
        """Return it for a mode; along the hyperparameters where all are identified.

        Raises
        ------
        UnsettledError
            If the optimum is at an edge, where estimates pile up and have no density.
        """
        if sampling.local.unidentified.size:
            middle = np.median(draws, axis=0)
            within = SamplingDistribution.of(sampling.evaluator, middle, sampling.scales, WEAKEST)
            if within.stderr.size > sampling.stderr.size:
                raise UnsettledError(
                    "the optimum is at an edge, as where a standard deviation is about zero: the "
                    "data tell less there than at the middle of the draws, and estimates pile up"
                )
        sampling = _along_elements(sampling)
        (estimate,), _ = sampling.refit(observed_set(sampling.evaluator))
        own = _own_values(sampling.evaluator, draws)
        bounded = own.shape == draws.shape and not np.allclose(own, draws)
        return cls(sampling, estimate, variance, bounded)

    @property
    def evaluator(self) -> Evaluator:
        """That of the model."""
        return self.sampling.evaluator

    def points(self, thetas: Floats) -> Floats:
        """Return coordinates of thetas, (n, d): what is identified first."""
        local = self.sampling.local
        x, _ = self.sampling.coordinates(thetas)
        shifts = (thetas - self.sampling.theta) / local.prior_sd
        return np.column_stack([x, shifts @ local.unidentified])

    def thetas(self, points: Floats) -> Floats:
        """Return the thetas of coordinates, (n, d)."""
        local = self.sampling.local
        r = self.sampling.stderr.size
        remainder = points[:, r:] @ local.unidentified.T * local.prior_sd
        return self.sampling.thetas(points[:, :r], remainder)

    def kinds(self, thetas: Floats) -> list[Floats]:
        """Return coordinates of several kinds, (n, d) each: also the users' own values.

        Where a standard deviation comes near zero nothing changes any more with its logarithm.
        """
        kinds = [self.points(thetas)]
        if self.bounded:
            kinds.append(_own_values(self.evaluator, thetas))
        return kinds

    def sight(self, draws: Floats) -> Sight:
        """Return where an estimate counts as a number, around that of the data or the draws."""
        r = self.estimate.size
        points = self.points(draws)[:, :r]
        low, high = np.quantile(points, [_OUTERMOST, 1 - _OUTERMOST], axis=0)
        # An estimate that ran away is beyond what the posterior is about.
        width = points.std(axis=0)
        middle = np.clip(self.estimate, low - width, high + width)
        return Sight(middle - _IN_SIGHT * width, middle + _IN_SIGHT * width)

    def refits(self, draws: Floats, number: int, rng: np.random.Generator) -> _Refits:
        """Draw data sets around draws, and fit them.

        Raises
        ------
        UnsettledError
            If designs support too few of them, or too few refits converge.
        """
        near = self.points(draws)
        middle = np.median(near, axis=0)
        chosen = near[rng.integers(len(near), size=number)]
        points = middle + _SPREAD_OUT * (chosen - middle)
        thetas = self.thetas(points)
        supported = self._supported(thetas)
        if supported.mean() < 0.5:
            raise UnsettledError(
                f"designs support {supported.mean():.0%} of the populations around the posterior, "
                "expected at least half, so that data sets cannot be drawn there"
            )
        thetas = thetas[supported]
        sets = sets_along(self.evaluator, thetas, rng)
        start = points[supported, : self.estimate.size]
        estimates, converged = self.sampling.refit(sets, start, roughly=True)
        if converged.mean() < ARRIVED:
            raise UnsettledError(
                f"{int(converged.sum())} of {converged.size} refits converged, expected at least "
                f"{ARRIVED:.0%}, so that they do not tell how the estimate is distributed"
            )
        anew = self.sampling.refit_anew(sets, start, estimates)
        luck = rng.spawn(1)[0].random(len(start))  # what else is drawn stays as it was
        return _Refits(thetas, start, estimates, anew, luck).rows(np.flatnonzero(converged))

    def _supported(self, thetas: Floats) -> Any:
        """Return at which thetas designs support the populations, shape (n,)."""
        supported = np.isfinite(self.evaluator.hyperparameters.log_prior(thetas))
        for name, support in self.evaluator.support(thetas).items():
            design = self.evaluator.designs[name]
            most = design.config.max_lost
            supported &= supports_each(support, design.required_ess, most, TOLERABLE)
        return supported

    def weights(self, refits: _Refits, near: Floats) -> Floats:
        """Return how much each refit counts for a model around draws, (m, d)."""
        squared = _distances(self.points(refits.thetas), self.points(near))
        return np.asarray(np.exp(-0.5 * squared / _NEARBY**2))

    def model(self, refits: _Refits, draws: Floats) -> SamplingModel:
        """Return the model of the estimate around draws."""
        kinds = self.kinds(refits.thetas)
        weights = self.weights(refits, draws)
        return SamplingModel.fit(kinds, refits.estimates, weights, self.sight(draws))

    def drawn(
        self, model: SamplingModel, refits: _Refits, draws: Floats, rng: np.random.Generator
    ) -> tuple[Floats, float]:
        """Return as many draws of the posterior, (n, d), and how they hang on the given ones."""
        clouds = self.kinds(refits.thetas)

        def log_density(thetas: Floats) -> Floats:
            total = np.full(len(thetas), -np.inf)
            kinds = self.kinds(thetas)
            near = np.isfinite(thetas).all(axis=1)
            for points, cloud in zip(kinds, clouds, strict=True):
                near &= _distances(points, cloud) <= _BEYOND**2
            some = [points[near] for points in kinds]
            likelihood = model.log_likelihood(some, self.estimate, self.variance)
            log_prior = self.evaluator.hyperparameters.log_prior(thetas[near])
            total[near] = log_prior + likelihood
            return np.where(np.isnan(total), -np.inf, total)

        return walked(log_density, draws, rng)

    def log_likelihood(self, model: SamplingModel, draws: Floats) -> Floats:
        """Return the log-density of the estimate at draws, (n,)."""
        return model.log_likelihood(self.kinds(draws), self.estimate, self.variance)

    def strain(self, model: SamplingModel, draws: Floats) -> float:
        """Return how far out the estimate is for a typical draw, in standard deviations."""
        return float(np.median(model.strain(self.kinds(draws), self.estimate)))

    def errors(self, found: _Found, rng: np.random.Generator) -> tuple[float, float]:
        """Return the Monte Carlo errors of centre and width, as `Adjusted` has them."""
        model = found.model
        refits = found.refits
        draws = found.draws
        some = draws[rng.permutation(len(draws))[:_TOLD_ON]]
        points = self.points(some)
        kinds = self.kinds(some)
        weights = self.weights(refits, some)
        before = model.log_likelihood(kinds, self.estimate, self.variance)
        sd = points.std(axis=0)
        fitted = self.kinds(refits.thetas)
        n = len(weights)
        centers = []
        widths = []
        for _ in range(_RESAMPLED):
            chosen = rng.integers(n, size=n)
            other = SamplingModel.fit(
                [kind[chosen] for kind in fitted],
                refits.rows(chosen).estimates,
                weights[chosen],
                model.sight,
                like=model,
            )
            after = other.log_likelihood(kinds, self.estimate, self.variance)
            ratio = np.exp(after - before - (after - before).max())
            ratio /= ratio.sum()
            center = ratio @ points
            variance = ratio @ (points - center) ** 2
            centers.append(center / sd)
            widths.append(np.sqrt(variance) / sd)
        of_center = np.std(centers, axis=0).max()
        of_width = np.std(widths, axis=0).max()
        return float(of_center), float(of_width)


def _along_elements(sampling: SamplingDistribution) -> SamplingDistribution:
    """Return the distribution along the hyperparameters themselves, where all are identified.

    The estimate of a scale is skewed, that of a location is not: axes between them would be both.
    """
    local = sampling.local
    if local.unidentified.size:
        return sampling
    covariance = local.identified @ local.covariance @ local.identified.T
    stderr = np.sqrt(np.diag(covariance))
    return replace(sampling, axes=np.eye(stderr.size), stderr=stderr)


def _distances(points: Floats, cloud: Floats) -> Floats:
    """Return the mean squared distance of points, (n, d), from the middle of a cloud, (m, d).

    In standard deviations of the cloud, (n,): the mean over its principal axes.
    """
    d = points.shape[1]
    covariance = np.cov(cloud, rowvar=False).reshape(d, d)
    values, vectors = np.linalg.eigh(covariance)
    along = (points - np.median(cloud, axis=0)) @ vectors
    squared = along**2 / np.maximum(values, 1e-12 * values[-1])
    return np.asarray(squared.mean(axis=1))


def _motion(before: Floats, after: Floats) -> float:
    """Return how far the middle of draws moved, in standard deviations of those before."""
    shift = np.median(after, axis=0) - np.median(before, axis=0)
    return float(np.abs(shift / before.std(axis=0)).max())


def _own_values(evaluator: Evaluator, thetas: Floats) -> Floats:
    """Return the users' own values of thetas, (n, d), side by side."""
    own = evaluator.constrained(thetas)
    columns = [np.reshape(values, (len(thetas), -1)) for values in own.values()]
    return np.column_stack(columns)
