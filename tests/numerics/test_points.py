"""Points of the unit cube."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest

from prbayes.numerics.points import base_points, monte_carlo, points_from, sobol
from prbayes.response.inputs import read_inputs


@pytest.mark.parametrize("points", [sobol, monte_carlo])
@pytest.mark.parametrize("n", [1, 2, 100, 128])
def test_points_are_inside_the_open_cube_and_the_same_for_a_seed(points: Any, n: int) -> None:
    found = points(n, 3, 7)
    assert found.shape == (n, 3)
    assert (found > 0).all()
    assert (found < 1).all()
    np.testing.assert_array_equal(found, points(n, 3, 7))
    assert not np.array_equal(found, points(n, 3, 8))


def test_each_cell_of_a_dyadic_grid_holds_one_sobol_point() -> None:
    found = sobol(64, 2, 0)
    for split in ((64, 1), (8, 8), (1, 64)):
        cells = (found * split).astype(int)
        assert len(np.unique(cells, axis=0)) == 64


def test_random_points_leave_cells_empty() -> None:
    cells = (monte_carlo(64, 2, 0) * 8).astype(int)
    assert len(np.unique(cells, axis=0)) < 64


def test_points_by_name_or_by_function() -> None:
    assert points_from("sobol") is sobol
    assert points_from("monte_carlo") is monte_carlo
    assert points_from(np.empty) is np.empty
    with pytest.raises(ValueError, match="got 'halton', expected \"sobol\""):
        points_from("halton")
    with pytest.raises(TypeError, match="points: got int"):
        points_from(3)


def test_every_input_gets_columns_of_its_own() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 1)
        one = pm.Normal.dist(mu, 1.0)
        two = pm.MvNormal.dist([0.0, 0.0], np.eye(2))
        inputs = read_inputs("y", [two, one], model)
    spare, (of_two, of_one) = base_points(inputs.event_shapes, 16, 3)
    columns = np.column_stack([spare, of_two, of_one])
    assert of_two.shape == (16, 2)
    assert of_one.shape == (16,)
    np.testing.assert_array_equal(columns, sobol(16, 4, 3))
