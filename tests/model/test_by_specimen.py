"""Functions and records of each specimen's own."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal, norm

import prbayes as prb
from prbayes.model.measurement import SpecimenLikelihood, observing
from prbayes.model.specimen_likelihood import log_likelihoods, specimen_likelihoods
from prbayes.model.specimen_preparation import prepared
from prbayes.response.by_specimen import BySpecimen
from prbayes.response.compile import PLAIN

RNG = np.random.default_rng(4)
N = 12
X = RNG.normal(1.0, 0.2, N)
SLOPES = np.linspace(0.5, 2.0, N)
ERROR = 0.2
TIMES = [RNG.uniform(0.0, 3.0, 1 + row % 3).round(1) for row in range(N)]
TIMES[2] = np.array([1.0, 1.0, 2.0])  # two readings at the same time
RECORDS = [{"time": times} for times in TIMES]
THETAS = {
    "mu": np.array([1.0, 0.9, 1.2]),
    "sigma": np.array([0.3, 0.4, 0.25]),
    "rise": np.array([0.5, 0.4, 0.6]),
    "error": np.array([0.2, 0.25, 0.18]),
}


class Power:
    """The function of one specimen."""

    def __init__(self, slope: float) -> None:
        self.slope = slope

    def __call__(self, x: Any) -> Any:
        return np.exp(self.slope * np.asarray(x))


def line(x: Any, rise: Any, record: dict[str, Any]) -> Any:
    """Return readings of a line at the times of a record."""
    x, rise = (np.asarray(v)[..., None] for v in (x, rise))
    return x + rise * record["time"]


def padded(rows: list[Any]) -> NDArray[np.float64]:
    """Return rows filled up with NaN."""
    result = np.full((len(rows), max(map(len, rows))), np.nan)
    for row, values in zip(result, rows, strict=True):
        row[: len(values)] = values
    return result


READINGS = padded(
    [
        line(x, 0.5, r) + RNG.normal(0, ERROR, len(r["time"]))
        for x, r in zip(X, RECORDS, strict=True)
    ]
)


def functions() -> BySpecimen:
    """Return a response with a function for each specimen."""
    return prb.response.by_specimen([Power(slope) for slope in SLOPES])


def model_of_functions(response: Any = None, **arguments: Any) -> pm.Model:
    """Return a model of one input that exact readings determine."""
    arguments.setdefault("observed", np.exp(SLOPES * X))
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1.0, 0.5), pm.HalfNormal("sigma", 0.5))
        prb.Simulator("y", functions() if response is None else response, x, **arguments)
    return model


def model_of_lines(response: Any = None, error: float | None = ERROR, **arguments: Any) -> pm.Model:
    """Return a model of two inputs with one to three readings of each specimen."""
    arguments.setdefault("observed", READINGS)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1.0, 0.5), pm.LogNormal("sigma", -1.2, 0.4))
        rise = pm.Normal.dist(pm.Normal("rise", 0.5, 0.3), 0.2)
        scatter = pm.LogNormal("error", np.log(0.2), 0.2) if error is None else error
        response = prb.response.by_specimen(line, RECORDS) if response is None else response
        arguments.setdefault("metric", prb.LogLikelihood(error=scatter))
        prb.Simulator("y", response, x, rise, **arguments)
    return model


def likelihood_of(model: pm.Model) -> SpecimenLikelihood:
    """Return the likelihood of a model with one simulator."""
    (likelihood,) = specimen_likelihoods(model).values()
    likelihood.cache["keep"] = model
    return likelihood


def exact_log_likelihoods(values: dict[str, Any]) -> NDArray[np.float64]:
    """Return the exact log-likelihood of each specimen of lines, (3, N)."""
    result = np.empty((3, N))
    for k in range(3):
        theta = {name: array[k] for name, array in values.items()}
        for row, times in enumerate(TIMES):
            mean = theta["mu"] + theta["rise"] * times
            covariance = theta["sigma"] ** 2 + 0.2**2 * np.outer(times, times)
            covariance = covariance + theta["error"] ** 2 * np.eye(len(times))
            readings = READINGS[row, : len(times)]
            result[k, row] = multivariate_normal.logpdf(readings, mean, covariance)
    return result


@pytest.mark.parametrize("propagation", [None, prb.Resimulated()])
def test_each_specimen_has_the_likelihood_of_its_function(propagation: Any) -> None:
    likelihood = likelihood_of(model_of_functions(propagation=propagation))
    values = {name: THETAS[name] for name in ("mu", "sigma")}
    got = log_likelihoods(likelihood, values)
    expected = norm.logpdf(X, values["mu"][:, None], values["sigma"][:, None])
    expected -= np.log(SLOPES) + SLOPES * X  # dx / dy
    np.testing.assert_allclose(got, expected, atol=0.04)
    np.testing.assert_allclose(got - got[0], expected - expected[0], atol=0.01)


@pytest.mark.parametrize("form", ["index", "levels", "column"])
@pytest.mark.parametrize("given", ["functions", "condition"])
def test_groups_and_labels_are_read_from_pandas(form: str, given: str) -> None:
    names = ["a" if row % 3 else "b" for row in range(N)]
    labels = [f"no. {row}" for row in range(N)]
    index = pd.Index(names, name="rig")
    if form == "levels":
        index = pd.MultiIndex.from_arrays([labels, names], names=["bar", "rig"])
    table = pd.DataFrame(np.exp(np.outer(X, [1.0, 2.0])), index)
    if form == "column":
        table = table.reset_index(drop=True).assign(rig=names)

    def curve(x: Any, t: Any) -> Any:
        return np.exp(np.asarray(x)[..., None] * t)

    with pm.Model(coords={"rig": ["a", "b"]}) as model:
        mu = pm.Normal("mu", 1.0, 0.5, dims="rig")
        inputs = [pm.Normal.dist(mu[prb.response.group("rig")], 0.3)]
        if given == "condition":
            inputs.append(prb.response.condition("t", np.tile([1.0, 2.0], (N, 1))))
            response: Any = curve
        else:
            response = prb.response.by_specimen(curve, [np.array([1.0, 2.0])] * N)
        prb.Simulator("y", response, *inputs, observed=table)
    (likelihood,) = specimen_likelihoods(model).values()
    for group, (_, rows) in zip("ab", likelihood.by_group, strict=True):
        assert [names[row] for row in rows] == [group] * len(rows)


def test_a_named_index_labels_the_specimens() -> None:
    labels = [f"no. {row}" for row in range(N)]
    index = pd.Index(labels, name="bar")
    model = model_of_functions(observed=pd.Series(np.exp(SLOPES * X), index))
    (measurement,) = likelihood_of(model).measurements
    assert measurement.outputs.names == tuple(labels)


def test_records_with_readings_in_different_numbers_have_their_exact_likelihood() -> None:
    likelihood = likelihood_of(model_of_lines(error=None))
    exact = exact_log_likelihoods(THETAS)
    got = log_likelihoods(likelihood, THETAS)
    # The guard allows a Monte Carlo error of .05 nats of the sum over specimens.
    np.testing.assert_allclose(got, exact, atol=0.06)
    np.testing.assert_allclose((got - got[0]).sum(axis=1), (exact - exact[0]).sum(axis=1), atol=0.1)
    assert likelihood.cache["preparation"].points.outputs.shape[2] == 3
    assert likelihood.cache["preparation"].proposals.linear.is_used.all()


@pytest.mark.long
def test_optimum_prediction_and_individuals() -> None:
    model = model_of_functions()
    optimum = prb.minimize(model)
    assert abs(optimum.point["mu"] - X.mean()) < 1e-3
    assert abs(optimum.point["sigma"] / X.std() - 1) < 5e-3
    x = likelihood_of(model).inputs.aleatory[0]
    new = prb.response.by_specimen([Power(0.5), Power(1.0), Power(2.0)])
    predicted = prb.predict(optimum, new, x, model=model, n_samples=4000, random_seed=1)
    medians = predicted.squeeze().median("sample")
    np.testing.assert_allclose(
        np.log(medians), optimum.point["mu"] * np.array([0.5, 1, 2]), atol=0.05
    )
    assert prb.diagnose(optimum)  # from synthetic data of each specimen's function
    subjects = prb.individuals(optimum)
    np.testing.assert_allclose(subjects["posterior"]["x"].mean(("chain", "draw")), X, atol=1e-3)
    with pytest.raises(ValueError, match="as many as there are groups, conditions, records"):
        observing(likelihood_of(model).measurements[0], np.ones((2, N)))


def test_a_changed_record_is_noticed() -> None:
    records = [{"slope": slope} for slope in SLOPES]

    def power(x: Any, record: dict[str, float]) -> Any:
        return np.exp(record["slope"] * x)

    model = model_of_functions(prb.response.by_specimen(power, records))
    model.compile_logp(mode=PLAIN)
    records[3]["slope"] = 1.7
    with pytest.raises(prb.response.ResponseError, match="slope has changed since"):
        prb.minimize(model)


def test_functions_are_vectorised_wrapped_and_stored_alike(tmp_path: Path) -> None:
    x = np.linspace(0.5, 1.5, 4)
    expected = np.exp(x[:, None] * SLOPES)
    numbers = prb.response.by_specimen([prb.scalar(Power(slope)) for slope in SLOPES])
    for response in (functions(), numbers, prb.scalar(functions())):
        np.testing.assert_allclose(response(x), expected)
    by_record = prb.response.by_specimen(prb.scalar(line), RECORDS[:2])
    np.testing.assert_allclose(
        by_record(x, 0.5), np.concatenate([line(x, 0.5, r) for r in RECORDS[:2]], axis=-1)
    )
    copy = pickle.loads(pickle.dumps(functions()))
    np.testing.assert_allclose(copy(x), expected)
    settings = prb.Reweighted(store=tmp_path / "runs")
    model = model_of_functions(prb.scalar(functions()), propagation=settings)
    again = model_of_functions(prb.scalar(functions()), propagation=settings)
    emulations = [prepared(likelihood_of(m)).emulation for m in (model, again)]
    np.testing.assert_array_equal(emulations[0].y, emulations[1].y)
    simulator = likelihood_of(again).measurements[0].responses
    assert simulator.computed <= 3  # a few are repeated, in case the function has changed


def test_equal_functions_have_common_outputs() -> None:
    power = Power(1.0)
    response = prb.response.by_specimen([power] * (N - 1) + [Power(2.0)])
    likelihood = likelihood_of(model_of_functions(response))
    assert likelihood.readings.values.shape == (N, 2)
    assert np.isnan(likelihood.readings.values[:-1, 1]).all()
    assert response.label(0) == "function of specimen 0, 1, 2, ..."


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"observed": READINGS[:-1]}, "got 11 rows, and functions or records of 12 specimens"),
        ({"observed": {"y": READINGS[:, 0]}}, "padded with NaN"),
        ({"observed": np.where(np.arange(N)[:, None] == 5, np.nan, READINGS)}, "in row 5"),
        ({"metric": prb.AreaMetric()}, "compares specimens with the same function"),
        ({"metric": prb.LogLikelihood(error=ERROR, selected=(-9.0, None))}, "leave selected= out"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        model_of_lines(**arguments)


def test_times_and_records_are_not_combined() -> None:
    times = prb.response.condition("time", np.arange(N * 2.0).reshape(N, 2))
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        with pytest.raises(TypeError, match="put the values into the records"):
            prb.Simulator("y", functions(), x, times, observed=READINGS[:, :2])


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x, rise, r: line(x, rise, r)[..., :0], "function of specimen 0 returned shape"),
        (
            lambda x, rise, r: line(x[: 9 - len(r["time"])], 0.5, r),
            "function of specimen 1 returned",
        ),
        (lambda x, rise, r: line(x, rise, r["none"]), "function of specimen 0: KeyError: 'none'"),
    ],
)
def test_a_function_that_fails_is_named(function: Any, message: str) -> None:
    model = model_of_lines(prb.response.by_specimen(function, RECORDS))
    with pytest.raises(prb.response.ResponseError, match=message):
        prb.minimize(model)


def test_one_reading_takes_one_number() -> None:
    model = model_of_functions(prb.response.by_specimen([lambda x: np.stack([x, x], -1)] * N))
    with pytest.raises(prb.response.ResponseError, match="expected one number for each point"):
        prb.minimize(model)


def test_a_function_without_a_response_for_likely_inputs_is_refused() -> None:
    def gap(x: Any) -> Any:
        return np.where(np.asarray(x) > 1.0, np.nan, np.exp(x))

    model = model_of_functions(prb.response.by_specimen([gap, *(Power(s) for s in SLOPES[1:])]))
    with pytest.raises(prb.propagation.DesignError, match="where one of them returns NaN"):
        prb.minimize(model)
