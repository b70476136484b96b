"""Populations of a result, and weighted samples of a response under each of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr
from numpy.typing import ArrayLike
from pytensor.graph.basic import Variable
from scipy.special import gammaincinv, ndtr, ndtri

from prbayes._display import Table, View, percentage
from prbayes._finding import Finding, Findings, as_json, report, sentences_of
from prbayes._stats import INTERVAL, ascending_quantile, tail_levels
from prbayes._validate import (
    AT_ONCE,
    ArrayFunction,
    Arrays,
    Floats,
    Function,
    Indices,
    NamedValues,
    StrPath,
    positive_integer,
    share,
)
from prbayes.decision.quantities import (
    Quantile,
    Quantity,
    refuse_quantity,
)
from prbayes.inference.asymptotics import oriented
from prbayes.model.emulated import (
    EmulatedSample,
    EmulatedSimulator,
    emulator_error,
    replaced_inputs,
)
from prbayes.model.evaluator import Evaluator, read_inputs_of_copy
from prbayes.model.locking import locked
from prbayes.model.parameters import parent_values, variables_at
from prbayes.numerics.points import inside, sobol
from prbayes.optimize.optimum import NO_RESPONSE, SMALLEST_SHARE, Optimum, require_sampling
from prbayes.posterior.nested import NestedFamily, nested_posterior
from prbayes.propagation.base import N_BLOCKS, DesignError
from prbayes.propagation.importance import new_specimens, through_inverses
from prbayes.propagation.reweighted import ReweightedBound
from prbayes.response.compile import compile_batched
from prbayes.response.discrepancy import findings_of
from prbayes.response.distributions import compiled_log_density
from prbayes.response.inputs import Inputs, refuse_several_populations
from prbayes.response.outputs import Outputs, is_missing
from prbayes.response.response import Responses
from prbayes.results.predict import (
    call_settings,
    known_outputs,
    known_scatter,
    model_of,
    named_response,
    provenance,
    refuse_unsupported,
    rough_emulator,
    serving,
    thetas_of,
)
from prbayes.results.products import evaluator_of_products, product_names

_TAILS = "tails.md#both-families"  # page of the findings on families

# Number of populations for checks and error estimates, whose quantiles then have an error of a few
# percent
N_CHECKED = 400


@dataclass(frozen=True, eq=False)
class Populations:
    """The populations that a result represents, as thetas."""

    result: Any
    evaluator: Evaluator
    # (k, d): draws of the posterior, or Sobol points of an optimum's sampling distribution
    thetas: Floats
    center: Floats  # (d,): median of the draws, or the optimum
    caller: str  # name of the caller, for messages
    are_draws: bool  # whether thetas are random draws, and not Sobol points
    # settings of responses that are not the model's own: executor, store and version
    calling: NamedValues = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        result: Any,
        model: pm.Model | None,
        n_draws: int,
        caller: str,
        calling: Mapping[str, Any] | None = None,
    ) -> Populations:
        """Read a result; raise if it is another model's, or an optimum without standard errors."""
        model = model_of(result, model, caller)
        calling = calling or {}
        if isinstance(result, Optimum):
            thetas = _sobol_thetas(result, n_draws, caller)
            evaluator = result.evaluator if model is result.model else Evaluator.of(model)
            return cls(result, evaluator, thetas, result.theta, caller, False, calling)
        evaluator = evaluator_of_products(result, model)
        thetas = thetas_of(result, evaluator, n_draws, caller)
        center = np.median(thetas, axis=0)
        return cls(result, evaluator, thetas, center, caller, True, calling)

    def provenance(self) -> dict[str, Any]:
        """Return the attributes of a table: the problem's fingerprint, and versions."""
        return provenance(self.result, self.evaluator.model)

    def thinned(self) -> Floats:
        """Return about `N_CHECKED` thetas, evenly spaced in their order."""
        return self.thetas[:: max(1, len(self.thetas) // N_CHECKED)]

    def parents(self, thetas: Floats, k: int, inputs: Inputs) -> list[Floats]:
        """Return the parents of inputs of the k-th simulator, or of others in their place."""
        if inputs is self.evaluator.simulators[k].inputs:
            return self.evaluator.parents(thetas, k)
        variables = variables_at(self.evaluator.hyperparameters, thetas)
        return parent_values(variables, inputs, None, ())

    def responses(self, response: Function, inputs: Sequence[Any]) -> Responses:
        """Return a response with its inputs, which are those of one population."""
        responses = self._responses(response, inputs)
        refuse_several_populations(f"{self.caller}: {responses.name}", responses.inputs.parents)
        return responses

    def _responses(self, response: Function, inputs: Sequence[Any]) -> Responses:
        name = named_response(response, self.calling, "write the response with def")
        sorted_inputs = read_inputs_of_copy(name, inputs, self.evaluator.model, function=response)
        simulators = self.evaluator.simulators
        outputs = known_outputs(simulators, response)
        scatter = known_scatter(simulators, response)
        return Responses(
            name,
            response,
            sorted_inputs,
            outputs=outputs,
            caller=self.caller,
            scatter=scatter,
            **self.calling,
        )

    @cached_property
    def _designs(self) -> dict[tuple[Any, ...], ReweightedBound | EmulatedSample]:
        return {}

    def sample(self, response: Function, inputs: Sequence[Any], output: Any) -> ResponseSample:
        """Return one output of a response at the design's specimens, computed where unknown."""
        sample = self.sample_of_all_outputs(response, inputs)
        return replace(sample, column=output_column(sample.responses, sample.outputs, output))

    def sample_of_all_outputs(self, response: Function, inputs: Sequence[Any]) -> ResponseSample:
        """Return all outputs of a response at the design's specimens.

        Raises TypeError if no simulator has specimens of these inputs, and DesignError if the
        design does not support the populations, or too many responses are NaN.
        """
        responses = self.responses(response, inputs)
        population = responses.inputs
        simulator = serving(self.evaluator.simulators, responses)
        replaced: dict[Variable, Variable] = {}
        if simulator is None:
            simulator, replaced = replaced_inputs(self.evaluator.emulated, responses)
            places = {new: old for old, new in replaced.items()}
            arguments = [
                places.get(x, x) if isinstance(x, Variable) else x for x in population.sources
            ]
            responses = self._responses(response, arguments)
        if simulator is None:
            advice = "prb.exceedance takes all with n_points=1000, prb.predict also model variables"
            if any(node.group for node in self.evaluator.nodes):
                advice += (
                    "; a metric has no specimens of a single group: leave metric= out of the "
                    "simulator, for the log-likelihood by specimen"
                )
            raise TypeError(
                f"{self.caller}: {responses.name}: got inputs without stored responses in any "
                "simulator of the model, expected the .dist() objects of one with "
                "prb.Reweighted() or prb.LogLikelihood(), for the latter also others of the same "
                f"names, and constants; {advice}"
            )
        k = self.evaluator.simulators.index(simulator)
        key = (k, *replaced.values())
        if key not in self._designs:
            if isinstance(simulator, EmulatedSimulator):
                of_sample = population if replaced else simulator.inputs
                parents = self.parents(self.thetas, k, of_sample)
                emulated = EmulatedSample.of(simulator, parents, of_sample, replaced)
                self._designs[key] = emulated
            elif simulator.reweighted is not None:
                self._designs[key] = simulator.reweighted
        design = self._designs[key]
        sample = ResponseSample(self, k, design, responses, design.values_of(responses), None)
        parents = sample.parents(self.thinned())
        if design.has_runs:
            refuse_unsupported(responses.name, design, parents)
        else:
            design.refuse_unsupported(responses.name, parents)
        if sample.lost > design.max_lost:
            raise DesignError(
                f"{responses.name}: lost mass: got {sample.lost:.1%} of a population's weight on "
                f"points whose response is NaN, expected at most {design.max_lost:.1%}; repair "
                "it, or return +inf for specimens that fail"
            )
        return sample


@dataclass(frozen=True, eq=False)
class NestedPopulations:
    """Populations under a simpler family that the data do not separate from that of the model."""

    populations: Populations
    family: NestedFamily
    probability: float  # posterior probability of the simpler family, if it is one half before

    @classmethod
    def of(cls, populations: Populations) -> tuple[NestedPopulations | None, Findings]:
        """Return the populations, or why they are not known; neither if the families are separate.

        Families are separate if the simpler one has a posterior probability below .05.
        """
        evaluator, least = populations.evaluator, 0.05
        family = NestedFamily.of(evaluator)
        if family is None:
            return None, ()
        obstacle, posterior = "", None
        by_metric = [node.name for node in evaluator.nodes if not node.metric.exact_likelihood]
        if not populations.are_draws:
            obstacle = "an optimum has no posterior of either; pass the result of prb.sample"
        elif by_metric:
            obstacle = f"that needs prb.LogLikelihood() in place of the metric of {by_metric[0]}"
        elif product_names(populations.result):
            obstacle = "that needs prb.sample of a model with the data of this product"
        else:
            posterior = nested_posterior(evaluator, family, populations.thetas)
        if posterior is None:
            obstacle = obstacle or "importance sampling of the simpler one is not reliable"
            text = (
                f"The {family.describe(0)} population of {', '.join(family.families)} was not "
                f"compared with a {family.describe(1)} one: {obstacle}."
            )
            return None, report(Finding("family-not-compared", text, _TAILS))
        if posterior.probability < least:
            return None, ()
        nested = replace(populations, thetas=posterior.thetas)
        return cls(nested, family, posterior.probability), ()

    @property
    def name(self) -> str:
        """The name of the simpler family."""
        return self.family.describe(1)

    def label(self, name: str) -> str:
        """Return the name of an input or a response under the simpler family."""
        return f"{name} ({self.name})"

    def finding(self, answers: str) -> Finding:
        """Return the finding that reports the answers under both families."""
        names = ", ".join(self.family.families)
        text = (
            f"The data do not separate the {self.family.describe(0)} population of {names} from a "
            f"{self.name} one (probability {self.probability:.2f} if both are equally probable "
            f"before the data): {answers}."
        )
        return Finding("two-families", text, _TAILS)


@dataclass(frozen=True, eq=False)
class ResponseSample:
    """A response at the points of a design, whose weights represent each population."""

    populations: Populations
    k: int  # index of the simulator with the design
    design: ReweightedBound | EmulatedSample
    responses: Responses
    outputs: Floats  # (n,) or (n, m): outputs at the design's points
    column: int | None  # column of the output; None for a response with one number

    def around(self, center: Floats) -> ResponseSample:
        """Return the sample with another centre of the populations, (d,)."""
        return replace(self, populations=replace(self.populations, center=center))

    def select(self, outputs: Floats) -> Floats:
        """Return the output, (..., n) or (..., n, m) -> (..., n)."""
        return outputs if self.column is None else outputs[..., self.column]

    @property
    def points(self) -> list[Floats]:
        """The specimens, shapes (n, *event), by input."""
        return list(self.design.points_of(self.design.inputs))

    def emulated(self, points: Arrays) -> list[Floats]:
        """Return the output of emulators at specimens, (n,) each: the best estimate first.

        The others differ from it by an estimate of its error: they lack a block of the runs each,
        or add the error of left-out runs, or the error beyond the runs' range. The list is empty if
        responses are stored and not emulated.
        """
        return [self.select(v) for v in self.design.emulated(self.responses, list(points))]

    @cached_property
    def _order(self) -> Indices:
        """The points that have a response, in ascending order of it."""
        values = self.select(self.outputs)
        order = np.argsort(values, kind="stable")
        return order[~np.isnan(values[order])]

    @cached_property
    def values(self) -> Floats:
        """The responses in ascending order, (n,)."""
        return self.select(self.outputs)[self._order]

    @cached_property
    def blocks(self) -> Indices:
        """The block of the design that each of the values is in, (n,)."""
        return self.design.blocks[self._order]

    def parents(self, thetas: Floats) -> list[Floats]:
        """Return the parents of populations, (k, d) -> (k, *shape) each."""
        return self.populations.parents(thetas, self.k, self.design.inputs)

    def masses(self, thetas: Floats) -> Floats:
        """Return weights of all points, also of those without response, (k, d) -> (k, n)."""
        return self.design.populations(self.parents(thetas))[1]

    def weights(self, thetas: Floats) -> Floats:
        """Return weights of the values in populations, (k, d) -> (k, n), with sum one."""
        weights = self.masses(thetas)[:, self._order]
        with np.errstate(invalid="ignore"):
            return weights / weights.sum(axis=1, keepdims=True)

    def weight_batches(self, thetas: Floats) -> Iterator[Floats]:
        """Yield the weights of as many populations at a time as fit into memory."""
        step = max(1, AT_ONCE // self.design.n_points)
        for first in range(0, len(thetas), step):
            yield self.weights(thetas[first : first + step])

    @cached_property
    def mean_weights(self) -> Floats:
        """The mean weights over all valid populations, (n,)."""
        total = np.zeros(self.values.size)
        for weights in self.weight_batches(self.populations.thetas):
            total += np.nansum(weights, axis=0)
        return total / total.sum()

    def evaluate(self, functional: Callable[[Floats, Floats], Floats], thetas: Floats) -> Floats:
        """Return a functional of populations, (k, d) -> (k, ...); NaN without a population.

        It is a function of the values and their weights, as `Quantity.of` is.
        """
        return np.concatenate([functional(self.values, w) for w in self.weight_batches(thetas)])

    @cached_property
    def lost(self) -> float:
        """The share of a population that has no response, the median over populations."""
        weights = self.masses(self.populations.thinned())
        return float(np.nanmedian(weights[:, is_missing(self.outputs)].sum(axis=1)))


def share_error(sample: ResponseSample, counts: ArrayFunction) -> Floats:
    """Return the error of the mean share of responses that count, by points and emulator.

    ``counts`` returns whether responses (n,) count, (n,) or (n, m) for m shares. The part by
    points is the jackknife over their blocks, or one over their effective number if none or all
    of them count. The part by emulators is the scatter of emulators without a block of the
    runs.
    """
    is_counted = counts(sample.values)
    weights = sample.mean_weights
    without = []
    for block in range(N_BLOCKS):
        rest = weights * (sample.blocks != block)
        without.append(rest @ is_counted / rest.sum())
    error = np.sqrt((N_BLOCKS - 1) * np.var(without, axis=0))
    is_weighted = is_counted[weights > 0]
    is_same = (is_weighted == is_weighted[0]).all(axis=0)
    error = np.where(is_same, (weights**2).sum(), error)
    outputs = sample.emulated(sample.points)
    if not outputs:
        return error
    mass = np.nanmean(sample.masses(sample.populations.thinned()), axis=0)
    means = np.array([mass @ counts(values) for values in outputs])
    squares = (means[1:] - means[0]) ** 2
    return np.asarray(np.hypot(error, np.sqrt(squares.sum(axis=0))))


def rough_sample(sample: ResponseSample) -> Findings:
    """Return a finding if the emulator of a response has a large error beside its spread."""
    if not isinstance(sample.design, EmulatedSample):
        return ()
    weights = sample.mean_weights * np.isfinite(sample.values)
    values = np.where(weights > 0, sample.values, 0.0)
    mean = weights @ values / weights.sum()
    spread = np.sqrt(weights @ (values - mean) ** 2 / weights.sum())
    error = np.atleast_1d(sample.select(emulator_error(sample.design, sample.responses)))
    remedy = (
        "compute the answer from prb.predict with stored=False, or a probability from "
        "prb.exceedance with n_points=1000, which call the response at new specimens"
    )
    return rough_emulator(sample.responses.name, error, np.atleast_1d(spread), remedy)


def left_out_findings(name: str, lost: float, answer: str) -> Findings:
    """Report a share of specimens without response, and what the ``answer`` says of them."""
    if lost < SMALLEST_SHARE:
        return ()
    text = (
        f"{name}: {lost:.1%} of specimens {NO_RESPONSE}: {answer}. A response that returns +inf "
        "counts as a specimen that failed."
    )
    return report(Finding("specimens-left-out", text, "distributed.md#when-a-response-fails"))


def checked_quantity(sample: ResponseSample, quantity: Quantity) -> tuple[Findings, float]:
    """Return findings, and the error of the quantity at the centre.

    Findings report a tail of few points, populations beyond the runs, specimens without response,
    and a model discrepancy beyond the data. Raises ValueError if no response is in the tail, or
    specimens failed.
    """
    caller, center = sample.populations.caller, sample.populations.center[None]
    findings = findings_of(quantity.response)
    others = "the quantity is that of the others"
    findings += left_out_findings(repr(quantity), sample.lost, others)
    findings += report(*rough_sample(sample))
    if quantity.needs_finite and np.isposinf(sample.values[-1]):
        raise ValueError(
            f"{caller}: {quantity!r}: got specimens that failed (+inf), expected finite "
            "responses; ask for a Quantile or an Exceedance"
        )
    (value,) = sample.evaluate(quantity.of, center)
    # Count responses that are equal to a quantile as beyond it, such as the largest one.
    at, side = np.nextafter(value, -np.inf), "beyond it"
    is_beyond = quantity.of_specimen(sample.values, at)
    if not np.isin(is_beyond, (0.0, 1.0)).all():
        error = _jackknife_error(sample, quantity)
        findings += _beyond_runs(sample, quantity) + _inaccurate(sample, quantity, error)
        return findings, error
    share = float(sample.mean_weights @ is_beyond)
    is_upper = share <= 0.5
    if not is_upper:  # because the rarer side decides how well the quantity is known
        at, side = np.nextafter(value, np.inf), "on its other side"
        share = float(sample.mean_weights @ (1 - quantity.of_specimen(sample.values, at)))
    error = float(share_error(sample, lambda values: quantity.of_specimen(values, at)))
    more = "pass more responses to the propagation"
    if not sample.design.has_runs:
        more = "compute it from prb.predict with stored=False"
    advice = f"{more}, or ask for a less rare quantity"
    if share == 0:
        raise ValueError(
            f"{caller}: {quantity!r}: got no response {side}, of {1 / error:.0f} effective "
            f"points, expected some; {advice}"
        )
    if error > 0.3 * share:
        text = (
            f"{quantity!r}: the share of responses {side}, {share:.2g}, has a standard error "
            f"of {error:.2g}, which limits the accuracy of the quantity; {advice}."
        )
        findings += report(Finding("rough-probability", text))
    if not isinstance(quantity, Quantile):
        return findings, error
    findings += _beyond_runs(sample, quantity)
    (weights,) = sample.weights(center)
    is_beyond = quantity.of_specimen(sample.values, at)
    if not sample.design.on_line:  # because the jackknife of few points in a tail is itself rough
        rare = weights * (is_beyond if is_upper else 1 - is_beyond)
        error = max(error, float(np.linalg.norm(rare)))
    tails = probability_bounds(share, error, float(ndtr(-1)))
    tails *= min(quantity.probability, 1 - quantity.probability) / share
    ends = ascending_quantile(sample.values, weights, 1 - tails if is_upper else tails)
    error = float(np.abs(ends - value).max())
    if not sample.design.has_runs:
        error = float(np.hypot(error, _range_effect(sample, quantity, center)[0]))
    return findings + _inaccurate(sample, quantity, error), error


def _inaccurate(sample: ResponseSample, quantity: Quantity, error: float) -> Findings:
    """Report an error of the computation that is not small beside the scatter of populations."""
    spread = standard_deviation(sample.evaluate(quantity.of, sample.populations.thinned()))
    share = getattr(quantity, "probability", 0.5)
    if isinstance(sample.design, EmulatedSample) and not sample.design.has_tails:
        text = (
            f"{quantity!r}: an input depends on others, or PyMC has no (inverse) distribution "
            "function of it, so that few points are in the tails of wide populations: ends of "
            "intervals may be .6 standard deviations off. Pass the result of prb.predict with "
            "n_samples=8192 to prb.population."
        )
        if min(share, 1 - share) < 0.05:
            return report(Finding("rough-probability", text))
    if not error > 0.5 * spread > 0:
        return ()
    text = (
        f"{quantity!r}: the computation has an error of {error / spread:.0%} of the standard "
        "deviation over the populations; compute it from prb.predict with stored=False and "
        "n_samples=8192."
    )
    return report(Finding("rough-probability", text))


def _jackknife_error(sample: ResponseSample, quantity: Quantity) -> float:
    """Return the error of a quantity at the centre, by points and emulator."""
    center = sample.populations.center[None]
    is_kept = sample.blocks != np.arange(N_BLOCKS)[:, None]
    rest = sample.weights(center) * is_kept
    without = quantity.of(sample.values, rest / rest.sum(axis=1, keepdims=True))
    variance = (N_BLOCKS - 1) * np.var(without)
    outputs = sample.emulated(sample.points)
    if outputs:
        mass = sample.masses(center)
        quantities = np.array([_of_unsorted(quantity, values, mass)[0] for values in outputs])
        variance += ((quantities[1:] - quantities[0]) ** 2).sum()
    return float(np.sqrt(variance))


def _beyond_runs(sample: ResponseSample, quantity: Quantity) -> Findings:
    """Return a finding if the constant response beyond the runs limits a quantity."""
    if sample.design.has_runs:
        return ()
    thetas = sample.populations.thinned()
    change = standard_deviation(_range_effect(sample, quantity, thetas)) / 2
    if not change > 0.1 * standard_deviation(sample.evaluate(quantity.of, thetas)):
        return ()
    text = (
        f"{quantity!r}: some populations extend beyond the range of the runs, where the response "
        "is taken as constant. With the slope at the end of the range the quantity of a "
        f"population would be different by about {change:.1g}, and its interval too; compute it "
        "from prb.predict with stored=False, which calls the response there."
    )
    return report(Finding("beyond-runs", text, "decision.md#the-population-in-units"))


def _range_effect(sample: ResponseSample, quantity: Quantity, thetas: Floats) -> Floats:
    """Return by how much a steeper response beyond the runs changes a quantity, (k,)."""
    mass = sample.masses(thetas)
    constant, *_, steeper = sample.emulated(sample.points)
    with np.errstate(invalid="ignore"):  # because both may be infinite
        return _of_unsorted(quantity, steeper, mass) - _of_unsorted(quantity, constant, mass)


def _of_unsorted(quantity: Quantity, values: Floats, weights: Floats) -> Floats:
    """Return a quantity of responses in any order, (n,), by population; NaN are left out."""
    order = np.argsort(values)[: np.isfinite(values).sum()]
    weights = weights[:, order]
    with np.errstate(invalid="ignore"):
        return quantity.of(values[order], weights / weights.sum(axis=1, keepdims=True))


def standard_deviation(by_draw: Floats) -> float:
    """Return the standard deviation over draws; infinite if one draw is infinite."""
    if np.isinf(by_draw).any():
        return np.inf
    return float(np.nanstd(by_draw))


def quantiles_of(by_draw: Floats, levels: Sequence[float]) -> Floats:
    """Return quantiles of draws, (n,), of which some may be infinite."""
    # Do not interpolate between infinite neighbours, whose mean is NaN.
    method: Any = "inverted_cdf" if np.isinf(by_draw).any() else "linear"
    return np.quantile(by_draw, levels, method=method)


def probability_bounds(probability: ArrayLike, error: ArrayLike, tail: float) -> Floats:
    r"""Return the bounds of probabilities that leave out ``tail`` on each side, (2, ...).

    They are those of a Poisson mean (Garwood 1936), for :math:`(p / error)^2` events: for many the
    normal ones, and for none of n points, with an error of 1 / n, the rule of three.
    """
    probability, error = np.asarray(probability, dtype=float), np.asarray(error, dtype=float)
    rare = np.minimum(probability, 1 - probability)
    has_events = rare > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        n_events = np.where(has_events, (rare / error) ** 2, 0.0)
        by_event = np.where(has_events, error**2 / rare, error)
    # With so many events the bounds are the normal ones to a thousandth of an error.
    is_normal = n_events > 1e6
    n_events = np.where(is_normal, 1.0, n_events)
    low = np.where(has_events, by_event * gammaincinv(np.maximum(n_events, 1e-9), tail), 0.0)
    high = by_event * gammaincinv(n_events + 1, 1 - tail)
    low = np.where(is_normal, rare + ndtri(tail) * error, low)
    high = np.minimum(np.where(is_normal, rare - ndtri(tail) * error, high), 1.0)
    bounds = np.array([low, high])
    return np.where(probability > 0.5, 1 - bounds[::-1], bounds)


class CentralSpecimens:
    """A response at few specimens of the central population, the same for all constant inputs."""

    def __init__(
        self,
        populations: Populations,
        response: Function,
        output: Any,
        n_runs: int,
    ) -> None:
        self.populations, self.response, self.output = populations, response, output
        # The search calls the response 64 times at these specimens, which costs about four times
        # the runs.
        self.size = min(max(n_runs // 16, 4), 32)
        self.count = 0  # number of responses computed
        self.inputs: tuple[list[Floats], list[Floats]] | None = None

    def __call__(self, inputs: Sequence[Any]) -> Floats:
        """Return the output at the specimens, (size,)."""
        responses = self.populations.responses(self.response, inputs)
        outputs = responses(*self._specimens(responses))[0]
        self.count += responses.count
        column = output_column(responses, outputs, self.output)
        return np.asarray(outputs if column is None else outputs[:, column])

    def _specimens(self, responses: Responses) -> tuple[list[Floats], list[Floats]]:
        """Return the inputs of the specimens."""
        if self.inputs is None:
            evaluator = self.populations.evaluator
            center = variables_at(evaluator.hyperparameters, self.populations.center[None])
            parents = [center[str(rv.name)] for rv in responses.inputs.parents]
            rng = np.random.default_rng(0)
            self.inputs = new_specimens(responses.name, responses.inputs, parents, self.size, rng)
        return self.inputs


class InverseTransform:
    """The aleatory inputs of one population as functions of standard normal numbers z.

    The inputs are inverse distribution functions at Phi(z). A distribution without one, or one that
    depends on another input, raises TypeError.
    """

    def __init__(self, name: str, inputs: Inputs, parents: Sequence[Floats]) -> None:
        self.inputs = inputs
        self.parents = parents  # parents of the population, shapes (1, *shape)
        sizes = [int(np.prod(shape, dtype=int)) for shape in inputs.event_shapes]
        ends = np.cumsum([0, *sizes]).tolist()
        self.columns = [slice(a, b) for a, b in pairwise(ends)]  # columns of z, by input
        self.size = ends[-1]
        symbols = inputs.placeholders()
        uniforms = [pt.tensor(dtype="float64", shape=(None, *s)) for s in inputs.event_shapes]
        quantiles, epistemic = through_inverses(name, inputs, symbols, uniforms)
        self._function = compile_batched([*symbols, *uniforms], [*quantiles, *epistemic])

    @cached_property
    def _log_density(self) -> Any:
        return compiled_log_density(self.inputs)

    def __call__(self, z: Floats) -> list[Floats]:
        """Return the aleatory inputs, shapes (n, *event), of z (n, size)."""
        return self._of_populations(self.parents, z)

    def _of_populations(self, parents: Arrays, z: Floats) -> list[Floats]:
        """Return the aleatory inputs of k populations at z (n, size), shapes (k n, *event)."""
        shapes = self.inputs.event_shapes
        k = len(parents[0]) if parents else 1
        uniforms = [
            np.repeat(inside(ndtr(z[:, columns])).reshape(1, len(z), *shape), k, axis=0)
            for columns, shape in zip(self.columns, shapes, strict=True)
        ]
        values = self._function(*parents, *uniforms)[: len(shapes)]
        return [
            np.broadcast_to(v, (k, len(z), *shape)).reshape(-1, *shape)
            for v, shape in zip(values, shapes, strict=True)
        ]

    def has_support_of(self, parents: Arrays) -> bool:
        """Return whether the population has a density wherever the k populations of parents do.

        Their ends are compared, five standard deviations of z from the middle.
        """
        ends = self._of_populations(parents, np.array([[-5.0], [5.0]]) * np.ones(self.size))
        return not np.isneginf(self.log_density(self.parents, ends)).any()

    def log_density(self, parents: Sequence[Floats], x: Sequence[Floats]) -> Floats:
        """Return log-densities of inputs in the populations of parents, (k, n)."""
        return np.asarray(self._log_density(*parents, *x)[0])

    def responses(self, responses: Responses, z: Floats) -> Floats:
        """Call a response at z (n, size); return (n,) or (n, m)."""
        x = self(z)
        positions = [id(variable) for variable in self.inputs.aleatory]
        return responses([x[positions.index(id(v))] for v in responses.inputs.aleatory], [])


def _sobol_thetas(optimum: Optimum, n: int, caller: str) -> Floats:
    """Return Sobol points of the sampling distribution of an optimum, (n, d)."""
    require_sampling(optimum, caller)
    covariance = optimum.covariance
    if not np.isfinite(covariance).all():
        is_known = np.isfinite(np.diag(covariance))
        unknown = [
            name
            for name, is_ok in zip(optimum.evaluator.hyperparameters.names, is_known, strict=True)
            if not is_ok
        ]
        raise ValueError(
            f"{caller}: got an optimum without the uncertainty of {unknown}, expected "
            "a standard error of each; pass the posterior of prb.sample_smc"
        )
    z = ndtri(sobol(n, optimum.theta.size, seed=0))
    values, vectors = np.linalg.eigh(covariance)
    root = oriented(vectors) * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(optimum.theta + z @ root.T)


def answers_by_family(
    sample: ResponseSample, question: str, answer: Callable[[ResponseSample], str]
) -> Findings:
    """Report the answers to a question under the families that the data do not separate."""
    nested, findings = NestedPopulations.of(sample.populations)
    if nested is None:
        return findings
    simpler = replace(sample, populations=nested.populations)
    answers = f"{answer(sample)}, or {answer(simpler)} under the {nested.name} family"
    return report(nested.finding(f"{question} {answers}"))


def checked_by_family(
    sample: ResponseSample, quantity: Quantity, prob: float = INTERVAL
) -> tuple[Findings, float]:
    """Return findings, also of the families that the data do not separate, and the error."""

    def answer(sample: ResponseSample) -> str:
        by_draw = sample.evaluate(quantity.of, sample.populations.thetas)
        by_draw = by_draw[~np.isnan(by_draw)]
        lower, upper = quantiles_of(by_draw, tail_levels(prob))
        interval = f"{percentage(prob)} interval {lower:.4g} to {upper:.4g}"
        return f"{by_draw.mean():.4g} ({interval})"

    findings, error = checked_quantity(sample, quantity)
    return findings + answers_by_family(sample, "the quantity is", answer), error


def output_column(responses: Responses, values: Floats, output: Any) -> int | None:
    """Return the column of an output, or None for a response with one number; or raise."""
    if values.ndim == 1:
        if output is not None:
            raise ValueError(
                f"{responses.name}: output: got {output!r} of a response with one output, expected "
                "None; leave output= out"
            )
        return None
    outputs = responses.outputs or Outputs(tuple(range(values.shape[1])))
    labels, names = list(outputs.labels), list(outputs.names)
    if output is None:
        raise ValueError(
            f"{responses.name}: got a response of {len(labels)} outputs, expected output= to say "
            f"which, of {names[:9]}"
        )
    for identifiers in (labels, names):
        if output in identifiers:
            return identifiers.index(output)
    raise KeyError(f"{responses.name}: output: got {output!r}, expected one of {labels[:9]}")


@locked
def evaluate(
    result: Optimum | xr.DataTree,
    quantity: Quantity,
    *,
    model: pm.Model | None = None,
    prob: float = INTERVAL,
    n_draws: int = 2000,
    executor: Executor | None = None,
    store: StrPath | None = None,
    version: str | None = None,
) -> QuantityTable:
    """Return a decision quantity with its interval.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`, with its sampling distribution; or with a ``posterior`` group, from any
        sampler.
    quantity : Quantity
        Such as ``prb.decision.Quantile(response, x, probability=0.99)``. A response other than a
        simulator's is computed once for each run of the design, unless `predict` has computed it;
        under the log-likelihood by specimen also at 16 to 64 specimens of the populations.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    prob : float
        Probability of the interval, which has equal tails.
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
        In the units of the quantity ``estimate`` (at the optimum, or the posterior mean), ``lower``
        and ``upper``; ``error``, the standard error at the centre from the points and the emulator;
        and ``by_draw``, with dimension ``draw``. It prints as sentences; a notebook shows a table.
        Attributes: ``prob``, ``quantity``, ``responses`` (number computed), ``findings`` (as JSON)
        and ``identity``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, the result is another model's, or the inputs have no
        stored responses.
    DesignError
        If the design does not support the populations.
    ResponseError
        If the response raises, or has the wrong shape.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     data = np.random.default_rng(1).normal(0, 1, 50)
    ...     y = prb.Simulator("y", lambda x: x, x, metric=prb.AreaMetric(), observed=data)
    >>> median = prb.decision.Quantile(np.exp, x, probability=0.5)
    >>> table = prb.decision.evaluate(prb.minimize(model), median)
    >>> bool(table.lower < table.estimate < table.upper)
    True
    """
    caller = "prb.decision.evaluate"
    refuse_quantity(quantity, caller)
    prob = share(prob, "prob")
    positive_integer(n_draws, "n_draws", minimum=2)
    calling = call_settings(executor, store, version)
    populations = Populations.of(result, model, n_draws, caller, calling)
    sample = populations.sample(quantity.response, quantity.inputs, quantity.output)
    findings, error = checked_by_family(sample, quantity, prob)
    by_draw = sample.evaluate(quantity.of, populations.thetas)
    (center,) = sample.evaluate(quantity.of, populations.center[None])
    lower, upper = quantiles_of(by_draw[~np.isnan(by_draw)], tail_levels(prob))
    return QuantityTable(
        {
            "estimate": np.nanmean(by_draw) if populations.are_draws else center,
            "lower": lower,
            "upper": upper,
            "error": error,
            "by_draw": ("draw", by_draw),
        },
        attrs={
            "prob": prob,
            "quantity": repr(quantity),
            "responses": sample.responses.count,
            "findings": as_json(findings),
            **populations.provenance(),
        },
    )


class QuantityTable(Table):
    """A decision quantity with its interval."""

    __slots__ = ()
    _parts = ("estimate", "lower", "upper", "error", "draw", "prob", "quantity")
    _columns = ("estimate", "lower", "upper", "error")

    def to_view(self) -> View:
        """Return what a reader sees."""
        estimate, lower, upper = (float(self[key]) for key in self._columns[:3])
        rows = [
            ["standard error of the computation", f"{float(self['error']):.1g}"],
            ["responses computed", str(self.attrs["responses"])],
        ]
        heading = (
            f"{self.attrs['quantity']}: {estimate:.4g}, {percentage(self.attrs['prob'])} interval "
            f"{lower:.4g} to {upper:.4g}"
        )
        sentences = sentences_of(self.attrs)
        return View(heading, rows=rows, sentences=sentences)
