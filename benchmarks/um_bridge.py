"""Workers of an UM-Bridge server that are busy: a model that takes 50 ms, asked from several threads at a time.

The server is the package `umbridge` in a process of its own on the loopback interface, with as many
workers as there are threads. *Utilisation* is the time that its model was at work, which it counts
itself, over workers times the wall-clock time of the design of `Reweighted`, from the first request
to the last response: the runs of a simulator as users make them, in memory, with a store, and with one on a
disk that takes 10 ms for a commit; and the same number of calls of the client of `umbridge` in a
thread pool. Each is measured three times, in turn; the table has the median.

    uv run python -m benchmarks.um_bridge
"""

from __future__ import annotations

import argparse
import logging
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import record

SECONDS = 0.05
WORKERS = (4, 16)
# Runs of each worker: 3.2 s of work, in which the start of the first and the end of the last count.
RUNS_EACH = 64
TIMES = 3
SLOW_DISK = 0.01  # s for a commit: a disk that turns
CLIENT, MEMORY, STORE, SLOW = (
    "client of umbridge",
    "in memory",
    "with a store",
    "with a store, slow disk",
)


def serve(port: int, workers: int) -> None:
    """Serve a model that sleeps, and one that tells for how long it has."""
    import umbridge

    class Sleeping(umbridge.Model):
        count, busy, turn = 0, 0.0, threading.Lock()

        def get_input_sizes(self, config: Any) -> list[int]:
            return [1]

        get_output_sizes = get_input_sizes

        def supports_evaluate(self) -> bool:
            return True

        def __call__(self, parameters: Any, config: Any) -> list[list[float]]:
            clock = time.perf_counter()
            time.sleep(SECONDS)
            with self.turn:
                Sleeping.busy += time.perf_counter() - clock
                Sleeping.count += 1
            return [[2 * parameters[0][0]]]

    class Counted(Sleeping):
        def get_output_sizes(self, config: Any) -> list[int]:
            return [2]

        def __call__(self, parameters: Any, config: Any) -> list[list[float]]:
            return [[Sleeping.busy, float(Sleeping.count)]]

    umbridge.serve_models([Sleeping("sleeping"), Counted("counted")], port, max_workers=workers)


@contextmanager
def server(workers: int) -> Iterator[str]:
    """Run a server, and give its address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    program = [sys.executable, "-m", "benchmarks.um_bridge", "--child", str(port), str(workers)]
    process = subprocess.Popen(program, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until = time.monotonic() + 60
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except OSError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.05)
        yield f"http://127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()


@contextmanager
def disk(seconds: float) -> Iterator[None]:
    """Let every commit of a store take longer."""
    from prbayes.response.store import Store

    add = Store.add_all

    def late(self: Store, parts: Any) -> None:
        time.sleep(seconds)
        add(self, parts)

    Store.add_all = late  # type: ignore[method-assign]
    try:
        yield
    finally:
        Store.add_all = add  # type: ignore[method-assign]


def through_prbayes(url: str, pool: ThreadPoolExecutor, runs: int, store: str | None) -> float:
    """Make the runs of a simulator's design; return the seconds from the first to the last."""
    import pymc as pm

    import prbayes as prb

    response = prb.umbridge(url, "sleeping")
    spent = []

    class Timed(prb.Reweighted):
        """Times the call of the responses, in which nothing else is done."""

        def bind(self, name: str, inputs: Any, target: Any, responses: Any) -> Any:
            computed = responses._computed

            def timed(given: Any) -> Any:
                clock = time.perf_counter()
                found = computed(given)
                spent.append(time.perf_counter() - clock)
                return found

            responses._computed = timed
            return super().bind(name, inputs, target, responses)

    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        prb.Simulator(
            "y",
            response,
            x,
            metric=prb.AreaMetric(),
            observed=[1, 2.0],
            propagation=Timed(runs, executor=pool, store=store, version="1"),
            progressbar=False,
        )
    model.logp()  # the first use
    return sum(spent)


def through_its_client(url: str, pool: ThreadPoolExecutor, runs: int) -> float:
    """Make as many calls with the client of `umbridge`; return the seconds."""
    import umbridge

    model = umbridge.HTTPModel(url, "sleeping")
    clock = time.perf_counter()
    for _ in pool.map(lambda x: model([[x]]), np.linspace(0, 1, runs).tolist()):
        pass
    return time.perf_counter() - clock


def measured(workers: int, how: str) -> dict[str, Any]:
    """Return the utilisation of a server's workers."""
    import umbridge

    runs = RUNS_EACH * workers
    with server(workers) as url, ThreadPoolExecutor(workers) as pool:
        clock = time.process_time()
        if how == CLIENT:
            wall = through_its_client(url, pool, runs)
        else:
            with tempfile.TemporaryDirectory() as folder, disk(SLOW_DISK if how == SLOW else 0.0):
                wall = through_prbayes(url, pool, runs, None if how == MEMORY else folder)
        cpu = time.process_time() - clock
        ((busy, count),) = umbridge.HTTPModel(url, "counted")([[0.0]])
    if count != runs:
        raise RuntimeError(f"got {count} calls of the model, expected {runs}")
    return {
        "workers": workers,
        "how": how,
        "runs": runs,
        "wall": wall,
        "busy": busy,
        "cpu": cpu,
        "utilisation": busy / (workers * wall),
    }


def main() -> None:
    """Measure all, print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=record.RESULTS / "um_bridge.json")
    parser.add_argument("--child", nargs=2, type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        serve(*arguments.child)
        return
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    print(f"{'workers':>7} {'':24} {'runs':>5} {'wall s':>7} {'busy s':>7} {'utilisation':>11}")
    table = []
    for workers in WORKERS:
        found: dict[str, list[dict[str, Any]]] = {how: [] for how in (MEMORY, STORE, SLOW, CLIENT)}
        measured(workers, MEMORY)  # what is imported is there
        for _ in range(TIMES):
            for how, rows in found.items():
                rows.append(measured(workers, how))
        for how, rows in found.items():
            row = sorted(rows, key=lambda each: each["utilisation"])[TIMES // 2]
            row["lowest"] = min(each["utilisation"] for each in rows)
            table.append(row)
            print(
                f"{workers:7d} {how:24} {row['runs']:5d} {row['wall']:7.2f} {row['busy']:7.1f} "
                f"{row['utilisation']:11.1%}",
                flush=True,
            )
    record.save(arguments.out, table)


if __name__ == "__main__":
    main()
