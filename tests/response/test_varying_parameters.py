"""Each distribution of PyMC with a parameter that differs between specimens: right, or refused."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr
from scipy import optimize, stats

import prbayes as prb
from benchmarks.distributions import CASES
from prbayes.response.compile import PLAIN, interpreted
from prbayes.response.distributions import (
    PopulationSampler,
    compiled_log_density,
    refuse_without_density,
)
from prbayes.response.inputs import Inputs, read_inputs

N = 120  # draws for each value of the condition

Dist = Callable[[Any], Any]
EYE = np.eye(2)


def _mixture(first: Any, second: Any, **given: Any) -> Any:
    return pm.Mixture.dist([0.3, 0.7], [first, second], **given)


# Distributions of a positive number h that the table of univariate ones does not have.
OTHERS: dict[str, Dist] = {
    "AR": lambda h: pm.AR.dist([0.5], sigma=h, init_dist=pm.Normal.dist(0, 1), steps=3),
    "CAR": lambda h: pm.CAR.dist(h * np.ones(2), 1 - EYE, 0.5, 1.0),
    "Censored Weibull": lambda h: pm.Censored.dist(pm.Weibull.dist(2.0, h), None, 3.0),
    "Dirichlet": lambda h: pm.Dirichlet.dist(h * np.ones(3)),
    "DirichletMultinomial": lambda h: pm.DirichletMultinomial.dist(5, h * np.ones(3)),
    "EulerMaruyama": lambda h: pm.EulerMaruyama.dist(
        0.1, lambda x, a: (a, 1.0), (h,), init_dist=pm.Normal.dist(0, 1), steps=3
    ),
    "GARCH11": lambda h: pm.GARCH11.dist(
        omega=h, alpha_1=0.1, beta_1=0.1, initial_vol=1.0, steps=3
    ),
    "GaussianRandomWalk": lambda h: pm.GaussianRandomWalk.dist(
        mu=0.0, sigma=h, init_dist=pm.Normal.dist(0, 1), steps=3
    ),
    "KroneckerNormal": lambda h: pm.KroneckerNormal.dist(mu=h * np.ones(4), covs=[EYE, EYE]),
    "LKJCorr": lambda h: pm.LKJCorr.dist(n=2, eta=h),
    "MatrixNormal": lambda h: pm.MatrixNormal.dist(h * np.ones((2, 2)), rowcov=EYE, colcov=EYE),
    "Mixture of Weibull": lambda h: _mixture(pm.Weibull.dist(2.0, h), pm.Gamma.dist(2.0, 1.0)),
    "Mixture of vectors": lambda h: _mixture(
        pm.MvNormal.dist(h * np.ones(2), EYE), pm.MvNormal.dist(np.zeros(2), EYE)
    ),
    "Mixture, several": lambda h: _mixture(pm.Normal.dist(h, 1), pm.Normal.dist(0, 1), shape=3),
    "MvNormal": lambda h: pm.MvNormal.dist(h * np.ones(2), EYE),
    "MvNormal, covariance": lambda h: pm.MvNormal.dist(np.zeros(2), h * EYE),
    "MvStudentT": lambda h: pm.MvStudentT.dist(5, mu=np.zeros(2), scale=h * EYE),
    "Normal, several": lambda h: pm.Normal.dist(0.0, h, shape=2),
    "NormalMixture, spread": lambda h: pm.NormalMixture.dist([0.3, 0.7], [0.0, 4.0], h),
    "Truncated Weibull": lambda h: pm.Truncated.dist(pm.Weibull.dist(2.0, h), 0.5, 3.0),
    "Truncated Weibull, bound": lambda h: pm.Truncated.dist(pm.Weibull.dist(2.0, 1.0), h / 10),
    "Weibull, several": lambda h: pm.Weibull.dist(h, 2.0, shape=2),
    "Weibull, vector": lambda h: pm.Weibull.dist(2.0, h * np.array([1.0, 2.0])),
    "Wishart": lambda h: pm.Wishart.dist(5, h * EYE),
    "ZeroSumNormal": lambda h: pm.ZeroSumNormal.dist(sigma=h, shape=3),
}
ALL: dict[str, tuple[Dist, Any]] = {
    name: (dist, np.array([1.0, 4.0])) for name, dist in OTHERS.items()
}
for _name, _case in CASES.items():
    if _name not in ("Flat", "HalfFlat", "Interpolated"):  # they have no parameter that varies
        ALL[_name] = (_case.dist, np.array(_case.nearby())[[0, 2]])
# PyMC cannot make these again for several specimens.
REFUSED = ("CustomDist, of others", "GaussianRandomWalk", "LKJCorr", "LogitNormal")
# PyMC draws no value of these, or asks for a package that tests do not install.
_UNDRAWN = ("CustomDist, without draws", "PolyaGamma")
_WITHOUT_DENSITY = (
    "CustomDist, by draws alone",
    "MatrixNormal",  # for a single value only
    "Simulator",
    "Truncated, without distribution function",
)
# One for each way in which PyMC makes distributions of others. The long tests have some more of
# these, the slow ones all distributions of a single random variable.
_SHORT = (
    "AsymmetricLaplace",
    "Censored, moving bound",
    "HurdleGamma",
    "Kumaraswamy",
    "MatrixNormal",
    "Mixture of Weibull",
    "Mixture, of a share",
    "Mixture, several",
    "MvStudentT",
    "Normal",
    "Normal, several",
    "NormalMixture, spread",
    "Truncated Weibull",
    "Weibull",
    "Weibull, vector",
)
_LONG = [name for name in ALL if name in OTHERS or "," in name]
_NAMES = [
    *_SHORT,
    *(
        pytest.param(name, marks=pytest.mark.long if name in _LONG else pytest.mark.slow)
        for name in ALL
        if name not in (*REFUSED, *_SHORT)
    ),
]


def _inputs(dist: Dist, values: Any) -> Inputs:
    with pm.Model() as model:
        shift = pm.Normal("shift", 0, 1)
        x = dist(prb.response.condition("c", values) + shift)
    return read_inputs("y", (x,), model)


def _params(inputs: Inputs, values: Any) -> list[Any]:
    return [
        np.tile(values, (2, 1)) if parent.name == "c" else np.zeros(2) for parent in inputs.parents
    ]


@pytest.mark.filterwarnings(  # of PyMC
    "ignore::RuntimeWarning", "ignore::UserWarning", "ignore::FutureWarning"
)
@pytest.mark.parametrize("name", _NAMES)
def test_each_specimen_has_the_distribution_of_its_own_parameters(name: str) -> None:
    dist, values = ALL[name]
    inputs = _inputs(dist, values)
    params = _params(inputs, values)
    if name not in _UNDRAWN:
        (draws,), _ = PopulationSampler(inputs)(params, 2 * N, np.random.default_rng(3))
        expected = [pm.draw(dist(h), N, random_seed=1, mode=PLAIN) for h in values]
        for k, right in enumerate(expected):
            pairs = zip(draws[1, k::2].reshape(N, -1).T, right.reshape(N, -1).T, strict=True)
            for x, y in pairs:  # of 300 comparisons one is rejected by chance with p = .003
                assert stats.ks_2samp(x, y, method="asymp").pvalue > 1e-5
        # The specimens of both populations are independent.
        if draws.dtype.kind == "f" and len(np.unique(expected[0])) > N // 2:
            assert len(np.unique(draws[:, ::2])) > len(np.unique(draws[1, ::2]))
    if name in _WITHOUT_DENSITY:
        with pytest.raises(TypeError, match="for which PyMC has no density"):
            refuse_without_density("y", inputs)
        return
    points = np.array([0.4, 0.6]) if name in _UNDRAWN else np.stack([x[0] for x in expected])
    if name == "PolyaGamma":
        return
    (density,) = compiled_log_density(inputs)(*params, points)
    with interpreted():
        logs = [
            pm.logp(dist(pt.constant(h)), x, warn_rvs=False).eval(mode="FAST_COMPILE").sum()
            for h, x in zip(values, points, strict=True)
        ]
    np.testing.assert_allclose(density[1], logs)


@pytest.mark.parametrize("name", REFUSED)
def test_a_distribution_that_pymc_cannot_vectorise_is_refused(name: str) -> None:
    inputs = _inputs(*ALL[name])
    for refuse in (PopulationSampler, compiled_log_density):
        with pytest.raises(TypeError, match=r"differ between specimens.*compute the rest in the"):
            refuse(inputs)


def test_the_remedy_of_the_refusal_works() -> None:
    c = np.linspace(-1.0, 1.0, 40)
    x = np.random.default_rng(1).normal(0.5 + c, 0.6)
    with pm.Model() as model:
        a, s = pm.Normal("a", 0, 1), pm.HalfNormal("s", 1)
        inputs = pm.Normal.dist(a + prb.response.condition("c", c), s)
        prb.Simulator("y", lambda x: 1 / (1 + np.exp(-x)), inputs, observed=1 / (1 + np.exp(-x)))
    optimum = prb.minimize(model, starts=0, progressbar=False)
    assert optimum.point["a"] == pytest.approx((x - c).mean(), abs=0.01)
    assert optimum.point["s"] == pytest.approx((x - c).std(), rel=0.02)


@pytest.mark.long
def test_weibull_lives_at_voltages_of_their_own() -> None:
    # Insulating fluid, Nelson (1982), Applied Life Data Analysis.
    kilovolts = np.repeat([26.0, 30.0, 34.0, 38.0], [3, 11, 19, 8])
    minutes = np.loadtxt(
        io.StringIO(
            "5.79 1579.52 2323.7 7.74 17.05 20.46 21.02 22.66 43.4 47.3 139.07 144.12 175.88 194.9 "
            "0.19 0.78 0.96 1.31 2.78 3.16 4.15 4.67 4.85 6.5 7.35 8.01 8.27 12.06 31.75 32.52 "
            "33.91 36.71 72.89 0.09 0.39 0.47 0.73 0.74 1.13 1.4 2.38"
        )
    )
    c = np.log(kilovolts / 30)
    with pm.Model() as model:
        b0, b1, k = pm.Normal("b0", 4, 3), pm.Normal("b1", 15, 10), pm.Normal("k", 0, 1)
        scale = pm.math.exp(b0 - b1 * prb.response.condition("c", c))
        prb.Simulator("y", np.log, pm.Weibull.dist(pm.math.exp(k), scale), observed=np.log(minutes))
    optimum = prb.minimize(model, progressbar=False)

    def negative_log_likelihood(p: Any) -> Any:
        scales = np.exp(p[0] - p[1] * c)
        return -stats.weibull_min.logpdf(minutes, np.exp(p[2]), scale=scales).sum()

    right = optimize.minimize(negative_log_likelihood, [4.5, 18.0, -0.2], method="Nelder-Mead").x
    for name, value in zip(("b0", "b1", "k"), right, strict=True):
        assert abs(optimum.point[name] - value) < 0.02 * optimum.stderr[name]


@pytest.mark.long
def test_groups_may_differ_in_a_parameter_of_any_family() -> None:
    rng = np.random.default_rng(0)
    xs = [scale * rng.weibull(2.5, 20) for scale in (5.0, 9.0)]
    right = [np.mean(x**2.5) ** (1 / 2.5) for x in xs]
    coords = {"supplier": ["A", "B"]}
    labels = np.repeat(coords["supplier"], 20)
    data = xr.DataArray(2 * np.concatenate(xs), {"supplier": ("specimen", labels)}, "specimen")
    with pm.Model(coords=coords) as model:
        s = pm.LogNormal("s", 2, 3, dims="supplier")
        x = pm.Weibull.dist(2.5, s[prb.response.group("supplier")])
        prb.Simulator("y", lambda x: 2 * x, x, observed=data)
    optimum = prb.minimize(model, starts=0, progressbar=False)
    assert (np.abs(optimum.point["s"] - right) < 0.1 * optimum.stderr["s"]).all()
