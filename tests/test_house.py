"""The package keeps to the plan of DESIGN.md: who imports whom, who touches PyMC's inner names, how long files are."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import prbayes

PACKAGE = Path(prbayes.__file__).parent
FILES = sorted(p for p in PACKAGE.rglob("*.py") if p.parent.name != "datasets")

# A file may import those before it.
ORDER = [
    "_arrays", "progress", "loops", "cells", "density", "discrepancy", "metrics", "failures", "store", "calling",
    "inputs", "responses", "propagation", "resimulation", "design", "simulator", "describe", "surfaces", "region",
    "surrogate", "population", "resampling", "information", "descent", "refit", "modes", "refinement", "search",
    "optimum", "optimize", "epsilon", "adjust", "results", "bootstrap", "checkpoint", "kernel", "smc", "sbc",
    "diagnose", "compare", "heldout", "predict", "nulls", "joint", "validity", "curves", "ensemble", "margins",
    "landscape", "canvas", "plots", "portraits", "trails", "section", "material", "summary", "illustrations",
    "assessment", "contents", "report", "demo", "__main__",
]  # fmt: skip

# Upwards, inside a function or for types only, with the reason.
UPWARDS = {
    ("propagation", "design"),  # a propagation's bind makes its own moving part
    ("propagation", "resimulation"),
    ("refinement", "optimize"),  # the public refine() looks around the optimum
    ("optimum", "results"),  # Optimum.to_datatree
    ("results", "optimum"),  # annotation of optimum_tree
}

# Results, errors and base classes, which nobody makes; and a kernel that is passed to PyMC.
WITHOUT_EXAMPLE = {"BatchedKernel", "DesignError", "Diagnosis", "Metric", "Optimum", "ResponseError", "StoreError",
                    "SurrogateError", "ValidityTest"}  # fmt: skip

INNER = ("pymc.logprob", "pymc.smc", "pymc.pytensorf", "pymc.distributions", "pymc.model.core", "pymc.backends")
MAY_TOUCH_PYMC = {"inputs", "simulator", "population", "kernel"}


# PyMC's private names that are touched, each with a test of what it is used for.
PRIVATE = {("simulator", "_logprob")}  # test_sbc: models sent to other processes


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
            other = module.split(".")[-1]
            allowed = ORDER.index(other) < ORDER.index(path.stem) or (path.stem, other) in UPWARDS
            assert allowed, f"{path.stem} imports {other}, which stands above it"


def test_optimiser_and_sampler_know_of_each_other_in_one_direction_only() -> None:
    assert "prbayes.posterior.smc" not in imported(PACKAGE / "optimize.py")


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


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_nothing_reaches_for_private_attributes_of_pymc(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    private = [
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("pymc")
        for alias in node.names
        if alias.name.startswith("_") and (path.stem, alias.name) not in PRIVATE
    ]
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.endswith("__"):
            source = ast.unparse(node)
            private += [source] if source.startswith(("pm.", "pymc.")) else []
    assert not private


def test_imports_form_no_cycle() -> None:
    """Module-level imports only, whatever ORDER says: each file can be imported first."""
    graph: dict[str, set[str]] = {}
    for path in FILES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        top = [n for n in tree.body if isinstance(n, ast.ImportFrom) and (n.module or "").startswith("prbayes.")]
        graph[path.stem] = {(n.module or "").split(".")[-1] for n in top} & {p.stem for p in FILES}
    done: set[str] = set()
    while ready := {name for name in graph if name not in done and graph[name] <= done}:
        done |= ready
    assert done == set(graph), f"a cycle among {sorted(set(graph) - done)}"


def test_a_new_room_gets_a_place() -> None:
    assert sorted(ORDER) == sorted(p.stem for p in FILES if p.stem != "__init__")


@pytest.mark.parametrize("name", sorted(set(prbayes.__all__) - {"datasets"}))
def test_public_functions_and_configurations_have_an_example(name: str) -> None:
    if name in WITHOUT_EXAMPLE:
        return
    text = getattr(prbayes, name).__doc__
    assert "Examples\n" in text
    assert ">>> " in text


@pytest.mark.parametrize("name", sorted(set(prbayes.__all__) - {"datasets"}))
def test_public_names_are_documented(name: str) -> None:
    text = getattr(prbayes, name).__doc__
    assert text
    assert text.strip().splitlines()[0].endswith("."), "the summary is one sentence"


def test_the_package_imports_nothing_that_draws_or_renders() -> None:
    code = "import sys, prbayes; print({'arviz', 'arviz_plots', 'graphviz', 'jinja2', 'matplotlib'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"


def test_public_names_are_in_the_reference() -> None:
    page = (PACKAGE.parent / "docs" / "api.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^   (\w+)$", page, flags=re.MULTILINE))
    assert listed == set(prbayes.__all__) - {"datasets"}


def test_the_sign_of_a_discrepancy_changes_in_one_place() -> None:
    sources = [p.stem for p in FILES if "return -discrepancy / epsilon" in p.read_text(encoding="utf-8")]
    assert sources == ["simulator"]
