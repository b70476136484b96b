"""What is said of an optimum, and when two populations differ."""

import numpy as np

from prbayes.estimate.caveats import _shares_below, breakdown


def test_what_breaks_down_is_said_by_name_and_only_then() -> None:
    assert breakdown((), ()) == []
    (line,) = breakdown(("sigma", "tau"), ())
    assert line.startswith("sigma, tau ran to the edge of the support")
    (line,) = breakdown((), ("y",))
    assert line.startswith("y: points lose their response at the optimum")
    assert len(breakdown(("sigma",), ("y",))) == 2


def test_shares_below_are_a_distribution_function_with_lost_points_above_all() -> None:
    values, weights = np.array([2.0, np.nan, 1.0, 4.0]), np.array([0.2, 0.4, 0.1, 0.3])
    found = _shares_below(values, weights, np.array([0.0, 1.0, 2.0, 3.0, 9.0]))
    np.testing.assert_allclose(found, [0.0, 0.1, 0.3, 0.3, 0.6])
