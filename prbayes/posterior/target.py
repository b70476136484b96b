"""Posterior density: priors and a log-likelihood, by specimen or given the estimate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.checks.prior import conflict_findings
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import log_posterior
from prbayes.optimize.optimum import Optimum, optima_of
from prbayes.posterior.estimate_likelihood import estimate_likelihood, score_obstacle
from prbayes.posterior.importance import LogDensity
from prbayes.posterior.refit_likelihood import refit_likelihood


@dataclass(frozen=True, eq=False)
class Target:
    """A posterior density in unconstrained space."""

    evaluator: Evaluator
    log_likelihood: LogDensity  # all terms but the priors
    starts: Floats  # (M, d): points near the modes
    scale: Floats  # (d,): unit of each element for `laplace`

    def log_posterior(self, thetas: Floats) -> Floats:
        """Return the unnormalised log-density, (S, d) -> (S,); -inf where it is not known."""
        return log_posterior(self.evaluator.hyperparameters, thetas, self.log_likelihood)


def specimen_target(evaluator: Evaluator, optimum: Optimum | None) -> Target:
    """Return the posterior of a model whose simulators have a log-likelihood by specimen."""
    prior_sd = evaluator.hyperparameters.prior_sd
    if optimum is not None:
        return Target(evaluator, evaluator.log_other, optima_of(optimum, evaluator), prior_sd)
    target = Target(evaluator, evaluator.log_other, np.empty((0, len(prior_sd))), prior_sd)
    return replace(target, starts=_prior_starts(target))


def _prior_starts(target: Target) -> Floats:
    """Return the best of 1024 prior points, and seven of the best quarter far from each other."""
    prior_sd = target.evaluator.hyperparameters.prior_sd
    thetas = target.evaluator.hyperparameters.prior_points(1024, 0)
    order = np.argsort(-target.log_posterior(thetas), kind="stable")
    candidates = thetas[order[: len(thetas) // 4]] / prior_sd
    selected = [0]
    distances = np.full(len(candidates), np.inf)
    while len(selected) < 8:
        squares = ((candidates - candidates[selected[-1]]) ** 2).sum(axis=1)
        distances = np.minimum(distances, squares)
        selected.append(int(np.argmax(distances)))
    return np.asarray(candidates[selected] * prior_sd)


def estimate_target(evaluator: Evaluator, optimum: Optimum) -> Target:
    """Return the posterior given the metrics' own estimate; raise as `require_density`.

    The estimate of metrics whose gradient is a mean over specimens is an M-estimator, and its
    density follows from the scores of stored responses. The density of other estimates follows from
    refits.
    """
    require_density(evaluator)
    is_mean = score_obstacle(evaluator) is None
    likelihood = (estimate_likelihood if is_mean else refit_likelihood)(evaluator, optimum)

    def log_likelihood(thetas: Floats) -> Floats:
        return likelihood.log_likelihood(thetas) + evaluator.log_other(thetas)

    return Target(evaluator, log_likelihood, likelihood.starts, likelihood.scale)


def require_density(evaluator: Evaluator) -> None:
    """Raise if the density of the metrics' estimate is not known.

    Responses are random, or not stored although the density requires refits.
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
    """Report hyperparameters whose prior pulls the posterior, thetas (..., d), from the estimate.

    The predictive distribution of an estimate is that of draws of the prior with the standard
    errors of the optimum.
    """
    if optimum.search.prior or any(rival["comparable"] for rival in optimum.rivals):
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
