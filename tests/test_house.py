"""The package keeps to the plan of DESIGN.md: who imports whom, who touches PyMC's inner names, how long files are."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import prbayes

PACKAGE = Path(prbayes.__file__).parent
FILES = sorted(PACKAGE.glob("*.py"))

# A file may import those before it.
ORDER = [
    "_arrays", "density", "discrepancy", "metrics", "inputs", "responses", "propagation", "design", "simulator",
    "population", "information", "refinement", "search", "optimize", "epsilon", "results", "smc", "diagnose", "compare",
]  # fmt: skip

# Upwards, inside a function or for types only, with the reason.
UPWARDS = {
    ("propagation", "design"),  # Reweighted.bind makes its own moving part
    ("refinement", "optimize"),  # the public refine() looks around the optimum
    ("optimize", "results"),  # Optimum.to_datatree
    ("results", "optimize"),  # annotation of optimum_tree
}

INNER = ("pymc.logprob", "pymc.smc", "pymc.pytensorf", "pymc.distributions", "pymc.model.core", "pymc.backends")
MAY_TOUCH_PYMC = {"inputs", "simulator", "population", "smc"}


def imported(path: Path) -> list[str]:
    """Return the modules that a file imports from, anywhere in it."""
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names.append(node.module)
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    return names


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_imports_run_downwards(path: Path) -> None:
    if path.stem == "__init__":
        return
    assert path.stem in ORDER, "a new room: give it a place in DESIGN.md and here"
    for module in imported(path):
        if module.startswith("prbayes."):
            other = module.split(".")[1]
            allowed = ORDER.index(other) < ORDER.index(path.stem) or (path.stem, other) in UPWARDS
            assert allowed, f"{path.stem} imports {other}, which stands above it"


def test_optimiser_and_sampler_know_of_each_other_in_one_direction_only() -> None:
    assert "prbayes.smc" not in imported(PACKAGE / "optimize.py")


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_inner_names_of_pymc_stay_in_their_rooms(path: Path) -> None:
    touched = [m for m in imported(path) if m.startswith(INNER)]
    assert not touched or path.stem in MAY_TOUCH_PYMC, f"{path.stem} imports {touched}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_files_are_short_and_print_nothing(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 400
    calls = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
    assert not {"print", "eval", "exec", "breakpoint"} & {c.func.id for c in calls if isinstance(c.func, ast.Name)}


@pytest.mark.parametrize("name", sorted(set(prbayes.__all__) - {"datasets"}))
def test_public_names_are_documented(name: str) -> None:
    text = getattr(prbayes, name).__doc__
    assert text
    assert text.strip().splitlines()[0].endswith("."), "the summary is one sentence"


def test_the_sign_of_a_discrepancy_changes_in_one_place() -> None:
    sources = [p.stem for p in FILES if "return -discrepancy / epsilon" in p.read_text(encoding="utf-8")]
    assert sources == ["simulator"]
