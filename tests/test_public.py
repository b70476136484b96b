"""The package loads a public name when it is used, and type checkers know all of them."""

import ast
import subprocess
import sys
from pathlib import Path

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


def test_type_checkers_see_the_names_of_the_table() -> None:
    tree = ast.parse(Path(str(prb.__file__)).read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    imports = {
        alias.name: str(node.module)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert set(imports) == set(prb.__all__)
    for name, module in imports.items():
        if module != "prbayes":
            assert getattr(prb, name).__module__ == module
