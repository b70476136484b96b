"""Remedies that a refusal names: other metrics and propagations that the same model accepts.

A remedy is tried by the checks that would refuse it, and named only if they let it pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
from pytensor.graph.traversal import ancestors

from prbayes._finding import any_of
from prbayes._validate import Floats
from prbayes.emulators.runs import Runs, outlier_advice
from prbayes.metrics.base import Discrepancy, Metric
from prbayes.metrics.divergence import ProbabilityResidual
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.multivariate import Joint
from prbayes.model.measurement import Measurement, SpecimenLikelihood
from prbayes.propagation.base import Propagation
from prbayes.propagation.resimulated import Fresh, Resimulated
from prbayes.propagation.reweighted import Reweighted
from prbayes.response.distributions import PriorSampler
from prbayes.response.inputs import Inputs

# The default is the first one.
PROPAGATIONS: tuple[Propagation, ...] = (Reweighted(), Resimulated(), Fresh())


def check_propagation(
    name: str, propagation: Propagation, inputs: Inputs, target: Discrepancy
) -> None:
    """Raise TypeError if a propagation does not take inputs or metric, and name one that does."""
    try:
        propagation.check_simulator(name, inputs, target)
    except TypeError as error:
        accepted = [p for p in PROPAGATIONS if accepts(name, p, inputs, target)]
        remedies = [f"use propagation=prb.{type(p).__name__}()" for p in accepted[:1]]
        raise TypeError(advised(str(error), *remedies)) from None


def other_metric(
    name: str,
    inputs: Inputs,
    observed: Floats,
    metric: Metric,
    propagations: Sequence[Propagation] = PROPAGATIONS,
) -> str:
    """Return advice to use a metric of distributions that a simulator accepts; empty if none."""
    if inputs.conditions or inputs.covariates:
        return ""
    of_one = f"prb.{type(metric).__name__}()"
    for candidate, label in ((metric, of_one), (Joint(metric), f"prb.Joint({of_one})")):
        try:
            target = candidate.against(observed)
        except (TypeError, ValueError):
            continue
        for propagation in filter(lambda p: accepts(name, p, inputs, target), propagations):
            # The propagation stays if it is the default, or random as the response.
            is_other = len(propagations) > 1 and propagation is not PROPAGATIONS[0]
            suffix = f" with propagation=prb.{type(propagation).__name__}()" if is_other else ""
            return f"use metric={label}{suffix}"
    return ""


def accepts(name: str, propagation: Propagation, inputs: Inputs, target: Discrepancy) -> bool:
    """Return whether a propagation takes inputs and a metric."""
    try:
        propagation.check_simulator(name, inputs, target)
    except (TypeError, ValueError):
        return False
    return True


def advised(text: str, *remedies: str) -> str:
    """Return a refusal with further remedies; one that names a remedy has a semicolon before it."""
    joint = any_of(*remedies)
    return f"{text}{', or ' if '; ' in text else '; '}{joint}" if joint else text


def remedies_of(likelihood: SpecimenLikelihood) -> tuple[str, str]:
    """Return advice on more runs, and on another metric, that a likelihood accepts.

    A metric compares readings as they are, so that none is named for readings with an error, or for
    specimens with several readings. Specimens of several simulators have one kind of metric.
    """
    metrics = {_metric_of(m) for m in likelihood.measurements}
    metric = metrics.pop() if len(metrics) == 1 else ""
    everywhere = f" in {likelihood.name}" if len(likelihood.measurements) > 1 else ""
    metric += everywhere if metric else ""
    if likelihood.has_table:
        return table_advice(likelihood), metric
    if likelihood.calls_response:
        return "", metric
    runs = "ask for more first runs with propagation=prb.Reweighted(n)"
    return (
        f"{runs}, use propagation=prb.Resimulated(){everywhere}, with 10,000 runs and more",
        metric,
    )


def table_advice(likelihood: SpecimenLikelihood) -> str:
    """Return advice on the runs of tables: to correct one that is an outlier, or to add runs."""
    tables = [cast(Runs, m.responses.function) for m in likelihood.measurements]
    advice = map(outlier_advice, tables)
    return next(filter(None, advice), "add the runs that prb.propose_runs(model) returns")


def _metric_of(measurement: Measurement) -> str:
    """Return advice to use a metric for one simulator with a log-likelihood by specimen."""
    m, labels = measurement, measurement.specimens
    is_plain = m.metric == LogLikelihood() and not m.at_conditions
    if not is_plain or (labels is not None and len(np.unique(labels)) < len(labels)):
        return ""
    return other_metric(m.name, m.inputs, m.observed, ProbabilityResidual())


def scatter_advice(inputs: Inputs, specimens: int) -> str:
    """Return how an input that is common to all specimens becomes one that scatters, or data."""
    x = inputs.epistemic[0]
    label = str(x.name or "c")
    if not any(above in inputs.parents for above in ancestors([x])):
        if x.type.ndim == 1 and x.eval().shape == (specimens,):
            return f"write prb.response.condition({label!r}, values) for a value of each specimen"
        return f"pass the value itself, such as {label}.get_value()"
    (draws,) = PriorSampler([x])(2048, seed=0)
    low, high = np.quantile(draws, [0.16, 0.84], axis=0)
    scatter = np.array2string((high - low) / 20, precision=2, separator=", ")
    return (
        "narrow a vague prior, and let it scatter by a tenth of the prior's standard deviation, as "
        f"in pm.Normal.dist({label}, {scatter})"
    )
