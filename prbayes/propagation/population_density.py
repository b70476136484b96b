"""Log-likelihoods of specimens in batches of populations, without a graph of the log-density.

    log p(y_i | theta) = logsumexp_k(log p(x_ik | theta) + A_ik)

An exponential family has log p(x | theta) = eta(theta) T(x) + B(theta) + log h(x). The exponents of
all points in all populations are one product of the statistics T, with A + log h as another one,
and the natural parameters eta. Inputs of other families have their log-density compiled.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from pymc.distributions.multivariate import MvNormal
from pytensor.graph.basic import Constant
from pytensor.tensor.random import basic as random_variables
from scipy.special import betaln, gammaln

from prbayes._checks import IN_CACHE, Floats
from prbayes.numerics.log_sum_exp import log_sum_exp
from prbayes.response.compilation import compile_batched, untraced
from prbayes.response.distributions import PopulationSampler, compiled_log_density
from prbayes.response.inputs import Inputs

# Natural parameters, (q, S), and the normaliser B, (S,): NaN or infinite where one is invalid.
Natural = tuple[Sequence[Floats], Floats]


@dataclass(frozen=True, eq=False)
class FamilyTerms:
    """An exponential family at n points.

    Attributes
    ----------
    statistics : sequence of ndarray, shapes (n,)
        T(x).
    base : ndarray, shape (n,)
        log h(x); -inf outside the support.
    natural : callable
        Parameters of PyMC's distribution, shapes (S,) -> natural parameters and normaliser.
    """

    statistics: Sequence[Floats]
    base: Floats
    natural: Callable[..., Natural]


def normal_terms(x: Floats) -> FamilyTerms:
    """Return the normal family at points (n,), which are centred so that squares keep digits."""
    center, unit = x.mean(), max(float(x.std()), 1e-300)
    u = (x - center) / unit

    def natural(mu: Floats, sigma: Floats) -> Natural:
        m, precision = (mu - center) / unit, np.where(sigma > 0, unit / sigma, np.nan) ** 2
        normaliser = -0.5 * m**2 * precision - np.log(sigma) - 0.5 * np.log(2 * np.pi)
        return [m * precision, -0.5 * precision], normaliser

    return FamilyTerms([u, u**2], np.zeros(len(x)), natural)


def lognormal_terms(x: Floats) -> FamilyTerms:
    """Return the lognormal family."""
    log_x, base = _log(x)
    return FamilyTerms(*_fields(normal_terms(log_x), base - log_x))


def gamma_terms(x: Floats) -> FamilyTerms:
    """Return the gamma family."""
    log_x, base = _log(x)

    def natural(alpha: Floats, scale: Floats) -> Natural:
        normaliser = -gammaln(_positive(alpha)) - alpha * np.log(scale)
        return [alpha - 1, -1 / scale], normaliser

    return FamilyTerms([log_x, x], base, natural)


def inverse_gamma_terms(x: Floats) -> FamilyTerms:
    """Return the inverse gamma family."""
    log_x, base = _log(x)

    def natural(alpha: Floats, beta: Floats) -> Natural:
        normaliser = alpha * np.log(beta) - gammaln(_positive(alpha))
        return [-alpha - 1, -beta], normaliser

    return FamilyTerms([log_x, np.exp(-log_x)], base, natural)


def exponential_terms(x: Floats) -> FamilyTerms:
    """Return the exponential family of one parameter, the mean."""
    base = np.where(x >= 0, 0.0, -np.inf)
    return FamilyTerms([x], base, lambda scale: ([-1 / scale], -np.log(scale)))


def beta_terms(x: Floats) -> FamilyTerms:
    """Return the beta family."""
    (log_x, base), (log_rest, base_of_rest) = _log(x), _log(1 - x)

    def natural(alpha: Floats, beta: Floats) -> Natural:
        return [alpha - 1, beta - 1], -betaln(_positive(alpha), _positive(beta))

    return FamilyTerms([log_x, log_rest], base + base_of_rest, natural)


def multivariate_normal_terms(x: Floats) -> FamilyTerms:
    """Return the multivariate normal family at points (n, d)."""
    d = x.shape[1]
    center, unit = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-300)
    u = (x - center) / unit
    first, second = np.triu_indices(d)

    def natural(mu: Floats, covariance: Floats) -> Natural:
        m, scaled = (mu - center) / unit, covariance / np.outer(unit, unit)
        is_finite = np.isfinite(scaled).all(axis=(1, 2))
        values, vectors = np.linalg.eigh(np.where(is_finite[:, None, None], scaled, np.eye(d)))
        is_valid = is_finite & (values[:, 0] > 0)
        values = np.where(is_valid[:, None], values, np.nan)
        precision = (vectors / values[:, None]) @ vectors.swapaxes(1, 2)
        slope = np.einsum("sde,se->sd", precision, m)
        normaliser = -0.5 * np.einsum("sd,sd->s", m, slope) - 0.5 * np.log(values).sum(axis=1)
        normaliser -= np.log(unit).sum() + d / 2 * np.log(2 * np.pi)
        quadratic = precision * np.where(np.eye(d) > 0, -0.5, -1.0)
        return [*slope.T, *quadratic[:, first, second].T], normaliser

    return FamilyTerms([*u.T, *(u[:, first] * u[:, second]).T], np.zeros(len(x)), natural)


def _log(x: Floats) -> tuple[Floats, Floats]:
    """Return log x, and zero or -inf where x is outside the support."""
    inside = x > 0
    return np.log(np.where(inside, x, 1.0)), np.where(inside, 0.0, -np.inf)


def _positive(x: Floats) -> Floats:
    return np.where(x > 0, x, np.nan)


def _fields(terms: FamilyTerms, base: Floats) -> tuple[Any, ...]:
    return terms.statistics, terms.base + base, terms.natural


FAMILIES: dict[type, Callable[[Floats], FamilyTerms]] = {
    random_variables.NormalRV: normal_terms,
    random_variables.LogNormalRV: lognormal_terms,
    random_variables.GammaRV: gamma_terms,
    random_variables.InvGammaRV: inverse_gamma_terms,
    random_variables.ExponentialRV: exponential_terms,
    random_variables.BetaRV: beta_terms,
    type(MvNormal.rv_op): multivariate_normal_terms,
}


@dataclass(frozen=True, eq=False)
class PopulationDensity:
    """Populations of some inputs, as far as they are compiled: log-densities and draws.

    Attributes
    ----------
    inputs : Inputs
    """

    inputs: Inputs

    @cached_property
    def _families(self) -> list[Callable[[Floats], FamilyTerms]] | None:
        """The families of the aleatory inputs, None if one is not an exponential family."""
        families = [FAMILIES.get(type(x.owner.op)) for x in self.inputs.aleatory]
        if self.inputs.nested or any(family is None for family in families):
            return None
        return [family for family in families if family is not None]

    @cached_property
    @untraced()
    def _parameters(self) -> Callable[..., list[Floats]]:
        """Function of roots, (S, *shape), that returns all parameters of all inputs."""
        symbols = self.inputs.placeholders()
        dists, _ = self.inputs.rebuilt(symbols)
        graphs = [p for dist in dists for p in dist.owner.op.dist_params(dist.owner)]
        if all(p in symbols or isinstance(p, Constant) for p in graphs):
            # Nothing to compute.
            return lambda *roots: [
                roots[symbols.index(p)] if p in symbols else p.data[None] for p in graphs
            ]
        function = compile_batched(symbols, graphs)

        def evaluate(*roots: Floats) -> list[Floats]:
            values = zip(function(*roots), graphs, strict=True)
            return [v if v.ndim > graph.type.ndim else v[None] for v, graph in values]

        return evaluate

    @cached_property
    def _log_density(self) -> Any:
        return compiled_log_density(self.inputs)

    @cached_property
    def sampler(self) -> PopulationSampler:
        """Draws of specimens."""
        return PopulationSampler(self.inputs)

    def log_likelihoods(
        self, roots: Sequence[Floats], x: Sequence[Floats], log_a: Floats
    ) -> Floats:
        """Return log p(y_i | theta), (S, N).

        Parameters
        ----------
        roots : sequence of ndarray, shapes (S, *shape)
        x : sequence of ndarray, shapes (N, K, *event)
            Points, by aleatory input.
        log_a : ndarray, shape (N, K)
        """
        n, count = log_a.shape
        if not log_a.size:
            return np.full((len(roots[0]), n), -np.inf)
        if self._families is None:
            return self._by_graph(roots, x, log_a)
        # The points of a specimen as the first axis: reductions are then sums of long rows.
        flat = [v.swapaxes(0, 1).reshape(n * count, *v.shape[2:]) for v in x]
        with np.errstate(all="ignore"):
            terms, eta = self._terms(roots, flat, log_a.T.ravel())
            is_valid = np.isfinite(eta).all(axis=0)
            result = np.empty((n, len(is_valid)))
            step = max(16, IN_CACHE // 4 // len(terms))
            for first in range(0, len(is_valid), step):
                some = slice(first, first + step)
                exponents = terms @ np.where(is_valid[some], eta[:, some], 0.0)
                _log_sum_exp_first(exponents.reshape(count, n, -1), result[:, some])
        result[:, ~is_valid] = -np.inf
        return result.T

    def _by_graph(self, roots: Sequence[Floats], x: Sequence[Floats], log_a: Floats) -> Floats:
        """Return the same by the compiled log-density."""
        n, count = log_a.shape
        flat = [np.ascontiguousarray(v.reshape(n * count, *v.shape[2:])) for v in x]
        result = np.empty((len(roots[0]), n))
        step = max(1, IN_CACHE // log_a.size)
        for first in range(0, len(result), step):
            some = slice(first, first + step)
            with np.errstate(all="ignore"):
                (logs,) = self._log_density(*(root[some] for root in roots), *flat)
            logs = np.where(np.isnan(logs), -np.inf, logs)
            result[some] = log_sum_exp(logs.reshape(-1, n, count) + log_a)
        return result

    def _terms(
        self, roots: Sequence[Floats], flat: Sequence[Floats], log_a: Floats
    ) -> tuple[Floats, Floats]:
        """Return statistics of the points, (n, q), and natural parameters, (q, S).

        With them A and the base measure, whose parameter is one, and a one, whose parameter is the
        normaliser.
        """
        size = len(roots[0])
        parameters = iter(np.asarray(p, dtype=float) for p in self._parameters(*roots))
        statistics: list[Floats] = []
        natural: list[Floats] = []
        base, normaliser = log_a, np.zeros(size)
        assert self._families is not None
        for dist, family, x in zip(self.inputs.aleatory, self._families, flat, strict=True):
            params = [next(parameters) for _ in dist.owner.op.dist_params(dist.owner)]
            elements: list[tuple[Floats, list[Floats]]] = [(x, params)]
            if family is not multivariate_normal_terms and x.ndim > 1:
                # A vector of independent inputs.
                params = [np.broadcast_to(p, (len(p), *x.shape[1:])) for p in params]
                columns = [p.reshape(len(p), -1).T for p in params]
                by_element = zip(x.reshape(len(x), -1).T, *columns, strict=True)
                elements = [(element, of_element) for element, *of_element in by_element]
            for element, of_element in elements:
                terms = family(element)
                eta, of_normaliser = terms.natural(*of_element)
                statistics += terms.statistics
                natural += [np.broadcast_to(parameter, size) for parameter in eta]
                base = base + terms.base
                normaliser = normaliser + of_normaliser
        base = np.maximum(base, _NOTHING)
        ones = np.ones(len(base)), np.ones(size)
        return (
            np.stack([*statistics, base, ones[0]], axis=1),
            np.stack([*natural, ones[1], normaliser]),
        )


# Logarithm of no density in a product, where -inf times zero is NaN.
_NOTHING = -1e300


def _log_sum_exp_first(exponents: Floats, out: Floats) -> None:
    """Put the log of the sum of exponentials over the first axis into ``out``."""
    largest = exponents.max(axis=0)
    exponents -= largest
    np.exp(exponents, out=exponents)
    np.log(exponents.sum(axis=0), out=out)
    out += largest
    out[largest < _NOTHING / 2] = -np.inf
