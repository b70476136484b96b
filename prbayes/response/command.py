"""External programs as responses, each run in its own folder."""

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

from prbayes._validate import (
    Names,
    StrPath,
    called,
    flag,
    folder_path,
    positive_number,
    unmasked,
    wrong_value,
)
from prbayes.response.call import scalar
from prbayes.response.outputs import relabelled


def command(
    arguments: Sequence[StrPath],
    *,
    inputs: Sequence[str],
    read: Callable[[Path], Any],
    write: Mapping[str, StrPath] | None = None,
    timeout: float | None = None,
    folder: StrPath | None = None,
    keep: bool = False,
) -> scalar:
    """Turn a program into a response: it runs once for each specimen, in a folder of the run.

    There is no shell: arguments reach the program unchanged. Its printed output is in the files
    ``stdout.txt`` and ``stderr.txt`` of the folder. The response has one output or several.

    Parameters
    ----------
    arguments : sequence of str or path
        The program and its arguments. A program without a folder is looked up on the path, once.
    inputs : sequence of str
        Names of the simulator's inputs, in their order. ``{name}`` or ``{name:.6e}`` in an argument
        or a template is replaced by the value; other braces are left alone.
    read : callable
        ``read(folder)`` returns the response, in the unit of the observed values, from the files in
        the folder: a number, or for several outputs an array, shape (m,), or a mapping of numbers
        or arrays by the names in ``observed``.
    write : mapping of str to str or path, optional
        Files to write before each run: the name of the file in the folder, and the text of its
        template, or the path of a template.
    timeout : float, optional
        Seconds after which the program, and all that it started, is killed.
    folder : path, optional
        Where the folders of the runs are made; by default where temporary files are.
    keep : bool
        Whether folders are kept. With ``folder``, those of failed runs are kept in any case.

    Returns
    -------
    callable
        The response, to be passed to `Simulator`, `Surrogate.fit` or `predict`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, or an input occurs nowhere.
    FileNotFoundError
        If there is no such program, or no such template.

    Notes
    -----
    A run fails if the program ends with another code than zero, takes longer than ``timeout``, or
    if ``read`` raises, or returns no numbers. The error repeats the last lines of the program; the
    propagation's ``on_failure`` applies. Programs run outside Python, so threads serve as an
    executor.

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
        raise wrong_value(
            read, "command: read", "a function of the run's folder that returns numbers"
        )
    program = Program(
        arguments=_checked_arguments(arguments),
        inputs=_checked_names(inputs),
        templates=_read_templates({} if write is None else write),
        read=read,
        timeout=None if timeout is None else positive_number(timeout, "command: timeout"),
        folder=None if folder is None else folder_path(folder, "command: folder"),
        keep=flag(keep, "command: keep"),
    )
    for name in program.inputs:
        texts = [*program.arguments[1:], *program.templates.values()]
        if [_filled(text, {name: 1.0}) for text in texts] == texts:
            raise ValueError(
                f"command: inputs: got {name!r}, which occurs neither in the arguments nor in a "
                f"template, expected {{{name}}} in one of them: the response would not depend on it"
            )
    return scalar(program)


def _checked_arguments(arguments: object) -> Names:
    """Return the path of the program, and its arguments."""
    if isinstance(arguments, str) or not isinstance(arguments, Sequence) or not arguments:
        raise wrong_value(
            arguments,
            "command: arguments",
            'a list of the program and its arguments, such as ["solver", "input.txt"]',
        )
    for argument in arguments:
        if not isinstance(argument, str | PathLike):
            raise TypeError(
                f"command: arguments: got {called(argument)} among them, expected texts and paths"
            )
    program, *rest = map(os.fspath, arguments)
    path = shutil.which(program)
    if path is None:
        raise FileNotFoundError(
            f"command: got the program {program!r}, which is missing or not executable, expected "
            "one on the path, or its whole path"
        )
    return (os.path.abspath(path), *rest)  # absolute, because it runs in another folder


def _checked_names(inputs: object) -> Names:
    if isinstance(inputs, str) or not isinstance(inputs, Sequence):
        raise wrong_value(
            inputs,
            "command: inputs",
            'a list of the simulator\'s inputs, such as ["modulus", "force"]',
        )
    for name in inputs:
        if not isinstance(name, str) or not name.isidentifier() or inputs.count(name) > 1:
            raise ValueError(
                f"command: inputs: got {name!r}, expected names of letters and digits, each once"
            )
    return tuple(inputs)


def _read_templates(write: object) -> dict[str, str]:
    """Return the texts of the templates by the name of their file."""
    if not isinstance(write, Mapping):
        raise wrong_value(write, "command: write", "templates by the name of their file")
    texts = {}
    for name, template in write.items():
        path = Path(name) if isinstance(name, str) else Path()
        if not path.parts or path.is_absolute() or ".." in path.parts:
            raise ValueError(
                f"command: write: got the file {name!r}, expected a name inside the run's folder"
            )
        if not isinstance(template, str | PathLike):
            raise TypeError(
                f"command: write: got {called(template)} for {name}, expected the text of a "
                "template, or its path"
            )
        if isinstance(template, PathLike):
            template = Path(template).read_text(encoding="utf-8")
        texts[name] = template
    return texts


@dataclass(frozen=True, eq=False)
class Program:
    """A program as a function of one specimen's inputs."""

    arguments: Names
    inputs: Names
    templates: dict[str, str]  # templates of the files to write, by the name of the file
    read: Callable[[Path], Any]
    timeout: float | None
    folder: Path | None
    keep: bool

    @property
    def __name__(self) -> str:
        """The name of the program."""
        return Path(self.arguments[0]).name

    def __call__(self, *values: float) -> Any:
        """Run the program for one specimen, and read the response."""
        self.refuse_misfit(self.__name__, [np.size(value) for value in values])
        by_name = dict(zip(self.inputs, values, strict=True))
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f"{self.__name__}-", dir=self.folder))
        has_failed = True
        try:
            for name, template in self.templates.items():
                path = folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(_filled(template, by_name), encoding="utf-8")
            self._run([_filled(text, by_name) for text in self.arguments], folder)
            outputs = self._outputs(folder)
            has_failed = False
        finally:
            if not (self.keep or (has_failed and self.folder is not None)):
                shutil.rmtree(folder, ignore_errors=True)
        return outputs

    def refuse_misfit(self, name: str, sizes: Sequence[int], outputs: Any = None) -> None:
        """Raise if the number of inputs is not that of the program; sizes are for the message."""
        if len(sizes) == len(self.inputs):
            return
        hint = ""
        if list(sizes) == [len(self.inputs)]:
            elements = ", ".join(f"x[{i}]" for i in range(len(self.inputs)))
            hint = (
                "; for one input with these elements, such as correlated ones, pass "
                f"prb.scalar(lambda x: program({elements}))"
            )
        raise ValueError(
            f"{name}: got {len(sizes)} inputs, expected {len(self.inputs)}: "
            f"{', '.join(self.inputs)}{hint}"
        )

    def _run(self, arguments: list[str], folder: Path) -> None:
        """Run the program to its end; kill it if the wait is interrupted."""
        with (
            (folder / "stdout.txt").open("wb") as stdout,
            (folder / "stderr.txt").open("wb") as stderr,
            subprocess.Popen(
                arguments,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
                start_new_session=True,
            ) as process,
        ):
            try:
                code = process.wait(self.timeout)
            except subprocess.TimeoutExpired:
                raise TimeoutError(
                    f"{self.__name__}: no result within timeout = {self.timeout:g} s"
                    f"{self._last_lines(folder)}"
                ) from None
            finally:
                # The wait may be ended by the time limit, by Ctrl-C, or by a worker's time limit.
                if process.returncode is None:
                    _kill_tree(process)
        if code != 0:
            raise RuntimeError(
                f"{self.__name__}: ended with code {code}, expected 0{self._last_lines(folder)}"
            )

    def _outputs(self, folder: Path) -> Any:
        """Return the results of the program as numbers."""
        try:
            result = self.read(folder)
            if isinstance(result, Mapping):
                return {name: _numbers(value) for name, value in result.items()}
            return _numbers(result)
        except TimeoutError:  # raised by a worker's time limit, not by the reader
            raise
        except Exception as error:
            files = sorted(path.name for path in folder.iterdir())
            raise RuntimeError(
                f"{self.__name__}: its results cannot be read ({type(error).__name__}: "
                f"{error!s:.300}), expected numbers in the files that it wrote; there are "
                f"{', '.join(files[:12])}{self._last_lines(folder)}"
            ) from error

    def _last_lines(self, folder: Path) -> str:
        """Return the end of the printed output, and the folder of the run, for an error message."""
        printed = "; it wrote nothing"
        for name in ("stderr.txt", "stdout.txt"):
            text = (folder / name).read_text(encoding="utf-8", errors="replace").strip()
            if text:
                printed = f"; it wrote: {text[-1000:]}"
                break
        return printed if self.folder is None else f"{printed}\nfolder: {folder}"


def _filled(text: str, values: Mapping[str, float]) -> str:
    """Return a text with values in place of fields, such as {force} or {force:.6e}."""

    def formatted(field: re.Match[str]) -> str:
        if field[1] not in values:
            return field[0]
        value = float(values[field[1]])
        try:
            return repr(value) if field[2] is None else format(value, field[2][1:])
        except ValueError:
            raise ValueError(
                f"command: got the field {field[0]}, expected the format of a number, such as "
                f"{{{field[1]}:.6e}}"
            ) from None

    return re.sub(r"\{(\w+)(:[^{}]*)?\}", formatted, text)


def _numbers(result: object) -> Any:
    """Return a result as a number, or as a labelled array; texts are converted to numbers."""
    array = np.asarray(unmasked(result))
    if array.dtype.kind in "Oc":
        raise TypeError(f"got {called(result)}")
    return relabelled(array.astype(np.float64), result) if array.ndim else float(array)


def _kill_tree(process: subprocess.Popen[bytes]) -> None:
    """End a running program, and all processes that it started."""
    if sys.platform == "win32":
        tree = ["taskkill", "/T", "/F", "/PID", str(process.pid)]
        subprocess.run(tree, capture_output=True, check=False)
    else:
        # The process leads a session, and keeps its number until it is waited for. The system may
        # refuse if all processes of the session have ended.
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
