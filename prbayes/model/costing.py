"""What a model costs before it is computed: how many runs, what for, and one of them as a trial."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import pymc as pm

from prbayes._checks import called, flag
from prbayes.metrics.base import Discrepancy
from prbayes.model.description import without_addresses
from prbayes.model.node import model_on_context, required_simulators
from prbayes.propagation.base import Propagation
from prbayes.response.costs import Cost, SimulatorCost
from prbayes.response.rehearsal import Rehearsal
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
_listening: ContextVar[list[Asked] | None] = ContextVar("listening", default=None)


def listening() -> list[Asked] | None:
    """Return where a simulator that is made here says what it asks for, None if it may begin."""
    return _listening.get()


def _of_function(build: Callable[[], Any]) -> list[Asked]:
    """Return what the simulators ask for that a function makes."""
    asked: list[Asked] = []
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


def _of_model(model: pm.Model) -> list[Asked]:
    """Return what the simulators of a model ask for, or asked for at the first use."""
    asked: list[Asked] = []
    for simulator in required_simulators(model).values():
        responses = simulator.responses
        computed = simulator.is_computed
        alike = [earlier for earlier in asked if earlier.responses.runs is responses.runs]
        shared = alike[0].responses.name if alike and not computed else ""
        asked.append(Asked(responses, simulator.propagation, simulator.target, shared, computed))
    return asked
