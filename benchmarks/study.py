"""Frame of a study: data sets by cell, whose rows are stored as they come, and a summary of each cell.

A study is a function of a cell's name and the number of a data set. Its results are a file
``{"summary": {cell: figures}, "rows": {cell: [row, ...]}}``. A study that was interrupted continues
where it stopped. Each module of a study is a program:

    OMP_NUM_THREADS=1 uv run python -m benchmarks.NAME [--data-sets 40] [--cells "PR*"]
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks import record

Rows = list[Any]
_SECONDS = 20.0  # between two writes of the results


@dataclass(frozen=True)
class Study:
    """Cells, what is done with a data set of a cell, and the summary of its rows.

    Attributes
    ----------
    name : str
        The module, and the file of the results.
    doc : str
        What the program says of itself.
    cells : iterable of str
        Names of the cells.
    row : callable
        Cell and number of a data set to a row, which JSON can store.
    data_sets : int
        Of each cell, by default.
    summary : callable, optional
        Rows of a cell to figures.
    failures : tuple of exceptions
        That are results, stored as ``{"error": text}``.
    block : int, optional
        Data sets of a cell before the next cell; all of them by default.
    has_rows : bool
        Whether the file of the results has the rows; otherwise they are in ``results/rows``.
    packages : iterable of str
        Whose versions are stored.
    """

    name: str
    doc: str
    cells: Iterable[str]
    row: Callable[[str, int], Any]
    data_sets: int
    summary: Callable[[Rows], Any] | None = None
    failures: tuple[type[Exception], ...] = ()
    block: int | None = None
    has_rows: bool = True
    packages: Iterable[str] = record.PACKAGES

    @property
    def out(self) -> Path:
        """The file of the results."""
        return record.RESULTS / f"{self.name}.json"

    def stored(self) -> dict[str, Any]:
        """Return the stored results."""
        results: dict[str, Any] = record.load(self.out, {"summary": {}, "rows": {}})
        return results

    def attempt(self, cell: str, number: int) -> Any:
        """Return a row, or the text of a failure."""
        from prbayes._progress import shown  # late: some studies measure the import

        logging.disable(logging.WARNING)
        try:
            with shown(False):
                return self.row(cell, number)
        except self.failures as error:
            return {"error": f"{type(error).__name__}: {error}"[:300]}

    def complete(
        self, cells: Iterable[str], data_sets: int, out: Path, workers: int = 1
    ) -> dict[str, Any]:
        """Compute the data sets of cells that are not stored, and return the results."""
        apart = out.parent / "rows" / out.name
        results: dict[str, Any] = record.load(out, {"summary": {}})
        rows = results.get("rows", {}) if self.has_rows else record.load(apart, {})
        block = self.block or data_sets
        due = time.monotonic()
        for until in range(block, data_sets + block, block):
            for cell in cells:
                of_cell = rows.setdefault(cell, [])
                numbers = range(len(of_cell), min(until, data_sets))
                for row in self._missing(cell, numbers, workers):
                    of_cell.append(row)
                    if len(of_cell) < numbers.stop and time.monotonic() < due:
                        continue
                    if self.summary:
                        results["summary"][cell] = self.summary(of_cell)
                    if self.has_rows:
                        results["rows"] = rows
                    else:
                        record.save(apart, rows)
                    record.save(out, results, self.packages)
                    due = time.monotonic() + _SECONDS
                print(cell, len(of_cell), results["summary"].get(cell, ""), flush=True)
        return results

    def _missing(self, cell: str, numbers: range, workers: int) -> Iterable[Any]:
        attempt = partial(self.attempt, cell)
        if workers == 1:
            yield from map(attempt, numbers)
            return
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            yield from pool.map(attempt, numbers)

    def main(self) -> None:
        """Run the program."""
        names = list(self.cells)
        parser = argparse.ArgumentParser(description=self.doc.splitlines()[0])
        parser.add_argument("--data-sets", type=int, default=self.data_sets)
        parser.add_argument(
            "--cells", nargs="+", default=["*"], help=f"of {', '.join(names)}".replace("%", "%%")
        )
        parser.add_argument("--workers", type=int, default=1)
        parser.add_argument("--out", type=Path, default=self.out)
        given = parser.parse_args()
        chosen = [name for name in names if any(fnmatch(name, pattern) for pattern in given.cells)]
        self.complete(chosen, given.data_sets, given.out, given.workers)
