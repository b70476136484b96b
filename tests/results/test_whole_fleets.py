"""Decisions, pictures and reports of a whole fleet are those of its products."""

from __future__ import annotations

import logging
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes._finding import Finding
from prbayes.decision.population_table import PopulationTable
from prbayes.results.diagnose import Diagnosis
from prbayes.results.products import ProductResults, findings_together
from prbayes.validation.fleet import tests_of_products as products_tests

QUIET: dict[str, Any] = {"progressbar": False}
X = {
    "near": np.random.default_rng(3).normal(20, 1, 12),
    "far": np.random.default_rng(4).normal(31, 2, 9),
    "wide": np.random.default_rng(5).normal(20, 2, 10),
}
SHEET = prb.Summary(n=20, mean=3.0, sd=0.2)


def growth(x: Any) -> Any:
    return np.exp(0.05 * x) + 0.03 * np.sin(x)


def built(observed: Any, metric: Any = None) -> tuple[pm.Model, Any]:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 20, 8), pm.HalfNormal("s", 4), name="x")
        units = {"x": "mm"}
        prb.Simulator("y", growth, x, observed=observed, metric=metric, units=units, **QUIET)
    return model, x


@cache
def template() -> tuple[pm.Model, Any]:
    return built(growth(X["near"]))


@cache
def fleet() -> Any:
    rng = np.random.default_rng(6)
    further = {"near": growth(rng.normal(20, 1, 8)), "far": growth(rng.normal(24, 1, 8))}
    data = {name: growth(x) for name, x in X.items()} | {"sheet": SHEET}
    model, _ = template()
    return prb.calibrate_each(data, model=model, draws=400, validation=further, **QUIET)


@cache
def table() -> Any:
    return prb.population(fleet(), model=template()[0])


@cache
def risk() -> Any:
    model, x = template()
    return prb.exceedance(fleet(), growth, 4.0, x, model=model, requirement=0.1)


@pytest.mark.long
@pytest.mark.parametrize("name", ["far", "sheet"])
def test_a_row_is_the_table_of_the_product(name: str) -> None:
    model, x = template()
    product = fleet().sel(product=name)
    alone = prb.population(product, model=model)
    np.testing.assert_array_equal(table()["estimate"].sel(product=name), alone["estimate"])
    np.testing.assert_array_equal(table()["upper"].sel(product=name), alone["upper"])
    of_product = prb.exceedance(product, growth, 4.0, x, model=model, requirement=0.1)
    assert float(risk()["probability"].sel(product=name)) == float(of_product["probability"])
    assert str(risk()["verdict"].sel(product=name).item()) == of_product.attrs["verdict"]


def test_tables_have_the_verdicts_of_the_tests() -> None:
    expected = ["not rejected", "rejected", "not tested", "not tested"]
    for of_fleet in (table(), risk()):
        assert of_fleet["product"].values.tolist() == [*X, "sheet"]
        assert of_fleet["validity"].values.tolist() == expected
    line = next(line for line in repr(table()).splitlines() if "x[far] (mm)" in line)
    assert line.endswith(" rejected")
    assert "B-basis" in repr(table())
    assert "<table>" in table()._repr_html_()
    assert set(table().to_dataframe().index.get_level_values("product")) == {*X, "sheet"}
    assert "not met" in repr(risk())


def test_intervals_have_their_points_by_product() -> None:
    model, x = template()
    two, load = fleet().isel(product=[0, 2]), prb.decision.Interval(0.9, 1.1)
    got = prb.exceedance(
        two, lambda x, load: load * x, 20.0, x, load, model=model, n_draws=20, steps=2
    )
    assert got["at"].values.tolist() == ["0.9 to 1.1", "0.9 to 1.1"]
    assert got["probability"].sizes == {"product": 2, "bound": 2}
    assert " to " in got.to_view().rows[0][1]
    assert len(prb.plots.plot_products(got).axes) == 1


def test_the_emulator_is_accurate_far_from_the_observed_values_of_the_model() -> None:
    """The runs of the model itself are near its own observed values."""
    model, x = built(growth(X["far"]))
    alone = prb.exceedance(prb.sample(400, model=model, **QUIET), growth, 5.2, x, model=model)
    first, inputs = template()
    got = prb.exceedance(fleet().sel(product="far"), growth, 5.2, inputs, model=first)
    assert 0.05 < float(alone["probability"]) < 0.5
    # Four standard errors of a mean over 400 draws of a probability with an sd of .08
    assert abs(float(got["probability"] - alone["probability"])) < 0.023
    drawn = prb.predict(fleet().sel(product="far"), growth, inputs, model=first, **QUIET)
    expected = np.mean(growth(X["far"]))
    assert float(drawn.mean()) == pytest.approx(expected, abs=0.1)


def test_a_prediction_has_the_data_of_its_product() -> None:
    model, x = template()
    product = fleet().sel(product="far")
    predicted = prb.predict(product, growth, x, model=model, n_samples=20, **QUIET)
    with pytest.raises(ValueError, match="the data of the calibration"):
        prb.area_test(growth(X["far"]), predicted, **QUIET)


def test_runs_of_a_file_are_those_of_all_products(tmp_path: Any) -> None:
    fleet().to_netcdf(tmp_path / "fleet.nc", engine="h5netcdf")
    read = xr.open_datatree(tmp_path / "fleet.nc", engine="h5netcdf").load()
    xr.testing.assert_equal(prb.population(read, model=template()[0]), table())
    assert {k: t.p_value for k, t in products_tests(read).items()} == {
        k: t.p_value for k, t in products_tests(fleet()).items()
    }


@pytest.mark.long
def test_a_data_sheet_has_the_posterior_that_it_has_alone() -> None:
    model, _ = built(SHEET)
    alone = prb.sample(400, model=model, **QUIET)["posterior"].to_dataset()
    got = fleet().sel(product="sheet")["posterior"].to_dataset()
    for name in ("mu", "s"):
        sd = float(alone[name].std())
        # 400 draws: four standard errors of a difference of means are .28 sd, of a ratio .28.
        assert abs(float(got[name].mean() - alone[name].mean())) < 0.2 * sd
        assert float(got[name].std()) == pytest.approx(sd, rel=0.2)


@pytest.mark.long
def test_a_data_sheet_with_a_metric_of_distributions() -> None:
    model, _ = built(growth(X["near"]), prb.KullbackLeibler())
    data = {"near": growth(X["near"]), "sheet": SHEET}
    tree = prb.calibrate_each(data, model=model, draws=200, **QUIET)
    got, expected = (t["posterior"]["mu"].sel(product="sheet") for t in (tree, fleet()))
    assert float(got.mean()) == pytest.approx(float(expected.mean()), abs=0.1)
    assert prb.population(tree, model=model).sizes["product"] == 2


@pytest.mark.long
def test_a_data_sheet_has_no_individuals() -> None:
    tree = prb.individuals(fleet(), model=template()[0], n_draws=50)
    assert tree["posterior"]["product"].values.tolist() == [*X]
    for name, x in X.items():
        means = tree["posterior"]["x"].sel(product=name).mean(("chain", "draw"))
        np.testing.assert_allclose(means[: x.size], x, rtol=0.02)
        assert np.isnan(means[x.size :]).all()
    rows = tree.to_dataframe()
    assert len(rows) == sum(x.size for x in X.values())
    assert rows["product"].tolist() == np.repeat([*X], [x.size for x in X.values()]).tolist()
    assert "x[" in repr(tree)


def test_a_diagnosis_of_a_data_sheet_is_by_its_emulator() -> None:
    diagnosis = prb.diagnose(fleet().sel(product="sheet"), model=template()[0])
    assert diagnosis.ok


@pytest.mark.parametrize(
    ("data", "settings", "match"),
    [
        ({"a": SHEET}, {"metric": prb.LogLikelihood(error=0.1)}, r"a: got a prb.Summary .*metric="),
        ({1: [2.0, 2.1], "1": [2.0, 2.2]}, {}, "two products with the name '1'"),
    ],
)
def test_data_that_are_no_product_are_refused(data: Any, settings: Any, match: str) -> None:
    model, _ = built(growth(X["near"]), **settings)
    with pytest.raises((TypeError, ValueError), match=match):
        prb.calibrate_each(data, model=model, **QUIET)


def test_a_data_sheet_of_several_outputs_is_refused() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 0.4), pm.HalfNormal("s", 0.4))
        observed = np.random.default_rng(0).normal(1, 0.2, (5, 1)) * [1.0, 2.0]
        prb.Simulator("y", lambda x: np.stack([x, 2 * x], axis=-1), x, observed=observed)
    with pytest.raises(TypeError, match="several outputs"):
        prb.calibrate_each({"a": SHEET}, model=model, **QUIET)


def test_a_product_without_a_result_is_a_row_of_nan(caplog: pytest.LogCaptureFixture) -> None:
    broken = fleet().copy(deep=True)
    draws = broken["posterior"]["mu"]
    broken["posterior"]["mu"] = draws.where(draws["product"] != "far")
    texts = ["", "far: no mode", "two modes", ""]
    broken["products"]["finding"] = xr.DataArray(texts, dims="product")
    with caplog.at_level(logging.WARNING, "prbayes"):
        got = prb.population(broken, model=template()[0])
    assert np.isnan(got["estimate"].sel(product="far")).all()
    assert got["validity"].values.tolist()[1] == "failed"
    assert "no mode" in got["finding"].sel(product="far").item()
    assert "wide: two modes" in repr(got)
    assert [record.code for record in caplog.records] == ["failed-products", "product-finding"]
    np.testing.assert_array_equal(
        got["estimate"].sel(product="near"), table()["estimate"].sel(product="near")
    )
    # Of products with the same verdict those with the largest probability come first.
    decision = risk().copy(deep=True)
    decision["probability"].loc[{"product": ["wide", "sheet"]}] = [0.1, 1.0]
    orders = ["far", "wide", "sheet", "near"], ["far", "sheet", "wide", "near"]
    for of_report, order in zip((None, decision), orders, strict=True):
        report = prb.Report(
            "Springs", posterior=broken, model=template()[0], pictures=False, decision=of_report
        )
        assert report.sections[1].table["product"].tolist() == order


def test_arguments_that_no_product_accepts_raise() -> None:
    model, x = template()
    with pytest.raises(ValueError, match="prob"):
        prb.population(fleet(), model=model, prob=2.0)
    with pytest.raises(KeyError, match="zz"):
        prb.population(fleet(), "zz", model=model)
    predicted = prb.predict(fleet().sel(product="near"), growth, x, model=model, **QUIET)
    with pytest.raises(TypeError, match="a prediction is that of one product"):
        prb.population(fleet(), predicted, model=model)
    other, _ = built(growth(X["near"][1:]))
    with pytest.raises(ValueError, match="other observed values of y"):
        prb.population(fleet(), model=other)


def test_verdicts_are_in_the_rows_of_their_products() -> None:
    parts = {}
    for k, name in enumerate(["a", "b", "c"]):
        values = (("name", "quantity"), np.array([[k + 1.0], [k + 11.0]]))
        parts[name] = PopulationTable(
            dict.fromkeys(("estimate", "lower", "upper"), values),
            coords={"name": ["x", "z"], "quantity": ["mean"], "unit": ("name", ["mm", ""])},
            attrs={"prob": 0.89, "interval": "posterior", "bounds": "lower"},
        )
    verdicts = ["rejected", "not tested", "not rejected"]
    results = ProductResults(list(parts), parts, {}, verdicts, {})
    shown = PopulationTable.of_products(results).to_view()
    assert [(row[0], row[-1]) for row in shown.rows[:4]] == [
        ("x[a] (mm)", "rejected"),
        ("x[b] (mm)", "not tested"),
        ("x[c] (mm)", "not rejected"),
        ("z[a]", "rejected"),
    ]
    assert [row[1].split()[0] for row in shown.rows] == ["1", "2", "3", "11", "12", "13"]


def test_findings_of_many_products_are_one() -> None:
    page = "fleets.md"
    findings = {f"p{i}": (Finding("rough", f"text {i}", page),) for i in range(5)}
    (together,) = findings_together(findings)
    assert together.text == "p0, p1, p2 and 2 other products; for p0: text 0"
    few = findings_together(dict(list(findings.items())[:2]))
    assert [f.text for f in few] == ["p0: text 0", "p1: text 1"]


def test_a_diagnosis_of_a_fleet_names_the_products() -> None:
    good = Diagnosis((), xr.Dataset())
    bad = Diagnosis((Finding("population-misfit", "The family is wrong."),), xr.Dataset())
    parts = ProductResults(
        ["a", "b", "c"], {"a": good, "b": bad}, {"c": "no mode"}, ["not tested"] * 3, {}
    )
    diagnosis = Diagnosis.of_products(parts)
    assert [f.code for f in diagnosis.findings] == ["population-misfit", "failed-products"]
    assert str(diagnosis.findings[0]) == "b: The family is wrong."
    assert repr(diagnosis).startswith("Diagnosis of 3 products, 2 with problems")
    assert diagnosis.to_dataframe()["product"].tolist() == ["b", "c"]
    assert diagnosis.products["a"].ok
    assert not diagnosis.ok


def test_a_product_has_the_test_of_area_test() -> None:
    tests = products_tests(fleet())
    assert list(tests) == ["near", "far"]
    product = fleet().sel(product="far")
    (test,) = products_tests(product).values()
    assert test.rejected
    assert test.u_values.size == 8
    assert test.u_values.min() >= 0
    assert test.u_values.max() <= 1
    assert (test.envelope[0] <= test.envelope[1]).all()
    assert float(product["products"]["statistic"]) == test.statistic
    figure = prb.plots.plot_validity(product)
    assert "rejected" in figure.axes[0].get_title()


def test_the_report_of_a_product_has_its_verdict() -> None:
    for name, title in {"near": "Passed", "far": "Rejected"}.items():
        product = fleet().sel(product=name)
        report = prb.Report(name, posterior=product, pictures=False)
        assert report.sections[0].title == title
        evidence = next(s for s in report.sections if s.title == "Evidence")
        assert evidence.table["N"].tolist() == [X[name].size]


def test_the_report_of_a_fleet_has_the_worst_product_first(tmp_path: Any) -> None:
    settings = {"posterior": fleet(), "model": template()[0], "decision": {"above 4": risk()}}
    report = prb.Report("Springs", **settings)
    first, products = report.sections[:2]
    assert first.title == "1 of 2 tested products rejected"
    assert first.verdict == "bad"
    rows = products.table.set_index("product")
    assert rows.index.tolist()[0] == "far"
    assert rows.index.tolist()[-1] == "near"
    assert rows.loc["sheet", "specimens"] == "sheet of 20"
    assert rows.loc["far", "specimens"] == "9"
    assert rows["validity"].str.contains(", p = ").tolist() == [True, False, False, True]
    assert rows.loc["far", "above 4"].endswith("not met")
    row = next(cells for name, _, cells in table().rows() if name == "x[wide]")
    assert rows.loc["wide", "x (mm): B-basis"] == row["B-basis"][0]
    assert sum(section.picture is not None for section in report.sections) == 2
    assert "1 of 2 tested" in report.to_html(tmp_path / "fleet.html").read_text()
    with pytest.raises(ValueError, match=r"validity: got ValidityTest.*beside a whole fleet"):
        prb.Report("Springs", validity=products_tests(fleet())["far"], **settings)
    without = prb.Report("Springs", posterior=fleet(), pictures=False)
    assert "Populations need the model" in without.sections[1].text[0]


def test_pictures_have_a_row_for_each_product() -> None:
    figure = prb.plots.plot_products(table())
    (axis,) = figure.axes
    texts = [text.get_text() for text in axis.get_yticklabels()]
    basis = table()["estimate"].sel(quantity="B-basis", name="x").to_series()
    assert texts == basis.sort_values().index.tolist()
    points = {path.get_gid(): path.get_offsets() for path in axis.collections if path.get_gid()}
    far = float(table()["estimate"].sel(quantity="mean", name="x", product="far"))
    np.testing.assert_allclose(points["rejected"][0], [far, 3 - texts.index("far")])
    of_risk = prb.plots.plot_products(risk(), coords={"product": ["near", "far"]})
    assert [t.get_text() for t in of_risk.axes[0].get_yticklabels()] == ["far", "near"]
    tests = prb.plots.plot_validity(fleet())
    assert [t.get_text()[:3] for t in tests.axes[0].get_yticklabels()] == ["far", "nea"]
    with pytest.raises(ValueError, match="sort: got 'mode'"):
        prb.plots.plot_products(table(), sort="mode")
    with pytest.raises(TypeError, match="of a fleet"):
        prb.plots.plot_products(prb.population(fleet().sel(product="near"), model=template()[0]))
    with pytest.raises(ValueError, match="without validity tests"):
        prb.plots.plot_validity(fleet().sel(product="wide"))
