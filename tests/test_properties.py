"""What holds for any numbers: metrics against plain sums, invariances, small models at random.

Examples are the same in every run. PRBAYES_EXAMPLES=500 makes more of them.
"""

from __future__ import annotations

import os
from itertools import pairwise
from typing import Any

import numpy as np
import pymc as pm
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from scipy.stats import wasserstein_distance

import prbayes as prb
from prbayes._stats import quantile, reached
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator, compiled_objective
from prbayes.model.parameters import unconstrained
from prbayes.propagation.base import discrepancy_error
from prbayes.response.compile import PLAIN

EXAMPLES = int(os.environ.get("PRBAYES_EXAMPLES", "10"))
MODELS = max(1, EXAMPLES // 10)
QUIET = {
    "derandomize": True,
    "deadline": None,
    "database": None,
    "suppress_health_check": list(HealthCheck),
}
many = settings(max_examples=EXAMPLES, **QUIET)
# A smaller example of a failure would cost many models.
few = settings(max_examples=MODELS, phases=[Phase.generate], **QUIET)

# Sevenths, so that there are ties and sums are rounded.
numbers = st.integers(-70, 70).map(lambda k: k / 7)
sizes = st.sampled_from([1, 2, 3, 4, 7, 20])
scales = st.integers(-150, 150).map(lambda power: 10.0**power)


@st.composite
def samples(draw: st.DrawFn, smallest: int = 1) -> tuple[Floats, Floats]:
    """Draw values and weights that sum to one, a few of them zero."""
    n = draw(sizes.filter(lambda size: size >= smallest))
    values = np.array(draw(st.lists(numbers, min_size=n, max_size=n)))
    raw = np.array(draw(st.lists(st.integers(0, 5), min_size=n, max_size=n)), dtype=float)
    raw = raw if raw.any() else np.ones(n)
    return values, raw / raw.sum()


# -- Plain sums ------------------------------------------------------------------------------------


METRICS = {
    "PR": prb.ProbabilityResidual(),
    "KLD": prb.KullbackLeibler(),
    "area": prb.AreaMetric(),
    "log-likelihood": prb.LogLikelihood(density=prb.GaussianKDE()),
}

# -- Metrics ---------------------------------------------------------------------------------------


@many
@given(samples(), samples(), scales)
def test_the_area_is_the_first_wasserstein_distance(
    simulated: Any, observed: Any, scale: float
) -> None:
    (x, w), (y, v) = simulated, observed
    metric = prb.AreaMetric()
    found = metric(scale * x, scale * y, weights=5 * w, observed_weights=9 * v)
    distance = wasserstein_distance(x, y, w, v)
    assert found / scale == pytest.approx(distance, rel=1e-12, abs=1e-13)
    prepared = metric.against(scale * y, v)
    stored = prepared.outer(*prepared.basis(scale * x).features(w), xp=np)
    assert float(stored) / scale == pytest.approx(found / scale, rel=1e-12, abs=1e-13)


# -- Weighted samples ------------------------------------------------------------------------------


@many
@given(samples(), st.integers(0, 20).map(lambda k: k / 20), scales)
def test_quantiles_are_lines_between_the_middles_of_steps(
    sample: Any, level: float, scale: float
) -> None:
    values, weights = sample[0][sample[1] > 0], sample[1][sample[1] > 0]
    found = float(quantile(scale * values, weights, level)) / scale
    corners, total = [], 0.0
    for x, w in sorted(zip(values, weights, strict=True)):
        corners.append((total + w / 2, x))
        total += w
    if level <= corners[0][0]:
        expected = {corners[0][1]}
    elif level >= corners[-1][0]:
        expected = {corners[-1][1]}
    else:
        expected = set()
        for (a, low), (b, high) in pairwise(corners):
            if a - 1e-12 <= level <= b + 1e-12:
                part = (level - a) / (b - a) if b > a + 1e-12 else 0.0
                expected |= {low + part * (high - low), *((low, high) if b <= a + 1e-12 else ())}
    assert any(found == pytest.approx(each, abs=1e-9) for each in expected)


@many
@given(samples(), st.lists(st.integers(1, 40).map(lambda k: k / 40.5), min_size=1, max_size=4))
def test_a_level_is_reached_at_the_first_sum_that_is_not_below(sample: Any, levels: Any) -> None:
    _, weights = sample
    found = reached(weights, np.array(levels), normalized=True)
    sums = np.cumsum(weights)
    expected = [next((i for i, s in enumerate(sums) if s >= z), sums.size - 1) for z in levels]
    assert list(found) == expected


# -- Small models ----------------------------------------------------------------------------------

FAMILIES = {
    "Normal": lambda a, b: pm.Normal.dist(a, b),
    "LogNormal": lambda a, b: pm.LogNormal.dist(0.5 * a, 0.5 * b),
    "Gamma": lambda a, b: pm.Gamma.dist(mu=1.0 + 0.2 * a, sigma=0.6 * b),
    "Logistic": lambda a, b: pm.Logistic.dist(a, 0.6 * b),
    "Gumbel": lambda a, b: pm.Gumbel.dist(a, b),
    "Weibull": lambda a, b: pm.Weibull.dist(1.0 + b, 1.5 + 0.2 * a),
    "Triangular": lambda a, b: pm.Triangular.dist(lower=-3, c=0.5 * a, upper=3 + 0 * b),
    "TruncatedNormal": lambda a, b: pm.TruncatedNormal.dist(a, b, lower=-1.0, upper=4.0),
}


@st.composite
def problems(draw: st.DrawFn) -> dict[str, Any]:
    """Draw what a small model is made of."""
    families = draw(st.lists(st.sampled_from(list(FAMILIES)), min_size=1, max_size=2))
    return {
        "families": families,
        "linear": draw(st.sampled_from([1.0, -2.0, 0.5])),
        "square": draw(st.sampled_from([0.0, 0.0, 0.3])),
        "kind": draw(st.sampled_from(["PR", "KLD", "area", "log-likelihood"])),
        "at": (draw(st.sampled_from([-0.4, 0.0, 0.5])), draw(st.sampled_from([0.8, 1.0, 1.3]))),
        "seed": draw(st.integers(0, 99)),
    }


def evaluator_of(problem: dict[str, Any], propagation: Any) -> Evaluator:
    def response(*inputs: Any) -> Any:
        y: Any = 0.0
        for share, x in zip((1.0, 0.4), inputs, strict=False):
            y = y + share * (problem["linear"] * x + problem["square"] * x**2)
        return y

    rng = np.random.default_rng(problem["seed"])
    with pm.Model() as model:
        a, b = pm.Normal("a", 0, 0.5), pm.LogNormal("b", 0, 0.3)
        inputs = [FAMILIES[family](a, b) for family in problem["families"]]
        truth = [
            pm.draw(FAMILIES[family](0.0, 1.0), 40, random_seed=rng, mode=PLAIN)
            for family in problem["families"]
        ]
        prb.Simulator(
            "y",
            response,
            *inputs,
            metric=METRICS[problem["kind"]],
            observed=response(*truth),
            propagation=propagation,
        )
    return Evaluator.of(model)


@pytest.mark.long
@few
@given(problems())
@pytest.mark.filterwarnings("default")
def test_three_propagations_agree_and_gradients_are_differences(problem: dict[str, Any]) -> None:
    n = 1024 * len(problem["families"]) ** 2
    found, errors = [], []
    for propagation in (prb.Reweighted(n), prb.Resimulated(2 * n), prb.Fresh(1 << 14)):
        evaluator = evaluator_of(problem, propagation)
        bound = evaluator.nodes[0].bound
        theta = unconstrained(
            evaluator.hyperparameters, {"a": problem["at"][0], "b": problem["at"][1]}
        )
        roots = evaluator.parents(theta[None], 0)
        (value,) = bound.discrepancies(roots, bound.target)
        found.append(value)
        errors.append(discrepancy_error(bound, roots))
        if bound.random:
            continue
        try:
            objective = compiled_objective(evaluator, prior=False, gradient=True)
        except TypeError:
            assert "Gamma" in problem["families"]  # whose quantiles have no derivative
            continue
        plain, gradient = objective(theta, np.ones(1))
        assert plain == pytest.approx(value, rel=1e-9)
        steps = 1e-5 * np.eye(2)
        for step, slope in zip(steps, gradient, strict=True):
            above, beneath = (objective(theta + s * step, np.ones(1))[0] for s in (1, -1))
            difference = (above - beneath) / 2e-5
            largest = max(np.abs(gradient).max(), 1e-6)
            assert slope == pytest.approx(difference, rel=2e-3, abs=0.02 * largest)
    scale = evaluator.nodes[0].target.scale
    for i, k in ((0, 1), (0, 2), (1, 2)):
        allowed = 5 * np.hypot(errors[i], errors[k]) + 0.002 * scale
        assert abs(found[i] - found[k]) < allowed, (found, errors)
