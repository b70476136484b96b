"""Files of released versions are read by this one, with the same numbers."""

import json
import shutil
from pathlib import Path
from typing import Any

import formats
import numpy as np
import pytest
import xarray as xr

import prbayes as prb
from prbayes import _validate, cli
from prbayes.optimize.optimum import identity_in
from prbayes.response.store import StoreError

VERSIONS = sorted(path.name for path in formats.FOLDER.iterdir() if path.is_dir())


@pytest.fixture(params=VERSIONS)
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A copy of the files of a version."""
    return Path(shutil.copytree(formats.FOLDER / request.param, tmp_path / request.param))


@pytest.fixture
def numbers(folder: Path) -> dict[str, Any]:
    """What the files contain."""
    read: dict[str, Any] = json.loads((folder / "numbers.json").read_text(encoding="utf-8"))
    return read


def test_a_store_has_its_responses(folder: Path) -> None:
    store = prb.response.Store(folder / "store", "y", version="1")
    inputs, values = store.known()
    assert inputs.shape == (64, 1)
    np.testing.assert_allclose(values, formats.square(inputs[:, 0]), rtol=1e-14)
    assert store.find(inputs)[1].all()


def test_a_finished_checkpoint_has_its_draws(folder: Path, numbers: dict[str, Any]) -> None:
    before = (folder / "run.nc").read_bytes()
    # Inputs of another processor may differ in the last digit: the response is there for these.
    draws = formats.sampled(formats.model_of(formats.square, folder), folder).posterior
    for name, expected in numbers["posterior"].items():
        assert float(draws[name].mean()) == pytest.approx(expected, rel=1e-9)
    assert (folder / "run.nc").read_bytes() == before


def test_saved_results_are_compared_and_diagnosed(folder: Path, numbers: dict[str, Any]) -> None:
    with (
        xr.open_datatree(folder / "optimum.nc") as optimum,
        xr.open_datatree(folder / "posterior.nc") as posterior,
    ):
        table = prb.compare({"optimum": optimum, "posterior": posterior})
        for result in ("optimum", "posterior"):
            for name, expected in numbers[result].items():
                estimate = table.estimate.sel(result=result, hyperparameter=name)
                assert float(estimate) == pytest.approx(expected, rel=1e-9)
        assert prb.diagnose(posterior)
        assert prb.Report("Files", optimum=optimum, posterior=posterior, pictures=False).sections


def test_a_prediction_is_tested(folder: Path, numbers: dict[str, Any]) -> None:
    with xr.open_dataarray(folder / "prediction.nc") as predicted:
        assert identity_in(predicted.to_dataset(promote_attrs=True)) is not None
        test = prb.area_test(formats.NEW, predicted, random_seed=5, progressbar=False)
    assert test.statistic == pytest.approx(numbers["statistic"], rel=1e-9)


def test_all_results_are_reported(folder: Path, tmp_path: Path, numbers: dict[str, Any]) -> None:
    names = ("optimum", "posterior", "validity", "exceedance")
    files = [str(folder / f"{name}.nc") for name in names]
    page = tmp_path / "page.html"
    assert cli.main(["report", *files, "--no-pictures", "--out", str(page), "--quiet"]) == 0
    text = page.read_text(encoding="utf-8")
    assert "above 3.000" in text
    assert f"{numbers['statistic']:.4f}" in text


def test_a_surrogate_is_read(folder: Path, numbers: dict[str, Any]) -> None:
    surrogate = prb.Surrogate.load(folder / "surrogate.nc")
    # Fitted again, by the linear algebra of this machine.
    assert float(surrogate(np.array([1.5]))[0]) == pytest.approx(numbers["surrogate"], rel=1e-6)


def test_a_checkpoint_of_another_problem_is_refused(folder: Path) -> None:
    model = formats.model_of(formats.square, folder)
    with pytest.raises(StoreError, match="belongs to another run"):
        prb.sample_smc(model=model, checkpoint=folder / "run.nc", **formats.SAMPLED | {"draws": 41})


def test_files_of_a_later_format_are_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_validate, "FORMAT", 9)
    text = "got a file of format 10, expected 9"
    with pytest.raises(StoreError, match=text):
        prb.Surrogate.load(folder / "surrogate.nc")
    with pytest.raises(StoreError, match=text):
        formats.sampled(formats.model_of(formats.square, folder), folder)
    with (
        xr.open_datatree(folder / "optimum.nc") as optimum,
        pytest.raises(ValueError, match=text),
    ):
        prb.compare({"optimum": optimum})


def test_files_of_a_release_candidate_are_refused() -> None:
    refused = pytest.raises(ValueError, match="format None, expected 10; numbers below 10, or")
    with xr.open_datatree(formats.FOLDER / "release_candidate.nc") as posterior:
        for use in (prb.diagnose, prb.plots.plot_posterior, lambda x: prb.compare({"a": x})):
            with refused:
                use(posterior)
