"""`sample_smc` and its kernel against exact posteriors, numerical grids, and what they promise."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import arviz as az
import matplotlib as mpl
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from first_use import first_use
from scipy.stats import norm

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import nodes

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)
N, MEAN = OBSERVED.size, float(OBSERVED.mean())
R256 = prb.Reweighted(256)
R128 = prb.Reweighted(128)


def same(x: Any) -> Any:
    return x


def known_sd(metric: prb.Metric, **keywords: Any) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        prb.Simulator("y", same, x, metric=metric, observed=OBSERVED, propagation=R128, **keywords)
    return model


def two_hyperparameters(**keywords: Any) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y", same, x, metric=prb.AreaMetric(), observed=OBSERVED, propagation=R256, **keywords
        )
    return model


def sample(model: pm.Model, draws: int = 500, **keywords: Any) -> xr.DataTree:
    # The pseudo-posterior; the posterior given the estimate is tested in test_target.py.
    keywords = {"chains": 4, "random_seed": 1, "progressbar": False, "adjustment": None} | keywords
    return prb.sample_smc(draws, model=model, **keywords)


@cache
def area_run() -> tuple[pm.Model, xr.DataTree]:
    model = two_hyperparameters(epsilon=0.02)
    return model, sample(model)


@cache
def area_grid() -> tuple[Floats, Floats, float]:
    """Thetas, their normalised weights, and the log marginal likelihood, by quadrature."""
    mu, log_sigma = np.linspace(0.6, 1.4, 81), np.linspace(np.log(0.12), np.log(1.2), 81)
    thetas = np.stack(np.meshgrid(mu, log_sigma, indexing="ij"), axis=-1).reshape(-1, 2)
    sigma = np.exp(thetas[:, 1])
    log_prior = (
        norm.logpdf(thetas[:, 0], 0, 2) + np.log(2) + norm.logpdf(sigma, 0, 1) + thetas[:, 1]
    )
    distance = Evaluator.of(area_run()[0])(thetas).discrepancies[:, 0]
    logs = log_prior - distance / 0.02
    weights = np.exp(logs - logs.max())
    edges = weights.reshape(81, 81)
    assert max(edges[[0, -1]].max(), edges[:, [0, -1]].max()) < 1e-3  # the grid holds the posterior
    cell = (mu[1] - mu[0]) * (log_sigma[1] - log_sigma[0])
    return thetas, weights / weights.sum(), float(np.log(weights.sum() * cell) + logs.max())


def moments(x: Floats, weights: Floats) -> tuple[float, float]:
    mean = float(weights @ x)
    return mean, float(np.sqrt(weights @ (x - mean) ** 2))


def ess(draws: xr.DataArray) -> float:
    """Effective sample size; particles are a little correlated with those of the stage before."""
    return float(min(az.ess(draws.values), draws.size))


def assert_moments(draws: xr.DataArray, mean: float, sd: float, rtol_sd: float) -> None:
    # Standard error of the mean sd / sqrt(ess); of the sd about sd / sqrt(2 ess), 1.6% for 2000
    # draws.
    n = ess(draws)
    assert n > 0.5 * draws.size
    assert abs(float(draws.mean()) - mean) < 4 * sd / n**0.5
    np.testing.assert_allclose(float(draws.std()), sd, rtol=rtol_sd)


# -- the posterior is the right one
# ----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["KullbackLeibler", "LogLikelihood"])
def test_conjugate_posterior_of_a_normal_mean(name: str) -> None:
    # N times these metrics is the negative log-likelihood of a normal with variance sd^2 + h^2, up
    # to a constant.
    metric = (
        prb.KullbackLeibler()
        if name == "KullbackLeibler"
        else prb.LogLikelihood(density=prb.GaussianKDE())
    )
    model = known_sd(metric)
    h = next(iter(nodes(model).values())).target.cells.bandwidth
    idata = sample(model)
    precision = 1 / 4 + N / (0.25 + h**2)
    mean, sd = N * MEAN / (0.25 + h**2) / precision, precision**-0.5
    assert_moments(idata.posterior["mu"], mean, sd, 0.08)  # five standard errors
    # Against the posterior under the exact likelihood: the divergence is smoothed by two Silverman
    # bandwidths.
    ratio = float(idata.posterior["mu"].std()) * (1 / 4 + N / 0.25) ** 0.5
    assert 0.93 < ratio < (1.3 if name == "KullbackLeibler" else 1.1)
    if name == "LogLikelihood":  # and the evidence: that of the normal data, conjugate
        covariance = (0.25 + h**2) * np.eye(N) + 4.0
        _, logdet = np.linalg.slogdet(2 * np.pi * covariance)
        exact = -0.5 * (logdet + OBSERVED @ np.linalg.solve(covariance, OBSERVED))
        found = idata.sample_stats["log_marginal_likelihood"].values[:, -1]
        assert (
            abs(found.mean() - exact) < 4 * 0.1 / 2 + 0.05
        )  # sd of 0.1 between chains; the data are not quite normal


def test_area_posterior_against_a_grid() -> None:
    thetas, weights, _ = area_grid()
    posterior = area_run()[1].posterior
    # A particle may stay at an artefact of the design's 256 points, below the grid.
    inside = posterior["sigma"] > 0.12
    assert (~inside).sum() <= 2
    log_sigma = np.log(posterior["sigma"].where(inside, float(posterior["sigma"].median())))
    for name, values in (("mu", thetas[:, 0]), ("sigma", np.exp(thetas[:, 1]))):
        mean, sd = moments(values, weights)
        assert_moments(posterior[name], mean, sd, 0.08)
    assert_moments(log_sigma, *moments(thetas[:, 1], weights), 0.08)


def test_log_marginal_likelihood_against_a_grid() -> None:
    found = area_run()[1].sample_stats["log_marginal_likelihood"].values
    assert np.isnan(found[:, :-1]).all()  # only at beta = 1 is it that of the model
    last = np.array([row[~np.isnan(row)][-1] for row in found])
    # 500 particles leave an sd of 0.15 between chains; log of a mean: bias -0.01.
    assert np.ptp(last) < 6 * 0.15
    assert abs(last.mean() - area_grid()[2]) < 4 * 0.15 / 4**0.5


def test_a_reflection_keeps_both_modes() -> None:
    data = (np.random.default_rng(3).normal(2.0, 0.5, 40) - 1) ** 2
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1.5), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y",
            lambda x: x**2 - 2 * x + 1,
            x,
            metric=prb.AreaMetric(),
            observed=data,
            epsilon=0.05,
            propagation=R256,
        )
    mu = sample(model).posterior["mu"].values
    # Symmetric about 1; 2000 draws would give a standard error of 0.011 if chains kept the shares
    # of the prior draws exactly, and resampling at low temperatures adds drift: 0.3 to 0.7 is more
    # than five standard errors.
    assert 0.3 < (mu > 1).mean() < 0.7
    assert ((mu > 1).mean(axis=1) > 0.2).all()
    assert ((mu > 1).mean(axis=1) < 0.8).all()
    assert 1.7 < np.median(mu[mu > 1]) < 2.1
    assert -0.1 < np.median(mu[mu < 1]) < 0.3


def test_several_simulators_and_an_ordinary_likelihood() -> None:
    # All quadratic in mu: two divergences with known bandwidths, a normal likelihood and a
    # potential.
    rng = np.random.default_rng(2)
    other, extra = rng.normal(1.4, 0.5, 20), rng.normal(1.2, 0.5, 30)
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 2)
        x = pm.Normal.dist(mu, 0.5)
        prb.Simulator(
            "a", same, x, metric=prb.KullbackLeibler(), observed=OBSERVED, propagation=R128
        )
        prb.Simulator(
            "b", lambda x: -x, x, metric=prb.KullbackLeibler(), observed=-other, propagation=R128
        )
        pm.Normal("z", mu, 0.5, observed=extra)
        pm.Potential("pull", -5.0 * (mu - 3.0) ** 2)
    h = np.array([n.target.cells.bandwidth for n in nodes(model).values()])
    precision = np.array([1 / 4, *([N, 20] / (0.25 + h**2)), 30 / 0.25, 10])
    centers = np.array([0.0, MEAN, other.mean(), extra.mean(), 3.0])
    idata = sample(model)
    mean, sd = precision @ centers / precision.sum(), precision.sum() ** -0.5
    assert_moments(idata.posterior["mu"], mean, sd, 0.08)
    assert idata.posterior.attrs["n_responses"] == int(idata.calibration["n_points"].sum())
    np.testing.assert_allclose(idata.calibration["epsilon"], [1 / N, 1 / 20])
    assert list(idata.calibration["simulator"].values) == ["a", "b"]


# -- determinism
# -----------------------------------------------------------------------------------------


def test_bit_identical_for_a_seed_and_different_for_others() -> None:
    model, first = area_run()
    again = sample(two_hyperparameters(epsilon=0.02))
    for group in ("posterior", "sample_stats"):
        xr.testing.assert_equal(first[group].to_dataset(), again[group].to_dataset())
    other = sample(model, 50, chains=2, random_seed=2)
    short = sample(model, 50, chains=2, random_seed=1)
    assert not np.isin(other.posterior["mu"].values, short.posterior["mu"].values).any()
    first_chain, second_chain = short.posterior["mu"].values
    assert not np.isin(first_chain, second_chain).any()


# -- epsilon
# ---------------------------------------------------------------------------------------------


def epsilon_of(model: pm.Model) -> list[float]:
    return [n.epsilon_value for n in nodes(model).values()]


def test_an_epsilon_is_for_one_run() -> None:
    model = area_run()[0]
    for epsilon in (0.5, {"y": 0.5}):
        idata = sample(model, 100, chains=1, epsilon=epsilon)
        np.testing.assert_allclose(idata.calibration["epsilon"], [0.5])
        assert epsilon_of(model) == [0.02]
    wide, narrow = idata.posterior["mu"].std(), area_run()[1].posterior["mu"].std()
    assert float(wide) > 2 * float(narrow)


@pytest.mark.long
def test_an_unset_epsilon_is_calibrated_for_the_run() -> None:
    model = two_hyperparameters()
    assert np.isnan(epsilon_of(model)).all()
    optimum = prb.minimize(model, method="Nelder-Mead")
    idata = sample(model, 100, chains=1, optimum=optimum)
    expected = prb.calibrate_epsilon(optimum)
    np.testing.assert_allclose(idata.calibration["epsilon"], [expected["y"]])
    assert np.isnan(epsilon_of(model)).all()
    alone = sample(model, 100, chains=1)  # looks for the optimum itself
    np.testing.assert_allclose(alone.calibration["epsilon"], [expected["y"]], rtol=0.05)


def test_epsilon_is_restored_after_a_failure() -> None:
    model = area_run()[0]

    class Stop(Exception):  # noqa: N818
        pass

    def fail(*_: Any) -> None:
        raise Stop

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prb.posterior.BatchedKernel, "mutate", fail)
        with pytest.raises(Stop):
            sample(model, 50, chains=1, epsilon=0.7)
    assert epsilon_of(model) == [0.02]


@pytest.mark.parametrize(
    ("epsilon", "error", "words"),
    [
        ({"z": 0.1}, KeyError, r"\['z'\], expected names of simulators: \['y'\]"),
        (-0.1, ValueError, "y: epsilon"),
        (0.0, ValueError, "y: epsilon"),
        (np.nan, ValueError, "y: epsilon"),
        ("wide", TypeError, "y: epsilon"),
    ],
)
def test_an_epsilon_that_is_none_is_refused(
    epsilon: Any, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        sample(area_run()[0], 50, chains=1, epsilon=epsilon)
    assert epsilon_of(area_run()[0]) == [0.02]


def test_one_number_for_two_simulators_is_refused() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu"), 1.0)
        for name in "ab":
            prb.Simulator(
                name,
                same,
                x,
                metric=prb.AreaMetric(),
                observed=OBSERVED,
                propagation=prb.Reweighted(16),
            )
    with pytest.raises(
        ValueError, match=r"one number for 2 simulators, expected a dict by name: \['a', 'b'\]"
    ):
        sample(model, 50, epsilon=0.1)


# -- other arguments
# -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keywords", "error", "words"),
    [
        ({"draws": 5}, ValueError, "draws"),
        ({"draws": 10.5}, TypeError, "draws"),
        ({"chains": 0}, ValueError, "chains"),
        ({"threshold": 1.0}, ValueError, "threshold"),
    ],
)
def test_arguments_are_checked(
    keywords: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        sample(area_run()[0], **keywords)


def test_no_finite_discrepancy_among_the_prior_draws() -> None:
    metric = prb.FunctionMetric(lambda z, observed: np.full(np.shape(z)[:-1], np.nan))
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        prb.Simulator(
            "y",
            same,
            x,
            metric=metric,
            observed=OBSERVED,
            epsilon=1.0,
            propagation=prb.Resimulated(16),
        )
    with pytest.raises(ValueError, match="no finite discrepancy among 50 draws"):
        sample(model, 50, chains=1)


def test_a_higher_threshold_takes_more_stages() -> None:
    model = area_run()[0]
    few, many = (
        sample(model, 100, chains=1, threshold=t).sample_stats.sizes["stage"] for t in (0.3, 0.9)
    )
    assert many > few


def test_responses_are_counted_under_other_propagations() -> None:
    counted = 0

    def count(x: Any) -> Floats:
        nonlocal counted
        x = np.asarray(x, dtype=float)
        counted += x.size
        return np.asarray(x)

    for propagation in (prb.Resimulated(64), prb.Fresh(64)):
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
            prb.Simulator(
                "y",
                count,
                x,
                metric=prb.AreaMetric(),
                observed=OBSERVED,
                epsilon=0.1,
                propagation=propagation,
            )
        first_use(model)
        counted = 0
        idata = sample(model, 60, chains=2)
        assert idata.posterior.attrs["n_responses"] == counted > 60 * 2 * 64
        assert abs(float(idata.posterior["mu"].mean()) - MEAN) < 0.2


# -- the result
# ------------------------------------------------------------------------------------------


def test_the_tree_is_complete() -> None:
    model, idata = area_run()
    own = {"posterior", "sample_stats", "calibration", "observed_data"}
    of_arviz = {"prior", "log_prior", "log_likelihood", "posterior_predictive", "prior_predictive"}
    assert set(idata.children) == own | of_arviz
    assert idata.posterior.sizes == {"chain": 4, "draw": 500}
    stats = idata.sample_stats
    for row in stats["beta"].values:
        stages = row[~np.isnan(row)]
        assert (np.diff(stages) > 0).all()
        assert stages[-1] == 1.0
    assert ((stats["accept_rate"] > 0.05) | np.isnan(stats["beta"])).all()
    np.testing.assert_array_equal(idata.observed_data["y"], OBSERVED)
    calibration = idata.calibration
    assert list(calibration["element"].values) == ["mu", "sigma_log__"]
    np.testing.assert_allclose(
        calibration["theta"].sel(element="sigma_log__"), np.log(idata.posterior["sigma"])
    )
    again = Evaluator.of(model)(calibration["theta"].values.reshape(-1, 2)).discrepancies.reshape(
        4, 500, 1
    )
    np.testing.assert_allclose(calibration["discrepancy"], again)
    for key, low, high in (("weight_ess", 10, 256), ("mean_weight", 0.8, 1.2), ("lost_mass", 0, 0)):
        assert low <= float(calibration[key].median()) <= high
    assert idata.posterior.attrs["random_seed"] == "1"
    assert idata.posterior.attrs["n_responses"] == int(calibration["n_points"][0])


def vector_model() -> pm.Model:
    data = np.random.default_rng(4).normal([1.0, 2.0], 1.0, (30, 2))
    with pm.Model(coords={"axis": ["a", "b"]}) as model:
        mean = pm.Normal("mean", 0, [2.0, 2.0], dims="axis")
        pm.Deterministic("gap", mean[1] - mean[0])
        pm.Deterministic("twice", 2 * mean, dims="axis")
        for i, name in enumerate(("first", "second")):
            x = pm.Normal.dist(mean[i], 1.0)
            prb.Simulator(
                name, same, x, metric=prb.KullbackLeibler(), observed=data[:, i], propagation=R128
            )
    return model


@cache
def vector_run() -> xr.DataTree:
    return sample(vector_model(), 200)


def test_named_dimensions_arrive_in_the_posterior() -> None:
    posterior = vector_run().posterior
    assert posterior["mean"].dims == ("chain", "draw", "axis")
    assert list(posterior["axis"].values) == ["a", "b"]
    np.testing.assert_allclose(posterior["twice"], 2 * posterior["mean"])
    np.testing.assert_allclose(
        posterior["gap"], posterior["mean"].diff("axis").squeeze("axis", drop=True)
    )
    assert list(vector_run().calibration["element"].values) == ["mean[a]", "mean[b]"]
    for i, name in enumerate("ab"):
        data = vector_run().observed_data[("first", "second")[i]].values
        h2 = vector_run_bandwidth(i) ** 2
        precision = 1 / 4 + 30 / (1 + h2)
        draws = posterior["mean"].sel(axis=name)
        assert_moments(
            draws, 30 * data.mean() / (1 + h2) / precision, precision**-0.5, 0.12
        )  # 800 draws: 5 x 2.5%


def vector_run_bandwidth(i: int) -> float:
    return float(list(nodes(vector_model()).values())[i].target.cells.bandwidth)


@pytest.mark.parametrize("run", [lambda: area_run()[1], vector_run])
def test_arviz_takes_it(run: Callable[[], xr.DataTree]) -> None:
    mpl.use("Agg")
    idata = run()
    table = az.summary(idata)
    assert (table["ess_bulk"].astype(float) > 200).all()
    assert (table["r_hat"].astype(float) < 1.05).all()
    for plot in (az.plot_dist, az.plot_trace, az.plot_rank, az.plot_forest, az.plot_pair):
        assert plot(idata) is not None
    mpl.pyplot.close("all")


def test_storage_in_netcdf(tmp_path: Path) -> None:
    idata = area_run()[1]
    idata.to_netcdf(tmp_path / "run.nc")
    loaded = az.from_netcdf(tmp_path / "run.nc")
    try:
        for group in idata.children:
            xr.testing.assert_equal(loaded[group].to_dataset().load(), idata[group].to_dataset())
            for key, value in idata[group].attrs.items():
                assert loaded[group].attrs[key] == value
    finally:
        loaded.close()


# -- the kernel under PyMC's own sampler


def test_the_kernel_draws_the_same_posterior_under_pymc() -> None:
    keywords = {
        "draws": 500,
        "chains": 2,
        "cores": 1,
        "progressbar": False,
        "compute_convergence_checks": False,
    }
    idata = pm.sample_smc(
        kernel=prb.posterior.BatchedKernel, model=area_run()[0], random_seed=1, **keywords
    )
    thetas, weights, evidence = area_grid()
    for name, values in (("mu", thetas[:, 0]), ("sigma", np.exp(thetas[:, 1]))):
        assert_moments(
            idata.posterior[name], *moments(values, weights), 0.12
        )  # 1000 draws: five times 2.2%
    chain = idata.sample_stats["log_marginal_likelihood"].values
    last = [np.asarray(row, dtype=float)[-1] for row in chain]
    assert abs(np.mean(last) - evidence) < 4 * 0.15 / 2**0.5
