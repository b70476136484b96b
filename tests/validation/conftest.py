"""What several files need: populations of the exact posterior of a normal sample."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtri


@pytest.fixture(scope="session")
def posterior() -> Callable[..., Any]:
    """A function that gives 400 populations, one per draw under Jeffreys' prior, (400, 100)."""

    def populations(n0: int = 15, seed: int = 0) -> Any:
        rng = np.random.default_rng(seed)
        data = rng.normal(size=n0)
        sd = data.std(ddof=1) * np.sqrt((n0 - 1) / rng.chisquare(n0 - 1, (400, 1)))
        mean = data.mean() + sd / np.sqrt(n0) * rng.normal(size=(400, 1))
        return mean + sd * ndtri((np.arange(100) + rng.random((400, 1))) / 100)

    return populations
