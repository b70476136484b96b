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


def test_a_surrogate_is_read(folder: Path, numbers: dict[str, Any]) -> None:
    surrogate = prb.Surrogate.load(folder / "surrogate.nc")
    # Fitted again, by the linear algebra of this machine.
    assert float(surrogate(np.array([1.5]))[0]) == pytest.approx(numbers["surrogate"], rel=1e-6)


def test_a_checkpoint_of_another_problem_is_refused(folder: Path) -> None:
    model = formats.model_of(formats.square, folder)
    with pytest.raises(StoreError, match="belongs to another run"):
        prb.sample_smc(model=model, checkpoint=folder / "run.nc", **formats.SAMPLED | {"draws": 41})
