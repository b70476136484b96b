"""Requirements of the package: what it imports, and the same ranges in the conda recipe."""

import ast
import re
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import pytest
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


def test_all_files_name_the_version_and_whether_it_is_a_candidate() -> None:
    project = PROJECT["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == project["version"]
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^## \[([^\]]+)\]", changelog, re.MULTILINE)[1] == project["version"]  # type: ignore[index]
    is_candidate = "rc" in project["version"]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert ("release candidate" in readme) is is_candidate
    assert any("4 - Beta" in name for name in project["classifiers"]) is is_candidate
    assert ("date-released" in citation) is not is_candidate


def test_every_python_of_the_classifiers_is_allowed() -> None:
    listed = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["project"]["classifiers"]))
    allowed = SpecifierSet(PROJECT["project"]["requires-python"])
    assert listed == ["3.12", "3.13"]
    assert listed[0] in allowed
    assert "3.11" not in allowed


LICENCES = dict(
    re.findall(
        r"^\| (.+) \| ([^|]+) \|$",
        (ROOT / "docs/install.md").read_text(encoding="utf-8").partition("## Licences")[2],
        re.MULTILINE,
    )
)


def test_every_requirement_has_its_licence_in_the_documentation() -> None:
    packages = [name for name in LICENCES if re.fullmatch(r"[a-z0-9]+", name)]
    assert sorted(packages) == sorted({*REQUIRED, *EXTRAS, "package", "data"})


@pytest.mark.parametrize("name", [*REQUIRED, *EXTRAS])
def test_the_licence_of_a_requirement_is_that_of_the_installed_package(name: str) -> None:
    try:
        package = distribution(name)
    except PackageNotFoundError:
        pytest.skip("not installed: an extra")
    declared = [str(package.metadata.get("License-Expression", ""))]
    declared += [str(package.metadata.get("License", ""))]
    declared += package.metadata.get_all("Classifier") or []
    paths = [path for path in package.files or [] if path.name.upper().startswith("LICEN")]
    texts = [path.read_text(encoding="utf-8") for path in paths if path.suffix != ".json"]
    text = "\n".join(declared + texts)
    # A classifier names the family only.
    families = {"PSF": "Python Software Foundation", "Apache-2.0": "Apache"}
    licences = re.findall(r"[A-Z][\w.]+(?:-[\w.]+)*", LICENCES[name])
    names = [families.get(licence, licence.partition("-")[0]) for licence in licences]
    assert any(re.search(rf"\b{family}\b", text) for family in names)


def test_data_of_the_repository_alone_are_not_in_the_source_distribution() -> None:
    excluded = PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["exclude"]
    for row, licence in LICENCES.items():
        for name in re.findall(r"`([^`]+)`", row):
            path = ROOT / name
            files = path.glob("*.csv") if path.is_dir() else [path] * (path.suffix == ".csv")
            for file in files:
                place = f"/{file.relative_to(ROOT).as_posix()}"
                is_left_out = any(fnmatch(place, pattern) for pattern in excluded)
                assert is_left_out == ("only in the repository" in licence), place
    assert any("LGPL" in licence for licence in LICENCES.values())


def test_all_data_in_the_repository_have_a_licence() -> None:
    listed = re.findall(r"`([^`]+)`", " ".join(LICENCES))
    command = ["git", "ls-files", "*.csv"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    paths = done.stdout.split()
    assert not [p for p in paths if not any(p.startswith(name) for name in listed)]
    assert all((ROOT / name).exists() for name in listed)
