"""Threads of linear algebra: one inside, as many as before outside, whoever else is at work."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from prbayes.numerics.threads import one_thread


def number() -> set[int]:
    """Return how many threads NumPy's and SciPy's linear algebra may take."""
    np.eye(2) @ np.eye(2)
    return {found["num_threads"] for found in threadpool_info() if found["user_api"] == "blas"}


def test_there_is_one_inside_and_as_many_as_before_outside() -> None:
    with threadpool_limits(2, user_api="blas"):
        with one_thread():
            assert number() == {1}
        assert number() == {2}


def test_who_comes_second_leaves_the_number_alone() -> None:
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
            try:
                with one_thread():
                    raise KeyError
            except KeyError:
                assert number() == {2}
