"""Margins of inputs, against closed forms."""

import numpy as np
import pymc as pm
import pytest
from scipy import stats

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.plots._margins import margin_densities, margins, select_margins
from prbayes.propagation.base import Propagation


def two_inputs(propagation: Propagation) -> tuple[pm.Model, list[object]]:
    def first(load: np.ndarray, gap: np.ndarray, factor: float) -> np.ndarray:
        return load[..., 0] * factor + gap + 0 * load[..., 1]

    rng = np.random.default_rng(1)
    with pm.Model() as model:
        mu, size = pm.Normal("mu", [1.0, 3.0], 1.0, shape=2), pm.HalfNormal("size", 1.0)
        load = pm.MvNormal.dist(mu, np.array([[0.04, 0.05], [0.05, 0.25]]))
        gap = pm.Gamma.dist(4.0, 4.0 / size)
        observed = rng.normal(3, 0.5, 20)
        prb.Simulator(
            "first",
            first,
            load,
            gap,
            2.0,
            metric=prb.AreaMetric(),
            observed=observed,
            propagation=propagation,
        )
        prb.Simulator(
            "second",
            lambda gap: gap**2,
            gap,
            metric=prb.AreaMetric(),
            observed=observed,
            propagation=propagation,
        )
    return model, [load, gap]


@pytest.mark.long
def test_margins_are_the_closed_forms_and_named_as_the_response_names_them() -> None:
    model, (load, gap) = two_inputs(prb.Resimulated(64))
    evaluator = Evaluator.of(model)
    known = margins(evaluator)
    assert [m.name for m in known] == ["load[0]", "load[1]", "gap"]
    assert select_margins(known, ["gap"]) == select_margins(known, [gap]) == known[2:]
    assert select_margins(known, "load") == select_margins(known, [load]) == known[:2]
    with pytest.raises(KeyError, match=r"got nothing, expected some of \['load\[0\]'"):
        select_margins(known, ["nothing"])
    thetas = np.array(
        [
            evaluator.hyperparameters.unconstrained({"mu": m, "size": s})
            for m, s in (([1, 3], 1.0), ([1.2, 2.5], 1.5))
        ]
    )
    before = evaluator.n_responses
    found = margin_densities(evaluator, known, thetas)
    assert evaluator.n_responses == before
    exact = {
        "load[0]": lambda x: stats.norm.pdf(x, [[1], [1.2]], 0.2),
        "load[1]": lambda x: stats.norm.pdf(x, [[3], [2.5]], 0.5),
        "gap": lambda x: stats.gamma.pdf(x, 4, scale=np.array([[1], [1.5]]) / 4),
    }
    for name, (grid, y) in found.items():
        np.testing.assert_allclose(y, exact[name](grid), atol=1e-9)
        assert (np.trapezoid(y, grid) > 0.98).all()


def test_margins_without_a_density_of_their_own_are_drawn() -> None:
    with pm.Model() as model:
        mu = pm.HalfNormal("mu", 5.0)
        mean = pm.Normal.dist(mu, 0.6)
        x = pm.Normal.dist(mean, 0.8)
        n = pm.Poisson.dist(mu)
        prb.Simulator(
            "y",
            lambda x, n: x + n,
            x,
            n,
            metric=prb.AreaMetric(),
            observed=np.arange(9.0),
            propagation=prb.Fresh(50),
        )
    evaluator = Evaluator.of(model)
    found = margin_densities(
        evaluator, margins(evaluator), evaluator.hyperparameters.unconstrained({"mu": 3.0})[None]
    )
    grid, y = found["x"]
    np.testing.assert_allclose(y[0], stats.norm.pdf(grid, 3, 1), atol=0.06)
    grid, y = found["n"]
    np.testing.assert_array_equal(grid, np.round(grid))
    np.testing.assert_allclose(y[0], stats.poisson.pmf(grid, 3), atol=0.04)
