"""Labels of elements and metrics, and refusals of labels for unknown names."""

from collections.abc import Callable
from typing import Any

import pytest

import prbayes as prb
from prbayes.plots._labels import metric_label, named


def test_elements_take_the_label_of_their_variable() -> None:
    labels = {"mu": "mean", "mu[1]": "second mean"}
    found = [named(name, labels) for name in ("mu[0]", "mu[1]", "nu", "nu[0]", "mu")]
    assert found == ["mean[0]", "second mean", "nu", "nu[0]", "mean"]
    assert named("mu[0]", None) == "mu[0]"


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
