"""Rare responses beside closed forms."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy.special import ndtr, ndtri

from prbayes._validate import Floats
from prbayes.decision.importance_sampling import RareEvent, rare_event
from prbayes.decision.populations import InverseTransform
from prbayes.response.inputs import read_inputs

SEEDS = 12


def found(
    size: int, respond: Callable[[Floats], Any], limit: float, mu: Any = (0.0,), n: int = 1000
) -> list[RareEvent]:
    """Return probabilities of responses of independent normal inputs, by seed."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu") * np.ones(size), 1.0)
    inputs = read_inputs("f", [x], model)
    roots = [np.asarray(mu, dtype=float)]
    transform = InverseTransform("f", inputs, [np.zeros(1)])
    return [
        rare_event(transform, roots, respond, limit, n, np.random.default_rng(seed))
        for seed in range(SEEDS)
    ]


CASES: dict[str, tuple[int, Callable[[Floats], Any], float, float]] = {
    "one": (1, lambda z: z[:, 0], ndtri(1 - 1e-5), 1e-5),
    "ten": (10, lambda z: z.sum(axis=1) / np.sqrt(10), ndtri(1 - 1e-4), 1e-4),
    "two sides": (1, lambda z: np.abs(z[:, 0]), ndtri(1 - 5e-5), 1e-4),
    "common": (2, lambda z: z[:, 0] + z[:, 1], 0.0, 0.5),
    "of another size": (1, lambda z: 1e6 + 3e-3 * z[:, 0], 1e6 + 3e-3 * ndtri(1 - 1e-4), 1e-4),
    "failed": (1, lambda z: np.where(z[:, 0] > 3.0, np.inf, z[:, 0]), 3.0, ndtr(-3.0)),
}


@pytest.mark.parametrize("case", CASES)
def test_probabilities_and_their_stated_errors(case: str) -> None:
    size, respond, limit, expected = CASES[case]
    every = found(size, respond, limit)
    values = np.array([one.by_draw[0] for one in every])
    stated = np.array([one.error for one in every])
    assert (stated < 0.25 * expected).all()
    # In units of the stated error: a standard deviation of one, known to 1 / sqrt(2 SEEDS).
    assert np.sqrt(np.mean(((values - expected) / stated) ** 2)) < 1 + 4 / np.sqrt(2 * SEEDS)
    assert abs(values.mean() - expected) < 4 * np.sqrt(np.mean(stated**2) / SEEDS)


def test_populations_share_their_points() -> None:
    mu = np.array([-0.5, 0.0, 0.5])
    expected = ndtr(mu - 4.0)
    every = np.array([one.by_draw for one in found(1, lambda z: z[:, 0], 4.0, mu)])
    np.testing.assert_allclose(every.mean(axis=0), expected, rtol=0.1)


def test_what_has_no_response_is_counted_and_what_is_never_reached_has_an_error() -> None:
    (lossy, *_) = found(1, lambda z: np.where(z[:, 0] < 0, np.nan, z[:, 0]), 3.0)
    assert lossy.lost == pytest.approx(0.5, abs=0.2)
    assert lossy.by_draw[0] == pytest.approx(ndtr(-3.0), rel=0.3)
    (never, *_) = found(1, lambda z: np.clip(z[:, 0], -1, 1), 2.0)
    assert never.by_draw[0] == 0
    assert never.error > 0
