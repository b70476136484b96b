"""Cross-validation of a discrepancy: `held_out`."""

from __future__ import annotations

import numpy as np
import xarray as xr

from prbayes._checks import positive_integer
from prbayes.estimate.data_sets import DataSets, specimens
from prbayes.estimate.obstacles import refit_obstacle
from prbayes.estimate.optimum import Optimum, surveyed
from prbayes.estimate.refit import SamplingDistribution
from prbayes.model.labels import versions


def held_out(optimum: Optimum, *, folds: int = 5, random_seed: int = 0) -> xr.Dataset:
    """Calibrate on parts of the specimens, and return the discrepancy of those left out.

    In place of LOO and WAIC, which do not apply to a discrepancy: it is one value for all specimens together.
    The smaller the mean, the better the family of populations predicts other specimens. Only discrepancies of
    the same metric, data and folds are to be compared: between families, responses or inputs, not between
    metrics. Minimisations start at the optimum and, with `Reweighted`, compute no response.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`, without the prior.
    folds : int
        Number of parts; specimens are dealt out at random, those with the same label together.
    random_seed : int
        Models with as many specimens have the same folds with the same seed.

    Returns
    -------
    xarray.Dataset
        Dims (fold, simulator): ``discrepancy`` of the specimens left out, ``calibrated`` of the others, in
        units of the metric; ``n_held_out``; and ``converged`` by fold. Where a fold has no observation of a
        simulator its discrepancy is NaN.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, there are fewer specimens than two per fold, or nothing is known
        of a metric or propagation (`FunctionMetric`, `Fresh`).

    References
    ----------
    .. [1] Geisser, S. (1975), The predictive sample reuse method with applications, J. Am. Stat. Assoc. 70, 320-328,
       doi:10.1080/01621459.1975.10479865.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> data = np.random.default_rng(1).normal(1.0, 0.5, 40)
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
    ...     y = prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=data)
    >>> found = prb.held_out(prb.minimize(model))
    >>> found.discrepancy.dims, bool((found.discrepancy > found.calibrated).mean() > 0.5)
    (('fold', 'simulator'), True)
    """
    if not isinstance(optimum, Optimum):
        raise TypeError(f"held_out: got {type(optimum).__name__}, expected an Optimum; call prb.minimize() first")
    evaluator = surveyed(optimum, "held_out").evaluator
    reason = refit_obstacle(evaluator)
    if reason:
        raise ValueError(f"held_out: {reason}, so that the model cannot be calibrated anew")
    folds = positive_integer(folds, "folds", minimum=2)
    numbers, total = specimens(evaluator.nodes)
    if total < 2 * folds:
        raise ValueError(f"folds: got {folds} for {total} specimens, expected at most {total // 2}")
    fold = np.random.default_rng([random_seed, 3]).permutation(np.arange(total) % folds)
    targets = [n.target for n in evaluator.nodes]
    out = [fold[number] == np.arange(folds)[:, None] for number in numbers]
    kept = [np.where(o, 0.0, t.weights) for o, t in zip(out, targets, strict=True)]
    few = [n.name for n, w in zip(evaluator.nodes, kept, strict=True) if ((w > 0).sum(axis=1) < 2).any()]
    if few:
        raise ValueError(f"folds: got {folds}, with fewer than 2 observations of {few} in the others, expected fewer")
    kept = [w / w.sum(axis=1, keepdims=True) for w in kept]
    scales = np.array(list(optimum.scales.values()))
    sampling = SamplingDistribution.of(evaluator, optimum.theta, scales)
    x, converged = sampling.refit(DataSets([t.observed for t in targets], kept))
    thetas = sampling.thetas(x)
    found = np.full((2, folds, len(targets)), np.nan)
    for k, target in enumerate(targets):
        values, weights = evaluator.populations(thetas, k)
        for i in range(folds):
            for j, w in enumerate((np.where(out[k][i], target.weights, 0.0), kept[k][i])):
                if w.sum() > 0:
                    other = target.with_observed(target.observed, w / w.sum())
                    found[j, i, k] = other.of(values[i : i + 1], weights[i : i + 1])[0]
    where = ["fold", "simulator"]
    return xr.Dataset(
        {
            "discrepancy": (where, found[0]),
            "calibrated": (where, found[1]),
            "n_held_out": (where, np.array([o.sum(axis=1) for o in out]).T),
            "converged": ("fold", converged),
        },
        coords={"fold": np.arange(folds), "simulator": [n.name for n in evaluator.nodes]},
        attrs={"random_seed": str(random_seed), **versions()},
    )
