"""A result's populations, and a response of their specimens, from stored responses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from scipy.special import ndtri

from prbayes._validate import AT_ONCE, Floats
from prbayes.decision.quantities import Quantity
from prbayes.inference.identifiability import oriented
from prbayes.model.emulated import (
    EmulatedResponse,
    EmulatedSample,
    EmulatedSimulator,
    values_of,
)
from prbayes.model.evaluator import Evaluator
from prbayes.numerics.points import sobol
from prbayes.optimize.optimum import Optimum, require_sampling
from prbayes.propagation.base import DesignError
from prbayes.propagation.reweighted import Design
from prbayes.response.groups import refuse_groups
from prbayes.response.inputs import read_inputs
from prbayes.response.outputs import Outputs, lacking
from prbayes.response.response import Responses
from prbayes.results.predict import (
    known_outputs,
    model_of,
    populations_of,
    refuse_unsupported,
    serving,
)

# Draws at which it is looked whether the design supports a result: quantiles of so many are known
# to a few percent, and they cost a weight at each point.
_SUPPORTED_AT = 400


@dataclass(frozen=True, eq=False)
class Populations:
    """The populations that a result stands for, as thetas."""

    evaluator: Evaluator
    thetas: Floats  # (k, d): the posterior's draws, or what an optimum's sampling distribution says
    center: Floats  # (d,): the median, or the optimum
    caller: str  # for messages
    drawn: bool  # whether thetas are draws, which scatter, and not spread evenly

    @classmethod
    def of(cls, result: Any, model: pm.Model | None, draws: int, caller: str) -> Populations:
        """Read a result.

        Raises
        ------
        TypeError, KeyError, ValueError
            If it is none, or another model's, or an optimum without standard errors.
        """
        model = model_of(result, model, caller)
        if isinstance(result, Optimum):
            thetas = _normal_thetas(result, draws, caller)
            own = model is result.model
            evaluator = result.evaluator if own else Evaluator.of(model)
            return cls(evaluator, thetas, result.theta, caller, drawn=False)
        points, _ = populations_of(result, model, draws, caller)
        evaluator = Evaluator.of(model)
        thetas = evaluator.hyperparameters.thetas_of(
            [points[str(rv.name)] for rv in model.free_RVs]
        )
        return cls(evaluator, thetas, np.median(thetas, axis=0), caller, drawn=True)

    def responses(
        self, response: Callable[..., Any], inputs: Sequence[Any], **calling: Any
    ) -> Responses:
        """Return a response with its inputs."""
        label = str(getattr(response, "__name__", type(response).__name__))
        sorted_inputs = read_inputs(label, inputs, self.evaluator.model)
        refuse_groups(f"{self.caller}: {label}", sorted_inputs.roots)
        return Responses(
            label,
            response,
            sorted_inputs,
            outputs=known_outputs(self.evaluator.simulators, response),
            **calling,
        )

    def design_for(self, responses: Responses) -> int:
        """Return which simulator has stored or emulated specimens of a response.

        Raises
        ------
        TypeError
            If none has.
        """
        simulator = serving(self.evaluator.simulators, responses)
        if simulator is None:
            raise TypeError(
                f"{self.caller}: {responses.name}: got inputs of which no simulator of the model "
                "has stored responses, expected the .dist() objects of one with prb.Reweighted(), "
                "and constants"
            )
        return self.evaluator.simulators.index(simulator)

    @cached_property
    def _samples(self) -> dict[int, EmulatedSample]:
        return {}

    def _sample(self, k: int, simulator: EmulatedSimulator) -> EmulatedSample:
        """Return the weighted specimens of a simulator whose responses are emulated."""
        if k not in self._samples:
            roots = self.evaluator.roots(self.thetas, k)
            self._samples[k] = EmulatedSample.of(simulator, roots)
        return self._samples[k]

    def told(
        self, response: Callable[..., Any], inputs: Sequence[Any], output: Any, **calling: Any
    ) -> Told:
        """Return a response of the design's specimens; what is not known of it is computed.

        Raises
        ------
        DesignError
            If the design does not support the populations, or too many responses are NaN.
        """
        found = self.all_outputs(response, inputs, **calling)
        return replace(found, place=output_place(found.responses, found.every, output))

    def all_outputs(
        self, response: Callable[..., Any], inputs: Sequence[Any], **calling: Any
    ) -> Told:
        """Return the same of all outputs together."""
        responses = self.responses(response, inputs, **calling)
        k = self.design_for(responses)
        simulator = self.evaluator.simulators[k]
        if simulator.is_emulated:
            sample = self._sample(k, simulator)
            emulator = simulator.emulator(responses)
            values = emulator(sample.points_of(responses.inputs))
            found = Told(self, k, sample, responses, values, None, emulator)
        else:
            design = simulator.design
            assert design is not None
            found = Told(self, k, design, responses, design.values_of(responses), None)
        found.refuse_unsupported()
        return found


@dataclass(frozen=True, eq=False)
class Told:
    """One output of a response at the points of a design."""

    populations: Populations
    k: int  # which simulator has the design
    design: Design | EmulatedSample
    responses: Responses
    every: Floats  # (n,) or (n, m): all outputs at the design's points
    place: int | None  # of the output; None where there is one
    emulator: EmulatedResponse | None = None  # of the response, where it is not stored

    def emulated(self, points: Sequence[Floats]) -> list[Floats]:
        """Return the output at specimens as emulators give it, (n,) each: the best one first.

        The others differ from it by its error: they lack a block of the runs each, or are off by
        the error at runs that are left out. Empty where responses are stored and not emulated.

        Parameters
        ----------
        points : sequence of ndarray, shapes (n, *event)
            Of the inputs of the design.
        """
        if self.emulator is None:
            assert self.design.has_runs
            return [self.column(v) for v in self.design.emulated(self.responses, list(points))]
        values = self.emulator(values_of(points, self.design.inputs, self.responses.inputs))
        error = self.emulator.error.reshape(self.emulator.event)
        return [self.column(values), self.column(values + error)]

    @property
    def points(self) -> list[Floats]:
        """The specimens, shapes (n, *event), by input."""
        design = self.design
        return list(design.contents.table.points if design.has_runs else design.points)

    def column(self, values: Floats) -> Floats:
        """Return the output, (..., n) or (..., n, m) -> (..., n)."""
        return values if self.place is None else values[..., self.place]

    @cached_property
    def _known(self) -> NDArray[np.intp]:
        """The points that have a response, in ascending order of it."""
        values = self.column(self.every)
        order = np.argsort(values, kind="stable")
        return order[~np.isnan(values[order])]

    @cached_property
    def values(self) -> Floats:
        """The responses in ascending order, (n,)."""
        return self.column(self.every)[self._known]

    @cached_property
    def blocks(self) -> NDArray[np.intp]:
        """Which of the design's blocks each of them is in, (n,)."""
        return self.design.blocks[self._known]

    def weights(self, thetas: Floats) -> Floats:
        """Return weights of the responses in populations, (k, d) -> (k, n): they sum to one."""
        roots = self.populations.evaluator.roots(thetas, self.k)
        _, weights = self.design.populations(roots)
        known = weights[:, self._known]
        with np.errstate(invalid="ignore"):
            return known / known.sum(axis=1, keepdims=True)

    def mean_weights(self, thetas: Floats) -> Floats:
        """Return the mean of the weights of populations, (k, d) -> (n,), of those there are."""
        total = np.zeros(self.values.size)
        for weights in self._some_weights(thetas):
            total += np.nansum(weights, axis=0)
        return total / total.sum()

    def at(self, quantity: Quantity, thetas: Floats) -> Floats:
        """Return a quantity of populations, (k, d) -> (k,); NaN where there is no population."""
        return np.concatenate([quantity.of(self.values, w) for w in self._some_weights(thetas)])

    def _some_weights(self, thetas: Floats) -> Iterator[Floats]:
        """Yield the weights of some populations at a time, as many as fit into memory."""
        step = max(1, AT_ONCE // self.design.n_points)
        for first in range(0, len(thetas), step):
            yield self.weights(thetas[first : first + step])

    def refuse_unsupported(self) -> None:
        """Raise if the design does not support the populations, or they lose too much of it."""
        thetas = self.populations.thetas[:: max(1, len(self.populations.thetas) // _SUPPORTED_AT)]
        roots = self.populations.evaluator.roots(thetas, self.k)
        if self.design.has_runs:
            refuse_unsupported(self.responses.name, self.design, roots)
        else:
            self.design.refuse_unsupported(self.responses.name, roots)
        _, weights = self.design.populations(roots)
        lost = float(np.nanmedian(weights[:, lacking(self.every)].sum(axis=1)))
        if lost > self.design.max_lost:
            raise DesignError(
                f"{self.responses.name}: lost mass: got {lost:.1%} of a population's weight on "
                f"points whose response is NaN, expected at most {self.design.max_lost:.1%}; "
                "repair it, or return +inf for specimens that fail"
            )

    def refuse_failed(self, quantity: Quantity) -> None:
        """Raise if specimens failed, of which the quantity is no number."""
        if quantity.needs_finite and np.isposinf(self.values[-1]):
            raise ValueError(
                f"{self.populations.caller}: {quantity!r}: got specimens that failed (+inf), of "
                "which there is none, expected finite responses; ask for a Quantile or an "
                "Exceedance"
            )


def _normal_thetas(optimum: Optimum, draws: int, caller: str) -> Floats:
    """Return thetas spread evenly over the sampling distribution of an optimum, (draws, d)."""
    require_sampling(optimum, caller)
    covariance = optimum.covariance
    if not np.isfinite(covariance).all():
        hidden = [
            name
            for name, variance in zip(optimum.names, np.diag(covariance), strict=True)
            if not np.isfinite(variance)
        ]
        raise ValueError(
            f"{caller}: got an optimum that says nothing of the uncertainty of {hidden}, expected "
            "a standard error of each; pass the posterior of prb.sample_smc"
        )
    z = ndtri(sobol(draws, optimum.theta.size, seed=0))
    values, vectors = np.linalg.eigh(covariance)
    root = oriented(vectors) * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(optimum.theta + z @ root.T)


def output_place(responses: Responses, values: Floats, output: Any) -> int | None:
    """Return which column of responses an output is; None where there is only one number.

    Raises
    ------
    ValueError, KeyError
        If it is none of them, or there are several and none is named.
    """
    if values.ndim == 1:
        if output is not None:
            raise ValueError(
                f"{responses.name}: output: got {output!r} of a response that has one number, "
                "expected None"
            )
        return None
    outputs = responses.outputs or Outputs(tuple(range(values.shape[1])))
    labels = list(outputs.labels)
    if output is None:
        raise ValueError(
            f"{responses.name}: got a response of {len(labels)} outputs, expected output= to say "
            f"which, of {list(outputs.names)[:9]}"
        )
    for known in (labels, list(outputs.names)):
        if output in known:
            return known.index(output)
    raise KeyError(f"{responses.name}: output: got {output!r}, expected one of {labels[:9]}")
