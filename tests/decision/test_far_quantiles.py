"""Far quantiles of emulated populations beside the closed form in each population."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
from one_input import posterior_of
from scipy import stats

import prbayes as prb
from prbayes._finding import from_json

DRAWS = 2000


def reference_draws(rng: Any, data: Any) -> tuple[Any, Any]:
    """Return draws of mean and standard deviation of a normal population, by the reference prior."""
    n = len(data)
    sd = data.std(ddof=1) * np.sqrt((n - 1) / rng.chisquare(n - 1, DRAWS))
    return rng.normal(data.mean(), sd / np.sqrt(n)), sd


def problem(n: int, n_inputs: int, *, is_log: bool, known: bool) -> Any:
    """Return the model, inputs, posterior, and mean and sd of the (log) sum."""
    rng = np.random.default_rng(n + n_inputs)
    data = rng.normal(2.0, 0.5, (n_inputs, n))
    inputs, draws = [], {}
    center, variance = np.zeros((2, DRAWS))
    with pm.Model() as model:
        for name, x in zip("ab", data, strict=False):
            mean, sd = reference_draws(rng, x)
            if known:
                mean, sd = rng.normal(x.mean(), 0.5 / np.sqrt(n), DRAWS), np.full(DRAWS, 0.5)
            family = pm.LogNormal if is_log else pm.Normal
            sigma = 0.5 if known else pm.HalfNormal(f"sd {name}", 2.0)
            inputs.append(family.dist(pm.Normal(f"mean {name}", 0.0, 3.0), sigma, name=name))
            draws |= {f"mean {name}": mean} | ({} if known else {f"sd {name}": sd})
            center, variance = center + mean, variance + sd**2
        values = np.exp(data) if is_log else data
        prb.Simulator("y", outputs, *inputs, observed=outputs(*values))
    posterior = posterior_of(**{name: x[None] for name, x in draws.items()})
    return model, inputs, posterior, center, np.sqrt(variance)


def outputs(*inputs: Any) -> Any:
    return inputs[0] if len(inputs) == 1 else np.stack(inputs, axis=-1)


def total(*inputs: Any) -> Any:
    return sum(inputs)


def log_total(*inputs: Any) -> Any:
    return sum(map(np.log, inputs))


def assert_close(table: Any, exact: Any) -> None:
    """Compare mean and interval with those of exact draws, in their standard deviation.

    The standard error is .02 with 25 specimens, and .06 with 400 of two inputs.
    """
    expected = [exact.mean(), *np.quantile(exact, [0.055, 0.945])]
    found = [table.estimate, table.lower, table.upper]
    np.testing.assert_allclose(found, expected, atol=0.25 * exact.std())


@pytest.mark.long
@pytest.mark.parametrize(
    ("n", "n_inputs", "is_log", "known"),
    [
        (25, 1, False, False),
        (400, 1, False, True),
        (400, 1, True, False),
        (25, 2, True, False),
        (400, 2, False, False),
    ],
)
def test_quantiles_of_a_population(n: int, n_inputs: int, is_log: bool, known: bool) -> None:
    model, inputs, posterior, center, sd = problem(n, n_inputs, is_log=is_log, known=known)
    response = log_total if is_log else total
    for probability in (0.95, 0.99, 0.999):
        quantity = prb.decision.Quantile(response, *inputs, probability=probability)
        table = prb.decision.evaluate(posterior, quantity, model=model)
        exact = center + stats.norm.ppf(probability) * sd
        assert_close(table, exact)
        assert float(table.by_draw.std()) == pytest.approx(exact.std(), rel=0.12)


@pytest.mark.long
def test_population_tables_and_plans_have_far_quantiles() -> None:
    model, inputs, posterior, center, sd = problem(25, 1, is_log=False, known=False)
    condition = prb.decision.Condition(total, *inputs)
    table = prb.population(posterior, condition, model=model, quantiles=[0.001, 0.99], upper=True)
    for probability in (0.001, 0.99):
        exact = center + stats.norm.ppf(probability) * sd
        assert_close(table.sel(name="total", quantity=f"{100 * probability:g}% quantile"), exact)
    a_basis = float(table.estimate.sel(name="total", quantity="A-basis"))
    assert a_basis == pytest.approx(np.quantile(exact, 0.95), abs=0.1 * exact.std())
    quantity = prb.decision.Quantile(total, *inputs, probability=0.99)
    plan = prb.plan(posterior, {"same": condition}, k=5, model=model, quantity=quantity)
    assert float(plan.now.sel(name="quantity")) == pytest.approx(exact.std(), rel=0.05)


def ratio(*inputs: Any) -> Any:
    return inputs[0] / (np.abs(inputs[-1]) + 0.2)


def growth(*inputs: Any) -> Any:
    return np.exp(sum(inputs))


def wave(*inputs: Any) -> Any:
    return np.sin(3 * inputs[0]) + inputs[-1] * np.cos(2 * inputs[-1])


@pytest.mark.long
@pytest.mark.parametrize("response", [ratio, growth, wave])
@pytest.mark.parametrize("n_inputs", [1, 2])
def test_another_response_has_runs_in_the_tails(response: Any, n_inputs: int) -> None:
    """Runs for one response lack those that the far quantiles of another one need."""
    model, inputs, posterior, *_ = problem(25, n_inputs, is_log=False, known=False)
    posterior = posterior.isel(draw=slice(None, None, 10))
    draws = {name: x.values.ravel() for name, x in posterior["posterior"].data_vars.items()}
    z = stats.norm.ppf(np.random.default_rng(5).random((2, 100_000)))
    exact = []
    for i in range(DRAWS // 10):
        names = "ab"[:n_inputs]
        values = [
            draws[f"mean {k}"][i] + draws[f"sd {k}"][i] * x for k, x in zip(names, z, strict=False)
        ]
        exact.append(np.quantile(response(*values), 0.99))
    quantile = prb.decision.Quantile(response, *inputs, probability=0.99)
    assert_close(prb.decision.evaluate(posterior, quantile, model=model), np.array(exact))


@pytest.mark.long
@pytest.mark.parametrize(
    "family",
    [
        lambda mu, sd: pm.SkewNormal.dist(mu=mu, sigma=sd, alpha=3.0),
        lambda mu, sd: pm.ExGaussian.dist(mu=mu, sigma=sd, nu=0.5),
        lambda mu, sd: pm.AsymmetricLaplace.dist(kappa=1.0, mu=mu, b=sd),
    ],
)
def test_far_quantiles_without_an_inverse_distribution_function_are_reported(family: Any) -> None:
    with pm.Model() as model:
        x = family(pm.Normal("mu", 0.0, 3.0), pm.HalfNormal("sd", 2.0))
        prb.Simulator("y", total, x, observed=np.random.default_rng(1).normal(2.0, 0.5, 25))
    mean, sd = reference_draws(np.random.default_rng(2), np.linspace(1.0, 3.0, 25))
    posterior = posterior_of(mu=mean[None, ::20], sd=sd[None, ::20])
    for probability, is_reported in ((0.99, True), (0.5, False)):
        quantity = prb.decision.Quantile(total, x, probability=probability)
        table = prb.decision.evaluate(posterior, quantity, model=model)
        codes = {finding.code for finding in from_json(table.attrs["findings"])}
        assert ("rough-probability" in codes) == is_reported
