"""Held-out discrepancies: against calibrations on the subsets themselves."""

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb

DATA = np.exp(np.random.default_rng(0).normal(0.0, 0.7, 60))
METRIC = prb.AreaMetric()


def build(data: Any = DATA, family: Any = pm.LogNormal, **keywords: Any) -> pm.Model:
    with pm.Model() as model:
        x = family.dist(pm.Normal("mu", 0.5, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", np.positive, x, metric=METRIC, observed=data, **keywords)
    return model


@cache
def optimum(family: Any = pm.LogNormal) -> prb.Optimum:
    return prb.minimize(build(family=family))


@pytest.mark.long
def test_each_fold_is_a_calibration_on_the_other_specimens() -> None:
    before = optimum().evaluator.n_responses
    found = prb.cross_validate(optimum(), folds=4, random_seed=3)
    assert optimum().evaluator.n_responses == before
    assert found.sizes == {"fold": 4, "simulator": 1, "specimen": 60}
    assert found.n_held_out.values.ravel().tolist() == [15] * 4
    assert found.converged.all()
    fold = np.random.default_rng([3, 3]).permutation(np.arange(60) % 4)
    for i in (0, 3):
        other = prb.minimize(build(DATA[fold != i]))
        assert float(found.calibrated[i, 0]) == pytest.approx(other.discrepancy, rel=0.01)
        z = np.random.default_rng(1).normal(size=400_000)
        population = np.exp(other.point["mu"] + other.point["sigma"] * z)
        assert float(found.discrepancy[i, 0]) == pytest.approx(
            METRIC(population, DATA[fold == i]), rel=0.03
        )


@pytest.mark.long
def test_the_wrong_family_predicts_worse() -> None:
    right, wrong = (prb.cross_validate(optimum(f)) for f in (pm.LogNormal, pm.Normal))
    assert float(wrong.discrepancy.mean()) > 1.1 * float(right.discrepancy.mean())
    assert float(right.discrepancy.mean()) > float(right.calibrated.mean())


@pytest.mark.long
def test_specimens_are_dealt_out_whole() -> None:
    with pm.Model() as model:
        x = pm.LogNormal.dist(pm.Normal("mu", 0.5, 1), pm.HalfNormal("sigma", 1))
        for name, f, size in (("first", np.positive, 60), ("second", np.sqrt, 50)):
            prb.Simulator(
                name, f, x, metric=METRIC, observed=f(DATA[:size]), specimens=np.arange(size)
            )
    found = prb.cross_validate(prb.minimize(model), folds=5)
    assert found.n_held_out.sum("fold").values.tolist() == [60, 50]
    fold = np.random.default_rng([0, 3]).permutation(np.arange(60) % 5)
    np.testing.assert_array_equal(
        found.n_held_out.sel(simulator="second"), np.bincount(fold[:50], minlength=5)
    )


def test_few_specimens_have_fewer_folds() -> None:
    with pm.Model() as model:
        x = pm.LogNormal.dist(pm.Normal("mu", 0.5, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", np.positive, x, metric=METRIC, observed=DATA[:9])
    few = prb.minimize(model)
    assert prb.cross_validate(few).sizes["fold"] == 4
    assert prb.cross_validate(optimum()).sizes["fold"] == 5
    table = prb.rank({"one": few, "other": few})
    assert table.attrs["folds"] == 4
    # Those that are there already say how many.
    three = prb.cross_validate(few, folds=3)
    table = prb.rank({"one": three, "other": few})
    assert table.attrs["folds"] == 3


def test_refusals() -> None:
    with pytest.raises(TypeError, match="got dict, expected an Optimum"):
        prb.cross_validate({})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="folds: got 1"):
        prb.cross_validate(optimum(), folds=1)
    with pytest.raises(ValueError, match="folds: got 40 for 60 specimens, expected at most 30"):
        prb.cross_validate(optimum(), folds=40)
    few = {"method": "Nelder-Mead", "starts": 0, "max_evaluations": 50}
    fresh = prb.minimize(build(propagation=prb.Fresh(60)), **few)
    with pytest.raises(ValueError, match="cannot be calibrated anew"):
        prb.cross_validate(fresh)
