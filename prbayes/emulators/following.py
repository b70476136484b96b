"""Emulators of an output that follow a coarse response.

The coarse response is one more input of the surface, which follows it by a constant factor, or by
one that depends on the other inputs [1]_ [2]_.

References
----------
.. [1] Kennedy, M. C. and A. O'Hagan (2000), Predicting the output from a complex computer code when
   fast approximations are available, Biometrika 87, doi:10.1093/biomet/87.1.1.
.. [2] Perdikaris, P. et al. (2017), Nonlinear information fusion algorithms for data-efficient
   multi-fidelity modelling, Proc. R. Soc. A 473, doi:10.1098/rspa.2016.0751.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._validate import Bools, Floats
from prbayes.emulators.emulator import Emulator, fit_emulator
from prbayes.emulators.surfaces import Surface


@dataclass(frozen=True, eq=False)
class Follower:
    """An emulator of one output, with a coarse response as its last input."""

    rows: Bools  # (n,): runs with a finite coarse response, used in the fit
    center: float  # location of the coarse response
    unit: float  # scale of the coarse response; after scaling it has the spread of the inputs
    emulator: Emulator

    def values(self, z: Floats, coarse: Floats) -> Floats:
        """Return values at points, (k, d), (k,) -> (k,)."""
        points = np.column_stack([z, (coarse - self.center) / self.unit])
        return self.emulator.values(points)[:, 0]


def fit_follower(
    z: Floats, y: Floats, coarse: Floats, left_out: Floats, surface: Surface
) -> Follower | None:
    """Fit an emulator of an output, (n,), that follows a coarse response; None if it is no better.

    ``left_out``, (n,), are the left-out errors of the emulator without the coarse response.
    """
    tried = surface.following()
    rows = np.isfinite(coarse)
    if 2 * rows.sum() < 3 * max(model.terms(z.shape[1] + 1) for model in tried):
        return None
    # Scale the coarse response to the location and spread of the inputs.
    unit = float(coarse[rows].std() / z[rows].std(axis=0).mean()) or 1.0
    center = float(coarse[rows].mean() - z[rows].mean() * unit)
    points = np.column_stack([z[rows], (coarse[rows] - center) / unit])
    emulator = fit_emulator(points, y[rows, None], tried=tried)
    error = (emulator.left_out**2).sum()
    alone = (left_out[rows] ** 2).sum()
    # The coarse response has to reduce the squared error by a tenth, which excludes chance, and the
    # error without it has to exceed rounding.
    if error > 0.9 * alone or alone < 1e-18 * rows.sum() * y.var():
        return None
    return Follower(rows, center, unit, emulator)
