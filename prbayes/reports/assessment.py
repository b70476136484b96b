"""The sections of a report that judge: comparison, diagnostics, validity, and what it took."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from prbayes.reports.material import Material
from prbayes.reports.section import Section, alike, number, plus_minus, rows_table
from prbayes.reports.summary import shown, verdict


def comparison(m: Material) -> list[Section]:
    """Return the results side by side."""
    if m.comparison is None:
        return []
    table, rows = m.comparison, []
    for name in table["hyperparameter"].values.tolist():
        for label in table["result"].values.tolist():
            own = table.sel(hyperparameter=name, result=label)
            values = [float(own[key]) for key in ("estimate", "sd", "lower", "upper")]
            estimate, sd, lower, upper = alike(values, values[1])
            row = {"hyperparameter": name, "result": label, "estimate": estimate, "sd": sd}
            rows.append(row | {"89% from": lower, "to": upper, "shift in sd": _shift(float(own["shift"]))})
    labels = table["result"].values.tolist()
    scores = [
        {"under the metric": str(key)} | dict(zip(labels, values.values.tolist(), strict=True))
        for key, values in table.data_vars.items()
        if values.dims == ("result",) and key not in ("n_responses", "seconds")
    ]
    first = labels[0]
    text = f"The shift is the distance from the estimate of {first}, in standard deviations of the result in the row."
    sections = [Section("Comparison", text, rows_table(rows))]
    if scores:
        text = "Discrepancy of the population at each estimate, under each metric, whatever it was calibrated with."
        sections.append(Section("Scores under each metric", text, rows_table(scores), level=3))
    return sections


def _shift(value: float) -> str:
    return f"{value + 0.0:.2f}" if math.isfinite(value) else number(value)


def diagnostics(m: Material) -> list[Section]:
    """Return what is wrong with the results, in sentences, and what the sampler says of itself."""
    text, rows = [], []
    for label, diagnosis in m.diagnoses.items():
        who = f"{label[0].upper()}{label[1:]}: "
        if diagnosis is None:
            text.append(f"{who}not looked at, because that needs the model, which was not given.")
            continue
        text += [f"{who}{message}" for message in diagnosis.messages or ("no problem was found.",)]
        for name in diagnosis.support["simulator"].values.tolist() if "weight_ess" in diagnosis.support else ():
            own = diagnosis.support.sel(simulator=name)
            low, middle = np.quantile(own["weight_ess"].values, [0.05, 0.5])
            rows.append(
                {
                    "result": label,
                    "simulator": name,
                    "weight ESS, 5%": f"{low:.0f}",
                    "median": f"{middle:.0f}",
                    "mean weight": f"{float(own['mean_weight'].median()):.3f}",
                    "largest lost mass": number(float(own["lost_mass"].max())),
                }
            )
    text += [f"{label[0].upper()}{label[1:]}: {line}" for label in m.posteriors for line in _stages(m, label)]
    if not text:
        return []
    sections = [Section("Diagnostics", tuple(text))]
    if rows:
        about = (
            "Responses were computed once, and weighted for each set of hyperparameters. The effective sample size of "
            "the weights says on how many of them an answer rests; the mean weight is 1 where the design covers the "
            "population; lost mass is that of points without a response."
        )
        sections.append(Section("Support by stored responses", about, rows_table(rows), level=3))
    return sections


def _stages(m: Material, label: str) -> list[str]:
    """Say what the sampler says of itself."""
    tree = m.posteriors[label]
    if "sample_stats" not in tree or "stage" not in tree["sample_stats"].dims:
        return []
    stats = tree["sample_stats"].to_dataset()
    last = (~np.isnan(stats["beta"].values)).sum(axis=1)
    chains = np.arange(last.size)
    rate, steps = (stats[k].values[chains, last - 1] for k in ("accept_rate", "n_steps"))
    moved = _span(rate * steps, ".1f")
    lines = [
        f"the sampler went from the prior to the posterior in {_span(last, '.0f')} stages; in the last one it accepted "
        f"{_span(100 * rate, '.0f')}% of the proposals, and each particle moved {moved} times on average."
    ]
    attrs = tree["posterior"].attrs
    if "log_marginal_likelihood" in attrs:
        evidence, spread = (float(attrs[f"log_marginal_likelihood{s}"]) for s in ("", "_sd"))
        lines.append(
            f"log marginal likelihood {plus_minus(evidence, spread)} (spread between chains); comparable between "
            "models with the same metric and epsilon only."
        )
    return lines


def _span(values: Any, form: str) -> str:
    low, high = f"{values.min():{form}}", f"{values.max():{form}}"
    return low if low == high else f"{low} to {high}"


def validity(m: Material) -> list[Section]:
    """Return the verdicts of the validity tests."""
    if not m.tests:
        return []
    rows = [
        {
            "test": label if len(m.tests) > 1 else "area test",
            "values": t.u_values.size,
            "specimens": np.unique(t.specimens).size,
            "of": "|2u - 1|" if t.folded else "u",
            "area": f"{t.statistic:.4f}",
            "critical value": f"{t.critical_value:.4f}",
            "p-value": f"{t.p_value:.3f}",
            "level": f"{100 * t.level:g}%",
            "verdict": "rejected" if t.rejected else "not rejected",
        }
        for label, t in m.tests.items()
    ]
    about = (
        "The u-value of a measured response is its place in the predicted distribution, between 0 and 1. The statistic "
        "is the area between the distribution of the u-values and the uniform one; a larger area than the critical "
        "value rejects the model. Of u the area sees a wrong mean, of |2u - 1| a wrong spread. That a model is not "
        "rejected does not prove it."
    )
    held = dict.fromkeys(f"Held to be true: {t.null}." for t in m.tests.values())
    return [
        Section("Validity", (*(verdict(label, t, m) for label, t in m.tests.items()), about, *held), rows_table(rows))
    ]


def origin(m: Material) -> list[Section]:
    """Return versions, seeds, and what the results cost."""
    rows: list[dict[str, Any]] = []
    versions: dict[str, str] = {}
    for label in m.results:
        attrs = m.attrs(label)
        seed = attrs.get("random_seed")
        rows.append(
            {
                "result": label,
                "by": str(attrs.get("sampler", "minimize" if label in m.optima else "")),
                "responses": str(int(attrs["n_responses"])) if "n_responses" in attrs else None,
                "seconds": shown(float(attrs["seconds"])) if "seconds" in attrs else None,
                "seed": None if seed is None else str(seed),
            }
        )
        versions |= {k.removesuffix("_version"): str(v) for k, v in attrs.items() if str(k).endswith("_version")}
    if not rows:
        return []
    made = ", ".join(f"{name} {version}" for name, version in versions.items() if name != "inference_library")
    text = ["Responses are scalar evaluations of the simulated response, those of a common design counted in each."]
    return [Section("Cost and origin", (*text, *([f"Computed with {made}."] if made else [])), rows_table(rows))]
