"""Draws that walk to a density."""

import numpy as np

from prbayes._checks import Floats
from prbayes.posterior.walk import walked


def test_draws_walk_to_the_density_that_they_are_of_and_forget_where_they_began() -> None:
    rng = np.random.default_rng(3)
    start = rng.normal(2, 3, (2000, 2))
    draws, memory = walked(lambda x: -0.5 * (x**2).sum(axis=1), start, rng)
    assert memory < 0.05
    np.testing.assert_allclose(draws.mean(axis=0), 0, atol=0.1)
    np.testing.assert_allclose(draws.std(axis=0), 1, rtol=0.06)


def test_draws_that_stay_where_they_were_remember_it() -> None:
    rng = np.random.default_rng(3)
    start = rng.normal(0, 1, (50, 1))
    known = {float(x) for x in start[:, 0]}

    def nowhere_else(x: Floats) -> Floats:
        return np.array([0.0 if float(row[0]) in known else -np.inf for row in x])

    draws, memory = walked(nowhere_else, start, rng)
    np.testing.assert_array_equal(draws, start)
    assert memory > 0.99
