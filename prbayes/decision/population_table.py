"""Population tables: moments, quantiles and tolerance bounds of inputs and responses, in units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any, Self

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._display import Table, View, percentage
from prbayes._finding import Findings, as_json, report, sentences_of
from prbayes._stats import INTERVAL, tail_levels
from prbayes._validate import Arrays, Floats, StrPath, called, flag, positive_integer, share
from prbayes.decision.population_quantities import Element, PopulationReader
from prbayes.decision.populations import NestedPopulations, Populations, quantiles_of
from prbayes.model.locking import locked
from prbayes.model.parameters import element_name, variable_of
from prbayes.optimize.optimum import Optimum
from prbayes.response.inputs import Groups
from prbayes.response.outputs import with_unit
from prbayes.results.predict import call_settings, width_of_epsilon
from prbayes.results.products import ProductResults, each_product, joined_table

_CALLER = "prb.population"
_VARIABLES = ("estimate", "lower", "upper")
# Shares of specimens beyond tolerance bounds of 95 % confidence (MMPDS, CMH-17)
BASES = {"B-basis": 0.10, "A-basis": 0.01}


@locked
@each_product
def population(
    result: Optimum | xr.DataTree,
    inputs: Any = None,
    *,
    model: pm.Model | None = None,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    prob: float = INTERVAL,
    upper: bool = False,
    at: Mapping[str, float] | None = None,
    n_draws: int = 4000,
    executor: Executor | None = None,
    store: StrPath | None = None,
    version: str | None = None,
) -> PopulationTable:
    r"""Return mean, spread, quantiles and tolerance bounds of inputs and responses, in units.

    The intervals are those of a quantity of the population: of its posterior, or of the sampling
    distribution of an optimum. An A-basis (B-basis) value is a tolerance bound: 99 % (90 %) of all
    specimens exceed it, with 95 % confidence.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group, from any sampler, or from `calibrate_each`.
    inputs : str, TensorVariable, Condition, xarray.DataArray, or a sequence of such, optional
        The name of an input, which is that of the ``.dist()`` or of the response's argument, of an
        element such as ``"x[0]"``, or a ``.dist()``; all inputs by default. A response is a
        `prbayes.decision.Condition`, or the result of `predict` for a posterior.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    quantiles : sequence of float
        Probabilities between 0 and 1.
    prob : float
        Probability of the intervals, which have equal tails.
    upper : bool
        Whether tolerance bounds are upper ones, which the specimens do not exceed.
    at : mapping, optional
        The value of each covariate, by the name of its `prbayes.response.condition`, where inputs
        depend on one.
    n_draws : int
        Largest number of populations, over all chains; the posterior's draws are thinned evenly.
    executor : concurrent.futures.Executor, optional
        Where the response is computed.
    store : path-like, optional
        A folder that keeps every computed response, by its name.
    version : str, optional
        Of the response, for the store; as for `Reweighted`.

    Returns
    -------
    xarray.Dataset
        Dims (name, quantity); with groups (name, group, quantity), with the name of their
        dimension. Variables ``estimate`` (at the optimum, or the posterior mean), ``lower`` and
        ``upper``; a coordinate ``unit`` by name. Quantities are the mean, ``sd``, ``cv`` (sd over
        absolute mean, without unit), quantiles, tolerance bounds, and the correlations of elements
        of a vector. Tolerance bounds are estimates without an interval. Of a fleet it has the
        dimension product, with the coordinates ``validity`` and ``finding``. Moments that do not
        exist, as of a Cauchy distribution or of responses with failures (+inf), are NaN. It prints
        as sentences; a notebook shows a table.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or the result is another model's, or an optimum without
        standard errors.
    DesignError
        If stored responses do not support the populations of a `Condition`.

    Notes
    -----
    Let :math:`q_p(\theta)` be the p-quantile of the population :math:`\theta`. The B-basis value is
    the 5 % quantile of :math:`q_{.1}(\theta)`, and the A-basis value that of
    :math:`q_{.01}(\theta)`, over the draws [1]_. For a normal population and the reference prior it
    is the classical bound :math:`\bar y - k s`, with the factor k of the noncentral t distribution.
    An optimum's bounds have the confidence only for many specimens; take the posterior.

    Margins come from inverse distribution functions, or from random draws where there is none.

    If the data do not separate a population of ``prbayes.families`` from a simpler one, rows such
    as ``"x (normal)"`` have the answer under the latter.

    References
    ----------
    .. [1] Krishnamoorthy, K. and T. Mathew (2009), Statistical Tolerance Regions, Wiley,
       doi:10.1002/9780470473900, chapter 11.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     k = pm.Normal.dist(pm.Normal("mu", 3, 2), pm.HalfNormal("sigma", 1))
    ...     y = prb.Simulator(
    ...         "y", lambda k: 2 * k, k, metric=prb.AreaMetric(), units={"k": "kN/mm"},
    ...         observed=[5.0, 5.5, 6.0, 6.2, 6.4, 7.0, 7.5, 8.1],
    ...     )
    >>> table = prb.population(prb.minimize(model), "k")
    >>> float(table.estimate.sel(name="k", quantity="mean").round(1)), str(table.unit.values[0])
    (3.2, 'kN/mm')
    """
    prob = share(prob, f"{_CALLER}: prob")
    upper = flag(upper, f"{_CALLER}: upper")
    positive_integer(n_draws, f"{_CALLER}: n_draws", minimum=2)
    probabilities = [share(p, f"{_CALLER}: quantiles") for p in np.atleast_1d(quantiles).tolist()]
    levels = {f"{100 * p:g}% quantile": p for p in probabilities}
    populations = Populations.of(
        result, model, n_draws, _CALLER, call_settings(executor, store, version)
    )
    bases = {name: 1 - p if upper else p for name, p in BASES.items()}
    reader = PopulationReader(populations, levels | bases, _covariates(populations, at))
    elements = reader.elements(inputs)
    nested, findings = NestedPopulations.of(populations)
    if nested is not None:
        elements += _under_nested_family(reader, nested, inputs)
    names = list(dict.fromkeys(name for x in elements for name in x.numbers))
    groups = {_dimension(x.groups): list(x.groups.labels) for x in elements if x.groups is not None}
    if len(groups) > 1:
        raise ValueError(
            f"{_CALLER}: inputs: got populations of the groups {list(groups)}, expected those of "
            "one partition; ask for one input at a time"
        )
    n_groups = max(map(len, groups.values()), default=1)
    # (3, elements, groups, quantities): estimates, lower and upper ends
    table = np.full((3, len(elements), n_groups, len(names)), np.nan)
    for i, x in enumerate(elements):
        for name, values in x.numbers.items():
            bound = (0.95 if upper else 0.05) if name in bases else None
            table[:, i, :, names.index(name)] = _numbers(values, populations, prob, bound)
    if nested is not None:
        findings = _difference(nested, elements, table[0, :, 0, names.index("A-basis")])
    width = width_of_epsilon(result, populations.evaluator.model)
    if not groups:
        table = table[:, :, 0]
    dims = ["name", *groups, "quantity"]
    return PopulationTable(
        {key: (dims, numbers) for key, numbers in zip(_VARIABLES, table, strict=True)},
        coords={
            "name": [x.name for x in elements],
            **groups,
            "quantity": names,
            "unit": ("name", [x.unit for x in elements]),
        },
        attrs={
            "prob": prob,
            "interval": "posterior" if populations.are_draws else "standard error",
            "bounds": "upper" if upper else "lower",
            "findings": as_json(
                (*findings, *report(*width), *(f for x in elements for f in x.findings))
            ),
            **populations.provenance(),
        },
    )


def _dimension(groups: Groups) -> str:
    """Return the dimension of groups, which differs from the table's other coordinates."""
    is_taken = groups.dim in ("name", "quantity", "unit")
    return f"{groups.dim}_group" if is_taken else groups.dim


def _numbers(values: Floats, populations: Populations, prob: float, bound: float | None) -> Arrays:
    """Return estimate, lower and upper end, (groups,) each, of values, (groups, k).

    A tolerance bound, the quantile over populations at ``bound``, has no ends.
    """
    draws = values if populations.are_draws else values[..., 1:]
    if bound is not None:
        (estimate,) = _quantiles(draws, [bound])
        return [estimate, *np.full((2, len(draws)), np.nan)]
    estimate = _means(draws) if populations.are_draws else values[:, 0]
    return [estimate, *_quantiles(draws, tail_levels(prob))]


def _under_nested_family(
    reader: PopulationReader, nested: NestedPopulations, inputs: Any
) -> list[Element]:
    """Return the requested elements whose populations a nested family changes, under this family.

    The draws of a prediction are those of the model's own family.
    """
    several = inputs if isinstance(inputs, list | tuple) else [inputs]
    inputs = [x for x in several if not isinstance(x, xr.DataArray)]
    if not inputs:
        return []
    elements = replace(reader, populations=nested.populations).elements(
        None if inputs == [None] else inputs
    )
    return [
        replace(x, name=nested.label(x.name))
        for x in elements
        if variable_of(x.name) not in nested.family.unchanged
    ]


def _difference(
    nested: NestedPopulations, elements: Sequence[Element], a_basis: Floats
) -> Findings:
    """Report the A-basis values of elements, (elements,), under both families."""
    by_name = dict(zip([x.name for x in elements], a_basis.tolist(), strict=True))
    answers = [
        f"the A-basis value of {name} is {value:.4g}, or {by_name[nested.label(name)]:.4g} under "
        f"the {nested.name} family"
        for name, value in by_name.items()
        if nested.label(name) in by_name
    ]
    return report(nested.finding("; ".join(answers)))


def _covariates(populations: Populations, at: Any) -> Mapping[str, float]:
    """Return the values of covariates, or raise if the model has no such covariate."""
    simulators = populations.evaluator.simulators
    covariates = {str(v.name) for node in simulators for v in node.inputs.covariates}
    if at is not None and not (isinstance(at, Mapping) and set(at) <= covariates):
        raise ValueError(
            f"{_CALLER}: at: got {called(at)}, expected values of covariates of the model, some of "
            f"{sorted(covariates)}"
        )
    return at or {}


def _means(draws: Floats) -> Floats:
    """Return means over populations, (groups, k) -> (groups,), without infinite draws."""
    return np.array([_defined(row, ~np.isfinite(row)).mean() for row in draws])


def _quantiles(draws: Floats, probabilities: Sequence[float]) -> Floats:
    """Return quantiles over populations, (groups, k) -> (p, groups); a draw may be infinite."""
    return np.array([quantiles_of(_defined(row, np.isnan(row)), probabilities) for row in draws]).T


def _defined(row: Floats, is_left_out: Any) -> Floats:
    """Return the numbers that are not left out, or NaN if most are."""
    numbers = row[~is_left_out]
    return numbers if numbers.size > 0.5 * row.size else np.array([np.nan])


class PopulationTable(Table):
    """A dataset that prints as sentences, and that notebooks show as a table."""

    __slots__ = ()
    _parts = (*_VARIABLES, "name", "quantity", "prob")
    _columns = _VARIABLES

    def to_dataframe(self, dim_order: Sequence[Any] | None = None) -> Any:
        """Return the table as a data frame with the unit of each quantity."""
        table = super().to_dataframe(dim_order)
        flat = table.reset_index()
        if {"unit", "quantity"} <= set(flat):
            is_pure = flat["quantity"].astype(str).str.match("cv$|correlation with ").to_numpy()
            table.loc[is_pure, "unit"] = ""
        return table

    @classmethod
    def of_products(cls, parts: ProductResults[Self]) -> Self:
        """Return the tables of products as one with the dimension ``product``."""
        table = joined_table(parts)
        return cls(table.data_vars, coords=table.coords, attrs=table.attrs)

    def rows(self) -> Iterator[tuple[str, str, dict[str, tuple[str, str]]]]:
        """Yield name, unit, and texts of estimate and interval by quantity, of each population."""
        more = [str(dim) for dim in self["estimate"].dims if dim not in ("name", "quantity")]
        names, quantities = (self[dim].values.tolist() for dim in ("name", "quantity"))
        units = self["unit"].values.tolist() if "unit" in self.coords else [""] * len(names)
        by_name = [self[key].transpose("name", *more, "quantity").values for key in _VARIABLES]
        numbers = np.stack(by_name, axis=-1)  # (names, ..., quantities, 3)
        labels = [self[dim].values.tolist() for dim in more]
        for index in np.ndindex(numbers.shape[:-2]):
            cells = {}
            for quantity, values in zip(quantities, numbers[index].tolist(), strict=True):
                if np.isfinite(values[0]):
                    cells[quantity] = _texts(values, 100.0 if quantity == "cv" else 1.0)
            of_population = [texts[i] for texts, i in zip(labels, index[1:], strict=True)]
            yield element_name(names[index[0]], of_population), units[index[0]], cells

    def sentences(self) -> list[str]:
        """Return a sentence for each population."""
        sentences = []
        for name, unit, cells in self.rows():
            parts = []
            for quantity, (estimate, interval) in cells.items():
                text = f"{quantity} {estimate}"
                if quantity == "cv":
                    text += "%"
                if interval:
                    text += f" ({interval})"
                if quantity == "mean" and unit:
                    text += f" {unit}"
                parts.append(text)
            sentences.append(f"{name}: {', '.join(parts)}.")
        return sentences

    def _heading(self) -> str:
        kind, prob = self.attrs.get("interval", ""), self.attrs.get("prob", np.nan)
        bounds = self.attrs.get("bounds", "")
        return (
            f"Population, with {percentage(prob)} intervals by the {kind}; A- and B-basis values "
            f"are {bounds} bounds for 99% and 90% of the specimens with 95% confidence"
        )

    def __repr__(self) -> str:
        """Return a sentence for each population, or xarray's text for a selection."""
        if not self._is_whole or "product" in self.dims:
            return super().__repr__()
        return "\n  ".join([f"{self._heading()}:", *self.sentences(), *sentences_of(self.attrs)])

    def to_view(self) -> View:
        """Return what a reader sees."""
        quantities = self["quantity"].values.tolist()
        rows = []
        for name, unit, cells in self.rows():
            texts = [cells.get(quantity, ("", "")) for quantity in quantities]
            shown = [f"{value} ({interval})" if interval else value for value, interval in texts]
            rows.append([with_unit(name, unit), *shown])
        header = ["", *(q if q != "cv" else "cv (%)" for q in quantities)]
        if "validity" in self.coords and (self["validity"] != "not tested").any():
            more = [dim for dim in self["estimate"].dims if dim not in ("name", "quantity")]
            verdicts, _ = xr.broadcast(self["validity"], self["estimate"].isel(quantity=0))
            column = verdicts.transpose("name", *more).values.ravel().tolist()
            header.append("validity")
            rows = [[*row, verdict] for row, verdict in zip(rows, column, strict=True)]
        sentences = sentences_of(self.attrs)
        return View(self._heading(), header, rows, sentences)


def _texts(values: Sequence[float], factor: float) -> tuple[str, str]:
    """Return an estimate and its interval, with two digits of the half width of the interval."""
    estimate, low, high = (factor * value for value in values)
    width = (high - low) / 2
    if not (np.isfinite(width) and width > 1e-9 * max(abs(low), abs(high))):
        return f"{estimate:.4g}", ""
    decimals = 1 - int(np.floor(np.log10(width)))
    if not 0 <= decimals <= 6:
        return f"{estimate:.4g}", f"{low:.4g}, {high:.4g}"
    return f"{estimate:.{decimals}f}", f"{low:.{decimals}f}, {high:.{decimals}f}"
