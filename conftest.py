"""What holds for all tests: threads, imports of benchmarks, and perturbed responses where asked.

`PRBAYES_LAST_DIGITS=1 uv run pytest` multiplies every response of the user's by 1 + 1e-12 sin(a
number of the response and the seed 1): what another processor, or another version of NumPy, may do.
No verdict is to hang on that; tests that hold numbers against others of the same response exactly
are left out by the marker ``exact``.
"""

import gc
import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    # One thread of linear algebra for each worker of a test run: the workers share the cores.
    os.environ.setdefault(_name, "1")
# A twelfth of the time of a test run went into noting the line on which each variable was made.
os.environ.setdefault("PYTENSOR_FLAGS", "traceback__limit=0")

# After the installed packages, so that tests of a wheel import the package from there.
sys.path.append(str(Path(__file__).parent))

_SEED = os.environ.get("PRBAYES_LAST_DIGITS")


def pytest_configure(config: pytest.Config) -> None:
    """Perturb responses in all processes of a test run, where asked."""
    if _SEED is None:
        return
    from prbayes.response.response import Responses

    exact = Responses.__call__

    def perturbed(self: Responses, *given: object) -> np.ndarray:
        found = exact(self, *given)  # type: ignore[arg-type]
        with np.errstate(all="ignore"):
            digits = np.sin(1e7 * found + float(_SEED))
        return np.where(np.isfinite(digits), found * (1 + 1e-12 * digits), found)

    Responses.__call__ = perturbed  # type: ignore[method-assign, assignment]


@pytest.fixture(autouse=True)
def _close_figures() -> Iterator[None]:
    """Close what a test has drawn: Matplotlib warns of many open figures."""
    yield
    pyplot = sys.modules.get("matplotlib.pyplot")
    if pyplot is not None:
        pyplot.close("all")


@pytest.fixture(autouse=True)
def _logging() -> Iterator[None]:
    """Leave the package's logger as it was: the command line sets it up for its process."""
    log = logging.getLogger("prbayes")
    handlers, propagate, level = log.handlers[:], log.propagate, log.level
    yield
    log.handlers[:], log.propagate = handlers, propagate
    log.setLevel(level)


def pytest_collection_finish() -> None:
    """Take what was imported out of the garbage collector's rounds, and have fewer of them.

    A twentieth of the time of a test run goes into rounds over graphs that live on.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out tests that compare numbers of the same response to the last digit."""
    if _SEED is None:
        return
    left = [item for item in items if item.get_closest_marker("exact")]
    config.hook.pytest_deselected(items=left)
    items[:] = [item for item in items if item not in left]
