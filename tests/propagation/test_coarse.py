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
from prbayes._validate import Floats
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


Z = np.random.default_rng(1).normal(size=(2, 40))
OBSERVED = fine(1.2 + 0.8 * Z[0], 1.0 + 0.6 * Z[1])


class Counted:
    """A response that counts the points at which it is called."""

    def __init__(self, function: Any) -> None:
        self.function, self.count = function, 0

    def __call__(self, a: Any, b: Any, scale: Any) -> Any:
        self.count += np.size(a)
        return self.function(a, b)


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


def off(bound: ReweightedBound, values: Floats | None = None) -> float:
    """Return the error of emulated responses, in spreads of the response."""
    points = bound.design.emulated
    assert points is not None
    truth = fine(*points.inputs)
    values = bound.design.sample.values if values is None else values
    return float(np.std(values[: len(points)] - truth) / np.std(truth))


def test_an_emulated_sample_follows_the_coarse_response_at_its_points() -> None:
    without = design_of(build(None))
    assert off(without) > 0.05
    assert "coarse" not in without.design.summary("y")
    evaluator = Evaluator.of(build())
    bound = evaluator.reweighted["y"]
    assert off(bound) < 0.01
    assert "It follows the coarse response." in bound.design.summary("y")
    # So do emulators without a block of the runs, and runs that are added.
    for values in bound.design.without_each_block():
        assert off(bound, values) < 0.02
    with designs_restored([bound]):
        bound.add(evaluator.parents(evaluator.hyperparameters.prior_thetas(32, 3), 0), 32)
        assert bound.design.coarse is not None
        np.testing.assert_allclose(bound.design.coarse[:, 0], coarse(*bound.design.runs.points))
        assert off(bound) < 0.01
    assert len(bound.design.coarse) == bound.n_runs == 64


def test_runs_may_be_added_where_the_coarse_response_has_no_value() -> None:
    evaluator = Evaluator.of(build(lambda a, b, _: np.where(a > 4, np.nan, coarse(a, b))))
    bound = evaluator.reweighted["y"]
    roots = evaluator.parents(evaluator.hyperparameters.prior_thetas(32, 3), 0)
    bound.add([np.full_like(roots[0], 30.0), *map(np.ones_like, roots[1:])], 16)
    assert bound.n_runs == 80
    assert np.isfinite(bound.design.sample.values).all()


def test_its_calls_are_neither_counted_nor_limited() -> None:
    called = Counted(coarse)
    with limited(None, max_runs=64):
        evaluator = Evaluator.of(build(called))
    assert evaluator.n_responses == 64
    assert called.count == 64 + 3 + SIZES.first  # three by themselves


def test_an_unrelated_one_is_not_called_between_the_runs() -> None:
    called = Counted(unrelated)
    bound, without = design_of(build(called)), design_of(build(None))
    np.testing.assert_array_equal(bound.design.sample.values, without.design.sample.values)
    assert called.count == 64 + 3
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


def test_it_is_computed_on_the_executor_of_the_response_and_travels() -> None:
    names: set[str] = set()

    def response(a: Any, b: Any, scale: Any) -> Any:
        names.add(threading.current_thread().name)
        return coarse(a, b, scale)

    model = build()
    with ThreadPoolExecutor(2, "worker") as threads:
        designs = [design_of(build(response, executor=threads)), design_of(model)]
    assert all(name.startswith("worker") for name in names)
    designs.append(design_of(cloudpickle.loads(cloudpickle.dumps(model))))
    for bound in designs[1:]:
        np.testing.assert_array_equal(bound.design.sample.values, designs[0].design.sample.values)


@pytest.mark.parametrize(
    ("beside", "words"),
    [
        (lambda a, b, s: np.stack([a, b], -1), r"y: coarse: the response returned shape .*, 2\)"),
        (lambda a, b, s: int("a"), r"y: coarse: got no number at any of 64 runs \(it raised Val"),
        (lambda a, b: a, r"y: coarse: response: got inputs of \[1, 1, 1\] numbers for a function"),
        (lambda a, b, s: np.nan * a, r"y: coarse: got no number at any of 64 runs"),
        (lambda a, b, s: np.inf * (1 + a**2), r"no number at any of 64 runs \(it is infinite\)"),
    ],
)
def test_other_functions_are_refused_before_any_run(beside: Any, words: str) -> None:
    response = Counted(fine)
    with pytest.raises((ResponseError, TypeError), match=words):
        first_use(build(beside, response))
    assert response.count == 0


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


def test_designs_that_cannot_follow_are_refused() -> None:
    with pytest.raises(ValueError, match="coarse: got a coarse response and no emulator"):
        prb.Reweighted(64, emulator=None, coarse=coarse)
    with pytest.raises(TypeError, match="Reweighted: coarse: got int 3, expected a function"):
        prb.Reweighted(64, emulator="auto", coarse=3)  # type: ignore[arg-type]
    response = Counted(fine)
    with pytest.raises(TypeError, match=r"y: coarse: got a coarse response for 2 .* n = 4096"):
        build(n=4096, response=response)
    assert response.count == 0


def test_another_coarse_response_is_another_problem() -> None:
    def simulator(by: float) -> SimulatorIdentity:
        biased = lambda a, b, scale: coarse(a, b) + by * np.sin(9 * a)  # noqa: E731
        return identity_of(Evaluator.of(build(biased))).simulators[0]

    first, again, changed = map(simulator, (0.1, 0.1, 1.0))
    assert first == again
    # The representation has no addresses, and no variables of closures: numbers differ.
    assert "coarse=test_another_coarse_response" in first.propagation
    assert first.propagation == changed.propagation
    assert first.discrepancies != changed.discrepancies
