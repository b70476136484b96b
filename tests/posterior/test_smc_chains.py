"""Chains that were killed go on where they stopped, and give the particles they would have given."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import identity_of
from prbayes.posterior.kernel import BatchedKernel, Checkpoint, KernelOptions
from prbayes.posterior.results import Draws
from prbayes.posterior.smc import Chains, SamplingSettings

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 20)
DRAWS, CHAINS = 20, 3
PROPAGATIONS: dict[str, Any] = {
    "stored": prb.Reweighted(64),
    "large": prb.Reweighted(512),
    "random": prb.Fresh(32),
}


@pytest.fixture(autouse=True)
def _large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prbayes.model.evaluator._LARGE", 512)


class Killed(Exception):  # noqa: N818
    pass


def evaluator(name: str) -> Evaluator:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        prb.Simulator(
            "y",
            np.positive,
            x,
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            epsilon=0.05,
            propagation=PROPAGATIONS[name],
        )
    return Evaluator.of(model)


def run(name: str, path: Path | None = None) -> Draws:
    own = evaluator(name)
    checkpoint = None if path is None else Checkpoint(path, identity_of(own), {})
    chains = Chains(own, SamplingSettings(draws=DRAWS), checkpoint=checkpoint)
    return chains.run(np.random.SeedSequence(3).spawn(CHAINS))


@cache
def undisturbed(name: str) -> Draws:
    return run(name)


def kill_after(n_stages: int, patch: pytest.MonkeyPatch) -> None:
    """Raise at the stage after so many."""
    original, done = BatchedKernel.mutate, [0]

    def mutate(self: BatchedKernel) -> None:
        if done[0] == n_stages:
            raise Killed
        done[0] += 1
        original(self)

    patch.setattr(BatchedKernel, "mutate", mutate)


def stages_of(draws: Draws) -> list[int]:
    return [len(stages["beta"]) for stages in draws.stages]


@pytest.mark.long
@pytest.mark.parametrize("name", PROPAGATIONS)
@pytest.mark.parametrize("where", ["in the first", "before its end", "between", "in the last"])
def test_a_chain_that_was_killed_gives_the_same_particles(
    name: str, where: str, tmp_path: Path
) -> None:
    expected = undisturbed(name)
    first, second, _ = stages_of(expected)
    n_stages = {
        "in the first": 1,
        "before its end": first - 1,
        "between": first,
        "in the last": first + second + 1,
    }[where]
    with pytest.MonkeyPatch.context() as patch:
        kill_after(n_stages, patch)
        with pytest.raises(Killed):
            run(name, tmp_path / "run.nc")
    found = run(name, tmp_path / "run.nc")
    np.testing.assert_array_equal(found.thetas, expected.thetas)
    np.testing.assert_array_equal(found.discrepancies, expected.discrepancies)
    assert stages_of(found) == stages_of(expected)


def test_finished_chains_compute_nothing_again(tmp_path: Path) -> None:
    run("stored", tmp_path / "run.nc")
    with pytest.MonkeyPatch.context() as patch:
        kill_after(0, patch)
        found = run("stored", tmp_path / "run.nc")
    np.testing.assert_array_equal(found.thetas, undisturbed("stored").thetas)


def test_chains_are_independent_of_one_another() -> None:
    thetas = undisturbed("stored").thetas
    assert thetas.shape == (CHAINS, DRAWS, 1)
    for one in range(CHAINS):
        for other in range(one):
            assert not np.isin(thetas[one], thetas[other]).any()


@pytest.mark.parametrize("name", ["stored", "large"])
def test_the_discrepancies_are_those_of_the_particles(name: str) -> None:
    found = undisturbed(name)
    again = evaluator(name)(found.thetas.reshape(-1, 1)).discrepancies
    np.testing.assert_allclose(found.discrepancies.reshape(-1, 1), again)


def test_large_designs_are_whole_in_the_last_stage_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[list[int]] = []
    original = BatchedKernel.mutate

    def mutate(self: BatchedKernel) -> None:
        seen[-1].append(self.evaluator.nodes[0].bound.n_points)
        original(self)

    def begun(self: Any, *rest: Any) -> Any:
        seen.append([])
        return beginning(self, *rest)

    beginning = Chains._begin
    monkeypatch.setattr(BatchedKernel, "mutate", mutate)
    monkeypatch.setattr(Chains, "_begin", begun)
    found = run("large")
    assert len(seen) == CHAINS
    for points, stages in zip(seen, found.stages, strict=True):
        assert points == [64] * (len(points) - 1) + [512]
        # Twice at one: on an eighth of the points, and on all of them.
        betas = stages["beta"]
        assert betas[-2:] == [1, 1]
        assert max(betas[:-2]) < 1
        assert np.isnan(stages["log_marginal_likelihood"][:-2]).all()


def test_where_few_particles_serve_the_chain_begins_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prbayes.posterior.kernel._OPTIONS", KernelOptions(effective=1.1))
    found = run("large")
    for stages in found.stages:
        assert stages["beta"].count(1) == 1
        assert np.all(np.diff(stages["beta"]) > 0)
        assert {len(values) for values in stages.values()} == {len(stages["beta"])}
    # From the prior: all of the evidence is gathered once more.
    evidence = [stages["log_marginal_likelihood"][-1] for stages in found.stages]
    others = [stages["log_marginal_likelihood"][-1] for stages in undisturbed("large").stages]
    assert np.mean(evidence) == pytest.approx(np.mean(others), abs=0.5)
    again = evaluator("large")(found.thetas.reshape(-1, 1)).discrepancies
    np.testing.assert_allclose(found.discrepancies.reshape(-1, 1), again)


def test_coarser_designs_change_no_posterior(monkeypatch: pytest.MonkeyPatch) -> None:
    own = evaluator("large")
    chains = Chains(own, SamplingSettings(draws=500))
    some = [chains.run(np.random.SeedSequence(s).spawn(2)) for s in (1, 2)]
    monkeypatch.setattr("prbayes.model.evaluator._LARGE", 513)
    whole = chains.run(np.random.SeedSequence(3).spawn(4))
    thetas = np.concatenate([found.thetas for found in some])
    assert abs(thetas.mean() - whole.thetas.mean()) < 0.2 * whole.thetas.std()
    assert thetas.std() == pytest.approx(whole.thetas.std(), rel=0.15)
    evidence = [found.stages[i]["log_marginal_likelihood"][-1] for found in some for i in (0, 1)]
    others = [stages["log_marginal_likelihood"][-1] for stages in whole.stages]
    np.testing.assert_allclose(np.mean(evidence), np.mean(others), atol=0.2)
