"""Compilation: one invalid row leaves the others alone, and what is known is not done again."""

from __future__ import annotations

from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from one_input import one_input
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op
from pytensor.tensor.blockwise import Blockwise
from pytensor.tensor.subtensor import Subtensor
from scipy import stats

import prbayes as prb
from prbayes.model.evaluator import Evaluator, compiled_objective
from prbayes.response import compile as compilation
from prbayes.response.compile import (
    compile_batched,
    compiled,
    interpreted,
)
from prbayes.response.distributions import PriorSampler


def test_our_own_graphs_have_no_notes_of_lines_and_others_have() -> None:
    x = pt.dscalar("x")
    with pytensor.config.change_flags(traceback__limit=8):
        with interpreted():
            ours = x + 1.0
        theirs = x + 2.0
        with pytest.raises(ZeroDivisionError), interpreted():
            raise ZeroDivisionError
        assert pytensor.config.traceback__limit == 8
    assert not any(getattr(ours.tag, "trace", ()))
    assert any(getattr(theirs.tag, "trace", ()))


def test_a_batch_gives_what_single_calls_do() -> None:
    x, v = pt.dscalar("x"), pt.dvector("v")
    extra = pt.dscalar("extra")
    function = compile_batched([x, v], [x * v, v.sum() + x], [extra])
    xs, vs = np.array([1.0, -2.0, 0.5]), np.arange(6.0).reshape(3, 2)
    products, sums = function(xs, vs, 3.0)
    np.testing.assert_array_equal(products, xs[:, None] * vs)
    np.testing.assert_array_equal(sums, vs.sum(axis=1) + xs)


@pytest.mark.parametrize("name", ["half", "double", "single"])
def test_a_variable_has_the_name_of_a_type(name: str) -> None:
    x = pt.dscalar(name)
    np.testing.assert_array_equal(compile_batched([x], [2 * x])([1.0, 2.0]), [[2.0, 4.0]])


def test_a_mixture_has_no_loop_over_the_rows_of_a_batch() -> None:
    mu, weight = pt.dscalar("mu"), pt.dscalar("weight")
    components = [pm.Normal.dist(mu, 1.0), pm.Normal.dist(mu + 3, 1.0)]
    mixture = pm.Mixture.dist(pt.stack([weight, 1 - weight]), components)
    function = compile_batched([mu, weight], [pm.logp(mixture, 0.5), pm.logcdf(mixture, 0.5)])
    assert not any("Blockwise" in str(node.op) for node in function.maker.fgraph.toposort())
    logp, logcdf = function(np.array([0.0, 1.0]), np.array([0.3, 0.8]))
    pair = stats.norm([[0.0, 3.0], [1.0, 4.0]])
    shares = np.array([[0.3, 0.7], [0.8, 0.2]])
    np.testing.assert_allclose(np.exp(logp), (shares * pair.pdf(0.5)).sum(axis=1))
    np.testing.assert_allclose(np.exp(logcdf), (shares * pair.cdf(0.5)).sum(axis=1))


def test_an_invalid_row_is_minus_infinity_and_leaves_the_others_alone() -> None:
    mu, sigma = pt.dscalar("mu"), pt.dscalar("sigma")
    logp = pm.logp(pm.Normal.dist(mu, sigma), 0.5)
    function = compile_batched([mu, sigma], [logp])
    (found,) = function(np.zeros(4), np.array([1.0, -1.0, np.nan, 2.0]))
    assert list(np.isneginf(found)) == [False, True, True, False]
    expected = -0.5 * np.log(2 * np.pi) - np.log([1.0, 2.0]) - 0.5 * (0.5 / np.array([1, 2])) ** 2
    np.testing.assert_allclose(found[[0, 3]], expected, rtol=1e-12)


def test_a_sum_may_have_more_terms_than_an_operation_of_numpy_has_operands() -> None:
    xs = [pt.dvector() for _ in range(95)]
    total = sum(xs[1:], start=xs[0])
    product = xs[0]
    for x in xs[1:]:
        product = product * x
    (slope,) = pt.grad(sum((x * xs[0]).sum() for x in xs), [xs[0]])
    function = compiled(xs, [total, product, slope])
    values = np.random.default_rng(0).uniform(0.9, 1.1, (95, 3))
    found = function(*values)
    slopes = values.sum(axis=0) + values[0]
    expected = [values.sum(axis=0), values.prod(axis=0), slopes]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


# -- once ------------------------------------------------------------------------------------------


@pytest.fixture
def compilations(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Begin with nothing known, and count what is compiled."""
    counted: list[Any] = []
    function = pytensor.function

    def counting(*given: Any, **keywords: Any) -> Any:
        counted.append(given)
        return function(*given, **keywords)

    monkeypatch.setattr(compilation, "_cache", OrderedDict())
    monkeypatch.setattr(pytensor, "function", counting)
    return counted


def line(slope: float, *, vector: bool = False, power: int = 2, swap: bool = False) -> Any:
    """Compile slope x^power - y."""
    x, y = (pt.dvector(), pt.dvector()) if vector else (pt.dscalar("x"), pt.dscalar("y"))
    return compiled([y, x] if swap else [x, y], [slope * x**power - y])


def test_the_same_graph_is_compiled_once(compilations: list[Any]) -> None:
    first, second = line(3.0), line(3.0)
    assert len(compilations) == 1
    assert first(2.0, 1.0) == second(2.0, 1.0) == [11.0]


@pytest.mark.parametrize(
    ("change", "found"),
    [({"slope": 4.0}, 15.0), ({"vector": True}, 11.0), ({"power": 3}, 23.0), ({"swap": True}, 1.0)],
    ids=["a constant", "a type", "an operation", "an order"],
)
def test_another_graph_is_compiled_for_itself(
    change: dict[str, Any], found: float, compilations: list[Any]
) -> None:
    line(3.0)
    other = line(**{"slope": 3.0, **change})
    assert len(compilations) == 2
    given = ([2.0], [1.0]) if "vector" in change else (2.0, 1.0)
    np.testing.assert_array_equal(np.ravel(other(*given)), [found])


def test_functions_of_one_graph_share_no_memory(compilations: list[Any]) -> None:
    x = pt.dvector()
    first, second = (compiled([x], [pt.cumsum(pt.exp(x)), x + 1]) for _ in range(2))
    (kept, _) = first(np.zeros(3))
    second(np.ones(3))
    np.testing.assert_array_equal(kept, [1, 2, 3])
    with ThreadPoolExecutor(2) as threads:
        given = [np.full(2000, float(i)) for i in range(2)]
        jobs = [
            threads.submit(lambda f, v: [f(v)[1][0] for _ in range(300)], f, v)
            for f, v in zip((first, second), given, strict=True)
        ]
        assert [set(job.result()) for job in jobs] == [{1.0}, {2.0}]
    assert len(compilations) == 1


class Theirs(Op):
    """An operation of a user's, which may hold anything."""

    __props__ = ()

    def make_node(self, x: Any) -> Apply:
        return Apply(self, [x], [x.type()])

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        outputs[0][0] = 2 * inputs[0]


@pytest.mark.parametrize("shape", [(None,), (3,)], ids=["of any length", "of three"])
def test_shared_variables_are_those_of_the_one_who_asks(
    shape: tuple[int | None], compilations: list[Any]
) -> None:
    def total(held: Any, scale: Any) -> Any:
        x = pt.dscalar()
        return compiled([x], [x * scale * pt.exp(held).sum()])

    mine, other = (pytensor.shared(np.full(3, value), shape=shape) for value in (0.0, 1.0))
    double = pytensor.shared(2.0)
    first, second = total(mine, double), total(other, double)
    assert len(compilations) == 1
    np.testing.assert_allclose([first(1.0)[0], second(1.0)[0]], [6, 6 * np.e])
    mine.set_value(np.full(3, -1.0))
    np.testing.assert_allclose([first(1.0)[0], second(1.0)[0]], [6 / np.e, 6 * np.e])
    # Which one goes where is a part of what the graph is, and so is their type.
    assert total(mine, mine)(1.0)[0].shape == (3,)
    total(pytensor.shared(np.zeros((3, 1))), double)
    assert len(compilations) == 3


@pytest.mark.parametrize("what", ["generator", "operation", "inside", "large"])
def test_what_may_be_a_users_is_not_kept(what: str, compilations: list[Any]) -> None:
    x = pt.dvector()
    graph = {
        "generator": lambda: x + pt.random.normal(rng=pytensor.shared(np.random.default_rng(0))),
        "operation": lambda: Theirs()(x),
        "inside": lambda: pt.vectorize(Theirs(), signature="(n)->(n)")(pt.stack([x, x])),
        "large": lambda: x.sum() + np.arange(1e4),
    }[what]()
    for _ in range(2):
        compiled([x], [graph])
    assert len(compilations) == 2
    assert not compilation._cache


def test_a_number_of_functions_is_kept_the_latest_used(compilations: list[Any]) -> None:
    for slope in range(1, 65):
        line(float(slope))
    line(1.0)
    line(-1.0)  # one too many: the second goes, for the first was just used
    assert len(compilation._cache) == 64
    before = len(compilations)
    line(1.0)
    assert len(compilations) == before
    line(2.0)
    assert len(compilations) == before + 1


def test_a_model_that_is_built_again_has_its_functions(compilations: list[Any]) -> None:
    def log_prior(mean: float) -> Any:
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", mean, 1), 0.5)
            y = [1.0, 2.0]
            prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=y)
        return Evaluator.of(model).hyperparameters.log_prior(np.zeros((1, 1)))[0]

    first = log_prior(0.0)
    before = len(compilations)
    assert log_prior(0.0) == first == pytest.approx(-0.5 * np.log(2 * np.pi))
    assert len(compilations) - before < before / 2
    assert log_prior(1.0) == pytest.approx(first - 0.5)


def test_the_objective_of_other_data_is_not_compiled_again(compilations: list[Any]) -> None:
    theta, scales = np.zeros(1), np.ones(1)
    added = []
    for size in (20, 30):
        y = np.linspace(0, size, size)
        model = one_input(y, prb.KullbackLeibler(), mu=(0, 1), sd=0.5)
        evaluator = Evaluator.of(model)
        before = len(compilations)
        value, _ = compiled_objective(evaluator, prior=False, gradient=True)(theta, scales)
        added.append(len(compilations) - before)
        np.testing.assert_allclose(value, evaluator.total(theta[None], scales)[0], rtol=1e-9)
    assert added == [1, 0]


def test_no_compiler_is_called_for_a_prior_of_correlations(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("C++ was to be compiled")

    monkeypatch.setattr("pytensor.link.c.cmodule.ModuleCache.module_from_key", refuse)
    before = pytensor.config.cxx
    with pm.Model() as model:
        deviations = pm.HalfNormal.dist(1.0, shape=3)
        pm.LKJCholeskyCov("chol", n=3, eta=2, sd_dist=deviations)
    (packed,) = PriorSampler(model.free_RVs)(4, 0)
    assert packed.shape == (4, 6)
    assert pytensor.config.cxx == before


def test_softplus_takes_whole_arrays_and_is_right_everywhere() -> None:
    x = pt.dvector("x")
    function = compiled([x], [pt.softplus(x), pt.log1p(pt.exp(2 * x))])
    names = [str(node.op) for node in function.maker.fgraph.toposort()]
    assert not any("oftplus" in name for name in names)
    at = np.array([-800.0, -40.0, -1e-3, 0.0, 0.3, 17.9, 18.1, 40.0, 800.0])
    for found, scale in zip(function(at), (1.0, 2.0), strict=True):
        np.testing.assert_allclose(found, np.logaddexp(0, scale * at), rtol=1e-15)


def test_an_element_of_each_row_is_taken_at_once() -> None:
    rng = np.random.default_rng(1)
    vector, matrix, i = pt.dvector("vector"), pt.dmatrix("matrix"), pt.lscalar("i")
    function = compile_batched([vector, matrix, i], [2 * vector[i], matrix[i]])
    names = [str(node.op) for node in function.maker.fgraph.toposort()]
    assert not any("Blockwise" in name for name in names)
    rows = rng.normal(size=(50, 4))
    tables = rng.normal(size=(50, 4, 3))
    which = rng.integers(-4, 4, 50)
    of_rows, of_tables = function(rows, tables, which)
    np.testing.assert_array_equal(of_rows, [2 * row[k] for row, k in zip(rows, which, strict=True)])
    each = [table[k] for table, k in zip(tables, which, strict=True)]
    np.testing.assert_array_equal(of_tables, each)
    with pytest.raises(IndexError):
        function(rows, tables, which + 4)


@pytest.mark.parametrize("one", ["vector", "index"])
def test_an_element_of_one_row_is_that_of_all(one: str) -> None:
    shapes = {"vector": (None, 4), "index": (None,)}
    shapes[one] = (1, *shapes[one][1:])
    rows = pt.tensor("rows", shape=shapes["vector"])
    which = pt.tensor("which", shape=shapes["index"], dtype="int64")
    element = Blockwise(Subtensor([0]), signature="(n),()->()")(rows, which)
    function = compiled([rows, which], [element])
    assert not any("Blockwise" in str(node.op) for node in function.maker.fgraph.toposort())
    values = np.arange(4.0) + 10 * np.arange(1 if one == "vector" else 3)[:, None]
    places = np.array([2] if one == "index" else [0, 3, 2])
    each = np.broadcast_arrays(values[:, 0], places)
    expected = np.broadcast_to(values, (3, 4))[np.arange(3), each[1]]
    np.testing.assert_array_equal(function(values, places), [expected])


def test_powers_take_whole_arrays() -> None:
    """PyTensor rewrites x^6 as a composite operation, a loop over numbers in Python."""
    x = pt.dvector("x")
    function = compiled([x], [x**6 + 2 * x**3, pt.log1p(x**8)])
    names = [str(node.op) for node in function.maker.fgraph.toposort()]
    assert not any("Composite" in name for name in names)
    at = np.linspace(-2.0, 2.0, 9)
    np.testing.assert_allclose(function(at)[0], at**6 + 2 * at**3, rtol=1e-14)
    np.testing.assert_allclose(function(at)[1], np.log1p(at**8), rtol=1e-14)
