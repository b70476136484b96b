"""Operations of graphs, against NumPy and against differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.gradient import NullTypeGradError
from pytensor.graph.replace import vectorize_graph

import prbayes as prb
from prbayes.metrics.base import Discrepancy
from prbayes.propagation.ops import (
    CotangentOp,
    DensityOp,
    ResponseOp,
    stored_discrepancy,
    symbolic_discrepancy,
)
from prbayes.response.compile import PLAIN
from prbayes.response.inputs import read_inputs
from prbayes.response.response import Responses

OBSERVED = np.array([0.1, 0.4, 0.5, 0.9, 1.3])
SAMPLE = np.linspace(-0.5, 1.8, 12)
WEIGHTS = np.arange(1.0, 13) / 78


def target(metric: Any) -> Discrepancy:
    return metric.against(OBSERVED)


def mean_gap(simulated: Any, observed: Any, weights: Any) -> Any:
    return np.abs((simulated * weights).sum(axis=-1) - observed.mean())


METRICS = {
    "PR": prb.ProbabilityResidual(),
    "KLD": prb.KullbackLeibler(),
    "area": prb.AreaMetric(),
    "bins": prb.ProbabilityResidual(prb.Histogram()),
    "function": prb.FunctionMetric(mean_gap, weighted=True),
}


@pytest.mark.parametrize("name", ["PR", "KLD", "area"])
def test_gradients_in_values_and_weights_are_those_of_differences(name: str) -> None:
    sample, weights = pt.dvector(), pt.dvector()
    graph = symbolic_discrepancy(target(METRICS[name]), sample, weights)
    gradient = pytensor.function([sample, weights], pt.grad(graph, [sample, weights]), mode=PLAIN)
    in_sample, in_weights = gradient(SAMPLE, WEIGHTS)
    direct, step = target(METRICS[name]).of, 1e-6
    for i in range(SAMPLE.size):
        nudge = step * np.eye(SAMPLE.size)[i]
        by_sample = direct(SAMPLE + nudge, WEIGHTS) - direct(SAMPLE - nudge, WEIGHTS)
        by_weight = direct(SAMPLE, WEIGHTS + nudge) - direct(SAMPLE, WEIGHTS - nudge)
        assert in_sample[i] == pytest.approx(by_sample / (2 * step), abs=1e-6)
        assert in_weights[i] == pytest.approx(by_weight / (2 * step), abs=1e-6)


@pytest.mark.parametrize("name", ["bins", "function"])
def test_metrics_without_a_gradient(name: str) -> None:
    sample = pt.dvector()
    graph = symbolic_discrepancy(target(METRICS[name]), sample, WEIGHTS)
    with pytest.raises((NotImplementedError, NullTypeGradError), match="has no gradient"):
        pt.grad(graph, sample)


def test_second_derivatives_are_refused() -> None:
    sample = pt.dvector()
    graph = symbolic_discrepancy(target(prb.ProbabilityResidual()), sample, WEIGHTS)
    with pytest.raises(NotImplementedError, match="second derivatives"):
        pt.grad(pt.grad(graph, sample).sum(), sample)


def test_operations_are_equal_if_they_have_the_very_same_objects() -> None:
    cells, copy = (target(prb.ProbabilityResidual()).cells for _ in range(2))  # type: ignore[attr-defined]
    assert DensityOp(cells) == DensityOp(cells)
    assert hash(DensityOp(cells)) == hash(DensityOp(cells))
    assert DensityOp(cells) != DensityOp(copy)
    assert CotangentOp(cells, False) == CotangentOp(cells, False)
    assert CotangentOp(cells, False) != CotangentOp(cells, True)
    assert CotangentOp(cells, False) != DensityOp(cells)


def response_op(calls: list[tuple[int, ...]]) -> ResponseOp:
    def response(x: Any, m: Any) -> Any:
        if x.shape != (1,):  # a specimen by itself, to see that none depends on others
            calls.append(x.shape)
        return x + m

    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 1)
        x = pm.Normal.dist(mu, 1.0)
        m = pm.Normal("m", 0, 1)
        inputs = read_inputs("y", [x, m], model)
    return ResponseOp(Responses("y", response, inputs))


@pytest.mark.exact
def test_a_batch_is_one_call_of_the_response() -> None:
    calls: list[tuple[int, ...]] = []
    op = response_op(calls)
    x, m, xs, ms = pt.dvector(), pt.dvector(), pt.dmatrix(), pt.dmatrix()
    graph = vectorize_graph(op(x, m), {x: xs, m: ms})
    compiled = pytensor.function([xs, ms], graph, mode=PLAIN)
    found = compiled(np.ones((3, 4)), np.arange(3.0)[:, None])
    np.testing.assert_array_equal(found, 1 + np.arange(3.0)[:, None] + np.zeros((3, 4)))
    assert calls == [(3, 4)]
    # It is not called for populations without a finite specimen.
    values = np.array([[1.0, 2.0], [-np.inf, np.nan], [3.0, np.inf]])
    found = compiled(values, np.zeros((3, 1)))
    np.testing.assert_array_equal(found, [[1.0, 2.0], [np.nan, np.nan], [3.0, np.inf]])
    assert np.isnan(compiled(np.full((1, 2), -np.inf), np.zeros((1, 1)))).all()
    assert calls == [(3, 4), (2, 2)]


def test_backends_without_an_operation_say_what_to_do_and_not_what_it_contains() -> None:
    cells = target(prb.ProbabilityResidual()).cells  # type: ignore[attr-defined]
    for op in [response_op([]), DensityOp(cells), CotangentOp(cells, False)]:
        assert str(op).startswith(f"{type(op).__name__}, which is computed by NumPy: PyTensor's JA")
        assert "use that, or nuts_sampler='nutpie' or 'pymc'" in str(op)
        assert len(str(op)) < 200


@pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)
@pytest.mark.parametrize("propagation", [prb.Resimulated(32), prb.Fresh(32)])
def test_jax_refuses_densities_of_simulated_values(propagation: Any) -> None:
    pytest.importorskip("jax")
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        prb.Simulator(
            "y", lambda x: 2 * x, x, metric=prb.ProbabilityResidual(), observed=OBSERVED,
            epsilon=0.1, propagation=propagation,
        )  # fmt: skip
    with pytest.raises(
        NotImplementedError, match=r"JAX mode and NumPyro take prb\.Reweighted alon"
    ):
        model.compile_logp(mode="JAX")(model.initial_point())


@pytest.mark.parametrize("name", ["PR", "KLD", "bins"])
def test_a_basis_of_projections_has_the_discrepancy_and_gradient_of_the_matrix(name: str) -> None:
    rng = np.random.default_rng(3)
    joint = prb.Joint(METRICS[name]).against(rng.standard_normal((20, 2)))
    values = rng.standard_normal((30, 2))
    values[4, 1] = np.nan
    weights, many = pt.dvector(), pt.dmatrix()
    rows = rng.dirichlet(np.ones(30), 3)
    results = []
    for most in (np.inf, 0):
        basis = joint.basis(values, most)
        graph = stored_discrepancy(joint, basis, weights)
        # Batches of weights share the values.
        batched = vectorize_graph(graph, {weights: many})
        wanted = [graph, pt.grad(graph, weights), batched]
        function = pytensor.function([weights, many], wanted, mode=PLAIN)
        features = basis.features(rows)
        results.append([*function(rows[0], rows), joint.outer(*features, xp=np)])
    for matrix, projections in zip(*results, strict=True):
        np.testing.assert_allclose(projections, matrix, rtol=1e-12, atol=1e-14)
