"""Results on disk, with what is needed to read them later: command, commit, versions, date and machine."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
PACKAGES = ("prbayes", "pymc", "pytensor", "arviz", "numba", "numpy", "scipy", "xarray")


def _git(*arguments: str) -> str:
    found = subprocess.run(["git", *arguments], capture_output=True, text=True, check=False)
    return found.stdout.strip()


def _without_folders(argument: str) -> str:
    """Return an argument; of a path from the root of this machine's files its name only."""
    return Path(argument).name if Path(argument).is_absolute() else argument


def about(packages: Iterable[str] = PACKAGES) -> dict[str, Any]:
    """Return how, on what and when this process runs, with the versions of packages."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    module = f"-m {spec.name}" if spec is not None else _without_folders(sys.argv[0])
    # What the benchmarks themselves write is no change of what they measure.
    code = [".", ":!benchmarks/results", ":!docs"]
    status = _git("status", "--porcelain", "--untracked-files=no", "--", *code)
    changed = " with changes" if status else ""
    versions = {"python": platform.python_version()}
    for name in packages:
        versions[name] = importlib.metadata.version(name)
    return {
        "command": " ".join(["python", module, *map(_without_folders, sys.argv[1:])]),
        "commit": _git("rev-parse", "--short", "HEAD") + changed,
        "versions": versions,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }


def _rounded(value: Any) -> Any:
    """Return a value with seven digits of each number."""
    if isinstance(value, float):
        return float(f"{value:.7g}")
    if isinstance(value, dict):
        return {key: _rounded(inner) for key, inner in value.items()}
    return [_rounded(inner) for inner in value] if isinstance(value, list | tuple) else value


def save(path: Path, found: Any, packages: Iterable[str] = PACKAGES) -> None:
    """Write results with seven digits, and how they were computed."""
    path.parent.mkdir(exist_ok=True)
    whole = {"run": about(packages), "found": _rounded(found)}
    path.write_text(json.dumps(whole, separators=(",", ":")) + "\n", encoding="utf-8")


def load(path: Path, missing: Any) -> Any:
    """Return what was found, or ``missing`` where there is no such file."""
    return json.loads(path.read_text(encoding="utf-8"))["found"] if path.exists() else missing
