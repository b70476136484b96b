"""ArviZ's arguments of all pictures, and what they select."""

import inspect
from typing import Any

import numpy as np
import pytest
import xarray as xr

import prbayes as prb
from prbayes.plots.selection import elements_of, select, subset

ARRAYS = {
    "mu": xr.DataArray(np.zeros((2, 3)), {"group": ["a", "b", "c"]}, ["draw", "group"]),
    "nu": xr.DataArray(np.zeros((2, 2, 2)), {"time": [0.5, 1.5]}, ["draw", "time", "nu_dim_1"]),
    "sigma": xr.DataArray(np.zeros(2), dims="draw"),
}
ELEMENTS = elements_of(ARRAYS)


@pytest.mark.parametrize("name", prb.plots.__all__)
def test_all_pictures_have_arviz_arguments(name: str) -> None:
    signature = inspect.signature(getattr(prb.plots, name))
    parameters = signature.parameters
    shared = ["var_names", "filter_vars", "coords"]
    if name == "plot_validity":  # has no variables
        shared = []
    elif name == "plot_sensitivity":  # has names of factors alone
        shared = shared[:2]
    assert [key for key in parameters if key in ("var_names", "filter_vars", "coords")] == shared
    kinds = {key: parameters[key].kind for key in [*shared, "pc_kwargs"]}
    assert kinds.pop("pc_kwargs") is inspect.Parameter.VAR_KEYWORD
    assert set(kinds.values()) <= {inspect.Parameter.KEYWORD_ONLY}
    by_arviz = name == "plot_posterior"
    assert ("backend" in parameters) == by_arviz
    assert signature.return_annotation == ("PlotCollection" if by_arviz else "Figure")


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, list(ELEMENTS)),
        ({"var_names": "mu"}, ["mu[a]", "mu[b]", "mu[c]"]),
        ({"var_names": ["sigma", "mu[b]"]}, ["sigma", "mu[b]"]),
        ({"var_names": "~nu", "coords": {"group": ["c", "a"]}}, ["mu[a]", "mu[c]", "sigma"]),
        ({"var_names": "~mu[a]", "coords": {"time": []}}, KeyError),
        ({"var_names": "u", "filter_vars": "like", "coords": {"group": "b"}}, 5),
        ({"var_names": "^.u$", "filter_vars": "regex", "coords": {"time": slice(1, 2)}}, 5),
        ({"var_names": "^s", "filter_vars": "regex"}, ["sigma"]),
        ({"var_names": ["mu", "tau"]}, KeyError),
        ({"var_names": []}, KeyError),
        ({"var_names": 3}, TypeError),
        ({"var_names": "m"}, KeyError),
        ({"var_names": "mu", "filter_vars": "glob"}, ValueError),
        ({"coords": {"group": "d"}}, KeyError),
        ({"coords": {"place": "d"}}, KeyError),
        ({"coords": ["group"]}, TypeError),
        ({"coords": {"nu_dim_1": 1}, "var_names": "nu"}, ["nu[0.5,1]", "nu[1.5,1]"]),
    ],
)
def test_names_filters_and_coordinates(given: dict[str, Any], expected: Any) -> None:
    arguments = {"var_names": None, "filter_vars": None, "coords": None} | given
    if isinstance(expected, type):
        with pytest.raises(expected, match=r"got .*expected"):
            select(ELEMENTS, **arguments)
    elif isinstance(expected, int):
        assert len(select(ELEMENTS, **arguments)) == expected
    else:
        assert select(ELEMENTS, **arguments) == expected


def test_a_dataset_is_restricted_along_its_own_dimensions() -> None:
    data = xr.Dataset({"mu": ARRAYS["mu"], "sigma": ARRAYS["sigma"]})
    assert subset(data, {"group": "b"}).sizes == {"draw": 2, "group": 1}
    assert subset(data, {"place": 1}, ["place"]).sizes == data.sizes
    with pytest.raises(KeyError, match="place"):
        subset(data, {"place": 1})
