"""Covariates: populations that depend on a known value of each specimen."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from pymc.model.fgraph import clone_model
from scipy import stats
from suppliers import labelled

import prbayes as prb
from prbayes.model.description import describe
from prbayes.model.evaluator import Evaluator, specimen_graphs, specimen_log_likelihoods
from prbayes.model.fingerprint import identity_of
from prbayes.model.random_variable import simulators
from prbayes.model.specimen_likelihood import arrays
from prbayes.response.distributions import compiled_log_density
from prbayes.results.likelihood_checks import score_function, scored_specimens

N = 12
HARDNESS = np.random.default_rng(3).uniform(200, 300, N)
NOISE = np.random.default_rng(4).normal(size=(2, N))
X = 1 + 0.01 * (HARDNESS - 250) + 0.2 * NOISE[0]


def double(x: Any) -> Any:
    return 2.0 * x


def build(
    response: Any = double,
    observed: Any = 2 * X,
    hardness: Any = HARDNESS,
    group: bool = False,
    **given: Any,
) -> pm.Model:
    with pm.Model(coords={"supplier": ["A", "B"]}) as model:
        a = pm.Normal("a", 1, 0.5, dims="supplier" if group else None)
        b = pm.Normal("b", 0.01, 0.005)
        sigma = pm.LogNormal("sigma", -1.5, 0.5)
        a = a[prb.response.group("supplier")] if group else a
        covariate = prb.response.condition("hardness", hardness)
        x = pm.Normal.dist(a + b * (covariate - 250.0), sigma, name="x")
        prb.Simulator("y", response, x, observed=observed, progressbar=False, **given)
    return model


def means(values: dict[str, Any], a: Any = None) -> Any:
    a = values["a"][:, None] if a is None else a
    return a + values["b"][:, None] * (HARDNESS - 250)


def truncated(x: Any) -> Any:
    return np.where(np.asarray(x) > 0.6, 2.0 * x, np.nan)


@pytest.fixture(scope="module")
def model() -> pm.Model:
    return build()


@pytest.fixture(scope="module")
def posterior(model: pm.Model) -> xr.DataTree:
    return prb.sample(500, model=model, chains=2, random_seed=1, progressbar=False)


def test_a_log_likelihood_is_that_of_the_population_of_each_specimen(model: pm.Model) -> None:
    evaluator = Evaluator.of(model)
    thetas = evaluator.hyperparameters.prior_thetas(30, 0)
    values = evaluator.hyperparameters.constrained(thetas)
    exact = stats.norm.logpdf(X, means(values), values["sigma"][:, None]) - np.log(2)
    logs = specimen_log_likelihoods(evaluator, thetas)["y"]
    assert np.abs(logs - exact).max() < 0.02
    (graph,) = evaluator.hyperparameters.compile(specimen_graphs(evaluator))(thetas)
    assert np.allclose(graph, logs, atol=1e-9)


def test_groups_and_covariates_go_together() -> None:
    makers = np.array(["A", "B"] * (N // 2))
    evaluator = Evaluator.of(build(observed=labelled(2 * X, makers), group=True))
    thetas = evaluator.hyperparameters.prior_thetas(30, 0)
    values = evaluator.hyperparameters.constrained(thetas)
    a = values["a"][:, (makers == "B").astype(int)]
    exact = stats.norm.logpdf(X, means(values, a), values["sigma"][:, None]) - np.log(2)
    logs = specimen_log_likelihoods(evaluator, thetas)["y"]
    assert np.abs(logs - exact).max() < 0.02
    (graph,) = evaluator.hyperparameters.compile(specimen_graphs(evaluator))(thetas)
    assert np.allclose(graph, logs, atol=1e-9)


@pytest.mark.long
def test_a_population_is_truncated_where_it_has_no_response() -> None:
    rows = X > 0.6
    evaluator = Evaluator.of(build(truncated, 2 * X[rows], HARDNESS[rows]))
    thetas = evaluator.hyperparameters.prior_thetas(30, 0)
    values = evaluator.hyperparameters.constrained(thetas)
    population = stats.norm(means(values)[:, rows], values["sigma"][:, None])
    exact = population.logpdf(X[rows]) - np.log(2) - population.logsf(0.6)
    logs = specimen_log_likelihoods(evaluator, thetas)["y"]
    is_plausible = exact.sum(axis=1) > exact.sum(axis=1).max() - 20
    assert np.abs(logs - exact)[is_plausible].max() < 0.05
    (graph,) = evaluator.hyperparameters.compile(specimen_graphs(evaluator))(thetas)
    assert np.allclose(graph, logs, atol=1e-9)


def test_specimens_with_fewer_readings_than_inputs_have_their_own_population() -> None:
    with pm.Model() as model:
        a = pm.Normal("a", 1, 0.3)
        b = pm.Normal("b", 0.01, 0.003)
        covariate = prb.response.condition("hardness", HARDNESS)
        x = pm.Normal.dist(a + b * (covariate - 250.0), 0.2)
        z = pm.Normal.dist(0, 0.3)
        prb.Simulator("y", lambda x, z: x + z, x, z, observed=X + 0.3 * NOISE[1])
    evaluator = Evaluator.of(model)
    thetas = evaluator.hyperparameters.prior_thetas(30, 0)
    values = evaluator.hyperparameters.constrained(thetas)
    exact = stats.norm.logpdf(X + 0.3 * NOISE[1], means(values), np.hypot(0.2, 0.3))
    logs = specimen_log_likelihoods(evaluator, thetas)["y"]
    is_plausible = exact.sum(axis=1) > exact.sum(axis=1).max() - 20
    assert np.abs(logs - exact)[is_plausible].max() < 0.15


def test_the_posterior_is_the_exact_one(model: pm.Model, posterior: xr.DataTree) -> None:
    # On a grid of sigma; given sigma, a and b are normal.
    design = np.column_stack([np.ones(N), HARDNESS - 250])
    prior = np.diag([0.5**2, 0.005**2])
    log_sigma = np.linspace(-3, 0.5, 400)
    moments = []
    for sigma in np.exp(log_sigma):
        precision = np.linalg.inv(prior) + design.T @ design / sigma**2
        covariance = np.linalg.inv(precision)
        mean = covariance @ (np.linalg.inv(prior) @ [1, 0.01] + design.T @ X / sigma**2)
        marginal = stats.multivariate_normal(
            design @ [1, 0.01], design @ prior @ design.T + sigma**2 * np.eye(N)
        )
        log_weight = marginal.logpdf(X) + stats.norm.logpdf(np.log(sigma), -1.5, 0.5)
        moments.append([log_weight, *mean, *np.diag(covariance)])
    log_weight, a, b, variance_a, variance_b = np.array(moments).T
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    draws = posterior["posterior"]
    for name, mean, variance in (("a", a, variance_a), ("b", b, variance_b)):
        exact = weight @ mean
        sd = np.sqrt(weight @ (variance + mean**2) - exact**2)
        # Standard errors of 1000 draws are .03 and 2.2 %.
        assert abs(float(draws[name].mean()) - exact) < 0.15 * sd
        assert float(draws[name].std()) == pytest.approx(sd, rel=0.1)


def test_drawn_readings_are_at_the_covariates_of_the_specimens(posterior: xr.DataTree) -> None:
    draws, readings = posterior["posterior"], posterior["posterior_predictive"]["y"]
    values = {name: draws[name].values.ravel() for name in ("a", "b", "sigma")}
    expected = 2 * means(values).mean(axis=0)
    assert np.abs(readings.values.mean(axis=(0, 1)) - expected).max() < 0.1


def test_predictions_are_at_a_value_of_the_covariate(
    model: pm.Model, posterior: xr.DataTree
) -> None:
    (x,) = next(iter(Evaluator.of(model).likelihoods)).inputs.aleatory
    at = prb.predict(posterior, double, x, model=model, at={"hardness": 250})
    assert at.attrs["responses"] == 0
    draws = posterior["posterior"]
    same = pm.Normal.dist(model["a"] + model["b"] * 0.0, model["sigma"])
    written = prb.predict(posterior, double, same, model=model)
    assert float(at.mean()) == pytest.approx(2 * float(draws["a"].mean()), abs=0.02)
    # The specimens are the same; few are beyond the range of the runs.
    assert float((np.abs(at - written) < 1e-3).mean()) > 0.999
    far = prb.predict(posterior, double, x, model=model, at={"hardness": 400}, stored=False)
    exact = 2 * float((draws["a"] + 150 * draws["b"]).mean())
    assert float(far.mean()) == pytest.approx(exact, abs=0.1)
    for given in (None, {"load": 1.0}, 3.0, {"hardness": 400}):
        with pytest.raises(ValueError, match=r"at: .*got"):
            prb.predict(posterior, double, x, model=model, at=given)
    with pytest.raises(TypeError, match="at: hardness: got str"):
        prb.predict(posterior, double, x, model=model, at={"hardness": "high"})
    with pytest.raises(TypeError, match="has the responses of a population"):
        prb.exceedance(posterior, double, 3.0, x, model=model)


def test_the_test_of_the_population_takes_the_population_of_each_specimen(model: pm.Model) -> None:
    evaluator = Evaluator.of(model)
    (likelihood,) = evaluator.likelihoods
    theta = evaluator.hyperparameters.initial
    values = evaluator.hyperparameters.constrained(theta[None])
    points, log_a = arrays(likelihood)
    functions = score_function(likelihood.inputs), compiled_log_density(likelihood.inputs)
    data = [([x.get_value() for x in points], log_a.get_value())]
    ((z, weights),) = scored_specimens(evaluator, [functions], theta, data)
    exact = (X - means(values)[0]) / values["sigma"][0]
    assert np.allclose((z[..., 0] * weights).sum(axis=1), exact, atol=0.01)


@pytest.mark.parametrize("is_last", [False, True])
def test_a_condition_may_be_an_input_and_a_covariate(is_last: bool) -> None:
    def response(*arguments: Any) -> Any:
        hardness, x = arguments[::-1] if is_last else arguments
        return hardness / 100 * x

    with pm.Model() as model:
        a = pm.Normal("a", 1, 0.5)
        b = pm.Normal("b", 0.01, 0.005)
        hardness = prb.response.condition("hardness", HARDNESS)
        x = pm.Normal.dist(a + b * (hardness - 250.0), 0.2, name="x")
        inputs = (x, hardness) if is_last else (hardness, x)
        prb.Simulator("y", response, *inputs, observed=HARDNESS / 100 * X)
    evaluator = Evaluator.of(model)
    thetas = evaluator.hyperparameters.prior_thetas(30, 0)
    values = evaluator.hyperparameters.constrained(thetas)
    exact = stats.norm.logpdf(X, means(values), 0.2) - np.log(HARDNESS / 100)
    logs = specimen_log_likelihoods(evaluator, thetas)["y"]
    is_plausible = exact.sum(axis=1) > exact.sum(axis=1).max() - 20
    assert np.abs(logs - exact)[is_plausible].max() < 0.05
    if is_last:
        return
    optimum = prb.minimize(model, starts=0, progressbar=False)
    drawn = prb.predict(optimum, response, hardness, x, model=model, n_samples=400)
    point = {name: np.array([float(optimum.point[name])]) for name in ("a", "b")}
    expected = HARDNESS / 100 * means(point)[0]
    # Four standard errors of 400 draws with a standard deviation of .6 at most.
    assert np.abs(drawn.mean(("chain", "draw")) - expected).max() < 0.12
    number = prb.predict(optimum, response, 250.0, x, model=model, at={"hardness": 250.0})
    assert float(number.mean()) == pytest.approx(2.5 * point["a"][0], abs=0.05)
    with pytest.raises(ValueError, match=r"at: got .*hardness"):
        prb.predict(optimum, response, hardness, x, model=model, at={"hardness": 250.0})


@pytest.mark.parametrize("part", [slice(None), 0])
def test_a_covariate_has_one_value_for_each_specimen(part: Any) -> None:
    """A column, such as a DataFrame of one, is no vector: it has rows of one value."""
    with pm.Model():
        hardness = prb.response.condition("hardness", np.reshape(HARDNESS, (-1, 1)))
        x = pm.Normal.dist(pm.Normal("a", 1, 1) + hardness[part], 1.0, name="x")
        shape = rf"got x .* from hardness, whose values have the shape \({len(HARDNESS)}, 1\)"
        with pytest.raises(TypeError, match=shape):
            prb.Simulator("y", np.positive, x, observed=HARDNESS)


def test_a_population_for_each_specimen_has_no_common_score(model: pm.Model) -> None:
    table = prb.cross_validate(
        prb.minimize(model, starts=0, progressbar=False), folds=2, progressbar=False
    )
    assert np.isfinite(table["discrepancy"]).all()
    assert "specimens without a score" in str(table)
    assert "nan" not in str(table)
    with pytest.raises(ValueError, match="depend on a condition of each specimen"):
        prb.rank({"first": table, "second": table})


def test_other_covariates_are_another_problem(model: pm.Model) -> None:
    identity = identity_of(model)
    assert identity == identity_of(clone_model(model))
    assert identity != identity_of(build(hardness=HARDNESS[::-1]))
    assert "hardness" in str(describe(model))


def test_frequencies_and_other_data_keep_the_covariates() -> None:
    frequencies = np.array([2, 1] * (N // 2))
    repeated = build(weights=frequencies)
    (measurement,) = next(iter(Evaluator.of(repeated).likelihoods)).measurements
    assert measurement.covariates["hardness"].tolist() == np.repeat(HARDNESS, frequencies).tolist()
    with pytest.raises(ValueError, match="as many as there are groups, conditions"):
        measurement.observing(np.ones(3))


def as_in_pymc(hardness: Any, with_dims: bool = False) -> None:
    with pm.Model(coords={"specimen": np.arange(N)}):
        a, b = pm.Normal("a"), pm.Normal("b")
        values = pm.Data("hardness", hardness) if with_dims else hardness
        mu = a + b * values
        mu = pm.Deterministic("mu", mu, dims="specimen") if with_dims else mu
        prb.Simulator("y", double, pm.LogNormal.dist(mu, 1.0, name="x"), observed=2 * X)


def named_expression() -> None:
    with pm.Model():
        hardness = prb.response.condition("hardness", HARDNESS)
        mu = pm.Deterministic("mu", pm.Normal("a") * hardness)
        prb.Simulator("y", double, pm.LogNormal.dist(mu, 1.0), observed=2 * X)


def two_calls() -> None:
    with pm.Model():
        first, second = (prb.response.condition("hardness", HARDNESS) for _ in range(2))
        x = pm.LogNormal.dist(pm.Normal("a") * first, second)
        prb.Simulator("y", double, x, observed=2 * X)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: as_in_pymc(HARDNESS), r"write hardness = prb.response.condition\('hardness'"),
        (lambda: as_in_pymc(HARDNESS, True), r"write hardness = prb.response.condition"),
        (named_expression, "expected an expression without a name"),
        (two_calls, "got two calls"),
        (
            lambda: build(metric=prb.AreaMetric()),
            "leave metric= out, for the log-likelihood by specimen",
        ),
    ],
)
def test_other_forms_are_refused_with_the_remedy(make: Any, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        make()


def test_a_vector_of_as_many_components_as_specimens_is_an_input() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", shape=N), 1.0)
        prb.Simulator("y", lambda x: x.sum(-1), x, metric=prb.AreaMetric(), observed=2 * X)
    assert len(simulators(model)) == 1
