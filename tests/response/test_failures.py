"""Failure policies: what each says of a response that fails, and what is no policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from prbayes.response.failures import Abort, OnFailure, Replace, Retry


@pytest.mark.parametrize(
    ("policy", "tries", "goes_on", "refuses_nan", "replacement"),
    [
        (Abort(), 1, False, False, None),
        (Abort(on_nan=True), 1, False, True, None),
        (Replace(-1.0), 1, True, False, -1.0),
        (Retry(2, then=Abort()), 3, False, False, None),
        (Retry(2, then=Abort(on_nan=True)), 3, False, True, None),
        (Retry(1, then=Replace(np.inf)), 2, True, False, np.inf),
    ],
    ids=repr,
)
def test_what_a_policy_says(
    policy: OnFailure, tries: int, goes_on: bool, refuses_nan: bool, replacement: float | None
) -> None:
    final = policy.final
    assert policy.tries == tries
    assert (final.goes_on, final.refuses_nan, final.replacement) == (
        goes_on,
        refuses_nan,
        replacement,
    )
    assert final.final is final


def test_defaults() -> None:
    assert Abort() == Abort(on_nan=False)
    assert np.isnan(Replace().value)
    assert Retry().times == 1
    assert np.isnan(Retry().then.replacement or 0.0)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Replace("a"), TypeError, "Replace: value: got str 'a', expected a number"),  # type: ignore[arg-type]
        (lambda: Replace(True), TypeError, "Replace: value: got bool True, expected a number"),
        (lambda: Retry(0), ValueError, "Retry: times: got 0, expected an integer >= 1"),
        (
            lambda: Retry(1, then=Retry()),
            TypeError,
            "Retry: then: got Retry, expected prb.response.Abort",
        ),
        (lambda: Retry(1, then=3), TypeError, "Retry: then: got int, expected prb.response.Abort"),  # type: ignore[arg-type]
    ],
)
def test_bad_settings(make: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make()
