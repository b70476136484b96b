"""The sections with the answers: optima and posteriors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np
import xarray as xr

from prbayes._stats import INTERVAL
from prbayes.model.elements import (
    read_elements,
    single_elements,
    split_elements,
    stacked_draws,
    told_elements,
    told_of,
)
from prbayes.model.labels import labelled
from prbayes.reports.material import Material
from prbayes.reports.numbers import NOTHING, alike, counted, number, places
from prbayes.reports.section import Section
from prbayes.reports.tables import rows_table

# More elements than this make a sentence too long to read, so that it has scalars alone: by
# judgement.
_LONGEST_PLACE = 8


def optima(m: Material) -> list[Section]:
    """Return a section for each optimum."""
    sections = []
    for label, tree in m.optima.items():
        text = [_how_it_ended(tree["optimum"].attrs)]
        if label in m.found:
            evaluator = m.found[label].evaluator
            for rival in m.found[label].rivals:
                point = labelled(evaluator, rival["point"], {}).data_vars
                text.append(_other_optimum(rival, point, _read_of(tree)))
        text.append(
            "Standard errors are those of the curvature of the log-likelihood."
            if m.is_by_specimen
            else "Standard errors are those of the estimator over repeated sets of as many "
            "specimens."
        )
        title = _titled("Optimum", label, m.optima)
        sections.append(Section(title, text, rows_table(_optimum_rows(tree))))
    return sections


def _optimum_rows(tree: xr.DataTree) -> list[dict[str, Any]]:
    point = single_elements(tree["optimum"].data_vars)
    stderr = single_elements(tree["stderr"].data_vars)
    rows = []
    for name in _read_of(tree):
        estimate, error = alike((point[name], stderr[name]), stderr[name])
        rows.append({"hyperparameter": name, "estimate": estimate, "standard error": error})
    return rows


def _read_of(tree: xr.DataTree) -> list[str]:
    """Return the elements of an optimum that are read."""
    return read_elements(told_of(tree["optimum"].data_vars, tree["stderr"].data_vars))


def _how_it_ended(attrs: Mapping[Any, Any]) -> str:
    ended = "converged" if attrs.get("converged") else "did not converge"
    evaluations = counted(int(attrs.get("n_evaluations", 0)), "evaluation")
    message = str(attrs.get("message", "")).rstrip(".")
    told = f"The optimiser {ended} after {evaluations} of the objective: {message}."
    if not attrs.get("prior"):
        return told
    return (
        f"{told} Minus the log prior was part of the objective: "
        "the discrepancy alone is smallest elsewhere."
    )


def _other_optimum(rival: Mapping[str, Any], point: Mapping[Any, Any], names: Sequence[str]) -> str:
    """Say where another optimum is, by elements that are read."""
    elements = single_elements(point)
    shown = [name for name in names if name in elements]
    if len(shown) > _LONGEST_PLACE:
        shown = [name for name in shown if name in point] or shown
    at = ", ".join(f"{name} = {number(elements[name])}" for name in shown)
    discrepancy = number(float(rival["discrepancy"]))
    if rival["comparable"]:
        judged = "the data could as well come from there"
    else:
        judged = "the data fit it less well; a posterior tells how much it counts"
    return f"Another optimum is at {at}, with discrepancy {discrepancy}: {judged}."


def posteriors(m: Material) -> list[Section]:
    """Return a section for each posterior."""
    sections = []
    for label, tree in m.posteriors.items():
        text = [_size(tree["posterior"]), *([] if m.is_by_specimen else _width(tree))]
        title = _titled("Posterior", label, m.posteriors)
        sections.append(Section(title, text, rows_table(_posterior_rows(tree))))
        rows = _correlation_rows(tree)
        if rows:
            about = "Correlations of the draws: what is 1 or -1 the data hardly tell apart."
            title = _titled("Correlations of the hyperparameters", label, m.posteriors)
            sections.append(Section(title, about, rows_table(rows), level=3))
    return sections


# Columns of correlations that fit on a page of A4 in print.
_MOST_CORRELATED = 8


def _correlation_rows(tree: xr.DataTree) -> list[dict[str, str]]:
    """Return the correlations of the draws; none of one variable, or of more than fit."""
    draws = stacked_draws(tree["posterior"])
    values = split_elements(draws)
    told = [name for name in read_elements(told_elements(draws)) if np.ptp(values[name]) > 0]
    if not 2 <= len(told) <= _MOST_CORRELATED:
        return []
    r = np.corrcoef([values[name] for name in told])
    rows = []
    for i, name in enumerate(told):
        row = {"": name}
        for j, other in enumerate(told):
            row[other] = "1" if i == j else f"{r[i, j] + 0.0:.2f}"
        rows.append(row)
    return rows


def _titled(what: str, label: str, among: Mapping[str, Any]) -> str:
    return what if len(among) == 1 else f"{what}: {label}"


def _posterior_rows(tree: xr.DataTree) -> list[dict[str, Any]]:
    arviz: Any = import_module("arviz")  # heavy, and partly annotated
    with np.errstate(all="ignore"):  # a variable that never moves
        table = arviz.summary(tree, kind="all", ci_prob=INTERVAL, ci_kind="eti", round_to="none")
    # Elements are called as in all else of a report, where ArviZ has ways of its own.
    draws = stacked_draws(tree["posterior"])
    names = list(split_elements(draws))
    told = read_elements(told_elements(draws))
    percent = f"{100 * INTERVAL:.0f}"
    rows = []
    for name, (_, found) in zip(names, table.iterrows(), strict=True):
        if name not in told:
            continue
        in_units = [found[k] for k in ("mean", "sd", f"eti{percent}_lb", f"eti{percent}_ub")]
        mean, sd, lower, upper = alike(in_units, float(found["sd"]))
        rows.append(
            {
                "variable": name,
                "mean": mean,
                "sd": sd,
                f"{percent}% from": lower,
                "to": upper,
                "ESS, bulk": _whole(float(found["ess_bulk"])),
                "ESS, tail": _whole(float(found["ess_tail"])),
                "R-hat": _rhat(float(found["r_hat"])),
                "error of mean": _error(float(found["mcse_mean"])),
            }
        )
    return rows


def _size(posterior: Any) -> str:
    chains = counted(int(posterior.sizes["chain"]), "chain")
    by = f" by {posterior.attrs['sampler']}" if "sampler" in posterior.attrs else ""
    return (
        f"{chains} of {posterior.sizes['draw']} draws{by}. "
        f"Intervals hold {INTERVAL:.0%} of the draws, with equal tails."
    )


def _width(tree: xr.DataTree) -> list[str]:
    """Say what the width of the draws is, of results of `sample_smc`."""
    attrs = tree["posterior"].attrs
    if "adjustment" not in attrs:
        return []
    adjustment = str(attrs["adjustment"])
    if adjustment == "estimate":
        return [
            "The posterior is that given the metric's own estimate: prior times density of the "
            "estimate over repeated sets of specimens."
        ]
    by_epsilon = "The draws are those of exp(-discrepancy / epsilon): their width is epsilon's."
    return [by_epsilon] if _has_epsilon(tree) else []


def _has_epsilon(tree: xr.DataTree) -> bool:
    """Return whether a simulator of the result has a metric with an epsilon."""
    calibration = tree["calibration"].to_dataset()
    return bool((calibration["is_likelihood"] == 0).any())


def _whole(value: float) -> str:
    return f"{value:.0f}" if math.isfinite(value) else NOTHING


def _rhat(value: float) -> str:
    return NOTHING if math.isnan(value) else f"{value:.3f}"


def _error(value: float) -> str:
    """Return a Monte Carlo error with two significant digits."""
    decimals = places(value, 2)
    return number(value) if decimals is None else f"{value:.{decimals}f}"
