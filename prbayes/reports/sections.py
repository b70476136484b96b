"""The sections of a report: model, data, metric, optima, posteriors, decision; the order of all."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np
import xarray as xr

from prbayes._finding import from_json
from prbayes._stats import INTERVAL
from prbayes._validate import Floats
from prbayes.decision.population_table import population
from prbayes.model.description import labelled
from prbayes.model.emulated import population_simulators
from prbayes.model.parameters import (
    optimum_elements,
    readable_elements,
    single_elements,
    split_elements,
    stacked_draws,
    table_elements,
)
from prbayes.optimize.optimum import Optimum, compared_in
from prbayes.plots.canvas import named
from prbayes.reports.assessment import (
    answers,
    diagnostics,
    failures,
    interval_of,
    next_steps,
    origin,
    specimens,
    summary,
    validity,
)
from prbayes.reports.figures import illustrate, with_graph
from prbayes.reports.material import Material, kind_of_decision
from prbayes.reports.numbers import (
    NOTHING,
    alike,
    correlation_table,
    counted,
    described,
    number,
    percentage,
    places,
    plus_minus,
    rows_table,
    sample_sd,
    with_zeros,
)
from prbayes.reports.section import Section
from prbayes.response.outputs import SINGLE_OUTPUT, with_unit


def sections_of(material: Material, *, pictures: bool) -> tuple[Section, ...]:
    """Return the sections that the material allows, with or without pictures."""
    parts = (
        _summary,
        population_in_units,
        model,
        data,
        metric,
        optima,
        posteriors,
        comparison,
        diagnostics,
        failures,
        validity,
        specimens,
        decision,
        origin,
    )
    sections = tuple(section for part in parts for section in part(material))
    return illustrate(with_graph(sections, material), material) if pictures else sections


def _summary(m: Material) -> list[Section]:
    if not (m.results or m.tests or m.description):
        return []
    sections = [Section("Summary", summary(m), rows_table(answers(m)))]
    steps = next_steps(m)
    if steps:
        sections.append(Section("What to do next", steps, level=3))
    return sections


# -- population ------------------------------------------------------------------------------


def population_in_units(m: Material) -> list[Section]:
    """Return moments, quantiles and tolerance bounds of the inputs, by the first result."""
    results: list[Optimum | xr.DataTree] = [*m.posteriors.values(), *m.live_optima.values()]
    result = results[0] if results else None
    if m.model is None or result is None or m.rejected or not population_simulators(m.model):
        return []
    try:
        table = population(result, model=m.model)
    except (TypeError, ValueError, NotImplementedError) as error:
        return [Section("Population", f"Not shown: {error}.", level=3)]
    quantities = table["quantity"].values.tolist()
    columns: dict[str, dict[str, str]] = {}
    for name, unit, cells in table.rows():
        label = named(name, m.labels)
        texts = {}
        for quantity in quantities:
            value, interval = cells.get(quantity, ("", ""))
            texts[quantity.replace("cv", "cv, %")] = f"{value} ({interval})" if interval else value
        columns[with_unit(label, unit) if label == name else label] = texts
    if len(columns) <= 4:  # a line for each quantity, which fits on a page
        names = next(iter(columns.values()))
        rows = [{"": q} | {x: texts[q] for x, texts in columns.items()} for q in names]
    else:
        rows = [{"input": x} | texts for x, texts in columns.items()]
    about = (
        "How the inputs vary from specimen to specimen: mean, standard deviation (sd), coefficient "
        f"of variation (cv) and quantiles, with {INTERVAL:.0%} intervals in brackets. "
        "A B-basis (A-basis) value is a tolerance bound: 90% (99%) of all specimens exceed it, "
        "with 95% confidence."
    )
    return [Section("Population", about, rows_table(rows), level=3)]


# -- model -----------------------------------------------------------------------------------


def model(m: Material) -> list[Section]:
    """Return the variables of the model, and its simulators."""
    if m.description is None:
        return []
    variables = [
        {
            "variable": v["name"],
            "role": v["role"],
            "distribution": v["distribution"],
            "meaning": m.labels.get(v["name"], ""),
        }
        for v in m.variables
    ]
    about = (
        "Hyperparameters describe how the inputs vary from specimen to specimen, "
        "and have prior distributions."
    )
    sections = [Section("Model", about, rows_table(variables))]
    simulators = [
        {"simulator": s["name"]} | {key: s[key] for key in ("response", "inputs", "propagation")}
        for s in m.simulators
    ]
    if simulators:
        about = "A simulator computes the response of a specimen from its inputs."
        sections.append(Section("Simulators", about, rows_table(simulators), level=3))
    return sections


# -- data ------------------------------------------------------------------------------------


def data(m: Material) -> list[Section]:
    """Return a summary of the measured responses, correlations of outputs, and the values."""
    if not m.observed:
        return []
    rows: list[dict[str, Any]] = []
    text = ["Measured responses, in the units of the response."]
    for simulator in m.simulators:
        if simulator["specimens"]:
            text.append(f"{simulator['name']}: {simulator['specimens']}.")
    correlations = []
    # The measured values, by which a calibration can be repeated; at most half a page
    about = f"In the order of the specimens; {NOTHING} was not measured, ∞ is a failure."
    values = [about]
    for name, y in m.observed.items():
        outputs = m.outputs.get(name, SINGLE_OUTPUT)
        columns: list[tuple[str, int, Floats]] = []
        if y.ndim == 1:
            columns = [("", 0, y)]
        else:  # at most twelve outputs, half a page, from the first to the last
            n = y.shape[1]
            places = map(round, np.linspace(0, n - 1, min(n, 12)).tolist())
            columns = [(outputs.names[j], j, y[:, j]) for j in places]
            if len(columns) < n:
                text.append(f"{name}: {len(columns)} of {n} outputs are shown.")
            if n > 1:
                correlations.append(_correlations(name, columns))
        for output, j, column in columns:
            meaning = m.labels.get(name, "")
            if y.ndim > 1:
                meaning = m.labels.get(f"{name}[{output}]", m.labels.get(output, ""))
            units = outputs.units[j] if outputs.units else ""
            row = {"simulator": name, "meaning": meaning, "output": output, "units": units}
            rows.append(row | described(column))
        if y.size > 300:
            values.append(f"{name}: {y.size} values, which are too many to print.")
        else:
            names = [name] if y.ndim == 1 else [f"{name}[{output}]" for output in outputs.names]
            for element, column in zip(names, np.atleast_2d(y.T), strict=True):
                texts = alike(column.tolist(), sample_sd(column[np.isfinite(column)]), 4)
                values.append(f"{element}: {', '.join(texts)}.")
    table = rows_table(with_zeros(rows))
    return [
        Section("Data", text, table),
        *correlations,
        Section("Measured values", values, level=3),
    ]


def _correlations(name: str, columns: list[tuple[str, int, Floats]]) -> Section:
    """Return the correlations of outputs, each of the specimens that have both."""
    pandas: Any = import_module("pandas")
    y = np.column_stack([column for *_, column in columns])
    r = pandas.DataFrame(np.where(np.isfinite(y), y, np.nan)).corr(min_periods=3).values
    about = (
        f"Correlations of the measured outputs of {name}, each of the specimens that have both; "
        "those that failed are in none."
    )
    table = correlation_table([output for output, *_ in columns], r, 3)
    return Section(f"Correlations of {name}", about, table, level=3)


# -- metric ----------------------------------------------------------------------------------


def metric(m: Material) -> list[Section]:
    """Return the metric, and the discrepancies and epsilons of the results."""
    rows = [
        row
        for label, calibration in m.calibrations.items()
        for row in _discrepancies(label, calibration)
    ]
    metrics = _metrics(m)
    if not rows and not metrics:
        return []
    if m.is_by_specimen:
        about = (
            "The log-likelihood compares specimens: the density of each measured response in the "
            "population, through the inputs that reproduce it. It is evaluated on an emulator of "
            "the response, whose runs are counted here. The log-likelihood of a posterior is the "
            "mean over its draws."
        )
        for row in rows:
            row["log-likelihood"] = -row["discrepancy"]
        keys = ("result", "simulator", "log-likelihood", "runs")
        table = rows_table([{key: row[key] for key in keys} for row in rows])
        return [Section("Log-likelihood", about, table)]
    about = (
        "The metric measures how far the distribution of the simulated responses is "
        "from that of the measured ones; smaller is better."
    )
    if any(row["epsilon"] is not None for row in rows):
        about += (
            " Epsilon is the discrepancy that the sampler takes for one unit of log-density."
            " The discrepancy of a posterior is the mean over its draws."
        )
    lines = [f"{name}: {metric}." for name, metric in metrics.items()]
    compared = [line for table in m.calibrations.values() for line in compared_in(table)]
    text = (about, *lines, *dict.fromkeys(compared))
    return [Section("Metric and epsilon", text, rows_table(rows))]


def _discrepancies(label: str, calibration: xr.Dataset) -> list[dict[str, Any]]:
    """Return a row for each simulator of a result."""
    sample_dims = [dim for dim in ("chain", "draw") if dim in calibration.dims]
    mean = calibration["discrepancy"].mean(sample_dims, skipna=False)
    rows: list[dict[str, Any]] = []
    for name in calibration["simulator"].values.tolist():
        values = calibration.sel(simulator=name)
        keys = ("discrepancy_error", "epsilon")
        error, epsilon = (float(values[key]) if key in values else None for key in keys)
        rows.append(
            {
                "result": label,
                "simulator": name,
                "discrepancy": float(mean.sel(simulator=name)),
                "Monte Carlo error": error,
                "epsilon": epsilon,
                "runs": str(int(values["n_runs"])) if "n_runs" in values else None,
            }
        )
    return rows


def _metrics(m: Material) -> dict[str, str]:
    """Return the metric by simulator; by result as well, where results differ in it."""
    by_result = {}
    for label, table in m.calibrations.items():
        pairs = zip(table["simulator"].values, table["metric"].values, strict=True)
        by_result[label] = {str(name): str(metric) for name, metric in pairs}
    if not by_result:
        return {s["name"]: s["metric"] for s in m.simulators}
    first, *rest = by_result.values()
    if all(metrics == first for metrics in rest):
        return first
    return {
        f"{label}, {name}": metric
        for label, metrics in by_result.items()
        for name, metric in metrics.items()
    }


# -- optima ----------------------------------------------------------------------------------


def optima(m: Material) -> list[Section]:
    """Return a section for each optimum."""
    sections = []
    for label, tree in m.optima.items():
        names = readable_elements(
            optimum_elements(tree["optimum"].data_vars, tree["stderr"].data_vars)
        )
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
        text.append(
            "Standard errors are those of the curvature of the log-likelihood."
            if m.is_by_specimen
            else "Standard errors are those of the estimator over repeated sets of as many "
            "specimens."
        )
        point = single_elements(tree["optimum"].data_vars)
        stderr = single_elements(tree["stderr"].data_vars)
        rows = []
        for name in names:
            estimate, error = alike((point[name], stderr[name]), stderr[name])
            rows.append({"hyperparameter": name, "estimate": estimate, "standard error": error})
        sections.append(Section(_titled("Optimum", label, m.optima), text, rows_table(rows)))
    return sections


def _titled(title: str, label: str, results: Mapping[str, Any]) -> str:
    return title if len(results) == 1 else f"{title}: {label}"


def _other_optimum(mode: Mapping[str, Any], point: Mapping[Any, Any], names: Sequence[str]) -> str:
    """Return a sentence on another optimum, by scalars alone if its elements are many."""
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


# -- posteriors ------------------------------------------------------------------------------


def posteriors(m: Material) -> list[Section]:
    """Return a section for each posterior."""
    sections = []
    for label, tree in m.posteriors.items():
        posterior = tree["posterior"]
        chains = counted(int(posterior.sizes["chain"]), "chain")
        by = f" by {posterior.attrs['sampler']}" if "sampler" in posterior.attrs else ""
        text = [
            f"{chains} of {posterior.sizes['draw']} draws{by}. "
            f"Intervals contain {INTERVAL:.0%} of the draws, with equal tails."
        ]
        # The width of the draws of `sample_smc`
        adjustment = str(posterior.attrs.get("adjustment", ""))
        if m.is_by_specimen or not adjustment:
            pass
        elif adjustment == "estimate":
            text.append(
                "The posterior is that given the metric's own estimate: prior times density of the "
                "estimate over repeated sets of specimens."
            )
        elif bool((tree["calibration"]["is_likelihood"] == 0).any()):
            text.append(
                "The draws are those of exp(-discrepancy / epsilon): their width is epsilon's."
            )
        draws = stacked_draws(posterior)
        values = split_elements(draws)
        names = readable_elements(table_elements(draws))
        title = _titled("Posterior", label, m.posteriors)
        table = rows_table(_posterior_rows(tree, list(values), names))
        sections.append(Section(title, text, table))
        varying = [name for name in names if np.ptp(values[name]) > 0]
        if 2 <= len(varying) <= 8:  # more do not fit on a page
            r = np.corrcoef([values[name] for name in varying])
            about = "Correlations of the draws: the data hardly distinguish a pair near 1 or -1."
            title = _titled("Correlations of the hyperparameters", label, m.posteriors)
            sections.append(Section(title, about, correlation_table(varying, r, 2), level=3))
    return sections


def _posterior_rows(
    tree: xr.DataTree, elements: list[str], names: Sequence[str]
) -> list[dict[str, Any]]:
    arviz: Any = import_module("arviz")  # heavy, and partly annotated
    with np.errstate(all="ignore"):  # a variable that never moves
        table = arviz.summary(tree, kind="all", ci_prob=INTERVAL, ci_kind="eti", round_to="none")
    percent = f"{100 * INTERVAL:.0f}"
    rows = []
    # ArviZ has the same elements in the same order, with names of its own.
    for name, (_, values) in zip(elements, table.iterrows(), strict=True):
        if name not in names:
            continue
        in_units = [values[k] for k in ("mean", "sd", f"eti{percent}_lb", f"eti{percent}_ub")]
        mean, sd, lower, upper = alike(in_units, float(values["sd"]))
        bulk, tail, rhat, mcse = (
            float(values[k]) for k in ("ess_bulk", "ess_tail", "r_hat", "mcse_mean")
        )
        decimals = places(mcse, 2)
        rows.append(
            {
                "variable": name,
                "mean": mean,
                "sd": sd,
                f"{percent}% from": lower,
                "to": upper,
                "ESS, bulk": f"{bulk:.0f}" if math.isfinite(bulk) else NOTHING,
                "ESS, tail": f"{tail:.0f}" if math.isfinite(tail) else NOTHING,
                "R-hat": NOTHING if math.isnan(rhat) else f"{rhat:.3f}",
                "error of mean": number(mcse) if decimals is None else f"{mcse:.{decimals}f}",
            }
        )
    return rows


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
            cell = table.sel(hyperparameter=name, result=label)
            values = [float(cell[key]) for key in ("estimate", "sd", "lower", "upper")]
            estimate, sd, lower, upper = alike(values, values[1])
            shift = float(cell["shift"])
            rows.append(
                {
                    "hyperparameter": name,
                    "result": label,
                    "estimate": estimate,
                    "sd": sd,
                    f"{INTERVAL:.0%} from": lower,
                    "to": upper,
                    "shift in sd": f"{shift + 0.0:.2f}" if math.isfinite(shift) else number(shift),
                }
            )
    about = (
        f"The shift is the distance from the estimate of {labels[0]}, "
        "in standard deviations of the result in the row."
    )
    sections = [Section("Comparison", about, rows_table(rows))]
    scores = [
        {"under the metric": str(key)} | dict(zip(labels, values.values.tolist(), strict=True))
        for key, values in table.data_vars.items()
        if values.dims == ("result",) and key not in ("n_responses", "seconds")
    ]
    if scores:
        about = (
            "Discrepancy of the population at each estimate, under each metric, "
            "whichever metric it was calibrated with."
        )
        sections.append(Section("Scores under each metric", about, rows_table(scores), level=3))
    return sections


# -- decision --------------------------------------------------------------------------------


def decision(m: Material) -> list[Section]:
    """Return the answers for a decision, a table for each kind of question."""
    if not m.decisions:
        return []
    about = ["These answers include the uncertainty of the hyperparameters by the posterior."]
    if m.rejected:
        about.insert(
            0,
            "The calibrated model was rejected, see Validity: these answers are of a model that "
            "data contradict. Do not rely on them.",
        )
    elif m.has_problems:
        about.insert(0, "Remove the problems under Diagnostics before these answers are used.")
    for label, table in m.decisions.items():
        about += [f"{label}: {f}" for f in from_json(str(table.attrs.get("findings", "[]")))]
    sections = [Section("Decision", about)]
    for kind, (title, text, rows_of) in _KINDS.items():
        rows = [
            {"question": label} | _unanswered(row, m)
            for label, table in m.decisions.items()
            if kind_of_decision(table) == kind
            for row in rows_of(table, m.labels)
        ]
        if rows:
            sections.append(Section(title, text, rows_table(rows), level=3))
    return sections


def _unanswered(row: dict[str, Any], m: Material) -> dict[str, Any]:
    """Return a row without a verdict if the model must not be used."""
    if row.get("requirement is") and not m.is_usable:
        return row | {"requirement is": "not answered"}
    return row


def _risk(table: xr.Dataset, labels: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the rows of a probability, one for each bound."""
    values, errors = (np.atleast_1d(table[key].values) for key in ("probability", "error"))
    bounds = table["bound"].values if "bound" in table.coords else [""]
    beyond = "below" if table.attrs["below"] else "above"
    required = verdict = ""
    if "requirement" in table.attrs:
        required = f"at most {table.attrs['requirement']:g}"
        verdict = str(table.attrs["verdict"])
    return [
        {
            "beyond": f"{beyond} {table.attrs['limit']:g}",
            "bound": str(bound),
            "probability": number(float(value), 2),
            "its error": number(float(error), 1),
            f"{percentage(table.attrs['prob'])} interval": interval_of(table),
            "required": required,
            "requirement is": verdict,
        }
        for bound, value, error in zip(bounds, values, errors, strict=True)
    ]


def _indices(table: xr.Dataset, labels: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the rows of sensitivity indices, one for each factor."""
    value = plus_minus(float(table.attrs["value"]), float(table.attrs["sd"]))
    quantity = f"{table.attrs['quantity']} = {value}"
    response = str(table.attrs.get("of_inputs", "the response"))
    rows = []
    for i, (factor, kind) in enumerate(zip(table.factor.values, table.kind.values, strict=True)):
        of = response if str(kind) == "input" else quantity
        row = {"of": of, "factor": named(str(factor), labels)}
        for key, title in (("first", "by itself"), ("total", "with all others known")):
            index = float(table[key][i])
            error = float(table[f"{key}_error"][i])
            row[title] = f"{index:.2f} ± {error:.2f}" if np.isfinite(index) else ""
        rows.append(row)
    return rows


def _plan(table: xr.Dataset, labels: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the rows of a plan, the present first."""
    names = [str(name) for name in table.name.values]

    def row(text: str, sd: xr.DataArray) -> dict[str, Any]:
        sds = {name: number(float(sd.sel(name=name)), 3) for name in names}
        return {"specimens": text, **sds}

    rows = [row("none more", table.now)]
    for candidate in table.candidate.values:
        for k in table.k.values:
            sd = table.sd.sel(candidate=candidate, k=k)
            rows.append(row(f"{k} more, {candidate}", sd))
    return rows


_Rows = Callable[[xr.Dataset, Mapping[str, str]], list[dict[str, Any]]]
_KINDS: dict[str, tuple[str, str, _Rows]] = {
    "risk": (
        "Probability of exceedance",
        "The probability is that of a new specimen; the interval is that of the share in a large "
        "batch. A requirement is met if the whole interval is below it, not met if all of it is "
        "above, with two errors of the computation on both sides, and else not decided.",
        _risk,
    ),
    "sensitivity": (
        "What moves it",
        "The share of a variance that knowing a factor would remove, and that is left when all "
        "others are known: of hyperparameters, in the uncertainty of the quantity; of inputs, in "
        "the scatter of specimens.",
        _indices,
    ),
    "plan": (
        "What more data would change",
        "Standard deviations that are expected after further specimens.",
        _plan,
    ),
}
