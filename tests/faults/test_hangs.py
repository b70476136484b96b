"""Models that never return, where nothing but their adapter can end them: each costs its specimen."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import units
from um_server import Real

import prbayes as prb
from benchmarks.hostile import EXECUTORS
from prbayes.response.call import CallSettings, Points, Tally, respond

LIMIT = 2.0


def by_command(folder: Path) -> Iterator[prb.scalar]:
    code = "import time; x = {x}; time.sleep(600 * (x == 3)); print(2 * x)"

    def read(run: Path) -> float:
        return float((run / "stdout.txt").read_text())

    yield prb.command([sys.executable, "-S", "-c", code], inputs=["x"], read=read, timeout=LIMIT)


def by_umbridge(folder: Path) -> Iterator[prb.scalar]:
    server = Real(folder)
    try:
        model = prb.umbridge(server.url, "moody", timeout=LIMIT)
        # It sleeps for as many seconds as the number below zero.
        yield prb.scalar(lambda x: model.function(-60.0 if x == 3 else x))
    finally:
        server.kill()


def by_fmu(folder: Path) -> Iterator[prb.scalar]:
    unit = prb.fmu(
        units.built(folder), inputs=["force"], outputs=["position"], step=0.01, timeout=LIMIT
    )
    # From a force of 100 on each of 200 steps takes a thousandth of it in seconds.
    yield prb.scalar(lambda x: unit.function(1000.0 if x == 3 else x) / 1.5 * 2)


@pytest.mark.parametrize(
    "adapter",
    [
        pytest.param(by_command, marks=pytest.mark.long),
        pytest.param(by_umbridge, marks=pytest.mark.long),
        pytest.param(by_fmu, marks=pytest.mark.slow),
    ],
)
def test_a_model_that_never_returns_costs_its_specimen_without_workers_in_processes(
    adapter: object, tmp_path: Path
) -> None:
    x = np.arange(1.0, 5.0)
    making = adapter(tmp_path)  # type: ignore[operator]
    response = next(making)
    try:
        for where in ("nothing", "threads"):
            tally, clock = Tally(), time.monotonic()
            with EXECUTORS[where]() as executor:
                calling = CallSettings("y", response, executor, None, prb.response.Replace(-1.0))
                found = respond(calling, Points([x], [True]), tally)
            np.testing.assert_allclose(found, np.where(x == 3, -1.0, 2 * x), rtol=1e-12)
            (failure,) = tally.failed.values()
            assert failure.reason.startswith("it raised TimeoutError: ")
            assert f"within timeout = {LIMIT:g} s" in failure.reason
            assert time.monotonic() - clock < 30
    finally:
        making.close()
