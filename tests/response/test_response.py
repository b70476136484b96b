"""The response: shapes of what goes in and comes out, counts, and what makes two the same."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
import pytest

import prbayes as prb
from prbayes.model.random_variable import nodes
from prbayes.response.call import scalar
from prbayes.response.failures import Abort, Replace, ResponseError
from prbayes.response.inputs import Inputs, read_inputs
from prbayes.response.outputs import read_observed
from prbayes.response.response import (
    Responses,
    deduplicated_responses,
)
from prbayes.response.store import StoreError

with pm.Model() as MODEL:
    MU = pm.Normal("mu")
    X = pm.Normal.dist(MU, 1.0)
    PAIR = pm.MvNormal.dist(pt.stack([MU, MU]), np.eye(2))


def inputs(*given: Any) -> Inputs:
    return read_inputs("y", given, MODEL)


def weighted(pair: Any, a: Any, x: Any, slope: Any) -> Any:
    return a * pair[..., 0] + 10 * pair[..., 1] + 100 * x + 1000 * slope


ALL = (PAIR, 2.0, X, MU)  # aleatory, constant, aleatory, epistemic
RNG = np.random.default_rng(1)
PAIRS, XS, SLOPES = RNG.normal(size=(4, 3, 2)), RNG.normal(size=(4, 3)), RNG.normal(size=(4, 1))
EXPECTED = weighted(PAIRS, 2.0, XS, SLOPES)


def by_rows(pair: Any, a: Any, x: Any, slope: Any) -> Any:
    assert np.ndim(x) == 1
    assert np.shape(pair) == (len(x), 2)
    return weighted(pair, a, x, slope)


@pytest.mark.exact
@pytest.mark.parametrize("way", ["plain", "scalar", "stored", "tolerant"])
def test_every_way_of_calling_gives_the_same_in_the_shape_of_the_batch(
    way: str, tmp_path: Path
) -> None:
    settings: dict[str, dict[str, Any]] = {
        "plain": {"function": weighted},
        "scalar": {"function": scalar(weighted)},
        "stored": {"function": by_rows, "store": tmp_path},
        "tolerant": {"function": by_rows, "on_failure": Replace()},
    }
    responses = Responses("y", inputs=inputs(*ALL), **settings[way])
    assert responses.is_batched == (way == "plain")
    np.testing.assert_array_equal(responses([PAIRS, XS], [SLOPES]), EXPECTED)
    assert (responses.count, responses.computed, responses.failures) == (12, 12, 0)
    np.testing.assert_array_equal(responses([PAIRS[:1], XS[0]], [SLOPES[0, 0]]), EXPECTED[:1])
    assert responses.count == 15
    assert responses.computed == (12 if way == "stored" else 15)
    assert responses([PAIRS[:0], XS[:0]], [SLOPES[:0]]).shape == (0, 3)


def test_a_point_of_a_store_is_all_that_goes_into_the_response(tmp_path: Path) -> None:
    def count(*given: Any) -> int:
        responses = Responses("y", by_rows, inputs(*given), store=tmp_path)
        responses([PAIRS, XS], [SLOPES])
        return responses.computed

    # Three again, to see that it is the same response
    assert [count(*ALL), count(*ALL)] == [12, 3]
    assert count(PAIR, 3.0, X, MU) == 12  # another constant is another input
    repeated = Responses("z", lambda a, b: a + 2 * b, inputs(X, X), store=tmp_path)
    np.testing.assert_array_equal(repeated([XS[0]], []), 3 * XS[0])


@pytest.mark.exact
def test_failures_are_counted(tmp_path: Path) -> None:
    def steep(x: Any) -> Any:
        return np.where(x > 0, np.nan, x)

    responses = Responses("y", steep, inputs(X), on_failure=Replace(-9.0))
    found = responses([np.array([1.0, -1.0, 2.0])], [])
    np.testing.assert_array_equal(found, [-9.0, -1.0, -9.0])
    assert responses.failures == 2
    plain = Responses("y", steep, inputs(X), on_failure=Abort())
    assert plain.is_batched
    np.testing.assert_array_equal(plain([np.array([1.0, -1.0])], []), [np.nan, -1.0])
    assert plain.failures == 0


def test_a_wrong_shape_is_no_failure_to_replace() -> None:
    responses = Responses("y", lambda x: x[:1], inputs(X), on_failure=Replace())
    with pytest.raises(
        ResponseError, match=r"y: .*returned shape \(1,\) .* \(2,\), expected \(2,\)"
    ):
        responses([np.zeros((2, 3))], [])


def test_two_responses_are_the_same_by_function_inputs_and_constants() -> None:
    with MODEL:
        other = pm.Normal.dist(MU, 1.0)

    def same(function: Any, *given: Any) -> bool:
        one = Responses("y", of_any, inputs(PAIR, 2.0, X))
        return one.same_as(Responses("z", function, inputs(*given)))

    assert same(of_any, PAIR, 2.0, X)
    assert not same(first_of_any, PAIR, 2.0, X)
    assert not same(of_any, PAIR, 3.0, X)
    assert not same(of_any, X, 2.0, PAIR)
    assert not same(of_any, PAIR, 2.0, other)
    assert not same(of_any, PAIR, X, X)
    assert not same(of_any, PAIR, 2.0)
    # A variable that is common to all specimens is the same input if it is the same variable.
    epistemic = Responses("y", of_any, inputs(X, MU))
    assert epistemic.same_as(Responses("y", of_any, inputs(X, MU)))
    assert not epistemic.same_as(Responses("y", of_any, inputs(X, 2.0)))


def of_any(*values: Any) -> Any:
    return values[0]


def first_of_any(*values: Any) -> Any:
    return values[0]


def test_a_function_of_other_arguments_is_refused_before_it_is_called() -> None:
    def wrapped(x: Any) -> Any:
        return of_any(x)

    Responses("y", wrapped, inputs(X))
    # What a decorator says of the function inside is not what is called.
    wrapped.__wrapped__ = lambda a, b: a  # type: ignore[attr-defined]
    Responses("y", wrapped, inputs(X))
    # What a model was made of has other arguments than a call of it.
    keeping = functools.partial(lambda function, x: function(x, 2.0), lambda x, mesh: mesh * x)
    for taken in (np.exp, keeping, np.vectorize(of_any), functools.lru_cache(of_any)):
        Responses("y", taken, inputs(X))
    Responses("y", numba.njit(lambda x: 2.0 * x), inputs(X))
    told = r"y: response: got inputs of \[2\] numbers for a function of \(a, b\) \(missing"
    for function in (lambda a, b: a, scalar(lambda a, b: a)):
        with pytest.raises(TypeError, match=told):
            Responses("y", function, inputs(PAIR))


def test_a_function_that_knows_its_sizes_is_told_those_of_a_simulator() -> None:
    told = []

    class Sized:
        def __call__(self, *x: Any) -> float:
            return 0.0

        def refuse_misfit(self, *given: Any) -> None:
            told.append(given)

    Responses("y", scalar(Sized()), inputs(PAIR, [1.0, 2.0, 3.0], X, MU, X), outputs=None)
    assert told == [("y", [2, 3, 1, 1, 1], None)]


class Counted:
    """A response that keeps what it was asked for; a specimen by itself is no run."""

    def __init__(self, function: Any) -> None:
        self.function = function
        self.asked: list[int] = []

    def __call__(self, *inputs: Any) -> Any:
        if np.size(inputs[0]) > 1:
            self.asked.append(int(np.size(inputs[0])))
        return self.function(*inputs)


# -- batches that mix their specimens ----------------------------------------------------------

POINTS = np.linspace(-2.0, 2.5, 64)


def call(response: Any, *batches: Any) -> None:
    responses = Responses("y", response, inputs(X), outputs=None)
    for batch in batches or (POINTS,):
        responses([batch], [])


def warm_start(x: Any) -> Any:
    """Start from the response of the specimen before."""
    y, last = np.empty_like(x), np.zeros(x.shape[:-1])
    for j in range(x.shape[-1]):
        last = 0.5 * last + 0.5 * x[..., j]
        y[..., j] = last
    return y


def second_is_reversed(x: Any) -> Any:
    return np.stack([x, x[..., ::-1]], axis=-1)


@pytest.mark.parametrize(
    ("response", "batches"),
    [
        (lambda x: x[..., ::-1], ()),
        (lambda x: x - x.mean(), ()),
        (lambda x: np.cumsum(x, axis=-1)[..., ::-1], ()),
        (warm_start, ()),
        (lambda x: x + 0.6 * (x - np.concatenate([x[..., :1], x[..., :-1]], axis=-1)), ()),
        (lambda x: 0.5 * (x + x[..., :1]), ()),
        (lambda x: np.cumsum(x, axis=-1), ()),
        (lambda x: np.maximum.accumulate(x, axis=-1), (POINTS.reshape(2, 32)[::-1, ::-1],)),
        (lambda x: np.gradient(x, axis=-1), (POINTS**2,)),
        (second_is_reversed, ()),
        (second_is_reversed, (np.array([0.5]), POINTS)),  # a batch of one shows nothing
    ],
    ids=[
        *("flip", "mean", "sum", "warm start", "difference", "first", "cumsum"),
        *("running maximum", "gradient", "output", "later"),
    ],
)
def test_a_response_that_mixes_its_specimens_is_refused(response: Any, batches: Any) -> None:
    said = r"y: the response of a specimen depends on .* alone, and .* among 64, expected"
    with pytest.raises(ResponseError, match=said):
        call(response, *batches)


def test_others_are_not_refused() -> None:
    rng = np.random.default_rng(0)

    def of_many(x: Any) -> Any:
        assert x.size > 1, "takes no single specimen"
        return x

    call(np.exp)
    call(lambda x: np.where(x > 0, x, np.nan))
    call(lambda x: x + 1e-4 * x.mean())  # as much as a solver's steps differ
    Responses("y", lambda x: x + rng.normal(size=x.shape), inputs(X), scatter=None)([POINTS], [])
    call(lambda x: x * 0.0 + 2.0)
    call(of_many)
    # It costs some runs that are not counted, once.
    response = Counted(lambda x: x)
    responses = Responses("y", response, inputs(X))
    for _ in range(2):
        responses([POINTS], [])
    assert response.asked == [64, 9, 64]
    assert responses.count == responses.computed == 128


def running(step: Any) -> Any:
    """Return a response of one specimen with a state: the specimen and the last response."""
    state: list[float] = []

    def response(x: float) -> float:
        state[:] = [step(x, *state) if state else x]
        return state[0]

    return response


def beside_the_first() -> Any:
    first: list[float] = []

    def response(x: float) -> float:
        first.append(x)
        return 0.5 * x + 0.5 * first[0]

    return response


def random_response() -> Any:
    rng = np.random.default_rng(0)
    return lambda x: x + rng.normal(0, 0.1)


@pytest.mark.parametrize(
    ("response", "message"),
    [
        (
            lambda: running(lambda x, last: 0.5 * last + 0.5 * x),
            "a state from one specimen to the next",
        ),
        (lambda: running(max), "a state from one specimen to the next"),
        (beside_the_first, "has changed since then"),
        (random_response, r"it is random, .*prb\.AreaMetric\(\) with prb\.Fresh"),
    ],
    ids=["warm start", "maximum", "first", "random"],
)
def test_a_response_of_one_specimen_with_a_state_or_scatter_is_refused(
    response: Any, message: str
) -> None:
    for settings in ({}, {"on_failure": Replace()}):
        responses = Responses("y", scalar(response()), inputs(X), **settings)
        with pytest.raises(ResponseError, match=message):
            responses([POINTS[[30, 9, 50, 63, 0, 20]]], [])


def test_a_random_response_of_batches_is_refused_and_also_with_a_store(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for settings in ({}, {"store": tmp_path}):
        with pytest.raises(ResponseError, match="it is random"):
            Responses("y", lambda x: x + rng.normal(size=x.shape), inputs(X), **settings)(
                [POINTS], []
            )
    # A batch whose chunks are stored is no excuse for a mean.
    with pytest.raises(ResponseError, match="depends on the other specimens"):
        Responses("z", lambda x: x - x.mean(), inputs(X), store=tmp_path)([POINTS], [])


# -- variables that change ---------------------------------------------------------------------


class Machine:
    """A response with an attribute."""

    def __init__(self, load: float) -> None:
        self.load = load

    def __call__(self, x: Any) -> Any:
        return self.load * x


def test_a_change_between_the_simulator_and_its_first_runs_is_refused() -> None:
    response = Machine(1.0)
    early = Responses("y", response, inputs(X))
    response.load = 2.0
    late = Responses("z", response, inputs(X))
    np.testing.assert_array_equal(late([POINTS], []), 2 * POINTS)
    with pytest.raises(ResponseError, match=r"^y: got 5 .* expected 2.5, its value when the"):
        early([POINTS], [])


def test_uses_cost_three_runs_once_and_none_with_a_version(tmp_path: Path) -> None:
    asked: list[float] = []

    def response(x: Any) -> Any:
        asked.extend(x)
        return np.where(x > 2, np.inf, np.where(x < -1.5, np.nan, x))

    for version, runs in ((None, 3), ("1", 0)):
        stored = Responses("y", response, inputs(X), store=tmp_path, version=version)
        values = stored([POINTS], [])
        asked.clear()
        for caller in ("prb.predict", "prb.exceedance"):
            stored.used_by(caller).refuse_change([POINTS], values, stored)
        assert len(asked) == stored.n_repeated == runs


@pytest.mark.parametrize(
    "change",
    [
        lambda x: np.where(x > 2, x + 1, x),
        lambda x: np.where(np.abs(x - 0.25) < 0.2, 0.26, x),
        lambda x: x + 1e-3,
    ],
    ids=["largest", "middle", "all"],
)
def test_a_store_refuses_a_response_that_has_changed_in_a_part(change: Any, tmp_path: Path) -> None:
    Responses("y", lambda x: x * 1.0, inputs(X), store=tmp_path)([POINTS], [])
    with pytest.raises(StoreError, match="another function, or its variables have changed"):
        Responses("y", change, inputs(X), store=tmp_path)([POINTS], [])


@pytest.mark.parametrize("wrapped", [scalar, lambda f: f], ids=["scalar", "batch"])
def test_nan_in_a_store_is_computed_again_after_a_repair(wrapped: Any, tmp_path: Path) -> None:
    def call(function: Any, **settings: Any) -> Any:
        responses = Responses("y", wrapped(function), inputs(X), store=tmp_path, **settings)
        return responses([POINTS], []), responses.computed

    def broken(x: Any) -> Any:
        return np.where(x > 1, np.nan, x)

    call(broken)
    path = re.escape(str(tmp_path / "responses.sqlite"))
    with pytest.raises(StoreError, match=rf"gives 1\..* nan, .*{path}.*pass retry_failed=True"):
        call(lambda x: x * 1.0)
    values, computed = call(lambda x: x * 1.0, retry_failed=True)
    np.testing.assert_array_equal(values, POINTS)
    # All runs: the code is another one, and they take less than ten seconds.
    assert computed == 64
    assert call(lambda x: x * 1.0) == (pytest.approx(POINTS), 3)
    # A repair that changes other responses as well is another function.
    with pytest.raises(StoreError, match="have changed"):
        call(lambda x: x + 1.0, retry_failed=True)


# -- points that repeat ------------------------------------------------------------------------


def responses_of(function: Any, n_inputs: int = 1) -> Responses:
    with pm.Model() as model:
        rate = pm.HalfNormal("rate", 3)
        inputs = [pm.Poisson.dist(rate) for _ in range(n_inputs)]
        return Responses("y", function, read_inputs("y", inputs, model))


@pytest.mark.exact
def test_each_different_point_is_computed_once() -> None:
    response = Counted(lambda a, b: 10 * a + b)
    responses = responses_of(response, 2)
    rng = np.random.default_rng(0)
    points = [rng.integers(0, 3, 500), rng.integers(0, 4, 500)]
    found = deduplicated_responses(responses, points, None)
    np.testing.assert_array_equal(found, 10 * points[0] + points[1])
    assert response.asked == [12]
    # Known ones are not computed, and none is again.
    more = [rng.integers(0, 4, 300), rng.integers(0, 4, 300)]
    found = deduplicated_responses(responses, more, (points, found))
    np.testing.assert_array_equal(found, 10 * more[0] + more[1])
    assert response.asked == [12, 4]
    assert responses.count == 800
    assert responses.computed == 16
    assert deduplicated_responses(responses, more, (more, found)) == pytest.approx(found)
    assert response.asked == [12, 4]
    # Different points are one call with all of them.
    points = [np.arange(20), np.arange(20)]
    found = deduplicated_responses(responses, points, None)
    np.testing.assert_array_equal(found, 11 * points[0])
    assert response.asked == [12, 4, 20]


@pytest.mark.exact
def test_failed_points_fail_again() -> None:
    responses = responses_of(lambda x: np.where(x > 1, np.nan, x))
    found = deduplicated_responses(responses, [np.array([0, 2, 2, 1, 0])], None)
    np.testing.assert_array_equal(found, [0, np.nan, np.nan, 1, 0])


@pytest.mark.exact
def test_a_design_of_a_discrete_input_computes_a_value_once_also_after_refinement() -> None:
    response = Counted(lambda x: 2.0 * x)
    with pm.Model() as model:
        x = pm.Binomial.dist(16, pm.Beta("p", 2, 2))
        propagation = prb.Reweighted(256)
        prb.Simulator(
            "y",
            response,
            x,
            metric=prb.AreaMetric(),
            observed=[8.0, 10.0, 12.0],
            propagation=propagation,
        )
    (node,) = nodes(model).values()
    assert response.asked == [17]
    prb.refine(model, thetas=np.full((1, 1), 2.0))
    node.reweighted.add([np.array([0.9, 0.95])])
    assert response.asked == [17, 3]  # those of a refinement, as variables may have changed
    np.testing.assert_array_equal(
        node.reweighted.design.sample.values, 2.0 * node.reweighted.design.runs.points[0]
    )


def test_the_last_call_of_shared_runs_is_reused() -> None:
    response = Counted(lambda x: 2 * x)
    first, second = (Responses(name, response, inputs(X)) for name in "yz")
    second.share(first)
    np.testing.assert_array_equal(first([POINTS], []), second([POINTS], []))
    assert response.asked == [64, 9]


LOAD = np.linspace(2.0, 0.5, 40)


@pytest.mark.parametrize(
    ("function", "constants"),
    [
        (lambda x, load: x * load, [LOAD.tolist()]),
        (lambda x: x * LOAD, []),
        (lambda x: x * pd.Series(LOAD), []),
    ],
)
def test_an_array_of_values_of_specimens_is_no_population(
    function: Any, constants: list[Any]
) -> None:
    given = inputs(X, *constants)
    x = np.linspace(1, 2, 40)
    advice = "known for each specimen, such as its load, is no constant: "
    with pytest.raises(ResponseError, match=f"takes 40 specimens, but not one or 2, .*{advice}"):
        Responses("y", function, given)([x], [])
    for batch in (np.stack([x, x]), np.ones(64)):
        with pytest.raises(ResponseError, match=advice):
            Responses("y", function, given)([batch], [])
    with pytest.raises(ResponseError, match=advice):
        Responses("y", function, given, on_failure=Replace())([x], [])
    with pytest.raises(ResponseError, match=advice):
        Responses("y", scalar(function), given)([x], [])


def test_an_array_of_two_values_and_one_inside_a_mapping_are_refused() -> None:
    with pytest.raises(ResponseError, match="takes 2 specimens, but not one or 3"):
        Responses("y", lambda x: x * LOAD[:2], inputs(X))([np.array([1.0, 2.0])], [])
    _, outputs = read_observed("y", {"y": LOAD, "load": LOAD})
    with pytest.raises(ResponseError, match="takes 40 specimens, but not one or 2"):
        Responses("y", lambda x: {"y": x * LOAD, "load": LOAD}, inputs(X), outputs=outputs)(
            [LOAD], []
        )


def test_constant_arrays_that_are_no_specimens_are_taken() -> None:
    x = np.linspace(1, 2, 40)
    _, outputs = read_observed("y", np.ones((40, 40)))
    curve = Responses("y", lambda x, t: x[..., None] * t, inputs(X, LOAD), outputs=outputs)
    np.testing.assert_array_equal(curve([x], []), x[:, None] * LOAD)
    total = Responses("y", lambda x, t: (x[..., None] * t).sum(axis=-1), inputs(X, LOAD))
    np.testing.assert_allclose(total([x], []), x * LOAD.sum())
    one = Responses("y", lambda x, t: x * t, inputs(X, [2.0]))
    np.testing.assert_array_equal(one([x], []), 2 * x)


def test_a_failed_point_has_the_names_of_its_inputs() -> None:
    def root(E: float, t: float, load: float) -> float:
        raise ArithmeticError("no root")

    match = r"the first with inputs \(E = 84.3, t = 1.98, load = 2\): it raised ArithmeticError"
    named = inputs(X, pm.Normal.dist(MU, 2.0), 2.0)
    point = [np.array([84.3]), np.array([1.98])]
    with pytest.raises(ResponseError, match=match):
        Responses("y", scalar(root), named)(point, [])
    # A variable has its own name, elements of an array have their index.
    match = r"inputs \(pair\[0\] = 1, pair\[1\] = 2, mu = 3\): it"
    vector = Responses("y", scalar(lambda pair, m: root(*pair, m)), inputs(PAIR, MU))
    with pytest.raises(ResponseError, match=match):
        vector([np.array([[1.0, 2.0]])], [np.array([3.0])])
