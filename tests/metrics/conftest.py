"""Fixtures of all metrics, one after the other."""

from __future__ import annotations

import pytest
from metric_samples import make

from prbayes.metrics.base import Metric


@pytest.fixture(params=sorted(make()))
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def metric(name: str) -> Metric:
    return make()[name]
