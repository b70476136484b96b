"""Specimens of two simulators with common inputs: labelled, refused, or reported."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr
from pymc.model.fgraph import clone_model

import prbayes as prb
from prbayes.model.simulator_with_data import unlabelled_specimens
from prbayes.model.specimen_likelihood import all_simulators

N = 25
RNG = np.random.default_rng(1)
X = RNG.normal(10, 2, N)
COLD, HOT = X**1.5 + RNG.normal(0, 0.5, N), 100 / X + RNG.normal(0, 0.2, N)
NAMES = [f"s{i}" for i in range(N)]
OTHERS = [f"t{i}" for i in range(N)]
BATCHES = pd.MultiIndex.from_tuples([("A", i) for i in range(N)], names=["batch", "number"])


def array(values: Any, names: Any = NAMES) -> xr.DataArray:
    return xr.DataArray(values, coords={"specimen": names}, dims="specimen")


def series(values: Any, index: Any = NAMES) -> pd.Series:
    return pd.Series(values, index=index)


def two(cold: Any, hot: Any, *, of: Any = (None, None), coords: Any = None, **given: Any) -> Any:
    """Return a model of two tests with labels ``of`` both, given as specimens=."""
    metric = given.pop("metric", None)
    metrics = [prb.LogLikelihood(error=e) if metric is None else metric for e in (0.5, 0.2)]
    with pm.Model(coords=coords) as model:
        x = pm.Normal.dist(pm.Normal("mu", 9, 3), pm.HalfNormal("s", 3))
        for name, f, y, own, labels in (
            ("cold", lambda x: x**1.5, cold, metrics[0], of[0]),
            ("hot", lambda x: 100 / x, hot, metrics[1], of[1]),
        ):
            prb.Simulator(name, f, x, observed=y, metric=own, specimens=labels, **given)
    return model


SAME: dict[str, Callable[[], Any]] = {
    "coordinate": lambda: two(array(COLD), array(HOT)),
    "index": lambda: two(series(COLD), series(HOT)),
    "table": lambda: two(pd.DataFrame({"c": COLD}, NAMES), pd.DataFrame({"h": HOT}, NAMES)),
    "dims": lambda: two(COLD, HOT, coords={"specimen": NAMES}, dims="specimen"),
    "another order": lambda: two(series(COLD), series(HOT)[::-1]),
    "some in common": lambda: two(series(COLD), series(HOT, [*OTHERS[1:], "s3"])),
    "levels": lambda: two(series(COLD, BATCHES), series(HOT, BATCHES)),
    "specimens= in one": lambda: two(COLD, series(HOT), of=(NAMES, None)),
    "specimens= in the other": lambda: two(array(COLD), HOT, of=(None, NAMES)),
    "numbers": lambda: two(series(COLD, np.arange(N) + 7), array(HOT, np.arange(N) + 7)),
    "metric": lambda: two(array(COLD), array(HOT), metric=prb.AreaMetric()),
}


@pytest.mark.parametrize("kind", SAME)
def test_the_same_labels_outside_of_specimens_are_refused(kind: str) -> None:
    with pytest.raises(ValueError, match=r"hot: observed: got the specimen '.*which cold has too"):
        SAME[kind]()


def test_dims_of_data_are_labels() -> None:
    with pm.Model(coords={"specimen": NAMES}):
        x = pm.Normal.dist(pm.Normal("mu", 9, 3), pm.HalfNormal("s", 3))
        data = [pm.Data(f"y{k}", y, dims="specimen") for k, y in enumerate((COLD, HOT))]
        prb.Simulator("cold", lambda x: x**1.5, x, observed=data[0])
        with pytest.raises(ValueError, match="which cold has too"):
            prb.Simulator("hot", lambda x: 100 / x, x, observed=data[1])


def findings(model: pm.Model) -> list[str]:
    return [finding.text for finding in unlabelled_specimens(all_simulators(model))]


def test_the_remedy_counts_specimens_once() -> None:
    labels = [str(label) for label in series(COLD).index]
    model = two(series(COLD), series(HOT), of=(labels, labels))
    optimum = prb.minimize(model, starts=0, progressbar=False)
    assert optimum.stderr["mu"] == pytest.approx(X.std() / 5, rel=0.03)
    assert not optimum.findings


@pytest.mark.parametrize(
    "make",
    [
        lambda: two(COLD, HOT),
        lambda: two(COLD, HOT, coords={"specimen": range(N)}, dims="specimen"),
        lambda: two(series(COLD), HOT),
        lambda: two(COLD, HOT, metric=prb.AreaMetric()),
    ],
    ids=["arrays", "numbered", "one", "metric"],
)
def test_equal_numbers_without_labels_are_reported(
    make: Any, caplog: pytest.LogCaptureFixture
) -> None:
    model = make()
    (record,) = [r for r in caplog.records if getattr(r, "code", "") == "unlabelled-specimens"]
    assert "they count as 50 specimens" in record.message
    (text,) = findings(model)
    assert text.startswith("cold and hot: got 25 specimens of the same inputs in each")


@pytest.mark.long
def test_results_report_equal_numbers_without_labels() -> None:
    model = two(COLD, HOT)
    optimum = prb.minimize(model, starts=0, progressbar=False)
    posterior = prb.sample(100, model=model, optimum=optimum, progressbar=False)
    for result in (optimum, prb.diagnose(posterior, model=model)):
        assert "unlabelled-specimens" in {finding.code for finding in result.findings}


@pytest.mark.parametrize(
    "make",
    [
        lambda: two(series(COLD), series(HOT, OTHERS)),
        lambda: two(COLD, HOT, of=(NAMES, OTHERS)),
        lambda: two(COLD, HOT[1:]),
    ],
    ids=["index", "specimens=", "numbers"],
)
def test_other_specimens_are_not_reported(make: Any) -> None:
    model = make()
    assert not findings(model)
    assert not findings(clone_model(model))


def test_a_label_twice_in_one_index_is_reported() -> None:
    (text,) = findings(two(series(COLD, ["s0", *NAMES[:-1]]), series(HOT, OTHERS)))
    assert text.startswith("cold: got the label 's0' 2 times in the index of observed")
    table = pd.concat([series(COLD[:10], range(10)), series(COLD[10:], range(15))])
    assert not findings(two(table, series(HOT, OTHERS)))


def test_specimens_of_other_inputs_may_have_the_same_labels() -> None:
    with pm.Model() as model:
        for name in ("a", "b"):
            x = pm.Normal.dist(pm.Normal(f"mu_{name}", 9, 3), 2.0)
            prb.Simulator(name, lambda x: x**1.5, x, observed=series(COLD))
    assert not findings(model)


def test_names_of_groups_in_an_index_are_no_labels() -> None:
    groups = np.repeat(["A", "B"], [10, 15])
    with pm.Model(coords={"batch": ["A", "B"]}) as model:
        mu = pm.Normal("mu", 9, 3, dims="batch")
        x = pm.Normal.dist(mu[prb.response.group("batch")], pm.HalfNormal("s", 3))
        index = pd.Index(groups, name="batch")
        prb.Simulator("cold", lambda x: x**1.5, x, observed=series(COLD, index))
        coordinate = {"batch": ("specimen", groups)}
        hot = xr.DataArray(HOT, coordinate, "specimen")
        prb.Simulator("hot", lambda x: 100 / x, x, observed=hot)
    (text,) = findings(model)
    assert text.startswith("cold and hot: got 25 specimens")
    with pm.Model(coords={"batch": ["A", "B"]}):
        mu = pm.Normal("mu", 9, 3, dims="batch")
        x = pm.Normal.dist(mu[prb.response.group("batch")], pm.HalfNormal("s", 3))
        index = pd.MultiIndex.from_arrays([groups, NAMES], names=["batch", "specimen"])
        prb.Simulator("cold", lambda x: x**1.5, x, observed=series(COLD, index))
        with pytest.raises(ValueError, match="got the specimen 's0', which cold has too"):
            prb.Simulator("hot", lambda x: 100 / x, x, observed=series(HOT, index))
