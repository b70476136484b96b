"""What is asked of an optimum before it is used."""

from types import SimpleNamespace
from typing import Any

import pytest

from prbayes.estimate.optimum import plain, require_refits, require_sampling


@pytest.mark.parametrize("kind", ["at_edge", "at_jump"])
def test_where_nothing_is_known_an_optimum_is_refused(kind: str) -> None:
    optimum: Any = SimpleNamespace(**({"at_edge": (), "at_jump": ()} | {kind: ("sigma",)}))
    with pytest.raises(ValueError, match=r"bootstrap: got an optimum around .*sigma.*adjust=False"):
        require_sampling(optimum, "bootstrap")


def test_something_else_than_an_optimum_is_refused() -> None:
    with pytest.raises(TypeError, match=r"JointNull: got dict, expected an Optimum"):
        require_refits({}, "JointNull", "")


def test_one_number_is_a_float() -> None:
    assert type(plain(1)) is float
    assert plain([1, 2]).shape == (2,)
