"""Every distribution of PyMC as an aleatory input: right under a propagation, or refused with what to do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.propagation.base import Propagation
from prbayes.response.compilation import PLAIN

OBSERVED = np.linspace(-1, 3, 30)
METRIC = prb.AreaMetric()
SHARES = np.array([0.3, 0.7])
# Two hyperparameters: anywhere, and positive.
AT = np.array([[0.8, np.log(1.1)], [1.2, np.log(0.6)]])
PROPAGATIONS: dict[str, Propagation] = {
    "Reweighted": prb.Reweighted(2048),
    "Resimulated": prb.Resimulated(1024),
    "Fresh": prb.Fresh(4000),
}
DRAWS = 100_000

type Made = Callable[[Any, Any], Any]
CASES: dict[str, Made] = {
    "Normal": lambda m, s: pm.Normal.dist(m, s),
    "TruncatedNormal": lambda m, s: pm.TruncatedNormal.dist(m, s, lower=0),
    "SkewNormal": lambda m, s: pm.SkewNormal.dist(mu=m, sigma=s, alpha=2),
    "Moyal": lambda m, s: pm.Moyal.dist(m, s),
    "Rice": lambda m, s: pm.Rice.dist(nu=1.0, sigma=s),
    "Truncated": lambda m, s: pm.Truncated.dist(pm.Normal.dist(m, s), lower=0),
    "Censored": lambda m, s: pm.Censored.dist(pm.Normal.dist(m, s), lower=0, upper=None),
    "Censored, moving": lambda m, s: pm.Censored.dist(pm.Normal.dist(0, 1), lower=-s, upper=s),
    "Mixture": lambda m, s: pm.Mixture.dist(
        SHARES, [pm.Normal.dist(m, s), pm.Normal.dist(m + 3, s)]
    ),
    "Mixture, half": lambda m, s: pm.Mixture.dist(
        SHARES, [pm.Normal.dist(m, 1), pm.Normal.dist(5, 1)]
    ),
    "Mixture of a vector": lambda m, s: pm.NormalMixture.dist(
        w=SHARES, mu=pt.stack([m, m + 3]), sigma=s
    ),
    "HurdleGamma": lambda m, s: pm.HurdleGamma.dist(psi=0.7, alpha=2 + s, beta=1),
    "ZeroInflatedPoisson": lambda m, s: pm.ZeroInflatedPoisson.dist(psi=0.7, mu=4 * s),
    "DiscreteUniform": lambda m, s: pm.DiscreteUniform.dist(0, pt.cast(pt.ceil(5 * s), "int64")),
    "Poisson": lambda m, s: pm.Poisson.dist(4 * s),
    "Nested": lambda m, s: pm.Normal.dist(pm.Normal.dist(m, s), 1),
    "AsymmetricLaplace": lambda m, s: pm.AsymmetricLaplace.dist(kappa=1.5, mu=m, b=1 / s),
    "Beta": lambda m, s: pm.Beta.dist(1 + s, 2),
    "Cauchy": lambda m, s: pm.Cauchy.dist(m, s),
    "ChiSquared": lambda m, s: pm.ChiSquared.dist(2 + s),
    "ExGaussian": lambda m, s: pm.ExGaussian.dist(mu=m, sigma=s, nu=1),
    "Exponential": lambda m, s: pm.Exponential.dist(scale=s),
    "Gamma": lambda m, s: pm.Gamma.dist(alpha=2, beta=s),
    "Gumbel": lambda m, s: pm.Gumbel.dist(m, s),
    "HalfCauchy": lambda m, s: pm.HalfCauchy.dist(s),
    "HalfNormal": lambda m, s: pm.HalfNormal.dist(s),
    "HalfStudentT": lambda m, s: pm.HalfStudentT.dist(nu=5, sigma=s),
    "InverseGamma": lambda m, s: pm.InverseGamma.dist(alpha=5, beta=s),
    "Kumaraswamy": lambda m, s: pm.Kumaraswamy.dist(1 + s, 2),
    "Laplace": lambda m, s: pm.Laplace.dist(m, s),
    "LogNormal": lambda m, s: pm.LogNormal.dist(m, 0.3),
    "Logistic": lambda m, s: pm.Logistic.dist(m, s),
    "LogitNormal": lambda m, s: pm.LogitNormal.dist(m, s),
    "Pareto": lambda m, s: pm.Pareto.dist(alpha=3 + s, m=1),
    "PolyaGamma": lambda m, s: pm.PolyaGamma.dist(h=1, z=m),
    "SkewStudentT": lambda m, s: pm.SkewStudentT.dist(a=3, b=4, mu=m, sigma=s),
    "StudentT": lambda m, s: pm.StudentT.dist(nu=5, mu=m, sigma=s),
    "Triangular": lambda m, s: pm.Triangular.dist(lower=-1, c=0, upper=1 + s),
    "Uniform": lambda m, s: pm.Uniform.dist(0, 1 + s),
    "VonMises": lambda m, s: pm.VonMises.dist(m, 1 / s),
    "Wald": lambda m, s: pm.Wald.dist(mu=1, lam=s),
    "Weibull": lambda m, s: pm.Weibull.dist(alpha=2, beta=s),
    "Bernoulli": lambda m, s: pm.Bernoulli.dist(logit_p=m),
    "BetaBinomial": lambda m, s: pm.BetaBinomial.dist(n=5, alpha=1 + s, beta=2),
    "Binomial": lambda m, s: pm.Binomial.dist(n=5, logit_p=m),
    "Categorical": lambda m, s: pm.Categorical.dist(logit_p=pt.stack([0.0, m, 0.5])),
    "DiscreteWeibull": lambda m, s: pm.DiscreteWeibull.dist(q=0.8, beta=1 + s),
    "Geometric": lambda m, s: pm.Geometric.dist(pm.math.invlogit(m)),
    "HyperGeometric": lambda m, s: pm.HyperGeometric.dist(
        N=20, k=8, n=pt.cast(pt.ceil(5 * s), "int64")
    ),
    "NegativeBinomial": lambda m, s: pm.NegativeBinomial.dist(mu=4 * s, alpha=3),
    "OrderedLogistic": lambda m, s: pm.OrderedLogistic.dist(eta=m, cutpoints=np.array([0.0, 1.0])),
}
VECTORS: dict[str, Made] = {
    "MvNormal": lambda m, s: pm.MvNormal.dist(
        pt.stack([m, 0.0]), np.array([[1.0, 0.5], [0.5, 1.0]])
    ),
    "MvStudentT": lambda m, s: pm.MvStudentT.dist(nu=5, mu=pt.stack([m, 0.0]), scale=np.eye(2)),
    "Dirichlet": lambda m, s: pm.Dirichlet.dist(pt.stack([1 + s, 2.0])),
    "Multinomial": lambda m, s: pm.Multinomial.dist(
        n=5, p=pt.stack([pm.math.invlogit(m), 1 - pm.math.invlogit(m)])
    ),
    "Normal, a vector": lambda m, s: pm.Normal.dist(m, s, shape=2),
}
# A default run that is short: what was wrong or crashed once.
SHORT = {
    ("Censored", "Reweighted"),
    ("Censored, moving", "Reweighted"),
    ("Mixture", "Reweighted"),
    ("Mixture, half", "Fresh"),
    ("Nested", "Reweighted"),
    ("Truncated", "Fresh"),
    ("HurdleGamma", "Reweighted"),
}


def response(name: str) -> Callable[[Any], Any]:
    """Return the value of a number, the sum of the first two of a vector."""
    if name in VECTORS:
        return lambda x: x[..., 0] + 0.5 * x[..., 1]
    return lambda x: 1.0 * x


def outcome(name: str, propagation: Propagation) -> str:
    """Return "works", or by what sentence it is refused; raise if it does neither."""
    made = {**CASES, **VECTORS}[name]
    respond = response(name)
    with pm.Model() as model:
        x = made(pm.Normal("m", 1, 0.5), pm.HalfNormal("s", 1))
        keywords: dict[str, Any] = {
            "metric": METRIC,
            "observed": OBSERVED,
            "propagation": propagation,
        }
        complaint = ""
        try:
            prb.Simulator("y", respond, x, progressbar=False, **keywords)
        except TypeError as error:
            complaint = str(error)
    if complaint:
        assert complaint.startswith("y: ")
        assert "use " in complaint
        return "refused"
    evaluator = Evaluator(model)
    found = evaluator.discrepancies(AT, 0)
    supported = np.ones(len(AT), dtype=bool)
    if evaluator.designs:
        support = evaluator.support(AT)["y"]
        supported = support["weight_ess"] > 100
        assert supported.any(), support
    for (m, log_s), got in zip(AT[supported], found[supported], strict=True):
        drawn = pm.draw(made(float(m), float(np.exp(log_s))), DRAWS, random_seed=1, mode=PLAIN)
        population = respond(drawn.astype(float))
        spread = np.subtract(*np.quantile(population, [0.75, 0.25]))
        expected = METRIC(population, OBSERVED)
        # The area metric of n random values is known to about sd / sqrt(n); heavy tails, to less.
        middle = np.abs(population).mean() + spread
        assert got == pytest.approx(expected, abs=0.06 * max(middle, 0.1)), (name, m, log_s)
    return "works"


def cases() -> list[Any]:
    found = []
    for name in {**CASES, **VECTORS}:
        for kind in PROPAGATIONS:
            marks = () if (name, kind) in SHORT else pytest.mark.slow
            found.append(pytest.param(name, kind, marks=marks, id=f"{name}-{kind}"))
    return found


@pytest.mark.parametrize(("name", "kind"), cases())
def test_a_distribution_works_or_is_refused(name: str, kind: str) -> None:
    found = outcome(name, PROPAGATIONS[kind])
    assert found == REFUSED.get((name, kind), "works")


# What is refused; all else works.
REFUSED: dict[tuple[str, str], str] = {
    ("Censored, moving", "Reweighted"): "refused",
    ("Nested", "Reweighted"): "refused",
}
