"""What a model costs before it is computed: how many runs, what for, and one of them as a trial."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pymc as pm

from prbayes._validate import called, flag
from prbayes.metrics.base import Discrepancy
from prbayes.model.description import without_addresses
from prbayes.model.measurement import Measurement
from prbayes.model.random_variable import simulators
from prbayes.model.specimen_likelihood import (
    SpecimenLikelihood,
    measurements_of,
    require_simulator,
    specimen_likelihoods,
)
from prbayes.propagation.base import Propagation
from prbayes.propagation.specimen_points import first_runs
from prbayes.response.costs import Cost, Demand, SimulatorCost
from prbayes.response.dry_run import Rehearsal
from prbayes.response.inputs import model_on_context
from prbayes.response.response import Responses

_log = logging.getLogger("prbayes")


def cost(model: pm.Model | Callable[[], Any] | None = None, *, dry_run: bool = False) -> Cost:
    """Say how many runs a model's simulators need, before any is made.

    Parameters
    ----------
    model : callable or pymc.Model, optional
        A function without arguments that makes the model, and does nothing more: it is called, and
        its simulators report their runs. Or a model, whose first runs are known from its first use
        on; the one on the context by default.
    dry_run : bool
        Whether one specimen of each simulator is run, to see that the response works, and how long
        it takes: one in the middle of those that are needed first. With ``store=`` it is kept, so
        that it is not computed again.

    Returns
    -------
    Cost
        It prints as sentences, and has numbers: ``runs`` to compute at first, ``runs_each`` for
        each value of the hyperparameters, and the estimated ``seconds`` of the first runs with all
        workers; the same for each of its ``simulators``.

    Raises
    ------
    TypeError
        If ``model`` is neither, or there is none.
    ValueError
        If it has no simulator.
    ResponseError
        If the specimen of the dry run fails, or is NaN, whatever ``on_failure`` says.

    Notes
    -----
    A model is not used by it: of one whose first runs are not made yet, none is made but that of
    the dry run.

    Under `Resimulated` and `Fresh` the first runs are those that show whether the response works;
    how many values of the hyperparameters an optimiser or sampler then asks for is not known
    before. The estimate takes all runs to be as long as that of the dry run.

    Examples
    --------
    >>> import pymc as pm, prbayes as prb
    >>> def build():
    ...     with pm.Model() as model:
    ...         x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...         prb.Simulator(
    ...             "y",
    ...             prb.scalar(lambda x: x**2),
    ...             x,
    ...             metric=prb.AreaMetric(),
    ...             observed=[0.5, 1.0, 4.0],
    ...             propagation=prb.Resimulated(64),
    ...         )
    ...     return model
    >>> prb.cost(build)
    y: Resimulated(n=64, random_seed=0)
      at first: 16 runs, 0 of them known: 16 to compute, one at a time
      for each value of the hyperparameters: 64 runs
      more: each value that the optimiser or sampler asks for; max_runs= and max_seconds= end it
    """
    flag(dry_run, "cost: dry_run")
    if isinstance(model, pm.Model) or not callable(model):
        if model is not None and not isinstance(model, pm.Model):
            raise TypeError(
                f"cost: model: got {called(model)}, expected a function that makes a model, or one"
            )
        asked = _of_model(model_on_context(model, "prb.cost()"))
    else:
        asked = _of_function(model)
    return Cost(tuple(each.counted(dry_run) for each in asked))


class Countable(Protocol):
    """A simulator whose runs can be counted before they are made."""

    def counted(self, dry_run: bool) -> SimulatorCost:
        """Return the runs that are needed, after one was made where asked for."""


@dataclass(frozen=True, eq=False)
class Asked:
    """What a simulator asks for."""

    responses: Responses
    propagation: Propagation
    target: Discrepancy
    shared: str = ""  # the simulator whose runs it takes
    computed: bool = False  # whether its first runs are made

    def counted(self, dry_run: bool) -> SimulatorCost:
        """Return the runs that are needed, after one was made where asked for."""
        responses = self.responses
        rehearsal = Rehearsal(responses)
        points = rehearsal.asked(self._begin)
        first, known, tried = 0, 0, None
        if points is not None and not self.shared:
            tried = rehearsal.tried(points) if dry_run else None
            first = len(points)
            known = first if self.computed else int(rehearsal.stored(points).sum())
        told = without_addresses(self.propagation)
        return SimulatorCost(
            responses.name,
            f"{told}, with the runs of {self.shared}" if self.shared else told,
            first,
            known,
            self.propagation.demand,
            responses.workers,
            tried,
        )

    def _begin(self, responses: Responses) -> object:
        return self.propagation.bind(responses.name, responses.inputs, self.target, responses)


# Where simulators say what they ask for, in place of asking.
_listening: ContextVar[list[Countable] | None] = ContextVar("listening", default=None)


def listening() -> list[Countable] | None:
    """Return where a simulator that is made here says what it asks for, None if it may begin."""
    return _listening.get()


def with_points(asked: list[Countable]) -> list[Asked]:
    """Return the simulators that can share runs with others."""
    return [simulator for simulator in asked if isinstance(simulator, Asked)]


def _of_function(build: Callable[[], Any]) -> list[Countable]:
    """Return what the simulators ask for that a function makes."""
    asked: list[Countable] = []
    token = _listening.set(asked)
    try:
        build()
    finally:
        _listening.reset(token)
    if not asked:
        raise ValueError(
            f"cost: model: got {called(build)}, which made no prb.Simulator, expected a function "
            "that makes a model with one at least"
        )
    return asked


def _of_model(model: pm.Model) -> list[Countable]:
    """Return what the simulators of a model ask for, or asked for at the first use."""
    require_simulator(model)
    asked: list[Asked] = []
    for simulator in simulators(model).values():
        responses = simulator.responses
        computed = simulator.is_computed
        alike = [earlier for earlier in asked if earlier.responses.runs is responses.runs]
        shared = alike[0].responses.name if alike and not computed else ""
        asked.append(
            Asked(
                responses=responses,
                propagation=simulator.propagation,
                target=simulator.target,
                shared=shared,
                computed=computed,
            )
        )
    likelihoods = specimen_likelihoods(model)
    specimens = [SpecimenRuns(likelihoods[rv], m) for rv, m in measurements_of(model).items()]
    return [*asked, *specimens]


@dataclass(frozen=True, eq=False)
class SpecimenRuns:
    """What the emulator of a log-likelihood by specimen asks of a simulator."""

    likelihood: SpecimenLikelihood
    measurement: Measurement

    def counted(self, dry_run: bool) -> SimulatorCost:
        """Return the runs that are needed, after one was made where asked for."""
        likelihood = self.likelihood
        responses = self.measurement.responses
        d = likelihood.coordinates.size
        first = likelihood.first_runs or first_runs(d)
        batch = max(first // 2, likelihood.options.fresh)
        is_emulated = "_prepared" in vars(likelihood)
        known = len(likelihood.emulation.z) if is_emulated else 0
        tried = None
        if dry_run:
            rehearsal = Rehearsal(responses)
            inputs = likelihood.coordinates.inputs(np.zeros((1, d)))
            points = rehearsal.asked(lambda responses: responses(inputs, []))
            tried = None if points is None else rehearsal.tried(points)
        least = first + 2 * batch
        return SimulatorCost(
            responses.name,
            f"{self.measurement.metric!r} by an emulator",
            max(least, known),
            known,
            Demand(
                0,
                first + 5 * batch,
                f"up to {first + 5 * batch} in all, {batch} at a time at the roots of the "
                "specimens, until the emulator shifts no estimate by more than "
                f"{likelihood.options.bias} standard deviations",
            ),
            responses.workers,
            tried,
        )
