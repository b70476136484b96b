"""Whether a likelihood's kernel is narrow beside what it smooths, told by one of half its width.

Only the simulated side is smoothed, which makes the fitted population too narrow where a density
bends within a kernel, as where a response has branches that lie far apart: the bandwidth rule looks
at the spread of all values.
"""

from __future__ import annotations

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local
from prbayes.inference.projections import number_parts
from prbayes.metrics.likelihood import kernel_width, with_narrower_kernel
from prbayes.model.evaluator import Evaluator
from prbayes.numerics.derivatives import hessian_of, slopes, stencil

# Step of differences, in standard errors: what is of second order in it is then some per cent, and
# the noise of a design's points small beside it.
_DIFFERENCE_STEP = 0.3
# Bias in standard errors of which is warned: 89% intervals hold the truth in 85% there. The default
# kernel's is a tenth where a population is normal.
_BIASED = 0.5
# The bias goes with the kernel's variance, so that a kernel of half the width leaves a quarter.
_OF_BIAS = 3 / 4
# The bias that a kernel is proposed for, as that of the default.
_AIMED = 0.1
# Bias beyond which one step tells no number: of two branches ten spreads apart it told 1.5 to 3.6
# where 1.1 to 2.9 was true.
_ONE_STEP = 1.5


def wide_kernels(
    evaluator: Evaluator, theta: Floats, scales: Floats, local: Local | None
) -> list[Finding]:
    """Say which likelihood is smoothed by so much that the optimum is where it is because of that.

    By a step to the optimum under kernels of half the width; of stored responses only.

    Parameters
    ----------
    evaluator : Evaluator
    theta : ndarray, shape (d,)
        The optimum.
    scales : ndarray, shape (k,)
        By which the simulators' discrepancies are divided.
    local : Local, optional
        The sampling distribution there; without it nothing is said.
    """
    smoothed = [
        k
        for k, node in enumerate(evaluator.nodes)
        if node.bound.stored and any(kernel_width(p.target) > 0 for p in number_parts(node.target))
    ]
    if local is None or not smoothed or not local.covariance.size:
        return []
    axes = _axes(local)
    thetas = theta + _DIFFERENCE_STEP * stencil(axes.shape[1]) @ axes.T
    step = np.full(axes.shape[1], _DIFFERENCE_STEP)
    hessian = hessian_of(evaluator.total(thetas, scales), step.size)
    findings = []
    for k in smoothed:
        gain = _gain(evaluator, thetas, k) / scales[k]
        # On the way to the other optimum the curvature is the mean of both.
        curvature = (hessian + hessian_of(gain, step.size) / 2) / _DIFFERENCE_STEP**2
        if not (np.isfinite(curvature).all() and np.linalg.eigvalsh(curvature)[0] > 0):
            continue
        gradient = slopes(gain[: 1 + 2 * step.size], step)
        shift = axes @ np.linalg.solve(curvature, -gradient)
        stderr = np.sqrt((axes**2).sum(axis=1))
        bias = np.abs(shift) / np.where(stderr > 0, stderr, np.inf) / _OF_BIAS
        if bias.max() > _BIASED:
            findings.append(_finding(evaluator, k, bias))
    return findings


def _axes(local: Local) -> Floats:
    """Return steps of one standard error in theta along principal axes, (d, r)."""
    variances, axes = np.linalg.eigh(local.covariance)
    known = variances > 0
    along = axes[:, known] * np.sqrt(variances[known])
    return np.asarray(local.prior_sd[:, None] * (local.identified @ along))


def _gain(evaluator: Evaluator, thetas: Floats, k: int) -> Floats:
    """Return what kernels of half the width add to a discrepancy, (P,)."""
    values, weights = evaluator.populations(thetas, k)
    total = np.zeros(len(thetas))
    for part in number_parts(evaluator.nodes[k].target):
        seen = part.of(values)
        total += part.share * with_narrower_kernel(part.target, 0.5).of(seen, weights)
        total -= part.share * part.target.of(seen, weights)
    return total


def _finding(evaluator: Evaluator, k: int, bias: Floats) -> Finding:
    node = evaluator.nodes[k]
    worst = int(bias.argmax())
    name = evaluator.hyperparameters.readable_names[worst]
    kernel = ""
    parts = number_parts(node.target)
    if len(parts) == 1:
        width = kernel_width(parts[0].target) * np.sqrt(_AIMED / bias[worst])
        kernel = f"prb.LogLikelihood(density=prb.GaussianKDE({width:.2g})), or "
    size = f"about {bias[worst]:.1f} standard errors"
    if bias[worst] > _ONE_STEP:
        size = "more than a standard error"
    return Finding(
        "smoothing-bias",
        f"{node.name}: the kernel of the log-likelihood is wide beside what it smooths, as where "
        f"responses lie in groups or a long tail: {name} is off by {size} for that; use {kernel}"
        "prb.KullbackLeibler().",
        "choosing_metric.md#advice",
    )
