"""The kernel's stages: what they keep, what they leave as it is, and what PyMC asks of it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from pymc.smc.kernels import SMC_KERNEL, systematic_resampling

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator
from prbayes.posterior.kernel import BatchedKernel, Normal, correlation

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)


def same(x: Any) -> Any:
    return x


@cache
def area_model() -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y",
            same,
            x,
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            epsilon=0.02,
            propagation=prb.Reweighted(256),
        )
    return model


@cache
def evaluator() -> Evaluator:
    return Evaluator.of(area_model())


def begun(draws: int = 60, **keywords: Any) -> BatchedKernel:
    kernel = BatchedKernel(draws, model=area_model(), evaluator=evaluator(), **keywords)
    kernel.initialize(None, np.random.default_rng(3))
    return kernel


def stage(kernel: BatchedKernel) -> None:
    kernel.update_beta_and_weights()
    kernel.step()


# -- Metropolis and Hastings


@dataclass
class Quadratic:
    """Log prior and log likelihood -x^2 / 4 and -x^2 / 2: at beta 1/2 a standard normal."""

    within: float = np.inf

    def __call__(self, thetas: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        squared = (thetas**2).sum(axis=1)
        likelihood = np.where(np.abs(thetas[:, 0]) < self.within, -squared / 2, np.nan)
        return -squared / 4, likelihood, squared[:, None], thetas[:, :1] ** 3


def at_standard_normal(n: int, target: Quadratic) -> BatchedKernel:
    kernel = begun(10)
    kernel._evaluate = target
    kernel.beta = 0.5
    kernel.rng = np.random.default_rng(8)
    kernel.tempered_posterior = kernel.rng.standard_normal((n, 2))
    found = target(kernel.tempered_posterior)
    kernel.prior_logp, kernel.likelihood_logp, kernel.discrepancies, kernel.lost = found
    return kernel


@pytest.mark.parametrize("proposal", ["_jump", "_walk"])
def test_proposals_leave_a_standard_normal_as_it_is(proposal: str) -> None:
    n = 20_000
    kernel = at_standard_normal(n, Quadratic())
    # A fit that is off, as one to few particles is: the acceptance has to make up for it.
    fitted = Normal(np.array([0.4, -0.3]), np.array([[1.4, 0.0], [0.5, 0.8]]))
    propose = getattr(kernel, proposal)
    before = kernel.tempered_posterior.copy()
    rates = [propose(fitted, kernel.rng.standard_normal((n, 2))) for _ in range(8)]
    after = kernel.tempered_posterior
    assert 0.2 < np.mean(rates) < 0.95
    assert (after != before).any(axis=1).mean() > 0.8
    standard_error = n**-0.5
    np.testing.assert_allclose(after.mean(axis=0), 0.0, atol=5 * standard_error)
    np.testing.assert_allclose(after.var(axis=0), 1.0, atol=5 * 2**0.5 * standard_error)
    assert abs((after[:, 0] * after[:, 1]).mean()) < 5 * standard_error
    # What is noted of the particles goes with them.
    prior, likelihood, discrepancies, lost = Quadratic()(after)
    np.testing.assert_array_equal(kernel.prior_logp, prior)
    np.testing.assert_array_equal(kernel.likelihood_logp, likelihood)
    np.testing.assert_array_equal(kernel.discrepancies, discrepancies)
    np.testing.assert_array_equal(kernel.lost, lost)


def test_places_without_a_discrepancy_are_never_accepted() -> None:
    kernel = at_standard_normal(500, Quadratic())
    inside = np.clip(kernel.tempered_posterior, -0.9, 0.9)
    kernel.tempered_posterior = inside
    target = Quadratic(within=1.0)
    kernel._evaluate = target
    found = target(inside)
    kernel.prior_logp, kernel.likelihood_logp, kernel.discrepancies, kernel.lost = found
    rate = kernel._accept(inside + 3.0, np.full(500, 100.0))
    assert rate == 0.0
    np.testing.assert_array_equal(kernel.tempered_posterior, inside)


def test_the_fitted_normal_has_the_moments_of_the_particles() -> None:
    particles = np.random.default_rng(2).normal([1.0, -2.0], [0.5, 3.0], (200, 2))
    fitted = Normal.of(particles)
    np.testing.assert_allclose(fitted.mean, particles.mean(axis=0))
    np.testing.assert_allclose(fitted.root @ fitted.root.T, np.cov(particles.T), rtol=1e-9)
    identical = Normal.of(np.ones((10, 2)))
    assert np.isfinite(identical.root).all()


def test_correlation_of_particles_with_those_before() -> None:
    before = np.random.default_rng(2).normal(size=(2000, 2))
    other = np.random.default_rng(3).normal(size=(2000, 2))
    np.testing.assert_allclose(correlation(before, before), 1.0)
    np.testing.assert_allclose(correlation(before, 3.0 - 2.0 * before), 1.0)
    assert correlation(before, other) < 5 * 2000**-0.5
    assert correlation(before, np.ones_like(before)) == 0.0


# -- Stages


def test_the_weights_of_a_stage_keep_the_share_asked_for() -> None:
    for threshold in (0.3, 0.7):
        kernel = begun(400, threshold=threshold)
        kernel.update_beta_and_weights()
        assert 0 < kernel.beta < 1
        np.testing.assert_allclose(kernel.weights.sum(), 1.0)
        effective = 1 / (kernel.weights**2).sum()
        np.testing.assert_allclose(effective, threshold * 400, rtol=0.02)


def test_what_is_noted_of_particles_is_theirs_after_a_stage() -> None:
    kernel = begun()
    stage(kernel)
    prior, likelihood, discrepancies, _ = kernel._evaluate(kernel.tempered_posterior)
    np.testing.assert_allclose(kernel.prior_logp, prior)
    np.testing.assert_allclose(kernel.likelihood_logp, likelihood)
    np.testing.assert_allclose(kernel.discrepancies, discrepancies)
    np.testing.assert_allclose(kernel.likelihood_logp, -discrepancies[:, 0] / 0.02)


def test_resampling_takes_particles_by_their_weights() -> None:
    kernel = begun(10)
    before = kernel.tempered_posterior.copy(), kernel.discrepancies.copy()
    kernel.weights = np.zeros(10)
    kernel.weights[[2, 7]] = 0.3, 0.7
    kernel.resample()
    taken = np.repeat([2, 7], [3, 7])
    np.testing.assert_array_equal(kernel.tempered_posterior, before[0][taken])
    np.testing.assert_array_equal(kernel.discrepancies, before[1][taken])


def test_another_evaluator_weighs_the_particles() -> None:
    # A standard normal at beta 1, of prior and likelihood exp(-x^2 / 4) each.
    kernel = at_standard_normal(4000, Quadratic())
    kernel.beta, kernel.draws, kernel.roughly = 1.0, 4000, True
    kernel.likelihood_logp /= 2
    kernel._evaluate = Quadratic()
    assert kernel.go_over(evaluator())
    assert not kernel.roughly
    assert kernel.evaluator is evaluator()
    # The mean of exp(-x^2 / 4) in two dimensions is 2/3; variances become 2/3.
    assert kernel.log_marginal_likelihood == pytest.approx(np.log(2 / 3), abs=0.03)
    kernel.resample()
    np.testing.assert_allclose(kernel.tempered_posterior.var(axis=0), 2 / 3, rtol=0.1)
    np.testing.assert_array_equal(kernel.likelihood_logp, Quadratic()(kernel.tempered_posterior)[1])


def test_particles_that_carry_no_weight_do_not_serve() -> None:
    kernel = at_standard_normal(1000, Quadratic())
    kernel.beta, kernel.draws = 1.0, 1000
    kernel._evaluate = Quadratic(within=0.0)
    assert not kernel.go_over(evaluator())
    kernel = at_standard_normal(1000, Quadratic())
    kernel.draws = 1000
    kernel._evaluate = Quadratic(within=0.2)  # 16% of them
    assert not kernel.go_over(evaluator())
    kernel = at_standard_normal(1000, Quadratic())
    kernel.draws = 1000
    kernel._evaluate = Quadratic(within=0.4)  # 31%
    assert kernel.go_over(evaluator())


def test_a_state_that_is_restored_goes_on_bit_for_bit() -> None:
    kernel = begun()
    stage(kernel)
    arrays, note = kernel.state()
    arrays = {name: array.copy() for name, array in arrays.items()}
    note = json.loads(json.dumps(note))
    again = BatchedKernel(60, model=area_model(), evaluator=evaluator(), random_seed=99)
    again.restore(arrays, note)
    while kernel.beta < 1:
        stage(kernel)
        stage(again)
        assert again.beta == kernel.beta
    assert again.log_marginal_likelihood == kernel.log_marginal_likelihood
    assert again.iteration == kernel.iteration
    expected, _ = kernel.state()
    found, _ = again.state()
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array)
    assert not np.array_equal(arrays["thetas"], found["thetas"])  # the saved ones stay as they were


@pytest.mark.parametrize("threshold", [0.0, 1.0, -1.0, np.nan])
def test_a_threshold_that_is_no_share_is_refused(threshold: float) -> None:
    with pytest.raises(ValueError, match="threshold"):
        BatchedKernel(10, model=area_model(), threshold=threshold)


# -- Under PyMC's own sampler


def test_the_methods_that_the_kernel_relies_on_exist() -> None:
    for name in (
        "initialize", "set_rng", "_reset_state", "_initialize_kernel", "setup_kernel", "update_beta_and_weights",
        "step", "resample", "tune", "mutate", "sample_stats", "sample_settings",
    ):  # fmt: skip
        assert callable(getattr(SMC_KERNEL, name)), name
    index = systematic_resampling(np.array([0.5, 0.0, 0.5]), np.random.default_rng(1))
    assert sorted(index) in ([0, 0, 2], [0, 2, 2])
    kernel = BatchedKernel(20, model=area_model(), random_seed=1)
    for name in (
        "tempered_posterior",
        "prior_logp",
        "likelihood_logp",
        "beta",
        "iteration",
        "weights",
    ):
        assert hasattr(kernel, name), name
    assert kernel.beta == 0
    assert kernel.log_marginal_likelihood == 0


class Recording(BatchedKernel):
    def __getattribute__(self, name: str) -> Any:
        if name in RECORDED:
            RECORD.append(name)
        return super().__getattribute__(name)


RECORD: list[str] = []
RECORDED = {
    "initialize", "set_rng", "_reset_state", "_initialize_kernel", "setup_kernel", "update_beta_and_weights", "step",
    "resample", "tune", "mutate", "sample_stats", "sample_settings",
}  # fmt: skip


def test_pymc_calls_the_kernel_in_the_documented_order() -> None:
    RECORD.clear()
    keywords = {
        "draws": 60,
        "chains": 1,
        "cores": 1,
        "progressbar": False,
        "compute_convergence_checks": False,
    }
    idata = pm.sample_smc(kernel=Recording, model=area_model(), random_seed=1, **keywords)
    stages = idata.sample_stats["beta"].size
    first = RECORD.index("initialize")
    start = ["initialize", "_reset_state", "set_rng", "_initialize_kernel", "setup_kernel"]
    stage = ["update_beta_and_weights", "step", "resample", "tune", "mutate", "sample_stats"]
    assert RECORD[first:] == start + stages * stage + ["sample_settings"]


def test_the_kernel_needs_an_epsilon() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu"), 1.0)
        prb.Simulator(
            "y", same, x, metric=prb.AreaMetric(), observed=OBSERVED, propagation=prb.Reweighted(16)
        )
    with pytest.raises(ValueError, match=r"y: epsilon is not set; call prb\.set_epsilon"):
        BatchedKernel(50, model=model)
