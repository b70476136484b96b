"""The package keeps to the plan of DESIGN.md: imports, inner names of others, what is public."""

from __future__ import annotations

import ast
import inspect
import json
import os
import re
import runpy
import subprocess
import sys
from enum import Enum
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import structure
from structure import parsed

import prbayes

PACKAGE = Path(prbayes.__file__).parent
ROOT = Path(__file__).parents[1]
FILES = sorted(PACKAGE.rglob("*.py"))
README = (ROOT / "README.md").read_text(encoding="utf-8")
README_OUTPUTS = re.findall(r"^```text\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
README_SCRIPTS = re.findall(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL)

# Rooms below everything else, which may import each other.
_GROUND = (
    "_validate",
    "_finding",
    "_display",
    "_progress",
    "_stats",
    "datasets",
)
# Each floor may import from those before it; rooms of one floor do not import each other.
LAYERS = (
    _GROUND,
    ("numerics",),
    ("readings",),
    ("metrics", "response"),
    ("emulators", "families"),
    ("propagation",),
    ("specimens",),
    ("model",),
    ("inference",),
    ("optimize",),
    ("posterior",),
    ("results",),
    ("validation", "decision"),
    ("plots",),
    ("reports",),
    ("surrogate",),
    ("cli",),
    ("__main__",),
)
FLOOR = {room: floor for floor, rooms in enumerate(LAYERS) for room in rooms}
# Rooms of one floor that may import each other.
TOGETHER = (set(_GROUND),)
CEILINGS = json.loads((ROOT / "tests" / "structure_ceilings.json").read_text(encoding="utf-8"))

# Results, errors and base classes, which nobody makes; and a kernel that is passed to PyMC.
WITHOUT_EXAMPLE = {
    "BatchedKernel",
    "BudgetError",
    "Bound",
    "Cost",
    "CrossValidation",
    "DensityDiscrepancy",
    "DensityEstimator",
    "DesignError",
    "Diagnosis",
    "Discrepancy",
    "Metric",
    "Minimum",
    "Optimum",
    "Propagation",
    "Quantity",
    "ReadingDistribution",
    "ResponseError",
    "Store",
    "StoreError",
    "Surface",
    "ValidityTest",
}


def public() -> dict[str, Any]:
    """Return what users may import, by name: that of the package, and that of its namespaces."""
    found = {}
    for name in prbayes.__all__:
        value = getattr(prbayes, name)
        if isinstance(value, ModuleType):
            found |= {f"{name}.{inner}": getattr(value, inner) for inner in value.__all__}
        else:
            found[name] = value
    return found


PUBLIC = public()


def dotted(path: Path) -> str:
    """Return the dotted name of a file of the package, without the package's own."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


def imported(path: Path) -> list[str]:
    """Return what a file imports, anywhere in it, as dotted names: `from a import b` is a.b."""
    names: list[str] = []
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    return names


MODULES = {dotted(path) for path in FILES}


@cache
def package_imports(path: Path) -> set[str]:
    """Return the modules of the package that a file imports; that of the package itself is empty."""
    modules: set[str] = set()
    for name in imported(path):
        parts = name.split(".")
        if parts[0] != "prbayes":
            continue
        prefixes = [".".join(parts[1:end]) for end in range(len(parts), 1, -1)]
        modules.add(next((prefix for prefix in prefixes if prefix in MODULES), ""))
    return modules


def room(module: str) -> str:
    return module.split(".")[0]


def upward_imports(path: Path) -> list[str]:
    """Return the imports of a file from its own floor or from above, one line for each."""
    module = dotted(path)
    if module in ("", "__init__"):
        return []
    if room(module) not in FLOOR:
        return [f"{module} is in a new room: give it a floor in DESIGN.md and here"]
    lines = []
    for target in sorted(package_imports(path)):
        if not target:
            lines.append(f"{module} imports the package itself, which is above everything")
            continue
        rooms = {room(module), room(target)}
        is_below = FLOOR.get(room(target), len(LAYERS)) < FLOOR[room(module)]
        if len(rooms) > 1 and not is_below and not any(rooms <= group for group in TOGETHER):
            lines.append(f"{module} imports {target}")
    return lines


def test_imports_run_downwards() -> None:
    violations = [line for path in FILES for line in upward_imports(path)]
    assert not violations, "\n".join(violations)


@cache
def current_figures() -> dict[str, structure.Figure]:
    return structure.limited_figures(PACKAGE)


def test_figures_of_the_structure_stay_below_their_ceilings() -> None:
    """Ceilings only go down: a figure that has improved lowers its own."""
    figures = current_figures()
    errors = [structure.ceiling_error(name, figures[name], CEILINGS[name]) for name in CEILINGS]
    assert not any(errors), "\n".join(filter(None, errors))


def test_every_figure_of_the_structure_has_a_ceiling() -> None:
    assert set(CEILINGS) == set(current_figures())


def test_files_print_nothing_and_evaluate_nothing() -> None:
    forbidden = {"print", "eval", "exec", "breakpoint"}
    violations = [
        f"{dotted(path)}:{node.lineno} calls {node.func.id}"
        for path in FILES
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in forbidden
    ]
    assert not violations, "\n".join(violations)


def sections(value: Any) -> dict[str, str]:
    """Return the sections of a numpydoc docstring, and its summary, by title."""
    text = f"Summary\n---\n{inspect.getdoc(value)}"
    parts = re.split(r"^([A-Z][a-z]+)\n---+\n", text, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def documented(value: Any) -> set[str]:
    """Return the parameters that a docstring describes; a base class has attributes."""
    parts = sections(value)
    text = parts.get("Parameters", "") + parts.get("Attributes", "")
    lines = re.findall(r"^([*\w, ]+?)(?: :.*)?$", text, re.MULTILINE)
    return {name.strip(" *") for line in lines for name in line.split(",")}


def members_in_the_reference() -> dict[str, Any]:
    """Return the methods with arguments that pages of classes show, by name."""
    template = (ROOT / "docs/_templates/autosummary/class.rst").read_text(encoding="utf-8")
    shown = set(re.findall(r'"(\w+)"', template.partition("in [")[2].partition("]")[0]))
    hidden = re.findall(r"\w+", template.partition("exclude-members:")[2].partition("\n")[0])
    return {
        f"{name}.{key}": getattr(value, "__func__", value)
        for name, cls in PUBLIC.items()
        if name.split(".")[-1] in shown - WITHOUT_EXAMPLE | {"Store", "Optimum", "ValidityTest"}
        for key, value in vars(cls).items()
        if key[0] != "_" and key not in hidden
        if inspect.isfunction(getattr(value, "__func__", value))
    }


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_a_public_name_has_all_sections(name: str) -> None:
    value = PUBLIC[name]
    parts = sections(value)
    assert parts["Summary"].splitlines()[0].endswith(".")
    is_base = name.split(".")[-1] in WITHOUT_EXAMPLE
    assert is_base or ">>> " in parts["Examples"]
    if not (is_base and issubclass(value, Exception | Enum)):
        parameters = inspect.signature(value).parameters
        assert parameters.keys() <= documented(value)
        assert is_base or not parameters or "Raises" in parts
    assert inspect.isclass(value) or "Returns" in parts or returns_nothing(value)


def returns_nothing(function: Any) -> bool:
    """Return whether a function is annotated so."""
    return inspect.signature(function).return_annotation in ("None", None)


METHODS = members_in_the_reference()


@pytest.mark.parametrize("name", sorted(METHODS))
def test_a_method_of_the_reference_has_all_sections(name: str) -> None:
    method = METHODS[name]
    parts = sections(method)
    arguments = inspect.signature(method).parameters.keys() - {"self", "cls"}
    assert parts["Summary"].splitlines()[0].endswith(".")
    assert arguments <= documented(method)
    assert not arguments or "Raises" in parts
    assert not arguments or "Returns" in parts or returns_nothing(method)


def test_no_module_at_the_top_has_the_name_of_a_public_function() -> None:
    """Once imported, `prbayes/compare.py` would take the place of `prb.compare`, which is lazy."""
    # Not getattr, which may return the module
    names = {n for n in prbayes.__all__ if not inspect.ismodule(prbayes.__getattr__(n))}
    clashes = names & {room(module) for module in MODULES}
    assert not clashes


# How work is done, by keyword, after what is done; in this order.
TAIL = (
    "labels",
    "executor",
    "store",
    "version",
    "on_failure",
    "retry_failed",
    "max_stages",
    "max_seconds",
    "max_runs",
    "checkpoint",
    "random_seed",
    "progressbar",
)
# What computes responses, refits or replicates, and may so take long.
SLOW = (
    "Simulator",
    "Surrogate.fit",
    "area_test",
    "bootstrap",
    "calibrate_each",
    "cross_validate",
    "minimize",
    "predict",
    "rank",
    "refine",
    "repeat_runs",
    "sample",
    "sample_smc",
    "simulation_based_calibration",
)
SIGNATURES = {
    name: inspect.signature(value)
    for name, value in (PUBLIC | {"Surrogate.fit": prbayes.Surrogate.fit}).items()
    if inspect.isroutine(value)
}


def test_public_functions_have_their_arguments_in_one_order() -> None:
    violations = []
    for name, signature in SIGNATURES.items():
        parameters = {
            key: p.kind
            for key, p in signature.parameters.items()
            if p.kind is not inspect.Parameter.VAR_KEYWORD
        }
        common = sorted(parameters.keys() & TAIL, key=TAIL.index)
        is_last = list(parameters)[len(parameters) - len(common) :] == common
        if not is_last or any(
            parameters[key] is not inspect.Parameter.KEYWORD_ONLY for key in common
        ):
            violations.append(name)
    assert not violations


# Words that say one thing each: those on the left are spelled as those on the right.
ONE_WORD = {
    "alpha": ("level", "size", "significance"),
    "n_draws": ("num_draws",),
    "n_samples": ("samples", "num_samples"),
    "observed": ("measured", "data", "measurements"),
    "prob": ("level", "coverage", "ci_prob", "hdi_prob"),
    "random_seed": ("seed", "rng"),
}
# A section of a report has a heading of some level, and a title, a text and a table by position.
OTHER_VOICE = {"reports.Section": {"level", "table"}}


def test_arguments_speak_in_one_voice() -> None:
    """One word for one thing, and options are keywords: at most one positional argument has a default."""
    unwanted = {word for words in ONE_WORD.values() for word in words}
    violations = []
    for name, value in (PUBLIC | {"Surrogate.fit": prbayes.Surrogate.fit}).items():
        if not callable(value) or name.split(".")[-1] in WITHOUT_EXAMPLE | {"Surrogate"}:
            continue
        parameters = inspect.signature(value).parameters
        violations += [
            f"{name}: {key}" for key in parameters.keys() & unwanted - OTHER_VOICE.get(name, set())
        ]
        positional = [
            key
            for key, p in parameters.items()
            if p.kind is p.POSITIONAL_OR_KEYWORD and p.default is not p.empty
        ]
        violations += [
            f"{name}: {key} is positional"
            for key in positional[1:]
            if key not in OTHER_VOICE.get(name, set())
        ]
        if "result" in parameters and next(iter(parameters)) != "result":
            violations.append(f"{name}: result is not the first argument")
    assert not violations


def test_what_is_slow_has_a_progress_bar_that_can_be_left_out() -> None:
    with_bar = [name for name, s in SIGNATURES.items() if "progressbar" in s.parameters]
    assert sorted(with_bar) == list(SLOW)
    assert all(SIGNATURES[name].parameters["progressbar"].default is True for name in SLOW)


def test_seeds_are_zero_by_default() -> None:
    for name, value in PUBLIC.items():
        if name == "posterior.BatchedKernel":
            continue  # made by PyMC, which hands it a generator
        if isinstance(value, type) and issubclass(value, Exception):
            continue
        parameters = inspect.signature(value).parameters
        assert "seed" not in parameters
        if "random_seed" in parameters:
            assert parameters["random_seed"].default == 0, name


DESIGN = (ROOT / "DESIGN.md").read_text(encoding="utf-8")


def test_design_shows_the_rooms_in_their_own_words() -> None:
    rows = dict(re.findall(r"^\| `(\w+)(?:/|\.py)` \| (.*) \|$", DESIGN, flags=re.MULTILINE))
    assert set(rows) == {room(module) for module in MODULES - {""}} - {"__init__"}
    for name, words in rows.items():
        folder = PACKAGE / name
        path = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
        summary = (ast.get_docstring(parsed(path)) or "").split("\n\n")[0].replace("\n", " ")
        assert words == summary, f"DESIGN.md says of {name}: {words}; the module: {summary}"


def test_design_names_what_there_is() -> None:
    defined = {path.stem for path in FILES} | {path.parent.name for path in FILES}
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        defined |= set(re.findall(r"^ *(?:class|def) (\w+)", text, re.MULTILINE))
        defined |= set(re.findall(r"^([A-Z]\w*) = ", text, re.MULTILINE))
    named = set(re.findall(r"`(?:prb\.)?(\w+)`", DESIGN))
    assert named - defined == set()
    assert len(DESIGN.split()) < 1300  # two pages


@pytest.mark.long
def test_the_package_imports_nothing_heavy_that_it_may_not_need() -> None:
    code = "import sys, prbayes; prbayes.minimize; print({'arviz', 'arviz_plots', 'graphviz', 'jinja2', 'matplotlib', 'scipy.optimize', 'scipy.stats'} & set(sys.modules))"
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "set()\n"
    )


def test_public_names_are_in_the_reference() -> None:
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    listed: dict[str, set[str]] = {}
    blocks = re.findall(r"^\.\. currentmodule:: (\S+)\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    for module, block in blocks:
        names = re.findall(r"^   (\w+)$", block, flags=re.MULTILINE)
        listed.setdefault(module, set()).update(names)
    namespaces = {name for name in prbayes.__all__ if inspect.ismodule(getattr(prbayes, name))}
    expected = {"prbayes": set(prbayes.__all__) - namespaces}
    for name in namespaces - {"datasets"}:  # the data are listed by automodule
        expected[f"prbayes.{name}"] = set(getattr(prbayes, name).__all__)
    assert listed == expected


@pytest.mark.long
@pytest.mark.parametrize("number", [0, 1])
def test_scripts_of_the_readme_print_what_it_says(
    number: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    preamble, _ = README_SCRIPTS[0].split("with pm.Model()")
    script = tmp_path / "example.py"
    script.write_text((preamble if number else "") + README_SCRIPTS[number], encoding="utf-8")
    variables = runpy.run_path(str(script))
    assert variables["optimum"].converged
    printed, shown = capsys.readouterr().out, README_OUTPUTS[number]
    values = [re.findall(r"\d+\.\d+|\d+(?= runs)", text) for text in (printed, shown)]
    # Other processors round differently; the last digit may differ where libraries are others.
    ours, theirs = np.array(values, float)
    np.testing.assert_allclose(ours[:16], theirs[:16], atol=0.0101)
    np.testing.assert_allclose(ours[16:], theirs[16:], atol=15)  # runs
    texts = [re.sub(r"\d+(?= runs)", "N", text) for text in (printed, shown)]
    words = [[line.split()[:1] for line in text.splitlines()] for text in texts]
    assert words[0][:7] == words[1][:7]


@pytest.mark.slow
def test_the_table_of_the_readme_is_what_its_example_prints(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "examples" / "crack_growth.py"), "--out", str(tmp_path)]
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    printed = re.findall(r" (?:mu|sigma) +(\d\.\d{3})  (\d\.\d{3}) ", done.stdout)
    rows = re.findall(r"^\| [\w -]+ (\|(?: \d\.\d{3} ± \d\.\d{3} \|){4})$", README, re.MULTILINE)
    told = [tuple(cell.split(" ± ")) for row in rows for cell in row.strip("| ").split(" | ")]
    assert len(told) == 20
    assert told == printed


def negations_of_a_discrepancy(path: Path) -> list[str]:
    """Return the functions of a file that divide minus a discrepancy by epsilon, by their syntax trees."""
    found = []
    for function in ast.walk(parsed(path)):
        if not isinstance(function, ast.FunctionDef):
            continue
        for node in ast.walk(function):
            if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
                names = {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
                names |= {n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute)}
                if any("discrepanc" in name for name in names):
                    found.append(f"{dotted(path)}.{function.name}")
    return found


def test_the_sign_of_a_discrepancy_changes_in_one_place() -> None:
    found = [place for path in FILES for place in negations_of_a_discrepancy(path)]
    assert found == ["model.random_variable.log_kernel"]


def constants(path: Path) -> list[tuple[str, ast.expr, ast.Assign]]:
    """Return the constants at the top of a file: names in capitals, their values, the statements."""
    found: list[tuple[str, ast.expr, ast.Assign]] = []
    for statement in parsed(path).body:
        if not isinstance(statement, ast.Assign):
            continue
        (target,) = statement.targets
        pairs = [(target, statement.value)]
        if isinstance(target, ast.Tuple) and isinstance(statement.value, ast.Tuple):
            pairs = list(zip(target.elts, statement.value.elts, strict=True))
        for name, value in pairs:
            if isinstance(name, ast.Name) and name.id.isupper():
                found.append((name.id, value, statement))
    return found


def is_numeric(value: ast.expr) -> bool:
    """Return whether a value is made of numbers alone."""
    leaves = [n for n in ast.walk(value) if isinstance(n, ast.Constant | ast.Name | ast.Call)]
    numbers = [
        n for n in leaves if isinstance(n, ast.Constant) and isinstance(n.value, int | float)
    ]
    return bool(leaves) and len(numbers) == len(leaves)


def reason(path: Path, statement: ast.Assign) -> str:
    """Return what is said of a constant: beside it, or above it and its neighbours."""
    lines = path.read_text(encoding="utf-8").splitlines()
    last = lines[statement.end_lineno - 1 if statement.end_lineno else 0]
    _, _, beside = last.partition("  # ")
    first = statement.lineno - 1
    neighbours = {
        n for _, _, other in constants(path) for n in range(other.lineno - 1, other.end_lineno or 0)
    }
    while first - 1 in neighbours:
        first -= 1
    above = []
    while lines[first - 1].startswith("# "):
        first -= 1
        above.append(lines[first][2:])
    return " ".join([*reversed(above), beside])


def test_a_number_says_why() -> None:
    unexplained = []
    for path in FILES:
        for name, value, statement in constants(path):
            if is_numeric(value):
                comment = re.sub("by judgement", "", reason(path, statement), flags=re.IGNORECASE)
                if len(comment.split()) < 5:
                    unexplained.append(f"{dotted(path)}.{name}")
    assert not unexplained, f"a comment of five words or more says why: {unexplained}"


FOREIGN = ("pymc", "pytensor", "arviz", "arviz_base", "arviz_stats", "arviz_plots")


def inner(path: Path) -> set[str]:
    """Return names below the top of a foreign package that a file imports, or reaches as pm.distributions.x."""
    found = {name for name in imported(path) if name.split(".")[0] in FOREIGN}
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute):
            whole = ast.unparse(node).split(".")
            if (
                whole[0] == "pm"
                and len(whole) > 2
                and whole[1] in ("distributions", "logprob", "model")
            ):
                found.add(".".join(["pymc", *whole[1:]]))
    inner = {name for name in found if name.count(".") > 1}
    return {name for name in inner if not any(other.startswith(f"{name}.") for other in inner)}


def test_inner_names_of_others_have_contracts() -> None:
    tested = inner(ROOT / "tests" / "test_contracts.py")
    without = {dotted(path): names for path in FILES if (names := inner(path) - tested)}
    assert not without, f"imported without a test in tests/test_contracts.py: {without}"


def asked_of_executors() -> set[str]:
    """Return names that the package asks executors for: by `getattr`, and in the table of what a pool was made with."""
    path = PACKAGE / "response" / "executors.py"
    found: set[str] = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "getattr":
            name = node.args[1]
            found |= {str(name.value)} if isinstance(name, ast.Constant) else set()
        if isinstance(node, ast.Constant) and re.fullmatch(r"_[a-z_]+", str(node.value)):
            found.add(str(node.value))
    return found


def test_inner_names_of_executors_have_contracts() -> None:
    names = asked_of_executors()
    assert "_max_workers" in names
    contracts = (ROOT / "tests" / "test_contracts.py").read_text(encoding="utf-8")
    assert all(re.search(rf"\b{name}\b", contracts) for name in names)
    # Executors are asked nowhere else.
    others = [path for path in FILES if path.stem != "executors"]
    texts = [path.read_text(encoding="utf-8") for path in others]
    assert not any(f'"{name}"' in text for text in texts for name in names)


def test_the_page_of_findings_has_every_code() -> None:
    calls = [
        node for path in FILES for node in ast.walk(parsed(path)) if isinstance(node, ast.Call)
    ]
    findings = [call.args[0] for call in calls if getattr(call.func, "id", "") == "Finding"]
    codes = {code.value for code in findings if isinstance(code, ast.Constant)}
    page = (ROOT / "docs" / "findings.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w-]+)` \|", page, flags=re.MULTILINE)
    assert len(rows) == len(set(rows))
    assert set(rows) == codes


def test_promises_name_tests_that_are_there() -> None:
    page = (ROOT / "docs" / "promises.md").read_text(encoding="utf-8")
    promises, rest = page.split("## How often")
    rows = re.findall(r"^<small>Tests: (.*)</small>$", promises, flags=re.MULTILINE)
    assert len(rows) == promises.count("\n## ") >= 10
    assert "<small>" not in rest
    there: set[str] = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        there |= set(re.findall(r"^def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE))
    for row in rows:
        named = re.findall(r"`(test_\w+)`", row)
        assert named, "each promise has its test"
        assert set(named) <= there
