"""`compare`: optima and posteriors side by side."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import norm

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator

DATA = np.random.default_rng(1).normal([1.0, 3.0], 0.5, (40, 2))


@pytest.fixture(scope="module")
def model() -> pm.Model:
    """Two simulators, a vector hyperparameter, a scalar one, a deterministic."""
    with pm.Model(coords={"lab": ["north", "south"]}) as m:
        mean = pm.Normal("mean", 0, [3.0, 3.0], dims="lab")
        sigma = pm.HalfNormal("sigma", 1)
        pm.Deterministic("variance", sigma**2)
        for i, name in enumerate(("first", "second")):
            x = pm.Normal.dist(mean[i], sigma)
            prb.Simulator(
                name,
                np.positive,
                x,
                metric=prb.KullbackLeibler() if i else prb.AreaMetric(),
                observed=DATA[:, i],
                propagation=prb.Reweighted(256),
            )
    return m


@pytest.fixture(scope="module")
def optimum(model: pm.Model) -> prb.Optimum:
    return prb.minimize(model, method="Nelder-Mead")


@pytest.fixture(scope="module")
def idata(model: pm.Model, optimum: prb.Optimum) -> xr.DataTree:
    return prb.sample_smc(
        100, chains=2, model=model, optimum=optimum, random_seed=3, progressbar=False
    )


def test_what_nobody_reads_of_a_covariance_is_compared_only_where_nothing_else_is() -> None:
    rng = np.random.default_rng(0)
    sizes = {"mu": (), "cov": (3,), "cov_stds": (2,), "cov_corr": (2, 2)}
    draws = {
        name: (
            ["chain", "draw", *(f"{name}_{i}" for i in range(len(shape)))],
            rng.normal(size=(2, 50, *shape)),
        )
        for name, shape in sizes.items()
    }
    whole = xr.DataTree.from_dict({"posterior": xr.Dataset(draws)})
    part = xr.DataTree.from_dict({"posterior": xr.Dataset({n: draws[n] for n in ("mu", "cov")})})
    names = prb.compare({"a": whole, "b": whole})["hyperparameter"].values.tolist()
    assert names[:3] == ["mu", "cov_stds[0]", "cov_stds[1]"]
    assert len(names) == 7
    names = prb.compare({"a": whole, "b": part})["hyperparameter"].values.tolist()
    assert names == ["mu", "cov[0]", "cov[1]", "cov[2]"]


def test_compare_sets_optimum_and_posterior_side_by_side(
    model: pm.Model, optimum: prb.Optimum, idata: xr.DataTree
) -> None:
    table = prb.compare({"optimum": optimum, "ABC": idata}, model=model)
    assert list(table["result"].values) == ["optimum", "ABC"]
    names = ["mean[north]", "mean[south]", "sigma", "variance"]
    assert list(table["hyperparameter"].values) == names
    z = norm.ppf(0.945)
    best = table.sel(result="optimum")
    estimates = [*optimum.point["mean"], optimum.point["sigma"], optimum.point["variance"]]
    errors = [*optimum.stderr["mean"], optimum.stderr["sigma"], optimum.stderr["variance"]]
    np.testing.assert_allclose(best["estimate"], estimates)
    np.testing.assert_allclose(best["sd"], errors)
    np.testing.assert_allclose(
        best["lower"], np.subtract(estimates, np.multiply(z, errors)), rtol=1e-4
    )
    np.testing.assert_allclose(best["upper"], np.add(estimates, np.multiply(z, errors)), rtol=1e-4)
    np.testing.assert_array_equal(best["shift"], 0.0)
    abc = table.sel(result="ABC")
    posterior = idata["posterior"]
    draws = np.stack(
        [
            *np.moveaxis(posterior["mean"].values, -1, 0),
            posterior["sigma"].values,
            posterior["variance"].values,
        ]
    ).reshape(4, -1)
    np.testing.assert_allclose(abc["estimate"], draws.mean(axis=1))
    np.testing.assert_allclose(abc["sd"], draws.std(axis=1, ddof=1))
    np.testing.assert_allclose(
        [abc["lower"], abc["upper"]], np.quantile(draws, [0.055, 0.945], axis=1)
    )
    np.testing.assert_allclose(
        abc["shift"], (draws.mean(axis=1) - estimates) / draws.std(axis=1, ddof=1)
    )
    assert (np.abs(abc["shift"]) < 1).all()  # one model, one metric
    assert list(table["n_responses"].values) == [
        optimum.n_responses,
        posterior.attrs["n_responses"],
    ]
    assert (table["seconds"] > 0).all()
    frame = table.to_dataframe()
    assert {"estimate", "sd", "lower", "upper", "shift"} <= set(frame.columns)
    assert table.attrs["interval"] == 0.89


def test_compare_scores_each_result_under_every_metric(
    model: pm.Model, optimum: prb.Optimum, idata: xr.DataTree
) -> None:
    results = {"optimum": optimum, "ABC": idata}
    before = optimum.evaluator.n_responses
    table = prb.compare(results, model=model)
    assert optimum.evaluator.n_responses == before
    for name, metric in (("first AreaMetric", "first"), ("second KullbackLeibler", "second")):
        np.testing.assert_allclose(
            table[name].sel(result="optimum"), optimum.discrepancies[metric], rtol=1e-9
        )
    total = table["first AreaMetric"] / optimum.scales["first"]
    total = total + table["second KullbackLeibler"] / optimum.scales["second"]
    assert total.sel(result="ABC") > total.sel(result="optimum")
    # A metric that the model does not have: by the direct call, at the posterior mean
    mean = {k: np.asarray(idata["posterior"][k].mean(("chain", "draw"))) for k in ("mean", "sigma")}
    values, weights = optimum.evaluator.populations(
        optimum.evaluator.hyperparameters.unconstrained(mean)[None], 0
    )
    direct = prb.ProbabilityResidual().against(DATA[:, 0])(values, weights)
    np.testing.assert_allclose(table["first ProbabilityResidual"].sel(result="ABC"), direct)
    few = prb.compare(results, model=model, metrics=[prb.ProbabilityResidual(scale_base=1)])
    assert "first AreaMetric" not in few
    assert few["first ProbabilityResidual"].sel(result="ABC") != table[
        "first ProbabilityResidual"
    ].sel(result="ABC")
    far = tree_of(sigma=np.full((1, 5), 1e-3), **{"mean": np.zeros((1, 5))})
    far["posterior"] = (
        far["posterior"]
        .to_dataset()
        .assign(mean=(["chain", "draw", "lab"], np.full((1, 5, 2), 90.0)))
    )
    assert np.isnan(prb.compare({"far": far}, model=model)["first AreaMetric"]).all()


def test_compare_without_a_model_shows_all_that_is_shared(
    optimum: prb.Optimum, idata: xr.DataTree
) -> None:
    table = prb.compare({"a": optimum, "b": idata})
    names = ["mean[north]", "mean[south]", "sigma", "variance"]
    assert list(table["hyperparameter"].values) == names
    bare = xr.DataTree.from_dict({"posterior": idata["posterior"].to_dataset().drop_vars("lab")})
    for together in ({"a": optimum, "b": bare}, {"b": bare, "a": optimum}):
        assert list(prb.compare(together)["hyperparameter"].values) == names


def tree_of(**values: Floats) -> xr.DataTree:
    return xr.DataTree.from_dict(
        {"posterior": xr.Dataset({k: (["chain", "draw"], v) for k, v in values.items()})}
    )


def test_compare_takes_the_posterior_of_any_sampler(optimum: prb.Optimum) -> None:
    rng = np.random.default_rng(2)
    table = prb.compare({"NUTS": tree_of(sigma=rng.normal(size=(2, 50))), "optimum": optimum})
    assert list(table["hyperparameter"].values) == ["sigma"]
    assert np.isnan(table["n_responses"].sel(result="NUTS"))
    assert np.isnan(table["seconds"].sel(result="NUTS"))
    shift = (table["estimate"][1] - table["estimate"][0]) / table["sd"][1]
    np.testing.assert_allclose(table["shift"].sel(result="optimum"), shift)


def test_compare_with_a_first_result_without_spread() -> None:
    table = prb.compare(
        {"a": tree_of(sigma=np.ones((1, 5))), "b": tree_of(sigma=np.full((1, 5), 2.0))}
    )
    assert np.isinf(table["shift"].sel(result="b")).all()


@pytest.mark.parametrize(
    ("results", "error", "words"),
    [
        ({}, ValueError, "got no results"),
        ({"a": {"mu": 1.0}}, TypeError, "a: got dict, expected an Optimum or a DataTree"),
        ({"a": xr.DataTree()}, TypeError, "a: got DataTree, expected"),
        (
            {"a": tree_of(x=np.ones((1, 5))), "b": tree_of(y=np.ones((1, 5)))},
            ValueError,
            "share no hyperparameter",
        ),
    ],
)
def test_compare_refuses_what_cannot_be_compared(
    results: Any, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        prb.compare(results)


def test_compare_of_a_model_that_is_another(optimum: prb.Optimum) -> None:
    with pm.Model() as other:
        pm.Normal("tau")
    with pytest.raises(ValueError, match="share no hyperparameter"):
        prb.compare({"a": optimum}, model=other)


def test_saved_optima_compare_as_they_do_in_memory(optimum: prb.Optimum) -> None:
    table = prb.compare({"memory": optimum, "saved": optimum.to_datatree()})
    for key in ("estimate", "sd", "lower", "upper"):
        np.testing.assert_array_equal(*table[key].values)
    sigma = table.sel(hyperparameter="sigma", result="saved")
    upper = optimum.point["sigma"] + norm.ppf(0.945) * optimum.stderr["sigma"]
    np.testing.assert_allclose(float(sigma["upper"]), upper, rtol=1e-14)
    assert table["n_responses"].values.tolist() == [optimum.n_responses] * 2


def test_the_interval_of_an_optimum_is_that_of_a_normal(optimum: prb.Optimum) -> None:
    best = prb.compare({"a": optimum}).sel(result="a")
    for bound in ("lower", "upper"):
        covered = norm.cdf(best[bound], best["estimate"], best["sd"])
        np.testing.assert_allclose(covered, 0.055 if bound == "lower" else 0.945, rtol=1e-10)


def test_scores_of_a_model_that_was_built_again_are_those_of_the_first() -> None:
    def build() -> pm.Model:
        with pm.Model() as model:
            a = pm.Normal.dist(pm.Normal("mu", 0.0, 12.0), 0.2)
            b = pm.Normal.dist(3.0, 0.2)
            observed = np.random.default_rng(1).normal([4.0, 3.0], 0.2, (20, 2)).sum(axis=1)
            prb.Simulator(
                "y", lambda a, b: a + b, a, b,
                metric=prb.ProbabilityResidual(), observed=observed,
                propagation=prb.Reweighted(64),
            )  # fmt: skip
        return model

    first = build()
    optimum = prb.minimize(first)
    there = prb.compare({"optimum": optimum}, model=first)
    again = build()
    bound = Evaluator.of(again).reweighted["y"]
    before = bound.design
    here = prb.compare({"optimum": optimum.to_datatree()}, model=again)
    for name in ("ProbabilityResidual", "KullbackLeibler", "AreaMetric"):
        np.testing.assert_allclose(here[name], there[name], rtol=0.1)
    assert bound.design is before
    # The compiled graphs read it too.
    assert prb.minimize(again).discrepancy == optimum.discrepancy


@pytest.mark.long
def test_several_outputs_are_scored_by_joint_metrics() -> None:
    def response(a: Any, b: Any) -> Any:
        return np.stack([a + b, a * b], axis=-1)

    data = response(*np.random.default_rng(1).normal([[2.0], [3.0]], 0.2, (2, 20)))
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("mu", 2.0, 0.5), 0.2)
        b = pm.Normal.dist(3.0, 0.2)
        joint = prb.Joint(prb.AreaMetric())
        given: dict[str, Any] = {"metric": joint, "observed": data}
        prb.Simulator("y", response, a, b, **given, propagation=prb.Reweighted(64))
    optimum = prb.minimize(model, refine=False, starts=0)
    table = prb.compare({"optimum": optimum}, model=model)
    names = ["ProbabilityResidual", "KullbackLeibler", "AreaMetric", "LogLikelihood"]
    assert {f"Joint({name})" for name in names} <= set(table.data_vars)
    assert float(table["Joint(AreaMetric)"][0]) == pytest.approx(optimum.discrepancy)
    prb.plot_comparison(table)


def test_scores_need_every_hyperparameter(model: pm.Model) -> None:
    table = prb.compare({"part": tree_of(sigma=np.ones((1, 5)))}, model=model)
    assert list(table["hyperparameter"].values) == ["sigma"]
    assert not [key for key in table.data_vars if "AreaMetric" in str(key)]


def test_scores_that_would_compute_responses_are_asked_for() -> None:
    with pm.Model() as m:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.5)
        points = prb.Resimulated(64)
        data = DATA[:, 0]
        prb.Simulator(
            "y", np.positive, x, metric=prb.AreaMetric(), observed=data, propagation=points
        )
    draws = {"a": tree_of(mu=np.ones((1, 5)))}
    assert "AreaMetric" not in prb.compare(draws, model=m)
    table = prb.compare(draws, model=m, metrics=[prb.AreaMetric()])
    assert "KullbackLeibler" not in table
    # Half a unit per unit of u between the quantile functions of two normals of one width.
    assert float(table["AreaMetric"][0]) == pytest.approx(abs(data.mean() - 1.0), abs=0.15)
