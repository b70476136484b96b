"""Covariates: populations that depend on a known value of each specimen."""

from __future__ import annotations

from collections.abc import Callable
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
from prbayes.model.measurement import observing
from prbayes.model.random_variable import simulators

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


@pytest.fixture(scope="module")
def model() -> pm.Model:
    return build()


@pytest.fixture(scope="module")
def posterior(model: pm.Model) -> xr.DataTree:
    return prb.sample(500, model=model, chains=2, random_seed=1, progressbar=False)


def require_log_likelihood(
    evaluator: Evaluator, exact: Callable[[dict[str, Any]], Any], error: float
) -> None:
    """Require log-likelihoods of specimens, (S, N), at plausible points of the prior."""
    thetas = evaluator.hyperparameters.prior_thetas(30, 0)
    expected = exact(evaluator.hyperparameters.constrained(thetas))
    logs = specimen_log_likelihoods(evaluator, thetas)["y"]
    is_plausible = expected.sum(axis=1) > expected.sum(axis=1).max() - 20
    assert np.abs(logs - expected)[is_plausible].max() < error


def test_a_log_likelihood_is_that_of_the_population_of_each_specimen(model: pm.Model) -> None:
    def exact(values: dict[str, Any]) -> Any:
        return stats.norm.logpdf(X, means(values), values["sigma"][:, None]) - np.log(2)

    evaluator = Evaluator.of(model)
    require_log_likelihood(evaluator, exact, 0.02)
    thetas = evaluator.hyperparameters.prior_thetas(30, 0)
    logs = specimen_log_likelihoods(evaluator, thetas)["y"]
    (graph,) = evaluator.hyperparameters.compile(specimen_graphs(evaluator))(thetas)
    assert np.allclose(graph, logs, atol=1e-9)


def test_groups_and_covariates_go_together() -> None:
    makers = np.array(["A", "B"] * (N // 2))

    def exact(values: dict[str, Any]) -> Any:
        a = values["a"][:, (makers == "B").astype(int)]
        return stats.norm.logpdf(X, means(values, a), values["sigma"][:, None]) - np.log(2)

    model = build(observed=labelled(2 * X, makers), group=True)
    require_log_likelihood(Evaluator.of(model), exact, 0.02)


def test_specimens_with_fewer_readings_than_inputs_have_their_own_population() -> None:
    with pm.Model() as model:
        a = pm.Normal("a", 1, 0.3)
        b = pm.Normal("b", 0.01, 0.003)
        covariate = prb.response.condition("hardness", HARDNESS)
        x = pm.Normal.dist(a + b * (covariate - 250.0), 0.2)
        z = pm.Normal.dist(0, 0.3)
        prb.Simulator("y", lambda x, z: x + z, x, z, observed=X + 0.3 * NOISE[1])

    def exact(values: dict[str, Any]) -> Any:
        return stats.norm.logpdf(X + 0.3 * NOISE[1], means(values), np.hypot(0.2, 0.3))

    require_log_likelihood(Evaluator.of(model), exact, 0.15)


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
    for given in (None, {"load": 1.0}, 3.0, {"hardness": 400}, {"hardness": "high"}):
        with pytest.raises((TypeError, ValueError), match=r"at: .*got"):
            prb.predict(posterior, double, x, model=model, at=given)
    with pytest.raises(TypeError, match=r"expected a \.dist\(\) with a value of it"):
        prb.exceedance(posterior, double, 3.0, x, model=model)


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

    def exact(values: dict[str, Any]) -> Any:
        return stats.norm.logpdf(X, means(values), 0.2) - np.log(HARDNESS / 100)

    require_log_likelihood(Evaluator.of(model), exact, 0.05)
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
        observing(measurement, np.ones(3))


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
