"""The design of `prb.Reweighted`: stored runs, and the sample whose weights make populations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import Bools, Floats
from prbayes.propagation.base import N_BLOCKS, DesignError
from prbayes.propagation.importance import (
    SIZES,
    DesignEmulator,
    Mixture,
    MixtureSampler,
    Sample,
    concatenated,
    mixture_of,
    spread_over,
)
from prbayes.propagation.moving_support import averaged_log_density, cells_around, moving_inputs
from prbayes.propagation.population_density import normalise
from prbayes.response.compile import compile_batched
from prbayes.response.distributions import log_density
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import is_missing
from prbayes.response.response import Responses, deduplicated_responses


@dataclass(frozen=True, eq=False)
class Design:
    """Stored runs, and points whose weights make populations; one that grows is a new record."""

    runs: Sample
    mixture: Mixture  # mixture of populations that the runs were drawn from, their proposal density
    batch_sizes: tuple[int, ...]  # number of runs of each batch, in the order of the runs
    # Populations that the sample has to support, as groups of the parents' values, (k, *shape)
    # each. The first group is from the prior, the last one has the populations of interest.
    groups: tuple[tuple[Floats, ...], ...]
    # The points that have weights: the runs, or emulated points with or without the runs.
    sample: Sample
    # Emulated points, (M, *event) by input, which come first in the sample; None without emulator.
    emulated: tuple[Floats, ...] | None = None
    emulator: DesignEmulator | None = None
    n_emulated_samples: int = 0  # number of emulated samples that have been drawn
    emulated_size: int = SIZES.first  # number of points of the next emulated sample
    # Indices of the inputs whose support depends on the hyperparameters.
    moving: tuple[int, ...] = ()
    # Whether a specimen is one continuous number, so that the points are a quadrature rule.
    on_line: bool = False

    @property
    def has_emulated_points(self) -> bool:
        """Whether there are points between the runs, whose responses are emulated."""
        return self.emulated is not None

    def rows(self, mask: Bools) -> Design:
        """Return the design with some of its points only."""
        return replace(self, sample=self.sample.rows(mask))

    def runs_alone(self) -> Design:
        """Return the design without emulated points."""
        return replace(self, sample=self.runs, emulated=None, emulator=None)

    def with_values(self, values: Floats) -> Design:
        """Return the same points with another response, (n,) or (n, m)."""
        sample = replace(self.sample, values=values)
        return replace(self, sample=sample, emulated=None, emulator=None)

    def without_each_block(self) -> list[Floats]:
        """Return the responses by emulators without one block of runs each; none without one."""
        if self.emulated is None or self.emulator is None:
            return []
        n_emulated = len(self.emulated[0])
        at_runs = self.sample.values[n_emulated:]
        by_block = self.emulator.without_each_block(self.emulated)
        return [np.concatenate([values, at_runs]) for values in by_block]

    @cached_property
    def weight_arrays(self) -> list[Floats]:
        """Points and log g of the sample, then ends of cells of inputs whose support moves."""
        # With several inputs neighbouring points have unequal weights, and would leave a moving
        # support one by one. Cells that reach over 8 neighbours smooth this. With one input the
        # cells of neighbours meet.
        reach = 1 if self.on_line else 8
        cells = [cells_around(self.sample.points[i], reach) for i in self.moving]
        return [*self.sample.points, self.sample.log_density, *chain.from_iterable(cells)]

    @property
    def graph_arrays(self) -> list[Floats]:
        """The arrays of weights in a graph: points without response (NaN) have no weight."""
        arrays = list(self.weight_arrays)
        place = len(self.sample.points)
        arrays[place] = np.where(is_missing(self.sample.values), np.inf, arrays[place])
        return arrays

    def summary(self, name: str) -> str:
        """Return the number of runs, and how responses between them are emulated, as a sentence."""
        if self.emulator is None:
            return f"{name}: {len(self.runs)} runs."
        return (
            f"{name}: {len(self.runs)} runs, and {len(self.sample)} emulated points between them. "
            f"At runs that were left out the emulator has an error of {self.emulator.error_text}."
        )


class PoorEmulatorError(DesignError):
    """The emulator of another response of the same specimens is too poor."""


@dataclass(eq=False)
class DesignSampler:
    """Points of designs, and their weights: runs, and emulated points if there is an emulator."""

    mixtures: MixtureSampler
    random_seed: int
    emulator: Any
    # Compiled function of the log-weights, if the support of an input moves.
    _log_weights: Any = None

    def emulator_of(self, design: Design, at_runs: Floats) -> DesignEmulator:
        """Return an emulator of another response, fitted to its values at the runs of a design."""
        assert design.emulator is not None
        runs = replace(design.runs, values=at_runs)
        emulator = DesignEmulator.fit(self.emulator, runs, design.emulator.weights)
        # With a mixing weight of one half the bias of the emulator is as large as the sampling
        # error of the runs. The runs get the mixing weight that they have for the design's own
        # response.
        most = 0.5
        share = 1.0 if emulator is None else emulator.run_share
        if emulator is None or share > most + design.emulator.run_share:
            raise PoorEmulatorError(
                f"{self.mixtures.name}: got a response of the same specimens whose emulator would "
                f"leave {share:.0%} of a population to the {len(runs)} runs alone, expected at "
                f"most {most:.0%} more than for the response of the design; calibrate with "
                "prb.Reweighted(n, emulator=None), or let one response return both outputs"
            )
        return emulator

    def with_runs(
        self, design: Design | None, components: Sequence[Floats], n: int, responses: Responses
    ) -> Design:
        """Return a design with n more runs at points from populations at parents, (k, *shape)."""
        inputs = self.mixtures.inputs
        n_batches = 0 if design is None else len(design.batch_sizes)
        # The stride is a large prime, so that designs with seeds 0, 1, 2, ... share no batch.
        seed = self.random_seed + 7919 * n_batches
        first = inputs.aleatory[0]
        is_scalar = len(inputs.aleatory) == 1 and first.type.ndim == 0
        on_line = is_scalar and first.dtype.startswith("float")
        draw = self.mixtures.equal_mass if on_line else self.mixtures.draw
        points, mixture = draw(components, n, seed)
        # Responses that this or another design has at these points are reused.
        values = responses.runs.at(points)
        if values is not None:
            if responses.runs.is_shared or responses.may_differ:
                responses.refuse_change(points, values, responses)
            responses.count_reused(len(values))
        else:
            earlier = None if design is None else (design.runs.points, design.runs.values)
            values = deduplicated_responses(responses, points, earlier)
            responses.runs.stored.append((list(points), values))
        batch_sizes: tuple[int, ...] = (n,)
        if design is None:
            moving = moving_inputs(self.mixtures.name, inputs, components, points)
        else:
            moving = design.moving
            points = concatenated(design.runs.points, points)
            values = np.concatenate([design.runs.values, values])
            mixture = design.mixture.joined(mixture)
            batch_sizes = (*design.batch_sizes, n)
        # Each batch changes the mixture, and with it the density at the points of earlier batches.
        log_g = self.mixtures.log_density(mixture, points)
        if on_line:
            blocks = np.arange(len(log_g)) % N_BLOCKS
        else:
            # Each batch of points is a stretch of a Sobol sequence, so evenly distributed itself.
            blocks = np.concatenate([np.arange(size) * N_BLOCKS // size for size in batch_sizes])
        runs = Sample(points, values, log_g, blocks)
        if design is None:
            grown = Design(runs, mixture, batch_sizes, (), runs, moving=moving, on_line=on_line)
        else:
            grown = replace(design, runs=runs, mixture=mixture, batch_sizes=batch_sizes)
        return self.resampled(grown, components, None)

    def resampled(
        self, design: Design, components: Sequence[Floats], emulator: DesignEmulator | None
    ) -> Design:
        """Return a design that supports populations, by emulated points where these are better."""
        runs = design.runs
        # Keep the prior's group and the latest of the others, and add the new group.
        groups = (*design.groups[:1], *design.groups[1:][-1:], tuple(components))
        design = replace(design, groups=groups, sample=runs, emulated=None, emulator=None)
        if self.emulator is None:
            return design
        # 32 populations suffice to choose the mixing weight of the runs and the emulated points.
        weights = self.weights(runs, spread_over(components, 32))
        if emulator is None:
            emulator = DesignEmulator.fit(self.emulator, runs, weights)
        else:
            emulator = emulator.for_populations(weights)
        if emulator is None:
            return design
        # The stride is another prime, so that no emulated sample has the points of a batch of runs.
        seed = self.random_seed + 104_729 * (1 + design.n_emulated_samples)
        populations, shares = mixture_of(groups, design.emulated_size)
        points, mixture = self.mixtures.draw(populations, design.emulated_size, seed, shares)
        log_g = self.mixtures.log_density(mixture, points)
        return replace(
            design,
            sample=emulator.joined(points, log_g, runs),
            emulated=points,
            emulator=emulator,
            n_emulated_samples=design.n_emulated_samples + 1,
        )

    def weights(self, sample: Sample, components: Sequence[Floats]) -> Floats:
        """Return weights of a sample's points in populations, (T, n): they sum to one."""
        logs = self.mixtures.density.at(components, sample.points)(slice(None))
        logs -= sample.log_density
        normalise(logs)
        return np.where(np.isnan(logs), 1 / logs.shape[1], logs)

    def log_weights(self, params: Sequence[Any], design: Design) -> Floats:
        """Return log p(x given theta) - log g(x) at parents, shapes (k, *shape) -> (k, n)."""
        if not design.moving:
            logs = self.mixtures.density.at(params, design.sample.points)(slice(None))
            logs -= design.sample.log_density
            return logs
        if self._log_weights is None:
            inputs = self.mixtures.inputs
            symbols = inputs.placeholders()
            arrays = [
                pt.tensor(dtype=a.dtype, shape=(None,) * a.ndim) for a in design.weight_arrays
            ]
            graph = log_weight_graph(inputs, symbols, arrays, design.moving)
            self._log_weights = compile_batched(symbols, [graph], arrays)
        (logs,) = self._log_weights(*params, *design.weight_arrays)
        return np.array(logs)


def log_weight_graph(
    inputs: Inputs, params: Sequence[Any], arrays: Sequence[Any], moving: Sequence[int]
) -> TensorVariable:
    """Return log weights of symbols of the parents and of `Design.weight_arrays`, shape (n,)."""
    k = len(inputs.aleatory)
    points, log_g, ends = arrays[:k], arrays[k], arrays[k + 1 :]
    dists, _ = inputs.rebuilt(params)
    averaged = {
        i: partial(averaged_log_density, lower=lower, upper=upper)
        for i, lower, upper in zip(moving, ends[::2], ends[1::2], strict=True)
    }
    return log_density(inputs, dists, points, averaged) - log_g
