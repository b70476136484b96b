"""Files of surrogates: the same surface comes back, and other files are refused."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from bent_response import BOX, FRESH, bent
from sklearn.linear_model import Ridge

import prbayes as prb
from prbayes.emulators.io import _SHIPPED
from prbayes.response.failures import Abort, Replace
from prbayes.response.store import StoreError

X, Y = FRESH


@pytest.mark.parametrize(
    "model",
    [
        prb.surrogate.RadialBasis("quintic", degree=2, smoothing=1e-6),
        prb.surrogate.Polynomial(3),
        prb.surrogate.GaussianProcess("matern", lengths=(0.5, 1.5), nugget=1e-6),
    ],
)
def test_a_file_keeps_the_surface_and_its_settings(tmp_path: Path, model: Any) -> None:
    found = prb.Surrogate.fit(bent, BOX, 48, model=model, outside=Replace(7.0)).with_error(3)
    found.save(tmp_path / "s.nc")
    back = prb.Surrogate.load(tmp_path / "s.nc")
    np.testing.assert_array_equal(back(X, Y), found(X, Y))
    assert back(99.0, 1.0) == 7.0
    again = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again(X, Y), found(X, Y))
    np.testing.assert_array_equal(again.local_error(X, Y), found.local_error(X, Y))
    assert (back.model, back.n_runs, back.ranges) == (model, 48, found.ranges)
    assert (back.error.rms, back.error.population_sd) == (
        found.error.rms,
        found.error.population_sd,
    )


def test_all_public_surfaces_are_saved_with_their_settings() -> None:
    public = {getattr(prb.surrogate, name) for name in prb.surrogate.__all__}
    surfaces = {cls for cls in public if issubclass(cls, prb.surrogate.Surface)}
    assert surfaces - {prb.surrogate.Surface} == set(_SHIPPED)


def test_multivariate_constant_and_abort_survive_a_file(tmp_path: Path) -> None:
    with pm.Model():
        pair = pm.MvNormal.dist(pm.Normal("m", 0, 1, shape=2), np.eye(2))
        found = prb.Surrogate.fit(lambda v, a: a * v.sum(-1), [pair, 2.0], 30, outside=Abort())
    found.save(tmp_path / "s.nc")
    back = prb.Surrogate.load(tmp_path / "s.nc")
    v = np.array([[0.1, 0.2], [0.5, -1.0]])
    np.testing.assert_array_equal(back(v, 2.0), found(v, 2.0))
    with pytest.raises(ValueError, match="outside its design"):
        back(v, 1.0)


def test_labels_of_outputs_survive_a_file(tmp_path: Path) -> None:
    times = [0.3, 0.1]

    def labelled(x: Any, y: Any) -> xr.DataArray:
        values = np.stack([x, x + y], axis=-1)
        return xr.DataArray(values, dims=["n", "time"], coords={"time": times})

    found = prb.Surrogate.fit(labelled, BOX, 30)
    found.save(tmp_path / "s.nc")
    for surrogate in (found, prb.Surrogate.load(tmp_path / "s.nc")):
        values = surrogate(X, Y)
        assert values.coords["time"].values.tolist() == times
        np.testing.assert_allclose(values.sel(time=0.1), X + Y, atol=1e-6)


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "s.nc").write_bytes(b"not a file of this kind")
    with pytest.raises(StoreError, match=r"path: got .*expected a file of Surrogate.save"):
        prb.Surrogate.load(tmp_path / "s.nc")


def test_a_regressor_is_passed_again_at_load(tmp_path: Path) -> None:
    found = prb.Surrogate.fit(bent, BOX, 48, model=Ridge(alpha=1e-6))
    found.save(tmp_path / "s.nc")
    with pytest.raises(TypeError, match="expected the Ridge it was fitted with; pass model="):
        prb.Surrogate.load(tmp_path / "s.nc")
    back = prb.Surrogate.load(tmp_path / "s.nc", model=Ridge(alpha=1e-6))
    np.testing.assert_allclose(back(X, Y), found(X, Y))
    with pytest.raises(ValueError, match="gives other values than the Ridge that was saved"):
        prb.Surrogate.load(tmp_path / "s.nc", model=Ridge(alpha=10.0))


@pytest.mark.parametrize("joined", [False, True])
def test_a_coarse_response_is_passed_again_at_load(tmp_path: Path, joined: bool) -> None:
    def coarse(x: Any, y: Any) -> Any:
        return np.sin(12 * x) * np.cos(9 * y)

    def fine(x: Any, y: Any) -> Any:
        return bent(x, y) + (x if joined else 1) * coarse(x, y)

    found = prb.Surrogate.fit(fine, BOX, 48, coarse=coarse)
    found.save(tmp_path / "s.nc")
    with pytest.raises(TypeError, match="got no coarse response, expected the one"):
        prb.Surrogate.load(tmp_path / "s.nc")
    with pytest.raises(ValueError, match="and the same coarse response"):
        prb.Surrogate.load(tmp_path / "s.nc", coarse=lambda x, y: coarse(x, 1.01 * y))
    back = prb.Surrogate.load(tmp_path / "s.nc", coarse=coarse)
    np.testing.assert_array_equal(back(X, Y), found(X, Y))
    prb.Surrogate.fit(bent, BOX, 48).save(tmp_path / "alone.nc")
    assert prb.Surrogate.load(tmp_path / "alone.nc", coarse=coarse).coarse is None


def test_several_outputs_survive_a_file(tmp_path: Path) -> None:
    def both(x: Any, y: Any) -> Any:
        return {"bent": bent(x, y), "pair": np.stack([100 * x, y * x], axis=-1)}

    found = prb.Surrogate.fit(both, BOX, 48, model=prb.surrogate.GaussianProcess()).with_error(3)
    found.save(tmp_path / "s.nc")
    back = prb.Surrogate.load(tmp_path / "s.nc")
    assert list(back(X, Y)) == ["bent", "pair"]
    for name, values in found(X, Y).items():
        np.testing.assert_array_equal(back(X, Y)[name], values)
    np.testing.assert_array_equal(back.error.rms, found.error.rms)
    np.testing.assert_array_equal(back.error.population_sd, found.error.population_sd)
