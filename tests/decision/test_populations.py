"""Stored responses as populations of a result."""

import inspect
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
from decisions import OBSERVED, doubled, normal, optimum, posterior, same
from scipy.special import ndtri

import prbayes as prb
from prbayes.decision.populations import (
    InverseTransform,
    Populations,
    checked_quantity,
    output_column,
)
from prbayes.response.inputs import read_inputs
from prbayes.response.outputs import Outputs
from prbayes.response.response import Responses


def populations(result: Any, n: int = 100) -> Populations:
    return Populations.of(result, normal()[0], n, "prb.sensitivity")


def test_a_normal_population_has_its_mean_spread_and_tail() -> None:
    _, x = normal()
    found = populations(posterior(), 500)
    sample = found.sample(lambda x: 2 * x, (x,), None)
    mu, sigma = found.thetas[:, 0], np.exp(found.thetas[:, 1])
    for quantity, expected in (
        (prb.decision.Mean(doubled, x), 2 * mu),
        (prb.decision.StandardDeviation(doubled, x), 2 * sigma),
        (prb.decision.Quantile(doubled, x, probability=0.8), 2 * (mu + 0.8416 * sigma)),
    ):
        np.testing.assert_allclose(sample.evaluate(quantity.of, found.thetas), expected, atol=0.02)
    # Known responses are reused.
    assert sample.responses.count == sample.design.n_runs
    again = found.sample(sample.responses.function, (x,), None)
    assert again.responses.count == 0


def test_a_tail_of_few_points_is_reported_and_one_of_none_refused() -> None:
    _, x = normal()
    found = populations(posterior(), 500)

    def findings(response: Any, quantity: Any, **options: Any) -> Any:
        sample = found.sample(response, (x,), None)
        return checked_quantity(sample, quantity(response, x, **options))[0]

    def scattered(x: Any) -> Any:
        return np.sin(1e4 * x)

    # One response in 200 is above: some points of 300, wherever they are.
    (finding,) = findings(scattered, prb.decision.Exceedance, limit=np.cos(np.pi / 200))
    assert finding.code == "rough-probability"
    assert findings(scattered, prb.decision.Exceedance, limit=0.5) == ()
    assert findings(doubled, prb.decision.Quantile, probability=0.99) == ()
    assert findings(doubled, prb.decision.Mean) == ()
    # A largest response that is a limit is known, and one that is the last point is not.
    assert findings(np.tanh, prb.decision.Quantile, probability=0.99) == ()
    assert findings(lambda x: np.minimum(x, 1), prb.decision.Quantile, probability=0.99) == ()
    assert len(findings(scattered, prb.decision.Quantile, probability=1 - 1e-9)) == 1
    # The rarer side counts: a low quantile, and a probability near one.
    assert len(findings(scattered, prb.decision.Quantile, probability=1e-9)) == 1
    assert findings(doubled, prb.decision.Quantile, probability=0.01) == ()
    (finding,) = findings(scattered, prb.decision.Exceedance, limit=-np.cos(np.pi / 200))
    assert "on its other side, 0.00" in finding.text
    with pytest.raises(ValueError, match=r"got no response beyond it, of \d+ effective points"):
        findings(doubled, prb.decision.Exceedance, limit=99.0)
    with pytest.raises(ValueError, match="got no response on its other side, of"):
        findings(doubled, prb.decision.Exceedance, limit=-99.0)


def test_quantities_have_the_error_of_their_computation() -> None:
    _, x = normal()
    found = populations(posterior(), 500)
    sample = found.sample(doubled, (x,), None)
    mu, sigma = found.center[0], np.exp(found.center[1])
    for quantity, expected in (
        (prb.decision.Mean(doubled, x), 2 * mu),
        (prb.decision.StandardDeviation(doubled, x), 2 * sigma),
        (prb.decision.Exceedance(doubled, x, limit=2 * mu), 0.5),
        *(
            (prb.decision.Quantile(doubled, x, probability=p), 2 * (mu + sigma * z))
            for p, z in ((1e-6, -4.7534), (0.01, -2.3263), (0.99, 2.3263), (1 - 1e-6, 4.7534))
        ),
    ):
        (value,) = sample.evaluate(quantity.of, found.center[None])
        _, error = checked_quantity(sample, quantity)
        assert abs(value - expected) < 3 * error < 1.5


def test_an_optimum_is_its_sampling_distribution() -> None:
    found = Populations.of(optimum(), None, 4000, "prb.sensitivity")
    np.testing.assert_allclose(found.center, optimum().theta)
    np.testing.assert_allclose(np.cov(found.thetas.T), optimum().covariance, rtol=0.03, atol=1e-5)
    assert found.evaluator.model is normal()[0]


def test_lost_responses_are_refused() -> None:
    _, x = normal()
    found = populations(posterior())
    sample = found.sample(lambda x: np.where(x > 3.5, np.nan, x), (x,), None)
    np.testing.assert_allclose(sample.weights(found.thetas).sum(axis=1), 1.0)
    with pytest.raises(prb.propagation.DesignError, match="lost mass"):
        found.sample(lambda x: np.where(x > 1.0, np.nan, x), (x,), None)
    broken = found.sample(lambda x: np.where(x > 1.0, np.inf, x), (x,), None)
    with pytest.raises(ValueError, match=r"got specimens that failed \(\+inf\)"):
        checked_quantity(broken, prb.decision.Mean(same, x))
    checked_quantity(broken, prb.decision.Exceedance(same, x, limit=1.0))


def test_an_output_is_found_by_label_or_name() -> None:
    responses = populations(optimum()).responses(same, (normal()[1],))
    values = np.zeros((3, 2))
    responses.outputs = Outputs((60.0, 120.0))
    assert output_column(responses, values, 120) == output_column(responses, values, "120") == 1
    for columns, output, message in (
        (values, "length", "expected one of"),
        (values, None, "expected output= to say which"),
        (values[:, 0], 0, "leave output= out"),
    ):
        with pytest.raises((KeyError, ValueError), match=message):
            output_column(responses, columns, output)


def test_normal_numbers_become_inputs_by_their_distribution_functions() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu")
        x = pm.Normal.dist(mu, 2.0)
        v = pm.MvNormal.dist(mu * np.ones(2), chol=np.array([[1.0, 0.0], [0.6, 0.8]]))
        u, count = pm.Uniform.dist(0.0, 1.0), pm.Poisson.dist(pm.HalfNormal("b"))
    transform = InverseTransform("f", read_inputs("f", [x, v, u], model), [np.array([3.0])])
    assert transform.size == 4
    z = np.random.default_rng(0).normal(size=(50, 4))
    a, b, c = transform(z)
    np.testing.assert_allclose(a, 3 + 2 * z[:, 0], rtol=1e-9)
    np.testing.assert_allclose(b[:, 1], 3 + 0.6 * z[:, 1] + 0.8 * z[:, 2], rtol=1e-9)
    assert ((c > 0) == (c < 1)).all()
    assert (np.argsort(c) == np.argsort(z[:, 3])).all()
    # A response takes its inputs in its order.
    responses = Responses("g", lambda u, x: x - u, read_inputs("g", [u, x], model))
    np.testing.assert_allclose(transform.responses(responses, z), a - c)
    with pytest.raises(TypeError, match="discrete"):
        InverseTransform("f", read_inputs("f", [count], model), [np.ones(1)])


def calling_functions() -> dict[str, Callable[..., Any]]:
    """Return calls that compute a response of the user, by the name of the function."""
    _, x = normal()
    condition = prb.decision.Condition

    def tested(f: Any, **options: Any) -> Any:
        predicted = prb.predict(optimum(), np.positive, x, name="own")
        null = prb.validation.JointNull(optimum(), responses=(f, x), replicates=19, **options)
        return prb.area_test(OBSERVED, predicted, null=null)

    return {
        "predict": lambda f, **o: prb.predict(optimum(), f, x, n_samples=50, **o),
        "exceedance": lambda f, **o: prb.exceedance(optimum(), f, 1.0, x, **o),
        "decision.p_box": lambda f, **o: prb.decision.p_box(optimum(), f, x, n_draws=20, **o),
        "decision.evaluate": lambda f, **o: prb.decision.evaluate(
            optimum(), prb.decision.Mean(f, x), n_draws=20, **o
        ),
        "sensitivity": lambda f, **o: prb.sensitivity(
            optimum(), prb.decision.Mean(f, x), n_points=64, **o
        ),
        "plan": lambda f, **o: prb.plan(optimum(), {"a": condition(f, x)}, k=5, **o),
        "population": lambda f, **o: prb.population(optimum(), condition(f, x), n_draws=20, **o),
        "validation.JointNull": tested,
        "Surrogate.fit": lambda f, **o: prb.Surrogate.fit(f, {"x": (0, 1)}, 16, name="own", **o),
    }


CALLING = calling_functions()


def public(name: str) -> Any:
    return reduce(getattr, name.split("."), prb)


@pytest.mark.parametrize("name", CALLING)
def test_a_store_and_an_executor_are_taken_wherever_a_response_is_computed(
    name: str, tmp_path: Path
) -> None:
    def own(x: Any) -> Any:
        return np.positive(x)

    with ThreadPoolExecutor(1) as executor:
        CALLING[name](own, executor=executor, store=tmp_path, version="1")
    assert len(prb.response.Store(tmp_path, "own", columns=1, version="1", outputs=1)) > 0
    with pytest.raises(TypeError, match=r"executor: got int 3"):
        CALLING[name](own, executor=3)
    if name not in ("Surrogate.fit", "validation.JointNull"):  # they have names of their own
        with pytest.raises(ValueError, match="store: got a function called <lambda>, expected a"):
            CALLING[name](lambda x: x, store=tmp_path)


def test_where_a_response_is_computed_is_documented_alike() -> None:
    sentences = []
    for name in CALLING:
        names = list(inspect.signature(public(name)).parameters)
        first = names.index("executor")
        assert names[first : first + 3] == ["executor", "store", "version"], name
        if name == "Surrogate.fit":  # all settings of a propagation
            continue
        text = str(public(name).__doc__)
        sentences.append(text[text.index("executor : ") : text.index("as for `Reweighted`.")])
    assert len({" ".join(s.split()) for s in sentences}) == 1


def test_a_function_inside_scalar_has_its_name(tmp_path: Path) -> None:
    _, x = normal()

    def cube(x: Any) -> Any:
        return x**3

    predicted = prb.predict(optimum(), prb.scalar(cube), x, n_samples=50, store=tmp_path)
    assert predicted.name == "cube"


def test_a_quantity_has_the_value_and_interval_of_its_draws() -> None:
    model, x = normal()
    quantity = prb.decision.Quantile(doubled, x, probability=0.8)
    table = prb.decision.evaluate(posterior(), quantity, model=model, prob=0.9, n_draws=500)
    found = populations(posterior(), 500)
    exact = 2 * (found.thetas[:, 0] + 0.8416 * np.exp(found.thetas[:, 1]))
    assert float(table.estimate) == pytest.approx(exact.mean(), abs=0.02)
    np.testing.assert_allclose(
        [table.lower, table.upper], np.quantile(exact, [0.05, 0.95]), atol=0.02
    )
    assert str(table).startswith(f"80% quantile of doubled: {float(table.estimate):.4g}, 90% int")
    at_optimum = prb.decision.evaluate(optimum(), quantity)
    shares = prb.sensitivity(optimum(), quantity, n_points=64)
    assert float(at_optimum.estimate) == pytest.approx(shares.attrs["value"])
    assert float(at_optimum.error) == pytest.approx(shares.attrs["value_error"], rel=1e-3)
    with pytest.raises(TypeError, match=r"prb.decision.evaluate: quantity: got"):
        prb.decision.evaluate(posterior(), doubled, model=model)  # type: ignore[arg-type]


def ends_beyond(limit: float) -> Any:
    """Return a response that is infinite beyond a limit: the specimen has failed."""
    return lambda x: np.where(x > limit, np.inf, x)


def test_a_quantity_that_is_infinite_at_some_draws() -> None:
    model, x = normal()
    upper = np.quantile(at_draws(0.99), 0.94)
    quantity = prb.decision.Quantile(ends_beyond(upper), x, probability=0.99)
    table = prb.decision.evaluate(posterior(), quantity, model=model, prob=0.9)
    assert float(table.upper) == np.inf
    assert float(table.lower) == pytest.approx(np.quantile(at_draws(0.99), 0.05), rel=0.02)
    after = prb.decision.Condition(ends_beyond(upper), x)
    table = prb.population(posterior(), after, model=model, upper=True)
    assert float(table.estimate.sel(quantity="A-basis").item()) == np.inf


def test_the_spread_of_a_quantity_that_is_infinite_at_a_few_draws() -> None:
    model, x = normal()
    limit = np.quantile(at_draws(0.95), 0.998)
    quantity = prb.decision.Quantile(ends_beyond(limit), x, probability=0.95)
    table = prb.sensitivity(posterior(), quantity, model=model, n_points=64)
    assert table.attrs["sd"] == np.inf
    assert "infinite at some draws" in str(table)


def at_draws(probability: float) -> Any:
    """Return the quantile of the normal population at each draw."""
    draws = posterior().posterior
    return (draws["mu"] + ndtri(probability) * draws["sigma"]).values
