"""Asymptotic sampling distribution of the minimiser: the sandwich, and its analogue for areas.

The sandwich is H^-1 J H^-1, of the Hessian H and the covariance J of the gradient. Both follow from
the population at theta, so that `Reweighted` computes no response. Derivatives are central
differences of stored weights, exact to rounding.

Directions that the data do not identify are left out, and have names.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from prbayes._stats import distribution_function, positive_scale, quantile, reached
from prbayes._validate import AT_ONCE, Bools, Floats, Indices, flat_rows
from prbayes.inference.resampling import (
    SETS,
    DataSets,
    dependent,
    observable,
    simulated_sets,
    thinned,
)
from prbayes.metrics.area import bias_and_density, correction_table, interpolated, without_rounding
from prbayes.metrics.base import Discrepancy, Minimum, Part, is_additive
from prbayes.metrics.density import DensityDiscrepancy, is_differentiable
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import Node
from prbayes.numerics.derivatives import hessian_of, slopes, stencil

# smallest positive number, which keeps quotients of vanishing variances finite
_TINY = np.finfo(float).tiny


def single_output_parts(target: Discrepancy) -> list[Part]:
    """Return the parts that compare one number of a specimen: with one output the metric."""
    return [part for part in target.parts if not part.target.event]


# -- populations around theta ------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LinearArea:
    """The area metric of data sets, with distribution functions that are linear in theta.

    At theta + delta it is the sum over intervals of |gaps + delta @ slopes| lengths, less that of
    the correction at simulated + delta @ slopes.
    """

    # (n_sets, m): simulated less observed distribution function on each interval between knots.
    gaps: Floats
    slopes: Floats  # (d, m): derivatives of the simulated distribution function
    lengths: Floats  # (m,): lengths of the intervals
    simulated: Floats  # (m,): simulated distribution function
    specimens: int  # number of specimens of the correction for few specimens; zero without it

    def of_sets(self) -> Floats:
        """Return the area at theta for each data set, (n_sets,)."""
        table = correction_table(self.specimens)
        measured = self.simulated - self.gaps
        gain = interpolated(table, measured)
        gain -= interpolated(table, self.simulated)
        heights = np.abs(self.gaps) + gain
        return np.asarray(heights @ self.lengths)


@dataclass(frozen=True, eq=False)
class Stencil:
    """Populations around theta, in the order of `numerics.derivatives.stencil`."""

    step: Floats  # (d,): steps, shorter than the nominal ones where the prior is wide
    is_wide: bool  # whether the nominal step is that for step functions
    values: Floats  # (s, n): responses, or (s, n, m) of several outputs
    weights: Floats  # (s, n): weights of the responses
    blocks: Indices  # (n,): blocks of the design's points, copied because the design may change
    has_equal_values: bool  # whether the responses are the same at all points, as stored ones are


def _stencil_around(
    evaluator: Evaluator, k: int, theta: Floats, share: float, *, is_wide: bool
) -> Stencil:
    """Return populations around theta; steps are shortened until populations overlap.

    ``share`` is the nominal step in prior standard deviations.
    """
    node, d = evaluator.nodes[k], theta.size
    across = slice(1 + 2 * d)  # theta and its neighbours along each element
    step = share * evaluator.hyperparameters.prior_sd
    # Largest distance between the distribution functions on both sides of a step. It corresponds to
    # a shift of a normal population by .6 standard deviations, over which differences are accurate
    # to a few per cent.
    largest = 0.24
    stencils = []
    for _ in range(9):  # each step is up to ten times shorter, to 1e-11 of the prior's spread
        values, weights = evaluator.populations(theta + stencil(d) * step, k)
        is_equal = np.array_equal(values[0], values[-1], equal_nan=True)
        around = Stencil(step, is_wide, values, weights, node.bound.blocks, is_equal)
        stencils.append(around)
        moves = np.zeros(d)  # largest change of a distribution function over a step, by element
        for part in single_output_parts(node.target):
            projection = part.of(values[:1] if is_equal else values)
            is_usable = np.isfinite(projection[0]) & (weights[0] > 0)
            if not is_usable.any():
                continue
            mass = weights[0][is_usable]
            mass = mass / mass.sum()
            knots = quantile(projection[0][is_usable], mass, np.linspace(0.05, 0.95, 19))
            simulated = projection[0] if is_equal else projection[across]
            below = distribution_function(simulated, weights[across], knots)
            gaps = np.nan_to_num(np.abs(below[1:] - below[0]).max(axis=-1))
            moves = np.maximum(moves, gaps.reshape(2, d).max(axis=0))
        if moves.max(initial=0.0) <= largest:
            return around
        # Where populations do not overlap, the distance does not tell how much shorter the step has
        # to be.
        factor = np.where(moves > 0.9, 0.1, 0.5 * largest / moves.clip(1e-9))
        step = np.where(moves > largest, factor, 1.0) * step
    # A population that is a single number overlaps with no other at any step.
    return stencils[0]


# -- H and J ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Information:
    """Information about theta in one simulator's data, if they are drawn from the model there."""

    evaluator: Evaluator
    k: int  # index of the simulator
    theta: Floats  # (d,)
    n_sets: int = SETS  # number of simulated data sets, each of the observed size
    widened: float = 1.0  # factor of the step where the discrepancy jumps, or has steps in theta

    @property
    def prior_sd(self) -> Floats:
        """The prior's standard deviation of each element, (d,)."""
        return self.evaluator.hyperparameters.prior_sd

    @property
    def node(self) -> Node:
        """The simulator, read from the evaluator so that both are the same after a pickle."""
        return self.evaluator.nodes[self.k]

    @cached_property
    def stencil(self) -> Stencil:
        """The populations around theta, at the smallest steps that suit the discrepancy."""
        target, bound = self.node.target, self.node.bound
        # With a moving support the step is wide, so that the edge passes several points.
        is_smooth = not bound.support_moves if bound.stored else is_differentiable(target)
        if is_smooth:
            narrow = _stencil_around(self.evaluator, self.k, self.theta, 1e-3, is_wide=False)
            # With several outputs a failure is coded as the largest value and causes no jump.
            is_known = ~np.isnan(narrow.values) if target.event else np.isfinite(narrow.values)
            # If points fail, the step is wide: the edge of their region passes none of them within
            # a narrow step, so that the share of failures would not change.
            if bound.stored or is_known.all():
                return narrow
        # The discrepancy is a step function of theta: its differences need a wide step.
        share = 0.05 * self.widened
        return _stencil_around(self.evaluator, self.k, self.theta, share, is_wide=True)

    @cached_property
    def data_sets(self) -> DataSets:
        """Data sets drawn from the model at theta, for all simulators."""
        return simulated_sets(self.evaluator, self.theta, self.n_sets)

    @cached_property
    def _sides(self) -> tuple[Any, Floats, Floats]:
        """Features at the stencil, and the values and weights at theta that can be observed."""
        around, target = self.stencil, self.node.target
        has_densities = [isinstance(part.target, DensityDiscrepancy) for part in target.parts]
        if around.has_equal_values and len(has_densities) > 1 and all(has_densities):
            # The basis fills its cells once for all points of the stencil.
            features = target.basis(around.values[0]).features(around.weights)
        else:
            features = target.features(around.values, around.weights, np)
        is_observable = observable(around.values[0], target)
        mass = around.weights[0][is_observable]
        return features, around.values[0][is_observable], mass / mass.sum()

    def discrepancies(
        self, observed: Floats, weights: Floats, points: slice = slice(None)
    ) -> Floats:
        """Return discrepancies at points of the stencil, (s,) or (n_sets, s)."""
        features = [feature[points] for feature in self._sides[0]]
        target = self.node.target.with_observed(observed, weights)
        n_sets = len(weights) if weights.ndim > 1 else 1
        at_once = max(1, AT_ONCE // sum(map(np.size, features)))
        if n_sets <= at_once:
            return np.atleast_1d(target.outer(*features, xp=np))
        starts = range(0, n_sets, at_once)
        return np.concatenate(
            [target.rows(slice(i, i + at_once)).outer(*features, xp=np) for i in starts]
        )

    @cached_property
    def noise_floor(self) -> float:
        """The mean discrepancy between the population at theta and data sets drawn from it.

        For a log-likelihood it is the expected gain from the truth to the maximum: half for each
        hyperparameter, over N (Wilks 1938, doi:10.1214/aoms/1177732360).
        """
        if not self.node.metric.distance:
            return self.theta.size / (2 * self.node.n_specimens)
        at_theta = self.evaluator.populations(self.theta[None], self.k)
        values, weights = thinned(*at_theta, self.node)
        observed = self.data_sets.values[self.k]
        distances = []
        for w in self.data_sets.weights[self.k]:
            is_drawn = w > 0
            target = self.node.target.with_observed(observed[is_drawn], w[is_drawn])
            distances.append(target.of(values, weights))
        return float(np.mean(distances))

    def gradients(self, observed: Floats, weights: Floats) -> Floats:
        """Return gradients at theta, (n_sets, d), for data sets of values (n,)."""
        step = self.stencil.step
        across = self.discrepancies(observed, weights[:, None], slice(1 + 2 * step.size))
        return slopes(across.T, step)

    @cached_property
    def sampling_covariance(self) -> Floats:
        """J: the covariance of the gradient over data sets of the observed size, shape (d, d)."""
        target = self.node.target
        if target.metric.exact_likelihood:
            # because the covariance of the score is the information
            return self.hessian / target.n_effective
        if not is_additive(target) or dependent([self.node]):
            sets = self.data_sets
            gradients = self.gradients(sets.values[self.k], sets.weights[self.k])
            return np.atleast_2d(np.cov(gradients, rowvar=False))
        # The discrepancy is a mean over observations, so that J is the covariance of the gradient
        # of a single specimen over N. Single specimens are drawn at equal steps of probability.
        # With several outputs half of them are drawn in proportion to the fourth power of their
        # distance from the middle, because these contribute most of the mean square of gradients.
        _, values, weights = self._sides
        order = np.argsort(flat_rows(values)[:, 0])
        n, mass = 1000, weights
        if values.ndim > 1:
            n = 2000
            far = _squared_distances(target, values, weights) ** 2
            mass = weights * (1 + far / max(float(weights @ far), _TINY))
            mass = mass / mass.sum()
        rows = order[reached(mass[order], (np.arange(n) + 0.5) / n)]
        single = values[rows]
        # Batches have 64 specimens, because the work grows with the square of their number.
        batches = [single[i : i + 64] for i in range(0, n, 64)]
        singles = [self.gradients(batch, np.eye(len(batch))) for batch in batches]
        aweights = weights[rows] / mass[rows]
        covariance = np.cov(np.concatenate(singles), rowvar=False, aweights=aweights)
        return np.atleast_2d(covariance) / target.n_effective

    @cached_property
    def hessian(self) -> Floats:
        """H: the Hessian of the discrepancy against the population at theta, shape (d, d)."""
        step = self.stencil.step
        differences = hessian_of(self.discrepancies(*self._sides[1:]), step.size)
        return differences / np.outer(step, step)

    @cached_property
    def areas_of_sets(self) -> list[LinearArea]:
        """The linear models of the areas for the data sets drawn from the model."""
        return self.areas(self.data_sets)

    def areas(self, sets: DataSets, subset: Bools | None = None) -> list[LinearArea]:
        """Return a linear model of each area that the metric is a sum of, for data sets.

        ``subset`` selects points of the population; all by default.
        """
        around = self.stencil
        observed, observed_weights = sets.values[self.k], sets.weights[self.k]
        weights = around.weights
        if subset is not None:
            weights = weights * subset
            total = weights.sum(axis=-1, keepdims=True)
            # A population without weight on these points has a distribution function of zeros.
            weights = weights / positive_scale(total)
        areas = []
        for part in self.node.target.parts:
            part_observed, rows = part.observed_of(observed)
            w = observed_weights[:, rows]
            if len(part_observed) < len(observed):
                w = w / w.sum(axis=1, keepdims=True)
            values = part.of(around.values)
            # Knots are values that occur, because distribution functions are exact there; 400
            # suffice.
            occurring = np.concatenate([values[0], part_observed])
            knots = np.unique(occurring[np.isfinite(occurring)])
            knots = knots[np.unique(np.linspace(0, knots.size - 1, 400).astype(int))]
            # Responses that are the same at all points of the stencil are sorted once.
            if around.has_equal_values:
                values = values[0]
            simulated = distribution_function(values, weights, knots, kind="quicksort")
            # Few values occur in each data set: add up these alone, between the knots.
            sets_with, occurring_in = np.nonzero(w)
            size = knots.size + 1
            cell = np.searchsorted(knots, part_observed)
            cells = cell[occurring_in] + size * sets_with
            mass = np.bincount(cells, w[sets_with, occurring_in], size * len(w))
            by_set = mass.reshape(len(w), size)
            measured = by_set[:, :-1].cumsum(axis=1)
            simulated, measured = without_rounding(simulated), without_rounding(measured)
            gaps = simulated[0] - measured
            derivatives = slopes(simulated[: 1 + 2 * around.step.size], around.step).T
            # Distribution functions are constant between knots, with the value at the left knot.
            lengths = part.share * np.diff(knots)
            n = getattr(part.target, "specimens", 0)  # a metric of the user has no correction
            levels = simulated[0, :-1]
            areas.append(LinearArea(gaps[:, :-1], derivatives[:, :-1], lengths, levels, n))
        return areas


def _squared_distances(target: Discrepancy, values: Floats, weights: Floats) -> Floats:
    """Return mean squares of the standardised projections of each specimen, (n,)."""
    squares = [np.zeros(len(values))]
    for part in single_output_parts(target):
        projection = part.of(values)
        is_finite = np.isfinite(projection)
        finite = np.where(is_finite, projection, 0.0)
        mass = np.where(is_finite, weights, 0.0)
        mass = mass / max(float(mass.sum()), _TINY)
        centered = np.where(is_finite, finite - mass @ finite, 0.0)
        variance = float(mass @ centered**2)
        squares.append(centered**2 / max(variance, _TINY))
    return np.mean(squares, axis=0)


def identified_by_area(information: Information, weakest: float = 1.0) -> Floats:
    """Return the directions that an area metric identifies, the strongest last, shape (d, r).

    Orthonormal in units of the prior's spread. A direction is not identified if ``weakest`` prior
    standard deviations along it change the area by less than half the noise floor, or if two halves
    of the points do not agree on the change, which is then the points' own error.
    """
    spread = information.prior_sd[:, None]
    sets, blocks = information.data_sets, information.stencil.blocks
    areas = information.areas_of_sets
    lengths = [area.lengths for area in areas]
    scaled = [area.slopes * spread for area in areas]
    pairs = zip(scaled, lengths, strict=True)
    gram = sum((slopes * length) @ slopes.T for slopes, length in pairs)
    _, vectors = np.linalg.eigh(gram)
    # Change of the area over one prior standard deviation along each direction.
    pairs = zip(scaled, lengths, strict=True)
    change = sum((np.abs(vectors.T @ x) * length).sum(axis=-1) for x, length in pairs)
    noise_floor = sum(area.of_sets().mean() for area in areas)
    is_identified = weakest * change > 0.5 * noise_floor
    if blocks.size >= 256:
        even, odd = (
            [vectors.T @ (area.slopes * spread) for area in information.areas(sets, half)]
            for half in (blocks % 2 == 0, blocks % 2 == 1)
        )

        def product(first: list[Floats], second: list[Floats]) -> Any:
            # Both halves of the points have the same knots, and so the same lengths.
            changes = zip(first, second, lengths, strict=True)
            return sum((a * b * length).sum(axis=-1) for a, b, length in changes)

        # Require a correlation of .35 between the changes by the two halves of the points.
        is_identified &= product(even, odd) > 0.35 * np.sqrt(
            product(even, even) * product(odd, odd)
        )
    return vectors[:, is_identified]


# -- the sampling distribution --------------------------------------------------------------------


def first_order_shifts(
    information: list[Information], scales: Floats, basis: Floats, sets: DataSets
) -> Floats:
    """Return shifts of the minimiser over data sets, to first order, along a basis.

    The features are taken as linear in theta. Smooth discrepancies then contribute their gradient
    and Hessian; areas, integrals of an absolute value, are minimised by iterated reweighting. The
    basis, (d, r), has directions in units of the prior's spread; the shifts are (n_sets, r).
    """
    directions = basis * information[0].prior_sd[:, None]
    n_sets, r = len(sets.weights[0]), basis.shape[1]
    force = np.zeros((n_sets, r))  # minus the gradients at theta
    curvature = np.zeros((r, r))
    areas = []
    for item, scale in zip(information, scales, strict=True):
        if item.node.metric.minimum is Minimum.QUADRATIC:
            gradients = item.gradients(sets.values[item.k], sets.weights[item.k])
            force -= gradients @ directions / scale
            curvature += directions.T @ item.hessian @ directions / scale
        else:
            for area in item.areas_of_sets if sets is item.data_sets else item.areas(sets):
                along, lengths = directions.T @ area.slopes, area.lengths / scale
                if not area.specimens:
                    areas.append(replace(area, slopes=along, lengths=lengths))
                    continue
                # The corrected area is smooth on average over data sets: use its mean derivatives.
                expected, density = bias_and_density(area.specimens, area.simulated)
                force -= (lengths * (np.sign(area.gaps) - expected)) @ along.T
                curvature += (lengths * density * along) @ along.T
    shifts = np.zeros_like(force)
    squares = []
    for area in areas:
        square = area.slopes[:, None] * area.slopes
        squares.append(square.reshape(r * r, -1))
    # Without area metrics the system is linear: one iteration suffices.
    for _ in range(30 if areas else 1):
        matrix = np.broadcast_to(curvature, (n_sets, r, r)).copy()
        vector = force.copy()
        for area, products in zip(areas, squares, strict=True):
            # Iterated reweighting replaces each |gap| by a parabola through its value at the
            # present shifts. Gaps below 1e-4 are rounded off, so that weights stay finite.
            gaps = area.gaps + shifts @ area.slopes
            weight = area.lengths / np.sqrt(gaps**2 + 1e-8)
            matrix += (weight @ products.T).reshape(n_sets, r, r)
            vector -= (weight * area.gaps) @ area.slopes.T
        # The ridge is relative to each direction's own size, because priors may differ in width by
        # far.
        ridge = 1e-10 * np.diagonal(matrix, axis1=1, axis2=2)[:, :, None]
        shifts = np.linalg.solve(matrix + ridge * np.eye(r), vector[..., None])[..., 0]
    return shifts


@dataclass(frozen=True, eq=False)
class Local:
    """Covariance of the minimiser at one theta, in units of the prior's spread.

    Elements and functions whose share in unidentified directions is above .02 count as not
    identified.
    """

    prior_sd: Floats  # (d,): standard deviations of the prior
    identified: Floats  # (d, r): orthonormal directions that the data identify
    unidentified: Floats  # (d, d - r): orthonormal directions that the data do not identify
    covariance: Floats  # (r, r): covariance of the minimiser along the identified directions

    @property
    def hidden_share(self) -> Floats:
        """The share of each element in directions that are not identified, (d,)."""
        return (self.unidentified**2).sum(axis=1)

    @property
    def in_theta(self) -> Floats:
        """The covariance in theta, (d, d); infinite for elements that are not fully identified."""
        unit = np.outer(self.prior_sd, self.prior_sd)
        covariance = self.identified @ self.covariance @ self.identified.T * unit
        is_hidden = self.hidden_share > 0.02
        covariance[is_hidden] = np.inf
        covariance[:, is_hidden] = np.inf
        return covariance

    def variance(self, gradients: Floats) -> Floats:
        """Return the variance of functions of theta with gradients (..., d).

        It is infinite for functions that are not fully identified. A function of unidentified
        elements may be identified, such as the standard deviation of an input whose correlation is
        not.
        """
        unit = gradients * self.prior_sd
        along = unit @ self.identified
        across = unit @ self.unidentified
        variance = np.einsum("...i,ij,...j->...", along, self.covariance, along)
        is_hidden = (across**2).sum(axis=-1) > 0.02 * (unit**2).sum(axis=-1)
        return np.where(is_hidden, np.inf, np.maximum(variance, 0))


def local_sampling(information: list[Information], scales: Floats, weakest: float = 1.0) -> Local:
    """Return the sampling distribution of the minimiser of sum of d_k / scale_k, to first order.

    Directions along which its standard error is above ``weakest``, in units of the prior's spread,
    are not identified.
    """
    if any(item.node.metric.minimum is not Minimum.QUADRATIC for item in information):
        return _area_covariance(information, scales, weakest)
    prior_sd = information[0].prior_sd
    unit = np.outer(prior_sd, prior_sd)
    pairs = list(zip(information, scales, strict=True))
    hessian = unit * sum(item.hessian / scale for item, scale in pairs)
    if dependent(information[0].evaluator.nodes):
        # Gradients of simulators that share specimens are correlated: add them for each data set.
        sets = information[0].data_sets
        gradients = sum(
            item.gradients(sets.values[item.k], sets.weights[item.k]) / scale
            for item, scale in pairs
        )
        noise = unit * np.atleast_2d(np.cov(gradients, rowvar=False))
    else:
        noise = unit * sum(item.sampling_covariance / scale**2 for item, scale in pairs)
    values, vectors, is_identified = identified_by_curvature(hessian, noise, weakest)
    identified = vectors[:, is_identified]
    inverse = identified / values[is_identified]
    covariance = inverse.T @ noise @ inverse
    return Local(prior_sd, identified, vectors[:, ~is_identified], covariance)


def _area_covariance(information: list[Information], scales: Floats, weakest: float) -> Local:
    """Return the sampling distribution with area metrics, from first-order shifts of the estimate.

    The covariance is that of the shifts over synthetic data sets.
    """
    prior_sd = information[0].prior_sd
    unit = np.outer(prior_sd, prior_sd)
    # Columns span the space that any simulator identifies. The column of zeros keeps the array from
    # being empty.
    columns = [np.zeros((prior_sd.size, 1))]
    for item in information:
        if item.node.metric.minimum is Minimum.QUADRATIC:
            noise = item.sampling_covariance * unit
            _, vectors, is_identified = identified_by_curvature(item.hessian * unit, noise, weakest)
            columns.append(vectors[:, is_identified])
        else:
            columns.append(identified_by_area(item, weakest))
    axes, strength, _ = np.linalg.svd(np.concatenate(columns, axis=1))
    # Singular values of identified directions are one or more, others are rounding errors.
    rank = int((strength > 0.1).sum())
    identified = axes[:, :rank]
    covariance = np.zeros((rank, rank))
    if rank:
        sets = information[0].data_sets
        shifts = first_order_shifts(information, scales, identified, sets)
        covariance = np.cov(shifts, rowvar=False).reshape(rank, rank)
    return Local(prior_sd, identified, axes[:, rank:], covariance)


def unidentified_directions(unidentified: Floats, names: list[str]) -> list[str]:
    """Name unidentified directions, orthonormal columns (d, q), such as 'mu[0] - 0.8 mu[1]'.

    They are rotated so that each has few elements.
    """
    labels = []
    space = unidentified
    while space.shape[1]:
        # Select the element that lies closest to the space, and project it on the space.
        projector = space @ space.T
        within = np.diag(projector)
        i = int(np.argmax(within))
        direction = projector[i] / np.sqrt(within[i])
        labels.append(named_direction(direction, names))
        complement = space - np.outer(direction, direction @ space)
        axes, strength, _ = np.linalg.svd(complement, full_matrices=False)
        # Singular values of directions in the complement are one, up to rounding.
        space = axes[:, strength > 1e-6]
    return labels


def oriented(axes: Floats) -> Floats:
    """Return axes, columns of (d, r), with signs that do not depend on rounding.

    The signs of eigenvectors are arbitrary, and draws along the axes depend on them.
    """
    direction = np.cos(np.arange(len(axes)))
    return np.where(direction @ axes < 0, -axes, axes)


def named_direction(direction: Floats, names: list[str]) -> str:
    """Name a direction by its largest elements, relative to the largest: 'mu - 0.8 sigma'."""
    ratios = direction / direction[np.argmax(np.abs(direction))]
    terms = []
    for i in np.argsort(-np.abs(ratios), kind="stable"):
        size = abs(ratios[i])
        # Leave out elements below .15, and print no factor above .95.
        if size <= 0.15:
            continue
        sign = "-" if ratios[i] < 0 else "+"
        factor = "" if size > 0.95 else f"{size:.1f} "
        terms.append(f"{sign} {factor}{names[i]}")
    return " ".join(terms).removeprefix("+ ")


def identified_by_curvature(
    hessian: Floats, noise: Floats, weakest: float = 1.0
) -> tuple[Floats, Floats, Bools]:
    """Return eigenvalues and eigenvectors of the Hessian, and which of them the data identify.

    H and J of the sandwich, (d, d), are in units of the prior's spread; ``weakest`` is an upper
    bound of the standard error of an identified direction.
    """
    values, vectors = np.linalg.eigh((hessian + hessian.T) / 2)
    noise_along = np.einsum("ik,ij,jk->k", vectors, noise, vectors)
    # Along flat directions curvature and noise are both rounding errors: require a hundredth of
    # their typical ratio.
    total = float(np.trace(hessian))
    floor = 0.01 * float(np.trace(noise)) / total if total > 0 else 0.0
    is_precise = noise_along < (weakest * values) ** 2
    return values, vectors, (values > floor) & is_precise
