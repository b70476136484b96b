"""Runs that a model needs, before any is computed, and what is kept when a budget ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import pymc as pm

from prbayes.model.description import without_addresses
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import computed_node, simulators
from prbayes.model.specimen_likelihood import (
    measurements_of,
    require_simulator,
    specimen_likelihoods,
)
from prbayes.model.specimen_preparation import emulator_cost, is_prepared, prepared
from prbayes.response.budget import BudgetError, Cost, SimulatorCost
from prbayes.response.inputs import model_on_context


def cost(model: pm.Model | None = None) -> Cost:
    """Return how many runs a model's simulators need; no run is made.

    Parameters
    ----------
    model : pymc.Model, optional
        By default the one on the context.

    Returns
    -------
    Cost
        It prints as sentences; a notebook shows a table. Numbers are ``runs`` to compute at the
        first use of the model, and ``runs_each`` for each value of the hyperparameters, for all and
        for each of its ``simulators``.

    Raises
    ------
    TypeError
        If there is no model.
    ValueError
        If it has no simulator.

    Notes
    -----
    Runs that ``store=`` has are not computed again, and discrete inputs that repeat are computed
    once: then fewer runs are made. Under `Resimulated` and `Fresh` the first runs show whether the
    response works; how many values of the hyperparameters an optimiser or sampler evaluates is not
    known in advance.

    Examples
    --------
    >>> import pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y",
    ...         prb.scalar(lambda x: x**2),
    ...         x,
    ...         metric=prb.AreaMetric(),
    ...         observed=[0.5, 1.0, 4.0],
    ...         propagation=prb.Resimulated(64),
    ...     )
    >>> prb.cost(model)
    y: Resimulated(n=64, random_seed=0)
      at first: 16 runs, 0 of them computed, one at a time
      for each value of the hyperparameters: 64 runs
      more: each value that the optimiser or sampler asks for; max_runs= and max_seconds= end it
    """
    model = model_on_context(model, "prb.cost()")
    require_simulator(model)
    costs = []
    # Name of the first simulator that uses each `Runs` object, which simulators may share.
    owner: dict[int, str] = {}
    for simulator in simulators(model).values():
        responses = simulator.responses
        needed = simulator.propagation.cost
        propagation = without_addresses(simulator.propagation)
        shared = owner.setdefault(id(responses.runs), responses.name)
        if shared != responses.name:
            propagation = f"{propagation}, with the runs of {shared}"
            needed = replace(needed, first=0)
        computed = needed.first if computed_node(simulator) else 0
        costs.append(
            SimulatorCost(responses.name, propagation, needed, computed, responses.workers)
        )
    likelihoods = specimen_likelihoods(model)
    for rv, measurement in measurements_of(model).items():
        likelihood, responses = likelihoods[rv], measurement.responses
        computed = len(prepared(likelihood).emulation.z) if is_prepared(likelihood) else 0
        emulator = f"{measurement.metric!r} by an emulator"
        needed = emulator_cost(likelihood)
        costs.append(SimulatorCost(responses.name, emulator, needed, computed, responses.workers))
    return Cost(tuple(costs))


@contextmanager
def designs_as_before(evaluator: Evaluator) -> Iterator[Callable[[], None]]:
    """Restore the designs if the work is interrupted: the same call then starts from them again.

    Its responses are reused. The function that is yielded restores them as well, for work that a
    budget ended with a part of its result.
    """
    designs = [(bound, bound.design) for bound in evaluator.reweighted.values()]

    def restore() -> None:
        for bound, design in designs:
            bound.design = design

    try:
        yield restore
    except (BudgetError, KeyboardInterrupt):
        restore()
        raise


@contextmanager
def explained(model: pm.Model, caller: str, *also: str) -> Iterator[None]:
    """Explain a budget that was spent before there was a result.

    ``also`` names what is kept besides responses.
    """
    try:
        yield
    except BudgetError as spent:
        raise BudgetError(
            f"{caller}: {spent} before there was a result; {kept(model, *also)}; call it again "
            "with a larger budget"
        ) from None


def kept(model: pm.Model, *also: str) -> str:
    """Return what the next call can reuse, as a phrase."""
    used = list(simulators(model).values())
    stores = [simulator.responses.folder for simulator in used]
    folders = {str(folder) for folder in stores if folder is not None}
    parts = list(also)
    if folders:
        parts.append(f"all responses ({', '.join(sorted(folders))})")
    elif any(node and node.reweighted for node in map(computed_node, used)):
        parts.append("the responses of the model's designs")
    if not parts:
        return "nothing is kept: give the propagation a store="
    return f"kept: {' and '.join(parts)}"
