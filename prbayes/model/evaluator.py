"""Reads a PyMC model: theta[P, d] -> log prior[P], discrepancies[P, k], gradients. One evaluator for all routes.

Theta is the vector of the model's value variables, unconstrained through PyMC's transforms.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from pymc.pytensorf import join_nonshared_inputs
from pytensor.graph.replace import graph_replace, vectorize_graph

from prbayes._checks import Floats, real_array
from prbayes.metrics.base import Metric
from prbayes.model.simulator import Node, log_kernel, required_nodes
from prbayes.propagation.points import sobol
from prbayes.propagation.reweighted import Design
from prbayes.response.compilation import PLAIN, ninf_for_invalid
from prbayes.response.distributions import PriorPoints, PriorSampler

_PRIOR_DRAWS = 256  # for the prior's spread, which only sets units: a tenth more or less changes no answer
_ONE_SD = (0.84, 0.16)  # levels of a normal one standard deviation above and below its mean
_CHUNK = 1 << 22  # design points times particles evaluated at a time: bounds memory


@dataclass(frozen=True)
class Evaluation:
    """What is known of a batch of thetas.

    Attributes
    ----------
    log_prior : ndarray, shape (P,)
        With the Jacobian of the transforms.
    log_other : ndarray, shape (P,)
        Log-likelihood of ordinary observed variables, and potentials.
    discrepancies : ndarray, shape (P, k)
        One column per simulator; +inf where a population is invalid or has no support.
    """

    log_prior: Floats
    log_other: Floats
    discrepancies: Floats

    def log_likelihood(self, epsilon: Floats) -> Floats:
        """Return the pseudo log-likelihood, shape (P,), for epsilons of shape (k,)."""
        return np.asarray(self.log_other + np.asarray(log_kernel(self.discrepancies, epsilon)).sum(axis=-1))


class Evaluator:
    """Everything that the optimiser, the epsilon rules and the sampler ask of a model.

    Parameters
    ----------
    model : pymc.Model
        With at least one `Simulator`.
    """

    def __init__(self, model: pm.Model) -> None:
        self.model = model
        found = required_nodes(model)
        self.nodes: list[Node] = list(found.values())
        self._variables = list(found)
        discrete = [v.name for v in model.value_vars if not v.dtype.startswith("float")]
        if discrete:
            raise TypeError(
                f"model: got discrete hyperparameters {discrete}, expected continuous ones; use pm.sample, or fix them"
            )
        point = model.initial_point(random_seed=0)
        self.shapes = {v.name: np.shape(point[v.name]) for v in model.value_vars}
        self.initial = np.concatenate([np.ravel(point[v.name]) for v in model.value_vars])
        self.size = self.initial.size
        self._point = point
        self._drawn: dict[tuple[int, int], Floats] = {}

    @property
    def names(self) -> list[str]:
        """Names of the elements of theta, such as 'sigma_log__' or 'mu[1]'."""
        return self._elements(list(self.shapes))

    @property
    def readable_names(self) -> list[str]:
        """The same with the variables' own names, such as 'sigma'; elements of theta are transformed nevertheless."""
        return self._elements([str(self.model.values_to_rvs[v].name) for v in self.model.value_vars])

    def _elements(self, names: list[str]) -> list[str]:
        out: list[str] = []
        for name, shape in zip(names, self.shapes.values(), strict=True):
            out += [f"{name}[{','.join(map(str, i))}]" for i in np.ndindex(shape)] if shape else [name]
        return out

    @property
    def epsilon(self) -> Floats:
        """The simulators' epsilons, shape (k,), NaN where unset."""
        return np.array([node.epsilon_value for node in self.nodes])

    @property
    def n_responses(self) -> int:
        """Scalar responses computed so far, over all simulators."""
        return sum(node.bound.responses.count for node in self.nodes)

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
        return [
            n.bound.inputs.core(rv.owner.op.dist_params(rv.owner))
            for n, rv in zip(self.nodes, self._variables, strict=True)
        ]

    def _graphs(self) -> list[Any]:
        graphs = [n.bound.discrepancy(p) for n, p in zip(self.nodes, self._params(), strict=True)]
        return list(self.model.replace_rvs_by_values([pt.as_tensor(g) for g in graphs]))

    def _compile(self, graphs: Sequence[Any], *, batched: bool = True) -> Any:
        outputs, theta = join_nonshared_inputs(self._point, list(graphs), self.model.value_vars)
        outputs = ninf_for_invalid(outputs)
        if batched:
            batch = pt.dmatrix("thetas")
            outputs, theta = vectorize_graph(outputs, {theta: batch}), batch
        return pytensor.function([theta], outputs, mode=PLAIN, on_unused_input="ignore")

    def _log_other(self) -> Any:
        ordinary = [rv for rv in self.model.observed_RVs if rv not in self._variables]
        likelihood = self.model.logp(vars=ordinary) if ordinary else pt.constant(0.0)
        return likelihood + self.model.potentiallogp

    @cached_property
    def _evaluate(self) -> Any:
        return self._compile([self.model.varlogp, self._log_other()])

    def __call__(self, thetas: Floats) -> Evaluation:
        """Evaluate a batch, shape (P, d); invalid thetas leave the others alone."""
        size = len(thetas)
        points = max((n.bound.n_points for n in self.nodes), default=1)
        step = max(1, _CHUNK // max(1, points))
        log_prior, log_other = np.empty(size), np.empty(size)
        discrepancies = np.empty((size, len(self.nodes)))
        for i in range(0, size, step):
            block = np.ascontiguousarray(thetas[i : i + step])
            log_prior[i : i + step], log_other[i : i + step] = self._evaluate(block)
            for k, node in enumerate(self.nodes):
                discrepancies[i : i + step, k] = node.bound.discrepancies(self.roots(block, k), node.target)
        return Evaluation(
            np.nan_to_num(log_prior, nan=-np.inf, posinf=np.inf, neginf=-np.inf),
            np.nan_to_num(log_other, nan=-np.inf, posinf=np.inf, neginf=-np.inf),
            np.nan_to_num(discrepancies, nan=np.inf, posinf=np.inf, neginf=-np.inf),
        )

    def _count(self, thetas: int) -> None:
        """Count the responses that are part of a graph, evaluated at so many thetas."""
        for node in self.nodes:
            if node.bound.symbolic:
                node.bound.responses.count += node.bound.n_per_theta * thetas

    @cache  # noqa: B019 (lives as long as the evaluator)
    def objective(self, *, prior: bool, gradient: bool) -> Any:
        """Compile (theta, scales) -> sum of d_k / scale_k [- log prior] - log of ordinary terms [, its gradient].

        The prior's density is that of the user's own units, as in `pymc.find_MAP`: without Jacobian.

        Raises
        ------
        NotImplementedError, TypeError
            If a gradient is asked for and there is none.
        """
        scales = pt.dvector("scales")
        total = sum(g / scales[k] for k, g in enumerate(self._graphs())) - self._log_other()
        log_prior = self.model.logp(vars=self.model.free_RVs, jacobian=False)
        total = pt.switch(log_prior > -np.inf, total - log_prior if prior else total, np.inf)
        outputs, theta = join_nonshared_inputs(self._point, [total], self.model.value_vars)
        graphs = [outputs[0], *([pt.grad(outputs[0], theta)] if gradient else [])]
        compiled = pytensor.function([theta, scales], ninf_for_invalid(graphs), mode=PLAIN, on_unused_input="ignore")

        def counted(theta: Floats, scales: Floats) -> Any:
            self._count(1)
            return compiled(theta, scales)

        return counted

    def observing(self, data: dict[str, Floats], metric: Metric | None = None) -> Evaluator:
        """Return an evaluator of the same model with other observed responses, by the names of simulators.

        Metrics choose bandwidths and cells anew; designs and epsilons are the same objects. With ``metric`` all
        simulators have that one.
        """
        _ = self._evaluate, self._constrain, self._roots, self._transform  # compiled once, for all copies
        other = copy.copy(self)
        other.nodes = [
            replace(
                n,
                target=(metric or n.metric).against(
                    data[n.name], n.target.weights if n.target.observed.size == np.size(data[n.name]) else None
                ),
            )
            for n in self.nodes
        ]
        other.__dict__["objective"] = other._uncompiled
        return other

    def _uncompiled(self, *, prior: bool, gradient: bool) -> Any:
        if prior or gradient:
            raise NotImplementedError("on other data the objective is evaluated, not compiled")
        return lambda theta, scales: (self.total(theta[None], scales)[0],)

    def total(self, thetas: Floats, scales: Floats) -> Floats:
        """Return the sum of d_k / scale_k - log of ordinary terms, shape (P,); +inf outside the priors' support."""
        found = self(thetas)
        with np.errstate(invalid="ignore"):
            value = (found.discrepancies / scales).sum(axis=-1) - found.log_other
        return np.where(np.isfinite(found.log_prior) & np.isfinite(value), value, np.inf)

    def in_support(self, thetas: Floats) -> Any:
        """Return which thetas have a finite log prior, shape (P,)."""
        return np.isfinite(np.broadcast_to(self._evaluate(np.ascontiguousarray(thetas))[0], len(thetas)))

    @cached_property
    def _constrain(self) -> tuple[list[str], Any]:
        wanted = self.model.unobserved_RVs
        return [v.name for v in wanted], self._compile(self.model.replace_rvs_by_values(wanted))

    def constrained(self, thetas: Floats) -> dict[str, Floats]:
        """Return the model's variables and deterministics, shapes (P, *shape), in the user's own units."""
        names, function = self._constrain
        values = function(np.ascontiguousarray(thetas))
        return {
            n: np.array(np.broadcast_to(v, (len(thetas), *np.shape(v)[1:])) if np.ndim(v) else np.full(len(thetas), v))
            for n, v in zip(names, values, strict=True)
        }

    def unconstrained(self, point: dict[str, Any]) -> Floats:
        """Return theta, shape (d,), of a point given in the user's own units.

        Raises
        ------
        KeyError, TypeError, ValueError
            If the names are not the model's free variables, or a value is outside its support.
        """
        free = {rv.name: rv for rv in self.model.free_RVs}
        if set(point) != set(free):
            raise KeyError(f"start: got {sorted(point)}, expected a value for each of {sorted(free)}")
        draws = []
        for name, rv in free.items():
            value, shape = real_array(point[name], f"start: {name}"), tuple(map(int, rv.shape.eval()))
            if value.shape not in ((), shape):
                raise ValueError(f"start: {name}: got shape {value.shape}, expected {shape}")
            draws.append(np.broadcast_to(value, shape)[None])
        theta: Floats = self.thetas_of(draws)[0]
        if not np.isfinite(theta).all() or not self.in_support(theta[None])[0]:
            raise ValueError(f"start: got {point}, expected values inside the support of the priors")
        return theta

    @cached_property
    def _roots(self) -> list[Any]:
        params = self._params()
        flat = [p for ps in params for p in ps]
        function = self._compile(self.model.replace_rvs_by_values(flat))
        sizes = np.cumsum([0, *(len(ps) for ps in params)])
        return [function, sizes]

    def roots(self, thetas: Floats, k: int) -> list[Floats]:
        """Return the values of the k-th simulator's roots, shapes (P, *shape)."""
        function, sizes = self._roots
        values = function(np.ascontiguousarray(thetas))[sizes[k] : sizes[k + 1]]
        return [np.broadcast_to(v, (len(thetas), *np.shape(v)[1:])) for v in values]

    def populations(self, thetas: Floats, k: int) -> tuple[Floats, Floats]:
        """Return responses and weights, (P, n) each, of the k-th simulator's populations."""
        return self.nodes[k].bound.populations(self.roots(thetas, k))

    def support(self, thetas: Floats) -> dict[str, dict[str, Floats]]:
        """Return how well each design supports the populations at thetas, arrays of shape (P,)."""
        return {
            node.name: node.design.support(self.roots(thetas, k))
            for k, node in enumerate(self.nodes)
            if node.design is not None
        }

    def thetas_of(self, draws: Sequence[Floats]) -> Floats:
        """Return thetas, shape (P, d), of values of the free variables, shapes (P, *shape), in the model's order."""
        return np.asarray(self._transform(*draws))

    @cached_property
    def _sampler(self) -> PriorSampler:
        return PriorSampler(self.model.free_RVs)

    def prior_thetas(self, size: int, seed: int) -> Floats:
        """Draw thetas from the prior, shape (size, d)."""
        if (size, seed) not in self._drawn:
            self._drawn[size, seed] = self.thetas_of(self._sampler(size, seed))
        return self._drawn[size, seed].copy()

    @cached_property
    def prior_sd(self) -> Floats:
        """The prior's standard deviation of each element of theta, robust, shape (d,): the unit of parameters."""
        thetas = self.prior_thetas(_PRIOR_DRAWS, seed=0)
        upper, lower = np.quantile(thetas, _ONE_SD, axis=0)
        spread = (upper - lower) / 2
        known = (spread > 0) & np.isfinite(spread)
        return np.where(known, spread, 1.0)

    @cached_property
    def _points(self) -> PriorPoints | None:
        try:
            return PriorPoints(self.model.free_RVs)
        except TypeError:  # a prior without inverse distribution function
            return None

    def prior_points(self, size: int, seed: int) -> Floats:
        """Return thetas spread evenly over the prior, shape (size, d): Sobol points, or draws where there are none."""
        if self._points is None:
            return self.prior_thetas(size, seed)
        thetas = self.thetas_of(self._points(sobol(size, self._points.size, seed)))
        return np.where(np.isfinite(thetas), thetas, self.initial)

    @cached_property
    def _transform(self) -> Any:
        free = self.model.free_RVs
        symbols = [v.type() for v in free]
        swap = dict(zip(free, symbols, strict=True))
        parts = []
        for value_var in self.model.value_vars:
            rv = self.model.values_to_rvs[value_var]
            transform = self.model.rvs_to_transforms[rv]
            value = rv if transform is None else transform.forward(rv, *rv.owner.inputs)
            parts.append(pt.atleast_1d(value).ravel())
        theta = graph_replace(pt.concatenate(parts), swap, strict=False)
        batched = [pt.tensor(dtype=s.dtype, shape=(None, *s.type.shape)) for s in symbols]
        return pytensor.function(
            batched,
            vectorize_graph(theta, dict(zip(symbols, batched, strict=True))),
            mode=PLAIN,
            on_unused_input="ignore",
            allow_input_downcast=True,
        )
