"""Cross-validation: discrepancies and log scores of held-out specimens."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from prbayes._progress import shown
from prbayes._validate import Floats, Seed, positive_integer, seed_number
from prbayes.inference.refits import refit
from prbayes.inference.resampling import DataSets, specimens
from prbayes.model.description import versions
from prbayes.model.emulated import PopulationSimulator
from prbayes.model.evaluator import Evaluator, specimen_log_likelihoods
from prbayes.model.locking import locked
from prbayes.model.measurement import specimen_numbers
from prbayes.optimize.optimum import Optimum, require_refits
from prbayes.optimize.specimen_refits import is_specimen_optimum, specimen_refits
from prbayes.validation.scores import log_scores, scoring_target


@locked
def cross_validate(
    optimum: Optimum,
    *,
    folds: int | None = None,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> xr.Dataset:
    """Calibrate on parts of the specimens, and return the discrepancy of the held-out ones.

    LOO and WAIC do not apply to a discrepancy, which is one value for all specimens together. The
    smaller the mean, the better the family of populations predicts other specimens. Compare only
    discrepancies of the same metric, data and folds: between families, responses or inputs, not
    between metrics. Minimisations start at the optimum and, with `Reweighted`, compute no response.

    `prb.rank` compares several models by the scores of the specimens.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`, without the prior.
    folds : int, optional
        Number of parts, five by default, or half as many as there are specimens. Specimens are
        assigned at random; observations with the same label stay together.
    random_seed : int, sequence of int, numpy.random.Generator or None
        Models with as many specimens have the same folds with the same seed.
    progressbar : bool
        Whether work of more than two seconds shows a bar on stderr.

    Returns
    -------
    xarray.Dataset
        Dims (fold, simulator): ``discrepancy`` of the held-out specimens, ``calibrated`` of the
        other ones, in units of the metric (with the log-likelihood by specimen minus its mean over
        the specimens); ``n_held_out``; and ``converged`` by fold. The discrepancy is NaN if a fold
        has no observation of a simulator. Dim (specimen), in the order of the observations:
        ``score``, the log density under the population of the other folds, whatever the metric, of
        which a tenth is spread widely over the data; and ``weight``, the number of observations
        that the specimen counts for. The scores of several simulators add up; of several outputs a
        score is the mean over directions, as in `Joint`. Scores are NaN if the data have no
        density.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, there are fewer specimens than two per fold, or a metric
        or propagation does not allow refits (`FunctionMetric`, `Fresh`); if the prior was part of
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
    evaluator = _require_refits(optimum).evaluator
    folds = most_folds(optimum, 5) if folds is None else folds
    folds = positive_integer(folds, "folds", minimum=2)
    seed = seed_number(random_seed)
    held_out, kept, sizes = _folds(evaluator.simulators, folds, seed)
    with shown(progressbar):
        if by_specimen:
            thetas, converged = specimen_refits(optimum, "cross_validate").reweighted(kept)
        else:
            observed = [node.target.observed for node in evaluator.nodes]
            sampling = optimum.sampling()
            x, converged = refit(sampling, DataSets(observed, kept))
            thetas = sampling.thetas(x)
    losses = _mean_log_losses if by_specimen else _discrepancies
    scores, weights = _scores(evaluator, thetas, held_out)
    dims = ["fold", "simulator"]
    return xr.Dataset(
        {
            "discrepancy": (dims, losses(evaluator, thetas, held_out)),
            "calibrated": (dims, losses(evaluator, thetas, kept)),
            "n_held_out": (dims, sizes),
            "converged": ("fold", converged),
            "score": ("specimen", scores),
            "weight": ("specimen", weights),
            "data": ("simulator", [_digest(simulator) for simulator in evaluator.simulators]),
        },
        coords={
            "fold": np.arange(folds),
            "simulator": [simulator.name for simulator in evaluator.simulators],
        },
        attrs={"random_seed": str(seed), **versions()},
    )


def most_folds(optimum: Optimum, limit: int) -> int:
    """Return the largest number of folds of two specimens or more, at most a limit."""
    _, total = specimens(_require_refits(optimum).evaluator.simulators)
    return max(2, min(limit, total // 2))


def _require_refits(optimum: Optimum) -> Optimum:
    """Return an optimum whose model can be calibrated to parts of the specimens, or raise."""
    if is_specimen_optimum(optimum):
        specimen_refits(optimum, "cross_validate")
        return optimum
    return require_refits(optimum, "cross_validate", "; the model cannot be calibrated anew")


def _folds(
    simulators: Sequence[PopulationSimulator], folds: int, random_seed: int
) -> tuple[list[Floats], list[Floats], NDArray[np.intp]]:
    """Assign specimens to folds at random.

    Return weights of held-out observations and of the other ones, which sum to one, (folds, n_k) by
    simulator; and numbers of held-out observations, (folds, simulators).
    """
    numbers, total = specimens(simulators)
    if total < 2 * folds:
        raise ValueError(f"folds: got {folds} for {total} specimens, expected at most {total // 2}")
    # The 3 makes random numbers differ from others with the same seed.
    rng = np.random.default_rng([random_seed, 3])
    fold_of = rng.permutation(np.arange(total) % folds)
    held_out, kept, sizes, too_few = [], [], [], []
    for simulator, number in zip(simulators, numbers, strict=True):
        is_out = fold_of[number] == np.arange(folds)[:, None]
        rest = np.where(is_out, 0.0, simulator.weights)
        if ((rest > 0).sum(axis=1) < 2).any():
            too_few.append(simulator.name)
        held_out.append(np.where(is_out, simulator.weights, 0.0))
        kept.append(rest)
        sizes.append(is_out.sum(axis=1))
    if too_few:
        raise ValueError(
            f"folds: got {folds}, with fewer than 2 observations of {too_few} in the others, "
            "expected fewer"
        )
    return held_out, [w / w.sum(axis=1, keepdims=True) for w in kept], np.array(sizes).T


def _discrepancies(evaluator: Evaluator, thetas: Floats, data: list[Floats]) -> Floats:
    """Return discrepancies (folds, simulators) of populations at thetas, (folds, d).

    ``data`` has weights of the observations, (folds, n_k) by simulator; NaN if all are zero.
    """
    columns = []
    for k, (node, by_fold) in enumerate(zip(evaluator.nodes, data, strict=True)):
        values, weights = evaluator.populations(thetas, k)
        column = []
        for i, observation_weights in enumerate(by_fold):
            total = observation_weights.sum()
            if not total > 0:
                column.append(np.nan)
                continue
            target = node.target.with_observed(node.target.observed, observation_weights / total)
            column.append(float(target.of(values[i : i + 1], weights[i : i + 1])[0]))
        columns.append(column)
    return np.array(columns).T


def _mean_log_losses(evaluator: Evaluator, thetas: Floats, data: list[Floats]) -> Floats:
    """Return minus the mean log-likelihood of weighted specimens, (folds, simulators)."""
    by_name = specimen_log_likelihoods(evaluator, thetas)
    columns = []
    for simulator, weights in zip(evaluator.emulated, data, strict=True):
        likelihood, measurement = simulator.likelihood, simulator.measurement
        numbers = specimen_numbers(likelihood, measurement)
        rows = numbers[simulator.rows]
        weights = weights / np.bincount(numbers)[rows]  # a specimen counts once
        logs = by_name[likelihood.measurements[-1].name][:, rows]
        if measurement.weights is not None:
            factors = np.where(measurement.weights > 0, measurement.weights, 1.0)
            logs = logs / factors[simulator.rows]
        total = weights.sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            columns.append(-np.where(weights > 0, weights * logs, 0.0).sum(axis=1) / total)
    return np.array(columns).T


def _scores(evaluator: Evaluator, thetas: Floats, held_out: list[Floats]) -> tuple[Floats, Floats]:
    """Return scores and weights of the specimens, under populations at thetas, (folds, d)."""
    numbers, total = specimens(evaluator.simulators)
    scores, counts = np.zeros(total), np.zeros(total)
    for k, simulator in enumerate(evaluator.simulators):
        weights = simulator.weights
        counts += np.bincount(numbers[k], weights * weights.size, total)
        try:
            target = scoring_target(simulator.observed, weights)
        except ValueError:  # no density, for example because all observations are equal
            observation_scores = np.full(len(simulator.observed), np.nan)
        else:
            observation_scores = np.zeros(len(simulator.observed))
            values, masses = evaluator.populations(thetas, k)
            for i, fold in enumerate(held_out[k]):
                rows = np.flatnonzero(fold)
                observation_scores[rows] = log_scores(target, values[i], masses[i], rows)
        scores += np.bincount(numbers[k], observation_scores, total)
    return scores, counts


def _digest(simulator: PopulationSimulator) -> str:
    """Return a digest of observed values, weights and labels, in order."""
    labels = [] if simulator.specimens is None else simulator.specimens.tolist()
    content = simulator.observed.tobytes() + simulator.weights.tobytes() + repr(labels).encode()
    return hashlib.sha256(content).hexdigest()[:16]
