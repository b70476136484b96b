"""Cross-validation of a discrepancy, and scores of specimens left out: `cross_validate`."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from prbayes._progress import shown
from prbayes._validate import Floats, Seed, positive_integer, seed_number
from prbayes.inference.resampling import DataSets, specimens
from prbayes.metrics.base import Discrepancy
from prbayes.model.emulated import PopulationSimulator
from prbayes.model.evaluator import Evaluator
from prbayes.model.labels import versions
from prbayes.model.locking import in_turn
from prbayes.optimize.optimum import Optimum, require_refits
from prbayes.optimize.specimen_refits import is_specimen_optimum, specimen_refits
from prbayes.validation.scores import Scoring

_ADVICE = ", so that the model cannot be calibrated anew"
# Parts by default: four in five calibrate.
_FOLDS = 5


@in_turn
def cross_validate(
    optimum: Optimum,
    *,
    folds: int | None = None,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> xr.Dataset:
    """Calibrate on parts of the specimens, and return the discrepancy of those left out.

    In place of LOO and WAIC, which do not apply to a discrepancy: it is one value for all specimens
    together. The smaller the mean, the better the family of populations predicts other specimens.
    Only discrepancies of the same metric, data and folds are to be compared: between families,
    responses or inputs, not between metrics. Minimisations start at the optimum and, with
    `Reweighted`, compute no response.

    Each specimen left out has a score as well, by which `prb.rank` tells
    which of several models predicts better, and whether the data can tell.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`, without the prior.
    folds : int, optional
        Number of parts, five by default, or half as many as there are specimens; these are dealt
        out at random, those with the same label together.
    random_seed : int, sequence of int, numpy.random.Generator or None
        Models with as many specimens have the same folds with the same seed.
    progressbar : bool
        Whether work of more than two seconds shows a bar on stderr.

    Returns
    -------
    xarray.Dataset
        Dims (fold, simulator): ``discrepancy`` of the specimens left out, ``calibrated`` of the
        others, in units of the metric, of the log-likelihood by specimen minus its mean over the
        specimens; ``n_held_out``; and ``converged`` by fold. Where a fold has
        no observation of a simulator its discrepancy is NaN. Dim (specimen), in the order of the
        observations: ``score``, the log density of what was left out under the population of the
        others, whatever the metric, of which a hundredth is spread widely over the data; and
        ``weight``, how many observations the specimen counts for. A specimen that several
        simulators have seen has the sum of its scores; of several outputs a score is the mean over
        directions, as in `Joint`. Scores are NaN where the data have no density.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, there are fewer specimens than two per fold, or nothing
        is known of a metric or propagation (`FunctionMetric`, `Fresh`); if the prior was part of
        the optimum, or its model has changed since.

    References
    ----------
    .. [1] Geisser, S. (1975), The predictive sample reuse method with applications, J. Am. Stat.
       Assoc. 70, 320-328, doi:10.1080/01621459.1975.10479865.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> data = np.random.default_rng(1).normal(1.0, 0.5, 40)
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
    ...     y = prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=data)
    >>> found = prb.cross_validate(prb.minimize(model))
    >>> found.discrepancy.dims, bool((found.discrepancy > found.calibrated).mean() > 0.5)
    (('fold', 'simulator'), True)
    """
    by_specimen = is_specimen_optimum(optimum)
    evaluator = _refitted(optimum).evaluator
    folds = most_folds(optimum, _FOLDS) if folds is None else folds
    folds = positive_integer(folds, "folds", minimum=2)
    seed = seed_number(random_seed)
    parts = _Folds.dealt(evaluator.simulators, folds, seed)

    # Calibrate on the others of each fold.
    with shown(progressbar):
        if by_specimen:
            refits = specimen_refits(optimum, "cross_validate")
            thetas, converged = refits.reweighted(parts.kept)
        else:
            observed = [node.target.observed for node in evaluator.nodes]
            sampling = optimum.sampling()
            x, converged = sampling.refit(DataSets(observed, parts.kept))
            thetas = sampling.thetas(x)

    # Compare what was found with both parts.
    compare = _mean_log_losses if by_specimen else _discrepancies
    left_out = compare(evaluator, thetas, parts.left_out)
    calibrated = compare(evaluator, thetas, parts.kept)
    scores, weights = _scores(evaluator, thetas, parts.left_out)

    where = ["fold", "simulator"]
    return xr.Dataset(
        {
            "discrepancy": (where, left_out),
            "calibrated": (where, calibrated),
            "n_held_out": (where, parts.sizes),
            "converged": ("fold", converged),
            "score": ("specimen", scores),
            "weight": ("specimen", weights),
            "data": ("simulator", [_digest(each) for each in evaluator.simulators]),
        },
        coords={
            "fold": np.arange(folds),
            "simulator": [simulator.name for simulator in evaluator.simulators],
        },
        attrs={"random_seed": str(seed), **versions()},
    )


def most_folds(optimum: Optimum, wanted: int) -> int:
    """Return how many folds there are of a wanted number, each of two specimens at least."""
    _, total = specimens(_refitted(optimum).evaluator.simulators)
    return max(2, min(wanted, total // 2))


def _refitted(optimum: Optimum) -> Optimum:
    """Return an optimum whose model can be calibrated to parts of the specimens, or raise."""
    if is_specimen_optimum(optimum):
        specimen_refits(optimum, "cross_validate")
        return optimum
    return require_refits(optimum, "cross_validate", _ADVICE)


@dataclass(frozen=True, eq=False)
class _Folds:
    """The parts of the specimens, as weights of the observations."""

    # (folds, n_k): by simulator: weights of the observations of a fold, and of the others; those
    # kept sum to one.
    left_out: list[Floats]
    kept: list[Floats]
    sizes: NDArray[np.intp]  # (folds, simulators): observations left out

    @classmethod
    def dealt(cls, nodes: Sequence[PopulationSimulator], folds: int, random_seed: int) -> _Folds:
        """Deal specimens out at random, those with the same label together."""
        numbers, total = specimens(nodes)
        if total < 2 * folds:
            raise ValueError(
                f"folds: got {folds} for {total} specimens, expected at most {total // 2}"
            )
        # The number sets these random numbers apart from others with the same seed; any does.
        rng = np.random.default_rng([random_seed, 3])
        fold_of = rng.permutation(np.arange(total) % folds)
        left_out = []
        kept = []
        sizes = []
        few = []
        for node, number in zip(nodes, numbers, strict=True):
            weights = node.weights
            out = fold_of[number] == np.arange(folds)[:, None]
            others = np.where(out, 0.0, weights)
            left = (others > 0).sum(axis=1)
            if (left < 2).any():
                few.append(node.name)
            left_out.append(np.where(out, weights, 0.0))
            kept.append(others)
            sizes.append(out.sum(axis=1))
        if few:
            raise ValueError(
                f"folds: got {folds}, with fewer than 2 observations of {few} in the others, "
                "expected fewer"
            )
        kept = [w / w.sum(axis=1, keepdims=True) for w in kept]
        return cls(left_out, kept, np.array(sizes).T)


def _discrepancies(evaluator: Evaluator, thetas: Floats, data: list[Floats]) -> Floats:
    """Return discrepancies of populations from weighted data.

    Parameters
    ----------
    evaluator : Evaluator
    thetas : ndarray, shape (folds, d)
    data : list of ndarray, shapes (folds, n_k)
        By simulator: weights of the observations.

    Returns
    -------
    ndarray, shape (folds, simulators)
    """
    columns = []
    for k, node in enumerate(evaluator.nodes):
        values, weights = evaluator.populations(thetas, k)
        column = []
        for i in range(len(thetas)):
            one = slice(i, i + 1)
            found = _discrepancy(node.target, data[k][i], values[one], weights[one])
            column.append(found)
        columns.append(column)
    return np.array(columns).T


def _mean_log_losses(evaluator: Evaluator, thetas: Floats, data: list[Floats]) -> Floats:
    """Return minus the mean log-likelihood of weighted specimens, (folds, simulators).

    Arguments are those of `_discrepancies`.
    """
    by_name = evaluator.specimen_log_likelihoods(thetas)
    columns = []
    for simulator, weights in zip(evaluator.emulated, data, strict=True):
        likelihood, measurement = simulator.likelihood, simulator.measurement
        numbers = likelihood.numbers(measurement)
        specimens = numbers[simulator.rows]
        weights = weights / np.bincount(numbers)[specimens]  # a specimen counts once
        logs = by_name[likelihood.measurements[-1].name][:, specimens]
        own = measurement.weights
        if own is not None:
            logs = logs / np.where(own > 0, own, 1.0)[simulator.rows]
        total = weights.sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            columns.append(-np.where(weights > 0, weights * logs, 0.0).sum(axis=1) / total)
    return np.array(columns).T


def _scores(evaluator: Evaluator, thetas: Floats, data: list[Floats]) -> tuple[Floats, Floats]:
    """Return score and weight of each specimen, (specimens,), under the population of the others.

    Arguments are those of `_discrepancies`.
    """
    numbers, total = specimens(evaluator.simulators)
    scores = np.zeros(total)
    counted = np.zeros(total)
    for k, simulator in enumerate(evaluator.simulators):
        weights = simulator.weights
        counted += np.bincount(numbers[k], weights * weights.size, total)
        own = _observation_scores(evaluator, thetas, data[k], k)
        scores += np.bincount(numbers[k], own, total)
    return scores, counted


def _observation_scores(evaluator: Evaluator, thetas: Floats, data: Floats, k: int) -> Floats:
    """Return the scores of the k-th simulator's observations, (n_k,); NaN without a density."""
    simulator = evaluator.simulators[k]
    scores = np.zeros(len(simulator.observed))
    try:
        scoring = Scoring.of(simulator.observed, simulator.weights)
    except ValueError:  # as where all observations are equal
        return np.full(scores.shape, np.nan)
    values, weights = evaluator.populations(thetas, k)
    for i, left_out in enumerate(data):
        rows = np.flatnonzero(left_out)
        scores[rows] = scoring.scores(values[i], weights[i], rows)
    return scores


def _digest(simulator: PopulationSimulator) -> str:
    """Return what observed values, weights and labels of a simulator are known by, in order."""
    labels = [] if simulator.specimens is None else simulator.specimens.tolist()
    content = simulator.observed.tobytes() + simulator.weights.tobytes() + repr(labels).encode()
    return hashlib.sha256(content).hexdigest()[:16]


def _discrepancy(target: Discrepancy, data: Floats, values: Floats, weights: Floats) -> float:
    """Return the discrepancy of a population from weighted data, or NaN if there are none.

    Parameters
    ----------
    target : Discrepancy
        Of all observations.
    data : ndarray, shape (n,)
        Weights of the observations.
    values, weights : ndarray, shape (1, m)
        The population.
    """
    total = data.sum()
    if not total > 0:
        return np.nan
    other = target.with_observed(target.observed, data / total)
    return float(other.of(values, weights)[0])
