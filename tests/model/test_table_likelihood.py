"""The log-likelihood by specimen from a table of runs: as from the function, or refused."""

import pickle
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytest
from one_input import one_input

import prbayes as prb
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.model.specimen_preparation import prepared
from prbayes.numerics.points import sobol
from prbayes.propagation.base import DesignError
from prbayes.response import ResponseError
from prbayes.response.compile import PLAIN

RNG = np.random.default_rng(3)
E, T = RNG.normal(70, 4, 24), RNG.normal(2, 0.1, 24)


def stiffness(e: Any, t: Any) -> Any:
    return np.stack(np.broadcast_arrays(e * t, np.sqrt(e) + t), axis=-1)


def table(n: int, low: Any = (50, 1.4), high: Any = (90, 2.6), noise: float = 0.0) -> prb.Runs:
    x = np.array(low) + (np.array(high) - low) * sobol(n, 2, 2)
    values = stiffness(*x.T)
    return prb.Runs({"e": x[:, 0], "t": x[:, 1]}, values + noise * RNG.normal(size=values.shape))


def model_of(response: Any, observed: Any = None, outputs: Any = slice(None)) -> pm.Model:
    data = stiffness(E, T)[:, outputs] if observed is None else observed
    with pm.Model() as model:
        e = pm.Normal.dist(pm.Normal("mu", 70, 5), pm.HalfNormal("sd", 5))
        t = pm.Normal.dist(pm.Normal("mu_t", 2, 0.2), pm.HalfNormal("sd_t", 0.2))
        prb.Simulator("s", response, e, t, observed=data)
    return model


def emulation_of(model: pm.Model) -> Any:
    (likelihood,) = specimen_likelihoods(model).values()
    return prepared(likelihood).emulation


def log_density(model: pm.Model) -> Any:
    function = model.compile_fn(model.observedlogp, inputs=model.value_vars, mode=PLAIN)
    at = model.initial_point()
    if "sd" in model:
        at |= {"sd_log__": 1.4, "mu_t": 2.01, "sd_t_log__": -2.2}
    return [function(at | {"mu": mu}) for mu in (69.5, 70.5)]


@pytest.mark.long
def test_a_table_gives_the_log_likelihood_of_the_function_without_a_run() -> None:
    of_table = model_of(table(64))
    (responses,) = [m.measurements[0].responses for m in specimen_likelihoods(of_table).values()]
    np.testing.assert_allclose(log_density(of_table), log_density(model_of(stiffness)), atol=0.05)
    assert responses.count == 0
    assert prb.cost(of_table).runs == 0
    assert len(emulation_of(of_table).z) == 64
    assert 0 < emulation_of(of_table).bias < 0.15


@pytest.mark.long
def test_a_table_that_ends_within_the_data_is_refused_with_a_proposal() -> None:
    narrow = table(64, high=(70, 2.6))
    model = model_of(narrow)
    beyond = int((narrow.points[:, 0].max() < E).sum())
    message = rf"inputs of {beyond} of 24 specimens.*: about e from 5.* where the runs have 50.* to"
    with pytest.raises(DesignError, match=message):
        log_density(model)
    proposed = prb.propose_runs(model, n=12)
    assert list(proposed) == ["e", "t"]
    assert repr(proposed).startswith("12 proposed runs near the measured responses, 12 of them")
    assert "e from 50" in repr(proposed)
    assert proposed._repr_html_().count("<tr>") == 13
    assert repr(pickle.loads(pickle.dumps(proposed))) == repr(proposed)
    for part in (proposed[["e"]], proposed.head(2), proposed.copy(), proposed.to_dataframe()):
        assert type(part) is pd.DataFrame
    assert (proposed["e"] > narrow.points[:, 0].max()).all()
    # They reproduce the data, and the wider table is accepted.
    values = stiffness(*proposed.to_numpy().T)
    data = stiffness(E, T)
    assert (np.abs(values - data.mean(axis=0)) < 5 * data.std(axis=0)).all()
    x = np.concatenate([narrow.points, prb.propose_runs(model, n=24).to_numpy()])
    wider = model_of(prb.Runs({"e": x[:, 0], "t": x[:, 1]}, stiffness(*x.T)))
    np.testing.assert_allclose(log_density(wider), log_density(model_of(stiffness)), atol=0.3)


def test_points_that_do_not_suffice_beyond_the_table_are_a_table_that_is_too_short(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: Any, **__: Any) -> Any:
        raise DesignError("two halves differ")

    monkeypatch.setattr("prbayes.model.table_likelihood.specimen_points", refuse)
    message = r"likeliest inputs of [34]\d% of the specimens .*where the runs have 50.*propose_runs"
    with pytest.raises(DesignError, match=message):
        log_density(model_of(table(64, high=(70, 2.6))))
    with pytest.raises(DesignError, match=r"^two halves differ$"):
        log_density(model_of(table(64)))


def test_an_inaccurate_table_is_refused_and_runs_near_the_specimens_are_proposed() -> None:
    model = model_of(table(64, noise=0.05))
    with pytest.raises(DesignError, match=r"64 runs with a cross-validated error of 0\.\d"):
        log_density(model)
    proposed = prb.propose_runs(model)
    assert len(proposed) == 16
    assert proposed["e"].between(45, 95).all()


def test_a_table_and_a_prior_without_overlap_are_refused() -> None:
    x = np.linspace(5e4, 9e4, 20)
    runs = prb.Runs({"e": x}, x)
    with pm.Model() as model:
        prb.Simulator("s", runs, pm.Normal.dist(pm.Normal("mu", 70, 5), 2), observed=[6e4, 7e4])
    with pytest.raises(DesignError, match=r"e from 5e\+04 to 9e\+04, and a prior of .* units"):
        log_density(model)


def test_fewer_readings_than_inputs_are_refused_beyond_the_table_too() -> None:
    x = table(64).points
    runs = prb.Runs({"e": x[:, 0], "t": x[:, 1]}, x[:, 0] * x[:, 1])
    with pm.Model() as model:
        e = pm.Normal.dist(pm.Normal("mu", 80, 10), 4)
        prb.Simulator("s", runs, e, pm.Normal.dist(2, 0.1), observed=[190.1, 196.3, 192.7, 187.4])
    with pytest.raises(
        DesignError,
        match=r"of 4 of 4 specimens .* about e from .* to 10.*, where the runs have 50.31 to 89.91; prb",
    ):
        log_density(model)


def test_a_table_beside_a_function_of_the_same_specimens_is_refused() -> None:
    runs = prb.Runs({"x": np.linspace(0, 3, 12)}, np.linspace(0, 3, 12) ** 2)
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.2)
        settings = {"metric": prb.LogLikelihood(error=0.1), "specimens": [0, 1, 2]}
        prb.Simulator("a", lambda x: x + 1, x, observed=[2.0, 2.1, 2.2], **settings)
        with pytest.raises(
            ValueError, match="a table of runs in one and a function in the other of b"
        ):
            prb.Simulator("b", runs, x, observed=[1.0, 1.1, 1.2], **settings)


def test_metrics_refuse_a_population_outside_the_table_and_say_what_to_do() -> None:
    x = np.linspace(0.0, 3.0, 20)
    runs = prb.Runs({"x": x}, np.exp(x))
    data = np.exp(np.random.default_rng(1).normal(2.9, 0.3, 30))
    with pm.Model() as model:
        dist = pm.Normal.dist(pm.Normal("mu", 2, 1), pm.HalfNormal("sd", 0.5))
        prb.Simulator("y", runs, dist, metric=prb.AreaMetric(), observed=data)
    with pytest.raises(
        DesignError, match=r"no run has a finite .* add the runs that prb\.propose_runs"
    ):
        prb.minimize(model, starts=0, progressbar=False)
    assert (prb.propose_runs(model)["x"] > 3).all()
    with pytest.raises(ValueError, match="got a table of no simulator"):
        prb.propose_runs(model, runs=prb.Runs(x, x**2))
    other = one_input(data, prb.AreaMetric(), response=np.exp, mu=(2, 1), sd=1)
    with pytest.raises(ValueError, match="got 0 tables of runs"):
        prb.propose_runs(other)


@pytest.mark.long
def test_predictions_of_a_table_are_nan_outside_and_the_error_is_diagnosed() -> None:
    x = np.linspace(0.0, 6.0, 30)
    runs = prb.Runs({"x": x}, np.exp(x / 2))
    data = np.exp(np.random.default_rng(1).normal(2.9, 0.3, 20) / 2)
    with pm.Model() as model:
        dist = pm.Normal.dist(pm.Normal("mu", 3, 1), pm.HalfNormal("sd", 0.5))
        prb.Simulator("y", runs, dist, observed=data)
    optimum = prb.minimize(model, starts=0, progressbar=False)
    assert "surface through 30 runs, with a cross-validated error" in str(prb.diagnose(optimum))
    predicted = prb.predict(optimum, runs, dist, model=model, progressbar=False)
    of_function = prb.predict(
        optimum, lambda x: np.exp(x / 2), dist, model=model, stored=False, progressbar=False
    )
    np.testing.assert_allclose(predicted, of_function, rtol=1e-3)
    narrow = prb.Runs({"x": x[:15]}, x[:15])
    remedy = r"the runs have x from 0 to 2\.897: add runs at the inputs of the prediction"
    with pytest.raises(DesignError, match=f"% NaN .*{remedy}"):
        prb.predict(optimum, narrow, dist, model=model, progressbar=False)
    with pytest.raises(ResponseError, match=f"NaN at all .*{remedy}"):
        prb.predict(optimum, narrow, pm.Normal.dist(model["mu"] + 6, 0.1), model=model)
    result = prb.exceedance(optimum, runs, 5.0, dist, model=model)
    assert 0 <= float(result.probability) < 1
