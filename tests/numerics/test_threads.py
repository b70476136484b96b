"""Threads of linear algebra: one inside, as many as before outside, also of a second caller."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from prbayes.numerics.threads import one_thread


def number() -> set[int]:
    """Return how many threads NumPy's and SciPy's linear algebra may take."""
    np.eye(2) @ np.eye(2)
    return {
        library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"
    }


def test_one_thread_inside_and_as_many_as_before_outside() -> None:
    with threadpool_limits(2, user_api="blas"), ThreadPoolExecutor(1) as pool:
        with one_thread():
            with one_thread():
                pass
            assert number() == {1}
            pool.submit(one_thread()(number)).result()
            assert number() == {1}
        assert number() == {2}


def test_a_failure_inside_leaves_nothing_behind() -> None:
    with threadpool_limits(2, user_api="blas"):
        for _ in range(2):
            with pytest.raises(KeyError), one_thread():
                raise KeyError
            assert number() == {2}
