"""Checks of measured data before any run: rounding, censoring and repeated specimens.

The log-likelihood by specimen takes measured values as exact. Each check names the argument of
`LogLikelihood` that describes the data instead. Size is the share of flagged data sets when nothing
is wrong, power the share when the error is there; the study is likelihood_guards, sections 2.6 to
2.9, unless another is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import bdtrc

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.numerics.min_p import adjusted_p_values


@dataclass(frozen=True)
class DataCheckOptions:
    """Thresholds of the checks.

    Parameters
    ----------
    step : float
        Largest step of rounded values, in standard deviations, that a monotone response allows.
        At .25 the standard deviation is .03 posterior standard deviations too large with 50
        specimens and .05 with 200; at .5 it is .10 and .21 too large.
    step_at_turning_point : float
        The same where the response has a turning point. At .02 the bias is .02 posterior standard
        deviations with 200 specimens, at .05 .08, at .1 .24 (folded response, 1000 data sets).
    censored : float
        Largest p-value of a pile at an end.
    repeated : float
        Largest p-value of repeats among specimens that are rounded in all outputs.
    draws : int
        Bootstrap samples of each p-value.
    seed : int
    """

    step: float = 0.25
    step_at_turning_point: float = 0.02
    censored: float = 0.05
    repeated: float = 0.01
    draws: int = 399
    seed: int = 0


def resolution(y: Floats, tolerance: float = 1e-6) -> float:
    """Return the step between possible values of rounded data, or 0 for continuous data.

    All values are multiples of the step, up to an offset. Size 0 of 8000 data sets, power 1.00 for
    steps of .1 to 1 standard deviation and 20 to 200 specimens. A nonlinear function of rounded
    readings has no step.

    Parameters
    ----------
    y : ndarray, shape (N,)
        Finite values.
    tolerance : float
        Largest deviation from a multiple, relative to the largest multiple of the step.
    """
    if len(y) < 3:
        return 0.0
    accuracy = 4 * np.finfo(np.float64).eps * np.abs(y).max()
    values = np.unique(y)
    gaps = np.diff(values)
    gaps = gaps[gaps > accuracy]  # equal up to the last digits
    if len(gaps) < 2:
        return 0.0
    for divisor in range(1, 11):  # the smallest gap may itself be several steps
        step = float(gaps.min()) / divisor
        multiples = (values - values[0]) / step
        if multiples.max() > 1e4:  # almost any number is close to a multiple of so fine a step
            return 0.0
        error = np.abs(multiples - np.round(multiples)).max()
        if error < tolerance * max(1.0, multiples.max()) + accuracy / step:
            # The mean over all steps is more accurate than the smallest gap.
            return float((values[-1] - values[0]) / np.round(multiples[-1]))
    return 0.0


@dataclass(frozen=True)
class Ends:
    """Values at the largest and at the smallest value of a sample.

    Parameters
    ----------
    counts : (int, int)
        Number of values that equal the largest, and the smallest.
    p_values : (float, float)
        Each p-value is adjusted for both ends.
    """

    counts: tuple[int, int]
    p_values: tuple[float, float]


def count_at_ends(y: Floats, step: float = 0.0, draws: int = 399, seed: int = 0) -> Ends:
    """Count the values at either end, and return p-values of the hypothesis of no censoring.

    The null distribution of the counts is a bootstrap of normal values that are rounded as the data
    are. Two exact values are never equal, so that two values at an end suffice without rounding:
    size 0, power .60 and .98 (10 % censored, 20 and 50 specimens), .99 and 1.00 (30 %).

    Rounded values of a population that is not normal pile up at an end by themselves: the bootstrap
    alone flags .58 of the folded and .48 of the lognormal data sets with 50 specimens and a step of
    .1 standard deviations. Therefore the density at the end also has to exceed the density within
    half a standard deviation of it (binomial test); the larger of the two p-values counts. Size and
    power with 20 and 50 specimens (300 data sets, ``slow`` test of this module):

    ================================  ==========  ==========  ==========
    step in standard deviations       .1          .25         .5
    ================================  ==========  ==========  ==========
    normal                            .01, .01    .01, .00    .00, .00
    folded, lognormal, exponential    .03, .04    .02, .01    .00, .00
    beta (1/2, 1/2)                   .27, .52    .20, .40    .04, .05
    10 % censored                     .25, .61    .06, .20    .01, .01
    30 % censored                     .89, 1.00   .47, .86    .24, .51
    ================================  ==========  ==========  ==========

    At a step of 1 the lognormal population is flagged in .15 and .36, and 30 % censored in .01 and
    .02. The bootstrap alone has power .75 and 1.00 for 30 % at a step of .5. Limits that differ
    between specimens leave no pile and are not detected.

    Parameters
    ----------
    y : ndarray, shape (N,)
        Finite values.
    step : float
        Step of rounded values, 0 for exact ones.
    draws : int
        Bootstrap samples.
    seed : int
    """
    n, high, low = len(y), y.max(), y.min()
    at_high = np.sum(y > high - step / 2)
    at_low = np.sum(y < low + step / 2)
    at_end = np.array([at_high, at_low])
    if not step:
        at_end = np.array([np.sum(y == high), np.sum(y == low)])
        # Copies of specimens repeat values between the ends, too.
        _, repeats = np.unique(y[(y > low) & (y < high)], return_counts=True)
        p_values = np.where(at_end > repeats.max(initial=1), 1 / (draws + 1), 1.0)
    else:
        rng = np.random.default_rng(seed)
        null = np.empty((draws, 2))
        for draw in null:
            values = np.round((rng.normal(y.mean(), y.std(), n) - low) / step)
            draw[0] = np.sum(values == values.max())
            draw[1] = np.sum(values == values.min())
        bootstrap = adjusted_p_values(at_end.astype(np.float64), null)
        cells = max(1, int(0.5 * y.std() / step))
        width = (cells + 0.5) * step
        near_high = np.sum(y > high - width)
        near_low = np.sum(y < low + width)
        near = np.array([near_high, near_low])
        p_values = np.maximum(bootstrap, bdtrc(at_end - 1, near, 1 / (1 + cells)))
    top, bottom = at_end.tolist()
    p_top, p_bottom = p_values.tolist()
    return Ends((top, bottom), (p_top, p_bottom))


def identical_specimens(y: Floats) -> tuple[tuple[int, ...], ...]:
    """Return groups of specimens that are identical in all measured outputs, by their indices.

    Size 0, power 1.00 for exact repeats. Repeats with a new reading error are not identical.

    Parameters
    ----------
    y : ndarray, shape (N, m)
        NaN where an output was not measured. Specimens without any output are ignored.
    """
    measured = np.flatnonzero(np.isfinite(y).any(axis=1))
    rows = np.where(np.isfinite(y[measured]), y[measured], np.inf)
    _, group = np.unique(rows, axis=0, return_inverse=True)
    counts = np.bincount(group)
    return tuple(tuple(measured[group == index].tolist()) for index in np.flatnonzero(counts > 1))


def chance_of_repeats(y: Floats, steps: Floats, draws: int = 399, seed: int = 0) -> float:
    """Return the p-value of the number of repeats among specimens rounded in all outputs.

    Values of the null data sets move by -1, 0 or 1 step: the local density stays, copies part. Only
    outputs with steps of at most a quarter standard deviation move, as more would widen their
    distribution. Without such an output repeats by chance are frequent, and the p-value is 1.

    With p <= .01 the size is 0 to .03 (one to three outputs, correlation .7, steps 0 to 1 standard
    deviation). Power for 20 % copies of 20 specimens is .98 to 1.00 with two or three outputs and
    steps of .01 and .1, and .06 with one output, whose repeats look like chance (100 data sets).

    Parameters
    ----------
    y : ndarray, shape (N, m)
        NaN where an output was not measured.
    steps : ndarray, shape (m,)
        Step of each output, 0 for exact ones. Specimens do not agree in an exact output by chance.
    """
    repeats = _repeats(y)
    if not repeats:
        return 1.0
    measured = np.isfinite(y)
    sd = np.array([y[kept, j].std() if kept.any() else 0.0 for j, kept in enumerate(measured.T)])
    fine = steps <= 0.25 * sd
    if not fine.any():
        return 1.0
    cells = np.where(steps > 0, np.round(y / np.where(steps > 0, steps, 1.0)), y)
    rng = np.random.default_rng(seed)
    null = []
    for _ in range(draws):
        move = np.where(steps > 0, fine * rng.integers(-1, 2, y.shape), rng.random(y.shape))
        null.append(_repeats(cells + move))
    return (np.sum(np.array(null) >= repeats) + 1) / (draws + 1)


def _repeats(y: Floats) -> int:
    """Return the number of specimens that repeat an earlier one."""
    return sum(len(group) - 1 for group in identical_specimens(y))


def data_findings(
    y: ArrayLike,
    *,
    labels: Sequence[str] | None = None,
    several_roots: bool = False,
    rounded: ArrayLike | None = None,
    censored: ArrayLike | None = None,
    options: DataCheckOptions | None = None,
) -> tuple[Finding, ...]:
    """Return findings of rounded, censored and repeated data.

    Parameters
    ----------
    y : array_like, shape (N,) or (N, m)
        Measured outputs. Values that are not finite count as not measured.
    labels : sequence of str, optional
        Names of the outputs.
    several_roots : bool
        Whether several inputs have the same response, as beside a turning point. There rounding is
        never harmless.
    rounded : array_like, shape () or (m,), optional
        Steps that the user stated. NaN where none was.
    censored : array_like, shape () or (m,), optional
        Limits that the user stated. NaN where none was.
    options : DataCheckOptions, optional

    Returns
    -------
    tuple of Finding
        Codes ``rounded-data``, ``censored-data`` and ``identical-specimens``. A check is silent for
        an output where the user stated the argument that describes it.

    Examples
    --------
    >>> import numpy as np
    >>> lengths = np.round(np.random.default_rng(0).normal(10, 1, 30) * 2) / 2
    >>> [finding.code for finding in data_findings(lengths)]
    ['rounded-data']
    >>> data_findings(lengths, rounded=0.5)
    ()
    """
    options = DataCheckOptions() if options is None else options
    y = np.asarray(y, dtype=np.float64)
    y = np.where(np.isfinite(y), y, np.nan).reshape(len(y), -1)
    m = y.shape[1]
    if labels is None:
        labels = ["observed"] if m == 1 else [f"observed[{j}]" for j in range(m)]
    stated_steps = _by_output(rounded, m, "rounded")
    stated_limits = _by_output(censored, m, "censored")
    largest_step = options.step_at_turning_point if several_roots else options.step
    # Copies of a specimen would pile up at the ends of its outputs.
    copies = [i for group in identical_specimens(y) for i in group[1:]]
    counted = np.ones(len(y), dtype=bool)
    counted[copies] = np.isfinite(y[copies]).sum(axis=1) < 2
    findings: list[Finding] = []
    steps = np.zeros(m)
    exact = y.copy()  # NaN at a limit, where specimens are equal by censoring
    for j, label in enumerate(labels):
        values = y[np.isfinite(y[:, j]), j]
        if len(values) < 3:
            continue
        steps[j] = resolution(values) if np.isnan(stated_steps[j]) else stated_steps[j]
        if np.isnan(stated_steps[j]) and steps[j] > largest_step * values.std(ddof=1):
            findings.append(_rounded(label, values, float(steps[j]), largest_step))
        limits = [stated_limits[j]]
        if np.isnan(stated_limits[j]):
            sample = y[counted & np.isfinite(y[:, j]), j]
            ends = count_at_ends(sample, float(steps[j]), options.draws, options.seed)
            limits = []
            for side, count, p_value in zip(
                ("largest", "smallest"), ends.counts, ends.p_values, strict=True
            ):
                if p_value <= options.censored:
                    limits.append(sample.max() if side == "largest" else sample.min())
                    findings.append(_censored(label, side, count, len(sample), limits[-1]))
        for limit in limits:
            at_limit = np.abs(y[:, j] - limit) <= steps[j] / 2
            exact[at_limit, j] = np.nan
    if chance_of_repeats(exact, steps, options.draws, options.seed) <= options.repeated:
        findings.append(_identical(identical_specimens(exact)))
    return tuple(findings)


def _by_output(values: ArrayLike | None, m: int, name: str) -> Floats:
    """Return what the user stated by output, (m,), NaN where nothing was stated."""
    array = np.asarray(np.nan if values is None else values, dtype=np.float64)
    if array.shape not in ((), (1,), (m,)):
        raise ValueError(
            f"{name}: got shape {array.shape}, expected one value or one by output, ({m},); "
            "pass NaN for an output without"
        )
    return np.broadcast_to(array, (m,))


def _rounded(label: str, values: Floats, step: float, largest: float) -> Finding:
    share = step / values.std(ddof=1)
    return Finding(
        "rounded-data",
        f"{label}: got {len(values)} values that are all multiples of a step of {step:.4g} "
        f"({share:.3g} standard deviations), expected exact values, or a step of at most "
        f"{largest:g} standard deviations; pass rounded={step:.4g}.",
        "likelihood.md#rounded-data",
    )


def _censored(label: str, side: str, count: int, n: int, limit: float) -> Finding:
    limits = f"(None, {limit:.6g})" if side == "largest" else f"({limit:.6g}, None)"
    return Finding(
        "censored-data",
        f"{label}: got {count} of {n} values equal to the {side}, {limit:.6g}, expected fewer "
        f"without a limit of measurement; pass censored={limits} if they lie beyond it, or "
        "leave out copies.",
        "likelihood.md#censored-data",
    )


def _identical(groups: tuple[tuple[int, ...], ...]) -> Finding:
    shown = "; ".join(" and ".join(map(str, group)) for group in groups[:3])
    more = f" and {len(groups) - 3} groups more" if len(groups) > 3 else ""
    return Finding(
        "identical-specimens",
        f"Got specimens {shown}{more} (counted from 0) with identical values of all outputs, "
        "expected different ones; leave out copies, pass specimens= and error= for repeated "
        "readings, or rounded= for coarse ones.",
        "likelihood.md#identical-specimens",
    )
