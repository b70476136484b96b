"""What is to be said of an optimum: at an edge or a jump, far from the data, not identified."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from prbayes._finding import Finding
from prbayes._stats import distribution_function, quantile
from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local
from prbayes.inference.checks.discrepancy_confounding import confounded
from prbayes.inference.checks.prior_ends import at_prior_ends, prior_end_findings
from prbayes.inference.identifiability import unidentified_directions, without
from prbayes.inference.projections import number_parts, one_dimensional
from prbayes.inference.refits import SamplingDistribution
from prbayes.inference.resampling import dependent
from prbayes.metrics.base import Minimum, is_likelihood
from prbayes.metrics.likelihood import kernel_width
from prbayes.metrics.multivariate import components_missed
from prbayes.model.elements import read_variables, split_elements, told_elements
from prbayes.model.evaluator import Evaluator, only_through_prior
from prbayes.model.labels import labelled
from prbayes.model.parameters import THETAS
from prbayes.numerics.derivatives import cross
from prbayes.optimize.convergence import AGREE
from prbayes.propagation.importance import SIZES

# Design error of which is warned, in standard errors: half as much again as is asked for, since an
# estimate from eight blocks is itself uncertain by a quarter.
_TOLERATED = 1.5 * AGREE
# Where an element left its prior, by spreads of the prior from its middle; nearer to it nothing is
# evaluated. Collapsed populations end 2.9 to 24 of them out, with priors of sigma from narrow to
# fifty times as wide as its truth (test: a collapsed population is known by the objective).
_OUTSIDE = 2.0
# A change that is none, of the objective's typical size. Of collapsed populations a spread further
# changes 2e-7 at most, and the way back to the prior's middle 7e-4 at least: any value in
# [1e-6, 1e-4] gives the same verdicts on them, on four processors and with noise of 1e-12.
_UNCHANGED = 1e-5
# Distance between distribution functions from which two populations differ. A half of the mass
# whose spread shrinks by a factor of 1.3 makes 0.035; where a population stands still it is a
# point's 1/n.
_DIFFERENT = 0.02
# Share of a population whose tail is looked at, and the tail index (Hill 1975) up to which its area
# is said to hang on what no point of a design reaches: with one or less there is no mean. At 1024
# quantiles of a half-Cauchy population it is 1.0, of Student's t with 1.5 and 2 degrees of freedom
# 1.5 and 1.9, of lognormal ones with a spread of 1, 2 and 2.5 2.4, 1.3 and 1.1.
_TAIL = 0.02
_NO_MEAN = 1.1
# Standard deviations of a kernel within which there is a response where its sum over evenly spaced
# ones is the density to some per cent: by Poisson's summation 2 exp(-2 (pi / 2.5)^2) = 9% at a
# spacing of 2.5, and .001% at one of 1.25.
_APART_BY = 1.25
# Halvings of the way back to the middle of the prior: a thousandth of it is a tenth of a spread
# where an optimum is a hundred spreads out.
_HALVINGS = 10


def breakdown(at_edge: tuple[str, ...], at_jump: tuple[str, ...]) -> list[Finding]:
    """Say why no sampling distribution is known: elements at an edge, simulators that jump."""
    findings = []
    if at_edge:
        findings.append(
            Finding(
                "flat-edge",
                f"{', '.join(at_edge)} ran to the edge of the support, where the discrepancy no "
                "longer changes; perhaps the population has collapsed within the bandwidth of the "
                "metric: use a smaller bandwidth, or prb.AreaMetric(), which has none.",
                "choosing_metric.md#advice",
            )
        )
    if at_jump:
        findings.append(
            Finding(
                "jump-at-optimum",
                f"{', '.join(at_jump)}: points lose their response at the optimum, and the "
                "discrepancy jumps there by more than it changes otherwise: use prb.AreaMetric(), "
                "prb.Reweighted(), or more responses.",
                "choose.md#the-propagation",
            )
        )
    return findings


def no_information(evaluator: Evaluator, theta: Floats) -> bool:
    """Return whether no discrepancy changes around theta, as where populations miss the data."""
    # In spreads of the prior: small enough to stay on a plateau, and large against rounding.
    step = 0.01 * evaluator.hyperparameters.prior_sd
    found = evaluator(cross(theta, step)).discrepancies
    here = found[0]
    with np.errstate(invalid="ignore"):
        change = np.abs(found - here)
        # 1e4 times the rounding of a sum in double precision.
        rounding = 1e-12 * np.abs(here)
        # Infinite values are equal, although their difference is not zero.
        same = (found == here) | (change <= rounding)
    return bool(same.all())


def elements_at_edge(
    evaluator: Evaluator, theta: Floats, scales: Floats, *, size: float, tolerance: float, seed: int
) -> tuple[str, ...]:
    """Return the elements that ran to an edge.

    The population goes on changing there, and its discrepancy does not. So far out that the
    population is one number, to the last digit, it no longer changes either: there the last place
    on the way back counts where the discrepancy is the same.

    Standard errors cannot tell: curvature and noise are both rounding errors at an edge, and their
    ratio is anything. The way back to the middle of the prior does change the discrepancy, unlike
    that of a hyperparameter without effect. At the bound of a prior the population itself stands
    still: that is a minimum under a constraint.

    Parameters
    ----------
    evaluator : Evaluator
    theta : ndarray, shape (d,)
    scales : ndarray, shape (k,)
    size : float
        Typical size of the objective.
    tolerance : float
        Of the minimiser: it stops where the objective changes by less than that in one spread of
        the prior.
    seed : int
    """
    # Elements far from the middle of their prior.
    middle = np.median(evaluator.hyperparameters.prior_thetas(THETAS, seed), axis=0)
    away = theta - middle
    distance = np.abs(away)
    far = np.flatnonzero(distance > _OUTSIDE * evaluator.hyperparameters.prior_sd)
    if not far.size or no_information(evaluator, theta):
        return ()
    # What changes further out, and on the way back.
    outwards = np.sign(away) * evaluator.hyperparameters.prior_sd
    further = theta + np.diag(outwards)[far]
    back = theta - np.diag(away)[far]
    thetas = np.vstack([theta, further, back])
    here, *there = evaluator.total(thetas, scales)
    with np.errstate(invalid="ignore"):
        changes = np.abs(np.array(there) - here)
    beyond, returning = changes.reshape(2, -1)
    unchanged = max(_UNCHANGED, tolerance) * size
    stands_still = beyond < unchanged
    comes_back = returning > unchanged
    # Of those, the ones whose population changes all the same, there or on the way back.
    found = []
    for i in np.flatnonzero(stands_still & comes_back):
        changes_here = _apart(evaluator, theta, further[i]) > _DIFFERENT
        if not changes_here:
            last = _last_unchanged(evaluator, theta, back[i], scales, unchanged)
            outwards_from_there = last + further[i] - theta
            changes_here = _apart(evaluator, last, outwards_from_there) > _DIFFERENT
        if changes_here:
            name = evaluator.hyperparameters.readable_names[far[i]]
            found.append(name)
    return tuple(found)


def _last_unchanged(
    evaluator: Evaluator, theta: Floats, back: Floats, scales: Floats, unchanged: float
) -> Floats:
    """Return the last place on a straight way where the objective is that at its beginning."""
    (here,) = evaluator.total(theta[None], scales)
    same, other = 0.0, 1.0
    for _ in range(_HALVINGS):
        half = (same + other) / 2
        (there,) = evaluator.total((theta + half * (back - theta))[None], scales)
        if abs(there - here) < unchanged:
            same = half
        else:
            other = half
    return theta + same * (back - theta)


def _apart(evaluator: Evaluator, a: Floats, b: Floats) -> float:
    """Return the largest distance between the populations' distribution functions at two thetas."""
    largest = 0.0
    both = np.array([a, b])
    for k, node in enumerate(evaluator.nodes):
        values, weights = evaluator.populations(both, k)
        for seen in one_dimensional(node.target, values):
            occurring = np.unique(seen[np.isfinite(seen)])
            below = distribution_function(seen, weights, occurring)
            gaps = np.abs(below[0] - below[1])
            largest = max(largest, float(gaps.max(initial=0.0)))
    return largest


def heavy_tails(evaluator: Evaluator, theta: Floats) -> list[Finding]:
    """Say which populations have no mean, or hardly one, so that their area is not known.

    Of stored responses only: others would be computed for it.
    """
    findings = []
    for k, node in enumerate(evaluator.nodes):
        if node.metric.minimum is not Minimum.ABSOLUTE or not node.bound.stored:
            continue
        values, weights = evaluator.populations(theta[None], k)
        seen = one_dimensional(node.target, values[0])
        index = min(_tail_index(numbers, weights[0]) for numbers in seen)
        if index < _NO_MEAN:
            findings.append(
                Finding(
                    "heavy-tail",
                    f"{node.name}: the tail of the simulated responses is so long (tail index "
                    f"{index:.2f}, of which one or less has no mean) that the area between "
                    "distribution functions is infinite, or rests on responses beyond all that "
                    "were computed: use prb.ProbabilityResidual() or prb.KullbackLeibler(), inputs "
                    "with a mean, or the logarithm of the response.",
                    "choosing_metric.md#advice",
                )
            )
    return findings


def _tail_index(values: Floats, weights: Floats) -> float:
    """Return Hill's index of the longer tail of a weighted population, from its middle."""
    known = np.isfinite(values) & (weights > 0)
    values = values[known]
    weights = weights[known]
    weights = weights / weights.sum()
    away = values - quantile(values, weights, 0.5)
    found = [np.inf]
    for side in (away, -away):
        start = float(quantile(side, weights, 1 - _TAIL))
        beyond = side > start
        mass = weights[beyond]
        total = float(mass.sum())
        if start > 0 and total > 0:
            logs = np.log(side[beyond] / start)
            length = float(mass @ logs)
            found.append(total / max(length, 1e-300))
    return min(found)


def between_runs(evaluator: Evaluator, theta: Floats) -> list[Finding]:
    """Say which observed values lie where a density is read between responses too far apart.

    Of stored responses only: common points move with theta.
    """
    findings = []
    for k, node in enumerate(evaluator.nodes):
        if not node.bound.stored:
            continue
        values, _ = evaluator.populations(theta[None], k)
        for part in number_parts(node.target):
            width = kernel_width(part.target)
            if not width > 0:
                continue
            observed = part.target.observed
            observed = observed[np.isfinite(observed)]
            lonely = _nearest(part.of(values[0]), observed) > _APART_BY * width
            if lonely.any():
                told = ", ".join(f"{value:.4g}" for value in observed[lonely][:3])
                findings.append(
                    Finding(
                        "data-between-runs",
                        f"{node.name}: {int(lonely.sum())} of {observed.size} observed values "
                        f"({told}) lie between responses that are farther apart than the kernel is "
                        "wide, so that their likelihood is not known: pass a larger "
                        "prb.Reweighted(n), until the optimum stays, or use prb.KullbackLeibler().",
                        "choosing_metric.md#advice",
                    )
                )
    return findings


def _nearest(values: Floats, places: Floats) -> Floats:
    """Return how far the nearest of some values is from each place, (n,)."""
    known = np.sort(values[np.isfinite(values)])
    ends = np.concatenate([[-np.inf], known, [np.inf]])
    above = np.searchsorted(ends[1:-1], places) + 1
    return np.asarray(np.minimum(ends[above] - places, places - ends[above - 1]))


def caveats(
    evaluator: Evaluator,
    sampling: SamplingDistribution | None,
    rivals: Sequence[Floats],
    design_error: float,
) -> tuple[Finding, ...]:
    """Say what is not seen, is identified only by the prior, or could as well be elsewhere.

    And whether the design is too small.
    """
    missed = {node.name: components_missed(node.target) for node in evaluator.nodes}
    findings = [
        Finding("components-left-out", f"{name}: {text}.") for name, text in missed.items() if text
    ]
    if design_error > _TOLERATED:
        findings.append(_of_design(evaluator, design_error))
    findings += [_of_rival(evaluator, theta) for theta in rivals]
    if sampling is not None:
        ends = at_prior_ends(sampling)
        page = "optimum_or_abc.md#few-specimens-and-a-prior-that-knows-something"
        findings += prior_end_findings(ends, page)
        findings += not_identified(evaluator, sampling.local, [end.name for end in ends])
        findings += confounded(evaluator, sampling.local)
    return tuple(findings)


def small_simulators(evaluator: Evaluator, enough: int = 30) -> list[Finding]:
    """Report simulators of so few specimens that the spread in common is estimated too small.

    Bandwidths of few data let simulators that happen to scatter little weigh most, and a sum of
    areas leaves out the scatter between their means. The probability residual is right.
    """
    nodes = evaluator.nodes
    is_biased = [
        node.metric.minimum is Minimum.ABSOLUTE or is_likelihood(node.target) for node in nodes
    ]
    fewest = min((len(node.observed) for node in nodes), default=enough)
    if len(nodes) < 2 or fewest >= enough or not any(is_biased) or dependent(nodes):
        return []
    if not _have_hyperparameters_in_common(evaluator):
        return []
    return [
        Finding(
            "small-simulators",
            f"The optimum underestimates a spread that {len(nodes)} simulators have in common, as "
            f"they have {fewest} specimens or more, expected at least {enough}: by 30% with 4, 10% "
            "with 10; take the posterior of prb.sample, which corrects for it, or "
            "prb.ProbabilityResidual(), or give one simulator all specimens of a condition.",
        )
    ]


def _have_hyperparameters_in_common(evaluator: Evaluator) -> bool:
    """Return whether an element of theta enters the populations of two simulators."""
    thetas = evaluator.hyperparameters.initial + np.vstack(
        [0 * evaluator.hyperparameters.prior_sd, np.diag(evaluator.hyperparameters.prior_sd)]
    )
    count = np.zeros(evaluator.hyperparameters.size)
    for k in range(len(evaluator.nodes)):
        moves = np.zeros(evaluator.hyperparameters.size, dtype=bool)
        for root in evaluator.roots(thetas, k):
            flat = root.reshape(len(thetas), -1)
            moves |= (flat[1:] != flat[0]).any(axis=1)
        count += moves
    return bool((count > 1).any())


def not_identified(evaluator: Evaluator, local: Local, told: Sequence[str] = ()) -> list[Finding]:
    """Say about which directions the data tell less than the prior, without those told of."""
    hidden = without(local.unidentified, only_through_prior(evaluator))
    directions = unidentified_directions(hidden, evaluator.hyperparameters.readable_names)
    return [_of_direction(direction) for direction in directions if direction not in told]


def _of_design(evaluator: Evaluator, error: float) -> Finding:
    designs = [bound.design for bound in evaluator.reweighted.values()]
    runs = max(design.n_runs for design in designs)
    apart = f"The optimum of another design would differ by about {error:.2f} standard errors, "
    apart += f"expected at most {AGREE}; "
    if min(len(design.emulated or ()) for design in designs) < SIZES.largest:
        advice = f"pass a larger n or max_points to prb.Reweighted (now {runs} runs)"
    else:
        advice = (
            f"between its {runs} runs are {SIZES.largest} emulated points, the most there are: "
            "more runs help as far as the emulator is off, which the message says, and the rest "
            "counts as another error of the optimum"
        )
    return Finding("design-error", f"{apart}{advice}.", "choose.md#how-many-responses")


def _of_rival(evaluator: Evaluator, theta: Floats) -> Finding:
    # Beside another point, by which what is the same everywhere is seen.
    points = evaluator.hyperparameters.constrained(
        np.stack([theta, evaluator.hyperparameters.initial])
    )
    read = read_variables([str(rv.name) for rv in evaluator.model.free_RVs], points)
    values = labelled(evaluator, {name: points[name] for name in read}, {"point": 2}).data_vars
    elements = split_elements(values)
    place = ", ".join(f"{name} = {elements[name][0]:.4g}" for name in told_elements(values))
    return Finding(
        "second-mode",
        f"The data could as well come from {place}: another optimum, or mirror "
        "solution, whose discrepancy differs by no more than sampling noise; state a prior that "
        "excludes one, or report both.",
        "optimum_or_abc.md#two-answers",
    )


def _of_direction(direction: str) -> Finding:
    return Finding(
        "not-identified",
        f"The data tell less than the prior about {direction} (in units of the priors' standard "
        "deviations): it is not identified by them, and its posterior rests on the prior; measure "
        "more outputs or conditions, or state what is known.",
        "optimum_or_abc.md#no-answer",
    )
