"""What is told of results that are not what the package writes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr

from prbayes.reports.schema import complaints


def draws(values: Any) -> xr.Dataset:
    return xr.Dataset({"mu": (("chain", "draw"), values)})


def validity(**changes: Any) -> xr.DataTree:
    numbers = dict.fromkeys(("statistic", "critical_value", "p_value", "alpha", "folded"), 0.5)
    u = {"u": ("observation", [0.1, 0.9])}
    ends = {"lower": ("rank", [0.0, 0.1]), "upper": ("rank", [0.5, 1.0])}
    return xr.DataTree(xr.Dataset(numbers | u | ends | changes))


def posterior(**groups: xr.Dataset) -> xr.DataTree:
    given = {"posterior": draws([[0.0, 1.0]])} | groups
    return xr.DataTree.from_dict(given)


def optimum(**groups: xr.Dataset) -> xr.DataTree:
    given = {"optimum": xr.Dataset({"mu": 1.0}), "stderr": xr.Dataset({"mu": 0.1})} | groups
    return xr.DataTree.from_dict(given)


BAD: dict[str, tuple[Callable[[], xr.DataTree], str]] = {
    "draws are NaN": (
        lambda: posterior(posterior=draws(np.full((2, 9), np.nan))),
        "posterior: mu: got NaN or infinite values only, expected finite ones",
    ),
    "draws are infinite": (
        lambda: posterior(posterior=draws(np.full((2, 9), np.inf))),
        "posterior: mu: got NaN or infinite values only, expected finite ones",
    ),
    "no draws": (
        lambda: posterior(posterior=draws(np.empty((0, 0)))),
        "posterior: mu: got no values (shape (0, 0)), expected some",
    ),
    "draws are texts": (
        lambda: posterior(posterior=draws(np.array([["a", "b"]]))),
        "posterior: mu: got values of dtype <U1, expected numbers",
    ),
    "seconds are a text": (
        lambda: posterior(posterior=draws([[0.0, 1.0]]).assign_attrs(seconds="x")),
        "posterior: seconds: got 'x', expected a number",
    ),
    "stages": (
        lambda: posterior(sample_stats=xr.Dataset({"beta": ("stage", [1.0])})),
        "sample_stats: got no ['accept_rate', 'n_steps'], expected them beside ['beta']",
    ),
    "data are texts": (
        lambda: posterior(observed_data=xr.Dataset({"y": ("i", np.array(["a"]))})),
        "observed_data: y: got values of dtype <U1, expected numbers",
    ),
    "another standard error": (
        lambda: optimum(stderr=xr.Dataset({"z": 1.0})),
        "stderr: got no standard error of mu, expected one of the same shape",
    ),
    "another calibration": (
        lambda: optimum(calibration=xr.Dataset({"a": 1.0})),
        "calibration: got no ['discrepancy', 'metric'], expected them beside ['a']",
    ),
    "several statistics": (
        lambda: validity(statistic=("z", [1.0, 2.0])),
        "statistic: got shape (2,), expected one number",
    ),
    "no u-values": (
        lambda: validity(u=("observation", np.empty(0))),
        "u: got shape (0,), expected one or more numbers between 0 and 1",
    ),
    "a p-value of NaN": (
        lambda: validity(p_value=np.nan),
        "p_value: got NaN or an infinite number, expected a finite one",
    ),
    "an envelope of another length": (
        lambda: validity(lower=("other", [0.1])),
        "lower: got shape (1,), expected that of u, (2,)",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_told(case: str) -> None:
    make, expected = BAD[case]
    assert next(complaints(make())) == expected


@pytest.mark.parametrize("make", [posterior, optimum, validity])
def test_nothing_is_told_of_what_is_sound(make: Callable[[], xr.DataTree]) -> None:
    assert not list(complaints(make()))
