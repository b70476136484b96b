"""`adjust`: draws of any sampler, brought to the width that the data warrant."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._checks import Floats, called, flag
from prbayes._progress import shown
from prbayes.estimate.minimization import Minimisation, find_optimum, require_finished
from prbayes.estimate.obstacles import refit_obstacle
from prbayes.estimate.optimum import Optimum, require_of_model, require_sampling
from prbayes.model.elements import finite_draws
from prbayes.model.epsilon import refuse_without_epsilon
from prbayes.model.evaluator import Evaluator
from prbayes.model.identity import Level
from prbayes.model.interruption import designs_as_before
from prbayes.model.node import model_on_context
from prbayes.model.turns import in_turn
from prbayes.posterior.adjustment import Affine
from prbayes.posterior.chains import Particles
from prbayes.posterior.default_adjustment import default_adjustment
from prbayes.posterior.epsilon import calibrate_epsilon
from prbayes.posterior.groups import arviz_groups
from prbayes.posterior.smc import Rounds, epsilons_restored, evaluator_of, optima_of
from prbayes.posterior.trees import adjusted_tree


@in_turn
def adjust(
    idata: xr.DataTree,
    *,
    model: pm.Model | None = None,
    optimum: Optimum | None = None,
    by: Affine | None = None,
    refine: bool = True,
    progressbar: bool = True,
) -> xr.DataTree:
    """Bring draws of any sampler to the width that the data warrant, as `sample_smc` does its own.

    A simulator's log-density is -discrepancy / epsilon, so that draws of ``pymc.sample``, nutpie,
    NumPyro, ``pymc.sample_smc`` or ``pymc.fit`` are as wide as epsilon makes them.

    Parameters
    ----------
    idata : xarray.DataTree
        With a ``posterior`` group that has the model's free variables, dimensions chain and draw.
    model : pymc.Model, optional
        The one on the context by default. For draws of a stock `pymc.Simulator`, with
        `abc_distance`, one that has the same hyperparameters and a `Simulator` in its place.
    optimum : Optimum, optional
        The centre of the adjustment; `minimize` finds it if needed.
    by : Affine, optional
        By what: `Affine` or `GivenEstimate` of ``prb.posterior``; by default as `sample_smc` does.
    refine : bool
        Whether designs of `Reweighted` that do not support the draws get more points.
    progressbar : bool
        Of responses that are computed.

    Returns
    -------
    xarray.DataTree
        Groups ``posterior``, the draws where they should be, with the attribute ``adjustment`` and
        those that `sample_smc` gives besides; ``unadjusted``, those that were given, if an
        adjustment was needed and could be made;
        ``calibration``, ``observed_data``, ``log_prior``, predictive draws of stored responses and,
        given the estimate, ``log_likelihood``, as of `sample_smc`; and those given that do not
        depend on the draws, or tell how they were drawn (``sample_stats``, ``prior`` and the
        like). Predictions and log-likelihoods of the draws before are left out.

    Raises
    ------
    TypeError, KeyError
        If an argument is not as described, there is no model, or the posterior lacks a variable.
    ValueError
        If the draws are of another problem, or were adjusted before; if data sets cannot be
        calibrated anew, as with `Fresh`; or if nothing is known around the optimum (``at_edge``
        and ``at_jump`` of `Optimum`).
    DesignError
        If a design does not support the draws after refinement.

    References
    ----------
    .. [1] Shaby, B. A. (2014), The open-faced sandwich adjustment for MCMC using estimating
       functions, J. Comput. Graph. Stat. 23, 853-876, doi:10.1080/10618600.2013.842174.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> data = np.random.default_rng(1).normal(1.0, 0.5, 20)
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
    ...     y = prb.Simulator("y", lambda x: x, x, metric=prb.AreaMetric(), observed=data)
    >>> prb.set_epsilon(model, {"y": 0.02})
    >>> quiet = dict(progressbar=False, compute_convergence_checks=False)
    >>> with model:
    ...     idata = pm.sample(50, tune=100, chains=2, cores=1, random_seed=1, **quiet)
    >>> adjusted = prb.adjust(idata, model=model, progressbar=False)
    >>> adjusted.posterior.attrs["adjustment"]
    'GivenEstimate(n_sets=200, random_seed=0, n_fits=2000)'
    """
    model = model_on_context(model, "prb.adjust")
    if by is not None and not isinstance(by, Affine):
        raise TypeError(
            f"adjust: by: got {called(by)}, expected prb.posterior.Affine() or "
            "prb.posterior.GivenEstimate()"
        )
    if optimum is not None and not isinstance(optimum, Optimum):
        raise TypeError(
            f"adjust: optimum: got {called(optimum)}, expected an Optimum from prb.minimize"
        )
    flag(refine, "refine")
    refuse_without_epsilon(model, "adjust", "use its draws as they are")
    _refuse_other(idata)
    require_of_model(idata, model, "adjust", Level.OPTIMUM)
    evaluator = evaluator_of(model, optimum, "adjust")
    _require_same_data(idata, evaluator)
    obstacle = refit_obstacle(evaluator)
    if obstacle is not None:
        raise ValueError(f"adjust: the draws cannot be adjusted: {obstacle}")
    draws = _Drawn(evaluator, _thetas(idata, evaluator))
    with shown(progressbar):
        return _adjusted(draws, idata, optimum, by or default_adjustment(evaluator), refine=refine)


def _refuse_other(idata: object) -> None:
    """Raise if there are no draws, or adjusted ones."""
    if not isinstance(idata, xr.DataTree) or "posterior" not in idata.children:
        raise TypeError(
            f"adjust: idata: got {called(idata)}, expected a DataTree with a posterior group, "
            "such as pymc.sample returns"
        )
    before = str(idata["posterior"].attrs.get("adjustment", "none"))
    if "unadjusted" in idata.children or not before.startswith("none"):
        raise ValueError(
            f"adjust: idata: got draws that were adjusted before ({before}), expected those of a "
            "sampler; they are in the group `unadjusted`"
        )


def _require_same_data(idata: xr.DataTree, evaluator: Evaluator) -> None:
    """Raise if the draws are given other data than the model's, as far as they tell.

    A simulator goes by its name, or, where there is one on either side, by that.
    """
    if "observed_data" not in idata.children:
        return
    given = idata["observed_data"].to_dataset()
    names = list(given.data_vars)
    for node in evaluator.nodes:
        only = len(names) == len(evaluator.nodes) == 1
        name = names[0] if only else node.name
        if name not in given:
            continue
        values = given[name].values
        same = values.shape == node.target.observed.shape
        if not same or not np.allclose(values, node.target.observed, rtol=1e-6, equal_nan=True):
            raise ValueError(
                f"adjust: idata: got draws given other data ({name}) than {node.name} observes, "
                "expected those of the model; pass the model that was sampled"
            )


def _thetas(idata: xr.DataTree, evaluator: Evaluator) -> Floats:
    """Return the draws, (chains, draws, d)."""
    posterior: Any = idata["posterior"]
    names = [str(rv.name) for rv in evaluator.model.free_RVs]
    missing = [name for name in names if name not in posterior]
    if missing:
        raise KeyError(
            f"adjust: posterior: got no {missing}, expected the model's free variables {names}"
        )
    draws = finite_draws(posterior, names)
    thetas = evaluator.thetas_of(list(draws.values()))
    outside = ~np.isfinite(thetas).all(axis=1)
    if outside.any():
        raise ValueError(
            f"adjust: posterior: got {int(outside.sum())} draws at or beyond a bound of the "
            "model's priors, expected all within; pass the model that was sampled"
        )
    chains = posterior.sizes["chain"]
    return thetas.reshape(chains, -1, evaluator.size)


@dataclass(eq=False)
class _Drawn:
    """Draws that are there, in the place of `Chains`."""

    evaluator: Evaluator
    thetas: Floats  # (chains, draws, d)
    refined: list[Floats] = field(default_factory=list)

    def __call__(self, seeds: list[np.random.SeedSequence], progressbar: bool) -> Particles:
        """Return them, of which nothing else is known."""
        unknown = np.full((*self.thetas.shape[:2], len(self.evaluator.nodes)), np.nan)
        return Particles(self.thetas, unknown, unknown, [])

    def saved_refinement(self, round_: int) -> None:
        """Return nothing: these are always there."""


def _adjusted(
    draws: _Drawn, idata: xr.DataTree, optimum: Optimum | None, by: Affine, *, refine: bool
) -> xr.DataTree:
    """Return the tree of adjusted draws."""
    clock = time.perf_counter()
    evaluator = draws.evaluator
    with epsilons_restored(evaluator), designs_as_before(evaluator):
        if optimum is None:
            optimum = require_finished(find_optimum(evaluator, Minimisation(refine=refine)))
        require_sampling(optimum, "adjust")
        unset = [node for node in evaluator.nodes if np.isnan(node.epsilon_value)]
        calibrated = calibrate_epsilon(optimum) if unset else {}
        for node in unset:
            node.epsilon.set_value(np.asarray(calibrated[node.name]))
        rounds = Rounds(
            run=draws,
            chains=len(draws.thetas),
            seeds=np.random.SeedSequence(by.random_seed),
            adjustment=by,
            optima=optima_of(optimum, evaluator),
            design_error=optimum.design_error,
            refine=refine and bool(evaluator.designs),
        )
        found = rounds.until_supported(progressbar=False)
        found.warn()
        groups = arviz_groups(
            evaluator,
            draws.thetas,
            found.particles.discrepancies,
            found.thetas,
            found.log_likelihood,
            by.random_seed,
        )
        if found.log_likelihood is None:  # nobody knows what a sampler's draws were of
            groups.pop("log_likelihood", None)
        return adjusted_tree(
            evaluator,
            idata,
            found.thetas,
            unadjusted=None if found.thetas is draws.thetas else draws.thetas,
            adjustment=found.note,
            measured=found.measured,
            warnings=(*optimum.warnings, *found.warnings),
            seconds=time.perf_counter() - clock,
            groups=groups,
        )
