"""Which of several models of the same data predicts better, and whether the data can tell."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from scipy.stats import t as student

from prbayes._validate import Floats, Seed, called, flag, positive_integer, seed_number
from prbayes.optimize.optimum import Optimum
from prbayes.validation.cross_validation import cross_validate, most_folds

# Share of comparisons of candidates that predict alike in which one is said to be better.
_CLAIMED = 0.05
_EXAMPLE = "expected a mapping such as {'normal': optimum, 'lognormal': other}"
_CALLER = "rank"
# Of which nine in ten calibrate: nearly as many as there are.
_COMPARED_BY = 10


def rank(
    candidates: Mapping[str, Optimum | xr.Dataset],
    *,
    folds: int | None = None,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> xr.Dataset:
    """Say which of several models of the same data predicts new specimens better, and how surely.

    Models may differ in the family of an input, in its parameters, in the response or in the
    metric. Each is cross-validated by `cross_validate` with the same folds; every specimen has a
    score under the population that was calibrated without it, and candidates are compared specimen
    by specimen.

    Parameters
    ----------
    candidates : mapping
        By label an `Optimum`, from `minimize` without the prior, or what `cross_validate` returned
        for it. All are of the same observed values, weights and labels, in the same order.
    folds : int, optional
        Of each optimum: by default those of cross-validations among the candidates, which keep
        theirs and have to have the same; else ten, or half as many as there are specimens.
    random_seed : int, sequence of int, numpy.random.Generator or None
        By which specimens are dealt out; likewise.
    progressbar : bool
        Whether work of more than two seconds shows a bar on stderr.

    Returns
    -------
    xarray.Dataset
        Dim (candidate), the best first: ``score``, the expected log density of a new specimen;
        ``difference``, by how much the best is ahead over all specimens together, and ``stderr``,
        its standard error from the differences specimen by specimen; ``told_apart``, whether that
        is beyond chance; ``verdict``, the same as a sentence; and ``converged``, the share of folds
        whose minimisation did. Attribute ``verdict`` has all sentences.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, there are fewer than two candidates, they are of other
        data, folds or seeds, or one has no score of a specimen; and as `cross_validate`.

    Notes
    -----
    Of two candidates that predict alike one is said to be better in about 5% of data sets; of more
    than two, at most so often for any pair (Bonferroni). A difference is held against Student's t
    distribution with as many degrees of freedom as there are specimens less one. Scores are those
    of populations calibrated on all but one fold: slightly fewer data than there are. A candidate
    with more hyperparameters is not penalised, but by what it loses on specimens left out.

    The standard error does not see that folds share their calibrations, nor rare specimens that
    happen to be absent: of normal and lognormal candidates it is right to a quarter in most cases,
    and up to 1.7 times too small where the truth has a long tail (``benchmarks/families.py``).

    References
    ----------
    .. [1] Vehtari, A., A. Gelman and J. Gabry (2017), Practical Bayesian model evaluation using
       leave-one-out cross-validation and WAIC, Stat. Comput. 27, 1413-1432,
       doi:10.1007/s11222-016-9696-4.
    .. [2] Sivula, T. et al. (2025), Uncertainty in Bayesian leave-one-out cross-validation based
       model comparison, Bayesian Anal., doi:10.1214/25-BA1569.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> data = np.random.default_rng(1).lognormal(0.0, 0.8, 60)
    >>> optima = {}
    >>> for family in (pm.Normal, pm.LogNormal):
    ...     with pm.Model() as model:
    ...         x = family.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 2))
    ...         y = prb.Simulator("y", np.positive, x, metric=prb.KullbackLeibler(), observed=data)
    ...     optima[family.__name__] = prb.minimize(model)
    >>> table = prb.rank(optima)
    >>> table.candidate.values.tolist(), bool(table.told_apart[1])
    (['LogNormal', 'Normal'], True)
    """
    _refuse(candidates)
    if folds is not None:
        folds = positive_integer(folds, "folds", minimum=2)
    flag(progressbar, "progressbar")
    seed = seed_number(random_seed)
    known = [one.sizes["fold"] for one in candidates.values() if isinstance(one, xr.Dataset)]
    asked = folds or (known[0] if known else None)
    found = {}
    for label, candidate in candidates.items():
        if isinstance(candidate, Optimum):
            number = asked or most_folds(candidate, _COMPARED_BY)
            found[label] = cross_validate(
                candidate, folds=number, random_seed=seed, progressbar=progressbar
            )
        else:
            found[label] = candidate
    first, *others = found
    for label in others:
        _require_same(found[label], found[first], label, first)
    for label, one in found.items():
        _require_scores(one, label)
    return _table(found)


def _refuse(candidates: object) -> None:
    """Raise if these are no candidates."""
    if not isinstance(candidates, Mapping):
        raise TypeError(f"{_CALLER}: candidates: got {called(candidates)}, {_EXAMPLE}")
    if len(candidates) < 2:
        raise ValueError(
            f"{_CALLER}: candidates: got {list(candidates)}, expected at least two to compare"
        )
    for label, one in candidates.items():
        if not isinstance(label, str):
            raise TypeError(f"{_CALLER}: candidates: got label {label!r:.60}, expected a text")
        if isinstance(one, Optimum):
            continue
        if not isinstance(one, xr.Dataset) or not {"score", "weight", "data"} <= set(one):
            raise TypeError(
                f"{_CALLER}: candidates: {label}: got {called(one)}, expected an Optimum or what "
                "prb.cross_validate returned"
            )


def _require_same(one: xr.Dataset, other: xr.Dataset, label: str, first: str) -> None:
    """Raise unless two cross-validations are of the same data, folds and seed."""
    simulators = [each["simulator"].values.tolist() for each in (one, other)]
    if simulators[0] != simulators[1]:
        raise ValueError(
            f"{_CALLER}: got {label} with simulators {simulators[0]} and {first} with "
            f"{simulators[1]}, expected the same names in the same order"
        )
    same = one["data"].values == other["data"].values
    if not same.all():
        names = ", ".join(one["simulator"].values[~same].tolist())
        raise ValueError(
            f"{_CALLER}: got {label} and {first} with different observed values, weights or "
            f"labels of {names}, or in another order, expected the same data; build the models of "
            "one array"
        )
    for what, a, b in (
        ("folds", one.sizes["fold"], other.sizes["fold"]),
        ("random_seed", one.attrs["random_seed"], other.attrs["random_seed"]),
    ):
        if a != b:
            raise ValueError(
                f"{_CALLER}: got {label} with {what} {a} and {first} with {b}, expected the same; "
                "pass the optima, which are then cross-validated alike"
            )


def _require_scores(one: xr.Dataset, label: str) -> None:
    """Raise if a specimen has no score."""
    missing = int(np.isnan(one["score"].values).sum())
    if missing:
        raise ValueError(
            f"{_CALLER}: got {label} without a score of {missing} of {one.sizes['specimen']} "
            "specimens, expected one of each: the observed values have no density, as where all "
            "are equal, or the population of a fold has no response; compare the discrepancies of "
            "prb.cross_validate instead"
        )


def _table(found: Mapping[str, xr.Dataset]) -> xr.Dataset:
    """Return the candidates beside the best of them, in order."""
    labels = sorted(found, key=lambda label: -float(found[label]["score"].sum()))
    scores = np.array([found[label]["score"].values for label in labels])
    weights = found[labels[0]]["weight"].values
    differences = (scores[0] - scores).sum(axis=-1)
    errors = np.array([_stderr(scores[0] - own, weights) for own in scores])

    n = weights.size
    pairs = len(labels) * (len(labels) - 1) / 2
    beyond = student.ppf(1 - _CLAIMED / 2 / pairs, n - 1)
    apart = differences > beyond * errors
    sentences = [""]
    for i in range(1, len(labels)):
        names = labels[0], labels[i]
        told = _sentence(*names, differences[i], errors[i], apart=bool(apart[i]))
        sentences.append(told)
    variables: dict[str, Any] = {
        "score": scores.mean(axis=-1),
        "difference": differences,
        "stderr": errors,
        "told_apart": apart,
        "converged": [float(found[label]["converged"].mean()) for label in labels],
        "verdict": np.array(sentences),
    }
    by_candidate = {key: ("candidate", value) for key, value in variables.items()}
    attrs = {
        "verdict": "; ".join(sentences[1:]),
        "claimed": _CLAIMED,
        "n_specimens": n,
        "folds": found[labels[0]].sizes["fold"],
        "random_seed": found[labels[0]].attrs["random_seed"],
    }
    return xr.Dataset(by_candidate, coords={"candidate": labels}, attrs=attrs)


def _stderr(differences: Floats, weights: Floats) -> float:
    """Return the standard error of a sum over specimens, which count with weights."""
    n = weights.size
    typical = differences.sum() / weights.sum()
    residuals = differences - weights * typical
    variance = (residuals**2).sum() * n / (n - 1)
    return float(np.sqrt(variance))


def _sentence(best: str, other: str, difference: float, error: float, *, apart: bool) -> str:
    """Return what the data say of two candidates."""
    by = f"{difference:.1f} nats (standard error {error:.1f})"
    if apart:
        return f"{best} predicts better than {other} by {by}"
    return f"the data cannot tell {best} and {other} apart: {best} is ahead by {by}"
