"""The group of a specimen: how it is told, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr
from suppliers import labelled

import prbayes as prb
from prbayes.response.compile import PLAIN
from prbayes.response.groups import Groups, group_indices, groups_of, is_group, refuse_groups

GROUPS = Groups("supplier", ("Adler", "Busch"))
VALUES = [1.0, 2.0, 3.0]
WHO = ["Busch", "Adler", "Busch"]


def observed() -> list[Any]:
    """Return the same measurements in each form that tells their groups."""
    index = pd.MultiIndex.from_arrays([range(3), WHO], names=["specimen", "supplier"])
    return [
        labelled(VALUES, WHO),
        xr.DataArray(VALUES, {"supplier": WHO}, "supplier"),
        pd.DataFrame({"y": VALUES, "supplier": WHO}),
        pd.Series(VALUES, pd.Index(WHO, name="supplier")),
        pd.Series(VALUES, index),
    ]


@pytest.mark.parametrize("given", observed(), ids=lambda given: type(given).__name__)
def test_groups_are_read_from_coordinate_column_or_index(given: Any) -> None:
    places, values = group_indices("y", given, GROUPS)
    np.testing.assert_array_equal(places, [1, 0, 1])
    np.testing.assert_array_equal(np.asarray(values), VALUES)


def test_several_outputs_stay_named() -> None:
    frame = pd.DataFrame({"a": VALUES, "supplier": WHO, "b": VALUES})
    places, rest = group_indices("y", frame, GROUPS)
    np.testing.assert_array_equal(places, [1, 0, 1])
    assert list(rest.columns) == ["a", "b"]


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        (VALUES, TypeError, "got list without the group of each specimen, expected a DataArray"),
        (np.array(VALUES), TypeError, "got .* without the group of each specimen"),
        (pd.Series(VALUES), TypeError, "got .* without the group of each specimen"),
        (pd.DataFrame({"y": VALUES}), TypeError, "got .* without the group of each specimen"),
        (
            xr.DataArray(np.ones((3, 2)), {"supplier": ("o", ["a", "b"])}, ["i", "o"]),
            TypeError,
            "got .* a coordinate 'supplier' along the specimens",
        ),
        (
            labelled(VALUES, ["Adler", "Busch", "Celik"]),
            ValueError,
            r"got specimens of \['Celik'\]",
        ),
        (labelled(VALUES, ["Adler"] * 3), ValueError, r"got no specimen of \['Busch'\]"),
    ],
)
def test_what_tells_no_groups_is_refused(given: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=f"(?s)y: observed: {message}"):
        group_indices("y", given, GROUPS)


def test_a_group_is_an_index_that_is_drawn_evenly() -> None:
    with pm.Model(coords={"supplier": ["Adler", "Busch"]}):
        mu = pm.Normal("mu", [0.0, 1.0], dims="supplier")
        supplier = prb.response.group("supplier")
        assert mu[supplier].ndim == 0
    assert is_group(supplier)
    assert not is_group(mu)
    assert groups_of("y", [mu, supplier]) == GROUPS
    assert groups_of("y", [mu]) is None
    share = pm.draw(supplier, 4000, random_seed=1, mode=PLAIN).mean()
    # Five standard errors of a share of a half.
    assert abs(share - 0.5) < 5 * 0.5 / np.sqrt(4000)


@pytest.mark.parametrize(
    ("coords", "dim", "message"),
    [
        ({"supplier": ["a", "b"]}, "batch", "got 'batch', expected a dimension with a coordinate"),
        ({"supplier": ["a"]}, "supplier", "expected two or more different names"),
        ({"supplier": ["a", "a"]}, "supplier", "expected two or more different names"),
        ({"supplier": ["a", "b/c"]}, "supplier", "without a slash"),
    ],
)
def test_a_dimension_without_names_of_groups_is_refused(
    coords: dict[str, list[str]], dim: str, message: str
) -> None:
    with pm.Model(coords=coords), pytest.raises(ValueError, match=message):
        prb.response.group(dim)


def test_there_is_a_model_and_a_name() -> None:
    with pytest.raises(TypeError, match="got no model on the context"):
        prb.response.group("supplier")
    with pm.Model(), pytest.raises(TypeError, match="dim: got int 3"):
        prb.response.group(3)  # type: ignore[arg-type]


def test_two_partitions_are_refused() -> None:
    with pm.Model(coords={"supplier": ["a", "b"], "batch": [1, 2]}):
        both = [prb.response.group(dim) for dim in ("supplier", "batch")]
    with pytest.raises(ValueError, match=r"2 calls of .* \['supplier', 'batch'\], expected one"):
        groups_of("y", both)


def test_where_one_population_is_asked_for_groups_are_refused() -> None:
    with pm.Model(coords={"supplier": ["Adler", "Busch"]}):
        supplier = prb.response.group("supplier")
    with pytest.raises(TypeError, match=r"depends on prb.response.group\('supplier'\), expected"):
        refuse_groups("prb.sensitivity: f", [supplier])
    refuse_groups("prb.sensitivity: f", [])
