"""Bootstrap distributions of the minimiser: no epsilon and no prior."""

from __future__ import annotations

import time

import numpy as np
import xarray as xr

from prbayes._progress import shown
from prbayes._validate import Seed, flag, positive_integer, seed_number
from prbayes.inference.identifiability import unidentified_directions
from prbayes.inference.refits import is_prepared_by_data, refit, refit_prepared
from prbayes.inference.resampling import dirichlet_weights, reweighted_sets, simulated_sets
from prbayes.model.locking import locked
from prbayes.optimize.optimum import Optimum, require_refits
from prbayes.optimize.specimen_refits import is_specimen_optimum, specimen_refits
from prbayes.posterior.trees import bootstrap_tree


@locked
def bootstrap(
    optimum: Optimum,
    draws: int = 1000,
    *,
    parametric: bool = False,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> xr.DataTree:
    """Minimise the discrepancy once for each of many data sets that resemble the observed one.

    By default the observed specimens get Dirichlet weights: the loss-likelihood bootstrap, whose
    minimisers are draws from a posterior without prior and without epsilon. The parametric
    bootstrap draws data sets from the model at the optimum; its minimisers are the sampling
    distribution of the optimum. Observations that share a specimen label are weighted, or drawn,
    together.

    With `Reweighted` each minimisation is exact and computes no response; with `Resimulated` it is
    of first order. A metric of several outputs takes its coordinates from the data, and is prepared
    for each data set, which takes some hundredths of a second. With the log-likelihood by specimen
    the minimisers are maximum-likelihood estimates; simulated data sets are drawn from one pool of
    simulated specimens, and nothing is run.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`, without the prior.
    draws : int
    parametric : bool
    random_seed : int, sequence of int, numpy.random.Generator or None
    progressbar : bool
        Whether work of more than two seconds shows a bar on stderr.

    Returns
    -------
    xarray.DataTree
        Group ``posterior`` with dimensions (chain, draw), chain of length one, for ArviZ and
        `compare`; and ``observed_data``. The attribute ``converged`` is the share of minimisations
        that did.

    Raises
    ------
    TypeError
        If ``optimum`` is no Optimum.
    ValueError
        If the data tell less than the prior about a direction, along which the minimiser is
        anywhere; or if nothing is known of a metric or propagation (`FunctionMetric`, `Fresh`); if
        the prior was part of the optimum, or its model has changed since.

    References
    ----------
    .. [1] Lyddon, S. P., C. C. Holmes and S. G. Walker (2019), General Bayesian updating and the
       loss-likelihood bootstrap, Biometrika 106, 465-478, doi:10.1093/biomet/asz006.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     data = [0.0, 2.0, 4.0]
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=data)
    >>> prb.bootstrap(prb.minimize(model), draws=50).posterior["mu"].shape
    (1, 50)
    """
    if is_specimen_optimum(optimum):
        return _by_specimen(optimum, draws, parametric=parametric, seed=seed_number(random_seed))
    clock = time.perf_counter()
    evaluator = require_refits(optimum, "bootstrap", "; use prb.sample_smc").evaluator
    positive_integer(draws, "draws", minimum=2)
    flag(parametric, "parametric")
    seed = seed_number(random_seed)
    sampling = optimum.sampling()
    unidentified = unidentified_directions(
        sampling.local.unidentified, evaluator.hyperparameters.readable_names
    )
    if unidentified:
        raise ValueError(
            f"bootstrap: the data tell less than the prior about {', '.join(unidentified)}, "
            "along which the minimiser is anywhere; use prb.sample_smc, whose posterior "
            "falls back on the prior there, or fix a hyperparameter"
        )
    if parametric:
        data = simulated_sets(evaluator, optimum.theta, draws, seed)
    else:
        data = reweighted_sets(evaluator, draws, seed)
    with shown(progressbar):
        x, converged = refit(sampling, data)
        if is_prepared_by_data(sampling.evaluator):
            x, converged = refit_prepared(sampling, data, x)
    return bootstrap_tree(
        evaluator,
        sampling.thetas(x)[None],
        sampler="parametric bootstrap" if parametric else "loss-likelihood bootstrap",
        converged=float(converged.mean()),
        seed=seed,
        n_responses=optimum.n_responses,
        seconds=time.perf_counter() - clock,
    )


def _by_specimen(optimum: Optimum, draws: int, *, parametric: bool, seed: int) -> xr.DataTree:
    """Return estimates of data sets that resemble the observed one, by maximum likelihood."""
    clock = time.perf_counter()
    positive_integer(draws, "draws", minimum=2)
    flag(parametric, "parametric")
    refits = specimen_refits(optimum, "bootstrap", simulated=parametric)
    unidentified = np.isinf(np.diag(optimum.covariance))
    if unidentified.any():
        names = [n for n, is_flat in zip(optimum.names, unidentified, strict=True) if is_flat]
        raise ValueError(
            f"bootstrap: the data tell less than the prior about {', '.join(names)}, along which "
            "the estimate is arbitrary; use prb.sample_smc, whose posterior falls back on the "
            "prior there, or fix a hyperparameter"
        )
    evaluator = refits.evaluator
    if parametric:
        estimates = list(refits.simulated(draws, seed))
        thetas = np.array([refit.theta for refit in estimates])
        converged = np.array([refit.converged for refit in estimates])
    else:
        weights = dirichlet_weights(evaluator.emulated, draws, seed)
        thetas, converged = refits.reweighted(weights)
    return bootstrap_tree(
        evaluator,
        thetas[None],
        sampler="parametric bootstrap" if parametric else "loss-likelihood bootstrap",
        converged=float(converged.mean()),
        seed=seed,
        n_responses=optimum.n_responses,
        seconds=time.perf_counter() - clock,
    )
