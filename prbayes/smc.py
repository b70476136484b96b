"""ABC by sequential Monte Carlo: a kernel that evaluates a whole population in one call, and `sample_smc`."""

from __future__ import annotations

import logging
import time
from typing import Any, ClassVar

import numpy as np
import pymc as pm
import xarray as xr
from pymc.smc.kernels import SMC_KERNEL, systematic_resampling
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from prbayes._arrays import Floats, positive_integer, positive_number
from prbayes.adjust import Affine, inapplicable
from prbayes.epsilon import calibrate_epsilon
from prbayes.optimize import Optimum, find_optimum
from prbayes.population import Evaluation, Evaluator
from prbayes.refinement import _MAX_ROUNDS, refine_at, refuse, shortcomings
from prbayes.results import posterior_tree
from prbayes.simulator import model_on_context

_log = logging.getLogger("prbayes")


_MAX_STEPS = 25
_UNCORRELATED = 0.05  # with the particles before the last stage; on the way, six times as much will do


class BatchedKernel(SMC_KERNEL):
    """SMC kernel that computes priors, responses and discrepancies of all particles in one call.

    It mutates by independent proposals from a normal fitted to the particles, which forget the past at
    once, in turn with random-walk proposals, which also move inside separate modes; until the particles
    are uncorrelated with those before, or stop becoming less so. Also usable as
    ``pymc.sample_smc(kernel=prbayes.BatchedKernel)``.

    Parameters
    ----------
    draws : int
        Number of particles.
    start : None
        Particles start from the prior.
    model : pymc.Model, optional
        The one on the context by default.
    random_seed : int, optional
    threshold : float
        Share of the effective sample size that a stage keeps.
    compile_kwargs : dict, optional
        Accepted for PyMC's sake; the populations are evaluated in NumPy.
    """

    stats_dtypes_shapes: ClassVar[dict[str, tuple[type, list[Any]]]] = {
        "log_marginal_likelihood": (float, []),
        "beta": (float, []),
        "accept_rate": (float, []),
        "n_steps": (int, []),
    }

    def __init__(
        self,
        draws: int = 2000,
        start: Any = None,
        model: pm.Model | None = None,
        random_seed: int | None = None,
        threshold: float = 0.5,
        compile_kwargs: dict[str, Any] | None = None,
        evaluator: Evaluator | None = None,
    ) -> None:
        # PyMC's constructor compiles functions of single particles, which this kernel never calls.
        if not 0 < threshold < 1:
            raise ValueError(f"threshold: got {threshold}, expected a number between 0 and 1")
        self.draws = draws
        self.start = start
        self.threshold = threshold
        model = model_on_context(model, "BatchedKernel")
        self.evaluator = evaluator or Evaluator(model)
        unset = [n.name for n, e in zip(self.evaluator.nodes, self.evaluator.epsilon, strict=True) if np.isnan(e)]
        if unset:
            raise ValueError(
                f"{unset[0]}: epsilon is not set; call prb.set_epsilon(model, "
                "prb.calibrate_epsilon(prb.minimize(model))) or use prb.sample_smc, which calibrates it"
            )
        self.variables = model.value_vars
        self.var_info = {n: (s, int(np.prod(s, dtype=int))) for n, s in self.evaluator.shapes.items()}
        self.rng = np.random.default_rng(random_seed)
        self._reset_state()

    def set_rng(self, rng: np.random.Generator) -> None:
        """Take over a chain's generator."""
        self.rng = rng

    def _evaluate(self, thetas: Floats) -> tuple[Floats, Floats, Floats]:
        found: Evaluation = self.evaluator(thetas)
        return found.log_prior, found.log_likelihood(self.evaluator.epsilon), found.discrepancies

    def _initialize_kernel(self) -> None:
        self.tempered_posterior = self.evaluator.prior_thetas(self.draws, int(self.rng.integers(2**31)))
        self.prior_logp, self.likelihood_logp, self.discrepancies = self._evaluate(self.tempered_posterior)
        if not np.isfinite(self.likelihood_logp).any():
            raise ValueError(
                f"model: got no finite discrepancy among {self.draws} draws from the prior, expected some; the "
                "populations of the prior are invalid or far from the design: look at the priors"
            )

    def resample(self) -> None:
        """Resample the particles in proportion to their weights."""
        index = systematic_resampling(self.weights, self.rng)
        self.resampling_indexes = index
        self.tempered_posterior = self.tempered_posterior[index]
        self.prior_logp, self.likelihood_logp = self.prior_logp[index], self.likelihood_logp[index]
        self.discrepancies = self.discrepancies[index]

    def mutate(self) -> None:
        """Move all particles by Metropolis-Hastings steps that leave the tempered posterior as it is."""
        before = self.tempered_posterior.copy()
        mean, d = before.mean(axis=0), before.shape[1]
        covariance = np.atleast_2d(np.cov(before, rowvar=False))
        root = np.linalg.cholesky(covariance + 1e-12 * np.diag(np.diag(covariance) + 1e-300))
        scale, accepted, correlation = 2.38 / np.sqrt(d), [], 1.0
        enough = _UNCORRELATED * (1 if self.beta == 1 else 6)
        for step in range(1, _MAX_STEPS + 1):
            noise = self.rng.standard_normal(before.shape)
            if step % 2:
                moved = mean + noise @ root.T
                now = np.linalg.solve(root, (self.tempered_posterior - mean).T)
                log_ratio = 0.5 * ((noise**2).sum(axis=1) - (now**2).sum(axis=0))
            else:
                moved, log_ratio = self.tempered_posterior + scale * noise @ root.T, np.zeros(len(before))
            rate = self._accept(moved, log_ratio)
            accepted.append(rate)
            if not step % 2:
                scale *= np.exp(rate - 0.3)
                last, correlation = correlation, _correlation(before, self.tempered_posterior)
                if correlation < enough or correlation > last - 0.01:
                    break
        self.accept_rate, self.n_steps = float(np.mean(accepted)), step

    def _accept(self, moved: Floats, log_ratio: Floats) -> float:
        prior, likelihood, discrepancies = self._evaluate(moved)
        with np.errstate(invalid="ignore"):
            gain = prior - self.prior_logp + self.beta * (likelihood - self.likelihood_logp) + log_ratio
        ok = np.log(self.rng.random(len(moved))) < np.nan_to_num(gain, nan=-np.inf)
        self.tempered_posterior[ok] = moved[ok]
        self.prior_logp[ok], self.likelihood_logp[ok] = prior[ok], likelihood[ok]
        self.discrepancies[ok] = discrepancies[ok]
        return float(ok.mean())

    def sample_stats(self) -> dict[str, Any]:
        """Return the statistics of a stage."""
        return {
            "log_marginal_likelihood": self.log_marginal_likelihood if self.beta == 1 else np.nan,
            "beta": self.beta,
            "accept_rate": self.accept_rate,
            "n_steps": self.n_steps,
        }

    def sample_settings(self) -> dict[str, Any]:
        """Return the settings of the run."""
        return {"_n_draws": self.draws, "threshold": self.threshold, "_n_tune": self.n_steps}


def _correlation(before: Floats, after: Floats) -> float:
    """Return the mean absolute correlation of the particles' coordinates with those before."""
    a, b = before - before.mean(axis=0), after - after.mean(axis=0)
    size = np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    return float(np.mean(np.abs((a * b).sum(axis=0)) / np.where(size > 0, size, 1.0)))


def sample_smc(
    draws: int = 1000,
    *,
    chains: int = 4,
    model: pm.Model | None = None,
    epsilon: float | dict[str, float] | None = None,
    optimum: Optimum | None = None,
    adjust: Affine | bool = True,
    threshold: float = 0.5,
    refine: bool = True,
    random_seed: int | None = None,
    progressbar: bool = True,
) -> xr.DataTree:
    """Draw from the pseudo-posterior prior x exp(-sum of d_k / epsilon_k) by sequential Monte Carlo.

    Parameters
    ----------
    draws : int
        Particles, and draws, of each chain.
    chains : int
        Independent runs.
    model : pymc.Model, optional
        The one on the context by default.
    epsilon : float or dict, optional
        For this run. By default the simulators' own, calibrated where unset (`calibrate_epsilon`).
    optimum : Optimum, optional
        Where to calibrate epsilon, and the centre of the adjustment; `minimize` finds it if needed.
    adjust : Affine or bool
        Whether, and how, the draws are brought to the width that the data warrant. By default by `Affine()`,
        unless an epsilon was given, which is then taken at its word; an `Affine` adjusts in any case.
    threshold : float
        Share of the effective sample size that a stage keeps; higher means more stages.
    refine : bool
        Whether designs of `Reweighted` that do not support the posterior get more points.
    random_seed : int, optional
    progressbar : bool

    Returns
    -------
    xarray.DataTree
        Groups ``posterior`` (chain, draw), ``unadjusted`` (the draws before the adjustment, if there was one),
        ``sample_stats`` (chain, stage; NaN after the last stage),
        ``calibration`` (discrepancy, epsilon, weight effective sample size, mean raw weight, lost mass; by
        simulator) and ``observed_data``; ArviZ takes it, ``to_netcdf`` saves it.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, or no prior draw has a finite discrepancy.
    DesignError
        If a design does not support the posterior after refinement.

    References
    ----------
    .. [1] P. Del Moral, A. Doucet and A. Jasra (2006), Sequential Monte Carlo samplers, J. R. Stat. Soc. B
       68, 411-436, doi:10.1111/j.1467-9868.2006.00553.x.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> idata = prb.sample_smc(100, chains=2, model=model, random_seed=1, progressbar=False)
    >>> idata.posterior["mu"].shape
    (2, 100)
    """
    positive_integer(draws, "draws", minimum=10)
    positive_integer(chains, "chains")
    model = model_on_context(model, "prb.sample_smc")
    if not isinstance(adjust, Affine | bool):
        raise TypeError(f"adjust: got {type(adjust).__name__} {adjust!r:.60}, expected prb.Affine(), True or False")
    if optimum is not None and not isinstance(optimum, Optimum):
        raise TypeError(f"optimum: got {type(optimum).__name__}, expected an Optimum; call prb.minimize() first")
    return sample(
        Evaluator(model) if optimum is None else optimum.evaluator,
        draws=draws,
        chains=chains,
        epsilon=epsilon,
        optimum=optimum,
        adjust=adjust,
        threshold=threshold,
        refine=refine,
        random_seed=random_seed,
        progressbar=progressbar,
    )


def sample(
    evaluator: Evaluator,
    *,
    draws: int,
    chains: int,
    epsilon: float | dict[str, float] | None,
    optimum: Optimum | None,
    adjust: Affine | bool,
    threshold: float,
    refine: bool,
    random_seed: int | None,
    progressbar: bool,
) -> xr.DataTree:
    """Do what `sample_smc` does, for an evaluator."""
    clock = time.perf_counter()
    computed = evaluator.n_responses - sum(d.n_points for d in evaluator.designs.values())
    before = evaluator.epsilon
    try:
        _set_for_run(evaluator, epsilon)
        unset = [n for n in evaluator.nodes if np.isnan(n.epsilon_value)]
        if adjust is True and all(n in unset or n.epsilon_is_default for n in evaluator.nodes):
            adjust = Affine()
        if optimum is None and (unset or (isinstance(adjust, Affine) and not inapplicable(evaluator))):
            optimum = find_optimum(evaluator, refine=refine)
        if unset and optimum is not None:
            calibrated = calibrate_epsilon(optimum)
            for node in unset:
                node.epsilon.set_value(np.asarray(calibrated[node.name]))
        seeds = np.random.SeedSequence(random_seed)
        for round_ in range(_MAX_ROUNDS + 1):
            plain, discrepancies, stats = _run(evaluator, draws, chains, threshold, seeds, progressbar)
            thetas, note = plain, "none"
            if isinstance(adjust, Affine):
                optima = (
                    [] if optimum is None else [optimum.theta, *(r["theta"] for r in optimum.rivals if r["comparable"])]
                )
                thetas, note = adjust(evaluator, plain, optima)
            if not (refine and evaluator.designs):
                break
            both = np.concatenate([plain, thetas]).reshape(-1, evaluator.size)
            some = np.random.default_rng(seeds).permutation(both)[:256]
            if round_ == _MAX_ROUNDS:
                refuse(shortcomings(evaluator, some), evaluator)
            elif not refine_at(evaluator, some):
                break
            _log.info("sampling again on the refined design")
        if note.startswith("none: "):
            _log.warning("the draws are not adjusted: %s; their width is epsilon's", note.removeprefix("none: "))
        return posterior_tree(
            evaluator,
            thetas,
            discrepancies,
            stats,
            unadjusted=None if thetas is plain else plain,
            adjustment=note,
            warnings=() if optimum is None else optimum.warnings,
            seed=random_seed,
            n_responses=evaluator.n_responses - computed,
            seconds=time.perf_counter() - clock,
        )
    finally:
        for node, value in zip(evaluator.nodes, before, strict=True):
            node.epsilon.set_value(np.asarray(value))


def _set_for_run(evaluator: Evaluator, epsilon: float | dict[str, float] | None) -> None:
    names = [n.name for n in evaluator.nodes]
    if epsilon is None:
        return
    if not isinstance(epsilon, dict):
        if len(names) > 1:
            raise ValueError(f"epsilon: got one number for {len(names)} simulators, expected a dict by name: {names}")
        epsilon = {names[0]: epsilon}
    unknown = sorted(set(epsilon) - set(names))
    if unknown:
        raise KeyError(f"epsilon: got {unknown}, expected names of simulators: {names}")
    values = {n: positive_number(v, f"{n}: epsilon") for n, v in epsilon.items()}
    for node in evaluator.nodes:
        if node.name in values:
            node.epsilon.set_value(np.asarray(values[node.name]))


def _run(
    evaluator: Evaluator, draws: int, chains: int, threshold: float, seeds: np.random.SeedSequence, progressbar: bool
) -> tuple[Floats, Floats, list[dict[str, list[float]]]]:
    """Run all chains; return thetas, (chains, draws, d), discrepancies, (chains, draws, k), and statistics by stage."""
    columns = (
        TextColumn("SMC chain {task.fields[chain]}"),
        BarColumn(),
        TextColumn("beta {task.completed:.4f}"),
        TextColumn("acceptance {task.fields[rate]:.2f}"),
        TimeElapsedColumn(),
    )
    thetas, discrepancies, stats = [], [], []
    with Progress(*columns, disable=not progressbar) as progress:
        for chain, seed in enumerate(seeds.spawn(chains)):
            task = progress.add_task("", total=1.0, chain=chain, rate=0.0)
            kernel = BatchedKernel(draws, model=evaluator.model, threshold=threshold, evaluator=evaluator)
            kernel.initialize(None, np.random.default_rng(seed))
            stages: dict[str, list[float]] = {name: [] for name in kernel.stats_dtypes_shapes}
            while kernel.beta < 1:
                kernel.update_beta_and_weights()
                for name, value in kernel.step().items():
                    stages[name].append(value)
                progress.update(task, completed=kernel.beta, rate=kernel.accept_rate)
            thetas.append(kernel.tempered_posterior)
            discrepancies.append(kernel.discrepancies)
            stats.append(stages)
    return np.array(thetas), np.array(discrepancies), stats
