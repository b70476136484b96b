"""What a reader calls the elements of variables, and which names a picture may show."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from prbayes.model.elements import variable_of
from prbayes.model.evaluator import Evaluator
from prbayes.plots._objective import METRIC_LABELS
from prbayes.response.inputs import aleatory_names

# What a reader calls a statistic, if he does not say.
STATISTIC_LABELS = {
    "beta": "beta (1: posterior)",
    "accept_rate": "acceptance rate",
    "n_steps": "steps per stage",
    "log_marginal_likelihood": "log marginal likelihood",
}
# Names that a message lists: two lines, by judgement.
_MOST_LISTED = 12


def named(name: str, labels: Mapping[str, str] | None) -> str:
    """Return an element's label, or its variable's with the index, or else its name."""
    given = labels or {}
    if name in given:
        return given[name]
    variable = variable_of(name)
    index = name.removeprefix(variable)
    return given.get(variable, variable) + index


def names_of_model(evaluator: Evaluator) -> set[str]:
    """Return what a model has that may have a label: variables, simulators, outputs, inputs."""
    found = {str(name) for name in evaluator.model.named_vars}
    for node in evaluator.simulators:
        found |= {node.name, node.outputs.dim}
        found |= {str(name) for name in node.outputs.names}
        names = aleatory_names(node.inputs, node.responses.function)
        for name in names:
            found |= {variable_of(name), f"{variable_of(name)} of {node.name}"}
    return found


def refuse_labels(
    labels: Mapping[str, str] | None,
    known: Iterable[str],
    *,
    evaluator: Evaluator | None = None,
) -> None:
    """Raise if there are labels for what there is not.

    Where the model is known, every label has to be for something that it or the picture has, so
    that one mapping serves all pictures of a model; elsewhere one label at least has to fit.

    Raises
    ------
    KeyError
        With the names that a label may have.
    """
    if not labels:
        return
    own = list(dict.fromkeys(known))
    variables = {variable_of(name) for name in own}
    allowed = {*own, *variables, *STATISTIC_LABELS, *METRIC_LABELS}
    if evaluator is not None:
        allowed |= names_of_model(evaluator)
    strange = [name for name in labels if name not in allowed and variable_of(name) not in allowed]
    if evaluator is None and len(strange) < len(labels):
        return
    if strange:
        more = ", ..." if len(own) > _MOST_LISTED else ""
        listed = ", ".join(own[:_MOST_LISTED])
        raise KeyError(
            f"labels: got {strange[0]!r:.60}, which is no name of what is shown; expected some of "
            f"{listed}{more}"
        )
