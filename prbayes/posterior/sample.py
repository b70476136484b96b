"""The posterior by importance sampling, else NUTS or sequential Monte Carlo: `sample`."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._finding import Finding, Findings, report
from prbayes._progress import announce, shown
from prbayes._validate import Floats, Seed, positive_integer, seed_number
from prbayes.model.cost import designs_as_before, explained
from prbayes.model.evaluator import Evaluator, n_design_runs
from prbayes.model.locking import locked
from prbayes.model.parameters import THETAS
from prbayes.model.specimen_audit import audited_evaluator
from prbayes.numerics.modes import Laplace
from prbayes.optimize.design_refinement import MAX_ROUNDS, refine_at
from prbayes.optimize.maximum_likelihood import determined_modes
from prbayes.optimize.optimum import Optimum
from prbayes.posterior import smc
from prbayes.posterior.importance import ImportanceOptions, importance_sample
from prbayes.posterior.mode_masses import has_valley, modes_finding
from prbayes.posterior.results import Chains, require_selection, selected
from prbayes.posterior.smc import (
    Likelihood,
    SamplingSettings,
    evaluator_of,
    required_optimum,
    result_of,
)
from prbayes.posterior.target import Target, modes_of, posterior_target
from prbayes.response.budget import limited
from prbayes.response.inputs import model_on_context


@locked
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

    The first sampler is importance sampling from Laplace approximations of the modes, then from
    mixtures fitted to the weighted points [1]_. If Pareto k is above .7, or the effective sample
    size below half of the draws, NUTS starts at the mode. Sequential Monte Carlo takes its place if
    the model has a metric, several modes, or a likelihood that jumps at the optimum, or if R-hat of
    the chains is above 1.1.

    With a metric, the posterior is prior times density of the metric's own estimate. The density is
    a saddlepoint approximation [2]_. It is that of the score if the gradient is a mean over
    specimens (PR, the Kullback-Leibler divergence), else of refits of synthetic data sets.

    If the posterior has several modes, the difference of the discrepancy between their optima is
    part of the estimate, and the finding ``second-mode`` has the share of the draws near each. The
    draws of sequential Monte Carlo are resampled to the masses of the modes by bridge sampling.

    Parameters
    ----------
    draws : int
        Draws of each chain.
    chains : int
        The draws of importance sampling are independent, in chains of equal size as PyMC's are.
    model : pymc.Model, optional
        The one on the context by default.
    optimum : Optimum, optional
        Where to begin, by default the best of 1024 points of the prior. With a metric it is the
        estimate, by default from `minimize`.
    idata_kwargs, var_names
        As in `sample_smc`.
    max_seconds : float, optional
        Seconds after which no further run begins. Sequential Monte Carlo then returns its finished
        chains, with the attribute ``stopped`` and a warning.
    max_runs : int, optional
        Largest number of responses to compute, the first runs included.
    random_seed : int, sequence of int, numpy.random.Generator or None
    progressbar : bool
        Whether work of more than two seconds shows a bar on stderr.

    Returns
    -------
    xarray.DataTree
        The groups of `sample_smc`. The attribute ``sampler`` of ``posterior`` is the sampler's
        name. Importance sampling adds ``pareto_k``, ``efficiency`` (effective sample size of a
        point) and ``log_marginal_likelihood``. Its ``sample_stats`` have ``lp``, the log posterior
        density in unconstrained space.

    Raises
    ------
    TypeError, KeyError, ValueError
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
    names, keywords = require_selection(var_names, idata_kwargs, model)
    settings = SamplingSettings(
        draws=draws,
        chains=chains,
        optimum=optimum,
        random_seed=seed_number(random_seed),
        progressbar=progressbar,
        with_groups=True,
    )
    with (
        shown(progressbar),
        explained(model, "prb.sample"),
        limited(max_seconds, max_runs),
    ):
        evaluator = evaluator_of(model, optimum, "sample")
        return selected(draw_posterior(evaluator, settings, is_audited=True), names, keywords)


def draw_posterior(
    evaluator: Evaluator, settings: SamplingSettings, *, is_audited: bool = False
) -> xr.DataTree:
    """Return draws by importance sampling, else by NUTS or SMC; designs grow if needed.

    An audit of emulators needs the data of the evaluator's model, not those of a product or
    synthetic ones.
    """
    clock = time.perf_counter()
    n_before = evaluator.n_responses - n_design_runs(evaluator)
    optimum = required_optimum(evaluator, settings, "sample")
    settings = replace(settings, optimum=optimum)
    with designs_as_before(evaluator):
        chains = None
        findings: Findings = ()
        for round_ in range(MAX_ROUNDS + 1):
            target = posterior_target(evaluator, optimum)
            modes = modes_of(target.log_posterior, target.starts, target.scale)
            if modes is None:
                announce("No mode of the posterior was found.", visible=settings.progressbar)
                break
            chains = importance_chains(target, modes, settings)
            if chains is None:
                optima = getattr(optimum, "local_optima", ())
                is_ambiguous = any(mode["comparable"] for mode in optima)
                has_one_mode = len(modes) == 1 and not is_ambiguous
                is_exact = settings.kind(evaluator) is Likelihood.SPECIMENS
                if has_one_mode and is_exact and evaluator.has_graph:
                    chains = _nuts_chains(evaluator, modes[0], settings)
            if chains is None:
                break
            thetas = chains.thetas.reshape(-1, evaluator.hyperparameters.size)
            latest = evaluator
            if is_audited:
                is_last = round_ == MAX_ROUNDS
                latest, findings = audited_evaluator(
                    evaluator, thetas, "the draws", is_last=is_last
                )
            if not refine_at(latest, thetas[:THETAS]) and latest is evaluator:
                break
            evaluator = latest
        if chains is None:
            text = "The posterior is drawn by sequential Monte Carlo, from the prior."
            announce(text, visible=settings.progressbar)
            return smc.sample(evaluator, settings, is_audited=is_audited)
        if modes is not None:
            findings += report(*mode_findings(target, modes, chains.thetas))
            chains = replace(chains, findings=findings)
        return result_of(evaluator, chains, settings, optimum, n_before=n_before, clock=clock)


def mode_findings(target: Target, modes: list[Laplace], draws: Floats) -> list[Finding]:
    """Report the share of draws, (..., d), around each mode, if two or more have 1 % of them.

    A draw belongs to the mode that is nearest in standard deviations. A mode at which the points do
    not determine the likelihood, such as that of a very narrow population, is an artefact of them.
    """
    thetas = draws.reshape(-1, draws.shape[-1])
    separate: list[Laplace] = []
    determined = determined_modes(target.evaluator, modes)
    for mode in sorted(determined, key=lambda mode: -mode.log_mass):
        if all(has_valley(target.log_posterior, mode.mode, x.mode) for x in separate):
            separate.append(mode)
    if len(separate) < 2:
        return []
    factors = [np.linalg.inv(np.linalg.cholesky(mode.covariance)) for mode in separate]
    pairs = zip(separate, factors, strict=True)
    distances = [np.linalg.norm((thetas - mode.mode) @ root.T, axis=1) for mode, root in pairs]
    shares = np.bincount(np.argmin(distances, axis=0), minlength=len(separate)) / len(thetas)
    places = np.array([mode.mode for mode in separate])
    largest = target.errors_of_shares(places, shares).max()
    error = f" (standard error {largest:.1g}, because they rest on refits)" if largest else ""
    return modes_finding(target.evaluator, places, shares, error)


def importance_chains(
    target: Target, modes: list[Laplace], settings: SamplingSettings
) -> Chains | None:
    """Return draws by importance sampling, None if they are not reliable."""
    shape = settings.chains, settings.draws
    hyperparameters = target.evaluator.hyperparameters
    prior = hyperparameters.prior_thetas, hyperparameters.log_prior
    seed = seed_number(settings.random_seed)
    size = settings.chains * settings.draws
    options = ImportanceOptions()
    sample = importance_sample(target.log_posterior, modes, size, seed, options, prior)
    if not sample.is_reliable:
        limit = options.effective * size
        announce(
            f"Importance sampling is not reliable: {sample.effective_size:.0f} effective draws, "
            f"at least {limit:.0f} needed, and Pareto k {sample.pareto_k:.2f}, at most "
            f"{options.pareto_k:g} needed.",
            visible=settings.progressbar,
        )
        return None
    log_prior = hyperparameters.log_prior(sample.draws)
    coords = {"chain": np.arange(settings.chains), "draw": np.arange(settings.draws)}
    lp = ["chain", "draw"], sample.log_density.reshape(shape)
    return Chains(
        sample.draws.reshape(*shape, -1),
        sampler={
            "sampler": "importance sampling",
            "pareto_k": sample.pareto_k,
            "efficiency": sample.efficiency,
            "log_marginal_likelihood": sample.log_evidence,
        },
        sample_stats=xr.Dataset({"lp": lp}, coords=coords),
        log_likelihood=(sample.log_density - log_prior).reshape(shape),
    )


def _nuts_chains(evaluator: Evaluator, mode: Laplace, settings: SamplingSettings) -> Chains | None:
    """Return draws by NUTS from the mode of the posterior, None if its chains disagree."""
    hyperparameters = evaluator.hyperparameters
    values = hyperparameters.constrained(mode.mode[None])
    names = [str(rv.name) for rv in evaluator.model.free_RVs]
    text = f"The posterior is drawn by NUTS, in {settings.chains} chains from its mode."
    announce(text, visible=settings.progressbar)
    # A step that overflows is a divergence, and not an error.
    with evaluator.model, np.errstate(over="ignore"):
        idata = pm.sample(
            settings.draws,
            chains=settings.chains,
            initvals={name: values[name][0] for name in names},
            init="adapt_diag",
            nuts_sampler="pymc",
            cores=1,
            random_seed=settings.random_seed,
            progressbar=False,
            compute_convergence_checks=False,
        )
    posterior = idata["posterior"].to_dataset()
    if settings.chains > 1:
        r_hat = import_module("arviz").rhat(posterior).to_array().max()
        if not r_hat <= 1.1:  # because chains are in different modes
            announce(
                f"The chains of NUTS disagree: R-hat {r_hat:.2f}.", visible=settings.progressbar
            )
            return None
    columns = [posterior[name].transpose("chain", "draw", ...).values for name in names]
    thetas = hyperparameters.thetas_of([x.reshape(-1, *x.shape[2:]) for x in columns])
    return Chains(
        thetas.reshape(settings.chains, settings.draws, -1),
        sampler={"sampler": "NUTS"},
        sample_stats=idata["sample_stats"].to_dataset(),
    )
