"""Maximum likelihood for models whose observed variables have exact log-densities.

BFGS with exact gradients from the most likely points of the prior. Every local optimum is kept with
its weight, the share of the posterior mass by Laplace's approximation. Estimates of other data sets
cost no run: these are the observed specimens with other weights, or simulated specimens of a pool.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import pytensor.tensor as pt

from prbayes._finding import Finding, counted, report
from prbayes._stats import positive_scale
from prbayes._validate import (
    IN_CACHE,
    ArrayPair,
    Arrays,
    ArraysByName,
    Bools,
    Floats,
    Indices,
    NamedArrays,
)
from prbayes.inference.checks.one_sided import end_and_bound_findings, one_sided_bounds
from prbayes.inference.checks.population import (
    failing_region_findings,
    refuse_lost_specimens,
    replaced_findings,
)
from prbayes.inference.checks.prior import elements_at_prior_ends
from prbayes.inference.checks.sample_size import few_specimens
from prbayes.inference.prior_continuation import ends_of_prior
from prbayes.metrics.readings import with_values
from prbayes.model.evaluator import (
    Evaluator,
    compiled_objective,
    only_through_prior,
    specimen_graphs,
    specimen_log_likelihoods,
)
from prbayes.model.fingerprint import identity_of
from prbayes.model.measurement import SpecimenLikelihood, has_random_response, specimen_numbers
from prbayes.model.parameters import Hyperparameters, unconstrained, variables_at
from prbayes.model.specimen_audit import audited_evaluator
from prbayes.model.specimen_likelihood import arrays, draw_readings, monte_carlo_error
from prbayes.model.specimen_preparation import (
    PopulationDraws,
    SpecimenPopulations,
    prepared,
    specimen_data,
)
from prbayes.numerics.batched_minimisers import descend_by_slopes
from prbayes.numerics.mixtures import normalised_weights
from prbayes.numerics.modes import Laplace, far_apart
from prbayes.optimize.convergence import Result
from prbayes.optimize.design_refinement import MAX_ROUNDS
from prbayes.optimize.optimum import (
    Optimum,
    SearchRecord,
    local_optimum,
    n_computed,
    point_and_stderr,
    point_text,
    require_sampling,
)
from prbayes.response.compile import compile_batched, interpreted
from prbayes.specimens.points import agreeing_points, fit_proposals


@dataclass(frozen=True, eq=False)
class Mode:
    """A local minimum of minus the log-likelihood, or of minus the log-posterior."""

    theta: Floats  # (d,)
    value: float
    # (d, d): inverse Hessian; infinite along directions without curvature, NaN at the edge of a
    # support
    covariance: Floats
    converged: bool
    # part of the objective's trace, without the evaluations for the Hessian
    steps: slice = slice(0)


def maximize_likelihood(evaluator: Evaluator, settings: Any) -> Optimum:
    """Return the maximum of the likelihood, or of the posterior density with ``settings.prior``.

    The model has no metric of distributions; ``settings`` is a `Minimisation`.
    """
    clock = time.perf_counter()
    n_previous = evaluator.n_responses
    for round_ in range(MAX_ROUNDS + 1):
        objective = _Objective(evaluator, settings.prior)
        starts, n_screened = _starts(evaluator, settings)
        optima = []
        for start in starts:
            optima.append(_descend(objective, start, settings))
            if objective.count > settings.max_evaluations:
                break
        modes, is_supported = supported_modes(evaluator, objective, optima)
        thetas = np.stack([mode.theta for mode in modes])
        # An emulator that stays wrong at another optimum than the best is no reason to refuse.
        is_last = round_ == MAX_ROUNDS
        rows = thetas[[mode.value - modes[0].value <= (0.0 if is_last else 6.0) for mode in modes]]
        latest, spent = audited_evaluator(evaluator, rows, "the optima", is_last=is_last)
        if latest is evaluator:
            break
        evaluator = latest
    modes, weights = modes_with_weights(evaluator, modes, prior=settings.prior)
    best = modes[0]
    point, stderr = point_and_stderr(evaluator, best.theta, best.covariance)
    preparations = map(prepared, evaluator.likelihoods)
    findings = [*spent, *(finding for p in preparations for finding in p.findings)]
    n_known = len(modes) if is_supported else 1  # the other modes are spurious
    if not is_supported:
        findings += report(_UNSUPPORTED)
    findings += report(*_findings(evaluator, objective, modes[:n_known], weights[:n_known]))
    local_optima = tuple(
        local_optimum(evaluator, mode.theta, mode.value, comparable=mode.value - best.value < 6.0)
        | {"weight": float(weight)}
        for mode, weight in zip(modes[1:], weights[1:], strict=True)
    )
    log_likelihoods = specimen_log_likelihoods(evaluator, best.theta[None])
    # The covariance is NaN at the edge of a support.
    is_jump = np.isnan(best.covariance).any()
    is_converged = best.converged and not is_jump and is_supported
    return Optimum(
        point=point,
        stderr=stderr,
        theta=best.theta,
        covariance=best.covariance,
        evaluator=evaluator,
        discrepancy=best.value,
        discrepancies={name: -float(v.sum()) for name, v in log_likelihoods.items()},
        scales=dict.fromkeys(log_likelihoods, 1.0),
        n_responses=evaluator.n_responses - n_previous,
        search=SearchRecord(
            result=Result.CONVERGED if is_converged else Result.FAILED,
            prior=settings.prior,
            details=f"{counted(len(modes), 'local optimum', 'local optima')} "
            f"from {counted(len(starts), 'start')}.",
            n_evaluations=objective.count,
            n_screened=n_screened,
            n_computed=n_computed(evaluator),
            seconds=time.perf_counter() - clock,
            trace=objective.trace(best.steps),
            identity=identity_of(evaluator, prior_minimised=settings.prior),
        ),
        local_optima=local_optima,
        findings=tuple(findings),
    )


def modes_with_weights(
    evaluator: Evaluator, modes: list[Mode], *, prior: bool
) -> tuple[list[Mode], Floats]:
    """Return optima, best first, and their shares in the posterior's mass.

    Of optima that the likelihood does not separate, such as mirror populations, the best is the one
    with the largest share: rounding would decide otherwise.
    """
    if prior or len(modes) == 1:
        return modes, mode_weights(modes)
    hyperparameters = evaluator.hyperparameters
    log_prior = hyperparameters.log_prior(np.stack([mode.theta for mode in modes]))
    weights = mode_weights(modes, log_prior, hyperparameters.prior_sd)
    errors = [likelihood.options.half_difference for likelihood in evaluator.likelihoods]
    is_tied = [mode.value <= modes[0].value + np.linalg.norm(errors) for mode in modes]
    first = int(np.argmax(np.where(is_tied, weights, -1.0)))
    order = [first, *(k for k in range(len(modes)) if k != first)]
    return [modes[k] for k in order], weights[order]


_UNSUPPORTED = Finding(
    "narrow-population",
    "The likelihood is largest for a population that is narrower than the distances between the "
    "points of the specimens, where its value is not known to half a nat: the data do not bound "
    "the spread of an input from below. Sample the posterior with prb.sample, or fix the spread.",
    "likelihood_findings.md#narrow-population",
)


def _monte_carlo_errors(evaluator: Evaluator, thetas: Floats) -> Floats:
    """Return the Monte Carlo error of the log-likelihood at thetas, (M, d), in nats."""
    values = variables_at(evaluator.hyperparameters, thetas)
    variance = sum(monte_carlo_error(item, values) ** 2 for item in evaluator.likelihoods)
    return np.asarray(np.sqrt(variance))


def _known(errors: Floats, n_specimens: int) -> Bools:
    """Return which log-likelihoods, (M,), are known, from their Monte Carlo errors.

    A log-likelihood with a Monte Carlo error of more than half a nat shows a spurious maximum: a
    population that is narrower than the distances between points can have most of its density at a
    few points. With many specimens the limit is a tenth of a nat for each, in quadrature. The error
    for rounded readings is .06 nats a specimen.
    """
    limit = max(0.5, 0.1 * float(np.sqrt(n_specimens)))
    return np.asarray(errors <= limit)


def is_known_at(evaluator: Evaluator, thetas: Floats) -> Bools:
    """Return at which thetas, (M, d), the points determine the log-likelihoods by specimen."""
    if not len(thetas):
        return np.ones(0, dtype=bool)
    errors = _monte_carlo_errors(evaluator, thetas)
    of_each = np.broadcast_to(errors, len(thetas))
    return _known(of_each, _n_readings(evaluator))


def determined_modes(evaluator: Evaluator, modes: Sequence[Laplace]) -> list[Laplace]:
    """Return the modes at which the points determine the log-likelihoods by specimen."""
    centers = np.array([mode.mode for mode in modes])
    is_known = is_known_at(evaluator, centers)
    return [mode for mode, ok in zip(modes, is_known, strict=True) if ok]


def _n_readings(evaluator: Evaluator) -> int:
    """Return the number of specimens of all log-likelihoods."""
    return sum(len(likelihood.readings) for likelihood in evaluator.likelihoods)


def _supported(values: Floats, errors: Floats, n_specimens: int) -> Bools:
    """Return which optima, (M,), are not spurious, from their values and Monte Carlo errors.

    A maximum is too high rather than too low: so the best optimum is the best after two errors are
    subtracted, and what seems better is left out.
    """
    is_known = _known(errors, n_specimens)
    if not is_known.any():
        return is_known
    best = np.argmin(np.where(is_known, values + 2 * errors, np.inf))
    return np.asarray(is_known & (values >= values[best]))


def supported_modes(
    evaluator: Evaluator, objective: _Objective, optima: Sequence[Mode]
) -> tuple[list[Mode], bool]:
    """Return the distinct optima, best first, without spurious ones, and whether any is supported.

    If all optima are spurious, none is left out.
    """
    # Monte Carlo errors of the points make ripples on a ridge, which are no barriers.
    errors = [
        max(prepared(likelihood).points.difference, likelihood.options.half_difference)
        for likelihood in evaluator.likelihoods
    ]
    values = np.array([optimum.value for optimum in optima])
    thetas = np.stack([optimum.theta for optimum in optima])
    errors_of_points = _monte_carlo_errors(evaluator, thetas)
    is_supported = _supported(values, errors_of_points, _n_readings(evaluator))
    if is_supported.any():
        optima = [optimum for optimum, ok in zip(optima, is_supported, strict=True) if ok]
    modes = _distinct(optima, objective, 3 * float(np.linalg.norm(errors)))
    return modes, bool(is_supported.any())


def mode_weights(
    modes: list[Mode], log_prior: Floats | None = None, prior_sd: Floats | None = None
) -> Floats:
    """Return the share of each mode in the posterior's mass, by Laplace's approximation.

    ``log_prior``, (M,), is added if the optima are those of the likelihood. ``prior_sd``, (d,),
    then bounds the mass.
    """
    logs = np.array([-mode.value for mode in modes])
    if log_prior is not None:
        logs = logs + log_prior
    for k, mode in enumerate(modes):
        covariance = mode.covariance
        if np.isnan(covariance).any():
            continue
        is_unidentified = np.isinf(np.diag(covariance))
        covariance = np.where(np.isinf(covariance), 0.0, covariance)
        if prior_sd is not None:
            covariance = covariance + 1e6 * np.diag(is_unidentified * prior_sd**2)
            precision = np.linalg.inv(covariance) + np.diag(prior_sd**-2.0)
            logs[k] -= np.linalg.slogdet(precision)[1] / 2
        elif not is_unidentified.any():
            sign, log_det = np.linalg.slogdet(covariance)
            logs[k] += log_det / 2 if sign > 0 else 0.0
    return normalised_weights(logs)


class _Objective:
    """Minus the log-likelihood or log-posterior, with a trace of its evaluations."""

    def __init__(self, evaluator: Evaluator, prior: bool) -> None:
        self.function = compiled_objective(evaluator, prior=prior, gradient=True)
        self.unit = evaluator.hyperparameters.prior_sd
        self.thetas: list[Floats] = []
        self.values: list[float] = []

    @property
    def count(self) -> int:
        """Number of evaluations."""
        return len(self.values)

    def __call__(self, theta: Floats) -> tuple[float, Floats]:
        """Return value and gradient at theta; +inf outside the support."""
        # because the value is +inf far from the data
        with np.errstate(over="ignore", invalid="ignore"):
            value, gradient = self.function(theta, np.empty(0))
        value = float(value) if np.isfinite(value) else np.inf
        self.thetas.append(theta.copy())
        self.values.append(value)
        return value, np.where(np.isfinite(gradient), gradient, 0.0)

    def trace(self, steps: slice) -> NamedArrays:
        """Return the points of one descent."""
        return {
            "theta": np.array(self.thetas[steps]),
            "discrepancy": np.array(self.values[steps]),
            "evaluations": np.arange(1, self.count + 1)[steps],
        }


def _starts(evaluator: Evaluator, settings: Any) -> tuple[list[Floats], int]:
    """Return the user's start, or likely points of the prior, and the number screened."""
    hyperparameters = evaluator.hyperparameters
    if settings.start is not None:
        return [unconstrained(hyperparameters, settings.start)], 0
    n_screened = 1024
    thetas = hyperparameters.prior_points(n_screened, settings.random_seed)
    values = evaluator.total(thetas, np.empty(0))
    order = np.argsort(values, kind="stable")
    order = order[np.isfinite(values[order])]
    if not order.size:
        return [hyperparameters.initial], n_screened
    # Start at the best point, and at points of the better quarter that are far from each other.
    n_starts = 8 if settings.starts is None else max(1, settings.starts)
    candidates = thetas[order[: max(n_starts, order.size // 4)]]
    return list(far_apart(candidates, n_starts, hyperparameters.prior_sd)), n_screened


def _descend(objective: _Objective, start: Floats, settings: Any) -> Mode:
    """Return the local minimum that BFGS reaches, with its inverse Hessian."""
    from scipy.optimize import minimize as scipy_minimize

    unit, first = objective.unit, objective.count

    def standardised(u: Floats) -> tuple[float, Floats]:
        value, gradient = objective(u * unit)
        return value, gradient * unit

    remaining = max(10, settings.max_evaluations - objective.count)
    result = scipy_minimize(
        standardised,
        start / unit,
        jac=True,
        method="BFGS",
        options={"gtol": settings.tolerance * 100, "maxiter": remaining},
    )
    theta = result.x * unit
    value, _ = objective(theta)
    if not result.success and np.isfinite(value):
        # With a moving support the optimum is at a jump: continue without gradients.
        simplex = scipy_minimize(
            lambda u: objective(u * unit)[0],
            theta / unit,
            method="Nelder-Mead",
            options={"maxfev": min(remaining, 200 * theta.size), "xatol": 1e-8, "fatol": 1e-8},
        )
        if simplex.fun < value - 1e-6:
            theta = simplex.x * unit
            value, _ = objective(theta)
    steps = slice(first, objective.count)
    covariance, slope = _inverse_hessian(objective, theta)
    return Mode(theta, value, covariance, bool(slope < 0.05), steps)


def _inverse_hessian(objective: _Objective, theta: Floats) -> tuple[Floats, float]:
    """Return the inverse Hessian, and the gradient in standard errors.

    Infinite along directions without curvature; NaN where the log-likelihood jumps.
    """
    unit, unknown = objective.unit, np.full((theta.size, theta.size), np.nan)
    hessian = _hessian(objective, theta)
    if hessian is None:
        return unknown, np.inf
    values, vectors = np.linalg.eigh(hessian * np.outer(unit, unit))
    if values.min() < -1e-3 * max(values.max(), 1.0):
        return unknown, np.inf
    # Directions with less than a twenty-fifth of the prior's curvature are not identified.
    is_flat = values < 1.0 / 25
    inverse = np.where(is_flat, 0.0, 1 / np.where(is_flat, 1.0, values))
    covariance = (vectors * inverse) @ vectors.T
    # Measure the slope along flat directions in units of the prior, because a point with a slope
    # there is no optimum.
    _, gradient = objective(theta)
    along = vectors.T @ (gradient * unit)
    slope = float(np.sqrt((along**2 * np.where(is_flat, 1.0, inverse)).sum()))
    covariance = covariance * np.outer(unit, unit)
    is_touched = (np.abs(vectors[:, is_flat]) > 1e-3).any(axis=1)
    covariance[np.ix_(is_touched, is_touched)] = np.inf
    return covariance, slope


def _hessian(objective: _Objective, theta: Floats) -> Floats | None:
    """Return central differences of the gradient, or None where the objective is not finite.

    The steps are a hundredth of a standard error. They are wider where the objective has kinks, as
    that of a Laplace population.
    """
    step = 1e-3 * objective.unit
    hessian = _differences(objective, theta, step)
    for _ in range(2):
        if hessian is None:
            return None
        curvature = np.maximum(np.diag(hessian), 1e-4 / objective.unit**2)
        better_step = 0.01 / np.sqrt(curvature)
        if np.all((better_step / step < 10) & (step / better_step < 10)):
            break
        step = better_step
        hessian = _differences(objective, theta, step)
    if hessian is None:
        return None
    wide_step = _widened(objective, theta, step, hessian)
    if np.array_equal(wide_step, step):
        return hessian
    return _differences(objective, theta, wide_step)


def _differences(objective: _Objective, theta: Floats, step: Floats) -> Floats | None:
    """Return the symmetric differences of the gradient, or None where it is not finite."""
    rows = []
    for j, shift in enumerate(np.diag(step)):
        ahead, up = objective(theta + shift)
        behind, down = objective(theta - shift)
        if not (np.isfinite(ahead) and np.isfinite(behind)):
            return None
        rows.append((up - down) / (2 * step[j]))
    hessian = np.array(rows)
    return np.asarray((hessian + hessian.T) / 2)


def _widened(objective: _Objective, theta: Floats, step: Floats, hessian: Floats) -> Floats:
    """Return steps over which an objective with kinks rises by two nats on both sides.

    At kinks differences over small steps are too large, and between them zero: one standard error
    away the objective has not risen.
    """
    result = step.copy()
    value, _ = objective(theta)
    for j, unit in enumerate(np.diag(objective.unit)):
        curvature = unit @ hessian @ unit
        if curvature > 1.0 / 25:
            rises = _values_beside(objective, theta, unit / np.sqrt(curvature)) - value
            if not rises.mean() < 0.25:  # half of the rise that the curvature predicts
                continue
        for width in 2.0 ** np.arange(-12, 1):
            rises = _values_beside(objective, theta, width * unit) - value
            if np.isfinite(rises).all() and rises.min() >= 2.0:
                result[j] = width * unit[j]
                break
    return result


def _values_beside(objective: _Objective, theta: Floats, shift: Floats) -> Floats:
    """Return the objective on both sides of theta, (2,)."""
    return np.array([objective(theta + shift)[0], objective(theta - shift)[0]])


def _distinct(optima: Sequence[Mode], objective: _Objective, error: float) -> list[Mode]:
    """Return the modes within 30 nats of the best optimum, best first.

    Optima closer than a hundredth of the prior's width are the same.
    """
    ordered = sorted((o for o in optima if np.isfinite(o.value)), key=lambda o: o.value)
    if not ordered:
        return list(optima[:1])
    modes = ordered[:1]
    for optimum in ordered[1:]:
        if optimum.value > ordered[0].value + 30 or not optimum.converged:
            continue
        distances = [np.abs((optimum.theta - mode.theta) / objective.unit).max() for mode in modes]
        if min(distances) > 0.01 and not any(
            share_mode(objective, objective.unit, mode, optimum, error) for mode in modes
        ):
            modes.append(optimum)
    return modes


def share_mode(
    objective: Callable[[Floats], tuple[float, Floats]],
    unit: Floats,
    first: Mode,
    second: Mode,
    barrier: float,
) -> bool:
    """Return whether two optima belong to one mode: no barrier, in nats, lies between them.

    The profile along the straight line takes the smallest value across it, so that a ridge is one
    mode.
    """
    from scipy.linalg import null_space
    from scipy.optimize import minimize as scipy_minimize

    start, step = first.theta / unit, (second.theta - first.theta) / unit
    across = null_space(step[None])
    height = max(first.value, second.value) + barrier

    def profile(u: Floats, at: Floats) -> tuple[float, Floats]:
        value, gradient = objective((at + across @ u) * unit)
        return value, across.T @ (gradient * unit)

    # begins in the middle, where a barrier is likely
    for share in (0.5, 0.25, 0.75, 0.125, 0.375, 0.625, 0.875):
        at, offset = start + share * step, np.zeros(across.shape[1])
        value, _ = profile(offset, at)
        if value > height and offset.size:
            # Start off the line, on which a symmetric objective has no slope.
            value = scipy_minimize(profile, offset + 0.01, args=(at,), jac=True, method="BFGS").fun
        if value > height:
            return False
    return True


def _findings(
    evaluator: Evaluator, objective: _Objective, modes: list[Mode], weights: Floats
) -> list[Finding]:
    """Report a failing region, ends of priors, several modes and what is not identified."""
    best = modes[0]
    refuse_lost_specimens(evaluator, best.theta)
    is_flat = np.isinf(np.diag(best.covariance))
    # A rise of three nats is a likelihood ratio of twenty.
    ends = elements_at_prior_ends(evaluator, best.theta, is_flat, lambda t: objective(t)[0], 3.0)
    findings = [*failing_region_findings(evaluator, best.theta)]
    findings += replaced_findings(evaluator, best.theta)
    findings += few_specimens(evaluator)
    if np.isnan(best.covariance).any():
        findings.append(
            Finding(
                "support-edge",
                "The likelihood jumps at the optimum, where the end of an input's support meets a "
                "specimen, so that its curvature gives no standard errors. Sample with "
                "prb.sample_smc.",
                "likelihood_findings.md#moving-supports",
            )
        )
    names = np.array(evaluator.hyperparameters.readable_names)
    is_direct = ~only_through_prior(evaluator)
    unidentified = names[is_flat & is_direct].tolist()
    bounds = one_sided_bounds(
        evaluator, best.theta, is_flat & is_direct, partial(_signed_root, objective, best)
    )
    one_sided, excluded = end_and_bound_findings(ends, bounds)
    findings += one_sided
    flat = [name for name in unidentified if name not in excluded]
    if flat:
        findings.append(
            Finding(
                "not-identified",
                f"The data do not identify {', '.join(flat)}; values at the optimum are arbitrary, "
                "and the posterior keeps the prior there.",
                "likelihood_findings.md#identification",
            )
        )
    second_modes = [(m, w) for m, w in zip(modes[1:], weights[1:], strict=True) if w >= 0.01]
    for mode, weight in second_modes:
        findings.append(
            Finding(
                "second-mode",
                f"A second optimum at {point_text(evaluator, mode.theta)} has {weight:.0%} of the "
                "posterior's mass; NUTS chains may stay in the mode where they start; "
                "prb.sample_smc samples both.",
                "likelihood_findings.md#several-modes",
            )
        )
    is_too_small = _too_small_errors(evaluator.hyperparameters, objective, best)
    too_small = [name for name in names[is_too_small] if name not in excluded]
    if too_small and not second_modes:
        findings.append(
            Finding(
                "flat-likelihood",
                f"The likelihood of {', '.join(too_small)} is more than three times as wide as "
                "the standard error: values four standard errors from the optimum are nearly as "
                "likely. Report intervals of prb.sample.",
                "likelihood_findings.md#flat-likelihood",
            )
        )
    return findings


def _too_small_errors(hyperparameters: Hyperparameters, objective: _Objective, best: Mode) -> Bools:
    """Return which standard errors, (d,), are less than a third as wide as the likelihood.

    The root of the profile likelihood ratio four standard errors away is compared with four, or
    with the distance in the user's units where that is shorter, as from a spread to zero. Where a
    population is normal, the root is at least half as large, also with three specimens.
    """
    size = best.theta.size
    is_too_small = np.zeros(size, dtype=bool)
    for i in range(size):
        variance = best.covariance[i, i]
        if not 0 < variance < np.inf:
            continue
        # Move the other elements to their conditional optima under a normal likelihood.
        step = np.nan_to_num(best.covariance[i], posinf=0.0) / np.sqrt(variance)
        thetas = [best.theta + shift * step for shift in (0.0, 0.01, -4.0, 4.0)]
        values = [ends_of_prior(hyperparameters, theta)[0][i] for theta in thetas]
        # The unit is bounded, because a transform may saturate.
        unit = max(abs(values[1] - values[0]) / 0.01, 1e-300)
        for theta, value in zip(thetas[2:], values[2:], strict=True):
            distance = np.fmin(abs(value - values[0]) / unit, 4.0)
            if _signed_root(objective, best, theta, i) < distance / 3:
                is_too_small[i] = True
    return is_too_small


def _signed_root(objective: _Objective, best: Mode, theta: Floats, i: int) -> float:
    """Return the signed root of the profile likelihood ratio at theta's i-th element."""
    from scipy.optimize import minimize as scipy_minimize

    rest = np.arange(theta.size) != i

    def profile(u: Floats) -> tuple[float, Floats]:
        place = theta.copy()
        place[rest] += u * objective.unit[rest]
        value, gradient = objective(place)
        return value, gradient[rest] * objective.unit[rest]

    value, _ = profile(np.zeros(theta.size - 1))
    if theta.size > 1 and np.isfinite(value):
        value = scipy_minimize(profile, np.zeros(theta.size - 1), jac=True, method="BFGS").fun
    return float(np.sqrt(2 * max(value - best.value, 0.0)))


def specimen_refit_obstacle(evaluator: Evaluator) -> str | None:
    """Return why a model of log-likelihoods by specimen cannot be fitted to other data, or None."""
    others = len(evaluator.model.observed_RVs) > len(evaluator.measurements)
    if others or evaluator.model.potentials:
        return (
            "the model has likelihood terms or potentials besides its log-likelihoods by specimen"
        )
    return None


def simulation_obstacle(evaluator: Evaluator) -> str | None:
    """Return why data sets cannot be simulated from a model, or None."""
    obstacle = specimen_refit_obstacle(evaluator)
    if obstacle is not None:
        return obstacle
    for likelihood in evaluator.likelihoods:
        if has_random_response(likelihood):
            return f"the response of {likelihood.name} is random"
        if likelihood.readings.is_censored.any():
            return f"readings of {likelihood.name} are censored, and new ones cannot be drawn"
        is_measured = likelihood.readings.is_measured
        if (is_measured.sum(axis=1) < len(likelihood.coordinates.inputs_of_population)).any():
            return f"specimens of {likelihood.name} have fewer readings than inputs"
        if not likelihood.error_is_known:
            return f"the error of the readings of {likelihood.name} is unknown"
    return None


type SpecimenData = tuple[list[Floats], Floats]
"""Points, (N, K, *event) by input, and numbers A, (N, K), of the specimens of a likelihood."""


@dataclass(frozen=True, eq=False)
class _Copies:
    """Draws of the hyperparameters, for several copies of the specimens."""

    draws: PopulationDraws
    n: int  # number of specimens

    @property
    def thetas(self) -> Floats:
        """The draws, (S, p)."""
        return self.draws.thetas

    def log_likelihoods(self, z: Floats, log_a: Floats) -> Floats:
        """Return log p(y_i | theta) of all copies, (S, copies * n)."""
        copies = [slice(first, first + self.n) for first in range(0, len(z), self.n)]
        return np.concatenate([self.draws.log_likelihoods(z[k], log_a[k]) for k in copies], axis=1)

    def specimens(self) -> Floats:
        """Return coordinates of specimens, (n, d)."""
        return self.draws.specimens()


def specimen_pool(
    likelihood: SpecimenLikelihood,
    values: ArraysByName,
    rng: np.random.Generator,
    size: int = 2000,
) -> Callable[[np.random.Generator], SpecimenData]:
    """Simulate at least ``size`` specimens of one population, with their points.

    ``values`` are those of the model's variables by name, (1, *shape). Return a function
    that draws a data set: for each observed specimen one with its group and missing outputs.
    """
    n = len(likelihood.readings)
    copies = max(1, -(-size // n))
    drawn = draw_readings(likelihood, rng, values, copies * n)[0].reshape(copies * n, -1)
    observed = likelihood.readings.rows(np.tile(np.arange(n), copies))
    readings = with_values(observed, drawn)
    data, preparation = specimen_data(likelihood), prepared(likelihood)
    # The tolerance is that of the log-likelihood of a data set, not of the pool.
    tolerance = data.options.half_difference * np.sqrt(copies)
    data = replace(
        data,
        readings=readings,
        known=np.tile(data.known, (copies, 1)),
        columns=None if data.columns is None else np.tile(data.columns, (copies, 1)),
        options=replace(data.options, half_difference=tolerance),
        seed=1,
    )
    assert preparation.proposals is not None  # `simulation_obstacle` excludes random responses
    proposals = fit_proposals(
        data,
        replace(preparation.emulation, offsets=None),
        preparation.proposals.residuals.population,
    )
    draws = _Copies(PopulationDraws(SpecimenPopulations(likelihood), preparation.thetas), n)
    points, _ = agreeing_points(data, proposals, data.options.points, draws)
    log_a = points.log_a + likelihood.coordinates.log_jacobian(points.z)
    inputs = likelihood.coordinates.inputs(points.z)

    def data_set(rng: np.random.Generator) -> SpecimenData:
        rows = rng.integers(0, copies, n) * n + np.arange(n)
        return [x[rows] for x in inputs], log_a[rows]

    return data_set


def _in_one_list(data: Iterable[tuple[list[Any], Any]]) -> list[Any]:
    """Return points and numbers A, by likelihood, in one list."""
    result = []
    for points, log_a in data:
        result += points
        result.append(log_a)
    return result


@contextmanager
def other_specimens(
    likelihoods: Sequence[SpecimenLikelihood], data: Sequence[SpecimenData]
) -> Iterator[None]:
    """Give compiled likelihoods the points and numbers A of other specimens within the context."""
    variables = _in_one_list(map(arrays, likelihoods))
    values = _in_one_list(data)
    originals = [variable.get_value() for variable in variables]
    try:
        for variable, value in zip(variables, values, strict=True):
            variable.set_value(np.ascontiguousarray(value), borrow=True)
        yield
    finally:
        for variable, value in zip(variables, originals, strict=True):
            variable.set_value(value, borrow=True)


@dataclass(frozen=True, eq=False)
class SpecimenRefits:
    """Maximum-likelihood estimates around an optimum."""

    evaluator: Evaluator
    theta: Floats  # (d,): start of all estimates
    covariance: Floats  # (d, d): unit of the parameters, or the prior's spread if not finite

    def _function(self, *, same_specimens: bool) -> Any:
        """Compile (thetas, *weights, *points and A) -> minus the log-likelihoods, gradients.

        A row is a data set. Without points the specimens are those of the evaluator.
        """
        evaluator = self.evaluator
        key = f"weighted log-likelihoods, {same_specimens=}"
        if key in evaluator.functions:
            return evaluator.functions[key]
        with interpreted():
            graphs = specimen_graphs(evaluator)
            weights = [pt.dvector(f"weights_{k}") for k in range(len(graphs))]
            terms = [
                pt.switch(pt.gt(w, 0), w * g, 0.0).sum()
                for w, g in zip(weights, graphs, strict=True)
            ]
            (value,), theta = evaluator.hyperparameters.joined([-sum(terms)])
            gradient = pt.grad(value, theta)
            symbols = [theta, *weights]
            if not same_specimens:
                symbols += _in_one_list(map(arrays, evaluator.likelihoods))
            evaluator.functions[key] = compile_batched(symbols, [value, gradient])
        return evaluator.functions[key]

    @cached_property
    def _root(self) -> Floats:
        """Root of the covariance: estimates are searched in its units, (d, d)."""
        if np.isfinite(self.covariance).all():
            values, vectors = np.linalg.eigh(self.covariance)
            if values.min() > 0:
                return vectors * np.sqrt(values)
        return np.diag(self.evaluator.hyperparameters.prior_sd)

    def fit(self, weights: Sequence[Floats], data: Sequence[Floats] = ()) -> tuple[Floats, Bools]:
        """Return estimates of B data sets, (B, d), and whether their searches converged.

        ``weights``, (B, N) by likelihood, have the sum N in each row. ``data`` are points, (B, N,
        K, *event), and numbers A, (B, N, K), of other specimens.
        """
        root = self._root
        function = self._function(same_specimens=not data)

        def problem(u: Floats, rows: Indices) -> ArrayPair:
            arguments = [array[rows] for array in (*weights, *data)]
            with np.errstate(over="ignore", invalid="ignore"):  # far from the data
                values, gradients = function(self.theta + u @ root.T, *arguments)
            gradients = np.where(np.isfinite(gradients), gradients, 0.0)
            values = np.where(np.isfinite(values), values, np.inf)
            return values, gradients @ root

        start = np.zeros((len(weights[0]), self.theta.size))
        u, *_ = descend_by_slopes(
            problem, start, np.eye(self.theta.size), tolerance=5e-7, max_iterations=200
        )
        values, slopes = problem(u, np.arange(len(u)))
        steepest = np.abs(slopes).max(axis=1, initial=0.0)
        converged = np.isfinite(values) & (steepest < 0.05)
        return self.theta + u @ root.T, converged

    def _blocks(self, size: int) -> list[Indices]:
        """Return the numbers of the data sets that are fitted at once."""
        n_values = 0
        for _, log_a in map(arrays, self.evaluator.likelihoods):
            n_values += log_a.get_value(borrow=True).size
        at_once = max(1, IN_CACHE // n_values)
        return np.split(np.arange(size), np.arange(at_once, size, at_once))

    def simulated(self, draws: int, seed: int) -> Iterator[tuple[Floats, bool, list[SpecimenData]]]:
        """Yield estimates of simulated data sets, whether they converged, and the data."""
        evaluator = self.evaluator
        rng = np.random.default_rng([seed, 21])
        values = variables_at(evaluator.hyperparameters, self.theta[None])
        pools = [specimen_pool(likelihood, values, rng) for likelihood in evaluator.likelihoods]
        rng = np.random.default_rng([seed, 22])
        sizes = [len(likelihood.readings) for likelihood in evaluator.likelihoods]
        for block in self._blocks(draws):
            data = []
            rows = []
            for _ in block:
                data_set = [pool(rng) for pool in pools]
                data.append(data_set)
                rows.append(_in_one_list(data_set))
            stacked = [np.stack(column) for column in zip(*rows, strict=True)]
            weights = [np.ones((len(block), size)) for size in sizes]
            thetas, converged = self.fit(weights, stacked)
            yield from zip(thetas, converged, data, strict=True)

    def reweighted(self, weights: Arrays) -> tuple[Floats, Bools]:
        """Return estimates of weighted data sets, (S, d), and which converged.

        ``weights``, (S, n_k), are of the specimens of each of `Evaluator.emulated`, with any sum.
        """
        by_likelihood = []
        emulated = self.evaluator.emulated
        for likelihood in self.evaluator.likelihoods:
            factors = np.zeros((len(weights[0]), len(likelihood.readings)))
            count = np.zeros(len(likelihood.readings))
            for simulator, part in zip(emulated, weights, strict=True):
                if simulator.likelihood is likelihood:
                    specimens = specimen_numbers(likelihood, simulator.measurement)[simulator.rows]
                    np.add.at(factors.T, specimens, part.T * len(specimens))
                    np.add.at(count, specimens, 1)
            factors /= count
            stated = likelihood.measurements[0].weights
            if stated is not None:  # the likelihood contains stated weights, and so do the factors
                factors = factors / positive_scale(stated)
            by_likelihood.append(factors)
        blocks = self._blocks(len(weights[0]))
        estimates = [self.fit([factors[block] for factors in by_likelihood]) for block in blocks]
        thetas, converged = zip(*estimates, strict=True)
        return np.concatenate(thetas), np.concatenate(converged)


def is_specimen_optimum(result: object) -> bool:
    """Return whether a result is an optimum of log-likelihoods by specimen without a metric."""
    return isinstance(result, Optimum) and not result.evaluator.nodes


def specimen_refits(optimum: Optimum, caller: str, *, simulated: bool = False) -> SpecimenRefits:
    """Return the refits around an optimum, or raise if the model cannot be fitted to other data."""
    evaluator = require_sampling(optimum, caller).evaluator
    find = simulation_obstacle if simulated else specimen_refit_obstacle
    obstacle = find(evaluator)
    if obstacle is not None:
        raise ValueError(f"{caller}: {obstacle}; use prb.sample_smc")
    return SpecimenRefits(evaluator, optimum.theta, optimum.covariance)
