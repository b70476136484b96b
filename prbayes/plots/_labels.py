"""Labels of variables, statistics and metrics for readers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import variable_of
from prbayes.response.inputs import aleatory_names

STATISTIC_LABELS = {
    "beta": "beta (1: posterior)",
    "accept_rate": "acceptance rate",
    "n_steps": "steps per stage",
    "log_marginal_likelihood": "log marginal likelihood",
}
# Any other metric is called by its class.
METRIC_LABELS = {
    "AreaMetric": "area metric",
    "KullbackLeibler": "Kullback-Leibler divergence",
    "LogLikelihood": "log-likelihood",
    "ProbabilityResidual": "probability residual",
}
# Metrics of several outputs that are made of a metric of one.
_LIFTED_LABELS = {
    "Joint": "joint {}",
    "MarginalCorrelation": "{} of marginals, with correlations",
}


def metric_label(representation: str) -> str:
    """Return the label of a metric by its representation, such as 'Joint(AreaMetric())'."""
    lifted = re.match(r"(\w+)\((?:metric=)?(\w+)\(", representation)
    if lifted and lifted[1] in _LIFTED_LABELS:
        return _LIFTED_LABELS[lifted[1]].format(METRIC_LABELS.get(lifted[2], lifted[2]))
    name = representation.partition("(")[0]
    return METRIC_LABELS.get(name, name)


def named(name: str, labels: Mapping[str, str] | None) -> str:
    """Return an element's label, or its variable's with the index, or else its name."""
    labels = labels or {}
    if name in labels:
        return labels[name]
    variable = variable_of(name)
    return labels.get(variable, variable) + name.removeprefix(variable)


def refuse_labels(
    labels: Mapping[str, str] | None, shown: Iterable[str], *, evaluator: Evaluator | None = None
) -> None:
    """Raise a `KeyError` if there are labels of unknown names.

    With an evaluator, every label has to be of something in the model or the picture, so that one
    mapping serves all pictures of a model; otherwise one label at least has to be of a shown name.
    """
    if not labels:
        return
    names = list(dict.fromkeys(shown))
    allowed = {*names, *map(variable_of, names), *STATISTIC_LABELS, *METRIC_LABELS}
    if evaluator is not None:
        allowed |= _names_of_model(evaluator)
    unknown = [name for name in labels if not {name, variable_of(name)} & allowed]
    if unknown and (evaluator is not None or len(unknown) == len(labels)):
        more = ", ..." if len(names) > 12 else ""
        raise KeyError(
            f"labels: got {unknown[0]!r:.60}, which is no name of what is shown; expected some of "
            f"{', '.join(names[:12])}{more}"
        )


def _names_of_model(evaluator: Evaluator) -> set[str]:
    """Return the names of variables, simulators, outputs and inputs, which may have labels."""
    names = set(map(str, evaluator.model.named_vars))
    for node in evaluator.simulators:
        names |= {node.name, node.outputs.dim, *map(str, node.outputs.names)}
        for name in aleatory_names(node.inputs, node.responses.function):
            names |= {variable_of(name), f"{variable_of(name)} of {node.name}"}
    return names
