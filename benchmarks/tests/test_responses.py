"""Responses of the benchmarks are what their table says."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.responses import RESPONSES, Response


@pytest.fixture(params=list(RESPONSES))
def response(request: pytest.FixtureRequest) -> Response:
    found: Response = RESPONSES[request.param]
    return found


def population(response: Response, n: int = 4096) -> np.ndarray:
    rng = np.random.default_rng(0)
    x: np.ndarray = response.mean + response.sd * rng.standard_normal((n, response.d))
    return x


def test_a_specimen_gives_the_same_outputs_whatever_is_run_with_it(response: Response) -> None:
    x = population(response)
    y = response(x)
    assert y.shape == (len(x), response.outputs)
    np.testing.assert_allclose(response(x[5:9]), y[5:9], rtol=1e-14)


def test_only_regions_that_are_said_to_fail_are_not_finite(response: Response) -> None:
    failed = 1 - np.isfinite(response(population(response))).all(axis=1).mean()
    if response.name in ("NaN region", "inf region"):
        assert 0.005 < failed < 0.05
    else:
        assert failed == 0


def test_noise_is_a_tenth_of_the_scatter_and_independent_of_neighbours() -> None:
    response = RESPONSES["noise"]
    x = population(response)
    change = response(x + 1e-9) - response(x)
    assert change.std() / 2**0.5 == pytest.approx(0.1 * response(x).std(), rel=0.05)
