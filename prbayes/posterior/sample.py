"""The posterior by importance sampling, or by the sampler of PyMC that it needs: `sample`."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._checks import Floats, Seed, positive_integer, seed_number
from prbayes._progress import shown
from prbayes.estimate.minimization import Minimisation, find_optimum, require_finished
from prbayes.estimate.optimum import Optimum
from prbayes.estimate.refinement import MAX_ROUNDS, refine_at
from prbayes.model.evaluator import Evaluator
from prbayes.model.hyperparameters import THETAS
from prbayes.model.interruption import designs_as_before, explained
from prbayes.model.node import model_on_context
from prbayes.model.turns import in_turn
from prbayes.posterior.estimate_likelihood import estimate_likelihood
from prbayes.posterior.groups import arviz_groups, specimen_groups
from prbayes.posterior.importance import (
    ImportanceOptions,
    ImportanceSample,
    Laplace,
    LogDensity,
    importance_sample,
    laplace,
)
from prbayes.posterior.returned import as_asked, checked_idata_kwargs, checked_names
from prbayes.posterior.smc import Sampling, evaluator_of, optima_of, sample_likelihood
from prbayes.posterior.smc import sample as sample_by_smc
from prbayes.posterior.trees import posterior_tree
from prbayes.response.budget import limited, unlimited

_OPTIONS = ImportanceOptions()


@in_turn
def sample(
    draws: int = 1000,
    *,
    chains: int = 4,
    model: pm.Model | None = None,
    optimum: Optimum | None = None,
    idata_kwargs: Mapping[str, Any] | None = None,
    var_names: Sequence[str] | None = None,
    max_seconds: float | None = None,
    max_runs: int | None = None,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> xr.DataTree:
    """Draw from the posterior of any model, by the fastest sampler that is exact for it.

    With the log-likelihood by specimen: importance sampling from Laplace approximations of the
    modes. If Pareto k is above .7, or the effective sample size below a quarter of the points, NUTS
    from the optimum; of several modes, or where the likelihood jumps at the optimum, sequential
    Monte Carlo from the prior.

    With PR or the Kullback-Leibler divergence and stored responses (`Reweighted`), the posterior is
    prior times density of the metric's own estimate: of its score there, by a saddlepoint
    approximation [2]_. It is sampled in the same way. Other metrics are sampled by `sample_smc`.

    Parameters
    ----------
    draws : int
        Draws of each chain.
    chains : int
        The draws of importance sampling are independent, in chains of equal size as PyMC's are.
    model : pymc.Model, optional
        The one on the context by default.
    optimum : Optimum, optional
        Where to begin; by default the best of 1024 points of the prior.
    idata_kwargs, var_names
        As in `sample_smc`.
    max_seconds : float, optional
        Seconds after which no further run is begun.
    max_runs : int, optional
        Largest number of responses to compute, the first runs included.
    random_seed : int, sequence of int, numpy.random.Generator or None
    progressbar : bool

    Returns
    -------
    xarray.DataTree
        The groups of `sample_smc`. The attribute ``sampler`` of ``posterior`` says which sampler
        was taken. Importance sampling has the attributes ``pareto_k``, ``efficiency`` (effective
        sample size as a share of the points) and ``log_marginal_likelihood``, and ``lp``, the log
        posterior density in unconstrained space, in ``sample_stats`` (chain, draw).

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.
    DesignError
        If the points of the specimens cannot be computed.
    BudgetError
        If a budget is spent before there are draws.

    References
    ----------
    .. [1] Vehtari, A., D. Simpson, A. Gelman, Y. Yao and J. Gabry (2024), Pareto smoothed
       importance sampling, J. Mach. Learn. Res. 25(72), 1-58.
    .. [2] Field, C. A. and F. R. Hampel (1982), Small-sample asymptotic distributions of
       M-estimators of location, Biometrika 69(1), 29-46, doi:10.1093/biomet/69.1.29.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, observed=[0.0, 1.0, 2.0, 4.0, 5.0])
    >>> idata = prb.sample(500, model=model, random_seed=1, progressbar=False)
    >>> idata.posterior["mu"].shape
    (4, 500)
    """
    positive_integer(draws, "draws", minimum=10)
    positive_integer(chains, "chains")
    model = model_on_context(model, "prb.sample")
    if optimum is not None and not isinstance(optimum, Optimum):
        got = type(optimum).__name__
        raise TypeError(f"optimum: got {got}, expected an Optimum; call prb.minimize() first")
    names = checked_names(var_names, model)
    keywords = checked_idata_kwargs(idata_kwargs)
    seed = seed_number(random_seed)
    asked = Sampling(
        draws=draws,
        chains=chains,
        optimum=optimum,
        random_seed=seed,
        progressbar=progressbar,
        with_groups=True,
    )
    with (
        shown(progressbar),
        explained(model, "prb.sample"),
        limited(max_seconds, max_runs),
    ):
        evaluator = evaluator_of(model, optimum, "sample")
        if evaluator.nodes:
            tree = _sample_given_estimate(evaluator, asked)
        else:
            tree = _sample_likelihood(evaluator, asked)
        return as_asked(tree, names, keywords)


def _sample_likelihood(evaluator: Evaluator, asked: Sampling) -> xr.DataTree:
    """Return the result for a model whose simulators have a log-likelihood by specimen."""
    clock = time.perf_counter()
    before = evaluator.n_responses
    density = log_posterior(evaluator)
    if asked.optimum is None:
        starts = _starts(evaluator, density)
    else:
        starts = list(optima_of(asked.optimum, evaluator))
    modes = _modes(density, starts, evaluator.prior_sd)
    if modes is None:
        return sample_likelihood(evaluator, asked)
    seed = seed_number(asked.random_seed)
    sample = importance_sample(density, modes, asked.chains * asked.draws, seed, _OPTIONS)
    if sample.is_reliable(_OPTIONS):
        attrs, thetas, stats = _of_importance_sample(sample, asked)
    elif len(modes) > 1:
        return sample_likelihood(evaluator, asked)
    else:
        attrs, thetas, stats = _by_nuts(evaluator, modes[0], asked)
    no_metric = np.empty((asked.chains, asked.draws, 0))
    with unlimited():
        return posterior_tree(
            evaluator,
            thetas,
            no_metric,
            no_metric,
            [],
            sampler=attrs,
            sample_stats=stats,
            warnings=_warnings(evaluator, asked.optimum),
            seed=asked.random_seed,
            n_responses=evaluator.n_responses - before,
            seconds=time.perf_counter() - clock,
            groups=specimen_groups(evaluator, thetas, asked.random_seed),
        )


def _sample_given_estimate(evaluator: Evaluator, asked: Sampling) -> xr.DataTree:
    """Return the result for metrics: prior times density of the metric's score at the estimate.

    By `sample_smc` where there is no such density, or where importance sampling is not reliable.
    """
    clock = time.perf_counter()
    before = evaluator.n_responses - evaluator.n_runs
    optimum = asked.optimum
    if optimum is None:
        optimum = require_finished(find_optimum(evaluator, Minimisation()))
    asked = replace(asked, optimum=optimum)
    with designs_as_before(evaluator):
        sample = _importance_sample_given_estimate(evaluator, optimum, asked)
    if sample is None:
        return sample_by_smc(evaluator, asked)
    attrs, thetas, stats = _of_importance_sample(sample, asked)
    with unlimited():
        evaluation = evaluator(sample.draws)
        shape = (asked.chains, asked.draws, -1)
        discrepancies = evaluation.discrepancies.reshape(shape)
        log_likelihood = (sample.log_density - evaluation.log_prior).reshape(shape[:2])
        return posterior_tree(
            evaluator,
            thetas,
            discrepancies,
            evaluation.lost.reshape(shape),
            [],
            sampler=attrs,
            sample_stats=stats,
            adjustment="none needed: the posterior is given the metric's own estimate",
            warnings=optimum.warnings,
            seed=asked.random_seed,
            n_responses=evaluator.n_responses - before,
            seconds=time.perf_counter() - clock,
            groups=arviz_groups(
                evaluator, thetas, discrepancies, thetas, log_likelihood, asked.random_seed
            ),
        )


def _importance_sample_given_estimate(
    evaluator: Evaluator, optimum: Optimum, asked: Sampling
) -> ImportanceSample | None:
    """Return draws given the estimate, or None where they cannot be had or are not reliable.

    Stored responses are added where they do not support the draws. Fewer than ten specimens of a
    simulator have bandwidths that bias the estimate, and were not studied.
    """
    if min(len(node.observed) for node in evaluator.nodes) < 10:
        return None
    seed = seed_number(asked.random_seed)
    for _ in range(MAX_ROUNDS + 1):
        try:
            likelihood = estimate_likelihood(evaluator, optimum)
        except (TypeError, ValueError):
            return None
        density = likelihood.log_posterior
        # Of several outputs the estimate is minimised again, with other coordinates.
        starts = [likelihood.point, *optima_of(optimum, evaluator)[1:]]
        modes = _modes(density, starts, likelihood.scale)
        if modes is None:
            return None
        sample = importance_sample(density, modes, asked.chains * asked.draws, seed, _OPTIONS)
        if not sample.is_reliable(_OPTIONS):
            return None
        if not refine_at(evaluator, sample.draws[:THETAS]):
            return sample
    return None


def log_posterior(evaluator: Evaluator) -> LogDensity:
    """Return the log-posterior density in unconstrained space, (S, d) -> (S,)."""

    def function(thetas: Floats) -> Floats:
        evaluation = evaluator(thetas)
        return evaluation.log_prior + evaluation.log_other

    return function


def _warnings(evaluator: Evaluator, optimum: Optimum | None) -> tuple[str, ...]:
    """Return what the data, the runs and the optimum report."""
    if optimum is not None:
        return optimum.warnings
    findings = [finding for each in evaluator.likelihoods for finding in each.findings]
    return tuple(str(finding) for finding in findings)


def _modes(density: LogDensity, starts: list[Floats], scale: Floats) -> list[Laplace] | None:
    """Return Laplace approximations of the modes near starts, None if the density jumps there."""
    try:
        candidates = laplace(density, np.stack(starts), scale)
    except (ValueError, np.linalg.LinAlgError):
        return None
    candidates.sort(key=lambda mode: (not mode.converged, -mode.log_mass))
    modes: list[Laplace] = []
    for mode in candidates:
        distances = [
            np.abs(mode.mode - each.mode) / np.sqrt(np.diag(each.covariance)) for each in modes
        ]
        negligible = mode.log_mass < candidates[0].log_mass - 10
        unusable = negligible or (bool(modes) and not mode.converged)
        if not unusable and all(distance.max() > 0.5 for distance in distances):
            modes.append(mode)
    return modes


def _starts(
    evaluator: Evaluator, density: LogDensity, screened: int = 1024, count: int = 8
) -> list[Floats]:
    """Return the best point of the prior, and others of the best quarter far from each other."""
    thetas = evaluator.prior_points(screened, 0)
    order = np.argsort(-density(thetas), kind="stable")
    candidates = thetas[order[: screened // 4]] / evaluator.prior_sd
    chosen = [0]
    distance = np.full(len(candidates), np.inf)
    while len(chosen) < count:
        away = ((candidates - candidates[chosen[-1]]) ** 2).sum(axis=1)
        distance = np.minimum(distance, away)
        chosen.append(int(np.argmax(distance)))
    return list(candidates[chosen] * evaluator.prior_sd)


def _of_importance_sample(
    sample: ImportanceSample, asked: Sampling
) -> tuple[dict[str, Any], Floats, xr.Dataset]:
    """Return attributes, draws (chains, draws, d) and statistics of a sample."""
    attrs = {
        "sampler": "importance sampling",
        "pareto_k": sample.pareto_k,
        "efficiency": sample.efficiency,
        "log_marginal_likelihood": sample.log_evidence,
    }
    shape = (asked.chains, asked.draws)
    lp = (["chain", "draw"], sample.log_density.reshape(shape))
    coords = {"chain": np.arange(asked.chains), "draw": np.arange(asked.draws)}
    return attrs, sample.draws.reshape(*shape, -1), xr.Dataset({"lp": lp}, coords=coords)


def _by_nuts(
    evaluator: Evaluator, mode: Laplace, asked: Sampling
) -> tuple[dict[str, Any], Floats, xr.Dataset]:
    """Return the same by NUTS from the mode of the posterior."""
    values = evaluator.constrained(mode.mode[None])
    free = [str(rv.name) for rv in evaluator.model.free_RVs]
    with evaluator.model:
        idata = pm.sample(
            asked.draws,
            chains=asked.chains,
            initvals={name: values[name][0] for name in free},
            init="adapt_diag",
            nuts_sampler="pymc",
            cores=1,
            random_seed=asked.random_seed,
            progressbar=False,
            compute_convergence_checks=False,
        )
    posterior = idata["posterior"].to_dataset()
    columns = [posterior[name].transpose("chain", "draw", ...).values for name in free]
    flat = [x.reshape(-1, *x.shape[2:]) for x in columns]
    thetas = evaluator.thetas_of(flat).reshape(asked.chains, asked.draws, -1)
    return {"sampler": "NUTS"}, thetas, idata["sample_stats"].to_dataset()
