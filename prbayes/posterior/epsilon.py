"""Epsilon, the scale of a discrepancy in exp(-d / epsilon): its calibration, and its setting."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pymc as pm

from prbayes._stats import INTERVAL
from prbayes._validate import Floats, positive_number, wrong_value
from prbayes.inference.asymptotics import (
    Information,
    first_order_shifts,
    identified_by_area,
    identified_by_curvature,
    local_sampling,
)
from prbayes.inference.refits import simplex_refits, simulator_obstacle
from prbayes.inference.resampling import DataSets, groups
from prbayes.metrics.area import correction_table, interpolated
from prbayes.metrics.base import Minimum, is_likelihood
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import Identity, identity_of, require_same
from prbayes.model.locking import locked
from prbayes.model.random_variable import AnySimulator, simulators
from prbayes.model.specimen_likelihood import require_simulator, specimen_likelihoods
from prbayes.numerics.mixtures import normalised_weights
from prbayes.optimize.minimize import find_optimum, require_finished
from prbayes.optimize.objective import Minimisation
from prbayes.optimize.optimum import Optimum, require_minimiser, require_sampling
from prbayes.propagation.reweighted import Reweighted

_log = logging.getLogger("prbayes")


@locked
def calibrate_epsilon(optimum: Optimum) -> dict[str, float]:
    """Return an epsilon for each simulator with which the posterior has the width of the estimate.

    - KLD and log-likelihood: 1/N, the scale of a log-likelihood. N is the effective number of
      specimens.
    - Other smooth metrics (probability residual): trace(H^-1 J) / p over the p identified
      directions. H is the Hessian of the discrepancy at the optimum, J the sampling covariance of
      its gradient. The posterior's covariance epsilon H^-1 then matches the estimator's
      H^-1 J H^-1 on average.
    - Area metric: data sets are simulated at the optimum. With this epsilon, 89% intervals of their
      posteriors contain the optimum in 89% of cases, on average over the two directions that the
      data identify best.
    - Metrics with an undeclared minimum, such as a `FunctionMetric` (`Reweighted` only): the mean
      of delta . grad d / p at the minimiser plus delta, over refitted data sets, with delta from
      the sampling distribution. For a density proportional to exp(-d / epsilon) it is epsilon, by
      integration by parts.

    Simulators that share specimens count them several times. Their epsilons are multiplied by the
    ratio of the variance of their common minimiser to its variance with different specimens (not
    with a metric whose minimum is undeclared).

    No response is computed under `Reweighted`. Under `Fresh`, whose discrepancy is random, another
    optimum is estimated from runs that are kept, as under `Reweighted`, and epsilon there.

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
        For simulators with `Resimulated` and a metric of undeclared minimum, or with `Fresh` and a
        metric or inputs that `Reweighted` does not take: pass their epsilon.
    ValueError
        If the optimum is at an edge or a jump (``search.at_edge``, ``search.at_jump``), or
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
    refuse_without_epsilon(optimum.model, "calibrate_epsilon")
    evaluator = require_sampling(optimum, "calibrate_epsilon").evaluator
    require_minimiser(optimum, "calibrate_epsilon")
    identity, kept = optimum.search.identity, with_kept_runs(evaluator)
    if kept is not evaluator:
        optimum = find_optimum(kept, Minimisation(start=optimum.point))
        evaluator = require_sampling(require_finished(optimum), "calibrate_epsilon").evaluator
    nodes = evaluator.nodes
    information = [Information(evaluator, k, optimum.theta) for k in range(len(nodes))]
    epsilons = np.array([_epsilon_of(item) for item in information])
    for group in groups(nodes):
        ratio = _variance_ratio([information[k] for k in group], epsilons[group])
        epsilons[group] *= ratio
    by_name = {node.name: float(value) for node, value in zip(nodes, epsilons, strict=True)}
    return Epsilon(by_name, identity)


def with_kept_runs(evaluator: Evaluator) -> Evaluator:
    """Return an evaluator whose simulators with `Fresh` keep their runs, as under `Reweighted`.

    Then their discrepancies are smooth functions of the hyperparameters, so that their minimiser
    has a sampling distribution. It is the same evaluator without such simulators.
    """
    changed = []
    for node in evaluator.nodes:
        if node.bound.random:
            stored = Reweighted(max(node.bound.n_per_theta, 1024), emulator=None)
            try:
                stored.check_simulator(node.name, node.inputs, node.target)
            except TypeError as error:
                text = f"epsilon cannot be calibrated: {error}; pass epsilon= to prb.Simulator"
                raise TypeError(text) from None
            bound = stored.bind(node.name, node.inputs, node.target, node.responses)
            node = replace(node, bound=bound, propagation=stored)
        changed.append(node)
    if changed == list(evaluator.nodes):
        return evaluator
    return replace(evaluator, nodes=tuple(changed), functions={})


def _variance_ratio(information: list[Information], epsilon: Floats) -> float:
    """Return the variance of the minimiser with shared specimens over that with different ones."""
    minima = [item.node.metric.minimum for item in information]
    if len(minima) < 2 or Minimum.UNKNOWN in minima:
        return 1.0
    basis = local_sampling(information, epsilon).identified
    if not basis.shape[1]:
        return 1.0
    sets = information[0].data_sets
    variances = []
    # Exchange the data sets between the simulators, so that their specimens are different.
    for shift in range(5):
        weights = [np.roll(w, shift * k, axis=0) for k, w in enumerate(sets.weights)]
        shifts = first_order_shifts(information, epsilon, basis, DataSets(sets.values, weights))
        variances.append(np.atleast_2d(np.cov(shifts, rowvar=False)))
    # The mean over four exchanges has a negligible error.
    ratio = np.linalg.solve(np.mean(variances[1:], axis=0), variances[0])
    return float(np.trace(ratio) / len(ratio))


def _epsilon_of(information: Information) -> float:
    """Return the epsilon of a simulator by itself."""
    node = information.node
    if is_likelihood(node.target):
        return 1 / node.n_specimens
    obstacle = simulator_obstacle(information.evaluator, information.k)
    if obstacle is not None:
        raise TypeError(
            f"epsilon cannot be calibrated: {obstacle}; pass epsilon= to prb.Simulator (the "
            "standard deviation of the discrepancy at a good theta is a start)"
        )
    methods = {
        Minimum.QUADRATIC: _by_sandwich,
        Minimum.ABSOLUTE: _by_coverage,
        Minimum.UNKNOWN: _by_refits,
    }
    epsilon = methods[node.metric.minimum](information)
    if epsilon is None:
        raise ValueError(
            f"{node.name}: the data are less informative than the prior about every "
            "hyperparameter, so that epsilon cannot be calibrated; look at the optimum, widen the "
            "priors, or pass epsilon="
        )
    return epsilon


def _by_sandwich(information: Information) -> float | None:
    """Return trace(H^-1 J) / p over the p identified directions, None without any."""
    unit = np.outer(information.prior_sd, information.prior_sd)
    noise = information.sampling_covariance * unit
    values, vectors, is_identified = identified_by_curvature(information.hessian * unit, noise)
    if not is_identified.any():
        return None
    variances = np.einsum("ik,ij,jk->k", vectors, noise, vectors)
    return float(np.mean(variances[is_identified] / values[is_identified]))


def _by_refits(information: Information) -> float | None:
    """Return the mean of delta . grad d / p, delta from the sampling distribution.

    The derivative along delta is the difference between 1.5 delta and .5 delta, which is exact for
    a discrepancy that grows like a square or like an absolute value.
    """
    scales = np.ones(len(information.evaluator.nodes))
    refits = simplex_refits(
        information.evaluator, information.theta, scales, simulators=[information.k]
    )
    local = refits.local()
    p = local.identified.shape[1]
    if not p:
        return None
    # Draw a delta for each data set, in units of the prior's spread, and use its opposite as well.
    z = np.random.default_rng(0).standard_normal((len(refits.shifts), p))
    root = np.linalg.cholesky(local.covariance)
    delta = z @ root.T @ local.identified.T
    factors = np.array([1.5, 0.5, -0.5, -1.5])
    steps = refits.shifts[:, None] + factors[:, None] * delta[:, None]
    values = refits.objective(refits.theta + steps * refits.prior_sd, slice(None))
    far, near, opposite, far_opposite = values.T
    slopes = ((far - near) + (far_opposite - opposite)) / 2
    # Leave out populations that the design does not reach, whose slopes are not finite.
    return float(slopes[np.isfinite(slopes)].mean() / p)


def _by_coverage(information: Information) -> float | None:
    """Solve for the epsilon whose posteriors have the nominal coverage, with linear features."""
    # Keep the strongest directions, which are the last: two for one output, close to its location
    # and spread, because further information is of the order of the error of derivatives of stored
    # weights. With m outputs they are as many as locations, spreads and correlations.
    (m,) = information.node.target.event or (1,)
    basis = identified_by_area(information)[:, -m * (m + 3) // 2 :]
    if not basis.shape[1]:
        return None
    shifts = first_order_shifts([information], np.ones(1), basis, information.data_sets)
    covariance = np.atleast_2d(np.cov(shifts, rowvar=False))
    variances, vectors = np.linalg.eigh(covariance)
    axes = basis @ (vectors * np.sqrt(np.maximum(variances, 0)))
    # (d, r): axes in theta, each one standard error long
    directions = axes * information.prior_sd[:, None]
    # Thetas around the optimum scatter three times as wide as the sampling distribution, to reach
    # the posteriors of all data sets.
    z = np.random.default_rng(0).standard_normal((500, directions.shape[1]))
    thetas = 3.0 * (z @ directions.T)
    distances = 0  # (n_sets, M): discrepancies of the data sets at the thetas
    for area in information.areas(information.data_sets):
        change = thetas @ area.slopes
        rows = [(np.abs(gap + change) * area.lengths).sum(axis=-1) for gap in area.gaps]
        levels = interpolated(correction_table(area.specimens), area.simulated + change)
        distances = distances + np.array(rows) - (levels * area.lengths).sum(axis=-1)
    log_proposal = -0.5 * (z**2).sum(axis=-1)
    # Bisect the logarithm of epsilon, because coverage grows with it.
    low, high = (information.noise_floor * factor for factor in (1e-3, 10.0))
    for _ in range(40):  # enough to reach rounding errors
        middle = float(np.sqrt(low * high))
        logs = -distances / middle - log_proposal
        weights = normalised_weights(logs)
        # below: posterior probability below the optimum, which is at zero, by axis and data set
        below = np.stack([(weights * (column < 0)).sum(axis=1) for column in z.T])
        coverage = float(np.mean(np.abs(below - 0.5) < INTERVAL / 2))
        low, high = (middle, high) if coverage < INTERVAL else (low, middle)
    return float(np.sqrt(low * high))


class Epsilon(dict[str, float]):
    """Epsilon by the names of simulators, with the identity of the problem, None if unknown."""

    def __init__(self, values: Mapping[str, float], identity: Identity | None) -> None:
        super().__init__(values)
        self.identity = identity


def checked_epsilon(
    epsilon: Mapping[str, float], simulators: Sequence[AnySimulator], model: pm.Model, caller: str
) -> dict[str, float]:
    """Return positive numbers by the names of simulators; raise if they are no such numbers."""
    if not isinstance(epsilon, Mapping):
        raise wrong_value(
            epsilon,
            "epsilon",
            'a mapping of names of simulators to positive numbers, such as {"y": 0.1}',
        )
    names = [simulator.name for simulator in simulators]
    unknown = sorted(map(str, set(epsilon) - set(names)))
    if unknown:
        raise KeyError(f"epsilon: got {unknown}, expected names of simulators: {sorted(names)}")
    if isinstance(epsilon, Epsilon):
        require_same(epsilon.identity, identity_of(Evaluator.of(model)), caller)
    return {name: positive_number(value, f"{name}: epsilon") for name, value in epsilon.items()}


def refuse_without_epsilon(model: pm.Model, caller: str) -> None:
    """Raise if all simulators of a model have a log-likelihood by specimen, without an epsilon."""
    if specimen_likelihoods(model) and not simulators(model):
        raise ValueError(
            f"{caller}: got a model whose simulators use prb.LogLikelihood(), which has no epsilon "
            "and whose draws have the width of the data, expected a metric of distributions; "
            "sample it with prb.sample_smc or pm.sample"
        )


@locked
def set_epsilon(model: pm.Model, epsilon: dict[str, float]) -> None:
    """Set the epsilon of simulators by name.

    Parameters
    ----------
    model : pymc.Model
    epsilon : dict
        Positive numbers by the names of simulators; others keep theirs.

    Raises
    ------
    KeyError, TypeError, ValueError
        If a name is unknown, a value is not a positive number, `calibrate_epsilon` found them for
        another problem, or no simulator has an epsilon; then nothing is changed.

    Notes
    -----
    A clone of a model (``pymc.do``, ``pymc.observe``, a copy) has its own epsilons from its first
    use by this package; functions that were compiled before follow the original.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu"), 1.0)
    ...     y = prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=[0.5, 1.0, 4.0])
    >>> prb.set_epsilon(model, {"y": 0.1})
    """
    refuse_without_epsilon(model, "set_epsilon")
    require_simulator(model)
    by_metric = list(simulators(model).values())
    values = checked_epsilon(epsilon, by_metric, model, "set_epsilon")
    for simulator in by_metric:
        if simulator.name in values:
            simulator.epsilon.set_value(np.asarray(values[simulator.name]))
    _log.info(
        "draws of exp(-discrepancy / epsilon), as those of pymc.sample, are as wide as epsilon "
        "makes them; prb.sample draws the posterior given the estimate"
    )
