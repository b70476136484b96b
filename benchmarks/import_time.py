"""Import time of prbayes on top of pymc, in fresh processes; prints a table and writes JSON.

Run: uv run python -m benchmarks.import_time [--runs 7]
"""

import argparse
import statistics
import subprocess
import sys
from pathlib import Path

from benchmarks import record

CODE = """
import time
a = time.perf_counter()
import pymc
b = time.perf_counter()
import prbayes
c = time.perf_counter()
print(b - a, c - b)
"""


def main():
    """Time both imports in the same fresh process, several times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "import_time.json")
    arguments = parser.parse_args()
    times = []
    for _ in range(arguments.runs + 1):
        text = subprocess.run(
            [sys.executable, "-c", CODE], capture_output=True, text=True, check=True
        ).stdout
        times.append([float(t) for t in text.split()])
    pymc_times, own_times = zip(*times[1:], strict=True)  # the first run fills the disk cache
    ratio = statistics.median(o / p for p, o in times[1:])
    table = {
        "pymc_seconds": statistics.median(pymc_times),
        "prbayes_added_seconds": statistics.median(own_times),
        "ratio_prbayes_over_pymc": 1 + ratio,
        "runs": arguments.runs,
    }
    for name, value in table.items():
        print(f"{name:28s} {value:.3f}" if isinstance(value, float) else f"{name:28s} {value}")
    record.save(arguments.out, table)


if __name__ == "__main__":
    main()
