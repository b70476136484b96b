"""Bands of distribution functions beside those of the posterior's populations."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from decisions import OBSERVED, doubled, jeffreys, normal, same
from scipy.special import ndtr

import prbayes as prb
from prbayes._finding import from_json
from prbayes.decision.p_box import _distribution_functions
from prbayes.decision.populations import Populations

DRAWS = 999
POSTERIOR = jeffreys(OBSERVED, DRAWS)
MU, SIGMA = (POSTERIOR.posterior[name].values[0] for name in ("mu", "sigma"))


def box(response: Any = same, *more: Any, **options: Any) -> xr.Dataset:
    model, x = normal()
    return prb.decision.p_box(POSTERIOR, response, x, *more, model=model, **options)


def functions(y: Any) -> Any:
    return ndtr((y - MU[:, None]) / SIGMA[:, None])


def test_bands_contain_their_share_of_distribution_functions() -> None:
    prob = 0.9
    found = box(prob=prob)
    y = found.y.values
    pointwise, entire = found.sel(band="pointwise"), found.sel(band="simultaneous")
    expected = np.quantile(functions(y), [(1 - prob) / 2, (1 + prob) / 2], axis=0)
    np.testing.assert_allclose([pointwise.lower, pointwise.upper], expected, atol=0.01)
    np.testing.assert_allclose(found["mean"], functions(y).mean(axis=0), atol=0.01)
    model, x = normal()
    populations = Populations.of(POSTERIOR, model, DRAWS, "prb.decision.p_box")
    of_sample = _distribution_functions(populations.sample(same, (x,), None), y)
    np.testing.assert_allclose(of_sample, functions(y), atol=0.012)
    inside = (entire.lower.values <= of_sample) & (of_sample <= entire.upper.values)
    # Draws are left out by the same number on both sides, at each of their places.
    assert prob <= inside.all(axis=1).mean() < prob + 0.03
    # The bands are distribution functions, and nested.
    assert (np.diff([found.lower, found.upper], axis=-1) >= 0).all()
    assert (entire.lower <= pointwise.lower).all()
    assert (pointwise.upper <= entire.upper).all()
    assert float(found["mean"][0]) < 1e-3 < 1 - 1e-3 < float(found["mean"][-1])


def test_tails_without_points_have_a_bound_and_an_error() -> None:
    found = box(lambda x: np.minimum(x, 1.2))
    expected = functions(found.y.values[:-1]).mean(axis=0)
    assert (np.abs(found["mean"][:-1] - expected) < 4 * found.error[:-1] + 1e-4).all()
    # No response is above the last y: the share above is below the bound of the points.
    assert float(found["mean"][-1]) == pytest.approx(1.0)
    low = found.lower.sel(band="pointwise")[-1]
    assert float(low) == pytest.approx(1 + np.log(0.055) * float(found.error[-1]))


def test_a_narrow_extreme_inside_an_interval_is_within_the_bands() -> None:
    interval = prb.decision.Interval(0.0, 1.0)
    found = box(lambda x, k: x / (1 + ((k - 0.37) / 0.05) ** 2), interval, steps=2)
    at_worst = box()
    y = at_worst.y.values
    inner = (y > 0.3) & (y < found.y.values[-1])
    lowest = np.interp(y[inner], found.y, found.lower.sel(band="pointwise"))
    np.testing.assert_allclose(
        lowest, at_worst.lower.sel(band="pointwise").values[inner], atol=0.03
    )


def test_an_interval_widens_to_both_ends() -> None:
    found = box(lambda x, by: x + by, prb.decision.Interval(-0.5, 0.5))
    y = found.y.values
    low, high = functions(y - 0.5).mean(axis=0), functions(y + 0.5).mean(axis=0)
    np.testing.assert_allclose(found["mean"], low, atol=0.012)
    np.testing.assert_allclose(found.mean_upper, high, atol=0.012)
    assert (found.lower.sel(band="pointwise") <= low + 0.01).all()
    assert (found.upper.sel(band="pointwise") >= high - 0.01).all()


def test_other_units_and_equal_and_failed_values() -> None:
    one, two = box(n_draws=50), box(doubled, n_draws=50)
    np.testing.assert_allclose(two.y, 2 * one.y)  # a unit moves the places alone
    np.testing.assert_allclose(two.lower, one.lower)
    rounded = box(np.round)
    (whole,) = rounded["mean"].values[np.isclose(rounded.y, 1.0)][:1]
    assert whole == pytest.approx(ndtr((1.5 - MU) / SIGMA).mean(), abs=0.01)
    # Specimens that failed are above all others.
    last = box(lambda x: np.where(x > 1.0, np.inf, x))["mean"].values[-1]
    assert last == pytest.approx(ndtr((1.0 - MU) / SIGMA).mean(), abs=0.02)


def test_specimens_without_response_may_have_any_value() -> None:
    at = float((MU + 1.8 * SIGMA).mean())
    found = box(lambda x: np.where(x > at, np.nan, x))
    whole = box(lambda x: np.minimum(x, at))
    (finding,) = from_json(found.attrs["findings"])
    assert finding.code == "specimens-left-out"
    y = float(found.y[np.abs(found["mean"].values - 0.9).argmin()])
    k = {"y": y, "method": "nearest"}
    for band in ("pointwise", "simultaneous"):
        lower, upper = (float(found[name].sel(band=band).sel(**k)) for name in ("lower", "upper"))
        complete = float(whole["mean"].interp(y=y))  # all left-out specimens are above y
        assert lower < complete < upper
        # Without them the distribution function would be too high by their share.
        assert lower < float(found["mean"].sel(**k)) * (1 - 0.03)


def test_other_decisions_report_specimens_without_response() -> None:
    at = float((MU + 1.8 * SIGMA).mean())
    model, x = normal()

    def response(x: Any) -> Any:
        return np.where(x > at, np.nan, x)

    table = prb.sensitivity(POSTERIOR, prb.decision.Mean(response, x), model=model)
    codes = [finding.code for finding in from_json(table.attrs["findings"])]
    assert "specimens-left-out" in codes
