"""Functions of results on a product of a fleet, on a fleet, and on selected chains and draws."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb

QUIET: dict[str, Any] = {"progressbar": False}
A = np.random.default_rng(2).normal(20, 1, 10)
B = np.random.default_rng(3).normal(28, 3, 14)
C = np.array([60.0, *B[1:]])  # with an outlier, which other products have not


def stiffness(x: Any) -> Any:
    return 100 / x


def built(observed: Any, metric: Any = None) -> tuple[pm.Model, Any]:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 20, 8), pm.HalfNormal("s", 4), name="x")
        prb.Simulator("y", stiffness, x, observed=observed, metric=metric)
    return model, x


@cache
def template() -> tuple[pm.Model, Any]:
    return built(100 / A)


@cache
def fleet() -> xr.DataTree:
    return prb.calibrate_each(
        {"A": 100 / A, "B": 100 / B, "C": 100 / C}, model=template()[0], **QUIET
    )


@cache
def posterior() -> xr.DataTree:
    return prb.sample(400, model=template()[0], **QUIET)


CALLS: dict[str, Callable[[Any], Any]] = {
    "population": lambda r: prb.population(r, "x", model=template()[0]),
    "predict": lambda r: prb.predict(r, stiffness, template()[1], model=template()[0]),
    "exceedance": lambda r: prb.exceedance(r, stiffness, 5.5, template()[1], model=template()[0]),
    "individuals": lambda r: prb.individuals(r, model=template()[0]),
    "diagnose": lambda r: prb.diagnose(r, model=template()[0]),
    "compare": lambda r: prb.compare({"r": r}, model=template()[0]),
    "Report": lambda r: prb.Report("A report", posterior=r, model=template()[0]),
    "plot_responses": lambda r: prb.plots.plot_responses(r, model=template()[0]),
    "plot_population": lambda r: prb.plots.plot_population(r, model=template()[0]),
}


def test_individuals_are_those_of_the_product() -> None:
    tree = prb.individuals(fleet().sel(product="B"), model=template()[0])
    means = tree["posterior"]["x"].mean(("chain", "draw"))
    np.testing.assert_allclose(means, B, rtol=0.005)
    np.testing.assert_allclose(tree["observed_data"]["y"], 100 / B)
    figure = prb.plots.plot_individuals(tree)
    assert figure.axes


@pytest.mark.long
def test_a_diagnosis_is_of_the_data_of_the_product() -> None:
    diagnosis = prb.diagnose(fleet().sel(product="C"), model=template()[0])
    assert "population-misfit" in [finding.code for finding in diagnosis.findings]


def without_data(product: xr.DataTree) -> xr.DataTree:
    """Return the posterior alone."""
    return xr.DataTree.from_dict({"posterior": product["posterior"].to_dataset().drop_attrs()})


def test_scores_of_a_comparison_are_by_the_data_of_the_product() -> None:
    product = fleet().sel(product="B")
    table = prb.compare({"B": product}, model=template()[0])
    alone, _ = built(100 / B)
    expected = prb.compare({"B": without_data(product)}, model=alone)
    score = "LogLikelihood by specimen"
    assert table[score].item() == pytest.approx(expected[score].item(), abs=0.02)
    products = {name: fleet().sel(product=name) for name in "AB"}
    with pytest.raises(ValueError, match=r"several products.*leave model= out"):
        prb.compare(products, model=template()[0])
    assert prb.compare(products)["estimate"].shape == (2, 2)


def test_a_metric_of_distributions_has_the_data_of_the_product() -> None:
    model, _ = built(100 / A, prb.KullbackLeibler())
    each = prb.calibrate_each({"A": 100 / A, "B": 100 / B[1:]}, model=model, draws=50, **QUIET)
    product, metrics = each.sel(product="B"), [prb.AreaMetric()]
    table = prb.compare({"B": product}, model=model, metrics=metrics)
    alone, _ = built(100 / B[1:], prb.KullbackLeibler())
    expected = prb.compare({"B": without_data(product)}, model=alone, metrics=metrics)
    np.testing.assert_allclose(table["AreaMetric"], expected["AreaMetric"], rtol=0.05)


def test_a_product_of_another_model_is_refused() -> None:
    other, _ = built(100 / A[1:])
    with pytest.raises(ValueError, match="other observed values of y"):
        prb.individuals(fleet().sel(product="B"), model=other)


@pytest.mark.parametrize("name", ["predict", "compare", "plot_responses", "plot_population"])
def test_a_fleet_is_refused_with_what_to_pass(name: str) -> None:
    match = r"got posteriors of 3 products, expected one; pass fleet.sel\(product='A'\)"
    with pytest.raises(ValueError, match=match):
        CALLS[name](fleet())


SELECTIONS: dict[str, Callable[[], Any]] = {
    "chain": lambda: posterior().isel(chain=0),
    "label": lambda: posterior().sel(chain=0),
    "without coordinate": lambda: posterior().isel(chain=0, drop=True),
    "draws": lambda: posterior().isel(draw=slice(0, 100)),
    "from_dict": lambda: _from_dict().isel(chain=0),
    "product": lambda: fleet().sel(product="B").isel(chain=0),
}


def _from_dict() -> Any:
    draws = {str(k): v.values for k, v in posterior()["posterior"].data_vars.items()}
    return az.from_dict({"posterior": draws})


@pytest.mark.parametrize("selection", SELECTIONS)
def test_selected_chains_and_draws_are_results(selection: str) -> None:
    CALLS["population"](SELECTIONS[selection]())


@pytest.mark.long
@pytest.mark.parametrize("name", [n for n in CALLS if n not in ("population", "diagnose")])
def test_a_single_chain_of_a_product_is_a_result(name: str) -> None:
    CALLS[name](SELECTIONS["product"]())


def test_numbers_of_a_selected_chain_are_those_of_a_result_with_one() -> None:
    first = posterior().isel(chain=[0])
    for name in ("population", "compare"):
        xr.testing.assert_equal(CALLS[name](posterior().isel(chain=0)), CALLS[name](first))
    pictures = prb.plots.plot_posterior(posterior().isel(chain=0), backend="none")
    assert list(pictures.viz["dist"]) == ["mu", "s"]


def test_a_single_draw_has_populations_and_no_diagnosis() -> None:
    draw = posterior().isel(draw=0)
    assert CALLS["population"](draw)["estimate"].notnull().any()
    with pytest.raises(ValueError, match="got 1 draw of each chain, expected at least 2"):
        CALLS["diagnose"](draw)


def test_means_of_draws_are_no_draws() -> None:
    means = {"posterior": posterior()["posterior"].to_dataset().mean(("chain", "draw"))}
    for name in ("population", "compare", "diagnose", "Report"):
        with pytest.raises(ValueError, match=r"without the dimensions \['chain', 'draw'\]"):
            CALLS[name](xr.DataTree.from_dict(means))
