"""The frame of the studies in benchmarks/: rows are stored, continued, and summed up."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import record
from benchmarks.study import Study


def row(cell: str, number: int) -> float:
    if cell == "bad" and number == 1:
        raise ValueError("no root")
    return float(number)


def count(rows: list[Any]) -> dict[str, int]:
    return {"data sets": len(rows), "failed": sum(isinstance(row, dict) for row in rows)}


@pytest.mark.parametrize("has_rows", [True, False])
def test_a_study_continues_where_it_stopped(has_rows: bool, tmp_path: Path) -> None:
    study = Study(
        "x", "A study.", ["good", "bad"], row, 4, count, (ValueError,), block=2, has_rows=has_rows
    )
    out = tmp_path / "x.json"
    study.complete(["good"], 1, out)
    study.complete(study.cells, 4, out)
    stored = record.load(out, None)
    assert stored["summary"] == {
        "good": {"data sets": 4, "failed": 0}, "bad": {"data sets": 4, "failed": 1}
    }  # fmt: skip
    rows = stored["rows"] if has_rows else record.load(tmp_path / "rows" / "x.json", None)
    error = {"error": "ValueError: no root"}
    assert rows == {"good": [0.0, 1.0, 2.0, 3.0], "bad": [0.0, error, 2.0, 3.0]}
    assert ("rows" in stored) == has_rows


def test_an_error_that_is_no_result_stops_a_study(tmp_path: Path) -> None:
    study = Study("x", "A study.", ["bad"], row, 2)
    with pytest.raises(ValueError, match="no root"):
        study.complete(study.cells, 2, tmp_path / "x.json")


def test_the_record_of_a_run_has_no_folder_of_its_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", None)
    monkeypatch.setattr(sys, "argv", ["/a/folder/table.py", "--out", "/a/folder/x.json"])
    assert record.about(("numpy",))["command"] == "python table.py --out x.json"
