"""What results look like: the trees of `sample_smc` and `minimize`."""

from functools import cache
from pathlib import Path
from typing import Any

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.labels import versions
from prbayes.posterior.trees import posterior_tree

DATA = np.random.default_rng(1).normal([1.0, 3.0], 0.5, (40, 2))


def same(x: Any) -> Any:
    return x


@cache
def model() -> pm.Model:
    """Two simulators, a vector hyperparameter with named elements, a scalar one, a deterministic, named specimens."""
    with pm.Model(
        coords={"lab": ["north", "south"], "specimen": [f"s{i}" for i in range(40)]}
    ) as m:
        mean = pm.Normal("mean", 0, [3.0, 3.0], dims="lab")
        sigma = pm.HalfNormal("sigma", 1)
        pm.Deterministic("variance", sigma**2)
        for i, name in enumerate(("first", "second")):
            x = pm.Normal.dist(mean[i], sigma)
            prb.Simulator(
                name, same, x, metric=prb.KullbackLeibler() if i else prb.AreaMetric(), observed=DATA[:, i],
                epsilon=None if i else 0.02, dims=None if i else "specimen", propagation=prb.Reweighted(256),
            )  # fmt: skip
    return m


@cache
def optimum() -> prb.Optimum:
    return prb.minimize(model(), method="Nelder-Mead")


@cache
def idata() -> xr.DataTree:
    return prb.sample_smc(200, chains=4, model=model(), random_seed=3, progressbar=False)


# -- trees
# -----------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_tree_of_an_optimum() -> None:
    tree = optimum().to_datatree()
    assert set(tree.children) == {"optimum", "stderr", "trace", "calibration", "observed_data"}
    assert (
        set(tree["optimum"].data_vars)
        == set(tree["stderr"].data_vars)
        == {"mean", "sigma", "variance"}
    )
    assert tree["optimum"]["mean"].dims == ("lab",)
    assert float(tree["optimum"]["mean"].sel(lab="south")) == optimum().point["mean"][1]
    assert float(tree["stderr"]["sigma"]) == optimum().stderr["sigma"]
    calibration = tree["calibration"]
    assert calibration["covariance"].dims == ("element", "other_element")
    assert (
        calibration["covariance"].sel(element="mean[south]", other_element="sigma_log__")
        == optimum().covariance[1, 2]
    )
    assert (
        float(calibration["discrepancy"].sel(simulator="second"))
        == optimum().discrepancies["second"]
    )
    assert float(calibration["scale"].sel(simulator="first")) == 0.02
    assert tree["trace"].sizes["evaluation"] == optimum().search.n_evaluations
    assert {
        "discrepancy",
        "converged",
        "message",
        "n_evaluations",
        "n_responses",
        "n_screened",
        "seconds",
    } <= set(tree["optimum"].attrs)
    assert versions().items() <= tree["optimum"].attrs.items()


@pytest.mark.long
def test_observed_data_keep_their_labels() -> None:
    for tree in (optimum().to_datatree(), idata()):
        observed = tree["observed_data"]
        np.testing.assert_array_equal(observed["first"], DATA[:, 0])
        np.testing.assert_array_equal(observed["second"], DATA[:, 1])
        assert observed["first"].dims == ("specimen",)
        assert str(observed["specimen"].values[3]) == "s3"
        assert observed["second"].dims == ("second_dim_0",)


def test_the_tree_of_a_sampler() -> None:
    tree = idata()
    assert tree["posterior"]["mean"].dims == ("chain", "draw", "lab")
    np.testing.assert_allclose(tree["posterior"]["variance"], tree["posterior"]["sigma"] ** 2)
    calibration = tree["calibration"]
    assert calibration["discrepancy"].dims == ("chain", "draw", "simulator")
    thetas = calibration["theta"].values.reshape(-1, 3)
    found = Evaluator.of(model())(thetas)
    np.testing.assert_allclose(
        calibration["discrepancy"].values.reshape(-1, 2), found.discrepancies, rtol=1e-9
    )
    support = Evaluator.of(model()).support(thetas)
    for name in ("first", "second"):
        one = calibration.to_dataset().sel(simulator=name)
        assert int(one["n_points"]) % 256 == 0
        np.testing.assert_allclose(
            one["weight_ess"].values.ravel(), support[name]["weight_ess"], rtol=1e-9
        )
        np.testing.assert_allclose(
            one["mean_weight"].values.ravel(), support[name]["mean_weight"], rtol=1e-9
        )
    np.testing.assert_allclose(calibration["epsilon"], [0.02, 1 / 40])
    assert tree["posterior"].attrs["inference_library"] == "prbayes"
    assert versions().items() <= tree["posterior"].attrs.items()


def test_metrics_are_described_the_same_in_every_session() -> None:
    expected = [
        "AreaMetric()",
        "KullbackLeibler(density=GaussianKDE(bandwidth=twice_silverman), reverse=False)",
    ]
    for tree in (optimum().to_datatree(), idata()):
        assert list(tree["calibration"]["metric"].values) == expected
    assert list(idata()["calibration"]["propagation"].values) == [repr(prb.Reweighted(256))] * 2


def test_chains_with_different_numbers_of_stages() -> None:
    evaluator = Evaluator.of(model())
    thetas = np.zeros((2, 3, 3))
    stats: list[dict[str, list[float]]] = [
        {"beta": [0.2, 1.0], "n_steps": [2, 4]},
        {"beta": [1.0], "n_steps": [6]},
    ]
    tree = posterior_tree(
        evaluator,
        thetas,
        np.ones((2, 3, 2)),
        np.full((2, 3, 2), np.nan),
        stats,
        sampler={"sampler": "SMC"},
        seed=None,
        n_responses=7,
        seconds=1.5,
    )
    np.testing.assert_array_equal(tree["sample_stats"]["beta"], [[0.2, 1.0], [1.0, np.nan]])
    np.testing.assert_array_equal(tree["sample_stats"]["n_steps"], [[2, 4], [6, np.nan]])
    assert tree["posterior"].attrs["random_seed"] == "None"
    assert tree["posterior"].attrs["n_responses"] == 7
    np.testing.assert_array_equal(tree["posterior"]["sigma"], 1.0)


@pytest.mark.parametrize("make", [idata, lambda: optimum().to_datatree()])
def test_trees_survive_storage(make: Any, tmp_path: Path) -> None:
    tree = make()
    tree.to_netcdf(tmp_path / "tree.nc")
    loaded = az.from_netcdf(tmp_path / "tree.nc")
    try:
        assert set(loaded.children) == set(tree.children)
        for group in tree.children:
            xr.testing.assert_equal(loaded[group].to_dataset().load(), tree[group].to_dataset())
            assert {k: loaded[group].attrs[k] for k in tree[group].attrs} == dict(tree[group].attrs)
            assert all(v.dtype != object for v in tree[group].data_vars.values())
    finally:
        loaded.close()


def test_propagations_without_a_design_have_no_support_to_report() -> None:
    with pm.Model() as m:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.5)
        prb.Simulator(
            "y",
            same,
            x,
            metric=prb.KullbackLeibler(),
            observed=DATA[:, 0],
            propagation=prb.Resimulated(64),
        )
    tree = prb.sample_smc(50, chains=1, model=m, random_seed=1, progressbar=False)
    for key in ("weight_ess", "mean_weight"):
        assert np.isnan(tree["calibration"][key]).all()
    assert (tree["calibration"]["lost_mass"] == 0).all()
    assert int(tree["calibration"]["n_points"][0]) == 64
    assert prb.diagnose(tree, model=m).ok
    assert prb.diagnose(tree, model=m).support.sizes["simulator"] == 0


def test_the_support_of_an_optimum_is_part_of_it() -> None:
    assert optimum().support
    tree = optimum().to_datatree()["calibration"]
    for name, support in optimum().support.items():
        for key, value in support.items():
            assert float(tree[key].sel(simulator=name)) == value
        assert support["weight_ess"] > 30
        assert 0.8 < support["mean_weight"] < 1.25
        assert support["lost_mass"] == 0


def test_an_optimum_shows_its_answer_in_a_few_lines() -> None:
    found = optimum()
    lines = repr(found).splitlines()
    assert lines[0].startswith(
        f"Optimum: discrepancy {found.discrepancy:.4g} after {found.search.n_evaluations} evaluations"
    )
    assert lines[0].endswith("converged")
    told = [line.strip().partition(" = ") for line in lines[1:] if " ± " in line]
    assert [name for name, _, _ in told] == ["mean[north]", "mean[south]", "sigma", "variance"]
    assert len(lines) == 1 + len(told) + len(found.findings)
    numbers = np.concatenate([np.ravel(found.point[name]) for name in found.point])
    errors = np.concatenate([np.ravel(found.stderr[name]) for name in found.point])
    for (_, _, text), number, error in zip(told, numbers, errors, strict=True):
        assert text == f"{number:.4g} ± {error:.4g}"
