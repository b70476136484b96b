"""Functional Mock-up Units for tests: built here, and changed as is needed."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

HERE = Path(__file__).parent
WHY = "the extra prbayes[codes] and the packages of the group dev make units: uv sync --all-extras"


def built(folder: Path, version: int = 2) -> Path:
    """Return a unit of a version of FMI."""
    pytest.importorskip("fmpy", reason=WHY)
    builder = {2: "pythonfmu", 3: "pythonfmu3"}[version]
    pytest.importorskip(builder, reason=WHY)
    source = HERE / {2: "oscillator.py", 3: "oscillator3.py"}[version]
    command = [sys.executable, "-m", builder, "build", "-f", str(source), "-d", str(folder)]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    return folder / {2: "Oscillator.fmu", 3: "Oscillator3.fmu"}[version]


def changed(
    unit: Path,
    target: Path,
    *swaps: tuple[str, str],
    keep: Callable[[str], bool] = lambda name: True,
    **files: bytes,
) -> Path:
    """Return a copy of a unit with other words in its description, some of its files, and others in the place of those with an ending."""
    with zipfile.ZipFile(unit) as old, zipfile.ZipFile(target, "w") as new:
        for name in filter(keep, old.namelist()):
            content = old.read(name)
            if name == "modelDescription.xml":
                text = content.decode()
                for was, is_now in swaps:
                    assert was in text
                    text = text.replace(was, is_now)
                content = text.encode()
            new.writestr(name, files.get(Path(name).suffix[1:], content))
    return target
