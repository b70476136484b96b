"""Bands of distribution functions beside those of the posterior's own populations."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from decisions import OBSERVED, doubled, jeffreys, normal, same
from scipy.special import ndtr

import prbayes as prb
from prbayes.decision.p_box import _distribution_functions
from prbayes.decision.populations import Populations

DRAWS = 999
POSTERIOR = jeffreys(OBSERVED, DRAWS)
MU, SIGMA = (POSTERIOR.posterior[name].values[0] for name in ("mu", "sigma"))


def box(response: Any = same, *more: Any, **given: Any) -> xr.Dataset:
    model, x = normal()
    return prb.decision.p_box(POSTERIOR, response, x, *more, model=model, **given)


def functions(y: Any) -> Any:
    return ndtr((y - MU[:, None]) / SIGMA[:, None])


@pytest.mark.parametrize("prob", [0.9, pytest.param(0.5, marks=pytest.mark.slow)])
def test_bands_hold_what_they_say(prob: float) -> None:
    found = box(prob=prob)
    each = functions(found.y.values)
    pointwise = found.sel(band="pointwise")
    expected = np.quantile(each, [(1 - prob) / 2, (1 + prob) / 2], axis=0)
    np.testing.assert_allclose([pointwise.lower, pointwise.upper], expected, atol=0.01)
    entire = found.sel(band="simultaneous")
    model, x = normal()
    populations = Populations.of(POSTERIOR, model, DRAWS, "prb.decision.p_box")
    own = _distribution_functions(populations.sample(same, (x,), None), found.y.values)
    np.testing.assert_allclose(own, each, atol=0.012)
    inside = (entire.lower.values <= own) & (own <= entire.upper.values)
    # Draws are left out by the same number on both sides, at each of their places.
    assert prob <= inside.all(axis=1).mean() < prob + 0.03
    np.testing.assert_allclose(found["mean"], each.mean(axis=0), atol=0.01)


def test_bands_are_distribution_functions_and_nested() -> None:
    found = box()
    for key in ("lower", "upper"):
        assert (np.diff(found[key].values, axis=1) >= 0).all()
    wide, narrow = found.sel(band="simultaneous"), found.sel(band="pointwise")
    assert (wide.lower <= narrow.lower).all()
    assert (narrow.upper <= wide.upper).all()
    assert float(found["mean"][0]) < 1e-3
    assert float(found["mean"][-1]) > 1 - 1e-3


def test_a_unit_moves_the_places_alone() -> None:
    one, two = box(), box(doubled)
    np.testing.assert_allclose(two.y, 2 * one.y)
    np.testing.assert_allclose(two.lower, one.lower)


def test_an_interval_widens_to_both_ends() -> None:
    def shifted(x: Any, by: float) -> Any:
        return x + by

    found = box(shifted, prb.decision.Interval(-0.5, 0.5))
    y = found.y.values
    low, high = functions(y - 0.5).mean(axis=0), functions(y + 0.5).mean(axis=0)
    np.testing.assert_allclose(found["mean"], low, atol=0.012)
    np.testing.assert_allclose(found.mean_upper, high, atol=0.012)
    assert (found.lower.sel(band="pointwise") <= low + 0.01).all()
    assert (found.upper.sel(band="pointwise") >= high - 0.01).all()


def test_a_value_counts_where_it_is() -> None:
    found = box(np.round)
    y = found.y.values
    whole = np.isclose(y, 1.0)
    assert whole.any()
    expected = ndtr((1.5 - MU) / SIGMA).mean()
    assert float(found["mean"].values[whole][0]) == pytest.approx(expected, abs=0.01)


def test_specimens_that_failed_are_above_all_others() -> None:
    found = box(lambda x: np.where(x > 1.0, np.inf, x))
    last = float(found["mean"][-1])
    assert last == pytest.approx(float(ndtr((1.0 - MU) / SIGMA).mean()), abs=0.02)
