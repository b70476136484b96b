"""Importance points of measured specimens, from runs and an emulator.

Posterior draws of the hyperparameters, given such points, give the population in which fibres are
covered, and the unit of Monte Carlo errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.special import chdtri, ndtri

from prbayes._finding import Finding, report
from prbayes._stats import log_sum_exp
from prbayes._validate import IN_CACHE, Floats
from prbayes.model.data_checks import (
    check_failing_region,
    data_findings,
    emulator_findings,
    misfit_findings,
    outlier_findings,
    refuse_undetermined,
    refuse_unreachable,
    refuse_unused_inputs,
    repeat_findings,
    unreached,
)
from prbayes.model.measurement import SpecimenLikelihood, output_columns
from prbayes.model.parameters import Hyperparameters, log_posterior, variables_at
from prbayes.model.random_variable import log_first_runs
from prbayes.model.table_likelihood import OfTables, points_of_tables
from prbayes.numerics.points import sobol
from prbayes.propagation.base import MAX_LOST, DesignError
from prbayes.propagation.fibre_points import fibre_points
from prbayes.propagation.population_density import WeightedPoints
from prbayes.propagation.response_share import ResponseShare, response_share
from prbayes.propagation.roots import Roots
from prbayes.propagation.specimen_emulation import (
    Emulation,
    EmulationProblem,
    emulate,
    first_runs,
)
from prbayes.propagation.specimen_points import SpecimenPoints, draw_points
from prbayes.response.budget import RunCost
from prbayes.response.inputs import aleatory_names


@dataclass(frozen=True, eq=False)
class Preparation:
    """Emulator and importance points of measured specimens."""

    emulation: Emulation
    points: SpecimenPoints
    findings: tuple[Finding, ...]  # about the data and the runs, before the fit
    share: ResponseShare | None  # of a population with a response, if it matters


def prepared(likelihood: SpecimenLikelihood) -> Preparation:
    """Return the emulator and the points of a likelihood; the first call computes the runs.

    Raise DesignError or ResponseError if the response does not allow the likelihood.
    """
    if "preparation" not in likelihood.cache:
        likelihood.cache["preparation"] = _prepare(likelihood)
    preparation: Preparation = likelihood.cache["preparation"]
    return preparation


def is_prepared(likelihood: SpecimenLikelihood) -> bool:
    """Return whether the points of a likelihood are computed."""
    return "preparation" in likelihood.cache


def first_run_count(likelihood: SpecimenLikelihood) -> int | None:
    """Return the largest number of first runs that a simulator requires, None for the default."""
    numbers = [m.propagation.emulator_runs for m in likelihood.measurements]
    return max((n for n in numbers if n is not None), default=None)


def emulator_cost(likelihood: SpecimenLikelihood) -> RunCost:
    """Return the runs for the emulator of a log-likelihood by specimen."""
    if likelihood.has_table:
        n = len(prepared(likelihood).emulation.z) if is_prepared(likelihood) else 0
        return RunCost(n, 0, n, "none: the table has all runs")
    first = first_run_count(likelihood) or first_runs(likelihood.coordinates.size)
    batch = max(first // 2, likelihood.options.fresh)
    computed = len(prepared(likelihood).emulation.z) if is_prepared(likelihood) else 0
    least, most = first + 2 * batch, first + 5 * batch
    growth = (
        f"{least} to {most} in all, {batch} at a time at the roots of the specimens, until the "
        f"emulator shifts no estimate by more than {likelihood.options.bias} standard deviations"
    )
    return RunCost(max(least, computed), 0, most, growth)


def _prepare(likelihood: SpecimenLikelihood) -> Preparation:
    """Compute runs, emulator and points; log how many runs there are."""
    responses = [m.responses for m in likelihood.measurements]
    cost = emulator_cost(likelihood)
    n = first_run_count(likelihood) or first_runs(likelihood.coordinates.size)
    for response in responses if not likelihood.has_table else []:
        response.on_start = partial(log_first_runs, cost, f"Reweighted(n={n})", response)
    populations = Populations(likelihood)
    runs = Runs(likelihood)
    try:
        emulation, points, findings = _emulate(runs, populations, likelihood.shared_emulation)
        problem = _problem(runs)
        if likelihood.has_table:  # a call of the surface is no run
            problem = replace(problem, run=OfTables.of(likelihood, lambda table: table))
        refined, share = response_share(
            problem,
            emulation,
            populations.prior_specimens,
            lambda share: populations.posterior(points.z, points.log_a, share=share),
        )
        if share is not None and likelihood.inputs.conditions:
            raise DesignError(
                f"{likelihood.name}: got NaN from the response for a share of the specimens that "
                "is not negligible, expected a response of all specimens with "
                "prb.response.condition, since the share depends on the condition; return a "
                "number there, such as the limit of the measurement, or narrow the priors"
            )
        if likelihood.has_table:
            refined = emulation
        if refined is not emulation and not _is_partial(likelihood):
            # Specimens beside the failing region have points on its right side now.
            refined, points, findings = _emulate(runs, populations, refined)
        return Preparation(refined, points, report(*runs.findings, *findings), share)
    except DesignError as error:
        if likelihood.has_table:
            raise
        cause = "" if runs.first is None else unreached(runs.first, likelihood.readings)
        if not cause:
            outputs = np.empty((0, 0)) if runs.first is None else runs.first
            data = _data_findings(likelihood, outputs, several_roots=False)
            cause = "".join(finding.text.removesuffix(".") for finding in data[:1])
        raise DesignError(f"{cause}. Therefore: {error}" if cause else str(error)) from None
    finally:
        for response in responses:
            response.on_start = None


@dataclass(eq=False)
class Runs:
    """Outputs of runs at coordinates; checks the first ones for range and influence."""

    likelihood: SpecimenLikelihood
    first: Floats | None = None  # (n, M): outputs of the first runs
    findings: tuple[Finding, ...] = ()  # about the first runs

    def __call__(self, z: Floats) -> Floats:
        """Return outputs of runs, (n, d) -> (n, M): NaN without response, +inf for a failure."""
        likelihood = self.likelihood
        measurements = likelihood.measurements
        inputs = likelihood.coordinates.inputs(z)
        parts = [m.responses(inputs, []).reshape(len(z), -1) for m in measurements]
        # Conditions are outputs that were read exactly.
        parts.append(z[:, likelihood.coordinates.is_condition])
        values = np.concatenate(parts, axis=1)
        if likelihood.shared_emulation is None and self.first is None:
            refuse_unreachable(likelihood.name, values, likelihood.readings)
            refuse_unused_inputs(likelihood.name, z, values, _coordinate_names(likelihood))
            self.first = values
            if not any(
                m.metric.error is not None or m.gross_errors is not False for m in measurements
            ):
                self.findings = check_failing_region(
                    likelihood.name,
                    likelihood.readings.values,
                    [z],
                    values,
                    max(getattr(m.propagation, "max_lost", MAX_LOST) for m in measurements),
                )
        return values


def _coordinate_names(likelihood: SpecimenLikelihood) -> list[str]:
    """Return the name of the input of each coordinate."""
    inputs = likelihood.inputs
    names = aleatory_names(inputs, likelihood.measurements[0].responses.function)
    sizes = [int(np.prod(shape, dtype=int)) for shape in inputs.event_shapes]
    return [name for name, size in zip(names, sizes, strict=True) for _ in range(size)]


def _is_partial(likelihood: SpecimenLikelihood) -> bool:
    """Return whether the readings of a specimen leave inputs along a fibre.

    They are fewer than the inputs, or some are measured, known conditions among them, and the
    others censored: points around roots would miss the measured ones. Without a known error such
    points are kept, or refused where their halves differ.
    """
    n_measured = likelihood.readings.is_measured.sum(axis=1)
    n_present = n_measured + likelihood.readings.is_censored.sum(axis=1)
    size = likelihood.coordinates.size
    is_partial = n_present < size
    has_gross_errors = any(m.gross_errors is not False for m in likelihood.measurements)
    if likelihood.error_is_known and not has_gross_errors and not likelihood.calls_response:
        is_partial |= (n_measured > 0) & (n_measured < size)
    return bool(is_partial.any())


def _problem(runs: Runs) -> EmulationProblem:
    """Return the response and the readings of all simulators of the specimens."""
    likelihood = runs.likelihood
    n, options = first_run_count(likelihood), likelihood.options
    return EmulationProblem(runs, likelihood.readings, options, n=n, name=likelihood.name)


def _emulate(
    runs: Runs, populations: Populations, emulation: Emulation | None
) -> tuple[Emulation, SpecimenPoints, Sequence[Finding]]:
    """Return the emulator, the points and findings of both."""
    likelihood = runs.likelihood
    name, options, readings = likelihood.name, likelihood.options, likelihood.readings
    bounds, d = likelihood.coordinates.bounds, likelihood.coordinates.size
    problem = _problem(runs)
    if likelihood.has_table:
        emulation, points, roots = points_of_tables(
            problem, likelihood, populations.prior_specimens, populations.posterior
        )
        return emulation, points, _findings(likelihood, emulation, points, roots)
    if _is_partial(likelihood):
        if likelihood.calls_response:
            raise TypeError(
                f"{name}: propagation: got prb.Resimulated, expected stored responses where "
                "specimens have fewer readings than inputs; leave propagation= out"
            )
        specimens, posterior = populations.prior_specimens(), populations.posterior
        emulation, points = fibre_points(problem, bounds, specimens, posterior)
        return emulation, points, _findings(likelihood, emulation, points, None)
    box = np.stack([-np.ones(d), np.ones(d)])
    if likelihood.calls_response:
        emulation = Emulation.of_function(problem, box, bounds)
    emulation, roots = emulate(problem, box, bounds, emulation)
    if not likelihood.calls_response:
        refuse_undetermined(name, emulation, roots, _coordinate_names(likelihood))
    is_known = likelihood.error_is_known
    has_gross_errors = likelihood.measurements[0].gross_errors is not False
    points = draw_points(
        emulation,
        readings,
        roots,
        options,
        error_is_known=is_known,
        gross_errors=has_gross_errors,
    )
    return emulation, points, _findings(likelihood, emulation, points, roots)


def _findings(
    likelihood: SpecimenLikelihood,
    emulation: Emulation,
    points: SpecimenPoints,
    roots: Roots | None,
) -> list[Finding]:
    """Return findings of the data, and of the emulator at the roots of the specimens, if any."""
    if roots is None:
        return [*_data_findings(likelihood, emulation.y, several_roots=True)]
    name, readings, error = likelihood.name, likelihood.readings, emulation.error
    return [
        *_data_findings(likelihood, emulation.y, several_roots=bool((points.n_roots > 1).any())),
        *misfit_findings(
            name,
            readings,
            roots,
            error,
            gross_errors=likelihood.measurements[0].gross_errors is not False,
        ),
        *emulator_findings(name, readings, error),
    ]


def _data_findings(
    likelihood: SpecimenLikelihood, outputs: Floats, *, several_roots: bool
) -> tuple[Finding, ...]:
    """Return findings of outliers, and of rounded, censored and repeated exact readings.

    None of outputs, (n, M), that are the same in all runs.
    """
    findings: list[Finding] = []
    finite = outputs[np.isfinite(outputs).all(axis=1)]
    for m in likelihood.measurements:
        values = m.readings.values
        simulated = outputs[:, output_columns(likelihood, m)] if len(outputs) else outputs
        has_gross_errors = m.gross_errors is not False
        findings += outlier_findings(
            m.name, values, simulated, m.outputs.names, gross_errors=has_gross_errors
        )
        if len(finite):
            is_constant = np.ptp(finite[:, output_columns(likelihood, m)], axis=0) == 0
            values = np.where(is_constant, np.nan, values)
        steps: Any = m.readings.step.max(axis=0)
        # A reading error that the user gives covers rounding.
        is_stated = (steps > 0) | (m.metric.error is not None)
        findings += data_findings(
            values,
            labels=[f"{m.name}[{label}]" for label in m.outputs.names] or [m.name],
            several_roots=several_roots,
            rounded=np.where(is_stated, np.maximum(steps, 1e-300), np.nan),
        )
    repeats, gross_errors = likelihood.stacked.repeats, likelihood.measurements[0].gross_errors
    if repeats is not None and likelihood.error_is_known and gross_errors is False:
        findings += repeat_findings(likelihood.name, repeats)
    return tuple(findings)


def log_shares(
    likelihood: SpecimenLikelihood, values: Mapping[str, Floats], share: ResponseShare
) -> Floats:
    """Return log S of the population of each specimen, (P, S), at values by name, (P, *shape)."""
    result = np.empty((len(next(iter(values.values()))), len(likelihood.readings)))
    for group, rows in likelihood.by_context:
        parents = likelihood.parents(values, group, rows[:1])
        log_share = share.of_populations(likelihood.density, parents, likelihood.coordinates)
        result[:, rows] = log_share[:, None]
    return result


@dataclass(frozen=True, eq=False)
class Populations:
    """Populations of a model's hyperparameters, evaluated at points of its specimens."""

    likelihood: SpecimenLikelihood

    @cached_property
    def hyperparameters(self) -> Hyperparameters:
        """The hyperparameters of the model."""
        return self.likelihood.hyperparameters

    def log_likelihoods(
        self, thetas: Floats, z: Floats, log_a: Floats, smoothing: Floats | None = None
    ) -> Floats:
        """Return log p(y_i | theta), (S, N), from points (N, K, d) and their numbers (N, K).

        With `smoothing`, a covariance (d, d), populations are normal with the moments of the
        coordinates z, and wider by it: the log-likelihood is then smooth.
        """
        n, count, d = z.shape
        likelihood = self.likelihood
        result = np.empty((len(thetas), n))
        x = likelihood.coordinates.inputs(z)
        weights = log_a if smoothing is not None else log_a + likelihood.coordinates.log_jacobian(z)
        values = variables_at(self.hyperparameters, thetas)
        contexts = likelihood.by_group if smoothing is None else likelihood.by_context
        for group, rows in contexts:
            parents = likelihood.parents(values, group, rows)
            if smoothing is None:
                points = WeightedPoints.of(likelihood.inputs, [v[rows] for v in x], weights[rows])
                result[:, rows] = likelihood.density.log_likelihoods(parents, points)
                continue
            step = max(1, IN_CACHE // (len(rows) * count))
            for first in range(0, len(thetas), step):
                block = slice(first, first + step)
                at_block = [parent[block] for parent in parents]
                logs = self._normal_log_density(at_block, z[rows].reshape(-1, d), smoothing)
                logs = np.where(np.isnan(logs), -np.inf, logs)
                logs = logs.reshape(-1, len(rows), count)
                result[block, rows] = log_sum_exp(logs + weights[rows])
        return result

    def prior_specimens(self) -> Floats:
        """Return coordinates of specimens of the prior predictive population, (n, d)."""
        return PopulationDraws(self, self.hyperparameters.prior_thetas(2048, 0)).specimens(1)

    def log_share(self, thetas: Floats, share: ResponseShare) -> Floats:
        """Return log S of the population of each specimen, summed over the specimens, (S,)."""
        values = variables_at(self.hyperparameters, thetas)
        return log_shares(self.likelihood, values, share).sum(axis=1)

    def _normal_log_density(
        self, parents: Sequence[Floats], z: Floats, smoothing: Floats, specimens: int = 256
    ) -> Floats:
        """Return the log-density of points (n, d) in smoothed normal populations, (S, n)."""
        sampler, rng = self.likelihood.density.sampler, np.random.default_rng(0)
        sample = self.likelihood.coordinates.of(sampler(parents, specimens, rng)[0], 2)
        # Populations far from the prior may have inputs whose squares overflow.
        is_finite = (np.abs(sample) < 1e100).all(axis=(1, 2))
        sample[~is_finite] = 0.0
        mean = sample.mean(axis=1, keepdims=True)
        centred = sample - mean
        root = np.linalg.cholesky(centred.swapaxes(1, 2) @ centred / specimens + smoothing)
        inverse = np.linalg.inv(root)
        log_det = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1, keepdims=True)
        constant = z.shape[1] / 2 * np.log(2 * np.pi)
        result = np.zeros((len(mean), len(z)))
        for axis in inverse.swapaxes(0, 1):
            standard = axis @ z.T
            standard -= (axis * mean[:, 0]).sum(axis=1, keepdims=True)
            result += np.square(standard, out=standard)
        result *= -0.5
        result -= log_det + constant
        result[~is_finite] = -np.inf
        return result

    def posterior(
        self,
        z: Floats,
        log_a: Floats,
        smoothing: Floats | None = None,
        share: ResponseShare | None = None,
        seed: int = 0,
    ) -> PopulationDraws:
        """Return draws of the posterior of the hyperparameters given points of the specimens.

        Adaptive importance sampling. Weights are tempered until their effective sample size is ten
        times the number of hyperparameters, so that a few draws do not decide the next proposal.
        """
        names = self.hyperparameters
        d = names.size

        def log_likelihood(thetas: Floats) -> Floats:
            total = self.log_likelihoods(thetas, z, log_a, smoothing).sum(axis=1)
            return total if share is None else total - self.log_share(thetas, share)

        thetas = names.prior_points(2048, seed)
        log_weights = log_posterior(names, thetas, log_likelihood) - names.log_prior(thetas)
        weights, _ = _tempered(log_weights, 10 * d)
        for attempt in range(12):
            mean = weights @ thetas
            away = thetas - mean
            covariance = (away.T * weights) @ away + 1e-12 * np.diag(names.prior_sd**2)
            root = np.linalg.cholesky(1.2 * covariance)
            u = sobol(1024, d + 1, seed + 1 + attempt)
            radius = np.sqrt(5 / chdtri(5, u[:, d]))
            standard = ndtri(u[:, :d]) * radius[:, None]
            thetas = mean + standard @ root.T
            log_proposal = -(5 + d) / 2 * np.log1p((standard**2).sum(axis=1) / 5)
            log_density = log_posterior(names, thetas, log_likelihood)
            weights, temper = _tempered(log_density - log_proposal, 10 * d)
            if temper == 1.0 and attempt >= 2 and 1 / (weights**2).sum() > 200:
                break
        rng = np.random.default_rng([seed, 5])
        return PopulationDraws(self, thetas[rng.choice(len(thetas), 256, p=weights)])


def _tempered(log_weights: Floats, least: int) -> tuple[Floats, float]:
    """Return normalised weights, tempered to an effective sample size, and the temper."""
    if not np.isfinite(log_weights).any():
        raise ValueError(
            "log-likelihood: got no population of the prior that reaches the specimens, expected "
            "one at least; look at the priors and at the data's units, and pass "
            "prb.LogLikelihood(error=...) if readings have an error"
        )
    temper = 1.0
    while True:
        scaled = temper * (log_weights - log_weights.max())
        weights = np.exp(np.nan_to_num(scaled, nan=-np.inf))
        weights /= weights.sum()
        if 1 / (weights**2).sum() >= least or temper < 1e-6:
            return weights, temper
        temper *= 0.7


@dataclass(frozen=True, eq=False)
class PopulationDraws:
    """Draws of the hyperparameters, (S, d)."""

    populations: Populations
    thetas: Floats

    def log_likelihoods(self, z: Floats, log_a: Floats) -> Floats:
        """Return log p(y_i | theta) at the draws, (S, N)."""
        return self.populations.log_likelihoods(self.thetas, z, log_a)

    def log_share(self, share: ResponseShare) -> Floats:
        """Return the sum over the specimens of log S, the log share with a response, (S,)."""
        return self.populations.log_share(self.thetas, share)

    def specimens(self, n_of_each: int = 16) -> Floats:
        """Return coordinates of specimens of all groups and draws, (n, d)."""
        populations, likelihood = self.populations, self.populations.likelihood
        rng = np.random.default_rng([0, 3])
        parts = []
        values = variables_at(populations.hyperparameters, self.thetas)
        for group, rows in likelihood.by_group:
            if likelihood.inputs.covariates:
                rows = rng.choice(rows, (len(self.thetas), n_of_each))
            parents = likelihood.parents(values, group, rows)
            inputs, _ = likelihood.density.sampler(parents, n_of_each, rng)
            z = likelihood.coordinates.of(inputs, 2)
            parts.append(z.reshape(-1, z.shape[-1]))
        z = np.concatenate(parts)
        return z[np.isfinite(z).all(axis=1)]
