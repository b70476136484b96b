"""Products of a fleet, one row each: quantities with intervals, or u-values of validity tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Sized
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from prbayes._display import percentage
from prbayes._finding import counted
from prbayes._validate import Floats, Indices, Labels, plain_text, wrong_type
from prbayes.plots.canvas import (
    BLUE,
    GREY,
    PALE,
    VERMILION,
    check_options,
    finish,
    ink,
    named,
    panels,
    refuse_labels,
    round_ticks,
    with_label,
)
from prbayes.plots.selection import Coords, FilterVars, VarNames, select_variables, subset
from prbayes.validation.area_test import ValidityTest

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colour of a product by the verdict of its validity test
_COLORS = {"rejected": VERMILION, "not rejected": BLUE, "not tested": GREY}


def plot_products(
    table: xr.Dataset,
    *,
    sort: str | None = None,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
    """Draw a row for each product of a fleet: mean with interval and B-basis, or a probability.

    The worst product is on top. Colours are those of the verdicts of validity tests. Of many
    products only those that were rejected have names.

    Parameters
    ----------
    table : xarray.Dataset
        From `population` or `exceedance` of a whole fleet.
    sort : str, optional
        Quantity by which products are sorted; "B-basis" by default, so that the one with the
        smallest value (the largest one of an upper bound) is on top.
    var_names : str or sequence of str, optional
        Inputs or responses of `population`, a panel each; all by default.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Such as ``{"product": ["A", "B"]}``.
    labels : mapping, optional
        Labels of inputs, responses or products by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        With a panel for each input or response.

    Raises
    ------
    TypeError, KeyError, ValueError
        If it is no such table, or an argument is not as described.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> rng = np.random.default_rng(1)
    >>> data = {name: rng.normal(mean, 0.3, 12) for name, mean in [("A", 1), ("B", 2)]}
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 1.5, 1), pm.HalfNormal("sigma", 1))
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, observed=data["A"])
    >>> fleet = prb.calibrate_each(data, model=model, progressbar=False)
    >>> figure = prb.plots.plot_products(prb.population(fleet, model=model))
    >>> [text.get_text() for text in figure.axes[0].get_yticklabels()]
    ['A', 'B']
    """
    check_options(labels, pc_kwargs)
    table = _by_quantity(subset(_table_of_fleet(table), coords))
    names = select_variables(table["name"].values.tolist(), var_names, filter_vars)
    products = [str(name) for name in table["product"].values]
    refuse_labels(labels, [*names, *products])
    quantities = table["quantity"].values.tolist()
    by = plain_text("B-basis" if "B-basis" in quantities else quantities[0], "sort")
    by = by if sort is None else plain_text(sort, "sort")
    if by not in quantities:
        raise ValueError(f"sort: got {sort!r}, expected one of {quantities}")
    sign = -1 if table.attrs.get("bounds") == "upper" or "limit" in table.attrs else 1
    keys = table["estimate"].sel(quantity=by, name=names[0]).values
    order = np.argsort(np.where(np.isnan(keys), np.inf, sign * keys), kind="stable")
    verdicts = np.asarray(table["validity"].values)[order]
    texts = [named(products[row], labels) for row in order]
    figure, axes = panels(names, size=(5.2, _height_of(len(order))), pc_kwargs=pc_kwargs)
    for name, axis in axes.items():
        panel = table.sel(name=name).isel(product=order)
        _draw_products(axis, panel, quantities[0], verdicts)
        if "B-basis" in quantities and quantities[0] != "B-basis":
            values = panel["estimate"].sel(quantity="B-basis").values
            axis.scatter(
                values,
                _row_heights(values),
                30,
                color=ink(),
                marker="|",
                label="B-basis",
                gid="basis",
            )
        _label_products(axis, texts, verdicts)
        unit = str(panel["unit"].values) if "unit" in panel.coords else ""
        interval = f"{percentage(table.attrs['prob'])} interval"
        axis.set_xlabel(f"{with_label(name, unit, labels or {})}\n{quantities[0]}, {interval}")
        axis.set_xticks(*round_ticks(*axis.get_xlim()))
        axis.grid(visible=True, axis="x", color=PALE, alpha=0.3, linewidth=0.6)
    return finish(figure)


def plot_tests(tests: Mapping[str, ValidityTest], pc_kwargs: Mapping[str, Any]) -> Figure:
    """Draw the u-values of each test in a row, the smallest p-value on top."""
    order = sorted(tests, key=lambda name: tests[name].p_value)
    verdicts = np.array(["rejected" if tests[name].rejected else "not rejected" for name in order])
    figure, axes = panels(["u"], size=(5.6, _height_of(len(order))), pc_kwargs=pc_kwargs)
    axis = axes["u"]
    rows = _row_heights(order)
    for verdict, color in _COLORS.items():
        of_verdict = [k for k in range(len(order)) if verdicts[k] == verdict]
        if of_verdict:
            values = [tests[order[k]].u_values for k in of_verdict]
            heights = np.repeat(rows[of_verdict], [u.size for u in values])
            axis.scatter(
                np.concatenate(values), heights, 12, color=color, alpha=0.7, label=verdict, gid="u"
            )
    texts = [f"{name}, p = {tests[name].p_value:.2g}" for name in order]
    _label_products(axis, texts, verdicts)
    axis.set(xlabel="u-values of the specimens of the test", xlim=(-0.02, 1.02))
    return finish(figure)


def _table_of_fleet(table: Any) -> xr.Dataset:
    """Return the table of a fleet, or raise."""
    is_table = isinstance(table, xr.Dataset) and "product" in table.dims
    if not is_table or not {"estimate", "probability"} & set(table.data_vars):
        raise wrong_type(
            table, "plot_products", "the table of prb.population or prb.exceedance of a fleet"
        )
    checked: xr.Dataset = table
    return checked


def _by_quantity(table: xr.Dataset) -> xr.Dataset:
    """Return estimate, lower and upper end, with dims (name, product, quantity)."""
    if "validity" not in table.coords:
        verdicts = np.full(table.sizes["product"], "not tested")
        table = table.assign_coords(validity=("product", verdicts))
    if "estimate" in table:
        more = set(table["estimate"].dims) - {"name", "quantity", "product"}
        if more:
            raise ValueError(
                f"plot_products: got a table with {sorted(map(str, more))}, expected one of "
                "products alone; select a label of it"
            )
        return table
    probability = table["probability"]
    if "bound" in probability.dims:
        probability = probability.sel(bound="upper")
    sides = "below" if table.attrs["below"] else "above"
    name = f"P({table.attrs['response']} {sides} {table.attrs['limit']:g})"
    arrays = {"estimate": probability, "lower": table["lower"], "upper": table["upper"]}
    flat = xr.Dataset({k: x.drop_vars("bound", errors="ignore") for k, x in arrays.items()})
    flat = flat.expand_dims(name=[name], quantity=["probability"])
    return flat.assign_coords(validity=table["validity"]).assign_attrs(table.attrs)


def _height_of(n: int) -> float:
    """Return the height in inches of a panel with n rows."""
    return float(np.clip(1.4 + 0.19 * n, 2.2, 10.0))


def _row_heights(values: Sized) -> Floats:
    """Return the heights of rows; the first one is on top."""
    return np.arange(len(values) - 1.0, -1.0, -1.0)


def _draw_products(axis: Axes, panel: xr.Dataset, quantity: str, verdicts: Any) -> None:
    """Draw estimates and intervals, by verdict."""
    of_quantity = panel.sel(quantity=quantity)
    lower, upper, estimate = (of_quantity[key].values for key in ("lower", "upper", "estimate"))
    rows = _row_heights(estimate)
    width = 2.5 if len(rows) <= 45 else 1.0
    is_tested = bool((verdicts != "not tested").any())
    for verdict, color in _COLORS.items():
        mask = (verdicts == verdict) & np.isfinite(estimate)
        if mask.any():
            label = verdict if is_tested else None
            ends = rows[mask], lower[mask], upper[mask]
            axis.hlines(*ends, color=color, linewidth=width, gid="interval")
            axis.scatter(
                estimate[mask], rows[mask], 6 * width, color=color, label=label, gid=verdict
            )
    if "requirement" in panel.attrs and quantity == "probability":
        required = float(panel.attrs["requirement"])
        axis.axvline(required, color=PALE, linestyle="--", label="requirement", gid="requirement")


def _label_products(axis: Axes, texts: Sequence[str], verdicts: Any, most: int = 45) -> None:
    """Name the rows, or of many those that were rejected, as far as there is room."""
    rows = _row_heights(texts)
    shown: Indices = np.arange(len(texts))
    if len(texts) > most:
        shown = np.flatnonzero(verdicts == "rejected")
        room = len(texts) / most
        spaced: list[int] = []
        for row in shown.tolist():
            if not spaced or row - spaced[-1] >= room:
                spaced.append(row)
        shown = np.array(spaced, dtype=np.intp)
        axis.set_ylabel(f"{counted(len(texts), 'product')}, the worst on top")
    axis.set_yticks(rows[shown], [texts[row] for row in shown])
    axis.set_ylim(-0.7, len(texts) - 0.3)
