"""Smoothing bias of a log-likelihood by kernel density, by halving the bandwidth.

Only the simulated side is smoothed. The fitted population is then too narrow if a density bends
within a kernel, as for a response with branches: the bandwidth rule takes the spread of all values.
"""

from __future__ import annotations

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local, number_parts
from prbayes.metrics.likelihood import kernel_width, with_narrower_kernel
from prbayes.model.evaluator import Evaluator
from prbayes.numerics.derivatives import hessian_of, slopes, stencil


def smoothing_bias(
    evaluator: Evaluator, theta: Floats, scales: Floats, local: Local | None
) -> list[Finding]:
    """Report log-likelihoods whose smoothing moves the optimum by more than half a standard error.

    By a Newton step to the optimum under kernels of half the width; of stored responses only. It
    needs the sampling distribution ``local``.
    """
    smoothed = [
        k
        for k, node in enumerate(evaluator.nodes)
        if node.bound.stored and any(kernel_width(p.target) > 0 for p in number_parts(node.target))
    ]
    if local is None or not smoothed or not local.covariance.size:
        return []
    # Principal axes in theta, (d, r), of one standard error each.
    variances, vectors = np.linalg.eigh(local.covariance)
    positive = variances > 0
    along = vectors[:, positive] * np.sqrt(variances[positive])
    axes = np.asarray(local.prior_sd[:, None] * (local.identified @ along))
    r = axes.shape[1]
    # The second order in .3 standard errors is some per cent, the points' noise small beside it.
    size = 0.3
    thetas = theta + size * stencil(r) @ axes.T
    step = np.full(r, size)
    hessian = hessian_of(evaluator.total(thetas, scales), r)
    findings = []
    for k in smoothed:
        gain = _gain(evaluator, thetas, k) / scales[k]
        # On the way to the other optimum the curvature is the mean of both.
        curvature = (hessian + hessian_of(gain, r) / 2) / size**2
        if not (np.isfinite(curvature).all() and np.linalg.eigvalsh(curvature)[0] > 0):
            continue
        gradient = slopes(gain[: 1 + 2 * r], step)
        shift = axes @ np.linalg.solve(curvature, -gradient)
        stderr = np.sqrt((axes**2).sum(axis=1))
        # The bias goes with the kernel's variance: half the width removes three quarters.
        bias = np.abs(shift) / np.where(stderr > 0, stderr, np.inf) / (3 / 4)
        # 89 % intervals cover 85 % at a bias of half a standard error.
        if bias.max() > 0.5:
            findings.append(_finding(evaluator, k, bias))
    return findings


def _gain(evaluator: Evaluator, thetas: Floats, k: int) -> Floats:
    """Return the change of a discrepancy by kernels of half the width, (P,)."""
    values, weights = evaluator.populations(thetas, k)
    total = np.zeros(len(thetas))
    for part in number_parts(evaluator.nodes[k].target):
        projection = part.of(values)
        total += part.share * with_narrower_kernel(part.target, 0.5).of(projection, weights)
        total -= part.share * part.target.of(projection, weights)
    return total


def _finding(evaluator: Evaluator, k: int, bias: Floats) -> Finding:
    node = evaluator.nodes[k]
    worst = int(bias.argmax())
    name = evaluator.hyperparameters.readable_names[worst]
    kernel = ""
    parts = number_parts(node.target)
    if len(parts) == 1:
        # A bias of a tenth, as that of the default kernel for a normal population.
        width = kernel_width(parts[0].target) * np.sqrt(0.1 / bias[worst])
        kernel = f"prb.LogLikelihood(density=prb.GaussianKDE({width:.2g})), or "
    # Beyond 1.5 standard errors one step gives no reliable number.
    amount = f"about {bias[worst]:.1f} standard errors"
    if bias[worst] > 1.5:
        amount = "more than a standard error"
    return Finding(
        "smoothing-bias",
        f"{node.name}: the kernel of the log-likelihood is wide beside what it smooths, as where "
        f"responses lie in groups or a long tail: {name} is off by {amount} for that; use {kernel}"
        "prb.KullbackLeibler().",
        "choosing_metric.md#advice",
    )
