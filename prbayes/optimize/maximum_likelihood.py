"""Maximum likelihood for models whose observed variables have exact log-densities.

BFGS with exact gradients from the most likely points of the prior. Every local optimum is kept with
its weight, the share of the posterior mass by Laplace's approximation.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from prbayes._finding import Finding, report
from prbayes._validate import Floats
from prbayes.inference.checks.failing_region import failing_region_findings
from prbayes.inference.checks.prior_ends import PriorEnd, end_of_range, prior_end_findings
from prbayes.model.evaluator import Evaluator, specimen_log_likelihoods
from prbayes.model.fingerprint import identity_of
from prbayes.model.parameters import THETAS
from prbayes.model.specimen_preparation import prepared
from prbayes.numerics.derivatives import cross, slopes
from prbayes.optimize.optimum import Optimum, plain


@dataclass(frozen=True, eq=False)
class LocalOptimum:
    """A local minimum of minus the log-likelihood, or of minus the log-posterior.

    Attributes
    ----------
    theta : ndarray, shape (d,)
        In unconstrained space.
    value : float
    covariance : ndarray, shape (d, d)
        Inverse Hessian; infinite along directions without curvature, NaN at the edge of a support.
    converged : bool
    steps : slice
        Its evaluations of the objective, without those of the Hessian.
    """

    theta: Floats
    value: float
    covariance: Floats
    converged: bool
    steps: slice = slice(0)


def maximize_likelihood(evaluator: Evaluator, options: Any) -> Optimum:
    """Return the maximum of the likelihood, times the prior where that is asked for.

    Parameters
    ----------
    evaluator : Evaluator
        Of a model without a metric of distributions.
    options : Minimisation
        ``start``, ``prior``, ``tolerance``, ``max_evaluations``, ``starts`` and ``random_seed``.
    """
    clock = time.perf_counter()
    before = evaluator.n_responses
    objective = _Objective(evaluator, options.prior)
    starts, screened = _starts(evaluator, options)
    optima = []
    for start in starts:
        optima.append(_descend(objective, start, options))
        if objective.count > options.max_evaluations:
            break
    # Points of specimens have a Monte Carlo error, with which a ridge has ripples.
    errors = [
        max(prepared(x).points.difference, x.options.half_difference) for x in evaluator.likelihoods
    ]
    modes = _distinct(optima, objective, 3 * float(np.linalg.norm(errors)))
    best = modes[0]
    point, stderr = _in_units(evaluator, best.theta, best.covariance)
    ends = _prior_ends(evaluator, best, lambda theta: objective(theta)[0])
    findings = [f for likelihood in evaluator.likelihoods for f in prepared(likelihood).findings]
    weights = _posterior_weights(evaluator, modes, with_prior=options.prior)
    findings += report(*_findings(evaluator, modes, weights, ends))
    rivals = tuple(
        {
            "point": _in_units(evaluator, mode.theta, mode.covariance)[0],
            "discrepancy": mode.value,
            "theta": mode.theta,
            "comparable": mode.value - best.value < 6.0,
            "weight": float(weight),
        }
        for mode, weight in zip(modes[1:], weights[1:], strict=True)
    )
    values = specimen_log_likelihoods(evaluator, best.theta[None])
    identified = np.isfinite(best.covariance).all()
    message = "Converged: " if best.converged else "Not converged: "
    message += f"{len(modes)} local optimum(s) from {len(starts)} starts."
    return Optimum(
        point=point,
        discrepancy=best.value,
        discrepancies={name: -float(v.sum()) for name, v in values.items()},
        scales=dict.fromkeys(values, 1.0),
        n_evaluations=objective.count,
        n_screened=screened,
        n_responses=evaluator.n_responses - before,
        converged=best.converged and bool(identified or np.isinf(best.covariance).any()),
        message=message,
        stderr=stderr,
        covariance=best.covariance,
        theta=best.theta,
        names=evaluator.hyperparameters.names,
        evaluator=evaluator,
        trace=objective.trace(best.steps),
        seconds=time.perf_counter() - clock,
        rivals=rivals,
        findings=tuple(findings),
        prior=options.prior,
        identity=identity_of(evaluator, prior_minimised=options.prior),
    )


def _posterior_weights(
    evaluator: Evaluator, modes: list[LocalOptimum], *, with_prior: bool
) -> Floats:
    """Return the share of each mode in the posterior's mass."""
    if with_prior or len(modes) == 1:
        return mode_weights(modes)
    log_prior = evaluator.hyperparameters.log_prior(np.stack([mode.theta for mode in modes]))
    return mode_weights(modes, log_prior, evaluator.hyperparameters.prior_sd)


def mode_weights(
    modes: list[LocalOptimum], log_prior: Floats | None = None, prior_sd: Floats | None = None
) -> Floats:
    """Return the share of each mode in the posterior's mass, by Laplace's approximation.

    Parameters
    ----------
    modes : list of LocalOptimum
    log_prior : ndarray, shape (M,), optional
        Log-density of the prior at each mode, in unconstrained space; none by default, as where
        the optima are those of the posterior.
    prior_sd : ndarray, shape (d,), optional
        Spread of the prior, which bounds the mass along directions that the data do not identify.
    """
    logs = np.array([-mode.value for mode in modes])
    if log_prior is not None:
        logs = logs + log_prior
    for k, mode in enumerate(modes):
        covariance = mode.covariance
        if np.isnan(covariance).any():
            continue
        open_directions = np.isinf(np.diag(covariance))
        covariance = np.where(np.isinf(covariance), 0.0, covariance)
        if prior_sd is not None:
            covariance = covariance + 1e6 * np.diag(open_directions * prior_sd**2)
            precision = np.linalg.inv(covariance) + np.diag(prior_sd**-2.0)
            logs[k] -= np.linalg.slogdet(precision)[1] / 2
        elif not open_directions.any():
            sign, log_det = np.linalg.slogdet(covariance)
            logs[k] += log_det / 2 if sign > 0 else 0.0
    shares = np.exp(logs - logs.max())
    return np.asarray(shares / shares.sum())


class _Objective:
    """Minus the log-likelihood in standardised parameters, with a trace of its evaluations."""

    def __init__(self, evaluator: Evaluator, prior: bool) -> None:
        self.function = evaluator.objective(prior=prior, gradient=True)
        self.unit = evaluator.hyperparameters.prior_sd
        self.count = 0
        self.thetas: list[Floats] = []
        self.values: list[float] = []

    def __call__(self, theta: Floats) -> tuple[float, Floats]:
        """Return value and gradient in unconstrained space; +inf outside the support."""
        value, gradient = self.function(theta, np.empty(0))
        self.count += 1
        value = float(value) if np.isfinite(value) else np.inf
        self.thetas.append(theta.copy())
        self.values.append(value)
        return value, np.where(np.isfinite(gradient), gradient, 0.0)

    def trace(self, steps: slice) -> dict[str, Floats]:
        """Return the points of one descent."""
        return {
            "theta": np.array(self.thetas[steps]),
            "discrepancy": np.array(self.values[steps]),
            "evaluations": np.arange(1, self.count + 1)[steps],
        }


def _starts(
    evaluator: Evaluator, options: Any, screened: int = 1024, descents: int = 8
) -> tuple[list[Floats], int]:
    """Return the given start, or the most likely points of the prior, and the number screened."""
    if options.start is not None:
        return [evaluator.hyperparameters.unconstrained(options.start)], 0
    thetas = evaluator.hyperparameters.prior_points(screened, options.random_seed)
    values = evaluator.total(thetas, np.empty(0))
    order = np.argsort(values, kind="stable")
    count = descents if options.starts is None else max(1, options.starts)
    order = order[np.isfinite(values[order])]
    if not order.size:
        return [evaluator.hyperparameters.initial], screened
    # The best one, and of the better quarter those farthest from all chosen before.
    candidates = thetas[order[: max(count, order.size // 4)]] / evaluator.hyperparameters.prior_sd
    chosen = [0]
    distance = ((candidates - candidates[0]) ** 2).sum(axis=1)
    while len(chosen) < min(count, len(candidates)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, ((candidates - candidates[chosen[-1]]) ** 2).sum(axis=1))
    return list(candidates[chosen] * evaluator.hyperparameters.prior_sd), screened


def _descend(objective: _Objective, start: Floats, options: Any) -> LocalOptimum:
    """Return the local minimum that BFGS finds, with its inverse Hessian."""
    from scipy.optimize import minimize

    unit = objective.unit
    first = objective.count

    def standardised(u: Floats) -> tuple[float, Floats]:
        value, gradient = objective(u * unit)
        return value, gradient * unit

    left = max(10, options.max_evaluations - objective.count)
    result = minimize(
        standardised,
        start / unit,
        jac=True,
        method="BFGS",
        options={"gtol": options.tolerance * 100, "maxiter": left},
    )
    theta = np.asarray(result.x) * unit
    value, _ = objective(theta)
    if not result.success and np.isfinite(value):
        # A support whose end moves has its optimum at a jump: without gradients from there.
        simplex = minimize(
            lambda u: objective(u * unit)[0],
            theta / unit,
            method="Nelder-Mead",
            options={"maxfev": min(left, 200 * theta.size), "xatol": 1e-8, "fatol": 1e-8},
        )
        if simplex.fun < value - 1e-6:
            theta = np.asarray(simplex.x) * unit
            value, _ = objective(theta)
    steps = slice(first, objective.count)
    covariance, slope = _inverse_hessian(objective, theta)
    return LocalOptimum(
        theta=theta,
        value=value,
        covariance=covariance,
        converged=bool(slope < 0.05),
        steps=steps,
    )


def _inverse_hessian(objective: _Objective, theta: Floats) -> tuple[Floats, float]:
    """Return the inverse Hessian, and the gradient in standard errors.

    By central differences of the gradient, with steps of a hundredth of a standard error. Infinite
    along directions without curvature; NaN where the log-likelihood jumps.
    """
    d = theta.size
    unknown = np.full((d, d), np.nan)
    step = 1e-3 * objective.unit
    hessian = unknown
    for _ in range(3):
        rows = []
        for j in range(d):
            shift = np.eye(d)[j] * step
            (ahead, up), (behind, down) = objective(theta + shift), objective(theta - shift)
            if not (np.isfinite(ahead) and np.isfinite(behind)):
                return unknown, np.inf
            rows.append((up - down) / (2 * step[j]))
        hessian = (np.array(rows) + np.array(rows).T) / 2
        curvature = np.maximum(np.diag(hessian), 1e-4 / objective.unit**2)
        new = 0.01 / np.sqrt(curvature)
        if np.all((new / step < 10) & (step / new < 10)):
            break
        step = new
    # In units of the prior.
    unit = objective.unit
    values, vectors = np.linalg.eigh(hessian * np.outer(unit, unit))
    if values.min() < -1e-3 * max(values.max(), 1.0):
        return unknown, np.inf
    # Less curvature than the prior's would have is none that data identify.
    is_flat = values < 1.0 / 25
    inverse = np.where(is_flat, 0.0, 1 / np.where(is_flat, 1.0, values))
    covariance = (vectors * inverse) @ vectors.T
    # Along directions without curvature in units of the prior: a slope there is no optimum.
    _, gradient = objective(theta)
    along = vectors.T @ (gradient * unit)
    slope = float(np.sqrt((along**2 * np.where(is_flat, 1.0, inverse)).sum()))
    covariance = covariance * np.outer(unit, unit)
    touched = (np.abs(vectors[:, is_flat]) > 1e-3).any(axis=1)
    covariance[touched, :] = np.where(touched, np.inf, covariance[touched, :])
    covariance[:, touched] = np.where(touched[:, None], np.inf, covariance[:, touched])
    covariance[touched, touched] = np.inf
    return covariance, slope


def _distinct(
    optima: list[LocalOptimum], objective: _Objective, error: float
) -> list[LocalOptimum]:
    """Return the modes within 30 nats of the best optimum, best first.

    Optima closer than a hundredth of the prior's width are the same.
    """
    ordered = sorted((o for o in optima if np.isfinite(o.value)), key=lambda o: o.value)
    if not ordered:
        return optima[:1]
    modes = ordered[:1]
    for optimum in ordered[1:]:
        if optimum.value > ordered[0].value + 30 or not optimum.converged:
            continue
        away = [np.abs((optimum.theta - mode.theta) / objective.unit).max() for mode in modes]
        if min(away) > 0.01 and not any(
            share_mode(objective, objective.unit, mode, optimum, error) for mode in modes
        ):
            modes.append(optimum)
    return modes


def share_mode(
    objective: Callable[[Floats], tuple[float, Floats]],
    unit: Floats,
    first: LocalOptimum,
    second: LocalOptimum,
    largest: float,
) -> bool:
    """Return whether two optima are of one mode: no barrier lies between them.

    The barrier is that of the profile along the straight line between the optima: the smallest
    value across the line, in units of the prior. So a ridge, straight or curved, is one mode.

    Parameters
    ----------
    objective : callable
        Theta (d,) -> value and gradient.
    unit : ndarray, shape (d,)
        Unit of each parameter.
    first, second : LocalOptimum
    largest : float
        Height above the higher optimum, in nats, from which on it is a barrier.
    """
    from scipy.linalg import null_space
    from scipy.optimize import minimize

    start, step = first.theta / unit, (second.theta - first.theta) / unit
    across = null_space(step[None])
    height = max(first.value, second.value) + largest

    def profile(u: Floats, at: Floats) -> tuple[float, Floats]:
        value, gradient = objective((at + across @ u) * unit)
        return value, across.T @ (gradient * unit)

    for share in (0.5, 0.25, 0.75, 0.125, 0.375, 0.625, 0.875):  # a barrier is likely in the middle
        at, offset = start + share * step, np.zeros(across.shape[1])
        value, _ = profile(offset, at)
        if value > height and offset.size:
            # Off the line, on which a symmetric objective has no slope.
            value = minimize(profile, offset + 0.01, args=(at,), jac=True, method="BFGS").fun
        if value > height:
            return False
    return True


def _in_units(
    evaluator: Evaluator, theta: Floats, covariance: Floats
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return variables in the user's units, and their standard errors by the delta method."""
    step = 1e-4 * evaluator.hyperparameters.prior_sd
    values = evaluator.hyperparameters.constrained(cross(theta, step))
    point = {name: plain(v[0]) for name, v in values.items()}
    stderr = {}
    for name, v in values.items():
        gradient = slopes(v, step)
        infinite = np.isinf(covariance)
        finite = np.where(infinite, 0.0, covariance)
        variance = np.einsum("...i,ij,...j->...", gradient, finite, gradient)
        touched = (np.abs(gradient) * np.isinf(np.diag(covariance))).sum(axis=-1) > 0
        stderr[name] = plain(np.where(touched, np.inf, np.sqrt(np.maximum(variance, 0.0))))
    return point, stderr


def _prior_ends(
    evaluator: Evaluator, optimum: LocalOptimum, objective: Callable[[Floats], float]
) -> list[PriorEnd]:
    """Return the hyperparameters that the data push to a finite end of their prior.

    In unconstrained space the end is at infinity, and nothing changes on the way there. Back at the
    middle of the prior the log-likelihood is lower by more than three nats, whatever the others do.
    """
    from scipy.optimize import minimize

    theta, unit = optimum.theta, evaluator.hyperparameters.prior_sd
    flat = np.flatnonzero(np.isinf(np.diag(optimum.covariance)))
    ends = []
    prior = (
        evaluator.hyperparameters.prior_thetas(THETAS, 0)
        if flat.size
        else np.empty((0, theta.size))
    )
    for i in flat.tolist():
        below = float((prior[:, i] <= theta[i]).mean())
        if 0.05 <= below <= 0.95:
            continue
        value, bound = end_of_range(evaluator, theta, i, is_upper=below > 0.5)
        if not np.isfinite(bound):
            continue
        start = theta.copy()
        start[i] = np.median(prior[:, i])

        def along(u: Floats, start: Floats = start, i: int = i) -> float:
            return objective(start + np.insert(u, i, 0.0) * unit)

        nothing = np.zeros(theta.size - 1)
        back = along(nothing)
        if theta.size > 1 and np.isfinite(back):
            options = {"maxfev": 100 * theta.size, "xatol": 1e-2, "fatol": 1e-2}
            back = minimize(along, nothing, method="Nelder-Mead", options=options).fun
        if back > optimum.value + 3.0:
            ends.append(PriorEnd(evaluator.hyperparameters.readable_names[i], value, bound))
    return ends


def _findings(
    evaluator: Evaluator, modes: list[LocalOptimum], weights: Floats, ends: list[PriorEnd]
) -> list[Finding]:
    """Report a failing region, ends of priors, several modes and what is not identified."""
    best = modes[0]
    findings = list(failing_region_findings(evaluator, best.theta))
    findings += prior_end_findings(ends)
    if np.isnan(best.covariance).any():
        findings.append(
            Finding(
                "support-edge",
                "The likelihood jumps at the optimum, as it does where the end of an input's "
                "support meets a specimen; no standard errors follow from its curvature. Sample "
                "with prb.sample_smc.",
                "likelihood.md#moving-supports",
            )
        )
    flat = [
        name
        for name, v in zip(
            evaluator.hyperparameters.readable_names, np.diag(best.covariance), strict=True
        )
        if np.isinf(v) and name not in {end.name for end in ends}
    ]
    if flat:
        findings.append(
            Finding(
                "not-identified",
                f"The data do not identify {', '.join(flat)}; values at the optimum are arbitrary, "
                "and the posterior keeps the prior there.",
                "likelihood.md#identification",
            )
        )
    for mode, weight in zip(modes[1:], weights[1:], strict=True):
        if weight < 0.01:
            continue
        point = _in_units(evaluator, mode.theta, mode.covariance)[0]
        free = [str(rv.name) for rv in evaluator.model.free_RVs]
        where = ", ".join(
            f"{name} = {np.array2string(np.asarray(point[name]), precision=4)}" for name in free
        )
        findings.append(
            Finding(
                "second-mode",
                f"A second optimum at {where} has {weight:.0%} of the posterior's mass; NUTS "
                "chains may stay in the mode where they start; prb.sample_smc samples both.",
                "likelihood.md#several-modes",
            )
        )
    return findings
