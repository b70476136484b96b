"""The sections of a report that judge: comparison, diagnostics, validity, and what it took."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes._stats import INTERVAL
from prbayes.plots._labels import named
from prbayes.plots.validity import in_directions
from prbayes.reports.material import Material
from prbayes.reports.numbers import (
    alike,
    number,
    percentage,
    plus_minus,
    probability,
    shown,
    span,
)
from prbayes.reports.problem import described
from prbayes.reports.schema import CALLED, kind_of_decision
from prbayes.reports.section import Section
from prbayes.reports.summary import verdict
from prbayes.reports.tables import rows_table
from prbayes.results.diagnose import Diagnosis
from prbayes.validation.area_test import ValidityTest
from prbayes.validation.conditions import Comparable, comparables

# -- comparison ------------------------------------------------------------------------------


def comparison(m: Material) -> list[Section]:
    """Return the results side by side."""
    if m.comparison is None:
        return []
    table = m.comparison
    labels = table["result"].values.tolist()
    rows = []
    for name in table["hyperparameter"].values.tolist():
        for label in labels:
            own = table.sel(hyperparameter=name, result=label)
            rows.append({"hyperparameter": name, "result": label} | _estimate(own))
    about = (
        f"The shift is the distance from the estimate of {labels[0]}, "
        "in standard deviations of the result in the row."
    )
    sections = [Section("Comparison", about, rows_table(rows))]
    scores = _scores(table)
    if scores:
        about = (
            "Discrepancy of the population at each estimate, under each metric, "
            "whatever it was calibrated with."
        )
        sections.append(Section("Scores under each metric", about, rows_table(scores), level=3))
    return sections


def _estimate(own: xr.Dataset) -> dict[str, str]:
    """Return an estimate with its spread, as text."""
    values = [float(own[key]) for key in ("estimate", "sd", "lower", "upper")]
    estimate, sd, lower, upper = alike(values, values[1])
    shift = float(own["shift"])
    return {
        "estimate": estimate,
        "sd": sd,
        f"{INTERVAL:.0%} from": lower,
        "to": upper,
        "shift in sd": f"{shift + 0.0:.2f}" if math.isfinite(shift) else number(shift),
    }


def _scores(table: xr.Dataset) -> list[dict[str, Any]]:
    labels = table["result"].values.tolist()
    rows = []
    for key, values in table.data_vars.items():
        if values.dims == ("result",) and key not in ("n_responses", "seconds"):
            by_result = dict(zip(labels, values.values.tolist(), strict=True))
            rows.append({"under the metric": str(key)} | by_result)
    return rows


# -- diagnostics -----------------------------------------------------------------------------


def diagnostics(m: Material) -> list[Section]:
    """Return what is wrong with the results, in sentences, and what the sampler says of itself."""
    text: list[str] = []
    rows: list[dict[str, Any]] = []
    for label, diagnosis in m.diagnoses.items():
        text += [f"{_capital(label)}: {sentence}" for sentence in _sentences(diagnosis)]
        if diagnosis is not None:
            rows += _support(label, diagnosis.support)
    for label, tree in m.posteriors.items():
        sentences = _of_itself(tree, by_specimen=m.is_by_specimen)
        text += [f"{_capital(label)}: {sentence}" for sentence in sentences]
    if not text:
        return []
    sections = [Section("Diagnostics", text)]
    if rows:
        about = (
            "Responses were computed once, and weighted for each set of hyperparameters. "
            "The effective sample size of the weights says on how many of them an answer rests; "
            "the mean weight is 1 where the design covers the population; "
            "lost mass is that of points without a response."
        )
        sections.append(Section("Support by stored responses", about, rows_table(rows), level=3))
    return sections


def _capital(label: str) -> str:
    return f"{label[0].upper()}{label[1:]}"


def _sentences(diagnosis: Diagnosis | None) -> tuple[str, ...]:
    if diagnosis is None:
        return ("not looked at, because that needs the model, which was not given.",)
    clear = diagnosis.all_clear
    messages = diagnosis.messages or (f"{clear[0].lower()}{clear[1:]}",)
    return (*messages, *diagnosis.notes, *diagnosis.untested)


def _support(label: str, support: xr.Dataset) -> list[dict[str, Any]]:
    """Return a row for each simulator with stored responses."""
    if "weight_ess" not in support:
        return []
    rows = []
    for name in support["simulator"].values.tolist():
        own = support.sel(simulator=name)
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
    return rows


def _of_itself(tree: xr.DataTree, *, by_specimen: bool) -> list[str]:
    """Say what `sample_smc` says of itself; nothing of other samplers."""
    if "sample_stats" not in tree or "stage" not in tree["sample_stats"].dims:
        return []
    # Chains have different numbers of stages: NaN from the end of a chain on.
    stats = tree["sample_stats"].to_dataset()
    stages = (~np.isnan(stats["beta"].values)).sum(axis=1)
    chains = np.arange(stages.size)
    accepted = stats["accept_rate"].values[chains, stages - 1]
    moves = accepted * stats["n_steps"].values[chains, stages - 1]
    sentences = [
        f"the sampler went from the prior to the posterior in {span(stages, '.0f')} stages; "
        f"in the last one it accepted {span(100 * accepted, '.0f')}% of the proposals, "
        f"and each particle moved {span(moves, '.1f')} times on average."
    ]
    attrs = tree["posterior"].attrs
    if "log_marginal_likelihood" in attrs:
        sentences.append(_evidence(attrs, by_specimen=by_specimen))
    return sentences


def _evidence(attrs: Mapping[Any, Any], *, by_specimen: bool) -> str:
    value = float(attrs["log_marginal_likelihood"])
    spread = float(attrs["log_marginal_likelihood_sd"])
    return (
        f"log marginal likelihood {plus_minus(value, spread)} (spread between chains); "
        "comparable between models "
        f"{'of the same data' if by_specimen else 'with the same metric and epsilon'} only."
    )


# -- failures --------------------------------------------------------------------------------


def failures(m: Material) -> list[Section]:
    """Return which responses failed, and why."""
    rows: dict[tuple[Any, ...], dict[str, Any]] = {}
    for tree in m.results.values():
        if "failures" in tree.children:
            for row in _failure_rows(tree["failures"].to_dataset()):
                rows.setdefault(tuple(row.values()), row)
    if not rows:
        return []
    shown = list(rows.values())[:20]  # a page
    about = f"{len(rows)} responses failed; what took their place is no result."
    more = "" if len(shown) == len(rows) else f" The first {len(shown)} are told."
    return [Section("Failed responses", about + more, rows_table(shown), level=3)]


def _failure_rows(failures: xr.Dataset) -> list[dict[str, Any]]:
    names = failures["simulator"].values
    reasons = failures["reason"].values
    found = []
    for name, inputs, reason in zip(names, failures["inputs"].values, reasons, strict=True):
        at = ", ".join(f"{x:.6g}" for x in inputs[~np.isnan(inputs)])
        found.append({"simulator": str(name), "inputs": at, "reason": str(reason)})
    return found


# -- validity --------------------------------------------------------------------------------


def validity(m: Material) -> list[Section]:
    """Return the verdicts of the validity tests, and their data."""
    if not m.tests:
        data = _validation_data(m)
        return [Section("Validity", "No test of validity was given."), *data] if data else []
    rows = []
    for label, test in m.tests.items():
        name = label if len(m.tests) > 1 else "area test"
        rows.append({"test": name} | _tested(test))
    about = (
        "The u-value of a measured response is its place in the predicted distribution, "
        "between 0 and 1. "
        "The statistic is the area between the distribution of the u-values and the uniform one; "
        "a larger area than the critical value rejects the model. "
        "Of u the area sees a wrong mean, of |2u - 1| a wrong spread. "
        "That a model is not rejected does not prove it."
    )
    if any(in_directions(test) for test in m.tests.values()):
        about += (
            " Several outputs of a specimen are seen in some directions of the predicted ones, in "
            "which a wrong correlation is a wrong spread; the statistic is the mean over these of "
            "the areas of u and of |2u - 1|."
        )
    if len(m.tests) > 1:
        levels = sum(test.alpha for test in m.tests.values())
        about += (
            f" A right model is rejected by one or more of these {len(m.tests)} tests in up to "
            f"{percentage(min(levels, 1.0))} of cases."
        )
    verdicts = [verdict(label, test, m) for label, test in m.tests.items()]
    assumed = dict.fromkeys(f"Held to be true: {test.null}." for test in m.tests.values())
    sections = [Section("Validity", (*verdicts, about, *assumed), rows_table(rows))]
    return [*sections, *_validation_data(m)]


def _validation_data(m: Material) -> list[Section]:
    """Return what was measured on other specimens, and what was predicted of it."""
    rows = []
    for condition, (measured, predicted) in m.validation.items():
        pairs = comparables({condition: measured}, {condition: predicted}, "Report: validation")
        rows += [_measured_and_predicted(pair, m) for pair in pairs]
    if not rows:
        return []
    for key in ("failed", "missing"):
        if any(row[key] for row in rows):
            rows = [row | {key: row[key] or "0"} for row in rows]
    about = (
        "Specimens that the calibration has not seen, and what was predicted of them: the median "
        f"and the range that holds {INTERVAL:.0%} of the predicted responses. ∞ is a failure."
    )
    return [Section("Data of the test", about, rows_table(rows), level=3)]


def _measured_and_predicted(pair: Comparable, m: Material) -> dict[str, Any]:
    """Return the row of one output under one condition."""
    known = pair.predicted[~np.isnan(pair.predicted)]
    levels = [0.5, (1 - INTERVAL) / 2, (1 + INTERVAL) / 2]
    median, low, high = np.quantile(known, levels, method="inverted_cdf").tolist()
    finite = pair.measured[np.isfinite(pair.measured)]
    sd = float(finite.std(ddof=1)) if finite.size > 1 else math.nan
    middle, lower, upper = alike((median, low, high), sd)
    return {
        "condition": named(pair.name, m.labels),
        **described(pair.measured),
        "predicted median": middle,
        f"{INTERVAL:.0%} from": lower,
        "to": upper,
    }


def _tested(test: ValidityTest) -> dict[str, Any]:
    directions = len(in_directions(test))
    of = "|2u - 1|" if test.folded else "u"
    if directions and not test.folded:
        of = "u and |2u - 1|"
    # The verdict first: what is at the end of a wide table is off a phone's screen.
    return {
        "verdict": "rejected" if test.rejected else "not rejected",
        "values": test.u_values.size,
        "specimens": np.unique(test.specimens).size,
        "directions": str(directions) if directions else "",
        "of": of,
        "area": f"{test.statistic:.4f}",
        "critical value": f"{test.critical_value:.4f}",
        "p-value": probability(test.p_value).removeprefix("= "),
        "level": percentage(test.alpha),
    }


# -- cost and origin -------------------------------------------------------------------------


def origin(m: Material) -> list[Section]:
    """Return versions, seeds, and what the results cost."""
    if not m.results:
        return []
    rows = [_cost(m, label) for label in m.results]
    for condition, (_, predicted) in m.validation.items():
        rows.append(_cost_of(f"prediction, {named(condition, m.labels)}", "predict", predicted))
    for label, table in m.decisions.items():
        rows.append(_cost_of(label, CALLED[kind_of_decision(table) or ""], table))
    text = [
        "Responses are evaluations of the simulated response for one specimen, whatever the number "
        "of its outputs; those of a common design are counted in each."
    ]
    versions: dict[str, str] = {}
    for label in m.results:
        versions |= _versions(m.attrs(label))
    if versions:
        made = ", ".join(f"{name} {version}" for name, version in versions.items())
        text.append(f"Computed with {made}.")
    return [Section("Cost and origin", text, rows_table(rows))]


def _cost(m: Material, label: str) -> dict[str, Any]:
    attrs = m.attrs(label)
    by = "minimize" if label in m.optima else ""
    responses, seconds, seed = (attrs.get(k) for k in ("n_responses", "seconds", "random_seed"))
    return {
        "result": label,
        "by": str(attrs.get("sampler", by)),
        "responses": None if responses is None else str(int(responses)),
        "seconds": None if seconds is None else shown(float(seconds)),
        "seed": None if seed is None else str(seed),
    }


def _cost_of(label: str, function: str, found: xr.DataArray | xr.Dataset) -> dict[str, Any]:
    """Return what followed from a result, by which function, and what it took."""
    responses, seed = (found.attrs.get(key) for key in ("responses", "random_seed"))
    return {
        "result": label,
        "by": function,
        "responses": None if responses is None else str(int(responses)),
        "seconds": None,
        "seed": None if seed is None else str(seed),
    }


def _versions(attrs: Mapping[Any, Any]) -> dict[str, str]:
    """Return the versions of packages; not those of libraries that ArviZ is told of."""
    found = {}
    for key, value in attrs.items():
        name = str(key).removesuffix("_version")
        if name not in (str(key), "inference_library", "creation_library"):
            found[name] = str(value)
    return found
