"""Evaluator of a PyMC model: theta (P, d) -> log prior (P,), discrepancies (P, k), gradients.

It says as well whether a design supports the populations at theta, and where it falls short.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pytensor.graph.traversal import ancestors

from prbayes._validate import (
    AT_ONCE,
    IN_CACHE,
    Bools,
    Floats,
    Function,
    NamedArrays,
    wrong_value,
)
from prbayes.metrics.area import with_unbiased_areas
from prbayes.metrics.base import Discrepancy, Metric
from prbayes.model.emulated import EmulatedSimulator, PopulationSimulator, emulated_simulators
from prbayes.model.measurement import Measurement, SpecimenLikelihood, specimen_numbers
from prbayes.model.parameters import Hyperparameters, value_shapes, variables_at
from prbayes.model.random_variable import (
    Node,
    ObservedRV,
    SimulatorRV,
    building,
    common_targets,
    log_kernel,
    nodes,
)
from prbayes.model.simulator_with_data import SimulatorWithData
from prbayes.model.specimen_likelihood import (
    all_simulators,
    log_likelihoods,
    require_simulator,
    specimen_likelihoods,
)
from prbayes.model.specimen_preparation import refuse_changed_runs
from prbayes.propagation.base import responding_weights
from prbayes.propagation.importance import SIZES
from prbayes.propagation.reweighted import ReweightedBound
from prbayes.response.budget import budget
from prbayes.response.compile import compiled, interpreted, ninf_for_invalid, with_shared_arrays
from prbayes.response.inputs import Inputs, is_known, read_inputs
from prbayes.response.response import repeats_of

# Number of points of a design from which on samplers start with an eighth of the points.
_LARGE = SIZES.first


@dataclass(frozen=True)
class Evaluation:
    """Terms of the log posterior of a batch of thetas."""

    log_prior: Floats  # (P,): log-density of the prior, with the Jacobian of the transforms
    log_other: Floats  # (P,): log-likelihood of ordinary observed variables, and potentials
    # (P, k): a column for each simulator; +inf where a population is invalid or has no support.
    discrepancies: Floats
    # (P, k): share of a population's weight on points without response. It is NaN where the
    # population is invalid, and for stored responses, whose support reports the share.
    lost: Floats

    def log_likelihood(self, epsilon: Floats) -> Floats:
        """Return the pseudo log-likelihood, shape (P,), for epsilons of shape (k,)."""
        kernels = np.asarray(log_kernel(self.discrepancies, epsilon))
        return np.asarray(self.log_other + kernels.sum(axis=-1))


@dataclass(frozen=True, eq=False)
class Evaluator:
    """Simulators, likelihoods and hyperparameters of a model, compiled for batches of thetas."""

    model: pm.Model
    hyperparameters: Hyperparameters  # names, transforms and prior of theta
    nodes: tuple[Node, ...]  # simulators with a metric of distributions
    # Simulators with a log-likelihood by specimen, whose populations are emulated; an entry for
    # each group.
    emulated: tuple[EmulatedSimulator, ...]
    # Whether the nodes have the data and designs of the model. Then the graph of the model is the
    # objective.
    has_graph: bool = True
    # Compiled functions, shared by copies.
    functions: dict[Any, Any] = field(default_factory=dict, repr=False)
    # Likelihoods; simulators with common specimens share one.
    likelihoods: tuple[SpecimenLikelihood, ...] = field(init=False)
    # Simulators with a log-likelihood by specimen, not divided into groups.
    measurements: tuple[Measurement, ...] = field(init=False)
    # The nodes, then an entry for each group of the simulators whose responses are emulated.
    simulators: list[PopulationSimulator] = field(init=False, repr=False)
    # Designs with stored runs by the simulator's name.
    reweighted: dict[str, ReweightedBound] = field(init=False, repr=False)
    responses_per_theta: int = field(init=False)  # number of scalar responses of one theta

    def __post_init__(self) -> None:
        """Set the attributes that follow from the simulators and the model."""
        vars(self).update(
            likelihoods=tuple(dict.fromkeys(e.likelihood for e in self.emulated)),
            measurements=tuple(dict.fromkeys(e.measurement for e in self.emulated)),
            simulators=[*self.nodes, *self.emulated],
            reweighted={n.name: n.reweighted for n in self.nodes if n.reweighted is not None},
            responses_per_theta=sum(node.bound.n_per_theta for node in self.nodes),
        )

    @classmethod
    def of(cls, model: pm.Model) -> Evaluator:
        """Return the evaluator of a model with at least one `Simulator`."""
        require_simulator(model)
        refuse_replaced_expressions(model)
        # Raises for an invalid model before its first runs.
        hyperparameters = Hyperparameters.of(model)
        computed = tuple(nodes(model).values())
        evaluator = cls(model, hyperparameters, computed, tuple(emulated_simulators(model)))
        for likelihood in evaluator.likelihoods:
            likelihood.cache["hyperparameters"] = weakref.ref(hyperparameters)
        return evaluator

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the model by cloudpickle, because models of PyMC cannot be pickled otherwise."""
        import cloudpickle

        targets = None if self.has_graph else [node.target for node in self.nodes]
        return _unpickled, (cloudpickle.dumps((self.model, targets)),)

    @property
    def n_responses(self) -> int:
        """Number of scalar responses that were computed; shared responses count once."""
        # Number of responses by the id of the runs, which simulators may share.
        counts: dict[int, int] = {}
        for node in self.nodes:
            runs = id(node.responses.runs)
            counts[runs] = max(node.responses.count, counts.get(runs, 0))
        return sum(counts.values()) + sum(m.responses.count for m in self.measurements)

    def log_other(
        self, thetas: Floats, likelihoods: Sequence[SpecimenLikelihood] | None = None
    ) -> Floats:
        """Return log-likelihoods by specimen, of other observed variables, and potentials, (P,).

        The log-likelihoods by specimen are those of the model unless others are given.
        """
        total = np.zeros(len(thetas))
        for likelihood in self.likelihoods if likelihoods is None else likelihoods:
            values = variables_at(self.hyperparameters, thetas)
            # Populations are evaluated in blocks, so that memory stays bounded with many specimens.
            step = max(1, AT_ONCE // len(likelihood.readings))
            for first in range(0, len(thetas), step):
                rows = slice(first, first + step)
                at_rows = {name: value[rows] for name, value in values.items()}
                # A population far narrower than its distance has a sum of -inf.
                with np.errstate(over="ignore"):
                    total[rows] += log_likelihoods(likelihood, at_rows).sum(axis=1)
        observed = self.model.observed_RVs
        variables = [rv for rv in observed if not isinstance(rv.owner.op, ObservedRV)]
        if variables or self.model.potentials:
            if "log_other" not in self.functions:
                graph = _log_other(self.model, variables)
                self.functions["log_other"] = self.hyperparameters.compile([graph])
            (terms,) = self.functions["log_other"](np.ascontiguousarray(thetas))
            total = total + terms
        return total

    def discrepancies(self, thetas: Floats, k: int, target: Discrepancy | None = None) -> Floats:
        """Return the k-th simulator's discrepancies, shape (P,), or those from another target."""
        budget().check()
        node = self.nodes[k]
        return node.discrepancies(self.parents(thetas, k), target or node.target)

    def __call__(self, thetas: Floats) -> Evaluation:
        """Evaluate a batch, shape (P, d); an invalid theta does not affect the rest."""
        size = len(thetas)
        rows_at_once = [AT_ONCE // max(1, node.bound.n_points) for node in self.nodes]
        step = max(1, min(rows_at_once, default=size))
        log_prior = np.empty(size)
        log_other = np.empty(size)
        discrepancies = np.empty((size, len(self.nodes)))
        lost = np.empty_like(discrepancies)
        for first in range(0, size, step):
            rows = slice(first, first + step)
            block = np.ascontiguousarray(thetas[rows])
            log_prior[rows] = self.hyperparameters.log_prior(block)
            log_other[rows] = self.log_other(block)
            for i, node in enumerate(self.nodes):
                discrepancies[rows, i] = self.discrepancies(block, i)
                lost[rows, i] = node.bound.last_missing.lost
        log_prior[np.isnan(log_prior)] = -np.inf
        log_other[np.isnan(log_other)] = -np.inf
        discrepancies[np.isnan(discrepancies)] = np.inf
        return Evaluation(log_prior, log_other, discrepancies, lost)

    def total(self, thetas: Floats, scales: Floats) -> Floats:
        """Return the sum of d_k / scale_k - log of ordinary terms, shape (P,).

        +inf outside the priors' support.
        """
        terms = self(thetas)
        with np.errstate(invalid="ignore"):
            scaled = terms.discrepancies / scales
            value = scaled.sum(axis=-1) - terms.log_other
        is_finite = np.isfinite(terms.log_prior) & np.isfinite(value)
        return np.where(is_finite, value, np.inf)

    def observing(
        self,
        data: NamedArrays,
        metric: Metric | None = None,
        weights: NamedArrays | None = None,
    ) -> Evaluator:
        """Return an evaluator of the same model with other observed responses, by simulator.

        Metrics choose bandwidths and cells again; designs and epsilons are the same objects.
        Weights are by default those of the model for as many responses.
        """
        targets = []
        for node in self.nodes:
            observed = data[node.name]
            counted = None if weights is None else weights[node.name]
            if weights is None and np.shape(observed) == node.observed.shape:
                counted = node.weights
            target = (metric or node.metric).against(observed, counted)
            targets.append(target.metric.for_inputs(target, node.bound.inputs.dimensions))
        return with_targets(self, common_targets(self.nodes, targets))

    def parents(self, thetas: Floats, k: int) -> list[Floats]:
        """Return the values of the parents of the k-th of `simulators`, shapes (P, *shape)."""
        if k >= len(self.nodes):
            simulator = self.emulated[k - len(self.nodes)]
            values = variables_at(self.hyperparameters, thetas)
            numbers = specimen_numbers(simulator.likelihood, simulator.measurement)
            return simulator.likelihood.parents(values, simulator.place, numbers[simulator.rows])
        key = ("parents", *(node.name for node in self.nodes))
        if key not in self.functions:
            params = _simulator_params(self)
            graphs = self.model.replace_rvs_by_values([p for group in params for p in group])
            ends = np.cumsum([0, *map(len, params)])
            self.functions[key] = self.hyperparameters.compile(graphs), ends
        function, ends = self.functions[key]
        parents = function(np.ascontiguousarray(thetas))[ends[k] : ends[k + 1]]
        return [np.broadcast_to(p, (len(thetas), *np.shape(p)[1:])) for p in parents]

    def populations(self, thetas: Floats, k: int) -> tuple[Floats, Floats]:
        """Return responses and weights, (P, n) each, of populations of the k-th of `simulators`.

        As metrics compare them: points without response have no weight.
        """
        values, weights = self.simulators[k].populations(self.parents(thetas, k))
        return values, responding_weights(values, weights)

    def support(self, thetas: Floats) -> dict[str, NamedArrays]:
        """Return how well each design supports the populations at thetas, arrays of shape (P,)."""
        by_name = {}
        for k, node in enumerate(self.nodes):
            bound = node.reweighted
            if bound is None:
                continue
            # Populations are evaluated in blocks, because their weights at all points need memory.
            step = max(1, IN_CACHE // bound.n_points)
            parts = []
            for first in range(0, max(1, len(thetas)), step):
                parents = self.parents(thetas[first : first + step], k)
                parts.append(bound.support(parents))
            by_name[node.name] = {
                key: np.concatenate([part[key] for part in parts]) for key in parts[0]
            }
        return by_name


def epsilons(evaluator: Evaluator) -> Floats:
    """Return the simulators' epsilons, shape (k,), NaN where unset."""
    return np.array([node.epsilon_value for node in evaluator.nodes])


def compiled_objective(evaluator: Evaluator, *, prior: bool, gradient: bool) -> Any:
    """Compile the objective as a function of theta and scales.

    (theta, scales) -> sum of d_k / scale_k [- log prior] - log of ordinary terms [, gradient].

    The prior's density is in the user's own units, as in `pymc.find_MAP`: without Jacobian.
    Raise NotImplementedError or TypeError if the objective has no gradient.
    """
    model = evaluator.model
    if not evaluator.has_graph:
        if prior or gradient:
            raise NotImplementedError("on other data the objective is evaluated, not compiled")
        return lambda theta, scales: (evaluator.total(theta[None], scales)[0],)
    key = ("objective", prior, gradient)
    if key not in evaluator.functions:
        with interpreted():
            graphs = [
                pt.as_tensor(node.bound.discrepancy(params))
                for node, params in zip(evaluator.nodes, _simulator_params(evaluator), strict=True)
            ]
            graphs = model.replace_rvs_by_values(graphs)
            for k, node in enumerate(evaluator.nodes):
                if node.bound.stored:
                    graphs[k] = with_shared_arrays(graphs[k])
            scales = pt.dvector("scales")
            scaled = sum(graph / scales[k] for k, graph in enumerate(graphs))
            total = scaled - _log_other(model, _ordinary(model))
            with building("priors"):
                log_prior = model.logp(vars=model.free_RVs, jacobian=False)
            value = pt.switch(log_prior > -np.inf, total - log_prior if prior else total, np.inf)
            (value,), theta = evaluator.hyperparameters.joined([value])
            outputs = [value, pt.grad(value, theta)] if gradient else [value]
            evaluator.functions[key] = compiled([theta, scales], ninf_for_invalid(outputs))
    function = evaluator.functions[key]
    symbolic = [node.bound for node in evaluator.nodes if node.bound.symbolic]

    def counted(theta: Floats, scales: Floats) -> Any:
        budget().check()
        for bound in symbolic:
            bound.responses.count_symbolic(bound.n_per_theta)
        return function(theta, scales)

    return counted


def with_unchanged_runs(evaluator: Evaluator) -> Evaluator:
    """Return an evaluator; raise if a response differs from its runs after a change."""
    for bound in evaluator.reweighted.values():
        if bound.responses.may_differ:
            bound.values_of(bound.responses)  # raises after a change
    for likelihood in evaluator.likelihoods:
        refuse_changed_runs(likelihood)
    return evaluator


def _unpickled(payload: bytes) -> Evaluator:
    """Restore an evaluator from its pickle."""
    import cloudpickle

    model, targets = cloudpickle.loads(payload)
    evaluator = Evaluator.of(model)
    return evaluator if targets is None else with_targets(evaluator, targets)


def with_targets(evaluator: Evaluator, targets: list[Discrepancy]) -> Evaluator:
    """Return an evaluator of the same model with other prepared metrics, by simulator."""
    if len(targets) > 1:
        targets = [with_unbiased_areas(target) for target in targets]
    pairs = zip(evaluator.nodes, targets, strict=True)
    changed = tuple(replace(node, target=target) for node, target in pairs)
    return replace(evaluator, nodes=changed, has_graph=False)


def has_other_terms(model: pm.Model) -> bool:
    """Return whether a model has terms other than metrics of distributions, and priors."""
    return bool(_ordinary(model) or model.potentials)


def _ordinary(model: pm.Model) -> list[Any]:
    """Return the observed variables without a metric of distributions."""
    return [rv for rv in model.observed_RVs if not isinstance(rv.owner.op, SimulatorRV)]


# Inputs in a copy of a model.


def read_inputs_of_copy(
    name: str,
    inputs: Sequence[Any],
    model: pm.Model,
    *,
    fixed: bool = False,
    function: Function | None = None,
) -> Inputs:
    """Sort the inputs of a response, as `read_inputs`.

    Inputs may be those of the model's simulators, also where `pymc.do`, `pymc.observe` or a clone
    made the model: its simulators have the variables of the first one. A random ``function`` of
    a simulator has the simulator's noise as a further input.
    """
    records = [record.responses for record in all_simulators(model).values()]
    parents = [v for record in records for v in record.inputs.parents]
    originals = [v for v in dict.fromkeys(parents) if not is_known(v)]
    if function is not None and repeats_of(function) > 1:
        noises = [r.inputs.aleatory[-1] for r in records if r.function is function]
        if not noises:
            raise wrong_value(
                function,
                name,
                "the random response of a simulator of the model, whose distribution is "
                "emulated; pass that very object",
            )
        inputs = [*(x for x in inputs if x is not noises[0]), noises[0]]
    return read_inputs(name, inputs, model, fixed=fixed, originals=originals)


def refuse_replaced_expressions(model: pm.Model) -> None:
    """Refuse `pymc.do` of an expression between hyperparameters and inputs: it has no effect."""
    replaced = {str(v.name) for v in model.data_vars}
    for record in all_simulators(model).values():
        inputs = record.responses.inputs
        parents = set(inputs.parents)
        ends = [*inputs.aleatory, *inputs.epistemic]
        for v in ancestors(ends, blockers=parents):
            if v not in parents and v.owner is not None and str(v.name) in replaced:
                raise ValueError(
                    f"model: got pm.do of {v.name}, an expression in the parameters of an input, "
                    "expected pm.do of variables with a prior alone; fix those that it is "
                    "computed from, or write the model again with a number in its place"
                )


# Compiled functions.


def _simulator_params(evaluator: Evaluator) -> list[list[Any]]:
    """Return the parents of each node in the evaluator's model, which may be a clone."""
    params = []
    for node in evaluator.nodes:
        application = evaluator.model.named_vars[node.name].owner
        params.append(node.bound.inputs.core(application.op.dist_params(application)))
    return params


# Terms of the log posterior other than discrepancies.


def _log_other(model: pm.Model, variables: list[Any]) -> Any:
    """Return the graph of the log-likelihood of observed variables, plus potentials."""
    likelihood = model.logp(vars=variables) if variables else pt.constant(0.0)
    return likelihood + model.potentiallogp


def only_through_prior(evaluator: Evaluator) -> Bools:
    """Return which elements of theta only the prior links to the data, shape (d,).

    Such as the spread between groups, or the mean of a group that was not measured.
    """
    model = evaluator.model
    free = set(model.free_RVs)
    params = [p for group in _simulator_params(evaluator) for p in group]
    for likelihood in evaluator.likelihoods:
        params += [model[str(v.name)] for v in likelihood.variables() if not is_known(v)]
    direct = {v for v in ancestors(params, blockers=free) if v in free}
    joined = free & set(ancestors(list(direct)))
    # `free_RVs` is in topological order, so that a variable comes after its parents.
    for rv in model.free_RVs:
        if joined.intersection(ancestors([rv])):
            joined.add(rv)
    indirect = {str(rv.name) for rv in joined - direct}
    names = [str(model.values_to_rvs[v].name) for v in model.value_vars]
    sizes = [int(np.prod(s, dtype=int)) for s in value_shapes(evaluator.hyperparameters).values()]
    return np.repeat([name in indirect for name in names], sizes)


def likelihood_of(evaluator: Evaluator, measurement: Measurement) -> SpecimenLikelihood:
    """Return the log-likelihood of a simulator's specimens."""
    return next(e.likelihood for e in evaluator.emulated if e.measurement is measurement)


def specimen_graphs(evaluator: Evaluator) -> list[Any]:
    """Return the graphs of the log-likelihoods of the specimens, by likelihood, (S,)."""
    names = [likelihood.measurements[-1].name for likelihood in evaluator.likelihoods]
    variables = [evaluator.model.named_vars[name] for name in names]
    return list(evaluator.model.logp(vars=variables, sum=False))


def specimen_log_likelihoods(evaluator: Evaluator, thetas: Floats) -> NamedArrays:
    """Return log p(y_i | theta), (P, S), by simulator with a log-likelihood by specimen.

    Of simulators with common specimens the last has those of all, and the first ones have none.
    """
    result = {m.name: np.empty((len(thetas), 0)) for m in evaluator.measurements}
    values = variables_at(evaluator.hyperparameters, thetas)
    for likelihood in evaluator.likelihoods:
        result[likelihood.measurements[-1].name] = log_likelihoods(likelihood, values)
    return result


# Runs and designs.


def with_data(evaluator: Evaluator) -> list[SimulatorWithData]:
    """Return all simulators, each with the specimens of all of its groups."""
    return [*evaluator.nodes, *evaluator.measurements]


def have_emulated_points(evaluator: Evaluator) -> bool:
    """Return whether all designs have points with emulated responses."""
    return all(bound.design.has_emulated_points for bound in evaluator.reweighted.values())


def is_current(evaluator: Evaluator) -> bool:
    """Return whether the model still has the evaluator's data; `pymc.set_data` changes them."""
    model = evaluator.model
    likelihoods = dict.fromkeys(specimen_likelihoods(model).values())
    now = [*nodes(model).values(), *likelihoods]
    previous = [*evaluator.nodes, *evaluator.likelihoods]
    return now == previous


def n_design_runs(evaluator: Evaluator) -> int:
    """Return the number of runs of all designs; shared runs count once."""
    counts: dict[int, int] = {}  # number of runs by the id of the runs, which simulators may share
    for bound in evaluator.reweighted.values():
        runs = id(bound.responses.runs)
        counts[runs] = max(bound.n_runs, counts.get(runs, 0))
    return sum(counts.values())


def missing_mass(evaluator: Evaluator, theta: Floats, k: int) -> dict[str, float]:
    """Return the weight of a population, at theta (d,), on responses that are NaN and that failed.

    No response is computed at the theta that was evaluated last.
    """
    missing = evaluator.nodes[k].bound.missing(evaluator.parents(theta[None], k))
    return {"lost_mass": float(missing.lost[0]), "failed_mass": float(missing.failed[0])}


def coarser_evaluator(evaluator: Evaluator, theta: Floats) -> Evaluator:
    """Return an evaluator with an eighth of the points of large designs.

    The same one if no design is large, or if the smaller designs do not support theta, (d,).
    """
    smaller = {
        name: bound.copied(bound.design.rows(bound.blocks == 0))
        for name, bound in evaluator.reweighted.items()
        if bound.n_points >= _LARGE
    }
    if not smaller:
        return evaluator
    coarse_nodes = [replace(n, bound=smaller.get(n.name, n.bound)) for n in evaluator.nodes]
    coarse = replace(evaluator, nodes=tuple(coarse_nodes), has_graph=False)
    for name, values in coarse.support(theta[None]).items():
        if not values["weight_ess"][0] >= coarse.reweighted[name].required_ess:
            return evaluator
    return coarse


@dataclass(frozen=True)
class Requirement:
    """How well a design has to support populations."""

    # Median effective sample size of the weights, as a share of the design's required one.
    ess: float
    lowest_ess: float  # 5% quantile of the effective sample size, in the same unit
    # Bounds of the mean importance weight, which is one if the design covers the population.
    mass: tuple[float, float]
    # Whether both the 5% and the 95% quantile of the mean weight are bounded, or the median only.
    tails: bool


# Requirement of the optimiser and the samplers, whose designs grow until they meet it. A mean
# weight of 0.8 to 1.25 misses at most a fifth of the population's mass. With half the effective
# sample size an optimum moves by .05 standard errors. Twice the effective sample size cannot be
# reached by 1024 points with two inputs.
ENOUGH = Requirement(ess=1.0, lowest_ess=0.1, mass=(0.8, 1.25), tails=True)
# Requirement of predictions, whose designs do not grow. It is less strict, because a design covers
# draws at the edge of a posterior less well than the centre, and because resampling needs no
# derivative.
TOLERABLE = Requirement(ess=0.5, lowest_ess=0.0, mass=(0.7, 1.4), tails=False)
# Requirement of plots, where a curve may be less accurate than an estimate. A curve from fewer than
# ten responses, a fifth of the smallest requirement, would show the single points.
VISIBLE = Requirement(ess=0.2, lowest_ess=0.2, mass=(0.5, 2.0), tails=False)


@dataclass(frozen=True)
class Shortcoming:
    """Requirements that a design does not meet for populations."""

    text: str  # end of a sentence: what was got, and what was expected
    is_lost: bool  # whether the shortcoming is too much weight on points without response

    def __str__(self) -> str:
        """Return the text."""
        return self.text


def shortcomings(evaluator: Evaluator, thetas: Floats) -> dict[str, Shortcoming]:
    """Return how designs fall short for populations at thetas, (P, d), by simulator."""
    result = {}
    for name, support in evaluator.support(thetas).items():
        bound = evaluator.reweighted[name]
        short = shortcoming(support, bound.required_ess, bound.max_lost, bound.n_points, ENOUGH)
        if short is not None:
            result[name] = short
    return result


def supports_each(
    support: NamedArrays, required_ess: float, max_lost: float, requirement: Requirement
) -> Bools:
    """Return which populations a design supports, shape (P,); parameters as in `shortcoming`."""
    ess, mass, lost = (support[key] for key in ("weight_ess", "mean_weight", "lost_mass"))
    least, most = requirement.mass
    covered = (mass >= least) & (mass <= most)
    # A sum of weights that are zero may differ from zero by rounding.
    lost_little = lost <= max(max_lost, 1e-12)
    return (ess >= requirement.ess * required_ess) & covered & lost_little


def shortcoming(
    support: NamedArrays,
    required_ess: float,
    max_lost: float,
    n_points: int,
    requirement: Requirement,
) -> Shortcoming | None:
    """Return how a design of n points falls short of a requirement; None if it meets it.

    ``support`` has ``weight_ess``, ``mean_weight`` and ``lost_mass`` of the populations, (P,).
    """
    ess, mass, lost = (support[key] for key in ("weight_ess", "mean_weight", "lost_mass"))
    most_lost = float(np.quantile(lost, 0.95))
    if most_lost > max_lost:
        return Shortcoming(
            f"lost mass: {most_lost:.1%} of a population's weight is on points whose response "
            f"is NaN, expected at most max_lost = {max_lost:.1%}",
            is_lost=True,
        )
    complaints = []
    # Quantiles are compared, because single extreme populations may have a small sample size.
    low, middle = np.quantile(ess, [0.05, 0.5])
    least, need = requirement.lowest_ess * required_ess, requirement.ess * required_ess
    # A comparison with NaN is false, so that NaN is a shortcoming.
    if not (middle >= need and low >= least):
        complaints.append(
            f"weight effective sample size {low:.0f} (5% quantile) and {middle:.0f} (median) "
            f"of {n_points} points, expected {least:.0f} and {need:.0f}"
        )
    lowest, highest = np.quantile(mass, [0.05, 0.95] if requirement.tails else [0.5, 0.5])
    least, most = requirement.mass
    if not (lowest >= least and highest <= most):
        complaints.append(
            f"mean raw weight from {lowest:.2f} to {highest:.2f}, expected within {least} to {most}"
        )
    return Shortcoming(", and ".join(complaints), is_lost=False) if complaints else None
