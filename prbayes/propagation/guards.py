"""Guards of the log-likelihood by specimen: missing roots, emulator error, Monte Carlo error.

They return numbers, with which loops add starts, runs or points. No guard detects a root outside
the box of the search, or an emulator error that is smooth between the fresh runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from prbayes._validate import Floats
from prbayes.numerics.points import sobol


def missing_share(
    find_roots: Callable[[Floats], Sequence[Floats]],
    response: Callable[[Floats], Floats],
    box: Floats,
    y: Floats,
    n: int = 128,
    seed: int = 0,
    tolerance: float = 0.03,
) -> float:
    """Return the share of simulated specimens whose own inputs are not among their roots.

    Inputs x* are uniform in the box of the runs. Only responses near the data count. As x* is a
    draw from its own posterior under a flat population, the share estimates the missing posterior
    mass. 0 of 128 means less than 2.3 % (95 %).

    NaN if no response in the box is near the data. A root may differ from x* by ``tolerance`` of
    the box. Responses of at most n specimens are (n, m); ``y`` are the measured ones, (N, m).
    """
    low, high = box
    y = y[np.isfinite(y).all(axis=1)]
    # Far more inputs than n, as few responses of a large box are near the data.
    inputs = low + (high - low) * sobol(16 * n, len(low), seed)
    responses = response(inputs)
    margin = 0.1 * np.ptp(y, axis=0)
    near = (responses >= y.min(axis=0) - margin) & (responses <= y.max(axis=0) + margin)
    rows = np.flatnonzero(near.all(axis=1))
    # Outputs in the range of the data may be far from all specimens together.
    unit = np.where(y.std(axis=0) > 0, y.std(axis=0), 1.0)
    squares = [(((y - value) / unit) ** 2).sum(axis=1).min() for value in responses[rows]]
    rows = rows[np.array(squares) < 1][:n]
    if not len(rows):
        return np.nan
    is_missing = []
    for roots, x in zip(find_roots(responses[rows]), inputs[rows], strict=True):
        distance = np.abs(np.reshape(roots, (-1, len(low))) - x)
        is_missing.append(not (distance < tolerance * (high - low)).all(axis=1).any())
    return float(np.mean(is_missing))


def half_difference(log_likelihoods_a: Floats, log_likelihoods_b: Floats) -> float:
    """Return the Monte Carlo error of the log-likelihood over the posterior, in nats.

    sd_s sum_i (log L_i^a(theta_s) - log L_i^b(theta_s)) / 2

    over posterior draws theta_s, with points of two independent halves a and b. The log-likelihood
    of all points is about their mean. A tilt of it by one nat for each posterior standard deviation
    moves the posterior mean by one standard deviation. At .15: size .00 to .06 with 256 Sobol
    points, power .80 to 1.00 with up to 16 (one to four free inputs, 20 and 50 specimens, 200 data
    sets). With data that inform little it flags .45 to .58 of the good sets, at the price of free
    points. It is a single number from two halves: single data sets with a large error are missed
    in up to .71 where these are rare (<= .07).

    Both have shape (S, N), by posterior draw and specimen; 32 draws suffice. A specimen without a
    point in one of the halves, as beside a region without response, is left out.
    """
    is_finite = np.isfinite(log_likelihoods_a) & np.isfinite(log_likelihoods_b)
    with np.errstate(invalid="ignore"):
        by_specimen = np.where(is_finite, log_likelihoods_a - log_likelihoods_b, 0.0)
    difference = by_specimen.sum(axis=1)
    return float(difference.std() / 2)


def predicted_bias(misfit: Floats, jacobian: Floats, x: Floats, size: int) -> Floats:
    """Return the bias that the emulator's error causes, (2, d), in posterior standard deviations.

    The true root lies at x + shift, where shift = -J^+ (run - emulator). From the shifts follow the
    biases of mean (first row) and standard deviation (second row) of each input's population. At
    .15 for the largest absolute value, 16 fresh runs: flagged .91 of the data sets with a true bias
    > .25 and .055 of the others (kinks, poles, crossing modes, jump, frame; 7000 data sets). At a
    jump the prediction has .10 to .45 of the true size. Missing roots are not seen. Infinite if all
    runs have the same value of an input.

    ``misfit`` is run minus emulator at n fresh runs, (n, m), whose inputs ``x``, (n, d), are a
    sample of the roots of ``size`` specimens; the emulator's Jacobian there has shape (n, m, d).
    Scale outputs of different units in misfit and Jacobian.
    """
    shift = -np.einsum("ndm,nm->nd", np.linalg.pinv(jacobian), misfit)
    sd = x.std(axis=0)
    if (sd == 0).any():
        # Roots at one place, such as the maximum of a response, show no spread.
        return np.full((2, len(sd)), np.inf)
    mean_bias = -shift.mean(axis=0) / sd * np.sqrt(size)
    covariance = ((x - x.mean(axis=0)) * shift).mean(axis=0)
    # var(x) = var(x + shift) - 2 cov(x, shift) - var(shift)
    sd_bias = -(covariance + shift.var(axis=0) / 2) / sd**2 * np.sqrt(2 * size)
    return np.stack([mean_bias, sd_bias])
