"""Log-likelihoods of specimens in batches of populations, without a graph of the log-density.

    log p(y_i | theta) = logsumexp_k(log p(x_ik | theta) + A_ik)

Of exponential families the exponents of all points in all populations are one product of matrices,
of sufficient statistics with A and natural parameters (`exponential_families`). Other inputs, and
populations far narrower than their points, have PyMC's log-density.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from prbayes._validate import IN_CACHE, Floats
from prbayes.numerics.log_sum_exp import log_sum_exp
from prbayes.numerics.threads import one_thread
from prbayes.propagation.exponential_families import ExponentialForm
from prbayes.response.distributions import PopulationSampler, compiled_log_density
from prbayes.response.inputs import Inputs


@dataclass(frozen=True, eq=False)
class WeightedPoints:
    """Points of N specimens, with the matrix form of log-densities there.

    Attributes
    ----------
    x : sequence of ndarray, shapes (N, K, *event)
        By aleatory input.
    log_a : ndarray, shape (N, K)
    form : ExponentialForm, optional
        At the points in the order of (K, N): reductions are then sums of long rows.
    """

    x: Sequence[Floats]
    log_a: Floats
    form: ExponentialForm | None

    @classmethod
    def of(cls, inputs: Inputs, x: Sequence[Floats], log_a: Floats) -> WeightedPoints:
        """Return the points with their form, if the inputs have one."""
        if inputs.nested or not log_a.size:
            return cls(x, log_a, None)
        flat = [v.swapaxes(0, 1).reshape(log_a.size, *v.shape[2:]) for v in x]
        return cls(x, log_a, ExponentialForm.of(inputs.aleatory, flat))


@dataclass(frozen=True, eq=False)
class PopulationDensity:
    """Populations of some inputs, as far as they are compiled: log-densities and draws.

    Attributes
    ----------
    inputs : Inputs
    """

    inputs: Inputs

    @cached_property
    def _log_density(self) -> Any:
        return compiled_log_density(self.inputs)

    @cached_property
    def sampler(self) -> PopulationSampler:
        """Draws of specimens."""
        return PopulationSampler(self.inputs)

    @one_thread()
    def log_likelihoods(self, roots: Sequence[Floats], points: WeightedPoints) -> Floats:
        """Return log p(y_i | theta), (S, N), of populations at roots, shapes (S, *shape)."""
        form, log_a = points.form, points.log_a
        n, count = log_a.shape
        if form is None:
            return self._by_graph(roots, points)
        with np.errstate(all="ignore"):
            (at_anchors,) = self._log_density(*roots, *form.anchors)
        is_rounded = form.is_rounded(at_anchors)
        natural = form.natural_parameters(np.where(is_rounded[:, None], 0.0, at_anchors))
        # A is a statistic whose parameter is one; -inf in a product may become NaN.
        base = np.where(form.is_inside, log_a.T.ravel(), -np.inf)
        terms = np.vstack([form.statistics, np.maximum(base, -1e300)]).T
        parameters = np.vstack([natural.T, np.ones(len(natural))])
        result = np.empty((n, len(natural)))
        step = max(64, IN_CACHE // 4 // log_a.size)
        rows = max(1, IN_CACHE // 4 // (step * n))
        for first in range(0, len(natural), step):
            block = parameters[:, first : first + step]
            total: Any = -np.inf
            for k in range(0, count, rows):
                exponents = terms[k * n : (k + rows) * n] @ block
                part = _log_sum_exp_first(exponents.reshape(-1, n, block.shape[1]))
                total = np.logaddexp(total, part) if k else part
            result[:, first : first + step] = total
        if is_rounded.any():
            narrow = [root[is_rounded] for root in roots]
            result[:, is_rounded] = self._by_graph(narrow, points).T
        return result.T

    def _by_graph(self, roots: Sequence[Floats], points: WeightedPoints) -> Floats:
        """Return the same by the compiled log-density."""
        log_a = points.log_a
        n, count = log_a.shape
        result = np.full((len(roots[0]), n), -np.inf)
        if not log_a.size:
            return result
        flat = [np.ascontiguousarray(v.reshape(n * count, *v.shape[2:])) for v in points.x]
        step = max(1, IN_CACHE // log_a.size)
        for first in range(0, len(result), step):
            block = slice(first, first + step)
            with np.errstate(all="ignore"):
                (logs,) = self._log_density(*(root[block] for root in roots), *flat)
            logs = np.where(np.isnan(logs), -np.inf, logs)
            result[block] = log_sum_exp(logs.reshape(-1, n, count) + log_a)
        return result


def _log_sum_exp_first(exponents: Floats) -> Floats:
    """Return the log of the sum of exponentials over the first axis; exponents are overwritten."""
    largest = exponents.max(axis=0)
    exponents -= largest
    np.exp(exponents, out=exponents)
    total = np.log(exponents.sum(axis=0)) + largest
    return np.where(largest < -1e299, -np.inf, total)
