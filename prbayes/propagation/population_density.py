"""Log-likelihoods of specimens in batches of populations, without a graph of the log-density.

    log p(y_i | theta) = logsumexp_k(log p(x_ik | theta) + A_ik)

An exponential family has log p(x | theta) = eta(theta) T(x) + B(theta) + log h(x). The exponents of
all points in all populations are one product of the statistics T, with A + log h as another one,
and the natural parameters eta. Inputs of other families have their log-density compiled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pymc as pm
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
    center = x.mean()
    unit = max(float(x.std()), 1e-300)
    u = (x - center) / unit

    def natural(mu: Floats, sigma: Floats) -> Natural:
        m = (mu - center) / unit
        precision = np.where(sigma > 0, unit / sigma, np.nan) ** 2
        slope = m * precision
        normaliser = -0.5 * m * slope - np.log(sigma) - 0.5 * np.log(2 * np.pi)
        return [slope, -0.5 * precision], normaliser

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
    center = x.mean(axis=0)
    unit = np.maximum(x.std(axis=0), 1e-300)
    u = (x - center) / unit
    first, second = np.triu_indices(d)
    products = u[:, first] * u[:, second]
    factors = np.where(first == second, -0.5, -1.0)

    def natural(mu: Floats, covariance: Floats) -> Natural:
        m = (mu - center) / unit
        scaled = covariance / np.outer(unit, unit)
        is_finite = np.isfinite(scaled).all(axis=(1, 2))
        values, vectors = np.linalg.eigh(np.where(is_finite[:, None, None], scaled, np.eye(d)))
        is_valid = is_finite & (values[:, 0] > 0)
        values = np.where(is_valid[:, None], values, np.nan)
        precision = (vectors / values[:, None]) @ vectors.swapaxes(1, 2)
        slope = np.einsum("sde,se->sd", precision, m)
        square = np.einsum("sd,sd->s", m, slope)
        log_det = np.log(values).sum(axis=1)
        constant = np.log(unit).sum() + d / 2 * np.log(2 * np.pi)
        quadratic = factors * precision[:, first, second]
        return [*slope.T, *quadratic.T], -0.5 * (square + log_det) - constant

    return FamilyTerms([*u.T, *products.T], np.zeros(len(x)), natural)


def _log(x: Floats) -> tuple[Floats, Floats]:
    """Return log x, and zero or -inf where x is outside the support."""
    inside = x > 0
    return np.log(np.where(inside, x, 1.0)), np.where(inside, 0.0, -np.inf)


def _positive(x: Floats) -> Floats:
    return np.where(x > 0, x, np.nan)


def _fields(terms: FamilyTerms, base: Floats) -> tuple[Any, ...]:
    return terms.statistics, terms.base + base, terms.natural


FAMILIES: dict[type, Callable[[Floats], FamilyTerms]] = {
    type(pm.Normal.rv_op): normal_terms,
    type(pm.LogNormal.rv_op): lognormal_terms,
    type(pm.Gamma.rv_op): gamma_terms,
    type(pm.InverseGamma.rv_op): inverse_gamma_terms,
    type(pm.Exponential.rv_op): exponential_terms,
    type(pm.Beta.rv_op): beta_terms,
    type(pm.MvNormal.rv_op): multivariate_normal_terms,
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
        ops = [type(x.owner.op) for x in self.inputs.aleatory]
        if self.inputs.nested or not FAMILIES.keys() >= set(ops):
            return None
        return [FAMILIES[op] for op in ops]

    @cached_property
    @untraced()
    def _parameters(self) -> Callable[..., list[Floats]]:
        """Function of roots, (S, *shape), that returns all parameters of all inputs."""
        symbols = self.inputs.placeholders()
        dists, _ = self.inputs.rebuilt(symbols)
        graphs: list[Any] = []
        for dist in dists:
            graphs += dist.owner.op.dist_params(dist.owner)
        computed = [graph for graph in graphs if graph not in symbols]
        # Without a computation the parameters are the roots.
        function = compile_batched(symbols, computed) if computed else None

        def evaluate(*roots: Floats) -> list[Floats]:
            results = iter(function(*roots)) if function else iter(())
            given = dict(zip(symbols, roots, strict=True))
            values = []
            for graph in graphs:
                value = given[graph] if graph in given else next(results)
                # What does not depend on a root comes without a leading axis.
                value = value if value.ndim > graph.type.ndim else value[None]
                values.append(np.asarray(value, dtype=float))
            return values

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
            statistics, natural = self._terms(roots, flat, log_a.T.ravel())
            is_valid = np.isfinite(natural).all(axis=0)
            natural = np.where(is_valid, natural, 0.0)
            size = len(is_valid)
            result = np.empty((n, size))
            step = max(16, IN_CACHE // 4 // log_a.size)
            for first in range(0, size, step):
                some = slice(first, first + step)
                exponents = statistics @ natural[:, some]
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
        parameters = iter(self._parameters(*roots))
        statistics: list[Floats] = []
        natural: list[Floats] = []
        base, normaliser = log_a, np.zeros(size)
        for dist, family, x in zip(self.inputs.aleatory, self._families or (), flat, strict=True):
            params = [next(parameters) for _ in dist.owner.op.dist_params(dist.owner)]
            is_joint = family is multivariate_normal_terms
            for element, of_element in [(x, params)] if is_joint else _elements(x, params):
                terms = family(element)
                eta, of_normaliser = terms.natural(*of_element)
                statistics += terms.statistics
                natural += [np.broadcast_to(parameter, size) for parameter in eta]
                base = base + terms.base
                normaliser = normaliser + of_normaliser
        # -inf times zero is NaN.
        statistics += [np.maximum(base, -1e300), np.ones(len(base))]
        natural += [np.ones(size), normaliser]
        return np.stack(statistics, axis=1), np.stack(natural)


def _elements(x: Floats, params: Sequence[Floats]) -> Iterator[tuple[Floats, list[Floats]]]:
    """Return points, (n,), and parameters, (S,), of the elements of independent inputs."""
    if x.ndim == 1:
        yield x, list(params)
        return
    event = x.shape[1:]
    for place in np.ndindex(*event):
        values = [np.broadcast_to(p, (len(p), *event))[:, *place] for p in params]
        yield x[:, *place], values


def _log_sum_exp_first(exponents: Floats, out: Floats) -> None:
    """Put the log of the sum of exponentials over the first axis into ``out``."""
    largest = exponents.max(axis=0)
    exponents -= largest
    np.exp(exponents, out=exponents)
    np.log(exponents.sum(axis=0), out=out)
    out += largest
    out[largest < -1e299] = -np.inf
