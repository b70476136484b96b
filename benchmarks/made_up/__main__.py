"""Compare made-up problems with their references.

OMP_NUM_THREADS=1 uv run python -m benchmarks.made_up [--cells "likelihood*"]
"""

from __future__ import annotations

import time
from importlib import import_module
from typing import Any

from benchmarks.made_up import PROBLEMS
from benchmarks.study import Study

MODULES = ("likelihood", "readings", "populations", "decisions")
for module in MODULES:
    import_module(f"benchmarks.made_up.{module}")


def row(cell: str, number: int) -> dict[str, Any]:
    """Return the largest share of an allowed difference, what has it, and CPU seconds."""
    begun = time.process_time()
    name, largest = max(PROBLEMS[cell](), key=lambda found: found[1])
    return {"largest": largest, "of": name, "cpu": time.process_time() - begun}


def summary(rows: list[Any]) -> dict[str, Any]:
    """Return the only row, and whether it holds."""
    row = rows[0]
    return {**row, "holds": row.get("largest", 2.0) <= 1.0}


if __name__ == "__main__":
    Study("made_up", __doc__, PROBLEMS, row, 1, summary, failures=(Exception,)).main()
