"""Where each new specimen stands in its prediction."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.reports.tables import cells

NULL: dict[str, Any] = {"null": prb.validation.PosteriorNull(99)}


def table(title: str = "Specimens of the test", **given: Any) -> list[dict[str, str]]:
    """Return the rows of a table of a report; none where it has none."""
    report = prb.Report("x", **given, pictures=False)
    for section in report.sections:
        if section.title == title:
            found = cells(section.table)
            return [dict(zip(found.header, row, strict=True)) for row in found.rows]
    return []


@pytest.fixture(scope="module")
def later(calibrated: Any) -> xr.DataArray:
    model = calibrated.model
    x = pm.Normal.dist(model["mu"], model["sigma"])
    return prb.predict(calibrated.posterior, np.positive, x, model=model, random_seed=1)


def test_of_a_test_alone_there_are_u_values(calibrated: Any) -> None:
    test = calibrated.test
    rows = table(validity=test)
    assert [row["specimen"] for row in rows] == [str(i) for i in range(1, 13)]
    np.testing.assert_allclose([float(row["u"]) for row in rows], test.u_values, atol=6e-4)
    assert "measured" not in rows[0]


def test_readings_stand_beside_u_values(calibrated: Any, later: xr.DataArray) -> None:
    fresh = np.random.default_rng(4).normal(2.0, 0.6, 12)
    names = [f"S{i}" for i in range(12)]
    test = prb.area_test(fresh, later, specimens=names, **NULL)
    rows = table(validity=test, validation={"hot": (fresh, later)})
    assert [row["condition"] for row in rows] == ["hot"] * 12
    assert [row["specimen"] for row in rows] == names
    measured = [float(row["measured"]) for row in rows]
    np.testing.assert_allclose(measured, fresh, atol=0.006)
    np.testing.assert_allclose([float(row["u"]) for row in rows], test.u_values, atol=6e-4)
    # Its lowest reading has the lowest place.
    assert np.argmin(measured) == np.argmin([float(row["u"]) for row in rows])
    counted = table(validation={"hot": (fresh, later)})
    assert [row["specimen"] for row in counted] == [str(i) for i in range(1, 13)]


def test_both_tests_of_a_specimen_share_a_row(calibrated: Any, later: xr.DataArray) -> None:
    data = {"hot": [1.5, 2.5], "cold": [2.0, np.inf, 1.0]}
    both = {"hot": later, "cold": later}
    tests = {
        "mean": prb.area_test(data, both, **NULL),
        "spread": prb.area_test(data, both, folded=True, **NULL),
    }
    rows = table(validity=tests, labels={"hot": "300 K"})
    assert [row["condition"] for row in rows] == ["300 K"] * 2 + ["cold"] * 3
    assert [row["specimen"] for row in rows] == ["1", "2", "1", "2", "3"]
    np.testing.assert_allclose([float(row["u"]) for row in rows], tests["mean"].u_values, atol=6e-4)
    with_readings = table(validity=tests, validation={c: (data[c], both[c]) for c in data})
    assert [row["measured"] for row in with_readings][3] == "\u221e"


def test_outputs_have_a_row_each(later: xr.DataArray) -> None:
    prediction = xr.concat(
        [later, later.copy(data=later.values[..., ::-1] + 10)],
        dim=xr.Variable("end", ["left", "right"]),
    )
    prediction = prediction.transpose(..., "end").assign_attrs(later.attrs)
    measured = np.array([[2.0, 13.0], [3.0, 12.0]])
    rows = table(validation={"hot": (measured, prediction)})
    assert [(row["condition"], row["specimen"]) for row in rows] == [
        ("hot[left]", "1"),
        ("hot[left]", "2"),
        ("hot[right]", "1"),
        ("hot[right]", "2"),
    ]
    # Of equal readings above the same prediction the u-values are the same.
    assert float(rows[1]["u"]) == float(rows[2]["u"]) > 0.8


def test_a_page_of_them_is_told(later: xr.DataArray) -> None:
    fresh = np.random.default_rng(4).normal(2.0, 0.6, 60)
    report = prb.Report("x", validation={"hot": (fresh, later)}, pictures=False)
    (section,) = (s for s in report.sections if s.title == "Specimens of the test")
    assert "The first 40 of 60 values are told." in " ".join(section.text)
    assert len(cells(section.table).rows) == 40


def test_measured_and_predicted_responses_are_summed_up(later: xr.DataArray) -> None:
    fresh = np.random.default_rng(4).normal(2.0, 0.6, 30)
    fresh[7] = np.inf
    (row,) = table("Data of the test", validation={"hot": (fresh, later)})
    finite = fresh[np.isfinite(fresh)]
    assert (row["condition"], row["N"], row["failed"]) == ("hot", "30", "1")
    told = [float(row[key]) for key in ("smallest", "largest", "mean", "sd")]
    own = [finite.min(), finite.max(), finite.mean(), finite.std(ddof=1)]
    np.testing.assert_allclose(told, own, atol=6e-3)
    told = [float(row[key]) for key in ("predicted median", "89% from", "to")]
    np.testing.assert_allclose(told, np.quantile(later, [0.5, 0.055, 0.945]), atol=6e-3)
