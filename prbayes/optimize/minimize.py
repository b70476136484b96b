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

from prbayes._finding import Finding, report
from prbayes._progress import progress, shown
from prbayes._validate import (
    Floats,
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
)
from prbayes.inference.checks.metric_suitability import (
    data_between_runs,
    heavy_tails,
    smoothing_bias,
)
from prbayes.inference.checks.prior import prior_end_findings, prior_ends
from prbayes.inference.design_error import design_error
from prbayes.inference.refits import SamplingDistribution, jumping_simulators
from prbayes.inference.resampling import SETS
from prbayes.metrics.multivariate import components_summary
from prbayes.model.cost import explained, kept
from prbayes.model.description import labelled
from prbayes.model.evaluator import Evaluator, n_design_runs, only_through_prior, shortcomings
from prbayes.model.locking import locked
from prbayes.model.parameters import (
    THETAS,
    Hyperparameters,
    readable_variables,
    split_elements,
    table_elements,
)
from prbayes.model.random_variable import simulators
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.optimize.convergence import Fit, Search, Trace, approach, minimise, settle
from prbayes.optimize.design_refinement import (
    AGREE,
    MAX_ROUNDS,
    Restart,
    noise_floors,
    refine_at,
    refine_designs,
    refuse,
    refuse_lost,
    sampling_distribution,
)
from prbayes.optimize.local_optima import Rival, find_rivals
from prbayes.optimize.maximum_likelihood import maximize_likelihood
from prbayes.optimize.objective import Method, Ridge, initial_scales
from prbayes.optimize.optimum import Optimum, SearchRecord, n_computed, optimum_of
from prbayes.propagation.importance import SIZES
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
        thetas = _require_thetas(Hyperparameters.of(model), thetas)
    with (
        shown(progressbar),
        explained(model, "prb.refine"),
        limited(max_seconds, max_runs),
    ):
        evaluator = Evaluator.of(model)
        if thetas is None:
            require_finished(find_optimum(evaluator, Minimisation()))
        else:
            for _ in range(MAX_ROUNDS):
                if not refine_at(evaluator, thetas):
                    break
            refuse(shortcomings(evaluator, thetas), evaluator)
    return {name: bound.n_runs for name, bound in evaluator.reweighted.items()}


def _require_thetas(hyperparameters: Hyperparameters, values: Any) -> Floats:
    """Return thetas, shape (P, d), or raise if they do not fit the model."""
    thetas = real_array(values, "thetas")
    size = hyperparameters.size
    if thetas.ndim != 2 or thetas.shape[1] != size or not len(thetas):
        raise ValueError(
            f"thetas: got shape {thetas.shape}, expected (P, {size}) with P >= 1: a row for each "
            f"population, a column for each of {hyperparameters.names}"
        )
    if not np.isfinite(thetas).all():
        raise ValueError("thetas: got NaN or infinite values, expected finite ones")
    return thetas


@locked
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
        else none.
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
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0,
    ...     4.0])
    >>> optimum = prb.minimize(model)
    >>> bool(abs(optimum.point["mu"] - 1) < 0.1)
    True
    """
    model = model_on_context(model, "prb.minimize")
    if starts is not None:
        positive_integer(starts, "starts", minimum=0)
    settings = Minimisation(
        start=start,
        method=Method.of(method, options),
        prior=flag(prior, "prior"),
        tolerance=positive_number(tolerance, "tolerance"),
        max_evaluations=positive_integer(max_evaluations, "max_evaluations"),
        refine=flag(refine, "refine"),
        starts=starts,
        random_seed=seed_number(random_seed),
    )
    with (
        shown(progressbar),
        explained(model, "prb.minimize"),
        limited(max_seconds, max_runs),
    ):
        return find_optimum(Evaluator.of(model), settings)


@dataclass(frozen=True)
class Minimisation:
    """Settings of `minimize`."""

    start: dict[str, Any] | None = None
    method: Method = field(default_factory=Method)
    prior: bool = False
    tolerance: float = 1e-6
    max_evaluations: int = 5000
    refine: bool = True
    starts: int | None = None
    random_seed: int = 0


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is minimised, and the fits so far."""

    search: Search
    settings: Minimisation
    advance: Callable[[int, str], None]  # of the progress bar: number of runs, and a note
    n_previous: int  # responses computed before, without those of designs
    n_screened: int  # points of the prior that were compared
    n_approach: int  # evaluations of the area metric that led to the start
    fits: list[Fit] = field(default_factory=list)  # of each step; a spent budget reports the last

    @property
    def evaluator(self) -> Evaluator:
        """The model's evaluator."""
        return self.search.evaluator

    def keep(self, fit: Fit) -> Fit:
        """Record a fit."""
        self.fits.append(fit)
        return fit


def find_optimum(evaluator: Evaluator, settings: Minimisation) -> Optimum:
    """Minimise as `minimize` does; raise BudgetError if it is spent before the first minimum."""
    if not evaluator.nodes:
        return maximize_likelihood(evaluator, settings)
    for node in evaluator.nodes:
        node.bound.stream, node.bound.draws = settings.random_seed, 0
    clock = time.perf_counter()
    search = Search(
        evaluator,
        evaluator.hyperparameters.prior_sd,
        settings.method,
        settings.prior,
        settings.tolerance,
        settings.max_evaluations,
    )
    search.refuse_random()
    n_previous = evaluator.n_responses - n_design_runs(evaluator)
    with progress("runs") as advance:
        scales = initial_scales(evaluator, prior=settings.prior)
        theta, n_screened = _start(search, settings, scales)
        theta, trace = approach(search, theta, scales, settings.random_seed, Trace())
        problem = _Problem(search, settings, advance, n_previous, n_screened, trace.count)
        try:
            fit, rivals = _optimise(problem, theta, scales, trace)
            optimum = _report(problem, fit, rivals)
        except BudgetError as spent:
            if not problem.fits:
                raise
            with unlimited():
                optimum = _report(problem, problem.fits[-1], [], stopped=str(spent))
    record = replace(
        optimum.search,
        seconds=time.perf_counter() - clock,
        n_computed=n_computed(evaluator),
    )
    return replace(optimum, search=record)


def require_finished(optimum: Optimum) -> Optimum:
    """Return an optimum that no budget ended, or raise BudgetError."""
    if optimum.search.stopped:
        raise BudgetError(optimum.search.stopped)
    return optimum


def _optimise(
    problem: _Problem, theta: Floats, scales: Floats, trace: Trace
) -> tuple[Fit, list[Rival]]:
    """Minimise on designs that grow until they support the minimum, then compare local optima."""
    fit = _fit(problem, theta, scales, trace)
    if problem.settings.refine:
        for round_ in count():
            fit, restart = refine_designs(
                *(problem.search, fit, round_, problem.settings.random_seed, problem.advance)
            )
            if restart is None:
                break
            fit = _refit(problem, fit, restart)
    problem.keep(fit)
    fit = problem.keep(_with_less_ridge(problem, fit))
    fit, rivals = _compare_rivals(problem, fit)
    return problem.keep(_settle(problem, problem.keep(fit))), rivals


def _start(search: Search, settings: Minimisation, scales: Floats) -> tuple[Floats, int]:
    """Return a starting point, and the number of points of the prior that were compared."""
    hyperparameters = search.evaluator.hyperparameters
    if settings.start is not None:
        return hyperparameters.unconstrained(settings.start), 0
    if search.evaluator.responses_per_theta:
        return hyperparameters.initial, 0
    points = hyperparameters.prior_points(THETAS, settings.random_seed)
    candidates = np.concatenate([hyperparameters.initial[None], points])
    return search.best_of(candidates, scales), len(candidates)


# -- minimisation ----------------------------------------------------------------------------------


def _fit(
    problem: _Problem,
    theta: Floats,
    scales: Floats,
    trace: Trace,
    cloud: Floats | None = None,
    ridge: Ridge | None = None,
) -> Fit:
    """Minimise from theta; with several simulators again, with the noise at that pilot optimum."""
    evaluator = problem.evaluator
    search = replace(problem.search, ridge=ridge)
    fit = problem.keep(Fit(minimise(search, theta, scales, trace), cloud=cloud, ridge=ridge))
    is_unset = np.isnan(evaluator.epsilon)
    if len(evaluator.nodes) > 1 and is_unset.any():
        noise = noise_floors(evaluator, fit.theta, SETS)
        scales = np.where(is_unset, noise, evaluator.epsilon)
        fit = problem.keep(replace(fit, run=minimise(search, fit.theta, scales, fit.run.trace)))
    return replace(fit, sampling=sampling_distribution(evaluator, fit.theta, fit.scales))


def _refit(problem: _Problem, fit: Fit, restart: Restart) -> Fit:
    """Minimise again from a restart, and from its alternative if that is better."""
    seed, alternative = problem.settings.random_seed, restart.alternative
    theta, trace = approach(problem.search, restart.theta, fit.scales, seed, fit.run.trace)
    fit = _fit(problem, theta, fit.scales, trace, restart.cloud, restart.ridge)
    if alternative is not None:
        thetas = np.array([alternative, fit.theta])
        earlier, later = problem.evaluator.total(thetas, fit.scales)
        if earlier < later:
            trace = fit.run.trace
            fit = _fit(problem, alternative, fit.scales, trace, restart.cloud, restart.ridge)
    return fit


def _with_less_ridge(problem: _Problem, fit: Fit) -> Fit:
    """Minimise without the ridge along directions that grown designs have come to identify."""
    ridge, local = fit.ridge, fit.local
    if ridge is None or local is None or local.unidentified.shape[1] >= ridge.directions.shape[1]:
        return fit
    rest = replace(ridge, directions=local.unidentified) if local.unidentified.size else None
    refit = _fit(problem, fit.theta, fit.scales, fit.run.trace, fit.cloud, rest)
    is_lost = refit.local is None or shortcomings(problem.evaluator, refit.theta[None])
    return fit if is_lost else refit


def _compare_rivals(problem: _Problem, fit: Fit) -> tuple[Fit, list[Rival]]:
    """Search for other optima; move to a better one."""
    evaluator, settings = problem.evaluator, problem.settings
    n_starts = settings.starts
    if n_starts is None:
        n_starts = 0 if evaluator.responses_per_theta else 32
    rivals: list[Rival] = []
    for is_first in (True, False):
        if not n_starts or fit.local is None:
            return fit, []
        rivals = find_rivals(
            *(evaluator, fit.theta, fit.scales, fit.local, fit.ridge),
            starts=n_starts,
            seed=settings.random_seed,
            refine=settings.refine,
        )
        if not (is_first and rivals and rivals[0].better):
            break
        search = replace(problem.search, ridge=fit.ridge)
        run = minimise(search, rivals[0].theta, fit.scales, fit.run.trace)
        if settings.refine and refine_at(evaluator, run.best[None]):
            run = minimise(search, run.best, fit.scales, run.trace)
        sampling = sampling_distribution(evaluator, run.best, fit.scales)
        fit = replace(fit, run=run, sampling=sampling)
    return fit, rivals


def _settle(problem: _Problem, fit: Fit) -> Fit:
    """Settle a line search that gave up, and complete the fit at its end."""
    evaluator = problem.evaluator
    search = replace(problem.search, ridge=fit.ridge)
    run = settle(search, fit.run)
    if problem.settings.refine and refine_at(evaluator, run.best[None], beside=fit.theta[None]):
        # A simplex may move to where few points have a lower value by accident.
        run = settle(search, fit.run)
        if shortcomings(evaluator, run.best[None]):
            run = fit.run
    shift = np.abs(run.best - fit.theta)
    fit = replace(fit, run=run)
    if fit.sampling is None:
        return fit
    # Standard errors change less than the theta of a settled line search.
    if (shift > 0.01 * evaluator.hyperparameters.prior_sd).any():
        sampling = sampling_distribution(evaluator, fit.theta, fit.scales)
        fit = replace(fit, sampling=sampling)
    if fit.sampling is None or not (np.isnan(fit.design_error) or shift.any()):
        return fit
    return replace(fit, design_error=design_error(fit.sampling).whole)


# -- report ----------------------------------------------------------------------------------------


def _report(problem: _Problem, fit: Fit, rivals: list[Rival], *, stopped: str = "") -> Optimum:
    """Return the optimum of the last fit, and log its findings.

    No response is computed if a budget has ``stopped`` the minimisation.
    """
    evaluator, search = problem.evaluator, problem.search
    at_edge: tuple[str, ...] = ()
    at_jump: tuple[str, ...] = ()
    if fit.sampling is not None and not stopped:
        at_edge = elements_at_edge(
            evaluator,
            fit.theta,
            fit.scales,
            size=search.size(fit.theta, fit.scales),
            tolerance=search.tolerance,
            seed=problem.settings.random_seed,
        )
        at_jump = tuple(evaluator.nodes[k].name for k in jumping_simulators(fit.sampling))
        if at_edge or at_jump:
            fit, rivals = replace(fit, sampling=None), []
    record = SearchRecord(
        result=fit.run.result,
        prior=search.prior,
        details=f"{fit.run.details} {_details(problem, fit, at_edge, stopped)}".strip(),
        n_evaluations=fit.run.trace.count,
        n_screened=problem.n_screened,
        trace=fit.run.trace.arrays(fit.theta.size),
        stopped=stopped,
        at_edge=at_edge,
        at_jump=at_jump,
    )
    optimum = optimum_of(search, fit, record, problem.n_previous)
    if stopped:
        finding = Finding(
            "budget-spent",
            f"{stopped} before the minimisation was finished, so that this is no answer yet; "
            f"{kept(evaluator.model)}; call prb.minimize with a larger budget, on a model that is "
            "built again, to go on.",
            "expensive.md#a-night-is-not-enough",
        )
        return replace(optimum, findings=report(finding))
    refuse_lost(
        evaluator, {name: numbers["lost_mass"] for name, numbers in optimum.support.items()}
    )
    findings = report(
        *breakdown_findings(at_edge, at_jump),
        *heavy_tails(evaluator, fit.theta),
        *data_between_runs(evaluator, fit.theta),
        *smoothing_bias(evaluator, fit.theta, fit.scales, fit.local),
        *optimum_findings(evaluator, fit.sampling, rivals, fit.design_error),
    )
    records = tuple(rival.record(evaluator) for rival in rivals)
    return replace(optimum, design_error=fit.design_error, rivals=records, findings=findings)


def _details(problem: _Problem, fit: Fit, at_edge: tuple[str, ...], stopped: str) -> str:
    """Return sentences about start, edges, designs and directions that are not identified."""
    evaluator = problem.evaluator
    sentences = []
    if problem.n_approach:
        sentences.append(
            "At the start hardly any simulated response was near the data: the area metric led "
            f"from there, in {problem.n_approach} evaluations."
        )
    if stopped:
        return " ".join([*sentences, f"{stopped} before the minimisation was finished."])
    if at_edge:
        sentences.append(f"{', '.join(at_edge)} ran to the edge of the support.")
    designs = [
        bound.design.summary(name)
        for name, bound in evaluator.reweighted.items()
        if bound.design.is_emulated
    ]
    sentences += designs
    if designs and np.isfinite(fit.design_error):
        sentences.append(
            f"Another design's optimum would differ by {fit.design_error:.2g} standard errors."
        )
    if fit.ridge is not None:
        sentences.append(
            "Directions that the data do not identify were regularised; their values are arbitrary."
        )
    names = np.array(evaluator.hyperparameters.readable_names)
    indirect = names[only_through_prior(evaluator)]
    if indirect.size and not problem.search.prior:
        sentences.append(
            f"The data inform {', '.join(indirect)} only through other hyperparameters and the "
            "prior, which is not minimised: their values are arbitrary; use prb.sample_smc."
        )
    return " ".join(sentences)


def optimum_findings(
    evaluator: Evaluator,
    sampling: SamplingDistribution | None,
    rivals: Sequence[Rival],
    design_error: float,
) -> tuple[Finding, ...]:
    """Report what the metric leaves out, the design's error, other optima, and identification."""
    missed = {n.name: components_summary(n.target, missed=True) for n in evaluator.nodes}
    findings = [
        Finding("components-left-out", f"{name}: {text}.") for name, text in missed.items() if text
    ]
    # An estimate from eight blocks is itself uncertain by a quarter.
    if design_error > 1.5 * AGREE:
        findings.append(_design_finding(evaluator, design_error))
    findings += [_second_mode(evaluator, rival) for rival in rivals if rival.comparable]
    if sampling is not None:
        ends = prior_ends(sampling)
        page = "optimum_or_abc.md#few-specimens-and-a-prior-that-knows-something"
        findings += prior_end_findings(ends, page)
        names = {end.name for end in ends}
        findings += unidentified_findings(evaluator, sampling.local, names)
        findings += confounding_findings(evaluator, sampling.local)
    return tuple(findings)


def _design_finding(evaluator: Evaluator, error: float) -> Finding:
    """Report a large error of the optimum by the design."""
    designs = [bound.design for bound in evaluator.reweighted.values()]
    runs = max(len(design.runs) for design in designs)
    if min(len(design.emulated or ()) for design in designs) < SIZES.largest:
        advice = f"pass a larger n or max_points to prb.Reweighted (now {runs} runs)"
    else:
        advice = (
            f"between its {runs} runs are {SIZES.largest} emulated points, the most there are: "
            "more runs help as far as the emulator is off, which the message says, and the rest "
            "counts as another error of the optimum"
        )
    return Finding(
        "design-error",
        f"The optimum of another design would differ by about {error:.2f} standard errors, "
        f"expected at most {AGREE}; {advice}.",
        "choose.md#how-many-responses",
    )


def _second_mode(evaluator: Evaluator, rival: Rival) -> Finding:
    """Report another optimum."""
    hyperparameters = evaluator.hyperparameters
    # Beside a second point, so that constants can be recognised.
    points = hyperparameters.constrained(np.stack([rival.theta, hyperparameters.initial]))
    names = readable_variables([str(rv.name) for rv in evaluator.model.free_RVs], points)
    values = labelled(evaluator, {name: points[name] for name in names}, {"point": 2}).data_vars
    elements = split_elements(values)
    place = ", ".join(f"{name} = {elements[name][0]:.4g}" for name in table_elements(values))
    return Finding(
        "second-mode",
        f"The data could as well come from {place}: another optimum, or mirror "
        "solution, whose discrepancy differs by no more than sampling noise; state a prior that "
        "excludes one, or report both.",
        "optimum_or_abc.md#two-answers",
    )
