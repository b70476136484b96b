"""Refinement of the designs of `Reweighted`: more points where the populations that matter live."""

from __future__ import annotations

import logging

import numpy as np
import pymc as pm

from prbayes._checks import Floats
from prbayes.information import Information
from prbayes.population import Evaluator
from prbayes.propagation.reweighted import Design
from prbayes.resampling import siblings
from prbayes.simulator import model_on_context

_log = logging.getLogger("prbayes")

MAX_ROUNDS = 8
_THETAS = 256
AGREE = 0.1  # standard errors within which the optima of two independent designs are to be
_RATE = 0.65  # the power of its size with which the error of a design of several inputs falls, about


class DesignError(RuntimeError):
    """A design that cannot support the answer, even after refinement."""


def shortcomings(evaluator: Evaluator, thetas: Floats) -> dict[str, str]:
    """Say, by simulator, in what its design does not support the populations at thetas, shape (P, d)."""
    designs = evaluator.designs
    found = {
        name: shortcoming(support, designs[name].required_ess, designs[name].config.max_lost, designs[name].n_points)
        for name, support in evaluator.support(thetas).items()
    }
    return {name: what for name, what in found.items() if what}


def shortcoming(support: dict[str, Floats], need: float, max_lost: float, n_points: int) -> str:
    """Say in what a design with such support, arrays of shape (P,), falls short; nothing where it does not."""
    ess, mass, lost = (support[key] for key in ("weight_ess", "mean_weight", "lost_mass"))
    low, middle = np.quantile(ess, [0.05, 0.5])
    mass_low, mass_high = np.quantile(mass, [0.05, 0.95])
    most_lost = float(np.quantile(lost, 0.95))
    if most_lost > max_lost:
        return (
            f"lost mass: {most_lost:.1%} of a population's weight is on points whose response is NaN, expected at "
            f"most max_lost = {max_lost:.1%}"
        )
    complaints = []
    if middle < need or low < need / 10:
        complaints.append(
            f"weight effective sample size {low:.0f} (5% quantile) and {middle:.0f} (median) of {n_points} "
            f"points, expected {need / 10:.0f} and {need:.0f}"
        )
    if mass_low < 0.8 or mass_high > 1.25:
        complaints.append(f"mean raw weight from {mass_low:.2f} to {mass_high:.2f}, expected within 0.8 to 1.25")
    return ", and ".join(complaints)


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
        if node.name in names and isinstance(node.bound, Design):
            first, now = node.bound.config.n, node.bound.n_points
            batches = max(1, round((factor - 1) * now / first))
            size = min(batches * first, node.bound.max_points - now)
            if size > 0:
                node.bound.add(evaluator.roots(thetas, k), size)
                added = True
                _log.info("%s: refined to %d responses", node.name, node.bound.n_points)
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
        _add(evaluator, best, {name for name in thin if evaluator.designs[name].batches <= MAX_ROUNDS})
        noise = sum(Information(evaluator, k, best[0], scale, n_sets=50).noise_floor / s for k, s in enumerate(scales))
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


def refine(model: pm.Model | None = None, thetas: Floats | None = None) -> dict[str, int]:
    """Add design points where the posterior's populations live, until the designs support them.

    `minimize` and `sample_smc` call it; call it yourself before `pymc.sample` on models with several
    aleatory inputs or wide priors.

    Parameters
    ----------
    model : pymc.Model, optional
        The one on the context by default.
    thetas : ndarray, shape (P, d), optional
        Unconstrained hyperparameters whose populations matter; by default those around the optimum.

    Returns
    -------
    dict
        The number of stored responses by simulator.

    Raises
    ------
    DesignError
        If a design does not support them after eight more batches, or at ``max_points``.

    References
    ----------
    .. [1] Owen, A. and Y. Zhou (2000), Safe and effective importance sampling, J. Am. Stat. Assoc. 95, 135-143.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu"), 1.0)
    ...     y = prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=[0.5, 1.0, 4.0])
    >>> prb.refine(model)
    {'y': 1024}
    """
    from prbayes.optimize import minimize

    model = model_on_context(model, "prb.refine")
    evaluator = Evaluator(model)
    if thetas is None:
        minimize(model)
    else:
        for _ in range(MAX_ROUNDS):
            if not refine_at(evaluator, np.asarray(thetas, dtype=np.float64)):
                break
        refuse(shortcomings(evaluator, thetas), evaluator)
    return {name: design.n_points for name, design in evaluator.designs.items()}
