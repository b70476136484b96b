"""Checks of results of the log-likelihood by specimen: population, prior, modes, influence.

Each check returns findings, or the reason why it was not run. No response is computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import xarray as xr
from scipy.special import softmax

from prbayes._finding import Finding, Findings, counted
from prbayes._stats import positive_scale
from prbayes._validate import ArrayPair, Arrays, Floats, Names, complete_rows
from prbayes.emulators.runs import Runs, outlier_advice
from prbayes.inference.asymptotics import oriented
from prbayes.inference.checks.population import (
    failing_region_findings,
    population_findings,
    population_statistics,
    population_test,
    power_text,
)
from prbayes.inference.checks.prior import conflict_findings
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import element_names, variables_at
from prbayes.model.simulator_with_data import unlabelled_specimens
from prbayes.model.specimen_likelihood import all_simulators, arrays
from prbayes.model.specimen_preparation import prepared
from prbayes.numerics.derivatives import cross, slopes
from prbayes.optimize.maximum_likelihood import (
    simulation_obstacle,
    specimen_refit_obstacle,
    specimen_refits,
)
from prbayes.optimize.optimum import Optimum, require_minimiser
from prbayes.response.condition import is_condition
from prbayes.response.distributions import PopulationSampler, compiled_log_density, normal_scores
from prbayes.response.inputs import aleatory_names


@dataclass(frozen=True)
class CheckOptions:
    """Sizes and thresholds of the checks (likelihood_guards, sections 2.4 and 2.11)."""

    replicates: int = 199  # synthetic data sets of the test of the population
    prior_draws: int = 500  # draws of the prior, for its conflict with the data
    specimens: int = 256  # specimens from which the information at a draw is computed
    # distance of the means of chains in different modes, in within-chain standard deviations; the
    # means of chains in one mode, with ten independent draws each, differ by one
    separation: float = 2.0
    pull: float = 0.5  # shift by the prior, in standard errors, from which a conflict matters
    # p-value up to which a misfit of the population is a finding, and no remark: half of .05,
    # because a diagnosis has two tests, and at most one right model in twenty shall be no "ok"
    misfit: float = 0.025


_OPTIONS = CheckOptions()


@dataclass(frozen=True)
class Checked:
    """What checks found, what they did not find, and which were not run."""

    findings: Findings = ()
    remarks: Findings = ()  # results of tests that found nothing, with their power
    untested: Names = ()  # sentences on tests that were not run, with the reason

    def __add__(self, second: Checked) -> Checked:
        """Return the reports of both checks together."""
        pairs = zip(vars(self).values(), vars(second).values(), strict=True)
        return Checked(*(a + b for a, b in pairs))


def _not_tested(subject: str, reason: str) -> Checked:
    return Checked(untested=(f"{subject} was not tested: {reason}.",))


_FAMILY = "The family of the population"
_CONFLICT = "The conflict of prior and data"


def emulator_remarks(evaluator: Evaluator) -> Checked:
    """Report the emulator and the points of each likelihood by specimen."""
    remarks = []
    for likelihood in evaluator.likelihoods:
        emulation, points = prepared(likelihood).emulation, prepared(likelihood).points
        low, high = int(points.n_roots.min()), int(points.n_roots.max())
        count = counted(low, "root") if low == high else f"{low} to {high} roots"
        remarks.append(
            Finding(
                "emulator-bias",
                f"{likelihood.name}: the emulator of {len(emulation.z)} runs shifts a mean or "
                "standard deviation of an input by at most "
                f"{max(emulation.bias, 0.005):.2f} posterior standard deviations; a specimen has "
                f"{count}, and up to {points.log_a.shape[1]} points.",
            )
        )
    return Checked(remarks=tuple(remarks))


def check_simulators(evaluator: Evaluator) -> Checked:
    """Report the error of the surface of each table of runs, and specimens without labels.

    An error above a tenth of a standard deviation of the data, which widens populations by half a
    percent, is a finding.
    """
    largest = 0.1
    checked = Checked()
    for simulator in evaluator.simulators:
        table = simulator.responses.function
        if isinstance(table, Runs):
            share = table.error_beside(simulator.observed)
            text = (
                f"{simulator.name}: its responses are those of a surface through {len(table)} "
                f"runs, with a cross-validated error of {share:.2g} standard deviations of the "
                "observed responses"
            )
            if share > largest:
                advice = (
                    outlier_advice(table) or "add the runs that prb.propose_runs(model) returns"
                )
                text += f", expected at most {largest}; {advice}"
            text += "."
            report = (Finding("table-error", text, "runs.md#the-error-of-the-surface"),)
            checked += Checked(report) if share > largest else Checked(remarks=report)
    return checked + Checked(tuple(unlabelled_specimens(all_simulators(evaluator.model))))


# -- population ------------------------------------------------------------------------------


def check_population(optimum: Optimum) -> Checked:
    """Test whether the family of the population fits the inputs of the specimens.

    The test takes seconds. The last one is kept for optima that are a hundredth of a standard error
    apart: a report has an optimum, and finds that of a posterior.
    """
    evaluator = optimum.evaluator
    likelihoods = evaluator.likelihoods
    reason = _population_obstacle(optimum)
    if reason:
        return _not_tested(_FAMILY, reason)
    cache, preparations = likelihoods[0].cache, list(map(prepared, likelihoods))
    checked: Checked
    earlier, theta, checked = cache.get("population", (None, optimum.theta, Checked()))
    difference = np.abs(optimum.theta - theta)
    if earlier == preparations and (difference**2 <= 1e-4 * np.diag(optimum.covariance)).all():
        return checked
    functions = [normal_scores(likelihood.inputs) for likelihood in likelihoods]
    for likelihood, function in zip(likelihoods, functions, strict=True):
        if function is None:
            reason = f"PyMC has no distribution function of an input of {likelihood.name}"
            return _not_tested(_FAMILY, reason)
    scores = [
        (function, compiled_log_density(likelihood.inputs))
        for likelihood, function in zip(likelihoods, functions, strict=True)
    ]
    refits = specimen_refits(optimum, "diagnose", simulated=True)
    require_minimiser(optimum, "diagnose")
    data = [
        ([x.get_value() for x in points], log_a.get_value())
        for points, log_a in map(arrays, likelihoods)
    ]
    samples = scored_specimens(evaluator, scores, optimum.theta, data)
    null: list[list[Floats]] = [[] for _ in samples]
    for theta, converged, simulated in refits.simulated(_OPTIONS.replicates, seed=0):
        if converged:
            replicates = scored_specimens(evaluator, scores, theta, simulated)
            for statistics, (z, weights) in zip(null, replicates, strict=True):
                statistics.append(population_statistics(z, weights))
    if len(null[0]) < _OPTIONS.replicates / 2:
        reason = f"{len(null[0])} of {_OPTIONS.replicates} refits converged"
        return _not_tested(_FAMILY, reason)
    checked = reported_tests(optimum, samples, null)
    cache["population"] = preparations, optimum.theta, checked
    return checked


def reported_tests(
    optimum: Optimum, samples: Sequence[ArrayPair], null: Sequence[Arrays]
) -> Checked:
    """Return what tests of the population say of each likelihood.

    ``samples`` are scores and weights of the specimens, ``null`` statistics of synthetic data.
    """
    checked = Checked()
    is_rounded = "rounded-data" in [finding.code for finding in optimum.findings]
    for likelihood, (z, weights), statistics in zip(
        optimum.evaluator.likelihoods, samples, null, strict=True
    ):
        inputs = likelihood.inputs
        labels = []
        names = aleatory_names(inputs, likelihood.measurements[0].responses.function)
        for place, (name, shape) in enumerate(zip(names, inputs.event_shapes, strict=True)):
            if place in inputs.conditions:
                continue
            labels += element_names(name, shape)
        test = population_test(z, weights, statistics)
        misfit = population_findings(test, labels, threshold=0.05 / len(samples))
        if misfit and is_rounded:
            reason = f"rounded readings fit no family; pass rounded= to {likelihood.name} first"
            checked += _not_tested(_FAMILY, reason)
            continue
        if test.p_value <= _OPTIONS.misfit / len(samples):
            checked += Checked(misfit)
            continue
        power = power_text(len(z), z.shape[-1], likelihood.readings.values.shape[1])
        text = f"{likelihood.name}: the test of the population found no misfit. {power}"
        checked += Checked(remarks=misfit or (Finding("population-tested", text),))
    return checked


def _population_obstacle(optimum: Optimum) -> str:
    """Return why the family of the population cannot be tested, empty if it can."""
    evaluator = optimum.evaluator
    obstacle = simulation_obstacle(evaluator)
    if obstacle is not None:
        return obstacle
    if optimum.search.prior:
        return "the prior was part of the optimum"
    unknown = _without_sampling(optimum)
    if unknown:
        return unknown
    for likelihood in evaluator.likelihoods:
        outputs = likelihood.readings.values.shape[1]
        count = len(likelihood.coordinates.inputs_of_population)
        if count > outputs:
            return (
                f"{likelihood.name} has fewer outputs ({outputs}) than inputs ({count}), with "
                "which the test has no power"
            )
    return ""


def _without_sampling(optimum: Optimum) -> str:
    """Return why the sampling distribution of an optimum is not known, empty if it is."""
    if not optimum.converged:
        return "the optimum did not converge; pass another start= to prb.minimize"
    has_error = np.isfinite(np.diag(optimum.covariance))
    if has_error.all():
        return ""
    names = np.array(optimum.evaluator.hyperparameters.readable_names)[~has_error]
    fixed = ", ".join(dict.fromkeys(name.partition("[")[0] for name in names.tolist()))
    return (
        f"the optimum has no standard error of {', '.join(names)}, and data sets cannot be "
        f"refitted; fix {fixed} with pm.do at likely values, and pass the optimum of that model"
    )


def scored_specimens(
    evaluator: Evaluator,
    scores: Sequence[tuple[Any, Any]],
    theta: Floats,
    data: Sequence[tuple[list[Floats], Floats]],
) -> list[ArrayPair]:
    """Return normal scores (N, K, d) and posterior weights (N, K) of points, by likelihood.

    Conditions of the specimens have no score.

    ``scores`` are `normal_scores` and the compiled log-density of each likelihood's inputs, and
    ``data`` points (N, K, *event) and numbers A (N, K).
    """
    result = []
    at_theta = variables_at(evaluator.hyperparameters, theta[None])
    for likelihood, functions, (points, log_a) in zip(
        evaluator.likelihoods, scores, data, strict=True
    ):
        inputs = likelihood.inputs
        z = np.empty((*log_a.shape, inputs.dimensions - len(inputs.conditions)))
        weights = np.empty(log_a.shape)
        for place, rows in likelihood.by_group:
            size = log_a[rows].size
            parents = likelihood.parents(at_theta, place, np.repeat(rows, log_a.shape[1]))
            flat = [x[rows].reshape(size, *x.shape[2:]) for x in points]
            values, (log_p,) = (function(*parents, *flat) for function in functions)
            columns = []
            for dist, value, x in zip(inputs.aleatory, values, flat, strict=True):
                if is_condition(dist):
                    continue
                column = np.broadcast_to(value, (1, *x.shape))[0].reshape(size, -1)
                columns.append(np.clip(column, -6.0, 6.0))
            z[rows] = np.concatenate(columns, axis=1).reshape(*log_a[rows].shape, -1)
            weights[rows] = np.broadcast_to(log_p, (1, size))[0].reshape(log_a[rows].shape)
        # Points that fill up the arrays have no weight. Their scores are arbitrary.
        z = np.where(np.isfinite(z), z, 0.0)
        log_weights = weights + log_a
        log_weights = np.where(np.isfinite(log_weights), log_weights, -np.inf)
        with np.errstate(invalid="ignore"):  # A row may have no weight at all.
            relative = softmax(log_weights, axis=1)
        equal = 1 / log_a.shape[1]
        result.append((z, np.where(np.isfinite(relative), relative, equal)))
    return result


# -- draws -----------------------------------------------------------------------------------


def check_draws(evaluator: Evaluator | None, result: xr.DataTree, thetas: Floats | None) -> Checked:
    """Return the reports of the checks of draws that need no optimum.

    Without a model, evaluator and thetas are None.
    """
    # Pareto k is about az.loo, not about the draws.
    checked = Checked(remarks=influence(result))
    if evaluator is None or thetas is None:
        both = f"{_FAMILY} and the conflict of prior and data were not tested"
        return checked + Checked(untested=(f"{both}: that needs the model; pass model=.",))
    checked += Checked(failing_region_findings(evaluator, thetas.mean(axis=0)))
    checked += emulator_remarks(evaluator)
    obstacle = specimen_refit_obstacle(evaluator)
    if obstacle is None:
        return checked
    return checked + _not_tested(_FAMILY, obstacle) + _not_tested(_CONFLICT, obstacle)


def separate_modes(thetas: Floats, names: Sequence[str]) -> Findings:
    """Report chains whose means are farther apart than the chains are wide."""
    if len(thetas) < 2 or thetas.shape[1] < 4:
        return ()
    within = np.sqrt(thetas.var(axis=1).mean(axis=0))
    separation = np.ptp(thetas.mean(axis=1), axis=0) / positive_scale(within, np.inf)
    far = np.flatnonzero(separation > _OPTIONS.separation)
    if not far.size:
        return ()
    listed = ", ".join(f"{separation[j]:.1f} for {names[j]}" for j in far.tolist())
    return (
        Finding(
            "chains-in-different-modes",
            f"The means of the chains differ by {listed} within-chain standard deviations: the "
            "chains are in different modes, and their number of draws is not the mass of a mode; "
            "sample with prb.sample_smc, which weighs the modes.",
            "likelihood_findings.md#chains-in-different-modes",
        ),
    )


def influence(result: xr.DataTree) -> Findings:
    """Report specimens on which the posterior depends, by Pareto k of leave-one-out."""
    if "log_likelihood" not in result.children:
        return ()
    stats = import_module("arviz_stats")
    findings = []
    for name, values in result["log_likelihood"].to_dataset().data_vars.items():
        if values.ndim != 3 or values.shape[-1] < 2:
            continue  # This log-likelihood is one of all specimens together.
        limit = min(0.7, 1 - 1 / np.log10(max(values.sizes["chain"] * values.sizes["draw"], 11)))
        by_sample = values.stack(sample=("chain", "draw")).transpose(..., "sample")
        with np.errstate(all="ignore"):
            # ArviZ takes the negative of its argument as log weights of leave-one-out.
            _, k = stats.base.array_stats.psislw(by_sample.values, axis=-1)
        k = np.atleast_1d(k)
        high = np.flatnonzero(k > limit)
        if high.size:
            listed = ", ".join(map(str, high[:5])) + (", ..." if high.size > 5 else "")
            findings.append(
                Finding(
                    "influential-specimens",
                    f"{name}: Pareto k of leave-one-out is above {limit:.2f} for {high.size} of "
                    f"{k.size} specimens (indices {listed}; largest {k.max():.2f}): the posterior "
                    "depends on them, and az.loo is not reliable; look at these specimens, or use "
                    "prb.cross_validate.",
                    "likelihood_findings.md#leave-one-out",
                )
            )
    return tuple(findings)


# -- prior and data --------------------------------------------------------------------------


def check_conflict(optimum: Optimum, thetas: Floats) -> Checked:
    """Report hyperparameters whose prior pulls the posterior away from the data; draws (k, d)."""
    evaluator = optimum.evaluator
    unknown = _without_sampling(optimum)
    if unknown:
        return _not_tested(_CONFLICT, unknown)
    if any(mode["comparable"] for mode in optimum.local_optima):
        return _not_tested(_CONFLICT, "the likelihood has several modes")
    names = evaluator.hyperparameters.readable_names
    mean = thetas.mean(axis=0)
    errors = np.sqrt(np.diag(optimum.covariance))
    pulls = np.abs(mean - optimum.theta) / errors
    j = int(pulls.argmax())
    shift = (
        f"The posterior mean of {names[j]} is {pulls[j]:.2f} standard errors from the estimate "
        "without the prior"
    )
    if pulls[j] <= _OPTIONS.pull:
        text = f"{shift}, too little to matter."
        return Checked(remarks=(Finding("prior-agrees", text),))
    prior = evaluator.hyperparameters.prior_thetas(_OPTIONS.prior_draws, 0)
    predictive = _predictive_estimates(optimum, prior)
    if complete_rows(predictive).mean() < 0.5:
        reason = "the information of most populations of the prior is not finite"
        return _not_tested(_CONFLICT, reason)
    findings = conflict_findings(names, prior, optimum.theta, errors, mean, predictive)
    if findings:
        return Checked(findings)
    text = f"{shift}; no hyperparameter is in conflict with its prior (p > .05)."
    # The power was measured with one reading of each input, and readings without limits.
    if simulation_obstacle(evaluator) is None:
        n = sum(len(likelihood.readings) for likelihood in evaluator.likelihoods)
        power = np.interp(np.log(n), np.log([10, 20, 50]), [0.86, 0.98, 1.0])
        text += (
            f" With {n} specimens the test has a power of {power:.2f} for a mean four prior "
            "standard deviations off."
        )
    return Checked(remarks=(Finding("prior-agrees", text),))


def _predictive_estimates(optimum: Optimum, prior: Floats) -> Floats:
    """Return estimates from data sets simulated at draws of the prior, (S, d); NaN if unknown.

    They are normal around each draw. Their covariance is the inverse information of known inputs,
    scaled to the standard errors of the optimum.
    """
    rng = np.random.default_rng(31)
    evaluator = optimum.evaluator
    compiled = [
        (PopulationSampler(likelihood.inputs), compiled_log_density(likelihood.inputs))
        for likelihood in evaluator.likelihoods
    ]
    complete = _complete_covariance(evaluator, compiled, optimum.theta, rng)
    ratio = np.sqrt(np.diag(optimum.covariance) / np.diag(complete))
    estimates = np.full(prior.shape, np.nan)
    for row, theta in zip(estimates, prior, strict=True):
        covariance = _complete_covariance(evaluator, compiled, theta, rng)
        if np.isfinite(covariance).all():
            values, vectors = np.linalg.eigh(covariance)
            scaled = np.sqrt(np.maximum(values, 0)) * rng.standard_normal(len(theta))
            row[:] = theta + ratio * (oriented(vectors) @ scaled)
    return estimates


def _complete_covariance(
    evaluator: Evaluator,
    compiled: Sequence[tuple[PopulationSampler, Any]],
    theta: Floats,
    rng: np.random.Generator,
) -> Floats:
    """Return the inverse information of the inputs of all specimens, (d, d); NaN if singular."""
    step = 1e-3 * evaluator.hyperparameters.prior_sd
    around = cross(theta, step)
    values = variables_at(evaluator.hyperparameters, around)
    information = np.zeros((theta.size, theta.size))
    n = _OPTIONS.specimens
    for likelihood, (sampler, log_density) in zip(evaluator.likelihoods, compiled, strict=True):
        for place, rows in likelihood.by_group:
            parents = likelihood.parents(values, place, np.resize(rows, n))
            specimens, _ = sampler([parent[:1] for parent in parents], n, rng)
            (log_p,) = log_density(*parents, *[x[0] for x in specimens])
            with np.errstate(invalid="ignore"):
                scores = slopes(np.broadcast_to(log_p, (len(around), n)), step)
            information += len(rows) / n * scores.T @ scores
    if np.isfinite(information).all():
        try:
            return np.linalg.inv(information)
        except np.linalg.LinAlgError:
            pass
    return np.full_like(information, np.nan)
