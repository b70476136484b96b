"""Matrix forms of log-densities: which distributions have one, and at which points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest

from prbayes.propagation.population_density import ExponentialForm


@pytest.mark.parametrize(
    ("dist", "points"),
    [
        (pm.StudentT.dist(nu=3, mu=0, sigma=1), np.linspace(0.1, 0.9, 50)),
        (pm.Uniform.dist(0, 1), np.linspace(0.1, 0.9, 50)),
        (pm.TruncatedNormal.dist(0, 1, lower=pm.Normal.dist()), np.linspace(0.1, 0.9, 50)),
        (pm.Poisson.dist(3), np.arange(50.0)),
        (pm.Normal.dist(0, 1), np.repeat([0.0, 1.0], 20)),  # points that coincide
        (pm.InverseGamma.dist(3, 1), -np.ones(40)),  # all outside of the support
        (pm.InverseGamma.dist(3, 1), np.full(40, np.nan)),
    ],
)
def test_distributions_and_points_without_a_matrix_form(dist: Any, points: Any) -> None:
    assert ExponentialForm.of([dist], [points]) is None


def test_points_outside_of_a_support_take_no_part() -> None:
    """Those below zero, or above the end of a truncated distribution."""
    points = np.linspace(0.1, 2.0, 40)
    for dist in (pm.HalfNormal.dist(1), pm.Gamma.dist(2, 1), pm.Exponential.dist(1)):
        beside = ExponentialForm.of([dist], [np.concatenate([points, [-1.0, np.nan]])])
        alone = ExponentialForm.of([dist], [points])
        assert beside.is_inside.tolist() == [True] * 40 + [False] * 2
        np.testing.assert_array_equal(beside.statistics[:, :40], alone.statistics)
    truncated = ExponentialForm.of([pm.TruncatedNormal.dist(0, 1, upper=1)], [points])
    assert truncated.is_inside.tolist() == (points <= 1).tolist()
