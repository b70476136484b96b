"""Simulation-based calibration: the ranks of true hyperparameters among posterior draws."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, as_completed
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._display import Tree, View
from prbayes._finding import Finding, report
from prbayes._progress import progress, shown
from prbayes._validate import (
    NamedArrays,
    Seed,
    executes,
    flag,
    positive_integer,
    seed_number,
)
from prbayes.inference.refits import summary_obstacle
from prbayes.inference.resampling import fresh_data
from prbayes.model.description import labelled, versions
from prbayes.model.evaluator import Evaluator, has_other_terms, with_unchanged_runs
from prbayes.model.locking import locked
from prbayes.model.parameters import split_elements
from prbayes.optimize.maximum_likelihood import (
    other_specimens,
    simulation_obstacle,
    specimen_pool,
)
from prbayes.posterior.sample import draw_posterior
from prbayes.posterior.smc import Adjustment, SamplingSettings, require_adjustment, sample
from prbayes.propagation.reweighted import designs_restored
from prbayes.response.inputs import model_on_context

# Number of data sets of a job. A worker analyses them in seconds, and sending the model takes
# milliseconds.
_CHUNK = 10


@locked
def simulation_based_calibration(
    n_data_sets: int = 200,
    *,
    model: pm.Model | None = None,
    draws: int = 500,
    adjustment: Adjustment = "estimate",
    executor: Executor | None = None,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> Ranks:
    """Calibrate many data sets with known hyperparameters, and rank these among the draws.

    Hyperparameters are drawn from the prior, and specimens from their populations. The response is
    called for them; with the log-likelihood by specimen its emulator is, which is not checked. Then
    `sample`, or `sample_smc` with ``adjustment=None``, runs as on measurements. If posteriors have
    the right width and place, the ranks are uniform. The check covers the whole prior.

    Parameters
    ----------
    n_data_sets : int
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
        set: ranks scaled to the unit interval, for `arviz.plot_ecdf_pit`. Group ``envelope``: the
        ECDF of the ranks of each variable, and ArviZ's simultaneous 95% envelope for uniform ones;
        the attribute ``outside`` names the variables that leave it. Groups ``truth`` and
        ``posterior_sd`` alike. Data sets that could not be analysed are left out and counted in the
        attribute ``failed``.

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
    positive_integer(n_data_sets, "n_data_sets", minimum=2)
    positive_integer(draws, "draws", minimum=10)
    require_adjustment(adjustment)
    executes(executor)
    flag(progressbar, "progressbar")
    seed = seed_number(random_seed)
    evaluator = with_unchanged_runs(Evaluator.of(model))
    obstacle = simulation_obstacle(evaluator)
    if evaluator.nodes:
        obstacle = summary_obstacle(evaluator)
        if obstacle is None and has_other_terms(model):
            raise ValueError(
                "simulation_based_calibration: got a model with likelihood terms or potentials "
                "besides its simulators, whose data cannot be drawn; expected prb.Simulator nodes "
                "only"
            )
    if obstacle is not None:
        raise ValueError(
            f"simulation_based_calibration: {obstacle}, and data sets cannot be drawn; "
            "calibrate data of your own simulations with prb.sample_smc"
        )
    settings = SamplingSettings(draws=draws, adjustment=adjustment, random_seed=seed)
    jobs = [range(n_data_sets)[start : start + _CHUNK] for start in range(0, n_data_sets, _CHUNK)]
    with shown(progressbar), progress("data sets", n_data_sets) as advance:
        if executor is None:
            parts = [_analyse(evaluator, job, settings, lambda: advance(1, "")) for job in jobs]
        else:
            import cloudpickle

            pickled = cloudpickle.dumps(model)
            futures = [executor.submit(_analyse, pickled, job, settings) for job in jobs]
            for future in as_completed(futures):
                advance(len(future.result()), "")
            parts = [future.result() for future in futures]
    results = list(chain.from_iterable(parts))
    rows = [result for result in results if isinstance(result, dict)]
    errors = [result for result in results if isinstance(result, str)]
    if errors:
        failed = f"{len(errors)} of {n_data_sets} data sets could not be analysed"
        text = f"{failed}; the first: {errors[0]}"
        report(Finding("data-sets-not-analysed", text))
    if len(errors) > n_data_sets / 2:
        raise RuntimeError(
            f"simulation_based_calibration: {len(errors)} of {n_data_sets} data sets failed; "
            f"first: {errors[0]}"
        )
    groups = {}
    for i, group in enumerate(("prior_sbc", "truth", "posterior_sd")):
        values = {name: np.stack([row[name] for row in rows])[None, :, i] for name in rows[0]}
        groups[group] = labelled(evaluator, values, {"chain": 1, "draw": len(rows)})
    groups["envelope"], outside = _envelopes(groups["prior_sbc"])
    groups["prior_sbc"].attrs.update(
        {
            "outside": ", ".join(outside),
            "failed": len(errors),
            "draws": draws,
            "adjustment": str(adjustment),
            "random_seed": str(seed),
            **versions(),
        }
    )
    return Ranks.from_dict(groups)


class Ranks(Tree):
    """Ranks of true hyperparameters among posterior draws."""

    __slots__ = ()
    _parts = ("prior_sbc", "envelope", "truth", "posterior_sd")

    def to_dataframe(self) -> Any:
        """Return a row for each variable: mean and sd of its ranks, and the envelope's verdict."""
        if not self._is_whole:
            return super().to_dataframe()
        import pandas as pd

        ranks = self["prior_sbc"].to_dataset()
        values = {name: variable[0] for name, variable in ranks.data_vars.items()}
        elements = split_elements(values)
        outside = ranks.attrs["outside"].split(", ")
        columns = {
            "mean rank": [x.mean() for x in elements.values()],
            "sd of ranks": [x.std() for x in elements.values()],
            "outside the envelope": [name in outside for name in elements],
        }
        return pd.DataFrame(columns, index=pd.Index(elements, name="variable"))

    def to_view(self) -> View:
        """Return what a reader sees."""
        attrs, table = self["prior_sbc"].attrs, self.to_dataframe()
        rows = [
            [str(name), f"{mean:.3f}", f"{sd:.3f}", "outside" if is_outside else "inside"]
            for name, mean, sd, is_outside in table.itertuples(name=None)
        ]
        verdict = f"those of {attrs['outside']} are not uniform" if attrs["outside"] else "uniform"
        n = self["prior_sbc"].sizes["draw"]
        heading = f"Ranks of true hyperparameters in {n} data sets: {verdict}"
        sentences = ["Of uniform ranks the mean is .5 and the standard deviation .289."]
        if attrs["failed"]:
            sentences.append(f"{attrs['failed']} data sets could not be analysed.")
        return View(heading, ["", "mean rank", "sd of ranks", "95% envelope"], rows, sentences)


def _envelopes(ranks: xr.Dataset) -> tuple[xr.Dataset, list[str]]:
    """Return ECDFs of ranks with ArviZ's envelope for uniform ones, and variables outside of it."""
    from arviz_stats.ecdf_utils import ecdf_pit

    prob = 0.95  # the probability in ArviZ's own pictures of ranks
    ecdfs, outside = {}, []
    values = {name: variable[0] for name, variable in ranks.data_vars.items()}
    for name, column in split_elements(values).items():
        x, ecdf, lower, upper = ecdf_pit(  # type: ignore[no-untyped-call]
            column, prob, n_simulations=1000, rng=np.random.default_rng(0)
        )
        ecdfs[name] = ecdf
        if ((ecdf < lower) | (ecdf > upper)).any():
            outside.append(name)
    envelope = xr.Dataset(
        {
            "ecdf": (["variable", "x"], np.array(list(ecdfs.values()))),
            "lower": ("x", lower),
            "upper": ("x", upper),
        },
        coords={"variable": list(ecdfs), "x": x},
        attrs={"probability": prob},
    )
    return envelope, outside


# ranks, truths and standard deviations by variable, or an error message
_Result = NamedArrays | str


def _analyse(
    problem: Evaluator | bytes,
    numbers: range,
    settings: SamplingSettings,
    advance: Callable[[], Any] = lambda: None,
) -> list[_Result]:
    """Analyse data sets of an evaluator, or a pickled model, each on the original designs."""
    if isinstance(problem, bytes):
        import cloudpickle

        problem = Evaluator.of(cloudpickle.loads(problem))
    results: list[_Result] = []
    for i in numbers:
        with shown(False), designs_restored(problem.reweighted.values()):
            try:
                results.append(_ranks(problem, settings, i))
            except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
                results.append(f"{type(error).__name__}: {error}")
        advance()
    return results


def _ranks(evaluator: Evaluator, settings: SamplingSettings, number: int) -> NamedArrays:
    """Draw hyperparameters, and data from their population, and rank them among the draws."""
    assert settings.random_seed is not None
    rng = np.random.default_rng([settings.random_seed, number])
    hyperparameters = evaluator.hyperparameters
    theta = hyperparameters.prior_thetas(1, int(rng.integers(2**31)))
    data = fresh_data(evaluator, theta[0], rng)
    values = hyperparameters.constrained(theta)
    # With a log-likelihood by specimen the emulator stands for the response.
    pools = [
        specimen_pool(likelihood, values, rng, size=len(likelihood.readings))
        for likelihood in evaluator.likelihoods
    ]
    settings = replace(settings, random_seed=int(rng.integers(2**31)))
    draw = sample if settings.adjustment is None else draw_posterior
    with other_specimens(evaluator.likelihoods, [pool(rng) for pool in pools]):
        posterior = draw(evaluator.observing(data), settings)["posterior"]
    row = {}
    for name, (truth,) in hyperparameters.constrained(theta).items():
        values = np.asarray(posterior[name])[0]
        below = (values < truth).sum(axis=0)
        # A random position between the two neighbouring draws makes ranks continuous.
        rank = (below + rng.random(np.shape(below))) / (settings.draws + 1)
        row[name] = np.stack([rank, truth, values.std(axis=0)])
    return row
