"""Models that `pymc.do` and `pymc.observe` made of others: calibration and what follows it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator, specimen_log_likelihoods
from prbayes.model.parameters import unconstrained

Y = 2 * np.random.default_rng(0).normal(1.0, 0.3, 25)
METRICS = [None, prb.AreaMetric()]
QUIET: dict[str, Any] = {"progressbar": False}


def double(x: Any) -> Any:
    return 2 * x


def original(metric: prb.Metric | None = None, **options: Any) -> tuple[pm.Model, Any]:
    """Return a model of Y, and its input."""
    if metric is None:
        metric = prb.LogLikelihood(**options)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 0.5), pm.HalfNormal("sigma", 0.5))
        prb.Simulator(
            "y", double, x, metric=metric, observed=Y, propagation=prb.Reweighted(64), **QUIET
        )
    return model, x


def log_likelihood(model: pm.Model, **point: float) -> Floats:
    """Return the log-likelihoods at values of the free variables."""
    evaluator = Evaluator.of(model)
    theta = unconstrained(evaluator.hyperparameters, point)
    return specimen_log_likelihoods(evaluator, theta[None])["y"][0]


def test_a_fixed_share_of_gross_errors_has_its_value() -> None:
    model, _ = original(error=0.1, gross_errors=True)
    fixed = log_likelihood(pm.do(model, {"y_gross_errors": 0.2}), mu=1.1, sigma=0.25)
    free = log_likelihood(model, mu=1.1, sigma=0.25, y_gross_errors=0.2)
    np.testing.assert_allclose(fixed, free, atol=0.03)


def test_the_first_model_keeps_its_points() -> None:
    model, _ = original()
    wide = log_likelihood(model, mu=1.0, sigma=0.4)
    log_likelihood(pm.do(model, {"sigma": 0.01}), mu=1.0)
    np.testing.assert_array_equal(log_likelihood(model, mu=1.0, sigma=0.4), wide)


@pytest.mark.long
@pytest.mark.parametrize("metric", METRICS)
def test_what_follows_a_calibration_takes_the_inputs_of_the_first_model(metric: Any) -> None:
    model, x = original(metric)
    fixed = pm.do(model, {"sigma": 0.3})
    optimum = prb.minimize(fixed, **QUIET)
    assert list(optimum.point) == ["mu"]
    assert optimum.point["mu"] == pytest.approx(Y.mean() / 2, abs=0.05)
    posterior = prb.sample(model=fixed, optimum=optimum, draws=100, random_seed=1, **QUIET)
    for result in (optimum, posterior):
        predicted = prb.predict(result, double, x, model=fixed, stored=False, n_draws=20)
        # 500 specimens of each of 1 or 20 populations: a standard error of .03 or less
        spread = float(predicted.std("sample").mean())
        assert spread == pytest.approx(0.6, abs=0.13)
        assert float(prb.exceedance(result, double, 2.6, x, model=fixed).probability) < 0.5
        assert prb.population(result, model=fixed).sel(quantity="sd")["estimate"].values == (
            pytest.approx(0.3, abs=1e-3)
        )
        assert prb.diagnose(result, model=fixed).ok
    table = prb.compare({"optimum": optimum, "posterior": posterior}, model=fixed)
    assert table.hyperparameter.values.tolist() == ["mu"]
    if metric is None:
        drawn = prb.individuals(posterior, model=fixed, n_draws=20)["posterior"]["x"]
        np.testing.assert_allclose(drawn.mean(("chain", "draw")), Y / 2, atol=1e-3)


def test_do_of_an_expression_is_refused_since_simulators_do_not_see_it() -> None:
    with pm.Model() as model:
        half = pm.Deterministic("half", pm.Normal("mu", 2, 1) / 2)
        prb.Simulator("y", double, pm.Normal.dist(half, 0.3), observed=Y)
    with pytest.raises(ValueError, match=r"got pm\.do of half, an expression in the parameters"):
        prb.minimize(pm.do(model, {"half": 1.0}))


def test_a_model_without_free_variables_is_refused() -> None:
    fixed = pm.do(original()[0], {"mu": 1.0, "sigma": 0.3})
    with pytest.raises(ValueError, match="got no free variable, expected one at least"):
        prb.minimize(fixed)


def test_a_model_in_place_of_a_result_is_named() -> None:
    model, x = original()
    message = "got a Model, expected a result of prb.minimize or prb.sample; pass the model as"
    calls: list[Callable[[], Any]] = [
        lambda: prb.exceedance(model, double, 1.0, x),  # type: ignore[arg-type]
        lambda: prb.individuals(model),  # type: ignore[arg-type]
        lambda: prb.predict(model, double, x),  # type: ignore[arg-type]
        lambda: prb.population(model),  # type: ignore[arg-type]
        lambda: prb.compare(model),  # type: ignore[arg-type]
        lambda: prb.compare({"first": model}),  # type: ignore[dict-item]
        lambda: prb.diagnose(model),  # type: ignore[arg-type]
    ]
    for call in calls:
        with pytest.raises(TypeError, match=message):
            call()
