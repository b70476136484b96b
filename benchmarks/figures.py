"""Figures of the whole package on the present commit, for `docs/figures.md`.

Structure of the code, time of the tests, coverage of intervals, accuracy beside the stored results
of other programs, and speed. Each is computed anew by the program that the pages quote, with fewer
data sets, into a folder of its own. It takes about an hour of one core:

    OMP_NUM_THREADS=1 uv run python -m benchmarks.figures [--steps structure tests]
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import record
from benchmarks.scoreboard.table import scores

ROOT = Path(__file__).parents[1]
FOLDER = record.RESULTS / "figures"
# Problems with a reference whose data are drawn, and those of one data set.
_DRAWN = ("linear", "folded", "frame")
_SINGLE = ("crack growth", "thermal")
_METRICS = ("prbayes PR", "prbayes KLD", "prbayes area")


def run(*arguments: str) -> str:
    """Run a Python program from the root of the repository, and return what it writes."""
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)} ended with {done.returncode}:\n{done.stdout}")
    return done.stdout


def structure() -> dict[str, float]:
    """Return the figures of the structure of the code."""
    code = (
        "import json, structure; "
        "print(json.dumps({name: f.value for name, f in structure.figures().items()}))"
    )
    helpers = str(ROOT / "tests" / "helpers")
    figures: dict[str, float] = json.loads(
        run("-c", f"import sys; sys.path.insert(0, {helpers!r}); {code}")
    )
    return figures


def tests() -> dict[str, float]:
    """Return the number of tests of the default run, with its seconds."""
    start, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    last = run("-m", "pytest", "-q").strip().splitlines()[-1]
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    (passed,) = re.findall(r"(\d+) passed", last)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        "tests of the default run": int(passed),
        "their seconds": round(time.monotonic() - start),
        "their CPU seconds": round(cpu),
    }


def study(name: str, *options: str) -> dict[str, Any]:
    """Return the rows and summaries of a study that is run anew."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"{name}.json")
        run("-m", f"benchmarks.{name}", "--out", str(path), *options)
        results: dict[str, Any] = record.load(path, None)
    return results


def coverage() -> dict[str, Any]:
    """Return coverage of fleets by specimen, and of posteriors with a metric."""
    from benchmarks.posterior import groups, pooled

    fleets = study("fleet", "--cells", "one input", "two inputs*", "--data-sets", "2")["rows"]
    posteriors = study("posterior", "--data-sets", "1")["summary"]
    return {
        "fleets": {cell: _means(rows) | {"fleets": len(rows)} for cell, rows in fleets.items()},
        "posteriors": {name: pooled(posteriors, has) for name, has in groups().items()},
    }


def _means(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each figure."""
    return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}


def scoreboard() -> dict[str, Any]:
    """Return scores of prbayes on a part of the scoreboard."""
    program = ("-m", "benchmarks.scoreboard.rivals.prbayes", "--sizes", "20", "21", "30", "50")
    with tempfile.TemporaryDirectory() as folder:
        store = ("--store", folder, "--problems")
        likelihood = ("--rivals", "prbayes likelihood")
        run(*program, *store, *_DRAWN, *_SINGLE, *likelihood)
        run(*program, *store, "linear", "folded", *_SINGLE, "--rivals", *_METRICS)
        return scores(Path(folder))


def speed() -> dict[str, Any]:
    """Return CPU seconds, memory and import."""
    return {name: rows[0] for name, rows in study("speed")["rows"].items()}


STEPS: dict[str, Callable[[], dict[str, Any]]] = {
    "structure": structure,
    "tests": tests,
    "coverage": coverage,
    "scoreboard": scoreboard,
    "speed": speed,
}


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", nargs="+", default=list(STEPS), choices=list(STEPS))
    for name in parser.parse_args().steps:
        start = time.monotonic()
        record.save(FOLDER / f"{name}.json", STEPS[name]())
        run("-m", "benchmarks.pages")  # a test compares the pages with the results
        print(f"{name}: {time.monotonic() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
