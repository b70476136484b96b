"""The report of a whole fleet: the table of its products, the worst first."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes._display import percentage
from prbayes._finding import counted, from_json
from prbayes._stats import INTERVAL
from prbayes._validate import called
from prbayes.decision.population_table import population
from prbayes.model.parameters import element_name
from prbayes.plots.canvas import with_label
from prbayes.plots.products import plot_products
from prbayes.plots.validity import plot_validity
from prbayes.reports.figures import Illustration, picture_of
from prbayes.reports.material import Material, kind_of_decision
from prbayes.reports.numbers import NOTHING, in_percent, rows_table
from prbayes.reports.section import Section
from prbayes.reports.sections import comparison_of_responses, model
from prbayes.results.products import (
    data_sheets,
    failed_products,
    product_names,
    texts_by_product,
    validity_verdicts,
)

_FOREST = Illustration(
    plot_products,
    title="Products side by side",
    alt="A row for each product with mean, interval and B-basis of each input; the worst on top.",
    caption="Sorted by the B-basis value; colours are verdicts of the validity tests.",
)
_TESTS = Illustration(
    plot_validity,
    title="u-values by product",
    alt="The u-values of the specimens of each product's validity test, a row for each.",
    caption="The u-values of a right model are spread evenly from 0 to 1.",
)
# Verdicts, the worst first
_WORST_FIRST = ("failed", "rejected", "not tested", "not rejected")


def fleet_sections(
    fleet: xr.DataTree, m: Material, decision: Any, *, pictures: bool, most: int = 25
) -> tuple[Section, ...]:
    """Return the sections of a report of a whole fleet, with the material of its model."""
    decisions = _decisions_on_fleet(decision)
    table = None if m.model is None else population(fleet, model=m.model)
    rows = _rows_of_products(fleet, table, decisions, m)
    first = rows_table(rows[:most])
    title = "Products, the worst first"
    sections = [
        _verdict_on_fleet(fleet),
        Section(title, _about_products(len(rows), most, table), first, level=3),
    ]
    sections += _drawn_of_fleet(_FOREST, table, pictures and table is not None)
    sections += [Section("Test of the products", level=2)] if "validity" in fleet.children else []
    sections += _drawn_of_fleet(_TESTS, fleet, pictures and "validity" in fleet.children)
    sections += [*model(m), *comparison_of_responses(m)]
    sections.append(Section("Diagnostics", _findings_of_products(fleet, decisions)))
    if len(rows) > most:
        sections += [Section("Appendix"), Section("All products", (), rows_table(rows), level=3)]
    return tuple(sections)


def _drawn_of_fleet(illustration: Illustration, result: Any, is_requested: bool) -> list[Section]:
    """Return a picture, or why it could not be made."""
    if not is_requested:
        return []
    picture = picture_of(illustration, ((result,), {}))
    if isinstance(picture, Section):
        return [picture]
    return [Section(f"{illustration.title}: no picture", picture, level=3)]


def _decisions_on_fleet(decision: Any) -> dict[str, xr.Dataset]:
    """Return the tables of exceedances by question, or raise."""
    tables = decision if isinstance(decision, Mapping) else {"decision": decision}
    if isinstance(decision, xr.Dataset):
        tables = {"decision": decision}
    tables = {str(name): table for name, table in tables.items() if table is not None}
    for name, table in tables.items():
        if kind_of_decision(table) != "risk" or "product" not in table.dims:
            raise TypeError(
                f"Report: {name}: got {called(table)}, expected prb.exceedance of the whole fleet"
            )
    return tables


def _verdict_on_fleet(fleet: xr.DataTree) -> Section:
    """Return how many products are rejected, have failed, or have findings."""
    verdicts = validity_verdicts(fleet)
    counts = {name: verdicts.count(name) for name in _WORST_FIRST}
    n_tested = counts["rejected"] + counts["not rejected"]
    title, mark = "Not tested", "open"
    text = []
    if n_tested:
        alpha = float(fleet["products"].attrs["alpha"])
        title = f"{counts['rejected']} of {counted(n_tested, 'tested product')} rejected"
        mark = "bad" if counts["rejected"] else "good"
        text.append(
            f"Of valid products about {alpha * n_tested:.2g} would be rejected at the level of "
            f"{percentage(alpha)}. Do not use the predictions of rejected products."
        )
    n_found = len(texts_by_product(fleet, "finding")) - counts["failed"]
    reported = {
        "not tested": counts["not tested"],
        "failed": counts["failed"],
        "with findings": n_found,
        "by a data sheet": len(data_sheets(fleet)),
    }
    parts = [f"{n} {name}" for name, n in reported.items() if n]
    text.append(", ".join([counted(len(verdicts), "product"), *parts]) + ".")
    return Section(title, text, verdict=mark)


def _rows_of_products(
    fleet: xr.DataTree,
    table: xr.Dataset | None,
    decisions: Mapping[str, xr.Dataset],
    m: Material,
) -> list[dict[str, Any]]:
    """Return a row for each product, the worst first."""
    names, verdicts = product_names(fleet), validity_verdicts(fleet)
    products = fleet["products"].to_dataset()
    findings = np.atleast_1d(products["finding"].values).tolist()
    sheets = data_sheets(fleet)
    sizes = _numbers_of_specimens(fleet)
    rows: list[dict[str, Any]] = []
    for k, name in enumerate(names):
        n = f"sheet of {sheets[name].n}" if name in sheets else str(sizes[k])
        p = float(np.atleast_1d(products["p_value"].values)[k]) if "p_value" in products else np.nan
        validity = verdicts[k] if np.isnan(p) else f"{verdicts[k]}, p = {p:.2g}"
        if findings[k] and verdicts[k] != "failed":
            validity += "; finding"
        rows.append({"product": name, "validity": validity, "specimens": n})
    highest = np.zeros(len(names))  # probability of each product, of all decisions
    for question, risk in decisions.items():
        of_products = risk.sel(product=names)
        probability = of_products["probability"].transpose("product", ...).values
        highest = np.fmax(highest, probability.reshape(len(names), -1).max(axis=1))
        for k, row in enumerate(rows):
            row |= _risk_of_product(question, of_products.isel(product=k))
    keys = np.zeros(len(names))
    if table is not None:
        keys = table["estimate"].sel(quantity="B-basis").isel(name=0).values
        cells = {(x, q): c for x, _, by_quantity in table.rows() for q, c in by_quantity.items()}
        columns = table["name"].values.tolist()[:3]
        units = table["unit"].values
        for x, unit in zip(columns, units, strict=False):
            label = with_label(x, str(unit), m.labels)
            for row in rows:
                of_row = element_name(x, [row["product"]])
                for quantity in ("mean", "sd", "B-basis"):
                    value, interval = cells.get((of_row, quantity), (NOTHING, ""))
                    text = f"{value} ({interval})" if interval else value
                    row[f"{label}: {quantity}"] = text
    by_product = zip(verdicts, -highest, findings, np.nan_to_num(keys), strict=True)
    ranks = [(_WORST_FIRST.index(v), risk, not f, key) for v, risk, f, key in by_product]
    order = sorted(range(len(rows)), key=ranks.__getitem__)
    return [rows[k] for k in order]


def _numbers_of_specimens(fleet: xr.DataTree) -> list[int]:
    """Return the number of specimens of each product."""
    (data,) = fleet["observed_data"].data_vars.values()
    measured = data.transpose("product", ...).notnull().values
    is_specimen = measured.any(axis=tuple(range(2, measured.ndim)))
    return [int(n) for n in is_specimen.sum(axis=1)]


def _risk_of_product(question: str, table: xr.Dataset) -> dict[str, str]:
    """Return probability and verdict of a requirement for a product."""
    values = np.atleast_1d(table["probability"].values)
    if np.isnan(values).any():
        return {question: NOTHING}
    text = " to ".join(in_percent(float(p)) for p in values)
    if "verdict" in table.coords:
        text += f", {table['verdict'].item()}"
    return {question: text}


def _about_products(n: int, most: int, table: xr.Dataset | None) -> str:
    """Return what the columns are."""
    prob = percentage(INTERVAL)
    text = f"{min(n, most)} of {counted(n, 'product')}. "
    if table is None:
        return text + "Populations need the model, which was not given."
    return text + (
        f"Mean and standard deviation (sd) of the inputs have {prob} intervals in brackets. 90% of "
        "the specimens exceed the B-basis value, with 95% confidence. Rows are sorted by the "
        "verdict of the test, the probability of a decision, findings, and the B-basis value."
    )


def _findings_of_products(
    fleet: xr.DataTree, decisions: Mapping[str, xr.Dataset], most: int = 40
) -> list[str]:
    """Return the findings of the products, at most a page."""
    texts = texts_by_product(fleet, "finding")
    lines = [f"{name}: {text.removeprefix(f'{name}: ')}" for name, text in texts.items()]
    for question, table in decisions.items():
        for finding in from_json(str(table.attrs.get("findings", "[]"))):
            lines.append(f"{question}: {finding}")
    if len(lines) > most:
        lines = [*lines[:most], f"{len(lines) - most} more are in the column finding of the fleet."]
    failed = failed_products(fleet)
    about = "The table has the findings of the calibration."
    if failed:
        about += f" {counted(len(failed), 'product')} failed and has no population."
    return [
        about + " The report of one product, posterior=fleet.sel(product=...), has its diagnosis.",
        *lines,
    ]
