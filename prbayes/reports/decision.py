"""The decision: what is risked, what moves it, and what more data would change."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes.reports.material import Material
from prbayes.reports.numbers import number, percentage
from prbayes.reports.section import Section
from prbayes.reports.tables import rows_table


def decision(m: Material) -> list[Section]:
    """Return what was asked for a decision, a table for each kind of question."""
    if not m.decisions:
        return []
    about = "These answers count that the hyperparameters are uncertain, as the posterior says."
    found = [Section("Decision", about)]
    for kind, (title, text, rows_of) in _KINDS.items():
        rows = []
        for label, table in m.decisions.items():
            if kind_of_decision(table) == kind:
                rows += [{"question": label} | row for row in rows_of(table)]
        if rows:
            found.append(Section(title, text, rows_table(rows), level=3))
    return found


def refuse_decisions(given: Any) -> None:
    """Raise if it is no table of a decision, or no mapping of such."""
    if given is None:
        return
    several = isinstance(given, Mapping) and not isinstance(given, xr.Dataset)
    for table in given.values() if several else [given]:
        if kind_of_decision(table) is None:
            raise TypeError(
                f"Report: decision: got {type(table).__name__}, expected the Dataset of "
                "prb.exceedance, prb.sensitivity or prb.plan, or several by name"
            )


def kind_of_decision(table: Any) -> str | None:
    """Return of which function a table is; None if of none."""
    if not isinstance(table, xr.Dataset):
        return None
    for kind, variables in _VARIABLES.items():
        if variables <= set(table.data_vars):
            return kind
    return None


def _risk(table: xr.Dataset) -> list[dict[str, Any]]:
    """Return the rows of a probability, one for each bound."""
    values, errors = (np.atleast_1d(table[key].values) for key in ("probability", "error"))
    bounds = table["bound"].values if "bound" in table.coords else [""]
    beyond = "below" if table.attrs["below"] else "above"
    interval = f"{number(float(table.lower))} to {number(float(table.upper))}"
    return [
        {
            "beyond": f"{beyond} {number(table.attrs['limit'])}",
            "bound": str(bound),
            "probability": number(float(value)),
            "error by points": number(float(error), 2),
            f"{percentage(table.attrs['level'])} interval": interval,
        }
        for bound, value, error in zip(bounds, values, errors, strict=True)
    ]


def _shares(table: xr.Dataset) -> list[dict[str, Any]]:
    """Return the rows of shares, one for each factor."""
    return [
        {
            "of": table.attrs["quantity"],
            "factor": str(factor),
            "kind": str(kind),
            "by itself": _share(table, "first", i),
            "with all others known": _share(table, "total", i),
        }
        for i, (factor, kind) in enumerate(zip(table.factor.values, table.kind.values, strict=True))
    ]


def _share(table: xr.Dataset, key: str, i: int) -> str:
    value = float(table[key][i])
    error = float(table[f"{key}_error"][i])
    return f"{value:.2f} ± {error:.2f}" if np.isfinite(value) else ""


def _plan(table: xr.Dataset) -> list[dict[str, Any]]:
    """Return the rows of a plan, the present first."""
    names = [str(name) for name in table.name.values]
    now = {name: number(float(table.now.sel(name=name)), 3) for name in names}
    rows = [{"specimens": "none more", **now}]
    for candidate in table.candidate.values:
        for k in table.k.values:
            sd = table.sd.sel(candidate=candidate, k=k)
            own = {name: number(float(sd.sel(name=name)), 3) for name in names}
            rows.append({"specimens": f"{k} more, {candidate}", **own})
    return rows


_VARIABLES = {
    "risk": {"probability", "by_draw", "error"},
    "sensitivity": {"first", "total", "derivative"},
    "plan": {"sd", "now"},
}
_Rows = Callable[[xr.Dataset], list[dict[str, Any]]]
_KINDS: dict[str, tuple[str, str, _Rows]] = {
    "risk": (
        "Probability of exceedance",
        "The probability is that of a new specimen; the interval is that of the share in a large "
        "batch.",
        _risk,
    ),
    "sensitivity": (
        "What moves it",
        "Of hyperparameters the share of the quantity's variance that knowing one would remove, "
        "and that is left when all others are known; of inputs the shares of the response's "
        "scatter.",
        _shares,
    ),
    "plan": (
        "What more data would change",
        "Standard deviations that are expected after further specimens.",
        _plan,
    ),
}
