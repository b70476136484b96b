"""The sections that say what was calibrated: the model, the data, the metric."""

from __future__ import annotations

import math
from typing import Any

import xarray as xr

from prbayes._checks import Floats
from prbayes.reports.material import Material
from prbayes.reports.numbers import alike
from prbayes.reports.section import Section
from prbayes.reports.tables import rows_table


def model(m: Material) -> list[Section]:
    """Return the variables of the model, and its simulators."""
    if m.description is None:
        return []
    variables = [_named(v, "variable", "role", "distribution") for v in m.description["variables"]]
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


def _named(described: dict[str, Any], kind: str, *keys: str) -> dict[str, Any]:
    """Return some facts of what has a name."""
    return {kind: described["name"]} | {key: described[key] for key in keys}


def data(m: Material) -> list[Section]:
    """Return what the measured responses are like."""
    if not m.observed:
        return []
    rows = [{"simulator": name} | _described(y) for name, y in m.observed.items()]
    known = [] if m.description is None else m.description["simulators"]
    specimens = [f"{s['name']}: {s['specimens']}." for s in known if s["specimens"]]
    text = ("Measured responses, in the units of the response.", *specimens)
    return [Section("Data", text, rows_table(rows))]


def _described(y: Floats) -> dict[str, Any]:
    sd = float(y.std(ddof=1)) if y.size > 1 else math.nan
    low, high, mean, spread = alike((y.min(), y.max(), y.mean(), sd), sd)
    return {"N": y.size, "smallest": low, "largest": high, "mean": mean, "sd": spread}


def metric(m: Material) -> list[Section]:
    """Return the metric, and the discrepancies and epsilons of the results."""
    rows = []
    for label, calibration in m.calibrations.items():
        rows += _discrepancies(label, calibration)
    metrics = _metrics(m)
    if not rows and not metrics:
        return []
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
    table = rows_table(rows) if rows else None
    return [Section("Metric and epsilon", (about, *named), table)]


def _discrepancies(label: str, calibration: xr.Dataset) -> list[dict[str, Any]]:
    """Return a row for each simulator of a result."""
    sample_dims = [dim for dim in ("chain", "draw") if dim in calibration.dims]
    mean = calibration["discrepancy"].mean(sample_dims, skipna=False)
    rows: list[dict[str, Any]] = []
    for name in calibration["simulator"].values.tolist():
        own = calibration.sel(simulator=name)
        points = str(int(own["n_points"])) if "n_points" in own else None
        rows.append(
            {
                "result": label,
                "simulator": name,
                "discrepancy": float(mean.sel(simulator=name)),
                "Monte Carlo error": _optional(own, "discrepancy_error"),
                "epsilon": _optional(own, "epsilon"),
                "points": points,
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
