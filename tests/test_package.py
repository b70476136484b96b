"""Requirements of the package: what it imports, and the same ranges in the conda recipe."""

import ast
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

import prbayes

PACKAGE = Path(prbayes.__file__).parent
ROOT = Path(__file__).parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
RECIPE: dict[str, Any] = yaml.safe_load((ROOT / "recipe/recipe.yaml").read_text(encoding="utf-8"))

# Modules that another package is made of, or requires itself.
PART_OF = {"arviz_plots": "arviz", "arviz_stats": "arviz", "markupsafe": "jinja2"}
# Packages that users may lack: progress bars in a notebook, and the graph of a model in a report.
OPTIONAL = {"graphviz", "ipywidgets"}
# xarray's engine for netCDF, and what that engine reads and writes with.
BY_NAME = {"h5netcdf", "h5py"}
# conda-forge splits Matplotlib: this part needs no toolkit for windows.
ON_CONDA = {"matplotlib": "matplotlib-base"}


def ranges(requirements: list[str]) -> dict[str, SpecifierSet]:
    """Return the versions that are allowed of each package."""
    parsed = map(Requirement, requirements)
    return {requirement.name: requirement.specifier for requirement in parsed}


def conda_ranges(requirements: list[str]) -> dict[str, SpecifierSet]:
    """Return the versions that a list of the recipe allows."""
    parts = [requirement.partition(" ") for requirement in requirements]
    return {name: SpecifierSet(versions) for name, _, versions in parts}


def imported(source: str) -> set[str]:
    """Return the packages that a module imports, or looks for, by name."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Import():
                names |= {alias.name for alias in node.names}
            case ast.ImportFrom(module=str(module), level=0):
                names.add(module)
            case ast.Call(
                func=ast.Name(id="import_module" | "find_spec"),
                args=[ast.Constant(value=str(name))],
            ):
                names.add(name)
    return {name.partition(".")[0] for name in names} - {*sys.stdlib_module_names, "prbayes"}


REQUIRED = ranges(PROJECT["project"]["dependencies"])
EXTRAS = {
    name: versions
    for extra in PROJECT["project"]["optional-dependencies"].values()
    for name, versions in ranges(extra).items()
}


def test_every_import_is_declared_and_every_requirement_is_imported() -> None:
    sources = [path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")]
    found = set().union(*map(imported, sources))
    assert found >= OPTIONAL | set(PART_OF)
    # PyMC runs the samplers of `nuts`.
    expected = (set(REQUIRED) - BY_NAME) | (set(EXTRAS) - {"nutpie", "numpyro"})
    assert {PART_OF.get(name, name) for name in found - OPTIONAL} == expected
    assert any('engine="h5netcdf"' in source for source in sources)


def test_imports_in_functions_and_by_name_are_found() -> None:
    source = (
        "import numpy.linalg as la, os\nfrom . import near\nfrom prbayes import model\n"
        "def late():\n    from scipy import stats\n    import_module('pandas.io')\n"
        "    find_spec('dask')\n"
    )
    assert imported(source) == {"numpy", "scipy", "pandas", "dask"}


def test_the_conda_recipe_has_the_ranges_of_the_package() -> None:
    required = {ON_CONDA.get(name, name): versions for name, versions in REQUIRED.items()}
    python, *run = RECIPE["requirements"]["run"]
    assert python == "python >=${{ python_min }}"
    assert conda_ranges(run) == required
    assert conda_ranges(RECIPE["requirements"]["run_constraints"]) == EXTRAS
    build, *_ = PROJECT["build-system"]["requires"]
    assert build.replace(">", " >") in RECIPE["requirements"]["host"]


def test_the_conda_recipe_is_of_this_version_and_program() -> None:
    project, context = PROJECT["project"], RECIPE["context"]
    assert context["version"] == project["version"] == prbayes.__version__
    assert f">={context['python_min']}" == project["requires-python"]
    assert RECIPE["about"]["license"] == project["license"]
    assert RECIPE["about"]["summary"] == project["description"]
    (script,) = project["scripts"].items()
    assert RECIPE["build"]["python"]["entry_points"] == [" = ".join(script)]


def test_every_python_of_the_classifiers_is_allowed() -> None:
    listed = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["project"]["classifiers"]))
    allowed = SpecifierSet(PROJECT["project"]["requires-python"])
    assert listed == ["3.12", "3.13"]
    assert listed[0] in allowed
    assert "3.11" not in allowed
