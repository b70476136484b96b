from __future__ import annotations

import dataclasses

import pytest

from prbayes._finding import Finding


def test_a_finding_is_a_frozen_value() -> None:
    finding = Finding("rounded-data", "y: got multiples of 0.5")
    assert finding == Finding("rounded-data", "y: got multiples of 0.5", page="")
    with pytest.raises(dataclasses.FrozenInstanceError):
        finding.code = "other"  # type: ignore[misc]
