"""Coordinates of the inputs of specimens: a smooth map to a vector with the prior range [-1, 1]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from prbayes._validate import AT_ONCE, Bools, Floats, Indices, Shape
from prbayes.response.distributions import PopulationSampler, PriorSampler, fixed_ends
from prbayes.response.inputs import Inputs


@dataclass(frozen=True, eq=False)
class Coordinates:
    """A smooth map between the aleatory inputs and a vector z with the prior range [-1, 1]."""

    shapes: tuple[Shape, ...]  # event shape of each aleatory input
    # (d,): whether z is linear in the logarithm of the input: for positive inputs whose prior spans
    # more than a factor of ten.
    is_log: Bools
    # (d,): middle of the prior range, which has 99 % of the specimens of the prior predictive
    # population
    center: Floats
    half_width: Floats  # (d,): half the width of that range
    # (2, d): smallest and largest z in data sets of the prior, one for each of 4096 populations. A
    # new data set of the prior exceeds an end with a probability of 1 in 4097.
    bounds: Floats
    # (2, d): ends of the range of inputs between zero and one whose density may be infinite there;
    # infinite numbers for other inputs.
    ends: Floats
    is_condition: Bools  # (d,): whether the value is known for each specimen
    # (2, d): ends of the inputs that are the same for all populations; infinite without
    support: Floats | None = None
    # (2, d): ends of the inputs at which the response may be run: those of the support, or where
    # the density may be infinite there, the bounds
    reach: Floats | None = None

    @classmethod
    def of_prior(
        cls,
        inputs: Inputs,
        n: int = 1,
        populations: int = 4096,
        sampler: PopulationSampler | None = None,
    ) -> Coordinates:
        """Return the coordinates of populations of the prior, and bounds of n specimens of each."""
        roots = PriorSampler(inputs.parents)(populations, 0)
        sampler = sampler or PopulationSampler(inputs)
        rng = np.random.default_rng([0, 11])

        def draw(count: int, among: int) -> Floats:
            drawn, _ = sampler([root[:among] for root in roots], count, rng)
            flat = np.concatenate([x.reshape(among * count, -1) for x in drawn], axis=1)
            return flat[np.isfinite(flat).all(axis=1)]

        flat = draw(1, populations)
        is_log, is_infinite = kinds_of_scale(flat)
        logs = _logs(flat, is_log)
        logs = logs[np.isfinite(logs).all(axis=1)]
        low, high = np.quantile(logs, [0.005, 0.995], axis=0)
        half_width = np.where(high > low, (high - low) / 2, 1.0)
        center = (low + high) / 2
        is_condition = np.zeros(center.size, dtype=bool)
        sizes = [int(np.prod(shape, dtype=int)) for shape in inputs.event_shapes]
        for place in inputs.conditions:
            column = sum(sizes[:place])
            is_condition[column] = True
            scale = inputs.aleatory[place].owner.op.scale
            is_log[column], center[column], half_width[column] = scale
        extremes, drawn = [], 1
        while True:
            z = (_logs(flat, is_log) - center) / half_width
            z = z[np.isfinite(z).all(axis=1)]
            extremes += [z.min(axis=0), z.max(axis=0)]
            if drawn >= n:
                break
            # Large data sets are those of fewer populations, so that time grows slowly with n, and
            # specimens are drawn in blocks, so that memory stays constant.
            among = max(min(populations, 64), populations * 128 // max(drawn, 128))
            block = min(n - drawn, max(1, 2 * AT_ONCE // (among * len(center))))
            flat = draw(block, among)
            drawn += block
        bounds = np.stack([np.min(extremes, axis=0), np.max(extremes, axis=0)])
        range_ = (np.array([[0.0], [1.0]]) - center) / half_width
        ends = np.where(is_infinite & ~is_condition, range_, [[-np.inf], [np.inf]])
        coordinates = cls(
            inputs.event_shapes, is_log, center, half_width, bounds, ends, is_condition
        )
        return coordinates.with_ends(inputs)

    def with_ends(self, inputs: Inputs) -> Coordinates:
        """Return the coordinates with the ends that are the same for all populations."""
        low, high, closed = [], [], []
        for dist in inputs.aleatory:
            lower, upper, is_closed = fixed_ends(dist)
            low.append(lower.ravel())
            high.append(upper.ravel())
            closed.append(np.full(lower.size, is_closed))
        flat = np.stack([np.concatenate(low), np.concatenate(high)])
        # A logarithm has no lower end, also where the family as such has negative numbers.
        flat[0, self.is_log] = np.maximum(flat[0, self.is_log], 0.0)
        support = (_logs(flat, self.is_log) - self.center) / self.half_width
        support[:, self.is_condition] = [[-np.inf], [np.inf]]
        is_end = np.concatenate(closed) | np.isinf(support)
        # Rounding of the map to inputs does not lead beyond an end.
        inside = np.array([[1e-9], [-1e-9]])
        reach = np.where(is_end, support, self.bounds) + inside
        return replace(self, support=support, reach=reach)

    @property
    def size(self) -> int:
        """Number of aleatory numbers of a specimen, d, with its conditions."""
        return len(self.center)

    @property
    def inputs_of_population(self) -> Indices:
        """The coordinates that are not known for each specimen."""
        return np.flatnonzero(~self.is_condition)

    def inputs(self, z: Floats) -> list[Floats]:
        """Return the aleatory inputs, shapes (..., *event), of coordinates (..., d)."""
        flat = self.center + self.half_width * z
        flat = np.where(self.is_log, np.exp(np.where(self.is_log, flat, 0.0)), flat)
        arrays, first = [], 0
        for shape in self.shapes:
            last = first + int(np.prod(shape, dtype=int))
            part = flat[..., first:last]
            arrays.append(part.reshape(*z.shape[:-1], *shape))
            first = last
        return arrays

    def inputs_of_runs(self, z: Floats) -> list[Floats]:
        """Return the inputs at which the response is run for coordinates (..., d)."""
        return self.inputs(self.within(z))

    def within(self, z: Floats) -> Floats:
        """Return coordinates (..., d) that are moved to where the response may be run."""
        return z if self.reach is None else np.clip(z, *self.reach)

    def of(self, inputs: Sequence[Floats], batch_ndim: int) -> Floats:
        """Return the coordinates (..., d) of aleatory inputs with so many batch axes."""
        batch = inputs[0].shape[:batch_ndim]
        flat = np.concatenate([x.reshape(*batch, -1) for x in inputs], axis=-1)
        return (_logs(flat, self.is_log) - self.center) / self.half_width

    def log_jacobian(self, z: Floats) -> Floats:
        """Return log|dx/dz|, (..., d) -> (...), of all inputs that are no conditions."""
        is_log = self.is_log & ~self.is_condition
        logs = np.where(is_log, self.center + self.half_width * z, 0.0).sum(axis=-1)
        return np.asarray(logs + np.log(self.half_width[~self.is_condition]).sum())


def kinds_of_scale(flat: Floats) -> tuple[Bools, Bools]:
    """Return which inputs, (n, d), have logarithmic coordinates, and which an infinite density.

    The latter is that of shares at zero or one.
    """
    low, high = np.quantile(flat, [0.005, 0.995], axis=0)
    # A density may be infinite at both ends of a range; a logarithm resolves one of them only.
    from_middle = np.abs(flat - 0.5)
    is_share = (from_middle <= 0.5).all(axis=0) & (high > 0.5)
    # Draws of a gamma density that is infinite at zero may underflow.
    is_positive = (flat >= 0).all(axis=0) & ((flat > 0).mean(axis=0) > 0.99)
    is_log = is_positive & (high > 10 * low) & ~is_share
    # A uniform density has .2 % of the draws so near to an end; one that is infinite has more.
    is_infinite = is_share & ((from_middle > 0.499).mean(axis=0) > 0.01)
    return is_log, is_infinite


@np.errstate(divide="ignore", invalid="ignore")
def _logs(flat: Floats, is_log: Bools) -> Floats:
    """Return inputs (..., d), with the logarithm of those selected; NaN for negative values."""
    return np.where(is_log, np.log(np.where(is_log, flat, 1.0)), flat)
