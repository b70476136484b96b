"""Epsilon, the scale of a discrepancy in exp(-d / epsilon), from the information in the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from prbayes._stats import INTERVAL
from prbayes._validate import Floats
from prbayes.inference.asymptotics import first_order_shifts, local_sampling
from prbayes.inference.identifiability import identified_by_area, identified_by_curvature
from prbayes.inference.measured import Refits
from prbayes.inference.requirements import simulator_obstacle
from prbayes.inference.resampling import SETS, DataSets, groups
from prbayes.inference.sandwich import Information, LinearArea
from prbayes.metrics.base import Minimum, is_likelihood
from prbayes.model.epsilon import Epsilon, refuse_without_epsilon
from prbayes.model.locking import locked
from prbayes.optimize.optimum import Optimum, require_minimiser, require_sampling

# Thetas that carry each simulated data set's posterior: half or twice changes epsilon by 3%, as
# much as another number of data sets does (docs/constants.md).
_CLOUD = 500
# How much wider than the sampling distribution the cloud is: it has to reach wherever posteriors
# do. Half changes epsilon by 2%; with twice few of its thetas are where posteriors are, and epsilon
# changes by 11% (docs/constants.md).
_WIDER = 3.0


@locked
def calibrate_epsilon(optimum: Optimum) -> dict[str, float]:
    """Return an epsilon for each simulator, so that the posterior is as wide as the data warrant.

    - KLD and log-likelihood: 1/N, which puts them on the scale of a log-likelihood, N the effective
      number of specimens.
    - Other smooth metrics (probability residual): trace(H^-1 J) / p over the p identified
      directions, H the Hessian of the discrepancy at the optimum and J the sampling covariance of
      its gradient: then the posterior's covariance epsilon H^-1 matches the estimator's
      H^-1 J H^-1 on average.
    - Area metric: the epsilon with which 89% intervals of the posteriors of data sets simulated at
      the optimum contain the optimum in 89% of cases, on average over the two directions that the
      data identify best.
    - Metrics that declare nothing of their minimum, such as a `FunctionMetric` (`Reweighted` only):
      the mean, over data sets simulated at the optimum and refitted, of delta . grad d / p at the
      minimiser plus delta, delta drawn from the sampling distribution. For any density proportional
      to exp(-d / epsilon) that mean is epsilon, by integration by parts; for a quadratic d it is
      trace(H Sigma) / p, which is the sandwich's.

    Simulators that share specimens count them several times: their epsilons are then multiplied by
    the ratio of the variance of their common minimiser, over data sets, to that it would have if
    their specimens were different ones (not where a metric declares nothing of its minimum).

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
        For simulators with `Fresh`, or with `Resimulated` and a metric that declares nothing of its
        minimum: their epsilon has to be given.
    ValueError
        If nothing is known around the optimum (``search.at_edge`` and ``search.at_jump``), or
        nothing is identified; if the prior was part of it, its model has changed since, or no
        simulator has an epsilon.

    References
    ----------
    .. [1] Shaby, B. A. (2014), The open-faced sandwich adjustment for MCMC using estimating
       functions, J. Comput. Graph. Stat. 23, 853-876.
    .. [2] Syring, N. and R. Martin (2019), Calibrating general posterior credible regions,
       Biometrika 106, 479-486, doi:10.1093/biomet/asy054.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.KullbackLeibler(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> prb.calibrate_epsilon(prb.minimize(model))
    {'y': 0.3333333333333333}
    """
    if not isinstance(optimum, Optimum):
        raise TypeError(
            f"calibrate_epsilon: got {type(optimum).__name__}, expected an Optimum; call "
            "prb.calibrate_epsilon(prb.minimize(model))"
        )
    refuse_without_epsilon(
        optimum.model, "calibrate_epsilon", "sample it with prb.sample_smc or pm.sample"
    )
    evaluator = require_sampling(optimum, "calibrate_epsilon").evaluator
    require_minimiser(optimum, "calibrate_epsilon")
    found = {}
    for k, node in enumerate(evaluator.nodes):
        information = Information(evaluator, k, optimum.theta, n_sets=SETS)
        found[node.name] = _epsilon(information)
    for group in groups(evaluator.nodes):
        names = [evaluator.nodes[k].name for k in group]
        factor = _dependence(optimum, group, np.array([found[name] for name in names]))
        for name in names:
            found[name] *= factor
    return Epsilon(found, optimum.identity)


def _dependence(optimum: Optimum, group: list[int], epsilon: Floats) -> float:
    """Return by how much the minimiser of simulators that share specimens varies more for it.

    The ratio of variances over data sets, and over the same data sets with the simulators' ones
    exchanged, averaged over the directions identified.
    """
    evaluator = optimum.evaluator
    information = [Information(evaluator, k, optimum.theta, n_sets=SETS) for k in group]
    if len(group) < 2 or any(one.node.metric.minimum is Minimum.UNKNOWN for one in information):
        return 1.0
    basis = local_sampling(information, epsilon).identified
    if not basis.shape[1]:
        return 1.0
    sets = information[0].data_sets

    def variance(shift: int) -> Floats:
        # Rows that belong together are apart, by another number of rows in each simulator.
        weights = [np.roll(w, shift * k, axis=0) for k, w in enumerate(sets.weights)]
        moved = first_order_shifts(information, epsilon, basis, DataSets(sets.values, weights))
        return np.atleast_2d(np.cov(moved, rowvar=False))

    # The mean of some, so that only the errors of the numerator are left.
    apart = np.mean([variance(shift) for shift in range(1, 5)], axis=0)
    ratio = np.linalg.solve(apart, variance(0))
    return float(np.trace(ratio) / len(ratio))


def _epsilon(information: Information) -> float:
    node = information.node
    if is_likelihood(node.target):
        return 1 / node.n_specimens
    obstacle = simulator_obstacle(information.evaluator, information.k)
    if obstacle is not None:
        raise TypeError(
            f"epsilon cannot be calibrated: {obstacle}; pass epsilon= to prb.Simulator (the "
            "standard deviation of the discrepancy at a good theta is a start)"
        )
    match node.metric.minimum:
        case Minimum.QUADRATIC:
            return _sandwich(information)
        case Minimum.ABSOLUTE:
            return _by_coverage(information)
        case Minimum.UNKNOWN:
            return _by_refits(information)


def _sandwich(information: Information) -> float:
    """Return trace(H^-1 J) / p over the directions identified."""
    unit = np.outer(information.prior_sd, information.prior_sd)
    hessian = information.hessian * unit
    noise = information.sampling_covariance * unit
    values, vectors, found = identified_by_curvature(hessian, noise)
    _refuse_unidentified(information, int(found.sum()))
    along = np.einsum("ik,ij,jk->k", vectors, noise, vectors)
    shares = along[found] / values[found]
    return float(np.mean(shares))


def _refuse_unidentified(information: Information, identified: int) -> None:
    """Raise where no direction is identified."""
    if identified:
        return
    name = information.node.name
    raise ValueError(
        f"{name}: the data tell less than the prior about every hyperparameter, so epsilon cannot "
        "be calibrated; look at the optimum, widen the priors, or pass epsilon="
    )


def _by_refits(information: Information) -> float:
    """Return the mean of delta . grad d / p, delta from the sampling distribution.

    The derivative along delta is the difference between one and a half and half of it: exact where
    the discrepancy grows like a square or like an absolute value.
    """
    scales = np.ones(len(information.evaluator.nodes))
    refits = Refits.at(
        information.evaluator,
        information.theta,
        scales,
        simulators=[information.k],
    )
    local = refits.local()
    p = local.identified.shape[1]
    _refuse_unidentified(information, p)
    # One delta for each data set, and its opposite; steps in units of the prior's spread.
    rng = np.random.default_rng(information.seed)
    z = rng.standard_normal((len(refits.shifts), p))
    root = np.linalg.cholesky(local.covariance)
    delta = z @ root.T @ local.identified.T
    shares = np.array([1.5, 0.5, -0.5, -1.5])
    away = shares[:, None] * delta[:, None]
    steps = refits.shifts[:, None] + away
    thetas = refits.theta + steps * refits.prior_sd
    values = refits.objective(thetas, slice(None))
    far, near, opposite, far_opposite = values.T
    slopes = ((far - near) + (far_opposite - opposite)) / 2
    # Where a population leaves the design's reach nothing is known.
    known = slopes[np.isfinite(slopes)]
    return float(known.mean() / p)


@dataclass(frozen=True, eq=False)
class _Cloud:
    """Thetas around the optimum with the distances of data sets from their populations."""

    # (M, r): standard normal coordinates along the principal axes of the sampling distribution.
    z: Floats
    distances: Floats  # (n_sets, M)

    @classmethod
    def around(cls, areas: Sequence[LinearArea], directions: Floats, seed: int) -> _Cloud:
        """Draw the thetas; directions, (d, r), are one standard error long."""
        rng = np.random.default_rng(seed)
        z = rng.standard_normal((_CLOUD, directions.shape[1]))
        shifts = _WIDER * (z @ directions.T)
        total: Any = 0
        for area in areas:
            change = shifts @ area.slopes
            distances = []
            for gap in area.gaps:
                gaps = np.abs(gap + change)
                distance = (gaps * area.lengths).sum(axis=-1)
                distances.append(distance)
            total = total + np.array(distances)
        return cls(z, total)

    def coverage(self, epsilon: float) -> float:
        """Return how often the data sets' posterior intervals contain the optimum, on average."""
        log_proposal = -0.5 * (self.z**2).sum(axis=-1)
        logs = -self.distances / epsilon - log_proposal
        highest = logs.max(axis=1, keepdims=True)
        weights = np.exp(logs - highest)
        weights /= weights.sum(axis=1, keepdims=True)
        # The optimum is at zero: the posterior probability below it, by data set and axis.
        below = []
        for z in self.z.T:
            share = (weights * (z < 0)).sum(axis=1)
            below.append(share)
        off_center = np.abs(np.stack(below) - 0.5)
        inside = off_center < INTERVAL / 2
        return float(np.mean(inside))


def _by_coverage(information: Information) -> float:
    """Solve for the epsilon whose posteriors cover, the features taken as linear in theta."""
    areas = information.areas(*information.data_set)
    # Strongest last. What a sample of one response tells beyond two directions, close to its
    # location and its spread, is of the order of the error of derivatives of stored weights; m
    # outputs have as many locations, spreads and correlations.
    (m,) = information.node.target.event or (1,)
    basis = identified_by_area(information)[:, -m * (m + 3) // 2 :]
    _refuse_unidentified(information, basis.shape[1])
    sets = information.data_sets
    shifts = first_order_shifts([information], np.ones(1), basis, sets)
    # The cloud spans the directions identified, wider than the estimator's sampling distribution.
    covariance = np.atleast_2d(np.cov(shifts, rowvar=False))
    variances, vectors = np.linalg.eigh(covariance)
    errors = np.sqrt(np.maximum(variances, 0))
    axes = basis @ (vectors * errors)
    directions = axes * information.prior_sd[:, None]
    cloud = _Cloud.around(areas, directions, information.seed)
    # Coverage grows with epsilon.
    low, high = (information.noise_floor * factor for factor in (1e-3, 10.0))
    # To rounding.
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        if cloud.coverage(middle) < INTERVAL:
            low = middle
        else:
            high = middle
    return float(np.sqrt(low * high))
