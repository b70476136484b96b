"""What was calibrated: the numbers are those of the model, the data and the results."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import prbayes as prb
from prbayes.reports.material import gather
from prbayes.reports.problem import data, metric
from prbayes.reports.tables import cells


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
