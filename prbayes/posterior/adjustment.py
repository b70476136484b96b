"""Adjustment of a pseudo-posterior's draws to the width of the metric's own estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats, called, positive_integer
from prbayes.estimate.conflict import least_probability, of_conflict, prior_probabilities
from prbayes.estimate.data_sets import observed_set, simulated_sets
from prbayes.estimate.goodness import of_another_family, probability_of_fit
from prbayes.estimate.measured import drawn_in
from prbayes.estimate.obstacles import refit_obstacle
from prbayes.estimate.prepared_anew import as_prepared_anew, of_few_pairs
from prbayes.estimate.refinement import AGREE
from prbayes.estimate.refit import ARRIVED, SamplingDistribution
from prbayes.model.evaluator import Evaluator
from prbayes.model.hyperparameters import THETAS
from prbayes.posterior.mode_weights import (
    BY_EPSILON,
    Mode,
    dealt_out,
    mode_weights,
    of_several_modes,
)
from prbayes.posterior.pooling import pooled

# Standard errors from which on a minimiser is elsewhere than where its sampling distribution was
# taken: an optimum by itself is within a hundredth of one, one that the prior held may be far off.
# By judgement.
_ELSEWHERE = 1.0
# Times that it is followed; one or two arrive.
_STEPS = 5
# Width of draws, in standard errors, that is none: rounding, where all are copies of one.
_NO_WIDTH = 1e-6
# Draws of a mode below which it is left as it is: standard deviations from 50 have an error of a
# tenth. With 25 a mode that has 36 of 400 draws is mapped as well (docs/constants.md).
_FEWEST = 50
# Standard deviations to which draws farther out are drawn in. Half or twice moves a mean by .012
# standard deviations at most (docs/constants.md).
_FAR = 6.0
# Modes that are looked for where draws are far from all that are known, at most; by judgement.
_OVERLOOKED = 4
# Standard errors beyond which a refit counts as so far away, and no farther. Twice changes means by
# .016 standard deviations and spreads by 2% at most; with half, where refits within are cut as
# well, spreads shrink by up to 7% (docs/constants.md).
_REACH = 3.0
# Resamples of the refits that tell the Monte Carlo error of what they tell: to 7%, as any bootstrap
# standard deviation from so many.
_RESAMPLES = 100
# Monte Carlo errors that are said to be large: of the centre in standard deviations, of the width
# as a share of it. From 200 refits they are .09 and .05, from the twenty that are the least .28 and
# .16.
_UNSURE_CENTER = 0.25
_UNSURE_WIDTH = 0.15
# Standard deviations, the narrower of both, between the medians before and after, from which prior
# and data are said to be in conflict. Where they agree it is .45 at most (four metrics, 10 to 50
# data), with a prior that is narrow and several of its spreads off, 0.9 to 5.7.
_APART = 0.75
# Standard error, in units of the prior's spread, up to which refits follow a direction. Twice
# changes nothing; with half, directions about which data and prior tell as much are left to draws
# of exp(-d / epsilon), whose spread differs by a third there (docs/constants.md).
WEAKEST = 2.0


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
    # Monte Carlo errors, from the number of refits, of the worst direction: of the centre in
    # standard deviations of the draws, and of the width as a share of it; NaN if nothing was done.
    center_error: float = np.nan
    width_error: float = np.nan
    # How far the medians moved, of the worst element, in standard deviations.
    moved: float = np.nan
    # Of the data's distance from the best population, among data sets drawn there.
    fit_probability: float = np.nan
    # Of estimates as far out as that of the data, among those that the prior leads to.
    prior_probability: float = np.nan
    warnings: tuple[str, ...] = ()
    # Of the draws, up to a constant, shape (...,); None where it is not known.
    log_likelihood: Floats | None = None

    @property
    def note(self) -> str:
        """What was done, or why nothing, as results state it."""
        return self.done if self.reason is None else f"none: {self.reason}"


class UnsettledError(ValueError):
    """Too few refits converged, or draws have no width, to tell where draws belong."""


@dataclass(frozen=True, eq=False)
class _Told:
    """What refits and the prior tell of one mode, in coordinates (r)."""

    center: Floats  # (r,): of the minimiser
    shifts: Floats  # (n, r): of refits that converged, from the centre
    prior_mean: Floats  # (r,)
    prior_precision: Floats  # (r, r)
    fit_probability: float  # as in `Adjusted`
    allowed: dict[str, float]  # by the prior, as `prior_probabilities` says
    doubts: tuple[str, ...]  # what speaks against it
    design_variance: float = 0.0  # of the minimiser, by the design's error

    def of_data(self, shifts: Floats) -> tuple[Floats, Floats]:
        """Return the centre (r,) that the data tell, without bias, and their information (r, r)."""
        # What the data tell: the minimiser's information and its bias, which as a median is the
        # same in every parametrisation, as where a scale comes near zero.
        information = _precision(shifts, self.center.size)
        if self.design_variance:
            unknown = self.design_variance * np.eye(self.center.size)
            information = np.linalg.inv(np.linalg.inv(information) + unknown)
        return self.center - np.median(shifts, axis=0), information

    def combined(self, shifts: Floats) -> tuple[Floats, Floats]:
        """Return the centre (r,) and covariance (r, r) that draws should have."""
        told, information = self.of_data(shifts)
        covariance = np.linalg.inv(information + self.prior_precision)
        from_data = information @ told
        from_prior = self.prior_precision @ self.prior_mean
        return covariance @ (from_data + from_prior), covariance

    def errors(self, seed: int) -> tuple[float, float]:
        """Return the Monte Carlo errors of centre and width, of the worst direction.

        From resampled refits: of the centre in standard deviations, of the width as a share of it.
        """
        rng = np.random.default_rng([seed, 3])
        n = len(self.shifts)
        _, covariance = self.combined(self.shifts)
        sd = np.sqrt(np.diag(covariance))
        centers = []
        widths = []
        for _ in range(_RESAMPLES):
            chosen = rng.integers(n, size=n)
            center, spread = self.combined(self.shifts[chosen])
            width = np.sqrt(np.diag(spread))
            centers.append(center / sd)
            widths.append(width / sd)
        of_center = np.std(centers, axis=0).max()
        of_width = np.std(widths, axis=0).max()
        return float(of_center), float(of_width)


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
        """Return the centre (r,) and covariance (r, r) that draws should have, in coordinates.

        Raises
        ------
        ValueError
            If too few refits converge.
        """
        told = self._told(sampling)
        return told.combined(told.shifts)

    def _told(self, sampling: SamplingDistribution) -> _Told:
        """Return what refits and the prior tell.

        Raises
        ------
        UnsettledError
            If too few refits converge.
        """
        evaluator = sampling.evaluator
        # Where the minimiser is, and data sets drawn from the model there.
        (center,), _ = sampling.refit(observed_set(evaluator))
        at = sampling.thetas(center)
        sets = simulated_sets(evaluator, at, self.n_sets, self.random_seed)
        x, converged = sampling.refit(sets)
        if converged.mean() < ARRIVED:
            raise UnsettledError(
                f"{int(converged.sum())} of {self.n_sets} refits converged, expected at least "
                f"{ARRIVED:.0%}, so that they do not tell how wide the draws should be"
            )
        anew = sampling.refit_anew(sets, np.broadcast_to(center, x.shape), x)
        luck = np.random.default_rng([self.random_seed, 8]).random(len(x))
        away = as_prepared_anew(x - center, anew - center, luck)[converged]
        shifts = np.clip(away, -_REACH, _REACH)
        # What the prior tells.
        draws = evaluator.prior_thetas(4 * THETAS, self.random_seed)
        prior, _ = sampling.coordinates(draws)
        precision = _precision(prior, sampling.stderr.size)
        fit = probability_of_fit(sampling, center, sets, x, converged)
        allowed = prior_probabilities(sampling, center, shifts, self.random_seed)
        doubts = of_few_pairs(anew) if sampling.prepares else []
        return _Told(center, shifts, prior.mean(axis=0), precision, fit, allowed, tuple(doubts))

    def __call__(
        self,
        evaluator: Evaluator,
        thetas: Floats,
        optima: Sequence[Floats],
        design_error: float = 0.0,
    ) -> Adjusted:
        """Map draws of the pseudo-posterior, each mode by itself.

        Parameters
        ----------
        evaluator : Evaluator
            With the epsilons of the draws.
        thetas : ndarray, shape (..., d)
        optima : sequence of ndarray, shapes (d,)
            The best one first; draws belong to the nearest, in its own standard errors.
        design_error : float
            How far the optima of two designs are apart, in standard errors, as
            `Optimum.design_error` says; draws are as much wider where it is more than a tenth.

        Returns
        -------
        Adjusted
        """
        chosen = self._serving(evaluator, design_error)
        if chosen is not self:
            return chosen(evaluator, thetas, optima, design_error)
        return self._concluded(self._of_modes(evaluator, thetas, optima, design_error), thetas)

    def _serving(self, evaluator: Evaluator, design_error: float) -> Affine:
        """Return the adjustment that can be made: this one, or one that asks for less."""
        return self

    def _concluded(self, found: Adjusted, given: Floats) -> Adjusted:
        """Return what is said of draws that were given."""
        return found

    def _of_modes(
        self,
        evaluator: Evaluator,
        thetas: Floats,
        optima: Sequence[Floats],
        design_error: float,
    ) -> Adjusted:
        """Map the draws of each mode, or say why not."""
        obstacle = refit_obstacle(evaluator)
        if obstacle is not None:
            return _not_adjusted(thetas, obstacle)
        draws = thetas.reshape(-1, thetas.shape[-1])
        modes = _identified_modes(evaluator, optima)
        if not modes:
            reason = "the data tell less than the prior about every hyperparameter"
            return _not_adjusted(thetas, reason)
        modes = _with_overlooked(modes, draws)
        distances = np.array([_distance(mode, draws) for mode in modes])
        if _run_together(distances):
            return _not_adjusted(thetas, "the posterior has modes that run into each other")
        matters = AGREE < design_error < np.inf
        # Two designs differ by the root of two of one's error.
        variance = design_error**2 / 2 if matters else 0.0
        return self._adjusted(evaluator, thetas, modes, distances, variance)

    def _adjusted(
        self,
        evaluator: Evaluator,
        thetas: Floats,
        modes: list[SamplingDistribution],
        distances: Floats,
        design_variance: float,
    ) -> Adjusted:
        """Map the draws of each mode, (..., d), given their distances (modes, n) from each."""
        rows, nearest, counted = self._dealt_out(modes, thetas, distances.argmin(axis=0))
        draws = thetas.reshape(-1, thetas.shape[-1])[rows]
        out = draws.copy()
        mapped = []
        for m, mode in enumerate(modes):
            own = nearest == m
            if own.sum() < _FEWEST:
                continue
            try:
                found = self._mapped(mode, draws[own], design_variance)
            except UnsettledError as error:
                return _not_adjusted(thetas, str(error))
            out[own] = found.draws
            mapped.append(found)
        if not mapped:
            return _not_adjusted(thetas, f"there are fewer than {_FEWEST} draws of a mode")
        center_error = max(found.center_error for found in mapped)
        width_error = max(found.width_error for found in mapped)
        moves = _moves(draws, out)
        unweighed = counted if counted == BY_EPSILON else ""
        enough = np.bincount(nearest)[nearest] >= _FEWEST
        several = of_several_modes(evaluator.constrained(out[enough]), nearest[enough], unweighed)
        # Of several modes the one that the prior allows most.
        allowed = max((found.allowed for found in mapped), key=least_probability)
        # Of several modes the constants between them are not known.
        likelihood = mapped[0].log_likelihood if len(modes) == 1 else None
        if likelihood is not None:
            likelihood = likelihood.reshape(thetas.shape[:-1])
        return Adjusted(
            out.reshape(thetas.shape),
            self._said(mapped, len(modes), len(draws), design_variance) + counted,
            center_error=center_error,
            width_error=width_error,
            moved=float(moves.max()),
            fit_probability=mapped[0].fit_probability,
            prior_probability=least_probability(allowed),
            warnings=(
                *several,
                *of_conflict(allowed),
                *self._distrust(moves, mapped, evaluator.readable_names),
                *_of_noise(center_error, width_error, self._refits),
                *of_another_family(mapped[0].fit_probability),
            ),
            log_likelihood=likelihood,
        )

    def _dealt_out(
        self, modes: list[SamplingDistribution], thetas: Floats, nearest: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], str]:
        """Return which draws stand for the posterior, (n,), their modes, and what to say of it.

        Modes count as fits in all of them tell, where responses are stored, and else as epsilon
        says.
        """
        every = np.arange(nearest.size)
        numbers = np.bincount(nearest, minlength=len(modes))
        if len(modes) < 2 or numbers.min() < _FEWEST:
            return every, nearest, ""
        as_drawn = every, nearest, BY_EPSILON
        evaluator = modes[0].evaluator
        stored = all(node.bound.stored for node in evaluator.nodes)
        if not stored or evaluator.told_by_prior.any():
            return as_drawn
        draws = thetas.reshape(-1, thetas.shape[-1])
        rng = np.random.default_rng([self.random_seed, 10])
        try:
            found = [
                self._mode(mode, draws[nearest == m], numbers[m] / nearest.size)
                for m, mode in enumerate(modes)
            ]
            weights = mode_weights(found, 2 * self.n_sets, rng)
        except (ValueError, np.linalg.LinAlgError):
            return as_drawn
        if weights is None:
            return as_drawn
        rows, dealt = dealt_out(nearest, weights, rng)
        shares = " and ".join(f"{weight:.2f}" for weight in weights)
        return rows, dealt, f", of shares {shares}"

    def _mode(self, sampling: SamplingDistribution, draws: Floats, share: float) -> Mode:
        sampling = among(sampling, draws)
        told = self._told(sampling)
        x, _ = sampling.coordinates(draws)
        before = np.atleast_2d(np.cov(drawn_in(x, _REACH), rowvar=False))
        return Mode(sampling, share, before, *told.combined(told.shifts))

    @property
    def _refits(self) -> str:
        """What the number of refits is set by."""
        return f"Affine(n_sets={self.n_sets})"

    def _distrust(self, moves: Floats, mapped: list[Mapped], names: list[str]) -> list[str]:
        """Say where the map is not to be relied on, given how far each median moved, (d,)."""
        doubts = [doubt for mode in mapped for doubt in mode.doubts]
        exact = all(mode.given for mode in mapped)
        return doubts if exact else [*doubts, *_of_motion(moves, names)]

    def _said(self, mapped: list[Mapped], modes: int, draws: int, design_variance: float) -> str:
        """Return what was done, in words."""
        done = f"{self!r}"
        if modes > 1:
            few = "" if len(mapped) == modes else f", but {modes - len(mapped)} of few draws"
            done += f", {modes} modes each by itself{few}"
        far = sum(found.outside for found in mapped)
        if far:
            share = far / draws
            done += f", {share:.1%} of the draws drawn in to {_FAR:.0f} standard deviations"
        if design_variance:
            done += f", with the design's error of {np.sqrt(design_variance):.2f} standard errors"
        return done

    def _mapped(
        self, sampling: SamplingDistribution, draws: Floats, design_variance: float
    ) -> Mapped:
        """Return the draws of one mode where they should be."""
        return self._by_refits(among(sampling, draws), draws, design_variance)

    def _by_refits(
        self, sampling: SamplingDistribution, draws: Floats, design_variance: float
    ) -> Mapped:
        x, remainder = sampling.coordinates(draws)
        told = replace(self._told(sampling), design_variance=design_variance)
        errors = told.errors(self.random_seed)
        if sampling.evaluator.told_by_prior.any():
            center, information = told.of_data(told.shifts)
            found, doubts = pooled(sampling, center, information, draws, self.random_seed)
            mapped = Mapped(found, 0, *errors, told.fit_probability, told.allowed)
            return replace(mapped, given=True, doubts=(*told.doubts, *doubts))
        center, covariance = told.combined(told.shifts)
        out = transported(sampling, x, remainder, center, covariance)
        outside = drawn_in(x, _FAR) != x
        far = int(outside.any(axis=1).sum())
        mapped = Mapped(out, far, *errors, told.fit_probability, told.allowed)
        return replace(mapped, doubts=told.doubts)


@dataclass(frozen=True, eq=False)
class Mapped:
    """The draws of one mode where they should be."""

    draws: Floats  # (n, d)
    outside: int  # how many of them were far out
    center_error: float  # as in `Adjusted`
    width_error: float
    fit_probability: float
    allowed: dict[str, float]  # as in `_Told`
    given: bool = False  # whether they are draws given the estimate, and not only mapped
    doubts: tuple[str, ...] = ()  # what speaks against them
    log_likelihood: Floats | None = None  # (n,): of the draws, where it is known


def _not_adjusted(thetas: Floats, reason: str) -> Adjusted:
    """Return the draws that were given, and say why they stay as they are."""
    said = f"the draws are not adjusted: {reason}; their width is epsilon's"
    return Adjusted(thetas, reason=reason, warnings=(said,))


def _moves(before: Floats, after: Floats) -> Floats:
    """Return how far the medians of draws, (n, d), moved, in standard deviations, (d,)."""
    sd_before = drawn_in(before, _REACH).std(axis=0)
    sd_after = drawn_in(after, _REACH).std(axis=0)
    narrower = np.maximum(np.minimum(sd_before, sd_after), 1e-300)
    shift = np.median(after, axis=0) - np.median(before, axis=0)
    return np.asarray(np.abs(shift) / narrower)


def _of_motion(moves: Floats, names: list[str]) -> list[str]:
    """Say so where the adjusted draws are elsewhere than those of the prior and epsilon."""
    apart = [i for i, move in enumerate(moves) if move > _APART]
    if not apart:
        return []
    listed = ", ".join(f"{moves[i]:.1f} for {names[i]}" for i in apart)
    return [
        "the medians of the draws before and after the adjustment are some standard deviations "
        f"apart ({listed}), expected at most {_APART}: prior and data probably contradict each "
        "other, where the adjustment, which takes both as normal, is not to be relied on; look at "
        "the prior, and at the group `unadjusted`, or pass adjust=False"
    ]


def _of_noise(center_error: float, width_error: float, refits: str) -> list[str]:
    """Say so where too few refits tell."""
    if not (center_error > _UNSURE_CENTER or width_error > _UNSURE_WIDTH):
        return []
    return [
        f"the adjustment has a Monte Carlo error of {center_error:.2f} standard deviations of the "
        f"centre and of {width_error:.0%} of the width, from the number of its refits, expected at "
        f"most {_UNSURE_CENTER} and {_UNSURE_WIDTH:.0%}; it was prb.posterior.{refits}: pass "
        "adjust= with more"
    ]


def _identified_modes(evaluator: Evaluator, optima: Sequence[Floats]) -> list[SamplingDistribution]:
    """Return the sampling distributions at optima about which the data tell something."""
    scales = evaluator.epsilon
    found = []
    for theta in optima:
        sampling = _at_minimiser(SamplingDistribution.of(evaluator, theta, scales, WEAKEST))
        if sampling.stderr.size:
            found.append(sampling)
    return found


def _with_overlooked(
    modes: list[SamplingDistribution], draws: Floats
) -> list[SamplingDistribution]:
    """Return modes and those that draws, (n, d), have besides, with stored responses.

    Not every mode is as good as the best one: it has draws where the data cannot quite exclude it.
    """
    evaluator = modes[0].evaluator
    if not all(node.bound.stored for node in evaluator.nodes):
        return modes
    found = list(modes)
    for _ in range(_OVERLOOKED):
        far = draws[np.min([_distance(mode, draws) for mode in found], axis=0) > _FAR]
        if len(far) < _FEWEST:
            break
        likely = evaluator(far).log_likelihood(evaluator.epsilon)
        best = far[int(np.nan_to_num(likely, nan=-np.inf).argmax())]
        mode = _at_minimiser(SamplingDistribution.of(evaluator, best, evaluator.epsilon, WEAKEST))
        # Where it leads back these draws are the tail of a mode that is known, and as far from it.
        if not mode.stderr.size or (_distance(mode, far) < _FAR).sum() < _FEWEST:
            break
        # They are a tail, too, where there are draws all the way to it.
        if _run_together(np.array([_distance(one, draws) for one in (*found, mode)])):
            break
        found.append(mode)
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
        sampling = SamplingDistribution.of(sampling.evaluator, place, sampling.scales, WEAKEST)
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

    Raises
    ------
    UnsettledError
        If the draws have no width.
    """
    r = sampling.stderr.size
    x = drawn_in(x, _FAR)
    # The symmetric map between two normal distributions.
    counted = drawn_in(x, _REACH)
    before = np.cov(counted, rowvar=False).reshape(r, r)
    if np.linalg.eigvalsh(before)[0] < _NO_WIDTH**2:
        raise UnsettledError(
            f"the {len(x)} draws of a mode have no width of their own, as one particle that "
            "survived has none: pass more draws"
        )
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


def among(sampling: SamplingDistribution, thetas: Floats) -> SamplingDistribution:
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
        WEAKEST,
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
