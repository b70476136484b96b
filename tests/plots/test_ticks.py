"""Ticks are few, round, and stand where their labels say."""

import numpy as np

from prbayes.plots._ticks import log_ticks, round_ticks, spans_decades


def test_ticks_are_few_and_round() -> None:
    assert round_ticks(1.06, 1.22)[1] == ["1.1", "1.15", "1.2"]
    assert round_ticks(-1.0, 1.0)[1] == ["-1", "-0.5", "0", "0.5", "1"]
    for low, high in ((0.0, 13.0), (1e-6, 3e-6), (-3.0, 1e5)):
        at, labels = round_ticks(low, high)
        assert 2 <= len(at) <= 6
        np.testing.assert_allclose(at, [float(text) for text in labels], rtol=1e-9)


def test_zero_is_called_zero() -> None:
    at, labels = round_ticks(-0.3, 0.3)
    assert labels[len(labels) // 2] == "0"
    assert min(at) >= -0.3
    assert max(at) <= 0.3


def test_ticks_of_logarithms_stand_where_their_labels_say() -> None:
    for values in (np.array([0.011, 0.4]), np.array([1e-9, 1.0]), np.array([3.0, 70.0, np.nan])):
        assert spans_decades(values)
        at, labels = log_ticks(values)
        assert 2 <= len(at) <= 7
        np.testing.assert_allclose(10 ** np.array(at), [float(text) for text in labels])


def test_a_logarithm_needs_positive_values_of_different_orders() -> None:
    assert spans_decades(np.array([1.0, 20.1]))
    assert not spans_decades(np.array([1.0, 20.0]))
    assert not spans_decades(np.array([-1.0, 500.0]))
    assert not spans_decades(np.array([0.0, 500.0]))
    assert not spans_decades(np.array([np.nan, np.inf]))
