"""Refinement of the designs of `Reweighted`: more points where the populations that matter live."""

from __future__ import annotations

import logging

import numpy as np
import pymc as pm

from prbayes._arrays import Floats
from prbayes.design import Design
from prbayes.inputs import event_shape
from prbayes.population import Evaluator

_log = logging.getLogger("prbayes")

_MAX_ROUNDS = 8
_THETAS = 256


class DesignError(RuntimeError):
    """A design that cannot support the answer, even after refinement."""


def required_ess(design: Design) -> float:
    """Return the weight effective sample size that keeps design error well below sampling error.

    Stratified points of one input integrate with an error that falls like 1/n, of several like n^(-3/4);
    the size follows from asking that error to be a fraction of 1/sqrt(N).
    """
    inputs = sum(int(np.prod(event_shape(x), dtype=int)) for x in design.inputs.aleatory)
    root = np.sqrt(design.target.n_effective)
    return float(max(50.0, 6 * root) if inputs == 1 else max(100.0, (15 * root) ** (4 / 3)))


def shortcomings(evaluator: Evaluator, thetas: Floats) -> dict[str, str]:
    """Say, by simulator, in what its design does not support the populations at thetas, shape (P, d)."""
    found = {}
    for name, support in evaluator.support(thetas).items():
        ess, mass, lost = (support[key] for key in ("weight_ess", "mean_weight", "lost_mass"))
        design = evaluator.designs[name]
        low, need = float(np.quantile(ess, 0.05)), required_ess(design)
        mass_low, mass_high = np.quantile(mass, [0.05, 0.95])
        most_lost = float(np.quantile(lost, 0.95))
        if most_lost > design.config.max_lost:
            found[name] = (
                f"lost mass: {most_lost:.1%} of a population's weight is on points whose response is NaN, expected at "
                f"most max_lost = {design.config.max_lost:.1%}"
            )
        elif low < need:
            found[name] = f"weight effective sample size {low:.0f} of {design.n_points} points, expected {need:.0f}"
        elif mass_low < 0.8 or mass_high > 1.25:
            found[name] = f"mean raw weight from {mass_low:.2f} to {mass_high:.2f}, expected within 0.8 to 1.25"
    return found


def refine_at(evaluator: Evaluator, thetas: Floats) -> dict[str, str]:
    """Add one batch to each design that falls short at thetas, shape (P, d); return what was short."""
    short = shortcomings(evaluator, thetas)
    for k, node in enumerate(evaluator.nodes):
        if node.name in short and isinstance(node.bound, Design):
            if short[node.name].startswith("lost mass"):
                raise DesignError(
                    f"{node.name}: {short[node.name]}; repair the response there, return +inf for specimens that "
                    "fail, narrow the priors, or raise max_lost"
                )
            node.bound.add(evaluator.roots(thetas, k))
            _log.info("%s: %s; refined to %d responses", node.name, short[node.name], node.bound.n_points)
    return short


def refuse(short: dict[str, str], evaluator: Evaluator) -> None:
    """Raise for designs that still fall short."""
    if short:
        first = next(iter(short))
        points = evaluator.designs[first].n_points
        raise DesignError(
            "; ".join(f"{name}: the design does not support the answer: {what}" for name, what in short.items())
            + f"; narrow the priors, pass a larger prb.Reweighted(n) (now {points} points in all), or use "
            "prb.Resimulated(n), which has no design"
        )


def spread_around(center: Floats, covariance: Floats, scale: Floats, *, size: int = _THETAS, seed: int = 0) -> Floats:
    """Return thetas around an optimum, from a normal with four times the covariance, at most the prior's scale."""
    values, vectors = np.linalg.eigh(np.nan_to_num(covariance, posinf=0.0) / np.outer(scale, scale))
    blind = ~np.isfinite(covariance).all()
    sd = np.ones_like(values) if blind else 2 * np.sqrt(np.clip(values, 0, 1))
    z = np.random.default_rng(seed).standard_normal((size, center.size))
    return np.asarray(center + (z * sd) @ vectors.T * scale)


def refine(model: pm.Model, thetas: Floats | None = None) -> dict[str, int]:
    """Add design points where the posterior's populations live, until the designs support them.

    `minimize` and `sample_smc` call it; call it yourself before `pymc.sample` on models with several
    aleatory inputs or wide priors.

    Parameters
    ----------
    model : pymc.Model
    thetas : ndarray, shape (P, d), optional
        Unconstrained hyperparameters whose populations matter; by default those around the optimum.

    Returns
    -------
    dict
        The number of stored responses by simulator.

    Raises
    ------
    DesignError
        If a design does not support them after eight more batches.

    References
    ----------
    .. [1] A. Owen and Y. Zhou (2000), Safe and effective importance sampling, J. Am. Stat. Assoc. 95, 135-143.

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

    evaluator = Evaluator(model)
    if thetas is None:
        minimize(model)
    else:
        for _ in range(_MAX_ROUNDS):
            if not refine_at(evaluator, np.asarray(thetas, dtype=np.float64)):
                break
        refuse(shortcomings(evaluator, thetas), evaluator)
    return {name: design.n_points for name, design in evaluator.designs.items()}
