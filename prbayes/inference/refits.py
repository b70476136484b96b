"""Refits: the minimisers of many data sets, and the sampling distribution that they follow.

Requirements on metrics and propagations are given as obstacles: a reason in words, as the end of a
sentence.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np

from prbayes._progress import progress
from prbayes._validate import AT_ONCE, IN_CACHE, ArrayPair, Bools, Floats
from prbayes.inference.asymptotics import (
    Information,
    Local,
    first_order_shifts,
    local_sampling,
    oriented,
)
from prbayes.inference.resampling import SETS, DataSets, observed_set, one_set, simulated_sets
from prbayes.metrics.base import Basis, Discrepancy, Minimum
from prbayes.metrics.density import is_differentiable
from prbayes.model.evaluator import Evaluator, has_other_terms
from prbayes.numerics.batched_minimisers import Descent, descend, descend_by_simplex
from prbayes.numerics.derivatives import second_differences
from prbayes.numerics.threads import one_thread

# Smallest share of refits that has to converge. If the outermost tenth at one end is missing, a
# normal sampling distribution is too narrow by 16 %.
MIN_CONVERGED = 0.9


@dataclass(frozen=True, eq=False)
class SamplingDistribution:
    """Sampling distribution of the minimiser around an optimum, over data sets."""

    evaluator: Evaluator
    theta: Floats  # (d,)
    scales: Floats  # (k,): divisors of the simulators' discrepancies before they are added
    information: list[Information]  # information of each simulator
    local: Local
    # (d, r): principal axes of the sampling distribution along the directions that the data
    # identify, orthonormal in units of the prior's spread.
    axes: Floats
    stderr: Floats  # (r,): standard errors along the axes

    @classmethod
    def of(
        cls, evaluator: Evaluator, theta: Floats, scales: Floats, weakest: float = 1.0
    ) -> SamplingDistribution:
        """Return the distribution at theta.

        It is of first order, from the metrics' derivatives, or from refits if a metric does not
        declare its minimum. Directions with a standard error above ``weakest`` prior standard
        deviations are not identified.
        """
        nodes = range(len(evaluator.nodes))
        information = [Information(evaluator, k, theta) for k in nodes]
        if needs_refits(evaluator):
            local = simplex_refits(evaluator, theta, scales).local(weakest)
        else:
            local = local_sampling(information, scales, weakest)
        variances, vectors = np.linalg.eigh(local.covariance)
        axes = oriented(local.identified @ vectors)
        # A variance may be zero or less by rounding.
        stderr = np.sqrt(np.maximum(variances, 1e-300))
        return cls(evaluator, theta, scales, information, local, axes, stderr)

    @property
    def noise(self) -> float:
        """The part of the objective that sampling explains."""
        pairs = zip(self.information, self.scales, strict=True)
        return float(sum(item.noise_floor / scale for item, scale in pairs))

    def coordinates(self, thetas: Floats) -> Floats:
        """Return coordinates of thetas along the axes, in standard errors, (..., d) -> (..., r)."""
        shifts = (thetas - self.theta) / self.local.prior_sd
        return shifts @ self.axes / self.stderr

    def thetas(self, x: Floats) -> Floats:
        """Return thetas, (..., d), of coordinates (..., r)."""
        shifts = (x * self.stderr) @ self.axes.T
        return self.theta + shifts * self.local.prior_sd

    def linear_estimates(self, sets: DataSets) -> Floats:
        """Return minimisers of data sets, (S, r) in coordinates, to first order."""
        shifts = first_order_shifts(self.information, self.scales, self.axes, sets)
        return shifts / self.stderr


def sampling_of_functions(sampling: SamplingDistribution) -> Local:
    """Return the first-order distribution with directions that are weakly identified as well.

    The data may identify a function of theta, such as a standard deviation, but not its elements,
    such as those of a Cholesky factor. Directions count if their standard error is at most 10 prior
    standard deviations. Any limit from 3 to 30 gives the same results
    (tests/test_correlated_inputs.py).
    """
    if not sampling.local.unidentified.size or needs_refits(sampling.evaluator):
        return sampling.local
    return local_sampling(sampling.information, sampling.scales, 10.0)


def jumping_simulators(sampling: SamplingDistribution) -> list[int]:
    """Return the simulators whose discrepancy jumps at theta, if that changes standard errors.

    It does if twice the step of the differences gives other errors: second differences over a jump
    are the smaller the wider the step, those of a smooth function are not.
    """
    jumping = [
        item.k
        for item in sampling.information
        if is_differentiable(item.node.target)
        and not item.node.bound.stored
        and item.stencil.is_wide  # because points lose their response close to theta
    ]
    if not jumping:
        return []
    evaluator, theta = sampling.evaluator, sampling.theta
    wider = [Information(evaluator, item.k, theta, widened=2.0) for item in sampling.information]
    variances, wide_variances = (
        np.diag(local_sampling(information, sampling.scales).in_theta)
        for information in (sampling.information, wider)
    )
    ratio = np.sqrt(variances / wide_variances)
    return [] if ((ratio > 1 / 1.5) & (ratio < 1.5)).all() else jumping


# -- refits from derivatives -----------------------------------------------------------------------


def refit(
    sampling: SamplingDistribution,
    sets: DataSets,
    start: Floats | None = None,
    *,
    is_rough: bool = False,
) -> tuple[Floats, Bools]:
    """Return the minimiser of each data set, (n_sets, r) in coordinates, and which converged.

    Stored responses are minimised exactly from ``start``, by default the optimum, without a new
    response. Others give first-order estimates. With ``is_rough`` the error is a few hundredths of
    a standard error, in half of the time.
    """
    if not is_stored(sampling.evaluator):
        x = sampling.linear_estimates(sets)
        return x, np.ones(len(x), dtype=bool)
    n_sets = len(sets.weights[0])
    if start is None:
        start = np.zeros((n_sets, sampling.stderr.size))
    descent = None
    results = []
    with progress("refits", n_sets) as advance:
        for rows, objective in objectives_of_batches(sampling, sets):
            if descent is None:  # the curvature of the first batch serves all batches
                descent = descent_of(sampling, objective, is_rough=is_rough)
            results.append(minimise_sets(sampling, objective, descent, start[rows]))
            advance(len(results[-1][1]), "")
    minimisers, converged = zip(*results, strict=True)
    return np.concatenate(minimisers), np.concatenate(converged)


def objectives(sampling: SamplingDistribution, sets: DataSets, thetas: Floats) -> Floats:
    """Return the objective of each data set at thetas, (T, d) -> (n_sets, T)."""
    return np.concatenate(
        [f(thetas[None], slice(None)) for _, f in objectives_of_batches(sampling, sets)]
    )


def objectives_of_batches(
    sampling: SamplingDistribution, sets: DataSets
) -> Iterator[tuple[slice, BatchObjective]]:
    """Yield the rows and the objective of as many data sets as fit into memory."""
    points = max(
        len(node.target.parts) * max(node.bound.n_points, len(values))
        for node, values in zip(sampling.evaluator.nodes, sets.values, strict=True)
    )
    at_once = max(1, 2 * AT_ONCE // points)
    for i in range(0, len(sets.weights[0]), at_once):
        rows = slice(i, i + at_once)
        batch = DataSets(sets.values, [w[rows] for w in sets.weights])
        yield rows, BatchObjective.of(sampling.evaluator, sampling.scales, batch)


def is_prepared_by_data(evaluator: Evaluator) -> bool:
    """Return whether the metric takes its coordinates from the data, as with several outputs.

    False unless responses are stored and the metric declares its minimum.
    """
    has_outputs = any(node.target.event for node in evaluator.nodes)
    return has_outputs and is_stored(evaluator) and not needs_refits(evaluator)


def refit_prepared(
    sampling: SamplingDistribution, sets: DataSets, minimisers: Floats
) -> tuple[Floats, Bools]:
    """Return the minimiser of the metric prepared for each data set, and which converged.

    The minimisers of the metric prepared for the observed data (`refit`) remain if the metric
    cannot be prepared, as for specimens that are all alike.
    """
    evaluator, scales = sampling.evaluator, sampling.scales
    result = minimisers.copy()
    is_converged = np.zeros(len(minimisers), dtype=bool)
    shared = BatchObjective.of(evaluator, scales, observed_set(evaluator))
    descent = descent_of(sampling, shared, is_rough=True)
    with progress("refits", len(minimisers)) as advance:
        for i, minimiser in enumerate(minimisers):
            advance(1, "")
            data, weights = one_set(evaluator, sets, i)
            try:
                prepared = evaluator.observing(data, weights=weights)
            except ValueError:
                # A data set can be invalid for a metric, for example if all specimens are alike.
                continue
            objective = BatchObjective.of(prepared, scales, observed_set(prepared))
            starts = np.stack([np.zeros_like(minimiser), minimiser])
            (values,) = objective(sampling.thetas(starts)[None], slice(1))
            x, converged = minimise_sets(sampling, objective, descent, starts[[values.argmin()]])
            if converged[0]:
                result[i], is_converged[i] = x[0], True
    return result, is_converged


def is_stored(evaluator: Evaluator) -> bool:
    """Return whether the responses of all simulators are stored."""
    return all(node.bound.stored for node in evaluator.nodes)


def descent_of(
    sampling: SamplingDistribution, objective: BatchObjective, *, is_rough: bool
) -> Descent:
    """Return the minimisation of data sets whose objectives have about the same curvature."""
    r = sampling.stderr.size
    step = 0.02  # step of the differences, in standard errors
    if r == 0 or needs_refits(sampling.evaluator):  # because the descent is not used then
        return partial(descend, curvature=np.eye(r), tolerance=0.0, step=step)
    # Take differences along uncorrelated directions of one standard error: along correlated axes
    # the large curvature across a ridge hides the small one along it.
    along = sampling.axes.T @ sampling.local.identified / sampling.stderr[:, None]
    try:
        root = np.linalg.cholesky(along @ sampling.local.covariance @ along.T)
    except np.linalg.LinAlgError:  # if a variance is zero by rounding
        root = np.eye(r)

    def mean_objective(z: Floats) -> Floats:
        # Fifty data sets suffice for a first guess of the curvature.
        return objective(sampling.thetas(z @ root.T), slice(50)).mean(axis=0)

    # Bound the curvatures from below by a twentieth of the largest, so that the first guess is
    # positive definite.
    curvatures, vectors = np.linalg.eigh(second_differences(mean_objective, r))
    highest = np.nanmax(curvatures)
    if not highest > np.finfo(float).tiny:  # a constant objective, as of equal observations
        return partial(descend, curvature=np.eye(r), tolerance=0.0, step=step)
    lowest = 0.05 * highest
    positive = np.maximum(np.nan_to_num(curvatures), lowest)
    across = np.linalg.inv(root)
    curvature = across.T @ ((vectors * positive) @ vectors.T) @ across
    # Take the harmonic mean of the curvatures as the cost of an error of one standard error. With
    # correlated estimates the arithmetic mean would be that of a direction with hardly any error.
    cost = r / np.trace(np.linalg.inv(curvature))
    # A tolerance of 1e-4 corresponds to an error of about a hundredth of a standard error.
    tolerance = (1e-3 if is_rough else 1e-4) * cost
    return partial(descend, curvature=curvature, tolerance=tolerance, step=step)


def minimise_sets(
    sampling: SamplingDistribution,
    objective: BatchObjective,
    descent: Descent,
    start: Floats | None = None,
) -> tuple[Floats, Bools]:
    """Return the minimisers of data sets along the axes, by default from the optimum on."""

    def value(x: Floats, rows: Any) -> Floats:
        return objective(sampling.thetas(x), rows)

    r = sampling.stderr.size
    if start is None:
        start = np.zeros((objective.n_sets, r))
    if r == 0:  # because no direction is identified
        return start, np.ones(len(start), dtype=bool)
    if needs_refits(sampling.evaluator):
        # Edges are in standard errors. The second simplex starts at the end of the first one.
        x, _, converged = descend_by_simplex(value, start, sizes=(1.0, -0.5))
        return x, converged
    minima = descent(value, start)
    return minima.x, minima.converged


# -- refits of metrics that declare nothing of their minimum ---------------------------------------


@dataclass(frozen=True, eq=False)
class SimplexRefits:
    """Data sets drawn from the model at one theta, and the minimiser of each."""

    objective: BatchObjective  # sum of the discrepancies against each data set
    theta: Floats  # (d,)
    prior_sd: Floats  # (d,)
    shifts: Floats  # (n_sets, d): minimisers less theta, in units of the prior's spread
    gain: float  # mean decrease of the objective from theta to the minimisers

    def local(self, weakest: float = 1.0) -> Local:
        """Return the minimisers' covariance, along the directions that the data identify.

        A direction is identified if the minimisers scatter along it by less than ``weakest`` prior
        standard deviations, and if the discrepancy rises along it: its second derivative, averaged
        over data sets, is more than twice the mean gain of one identified direction over
        ``weakest**2``. For a quadratic discrepancy both conditions are equivalent. Along a flat
        direction a minimiser stays close to its start, and only the second condition fails.
        """
        # Steps of the second differences are the minimisers' standard errors, because kinks at
        # different places average out over them. They are half a prior standard deviation where
        # standard errors are large.
        axes, sd = principal_axes(self.shifts)
        steps = np.minimum(np.where(sd > 0.1, 0.5, sd), 0.5)

        def mean(x: Floats) -> Floats:
            thetas = self.theta + (x * steps) @ axes.T * self.prior_sd
            return self.objective(thetas, slice(None)).mean(axis=0)

        back = axes / steps  # map to derivatives in units of the prior's spread
        hessian = back @ np.nan_to_num(second_differences(mean, steps.size)) @ back.T
        curvatures, vectors = np.linalg.eigh(hessian)
        # Sort by curvature, the largest first.
        curvatures, vectors = curvatures[::-1], vectors[:, ::-1]
        number = np.arange(1, curvatures.size + 1)
        rises = curvatures * weakest**2 > 2 * self.gain / number
        rank = int(number[rises].max(initial=0))
        rising, level = vectors[:, :rank], vectors[:, rank:]
        # Of the rising directions, keep those along which the minimisers scatter by less than the
        # limit.
        axes, sd = principal_axes(self.shifts @ rising)
        is_narrow = sd < weakest
        identified = rising @ axes[:, is_narrow]
        unidentified = np.concatenate([level, rising @ axes[:, ~is_narrow]], axis=1)
        return Local(self.prior_sd, identified, unidentified, np.diag(sd[is_narrow] ** 2))


def simplex_refits(
    evaluator: Evaluator,
    theta: Floats,
    scales: Floats,
    *,
    simulators: Sequence[int] | None = None,
) -> SimplexRefits:
    """Draw data sets at theta and minimise the discrepancy of each; no response is computed.

    The last results are cached: standard errors, epsilon and the adjustment use the same refits.
    """
    indices = tuple(range(len(evaluator.nodes)) if simulators is None else simulators)
    # The cache has ratios of scales, because minimisers depend on nothing else.
    ratios = scales / scales[indices[0]]
    designs = tuple(
        hash(bound.design.sample.values.tobytes()) for bound in evaluator.reweighted.values()
    )
    return _cached_refits(evaluator, tuple(theta), tuple(ratios), indices, designs)


@lru_cache(maxsize=4)  # entries: the optimum, and a few simulators by themselves for epsilon
def _cached_refits(
    evaluator: Evaluator,
    theta: tuple[float, ...],
    scales: tuple[float, ...],
    simulators: tuple[int, ...],
    designs: tuple[int, ...],
) -> SimplexRefits:
    """Return refits on the present designs, which have hashes ``designs``."""
    center, prior_sd = np.array(theta), evaluator.hyperparameters.prior_sd
    sets = simulated_sets(evaluator, center, SETS, seed=0)
    objective = BatchObjective.of(evaluator, np.array(scales), sets, simulators=simulators)
    d = center.size

    def value(x: Floats, rows: Any) -> Floats:
        return objective(center + x * prior_sd, rows)

    def value_along(x: Floats, rows: Any) -> Floats:
        return value((x * sd) @ axes.T, rows)

    start = np.zeros((SETS, d))
    at_theta = value(start[:, None], np.arange(SETS))[:, 0]
    # The first simplex has edges of half a prior standard deviation.
    shifts, _, _ = descend_by_simplex(value, start, sizes=[0.5])
    # The second simplices have their edges along the principal axes of the first minimisers.
    axes, sd = principal_axes(shifts)
    x, at_minimum, _ = descend_by_simplex(value_along, shifts @ axes / sd, sizes=[1.0])
    is_finite = np.isfinite(at_theta)
    gain = float((at_theta[is_finite] - at_minimum[is_finite]).mean())
    return SimplexRefits(objective, center, prior_sd, (x * sd) @ axes.T, gain)


# Ends and middle of the central 89 %, which is 3.2 standard deviations wide if normal
_QUANTILES = (0.055, 0.5, 0.945)


def principal_axes(points: Floats) -> ArrayPair:
    """Return principal axes of points, (n, d), as columns (d, d), and robust spreads along them.

    Spreads are those of the central 89 %, so that a few minimisers that ran away do not decide.
    """
    d = points.shape[1]
    if d == 0:
        return np.empty((0, 0)), np.empty(0)
    covariance = np.cov(drawn_in(points), rowvar=False).reshape(d, d)
    axes = oriented(np.linalg.eigh(covariance)[1])
    low, _, high = np.quantile(points @ axes, _QUANTILES, axis=0)
    sd = (high - low) / 3.2
    # Bound the spreads from below, because they are divisors.
    largest = sd.max()
    return axes, np.maximum(sd, 1e-4 * largest if largest > 0 else 1.0)


def drawn_in(points: Floats) -> Floats:
    """Return points, (n, d), at most three robust standard deviations from the median.

    A few in a thousand far out, as where a bounded parameter comes near its bound, would otherwise
    decide about all others.
    """
    low, middle, high = np.quantile(points, _QUANTILES, axis=0)
    far = 3.0 * (high - low) / 3.2
    return np.clip(points, middle - far, middle + far)


@dataclass(frozen=True, eq=False)
class BatchObjective:
    """The sum of d_k / scale_k against each of B data sets; no response is computed."""

    evaluator: Evaluator  # evaluator whose responses are all stored
    scales: Floats  # (K,): divisors of the discrepancies of all simulators of the model
    simulators: tuple[int, ...]  # indices of the simulators in the sum
    targets: list[Discrepancy]  # discrepancy of each simulator in the sum, against all B data sets
    values: list[Floats]  # stored responses, (n_k,) or (n_k, m)
    bases: list[Basis]  # maps from weights of stored responses to features

    @classmethod
    def of(
        cls,
        evaluator: Evaluator,
        scales: Floats,
        sets: DataSets,
        *,
        simulators: Sequence[int] | None = None,
        stored: Sequence[Floats | None] = (),
    ) -> BatchObjective:
        """Prepare the discrepancies against all data sets, by default of all simulators.

        ``stored``, by simulator, replaces the responses at the designs' points unless it is None.
        """
        if simulators is None:
            simulators = range(len(evaluator.nodes))
        # The indexing copies the weights row by row, so that sums over rows do not depend on their
        # layout in memory.
        rows = np.arange(len(sets.weights[0]))
        targets, values, bases = [], [], []
        for k in simulators:
            node = evaluator.nodes[k]
            target = node.target.with_observed(sets.values[k], sets.weights[k][rows, None])
            replacement = stored[k] if stored else None
            if replacement is None:
                responses = evaluator.reweighted[node.name].design.sample.values
            else:
                responses = replacement
            targets.append(target)
            values.append(responses)
            bases.append(target.basis(responses))
        return cls(evaluator, scales, tuple(simulators), targets, values, bases)

    @property
    def n_sets(self) -> int:
        """Number of data sets."""
        return len(self.targets[0].weights)

    @one_thread()
    def __call__(self, thetas: Floats, rows: Any) -> Floats:
        """Return the values for data sets ``rows`` at several thetas each, (A, s, d) -> (A, s).

        With thetas of shape (1, s, d) all data sets are compared with the same populations. NaN,
        as where a design has no point, becomes infinite.
        """
        # Work in portions whose weights stay in the cache.
        most = max(len(values) for values in self.values) * thetas.shape[1]
        at_once = max(1, IN_CACHE // most)
        if len(thetas) <= at_once:
            return self._values(thetas, rows)
        numbers = np.arange(self.n_sets)[rows]
        portions = [slice(i, i + at_once) for i in range(0, len(thetas), at_once)]
        return np.concatenate([self._values(thetas[p], numbers[p]) for p in portions])

    def _values(self, thetas: Floats, rows: Any) -> Floats:
        """Return the objectives of the data sets in ``rows``, each at its own thetas."""
        stacked = thetas.reshape(-1, thetas.shape[-1])
        total = 0.0
        for i, k in enumerate(self.simulators):
            _, weights = self.evaluator.populations(stacked, k)
            weights = weights.reshape(*thetas.shape[:-1], -1)
            features = self.bases[i].rows(rows).features(weights)
            total = total + self.targets[i].rows(rows).outer(*features, xp=np) / self.scales[k]
        return np.asarray(np.nan_to_num(total, nan=np.inf, posinf=np.inf))


def simulator_obstacle(evaluator: Evaluator, k: int) -> str | None:
    """Return why the minimiser of one simulator's discrepancy has no sampling distribution."""
    node = evaluator.nodes[k]
    if node.bound.random:
        return f"{node.name} has prb.Fresh, whose discrepancy is random"
    if node.metric.minimum is Minimum.UNKNOWN and not node.bound.stored:
        return (
            f"{node.name} has a {type(node.metric).__name__}, whose standard errors need refits, "
            "and these need stored responses: use propagation=prb.Reweighted()"
        )
    return None


def sampling_obstacle(evaluator: Evaluator) -> str | None:
    """Return why there is no sampling distribution of the minimiser, or None."""
    for k in range(len(evaluator.nodes)):
        obstacle = simulator_obstacle(evaluator, k)
        if obstacle is not None:
            return obstacle
    # If one simulator needs refits, all of them are refitted.
    computed = [node.name for node in evaluator.nodes if not node.bound.stored]
    if computed and needs_refits(evaluator):
        names = ", ".join(computed)
        return f"another metric needs refits, and the responses of {names} are not stored"
    return None


def refit_obstacle(evaluator: Evaluator) -> str | None:
    """Return why the model cannot be calibrated to other data sets, or None."""
    obstacle = sampling_obstacle(evaluator) or summary_obstacle(evaluator)
    if obstacle is None and evaluator.emulated:
        return "the model has a log-likelihood by specimen"
    if obstacle is None and has_other_terms(evaluator.model):
        return "the model has likelihood terms or potentials besides its simulators"
    return obstacle


def summary_obstacle(evaluator: Evaluator) -> str | None:
    """Return that a simulator has statistics instead of specimens, or None."""
    for node in evaluator.nodes:
        if node.metric.exact_likelihood:
            return f"{node.name} has a prb.Summary, and no specimens to resample"
    return None


def needs_refits(evaluator: Evaluator) -> bool:
    """Return whether a metric declares nothing of its minimum, so that refits measure it."""
    return Minimum.UNKNOWN in [node.metric.minimum for node in evaluator.nodes]
