"""A Functional Mock-up Unit as a response: what it is told, what is read, what is refused."""

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
import pymc as pm
import pytest
import units

import prbayes as prb
from prbayes.response import fmu


@pytest.fixture(scope="module")
def unit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return units.built(tmp_path_factory.mktemp("unit"))


def spring(unit: Path, **keywords: Any) -> prb.scalar:
    settings = {"inputs": ["stiffness", "force"], "outputs": ["position", "work"]} | keywords
    return prb.fmu(unit, **settings)


K, F = np.array([[2.0, 4.0, 0.1], [1 / 3, 8.0, 5.0]]), np.array([1.0, 3.0, -7.0])
# From time 1 to 3, by steps of .5.
POSITION, WORK = F / K * 3.0, np.broadcast_to(2.0 * F**2, K.shape)


def joined(found: Any) -> Any:
    """Return outputs by name side by side in the last axis, those of one specimen in a row."""
    arrays = list(found.values())
    return np.hstack(arrays) if arrays[0].ndim < 2 else np.stack(arrays, axis=-1)


def test_each_specimen_is_simulated_anew_with_inputs_and_outputs_in_their_order(unit: Path) -> None:
    expected = np.stack([POSITION, WORK], axis=-1)
    for _ in range(2):
        np.testing.assert_array_equal(joined(spring(unit)(K, F)), expected)
    swapped = spring(unit, inputs=["force", "stiffness"], outputs=["work", "position"])
    np.testing.assert_array_equal(joined(swapped(F, K)), expected[..., ::-1])
    one = spring(unit, outputs=["position"])(K, F)
    np.testing.assert_array_equal(one, POSITION)


def test_parameters_are_the_same_for_all_whatever_their_type(unit: Path) -> None:
    for parameters, factor in (
        ({"gain": 0.5, "turns": 3}, 1.5),
        ({"doubled": True}, 2.0),
        ({"doubled": np.bool_(False), "turns": np.int64(2)}, 2.0),
        ({"material": "gold", "gain": 3}, 6.0),
    ):
        found = spring(unit, outputs=["position"], parameters=parameters)(K, F)
        np.testing.assert_array_equal(found, factor * F / K * 3.0)
    turned = spring(unit, inputs=["turns", "force"], outputs=["position"])
    assert turned(4.0, 1.0) == 6.0
    with pytest.raises(ValueError, match=r"Oscillator: got 2.5 for turns, expected a whole number"):
        turned(2.5, 1.0)


def test_curves_are_read_at_the_times_that_were_asked_for(unit: Path) -> None:
    times = [1.1, 2.0, 3.5]
    curve = spring(unit, outputs=["position"], times=times)
    np.testing.assert_allclose(curve(2.0, 3.0), 1.5 * np.array(times), rtol=1e-14)
    both = spring(unit, times=times, outputs={"x": "position", "w": "work"})
    found = both.function(2.0, 3.0)
    assert list(found) == ["x", "w"]
    np.testing.assert_allclose(found["w"], 9.0 * (np.array(times) - 1.0), rtol=1e-14)
    np.testing.assert_array_equal(joined(both(2.0, 3.0)), [*found["x"], *found["w"]])


def test_steps_are_as_long_as_was_asked_for_at_most(unit: Path, tmp_path: Path) -> None:
    def steps(path: Path = unit, **keywords: Any) -> Any:
        return spring(path, outputs=["steps"], **keywords)(1.0, 1.0).tolist()

    assert steps() == 4  # as the unit states
    assert steps(step=0.3) == 7
    assert steps(step=100) == 1
    assert steps(step=0.1, stop_time=2) == 10
    assert steps(times=[1.2, 2.0, 2.1]) == [1, 3, 4]
    assert steps(start_time=0) == 6
    silent = units.changed(unit, tmp_path / "silent.fmu", (' stepSize="0.5"', ""))
    assert steps(silent) == 500


def test_units_with_steps_of_one_size_are_refused_other_times(unit: Path, tmp_path: Path) -> None:
    variable = 'canHandleVariableCommunicationStepSize="{}"'
    swap = variable.format("true"), variable.format("false")
    even = units.changed(unit, tmp_path / "even.fmu", swap)
    found = joined(spring(even, times=[1.5, 3.0])(2.0, 3.0))
    np.testing.assert_array_equal(found, [2.25, 4.5, 4.5, 18.0])
    with pytest.raises(
        ValueError, match=r"got the time 1.7, which steps of 0.5 from 1 do not reac"
    ):
        spring(even, times=[1.5, 1.7])
    with pytest.raises(ValueError, match=r"got the time 3, which steps of 0.3 from 1 do not reach"):
        spring(even, step=0.3)
    unknown = units.changed(unit, tmp_path / "unknown.fmu", swap, (' stepSize="0.5"', ""))
    with pytest.raises(ValueError, match=r"fmu: step: got none, and Oscillator takes steps of one"):
        spring(unknown)
    assert spring(unknown, step=0.25)(2.0, 3.0)["position"] == 4.5


def test_failures_say_what_the_unit_logged_and_the_next_specimen_is_sound(unit: Path) -> None:
    response = spring(unit)
    with pytest.raises(RuntimeError, match=r"Oscillator: .*fatal.*logged: .*'no equilibrium'"):
        response(-1.0, 1.0)
    with pytest.raises(RuntimeError, match=r"status 2 \(discard\); it logged nothing"):
        response(0.0, 1.0)
    np.testing.assert_array_equal(joined(response(K, F)), np.stack([POSITION, WORK], axis=-1))


def test_what_takes_too_long_is_ended_between_steps(unit: Path) -> None:
    # Each of two steps takes longer than the limit.
    response = spring(unit, timeout=1.0)
    with pytest.raises(
        TimeoutError, match=r"Oscillator: no result within timeout = 1 s, at time 1\.5 of 3"
    ):
        response(1.0, 1050.0)
    np.testing.assert_array_equal(joined(response(2.0, 3.0)), [4.5, 18.0])


def test_a_simulator_that_does_not_fit_is_refused_before_anything_is_simulated(
    unit: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 9))
    both, curve = spring(unit), spring(unit, outputs=["work"], times=[2.0, 3.0])
    curves = spring(unit, times=[2.0, 3.0])
    joint, area = prb.Joint(prb.AreaMetric()), prb.AreaMetric()
    pairs = rng.normal(size=(9, 2))
    monkeypatch.setattr(fmu._OpenUnit, "instance", None)
    named = {"position": a, "work": b}
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1)
        pair = pm.MvNormal.dist(np.zeros(2), np.eye(2))
        for response, inputs, metric, observed, said in (
            (both, (x,), joint, named, r"inputs of 1 numbers, expected 2 of one"),
            (both, (pair, x), joint, named, r"got inputs of 2, 1 numbers"),
            (both, (x, 1.0), joint, pairs, r"outputs without names, expected a mapping .* DataFr"),
            (both, (x, 1.0), joint, {"work": a, "w": b}, r"got work, w, .*'position', 'work': the"),
            (both, (x, 1.0), area, a, r"observed: got outputs without names"),
            (curve, (x, 1.0), area, a, r"got shape \(N\), expected \(N, 2\), a column for each"),
            (curves, (x, 1.0), joint, named, r"arrays \(N, 2\), with 'positio"),
        ):
            settings = {"metric": metric, "observed": observed}
            with pytest.raises(ValueError, match=rf"y: .*{said}"):
                prb.Simulator("y", response, *inputs, **settings)
    with pytest.raises(ValueError, match=r"Oscillator: got inputs of 1, 1, 1 numbers, expected 2"):
        both(1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("keywords", "said"),
    [
        (
            {"inputs": ["stifness"]},
            r"inputs: got 'stifness', .*; did you mean 'stiffness' or 'steps'\?$",
        ),
        ({"inputs": ["zzz"]}, r"a variable of Oscillator; it has 'stiffness', 'gain', 'turns', "),
        ({"inputs": ["work"]}, r"'work', which Oscillator computes itself \(output, calculated\)"),
        ({"inputs": ["material"]}, r"'material', which is of type String in Oscillator, .* number"),
        ({"outputs": ["material"]}, r"outputs: got 'material', which is of type String"),
        ({"outputs": {"x": "positon"}}, r"outputs: got 'positon', .* did you mean 'position'\?"),
        ({"parameters": {"mass": 1.0}}, r"parameters: got 'mass', expected a variable of"),
        ({"parameters": {"force": 1.0}}, r"parameters: got 'force', which is among the inputs too"),
        ({"parameters": {"turns": 1.5}}, r"parameters: got 1.5 for turns, expected a whole number"),
        ({"parameters": {"doubled": 2}}, r"parameters: got 2 for doubled, expected 0 or 1"),
        ({"parameters": {"material": 1}}, r"parameters: got 1 for material, expected a text"),
        ({"parameters": {"gain": "1"}}, r"parameters: got '1' for gain, expected a number"),
        ({"stop_time": 1.0}, r"stop_time: got 1, expected a time after start_time = 1"),
        ({"stop_time": np.inf}, r"stop_time: got inf, expected a finite number"),
        ({"times": [1.0, 2.0]}, r"times: got \[1.0, 2.0\], expected increasing times after start"),
        ({"times": [3.0, 2.0]}, r"times: got .*, expected increasing times"),
        (
            {"times": [2.0, 4.0], "stop_time": 3.0},
            r"got 4 as the last, expected none after stop_ti",
        ),
        ({"step": 0}, r"fmu: step: got 0, expected a positive"),
        ({"timeout": -1}, r"fmu: timeout: got -1"),
    ],
)
def test_what_the_unit_does_not_have_is_refused(
    unit: Path, keywords: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        spring(unit, **keywords)


def test_units_of_fmi_3(tmp_path: Path) -> None:
    unit = units.built(tmp_path, 3)
    response = spring(unit, parameters={"turns": 2}, times=[1.0, 2.0])
    for k, f in ((2.0, 3.0), (4.0, 5.0)):
        expected = [2 * f / k, 4 * f / k, f**2, 2 * f**2]
        np.testing.assert_allclose(joined(response(k, f)), expected, rtol=1e-12)
    with pytest.raises(RuntimeError, match=r"Oscillator3: fmi3DoStep .*logged: .*'no equilibrium'"):
        response(-2.0, 3.0)
    np.testing.assert_allclose(joined(response(2.0, 3.0)), [3.0, 6.0, 9.0, 18.0], rtol=1e-12)
    with pytest.raises(
        ValueError, match=r"stop_time: got none, and the unit states none, expected"
    ):
        spring(unit)


def test_without_fmpy_it_is_said_what_to_install(
    unit: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(ImportError, match=r"run pip install prbayes\[codes\]"):
        spring(unit)


# -- instances in a process ----------------------------------------------------------------------


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
    noted(fmu, "_free")
    return seen


def test_a_unit_is_loaded_once_and_one_instance_is_used_again(
    unit: Path, tmp_path: Path, made: list[str]
) -> None:
    own = units.changed(unit, tmp_path / "own.fmu")
    folders = len(fmu._open_units)
    response = work(own)
    np.testing.assert_array_equal(response(np.arange(5.0)), 2 * np.arange(5.0) ** 2)
    np.testing.assert_array_equal(work(own)(np.arange(5.0)), 2 * np.arange(5.0) ** 2)
    assert made[:2] == ["__init__", "instantiate"]
    assert set(made[2:]) == {"reset"}
    assert len(fmu._open_units) == folders + 1


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
        opened = fmu._opened(response.function.unit)
        assert 1 <= len(opened.idle) <= most
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


def test_a_file_that_is_changed_or_gone_is_noticed_where_the_work_is_done(
    unit: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = units.changed(unit, tmp_path / "own.fmu", ('stopTime="3.0"', 'stopTime="4.0"'))
    response = work(own)
    assert response(1.0) == 3
    monkeypatch.setattr(fmu, "_open_units", {})
    units.changed(unit, own)
    with pytest.raises(RuntimeError, match=r"own.fmu, which has changed since, expected the file"):
        response(1.0)
    own.unlink()
    with pytest.raises(RuntimeError, match=r"own.fmu, which is not there, expected the file"):
        response(1.0)


def test_files_that_are_no_units_for_this_machine_are_refused(unit: Path, tmp_path: Path) -> None:
    here = Path.cwd()

    def changed(name: str, *replaced: tuple[str, str], **changes: Any) -> Path:
        return units.changed(unit, tmp_path / f"{name}.fmu", *replaced, **changes)

    text, broken = tmp_path / "text.fmu", tmp_path / "broken.fmu"
    text.write_text("no archive")
    content = bytearray(unit.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 1000] = bytes(1000)
    broken.write_bytes(content)
    empty = changed("empty", keep=lambda name: name != "modelDescription.xml")
    other = changed("other", keep=lambda name: "linux" not in name)
    unread = "fmu: path: got .*, which cannot be read as an .*"
    co_simulation = "expected FMI 2 or 3 for co-simulation"
    for path, said in (
        (text, unread + "BadZipFile"),
        (empty, unread + "KeyError: .*modelDesc"),
        (changed("torn", ("</fmiModelDescription>", "")), unread + "ParseError"),
        (other, "which runs on win64, expected linux64; let the tool"),
        (changed("old", ('fmiVersion="2.0"', 'fmiVersion="1.0"')), f"of FMI 1.0, {co_simulation}"),
        (
            changed("models", ("CoSimulation", "ModelExchange")),
            f"of FMI 2.0 without co-simulation, {co_simulation[:-19]}",
        ),
        (broken, r"broken.fmu, which cannot be unzipped \(.*\), expected"),
    ):
        with pytest.raises(ValueError, match=said):
            work(path)
    # A name without a library, and a library that is none.
    hollow = changed("hollow", ('modelIdentifier="Oscillator"', 'modelIdentifier="Other"'))
    for path in (hollow, changed("bytes", so=b"no library")):
        with pytest.raises(
            RuntimeError, match=rf"a library that cannot be loaded from .*{path.name}"
        ):
            work(path)
    assert Path.cwd() == here
    with pytest.raises(FileNotFoundError, match=r"got .*none.fmu, which is not there, expected an"):
        work(tmp_path / "none.fmu")
    with pytest.raises(ValueError, match=r"which is a folder, expected a file"):
        work(tmp_path)
