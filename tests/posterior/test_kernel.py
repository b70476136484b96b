"""The kernel of SMC: steps, stages, first particles, and chains that continue from a checkpoint."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input
from scipy import stats

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import Identity, identity_of
from prbayes.posterior.kernel import (
    BatchedKernel,
    Checkpoint,
    Particles,
    correlation,
    starting_thetas,
)
from prbayes.posterior.results import Chains
from prbayes.posterior.smc import SamplingSettings, run_chains
from prbayes.response.budget import BudgetError
from prbayes.response.store import StoreError, only_writer

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 20)
AREA = prb.AreaMetric()
DRAWS, CHAINS = 20, 3
PROPAGATIONS: dict[str, Any] = {
    "stored": prb.Reweighted(64),
    "random": prb.Fresh(32),
}


def one_mean(propagation: Any, response: Any = np.positive, metric: Any = AREA) -> pm.Model:
    return one_input(
        OBSERVED, metric, response=response, epsilon=0.05, propagation=propagation, sd=0.5
    )


def evaluator(name: str) -> Evaluator:
    return Evaluator.of(one_mean(PROPAGATIONS[name]))


@cache
def stored() -> Evaluator:
    return evaluator("stored")


def begun(draws: int = 60, **keywords: Any) -> BatchedKernel:
    kernel = BatchedKernel(draws, model=stored().model, evaluator=stored(), **keywords)
    kernel.initialize(None, np.random.default_rng(3))
    return kernel


# -- Metropolis and Hastings


class Quadratic:
    """Log prior and log likelihood -x^2 / 4 and -x^2 / 2: at beta 1/2 a standard normal."""

    def __init__(self, within: float = np.inf) -> None:
        self.within = within

    def __call__(self, thetas: Floats) -> Particles:
        squared = (thetas**2).sum(axis=1)
        likelihood = np.where(np.abs(thetas[:, 0]) < self.within, -squared / 2, np.nan)
        return Particles(thetas, -squared / 4, likelihood, squared[:, None], thetas[:, :1] ** 3)


def at_standard_normal(n: int, target: Quadratic, within: float = np.inf) -> BatchedKernel:
    kernel = begun(10)
    kernel._evaluate = target
    kernel.beta, kernel.draws, kernel.rng = 0.5, n, np.random.default_rng(8)
    thetas = stats.truncnorm(-within, within).rvs((n, 2), random_state=kernel.rng)
    thetas[:, 1] = kernel.rng.standard_normal(n)
    kernel._take(target(thetas))
    return kernel


def test_steps_preserve_a_truncated_normal() -> None:
    """The fitted normal passes the ends of the first element: acceptance makes up for it."""
    n, target = 20_000, Quadratic(within=1.0)
    kernel = at_standard_normal(n, target, within=1.0)
    start = kernel.tempered_posterior
    kernel.mutate()
    end = kernel.tempered_posterior
    assert 0.2 < kernel.accept_rate < 0.95
    assert (end != start).any(axis=1).mean() > 0.8
    assert np.abs(end[:, 0]).max() < 1  # points without a density are never accepted
    sd = np.array([stats.truncnorm(-1, 1).std(), 1.0])
    np.testing.assert_allclose(end.mean(axis=0) / sd, 0.0, atol=5 * n**-0.5)
    np.testing.assert_allclose(end.std(axis=0) / sd, 1.0, atol=5 * (2 * n) ** -0.5)
    assert abs((end[:, 0] * end[:, 1]).mean()) < 5 * sd[0] * n**-0.5
    for values, expected in zip(kernel.particles, target(end), strict=True):
        np.testing.assert_array_equal(values, expected)


def test_identical_particles_move() -> None:
    kernel = begun(10)
    kernel._evaluate = Quadratic()
    kernel._take(kernel._evaluate(np.ones((10, 2))))
    kernel.mutate()
    assert np.isfinite(kernel.tempered_posterior).all()


def test_correlation_with_previous_particles() -> None:
    previous, independent = np.random.default_rng(2).normal(size=(2, 2000, 2))
    np.testing.assert_allclose(correlation(previous, 3.0 - 2.0 * previous), 1.0)
    assert correlation(previous, independent) < 5 * 2000**-0.5
    assert correlation(previous, np.ones_like(previous)) == 0.0


# -- stages


@pytest.mark.parametrize("threshold", [0.3, 0.7])
def test_a_stage_keeps_the_threshold_of_effective_particles(threshold: float) -> None:
    kernel = begun(400, threshold=threshold)
    kernel.update_beta_and_weights()
    assert 0 < kernel.beta < 1
    np.testing.assert_allclose(1 / (kernel.weights**2).sum(), threshold * 400, rtol=0.02)
    kernel.step()
    expected = kernel._evaluate(kernel.tempered_posterior)
    for values, others in zip(kernel.particles, expected, strict=True):
        np.testing.assert_allclose(values, others)
    np.testing.assert_allclose(kernel.likelihood_logp, -expected.discrepancies[:, 0] / 0.05)


def test_resampling_follows_the_weights() -> None:
    kernel = begun(10)
    particles = kernel.particles
    kernel.weights = np.zeros(10)
    kernel.weights[[2, 7]] = 0.3, 0.7
    kernel.resample()
    rows = np.repeat([2, 7], [3, 7])
    np.testing.assert_array_equal(kernel.tempered_posterior, particles.thetas[rows])
    np.testing.assert_array_equal(kernel.particles.discrepancies, particles.discrepancies[rows])


# -- first particles

MU = np.random.default_rng(1).normal(1, 1, (7, 2))
SIGMA = np.abs(np.random.default_rng(2).normal(size=7))


@cache
def vector_model() -> Evaluator:
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 1, 1, shape=2), pm.HalfNormal("sigma", 1)
        x = pm.Normal.dist(mu[0] + mu[1], sigma)
        prb.Simulator("y", np.positive, x, observed=[0.0, 1.0, 2.0], metric=prb.AreaMetric())
    return Evaluator.of(model)


def test_own_units_and_transformed_values_are_the_same_thetas() -> None:
    expected = np.column_stack([MU, np.log(SIGMA)])
    for start in ({"mu": MU, "sigma": SIGMA}, {"sigma_log__": np.log(SIGMA), "mu": MU}):
        thetas = starting_thetas(vector_model().hyperparameters, start, 7)
        np.testing.assert_allclose(thetas, expected, rtol=1e-12)


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
def test_invalid_starts(start: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        starting_thetas(vector_model().hyperparameters, start, 7)


# -- chains


class Killed(Exception):  # noqa: N818
    pass


def run(name: str, path: Path | None = None) -> Chains:
    problem = evaluator(name)
    checkpoint = None if path is None else Checkpoint(path, identity_of(problem), {})
    seeds = np.random.SeedSequence(3).spawn(CHAINS)
    return run_chains(problem, SamplingSettings(draws=DRAWS), seeds, checkpoint=checkpoint)


@cache
def undisturbed(name: str) -> Chains:
    return run(name)


def kill_after(n_stages: int, patch: pytest.MonkeyPatch) -> None:
    """Raise at the stage after so many."""
    original, calls = BatchedKernel.mutate, []

    def mutate(self: BatchedKernel) -> None:
        if len(calls) == n_stages:
            raise Killed
        calls.append(1)
        original(self)

    patch.setattr(BatchedKernel, "mutate", mutate)


def require_same(chains: Chains, expected: Chains) -> None:
    np.testing.assert_array_equal(chains.thetas, expected.thetas)
    np.testing.assert_array_equal(chains.discrepancies, expected.discrepancies)
    xr.testing.assert_equal(chains.sample_stats, expected.sample_stats)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "where"),
    [("stored", "in the first"), ("stored", "between"), ("random", "in the last")],
)
def test_a_killed_run_continues_with_the_same_particles(
    name: str, where: str, tmp_path: Path
) -> None:
    expected = undisturbed(name)
    first, second, _ = expected.sample_stats["beta"].count("stage").values
    n_stages = {"in the first": 1, "between": first, "in the last": first + second + 1}[where]
    with pytest.MonkeyPatch.context() as patch:
        kill_after(n_stages, patch)
        with pytest.raises(Killed):
            run(name, tmp_path / "run.nc")
    require_same(run(name, tmp_path / "run.nc"), expected)


def test_finished_chains_compute_nothing_again(tmp_path: Path) -> None:
    expected = run("stored", tmp_path / "run.nc")
    require_same(expected, undisturbed("stored"))
    with pytest.MonkeyPatch.context() as patch:
        kill_after(0, patch)
        require_same(run("stored", tmp_path / "run.nc"), expected)


def test_chains_are_independent_and_have_their_discrepancies() -> None:
    chains = undisturbed("stored")
    assert np.unique(chains.thetas[:, :, 0]).size > 0.5 * CHAINS * DRAWS
    for i in range(CHAINS):
        assert not np.isin(chains.thetas[i], chains.thetas[:i]).any()
    again = stored()(chains.thetas.reshape(-1, 1)).discrepancies
    np.testing.assert_allclose(chains.discrepancies.reshape(-1, 1), again)


# -- checkpoints


@cache
def best(response: Any = np.positive) -> prb.Optimum:
    model = one_mean(prb.Reweighted(64, max_lost=0.9), response, prb.KullbackLeibler())
    return prb.minimize(model, starts=0, progressbar=False)


def sample(path: Path, response: Any = np.positive, **changes: Any) -> xr.DataTree:
    optimum = best(response)
    settings = {"draws": 20, "chains": 1, "random_seed": 1, "adjustment": None} | changes
    return prb.sample_smc(
        model=optimum.model, optimum=optimum, checkpoint=path, progressbar=False, refine=False,
        **settings,
    )  # fmt: skip


def test_a_checkpoint_of_another_run_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    first = sample(path)
    content = path.read_bytes()
    for changes in ({"response": np.negative}, {"random_seed": 2}, {"draws": 30}):
        with pytest.raises(StoreError, match=r"belongs to another run: .*move it away"):
            sample(path, **changes)
    assert path.read_bytes() == content
    xr.testing.assert_equal(sample(path).posterior.to_dataset(), first.posterior.to_dataset())


HOLDER = """
import sys
from filelock import FileLock
lock = FileLock(sys.argv[1])
lock.acquire()
print("locked", flush=True)
sys.stdin.read()
"""


def test_a_second_run_on_a_checkpoint_is_refused_until_the_first_ends_or_is_killed(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.nc"
    part, others = f"run.nc.{'0' * 32}.part", f"run.nc.b.{'0' * 32}.part"
    for name in (part, others):
        (tmp_path / name).touch()
    command = [sys.executable, "-c", HOLDER, f"{path}.lock"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "locked\n"
        with pytest.raises(StoreError, match=r"run.nc, which another run is writing to.*wait for"):
            sample(path)
        assert not path.exists()
        holder.kill()
    first = sample(path)
    # What the killed run left is removed, what belongs to another file is not.
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.nc", others, "run.nc.lock"]
    (tmp_path / "link.nc").symlink_to(path)
    with (
        only_writer(tmp_path / "link.nc", "checkpoint"),
        pytest.raises(StoreError, match="another run is writing to"),
    ):
        sample(path)
    xr.testing.assert_equal(sample(path).posterior.to_dataset(), first.posterior.to_dataset())
    with pytest.raises(StoreError, match="whose folder does not exist"):
        sample(tmp_path / "no" / "state.nc")


@pytest.mark.parametrize("adjustment", [None, "estimate"])
def test_an_interrupted_run_gives_the_draws_of_an_uninterrupted_one(
    adjustment: str | None, tmp_path: Path
) -> None:
    settings = {"adjustment": adjustment, "chains": 2, "threshold": 0.7}
    expected = sample(tmp_path / "at_once.nc", **settings)
    with pytest.raises(BudgetError, match="max_stages = 1"):
        sample(tmp_path / "run.nc", max_stages=1, **settings)
    resumed = sample(tmp_path / "run.nc", **settings)
    for group in ("posterior", "sample_stats"):
        xr.testing.assert_equal(resumed[group].to_dataset(), expected[group].to_dataset())


def test_a_run_without_a_seed_takes_that_of_the_run_that_it_continues(tmp_path: Path) -> None:
    first, again = (sample(tmp_path / "run.nc", random_seed=None) for _ in range(2))
    np.testing.assert_array_equal(again["posterior"]["mu"], first["posterior"]["mu"])


SETTINGS = {"draws": 10, "entropy": "7"}


def test_checkpoints_keep_arrays_and_notes(tmp_path: Path) -> None:
    path, problem = tmp_path / "state.nc", identity_of(stored())
    arrays = {"thetas": np.arange(6.0).reshape(2, 3), "one": np.array(np.nan)}
    Checkpoint(path, problem, SETTINGS).save(arrays, {"round": 1})
    again = Checkpoint(path, problem, SETTINGS | {"entropy": None})
    assert again.note == {"round": 1}
    assert again.settings == SETTINGS
    for name, array in arrays.items():
        np.testing.assert_array_equal(again.arrays[name], array)
    assert not path.with_name("state.nc.part").exists()
    with xr.open_dataset(path, engine="h5netcdf") as data:  # for other programs it is netCDF
        np.testing.assert_array_equal(data["thetas"], arrays["thetas"])
    for changed in (SETTINGS | {"draws": 11}, {"entropy": "7"}, SETTINGS | {"chains": 2}):
        with pytest.raises(StoreError, match="belongs to another run"):
            Checkpoint(path, problem, changed)
    with pytest.raises(StoreError, match="belongs to another run"):
        Checkpoint(path, identity_of(vector_model()), SETTINGS)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: b"", "it is damaged"),
        (lambda content: b"hello", "it is damaged"),
        (lambda content: content[:-32], "it is damaged"),
        (lambda content: b"hello" + hashlib.sha256(b"hello").digest(), "cannot be read"),
    ],
    ids=["empty", "text", "without digest", "text with digest"],
)
def test_damaged_files_are_refused(
    damage: Callable[[bytes], bytes], message: str, tmp_path: Path
) -> None:
    path, problem = tmp_path / "state.nc", identity_of(stored())
    Checkpoint(path, problem, SETTINGS).save({"a": np.zeros(3)}, {})
    broken = damage(path.read_bytes())
    path.write_bytes(broken)
    with pytest.raises(StoreError, match=message):
        Checkpoint(path, problem, SETTINGS)
    assert path.read_bytes() == broken


def test_two_runs_on_one_checkpoint_are_noticed(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    identity = Identity({"mu": ()}, {"mu": "Normal(0, 1)"}, (), ())
    one, other = (Checkpoint(path, identity, {"entropy": "7"}) for _ in range(2))
    one.save({"theta": np.zeros(3)}, {"stage": 1})
    one.save({"theta": np.ones(3)}, {"stage": 2})
    with pytest.raises(StoreError, match="belongs to another run, which is writing to it; nothing"):
        other.save({"theta": np.zeros(3)}, {"stage": 1})
    later = Checkpoint(path, identity, {"entropy": "7"})
    assert later.note == {"stage": 2}
    later.save({"theta": np.ones(3)}, {"stage": 3})
    with pytest.raises(StoreError, match="belongs to another run, which is writing to it; nothing"):
        one.save({"theta": np.ones(3)}, {"stage": 3, "chain": 1})
    path.unlink()
    one.save({"theta": np.ones(3)}, {"stage": 3})
    assert [p.name for p in tmp_path.iterdir()] == ["run.nc"]
