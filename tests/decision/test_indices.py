"""Indices beside closed forms, and beside SALib where it is installed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.decision.indices import Indices, derivative_bound, first_order, total_order

# Sobol' indices of Ishigami's function with 7 and 0.1 (Ishigami and Homma 1990).
VARIANCE = 49 / 8 + 0.1 * np.pi**4 / 5 + 0.01 * np.pi**8 / 18 + 0.5
FIRST = np.array([0.5 * (1 + 0.1 * np.pi**4 / 5) ** 2, 49 / 8, 0.0]) / VARIANCE
BOTH = 0.01 * np.pi**8 * (1 / 18 - 1 / 50) / VARIANCE
TOTAL = FIRST + BOTH * np.array([1, 0, 1])
R, SIZE = 16, 4096


def ishigami(x: Floats) -> Any:
    a, b, c = np.moveaxis(x, -1, 0)
    return np.sin(a) + 7 * np.sin(b) ** 2 + 0.1 * c**4 * np.sin(a)


def matched(seed: int = 0) -> tuple[Floats, list[Floats], list[Floats]]:
    """Return points, and for each factor points that share it, and points that share all others."""
    here, elsewhere = np.random.default_rng(seed).uniform(-np.pi, np.pi, (2, R, SIZE, 3))
    same, other = [], []
    for i in range(3):
        pick = np.arange(3) == i
        same.append(np.where(pick, here, elsewhere))
        other.append(np.where(pick, elsewhere, here))
    return here, same, other


@pytest.fixture(scope="module")
def indices() -> Indices:
    here, same, other = matched()
    y = ishigami(here)
    first = np.transpose([first_order(y, ishigami(x)) for x in same])
    total = np.transpose([total_order(y, ishigami(x)) for x in other])
    return Indices.of(first, total, total)


def test_ishigami(indices: Indices) -> None:
    assert (np.abs(indices.first - FIRST) < 5 * indices.first_error).all()
    assert (np.abs(indices.total - TOTAL) < 5 * indices.total_error).all()
    assert (indices.first_error < 0.01).all()
    assert (indices.total_error < 0.01).all()


def test_ishigami_beside_salib(indices: Indices) -> None:
    pytest.importorskip("SALib")
    from SALib.analyze import sobol
    from SALib.sample import sobol as design

    problem = {"num_vars": 3, "names": ["a", "b", "c"], "bounds": [[-np.pi, np.pi]] * 3}
    x = design.sample(problem, 4096, calc_second_order=False, seed=1)
    theirs = sobol.analyze(problem, ishigami(x), calc_second_order=False, seed=1)
    for ours, error, key in (
        (indices.first, indices.first_error, "S1"),
        (indices.total, indices.total_error, "ST"),
    ):
        # Their intervals are 95% ones.
        both = np.hypot(error, np.array(theirs[f"{key}_conf"]) / 1.96)
        assert (np.abs(ours - theirs[key]) < 5 * both).all()


def test_estimators_on_the_same_points_as_salib() -> None:
    pytest.importorskip("SALib")
    from SALib.analyze import sobol

    here, _, other = matched(1)
    base, mixed = ishigami(here[0]), [ishigami(x[0]) for x in other]
    theirs = sobol.total_order(base, mixed[0], base)
    # They divide by the variance of the first set alone.
    ours = total_order(base[None], mixed[0][None])
    np.testing.assert_allclose(ours, theirs, rtol=0.1)


def test_a_linear_function_has_shares_that_sum_to_one_and_equal_bounds() -> None:
    rng = np.random.default_rng(2)
    slopes = np.array([1.0, -2.0, 0.0])
    z, fresh = rng.normal(size=(2, R, SIZE, 3))
    y = z @ slopes
    for i, expected in enumerate(slopes**2 / 5):
        only, without = fresh.copy(), z.copy()
        only[..., i], without[..., i] = z[..., i], fresh[..., i]
        first = first_order(y, only @ slopes)
        total = total_order(y, without @ slopes)
        bound = derivative_bound(np.full_like(y, slopes[i] ** 2), y)
        for found in (first, total, bound):
            assert abs(found.mean() - expected) <= 5 * found.std(ddof=1) / np.sqrt(R) + 1e-12


def test_shares_do_not_depend_on_unit_and_zero() -> None:
    here, same, other = matched(3)
    y = ishigami(here)
    for function, points in ((first_order, same[0]), (total_order, other[0])):
        np.testing.assert_allclose(
            function(1e6 + 3 * y, 1e6 + 3 * ishigami(points)),
            function(y, ishigami(points)),
            rtol=1e-6,
        )


def test_what_is_not_known_is_left_out_and_what_does_not_vary_has_no_share() -> None:
    rng = np.random.default_rng(4)
    y, other = rng.normal(size=(2, 1, 1000))
    gone = other.copy()
    gone[:, :500] = np.nan
    np.testing.assert_allclose(first_order(y, gone), first_order(y[:, 500:], other[:, 500:]))
    np.testing.assert_allclose(total_order(y, gone), total_order(y[:, 500:], other[:, 500:]))
    assert np.isnan(first_order(np.ones((1, 9)), np.ones((1, 9))))
