"""The posterior after further specimens, without a new emulator."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._finding import Finding, counted, report
from prbayes._progress import shown
from prbayes._validate import Floats, Indices, Seed, real_array, seed_number, wrong_type
from prbayes.model.emulated import EmulatedSimulator
from prbayes.model.evaluator import Evaluator, with_unchanged_runs
from prbayes.model.fingerprint import identity_from_attributes, identity_of, require_same
from prbayes.model.locking import locked
from prbayes.model.measurement import SpecimenLikelihood, has_random_response, is_exchangeable
from prbayes.model.parameters import variables_at
from prbayes.model.specimen_audit import audited_likelihood
from prbayes.model.specimen_likelihood import (
    all_simulators,
    log_likelihoods,
    specimen_likelihoods,
)
from prbayes.model.specimen_preparation import prepared, with_emulator, with_specimens
from prbayes.numerics.mixtures import pareto_smoothed
from prbayes.posterior.sample import draw_posterior
from prbayes.posterior.smc import SamplingSettings
from prbayes.propagation.base import DesignError
from prbayes.response.inputs import model_on_context
from prbayes.results.predict import thetas_of
from prbayes.results.products import one_posterior

_AGAIN = "calibrate all specimens together: pm.set_data or a new model, and prb.sample"


@locked
def update(
    result: xr.DataTree,
    *,
    observed: Any,
    model: pm.Model | None = None,
    random_seed: Seed = 0,
) -> xr.DataTree:
    r"""Return the posterior of the specimens of a result and of further ones.

    The emulator of the first specimens finds the inputs of the new ones, so that the response does
    not run. With the likelihood :math:`p(y_i \mid \theta)` of each new specimen,

    .. math:: p(\theta \mid y_1, \ldots, y_{N + n})
        \propto p(\theta \mid y_1, \ldots, y_N) \prod_{i = N + 1}^{N + n} p(y_i \mid \theta) .

    All specimens count alike: the posterior is drawn anew from the points of all of them [1]_, and
    does not depend on the order of updates.

    Parameters
    ----------
    result : xarray.DataTree
        Posterior of the model's specimens, from `sample` or any sampler of PyMC; or from this
        function.
    observed : array_like, (n,) or (n, m)
        Readings of the new specimens, in the form of the simulator's.
    model : pymc.Model, optional
        That of the result, with its data; the one on the context by default. It has one simulator,
        with the log-likelihood by specimen.
    random_seed : int, sequence of int, numpy.random.Generator or None

    Returns
    -------
    xarray.DataTree
        As from `sample`, with as many chains and draws as ``result``. The group ``observed_data``
        has all specimens. The finding ``unlike-specimens`` names new specimens that contradict the
        first ones.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or if the specimens have groups, labels, weights or
        conditions of their own.
    DesignError
        If the emulator does not reach the new specimens.

    References
    ----------
    .. [1] Vehtari, A., D. Simpson, A. Gelman, Y. Yao and J. Gabry (2024), Pareto smoothed
       importance sampling, J. Mach. Learn. Res. 25(72), 1-58.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, observed=[0.0, 1.0, 2.0, 4.0, 5.0])
    >>> first = prb.sample(500, model=model, random_seed=1, progressbar=False)
    >>> later = prb.update(first, observed=[1.5, 3.0], model=model)
    >>> later.observed_data["y"].size
    7
    """
    caller = "prb.update"
    model = model_on_context(model, caller)
    new = real_array(observed, f"{caller}: observed").astype(float)
    if not new.size:
        raise ValueError(f"{caller}: observed: got no reading, expected those of new specimens")
    seed = seed_number(random_seed)
    if not isinstance(result, xr.DataTree) or "posterior" not in result.children:
        raise wrong_type(result, caller, "a DataTree with a posterior, as of prb.sample")
    result = one_posterior(result, caller)
    likelihood = _updatable(model, caller)
    latest = likelihood.cache.get("updated")
    evaluator = with_unchanged_runs(latest or Evaluator.of(model))
    thetas = thetas_of(result, evaluator, 1024, caller)
    earlier = _of_result(likelihood, latest, result, thetas, caller)
    identity = identity_from_attributes(result["posterior"].attrs)
    require_same(identity, identity_of(_evaluator(evaluator, earlier)), caller)
    event = likelihood.measurements[0].event
    if new.shape[1:] != event:
        raise ValueError(
            f"{caller}: observed: got shape {new.shape}, expected {('n', *event)}, in the form of "
            "the simulator's observed values"
        )
    extended, unlike = _extended(earlier, new, thetas, caller)
    updated = likelihood.cache["updated"] = _evaluator(evaluator, extended)
    findings = (*prepared(extended).findings, *report(*unlike))
    extended.cache["preparation"] = replace(prepared(extended), findings=findings)
    posterior = result["posterior"]
    settings = SamplingSettings(
        draws=posterior.sizes["draw"],
        chains=posterior.sizes["chain"],
        random_seed=seed,
        with_groups=True,
    )
    with shown(False):
        return draw_posterior(updated, settings)


def _updatable(model: pm.Model, caller: str) -> SpecimenLikelihood:
    """Return the likelihood of a model whose specimens are alike, or raise."""
    likelihoods = list(specimen_likelihoods(model).values())
    if len(likelihoods) != 1 or len(all_simulators(model)) != 1:
        raise TypeError(
            f"{caller}: got a model with other simulators than one with the log-likelihood by "
            f"specimen, expected one without metric=; {_AGAIN}"
        )
    (likelihood,) = likelihoods
    if not is_exchangeable(likelihood) or likelihood.measurements[0].specimens is not None:
        raise TypeError(
            f"{caller}: {likelihood.name}: got specimens with groups, labels, weights or "
            f"conditions, which new ones lack, expected none; {_AGAIN}"
        )
    if has_random_response(likelihood):
        raise TypeError(
            f"{caller}: {likelihood.name}: got a random response, whose emulator is that of the "
            f"first specimens, expected a deterministic one; {_AGAIN}"
        )
    if prepared(likelihood).emulation.offsets is not None:
        raise DesignError(
            f"{likelihood.name}: got an emulator that runs at each specimen correct, expected one "
            f"that serves further specimens; {_AGAIN}"
        )
    return likelihood


def _of_result(
    likelihood: SpecimenLikelihood,
    latest: Evaluator | None,
    result: xr.DataTree,
    thetas: Floats,
    caller: str,
) -> SpecimenLikelihood:
    """Return the likelihood of a result's specimens: those of the model, and of earlier updates."""
    (measurement,) = likelihood.measurements
    if "observed_data" not in result.children:
        return likelihood
    data = np.asarray(result["observed_data"][measurement.name], dtype=np.float64)
    of_updates = latest.likelihoods if latest else ()
    for candidate in (*of_updates, likelihood):
        first = candidate.measurements[0].observed
        if np.array_equal(data[: len(first)], first, equal_nan=True):
            rest = data[len(first) :]
            return _extended(candidate, rest, thetas, caller)[0] if len(rest) else candidate
    raise ValueError(
        f"{caller}: got a result of other specimens than the model's, expected those of "
        f"{measurement.name} first; pass the model that the result was made from"
    )


def _evaluator(evaluator: Evaluator, likelihood: SpecimenLikelihood) -> Evaluator:
    """Return the evaluator of other specimens."""
    emulated = (EmulatedSimulator(likelihood, likelihood.measurements[0]),)
    return replace(evaluator, emulated=emulated, has_graph=False)


def rare_specimens(logs: Floats) -> Indices:
    """Return specimens whose likelihoods are those of few draws: logs (S, n), Pareto k above .7."""
    _, tails = pareto_smoothed(logs.T)
    return np.flatnonzero(tails > 0.7)


def _extended(
    likelihood: SpecimenLikelihood, new: Floats, thetas: Floats, caller: str
) -> tuple[SpecimenLikelihood, list[Finding]]:
    """Return the likelihood of the specimens and of new ones, and what the new ones contradict."""
    try:
        joint, added = with_specimens(likelihood, new, thetas)
    except ValueError as error:  # errors, limits or steps by reading
        raise TypeError(f"{caller}: {error}; {_AGAIN}") from None
    grown, checked = audited_likelihood(added, thetas, is_last=False), added
    if grown is not added:
        # The emulator has got runs, and all specimens new points.
        checked = joint = with_emulator(joint, grown)
    for finding in prepared(checked).findings:
        if finding.code == "readings-misfit":
            raise DesignError(f"{caller}: {finding.text}")
    n = len(likelihood.readings)
    logs = log_likelihoods(added, variables_at(likelihood.hyperparameters, thetas))
    unlike = [f"{n + i}" for i in rare_specimens(logs)]
    findings = []
    if unlike:
        prepared(grown)  # Raises where only the emulator has inputs of the new readings.
        # The points were to suffice for the first specimens' populations, which may not be likely.
        joint = with_emulator(joint, grown)
        text = (
            f"{likelihood.name}: {counted(len(unlike), 'new specimen')} (row {', '.join(unlike)}) "
            "would be rare under every population that the first specimens allow (Pareto k above "
            "0.7). Look at these specimens before the posterior is used."
        )
        findings.append(
            Finding("unlike-specimens", text, "more_specimens.md#a-specimen-that-is-unlike")
        )
    return joint, findings
