"""The decision: what is risked, what moves it, and what more data would change."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes.plots._labels import named
from prbayes.reports.material import Material
from prbayes.reports.numbers import number, percentage, plus_minus
from prbayes.reports.schema import kind_of_decision
from prbayes.reports.section import Section
from prbayes.reports.tables import rows_table

REJECTED = (
    "The calibrated model was rejected, see Validity: these are the answers of a model that data "
    "contradict, and not to be relied on."
)


def decision(m: Material) -> list[Section]:
    """Return what was asked for a decision, a table for each kind of question."""
    if not m.decisions:
        return []
    about = ["These answers count that the hyperparameters are uncertain, as the posterior says."]
    if m.rejected:
        about.insert(0, REJECTED)
    found = [Section("Decision", about)]
    for kind, (title, text, rows_of) in _KINDS.items():
        rows = []
        for label, table in m.decisions.items():
            if kind_of_decision(table) == kind:
                rows += [{"question": label} | row for row in rows_of(table, m.labels)]
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


def _risk(table: xr.Dataset, labels: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the rows of a probability, one for each bound."""
    values, errors = (np.atleast_1d(table[key].values) for key in ("probability", "error"))
    bounds = table["bound"].values if "bound" in table.coords else [""]
    beyond = "below" if table.attrs["below"] else "above"
    interval = interval_of(table)
    return [
        {
            "beyond": f"{beyond} {table.attrs['limit']:g}",
            "bound": str(bound),
            "probability": number(float(value), 2),
            "its error": number(float(error), 1),
            f"{percentage(table.attrs['prob'])} interval": interval,
            **_required(table),
        }
        for bound, value, error in zip(bounds, values, errors, strict=True)
    ]


def interval_of(table: xr.Dataset) -> str:
    """Return the interval of a probability, as text."""
    return f"{number(float(table.lower), 2)} to {number(float(table.upper), 2)}"


def _required(table: xr.Dataset) -> dict[str, str]:
    """Return what was required of a probability, and whether it is met."""
    if "requirement" not in table.attrs:
        return {"required": "", "requirement is": ""}
    most = f"at most {table.attrs['requirement']:g}"
    return {"required": most, "requirement is": str(table.attrs["verdict"])}


def _shares(table: xr.Dataset, labels: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the rows of shares, one for each factor."""
    return [
        {
            "of": _of_what(table, str(kind)),
            "factor": named(str(factor), labels),
            "by itself": _share(table, "first", i),
            "with all others known": _share(table, "total", i),
        }
        for i, (factor, kind) in enumerate(zip(table.factor.values, table.kind.values, strict=True))
    ]


def _of_what(table: xr.Dataset, kind: str) -> str:
    """Return what a factor has a share of."""
    if kind == "input":
        return str(table.attrs.get("of_inputs", "the response"))
    value = plus_minus(float(table.attrs["value"]), float(table.attrs["sd"]))
    return f"{table.attrs['quantity']} = {value}"


def _share(table: xr.Dataset, key: str, i: int) -> str:
    value = float(table[key][i])
    error = float(table[f"{key}_error"][i])
    return f"{value:.2f} ± {error:.2f}" if np.isfinite(value) else ""


def _plan(table: xr.Dataset, labels: Mapping[str, str]) -> list[dict[str, Any]]:
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


_Rows = Callable[[xr.Dataset, Mapping[str, str]], list[dict[str, Any]]]
_KINDS: dict[str, tuple[str, str, _Rows]] = {
    "risk": (
        "Probability of exceedance",
        "The probability is that of a new specimen; the interval is that of the share in a large "
        "batch. A requirement is met if the whole interval is below it, not met if all of it is "
        "above, and else not decided.",
        _risk,
    ),
    "sensitivity": (
        "What moves it",
        "The share of a variance that knowing a factor would remove, and that is left when all "
        "others are known: of hyperparameters, in the uncertainty of the quantity; of inputs, in "
        "the scatter of specimens.",
        _shares,
    ),
    "plan": (
        "What more data would change",
        "Standard deviations that are expected after further specimens.",
        _plan,
    ),
}
