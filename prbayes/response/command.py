"""A program that computes the response of one specimen, run in a folder of its own."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from prbayes._validate import Floats, called, flag, folder_path, positive_number
from prbayes.response.call import scalar

# Characters of what a program wrote that an error repeats: its last lines say what went wrong.
_REPEATED = 1000
# Files of a run that an error names: what fits a line.
_NAMED = 12
# Seconds for a program without a time limit: 46 days, the longest that Windows waits for.
_LONGEST = 4e6


def command(
    arguments: Sequence[str | PathLike[str]],
    *,
    inputs: Sequence[str],
    read: Callable[[Path], Any],
    write: Mapping[str, str | PathLike[str]] | None = None,
    timeout: float | None = None,
    folder: str | PathLike[str] | None = None,
    keep: bool = False,
) -> scalar:
    """Turn a program into a response: it is run once for each specimen, in a folder of its own.

    There is no shell: arguments reach the program as they are. What it prints is in the files
    ``stdout.txt`` and ``stderr.txt`` of the folder. The response is of one output or several.

    Parameters
    ----------
    arguments : sequence of str or path
        The program and its arguments. A program without a folder is looked up on the path, once.
    inputs : sequence of str
        Names of the simulator's inputs, in their order. ``{name}`` or ``{name:.6e}`` in an argument
        or a template stands for the value; other braces are left alone.
    read : callable
        ``read(folder)`` takes the response, in the unit of the observed values, from the files in
        the folder: a number, or for several outputs an array, shape (m,), or a mapping of numbers
        or arrays by the names that they have in what was observed.
    write : mapping of str to str or path, optional
        Files to write before each run: the name of the file in the folder, and the text of its
        template, or the path of a template.
    timeout : float, optional
        Seconds after which the program, and all that it started, is killed.
    folder : path, optional
        Where the folders of the runs are made; by default where temporary files are.
    keep : bool
        Whether folders are kept. Those of runs that failed are kept in any case where ``folder`` is
        given.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, or an input occurs nowhere.
    FileNotFoundError
        If there is no such program, or no such template.

    Notes
    -----
    A run fails if the program ends with another code than zero, takes longer than ``timeout``, or
    if ``read`` raises, or gives no numbers. The error tells what the program wrote last; a
    propagation's ``on_failure`` says what becomes of the point. Programs run outside Python, so
    that threads serve as an executor.

    Examples
    --------
    >>> import sys
    >>> spring = command(
    ...     [sys.executable, "-c", "print(float(open('in.txt').read()) * {force})"],
    ...     inputs=["compliance", "force"],
    ...     write={"in.txt": "{compliance:.17g}"},
    ...     read=lambda folder: float((folder / "stdout.txt").read_text()),
    ... )
    >>> spring([0.5, 0.25], 8.0)
    array([4., 2.])
    """
    if not callable(read):
        raise TypeError(
            f"command: read: got {called(read)}, expected a function of the run's folder that "
            "returns numbers"
        )
    found = Program(
        arguments=_arguments(arguments),
        inputs=_names(inputs),
        templates=_templates({} if write is None else write),
        read=read,
        timeout=None if timeout is None else positive_number(timeout, "command: timeout"),
        folder=None if folder is None else folder_path(folder, "command: folder"),
        keep=flag(keep, "command: keep"),
    )
    found.refuse_unused()
    return scalar(found)


@dataclass(frozen=True, eq=False)
class Program:
    """A program as a function of one specimen's inputs."""

    arguments: tuple[str, ...]
    inputs: tuple[str, ...]
    templates: dict[str, str]  # of files, by name
    read: Callable[[Path], Any]
    timeout: float | None
    folder: Path | None
    keep: bool

    @property
    def __name__(self) -> str:
        """The name of the program."""
        return Path(self.arguments[0]).name

    def refuse_unused(self) -> None:
        """Raise if an input occurs nowhere, or cannot be written as it is asked for."""
        written = [*self.arguments[1:], *self.templates.values()]
        for name in self.inputs:
            fields = [field for text in written for field in _field(name).finditer(text)]
            if not fields:
                raise ValueError(
                    f"command: inputs: got {name!r}, which occurs neither in the arguments nor in "
                    f"a template, expected {{{name}}} in one of them: the response would not "
                    "depend on it"
                )
            for field in fields:
                try:
                    _formatted(1.0, field["format"])
                except ValueError:
                    raise ValueError(
                        f"command: got the field {field[0]}, expected the format of a number, such "
                        f"as {{{name}:.6e}}"
                    ) from None

    def __call__(self, *values: float) -> float | Floats | dict[str, float | Floats]:
        """Run the program for one specimen, and read the response.

        Raises
        ------
        RuntimeError
            If the program ends with another code than zero, or its results cannot be read.
        TimeoutError
            If it takes too long; it is ended then, with all that it started.
        ValueError
            If there are more or fewer inputs than names.
        """
        if len(values) != len(self.inputs):
            hint = ""
            if len(values) == 1 and np.size(values[0]) == len(self.inputs):
                elements = ", ".join(f"x[{i}]" for i in range(len(self.inputs)))
                hint = (
                    "; one input that has these as its elements, as correlated ones are, is taken "
                    f"apart by prb.scalar(lambda x: program({elements}))"
                )
            raise ValueError(
                f"{self.__name__}: got {len(values)} inputs, expected {len(self.inputs)}: "
                f"{', '.join(self.inputs)}{hint}"
            )
        known = dict(zip(self.inputs, values, strict=True))
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
        here = Path(tempfile.mkdtemp(prefix=f"{self.__name__}-", dir=self.folder))
        failed = True
        try:
            for name, template in self.templates.items():
                path = here / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(_filled(template, known), encoding="utf-8")
            self._run([_filled(text, known) for text in self.arguments], here)
            found = self._read(here)
            failed = False
        finally:
            kept = self.keep or (failed and self.folder is not None)
            if not kept:
                shutil.rmtree(here, ignore_errors=True)
        return found

    def _run(self, arguments: list[str], here: Path) -> None:
        """Run the program to its end, or end it."""
        with (
            (here / "stdout.txt").open("wb") as stdout,
            (here / "stderr.txt").open("wb") as stderr,
            subprocess.Popen(
                arguments,
                cwd=here,
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
                start_new_session=True,
            ) as process,
        ):
            limit = _LONGEST if self.timeout is None else self.timeout
            try:
                # With a limit it looks again and again, so that what is raised in a worker's thread
                # arrives; without one, only when the program has ended.
                code = process.wait(limit)
            except subprocess.TimeoutExpired:
                raise TimeoutError(
                    f"{self.__name__}: no result within timeout = {limit:g} s"
                    f"{self._last_words(here)}"
                ) from None
            finally:
                # Whatever ends the wait: a limit, Ctrl-C, a worker's time limit.
                if process.returncode is None:
                    _end(process)
        if code != 0:
            raise RuntimeError(
                f"{self.__name__}: ended with code {code}, expected 0{self._last_words(here)}"
            )

    def _read(self, here: Path) -> float | Floats | dict[str, float | Floats]:
        """Return what the program computed, as numbers."""
        try:
            found = self.read(here)
            if isinstance(found, Mapping):
                return {name: _numbers(value) for name, value in found.items()}
            return _numbers(found)
        except TimeoutError:  # a worker's time limit
            raise
        except Exception as error:
            files = sorted(path.name for path in here.iterdir())
            raise RuntimeError(
                f"{self.__name__}: its results cannot be read ({type(error).__name__}: "
                f"{error!s:.300}), expected numbers in the files that it wrote; there are "
                f"{', '.join(files[:_NAMED])}{self._last_words(here)}"
            ) from error

    def _last_words(self, here: Path) -> str:
        """Return the end of what the program wrote, and where all of it is, to add to an error."""
        written = "; it wrote nothing"
        for name in ("stderr.txt", "stdout.txt"):
            text = (here / name).read_text(encoding="utf-8", errors="replace").strip()
            if text:
                written = f"; it wrote: {text[-_REPEATED:]}"
                break
        return written if self.folder is None else f"{written}\nfolder: {here}"


def _arguments(arguments: object) -> tuple[str, ...]:
    """Return the program, where it is, and its arguments."""
    if isinstance(arguments, str) or not isinstance(arguments, Sequence) or not arguments:
        raise TypeError(
            f"command: arguments: got {called(arguments)}, expected a list of the program and its "
            'arguments, such as ["solver", "input.txt"]'
        )
    found = []
    for argument in arguments:
        if not isinstance(argument, str | PathLike):
            raise TypeError(
                f"command: arguments: got {called(argument)} among them, expected texts and paths"
            )
        found.append(os.fspath(argument))
    where = shutil.which(found[0])
    if where is None:
        raise FileNotFoundError(
            f"command: got the program {found[0]!r}, which is not there or cannot be run, expected "
            "one on the path, or its whole path"
        )
    # The program runs in another folder.
    return (os.path.abspath(where), *found[1:])


def _names(inputs: object) -> tuple[str, ...]:
    if isinstance(inputs, str) or not isinstance(inputs, Sequence):
        raise TypeError(
            f"command: inputs: got {called(inputs)}, expected a list of the simulator's inputs, "
            'such as ["modulus", "force"]'
        )
    names = tuple(inputs)
    for name in names:
        if not isinstance(name, str) or not name.isidentifier() or names.count(name) > 1:
            raise ValueError(
                f"command: inputs: got {name!r}, expected names of letters and digits, each once"
            )
    return names


def _templates(write: object) -> dict[str, str]:
    """Return the texts of the files to write, by name."""
    if not isinstance(write, Mapping):
        raise TypeError(
            f"command: write: got {called(write)}, expected templates by the name of their file"
        )
    found = {}
    for name, template in write.items():
        if not isinstance(name, str) or not _is_inside(name):
            raise ValueError(
                f"command: write: got the file {name!r}, expected a name inside the run's folder"
            )
        if isinstance(template, PathLike):
            found[name] = Path(template).read_text(encoding="utf-8")
        elif isinstance(template, str):
            found[name] = template
        else:
            raise TypeError(
                f"command: write: got {called(template)} for {name}, expected the text of a "
                "template, or its path"
            )
    return found


def _is_inside(name: str) -> bool:
    path = Path(name)
    return bool(path.parts) and not path.is_absolute() and ".." not in path.parts


def _field(name: str) -> re.Pattern[str]:
    """Return what finds an input in a text, with its format if it has one."""
    return re.compile(r"\{" + re.escape(name) + r"(?P<format>:[^{}]*)?\}")


def _filled(text: str, values: Mapping[str, float]) -> str:
    """Return a text with values in the place of their names."""
    for name, value in values.items():
        parts = []
        end = 0
        for field in _field(name).finditer(text):
            parts += [text[end : field.start()], _formatted(value, field["format"])]
            end = field.end()
        text = "".join([*parts, text[end:]])
    return text


def _formatted(value: float, layout: str | None) -> str:
    # All digits, unless it is said how many.
    return repr(float(value)) if layout is None else format(float(value), layout[1:])


def _numbers(found: object) -> float | Floats:
    """Return what was read as a number, or an array of them; a text may be one."""
    array = np.asarray(found)
    if array.dtype.kind in "Oc":
        raise TypeError(f"got {called(found)}")
    return array.astype(np.float64) if array.ndim else float(array)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a program that is still there, and what it started."""
    if sys.platform == "win32":
        tree = ["taskkill", "/T", "/F", "/PID", str(process.pid)]
        subprocess.run(tree, capture_output=True, check=False)
    else:
        # It is the first of a session of its own, and was not waited for, so that its number is
        # still its own.
        # A system may refuse where all of it is over already.
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
