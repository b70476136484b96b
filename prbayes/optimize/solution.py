"""From where a search ended to an `Optimum`: values in the user's units, standard errors."""

from __future__ import annotations

from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local
from prbayes.inference.checks.flat_edge import no_information
from prbayes.model.evaluator import Evaluator, has_other_terms, missing_mass
from prbayes.model.fingerprint import identity_of
from prbayes.model.parameters import THETAS
from prbayes.numerics.derivatives import cross, slopes
from prbayes.optimize.convergence import Run, Search, apart_from_data
from prbayes.optimize.local_optima import Rival
from prbayes.optimize.optimum import Optimum, plain


def assemble(
    search: Search,
    run: Run,
    *,
    covariance: Floats,
    functions: Local | None = None,
    remark: str,
    screened: int,
    responses_before: int,
    stopped: str = "",
) -> Optimum:
    """Return the record of a search that has ended.

    Parameters
    ----------
    search : Search
    run : Run
        The last one.
    covariance : ndarray, shape (d, d)
        Sampling covariance in unconstrained space; infinite along what is not identified, or NaN.
    functions : Local, optional
        The same by directions, faint ones among them, which tells more of deterministics.
    remark : str
        What is added to the message.
    screened : int
        Points of the prior tried as starts.
    responses_before : int
        Scalar responses that were computed for something else.
    stopped : str
        Which budget ended the search; no response is computed then.
    """
    evaluator = search.evaluator
    theta = run.best
    scales = run.scales
    point, stderr = point_and_stderr(evaluator, theta, covariance, functions)
    affordable = not (stopped and evaluator.responses_per_theta)
    nowhere = _nowhere(evaluator, theta, covariance)
    lost = ""
    if nowhere:
        lost = (
            " No hyperparameter changes the discrepancy here, far from the data: try another start."
        )
    elif affordable and not search.prior and apart_from_data(evaluator, theta):
        # Such a minimum is one of the mass beyond the grid, and no fit.
        nowhere = True
        lost = " The population here hardly overlaps, far from the data: try another start."
    if affordable:
        values = evaluator(theta[None]).discrepancies[0]
    else:
        values = _known_discrepancies(search, run)
    names = [n.name for n in evaluator.nodes]
    discrepancies = dict(zip(names, map(float, values), strict=True))
    return Optimum(
        point=point,
        discrepancy=float((values / scales).sum()),
        discrepancies=discrepancies,
        scales=dict(zip(names, map(float, scales), strict=True)),
        n_evaluations=run.trace.count,
        n_screened=screened,
        n_responses=evaluator.n_responses - responses_before,
        converged=run.success and not nowhere and not stopped,
        message=f"{run.message}{remark}{lost}",
        stderr=stderr,
        covariance=covariance,
        theta=theta,
        names=evaluator.hyperparameters.names,
        evaluator=evaluator,
        support=_support(evaluator, theta, affordable=affordable),
        trace={
            "theta": np.array(run.trace.thetas).reshape(-1, theta.size),
            "discrepancy": np.array(run.trace.values),
            "evaluations": np.array(run.trace.counts, dtype=np.int64),
        },
        prior=search.prior,
        stopped=stopped,
        identity=identity_of(evaluator, prior_minimised=search.prior),
    )


def point_and_stderr(
    evaluator: Evaluator, theta: Floats, covariance: Floats, functions: Local | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return variables and deterministics in the user's units, and their standard errors."""
    # Any small step serves: transforms are smooth.
    step = 1e-4 * evaluator.hyperparameters.prior_sd
    values = evaluator.hyperparameters.constrained(cross(theta, step))
    point = {name: plain(v[0]) for name, v in values.items()}
    prior = evaluator.hyperparameters.constrained(
        evaluator.hyperparameters.prior_thetas(THETAS, seed=0)
    )
    deterministic = {str(variable.name) for variable in evaluator.model.deterministics}
    stderr = {}
    for name, v in values.items():
        gradients = slopes(v, step)
        found = _stderr(gradients, covariance)
        if functions is not None and name in deterministic:
            found = _of_functions(found, gradients, prior[name], functions)
        fixed = _same_everywhere(v, prior[name])
        stderr[name] = plain(np.where(fixed, 0.0, found))
    return point, stderr


def _of_functions(stderr: Floats, gradients: Floats, prior: Floats, functions: Local) -> Floats:
    """Return standard errors, (*shape), of deterministics of elements that are not identified.

    They are if they are known better than by their own prior, of which there are draws,
    (P, *shape).
    """
    found = np.sqrt(functions.variance(gradients))
    upper, lower = np.quantile(prior, [0.84, 0.16], axis=0)
    better = np.isinf(stderr) & (found < (upper - lower) / 2)
    return np.where(better, found, stderr)


def _same_everywhere(values: Floats, prior: Floats) -> Any:
    """Return which elements no hyperparameter changes, as a correlation's diagonal, (*shape)."""
    both = np.concatenate([values, prior])
    # Up to rounding, of which a few operations make a few units in the last place.
    return np.ptp(both, axis=0) <= 1e-12 * np.abs(values[0])


def _stderr(gradients: Floats, covariance: Floats) -> Floats:
    """Carry a covariance, some of it infinite or NaN, along gradients (..., d)."""
    unknown = np.isinf(covariance)
    finite = np.where(unknown, 0.0, covariance)
    variance = np.einsum("...i,ij,...j->...", gradients, finite, gradients)
    size = np.abs(gradients)
    touched = np.einsum("...i,ij,...j->...", size, unknown.astype(float), size)
    # At a bound of its support nothing moves it, and nothing is known of what would.
    at_bound = unknown.any() & (gradients == 0).all(axis=-1)
    variance = np.where(touched > 0, np.inf, np.maximum(variance, 0))
    return np.asarray(np.sqrt(np.where(at_bound, np.nan, variance)))


def _nowhere(evaluator: Evaluator, theta: Floats, covariance: Floats) -> bool:
    """Return whether the search ended where no hyperparameter changes the discrepancy."""
    variance = np.diag(covariance) / evaluator.hyperparameters.prior_sd**2
    # A smaller variance can be that of rounding errors; the discrepancy tells.
    suspect = np.isinf(variance) | (variance < 1e-16)
    return bool(suspect.all()) and no_information(evaluator, theta)


def _known_discrepancies(search: Search, run: Run) -> Floats:
    """Return what the search tells of the discrepancies where it ended, NaN if nothing."""
    if len(run.scales) > 1 or search.prior or has_other_terms(search.evaluator):
        return np.full(len(run.scales), np.nan)
    return run.lowest * run.scales


def _support(
    evaluator: Evaluator, theta: Floats, *, affordable: bool
) -> dict[str, dict[str, float]]:
    """Return how well designs support the population at theta, and what it lacks, by simulator."""
    out = {}
    for name, support in evaluator.support(theta[None]).items():
        out[name] = {key: float(value[0]) for key, value in support.items()}
    for k, node in enumerate(evaluator.nodes):
        if node.reweighted is None and affordable:
            out[node.name] = missing_mass(evaluator, theta, k)
    return out


def rival_record(evaluator: Evaluator, rival: Rival) -> dict[str, Any]:
    """Return another optimum as `Optimum` keeps it."""
    values = evaluator.hyperparameters.constrained(rival.theta[None])
    return {
        "point": {name: plain(v[0]) for name, v in values.items()},
        "discrepancy": rival.value,
        "theta": rival.theta,
        "comparable": rival.comparable,
    }
