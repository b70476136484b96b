"""What does it cost to emulate four outputs of eight inputs between the runs?

Processor seconds of one thread: to choose the emulators of all outputs, to say 16 384 points of a
cloud with them, and to say these again without each eighth of the runs, which tells the error of an
answer; and the memory that a process needs beyond that before it (a process for each row).

Run: uv run python -m benchmarks.emulator_speed
"""

from __future__ import annotations

import argparse
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks import record
from benchmarks.responses import RESPONSES

RUNS = (64, 128, 256, 500, 1000, 2000)
POINTS = 16_384
POPULATIONS = 32  # that the emulators are judged by
REPEATS = 3


def row(n: int) -> dict[str, float]:
    """Return the least seconds of a few repetitions, and MiB."""
    from prbayes.propagation.importance import EmulatedPoints, Sample, fit_emulator

    response = RESPONSES["eight inputs"]
    rng = np.random.default_rng(n)
    x = response.mean + 1.4 * response.sd * rng.standard_normal((n, response.d))
    at = response.mean + response.sd * rng.standard_normal((POINTS, response.d))
    points = EmulatedPoints(tuple(at.T))
    weights, blocks = np.full((POPULATIONS, n), 1 / n), np.arange(n) * 8 // n
    runs = Sample(tuple(x.T), response(x), np.zeros(n), blocks)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    least = np.full(3, np.inf)
    for _ in range(REPEATS):
        clock = [time.process_time()]
        emulator = fit_emulator("auto", runs, weights)
        clock.append(time.process_time())
        assert emulator is not None
        emulator.at(points)
        clock.append(time.process_time())
        emulator.without_each_block(points)
        clock.append(time.process_time())
        least = np.minimum(least, np.diff(clock))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    choose, say, left_out = map(float, least)
    return {"choose": choose, "say": say, "left out": left_out, "MiB": peak / 1024}


def main() -> None:
    """Print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=record.RESULTS / "emulator_speed.json")
    arguments = parser.parse_args()
    table = {}
    print(f"{'runs':>6s}{'choose':>10s}{'say':>10s}{'left out':>10s}{'MiB':>8s}")
    for n in RUNS:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            found = table[str(n)] = pool.submit(row, n).result()
        print(
            f"{n:6d}{found['choose']:10.2f}{found['say']:10.2f}{found['left out']:10.2f}"
            f"{found['MiB']:8.0f}",
            flush=True,
        )
    record.save(arguments.out, table)


if __name__ == "__main__":
    main()
