"""The u-values of a validity test against their envelope."""

from functools import cache
from typing import Any

import figure_reader as read
import numpy as np
import pytest

import prbayes as prb
from prbayes.plots.validity import _between, in_directions

RNG = np.random.default_rng(1)
PREDICTED = RNG.normal(RNG.normal(0, 0.25, (200, 1)), 1.0, (200, 500))
FRESH = RNG.normal(0, 1, 20)
QUICK = prb.validation.PosteriorNull(999)


@cache
def validity(shift: float = 0.0, folded: bool = False) -> prb.validation.ValidityTest:
    return prb.area_test(FRESH + shift, PREDICTED, null=QUICK, folded=folded)


def polygon(artist: Any) -> np.ndarray[Any, Any]:
    return np.asarray(artist.get_paths()[0].vertices)


def shoelace(corners: np.ndarray[Any, Any]) -> float:
    """The area of a polygon whose loops all turn the same way."""
    x, y = corners.T
    return float(abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2)


# -- plot_validity ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("shift", "folded"), [(0.0, False), (1.2, False), (0.0, True)])
def test_the_shaded_area_is_the_statistic(shift: float, folded: bool) -> None:
    test = validity(shift, folded)
    pc = prb.plots.plot_validity(test)
    assert shoelace(polygon(read.artist(pc, "area", "u"))) == pytest.approx(
        test.statistic, abs=1e-9
    )
    line = read.artist(pc, "ecdf", "u")
    tested = np.abs(2 * test.u_values - 1) if folded else test.u_values
    x, y = line.get_xdata(), line.get_ydata()
    np.testing.assert_allclose(np.interp(0.5, x, y), (tested <= 0.5).mean(), atol=1e-12)
    np.testing.assert_array_equal(read.xy(pc, "identity", "u")[0], [0, 1])


def test_the_verdict_stands_in_the_title() -> None:
    for shift, verdict, sign in ((0.0, "not rejected", "<"), (1.2, "rejected", ">")):
        test = validity(shift)
        axis = prb.plots.plot_validity(test).axes[0]
        expected = f"area {test.statistic:.3f} {sign} critical {test.critical_value:.3f}: {verdict}"
        assert axis.get_title() == f"p = {test.p_value:.2g}, level 5%\n{expected}"
        assert axis.get_xlabel() == "u-value"
    assert prb.plots.plot_validity(validity(0.0, True)).axes[0].get_xlabel() == "|2u - 1|"
    # Several tests have a panel each.
    small = prb.area_test(FRESH[:7], PREDICTED, null=QUICK)
    pc = prb.plots.plot_validity({"all": validity(), "some": small})
    assert [axis.get_title().split(",")[0] for axis in pc.axes] == ["all", "some"]
    assert [axis.get_ylabel() for axis in pc.axes] == ["share of 20 values", "share of 7 values"]


def test_the_envelope_holds_the_ecdf_of_a_right_model() -> None:
    for shift, inside in ((0.0, True), (1.2, False)):
        test = validity(shift)
        path = read.artist(prb.plots.plot_validity(test), "envelope", "u").get_paths()[0]
        v = np.linspace(0.011, 0.989, 200)
        low, high = (np.searchsorted(test.envelope[i], v, side="right") / 20 for i in (1, 0))
        ecdf = np.searchsorted(np.sort(test.u_values), v, side="right") / 20
        assert ((low <= ecdf) & (ecdf <= high)).all() == inside
        middle = path.contains_points(np.column_stack([v, (low + high) / 2 + 1e-9]))
        assert middle[high > low].all()
        assert not path.contains_points(np.column_stack([v, high + 0.03]))[high < 0.96].any()


# -- several outputs -------------------------------------------------------------------------------


@cache
def of_outputs(folded: bool = False) -> prb.validation.ValidityTest:
    rng = np.random.default_rng(1)
    predicted = rng.normal(rng.normal(0, 0.25, (100, 1, 2)), 1.0, (100, 200, 2))
    observed = {"a": rng.normal(0, 1, (12, 2)), "b": rng.normal(0, 1, 9)}
    both = {"a": predicted, "b": predicted[..., 0]}
    return prb.area_test(observed, both, null=prb.validation.PosteriorNull(99), folded=folded)


@pytest.mark.parametrize("folded", [False, True])
def test_outputs_have_a_line_for_each_direction_and_no_band_of_another_statistic(
    folded: bool,
) -> None:
    test = of_outputs(folded)
    pc = prb.plots.plot_validity(test)
    expected = {"identity", "folded"} if folded else {"identity", "folded", "ecdf"}
    gids = {artist.get_gid() for artist in pc.findobj()}
    assert gids & {"area", "envelope", "identity", "ecdf", "folded"} == expected
    # The areas of the lines make the statistic, shared by numbers of values
    directions = in_directions(test)
    assert [u.size for u in directions] == [12] * len(directions)
    alone = test.u_values[test.conditions == "b"]
    mean = 0.0
    for line in expected - {"identity"}:
        x, y = read.xy(pc, line, "u")
        parts = np.split(np.arange(x.size), np.flatnonzero(np.isnan(x)))
        # Of one output the area of u alone
        drawn = [alone, *directions] if folded or line == "ecdf" else directions
        for part, u in zip(parts, drawn, strict=True):
            known = part[~np.isnan(x[part])]
            at, low, high = _between(x[known], y[known])
            area = np.trapezoid(high - low, at)
            share = 1.0 if folded or u is alone else 0.5
            mean += area * share * u.size / test.u_values.size
    assert mean == pytest.approx(test.statistic, rel=1e-9)


def test_the_title_of_outputs_has_the_mean_area_and_p() -> None:
    test = of_outputs()
    axis = prb.plots.plot_validity(test).axes[0]
    assert axis.get_title().startswith(f"p = {test.p_value:.2g}, level 5%\nmean area 0.")
    assert axis.get_ylabel() == f"share of values in each of {len(in_directions(test))} directions"
    assert in_directions(validity()) == []
