"""The crack growth case from end to end, once, with few draws."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from prbayes._demo import CALIBRATED_AT, EXPONENT, relative_length, run_demo


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return run_demo(tmp_path_factory.mktemp("demo") / "here", draws=50, chains=2, seed=1)


def test_results_and_a_report_are_written(written: list[Path]) -> None:
    names = ["results.nc", "optimum.nc", "validity.nc", "report.html"]
    assert [path.name for path in written] == names
    assert all(path.parent.name == "here" for path in written)
    text = written[-1].read_text(encoding="utf-8")
    for title in (
        "Model",
        "Data",
        "Optimum",
        "Posterior",
        "Comparison",
        "Diagnostics",
        "Validity",
    ):
        assert f">{title}</h2>" in text


def test_eleven_specimens_calibrate_and_ten_others_test(written: list[Path]) -> None:
    with xr.open_datatree(written[0], engine="h5netcdf") as results:
        assert dict(results["posterior"].sizes) == {"chain": 2, "draw": 50}
        assert results["observed_data"]["crack"].size == 11
        mean = float(results["posterior"]["mu"].mean())
    with xr.open_datatree(written[1], engine="h5netcdf") as optimum:
        sd = float(optimum["stderr"]["mu"])
        assert mean == pytest.approx(float(optimum["optimum"]["mu"]), abs=sd)
    with xr.open_dataset(written[2], engine="h5netcdf") as test:
        assert test["u"].size == np.unique(test["specimen"]).size == 10
        assert float(test["p_value"]) > 0.05, "the model is not rejected"


def test_crack_length_follows_paris_law() -> None:
    """The integral of dl/dN = C (l / l0)^m l0, at half the cycles and at failure."""
    response = relative_length(CALIBRATED_AT)
    assert response(0.0, EXPONENT) == 1.0
    lengths = np.linspace(1, response(3.0, EXPONENT), 20_001)
    cycles = np.trapezoid(lengths**-EXPONENT / 3.0, lengths)
    assert cycles == pytest.approx(CALIBRATED_AT, rel=1e-6)
    failure = 1 / ((EXPONENT - 1) * CALIBRATED_AT)
    assert np.isinf(response(np.array([failure, 2 * failure]), EXPONENT)).all()
    assert np.isfinite(response(0.999 * failure, EXPONENT))
