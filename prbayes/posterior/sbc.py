"""Simulation-based calibration.

Whether the whole procedure gives posteriors of the right width for a model.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future, as_completed
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._finding import Finding, report
from prbayes._progress import progress, shown
from prbayes._validate import Floats, Seed, executes, flag, positive_integer, seed_number
from prbayes.inference.resampling import fresh_data
from prbayes.model.evaluator import Evaluator, has_other_terms, specimen_params
from prbayes.model.locking import locked
from prbayes.optimize.specimen_refits import (
    other_specimens,
    simulation_obstacle,
    specimen_pool,
)
from prbayes.posterior.sample import draw_posterior
from prbayes.posterior.smc import Adjustment, Sampling, refuse_adjustment, sample
from prbayes.posterior.trees import calibration_tree
from prbayes.propagation.reweighted import designs_restored
from prbayes.response.inputs import model_on_context

# Data sets that a worker analyses before it reports: seconds of work, against milliseconds of
# sending the model.
_CHUNK = 10


@locked
def simulation_based_calibration(
    n: int = 200,
    *,
    model: pm.Model | None = None,
    draws: int = 500,
    adjustment: Adjustment = "estimate",
    executor: Executor | None = None,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> xr.DataTree:
    """Calibrate many data sets with known hyperparameters, and rank these among the draws.

    Each time hyperparameters are drawn from the prior, and specimens from their populations, for
    which the response is called; with the log-likelihood by specimen its emulator gives the
    responses, nothing is run, and the emulator itself is not checked. Then `sample`, or
    `sample_smc` with ``adjustment=None``, runs as on measurements. If posteriors have the right
    width and place, the ranks are uniform. A wide prior asks more than one true value does: it
    shows what happens all over the prior.

    Parameters
    ----------
    n : int
        Number of data sets.
    model : pymc.Model, optional
        The one on the context by default. Its observed values matter only by their number, weights
        and labels.
    draws : int
        Draws of each posterior, in one chain.
    adjustment : {"estimate", None}
        As of `sample_smc`.
    executor : concurrent.futures.Executor, optional
        Where data sets are analysed, ten at a time; the model is sent with cloudpickle.
    random_seed : int, sequence of int, numpy.random.Generator or None
        The result does not depend on the executor.
    progressbar : bool

    Returns
    -------
    xarray.DataTree
        Group ``prior_sbc`` with dimensions (chain, draw), chain of length one and a draw per data
        set: ranks scaled to the unit interval, for `arviz.plot_ecdf_pit`, which adds the envelope
        or a test of uniformity. Group ``envelope``: the ECDF of the ranks of each variable, and
        ArviZ's simultaneous 95% envelope for uniform ones; the attribute ``outside`` names the
        variables that leave it. Groups ``truth`` and ``posterior_sd`` alike. Data sets that could
        not be analysed are left out and counted in the attribute ``failed``.

    Raises
    ------
    TypeError, ValueError
        If there is no model, or it has likelihood terms besides its simulators, whose data cannot
        be drawn.
    RuntimeError
        If more than half of the data sets could not be analysed.

    References
    ----------
    .. [1] Talts, S. et al. (2018), Validating Bayesian inference algorithms with
       simulation-based calibration, arXiv:1804.06788.
    .. [2] Säilynoja, T., P.-C. Bürkner and A. Vehtari (2022), Graphical test for discrete
       uniformity and its applications in goodness-of-fit evaluation, Stat. Comput. 32,
       doi:10.1007/s11222-022-10090-6.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     data = np.arange(9.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.KullbackLeibler(), observed=data)
    >>> ranks = prb.simulation_based_calibration(2, model=model, draws=50, progressbar=False)
    >>> ranks.prior_sbc["mu"].shape
    (1, 2)
    """
    model = model_on_context(model, "prb.simulation_based_calibration")
    positive_integer(n, "n", minimum=2)
    positive_integer(draws, "draws", minimum=10)
    refuse_adjustment(adjustment)
    executes(executor, "executor")
    flag(progressbar, "progressbar")
    seed = seed_number(random_seed)
    evaluator = Evaluator.of(model)
    obstacle = None if evaluator.nodes else simulation_obstacle(evaluator)
    if obstacle is not None:
        raise ValueError(
            f"simulation_based_calibration: {obstacle}, so that data sets cannot be drawn; "
            "calibrate data of your own simulations with prb.sample_smc"
        )
    if evaluator.nodes and has_other_terms(evaluator):
        raise ValueError(
            "simulation_based_calibration: got a model with likelihood terms or potentials "
            "besides its simulators, whose data cannot be drawn; expected prb.Simulator nodes only"
        )
    starts = range(0, n, _CHUNK)
    jobs = []
    for start in starts:
        numbers = range(start, min(start + _CHUNK, n))
        jobs.append(_Job(numbers, draws, adjustment, seed))
    with shown(progressbar), progress("data sets", n) as advance:
        if executor is None:
            parts = [_analyse(evaluator, job, lambda: advance(1, "")) for job in jobs]
        else:
            parts = _on_executor(executor, model, jobs, lambda size: advance(size, ""))
    rows = list(chain.from_iterable(parts))
    good = [row for row in rows if isinstance(row, dict)]
    failed = [row for row in rows if isinstance(row, str)]
    if failed:
        text = f"{len(failed)} of {n} data sets could not be analysed; the first: {failed[0]}"
        report(Finding("data-sets-not-analysed", text))
    if len(failed) > n / 2:
        raise RuntimeError(
            f"simulation_based_calibration: {len(failed)} of {n} data sets failed; "
            f"first: {failed[0]}"
        )
    return calibration_tree(
        evaluator, good, failed=len(failed), draws=draws, adjustment=adjustment, seed=seed
    )


@dataclass(frozen=True)
class _Job:
    """Some of the data sets, by their numbers, and how they are analysed."""

    which: range
    draws: int
    adjustment: Adjustment
    random_seed: int


# Ranks, truths and standard deviations by variable; or what went wrong.
_Row = dict[str, Floats] | str


def _on_executor(
    executor: Executor, model: pm.Model, jobs: list[_Job], report: Callable[[int], Any]
) -> list[list[_Row]]:
    """Return the rows of each job; reports as they are done, in whatever order."""
    import cloudpickle

    sent = cloudpickle.dumps(model)
    futures: list[Future[list[_Row]]] = [executor.submit(_remote, sent, job) for job in jobs]
    for done in as_completed(futures):
        report(len(done.result()))
    return [future.result() for future in futures]


def _remote(sent: bytes, job: _Job) -> list[_Row]:
    import cloudpickle

    return _analyse(Evaluator.of(cloudpickle.loads(sent)), job)


def _analyse(
    evaluator: Evaluator, job: _Job, report: Callable[[], Any] = lambda: None
) -> list[_Row]:
    """Analyse some data sets, each on the designs as they were before."""
    rows: list[_Row] = []
    for i in job.which:
        rng = np.random.default_rng([job.random_seed, i])
        with shown(False), designs_restored(evaluator.reweighted.values()):
            try:
                rows.append(_one(evaluator, job, rng))
            except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
                rows.append(f"{type(error).__name__}: {error}")
        report()
    return rows


def _one(evaluator: Evaluator, job: _Job, rng: np.random.Generator) -> dict[str, Floats]:
    """Draw hyperparameters, and data from their population, and rank them among the draws."""
    theta_seed = int(rng.integers(2**31))
    theta = evaluator.hyperparameters.prior_thetas(1, theta_seed)[0]
    # Of a likelihood by specimen the emulator is the response.
    pools, data = [], {}
    if evaluator.nodes:
        data = fresh_data(evaluator, theta, rng)
    for k, likelihood in enumerate(evaluator.likelihoods):
        params = specimen_params(evaluator, theta[None], k)
        pools.append(specimen_pool(likelihood, params, rng, size=len(likelihood.readings)))
    draws_seed = int(rng.integers(2**31))
    asked = Sampling(draws=job.draws, adjustment=job.adjustment, random_seed=draws_seed)
    draw = sample if job.adjustment is None else draw_posterior
    with other_specimens(evaluator.likelihoods, [pool.data_set(rng) for pool in pools]):
        posterior = draw(evaluator.observing(data), asked)["posterior"]
    row = {}
    for name, (truth,) in evaluator.hyperparameters.constrained(theta[None]).items():
        found = np.asarray(posterior[name])[0]
        below = (found < truth).sum(axis=0)
        # Somewhere between the two neighbours, so that ranks are uniform and not discrete.
        between = rng.random(np.shape(below))
        rank = (below + between) / (job.draws + 1)
        row[name] = np.stack([rank, truth, found.std(axis=0)])
    return row
