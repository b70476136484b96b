"""The calibrated curve and its band."""

import numpy as np

import prbayes as prb
from prbayes.plots._ensemble import Ensemble
from prbayes.plots._populations import calibrated

CURVES = np.arange(11.0)[:, None] * np.array([1.0, -1.0])


def shown(optimum: prb.Optimum, centers: int) -> Ensemble:
    thetas = np.zeros((11 - centers, 2))
    return Ensemble(optimum.evaluator, np.zeros((centers, 2)), thetas, "", "")


def test_the_curve_of_a_posterior_is_the_mean_in_its_band(optimum: prb.Optimum) -> None:
    found = calibrated(CURVES, shown(optimum, 0), 0.8)
    np.testing.assert_allclose(found.middle, [5, -5])
    np.testing.assert_allclose(found.band, [[1, -9], [9, -1]])
    assert found.top == 9


def test_the_curve_of_an_optimum_is_its_own_and_no_part_of_the_band(optimum: prb.Optimum) -> None:
    found = calibrated(CURVES, shown(optimum, 1), 0.8)
    np.testing.assert_allclose(found.middle, [0, 0])
    np.testing.assert_allclose(found.band, [[1.9, -9.1], [9.1, -1.9]])
    alone = calibrated(CURVES[:1], shown(optimum, 1), 0.8)
    assert alone.band is None
    assert alone.top == 0
