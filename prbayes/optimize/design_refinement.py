"""Refinement of the designs of `Reweighted`: points where the populations in question are."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.asymptotics import Information, oriented
from prbayes.inference.checks.identification import unidentified_names
from prbayes.inference.design_error import DesignErrors, design_error
from prbayes.inference.refits import SamplingDistribution, sampling_obstacle
from prbayes.inference.resampling import families, siblings
from prbayes.model.evaluator import (
    Evaluator,
    Shortcoming,
    have_emulated_points,
    n_design_runs,
    shortcomings,
)
from prbayes.model.parameters import THETAS, in_support
from prbayes.model.remedies import accepts
from prbayes.optimize.convergence import (
    OVERLAP,
    OVERLAP_ENOUGH,
    AreaGuide,
    Fit,
    Search,
    approach,
    best_or_nearest,
    stored_overlap,
)
from prbayes.optimize.objective import Ridge
from prbayes.propagation.base import DesignError, refuse_lost_share, valid_parents
from prbayes.propagation.importance import SIZES
from prbayes.propagation.resimulated import Resimulated
from prbayes.propagation.reweighted import designs_restored

_log = logging.getLogger("prbayes")
# Number of batches of runs after which a design is refused
MAX_ROUNDS = 8
# Share of the allowed error for points, and for emulators: both together are the whole
_SHARE = np.sqrt(0.5)
# Largest difference between optima of independent designs, in standard errors. A tenth adds half a
# percent to the width of an interval.
AGREE = 0.1
# Error of an emulator, in standard deviations of the response, above which more runs are made
_POOR_EMULATOR = 0.25
# Number of data sets for noise floors that only end a pilot or compare optima
FEW_SETS = 50


@dataclass(frozen=True, eq=False)
class Restart:
    """Start of the next minimisation, on designs that have grown."""

    theta: Floats  # (d,)
    pilot: Floats | None
    ridge: Ridge | None
    alternative: Floats | None = None  # (d,): an earlier minimum, which may be better


def refine_designs(
    search: Search, fit: Fit, round_: int, advance: Callable[[int, str], None]
) -> tuple[Fit, Restart | None]:
    """Add points where designs are too small for a fit; return it with the design's error.

    The restart is None if nothing was added. Raises DesignError if designs still do not support
    the fit after the last round.
    """
    evaluator = search.evaluator
    if not evaluator.reweighted:
        return fit, None
    nearby = neighbourhood(evaluator, fit, search.settings.random_seed)
    short = shortcomings(evaluator, nearby) or shortcomings(evaluator, fit.theta[None])
    if short and round_ == MAX_ROUNDS:
        # Name directions that are not identified, because a minimiser follows them beyond any
        # design.
        names = []
        if fit.sampling is not None:
            names = unidentified_names(evaluator, fit.sampling.local)
        refuse(short, evaluator, names)
    if short:
        return fit, _cover(search, fit, nearby)
    overlap = stored_overlap(evaluator, fit.theta)
    is_apart = overlap < OVERLAP
    if round_ < MAX_ROUNDS and overlap < OVERLAP_ENOUGH:
        # The design supports this point, but the fit is poor: continue along the area metric.
        theta, _ = approach(search, fit.theta, fit.scales, fit.trace, OVERLAP_ENOUGH)
        if refine_at(evaluator, theta[None]):
            alternative = None if is_apart else fit.theta
            return fit, Restart(theta, fit.pilot, fit.ridge, alternative)
    if is_apart or fit.sampling is None:
        return fit, None
    errors = design_error(fit.sampling)
    fit = replace(fit, design_error=errors.whole)
    if not errors.whole > AGREE:
        return fit, None
    previous = n_design_runs(evaluator)
    if not grow(evaluator, nearby, errors):
        return fit, None
    note = f"error {errors.whole:.2f} standard errors, {AGREE} are wanted"
    advance(n_design_runs(evaluator) - previous, note)
    # The fit may be an artefact of the smaller design.
    theta = best_or_nearest(search, np.vstack([fit.theta, nearby]), fit.scales)
    return fit, Restart(theta, fit.pilot, fit.ridge)


def neighbourhood(evaluator: Evaluator, fit: Fit, seed: int) -> Floats:
    """Return thetas around a fit that designs have to support, (m, d).

    They are those of the pilot, unless emulated samples can follow the fit anywhere, or a ridge
    penalises unidentified directions: then they are normal with the covariance of the fit, no wider
    than the prior.
    """
    hyperparameters = evaluator.hyperparameters
    prior_sd = hyperparameters.prior_sd
    local = None if fit.sampling is None else fit.sampling.local
    if fit.ridge is not None and local is not None:
        variances, vectors = np.linalg.eigh(local.covariance)
        axes = local.identified @ vectors
    elif fit.pilot is None or (local is not None and have_emulated_points(evaluator)):
        # Take the prior's variance for elements whose variance is not known.
        covariance = fit.covariance
        is_finite = np.isfinite(covariance)
        relative = np.where(is_finite, covariance / np.outer(prior_sd, prior_sd), 0.0)
        np.fill_diagonal(relative, np.where(np.diag(is_finite), np.diag(relative), 1.0))
        variances, axes = np.linalg.eigh(relative)
    else:
        return np.asarray(fit.pilot[in_support(hyperparameters, fit.pilot)])
    sd = np.sqrt(np.clip(variances, 0, 1))
    z = np.random.default_rng(seed).standard_normal((THETAS, sd.size))
    thetas = fit.theta + ((z * sd) @ oriented(axes).T) * prior_sd
    return np.asarray(thetas[in_support(hyperparameters, thetas)])


def _cover(search: Search, fit: Fit, nearby: Floats) -> Restart:
    """Add points to designs that do not support a fit, around a pilot and its optimum."""
    evaluator, thetas = search.evaluator, fit.pilot
    if thetas is None:
        thetas = nearby = pilot(evaluator, fit.scales, seed=search.settings.random_seed)
    elif (ridge := _ridge(search, fit, thetas)) is not None:
        refine_at(evaluator, ridge.center[None] if fit.ridge is None else nearby)
        return Restart(ridge.center, thetas, ridge)
    elif not refine_at(evaluator, nearby):
        refine_at(evaluator, fit.theta[None])
    theta = best_or_nearest(search, np.vstack([fit.theta, nearby]), fit.scales)
    return Restart(theta, thetas, fit.ridge)


def _ridge(search: Search, fit: Fit, pilot_thetas: Floats) -> Ridge | None:
    """Return a penalty on directions that are not identified, or None if all are identified.

    Along them a minimiser follows the error of the design, which grows with the distance. The
    penalty is the sampling noise at one spread of the prior.
    """
    evaluator = search.evaluator
    hyperparameters = evaluator.hyperparameters

    def noise(theta: Floats) -> float:
        return float((noise_floors(evaluator, theta, FEW_SETS) / fit.scales).sum())

    if search.settings.prior:
        return None
    center = fit.theta
    if fit.ridge is None or shortcomings(evaluator, center[None]):
        # Center the penalty at the theta closest to the prior's median, of those that fit as well
        # as the best.
        values = evaluator.total(pilot_thetas, fit.scales)
        is_as_good = values <= values.min() + noise(pilot_thetas[np.argmin(values)])
        candidates = pilot_thetas[is_as_good]
        median = np.median(
            hyperparameters.prior_thetas(THETAS, search.settings.random_seed), axis=0
        )
        distances = (((candidates - median) / hyperparameters.prior_sd) ** 2).sum(axis=1)
        center = candidates[np.argmin(distances)]
    sampling = sampling_distribution(evaluator, center, fit.scales)
    if sampling is None or not sampling.local.unidentified.size:
        return None
    return Ridge(center, sampling.local.unidentified, noise(center))


def sampling_distribution(
    evaluator: Evaluator, theta: Floats, scales: Floats
) -> SamplingDistribution | None:
    """Return the sampling distribution of the minimiser, or None if the model has none."""
    if sampling_obstacle(evaluator) is not None:
        return None
    return SamplingDistribution.of(evaluator, theta, scales)


def refine_at(
    evaluator: Evaluator, thetas: Floats, *, beside: Floats | None = None
) -> dict[str, Shortcoming]:
    """Add a batch to each design that falls short at thetas, (P, d); return what was short.

    Emulated samples are redrawn for these thetas and those ``beside`` them. Raises DesignError if
    too many points have no response.
    """
    short = shortcomings(evaluator, thetas)
    if not short:
        return short
    for name, shortcoming in short.items():
        if shortcoming.is_lost:
            remedy = evaluator.reweighted[name].responses.remedy
            raise DesignError(
                f"{name}: {shortcoming}; {remedy} there, return +inf for specimens "
                "that fail, narrow the priors, or raise max_lost"
            )
    names = set(short)
    nearby = thetas if beside is None else np.concatenate([thetas, beside])
    is_drawn = draw_samples(evaluator, nearby, names)
    while is_drawn and names:
        names &= set(shortcomings(evaluator, thetas))
        is_drawn = draw_samples(evaluator, nearby, names, larger=True, same_surfaces=True)
    # Add runs where larger samples do not suffice or the emulator is poor.
    for name in short:
        emulator = evaluator.reweighted[name].design.emulator
        if emulator is not None and emulator.error > _POOR_EMULATOR:
            names.add(name)
    _add_runs(evaluator, nearby, names)
    return short


def grow(evaluator: Evaluator, thetas: Floats, errors: DesignErrors) -> bool:
    """Add points to all designs until their error is expected to be small enough.

    ``thetas``, (P, d), are those of the populations to support. Returns whether points were added.
    """
    _log.info(
        "the optima of independent designs would differ by %.2f standard errors, more than the "
        "%.2f that are left to them: designs are refined",
        errors.whole,
        AGREE,
    )
    names = set(evaluator.reweighted)
    if not have_emulated_points(evaluator) or errors.emulators > _SHARE * AGREE:
        # Assume that the error of a design of several inputs falls with the power .65 of its size.
        # Add at most as many runs as there are, because the estimate of the error is itself
        # uncertain.
        factor = float(min(2.0, (errors.whole / AGREE) ** (1 / 0.65)))
        if _add_runs(evaluator, thetas, names, factor):
            return True
    if not errors.points > _SHARE * AGREE:
        return False
    return draw_samples(evaluator, thetas, names, larger=True)


def _add_runs(evaluator: Evaluator, thetas: Floats, names: set[str], factor: float = 1.0) -> bool:
    """Add a batch to the designs named, and to those of simulators that share their specimens.

    The batch has the design's first size, or brings the whole to ``factor`` times what it was.
    Returns whether ``max_points`` left room for any.
    """
    names = siblings(evaluator.nodes, names)
    added = []
    for k, node in enumerate(evaluator.nodes):
        bound = node.reweighted
        if bound is None or node.name not in names:
            continue
        previous = bound.n_runs
        batch = bound.config.n
        if bound.design.has_emulated_points:
            batch = max(batch // 4, bound.responses.workers)
        batches = max(1, round((factor - 1) * previous / batch))
        size = min(batches * batch, bound.config.most - previous)
        if size > 0:
            bound.add(_components(evaluator, thetas, k), size)
            added.append(f"{node.name} from {previous} to {bound.n_runs}")
    if added:
        _log.info("refined: %s runs", ", ".join(added))
    return bool(added)


def _components(evaluator: Evaluator, thetas: Floats, k: int) -> list[Floats]:
    """Return the populations at thetas for which a design has points: those of all its groups."""
    members = next((family for family in families(evaluator.nodes) if k in family), [k])
    by_member = [evaluator.parents(thetas, member) for member in members]
    return [np.concatenate(values) for values in zip(*by_member, strict=True)]


def pilot(evaluator: Evaluator, scales: Floats, *, seed: int = 0) -> Floats:
    """Move an undersampled design from the prior to where the discrepancy is small.

    Each step keeps the best quarter of the thetas and, where the design does not support them, adds
    points from their populations before the next step. Returns thetas, (256, d), whose
    discrepancies differ by no more than sampling noise.
    """
    rng = np.random.default_rng(seed)
    thetas = evaluator.hyperparameters.prior_thetas(4 * THETAS, seed)
    for _ in range(2 * MAX_ROUNDS):
        # Keep the best quarter of the thetas.
        evaluation = evaluator(thetas)
        values = (evaluation.discrepancies / scales).sum(axis=-1) - evaluation.log_other
        values = np.where(np.isfinite(evaluation.log_prior), values, np.inf)
        order = np.argsort(values)[:THETAS]
        is_apart = stored_overlap(evaluator, thetas[order[0]]) < OVERLAP
        if is_apart:
            # Rank by the area, because without overlap discrepancies are equal up to rounding.
            order = np.argsort(AreaGuide(evaluator, scales)(thetas))[:THETAS]
        best = thetas[order]
        # Extend the designs that support fewer than half of these populations. Emulated samples
        # need no runs for that.
        bounds = evaluator.reweighted
        names = {
            name
            for name, support in evaluator.support(best).items()
            if np.median(support["weight_ess"]) < bounds[name].required_ess
        }
        draw_samples(evaluator, best, names, same_surfaces=True)
        has_room = {
            name
            for name in names
            if not bounds[name].design.has_emulated_points
            and len(bounds[name].design.batch_sizes) <= MAX_ROUNDS
        }
        _add_runs(evaluator, best, has_room)
        # Stop where sampling explains the remaining differences.
        spread = values[order[-1]] - values[order[0]]
        noise = sum(noise_floors(evaluator, best[0], FEW_SETS) / scales)
        if not (names or is_apart) and spread < noise:
            break
        # Random steps, small against the spread, so that the design almost covers the next thetas.
        covariance = np.atleast_2d(np.cov(best, rowvar=False))
        jitter = 1e-12 * np.diag(np.diag(covariance))
        root = np.linalg.cholesky(covariance + jitter)
        parents = best[rng.integers(len(best), size=4 * THETAS)]
        z = rng.standard_normal(parents.shape)
        thetas = parents + 0.4 * z @ root.T
    return best


# -- emulated samples ------------------------------------------------------------------------------


def draw_samples(
    evaluator: Evaluator,
    thetas: Floats,
    names: set[str],
    *,
    larger: bool = False,
    same_surfaces: bool = False,
) -> bool:
    """Redraw emulated samples for the populations at thetas; return whether any was drawn.

    The samples are those of the named designs, and of simulators that share their specimens.
    ``larger`` ones have at most the largest size.
    """
    names = siblings(evaluator.nodes, names)
    is_drawn = False
    for k, node in enumerate(evaluator.nodes):
        bound = node.reweighted
        if bound is None or not bound.design.has_emulated_points or node.name not in names:
            continue
        if not larger or bound.design.emulated_size < SIZES.largest:
            parents = valid_parents(bound, _components(evaluator, thetas, k))
            growth = 2 if larger else 1
            bound.reach(parents, same_surfaces=same_surfaces, growth=growth)
            is_drawn = True
    return is_drawn


@contextmanager
def temporary_first_samples(evaluator: Evaluator, thetas: Floats) -> Iterator[None]:
    """Redraw emulated samples for the populations at thetas within the context.

    These are the samples of models that were never calibrated, which cover the prior alone.
    """
    bounds = evaluator.reweighted.items()
    names = {name for name, bound in bounds if len(bound.design.groups) == 1}
    with designs_restored(list(evaluator.reweighted.values())):
        draw_samples(evaluator, thetas, names)
        yield


# -- noise, findings and refusals ---------------------------------------------------------------


def noise_floors(evaluator: Evaluator, theta: Floats, n_sets: int) -> Floats:
    """Return the mean discrepancy of data sets drawn from the model at theta, (k,) by simulator."""
    nodes = range(len(evaluator.nodes))
    return np.array([Information(evaluator, k, theta, n_sets=n_sets).noise_floor for k in nodes])


def design_error_findings(evaluator: Evaluator, error: float) -> list[Finding]:
    """Report a large error of the optimum by the design, in standard errors."""
    # Allow for the uncertainty of the estimate from eight blocks, which is a quarter.
    if not error > 1.5 * AGREE:
        return []
    designs = [bound.design for bound in evaluator.reweighted.values()]
    runs = max(len(design.runs) for design in designs)
    advice = f"pass a larger n or max_points to prb.Reweighted (now {runs} runs)"
    n_emulated = [0 if d.emulated is None else len(d.emulated[0]) for d in designs]
    if min(n_emulated) >= SIZES.largest:
        advice = (
            f"the {runs} runs have the largest number of emulated points, {SIZES.largest}: more "
            "runs reduce only the part of the error that is due to the emulator, stated in "
            "optimum.message; add the rest to the standard errors"
        )
    text = (
        f"The optimum of another design would differ by about {error:.2f} standard errors, "
        f"expected at most {AGREE}; {advice}."
    )
    return [Finding("design-error", text, "choose.md#how-many-responses")]


def rough_emulators(evaluator: Evaluator) -> list[Finding]:
    """Report emulators between runs whose error is large, also where the optimum hardly moves."""
    findings = []
    for name, bound in evaluator.reweighted.items():
        emulator = bound.design.emulator
        if emulator is not None and emulator.error > _POOR_EMULATOR:
            text = (
                f"{name}: between its runs the emulator has an error of {emulator.error_text}, "
                f"expected at most {_POOR_EMULATOR}. Without the finding design-error it hardly "
                "affects the optimum, but it affects predictions of this output; pass more runs."
            )
            page = "expensive.md#several-inputs-from-a-few-dozen-runs"
            findings.append(Finding("rough-emulator", text, page))
    return findings


def refuse(
    short: Mapping[str, Shortcoming], evaluator: Evaluator, unidentified: Sequence[str] = ()
) -> None:
    """Raise for designs that still fall short, perhaps in directions that are ``unidentified``."""
    if not short:
        return
    name, reason = next(iter(short.items()))
    suffix = f" (and {len(short) - 1} more)" if len(short) > 1 else ""
    bound = evaluator.reweighted[name]
    is_accepted = accepts(name, Resimulated(), bound.inputs, bound.target)
    resimulated = ", or use prb.Resimulated(n)" if is_accepted else ""
    cause, advice = "the design does not support the answer", "narrow the priors"
    if unidentified:
        cause += (
            f", where the data are less informative than the prior about {', '.join(unidentified)}"
        )
        advice = "narrow these priors, measure more outputs or conditions"
    raise DesignError(
        f"{name}{suffix}: {cause}: {advice}, pass a larger prb.Reweighted(n) (now {bound.n_runs} "
        f"runs, of at most {bound.config.most}){resimulated}; got {reason}"
    )


def refuse_lost(evaluator: Evaluator, lost: Mapping[str, float]) -> None:
    """Raise if too much of the population of a simulator without a design has no response."""
    for node in evaluator.nodes:
        if node.reweighted is None:
            share, limit = lost.get(node.name, 0.0), node.bound.max_lost
            refuse_lost_share(node.name, share, limit, node.responses.remedy)
