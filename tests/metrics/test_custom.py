"""A metric from a user's function."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.metrics.base import Minimum
from prbayes.metrics.custom import FunctionMetric

OK = [0.0, 1.0, 3.0]


def mean_difference(simulated: Any, observed: Any, weights: Any = None) -> Any:
    return np.abs(np.average(simulated, axis=-1, weights=weights) - observed.mean())


def test_it_is_the_value_of_the_function(draw: Callable[..., tuple[Floats, ...]]) -> None:
    x, _, z, _ = draw(12)
    plain, weighted = (FunctionMetric(mean_difference, weighted=w) for w in (False, True))
    d = weighted.against(z)
    assert plain(x, z) == pytest.approx(abs(x.mean() - z.mean()))
    rows = np.random.default_rng(13).dirichlet(np.ones(x.size), (2, 3))
    np.testing.assert_allclose(d(x, rows), np.abs(rows @ x - z.mean()), rtol=1e-12)
    stored = d.outer(*d.basis(x).features(rows), xp=np)
    np.testing.assert_allclose(stored, d(x, rows), rtol=1e-12)
    # Nothing is assumed of it.
    assert (plain.minimum, plain.likelihood, plain.symbolic) == (Minimum.UNKNOWN, False, False)
    assert [plain.takes_weights, weighted.takes_weights] == [False, True]
    assert d.scale == 1.0


def test_wrong_functions_results_and_weights() -> None:
    with pytest.raises(TypeError, match=r"function: got float, expected f\(simulated, observed\)"):
        FunctionMetric(3.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"shape \(3,\) .*expected \(\); reduce over"):
        FunctionMetric(lambda x, z: x)(OK, OK)
    with pytest.raises(ValueError, match=r"weights: got unequal .*pass weighted=True"):
        FunctionMetric(mean_difference)(OK, OK, weights=[1, 2, 3])
    with pytest.raises(ValueError, match="observed weights: got unequal"):
        FunctionMetric(mean_difference).against(OK, [1, 2, 3])
