"""Values as labelled datasets."""

from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.labels import labelled, observed_dataset, versions


def evaluator() -> Evaluator:
    with pm.Model(coords={"layer": ["top", "bottom"], "specimen": [7, 8, 9]}) as model:
        mu = pm.Normal("mu", 0, 1, dims="layer")
        prb.Simulator(
            "y",
            np.positive,
            pm.Normal.dist(mu[0], 1.0),
            metric=prb.AreaMetric(),
            observed=[0.0, 1.0, 2.0],
            dims="specimen",
            propagation=prb.Reweighted(64),
        )
    return Evaluator.of(model)


def test_dimensions_and_coordinates_are_the_models() -> None:
    data = labelled(evaluator(), {"mu": np.zeros((4, 2)), "free": np.ones((4, 3))}, {"draw": 4})
    assert data["mu"].dims == ("draw", "layer")
    assert data["free"].dims == ("draw", "free_dim_0")
    assert list(data["layer"].values) == ["top", "bottom"]
    assert list(data["draw"].values) == [0, 1, 2, 3]


def test_observed_values_are_labelled() -> None:
    data = observed_dataset(evaluator())
    assert data["y"].dims == ("specimen",)
    assert float(data["y"].sel(specimen=9)) == 2.0


def test_versions_are_those_of_this_installation() -> None:
    assert versions()["prbayes_version"] == prb.__version__
    assert versions()["numpy_version"] == np.__version__


TWO = np.array([[0.0, 1.0], [1.0, np.nan], [2.0, 0.5], [4.0, 3.0]])


def with_outputs(**observed: object) -> Evaluator:
    """Return a model with a simulator of several outputs for each of some observed responses."""
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu"), 1.0)
        for name, values in observed.items():
            m = np.shape(values)[1]
            prb.Simulator(
                name,
                lambda x, m=m: x[..., None] * np.arange(1, m + 1) + x[..., None] ** 2,
                x,
                metric=prb.MarginalCorrelation(prb.ProbabilityResidual()),
                observed=values,
                propagation=prb.Reweighted(64),
            )
        return Evaluator.of(pm.modelcontext(None))


def frequencies(units: object) -> xr.DataArray:
    """Return two measured outputs with names and units."""
    keep = {"attrs": {"units": units}} if isinstance(units, str) else {}
    data = xr.DataArray(
        TWO, dims=("specimen", "mode"), coords={"mode": ["first", "second"]}, **keep
    )
    return data if keep else data.assign_coords(units=("mode", units))


@pytest.mark.parametrize("units", ["Hz", ["Hz", "mm"]])
def test_outputs_keep_their_dimension_names_and_units_in_a_file(tmp_path: Path, units: Any) -> None:
    data = observed_dataset(with_outputs(frame=frequencies(units)))
    assert data["frame"].dims == ("frame_dim_0", "mode")
    assert data["mode"].values.tolist() == ["first", "second"]
    data.to_netcdf(tmp_path / "data.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "data.nc", engine="h5netcdf") as again:
        np.testing.assert_array_equal(again["frame"], TWO)
        assert again["mode"].values.tolist() == ["first", "second"]
        np.testing.assert_array_equal(again["frame"].attrs["units"], units)


def test_simulators_with_other_outputs_have_dimensions_of_their_own() -> None:
    three = np.column_stack([TWO[:, 0], [1.0, 0.0, 4.0, 5.0], [0.0, 2.0, 1.0, 3.0]])
    data = observed_dataset(with_outputs(one=TWO, other=three, same=TWO[::-1]))
    assert [data[name].dims[1] for name in data] == ["output", "other_output", "output"]
    assert data["output"].values.tolist() == [0, 1]
