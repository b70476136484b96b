"""Checks of measured data: sizes and powers of the study, and the findings."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
import pytest
from one_input import one_input

import prbayes as prb
from prbayes._validate import Floats
from prbayes.metrics.readings import Readings, Repeats
from prbayes.model.data_checks import (
    DataCheckOptions,
    check_constant,
    count_at_ends,
    data_findings,
    duplicate_findings,
    identical_specimens,
    outlier_findings,
    refuse_unreachable,
    repeat_findings,
    resolution,
    warn_out_of_range,
)
from prbayes.propagation.base import DesignError


def rounded(y: Floats, step: float) -> Floats:
    return np.round(y / step) * step if step else y


def correlated(rng: np.random.Generator, n: int, m: int, step: float = 0.0) -> Floats:
    """Return normal outputs (n, m) with correlation .7, rounded."""
    root = np.linalg.cholesky(0.3 * np.eye(m) + 0.7)
    return rounded(rng.standard_normal((n, m)) @ root.T, step)


def with_copies(y: Floats) -> Floats:
    """Return outputs whose last fifth repeats the first."""
    copies = len(y) // 5
    return np.concatenate([y[:-copies], y[:copies]])


def codes(y: Floats, **arguments: object) -> list[str]:
    options = DataCheckOptions(draws=199)
    return [finding.code for finding in data_findings(y, options=options, **arguments)]  # type: ignore[arg-type]


# Resolution: size 0 of 8000, power 1.00.


def test_continuous_values_have_no_step() -> None:
    for n in (3, 20, 200):
        rng = np.random.default_rng(n)
        assert not any(resolution(rng.normal(10, 1, n)) for _ in range(300))


@pytest.mark.parametrize("step", [0.1, 0.25, 0.5, 1.0])
def test_the_step_of_rounded_values_is_identified(step: float) -> None:
    rng = np.random.default_rng(0)
    found = [resolution(rounded(rng.normal(10, 1, 50), step)) for _ in range(100)]
    assert found == pytest.approx([step] * 100)


@pytest.mark.parametrize(
    ("values", "step"),
    [
        (lambda y: 273.15 + y, 0.1),
        (lambda y: 25.4e6 * y, 2.54e6),
        (lambda y: -y[::-1], 0.1),
        (lambda y: [0.0, 0.2, 0.5, 1.1, 1.4], 0.1),  # the smallest gap is several steps
        (lambda y: [], 0.0),
        (lambda y: [1.0, 2.0], 0.0),
        (lambda y: [3.0] * 9, 0.0),
        (lambda y: [1.0, 1.0, 2.0], 0.0),
        (lambda y: [0.1, 0.1 + 1e-16, 0.1], 0.0),
    ],
)
def test_steps_with_offsets_units_and_few_values(
    values: Callable[[Floats], Floats], step: float
) -> None:
    y = np.random.default_rng(1).normal(10, 1, 40).round(1)
    assert resolution(np.array(values(y))) == pytest.approx(step)


def test_a_turning_point_lowers_the_largest_step() -> None:
    rng = np.random.default_rng(3)
    y = rng.normal(10, 1, 50)
    assert codes(y.round(1)) == []  # .1 sd
    assert codes(y.round(1), several_roots=True) == ["rounded-data"]
    assert codes(y.round(1), several_roots=True, rounded=0.1) == []
    for digits in (3, 4):  # printed with many digits
        assert "rounded-data" not in codes(y.round(digits), several_roots=True)


# Ends of the sample.


def test_exact_values_of_any_population_have_no_pile() -> None:
    rng = np.random.default_rng(5)
    for n in (3, 20, 50):
        for y in (rng.normal(size=(100, n)), rng.exponential(size=(100, n))):
            assert all(min(count_at_ends(v)[1]) == 1 for v in y)


def test_either_end_counts_in_any_unit() -> None:
    y = np.minimum(np.random.default_rng(7).standard_normal(30), 0.5)
    counts, p_values = count_at_ends(y)
    assert counts.tolist() == [np.sum(y == 0.5), 1]
    assert p_values[0] <= 0.05 < p_values[1]
    mirrored = count_at_ends(-1000 * y[::-1])
    np.testing.assert_array_equal(mirrored, [counts[::-1], p_values[::-1]])


def test_a_tie_at_a_fine_step_may_be_chance() -> None:
    # The binomial test alone has p = .0003: an end always has at least one value.
    y = np.sort(rounded(np.random.default_rng(22).standard_normal(30), 0.01))
    y[-2] = y[-1]
    counts, p_values = count_at_ends(y, 0.01)
    assert counts.tolist() == [2, 1]
    assert p_values[0] > 0.005


def test_rounded_values_of_skewed_populations_rarely_have_a_pile() -> None:
    rng = np.random.default_rng(12)
    folded = (rng.normal(2, 0.5, (60, 50)) - 1) ** 2
    for y in (folded, np.exp(rng.standard_normal((60, 50)))):
        step = 0.1 * y.std()
        p = [min(count_at_ends(rounded(v, step), step, 99)[1]) for v in y]
        # at most .04 in the table; standard error .025. The bootstrap alone flags .5 to .95.
        assert np.mean(np.array(p) <= 0.05) <= 0.15


@pytest.mark.slow
def test_the_table_of_rounded_ends() -> None:
    table = {
        "normal": [(0.01, 0.01), (0.01, 0.00), (0.00, 0.00)],
        "folded": [(0.03, 0.04), (0.01, 0.01), (0.00, 0.00)],
        "lognormal": [(0.02, 0.04), (0.02, 0.00), (0.00, 0.00)],
        "exponential": [(0.02, 0.02), (0.01, 0.00), (0.00, 0.00)],
        "beta": [(0.27, 0.52), (0.20, 0.40), (0.04, 0.05)],
        "censored 10": [(0.25, 0.61), (0.06, 0.20), (0.01, 0.01)],
        "censored 30": [(0.89, 1.00), (0.47, 0.86), (0.24, 0.51)],
    }
    rng = np.random.default_rng(13)
    draw: dict[str, Callable[[tuple[int, int]], Floats]] = {
        "normal": lambda shape: rng.standard_normal(shape),
        "folded": lambda shape: (rng.normal(2, 0.5, shape) - 1) ** 2,
        "lognormal": lambda shape: np.exp(rng.standard_normal(shape)),
        "exponential": lambda shape: rng.exponential(size=shape),
        "beta": lambda shape: rng.beta(0.5, 0.5, shape),
        "censored 10": lambda shape: np.minimum(rng.standard_normal(shape), 1.2816),
        "censored 30": lambda shape: np.minimum(rng.standard_normal(shape), 0.5244),
    }
    for name, rows in table.items():
        sd = 1.0 if "censored" in name else draw[name]((1000, 100)).std()
        for step, row in zip((0.1, 0.25, 0.5), rows, strict=True):
            for n, rate in zip((20, 50), row, strict=True):
                y = rounded(draw[name]((300, n)), step * sd)
                p = [min(count_at_ends(v, step * sd)[1]) for v in y]
                # standard error of the difference of two shares at most .041; less near 0
                se = np.sqrt(2 * max(rate * (1 - rate), 0.01) / 300)
                assert np.mean(np.array(p) <= 0.05) == pytest.approx(rate, abs=4.5 * se), name


# Identical specimens.


def test_identical_specimens_are_groups_of_indices() -> None:
    y = np.array([[1, 2], [3, np.nan], [1, 2], [np.nan, np.nan], [3, np.nan], [1, 2], [1, np.nan]])
    assert identical_specimens(y) == ((0, 2, 5), (1, 4))
    assert identical_specimens(np.full((4, 2), np.nan)) == ()


def one_output(rng: np.random.Generator) -> Floats:
    y = rng.standard_normal(30)
    y[:6] = np.sort(y)[-6:]  # the largest one twice, as five others
    return y


def with_the_largest_twice(rng: np.random.Generator) -> Floats:
    y = correlated(rng, 20, 2)
    y[4] = y[y[:, 0].argmax()]
    return y


@pytest.mark.parametrize(
    "draw", [one_output, with_the_largest_twice, lambda rng: with_copies(correlated(rng, 20, 2))]
)
def test_copies_are_no_pile(draw: Callable[[np.random.Generator], Floats]) -> None:
    rng = np.random.default_rng(8)
    assert all(codes(draw(rng)) == ["identical-specimens"] for _ in range(15))


# All checks together.


def test_size_of_all_checks() -> None:
    rng = np.random.default_rng(17)
    assert not any(codes(correlated(rng, 20, 2)) for _ in range(30))
    counts = Counter(code for _ in range(30) for code in set(codes(correlated(rng, 50, 2, 0.1))))
    # about .04; standard error .04
    assert counts.total() / 30 <= 0.2


def test_texts_of_findings() -> None:
    rng = np.random.default_rng(4)
    (step,) = data_findings(rounded(rng.normal(10, 1, 50), 0.5), labels=["length"])
    assert step.text.startswith("length: got values that are all multiples of a step of 0.5 ")
    assert step.text.endswith("pass rounded=0.5.")
    y = np.minimum(rng.normal(10, 1, 30), 10.5)
    (end,) = data_findings(y)
    assert f"got {np.sum(y == 10.5)} of 30 values equal to the largest, 10.5" in end.text
    assert "pass censored=(None, 10.5)" in end.text
    y = rng.standard_normal((20, 2))
    y[17] = y[3]
    (copies,) = data_findings(y)
    assert copies.text.startswith("Got specimens 3 and 17 (counted from 0) with identical values")
    assert "groups more" in data_findings(np.concatenate([y, y]))[0].text


def test_order_and_units_do_not_matter() -> None:
    rng = np.random.default_rng(18)
    y = with_copies(correlated(rng, 30, 2))
    y[:, 1] = np.minimum(y[:, 1], 0.5)
    for data in (y, y[rng.permutation(30)], 1e-6 * y, 1e6 * y):
        assert sorted(codes(data)) == ["censored-data", "identical-specimens"]
    # Values at a limit are not repeated specimens.
    censored = correlated(rng, 30, 2)
    censored[:, 0] = np.minimum(censored[:, 0], 0.3)
    assert codes(censored) == ["censored-data"]
    assert set(codes(np.full(10, 3.0))) == {"censored-data"}


def test_missing_values_are_left_out() -> None:
    y = correlated(np.random.default_rng(19), 40, 3)
    y[:20, 0] = np.nan
    y[:, 2] = np.nan
    assert codes(y) == []
    y[:, 1] = rounded(y[:, 1], 0.5)
    assert data_findings(y)[0].text.startswith("observed[1]: got values that are all")
    y[0, 1] = np.inf  # a specimen that failed
    assert data_findings(y)[0].text.startswith("observed[1]: got values that are all")
    for n in (1, 2, 3):
        assert data_findings(np.arange(n) ** 0.5) == ()
        assert data_findings(np.full((n, 2), np.nan)) == ()


# Data beside the first responses.

RNG = np.random.default_rng(0)
SIMULATED = RNG.normal(size=(64, 2)) * [1, 2]
MEASURED = RNG.normal(size=(20, 2))


@pytest.fixture
def logged(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.WARNING, logger="prbayes")
    return caplog


def test_data_beyond_all_responses_are_reported(logged: pytest.LogCaptureFixture) -> None:
    warn_out_of_range("y", np.add(np.abs(MEASURED), [0.0, 1e4]), SIMULATED, ["a", "b"])
    assert "y[b]: got observed values from 1e+04 to 1e+04, all above the first 64" in logged.text
    logged.clear()
    warn_out_of_range("y", -9.0 - np.abs(MEASURED[:, 0]), SIMULATED[:, 0], [])
    assert "y: got observed values from -" in logged.text
    assert "all below the first 64 responses" in logged.text


@pytest.mark.parametrize("m", [1, 2])
def test_a_change_beyond_the_ninth_digit_is_no_exact_constant(m: int) -> None:
    values = 1e12 + SIMULATED[:40, :m]
    message = r"constant to nine digits: got 1e\+12 at all 40 runs .* range of [1-9].*subtract"
    with pytest.raises(DesignError, match=message) as by_metric:
        check_constant("y", values, ["a", "b"][: m if m > 1 else 0], True)
    with pytest.raises(DesignError, match=message) as by_specimen:
        refuse_unreachable("y", values, Readings.exact(values[:20]))
    for caught in (by_metric, by_specimen):
        assert ("leave the output out" in str(caught.value)) == (m > 1)


@pytest.mark.parametrize("kind", ["error", "relative"])
def test_an_output_that_is_constant_has_readings_of_its_error(kind: str) -> None:
    values = np.stack([SIMULATED[:40, 0], np.full(40, 10.0)], axis=1)
    exact = Readings.exact(values[:20])
    refuse_unreachable("y", values, replace(exact, **{kind: np.full((20, 2), 0.1)}))
    with pytest.raises(DesignError, match="output 1 of 2: the response is constant"):
        refuse_unreachable("y", values, exact)


def test_limits_of_zero_have_no_scale() -> None:
    values = np.stack([SIMULATED[:40, 0], -1e-6 * np.arange(40)], axis=1)
    exact = Readings.exact(values[:20])
    lower = np.where([False, True], -np.inf, np.full((20, 2), np.nan))
    for limit in (0.0, 4e-5):
        upper = np.where([False, True], limit, lower)
        censored = np.where([False, True], np.nan, exact.values)
        readings = replace(exact, values=censored, lower=lower, upper=upper)
        if limit:
            refuse_unreachable("y", values, readings)
            continue
        refuse_unreachable("y", values, replace(readings, error=np.full((20, 2), 0.1)))
        with pytest.raises(DesignError, match=r"output 1 of 2: got .* censored at 0.*add 3.9e-05"):
            refuse_unreachable("y", values, readings)


def test_constant_responses_that_are_stored_are_refused() -> None:
    message = (
        r"y: the response is constant .* got 1 at all 3 runs .*; check the .*, or take more runs"
    )
    with pytest.raises(DesignError, match=message):
        check_constant("y", np.ones(3), [], True)
    with pytest.raises(DesignError, match=r"y\[b\]: the .* constant .* got 0 at all 40 runs"):
        check_constant("y", np.stack([SIMULATED[:40, 0], np.zeros(40)], 1), ["a", "b"], True)
    with pytest.raises(DesignError, match="at all 24 runs"):
        check_constant("y", np.where(np.arange(64) < 24, 5.0, np.nan), [], True)


def test_constant_responses_that_are_simulated_again_are_reported() -> None:
    (finding,) = check_constant("y", np.ones(16), [], False)  # counts may be equal by chance
    assert finding.code == "constant-response"


@pytest.mark.parametrize("is_stored", [True, False])
def test_other_responses_are_not_constant(is_stored: bool) -> None:
    for values in (
        1 + 1e-6 * SIMULATED[:, 0],
        np.where(np.arange(64) < 40, 5.0, np.inf),  # data may be failures
        np.empty(0),
        np.ones(1),
        np.array([5.0, np.nan, np.nan]),
    ):
        assert not check_constant("y", values, [], is_stored)
    assert not check_constant("y", SIMULATED, ["a", "b"], is_stored)


@pytest.mark.parametrize(
    ("observed", "simulated"),
    [
        (MEASURED, SIMULATED),
        (1000 * MEASURED, SIMULATED),
        (np.ones(5), np.empty(0)),
        (np.ones((5, 2)), np.empty((0, 2))),
        (np.full(5, 99.0), np.zeros(15)),  # too few for a range
        (np.full(5, np.inf), np.zeros(64)),  # all failed
    ],
)
def test_data_around_few_or_many_responses_are_not_reported(
    observed: Floats, simulated: Floats, logged: pytest.LogCaptureFixture
) -> None:
    warn_out_of_range("y", observed, simulated, ["a", "b"][: simulated.ndim * 2 - 2])
    assert not logged.records


@pytest.mark.parametrize(
    "values", [MEASURED[:, 0], MEASURED, MEASURED[:, 0].round(3), 0.001 * np.arange(20) ** 2]
)
def test_duplicates_of_all_specimens_are_reported(values: Floats) -> None:
    (finding,) = duplicate_findings("y", np.concatenate([values, values[::-1]]))
    assert "y: got 40 observed values of which only 20 are different" in finding.text


@pytest.mark.parametrize(
    "values",
    [
        MEASURED[:, 0],
        np.append(MEASURED[:, 0], MEASURED[:3, 0]),  # some of them
        RNG.binomial(4, 0.5, 60),  # counts
        np.repeat([3, 5, 8], 4),
        np.repeat([300, 500, 800], 4),  # of hundreds
        RNG.normal(size=400).round(1).clip(-1, 1),  # rounded readings
        np.full(9, 2.5),  # all equal
        [1.0, 1.0, 2.0, 2.0],  # few
    ],
    ids=["once", "some", "counts", "other counts", "hundreds", "rounded", "equal", "few"],
)
def test_ties_by_chance_are_no_duplicates(values: Floats) -> None:
    assert not duplicate_findings("y", np.asarray(values, dtype=float))


@pytest.mark.parametrize("code", [-999.0, -9999.0, 9999.0])
def test_codes_of_missing_values_are_reported_whatever_the_responses(code: float) -> None:
    values = np.append(RNG.normal(3, 0.1, 24), code)
    (finding,) = outlier_findings("y", values, np.empty(0), [])
    assert f"y: got 1 of 25 observed values far from all others, {code:g}: such" in finding.text
    (finding,) = outlier_findings(
        "y", np.stack([values, values[::-1] ** 0], 1), SIMULATED, ["a", "b"], gross_errors=True
    )
    assert finding.text.startswith("y[a]: got 1 of 25")


def test_values_apart_from_data_and_responses_are_reported() -> None:
    values, responses = RNG.normal(3.1, 0.1, 25), RNG.normal(3, 1, 128)
    values[[3, 7]] = 31.4, 31.0
    (finding,) = outlier_findings("y", values, responses, [])
    assert "got 2 of 25 observed values far from all others and outside the" in finding.text
    assert "128 responses, 31, 31.4: look at units" in finding.text
    assert not outlier_findings("y", values, 10 * responses, [])
    assert not outlier_findings("y", values, responses, [], gross_errors=True)
    assert not outlier_findings("y", values, responses[:15], [])  # too few for a range
    (finding,) = outlier_findings("y", -values, -responses, [])
    assert "-31.4, -31: look at units" in finding.text


@pytest.mark.parametrize(
    "draw",
    [
        lambda rng: rng.normal(size=25),
        lambda rng: np.exp(rng.normal(size=25)),
        lambda rng: rng.standard_t(3, 25),
        lambda rng: 1000 + rng.poisson(2, 25),
        lambda rng: np.append(rng.uniform(500, 1500, 24), 999),
    ],
    ids=["normal", "lognormal", "t", "counts", "a number that is a code"],
)
def test_tails_are_no_outliers(draw: Callable[[np.random.Generator], Floats]) -> None:
    """The rate of alarms is below .3 %, also with responses around the median alone."""
    rng = np.random.default_rng(4)
    alarms = 0
    for _ in range(200):
        values = draw(rng)
        responses = np.median(values) + 1e-3 * rng.normal(size=64)
        alarms += len(outlier_findings("y", values, responses, []))
    assert alarms <= 2


def test_a_metric_that_a_code_spoils_names_it() -> None:
    values = np.append(RNG.normal(3, 0.1, 24), -999)
    message = r"span below .*got 1 of 25 .*, -999: such"
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 3, 1), 0.1)
        with pytest.raises(ValueError, match=message):
            prb.Simulator("y", np.positive, x, metric=prb.ProbabilityResidual(), observed=values)


def fitted(response: Any, values: Any, metric: prb.Metric, **given: Any) -> dict[str, str]:
    """Return the texts of findings about an optimum by code."""
    model = one_input(values, metric, response=response, mu=(3, 1), sigma=0.5, **given)
    findings = prb.minimize(model, starts=0, progressbar=False).findings
    return {finding.code: finding.text for finding in findings}


def test_an_optimum_reports_codes() -> None:
    values = np.append(RNG.normal(3, 0.1, 24), -999)
    propagation = prb.Reweighted(64)
    assert "outlying-data" in fitted(np.positive, values, prb.AreaMetric(), propagation=propagation)


@pytest.mark.long
@pytest.mark.parametrize(
    ("given", "advice"),
    [
        ({}, "or pass gross_errors=True beside the other arguments of prb.LogLikelihood."),
        ({"gross_errors": True}, None),
        ({"selected": (0.0, None)}, "or keep them as part of the population."),
    ],
)
def test_the_advice_for_an_outlier_keeps_the_other_arguments(
    given: dict[str, Any], advice: str | None
) -> None:
    values = np.append(RNG.normal(3, 0.1, 24), 500.0)
    texts = fitted(np.positive, values, prb.LogLikelihood(error=0.1, **given))
    assert ("outlying-data" in texts) == (advice is not None)
    assert advice is None or texts["outlying-data"].endswith(advice)


@pytest.mark.long
def test_a_misfit_of_many_outputs_is_one_number() -> None:
    t = np.linspace(0.1, 1, 200)
    values = RNG.normal(3, 0.1, (12, 1)) * t + RNG.normal(0, 0.1, (12, 200))
    text = fitted(lambda x: x[..., None] * t, values, prb.LogLikelihood())["readings-misfit"]
    assert "which are off by up to 0.1" in text
    assert len(text) < 500


# -- repeated readings -----------------------------------------------------------------------------


def scattered(error: float, n: int, count: int = 3, outlier: float = 0.0) -> Repeats:
    """Return repeated readings of n specimens with two outputs, in units of the stated error."""
    y = error * np.random.default_rng(1).standard_normal((n, count, 2))
    y[0, 0, 1] += outlier
    within = ((y - y.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
    return Repeats(np.full((n, 2), count - 1.0), within, np.zeros((n, 2)))


def test_repeated_readings_that_scatter_more_than_their_error_are_reported() -> None:
    for given in (
        scattered(1.0, 15),
        scattered(0.01, 15),
        scattered(1.0, 5000),
        scattered(1.3, 15),
    ):
        assert repeat_findings("y", given) == []
    (wrong,) = repeat_findings("y", scattered(4.0, 15))
    assert wrong.code == "readings-misfit"
    assert "repeated readings of the specimens scatter more than their error: by 3.7" in wrong.text
    (single,) = repeat_findings("y", scattered(1.0, 15, outlier=100.0))
    assert "readings of 1 of 15 specimens" in single.text


@pytest.mark.long
def test_an_impossible_repeated_reading_is_reported_by_the_optimum() -> None:
    rng = np.random.default_rng(2)
    y = np.repeat(rng.normal(1, 0.5, 8), 3) + rng.normal(0, 0.1, 24)
    y[4] *= 10

    for gross_errors in (False, True):
        metric = prb.LogLikelihood(error=0.1, gross_errors=gross_errors)
        texts = fitted(np.positive, y, metric, specimens=np.repeat(np.arange(8), 3))
        assert ("readings-misfit" in texts) is not gross_errors
