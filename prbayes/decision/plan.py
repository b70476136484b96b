"""`plan`: what more specimens under each of some conditions would tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._validate import Floats, called, positive_integer, positive_number
from prbayes.decision.information import Belief, Condition, of_a_specimen
from prbayes.decision.populations import Populations, Told
from prbayes.decision.quantities import Quantity, refuse_quantity
from prbayes.model.elements import split_elements, told_elements
from prbayes.model.fingerprint import as_attributes, identity_of_model
from prbayes.model.labels import labelled, versions
from prbayes.model.locking import in_turn
from prbayes.optimize.optimum import Optimum, identity_in

# Draws that are made narrower: standard deviations are then known to two percent.
_READ = 2000
# Specimens up to which one that reaches a target is looked for.
_MOST_SPECIMENS = 1_000_000
# What the row of the decision quantity is called.
_QUANTITY = "quantity"


@in_turn
def plan(
    result: Optimum | xr.DataTree,
    candidates: Mapping[str, Condition],
    *,
    k: int | Sequence[int] = (5, 10, 20, 50),
    model: pm.Model | None = None,
    quantity: Quantity | None = None,
    target: Mapping[str, float] | None = None,
) -> xr.Dataset:
    r"""Say what k more specimens under each candidate condition are expected to tell.

    The posterior has the precision :math:`\Lambda` that its draws say. One specimen under a
    condition adds the metric's (Godambe) information :math:`a = H J^{-1} H`, H the Hessian of its
    discrepancy at the centre and J the covariance of its gradient, both by the weights of stored
    responses; it is at most the Fisher information of the response. After k specimens the draws
    are expected to be as wide as :math:`(\Lambda + k a)^{-1}` says.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`, with its sampling distribution, and then without the prior; or with a
        ``posterior`` group, from any sampler.
    candidates : mapping of str to Condition
        By what a reader calls them. A response that is no simulator's is computed once for each run
        of the design, unless `predict` did that before.
    k : int or sequence of int
        Numbers of further specimens.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    quantity : Quantity, optional
        A decision quantity, whose standard deviation is told as well.
    target : mapping of str to float, optional
        Standard deviations to be reached, by the names of the table, in units of each; the
        quantity's is called ``"quantity"``.

    Returns
    -------
    xarray.Dataset
        Dimensions ``candidate``, ``k`` and ``name``, the hyperparameters, deterministics among
        them, and ``"quantity"``. Variables ``sd``, the expected standard deviation, in the user's
        own units, inf where the quantity is infinite in some populations; ``now``, the present one;
        and with ``target``, ``specimens``: the least number of them that reaches it, inf if a
        million do not, NaN where there is no target. Attributes: ``responses`` (how many were
        computed) and ``identity``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, the result is another model's, or the inputs have no
        stored responses.
    DesignError
        If the design does not support the populations.
    ResponseError
        If a response raises, or has the wrong shape.

    Notes
    -----
    This is an expectation at the centre of the result: a posterior after k specimens is there or
    elsewhere, and wider or narrower. Specimens are new ones, each measured under one condition.
    Numbers below ten are less reliable: information adds up as it does in large samples.

    References
    ----------
    .. [1] Chaloner, K. and I. Verdinelli (1995), Bayesian experimental design: a review, Stat. Sci.
       10, 273-304, doi:10.1214/ss/1177009939.
    .. [2] Godambe, V. P. (1960), An optimum property of regular maximum likelihood estimation, Ann.
       Math. Stat. 31, 1208-1211, doi:10.1214/aoms/1177705693.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1), name="x")
    ...     data = np.random.default_rng(1).normal(0, 1, 50)
    ...     metric = prb.LogLikelihood(density=prb.GaussianKDE())
    ...     y = prb.Simulator("y", np.sinh, x, metric=metric, observed=data)
    >>> same = prb.decision.Condition(np.sinh, x)
    >>> table = prb.plan(prb.minimize(model), {"same": same}, k=150)
    >>> ratio = table.sd.sel(candidate="same", k=150, name="mu") / table.now.sel(name="mu")
    >>> bool(abs(ratio - 0.5) < 0.05)
    True
    """
    caller = "prb.plan"
    numbers = _numbers(k)
    _refuse_candidates(candidates)
    if quantity is not None:
        refuse_quantity(quantity, caller)
    populations = Populations.of(result, model, _READ, caller)
    evaluator = populations.evaluator
    decided = None
    if quantity is not None:
        decided = populations.told(quantity.response, quantity.inputs, quantity.output)
        decided.refuse_failed(quantity)
    belief = Belief.of(populations.thetas, evaluator.prior_sd)
    outlook = _Outlook(populations, belief, quantity, decided)
    now = outlook.sd(np.zeros((evaluator.size, evaluator.size)))
    _refuse_target(target, list(now))
    told = {
        label: populations.all_outputs(one.response, one.inputs)
        for label, one in candidates.items()
    }
    sd, needed = [], []
    for label, one in candidates.items():
        each = of_a_specimen(told[label], one.metric)
        rows = [outlook.sd(number * each) for number in numbers]
        sd.append([[row[name] for name in now] for row in rows])
        needed.append([outlook.needed(each, name, (target or {}).get(name)) for name in now])
    variables: dict[str, Any] = {
        "sd": (["candidate", "k", "name"], sd),
        "now": ("name", list(now.values())),
    }
    if target is not None:
        variables["specimens"] = (["candidate", "name"], needed)
    responses = [one.responses for one in (*told.values(), *([decided] if decided else []))]
    identity = identity_in(result) or identity_of_model(evaluator.model)
    return xr.Dataset(
        variables,
        coords={"candidate": list(candidates), "k": numbers, "name": list(now)},
        attrs={
            "responses": sum(one.count for one in responses),
            **({} if quantity is None else {"quantity": repr(quantity)}),
            **as_attributes(identity),
            **versions(),
        },
    )


@dataclass(frozen=True, eq=False)
class _Outlook:
    """Standard deviations after more information."""

    populations: Populations
    belief: Belief
    quantity: Quantity | None
    decided: Told | None

    def sd(self, information: Floats) -> dict[str, float]:
        """Return standard deviations by name, after so much information, (d, d)."""
        thetas = self.belief.after(information)
        evaluator = self.populations.evaluator
        own = evaluator.constrained(thetas)
        values = labelled(evaluator, own, {"draw": len(thetas)}).data_vars
        elements = split_elements(values)
        found = {name: float(elements[name].std()) for name in told_elements(values)}
        if self.quantity is not None:
            found[_QUANTITY] = self._of_quantity(thetas)
        return found

    def _of_quantity(self, thetas: Floats) -> float:
        assert self.quantity is not None
        assert self.decided is not None
        values = self.decided.at(self.quantity, thetas)
        # Where specimens fail, a quantile may be infinite.
        return float(values.std()) if np.isfinite(values).all() else np.inf

    def _of_one(self, information: Floats, name: str) -> float:
        """Return one of the standard deviations."""
        if name == _QUANTITY:
            return self._of_quantity(self.belief.after(information))
        return replace(self, quantity=None).sd(information)[name]

    def needed(self, each: Floats, name: str, target: float | None) -> float:
        """Return the least number of specimens after which one is small enough; inf, NaN."""
        if target is None:
            return np.nan
        if self._of_one(0 * each, name) <= target:
            return 0.0
        # Twice as many until it is reached, and then halves of the gap.
        short, enough = 0, 1
        while self._of_one(enough * each, name) > target:
            short = enough
            enough = 2 * enough
            if short > _MOST_SPECIMENS:
                return np.inf
        while enough - short > 1:
            middle = (enough + short) // 2
            if self._of_one(middle * each, name) > target:
                short = middle
            else:
                enough = middle
        return float(enough)


def _numbers(k: object) -> list[int]:
    """Return numbers of specimens, or raise if they are none."""
    if isinstance(k, str | Mapping) or not isinstance(k, Sequence | np.ndarray):
        return [positive_integer(k, "k")]
    if len(k) == 0:
        raise ValueError(
            "k: got no numbers, expected numbers of further specimens, such as [5, 10]"
        )
    return [positive_integer(one, "k") for one in k]


def _refuse_candidates(candidates: object) -> None:
    """Raise if they are no conditions by name."""
    advice = 'such as {"later": prb.decision.Condition(response, x)}'
    if not isinstance(candidates, Mapping) or not candidates:
        raise TypeError(
            f"prb.plan: candidates: got {called(candidates)}, expected a mapping of names to "
            f"conditions, {advice}"
        )
    for name, one in candidates.items():
        if not isinstance(name, str) or not isinstance(one, Condition):
            raise TypeError(
                f"prb.plan: candidates: got {called(one)} by {called(name)}, expected a condition "
                f"by a text, {advice}"
            )


def _refuse_target(target: object, names: list[str]) -> None:
    """Raise if it is no standard deviation by name."""
    if target is None:
        return
    if not isinstance(target, Mapping) or not target:
        raise TypeError(
            f"prb.plan: target: got {called(target)}, expected a mapping of names to standard "
            f"deviations, of {names}"
        )
    for name, value in target.items():
        if name not in names:
            raise KeyError(f"prb.plan: target: got {name!r}, expected one of {names}")
        positive_number(value, f"target: {name}")
