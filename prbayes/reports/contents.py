"""From results to the sections of a report."""

from __future__ import annotations

import math
from importlib import import_module
from typing import Any

import numpy as np
import xarray as xr

from prbayes.reports.assessment import comparison as comparison_of
from prbayes.reports.assessment import diagnostics, origin
from prbayes.reports.assessment import validity as validity_of
from prbayes.reports.illustrations import illustrate, with_graph
from prbayes.reports.material import Material, elements, gather
from prbayes.reports.section import NOTHING, Section, alike, number, places, rows_table
from prbayes.reports.summary import counted, summary

_COLUMNS = {
    "mean": "mean",
    "sd": "sd",
    "eti89_lb": "89% from",
    "eti89_ub": "to",
    "ess_bulk": "ESS, bulk",
    "ess_tail": "ESS, tail",
    "r_hat": "R-hat",
    "mcse_mean": "error of mean",
}


def contents(
    model: Any, optimum: Any, posterior: Any, validity: Any, comparison: Any, *, pictures: bool
) -> tuple[Section, ...]:
    """Return the sections that the results allow, with pictures if wanted."""
    m = gather(model, optimum, posterior, validity, comparison)
    parts = (_summary, _model, _data, _metric, _optimum, _posterior, comparison_of, diagnostics, validity_of, origin)
    sections = tuple(section for part in parts for section in part(m))
    if not pictures:
        return sections
    return illustrate(with_graph(sections, m), m)


def _summary(m: Material) -> list[Section]:
    return [Section("Summary", tuple(summary(m)))] if m.results or m.tests or m.description else []


def _model(m: Material) -> list[Section]:
    if m.description is None:
        return []
    variables, simulators = m.description["variables"], m.description["simulators"]
    sections = [
        Section(
            "Model",
            "Hyperparameters describe how the inputs vary from specimen to specimen, and have prior distributions.",
            rows_table(
                [{"variable": v["name"], "role": v["role"], "distribution": v["distribution"]} for v in variables]
            ),
        )
    ]
    if simulators:
        rows = [
            {
                "simulator": s["name"],
                "response": s["response"],
                "inputs": s["inputs"],
                "propagation": s["propagation"],
            }
            for s in simulators
        ]
        text = "A simulator computes the response of a specimen from its inputs."
        sections.append(Section("Simulators", text, rows_table(rows), level=3))
    return sections


def _data(m: Material) -> list[Section]:
    if not m.observed:
        return []
    rows: list[dict[str, Any]] = []
    for name, y in m.observed.items():
        sd = float(y.std(ddof=1)) if y.size > 1 else math.nan
        low, high, mean, spread = alike((y.min(), y.max(), y.mean(), sd), sd)
        row = {"simulator": name, "N": y.size, "smallest": low, "largest": high, "mean": mean, "sd": spread}
        rows.append(row)
    known = (m.description or {"simulators": []})["simulators"]
    labels = [f"{s['name']}: {s['specimens']}." for s in known if s["specimens"]]
    return [Section("Data", ("Measured responses, in the units of the response.", *labels), rows_table(rows))]


def _metric(m: Material) -> list[Section]:
    rows = []
    for label, tree in m.results.items():
        if "calibration" not in tree:
            continue
        calibration = tree["calibration"].to_dataset()
        mean = calibration["discrepancy"].mean([d for d in ("chain", "draw") if d in calibration.dims], skipna=False)
        for name in calibration["simulator"].values.tolist():
            own = calibration.sel(simulator=name)
            rows.append(
                {
                    "result": label,
                    "simulator": name,
                    "discrepancy": float(mean.sel(simulator=name)),
                    "Monte Carlo error": _item(own, "discrepancy_error"),
                    "epsilon": _item(own, "epsilon"),
                    "points": str(int(own["n_points"])) if "n_points" in own else None,
                }
            )
    metrics = _metrics(m)
    if not rows and not metrics:
        return []
    text = (
        "The metric measures how far the distribution of the simulated responses is from that of the measured ones; "
        "smaller is better."
    )
    if any(row.get("epsilon") is not None for row in rows):
        text += (
            " Epsilon is the discrepancy that the sampler takes for one unit of log-density. The discrepancy of a "
            "posterior is the mean over its draws."
        )
    named = [f"{name}: {metric}." for name, metric in metrics.items()]
    return [Section("Metric and epsilon", (text, *named), rows_table(rows) if rows else None)]


def _metrics(m: Material) -> dict[str, str]:
    """Return the metric by simulator; by result as well, where results differ in it."""
    found = {}
    for label, tree in m.results.items():
        if "calibration" in tree:
            calibration = tree["calibration"].to_dataset()
            pairs = zip(calibration["simulator"].values.tolist(), calibration["metric"].values.tolist(), strict=True)
            found[label] = {str(name): str(metric) for name, metric in pairs}
    if not found and m.description is not None:
        return {s["name"]: s["metric"] for s in m.description["simulators"]}
    rows = list(found.values())
    if all(row == rows[0] for row in rows):
        return rows[0] if rows else {}
    return {f"{label}, {name}": metric for label, row in found.items() for name, metric in row.items()}


def _item(dataset: xr.Dataset, name: str) -> float | None:
    return float(dataset[name]) if name in dataset else None


def _optimum(m: Material) -> list[Section]:
    sections = []
    for label, tree in m.optima.items():
        points, errors = elements(tree["optimum"].to_dataset()), elements(tree["stderr"].to_dataset())
        rows = []
        for name, value in points.items():
            sd = float(errors[name][0])
            estimate, error = alike((float(value[0]), sd), sd)
            rows.append({"hyperparameter": name, "estimate": estimate, "standard error": error})
        attrs = tree["optimum"].attrs
        said = "converged" if attrs.get("converged") else "did not converge"
        n = counted(int(attrs.get("n_evaluations", 0)), "evaluation")
        text = [f"The optimiser {said} after {n} of the objective: {str(attrs.get('message', '')).rstrip('.')}."]
        optimum = m.found.get(label)
        for rival in optimum.rivals if optimum is not None else ():
            at = ", ".join(f"{k} = {number(v)}" for k, v in rival["point"].items() if np.ndim(v) == 0)
            how = "the data could as well come from there" if rival["comparable"] else "the data speak against it"
            text.append(f"Another optimum is at {at}, with discrepancy {number(float(rival['discrepancy']))}: {how}.")
        text.append("Standard errors are those of the estimator over repeated sets of as many specimens.")
        sections.append(Section(_titled("Optimum", label, m.optima), tuple(text), rows_table(rows)))
    return sections


def _titled(what: str, label: str, among: dict[str, Any]) -> str:
    return what if len(among) == 1 else f"{what}: {label}"


def _posterior(m: Material) -> list[Section]:
    arviz: Any = import_module("arviz") if m.posteriors else None
    sections = []
    for label, tree in m.posteriors.items():
        with np.errstate(all="ignore"):  # a variable that never moves
            table = arviz.summary(tree, kind="all", ci_prob=0.89, ci_kind="eti", round_to="none")
        rows = []
        for name, row in table.iterrows():
            kept = {column: float(row[key]) for key, column in _COLUMNS.items()}
            exact = alike([kept[c] for c in ("mean", "sd", "89% from", "to")], kept["sd"])
            rows.append(
                {"variable": str(name)}
                | dict(zip(("mean", "sd", "89% from", "to"), exact, strict=True))
                | {c: _whole(kept[c]) for c in ("ESS, bulk", "ESS, tail")}
                | {"R-hat": NOTHING if math.isnan(kept["R-hat"]) else f"{kept['R-hat']:.3f}"}
                | {"error of mean": _error(kept["error of mean"])}
            )
        sizes = tree["posterior"].sizes
        attrs = tree["posterior"].attrs
        by = f" by {attrs['sampler']}" if "sampler" in attrs else ""
        chains = counted(int(sizes["chain"]), "chain")
        text = [f"{chains} of {sizes['draw']} draws{by}. Intervals hold 89% of the draws, with equal tails."]
        adjustment = str(attrs.get("adjustment", "none"))
        if "adjustment" in attrs:
            if adjustment.startswith("none"):
                why = adjustment.removeprefix("none").removeprefix(": ")
                text.append(f"The draws are not adjusted{f' ({why})' if why else ''}: their width is that of epsilon.")
            else:
                text.append(
                    "The draws are adjusted to the width that the data warrant: that of the metric's own estimate over "
                    f"repeated sets of specimens, combined with the prior ({adjustment})."
                )
        sections.append(Section(_titled("Posterior", label, m.posteriors), tuple(text), rows_table(rows)))
    return sections


def _whole(value: float) -> str:
    return NOTHING if not math.isfinite(value) else f"{value:.0f}"


def _error(value: float) -> str:
    decimals = places(value, 2)
    return number(value) if decimals is None else f"{value:.{decimals}f}"
