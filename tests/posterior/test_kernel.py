"""The kernel's stages and first particles, and runs that go on from a checkpoint of their own."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from pymc.smc.kernels import SMC_KERNEL, systematic_resampling

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import identity_of
from prbayes.model.parameters import Hyperparameters
from prbayes.posterior.kernel import (
    BatchedKernel,
    Checkpoint,
    Particles,
    _sealed,
    correlation,
    fitted_normal,
    starting_thetas,
    stored_settings,
)
from prbayes.response.budget import BudgetError
from prbayes.response.store import StoreError

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

    def __call__(self, thetas: Floats) -> Particles:
        squared = (thetas**2).sum(axis=1)
        likelihood = np.where(np.abs(thetas[:, 0]) < self.within, -squared / 2, np.nan)
        return Particles(thetas, -squared / 4, likelihood, squared[:, None], thetas[:, :1] ** 3)


def at_standard_normal(n: int, target: Quadratic) -> BatchedKernel:
    kernel = begun(10)
    kernel._evaluate = target
    kernel.beta = 0.5
    kernel.rng = np.random.default_rng(8)
    kernel._take(target(kernel.rng.standard_normal((n, 2))))
    return kernel


@pytest.mark.parametrize("proposal", ["_independent_step", "_random_walk_step"])
def test_proposals_leave_a_standard_normal_as_it_is(proposal: str) -> None:
    n = 20_000
    kernel = at_standard_normal(n, Quadratic())
    # A fit that is off, as one to few particles is: the acceptance has to make up for it.
    root = np.array([[1.4, 0.0], [0.5, 0.8]])
    fitted = (np.array([0.4, -0.3]), root) if proposal == "_independent_step" else (root,)
    propose = getattr(kernel, proposal)
    before = kernel.tempered_posterior
    rates = [propose(*fitted, kernel.rng.standard_normal((n, 2))) for _ in range(8)]
    after = kernel.tempered_posterior
    assert 0.2 < np.mean(rates) < 0.95
    assert (after != before).any(axis=1).mean() > 0.8
    standard_error = n**-0.5
    np.testing.assert_allclose(after.mean(axis=0), 0.0, atol=5 * standard_error)
    np.testing.assert_allclose(after.var(axis=0), 1.0, atol=5 * 2**0.5 * standard_error)
    assert abs((after[:, 0] * after[:, 1]).mean()) < 5 * standard_error
    # What is noted of the particles goes with them.
    for found, expected in zip(kernel.particles, Quadratic()(after), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_places_without_a_discrepancy_are_never_accepted() -> None:
    kernel = at_standard_normal(500, Quadratic())
    inside = np.clip(kernel.tempered_posterior, -0.9, 0.9)
    target = Quadratic(within=1.0)
    kernel._evaluate = target
    kernel._take(target(inside))
    rate = kernel._accept(inside + 3.0, np.full(500, 100.0))
    assert rate == 0.0
    np.testing.assert_array_equal(kernel.tempered_posterior, inside)


def test_the_fitted_normal_has_the_moments_of_the_particles() -> None:
    particles = np.random.default_rng(2).normal([1.0, -2.0], [0.5, 3.0], (200, 2))
    mean, root = fitted_normal(particles)
    np.testing.assert_allclose(mean, particles.mean(axis=0))
    np.testing.assert_allclose(root @ root.T, np.cov(particles.T), rtol=1e-9)
    assert np.isfinite(fitted_normal(np.ones((10, 2)))[1]).all()


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
    expected = kernel._evaluate(kernel.tempered_posterior)
    for found, values in zip(kernel.particles, expected, strict=True):
        np.testing.assert_allclose(found, values)
    np.testing.assert_allclose(kernel.likelihood_logp, -expected.discrepancies[:, 0] / 0.02)


def test_resampling_takes_particles_by_their_weights() -> None:
    kernel = begun(10)
    before = kernel.particles
    kernel.weights = np.zeros(10)
    kernel.weights[[2, 7]] = 0.3, 0.7
    kernel.resample()
    taken = np.repeat([2, 7], [3, 7])
    np.testing.assert_array_equal(kernel.tempered_posterior, before.thetas[taken])
    np.testing.assert_array_equal(kernel.particles.discrepancies, before.discrepancies[taken])


def test_another_evaluator_weighs_the_particles() -> None:
    # A standard normal at beta 1, of prior and likelihood exp(-x^2 / 4) each.
    kernel = at_standard_normal(4000, Quadratic())
    kernel.beta, kernel.draws, kernel.is_coarse = 1.0, 4000, True
    likelihood = kernel.likelihood_logp / 2
    kernel._take(kernel.particles._replace(log_likelihood=likelihood))
    kernel._evaluate = Quadratic()
    assert kernel.reweight(evaluator())
    assert not kernel.is_coarse
    assert kernel.evaluator is evaluator()
    # The mean of exp(-x^2 / 4) in two dimensions is 2/3; variances become 2/3.
    assert kernel.log_marginal_likelihood == pytest.approx(np.log(2 / 3), abs=0.03)
    kernel.resample()
    np.testing.assert_allclose(kernel.tempered_posterior.var(axis=0), 2 / 3, rtol=0.1)
    np.testing.assert_array_equal(kernel.likelihood_logp, Quadratic()(kernel.tempered_posterior)[2])


def test_particles_that_carry_no_weight_do_not_serve() -> None:
    kernel = at_standard_normal(1000, Quadratic())
    kernel.beta, kernel.draws = 1.0, 1000
    kernel._evaluate = Quadratic(within=0.0)
    assert not kernel.reweight(evaluator())
    kernel = at_standard_normal(1000, Quadratic())
    kernel.draws = 1000
    kernel._evaluate = Quadratic(within=0.2)  # 16% of them
    assert not kernel.reweight(evaluator())
    kernel = at_standard_normal(1000, Quadratic())
    kernel.draws = 1000
    kernel._evaluate = Quadratic(within=0.4)  # 31%
    assert kernel.reweight(evaluator())


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


RNG = np.random.default_rng(1)
MU = RNG.normal(1, 1, (7, 2))
SIGMA = np.abs(RNG.normal(size=7))


def names() -> Hyperparameters:
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 1, 1, shape=2), pm.HalfNormal("sigma", 1)
        prb.Simulator(
            "y", np.positive, pm.Normal.dist(mu[0] + mu[1], sigma), metric=prb.AreaMetric(),
            observed=[0.0, 1.0, 2.0], propagation=prb.Reweighted(64),
        )  # fmt: skip
    return Evaluator.of(model).hyperparameters


def test_own_units_and_transformed_values_are_the_same_thetas() -> None:
    found = starting_thetas(names(), {"mu": MU, "sigma": SIGMA}, 7)
    np.testing.assert_allclose(found, np.column_stack([MU, np.log(SIGMA)]), rtol=1e-12)
    other = starting_thetas(names(), {"sigma_log__": np.log(SIGMA), "mu": MU}, 7)
    np.testing.assert_allclose(found, other, rtol=1e-12)


@pytest.mark.parametrize(
    ("start", "error", "message"),
    [
        (3, TypeError, "got int 3, expected a dict of arrays"),
        ({"mu": MU}, KeyError, r"got \['mu'\], expected values for each of \['mu', 'sigma'\]"),
        ({"mu": MU, "sigma": SIGMA, "sigma_log__": SIGMA}, KeyError, "expected values for each"),
        ({"mu": MU, "sigma": SIGMA, "nu": SIGMA}, KeyError, "expected values for each"),
        ({"mu": MU[:3], "sigma": SIGMA}, ValueError, r"mu: got shape \(3, 2\), expected \(7, 2\)"),
        ({"mu": MU, "sigma_log__": [0.0]}, ValueError, r"got shape \(1,\), expected \(7,\)"),
        ({"mu": MU, "sigma": -SIGMA}, ValueError, "got 7 of 7 points outside the support"),
        ({"mu": MU * np.nan, "sigma": SIGMA}, ValueError, "got 7 of 7 points outside"),
    ],
)
def test_other_starts_are_refused(start: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        starting_thetas(names(), start, 7)


READINGS = np.random.default_rng(1).normal(2.0, 1.0, 40)


def run(path: Path, **changes: Any) -> Any:
    """Sample a model; any of its parts, or settings of the run, may be changed."""
    prior = changes.pop("prior", lambda: pm.Normal("mu", 1, 1))
    slope = changes.pop("slope", 2.0)
    constant = changes.pop("constant", 3.0)
    family: Any = changes.pop("family", pm.Normal)
    simulator = {"metric": prb.KullbackLeibler(), "observed": READINGS, "epsilon": 0.05}
    simulator |= {"propagation": prb.Reweighted(64, max_lost=0.9)} | changes.pop("simulator", {})
    settings = {"draws": 20, "chains": 1, "random_seed": 1, "adjustment": None, "refine": False}
    settings |= changes.pop("settings", {})
    assert not changes
    with pm.Model() as model:
        mu = prior()
        x = family.dist(mu, 1.0)
        prb.Simulator("y", lambda x, c: slope * x + c - 3.0, x, constant, **simulator)
    return prb.sample_smc(model=model, checkpoint=path, progressbar=False, **settings)


def with_potential() -> Any:
    mu = pm.Normal("mu", 1, 1)
    pm.Potential("penalty", -50.0 * (mu - 5) ** 2)
    return mu


CHANGES: dict[str, dict[str, Any]] = {
    "prior": {"prior": lambda: pm.Normal("mu", -3, 0.1)},
    "prior family": {"prior": lambda: pm.Laplace("mu", 1, 1)},
    "potential": {"prior": with_potential},
    "response": {"slope": 4.0},
    "constant": {"constant": 5.0},
    "inputs": {"family": pm.Gumbel},
    "metric": {"simulator": {"metric": prb.AreaMetric()}},
    "observed": {"simulator": {"observed": READINGS + 1}},
    "epsilon": {"simulator": {"epsilon": 0.1}},
    "propagation": {"simulator": {"propagation": prb.Resimulated(64)}},
    "design": {"simulator": {"propagation": prb.Reweighted(128, max_lost=0.9)}},
    "seed": {"settings": {"random_seed": 2}},
    "draws": {"settings": {"draws": 30}},
    "chains": {"settings": {"chains": 2}},
    "threshold": {"settings": {"threshold": 0.7}},
    "adjustment": {"settings": {"adjustment": "estimate"}},
    "refinement": {"settings": {"refine": True}},
}


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    path = tmp_path_factory.mktemp("run") / "run.nc"
    return path, run(path)


@pytest.mark.parametrize("change", CHANGES)
def test_a_checkpoint_of_another_run_is_refused(change: str, done: tuple[Path, Any]) -> None:
    path, _ = done
    before = path.read_bytes()
    with pytest.raises(StoreError, match=r"belongs to another run: .*move it away"):
        run(path, **CHANGES[change])
    assert path.read_bytes() == before


def test_the_same_run_gives_the_same_draws_at_once(done: tuple[Path, Any]) -> None:
    path, first = done
    again = run(path)
    np.testing.assert_array_equal(again["posterior"]["mu"], first["posterior"]["mu"])


@pytest.mark.parametrize("adjustment", [None, "estimate"])
def test_an_interrupted_run_gives_the_draws_that_it_would_have_given(
    adjustment: str | None, tmp_path: Path
) -> None:
    settings = {"adjustment": adjustment, "chains": 2, "threshold": 0.7}
    at_once = run(tmp_path / "at_once.nc", settings=settings)
    with pytest.raises(BudgetError, match="max_stages = 1"):
        run(tmp_path / "run.nc", settings=settings | {"max_stages": 1})
    resumed = run(tmp_path / "run.nc", settings=settings)
    for group in ("posterior", "sample_stats"):
        xr.testing.assert_equal(resumed[group].to_dataset(), at_once[group].to_dataset())


def test_a_run_without_a_seed_takes_that_of_the_run_it_goes_on_with(tmp_path: Path) -> None:
    seedless = {"settings": {"random_seed": None}}
    first = run(tmp_path / "run.nc", **seedless)
    again = run(tmp_path / "run.nc", **seedless)
    np.testing.assert_array_equal(again["posterior"]["mu"], first["posterior"]["mu"])


# Files.


@pytest.fixture(scope="module")
def problem() -> Any:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=READINGS)
    return identity_of(Evaluator.of(model))


def test_arrays_and_notes_come_back(problem: Any, tmp_path: Path) -> None:
    path = tmp_path / "state.nc"
    arrays = {"thetas": np.arange(6.0).reshape(2, 3), "one": np.array(np.nan)}
    Checkpoint(path, problem, {"draws": 10, "entropy": "7"}).save(arrays, {"round": 1})
    again = Checkpoint(path, problem, {"draws": 10, "entropy": "7"})
    assert again.note == {"round": 1}
    for name, array in arrays.items():
        np.testing.assert_array_equal(again.arrays[name], array)
    assert stored_settings(path) == {"draws": 10, "entropy": "7"}
    assert not path.with_name("state.nc.part").exists()
    with xr.open_dataset(path, engine="h5netcdf") as data:  # for other programs it is netCDF
        np.testing.assert_array_equal(data["thetas"], arrays["thetas"])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: b"", "is damaged"),
        (lambda content: b"hello", "is damaged"),
        (lambda content: content[:-32], "is damaged, or no checkpoint of this version"),
        (lambda content: _sealed(b"hello"), "cannot be read"),
    ],
    ids=["empty", "text", "without digest", "sealed text"],
)
def test_damaged_files_are_refused(
    damage: Callable[[bytes], bytes], message: str, problem: Any, tmp_path: Path
) -> None:
    path = tmp_path / "state.nc"
    Checkpoint(path, problem, {"entropy": "7"}).save({"a": np.zeros(3)}, {})
    broken = damage(path.read_bytes())
    path.write_bytes(broken)
    with pytest.raises(StoreError, match=message):
        Checkpoint(path, problem, {"entropy": "7"})
    assert path.read_bytes() == broken


def test_a_folder_that_is_not_there_is_refused_before_any_work(
    problem: Any, tmp_path: Path
) -> None:
    with pytest.raises(StoreError, match="whose folder does not exist"):
        Checkpoint(tmp_path / "no" / "state.nc", problem, {})
    assert stored_settings(tmp_path / "no" / "state.nc") == {}
