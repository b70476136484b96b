r"""Log-likelihoods of specimens in populations, from weighted points.

The log-likelihood of specimen i, whose points x have the numbers A, is

    log p(y_i | theta) = logsumexp_k(log p(x_ik | theta) + A_ik).

Normal populations of such specimens are fitted by EM.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from prbayes._stats import log_sum_exp
from prbayes._validate import IN_CACHE, Floats, Indices
from prbayes.numerics.mixtures import normalised_weights
from prbayes.numerics.threads import one_thread
from prbayes.propagation.population_density import ExponentialForm, PopulationDensity


@dataclass(frozen=True, eq=False)
class WeightedPoints:
    """Points of N specimens, with the density of populations there."""

    density: PopulationDensity
    x: Sequence[Floats]  # (N, K, *event): values of each aleatory input
    log_a: Floats  # (N, K): the numbers A
    # Form for points in the order of (K, N), so that reductions are sums of long rows.
    form: ExponentialForm | None
    # Largest log-density at an anchor for which the form is used. Log-densities are off by 1e-7
    # nats at most, which is far less than the Monte Carlo error.
    largest: ClassVar[float] = 1e8

    @classmethod
    def of(cls, density: PopulationDensity, x: Sequence[Floats], log_a: Floats) -> WeightedPoints:
        """Return the points with their form, if they have one population, and the inputs a form."""
        form = None
        if not density.inputs.nested and log_a.size:
            flat = [v.swapaxes(0, 1).reshape(log_a.size, *v.shape[2:]) for v in x]
            form = ExponentialForm.of(density.inputs.aleatory, flat)
        return cls(density, x, log_a, form)

    @cached_property
    def _flat(self) -> list[Floats]:
        """The points of all specimens one after the other, (N K, *event)."""
        return [np.ascontiguousarray(v.reshape(self.log_a.size, *v.shape[2:])) for v in self.x]

    @property
    def terms(self) -> Floats:
        """The statistics of the form, and A as one whose parameter is one, (K N, q + 1)."""
        assert self.form is not None
        base = np.where(self.form.is_inside, self.log_a.T.ravel(), -np.inf)
        # A large number replaces -inf, as a product of infinity and zero is NaN.
        return np.vstack([self.form.statistics, np.maximum(base, -1e300)]).T

    def at_anchors(self, parents: Sequence[Floats]) -> Floats:
        """Return the log-densities of populations at the anchors of the form, (S, q)."""
        assert self.form is not None
        at_each = self.density.inputs.for_points(parents, len(self.form.anchors[0]))
        with np.errstate(all="ignore"):
            (logs,) = self.density.log_density(*at_each, *self.form.anchors)
        return np.asarray(logs)

    @one_thread()
    def log_likelihoods(self, parents: Sequence[Floats]) -> Floats:
        """Return log p(y_i | theta), (S, N), of populations at parents, shapes (S, *shape).

        Covariates are those of the specimens, (S, N).
        """
        form, log_a = self.form, self.log_a
        n, count = log_a.shape
        if form is None:
            return self.by_graph(parents)
        if self.density.inputs.covariates and n > 1:
            return np.stack([log_sum_exp(logs + log_a) for logs in self.log_densities(parents)])
        natural, is_rounded = form.natural_parameters(self.at_anchors(parents), self.largest)
        parameters = np.vstack([natural.T, np.ones(len(natural))])
        result = np.empty((n, len(natural)))
        # Blocks of specimens and populations whose exponents stay in the cache of the processor.
        step = max(64, IN_CACHE // 4 // log_a.size)
        size = max(1, IN_CACHE // 4 // (step * count))
        by_specimen = self.terms.reshape(count, n, -1)
        for start in range(0, n, size):
            rows = slice(start, start + size)
            of_rows = by_specimen[:, rows].reshape(-1, by_specimen.shape[2])
            for first in range(0, len(natural), step):
                columns = slice(first, first + step)
                exponents = of_rows @ parameters[:, columns]
                by_point = exponents.reshape(count, -1, exponents.shape[1])
                result[rows, columns] = _log_sum_exp_first(by_point)
        if is_rounded.any():
            narrow = [parent[is_rounded] for parent in parents]
            result[:, is_rounded] = self.by_graph(narrow).T
        return result.T

    def log_densities(self, parents: Sequence[Floats]) -> Iterator[Floats]:
        """Yield log p(x_ik | theta), (N, K), of each population."""
        form, (n, count) = self.form, self.log_a.shape
        if form is not None:
            size = len(form.anchors[0])
            has_covariates = bool(self.density.inputs.covariates) and n > 1
            anchors = [np.concatenate([v] * (n if has_covariates else 1)) for v in form.anchors]
            with np.errstate(all="ignore"):
                at_each = self.density.inputs.for_points(parents, size)
                (at_anchors,) = self.density.log_density(*at_each, *anchors)
            natural, is_rounded = form.natural_parameters(
                at_anchors.reshape(-1, size), self.largest
            )
            natural = natural.reshape(len(parents[0]), -1, size, 1)
            is_rounded = is_rounded.reshape(len(parents[0]), -1).any(axis=1)
            statistics = np.ascontiguousarray(form.statistics.reshape(-1, count, n).T)
            is_outside = ~form.is_inside.reshape(count, n).T
        for s in range(len(parents[0])):
            if form is None or is_rounded[s]:
                of_draw = self.density.inputs.for_points([p[s : s + 1] for p in parents], count)
                with np.errstate(all="ignore"):
                    (logs,) = self.density.log_density(*of_draw, *self._flat)
                yield np.where(np.isnan(logs), -np.inf, logs).reshape(n, count)
                continue
            logs = (statistics @ natural[s])[..., 0]
            logs[is_outside] = -np.inf
            yield logs

    def by_graph(self, parents: Sequence[Floats]) -> Floats:
        """Return log-likelihoods by the compiled log-density."""
        log_a = self.log_a
        n, count = log_a.shape
        result = np.full((len(parents[0]), n), -np.inf)
        if not log_a.size:
            return result
        step = max(1, IN_CACHE // log_a.size)
        for first in range(0, len(result), step):
            block = slice(first, first + step)
            of_block = self.density.inputs.for_points([parent[block] for parent in parents], count)
            with np.errstate(all="ignore"):
                (logs,) = self.density.log_density(*of_block, *self._flat)
            logs = np.where(np.isnan(logs), -np.inf, logs)
            result[block] = log_sum_exp(logs.reshape(-1, n, count) + log_a)
        return result


@dataclass(frozen=True, eq=False)
class ProductPoints:
    """Points of the specimens of P products, each of which has a population of its own."""

    points: WeightedPoints  # points of all specimens, which have a form
    ends: Indices  # (P + 1,): specimens of product p are those from ends[p] to ends[p + 1]
    # (P, q + 1): sums of statistics and numbers A over the specimens that have one point. The
    # logarithm of a sum of one term is linear in these.
    single: Floats
    # (P, K, N, q + 1): statistics and numbers A of the other specimens, filled up by those of a
    # specimen with the likelihood one; and (P,): how many specimens of a product these are.
    several: Floats
    count: Indices

    @classmethod
    def of(cls, points: WeightedPoints, sizes: Sequence[int]) -> ProductPoints:
        """Return the points of products that have so many specimens, one after the other."""
        n, count = points.log_a.shape
        terms = points.terms.reshape(count, n, -1).swapaxes(0, 1)
        product = np.repeat(np.arange(len(sizes)), sizes)
        exists = terms[:, :, -1] > -1e299
        has_one = exists.sum(axis=1) == 1
        single = np.zeros((len(sizes), terms.shape[2]))
        np.add.at(single, product[has_one], terms[has_one][exists[has_one]])
        rest = product[~has_one]
        place = np.arange(len(rest)) - np.searchsorted(rest, rest)
        several = np.zeros((len(sizes), count, place.max(initial=-1) + 1, terms.shape[2]))
        several[:, 1:, :, -1] = -1e300
        several[rest, :, place] = terms[~has_one]
        counts = np.bincount(rest, minlength=len(sizes))
        return cls(points, np.cumsum([0, *sizes]), single, several, counts)

    @one_thread()
    def log_likelihoods(self, parents: Sequence[Floats], products: Indices) -> Floats:
        """Return log-likelihoods of the specimens of products (A,) in n populations each, (A, n).

        The parents of these populations have shapes (A n, *shape).
        """
        at_anchors, form = self.points.at_anchors(parents), self.points.form
        assert form is not None
        natural, is_invalid = form.natural_parameters(at_anchors, np.inf)
        parameters = np.hstack([natural, np.ones((len(natural), 1))])
        parameters = parameters.reshape(len(products), -1, parameters.shape[1])
        single = self.single[products]
        with np.errstate(over="ignore"):  # of populations far narrower than their distance
            result = (parameters @ single[:, :, None])[..., 0]
        k = self.several.shape[1]
        # Blocks of products and populations whose exponents stay in the cache of the processor.
        width = max(1, k * int(self.count[products].max()))
        step = max(64, IN_CACHE // 4 // width)
        size = max(1, IN_CACHE // 4 // (width * min(step, result.shape[1])))
        for start in range(0, len(products), size):
            rows = slice(start, start + size)
            n = int(self.count[products[rows]].max())
            if not n:
                continue
            terms = self.several[products[rows], :, :n].reshape(-1, k * n, parameters.shape[2])
            for first in range(0, result.shape[1], step):
                columns = slice(first, first + step)
                exponents = terms @ parameters[rows, columns].swapaxes(1, 2)
                by_point = exponents.reshape(len(terms), k, n, -1)
                logs = _log_sum_exp_first(by_point.swapaxes(0, 1))
                result[rows, columns] += logs.sum(axis=1)
        result[result < -1e299] = -np.inf
        # Rounding matters where the density is not so low that the population is impossible.
        is_rounded = np.abs(at_anchors).max(axis=1) >= self.points.largest
        is_rounded &= result.ravel() > -1e6
        is_rounded |= is_invalid
        by_product = is_rounded.reshape(result.shape)
        for row in np.flatnonzero(by_product.any(axis=1)):
            specimens = slice(*self.ends[products[row] : products[row] + 2])
            x, log_a = [v[specimens] for v in self.points.x], self.points.log_a[specimens]
            columns = by_product[row]
            narrow = [v.reshape(*result.shape, *v.shape[1:])[row, columns] for v in parents]
            points = replace(self.points, x=x, log_a=log_a)
            logs = points.by_graph(narrow)
            result[row, columns] = logs.sum(axis=1)
        return result


def _log_sum_exp_first(exponents: Floats) -> Floats:
    """Return the log of the sum of exponentials over the first axis; exponents are overwritten."""
    largest = exponents.max(axis=0)
    exponents -= largest
    # Exponentials that underflow take seven times as long.
    np.maximum(exponents, -700.0, out=exponents)
    np.exp(exponents, out=exponents)
    total = np.log(exponents.sum(axis=0)) + largest
    return np.where(largest < -1e299, -np.inf, total)


type Normal = tuple[Floats, Floats]  # mean (d,) and lower Cholesky factor (d, d)


def fit_normal(z: Floats, log_a: Floats, start: Any = None) -> Normal:
    """Fit a normal population by EM to specimens with likelihood terms exp(log p(z) + log_a).

    With a population as the start, five steps are taken.
    """
    columns = np.ascontiguousarray(z.reshape(-1, z.shape[-1]).T)
    prior = 1e-12 * np.diag(np.maximum(columns.var(axis=1), 1e-300))

    def moments(weights: Floats) -> tuple[Floats, Floats]:
        flat = weights.ravel() / len(weights)
        mean = columns @ flat
        centred = columns - mean[:, None]
        return mean, (centred * flat) @ centred.T + prior

    if start is None:
        mean, covariance = moments(normalised_weights(log_a))
    else:
        mean, covariance = start.mean, start.root @ start.root.T
    for _ in range(30 if start is None else 5):
        log_w = normal_log_density(z, mean, np.linalg.cholesky(covariance)) + log_a
        previous_mean, previous_covariance = mean, covariance
        mean, covariance = moments(normalised_weights(log_w))
        variance = np.diag(covariance)
        change = np.diag(covariance - previous_covariance) / variance
        shift = (mean - previous_mean) / np.sqrt(variance)
        if max(np.abs(change).max(), np.abs(shift).max()) < 1e-9:
            break
    return mean, np.linalg.cholesky(covariance)


def normal_log_density(z: Floats, mean: Floats, root: Floats) -> Floats:
    """Return log-densities of points (..., d) in a normal population, (...)."""
    d = z.shape[-1]
    centred = np.ascontiguousarray(z.reshape(-1, d).T) - mean[:, None]
    square = np.square(np.linalg.inv(root) @ centred).sum(axis=0)
    constant = np.log(np.diag(root)).sum() + d / 2 * np.log(2 * np.pi)
    return np.asarray(-0.5 * square - constant).reshape(z.shape[:-1])
