"""The checks in .ci and the hosted workflow: they call the same commands, which the README names."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
WORKFLOW: dict[Any, Any] = yaml.safe_load(
    (ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8")
)
RUN = (ROOT / ".ci/run").read_text(encoding="utf-8")
# Commands of .ci/run, each of which prints its time.
STEPS = re.findall(r"^ *step (.*)$", RUN.replace("\\\n", " "), re.MULTILINE)
SYSTEMS = ["ubuntu-latest", "macos-latest", "windows-latest"]


def commands(job: str) -> list[str]:
    """Return the commands that a job of the workflow runs."""
    return [step["run"] for step in WORKFLOW["jobs"][job]["steps"] if "run" in step]


def systems(job: str) -> list[str]:
    """Return the systems on which a job of the workflow runs."""
    if WORKFLOW["jobs"][job]["runs-on"] != "${{ matrix.os }}":
        return [WORKFLOW["jobs"][job]["runs-on"]]
    return list(WORKFLOW["jobs"][job]["strategy"]["matrix"]["os"])


def test_all_checks_run_on_linux() -> None:
    assert systems("everything") == ["ubuntu-latest"]
    assert commands("everything")[-1] == ".ci/run"


@pytest.mark.parametrize("command", ["uv run pytest", "uv run mypy", ".ci/wheel"])
def test_tests_types_and_wheel_are_checked_on_all_systems_as_in_the_script(command: str) -> None:
    assert systems("systems") == SYSTEMS
    assert command in commands("systems")
    assert command in STEPS


def test_the_oldest_and_the_newest_versions_are_tested_on_all_systems() -> None:
    job = WORKFLOW["jobs"]["versions"]
    lowest = (ROOT / ".ci/lowest").read_text(encoding="utf-8")
    assert systems("versions") == SYSTEMS
    assert job["strategy"]["matrix"]["resolution"] == ["lowest-direct", "highest"]
    assert commands("versions") == [".ci/lowest"]
    assert job["steps"][-1]["env"] == {"RESOLUTION": "${{ matrix.resolution }}"}
    assert "${RESOLUTION:-lowest-direct}" in lowest


def test_bytecode_is_compiled_once_for_all_processes() -> None:
    assert WORKFLOW["env"] == {"UV_COMPILE_BYTECODE": "1"}
    assert "export UV_COMPILE_BYTECODE=1" in RUN


def test_the_workflow_may_read_the_repository_and_nothing_else() -> None:
    assert WORKFLOW["permissions"] == {"contents": "read"}
    # YAML 1.1 reads the key `on` as True.
    assert WORKFLOW[True] == {"push": {"branches": ["main"]}, "pull_request": None}


def test_scripts_that_are_called_exist_and_can_be_executed() -> None:
    texts = [RUN, *(command for job in WORKFLOW["jobs"] for command in commands(job))]
    names = set(re.findall(r"\.ci/\w+", " ".join(texts)))
    assert names >= {".ci/run", ".ci/wheel", ".ci/lowest", ".ci/notebooks"}
    assert all(os.access(ROOT / name, os.X_OK) for name in names)


def test_commands_of_the_readme_are_checked() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert re.search(r"^uv run pytest ", readme, re.MULTILINE)
    assert re.search(r"^uv run --group docs sphinx-build -W", readme, re.MULTILINE)
    assert any("uv run --group docs sphinx-build" in step and " -W " in step for step in STEPS)


def test_the_guide_for_contributors_has_the_time_of_every_check() -> None:
    guide = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    checks = set(re.findall(r"^\| `([^`]+)`[^|]* \| [^|]+ \| [^|]+ \|$", guide, re.MULTILINE))
    assert checks >= {"uv run pytest", "uv run ruff check", "uv run mypy", ".ci/wheel"}
    assert checks >= {".ci/run", ".ci/lowest"}
