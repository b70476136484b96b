"""The deterministic route.

`minimize` moves the hyperparameters until the discrepancy is smallest.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
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
from prbayes.inference.asymptotics import Local
from prbayes.inference.checks.flat_edge import breakdown_findings, elements_at_edge
from prbayes.inference.checks.identification import unidentified_findings
from prbayes.inference.checks.metric_suitability import data_between_runs, heavy_tails
from prbayes.inference.checks.smoothing_bias import smoothing_bias
from prbayes.inference.design_error import design_error
from prbayes.inference.refits import (
    SamplingDistribution,
    jumping_simulators,
    sampling_of_functions,
)
from prbayes.inference.requirements import sampling_obstacle
from prbayes.inference.resampling import SETS
from prbayes.model.budgets import explained, kept
from prbayes.model.coverage import shortcomings
from prbayes.model.evaluator import Evaluator, has_other_terms, n_design_runs, only_through_prior
from prbayes.model.locking import locked
from prbayes.model.parameters import THETAS, Hyperparameters
from prbayes.model.random_variable import simulators
from prbayes.model.specimen_variable import specimen_likelihoods
from prbayes.optimize.convergence import (
    OVERLAP,
    OVERLAP_ENOUGH,
    Approach,
    Run,
    Search,
    Trace,
    apart_from_data,
    approach,
    best_or_nearest,
    minimise,
    settle,
)
from prbayes.optimize.convergence import start as begin
from prbayes.optimize.design_refinement import (
    AGREE,
    FEW_SETS,
    MAX_ROUNDS,
    grow,
    noise_floors,
    pilot,
    refine_at,
    refuse,
    refuse_lost,
    runs_left,
    spread_along,
    spread_around,
)
from prbayes.optimize.findings import optimum_findings
from prbayes.optimize.local_optima import Best, Rival, excluded, rivals, standing, visit
from prbayes.optimize.maximum_likelihood import maximize_likelihood
from prbayes.optimize.methods import Method
from prbayes.optimize.objective import Hold
from prbayes.optimize.optimum import Optimum
from prbayes.optimize.solution import assemble, rival_record
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
    """Add design points where the posterior's populations live, until the designs support them.

    `minimize` and `sample_smc` call it; call it yourself before `pymc.sample` on models with
    several aleatory inputs or wide priors.

    Parameters
    ----------
    model : pymc.Model, optional
        The one on the context by default.
    thetas : ndarray, shape (P, d), optional
        Unconstrained hyperparameters whose populations matter; by default those around the optimum.
    max_seconds : float, optional
        Seconds after which nothing new is begun.
    max_runs : int, optional
        Largest number of responses to compute, the first runs included; those found in a store
        do not count.
    progressbar : bool
        Whether work of more than two seconds shows a bar on stderr.

    Returns
    -------
    dict
        The number of stored responses by simulator.

    Raises
    ------
    DesignError
        If a design does not support them after eight more batches, or at ``max_points``.
    BudgetError
        If a budget is spent before they are supported; whole batches of points stay in the designs.

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
    wanted = None if thetas is None else _thetas(Hyperparameters.of(model), thetas)
    with (
        shown(progressbar),
        explained(model, "prb.refine"),
        limited(max_seconds, max_runs),
    ):
        evaluator = Evaluator.of(model)
        if wanted is None:
            require_finished(find_optimum(evaluator, Minimisation()))
        else:
            for _ in range(MAX_ROUNDS):
                if not refine_at(evaluator, wanted):
                    break
            refuse(shortcomings(evaluator, wanted), evaluator)
    return {name: bound.n_runs for name, bound in evaluator.reweighted.items()}


def _thetas(hyperparameters: Hyperparameters, thetas: Any) -> Floats:
    """Return thetas, shape (P, d), or raise if they are none of the model's."""
    found = real_array(thetas, "thetas")
    size = hyperparameters.size
    if found.ndim != 2 or found.shape[1] != size or not len(found):
        raise ValueError(
            f"thetas: got shape {found.shape}, expected (P, {size}) with P >= 1: a row for each "
            f"population, a column for each of {hyperparameters.names}"
        )
    if not np.isfinite(found).all():
        raise ValueError("thetas: got NaN or infinite values, expected finite ones")
    return found


# Points of the prior from which other optima are searched for where a theta costs no response; the
# better half of four times as many. More take time, fewer may leave out a basin: with half or twice
# as many the same optima are found (docs/constants.md).
_STARTS = 32
# Points of the prior that tell whether other terms weigh, or only exclude some of them. By
# judgement, half or twice changes no answer (docs/constants.md); a power of two, as Sobol points
# are balanced then.
_TERMS = 64
# Of the noise floor: about the difference of the discrepancy between the data's fit and the
# truth's. It decides which optima are told of: of five problems half or twice changes what is said
# of one each, no optimum and no standard error (docs/constants.md).
_NOISE_SHARE = 0.3
# Looks at other optima, between which designs are refined for one of them.
_LOOKS = 3
# Optima, of those on too few points, that clouds are led to.
_VISITED = 4


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
    spread. With several simulators the sum of d_k / s_k is minimised: s_k is epsilon where it was
    given, and else the sampling noise of d_k, the mean discrepancy of data sets drawn from the
    model, at a pilot optimum. Beside other likelihood terms, potentials or the prior, s_k is
    epsilon: what is minimised is then minus a log-density.

    Parameters
    ----------
    model : pymc.Model, optional
        The one on the context by default.
    start : dict, optional
        A value for each free variable, in the user's own units. By default the best of 256 Sobol
        points of the prior where they cost no response (`Reweighted`), and else the model's initial
        point. Where no simulated response is near the data at the start, the area metric leads from
        there to where some are.
    method : str or callable, optional
        BFGS by default, with exact gradients where there are any (`Reweighted`; `Resimulated` if
        the response accepts PyTensor variables, which is tried) and differences on common points
        elsewhere. Any other method of `scipy.optimize.minimize` that needs no Hessian, by its name,
        or a function as scipy takes it: ``method(fun, x0, args, jac=..., callback=..., **options)
        -> OptimizeResult``. It works on standardised parameters, that start at zero; ``jac`` is
        None under `Fresh`.
    options : mapping, optional
        For scipy's ``options=``, in units of the standardised problem; they replace those that are
        set otherwise.
    prior : bool
        Add minus the log prior; every simulator needs an epsilon, then.
    tolerance : float
        Of the standardised problem: the gradient's largest element, or the smallest step of methods
        without gradient, with parameters in units of the prior's spread and the objective in units
        of its typical size.
    max_evaluations : int
        Largest number of evaluations of the objective by the optimiser in all, whatever the method.
    refine : bool
        Whether designs of `Reweighted` that do not support the optimum get more points.
    starts : int, optional
        Number of Sobol points of the prior from which other optima, such as mirror solutions, are
        searched for, all at once; 0 for none. By default 32 where a theta costs no response
        (`Reweighted`), and else none.
    max_seconds : float, optional
        Seconds after which nothing new is begun: what was found until then is returned, with
        ``stopped`` and not converged. The same call on the same model, built again, with a larger
        budget gives the optimum that it would have given at once; with a ``store`` it computes
        nothing again.
    max_runs : int, optional
        Largest number of responses to compute, the first runs included; those found in a store
        do not count. As for ``max_seconds``.
    random_seed : int, sequence of int, numpy.random.Generator or None
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
        If ``start`` does not fit the model, or there is no such method; or if the prior, other
        likelihood terms or potentials are to be weighed against a discrepancy without epsilon.
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
    asked = Minimisation(
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
        return find_optimum(Evaluator.of(model), asked)


@dataclass(frozen=True)
class Minimisation:
    """What `minimize` is asked for."""

    start: dict[str, Any] | None = None
    method: Method = field(default_factory=Method)
    prior: bool = False
    tolerance: float = 1e-6
    max_evaluations: int = 5000
    refine: bool = True
    starts: int | None = None
    random_seed: int = 0


def find_optimum(evaluator: Evaluator, asked: Minimisation) -> Optimum:
    """Do what `minimize` does, for an evaluator.

    Raises
    ------
    BudgetError
        If a budget is spent before the discrepancy is known anywhere.
    """
    if not evaluator.nodes:
        return maximize_likelihood(evaluator, asked)
    for node in evaluator.nodes:
        node.bound.restart(asked.random_seed)
    last = None
    with progress("runs") as advance:
        plan = _planned(evaluator, asked, advance)
        begun = _begun(plan, asked)
        try:
            for state in _states(plan, begun):
                last = state
            assert last is not None
            return _reported(plan, begun, last)
        except BudgetError as spent:
            if last is None:
                raise
            with unlimited():
                return _stopped(plan, begun, last, str(spent))


def require_finished(optimum: Optimum) -> Optimum:
    """Return an optimum that no budget ended, or raise that it was spent."""
    if optimum.stopped:
        raise BudgetError(optimum.stopped)
    return optimum


# -- what a minimisation is, and where it stands ---------------------------------------------------


@dataclass(frozen=True)
class _Plan:
    """What is to be done: the search, and what goes on around it."""

    search: Search
    several: bool  # whether there are several simulators, so that their scales matter
    refine: bool
    starts: int
    seed: int
    clock: float  # when it began
    responses_before: int  # computed before it began, without those of designs
    advance: Callable[[int, str], None]  # of the bar that tells of runs: how many more, and a note

    @property
    def evaluator(self) -> Evaluator:
        """The model's evaluator."""
        return self.search.evaluator

    def held(self, hold: Hold | None) -> Search:
        """Return the search, kept where it is held."""
        return replace(self.search, hold=hold)


@dataclass(frozen=True)
class _Beginning:
    """Where a minimisation begins."""

    scales: Floats  # (k,): by which the simulators' discrepancies are divided at first
    led: Approach
    screened: int  # points that were screened for it


@dataclass(frozen=True)
class _State:
    """Where the minimisation stands."""

    theta: Floats  # (d,): the best so far
    scales: Floats  # (k,): by which the simulators' discrepancies are divided
    run: Run  # the last one, with the trace of all
    # The sampling distribution of the minimiser around theta; None where nothing is known of it.
    sampling: SamplingDistribution | None
    design_error: float = np.nan  # of the design, in standard errors; NaN where it is not known
    # (m, d), or None: thetas to which a pilot led, around which the design grows.
    cloud: Floats | None = None
    hold: Hold | None = None  # what keeps the search where designs support it
    # (d,), or None: where to minimise again, on a design that has grown.
    restart: Floats | None = None
    left: Floats | None = None  # (d,), or None: an optimum that was left, and may be the better one
    others: tuple[Rival, ...] = ()  # other optima

    @property
    def local(self) -> Local | None:
        """To first order."""
        return None if self.sampling is None else self.sampling.local


# -- before ----------------------------------------------------------------------------------------


def _refuse_random(evaluator: Evaluator, method: Method) -> None:
    """Raise if a method of scipy that follows gradients is to follow those of random draws."""
    random = [n.name for n in evaluator.nodes if n.bound.random]
    if random and method.gradient and isinstance(method.method, str):
        raise TypeError(
            f"{random[0]}: prb.Fresh draws new responses at every evaluation, so the method "
            f"{method.name} has no gradient to follow; pass epsilon= to prb.sample_smc, which then "
            "needs no optimum, use prb.minimize(method='Nelder-Mead'), or "
            "propagation=prb.Reweighted() or prb.Resimulated()"
        )


def _planned(
    evaluator: Evaluator, asked: Minimisation, advance: Callable[[int, str], None]
) -> _Plan:
    """Return what is to be done."""
    clock = time.perf_counter()
    _refuse_random(evaluator, asked.method)
    stored = n_design_runs(evaluator)
    free = not evaluator.responses_per_theta
    return _Plan(
        search=Search(
            evaluator,
            evaluator.hyperparameters.prior_sd,
            asked.method,
            asked.prior,
            asked.tolerance,
            asked.max_evaluations,
        ),
        several=len(evaluator.nodes) > 1,
        refine=asked.refine,
        starts=(_STARTS if free else 0) if asked.starts is None else asked.starts,
        seed=asked.random_seed,
        clock=clock,
        responses_before=evaluator.n_responses - stored,
        advance=advance,
    )


def _begun(plan: _Plan, asked: Minimisation) -> _Beginning:
    """Return a start, and the way from there to where simulated responses meet the data."""
    weighed = _require_weights(plan.evaluator, prior=asked.prior)
    scales = _initial_scales(plan, weighed=weighed)
    theta, screened = begin(plan.search, asked.start, scales, plan.seed)
    led = approach(plan.search, theta, scales, plan.seed)
    return _Beginning(scales, led, screened)


def _require_weights(evaluator: Evaluator, *, prior: bool) -> bool:
    """Return whether log-densities are added to the discrepancies.

    Raises
    ------
    ValueError
        If there are some, and an epsilon is not set: their weights would mean nothing.
    """
    if prior:
        others = "minus the log prior (prior=True)"
    elif _other_terms_weigh(evaluator):
        others = "other likelihood terms or potentials"
    else:
        return False
    unset = [node.name for node in evaluator.nodes if np.isnan(node.epsilon_value)]
    if unset:
        raise ValueError(
            f"prb.minimize: got {others} beside simulators without epsilon, {unset}, expected an "
            "epsilon of each, without which a discrepancy has no weight against a log-density; "
            "pass epsilon= to prb.Simulator, or calibrate one on the simulators alone, in a model "
            "without other terms and with prior=False: "
            "prb.set_epsilon(model, dict(prb.calibrate_epsilon(prb.minimize(alone))))"
        )
    return True


def _other_terms_weigh(evaluator: Evaluator) -> bool:
    """Return whether other terms do more than to exclude hyperparameters."""
    if not has_other_terms(evaluator):
        return False
    thetas = evaluator.hyperparameters.prior_points(_TERMS, 0)
    values = evaluator.log_other(thetas)
    finite = values[np.isfinite(values)]
    return finite.size > 0 and bool(np.ptp(finite) > 0)


def _initial_scales(plan: _Plan, *, weighed: bool) -> Floats:
    """Return epsilons where they are given and matter, else typical sizes of discrepancies."""
    evaluator = plan.evaluator
    if not (plan.several or weighed):
        return np.ones(1)
    natural = np.array([n.target.scale for n in evaluator.nodes])
    epsilon = evaluator.epsilon
    return np.where(np.isnan(epsilon), natural, epsilon)


# -- steps -----------------------------------------------------------------------------------------


def _states(plan: _Plan, begun: _Beginning) -> Iterator[_State]:
    """Yield where the minimisation stands after each step; the last is where it ended."""
    # Step: minimise, look at the design, until it is enough
    led = begun.led
    state = yield from _minimised(plan, led.theta, begun.scales, led.trace)
    rounds = 0
    while (state := _judged(plan, state, rounds)).restart is not None:
        rounds += 1
        before = state
        led = _led(plan, state.restart, state)
        state = yield from _minimised(plan, led.theta, state.scales, led.trace, before)
        left = before.left
        if left is not None and _is_better(plan, left, state):
            state = yield from _minimised(plan, left, state.scales, state.run.trace, before)
    yield state
    state = yield from _released(plan, state)
    yield state
    # Terminate: other optima, stalled line searches, the error of the design where it ended
    state = _against_rivals(plan, state)
    yield state
    yield _settled(plan, state)


def _minimised(
    plan: _Plan, theta: Floats, scales: Floats, trace: Trace, before: _State | None = None
) -> Generator[_State, None, _State]:
    """Minimise from theta; with several simulators again, with the noise at that pilot optimum.

    What led there before, and what holds the search, stays.
    """
    cloud = None if before is None else before.cloud
    hold = None if before is None else before.hold
    search = plan.held(hold)
    run = minimise(search, theta, scales, trace)
    yield _State(run.best, scales, run, None, cloud=cloud, hold=hold)
    unset = np.isnan(plan.evaluator.epsilon)
    if plan.several and unset.any():
        noise = noise_floors(plan.evaluator, run.best, SETS)
        scales = np.where(unset, noise, plan.evaluator.epsilon)
        run = minimise(search, run.best, scales, run.trace)
        yield _State(run.best, scales, run, None, cloud=cloud, hold=hold)
    sampling = _sampling(plan.evaluator, run.best, scales)
    return _State(run.best, scales, run, sampling, cloud=cloud, hold=hold)


def _led(plan: _Plan, theta: Floats, state: _State, least: float = OVERLAP) -> Approach:
    """Return where the area metric leads from theta; theta itself where the data are near."""
    return approach(plan.search, theta, state.scales, plan.seed, state.run.trace, least)


def _is_better(plan: _Plan, theta: Floats, state: _State) -> bool:
    """Return whether the objective at theta is below that where the minimisation stands."""
    there, here = plan.evaluator.total(np.array([theta, state.theta]), state.scales)
    return bool(there < here)


def _judged(plan: _Plan, state: _State, rounds: int) -> _State:
    """Judge the designs; where they are not enough, add points and say where to begin again.

    Raises
    ------
    DesignError
        If they still fall short after the last round.
    """
    evaluator = plan.evaluator
    if not (plan.refine and evaluator.reweighted):
        return state
    near = state.cloud
    emulated = all(bound.design.is_emulated for bound in evaluator.reweighted.values())
    if near is None or (emulated and state.local is not None):
        # Points of clouds follow wherever it goes; runs are added where the pilot has led.
        near = spread_around(
            state.theta, _covariance(state), evaluator.hyperparameters.prior_sd, seed=plan.seed
        )
    if state.hold is not None and state.local is not None:
        near = spread_along(state.theta, state.local, seed=plan.seed)
    near = near[evaluator.hyperparameters.in_support(near)]
    short = shortcomings(evaluator, near) or shortcomings(evaluator, state.theta[None])
    if not short:
        # Enough for the populations; for the optimum?
        apart = apart_from_data(evaluator, state.theta)
        if rounds < MAX_ROUNDS and apart_from_data(evaluator, state.theta, OVERLAP_ENOUGH):
            # Enough for a minimum that is no fit, or a poor one, where a thin design may end: on,
            # the way that the area metric leads.
            ahead = _led(plan, state.theta, state, OVERLAP_ENOUGH).theta
            if refine_at(evaluator, ahead[None]):
                return replace(state, restart=ahead, left=None if apart else state.theta)
        if apart:
            return state
        if state.sampling is None:
            return state
        errors = design_error(state.sampling)
        state = replace(state, design_error=errors.whole)
        if not errors.whole > AGREE:
            return state
        left = runs_left(evaluator, errors)
        note = f"error {errors.whole:.2f} standard errors, {AGREE} are wanted"
        note += f", about {left} runs to go" if left else ", no more runs are needed"
        before = n_design_runs(evaluator)
        if not grow(evaluator, near, errors):
            return state
        plan.advance(n_design_runs(evaluator) - before, note)
    elif rounds == MAX_ROUNDS:
        # A search follows what is not identified until no design supports it.
        known = [] if state.local is None else unidentified_findings(evaluator, state.local)
        refuse(short, evaluator, known)
    elif state.cloud is None:
        near = pilot(evaluator, state.scales, seed=plan.seed)
        state = replace(state, cloud=near)
    elif (hold := _holding(plan, state)) is not None:
        refine_at(evaluator, hold.place[None] if state.hold is None else near)
        return replace(state, hold=hold, restart=hold.place)
    else:
        again = rounds > 1 and near is state.cloud
        if not refine_at(evaluator, near, again=again):
            refine_at(evaluator, state.theta[None], again=again)
    # What looked best on a thin design may be an artefact of it.
    candidates = np.vstack([state.theta, near])
    return replace(state, restart=best_or_nearest(plan.search, candidates, state.scales))


def _holding(plan: _Plan, state: _State) -> Hold | None:
    """Return what keeps the search where designs support it, None where the data tell all.

    Along what the data do not tell a search follows the error of the design, and further from the
    design there is more of it. It is held by as much as sampling noise in a spread of the prior.
    """
    evaluator = plan.evaluator
    if state.cloud is None or plan.search.prior:
        return None
    place = state.theta
    if state.hold is None or shortcomings(evaluator, place[None]):
        place = _likeliest(plan, state.cloud, state.scales)
    sampling = _sampling(evaluator, place, state.scales)
    if sampling is None or not sampling.local.unidentified.size:
        return None
    return Hold(place, sampling.local.unidentified, _noise(evaluator, place, state.scales))


def _released(plan: _Plan, state: _State) -> Generator[_State, None, _State]:
    """Minimise without a hold along what designs have come to tell since, if they support it.

    A thin design does not tell everything that one tells which has grown.
    """
    hold, local = state.hold, state.local
    if hold is None or local is None or local.unidentified.shape[1] >= hold.directions.shape[1]:
        return state
    left = replace(hold, directions=local.unidentified) if local.unidentified.size else None
    before = replace(state, hold=left)
    free = yield from _minimised(plan, state.theta, state.scales, state.run.trace, before)
    lost = free.local is None or shortcomings(plan.evaluator, free.theta[None])
    return state if lost else free


def _likeliest(plan: _Plan, thetas: Floats, scales: Floats) -> Floats:
    """Return, of thetas that fit as well as the best, the one closest to the prior's middle."""
    evaluator = plan.evaluator
    values = evaluator.total(thetas, scales)
    best = thetas[np.argmin(values)]
    as_good = values <= values.min() + _noise(evaluator, best, scales)
    candidates = thetas[as_good]
    middle = np.median(evaluator.hyperparameters.prior_thetas(THETAS, plan.seed), axis=0)
    away = (candidates - middle) / evaluator.hyperparameters.prior_sd
    return np.asarray(candidates[np.argmin((away**2).sum(axis=1))])


def _noise(evaluator: Evaluator, theta: Floats, scales: Floats) -> float:
    """Return the mean of the objective over data sets drawn from the model at theta."""
    return float((noise_floors(evaluator, theta, FEW_SETS) / scales).sum())


def _against_rivals(plan: _Plan, state: _State) -> _State:
    """Look for other optima, and leave for a better one."""
    if not plan.starts or state.local is None:
        return state
    others = _rivals(plan, state)
    if not others or not others[0].better:
        return replace(state, others=tuple(others))
    better = others[0].theta
    search = plan.held(state.hold)
    run = minimise(search, better, state.scales, state.run.trace)
    if plan.refine and refine_at(plan.evaluator, run.best[None]):
        run = minimise(search, run.best, state.scales, run.trace)
    sampling = _sampling(plan.evaluator, run.best, state.scales)
    state = replace(state, theta=run.best, run=run, sampling=sampling)
    if sampling is None:
        return state
    others = _rivals(plan, state)
    return replace(state, others=tuple(others))


def _rivals(plan: _Plan, state: _State) -> list[Rival]:
    """Return other optima, refining where designs are too thin for one that matters."""
    evaluator = plan.evaluator
    assert state.local is not None
    floors = noise_floors(evaluator, state.theta, FEW_SETS)
    noise = _NOISE_SHARE * float((floors / state.scales).sum())
    best = Best(
        evaluator=evaluator,
        theta=state.theta,
        scales=state.scales,
        local=state.local,
        noise=noise,
        hold=state.hold,
    )
    search = partial(rivals, best, starts=plan.starts, seed=plan.seed)
    emulated = any(bound.design.is_emulated for bound in evaluator.reweighted.values())
    if emulated and plan.refine:
        found = _visited(best, search())
    else:
        found = _supported(plan, search)
    return excluded(evaluator, state.theta, found, _NOISE_SHARE * floors)


def _visited(best: Best, found: list[Rival]) -> list[Rival]:
    """Return optima that stand up where clouds reach them, which they do afterwards."""
    evaluator = best.evaluator
    supported = _of_support(evaluator, found)
    few = [r.theta for r in found if r not in supported][:_VISITED]
    ends = [visit(best, theta) for theta in few]
    real = [end for end in ends if end is not None]
    if not real:
        return supported
    refine_at(evaluator, np.stack(real), beside=best.theta[None])
    thetas = np.stack([r.theta for r in supported] + real)
    return _of_support(evaluator, standing(best, thetas))


def _of_support(evaluator: Evaluator, found: list[Rival]) -> list[Rival]:
    """Return the optima that designs support, each by itself."""
    return [r for r in found if not shortcomings(evaluator, r.theta[None])]


def _supported(plan: _Plan, search: Callable[[], list[Rival]]) -> list[Rival]:
    """Return optima that designs support, with runs more where one that matters has too few."""
    evaluator = plan.evaluator
    # Most need one look.
    for look in range(_LOOKS):
        found = search()
        supported = _of_support(evaluator, found)
        thin = [r for r in found if (r.better or r.comparable) and r not in supported]
        if not thin or not plan.refine or look == _LOOKS - 1:
            break
        refine_at(evaluator, thin[0].theta[None])
    return supported


def _settled(plan: _Plan, state: _State) -> _State:
    """Settle a line search that gave up; what is known of the optimum is then that of its place."""
    before = state.theta
    run = settle(plan.held(state.hold), state.run)
    if plan.refine and refine_at(plan.evaluator, run.best[None], beside=before[None]):
        # A simplex goes where few points have a lower value.
        run = settle(plan.held(state.hold), state.run)
        if shortcomings(plan.evaluator, run.best[None]):
            run = state.run
    state = replace(state, theta=run.best, run=run)
    if state.sampling is None:
        return state
    away = np.abs(state.theta - before)
    # A simplex that settles a line search mostly moves less, and standard errors change by less.
    if (away > 0.01 * plan.evaluator.hyperparameters.prior_sd).any():
        sampling = _sampling(plan.evaluator, state.theta, state.scales)
        state = replace(state, sampling=sampling)
    known = not np.isnan(state.design_error) and not away.any()
    if known or state.sampling is None:
        return state
    return replace(state, design_error=design_error(state.sampling).whole)


# -- after -----------------------------------------------------------------------------------------


def _reported(plan: _Plan, begun: _Beginning, state: _State) -> Optimum:
    """Return the record; where nothing is known of the sampling distribution, it has none."""
    evaluator = plan.evaluator
    edge, jump = _breakdown(plan, state)
    if edge or jump:
        state = replace(state, sampling=None, others=())
    found = assemble(
        plan.search,
        state.run,
        covariance=_covariance(state),
        functions=None if state.sampling is None else sampling_of_functions(state.sampling),
        remark=begun.led.remark,
        screened=begun.screened,
        responses_before=plan.responses_before,
    )
    refuse_lost(evaluator, {name: each["lost_mass"] for name, each in found.support.items()})
    findings = report(
        *breakdown_findings(edge, jump),
        *heavy_tails(evaluator, state.theta),
        *data_between_runs(evaluator, state.theta),
        *smoothing_bias(evaluator, state.theta, state.scales, state.local),
        *optimum_findings(evaluator, state.sampling, state.others, state.design_error),
    )
    ran_out = f" {', '.join(edge)} ran to the edge of the support." if edge else ""
    told = _told_of_designs(evaluator, state.design_error)
    told += _HELD if state.hold is not None else ""
    told += "" if found.prior else _told_by_prior(evaluator)
    return replace(
        found,
        converged=found.converged and not edge,
        message=found.message + ran_out + told,
        seconds=time.perf_counter() - plan.clock,
        design_error=state.design_error,
        rivals=tuple(rival_record(evaluator, o) for o in state.others),
        findings=findings,
        at_edge=edge,
        at_jump=jump,
    )


_HELD = (
    " Along what the data do not tell the search was held near where designs support populations; "
    "any other place there would do."
)


def _told_by_prior(evaluator: Evaluator) -> str:
    """Say which hyperparameters the data tell through others only, by the prior."""
    names = evaluator.hyperparameters.readable_names
    above = [name for name, own in zip(names, only_through_prior(evaluator), strict=True) if own]
    if not above:
        return ""
    return (
        f" Of {', '.join(above)} the data tell through other hyperparameters and the prior, which "
        "is not minimised: they are anywhere here, and prb.sample_smc finds them."
    )


def _told_of_designs(evaluator: Evaluator, error: float) -> str:
    """Say how many runs emulators rest on, and how far another design's optimum would be."""
    designs = {name: bound.design for name, bound in evaluator.reweighted.items()}
    told = [design.summary(name) for name, design in designs.items() if design.is_emulated]
    if not told:
        return ""
    if np.isfinite(error):
        told.append(f"Another design's optimum would differ by {error:.2g} standard errors.")
    return " " + " ".join(told)


def _stopped(plan: _Plan, begun: _Beginning, state: _State, reason: str) -> Optimum:
    """Return the record of a minimisation that a budget ended; no response is computed for it."""
    found = assemble(
        plan.search,
        state.run,
        covariance=_covariance(state),
        functions=None if state.sampling is None else sampling_of_functions(state.sampling),
        remark=f"{begun.led.remark} {reason} before the minimisation was finished.",
        screened=begun.screened,
        responses_before=plan.responses_before,
        stopped=reason,
    )
    finding = Finding(
        "budget-spent",
        f"{reason} before the minimisation was finished, so that this is no answer yet; "
        f"{kept(plan.evaluator.model)}; call prb.minimize with a larger budget, on a model that is "
        "built again, to go on.",
        "expensive.md#a-night-is-not-enough",
    )
    seconds = time.perf_counter() - plan.clock
    return replace(found, seconds=seconds, findings=report(finding))


def _breakdown(plan: _Plan, state: _State) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the elements at an edge, and the simulators at a jump."""
    if state.sampling is None:
        return (), ()
    evaluator = plan.evaluator
    edge = elements_at_edge(
        evaluator,
        state.theta,
        state.scales,
        size=plan.search.size(state.theta, state.scales),
        tolerance=plan.search.tolerance,
        seed=plan.seed,
    )
    jump = tuple(evaluator.nodes[k].name for k in jumping_simulators(state.sampling))
    return edge, jump


def _sampling(evaluator: Evaluator, theta: Floats, scales: Floats) -> SamplingDistribution | None:
    """Return the sampling distribution of the minimiser, or None where nothing is known of it."""
    if sampling_obstacle(evaluator) is not None:
        return None
    return SamplingDistribution.of(evaluator, theta, scales)


def _covariance(state: _State) -> Floats:
    """Return the sampling covariance, (d, d); NaN where nothing is known."""
    if state.local is None:
        return np.full((state.theta.size, state.theta.size), np.nan)
    return state.local.in_theta
