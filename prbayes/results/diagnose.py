"""Diagnosis of a result: convergence of the sampler or optimiser, and coverage of the designs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._display import View, view, without_constructor
from prbayes._finding import Finding, Findings, counted, from_json
from prbayes._stats import positive_scale
from prbayes._validate import Floats, NamedArrays, Names, wrong_type
from prbayes.inference.checks.metric_suitability import refit_bias, small_simulators
from prbayes.inference.checks.population import lost_mass_shift
from prbayes.inference.goodness_of_fit import (
    UNLIKELY,
    FittedSets,
    output_misfits,
    population_misfit,
    rounding,
    unpredicted_failures,
)
from prbayes.inference.refits import SamplingDistribution, is_stored, refit_obstacle
from prbayes.inference.resampling import SETS
from prbayes.model.evaluator import ENOUGH, Evaluator, shortcoming
from prbayes.model.fingerprint import Level
from prbayes.model.locking import locked
from prbayes.model.parameters import (
    single_elements,
    split_elements,
    stacked_draws,
    table_elements,
)
from prbayes.optimize.design_refinement import rough_emulators
from prbayes.optimize.maximum_likelihood import specimen_refit_obstacle
from prbayes.optimize.minimize import find_optimum
from prbayes.optimize.objective import Minimisation
from prbayes.optimize.optimum import (
    NO_RESPONSE,
    SMALLEST_SHARE,
    Optimum,
    compared_in,
    identity_in,
    refuse_model,
    require_of_model,
)
from prbayes.response.inputs import model_on_context
from prbayes.results.likelihood_checks import (
    Checked,
    check_conflict,
    check_draws,
    check_population,
    check_simulators,
    emulator_remarks,
    separate_modes,
)
from prbayes.results.predict import RESULT, thetas_of, width_of_epsilon
from prbayes.results.products import (
    ProductResults,
    each_product,
    findings_of_calibration,
    findings_together,
    model_of_product,
    one_posterior,
)

# noise of R-hat: with independent draws it exceeds 1 + _NOISE / (chains x draws) about once in a
# thousand cases; the quantile was 9 to 12 with 2 to 8 chains of 25 to 500 draws, from 1500 to 4000
# sets of each
_NOISE = 11.0
_NEEDS_MODEL = (
    "The family of the population was not tested: that needs the model; pass the Optimum itself."
)
_SUPPORT = ("weight_ess", "mean_weight", "lost_mass")


@without_constructor
@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis:
    """The result of `diagnose`.

    Attributes
    ----------
    findings : tuple of Finding
        What is wrong and what to do, each with a code by which it is filtered; empty when nothing
        is wrong.
    support : xarray.Dataset
        ``weight_ess``, ``mean_weight`` and ``lost_mass`` by simulator and draw, for `Reweighted`.
    remarks : tuple of Finding
        How many outputs are compared; what was not tested, and why; which of several outputs
        misfit.
    untested : tuple of str
        Tests of the log-likelihood by specimen that were not run, and why.
    products : mapping of Diagnosis
        Of a fleet, by product; its findings then have the names of the products.

    Examples
    --------
    >>> import pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> [finding.code for finding in prb.diagnose(prb.minimize(model)).findings]
    ['few-specimens']
    """

    findings: Findings
    support: xr.Dataset = field(repr=False)
    remarks: Findings = ()
    untested: Names = ()
    products: Mapping[str, Diagnosis] = field(default_factory=dict)

    @classmethod
    def of_products(cls, parts: ProductResults[Diagnosis]) -> Diagnosis:
        """Return the diagnoses of products as one."""
        results = parts.results
        findings = parts.findings(lambda part: part.findings)
        remarks = {name: part.remarks for name, part in results.items()}
        none = Diagnosis((), xr.Dataset())
        return cls(
            findings_together(findings),
            xr.Dataset(),
            findings_together(remarks),
            tuple(dict.fromkeys(text for part in results.values() for text in part.untested)),
            {
                name: replace(results.get(name, none), findings=findings[name])
                for name in parts.names
            },
        )

    @property
    def messages(self) -> tuple[str, ...]:
        """The findings as sentences."""
        return tuple(map(str, self.findings))

    @property
    def notes(self) -> tuple[str, ...]:
        """The remarks as sentences."""
        return tuple(map(str, self.remarks))

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.findings

    @property
    def all_clear(self) -> str:
        """The sentence for a result without findings, by whether all tests were run."""
        if self.untested or any(r.code == "population-not-tested" for r in self.remarks):
            return "No problem was found by the tests that were run."
        return "No problem was found."

    def __repr__(self) -> str:
        lines = [*(self.messages or [self.all_clear]), *self.notes, *self.untested]
        if not self.products:
            return "\n".join(lines)
        order = sorted(self.products, key=lambda name: -len(self.products[name].findings))
        rows = [[name, ", ".join(f.code for f in self.products[name].findings)] for name in order]
        n_bad = sum(not part.ok for part in self.products.values())
        heading = f"Diagnosis of {counted(len(rows), 'product')}, {n_bad} with problems"
        return str(View(heading, ["", "problems"], rows, lines))

    def to_dataframe(self) -> Any:
        """Return a row for each finding and remark: its code, kind and text."""
        import pandas as pd

        if self.products:
            parts = {name: part.to_dataframe() for name, part in self.products.items()}
            return pd.concat(parts, names=["product", None]).reset_index("product")
        rows = [("finding", f.code, f.text) for f in self.findings]
        rows += [("remark", f.code, f.text) for f in self.remarks]
        return pd.DataFrame(rows, columns=["kind", "code", "text"])

    def _repr_html_(self) -> str:
        """Show a table of the findings and remarks in a notebook, and what was not tested."""
        heading = f"Diagnosis: {counted(len(self.findings), 'problem')}"
        if self.ok:
            clear = self.all_clear.removesuffix(".")
            heading = f"Diagnosis: {clear[0].lower()}{clear[1:]}"
        rows = [(f.code, "problem", str(f)) for f in self.findings]
        rows += [(f.code, "remark", str(f)) for f in self.remarks]
        header = ("code", "kind", "text")
        return view(heading, header=header, rows=rows, sentences=self.untested, align="left")


@locked
@each_product
def diagnose(result: xr.DataTree | Optimum, *, model: pm.Model | None = None) -> Diagnosis:
    """Report in sentences what is wrong with a result of any sampler or optimiser, and what to do.

    Findings are about identification, the convergence of an optimiser, and the support of the
    answer by the stored responses of `Reweighted`. For draws they are about R-hat and effective
    sample size (by ArviZ), equal draws, and moves of `sample_smc` in its last stage. Optima on
    stored responses are refitted: can the data come from the best population (p < .01)? Remarks
    name the outputs, and the correlations of two outputs, that misfit, and tests that were not run.
    Responses are computed for the test under `Resimulated`, if they take less than half a minute.

    With the log-likelihood by specimen, the family of the population of the inputs is tested
    (p <= .025; up to .05 a misfit is a remark). For draws it reports chains in different modes,
    conflicts of prior and data, and specimens on which the posterior depends (Pareto k). The
    optimum that these need is computed.

    Parameters
    ----------
    result : xarray.DataTree or Optimum
        With a ``posterior`` group that has the model's free variables, from `sample_smc` or any
        PyMC sampler; a fleet from `calibrate_each`; or the tree of an optimum.
    model : pymc.Model, optional
        The one on the context by default. Results of `sample_smc` and `minimize`, also from a file,
        do not need it.

    Returns
    -------
    Diagnosis
        ``print`` it, or look at ``ok`` and ``findings``.

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
    ...     data = [-3.0, -2.0, -1.0, -0.3, 0.3, 1.0, 2.0, 3.0]
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=data)
    >>> print(prb.diagnose(prb.minimize(model)))
    No problem was found.
    """
    refuse_model(result, "diagnose: result")
    result = one_posterior(result, "diagnose")
    optimum = result if isinstance(result, Optimum) else None
    tree = _checked_tree(result)
    has_draws = "posterior" in tree.children
    calibration = xr.Dataset()
    if "calibration" in tree.children:
        calibration = tree["calibration"].to_dataset()
    if has_draws and (not calibration or pm.Model.get_context(error_if_none=False)):
        model = model_on_context(model, "prb.diagnose")
    if model is not None:
        require_of_model(result, model, "diagnose", Level.OPTIMUM)
        model = model_of_product(result, model)
    by_specimen = "is_likelihood" in calibration and bool(calibration["is_likelihood"].all())
    evaluator = None if optimum is None else optimum.evaluator
    thetas = None if optimum is None else optimum.theta[None]
    # The tree of a sampler of this package has the support of its draws. A model that was built
    # again has other designs, and would not reproduce it.
    if has_draws and model is not None and (by_specimen or not calibration):
        evaluator = Evaluator.of(model)
        by_specimen = not evaluator.nodes
        every_draw = tree["posterior"].sizes["chain"] * tree["posterior"].sizes["draw"]
        thetas = thetas_of(tree, evaluator, every_draw, "prb.diagnose")
    coverage = {}
    if has_draws and calibration:
        coverage = _stored_coverage(calibration)
    elif evaluator is not None and thetas is not None:
        coverage = _computed_coverage(evaluator, thetas)
    attrs = tree["posterior" if has_draws else "optimum"].attrs
    findings = _earlier_findings(result, attrs)
    if has_draws:
        checked = _check_sampler(tree, model, by_specimen=by_specimen)
        reason = "refits need an optimum; look at prb.diagnose of prb.minimize"
    else:
        checked = _check_convergence(attrs, findings)
        reason = "refits need the model; pass the Optimum itself"
    if not by_specimen:
        checked += _not_tested(reason) if optimum is None else _check_family(optimum)
    elif optimum is not None:
        checked += emulator_remarks(optimum.evaluator) + check_population(optimum)
    elif has_draws:
        checked += check_draws(evaluator, tree, thetas)
        if (
            evaluator is not None
            and thetas is not None
            and specimen_refit_obstacle(evaluator) is None
        ):
            maximum = find_optimum(evaluator, Minimisation())
            checked += check_population(maximum) + check_conflict(maximum, thetas)
    else:
        checked += Checked(untested=(_NEEDS_MODEL,))
    if evaluator is not None:
        checked += check_simulators(evaluator)
    lost = _stored_shares(calibration, "lost_mass") or {
        name: float(support["lost_mass"].mean()) for name, (support, _) in coverage.items()
    }
    failures, harmless = _failure_findings(tree, calibration, lost)
    compared = [Finding("outputs-compared", sentence) for sentence in compared_in(calibration)]
    compared += [] if optimum is None else rough_emulators(optimum.evaluator)
    later = (*checked.findings, *failures, *_lost_mass(optimum, lost), *_unsupported(coverage))
    return Diagnosis(
        _each_once(findings, later),
        _as_dataset(coverage),
        (*compared, *_specimens_left_out(lost), *harmless, *checked.remarks),
        checked.untested,
    )


def _earlier_findings(result: object, attrs: Mapping[Any, Any]) -> Findings:
    """Return the findings of the run that made a result, or of the calibration of a product."""
    of_product = findings_of_calibration(result).values()
    of_run = from_json(str(attrs.get("findings", "[]")))
    return (*of_run, *(finding for findings in of_product for finding in findings))


def _checked_tree(result: object, fewest: int = 2) -> xr.DataTree:
    """Return a result as a tree; raise for chains of one draw, which have no autocorrelation."""
    tree = result.to_datatree() if isinstance(result, Optimum) else result
    if not isinstance(tree, xr.DataTree) or not {"posterior", "optimum"} & set(tree.children):
        raise wrong_type(result, "diagnose: result", RESULT)
    identity_in(tree)  # raises for a file of another format
    n = tree["posterior"].sizes["draw"] if "posterior" in tree.children else fewest
    if n < fewest:
        raise ValueError(
            f"diagnose: result: got {counted(n, 'draw')} of each chain, expected at least "
            f"{fewest}; pass the result with all draws"
        )
    return tree


def _each_once(earlier: Sequence[Finding], later: Sequence[Finding]) -> Findings:
    """Return findings without copies, and no later ones on a condition reported earlier.

    Two findings are about the same condition if they have the same code, and the same simulator
    before the colon.
    """

    def condition(finding: Finding) -> tuple[str, str]:
        return finding.code, finding.text.partition(":")[0]

    reported = {condition(finding) for finding in earlier}
    others = (finding for finding in later if condition(finding) not in reported)
    return tuple(dict.fromkeys([*earlier, *others]))


# -- optima ----------------------------------------------------------------------------------


def _check_convergence(attrs: Mapping[Any, Any], findings: Sequence[Finding]) -> Checked:
    """Report an optimiser that did not converge, unless a finding explains it."""
    is_at_edge = any(finding.code == "flat-edge" for finding in findings)
    if attrs.get("converged", True) or attrs.get("stopped") or is_at_edge:
        return Checked()
    reason = str(attrs.get("message", "")).removesuffix(".")
    text = f"The optimiser did not converge ({reason}); try another start or method."
    return Checked((Finding("not-converged", text, "choose.md#optimiser-or-sampler"),))


def _not_tested(reason: str) -> Checked:
    text = f"The family of the inputs was not tested: {reason}."
    return Checked(remarks=(Finding("population-not-tested", text),))


def _check_family(optimum: Optimum) -> Checked:
    """Test whether the data can come from the best population, or report why it was not tested."""
    evaluator = optimum.evaluator
    failures = unpredicted_failures(evaluator, optimum.theta) if is_stored(evaluator) else []
    obstacle = refit_obstacle(evaluator)
    if optimum.search.at_edge or optimum.search.at_jump:
        obstacle = "at an edge or a jump the optimum has no sampling distribution"
    elif not optimum.converged:
        obstacle = "the optimum did not converge; pass another start= or method= to prb.minimize"
    elif obstacle is None and seconds_of(optimum, SETS) > 30:
        obstacle = f"it would take {SETS * evaluator.responses_per_theta} responses"
    if obstacle is not None:
        return Checked((*small_simulators(evaluator), *failures)) + _not_tested(obstacle)
    fitted: FittedSets | None
    if optimum.search.prior:
        scales = np.array(list(optimum.scales.values()))
        sampling = SamplingDistribution.of(evaluator, optimum.theta, scales)
        fitted = FittedSets.at_theta(sampling, SETS, 0)
    else:
        fitted = FittedSets.of(optimum.sampling(), SETS, 0)
    p_value = np.nan if fitted is None else fitted.p_value
    if fitted is None or np.isnan(p_value):
        checked = Checked((*small_simulators(evaluator), *failures))
        return checked + _not_tested("the data are uninformative, or too few refits converge")
    misfits: Findings = ()
    ties, p_spread_out = "", np.nan
    if p_value < UNLIKELY:
        ties = rounding(evaluator)
        exact = fitted.without_rounding() if ties else None
        if exact is not None:
            p_spread_out = exact.p_value
        if not p_spread_out >= UNLIKELY and is_stored(evaluator):
            misfits = tuple(output_misfits(fitted))
    misfit = population_misfit(
        p_value, with_prior=optimum.search.prior, ties=ties, p_spread_out=p_spread_out
    )
    biases = [*small_simulators(evaluator), *failures]
    if is_stored(evaluator):
        biases += refit_bias(fitted)
    return Checked((*biases, *misfit), misfits)


def seconds_of(optimum: Optimum, populations: int) -> float:
    """Return an upper bound of the time for the responses of some populations, in seconds."""
    seconds_each = optimum.search.seconds / max(optimum.n_responses, 1)
    return populations * optimum.evaluator.responses_per_theta * seconds_each


# -- responses -------------------------------------------------------------------------------


def _stored_shares(calibration: xr.Dataset, key: str) -> dict[str, float]:
    """Return the share of specimens that have no response, or that fail, by simulator.

    It is the share at the optimum, or the mean over the draws. Simulators for which it is unknown
    are left out.
    """
    if key not in calibration:
        return {}
    shares = calibration[key]
    means = shares.mean([dim for dim in shares.dims if dim != "simulator"])
    if f"{key}_at_best" in calibration:
        means = means.fillna(calibration[f"{key}_at_best"])
    by_simulator = zip(calibration["simulator"].values.tolist(), means.values.tolist(), strict=True)
    return {name: share for name, share in by_simulator if not np.isnan(share)}


def _failure_findings(
    tree: xr.DataTree, calibration: xr.Dataset, lost: Mapping[str, float]
) -> tuple[list[Finding], list[Finding]]:
    """Return findings about failed responses that matter to the answer, and harmless ones."""
    findings: list[Finding] = []
    harmless: list[Finding] = []
    if "failures" not in tree.children:
        return findings, harmless
    failures = tree["failures"].to_dataset()
    # Only the log-likelihood by specimen stores this share.
    failing = _stored_shares(calibration, "failing_share")
    names = failures["simulator"].values
    for name in dict.fromkeys(names.tolist()):
        rows = failures.isel(failure=np.flatnonzero(names == name))
        inputs = rows["inputs"].values[0]
        point = ", ".join(f"{x:.6g}" for x in inputs[~np.isnan(inputs)])
        text = (
            f"{name}: the response failed at {counted(rows.sizes['failure'], 'point')}, the first "
            f"at ({point}): {rows['reason'].values[0]}; "
        )
        replacement = rows["instead"].values[0]
        share = np.nan  # Finite replacements look like other responses: their share is unknown.
        if np.isnan(replacement):
            share = {**lost, **failing}.get(name, np.nan)
        elif np.isposinf(replacement):
            share = (_stored_shares(calibration, "failed_mass") | failing).get(name, np.nan)
        if share < SMALLEST_SHARE:
            text += "the calibrated populations have next to no specimens there."
            harmless.append(Finding("harmless-failures", text))
            continue
        text += (
            "the replaced values are not results. Look at optimum.failures, or the group failures "
            "of a result, and repair the response."
        )
        page = "expensive.md#when-a-run-fails"
        findings.append(Finding("failed-responses", text, page))
    return findings, harmless


def _specimens_left_out(lost: Mapping[str, float]) -> list[Finding]:
    """Report the share of the populations without response, and its consequence."""
    page = "distributed.md#when-a-response-fails"
    return [
        Finding(
            "specimens-left-out",
            f"{name}: {share:.1%} of specimens {NO_RESPONSE}: the population compared is that of "
            "the others. A response that returns +inf counts as a specimen that failed, and "
            "on_failure=prb.response.Abort(on_nan=True) refuses NaN.",
            page,
        )
        for name, share in lost.items()
        if share >= SMALLEST_SHARE
    ]


def _lost_mass(optimum: Optimum | None, lost: Mapping[str, float]) -> list[Finding]:
    """Report an optimum that depends on whether specimens without response count."""
    is_small = all(share < SMALLEST_SHARE for share in lost.values())
    if optimum is None or is_small or optimum.evaluator.responses_per_theta:
        return []
    evaluator = optimum.evaluator
    scales = np.array(list(optimum.scales.values()))
    stderr = np.sqrt(np.diag(optimum.covariance))
    shift = lost_mass_shift(evaluator, optimum.theta, scales, stderr)
    far = np.flatnonzero(np.abs(shift) > 0.5)
    if not far.size:
        return []
    names = evaluator.hyperparameters.readable_names
    shifts = ", ".join(f"{names[i]} by {shift[i]:+.1f}" for i in far)
    text = (
        "Specimens without response (NaN) matter: if they counted as far from the data, the "
        f"optimum would move {shifts} standard errors. The optimum is right if such specimens "
        "cannot be measured; otherwise repair the response there, or return +inf for specimens "
        "that fail (of minus the response and minus the data, if they fail at the low end)."
    )
    return [Finding("lost-mass-matters", text, "distributed.md#when-a-response-fails")]


# -- draws -----------------------------------------------------------------------------------


def _check_sampler(tree: xr.DataTree, model: pm.Model | None, *, by_specimen: bool) -> Checked:
    """Report chains that disagree, dependent or repeated draws, and particles that are stuck."""
    posterior = tree["posterior"]
    variables = posterior.to_dataset()
    if model is not None:
        variables = variables[[str(rv.name) for rv in model.free_RVs]]
    elements = split_elements(stacked_draws(variables))
    sizes = posterior.sizes["chain"], posterior.sizes["draw"]
    draws = np.stack([x.reshape(sizes) for x in elements.values()], axis=-1)
    modes = separate_modes(draws, list(elements)) if by_specimen else ()
    findings = list(modes)
    # Chains in different modes have a large R-hat anyway. For fewer draws ArviZ returns NaN.
    if not modes and posterior.sizes["draw"] >= 4:
        findings += _convergence(variables)
    findings += [*_repeated_draws(draws), *_particles_stuck(tree), *width_of_epsilon(tree, model)]
    return Checked(tuple(findings), _divergences(tree))


def _divergences(tree: xr.DataTree) -> Findings:
    """Remark on divergent transitions of NUTS after tuning."""
    stats = tree["sample_stats"].to_dataset() if "sample_stats" in tree else {}
    diverging = stats["diverging"] if "diverging" in stats else np.zeros(1)
    n = int(diverging.sum())
    text = (
        f"{n} of {diverging.size} transitions of NUTS diverged: the draws may lack a part of the "
        "posterior. Raise target_accept= of pm.sample, or compare with prb.sample_smc."
    )
    page = "validity.md#diagnostics-of-the-sampler"
    return (Finding("divergent-transitions", text, page),) if n else ()


def _convergence(posterior: xr.Dataset) -> list[Finding]:
    """Report large R-hat and small effective sample sizes (Vehtari et al. 2021)."""
    chains, draws = posterior.sizes["chain"], posterior.sizes["draw"]
    page = "validity.md#diagnostics-of-the-sampler"
    findings = []
    limit = max(1.01, 1 + _NOISE / (chains * draws))
    rhats = _by_element("rhat", posterior) if chains > 1 else {}
    large = [f"{rhat:.2f} for {name}" for name, rhat in rhats.items() if rhat > limit]
    if large:
        text = (
            f"R-hat is {', '.join(large)}, expected at most {limit:.2f}: the chains disagree, look "
            "at az.plot_rank(idata). Pass more draws, or with prb.sample_smc a threshold of 0.8; "
            "if the chains are in separate modes, state a prior that excludes one."
        )
        findings.append(Finding("chains-disagree", text, page))
    total = chains * draws
    # With 400 effective draws R-hat and ESS are reliable. Of few draws a quarter is accepted.
    needed = min(400, 0.25 * total)
    sizes = _by_element("ess", posterior)
    small = [f"{size:.0f} for {name}" for name, size in sizes.items() if size < needed]
    if small:
        text = (
            f"The effective sample size is {', '.join(small)} of {total} draws: too few for means "
            "and intervals. Pass more draws."
        )
        findings.append(Finding("few-independent-draws", text, page))
    return findings


def _by_element(statistic: str, posterior: xr.Dataset) -> dict[str, float]:
    """Return a statistic of ArviZ by element, such as 'mu[1]', without those that never vary."""
    stats = import_module("arviz_stats")  # heavy, and partly annotated
    with np.errstate(all="ignore"):  # A variable may never move.
        values = getattr(stats, statistic)(posterior)
    elements = single_elements(values.data_vars)
    return {name: elements[name] for name in table_elements(stacked_draws(posterior))}


def _repeated_draws(draws: Floats) -> list[Finding]:
    """Report chains with hardly any different draws, (chains, draws, d)."""
    n_draws = draws.shape[1]
    counts = []
    for table in draws:
        size = np.abs(table).max(axis=0, initial=0.0)
        # Draws are equal if they differ by rounding alone; posteriors are far wider than that.
        digits = np.round(table / positive_scale(size) / 1e-12)
        counts.append(len(np.unique(digits, axis=0)))
    # A standard deviation from 50 different draws has an error of a tenth.
    expected = min(50, n_draws // 2)
    few = [str(chain) for chain, count in enumerate(counts) if count < expected]
    if not few:
        return []
    chains = "chains" if len(few) > 1 else "chain"
    text = (
        f"Of {n_draws} draws only {min(counts)} differ in {chains} {', '.join(few)}, "
        f"expected at least {expected}: few particles, or one, survived, and the width of the "
        "draws is meaningless. Pass more draws, priors nearer to the data, or a larger epsilon."
    )
    return [Finding("repeated-draws", text, "validity.md#diagnostics-of-the-sampler")]


def _particles_stuck(result: xr.DataTree) -> list[Finding]:
    """Report chains of `sample_smc` that hardly moved in their last stage."""
    if "sample_stats" not in result or "stage" not in result["sample_stats"].dims:
        return []
    stats = result["sample_stats"]
    moves: Any = (stats["accept_rate"] * stats["n_steps"]).values
    # Chains have different numbers of stages; their rows are filled up with NaN.
    last = [chain[~np.isnan(chain)][-1] for chain in moves]
    # If a particle moves less than once on average, many of its copies are still the same draw.
    stuck = [str(i) for i, moved in enumerate(last) if moved < 1]
    if not stuck:
        return []
    chains = "chains" if len(stuck) > 1 else "chain"
    calibration = result["calibration"]
    # The ratio is NaN if the Monte Carlo error is unknown.
    noise = float((calibration["discrepancy_error"] / calibration["epsilon"]).max())
    reason = f" (its Monte Carlo error is {noise:.1f} epsilon)" if noise > 1 else ""
    cure = "Pass more draws, or a threshold of 0.8"
    if result["posterior"].attrs.get("sampler") == "SMC-ABC":
        cure = (
            f"The discrepancy is too noisy{reason}, or epsilon too small: use prb.Reweighted or "
            "prb.Resimulated instead of prb.Fresh, or pass a larger n or epsilon"
        )
    text = (
        f"Particles hardly moved in the last stage of {chains} {', '.join(stuck)} ({min(last):.2f} "
        "accepted steps per particle, expected at least 1), so that many draws are the same. "
        f"{cure}."
    )
    return [Finding("particles-stuck", text, "validity.md#diagnostics-of-the-sampler")]


# -- designs ---------------------------------------------------------------------------------

# support of the populations of a result by each design, arrays of one shape, and what the design
# requires: weight ESS, largest lost mass and number of points; by simulator
_Coverage = dict[str, tuple[NamedArrays, tuple[float, float, int]]]


def _computed_coverage(evaluator: Evaluator, thetas: Floats) -> _Coverage:
    """Return the coverage by the designs as they are now."""
    support = evaluator.support(thetas)
    return {
        name: (support[name], (bound.required_ess, bound.max_lost, bound.n_points))
        for name, bound in evaluator.reweighted.items()
    }


def _stored_coverage(calibration: xr.Dataset) -> _Coverage:
    """Return the coverage by the designs when the sampler ran."""
    coverage = {}
    for k, name in enumerate(map(str, calibration["simulator"].values.tolist())):
        row = calibration.isel(simulator=k)
        if not np.isnan(row["required_ess"]):
            ess, lost, n = (float(row[key]) for key in ("required_ess", "max_lost", "n_points"))
            support = {key: row[key].transpose("chain", "draw").values.ravel() for key in _SUPPORT}
            coverage[name] = (support, (ess, lost, int(n)))
    return coverage


def _as_dataset(coverage: _Coverage) -> xr.Dataset:
    """Return the support of the populations with the dimensions simulator and sample."""
    variables = {}
    if coverage:
        for key in _SUPPORT:
            values = np.array([support[key] for support, _ in coverage.values()])
            variables[key] = (["simulator", "sample"], values)
    return xr.Dataset(variables, coords={"simulator": list(coverage)})


def _unsupported(coverage: _Coverage) -> list[Finding]:
    """Report designs that do not support the answer."""
    findings = []
    for name, (support, needs) in coverage.items():
        lacking = shortcoming(support, *needs, ENOUGH)
        if not lacking:
            continue
        text = f"{name}: the design does not support the answer: {lacking}. "
        if lacking.is_lost:
            # Further points would not have responses either.
            text += (
                "Repair the response there, return +inf for specimens that fail, narrow the "
                "priors, or raise max_lost."
            )
            findings.append(Finding("lost-mass", text, "distributed.md#when-a-response-fails"))
        else:
            text += "Call prb.refine(model) and sample again, or use prb.Resimulated."
            findings.append(Finding("design-support", text, "choose.md#the-propagation"))
    return findings
