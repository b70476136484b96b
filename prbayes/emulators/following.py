"""Emulators of a response that follows a coarse response.

The coarse response of an output is one more input of its surface, which follows it by a constant
factor, or by one that depends on the other inputs [1]_ [2]_.

References
----------
.. [1] Kennedy, M. C. and A. O'Hagan (2000), Predicting the output from a complex computer code when
   fast approximations are available, Biometrika 87, doi:10.1093/biomet/87.1.1.
.. [2] Perdikaris, P. et al. (2017), Nonlinear information fusion algorithms for data-efficient
   multi-fidelity modelling, Proc. R. Soc. A 473, doi:10.1098/rspa.2016.0751.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.emulators.emulator import Emulator, fit_emulator
from prbayes.emulators.surfaces import Surface


@dataclass(frozen=True, eq=False)
class Follower:
    """An emulator of one output, of which a coarse response is the last input."""

    rows: NDArray[np.bool_]  # (n,): runs with a coarse response, through which it goes
    center: float  # of the coarse response
    unit: float  # gives the coarse response the spread of the inputs
    emulator: Emulator

    def values(self, z: Floats, coarse: Floats) -> Floats:
        """Return values at points, (k, d), (k,) -> (k,)."""
        points = np.column_stack([z, (coarse - self.center) / self.unit])
        return self.emulator.values(points)[:, 0]


@dataclass(frozen=True, eq=False)
class FollowingEmulator:
    """An emulator of a response, and emulators of outputs that follow a coarse response."""

    alone: Emulator
    following: tuple[Follower | None, ...] = ()  # by output

    def values(self, z: Floats, coarse: Floats | None = None) -> Floats:
        """Return values at points, (k, d) -> (k, m), given a coarse response, (k, m).

        Where the coarse response is not finite, the emulator does without it.
        """
        values = self.alone.values(z)
        for k, follower in enumerate(self.following):
            if follower is not None and coarse is not None:
                rows = np.isfinite(coarse[:, k])
                values[rows, k] = follower.values(z[rows], coarse[rows, k])
        return values

    @property
    def left_out(self) -> Floats:
        """Error at each run of the emulator through all others, (n, m)."""
        left_out = self.alone.left_out.copy()
        for k, follower in enumerate(self.following):
            if follower is not None:
                left_out[follower.rows, k] = follower.emulator.left_out[:, 0]
        return left_out

    def without_each(self, masks: NDArray[np.bool_]) -> list[FollowingEmulator]:
        """Return emulators with the same settings that lack some runs each, (B, n)."""
        emulators = [FollowingEmulator(alone) for alone in self.alone.without_each(masks)]
        for follower in self.following:
            followers: list[Follower | None] = [None] * len(masks)
            if follower is not None:
                parts = follower.emulator.without_each(masks[:, follower.rows])
                followers = [replace(follower, emulator=part) for part in parts]
            emulators = [
                replace(emulator, following=(*emulator.following, part))
                for emulator, part in zip(emulators, followers, strict=True)
            ]
        return emulators


def fit_following(
    z: Floats,
    y: Floats,
    coarse: Floats | None = None,
    near: Floats | None = None,
    *,
    tried: Sequence[Surface],
    seed: int = 0,
) -> FollowingEmulator:
    """Fit an emulator of each output that follows a coarse response, (n, m), if errors are smaller.

    Runs (n, d), outputs (n, m), weights ``near``, (n,), and ``tried`` are as for `fit_emulator`.
    """
    alone = fit_emulator(z, y, near, tried=tried, seed=seed)
    if coarse is None:
        return FollowingEmulator(alone)
    weights = np.ones(len(z)) if near is None else near
    surfaces = [surface for model in tried for surface in model.following()]
    following: list[Follower | None] = []
    for k, output in enumerate(coarse.T):
        follower = fit_follower(z, y[:, k], output, weights, tried=surfaces, seed=seed)
        if follower is not None:
            weights_of_rows = weights[follower.rows]
            error = weights_of_rows @ follower.emulator.left_out[:, 0] ** 2
            # By more than rounding and luck.
            alone_error = weights_of_rows @ alone.left_out[follower.rows, k] ** 2
            if (
                error > 0.9 * alone_error
                or alone_error < 1e-18 * weights_of_rows.sum() * y[:, k].var()
            ):
                follower = None
        following.append(follower)
    return FollowingEmulator(alone, tuple(following))


def fit_follower(
    z: Floats,
    y: Floats,
    coarse: Floats,
    near: Floats,
    *,
    tried: Sequence[Surface],
    seed: int = 0,
) -> Follower | None:
    """Fit an emulator of an output, (n,), that follows a coarse one; None for too few of these."""
    rows = np.isfinite(coarse)
    if 2 * rows.sum() < 3 * max(model.terms(z.shape[1] + 1) for model in tried):
        return None
    # The coarse response has the place and spread of the inputs.
    unit = float(coarse[rows].std() / z[rows].std(axis=0).mean()) or 1.0
    center = float(coarse[rows].mean() - z[rows].mean() * unit)
    points = np.column_stack([z[rows], (coarse[rows] - center) / unit])
    emulator = fit_emulator(points, y[rows, None], near[rows], tried=tried, seed=seed)
    return Follower(rows, center, unit, emulator)
