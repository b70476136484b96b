"""The observed variable of the log-likelihood by specimen, as PyMC evaluates it.

Its log-density is a vector with an element for each specimen,

    log p(y_i | theta) = logsumexp_k(log p(x_ik | theta) + A_ik),

a graph of PyMC's own log-densities of the inputs at points x_ik. Points and numbers A_ik are
computed at the first use, from runs and an emulator (`prbayes.propagation.specimen_points`). They
contain no hyperparameter, so that NUTS, SMC and optimisers evaluate the graph without a run.

Simulators that measured the same specimens have one likelihood: y_i are the readings of all. The
log-density of the last one has an element for each specimen, those of the others have none; their
observed variables are parameters of the last one's.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.logprob.abstract import ValuedRV, _logprob
from pymc.logprob.utils import CheckParameterValue
from pytensor.graph.basic import Apply, Constant
from pytensor.graph.replace import graph_replace, vectorize_graph
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable

from prbayes._finding import Finding, report
from prbayes._validate import Floats, called
from prbayes.metrics.readings import Readings
from prbayes.model.data_checks import data_findings
from prbayes.model.measurement import Measurement, StackedReadings
from prbayes.model.parameters import Hyperparameters
from prbayes.model.population_draws import Populations
from prbayes.model.random_variable import (
    builds_priors_alone,
    known_value,
    required_simulators,
    response_name,
    rv_signature,
)
from prbayes.model.run_checks import (
    emulator_findings,
    refuse_scatter,
    refuse_undetermined,
    refuse_unreachable,
    refuse_unused_inputs,
    unreached,
)
from prbayes.propagation.base import DesignError
from prbayes.propagation.coordinates import Coordinates
from prbayes.propagation.fibre_points import fibre_points
from prbayes.propagation.population_density import PopulationDensity, WeightedPoints
from prbayes.propagation.response_share import ResponseShare, response_share
from prbayes.propagation.roots import Roots
from prbayes.propagation.specimen_points import (
    Emulation,
    PointOptions,
    SpecimenPoints,
    draw_points,
    emulate,
)
from prbayes.response.budget import duration
from prbayes.response.distributions import log_density
from prbayes.response.groups import is_group
from prbayes.response.inputs import Inputs, aleatory_names
from prbayes.response.response import Responses

_log = logging.getLogger("prbayes")


@dataclass(frozen=True, eq=False)
class SpecimenLikelihood:
    """The log-likelihood of specimens, each measured by one simulator or by several.

    Attributes
    ----------
    measurements : tuple of Measurement
        Of simulators with the same inputs, in the order of the model.
    model : weak reference to a pymc.Model
    known : Emulation or None
        Of the same responses, for other data.
    options : PointOptions
    """

    measurements: tuple[Measurement, ...]
    model: Any = None
    known: Emulation | None = None
    options: PointOptions = field(default_factory=PointOptions)

    def __getstate__(self) -> dict[str, Any]:
        """Replace the weak reference, which has no pickle, by the model."""
        model = None if self.model is None else self.model()
        return {**vars(self), "model": model, "_evaluated": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the weak reference."""
        model = state["model"]
        vars(self).update({**state, "model": None if model is None else weakref.ref(model)})

    @property
    def name(self) -> str:
        """Names of the simulators."""
        return " and ".join(m.name for m in self.measurements)

    @property
    def inputs(self) -> Inputs:
        """The inputs of the responses."""
        return self.measurements[0].inputs

    @cached_property
    def stacked(self) -> StackedReadings:
        """The readings of all simulators, by specimen."""
        return StackedReadings.of(self.measurements)

    @property
    def readings(self) -> Readings:
        """The readings of S specimens in M outputs."""
        return self.stacked.readings

    def variables(self, names: Collection[str] | None = None) -> tuple[TensorVariable, ...]:
        """Return the model variables of the log-density: roots of the inputs, then extras.

        Extras are those of the simulators with these names, by default of all.
        """
        extras = [
            v
            for m in self.measurements
            if names is None or m.name in names
            for v in m.extras.values()
        ]
        return tuple(dict.fromkeys([*self.inputs.roots, *extras]))

    @property
    def error_is_known(self) -> bool:
        """Whether no error of a reading is a variable of the model."""
        return not any("error" in m.extras for m in self.measurements)

    @property
    def calls_response(self) -> bool:
        """Whether the response itself takes the place of an emulator."""
        return self.measurements[0].propagation.calls_response

    @cached_property
    def coordinates(self) -> Coordinates:
        """Coordinates of the inputs."""
        return Coordinates.of_prior(self.inputs, len(self.readings), sampler=self._density.sampler)

    def columns(self, measurement: Measurement) -> slice:
        """Return which of all outputs are those of a simulator."""
        first = 0
        for m in self.measurements:
            last = first + m.rows.shape[1]
            if m is measurement:
                break
            first = last
        return slice(first, last)

    def numbers(self, measurement: Measurement) -> NDArray[np.intp]:
        """Return the specimen of each row of a simulator, (N,)."""
        return self.stacked.numbers[self.measurements.index(measurement)]

    @property
    def labels(self) -> NDArray[Any] | None:
        """Labels of the specimens, (S,); None if these are the rows of a single simulator."""
        if len(self.measurements) == 1 and len(self.readings) == len(self.measurements[0].observed):
            return None
        labels = np.concatenate([np.asarray(m.specimens) for m in self.measurements])
        _, first = np.unique(np.concatenate(self.stacked.numbers), return_index=True)
        return labels[first]

    @property
    def by_group(self) -> list[tuple[int | None, NDArray[np.intp]]]:
        """The index of each group, None without groups, and its specimens."""
        groups = self.stacked.groups
        if groups is None:
            return [(None, np.arange(len(self.readings)))]
        return [(place, np.flatnonzero(groups == place)) for place in np.unique(groups).tolist()]

    def run(self, z: Floats) -> Floats:
        """Return the outputs of runs at coordinates, (n, d) -> (n, M).

        NaN where there is no response, +inf where a specimen failed. The first runs are checked for
        scatter and for the range of the readings.
        """
        responses = [m.responses for m in self.measurements]
        before = sum(response.computed for response in responses)
        inputs = self.coordinates.inputs(z)
        parts = [response(inputs, []).reshape(len(z), -1) for response in responses]
        values = np.concatenate(parts, axis=1)
        values = np.where(np.isneginf(values), np.nan, values)
        if self.known is None and self._first_outputs is None:
            if sum(response.computed for response in responses) > before:

                def alone(row: int) -> Floats:
                    inputs = self.coordinates.inputs(z[row : row + 1])
                    return np.concatenate(
                        [response.alone(inputs).ravel() for response in responses]
                    )

                refuse_scatter(self.name, values, alone)
            refuse_unreachable(self.name, values, self.readings)
            refuse_unused_inputs(self.name, z, values, self._coordinate_names)
            vars(self)["_first_outputs"] = values
        return values

    @cached_property
    def _first_outputs(self) -> Floats | None:
        """Outputs of the first runs, (n, M), once they were made and checked."""
        return None

    @property
    def _coordinate_names(self) -> list[str]:
        """The name of the input of each coordinate."""
        names = aleatory_names(self.inputs, self.measurements[0].responses.function)
        sizes = [int(np.prod(shape, dtype=int)) for shape in self.inputs.event_shapes]
        return [name for name, size in zip(names, sizes, strict=True) for _ in range(size)]

    @cached_property
    def _prepared(
        self,
    ) -> tuple[Emulation, SpecimenPoints, tuple[Finding, ...], ResponseShare | None]:
        """The emulator, the points, what is to be reported of them, and the share of responses."""
        responses = [m.responses for m in self.measurements]
        for response in responses:
            response.on_start = partial(self._log_first_runs, response)
        populations = self.populations
        try:
            emulation, points, findings = self._prepare(populations, self.known)
            refined, share = response_share(
                self.run,
                emulation,
                populations.prior_specimens,
                lambda share: populations.posterior(points.z, points.log_a, share=share),
                self.options,
                name=self.name,
            )
            if refined is not emulation and not self._is_partial:
                # Specimens beside the failing region have points on its right side now.
                refined, points, findings = self._prepare(populations, refined)
            return refined, points, report(*findings), share
        except DesignError as error:
            raise DesignError(f"{error}{self._causes()}") from None
        finally:
            for response in responses:
                response.on_start = None

    def _causes(self) -> str:
        """Return what the data show of the causes of a refusal, as sentences."""
        first = self._first_outputs
        outside = "" if first is None else unreached(first, self.readings)
        findings = self._data_findings(several_roots=False)
        return outside + "".join(f". {finding}" for finding in findings)

    def _log_first_runs(self, responses: Responses, runs: int, seconds: float) -> None:
        """Log how many runs there are, how long they take, and which number changes them."""
        responses.on_start = None
        total = np.ceil(runs / responses.workers) * seconds
        time = f", about {duration(float(total))}" if total >= 1 else ""
        more = max(runs // 2, self.options.fresh)
        _log.info(
            "%s: runs at first: %d%s; then %d at a time at the roots of the specimens; to change "
            "this, pass another number in propagation=prb.Reweighted(n=%d)",
            responses.name,
            runs,
            time,
            more,
            runs,
        )

    def _prepare(
        self, populations: Populations, known: Emulation | None
    ) -> tuple[Emulation, SpecimenPoints, Sequence[Finding]]:
        """Return the emulator, the points and what is to be reported of them.

        Parameters
        ----------
        populations : Populations
        known : Emulation, optional
            Of the same response.
        """
        name, n = self.name, self.first_runs
        bounds, d = self.coordinates.bounds, self.coordinates.size
        if self._is_partial:
            if self.calls_response:
                raise TypeError(
                    f"{name}: propagation: got prb.Resimulated, expected stored responses where "
                    "specimens have fewer readings than inputs; leave propagation= out"
                )
            emulation, points = fibre_points(
                self.run,
                self.readings,
                bounds,
                populations.prior_specimens(),
                populations.posterior,
                self.options,
                n=n,
                name=name,
            )
            return emulation, points, self._data_findings(several_roots=True)
        box = np.stack([-np.ones(d), np.ones(d)])
        if self.calls_response:
            known = Emulation.of_function(self.run, box, bounds, self.readings, self.options)
        emulation, roots = emulate(
            self.run, self.readings, box, bounds, self.options, n=n, known=known, name=name
        )
        if not self.calls_response:
            refuse_undetermined(name, emulation, roots, self._coordinate_names)
        points = draw_points(
            emulation,
            emulation.error,
            self.readings,
            roots,
            emulation.box,
            self.options,
            error_is_known=self.error_is_known,
        )
        findings = [
            *self._data_findings(several_roots=bool((points.n_roots > 1).any())),
            *misfit_findings(self.name, self.readings, roots, emulation.error),
            *emulator_findings(self.name, self.readings, emulation.error),
        ]
        return emulation, points, findings

    @property
    def populations(self) -> Populations:
        """Populations of the model's hyperparameters, which compile what they are asked for."""
        groups = self.stacked.groups
        shared = self._density, self._evaluated
        return Populations(self.model, self.inputs, self.coordinates, groups, *shared)

    @cached_property
    def _density(self) -> PopulationDensity:
        return PopulationDensity(self.inputs)

    @cached_property
    def _evaluated(self) -> weakref.ref[Hyperparameters] | None:
        """The model's hyperparameters, once an evaluator has them."""
        return None

    def evaluated_by(self, hyperparameters: Hyperparameters) -> None:
        """Take what an evaluator of the model has compiled."""
        vars(self)["_evaluated"] = weakref.ref(hyperparameters)

    @property
    def _is_partial(self) -> bool:
        """Whether specimens have fewer readings than inputs, without censored ones in place."""
        present = self.readings.is_measured | self.readings.is_censored
        return bool((present.sum(axis=1) < self.coordinates.size).any())

    @property
    def first_runs(self) -> int | None:
        """The largest number of first runs that a simulator asks for, None for the default."""
        numbers = [m.propagation.emulator_runs for m in self.measurements]
        return max((n for n in numbers if n is not None), default=None)

    def _data_findings(self, *, several_roots: bool) -> tuple[Finding, ...]:
        """Return findings of rounded, censored and repeated readings that are taken as exact."""
        findings: list[Finding] = []
        for m in self.measurements:
            steps = m.readings.step.max(axis=0)
            # A reading error that the user gives covers rounding.
            is_stated = (steps > 0) | (m.metric.error is not None)
            steps = np.where(is_stated, np.maximum(steps, 1e-300), np.nan)
            findings += data_findings(
                m.readings.values,
                labels=[f"{m.name}[{label}]" for label in m.outputs.names] or [m.name],
                several_roots=several_roots,
                rounded=steps,
            )
        return tuple(findings)

    @property
    def emulation(self) -> Emulation:
        """The emulator; the first access computes its runs."""
        return self._prepared[0]

    @property
    def points(self) -> SpecimenPoints:
        """The points of the specimens."""
        return self._prepared[1]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the data and the runs show before the fit."""
        return self._prepared[2]

    @property
    def share(self) -> ResponseShare | None:
        """Points from which the share of a population with a response follows, if it matters."""
        return self._prepared[3]

    @cached_property
    def _weighted_points(self) -> tuple[list[Floats], Floats]:
        """The points, (N, K, *event) by input, and the numbers A, (N, K)."""
        points = self.points
        # The proposal is a density of z: p(x) dx = p(x(z)) |dx/dz| dz.
        log_a = points.log_a if self.error_is_known else -points.log_proposal
        return self.coordinates.inputs(points.z), log_a + self.coordinates.log_jacobian(points.z)

    @cached_property
    def arrays(self) -> tuple[list[Any], Any]:
        """Shared variables of the points, (N, K, *event) by input, and of the numbers A, (N, K)."""
        points, log_a = self._weighted_points
        shared = [
            pytensor.shared(np.ascontiguousarray(x), name=f"{self.name}_points_{i}")
            for i, x in enumerate(points)
        ]
        return shared, pytensor.shared(log_a, name=f"{self.name}_log_a")

    def _points_by_group(self) -> list[WeightedPoints]:
        """Return the points of the specimens of each group, as the shared variables have them.

        Refits put other specimens there.
        """
        shared, shared_log_a = self.arrays
        log_a = shared_log_a.get_value(borrow=True)
        cache: tuple[Any, list[WeightedPoints]] = vars(self).get("_cached_points", (None, []))
        cached_log_a, points = cache
        if cached_log_a is not log_a:
            x = [variable.get_value(borrow=True) for variable in shared]
            points = [
                WeightedPoints.of(self.inputs, [v[rows] for v in x], log_a[rows])
                for _, rows in self.by_group
            ]
            vars(self)["_cached_points"] = (log_a, points)
        return points

    @property
    def needs_graph(self) -> bool:
        """Whether only the graph has the log-likelihood: with an unknown error, or repeats."""
        return not self.error_is_known or self.stacked.repeats is not None

    def log_likelihoods(self, params: Mapping[Any, Floats]) -> Floats:
        """Return the log-likelihoods of the specimens in batches of populations, (P, S).

        The numbers of `log_likelihood`, for likelihoods that need no graph.

        Parameters
        ----------
        params : mapping
            Values by `variables`, shapes (P, *shape), without the group of a specimen.
        """
        size = len(next(iter(params.values())))
        result = np.empty((size, len(self.readings)))
        for (place, rows), points in zip(self.by_group, self._points_by_group(), strict=True):
            roots = [
                np.full(size, place) if is_group(root) else params[root]
                for root in self.inputs.roots
            ]
            result[:, rows] = self._density.log_likelihoods(roots, points)
            if self.share is not None:
                log_share = self.share.of_populations(self._density, roots, self.coordinates)
                result[:, rows] -= log_share[:, None]
        gross_share = self.measurements[0].gross_errors
        if gross_share is not False:
            gross_share = np.reshape(params.get(gross_share, gross_share), (-1, 1))
            gross = np.log(gross_share) + self.stacked.log_gross
            result = np.logaddexp(np.log1p(-gross_share) + result, gross)
        weights = self.measurements[0].weights
        return result if weights is None else result * weights

    def log_likelihood(self, params: Mapping[Any, Any]) -> TensorVariable:
        """Return the graph of the log-likelihoods of the specimens, (S,).

        Parameters
        ----------
        params : mapping
            Values by `variables`.
        """
        points, log_a = self.arrays
        n, count = len(self.readings), log_a.shape[1]
        symbols = self.inputs.placeholders()
        values = {s: params[r] for s, r in zip(symbols, self.inputs.roots, strict=True)}
        groups = self.stacked.groups
        groups = np.zeros(n, dtype=np.intp) if groups is None else groups
        flat = [x.reshape((n * count, *x.shape[2:]), ndim=x.ndim - 1) for x in points]
        log_p = self._log_density(values, flat, pt.repeat(pt.as_tensor(groups), count))
        terms = log_p.reshape((n, count)) + log_a
        error = self._errors(params)
        if not self.error_is_known:
            terms = terms + self._readings_log_density(error)
        likelihood = logsumexp_finite(terms)
        if self.share is not None:
            likelihood = likelihood - self._log_share(values, self.share)[groups]
        if self.stacked.repeats is not None:
            likelihood = likelihood + self.stacked.repeats.log_density(error, pt)
        gross_share = self.measurements[0].gross_errors
        if gross_share is not False:
            gross_share = params.get(gross_share, gross_share)
            gross = pt.log(gross_share) + self.stacked.log_gross
            likelihood = pt.logaddexp(pt.log1p(-gross_share) + likelihood, gross)
        weights = self.measurements[0].weights  # of one simulator without repeated readings
        return likelihood if weights is None else likelihood * weights

    def _errors(self, params: Mapping[Any, Any]) -> Any:
        """Return the unknown error of each output, (M,): one where it is known."""
        errors = []
        for m in self.measurements:
            error = params[m.extras["error"]] if "error" in m.extras else 1.0
            errors.append(error + pt.zeros(m.rows.shape[1]))
        return pt.concatenate(errors)

    def _log_density(self, values: dict[Any, Any], points: Sequence[Any], groups: Any) -> Any:
        """Return the log-density of points, (n, *event) by input, in populations of groups (n,).

        Parameters
        ----------
        values : dict
            Placeholders of the inputs' roots -> values.
        points : sequence
        groups : tensor of int, shape (n,)
        """
        symbols = list(values)
        dists, _ = self.inputs.rebuilt(symbols)
        if self.stacked.groups is not None:
            # A vector of groups in place of one makes vectors of the distributions' parameters.
            (group,) = (s for s, r in zip(symbols, self.inputs.roots, strict=True) if is_group(r))
            dists = vectorize_graph(dists, {group: groups})
            values = {symbol: value for symbol, value in values.items() if symbol is not group}
        log_p = log_density(self.inputs, dists, points)
        # After the densities are built: PyMC may clone parameters that are random.
        (log_p,) = graph_replace([log_p], values, strict=False)
        return log_p

    def _log_share(self, values: dict[Any, Any], share: ResponseShare) -> Any:
        """Return the graph of log S, the log share with a response, of the groups, (G,)."""
        size = 1 if self.stacked.groups is None else int(self.stacked.groups.max()) + 1
        points = [np.concatenate([x] * size) for x in self.coordinates.inputs(share.z)]
        groups = np.repeat(np.arange(size), len(share.z))
        log_b = share.log_b + self.coordinates.log_jacobian(share.z)
        log_p = self._log_density(values, list(map(pytensor.shared, points)), pt.as_tensor(groups))
        terms = log_p.reshape((size, len(share.z))) + pytensor.shared(log_b)
        inside = logsumexp_finite(terms[:, : share.with_response])
        outside = logsumexp_finite(terms[:, share.with_response :])
        is_unknown = pt.isinf(inside)
        log_ratio = outside - pt.switch(is_unknown, 0.0, inside)
        return pt.switch(is_unknown, 0.0, -pt.softplus(log_ratio))

    def _readings_log_density(self, error: Any) -> Any:
        """Return the log-density of the readings at the points, (S, K), for an unknown error."""
        outputs = self.points.outputs
        # Points that fill up the array have any output.
        outputs = np.where(np.isfinite(outputs), outputs, 1e30)
        unit = np.where(self.readings.is_relative[:, None], np.abs(outputs), 1.0)
        sd = error * self.stacked.scale[:, None] * unit
        variance = self.emulation.error**2 + sd**2
        return self.readings.symbolic_log_density(outputs, variance, pt)

    def draws(
        self,
        rng: np.random.Generator,
        params: Mapping[Any, Floats],
        n: int,
        measurement: Measurement | None = None,
    ) -> Floats:
        """Draw the emulated readings of n specimens of each population.

        Parameters
        ----------
        rng : Generator
        params : mapping
            Values by `variables`, shapes (P, *shape), without the group of a specimen: specimens
            are of the groups of the observed ones.
        n : int
        measurement : Measurement, optional
            The simulator; by default the outputs of all, with repeated readings as their mean.

        Returns
        -------
        ndarray, shape (P, n), (P, n, m) or (P, n, M)
            With the error of the readings, and gross errors where the metric has them. As many as
            the simulator's rows are of its specimens, so that repeated readings have common inputs.
            NaN in a population of which next to nothing has a response.
        """
        roots = [params[root] for root in self.inputs.roots if not is_group(root)]
        groups = self.stacked.groups if measurement is None else measurement.groups
        same: Any = slice(None)
        if measurement is not None and n == len(measurement.observed):
            numbers = self.numbers(measurement)
            _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
            same = first[inverse]

        def drawn() -> Floats:
            if groups is None:
                specimens, _ = self._density.sampler(roots, n, rng)
            else:
                specimens = self._of_groups(rng, roots, np.resize(groups, n))
            flat = [x[:, same].reshape(-1, *x.shape[2:]) for x in specimens]
            return self.emulated(flat).reshape(len(roots[0]), n, -1)

        outputs = drawn()
        # Specimens without a response are not measured.
        for _ in range(32):
            is_missing = np.isnan(outputs).any(axis=-1)
            if not is_missing.any():
                break
            outputs[is_missing] = drawn()[is_missing]
        if measurement is None:
            return self._measured(rng, outputs, self.readings, self.measurements, params)
        outputs = outputs[..., self.columns(measurement)]
        values = self._measured(rng, outputs, measurement.readings, [measurement], params)
        return values.reshape(*values.shape[:2], *measurement.event)

    def _measured(
        self,
        rng: np.random.Generator,
        outputs: Floats,
        readings: Readings,
        measurements: Sequence[Measurement],
        params: Mapping[Any, Floats],
    ) -> Floats:
        """Return readings of outputs, (P, n, m): with error, rounding and gross errors."""
        size, n, count = outputs.shape
        sd: Any = np.resize(readings.error, (n, count))
        for m in measurements:
            if "error" in m.extras and len(measurements) == 1:
                sd = params[m.extras["error"]].reshape(size, 1, -1)
        is_relative = np.resize(readings.is_relative, (n, count))
        sd = sd * np.where(is_relative, np.abs(outputs), 1.0)
        values = outputs + sd * rng.standard_normal(outputs.shape)
        step = np.resize(readings.step, (n, count))
        whole = np.where(step > 0, step, 1.0)
        values = np.where(step > 0, np.round(values / whole) * whole, values)
        share = measurements[0].gross_errors
        if share is not False:
            low, high = np.concatenate([m.range for m in measurements], axis=1)
            middle, width = (low + high) / 2, high - low
            anywhere = middle + width * (2 * rng.random(outputs.shape) - 1)
            probability = np.reshape(params.get(share, share), (-1, 1))
            is_gross = rng.random((size, n)) < probability
            values = np.where(is_gross[..., None], anywhere, values)
        return np.asarray(values)

    def _of_groups(
        self, rng: np.random.Generator, roots: Sequence[Floats], groups: NDArray[np.intp]
    ) -> list[Floats]:
        """Return specimens of each population, of these groups."""
        drawn: list[Floats] = []
        for group in np.unique(groups):
            values = iter(roots)
            completed = [
                np.full(len(roots[0]), group) if is_group(root) else next(values)
                for root in self.inputs.roots
            ]
            columns = np.flatnonzero(groups == group)
            specimens, _ = self._density.sampler(completed, len(columns), rng)
            drawn = drawn or [np.empty((x.shape[0], len(groups), *x.shape[2:])) for x in specimens]
            for whole, part in zip(drawn, specimens, strict=True):
                whole[:, columns] = part
        return drawn

    def emulated(self, inputs: Sequence[Floats]) -> Floats:
        """Return the emulated outputs of specimens, (n, *event) by input -> (n, M); no run is made.

        Beyond the runs' range an input has the response at the end of the range.
        """
        z = self.coordinates.of(inputs, 1)
        z = np.clip(z, self.emulation.box[0], self.emulation.box[1])
        return self.emulation.values(z)

    def observing(self, data: Mapping[str, Any]) -> SpecimenLikelihood:
        """Return the likelihood of other observed values by simulator, with the same runs.

        It is the same object where the values are the same.
        """
        changed = tuple(
            m.observing(data[m.name]) if _differs(data.get(m.name), m.observed) else m
            for m in self.measurements
        )
        if all(a is b for a, b in zip(changed, self.measurements, strict=True)):
            return self
        known = self.emulation if "_prepared" in vars(self) else self.known
        return replace(self, measurements=changed, known=known)


def misfit_findings(
    name: str, readings: Readings, roots: Roots, error: Floats, largest: float = 50.0
) -> list[Finding]:
    """Report specimens whose readings no inputs reproduce.

    Parameters
    ----------
    name : str
    readings : Readings
    roots : Roots
    error : ndarray, shape (m,)
        Standard deviation of the emulator's error.
    largest : float
        Misfit in nats that is still an error of the emulator: ten standard deviations.
    """
    best = np.full(len(readings), np.inf)
    np.minimum.at(best, roots.specimen, roots.misfit)
    has_root = np.isfinite(best)
    poor = np.flatnonzero(has_root & (best > largest))
    if not poor.size:
        return []
    rows = [
        int(np.flatnonzero(roots.specimen == i)[np.argmin(roots.misfit[roots.specimen == i])])
        for i in poor
    ]
    sd = np.where(readings.is_measured, readings.comparison_sd(error), 0.0)[poor]
    off = np.sqrt(np.mean((roots.residual[rows] * sd) ** 2, axis=0))
    outputs = ", ".join(f"{value:.2g}" for value in off)
    return [
        Finding(
            "readings-misfit",
            f"{name}: no inputs in the range of the priors reproduce the readings of "
            f"{poor.size} of {int(has_root.sum())} specimens, which are off by {outputs} (root "
            "mean square, by output), expected less than the error of the readings; pass "
            "prb.LogLikelihood(error=...) with its standard deviation, or gross_errors=True for "
            "single specimens, or look at the response and the priors.",
            "likelihood.md#readings-that-no-inputs-reproduce",
        )
    ]


def logsumexp_finite(terms: Any) -> TensorVariable:
    """Return the log of the sum of exponentials over the last axis, (N, K) -> (N,).

    -inf where all terms are -inf, with gradients of zero instead of NaN.
    """
    largest = pt.max(terms, axis=-1, keepdims=True)
    largest = pt.switch(pt.isinf(largest), 0.0, largest)
    total = pt.exp(terms - largest).sum(axis=-1)
    is_empty = pt.eq(total, 0.0)
    log_total = pt.log(pt.switch(is_empty, 1.0, total)) + largest[..., 0]
    return pt.switch(is_empty, -np.inf, log_total)


class SpecimenRV(RandomVariable):  # type: ignore[misc]
    """The operation of the observed variable: draws data sets, and carries the likelihood.

    PyTensor's rewriters keep every operation that they have met. The likelihood with its arrays is
    therefore referenced by applications of the operation, and weakly by the operation itself.
    """

    __props__ = ("name", "signature", "dtype", "inplace", "reference", "simulators")

    def __init__(
        self,
        name: str | None = None,
        signature: str | None = None,
        dtype: str = "floatX",
        inplace: bool = False,
        *,
        likelihood: SpecimenLikelihood | None = None,
        reference: Any = None,
        simulators: tuple[str, ...] = (),
    ) -> None:
        self.reference = reference if likelihood is None else weakref.ref(likelihood)
        # This one, after those with the same specimens, whose observed variables are parameters.
        self.simulators = simulators
        function = response_name(self.measurement.responses.function)
        label = f"Simulator of {function} by LogLikelihood"
        super().__init__(name=name or label, signature=signature, dtype=dtype, inplace=inplace)

    @property
    def likelihood(self) -> SpecimenLikelihood:
        """The log-likelihood by specimen."""
        likelihood = self.reference()
        if likelihood is None:
            raise RuntimeError("got an operation of a model that is gone")
        return likelihood

    @property
    def measurement(self) -> Measurement:
        """The measurement of this simulator."""
        return self.measurements[-1]

    @property
    def measurements(self) -> list[Measurement]:
        """The measurements of `simulators`."""
        by_name = {m.name: m for m in self.likelihood.measurements}
        return [by_name[name] for name in self.simulators]

    @property
    def variables(self) -> tuple[TensorVariable, ...]:
        """The variables that are its first parameters."""
        return self.likelihood.variables(self.simulators)

    def __str__(self) -> str:
        """Show the name and the signature, without the likelihood."""
        return f'prbayes_Simulator_rv{{"{self.signature}"}}'

    @property
    def _print_name(self) -> tuple[str, str]:
        """What PyMC prints for the distribution, as text and as LaTeX."""
        text = f"{response_name(self.measurement.responses.function)}, LogLikelihood"
        latex = text.replace("_", "\\_")
        return f"Simulator[{text}]", f"\\operatorname{{Simulator}}[\\text{{{latex}}}]"

    def __getstate__(self) -> dict[str, Any]:
        """Replace the weak reference, which has no pickle, by the likelihood."""
        return {**self.__dict__, "reference": self.likelihood}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the weak reference; the application keeps the likelihood."""
        self.__dict__.update(state)
        self.reference = weakref.ref(state["reference"])

    def make_node(self, *inputs: Any, **keywords: Any) -> Apply[Any, Any]:
        """Apply the operation; the application references the likelihood."""
        apply = super().make_node(*inputs, **keywords)
        apply.tag.likelihood = self.likelihood
        return apply

    def rng_fn(self, rng: np.random.Generator, *arguments: Any) -> Floats:
        """Draw responses of specimens; their shape is the last of the arguments."""
        *params, size = arguments
        measurement = self.measurement
        roots = {}
        batch: tuple[int, ...] = ()
        # Readings of other simulators, the last parameters, are not part of the population.
        for param, root in zip(params, self.variables, strict=False):
            if is_group(root):
                continue
            leading = param.shape[: param.ndim - root.type.ndim]
            batch = np.broadcast_shapes(batch, leading)
            roots[root] = param
        shape = batch if size is None else tuple(int(s) for s in size)
        n = len(measurement.observed) if not shape else shape[-1]
        # The last batch axis is that of the specimens, along which parameters have length one.
        populations = batch[:-1] if batch else ()
        flat = {}
        for root, param in roots.items():
            ndim = root.type.ndim
            first = param if param.ndim == ndim else param[..., 0, *(slice(None),) * ndim]
            tail = first.shape[first.ndim - ndim :]
            flat[root] = np.broadcast_to(first, (*populations, *tail)).reshape(-1, *tail)
        values = self.likelihood.draws(rng, flat, n, measurement)
        return values.reshape(*shape, *measurement.event)

    def _supp_shape_from_params(self, dist_params: Any, param_shapes: Any = None) -> Any:
        """Return the number of outputs of a specimen."""
        return [pt.constant(n, dtype="int64") for n in self.measurement.event]


class SpecimenDistribution(pm.Distribution):  # type: ignore[misc]
    """The distribution that PyMC makes the observed variable from."""

    rv_type = SpecimenRV

    @classmethod
    def rv_op(
        cls,
        *params: Any,
        likelihood: SpecimenLikelihood,
        simulators: tuple[str, ...],
        size: Any = None,
        rng: Any = None,
    ) -> TensorVariable:
        """Return a random variable that carries a likelihood."""
        *earlier, last = (m for m in likelihood.measurements if m.name in simulators)
        ndims = [v.type.ndim for v in likelihood.variables(simulators)]
        ndims += [m.observed.ndim for m in earlier]
        signature = rv_signature(ndims, len(last.event))
        op = SpecimenRV(signature=signature, likelihood=likelihood, simulators=simulators)
        generator = pt.random.shared_rng(seed=None) if rng is None else rng
        _, rv = op(*params, size=size, rng=generator, return_next_rng=True)
        return rv

    @classmethod
    def dist(cls, *params: Any, **kwargs: Any) -> TensorVariable:
        """Return a random variable outside a model."""
        return super().dist(params, **kwargs)

    @staticmethod
    def support_point(rv: TensorVariable, size: Any, *params: Any) -> TensorVariable:
        """Return where a sampler would start, were the variable not observed."""
        return pt.zeros_like(rv)


@_logprob.register(SpecimenRV)  # type: ignore[untyped-decorator]
def _log_density(
    op: SpecimenRV, values: Any, rng: Any, size: Any, *params: Any, **kwargs: Any
) -> TensorVariable:
    """Return the log-likelihoods of the specimens, (S,); none where a later simulator has them."""
    (value,) = values
    if builds_priors_alone() or op.measurement is not op.likelihood.measurements[-1]:
        return pt.zeros(0)
    variables = op.variables
    roots = {
        v: p if is_group(v) else p[(0,) * (p.ndim - v.type.ndim)]
        for v, p in zip(variables, params, strict=False)
    }
    measurements: Sequence[Measurement] = op.measurements
    earlier = zip(params[len(variables) :], measurements[:-1], strict=True)
    data = [_value_of(p[(0,) * (p.ndim - m.observed.ndim)]) for p, m in earlier] + [value]
    numbers = {m.name: known_value(v) for m, v in zip(measurements, data, strict=True)}
    likelihood = op.likelihood.observing(numbers)
    result = likelihood.log_likelihood(roots)
    conditions = [
        _equal(v, m.observed)
        for m, v in zip(likelihood.measurements, data, strict=True)
        if not all(isinstance(leaf, Constant) for leaf in ancestors([v]) if leaf.owner is None)
    ]
    if not conditions:
        return result
    return CheckParameterValue(
        f"{op.measurement.name}: got other observed values than when this was compiled, expected "
        "the same ones, whose points are part of it; compile it again, as pm.sample, prb.minimize "
        "and prb.sample_smc do"
    )(result, pt.all(pt.stack(conditions)))


def _value_of(variable: Any) -> Any:
    """Return a parameter without the marks by which PyMC separates variables that have a value."""
    marks = {
        v: v.owner.inputs[0]
        for v in ancestors([variable])
        if v.owner is not None and isinstance(v.owner.op, ValuedRV)
    }
    return graph_replace([variable], marks)[0] if marks else variable


def _equal(value: Any, observed: Floats) -> Any:
    """Return a graph of whether values are the observed ones."""
    equal = pt.eq(value[: len(observed)], observed)
    equal |= pt.isnan(value[: len(observed)]) & np.isnan(observed)
    return pt.eq(value.shape[0], len(observed)) & pt.all(equal)


def _differs(data: Any, observed: Floats) -> bool:
    """Return whether values are known and not the observed ones."""
    if data is None:
        return False
    values = np.asarray(data, dtype=np.float64)
    return values.shape != observed.shape or not np.array_equal(values, observed, equal_nan=True)


def specimen_likelihoods(model: pm.Model) -> dict[Any, SpecimenLikelihood]:
    """Return the likelihoods by specimen of a model, by their observed variables.

    Simulators with common specimens have the same one.

    Raises
    ------
    TypeError
        If it is no model.
    """
    if not isinstance(model, pm.Model):
        raise TypeError(f"model: got {called(model)}, expected a pm.Model")
    rvs = [rv for rv in model.observed_RVs if isinstance(rv.owner.op, SpecimenRV)]
    data = {rv.owner.op.simulators[-1]: known_value(model.rvs_to_values[rv]) for rv in rvs}
    result = {rv: rv.owner.op.likelihood for rv in rvs}
    current = {old: old.observing(data) for old in result.values()}
    for rv, old in result.items():
        if current[old] is not old:
            set_likelihood(rv, current[old])
    return {rv: current[old] for rv, old in result.items()}


def set_likelihood(rv: Any, likelihood: SpecimenLikelihood) -> None:
    """Give an observed variable another likelihood."""
    properties = {**rv.owner.op._props_dict(), "reference": weakref.ref(likelihood)}
    rv.owner.op = SpecimenRV(**properties)
    rv.owner.tag.likelihood = likelihood


def measurements_of(model: pm.Model) -> dict[Any, Measurement]:
    """Return the simulators with a log-likelihood by specimen, by their observed variables."""
    return {rv: rv.owner.op.measurement for rv in specimen_likelihoods(model)}


def require_simulator(model: pm.Model) -> None:
    """Raise if a model has no simulator of any kind; nothing is run."""
    if not any(isinstance(rv.owner.op, SpecimenRV) for rv in model.observed_RVs):
        required_simulators(model)
