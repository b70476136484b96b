"""Names of elements, by one rule in both directions; labels of metrics."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import prbayes as prb
from prbayes.model.elements import element_name, split_elements, variable_of
from prbayes.plots._labels import metric_label, named


@pytest.mark.parametrize(("index", "expected"), [((), "mu"), ((1,), "mu[1]"), ((0, 2), "mu[0,2]")])
def test_an_element_has_the_name_of_its_variable_and_its_index(
    index: tuple[int, ...], expected: str
) -> None:
    assert element_name("mu", index) == expected
    assert variable_of(expected) == "mu"


def test_elements_take_the_label_of_their_variable() -> None:
    labels = {"mu": "mean", "mu[1]": "second mean"}
    found = [named(name, labels) for name in ("mu[0]", "mu[1]", "nu", "nu[0]", "mu")]
    assert found == ["mean[0]", "second mean", "nu", "nu[0]", "mean"]
    assert named("mu[0]", None) == "mu[0]"


def test_values_are_split_along_all_axes_but_the_first() -> None:
    cov = np.arange(12.0).reshape(3, 2, 2)
    found = split_elements({"mu": np.arange(3.0), "cov": cov})
    assert list(found) == ["mu", "cov[0,0]", "cov[0,1]", "cov[1,0]", "cov[1,1]"]
    np.testing.assert_array_equal(found["cov[0,1]"], cov[:, 0, 1])


PICTURES = ("responses", "population", "posterior", "optimizer", "landscape", "comparison")


@pytest.mark.parametrize("picture", PICTURES)
def test_a_label_of_nothing_is_refused(
    picture: str, pictures: dict[str, Callable[..., Any]]
) -> None:
    with pytest.raises(KeyError, match=r"labels: got 'crak', which is no name of what is shown"):
        pictures[picture](labels={"crak": "crack length (mm)"})


def test_one_mapping_serves_all_pictures_of_a_model(
    pictures: dict[str, Callable[..., Any]],
) -> None:
    labels = {"mu": "mean", "y": "response", "x": "input"}
    for picture in PICTURES:
        pictures[picture](labels=labels)
    with pytest.raises(KeyError, match="'nu'"):
        pictures["responses"](labels=labels | {"nu": "typing error"})


def test_metrics_of_several_outputs_are_called_by_that_of_one() -> None:
    area = prb.AreaMetric()
    assert metric_label(repr(area)) == "area metric"
    assert metric_label(repr(prb.Joint(area))) == "joint area metric"
    other = prb.MarginalCorrelation(prb.KullbackLeibler())
    assert (
        metric_label(repr(other)) == "Kullback-Leibler divergence of marginals, with correlations"
    )
    assert metric_label("Mine(Other(3))") == "Mine"
