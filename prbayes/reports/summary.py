"""The summary of a report: problem, answer, trust, decision, and the next steps."""

from __future__ import annotations

import numpy as np

from prbayes.model.parameters import (
    optimum_elements,
    readable_variables,
    single_elements,
    split_elements,
    stacked_draws,
    table_elements,
    variable_of,
)
from prbayes.plots._labels import metric_label, named
from prbayes.plots.validity import in_directions
from prbayes.reports.decision import interval_of
from prbayes.reports.material import Material
from prbayes.reports.numbers import (
    alike,
    counted,
    enumerated,
    number,
    percentage,
    plus_minus,
    probability,
)
from prbayes.reports.schema import kind_of_decision
from prbayes.validation.area_test import ValidityTest

# Most hyperparameters in a sentence: of more a table is easier to read.
_MOST_NAMES = 6


def summary(m: Material) -> list[str]:
    """Return the sentences, as paragraphs."""
    paragraphs = [
        _whole_verdict(m),
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


def _whole_verdict(m: Material) -> str:
    """Return in one sentence whether the calibration may be used."""
    if not m.results:
        return ""
    if m.rejected:
        return "Verdict: the calibrated model is rejected by new data."
    if _has_problems(m):
        return "Verdict: not to be used before the problems under Diagnostics are removed."
    if not m.tests:
        return "Verdict: calibrated, and not tested on new data."
    return "Verdict: calibrated, and not rejected by new data, which does not prove it right."


def _has_problems(m: Material) -> bool:
    return any(diagnosis is not None and not diagnosis.ok for diagnosis in m.diagnoses.values())


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
    metrics = _metrics(m)
    by = f", by the {enumerated(metrics)}" if metrics else ""
    return f"{hyperparameters} of the model {were} calibrated{on}{by}."


def _metrics(m: Material) -> list[str]:
    """Return the labels of the metrics, each once."""
    metrics: list[str] = []
    if m.description is not None:
        metrics = [str(s["metric"]) for s in m.description["simulators"]]
    elif m.calibrations:
        first = next(iter(m.calibrations.values()))
        metrics = list(map(str, first["metric"].values.tolist()))
    return list(dict.fromkeys(map(metric_label, metrics)))


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
        estimate = f"= {plus_minus(value, sd)}" if sd < np.inf else "is not identified"
        pairs.append(f"{named(name, m.labels)} {estimate}")
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
    variables = readable_variables(m.hyperparameters, {variable_of(name) for name in estimates})
    return {name: pair for name, pair in estimates.items() if variable_of(name) in variables}


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
    if any(diagnosis.untested for diagnosis in diagnoses.values()):
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
            sentence += f"; the requirement, {most}, is {table.attrs['verdict']}"
        sentences.append(f"{sentence}.")
    return sentences


# -- next steps ------------------------------------------------------------------------------


def next_steps(m: Material) -> list[str]:
    """Return at most four sentences on what to do next, the most urgent first."""
    if not m.results:
        return []
    steps = []
    if _has_problems(m):
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
    if not m.rejected:
        steps += _decision_steps(m)
    return [f"{i}. {step}" for i, step in enumerate(steps[:4], 1)]


def _decision_steps(m: Material) -> list[str]:
    """Return the questions of a decision that are open."""
    kinds = {kind_of_decision(table) for table in m.decisions.values()}
    steps = []
    if any(table.attrs.get("verdict") == "not decided" for table in m.decisions.values()):
        steps.append(
            "A requirement is not decided, as too little is known of the probability: make as many "
            "more specimens as prb.plan says, with prb.decision.Exceedance as its quantity."
        )
    if "risk" not in kinds:
        steps.append("Ask for the probability that a response is beyond its limit: prb.exceedance.")
    if "plan" not in kinds:
        steps.append("Ask what more specimens would change, before they are made: prb.plan.")
    return steps
