"""From results to the sections of a report."""

from __future__ import annotations

import logging
import math
from importlib import import_module
from typing import Any

import numpy as np
import xarray as xr

from prbayes.illustrations import illustrate
from prbayes.material import Material, elements, gather
from prbayes.section import Section, alike, number, places, plus_minus
from prbayes.summary import counted, shown, summary, verdict

_log = logging.getLogger("prbayes")

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
    parts = (_summary, _model, _data, _metric, _optimum, _posterior, _comparison, _diagnostics, _validity, _origin)
    sections = tuple(section for part in parts for section in part(m))
    if not pictures:
        return sections
    return illustrate(_with_graph(sections, m), m)


def _table(rows: list[dict[str, Any]]) -> Any:
    """Return a table without the columns that have nothing in them."""
    pandas: Any = import_module("pandas")
    frame = pandas.DataFrame(rows)
    empty = [c for c in frame.columns if all(v is None or v == "" or v != v for v in frame[c])]
    return frame.drop(columns=empty).reset_index(drop=True)


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
            _table([{"variable": v["name"], "role": v["role"], "distribution": v["distribution"]} for v in variables]),
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
        sections.append(Section("Simulators", text, _table(rows), level=3))
    return sections


def _with_graph(sections: tuple[Section, ...], m: Material) -> tuple[Section, ...]:
    """Add the model's graph after the parts of the section on the model; or say why there is none."""
    if m.model is None:
        return sections
    place = next(i for i, s in enumerate(sections) if s.title == "Model") + 1
    while place < len(sections) and sections[place].level == 3:
        place += 1
    try:
        import_module("graphviz")
        drawn = _graph(m.model)
        names = ", ".join(v["name"] for v in (m.description or {"variables": []})["variables"])
        alt = f"Graph of the model: arrows from its variables ({names}) to the simulators."
        caption = "Variables of the model; filled: compared with measured responses."
        section = Section("Graph", picture=drawn, alt=alt, caption=caption, level=3)
    except (ImportError, OSError) as error:  # OSError: there is the package, but no program
        why = "the Python package graphviz" if isinstance(error, ImportError) else "the program dot of Graphviz"
        section = Section("Graph", f"The model's graph is not drawn, because {why} is not installed.", level=3)
    return (*sections[:place], section, *sections[place:])


def _graph(model: Any) -> bytes:
    graphs: Any = import_module("pymc.model_graph")
    own = {node.name for node in _nodes(model)}
    plain = graphs.DEFAULT_NODE_FORMATTERS[graphs.NodeType.OBSERVED_RV]

    def observed(rv: Any) -> dict[str, Any]:
        style: dict[str, Any] = plain(rv)
        return {**style, "label": f"{rv.name}\n~\nSimulator"} if rv.name in own else style

    import pymc as pm

    graph = pm.model_to_graphviz(model, node_formatters={"Observed Random Variable": observed})
    svg: bytes = graph.pipe(format="svg")
    return svg


def _nodes(model: Any) -> Any:
    from prbayes.simulator import nodes

    return nodes(model).values()


def _data(m: Material) -> list[Section]:
    if not m.observed:
        return []
    rows = []
    for name, values in m.observed.items():
        y = values[np.isfinite(values)]
        sd = float(y.std(ddof=1)) if y.size > 1 else math.nan
        low, high, mean, spread = alike((y.min(), y.max(), y.mean(), sd) if y.size else [math.nan] * 4, sd)
        failed = int((~np.isfinite(values)).sum())
        row = {"simulator": name, "N": values.size, "failed": failed or None}
        rows.append(row | {"smallest": low, "largest": high, "mean": mean, "sd": spread})
    known = (m.description or {"simulators": []})["simulators"]
    labels = [f"{s['name']}: {s['specimens']}." for s in known if s["specimens"]]
    text = ["Measured responses, one per specimen, in the units of the response."]
    if any(row["failed"] for row in rows):
        text[0] += " Failed specimens count above all others; range, mean and sd are of the rest."
    return [Section("Data", (*text, *labels), _table(rows))]


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
                    "metric": str(own["metric"].item()),
                    "discrepancy": float(mean.sel(simulator=name)),
                    "its error": _item(own, "discrepancy_error"),
                    "epsilon": _item(own, "epsilon"),
                    "points": int(own["n_points"]) if "n_points" in own else None,
                }
            )
    if not rows and m.description is not None:
        rows = [{"simulator": s["name"], "metric": s["metric"]} for s in m.description["simulators"]]
    if not rows:
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
    return [Section("Metric and epsilon", text, _table(rows))]


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
        sections.append(Section(_titled("Optimum", label, m.optima), tuple(text), _table(rows)))
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
                | {"R-hat": "–" if math.isnan(kept["R-hat"]) else f"{kept['R-hat']:.3f}"}
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
                    f"The draws are adjusted, by {adjustment}, to the width that the data warrant: that of the metric's "
                    "own estimate over repeated sets of specimens, combined with the prior."
                )
        sections.append(Section(_titled("Posterior", label, m.posteriors), tuple(text), _table(rows)))
    return sections


def _whole(value: float) -> str:
    return "–" if not math.isfinite(value) else f"{value:.0f}"


def _error(value: float) -> str:
    decimals = places(value, 2)
    return number(value) if decimals is None else f"{value:.{decimals}f}"


def _comparison(m: Material) -> list[Section]:
    if m.comparison is None:
        return []
    table, rows, scores = m.comparison, [], []
    for name in table["hyperparameter"].values.tolist():
        for label in table["result"].values.tolist():
            own = table.sel(hyperparameter=name, result=label)
            values = [float(own[key]) for key in ("estimate", "sd", "lower", "upper")]
            estimate, sd, lower, upper = alike(values, values[1])
            row = {"hyperparameter": name, "result": label, "estimate": estimate, "sd": sd}
            rows.append(row | {"89% from": lower, "to": upper, "shift in sd": _shift(float(own["shift"]))})
    for label in table["result"].values.tolist():
        own = table.sel(result=label)
        named = {str(key): own[key].item() for key, v in table.data_vars.items() if v.dims == ("result",)}
        scores.append({"result": label} | {k: v for k, v in named.items() if k not in ("n_responses", "seconds")})
    first = table["result"].values.tolist()[0]
    text = f"The shift is the distance from the estimate of {first}, in standard deviations of the result in the row."
    sections = [Section("Comparison", text, _table(rows))]
    if len(scores[0]) > 1:
        text = "Discrepancy of the population at each estimate, under each metric, whatever it was calibrated with."
        sections.append(Section("Scores under each metric", text, _table(scores), level=3))
    return sections


def _shift(value: float) -> str:
    return f"{value + 0.0:.2f}" if math.isfinite(value) else number(value)


def _diagnostics(m: Material) -> list[Section]:
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
        sections.append(Section("Support by stored responses", about, _table(rows), level=3))
    return sections


def _stages(m: Material, label: str) -> list[str]:
    """Say what the sampler says of itself."""
    tree = m.posteriors[label]
    if "sample_stats" not in tree or "stage" not in tree["sample_stats"].dims:
        return []
    stats = tree["sample_stats"]
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
            f"log marginal likelihood {plus_minus(evidence, spread)} (spread between chains); comparable between models "
            "with the same metric and epsilon only."
        )
    return lines


def _span(values: Any, form: str) -> str:
    low, high = f"{values.min():{form}}", f"{values.max():{form}}"
    return low if low == high else f"{low} to {high}"


def _validity(m: Material) -> list[Section]:
    if not m.tests:
        return []
    rows = [
        {
            "test": label if len(m.tests) > 1 else None,
            "values": t.u_values.size,
            "specimens": np.unique(t.specimens).size,
            "of": "|2u − 1|" if t.folded else "u",
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
        "value rejects the model. Of u the area sees a wrong mean, of |2u − 1| a wrong spread. That a model is not "
        "rejected does not prove it."
    )
    held = dict.fromkeys(f"Held to be true: {t.null}." for t in m.tests.values())
    return [Section("Validity", (*(verdict(label, t, m) for label, t in m.tests.items()), about, *held), _table(rows))]


def _origin(m: Material) -> list[Section]:
    rows, versions = [], {}
    for label in m.results:
        attrs = m.attrs(label)
        seed = attrs.get("random_seed")
        rows.append(
            {
                "result": label,
                "by": str(attrs.get("sampler", "minimize" if label in m.optima else "")),
                "responses": int(attrs["n_responses"]) if "n_responses" in attrs else None,
                "seconds": shown(float(attrs["seconds"])) if "seconds" in attrs else None,
                "seed": None if seed is None else str(seed),
            }
        )
        versions |= {k.removesuffix("_version"): str(v) for k, v in attrs.items() if str(k).endswith("_version")}
    if not rows:
        return []
    made = ", ".join(f"{name} {version}" for name, version in versions.items() if name != "inference_library")
    text = ["Responses are scalar evaluations of the simulated response, those of a common design counted in each."]
    return [Section("Cost and origin", (*text, *([f"Computed with {made}."] if made else [])), _table(rows))]
