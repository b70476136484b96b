"""Points of the unit cube."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from prbayes.numerics.points import base_points, lattice, monte_carlo, points_from, sobol


@pytest.mark.parametrize("points", [sobol, monte_carlo])
@pytest.mark.parametrize("n", [1, 100, 128])
def test_points_are_inside_the_open_cube_and_the_same_for_a_seed(points: Any, n: int) -> None:
    found = points(n, 3, 7)
    assert found.shape == (n, 3)
    assert ((found > 0) & (found < 1)).all()
    np.testing.assert_array_equal(found, points(n, 3, 7))
    assert not np.array_equal(found, points(n, 3, 8))


def test_only_sobol_points_fill_every_cell_of_dyadic_grids() -> None:
    for split in ((64, 1), (8, 8), (1, 64)):
        filled = [
            len(np.unique((points(64, 2, 0) * split).astype(int), axis=0))
            for points in (sobol, monte_carlo)
        ]
        assert filled[0] == 64 > filled[1]


def test_lattices_are_equidistant_along_the_first_coordinate_and_even_in_the_plane() -> None:
    place = np.concatenate([np.arange(50), np.arange(89)])
    points = lattice(place, np.repeat([50, 89], [50, 89]), 2)
    np.testing.assert_allclose(points[:50, 0], np.arange(50) / 50)
    # The golden ratio: no cell of a grid of half as many is empty.
    np.testing.assert_allclose(points[51, 1], (np.sqrt(5) - 1) / 2)
    assert len(np.unique((points[50:] * (4, 8)).astype(int), axis=0)) == 32


def test_points_by_name_or_by_function() -> None:
    assert points_from("sobol") is sobol
    assert points_from("monte_carlo") is monte_carlo
    assert points_from(np.empty) is np.empty
    with pytest.raises(ValueError, match="got 'halton', expected \"sobol\""):
        points_from("halton")
    with pytest.raises(TypeError, match="points: got int"):
        points_from(3)


def test_every_input_has_its_columns() -> None:
    spare, (pairs, numbers) = base_points([(2,), ()], 16, 3)
    assert (pairs.shape, numbers.shape) == ((16, 2), (16,))
    np.testing.assert_array_equal(np.column_stack([spare, pairs, numbers]), sobol(16, 4, 3))
