"""Schema of results in files, checked before they are reported."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes._finding import from_json

# Variables that identify a table of a decision, and the function that returns it.
_TABLES = {
    "risk": {"probability", "by_draw", "error"},
    "sensitivity": {"first", "total", "derivative"},
    "plan": {"sd", "now"},
}
CALLED = {"risk": "exceedance", "sensitivity": "sensitivity", "plan": "plan"}
# Variables and attributes that a report reads.
_OF_DECISION = {
    "risk": ("lower", "upper", "limit", "below", "prob"),
    "sensitivity": ("factor", "kind", "first_error", "total_error", "quantity", "value", "sd"),
    "plan": ("name", "candidate", "k"),
}
_OF_CALIBRATION = (
    *("epsilon", "metric", "propagation", "n_points", "required_ess", "max_lost"),
    *("discrepancy", "discrepancy_error", "weight_ess", "mean_weight", "lost_mass"),
)
_OF_TEST = ("statistic", "critical_value", "p_value", "alpha", "folded")


def kind_of_decision(table: Any) -> str | None:
    """Return the kind of a table of a decision; None for anything else."""
    if isinstance(table, xr.Dataset):
        for kind, variables in _TABLES.items():
            if variables <= set(table.data_vars):
                return kind
    return None


def complaints(tree: xr.DataTree) -> Iterator[str]:
    """Yield errors of a posterior, an optimum, a test of validity or a table: got, expected."""
    groups = {str(name): group.to_dataset() for name, group in tree.children.items()}
    if "posterior" in groups:
        yield from _of_posterior(groups)
    elif "optimum" in groups:
        yield from _of_optimum(groups)
    elif "u" in tree.data_vars:
        yield from _of_test(tree.to_dataset())
    else:
        yield from _of_decision(tree.to_dataset())
    for group in ("posterior", "optimum"):
        if group in groups:
            yield from _of_attributes(group, groups[group].attrs)
    if "observed_data" in groups:
        yield from _not_numbers("observed_data", groups["observed_data"].data_vars)


def _of_posterior(groups: Mapping[str, xr.Dataset]) -> Iterator[str]:
    draws = groups["posterior"].data_vars
    yield from _not_numbers("posterior", draws)
    yield from _without_values("posterior", draws)
    yield from _lacking(groups, "calibration", _OF_CALIBRATION)
    stats = groups.get("sample_stats")
    if stats is not None and "stage" in stats.dims:
        yield from _lacking(groups, "sample_stats", ("beta", "accept_rate", "n_steps"))
        yield from _not_numbers("sample_stats", stats.data_vars)


def _of_optimum(groups: Mapping[str, xr.Dataset]) -> Iterator[str]:
    point = groups["optimum"].data_vars
    yield from _not_numbers("optimum", point)
    yield from _without_values("optimum", point)
    yield from _lacking(groups, "calibration", ("discrepancy", "metric"))
    if "stderr" in groups:
        errors = groups["stderr"]
        for name, value in point.items():
            if name not in errors or errors[name].shape != value.shape:
                yield f"stderr: got no standard error of {name}, expected one of the same shape"


def _of_test(test: xr.Dataset) -> Iterator[str]:
    lacking = [name for name in (*_OF_TEST, "lower", "upper") if name not in test.variables]
    if lacking:
        yield f"got no {lacking}, expected a validity test saved by to_dataset()"
        return
    for name in _OF_TEST:
        if test[name].size != 1 or test[name].dtype.kind not in "fiub":
            yield f"{name}: got shape {test[name].shape}, expected one number"
            return
    u = test["u"]
    yield from _not_numbers("a validity test", {"u": u})
    if u.ndim != 1 or not u.size or not bool(((u >= 0) & (u <= 1)).all()):
        yield f"u: got shape {u.shape}, expected one or more numbers between 0 and 1"
    for name in ("condition", "specimen", "lower", "upper"):
        if name in test.variables and test[name].shape != u.shape:
            yield f"{name}: got shape {test[name].shape}, expected that of u, {u.shape}"
    for name in ("statistic", "p_value"):
        if not np.isfinite(test[name].values).all():
            yield f"{name}: got NaN or an infinite number, expected a finite one"


def _of_decision(table: xr.Dataset) -> Iterator[str]:
    kind = kind_of_decision(table) or ""
    present = {*table.variables, *table.attrs}
    lacking = [name for name in _OF_DECISION[kind] if name not in present]
    if lacking:
        yield f"got no {lacking}, expected a table of prb.{CALLED[kind]}"
        return
    yield from _not_numbers("a decision", table.data_vars)


def _of_attributes(group: str, attrs: Mapping[Any, Any]) -> Iterator[str]:
    for name in ("n_responses", "seconds"):
        value = np.asarray(attrs.get(name, 0.0))
        if value.size != 1 or value.dtype.kind not in "fiu" or np.isnan(value).any():
            yield f"{group}: {name}: got {attrs[name]!r:.60}, expected a number"
    try:
        from_json(str(attrs.get("findings", "[]")))
    except ValueError as error:
        yield f"{group}: {error}"


def _not_numbers(group: str, variables: Mapping[Any, xr.DataArray]) -> Iterator[str]:
    for name, values in variables.items():
        if values.dtype.kind not in "fiu":
            yield f"{group}: {name}: got values of dtype {values.dtype}, expected numbers"


def _without_values(group: str, variables: Mapping[Any, xr.DataArray]) -> Iterator[str]:
    for name, values in variables.items():
        if not values.size:
            yield f"{group}: {name}: got no values (shape {values.shape}), expected some"
        elif values.dtype.kind == "f" and not np.isfinite(values.values).any():
            yield f"{group}: {name}: got NaN or infinite values only, expected finite ones"


def _lacking(groups: Mapping[str, xr.Dataset], group: str, names: tuple[str, ...]) -> Iterator[str]:
    lacking = [name for name in names if group in groups and name not in groups[group]]
    if lacking:
        yield f"{group}: got no {lacking}, expected them beside {list(groups[group])}"
