"""The same seed gives the same bits, wherever responses are computed and in whatever chunks."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from line_problem import build

import prbayes as prb
from benchmarks.hostile import EXECUTORS

pytestmark = pytest.mark.exact  # bits of one response, called in other ways
QUIET: dict[str, Any] = {"progressbar": False}
PROPAGATIONS: dict[str, Callable[..., Any]] = {
    "Reweighted": lambda **given: prb.Reweighted(32, **given),
    "Resimulated": lambda **given: prb.Resimulated(16, **given),
    "Fresh": lambda **given: prb.Fresh(16, **given),
}


def one(x: float) -> float:
    return 0.75 * x


def many(x: Any) -> Any:
    return 0.75 * np.asarray(x, dtype=np.float64)


def uneven(x: Any) -> Any:
    """Take another time in each call, so that chunks have other sizes each time."""
    time.sleep(1e-3 * os.urandom(1)[0] / 255)
    return many(x)


def digest(name: str, response: Any = None, **given: Any) -> str:
    """Return a digest of all numbers that a study comes to."""
    model, _ = build(PROPAGATIONS[name](**given), response or prb.scalar(one))
    keywords: dict[str, Any] = {"method": "Nelder-Mead"} if name == "Fresh" else {}
    optimum = prb.minimize(model, tolerance=1e-3, max_evaluations=60, **keywords, **QUIET)
    found = [optimum.theta, optimum.covariance]
    settings: dict[str, Any] = {"adjustment": "estimate" if name == "Reweighted" else None}
    settings |= {"model": model, "optimum": optimum, "random_seed": 1, **QUIET}
    posterior = prb.sample_smc(20, chains=2, **settings)
    for group in ("posterior", "sample_stats", "calibration"):
        variables = posterior[group].data_vars.values()
        found += [v.values for v in variables if v.dtype.kind == "f"]
    if name != "Fresh":
        found.append(prb.bootstrap(optimum, 20, random_seed=1, **QUIET)["posterior"]["mu"].values)
    return hashlib.sha256(b"".join(np.ascontiguousarray(x).tobytes() for x in found)).hexdigest()


@cache
def serial(name: str) -> str:
    return digest(name)


@pytest.mark.parametrize(
    "name",
    ["Resimulated", *(pytest.param(n, marks=pytest.mark.slow) for n in ("Reweighted", "Fresh"))],
)
def test_chunks_of_any_size_on_threads_give_the_same_bits(name: str) -> None:
    with ThreadPoolExecutor(3) as threads:
        assert digest(name, uneven, executor=threads) == serial(name)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["processes", "loky", "dask"])
@pytest.mark.parametrize("response", [prb.scalar(one), uneven], ids=["one", "uneven"])
@pytest.mark.parametrize("name", PROPAGATIONS)
@pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado).*")
def test_executors_give_the_same_bits(name: str, response: Any, where: str, tmp_path: Path) -> None:
    with EXECUTORS[where]() as pool:
        assert digest(name, response, executor=pool, store=tmp_path, version="1") == serial(name)


@pytest.mark.slow
@pytest.mark.parametrize("hash_seed", ["0", "1", "4711"])
def test_the_seed_of_hashes_changes_nothing(hash_seed: str) -> None:
    here = Path(__file__).parent
    environment = {
        **os.environ,
        "PYTHONHASHSEED": hash_seed,
        "PYTHONPATH": os.pathsep.join([str(here), str(here / "helpers")]),
    }
    code = "import test_same_bits as t; print(*map(t.digest, t.PROPAGATIONS))"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [serial(name) for name in PROPAGATIONS]
