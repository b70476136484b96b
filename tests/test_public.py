"""The package loads what users type when the first of it is asked for."""

import subprocess
import sys

import pytest

import prbayes as prb
from prbayes import _public


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


def test_all_names_that_are_loaded_are_public_and_no_others() -> None:
    loaded = {name for name in vars(_public) if not name.startswith("_")}
    assert loaded == set(prb.__all__)
