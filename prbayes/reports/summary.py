"""A report in a few sentences: what was calibrated, the answer, whether it may be trusted."""

from __future__ import annotations

import numpy as np

from prbayes._validate import Floats
from prbayes.model.elements import (
    read_variables,
    single_elements,
    split_elements,
    stacked_draws,
    told_elements,
    told_of,
    variable_of,
)
from prbayes.plots._labels import metric_label, named
from prbayes.plots.validity import in_directions
from prbayes.reports.decision import interval_of
from prbayes.reports.material import Material
from prbayes.reports.numbers import alike, counted, number, percentage, plus_minus, probability
from prbayes.reports.schema import kind_of_decision
from prbayes.validation.area_test import ValidityTest

# More hyperparameters than this make a list, which a table shows better: by judgement.
_MOST_NAMES = 6
# More conditions than this make a sentence too long to read: by judgement.
_MOST_CONDITIONS = 4
# More rows than these leave no room for the rest on the first page: by judgement.
_MOST_ROWS_IN_SUMMARY = 10


def summary(m: Material) -> list[str]:
    """Return the sentences, as paragraphs."""
    paragraphs = [_verdict(m), _what_was_calibrated(m), f"{_answer(m)} {_agreement(m)}", _trust(m)]
    paragraphs += [verdict(label, test, m) for label, test in m.tests.items()]
    paragraphs += _risks(m)
    stripped = map(str.strip, paragraphs)
    return list(filter(None, stripped))


def answers(m: Material) -> list[dict[str, str]]:
    """Return the rows of a table: the hyperparameters, what they are called, what is known."""
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
    return rows if len(rows) <= _MOST_ROWS_IN_SUMMARY else []


def _verdict(m: Material) -> str:
    """Return in one sentence whether the calibration may be used."""
    if not m.results:
        return ""
    problems = any(found is not None and not found.ok for found in m.diagnoses.values())
    if m.rejected:
        return "Verdict: the calibrated model is rejected by data that it has not seen."
    if problems:
        return "Verdict: not to be used before the problems under Diagnostics are removed."
    if not m.tests:
        return "Verdict: calibrated, and not tested on data that it has not seen."
    return (
        "Verdict: calibrated, and not rejected by data that it has not seen, which does not prove "
        "it right."
    )


def verdict(label: str, test: ValidityTest, m: Material) -> str:
    """Return what a test found, in one sentence."""
    who = f"{label}: " if len(m.tests) > 1 else ""
    aspect = "the spread of the responses" if test.folded else "the responses"
    specimens = counted(int(np.unique(test.specimens).size), "specimen")
    directions = len(in_directions(test))
    values = counted(test.u_values.size, "value")
    if directions:
        values = f"several outputs, seen in {counted(directions, 'direction')}"
    conditions = test.of_conditions
    # One alone may be called after a function only.
    told = len(conditions) > 1 or conditions[0] in {*m.validation, *m.labels}
    if told and len(conditions) <= _MOST_CONDITIONS:
        values += f": {_enumerated([named(name, m.labels) for name in conditions])}"
    area = "mean area" if directions else "area"
    found = "is rejected" if test.rejected else "is not rejected"
    sign = ">" if test.statistic > test.critical_value else "≤"
    return (
        f"{who}On {aspect} of {specimens} ({values}), the calibrated model {found} "
        f"at level {percentage(test.alpha)} "
        f"({area} {test.statistic:.3f} {sign} critical {test.critical_value:.3f}, "
        f"p {probability(test.p_value)})."
    )


def _what_was_calibrated(m: Material) -> str:
    names = m.hyperparameters
    if not names:
        return ""
    hyperparameters = counted(len(names), "hyperparameter")
    if len(names) <= _MOST_NAMES:
        hyperparameters += f" ({', '.join(named(name, m.labels) for name in names)})"
    if not m.results:
        return f"The model has {hyperparameters}. No result of a calibration was given."
    were = "was" if len(names) == 1 else "were"
    data = [_measured(named(name, m.labels), y) for name, y in m.observed.items()]
    on = f" on {_enumerated(data)}" if data else ""
    metrics = _metrics(m)
    by = f", by the {_enumerated(metrics)}" if metrics else ""
    return f"{hyperparameters} of the model {were} calibrated{on}{by}."


def _measured(name: str, y: Floats) -> str:
    """Return how much was measured of a simulator's responses."""
    if y.ndim == 1:
        return f"{counted(y.size, 'measured response')} of {name}"
    n, outputs = y.shape
    return f"{counted(n, 'specimen')} with {counted(outputs, 'output')} of {name}"


def _metrics(m: Material) -> list[str]:
    """Return the metrics in words, each once."""
    described: list[str] = []
    if m.description is not None:
        described = [str(s["metric"]) for s in m.description["simulators"]]
    elif m.calibrations:
        first = next(iter(m.calibrations.values()))
        described = list(map(str, first["metric"].values.tolist()))
    in_words = [metric_label(description) for description in described]
    return list(dict.fromkeys(in_words))


def _risks(m: Material) -> list[str]:
    """Return in a sentence each the probabilities that were asked for; of a rejected model none."""
    if m.rejected:
        return ["The questions of a decision are not answered by it."] if m.decisions else []
    sentences = []
    for label, table in m.decisions.items():
        if kind_of_decision(table) != "risk" or table.probability.ndim:
            continue
        level = percentage(table.attrs["prob"])
        said = (
            f"{label}: probability {number(float(table.probability), 2)} ({level} interval "
            f"{interval_of(table)})"
        )
        if "requirement" in table.attrs:
            most = f"at most {table.attrs['requirement']:g}"
            said += f"; the requirement, {most}, is {table.attrs['verdict']}"
        sentences.append(f"{said}.")
    return sentences


def _enumerated(items: list[str]) -> str:
    *first, last = items
    return f"{', '.join(first)} and {last}" if first else last


def _answer(m: Material) -> str:
    """Return the estimates of the first posterior, or else of the first optimum."""
    if not m.results:
        return ""
    if m.posteriors:
        of_kind, kind = m.posteriors, "posterior"
        what = "mean and standard deviation of the posterior"
    else:
        of_kind, kind = m.optima, "optimum"
        what = "optimum and standard error"
    label = next(iter(of_kind))
    estimates = _estimates(m, label)
    if not estimates or len(estimates) > _MOST_NAMES:
        return f"The answer is in the table of the {kind}."
    pairs = []
    for name, (value, sd) in estimates.items():
        found = f"= {plus_minus(value, sd)}" if sd < np.inf else "is not identified"
        pairs.append(f"{named(name, m.labels)} {found}")
    which = f" of {label}" if len(of_kind) > 1 else ""
    return f"The answer{which} is {', '.join(pairs)} ({what})."


def _estimates(m: Material, label: str) -> dict[str, tuple[float, float]]:
    """Return estimate and spread of each element of the hyperparameters, by a result."""
    found: dict[str, tuple[float, float]] = {}
    if label in m.posteriors:
        stacked = stacked_draws(m.posteriors[label]["posterior"])
        draws = split_elements(stacked)
        for name in told_elements(stacked):
            values = draws[name]
            mean = float(values.mean())
            sd = float(values.std(ddof=1))
            found[name] = (mean, sd)
    else:
        tree = m.optima[label]
        optimum = tree["optimum"].data_vars
        stderr = tree["stderr"].data_vars
        points = single_elements(optimum)
        errors = single_elements(stderr)
        for name in told_of(optimum, stderr):
            found[name] = (points[name], errors[name])
    variables = {name: variable_of(name) for name in found}
    known = read_variables(m.hyperparameters, set(variables.values()))
    return {name: pair for name, pair in found.items() if variables[name] in known}


def _agreement(m: Material) -> str:
    """Return how far apart two results are; nothing of more."""
    if m.comparison is None or m.comparison.sizes["result"] != 2:
        return ""
    # What one of them does not identify has no estimate there.
    told = (m.comparison["sd"] < np.inf).all("result")
    shifts = np.abs(m.comparison["shift"].where(told).values)
    if not np.isfinite(shifts).any():
        return ""
    largest = float(np.nanmax(shifts))
    if not np.isfinite(largest):
        return ""
    first, second = m.comparison["result"].values.tolist()
    return (
        f"The estimates of {first} and {second} differ by at most {number(largest, 2)} "
        "standard deviations."
    )


def _trust(m: Material) -> str:
    known = {label: found for label, found in m.diagnoses.items() if found is not None}
    if not known:
        return ""
    problems = []
    for label, found in known.items():
        if not found.ok:
            problems.append(f"{counted(len(found.messages), 'problem')} with {label}")
    if not problems:
        if any(found.untested for found in known.values()):
            return "The diagnostics that were run found no problem."
        return "The diagnostics found no problem."
    return (
        f"The diagnostics found {_enumerated(problems)}; "
        "see the section on diagnostics before the answer is used."
    )
