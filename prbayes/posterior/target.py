"""The posterior that `sample` and `sample_smc` draw from: priors and a log-likelihood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.checks.prior_conflict import conflict_findings
from prbayes.model.evaluator import Evaluator
from prbayes.optimize.optimum import Optimum, optima_of
from prbayes.posterior.estimate_likelihood import estimate_likelihood, score_obstacle
from prbayes.posterior.importance import LogDensity
from prbayes.posterior.refit_likelihood import refit_likelihood


@dataclass(frozen=True, eq=False)
class Target:
    """A posterior density in unconstrained space.

    Attributes
    ----------
    evaluator : Evaluator
    log_likelihood : callable
        (S, d) -> (S,): all terms but the priors.
    starts : tuple of ndarray, shapes (d,)
        Points near the modes.
    scale : ndarray, shape (d,)
        Unit of each element for `laplace`.
    """

    evaluator: Evaluator
    log_likelihood: LogDensity
    starts: tuple[Floats, ...]
    scale: Floats

    def log_posterior(self, thetas: Floats) -> Floats:
        """Return the unnormalised log-density, (S, d) -> (S,); -inf where it is not known."""
        return self.evaluator.hyperparameters.log_posterior(thetas, self.log_likelihood)


def specimen_target(evaluator: Evaluator, optimum: Optimum | None) -> Target:
    """Return the posterior of a model whose simulators have a log-likelihood by specimen."""
    if optimum is None:
        starts = _prior_starts(evaluator)
    else:
        starts = tuple(optima_of(optimum, evaluator))
    return Target(evaluator, evaluator.log_other, starts, evaluator.hyperparameters.prior_sd)


def _prior_starts(evaluator: Evaluator, screened: int = 1024, count: int = 8) -> tuple[Floats, ...]:
    """Return the best point of the prior, and others of the best quarter far from each other."""
    thetas = evaluator.hyperparameters.prior_points(screened, 0)
    heights = Target(
        evaluator, evaluator.log_other, (), evaluator.hyperparameters.prior_sd
    ).log_posterior(thetas)
    order = np.argsort(-heights, kind="stable")
    candidates = thetas[order[: screened // 4]] / evaluator.hyperparameters.prior_sd
    chosen = [0]
    distance = np.full(len(candidates), np.inf)
    while len(chosen) < count:
        away = ((candidates - candidates[chosen[-1]]) ** 2).sum(axis=1)
        distance = np.minimum(distance, away)
        chosen.append(int(np.argmax(distance)))
    return tuple(candidates[chosen] * evaluator.hyperparameters.prior_sd)


def estimate_target(evaluator: Evaluator, optimum: Optimum) -> Target:
    """Return the posterior given the metrics' own estimate.

    The estimate of metrics whose gradient is a mean over specimens is an M-estimator, and its
    density follows from the scores of stored responses. The density of other estimates follows from
    refits.

    Raises
    ------
    ValueError
        If the density is not known (`require_density`).
    """
    require_density(evaluator)
    by_scores = score_obstacle(evaluator) is None
    density = estimate_likelihood if by_scores else refit_likelihood
    likelihood = density(evaluator, optimum)

    def log_likelihood(thetas: Floats) -> Floats:
        return likelihood.log_likelihood(thetas) + evaluator.log_other(thetas)

    return Target(evaluator, log_likelihood, tuple(likelihood.starts), likelihood.scale)


def require_density(evaluator: Evaluator) -> None:
    """Raise if the density of the metrics' estimate is not known, before a search for it.

    Raises
    ------
    ValueError
        If responses are random, or not stored although the density takes refits.
    """
    obstacle = score_obstacle(evaluator)
    for node in evaluator.nodes:
        if node.bound.random:
            reason = "its discrepancy is random"
            expected = "prb.Reweighted() or prb.Resimulated()"
        elif obstacle is not None and not node.bound.stored:
            reason = obstacle
            expected = "prb.Reweighted(), whose stored responses can be refitted"
        else:
            continue
        raise ValueError(
            f"{node.name}: propagation: got {type(node.propagation).__name__}, with which the "
            f"distribution of the estimate is not known ({reason}); expected {expected}, or "
            "prb.sample_smc with adjustment=None, whose draws are as wide as epsilon makes them"
        )


def prior_conflicts(
    optimum: Optimum, evaluator: Evaluator, thetas: Floats, size: int = 4096
) -> tuple[Finding, ...]:
    """Report hyperparameters whose prior pulls the posterior away from the estimate.

    The predictive distribution of an estimate is that of draws of the prior with the standard
    errors of the optimum.

    Parameters
    ----------
    optimum : Optimum
    evaluator : Evaluator
    thetas : ndarray, shape (..., d)
        Draws of the posterior.
    size : int
        Number of draws of the prior.
    """
    if optimum.prior or any(rival["comparable"] for rival in optimum.rivals):
        return ()
    order = [optimum.names.index(name) for name in evaluator.hyperparameters.names]
    covariance = optimum.covariance[np.ix_(order, order)]
    is_identified = np.isfinite(np.diag(covariance))
    if not is_identified.any():
        return ()
    within = covariance[np.ix_(is_identified, is_identified)]
    prior = evaluator.hyperparameters.prior_thetas(size, 0)[:, is_identified]
    rng = np.random.default_rng(5)
    errors = rng.multivariate_normal(np.zeros(len(within)), within, size, method="eigh")
    names = np.array(evaluator.hyperparameters.readable_names)[is_identified]
    return conflict_findings(
        names.tolist(),
        prior,
        optimum.theta[order][is_identified],
        np.sqrt(np.diag(within)),
        thetas.reshape(-1, evaluator.hyperparameters.size)[:, is_identified].mean(axis=0),
        prior + errors,
    )
