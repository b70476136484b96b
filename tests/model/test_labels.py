"""Values as labelled datasets."""

import numpy as np
import pymc as pm

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.labels import labelled, observed_dataset, versions


def evaluator() -> Evaluator:
    with pm.Model(coords={"layer": ["top", "bottom"], "specimen": [7, 8, 9]}) as model:
        mu = pm.Normal("mu", 0, 1, dims="layer")
        prb.Simulator(
            "y",
            np.positive,
            pm.Normal.dist(mu[0], 1.0),
            metric=prb.AreaMetric(),
            observed=[0.0, 1.0, 2.0],
            dims="specimen",
            propagation=prb.Reweighted(64),
        )
    return Evaluator(model)


def test_dimensions_and_coordinates_are_the_models() -> None:
    data = labelled(evaluator(), {"mu": np.zeros((4, 2)), "free": np.ones((4, 3))}, {"draw": 4})
    assert data["mu"].dims == ("draw", "layer")
    assert data["free"].dims == ("draw", "free_dim_0")
    assert list(data["layer"].values) == ["top", "bottom"]
    assert list(data["draw"].values) == [0, 1, 2, 3]


def test_observed_values_are_labelled() -> None:
    data = observed_dataset(evaluator())
    assert data["y"].dims == ("specimen",)
    assert float(data["y"].sel(specimen=9)) == 2.0


def test_versions_are_those_of_this_installation() -> None:
    assert versions()["prbayes_version"] == prb.__version__
    assert versions()["numpy_version"] == np.__version__
