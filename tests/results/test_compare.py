"""`compare`: optima and posteriors side by side."""

from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input, posterior_of
from scipy.stats import norm

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import unconstrained

DATA = np.random.default_rng(1).normal([1.0, 3.0], 0.5, (40, 2))
AREA = prb.AreaMetric()
NAMES = ["mean[north]", "mean[south]", "sigma", "variance"]
Z = norm.ppf(0.945)


@cache
def model() -> pm.Model:
    """Return a model of two simulators with a vector, a scalar and a deterministic."""
    with pm.Model(coords={"lab": ["north", "south"]}) as m:
        mean = pm.Normal("mean", 0, [3.0, 3.0], dims="lab")
        sigma = pm.HalfNormal("sigma", 1)
        pm.Deterministic("variance", sigma**2)
        for i, (name, metric) in enumerate((("first", AREA), ("second", prb.KullbackLeibler()))):
            x = pm.Normal.dist(mean[i], sigma)
            propagation = prb.Reweighted(256)
            prb.Simulator(
                name, np.positive, x, metric=metric, observed=DATA[:, i], propagation=propagation
            )
    return m


@cache
def optimum() -> prb.Optimum:
    return prb.minimize(model(), method="Nelder-Mead", starts=0)


@cache
def idata() -> xr.DataTree:
    settings = {"model": model(), "optimum": optimum(), "adjustment": None, "progressbar": False}
    return prb.sample_smc(100, chains=2, random_seed=3, **settings)


# -- estimates


@pytest.mark.long
def test_estimates_of_an_optimum_and_a_posterior() -> None:
    table = prb.compare({"optimum": optimum(), "ABC": idata()}, model=model())
    assert table.attrs["interval"] == 0.89
    assert list(table["result"].values) == ["optimum", "ABC"]
    assert list(table["hyperparameter"].values) == NAMES
    best = table.sel(result="optimum")
    point, stderr = optimum().point, optimum().stderr
    estimates = np.array([*point["mean"], point["sigma"], point["variance"]])
    errors = np.array([*stderr["mean"], stderr["sigma"], stderr["variance"]])
    np.testing.assert_allclose(best["estimate"], estimates)
    np.testing.assert_allclose(best["sd"], errors)
    np.testing.assert_allclose(best["lower"], estimates - Z * errors, rtol=1e-12)
    np.testing.assert_allclose(best["upper"], estimates + Z * errors, rtol=1e-12)
    np.testing.assert_array_equal(best["shift"], 0.0)
    abc, posterior = table.sel(result="ABC"), idata()["posterior"]
    columns = [*np.moveaxis(posterior["mean"].values, -1, 0), posterior["sigma"].values]
    draws = np.stack([*columns, posterior["variance"].values]).reshape(4, -1)
    mean, sd = draws.mean(axis=1), draws.std(axis=1, ddof=1)
    np.testing.assert_allclose(abc["estimate"], mean)
    np.testing.assert_allclose(abc["sd"], sd)
    interval = np.quantile(draws, [0.055, 0.945], axis=1)
    np.testing.assert_allclose([abc["lower"], abc["upper"]], interval)
    np.testing.assert_allclose(abc["shift"], (mean - estimates) / sd)
    assert (np.abs(abc["shift"]) < 1).all()  # one model, one metric
    costs = [optimum().n_responses, posterior.attrs["n_responses"]]
    assert list(table["n_responses"].values) == costs
    assert (table["seconds"] > 0).all()
    assert {"estimate", "sd", "lower", "upper", "shift"} <= set(table.to_dataframe().columns)


def test_a_covariance_is_compared_by_its_parts_if_all_results_have_them() -> None:
    rng = np.random.default_rng(0)
    sizes = {"mu": (), "cov": (3,), "cov_stds": (2,), "cov_corr": (2, 2), "force [N]": (2,)}
    draws = {name: rng.normal(size=(2, 50, *shape)) for name, shape in sizes.items()}
    whole, part = posterior_of(**draws), posterior_of(mu=draws["mu"], cov=draws["cov"])
    table = prb.compare({"a": whole, "b": whole})
    names = table["hyperparameter"].values.tolist()
    assert names[:3] == ["mu", "cov_stds[0]", "cov_stds[1]"]
    assert names[-2:] == ["force [N][0]", "force [N][1]"]
    assert len(names) == 9
    expected = draws["force [N]"].mean(axis=(0, 1))
    np.testing.assert_allclose(table["estimate"].sel(result="b")[-2:], expected)
    names = prb.compare({"a": whole, "b": part})["hyperparameter"].values.tolist()
    assert names == ["mu", "cov[0]", "cov[1]", "cov[2]"]


def test_draws_without_coordinates_have_those_of_the_optimum() -> None:
    bare = xr.DataTree.from_dict({"posterior": idata()["posterior"].to_dataset().drop_vars("lab")})
    for together in ({"a": optimum(), "b": idata()}, {"b": bare, "a": optimum()}):
        assert list(prb.compare(together)["hyperparameter"].values) == NAMES
    # A saved optimum compares as in memory.
    table = prb.compare({"memory": optimum(), "saved": optimum().to_datatree()})
    for key in ("estimate", "sd", "lower", "upper"):
        np.testing.assert_array_equal(*table[key].values)
    assert table["n_responses"].values.tolist() == [optimum().n_responses] * 2


def test_the_posterior_of_any_sampler() -> None:
    draws = posterior_of(sigma=np.random.default_rng(2).normal(size=(2, 50)))
    table = prb.compare({"NUTS": draws, "optimum": optimum()}, model=model())
    assert list(table["hyperparameter"].values) == ["sigma"]
    assert np.isnan(table["n_responses"].sel(result="NUTS"))
    assert np.isnan(table["seconds"].sel(result="NUTS"))
    shift = (table["estimate"][1] - table["estimate"][0]) / table["sd"][1]
    np.testing.assert_allclose(table["shift"].sel(result="optimum"), shift)
    # Scores need every hyperparameter.
    assert not [key for key in table.data_vars if "AreaMetric" in str(key)]
    # Results without spread.
    first, second = posterior_of(sigma=np.ones((1, 5))), posterior_of(sigma=np.full((1, 5), 2.0))
    assert np.isinf(prb.compare({"a": first, "b": second})["shift"].sel(result="b")).all()


@pytest.mark.parametrize(
    ("results", "error", "words"),
    [
        ({"a": xr.DataTree()}, TypeError, "a: got DataTree, expected"),
        ({"a": posterior_of(x=[[1.0, 2.0]])}, ValueError, "share no"),
    ],
)
def test_invalid_results(results: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        prb.compare(results | {"b": posterior_of(y=[[1.0, 2.0]])})
    with pm.Model() as other:
        pm.Normal("tau")
    match = r"share no hyperparameter \(a: mean.*\) with each other and the model"
    with pytest.raises(ValueError, match=match):
        prb.compare({"a": optimum()}, model=other)


def test_names_that_not_all_results_have_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    one = posterior_of(mu=[[1.0, 2.0]], sigma=[[1.0, 2.0]])
    other = posterior_of(m=[[1.0, 2.0]], sigma=[[1.0, 2.0]])
    with caplog.at_level("WARNING", "prbayes"):
        prb.compare({"a": one, "b": one})
        assert not caplog.text
        assert prb.compare({"a": one, "b": other})["hyperparameter"].values.tolist() == ["sigma"]
    assert "compare: left out mu, m, as not all results have these names" in caplog.text


# -- scores


def test_scores_of_each_result_under_every_metric() -> None:
    results = {"optimum": optimum(), "ABC": idata()}
    n_responses = optimum().evaluator.n_responses
    table = prb.compare(results, model=model())
    assert optimum().evaluator.n_responses == n_responses
    total = 0.0
    for name, simulator in (("first AreaMetric", "first"), ("second KullbackLeibler", "second")):
        score = table[name].sel(result="optimum")
        # Areas of several simulators are minimised without the bias of few specimens.
        rtol = 0.02 if simulator == "first" else 1e-9
        np.testing.assert_allclose(score, optimum().discrepancies[simulator], rtol=rtol)
        total = total + table[name] / optimum().scales[simulator]
    assert total.sel(result="ABC") > total.sel(result="optimum")
    # A metric that the model does not have, at the posterior mean.
    mean = {k: idata()["posterior"][k].mean(("chain", "draw")).values for k in ("mean", "sigma")}
    evaluator = optimum().evaluator
    theta = unconstrained(evaluator.hyperparameters, mean)
    expected = prb.ProbabilityResidual().against(DATA[:, 0])(*evaluator.populations(theta[None], 0))
    np.testing.assert_allclose(table["first ProbabilityResidual"].sel(result="ABC"), expected)
    few = prb.compare(results, model=model(), metrics=[prb.ProbabilityResidual(scale_base=1)])
    assert "first AreaMetric" not in few
    assert (few["first ProbabilityResidual"] != table["first ProbabilityResidual"]).all()
    far = posterior_of(sigma=np.full((1, 5), 1e-3), mean=np.full((1, 5, 2), 90.0))
    assert np.isnan(prb.compare({"far": far}, model=model())["first AreaMetric"]).all()


def sum_model() -> pm.Model:
    observed = np.random.default_rng(1).normal([4.0, 3.0], 0.2, (20, 2)).sum(axis=1)
    with pm.Model() as model:
        inputs = pm.Normal.dist(pm.Normal("mu", 0.0, 12.0), 0.2), pm.Normal.dist(3.0, 0.2)
        settings = {"metric": prb.ProbabilityResidual(), "propagation": prb.Reweighted(64)}
        prb.Simulator("y", lambda a, b: a + b, *inputs, observed=observed, **settings)
    return model


@pytest.mark.long
def test_scores_of_a_model_that_was_built_again_are_those_of_the_first() -> None:
    first, again = sum_model(), sum_model()
    best = prb.minimize(first, starts=0)
    expected = prb.compare({"optimum": best}, model=first)
    bound = Evaluator.of(again).reweighted["y"]
    design = bound.design
    table = prb.compare({"optimum": best.to_datatree()}, model=again)
    for name in ("ProbabilityResidual", "KullbackLeibler", "AreaMetric"):
        np.testing.assert_allclose(table[name], expected[name], rtol=0.1)
    assert bound.design is design
    # The compiled graphs have it again, too.
    assert prb.minimize(again, starts=0).discrepancy == best.discrepancy


@pytest.mark.long
def test_several_outputs_are_scored_by_joint_metrics() -> None:
    def response(a: Any, b: Any) -> Any:
        return np.stack([a + b, a * b], axis=-1)

    data = response(*np.random.default_rng(1).normal([[2.0], [3.0]], 0.2, (2, 20)))
    with pm.Model() as model:
        inputs = pm.Normal.dist(pm.Normal("mu", 2.0, 0.5), 0.2), pm.Normal.dist(3.0, 0.2)
        settings = {"metric": prb.Joint(AREA), "propagation": prb.Reweighted(64)}
        prb.Simulator("y", response, *inputs, observed=data, **settings)
    best = prb.minimize(model, refine=False, starts=0)
    table = prb.compare({"optimum": best}, model=model)
    names = ["ProbabilityResidual", "KullbackLeibler", "AreaMetric", "LogLikelihood"]
    assert {f"Joint({name})" for name in names} <= set(table.data_vars)
    assert float(table["Joint(AreaMetric)"][0]) == pytest.approx(best.discrepancy)
    prb.plots.plot_comparison(table)


def test_scores_that_compute_responses_have_to_be_requested() -> None:
    data: Floats = DATA[:, 0]
    m = one_input(data, AREA, prb.Resimulated(64), mu=(1, 1), sd=0.5)
    draws = {"a": posterior_of(mu=np.ones((1, 5)))}
    assert "AreaMetric" not in prb.compare(draws, model=m)
    table = prb.compare(draws, model=m, metrics=[AREA])
    assert "KullbackLeibler" not in table
    # The area between the distribution functions of two normals of one width.
    assert float(table["AreaMetric"][0]) == pytest.approx(abs(data.mean() - 1.0), abs=0.15)


@pytest.mark.long
def test_a_metric_and_the_likelihood_of_the_same_data_are_compared() -> None:
    def fitted(**given: Any) -> prb.Optimum:
        settings = {"observed": DATA[:, 0]} | given
        return prb.minimize(one_input(mu=(1, 2), **settings), starts=0, progressbar=False)

    labels, counts = list(range(40)), np.arange(40) % 3 + 1
    by_metric = {"metric": prb.ProbabilityResidual(), "propagation": prb.Resimulated(256)}
    for data in ({"specimens": labels}, {"weights": counts}):
        pair = {"likelihood": fitted(**data), "metric": fitted(**by_metric, **data)}
        for m in (None, *(optimum.model for optimum in pair.values())):
            table = prb.compare(pair, model=m, metrics=[AREA])
            assert table.estimate.sel(hyperparameter="mu").std() < 0.1
    one = pair["metric"]
    for data, message in (
        ({"observed": DATA[:, 1]}, "other observed values of y;"),
        ({"weights": counts[::-1]}, "observed values of y"),
        ({"specimens": labels}, "labels of specimens of y"),
    ):
        with pytest.raises(ValueError, match=message):
            prb.compare({"metric": one, "other": fitted(**data)})


def test_readings_at_times_of_their_own_are_scored_by_the_likelihood_alone() -> None:
    rng = np.random.default_rng(3)
    times = np.array([1.0, 2.0]) + np.linspace(0, 0.5, 8)[:, None]
    y = rng.normal(1, 0.3, (8, 1)) * times + rng.normal(0, 0.1, (8, 2))
    with pm.Model() as model:
        rate = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        time = prb.response.condition("time", times)
        metric = prb.LogLikelihood(error=0.1)
        prb.Simulator("y", np.multiply.outer, rate, time, observed=y, metric=metric)
    results = {"optimum": prb.minimize(model, starts=0, progressbar=False)}
    table = prb.compare(results, model=model)
    scores = [name for name, x in table.data_vars.items() if x.dims == ("result",)]
    assert "LogLikelihood by specimen" in scores
    assert not any("Joint" in str(name) for name in scores)
    with pytest.raises(ValueError, match="expected at least 3"):
        prb.compare(results, model=model, metrics=[prb.Joint(prb.AreaMetric())])


def test_data_that_a_default_metric_does_not_take_have_no_value_of_it() -> None:
    """A group of one specimen has no bandwidth, and three outputs of one input are dependent."""
    rng = np.random.default_rng(0)
    x, who = rng.normal(2.0, 0.3, 11), ["A"] + ["B"] * 10
    with pm.Model(coords={"maker": ["A", "B"]}) as of_groups:
        mu = pm.Normal("mu", 0.0, 5.0, dims="maker")
        population = pm.Normal.dist(mu[prb.response.group("maker")], 0.3)
        data = pd.Series(np.exp(x), pd.Index(who, name="maker"))
        prb.Simulator("y", np.exp, population, observed=data)

    def curve(x: Any) -> Any:
        return np.asarray(x)[..., None] * np.array([1.0, 2.0, 3.0])

    of_curves = one_input(curve(x), response=curve, mu=(0.0, 5.0), sd=0.3)
    for model in (of_groups, of_curves):
        table = prb.compare({"optimum": prb.minimize(model, progressbar=False)}, model=model)
        assert np.isfinite(table["estimate"]).all()
