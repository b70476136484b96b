"""The log of a sum of exponentials, against SciPy's."""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

from prbayes.numerics.log_sum_exp import log_sum_exp


def test_it_is_that_of_scipy() -> None:
    terms = 500 * np.random.default_rng(0).standard_normal((3, 4, 10))
    terms[0, 0] = -np.inf
    terms[1, 2, 3:] = -np.inf
    expected = logsumexp(terms, axis=-1)
    before = terms.copy()
    np.testing.assert_allclose(log_sum_exp(terms), expected, rtol=1e-13)
    np.testing.assert_array_equal(terms, before)
    assert log_sum_exp(np.empty((2, 0))).tolist() == [-np.inf, -np.inf]
