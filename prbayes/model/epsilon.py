"""Epsilons of simulators: the scales of their discrepancies under `pymc.sample`."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import numpy as np
import pymc as pm

from prbayes._validate import called, positive_number
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import Identity, identity_of, require_same
from prbayes.model.locking import locked
from prbayes.model.random_variable import AnySimulator, required_simulators, simulators
from prbayes.model.specimen_variable import specimen_likelihoods

_log = logging.getLogger("prbayes")


class Epsilon(dict[str, float]):
    """Epsilon by the names of simulators, with the identity of the problem, None if unknown."""

    def __init__(self, values: Mapping[str, float], identity: Identity | None) -> None:
        super().__init__(values)
        self.identity = identity


def checked_epsilon(
    epsilon: Mapping[str, float], simulators: Sequence[AnySimulator], model: pm.Model, caller: str
) -> dict[str, float]:
    """Return positive numbers by the names of simulators.

    Raise KeyError, TypeError or ValueError if a name is unknown, a value is not a positive number,
    or they were calibrated for another problem.
    """
    if not isinstance(epsilon, Mapping):
        raise TypeError(
            f"epsilon: got {called(epsilon)}, expected a mapping of names of simulators to "
            'positive numbers, such as {"y": 0.1}'
        )
    names = [simulator.name for simulator in simulators]
    unknown = sorted(map(str, set(epsilon) - set(names)))
    if unknown:
        raise KeyError(f"epsilon: got {unknown}, expected names of simulators: {sorted(names)}")
    if isinstance(epsilon, Epsilon):
        require_same(epsilon.identity, identity_of(Evaluator.of(model)), caller)
    return {name: positive_number(value, f"{name}: epsilon") for name, value in epsilon.items()}


def refuse_without_epsilon(model: pm.Model, caller: str, advice: str) -> None:
    """Raise if all simulators of a model have a log-likelihood by specimen, without an epsilon."""
    if specimen_likelihoods(model) and not simulators(model):
        raise ValueError(
            f"{caller}: got a model whose simulators use prb.LogLikelihood(), which has no epsilon "
            f"and whose draws have the width of the data, expected a metric of distributions; "
            f"{advice}"
        )


@locked
def set_epsilon(model: pm.Model, epsilon: dict[str, float]) -> None:
    """Set the epsilon of simulators by name.

    Parameters
    ----------
    model : pymc.Model
    epsilon : dict
        Positive numbers by the names of simulators; others keep theirs.

    Raises
    ------
    KeyError, TypeError, ValueError
        If a name is unknown, a value is not a positive number, `calibrate_epsilon` found them for
        another problem, or no simulator has an epsilon; then nothing is changed.

    Notes
    -----
    A clone of a model (``pymc.do``, ``pymc.observe``, a copy) has its own epsilons from its first
    use by this package; functions that were compiled before follow the original.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu"), 1.0)
    ...     y = prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=[0.5, 1.0, 4.0])
    >>> prb.set_epsilon(model, {"y": 0.1})
    """
    refuse_without_epsilon(model, "set_epsilon", "sample it with prb.sample_smc or pm.sample")
    by_metric = list(required_simulators(model).values())
    values = checked_epsilon(epsilon, by_metric, model, "set_epsilon")
    for simulator in by_metric:
        if simulator.name in values:
            simulator.epsilon.set_value(np.asarray(values[simulator.name]))
    _log.info(
        "draws of exp(-discrepancy / epsilon), as those of pymc.sample, are as wide as epsilon "
        "makes them; prb.sample draws the posterior given the estimate"
    )
