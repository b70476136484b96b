"""A benchmark's parts in processes of their own, so that memory, compilation and caches are theirs alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from typing import Any


def child(module: str, *arguments: str, cold: bool = False) -> dict[str, Any]:
    """Run a module with ``--child arguments`` and return what it prints; with ``cold``, nothing is compiled yet."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        if cold:
            environment["PYTENSOR_FLAGS"] = f"base_compiledir={folder}"
        done = subprocess.run(
            [sys.executable, "-m", module, "--child", *arguments],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found
