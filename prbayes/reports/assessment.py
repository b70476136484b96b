"""The sections of a report that judge: diagnostics, failures, validity, specimens, and the cost."""

from __future__ import annotations

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
    described,
    number,
    percentage,
    plus_minus,
    probability,
    rows_table,
    sample_sd,
    shown,
    span,
    with_zeros,
)
from prbayes.reports.schema import CALLED, kind_of_decision
from prbayes.reports.section import Section
from prbayes.reports.summary import verdict
from prbayes.results.diagnose import Diagnosis
from prbayes.validation.area_test import ValidityTest, u_values
from prbayes.validation.conditions import DIRECTION, Comparable, comparables

# -- diagnostics -----------------------------------------------------------------------------


def diagnostics(m: Material) -> list[Section]:
    """Return the problems of the results, and the statistics of the sampler, in sentences."""
    sentences: list[tuple[str, str]] = []
    rows: list[dict[str, Any]] = []
    for label, diagnosis in m.diagnoses.items():
        sentences += [(label, sentence) for sentence in _sentences(diagnosis)]
        if diagnosis is not None:
            rows += _support(label, diagnosis.support)
    for label, tree in m.posteriors.items():
        sampler = _sampler_sentences(tree, by_specimen=m.is_by_specimen)
        sentences += [(label, sentence) for sentence in sampler]
    if not sentences:
        return []
    text = [f"{label[0].upper()}{label[1:]}: {sentence}" for label, sentence in sentences]
    sections = [Section("Diagnostics", text)]
    if rows:
        about = (
            "Responses were computed once, and weighted for each set of hyperparameters. "
            "The effective sample size of the weights is the number of responses behind an answer; "
            "the mean weight is 1 where the design covers the population; "
            "lost mass is the probability of points without a response."
        )
        sections.append(Section("Support by stored responses", about, rows_table(rows), level=3))
    return sections


def _sentences(diagnosis: Diagnosis | None) -> tuple[str, ...]:
    if diagnosis is None:
        return ("not diagnosed, because that needs the model, which was not given.",)
    clear = diagnosis.all_clear
    messages = diagnosis.messages or (f"{clear[0].lower()}{clear[1:]}",)
    return (*messages, *diagnosis.notes, *diagnosis.untested)


def _support(label: str, support: xr.Dataset) -> list[dict[str, Any]]:
    """Return a row for each simulator with stored responses."""
    if "weight_ess" not in support:
        return []
    rows = []
    for name in support["simulator"].values.tolist():
        values = support.sel(simulator=name)
        low, median = np.quantile(values["weight_ess"].values, [0.05, 0.5])
        rows.append(
            {
                "result": label,
                "simulator": name,
                "weight ESS, 5%": f"{low:.0f}",
                "median": f"{median:.0f}",
                "mean weight": f"{float(values['mean_weight'].median()):.3f}",
                "largest lost mass": number(float(values["lost_mass"].max())),
            }
        )
    return rows


def _sampler_sentences(tree: xr.DataTree, *, by_specimen: bool) -> list[str]:
    """Return the statistics of `sample_smc`; nothing of other samplers."""
    if "sample_stats" not in tree or "stage" not in tree["sample_stats"].dims:
        return []
    # Chains have different numbers of stages: NaN from the end of a chain on.
    stats = tree["sample_stats"].to_dataset()
    stages = (~np.isnan(stats["beta"].values)).sum(axis=1)
    last = (np.arange(stages.size), stages - 1)
    accepted = stats["accept_rate"].values[last]
    moves = accepted * stats["n_steps"].values[last]
    sentences = [
        f"the sampler went from the prior to the posterior in {span(stages, '.0f')} stages; "
        f"in the last one it accepted {span(100 * accepted, '.0f')}% of the proposals, "
        f"and each particle moved {span(moves, '.1f')} times on average."
    ]
    attrs = tree["posterior"].attrs
    if "log_marginal_likelihood" in attrs:
        value = float(attrs["log_marginal_likelihood"])
        spread = float(attrs["log_marginal_likelihood_sd"])
        sentences.append(
            f"log marginal likelihood {plus_minus(value, spread)} (spread between chains); "
            "comparable between models "
            f"{'of the same data' if by_specimen else 'with the same metric and epsilon'} only."
        )
    return sentences


# -- failures --------------------------------------------------------------------------------


def failures(m: Material) -> list[Section]:
    """Return the failed responses with the reasons, a page of them."""
    rows: dict[tuple[str, ...], dict[str, Any]] = {}
    for tree in m.results.values():
        if "failures" in tree.children:
            table = tree["failures"].to_dataset()
            columns = (table[key].values for key in ("simulator", "inputs", "reason"))
            for name, inputs, reason in zip(*columns, strict=True):
                at = ", ".join(f"{x:.6g}" for x in inputs[~np.isnan(inputs)])
                row = {"simulator": str(name), "inputs": at, "reason": str(reason)}
                rows.setdefault(tuple(row.values()), row)
    if not rows:
        return []
    first = list(rows.values())[:20]
    about = f"{len(rows)} responses failed; the values that replaced them are no results."
    more = "" if len(first) == len(rows) else f" The first {len(first)} are shown."
    return [Section("Failed responses", about + more, rows_table(first), level=3)]


# -- validity --------------------------------------------------------------------------------


def validity(m: Material) -> list[Section]:
    """Return the verdicts of the validity tests, and their data."""
    if not m.tests:
        table = _validation_data(m)
        return [Section("Validity", "No test of validity was given."), *table] if table else []
    n_tests = len(m.tests)
    rows = [
        {"test": label if n_tests > 1 else "area test"} | _test_row(test)
        for label, test in m.tests.items()
    ]
    about = (
        "The u-value of a measured response is its place in the predicted distribution, "
        "between 0 and 1. "
        "The statistic is the area between the distribution of the u-values and the uniform one; "
        "a larger area than the critical value rejects the model. "
        "The area of u detects a wrong mean, that of |2u - 1| a wrong spread. "
        "A model that is not rejected is not proved."
    )
    if any(in_directions(test) for test in m.tests.values()):
        about += (
            " Several outputs of a specimen are projected on directions of the predicted ones, in "
            "which a wrong correlation is a wrong spread; the statistic is the mean over the "
            "directions of the areas of u and of |2u - 1|."
        )
    if n_tests > 1:
        alpha = min(sum(test.alpha for test in m.tests.values()), 1.0)
        about += (
            f" A right model is rejected by one or more of these {n_tests} tests in up to "
            f"{percentage(alpha)} of cases."
        )
    verdicts = [verdict(label, test, m) for label, test in m.tests.items()]
    nulls = dict.fromkeys(f"Null hypothesis: {test.null}." for test in m.tests.values())
    section = Section("Validity", (*verdicts, about, *nulls), rows_table(rows))
    return [section, *_validation_data(m)]


def _test_row(test: ValidityTest) -> dict[str, Any]:
    directions = len(in_directions(test))
    values = "|2u - 1|" if test.folded else "u"
    if directions and not test.folded:
        values = "u and |2u - 1|"
    # The verdict first: the end of a wide table is off a phone's screen.
    return {
        "verdict": "rejected" if test.rejected else "not rejected",
        "values": test.u_values.size,
        "specimens": np.unique(test.specimens).size,
        "directions": str(directions) if directions else "",
        "of": values,
        "area": f"{test.statistic:.4f}",
        "critical value": f"{test.critical_value:.4f}",
        "p-value": probability(test.p_value).removeprefix("= "),
        "level": percentage(test.alpha),
    }


def _validation_data(m: Material) -> list[Section]:
    """Return measured and predicted responses of specimens that were not used."""
    rows = [_validation_row(pair, m) for pairs in _validation_pairs(m) for pair in pairs]
    if not rows:
        return []
    about = (
        "Specimens that were not used in the calibration, and their prediction: the median and "
        f"the range with {INTERVAL:.0%} of the predicted responses. ∞ is a failure."
    )
    return [Section("Data of the test", about, rows_table(with_zeros(rows)), level=3)]


def _validation_pairs(m: Material) -> list[list[Comparable]]:
    """Return measured and predicted values of each condition, by output."""
    return [
        comparables({condition: measured}, {condition: predicted}, "Report: validation")
        for condition, (measured, predicted) in m.validation.items()
    ]


def _validation_row(pair: Comparable, m: Material) -> dict[str, Any]:
    """Return the row of one output under one condition."""
    predicted = pair.predicted[~np.isnan(pair.predicted)]
    levels = [0.5, (1 - INTERVAL) / 2, (1 + INTERVAL) / 2]
    quantiles = np.quantile(predicted, levels, method="inverted_cdf").tolist()
    sd = sample_sd(pair.measured[np.isfinite(pair.measured)])
    median, lower, upper = alike(quantiles, sd)
    return {
        "condition": named(pair.name, m.labels),
        **described(pair.measured),
        "predicted median": median,
        f"{INTERVAL:.0%} from": lower,
        "to": upper,
    }


# -- specimens -------------------------------------------------------------------------------


def specimens(m: Material) -> list[Section]:
    """Return the measured values and u-values of each specimen of the test, a page of them."""
    rows = _measured_rows(m) or _tested_rows(m)
    if not rows:
        return []
    about = (
        "u is the share of the predicted responses below the measured one: a specimen with a u "
        "near 0 or 1 is at the edge of the prediction."
    )
    if len(rows) > 40:
        about += f" The first 40 of {len(rows)} values are shown."
    return [Section("Specimens of the test", about, rows_table(rows[:40]), level=3)]


def _measured_rows(m: Material) -> list[dict[str, Any]]:
    """Return a row for each specimen and output of the validation data."""
    rows = []
    for (condition, (measured, _)), pairs in zip(
        m.validation.items(), _validation_pairs(m), strict=True
    ):
        labels = _specimen_labels(condition, len(measured), m)
        for pair in pairs:
            sd = sample_sd(pair.measured[np.isfinite(pair.measured)])
            values = alike(pair.measured.tolist(), sd)
            us = u_values(pair.measured, pair.predicted).tolist()
            name = named(pair.name, m.labels)
            rows += [
                {"condition": name, "specimen": label, "measured": value, "u": f"{u:.3f}"}
                for label, value, u in zip(labels, values, us, strict=True)
            ]
    return rows


def _specimen_labels(condition: str, n: int, m: Material) -> list[str]:
    """Return the labels of a condition's n specimens in a test of them, or their numbers."""
    for test in m.tests.values():
        is_single = len(test.of_conditions) == 1 and len(m.validation) == 1
        for name in test.of_conditions:
            mask = [text.split(DIRECTION)[0] == name for text in test.conditions.tolist()]
            labels = list(dict.fromkeys(test.specimens[mask].tolist()))
            if (is_single or name == condition) and len(labels) == n:
                return [_specimen_label(label, name) for label in labels]
    return [str(i + 1) for i in range(n)]


def _specimen_label(label: str, condition: str) -> str:
    """Return a label; the number from one on of a specimen that the test counts from zero."""
    index = label.removeprefix(f"{condition}, ")
    return str(int(index) + 1) if index != label and index.isdigit() else label


def _tested_rows(m: Material) -> list[dict[str, Any]]:
    """Return a row for each u-value of one specimen in the tests."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for test in m.tests.values():
        if in_directions(test):
            continue
        names = zip(test.conditions.tolist(), test.specimens.tolist(), strict=True)
        for (condition, specimen), u in zip(names, test.u_values, strict=True):
            rows[condition, specimen] = {
                "condition": named(condition, m.labels),
                "specimen": _specimen_label(specimen, condition),
                "u": f"{u:.3f}",
            }
    return list(rows.values())


# -- cost and origin -------------------------------------------------------------------------


def origin(m: Material) -> list[Section]:
    """Return versions, seeds, and the cost of the results."""
    if not m.results:
        return []
    rows = []
    versions: dict[str, str] = {}
    for label in m.results:
        attrs = m.attrs(label)
        by = str(attrs.get("sampler", "minimize" if label in m.optima else ""))
        rows.append(_cost(label, by, attrs, "n_responses"))
        versions |= _versions(attrs)
    for condition, (_, predicted) in m.validation.items():
        label = f"prediction, {named(condition, m.labels)}"
        rows.append(_cost(label, "predict", predicted.attrs, "responses"))
    for label, table in m.decisions.items():
        by = CALLED[kind_of_decision(table) or ""]
        rows.append(_cost(label, by, table.attrs, "responses"))
    text = [
        "Responses are evaluations of the simulated response for one specimen, whatever the number "
        "of its outputs; those of a common design are counted in each."
    ]
    if versions:
        packages = ", ".join(f"{name} {version}" for name, version in versions.items())
        text.append(f"Computed with {packages}.")
    return [Section("Cost and origin", text, rows_table(rows))]


def _cost(label: str, by: str, attrs: Mapping[Any, Any], responses: str) -> dict[str, Any]:
    n, seconds, seed = (attrs.get(key) for key in (responses, "seconds", "random_seed"))
    return {
        "result": label,
        "by": by,
        "responses": None if n is None else str(int(n)),
        "seconds": None if seconds is None else shown(float(seconds)),
        "seed": None if seed is None else str(seed),
    }


def _versions(attrs: Mapping[Any, Any]) -> dict[str, str]:
    """Return the versions of packages, without the libraries that ArviZ records."""
    suffix = "_version"
    return {
        str(key).removesuffix(suffix): str(value)
        for key, value in attrs.items()
        if str(key).endswith(suffix)
        and str(key).removesuffix(suffix) not in ("inference_library", "creation_library")
    }
