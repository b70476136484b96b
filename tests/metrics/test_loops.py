from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import prbayes.metrics.grid as loops
from prbayes._validate import Floats
from prbayes.metrics.density import GaussianKDE


def test_without_a_folder_for_it_the_compiled_loop_is_not_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Numba refuses to decorate where it can write neither to the package's folder nor a user's."""
    import numba

    asked: list[dict[str, Any]] = []

    def njit(**options: bool) -> Callable[..., Any]:
        def decorate(loop: Callable[..., None]) -> Callable[..., None]:
            asked.append(options)
            if options.get("cache"):
                raise RuntimeError("cannot cache function 'add': no locator available")
            return loop

        return decorate

    monkeypatch.setattr(numba, "njit", njit)

    def add(values: Floats) -> None:
        values += 1

    values = np.zeros(3)
    compiled = loops.compiled(add)
    assert not asked  # nothing is compiled before it is called
    compiled(values)
    compiled(values)
    np.testing.assert_array_equal(values, 2)
    assert [o.get("cache", False) for o in asked] == [True, False]


@pytest.mark.parametrize("n", [1, 40])
def test_smoothing_is_a_convolution_that_sees_zero_beyond_the_ends(n: int) -> None:
    rng = np.random.default_rng(n)
    values, kernel = rng.normal(size=(3, n)), rng.normal(size=7)
    values[1, ::2] = 0
    out = np.zeros_like(values)
    loops.smooth(values, kernel, 0, out)
    expected = [np.convolve(row, kernel)[3:-3] for row in values]
    np.testing.assert_allclose(out, expected, rtol=1e-12, atol=1e-14)
    # On fewer nodes, and on more, than the values have.
    for first_at, size in ((-5, 4), (2, n + 9), (n + 50, 3), (-n - 50, 3)):
        out = np.zeros((3, size))
        loops.smooth(values, kernel, first_at, out)
        wide = np.zeros((3, n + 400))
        wide[:, 197 : 203 + n] = [np.convolve(row, kernel) for row in values]
        np.testing.assert_allclose(out, wide[:, 200 - first_at :][:, :size], atol=1e-14)


def test_results_do_not_depend_on_layout_or_permission_to_write() -> None:
    rng = np.random.default_rng(1)
    cells = GaussianKDE().cells(rng.normal(size=30), np.full(30, 1 / 30))
    x, w = rng.normal(size=(4, 50)), rng.random((4, 50))
    expected, cotangent = cells.density(x, w), rng.normal(size=(4, cells.widths.size))
    slopes = cells.slope(x, cotangent)
    wide = np.asfortranarray(x)
    wide.flags.writeable = False
    np.testing.assert_array_equal(cells.density(wide, np.asfortranarray(w)), expected)
    np.testing.assert_array_equal(cells.slope(wide, np.asfortranarray(cotangent)), slopes)
    np.testing.assert_array_equal(cells.density(np.repeat(x, 2, axis=1)[:, ::2], w), expected)
    np.testing.assert_array_equal(cells.slope(x[0], cotangent)[2], cells.slope(x[0], cotangent[2]))
