"""A coarse response beside the expensive one: called where it is needed, refused before any run."""

from __future__ import annotations

import logging
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cloudpickle
import numpy as np
import pymc as pm
import pytest
from first_use import first_use

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import SimulatorIdentity, identity_of
from prbayes.propagation.importance import SIZES
from prbayes.propagation.reweighted import ReweightedBound, designs_restored
from prbayes.response.budget import limited
from prbayes.response.failures import ResponseError


def fine(a: Any, b: Any, scale: Any = 1.0) -> Any:
    return scale * (a * np.exp(0.3 * b) + 0.5 * np.sin(5 * a) * np.cos(4 * b))


def coarse(a: Any, b: Any, scale: Any = 1.0) -> Any:
    return 2 * fine(a, b, scale) - 0.3 * b**2


def unrelated(a: Any, b: Any, scale: Any = 1.0) -> Any:
    return np.sin(90 * a + 70 * b)


OBSERVED = fine(
    *(np.array([[1.2], [1.0]]) + [[0.8], [0.6]] * np.random.default_rng(1).normal(size=(2, 40)))
)


def build(beside: Any = coarse, response: Any = fine, n: int = 64, **keywords: Any) -> pm.Model:
    """Return a model of a response with a constant among its arguments, and a coarse one."""
    observed = keywords.pop("observed", OBSERVED)
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("ma", 1, 0.5), pm.LogNormal("sa", 0, 0.5))
        b = pm.Normal.dist(1.0, 0.6)
        stored = prb.Reweighted(n, emulator="auto", coarse=beside, **keywords)
        metric = prb.KullbackLeibler() if np.ndim(observed) == 1 else prb.Joint(prb.AreaMetric())
        prb.Simulator(
            "y", response, a, b, 1.0, metric=metric, observed=observed, propagation=stored
        )
    return model


def design_of(model: pm.Model) -> ReweightedBound:
    return Evaluator.of(model).reweighted["y"]


def off(bound: ReweightedBound) -> float:
    """Return by how much the cloud's responses are off, in spreads of the response."""
    cloud = bound.design.emulated
    assert cloud is not None
    truth = fine(*cloud.inputs)
    return float(np.std(bound.design.sample.values[: len(cloud)] - truth) / np.std(truth))


def test_a_cloud_follows_the_coarse_response_at_its_own_points() -> None:
    followed, without = design_of(build()), design_of(build(None))
    assert off(without) > 0.05
    assert off(followed) < 0.01
    assert "It follows the coarse response." in followed.design.summary("y")
    assert "coarse" not in without.design.summary("y")


def test_emulators_that_lack_runs_follow_it_too() -> None:
    bound = design_of(build())
    cloud = bound.design.emulated
    assert cloud is not None
    for said in bound.design.without_each_block():
        assert np.std(said[: len(cloud)] - fine(*cloud.inputs)) < 0.02 * OBSERVED.std()


def test_runs_that_are_added_have_a_coarse_response_as_well() -> None:
    evaluator = Evaluator.of(build())
    bound = evaluator.reweighted["y"]
    with designs_restored([bound]):
        bound.add(evaluator.roots(evaluator.hyperparameters.prior_thetas(32, 3), 0), 32)
        known = bound.design.coarse
        assert known is not None
        np.testing.assert_allclose(known[:, 0], coarse(*bound.design.runs.points))
        assert off(bound) < 0.01
    assert bound.design.coarse is not None
    assert len(bound.design.coarse) == bound.n_runs == 64


def test_runs_that_are_added_where_there_is_none_are_no_mistake() -> None:
    def partly(a: Any, b: Any, scale: Any) -> Any:
        return np.where(a > 4, np.nan, coarse(a, b))

    evaluator = Evaluator.of(build(partly))
    bound = evaluator.reweighted["y"]
    far = [
        np.full_like(root, 30.0 if i == 0 else 1.0)
        for i, root in enumerate(evaluator.roots(evaluator.hyperparameters.prior_thetas(32, 3), 0))
    ]
    bound.add(far, 16)
    assert bound.n_runs == 80
    assert np.isfinite(bound.design.sample.values).all()


def test_its_calls_are_neither_counted_nor_limited() -> None:
    calls: list[int] = []

    def called(a: Any, b: Any, scale: Any) -> Any:
        calls.append(np.size(a))
        return coarse(a, b, scale)

    with limited(None, max_runs=64):
        evaluator = Evaluator.of(build(called))
    assert evaluator.n_responses == 64
    assert sum(calls) == 64 + SIZES.first


def test_one_that_tells_nothing_is_not_called_between_the_runs() -> None:
    calls: list[int] = []

    def called(a: Any, b: Any, scale: Any) -> Any:
        calls.append(np.size(a))
        return unrelated(a, b)

    def smooth(a: Any, b: Any, scale: Any) -> Any:
        return a * np.exp(0.3 * b)

    bound, without = design_of(build(called, smooth)), design_of(build(None, smooth))
    np.testing.assert_array_equal(bound.design.sample.values, without.design.sample.values)
    assert sum(calls) == 64
    assert "It does not follow the coarse response" in bound.design.summary("y")


def test_where_it_raises_the_emulator_goes_on_without_it(caplog: pytest.LogCaptureFixture) -> None:
    def partly(a: float, b: float, scale: float) -> float:
        if a > 2.5:
            raise ArithmeticError("no equilibrium")
        return float(coarse(a, b, scale))

    with caplog.at_level(logging.WARNING, "prbayes"):
        bound = design_of(build(prb.scalar(partly)))
    assert "y: coarse: " in caplog.text
    assert "no equilibrium" in caplog.text
    assert np.isfinite(bound.design.sample.values).all()
    assert off(bound) < 0.7 * off(design_of(build(None)))


def test_threads_compute_it_where_they_compute_the_response() -> None:
    seen: set[str] = set()

    def told(a: Any, b: Any, scale: Any) -> Any:
        seen.add(threading.current_thread().name)
        return coarse(a, b, scale)

    with ThreadPoolExecutor(2, "worker") as threads:
        there = design_of(build(told, executor=threads))
    assert all(name.startswith("worker") for name in seen)
    np.testing.assert_array_equal(
        there.design.sample.values, design_of(build()).design.sample.values
    )


RUNS: list[int] = []


def counted(a: Any, b: Any, scale: Any) -> Any:
    RUNS.append(np.size(a))
    return fine(a, b)


@pytest.mark.parametrize(
    ("beside", "told"),
    [
        (lambda a, b, s: np.stack([a, b], -1), r"y: coarse: the response returned shape .*, 2\)"),
        (lambda a, b, s: int("a"), r"y: coarse: got no number at any of 64 runs \(it raised Val"),
        (lambda a, b: a, r"y: coarse: response: got inputs of \[1, 1, 1\] numbers for a function"),
        (lambda a, b, s: np.nan * a, r"y: coarse: got no number at any of 64 runs"),
        (lambda a, b, s: np.inf * (1 + a**2), r"no number at any of 64 runs \(it is infinite\)"),
    ],
)
def test_what_is_no_coarse_response_is_refused_before_any_run(beside: Any, told: str) -> None:
    RUNS.clear()
    with pytest.raises((ResponseError, TypeError), match=told):
        first_use(build(beside, counted))
    assert sum(RUNS) == 0


def test_several_outputs_are_followed_one_by_one() -> None:
    def both(a: Any, b: Any, scale: Any) -> Any:
        return np.stack([fine(a, b), a * b], axis=-1)

    def coarse_both(a: Any, b: Any, scale: Any) -> Any:
        return np.stack([coarse(a, b), unrelated(a, b)], axis=-1)

    observed = np.stack([OBSERVED, OBSERVED**2], axis=1)
    bound = design_of(build(coarse_both, both, observed=observed))
    assert "It follows the coarse response in 1 of 2 outputs." in bound.design.summary("y")
    with pytest.raises(ResponseError, match=r"y: coarse: .* expected \(\d+, 2\): 2 outputs"):
        first_use(build(coarse, both, observed=observed))


def test_what_cannot_follow_is_refused() -> None:
    with pytest.raises(ValueError, match="coarse: got a coarse response and no emulator"):
        prb.Reweighted(64, emulator=None, coarse=coarse)
    with pytest.raises(TypeError, match="Reweighted: coarse: got int 3, expected a function"):
        prb.Reweighted(64, emulator="auto", coarse=3)  # type: ignore[arg-type]
    RUNS.clear()
    with pytest.raises(TypeError, match=r"y: coarse: got a coarse response for 2 .* n = 4096"):
        build(n=4096, response=counted)
    assert sum(RUNS) == 0


def test_another_coarse_response_is_another_problem() -> None:
    def biased(by: float) -> Any:
        return lambda a, b, scale: coarse(a, b) + by * np.sin(9 * a)

    def simulator(beside: Any) -> SimulatorIdentity:
        return identity_of(Evaluator.of(build(beside))).simulators[0]

    one, again, other = map(simulator, (biased(0.1), biased(0.1), biased(1.0)))
    assert one == again
    # The representation has no addresses, and no variables of closures: numbers tell these.
    assert "coarse=test_another_coarse_response" in one.propagation
    assert one.propagation == other.propagation
    assert one.discrepancies != other.discrepancies


def test_a_model_with_one_travels() -> None:
    model = build()
    there = cloudpickle.loads(cloudpickle.dumps(model))
    np.testing.assert_array_equal(
        design_of(there).design.sample.values, design_of(model).design.sample.values
    )


@pytest.mark.long
def test_an_optimum_is_that_of_many_runs() -> None:
    few = prb.minimize(build(), starts=0, progressbar=False)
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("ma", 1, 0.5), pm.LogNormal("sa", 0, 0.5))
        b = pm.Normal.dist(1.0, 0.6)
        prb.Simulator(
            "y", fine, a, b, metric=prb.KullbackLeibler(), observed=OBSERVED,
            propagation=prb.Resimulated(2**14),
        )  # fmt: skip
    many = prb.minimize(model, start=few.point, starts=0, progressbar=False)
    assert few.n_responses == 64
    away = (few.theta - many.theta) / np.sqrt(np.diag(many.covariance))
    assert np.abs(away).max() < 0.1
