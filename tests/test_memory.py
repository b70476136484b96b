"""Memory: what is made for one call is gone after it, and work in parts holds one part at a time."""

from __future__ import annotations

import gc
import tracemalloc
import weakref
from typing import Any

import numpy as np
import pymc as pm
import pytest
from line_problem import OBSERVED, line
from one_input import one_input

import prbayes as prb
from prbayes.metrics.density import twice_silverman
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import nodes
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.model.specimen_preparation import prepared

MIB = 1 << 20


def build(n: int = 128) -> pm.Model:
    keywords: dict[str, Any] = {
        "metric": prb.AreaMetric(),
        "observed": OBSERVED,
        "progressbar": False,
    }
    return one_input(response=line, propagation=prb.Reweighted(n), mu=(2, 1), **keywords)


def alive() -> int:
    """Return how many evaluators there are that were made since `gc.freeze`."""
    gc.collect()
    # By their types: what only stands for another object may be gone by now.
    return sum(issubclass(type(thing), Evaluator) for thing in gc.get_objects())


@pytest.mark.long
def test_an_evaluator_goes_with_its_last_user() -> None:
    gc.freeze()  # what other tests left is not looked at
    model = build()
    prb.minimize(model, progressbar=False)
    before = alive()
    for _ in range(2):
        prb.minimize(model, progressbar=False)
    assert alive() <= before


@pytest.mark.long
def test_a_design_goes_with_its_model_and_stays_with_what_was_compiled() -> None:
    model = build()
    prb.minimize(model, progressbar=False)
    drawn = pm.compile([model["mu"], model["sigma"]], model["y"])
    (node,) = nodes(model).values()
    bound = weakref.ref(node.bound)
    del model, node
    gc.collect()
    assert drawn(2.0, 1.0).shape == OBSERVED.shape
    del drawn
    gc.collect()
    assert bound() is None


def test_the_support_of_many_populations_is_looked_at_in_parts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    evaluator = Evaluator.of(build())
    thetas = evaluator.hyperparameters.prior_thetas(50, 1)
    whole = evaluator.support(thetas)["y"]
    monkeypatch.setattr("prbayes.model.evaluator.IN_CACHE", 1024)
    parts = evaluator.support(thetas)["y"]
    assert all(np.array_equal(whole[key], parts[key]) for key in whole)
    bound = evaluator.reweighted["y"]
    sizes = []
    support = bound.support
    monkeypatch.setattr(
        bound, "support", lambda params: sizes.append(len(params[0])) or support(params)
    )
    evaluator.support(thetas)
    assert max(sizes) == 1024 // bound.n_points


@pytest.mark.parametrize("density", [prb.GaussianKDE(twice_silverman), prb.Histogram()])
def test_the_log_likelihood_of_many_observations_takes_little_memory(density: Any) -> None:
    observed = np.random.default_rng(1).normal(size=20_000)
    tracemalloc.start()
    prb.LogLikelihood(density=density).against(observed)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 200 * MIB


def test_readings_in_parts_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    observed = np.random.default_rng(1).normal(size=200)
    whole = prb.LogLikelihood(density=prb.GaussianKDE()).against(observed)
    monkeypatch.setattr("prbayes.metrics.grid.AT_ONCE", 20 * whole.reading.size)  # type: ignore[attr-defined]
    parts = prb.LogLikelihood(density=prb.GaussianKDE()).against(observed)
    assert np.allclose(parts.reading, whole.reading, rtol=1e-12, atol=1e-15)  # type: ignore[attr-defined]


def by_specimen() -> pm.Model:
    return one_input(OBSERVED, response=line, mu=(2, 1))


@pytest.mark.long
def test_points_go_with_their_model_and_stay_with_what_was_compiled() -> None:
    model = by_specimen()
    prb.minimize(model, progressbar=False)
    log_density = model.compile_logp()
    (likelihood,) = specimen_likelihoods(model).values()
    points = weakref.ref(prepared(likelihood).points)
    start = model.initial_point()
    del model, likelihood
    gc.collect()
    assert np.isfinite(log_density(start))
    del log_density
    gc.collect()
    # Not the shared variables: Numba keeps the graphs that PyTensor compiles for it.
    assert points() is None


@pytest.mark.long
def test_points_of_other_data_replace_those_before() -> None:
    with pm.Model() as model:
        data = pm.Data("data", OBSERVED)
        x = pm.Normal.dist(pm.Normal("mu", 2, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", line, x, observed=data)
    prb.minimize(model, progressbar=False)
    (likelihood,) = specimen_likelihoods(model).values()
    before = weakref.ref(prepared(likelihood).points)
    del likelihood
    with model:
        pm.set_data({"data": OBSERVED + 0.1})
    prb.minimize(model, progressbar=False)
    gc.collect()
    assert before() is None


def test_points_of_a_model_that_was_never_compiled_go() -> None:
    model = by_specimen()
    (likelihood,) = specimen_likelihoods(model).values()
    points = weakref.ref(prepared(likelihood).points)
    del model, likelihood
    gc.collect()
    assert points() is None


def test_many_observed_values_are_compared_in_blocks_of_populations() -> None:
    observed = np.random.default_rng(0).normal(2.0, 1.0, 100_000)
    model = one_input(
        observed, prb.AreaMetric(), response=line, propagation=prb.Reweighted(64), mu=(2, 1), sd=1.0
    )
    evaluator = Evaluator.of(model)
    thetas = np.linspace(1, 3, 128)[:, None]
    single = evaluator.discrepancies(thetas[[7]], 0)
    tracemalloc.start()
    distances = evaluator.discrepancies(thetas, 0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 250 * MIB  # 128 populations at a time take 400
    np.testing.assert_allclose(distances[7], single[0], rtol=1e-12)
