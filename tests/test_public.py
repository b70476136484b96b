"""The package loads a public name when it is used, and type checkers know all of them."""

import ast
import inspect
import pydoc
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import prbayes as prb


@pytest.mark.long
def test_nothing_is_loaded_before_a_public_name_is_asked_for() -> None:
    code = (
        "import sys, prbayes\n"
        "assert prbayes.__version__\n"
        "assert not {'pymc', 'numpy', 'xarray'} & set(sys.modules)\n"
        "assert prbayes.minimize.__module__ == 'prbayes.optimize.minimize'\n"
        "assert 'pymc' in sys.modules\n"
        "from prbayes import *\n"
        "assert Simulator is prbayes.Simulator\n"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)


def test_what_there_is_not_is_told_by_the_package_s_own_name() -> None:
    for name in ("nothing", "_nothing"):
        with pytest.raises(AttributeError, match=rf"module 'prbayes' has no attribute '{name}'"):
            getattr(prb, name)
    assert {"minimize", "decision", "__version__"} <= set(dir(prb))
    assert not hasattr(prb, "Nothing")


def test_type_checkers_see_the_public_names_and_no_others() -> None:
    stub = Path(str(prb.__file__)).with_suffix(".pyi")
    body = ast.parse(stub.read_text(encoding="utf-8")).body
    imports = [node for node in body if isinstance(node, ast.ImportFrom)]
    aliases = [(alias, node.module) for node in imports for alias in node.names]
    assert sorted(alias.name for alias, _ in aliases) == prb.__all__
    for alias, module in aliases:
        assert alias.asname == alias.name  # else a type checker takes it for private
        if module != "prbayes":
            assert getattr(prb, alias.name).__module__ == module
    # A function `__getattr__` would make every misspelled name valid.
    assert not any(isinstance(node, ast.FunctionDef) for node in body)


# Results, which no user constructs.
RESULTS = {"Cost", "CrossValidation", "Diagnosis", "Optimum", "Surrogate", "ValidityTest"}


def test_help_of_a_class_shows_the_arguments_of_users() -> None:
    values = [getattr(prb, name) for name in prb.__all__]
    modules = [value for value in values if isinstance(value, ModuleType)]
    values += [getattr(module, name) for module in modules for name in module.__all__]
    classes = {v for v in values if inspect.isclass(v) and not issubclass(v, Exception)}
    assert {c.__name__ for c in classes} > RESULTS
    for cls in classes:
        parameters = inspect.signature(cls).parameters
        if cls.__name__ in RESULTS:
            assert not parameters, cls
            assert "__init__(self, /)" in pydoc.render_doc(cls, renderer=pydoc.plaintext)
        for name, parameter in parameters.items():
            assert not name.startswith("_"), cls
            assert "<factory>" not in str(parameter), cls


def test_help_has_the_error_of_an_unknown_name() -> None:
    for module in (prb, prb.decision, prb.plots):
        for value in (getattr(module, name) for name in module.__all__):
            if inspect.isfunction(value) and {"result", "var_names"} & {
                *inspect.signature(value).parameters
            }:
                raised = str(value.__doc__).partition("Raises\n")[2]
                assert "KeyError" in raised.partition("Examples\n")[0], value
