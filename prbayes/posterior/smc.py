"""Sequential Monte Carlo from the prior (Del Moral, Doucet and Jasra 2006): `sample_smc`."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any, Literal

import numpy as np
import pymc as pm
import xarray as xr
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from threadpoolctl import threadpool_limits

from prbayes._finding import Finding, report
from prbayes._progress import CONSOLE, lines, live, shown
from prbayes._validate import Floats, Seed, file_path, flag, positive_integer, seed_number, share
from prbayes.model.cost import designs_as_before, explained
from prbayes.model.evaluator import (
    Evaluator,
    coarser_evaluator,
    is_current,
    missing_mass,
    n_design_runs,
    shortcomings,
)
from prbayes.model.fingerprint import identity_of, require_same
from prbayes.model.locking import locked
from prbayes.model.parameters import THETAS
from prbayes.model.random_variable import log_kernel
from prbayes.model.specimen_preparation import prepared
from prbayes.optimize.design_refinement import MAX_ROUNDS, refine_at, refuse, refuse_lost
from prbayes.optimize.minimize import Minimisation, find_optimum, require_finished
from prbayes.optimize.optimum import Optimum, require_sampling
from prbayes.posterior.epsilon import calibrate_epsilon, checked_epsilon
from prbayes.posterior.importance import LogDensity
from prbayes.posterior.kernel import BatchedKernel, Checkpoint, starting_thetas, stored_settings
from prbayes.posterior.results import (
    Draws,
    Stages,
    arviz_groups,
    as_multitrace,
    posterior_tree,
    require_idata_kwargs,
    require_names,
    selected,
    share_of_lossy,
)
from prbayes.posterior.target import estimate_target, prior_conflicts, require_density
from prbayes.propagation.base import Missing, discrepancy_error
from prbayes.response.budget import BudgetError, limited, unlimited
from prbayes.response.inputs import model_on_context

_log = logging.getLogger("prbayes")

Adjustment = Literal["estimate"] | None

_SAVED = ("thetas", "discrepancies", "lost")  # arrays of a finished chain


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

    It samples the same posterior as `sample`, also with several modes. With ``adjustment=None`` it
    samples the pseudo-posterior of approximate Bayesian computation, whose density is proportional
    to the prior times :math:`\exp(-\sum_k d_k / \epsilon_k)`.

    Parameters
    ----------
    draws : int
        Particles, and draws, of each chain.
    chains : int
        Independent runs.
    model : pymc.Model, optional
        The one on the context by default.
    epsilon : float or dict, optional
        With ``adjustment=None``, for this run. By default the simulators' own, calibrated if unset
        (`calibrate_epsilon`).
    optimum : Optimum, optional
        The estimate that the posterior is given, and where to calibrate epsilon; by default from
        `minimize`, if needed.
    adjustment : {"estimate", None}
        With "estimate" the posterior is that given the metrics' own estimate, whose width follows
        from the number of specimens. With None epsilon determines the width. The log-likelihood by
        specimen has one posterior.
    threshold : float
        Effective sample size after a stage, as a share; higher means more stages.
    refine : bool
        Whether designs of `Reweighted` that do not support the posterior get more points.
    start : mapping or sequence of mapping, optional
        Initial particles, for all chains or by chain: arrays, (draws, ...), by the names of the
        free variables, or of their transformed values, such as ``sigma_log__``. They must be draws
        of the prior, as by default; otherwise the posterior is another one.
    cores : int, optional
        Largest number of threads of linear algebra. Particles are evaluated in batches in this
        process, one chain after the other; a propagation's ``executor`` computes responses.
    return_inferencedata : bool
        With False a ``pymc.backends.base.MultiTrace`` of the draws alone.
    idata_kwargs : dict, optional
        ``log_likelihood=False`` and ``log_prior=False`` leave these groups out; ``dims`` and
        ``coords`` name dimensions and coordinates that the model does not name.
    var_names : sequence of str, optional
        Variables and deterministics of the result; all by default. Predictions require all free
        variables.
    max_stages : int, optional
        Largest number of stages of a chain. If a budget is spent, the finished chains are returned,
        if there are any; the attribute ``stopped`` and a warning report it, and designs that grew
        are restored. The same call with a larger budget and the same ``checkpoint`` continues, and
        returns the draws of an uninterrupted run.
    max_seconds : float, optional
        Seconds after which no new work begins.
    max_runs : int, optional
        Largest number of responses to compute, the first runs included; those from a store do not
        count.
    checkpoint : path-like, optional
        A file with the state after every stage: a run that was killed continues there when it is
        called again, and returns the same draws. Give the propagations a ``store`` as well, so that
        the search for the optimum computes no response again.
    random_seed : int, sequence of int, numpy.random.Generator or None
    progressbar : bool

    Returns
    -------
    xarray.DataTree
        For ArviZ; ``to_netcdf`` saves it. Groups:

        - ``posterior`` (chain, draw), with the attributes ``adjustment``,
          ``log_marginal_likelihood``, from all chains, to compare models with one metric and one
          epsilon, and ``log_marginal_likelihood_sd``, the spread between chains.
        - ``sample_stats`` (chain, stage), NaN after the last stage.
        - ``calibration``, by simulator: discrepancy, epsilon, effective sample size of the weights,
          mean raw weight, lost mass (of 64 draws if it costs responses), ``lossy_draws``, the share
          of draws with more lost mass than ``max_lost``, and ``discrepancy_error``, the Monte Carlo
          error of the discrepancy at the best draw.
        - ``observed_data``, ``prior``, ``log_prior``, and ``log_likelihood`` for power-scaling,
          with one number for each draw.
        - ``posterior_predictive`` and ``prior_predictive`` of simulators with stored responses.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, no prior draw has a finite density, or the optimum is
        needed and at an edge or a jump (``search.at_edge``, ``search.at_jump``).
    DesignError
        If a design does not support the posterior after refinement.
    StoreError
        If the checkpoint is damaged, or belongs to another run.
    BudgetError
        If a budget is spent before a chain is finished.

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
    require_adjustment(adjustment)
    flag(refine, "refine")
    share(threshold, "threshold")
    if checkpoint is not None:
        file_path(checkpoint, "checkpoint")
    require_optimum(optimum)
    if max_stages is not None:
        positive_integer(max_stages, "max_stages")
    names = require_names(var_names, model)
    keywords = require_idata_kwargs(idata_kwargs)
    flag(return_inferencedata, "return_inferencedata")
    if cores is not None:
        positive_integer(cores, "cores")
    settings = SamplingSettings(
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
        tree = sample(evaluator, settings)
        if not return_inferencedata:
            return as_multitrace(tree, evaluator)  # type: ignore[no-any-return]
        return selected(tree, names, keywords)


@dataclass(frozen=True, eq=False)
class SamplingSettings:
    """Arguments of `sample_smc` and `sample`."""

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
    with_groups: bool = False  # whether the result has the groups of `arviz_groups`


def require_adjustment(adjustment: object) -> None:
    """Raise unless it is "estimate" or None."""
    if adjustment is not None and adjustment != "estimate":
        raise ValueError(
            f'adjustment: got {adjustment!r}, expected "estimate", or None for draws of '
            "exp(-discrepancy / epsilon)"
        )


def require_optimum(optimum: object) -> None:
    """Raise unless it is an optimum or None."""
    if optimum is not None and not isinstance(optimum, Optimum):
        got = type(optimum).__name__
        raise TypeError(f"optimum: got {got}, expected an Optimum; call prb.minimize() first")


def evaluator_of(model: pm.Model, optimum: Optimum | None, caller: str) -> Evaluator:
    """Return the evaluator of a model; raise if the optimum is of another problem."""
    if optimum is None:
        return Evaluator.of(model)
    is_reusable = optimum.model is model and is_current(optimum.evaluator)
    evaluator = optimum.evaluator if is_reusable else Evaluator.of(model)
    require_same(optimum.identity, identity_of(evaluator), f"{caller}: optimum")
    return evaluator


def sample(evaluator: Evaluator, settings: SamplingSettings) -> xr.DataTree:
    """Return draws of the posterior, or of the pseudo-posterior with ``adjustment=None``."""
    is_pseudo = _is_pseudo(evaluator, settings)
    if settings.epsilon is not None and not is_pseudo:
        raise ValueError(
            f"epsilon: got {settings.epsilon!r}, expected none: this posterior has no scale to "
            "choose; leave epsilon= out, or pass adjustment=None with a metric"
        )
    clock = time.perf_counter()
    n_before = evaluator.n_responses - n_design_runs(evaluator)
    with _epsilons_restored(evaluator), designs_as_before(evaluator) as restore_designs:
        if is_pseudo:
            optimum = _set_epsilons(evaluator, settings)
        else:
            optimum = estimate_of(evaluator, settings, "sample_smc")
        draws, log_likelihood = _draws_on_designs(evaluator, settings, optimum)
        if is_pseudo:
            draws = _with_errors(evaluator, draws)
        elif log_likelihood is not None:
            logs = log_likelihood(draws.thetas.reshape(-1, evaluator.hyperparameters.size))
            draws = replace(draws, log_likelihood=logs.reshape(draws.thetas.shape[:2]))
        tree = result_of(evaluator, draws, settings, optimum, n_before=n_before, clock=clock)
        if draws.stopped:
            restore_designs()
        return tree


def _is_pseudo(evaluator: Evaluator, settings: SamplingSettings) -> bool:
    """Return whether the density is prior times exp(-sum of d_k / epsilon_k)."""
    return bool(evaluator.nodes) and settings.adjustment is None


def estimate_of(evaluator: Evaluator, settings: SamplingSettings, caller: str) -> Optimum | None:
    """Return the estimate that the posterior is given, by a search if needed.

    With a log-likelihood by specimen it is the optimum that was passed, if any. Raises ValueError
    if the density of the estimate is not known, or the optimum is at an edge or a jump.
    """
    optimum = settings.optimum
    if not evaluator.nodes:
        return optimum
    require_density(evaluator)
    if optimum is None:
        optimum = require_finished(find_optimum(evaluator, Minimisation(refine=settings.refine)))
    return require_sampling(optimum, caller)


def result_of(
    evaluator: Evaluator,
    draws: Draws,
    settings: SamplingSettings,
    optimum: Optimum | None,
    *,
    n_before: int,
    clock: float,
) -> xr.DataTree:
    """Return the DataTree of draws.

    Discrepancies are computed if that costs no response. ``n_before`` and ``clock`` are the number
    of responses and the time at the start. Raises DesignError if too much of the populations of
    most draws has no response.
    """
    findings = list(_budget_findings(draws, settings))
    thetas, lost, discrepancies = draws.thetas, draws.lost, draws.discrepancies
    rows = thetas.reshape(-1, evaluator.hyperparameters.size)
    is_pseudo = _is_pseudo(evaluator, settings)
    if not is_pseudo:
        lost = _lost_of_some(evaluator, thetas)
        _refuse_lost(evaluator, lost)
        discrepancies = np.full(lost.shape, np.nan)
    assert lost is not None
    with unlimited():
        if is_pseudo and settings.with_groups:
            kernels = np.asarray(log_kernel(discrepancies, evaluator.epsilon))
            other_terms = evaluator.log_other(rows).reshape(thetas.shape[:2])
            draws = replace(draws, log_likelihood=kernels.sum(axis=-1) + other_terms)
        elif not is_pseudo and evaluator.nodes and not evaluator.responses_per_theta:
            discrepancies = evaluator(rows).discrepancies.reshape(lost.shape)
        draws = replace(draws, discrepancies=discrepancies, lost=lost)
        groups = {}
        if settings.with_groups:
            groups = arviz_groups(evaluator, draws, settings.random_seed)
        findings += _lost_findings(evaluator, lost)
        if optimum is not None:
            findings += optimum.findings
            if evaluator.nodes and not is_pseudo:
                findings += prior_conflicts(optimum, evaluator, thetas)
        elif not is_pseudo:
            for likelihood in evaluator.likelihoods:
                findings += prepared(likelihood).findings
        return posterior_tree(
            evaluator,
            draws,
            adjustment="estimate" if evaluator.nodes and not is_pseudo else "none",
            findings=findings,
            seed=settings.random_seed,
            n_responses=evaluator.n_responses - n_before,
            seconds=time.perf_counter() - clock,
            groups=groups,
        )


def _budget_findings(draws: Draws, settings: SamplingSettings) -> tuple[Finding, ...]:
    """Report that a budget was spent before all chains were finished."""
    if not draws.stopped:
        return ()
    again = "" if settings.checkpoint is None else f" and checkpoint={settings.checkpoint}"
    finding = Finding(
        "budget-spent",
        f"{draws.stopped}, so that {len(draws.stages)} of {settings.chains} chains are here, and "
        "what would have cost responses is left out; call prb.sample_smc with a larger "
        f"budget{again}.",
        "expensive.md#a-night-is-not-enough",
    )
    return report(finding)


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
            place = np.unravel_index(row, (chains, draws))
            for k, node in enumerate(evaluator.nodes):
                if not node.bound.stored:
                    population = evaluator.populations(thetas[place][None], k)
                    lost[(*place, k)] = Missing.of(*population).lost[0]
    except BudgetError:
        pass
    return lost


def _refuse_lost(
    evaluator: Evaluator,
    lost: Floats,
    missing: Mapping[str, Mapping[str, float]] | None = None,
) -> None:
    """Raise if too much of the populations of most draws has no response.

    ``lost``, (chains, draws, k), is NaN if not known; ``missing`` is that of the best draw, by
    simulator.
    """
    shares = {}
    for k, node in enumerate(evaluator.nodes):
        shares[node.name] = 0.0 if missing is None else missing[node.name]["lost_mass"]
        if not np.isnan(lost[:, :, k]).all():
            shares[node.name] = max(shares[node.name], float(np.nanmedian(lost[:, :, k])))
    refuse_lost(evaluator, shares)


def _lost_findings(evaluator: Evaluator, lost: Floats) -> tuple[Finding, ...]:
    """Report that the populations of many draws lack responses; `diagnose` does for designs."""
    findings = []
    for k, node in enumerate(evaluator.nodes):
        limit = node.bound.max_lost
        share = share_of_lossy(lost[:, :, k], limit)
        if share > 0.05:  # a few draws may be far out
            findings.append(
                Finding(
                    "lost-mass",
                    f"{node.name}: lost mass: of {share:.0%} of the draws more than max_lost = "
                    f"{limit:.1%} of the population has no response (NaN), so that they rest on "
                    "the specimens that have one; repair the response, return +inf for specimens "
                    "that fail, or narrow the priors.",
                    "expensive.md#when-a-run-fails",
                )
            )
    return report(*findings)


# -- the pseudo-posterior --------------------------------------------------------------------------


@contextmanager
def _epsilons_restored(evaluator: Evaluator) -> Iterator[None]:
    """Restore the epsilons of the simulators afterwards."""
    epsilons = evaluator.epsilon
    try:
        yield
    finally:
        for node, value in zip(evaluator.nodes, epsilons, strict=True):
            node.epsilon.set_value(np.asarray(value))


def _set_epsilons(evaluator: Evaluator, settings: SamplingSettings) -> Optimum | None:
    """Set the epsilons, passed or calibrated; return the optimum if it is known."""
    epsilon, nodes = settings.epsilon, evaluator.nodes
    if epsilon is not None:
        names = [node.name for node in nodes]
        if not isinstance(epsilon, dict):
            if len(names) > 1:
                raise ValueError(
                    f"epsilon: got one number for {len(names)} simulators, "
                    f"expected a dict by name: {names}"
                )
            epsilon = {names[0]: epsilon}
        values = checked_epsilon(epsilon, nodes, evaluator.model, "sample_smc: epsilon")
        for node in nodes:
            if node.name in values:
                node.epsilon.set_value(np.asarray(values[node.name]))
    unset = [node for node in nodes if np.isnan(node.epsilon_value)]
    optimum = settings.optimum
    if not unset:
        return optimum
    if optimum is None:
        optimum = require_finished(find_optimum(evaluator, Minimisation(refine=settings.refine)))
    require_sampling(optimum, "sample_smc")
    calibrated = calibrate_epsilon(optimum)
    for node in unset:
        node.epsilon.set_value(np.asarray(calibrated[node.name]))
    return optimum


def _with_errors(evaluator: Evaluator, draws: Draws) -> Draws:
    """Return draws with errors of the discrepancies and missing responses at the best one."""
    assert draws.discrepancies is not None
    assert draws.lost is not None
    total = (draws.discrepancies / evaluator.epsilon).sum(axis=-1)
    best = draws.thetas[np.unravel_index(total.argmin(), total.shape)]
    errors = []
    missing = {}
    try:
        for k, node in enumerate(evaluator.nodes):
            errors.append(discrepancy_error(node.bound, evaluator.roots(best[None], k)))
            missing[node.name] = missing_mass(evaluator, best, k)
    except BudgetError as spent:
        return replace(draws, stopped=draws.stopped or str(spent))
    _refuse_lost(evaluator, draws.lost, missing)
    return replace(draws, errors=np.array(errors), missing=missing)


# -- chains ----------------------------------------------------------------------------------------


def _draws_on_designs(
    evaluator: Evaluator, settings: SamplingSettings, optimum: Optimum | None
) -> tuple[Draws, LogDensity | None]:
    """Return draws that the designs support, after refinements, and their log-likelihood.

    Raises DesignError if the refined designs do not support the draws, and BudgetError if a budget
    is spent before.
    """
    starts = _starts(evaluator, settings)
    checkpoint = _checkpoint(evaluator, settings, starts)
    entropy = settings.random_seed if checkpoint is None else int(checkpoint.settings["entropy"])
    seeds = np.random.SeedSequence(entropy)
    refinements: list[Floats] = []
    for round_ in range(MAX_ROUNDS + 1):
        children = seeds.spawn(settings.chains)
        if checkpoint is not None and round_ < checkpoint.note.get("round", 0):
            refinements.append(checkpoint.arrays[f"refined{round_}_thetas"])
            refine_at(evaluator, refinements[-1])
            continue
        log_likelihood = None
        if evaluator.nodes and not _is_pseudo(evaluator, settings):
            assert optimum is not None
            log_likelihood = estimate_target(evaluator, optimum).log_likelihood
        chains = Chains(evaluator, settings, log_likelihood, starts, checkpoint, tuple(refinements))
        draws = chains.run(children)
        if not (settings.refine and evaluator.reweighted):
            break
        rows = draws.thetas.reshape(-1, evaluator.hyperparameters.size)
        thetas = np.random.default_rng(seeds).permutation(rows)[:THETAS]
        if draws.stopped and shortcomings(evaluator, thetas):
            raise BudgetError(draws.stopped)
        if round_ == MAX_ROUNDS:
            refuse(shortcomings(evaluator, thetas), evaluator)
            break
        if not refine_at(evaluator, thetas):
            break
        refinements.append(thetas)
        _log.info("sampling again on the refined design")
    return draws, log_likelihood


def _starts(evaluator: Evaluator, settings: SamplingSettings) -> list[Floats] | None:
    """Return the particles that each chain begins with, None for draws of the prior."""
    start, chains = settings.start, settings.chains
    if start is None:
        return None
    by_chain = list(start) if isinstance(start, list | tuple) else [start] * chains
    if len(by_chain) != chains:
        raise ValueError(
            f"start: got {len(by_chain)} dicts, expected one, or {chains}, one for each chain"
        )
    hyperparameters = evaluator.hyperparameters
    return [starting_thetas(hyperparameters, values, settings.draws) for values in by_chain]


def _checkpoint(
    evaluator: Evaluator, settings: SamplingSettings, starts: list[Floats] | None
) -> Checkpoint | None:
    """Open the checkpoint; a run without a seed takes that of the run that it continues."""
    path = settings.checkpoint
    if path is None:
        return None
    entropy = str(np.random.SeedSequence(settings.random_seed).entropy)
    if settings.random_seed is None:
        entropy = stored_settings(path).get("entropy", entropy)
    stored: dict[str, Any] = {
        name: getattr(settings, name)
        for name in ("draws", "chains", "threshold", "adjustment", "refine")
    }
    if starts is not None:
        content = b"".join(np.ascontiguousarray(thetas).tobytes() for thetas in starts)
        stored["start"] = hashlib.sha256(content).hexdigest()
    return Checkpoint(path, identity_of(evaluator), stored | {"entropy": entropy})


@dataclass(frozen=True, eq=False)
class Chains:
    """The chains of one round on the designs as they are, saved after each stage."""

    evaluator: Evaluator
    settings: SamplingSettings
    log_likelihood: LogDensity | None = None  # in place of exp(-sum of d_k / epsilon_k)
    starts: list[Floats] | None = None
    checkpoint: Checkpoint | None = None
    refinements: tuple[Floats, ...] = ()  # thetas, (n, d), of earlier rounds

    def run(self, seeds: Sequence[np.random.SeedSequence]) -> Draws:
        """Run a chain for each seed, or as many as a budget allows.

        Raises BudgetError if it is spent before the first one is finished.
        """
        saved = {} if self.checkpoint is None else self.checkpoint.note
        if saved.get("round") != len(self.refinements):
            saved = {}
        is_pseudo = _is_pseudo(self.evaluator, self.settings)
        coarse = coarser_evaluator(self.evaluator) if self.log_likelihood is None else None
        finished: list[dict[str, Floats]] = []
        stages: list[Stages] = []
        stopped = ""
        columns = (
            TextColumn("SMC chain {task.fields[chain]}"),
            BarColumn(),
            TextColumn("beta {task.completed:.4f}"),
            TextColumn("acceptance {task.fields[rate]:.2f}"),
            TimeElapsedColumn(),
        )
        with (
            shown(self.settings.progressbar) as visible,
            Progress(*columns, console=CONSOLE, disable=not (visible and live())) as progress,
        ):
            write = lines()
            for chain, seed in enumerate(seeds):
                task = progress.add_task("", total=1.0, chain=chain, rate=0.0)
                if self.checkpoint is not None and chain < saved.get("chain", 0):
                    finished.append(self.checkpoint.arrays_of(f"chain{chain}_"))
                    stages.append(saved["stats"][chain])
                    continue
                try:
                    kernel, chain_stages = self._begin(chain, seed, coarse, saved)
                    for _ in self._temper(kernel, chain_stages):
                        self._save(finished, [*stages, chain_stages], kernel)
                        progress.update(task, completed=kernel.beta, rate=kernel.accept_rate)
                        write(f"SMC chain {chain + 1} of {len(seeds)}: beta {kernel.beta:.3g} of 1")
                except BudgetError as spent:
                    stopped = f"{spent} in chain {chain + 1} of {len(seeds)}"
                    break
                particles = kernel.particles._asdict()
                finished.append({name: particles[name] for name in _SAVED})
                stages.append(chain_stages)
        if not finished:
            raise BudgetError(stopped)
        thetas, discrepancies, lost = (
            np.array([arrays[name] for arrays in finished]) for name in _SAVED
        )
        return Draws(
            thetas=thetas,
            sampler={"sampler": "SMC-ABC" if is_pseudo else "SMC"},
            discrepancies=discrepancies,
            lost=lost,
            stages=stages,
            stopped=stopped,
        )

    def _begin(
        self,
        chain: int,
        seed: np.random.SeedSequence,
        coarse: Evaluator | None,
        saved: Mapping[str, Any],
    ) -> tuple[BatchedKernel, Stages]:
        """Return a kernel at the prior, or in a saved state, and the statistics of its stages.

        It begins on a coarser evaluator, if there is one.
        """
        (stream,) = seed.generate_state(1)
        for node in self.evaluator.nodes:
            node.bound.stream, node.bound.draws = int(stream), 0
        is_resumed = chain == saved.get("chain")
        is_coarse = saved["state"]["is_coarse"] if is_resumed else coarse is not None
        kernel = BatchedKernel(
            self.settings.draws,
            model=self.evaluator.model,
            threshold=self.settings.threshold,
            evaluator=coarse if is_coarse and coarse is not None else self.evaluator,
            log_likelihood=self.log_likelihood,
        )
        kernel.is_coarse = is_coarse
        if self.checkpoint is None or not is_resumed:
            start = None if self.starts is None else self.starts[chain]
            kernel.initialize(start, np.random.default_rng(seed))
            return kernel, {name: [] for name in kernel.stats_dtypes_shapes}
        kernel.restore(self.checkpoint.arrays_of("now_"), saved["state"])
        for node in self.evaluator.nodes:
            if node.bound.random:
                node.bound.draws = saved["generators"][node.name]
        return kernel, saved["stats"][chain]

    def _temper(self, kernel: BatchedKernel, stages: Stages) -> Iterator[None]:
        """Do the remaining stages of a chain, and yield after each."""
        while kernel.beta < 1 or kernel.is_coarse:
            if len(stages["beta"]) == self.settings.max_stages:
                raise BudgetError(
                    f"max_stages = {self.settings.max_stages} was reached (beta {kernel.beta:.3g}, "
                    "of 1)"
                )
            if kernel.beta < 1:
                kernel.update_beta_and_weights()
            elif not kernel.reweight(self.evaluator):
                # The coarse posterior differs: once more, on all points.
                kernel.initialize(kernel.start, kernel.rng)
                for values in stages.values():
                    values.clear()
                continue
            for name, value in kernel.step().items():
                stages[name].append(value)
            yield

    def _save(
        self, finished: list[dict[str, Floats]], stages: list[Stages], kernel: BatchedKernel
    ) -> None:
        if self.checkpoint is None:
            return
        now, state = kernel.state()
        arrays = {f"now_{name}": array for name, array in now.items()}
        for i, chain in enumerate(finished):
            arrays |= {f"chain{i}_{name}": array for name, array in chain.items()}
        arrays |= {f"refined{i}_thetas": thetas for i, thetas in enumerate(self.refinements)}
        bounds = [node.bound for node in self.evaluator.nodes]
        note = {
            "round": len(self.refinements),
            "chain": len(finished),
            "stats": stages,
            "state": state,
            "generators": {bound.name: bound.draws for bound in bounds if bound.random},
        }
        self.checkpoint.save(arrays, note)
