"""Checks of the number of specimens: too few for standard errors."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.special import gammaincinv, ndtri, stdtrit

from prbayes._finding import Finding
from prbayes._stats import INTERVAL
from prbayes._validate import Arrays, Bools, Floats, Indices
from prbayes.model.evaluator import Evaluator
from prbayes.model.simulator_with_data import unlabelled_specimens
from prbayes.model.specimen_likelihood import all_simulators
from prbayes.response.distributions import PopulationSampler
from prbayes.response.inputs import Inputs

_PAGE = "optimum_or_abc.md#few-specimens-and-a-prior-that-knows-something"


def elements_above(evaluator: Evaluator) -> Bools:
    """Return which elements of theta enter the population of each simulator, (K, d)."""
    hyperparameters = evaluator.hyperparameters
    prior_sd = hyperparameters.prior_sd
    thetas = hyperparameters.initial + np.vstack([0 * prior_sd, np.diag(prior_sd)])
    enters = np.zeros((len(evaluator.simulators), hyperparameters.size), dtype=bool)
    for k, row in enumerate(enters):
        parents = evaluator.parents(thetas, k)
        flat = [parent.reshape(len(thetas), -1) for parent in parents]
        values = np.concatenate(flat, axis=1)
        if values.shape[1] > len(parents):
            # Draw specimens, because a population may depend on a single element of a vector
            # parent.
            inputs = evaluator.simulators[k].inputs
            with contextlib.suppress(TypeError):  # raised by inputs that cannot be drawn
                values = _specimens(inputs, parents)
        row |= (values[1:] != values[0]).any(axis=1)
    return enters


def _specimens(inputs: Inputs, parents: Arrays) -> Floats:
    """Draw specimens of each population from the same random numbers, (P, k)."""
    sampler = PopulationSampler(inputs)
    draws = []
    for k in range(len(parents[0])):
        rng = np.random.default_rng(0)
        population = [parent[k : k + 1] for parent in parents]
        aleatory, epistemic = sampler(population, 64, rng)
        values = [np.ravel(x) for x in aleatory]
        values += [np.ravel(x) for x in epistemic]
        draws.append(np.concatenate(values))
    return np.stack(draws)


def interval_ratios(n: float) -> tuple[float, float]:
    """Return how much wider than their standard errors intervals of n normal specimens are.

    Of the mean and of the standard deviation, under Jeffreys' prior: by Student's t and chi-squared
    distributions with n - 1 degrees of freedom, relative to normal intervals around the maximum of
    the likelihood.

    Examples
    --------
    >>> [round(ratio, 1) for ratio in interval_ratios(3)]
    [2.1, 3.4]
    >>> [round(ratio, 2) for ratio in interval_ratios(1e6)]
    [1.0, 1.0]
    """
    upper = (1 + INTERVAL) / 2
    z = float(ndtri(upper))
    # The factor n / (n - 1) is that of the maximum of the likelihood, which divides squares by n.
    mean = np.sqrt(n / (n - 1)) * stdtrit(n - 1, upper) / z
    longest, shortest = (np.sqrt(n / (2 * gammaincinv((n - 1) / 2, p))) for p in (1 - upper, upper))
    return float(mean), float((longest - shortest) / (2 * z / np.sqrt(2 * n)))


def specimen_counts(evaluator: Evaluator) -> tuple[Bools, Indices, list[float]]:
    """Return the elements above each simulator, its group, and the specimens of each group.

    Simulators of a group have an element of theta in common.
    """
    enters = elements_above(evaluator)
    enters = enters[:, enters.any(axis=0)]
    _, groups = connected_components(enters @ enters.T)
    counts = []
    for group in np.unique(groups):
        members = [evaluator.simulators[k] for k in np.flatnonzero(groups == group)]
        labels = [member.specimens for member in members if member.specimens is not None]
        count = sum(member.n_specimens for member in members)
        if len(labels) == len(members):  # because specimens in common count once
            count = float(np.unique(np.concatenate(labels)).size)
        # because a sum of weights may be slightly below a whole number
        counts.append(round(count, 6))
    return enters, groups, counts


def few_for_bootstrap(evaluator: Evaluator, *, parametric: bool) -> list[Finding]:
    """Report too few specimens for intervals of the bootstrap.

    Shares of 3000 data sets of a normal population whose 89 % intervals contain its mean and its
    standard deviation, by 8, 20 and 50 specimens (benchmarks/bootstrap.py); between these they
    are interpolated in log n.
    """
    enough = 50
    n = min(specimen_counts(evaluator)[2], default=enough)
    if not n < enough:
        return []
    shares = (0.79, 0.85, 0.87), (0.58, 0.76, 0.82)
    if parametric:
        shares = (0.82, 0.86, 0.88), (0.70, 0.82, 0.85)
    mean, spread = (np.interp(np.log(n), np.log([8, 20, 50]), row) for row in shares)
    text = (
        f"The bootstrap: got {n:.3g} specimens, expected at least {enough}: of a normal population "
        f"{INTERVAL:.0%} intervals contain the standard deviation in about {spread:.0%} of data "
        f"sets, and the mean in {mean:.0%}; report intervals of prb.sample."
    )
    return [Finding("few-for-bootstrap", text, _PAGE)]


def few_specimens(evaluator: Evaluator) -> list[Finding]:
    """Report too few specimens for standard errors, and those that may be counted twice.

    Specimens of simulators with a common element of theta are added.
    """
    enough = 8
    enters, groups, counts = specimen_counts(evaluator)
    findings = unlabelled_specimens(all_simulators(evaluator.model))
    n = min(counts, default=enough)
    if not n < enough:
        return findings + _spread_in_common(evaluator, enters, groups, counts)
    fewest = np.flatnonzero(groups == np.argmin(counts))
    names = ", ".join(evaluator.simulators[k].name for k in fewest)
    text = f"{names}: got {n:.3g} specimen{'s' * (n != 1)}, expected at least {enough}: "
    if n < 2:
        text += "one specimen does not identify a spread, and standard errors do not apply; "
    else:
        mean, spread = interval_ratios(n)
        text += (
            "standard errors assume many specimens. Where the spread is estimated too, "
            f"{INTERVAL:.0%} intervals of a normal population's mean are at least {mean:.1f} times "
            f"as wide as by standard errors, and those of its spread {spread:.1f} times; "
        )
    text += "report intervals of prb.sample, not the optimum's."
    return [*findings, Finding("few-specimens", text, _PAGE)]


def _spread_in_common(
    evaluator: Evaluator,
    enters: Bools,
    groups: Indices,
    counts: Sequence[float],
) -> list[Finding]:
    """Report a spread that populations with means of their own underestimate (Neyman and Scott).

    With G means the maximum of the likelihood is sqrt(1 - G / N) of a common standard deviation,
    about G / sqrt(2 N) standard errors below it. Metrics of distributions are tested by refits
    instead.
    """
    if evaluator.nodes:
        return []
    findings = []
    for group, n in enumerate(counts):
        of_group = enters[groups == group]
        is_own = of_group & (of_group.sum(axis=0) == 1)
        size = int(is_own.any(axis=1).sum())
        if size < 2 or size < 0.5 * np.sqrt(2 * n):
            continue
        first = evaluator.simulators[np.flatnonzero(groups == group)[0]].name
        share = 1 - np.sqrt(max(1 - size / n, 0.0))
        text = (
            f"{first} and others: got {n:.3g} specimens of {size} populations with hyperparameters "
            "of their own, expected more of each: the optimum underestimates standard deviations, "
            f"by about {share:.0%} if they are in common; report prb.sample, not the optimum."
        )
        findings.append(Finding("few-specimens", text, _PAGE))
    return findings
