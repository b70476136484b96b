"""A checkpoint goes on with the run that it belongs to, and with no other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import identity_of
from prbayes.posterior.checkpoint import Checkpoint, _sealed, stored_settings
from prbayes.response.budget import BudgetError
from prbayes.response.store import StoreError

OBSERVED = np.random.default_rng(1).normal(2.0, 1.0, 40)


def run(path: Path, **changes: Any) -> Any:
    """Sample a model; any of its parts, or settings of the run, may be changed."""
    prior = changes.pop("prior", lambda: pm.Normal("mu", 1, 1))
    slope = changes.pop("slope", 2.0)
    constant = changes.pop("constant", 3.0)
    family: Any = changes.pop("family", pm.Normal)
    simulator = {"metric": prb.KullbackLeibler(), "observed": OBSERVED, "epsilon": 0.05}
    simulator |= {"propagation": prb.Reweighted(64, max_lost=0.9)} | changes.pop("simulator", {})
    settings = {"draws": 20, "chains": 1, "random_seed": 1, "adjustment": None, "refine": False}
    settings |= changes.pop("settings", {})
    assert not changes
    with pm.Model() as model:
        mu = prior()
        x = family.dist(mu, 1.0)
        prb.Simulator("y", lambda x, c: slope * x + c - 3.0, x, constant, **simulator)
    return prb.sample_smc(model=model, checkpoint=path, progressbar=False, **settings)


def with_potential() -> Any:
    mu = pm.Normal("mu", 1, 1)
    pm.Potential("penalty", -50.0 * (mu - 5) ** 2)
    return mu


CHANGES: dict[str, dict[str, Any]] = {
    "prior": {"prior": lambda: pm.Normal("mu", -3, 0.1)},
    "prior family": {"prior": lambda: pm.Laplace("mu", 1, 1)},
    "potential": {"prior": with_potential},
    "response": {"slope": 4.0},
    "constant": {"constant": 5.0},
    "inputs": {"family": pm.Gumbel},
    "metric": {"simulator": {"metric": prb.AreaMetric()}},
    "observed": {"simulator": {"observed": OBSERVED + 1}},
    "epsilon": {"simulator": {"epsilon": 0.1}},
    "propagation": {"simulator": {"propagation": prb.Resimulated(64)}},
    "design": {"simulator": {"propagation": prb.Reweighted(128, max_lost=0.9)}},
    "seed": {"settings": {"random_seed": 2}},
    "draws": {"settings": {"draws": 30}},
    "chains": {"settings": {"chains": 2}},
    "threshold": {"settings": {"threshold": 0.7}},
    "adjustment": {"settings": {"adjustment": "estimate"}},
    "refinement": {"settings": {"refine": True}},
}


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    path = tmp_path_factory.mktemp("run") / "run.nc"
    return path, run(path)


@pytest.mark.parametrize("change", CHANGES)
def test_a_checkpoint_of_another_run_is_refused(change: str, done: tuple[Path, Any]) -> None:
    path, _ = done
    before = path.read_bytes()
    with pytest.raises(StoreError, match=r"belongs to another run: .*move it away"):
        run(path, **CHANGES[change])
    assert path.read_bytes() == before


def test_the_same_run_gives_the_same_draws_at_once(done: tuple[Path, Any]) -> None:
    path, first = done
    again = run(path)
    np.testing.assert_array_equal(again["posterior"]["mu"], first["posterior"]["mu"])


@pytest.mark.parametrize("adjustment", [None, "estimate"])
def test_an_interrupted_run_gives_the_draws_that_it_would_have_given(
    adjustment: str | None, tmp_path: Path
) -> None:
    settings = {"adjustment": adjustment, "chains": 2, "threshold": 0.7}
    at_once = run(tmp_path / "at_once.nc", settings=settings)
    with pytest.raises(BudgetError, match="max_stages = 1"):
        run(tmp_path / "run.nc", settings=settings | {"max_stages": 1})
    resumed = run(tmp_path / "run.nc", settings=settings)
    for group in ("posterior", "sample_stats"):
        xr.testing.assert_equal(resumed[group].to_dataset(), at_once[group].to_dataset())


def test_a_run_without_a_seed_takes_that_of_the_run_it_goes_on_with(tmp_path: Path) -> None:
    seedless = {"settings": {"random_seed": None}}
    first = run(tmp_path / "run.nc", **seedless)
    again = run(tmp_path / "run.nc", **seedless)
    np.testing.assert_array_equal(again["posterior"]["mu"], first["posterior"]["mu"])


# Files.


@pytest.fixture(scope="module")
def problem() -> Any:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=OBSERVED)
    return identity_of(Evaluator.of(model))


def test_arrays_and_notes_come_back(problem: Any, tmp_path: Path) -> None:
    path = tmp_path / "state.nc"
    arrays = {"thetas": np.arange(6.0).reshape(2, 3), "one": np.array(np.nan)}
    Checkpoint(path, problem, {"draws": 10, "entropy": "7"}).save(arrays, {"round": 1})
    again = Checkpoint(path, problem, {"draws": 10, "entropy": "7"})
    assert again.note == {"round": 1}
    for name, array in arrays.items():
        np.testing.assert_array_equal(again.arrays[name], array)
    assert stored_settings(path) == {"draws": 10, "entropy": "7"}
    assert not path.with_name("state.nc.part").exists()
    with xr.open_dataset(path, engine="h5netcdf") as data:  # for other programs it is netCDF
        np.testing.assert_array_equal(data["thetas"], arrays["thetas"])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: b"", "is damaged"),
        (lambda content: b"hello", "is damaged"),
        (lambda content: content[:-32], "is damaged, or no checkpoint of this version"),
        (lambda content: _sealed(b"hello"), "cannot be read"),
    ],
    ids=["empty", "text", "without digest", "sealed text"],
)
def test_damaged_files_are_refused(
    damage: Callable[[bytes], bytes], message: str, problem: Any, tmp_path: Path
) -> None:
    path = tmp_path / "state.nc"
    Checkpoint(path, problem, {"entropy": "7"}).save({"a": np.zeros(3)}, {})
    broken = damage(path.read_bytes())
    path.write_bytes(broken)
    with pytest.raises(StoreError, match=message):
        Checkpoint(path, problem, {"entropy": "7"})
    assert path.read_bytes() == broken


def test_a_folder_that_is_not_there_is_refused_before_any_work(
    problem: Any, tmp_path: Path
) -> None:
    with pytest.raises(StoreError, match="whose folder does not exist"):
        Checkpoint(tmp_path / "no" / "state.nc", problem, {})
    assert stored_settings(tmp_path / "no" / "state.nc") == {}
