"""Draws of the hyperparameters given points of the specimens, against closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input
from scipy.stats import halfnorm, norm, truncnorm

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.model.specimen_preparation import SpecimenPopulations, prepared, secants

N, SD, PRIOR_SD = 12, 0.5, 2.0
X = np.random.default_rng(4).normal(1.0, SD, N)


def populations_of(model: pm.Model) -> SpecimenPopulations:
    (likelihood,) = specimen_likelihoods(model).values()
    return SpecimenPopulations(likelihood)


def normal_model(scale: float = 1.0) -> pm.Model:
    """Return a model of one normal input with a known standard deviation."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, PRIOR_SD * scale)
        x = pm.Normal.dist(mu, SD * scale)
        prb.Simulator("y", lambda x: x / scale, x, observed=X)
    return model


def points_at(populations: SpecimenPopulations, x: Floats) -> tuple[Floats, Floats]:
    """Return one point for each specimen, at its inputs, with the number of the density of x."""
    z = populations.likelihood.coordinates.of([x], 1)[:, None]
    return z, -populations.likelihood.coordinates.log_jacobian(z)


@pytest.mark.parametrize("scale", [1.0, 1e6])
def test_moments_are_those_of_the_posterior(scale: float) -> None:
    model = normal_model(scale)
    populations = populations_of(model)
    z, log_a = points_at(populations, scale * X)
    draws = populations.posterior(z, log_a)
    precision = N / SD**2 + 1 / PRIOR_SD**2
    mean, sd = X.sum() / SD**2 / precision, precision**-0.5
    thetas = draws.thetas[:, 0] / scale
    assert len(thetas) == 256
    assert thetas.mean() == pytest.approx(mean, abs=5 * sd / np.sqrt(256))
    assert thetas.std() == pytest.approx(sd, abs=5 * sd / np.sqrt(512))
    (x,) = populations.likelihood.coordinates.inputs(draws.specimens())
    assert x.shape == (256 * 16,)
    assert x.mean() / scale == pytest.approx(mean, abs=5 * sd / 16)
    assert x.std() / scale == pytest.approx(np.hypot(SD, sd), rel=5 / np.sqrt(2 * 256))
    again, other = (populations.posterior(z, log_a, seed=seed) for seed in (0, 1))
    np.testing.assert_array_equal(again.thetas, draws.thetas)
    assert not np.array_equal(other.thetas, draws.thetas)


@pytest.mark.parametrize(("rate", "codes"), [(3.0, ["second-mode"]), (0.3, [])])
def test_readings_with_several_roots_in_the_priors_centre_are_reported(
    rate: float, codes: list[str]
) -> None:
    model = one_input(np.sin(rate * 0.2 * X[:6]), response=lambda x: np.sin(rate * x))
    (likelihood,) = specimen_likelihoods(model).values()
    assert [finding.code for finding in prepared(likelihood).findings] == codes


def test_inaccurate_readings_inside_a_fold_have_two_roots() -> None:
    rng = np.random.default_rng(38)
    y = rng.normal(0.5, 0.5, 24) ** 2 + rng.normal(0, 0.05, 24)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.HalfNormal("mu", 2), pm.HalfNormal("sigma", 2))
        metric = prb.LogLikelihood(error=0.05)
        prb.Simulator("y", np.square, x, observed=y, metric=metric)
    (likelihood,) = specimen_likelihoods(model).values()
    assert not prepared(likelihood).findings


def test_a_gross_error_near_an_end_is_not_reported() -> None:
    rng = np.random.default_rng(37)
    x = rng.normal([2.0, 1.0], [0.3, 0.2], (20, 2))
    y = np.stack([x.prod(axis=1), x[:, 0] / x[:, 1]], axis=-1)
    y[[2, 11], 0] = [0.2, 6.0]
    with pm.Model() as model:
        mu, sd = pm.Normal("mu", 0.5, 1.0, shape=2), pm.HalfNormal("sd", 0.5, shape=2)
        a, b = (pm.LogNormal.dist(mu[k], sd[k]) for k in range(2))
        metric = prb.LogLikelihood(gross_errors=True)
        prb.Simulator(
            "y", lambda a, b: np.stack([a * b, a / b], axis=-1), a, b, observed=y, metric=metric
        )
    (likelihood,) = specimen_likelihoods(model).values()
    assert not prepared(likelihood).findings


def test_smoothing_widens_populations() -> None:
    model = normal_model()
    populations = populations_of(model)
    z, log_a = points_at(populations, X)
    unit = populations.likelihood.coordinates.half_width[0]
    smoothing = np.array([[(0.7 / unit) ** 2]])
    thetas = np.array([[0.0], [1.5]])
    smoothed = populations.log_likelihoods(thetas, z, log_a, smoothing)
    # Moments of 256 specimens: their standard errors shift log L by about .1.
    jacobian = populations.likelihood.coordinates.log_jacobian(z)[:, 0]
    expected = norm.logpdf(X, thetas, np.hypot(SD, 0.7)) - jacobian
    spread = np.abs(X - thetas) / (SD**2 + 0.7**2) * SD / np.sqrt(256) + 0.05
    assert (np.abs(smoothed - expected - jacobian) < 5 * spread).all()
    draws = populations.posterior(z, log_a, smoothing)
    precision = N / (SD**2 + 0.7**2) + 1 / PRIOR_SD**2
    assert draws.thetas.std() == pytest.approx(precision**-0.5, rel=0.25)


def test_populations_of_infinite_size_are_impossible_without_a_warning() -> None:
    with pm.Model() as model:
        x = pm.LogNormal.dist(pm.Normal("mu", 0, 1), 1.0)
        prb.Simulator("y", np.positive, x, observed=np.exp(X))
    populations = populations_of(model)
    z, log_a = points_at(populations, np.exp(X))
    thetas = np.array([[0.5], [1e4]])
    logs = populations.log_likelihoods(thetas, z, log_a, np.array([[0.1]])).sum(axis=1)
    np.testing.assert_array_equal(np.isfinite(logs), [True, False])


def test_groups_have_populations_of_their_own() -> None:
    groups = np.arange(N) % 2
    data = xr.DataArray(
        X + 3 * groups, {"kind": ("specimen", np.array(["a", "b"])[groups])}, "specimen"
    )
    with pm.Model(coords={"kind": ["a", "b"]}) as model:
        mu = pm.Normal("mu", 0, PRIOR_SD, dims="kind")
        x = pm.Normal.dist(mu[prb.response.group("kind")], SD)
        prb.Simulator("y", lambda x: x, x, observed=data)
    populations = populations_of(model)
    z, log_a = points_at(populations, X + 3 * groups)
    thetas = np.array([[0.0, 2.0], [1.0, 4.0]])
    expected = norm.logpdf(X + 3 * groups, thetas[:, groups], SD)
    np.testing.assert_allclose(populations.log_likelihoods(thetas, z, log_a), expected)
    draws = populations.posterior(z, log_a)
    precision = N / 2 / SD**2 + 1 / PRIOR_SD**2
    for group in (0, 1):
        mean = (X + 3 * groups)[groups == group].sum() / SD**2 / precision
        error = 5 * precision**-0.5 / 16
        assert draws.thetas[:, group].mean() == pytest.approx(mean, abs=error)
    specimens = draws.specimens(4)
    assert len(specimens) == 2 * 256 * 4
    (x,) = populations.likelihood.coordinates.inputs(specimens)
    assert x[: len(x) // 2].mean() == pytest.approx(draws.thetas[:, 0].mean(), abs=0.1)
    assert x[len(x) // 2 :].mean() == pytest.approx(draws.thetas[:, 1].mean(), abs=0.1)


def test_specimens_that_no_population_reaches() -> None:
    with pm.Model() as model:
        end = pm.Uniform("end", 1, 2)
        prb.Simulator("y", lambda x: x, pm.Uniform.dist(0, end), observed=X)
    populations = populations_of(model)
    with pytest.raises(
        ValueError, match="no population of the prior that reaches the inputs of specimen"
    ):
        populations.posterior(*points_at(populations, X + 10))


def test_a_response_whose_squares_overflow_under_a_vague_prior_is_right_or_refused() -> None:
    """Which of both depends on the last digits of the processor."""
    y = np.random.default_rng(52).lognormal(1.0, 0.7, 40)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 100.0), pm.HalfNormal("sigma", 10.0)
        prb.Simulator("y", np.exp, pm.Normal.dist(mu, sigma), observed=y)
        try:
            point = prb.minimize(progressbar=False).point
        except prb.propagation.DesignError:
            return
    logs = np.log(y)
    assert point["mu"] == pytest.approx(logs.mean(), abs=0.01 * logs.std())
    assert point["sigma"] == pytest.approx(logs.std(), rel=0.01)


def test_slopes_to_an_end_beside_a_turning_point() -> None:
    """A difference over both sides of the turning point would be zero."""
    z = np.array([[0.0], [1.0], [-0.1]])
    distance = np.full((3, 1), 0.4)
    slopes = secants(np.square, np.square(z), z, distance, [0])
    np.testing.assert_allclose(slopes[:, 0, 0], [-0.2, 2.2, -0.4])
    missing = secants(lambda z: np.where(z < 0, np.nan, z), z, z, distance, [0])
    np.testing.assert_allclose(missing[:2, 0, 0], [1.0, 1.0])


def test_a_model_that_is_gone() -> None:
    model: Any = normal_model()
    populations = populations_of(model)
    gone = SpecimenPopulations(replace(populations.likelihood, model=lambda: None))
    with pytest.raises(RuntimeError, match="build the model again"):
        _ = gone.hyperparameters


@pytest.mark.long
def test_a_mirror_population_that_the_prior_excludes() -> None:
    """The second output has a root on both sides of b = 1, and the prior is on one of them."""
    rng = np.random.default_rng([9, 20, 6])
    start = rng.standard_normal(4)
    share = norm.cdf(start)
    sd1, sd2 = halfnorm.ppf(share[[1, 3]], scale=0.5)
    mean = truncnorm.ppf(share[2], -1 / 0.7, np.inf, 2.0, 0.7)
    z = rng.standard_normal((20, 2))
    a, b = start[0] + sd1 * z[:, 0], mean + sd2 * z[:, 1]

    def response(a: Any, b: Any) -> Any:
        return np.stack([np.exp(0.3 * a + 0.1 * b), np.exp(b - 1) - (b - 1)], axis=-1)

    with pm.Model() as model:
        mu2 = pm.TruncatedNormal("mu2", 2.0, 0.7, lower=1.0)
        inputs = [
            pm.Normal.dist(pm.Normal("mu1", 0, 1), pm.HalfNormal("sd1", 0.5)),
            pm.Normal.dist(mu2, pm.HalfNormal("sd2", 0.5)),
        ]
        prb.Simulator("y", response, *inputs, observed=response(a, b))
    posterior = prb.sample(model=model, random_seed=1, progressbar=False).posterior
    for name, x in (("mu1", a), ("mu2", b)):
        off = float(posterior[name].mean()) - x.mean()
        assert abs(off) < 0.5 * float(posterior[name].std())


@pytest.mark.parametrize("propagation", [None, prb.Resimulated()])
def test_no_run_is_beyond_the_ends_of_truncated_inputs(propagation: Any) -> None:
    rng = np.random.default_rng(1)
    x = truncnorm(-1.5, 1.0).rvs(20, random_state=rng) * 2 + 3

    def response(x: Floats) -> Floats:
        if (x < 0).any() or (x > 5).any():
            raise ValueError("beyond the ends")
        return np.sqrt(x) + x

    settings = {} if propagation is None else {"propagation": propagation}
    with pm.Model() as model:
        mu = pm.Normal("mu", 3, 1)
        x_dist = pm.TruncatedNormal.dist(mu, 2.0, lower=0.0, upper=5.0)
        metric = prb.LogLikelihood(error=0.3)
        observed = response(x) + 0.3 * rng.standard_normal(20)
        prb.Simulator("y", response, x_dist, observed=observed, metric=metric, **settings)
    (likelihood,) = specimen_likelihoods(model).values()
    mus = np.linspace(1.0, 5.0, 9)
    populations = SpecimenPopulations(likelihood)
    points = prepared(likelihood).points
    logs = populations.log_likelihoods(mus[:, None], points.z, points.log_a)
    nodes = np.linspace(0, 5, 4001)
    densities = truncnorm(-mus[:, None] / 2, (5 - mus[:, None]) / 2, mus[:, None], 2).pdf(nodes)
    of_readings = norm(response(nodes), 0.3).pdf(observed[:, None])
    exact = np.log(densities @ of_readings.T * (nodes[1] - nodes[0]))
    assert np.abs((logs - exact).sum(axis=1)).max() < 0.15
    z = points.z[np.isfinite(points.log_a)]
    assert (likelihood.coordinates.within(z) == z).all()
