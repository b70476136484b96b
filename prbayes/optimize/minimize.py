"""Deterministic calibration: the hyperparameters with the smallest discrepancy.

The optimiser is a loop: minimise, then add points to the designs and minimise again until they
support the minimum. Then it looks for other optima.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any

import numpy as np
import pymc as pm

from prbayes._finding import Finding, Findings, report
from prbayes._progress import progress, shown
from prbayes._validate import (
    Floats,
    Function,
    Names,
    Seed,
    flag,
    positive_integer,
    positive_number,
    real_array,
    seed_number,
)
from prbayes.inference.checks.identification import (
    breakdown_findings,
    confounding_findings,
    elements_at_edge,
    unidentified_findings,
    unknown_error_findings,
)
from prbayes.inference.checks.metric_suitability import (
    components_left_out,
    data_between_runs,
    few_for_whitening,
    heavy_tails,
    smoothing_bias,
)
from prbayes.inference.checks.one_sided import (
    bounds_by_metric,
    end_and_bound_findings,
    is_far_from_data,
)
from prbayes.inference.checks.population import replaced_findings
from prbayes.inference.checks.prior import ends_by_metric
from prbayes.inference.checks.sample_size import few_specimens
from prbayes.inference.design_error import design_error
from prbayes.inference.refits import (
    SamplingDistribution,
    jumping_simulators,
    sampling_obstacle,
)
from prbayes.inference.resampling import SETS
from prbayes.model.cost import explained, kept
from prbayes.model.evaluator import (
    Evaluator,
    epsilons,
    n_design_runs,
    only_through_prior,
    shortcomings,
    with_data,
    with_unchanged_runs,
)
from prbayes.model.locking import locked
from prbayes.model.parameters import THETAS, Hyperparameters, unconstrained
from prbayes.model.random_variable import simulators
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.optimize.convergence import Fit, Result, Search, Trace, approach, minimise, settle
from prbayes.optimize.design_refinement import (
    MAX_ROUNDS,
    design_error_findings,
    noise_floors,
    refine_at,
    refine_designs,
    refuse,
    refuse_lost,
    sampling_distribution,
)
from prbayes.optimize.local_optima import LocalOptimum, find_local_optima
from prbayes.optimize.maximum_likelihood import maximize_likelihood
from prbayes.optimize.objective import Method, Minimisation, Ridge, initial_scales
from prbayes.optimize.optimum import (
    Optimum,
    SearchRecord,
    local_optimum,
    n_computed,
    optimum_of,
)
from prbayes.response.budget import BudgetError, limited, unlimited
from prbayes.response.inputs import model_on_context


@locked
def refine(
    model: pm.Model | None = None,
    *,
    thetas: Floats | None = None,
    max_seconds: float | None = None,
    max_runs: int | None = None,
    progressbar: bool = True,
) -> dict[str, int]:
    """Add design points where the posterior's populations are, until the designs support them.

    `minimize` and `sample_smc` call it; call it yourself before `pymc.sample` on models with
    several aleatory inputs or wide priors.

    Parameters
    ----------
    model : pymc.Model, optional
        The one on the context by default.
    thetas : ndarray, shape (P, d), optional
        Unconstrained hyperparameters of the populations; by default those around the optimum.
    max_seconds : float, optional
        Seconds after which no new work begins.
    max_runs : int, optional
        Largest number of responses to compute, including the first runs; those in a store do not
        count.
    progressbar : bool
        Whether work of more than two seconds shows a progress bar on stderr.

    Returns
    -------
    dict
        Number of stored responses by simulator.

    Raises
    ------
    TypeError, ValueError
        If there is no model, its simulators have no design or no optimum, or an argument is not as
        described.
    DesignError
        If a design does not support them after eight more batches, or at ``max_points``.
    BudgetError
        If a budget is spent before; whole batches of points stay in the designs.

    References
    ----------
    .. [1] Owen, A. and Y. Zhou (2000), Safe and effective importance sampling, J. Am. Stat. Assoc.
           95, 135-143.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu"), 1.0)
    ...     y = prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=[0.5, 1.0, 4.0])
    >>> prb.refine(model)
    {'y': 1024}
    """
    model = model_on_context(model, "prb.refine")
    if specimen_likelihoods(model) and not simulators(model):
        raise ValueError(
            "refine: got a model whose simulators use prb.LogLikelihood(), whose emulator gets the "
            "runs that it needs at the first use, expected a simulator with prb.Reweighted; leave "
            "the call out, or give the emulator more first runs with "
            "propagation=prb.Reweighted(n)"
        )
    if thetas is not None:
        thetas = real_array(thetas, "thetas")
        hyperparameters = Hyperparameters.of(model)
        size = hyperparameters.size
        if thetas.ndim != 2 or thetas.shape[1] != size or not len(thetas):
            raise ValueError(
                f"thetas: got shape {thetas.shape}, expected (P, {size}) with P >= 1: a row for "
                f"each population, a column for each of {hyperparameters.names}"
            )
        if not np.isfinite(thetas).all():
            raise ValueError("thetas: got NaN or infinite values, expected finite ones")
    with shown(progressbar), explained(model, "prb.refine"), limited(max_seconds, max_runs):
        evaluator = Evaluator.of(model)
        for bound in evaluator.reweighted.values():
            # Raises if the response has changed since the runs.
            bound.values_of(bound.responses.used_by("prb.refine"))
        if thetas is None:
            require_finished(find_optimum(evaluator, Minimisation()))
        else:
            for _ in range(MAX_ROUNDS):
                if not refine_at(evaluator, thetas):
                    break
            refuse(shortcomings(evaluator, thetas), evaluator)
    return {name: bound.n_runs for name, bound in evaluator.reweighted.items()}


@locked
def repeat_runs(model: pm.Model | None = None, *, progressbar: bool = True) -> dict[str, int]:
    """Repeat three runs of each simulator, and raise if one of them differs.

    A change of the response's code and variables, and of files that a text names, is noticed
    without a call. Other changes are not: of a program, a server, or what a program reads. For
    these, three runs are repeated once in a process, when another function uses the runs. Call
    this function when you have changed something of that kind.

    Parameters
    ----------
    model : pymc.Model, optional
        The one on the context by default.
    progressbar : bool
        Whether work of more than two seconds shows a progress bar on stderr.

    Returns
    -------
    dict
        Number of repeated runs by simulator; zero where runs are not kept, are a table, or belong
        to a store with a version.

    Raises
    ------
    TypeError
        If there is no model, or none with a simulator.
    ResponseError
        If a run differs.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu"), 1.0)
    ...     y = prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=[0.5, 1.0, 4.0])
    >>> prb.repeat_runs(model)
    {'y': 3}
    """
    model = model_on_context(model, "prb.repeat_runs")
    with shown(progressbar), explained(model, "prb.repeat_runs"):
        evaluator = Evaluator.of(model)
        simulators = with_data(evaluator)
        n_repeated = [simulator.responses.n_repeated for simulator in simulators]
        for simulator in simulators:
            simulator.responses.runs.is_repeated = None
        with_unchanged_runs(evaluator)
    pairs = zip(simulators, n_repeated, strict=True)
    return {s.name: s.responses.n_repeated - n for s, n in pairs}


@locked
def minimize(
    model: pm.Model | None = None,
    *,
    start: dict[str, Any] | None = None,
    method: str | Function | None = None,
    options: Mapping[str, Any] | None = None,
    prior: bool = False,
    tolerance: float = 1e-6,
    max_evaluations: int = 5000,
    refine: bool = True,
    starts: int | None = None,
    max_seconds: float | None = None,
    max_runs: int | None = None,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> Optimum:
    """Find the hyperparameters with the smallest discrepancy, inside the support of their priors.

    The parameters are unconstrained through PyMC's transforms and standardised by the prior's
    spread. With several simulators the objective is the sum of d_k / s_k: s_k is epsilon where it
    is set, and else the sampling noise of d_k at a pilot optimum, the mean discrepancy of data sets
    drawn from the model. Beside other likelihood terms, potentials or the prior, s_k is epsilon:
    the objective is then minus a log-density.

    Parameters
    ----------
    model : pymc.Model, optional
        The one on the context by default.
    start : dict, optional
        A value for each free variable, in the user's units. By default the best of 256 Sobol points
        of the prior where they cost no response (`Reweighted`), and else the model's initial point.
        If no simulated response is near the data at the start, a minimisation of the area metric
        comes first.
    method : str or callable, optional
        BFGS by default, with exact gradients where they exist (`Reweighted`; `Resimulated` if the
        response accepts PyTensor variables, which is tried) and differences on common points
        elsewhere. Or any method of `scipy.optimize.minimize` that needs no Hessian, by name, or a
        function that scipy accepts: ``method(fun, x0, args, jac=..., callback=..., **options) ->
        OptimizeResult``. It works on standardised parameters, which start at zero; ``jac`` is None
        under `Fresh`.
    options : mapping, optional
        For scipy's ``options=``, in units of the standardised problem; they replace the defaults.
    prior : bool
        Whether to add minus the log prior; every simulator then needs an epsilon.
    tolerance : float
        Largest element of the gradient, or smallest step of methods without gradient, with
        parameters in units of the prior's spread and the objective in units of its typical size.
    max_evaluations : int
        Largest number of evaluations of the objective in all, whatever the method.
    refine : bool
        Whether designs of `Reweighted` that do not support the optimum get more points.
    starts : int, optional
        Number of Sobol points of the prior that start a search for other optima, such as mirror
        solutions; 0 for none. By default 32 where a theta costs no response (`Reweighted`), and
        else 4 if the fit is poor and they take less than half a minute.
    max_seconds : float, optional
        Seconds after which no new work begins: the best point up to then is returned, not
        converged, with ``search.stopped``. The same call with a larger budget on the same model,
        built again, gives the same optimum as without interruption; with a ``store`` it repeats no
        run.
    max_runs : int, optional
        Largest number of responses to compute, including the first runs; those in a store do not
        count. As for ``max_seconds``.
    random_seed : int, sequence of int, numpy.random.Generator or None
        Seed of the starting points.
    progressbar : bool
        Whether work of more than two seconds shows a progress bar on stderr.

    Returns
    -------
    Optimum

    Raises
    ------
    TypeError
        If there is no model, or a gradient method is used on `Fresh`.
    KeyError, ValueError
        If ``start`` does not fit the model, if there is no such method, or if a simulator without
        epsilon is beside the prior, other likelihood terms or potentials.
    DesignError
        If a design does not support the optimum after refinement.
    BudgetError
        If a budget is spent before the discrepancy is known anywhere.

    References
    ----------
    .. [1] Oh et al. (2019), doi:10.1007/s00158-019-02288-6.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0, 2, 4])
    >>> optimum = prb.minimize(model)
    >>> bool(abs(optimum.point["mu"] - 1) < 0.1)
    True
    """
    model = model_on_context(model, "prb.minimize")
    if starts is not None:
        positive_integer(starts, "starts", minimum=0)
    settings = Minimisation(
        start=start,
        method=Method("BFGS" if method is None else method, {} if options is None else options),
        prior=flag(prior, "prior"),
        tolerance=positive_number(tolerance, "tolerance"),
        max_evaluations=positive_integer(max_evaluations, "max_evaluations"),
        refine=flag(refine, "refine"),
        starts=starts,
        random_seed=seed_number(random_seed),
    )
    with shown(progressbar), explained(model, "prb.minimize"), limited(max_seconds, max_runs):
        return find_optimum(with_unchanged_runs(Evaluator.of(model)), settings)


@dataclass(frozen=True, eq=False)
class _Problem:
    """State of a minimisation: its search, and the fits so far."""

    search: Search
    # update of the progress bar by a number of runs, with a note
    advance: Callable[[int, str], None]
    n_previous: int  # number of responses computed before, without those of designs
    record: SearchRecord  # record of the start of the search
    # fits of all steps; if a budget is spent the last one is reported
    fits: list[Fit] = field(default_factory=list)


def find_optimum(evaluator: Evaluator, settings: Minimisation) -> Optimum:
    """Minimise as `minimize` does; raise BudgetError if it is spent before the first minimum."""
    if not evaluator.nodes:
        return maximize_likelihood(evaluator, settings)
    for node in evaluator.nodes:
        node.bound.stream, node.bound.draws = settings.random_seed, 0
    clock = time.perf_counter()
    hyperparameters = evaluator.hyperparameters
    search = Search(evaluator, hyperparameters.prior_sd, settings)
    n_previous = evaluator.n_responses - n_design_runs(evaluator)
    n_screened, details = 0, ""
    with progress("runs") as advance:
        # Start from the user's point, the best of the prior, or the model's initial point.
        scales = initial_scales(evaluator, prior=settings.prior)
        theta = hyperparameters.initial
        if settings.start is not None:
            theta = unconstrained(hyperparameters, settings.start)
        elif not evaluator.responses_per_theta:
            points = hyperparameters.prior_points(THETAS, settings.random_seed)
            candidates = np.concatenate([theta[None], points])
            theta = candidates[np.argmin(evaluator.total(candidates, scales))]
            n_screened = len(candidates)
        theta, trace = approach(search, theta, scales, Trace())
        if trace.count:
            details = (
                "At the start hardly any simulated response was near the data: the area metric "
                f"was minimised first, in {trace.count} evaluations."
            )
        record = SearchRecord(Result.STOPPED, details, settings.prior, n_screened=n_screened)
        problem = _Problem(search, advance, n_previous, record)
        try:
            fit, optima = _optimise(problem, theta, scales, trace)
            optimum = _report(problem, fit, optima)
        except BudgetError as spent:
            if not problem.fits:
                raise
            with unlimited():
                optimum = _report(problem, problem.fits[-1], [], stopped=str(spent))
    seconds = time.perf_counter() - clock
    record = replace(optimum.search, seconds=seconds, n_computed=n_computed(evaluator))
    return replace(optimum, search=record)


def require_finished(optimum: Optimum) -> Optimum:
    """Return an optimum that no budget ended, or raise BudgetError."""
    if optimum.search.stopped:
        raise BudgetError(optimum.search.stopped)
    return optimum


# -- minimisation ----------------------------------------------------------------------------------


def _optimise(
    problem: _Problem, theta: Floats, scales: Floats, trace: Trace
) -> tuple[Fit, list[LocalOptimum]]:
    """Minimise on designs that grow until they support the minimum, then compare local optima."""
    search, evaluator = problem.search, problem.search.evaluator
    fit = _fit(problem, theta, scales, trace)
    for round_ in count() if search.settings.refine else ():
        fit, restart = refine_designs(search, fit, round_, problem.advance)
        if restart is None:
            break
        pilot, ridge = restart.pilot, restart.ridge
        theta, trace = approach(search, restart.theta, fit.scales, fit.trace)
        fit = _fit(problem, theta, fit.scales, trace, pilot, ridge)
        if restart.alternative is not None:
            # An earlier minimum may be better on the grown designs.
            thetas = np.array([restart.alternative, fit.theta])
            earlier, later = evaluator.total(thetas, fit.scales)
            if earlier < later:
                fit = _fit(problem, restart.alternative, fit.scales, fit.trace, pilot, ridge)
    problem.fits.append(fit)
    if fit.ridge is not None and fit.sampling is not None:
        # Minimise without the ridge along directions that the grown designs identify.
        directions = fit.sampling.local.unidentified
        if directions.shape[1] < fit.ridge.directions.shape[1]:
            rest = replace(fit.ridge, directions=directions) if directions.size else None
            refit = _fit(problem, fit.theta, fit.scales, fit.trace, fit.pilot, rest)
            if refit.sampling is not None and not shortcomings(evaluator, refit.theta[None]):
                fit = refit
            problem.fits.append(fit)
    fit, optima = _compare_optima(problem, fit)
    problem.fits.append(fit)
    fit = _settle(problem, fit)
    problem.fits.append(fit)
    return fit, optima


def _fit(
    problem: _Problem,
    theta: Floats,
    scales: Floats,
    trace: Trace,
    pilot: Floats | None = None,
    ridge: Ridge | None = None,
) -> Fit:
    """Minimise from theta; with several simulators again, scaled by the noise at the pilot."""
    search = replace(problem.search, ridge=ridge)
    evaluator = search.evaluator
    fit = replace(minimise(search, theta, scales, trace), pilot=pilot)
    problem.fits.append(fit)
    is_unset = np.isnan(epsilons(evaluator))
    if is_unset.size > 1 and is_unset.any():
        noise = noise_floors(evaluator, fit.theta, SETS)
        scales = np.where(is_unset, noise, epsilons(evaluator))
        fit = replace(minimise(search, fit.theta, scales, fit.trace), pilot=pilot)
        problem.fits.append(fit)
    return replace(fit, sampling=sampling_distribution(evaluator, fit.theta, fit.scales))


def _compare_optima(problem: _Problem, fit: Fit) -> tuple[Fit, list[LocalOptimum]]:
    """Search for other optima; move to a better one."""
    evaluator, settings = problem.search.evaluator, problem.search.settings
    n_starts = settings.starts
    if n_starts is None:
        n_starts = _starts_by_cost(problem.search, fit)
    optima = []
    for is_first in (True, False):
        if not n_starts or fit.sampling is None:
            return fit, []
        optima = find_local_optima(problem.search, fit, n_starts)
        if not (is_first and optima and optima[0].better):
            break
        search = replace(problem.search, ridge=fit.ridge)
        moved = minimise(search, optima[0].theta, fit.scales, fit.trace)
        if settings.refine and refine_at(evaluator, moved.theta[None]):
            moved = minimise(search, moved.theta, fit.scales, moved.trace)
        sampling = sampling_distribution(evaluator, moved.theta, fit.scales)
        fit = replace(moved, sampling=sampling, design_error=fit.design_error, pilot=fit.pilot)
    return fit, optima


def _starts_by_cost(search: Search, fit: Fit) -> int:
    """Return the number of starts in search of other optima.

    Where responses are simulated again, it is four if the fit is poor and the search takes less
    than half a minute.
    """
    evaluator = search.evaluator
    if not evaluator.responses_per_theta:
        return 32
    if (
        fit.sampling is None
        or search.settings.prior
        or not is_far_from_data(fit.sampling, fit.lowest)
    ):
        return 0
    evaluator.total(fit.theta[None], fit.scales)  # the first call compiles
    start = time.perf_counter()
    evaluator.total(fit.theta[None], fit.scales)
    seconds = time.perf_counter() - start
    # Four starts take about 200 populations for each element of theta.
    return 4 if 400 * fit.theta.size * seconds < 30 else 0


def _settle(problem: _Problem, fit: Fit) -> Fit:
    """Settle a line search that gave up, and complete the fit at its end."""
    search = replace(problem.search, ridge=fit.ridge)
    evaluator = search.evaluator
    end = settle(search, fit)
    if search.settings.refine and refine_at(evaluator, end.theta[None], beside=fit.theta[None]):
        # The simplex may have moved to where few points have a low value by chance: settle again on
        # the refined designs.
        end = settle(search, fit)
        if shortcomings(evaluator, end.theta[None]):
            end = fit
    shift = np.abs(end.theta - fit.theta)
    # Standard errors are computed again only if theta has moved by a hundredth of the prior's
    # spread.
    if end.sampling is not None and (shift > 0.01 * search.prior_sd).any():
        end = replace(end, sampling=sampling_distribution(evaluator, end.theta, end.scales))
    if end.sampling is None or not (np.isnan(end.design_error) or shift.any()):
        return end
    return replace(end, design_error=design_error(end.sampling).whole)


# -- report ----------------------------------------------------------------------------------------


def _report(
    problem: _Problem, fit: Fit, optima: list[LocalOptimum], *, stopped: str = ""
) -> Optimum:
    """Return the optimum of the last fit, and log its findings.

    No response is computed if a budget has ``stopped`` the minimisation.
    """
    search = problem.search
    evaluator = search.evaluator
    at_edge: Names = ()
    at_jump: Names = ()
    if fit.sampling is not None and not stopped:
        at_edge = elements_at_edge(
            evaluator,
            fit.theta,
            fit.scales,
            size=search.size(fit.theta, fit.scales),
            tolerance=search.settings.tolerance,
            seed=search.settings.random_seed,
        )
        at_jump = tuple(evaluator.nodes[k].name for k in jumping_simulators(fit.sampling))
        if at_edge or at_jump:
            fit, optima = replace(fit, sampling=None), []
    details = ["" if fit.result.converged else fit.details, problem.record.details]
    if stopped:
        details.append(f"{stopped} before the minimisation was finished.")
    else:
        details += _details(search, fit, at_edge)
    record = replace(
        problem.record,
        details=" ".join(filter(None, details)),
        stopped=stopped,
        at_edge=at_edge,
        at_jump=at_jump,
    )
    optimum = optimum_of(search, fit, record, problem.n_previous)
    if stopped:
        text = (
            f"{stopped} before the minimisation was finished, so that the result is not an "
            f"optimum; {kept(evaluator.model)}; build the model again and call prb.minimize with a "
            "larger budget to continue."
        )
        finding = Finding("budget-spent", text, "expensive.md#a-night-is-not-enough")
        return replace(optimum, findings=report(finding))
    support = optimum.search.support
    refuse_lost(evaluator, {name: numbers["lost_mass"] for name, numbers in support.items()})
    local = None if fit.sampling is None else fit.sampling.local
    unknown = [] if at_edge or at_jump else [*optimum.stderr.items()]
    # findings that are logged already
    first = [finding for node in evaluator.nodes for finding in node.bound.findings]
    findings = report(
        *breakdown_findings(at_edge, at_jump),
        *unknown_error_findings(dict(unknown), sampling_obstacle(evaluator)),
        *replaced_findings(evaluator, fit.theta),
        *heavy_tails(evaluator, fit.theta),
        *data_between_runs(evaluator, fit.theta),
        *smoothing_bias(evaluator, fit.theta, fit.scales, local),
        *components_left_out(evaluator, fit.theta),
        *optimum_findings(evaluator, fit.sampling, optima, fit.design_error),
    )
    local_optima = tuple(
        local_optimum(evaluator, mode.theta, mode.value, comparable=mode.comparable)
        for mode in optima
    )
    findings = (*first, *findings)
    return replace(
        optimum, design_error=fit.design_error, local_optima=local_optima, findings=findings
    )


def _details(search: Search, fit: Fit, at_edge: Names) -> list[str]:
    """Return sentences about edges, designs and directions that are not identified."""
    evaluator = search.evaluator
    sentences = [f"{', '.join(at_edge)} reached the edge of the support."] if at_edge else []
    designs = {name: bound.design for name, bound in evaluator.reweighted.items()}
    emulated = [
        design.summary(name) for name, design in designs.items() if design.has_emulated_points
    ]
    if emulated and np.isfinite(fit.design_error):
        error = f"{fit.design_error:.2g} standard errors"
        emulated.append(f"Another design's optimum would differ by {error}.")
    sentences += emulated
    if fit.ridge is not None:
        sentences.append(
            "Directions that the data do not identify were regularised; their values are arbitrary."
        )
    names = np.array(evaluator.hyperparameters.readable_names)
    indirect = names[only_through_prior(evaluator)]
    if indirect.size and not search.settings.prior:
        sentences.append(
            f"The data inform {', '.join(indirect)} only through other hyperparameters and the "
            "prior, which is not minimised: their values are arbitrary; use prb.sample_smc."
        )
    return sentences


def optimum_findings(
    evaluator: Evaluator,
    sampling: SamplingDistribution | None,
    optima: Sequence[LocalOptimum],
    design_error: float,
) -> Findings:
    """Report few specimens, the design's error, other optima, and identification."""
    findings = []
    for node in evaluator.nodes:
        findings += few_for_whitening(node.name, node.target)
    findings += design_error_findings(evaluator, design_error)
    findings += [mode.finding(evaluator) for mode in optima if mode.comparable]
    if sampling is not None:
        findings += few_specimens(evaluator)
        ends, bounds = ends_by_metric(sampling), bounds_by_metric(sampling)
        page = "optimum_or_abc.md#few-specimens-and-a-prior-that-knows-something"
        one_sided, names = end_and_bound_findings(ends, bounds or [], page)
        findings += one_sided
        findings += unidentified_findings(
            evaluator, sampling.local, names, has_bounds=bounds is not None
        )
        findings += confounding_findings(evaluator, sampling.local)
    return tuple(findings)
