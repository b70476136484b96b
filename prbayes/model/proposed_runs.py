"""`propose_runs`: points at which more runs of a table are needed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pymc as pm

from prbayes._display import Shown, View
from prbayes._finding import counted
from prbayes._stats import positive_scale
from prbayes._validate import Floats, Seed, finite_or_nan, positive_integer, seed_number
from prbayes.emulators.ranges import predictive_inputs
from prbayes.emulators.runs import Runs, continued
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.random_variable import simulators
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.model.specimen_preparation import PopulationDraws, SpecimenPopulations
from prbayes.numerics.points import farthest_rows
from prbayes.response.call import checked
from prbayes.response.inputs import model_on_context
from prbayes.response.response import Responses


def propose_runs(
    model: pm.Model | None = None,
    *,
    n: int | None = None,
    runs: Runs | None = None,
    random_seed: Seed = 0,
) -> ProposedRuns:
    """Return inputs of runs that a table needs.

    Specimens of the prior predictive population whose response is near a measured one: those
    outside the ranges of the runs if there are any, and else those far from all runs. The response
    outside the ranges is a linear continuation, so that a second round may be necessary.

    Parameters
    ----------
    model : pymc.Model, optional
        With a `Simulator` whose response is a `Runs`; by default the model on the context.
    n : int, optional
        Number of points; by default a quarter of the runs, at least four for each input.
    runs : Runs, optional
        Which table, if the model has several.
    random_seed : int, sequence of int, numpy.random.Generator or None
        Of the specimens of the prior.

    Returns
    -------
    pandas.DataFrame
        A row for each point, a column for each input of the table, in the units of the table. It
        prints with a sentence about the ranges of the runs; a notebook shows a table.

    Raises
    ------
    TypeError, ValueError
        If the model has no table, or several.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> x = np.linspace(1, 2, 12)
    >>> with pm.Model() as model:
    ...     dist = pm.Normal.dist(pm.Normal("mu", 2, 0.5), 0.1)
    ...     y = prb.Simulator("y", prb.Runs({"x": x}, x**2), dist, observed=[4.2, 5.1, 4.6])
    >>> table = prb.propose_runs(model)
    >>> bool((table["x"] > 2).all())
    True
    """
    model = model_on_context(model, "prb.propose_runs()")
    seed = seed_number(random_seed, "propose_runs: random_seed")
    used: list[tuple[Responses, Floats, SpecimenLikelihood | None]] = [
        (s.responses, s.target.observed, None) for s in simulators(model).values()
    ]
    for likelihood in dict.fromkeys(specimen_likelihoods(model).values()):
        used += [(m.responses, m.observed, likelihood) for m in likelihood.measurements]
    tables = list(dict.fromkeys(r.function for r, *_ in used if isinstance(r.function, Runs)))
    if runs is None:
        if len(tables) != 1:
            raise ValueError(
                f"propose_runs: model: got {len(tables)} tables of runs in its simulators, "
                "expected one; pass prb.Runs to a simulator, or runs= to select one of several"
            )
        (runs,) = tables
    elif runs not in tables:
        raise ValueError("propose_runs: runs: got a table of no simulator, expected one of a model")
    domain = runs.surrogate.domain
    n = max(4 * domain.dimensions, -(-len(runs) // 4)) if n is None else n
    positive_integer(n, "propose_runs: n")
    pools = [
        _near_data(_arguments(model, responses, likelihood, seed), responses, runs, data)
        for responses, data, likelihood in used
        if responses.function is runs
    ]
    pool = np.unique(np.concatenate(pools), axis=0)
    is_outside = domain.outside(pool).any(axis=1)
    if is_outside.mean() > 0.01:
        pool = pool[is_outside]
    scaled, at_runs = domain.scaled(pool), domain.scaled(runs.points)
    unit = positive_scale(scaled.std(axis=0))
    squares = np.min([(((scaled - x) / unit) ** 2).sum(axis=1) for x in at_runs], axis=0)
    rows = farthest_rows(scaled / unit, min(n, len(pool)), squares)
    proposed = ProposedRuns(pool[rows], columns=runs.columns)
    ranges = np.stack([domain.low, domain.high]).tolist()
    count = int(domain.outside(pool[rows]).any(axis=1).sum())
    proposed.attrs = {"runs": len(runs), "outside": count, "ranges": ranges}
    return proposed


class ProposedRuns(Shown, pd.DataFrame):  # type: ignore[misc]  # pandas has no types
    """Points at which more runs of a table are needed; parts of it are plain DataFrames."""

    def to_dataframe(self) -> pd.DataFrame:
        """Return a plain DataFrame."""
        return pd.DataFrame(self)

    def to_view(self) -> View:
        """Return what a reader sees."""
        size, outside = self.attrs["runs"], self.attrs["outside"]
        ranges = [
            f"{name} from {low:.4g} to {high:.4g}"
            for name, low, high in zip(self.columns, *self.attrs["ranges"], strict=False)
        ]
        heading = (
            f"{counted(len(self), 'proposed run')} near the measured responses, {outside} of them "
            f"outside the ranges of the {size} runs"
        )
        rows = [[str(k), *(f"{x:.6g}" for x in row)] for k, row in enumerate(self.to_numpy())]
        sentences = [f"The runs have {', '.join(ranges)}.", "Make a prb.Runs of old and new runs."]
        return View(heading, ["", *map(str, self.columns)], rows, sentences)


def _arguments(
    model: pm.Model, responses: Responses, likelihood: SpecimenLikelihood | None, seed: int
) -> list[Any]:
    """Return specimens drawn from the prior as the response's arguments, (n, *event)."""
    inputs = responses.inputs
    if likelihood is not None:
        populations = SpecimenPopulations(likelihood)
        thetas = populations.hyperparameters.prior_thetas(2048, seed)
        z = PopulationDraws(populations, thetas).specimens(16)
        return inputs.fill(likelihood.coordinates.inputs(z), [])
    with model:
        drawn = predictive_inputs(responses.name, [*inputs.aleatory, *inputs.epistemic], seed)
    flat = [x.reshape(-1, *x.shape[2:]) for x in drawn]
    count = len(inputs.aleatory)
    return inputs.fill(flat[:count], flat[count:])


def _near_data(
    arguments: list[Any], responses: Responses, runs: Runs, observed: Floats, of_each: int = 16
) -> Floats:
    """Return inputs, (k, d), of the specimens whose responses are nearest to each measured one."""
    columns, batch = runs.surrogate.domain.columns(arguments)
    values, _ = checked(continued(runs, *arguments), batch, arguments, responses.outputs)
    values = values.reshape(len(columns), -1)
    data = finite_or_nan(observed).reshape(len(observed), -1)
    spread = np.nanstd(data, axis=0)
    unit = positive_scale(spread)
    rows = []
    for reading in data:
        squares = np.nansum(((values - reading) / unit) ** 2, axis=1)
        squares[np.isnan(values).any(axis=1)] = np.inf
        rows.append(np.argpartition(squares, of_each)[:of_each])
    near = columns[np.unique(rows)]
    # Points beyond the ranges are moved farther by a quarter of their distance, so that specimens
    # at the end are inside the new ranges.
    inside = np.clip(near, runs.surrogate.domain.low, runs.surrogate.domain.high)
    return np.clip(near + 0.25 * (near - inside), columns.min(axis=0), columns.max(axis=0))
