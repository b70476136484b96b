"""After any sampler: did it converge, and did the designs support the answer? Silent when nothing is wrong."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._checks import Floats
from prbayes.estimate.optimum import Optimum
from prbayes.model.evaluator import Evaluator
from prbayes.model.node import model_on_context
from prbayes.model.support import shortcoming

_RHAT = 1.01
_NOISE = 11.0  # R-hat of independent draws is below 1 + _NOISE / (chains x draws) in 999 of 1000 cases, and a bit more
_ESS = 400
_SUPPORT = ("weight_ess", "mean_weight", "lost_mass")


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What `diagnose` found.

    Attributes
    ----------
    messages : tuple of str
        What is wrong and what to do; empty when nothing is.
    support : xarray.Dataset
        ``weight_ess``, ``mean_weight`` and ``lost_mass`` by simulator and draw, for `Reweighted`.
    """

    messages: tuple[str, ...]
    support: xr.Dataset = field(repr=False)

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.messages

    def __str__(self) -> str:
        return "\n".join(self.messages) if self.messages else "No problem was found."


def diagnose(result: xr.DataTree | Optimum, *, model: pm.Model | None = None) -> Diagnosis:
    """Say in sentences what is wrong with a result, and what to do, whichever sampler gave it.

    Looked at are: what is not identified; R-hat and effective sample size, by ArviZ; how far the particles of
    `sample_smc` moved in its last stage; and whether the stored responses of `Reweighted` supported the answer.

    Parameters
    ----------
    result : xarray.DataTree or Optimum
        With a ``posterior`` group that has the model's free variables, from `sample_smc` or any PyMC sampler.
    model : pymc.Model, optional
        The one on the context by default. Results of `sample_smc`, also from a file, tell without it.

    Returns
    -------
    Diagnosis
        ``print`` it, or look at ``ok``.

    Raises
    ------
    TypeError, KeyError
        If there is no model where one is needed, or the posterior lacks a free variable of it.

    References
    ----------
    .. [1] Vehtari, A., A. Gelman, D. Simpson, B. Carpenter and P.-C. Buerkner (2021), Rank-normalization, folding, and
       localization: an improved R-hat, Bayesian Analysis 16(2), 667-718, doi:10.1214/20-BA1221.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> print(prb.diagnose(prb.minimize(model)))
    No problem was found.
    """
    if isinstance(result, Optimum):
        messages = list(map(_sentence, result.warnings))
        if not result.converged and not result.at_edge:
            messages.append(f"The optimiser did not converge ({result.message}); try another start or method.")
        found = _computed(result.evaluator, result.theta[None])
    else:
        posterior = result["posterior"]
        messages = list(map(_sentence, str(posterior.attrs.get("warnings", "")).splitlines()))
        if model is None and "calibration" in result:
            found = _stored(result)
        else:
            model = model_on_context(model, "prb.diagnose")
            found = _computed(Evaluator(model), _thetas(posterior, model))
        variables = posterior.to_dataset()
        if model is not None:
            variables = variables[[str(rv.name) for rv in model.free_RVs]]
        messages += [*_convergence(variables), *_motion(result)]
    support, needs = found
    for name, (need, max_lost, n_points) in needs.items():
        own = {key: support[key].sel(simulator=name).values for key in _SUPPORT}
        what = shortcoming(own, need, max_lost, n_points)
        if what:
            messages.append(
                f"{name}: the design does not support the answer: {what}. Call prb.refine(model) and sample again, or "
                "use prb.Resimulated."
            )
    return Diagnosis(tuple(messages), support)


def _sentence(line: str) -> str:
    return f"{line[0].upper()}{line[1:]}."


def _convergence(posterior: xr.Dataset) -> list[str]:
    """Say where chains disagree, and where there are too few independent draws."""
    stats: Any = import_module("arviz_stats")  # heavy, and partly annotated
    chains, draws = posterior.sizes["chain"], posterior.sizes["draw"]
    messages = []
    if draws < 4:
        return []
    with np.errstate(all="ignore"):  # a variable that never moves
        rhats, sizes = _elements(stats.rhat(posterior)), _elements(stats.ess(posterior))
    if chains > 1:
        limit = max(_RHAT, 1 + _NOISE / (chains * draws))
        high = {name: r for name, r in rhats.items() if r > limit}
        if high:
            messages.append(
                f"R-hat is {_listed(high, '.2f')}, expected at most {limit:.2f}: the chains disagree, look at "
                "az.plot_rank(idata). Pass more draws, or with prb.sample_smc a threshold of 0.8; if the chains sit in "
                "separate modes, state a prior that excludes one."
            )
    low = {name: e for name, e in sizes.items() if e < min(_ESS, chains * draws / 4)}
    if low:
        messages.append(
            f"The effective sample size is {_listed(low, '.0f')} of {chains * draws} draws: too few for means and "
            "intervals. Pass more draws."
        )
    return messages


def _elements(values: Any) -> dict[str, float]:
    """Return numbers by element, such as 'mu[1]'."""
    return {
        f"{name}[{','.join(map(str, i))}]" if i else str(name): float(value.values[i])
        for name, value in values.items()
        for i in np.ndindex(value.shape)
    }


def _listed(values: dict[str, float], form: str) -> str:
    return ", ".join(f"{value:{form}} for {name}" for name, value in values.items())


def _motion(result: xr.DataTree) -> list[str]:
    """Say which chains of `sample_smc` hardly moved in their last stage."""
    if "sample_stats" not in result or "stage" not in result["sample_stats"].dims:
        return []
    stats = result["sample_stats"]
    moves: Any = (stats["accept_rate"] * stats["n_steps"]).values
    last = [chain[~np.isnan(chain)][-1] for chain in moves]
    stuck = [i for i, m in enumerate(last) if m < 1]
    if not stuck:
        return []
    calibration = result["calibration"]
    noise = float((calibration["discrepancy_error"] / calibration["epsilon"]).max())
    why = f" (its Monte Carlo error is {noise:.1f} epsilon)" if noise > 1 else ""
    return [
        f"Particles hardly moved in the last stage of {'chains' if len(stuck) > 1 else 'chain'} "
        f"{', '.join(map(str, stuck))} ({min(last):.2f} accepted steps per particle, expected at least 1), so that "
        f"many draws are the same. The discrepancy is too noisy{why}, or epsilon too small: use prb.Reweighted or "
        "prb.Resimulated instead of prb.Fresh, or pass a larger n or epsilon."
    ]


def _thetas(posterior: Any, model: pm.Model) -> Floats:
    names = [rv.name for rv in model.free_RVs]
    missing = [n for n in names if n not in posterior]
    if missing:
        raise KeyError(f"posterior: got no {missing}, expected the model's free variables {names}")
    arrays = [posterior[n].transpose("chain", "draw", ...).values for n in names]
    return Evaluator(model).thetas_of([a.reshape(-1, *a.shape[2:]) for a in arrays])


_Found = tuple[xr.Dataset, dict[str, tuple[float, float, int]]]


def _computed(evaluator: Evaluator, thetas: Floats) -> _Found:
    """Return the support of the designs now, and what they need, by simulator."""
    support = evaluator.support(thetas)
    needs = {name: (d.required_ess, d.config.max_lost, d.n_points) for name, d in evaluator.designs.items()}
    return _labelled({key: np.array([support[n][key] for n in support]) for key in _SUPPORT}, list(support)), needs


def _labelled(support: dict[str, Floats], names: list[str]) -> xr.Dataset:
    stacked = {key: (["simulator", "sample"], values) for key, values in support.items()} if names else {}
    return xr.Dataset(stacked, coords={"simulator": names})


def _stored(result: xr.DataTree) -> _Found:
    """Return the same as it was when the sampler ran."""
    calibration = result["calibration"].to_dataset()
    calibration = calibration.isel(simulator=np.flatnonzero(~np.isnan(calibration["required_ess"].values)))
    columns = [calibration[key].values for key in ("simulator", "required_ess", "max_lost", "n_points")]
    needs = {str(name): (float(need), float(lost), int(n)) for name, need, lost, n in zip(*columns, strict=True)}
    size = calibration.sizes
    shape = size["simulator"], size["chain"] * size["draw"]
    flat = {key: calibration[key].transpose("simulator", "chain", "draw").values.reshape(shape) for key in _SUPPORT}
    return _labelled(flat, list(needs)), needs
