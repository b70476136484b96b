"""What one more specimen under a condition tells of theta, and the posterior that follows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from prbayes._stats import reached
from prbayes._validate import Floats, called
from prbayes.decision.populations import Told
from prbayes.inference.measured import drawn_in
from prbayes.inference.refits import SamplingDistribution
from prbayes.inference.resampling import observable
from prbayes.metrics.base import Metric
from prbayes.numerics.derivatives import cross, slopes
from prbayes.response.response import refuse_uncallable

# Specimens of the ideal sample from which the information in one is told, or as many as there are:
# of fewer a metric's bandwidth or cells would be those of a small sample. By judgement.
_IDEAL = 50
# Standard error of an ideal sample, in spreads of the prior, up to which it tells of a direction:
# what it leaves out is less than a hundredth of what a prior tells.
_FAINTEST = 10.0
# Step of differences of log weights, in spreads of the prior: as those of densities elsewhere.
_LOG_WEIGHT_STEP = 1e-3
# Standard deviations beyond which draws count as so far away in their covariance, as refits do.
_WITHIN = 3.0


class Condition:
    """A condition under which specimens could be tested: a response, its inputs, and a metric.

    Parameters
    ----------
    response : callable
        As for `Simulator`: that of a simulator of the model, or another one of the same specimens.
    *inputs
        As for `predict`.
    metric : Metric, optional
        By which its data would be compared; that of the model's simulator by default.

    Raises
    ------
    TypeError
        If an argument is not as described.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> prb.decision.Condition(np.square, pm.Normal.dist(), metric=prb.AreaMetric())
    Condition of square
    """

    def __init__(
        self, response: Callable[..., Any], *inputs: Any, metric: Metric | None = None
    ) -> None:
        refuse_uncallable("prb.decision.Condition", response)
        if metric is not None and not isinstance(metric, Metric):
            raise TypeError(
                f"prb.decision.Condition: metric: got {called(metric)}, expected a metric, such as "
                "prb.ProbabilityResidual()"
            )
        self.response = response
        self.inputs = inputs
        self.metric = metric

    def __repr__(self) -> str:
        return f"Condition of {getattr(self.response, '__name__', type(self.response).__name__)}"


def of_a_specimen(told: Told, metric: Metric | None) -> Floats:
    r"""Return the information of one specimen, (d, d), in units of the prior's spread.

    The Godambe information :math:`H J^{-1} H` of an ideal sample of the population at the centre,
    divided by its size, and at most the Fisher information of the response. Of a simulator with the
    log-likelihood by specimen, the Fisher information itself.

    Parameters
    ----------
    told : Told
        The response under the condition.
    metric : Metric, optional
    """
    evaluator = told.populations.evaluator
    if not told.design.has_runs:
        if metric is not None:
            raise ValueError(
                f"prb.plan: {told.responses.name}: metric: got {metric!r} of a simulator with the "
                "log-likelihood by specimen, whose posterior takes all the information of the "
                "response; leave metric= out"
            )
        return fisher_information(told)
    node = evaluator.nodes[told.k]
    center = told.populations.center
    n = max(round(node.n_specimens), _IDEAL)
    sample = _ideal(told, n)
    target = (metric or node.metric).against(sample)
    design = told.design
    bound = design.telling(told.every, target.metric.beside(target, told.every, design.dimensions))
    alone = replace(node, target=bound.target, bound=bound, specimens=None)
    sampling = SamplingDistribution.of(
        evaluator.of_one(alone, told.k), center, np.ones(1), _FAINTEST
    )
    local = sampling.local
    if not local.identified.size:
        return np.zeros((center.size, center.size))
    found = local.identified @ np.linalg.inv(local.covariance) @ local.identified.T
    return _at_most(found / n, fisher_information(told))


def fisher_information(told: Told) -> Floats:
    r"""Return the Fisher information of one specimen, (d, d), in units of the prior's spread.

    The covariance of the score of a response, :math:`E[s(x) | y]`, which is the mean over bins of
    the response of that of the inputs, the derivative of their log weights. Of several outputs that
    of the inputs themselves, which bounds it.
    """
    evaluator = told.populations.evaluator
    center = told.populations.center
    unit = evaluator.prior_sd
    step = _LOG_WEIGHT_STEP * unit
    around = cross(center, step)
    _, weights = told.design.populations(evaluator.roots(around, told.k))
    if told.emulator is None:
        seen = observable(told.every, evaluator.nodes[told.k].target)
    else:
        seen = np.isfinite(told.every.reshape(len(told.every), -1)).all(axis=1)
    used = (weights[0] > 0) & seen
    weights = weights[:, used]
    with np.errstate(divide="ignore", invalid="ignore"):
        scores = slopes(np.log(weights), step) * unit
    mass = weights[0] / weights[0].sum()
    scores = scores - mass @ scores
    if told.every.ndim > 1:
        return np.asarray((scores.T * mass) @ scores)
    values = told.every[used]
    # As many bins as fine ones and full ones ask for; those in the tails have little weight.
    rank = np.searchsorted(np.sort(values), values)  # the same for equal values
    in_each = max(1, int(np.sqrt(len(mass)) / 2))
    bins = rank // in_each
    share = np.bincount(bins, mass)
    sums = np.array([np.bincount(bins, mass * column) for column in scores.T])
    means = sums / np.where(share > 0, share, 1.0)
    return np.asarray((means * share) @ means.T)


def _at_most(information: Floats, bound: Floats) -> Floats:
    """Return what is not more than a bound in any direction: matrices (d, d).

    Along directions of which the response tells next to nothing, both halves of a sandwich are
    rounding errors, and their quotient may be anything.
    """
    if not np.isfinite(bound).all():  # the support moves, and the likelihood is no bound
        return information
    d = len(bound)
    root = np.linalg.cholesky(bound + 1e-9 * np.trace(bound) * np.eye(d))
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ information @ inverse.T)
    capped = (vectors * np.minimum(values, 1.0)) @ vectors.T
    return np.asarray(root @ capped @ root.T)


def _ideal(told: Told, n: int) -> Floats:
    """Return n specimens at equal steps of probability of the population at the centre."""
    evaluator = told.populations.evaluator
    center = told.populations.center
    _, weights = told.design.populations(evaluator.roots(center[None], told.k))
    seen = observable(told.every, evaluator.nodes[told.k].target)
    values = told.every[seen]
    mass = weights[0][seen]
    first = values.reshape(len(values), -1)[:, 0]
    order = np.argsort(first)
    steps = (np.arange(n) + 0.5) / n
    places = reached(mass[order], steps, normalized=True)
    return np.asarray(values[order][places])


@dataclass(frozen=True, eq=False)
class Belief:
    """What is known of theta: draws, and the precision that they stand for.

    Attributes
    ----------
    thetas : ndarray, shape (k, d)
    unit : ndarray, shape (d,)
        The prior's spread.
    covariance : ndarray, shape (d, d)
        Of the draws, in that unit.
    """

    thetas: Floats
    unit: Floats
    covariance: Floats

    @classmethod
    def of(cls, thetas: Floats, unit: Floats) -> Belief:
        """Read draws, (k, d)."""
        counted = drawn_in(thetas / unit, _WITHIN)
        d = unit.size
        return cls(thetas, unit, np.cov(counted, rowvar=False).reshape(d, d))

    def after(self, information: Floats) -> Floats:
        """Return the draws, narrower by so much information, (d, d), around the same median.

        Their precision is then the sum, as that of normal distributions; the map is the symmetric
        one between those.
        """
        precision = np.linalg.inv(self.covariance) + information
        covariance = np.linalg.inv(precision)
        root = _root(self.covariance)
        inverse = np.linalg.inv(root)
        matrix = inverse @ _root(root @ covariance @ root) @ inverse
        middle = np.median(self.thetas, axis=0)
        away = (self.thetas - middle) / self.unit
        return np.asarray(middle + (away @ matrix.T) * self.unit)


def _root(matrix: Floats) -> Floats:
    """Return the symmetric square root."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
