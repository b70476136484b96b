"""Units in a process: what is read of them, how often they are loaded, threads and processes."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import units
from hostile import processes

import prbayes as prb
from prbayes.response import fmi
from prbayes.response.call import Points
from prbayes.response.chunks import Calling, Tally, respond
from prbayes.response.executors import Pool
from prbayes.response.store import Store


@pytest.fixture(scope="module")
def unit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return units.built(tmp_path_factory.mktemp("unit"))


def work(unit: Path, **keywords: Any) -> prb.scalar:
    """A response that adds up: 2 force^2, unless something is left of the specimen before."""
    return prb.fmu(unit, inputs=["force"], outputs=["work"], **keywords)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is done to units, in words."""
    from fmpy.fmi2 import FMU2Slave

    seen: list[str] = []

    def noted(where: Any, name: str) -> None:
        before = getattr(where, name)

        def doing(*given: Any, **keywords: Any) -> Any:
            seen.append(name)
            return before(*given, **keywords)

        monkeypatch.setattr(where, name, doing)

    for name in ("__init__", "instantiate", "reset"):
        noted(FMU2Slave, name)
    noted(fmi, "_free")
    return seen


def test_a_unit_is_loaded_once_and_one_instance_is_used_again(
    unit: Path, tmp_path: Path, made: list[str]
) -> None:
    own = units.changed(unit, tmp_path / "own.fmu")
    folders = len(fmi._units)
    response = work(own)
    np.testing.assert_array_equal(response(np.arange(5.0)), 2 * np.arange(5.0) ** 2)
    np.testing.assert_array_equal(work(own)(np.arange(5.0)), 2 * np.arange(5.0) ** 2)
    assert made[:2] == ["__init__", "instantiate"]
    assert set(made[2:]) == {"reset"}
    assert len(fmi._units) == folders + 1


def test_units_whose_reset_does_nothing_or_fails_are_made_anew(
    unit: Path, tmp_path: Path, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from fmpy.fmi2 import FMU2Slave

    own = units.changed(unit, tmp_path / "own.fmu")
    monkeypatch.setattr(FMU2Slave, "reset", lambda slave: None)
    np.testing.assert_array_equal(work(own, reset=False)([1.0, 1.0, 3.0]), [2.0, 2.0, 18.0])
    assert made.count("__init__") == 1
    assert made.count("instantiate") == 1 + made.count("_free") == 4

    def fails(slave: Any) -> None:
        raise RuntimeError("it cannot")

    monkeypatch.setattr(FMU2Slave, "reset", fails)
    np.testing.assert_array_equal(work(own)([1.0, 1.0, 3.0]), [2.0, 2.0, 18.0])


def test_an_instance_with_which_something_went_wrong_is_freed_unless_that_is_fatal(
    unit: Path, tmp_path: Path, made: list[str]
) -> None:
    own = units.changed(unit, tmp_path / "own.fmu")
    response = prb.fmu(own, inputs=["stiffness"], outputs=["work"])
    for stiffness, freed in ((-1.0, 0), (0.0, 1)):
        with pytest.raises(RuntimeError, match="failed with status"):
            response(stiffness)
        assert made.count("_free") == freed
        assert response(1.0) == 2
    assert made.count("__init__") == 3


@pytest.mark.slow
def test_threads_have_an_instance_each_and_those_of_one_only_take_turns(
    unit: Path, tmp_path: Path
) -> None:
    force = np.array([150.0, 151.0, 150.0, 152.0])
    shared = 'canBeInstantiatedOnlyOncePerProcess="{}"'
    swap = shared.format("false"), shared.format("true")
    once = units.changed(unit, tmp_path / "once.fmu", swap)
    for path, most in ((unit, 2), (once, 1)):
        response = work(path, step=1.0)
        clock = time.monotonic()
        with ThreadPoolExecutor(2) as pool:
            found = list(pool.map(response, force))
        seconds = time.monotonic() - clock
        np.testing.assert_array_equal(found, 2 * force**2)
        opened = fmi.opened(response.function.unit)
        assert 1 <= len(opened.spare) <= most
        # Each takes 0.3 s.
        assert (seconds < 1.1) == (most > 1)


@pytest.mark.slow
def test_it_travels_to_processes_that_fork_and_nothing_is_left_behind(
    unit: Path, tmp_path: Path
) -> None:
    code = """
import multiprocessing, os, pickle, sys

def there():
    return len([name for name in os.listdir(os.environ["TMPDIR"]) if "fmu" in name])

def answers(shift, folders):
    for x in range(20):
        assert response(float(x + shift)) == 2 * (x + shift) ** 2
    assert there() == folders

response = pickle.load(sys.stdin.buffer)
answers(0, 1)
if hasattr(os, "fork"):
    child = multiprocessing.get_context("fork").Process(target=answers, args=(30, 2))
    child.start()
    for _ in range(20):
        assert response(3.0) == 18
    child.join()
    assert child.exitcode == 0
    # The child removed its folder, and not its parent's.
    answers(0, 1)
"""
    program = [sys.executable, "-W", "ignore", "-c", code]
    home = {**os.environ, "TMPDIR": str(tmp_path)}
    packed = pickle.dumps(work(unit))
    subprocess.run(program, input=packed, check=True, timeout=60, env=home)
    assert not list(tmp_path.glob("*fmu*"))


@pytest.mark.long
@pytest.mark.parametrize(
    ("stiffness", "timeout"),
    [
        pytest.param(-7.0, None, id="crashes"),
        pytest.param(-9.0, 2.0, id="hangs", marks=pytest.mark.slow),
    ],
)
def test_a_unit_that_ends_or_hangs_its_process_costs_its_specimen_and_instances_are_used_again(
    unit: Path, tmp_path: Path, stiffness: float, timeout: float | None
) -> None:
    response = prb.fmu(unit, inputs=["stiffness", "force"], outputs=["position"])
    x = np.arange(1.0, 21.0)
    x[5] = stiffness
    points, tally = Points([x, 2 * x], [True, True]), Tally()
    store, policy = Store(tmp_path, "y", columns=2), prb.response.Replace(-1.0)
    with processes() as executor:
        calling = Calling("y", response, executor, store, policy, timeout=timeout)
        found = respond(calling, points, tally)
        np.testing.assert_array_equal(found, np.where(x == stiffness, -1.0, 6.0))
        (failure,) = tally.failed.values()
        assert failure.inputs[0] == stiffness
        assert failure.reason.startswith("it ended its worker (")
        # The others are in the store, and the failure is; nothing is computed for it again.
        again = Tally()
        respond(calling, points, again)
        assert again.computed == 0
        # Workers have made one instance each, whatever the number of specimens.
        more = Points([x + 0.5, 2 * x + 1], [True, True]).at(np.delete(np.arange(20), 5))
        np.testing.assert_array_equal(respond(calling, more, Tally()), np.full(19, 6.0))
        pool = Pool("y", executor)
        made = "[one.count for one in __import__('prbayes').response.fmi._units.values()]"
        counts = [pool.submitted(eval, made).result() for _ in range(8)]
        assert [1] in counts
        assert all(count in ([], [1]) for count in counts)
        if pool.executor is not executor:
            pool.executor.shutdown()


def test_a_file_that_is_changed_or_gone_is_noticed_where_the_work_is_done(
    unit: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = units.changed(unit, tmp_path / "own.fmu", ('stopTime="3.0"', 'stopTime="4.0"'))
    response = work(own)
    assert response(1.0) == 3
    monkeypatch.setattr(fmi, "_units", {})
    units.changed(unit, own)
    with pytest.raises(RuntimeError, match=r"own.fmu, which has changed since, expected the file"):
        response(1.0)
    own.unlink()
    with pytest.raises(RuntimeError, match=r"own.fmu, which is not there, expected the file"):
        response(1.0)


def test_files_that_are_no_units_for_this_machine_are_refused(unit: Path, tmp_path: Path) -> None:
    here = Path.cwd()
    text = tmp_path / "text.fmu"
    text.write_text("no archive")
    empty = units.changed(
        unit, tmp_path / "empty.fmu", keep=lambda name: name != "modelDescription.xml"
    )
    torn = units.changed(unit, tmp_path / "torn.fmu", ("</fmiModelDescription>", ""))
    for path, said in (
        (text, "BadZipFile"),
        (empty, "KeyError: .*modelDesc"),
        (torn, "ParseError"),
    ):
        with pytest.raises(
            ValueError, match=rf"fmu: path: got .*, which cannot be read as an .*{said}"
        ):
            work(path)
    other = units.changed(unit, tmp_path / "o.fmu", keep=lambda name: "linux" not in name)
    with pytest.raises(ValueError, match=r"which runs on win64, expected linux64; let the tool"):
        work(other)
    old = units.changed(unit, tmp_path / "old.fmu", ('fmiVersion="2.0"', 'fmiVersion="1.0"'))
    with pytest.raises(ValueError, match=r"of FMI 1.0, expected FMI 2 or 3 for co-simulation"):
        work(old)
    models = units.changed(unit, tmp_path / "models.fmu", ("CoSimulation", "ModelExchange"))
    with pytest.raises(ValueError, match=r"of FMI 2.0 without co-simulation, expected FMI 2 or 3"):
        work(models)
    # A name without a library, and an archive of which a part was overwritten.
    broken = tmp_path / "broken.fmu"
    hollow = units.changed(
        unit, tmp_path / "hollow.fmu", ('modelIdentifier="Oscillator"', 'modelIdentifier="Other"')
    )
    with pytest.raises(RuntimeError, match=r"Oscillator: got a library that cannot be loaded from"):
        work(hollow)
    with pytest.raises(
        RuntimeError, match=r"cannot be loaded from .*text.fmu \(.*, expected one for"
    ):
        work(units.changed(unit, text, so=b"no library"))
    content = bytearray(unit.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 1000] = bytes(1000)
    broken.write_bytes(content)
    with pytest.raises(ValueError, match=r"broken.fmu, which cannot be unzipped \(.*\), expected"):
        work(broken)
    assert Path.cwd() == here
    with pytest.raises(FileNotFoundError, match=r"got .*none.fmu, which is not there, expected an"):
        work(tmp_path / "none.fmu")
    with pytest.raises(ValueError, match=r"which is a folder, expected a file"):
        work(tmp_path)
