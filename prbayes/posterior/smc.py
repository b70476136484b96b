"""Sequential Monte Carlo from the prior (Del Moral, Doucet and Jasra 2006): `sample_smc`."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from enum import Enum, auto
from itertools import zip_longest
from typing import Any, Literal

import numpy as np
import pymc as pm
import xarray as xr
from scipy.special import logsumexp
from threadpoolctl import threadpool_limits

from prbayes._finding import Finding, Findings, as_json, report
from prbayes._progress import progress, shown
from prbayes._validate import (
    Arrays,
    Floats,
    Seed,
    StrPath,
    file_path,
    flag,
    positive_integer,
    seed_number,
    share,
)
from prbayes.inference.checks.population import refuse_lost_specimens
from prbayes.model.cost import designs_as_before, explained
from prbayes.model.evaluator import (
    Evaluator,
    epsilons,
    is_current,
    missing_mass,
    n_design_runs,
    shortcomings,
    with_unchanged_runs,
)
from prbayes.model.fingerprint import identity_of, require_same
from prbayes.model.locking import locked
from prbayes.model.parameters import THETAS
from prbayes.model.random_variable import log_kernel
from prbayes.model.specimen_audit import audited_evaluator
from prbayes.model.specimen_preparation import prepared
from prbayes.numerics.modes import LogDensity
from prbayes.optimize.design_refinement import MAX_ROUNDS, refine_at, refuse, refuse_lost
from prbayes.optimize.maximum_likelihood import determined_modes, is_known_at
from prbayes.optimize.minimize import find_optimum, require_finished
from prbayes.optimize.objective import Minimisation
from prbayes.optimize.optimum import Optimum, require_sampling
from prbayes.posterior.epsilon import calibrate_epsilon, checked_epsilon, with_kept_runs
from prbayes.posterior.kernel import BatchedKernel, Checkpoint, Stages, State, starting_thetas
from prbayes.posterior.mode_masses import bridged_modes, modes_finding
from prbayes.posterior.results import (
    AT_BEST,
    Chains,
    arviz_groups,
    as_multitrace,
    posterior_tree,
    require_selection,
    selected,
    share_of_lossy,
)
from prbayes.posterior.target import (
    Target,
    estimate_target,
    modes_of,
    prior_conflicts,
    require_density,
    specimen_target,
)
from prbayes.propagation.base import Missing, discrepancy_error
from prbayes.response.budget import BudgetError, limited, unlimited
from prbayes.response.inputs import model_on_context
from prbayes.response.store import only_writer

_log = logging.getLogger("prbayes")

Adjustment = Literal["estimate"] | None


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
    checkpoint: StrPath | None = None,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> xr.DataTree:
    r"""Draw from the posterior by sequential Monte Carlo from the prior.

    It samples the same posterior as `sample`, also with several modes, whose masses are those of
    bridge sampling. With ``adjustment=None`` it samples the pseudo-posterior of approximate
    Bayesian computation, whose density is proportional to the prior times
    :math:`\exp(-\sum_k d_k / \epsilon_k)`. There small modes have too few draws.

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
        called again, and returns the same draws. A ``store`` of the propagations keeps the
        responses of the search for the optimum.
    random_seed : int, sequence of int, numpy.random.Generator or None
    progressbar : bool
        Whether work of more than two seconds shows a bar on stderr.

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
    TypeError, KeyError, ValueError
        If an argument is not as described, no prior draw has a finite density, or the optimum is
        needed and at an edge or a jump (``search.at_edge``, ``search.at_jump``).
    DesignError
        If a design does not support the posterior after refinement.
    StoreError
        If the checkpoint is damaged, belongs to another run, or is in use by one.
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
    lock: AbstractContextManager[None] = nullcontext()
    if checkpoint is not None:
        lock = only_writer(file_path(checkpoint, "checkpoint"), "checkpoint")
    if max_stages is not None:
        positive_integer(max_stages, "max_stages")
    names, keywords = require_selection(var_names, idata_kwargs, model)
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
        lock,
        shown(progressbar),
        explained(model, "prb.sample_smc", *stages),
        limited(max_seconds, max_runs),
        nullcontext() if cores is None else threadpool_limits(cores),
    ):
        evaluator = evaluator_of(model, optimum, "sample_smc")
        tree = sample(evaluator, settings, is_audited=True)
        if not return_inferencedata:
            return as_multitrace(tree, evaluator)  # type: ignore[no-any-return]
        return selected(tree, names, keywords)


class Likelihood(Enum):
    """The likelihood of a posterior."""

    SPECIMENS = auto()  # log-likelihoods by specimen
    ESTIMATE = auto()  # density of the metrics' estimate
    PSEUDO = auto()  # exp(-discrepancy / epsilon)


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
    checkpoint: StrPath | None = None
    random_seed: int | None = 0
    progressbar: bool = False
    with_groups: bool = False  # whether the result has the groups of `arviz_groups`

    def kind(self, evaluator: Evaluator) -> Likelihood:
        """Return which likelihood the prior is multiplied by."""
        if not evaluator.nodes:
            return Likelihood.SPECIMENS
        return Likelihood.PSEUDO if self.adjustment is None else Likelihood.ESTIMATE


def require_adjustment(adjustment: object) -> None:
    """Raise unless it is "estimate" or None."""
    if adjustment is not None and adjustment != "estimate":
        raise ValueError(
            f'adjustment: got {adjustment!r}, expected "estimate", or None for draws of '
            "exp(-discrepancy / epsilon)"
        )


def evaluator_of(model: pm.Model, optimum: Optimum | None, caller: str) -> Evaluator:
    """Return the evaluator of a model; raise if the optimum is none, or of another problem."""
    if optimum is None:
        return with_unchanged_runs(Evaluator.of(model))
    if not isinstance(optimum, Optimum):
        got = type(optimum).__name__
        raise TypeError(f"optimum: got {got}, expected an Optimum; call prb.minimize() first")
    is_reusable = optimum.model is model and is_current(optimum.evaluator)
    evaluator = with_unchanged_runs(optimum.evaluator if is_reusable else Evaluator.of(model))
    require_same(optimum.search.identity, identity_of(evaluator), f"{caller}: optimum")
    return evaluator


def sample(
    evaluator: Evaluator, settings: SamplingSettings, *, is_audited: bool = False
) -> xr.DataTree:
    """Return draws of the posterior, or of the pseudo-posterior with ``adjustment=None``.

    An audit of emulators needs the data of the evaluator's model, as in `prbayes.sample`.
    """
    kind = settings.kind(evaluator)
    if settings.epsilon is not None and kind is not Likelihood.PSEUDO:
        raise ValueError(
            f"epsilon: got {settings.epsilon!r}, expected none: this posterior has no scale to "
            "choose; leave epsilon= out, or pass adjustment=None with a metric"
        )
    clock = time.perf_counter()
    n_before = evaluator.n_responses - n_design_runs(evaluator)
    nodes, earlier = evaluator.nodes, epsilons(evaluator)
    try:
        with designs_as_before(evaluator) as restore_designs:
            if kind is Likelihood.PSEUDO:
                optimum = _set_epsilons(evaluator, settings)
                chains = _with_errors(evaluator, _chains_on_designs(evaluator, settings, optimum))
            else:
                optimum = required_optimum(evaluator, settings, "sample_smc")
                is_audited &= kind is Likelihood.SPECIMENS
                evaluator, chains = _audited_chains(evaluator, settings, optimum, is_audited)
            tree = result_of(evaluator, chains, settings, optimum, n_before=n_before, clock=clock)
            if chains.stopped:
                restore_designs()
            return tree
    finally:
        for node, value in zip(nodes, earlier, strict=True):
            node.epsilon.set_value(np.asarray(value))


def required_optimum(
    evaluator: Evaluator, settings: SamplingSettings, caller: str
) -> Optimum | None:
    """Return the optimum of the settings, or the one that the density of the estimate needs."""
    optimum = settings.optimum
    if settings.kind(evaluator) is Likelihood.SPECIMENS:
        return optimum
    require_density(evaluator)
    if optimum is None:
        search = Minimisation(refine=settings.refine)
        optimum = require_finished(find_optimum(evaluator, search))
    return require_sampling(optimum, caller)


def result_of(
    evaluator: Evaluator,
    chains: Chains,
    settings: SamplingSettings,
    optimum: Optimum | None,
    *,
    n_before: int,
    clock: float,
) -> xr.DataTree:
    """Return the DataTree of chains, with discrepancies if these cost no response."""
    kind = settings.kind(evaluator)
    is_estimate = kind is Likelihood.ESTIMATE
    findings = [*chains.findings]
    if chains.stopped:
        again = "" if settings.checkpoint is None else f" and checkpoint={settings.checkpoint}"
        text = (
            f"{chains.stopped}: {len(chains.thetas)} of {settings.chains} chains are finished, and "
            "results that cost responses are left out; call prb.sample_smc with a larger "
            f"budget{again}."
        )
        page = "expensive.md#a-night-is-not-enough"
        findings += report(Finding("budget-spent", text, page))
    thetas = chains.thetas
    if kind is not Likelihood.PSEUDO:
        lost = _lost_of_some(evaluator, thetas)
        chains = replace(chains, lost=lost, discrepancies=np.full_like(lost, np.nan))
    findings += _lost_findings(evaluator, chains)
    rows = thetas.reshape(-1, evaluator.hyperparameters.size)
    refuse_lost_specimens(evaluator, rows.mean(axis=0))
    with unlimited():
        if is_estimate and not evaluator.responses_per_theta:
            discrepancies = evaluator(rows).discrepancies.reshape(lost.shape)
            chains = replace(chains, discrepancies=discrepancies)
        groups = {}
        if settings.with_groups:
            groups = arviz_groups(evaluator, chains, settings.random_seed)
        if optimum is not None:
            # Leave out findings that advise to sample, because draws are as wide as few specimens
            # and ridges make them. Shares of modes take the place of the optimum's finding.
            codes = {finding.code for finding in optimum.findings}
            of_modes = {finding.code for finding in chains.findings}
            left_out = {"few-specimens", "flat-likelihood", *of_modes}
            thinned = rows[:: len(rows) // 100 + 1]
            is_narrow = "narrow-population" in codes
            if is_narrow and is_known_at(evaluator, thinned).mean() > 0.95:
                left_out.add("narrow-population")
            findings += [f for f in optimum.findings if f.code not in left_out]
            if is_estimate:
                findings += prior_conflicts(optimum, evaluator, thetas)
        else:
            findings += [f for node in evaluator.nodes for f in node.bound.findings]
            if kind is not Likelihood.PSEUDO:
                for likelihood in evaluator.likelihoods:
                    findings += prepared(likelihood).findings
        attrs = {
            "n_responses": evaluator.n_responses - n_before,
            "seconds": time.perf_counter() - clock,
            "random_seed": str(settings.random_seed),
            "adjustment": "estimate" if is_estimate else "none",
            "findings": as_json(findings),
        }
        return posterior_tree(evaluator, chains, attrs, groups)


def _lost_of_some(evaluator: Evaluator, thetas: Floats) -> Floats:
    """Return the share without response, (chains, draws, k), at 64 draws.

    It is NaN at other draws, and for simulators with stored responses.
    """
    chains, draws, _ = thetas.shape
    lost = np.full((chains, draws, len(evaluator.nodes)), np.nan)
    rows = np.linspace(0, chains * draws - 1, 64).astype(np.intp)
    try:
        for row in np.unique(rows):
            place = np.unravel_index(row, (chains, draws))
            for k, node in enumerate(evaluator.nodes):
                if not node.bound.stored:
                    population = node.bound.populations(evaluator.parents(thetas[place][None], k))
                    lost[(*place, k)] = Missing.of(*population).lost[0]
    except BudgetError:
        pass
    return lost


def _lost_findings(evaluator: Evaluator, chains: Chains) -> Findings:
    """Report draws whose populations lack responses; raise if most draws, or the best, do."""
    lost = chains.lost
    assert lost is not None
    shares = {}
    findings = []
    for k, node in enumerate(evaluator.nodes):
        shares[node.name] = chains.at_best.get(node.name, {}).get("lost_mass_at_best", 0.0)
        if np.isnan(lost[:, :, k]).all():
            continue
        shares[node.name] = max(shares[node.name], float(np.nanmedian(lost[:, :, k])))
        limit = node.bound.max_lost
        share = share_of_lossy(lost[:, :, k], limit)
        if share > 0.05:  # because a few draws may be far out
            findings.append(
                Finding(
                    "lost-mass",
                    f"{node.name}: lost mass: in {share:.0%} of the draws more than max_lost = "
                    f"{limit:.1%} of the population has no response (NaN), and the draws describe "
                    "only the specimens that have one; repair the response, return +inf for "
                    "specimens that fail, or narrow the priors.",
                    "expensive.md#when-a-run-fails",
                )
            )
    refuse_lost(evaluator, shares)
    return report(*findings)


# -- the pseudo-posterior --------------------------------------------------------------------------


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
        search = Minimisation(refine=settings.refine)
        optimum = require_finished(find_optimum(with_kept_runs(evaluator), search))
    require_sampling(optimum, "sample_smc")
    calibrated = calibrate_epsilon(optimum)
    for node in unset:
        node.epsilon.set_value(np.asarray(calibrated[node.name]))
    return optimum


def _with_errors(evaluator: Evaluator, chains: Chains) -> Chains:
    """Return chains with log-likelihoods, and the error and missing mass at the best draw."""
    discrepancies = chains.discrepancies
    assert discrepancies is not None
    kernels = np.asarray(log_kernel(discrepancies, epsilons(evaluator)))
    rows = chains.thetas.reshape(-1, evaluator.hyperparameters.size)
    other_terms = evaluator.log_other(rows).reshape(kernels.shape[:2])
    chains = replace(chains, log_likelihood=kernels.sum(axis=-1) + other_terms)
    total = (discrepancies / epsilons(evaluator)).sum(axis=-1)
    best = chains.thetas[np.unravel_index(total.argmin(), total.shape)]
    at_best = {}
    try:
        for k, node in enumerate(evaluator.nodes):
            error = discrepancy_error(node.bound, evaluator.parents(best[None], k))
            masses = missing_mass(evaluator, best, k)
            numbers = (error, masses["lost_mass"], masses["failed_mass"])
            at_best[node.name] = dict(zip(AT_BEST, numbers, strict=True))
    except BudgetError as spent:
        return replace(chains, stopped=chains.stopped or str(spent))
    return replace(chains, at_best=at_best)


# -- chains ----------------------------------------------------------------------------------------


def _audited_chains(
    evaluator: Evaluator, settings: SamplingSettings, optimum: Optimum | None, is_audited: bool
) -> tuple[Evaluator, Chains]:
    """Return chains, and the evaluator whose emulators are right at the inputs of their draws."""
    # Stages of a checkpoint are those of one emulator.
    rounds = MAX_ROUNDS if settings.checkpoint is None else 0
    for round_ in range(rounds + 1):
        chains = _chains_on_designs(evaluator, settings, optimum)
        if not is_audited or chains.stopped:
            break
        thetas = chains.thetas.reshape(-1, evaluator.hyperparameters.size)
        latest, findings = audited_evaluator(
            evaluator, thetas, "the draws", is_last=round_ == rounds
        )
        if latest is evaluator:
            return evaluator, replace(chains, findings=(*chains.findings, *findings))
        evaluator = latest
    return evaluator, chains


def _chains_on_designs(
    evaluator: Evaluator, settings: SamplingSettings, optimum: Optimum | None
) -> Chains:
    """Return chains that the designs support, after refinements, or raise."""
    starts = None if settings.start is None else _starts(evaluator, settings)
    checkpoint = None
    entropy = settings.random_seed
    if settings.checkpoint is not None:
        names = ("draws", "chains", "threshold", "adjustment", "refine")
        stored = {name: getattr(settings, name) for name in names}
        stored["entropy"] = None if entropy is None else str(entropy)
        if starts is not None:
            content = b"".join(np.ascontiguousarray(thetas).tobytes() for thetas in starts)
            stored["start"] = hashlib.sha256(content).hexdigest()
        checkpoint = Checkpoint(settings.checkpoint, identity_of(evaluator), stored)
        # A run without a seed has the seed of the run that it continues.
        entropy = int(checkpoint.settings["entropy"])
    seeds = np.random.SeedSequence(entropy)
    refinements = []
    for round_ in range(MAX_ROUNDS + 1):
        children = seeds.spawn(settings.chains)
        if checkpoint is not None and round_ < checkpoint.note.get("round", 0):
            refinements.append(checkpoint.arrays[f"refined{round_}_thetas"])
            refine_at(evaluator, refinements[-1])
            continue
        target, log_likelihood = None, None
        if settings.kind(evaluator) is Likelihood.ESTIMATE:
            assert optimum is not None
            target = estimate_target(evaluator, optimum)
            log_likelihood = target.log_likelihood
        chains = run_chains(
            evaluator, settings, children, log_likelihood, starts, checkpoint, refinements
        )
        rows = chains.thetas.reshape(-1, evaluator.hyperparameters.size)
        if not (settings.refine and evaluator.reweighted):
            break
        thetas = np.random.default_rng(seeds).permutation(rows)[:THETAS]
        if chains.stopped and shortcomings(evaluator, thetas):
            raise BudgetError(chains.stopped)
        if round_ == MAX_ROUNDS:
            refuse(shortcomings(evaluator, thetas), evaluator)
            break
        if not refine_at(evaluator, thetas):
            break
        refinements.append(thetas)
        _log.info("sampling again on the refined design")
    if settings.kind(evaluator) is Likelihood.PSEUDO:
        return chains
    target = target or specimen_target(evaluator, optimum)
    chains = _with_bridged_modes(target, chains, np.random.default_rng(seeds))
    if log_likelihood is None:
        return chains
    rows = chains.thetas.reshape(rows.shape)
    return replace(chains, log_likelihood=log_likelihood(rows).reshape(chains.thetas.shape[:2]))


def _with_bridged_modes(target: Target, chains: Chains, rng: np.random.Generator) -> Chains:
    """Return draws that are resampled to the masses of their modes, and report these."""
    hyperparameters = target.evaluator.hyperparameters
    draws = chains.thetas.reshape(-1, hyperparameters.size)
    unit = hyperparameters.prior_sd
    laplace_modes = modes_of(target.log_posterior, target.starts, target.scale) or []
    determined = determined_modes(target.evaluator, laplace_modes)
    modes = bridged_modes(target.log_posterior, draws, unit, determined, rng)
    if modes is None:
        return chains
    error = f" (standard error {modes.errors.max():.1g})"
    finding = modes_finding(target.evaluator, modes.places, modes.shares, error)
    thetas = modes.draws.reshape(chains.thetas.shape)
    return replace(chains, thetas=thetas, findings=report(*finding))


def _starts(evaluator: Evaluator, settings: SamplingSettings) -> list[Floats]:
    """Return the particles that each chain begins with."""
    start, chains = settings.start, settings.chains
    by_chain = list(start) if isinstance(start, list | tuple) else [start] * chains
    if len(by_chain) != chains:
        raise ValueError(
            f"start: got {len(by_chain)} dicts, expected one, or {chains}, one for each chain"
        )
    hyperparameters = evaluator.hyperparameters
    return [starting_thetas(hyperparameters, values, settings.draws) for values in by_chain]


def run_chains(
    evaluator: Evaluator,
    settings: SamplingSettings,
    seeds: Sequence[np.random.SeedSequence],
    log_likelihood: LogDensity | None = None,
    starts: Arrays | None = None,
    checkpoint: Checkpoint | None = None,
    refinements: Arrays = (),
) -> Chains:
    """Run a chain for each seed on the designs as they are, or as many as a budget allows.

    ``log_likelihood`` replaces that of the evaluator. The checkpoint gets the states of all kernels
    after each stage, and ``refinements``, the thetas of earlier rounds. Raises BudgetError if a
    budget is spent before the first chain is finished.
    """
    saved = [] if checkpoint is None else _saved_states(checkpoint, len(refinements))
    states: list[State] = []  # states of the kernels of finished chains
    stopped = ""
    with shown(settings.progressbar), progress("SMC stages") as advance:
        for chain, seed in enumerate(seeds):
            kernel = BatchedKernel(
                settings.draws,
                None if starts is None else starts[chain],
                evaluator.model,
                threshold=settings.threshold,
                evaluator=evaluator,
                log_likelihood=log_likelihood,
            )
            (stream,) = seed.generate_state(1)
            for node in evaluator.nodes:
                node.bound.stream, node.bound.draws = int(stream), 0
            place = f"chain {chain + 1} of {len(seeds)}"
            try:
                if chain < len(saved):
                    kernel.restore(*saved[chain])
                else:
                    kernel.initialize(kernel.start, np.random.default_rng(seed))
                for _ in kernel.tempered(settings.max_stages):
                    if checkpoint is not None:
                        _save(checkpoint, [*states, kernel.state()], refinements)
                    advance(1, f"{place}: beta {kernel.beta:.3g} of 1")
            except BudgetError as spent:
                stopped = f"{spent} in {place}"
                break
            states.append(kernel.state())
    if not states:
        raise BudgetError(stopped)
    particles, notes = zip(*states, strict=True)
    arrays = {name: np.array([of_chain[name] for of_chain in particles]) for name in particles[0]}
    stats, evidence = _stage_statistics([note["stages"] for note in notes])
    is_pseudo = settings.kind(evaluator) is Likelihood.PSEUDO
    return Chains(
        thetas=arrays["thetas"],
        sampler={"sampler": "SMC-ABC" if is_pseudo else "SMC", **evidence},
        sample_stats=stats,
        discrepancies=arrays["discrepancies"],
        lost=arrays["lost"],
        stopped=stopped,
    )


def _saved_states(checkpoint: Checkpoint, round_: int) -> list[State]:
    """Return the states of the kernels that have begun in this round of refinement."""
    if checkpoint.note.get("round") != round_:
        return []
    states = []
    for i, note in enumerate(checkpoint.note["states"]):
        prefix = f"chain{i}_"
        arrays = checkpoint.arrays.items()
        of_chain = {k.removeprefix(prefix): v for k, v in arrays if k.startswith(prefix)}
        states.append((of_chain, note))
    return states


def _save(checkpoint: Checkpoint, states: Sequence[State], refinements: Arrays) -> None:
    """Save the states of the kernels that have begun, and refinements."""
    arrays = {f"refined{i}_thetas": thetas for i, thetas in enumerate(refinements)}
    for i, (particles, _) in enumerate(states):
        arrays |= {f"chain{i}_{name}": array for name, array in particles.items()}
    notes = [note for _, note in states]
    checkpoint.save(arrays, {"round": len(refinements), "states": notes})


def _stage_statistics(chains: Sequence[Stages]) -> tuple[xr.Dataset, dict[str, float]]:
    """Return statistics by chain and stage, NaN after the last stage, and the mean evidence."""
    variables = {}
    for name in chains[0]:
        by_stage = zip_longest(*(stages[name] for stages in chains), fillvalue=np.nan)
        variables[name] = (["stage", "chain"], np.array(list(by_stage), dtype=float))
    statistics = xr.Dataset(variables).transpose("chain", "stage")
    coords = {dim: np.arange(size) for dim, size in statistics.sizes.items()}
    logs = np.array([stages["log_marginal_likelihood"][-1] for stages in chains])
    evidence = {
        "log_marginal_likelihood": float(logsumexp(logs) - np.log(logs.size)),
        "log_marginal_likelihood_sd": float(logs.std(ddof=1)) if logs.size > 1 else np.nan,
    }
    return statistics.assign_coords(coords), evidence
