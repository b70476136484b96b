"""Sequential Monte Carlo from the prior: `sample_smc`."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from os import PathLike
from typing import Any, Literal

import numpy as np
import pymc as pm
import xarray as xr
from threadpoolctl import threadpool_limits

from prbayes._finding import Finding, report
from prbayes._progress import shown
from prbayes._validate import Floats, Seed, file_path, flag, positive_integer, seed_number, share
from prbayes.model.budgets import designs_as_before, explained
from prbayes.model.coverage import shortcomings
from prbayes.model.epsilon import checked_epsilon
from prbayes.model.evaluator import Evaluator, is_current, missing_mass, n_design_runs
from prbayes.model.fingerprint import identity_of, require_same
from prbayes.model.locking import locked
from prbayes.model.parameters import THETAS
from prbayes.model.random_variable import log_kernel
from prbayes.optimize.design_refinement import MAX_ROUNDS, refine_at, refuse, refuse_lost
from prbayes.optimize.minimize import Minimisation, find_optimum, require_finished
from prbayes.optimize.optimum import Optimum, require_sampling
from prbayes.posterior.arviz_groups import arviz_groups, specimen_groups
from prbayes.posterior.chains import Chains, Particles, Stages
from prbayes.posterior.checkpoint import Checkpoint, stored_settings
from prbayes.posterior.epsilon import calibrate_epsilon
from prbayes.posterior.importance import LogDensity
from prbayes.posterior.initial_particles import fingerprint, starting_thetas
from prbayes.posterior.results import (
    as_asked,
    as_multitrace,
    checked_idata_kwargs,
    checked_names,
)
from prbayes.posterior.target import estimate_target, prior_conflicts, require_density
from prbayes.posterior.trees import posterior_tree, share_of_lossy
from prbayes.propagation.base import Missing, discrepancy_error
from prbayes.response.budget import BudgetError, limited, unlimited
from prbayes.response.inputs import model_on_context

_log = logging.getLogger("prbayes")

Adjustment = Literal["estimate"] | None

# Share of draws that may fall short, as single ones far out do: that of what designs support.
_FAR_OUT = 0.05


@locked
def sample_smc(
    draws: int = 1000,
    *,
    chains: int = 4,
    model: pm.Model | None = None,
    epsilon: float | dict[str, float] | None = None,
    optimum: Optimum | None = None,
    adjustment: Adjustment = "estimate",
    threshold: float = 0.5,
    refine: bool = True,
    start: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
    cores: int | None = None,
    return_inferencedata: bool = True,
    idata_kwargs: Mapping[str, Any] | None = None,
    var_names: Sequence[str] | None = None,
    max_stages: int | None = None,
    max_seconds: float | None = None,
    max_runs: int | None = None,
    checkpoint: str | PathLike[str] | None = None,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> xr.DataTree:
    r"""Draw from the posterior by sequential Monte Carlo from the prior.

    It samples the same posterior as `sample`, also where that has several modes. With
    ``adjustment=None`` it samples the pseudo-posterior of approximate Bayesian computation, whose
    density is proportional to the prior times :math:`\exp(-\sum_k d_k / \epsilon_k)`.

    Parameters
    ----------
    draws : int
        Particles, and draws, of each chain.
    chains : int
        Independent runs.
    model : pymc.Model, optional
        The one on the context by default.
    epsilon : float or dict, optional
        With ``adjustment=None``, for this run. By default the simulators' own, calibrated where
        unset (`calibrate_epsilon`).
    optimum : Optimum, optional
        The estimate that the posterior is given, and where to calibrate epsilon; `minimize` finds
        it if needed.
    adjustment : {"estimate", None}
        With "estimate" the posterior is that given the metrics' own estimate, whose width follows
        from the number of specimens. With None it is as wide as epsilon makes it. The
        log-likelihood by specimen has one posterior.
    threshold : float
        Share of the effective sample size that a stage keeps; higher means more stages.
    refine : bool
        Whether designs of `Reweighted` that do not support the posterior get more points.
    start : mapping or sequence of mapping, optional
        Particles to begin with, for all chains or for each: arrays, (draws, ...), by the names of
        the free variables, or of their transformed values, such as ``sigma_log__``. They have to
        be draws of the prior, as they are by default: others lead to another posterior.
    cores : int, optional
        Most threads that linear algebra takes. Particles are evaluated in batches in this process,
        one chain after the other; responses are computed by a propagation's ``executor``.
    return_inferencedata : bool
        With False a ``pymc.backends.base.MultiTrace`` of the draws alone.
    idata_kwargs : dict, optional
        ``log_likelihood=False`` and ``log_prior=False`` leave these groups out; ``dims`` and
        ``coords`` name dimensions and coordinates that the model does not name.
    var_names : sequence of str, optional
        Variables and deterministics that the result has; all by default. Without a free variable
        nothing can be predicted from it.
    max_stages : int, optional
        Largest number of stages of a chain. If it is reached, or another budget is spent, the
        finished chains are returned, if there are any; the attribute ``stopped`` and a warning say
        so. Designs that grew for them are then as before. The same call with a larger budget and
        the same ``checkpoint`` goes on, and gives the draws that it would have given at once.
    max_seconds : float, optional
        Seconds after which nothing new is begun.
    max_runs : int, optional
        Largest number of responses to compute, the first runs included; those found in a store
        do not count.
    checkpoint : path-like, optional
        A file that keeps the state after every stage: a run that was killed goes on from there when
        it is called again, and gives the same draws. Give the propagations a ``store`` as well, so
        that the search for the optimum computes nothing again.
    random_seed : int, sequence of int, numpy.random.Generator or None
    progressbar : bool

    Returns
    -------
    xarray.DataTree
        Groups ``posterior`` (chain, draw), ``sample_stats`` (chain, stage; NaN after the last
        stage), ``calibration`` (discrepancy, epsilon, weight effective sample size, mean raw
        weight, lost mass, of 64 draws if it costs responses, ``lossy_draws``: the share of draws
        with more lost mass than ``max_lost``; ``discrepancy_error``: the Monte Carlo error of the
        discrepancy at the best draw; by simulator) and ``observed_data``; ArviZ takes it,
        ``to_netcdf`` saves it. For ArviZ there are ``prior``, ``log_prior`` and predictive draws
        (``posterior_predictive``, ``prior_predictive``) of simulators whose responses are stored,
        and ``log_likelihood`` for power-scaling, with one number for each
        draw. Attributes of
        ``posterior``: ``adjustment``; ``log_marginal_likelihood``, from all chains, and
        ``log_marginal_likelihood_sd``, the spread of the chains' own; a number to compare models by
        with one metric and one epsilon, and with no others.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, no prior draw has a finite density, or nothing is known
        around the optimum (``search.at_edge`` and ``search.at_jump``) and it is needed.
    DesignError
        If a design does not support the posterior after refinement.
    StoreError
        If the checkpoint is damaged, or belongs to another run.
    BudgetError
        If a budget is spent before there is a chain to return.

    References
    ----------
    .. [1] Del Moral, P., A. Doucet and A. Jasra (2006), Sequential Monte Carlo samplers, J. R.
       Stat. Soc. B 68, 411-436, doi:10.1111/j.1467-9868.2006.00553.x.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     data = [0.0, 2.0, 4.0]
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=data)
    >>> idata = prb.sample_smc(100, chains=2, model=model, random_seed=1, progressbar=False)
    >>> idata.posterior["mu"].shape
    (2, 100)
    """
    positive_integer(draws, "draws", minimum=10)
    positive_integer(chains, "chains")
    model = model_on_context(model, "prb.sample_smc")
    refuse_adjustment(adjustment)
    flag(refine, "refine")
    share(threshold, "threshold")
    if checkpoint is not None:
        file_path(checkpoint, "checkpoint")
    if optimum is not None and not isinstance(optimum, Optimum):
        got = type(optimum).__name__
        raise TypeError(f"optimum: got {got}, expected an Optimum; call prb.minimize() first")
    if max_stages is not None:
        positive_integer(max_stages, "max_stages")
    names = checked_names(var_names, model)
    keywords = checked_idata_kwargs(idata_kwargs)
    flag(return_inferencedata, "return_inferencedata")
    if cores is not None:
        positive_integer(cores, "cores")
    asked = Sampling(
        draws=draws,
        chains=chains,
        epsilon=epsilon,
        optimum=optimum,
        adjustment=adjustment,
        threshold=threshold,
        refine=refine,
        start=start,
        max_stages=max_stages,
        checkpoint=checkpoint,
        random_seed=None if random_seed is None else seed_number(random_seed),
        progressbar=progressbar,
        with_groups=True,
    )
    stages = () if checkpoint is None else (f"all finished stages ({checkpoint})",)
    with (
        shown(progressbar),
        explained(model, "prb.sample_smc", *stages),
        limited(max_seconds, max_runs),
        nullcontext() if cores is None else threadpool_limits(cores),
    ):
        evaluator = evaluator_of(model, optimum, "sample_smc")
        tree = sample(evaluator, asked)
        if not return_inferencedata:
            return as_multitrace(tree, evaluator)  # type: ignore[no-any-return]
        return as_asked(tree, names, keywords)


@dataclass(frozen=True, eq=False)
class Sampling:
    """What `sample_smc` is asked for."""

    draws: int = 1000
    chains: int = 1
    epsilon: float | dict[str, float] | None = None
    optimum: Optimum | None = None
    adjustment: Adjustment = "estimate"
    threshold: float = 0.5
    refine: bool = True
    start: Any = None
    max_stages: int | None = None
    checkpoint: str | PathLike[str] | None = None
    random_seed: int | None = 0
    progressbar: bool = False
    with_groups: bool = False  # whether the result has what ArviZ looks for besides


def refuse_adjustment(adjustment: object) -> None:
    """Raise if it is not one of the two."""
    if adjustment is not None and adjustment != "estimate":
        raise ValueError(
            f'adjustment: got {adjustment!r}, expected "estimate", or None for draws of '
            "exp(-discrepancy / epsilon)"
        )


def sample(evaluator: Evaluator, asked: Sampling) -> xr.DataTree:
    """Return draws of the posterior, or of the pseudo-posterior with ``adjustment=None``."""
    if evaluator.nodes and asked.adjustment is None:
        return _sample_kernel(evaluator, asked)
    if asked.epsilon is not None:
        raise ValueError(
            f"epsilon: got {asked.epsilon!r}, expected none: this posterior has no scale to "
            "choose; leave epsilon= out, or pass adjustment=None with a metric"
        )
    return sample_posterior(evaluator, asked)


def sample_posterior(evaluator: Evaluator, asked: Sampling) -> xr.DataTree:
    """Return draws of the posterior: given the estimate, or of a log-likelihood by specimen."""
    clock = time.perf_counter()
    before = evaluator.n_responses - n_design_runs(evaluator)
    with designs_as_before(evaluator) as restore_designs:
        optimum = estimate_of(evaluator, asked, "sample_smc")
        rounds = _rounds(evaluator, asked, optimum)
        particles = rounds.until_supported(asked.progressbar)
        log_likelihood = None
        if rounds.log_likelihood is not None:
            rows = particles.thetas.reshape(-1, evaluator.hyperparameters.size)
            log_likelihood = rounds.log_likelihood(rows).reshape(particles.thetas.shape[:2])
        tree = result_tree(
            evaluator,
            particles.thetas,
            asked,
            optimum,
            {"sampler": "SMC"},
            log_likelihood=log_likelihood,
            stats=particles.stats,
            findings=_of_budget(particles.stopped, particles, asked),
            stopped=particles.stopped,
            n_before=before,
            clock=clock,
        )
        if particles.stopped:
            restore_designs()
        return tree


def estimate_of(evaluator: Evaluator, asked: Sampling, caller: str) -> Optimum | None:
    """Return the estimate that the posterior is given, by a search if needed.

    With a log-likelihood by specimen the optimum that was passed, if any.

    Raises
    ------
    ValueError
        If the density of the estimate is not known (`require_density`), or the optimum is at the
        edge of a support or at a jump.
    """
    optimum = asked.optimum
    if not evaluator.nodes:
        return optimum
    require_density(evaluator)
    if optimum is None:
        optimum = require_finished(find_optimum(evaluator, Minimisation(refine=asked.refine)))
    return require_sampling(optimum, caller)


def _sample_kernel(evaluator: Evaluator, asked: Sampling) -> xr.DataTree:
    """Return draws of prior times exp(-sum of d_k / epsilon_k)."""
    clock = time.perf_counter()
    before = evaluator.n_responses - n_design_runs(evaluator)
    with epsilons_restored(evaluator), designs_as_before(evaluator) as restore_designs:
        optimum = _calibrated(evaluator, asked)
        particles = _rounds(evaluator, asked, optimum).until_supported(asked.progressbar)
        stopped, errors, missing = particles.stopped, None, None
        try:
            errors, missing = _at_the_best(evaluator, particles)
        except BudgetError as spent:
            stopped = stopped or str(spent)
        else:
            _refuse_lost(evaluator, particles.lost, missing)
        with unlimited():
            groups = None
            if asked.with_groups:
                thetas = particles.thetas
                kernels = np.asarray(log_kernel(particles.discrepancies, evaluator.epsilon))
                other = evaluator.log_other(thetas.reshape(-1, evaluator.hyperparameters.size))
                logs = kernels.sum(axis=-1) + other.reshape(thetas.shape[:2])
                groups = arviz_groups(evaluator, thetas, logs, asked.random_seed)
            tree = posterior_tree(
                evaluator,
                particles.thetas,
                particles.discrepancies,
                particles.lost,
                particles.stats,
                sampler={"sampler": "SMC-ABC"},
                findings=(
                    *_of_budget(stopped, particles, asked),
                    *_of_lost(evaluator, particles.lost),
                    *(() if optimum is None else optimum.findings),
                ),
                errors=errors,
                missing=missing,
                stopped=stopped,
                seed=asked.random_seed,
                n_responses=evaluator.n_responses - before,
                seconds=time.perf_counter() - clock,
                groups=groups,
            )
        if stopped:
            restore_designs()
        return tree


def _of_budget(stopped: str, particles: Particles, asked: Sampling) -> tuple[Finding, ...]:
    """Say, also in the log, that a budget was spent before everything was done."""
    if not stopped:
        return ()
    again = "" if asked.checkpoint is None else f" and checkpoint={asked.checkpoint}"
    finding = Finding(
        "budget-spent",
        f"{stopped}, so that {len(particles.stats)} of {asked.chains} chains are here, and what "
        f"would have cost responses is left out; call prb.sample_smc with a larger budget{again}.",
        "expensive.md#a-night-is-not-enough",
    )
    return report(finding)


def _refuse_lost(
    evaluator: Evaluator,
    lost: Floats,
    missing: Mapping[str, Mapping[str, float]] | None = None,
) -> None:
    """Raise if too much of the populations of most draws, or of the best, has no response.

    Parameters
    ----------
    evaluator : Evaluator
    lost : ndarray, shape (chains, draws, k)
        Shares of the populations without response; NaN if not known.
    missing : mapping, optional
        By simulator, of the best draw.
    """
    shares = {}
    for k, node in enumerate(evaluator.nodes):
        shares[node.name] = 0.0 if missing is None else missing[node.name]["lost_mass"]
        values = lost[:, :, k]
        if not np.isnan(values).all():
            shares[node.name] = max(shares[node.name], float(np.nanmedian(values)))
    refuse_lost(evaluator, shares)


def _of_lost(evaluator: Evaluator, lost: Floats) -> tuple[Finding, ...]:
    """Report, also in the log, the share of draws whose populations lack too many responses.

    For designs, `diagnose` reports it.
    """
    findings = []
    for k, node in enumerate(evaluator.nodes):
        most = node.bound.max_lost
        share = share_of_lossy(lost[:, :, k], most)
        if share > _FAR_OUT:
            findings.append(
                Finding(
                    "lost-mass",
                    f"{node.name}: lost mass: of {share:.0%} of the draws more than max_lost = "
                    f"{most:.1%} of the population has no response (NaN), so that they rest on the "
                    "specimens that have one; repair the response, return +inf for specimens that "
                    "fail, or narrow the priors.",
                    "expensive.md#when-a-run-fails",
                )
            )
    return report(*findings)


def _calibrated(evaluator: Evaluator, asked: Sampling) -> Optimum | None:
    """Set the epsilons; return the optimum if they are calibrated there."""
    _set_epsilons(evaluator, asked.epsilon)
    unset = [node for node in evaluator.nodes if np.isnan(node.epsilon_value)]
    optimum = asked.optimum
    if not unset:
        return optimum
    if optimum is None:
        optimum = require_finished(find_optimum(evaluator, Minimisation(refine=asked.refine)))
    require_sampling(optimum, "sample_smc")
    calibrated = calibrate_epsilon(optimum)
    for node in unset:
        node.epsilon.set_value(np.asarray(calibrated[node.name]))
    return optimum


def _rounds(evaluator: Evaluator, asked: Sampling, optimum: Optimum | None) -> Rounds:
    """Return the rounds of sampling, perhaps with the state that a run before has saved."""
    starts = _starts(evaluator, asked)
    given = {} if starts is None else {"start": fingerprint(starts)}
    saved = _checkpoint(
        asked.checkpoint,
        evaluator,
        asked.random_seed,
        draws=asked.draws,
        chains=asked.chains,
        threshold=asked.threshold,
        adjustment=asked.adjustment,
        refine=asked.refine,
        **given,
    )
    entropy = asked.random_seed if saved is None else int(saved.settings["entropy"])
    return Rounds(
        run=Chains(evaluator, asked.draws, asked.threshold, saved, asked.max_stages, starts),
        seeds=np.random.SeedSequence(entropy),
        asked=asked,
        optimum=optimum,
    )


def _starts(evaluator: Evaluator, asked: Sampling) -> list[Floats] | None:
    """Return the particles that each chain begins with, None for draws of the prior."""
    start = asked.start
    if start is None:
        return None
    each = list(start) if isinstance(start, list | tuple) else [start] * asked.chains
    if len(each) != asked.chains:
        raise ValueError(
            f"start: got {len(each)} dicts, expected one, or {asked.chains}, one for each chain"
        )
    return [starting_thetas(evaluator.hyperparameters, one, asked.draws) for one in each]


@dataclass(eq=False)
class Rounds:
    """Sampling and refinement, again until the designs support the draws.

    Attributes
    ----------
    run : Chains
    seeds : SeedSequence
    asked : Sampling
    optimum : Optimum or None
    log_likelihood : callable or None
        Given the estimate, of the last round.
    """

    run: Chains
    seeds: np.random.SeedSequence
    asked: Sampling
    optimum: Optimum | None
    log_likelihood: LogDensity | None = None

    def until_supported(self, progressbar: bool) -> Particles:
        """Return the draws of the first round that its designs support.

        Raises
        ------
        DesignError
            If there is none.
        BudgetError
            If a budget is spent before.
        """
        evaluator = self.run.evaluator
        refines = self.asked.refine and bool(evaluator.reweighted)
        for round_ in range(MAX_ROUNDS + 1):
            children = self.seeds.spawn(self.asked.chains)
            saved = self.run.saved_refinement(round_)
            if saved is not None:
                self.run.refined.append(saved)
                refine_at(evaluator, saved)
                continue
            self.log_likelihood = self._log_likelihood()
            particles = self.run(children, progressbar, self.log_likelihood)
            if not refines:
                return particles
            rows = particles.thetas.reshape(-1, evaluator.hyperparameters.size)
            thetas = np.random.default_rng(self.seeds).permutation(rows)[:THETAS]
            if particles.stopped and shortcomings(evaluator, thetas):
                raise BudgetError(particles.stopped)
            if round_ == MAX_ROUNDS:
                refuse(shortcomings(evaluator, thetas), evaluator)
                return particles
            if not refine_at(evaluator, thetas):
                return particles
            self.run.refined.append(thetas)
            _log.info("sampling again on the refined design")
        raise AssertionError("the last round returns or raises")

    def _log_likelihood(self) -> LogDensity | None:
        """Return the log-likelihood given the estimate, on the designs as they are."""
        evaluator = self.run.evaluator
        if not evaluator.nodes or self.asked.adjustment is None:
            return None
        assert self.optimum is not None
        return estimate_target(evaluator, self.optimum).log_likelihood


def result_tree(
    evaluator: Evaluator,
    thetas: Floats,
    asked: Sampling,
    optimum: Optimum | None,
    sampler: Mapping[str, Any],
    *,
    log_likelihood: Floats | None,
    stats: Sequence[Stages] = (),
    sample_stats: xr.Dataset | None = None,
    findings: Sequence[Finding] = (),
    stopped: str = "",
    n_before: int,
    clock: float,
) -> xr.DataTree:
    """Return the DataTree of draws of the posterior, (chains, draws, d).

    With a metric ``log_likelihood``, (chains, draws), is that given the estimate. Discrepancies are
    computed where that costs no response. ``n_before`` and ``clock`` are the number of responses
    and the time at the start.

    Raises
    ------
    DesignError
        If too much of the populations of most draws has no response.
    """
    chains, draws, d = thetas.shape
    shape = (chains, draws, len(evaluator.nodes))
    discrepancies = np.full(shape, np.nan)
    lost = _lost_of_some(evaluator, thetas)
    _refuse_lost(evaluator, lost)
    with unlimited():
        if evaluator.nodes and not evaluator.responses_per_theta:
            evaluation = evaluator(thetas.reshape(-1, d))
            discrepancies = evaluation.discrepancies.reshape(shape)
        groups = None
        if asked.with_groups and log_likelihood is None:
            groups = specimen_groups(evaluator, thetas, asked.random_seed)
        elif asked.with_groups and log_likelihood is not None:
            groups = arviz_groups(evaluator, thetas, log_likelihood, asked.random_seed)
        return posterior_tree(
            evaluator,
            thetas,
            discrepancies,
            lost,
            stats,
            sampler=sampler,
            sample_stats=sample_stats,
            adjustment="estimate" if evaluator.nodes else "none",
            findings=(
                *findings,
                *_of_lost(evaluator, lost),
                *_findings(evaluator, optimum, thetas),
            ),
            stopped=stopped,
            seed=asked.random_seed,
            n_responses=evaluator.n_responses - n_before,
            seconds=time.perf_counter() - clock,
            groups=groups,
        )


def _lost_of_some(evaluator: Evaluator, thetas: Floats, count: int = 64) -> Floats:
    """Return shares of populations without response, (chains, draws, k).

    Responses that are not stored are computed at a sample of draws, within the budget. The shares
    of other draws, and of stored responses, are NaN.
    """
    chains, draws, _ = thetas.shape
    lost = np.full((chains, draws, len(evaluator.nodes)), np.nan)
    rows = np.linspace(0, chains * draws - 1, count).astype(np.intp)
    try:
        for row in np.unique(rows):
            where = np.unravel_index(row, (chains, draws))
            for k, node in enumerate(evaluator.nodes):
                if not node.bound.stored:
                    population = evaluator.populations(thetas[where][None], k)
                    lost[(*where, k)] = Missing.of(*population).lost[0]
    except BudgetError:
        pass
    return lost


def _findings(evaluator: Evaluator, optimum: Optimum | None, thetas: Floats) -> tuple[Finding, ...]:
    """Return the findings of the data, the runs and the optimum, and conflicts with the prior."""
    if optimum is None:
        return tuple(finding for each in evaluator.likelihoods for finding in each.findings)
    conflicts = prior_conflicts(optimum, evaluator, thetas) if evaluator.nodes else ()
    return (*optimum.findings, *conflicts)


@contextmanager
def epsilons_restored(evaluator: Evaluator) -> Iterator[None]:
    """Give the simulators their epsilons back afterwards."""
    before = evaluator.epsilon
    try:
        yield
    finally:
        for node, value in zip(evaluator.nodes, before, strict=True):
            node.epsilon.set_value(np.asarray(value))


def _set_epsilons(evaluator: Evaluator, epsilon: float | dict[str, float] | None) -> None:
    """Set the epsilons that were given for this run."""
    if epsilon is None:
        return
    names = [node.name for node in evaluator.nodes]
    if not isinstance(epsilon, dict):
        if len(names) > 1:
            raise ValueError(
                f"epsilon: got one number for {len(names)} simulators, "
                f"expected a dict by name: {names}"
            )
        epsilon = {names[0]: epsilon}
    values = checked_epsilon(epsilon, evaluator.nodes, evaluator.model, "sample_smc: epsilon")
    for node in evaluator.nodes:
        if node.name in values:
            node.epsilon.set_value(np.asarray(values[node.name]))


def evaluator_of(model: pm.Model, optimum: Optimum | None, caller: str) -> Evaluator:
    """Return the evaluator of a model.

    An optimum's own if it is this model's, and no optimum of another problem.
    """
    if optimum is None:
        return Evaluator.of(model)
    own = optimum.model is model and is_current(optimum.evaluator)
    evaluator = optimum.evaluator if own else Evaluator.of(model)
    require_same(optimum.identity, identity_of(evaluator), f"{caller}: optimum")
    return evaluator


def _at_the_best(
    evaluator: Evaluator, particles: Particles
) -> tuple[Floats, dict[str, dict[str, float]]]:
    """Return, of the best particle, the Monte Carlo errors of its discrepancies, and what it lacks.

    The errors have shape (k,); shares of its populations without numbers come by simulator.
    """
    total = (particles.discrepancies / evaluator.epsilon).sum(axis=-1)
    where = np.unravel_index(total.argmin(), total.shape)
    best = particles.thetas[where][None]
    errors = []
    missing = {}
    for k, node in enumerate(evaluator.nodes):
        roots = evaluator.roots(best, k)
        errors.append(discrepancy_error(node.bound, roots))
        missing[node.name] = missing_mass(evaluator, best[0], k)
    return np.array(errors), missing


def _checkpoint(
    path: str | PathLike[str] | None, evaluator: Evaluator, seed: int | None, **settings: Any
) -> Checkpoint | None:
    """Open the checkpoint; a run without a seed takes that of the run it goes on with."""
    if path is None:
        return None
    entropy = str(np.random.SeedSequence(seed).entropy)
    if seed is None:
        entropy = stored_settings(path).get("entropy", entropy)
    return Checkpoint(path, identity_of(evaluator), {**settings, "entropy": entropy})
