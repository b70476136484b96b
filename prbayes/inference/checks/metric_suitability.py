"""Suitability of a metric for the data and populations at an optimum, and its smoothing bias.

Of a log-likelihood by kernel density only the simulated side is smoothed. The fitted population is
then too narrow if a density bends within a kernel, as for a response with branches: the bandwidth
rule takes the spread of all values.
"""

from __future__ import annotations

import numpy as np

from prbayes._finding import Finding
from prbayes._stats import positive_scale, quantile
from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local, single_output_parts
from prbayes.inference.checks.sample_size import elements_above
from prbayes.inference.goodness_of_fit import FittedSets
from prbayes.inference.resampling import dependent
from prbayes.metrics.base import Discrepancy, Minimum, Part
from prbayes.metrics.likelihood import kernel_width, with_narrower_kernel
from prbayes.metrics.multivariate import components_of
from prbayes.metrics.whitening import sufficient_specimens
from prbayes.model.evaluator import Evaluator
from prbayes.numerics.derivatives import hessian_of, slopes, stencil

_ADVICE = "choosing_metric.md#advice"


def heavy_tails(evaluator: Evaluator, theta: Floats) -> list[Finding]:
    """Report stored populations under the area metric whose mean is hardly finite."""
    findings = []
    for k, node in enumerate(evaluator.nodes):
        if node.metric.minimum is not Minimum.ABSOLUTE or not node.bound.stored:
            continue
        values, weights = evaluator.populations(theta[None], k)
        parts = single_output_parts(node.target)
        index = min(_tail_index(part.of(values[0]), weights[0]) for part in parts)
        # The index at 1024 quantiles is 1.0 for a half-Cauchy population, 1.5 for Student's t with
        # 1.5 degrees of freedom, and 1.1 for a lognormal population with a log-scale of 2.5.
        if index < 1.1:
            metrics = ["prb.ProbabilityResidual()", "prb.KullbackLeibler()"]
            if node.observed.ndim > 1:
                metrics = [f"prb.Joint({metric})" for metric in metrics]
            text = (
                f"{node.name}: the simulated responses have so heavy a tail (tail index "
                f"{index:.2f}; a population with an index of one or less has no mean) that the "
                "area between distribution functions is infinite, or depends on responses beyond "
                f"the computed ones: use {' or '.join(metrics)}, "
                "inputs with a mean, or the logarithm of the response."
            )
            findings.append(Finding("heavy-tail", text, _ADVICE))
    return findings


def _tail_index(values: Floats, weights: Floats) -> float:
    """Return the tail index of Hill (1975), the smaller one of both tails.

    A tail is the outermost 2 % of the values on a side of the median.
    """
    is_usable = np.isfinite(values) & (weights > 0)
    values, weights = values[is_usable], weights[is_usable]
    weights = weights / weights.sum()
    centered = values - quantile(values, weights, 0.5)
    indices = [np.inf]
    for side in (centered, -centered):
        start = float(quantile(side, weights, 1 - 0.02))
        is_beyond = side > start
        mass = weights[is_beyond]
        total = float(mass.sum())
        if start > 0 and total > 0:
            length = float(mass @ np.log(side[is_beyond] / start))
            indices.append(total / max(length, 1e-300))
    return min(indices)


def data_between_runs(evaluator: Evaluator, theta: Floats) -> list[Finding]:
    """Report observed values between stored responses that are farther apart than the kernel."""
    findings = []
    for k, node in enumerate(evaluator.nodes):
        if not node.bound.stored:
            continue
        values, _ = evaluator.populations(theta[None], k)
        for part in single_output_parts(node.target):
            width = kernel_width(part.target)
            if not width > 0:
                continue
            observed = part.target.observed
            observed = observed[np.isfinite(observed)]
            # A sum of kernels that are 2.5 widths apart approximates the density to 9 %, by
            # Poisson's summation 2 exp(-2 (pi / 2.5)^2).
            responses = part.of(values[0])
            finite = np.sort(responses[np.isfinite(responses)])
            ends = np.concatenate([[-np.inf], finite, [np.inf]])
            above = np.searchsorted(finite, observed) + 1
            distance = np.minimum(ends[above] - observed, observed - ends[above - 1])
            is_between = distance > 1.25 * width
            if is_between.any():
                listed = ", ".join(f"{value:.4g}" for value in observed[is_between][:3])
                text = (
                    f"{node.name}: {int(is_between.sum())} of {observed.size} observed values "
                    f"({listed}) lie between responses that are farther apart than the kernel is "
                    "wide, so that their likelihood is not known: pass a larger "
                    "prb.Reweighted(n), until the optimum does not change, or use "
                    "prb.KullbackLeibler()."
                )
                findings.append(Finding("data-between-runs", text, _ADVICE))
    return findings


def small_simulators(evaluator: Evaluator) -> list[Finding]:
    """Report simulators of so few specimens that their common spread is underestimated.

    With bandwidths of few data, simulators that scatter little by chance have the largest weight,
    unless all have one response and so one bandwidth. The probability residual and the area have no
    such bias.
    """
    enough, nodes = 30, evaluator.nodes
    widths = set()
    for node in nodes:
        parts = [part.target for part in node.target.parts if part.target.metric.likelihood]
        if len(parts) > 1:
            # because bandwidths are in white coordinates of the simulator's own data
            widths.add(node.name)
        elif parts:
            cells = getattr(parts[0], "cells", None)
            widths.add(getattr(cells, "bandwidth", node.name))
    fewest = min((len(node.observed) for node in nodes), default=enough)
    if len(nodes) < 2 or fewest >= enough or len(widths) < 2 or dependent(nodes):
        return []
    if not (elements_above(evaluator)[: len(nodes)].sum(axis=0) > 1).any():
        return []
    return [
        Finding(
            "small-simulators",
            f"The optimum underestimates the common spread of {len(nodes)} simulators, the "
            f"smallest with {fewest} specimens, expected at least {enough}: by 30% with 4, 10% "
            "with 10; use the posterior of prb.sample, which corrects for it, or "
            "prb.ProbabilityResidual(), or give one simulator all specimens of a condition.",
        )
    ]


def few_for_whitening(name: str, target: Discrepancy) -> list[Finding]:
    """Report outputs of so few specimens that a combination scatters too little by chance.

    White coordinates weigh it too much, even if shrunk, so that spreads are underestimated. The
    noise of three readings is low by 30% for 8 specimens and 11% for 12, that of lines with five
    readings by 20% for 12 and 7% for 30 (means of divergence and area metric).
    """
    parts: dict[tuple[int, ...], list[Part]] = {}
    for part in target.parts:
        if part.projection is not None:
            parts.setdefault(tuple(part.projection.outputs.tolist()), []).append(part)
    findings = []
    for outputs, members in parts.items():
        axes = np.array([p.projection.direction for p in members if p.projection is not None])
        size = np.abs(axes).max(axis=0)
        size = positive_scale(size)
        m = int(np.linalg.matrix_rank(axes / size))
        n = members[0].target.n_effective
        enough = sufficient_specimens(m)
        if m > 1 and round(n) < enough:
            text = (
                f"{name}: got {n:.0f} specimens with outputs {', '.join(map(str, outputs))}, "
                f"expected at least {enough} for {m} white coordinates: a combination of outputs "
                "that happens to scatter little counts too much, so that spreads are "
                "underestimated, by 5 to 15% with two thirds of these specimens and by 10 to 40% "
                "with a third, and by more where a combination hardly scatters; leave metric= "
                "out, for the log-likelihood by specimen."
            )
            findings.append(Finding("few-for-whitening", text, _ADVICE))
    return findings


def components_left_out(evaluator: Evaluator, theta: Floats) -> list[Finding]:
    """Report what principal components leave out of the data and of populations at theta."""
    findings = []
    for k, node in enumerate(evaluator.nodes):
        components = components_of(node.target)
        if not components:
            continue
        values, weights = evaluator.populations(theta[None], k)
        shares = [c.share_left_out(values[0], weights[0]) for c in components]
        missed = [c.missed(share) for c, share in zip(components, shares, strict=True)]
        text = "; ".join(filter(None, missed))
        if text:
            findings.append(Finding("components-left-out", f"{node.name}: {text}."))
    return findings


def refit_bias(fitted: FittedSets) -> list[Finding]:
    """Report a hyperparameter that refits of simulated data sets miss on average."""
    thetas = fitted.sampling.thetas(fitted.x[fitted.converged])
    if len(thetas) < 2:
        return []
    center = fitted.sampling.thetas(fitted.center[None])[0]
    spread = thetas.std(axis=0)
    spread = positive_scale(spread, np.inf)
    shift = (thetas.mean(axis=0) - center) / spread
    worst = int(np.abs(shift).argmax())
    # The standard error of the mean of 200 refits is .07 standard deviations.
    if abs(shift[worst]) < 0.5:
        return []
    name = fitted.sampling.evaluator.hyperparameters.readable_names[worst]
    side = ("lower", "under") if shift[worst] < 0 else ("higher", "over")
    text = (
        f"Refits of data sets that are drawn at the optimum give a {side[0]} {name}, on average by "
        f"{abs(shift[worst]):.1f} of their standard deviations: the optimum {side[1]}estimates it, "
        "usually because there are few specimens for each mean or output; report the posterior of "
        "prb.sample, which corrects for it."
    )
    return [Finding("biased-optimum", text, _ADVICE)]


def smoothing_bias(
    evaluator: Evaluator, theta: Floats, scales: Floats, local: Local | None
) -> list[Finding]:
    """Report log-likelihoods whose smoothing moves the optimum by more than half a standard error.

    The shift is a Newton step to the optimum under kernels of half the width. It needs stored
    responses and the sampling distribution ``local``.
    """
    smoothed = [
        k
        for k, node in enumerate(evaluator.nodes)
        if node.bound.stored
        and any(kernel_width(p.target) > 0 for p in single_output_parts(node.target))
    ]
    if local is None or not smoothed or not local.covariance.size:
        return []
    # axes, (d, r): principal axes in theta, each one standard error long
    variances, vectors = np.linalg.eigh(local.covariance)
    positive = variances > 0
    along = vectors[:, positive] * np.sqrt(variances[positive])
    axes = local.prior_sd[:, None] * (local.identified @ along)
    r = axes.shape[1]
    # Over .3 standard errors the second-order term is some per cent of the objective, and larger
    # than the noise of the points.
    size = 0.3
    thetas = theta + size * stencil(r) @ axes.T
    step = np.full(r, size)
    hessian = hessian_of(evaluator.total(thetas, scales), r)
    findings = []
    for k in smoothed:
        gain = _gain_of_half_width(evaluator, thetas, k) / scales[k]
        # The mean of both curvatures applies on the way to the other optimum.
        curvature = (hessian + hessian_of(gain, r) / 2) / size**2
        if not (np.isfinite(curvature).all() and np.linalg.eigvalsh(curvature)[0] > 0):
            continue
        gradient = slopes(gain[: 1 + 2 * r], step)
        shift = axes @ np.linalg.solve(curvature, -gradient)
        stderr = np.sqrt((axes**2).sum(axis=1))
        # The bias is proportional to the kernel's variance, so that half the width removes three
        # quarters of it.
        bias = np.abs(shift) / positive_scale(stderr, np.inf) / (3 / 4)
        # With a bias of half a standard error 89 % intervals cover 85 %.
        if bias.max() > 0.5:
            findings.append(_smoothing_finding(evaluator, k, bias))
    return findings


def _gain_of_half_width(evaluator: Evaluator, thetas: Floats, k: int) -> Floats:
    """Return the change of a discrepancy by kernels of half the width, (P,)."""
    values, weights = evaluator.populations(thetas, k)
    total = np.zeros(len(thetas))
    for part in single_output_parts(evaluator.nodes[k].target):
        projection = part.of(values)
        total += part.share * with_narrower_kernel(part.target).of(projection, weights)
        total -= part.share * part.target.of(projection, weights)
    return total


def _smoothing_finding(evaluator: Evaluator, k: int, bias: Floats) -> Finding:
    """Report the element with the largest bias, in standard errors, and the kernel for it."""
    node, worst = evaluator.nodes[k], int(bias.argmax())
    name = evaluator.hyperparameters.readable_names[worst]
    kernel = ""
    parts = single_output_parts(node.target)
    if len(parts) == 1:
        # Recommend a width with a bias of a tenth, as the default kernel has for a normal
        # population.
        width = kernel_width(parts[0].target) * np.sqrt(0.1 / bias[worst])
        kernel = f"prb.LogLikelihood(density=prb.GaussianKDE({width:.2g})), or "
    # Beyond 1.5 standard errors a single Newton step is not accurate.
    amount = f"about {bias[worst]:.1f} standard errors"
    if bias[worst] > 1.5:
        amount = "more than a standard error"
    text = (
        f"{node.name}: the kernel of the log-likelihood is wide beside features of the "
        f"distribution, such as groups of responses or a long tail, and shifts {name} by {amount}; "
        f"use {kernel}prb.KullbackLeibler()."
    )
    return Finding("smoothing-bias", text, _ADVICE)
