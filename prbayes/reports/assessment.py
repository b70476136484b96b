"""What judges in a report: diagnostics, failures, validity, specimens, cost; and its summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes._finding import from_json
from prbayes._stats import INTERVAL
from prbayes.model.parameters import (
    optimum_elements,
    readable_variables,
    single_elements,
    split_elements,
    stacked_draws,
    table_elements,
    variable_of,
)
from prbayes.plots.canvas import metric_label, named
from prbayes.plots.validity import in_directions
from prbayes.reports.material import CALLED, Material, kind_of_decision
from prbayes.reports.numbers import (
    alike,
    counted,
    described,
    enumerated,
    number,
    percentage,
    plus_minus,
    probability,
    rows_table,
    sample_sd,
    span,
    with_zeros,
)
from prbayes.reports.section import Section
from prbayes.validation.area_test import ValidityTest, u_values
from prbayes.validation.conditions import DIRECTION, Comparable, comparables

# -- diagnostics -----------------------------------------------------------------------------


def diagnostics(m: Material) -> list[Section]:
    """Return the problems of the results, and the statistics of the sampler, in sentences."""
    sentences: list[tuple[str, str]] = []
    rows: list[dict[str, Any]] = []
    for label, diagnosis in m.diagnoses.items():
        if diagnosis is None:
            missing = "not diagnosed, because that needs the model, which was not given."
            sentences.append((label, missing))
            continue
        clear = diagnosis.all_clear
        messages = diagnosis.messages or (f"{clear[0].lower()}{clear[1:]}",)
        texts = (*messages, *diagnosis.notes, *diagnosis.untested)
        sentences += [(label, sentence) for sentence in texts]
        support = diagnosis.support
        for name in support["simulator"].values.tolist() if "weight_ess" in support else []:
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


def _validation_pairs(m: Material) -> list[tuple[str, Comparable]]:
    """Return each condition with measured and predicted values of one output."""
    return [
        (condition, pair)
        for condition, (measured, predicted) in m.validation.items()
        for pair in comparables({condition: measured}, {condition: predicted}, "Report: validation")
    ]


def _validation_data(m: Material) -> list[Section]:
    """Return measured and predicted responses of specimens that were not used."""
    rows = []
    for _, pair in _validation_pairs(m):
        predicted = pair.predicted[~np.isnan(pair.predicted)]
        levels = [0.5, (1 - INTERVAL) / 2, (1 + INTERVAL) / 2]
        quantiles = np.quantile(predicted, levels, method="inverted_cdf").tolist()
        sd = sample_sd(pair.measured[np.isfinite(pair.measured)])
        median, lower, upper = alike(quantiles, sd)
        name = {"condition": named(pair.name, m.labels)}
        interval = {f"{INTERVAL:.0%} from": lower, "to": upper}
        rows.append(name | described(pair.measured) | {"predicted median": median} | interval)
    if not rows:
        return []
    about = (
        "Specimens that were not used in the calibration, and their prediction: the median and "
        f"the range with {INTERVAL:.0%} of the predicted responses. ∞ is a failure."
    )
    return [Section("Data of the test", about, rows_table(with_zeros(rows)), level=3)]


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
    for condition, pair in _validation_pairs(m):
        sd = sample_sd(pair.measured[np.isfinite(pair.measured)])
        values = alike(pair.measured.tolist(), sd)
        us = u_values(pair.measured, pair.predicted).tolist()
        name = named(pair.name, m.labels)
        labels = _specimen_labels(condition, len(m.validation[condition][0]), m)
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
    costs: list[tuple[str, str, Mapping[Any, Any], str]] = []
    versions: dict[str, str] = {}
    for label in m.results:
        attrs = m.attrs(label)
        by = str(attrs.get("sampler", "minimize" if label in m.optima else ""))
        costs.append((label, by, attrs, "n_responses"))
        for key, value in attrs.items():
            name = str(key).removesuffix("_version")
            # ArviZ records libraries too
            if name != key and name not in ("inference_library", "creation_library"):
                versions[name] = str(value)
    for condition, (_, predicted) in m.validation.items():
        label = f"prediction, {named(condition, m.labels)}"
        costs.append((label, "predict", predicted.attrs, "responses"))
    for label, table in m.decisions.items():
        costs.append((label, CALLED[kind_of_decision(table) or ""], table.attrs, "responses"))
    rows = []
    for label, by, record, responses in costs:
        row: dict[str, Any] = {"result": label, "by": by}
        row["responses"] = str(int(record[responses])) if responses in record else None
        seconds = record.get("seconds")
        if seconds is not None:  # to a tenth below ten
            seconds = f"{seconds:.0f}" if seconds >= 9.95 else f"{seconds:.1f}"
        seed = record.get("random_seed")
        rows.append(row | {"seconds": seconds, "seed": None if seed is None else str(seed)})
    text = [
        "Responses are evaluations of the simulated response for one specimen, whatever the number "
        "of its outputs; those of a common design are counted in each."
    ]
    if versions:
        packages = ", ".join(f"{name} {version}" for name, version in versions.items())
        text.append(f"Computed with {packages}.")
    return [Section("Cost and origin", text, rows_table(rows))]


# -- summary ---------------------------------------------------------------------------------


# Most hyperparameters in a sentence: of more a table is easier to read.
_MOST_NAMES = 6


def summary(m: Material) -> list[str]:
    """Return the sentences, as paragraphs."""
    paragraphs = [
        *_whole_verdict(m),
        _problem(m),
        f"{_answer(m)} {_agreement(m)}",
        _trust(m),
        *(verdict(label, test, m) for label, test in m.tests.items()),
        *_risks(m),
    ]
    return [paragraph.strip() for paragraph in paragraphs if paragraph.strip()]


def answers(m: Material) -> list[dict[str, str]]:
    """Return the rows of a table of the hyperparameters, unless they fill the first page."""
    if not m.results:
        return []
    label = next(iter(m.posteriors or m.optima))
    spread = "sd" if m.posteriors else "standard error"
    rows = []
    for name, (value, sd) in _estimates(m, label).items():
        estimate, error = alike((value, sd), sd, 2)
        meaning = named(name, m.labels)
        rows.append(
            {
                "hyperparameter": name,
                "meaning": "" if meaning == name else meaning,
                "estimate": estimate,
                spread: error,
            }
        )
    return rows if len(rows) <= 10 else []


def _whole_verdict(m: Material) -> list[str]:
    """Return in one sentence whether the calibration may be used."""
    if not m.results:
        return []
    if m.rejected:
        text = "the calibrated model is rejected by new data."
    elif m.has_problems:
        text = "not to be used before the problems under Diagnostics are removed."
    elif not m.tests:
        text = "calibrated, and not tested on new data."
    else:
        text = "calibrated, and not rejected by new data, which does not prove it right."
    return [f"Verdict: {text}"]


def verdict(label: str, test: ValidityTest, m: Material) -> str:
    """Return the verdict of a test, in one sentence."""
    name = f"{label}: " if len(m.tests) > 1 else ""
    aspect = "the spread of the responses" if test.folded else "the responses"
    specimens = counted(int(np.unique(test.specimens).size), "specimen")
    directions = len(in_directions(test))
    values = counted(test.u_values.size, "value")
    if directions:
        values = f"several outputs in {counted(directions, 'direction')}"
    conditions = test.of_conditions
    # A single condition may only have the name of a function.
    is_named = len(conditions) > 1 or conditions[0] in {*m.validation, *m.labels}
    if is_named and len(conditions) <= 4:
        values += f": {enumerated([named(condition, m.labels) for condition in conditions])}"
    area = "mean area" if directions else "area"
    rejected = "is rejected" if test.rejected else "is not rejected"
    sign = ">" if test.statistic > test.critical_value else "≤"
    return (
        f"{name}On {aspect} of {specimens} ({values}), the calibrated model {rejected} "
        f"at level {percentage(test.alpha)} "
        f"({area} {test.statistic:.3f} {sign} critical {test.critical_value:.3f}, "
        f"p {probability(test.p_value)})."
    )


def interval_of(table: xr.Dataset) -> str:
    """Return the interval of a probability, as text."""
    return f"{number(float(table.lower), 2)} to {number(float(table.upper), 2)}"


def _problem(m: Material) -> str:
    """Return the hyperparameters, data and metrics of the calibration."""
    names = m.hyperparameters
    if not names:
        return ""
    hyperparameters = counted(len(names), "hyperparameter")
    if len(names) <= _MOST_NAMES:
        hyperparameters += f" ({', '.join(named(name, m.labels) for name in names)})"
    if not m.results:
        return f"The model has {hyperparameters}. No result of a calibration was given."
    data = []
    for name, y in m.observed.items():
        measured = counted(y.size, "measured response")
        if y.ndim > 1:
            n, outputs = y.shape
            measured = f"{counted(n, 'specimen')} with {counted(outputs, 'output')}"
        data.append(f"{measured} of {named(name, m.labels)}")
    were = "was" if len(names) == 1 else "were"
    on = f" on {enumerated(data)}" if data else ""
    # The metrics, each once
    metrics = [str(simulator["metric"]) for simulator in m.simulators]
    if m.description is None and m.calibrations:
        first = next(iter(m.calibrations.values()))
        metrics = list(map(str, first["metric"].values.tolist()))
    labels = list(dict.fromkeys(map(metric_label, metrics)))
    by = f", by the {enumerated(labels)}" if labels else ""
    return f"{hyperparameters} of the model {were} calibrated{on}{by}."


def _answer(m: Material) -> str:
    """Return the estimates of the first posterior, or else of the first optimum."""
    if not m.results:
        return ""
    if m.posteriors:
        results, kind = m.posteriors, "posterior"
        estimator = "mean and standard deviation of the posterior"
    else:
        results, kind = m.optima, "optimum"
        estimator = "optimum and standard error"
    label = next(iter(results))
    estimates = _estimates(m, label)
    if not estimates or len(estimates) > _MOST_NAMES:
        return f"The answer is in the table of the {kind}."
    pairs = []
    for name, (value, sd) in estimates.items():
        phrase = f"= {number(value)}, without a standard error (see the section on diagnostics)"
        estimate = f"= {plus_minus(value, sd)}" if sd < np.inf else phrase
        pairs.append(f"{named(name, m.labels)} {estimate}")
    diagnosis = m.diagnoses.get(label)
    if diagnosis is not None and "width-of-epsilon" in {f.code for f in diagnosis.findings}:
        estimator = "mean and standard deviation of draws that are as wide as epsilon makes them"
    of_result = f" of {label}" if len(results) > 1 else ""
    return f"The answer{of_result} is {', '.join(pairs)} ({estimator})."


def _estimates(m: Material, label: str) -> dict[str, tuple[float, float]]:
    """Return estimate and spread of each element of the hyperparameters, by a result."""
    if label in m.posteriors:
        stacked = stacked_draws(m.posteriors[label]["posterior"])
        draws = split_elements(stacked)
        estimates = {
            name: (float(draws[name].mean()), float(draws[name].std(ddof=1)))
            for name in table_elements(stacked)
        }
    else:
        optimum = m.optima[label]["optimum"].data_vars
        stderr = m.optima[label]["stderr"].data_vars
        points = single_elements(optimum)
        errors = single_elements(stderr)
        estimates = {
            name: (points[name], errors[name]) for name in optimum_elements(optimum, stderr)
        }
    names = m.hyperparameters
    variable = {name: variable_of(name, names) for name in estimates}
    variables = readable_variables(names, set(variable.values()))
    return {name: pair for name, pair in estimates.items() if variable[name] in variables}


def _agreement(m: Material) -> str:
    """Return the distance between two results; nothing of more."""
    if m.comparison is None or m.comparison.sizes["result"] != 2:
        return ""
    # An unidentified hyperparameter has no estimate.
    is_identified = (m.comparison["sd"] < np.inf).all("result")
    shifts = np.abs(m.comparison["shift"].where(is_identified).values)
    if not np.isfinite(shifts).any() or not np.isfinite(np.nanmax(shifts)):
        return ""
    first, second = m.comparison["result"].values.tolist()
    return (
        f"The estimates of {first} and {second} differ by at most "
        f"{number(float(np.nanmax(shifts)), 2)} standard deviations."
    )


def _trust(m: Material) -> str:
    diagnoses = {label: d for label, d in m.diagnoses.items() if d is not None}
    if not diagnoses:
        return ""
    problems = [
        f"{counted(len(diagnosis.messages), 'problem')} with {label}"
        for label, diagnosis in diagnoses.items()
        if not diagnosis.ok
    ]
    if problems:
        return (
            f"The diagnostics found {enumerated(problems)}; "
            "see the section on diagnostics before the answer is used."
        )
    if any("tests that were run" in diagnosis.all_clear for diagnosis in diagnoses.values()):
        return "The diagnostics that were run found no problem."
    return "The diagnostics found no problem."


def _risks(m: Material) -> list[str]:
    """Return a sentence for each probability of a decision; of a rejected model none."""
    if m.rejected:
        return ["The questions of a decision are not answered by it."] if m.decisions else []
    sentences = []
    for label, table in m.decisions.items():
        if kind_of_decision(table) != "risk" or table.probability.ndim:
            continue
        prob = percentage(table.attrs["prob"])
        sentence = (
            f"{label}: probability {number(float(table.probability), 2)} ({prob} interval "
            f"{interval_of(table)})"
        )
        if "requirement" in table.attrs:
            most = f"at most {table.attrs['requirement']:g}"
            answer = table.attrs["verdict"] if m.is_usable else "not answered"
            sentence += f"; the requirement, {most}, is {answer}"
        sentences.append(f"{sentence}.")
    return sentences


# -- next steps ------------------------------------------------------------------------------


def next_steps(m: Material) -> list[str]:
    """Return at most four sentences on what to do next, the most urgent first."""
    if not m.results:
        return []
    steps = []
    if m.has_problems:
        steps.append("Remove the problems under Diagnostics: each sentence there says what to do.")
    if not m.tests:
        steps.append(
            "Test the calibrated model on specimens that were not used for it: prb.predict for "
            "their condition, then prb.area_test. With few specimens, prb.cross_validate."
        )
    elif m.rejected:
        steps.append(
            "Do not use the model beyond the data of its calibration. See under Validity whether "
            "the measured responses lie beside the predicted ones or are scattered more widely; "
            "correct the response, let another input vary, or calibrate what the response leaves "
            "out (prb.response.Additive, prb.response.Multiplicative)."
        )
    # In directions of several outputs the area of |2u - 1| is a part of the statistic.
    elif not any(test.folded or in_directions(test) for test in m.tests.values()):
        steps.append(
            "Test the spread as well: prb.area_test(..., folded=True), each of the two tests at "
            "half the level."
        )
    if not m.posteriors:
        steps.append(
            "Find the uncertainty of the hyperparameters: prb.sample_smc(optimum=optimum)."
        )
    if m.rejected:
        return [f"{i}. {step}" for i, step in enumerate(steps[:4], 1)]
    # The questions of a decision that are open
    undecided = [t for t in m.decisions.values() if t.attrs.get("verdict") == "not decided"]
    if any(from_json(str(table.attrs.get("findings", "[]"))) for table in undecided):
        steps.append(
            "A requirement is not decided, as the error of the computation is too large: see under "
            "Decision how many responses to compute."
        )
    elif undecided:
        steps.append(
            "A requirement is not decided, as too little is known of the probability: make as many "
            "more specimens as prb.plan says, with prb.decision.Exceedance as its quantity."
        )
    kinds = {kind_of_decision(table) for table in m.decisions.values()}
    if "risk" not in kinds:
        steps.append("Ask for the probability that a response is beyond its limit: prb.exceedance.")
    if "plan" not in kinds:
        steps.append("Ask what more specimens would change, before they are made: prb.plan.")
    return [f"{i}. {step}" for i, step in enumerate(steps[:4], 1)]
