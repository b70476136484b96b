"""What each of PyMC's univariate distributions gives as an aleatory input, under each propagation.

A population of each with one hyperparameter h, and as data 100 quantiles of 100 000 values that NumPy
and SciPy draw from the same distribution at the true h. A propagation works with it if

- at three values of h the area metric is that of 100 000 values drawn by NumPy and SciPy, up to five
  times the error that the propagation says it has;
- its derivative is that of differences, where it says to have one;
- the optimum is within half a standard error of the truth (of `Fresh`, whose discrepancy is noisy, it
  is not looked for);

and is refused if the model cannot be built, or the optimum not be found, and the error says what was
expected. All else is wrong, or a crash. docs/distributions.md shows the table.

    uv run python -m benchmarks.distributions [--cells "Gamma*"]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy import special, stats

import prbayes as prb
from benchmarks.study import Study
from prbayes.model.evaluator import Evaluator, compiled_objective
from prbayes.propagation.base import discrepancy_error

PROPAGATIONS = {
    "Reweighted": prb.Reweighted(256),
    "Resimulated": prb.Resimulated(512),
    "Fresh": prb.Fresh(1 << 14),
}
# Allowance for the draws of NumPy and SciPy, as a share of the mean distance from the median: five
# Monte Carlo errors of 100 000.
TOLERANCE = 0.02

# Exported by PyMC, and no univariate distributions: of vectors and matrices, processes, and what
# distributions are made of.
_OTHERS = """
AR CAR Continuous Dirichlet DirichletMultinomial Discrete Distribution EulerMaruyama GARCH11
GaussianRandomWalk ICAR KroneckerNormal LKJCholeskyCov LKJCorr MatrixNormal Multinomial
MvGaussianRandomWalk MvNormal MvStudentT MvStudentTRandomWalk OrderedMultinomial RandomWalk
StickBreakingWeights SymbolicRandomVariable Wishart WishartBartlett ZeroSumNormal
"""
OTHERS = frozenset(_OTHERS.split())

Dist = Callable[[Any], Any]
Draw = Callable[[float, np.random.Generator, int], Any]


@dataclass(frozen=True)
class Case:
    """A distribution with a hyperparameter h, and the same one by NumPy or SciPy."""

    dist: Dist
    draw: Draw
    truth: float
    of: Literal["scale", "place", "share"] = "scale"  # what h is: positive, real, or below one
    bounded: bool = False  # whether the response is x / (1 + |x|), as the mean may not exist

    def prior(self) -> Any:
        if self.of == "place":
            return pm.Normal("h", self.truth + 0.1, 0.5)
        if self.of == "share":
            return pm.Beta("h", 10 * self.truth, 10 * (1 - self.truth))
        return pm.LogNormal("h", np.log(self.truth) + 0.1, 0.3)

    def nearby(self) -> tuple[float, float, float]:
        """Return values of h at which discrepancies are compared."""
        h = self.truth
        if self.of == "place":
            return h - 0.4, h, h + 0.3
        if self.of == "share":
            return 0.7 * h, h, h + 0.3 * (1 - h)
        return 0.8 * h, h, 1.3 * h

    def response(self, *inputs: Any) -> Any:
        x = 1.0 * sum(inputs)
        return x / (1 + abs(x)) if self.bounded else x


def _normal_logp(value: Any, mu: Any) -> Any:
    return pm.logp(pm.Normal.dist(mu, 1.0), value)


def _normal_draws(mu: Any, rng: Any = None, size: Any = None) -> Any:
    return rng.normal(mu, 1.0, size=size)


def _shifted_gamma(mu: Any, size: Any) -> Any:
    return mu + pm.Gamma.dist(2.0, 1.0, size=size)


def _normal_simulator(rng: Any, mu: Any, size: Any) -> Any:
    return rng.normal(mu, 1.0, size=size)


def _polya_gamma(h: float, rng: np.random.Generator, n: int) -> Any:
    k = np.arange(1, 201) - 0.5
    total = np.zeros(n)
    for each in k:
        total += rng.gamma(h, size=n) / (each**2 + 0.25 / np.pi**2)
    # Of the terms that are left out, the mean.
    return (total + h * (1 / 200)) / (2 * np.pi**2)


def _hurdle(share: float, draw: Draw) -> Draw:
    """Return draws that are zero but for a share of them."""
    return lambda h, rng, n: np.where(rng.random(n) < share, draw(h, rng, n), 0)


def _within(draw: Draw, lower: float, upper: float) -> Draw:
    """Return draws between bounds, by rejection."""

    def inside(h: float, rng: np.random.Generator, n: int) -> Any:
        found = np.empty(0)
        while found.size < n:
            more = draw(h, rng, n)
            found = np.concatenate([found, more[(more >= lower) & (more <= upper)]])
        return found[:n]

    return inside


def _ordered(h: float, rng: np.random.Generator, n: int, noise: Callable[..., Any]) -> Any:
    return np.searchsorted([-1.0, 0.0, 1.5], h + noise(size=n))


def _numpy(method: str, *arguments: Any) -> Draw:
    """Return draws of NumPy, with h in the place of ``...``."""

    def draw(h: float, rng: np.random.Generator, n: int) -> Any:
        given = [h if each is ... else each for each in arguments]
        return getattr(rng, method)(*given, size=n)

    return draw


_NORMAL = _numpy("normal", ..., 1.0)


def _scipy(family: Any, *shape: Any, **keywords: Any) -> Draw:
    """Return draws of SciPy, with h in the place of ``...``."""

    def draw(h: float, rng: np.random.Generator, n: int) -> Any:
        given = [h if each is ... else each for each in shape]
        named = {name: h if each is ... else each for name, each in keywords.items()}
        return family.rvs(*given, **named, size=n, random_state=rng)

    return draw


def scale(dist: Dist, draw: Draw, truth: float, *, bounded: bool = False) -> Case:
    """Return a case with a positive hyperparameter."""
    return Case(dist, draw, truth, "scale", bounded)


def place(dist: Dist, draw: Draw, truth: float = 1.0, *, bounded: bool = False) -> Case:
    """Return a case with a real hyperparameter."""
    return Case(dist, draw, truth, "place", bounded)


def share(dist: Dist, draw: Draw, truth: float = 0.3) -> Case:
    """Return a case with a hyperparameter below one."""
    return Case(dist, draw, truth, "share")


CASES = {
    "AsymmetricLaplace": scale(
        lambda h: pm.AsymmetricLaplace.dist(b=h, kappa=1.5, mu=1.0),
        lambda h, rng, n: stats.laplace_asymmetric.rvs(1.5, 1.0, 1 / h, size=n, random_state=rng),
        2.0,
    ),
    "Bernoulli": share(lambda h: pm.Bernoulli.dist(p=h), lambda h, rng, n: rng.random(n) < h),
    "Beta": scale(lambda h: pm.Beta.dist(h, 3.0), _scipy(stats.beta, ..., 3.0), 2.0),
    "Beta, infinite at an edge": scale(
        lambda h: pm.Beta.dist(h, 0.5), _scipy(stats.beta, ..., 0.5), 0.6
    ),
    "BetaBinomial": scale(
        lambda h: pm.BetaBinomial.dist(h, 3.0, 12), _scipy(stats.betabinom, 12, ..., 3.0), 2.0
    ),
    "Binomial": share(lambda h: pm.Binomial.dist(12, h), _numpy("binomial", 12, ...)),
    "Categorical": share(
        lambda h: pm.Categorical.dist(p=pt.stack([h, 0.5 * (1 - h), 0.5 * (1 - h)])),
        lambda h, rng, n: rng.choice(3, n, p=[h, (1 - h) / 2, (1 - h) / 2]),
    ),
    "Cauchy": place(
        lambda h: pm.Cauchy.dist(h, 1.0), lambda h, rng, n: h + rng.standard_cauchy(n), bounded=True
    ),
    "Censored": place(
        lambda h: pm.Censored.dist(pm.Normal.dist(h, 1.0), -1.0, 2.0),
        lambda h, rng, n: np.clip(rng.normal(h, 1.0, n), -1.0, 2.0),
    ),
    "Censored, moving bound": place(
        lambda h: pm.Censored.dist(pm.Normal.dist(0.0, 1.0), None, h),
        lambda h, rng, n: np.minimum(rng.normal(0.0, 1.0, n), h),
        0.5,
    ),
    "Censored, discrete": scale(
        lambda h: pm.Censored.dist(pm.Poisson.dist(h), None, 4),
        lambda h, rng, n: np.minimum(rng.poisson(h, n), 4),
        3.0,
    ),
    "ChiSquared": scale(lambda h: pm.ChiSquared.dist(h), _scipy(stats.chi2, ...), 3.0),
    "CustomDist": place(
        lambda h: pm.CustomDist.dist(h, logp=_normal_logp, random=_normal_draws), _NORMAL
    ),
    "CustomDist, by draws alone": place(
        lambda h: pm.CustomDist.dist(h, random=_normal_draws), _NORMAL
    ),
    "CustomDist, of others": place(
        lambda h: pm.CustomDist.dist(h, dist=_shifted_gamma),
        lambda h, rng, n: h + rng.gamma(2.0, 1.0, n),
    ),
    "CustomDist, without draws": place(lambda h: pm.CustomDist.dist(h, logp=_normal_logp), _NORMAL),
    "DensityDist": place(
        lambda h: pm.DensityDist.dist(h, logp=_normal_logp, random=_normal_draws), _NORMAL
    ),
    "DiracDelta": place(lambda h: pm.DiracDelta.dist(h), lambda h, rng, n: np.full(n, h)),
    "DiscreteUniform": scale(
        lambda h: pm.DiscreteUniform.dist(0, pt.cast(pt.round(h), "int64")),
        lambda h, rng, n: rng.integers(0, np.round(h), n, endpoint=True),
        6.0,
    ),
    "DiscreteWeibull": share(
        lambda h: pm.DiscreteWeibull.dist(h, 1.2),
        lambda h, rng, n: np.ceil((np.log(rng.random(n)) / np.log(h)) ** (1 / 1.2)) - 1,
        0.7,
    ),
    "ExGaussian": place(
        lambda h: pm.ExGaussian.dist(mu=h, sigma=0.5, nu=1.0),
        lambda h, rng, n: rng.normal(h, 0.5, n) + rng.exponential(1.0, n),
    ),
    "Exponential": scale(
        lambda h: pm.Exponential.dist(h), lambda h, rng, n: rng.exponential(1 / h, n), 2.0
    ),
    "Flat": place(
        lambda h: (pm.Normal.dist(h, 1.0), pm.Flat.dist()), lambda h, rng, n: np.arange(n)
    ),
    "Gamma": scale(lambda h: pm.Gamma.dist(h, 1.5), _numpy("gamma", ..., 1 / 1.5), 2.0),
    "Gamma, infinite at an edge": scale(
        lambda h: pm.Gamma.dist(h, 1.5), _numpy("gamma", ..., 1 / 1.5), 0.4
    ),
    "Geometric": share(lambda h: pm.Geometric.dist(h), _numpy("geometric", ...)),
    "Gumbel": place(lambda h: pm.Gumbel.dist(h, 1.0), _numpy("gumbel", ..., 1.0)),
    "HalfCauchy": scale(
        lambda h: pm.HalfCauchy.dist(h),
        lambda h, rng, n: h * abs(rng.standard_cauchy(n)),
        1.5,
        bounded=True,
    ),
    "HalfFlat": place(
        lambda h: (pm.Normal.dist(h, 1.0), pm.HalfFlat.dist()), lambda h, rng, n: np.arange(n)
    ),
    "HalfNormal": scale(
        lambda h: pm.HalfNormal.dist(h), lambda h, rng, n: abs(rng.normal(0.0, h, n)), 1.5
    ),
    "HalfStudentT": scale(
        lambda h: pm.HalfStudentT.dist(5.0, h),
        lambda h, rng, n: h * abs(rng.standard_t(5.0, n)),
        1.5,
    ),
    "HurdleGamma": scale(
        lambda h: pm.HurdleGamma.dist(0.7, h, 1.5), _hurdle(0.7, _numpy("gamma", ..., 1 / 1.5)), 2.0
    ),
    "HurdleLogNormal": place(
        lambda h: pm.HurdleLogNormal.dist(0.7, h, 0.5),
        _hurdle(0.7, _numpy("lognormal", ..., 0.5)),
        0.5,
    ),
    "HurdleNegativeBinomial": scale(
        lambda h: pm.HurdleNegativeBinomial.dist(0.7, h, 3.0),
        _hurdle(
            0.7, _within(lambda h, rng, n: rng.negative_binomial(3.0, 3 / (3 + h), n), 1, np.inf)
        ),
        4.0,
    ),
    "HurdlePoisson": scale(
        lambda h: pm.HurdlePoisson.dist(0.7, h),
        _hurdle(0.7, _within(_numpy("poisson", ...), 1, np.inf)),
        4.0,
    ),
    "HyperGeometric": scale(
        lambda h: pm.HyperGeometric.dist(N=30, k=pt.cast(pt.round(h), "int64"), n=10),
        lambda h, rng, n: rng.hypergeometric(int(np.round(h)), 30 - int(np.round(h)), 10, n),
        12.0,
    ),
    # Its points are constants: beside another input.
    "Interpolated": place(
        lambda h: (
            pm.Normal.dist(h, 1.0),
            pm.Interpolated.dist(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 0.0])),
        ),
        lambda h, rng, n: rng.normal(h, 1.0, n) + rng.triangular(0.0, 1.0, 2.0, n),
    ),
    "InverseGamma": scale(
        lambda h: pm.InverseGamma.dist(4.0, h), lambda h, rng, n: h / rng.gamma(4.0, 1.0, n), 2.0
    ),
    "Kumaraswamy": scale(
        lambda h: pm.Kumaraswamy.dist(h, 3.0),
        lambda h, rng, n: (1 - rng.random(n) ** (1 / 3)) ** (1 / h),
        2.0,
    ),
    "Laplace": place(lambda h: pm.Laplace.dist(h, 1.0), _numpy("laplace", ..., 1.0)),
    "LogNormal": place(lambda h: pm.LogNormal.dist(h, 0.5), _numpy("lognormal", ..., 0.5), 0.5),
    "Lognormal": scale(lambda h: pm.Lognormal.dist(0.2, h), _numpy("lognormal", 0.2, ...), 0.5),
    "Logistic": place(lambda h: pm.Logistic.dist(h, 1.0), _numpy("logistic", ..., 1.0)),
    "LogitNormal": place(
        lambda h: pm.LogitNormal.dist(h, 1.0),
        lambda h, rng, n: special.expit(rng.normal(h, 1.0, n)),
    ),
    "Mixture": place(
        lambda h: pm.Mixture.dist([0.3, 0.7], [pm.Normal.dist(h, 1.0), pm.Gamma.dist(2.0, 1.0)]),
        lambda h, rng, n: np.where(rng.random(n) < 0.3, rng.normal(h, 1.0, n), rng.gamma(2, 1, n)),
    ),
    "Mixture, of a share": share(
        lambda h: pm.Mixture.dist(
            pt.stack([h, 1 - h]), [pm.Normal.dist(-1.0, 1.0), pm.Normal.dist(3.0, 1.0)]
        ),
        lambda h, rng, n: np.where(rng.random(n) < h, -1.0, 3.0) + rng.normal(size=n),
    ),
    "Mixture, of a moving point": place(
        lambda h: pm.Mixture.dist([0.3, 0.7], [pm.DiracDelta.dist(h), pm.Normal.dist(0.0, 1.0)]),
        lambda h, rng, n: np.where(rng.random(n) < 0.3, h, rng.normal(size=n)),
    ),
    "Mixture, discrete": scale(
        lambda h: pm.Mixture.dist([0.3, 0.7], [pm.Poisson.dist(h), pm.Poisson.dist(9.0)]),
        lambda h, rng, n: rng.poisson(np.where(rng.random(n) < 0.3, h, 9.0)),
        2.0,
    ),
    "Moyal": place(lambda h: pm.Moyal.dist(h, 1.0), _scipy(stats.moyal, ..., 1.0)),
    "NegativeBinomial": scale(
        lambda h: pm.NegativeBinomial.dist(h, 3.0),
        lambda h, rng, n: rng.negative_binomial(3.0, 3 / (3 + h), n),
        4.0,
    ),
    "Normal": place(lambda h: pm.Normal.dist(h, 1.0), _NORMAL),
    "NormalMixture": place(
        lambda h: pm.NormalMixture.dist([0.3, 0.7], pt.stack([h, 4.0]), 1.0),
        lambda h, rng, n: np.where(rng.random(n) < 0.3, h, 4.0) + rng.normal(size=n),
    ),
    "OrderedLogistic": place(
        lambda h: pm.OrderedLogistic.dist(eta=h, cutpoints=[-1.0, 0.0, 1.5], compute_p=False),
        lambda h, rng, n: _ordered(h, rng, n, rng.logistic),
        0.5,
    ),
    "OrderedProbit": place(
        lambda h: pm.OrderedProbit.dist(
            eta=h, cutpoints=[-1.0, 0.0, 1.5], sigma=1.0, compute_p=False
        ),
        lambda h, rng, n: _ordered(h, rng, n, rng.normal),
        0.5,
    ),
    "Pareto": scale(lambda h: pm.Pareto.dist(h, 1.0), lambda h, rng, n: rng.pareto(h, n) + 1, 4.0),
    "Pareto, moving threshold": scale(
        lambda h: pm.Pareto.dist(4.0, h), lambda h, rng, n: h * (rng.pareto(4.0, n) + 1), 2.0
    ),
    "Poisson": scale(lambda h: pm.Poisson.dist(h), _numpy("poisson", ...), 3.0),
    "PolyaGamma": scale(lambda h: pm.PolyaGamma.dist(h, 1.0), _polya_gamma, 2.0),
    "Rice": scale(lambda h: pm.Rice.dist(nu=h, sigma=1.0), _scipy(stats.rice, ..., 0.0, 1.0), 2.0),
    "Simulator": place(
        lambda h: pm.Simulator.dist(_normal_simulator, h, ndim_supp=0, ndims_params=[0]), _NORMAL
    ),
    "SkewNormal": place(
        lambda h: pm.SkewNormal.dist(mu=h, sigma=1.0, alpha=3.0),
        _scipy(stats.skewnorm, 3.0, ..., 1.0),
    ),
    "SkewStudentT": place(
        lambda h: pm.SkewStudentT.dist(a=4.0, b=6.0, mu=h, sigma=1.0),
        _scipy(stats.jf_skew_t, 4.0, 6.0, ..., 1.0),
    ),
    "StudentT": place(
        lambda h: pm.StudentT.dist(5.0, mu=h, sigma=1.0),
        lambda h, rng, n: h + rng.standard_t(5.0, n),
    ),
    "Triangular": share(
        lambda h: pm.Triangular.dist(lower=0.0, upper=3.0, c=3 * h),
        lambda h, rng, n: rng.triangular(0.0, 3 * h, 3.0, n),
    ),
    "Truncated": place(
        lambda h: pm.Truncated.dist(pm.Normal.dist(h, 1.0), 0.0, 2.5), _within(_NORMAL, 0.0, 2.5)
    ),
    "Truncated, discrete": scale(
        lambda h: pm.Truncated.dist(pm.Poisson.dist(h), 1, 8),
        _within(_numpy("poisson", ...), 1, 8),
        3.0,
    ),
    "Truncated, moving bound": scale(
        lambda h: pm.Truncated.dist(pm.Gamma.dist(2.0, 1.0), h, None),
        lambda h, rng, n: _within(lambda _, r, m: r.gamma(2.0, 1.0, m), h, np.inf)(h, rng, n),
        1.0,
    ),
    "Truncated, without distribution function": place(
        lambda h: pm.Truncated.dist(pm.SkewNormal.dist(mu=h, sigma=1.0, alpha=3.0), 0.0, 2.5),
        _within(_scipy(stats.skewnorm, 3.0, ..., 1.0), 0.0, 2.5),
    ),
    "TruncatedNormal": place(
        lambda h: pm.TruncatedNormal.dist(h, 1.0, lower=0.0), _within(_NORMAL, 0.0, np.inf)
    ),
    "TruncatedNormal, moving bound": place(
        lambda h: pm.TruncatedNormal.dist(1.0, 1.0, lower=h),
        lambda h, rng, n: _within(lambda _, r, m: r.normal(1.0, 1.0, m), h, np.inf)(h, rng, n),
        0.5,
    ),
    "Uniform": scale(lambda h: pm.Uniform.dist(0.0, h), _numpy("uniform", 0.0, ...), 2.0),
    "VonMises": place(lambda h: pm.VonMises.dist(h, 4.0), _numpy("vonmises", ..., 4.0), 0.5),
    "Wald": scale(lambda h: pm.Wald.dist(h, 3.0), _numpy("wald", ..., 3.0), 2.0),
    "Weibull": scale(
        lambda h: pm.Weibull.dist(h, 2.0), lambda h, rng, n: 2 * rng.weibull(h, n), 2.0
    ),
    "Weibull, infinite at an edge": scale(
        lambda h: pm.Weibull.dist(h, 2.0), lambda h, rng, n: 2 * rng.weibull(h, n), 0.6
    ),
    "ZeroInflatedBinomial": share(
        lambda h: pm.ZeroInflatedBinomial.dist(0.7, 12, h),
        _hurdle(0.7, _numpy("binomial", 12, ...)),
    ),
    "ZeroInflatedNegativeBinomial": scale(
        lambda h: pm.ZeroInflatedNegativeBinomial.dist(0.7, h, 3.0),
        _hurdle(0.7, lambda h, rng, n: rng.negative_binomial(3.0, 3 / (3 + h), n)),
        4.0,
    ),
    "ZeroInflatedPoisson": scale(
        lambda h: pm.ZeroInflatedPoisson.dist(0.7, h), _hurdle(0.7, _numpy("poisson", ...)), 4.0
    ),
}


def unknown() -> set[str]:
    """Return the distributions that PyMC exports and this table does not have."""
    known = {name.split(",")[0] for name in CASES} | OTHERS
    return set(pm.distributions.__all__) - known


def trial(case: Case, propagation: Any, *, search: bool = True) -> dict[str, Any]:
    """Return the verdict on a distribution under a propagation, and what led to it."""
    draws = case.response(case.draw(case.truth, np.random.default_rng(1), 100_000))
    observed = np.quantile(draws, (np.arange(100) + 0.5) / 100, method="inverted_cdf")
    try:
        with pm.Model() as model:
            inputs = case.dist(case.prior())
            prb.Simulator(
                "y",
                case.response,
                *(inputs if isinstance(inputs, tuple) else (inputs,)),
                metric=prb.AreaMetric(),
                observed=observed,
                propagation=propagation,
                progressbar=False,
            )
        evaluator = Evaluator.of(model)
        found = {"discrepancy": _off(case, evaluator, observed)}
        if search and not evaluator.nodes[0].bound.random:
            found["gradient"] = _off_derivative(case, evaluator)
            found |= _optimum(case, model)
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        refused = "expected" in text or "; use " in text
        return {"verdict": "refused" if refused else "crash", "why": text.splitlines()[0]}
    limits = {"discrepancy": 1.0, "gradient": 0.02, "optimum": 0.5}
    wrong = [key for key, most in limits.items() if key in found and not found[key] <= most]
    return {"verdict": "wrong" if wrong else "works", "why": ", ".join(wrong), **found}


def _theta(evaluator: Evaluator, h: float) -> Any:
    return evaluator.hyperparameters.thetas_of([np.array([h])])


def _off(case: Case, evaluator: Evaluator, observed: Any) -> float:
    """Return how far the area metric is from that of other draws, in units of what is allowed."""
    worst = 0.0
    bound = evaluator.nodes[0].bound
    for seed, h in enumerate(case.nearby()):
        draws = case.response(case.draw(h, np.random.default_rng([2, seed]), 100_000))
        expected = stats.wasserstein_distance(draws, observed)
        spread = np.mean(np.abs(draws - np.median(draws)))
        roots = evaluator.parents(_theta(evaluator, h), 0)
        (found,) = bound.discrepancies(roots, bound.target)
        allowed = 5 * discrepancy_error(bound, roots) + TOLERANCE * spread
        worst = max(worst, abs(found - expected) / max(allowed, 1e-12))
    return float(worst)


def _off_derivative(case: Case, evaluator: Evaluator) -> float:
    """Return how far a derivative is from that of differences, in units of the largest of them."""
    try:
        objective = compiled_objective(evaluator, prior=False, gradient=True)
    except (NotImplementedError, TypeError):
        return 0.0  # it says to have none
    step = 1e-4 * evaluator.hyperparameters.prior_sd[0]
    pairs = []
    below_truth, _, above_truth = case.nearby()  # at which atoms meet those of the data
    for h in (below_truth, above_truth):
        (theta,) = _theta(evaluator, h)
        _, slope = objective(theta, np.ones(1))
        above, below = (objective(theta + side * step, np.ones(1))[0] for side in (1, -1))
        pairs.append((float(slope[0]), float(above - below) / (2 * step)))
    analytic, differences = np.array(pairs).T
    return float(np.abs(analytic - differences).max() / max(np.abs(differences).max(), 1e-12))


def _optimum(case: Case, model: pm.Model) -> dict[str, float]:
    """Return how far the optimum is from the truth, in standard errors."""
    optimum = prb.minimize(model, starts=0, progressbar=False)
    off = float(abs(optimum.point["h"] - case.truth))
    return {"optimum": off / float(optimum.stderr["h"]), "converged": float(optimum.converged)}


def row(name: str, number: int) -> dict[str, Any]:
    """Return the verdicts on a distribution, by propagation."""
    return {kind: trial(CASES[name], each) for kind, each in PROPAGATIONS.items()}


STUDY = Study("distributions", __doc__, CASES, row, 1)

if __name__ == "__main__":
    STUDY.main()
