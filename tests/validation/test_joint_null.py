"""The area test on the calibration's own specimens."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb

Posterior = Callable[..., Any]
EXACT = prb.validation.ExactModel()


def same(x: Any) -> Any:
    return x


def double(x: Any) -> Any:
    return 2 * x


DATA = np.random.default_rng(20).normal(10, 1, 20)


@cache
def calibrated(labelled: bool = False) -> tuple[prb.Optimum, Any]:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3))
        prb.Simulator(
            "y", same, x, metric=prb.AreaMetric(), observed=DATA, propagation=prb.Reweighted(512),
            specimens=np.arange(20) if labelled else None,
        )  # fmt: skip
    return prb.minimize(model), x


@pytest.mark.long
def test_own_data_take_the_joint_null() -> None:
    optimum, x = calibrated()
    predicted = prb.predict(optimum, same, x, random_seed=1)
    with pytest.raises(ValueError, match="the very data of the calibration"):
        prb.area_test(DATA[::-1], predicted)
    test = prb.area_test(
        DATA[::-1], predicted, null=prb.validation.JointNull(optimum, replicates=999)
    )
    # A fitted normal distribution follows its own data. 1500 normal samples of 20, fitted by
    # Nelder-Mead to the smallest area and tested by formulas of their own, have the 95% point
    # .0571; standard error of both .001.
    assert test.critical_value == pytest.approx(0.0571, abs=0.004)
    assert not test.rejected
    assert test.p_value > 0.05


@pytest.mark.long
def test_own_specimens_under_another_condition_are_as_close_as_under_their_own() -> None:
    optimum, x = calibrated(labelled=True)
    null = prb.validation.JointNull(optimum, responses=(double, x), replicates=199)
    own = prb.area_test(
        DATA, prb.predict(optimum, same, x), null=prb.validation.JointNull(optimum, replicates=199)
    )
    predicted = prb.predict(optimum, double, x)
    later = prb.area_test(2 * DATA, predicted, null=null, specimens=np.arange(20))
    # 2 y tells the same as y; refits and replicates are the same.
    assert later.critical_value == pytest.approx(own.critical_value, rel=1e-6)
    fresh = prb.area_test(2 * DATA, predicted, null=null, specimens=np.arange(100, 120))
    assert fresh.critical_value > 1.15 * EXACT.critical_value(20)
    with pytest.raises(ValueError, match="specimens of the calibration"):
        prb.area_test(2 * DATA, predicted, specimens=np.arange(20))


def test_the_joint_null_rejects_what_the_family_cannot_follow() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 3), pm.HalfNormal("sigma", 3))
        data = np.concatenate([np.full(15, -1.0), np.full(15, 1.0)]) + np.random.default_rng(
            2
        ).normal(0, 0.05, 30)
        prb.Simulator(
            "y", same, x, metric=prb.AreaMetric(), observed=data, propagation=prb.Reweighted(512)
        )
    optimum = prb.minimize(model)
    test = prb.area_test(
        data,
        prb.predict(optimum, same, x, random_seed=1),
        null=prb.validation.JointNull(optimum, replicates=199),
    )
    assert test.rejected


def test_a_resimulated_model_has_a_joint_null_too() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3))
        prb.Simulator(
            "y", same, x, metric=prb.AreaMetric(), observed=DATA, propagation=prb.Resimulated(256)
        )
    optimum = prb.minimize(model)
    predicted = prb.predict(optimum, same, x, random_seed=1)
    test = prb.area_test(DATA, predicted, null=prb.validation.JointNull(optimum, replicates=199))
    assert test.critical_value == pytest.approx(0.0571, abs=0.012)  # to first order
    with pytest.raises(ValueError, match=r"no simulator with prb\.Reweighted has"):
        prb.area_test(
            2 * DATA,
            2 * predicted,
            null=prb.validation.JointNull(optimum, responses=(double, x), replicates=19),
            alpha=0.1,
        )


def test_refusals_of_the_joint_null(posterior: Posterior) -> None:
    optimum, x = calibrated()
    null = prb.validation.JointNull(optimum, replicates=19)
    with pytest.raises(ValueError, match="got 400 draws, expected the one population"):
        prb.area_test(DATA, posterior(), null=null, alpha=0.1)
    with pytest.raises(ValueError, match="distribution function differs by"):
        prb.area_test(DATA, prb.predict(optimum, double, x), null=null, alpha=0.1)
    two = prb.predict(optimum, same, x, random_seed=1)
    with pytest.raises(
        ValueError, match=r"condition 'late', expected the name of a simulator, \['y'\]"
    ):
        prb.area_test({"late": DATA, "y": DATA}, {"late": two, "y": two}, null=null, alpha=0.1)
    with pytest.raises(TypeError, match="got str, expected an Optimum"):
        prb.validation.JointNull("optimum")  # type: ignore[arg-type]
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 10, 3), 1.0)
        metric = prb.FunctionMetric(lambda s, o: np.abs(s.mean(-1) - o.mean()))
        prb.Simulator("y", same, x, metric=metric, observed=DATA, propagation=prb.Resimulated(64))
    with pytest.raises(
        ValueError, match=r"a FunctionMetric, .*the model cannot be calibrated anew"
    ):
        prb.validation.JointNull(prb.minimize(model, method="Nelder-Mead"))


def test_own_data_are_known_in_any_order_as_their_specimens() -> None:
    optimum, x = calibrated()
    null = prb.validation.JointNull(optimum, replicates=99)
    predicted = prb.predict(optimum, same, x, random_seed=1)
    tests = [
        prb.area_test(data, predicted, null=null) for data in (DATA, DATA[::-1], np.sort(DATA))
    ]
    assert len({(t.p_value, t.critical_value) for t in tests}) == 1


def test_fewer_of_the_own_specimens_are_followed_less_closely() -> None:
    optimum, x = calibrated(labelled=True)
    null = prb.validation.JointNull(optimum, replicates=199)
    predicted = prb.predict(optimum, same, x, random_seed=1)
    some = prb.area_test(DATA[:8], predicted, null=null, specimens=np.arange(8))
    fresh = prb.area_test(DATA[:8] + 0.01, predicted, null=null, specimens=np.arange(50, 58))
    assert some.critical_value < fresh.critical_value
