"""Checks of measured data, and of the first runs, before a fit.

The log-likelihood by specimen takes measured values as exact. Checks of rounding, censoring and
repeated specimens name the argument of `LogLikelihood` that describes the data instead. Checks of
runs raise where further runs would be useless. The study of size (share of flagged data sets when
nothing is wrong) and power is likelihood_guards, sections 2.6 to 2.9.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from prbayes._finding import Finding, Findings, any_of, report
from prbayes._stats import adjusted_p_values, positive_scale
from prbayes._validate import (
    ArrayPair,
    Arrays,
    Bools,
    Floats,
    Indices,
    complete_rows,
    finite_or_nan,
    flat_rows,
)
from prbayes.emulators.emulator import fit_emulator
from prbayes.metrics.readings import (
    Readings,
    Repeats,
    has_error,
    located_values,
    relative_error,
)
from prbayes.propagation.base import DesignError
from prbayes.specimens.proposals import Modes, best_rows

# Checks of the data against the first responses, for all metrics.


def output_labels(name: str, outputs: Sequence[str]) -> list[str]:
    """Return how messages name the outputs of a simulator, or its only one."""
    return [f"{name}[{output}]" for output in outputs] or [name]


def warn_out_of_range(
    name: str, observed: Floats, responses: Floats, outputs: Sequence[str]
) -> None:
    """Warn if all observed values of an output lie outside all simulated responses."""
    if not responses.size:  # a user's own propagation may store no responses
        return
    columns = flat_rows(observed).T
    simulated = flat_rows(responses).T
    if len(columns) != len(simulated):
        return
    triples = zip(output_labels(name, outputs), columns, simulated, strict=True)
    for label, column, values in triples:
        measured, finite = column[np.isfinite(column)], values[np.isfinite(values)]
        if not measured.size or finite.size < 16:  # too few responses to know the range
            continue
        low, high = measured.min(), measured.max()
        lowest, highest = finite.min(), finite.max()
        if high < lowest or low > highest:
            side = "below" if high < lowest else "above"
            report(
                Finding(
                    "data-out-of-reach",
                    f"{label}: got observed values from {low:.4g} to {high:.4g}, all {side} the "
                    f"first {finite.size} responses, from {lowest:.4g} to {highest:.4g}: check the "
                    "units, and whether the priors reach the data, before more runs are made.",
                )
            )
            return


def outlier_findings(
    name: str,
    observed: Floats,
    responses: Floats,
    outputs: Sequence[str],
    *,
    gross_errors: bool = False,
    remedy: str = "use metric=prb.LogLikelihood(gross_errors=True)",
) -> Findings:
    """Return findings of codes for missing values, and of values that no response explains.

    A code, such as -999, is farther from all other values than these are apart. Up to a tenth
    of the values are outliers if they are outside all simulated responses, and a gap of eight
    times the range of all other values separates them. Of samples of 25 lognormal values
    (sigma = 1) .3 % have such a gap, of Student's t (3) .1 %. With gross errors in the likelihood
    only codes are reported.
    """
    columns = flat_rows(observed).T
    # A user's own propagation may store no responses.
    simulated = flat_rows(responses).T if responses.size else np.empty((0, 0))
    labels = output_labels(name, outputs)
    findings = []

    def add(label: str, values: Floats, where: str, advice: str) -> None:
        listed = ", ".join(f"{value:.6g}" for value in np.unique(values)[:3])
        text = f"{label}: got {len(values)} of {len(observed)} observed values far from all others"
        text += f"{where}, {listed}: {advice}"
        findings.append(Finding("outlying-data", text, "my_data.md#outliers"))

    for k, (label, column) in enumerate(zip(labels, columns, strict=False)):
        values = np.sort(column[np.isfinite(column)])
        is_code = np.isin(np.abs(values), [999.0, 9999.0, 99999.0])
        codes, rest = values[is_code], values[~is_code]
        gaps = np.abs(np.subtract.outer(codes, rest))
        if codes.size and rest.size >= 3 and gaps.min() > np.ptp(rest):
            advice = "such a number often stands for a missing value; leave the specimen out, or "
            add(label, codes, "", f"{advice}write NaN where other outputs of it were measured.")
        else:
            rest = values
        finite = simulated[k][np.isfinite(simulated[k])] if len(columns) == len(simulated) else rest
        if gross_errors or len(rest) < 8 or len(finite) < 16:  # too few values to know the range
            continue
        far = _separate(rest, 8.0, 0.1)
        far = far[(far < finite.min()) | (far > finite.max())]
        if far.size:
            where = f" and outside the first {len(finite)} responses"
            add(label, far, where, f"look at units and typing errors, leave them out, or {remedy}.")
    return tuple(findings)


def _separate(values: Floats, apart: float, share: float) -> Floats:
    """Return the largest group of values at an end, at most a share of all, behind a wide gap."""
    # Values, (n,), are in ascending order.
    for count in range(int(share * len(values)) or 1, 0, -1):
        for far, rest in (
            (values[:count], values[count:]),
            (values[-count:], values[:-count]),
        ):
            gap = max(rest[0] - far[-1], far[0] - rest[-1])
            if gap > apart * (rest[-1] - rest[0]):
                return far
    return values[:0]


def check_constant(
    name: str, responses: Floats, outputs: Sequence[str], is_stored: bool
) -> Findings:
    """Return findings of outputs that are the same in all runs; raise if no others are made.

    Weights of equal stored responses make no difference. Responses of a propagation that simulates
    again may be equal by chance, as counts can be.
    """
    # A user's own propagation may store no responses. With +inf among the responses all specimens
    # may have failed.
    if not responses.size or np.isposinf(responses).any():
        return ()
    values = flat_rows(responses)
    finite = values[complete_rows(values)]
    if len(finite) < (2 if is_stored else 8):
        return ()
    findings = []
    for label, column in zip(output_labels(name, outputs), finite.T, strict=True):
        if np.ptp(column) > 1e-9 * np.abs(column).max():
            continue
        text = f"{label}: {_constant(column)}"
        if is_stored:
            leave = "leave the output out" if values.shape[1] > 1 else ""
            raise DesignError(any_of(text, "take more runs if it changes rarely", leave))
        findings.append(Finding("constant-response", f"{text}."))
    return tuple(findings)


def _constant(column: Floats) -> str:
    """Return a text on an output that is the same in all runs, to nine digits."""
    return (
        f"the response is constant to nine digits: got {column[0]:.6g} at all {len(column)} runs "
        f"over the priors, with a range of {np.ptp(column):.2g}, expected one that depends on its "
        "inputs; check the response (subtract a large constant from it and from the readings)"
    )


def check_failing_region(
    name: str,
    observed: Floats,
    points: Arrays,
    responses: Floats,
    max_lost: float,
    remedy: str = "repair the response",
) -> Findings:
    """Return a finding of observed values in gaps of the finite responses beside failing runs.

    A value is in such a gap if it is six times the local spacing away from the nearest finite
    response of the output, and 40 % of the 4 d + 4 runs around that run fail. Specimens were
    measured there, so that the response should not fail. Raises DesignError if the share of such
    specimens is above ``max_lost``. Nothing is checked on fewer than 32 finite runs.
    """
    if not responses.size or not points:  # a user's own propagation may store no responses
        return ()
    values = flat_rows(responses)
    is_finite = np.isfinite(values)
    if is_finite.all():
        return ()
    from scipy.stats import rankdata  # the import takes a third of the package's import time

    inputs = np.hstack([x.reshape(len(values), -1) for x in points])
    scores = rankdata(inputs, axis=0)
    _, neighbours = cKDTree(scores).query(scores, k=4 * inputs.shape[1] + 5)
    columns = flat_rows(observed)
    is_apart = np.zeros(columns.shape, dtype=bool)
    for j, column in enumerate(columns.T):
        usable = is_finite[:, j]
        if usable.all() or usable.sum() < 32:
            continue
        order = np.argsort(values[usable, j], kind="stable")
        is_beside = (~usable[neighbours[:, 1:]]).mean(axis=1)[usable] >= 0.4
        outputs, beside = values[usable, j][order], is_beside[order]
        right = np.clip(np.searchsorted(outputs, column), 1, outputs.size - 1)
        nearest = right - (column - outputs[right - 1] < outputs[right] - column)
        first = np.clip(nearest - 4, 0, outputs.size - 9)
        steps = np.diff(outputs)[first[:, None] + np.arange(8)]
        distance = np.abs(column - outputs[nearest])
        # Outputs that failed or were not measured are not finite.
        with np.errstate(invalid="ignore"):
            is_apart[:, j] = beside[nearest] & (distance > 6.0 * np.median(steps, axis=1))
        is_apart[:, j] &= np.isfinite(column)
    count = int(is_apart.any(axis=1).sum())
    if not count:
        return ()
    some = np.unique(columns[is_apart])[:3]
    text = (
        f"{name}: got {count} of {len(columns)} observed responses where no run has a finite "
        f"response, such as {', '.join(f'{value:.4g}' for value in some)}: specimens were measured "
        f"where {(~is_finite.all(axis=1)).sum()} of {len(values)} runs fail, so that the "
        "population cannot be estimated there"
    )
    if count > max_lost * len(columns):
        raise DesignError(f"{text}; {remedy}, or pass a larger max_lost")
    page = "expensive.md#when-a-run-fails"
    return (Finding("failing-data", f"{text}; {remedy}.", page),)


def duplicate_findings(name: str, observed: Floats) -> Findings:
    """Return a finding if each specimen without a label occurs at least twice.

    Counts, and readings on a scale of few steps, have duplicates by chance.
    """
    rows = flat_rows(observed)
    distinct, counts = np.unique(rows, axis=0, return_counts=True)
    # With six or more specimens it cannot be chance that every value occurs twice.
    if len(rows) < 6 or counts.min() < 2 or all(map(_has_few_steps, rows.T)):
        return ()
    return (
        Finding(
            "duplicated-data",
            f"{name}: got {len(rows)} observed values of which only {len(distinct)} are different, "
            "each at least twice: every specimen counts, so that copies make the uncertainty too "
            "small. Pass specimens= for repeated readings of a specimen, and leave out copies.",
        ),
    )


def _has_few_steps(column: Floats) -> bool:
    """Return whether n values, (n,), are on a scale of fewer than n steps."""
    values = column[np.isfinite(column)]
    step = resolution(values)
    has_few = step > 0 and np.ptp(values) / step < len(column)
    return bool(has_few) or len(np.unique(values)) < 3


# Checks for rounding, censoring and repeated values.


@dataclass(frozen=True)
class DataCheckOptions:
    """Thresholds of the checks."""

    # Largest step of rounded values, in standard deviations, that is accepted if the response is
    # monotone. With 200 specimens a step of .25 increases the estimated standard deviation by .05
    # posterior standard deviations, a step of .5 by .21.
    step: float = 0.25
    # Largest step that is accepted if the response has a turning point. With 200 specimens a step
    # of .02 gives a bias of .02 posterior standard deviations, a step of .05 gives .08 (folded
    # response).
    step_at_turning_point: float = 0.02
    censored: float = 0.05  # p-value below which repeated values at an end are reported as censored
    # P-value below which repeated specimens are reported, if all outputs are rounded.
    repeated: float = 0.01
    draws: int = 399  # number of bootstrap samples for each p-value
    seed: int = 0


def resolution(y: Floats, tolerance: float = 1e-6) -> float:
    """Return the step between possible values of rounded data, or 0 for continuous data.

    All values are multiples of the step, up to an offset, with a relative tolerance. A nonlinear
    function of rounded readings has no step.
    """
    if len(y) < 3:
        return 0.0
    accuracy = 4 * np.finfo(np.float64).eps * np.abs(y).max()
    values = np.unique(y)
    gaps = np.diff(values)
    gaps = gaps[gaps > accuracy]  # smaller gaps are rounding errors
    if len(gaps) < 2:
        return 0.0
    for divisor in range(1, 11):  # the smallest gap may consist of several steps
        step = float(gaps.min()) / divisor
        multiples = (values - values[0]) / step
        if multiples.max() > 1e4:  # so fine a step fits almost any numbers by chance
            return 0.0
        error = np.abs(multiples - np.round(multiples)).max()
        if error < tolerance * max(1.0, multiples.max()) + accuracy / step:
            # The mean over all steps is more accurate than the smallest gap.
            return float((values[-1] - values[0]) / np.round(multiples[-1]))
    return 0.0


def count_at_ends(
    y: Floats, step: float = 0.0, draws: int = 399, seed: int = 0
) -> tuple[Indices, Floats]:
    """Return the numbers of values at the largest and smallest one, (2,), and p-values, (2,).

    The hypothesis is that no value is censored; p-values are adjusted for both ends. Two exact
    values are never equal. Without rounding two values at an end therefore suffice: size 0, power
    .98 for 10 % censored of 50 specimens.

    For rounded values the null distribution is a bootstrap of normal values with the same step. A
    population that is not normal piles up at an end by itself. Therefore the density at the end
    also has to exceed the density within half a standard deviation of it (binomial test); the
    larger of the two p-values counts. Limits that differ between specimens leave no pile. A test
    has the table of size and power by population and step.
    """
    n, high, low = len(y), y.max(), y.min()
    if not step:
        at_end = np.array([np.sum(y == high), np.sum(y == low)])
        # Copied specimens also repeat values between the ends, so that these repeats are the
        # reference.
        between = y[(y > low) & (y < high)]
        _, repeats = np.unique(between, return_counts=True)
        is_pile = at_end > repeats.max(initial=1)
        p_values = np.where(is_pile, 1 / (draws + 1), 1.0)
    else:
        is_high = y > high - step / 2
        is_low = y < low + step / 2
        at_end = np.array([is_high.sum(), is_low.sum()])
        rng = np.random.default_rng(seed)
        samples = rng.normal(y.mean(), y.std(), (draws, n))
        cells_of = np.round((samples - low) / step)
        largest = cells_of == cells_of.max(axis=1, keepdims=True)
        smallest = cells_of == cells_of.min(axis=1, keepdims=True)
        null = np.stack([largest.sum(axis=1), smallest.sum(axis=1)], axis=1)
        bootstrap = adjusted_p_values(at_end.astype(np.float64), null.astype(np.float64))
        cells = max(1, int(0.5 * y.std() / step))
        width = (cells + 0.5) * step
        near_high = y > high - width
        near_low = y < low + width
        near = np.array([near_high.sum(), near_low.sum()])
        binomial = bdtrc(at_end - 1, near, 1 / (1 + cells))
        p_values = np.maximum(bootstrap, binomial)
    return at_end, p_values


def identical_specimens(y: Floats) -> tuple[tuple[int, ...], ...]:
    """Return groups of specimens that are identical in all measured outputs, by their indices.

    Outputs (N, m) are NaN where they were not measured. Specimens without any output are ignored.
    """
    measured = np.flatnonzero(np.isfinite(y).any(axis=1))
    rows = np.where(np.isfinite(y[measured]), y[measured], np.inf)
    _, group = np.unique(rows, axis=0, return_inverse=True)
    counts = np.bincount(group)
    return tuple(tuple(measured[group == index].tolist()) for index in np.flatnonzero(counts > 1))


def chance_of_repeats(y: Floats, steps: Floats, draws: int, seed: int = 0) -> float:
    """Return the p-value of the number of repeats among specimens rounded in all outputs.

    Values of the null data sets move by -1, 0 or 1 step: the local density stays, copies part. Only
    outputs with steps of at most a quarter standard deviation move, as more would widen their
    distribution. Without such an output repeats by chance are frequent, and the p-value is 1.

    With p <= .01 the size is 0 to .03. Power for 20 % copies of 20 specimens is .98 and more with
    two or three outputs, and .06 with one output, whose repeats look like chance.

    Steps, (m,), are 0 for exact outputs, in which specimens do not agree by chance.
    """

    def count_repeats(values: Floats) -> int:
        return sum(len(group) - 1 for group in identical_specimens(values))

    repeats = count_repeats(y)
    if not repeats:
        return 1.0
    sd = np.zeros(len(steps))
    for j, column in enumerate(y.T):
        measured = column[np.isfinite(column)]
        if measured.size:
            sd[j] = measured.std()
    fine = steps <= 0.25 * sd
    if not fine.any():
        return 1.0
    is_rounded = steps > 0
    unit = np.where(is_rounded, steps, 1.0)
    cells = np.where(is_rounded, np.round(y / unit), y)
    rng = np.random.default_rng(seed)
    null = []
    for _ in range(draws):
        whole_steps = fine * rng.integers(-1, 2, y.shape)
        move = np.where(is_rounded, whole_steps, rng.random(y.shape))
        null.append(count_repeats(cells + move))
    return (np.sum(np.array(null) >= repeats) + 1) / (draws + 1)


def data_findings(
    y: ArrayLike,
    *,
    labels: Sequence[str] | None = None,
    several_roots: bool = False,
    rounded: ArrayLike = np.nan,
    rows: Indices | None = None,
    options: DataCheckOptions | None = None,
) -> Findings:
    """Return findings of rounded, censored and repeated data, (N,) or (N, m), by output.

    Values that are not finite count as not measured. With several roots inputs have the same
    response, as beside a turning point, and rounding is never harmless. ``rounded`` are the steps
    that the user stated, () or (m,), NaN where none was: such an output has no finding of rounding.
    ``rows``, (N,), are the observed rows of specimens that frequencies repeat, as in a histogram.

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
    y = finite_or_nan(y).reshape(len(y), -1)
    m = y.shape[1]
    labels = [f"observed[{j}]" for j in range(m)] if labels is None else labels
    largest_step = options.step_at_turning_point if several_roots else options.step
    counted = _counted_once(y, rows)
    findings = []
    # Label, step, and step in standard deviations.
    rounded_outputs = []
    steps = np.zeros(m)
    exact = y.copy()  # NaN at a censoring limit, where specimens may be equal without being copies
    for j, (label, stated) in enumerate(zip(labels, np.broadcast_to(rounded, m), strict=True)):
        values = y[np.isfinite(y[:, j]), j]
        if len(values) < 3:
            continue
        steps[j] = step = float(resolution(values) if np.isnan(stated) else stated)
        share = step / max(values.std(ddof=1), 1e-300) if step else 0.0
        if np.isnan(stated) and share > largest_step:
            rounded_outputs.append((label, step, share))
        sample = y[counted & np.isfinite(y[:, j]), j]
        counts, p_values = count_at_ends(sample, step, options.draws, options.seed)
        ends = (
            ("largest", sample.max(), "(None, {:.6g})"),
            ("smallest", sample.min(), "({:.6g}, None)"),
        )
        for (side, limit, argument), count, p in zip(ends, counts, p_values, strict=True):
            if p <= options.censored:
                text = (
                    f"{label}: got {count} of {len(sample)} values equal to the {side}, "
                    f"{limit:.6g}, expected fewer without a limit of measurement; pass "
                    f"censored={argument.format(limit)} if they lie beyond it, or leave out copies."
                )
                findings.append(
                    Finding("censored-data", text, "likelihood_findings.md#censored-data")
                )
                exact[np.abs(y[:, j] - limit) <= step / 2, j] = np.nan
    if rows is not None:
        exact[~counted] = np.nan
    if rounded_outputs:
        findings.insert(0, _rounding_finding(rounded_outputs, largest_step))
    if chance_of_repeats(exact, steps, options.draws, options.seed) <= options.repeated:
        findings.append(_repeats_finding(identical_specimens(exact)))
    return tuple(findings)


def _counted_once(y: Floats, rows: Indices | None) -> Bools:
    """Return which rows of data, (N, m), are no copies: these would look like values at a limit."""
    if rows is not None:
        first = np.unique(rows, return_index=True)[1]
        return np.isin(np.arange(len(y)), first)
    copies = [i for group in identical_specimens(y) for i in group[1:]]
    counted = np.ones(len(y), dtype=bool)
    counted[copies] = np.isfinite(y[copies]).sum(axis=1) < 2
    return counted


def _repeats_finding(groups: Sequence[Sequence[int]]) -> Finding:
    """Return the finding of groups of identical specimens."""
    listed = "; ".join(" and ".join(map(str, group)) for group in groups[:3])
    more = f" and {len(groups) - 3} groups more" if len(groups) > 3 else ""
    text = (
        f"Got specimens {listed}{more} (counted from 0) with identical values of all outputs, "
        "expected different ones; leave out copies, pass specimens= and error= for repeated "
        "readings, or rounded= for coarse ones."
    )
    return Finding("identical-specimens", text, "likelihood_findings.md#identical-specimens")


def _rounding_finding(outputs: Sequence[tuple[str, float, float]], largest: float) -> Finding:
    """Return the finding of rounded outputs: label, step, and step in standard deviations."""
    names, steps, shares = zip(*outputs, strict=True)
    listed = ", ".join(f"{step:.4g}" for step in dict.fromkeys(steps))
    argument = listed if len(set(steps)) == 1 else "the step of each output"
    text = (
        f"{', '.join(names)}: got values that are all multiples of a step of {listed} (up to "
        f"{max(shares):.3g} standard deviations), expected exact values, or a step of at most "
        f"{largest:g} standard deviations; pass rounded={argument}."
    )
    return Finding("rounded-data", text, "likelihood_findings.md#rounded-data")


# Checks of the runs, for the log-likelihood by specimen.


def refuse_unreachable(name: str, outputs: Floats, readings: Readings) -> None:
    """Raise if the response is constant, or all readings are far outside the range of the runs.

    Also raise if limits of zero are all that is known of the scale of an output.

    Far is more than three widths of the range of the runs, outputs (n, m), over the populations of
    the prior. An output that is constant, as at time zero, is one of the error of its readings.
    """
    finite = outputs[complete_rows(outputs)]
    if len(finite) < 2:
        return
    low, high = finite.min(axis=0), finite.max(axis=0)
    size = np.abs(finite).max(axis=0)
    is_constant = high - low <= 1e-9 * size
    is_inexact = has_error(readings).all(axis=0) & (not is_constant.all())
    for j, width in enumerate(high - low):
        if is_constant[j] and is_inexact[j]:
            continue
        output, leave = "the output", ""
        if outputs.shape[1] > 1:
            output, leave = f"output {j} of {outputs.shape[1]}", ", or leave the output out"
        if is_constant[j]:
            raise DesignError(f"{name}: {output}: {_constant(finite[:, j])}{leave}")
        values = located_values(readings)[np.isfinite(located_values(readings)[:, j]), j]
        has_scale = readings.is_measured[:, j].any() or readings.error[:, j].any() or values.any()
        if not has_scale:
            raise DesignError(
                f"{name}: {output}: got readings that are all censored at 0, expected a limit with "
                f"the scale of the output; add {width:.2g} to the response and the limits"
            )
        beyond = np.maximum(values - high[j], low[j] - values)
        if values.size and (beyond > 3 * width).all():
            raise DesignError(
                f"{name}: got readings from {values.min():.4g} to {values.max():.4g}, but "
                f"{low[j]:.4g} to {high[j]:.4g} for {output} at {len(finite)} runs over the range "
                "of the priors, expected ranges that overlap; check the units of the readings, "
                "the response and the priors"
            )


def refuse_unreached(name: str, outputs: Floats, readings: Readings) -> None:
    """Raise if the readings of most specimens are outside the range of the runs."""
    finite = outputs[complete_rows(outputs)]
    if not len(finite):
        return
    with np.errstate(invalid="ignore"):
        outside = (readings.values < finite.min(axis=0)) | (readings.values > finite.max(axis=0))
    count = int(outside.any(axis=1).sum())
    order = "the order of the outputs, " if finite.shape[1] > 1 else ""
    if 2 * count > len(readings):
        error = "a larger error=" if has_error(readings).any() else "prb.LogLikelihood(error=...)"
        raise DesignError(
            f"{name}: the readings of {count} of {len(readings)} specimens are outside the range "
            f"of all runs over the priors; check {order}the response, the priors and the units, or "
            f"pass {error}"
        ) from None
    for pair in combinations(range(finite.shape[1]), 2):
        count = _n_beyond(finite[:, pair], readings.values[:, pair])
        if 2 * count > len(readings):
            raise DesignError(
                f"{name}: outputs {pair[0]} and {pair[1]} of {count} of {len(readings)} specimens "
                "are outside the range of all runs over the priors together, although each is "
                "within its own range; check the order of the outputs, the response and the priors"
            ) from None


def _n_beyond(runs: Floats, readings: Floats) -> int:
    """Return the number of readings of two outputs (N, 2) beyond all runs (n, 2) in a direction.

    The direction is that of the linear discriminant between the runs and the readings.
    """
    scale = runs.std(axis=0)
    readings = readings[complete_rows(readings)]
    if not len(readings) or not (scale > 0).all():
        return 0
    runs, readings = runs / scale, readings / scale
    away = np.median(readings, axis=0) - runs.mean(axis=0)
    direction = np.linalg.pinv(np.cov(runs.T), rcond=1e-6) @ away
    return int((readings @ direction > (runs @ direction).max()).sum())


def refuse_unused_inputs(name: str, z: Floats, outputs: Floats, inputs: Mapping[int, str]) -> None:
    """Raise if the first runs, (n, d) -> (n, m), show a direction of the inputs without influence.

    ``inputs`` are names by column of z; those of conditions, which are known, are not among them.
    The influence is relative to the direction with the largest, at the median run. Responses whose
    inputs all matter have .05 and more, others 1e-4 and less.
    """
    is_finite = complete_rows(outputs)
    d, m = len(inputs), outputs.shape[1]
    if d < 2 or m < d or is_finite.sum() < 4 * d:
        return
    z, outputs = z[is_finite], outputs[is_finite]
    surface = fit_emulator(z, outputs)
    jacobian = surface(z)[1][:, :, list(inputs)]
    spread = outputs.std(axis=0)
    values, directions = _singular_vectors(jacobian / positive_scale(spread)[:, None])
    if len(values) and np.median(values[:, -1] / values[:, 0]) < 1e-3:
        raise _undetermined(name, m, directions, list(inputs.values()))


def _singular_vectors(jacobian: Floats) -> ArrayPair:
    """Return singular values (k, d) and right singular vectors (k, d, d) of finite Jacobians."""
    finite = jacobian[np.isfinite(jacobian).all(axis=(1, 2))]
    if finite.shape[1] < finite.shape[2]:
        return np.empty((0, 0)), np.empty((0, 0, 0))
    _, values, directions = np.linalg.svd(finite)
    return values, directions


def _undetermined(name: str, m: int, directions: Floats, inputs: Sequence[str]) -> DesignError:
    weights = np.median(directions[:, -1] ** 2, axis=0)
    is_named = weights > 0.05 * weights.max()
    involved = ", ".join(x for x, is_shown in zip(inputs, is_named, strict=True) if is_shown)
    return DesignError(
        f"{name}: got {m} outputs that do not determine a direction of {involved}, expected "
        f"outputs that determine the {len(inputs)} inputs of a specimen; make an input without "
        "influence a constant, replace inputs that enter only through their sum or product by it, "
        "or pass only independent outputs"
    )


# Checks of the emulator of a response.


def misfit_findings(
    name: str,
    readings: Readings,
    modes: Modes,
    error: Floats,
    *,
    gross_errors: bool,
) -> list[Finding]:
    """Report specimens whose readings no inputs reproduce.

    The largest misfit in nats is still an error of the emulator: ten standard deviations, (m,).
    With gross errors in the likelihood half of the specimens may have such readings.
    """
    # For each specimen take the mode with the smallest misfit.
    best = modes.rows(best_rows(modes.specimen, modes.misfit))
    has_root = np.isfinite(best.misfit)
    is_poor = has_root & (best.misfit > 50.0)
    poor = best.specimen[is_poor]
    if not poor.size or (gross_errors and 2 * poor.size <= has_root.sum()):
        return []
    sd = np.where(readings.is_measured, readings.comparison_sd(error), 0.0)[poor]
    off = np.sqrt(np.mean((best.errors[is_poor] * sd) ** 2, axis=0))
    return [
        Finding(
            "readings-misfit",
            f"{name}: no inputs in the range of the priors reproduce the readings of "
            f"{poor.size} of {int(has_root.sum())} specimens, which are off by up to "
            f"{off.max():.2g} (root mean square of an output), expected less than the error of the "
            "readings; pass prb.LogLikelihood(error=...) with its standard deviation, or "
            "gross_errors=True for single specimens, or look at the order of the outputs, the "
            "response and the priors.",
            "likelihood_findings.md#readings-that-no-inputs-reproduce",
        )
    ]


def repeat_findings(name: str, repeats: Repeats) -> list[Finding]:
    """Report repeated readings that scatter more than the stated error allows.

    ``repeats`` are in units of that error, which costs n (r - 1 - log r) / 2 nats beside the best
    one, where n squares have the mean r: of an output of a specimen, or of all. By chance this is
    half a chi-squared number of one degree of freedom.
    """
    count = np.concatenate([repeats.count, repeats.count.sum(axis=0, keepdims=True)])
    within = np.concatenate([repeats.within, repeats.within.sum(axis=0, keepdims=True)])
    ratio = np.maximum(within / np.maximum(count, 1.0), 1.0)
    is_poor = count / 2 * (ratio - 1 - np.log(ratio)) > 50.0
    if not is_poor.any():
        return []
    specimens = int(is_poor[:-1].any(axis=1).sum())
    which = f"{specimens} of {len(repeats.count)} specimens" if specimens else "the specimens"
    times = np.sqrt(ratio[-1][count[-1] > 0]).max()
    return [
        Finding(
            "readings-misfit",
            f"{name}: repeated readings of {which} scatter more than their error: by {times:.2g} "
            "times the error (root mean square of the worst output), expected about once; correct "
            "the readings, pass prb.LogLikelihood(error=...) with their standard deviation, or an "
            "unknown one as a variable, or gross_errors=True for single specimens.",
            "likelihood_findings.md#readings-that-no-inputs-reproduce",
        )
    ]


def emulator_findings(
    name: str,
    readings: Readings,
    error: Floats,
    remedies: Callable[[], tuple[str, str]],
    largest: float = 0.03,
) -> list[Finding]:
    """Report an emulator whose error, (m,), is not small beside the scatter of the readings.

    The largest error is in robust standard deviations of the readings. Jumps, poles and crossing
    modes with less have posterior means within .1 standard deviations (32 of 33 data sets).
    """
    share = relative_error(readings, error)
    if not (share > largest).any():
        return []
    return [
        Finding(
            "emulator-error",
            f"{name}: the emulator's error is up to {share.max():.2g} standard deviations of the "
            f"readings, expected at most {largest}: the response has a pole, a jump or a kink "
            "in the range of the priors, or more detail than the runs; posterior means may be off "
            f"by more than .1 standard deviations: {any_of('narrow the priors', *remedies())}.",
            "likelihood_findings.md#emulator-error",
        )
    ]
