"""Calibration of many products that share one model and its runs, each with a validity test."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Self

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import ArrayLike

from prbayes._display import Tree, View
from prbayes._finding import Finding, counted, from_json, report
from prbayes._progress import progress, shown
from prbayes._stats import reached
from prbayes._validate import (
    Floats,
    Indices,
    NamedArrays,
    Seed,
    Shape,
    called,
    executes,
    flag,
    positive_integer,
    real_array,
    seed_number,
    share,
)
from prbayes.inference.checks.population import refuse_lost_specimens
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.summary import Summary
from prbayes.metrics.summary_likelihood import SummaryLikelihood
from prbayes.model.data_sheet import model_with_sheet
from prbayes.model.description import labelled, versions
from prbayes.model.emulated import EmulatedSimulator
from prbayes.model.evaluator import Evaluator, with_data, with_unchanged_runs
from prbayes.model.fingerprint import as_attributes, identity_from_attributes, identity_of
from prbayes.model.locking import locked
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.parameters import element_name
from prbayes.model.random_variable import shared_epsilon
from prbayes.model.specimen_audit import audited_likelihood
from prbayes.model.specimen_likelihood import draw_readings
from prbayes.model.specimen_preparation import prepared
from prbayes.posterior.batch import ProductPosteriors
from prbayes.posterior.sample import draw_posterior, importance_chains, mode_findings
from prbayes.posterior.smc import SamplingSettings
from prbayes.posterior.target import modes_of, specimen_target
from prbayes.propagation.base import DesignError
from prbayes.propagation.reweighted import designs_restored
from prbayes.response.inputs import model_on_context
from prbayes.response.outputs import Outputs
from prbayes.results.products import (
    product_names,
    representative_specimens,
    shared_runs,
    summary_as_text,
)
from prbayes.validation.area_test import ValidityTest, area_test
from prbayes.validation.nulls import PosteriorNull


@locked
def calibrate_each(
    data_sets: Mapping[str, ArrayLike | Summary],
    *,
    model: pm.Model | None = None,
    validation: Mapping[str, ArrayLike] | None = None,
    draws: int = 1000,
    alpha: float = 0.05,
    executor: Executor | None = None,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> Products:
    """Calibrate many products with one model, one set of runs and one compilation.

    Each product has a population and a posterior of its own. The runs, the emulator and the points
    of the log-likelihood by specimen serve all products: they are computed once, for the specimens
    of all of them. A product that fails leaves the others as they are.

    Parameters
    ----------
    data_sets : mapping of array_like, shape (N,) or (N, m), or of Summary
        Measured responses of each product by its name, in the form of ``observed`` of the
        simulator; products may have different numbers of specimens. A data sheet is a `Summary`.
    model : pymc.Model, optional
        A model with one `Simulator`, by default that on the context. Its own observed values matter
        by their form only.
    validation : mapping of array_like, optional
        Measured responses of further specimens of some products, for `area_test`.
    draws : int
        Draws of each posterior.
    alpha : float
        Significance level of the tests.
    executor : concurrent.futures.Executor, optional
        Where products are calibrated, 100 at a time; the model is sent with cloudpickle. The result
        does not depend on it.
    random_seed : int, sequence of int, numpy.random.Generator or None
    progressbar : bool

    Returns
    -------
    xarray.DataTree
        Group ``posterior``: the hyperparameters with dims (chain, draw, product), for
        ArviZ's summary or forest plot; NaN for products that failed. Group ``observed_data``: the
        data, with rows of NaN after the last specimen of a product. ``each.sel(product="A")`` has
        both of one product, for all functions that take a result. Group ``products``, by product:
        ``pareto_k`` of importance sampling (NaN for another sampler), ``finding`` (why it failed,
        which specimens no inputs reproduce, populations without a response, or modes of the
        posterior; else an empty text), ``data_sheet`` as JSON, and with ``validation`` the
        ``statistic``, ``critical_value``, ``p_value`` and ``rejected`` of its validity test. Of
        many valid products the share alpha is rejected. Group ``validity``: the u-values.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, or the model has groups, weights, labels or several
        simulators.
    DesignError, ResponseError
        If the response does not allow the calibration of any product.
    RuntimeError
        If more than half of the products fail.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> rng = np.random.default_rng(1)
    >>> data = {name: 2 * rng.normal(mean, 0.3, 12) for name, mean in [("A", 1), ("B", 2)]}
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 1.5, 1), pm.HalfNormal("sigma", 1))
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, observed=data["A"])
    >>> each = prb.calibrate_each(data, model=model, progressbar=False)
    >>> each["posterior"]["mu"].mean(("chain", "draw")).values.round(1)
    array([1.1, 2. ])
    """
    caller = "prb.calibrate_each"
    model = model_on_context(model, caller)
    positive_integer(draws, "draws", minimum=10)
    share(alpha, "alpha")
    executes(executor)
    flag(progressbar, "progressbar")
    seed = seed_number(random_seed)
    evaluator = with_unchanged_runs(Evaluator.of(model))
    simulator, *more = with_data(evaluator)
    if more:
        raise TypeError(
            f"{caller}: got a model with the simulators {simulator.name} and {more[0].name}, "
            "expected one; write a response with several outputs"
        )
    _refuse_specimens_of_the_model(caller, simulator)
    event = np.shape(simulator.observed)[1:]
    sheets = _read_sheets(caller, data_sets, simulator)
    observed = _read_data(data_sets, "data_sets", 2, event)
    further = {} if validation is None else _read_data(validation, "validation", 1, event)
    unknown = sorted(set(further) - set(observed))
    if unknown:
        raise KeyError(
            f"{caller}: validation: got {unknown[:5]}, expected products of data_sets, "
            f"{list(observed)[:5]}"
        )
    names = list(observed)
    settings = SamplingSettings(draws=draws, random_seed=seed)
    fleet = Fleet(evaluator, observed, further, settings, alpha, sheets)
    if evaluator.likelihoods:
        (likelihood,) = shared_runs(model, observed).evaluator.likelihoods
        (of_model,) = evaluator.likelihoods
        of_model.cache["emulation of a fleet"] = prepared(likelihood).emulation
        fleet = SpecimenFleet(**vars(fleet), likelihood=likelihood)
    rows = _calibrations(fleet, executor, progressbar)
    failures = [row.finding for row in rows if not row.values]
    if failures:
        text = (
            f"{len(failures)} of {len(names)} products failed; the column finding of the table has "
            f"the reasons; the first: {failures[0]}"
        )
        report(Finding("failed-products", text, "fleets.md#products-that-fail"))
    if len(failures) > len(names) / 2:
        raise RuntimeError(
            f"{caller}: {len(failures)} of {len(names)} products failed; {failures[0]}"
        )
    attrs = {"random_seed": str(seed), "alpha": alpha, **as_attributes(identity_of(model))}
    tree = _tree(evaluator, names, rows, draws, attrs)
    measured = {name: y[:0] if name in sheets else y for name, y in observed.items()}
    tree["observed_data"] = _padded(simulator.name, measured, simulator.outputs)
    if sheets:
        texts = [summary_as_text(sheets[name]) if name in sheets else "" for name in names]
        tree["products"]["data_sheet"] = xr.DataArray(texts, dims="product")
    return tree


def _calibrations(fleet: Fleet, executor: Executor | None, progressbar: bool) -> list[Calibration]:
    """Return the calibrations of all products, 100 at a time."""
    names = list(fleet.observed)
    jobs = [names[first : first + 100] for first in range(0, len(names), 100)]
    with shown(progressbar), progress("products", len(names)) as advance:
        if executor is None:
            parts = [fleet.calibrated(job, lambda: advance(1, "")) for job in jobs]
        else:
            import cloudpickle

            futures = [
                executor.submit(_calibrated, cloudpickle.dumps(fleet.part(job)), job)
                for job in jobs
            ]
            for future in as_completed(futures):
                advance(len(future.result()), "")
            parts = [future.result() for future in futures]
    return [row for part in parts for row in part]


def _padded(name: str, observed: Mapping[str, Floats], outputs: Outputs) -> xr.Dataset:
    """Return the data of all products, with rows of NaN after the last specimen of each."""
    size = max(map(len, observed.values()))
    arrays = [
        np.pad(y, [(0, size - len(y)), *[(0, 0)] * (y.ndim - 1)], constant_values=np.nan)
        for y in observed.values()
    ]
    dims = ("product", f"{name}_specimen", outputs.dim)[: 1 + arrays[0].ndim]
    coords: dict[str, Any] = {"product": list(observed)}
    if outputs.labels:
        coords[outputs.dim] = list(outputs.labels)
    return xr.Dataset({name: (dims, np.stack(arrays))}, coords)


def _refuse_specimens_of_the_model(caller: str, simulator: Any) -> None:
    """Raise if a simulator has weights, labels, groups or conditions, or a data sheet."""
    weights = simulator.weights
    numbers = {
        "weights=": weights is not None and np.ptp(weights) > 0,
        "specimens=": simulator.specimens is not None,
        "groups": simulator.inputs.groups is not None,
        "prb.response.condition": bool(simulator.inputs.covariates)
        or getattr(simulator, "conditions", None) is not None,
        "a prb.Summary": simulator.metric.exact_likelihood,
        "a random response": simulator.responses.repeats > 1,
    }
    names = [name for name, is_there in numbers.items() if is_there]
    if names:
        raise TypeError(
            f"{caller}: {simulator.name}: got a simulator with {', '.join(names)} of its observed "
            "specimens, expected none, since each product has specimens of its own; write a model "
            "for each product, or prb.response.group for all together"
        )


def _read_sheets(caller: str, data: object, simulator: Any) -> dict[str, Summary]:
    """Return the data sheets of products, or raise if the simulator has none."""
    pairs = data.items() if isinstance(data, Mapping) else ()
    sheets = {str(name): x for name, x in pairs if isinstance(x, Summary)}
    obstacle, metric = "", simulator.metric
    has_settings = metric.by_specimen and metric != LogLikelihood()
    if np.ndim(simulator.observed) > 1:
        obstacle = "several outputs"
    elif has_settings:
        obstacle = f"metric={metric!r:.60}"
    for name in sheets if obstacle else ():
        raise TypeError(
            f"{caller}: data_sets: {name}: got a prb.Summary for a simulator with {obstacle}, "
            "expected specimens: the statistics of a data sheet are those of one output, without "
            "an error or limits of the readings; write a model for this product"
        )
    return sheets


def _read_data(data: object, name: str, minimum: int, event: Shape) -> NamedArrays:
    """Return the measured responses of each product, or raise."""
    if not isinstance(data, Mapping) or not data:
        raise TypeError(
            f"{name}: got {called(data)}, expected a mapping of measured responses by product, "
            "such as {'A': [1.2, 1.4], 'B': [0.9, 1.1]}"
        )
    arrays = {}
    for product, values in data.items():
        if isinstance(values, Summary) and name == "data_sets":
            values = representative_specimens(values)
        array = real_array(values, f"{name}: {product}").astype(float)
        if array.ndim != 1 + len(event) or array.shape[1:] != event or len(array) < minimum:
            raise ValueError(
                f"{name}: {product}: got shape {array.shape}, expected {('N', *event)} with at "
                f"least {counted(minimum, 'specimen')}, in the form of the simulator's "
                "observed values"
            )
        if str(product) in arrays:
            raise ValueError(
                f"{name}: got two products with the name {str(product)!r}, expected different "
                "names; write texts in place of numbers"
            )
        arrays[str(product)] = array
    return arrays


@dataclass(frozen=True)
class Calibration:
    """The posterior of one product, and its validity test."""

    values: Mapping[str, Floats]  # hyperparameters, (draws, *shape); empty after a failure
    pareto_k: float = np.nan
    test: ValidityTest | None = None
    finding: str = ""  # reason of a failure, or a warning


@dataclass(frozen=True, eq=False)
class Drawn:
    """The posterior of one product, and what it predicts."""

    values: NamedArrays  # hyperparameters, (draws, *shape)
    pareto_k: float
    predicted: Floats | None  # responses of populations, (P, n, ...); None without a test
    finding: str = ""


@dataclass(frozen=True, eq=False)
class Fleet:
    """Products with a common model, whose simulator has a metric of distributions."""

    evaluator: Evaluator
    observed: Mapping[str, Floats]
    further: Mapping[str, Floats]  # measured responses for validity tests, by product
    settings: SamplingSettings
    alpha: float
    # Data sheets by product; ``observed`` has specimens that they may have.
    sheets: Mapping[str, Summary]

    def part(self, names: Sequence[str]) -> Self:
        """Return the fleet of some products."""
        observed = {name: self.observed[name] for name in names}
        further = {name: self.further[name] for name in names if name in self.further}
        sheets = {name: self.sheets[name] for name in names if name in self.sheets}
        return replace(self, observed=observed, further=further, sheets=sheets)

    def calibrated(
        self, names: Sequence[str], advance: Callable[[], Any] = lambda: None
    ) -> list[Calibration]:
        """Calibrate some products."""
        drawn: dict[str, Drawn] = {}
        with shown(False), suppress(ValueError, RuntimeError, np.linalg.LinAlgError):
            drawn = self._in_batch(names)
        results = []
        for name in names:
            with shown(False):
                try:
                    of_product = drawn.get(name) or self._singly(name)
                    results.append(self._tested(name, of_product))
                except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
                    results.append(Calibration({}, finding=f"{name}: {error}"))
            advance()
        return results

    def _tested(self, name: str, drawn: Drawn) -> Calibration:
        """Return the posterior of a product with its validity test."""
        is_wide = name not in self.sheets and len(self.observed[name]) < 8
        tails = _heavy_tails(drawn.values) if is_wide else ""
        finding = " ".join(filter(None, [drawn.finding, tails]))
        result = Calibration(drawn.values, drawn.pareto_k, finding=finding)
        if name not in self.further or drawn.predicted is None:
            return result
        null = PosteriorNull(999)
        test = area_test(
            self.further[name], drawn.predicted, alpha=self.alpha, null=null, progressbar=False
        )
        return replace(result, test=test)

    def _in_batch(self, names: Sequence[str]) -> dict[str, Drawn]:
        """Return the posteriors of the products that are easily sampled together."""
        return {}

    def _singly(self, name: str) -> Drawn:
        """Return the posterior of a product."""
        (node,) = self.evaluator.nodes
        sheet = self.sheets.get(name)
        if sheet is None:
            evaluator = self.evaluator.observing({node.name: self.observed[name]})
        else:
            metric = SummaryLikelihood(sheet)
            evaluator = self.evaluator.observing({node.name: sheet.values}, metric)
            epsilon = shared_epsilon(node.name, 1 / sheet.n)
            of_sheet = replace(evaluator.nodes[0], epsilon=epsilon)
            evaluator = replace(evaluator, nodes=(of_sheet,), has_graph=False)
        with designs_restored(evaluator.reweighted.values()):
            values, pareto_k, finding = self._samples(evaluator)
            draw, predicted = partial(draw_responses, evaluator), None
            if name in self.further:
                (predicted,) = self._predicted([values], draw)
        return Drawn(values, pareto_k, predicted, finding)

    def _samples(self, evaluator: Evaluator) -> tuple[NamedArrays, float, str]:
        """Return draws of the model's variables, Pareto k of importance sampling, and findings."""
        posterior = draw_posterior(evaluator, self.settings)["posterior"].to_dataset()
        codes = ("lost-mass", "second-mode")
        texts = [f.text for f in from_json(posterior.attrs["findings"]) if f.code in codes]
        pareto_k = float(posterior.attrs.get("pareto_k", np.nan))
        return values_of_variables(evaluator, posterior), pareto_k, " ".join(texts)

    def _predicted(
        self, posteriors: Sequence[NamedArrays], draw: Callable[..., Floats], n: int = 50
    ) -> list[Floats]:
        """Return responses of n specimens of 100 populations of each posterior, (100, n, ...)."""
        rows = np.linspace(0, self.settings.draws - 1, 100).astype(np.intp)
        thinned = {
            name: np.concatenate([values[name][rows] for values in posteriors])
            for name in posteriors[0]
        }
        rng = np.random.default_rng(self.settings.random_seed)
        return np.split(draw(rng, thinned, n), len(posteriors))


def values_of_variables(evaluator: Evaluator, posterior: xr.Dataset) -> NamedArrays:
    """Return draws of the first chain, (draws, *shape), of the model's variables."""
    names = [str(rv.name) for rv in evaluator.model.unobserved_RVs]
    return {name: posterior[name].values[0] for name in names}


def draw_responses(
    evaluator: Evaluator, rng: np.random.Generator, values: Mapping[str, Floats], n: int
) -> Floats:
    """Return responses of points of the populations, (P, n), by weight."""
    free = [values[str(rv.name)] for rv in evaluator.model.free_RVs]
    responses, weights = evaluator.populations(evaluator.hyperparameters.thetas_of(free), 0)
    levels = (np.arange(n) + rng.random((len(weights), 1))) / n
    rows = rng.permuted(reached(weights, levels, normalized=True), axis=1)
    return np.take_along_axis(np.broadcast_to(responses, weights.shape), rows, axis=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class SpecimenFleet(Fleet):
    """Products whose simulator has the log-likelihood by specimen, with points of all specimens."""

    likelihood: SpecimenLikelihood  # likelihood of the specimens of all products, in order

    def part(self, names: Sequence[str]) -> Self:
        """Return the fleet of some products."""
        return replace(super().part(names), likelihood=self._likelihood(names))

    @cached_property
    def _rows(self) -> dict[str, Indices]:
        """The rows of each product among the specimens of all."""
        ends = np.cumsum([len(values) for values in self.observed.values()])
        parts = np.split(np.arange(ends[-1]), ends[:-1])
        return dict(zip(self.observed, parts, strict=True))

    @cached_property
    def _of_sheets(self) -> Fleet:
        """The products with a data sheet, by the emulator of all products."""
        (measurement,) = self.likelihood.measurements
        simulator = EmulatedSimulator(self.likelihood, measurement)
        sheet = next(iter(self.sheets.values()))
        evaluator = Evaluator.of(model_with_sheet(self.evaluator.model, simulator, sheet))
        fields = vars(super().part(list(self.sheets))) | {"evaluator": evaluator}
        return Fleet(**{name: fields[name] for name in Fleet.__dataclass_fields__})

    def _likelihood(self, names: Sequence[str]) -> SpecimenLikelihood:
        """Return the likelihood of the specimens of some products, with their points."""
        rows = np.concatenate([self._rows[name] for name in names])
        result, preparation = self.likelihood.of_rows(rows), prepared(self.likelihood)
        result.cache["preparation"] = replace(preparation, points=preparation.points.rows(rows))
        return result

    def _tested(self, name: str, drawn: Drawn) -> Calibration:
        """Return the posterior of a product with its validity test; audit its emulator."""
        if name not in self.sheets:
            free = [drawn.values[str(rv.name)] for rv in self.evaluator.model.free_RVs]
            thetas = self.evaluator.hyperparameters.thetas_of(free)
            try:  # No runs can be added, because products share the emulator.
                audited_likelihood(self._likelihood([name]), thetas, is_last=True)
            except DesignError as error:
                drawn = replace(drawn, finding=f"{drawn.finding} {error}.".strip())
        return super()._tested(name, drawn)

    def _in_batch(self, names: Sequence[str]) -> dict[str, Drawn]:
        """Return the posteriors of the products that are easily sampled together."""
        names = [name for name in names if name not in self.sheets]
        if not names:
            return {}
        likelihood = self._likelihood(names)
        sizes = [len(self.observed[name]) for name in names]
        posteriors = ProductPosteriors.of(self.evaluator, likelihood, sizes)
        if posteriors is None:
            return {}
        samples = posteriors.samples(np.arange(len(names)), self.settings)
        if not samples:
            return {}
        draws = self.settings.draws
        thetas = np.concatenate([sample.draws for sample in samples.values()])
        of_all = self.evaluator.hyperparameters.constrained(thetas)
        values = {}
        for place, row in enumerate(samples):
            rows = slice(place * draws, (place + 1) * draws)
            values[row] = {name: value[rows] for name, value in of_all.items()}
        tested = [row for row in samples if names[row] in self.further]
        predicted: dict[int, Floats] = {}
        if tested:
            # Products differ in their specimens, and not in the way in which these are measured.
            draw = partial(draw_readings, likelihood, measurement=likelihood.measurements[0])
            responses = self._predicted([values[row] for row in tested], draw)
            predicted = dict(zip(tested, responses, strict=True))
        findings = _misfits(likelihood, sizes)
        return {
            names[row]: Drawn(values[row], sample.pareto_k, predicted.get(row), findings[row])
            for row, sample in samples.items()
        }

    def _singly(self, name: str) -> Drawn:
        """Return the posterior of a product."""
        if name in self.sheets:
            return self._of_sheets._singly(name)
        likelihood = self._likelihood([name])
        emulated = (EmulatedSimulator(likelihood, likelihood.measurements[0]),)
        evaluator = replace(self.evaluator, emulated=emulated, has_graph=False)
        target = specimen_target(evaluator, None)
        modes = modes_of(target.log_posterior, target.starts, target.scale)
        draws = self.settings.draws
        # The wide posterior of few specimens has few points in its tails: draw from four times as
        # many.
        factor = 4 if len(self.observed[name]) < 8 else 1
        many = replace(self.settings, draws=factor * draws)
        chains = None if modes is None else importance_chains(target, modes, many)
        if modes is None or chains is None:
            values, pareto_k, finding = self._samples(evaluator)
        else:
            refuse_lost_specimens(evaluator, chains.thetas[0].mean(axis=0))
            # The draws are in random order.
            values = evaluator.hyperparameters.constrained(chains.thetas[0, :draws])
            pareto_k = chains.sampler["pareto_k"]
            finding = " ".join(f.text for f in mode_findings(target, modes, chains.thetas))
        finding = " ".join(
            filter(None, [*_misfits(likelihood, [len(self.observed[name])]), finding])
        )
        predicted = None
        if name in self.further:
            draw = partial(draw_readings, likelihood, measurement=likelihood.measurements[0])
            (predicted,) = self._predicted([values], draw)
        return Drawn(values, pareto_k, predicted, finding)


def _calibrated(pickled: bytes, names: Sequence[str]) -> list[Calibration]:
    """Calibrate some products in a worker."""
    import cloudpickle

    fleet: Fleet = cloudpickle.loads(pickled)
    return fleet.calibrated(names)


def _heavy_tails(values: NamedArrays) -> str:
    """Return a sentence if a standard deviation of draws, (draws, *shape), is not well known.

    Its relative standard error depends on the kurtosis of the draws.
    """
    errors = {"": 0.0}
    for name, draws in values.items():
        squares = (draws - draws.mean(axis=0)) ** 2
        with np.errstate(invalid="ignore"):  # because a constant has none
            kurtosis = (squares**2).mean(axis=0) / squares.mean(axis=0) ** 2
        errors[name] = float(np.nanmax(np.sqrt((kurtosis - 1) / (4 * len(draws))), initial=0.0))
    name = max(errors, key=lambda key: errors[key])
    if errors[name] <= 2 / np.sqrt(2 * len(draws)):  # twice that of a normal posterior
        return ""
    return (
        f"The posterior of {name} has heavy tails: the standard deviation of its draws has a "
        f"standard error of {errors[name]:.0%}. Pass more draws, or report quantiles."
    )


def _misfits(
    likelihood: SpecimenLikelihood, sizes: Sequence[int], largest: float = 50.0
) -> list[str]:
    """Return a sentence about specimens whose readings no point reproduces to so many nats.

    For each product, which have so many specimens; an empty text where there are none.
    """
    preparation = prepared(likelihood)
    readings = likelihood.readings
    sd = readings.comparison_sd(preparation.emulation.error)[:, None]
    residual = (preparation.points.outputs - readings.values[:, None]) / sd
    misfit = np.where(np.isnan(residual), 0.0, residual**2).sum(axis=-1) / 2
    exists = np.isfinite(preparation.points.log_a) | (misfit > largest)
    is_poor = np.where(exists, misfit, np.inf).min(axis=1) > largest
    findings = []
    for part in np.split(is_poor, np.cumsum(sizes)[:-1]):
        finding = "No inputs in the range of the priors reproduce the readings of"
        finding += f" {part.sum()} of {len(part)} specimens."
        findings.append(finding if part.any() else "")
    return findings


def _tree(
    evaluator: Evaluator,
    names: Sequence[str],
    rows: Sequence[Calibration],
    draws: int,
    attrs: Mapping[str, Any],
) -> Products:
    """Return the posteriors and the table of products."""
    first = next(row for row in rows if row.values)
    missing = {name: np.full_like(values, np.nan) for name, values in first.values.items()}
    arrays = {
        name: np.stack([(row.values or missing)[name] for row in rows], axis=1)[None]
        for name in missing
    }
    posterior = labelled(evaluator, arrays, {"chain": 1, "draw": draws, "product": len(rows)})
    posterior = posterior.assign_coords(product=np.array(names))
    columns = {
        "pareto_k": [row.pareto_k for row in rows],
        "finding": [row.finding for row in rows],
    }
    attrs = {**attrs, **versions()}
    groups = {"posterior": posterior.assign_attrs(attrs)}
    tests = {name: row.test for name, row in zip(names, rows, strict=True) if row.test is not None}
    if tests:
        groups["validity"] = _validity(names, tests)
        for key in ("statistic", "critical_value", "p_value"):
            values = {name: getattr(test, key) for name, test in tests.items()}
            columns[key] = [values.get(name, np.nan) for name in names]
        columns["rejected"] = [name in tests and tests[name].rejected for name in names]
    products = xr.Dataset({k: ("product", v) for k, v in columns.items()}, {"product": names})
    groups["products"] = products.assign_attrs(attrs)
    return Products.from_dict(groups)


def _validity(names: Sequence[str], tests: Mapping[str, ValidityTest]) -> xr.Dataset:
    """Return the u-values of the tests of products, filled up after the last one of each."""
    size = max(test.u_values.size for test in tests.values())
    columns: dict[str, list[Any]] = {}
    for name in names:
        test = tests.get(name)
        n = 0 if test is None else test.u_values.size
        numbers, texts = np.full((3, size), np.nan), np.full((2, size), "", dtype=object)
        if test is not None:
            numbers[:, :n] = test.u_values, *test.envelope
            texts[:, :n] = test.conditions, test.specimens
        for key, values in zip(_OF_TEST, [*numbers, *texts.astype(str)], strict=True):
            columns.setdefault(key, []).append(values)
    first = next(iter(tests.values()))
    variables = {key: (("product", "value"), np.stack(rows)) for key, rows in columns.items()}
    return xr.Dataset(variables, {"product": list(names)}, {"null": first.null})


# Variables of the group ``validity``: of each u-value, and of each rank the envelope
_OF_TEST = ("u", "lower", "upper", "condition", "specimen")


def tests_of_products(result: Any) -> dict[str, ValidityTest]:
    """Return the validity tests of the products of a fleet, or of a product; none without any."""
    if not product_names(result) or "validity" not in result.children:
        return {}
    values, products = result["validity"].to_dataset(), result["products"].to_dataset()
    if "product" not in values.dims:
        values, products = values.expand_dims("product"), products.expand_dims("product")
    arrays = {key: values[key].transpose("product", "value").values for key in _OF_TEST}
    identity = identity_from_attributes(products.attrs)
    tests = {}
    for row, name in enumerate(product_names(result)):
        n = int(np.isfinite(arrays["u"][row]).sum())
        if n:
            of_test = {key: array[row, :n] for key, array in arrays.items()}
            tests[name] = ValidityTest(
                statistic=float(products["statistic"][row]),
                critical_value=float(products["critical_value"][row]),
                p_value=float(products["p_value"][row]),
                alpha=float(products.attrs["alpha"]),
                null=str(values.attrs["null"]),
                folded=False,
                u_values=of_test["u"],
                envelope=np.stack([of_test["lower"], of_test["upper"]]),
                conditions=of_test["condition"],
                specimens=of_test["specimen"],
                identity=identity,
            )
    return tests


class Products(Tree):
    """Posteriors and validity tests by product."""

    __slots__ = ()
    _parts = ("posterior", "products")

    def to_dataframe(self) -> Any:
        """Return a row for each product: mean and sd of each hyperparameter, and its test."""
        if not self._is_whole:
            return super().to_dataframe()
        posterior, products = self._tables()
        columns: dict[str, Any] = {}
        for name, draws in posterior.data_vars.items():
            values = draws.transpose("chain", "draw", "product", ...).values
            for index in np.ndindex(values.shape[3:]):
                element = element_name(str(name), index)
                of_products = values[:, :, :, *index]
                columns[element] = of_products.mean(axis=(0, 1))
                columns[f"sd of {element}"] = of_products.std(axis=(0, 1))
        table = xr.Dataset(
            {name: ("product", values) for name, values in columns.items()},
            {"product": posterior["product"]},
        )
        return table.merge(
            products.drop_vars(["finding", "data_sheet"], errors="ignore")
        ).to_dataframe()

    def _tables(self) -> list[xr.Dataset]:
        """Return posteriors and products with dimensions that a selection has lost."""
        tables = [self["posterior"].to_dataset(), self["products"].to_dataset()]
        for k, dims in enumerate((("chain", "draw", "product"), ("product",))):
            tables[k] = tables[k].expand_dims([dim for dim in dims if dim not in tables[k].dims])
        return tables

    def to_view(self) -> View:
        """Return what a reader sees."""
        _, products = self._tables()
        table = self.to_dataframe()
        columns = [name for name in table.columns if not name.startswith("sd of ")]
        rows = []
        for product, row in table.iterrows():
            cells = []
            for name in columns:
                sd = f" ± {row[f'sd of {name}']:.2g}" if f"sd of {name}" in table else ""
                number = row[name]
                is_text = isinstance(number, bool | np.bool_ | str)
                cells.append(str(number) if is_text else f"{number:.4g}{sd}")
            rows.append([str(product), *cells])
        pairs = zip(products["product"].values, products["finding"].values, strict=True)
        sentences = [f"{product}: {finding}" for product, finding in pairs if finding]
        heading = counted(len(rows), "product")
        if "rejected" in products:
            is_tested = np.isfinite(products["p_value"].values)
            heading += (
                f", {int(products['rejected'].sum())} of {int(is_tested.sum())} rejected at level "
                f"{products.attrs['alpha']:g}"
            )
        return View(heading, ["", *columns], rows, sentences[:10])
