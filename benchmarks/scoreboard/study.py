"""Runs of a rival on problems, one result a rival and problem, which goes on where it stopped."""

from __future__ import annotations

import argparse
import logging
import os
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import record
from benchmarks.scoreboard.problem import Draws, Problem, Response
from benchmarks.scoreboard.problems import PROBLEMS
from benchmarks.scoreboard.score import summary

STORE = record.RESULTS / "scoreboard"


class CannotError(Exception):
    """The rival has no way to say the problem; the message says why."""


@dataclass(frozen=True)
class Task:
    """What a rival is given: a problem, its data, a response that counts its runs, and a seed."""

    problem: Problem
    observed: Any
    response: Response
    seed: int


@dataclass(frozen=True)
class Rival:
    """A rival at its settings."""

    name: str
    packages: tuple[str, ...]  # whose versions are kept with the results
    settings: dict[str, Any]
    # Returns draws of the hyperparameters, each (S,), or a single number each of an optimiser.
    calibrate: Callable[[Task, dict[str, Any]], Draws]


def path_of(store: Path, rival: str, problem: str) -> Path:
    """Return the file of a rival's results on a problem."""
    return store / f"{rival} {problem}.json".replace(" ", "_")


def one(rival: Rival, problem: Problem, size: int, replicate: int) -> dict[str, Any]:
    """Return the row of one data set: values of what is told, or an error, with what it cost."""
    response = Response(problem)
    task = Task(problem, problem.data(size, replicate), response, seed=replicate)
    clock, spent = time.perf_counter(), _cpu()
    row: dict[str, Any] = {"size": size, "replicate": replicate, "seed": replicate}
    try:
        row["values"] = summary(problem.told(rival.calibrate(task, rival.settings)))
    except CannotError:
        raise
    except Exception as error:  # a failure is a result
        row["error"] = f"{type(error).__name__}: {error}"[:300]
    row["runs"] = response.runs
    row["cpu"] = round(_cpu() - spent, 3)
    row["seconds"] = round(time.perf_counter() - clock, 3)
    return row


def _cpu() -> float:
    """Return the processor's time of this process and of those that it waited for."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def study(rival: Rival, problem: Problem, sizes: list[int], replicates: int, store: Path,
            until: float = float("inf")) -> None:  # fmt: skip
    """Run what is missing of a rival on a problem, and keep every row as it comes."""
    path = path_of(store, rival.name, problem.name)
    empty = {"rival": rival.name, "problem": problem.name, "settings": rival.settings, "rows": []}
    found = record.load(path, empty)
    if found["settings"] != rival.settings:
        raise SystemExit(
            f"{path} has other settings: {found['settings']}; move it away to start anew"
        )
    done = {(row["size"], row["replicate"]) for row in found["rows"]}
    for replicate in range(min(replicates, problem.replicates)):
        for size in sizes:
            if (size, replicate) in done or time.monotonic() > until:
                continue
            try:
                row = one(rival, problem, size, replicate)
            except CannotError as error:
                found["cannot"] = str(error)
                record.save(path, found, rival.packages)
                return
            found["rows"].append(row)
            record.save(path, found, rival.packages)
            print(rival.name, problem.name, row, flush=True)


def main(rivals: tuple[Rival, ...]) -> None:
    """Run rivals from the command line."""
    names = [rival.name for rival in rivals]
    parser = argparse.ArgumentParser()
    parser.add_argument("--rivals", nargs="+", default=names, choices=names)
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=list(PROBLEMS))
    parser.add_argument("--sizes", nargs="+", type=int, help="numbers of specimens; default all")
    parser.add_argument(
        "--replicates", type=int, default=20, help="data sets, where they are drawn"
    )
    parser.add_argument(
        "--seconds", type=float, default=float("inf"), help="after which nothing is begun"
    )
    parser.add_argument("--store", type=Path, default=STORE)
    arguments = parser.parse_args()
    arguments.store.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    until = time.monotonic() + arguments.seconds
    for name in arguments.problems:
        problem = PROBLEMS[name]
        sizes = [n for n in problem.sizes if n in (arguments.sizes or problem.sizes)]
        for rival in rivals:
            if rival.name in arguments.rivals:
                study(rival, problem, sizes, arguments.replicates, arguments.store, until)
