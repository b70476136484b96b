"""A program as a response: what it is given, what is read, and what becomes of its failures."""

from __future__ import annotations

import os
import pickle
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytest

import prbayes as prb
from prbayes.response.executors import time_limit

SEES_PROCESSES = pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="no /proc to see processes in"
)
PYTHON = [sys.executable, "-S", "-c"]
SQUARE = "print(float(open('in.txt').read()) ** 2)"


def printed(folder: Path) -> float:
    return float((folder / "stdout.txt").read_text())


def square(**keywords: Any) -> prb.scalar:
    settings = {"inputs": ["x"], "write": {"in.txt": "{x}"}, "read": printed} | keywords
    return prb.command([*PYTHON, SQUARE], **settings)


def test_each_specimen_is_computed_with_all_digits() -> None:
    x = np.array([[1 / 3, 2.0], [-1e-300, 1e10]])
    np.testing.assert_array_equal(square()(x), x**2)
    # Also in another process.
    assert pickle.loads(pickle.dumps(square()))(5.0) == 25


def test_arguments_and_templates_have_values_in_formats_and_other_braces_are_left() -> None:
    code = (
        "import sys; print(len(sys.argv[1]) if open('a/b.txt').read() == '{y} {} 3.0e+00' else 0)"
    )
    run = prb.command(
        [*PYTHON, code, "{x:.3f}"],
        inputs=["x"],
        write={"a/b.txt": "{y} {} {x:.1e}"},
        read=printed,
    )
    assert run(3.0) == len("3.000")


def test_a_template_is_read_from_its_path_once(tmp_path: Path) -> None:
    template = tmp_path / "deck.txt"
    template.write_text("{x}")
    run = square(write={"in.txt": template})
    template.unlink()
    assert run(3.0) == 9


def test_nothing_goes_through_a_shell(tmp_path: Path) -> None:
    run = prb.command(
        [*PYTHON, "import sys; print(sys.argv[1] == '$HOME; ls *')", "$HOME; ls *", "{x}"],
        inputs=["x"],
        read=lambda folder: (folder / "stdout.txt").read_text() == "True\n",
    )
    assert run(1.0) == 1


def test_folders_go_unless_they_are_wanted(tmp_path: Path) -> None:
    square(folder=tmp_path / "gone")(2.0)
    assert not list((tmp_path / "gone").iterdir())
    square(folder=tmp_path / "kept", keep=True)(2.0)
    (kept,) = (tmp_path / "kept").iterdir()
    assert {path.name for path in kept.iterdir()} == {"in.txt", "stdout.txt", "stderr.txt"}


def test_a_program_that_fails_says_what_it_wrote_and_keeps_its_files(tmp_path: Path) -> None:
    code = "import sys; sys.exit('singular matrix {x}')"
    run = prb.command([*PYTHON, code], inputs=["x"], read=printed, folder=tmp_path)
    with pytest.raises(RuntimeError, match=r"ended with code 1, expected 0; it wrote: singular"):
        run(2.0)
    (kept,) = tmp_path.iterdir()
    assert (kept / "stderr.txt").read_text() == "singular matrix 2.0\n"


def test_a_run_has_several_outputs_as_an_array_or_by_name() -> None:
    code = "x = {x}; print(x, 3 * x)"

    def both(folder: Path) -> list[float]:
        return [float(text) for text in (folder / "stdout.txt").read_text().split()]

    def named(folder: Path) -> dict[str, Any]:
        first, second = both(folder)
        return {"twice": [second, first], "one": first}

    x = np.array([[1.5, -2.0]])
    settings: dict[str, Any] = {"inputs": ["x"]}
    as_array = prb.command([*PYTHON, code], read=both, **settings)
    np.testing.assert_array_equal(as_array(x), np.stack([x, 3 * x], axis=-1))
    by_name = prb.command([*PYTHON, code], read=named, **settings)
    found: dict[str, Any] = by_name(x)  # type: ignore[assignment]
    np.testing.assert_array_equal(found["twice"], np.stack([3 * x, x], axis=-1))
    np.testing.assert_array_equal(found["one"], x)
    with pytest.raises(
        ValueError, match=r"got 1 inputs, expected 2: a, b; .*program\(x\[0\], x\[1\]"
    ):
        prb.command([*PYTHON, "print({a} + {b})"], inputs=["a", "b"], read=printed).function(
            np.ones(2)
        )
    # A function around it, as for a vector of inputs, keeps the names.
    around = prb.scalar(lambda pair: by_name(pair[0]))
    assert set(around.function(np.array([2.0, 1.0]))) == {"twice", "one"}
    found = by_name.function(2.0)
    assert found.pop("twice").tolist() == [6.0, 2.0]
    assert found == {"one": 2.0}
    assert type(found["one"]) is float

    # A Series keeps its labels, and a masked number is no response.
    def row(folder: Path) -> pd.Series:
        return pd.Series(both(folder), index=["x", "thrice"])

    labelled = prb.command([*PYTHON, code], read=row, **settings)
    assert labelled.function(2.0).to_dict() == {"x": 2.0, "thrice": 6.0}
    masked = prb.command(
        [*PYTHON, code], read=lambda folder: np.ma.masked_greater(both(folder), 5), **settings
    )
    np.testing.assert_array_equal(masked.function(2.0), [2.0, np.nan])


@pytest.mark.parametrize(
    ("read", "said"),
    [
        (lambda folder: "diverged", r"\(ValueError: could not convert string to float: .*diverged"),
        (lambda folder: {"a": [[1.0], [1.0, 2.0]]}, r"\(ValueError: setting an array"),
        (lambda folder: (folder / "result.dat").read_text(), r"\(FileNotFoundError: .*result.dat"),
        (lambda folder: None, r"\(TypeError: "),
    ],
)
def test_a_result_file_that_is_malformed_is_told_with_the_files_that_are_there(
    read: Any, said: str
) -> None:
    run = prb.command([*PYTHON, "print('step 3 of 7', {x})"], inputs=["x"], read=read)
    text = rf"its results cannot be read {said}.* there are stderr.txt, stdout.txt; it wrote: step"
    with pytest.raises(RuntimeError, match=text):
        run(2.0)


def alive(pid: int) -> bool:
    """Return whether a process is there, and not only waits to be asked how it ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def ended(pids: list[int]) -> bool:
    """Return whether processes are gone within ten seconds."""
    until = time.monotonic() + 10
    while any(map(alive, pids)) and time.monotonic() < until:
        time.sleep(0.05)
    return not any(map(alive, pids))


@pytest.mark.long
@SEES_PROCESSES
def test_the_time_limit_of_a_worker_ends_the_program(tmp_path: Path) -> None:
    code = "import os, time; print(os.getpid(), {x}, flush=True); time.sleep(600)"
    run = prb.command([*PYTHON, code], inputs=["x"], read=printed, folder=tmp_path)

    def late() -> None:
        with time_limit(1.5):
            run(1.0)

    clock = time.monotonic()
    with pytest.raises(TimeoutError):
        late()
    assert time.monotonic() - clock < 60
    (kept,) = tmp_path.iterdir()
    assert ended([int((kept / "stdout.txt").read_text().split()[0])])


@pytest.mark.long
@SEES_PROCESSES
def test_a_time_limit_ends_the_program_and_what_it_started(tmp_path: Path) -> None:
    code = (
        "import os, subprocess, sys, time;"
        "child = subprocess.Popen([sys.executable, '-S', '-c', 'import time; time.sleep(600)']);"
        "print(os.getpid(), child.pid, {x}, flush=True); time.sleep(600)"
    )
    run = prb.command([*PYTHON, code], inputs=["x"], read=printed, timeout=1.5, folder=tmp_path)
    clock = time.monotonic()
    with pytest.raises(TimeoutError, match=r"no result within timeout = 1.5 s; it wrote: \d+"):
        run(1.0)
    assert time.monotonic() - clock < 60
    (kept,) = tmp_path.iterdir()
    pids = [int(pid) for pid in (kept / "stdout.txt").read_text().split()[:2]]
    assert ended(pids)


def test_the_program_is_looked_up_once_and_called_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "solver"
    program.symlink_to(sys.executable)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    run = prb.command(["solver", "-S", "-c", "print({x})"], inputs=["x"], read=printed)
    monkeypatch.undo()
    assert run.function.__name__ == "solver"
    assert run(4.0) == 4


def test_inputs_that_occur_nowhere_and_formats_of_no_number_are_refused() -> None:
    with pytest.raises(ValueError, match=r"got 'z', which occurs neither in the arguments"):
        square(inputs=["x", "z"])
    with pytest.raises(ValueError, match=r"got the field \{x:d\}, expected the format of a number"):
        square(write={"in.txt": "{x:d}"})
    with pytest.raises(ValueError, match=r"got 2 inputs, expected 1: x"):
        square()(1.0, 2.0)
    with pytest.raises(FileNotFoundError, match=r"'no such solver', which is missing or not"):
        prb.command(["no such solver", "{x}"], inputs=["x"], read=printed)


def test_a_program_with_other_inputs_than_the_simulator_is_refused_before_it_runs() -> None:
    two = prb.command(["true", "{a}", "{b}"], inputs=["a", "b"], read=lambda folder: 1.0)
    for units in (None, {"a": "mm"}):
        with pm.Model():
            x = pm.Normal.dist(pm.Normal("mu"), 1.0)
            with pytest.raises(ValueError, match="y: got 1 inputs, expected 2: a, b"):
                prb.Simulator("y", two, x, observed=[1.0, 2.0, 3.0], units=units)
