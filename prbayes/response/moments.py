"""Moments, quantiles and correlations of one input in each of many populations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy.special import ndtr

from prbayes._validate import AT_ONCE, Arrays, Floats, finite_or_nan
from prbayes.response.compile import PLAIN, compile_batched, interpreted
from prbayes.response.condition import is_condition
from prbayes.response.distributions import MVNORMAL, PopulationSampler, quantiles
from prbayes.response.inputs import Inputs


class InputMoments:
    """Moments and quantiles of the elements of one input as functions of its parents."""

    def __init__(self, label: str, inputs: Inputs, levels: Sequence[float]) -> None:
        self.inputs = inputs
        self.levels = np.array(levels)
        # Nodes of the trapezoidal rule for moments, in normal scores, which is exact enough for
        # smooth inverse distribution functions.
        self.z = np.linspace(-8.0, 8.0, 97)
        self.n_drawn = 2000  # draws if a population has no inverse distribution function
        (self.shape,) = inputs.event_shapes
        self.size = math.prod(self.shape)
        op = inputs.aleatory[0].owner.op
        self.is_multivariate = len(self.shape) == 1 == getattr(op, "ndim_supp", 0)
        self._inverse: Any = None
        self._sampler: PopulationSampler | None = None
        try:
            self._inverse = self._compiled(label)
        except TypeError:
            self._sampler = PopulationSampler(inputs) if inputs.parents else None

    def _compiled(self, label: str) -> Any:
        """Return a compiled inverse distribution function; raise TypeError if there is none."""
        u = pt.dvector("u")
        symbols = [pt.dscalar() if is_condition(r) else r.type() for r in self.inputs.parents]
        if self.inputs.nested:
            raise TypeError("no inverse of a conditional distribution")
        (dist,), _ = self.inputs.rebuilt(symbols)
        outputs = []
        if isinstance(dist.owner.op, MVNORMAL):
            mean, covariance = dist.owner.op.dist_params(dist.owner)
            sd = pt.sqrt(pt.diagonal(covariance, axis1=-2, axis2=-1))
            outputs = [mean + sd * pm.icdf(pm.Normal.dist(), u)[:, None], covariance]
        else:
            columns = pt.shape_padright(u, dist.type.ndim) * np.ones(self.shape)
            outputs = [quantiles(label, dist, columns)]
        return compile_batched(symbols, outputs, extra=[u])

    def numbers(self, parents: Arrays) -> Floats:
        """Return mean, sd, quantiles, and correlations with earlier elements, (k, q, elements)."""
        k = len(parents[0]) if parents else 1
        n = self.n_drawn if self._inverse is None else self.z.size + self.levels.size
        step = max(1, AT_ONCE // (n * self.size))
        parts = []
        for first in range(0, k, step):
            chunk = [p[first : first + step] for p in parents]
            parts.append(self._drawn(chunk) if self._inverse is None else self._exact(chunk))
        return np.concatenate(parts)

    def _exact(self, parents: Arrays) -> Floats:
        """Return the numbers from inverse distribution functions."""
        values = [
            p[:, 0] if is_condition(r) else p
            for r, p in zip(self.inputs.parents, parents, strict=True)
        ]
        k = len(parents[0]) if parents else 1
        placed, *covariance = self._inverse(*values, np.concatenate([ndtr(self.z), self.levels]))
        n = self.z.size + self.levels.size
        x = np.broadcast_to(placed, (k, n, *self.shape)).reshape(k, n, self.size)
        nodes = x[:, : self.z.size]
        levels = x[:, self.z.size :]
        weights = np.exp(-0.5 * self.z**2)
        weights /= weights.sum()
        with np.errstate(invalid="ignore", over="ignore"):
            mean = np.tensordot(nodes, weights, (1, 0))
            deviation = np.abs(nodes - mean[:, None])
            moments = []
            for power, moment in ((1, mean), (2, None)):
                terms = weights[:, None] * deviation**power
                total = terms.sum(axis=1)
                # A moment is infinite if the ends of the range contribute much of the sum.
                beyond = terms[:, np.abs(self.z) > 7].sum(axis=1)
                exists = beyond <= 0.01 * total
                moments.append(
                    np.where(exists, np.sqrt(total) if moment is None else moment, np.nan)
                )
        correlation = None
        if covariance and self.is_multivariate:
            c = np.broadcast_to(covariance[0], (k, self.size, self.size))
            scale = np.sqrt(np.diagonal(c, axis1=1, axis2=2))
            correlation = c / (scale[:, :, None] * scale[:, None])
        return self._stacked(moments, levels, correlation)

    def _drawn(self, parents: Arrays) -> Floats:
        """Return the numbers estimated from random draws."""
        (dist,) = self.inputs.aleatory
        if self._sampler is None:
            with interpreted():
                draws = pm.draw(dist, draws=self.n_drawn, random_seed=0, mode=PLAIN)
        else:
            (draws,), _ = self._sampler(parents, self.n_drawn, np.random.default_rng(0))
        x = np.reshape(draws, (-1, self.n_drawn, self.size))
        is_discrete = not dist.dtype.startswith("float")
        method: Any = "inverted_cdf" if is_discrete else "linear"
        levels = np.moveaxis(np.quantile(x, self.levels, axis=1, method=method), 0, 1)
        mean = x.mean(axis=1)
        sd = x.std(axis=1)
        correlation = None
        if self.is_multivariate:
            z = (x - mean[:, None]) / sd[:, None]
            correlation = np.swapaxes(z, 1, 2) @ z / self.n_drawn
        return self._stacked([mean, sd], levels, correlation)

    def _stacked(self, moments: Arrays, levels: Floats, correlation: Floats | None) -> Floats:
        """Return all numbers, (k, q, elements); NaN for populations that do not exist."""
        numbers = np.concatenate([np.stack(moments, axis=1), levels], axis=1)
        if correlation is not None:
            below = np.tril(np.ones(correlation.shape[1:], dtype=bool), -1)
            rows = np.where(below, correlation, np.nan)  # a column for each earlier element
            numbers = np.concatenate([numbers, np.swapaxes(rows, 1, 2)[:, :-1]], axis=1)
        return finite_or_nan(numbers)
