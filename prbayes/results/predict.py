"""Posterior prediction: responses of the calibrated population, for any response."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from pytensor.tensor.variable import TensorVariable

from prbayes._display import ShownArray, View
from prbayes._finding import Finding, Findings, as_json, counted, report, sentences_of
from prbayes._progress import shown
from prbayes._stats import positive_scale, reached
from prbayes._validate import (
    ArraysByName,
    Floats,
    Function,
    Indices,
    NamedArrays,
    NamedValues,
    Seed,
    StrPath,
    complete_rows,
    finite_number,
    flag,
    plain_text,
    positive_integer,
    seed_number,
    wrong_type,
)
from prbayes.emulators.runs import Runs
from prbayes.model.conditions import at_conditions, stacked_values
from prbayes.model.description import versions
from prbayes.model.emulated import (
    PopulationSimulator,
    emulator_of,
    population_simulators,
)
from prbayes.model.evaluator import TOLERABLE, Evaluator, read_inputs_of_copy, shortcoming
from prbayes.model.fingerprint import (
    Level,
    as_attributes,
    identity_of,
)
from prbayes.model.locking import locked
from prbayes.model.parameters import element_name, finite_draws, fixed_values
from prbayes.model.random_variable import Node, has_default_epsilon, simulators
from prbayes.optimize.optimum import Optimum, identity_in, refuse_model, require_of_model
from prbayes.propagation.base import MAX_LOST, DesignError, refuse_max_lost
from prbayes.propagation.design import PoorEmulatorError
from prbayes.propagation.importance import new_specimens
from prbayes.propagation.reweighted import ReweightedBound, designs_restored
from prbayes.response.condition import is_condition, known_covariates
from prbayes.response.discrepancy import findings_of
from prbayes.response.distributions import PopulationSampler
from prbayes.response.failures import Abort, ResponseError
from prbayes.response.inputs import Inputs, is_group, model_on_context
from prbayes.response.outputs import Outputs, is_missing
from prbayes.response.response import Responses, check_call_settings, refuse_uncallable
from prbayes.results.products import evaluator_of_products, one_posterior, product_names

# Types that a function of results takes, for its errors.
RESULT = (
    "an Optimum from prb.minimize, or a DataTree with a posterior group, such as prb.sample_smc "
    "returns"
)


@locked
def predict(
    result: Optimum | xr.DataTree,
    response: Function,
    *inputs: Any,
    model: pm.Model | None = None,
    n_samples: int = 500,
    n_draws: int = 400,
    stored: bool = True,
    max_lost: float | None = None,
    at: Mapping[str, float] | None = None,
    name: str | None = None,
    executor: Executor | None = None,
    store: StrPath | None = None,
    version: str | None = None,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> Prediction:
    """Draw responses of the calibrated population.

    Also of another response, or under another condition: a number in place of
    `prbayes.response.condition`, or a condition with the same name and values of other specimens,
    each of which is drawn once from each population.

    Each draw of the posterior is a population, from which ``n_samples`` specimens are drawn; an
    optimum is one population. If a simulator with `Reweighted` has the same ``.dist()`` objects,
    the specimens are its design points, resampled by their weights. Its own response then costs
    nothing, and another one is computed once for each design point. Otherwise specimens are new:
    Sobol points through the inverse distribution functions, or random draws without an inverse. The
    response of a simulator with the log-likelihood by specimen is that of its emulator. Another
    response is computed at the points of the emulator's runs, and interpolated.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group that has the model's free variables, from
        `sample_smc`, `bootstrap` or any PyMC sampler.
    response : callable
        As for `Simulator`; +inf is a specimen that failed, NaN a point that could not be computed.
    *inputs
        ``.dist()`` objects of the model's simulators, or new ones over the model's variables; model
        variables; constants.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    n_samples : int
        Specimens from each population; with a condition and an optimum, draws of all specimens.
    n_draws : int
        Largest number of populations, over all chains; the posterior's draws are thinned evenly.
    stored : bool
        Whether design points or an emulator may serve. With False the response is computed for
        n_draws x n_samples specimens.
    max_lost : float, optional
        Largest share of the predicted responses that may be NaN; by default what the model's
        simulators allow, the largest.
    at : dict, optional
        The value of each covariate, by the name of its `prbayes.response.condition`, where inputs
        depend on one. A condition that is an input as well has the values of the input.
    name : str, optional
        Of the result; by default that of the function.
    executor : concurrent.futures.Executor, optional
        Where the response is computed.
    store : path-like, optional
        A folder that keeps every computed response, by its name.
    version : str, optional
        Of the response, for the store; as for `Reweighted`.
    random_seed : int, sequence of int, numpy.random.Generator or None
    progressbar : bool
        Whether work of more than two seconds shows a bar on stderr.

    Returns
    -------
    xarray.DataArray
        Dims (chain, draw, sample), and for several outputs a last one, with their names where they
        are known: those of the simulator with this response, or the keys of a mapping. With a
        condition, (chain, draw, specimen) with a specimen for each of its values. Where inputs
        depend on `prbayes.response.group`, that dimension is before the samples. Attributes:
        ``source`` (how specimens were made), ``responses`` (how many were computed), ``units`` (of
        a simulator's response), ``emulator_error`` (of an emulator, by output: the root mean square
        error of runs that are left out), ``nan`` (how many values are NaN), ``findings`` (as JSON,
        such as that a model discrepancy extrapolates),
        ``specimens_id`` (equal for predictions with the same specimens), ``calibration_data`` and
        ``calibration_specimens`` (digests of the data, and specimen labels, of the calibration,
        which `area_test` compares), ``identity`` (of the problem that was calibrated). It prints
        as sentences; a notebook shows a table.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or the result lacks a free variable, or is of other
        populations or data than the model.
    DesignError
        If the design points do not support the populations, or more responses than ``max_lost`` are
        NaN.
    ResponseError
        If the response raises, has the wrong shape, or is NaN everywhere.

    Notes
    -----
    With the same ``result``, inputs, ``n_samples``, ``n_draws`` and ``random_seed``, sample i of a
    draw is the same specimen, whatever the response: predictions of several conditions can be set
    against repeated measurements. Where two simulators of the model have designs of their own, pass
    ``stored=False``.

    Quantiles of the result are no better known than the few samples beyond them, and the response
    is constant beyond the range of a likelihood's runs, unless ``stored=False``. Probabilities of
    far tails, with their errors, are those of `exceedance` with ``n_points=1000``.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     data = [0.0, 2.0, 4.0]
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=data)
    >>> squares = prb.predict(prb.minimize(model), np.square, x, random_seed=1)
    >>> squares.name, squares.shape, squares.attrs["responses"]
    ('square', (1, 1, 500), 1024)
    """
    refuse_uncallable("prb.predict", response, order="predict(result, response, *inputs)")
    positive_integer(n_samples, "n_samples", minimum=2)
    positive_integer(n_draws, "n_draws")
    flag(stored, "stored")
    if name is not None:
        plain_text(name, "name")
    calling = call_settings(executor, store, version)
    label = name or named_response(response, calling, "pass name=")
    model = model_of(result, model, "prb.predict")
    if product_names(result):
        model = evaluator_of_products(result, model).model
    sources = population_simulators(model)
    if max_lost is None:
        max_lost = max((s.max_lost for s in sources), default=MAX_LOST)
    refuse_max_lost(max_lost, "prb.predict")
    arguments, conditions = with_known_conditions(label, inputs, sources, stored=stored)
    copies = 1
    if conditions is not None:  # A sample has a specimen for each condition.
        copies, n_samples = n_samples, len(conditions)
    points, coords = populations_of(result, model, n_draws, "prb.predict", copies)
    inputs_read = read_inputs_of_copy(label, arguments, model, function=response)
    n_stored = sum(s.responses.count for s in sources)
    responses = Responses(
        label,
        response,
        inputs_read,
        **calling,
        outputs=known_outputs(sources, response, inputs_read),
        caller="prb.predict",
        scatter=known_scatter(sources, response),
    )
    seed = None if random_seed is None else seed_number(random_seed)
    # A table of runs needs no emulator: it costs no run, and is NaN outside its ranges.
    simulator = None
    if stored and not isinstance(response, Runs):
        simulator = serving(sources, responses)
    size = len(next(iter(points.values())))
    # A condition that is an input and a covariate has the same values as both.
    stated = _by_name(inputs_read, conditions)
    has_runs = simulator is not None
    points |= covariate_values(label, inputs_read, at, stated, size, has_runs=has_runs)
    rng = np.random.default_rng(seed)
    with shown(progressbar):
        drawn = _predicted(simulator, responses, points, n_samples, rng, conditions)
    missing, findings = _checked_responses(label, drawn, max_lost, _remedy(response, responses))
    findings += _prediction_findings(responses, drawn, result, model)
    n_computed = responses.count - n_stored + sum(s.responses.count for s in sources)
    attrs = {
        "responses": n_computed,
        **({} if responses.outputs is None else responses.outputs.attrs),
        "nan": missing,
        **_drawn_attributes(drawn, sources, response),
        "random_seed": str(seed),
        "findings": as_json(findings),
        **_calibration_attributes(result, model),
        **provenance(result, model),
    }
    coords["sample" if conditions is None else "specimen"] = np.arange(n_samples)
    return Prediction(_labelled(drawn.values, responses, coords).rename(label).assign_attrs(attrs))


class Prediction(ShownArray, xr.DataArray):
    """Predicted responses of the specimens of each population."""

    __slots__ = ()
    _parts = ("chain", "draw", "source", "responses")

    @property
    def _is_whole(self) -> bool:
        return super()._is_whole and bool({"sample", "specimen"} & set(self.dims))

    def to_view(self) -> View:
        """Return what a reader sees."""
        drawn = [d for d in self.dims if d in ("chain", "draw", "sample", "specimen")]
        rows_of = [d for d in self.dims if d not in drawn]
        values = self.transpose(*rows_of, *drawn).values
        shape = [self.sizes[d] for d in rows_of]
        rows = []
        for index in np.ndindex(*shape):
            x = values[index][~np.isnan(values[index])]
            labels = [self[d].values[i] for d, i in zip(rows_of, index, strict=True)]
            finite = x[np.isfinite(x)]
            moments = [finite.mean(), finite.std()] if finite.size else [np.nan, np.nan]
            with np.errstate(invalid="ignore"):  # A quantile may lie between two failures, +inf.
                numbers = [*moments, *np.quantile(x, [0.05, 0.5, 0.95])]
            rows.append([element_name(str(self.name), labels), *(f"{n:.4g}" for n in numbers)])
        size = self.sizes[drawn[-1]]
        populations = counted(self.sizes["chain"] * self.sizes["draw"], "population")
        heading = (
            f"Predicted {self.name}: {size} specimens of each of {populations}, "
            f"from {self.attrs['source']}"
        )
        sentences = sentences_of(self.attrs)
        failed = float(np.mean(np.isposinf(values)))
        if failed:
            sentences.append(
                f"{failed:.2g} of the specimens fail (+inf): mean and sd are those of the others."
            )
        sentences.append(f"{self.attrs['responses']} responses computed.")
        header = ["", "mean", "sd", "5% quantile", "median", "95% quantile"]
        return View(heading, header, rows, sentences)


def _labelled(
    values: Floats, responses: Responses, coords: dict[str, NDArray[Any]]
) -> xr.DataArray:
    """Return predicted responses with dimensions; ``coords`` are of chains, draws and specimens."""
    (chain, draw, specimen), groups = coords, responses.inputs.groups
    labels: dict[str, Any] = {chain: coords[chain], draw: coords[draw]}
    if groups is not None:
        labels[groups.dim] = list(groups.labels)
    labels[specimen] = coords[specimen]
    event = values.shape[len(labels) - 1 :]
    if event:
        outputs = responses.outputs or Outputs(tuple(range(event[0])))
        labels[outputs.dim] = list(outputs.labels)
    sizes = [len(label) for label in labels.values()]
    return xr.DataArray(values.reshape(sizes), labels, tuple(labels))


def covariate_values(
    label: str,
    inputs: Inputs,
    at: Mapping[str, float] | None,
    stated: ArraysByName,
    size: int,
    *,
    has_runs: bool,
) -> NamedArrays:
    """Return the values of each covariate in ``size`` populations, (size, 1).

    The values of a stated condition are those of N specimens, (size, N). With ``has_runs`` numbers
    outside the range of the runs are refused.
    """
    names = [str(covariate.name) for covariate in inputs.covariates]
    unknown = [name for name in names if name not in stated]
    numbers = {} if at is None else at
    if not isinstance(numbers, Mapping) or set(numbers) != set(unknown):
        remedy = "leave at= out"
        if unknown:
            remedy = f"pass at={{{unknown[0]!r}: value}}"
        raise ValueError(
            f"{label}: at: got {at!r}, expected a value of each covariate of the inputs, "
            f"{unknown}; {remedy}"
        )
    values = {}
    for covariate, name in zip(inputs.covariates, names, strict=True):
        value: Any = stated.get(name)
        if value is None:
            value = finite_number(numbers[name], f"{label}: at: {name}")
            if has_runs:
                ends = covariate.owner.op.dist_params(covariate.owner)
                low, high = (float(end.eval()) for end in ends)
                _refuse_outside(f"{label}: at", name, [value], low, high)
        values[name] = np.broadcast_to(value, (size, np.size(value)))
    return values


def points_by_group(inputs: Inputs, points: NamedArrays) -> list[NamedArrays]:
    """Return the variables of the populations of each group, or the only ones without groups."""
    if inputs.groups is None:
        return [points]
    size = len(next(iter(points.values())))
    (index,) = [str(parent.name) for parent in inputs.parents if is_group(parent)]
    places = range(len(inputs.groups.labels))
    return [points | {index: np.full(size, place)} for place in places]


def _refuse_outside(
    label: str, name: str, values: Sequence[float], low: float, high: float
) -> None:
    """Raise if a value is outside the range of the runs, beyond which nothing is known."""
    outside = [value for value in values if not low <= value <= high]
    if outside:
        raise ValueError(
            f"{label}: got {name} = {outside[0]:g}, expected values from {low:.4g} to {high:.4g}, "
            "the range of the runs; pass stored=False, which computes the response of new specimens"
        )


def _by_name(inputs: Inputs, conditions: Floats | None) -> NamedArrays:
    """Return the values of conditions that are inputs, (N, C), by name."""
    if conditions is None:
        return {}
    names = [str(inputs.aleatory[place].name) for place in inputs.conditions]
    return dict(zip(names, conditions.T, strict=True))


def call_settings(executor: Any, store: Any, version: Any) -> dict[str, Any]:
    """Check where a response is computed and kept; return it as arguments of `Responses`."""
    check_call_settings(executor, store, version, Abort())
    return {"executor": executor, "store": store, "version": version}


def named_response(response: Any, calling: NamedValues, advice: str) -> str:
    """Return the name of a response; raise if a store needs its name, and it has none."""
    inner = getattr(response, "function", response)  # `scalar` wraps a function.
    name = str(getattr(inner, "__name__", type(inner).__name__))
    is_named = hasattr(inner, "__name__") and name != "<lambda>"
    if calling.get("store") is not None and not is_named:
        raise ValueError(
            f"store: got a function called {name}, expected a name under which its responses are "
            f"stored; {advice}"
        )
    return name


# -- populations -----------------------------------------------------------------------------------


def model_of(result: Any, model: pm.Model | None, caller: str) -> pm.Model:
    """Return the model of a result, the one passed, or on the context; raise if it differs."""
    refuse_model(result, caller)
    if model is None and isinstance(result, Optimum):
        model = result.model
    model = model_on_context(model, caller)
    if not (isinstance(result, Optimum) and model is result.model):
        require_of_model(result, model, caller, Level.POPULATIONS)
    return model


def populations_of(
    result: Any, model: pm.Model, draws: int, caller: str, copies: int = 1
) -> tuple[NamedArrays, dict[str, NDArray[Any]]]:
    """Return variables, (k, *shape), at evenly thinned draws, and the coordinates of the draws.

    These are the free variables, and those that `pymc.do` or `pymc.observe` fixed. An optimum has
    one draw, which is repeated ``copies`` times.
    """
    names = [str(rv.name) for rv in model.free_RVs]
    result = one_posterior(result, caller)
    values: Any
    if isinstance(result, Optimum):
        values = result.point
    elif not isinstance(result, xr.DataTree) or "posterior" not in result:
        raise wrong_type(result, caller, RESULT)
    else:
        posterior = result["posterior"].to_dataset()
        size = posterior.sizes["draw"]
        by_chain = max(1, draws // posterior.sizes["chain"])
        rows = np.linspace(0, size - 1, min(size, by_chain)).round().astype(int)
        values = posterior.isel(draw=np.unique(rows))
    missing = [name for name in names if name not in values]
    if missing:
        raise KeyError(
            f"{caller}: got a result without {missing}, expected the model's free variables {names}"
        )
    if isinstance(result, Optimum):
        of_optimum = {name: np.asarray(values[name], dtype=np.float64) for name in names}
        points = {name: np.repeat(value[None], copies, 0) for name, value in of_optimum.items()}
        coords = {"chain": np.arange(1), "draw": np.arange(copies)}
    else:
        points = finite_draws(values, names)
        coords = {dim: np.asarray(values[dim]) for dim in ("chain", "draw")}
    size = len(points[names[0]])
    for name, value in fixed_values(model).items():
        points[name] = np.broadcast_to(value, (size, *value.shape))
    return points, coords


def thetas_of(result: Any, evaluator: Evaluator, draws: int, caller: str) -> Floats:
    """Return the thetas of an optimum, or of evenly thinned draws, (k, d)."""
    points, _ = populations_of(result, evaluator.model, draws, caller)
    values = [points[str(rv.name)] for rv in evaluator.model.free_RVs]
    return evaluator.hyperparameters.thetas_of(values)


def width_of_epsilon(result: Any, model: pm.Model | None) -> Findings:
    """Report draws whose width is that of epsilon, from any sampler.

    Draws of a bootstrap, and of log-likelihoods with their default epsilon, are not reported.
    """
    groups = result.children if isinstance(result, xr.DataTree) else {}
    attrs = result["posterior"].attrs if "posterior" in groups else {}
    is_adjusted = attrs.get("adjustment", "none") != "none"
    is_bootstrap = "converged" in attrs  # A bootstrap has no epsilon.
    if "posterior" not in groups or is_adjusted or is_bootstrap:
        return ()
    has_epsilon = False
    if model is not None:
        has_epsilon = not all(
            has_default_epsilon(simulator) and not simulator.target.metric.distance
            for simulator in simulators(model).values()
        )
    elif "calibration" in groups and "is_likelihood" in result["calibration"]:
        has_epsilon = not bool(result["calibration"]["is_likelihood"].all())
    if not has_epsilon:
        return ()
    text = (
        "The draws are those of exp(-discrepancy / epsilon): their width is that of epsilon, not "
        "of the number of specimens; prb.sample draws the posterior given the estimate."
    )
    return (Finding("width-of-epsilon", text, "choose.md#epsilon-and-the-width-of-the-posterior"),)


def _prediction_findings(
    responses: Responses, drawn: _Predicted, result: Any, model: pm.Model
) -> Findings:
    """Report extrapolation, and more than 1 % of specimens whose response is not known."""
    findings = [*width_of_epsilon(result, model)]
    if drawn.beyond > 0.01:
        text = (
            f"{responses.name}: {drawn.beyond:.1%} of the specimens are beyond the range of the "
            "runs, where the response is taken as constant, so that far quantiles are too "
            "moderate; pass stored=False, which calls the response there."
        )
        page = "decision.md#the-population-in-units"
        findings.append(Finding("beyond-runs", text, page))
    return (*findings_of(responses.function), *report(*findings))


# -- responses -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Predicted:
    """Responses of specimens."""

    # responses of n specimens of k populations, (k, n), or (k, n, m) of several outputs; groups are
    # an axis after the populations
    values: Floats
    specimens: list[Floats]  # aleatory inputs, (k, n, *event) each
    source: str  # text on how the specimens were made
    error: Floats | None = None  # error of the emulator by output, (m,)
    beyond: float = 0.0  # share of the specimens whose response beyond the runs is unknown


def _predicted(
    simulator: PopulationSimulator | None,
    responses: Responses,
    points: NamedArrays,
    n: int,
    rng: np.random.Generator,
    conditions: Floats | None,
) -> _Predicted:
    """Return responses of n specimens from each population, group by group.

    Specimens of a data set have known conditions, (n, C).
    """
    inputs = responses.inputs
    results = []
    emulated = None
    for group_points in points_by_group(inputs, points):
        if isinstance(simulator, Node):
            results.append(_resampled_responses(simulator, responses, group_points, n, rng))
            continue
        parents = [group_points[str(rv.name)] for rv in inputs.parents]
        if conditions is None:
            specimens, epistemic = new_specimens(responses.name, inputs, parents, n, rng)
        else:  # The specimens of a population are a data set: they are independent.
            specimens, epistemic = PopulationSampler(inputs)(parents, n, rng)
            specimens = at_conditions(inputs, specimens, conditions)
        if simulator is None:
            values = responses(specimens, epistemic)
            results.append(_Predicted(values, specimens, "new specimens"))
            continue
        flat = [x.reshape(-1, *x.shape[2:]) for x in specimens]
        emulated = emulated or emulator_of(simulator, responses, flat)
        values = emulated(flat)
        beyond = emulated.share_beyond(flat, values)
        values = values.reshape(len(parents[0]), n, *emulated.event)
        runs = len(emulated.z)
        source = f"an interpolant through {runs} runs at those of {simulator.name}"
        if responses.same_as(simulator.responses):
            source = f"the emulator of {simulator.name} ({runs} runs)"
        source = f"new specimens, by {source}"
        results.append(_Predicted(values, specimens, source, emulated.error, beyond))
    if len(results) == 1:
        return results[0]
    specimens = [x for result in results for x in result.specimens]
    values = np.stack([result.values for result in results], axis=1)
    beyond = max(result.beyond for result in results)
    return replace(results[0], values=values, specimens=specimens, beyond=beyond)


def with_known_conditions(
    label: str,
    inputs: Sequence[Any],
    simulators: Sequence[PopulationSimulator],
    *,
    stored: bool,
) -> tuple[list[Any], Floats | None]:
    """Return inputs with the model's conditions in place of conditions of the same name.

    The values of the latter, (N, C), are returned as well.
    """
    of_model = {
        str(s.inputs.aleatory[place].name): s.inputs.aleatory[place]
        for s in simulators
        for place in s.inputs.conditions
    }
    conditions = {
        str(x.name): x for x in inputs if isinstance(x, TensorVariable) and is_condition(x)
    }
    sizes = {name: len(x.owner.op.values) for name, x in conditions.items()}
    if len(set(sizes.values())) > 1:
        raise ValueError(
            f"{label}: got conditions of {sizes} specimens, expected one value of each condition "
            "for each specimen"
        )
    size = next(iter(sizes.values()), 0)
    changed = [
        of_model.get(str(x.name), x) if any(x is y for y in conditions.values()) else x
        for x in inputs
    ]
    if stored:
        for name, x in conditions.items():
            if name in of_model:
                _refuse_outside(label, name, x.owner.op.values, *of_model[name].owner.op.range)
    values = known_covariates(label, list(conditions.values()), size, None)
    return changed, stacked_values(values)


def _remedy(response: Any, responses: Responses) -> str:
    """Return what to do where a predicted response is NaN."""
    if not isinstance(response, Runs):
        return responses.remedy
    # The remedy is not `propose_runs`, which returns runs near the data, and none elsewhere.
    parts = [
        f"{name} from {np.min(low):.4g} to {np.max(high):.4g}"
        for name, (low, high) in response.ranges.items()
    ]
    return f"the runs have {', '.join(parts)}: add runs at the inputs of the prediction"


def _checked_responses(
    label: str, drawn: _Predicted, max_lost: float, remedy: str
) -> tuple[int, Findings]:
    """Return the number of NaN, and findings on them and on the emulator; raise if it is large."""
    values, error = drawn.values, drawn.error
    is_nan = is_missing(values.reshape(-1, *values.shape[2:]))
    missing = int(is_nan.sum())
    if missing == is_nan.size:
        raise ResponseError(
            f"{label}: got NaN at all {missing} specimens, expected numbers; {remedy}, or return "
            "+inf for specimens that fail"
        )
    if missing > max_lost * is_nan.size:
        raise DesignError(
            f"{label}: lost mass: got {missing / is_nan.size:.1%} NaN among the predicted "
            f"responses, expected at most max_lost = {max_lost:.1%}: the prediction would describe "
            f"only the specimens that have a response; {remedy}, return +inf for specimens that "
            "fail, or pass a larger max_lost"
        )
    findings: Findings = ()
    if missing:
        text = f"{label}: {missing} of {is_nan.size} predicted responses are NaN; {remedy}."
        findings = report(Finding("missing-predictions", text))
    if error is not None:
        flat = values.reshape(-1, error.size)
        is_finite = complete_rows(flat)
        spread = np.full(error.shape, np.nan)
        if is_finite.any():
            # Quartiles as well, because few specimens beside a pole have most of the variance.
            low, high = np.quantile(flat[is_finite], [0.25, 0.75], axis=0)
            spread = flat[is_finite].std(axis=0)
            spread = np.where(high > low, np.minimum(spread, (high - low) / 1.349), spread)
        advice = "pass stored=False, which computes the response at new specimens"
        findings += report(*rough_emulator(label, error, spread, advice))
    return missing, findings


def rough_emulator(name: str, error: Floats, spread: Floats, remedy: str) -> Findings:
    """Return a finding if an emulator has a large error beside the spread of responses, (m,)."""
    share = float(np.max(error / positive_scale(spread, np.inf)))
    if not share > 0.05:
        return ()
    text = (
        f"{name}: the interpolant between runs has an error of {share:.0%} of the standard "
        f"deviation of the predicted responses; {remedy}."
    )
    return (Finding("rough-prediction", text, "likelihood_findings.md#predictions"),)


def known_outputs(
    simulators: Sequence[PopulationSimulator],
    response: Function,
    inputs: Inputs | None = None,
) -> Outputs | None:
    """Return the outputs of a simulator's response, or None if only a run can show them.

    With another vector of constants, such as times, a response may have other outputs.
    """
    vectors = None if inputs is None else _vectors(inputs)
    for node in simulators:
        if node.responses.function is response and vectors in (None, _vectors(node.inputs)):
            return node.outputs
    return None


def _vectors(inputs: Inputs) -> list[list[float]]:
    """Return the arguments that are vectors of constants."""
    return [x.ravel().tolist() for x in inputs.arguments if isinstance(x, np.ndarray)]


def _drawn_attributes(
    drawn: _Predicted, simulators: Sequence[PopulationSimulator], response: Function
) -> dict[str, Any]:
    """Return attributes of drawn responses; one of them if their readings have an error."""
    attrs = {"source": drawn.source, "specimens_id": array_digest(*drawn.specimens)}
    if drawn.error is not None:
        attrs |= {"emulator_error": drawn.error.tolist()}
    of_response = (s.metric for s in simulators if s.responses.function is response)
    if any(getattr(metric, "error", None) is not None for metric in of_response):
        attrs |= {"without_error": array_digest(drawn.values)}
    return attrs


def known_scatter(simulators: Sequence[PopulationSimulator], response: Function) -> float | None:
    """Return the scatter that a response may have; None if it is random in a simulator."""
    nodes = (node for node in simulators if node.responses.function is response)
    return None if any(node.responses.scatter is None for node in nodes) else 0.01


def serving(
    simulators: Sequence[PopulationSimulator], responses: Responses
) -> PopulationSimulator | None:
    """Return a simulator that has specimens of all inputs, if any; one with this response first."""
    inputs = responses.inputs
    if inputs.epistemic:
        return None
    able = []
    for simulator in simulators:
        aleatory = simulator.inputs.aleatory
        has_inputs = all(any(x is y for y in aleatory) for x in inputs.aleatory)
        if simulator.has_specimens and has_inputs:
            able.append(simulator)
    same = [simulator for simulator in able if responses.same_as(simulator.responses)]
    return next(iter([*same, *able]), None)


def _resampled_responses(
    node: Node,
    responses: Responses,
    points: NamedArrays,
    n: int,
    rng: np.random.Generator,
) -> _Predicted:
    """Return responses of n design points for each population, by systematic resampling."""
    bound = node.reweighted
    assert bound is not None
    parents = [points[str(rv.name)] for rv in bound.inputs.parents]
    try:
        values = bound.values_of(responses)
    except PoorEmulatorError:
        with designs_restored([bound]):
            bound.design = bound.design.runs_alone()
            return _resampled_responses(node, responses, points, n, rng)
    refuse_unsupported(node.name, bound, parents)
    _, weights = bound.populations(parents)
    levels = (np.arange(n) + rng.random((len(weights), 1))) / n
    rows = rng.permuted(reached(np.nan_to_num(weights), levels, normalized=True), axis=1)
    specimens = [x[rows] for x in bound.points_of(responses.inputs)]
    kind = "design points" if responses.count else "stored responses"
    return _Predicted(values[rows], specimens, f"{kind} of {node.name}")


def refuse_unsupported(name: str, design: ReweightedBound, parents: list[Floats]) -> None:
    """Raise if the design does not support most of the populations."""
    support = design.support(parents)
    # The lost mass is not checked here, because `_checked_responses` reports the share of NaN.
    if not shortcoming(support, design.required_ess, 1.0, design.n_points, TOLERABLE):
        return
    ess = np.median(support["weight_ess"])
    mass = np.median(support["mean_weight"])
    raise DesignError(
        f"{name}: got a weight effective sample size of {ess:.0f} and a mean raw weight of "
        f"{mass:.2f} (medians over the populations), expected {design.required_ess:.0f} and 1; "
        "call prb.refine(model) and sample again, or pass stored=False, which computes responses "
        "of new specimens"
    )


# -- the data of the calibration -------------------------------------------------------------------


def specimen_names(labels: ArrayLike) -> list[str]:
    """Return labels as texts; 3 and 3.0 have the same text."""
    return [
        str(int(label) if isinstance(label, float) and label.is_integer() else label)
        for label in np.asarray(labels).tolist()
    ]


def data_digest(observed: Floats) -> str:
    """Return a digest of measured values, (n,) or (n, m), that does not depend on their order."""
    return array_digest(observed[in_order(observed)])


def in_order(observed: Floats) -> Indices:
    """Return the order of measured values, which is lexicographic for several outputs."""
    if observed.ndim == 1:
        return np.argsort(observed, kind="stable")
    return np.lexsort(observed.T[::-1])


def array_digest(*arrays: Floats) -> str:
    """Return 16 hexadecimal digits of the bytes of arrays."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array, dtype=np.float64).tobytes())
    return digest.hexdigest()[:16]


def _calibration_attributes(result: Optimum | xr.DataTree, model: pm.Model) -> dict[str, list[str]]:
    """Return digests and specimen labels of the data of the calibration.

    The data are those of the result if it has them, and else those of the model.
    """
    stored = {}
    if isinstance(result, xr.DataTree) and "observed_data" in result:
        stored = one_posterior(result, "prb.predict")["observed_data"]
    is_optimum = isinstance(result, Optimum)
    simulators = result.evaluator.simulators if is_optimum else population_simulators(model)
    labels: dict[str, None] = {}  # labels in their order, each once
    digests = []
    for node in simulators:
        observed = stored.get(node.name, node.observed)
        digests.append(data_digest(np.asarray(observed)))
        if node.specimens is not None:
            labels |= dict.fromkeys(specimen_names(node.specimens))
    attributes = {"calibration_data": digests, "calibration_specimens": list(labels)}
    # netCDF has no empty lists.
    return {key: value for key, value in attributes.items() if value}


def provenance(result: Any, model: pm.Model) -> dict[str, Any]:
    """Return the fingerprint of the problem of a result, and versions of packages, for a table."""
    return {**as_attributes(identity_in(result) or identity_of(model)), **versions()}
