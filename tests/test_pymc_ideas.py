"""Ideas of PyMC's own tests of `pymc.Simulator` and of SMC, carried over."""

from __future__ import annotations

import random
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from pytensor.tensor.random.type import RandomType

import prbayes as prb
from prbayes.response.compile import PLAIN

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 40)
CALLS: list[int] = []


def response(x: Any) -> Any:
    CALLS.append(np.size(x))
    return np.positive(x)


def build(propagation: Any = None, name: str = "", epsilon: float = 0.05) -> pm.Model:
    """Return the model of a normal population, with starting values of its own."""
    with pm.Model(name=name) as model:
        a = pm.Normal("a", 0, 1, initval=0.75)
        b = pm.HalfNormal("b", 1, initval=0.5)
        prb.Simulator(
            "s",
            response,
            pm.Normal.dist(a, b),
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            epsilon=epsilon,
            propagation=prb.Reweighted(64) if propagation is None else propagation,
        )
    return model


@cache
def named() -> pm.Model:
    return build(name="outer")


def draws(model: pm.Model) -> Any:
    found = prb.sample_smc(
        20, chains=2, model=model, epsilon=0.05, adjustment=None, random_seed=1, progressbar=False
    )
    return found.posterior


@pytest.mark.parametrize("propagation", [prb.Reweighted(64), prb.Resimulated(64), prb.Fresh(64)])
def test_a_log_density_has_no_randomness_of_its_own(propagation: Any) -> None:
    """Unlike that of PyMC's simulator and of fresh responses, which is another one at each call."""
    model = build(propagation)
    density = model.compile_logp(mode=PLAIN)
    point = model.initial_point()
    is_same = density(point) == density(point)
    assert is_same == (not isinstance(propagation, prb.Fresh))
    assert not [v for v in density.f.get_shared() if isinstance(v.type, RandomType)]


def test_a_named_model_has_named_results() -> None:
    names = {"outer::a", "outer::b"}
    assert set(draws(named()).data_vars) == names
    assert set(prb.minimize(named(), starts=0, progressbar=False).point) == names


def test_global_random_states_are_left_alone() -> None:
    before = np.random.get_state()[1].tolist(), random.getstate()  # noqa: NPY002
    draws(build())
    after = np.random.get_state()[1].tolist(), random.getstate()  # noqa: NPY002
    assert before == after


def test_starting_values_are_the_users_and_cost_no_response() -> None:
    model = build()
    before = len(CALLS)
    point = model.initial_point()
    assert len(CALLS) == before
    assert point["a"] == 0.75
    assert np.exp(point["b_log__"]) == pytest.approx(0.5)


def test_a_simulator_above_another_is_refused_before_its_response_is_computed() -> None:
    with build() as model:
        before = len(CALLS)
        for above in (model["s"], model["s"].mean()):
            x = pm.Normal.dist(above, 1.0)
            with pytest.raises(TypeError, match=r"t: got inputs that depend on the simulator s"):
                prb.Simulator("t", response, x, metric=prb.AreaMetric(), observed=OBSERVED)
    assert len(CALLS) == before
