"""Epsilon, the scale of a discrepancy in the pseudo-posterior exp(-d / epsilon), from the information in the data."""

from __future__ import annotations

import numpy as np

from prbayes.estimate.identifiability import seen_by_area, seen_by_curvature
from prbayes.estimate.optimum import Optimum, require_sampling
from prbayes.estimate.sampling import first_order_shifts
from prbayes.estimate.sandwich import Information
from prbayes.metrics.base import Minimum
from prbayes.model.epsilon import Epsilon
from prbayes.model.identity import identity_of, require_same

_CLOUD = 500  # thetas that carry each simulated data set's posterior
_SETS = 200
_LEVEL = 0.89


def calibrate_epsilon(optimum: Optimum) -> dict[str, float]:
    """Return an epsilon for each simulator, such that the posterior is about as wide as the data warrant.

    - KLD and log-likelihood: 1/N, which puts them on the scale of a log-likelihood.
    - Other smooth metrics (probability residual): trace(H^-1 J) / p over the p identified directions, H the
      Hessian of the discrepancy at the optimum and J the sampling covariance of its gradient: then the
      posterior's covariance epsilon H^-1 matches the estimator's H^-1 J H^-1 on average.
    - Area metric: the epsilon with which 89% intervals of the posteriors of data sets simulated at the
      optimum contain the optimum in 89% of cases, on average over the two directions that the data see best.

    No response is computed under `Reweighted`.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`, without the prior.

    Returns
    -------
    dict
        Epsilon by simulator, in units of its discrepancy; for `set_epsilon`.

    Raises
    ------
    TypeError
        For simulators with a `FunctionMetric` or `Fresh`, whose epsilon has to be given.
    ValueError
        If nothing is known around the optimum (``at_edge`` and ``at_jump`` of `Optimum`), or nothing is identified.

    References
    ----------
    .. [1] Shaby, B. A. (2014), The open-faced sandwich adjustment for MCMC using estimating functions,
       J. Comput. Graph. Stat. 23, 853-876.
    .. [2] Syring, N. and R. Martin (2019), Calibrating general posterior credible regions, Biometrika 106,
       479-486, doi:10.1093/biomet/asy054.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.KullbackLeibler(), observed=[0.0, 2.0, 4.0])
    >>> prb.calibrate_epsilon(prb.minimize(model))
    {'y': 0.3333333333333333}
    """
    if not isinstance(optimum, Optimum):
        raise TypeError(
            f"calibrate_epsilon: got {type(optimum).__name__}, expected an Optimum; call "
            "prb.calibrate_epsilon(prb.minimize(model))"
        )
    evaluator = require_sampling(optimum, "calibrate_epsilon").evaluator
    scale = evaluator.prior_sd
    require_same(optimum.identity, identity_of(evaluator), "calibrate_epsilon")
    found = {}
    for k, node in enumerate(evaluator.nodes):
        information = Information(evaluator, k, optimum.theta, scale, n_sets=_SETS)
        found[node.name] = _epsilon(information)
    return Epsilon(found, optimum.identity)


def _epsilon(information: Information) -> float:
    node = information.evaluator.nodes[information.k]
    if node.metric.likelihood:
        return 1 / node.target.n_effective
    unknown = node.metric.minimum is Minimum.UNKNOWN
    if unknown or node.bound.random:
        what = f"a {type(node.metric).__name__}" if unknown else "prb.Fresh"
        raise TypeError(
            f"{node.name}: epsilon of {what} cannot be calibrated, since it has no derivatives; pass epsilon= to "
            "prb.Simulator (the standard deviation of the discrepancy at a good theta is a start)"
        )
    return _sandwich(information) if node.metric.minimum is Minimum.QUADRATIC else _by_coverage(information)


def _sandwich(information: Information) -> float:
    unit = np.outer(information.scale, information.scale)
    hessian, noise = information.hessian * unit, information.sampling_covariance * unit
    values, vectors, seen = seen_by_curvature(hessian, noise)
    _refuse_blind(information, bool(seen.any()))
    along = np.einsum("ik,ij,jk->k", vectors, noise, vectors)
    return float(np.mean(along[seen] / values[seen]))


def _refuse_blind(information: Information, anything: bool) -> None:
    if not anything:
        raise ValueError(
            f"{information.evaluator.nodes[information.k].name}: the data tell less than the prior about every "
            "hyperparameter, so epsilon cannot be calibrated; look at the optimum, widen the priors, or pass epsilon="
        )


def _by_coverage(information: Information) -> float:
    """Solve for the epsilon whose posteriors cover, the features taken as linear in theta."""
    gap, slopes, lengths = information.area(*information.data_set)
    # Strongest last. What a sample of one response tells beyond two directions, close to its location and its
    # spread, is of the order of the error of derivatives of stored weights.
    basis = seen_by_area(information)[:, -2:]
    _refuse_blind(information, basis.shape[1] > 0)
    shifts = first_order_shifts([information], np.ones(1), basis, information.data_sets)
    # The cloud spans the directions seen, three times as wide as the estimator's sampling distribution.
    values, vectors = np.linalg.eigh(np.atleast_2d(np.cov(shifts, rowvar=False)))
    directions = (basis @ (vectors * np.sqrt(np.maximum(values, 0)))) * information.scale[:, None]
    z = np.random.default_rng(information.seed).standard_normal((_CLOUD, basis.shape[1]))
    moved = 3 * (z @ directions.T) @ slopes
    log_proposal = -0.5 * (z**2).sum(axis=-1)
    distances = np.array([(np.abs(g + moved) * lengths).sum(axis=-1) for g in gap])

    def coverage(epsilon: float) -> float:
        logs = -distances / epsilon - log_proposal
        weights = np.exp(logs - logs.max(axis=1, keepdims=True))
        weights /= weights.sum(axis=1, keepdims=True)
        below = np.stack([(weights * (z[:, j] < 0)).sum(axis=1) for j in range(z.shape[1])])
        return float(np.mean(np.abs(below - 0.5) < _LEVEL / 2))

    low, high = (information.noise_floor * f for f in (1e-3, 10.0))
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if coverage(middle) < _LEVEL else (low, middle)
    return float(np.sqrt(low * high))
