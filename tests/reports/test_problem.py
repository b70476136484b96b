"""What was calibrated: the numbers are those of the model, the data and the results."""

import dataclasses
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.reports.material import gather
from prbayes.reports.numbers import NOTHING
from prbayes.reports.problem import data, metric
from prbayes.reports.tables import cells
from prbayes.response.outputs import Outputs


def test_model_and_data(
    observed: Any, report: prb.Report, page: Any, row: Any, section: Any
) -> None:
    assert row("mu", "distribution", page)["distribution"] == "Normal(1.5, 1)"
    assert row("cv", "distribution", page) == {
        "variable": "cv", "role": "deterministic", "distribution": "computed from sigma, mu",
    }  # fmt: skip
    assert row("y", "inputs", page)["inputs"] == "Normal(mu, sigma)"
    data = row("y", "smallest", page)
    assert data["N"] == "30"
    found = [float(data[key]) for key in ("smallest", "largest", "mean", "sd")]
    expected = [observed.min(), observed.max(), observed.mean(), observed.std(ddof=1)]
    np.testing.assert_allclose(found, expected, atol=5.1e-4)
    assert "y: 30 specimens: 100, 101" in " ".join(section(report, "Data").text)


def test_metric_and_epsilon(
    calibrated: Any, report: prb.Report, page: Any, row: Any, section: Any
) -> None:
    _, optimum, posterior, _ = calibrated
    table = row("posterior", "epsilon", page)
    calibration = posterior["calibration"]
    assert float(table["epsilon"]) == pytest.approx(float(calibration["epsilon"][0]), rel=1e-3)
    assert float(table["discrepancy"]) == pytest.approx(
        float(calibration["discrepancy"].mean()), rel=1e-3
    )
    assert float(row("optimum", "epsilon", page)["discrepancy"]) == pytest.approx(
        optimum.discrepancy, rel=1e-3
    )
    assert any(
        p.startswith("y: KullbackLeibler(") for p in section(report, "Metric and epsilon").text
    )


def test_results_under_different_metrics(calibrated: Any) -> None:
    first = calibrated.optimum.to_datatree()
    other = first.copy(deep=True)
    other["calibration"] = (
        other["calibration"].to_dataset().assign(metric=("simulator", ["Other()"]))
    )
    given = dict.fromkeys(("model", "posterior", "validity", "comparison"))
    (same,) = metric(gather(optimum={"a": first, "b": first}, **given))
    assert [p.split(": ")[0] for p in same.text[1:]] == ["y"]
    (different,) = metric(gather(optimum={"a": first, "b": other}, **given))
    assert different.text[2] == "b, y: Other()."
    assert different.text[1].startswith("a, y: KullbackLeibler(")
    assert "Epsilon" not in different.text[0], "optima have none"
    assert "epsilon" not in cells(different.table).header


def test_one_measured_value_has_no_spread(calibrated: Any) -> None:
    nothing = dict.fromkeys(("model", "optimum", "posterior", "validity", "comparison"))
    m = dataclasses.replace(gather(**nothing), observed={"y": np.array([2.5])})
    (row,) = cells(data(m)[0].table).rows
    assert row == ("y", "1", "2.500", "2.500", "2.500", "\u2013")


# -- several outputs -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured() -> Any:
    """Two outputs of 20 specimens: of the second two were not measured, and one has failed."""
    y = np.random.default_rng(1).normal([5.0, 70.0], [0.5, 3.0], (20, 2))
    y[:2, 1], y[2, 1] = np.nan, np.inf
    return y


@pytest.fixture(scope="module")
def frame(measured: Any) -> pm.Model:
    data = xr.DataArray(
        measured,
        dims=("i", "mode"),
        coords={"mode": ["first", "second"], "units": ("mode", ["Hz", "mm"])},
    )
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("mu", 5, 1), 0.5)
        b = pm.Normal.dist(70, 3.0)
        prb.Simulator(
            "frame",
            lambda a, b: np.stack([a, b], axis=-1),
            *(a, b),
            metric=prb.Joint(prb.ProbabilityResidual()),
            observed=data,
            propagation=prb.Resimulated(128),
        )
    return model


def test_each_output_has_a_row_and_pairs_have_correlations(frame: Any, measured: Any) -> None:
    about, correlations, values = data(gather(frame, None, None, None, None))
    table = cells(about.table)
    assert table.header == (
        *("simulator", "output", "units", "N", "failed", "missing"),
        *("smallest", "largest", "mean", "sd"),
    )
    first, second = table.rows
    assert first[:6] == ("frame", "first", "Hz", "20", "0", "0")
    assert second[:6] == ("frame", "second", "mm", "18", "1", "2")
    known = measured[3:, 1]
    assert float(second[8]) == pytest.approx(known.mean(), abs=0.01)
    assert float(second[9]) == pytest.approx(known.std(ddof=1), abs=0.01)
    r = np.corrcoef(measured[3:].T)[0, 1]
    assert correlations.title == "Correlations of frame"
    assert cells(correlations.table).rows[0][1:] == ("1", f"{r:.3f}")
    _, first_listed, second_listed = values.text
    numbers = first_listed.removeprefix("frame[first]: ").removesuffix(".").split(", ")
    np.testing.assert_allclose(list(map(float, numbers)), measured[:, 0], atol=1e-3)
    assert second_listed.removeprefix("frame[second]: ").split(", ")[:3] == [NOTHING, NOTHING, "∞"]


def test_a_result_alone_tells_the_same_of_outputs(frame: Any) -> None:
    optimum = prb.minimize(frame)
    told = data(gather(frame, None, None, None, None))
    tree = optimum.to_datatree()
    stored = data(gather(None, tree, None, None, None))
    for one, other in zip(told, stored, strict=True):
        assert other.text == one.text
        if one.table is not None:
            assert cells(other.table) == cells(one.table)
    report = prb.Report("Frame", optimum=optimum, model=frame, pictures=False)
    assert (
        "on 20 specimens with 2 outputs of frame, by the joint probability residual"
        in (report.sections[0].text[1])
    )


def test_of_a_curve_some_outputs_have_a_row(calibrated: Any) -> None:
    nothing = dict.fromkeys(("model", "optimum", "posterior", "validity", "comparison"))
    rng = np.random.default_rng(1)
    m = dataclasses.replace(
        gather(**nothing),
        observed={"y": rng.normal(size=(5, 40))},
        outputs={"y": Outputs(tuple(np.arange(40) / 2), "hour")},
    )
    about, correlations, values = data(m)
    rows = cells(about.table).rows
    assert len(rows) == len(cells(correlations.table).rows) == 12
    assert [rows[0][1], rows[-1][1]] == ["0", "19.5"]
    assert "y: 12 of 40 outputs are told." in about.text
    assert len(values.text) == 41  # of few specimens all outputs are listed


def test_one_output_tells_its_units_from_memory_and_from_a_result() -> None:
    values = xr.DataArray([1.0, 2.0, 4.0], dims="specimen", attrs={"units": "N/mm"})
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 2, 1), 1.0)
        prb.Simulator(
            "k", np.positive, x, metric=prb.AreaMetric(), observed=values,
            propagation=prb.Reweighted(64),
        )  # fmt: skip
    optimum = prb.minimize(model)
    for given in ((model, None), (None, optimum.to_datatree())):
        section, values = data(gather(*given, None, None, None))
        assert values.text[1] == "k: 1.000, 2.000, 4.000."
        assert section.table["units"].tolist() == ["N/mm"]
    picture = prb.plot_responses(optimum)
    assert picture.viz["plot"]["k"].item().get_xlabel() == "k (N/mm)"
