"""Failure policies: what each does, and what is no policy."""

from __future__ import annotations

import numpy as np

from prbayes.response.failures import Abort, Replace, Retry


def test_policies_and_their_defaults() -> None:
    assert [policy.tries for policy in (Abort(), Replace(), Retry(), Retry(2))] == [1, 1, 2, 3]
    last = Replace(np.inf)
    assert (last.final, Retry(2, then=last).final) == (last, last)
    assert Abort() == Abort(on_nan=False) == Retry(then=Abort()).final
    assert np.isnan(Replace().value)
    assert isinstance(Retry().then, Replace)
