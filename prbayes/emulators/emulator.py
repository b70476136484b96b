"""The emulator of a response: the best surface of each output, or of each principal component.

Surfaces compete by left-out errors, weighted by how near the runs are to the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from prbayes._validate import ArrayPair, Bools, Floats, Indices, complete_rows, flat_rows
from prbayes.emulators.gaussian_process import GaussianProcess
from prbayes.emulators.radial_basis import RadialBasis
from prbayes.emulators.surfaces import FittedSurface, Surface
from prbayes.numerics.threads import one_thread

# Surfaces among which cross-validation selects. Quadratic trends save runs of smooth responses with
# many inputs; a Matern process is better for kinks and jumps.
CANDIDATES: tuple[Surface, ...] = (GaussianProcess(degree=2), RadialBasis("quintic", degree="best"))
ROUGH_CANDIDATES: tuple[Surface, ...] = (
    GaussianProcess(),
    GaussianProcess("matern"),
    CANDIDATES[1],
)


@dataclass(frozen=True, eq=False)
class Emulator:
    """Surfaces through the outputs of runs.

    With more than six outputs the surfaces are mostly those of principal components.
    """

    z: Floats  # (n, d): inputs of the runs
    left_out: Floats  # (n, m): cross-validation error of each output at each run
    center: Floats  # (m,): mean of the outputs
    unit: Floats  # (m,): spread of the outputs
    # (c, m): principal components of the outputs; None if each output has a surface.
    components: Floats | None
    surfaces: tuple[FittedSurface, ...]  # surface of each output, or of each principal component

    def __call__(self, z: Floats, columns: Indices | None = None) -> ArrayPair:
        """Return values and Jacobian at points, (k, d) -> (k, m), (k, m, d).

        With ``columns``, (k, c), they are those of the outputs listed in the row of each point.
        """
        place = slice(None) if columns is None else columns
        if columns is not None and self.components is None:
            values = np.empty(columns.shape)
            jacobian = np.empty((*columns.shape, z.shape[1]))
            for k in np.unique(columns):
                rows, slots = np.nonzero(columns == k)
                of_output = self.surfaces[k](z[rows])
                values[rows, slots] = of_output[0]
                jacobian[rows, slots] = of_output[1]
        else:
            parts, slopes = zip(*(surface(z) for surface in self.surfaces), strict=True)
            values = np.stack(parts, axis=1)
            jacobian = np.stack(slopes, axis=1)
            if self.components is not None and columns is None:
                values = values @ self.components
                jacobian = np.einsum("kcd,cm->kmd", jacobian, self.components, optimize=True)
            elif self.components is not None:
                loadings = self.components.T[columns]  # (k, c, components)
                values = (loadings @ values[:, :, None])[:, :, 0]
                jacobian = loadings @ jacobian
        center, unit = self.center[place], self.unit[place]
        return center + unit * values, unit[..., None] * jacobian

    def values(self, z: Floats, columns: Indices | None = None) -> Floats:
        """Return values at points, (k, d) -> (k, m); or (k, c) of the outputs in ``columns``."""
        if columns is not None:
            if self.components is None:
                return self(z, columns)[0]
            return np.take_along_axis(self.values(z), columns, axis=1)
        values = np.stack([surface.values(z) for surface in self.surfaces], axis=1)
        if self.components is not None:
            values = values @ self.components
        return self.center + self.unit * values

    def variance(self, z: Floats) -> Floats:
        """Return predictive variances at points, (k, d) -> (k, m), in squared units of outputs."""
        variances = np.stack([surface.variance(z) for surface in self.surfaces], axis=1)
        if self.components is not None:
            variances = variances @ self.components**2
        return self.unit**2 * variances

    def without_each(self, masks: Bools) -> list[Emulator]:
        """Return emulators with the same settings that lack some runs each, (B, n)."""
        parts = zip(*(surface.without_each(masks) for surface in self.surfaces), strict=True)
        return [replace(self, surfaces=surfaces) for surfaces in parts]


@one_thread()
def fit_emulator(
    z: Floats,
    y: Floats,
    near: Floats | Bools | None = None,
    *,
    tried: Sequence[Surface] = CANDIDATES,
    start: Emulator | None = None,
    seed: int = 0,
    of_point: int | None = None,
) -> Emulator:
    """Fit the surfaces of outputs with the smallest left-out errors.

    Parameters
    ----------
    z : ndarray, shape (n, d)
        Different runs.
    y : ndarray, shape (n, m)
        Finite outputs. Outputs far beyond the data are for the caller to limit.
    near : ndarray, shape (n,), optional
        Runs whose left-out errors count, as a mask or by weights; all by default.
    tried : sequence of Surface
        Surfaces that compete.
    start : Emulator, optional
        An emulator through earlier runs, whose lengths are a start of the search.
    seed : int
        Of the parts that are left out of surfaces without a formula for their left-out errors.
    of_point : int, optional
        Largest number of outputs that are evaluated at a point; all by default. If it is less than
        a quarter of the number of principal components, each output has a surface.

    Raises
    ------
    numpy.linalg.LinAlgError
        If no surface goes through the runs.

    Examples
    --------
    >>> import numpy as np
    >>> z = np.linspace(-1, 1, 24)[:, None]
    >>> values, jacobian = fit_emulator(z, np.exp(z))(np.array([[0.5]]))
    >>> bool(np.isclose(values, np.exp(0.5))), bool(np.isclose(jacobian, np.exp(0.5)))
    (True, True)
    """
    n = len(z)
    weights = _run_weights(near, n)
    center, unit = y.mean(axis=0), y.std(axis=0)
    is_constant = unit <= 1e-14 * np.abs(y).max(axis=0)
    center, unit = np.where(is_constant, y[0], center), np.where(is_constant, 1.0, unit)
    scaled = np.where(is_constant, 0.0, (y - center) / unit)
    components, scores = None, scaled.T
    if y.shape[1] > 6:
        u, sizes, directions = np.linalg.svd(scaled, full_matrices=False)
        n_components = (sizes > 1e-3 * sizes[0]).sum()
        if of_point is None or 4 * of_point >= n_components:
            # Scores have unit spread, as scaled outputs have.
            scores = np.sqrt(n) * u.T
            components = (sizes / np.sqrt(n))[:, None] * directions
    if start is not None and (start.components is None) != (components is None):
        start = None
    surfaces = []
    left_out, rest = np.zeros_like(y), scaled
    for k, output in enumerate(scores):
        earlier = start.surfaces[k] if start is not None and k < len(start.surfaces) else None
        fits = [surface.fit(z, output, weights, earlier, seed) for surface in tried]
        solved = [fit for fit in fits if fit is not None]
        if not solved:
            raise np.linalg.LinAlgError(
                f"interpolation: got {n} points that determine no surface of {z.shape[1]} inputs"
            )
        # A single candidate is taken without its cross-validation error, which would take time.
        best = min(solved, key=lambda fit: fit.error) if len(solved) > 1 else solved[0]
        surfaces.append(best)
        if components is None:
            left_out[:, k] = best.left_out
            continue
        # Further components can be left out if they add far less than the cross-validation errors.
        rest = rest - output[:, None] * components[k]
        left_out += best.left_out[:, None] * components[k]
        error = np.sqrt(weights @ left_out**2)
        if (np.sqrt((rest**2).mean(axis=0)) <= np.maximum(1e-6, 0.03 * error)).all():
            components = components[: k + 1]
            break
    if components is not None:
        left_out += rest
    return Emulator(z, unit * left_out, center, unit, components, tuple(surfaces))


def _run_weights(near: Floats | Bools | None, n: int) -> Floats:
    """Return the weights of n runs in cross-validation, of sum one."""
    weights = np.ones(n) if near is None else np.asarray(near, dtype=float)
    return weights / weights.sum() if weights.sum() > 0 else np.full(n, 1 / n)


def with_failures(values: Floats, points: Floats, runs: Floats, outputs: Floats) -> Floats:
    """Return values at points, (k, ...), or the outputs of the nearest run where that run failed.

    Points (k, d) and runs (n, d) have common units. Outputs (n, ...) of runs that failed are not
    finite. The values are overwritten.
    """
    has_failed = ~complete_rows(flat_rows(outputs))
    if has_failed.any():
        from scipy.spatial import cKDTree

        _, nearest = cKDTree(runs).query(points)
        is_beside = has_failed[nearest]
        values[is_beside] = outputs[nearest[is_beside]]
    return values
