"""The section of a report on a decision: risk, sensitivity, and the value of more data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes.plots._labels import named
from prbayes.reports.material import Material
from prbayes.reports.numbers import number, percentage, plus_minus, rows_table
from prbayes.reports.schema import kind_of_decision
from prbayes.reports.section import Section


def decision(m: Material) -> list[Section]:
    """Return the answers for a decision, a table for each kind of question."""
    if not m.decisions:
        return []
    about = ["These answers include the uncertainty of the hyperparameters by the posterior."]
    if m.rejected:
        about.insert(
            0,
            "The calibrated model was rejected, see Validity: these answers are of a model that "
            "data contradict. Do not rely on them.",
        )
    sections = [Section("Decision", about)]
    for kind, (title, text, rows_of) in _KINDS.items():
        rows = [
            {"question": label} | row
            for label, table in m.decisions.items()
            if kind_of_decision(table) == kind
            for row in rows_of(table, m.labels)
        ]
        if rows:
            sections.append(Section(title, text, rows_table(rows), level=3))
    return sections


def _risk(table: xr.Dataset, labels: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the rows of a probability, one for each bound."""
    values, errors = (np.atleast_1d(table[key].values) for key in ("probability", "error"))
    bounds = table["bound"].values if "bound" in table.coords else [""]
    beyond = "below" if table.attrs["below"] else "above"
    required = verdict = ""
    if "requirement" in table.attrs:
        required = f"at most {table.attrs['requirement']:g}"
        verdict = str(table.attrs["verdict"])
    return [
        {
            "beyond": f"{beyond} {table.attrs['limit']:g}",
            "bound": str(bound),
            "probability": number(float(value), 2),
            "its error": number(float(error), 1),
            f"{percentage(table.attrs['prob'])} interval": interval_of(table),
            "required": required,
            "requirement is": verdict,
        }
        for bound, value, error in zip(bounds, values, errors, strict=True)
    ]


def interval_of(table: xr.Dataset) -> str:
    """Return the interval of a probability, as text."""
    return f"{number(float(table.lower), 2)} to {number(float(table.upper), 2)}"


def _indices(table: xr.Dataset, labels: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the rows of sensitivity indices, one for each factor."""
    value = plus_minus(float(table.attrs["value"]), float(table.attrs["sd"]))
    quantity = f"{table.attrs['quantity']} = {value}"
    response = str(table.attrs.get("of_inputs", "the response"))
    return [
        {
            "of": response if str(kind) == "input" else quantity,
            "factor": named(str(factor), labels),
            "by itself": _index(table, "first", i),
            "with all others known": _index(table, "total", i),
        }
        for i, (factor, kind) in enumerate(zip(table.factor.values, table.kind.values, strict=True))
    ]


def _index(table: xr.Dataset, key: str, i: int) -> str:
    value = float(table[key][i])
    error = float(table[f"{key}_error"][i])
    return f"{value:.2f} ± {error:.2f}" if np.isfinite(value) else ""


def _plan(table: xr.Dataset, labels: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the rows of a plan, the present first."""
    names = [str(name) for name in table.name.values]

    def row(text: str, sd: xr.DataArray) -> dict[str, Any]:
        sds = {name: number(float(sd.sel(name=name)), 3) for name in names}
        return {"specimens": text, **sds}

    rows = [row("none more", table.now)]
    for candidate in table.candidate.values:
        for k in table.k.values:
            sd = table.sd.sel(candidate=candidate, k=k)
            rows.append(row(f"{k} more, {candidate}", sd))
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
        _indices,
    ),
    "plan": (
        "What more data would change",
        "Standard deviations that are expected after further specimens.",
        _plan,
    ),
}
