"""What a reader decides by: verdict, population, decisions, estimates and evidence."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr
from scipy.special import ndtri

from prbayes._display import p_digits, percentage
from prbayes._finding import counted, from_json, sentences_of
from prbayes._validate import Floats
from prbayes.decision.population_table import population
from prbayes.model.emulated import population_simulators
from prbayes.model.parameters import readable_variables, variable_of
from prbayes.optimize.optimum import Optimum
from prbayes.plots.canvas import named, with_label
from prbayes.plots.validity import in_directions
from prbayes.reports.material import Material, Observed, kind_of_decision
from prbayes.reports.numbers import (
    NOTHING,
    alike,
    described,
    enumerated,
    finite_sd,
    in_percent,
    number,
    plus_minus,
    rows_table,
    with_zeros,
)
from prbayes.reports.section import Section
from prbayes.results.compare import estimates_in, estimates_of
from prbayes.validation.area_test import ValidityTest

# -- page one --------------------------------------------------------------------------------


def verdict(m: Material) -> list[Section]:
    """Return whether the calibrated model may be used, and whether requirements are met."""
    title, mark, text = "Not calibrated", "open", ["No result of a calibration was given."]
    if m.rejected:
        title, mark = "Rejected", "bad"
        text = [f"Measurements of {_tested(m)} contradict the model. Do not use its predictions."]
        if len(m.tests) > 1:
            rejecting = [label for label, test in m.tests.items() if test.rejected]
            text.append(f"Failed: {enumerated(rejecting)}, of {len(m.tests)} tests.")
    elif m.problems:
        title = "Not ready"
        problems = counted(len(m.problems), "problem")
        pronoun = "it" if len(m.problems) == 1 else "them"
        text = [f"The calculation has {problems} (see Diagnostics). Solve {pronoun} before use."]
    elif m.tests:
        title, mark, text = "Passed", "good", []
    elif m.results:
        title = "Not tested"
        text = [f"The model was fitted to {_data(m)}, and compared with no other specimens."]
    elif not m.description["variables"]:
        return []
    if m.tests and not m.rejected:
        tests = m.tests.values()
        p = enumerated([f"{t.p_value:.{p_digits(t.p_value, t.alpha)}g}" for t in tests])
        text.append(f"Measurements of {_tested(m)} agree with the model (p = {p}).")
        # A normal test of the mean finds a shift by so many standard errors in half of all cases.
        shifts = [ndtri(1 - t.alpha / 2) / np.sqrt(np.unique(t.specimens).size) for t in tests]
        shift = min(shifts)
        text.append(
            f"A shift of the mean by {shift:.1f} standard deviations of the specimens can remain "
            "unseen."
        )
    if m.results and mark != "bad" and None in m.diagnoses.values():
        text.append("Not all results were diagnosed: that needs the model.")
    questions = {x: t for x, t in m.decisions.items() if kind_of_decision(t) == "risk"}
    requirements = {label: t for label, t in questions.items() if "requirement" in t.attrs}
    if m.is_usable:
        for question, table in questions.items():
            if question not in requirements:
                text.append(f"{question}: {_expected(table, m.prob)}.")
    sections = [_requirement(label, table, m) for label, table in requirements.items()]
    return [Section(title, text, verdict=mark), *sections]


def _requirement(label: str, table: xr.Dataset, m: Material) -> Section:
    """Return a requirement and, if the model may be used, its answer."""
    allowed = f"allowed: at most {percentage(table.attrs['requirement'])}"
    if not m.is_usable:
        reason = "the model is rejected" if m.rejected else "solve the problems first"
        return Section(
            "Requirement not answered",
            f"{label}; {allowed} of the specimens. There is no answer: {reason}.",
            verdict="open",
            level=3,
        )
    answer = table.attrs["verdict"]
    mark = {"met": "good", "not met": "bad"}.get(answer, "open")
    text = f"{label}: {_expected(table, m.prob)}; {allowed}."
    return Section(f"Requirement {answer}", text, verdict=mark, level=3)


def _expected(table: xr.Dataset, prob: float) -> str:
    """Return a sentence on a probability and its interval, as shares of specimens.

    The sentence names the probability of the interval unless it is ``prob``.
    """
    floor = min(1e-5, table.attrs.get("requirement", 1.0) / 10)
    bounds = dict.fromkeys(in_percent(p, floor) for p in np.ravel(table["probability"].values))
    interval = f"{in_percent(float(table.lower), floor)} to {in_percent(float(table.upper), floor)}"
    level = table.attrs.get("prob", prob)
    name = "interval" if level == prob else f"{percentage(level)} interval"
    return f"{' to '.join(bounds)} of the specimens are expected ({name} {interval})"


def _tested(m: Material) -> str:
    """Return the number of tested specimens, with their conditions where these have names."""
    labels = {label for test in m.tests.values() for label in test.specimens.tolist()}
    conditions = dict.fromkeys(name for test in m.tests.values() for name in test.of_conditions)
    # The name of a single condition may be that of a function, which readers do not know.
    is_named = len(conditions) > 1 or set(conditions) <= {*m.validation, *m.labels}
    shown = [named(condition, m.labels) for condition in conditions]
    where = f" ({enumerated(shown)})" if is_named and len(shown) <= 4 else ""
    return f"{counted(len(labels), 'specimen')}{where}"


def _data(m: Material) -> str:
    """Return the number of measured responses of each simulator."""
    data = []
    for name, sheet in m.sheets.items():
        data.append(f"a data sheet of {named(name, m.labels)} ({sheet})")
    labelled = {s["name"]: s["n_specimens"] for s in m.description["simulators"]}
    for name, y in m.observed.items():
        measured = counted(y.values.size, "measured value")
        if y.values.ndim > 1:
            n, outputs = y.values.shape
            # If specimens have labels, it is unknown how many of them a group has.
            is_labelled = bool(labelled.get(name.partition("[")[0]))
            rows = counted(n, "reading" if is_labelled else "specimen")
            measured = f"{labelled.get(name) or rows} with {counted(outputs, 'output')}"
        data.append(f"{measured} of {named(name, m.labels)}")
    return enumerated(data) if data else "measurements"


def population_in_units(m: Material) -> list[Section]:
    """Return moments, quantiles and tolerance bounds of the inputs, from the first result."""
    results: list[Optimum | xr.DataTree] = [*m.posteriors.values(), *m.live_optima.values()]
    result = results[0] if results else None
    if m.model is None or result is None or m.rejected or not population_simulators(m.model):
        return []
    try:
        table = population(result, model=m.model, prob=m.prob)
    except (TypeError, ValueError, NotImplementedError):
        return []
    shown = table.to_view()
    prefix = "correlation with "
    quantities = [
        prefix + named(q.removeprefix(prefix), m.labels) if q.startswith(prefix) else q
        for q in shown.header[1:]
    ]
    columns = {}
    for (name, unit, _), (_, *texts) in zip(table.rows(), shown.rows, strict=True):
        label = with_label(name, unit, m.labels)
        columns[label] = dict(zip(quantities, texts, strict=True))
    if len(columns) <= 4:  # With a line for each quantity the table fits on a page.
        rows = [{"": q} | {x: texts[q] for x, texts in columns.items()} for q in quantities]
    else:
        rows = [{"input": x} | texts for x, texts in columns.items()]
    about = (
        "How the inputs vary from specimen to specimen, with intervals in brackets: mean, standard "
        "deviation (sd), coefficient of variation (cv) and quantiles. 90% of the specimens exceed "
        "the B-basis value, 99% the A-basis value, with 95% confidence."
    )
    text = [about, *sentences_of(table.attrs)]
    return [Section("Population of the inputs", text, rows_table(rows), level=3)]


# -- decision --------------------------------------------------------------------------------


def decision(m: Material) -> list[Section]:
    """Return the answers for a decision, a table for each kind of question."""
    if not m.decisions:
        return []
    about = "These answers include the uncertainty of the population."
    if m.rejected:
        about = "Measurements contradict the model: do not rely on these answers."
    elif m.problems:
        about = "Solve the problems under Diagnostics before these answers are used."
    sections = [Section("Decision", about)]
    for kind, (title, text, rows_of) in _KINDS.items():
        rows = [
            {"question": label} | row
            for label, table in m.decisions.items()
            if kind_of_decision(table) == kind
            for row in rows_of(table, m)
        ]
        if rows:
            sections.append(Section(title, text, rows_table(rows), level=3))
    return sections


def _risk(table: xr.Dataset, m: Material) -> list[dict[str, Any]]:
    """Return the rows of a probability, one for each bound."""
    values, errors = (np.atleast_1d(table[key].values) for key in ("probability", "error"))
    bounds = table["bound"].values if "bound" in table.coords else [""]
    beyond = "below" if table.attrs["below"] else "above"
    required = answer = ""
    if "requirement" in table.attrs:
        required = f"at most {table.attrs['requirement']:g}"
        answer = str(table.attrs["verdict"]) if m.is_usable else "not answered"
    interval = f"{number(float(table.lower), 2)} to {number(float(table.upper), 2)}"
    return [
        {
            # The answer is the first column, as the end of a wide table is off a phone's screen.
            "requirement is": answer,
            "probability": number(float(value), 2),
            f"{percentage(table.attrs['prob'])} interval": interval,
            "required": required,
            "beyond": f"{beyond} {number(float(table.attrs['limit']))}",
            "bound": str(bound),
            "error of computation": number(float(error), 1),
        }
        for bound, value, error in zip(bounds, values, errors, strict=True)
    ]


def _indices(table: xr.Dataset, m: Material) -> list[dict[str, Any]]:
    """Return the rows of sensitivity indices, one for each factor."""
    value = plus_minus(float(table.attrs["value"]), float(table.attrs["sd"]))
    quantity = f"{table.attrs['quantity']} = {value}"
    response = str(table.attrs.get("of_inputs", "the response"))
    rows = []
    for i, (factor, kind) in enumerate(zip(table.factor.values, table.kind.values, strict=True)):
        of = response if str(kind) == "input" else quantity
        row = {"of": of, "factor": named(str(factor), m.labels)}
        for key, title in (("first", "by itself"), ("total", "with all others known")):
            index = float(table[key][i])
            error = float(table[f"{key}_error"][i])
            row[title] = f"{index:.2f} ± {error:.2f}" if np.isfinite(index) else ""
        rows.append(row)
    return rows


def _plan(table: xr.Dataset, m: Material) -> list[dict[str, Any]]:
    """Return the rows of a plan, with the present standard deviations first."""
    names = [str(name) for name in table.name.values]

    def row(text: str, sd: xr.DataArray) -> dict[str, Any]:
        sds = {named(name, m.labels): number(float(sd.sel(name=name)), 3) for name in names}
        return {"specimens": text, **sds}

    rows = [row("none more", table.now)]
    for candidate in table.candidate.values:
        for k in table.k.values:
            sd = table.sd.sel(candidate=candidate, k=k)
            rows.append(row(f"{k} more, {candidate}", sd))
    return rows


_Rows = Callable[[xr.Dataset, Material], list[dict[str, Any]]]
_KINDS: dict[str, tuple[str, str, _Rows]] = {
    "risk": (
        "Probability beyond a limit",
        "The probability is that of a new specimen; its interval is that of the share in a large "
        "batch. A requirement is met if the whole interval is below it, with two errors of the "
        "computation to spare; not met if all of it is above; and else not decided.",
        _risk,
    ),
    "sensitivity": (
        "What moves it",
        "The share of the variance that knowing a factor would remove, and the share that would "
        "remain with all others known.",
        _indices,
    ),
    "plan": (
        "What more data would change",
        "Standard deviations that are expected after further specimens.",
        _plan,
    ),
}


def next_steps(m: Material) -> list[Section]:
    """Return at most four sentences on what to do next, the most urgent first."""
    if not m.results:
        return []
    steps = []
    if m.problems:
        steps.append("Solve the problems under Diagnostics: each sentence there has the remedy.")
    if not m.tests:
        steps.append(
            "Test the model on specimens that were not used for it, at another condition if there "
            "is one. With few specimens, leave out some at a time (cross-validation)."
        )
    elif m.rejected:
        steps.append(
            "Do not use the model beyond the data that it was fitted to. See whether the measured "
            "values lie beside the predicted ones or scatter more; then correct the simulation, "
            "let another input vary, or calibrate an error of the model."
        )
    # For several outputs the statistic contains a test of the scatter.
    elif not any(test.folded or in_directions(test) for test in m.tests.values()):
        steps.append("Test the scatter as well, each of the two tests at half the level.")
    if not m.posteriors:
        steps.append("Compute the posterior: the uncertainty here is by standard errors alone.")
    tables = [] if m.rejected else list(m.decisions.values())
    kinds = set(map(kind_of_decision, tables))
    undecided = [t for t in tables if t.attrs.get("verdict") == "not decided"]
    findings = [f for t in undecided for f in from_json(str(t.attrs.get("findings", "[]")))]
    if any(finding.code != "two-families" for finding in findings):
        steps.append(
            "A requirement is not decided, as the error of the computation is too large: see "
            "Diagnostics for the number of runs."
        )
    elif undecided:
        steps.append(
            "A requirement is not decided, as too few specimens are known: plan how many more "
            "would decide it."
        )
    if not m.rejected and "risk" not in kinds:
        steps.append("Ask for the probability that a response is beyond its limit.")
    if not m.rejected and "plan" not in kinds:
        steps.append("Ask what more specimens would change, before they are made.")
    texts = [f"{i}. {step}" for i, step in enumerate(steps[:4], 1)]
    return [Section("What to do next", texts, level=3)] if texts else []


# -- answer ----------------------------------------------------------------------------------


def answer(m: Material) -> list[Section]:
    """Return the estimates of the first posterior, or else of the first optimum."""
    if not m.results:
        return []
    label = next(iter(m.posteriors or m.optima))
    rows = []
    has_draws = label in m.posteriors
    for name, (value, sd, *ends) in _estimates(m, label).items():
        texts = alike((value, sd, *ends), sd, 2)
        meaning = named(name, m.labels)
        row = {"parameter": name, "meaning": "" if meaning == name else meaning}
        row["estimate"] = texts[0]
        if np.isinf(sd):  # The data do not identify the parameter.
            texts[1] = NOTHING
        row["standard deviation" if has_draws else "standard error"] = texts[1]
        if has_draws:
            row |= {f"{percentage(m.prob)} from": texts[2], "to": texts[3]}
        rows.append(row)
    shown = rows if len(rows) <= 30 else []
    text = ["The estimates are in the appendix."]
    if shown:
        text = [f"The population of the inputs is fitted to {_data(m)}. These are its parameters."]
    if m.rejected:
        text.append("Measurements contradict the model: do not use these numbers for predictions.")
    diagnosis = m.diagnoses.get(label)
    if diagnosis is not None and "width-of-epsilon" in {f.code for f in diagnosis.findings}:
        text.append("Their spread is the tolerance of the sampler, and not their uncertainty.")
    if any(row.get("standard error") == NOTHING for row in shown):
        text.append("The data do not identify a parameter without a standard error.")
    return [Section("Answer", text, rows_table(shown))]


def _estimates(m: Material, label: str) -> dict[str, tuple[float, ...]]:
    """Return estimate, spread and interval of each hyperparameter by a result."""
    estimates, elements = estimates_of(m.results[label], m.prob)
    variables = m.description["variables"]
    names = [v["name"] for v in variables if v["role"] == "hyperparameter"]
    # Without a description deterministics cannot be told from hyperparameters.
    names = names or list(map(str, estimates_in(m.results[label]).data_vars))
    variable = {name: variable_of(name, names) for name in elements}
    readable = readable_variables(names, set(variable.values()))
    return {name: estimates[name] for name in elements if variable[name] in readable}


# -- evidence --------------------------------------------------------------------------------


def data(m: Material) -> list[Section]:
    """Return a summary of the measured responses."""
    if not (m.observed or m.sheets):
        return []
    rows = []
    text = [f"{named(name, m.labels)}: a data sheet, {x}." for name, x in m.sheets.items()]
    for simulator in m.description["simulators"]:
        if simulator["specimens"]:
            text.append(f"{named(simulator['name'], m.labels)}: {simulator['specimens']}.")
    for name, y in m.observed.items():
        columns = y.columns()
        shown = shown_columns(y)
        if len(shown) < len(columns):
            text.append(f"{name}: {len(shown)} of {len(columns)} outputs are shown.")
        for output, unit, values in shown:
            meaning = m.labels.get(f"{name}[{output}]", m.labels.get(output or name, ""))
            row = {"measured": name, "meaning": meaning, "output": output, "units": unit}
            rows.append(row | described(values))
    return [Section("Evidence", text, rows_table(with_zeros(rows)))]


def shown_columns(y: Observed) -> list[tuple[str, str, Floats]]:
    """Return name, unit and values of at most twelve outputs, from the first to the last."""
    columns = y.columns()
    places = np.linspace(0, len(columns) - 1, min(len(columns), 12)).round().astype(int)
    return [columns[place] for place in places]


def agreement(m: Material) -> list[Section]:
    """Return the tests of the calibrated model in words, and their data."""
    rows = []
    pairs = [pair for tested in m.validation.values() for pair in tested.pairs]
    for pair in pairs:
        predicted = pair.predicted[~np.isnan(pair.predicted)]
        levels = [0.5, (1 - m.prob) / 2, (1 + m.prob) / 2]
        quantiles = np.quantile(predicted, levels, method="inverted_cdf").tolist()
        median, lower, upper = alike(quantiles, finite_sd(pair.measured))
        name = {"condition": named(pair.name, m.labels)}
        interval = {f"{percentage(m.prob)} from": lower, "to": upper}
        rows.append(name | described(pair.measured) | {"predicted median": median} | interval)
    if not (m.tests or rows):
        return []
    text = [_in_words(label, test, m) for label, test in m.tests.items()]
    if len(text) > 1:
        alpha = in_percent(min(sum(test.alpha for test in m.tests.values()), 1.0))
        text.append(f"Together the tests reject a right model in up to {alpha} of cases.")
    text += [
        f"{row['condition']}: specimens failed, and no predicted one does: the model excludes them."
        for row, pair in zip(rows, pairs, strict=True)
        if row["failed"] and not np.isposinf(pair.predicted).any()
    ]
    if rows:
        text.append(
            f"The table has the measured values, and the range with {percentage(m.prob)} of the "
            "predicted ones; ∞ is a failure."
        )
    return [Section("Test of the model", text, rows_table(with_zeros(rows)), level=3)]


def _in_words(label: str, test: ValidityTest, m: Material) -> str:
    """Return the result of a test, in two sentences."""
    name = f"{label}: " if len(m.tests) > 1 else ""
    aspect, agreed = "the measured values", ("differ too much from", "agree with")
    if test.folded:
        aspect = "the scatter of the measured values"
        agreed = "differs too much from", "agrees with"
    digits = p_digits(test.p_value, test.alpha)
    p = "less than 0.1%"
    if test.p_value >= 0.001:
        p = percentage(float(f"{test.p_value:.{digits}g}"))
    aspect = aspect if name else aspect.capitalize()
    return (
        f"{name}{aspect} {agreed[not test.rejected]} the prediction. Of a right model, {p} of such "
        f"tests differ at least as much; at {percentage(test.alpha)} or less the model is rejected."
    )
