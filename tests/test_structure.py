"""Figures of the structure, on a package that is small enough to count by hand."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
import structure

import prbayes

FILES = {
    "__init__.py": "",
    "first.py": '''
from package import second

LIMIT = 3
LEVELS = (0.1, 0.5)
NAME = "text"
_WITH_UNIT = (2, "seconds")


class Large:
    """A class with three members and a special method."""

    size: int

    def __init__(self):
        pass

    @property
    def area(self):
        return outer(self.size)

    def _hidden(self):
        pass


def outer(a, /, b=0, *rest, c=1, **options):
    """Return a number."""
    found = _inner(a)
    return found


def _inner(weights):
    x = y = weights
    return last(x) + _inner(y)


def last(value):
    return value
''',
    "second.py": """
import package.third

def check(metric):
    return isinstance(metric, (int, AreaMetric))
""",
    "third.py": """
from package.first import outer

class AreaMetric:
    def same(self, metric):
        return isinstance(metric, AreaMetric)
""",
}


@pytest.fixture
def figures(tmp_path: Path) -> dict[str, structure.Figure]:
    package = tmp_path / "package"
    package.mkdir()
    for name, text in FILES.items():
        (package / name).write_text(text, encoding="utf-8")
    return structure.limited_figures(package)


def test_figures_of_a_small_package(figures: dict[str, structure.Figure]) -> None:
    assert {name: figure.value for name, figure in figures.items()} == {
        "vague names among assignments, %": pytest.approx(100 / 8, abs=0.01),
        "longest static chain of calls": 4,
        "module-level numeric constants": 2,
        "members of the largest class": 3,
        "syntax nodes per code line": pytest.approx(64 / 10),
        "longest function body, lines": 2,
        "most parameters": 3,
        "private functions per public function": pytest.approx(2 / 5, abs=0.01),
        "import circles": 1,
        "type switches outside their file": 1,
    }


def test_places_of_a_small_package(figures: dict[str, structure.Figure]) -> None:
    places = {name: figure.places for name, figure in figures.items()}
    assert places["vague names among assignments, %"] == ("found (1)", "package/first.py (1)")
    assert places["longest static chain of calls"] == ("area > outer > _inner > last",)
    assert places["members of the largest class"][0] == "package/first.py:Large (3)"
    assert places["most parameters"][0] == "package/first.py:outer (3)"
    assert places["import circles"] == ("package.first, package.second, package.third",)
    assert places["type switches outside their file"] == ("package/second.py:5",)


def test_nodes_and_lines_of_a_function() -> None:
    (function,) = ast.parse(
        'def f(x):\n    """Text."""\n    y = 2\n    return (\n        y\n    )\n'
    ).body
    assert isinstance(function, ast.FunctionDef)
    # Assign, Name, Store, Constant; Return, Name, Load; lines 3, 4 and 5
    assert structure.nodes_and_lines(function) == (7, 3)
    assert len(structure.body_without_docstring(function)) == 2


def test_a_figure_above_its_ceiling_names_the_places() -> None:
    figure = structure.Figure(11, ("a.py (6)", "b.py (5)"))
    error = structure.ceiling_error("constants", figure, 10)
    assert error.startswith("constants: got 11, expected at most 10; largest:")
    assert "a.py (6)" in error
    assert "b.py (5)" in error


@pytest.mark.parametrize(
    ("value", "ceiling", "is_error"),
    [(10, 10, False), (9, 10, True), (98, 100, False), (97, 100, True), (0, 0, False), (0.8, 0.85, False)],
)  # fmt: skip
def test_a_figure_far_below_its_ceiling_lowers_it(
    value: float, ceiling: float, is_error: bool
) -> None:
    error = structure.ceiling_error("a share", structure.Figure(value), ceiling)
    assert bool(error) == is_error
    assert not is_error or f"lower the ceiling to {value}" in error


def test_concrete_classes_exist() -> None:
    """A class that was renamed would be a type switch that nobody counts."""
    modules = structure.read(Path(prbayes.__file__).parent)
    classes = {n.name for m in modules for n in ast.walk(m.tree) if isinstance(n, ast.ClassDef)}
    assert classes >= structure.CONCRETE_CLASSES
