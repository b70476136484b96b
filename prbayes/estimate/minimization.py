"""The deterministic route: `minimize` moves the hyperparameters until the discrepancy is smallest."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm

from prbayes._checks import Floats, positive_integer, positive_number
from prbayes._progress import shown
from prbayes.estimate.caveats import flat, trouble
from prbayes.estimate.identifiability import unidentified_directions
from prbayes.estimate.methods import Method
from prbayes.estimate.obstacles import sampling_obstacle
from prbayes.estimate.optimum import Optimum, assemble, plain
from prbayes.estimate.refinement import (
    AGREE,
    MAX_ROUNDS,
    grow,
    pilot,
    refine_at,
    refuse,
    spread_around,
)
from prbayes.estimate.refit import SamplingDistribution
from prbayes.estimate.rivals import Rival, rivals
from prbayes.estimate.sampling import Local
from prbayes.estimate.sandwich import Information
from prbayes.estimate.search import Search
from prbayes.model.evaluator import Evaluator
from prbayes.model.simulator import model_on_context
from prbayes.model.support import shortcomings

_log = logging.getLogger("prbayes")


def refine(model: pm.Model | None = None, thetas: Floats | None = None) -> dict[str, int]:
    """Add design points where the posterior's populations live, until the designs support them.

    `minimize` and `sample_smc` call it; call it yourself before `pymc.sample` on models with several
    aleatory inputs or wide priors.

    Parameters
    ----------
    model : pymc.Model, optional
        The one on the context by default.
    thetas : ndarray, shape (P, d), optional
        Unconstrained hyperparameters whose populations matter; by default those around the optimum.

    Returns
    -------
    dict
        The number of stored responses by simulator.

    Raises
    ------
    DesignError
        If a design does not support them after eight more batches, or at ``max_points``.

    References
    ----------
    .. [1] Owen, A. and Y. Zhou (2000), Safe and effective importance sampling, J. Am. Stat. Assoc. 95, 135-143.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu"), 1.0)
    ...     y = prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=[0.5, 1.0, 4.0])
    >>> prb.refine(model)
    {'y': 1024}
    """
    from prbayes.estimate.minimization import minimize

    model = model_on_context(model, "prb.refine")
    evaluator = Evaluator(model)
    if thetas is None:
        minimize(model)
    else:
        for _ in range(MAX_ROUNDS):
            if not refine_at(evaluator, np.asarray(thetas, dtype=np.float64)):
                break
        refuse(shortcomings(evaluator, thetas), evaluator)
    return {name: design.n_points for name, design in evaluator.designs.items()}


_LOOKS = 3  # at other optima, with a design that is refined in between
_STARTS = 32  # points of the prior from which other optima are searched for where a theta costs no response
_TOLERATED = 1.5 * AGREE  # an estimate from eight blocks is itself uncertain
_MOVED = 0.01  # prior standard deviations from which what is known of an optimum is looked up again
_FAR = 4.0  # prior standard deviations from the prior's middle, from where on the edge of a support is thought of
_SAME = 1e-6  # of the objective's typical size: a change that is none
_FLOOR = 0.3  # of the noise floor: about the difference of the discrepancy between the data's fit and the truth's


def minimize(
    model: pm.Model | None = None,
    *,
    start: dict[str, Any] | None = None,
    method: str | Callable[..., Any] | None = None,
    options: Mapping[str, Any] | None = None,
    prior: bool = False,
    tolerance: float = 1e-6,
    max_evaluations: int = 5000,
    refine: bool = True,
    starts: int | None = None,
    random_seed: int = 0,
    progressbar: bool = True,
) -> Optimum:
    """Find the hyperparameters with the smallest discrepancy, inside the support of their priors.

    The parameters are unconstrained through PyMC's transforms and standardised by the prior's spread.
    With several simulators the sum of d_k / s_k is minimised: s_k is epsilon where it was given, and else
    the sampling noise of d_k, the mean discrepancy of data sets drawn from the model, at a pilot optimum.

    Parameters
    ----------
    model : pymc.Model, optional
        The one on the context by default.
    start : dict, optional
        A value for each free variable, in the user's own units. By default the best of 256 Sobol points of the prior
        where they cost no response (`Reweighted`), and else the model's initial point. Where no simulated response is
        near the data at the start, the area metric leads from there to where some are.
    method : str or callable, optional
        BFGS by default, with exact gradients where there are any (`Reweighted`; `Resimulated` if the response accepts
        PyTensor variables, which is tried) and differences on common points elsewhere. Any other method of
        `scipy.optimize.minimize` that needs no Hessian, by its name, or a function as scipy takes it:
        ``method(fun, x0, args, jac=..., callback=..., **options) -> OptimizeResult``. It works on standardised
        parameters, that start at zero; ``jac`` is None under `Fresh`.
    options : mapping, optional
        For scipy's ``options=``, in units of the standardised problem; they replace those that are set otherwise.
    prior : bool
        Add minus the log prior (then discrepancies should be divided by calibrated epsilons).
    tolerance : float
        Of the standardised problem: the gradient's largest element, or the smallest step of methods without gradient,
        with parameters in units of the prior's spread and the objective in units of its typical size.
    max_evaluations : int
        Largest number of evaluations of the objective by the optimiser in all, whatever the method.
    refine : bool
        Whether designs of `Reweighted` that do not support the optimum get more points.
    starts : int, optional
        Number of Sobol points of the prior from which other optima, such as mirror solutions, are searched for, all at
        once; 0 for none. By default 32 where a theta costs no response (`Reweighted`), and else none.
    random_seed : int
        Seed of the starting points.
    progressbar : bool
        Whether work of more than two seconds shows a bar on stderr.

    Returns
    -------
    Optimum

    Raises
    ------
    TypeError
        If there is no model, or a gradient method is used on `Fresh`.
    KeyError, ValueError
        If ``start`` does not fit the model, or there is no such method.
    DesignError
        If a design does not support the optimum after refinement.

    References
    ----------
    .. [1] Oh et al. (2019), doi:10.1007/s00158-019-02288-6.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> optimum = prb.minimize(model)
    >>> bool(abs(optimum.point["mu"] - 1) < 0.1)
    True
    """
    evaluator = Evaluator(model_on_context(model, "prb.minimize"))
    with shown(progressbar):
        return find_optimum(
            evaluator,
            start=start,
            method=method,
            options=options,
            prior=prior,
            tolerance=tolerance,
            max_evaluations=max_evaluations,
            refine=refine,
            starts=starts,
            random_seed=random_seed,
        )


def find_optimum(
    evaluator: Evaluator,
    *,
    start: dict[str, Any] | None = None,
    method: str | Callable[..., Any] | None = None,
    options: Mapping[str, Any] | None = None,
    prior: bool = False,
    tolerance: float = 1e-6,
    max_evaluations: int = 5000,
    refine: bool = True,
    starts: int | None = None,
    random_seed: int = 0,
) -> Optimum:
    """Do what `minimize` does, for an evaluator."""
    clock = time.perf_counter()
    minimiser = Method.of(method, options)
    positive_number(tolerance, "tolerance")
    positive_integer(max_evaluations, "max_evaluations")
    fresh = [n.name for n in evaluator.nodes if n.bound.random]
    if fresh and minimiser.gradient and isinstance(minimiser.method, str):
        raise TypeError(
            f"{fresh[0]}: prb.Fresh draws new responses at every evaluation, so the method {minimiser.name} has no "
            "gradient to follow; pass epsilon= to prb.sample_smc, which then needs no optimum, use "
            "prb.minimize(method='Nelder-Mead'), or propagation=prb.Reweighted() or prb.Resimulated()"
        )
    scale = evaluator.prior_sd
    already = evaluator.n_responses
    stored = sum(d.n_points for d in evaluator.designs.values())
    several = len(evaluator.nodes) > 1
    natural = np.array([n.target.scale for n in evaluator.nodes]) if several or prior else np.ones(1)
    natural = np.where(np.isnan(evaluator.epsilon) | (not (several or prior)), natural, evaluator.epsilon)
    search = Search(evaluator, scale, minimiser, prior, tolerance, max_evaluations)
    theta, screened = search.start(start, natural, random_seed)
    theta = search.approach(theta, natural, random_seed)
    scales = natural
    cloud: Floats | None = None
    error, rounds = np.nan, 0
    while True:
        result = search(theta, scales)
        theta = search.best
        if several and np.isnan(evaluator.epsilon).any():
            noise = [Information(evaluator, k, theta).noise_floor for k in range(len(evaluator.nodes))]
            scales = np.where(np.isnan(evaluator.epsilon), noise, evaluator.epsilon)
            result = search(theta, scales)
            theta = search.best
        hood = _hood(evaluator, theta, scale, scales)
        local = None if hood is None else hood.local
        covariance = np.full((theta.size, theta.size), np.nan) if local is None else local.in_theta
        if not (refine and evaluator.designs):
            break
        near = spread_around(theta, covariance, scale, seed=random_seed) if cloud is None else cloud
        near = near[evaluator.in_support(near)]
        short = shortcomings(evaluator, near) or shortcomings(evaluator, theta[None])
        if not short:
            error = np.nan if hood is None else hood.design_error()
            if not error > AGREE or not grow(evaluator, near, error):
                break
        elif rounds == MAX_ROUNDS:
            refuse(short, evaluator)
        elif cloud is None:
            cloud = near = pilot(evaluator, scales, scale, seed=random_seed)
        elif not refine_at(evaluator, near):
            refine_at(evaluator, theta[None])
        rounds += 1
        # What looked best on a thin design may be an artefact of it.
        theta = search.best_of(np.vstack([theta, near]), scales)
    starts = (0 if evaluator.responses_per_theta else _STARTS) if starts is None else starts
    others: list[Rival] = []
    if starts and local is not None:
        others = _rivals(evaluator, theta, scales, local, starts, random_seed, refine=refine)
        if others and others[0].better:
            result = search(others[0].theta, scales)
            theta = search.best
            hood = _hood(evaluator, theta, scale, scales)
            local = None if hood is None else hood.local
            others = (
                [] if local is None else _rivals(evaluator, theta, scales, local, starts, random_seed, refine=refine)
            )
    result = search.settle(result)
    theta = search.best
    if hood is not None and not np.array_equal(theta, hood.theta):
        if (np.abs(theta - hood.theta) > _MOVED * scale).any():
            hood = _hood(evaluator, theta, scale, scales)
            local = None if hood is None else hood.local
        error = np.nan
    if hood is not None and np.isnan(error):
        error = hood.design_error()
    edge = () if local is None else _at_edge(evaluator, theta, scales, local, search.size(theta, scales), random_seed)
    jump = () if hood is None else tuple(evaluator.nodes[k].name for k in hood.unsettled())
    if edge or jump:
        local, others = None, []
    warnings = (*trouble(edge, jump), *_warnings(evaluator, local, others, error))
    for line in warnings:
        _log.warning("%s", line)
    found = assemble(evaluator, theta, scales, local, search, result, screened, already - stored, clock)
    return replace(
        found,
        converged=found.converged and not edge,
        message=found.message + (f" {', '.join(edge)} ran to the edge of the support." if edge else ""),
        design_error=error,
        rivals=tuple(_described(evaluator, o) for o in others),
        warnings=warnings,
        at_edge=edge,
        at_jump=jump,
    )


def _hood(evaluator: Evaluator, theta: Floats, scale: Floats, scales: Floats) -> SamplingDistribution | None:
    """Return the sampling distribution of the minimiser around theta, or None where nothing is known of it."""
    if sampling_obstacle(evaluator) is not None:
        return None
    return SamplingDistribution.of(evaluator, theta, scales)


def _rivals(
    evaluator: Evaluator, theta: Floats, scales: Floats, local: Local, starts: int, seed: int, *, refine: bool
) -> list[Rival]:
    """Look for other optima; where a design is too thin for one that matters, refine it there and look again."""
    floors = [Information(evaluator, k, theta, n_sets=50).noise_floor for k in range(len(evaluator.nodes))]
    noise = _FLOOR * float((np.array(floors) / scales).sum())
    for _ in range(_LOOKS):
        found = rivals(evaluator, theta, scales, local, noise, starts=starts, seed=seed)
        thin = [r for r in found if (r.better or r.comparable) and shortcomings(evaluator, r.theta[None])]
        if not thin or not refine:
            break
        refine_at(evaluator, thin[0].theta[None])
    return [r for r in found if not shortcomings(evaluator, r.theta[None])]


def _at_edge(
    evaluator: Evaluator, theta: Floats, scales: Floats, local: Local, size: float, seed: int
) -> tuple[str, ...]:
    """Return the elements that went far out and could go on without any change: their best value is at an edge.

    Data drawn from such a population tell much, so that the standard errors are small there, and mean nothing.
    """
    away = theta - np.median(evaluator.prior_thetas(256, seed), axis=0)
    far = np.flatnonzero((np.abs(away) > _FAR * local.prior_sd) & np.isfinite(np.diag(local.in_theta)))
    if not far.size or flat(evaluator, theta, local.prior_sd):
        return ()
    further = np.diag(np.sign(away) * local.prior_sd)[far]
    here, *there = evaluator.total(np.vstack([theta, theta + further]), scales)
    return tuple(evaluator.readable_names[i] for i, f in zip(far, there, strict=True) if abs(f - here) < _SAME * size)


def _described(evaluator: Evaluator, rival: Rival) -> dict[str, Any]:
    point = {name: plain(v[0]) for name, v in evaluator.constrained(rival.theta[None]).items()}
    return {"point": point, "discrepancy": rival.value, "theta": rival.theta, "comparable": rival.comparable}


def _warnings(evaluator: Evaluator, local: Local | None, others: list[Rival], error: float) -> tuple[str, ...]:
    """Say what is not identified, and whether the design is too small."""
    lines = []
    if error > _TOLERATED:
        points = max(d.n_points for d in evaluator.designs.values())
        lines.append(
            f"the optimum of another design would differ by about {error:.2f} standard errors, expected at most "
            f"{AGREE}; pass a larger n or max_points to prb.Reweighted (now {points} points)"
        )
    for rival in others:
        if rival.comparable:
            point = evaluator.constrained(rival.theta[None])
            at = ", ".join(
                f"{rv.name} = {np.array2string(point[rv.name][0], precision=4)}" for rv in evaluator.model.free_RVs
            )
            lines.append(
                f"the data could as well come from {at}: another optimum, or mirror solution, whose discrepancy "
                "differs by no more than sampling noise; state a prior that excludes one, or report both"
            )
    if local is not None:
        lines += [
            f"the data tell less than the prior about {direction} (in units of the priors' standard deviations): it is "
            "not identified by them, and its posterior rests on the prior"
            for direction in unidentified_directions(local.unidentified, evaluator.readable_names)
        ]
    return tuple(lines)
