"""Refinement of the designs of `Reweighted`: more points where the populations that matter live."""

from __future__ import annotations

import logging

import numpy as np

from prbayes._checks import Floats
from prbayes.estimate.data_sets import siblings
from prbayes.estimate.sandwich import Information
from prbayes.model.evaluator import Evaluator
from prbayes.model.support import DesignError, shortcomings

_log = logging.getLogger("prbayes")
MAX_ROUNDS = 8
_THETAS = 256
AGREE = 0.1  # standard errors within which the optima of two independent designs are to be
_RATE = 0.65  # the power of its size with which the error of a design of several inputs falls, about


def refine_at(evaluator: Evaluator, thetas: Floats) -> dict[str, str]:
    """Add one batch to each design that falls short at thetas, shape (P, d); return what was short."""
    short = shortcomings(evaluator, thetas)
    for name, what in short.items():
        if what.startswith("lost mass"):
            raise DesignError(
                f"{name}: {what}; repair the response there, return +inf for specimens that fail, narrow the priors, "
                "or raise max_lost"
            )
    _add(evaluator, thetas, set(short))
    return short


def grow(evaluator: Evaluator, thetas: Floats, error: float) -> bool:
    """Add points to all designs until their error is expected to be small enough; return whether any were added.

    Parameters
    ----------
    evaluator : Evaluator
    thetas : ndarray, shape (P, d)
        Where the populations live that matter.
    error : float
        Difference between the optima of independent designs, in standard errors.
    """
    factor = min(2.0, (error / AGREE) ** (1 / _RATE))
    _log.info("independent designs would differ by %.2f standard errors, expected at most %.2f", error, AGREE)
    return _add(evaluator, thetas, set(evaluator.designs), factor)


def _add(evaluator: Evaluator, thetas: Floats, names: set[str], factor: float = 1.0) -> bool:
    """Add one batch to the designs named, and to those of simulators that share their specimens.

    The batch has the design's first size, or brings the whole to ``factor`` times what it was. Returns whether
    ``max_points`` left room for any.
    """
    names = siblings(evaluator.nodes, names)
    added = False
    for k, node in enumerate(evaluator.nodes):
        design = node.design
        if node.name in names and design is not None:
            first, now = design.config.n, design.n_points
            batches = max(1, round((factor - 1) * now / first))
            size = min(batches * first, design.max_points - now)
            if size > 0:
                design.add(evaluator.roots(thetas, k), size)
                added = True
                _log.info("%s: refined to %d responses", node.name, design.n_points)
    return added


def pilot(evaluator: Evaluator, scales: Floats, scale: Floats, *, seed: int = 0) -> Floats:
    """Lead a design that is far too thin from the prior to where the discrepancy is small, in short steps.

    Each step keeps the best quarter of the thetas and, where the design is thin there, adds points from
    their populations before it looks closer: the kept thetas are never far from the design's reach.

    Returns
    -------
    ndarray, shape (256, d)
        Thetas whose discrepancies differ by no more than sampling noise.
    """
    rng = np.random.default_rng(seed)
    thetas = evaluator.prior_thetas(4 * _THETAS, seed)
    for _ in range(2 * MAX_ROUNDS):
        found = evaluator(thetas)
        value = (found.discrepancies / scales).sum(axis=-1) - found.log_other
        value = np.where(np.isfinite(found.log_prior), value, np.inf)
        order = np.argsort(value)[:_THETAS]
        best = thetas[order]
        thin = {
            name
            for name, support in evaluator.support(best).items()
            if np.median(support["weight_ess"]) < evaluator.designs[name].required_ess
        }
        _add(evaluator, best, {name for name in thin if evaluator.designs[name].n_batches <= MAX_ROUNDS})
        noise = sum(Information(evaluator, k, best[0], n_sets=50).noise_floor / s for k, s in enumerate(scales))
        if not thin and value[order[-1]] - value[order[0]] < noise:
            break
        covariance = np.atleast_2d(np.cov(best, rowvar=False))
        root = np.linalg.cholesky(covariance + 1e-12 * np.diag(np.diag(covariance)))
        parents = best[rng.integers(len(best), size=4 * _THETAS)]
        thetas = parents + 0.4 * rng.standard_normal(parents.shape) @ root.T
    return best


def refuse(short: dict[str, str], evaluator: Evaluator) -> None:
    """Raise for designs that still fall short."""
    if short:
        first = next(iter(short))
        points = evaluator.designs[first].n_points
        raise DesignError(
            "; ".join(f"{name}: the design does not support the answer: {what}" for name, what in short.items())
            + f"; narrow the priors, pass a larger prb.Reweighted(n) (now {points} points in all, of at "
            f"most {evaluator.designs[first].max_points}), or use "
            "prb.Resimulated(n), which has no design"
        )


def spread_around(center: Floats, covariance: Floats, scale: Floats, *, seed: int = 0) -> Floats:
    """Return thetas around an optimum, from a normal with its covariance, at most the prior's scale."""
    known = np.where(np.isfinite(covariance), covariance / np.outer(scale, scale), 0.0)
    known[np.diag_indices_from(known)] = np.where(np.isfinite(np.diag(covariance)), np.diag(known), 1.0)
    values, vectors = np.linalg.eigh(known)
    sd = np.sqrt(np.clip(values, 0, 1))
    z = np.random.default_rng(seed).standard_normal((_THETAS, center.size))
    return np.asarray(center + (z * sd) @ vectors.T * scale)
