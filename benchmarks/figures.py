"""Figures of the whole package on the present commit, for the README and `docs/figures.md`.

Output of the README, structure of the code, time of the tests, coverage of intervals, accuracy beside the stored results
of other programs, and speed. Each is computed anew by the program that the pages quote, with fewer
data sets, into a folder of its own. It takes about an hour of one core:

    OMP_NUM_THREADS=1 uv run python -m benchmarks.figures [--steps structure tests]

The step ``studies``, which is not among the default ones, runs all studies with all their data
sets, which takes days.
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
# Modules that write one file of results with `--out`.
STUDIES = [
    path.parent.name if path.stem == "__main__" else path.stem
    for path in [*Path(__file__).parent.glob("*.py"), *Path(__file__).parent.glob("*/__main__.py")]
    if re.search(r"from benchmarks\.study import|\"--out\"", path.read_text(encoding="utf-8"))
]
_METRICS = ("prbayes PR", "prbayes KLD", "prbayes area")


def run(*arguments: str) -> str:
    """Run a Python program from the root of the repository, and return what it writes."""
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)} ended with {done.returncode}:\n{done.stdout}")
    return done.stdout


def readme() -> dict[str, Any]:
    """Return what the scripts and the main example of the README print."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    first, second = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    preamble, _ = first.split("with pm.Model()")
    with tempfile.TemporaryDirectory() as folder:
        example = run("examples/crack_growth.py", "--out", folder)
    runs = re.findall(r"^([\w -]+): (\d+) responses computed$", example, re.MULTILINE)
    numbers = re.findall(r" (?:mu|sigma) +(\d\.\d{3})  (\d\.\d{3}) ", example)
    cells = [" ± ".join(pair) for pair in numbers]
    return {
        "printed": [run("-c", first), run("-c", preamble + second)],
        "runs": {name: int(count) for name, count in runs},
        # optima, then posteriors, of the mean and the standard deviation
        "table": {name: cells[4 * i : 4 * i + 4] for i, (name, _) in enumerate(runs)},
    }


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


def studies() -> dict[str, Any]:
    """Run all studies anew, with all their data sets, and return the seconds of each."""
    seconds = {}
    for path in sorted(record.RESULTS.glob("*.json")):
        if path.stem not in STUDIES:
            continue
        start = time.monotonic()
        with tempfile.TemporaryDirectory(dir=record.RESULTS) as folder:
            new = Path(folder, path.name)
            run("-m", f"benchmarks.{path.stem}", "--out", str(new))
            new.replace(path)
        seconds[path.stem] = round(time.monotonic() - start)
    run("-m", "benchmarks.thermal_challenge")  # it also draws the picture of its page
    return seconds


def speed() -> dict[str, Any]:
    """Return CPU seconds, memory and import."""
    return {name: rows[0] for name, rows in study("speed")["rows"].items()}


STEPS: dict[str, Callable[[], dict[str, Any]]] = {
    "readme": readme,
    "structure": structure,
    "tests": tests,
    "coverage": coverage,
    "scoreboard": scoreboard,
    "speed": speed,
    "studies": studies,
}


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    short = [name for name in STEPS if name != "studies"]
    parser.add_argument("--steps", nargs="+", default=short, choices=list(STEPS))
    for name in parser.parse_args().steps:
        start = time.monotonic()
        record.save(FOLDER / f"{name}.json", STEPS[name]())
        run("-m", "benchmarks.pages")  # a test compares the pages with the results
        print(f"{name}: {time.monotonic() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
