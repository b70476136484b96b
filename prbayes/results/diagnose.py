"""After any sampler or optimiser: whether it converged, and the designs supported the answer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._display import view
from prbayes._finding import Finding
from prbayes._pages import more_in
from prbayes._validate import Floats
from prbayes.inference.disagreement import disagreement
from prbayes.inference.goodness_of_fit import UNLIKELY, Refitted, of_another_family, of_held_away
from prbayes.inference.refits import SamplingDistribution
from prbayes.inference.requirements import refit_obstacle
from prbayes.inference.resampling import SETS
from prbayes.model.coverage import ENOUGH, shortcoming
from prbayes.model.elements import (
    finite_draws,
    single_elements,
    stacked_draws,
    told_elements,
)
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import Level
from prbayes.model.locking import locked
from prbayes.optimize.caveats import small_simulators
from prbayes.optimize.optimum import NO_RESPONSE, TOLD_SHARE, Optimum, compared_in, require_of_model
from prbayes.response.inputs import model_on_context
from prbayes.results.likelihood_checks import Checked, check_draws, check_optimum, separate_modes

# R-hat of independent draws exceeds 1 + _NOISE / (chains x draws) about once in a thousand cases:
# the quantile was 9 to 12 with 2 to 8 chains of 25 to 500 draws, 1500 to 4000 sets of each
# (4 chains of 50 draws in tests/results/test_diagnose.py).
_NOISE = 11.0

# Draws of a chain that have to differ, where there are at least twice as many: a standard deviation
# from so many has an error of a tenth.
_ALL_DIFFERENT = 50
# Part of their size below which draws are the same: thousands of times rounding, and far below the
# width of any posterior from measured data.
_SAME_DIGITS = 1e-12

# Where the numbers behind sentences about draws are.
_IN_NUMBERS = more_in("validity.md#diagnostics-of-the-sampler")

# Where it says what NaN and +inf mean.
_ON_NAN = more_in("distributed.md#when-a-response-fails")

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
    notes : tuple of str
        By what many outputs are compared; what was not looked at, and why; and which of several
        outputs disagree.
    findings : tuple of Finding
        Those of the messages that have a code, by which they are filtered.
    untested : tuple of str
        Tests of the log-likelihood by specimen that were not run, and why.
    """

    messages: tuple[str, ...]
    support: xr.Dataset = field(repr=False)
    notes: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    untested: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.messages

    @property
    def all_clear(self) -> str:
        """What is said where nothing is wrong, by whether all tests were run."""
        if self.untested:
            return "No problem was found by the tests that were run."
        return "No problem was found."

    def __str__(self) -> str:
        return "\n".join([*(self.messages or [self.all_clear]), *self.notes, *self.untested])

    def _repr_html_(self) -> str:
        """Show the sentences in a notebook, what is wrong first."""
        remarks = (*self.notes, *self.untested)
        if self.ok:
            clear = self.all_clear.removesuffix(".")
            return view(f"Diagnosis: {clear[0].lower()}{clear[1:]}", sentences=remarks)
        count = len(self.messages)
        heading = f"Diagnosis: {count} problem{'s' if count > 1 else ''}"
        return view(heading, sentences=[*self.messages, *remarks])


@locked
def diagnose(result: xr.DataTree | Optimum, *, model: pm.Model | None = None) -> Diagnosis:
    """Say in sentences what is wrong with a result, and what to do, whichever sampler gave it.

    Looked at are: what is not identified; whether an optimiser converged; R-hat and effective
    sample size of draws, by ArviZ; how many of them differ; how far the particles of `sample_smc`
    moved in its last stage; whether the stored responses of `Reweighted` supported the answer; and,
    of optima on stored responses, whether the data can have come from the best population, by
    refits (p < .01). If they cannot, notes tell which of several outputs, and
    which correlations of two, disagree. No response is computed; what was not looked at is said.

    With the log-likelihood by specimen: a test of the family of the population of the inputs, with
    its power at this number of specimens; of draws, whether chains are in different modes, the
    conflict of prior and data, and specimens on which the posterior depends (Pareto k, where the
    result has a log-likelihood by specimen). Both tests of draws take the optimum of the
    likelihood, which is computed for them.

    Parameters
    ----------
    result : xarray.DataTree or Optimum
        With a ``posterior`` group that has the model's free variables, from `sample_smc` or any
        PyMC sampler; or the tree of an optimum.
    model : pymc.Model, optional
        The one on the context by default. Results of `sample_smc` and `minimize`, also from a file,
        tell without it.

    Returns
    -------
    Diagnosis
        ``print`` it, or look at ``ok``.

    Raises
    ------
    TypeError, KeyError
        If there is no model where one is needed, or the posterior lacks a free variable of it.
    ValueError
        If the result is of another problem than the model's.

    References
    ----------
    .. [1] Vehtari, A., A. Gelman, D. Simpson, B. Carpenter and P.-C. Buerkner (2021),
       Rank-normalization, folding, and localization: an improved R-hat, Bayesian Analysis 16(2),
       667-718, doi:10.1214/20-BA1221.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0, 2, 4])
    >>> print(prb.diagnose(prb.minimize(model)))
    No problem was found.
    """
    if not isinstance(result, Optimum):
        _refuse_other(result)
    if model is not None:
        require_of_model(result, model, "diagnose", Level.OPTIMUM)
    if isinstance(result, Optimum):
        return _of_optimum(result)
    if "optimum" in result and "posterior" not in result:
        return _of_stored_optimum(result)
    return _of_draws(result, model)


def _refuse_other(result: object) -> None:
    """Raise if a result is no tree of draws or of an optimum."""
    known = isinstance(result, xr.DataTree) and {"posterior", "optimum"} & set(result.children)
    if not known:
        raise TypeError(
            f"diagnose: result: got {type(result).__name__}, expected an Optimum from "
            "prb.minimize, or a DataTree with a posterior group, such as prb.sample_smc returns"
        )


# -- optima ----------------------------------------------------------------------------------


def _of_optimum(optimum: Optimum) -> Diagnosis:
    checked = Checked()
    if optimum.evaluator.nodes:
        family, notes = _of_family(optimum)
    else:
        checked = check_optimum(optimum)
        family, notes = [], checked.notes
    small = small_simulators(optimum.evaluator)
    messages = _sentences([*optimum.warnings, *small, *family])
    told = optimum.at_edge or optimum.stopped  # by the warnings
    if not optimum.converged and not told:
        messages.append(_not_converged(optimum.message))
    designs = _computed(optimum.evaluator, optimum.theta[None])
    lost, broken = (
        {name: each[key] for name, each in optimum.support.items()}
        for key in ("lost_mass", "failed_mass")
    )
    failed, harmless = _failed(optimum.failures, lost, broken)
    notes = (*_compared(optimum.to_datatree()), *_left_out(lost), *harmless, *notes)
    messages += _texts(checked.findings)
    return Diagnosis(
        (*messages, *failed, *_unsupported(designs)),
        designs.support,
        notes,
        checked.findings,
        checked.untested,
    )


def _texts(findings: Iterable[Finding]) -> list[str]:
    """Return findings as sentences."""
    return _sentences(map(str, findings))


def _of_family(optimum: Optimum) -> tuple[list[str], tuple[str, ...]]:
    """Say where the data are too far from the best population to have come from its family.

    Or else why that was not looked at.
    """
    evaluator = optimum.evaluator
    obstacle = refit_obstacle(evaluator)
    if not optimum.converged or optimum.at_edge or optimum.at_jump:
        return [], _not_looked_at("nothing is known of the sampling distribution of this optimum")
    if obstacle is not None:
        return [], _not_looked_at(obstacle)
    if evaluator.responses_per_theta:
        return [], _not_looked_at("it would take responses")
    if optimum.prior:
        scales = np.array(list(optimum.scales.values()))
        held = SamplingDistribution.of(evaluator, optimum.theta, scales)
        there = Refitted.there(held, SETS, 0)
        probability = there.probability
        return of_held_away(probability), _by_output(there, probability)
    refitted = Refitted.of(optimum.sampling(), SETS, 0)
    probability = np.nan if refitted is None else refitted.probability
    if refitted is None or np.isnan(probability):
        return [], _not_looked_at("the data tell too little, or too few refits converge")
    return of_another_family(probability), _by_output(refitted, probability)


def _by_output(refitted: Refitted, probability: float) -> tuple[str, ...]:
    """Say which of several outputs disagree, where the data are too far from the population."""
    return tuple(disagreement(refitted)) if probability < UNLIKELY else ()


def _compared(result: xr.DataTree) -> tuple[str, ...]:
    """Say by what outputs are compared, where it is not by themselves."""
    return compared_in(result["calibration"].to_dataset()) if "calibration" in result else ()


def _not_looked_at(reason: str) -> tuple[str, ...]:
    return (f"Whether the inputs have the right family was not looked at: {reason}.",)


def _of_stored_optimum(result: xr.DataTree) -> Diagnosis:
    attrs = result["optimum"].attrs
    messages = _warnings(attrs)
    if not attrs.get("converged", True) and not attrs.get("stopped"):
        messages.append(_not_converged(str(attrs.get("message", ""))))
    failed, harmless = _failed_in(result)
    notes = (*_compared(result), *_left_out(_lost_in(result)), *harmless)
    if _is_by_specimen(result):
        untested = (
            "The family of the population was not tested: that needs the model; pass the Optimum "
            "itself.",
        )
        return Diagnosis((*messages, *failed), xr.Dataset(), notes, untested=untested)
    refits = _not_looked_at("refits need the model; pass the Optimum itself")
    return Diagnosis((*messages, *failed), xr.Dataset(), (*notes, *refits))


def _is_by_specimen(result: xr.DataTree) -> bool:
    """Return whether all simulators of a result have the log-likelihood by specimen."""
    if "calibration" not in result or "is_likelihood" not in result["calibration"]:
        return False
    is_likelihood = result["calibration"].to_dataset()["is_likelihood"]
    return bool(is_likelihood.values.all())


def _failed_in(result: xr.DataTree) -> tuple[list[str], list[str]]:
    if "failures" not in result.children:
        return [], []
    failures = result["failures"].to_dataset()
    return _failed(failures, _lost_in(result), _lost_in(result, "failed_mass"))


def _failed(
    failures: xr.Dataset, lost: Mapping[str, float], broken: Mapping[str, float]
) -> tuple[list[str], list[str]]:
    """Say which responses failed, and why the first did: where it matters, and where it does not.

    It does not where they have next to no weight in the populations that are answered for, by the
    shares without response and of specimens that failed.
    """
    found: list[str] = []
    harmless: list[str] = []
    names = failures["simulator"].values
    for name in dict.fromkeys(names.tolist()):
        own = failures.isel(failure=np.flatnonzero(names == name))
        inputs = own["inputs"].values[0]
        at = ", ".join(f"{x:.6g}" for x in inputs[~np.isnan(inputs)])
        said = (
            f"The response of {name} failed at {own.sizes['failure']} point(s), the first at "
            f"({at}): {own['reason'].values[0]}; "
        )
        if _weight_of(own, lost.get(name, np.nan), broken.get(name, np.nan)) < TOLD_SHARE:
            harmless.append(f"{said}the populations of the answer have next to no specimens there.")
            continue
        found.append(
            f"{said}what took its place is no result. Look at optimum.failures, or the group "
            "failures of a result, and repair the response"
            f"{more_in('expensive.md#when-a-run-fails')}."
        )
    return found, harmless


def _weight_of(failures: xr.Dataset, lost: float, broken: float) -> float:
    """Return the share of an answer's populations at failures, at most; NaN if it is not known."""
    if "instead" not in failures:
        return np.nan
    # A number in its place looks like any other response.
    instead = failures["instead"].values[0]
    return lost if np.isnan(instead) else broken if np.isposinf(instead) else np.nan


def _left_out(lost: Mapping[str, float]) -> tuple[str, ...]:
    """Say which part of the populations has no response, and what that means."""
    return tuple(
        f"{name}: {share:.1%} of specimens {NO_RESPONSE}: the population compared is that of the "
        "others. A response that returns +inf counts as a specimen that failed, and "
        f"on_failure=prb.response.Abort(on_nan=True) refuses NaN{_ON_NAN}."
        for name, share in lost.items()
        if share >= TOLD_SHARE
    )


def _lost_in(result: xr.DataTree, key: str = "lost_mass") -> dict[str, float]:
    """Return the share without response by simulator, at the optimum or over the draws.

    Or that of specimens that failed.
    """
    if "calibration" not in result or key not in result["calibration"]:
        return {}
    calibration = result["calibration"].to_dataset()
    shares = calibration[key].transpose("simulator", ...).values
    rows = [row[~np.isnan(row)] for row in shares.reshape(len(shares), -1)]
    means = np.array([row.mean() if row.size else np.nan for row in rows])
    if f"{key}_at_best" in calibration:
        means = np.where(np.isnan(means), calibration[f"{key}_at_best"].values, means)
    names = calibration["simulator"].values.tolist()
    return dict(zip(names, means.tolist(), strict=True))


def _lost_by(designs: _Designs) -> dict[str, float]:
    """Return the same of draws of another sampler."""
    return {
        name: float(designs.support["lost_mass"].sel(simulator=name).mean())
        for name in designs.needs
    }


def _not_converged(message: str) -> str:
    more = more_in("choose.md#optimiser-or-sampler")
    return f"The optimiser did not converge ({message}); try another start or method{more}."


# -- draws -----------------------------------------------------------------------------------


def _of_draws(result: xr.DataTree, model: pm.Model | None) -> Diagnosis:
    posterior = result["posterior"]
    variables = posterior.to_dataset()
    evaluator, thetas = None, None
    if "calibration" in result:
        # A model that was built again has not yet the designs that these draws are of.
        designs = _stored(result["calibration"].to_dataset())
        by_specimen = _is_by_specimen(result)
        if model is not None and by_specimen:
            evaluator = Evaluator.of(model)
            thetas = _thetas(posterior, model)
    else:
        model = model_on_context(model, "prb.diagnose")
        require_of_model(result, model, "diagnose", Level.OPTIMUM)
        evaluator = Evaluator.of(model)
        thetas = _thetas(posterior, model)
        designs = _computed(evaluator, thetas)
        by_specimen = not evaluator.nodes
    if model is not None:
        variables = variables[[str(rv.name) for rv in model.free_RVs]]
    checked = Checked()
    modes: tuple[Finding, ...] = ()
    if by_specimen:
        shape = (posterior.sizes["chain"], posterior.sizes["draw"], -1)
        if thetas is not None:
            thetas = thetas.reshape(shape)
        checked = check_draws(evaluator, result, thetas)
        columns = _columns(variables)
        modes = separate_modes(np.stack(list(columns.values()), axis=-1), list(columns))
    failed, harmless = _failed_in(result)
    messages = [
        *_warnings(posterior.attrs),
        *_texts(modes),
        *_convergence(variables, in_modes=bool(modes)),
        *_copies(variables),
        *_motion(result),
        *failed,
        *_unsupported(designs),
        *_texts(checked.findings),
    ]
    lost = _lost_in(result) or _lost_by(designs)
    notes = (*_compared(result), *_left_out(lost), *harmless, *checked.notes)
    if not by_specimen:
        refits = _not_looked_at("refits need an optimum; look at prb.diagnose of prb.minimize")
        notes = (*notes, *_pseudo_posterior(posterior.attrs), *refits)
    findings = (*modes, *checked.findings)
    return Diagnosis(tuple(messages), designs.support, notes, findings, checked.untested)


def _columns(variables: xr.Dataset) -> dict[str, Floats]:
    """Return the draws of each element, (chains, draws)."""
    columns = {}
    for name, values in variables.data_vars.items():
        table = values.transpose("chain", "draw", ...).values
        flat = table.reshape(*table.shape[:2], -1)
        for j in range(flat.shape[-1]):
            columns[f"{name}[{j}]" if values.ndim > 2 else str(name)] = flat[..., j]
    return columns


def _pseudo_posterior(attrs: Mapping[Any, Any]) -> tuple[str, ...]:
    """Report that epsilon sets the width of the draws."""
    # A bootstrap has no epsilon.
    if str(attrs.get("adjustment", "none")) != "none" or "converged" in attrs:
        return ()
    return (
        "The draws are those of exp(-discrepancy / epsilon), as wide as epsilon makes them; "
        "prb.sample draws the posterior given the estimate"
        f"{more_in('choose.md#epsilon-and-the-width-of-the-posterior')}.",
    )


def _warnings(attrs: Mapping[Any, Any]) -> list[str]:
    """Return what was said when the result was made."""
    return _sentences(str(attrs.get("warnings", "")).splitlines())


def _sentences(lines: Any) -> list[str]:
    return [f"{line[0].upper()}{line[1:]}." for line in lines if line]


def _convergence(posterior: xr.Dataset, *, in_modes: bool = False) -> list[str]:
    """Say where chains disagree, and where there are too few independent draws.

    Of chains in different modes both are said already.
    """
    if in_modes:
        return []
    # ArviZ gives NaN for shorter chains.
    if posterior.sizes["draw"] < 4:
        return []
    return [*_disagreement(posterior), *_dependence(posterior)]


def _disagreement(posterior: xr.Dataset) -> list[str]:
    chains = posterior.sizes["chain"]
    draws = posterior.sizes["draw"]
    if chains == 1:
        return []
    # Recommended by Vehtari et al. (2021).
    limit = max(1.01, 1 + _NOISE / (chains * draws))
    rhats = _by_element("rhat", posterior)
    high = {name: rhat for name, rhat in rhats.items() if rhat > limit}
    if not high:
        return []
    return [
        f"R-hat is {_listed(high, '.2f')}, expected at most {limit:.2f}: the chains disagree, "
        "look at az.plot_rank(idata). "
        "Pass more draws, or with prb.sample_smc a threshold of 0.8; "
        f"if the chains sit in separate modes, state a prior that excludes one{_IN_NUMBERS}."
    ]


def _dependence(posterior: xr.Dataset) -> list[str]:
    total = posterior.sizes["chain"] * posterior.sizes["draw"]
    # Recommended by Vehtari et al. (2021), for R-hat and ESS themselves to be reliable; of few
    # draws no more than a quarter need be independent.
    needed = min(400, 0.25 * total)
    sizes = _by_element("ess", posterior)
    low = {name: size for name, size in sizes.items() if size < needed}
    if not low:
        return []
    return [
        f"The effective sample size is {_listed(low, '.0f')} of {total} draws: "
        f"too few for means and intervals. Pass more draws{_IN_NUMBERS}."
    ]


def _by_element(statistic: str, posterior: xr.Dataset) -> dict[str, float]:
    """Return a statistic of ArviZ by element, such as 'mu[1]'."""
    stats: Any = import_module("arviz_stats")  # heavy, and partly annotated
    with np.errstate(all="ignore"):  # a variable that never moves
        found = getattr(stats, statistic)(posterior)
    every = single_elements(found.data_vars)
    # Of what is the same in all draws, up to rounding, they are the chains' rounding errors.
    return {name: every[name] for name in told_elements(stacked_draws(posterior))}


def _listed(values: Mapping[str, float], form: str) -> str:
    each = [f"{value:{form}} for {name}" for name, value in values.items()]
    return ", ".join(each)


def _copies(draws: xr.Dataset) -> list[str]:
    """Say which chains have hardly any different draws."""
    counts = []
    for chain in range(draws.sizes["chain"]):
        columns = []
        for variable in draws.isel(chain=chain).transpose("draw", ...).data_vars.values():
            columns.append(variable.values.reshape(draws.sizes["draw"], -1))
        table = np.concatenate(columns, axis=1)
        size = np.abs(table).max(axis=0, initial=0.0)
        digits = np.round(table / np.where(size > 0, size, 1.0) / _SAME_DIGITS)
        counts.append(len(np.unique(digits, axis=0)))
    expected = min(_ALL_DIFFERENT, draws.sizes["draw"] // 2)
    few = [str(chain) for chain, count in enumerate(counts) if count < expected]
    if not few:
        return []
    chains = "chains" if len(few) > 1 else "chain"
    return [
        f"Of {draws.sizes['draw']} draws only {min(counts)} differ in {chains} {', '.join(few)}, "
        f"expected at least {expected}: few particles, or one, survived, and the width of the "
        "draws means nothing. Pass more draws, priors nearer to the data, or a larger epsilon"
        f"{_IN_NUMBERS}."
    ]


def _motion(result: xr.DataTree) -> list[str]:
    """Say which chains of `sample_smc` hardly moved in their last stage."""
    if "sample_stats" not in result or "stage" not in result["sample_stats"].dims:
        return []
    stats = result["sample_stats"]
    moves: Any = (stats["accept_rate"] * stats["n_steps"]).values
    # Chains have different numbers of stages: NaN from the end of a chain on.
    last = [chain[~np.isnan(chain)][-1] for chain in moves]
    # With less than one, many copies of a particle are still the same draw.
    stuck = [str(i) for i, moved in enumerate(last) if moved < 1]
    if not stuck:
        return []
    chains = "chains" if len(stuck) > 1 else "chain"
    calibration = result["calibration"]
    noise = float((calibration["discrepancy_error"] / calibration["epsilon"]).max())  # or NaN
    why = f" (its Monte Carlo error is {noise:.1f} epsilon)" if noise > 1 else ""
    cure = "Pass more draws, or a threshold of 0.8"
    if result["posterior"].attrs.get("sampler") == "SMC-ABC":
        cure = (
            f"The discrepancy is too noisy{why}, or epsilon too small: use prb.Reweighted or "
            "prb.Resimulated instead of prb.Fresh, or pass a larger n or epsilon"
        )
    return [
        f"Particles hardly moved in the last stage of {chains} {', '.join(stuck)} "
        f"({min(last):.2f} accepted steps per particle, expected at least 1), "
        f"so that many draws are the same. {cure}{_IN_NUMBERS}."
    ]


def _thetas(posterior: Any, model: pm.Model) -> Floats:
    """Return the draws as thetas, shape (chains x draws, d)."""
    names = [rv.name for rv in model.free_RVs]
    missing = [name for name in names if name not in posterior]
    if missing:
        raise KeyError(f"posterior: got no {missing}, expected the model's free variables {names}")
    draws = finite_draws(posterior, names)
    return Evaluator.of(model).hyperparameters.thetas_of(list(draws.values()))


# -- designs ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Needs:
    """What a design is asked for."""

    weight_ess: float
    max_lost: float
    n_points: int


@dataclass(frozen=True, eq=False)
class _Designs:
    """How designs support the populations of a result, and what they are asked for."""

    support: xr.Dataset  # with the dimensions simulator and sample
    needs: dict[str, _Needs]  # by simulator


def _computed(evaluator: Evaluator, thetas: Floats) -> _Designs:
    """Return the support of the designs as they are now."""
    needs = {}
    for name, design in evaluator.designs.items():
        needs[name] = _Needs(design.required_ess, design.config.max_lost, design.n_points)
    by_simulator = evaluator.support(thetas)
    names = list(by_simulator)
    stacked = {}
    for key in _SUPPORT:
        stacked[key] = np.array([by_simulator[name][key] for name in names])
    return _Designs(_labelled(stacked, names), needs)


def _stored(calibration: xr.Dataset) -> _Designs:
    """Return the support of the designs as it was when the sampler ran."""
    has_design = ~np.isnan(calibration["required_ess"].values)
    calibration = calibration.isel(simulator=np.flatnonzero(has_design))
    names = list(map(str, calibration["simulator"].values.tolist()))
    needs = {}
    for name in names:
        own = calibration.sel(simulator=name)
        ess = float(own["required_ess"])
        max_lost = float(own["max_lost"])
        needs[name] = _Needs(ess, max_lost, int(own["n_points"]))
    stacked = {}
    for key in _SUPPORT:
        values = calibration[key].transpose("simulator", "chain", "draw").values
        stacked[key] = values.reshape(
            len(names), calibration.sizes["chain"] * calibration.sizes["draw"]
        )
    return _Designs(_labelled(stacked, names), needs)


def _labelled(support: Mapping[str, Floats], names: list[str]) -> xr.Dataset:
    variables = {}
    if names:
        variables = {key: (["simulator", "sample"], values) for key, values in support.items()}
    return xr.Dataset(variables, coords={"simulator": names})


def _unsupported(designs: _Designs) -> list[str]:
    """Say which designs fall short."""
    messages = []
    for name, needs in designs.needs.items():
        own = {key: designs.support[key].sel(simulator=name).values for key in _SUPPORT}
        lacking = shortcoming(own, needs.weight_ess, needs.max_lost, needs.n_points, ENOUGH)
        if lacking.lost is not None:
            # More points would have no more responses.
            messages.append(
                f"{name}: the design does not support the answer: {lacking}. Repair the response "
                "there, return +inf for specimens that fail, narrow the priors, or raise max_lost"
                f"{_ON_NAN}."
            )
        elif lacking:
            messages.append(
                f"{name}: the design does not support the answer: {lacking}. "
                "Call prb.refine(model) and sample again, or use prb.Resimulated"
                f"{more_in('choose.md#the-propagation')}."
            )
    return messages
