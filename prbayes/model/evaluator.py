"""Reads a PyMC model: theta[P, d] -> log prior[P], discrepancies[P, k], gradients.

One evaluator serves all routes.
"""

from __future__ import annotations

import copy
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray

from prbayes._validate import AT_ONCE, IN_CACHE, Floats
from prbayes.metrics.base import Discrepancy, Metric
from prbayes.model.emulated import PopulationSimulator, emulated_simulators
from prbayes.model.measurement import Measurement
from prbayes.model.parameters import Hyperparameters
from prbayes.model.random_variable import (
    Node,
    log_kernel,
    nodes,
    priors_alone,
    without_epsilon_warning,
)
from prbayes.model.specimen_likelihood import (
    SpecimenLikelihood,
    measurements_of,
    require_simulator,
    specimen_likelihoods,
)
from prbayes.propagation.base import Bound
from prbayes.propagation.importance import CLOUD
from prbayes.propagation.reweighted import Design
from prbayes.response.budget import budget
from prbayes.response.compile import compiled, ninf_for_invalid, untraced
from prbayes.response.groups import is_group
from prbayes.response.inputs import Inputs

# Points of a design from which on an eighth of them serve on the way to an answer: those of the
# smallest cloud.
_LARGE = CLOUD


@dataclass(frozen=True)
class Evaluation:
    """What is known of a batch of thetas."""

    log_prior: Floats  # (P,): with the Jacobian of the transforms
    log_other: Floats  # (P,): log-likelihood of ordinary observed variables, and potentials
    # (P, k): one column per simulator; +inf where a population is invalid or has no support.
    discrepancies: Floats
    # (P, k): share of a population's weight on points without response; NaN where it is invalid,
    # and of stored responses, whose support tells.
    lost: Floats

    def log_likelihood(self, epsilon: Floats) -> Floats:
        """Return the pseudo log-likelihood, shape (P,), for epsilons of shape (k,)."""
        kernels = np.asarray(log_kernel(self.discrepancies, epsilon))
        total = kernels.sum(axis=-1)
        return np.asarray(self.log_other + total)


class Evaluator:
    """Everything that the optimiser, the epsilon rules and the sampler ask of a model.

    Names, transforms and prior draws are those of `hyperparameters`, and stand here too, since all
    ask for them.

    Parameters
    ----------
    model : pymc.Model
        With at least one `Simulator`.

    Attributes
    ----------
    nodes : list of Node
        The simulators with a metric of distributions.
    likelihoods : list of SpecimenLikelihood
        The log-likelihoods by specimen, one for simulators with common specimens.
    measurements : list of Measurement
        The simulators with a log-likelihood by specimen.
    emulated : list of EmulatedSimulator
        The populations of these, by group.
    hyperparameters : Hyperparameters
    """

    def __init__(self, model: pm.Model) -> None:
        self.model = model
        require_simulator(model)
        self.hyperparameters = Hyperparameters(model)  # refuses what would waste the first runs
        by_variable = nodes(model)
        self.nodes: list[Node] = list(by_variable.values())
        self._variables = list(by_variable)
        # Simulators with a likelihood by specimen: ordinary observed variables.
        self.likelihoods = list(dict.fromkeys(specimen_likelihoods(model).values()))
        self.measurements = list(measurements_of(model).values())
        self.emulated = emulated_simulators(model)
        for likelihood in self.likelihoods:
            likelihood.evaluated_by(self.hyperparameters)
        # Compiled, by what they were asked for; they live as long as this evaluator.
        self._objectives: dict[tuple[bool, bool], Any] = {}
        names = self.hyperparameters
        self.size = names.size
        self.initial = names.initial
        self.shapes = names.shapes
        self.in_support = names.in_support
        self.constrained = names.constrained
        self.unconstrained = names.unconstrained
        self.thetas_of = names.thetas_of
        self.prior_thetas = names.prior_thetas
        self.prior_points = names.prior_points

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel as the model packed by cloudpickle: those of PyMC have no plain pickle."""
        import cloudpickle

        # What other data are observed by an evaluator is not in the model.
        targets = [node.target for node in self.nodes] if "objective" in vars(self) else None
        return _unpacked, (cloudpickle.dumps((self.model, targets)),)

    def __copy__(self) -> Evaluator:
        """Share the model, and what is compiled for it."""
        other = object.__new__(Evaluator)
        vars(other).update(vars(self))
        return other

    @property
    def is_current(self) -> bool:
        """Whether the model has the data that this was made with: `pymc.set_data` changes them."""
        now = [*nodes(self.model).values(), *specimen_likelihoods(self.model).values()]
        before = [*self.nodes, *(self.likelihood_of(m) for m in self.measurements)]
        same = zip(now, before, strict=False)
        return len(now) == len(before) and all(a is b for a, b in same)

    @property
    def names(self) -> list[str]:
        """Names of the elements of theta, such as 'sigma_log__' or 'mu[1]'."""
        return self.hyperparameters.names

    @property
    def readable_names(self) -> list[str]:
        """The same with the variables' own names, such as 'sigma'."""
        return self.hyperparameters.readable_names

    @property
    def prior_sd(self) -> Floats:
        """The prior's standard deviation of each element of theta, shape (d,).

        The unit of parameters.
        """
        return self.hyperparameters.prior_sd

    @property
    def epsilon(self) -> Floats:
        """The simulators' epsilons, shape (k,), NaN where unset."""
        return np.array([node.epsilon_value for node in self.nodes])

    @property
    def n_responses(self) -> int:
        """Scalar responses computed so far; those that several simulators share count once."""
        by_metric = self._once([node.bound.responses.count for node in self.nodes])
        return by_metric + sum(m.responses.count for m in self.measurements)

    @property
    def n_runs(self) -> int:
        """Runs of all designs; those that several simulators share count once."""
        return self._once([0 if n.design is None else n.design.n_runs for n in self.nodes])

    def likelihood_of(self, measurement: Measurement) -> SpecimenLikelihood:
        """Return the log-likelihood of a simulator's specimens."""
        return next(joint for joint in self.likelihoods if measurement in joint.measurements)

    @property
    def simulators(self) -> list[PopulationSimulator]:
        """All simulators: `nodes`, then those whose responses are emulated, by group."""
        return [*self.nodes, *self.emulated]

    def _once(self, counts: list[int]) -> int:
        """Return the sum of counts by simulator, with one of those that share their runs."""
        shared: dict[int, int] = {}
        for node, count in zip(self.nodes, counts, strict=True):
            runs = id(node.bound.responses.runs)
            shared[runs] = max(count, shared.get(runs, 0))
        return sum(shared.values())

    @property
    def responses_per_theta(self) -> int:
        """Scalar responses that one theta costs."""
        return sum(node.bound.n_per_theta for node in self.nodes)

    @property
    def designs(self) -> dict[str, Design]:
        """The designs of the simulators that reweight stored responses, by name."""
        return {n.name: n.design for n in self.nodes if n.design is not None}

    def _params(self) -> list[list[Any]]:
        """Return the simulators' roots as they stand in this model, which may be a clone."""
        found = []
        for node, rv in zip(self.nodes, self._variables, strict=True):
            params = rv.owner.op.dist_params(rv.owner)
            found.append(node.bound.inputs.core(params))
        return found

    @cached_property
    def told_by_prior(self) -> NDArray[np.bool_]:
        """Which elements of theta the data tell by others and the prior alone, shape (d,).

        Such as the spread between groups, or the mean of a group that was not measured.
        """
        params = [p for own in self._params() for p in own]
        return self.hyperparameters.beyond_others(params)

    def _graphs(self) -> list[Any]:
        graphs = []
        for node, params in zip(self.nodes, self._params(), strict=True):
            graphs.append(pt.as_tensor(node.bound.discrepancy(params)))
        return list(self.model.replace_rvs_by_values(graphs))

    def _log_other(self, without: Collection[Any] = ()) -> Any:
        evaluated = {*self._variables, *without}
        ordinary = [rv for rv in self.model.observed_RVs if rv not in evaluated]
        with without_epsilon_warning():
            likelihood = self.model.logp(vars=ordinary) if ordinary else pt.constant(0.0)
        return likelihood + self.model.potentiallogp

    @property
    def has_other_terms(self) -> bool:
        """Whether there are ordinary observed variables or potentials."""
        ordinary = len(self.model.observed_RVs) > len(self.nodes)
        return ordinary or bool(self.model.potentials)

    @cached_property
    def _without_graph(self) -> list[Any]:
        """The observed variables of the likelihoods by specimen that need no graph."""
        return [
            rv
            for rv, measurement in measurements_of(self.model).items()
            if not self.likelihood_of(measurement).needs_graph
        ]

    @cached_property
    def _evaluate_other(self) -> Any:
        return self.hyperparameters.compile([self._log_other(self._without_graph)])

    def log_other(self, thetas: Floats) -> Floats:
        """Return the log-likelihood of ordinary observed variables, and potentials, shape (P,)."""
        total = np.zeros(len(thetas))
        for k, likelihood in enumerate(self.likelihoods):
            if not likelihood.needs_graph:
                values = likelihood.log_likelihoods(self.specimen_params(thetas, k))
                total += values.sum(axis=1)
        evaluated = len(self.nodes) + len(self._without_graph)
        if self.model.potentials or len(self.model.observed_RVs) > evaluated:
            (ordinary,) = self._evaluate_other(np.ascontiguousarray(thetas))
            total = total + ordinary
        return total

    def specimen_log_likelihoods(self, thetas: Floats) -> dict[str, Floats]:
        """Return log p(y_i | theta) by simulator, shapes (P, S), of those with a likelihood.

        Of simulators with common specimens the last has those of all, and the others have none.
        """
        result = {m.name: np.empty((len(thetas), 0)) for m in self.measurements}
        for k, likelihood in enumerate(self.likelihoods):
            if likelihood.needs_graph:
                rows = max(1, IN_CACHE // likelihood.points.log_a.size)
                blocks = np.split(np.ascontiguousarray(thetas), range(rows, len(thetas), rows))
                values = np.concatenate([self._evaluate_specimens[k](block)[0] for block in blocks])
            else:
                values = likelihood.log_likelihoods(self.specimen_params(thetas, k))
            result[likelihood.measurements[-1].name] = values
        return result

    def specimen_params(self, thetas: Floats, k: int) -> dict[Any, Floats]:
        """Return the variables of the k-th likelihood by specimen at thetas, shapes (P, *shape)."""
        values = self.constrained(thetas)
        variables = self.likelihoods[k].variables()
        return {v: values[str(v.name)] for v in variables if not is_group(v)}

    @cached_property
    def _evaluate_specimens(self) -> list[Any]:
        return [self.hyperparameters.compile([graph]) for graph in self.specimen_graphs()]

    def specimen_graphs(self) -> list[Any]:
        """Return the graphs of the log-likelihoods of the specimens, by likelihood, (S,)."""
        last = {joint.measurements[-1]: k for k, joint in enumerate(self.likelihoods)}
        variables = {v: last[m] for v, m in measurements_of(self.model).items() if m in last}
        graphs = self.model.logp(vars=sorted(variables, key=variables.__getitem__), sum=False)
        return list(graphs)

    def discrepancies(self, thetas: Floats, k: int, target: Discrepancy | None = None) -> Floats:
        """Return the k-th simulator's discrepancies, shape (P,), or those from another target."""
        budget().go_on()
        node = self.nodes[k]
        return node.bound.discrepancies(self.roots(thetas, k), target or node.target)

    def __call__(self, thetas: Floats) -> Evaluation:
        """Evaluate a batch, shape (P, d); invalid thetas leave the others alone."""
        size = len(thetas)
        rows_at_once = [AT_ONCE // max(1, node.bound.n_points) for node in self.nodes]
        by_graph = [each for each in self.likelihoods if each.needs_graph]
        rows_at_once += [IN_CACHE // each.points.log_a.size for each in by_graph]
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
                lost[rows, i] = node.bound.lost
        log_prior[np.isnan(log_prior)] = -np.inf
        log_other[np.isnan(log_other)] = -np.inf
        discrepancies[np.isnan(discrepancies)] = np.inf
        return Evaluation(log_prior, log_other, discrepancies, lost)

    def _count(self, thetas: int) -> None:
        """Count the responses that are part of a graph, evaluated at so many thetas."""
        for node in self.nodes:
            bound = node.bound
            if bound.symbolic:
                bound.responses.count_symbolic(bound.n_per_theta * thetas)

    def objective(self, *, prior: bool, gradient: bool) -> Any:
        """Compile the objective as a function of theta and scales.

        (theta, scales) -> sum of d_k / scale_k [- log prior] - log of ordinary terms [, gradient].

        The prior's density is that of the user's own units, as in `pymc.find_MAP`: without
        Jacobian.

        Raises
        ------
        NotImplementedError, TypeError
            If a gradient is asked for and there is none.
        """
        asked = (prior, gradient)
        if asked not in self._objectives:
            with untraced():
                self._objectives[asked] = self._objective(prior=prior, gradient=gradient)
        return self._objectives[asked]

    def _objective(self, *, prior: bool, gradient: bool) -> Any:
        scales = pt.dvector("scales")
        scaled = sum(graph / scales[k] for k, graph in enumerate(self._graphs()))
        total = scaled - self._log_other()
        with priors_alone():
            log_prior = self.model.logp(vars=self.model.free_RVs, jacobian=False)
        objective = total - log_prior if prior else total
        within = pt.switch(log_prior > -np.inf, objective, np.inf)
        (value,), theta = self.hyperparameters.joined([within])
        graphs = [value]
        if gradient:
            graphs.append(pt.grad(value, theta))
        function = compiled([theta, scales], ninf_for_invalid(graphs))

        def counted(theta: Floats, scales: Floats) -> Any:
            budget().go_on()
            self._count(1)
            return function(theta, scales)

        return counted

    def observing(
        self,
        data: dict[str, Floats],
        metric: Metric | None = None,
        weights: dict[str, Floats] | None = None,
    ) -> Evaluator:
        """Return an evaluator of the same model with other observed responses.

        They come by the names of simulators, and so do their weights; those of as many responses
        are by default what they were.
        Metrics choose bandwidths and cells anew; designs and epsilons are the same objects. With
        ``metric`` all simulators have that one.
        """
        _ = self._roots  # compiled once, for all copies
        targets = []
        for node in self.nodes:
            observed = data[node.name]
            before = node.target
            same_size = np.shape(observed) == before.observed.shape
            counted = before.weights if same_size else None
            if weights is not None:
                counted = weights[node.name]
            chosen = metric or node.metric
            target = chosen.against(observed, counted)
            bound = node.bound
            targets.append(target.metric.beside(target, bound.first_responses, bound.dimensions))
        return self.with_targets(targets)

    def of_one(self, node: Node, k: int) -> Evaluator:
        """Return an evaluator of one simulator alone, of the k-th's inputs; it is not compiled."""
        other = copy.copy(self)
        other.nodes = [node]
        other._variables = [self._variables[k]]
        vars(other).pop("_roots", None)
        other.__dict__["objective"] = other._uncompiled
        return other

    def coarser(self) -> Evaluator | None:
        """Return an evaluator with an eighth of the points of large designs; None if none is."""
        bounds: list[Bound] = []
        for node in self.nodes:
            design = node.design
            large = design is not None and design.n_points >= _LARGE
            bounds.append(design.coarser() if design is not None and large else node.bound)
        pairs = list(zip(self.nodes, bounds, strict=True))
        if all(node.bound is bound for node, bound in pairs):
            return None
        other = copy.copy(self)
        other.nodes = [replace(node, bound=bound) for node, bound in pairs]
        other.__dict__["objective"] = other._uncompiled
        return other

    def coarse_where_sufficient(self, theta: Floats) -> Evaluator:
        """Return that of an eighth of the points of large designs if they support theta, (d,)."""
        coarse = self.coarser()
        if coarse is None:
            return self
        support = coarse.support(theta[None])
        is_sufficient = [
            support[name]["weight_ess"][0] >= design.required_ess
            for name, design in coarse.designs.items()
        ]
        return coarse if all(is_sufficient) else self

    def with_targets(self, targets: list[Discrepancy]) -> Evaluator:
        """Return an evaluator of the same model with other prepared metrics, by simulator."""
        other = copy.copy(self)
        pairs = zip(self.nodes, targets, strict=True)
        other.nodes = [replace(node, target=target) for node, target in pairs]
        other.__dict__["objective"] = other._uncompiled
        return other

    def _uncompiled(self, *, prior: bool, gradient: bool) -> Any:
        if prior or gradient:
            raise NotImplementedError("on other data the objective is evaluated, not compiled")
        return lambda theta, scales: (self.total(theta[None], scales)[0],)

    def total(self, thetas: Floats, scales: Floats) -> Floats:
        """Return the sum of d_k / scale_k - log of ordinary terms, shape (P,).

        +inf outside the priors' support.
        """
        found = self(thetas)
        with np.errstate(invalid="ignore"):
            scaled = found.discrepancies / scales
            value = scaled.sum(axis=-1) - found.log_other
        known = np.isfinite(found.log_prior) & np.isfinite(value)
        return np.where(known, value, np.inf)

    @cached_property
    def _roots(self) -> tuple[Any, Any]:
        """The compiled roots of all simulators, and where those of each begin and end."""
        params = self._params()
        every = [p for own in params for p in own]
        function = self.hyperparameters.compile(self.model.replace_rvs_by_values(every))
        return function, np.cumsum([0, *map(len, params)])

    def roots(self, thetas: Floats, k: int) -> list[Floats]:
        """Return the values of the roots of the k-th of `simulators`, shapes (P, *shape)."""
        if k >= len(self.nodes):
            return self._emulated_roots(thetas, k)
        function, ends = self._roots
        values = function(np.ascontiguousarray(thetas))
        size = len(thetas)
        found = []
        for value in values[ends[k] : ends[k + 1]]:
            shape = (size, *np.shape(value)[1:])
            found.append(np.broadcast_to(value, shape))
        return found

    def _emulated_roots(self, thetas: Floats, k: int) -> list[Floats]:
        """Return the roots of a simulator whose responses are emulated, its group among them."""
        simulator = self.emulated[k - len(self.nodes)]
        return self.roots_of(thetas, simulator.inputs, simulator.place)

    def roots_of(self, thetas: Floats, inputs: Inputs, place: int | None) -> list[Floats]:
        """Return the roots of inputs in the group with this index, shapes (P, *shape)."""
        values = self.constrained(thetas)
        return [
            np.full(len(thetas), place) if is_group(root) else values[str(root.name)]
            for root in inputs.roots
        ]

    def populations(self, thetas: Floats, k: int) -> tuple[Floats, Floats]:
        """Return responses and weights, (P, n) each, of populations of the k-th of `simulators`."""
        return self.simulators[k].populations(self.roots(thetas, k))

    def missing(self, theta: Floats, k: int) -> dict[str, float]:
        """Return the shares of a population without numbers, by what they are.

        At the theta, shape (d,), that was evaluated last this costs no response.
        """
        found = self.nodes[k].bound.missing(self.roots(theta[None], k))
        return {"lost_mass": float(found.lost[0]), "failed_mass": float(found.failed[0])}

    def support(self, thetas: Floats) -> dict[str, dict[str, Floats]]:
        """Return how well each design supports the populations at thetas, arrays of shape (P,)."""
        found = {}
        for k, node in enumerate(self.nodes):
            design = node.design
            if design is None:
                continue
            # Some populations at a time: their weights are held at all points.
            step = max(1, IN_CACHE // design.n_points)
            parts = []
            for first in range(0, max(1, len(thetas)), step):
                roots = self.roots(thetas[first : first + step], k)
                parts.append(design.support(roots))
            found[node.name] = {
                key: np.concatenate([part[key] for part in parts]) for key in parts[0]
            }
        return found


def _unpacked(payload: bytes) -> Evaluator:
    """Return an evaluator that was pickled."""
    import cloudpickle

    model, targets = cloudpickle.loads(payload)
    evaluator = Evaluator(model)
    return evaluator if targets is None else evaluator.with_targets(targets)
