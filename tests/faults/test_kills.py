"""Processes that are killed: what they finished is kept, and the same run goes on to the same end."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PAUSE = "0.012"  # seconds of a response
SCRIPT = """
import sys, time
import numpy as np, pymc as pm, prbayes as prb

folder, kind, pause = sys.argv[1:]

def response(x):
    time.sleep(float(pause))
    with open(folder + "/calls", "a") as file:
        file.write(f"{x!r}\\n")
    return 2 * x

kinds = {
    "refined": lambda: prb.Reweighted(32, store=folder + "/store"),
    "reweighted": lambda: prb.Reweighted(100, store=folder + "/store"),
    "resimulated": lambda: prb.Resimulated(4, store=folder + "/store"),
}
with pm.Model() as model:
    mu = pm.Normal("mu", 1, 1)
    prb.Simulator(
        "y",
        prb.scalar(response),
        pm.Normal.dist(mu, 1.0),
        metric=prb.AreaMetric(),
        observed=[7.0, 8.0, 10.0] if kind == "refined" else [1.0, 2.0, 4.0],
        epsilon=2.0,
        propagation=kinds[kind](),
    )
    if kind == "refined":
        found = prb.minimize(progressbar=False).point
    else:
        settings = {"checkpoint": folder + "/run.nc", "progressbar": False}
        settings["adjustment"] = None
        idata = prb.sample_smc(10, chains=2, random_seed=1, **settings)
        found = float(idata.posterior["mu"].sum())
print(repr(found))
"""


def killed(folder: Path, kind: str, at: int) -> str:
    """Run the script in a process; kill it, hard, as soon as so many responses were computed.

    A response takes long enough for the kill to fall between two of them.
    """
    folder.mkdir()
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(folder), kind, PAUSE],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    calls = folder / "calls"
    while process.poll() is None:
        if calls.exists() and len(calls.read_text().splitlines()) >= at:
            process.send_signal(signal.SIGKILL)
        time.sleep(0.002)
    out, error = process.communicate()
    assert process.returncode == -signal.SIGKILL, error
    return out


@pytest.mark.parametrize(
    ("kind", "at"),
    [
        # In the second stage, after the design grew from 32 responses.
        pytest.param("refined", 60, marks=pytest.mark.long),
        pytest.param("reweighted", 40, marks=pytest.mark.slow),
        pytest.param("resimulated", 200, marks=pytest.mark.slow),
    ],
)
def test_a_killed_run_computes_nothing_again_and_gives_the_same(
    kind: str,
    at: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def finished(folder: Path) -> str:
        """Run the script to its end, in this process, which knows nothing of the killed one."""
        folder.mkdir(exist_ok=True)
        # Another pause would be a change of the response.
        monkeypatch.setattr(sys, "argv", ["script", str(folder), kind, PAUSE])
        capsys.readouterr()
        code = compile(
            SCRIPT, "script", "exec", dont_inherit=True
        )  # the same code as in the process
        exec(code, {"__name__": "__main__"})
        return capsys.readouterr().out

    once = finished(tmp_path / "a")
    assert killed(tmp_path / "b", kind, at) == ""
    before = (tmp_path / "b" / "calls").read_text().splitlines()
    expected = (tmp_path / "a" / "calls").read_text().splitlines()
    assert at <= len(before) < len(expected)
    assert finished(tmp_path / "b") == once
    calls = (tmp_path / "b" / "calls").read_text().splitlines()
    # A state is sought at random places of the batch: three of 32 runs, four of 100.
    assert len(expected) - len(set(expected)) <= 4
    # Three stored ones are computed again at each start, as no version says that the response is the
    # same. A kill may fall between the end of a response and its record: then that one is, too.
    assert len(calls) - len(set(calls)) <= 4 + 3 + 1
    assert set(calls) == set(expected)
