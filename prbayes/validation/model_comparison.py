"""Comparison of models of the same data by cross-validated log scores."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from scipy.stats import t as student

from prbayes._validate import Floats, Seed, called, flag, positive_integer, seed_number
from prbayes.optimize.optimum import Optimum
from prbayes.validation.cross_validation import cross_validate, most_folds

_CALLER = "rank"


def rank(
    candidates: Mapping[str, Optimum | xr.Dataset],
    *,
    folds: int | None = None,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> xr.Dataset:
    """Compare how well several models of the same data predict new specimens.

    Models may differ in the family of an input, in its parameters, in the response or in the
    metric. Each is cross-validated by `cross_validate` with the same folds; every specimen has a
    score under the population that was calibrated without it, and candidates are compared specimen
    by specimen.

    Parameters
    ----------
    candidates : mapping
        By label an `Optimum`, from `minimize` without the prior, or its result of `cross_validate`.
        All have the same observed values, weights and labels, in the same order.
    folds : int, optional
        Of each optimum. The default is the number of cross-validations among the candidates, which
        must agree; else ten, or half as many as there are specimens.
    random_seed : int, sequence of int, numpy.random.Generator or None
        Of the assignment of specimens to folds, which must agree likewise.
    progressbar : bool
        Whether work of more than two seconds shows a bar on stderr.

    Returns
    -------
    xarray.Dataset
        Dim (candidate), the best first: ``score``, the expected log density of a new specimen;
        ``difference``, the lead of the best one, summed over all specimens, and ``stderr``, its
        standard error from the differences by specimen; ``told_apart``, whether that is beyond
        chance; ``verdict``, the same as a sentence; and ``converged``, the share of folds whose
        minimisation converged. Attribute ``verdict`` has all sentences.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, there are fewer than two candidates, they are of other
        data, folds or seeds, or one has no score of a specimen; and as `cross_validate`.

    Notes
    -----
    Of two candidates that predict alike one is called better in about 5% of data sets; of more than
    two, at most so often for any pair (Bonferroni). A difference is compared with Student's t
    distribution with as many degrees of freedom as there are specimens less one. Scores are those
    of populations calibrated on all but one fold: slightly fewer data than there are. The only
    penalty of a candidate with more hyperparameters is its loss on held-out specimens.

    The standard error ignores that folds share their calibrations, and rare specimens that happen
    to be absent: of normal and lognormal candidates it is right to a quarter in most cases, and up
    to 1.7 times too small where the truth has a long tail (``benchmarks/families.py``).

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
    _require_candidates(candidates)
    if folds is not None:
        folds = positive_integer(folds, "folds", minimum=2)
    flag(progressbar, "progressbar")
    seed = seed_number(random_seed)
    passed = [table for table in candidates.values() if isinstance(table, xr.Dataset)]
    number = folds or (passed[0].sizes["fold"] if passed else None)
    tables = {}
    for label, candidate in candidates.items():
        if isinstance(candidate, Optimum):
            candidate = cross_validate(
                candidate,
                folds=number or most_folds(candidate, 10),
                random_seed=seed,
                progressbar=progressbar,
            )
        tables[label] = candidate
    first, *rest = tables
    for label in rest:
        _require_same(tables[label], tables[first], label, first)
    for label, table in tables.items():
        n_missing = int(np.isnan(table["score"].values).sum())
        if n_missing:
            raise ValueError(
                f"{_CALLER}: got {label} without a score of {n_missing} of "
                f"{table.sizes['specimen']} specimens, expected one of each: the observed values "
                "have no density, as where all are equal, or the population of a fold has no "
                "response; compare the discrepancies of prb.cross_validate instead"
            )
    return _comparison(tables)


def _require_candidates(candidates: object) -> None:
    """Raise unless these are two optima or cross-validations or more, by label."""
    if not isinstance(candidates, Mapping):
        raise TypeError(
            f"{_CALLER}: candidates: got {called(candidates)}, expected a mapping such as "
            "{'normal': optimum, 'lognormal': other}"
        )
    if len(candidates) < 2:
        raise ValueError(
            f"{_CALLER}: candidates: got {list(candidates)}, expected at least two to compare"
        )
    for label, candidate in candidates.items():
        if not isinstance(label, str):
            raise TypeError(f"{_CALLER}: candidates: got label {label!r:.60}, expected a text")
        is_table = isinstance(candidate, xr.Dataset) and {"score", "weight", "data"} <= set(
            candidate
        )
        if not is_table and not isinstance(candidate, Optimum):
            raise TypeError(
                f"{_CALLER}: candidates: {label}: got {called(candidate)}, expected an Optimum or "
                "what prb.cross_validate returned"
            )


def _require_same(table: xr.Dataset, reference: xr.Dataset, label: str, first: str) -> None:
    """Raise unless two cross-validations are of the same data, folds and seed."""
    names, expected = (t["simulator"].values.tolist() for t in (table, reference))
    if names != expected:
        raise ValueError(
            f"{_CALLER}: got {label} with simulators {names} and {first} with "
            f"{expected}, expected the same names in the same order"
        )
    is_same = table["data"].values == reference["data"].values
    if not is_same.all():
        differing = ", ".join(table["simulator"].values[~is_same].tolist())
        raise ValueError(
            f"{_CALLER}: got {label} and {first} with different observed values, weights or "
            f"labels of {differing}, or in another order, expected the same data; build the models "
            "of one array"
        )
    for argument, a, b in (
        ("folds", table.sizes["fold"], reference.sizes["fold"]),
        ("random_seed", table.attrs["random_seed"], reference.attrs["random_seed"]),
    ):
        if a != b:
            raise ValueError(
                f"{_CALLER}: got {label} with {argument} {a} and {first} with {b}, expected the "
                "same; pass the optima, which are then cross-validated alike"
            )


def _comparison(tables: Mapping[str, xr.Dataset]) -> xr.Dataset:
    """Return the candidates compared with the best one, in order."""
    labels = sorted(tables, key=lambda label: -float(tables[label]["score"].sum()))
    scores = np.array([tables[label]["score"].values for label in labels])
    weights = tables[labels[0]]["weight"].values
    differences = (scores[0] - scores).sum(axis=-1)
    errors = np.array([_stderr(scores[0] - row, weights) for row in scores])
    alpha = 0.05
    n = weights.size
    n_pairs = len(labels) * (len(labels) - 1) / 2
    critical = student.ppf(1 - alpha / 2 / n_pairs, n - 1)
    is_apart = differences > critical * errors
    best, *rest = labels
    sentences = [""]
    for label, lead, error, apart in zip(
        rest, differences[1:], errors[1:], is_apart[1:], strict=True
    ):
        by = f"{lead:.1f} nats (standard error {error:.1f})"
        if apart:
            sentences.append(f"{best} predicts better than {label} by {by}")
        else:
            sentences.append(
                f"the data cannot tell {best} and {label} apart: {best} is ahead by {by}"
            )
    converged = [float(tables[label]["converged"].mean()) for label in labels]
    return xr.Dataset(
        {
            "score": ("candidate", scores.mean(axis=-1)),
            "difference": ("candidate", differences),
            "stderr": ("candidate", errors),
            "told_apart": ("candidate", is_apart),
            "converged": ("candidate", converged),
            "verdict": ("candidate", np.array(sentences)),
        },
        coords={"candidate": labels},
        attrs={
            "verdict": "; ".join(sentences[1:]),
            "claimed": alpha,
            "n_specimens": n,
            "folds": tables[best].sizes["fold"],
            "random_seed": tables[best].attrs["random_seed"],
        },
    )


def _stderr(differences: Floats, weights: Floats) -> float:
    """Return the standard error of a sum of differences of weighted specimens."""
    n = weights.size
    mean = differences.sum() / weights.sum()
    variance = ((differences - weights * mean) ** 2).sum() * n / (n - 1)
    return float(np.sqrt(variance))
