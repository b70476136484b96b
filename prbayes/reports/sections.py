"""How a reader checks the answer: method, diagnostics and appendix; the order of all sections."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from prbayes._display import p_digits, percentage
from prbayes._finding import counted, sentences_of
from prbayes._stats import INTERVAL
from prbayes._validate import Labels, NamedValues, Names, finite_or_nan
from prbayes.model.description import labelled
from prbayes.model.parameters import (
    element_name,
    readable_elements,
    single_elements,
    split_elements,
    stacked_draws,
    table_elements,
)
from prbayes.optimize.optimum import compared_in
from prbayes.plots.canvas import metric_label, named
from prbayes.plots.validity import in_directions
from prbayes.reports.assessment import (
    agreement,
    answer,
    data,
    decision,
    next_steps,
    population_in_units,
    shown_columns,
    verdict,
)
from prbayes.reports.figures import pictures_of
from prbayes.reports.material import (
    CALLED,
    Material,
    Observed,
    attributes_of,
    kind_of_decision,
    metrics_of,
    versions_of,
)
from prbayes.reports.numbers import (
    NOTHING,
    alike,
    correlation_table,
    enumerated,
    finite_sd,
    number,
    plus_minus,
    rows_table,
    span,
    view_table,
)
from prbayes.reports.section import Section
from prbayes.results.compare import Comparison, estimates_of
from prbayes.validation.area_test import ValidityTest
from prbayes.validation.pit import DIRECTION, u_values


def sections_of(m: Material, *, pictures: bool) -> tuple[Section, ...]:
    """Return the sections for which there are results, with or without pictures."""
    drawn = pictures_of(m) if pictures else {}
    sections = []
    for title, parts in _CHAPTERS.items():
        chapter: list[Section] = []
        for part in parts:
            chapter += part(m) if callable(part) else drawn.get(part, [])
        if chapter and chapter[0].level == 3:
            chapter.insert(0, Section(title))
        sections += chapter
    return tuple(sections)


# -- method ----------------------------------------------------------------------------------


def model(m: Material) -> list[Section]:
    """Return the variables of the model, its simulators, and how responses are compared."""
    if not m.description["variables"]:
        return []
    variables = [
        {
            "variable": v["name"],
            "role": v["role"],
            "distribution": v["distribution"],
            "meaning": m.labels.get(v["name"], ""),
        }
        for v in m.description["variables"]
    ]
    about = (
        "Hyperparameters describe how the inputs vary from specimen to specimen, "
        "and have prior distributions."
    )
    sections = [Section("Method", about, rows_table(variables))]
    simulators = [
        {
            "simulator": s["name"],
            "response": s["response"],
            "inputs": ", ".join(
                f"{m.labels.get(name, name + unit)} {text}".strip()
                for name, unit, text in s["inputs"]
            ),
            "runs": s["runs"],
        }
        for s in m.description["simulators"]
    ]
    if simulators:
        about = "A simulator computes the response of a specimen from its inputs."
        sections.append(Section("Simulators", about, rows_table(simulators), level=3))
    return sections


@dataclass(frozen=True)
class _ObjectiveTexts:
    """What the sections say of the function that calibrations minimise, or maximise."""

    name: str
    title: str  # title of the section with the values of the results
    about: str  # text of this section
    compares: str  # sentence on how measured and simulated responses are compared
    standard_errors: str  # what standard errors are those of
    comparable: str  # which models have comparable marginal likelihoods
    is_named: bool  # whether its name depends on the metric
    sign: float  # factor of stored discrepancies
    # Titles of further columns with values of the results, by variable of the calibration.
    columns: Labels
    # Sentences on the width of the draws, by the sampler's adjustment.
    adjustments: Labels


_DISCREPANCY = _ObjectiveTexts(
    "discrepancy",
    "Metric and epsilon",
    "Of a posterior the mean discrepancy over its draws is shown.",
    "The metric measures how far the distribution of the simulated responses is "
    "from that of the measured ones; smaller is better.",
    "the estimator over repeated sets of as many specimens",
    "with the same metric and epsilon",
    is_named=True,
    sign=1.0,
    columns={"discrepancy_error": "Monte Carlo error", "epsilon": "epsilon"},
    adjustments={
        "estimate": "The posterior is that given the metric's own estimate: prior times density "
        "of the estimate over repeated sets of specimens.",
        "none": "The draws are those of exp(-discrepancy / epsilon): their width is epsilon's.",
    },
)
_LOG_LIKELIHOOD = _ObjectiveTexts(
    "log-likelihood",
    "Log-likelihood",
    "Runs are those of the emulator. Of a posterior the mean over its draws is shown.",
    "The log-likelihood compares specimens: the density of each measured response in the "
    "population, through the inputs that reproduce it, on an emulator of the response.",
    "the curvature of the log-likelihood",
    "of the same data",
    is_named=False,
    sign=-1.0,
    columns={},
    adjustments={},
)


def _objective_texts(m: Material) -> _ObjectiveTexts:
    """Return what the sections say of the objective of all calibrations."""
    return _LOG_LIKELIHOOD if m.is_by_specimen else _DISCREPANCY


def comparison_of_responses(m: Material) -> list[Section]:
    """Return how measured and simulated responses are compared."""
    if not (m.calibrations or m.description["simulators"]):
        return []
    labels = dict.fromkeys(map(metric_label, metrics_of(m).values()))
    objective = _objective_texts(m)
    text = [objective.compares]
    if m.sheets and len(m.sheets) == len(metrics_of(m)):
        text = ["The likelihood is the density of the statistics of the data sheet."]
    elif labels and objective.is_named:
        text.append(f"Here it is the {enumerated(list(labels))}.")
    text += dict.fromkeys(line for t in m.calibrations.values() for line in compared_in(t))
    return [Section("Measured against simulated responses", text, level=3)]


# -- diagnostics -----------------------------------------------------------------------------


def diagnostics(m: Material) -> list[Section]:
    """Return the problems of the results in sentences, and remarks."""
    problems: dict[str, list[str]] = {}  # labels of results by sentence
    remarks: dict[str, list[str]] = {}
    for label, diagnosis in m.diagnoses.items():
        if diagnosis is None:
            missing = "not diagnosed, because that needs the model, which was not given."
            problems.setdefault(missing, []).append(label)
            continue
        clear = diagnosis.all_clear
        for sentence in diagnosis.messages or (f"{clear[0].lower()}{clear[1:]}",):
            problems.setdefault(sentence, []).append(label)
        for sentence in (*diagnosis.notes, *diagnosis.untested):
            remarks.setdefault(sentence, []).append(label)
    for label, table in m.decisions.items():
        for sentence in sentences_of(table.attrs):
            problems.setdefault(sentence, []).append(label)
    if not problems:
        return []
    sections = [Section("Diagnostics", _with_labels(problems))]
    if remarks:
        sections.append(Section("Remarks", _with_labels(remarks), level=3))
    return sections


def _with_labels(sentences: Mapping[str, list[str]]) -> list[str]:
    """Return sentences after the names of the results that they are about."""
    texts = []
    for sentence, labels in sentences.items():
        names = enumerated(labels)
        texts.append(f"{names[0].upper()}{names[1:]}: {sentence}")
    return texts


def failures(m: Material) -> list[Section]:
    """Return the failed responses with the reasons, at most a page."""
    rows: dict[Names, dict[str, Any]] = {}
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


# -- appendix: estimates ---------------------------------------------------------------------


def metric(m: Material) -> list[Section]:
    """Return the discrepancies and epsilons of the results, or their log-likelihoods."""
    objective = _objective_texts(m)
    rows: list[dict[str, Any]] = []
    for label, calibration in m.calibrations.items():
        sample_dims = [dim for dim in ("chain", "draw") if dim in calibration.dims]
        means = calibration["discrepancy"].mean(sample_dims, skipna=False)
        for name, mean in zip(calibration["simulator"].values, means.values, strict=True):
            values = calibration.sel(simulator=name)
            row = {"result": label, "simulator": str(name)}
            if "n_runs" in values:
                row["runs"] = str(int(values["n_runs"]))
            keys = objective.columns.items()
            numbers = {text: float(values[key]) for key, text in keys if key in values}
            rows.append(row | {objective.name: objective.sign * float(mean)} | numbers)
    if not rows:
        return []
    about = objective.about
    if any("epsilon" in row for row in rows):
        about += " Epsilon is the discrepancy that the sampler takes for one unit of log-density."
    return [Section(objective.title, about, rows_table(rows), level=3)]


def optima(m: Material) -> list[Section]:
    """Return a section for each optimum."""
    sections = []
    for label, tree in m.optima.items():
        estimates, elements = estimates_of(tree)
        names = readable_elements(elements)
        attrs = tree["optimum"].attrs
        ended = "converged" if attrs.get("converged") else "did not converge"
        evaluations = counted(int(attrs.get("n_evaluations", 0)), "evaluation")
        message = str(attrs.get("message", "")).rstrip(".")
        ending = f"The optimiser {ended} after {evaluations} of the objective: {message}."
        if attrs.get("prior"):
            ending += (
                " Minus the log prior was part of the objective: "
                "the discrepancy alone is smallest elsewhere."
            )
        text = [ending]
        if label in m.live_optima:
            evaluator = m.live_optima[label].evaluator
            for mode in m.live_optima[label].local_optima:
                place = labelled(evaluator, mode["point"], {}).data_vars
                text.append(_other_optimum(mode, place, names))
        text.append(f"Standard errors are those of {_objective_texts(m).standard_errors}.")
        rows = []
        for name in names:
            value, stderr, *_ = estimates[name]
            estimate, error = alike((value, stderr), stderr)
            rows.append({"hyperparameter": name, "estimate": estimate, "standard error": error})
        title = _titled("Optimum", label, m.optima)
        sections.append(Section(title, text, rows_table(rows), level=3))
    return sections


def _titled(title: str, label: str, results: NamedValues) -> str:
    return title if len(results) == 1 else f"{title}: {label}"


def _other_optimum(mode: NamedValues, point: Mapping[Any, Any], names: Sequence[str]) -> str:
    """Return a sentence on another optimum; of many elements it names scalar variables alone."""
    elements = single_elements(point)
    shown = [name for name in names if name in elements]
    if len(shown) > 8:
        shown = [name for name in shown if name in point] or shown
    at = ", ".join(f"{name} = {number(elements[name])}" for name in shown)
    discrepancy = number(float(mode["discrepancy"]))
    if mode["comparable"]:
        judged = "the data could as well come from there"
    else:
        judged = "the data fit it less well; a posterior gives its weight"
    return f"Another optimum is at {at}, with discrepancy {discrepancy}: {judged}."


def posteriors(m: Material) -> list[Section]:
    """Return a section for each posterior."""
    sections, objective = [], _objective_texts(m)
    for label, tree in m.posteriors.items():
        posterior = tree["posterior"]
        chains = counted(int(posterior.sizes["chain"]), "chain")
        by = f" by {posterior.attrs['sampler']}" if "sampler" in posterior.attrs else ""
        text = [f"{chains} of {posterior.sizes['draw']} draws{by}. Intervals have equal tails."]
        # With a metric the width of the draws depends on the sampler's adjustment.
        adjustment = str(posterior.attrs.get("adjustment", ""))
        if adjustment in objective.adjustments and not m.sheets:
            is_likelihood = bool(tree["calibration"]["is_likelihood"].all())
            if adjustment == "estimate" or not is_likelihood:
                text.append(objective.adjustments[adjustment])
        text += _sampler_sentences(tree, objective.comparable)
        draws = stacked_draws(posterior)
        values = split_elements(draws)
        names = readable_elements(table_elements(draws))
        title = _titled("Posterior", label, m.posteriors)
        table = rows_table(_posterior_rows(tree, names, m.prob))
        sections.append(Section(title, text, table, level=3))
        varying = [name for name in names if np.ptp(values[name]) > 0]
        if 2 <= len(varying) <= 8:  # A larger table does not fit on a page.
            r = np.corrcoef([values[name] for name in varying])
            about = "Correlations of the draws: the data hardly distinguish a pair near 1 or -1."
            title = _titled("Correlations of the hyperparameters", label, m.posteriors)
            sections.append(Section(title, about, correlation_table(varying, r, 2), level=3))
    return sections


def _posterior_rows(tree: xr.DataTree, names: Sequence[str], prob: float) -> list[dict[str, Any]]:
    """Return estimates and diagnostics of the draws of each variable."""
    import arviz as az  # heavy

    with np.errstate(all="ignore"):  # a variable that never moves
        table = az.summary(tree, kind="diagnostics", round_to="none")
    estimates, _ = estimates_of(tree, prob)
    rows = []
    # ArviZ has the same elements in the same order, with names of its own.
    for (name, values), (_, checks) in zip(estimates.items(), table.iterrows(), strict=True):
        if name not in names:
            continue
        mean, sd, lower, upper = alike(values, values[1])
        bulk, tail, rhat, mcse = (
            float(checks[k]) for k in ("ess_bulk", "ess_tail", "r_hat", "mcse_mean")
        )
        rows.append(
            {
                "variable": name,
                "mean": mean,
                "sd": sd,
                f"{percentage(prob)} from": lower,
                "to": upper,
                "ESS, bulk": f"{bulk:.0f}" if math.isfinite(bulk) else NOTHING,
                "ESS, tail": f"{tail:.0f}" if math.isfinite(tail) else NOTHING,
                "R-hat": NOTHING if math.isnan(rhat) else f"{rhat:.3f}",
                "error of mean": alike([mcse], mcse, 2)[0],
            }
        )
    return rows


def comparison(m: Material) -> list[Section]:
    """Return the results side by side."""
    if m.comparison is None:
        return []
    table = m.comparison  # A comparison from a file is a plain dataset.
    shown = Comparison(table.data_vars, coords=table.coords, attrs=table.attrs).to_view()
    text = [
        f"The shift is the distance from the estimate of {table['result'].values[0]}, in standard "
        "deviations of the result in the row.",
        *shown.sentences,
    ]
    columns = view_table(shown)
    if m.prob != INTERVAL:  # All intervals of a report have the same probability.
        columns = columns.drop(columns=f"{INTERVAL:.0%} interval")
    return [Section("Comparison of results", text, columns, level=3)]


# -- appendix: diagnostics -------------------------------------------------------------------


def support(m: Material) -> list[Section]:
    """Return the support of the results by stored responses, and the statistics of samplers."""
    rows = []
    for label, diagnosis in m.diagnoses.items():
        table = None if diagnosis is None else diagnosis.support
        if table is None or "weight_ess" not in table:
            continue
        for name in table["simulator"].values.tolist():
            values = table.sel(simulator=name)
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
    if not rows:
        return []
    about = (
        "Responses were computed once and are weighted. The effective sample size (ESS) is the "
        "number of responses behind an answer; the mean weight is 1 where they cover the "
        "population; lost mass is the probability of points without a response."
    )
    return [Section("Support by stored responses", about, rows_table(rows), level=3)]


def _sampler_sentences(tree: xr.DataTree, comparable: str) -> list[str]:
    """Return the statistics of `sample_smc`; nothing of other samplers."""
    if "sample_stats" not in tree or "stage" not in tree["sample_stats"].dims:
        return []
    # Chains have different numbers of stages; their rows are filled up with NaN.
    stats = tree["sample_stats"].to_dataset()
    stages = (~np.isnan(stats["beta"].values)).sum(axis=1)
    last = (np.arange(stages.size), stages - 1)
    accepted = stats["accept_rate"].values[last]
    moves = accepted * stats["n_steps"].values[last]
    sentences = [
        f"The sampler went from the prior to the posterior in {span(stages, '.0f')} stages; "
        f"in the last one it accepted {span(100 * accepted, '.0f')}% of the proposals, "
        f"and each particle moved {span(moves, '.1f')} times on average."
    ]
    attrs = tree["posterior"].attrs
    if "log_marginal_likelihood" in attrs:
        value = float(attrs["log_marginal_likelihood"])
        spread = float(attrs["log_marginal_likelihood_sd"])
        sentences.append(
            f"Log marginal likelihood {plus_minus(value, spread)} (spread between chains); "
            f"comparable between models {comparable} only."
        )
    return sentences


# -- appendix: tests -------------------------------------------------------------------------


def validity(m: Material) -> list[Section]:
    """Return the statistics of the validity tests."""
    if not m.tests:
        return []
    n_tests = len(m.tests)
    rows = [
        {"test": label if n_tests > 1 else "area test"} | _test_row(test)
        for label, test in m.tests.items()
    ]
    about = (
        "The u-value of a measured response is its place in the predicted distribution, from 0 to "
        "1. The statistic is the area between the distribution of the u-values and the uniform "
        "one: a larger one than the critical value rejects the model. The area of u detects a "
        "wrong mean, that of |2u - 1| a wrong spread."
    )
    if any(in_directions(test) for test in m.tests.values()):
        about += (
            " Several outputs are projected on directions of the predicted ones, in which a wrong "
            "correlation is a wrong spread; the statistic is the mean of the areas over these."
        )
    nulls = dict.fromkeys(f"Null hypothesis: {test.null}." for test in m.tests.values())
    return [Section("Test statistics", (about, *nulls), rows_table(rows), level=3)]


def _test_row(test: ValidityTest) -> dict[str, Any]:
    directions = len(in_directions(test))
    values = "|2u - 1|" if test.folded else "u"
    if directions and not test.folded:
        values = "u and |2u - 1|"
    digits = p_digits(test.p_value, test.alpha)
    # The verdict is the first column, as the end of a wide table is off a phone's screen.
    return {
        "verdict": "rejected" if test.rejected else "not rejected",
        "values": test.u_values.size,
        "specimens": np.unique(test.specimens).size,
        "directions": str(directions) if directions else "",
        "of": values,
        "area": f"{test.statistic:.4f}",
        "critical value": f"{test.critical_value:.4f}",
        "p-value": f"{test.p_value:.{digits}g}" if test.p_value >= 0.001 else "< 0.001",
        "level": percentage(test.alpha),
    }


def specimens(m: Material) -> list[Section]:
    """Return measured values and u-values of the specimens of the test, at most a page."""
    rows = []
    for condition, tested in m.validation.items():
        labels = _specimen_labels(condition, len(tested.measured), m)
        for pair in tested.pairs:
            values = alike(pair.measured.tolist(), finite_sd(pair.measured))
            us = u_values(pair.measured, pair.predicted).tolist()
            name = named(pair.name, m.labels)
            rows += [
                {"condition": name, "specimen": label, "measured": value, "u": f"{u:.3f}"}
                for label, value, u in zip(labels, values, us, strict=True)
            ]
    if not rows:
        return []
    about = (
        "u is the share of the predicted responses below the measured one: a specimen with a u "
        "near 0 or 1 is at the edge of the prediction."
    )
    if len(rows) > 40:
        about += f" The first 40 of {len(rows)} values are shown."
    return [Section("Specimens of the test", about, rows_table(rows[:40]), level=3)]


def _specimen_labels(condition: str, n: int, m: Material) -> list[str]:
    """Return the labels of a condition's n specimens from the test of them, or else numbers."""
    for test in m.tests.values():
        is_single = len(test.of_conditions) == 1 and len(m.validation) == 1
        for name in test.of_conditions:
            mask = [text.split(DIRECTION)[0] == name for text in test.conditions.tolist()]
            labels = list(dict.fromkeys(test.specimens[mask].tolist()))
            if (is_single or name == condition) and len(labels) == n:
                return [_specimen_label(label, name) for label in labels]
    return [str(i + 1) for i in range(n)]


def _specimen_label(label: str, condition: str) -> str:
    """Return a label; tests count specimens without labels from zero, and a report from one."""
    index = label.removeprefix(f"{condition}, ")
    return str(int(index) + 1) if index != label and index.isdigit() else label


# -- appendix: data --------------------------------------------------------------------------


def measured_values(m: Material) -> list[Section]:
    """Return correlations of outputs, and the values by which a calibration can be repeated."""
    if not m.observed:
        return []
    sections = []
    # The values of a simulator fill half a page at most.
    about = f"In the order of the specimens; {NOTHING} was not measured, ∞ is a failure."
    values = [about]
    for name, y in m.observed.items():
        columns = y.columns()
        if len(columns) > 1:
            sections.append(_correlations(name, y))
        if y.values.size > 300:
            values.append(f"{name}: {y.values.size} values, which are too many to print.")
            continue
        for output, _, column in columns:
            texts = alike(column.tolist(), finite_sd(column), 4)
            element = element_name(name, [output] if output else [])
            values.append(f"{element}: {', '.join(texts)}.")
    return [*sections, Section("Measured values", values, level=3)]


def _correlations(name: str, y: Observed) -> Section:
    """Return the correlations of outputs, each of the specimens that have both."""
    columns = {output: finite_or_nan(x) for output, _, x in shown_columns(y)}
    r = pd.DataFrame(columns).corr(min_periods=3).values
    about = "Each of the specimens that have both outputs, without those that failed."
    table = correlation_table(list(columns), r, 3)
    return Section(f"Correlations of {name}", about, table, level=3)


def origin(m: Material) -> list[Section]:
    """Return versions, seeds, and the cost of the results."""
    if not m.results:
        return []
    costs: list[tuple[str, str, Mapping[Any, Any], str]] = []
    for label, result in m.results.items():
        attrs = attributes_of(result)
        by = str(attrs.get("sampler", "minimize" if label in m.optima else ""))
        costs.append((label, by, attrs, "n_responses"))
    for condition, tested in m.validation.items():
        label = f"prediction, {named(condition, m.labels)}"
        costs.append((label, "predict", tested.predicted.attrs, "responses"))
    for label, table in m.decisions.items():
        costs.append((label, CALLED[kind_of_decision(table) or ""], table.attrs, "responses"))
    rows = []
    for label, by, record, responses in costs:
        row: dict[str, Any] = {"result": label, "by": by}
        row["responses"] = str(int(record[responses])) if responses in record else None
        seconds = record.get("seconds")
        if seconds is not None:  # Below ten a tenth matters.
            seconds = f"{seconds:.0f}" if seconds >= 9.95 else f"{seconds:.1f}"
        seed = record.get("random_seed")
        rows.append(row | {"seconds": seconds, "seed": None if seed is None else str(seed)})
    text = ["Responses are runs for one specimen; those of a common design are counted in each."]
    text += [f"{name}: {metric}." for name, metric in metrics_of(m).items()]
    text += [f"{s['name']}: {s['propagation']}." for s in m.description["simulators"]]
    packages = ", ".join(f"{name} {version}" for name, version in versions_of(m).items())
    text += [f"Computed with {packages}."] if packages else []
    return [Section("Cost and origin", text, rows_table(rows), level=3)]


# -- order -----------------------------------------------------------------------------------


# parts of each chapter in their order: functions of the material, and names of pictures; the first
# chapter is page one, whose title is the verdict
_CHAPTERS: dict[str, tuple[Any, ...]] = {
    "Verdict": (verdict, "front", population_in_units),
    "Decision": (decision, "sensitivity", next_steps),
    "Answer": (answer, "population"),
    "Evidence": (data, "responses", "outputs", agreement),
    "Method": (model, "graph", comparison_of_responses),
    "Diagnostics": (diagnostics, failures),
    "Appendix": (
        *(metric, optima, "optimizer", "landscape"),
        *(posteriors, "posterior", "stages", comparison, "comparison", support),
        *(validity, "validity", specimens, measured_values, origin, "missing"),
    ),
}
