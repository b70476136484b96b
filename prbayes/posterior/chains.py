"""The chains of one round of sampling, saved after every stage."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from prbayes._progress import CONSOLE, lines, live, shown
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator, coarser_evaluator
from prbayes.posterior.checkpoint import Checkpoint
from prbayes.posterior.importance import LogDensity
from prbayes.posterior.kernel import BatchedKernel
from prbayes.response.budget import BudgetError

Stages = dict[str, list[float]]


class Chain(NamedTuple):
    """The draws of a chain that is finished, as in `Particles`."""

    thetas: Floats  # (draws, d)
    discrepancies: Floats  # (draws, k)
    lost: Floats  # (draws, k)


@dataclass(frozen=True, eq=False)
class Particles:
    """Draws of SMC."""

    thetas: Floats  # (chains, draws, d)
    discrepancies: Floats  # (chains, draws, k)
    lost: Floats  # (chains, draws, k): share of a population without response; NaN of stored ones
    stats: list[Stages]  # by chain: statistics by name, one value per stage
    stopped: str = ""  # which budget was spent before all chains were finished; empty if none


class Chains:
    """All chains on one design.

    Saves its state after every stage, and takes over one that was saved.

    Attributes
    ----------
    refined : list of ndarray, shapes (n, d)
        Thetas at which designs were refined in earlier rounds.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        draws: int,
        threshold: float,
        checkpoint: Checkpoint | None,
        max_stages: int | None = None,
        starts: Sequence[Floats] | None = None,
    ) -> None:
        self.evaluator = evaluator
        self.draws = draws
        self.threshold = threshold
        self.checkpoint = checkpoint
        self.max_stages = max_stages
        self.starts = starts
        self.refined: list[Floats] = []

    def __call__(
        self,
        seeds: list[np.random.SeedSequence],
        progressbar: bool,
        log_likelihood: LogDensity | None = None,
    ) -> Particles:
        """Run one chain for each seed, or as many as a budget allows.

        Parameters
        ----------
        seeds : list of SeedSequence
        progressbar : bool
        log_likelihood : callable, optional
            As for `BatchedKernel`.

        Raises
        ------
        BudgetError
            If it is spent before the first one is finished.
        """
        columns = (
            TextColumn("SMC chain {task.fields[chain]}"),
            BarColumn(),
            TextColumn("beta {task.completed:.4f}"),
            TextColumn("acceptance {task.fields[rate]:.2f}"),
            TimeElapsedColumn(),
        )
        coarser = coarser_evaluator(self.evaluator) if log_likelihood is None else None
        done: list[Chain] = []
        stats: list[Stages] = []
        stopped = ""
        with (
            shown(progressbar) as visible,
            Progress(*columns, console=CONSOLE, disable=not (visible and live())) as progress,
        ):
            write = lines()
            for chain, seed in enumerate(seeds):
                task = progress.add_task("", total=1.0, chain=chain, rate=0.0)
                finished = self._finished(chain)
                if finished is not None:
                    done.append(finished)
                    stats.append(self._saved["stats"][chain])
                    continue
                try:
                    kernel, stages = self._begun(chain, seed, coarser, log_likelihood)
                    for _ in self._stages(kernel, stages):
                        self._save(done, [*stats, stages], kernel)
                        progress.update(task, completed=kernel.beta, rate=kernel.accept_rate)
                        write(f"SMC chain {chain + 1} of {len(seeds)}: beta {kernel.beta:.3g} of 1")
                except BudgetError as spent:
                    stopped = f"{spent} in chain {chain + 1} of {len(seeds)}"
                    break
                done.append(Chain(kernel.tempered_posterior, kernel.discrepancies, kernel.lost))
                stats.append(stages)
        if not done:
            raise BudgetError(stopped)
        thetas, discrepancies, lost = map(np.array, zip(*done, strict=True))
        return Particles(
            thetas=thetas,
            discrepancies=discrepancies,
            lost=lost,
            stats=stats,
            stopped=stopped,
        )

    def _stages(self, kernel: BatchedKernel, stages: Stages) -> Iterator[None]:
        """Do the stages of a chain that are left, and yield after each.

        Raises
        ------
        BudgetError
            If a budget is spent before the last one.
        """
        while kernel.beta < 1 or kernel.roughly:
            if len(stages["beta"]) == self.max_stages:
                raise BudgetError(
                    f"max_stages = {self.max_stages} was reached (beta {kernel.beta:.3g}, of 1)"
                )
            if kernel.beta < 1:
                kernel.update_beta_and_weights()
            elif not kernel.go_over(self.evaluator):
                # An eighth of the points saw another posterior: once more, on all of them.
                kernel.initialize(kernel.start, kernel.rng)
                for values in stages.values():
                    values.clear()
                continue
            for name, value in kernel.step().items():
                stages[name].append(value)
            yield

    # -- What was saved --

    @property
    def _saved(self) -> dict[str, Any]:
        """What a run that was killed noted in this round, or nothing."""
        note = {} if self.checkpoint is None else self.checkpoint.note
        return note if note.get("round") == len(self.refined) else {}

    def saved_refinement(self, round_: int) -> Floats | None:
        """Return the thetas at which a finished round refined the designs, else None."""
        if self.checkpoint is None or round_ >= self.checkpoint.note.get("round", 0):
            return None
        return self.checkpoint.arrays[f"refined{round_}_thetas"]

    def _arrays(self, prefix: str) -> dict[str, Floats]:
        assert self.checkpoint is not None
        found = {}
        for key, array in self.checkpoint.arrays.items():
            if key.startswith(prefix):
                found[key.removeprefix(prefix)] = array
        return found

    def _finished(self, chain: int) -> Chain | None:
        """Return a chain that was at its end."""
        if chain >= self._saved.get("chain", 0):
            return None
        return Chain(**self._arrays(f"chain{chain}_"))

    def _begun(
        self,
        chain: int,
        seed: np.random.SeedSequence,
        coarser: Evaluator | None,
        log_likelihood: LogDensity | None,
    ) -> tuple[BatchedKernel, Stages]:
        """Return a kernel at the stage its chain had reached, and the statistics until then.

        On the way it has a coarser evaluator, if there is one.
        """
        evaluator = self.evaluator
        saved = self._saved
        goes_on = chain == saved.get("chain")
        roughly = saved["state"].get("roughly", False) if goes_on else coarser is not None
        (stream,) = seed.generate_state(1)
        for node in evaluator.nodes:
            node.bound.restart(int(stream))
        kernel = BatchedKernel(
            self.draws,
            model=evaluator.model,
            threshold=self.threshold,
            evaluator=coarser if roughly and coarser is not None else evaluator,
            log_likelihood=log_likelihood,
        )
        kernel.roughly = roughly
        if not goes_on:
            start = None if self.starts is None else self.starts[chain]
            kernel.initialize(start, np.random.default_rng(seed))
            return kernel, {name: [] for name in kernel.stats_dtypes_shapes}
        kernel.restore(self._arrays("now_"), saved["state"])
        for node in evaluator.nodes:
            if node.bound.random:
                node.bound.draws = saved["generators"][node.name]
        return kernel, saved["stats"][chain]

    def _save(self, done: list[Chain], stats: list[Stages], kernel: BatchedKernel) -> None:
        if self.checkpoint is None:
            return
        now, state = kernel.state()
        arrays = {f"now_{key}": value for key, value in now.items()}
        for i, chain in enumerate(done):
            for key, value in chain._asdict().items():
                arrays[f"chain{i}_{key}"] = value
        for i, thetas in enumerate(self.refined):
            arrays[f"refined{i}_thetas"] = thetas
        bounds = [node.bound for node in self.evaluator.nodes]
        note = {
            "round": len(self.refined),
            "chain": len(done),
            "stats": stats,
            "state": state,
            "generators": {bound.name: bound.draws for bound in bounds if bound.random},
        }
        self.checkpoint.save(arrays, note)
