"""Checks of the population: the test of its family, and its share without a response.

Under the fitted population the normal scores z = ndtri(u) of the inputs are independent standard
normals, where u are their conditional distribution functions (Rosenblatt 1952). The test needs the
scores z_ik of the points of a specimen and their posterior weights w_ik alone:

- Z_A (Zhang 2002, J. R. Stat. Soc. B 64, 281), for skewness, tails, gross errors and truncation.
- The log-likelihood ratio of a mixture of 25 normals to the standard normal, for several modes.

The p-value is that of the smallest p-value of all statistics of all inputs (min-P) against a
parametric bootstrap with refit. The study is likelihood_guards, section 2.4.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtr

from prbayes._finding import Finding, Findings
from prbayes._stats import adjusted_p_values, upper_p_values
from prbayes._validate import Arrays, Floats
from prbayes.model.emulated import EmulatedSimulator
from prbayes.model.evaluator import Evaluator
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.specimen_preparation import prepared
from prbayes.propagation.base import refuse_lost_share
from prbayes.response.distributions import PopulationSampler
from prbayes.response.response import Responses


def zhang_statistic(z: Floats, weights: Floats) -> Floats:
    """Return the mean Z_A of drawn inputs, (d,), of scores (N, K, d) and weights (N, K).

    A drawn input has the population's distribution, however many roots a specimen has; posterior
    means do not. The mean over eight draws removes most of the noise of drawing.
    """
    n, points, _ = z.shape
    cumulative = np.cumsum(weights, axis=1)
    draws = 8 if points > 1 else 1
    uniform = np.random.default_rng(0).random((draws, n, 1))
    drawn = (cumulative < uniform * cumulative[:, -1:]).sum(axis=-1)
    # (draws, N, d): distribution functions of the drawn inputs
    scores = np.clip(z[np.arange(n), drawn], -6, 6)
    u = np.sort(ndtr(scores), axis=1)
    rank = np.arange(1, n + 1)[:, None]
    upper = np.log1p(-u) / (rank - 0.5)
    lower = np.log(u) / (n - rank + 0.5)
    terms = lower + upper
    statistic: Floats = -terms.sum(axis=1).mean(axis=0)
    return statistic


def mixture_ratio(z: Floats, weights: Floats) -> Floats:
    """Return log-likelihood ratios of a mixture to the fitted population, (d,).

    The mixture replaces the population of one input at a time; its mixing weights follow from EM.
    The width of its normals bounds the likelihood.
    """
    centers, width = np.linspace(-3.5, 3.5, 25), 0.5
    ratios = []
    for score in np.moveaxis(np.clip(z, -6, 6), -1, 0):
        log_ratio = score[..., None] ** 2 / 2 - ((score[..., None] - centers) / width) ** 2 / 2
        ratio = np.einsum("nk,nkc->nc", weights, np.exp(log_ratio) / width)
        mixing = np.full(len(centers), 1 / len(centers))
        for _ in range(100):
            mixing *= (1 / (ratio @ mixing)) @ ratio / len(ratio)
        ratios.append(np.log(ratio @ mixing).sum())
    return np.array(ratios)


def population_statistics(z: Floats, weights: Floats) -> Floats:
    """Return Z_A of all inputs, then the ratios of their mixtures, (2 d,); large ones reject."""
    return np.concatenate([zhang_statistic(z, weights), mixture_ratio(z, weights)])


@dataclass(frozen=True)
class PopulationTest:
    """Result of the test of the family of the population."""

    p_value: float
    zhang: Floats  # (d,): p-values of Z_A by input, not adjusted for the number of statistics
    mixture: Floats  # (d,): p-values of the mixture's likelihood ratio by input
    n: int  # number of specimens


def population_test(z: Floats, weights: Floats, null: Arrays | Floats) -> PopulationTest:
    """Test whether the family of the population fits the inputs; for the power see `power_text`.

    ``null`` has the `population_statistics` of bootstrap samples of the fitted population, each
    with N specimens and refitted; 199 suffice. The size is .03 to .06 at p <= .05. Power with 20
    and 50 specimens against t (4), by a warp-speed bootstrap: .19 to .28, and .32 to .45.
    """
    observed = population_statistics(z, weights)
    null = np.asarray(null)
    zhang, mixture = upper_p_values(observed[None], null)[0].reshape(2, -1)
    p_value = float(adjusted_p_values(observed, null).min())
    return PopulationTest(p_value, zhang, mixture, len(z))


def power_text(n: int, inputs: int = 1, outputs: int = 1) -> str:
    """Return a sentence about the power of the test at p <= .05 with n specimens.

    Means over a linear, a folded and a frame problem, with 200 data sets each and the full
    bootstrap of 199 samples (standard error .035), interpolated in log n.
    """
    if outputs < inputs:
        return (
            f"The test of the population has no power with fewer outputs ({outputs}) than inputs "
            f"({inputs}): .05 to .12 with 50 specimens."
        )
    power = {
        "skewness 1": (0.23, 0.59, 1.0),
        "two modes": (0.35, 0.84, 1.0),
        "a population cut at its upper 30 %": (0.23, 0.76, 1.0),
        "5 % gross errors of 8 standard deviations": (0.98, 1.0, 1.0),
    }
    studied = np.log([20, 50, 200])
    values = [f"{np.interp(np.log(n), studied, row):.2f} for {k}" for k, row in power.items()]
    listed = f"{', '.join(values[:-1])} and {values[-1]}"
    if n < 20:
        return f"The test of the population has at {n} specimens less power than at 20: {listed}."
    return f"The test of the population has at {n} specimens a power of {listed}."


def population_findings(
    test: PopulationTest, labels: Sequence[str], threshold: float = 0.05
) -> Findings:
    """Return the finding ``population-misfit`` if the p-value is at most the threshold.

    The finding lists causes, because the best-fitting one is often wrong: skewness is taken for
    truncation in .69 of the data sets, gross errors for two modes in .84.
    """
    if test.p_value > threshold:
        return ()
    worst = labels[int(np.minimum(test.zhang, test.mixture).argmin())]
    text = (
        f"The family of the population: got p = {test.p_value:.2g} for the inputs of {test.n} "
        f"specimens, with the smallest p-value for {worst}, expected p > {threshold:g}; "
        "compare skewed families, two-part families, gross_errors=True, and a limit beyond "
        "which no specimen was measured."
    )
    return (Finding("population-misfit", text, "likelihood_findings.md#population-misfit"),)


def failing_region_findings(evaluator: Evaluator, theta: Floats) -> Findings:
    """Report populations in which at least .25 specimens are expected to have no response; no run.

    Where the response is NaN no specimen can be measured: the likelihood is that of the population
    truncated to the other inputs (`prbayes.specimens.response_share`). Where it is +inf specimens
    fail: as none is among the data, a population moves away from there.
    """
    lost, findings = 0.25, []
    for simulator, share in _failing_shares(evaluator, theta):
        likelihood = simulator.likelihood
        n = len(simulator.rows)
        if share * n < lost:
            continue
        meaning = (
            "the specimens count as a sample of the population truncated to inputs with a "
            "response. If specimens with these inputs were measured, repair the response; if "
            "their failures would have been recorded, return inf"
        )
        if prepared(likelihood).share is None:
            meaning = (
                "as no specimen with these inputs is among the data, the population moves away "
                "from there. If such specimens cannot be measured, return NaN"
            )
        text = (
            f"{simulator.name}: got no finite response for {share:.1%} of the population, "
            f"expected less than {lost / n:.1%}: {meaning}."
        )
        findings.append(Finding("failing-region", text, "likelihood_findings.md#failing-region"))
    return tuple(findings)


def replaced_findings(evaluator: Evaluator, theta: Floats) -> Findings:
    """Report populations that rest on finite numbers in place of responses that failed.

    The share is the weight of stored responses that were replaced. For the log-likelihood by
    specimen it is the share of specimens whose nearest run was replaced. Responses that are
    simulated again are computed once more.
    """
    shares = {}
    for k, node in enumerate(evaluator.nodes):
        if _replaces(node.bound.responses):
            parents, bound = evaluator.parents(theta[None], k), node.bound
            if node.reweighted is not None:
                bound = node.reweighted.copied(node.reweighted.design.runs_alone())
            values, weights = bound.populations(parents)
            shares[node.name] = _replaced_share(node.bound.responses, values[0], weights[0])
    for k, simulator in enumerate(evaluator.emulated, start=len(evaluator.nodes)):
        if _replaces(simulator.responses):
            emulation = prepared(simulator.likelihood).emulation
            z = _population_coordinates(evaluator, theta, k, simulator.likelihood)
            _, nearest = cKDTree(emulation.z).query(z)
            values, weights = emulation.y[nearest], np.full(len(z), 1 / len(z))
            shares[simulator.name] = _replaced_share(simulator.responses, values, weights)
    responses = {s.name: s.responses for s in evaluator.simulators}
    return tuple(
        Finding(
            "failed-responses",
            f"{name}: got {responses[name].failures} failed responses, replaced by "
            f"{responses[name].replacement:g}, which stands for {share:.1%} of the population and "
            "is compared with the data like any response. Look at optimum.failures and repair the "
            "response; or replace it by NaN, if such specimens cannot be measured, or by inf, if "
            "they fail.",
            "distributed.md#when-a-response-fails",
        )
        for name, share in shares.items()
        if share >= 5e-4  # a smaller one is displayed as 0.0%
    )


def _replaces(responses: Responses) -> bool:
    """Return whether finite numbers have replaced some responses."""
    return responses.failures > 0 and bool(np.isfinite(responses.replacement))


def _replaced_share(responses: Responses, values: Floats, weights: Floats) -> float:
    """Return the weight of the responses, (n, ...), that were replaced."""
    is_replaced = (values == responses.replacement).reshape(len(values), -1).all(axis=1)
    return float(weights @ is_replaced)


def lost_mass_shift(evaluator: Evaluator, theta: Floats, scales: Floats, stderr: Floats) -> Floats:
    """Return how far an optimum would move if lost specimens counted, in standard errors, (d,).

    The optimum is that of the specimens with a response. If they counted, points without a response
    would keep their weight and be farther from the data than all responses. No response is computed
    where they are stored; the minimum is searched by Nelder-Mead.
    """
    from scipy.optimize import minimize as scipy_minimize

    unit = np.where(np.isfinite(stderr) & (stderr > 0), stderr, 1.0)

    def counted(t: Floats) -> float:
        at = (theta + t * unit)[None]
        total = float(-evaluator.log_other(at)[0])
        for k, node in enumerate(evaluator.nodes):
            values, weights = node.bound.populations(evaluator.parents(at, k))
            features = node.target.features(values, weights, np)
            total += float(node.target.outer(*features, xp=np)[0]) / scales[k]
        return total if np.isfinite(total) else np.inf

    simplex = np.vstack([np.zeros(theta.size), np.eye(theta.size)])
    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-9, "maxfev": 200 * theta.size}
    minimum = scipy_minimize(counted, np.zeros(theta.size), method="Nelder-Mead", options=options)
    return np.asarray(minimum.x)


def refuse_lost_specimens(evaluator: Evaluator, theta: Floats) -> None:
    """Raise if too much of a population has no response (NaN): it is not known from the rest."""
    for simulator, share in _failing_shares(evaluator, theta):
        if prepared(simulator.likelihood).share is not None:
            remedy = simulator.responses.remedy
            refuse_lost_share(simulator.name, share, simulator.max_lost, remedy)


def failing_share(evaluator: Evaluator, theta: Floats) -> dict[str, float]:
    """Return the share of a population, at theta (d,), without a finite response; no run.

    The shares are by simulator, of those with a log-likelihood by specimen.
    """
    shares = dict.fromkeys((simulator.name for simulator in evaluator.emulated), 0.0)
    return shares | {s.name: share for s, share in _failing_shares(evaluator, theta)}


def _failing_shares(
    evaluator: Evaluator, theta: Floats
) -> Iterator[tuple[EmulatedSimulator, float]]:
    """Yield the emulated simulators with failing runs and the failing share of the population."""
    for k, simulator in enumerate(evaluator.emulated, start=len(evaluator.nodes)):
        likelihood = simulator.likelihood
        emulation = prepared(likelihood).emulation
        if np.isfinite(emulation.y).all():
            continue
        z = _population_coordinates(evaluator, theta, k, likelihood)
        fails = emulation.fails(np.clip(z, emulation.box[0], emulation.box[1]))
        yield simulator, float(fails.mean())


def _population_coordinates(
    evaluator: Evaluator, theta: Floats, k: int, likelihood: SpecimenLikelihood
) -> Floats:
    """Return the coordinates, (4096, d), of specimens drawn from a population."""
    sampler = PopulationSampler(likelihood.inputs)
    rng = np.random.default_rng(23)
    drawn, _ = sampler(evaluator.parents(theta[None], k), 4096, rng)
    return likelihood.coordinates.of([x[0] for x in drawn], 1)
