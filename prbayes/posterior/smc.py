"""ABC by sequential Monte Carlo: `sample_smc`."""

from __future__ import annotations

import hashlib
import logging
import time
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from prbayes._checks import Floats, positive_integer, positive_number
from prbayes._progress import CONSOLE, shown
from prbayes.estimate.minimization import find_optimum
from prbayes.estimate.obstacles import refit_obstacle
from prbayes.estimate.optimum import Optimum, surveyed
from prbayes.estimate.refinement import MAX_ROUNDS, refine_at, refuse
from prbayes.model.evaluator import Evaluator
from prbayes.model.simulator import model_on_context
from prbayes.model.support import shortcomings
from prbayes.posterior.adjustment import Affine
from prbayes.posterior.checkpoint import Checkpoint, stored_identity
from prbayes.posterior.epsilon import calibrate_epsilon
from prbayes.posterior.smc_kernel import BatchedKernel
from prbayes.posterior.trees import posterior_tree

_log = logging.getLogger("prbayes")


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
    random_seed: int | None = 0,
    checkpoint: str | PathLike[str] | None = None,
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
    checkpoint : path-like, optional
        A file that keeps the state after every stage: a run that was killed goes on from there when it is
        called again, and gives the same draws. Give the propagations a ``store`` as well, so that the search
        for the optimum computes nothing again.
    progressbar : bool

    Returns
    -------
    xarray.DataTree
        Groups ``posterior`` (chain, draw), ``unadjusted`` (the draws before the adjustment, if there was one),
        ``sample_stats`` (chain, stage; NaN after the last stage),
        ``calibration`` (discrepancy, epsilon, weight effective sample size, mean raw weight, lost mass,
        ``discrepancy_error``: the Monte Carlo error of the discrepancy at the best draw; by simulator) and
        ``observed_data``; ArviZ takes it, ``to_netcdf`` saves it. Attributes of ``posterior``:
        ``log_marginal_likelihood``, from all chains, and ``log_marginal_likelihood_sd``, the spread of the
        chains' own; a number to compare models by with one metric and one epsilon, and with no others.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, no prior draw has a finite discrepancy, or nothing is known around the
        optimum (``at_edge`` and ``at_jump`` of `Optimum`) and it is needed for epsilon or the adjustment.
    DesignError
        If a design does not support the posterior after refinement.
    StoreError
        If the checkpoint is damaged, or belongs to another run.

    References
    ----------
    .. [1] Del Moral, P., A. Doucet and A. Jasra (2006), Sequential Monte Carlo samplers, J. R. Stat. Soc. B
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
    with shown(progressbar):
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
            checkpoint=checkpoint,
            progressbar=progressbar,
        )


def sample(
    evaluator: Evaluator,
    *,
    draws: int = 1000,
    chains: int = 1,
    epsilon: float | dict[str, float] | None = None,
    optimum: Optimum | None = None,
    adjust: Affine | bool = True,
    threshold: float = 0.5,
    refine: bool = True,
    random_seed: int | None = 0,
    progressbar: bool = False,
    checkpoint: str | PathLike[str] | None = None,
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
        if optimum is None and (unset or (isinstance(adjust, Affine) and refit_obstacle(evaluator) is None)):
            optimum = find_optimum(evaluator, refine=refine)
        if optimum is not None and isinstance(adjust, Affine):
            surveyed(optimum, "sample_smc")
        if unset and optimum is not None:
            calibrated = calibrate_epsilon(optimum)
            for node in unset:
                node.epsilon.set_value(np.asarray(calibrated[node.name]))
        saved = _checkpoint(checkpoint, evaluator, draws, chains, threshold, random_seed)
        seeds = np.random.SeedSequence(random_seed if saved is None else int(saved.identity["entropy"]))
        run = _Run(evaluator, draws, threshold, saved)
        for round_ in range(MAX_ROUNDS + 1):
            children = seeds.spawn(chains)
            if saved is not None and round_ < saved.note.get("round", 0):
                run.refined.append(saved.arrays[f"refined{round_}_thetas"])
                refine_at(evaluator, run.refined[-1])
                continue
            plain, discrepancies, stats = run(children, progressbar)
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
            if round_ == MAX_ROUNDS:
                refuse(shortcomings(evaluator, some), evaluator)
            elif not refine_at(evaluator, some):
                break
            run.refined.append(some)
            _log.info("sampling again on the refined design")
        if note.startswith("none: "):
            _log.warning("the draws are not adjusted: %s; their width is epsilon's", note.removeprefix("none: "))
        best = plain[np.unravel_index((discrepancies / evaluator.epsilon).sum(axis=-1).argmin(), plain.shape[:2])]
        roots = [evaluator.roots(best[None], k) for k in range(len(evaluator.nodes))]
        errors = [node.bound.discrepancy_error(r) for node, r in zip(evaluator.nodes, roots, strict=True)]
        return posterior_tree(
            evaluator,
            thetas,
            discrepancies,
            stats,
            unadjusted=None if thetas is plain else plain,
            adjustment=note,
            warnings=() if optimum is None else optimum.warnings,
            errors=np.array(errors),
            seed=random_seed,
            n_responses=evaluator.n_responses - computed,
            seconds=time.perf_counter() - clock,
        )
    finally:
        for node, value in zip(evaluator.nodes, before, strict=True):
            node.epsilon.set_value(np.asarray(value))


def _checkpoint(
    path: str | PathLike[str] | None,
    evaluator: Evaluator,
    draws: int,
    chains: int,
    threshold: float,
    seed: int | None,
) -> Checkpoint | None:
    """Open the checkpoint; a run without a seed takes that of the run it goes on with."""
    if path is None:
        return None
    entropy = np.random.SeedSequence(seed).entropy
    if seed is None and Path(path).exists():
        entropy = stored_identity(path).get("entropy", entropy)
    observed = b"".join(n.target.observed.tobytes() + n.target.weights.tobytes() for n in evaluator.nodes)
    identity = {
        "draws": draws,
        "chains": chains,
        "threshold": threshold,
        "entropy": str(entropy),
        "hyperparameters": evaluator.names,
        "epsilon": [float(e) for e in evaluator.epsilon],
        "metrics and propagations": [f"{n.metric!r} {n.propagation!r}".split(" at 0x")[0] for n in evaluator.nodes],
        "observed": hashlib.sha256(observed).hexdigest(),
        "responses before": [n.bound.n_points for n in evaluator.nodes],
    }
    return Checkpoint(path, identity)


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


class _Run:
    """All chains of one round on one design; saves its state after every stage, and takes over one that was saved."""

    def __init__(self, evaluator: Evaluator, draws: int, threshold: float, checkpoint: Checkpoint | None) -> None:
        self.evaluator, self.draws, self.threshold, self.checkpoint = evaluator, draws, threshold, checkpoint
        self.refined: list[Floats] = []  # thetas at which designs were refined in earlier rounds

    def __call__(
        self, seeds: list[np.random.SeedSequence], progressbar: bool
    ) -> tuple[Floats, Floats, list[dict[str, list[float]]]]:
        """Return thetas, (chains, draws, d), discrepancies, (chains, draws, k), and statistics by stage."""
        columns = (
            TextColumn("SMC chain {task.fields[chain]}"),
            BarColumn(),
            TextColumn("beta {task.completed:.4f}"),
            TextColumn("acceptance {task.fields[rate]:.2f}"),
            TimeElapsedColumn(),
        )
        done: list[tuple[Floats, Floats]] = []
        stats: list[dict[str, list[float]]] = []
        saved = self._saved()
        with shown(progressbar) as visible, Progress(*columns, console=CONSOLE, disable=not visible) as progress:
            for chain, seed in enumerate(seeds):
                task = progress.add_task("", total=1.0, chain=chain, rate=0.0)
                kernel = BatchedKernel(
                    self.draws, model=self.evaluator.model, threshold=self.threshold, evaluator=self.evaluator
                )
                if chain < saved.get("chain", 0):
                    arrays = self._arrays(f"chain{chain}_")
                    done.append((arrays["thetas"], arrays["discrepancies"]))
                    stats.append(saved["stats"][chain])
                    continue
                stages: dict[str, list[float]] = {name: [] for name in kernel.stats_dtypes_shapes}
                if chain == saved.get("chain"):
                    kernel.restore(self._arrays("now_"), saved["state"])
                    stages = saved["stats"][chain]
                    self._restore_generators(saved["generators"])
                else:
                    kernel.initialize(None, np.random.default_rng(seed))
                while kernel.beta < 1:
                    kernel.update_beta_and_weights()
                    for name, value in kernel.step().items():
                        stages[name].append(value)
                    self._save(done, [*stats, stages], kernel)
                    progress.update(task, completed=kernel.beta, rate=kernel.accept_rate)
                done.append((kernel.tempered_posterior, kernel.discrepancies))
                stats.append(stages)
        return np.array([d[0] for d in done]), np.array([d[1] for d in done]), stats

    def _saved(self) -> dict[str, Any]:
        note = self.checkpoint.note if self.checkpoint is not None else {}
        return note if note.get("round") == len(self.refined) else {}

    def _arrays(self, prefix: str) -> dict[str, Floats]:
        assert self.checkpoint is not None
        return {k.removeprefix(prefix): v for k, v in self.checkpoint.arrays.items() if k.startswith(prefix)}

    def _save(
        self, done: list[tuple[Floats, Floats]], stats: list[dict[str, list[float]]], kernel: BatchedKernel
    ) -> None:
        if self.checkpoint is None:
            return
        arrays, state = kernel.state()
        everything = {f"now_{k}": v for k, v in arrays.items()}
        for i, (thetas, discrepancies) in enumerate(done):
            everything |= {f"chain{i}_thetas": thetas, f"chain{i}_discrepancies": discrepancies}
        everything |= {f"refined{i}_thetas": thetas for i, thetas in enumerate(self.refined)}
        note = {"round": len(self.refined), "chain": len(done), "stats": stats, "state": state}
        self.checkpoint.save(everything, note | {"generators": self._generators()})

    def _generators(self) -> dict[str, Any]:
        """Return how often the generators of simulators with `Fresh` have been used."""
        return {n.name: n.bound.draws for n in self.evaluator.nodes if n.bound.random}

    def _restore_generators(self, states: dict[str, Any]) -> None:
        for node in self.evaluator.nodes:
            if node.bound.random:
                node.bound.draws = states[node.name]
