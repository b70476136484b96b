"""State after an interruption, from which the same call can continue."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pymc as pm

from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import computed_node, simulators
from prbayes.response.budget import BudgetError


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
