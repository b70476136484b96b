"""The sections that say what was calibrated: the model, the data, the metric."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import Floats
from prbayes.optimize.optimum import compared_in
from prbayes.plots.outputs import correlation
from prbayes.reports.material import Material
from prbayes.reports.numbers import NOTHING, alike
from prbayes.reports.section import Section
from prbayes.reports.tables import rows_table
from prbayes.response.outputs import ONE


def model(m: Material) -> list[Section]:
    """Return the variables of the model, and its simulators."""
    if m.description is None:
        return []
    variables = []
    for v in m.description["variables"]:
        own = _named(v, "variable", "role", "distribution")
        variables.append(own | {"meaning": m.labels.get(v["name"], "")})
    about = (
        "Hyperparameters describe how the inputs vary from specimen to specimen, "
        "and have prior distributions."
    )
    sections = [Section("Model", about, rows_table(variables))]
    simulators = [
        _named(s, "simulator", "response", "inputs", "propagation")
        for s in m.description["simulators"]
    ]
    if simulators:
        about = "A simulator computes the response of a specimen from its inputs."
        sections.append(Section("Simulators", about, rows_table(simulators), level=3))
    return sections


def _named(facts: dict[str, Any], kind: str, *keys: str) -> dict[str, Any]:
    """Return some facts of what has a name."""
    return {kind: facts["name"]} | {key: facts[key] for key in keys}


def data(m: Material) -> list[Section]:
    """Return what the measured responses are like, and how outputs depend on each other."""
    if not m.observed:
        return []
    rows = []
    for name in m.observed:
        rows += _rows_of(name, m)
    for key in ("failed", "missing"):
        if any(row[key] for row in rows):
            rows = [row | {key: row[key] or "0"} for row in rows]
    text = ["Measured responses, in the units of the response."]
    known = [] if m.description is None else m.description["simulators"]
    for simulator in known:
        if simulator["specimens"]:
            text.append(f"{simulator['name']}: {simulator['specimens']}.")
    correlations = []
    for name, y in m.observed.items():
        if y.ndim == 1:
            continue
        untold = _untold(name, m)
        if untold:
            text.append(untold)
        if y.shape[1] > 1:
            correlations.append(_correlations(name, m))
    return [Section("Data", tuple(text), rows_table(rows)), *correlations, *_values(m)]


# Measured values of a simulator that are printed: half a page.
_MOST_VALUES = 300


def _values(m: Material) -> list[Section]:
    """Return the measured values themselves, by which a calibration can be made again."""
    text = []
    for name, y in m.observed.items():
        if y.size > _MOST_VALUES:
            text.append(f"{name}: {y.size} values, which are too many to print.")
        elif y.ndim == 1:
            text.append(f"{name}: {_listed(y)}.")
        else:
            names = m.outputs[name].names
            text += [f"{name}[{names[j]}]: {_listed(y[:, j])}." for j in range(y.shape[1])]
    about = f"In the order of the specimens; {NOTHING} was not measured, ∞ is a failure."
    return [Section("Measured values", (about, *text), level=3)]


def _listed(y: Floats) -> str:
    """Return values one after the other, with the digits that their spread warrants."""
    finite = y[np.isfinite(y)]
    sd = float(finite.std(ddof=1)) if finite.size > 1 else math.nan
    return ", ".join(alike(y.tolist(), sd, 4))


# Outputs of a simulator that have a row: half a page; of more, as of a curve, some from the first
# to the last.
_MOST_ROWS = 12


def _rows_of(name: str, m: Material) -> list[dict[str, Any]]:
    """Return a row for each output of a simulator."""
    y = m.observed[name]
    outputs = m.outputs.get(name, ONE)
    if y.ndim == 1:
        units = outputs.units[0] if outputs.units else ""
        meaning = m.labels.get(name, "")
        about = {"simulator": name, "meaning": meaning, "output": "", "units": units}
        return [about | described(y)]
    rows = []
    for j in _told(y):
        units = outputs.units[j] if outputs.units else ""
        own = outputs.names[j]
        meaning = m.labels.get(f"{name}[{own}]", m.labels.get(own, ""))
        about = {"simulator": name, "meaning": meaning, "output": own, "units": units}
        rows.append(about | described(y[:, j]))
    return rows


def _told(y: Floats) -> list[int]:
    """Return the outputs that are told of."""
    m = y.shape[1]
    places = np.linspace(0, m - 1, min(m, _MOST_ROWS))
    return [round(place) for place in places.tolist()]


def _untold(name: str, m: Material) -> str:
    """Say so where not all outputs are told of."""
    all_of_them = m.observed[name].shape[1]
    told = len(_told(m.observed[name]))
    return f"{name}: {told} of {all_of_them} outputs are told." if told < all_of_them else ""


def described(y: Floats) -> dict[str, Any]:
    """Describe one output: NaN was not measured, +inf has failed."""
    measured = y[~np.isnan(y)]
    finite = measured[np.isfinite(measured)]
    failed = measured.size - finite.size
    missing = y.size - measured.size
    sd = float(finite.std(ddof=1)) if finite.size > 1 else math.nan
    told = [math.nan] * 3
    if finite.size:
        told = [float(finite.min()), float(finite.max()), float(finite.mean())]
    low, high, mean, spread = alike((*told, sd), sd)
    return {
        "N": measured.size,
        "failed": str(failed) if failed else "",
        "missing": str(missing) if missing else "",
        "smallest": low,
        "largest": high,
        "mean": mean,
        "sd": spread,
    }


def _correlations(name: str, m: Material) -> Section:
    """Return the correlations of outputs, each of the specimens that have both."""
    y = m.observed[name]
    names = m.outputs[name].names
    told = _told(y)
    rows = []
    for i in told:
        row = {"": names[i]}
        for j in told:
            row[names[j]] = "1" if i == j else _correlation(y[:, [i, j]])
        rows.append(row)
    about = (
        f"Correlations of the measured outputs of {name}, each of the specimens that have both; "
        "those that failed are in none."
    )
    return Section(f"Correlations of {name}", about, rows_table(rows), level=3)


def _correlation(pairs: Floats) -> str:
    """Return the correlation of two outputs as text."""
    known = pairs[np.isfinite(pairs).all(axis=1)]
    r = correlation(known, np.ones(len(known))) if len(known) > 2 else math.nan
    return NOTHING if math.isnan(r) else f"{r + 0.0:.3f}"


def metric(m: Material) -> list[Section]:
    """Return the metric, and the discrepancies and epsilons of the results."""
    rows = []
    for label, calibration in m.calibrations.items():
        rows += _discrepancies(label, calibration)
    metrics = _metrics(m)
    if not rows and not metrics:
        return []
    if m.is_by_specimen:
        return [_log_likelihood(rows)]
    about = (
        "The metric measures how far the distribution of the simulated responses is "
        "from that of the measured ones; smaller is better."
    )
    if any(row["epsilon"] is not None for row in rows):
        about += (
            " Epsilon is the discrepancy that the sampler takes for one unit of log-density."
            " The discrepancy of a posterior is the mean over its draws."
        )
    named = [f"{name}: {metric}." for name, metric in metrics.items()]
    compared = [line for each in m.calibrations.values() for line in compared_in(each)]
    named += dict.fromkeys(compared)
    table = rows_table(rows) if rows else None
    return [Section("Metric and epsilon", (about, *named), table)]


def _log_likelihood(rows: list[dict[str, Any]]) -> Section:
    """Return the section of results of the log-likelihood by specimen."""
    about = (
        "The log-likelihood compares specimens: the density of each measured response in the "
        "population, through the inputs that reproduce it. It is evaluated on an emulator of the "
        "response, whose runs are counted here. The log-likelihood of a posterior is the mean over "
        "its draws."
    )
    table = [
        {
            "result": row["result"],
            "simulator": row["simulator"],
            "log-likelihood": -row["discrepancy"],
            "runs": row["runs"],
        }
        for row in rows
    ]
    return Section("Log-likelihood", about, rows_table(table))


def _discrepancies(label: str, calibration: xr.Dataset) -> list[dict[str, Any]]:
    """Return a row for each simulator of a result."""
    sample_dims = [dim for dim in ("chain", "draw") if dim in calibration.dims]
    mean = calibration["discrepancy"].mean(sample_dims, skipna=False)
    rows: list[dict[str, Any]] = []
    for name in calibration["simulator"].values.tolist():
        own = calibration.sel(simulator=name)
        runs = str(int(own["n_runs"])) if "n_runs" in own else None
        rows.append(
            {
                "result": label,
                "simulator": name,
                "discrepancy": float(mean.sel(simulator=name)),
                "Monte Carlo error": _optional(own, "discrepancy_error"),
                "epsilon": _optional(own, "epsilon"),
                "runs": runs,
            }
        )
    return rows


def _optional(dataset: xr.Dataset, name: str) -> float | None:
    return float(dataset[name]) if name in dataset else None


def _metrics(m: Material) -> dict[str, str]:
    """Return the metric by simulator; by result as well, where results differ in it."""
    by_result: dict[str, dict[str, str]] = {}
    for label, calibration in m.calibrations.items():
        simulators = map(str, calibration["simulator"].values.tolist())
        metrics = map(str, calibration["metric"].values.tolist())
        by_result[label] = dict(zip(simulators, metrics, strict=True))
    if by_result:
        first, *others = by_result.values()
        if all(other == first for other in others):
            return first
        found = {}
        for label, by_simulator in by_result.items():
            for name, metric in by_simulator.items():
                found[f"{label}, {name}"] = metric
        return found
    if m.description is None:
        return {}
    return {s["name"]: s["metric"] for s in m.description["simulators"]}
