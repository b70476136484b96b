"""The observed variable of the log-likelihood by specimen, as PyMC evaluates it.

Its log-density is a vector with an element for each specimen,

    log p(y_i | theta) = logsumexp_k(log p(x_ik | theta) + A_ik),

a graph of PyMC's own log-densities of the inputs at points x_ik. Points and numbers A_ik are
computed at the first use, from runs and an emulator (`prbayes.propagation.specimen_points`). They
contain no hyperparameter, so that NUTS, SMC and optimisers evaluate the graph without a run.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.logprob.abstract import _logprob
from pymc.logprob.utils import CheckParameterValue
from pytensor.graph.basic import Apply, Constant
from pytensor.graph.replace import graph_replace, vectorize_graph
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable

from prbayes._checks import Floats, called
from prbayes._finding import Finding, report
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.readings import Readings
from prbayes.model.data_checks import data_findings
from prbayes.model.node import (
    builds_priors_alone,
    known_value,
    required_simulators,
    response_name,
    rv_signature,
)
from prbayes.model.population_draws import Populations
from prbayes.model.run_checks import (
    emulator_findings,
    refuse_scatter,
    refuse_undetermined,
    refuse_unreachable,
    refuse_unused_inputs,
    unreached,
)
from prbayes.propagation.base import DesignError, Propagation
from prbayes.propagation.coordinates import Coordinates
from prbayes.propagation.fibre_points import fibre_points
from prbayes.propagation.response_share import ResponseShare, response_share
from prbayes.propagation.roots import Roots
from prbayes.propagation.specimen_points import (
    Emulation,
    PointOptions,
    SpecimenPoints,
    draw_points,
    emulate,
)
from prbayes.response.costs import in_words
from prbayes.response.distributions import PopulationSampler, log_density, prior_draws
from prbayes.response.grouping import is_group
from prbayes.response.inputs import Inputs, aleatory_names
from prbayes.response.outputs import Outputs
from prbayes.response.response import Responses

_log = logging.getLogger("prbayes")


@dataclass(frozen=True, eq=False)
class SpecimenLikelihood:
    """One simulator whose metric is the log-likelihood by specimen.

    Attributes
    ----------
    name : str
    metric : LogLikelihood
    observed : ndarray, shape (N,) or (N, m)
    readings : Readings
    weights : ndarray, shape (N,), or None
        Factors of the specimens' log-likelihoods, which sum to N.
    specimens : ndarray, shape (N,), or None
        Labels.
    inputs : Inputs
    responses : Responses
    propagation : Propagation
    outputs : Outputs
    groups : ndarray of int, shape (N,), or None
        Index of each specimen's group.
    extras : dict
        Model variables of the measurement, beside the roots of the inputs: ``error`` and
        ``gross_errors``.
    """

    name: str
    metric: LogLikelihood
    observed: Floats
    readings: Readings
    weights: Floats | None
    specimens: NDArray[Any] | None
    inputs: Inputs
    responses: Responses
    propagation: Propagation
    outputs: Outputs
    groups: NDArray[np.intp] | None = None
    extras: Mapping[str, TensorVariable] = field(default_factory=dict)
    model: Any = None  # weak reference to the pymc.Model
    known: Emulation | None = None  # of the same response, for other data
    options: PointOptions = field(default_factory=PointOptions)

    def __getstate__(self) -> dict[str, Any]:
        """Replace the weak reference, which has no pickle, by the model."""
        return {**vars(self), "model": None if self.model is None else self.model()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the weak reference."""
        model = state["model"]
        vars(self).update({**state, "model": None if model is None else weakref.ref(model)})

    @property
    def variables(self) -> tuple[TensorVariable, ...]:
        """The model variables that the log-density depends on: roots of the inputs, then extras."""
        return (*self.inputs.roots, *self.extras.values())

    @property
    def event(self) -> tuple[int, ...]:
        """Shape of one specimen's outputs, () or (m,)."""
        return self.observed.shape[1:]

    @cached_property
    def coordinates(self) -> Coordinates:
        """Coordinates of the inputs."""
        return Coordinates.of_prior(self.inputs)

    def run(self, z: Floats) -> Floats:
        """Return the outputs of runs at coordinates, (n, d) -> (n, m).

        NaN where there is no response, +inf where a specimen failed.

        The first runs are checked for scatter and for the range of the readings.
        """
        before = self.responses.computed
        values = self.responses(self.coordinates.inputs(z), [])
        values = values.reshape(len(z), -1)
        values = np.where(np.isneginf(values), np.nan, values)
        if self.known is None and self._first_outputs is None:
            if self.responses.computed > before:

                def alone(row: int) -> Floats:
                    inputs = self.coordinates.inputs(z[row : row + 1])
                    return self.responses.alone(inputs).ravel()

                refuse_scatter(self.name, values, alone)
            refuse_unreachable(self.name, values, self.readings)
            refuse_unused_inputs(self.name, z, values, self._coordinate_names)
            vars(self)["_first_outputs"] = values
        return values

    @cached_property
    def _first_outputs(self) -> Floats | None:
        """Outputs of the first runs, (n, m), once they were made and checked."""
        return None

    @property
    def _coordinate_names(self) -> list[str]:
        """The name of the input of each coordinate."""
        names = aleatory_names(self.inputs, self.responses.function)
        sizes = [int(np.prod(shape, dtype=int)) for shape in self.inputs.event_shapes]
        return [name for name, size in zip(names, sizes, strict=True) for _ in range(size)]

    @cached_property
    def _prepared(
        self,
    ) -> tuple[Emulation, SpecimenPoints, tuple[Finding, ...], ResponseShare | None]:
        """The emulator, the points, what is to be reported of them, and the share of responses."""
        self.responses.on_start = self._log_first_runs
        populations = self.populations
        try:
            emulation, points, findings = self._prepare(populations, self.known)
            refined, share = response_share(
                self.run, emulation, populations.prior_specimens,
                partial(populations.posterior, points.z, points.log_a), self.options,
                name=self.name,
            )  # fmt: skip
            if refined is not emulation and not self._is_partial:
                # Specimens beside the failing region have points on its right side now.
                refined, points, findings = self._prepare(populations, refined)
            return refined, points, report(findings), share
        except DesignError as error:
            raise DesignError(f"{error}{self._causes()}") from None
        finally:
            self.responses.on_start = None

    def _causes(self) -> str:
        """Return what the data show of the causes of a refusal, as sentences."""
        first = self._first_outputs
        outside = "" if first is None else unreached(first, self.readings)
        findings = self._data_findings(several_roots=False)
        return outside + "".join(f". {finding}" for finding in findings)

    def _log_first_runs(self, runs: int, seconds: float) -> None:
        """Log how many runs there are, how long they take, and which number changes them."""
        self.responses.on_start = None
        total = np.ceil(runs / self.responses.workers) * seconds
        duration = f", about {in_words(float(total))}" if total >= 1 else ""
        more = max(runs // 2, self.options.fresh)
        _log.info(
            "%s: runs at first: %d%s; then %d at a time at the roots of the specimens; to change "
            "this, pass another number in propagation=prb.Reweighted(n=%d)",
            self.name,
            runs,
            duration,
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
        name, n = self.name, self.propagation.emulator_runs
        bounds, d = self.coordinates.bounds, self.coordinates.size
        if self._is_partial:
            if self.propagation.calls_response:
                raise TypeError(
                    f"{name}: propagation: got prb.Resimulated, expected stored responses where "
                    "specimens have fewer readings than inputs; leave propagation= out"
                )
            emulation, points = fibre_points(
                self.run, self.readings, bounds, populations.prior_specimens(),
                populations.posterior, self.options, n=n, name=name,
            )  # fmt: skip
            return emulation, points, self._data_findings(several_roots=True)
        box = np.stack([-np.ones(d), np.ones(d)])
        if self.propagation.calls_response:
            known = Emulation.of_function(self.run, box, bounds, self.readings, self.options)
        emulation, roots = emulate(
            self.run, self.readings, box, bounds, self.options, n=n, known=known, name=name
        )
        if not self.propagation.calls_response:
            refuse_undetermined(name, emulation, roots, self._coordinate_names)
        points = draw_points(
            emulation,
            emulation.error,
            self.readings,
            roots,
            emulation.box,
            self.options,
            error_is_known="error" not in self.extras,
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
        return Populations(self.model, self.inputs, self.coordinates, self.groups)

    @property
    def _is_partial(self) -> bool:
        """Whether specimens have fewer readings than inputs, without censored ones in place."""
        present = self.readings.is_measured | self.readings.is_censored
        return bool((present.sum(axis=1) < self.coordinates.size).any())

    def _data_findings(self, *, several_roots: bool) -> tuple[Finding, ...]:
        """Return findings of rounded, censored and repeated readings that are taken as exact."""
        steps = self.readings.step.max(axis=0)
        # A reading error that the user gives covers rounding.
        is_stated = (steps > 0) | (self.metric.error is not None)
        steps = np.where(is_stated, np.maximum(steps, 1e-300), np.nan)
        names = self.outputs.names
        return data_findings(
            self.readings.values,
            labels=[f"{self.name}[{label}]" for label in names] or [self.name],
            several_roots=several_roots,
            rounded=steps,
        )

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
    def arrays(self) -> tuple[list[Any], Any]:
        """Shared variables of the points, (N, K, *event) by input, and of the numbers A, (N, K)."""
        points = self.points
        # The proposal is a density of z: p(x) dx = p(x(z)) |dx/dz| dz.
        is_known = "error" not in self.extras
        log_a = points.log_a if is_known else -points.log_proposal
        log_a = log_a + self.coordinates.log_jacobian(points.z)
        shared = [
            pytensor.shared(np.ascontiguousarray(x), name=f"{self.name}_points_{i}")
            for i, x in enumerate(self.coordinates.inputs(points.z))
        ]
        return shared, pytensor.shared(log_a, name=f"{self.name}_log_a")

    def log_likelihood(self, params: Sequence[Any]) -> TensorVariable:
        """Return the graph of the log-likelihoods of the specimens, (N,).

        Parameters
        ----------
        params : sequence
            Values of `variables`.
        """
        points, log_a = self.arrays
        n, count = self.observed.shape[0], log_a.shape[1]
        symbols = self.inputs.placeholders()
        values = dict(zip(symbols, params[: len(symbols)], strict=True))
        extras = dict(zip(self.extras, params[len(symbols) :], strict=True))
        groups = np.zeros(n, dtype=np.intp) if self.groups is None else self.groups
        flat = [x.reshape((n * count, *x.shape[2:]), ndim=x.ndim - 1) for x in points]
        log_p = self._log_density(values, flat, pt.repeat(pt.as_tensor(groups), count))
        terms = log_p.reshape((n, count)) + log_a
        if "error" in extras:
            terms = terms + self._readings_log_density(extras["error"])
        likelihood = logsumexp_finite(terms)
        if self.share is not None:
            likelihood = likelihood - self._log_share(values, self.share)[groups]
        gross_share = extras.get("gross_errors", self.metric.gross_errors)
        if gross_share is not False:
            gross = pt.log(gross_share) + self.log_gross_density
            likelihood = pt.logaddexp(pt.log1p(-gross_share) + likelihood, gross)
        return likelihood if self.weights is None else likelihood * self.weights

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
        if self.groups is not None:
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
        size = 1 if self.groups is None else int(self.groups.max()) + 1
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
        """Return the log-density of the readings at the points, (N, K), for an unknown error."""
        outputs = self.points.outputs
        sd = (
            error * np.abs(np.nan_to_num(self.readings.values))[:, None]
            if (self.metric.relative)
            else error
        )
        variance = self.emulation.error**2 + sd**2
        # Points that fill up the array have any output.
        outputs = np.where(np.isfinite(outputs), outputs, 1e30)
        return self.readings.symbolic_log_density(outputs, variance + pt.zeros((1, 1, 1)), pt)

    @cached_property
    def log_gross_density(self) -> Floats:
        """Log-density of a specimen with a gross error, (N,): uniform over twice the ranges."""
        rows = self.observed.reshape(len(self.observed), -1)
        width = 2 * (np.nanmax(rows, axis=0) - np.nanmin(rows, axis=0))
        logs = np.where(np.isnan(rows), 0.0, np.log(np.where(width > 0, width, 1.0)))
        return np.asarray(-logs.sum(axis=1))

    def draws(self, rng: np.random.Generator, params: Sequence[Floats], n: int) -> Floats:
        """Draw the emulated readings of n specimens of each population.

        Parameters
        ----------
        rng : Generator
        params : sequence of ndarray, shapes (P, *shape)
            Values of `variables` without the group of a specimen: specimens are of the groups of
            the observed ones.
        n : int

        Returns
        -------
        ndarray, shape (P, n) or (P, n, m)
            With the error of the readings, and gross errors where the metric has them. NaN in a
            population of which next to nothing has a response.
        """
        count = sum(not is_group(root) for root in self.inputs.roots)
        roots, extras = params[:count], dict(zip(self.extras, params[count:], strict=True))
        size = len(roots[0])

        def drawn() -> Floats:
            if self.groups is None:
                specimens, _ = self._sampler(roots, n, rng)
            else:
                specimens = self._of_groups(rng, roots, n)
            flat = [x.reshape(size * n, *x.shape[2:]) for x in specimens]
            return self.emulated(flat).reshape(size, n, -1)

        outputs = drawn()
        # Specimens without a response are not measured.
        for _ in range(32):
            is_missing = np.isnan(outputs).any(axis=-1)
            if not is_missing.any():
                break
            outputs[is_missing] = drawn()[is_missing]
        return self._measured(rng, outputs, extras).reshape(size, n, *self.event)

    def _measured(
        self, rng: np.random.Generator, outputs: Floats, extras: Mapping[str, Floats]
    ) -> Floats:
        """Return readings of outputs, (P, n, m): with error, rounding and gross errors."""
        size, n, m = outputs.shape
        sd: Any = np.resize(self.readings.error, (n, m))
        if "error" in extras:
            sd = extras["error"].reshape(size, 1, -1)
            sd = sd * np.abs(outputs) if self.metric.relative else sd
        values = outputs + sd * rng.standard_normal(outputs.shape)
        step = np.resize(self.readings.step, (n, m))
        whole = np.where(step > 0, step, 1.0)
        values = np.where(step > 0, np.round(values / whole) * whole, values)
        share = extras.get("gross_errors", self.metric.gross_errors)
        if share is not False:
            rows = self.observed.reshape(len(self.observed), -1)
            low, high = np.nanmin(rows, axis=0), np.nanmax(rows, axis=0)
            anywhere = (low + high) / 2 + (high - low) * (2 * rng.random(outputs.shape) - 1)
            is_gross = rng.random((size, n)) < np.reshape(share, (-1, 1))
            values = np.where(is_gross[..., None], anywhere, values)
        return np.asarray(values)

    def _of_groups(self, rng: np.random.Generator, roots: Sequence[Floats], n: int) -> list[Floats]:
        """Return specimens of each population, each of the group of an observed one."""
        assert self.groups is not None
        groups = np.resize(self.groups, n)
        drawn: list[Floats] = []
        for group in np.unique(groups):
            values = iter(roots)
            completed = [
                np.full(len(roots[0]), group) if is_group(root) else next(values)
                for root in self.inputs.roots
            ]
            columns = np.flatnonzero(groups == group)
            specimens, _ = self._sampler(completed, len(columns), rng)
            drawn = drawn or [np.empty((x.shape[0], n, *x.shape[2:])) for x in specimens]
            for whole, part in zip(drawn, specimens, strict=True):
                whole[:, columns] = part
        return drawn

    def emulated(self, inputs: Sequence[Floats]) -> Floats:
        """Return the emulator's responses of specimens, (n, *event) by input; no run is made.

        Beyond the runs' range an input has the response at the end of the range.
        """
        z = self.coordinates.of(inputs, 1)
        z = np.clip(z, self.emulation.box[0], self.emulation.box[1])
        values, _ = self.emulation(z)
        return values.reshape(len(z), *self.event)

    @cached_property
    def _sampler(self) -> PopulationSampler:
        return PopulationSampler(self.inputs)

    def observing(self, values: Floats) -> SpecimenLikelihood:
        """Return the likelihood of other observed responses, with the same runs."""
        values = np.asarray(values, dtype=np.float64)
        if values.ndim != self.observed.ndim or values.shape[1:] != self.event:
            raise ValueError(
                f"{self.name}: observed: got shape {values.shape}, expected "
                f"{('N', *self.event)}, as when the simulator was made"
            )
        rows = values.reshape(len(values), -1)
        readings = self.metric.readings(rows, reference_error(self.extras), self.event)
        if len(values) != len(self.observed) and not (
            self.groups is None and self.weights is None and self.specimens is None
        ):
            raise ValueError(
                f"{self.name}: observed: got {len(values)} specimens, expected "
                f"{len(self.observed)}, as many as there are groups, weights= or specimens=; build "
                "the model again with those of the new ones"
            )
        known = self.emulation if "_prepared" in vars(self) else self.known
        return replace(self, observed=values, readings=readings, known=known)


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
    rows = [int(np.flatnonzero(roots.specimen == i)[np.argmin(roots.misfit[roots.specimen == i])])
            for i in poor]  # fmt: skip
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
            "single specimens, or look at the response and the priors",
            "likelihood.md#readings-that-no-inputs-reproduce",
        )
    ]


def reference_error(extras: Mapping[str, TensorVariable]) -> Floats | None:
    """Return a plausible value of an unknown reading error: its prior's 84 % quantile."""
    if "error" not in extras:
        return None
    (draws,) = prior_draws([extras["error"]], 512, seed=0)
    return np.asarray(np.quantile(draws, 0.84, axis=0))


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

    __props__ = ("name", "signature", "dtype", "inplace", "reference")

    def __init__(
        self,
        name: str | None = None,
        signature: str | None = None,
        dtype: str = "floatX",
        inplace: bool = False,
        *,
        likelihood: SpecimenLikelihood | None = None,
        reference: Any = None,
    ) -> None:
        self.reference = reference if likelihood is None else weakref.ref(likelihood)
        function = response_name(self.likelihood.responses.function)
        label = f"Simulator of {function} by LogLikelihood"
        super().__init__(name=name or label, signature=signature, dtype=dtype, inplace=inplace)

    @property
    def likelihood(self) -> SpecimenLikelihood:
        """The log-likelihood by specimen."""
        likelihood = self.reference()
        if likelihood is None:
            raise RuntimeError("got an operation of a model that is gone")
        return likelihood

    def __str__(self) -> str:
        """Show the name and the signature, without the likelihood."""
        return f'prbayes_Simulator_rv{{"{self.signature}"}}'

    @property
    def _print_name(self) -> tuple[str, str]:
        """What PyMC prints for the distribution, as text and as LaTeX."""
        text = f"{response_name(self.likelihood.responses.function)}, LogLikelihood"
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
        likelihood = self.likelihood
        roots = []
        batch: tuple[int, ...] = ()
        variables = likelihood.variables
        for param, root in zip(params, variables, strict=True):
            if is_group(root):
                continue
            leading = param.shape[: param.ndim - root.type.ndim]
            batch = np.broadcast_shapes(batch, leading)
            roots.append(param)
        shape = batch if size is None else tuple(int(s) for s in size)
        n = len(likelihood.observed) if not shape else shape[-1]
        # The last batch axis is that of the specimens, along which parameters have length one.
        populations = batch[:-1] if batch else ()
        event_shapes = [r.type.shape for r in variables if not is_group(r)]
        flat = []
        for param, event in zip(roots, event_shapes, strict=True):
            ndim = len(event)
            first = param if param.ndim == ndim else param[..., 0, *(slice(None),) * ndim]
            tail = first.shape[first.ndim - ndim :]
            flat.append(np.broadcast_to(first, (*populations, *tail)).reshape(-1, *tail))
        values = likelihood.draws(rng, flat, n)
        return values.reshape(*shape, *likelihood.event)

    def _supp_shape_from_params(self, dist_params: Any, param_shapes: Any = None) -> Any:
        """Return the number of outputs of a specimen."""
        return [pt.constant(n, dtype="int64") for n in self.likelihood.event]


class SpecimenDistribution(pm.Distribution):  # type: ignore[misc]
    """The distribution that PyMC makes the observed variable from."""

    rv_type = SpecimenRV

    @classmethod
    def rv_op(
        cls, *params: Any, likelihood: SpecimenLikelihood, size: Any = None, rng: Any = None
    ) -> TensorVariable:
        """Return a random variable that carries a likelihood."""
        signature = rv_signature([r.type.ndim for r in likelihood.variables], len(likelihood.event))
        op = SpecimenRV(signature=signature, likelihood=likelihood)
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
    """Return the log-likelihoods of the specimens, (N,)."""
    (value,) = values
    likelihood = op.likelihood
    if builds_priors_alone():
        return pt.zeros(len(likelihood.observed))
    data = known_value(value)
    if data is not None and not _same(data, likelihood.observed):
        likelihood = likelihood.observing(data)
    roots = [
        p if is_group(r) else p[(0,) * (p.ndim - r.type.ndim)]
        for p, r in zip(params, likelihood.variables, strict=True)
    ]
    result = likelihood.log_likelihood(roots)
    if isinstance(value, Constant):
        return result
    observed = likelihood.observed
    first = value[: len(observed)]
    equal = pt.eq(first, observed) | (pt.isnan(first) & np.isnan(observed))
    same = pt.eq(value.shape[0], len(observed)) & pt.all(equal)
    return CheckParameterValue(
        f"{likelihood.name}: got other observed values than when this was compiled, expected the "
        "same ones, whose points are part of it; compile it again, as pm.sample, prb.minimize and "
        "prb.sample_smc do"
    )(result, same)


def _same(data: Any, observed: Floats) -> bool:
    values = np.asarray(data, dtype=np.float64)
    return values.shape == observed.shape and np.array_equal(values, observed, equal_nan=True)


def specimen_likelihoods(model: pm.Model) -> dict[Any, SpecimenLikelihood]:
    """Return the likelihoods by specimen of a model, by their observed variables.

    Raises
    ------
    TypeError
        If it is no model.
    """
    if not isinstance(model, pm.Model):
        raise TypeError(f"model: got {called(model)}, expected a pm.Model")
    result = {}
    for rv in model.observed_RVs:
        if isinstance(rv.owner.op, SpecimenRV):
            likelihood = rv.owner.op.likelihood
            data = known_value(model.rvs_to_values[rv])
            if data is not None and not _same(data, likelihood.observed):
                likelihood = likelihood.observing(data)
                rv.owner.op = SpecimenRV(
                    **{**rv.owner.op._props_dict(), "reference": weakref.ref(likelihood)}
                )
                rv.owner.tag.likelihood = likelihood
            result[rv] = likelihood
    return result


def require_simulator(model: pm.Model) -> None:
    """Raise if a model has no simulator of any kind; nothing is run."""
    if not any(isinstance(rv.owner.op, SpecimenRV) for rv in model.observed_RVs):
        required_simulators(model)
