"""Draws and densities of PyMC's distributions, with scalar and with vector parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy import stats

from benchmarks.distributions import CASES, Case
from prbayes.model.parameters import Hyperparameters, value_shapes
from prbayes.response.compile import PLAIN, interpreted
from prbayes.response.distributions import (
    PopulationSampler,
    PriorSampler,
    compiled_log_density,
    refuse_without_density,
)
from prbayes.response.inputs import read_inputs

DRAWS = 60
# PyMC draws no value of these, or asks for a package that tests do not install.
_UNDRAWN = ("CustomDist, without draws", "Flat", "HalfFlat", "PolyaGamma")
# Stacked in the cases along the axis that a vector would have.
# A truncated distribution by draws alone is refused as a vector.
_SCALAR_ONLY = (
    "Categorical",
    "Mixture, of a share",
    "NormalMixture",
    "Truncated, without distribution function",
)
# PyMC has no density, or estimates it from draws.
_WITHOUT_DENSITY = (
    "CustomDist, by draws alone",
    "Simulator",
    "Truncated, without distribution function",
)


def _dist(case: Case, h: Any) -> Any:
    dist = case.dist(h)
    return dist[-1] if isinstance(dist, tuple) else dist  # beside an input that has h


def _assert_same_distribution(draws: Any, expected: Any) -> None:
    assert draws.shape == expected.shape
    pairs = zip(draws.reshape(DRAWS, -1).T, expected.reshape(DRAWS, -1).T, strict=True)
    for x, y in pairs:
        # One of about 400 comparisons of 60 draws, by chance, with probability .004.
        assert stats.ks_2samp(x, y, method="asymp").pvalue > 1e-5


# One for each way in which PyMC draws a distribution, or has its density. The long tests have those
# that are made of others, the slow ones all distributions of a single random variable.
_SHORT = (
    "AsymmetricLaplace",
    "Bernoulli",
    "Censored",
    "CustomDist",
    "DensityDist",
    "DiracDelta",
    "HalfStudentT",
    "Interpolated",
    "Kumaraswamy",
    "Moyal",
    "Normal",
    "OrderedLogistic",
    "Poisson",
    "Simulator",
    "Truncated",
    "Weibull",
)
_PARTS = (",", "Hurdle", "ZeroInflated", "Mixture")
_NAMES = [
    *_SHORT,
    *(
        pytest.param(
            name,
            marks=pytest.mark.long if any(x in name for x in _PARTS) else pytest.mark.slow,
        )
        for name in CASES
        if name not in (*_SHORT, *_UNDRAWN)
    ),
]


@pytest.mark.filterwarnings(  # of PyMC
    "ignore::RuntimeWarning", "ignore::UserWarning", "ignore::FutureWarning"
)
@pytest.mark.parametrize("name", _NAMES)
def test_priors_and_inputs_are_those_of_pymc(name: str) -> None:
    case = CASES[name]
    low, truth, high = case.nearby()
    is_scalar = name in _SCALAR_ONLY
    h = truth if is_scalar else np.array([low, high])
    expected = pm.draw(_dist(case, h), DRAWS, random_seed=1, mode=PLAIN)
    _assert_prior(case, h, expected, has_density=name not in _WITHOUT_DENSITY)
    other = low if is_scalar else np.array([high, low])
    _assert_input(case, [other, h], expected, has_density=name not in _WITHOUT_DENSITY)


def _assert_prior(case: Case, h: Any, expected: Any, *, has_density: bool) -> None:
    with pm.Model() as model:
        variable = model.register_rv(_dist(case, h), "v")
    (draws,) = PriorSampler(model.free_RVs)(DRAWS, 2)
    _assert_same_distribution(draws, expected)
    if not has_density or not variable.dtype.startswith("float"):
        return
    hyperparameters = Hyperparameters.of(model)
    thetas = hyperparameters.thetas_of([draws[:2]])
    with interpreted():
        logp = model.compile_logp(mode="FAST_COMPILE")
    ((value, shape),) = value_shapes(hyperparameters).items()
    right = [logp({value: theta.reshape(shape)}) for theta in thetas]
    np.testing.assert_allclose(hyperparameters.log_prior(thetas), right, rtol=1e-6)


def _assert_input(case: Case, populations: Any, expected: Any, *, has_density: bool) -> None:
    h = populations[1]
    with pm.Model() as model:
        parent = pm.Normal("h", h, shape=np.shape(h))
    inputs = read_inputs("y", (pm.Normal.dist(parent), _dist(case, parent)), model)
    params = [np.stack(populations)]
    aleatory, _ = PopulationSampler(inputs)(params, DRAWS, np.random.default_rng(3))
    _assert_same_distribution(aleatory[1][1], expected)
    if not has_density:
        with pytest.raises(TypeError, match="for which PyMC has no density"):
            refuse_without_density("y", inputs)
        return
    inputs = read_inputs("y", (_dist(case, parent), pm.Normal.dist(parent)), model)
    points = [aleatory[1][1, :2], aleatory[0][1, :2]]
    (density,) = compiled_log_density(inputs)(*params, *points)
    with interpreted():
        terms = [
            pm.logp(dist, pt.constant(x))
            for dist, x in zip([_dist(case, h), pm.Normal.dist(h)], points, strict=True)
        ]
        right = sum(term.eval(mode="FAST_COMPILE").reshape(2, -1).sum(axis=1) for term in terms)
    np.testing.assert_allclose(density[1], right)


@pytest.mark.parametrize(
    ("dist", "shape"),
    [
        (lambda h: pm.HalfCauchy.dist(h), (2,)),
        (lambda h: pm.HalfStudentT.dist(3, h), (2,)),
        (lambda h: pm.HalfStudentT.dist(2 + h, 1.0), (2,)),
        (lambda h: pm.HalfCauchy.dist(h[:, None] * np.ones(3)), (2, 3)),
        (lambda h: pm.Truncated.dist(pm.HalfCauchy.dist(h), upper=5.0), (2,)),
        (lambda h: pm.LKJCorr.dist(n=2, eta=h[0]), (2, 2)),
    ],
    ids=["HalfCauchy", "HalfStudentT", "freedom", "matrix", "Truncated", "LKJCorr"],
)
def test_axes_of_parameters_are_axes_of_prior_draws(
    dist: Callable[[Any], Any], shape: tuple[int, ...]
) -> None:
    with pm.Model() as model:
        model.register_rv(dist(pt.constant([3.0, 0.5])), "v")
    (draws,) = PriorSampler(model.free_RVs)(4, 2)
    assert draws.shape == (4, *shape)
    assert (draws[0] != draws[1]).any()


def test_prior_draws_stay_possible_after_the_log_prior_is_compiled() -> None:
    # PyTensor makes a constant read-only that the compiled draws have a view of.
    with pm.Model() as model:
        pm.HalfStudentT("s", 3, [3.0, 0.5], shape=2)
    hyperparameters = Hyperparameters.of(model)
    thetas = hyperparameters.prior_thetas(3, 0)
    assert np.isfinite(hyperparameters.log_prior(thetas)).all()
    np.testing.assert_array_equal(hyperparameters.prior_thetas(3, 0), thetas)


def test_parts_of_an_input_are_drawn_for_each_specimen() -> None:
    with pm.Model() as model:
        h = pm.HalfNormal("h", 1.0)
        x = pm.Normal.dist(pm.HalfCauchy.dist(h), 1e-9)
        y = pm.HalfCauchy.dist(pm.HalfNormal.dist(h))  # PyTensor cannot draw it in batches
    rng = np.random.default_rng(0)
    (draws,), _ = PopulationSampler(read_inputs("y", (x,), model))([np.ones(1)], 200, rng)
    assert stats.kstest(draws[0], stats.halfcauchy.cdf).pvalue > 1e-4
    scales = np.array([1.0, 3.0])
    (draws,), _ = PopulationSampler(read_inputs("y", (y,), model))([scales], 400, rng)
    for of_population, scale in zip(draws, scales, strict=True):
        expected = np.abs(rng.normal(0, scale, 400) * rng.standard_cauchy(400))
        assert stats.ks_2samp(of_population, expected).pvalue > 1e-4
