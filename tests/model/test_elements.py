"""Names of elements."""

import numpy as np

from prbayes.model.elements import element_name, element_names, split_elements


def test_names() -> None:
    assert element_name("mu", ()) == "mu"
    assert element_name("mu", (1,)) == "mu[1]"
    assert element_name("cov", (0, 1)) == "cov[0,1]"


def test_names_are_in_the_order_of_raveled_values() -> None:
    assert element_names("mu", ()) == ["mu"]
    assert element_names("c", (2, 2)) == ["c[0,0]", "c[0,1]", "c[1,0]", "c[1,1]"]
    assert element_names("none", (0,)) == []


def test_values_by_element() -> None:
    found = split_elements({"s": np.arange(3.0), "c": np.arange(12.0).reshape(3, 2, 2)})
    assert list(found) == ["s", "c[0,0]", "c[0,1]", "c[1,0]", "c[1,1]"]
    np.testing.assert_array_equal(found["s"], [0, 1, 2])
    np.testing.assert_array_equal(found["c[1,0]"], [2, 6, 10])
