"""Fleets: a function of one result for each product, and a product with its own data."""

from __future__ import annotations

import json
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, Protocol, Self

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr
from pymc.model.fgraph import clone_model
from scipy.special import ndtri

from prbayes._finding import Finding, Findings, as_json, counted, from_json, report, unreported
from prbayes._progress import progress, shown
from prbayes._validate import Floats, NamedArrays
from prbayes.metrics.summary import Summary
from prbayes.model.data_sheet import model_with_sheet
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import Level
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.optimize.optimum import require_of_model
from prbayes.response.inputs import model_on_context
from prbayes.specimens.coordinates import Coordinates

# Groups of ArviZ whose variables all have the dimensions chain and draw.
_BY_DRAW = {"posterior", "posterior_predictive", "sample_stats", "log_likelihood"}


class OfProducts(Protocol):
    """A result that many products may have together."""

    @classmethod
    def of_products(cls, parts: ProductResults[Self]) -> Self:
        """Return the results of products as one."""


@dataclass(frozen=True, eq=False)
class ProductResults[T]:
    """Results of a function for the products of a fleet."""

    names: Sequence[str]  # names of all products
    results: Mapping[str, T]  # by product; some may have none
    failures: Mapping[str, str]  # reasons why products have no result
    validity: Sequence[str]  # verdict of the validity test of each product
    calibration: Mapping[str, Findings]  # findings of the calibration by product

    @property
    def first(self) -> T:
        """The result of the first product that has one."""
        return next(iter(self.results.values()))

    def findings(self, findings_of: Callable[[T], Sequence[Finding]]) -> dict[str, Findings]:
        """Return the findings of each product, with the reasons of failures."""
        page = "fleets.md#products-that-fail"
        result = {}
        for name in self.names:
            if name in self.results:
                result[name] = tuple(findings_of(self.results[name]))
            else:
                result[name] = (Finding("failed-products", self.failures[name], page),)
        return result


def each_product[**P, T: OfProducts](function: Callable[P, T]) -> Callable[P, T]:
    """Let a function of a result take a fleet: it is called for each product.

    A product for which it raises a ValueError or RuntimeError has no result, unless all raise.
    """

    @wraps(function)
    def mapped(*arguments: P.args, **keywords: P.kwargs) -> T:
        fleet: Any = arguments[0] if arguments else keywords.get("result")
        if not is_fleet(fleet):
            return function(*arguments, **keywords)
        call: Any = function
        caller = f"prb.{function.__name__}"
        further = {key: value for key, value in keywords.items() if key != "result"}
        _refuse_predictions(caller, [*arguments[1:], *further.values()])
        model = model_on_context(further.get("model"), caller)
        require_of_model(fleet, model, caller, Level.POPULATIONS)
        evaluator_of_products(fleet, model)  # Products share their runs.
        parts: ProductResults[T] = _results_of(
            fleet, lambda product: call(product, *arguments[1:], **further), caller
        )
        return type(parts.first).of_products(parts)

    return mapped


def _results_of(fleet: Any, call: Callable[[Any], Any], caller: str) -> ProductResults[Any]:
    """Return the results of a function for the products of a fleet; raise if there is none."""
    names, sheets = product_names(fleet), data_sheets(fleet)
    results: dict[str, Any] = {}
    errors: dict[str, Exception] = {}
    failures = failed_products(fleet)
    with progress("products", len(names)) as advance:
        for name in names:
            advance(1, "")
            if name in failures:
                continue
            try:
                with unreported(), shown(False):
                    results[name] = call(fleet.sel(product=name))
            except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
                errors[name] = error
            except TypeError as error:  # The argument is wrong, or specimens are needed.
                if name not in sheets:
                    raise
                errors[name] = error
    if not results and errors:
        raise next(iter(errors.values()))
    if not results:
        raise ValueError(
            f"{caller}: got a fleet whose {len(names)} products all failed, expected some with a "
            "posterior; the column finding of fleet['products'] has the reasons"
        )
    failures |= {name: str(error) for name, error in errors.items()}
    findings = findings_of_calibration(fleet)
    return ProductResults(names, results, failures, validity_verdicts(fleet), findings)


def _refuse_predictions(caller: str, arguments: Sequence[Any]) -> None:
    """Raise if an argument is a prediction, which is that of one product."""
    for argument in arguments:
        several = argument if isinstance(argument, list | tuple) else [argument]
        if any(isinstance(x, xr.DataArray) for x in several):
            raise TypeError(
                f"{caller}: got a fleet and a prediction, expected prb.decision.Condition(response,"
                " *inputs) in its place: a prediction is that of one product"
            )


def joined_table(parts: ProductResults[Any], by_product: Sequence[str] = ()) -> xr.Dataset:
    """Return tables with the dimension ``product``; rows of products without a result are NaN.

    Coordinates of the products are ``validity``, the verdict of the validity test, ``finding``,
    and attributes whose names are in ``by_product``.
    """
    plain = [xr.Dataset(t.variables).set_coords(list(t.coords)) for t in parts.results.values()]
    table = xr.concat(
        plain,
        xr.DataArray(list(parts.results), dims="product", name="product"),
        data_vars="all",
        coords="minimal",
        compat="override",
        join="outer",
    )
    table = table.reindex(product=list(parts.names))
    findings = parts.findings(lambda part: from_json(part.attrs.get("findings", "[]")))
    for name in parts.results:
        findings[name] = (*parts.calibration.get(name, ()), *findings[name])
    texts = [" ".join(map(str, of_product)) for of_product in findings.values()]
    coords: dict[str, Any] = {"validity": parts.validity, "finding": texts}
    attrs = dict(parts.first.attrs)
    for key in set(by_product) & set(attrs):
        empty = "" if isinstance(attrs.pop(key), str) else np.nan
        values = {name: part.attrs[key] for name, part in parts.results.items()}
        if isinstance(parts.first.attrs[key], list):  # points of intervals, for each bound
            empty = ""
            values = {name: " to ".join(map(str, texts)) for name, texts in values.items()}
        coords[key] = [values.get(name, empty) for name in parts.names]
    together = report(*findings_together(findings))
    return table.assign_coords(
        {key: ("product", values) for key, values in coords.items()}
    ).assign_attrs(attrs | {"findings": as_json(together)})


def findings_together(findings: Mapping[str, Sequence[Finding]], most: int = 3) -> Findings:
    """Return findings with the names of their products; one for each code that many have."""
    by_code: dict[str, list[tuple[str, Finding]]] = {}
    for name, of_product in findings.items():
        for finding in dict.fromkeys(of_product):
            by_code.setdefault(finding.code, []).append((name, finding))
    result = []
    for pairs in by_code.values():
        names = list(dict.fromkeys(name for name, _ in pairs))
        if len(names) <= most:
            result += [replace(f, text=f"{name}: {f.text}") for name, f in pairs]
            continue
        shown_names = ", ".join(names[:most])
        _, first = pairs[0]
        text = (
            f"{shown_names} and {counted(len(names) - most, 'other product')}; for {names[0]}: "
            f"{first.text}"
        )
        result.append(replace(first, text=text))
    return tuple(result)


def is_fleet(result: Any) -> bool:
    """Return whether a result has posteriors of products."""
    return bool(product_names(result)) and "product" in result["posterior"].dims


def findings_of_calibration(result: Any) -> dict[str, Findings]:
    """Return the findings of the products of a fleet, or of one, that have a posterior."""
    page = "fleets.md#products-that-fail"
    texts = texts_by_product(result, "finding")
    return {name: (Finding("product-finding", text, page),) for name, text in texts.items()}


def texts_by_product(result: Any, key: str) -> dict[str, str]:
    """Return the texts of products that have one, such as findings of a calibration."""
    if not product_names(result) or key not in result["products"]:
        return {}
    texts = np.atleast_1d(result["products"][key].values).tolist()
    pairs = zip(product_names(result), texts, strict=True)
    return {name: text for name, text in pairs if text}


def failed_products(fleet: Any) -> dict[str, str]:
    """Return the reasons why products of a fleet have no draws."""
    first = next(iter(fleet["posterior"].data_vars.values()))
    of_draws = [dim for dim in first.dims if dim != "product"]
    is_missing = np.atleast_1d(first.isnull().all(of_draws).values)
    reasons = np.atleast_1d(fleet["products"]["finding"].values).tolist()
    rows = zip(product_names(fleet), reasons, is_missing, strict=True)
    return {
        name: str(reason).removeprefix(f"{name}: ") for name, reason, is_failed in rows if is_failed
    }


def validity_verdicts(fleet: Any) -> list[str]:
    """Return the verdict of the validity test of each product."""
    products, failures = fleet["products"], failed_products(fleet)
    tested = np.full(len(product_names(fleet)), "not tested", dtype=object)
    if "rejected" in products:
        p_values = np.atleast_1d(products["p_value"].values)
        is_rejected = np.atleast_1d(products["rejected"].values)
        verdicts = np.where(is_rejected, "rejected", "not rejected")
        tested = np.where(np.isnan(p_values), tested, verdicts)
    pairs = zip(product_names(fleet), tested.tolist(), strict=True)
    return ["failed" if name in failures else str(verdict) for name, verdict in pairs]


def one_posterior(result: Any, caller: str) -> Any:
    """Return a result whose posterior has the dimensions chain and draw; raise for a fleet.

    Of a product, the data that are padded to the largest number of specimens lose these rows.
    """
    if is_fleet(result):
        first, *more = product_names(result)
        raise ValueError(
            f"{caller}: got posteriors of {len(more) + 1} products, expected one; pass "
            f"fleet.sel(product={first!r}), and for all products call this for each name of "
            "fleet['products']['product'].values"
        )
    result = with_chains(result)
    if isinstance(result, xr.DataTree) and "posterior" in result.children:
        lacking = {"chain", "draw"} - set(result["posterior"].dims)
        if lacking:
            raise ValueError(
                f"{caller}: got a posterior without the dimensions {sorted(lacking)}, expected "
                "draws, as of prb.sample; pass the result itself, not means of its draws"
            )
    if product_names(result) and "observed_data" in result.children:
        data = result["observed_data"].to_dataset()
        for dim in data.dims:
            data = data.dropna(dim, how="all")
        result = result.copy()
        result["observed_data"] = xr.DataTree(data)
    return result


def with_chains(result: Any) -> Any:
    """Restore the dimensions chain and draw, which a selection of one of them has lost."""
    if not isinstance(result, xr.DataTree) or "posterior" not in result.children:
        return result
    posterior = result["posterior"]
    lost = [
        dim for dim in ("chain", "draw") if dim in posterior.coords and dim not in posterior.dims
    ]
    if "draw" in posterior.dims and not {"chain"} & {*posterior.coords, *posterior.dims}:
        lost.append("chain")
    if not lost:
        return result
    groups = {name: node.to_dataset() for name, node in result.children.items()}
    for name in _BY_DRAW & set(groups):
        present = [dim for dim in lost if name == "posterior" or dim in groups[name].coords]
        groups[name] = groups[name].expand_dims(present)
    return type(result).from_dict(groups)


def product_names(result: Any) -> list[str]:
    """Return the names of the products of a fleet, or of one of them; none for other results."""
    is_of_fleet = isinstance(result, xr.DataTree) and "products" in result.children
    return list(map(str, np.ravel(result["products"]["product"]))) if is_of_fleet else []


def model_of_product(result: Any, model: pm.Model) -> pm.Model:
    """Return the model with the data of a product; the model itself for other results."""
    if not product_names(result) or "observed_data" not in result.children:
        return model
    sheets = data_sheets(result)
    if sheets:
        ((name, sheet),) = sheets.items()
        emulated = evaluator_of_products(result, model).emulated
        if emulated:
            return model_with_sheet(model, emulated[0], sheet)
        raise ValueError(
            f"{name}: got a product with a data sheet and a metric of distributions, expected the "
            "log-likelihood by specimen; or a model with observed=prb.Summary(...)"
        )
    data = {str(name): x.values for name, x in result["observed_data"].data_vars.items()}
    return _observing(model, data)


def _observing(model: pm.Model, data: Mapping[str, Any]) -> pm.Model:
    """Return a copy of a model with other observed values."""
    copy = clone_model(model)
    for name, values in data.items():
        variable = copy[name]
        observed = pt.constant(np.asarray(values, dtype=np.float64))
        del copy.values_to_rvs[copy.rvs_to_values[variable]]
        copy.rvs_to_values[variable] = observed
        copy.values_to_rvs[observed] = variable
    return copy


# Data sheets.


def data_sheets(result: Any) -> dict[str, Summary]:
    """Return the data sheets of products that have one in place of specimens."""
    texts = texts_by_product(result, "data_sheet")
    return {name: summary_from(text) for name, text in texts.items()}


def summary_as_text(summary: Summary) -> str:
    """Return the statistics of a data sheet as JSON."""
    return json.dumps({name: x for name, x in vars(summary).items() if x is not None})


def summary_from(text: str) -> Summary:
    """Return a data sheet from `summary_as_text`."""
    statistics = json.loads(text)
    quantiles = statistics.get("quantiles")
    if quantiles is not None:
        statistics["quantiles"] = {float(level): value for level, value in quantiles.items()}
    return Summary(**statistics)


def representative_specimens(summary: Summary, most: int = 32) -> Floats:
    """Return specimens that a data sheet may have, which show where runs are needed."""
    n = min(summary.n, most)
    # A mean alone has no spread; the value only shows where runs are needed.
    unit = summary.unit or 0.05 * abs(summary.center) or 1.0
    normal = summary.center + unit * ndtri((np.arange(n) + 0.5) / n)
    return np.concatenate([normal, summary.order_statistics[:, 1]])


# Runs that products share.


@dataclass(frozen=True, eq=False)
class SharedRuns:
    """A model whose emulator is accurate at the specimens of several products."""

    observed: NamedArrays  # measured responses by product
    evaluator: Evaluator

    @classmethod
    def of(cls, model: pm.Model, observed: NamedArrays) -> SharedRuns:
        """Return the shared runs of products; they are computed at their first use."""
        (likelihood,) = dict.fromkeys(specimen_likelihoods(model).values())
        (measurement,) = likelihood.measurements
        copy = _observing(model, {measurement.name: np.concatenate(list(observed.values()))})
        application = copy[measurement.name].owner
        common = _common_likelihood(likelihood, list(observed.values()))
        vars(common).update(model=weakref.ref(copy))
        application.op.assign(application, common)
        return cls(observed, Evaluator.of(copy))

    def serve(self, observed: NamedArrays) -> bool:
        """Return whether the runs are those of these products, with the same data."""
        return all(
            name in self.observed and np.array_equal(values, self.observed[name], equal_nan=True)
            for name, values in observed.items()
        )


def shared_runs(model: pm.Model, observed: NamedArrays) -> SharedRuns:
    """Return the runs that products share, those of the last call if it had these products."""
    (likelihood,) = dict.fromkeys(specimen_likelihoods(model).values())
    stored: SharedRuns | None = likelihood.cache.get("products")
    if stored is None or not stored.serve(observed):
        stored = likelihood.cache["products"] = SharedRuns.of(model, observed)
    return stored


def evaluator_of_products(result: Any, model: pm.Model) -> Evaluator:
    """Return an evaluator of a model whose emulator is accurate for the products of a result.

    It is that of the model for other results, and for metrics of distributions.
    """
    is_measured = product_names(result) and "observed_data" in result.children
    if not is_measured or len(set(specimen_likelihoods(model).values())) != 1:
        return Evaluator.of(model)
    (data,) = result["observed_data"].data_vars.values()
    data = data if "product" in data.dims else data.expand_dims("product")
    values = zip(product_names(result), data.transpose("product", ...).values, strict=True)
    observed = {}
    for name, y in values:
        is_missing = np.isnan(y).all(axis=tuple(range(1, y.ndim)))
        observed[name] = y[~is_missing]
    observed |= {name: representative_specimens(x) for name, x in data_sheets(result).items()}
    return shared_runs(model, observed).evaluator


def _common_likelihood(
    likelihood: SpecimenLikelihood, observed: Sequence[Floats]
) -> SpecimenLikelihood:
    """Return the likelihood of the specimens of all products.

    The limits of the errors of emulator and points are those for one product, which has fewer
    specimens and a narrower population.
    """
    (measurement,) = likelihood.measurements
    stacked = np.concatenate(observed)
    sizes = [len(values) for values in observed]
    within = np.median([np.nanstd(values, axis=0) for values in observed], axis=0)
    spread = np.nanstd(stacked, axis=0)
    has_spread = (within > 0) & (spread > 0)
    narrower = float(np.min((within / spread)[has_spread], initial=1.0))
    sampler = likelihood.density.sampler
    coordinates = Coordinates.of_prior(likelihood.inputs, max(sizes), sampler=sampler)
    fewer = np.sqrt(len(stacked) / np.median(sizes))
    options = replace(
        likelihood.options,
        bias=likelihood.options.bias * fewer * narrower,
        half_difference=likelihood.options.half_difference * fewer,
    )
    result = likelihood.observing({measurement.name: stacked})
    result = replace(result, options=options, shared_emulation=None)
    vars(result).update(density=likelihood.density, coordinates=coordinates)
    return result
