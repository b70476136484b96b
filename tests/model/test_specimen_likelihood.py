"""The observed variable of the log-likelihood by specimen, as PyMC, ArviZ and samplers use it."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import cache
from typing import Any

import arviz as az
import cloudpickle
import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr
from pymc.model.fgraph import clone_model
from scipy import stats

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator, specimen_log_likelihoods
from prbayes.model.specimen_likelihood import (
    draw_readings,
    log_likelihoods,
    specimen_likelihoods,
)
from prbayes.model.specimen_preparation import _error_scales
from prbayes.response.compile import PLAIN

N = 20
Y = 1 + 2 * np.random.default_rng(1).normal(1.0, 0.5, N)
POINT = {"mu": 0.8, "sigma_log__": -0.5}


class Line:
    """The response 1 + 2 x, which counts its runs; a specimen by itself is no run."""

    def __init__(self) -> None:
        self.runs = 0

    def __call__(self, x: Any) -> Any:
        self.runs += np.size(x) if np.size(x) > 1 else 0
        return 1 + 2 * np.asarray(x)


def priors() -> tuple[Any, Any]:
    return pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1)


def normal() -> list[Any]:
    return [pm.Normal.dist(*priors())]


def build(
    response: Any = None,
    observed: Any = Y,
    inputs: Callable[[], list[Any]] = normal,
    **given: Any,
) -> pm.Model:
    with pm.Model(coords={"specimen": np.arange(3)}) as model:
        prb.Simulator("y", response or Line(), *inputs(), observed=observed, **given)
    return model


def with_data() -> tuple[pm.Model, Line]:
    response = Line()
    with pm.Model() as model:
        data = pm.Data("data", Y)
        prb.Simulator("y", response, pm.Normal.dist(*priors()), observed=data)
    return model, response


def in_closed_form(observed: Floats = Y) -> pm.Model:
    with pm.Model() as model:
        mu, sigma = priors()
        pm.Normal("y", 1 + 2 * mu, 2 * sigma, observed=observed)
    return model


@cache
def shared() -> pm.Model:
    """Return a model whose points are drawn already, for tests that leave it as it is."""
    model = build()
    values(model)
    return model


def values(model: pm.Model, point: dict[str, Any] = POINT, rv: str = "y") -> Floats:
    """Return the log-density of an observed variable, without a compiler."""
    graph = model.logp(vars=[model[rv]], sum=False)[0]
    function = model.compile_fn(
        graph, inputs=model.value_vars, mode=PLAIN, on_unused_input="ignore"
    )
    return np.asarray(function(point))


def exact(point: dict[str, Any] = POINT, observed: Floats = Y) -> Floats:
    return np.asarray(
        stats.norm.logpdf(observed, 1 + 2 * point["mu"], 2 * np.exp(point["sigma_log__"]))
    )


def test_the_log_density_has_an_element_for_each_specimen() -> None:
    ours = values(shared())
    assert ours.shape == (N,)
    assert np.allclose(ours, exact(), atol=0.03)
    other = {"mu": 1.1, "sigma_log__": -0.7}
    difference = values(shared(), other) - ours
    assert np.allclose(difference, exact(other) - exact(), atol=1e-4)


def test_gradients_are_those_of_the_closed_form() -> None:
    gradient, reference = (
        m.compile_fn(m.dlogp(), mode=PLAIN)(POINT) for m in (shared(), in_closed_form())
    )
    assert np.allclose(gradient, reference, atol=1e-4)


@pytest.mark.parametrize("weights", [np.arange(1.0, N + 1), 1.0 * (np.arange(N) < N // 2)])
def test_weights_sum_to_the_effective_number_of_specimens(weights: Floats) -> None:
    ours = values(build(weights=weights))
    kish = weights.sum() ** 2 / (weights**2).sum()
    assert np.allclose(ours, weights * kish / weights.sum() * exact(), atol=0.03)


def test_outside_the_support_of_a_population_gradients_are_finite() -> None:
    # None at the lower end, where the points of a specimen lie on both sides of it.
    x = np.random.default_rng(0).uniform(0.1, 2, N)
    with pm.Model() as model:
        end = pm.HalfNormal("end", 3)
        prb.Simulator("y", lambda x: np.exp(x / 2), pm.Uniform.dist(0, end), observed=np.exp(x / 2))
    graphs = [model.logp(vars=[model["y"]]), model.dlogp()]
    functions = [model.compile_fn(g, mode=PLAIN) for g in graphs]
    for end_value, slope in ((1.0, None), (x.max() - 0.01, None), (x.max() + 0.01, -N), (3.0, -N)):
        value, gradient = (f({"end_log__": np.log(end_value)}) for f in functions)
        assert np.isfinite(gradient).all()
        if slope is None:
            assert value == -np.inf
        else:
            prior = 1 - end_value**2 / 9
            assert gradient[0] == pytest.approx(slope + prior, abs=1e-6)
            assert value == pytest.approx(
                -N * np.log(end_value) - (x / 2 + np.log(0.5)).sum(), abs=0.1
            )


def test_correlated_inputs_whose_correlation_is_a_hyperparameter() -> None:
    matrix = np.array([[1.0, 1.0], [1.0, -2.0]])
    y = np.random.default_rng(0).normal([1.0, 2.0], 1.0, (15, 2)) @ matrix.T
    with pm.Model() as model:
        mu, rho = pm.Normal("mu", 0, 2, shape=2), pm.Uniform("rho", -0.9, 0.9)
        covariance = pm.math.stack([pm.math.stack([1.0, rho]), pm.math.stack([rho, 1.0])])
        prb.Simulator("y", lambda x: x @ matrix.T, pm.MvNormal.dist(mu, covariance), observed=y)
    for rho, center in ((0.0, [0.3, 0.4]), (0.5, [1.0, 2.0])):
        exact = [[1, rho], [rho, 1]]
        p = stats.multivariate_normal(matrix @ center, matrix @ exact @ matrix.T)
        point = {"mu": np.array(center), "rho_interval__": np.log((rho + 0.9) / (0.9 - rho))}
        assert np.allclose(values(model, point), p.logpdf(y), atol=0.05)
    assert pm.draw(model["y"], 3, random_seed=1, mode=PLAIN).shape == (3, 15, 2)


@pytest.mark.long
def test_a_mixture_of_two_populations() -> None:
    observed = Y[:8]
    with pm.Model() as model:
        mu, sigma = priors()
        x = pm.NormalMixture.dist([0.3, 0.7], pm.math.stack([mu, mu + 1.0]), sigma)
        prb.Simulator("y", Line(), x, observed=observed)
    s = np.exp(-0.5)
    parts = [stats.norm.pdf(observed, 1 + 2 * m, 2 * s) for m in (0.8, 1.8)]
    assert np.allclose(values(model), np.log(0.3 * parts[0] + 0.7 * parts[1]), atol=0.03)


def labelled(groups: list[str]) -> xr.DataArray:
    rng = np.random.default_rng(5)
    index = np.array([groups.index(g) for g in np.resize(groups, N)])
    names = np.array(groups)[index]
    return xr.DataArray(rng.normal(index, 0.3), {"supplier": ("specimen", names)}, "specimen")


LIMIT = 1.2


def limited(x: Any) -> Any:
    return np.where(np.asarray(x) > LIMIT, np.nan, 1 + 2 * np.asarray(x))


def test_inputs_without_a_response_truncate_the_population() -> None:
    observed = Y[Y < 1 + 2 * LIMIT]
    model = build(limited, observed)
    other = {"mu": 1.0, "sigma_log__": -0.8}

    def truncated(point: dict[str, Any]) -> Floats:
        share = stats.norm.logcdf(LIMIT, point["mu"], np.exp(point["sigma_log__"]))
        return exact(point, observed) - share

    difference = values(model, other) - values(model)
    assert np.allclose(difference, truncated(other) - truncated(POINT), atol=2e-3)
    # The exact gradient of the term: differences of the closed form.
    gradient = model.compile_fn(model.dlogp(), mode=PLAIN)(POINT)
    prior = model.compile_fn(model.logp(vars=model.free_RVs), mode=PLAIN)
    for name, slope in zip(("mu", "sigma_log__"), np.ravel(gradient), strict=True):
        ahead, behind = ({**POINT, name: POINT[name] + step} for step in (1e-4, -1e-4))
        total = [truncated(at).sum() + prior(at) for at in (ahead, behind)]
        assert slope == pytest.approx((total[0] - total[1]) / 2e-4, abs=0.1)
    (likelihood,) = specimen_likelihoods(model).values()
    params = {"mu": np.array([1.0]), "sigma": np.array([0.5])}
    drawn = draw_readings(likelihood, np.random.default_rng(0), params, 500)
    assert (drawn < 1 + 2 * LIMIT + 0.05).all()


def test_each_group_is_truncated_by_itself() -> None:
    names = ["Adler", "Busch"]
    data = labelled(names)
    keep = data.values < LIMIT
    with pm.Model(coords={"supplier": names}) as model:
        mu, sigma = pm.Normal("mu", 0, 2, dims="supplier"), pm.HalfNormal("sigma", 1)
        x = pm.Normal.dist(mu[prb.response.group("supplier")], sigma)
        prb.Simulator("y", limited, x, observed=1 + 2 * data[keep])
    index = (data["supplier"].values[keep] == "Busch").astype(int)
    points = [{"mu": np.array(mu), "sigma_log__": -1.0} for mu in ((0.1, 0.9), (0.0, 1.2))]
    ours = values(model, points[1]) - values(model, points[0])
    expected = []
    for point in points:
        means, sd = point["mu"][index], np.exp(-1.0)
        log_p = stats.norm.logpdf(data.values[keep], means, sd)
        expected.append(log_p - stats.norm.logcdf(LIMIT, means, sd))
    assert np.allclose(ours, expected[1] - expected[0], atol=2e-3)
    # The same without a graph, as the optimiser and importance sampling evaluate it.
    thetas = np.array([[*np.ravel(point["mu"]), point["sigma_log__"]] for point in points])
    (arrays,) = specimen_log_likelihoods(Evaluator.of(model), thetas).values()
    assert np.allclose(arrays[1] - arrays[0], ours, atol=1e-9)


def test_a_model_prints() -> None:
    assert "Simulator[Line, LogLikelihood]" in shared().str_repr()
    assert "prbayes_Simulator_rv" in str(shared()["y"].owner.op)
    assert r"\text{Line, LogLikelihood}" in shared().str_repr(formatting="latex")


COPIES: dict[str, Callable[[pm.Model], pm.Model]] = {
    "clone_model": clone_model,
    "deepcopy": copy.deepcopy,
    "cloudpickle": lambda model: cloudpickle.loads(cloudpickle.dumps(model)),
}


@pytest.mark.parametrize("make", COPIES)
def test_copies_have_the_same_points(make: str) -> None:
    response = Line()
    model = build(response)
    if make != "clone_model":  # before the first use
        values(model)
    other = COPIES[make](model)
    assert np.allclose(values(other), values(model), rtol=1e-12)
    if make == "cloudpickle":
        (measurement,) = specimen_likelihoods(other)[other["y"]].measurements
        response = measurement.responses.function
    assert response.runs == Evaluator.of(model).n_responses <= 60


@pytest.mark.parametrize("change", [pm.do, pm.observe])
def test_a_hyperparameter_that_is_set_needs_no_run(change: Callable[..., pm.Model]) -> None:
    model = shared()
    (measurement,) = specimen_likelihoods(model)[model["y"]].measurements
    response = measurement.responses.function
    runs = response.runs
    other = change(model, {"sigma": 0.5})
    ours = values(other, {"mu": 0.8})
    assert np.allclose(ours, stats.norm.logpdf(Y, 2.6, 1.0), atol=0.03)
    if change is pm.do:  # its value can be changed
        pm.set_data({"sigma": 1.0}, model=other)
        ours = values(other, {"mu": 0.8})
        assert np.allclose(ours, stats.norm.logpdf(Y, 2.6, 2.0), atol=0.03)
    assert response.runs == runs


def test_other_data_of_the_same_model() -> None:
    model, response = with_data()
    before = values(model)
    other = Y + 1
    with model:
        pm.set_data({"data": other})
    ours = values(model)
    assert np.allclose(ours, exact(observed=other), atol=0.03)
    assert not np.allclose(ours, before, atol=0.03)
    runs = response.runs
    assert Evaluator.of(model).n_responses == runs
    (likelihood,) = specimen_likelihoods(model).values()
    with pytest.raises(ValueError, match=r"y: observed: got shape \(20, 1\), expected \('N',\)"):
        likelihood.observing({"y": Y[:, None]})
    with model:
        pm.set_data({"data": Y})
    assert np.allclose(values(model), before, rtol=1e-12)
    with model:
        pm.set_data({"data": Y[:7]})
    assert np.allclose(values(model), exact(observed=Y[:7]), atol=0.03)
    assert response.runs <= runs + 60


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"epsilon": 0.1}, r"epsilon: got 0\.1, expected none.*leave epsilon= out"),
        ({"propagation": prb.Fresh(64)}, r"got Fresh .*metric=prb\.AreaMetric"),
        (
            {"propagation": prb.Reweighted(64, emulator=None)},
            r"got Reweighted\(emulator=.*leave emulator= out",
        ),
        (
            {"propagation": prb.Reweighted(64, max_points=4096)},
            r"got Reweighted\(max_points=.*leave max_points= out",
        ),
        ({"observed": np.append(Y, np.inf)}, r"infinite values, .*metric=prb\.AreaMetric\(\)"),
        ({"observed": np.append(Y, np.nan)}, "got no measured output of specimen 20.*leave"),
        ({"observed": np.append(Y, 1e200)}, r"observed: got values of up to 1e\+200, .*check them"),
        (
            {"observed": {"a": Y, "b": np.full(N, np.nan)}},
            "observed: got no measured value of the output b, .*leave the output out",
        ),
        ({"observed": Y[:1]}, r"got shape \(1,\), expected \(N,\) or .* with at least 2 specimens"),
        ({"dims": "specimen"}, "dims: got 'specimen' of length 3, expected 20"),
        (
            {"inputs": lambda: [pm.Poisson.dist(pm.math.exp(pm.Normal("mu")))]},
            r"poisson.* is discrete.*prb\.AreaMetric",
        ),
        (
            {"inputs": lambda: [*normal(), pm.Normal("c")]},
            "got c, which goes into the response as a model variable.*scatter.*AreaMetric",
        ),
    ],
)
def test_arguments_without_a_meaning_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        build(**given)


@pytest.mark.long
def test_readings_may_have_limits_of_their_own() -> None:
    upper = np.where(np.arange(N) % 2, 4.0, 3.0)
    low = np.full(N, -9.0)
    tail = stats.norm.logsf(upper, 1 + 2 * POINT["mu"], 2 * np.exp(POINT["sigma_log__"]))
    expected = np.where(upper <= Y, tail, exact()).sum()
    metric = prb.LogLikelihood(censored=(low, list(upper)))
    model = build(metric=metric, observed=np.minimum(Y, upper))
    assert values(model).sum() == pytest.approx(expected, abs=0.1)


def test_censored_readings_alone_have_the_probability_of_their_tail() -> None:
    limit = float(Y.min())
    model = build(metric=prb.LogLikelihood(censored=(None, limit)))
    tail = stats.norm.logsf(limit, 1 + 2 * POINT["mu"], 2 * np.exp(POINT["sigma_log__"]))
    assert values(model).sum() == pytest.approx(N * tail, abs=0.1)


@cache
def posterior() -> dict[str, tuple[float, float]]:
    """Return mean and standard deviation of both hyperparameters, by quadrature."""
    mu, log_sigma = np.linspace(0.4, 1.7, 201)[:, None, None], np.linspace(-2.2, 0, 201)[:, None]
    sigma = np.exp(log_sigma)
    logs = stats.norm.logpdf(Y, 1 + 2 * mu, 2 * sigma).sum(axis=-1)
    logs += (stats.norm.logpdf(mu, 0, 2) + stats.halfnorm.logpdf(sigma) + log_sigma)[..., 0]
    p = np.exp(logs - logs.max())
    p /= p.sum()
    result = {}
    for name, x in (("mu", mu[..., 0]), ("sigma", sigma[:, 0])):
        mean = (p * x).sum()
        result[name] = mean, np.sqrt((p * (x - mean) ** 2).sum())
    return result


def assert_posterior(draws: Any, mean_error: float = 0.2, sd_error: float = 0.15) -> None:
    """Compare with quadrature: several hundred effective draws have standard errors of .04 sd."""
    for name, (mean, sd) in posterior().items():
        x = np.asarray(draws[name])
        assert abs(x.mean() - mean) < mean_error * sd, name
        assert abs(x.std() / sd - 1) < sd_error, name


@pytest.mark.long
@pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)
@pytest.mark.parametrize("sampler", ["nutpie", "numpyro"])
def test_nuts_has_the_exact_posterior(sampler: str) -> None:
    pytest.importorskip(sampler)
    response = Line()
    with build(response) as model:
        draws = pm.sample(
            1000,
            tune=500,
            chains=2,
            cores=1,
            nuts_sampler=sampler,
            random_seed=1,
            progressbar=False,
        )
    assert model
    assert 0 < response.runs <= 60
    assert_posterior(draws.posterior)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_arviz_compares_models_by_specimen() -> None:
    rng = np.random.default_rng(1)
    exact = {name: rng.normal(mean, sd, (2, 500)) for name, (mean, sd) in posterior().items()}
    quick: dict[str, Any] = {"progressbar": False, "compile_kwargs": {"mode": PLAIN}}
    trees = {}
    for name, model in (("points", shared()), ("closed form", in_closed_form())):
        draws = az.from_dict({"posterior": exact})
        with model:
            pm.compute_log_likelihood(draws, **quick)
            drawn = pm.sample_posterior_predictive(draws, random_seed=1, **quick)
        draws["posterior_predictive"] = drawn["posterior_predictive"]
        draws["observed_data"] = drawn["observed_data"]
        assert draws.log_likelihood["y"].shape == (2, 500, N)
        trees[name] = draws
    ours, reference = (az.loo(tree) for tree in trees.values())
    assert ours.elpd == pytest.approx(reference.elpd, abs=0.5)
    assert ours.p == pytest.approx(reference.p, abs=0.3)
    table = az.compare(trees)
    assert table["dse"].max() < 0.5
    pits = [az.loo_pit(tree)["y"].values for tree in trees.values()]
    assert pits[0].shape == (N,)
    # Predictive draws of 1000: standard error of a PIT below .016
    assert np.abs(pits[0] - pits[1]).max() < 0.1


def test_the_first_use_logs_the_number_of_runs(caplog: pytest.LogCaptureFixture) -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu"), 1.0)
        prb.Simulator("y", np.positive, x, observed=[1.0, 2.0, 0.5, -0.3])
        assert "runs at first" not in caplog.text
        with caplog.at_level("INFO", logger="prbayes"):
            values(model, {"mu": 0.0})
    assert "y: runs at first: 10" in caplog.text
    assert "propagation=Reweighted(n=10); more: 30 to 256 in all" in caplog.text


def test_labelled_arrays_in_another_order_than_observed_are_refused() -> None:
    """Errors, limits and conditions have no names to match by: they would belong to others."""
    y = pd.Series(Y, index=[f"s{i}" for i in range(N)])
    table = pd.DataFrame({"a": y, "b": 2 * y})
    step = 0 * y + np.linspace(0.1, 0.2, N)
    rows, columns = "in another order than observed", r"outputs \['b', 'a'\], expected \['a', 'b'\]"
    frame = table.abs() + 1

    def of_both(x: Any) -> Any:
        return {"a": 1 + 2 * x, "b": 2 + 4 * x}

    def metric(**given: Any) -> dict[str, Any]:
        return {"metric": prb.LogLikelihood(**given)}

    def input_at(condition: Any) -> dict[str, Any]:
        def inputs() -> list[Any]:
            mu, sigma = priors()
            return [pm.Normal.dist(mu + prb.response.condition("c", condition), sigma)]

        return {"inputs": inputs}

    for given, message in (
        (metric(error=step[::-1]), rows),
        (metric(rounded=step[::-1]), rows),
        (metric(censored=(None, (step + 3)[::-1])), rows),
        (metric(error=step.set_axis(step.index + "x")), "got values with the index"),
        (input_at(step[::-1]), rows),
    ):
        with pytest.raises(ValueError, match=message):
            build(observed=y, **given)
    for error, message in (
        (pd.Series({"b": 0.1, "a": 0.2}), columns),
        (frame[["b", "a"]], columns),
        (frame[::-1], rows),
    ):
        with pytest.raises(ValueError, match=message):
            build(of_both, table, **metric(error=error))
    build(observed=y, **metric(error=step, censored=(None, step + 3)))
    build(observed=y, **input_at(step.to_numpy()[::-1]))
    for same in (pd.Series({"a": 0.2, "b": 0.1}), frame, frame.reset_index(drop=True)):
        build(of_both, table, **metric(error=same))
        build(of_both, dict(table), **metric(error=same))


@pytest.mark.long
def test_censored_readings_beside_exact_ones_agree_with_closed_forms() -> None:
    """Another output, or a condition, is exact; the log-likelihood has an error of some tenths."""
    rng = np.random.default_rng(0)
    x, c = rng.normal(10, 1, N), rng.uniform(1, 3, N)

    def log_density(mu: float, sigma: float, limit: float) -> float:
        of_c = stats.norm.logpdf(x * c, mu * c, sigma * c)
        tail = stats.norm.logsf(limit, mu * c, sigma * c)
        return float(np.where(x * c >= limit, tail, of_c).sum())

    def log_density_of_both(mu: float, sigma: float, limit: float) -> float:
        of_c = stats.norm.logpdf(x * c, 2 * x, 0.5 * x)
        tail = stats.norm.logsf(limit, 2 * x, 0.5 * x)
        of_x = stats.norm.logpdf(x, mu, sigma)
        return float((of_x + np.where(x * c >= limit, tail, of_c)).sum())

    def product(x: Any, c: Any) -> Any:
        return x * c

    def both(x: Any, c: Any) -> Any:
        return {"x": x, "y": x * c}

    cases: list[tuple[Any, ...]] = [
        (product, lambda: prb.response.condition("c", c), x * c, log_density),
        (both, lambda: pm.Normal.dist(2, 0.5), {"x": x, "y": x * c}, log_density_of_both),
    ]
    for response, second, observed, expected in cases:
        limit = 22.0
        highest = limit if response is product else np.array([np.inf, limit])
        metric = prb.LogLikelihood(censored=(None, highest))
        with pm.Model() as model:
            mu, sigma = pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3)
            inputs = pm.Normal.dist(mu, sigma), second()
            prb.Simulator("y", response, *inputs, metric=metric, observed=observed)
        log_likelihood = model.compile_logp(vars=model.observed_RVs, mode=PLAIN)
        for place in ((10.0, 1.0), (11.0, 0.8), (9.5, 2.0)):
            got = float(log_likelihood({"mu": place[0], "sigma_log__": np.log(place[1])}))
            assert got == pytest.approx(expected(*place, limit), abs=0.4)


def test_scales_of_a_relative_error_leave_missing_readings_out() -> None:
    with pm.Model() as model:
        metric = prb.LogLikelihood(error=pm.HalfNormal("error", 1.0), relative=True)
        observed = np.array([[1.0, 2.0], [2.0, np.nan], [3.0, 5.0]])
        x = pm.Normal.dist(*priors())
        prb.Simulator("y", lambda x: np.stack([x, 2 * x], -1), x, observed=observed, metric=metric)
    (likelihood,) = specimen_likelihoods(model).values()
    scales = _error_scales(likelihood)[::-1, 0]
    # Divided by the 84 % quantile, the 1 and 99 % quantiles of a half-normal prior.
    np.testing.assert_allclose([scales[0], scales[-1]], [0.0089, 1.83], rtol=0.2)


@pytest.mark.long
def test_densities_between_values_of_an_unknown_error_are_interpolated() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(*priors())
        metric = prb.LogLikelihood(error=pm.HalfNormal("error", 1.0), relative=True)
        prb.Simulator("y", Line(), x, observed=Y, metric=metric)
    (likelihood,) = specimen_likelihoods(model).values()
    error = np.exp(np.random.default_rng(0).uniform(np.log(0.02), np.log(3.0), 500))
    values = {"mu": np.full(500, 0.9), "sigma": np.full(500, 0.4), "error": error}
    together = log_likelihoods(likelihood, values)
    single = [
        log_likelihoods(likelihood, {name: v[k : k + 1] for name, v in values.items()})[0]
        for k in range(0, 500, 50)
    ]
    np.testing.assert_allclose(together[::50].sum(axis=1), np.sum(single, axis=1), atol=0.01)
    assert np.abs(together[::50] - single).max() > 0
