"""After any sampler: did the designs support the answer? In sentences, silent when nothing is wrong."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._arrays import Floats
from prbayes.optimum import Optimum
from prbayes.population import Evaluator
from prbayes.refinement import shortcomings
from prbayes.simulator import model_on_context


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What `diagnose` found.

    Attributes
    ----------
    messages : tuple of str
        What is wrong and what to do; empty when nothing is.
    support : xarray.Dataset
        ``weight_ess``, ``mean_weight`` and ``lost_mass`` by simulator and draw, for `Reweighted`.
    """

    messages: tuple[str, ...]
    support: xr.Dataset = field(repr=False)

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.messages

    def __str__(self) -> str:
        return "\n".join(self.messages) if self.messages else "No problem was found."


def diagnose(result: xr.DataTree | Optimum, *, model: pm.Model | None = None) -> Diagnosis:
    """Say what is not identified, and whether the stored responses supported an answer, whichever sampler gave it.

    Parameters
    ----------
    result : xarray.DataTree or Optimum
        With a ``posterior`` group that has the model's free variables, from `sample_smc` or any PyMC sampler.
    model : pymc.Model, optional
        The one on the context by default.

    Returns
    -------
    Diagnosis
        ``print`` it, or look at ``ok``.

    Raises
    ------
    TypeError, KeyError
        If there is no model, or the posterior lacks a free variable of it.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> print(prb.diagnose(prb.minimize(model), model=model))
    No problem was found.
    """
    model = model_on_context(model, "prb.diagnose")
    evaluator = Evaluator(model)
    messages: list[str] = []
    if isinstance(result, Optimum):
        thetas = result.theta[None]
        messages += [f"{line[0].upper()}{line[1:]}." for line in result.warnings]
        if not result.converged:
            messages.append(f"The optimiser did not converge ({result.message}); try another start or method.")
    else:
        thetas = evaluator.thetas_of(_free_values(result, model))
        said = str(result["posterior"].attrs.get("warnings", ""))
        messages += [f"{line[0].upper()}{line[1:]}." for line in said.splitlines()]
    for name, what in shortcomings(evaluator, thetas).items():
        messages.append(
            f"{name}: the design does not support the answer: {what}. Call prb.refine(model) and sample again, or use "
            "prb.Resimulated."
        )
    return Diagnosis(tuple(messages), _labelled(evaluator.support(thetas)))


def _free_values(idata: xr.DataTree, model: pm.Model) -> list[Floats]:
    posterior = idata["posterior"]
    names = [rv.name for rv in model.free_RVs]
    missing = [n for n in names if n not in posterior]
    if missing:
        raise KeyError(f"posterior: got no {missing}, expected the model's free variables {names}")
    arrays = [posterior[n].transpose("chain", "draw", ...).values for n in names]
    return [a.reshape(-1, *a.shape[2:]) for a in arrays]


def _labelled(support: dict[str, dict[str, Floats]]) -> xr.Dataset:
    names = list(support)
    keys = ("weight_ess", "mean_weight", "lost_mass")
    stacked = {k: (["simulator", "sample"], np.array([support[n][k] for n in names])) for k in keys} if names else {}
    return xr.Dataset(stacked, coords={"simulator": names})
