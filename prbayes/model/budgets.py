"""What is kept of work that stops before its end, so that it can go on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pymc as pm

from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import computed_node, simulators
from prbayes.response.budget import BudgetError


@contextmanager
def designs_as_before(evaluator: Evaluator) -> Iterator[Callable[[], None]]:
    """Give designs that have grown inside their first size back, where the work is interrupted.

    The same call then begins where this one began, and finds the responses. The function that is
    yielded does the same, for work that a budget ended with a part of its result.
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
    """Say, where a budget was spent before there was a result, what is kept and what to do.

    ``also`` is what is kept besides responses.
    """
    try:
        yield
    except BudgetError as spent:
        raise BudgetError(
            f"{caller}: {spent} before there was a result; {kept(model, *also)}; call it again "
            "with a larger budget"
        ) from None


def kept(model: pm.Model, *also: str) -> str:
    """Say what is kept, for the next time."""
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
