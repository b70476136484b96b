"""Attacks on stores, checkpoints, results and workers: how many were tried, and what became of each.

The attacks are those of `benchmarks.attacks`, of which the tests try a few, and the response of
`benchmarks.hostile`. What is promised is told in ``docs/promises.md``.

    uv run python -m benchmarks.faults [--factor 20] [--out faults.json]
"""

from __future__ import annotations

import argparse
import logging
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

import prbayes as prb
from benchmarks import hostile, record
from benchmarks.attacks import ATTACKS, allowed

EXECUTORS = ("nothing", "threads", "processes", "loky")
# Two processes that are killed take seconds of which most is their start.
SLOW = {"two processes that write and are killed": 2}


def on_disk(factor: int) -> dict[str, Any]:
    """Return outcomes of attacks on files, by what is attacked and how."""
    found = {}
    for name, (attack, n) in ATTACKS.items():
        tries = max(1, n * factor // SLOW.get(name, 1))
        with tempfile.TemporaryDirectory() as folder:
            outcomes = Counter(attack(Path(folder), np.random.default_rng(5), tries))
        found[name] = row(name, outcomes, allowed(name))
    return found


def on_workers(where: str, tries: int) -> dict[str, Any]:
    """Return outcomes of hostile responses on one kind of executor, by policy."""
    replace, abort = prb.response.Replace(-1.0), prb.response.Abort()
    policies = (replace, prb.response.Retry(1, then=replace), abort)
    found = {}
    for policy in policies:
        outcomes: Counter[str] = Counter()
        with tempfile.TemporaryDirectory() as folder, hostile.EXECUTORS[where]() as executor:
            for seed in range(tries):
                store = Path(folder, str(seed))
                outcomes.update(hostile.on_workers(where, executor, policy, store, seed))
        name = f"hostile responses, {where}, {type(policy).__name__}"
        found[name] = row(name, outcomes, {"that point failed", "refused"})
    return found


def row(name: str, outcomes: Counter[str], allowed: set[str]) -> dict[str, Any]:
    """Return and print what became of one class of attacks."""
    tried = outcomes.total()
    survived = sum(outcomes[outcome] for outcome in allowed)
    print(f"{name:50s} {tried:6d} tried {survived:6d} survived  {dict(outcomes)}", flush=True)
    return {"tried": tried, "survived": survived, "outcomes": dict(outcomes)}


def main() -> None:
    """Try all, and write what was found."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--factor", type=int, default=20, help="times as many as in the tests")
    parser.add_argument("--out", type=Path, default=record.RESULTS / "faults.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    found = on_disk(arguments.factor)
    record.save(arguments.out, found)
    for where in EXECUTORS:
        found |= on_workers(where, max(1, arguments.factor // 10))
        record.save(arguments.out, found)


if __name__ == "__main__":
    main()
