"""Probability that a response exceeds a limit; if rare, by cross-entropy importance sampling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from scipy.special import logsumexp

from prbayes._finding import Finding, report
from prbayes._validate import (
    AT_ONCE,
    Floats,
    Seed,
    executes,
    finite_number,
    flag,
    positive_integer,
    seed_number,
    share,
)
from prbayes.decision.populations import (
    InverseTransform,
    Populations,
    ResponseSample,
    output_column,
)
from prbayes.decision.quantities import Exceedance, interval_grid, interval_values
from prbayes.model.locking import locked
from prbayes.model.random_variable import response_name
from prbayes.optimize.optimum import Optimum
from prbayes.propagation.base import MAX_LOST, N_BLOCKS, DesignError
from prbayes.response.response import Responses, refuse_uncallable


@locked
def exceedance(
    result: Optimum | xr.DataTree,
    response: Callable[..., Any],
    limit: float,
    *inputs: Any,
    model: pm.Model | None = None,
    output: Any = None,
    below: bool = False,
    prob: float = 0.89,
    requirement: float | None = None,
    n_draws: int = 2000,
    points: int = 0,
    steps: int = 5,
    executor: Executor | None = None,
    random_seed: Seed = 0,
) -> xr.Dataset:
    """Return the probability that a response is above a limit, with its interval.

    Each draw of the posterior is a population with its probability; the mean over draws is the
    probability of a new specimen. By default it comes from stored responses, whose number limits
    how small a probability they resolve. With ``points``, importance sampling computes that many
    responses near the limit, for all populations together: probabilities of one in a thousand to
    one in a million then have an error of some percent.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`, with its sampling distribution; or with a ``posterior`` group, from any
        sampler.
    response : callable
        As for `predict`; +inf is a specimen that failed, which is above every limit.
    limit : float
        In units of the response.
    *inputs
        As for `predict`. A ``prb.decision.Interval`` among them is a constant known only to lie
        between two ends: the probability then has bounds.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    output : label, optional
        Which output, where a run of the response gives several.
    below : bool
        Whether to look below the limit.
    prob : float
        Probability of the interval.
    requirement : float, optional
        Largest acceptable probability. It is met if the whole interval is below it, not met if the
        whole interval is above it, and else not decided.
    n_draws : int
        Largest number of populations, over all chains; the posterior's draws are thinned evenly.
    points : int
        Number of responses to compute near the limit, for each point of the intervals; 0, or at
        least 100. The inputs need inverse distribution functions, and no stored responses.
    steps : int
        Number of values in each interval, its ends included; at least 2.
    executor : concurrent.futures.Executor, optional
        Where the response is computed.
    random_seed : int, sequence of int, numpy.random.Generator or None

    Returns
    -------
    xarray.Dataset
        ``probability`` of a new specimen; ``lower`` and ``upper``, the equal-tailed interval of
        the populations' probabilities; ``error``, the standard error of ``probability`` from the
        points, the emulator and the draws; ``by_draw``, with dimension ``draw``. With intervals
        ``probability``, ``error`` and ``by_draw`` have the dimension ``bound``, "lower" and
        "upper"; ``lower`` and ``upper`` are the extremes over all points of the intervals, and the
        attribute ``at`` has the points of the bounds.
        Attributes: ``prob``, ``responses`` (number computed), ``source``, ``identity``, and with a
        requirement ``requirement`` and ``verdict``: "met", "not met" or "not decided".

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, the result is another model's, or the inputs have no
        stored responses and there are no ``points``.
    DesignError
        If the design does not support the populations, or too many responses are NaN.
    ResponseError
        If the response raises, or has the wrong shape.

    Notes
    -----
    The error from stored responses is the jackknife over eight blocks of them. It is rather too
    large for one input, whose points divide the population into parts of equal mass. Extremes
    inside an interval are found among ``steps`` values only. The result of the calibration is the
    same at all of them: vary a constant that the calibration also used there.

    References
    ----------
    .. [1] Owen, A. B. and Y. Zhou (2000), Safe and effective importance sampling, J. Am. Stat.
       Assoc. 95, 135-143, doi:10.1080/01621459.2000.10473909.
    .. [2] Ferson, S. and L. R. Ginzburg (1996), Different methods are needed to propagate ignorance
       and variability, Reliab. Eng. Syst. Saf. 54, 133-144, doi:10.1016/S0951-8320(96)00071-3.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     data = np.random.default_rng(1).normal(0, 1, 50)
    ...     y = prb.Simulator("y", lambda x: x, x, metric=prb.AreaMetric(), observed=data)
    >>> optimum = prb.minimize(model)
    >>> often = prb.exceedance(optimum, np.sinh, 1.0, x)
    >>> rarely = prb.exceedance(optimum, np.sinh, 50.0, x, points=1000)
    >>> bool(rarely.error < 0.15 * rarely.probability), rarely.attrs["responses"]
    (True, 1000)
    """
    caller = "prb.exceedance"
    refuse_uncallable(caller, response)
    limit = finite_number(limit, "limit")
    flag(below, "below")
    prob = share(prob, "prob")
    if requirement is not None:
        requirement = share(requirement, "requirement")
    positive_integer(n_draws, "n_draws", minimum=2)
    positive_integer(points, "points", minimum=0)
    if 0 < points < 100:  # a tenth of them is a step towards the limit
        raise ValueError(f"points: got {points}, expected 0, or at least 100")
    positive_integer(steps, "steps", minimum=2)
    executes(executor, "executor")
    seed = seed_number(random_seed)
    populations = Populations.of(result, model, n_draws, caller)
    grid = interval_grid(inputs, steps)
    estimates = []
    for place in grid:
        quantity = Exceedance(response, *place, limit=limit, below=below, output=output)
        if points:
            responses = populations.responses(response, place, executor=executor)
            estimates.append(_rare_probability(populations, responses, quantity, points, seed))
        else:
            sample = populations.sample(response, place, output, executor=executor)
            estimates.append(_stored_probability(sample, quantity))
    by_draw = np.array([estimate.by_draw for estimate in estimates])
    low, high = np.quantile(by_draw, [(1 - prob) / 2, (1 + prob) / 2], axis=1)
    means = by_draw.mean(axis=1)
    errors = np.array([estimate.error for estimate in estimates])
    bounds = [int(means.argmin()), int(means.argmax())]
    _warn_of_large_error(response, means[bounds], errors[bounds], points)
    table = xr.Dataset(
        {
            "probability": ("bound", means[bounds]),
            "error": ("bound", errors[bounds]),
            "by_draw": (["bound", "draw"], by_draw[bounds]),
            "lower": low.min(),
            "upper": high.max(),
        },
        coords={"bound": ["lower", "upper"]},
        attrs={
            "prob": prob,
            "limit": limit,
            "below": int(below),
            "responses": sum(estimate.responses for estimate in estimates),
            "source": estimates[0].source,
            "random_seed": str(seed),
            **populations.provenance(),
        },
    )
    if len(grid) == 1:
        table = table.isel(bound=0, drop=True)
    else:
        table.attrs["at"] = [interval_values(inputs, grid[bound]) for bound in bounds]
    if requirement is not None:
        table.attrs |= {"requirement": requirement, "verdict": _verdict(table, requirement)}
    return table


def _verdict(table: xr.Dataset, requirement: float) -> str:
    """Return whether a requirement is met by the whole interval, by none of it, or by a part."""
    if table["upper"] <= requirement:
        return "met"
    return "not met" if table["lower"] > requirement else "not decided"


@dataclass(frozen=True, eq=False)
class _Estimate:
    """Probabilities at one point of the intervals."""

    by_draw: Floats  # (k,)
    error: float
    responses: int  # computed
    source: str


def _stored_probability(sample: ResponseSample, quantity: Exceedance) -> _Estimate:
    """Return the probabilities of each population from stored or emulated responses."""
    by_draw = sample.evaluate(quantity, sample.populations.thetas)
    by_draw = by_draw[np.isfinite(by_draw)]
    errors = [
        _jackknife_error(sample, quantity),
        _emulator_error(sample, quantity),
        _error_of_draws(sample.populations, by_draw),
    ]
    kind = "stored" if sample.emulator is None else "emulated"
    source = f"{kind} responses of {sample.populations.evaluator.simulators[sample.k].name}"
    return _Estimate(by_draw, float(np.linalg.norm(errors)), sample.responses.count, source)


def _rare_probability(
    populations: Populations, responses: Responses, quantity: Exceedance, points: int, seed: int
) -> _Estimate:
    """Return the probabilities of each population by importance sampling near the limit."""
    if responses.inputs.epistemic:
        raise TypeError(
            f"prb.exceedance: {responses.name}: got a model variable as an input, expected "
            ".dist() objects and constants; take the .dist() objects of the model, or "
            "prb.decision.Interval"
        )
    evaluator = populations.evaluator
    values = evaluator.hyperparameters.constrained(populations.thetas)
    center = evaluator.hyperparameters.constrained(populations.center[None])
    names = [str(rv.name) for rv in responses.inputs.parents]
    transform = InverseTransform(responses.name, responses.inputs, [center[name] for name in names])
    sign = -1.0 if quantity.below else 1.0

    def respond(z: Floats) -> Floats:
        outputs = transform.responses(responses, z)
        column = output_column(responses, outputs, quantity.output)
        return sign * (outputs if column is None else outputs[:, column])

    rng = np.random.default_rng(seed)
    parents = [values[name] for name in names]
    event = rare_event(transform, parents, respond, sign * quantity.limit, points, rng)
    if event.lost > MAX_LOST:
        raise DesignError(
            f"{responses.name}: lost mass: got {event.lost:.1%} of a population's weight on "
            f"points whose response is NaN, expected at most {MAX_LOST:.0%}; repair it, or "
            "return +inf for specimens that fail"
        )
    error = np.hypot(event.error, _error_of_draws(populations, event.by_draw))
    return _Estimate(event.by_draw, float(error), responses.count, "importance points")


def _error_of_draws(populations: Populations, by_draw: Floats) -> float:
    """Return the Monte Carlo error of the mean over draws of the posterior, as if independent."""
    return float(by_draw.std(ddof=1) / np.sqrt(by_draw.size)) if populations.are_draws else 0.0


def _jackknife_error(sample: ResponseSample, quantity: Exceedance) -> float:
    """Return the error of the mean probability, by the jackknife over blocks of the points."""
    is_beyond = quantity.of_specimen(sample.values, np.nan)
    weights = sample.mean_weights()
    if not (weights * is_beyond).any():
        return float(weights.max())  # the contribution of a single point
    without = []
    for block in range(N_BLOCKS):
        rest = weights * (sample.blocks != block)
        without.append(rest @ is_beyond / rest.sum())
    return float(np.sqrt((N_BLOCKS - 1) * np.var(without)))


def _emulator_error(sample: ResponseSample, quantity: Exceedance) -> float:
    """Return the error of the mean probability, by emulators without a block of the runs each."""
    outputs = sample.emulated(sample.points)
    if not outputs:
        return 0.0
    thetas = sample.populations.thinned()
    _, weights = sample.design.populations(sample.populations.evaluator.parents(thetas, sample.k))
    mass = np.nanmean(weights, axis=0)
    means = [mass @ quantity.of_specimen(values, np.nan) for values in outputs]
    return float(np.sqrt(np.sum((np.array(means[1:]) - means[0]) ** 2)))


def _warn_of_large_error(response: Any, means: Floats, errors: Floats, points: int) -> None:
    """Warn where two standard errors are a factor of two of the probability, about."""
    excess = errors - 0.3 * means
    if not (excess > 0).any():
        return
    worst = int(np.argmax(excess))
    more = f"more than points={points}" if points else "points=1000, which computes as many"
    report(
        Finding(
            "rough-probability",
            f"{response_name(response)}: a probability of {means[worst]:.2g} has a standard error "
            f"of {errors[worst]:.2g}; pass {more} responses where the limit is exceeded.",
        )
    )


@dataclass(frozen=True, eq=False)
class RareEvent:
    """Probabilities of an event in each population, and the error of their mean."""

    by_draw: Floats  # (k,)
    error: float  # standard error of their mean
    lost: float  # share of the populations' weight that has no response


@dataclass(frozen=True, eq=False)
class _Normal:
    """A normal proposal of z."""

    mean: Floats  # (D,)
    root: Floats  # (D, D): lower Cholesky factor of the covariance

    def draw(self, n: int, rng: np.random.Generator) -> Floats:
        """Return n draws, (n, D)."""
        z = rng.standard_normal((n, self.mean.size))
        return np.asarray(self.mean + z @ self.root.T)

    def log_density(self, z: Floats) -> Floats:
        """Return the log-density, (n, D) -> (n,)."""
        standard = np.linalg.solve(self.root, (z - self.mean).T).T
        return log_normal(standard) - float(np.log(np.diag(self.root)).sum())


@dataclass(frozen=True, eq=False)
class _Points:
    """Points from several proposals, with their responses."""

    sizes: list[int]  # number of points from each proposal
    proposals: list[_Normal]
    z: Floats  # (n, D)
    values: Floats  # (n,)
    log_ratio: Floats  # (k, n): of the density of each population to that of the central one

    def log_mixture(self) -> Floats:
        """Return the log-density of the mixture of all proposals at the points, (n,)."""
        sizes = np.array(self.sizes)
        logs = [proposal.log_density(self.z) for proposal in self.proposals]
        return np.asarray(logsumexp(logs, axis=0, b=sizes[:, None] / sizes.sum()))

    def log_weights(self) -> Floats:
        """Return the log importance weights for all populations together, (n,)."""
        pooled = logsumexp(self.log_ratio, axis=0)
        return np.asarray(pooled + log_normal(self.z) - self.log_mixture())


def rare_event(
    transform: InverseTransform,
    parents: Sequence[Floats],
    respond: Callable[[Floats], Floats],
    limit: float,
    size: int,
    rng: np.random.Generator,
) -> RareEvent:
    r"""Return the probability that a response is above a limit, in each of k populations.

    Points are standard normal numbers z behind the inputs of a central population
    :math:`\theta_*`. One half is drawn towards the limit step by step, by the cross-entropy method.
    The other half is drawn from the mixture q of the last proposals, and counts:

    .. math:: P_j = \frac{1}{n} \sum_i 1[y_i > c] \frac{p(x_i | \theta_j)}{p(x_i | \theta_*)}
        \frac{\phi(z_i)}{q(z_i)}

    ``transform`` is that of the central population, ``parents`` are those of the k populations,
    ``respond`` maps normal numbers (n, D) to responses (n,), and ``size`` is the number of these.

    References
    ----------
    .. [1] Rubinstein, R. Y. and D. P. Kroese (2004), The cross-entropy method, Springer,
       doi:10.1007/978-1-4757-4321-0.
    .. [2] Owen, A. B. and Y. Zhou (2000), Safe and effective importance sampling, J. Am. Stat.
       Assoc. 95, 135-143, doi:10.1080/01621459.2000.10473909.
    """
    d = transform.size
    # Wider than the population, which bounds the weights; less so in each of many dimensions.
    widest = _Normal(np.zeros(d), (1 + 0.5 / np.sqrt(d)) * np.eye(d))
    proposals = [widest]
    # A sixteenth of the points a step; more dimensions need more.
    step = max(size // 16, min(10 * d, size // 8), 1)
    batches: list[_Points] = []
    remaining = size // 2
    while remaining:
        n = min(step, remaining)
        batches.append(_draw_points(proposals, n, transform, parents, respond, rng))
        remaining -= n
        # The level that the highest fifth of responses exceeds, as is usual for the method.
        values = batches[-1].values[~np.isnan(batches[-1].values)]
        elite = float(np.quantile(values, 1 - 0.2, method="lower")) if values.size else limit
        level = min(elite, limit)
        proposals = _cross_entropy_proposals(_concatenated(batches), level, limit) or proposals
    search = _concatenated(batches)
    # The proposals do not depend on the final points, whose mean is unbiased. One point in ten
    # comes from the widest proposal, which bounds weights.
    copies = max(1, 9 // len(proposals))
    mixture = [proposal for proposal in proposals for _ in range(copies)] + [widest]
    final = _draw_points(mixture, size - size // 2, transform, parents, respond, rng)
    weights = np.exp(final.log_ratio + (log_normal(final.z) - final.log_mixture()))
    mean_weights = weights.mean(axis=0)
    is_beyond = ~np.isnan(final.values) & (final.values > limit)
    terms = np.where(is_beyond, mean_weights, 0.0)
    error = terms.std(ddof=1) / np.sqrt(len(terms))
    if not is_beyond.any():
        error = mean_weights.max() / len(terms)  # the contribution of a single point
    log_weights = search.log_weights()
    shares = np.exp(log_weights - log_weights.max())
    return RareEvent(
        by_draw=np.where(is_beyond, weights, 0.0).mean(axis=1),
        error=float(error),
        lost=float(shares[np.isnan(search.values)].sum() / shares.sum()),
    )


def _draw_points(
    proposals: list[_Normal],
    n: int,
    transform: InverseTransform,
    parents: Sequence[Floats],
    respond: Callable[[Floats], Floats],
    rng: np.random.Generator,
) -> _Points:
    """Draw n points, in equal parts from each proposal, and compute their responses."""
    sizes = [len(part) for part in np.array_split(np.arange(n), len(proposals))]
    draws = [proposal.draw(size, rng) for proposal, size in zip(proposals, sizes, strict=True)]
    z = np.concatenate(draws)
    x = transform(z)
    central = transform.log_density(transform.parents, x)
    step = max(1, AT_ONCE // n)
    log_ratio = [
        transform.log_density([values[first : first + step] for values in parents], x) - central
        for first in range(0, len(parents[0]), step)
    ]
    return _Points(sizes, proposals, z, respond(z), np.concatenate(log_ratio))


def _concatenated(batches: Sequence[_Points]) -> _Points:
    """Return the points of all batches."""
    return _Points(
        sizes=[size for batch in batches for size in batch.sizes],
        proposals=[proposal for batch in batches for proposal in batch.proposals],
        z=np.concatenate([batch.z for batch in batches]),
        values=np.concatenate([batch.values for batch in batches]),
        log_ratio=np.concatenate([batch.log_ratio for batch in batches], axis=1),
    )


def _cross_entropy_proposals(points: _Points, level: float, limit: float) -> list[_Normal]:
    """Return the normal distribution nearest to the populations above a level, if any point is.

    Two of them if the points above spread wider than the population, as on both sides of it.
    """
    is_above = points.values >= level
    if not is_above.any():
        return []
    z = points.z[is_above]
    log_weights = points.log_weights()[is_above]
    weights = np.exp(log_weights - log_weights.max())
    total = weights.sum()
    # Variance towards the limit. Before the limit is reached, narrow proposals slow the search;
    # beyond four standard deviations a normal tail has a variance of .05.
    least = 0.1 if level >= limit else 1.0
    mean = weights @ z / total
    deviation = z - mean
    covariance = (deviation.T * weights) @ deviation / total
    variances, axes = np.linalg.eigh(covariance)
    error = np.sqrt(2 * (weights**2).sum()) / total  # of a variance of one
    # The largest of several variances is larger by chance (Marchenko and Pastur 1967).
    by_chance = (1 + np.sqrt(mean.size / 2) * error) ** 2
    if variances[-1] <= max(by_chance, 1 + 3 * error):
        return [_tail_normal(z, weights, least)]
    side = deviation @ axes[:, -1] > 0
    return [_tail_normal(z[part], weights[part], least) for part in (side, ~side)]


def _tail_normal(z: Floats, weights: Floats, least: float) -> _Normal:
    """Return a normal distribution with the mean of points, and their variance along it.

    Few points do not determine a covariance of several dimensions: across the mean it is isotropic.
    """
    total = weights.sum()
    mean = weights @ z / total
    direction = mean / max(float(np.linalg.norm(mean)), 1e-300)
    shares = weights / total
    deviation = z - mean
    whole = float(shares @ (deviation**2).sum(axis=1))
    along = float(shares @ (deviation @ direction) ** 2)
    # A fifth wider across, which bounds weights far out.
    across = 1.2 * max((whole - along) / max(mean.size - 1, 1), 1.0)
    outer = np.outer(direction, direction)
    covariance = across * (np.eye(mean.size) - outer) + max(along, least) * outer
    return _Normal(mean, np.linalg.cholesky(covariance))


def log_normal(z: Floats) -> Floats:
    """Return the log-density of independent standard normal numbers, (n, D) -> (n,)."""
    return np.asarray(-0.5 * (z**2).sum(axis=1) - 0.5 * z.shape[1] * np.log(2 * np.pi))
