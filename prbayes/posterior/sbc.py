"""Simulation-based calibration: whether the whole procedure gives posteriors of the right width for a model."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Executor, Future, as_completed
from contextlib import ExitStack
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._checks import Floats, positive_integer
from prbayes._progress import progress, shown
from prbayes.estimate.data_sets import fresh_data
from prbayes.model.evaluator import Evaluator
from prbayes.model.node import model_on_context
from prbayes.posterior.adjustment import Affine
from prbayes.posterior.smc import sample
from prbayes.posterior.trees import calibration_tree

_log = logging.getLogger("prbayes")
_CHUNK = 10  # data sets that a worker analyses before it reports


def simulation_based_calibration(
    n: int = 200,
    *,
    model: pm.Model | None = None,
    draws: int = 500,
    adjust: Affine | bool = True,
    executor: Executor | None = None,
    random_seed: int = 0,
    progressbar: bool = True,
) -> xr.DataTree:
    """Calibrate many data sets with known hyperparameters, and rank these among the posterior's draws.

    Each time hyperparameters are drawn from the prior, and specimens from their populations, for which the
    response is called; then epsilon, `sample_smc` and its adjustment run as they would on measurements. If
    posteriors have the right width and place, the ranks are uniform. A wide prior asks more than one true
    value does: it shows what happens all over the prior.

    Parameters
    ----------
    n : int
        Number of data sets.
    model : pymc.Model, optional
        The one on the context by default. Its observed values matter only by their number, weights and labels.
    draws : int
        Draws of each posterior, in one chain.
    adjust : Affine or bool
        As in `sample_smc`.
    executor : concurrent.futures.Executor, optional
        Where data sets are analysed, ten at a time; the model is sent with cloudpickle.
    random_seed : int
        The result does not depend on the executor.
    progressbar : bool

    Returns
    -------
    xarray.DataTree
        Group ``prior_sbc`` with dimensions (chain, draw), chain of length one and a draw per data set: ranks
        scaled to the unit interval, for `arviz.plot_ecdf_pit`, which adds the envelope or a test of
        uniformity. Group ``envelope``: the ECDF of the ranks of each variable, and ArviZ's simultaneous 95%
        envelope for uniform ones; the attribute ``outside`` names the variables that leave it. Groups ``truth``
        and ``posterior_sd`` alike. Data sets that could not be analysed are left out and counted in the
        attribute ``failed``.

    Raises
    ------
    TypeError, ValueError
        If there is no model, or it has likelihood terms besides its simulators, whose data cannot be drawn.
    RuntimeError
        If more than half of the data sets could not be analysed.

    References
    ----------
    .. [1] Talts, S. et al. (2018), Validating Bayesian inference algorithms with simulation-based calibration,
       arXiv:1804.06788.
    .. [2] Säilynoja, T., P.-C. Bürkner and A. Vehtari (2022), Graphical test for discrete uniformity and its
       applications in goodness-of-fit evaluation, Stat. Comput. 32, doi:10.1007/s11222-022-10090-6.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.KullbackLeibler(), observed=np.arange(9.0))
    >>> ranks = prb.simulation_based_calibration(2, model=model, draws=50, progressbar=False)
    >>> ranks.prior_sbc["mu"].shape
    (1, 2)
    """
    model = model_on_context(model, "prb.simulation_based_calibration")
    positive_integer(n, "n", minimum=2)
    positive_integer(draws, "draws", minimum=10)
    evaluator = Evaluator(model)
    if model.potentials or len(model.observed_RVs) > len(evaluator.nodes):
        raise ValueError(
            "simulation_based_calibration: got a model with likelihood terms or potentials besides its simulators, "
            "whose data cannot be drawn; expected prb.Simulator nodes only"
        )
    jobs = [(range(i, min(i + _CHUNK, n)), draws, adjust, random_seed) for i in range(0, n, _CHUNK)]
    with shown(progressbar), progress("data sets", n) as report:
        if executor is None:
            rows = [row for job in jobs for row in _analyse(evaluator, *job, lambda: report(1, ""))]
        else:
            import cloudpickle

            sent = cloudpickle.dumps(model)
            futures: list[Future[Any]] = [executor.submit(_remote, sent, *job) for job in jobs]
            for done in as_completed(futures):
                report(len(done.result()), "")
            rows = [row for future in futures for row in future.result()]
    failed = [row for row in rows if isinstance(row, str)]
    good = [row for row in rows if not isinstance(row, str)]
    if failed:
        _log.warning("%d of %d data sets could not be analysed; the first: %s", len(failed), n, failed[0])
    if len(failed) > n / 2:
        raise RuntimeError(f"simulation_based_calibration: {len(failed)} of {n} data sets failed; first: {failed[0]}")
    return calibration_tree(evaluator, good, failed=len(failed), draws=draws, adjust=adjust, seed=random_seed)


def _remote(sent: bytes, *job: Any) -> list[Any]:
    import cloudpickle

    return _analyse(Evaluator(cloudpickle.loads(sent)), *job)


def _analyse(
    evaluator: Evaluator,
    which: range,
    draws: int,
    adjust: Affine | bool,
    seed: int,
    report: Callable[[], Any] = lambda: None,
) -> list[Any]:
    """Analyse some data sets; each gives ranks, truths and standard deviations by variable, or what went wrong."""
    rows: list[Any] = []
    for i in which:
        rng = np.random.default_rng([seed, i])
        with ExitStack() as stack:
            stack.enter_context(shown(False))
            for design in evaluator.designs.values():
                stack.enter_context(design.undone())
            try:
                rows.append(_one(evaluator, draws, adjust, rng))
            except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
                rows.append(f"{type(error).__name__}: {error}")
        report()
    return rows


def _one(evaluator: Evaluator, draws: int, adjust: Affine | bool, rng: np.random.Generator) -> dict[str, Floats]:
    theta = evaluator.prior_thetas(1, int(rng.integers(2**31)))[0]
    tree = sample(
        evaluator.observing(fresh_data(evaluator, theta, rng)),
        draws=draws,
        adjust=adjust,
        random_seed=int(rng.integers(2**31)),
    )
    out = {}
    for name, value in evaluator.constrained(theta[None]).items():
        found = np.asarray(tree["posterior"][name])[0]
        below = (found < value[0]).sum(axis=0)
        rank = (below + rng.random(np.shape(below))) / (draws + 1)
        out[name] = np.stack([rank, value[0], found.std(axis=0)])
    return out
