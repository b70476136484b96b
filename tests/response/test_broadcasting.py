"""Leading axes broadcast, events stay as they are."""

from __future__ import annotations

import numpy as np
import pytest

from prbayes.response.broadcasting import batch_shape, broadcast_batch

X, PAIRS = np.arange(3.0), np.arange(8.0).reshape(4, 1, 2)


def test_leading_axes_broadcast_and_events_do_not() -> None:
    assert batch_shape([X, PAIRS], [0, 1]) == (4, 3)
    assert batch_shape([X, PAIRS], [1, 2]) == (4,)
    assert batch_shape([np.float64(1.0)], [0]) == ()
    x, pairs = broadcast_batch([X, PAIRS], [0, 1], (4, 3))
    assert (x.shape, pairs.shape) == ((4, 3), (4, 3, 2))
    np.testing.assert_array_equal(x[2], X)
    np.testing.assert_array_equal(pairs[2, 1], PAIRS[2, 0])


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="shape mismatch"):
        batch_shape([X, np.zeros(2)], [0, 0])
    with pytest.raises(ValueError, match="zip"):
        batch_shape([X], [0, 0])
