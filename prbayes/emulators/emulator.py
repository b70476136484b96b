"""The emulator of a response: the best surface of each output, or of each principal component.

Surfaces compete by left-out errors, weighted by how near the runs are to the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.emulators.kriging import (
    Kriging,
    Polynomials,
    fit_kriging,
    likeliest,
    orthonormal,
)
from prbayes.numerics.threads import one_thread

# Kernels of surfaces that compete.
CANDIDATES = ("squared_exponential", "quintic")


@dataclass(frozen=True, eq=False)
class Emulator:
    """Surfaces through the outputs of runs."""

    z: Floats  # (n, d): runs
    left_out: Floats  # (n, m): error at each run of the surface through all others
    center: Floats  # (m,): mean of the outputs
    unit: Floats  # (m,): spread of the outputs
    components: Floats | None  # (c, m): principal components; None if surfaces are of outputs
    parts: tuple[tuple[NDArray[np.intp], Kriging], ...]  # surfaces with the outputs they have

    def __call__(self, z: Floats) -> tuple[Floats, Floats]:
        """Return values and Jacobian at points, (k, d) -> (k, m), (k, m, d)."""
        values = np.empty((len(z), self.n_surfaces))
        jacobian = np.empty((*values.shape, z.shape[1]))
        for columns, surface in self.parts:
            values[:, columns], jacobian[:, columns] = surface(z)
        if self.components is not None:
            values = values @ self.components
            jacobian = np.einsum("kcd,cm->kmd", jacobian, self.components, optimize=True)
        return self.center + self.unit * values, self.unit[:, None] * jacobian

    def values(self, z: Floats) -> Floats:
        """Return values at points, (k, d) -> (k, m)."""
        values = np.empty((len(z), self.n_surfaces))
        for columns, surface in self.parts:
            values[:, columns] = surface.values(z)
        if self.components is not None:
            values = values @ self.components
        return np.asarray(self.center + self.unit * values)

    def variance(self, z: Floats) -> Floats:
        """Return predictive variances at points, (k, d) -> (k, m), in squared units of outputs."""
        variances = np.empty((len(z), self.n_surfaces))
        for columns, surface in self.parts:
            variances[:, columns] = surface.variance(z)
        if self.components is not None:
            variances = variances @ self.components**2
        return np.asarray(self.unit**2 * variances)

    @property
    def n_surfaces(self) -> int:
        """The number of outputs, or of principal components."""
        return len(self.center) if self.components is None else len(self.components)

    def lengths_of(self, k: int) -> Floats | None:
        """Return the lengths of a Gaussian process of a component or output, (d,)."""
        for columns, surface in self.parts:
            if k in columns and surface.kernel != "quintic":
                return surface.lengths
        return None


# Runs for the likelihood of lengths, whose time grows with the cube of their number.
MOST_TUNED = 256
# Runs of a surface; the others only test it.
MOST_RUNS = 2000
# Outputs with a surface each; more have principal components.
MOST_OUTPUTS = 6


@one_thread()
def fit_emulator(
    z: Floats,
    y: Floats,
    near: Floats | NDArray[np.bool_] | None = None,
    *,
    tried: tuple[str, ...] = CANDIDATES,
    start: Emulator | None = None,
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
    tried : tuple of str
        Kernels of the surfaces that compete.
    start : Emulator, optional
        An emulator through earlier runs, whose lengths are a start of the search.

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
    weights = np.ones(n) if near is None else np.asarray(near, dtype=float)
    weights = weights / weights.sum() if weights.sum() > 0 else np.full(n, 1 / n)
    center, unit = y.mean(axis=0), y.std(axis=0)
    largest = np.abs(y).max(axis=0)
    is_constant = unit <= 1e-14 * largest
    center, unit = np.where(is_constant, y[0], center), np.where(is_constant, 1.0, unit)
    scaled = np.where(is_constant, 0.0, (y - center) / unit)
    rows = spread_rows(weights, MOST_RUNS)
    # Surfaces of outputs, or of principal components as long as they matter.
    components, scores = None, scaled
    if y.shape[1] > MOST_OUTPUTS:
        u, sizes, components = np.linalg.svd(scaled, full_matrices=False)
        scores = u * sizes
    fits = Competition(z[rows], scores[rows], weights[rows] / weights[rows].sum(), tried, start)
    surfaces: list[Kriging] = []
    left_out, rest = np.zeros_like(y), scaled
    for k in range(scores.shape[1]):
        surfaces.append(fits.best(k))
        if components is None:
            continue
        rest = rest - scores[:, k, None] * components[k]
        left_out[rows] += surfaces[-1].left_out * components[k]
        error = np.sqrt(weights @ left_out**2)
        if (np.sqrt((rest**2).mean(axis=0)) <= np.maximum(1e-6, 0.03 * error)).all():
            break
    if components is None:
        left_out[rows] = np.concatenate([s.left_out for s in surfaces], axis=1)
    else:
        components = components[: len(surfaces)]
        left_out += rest
    emulator = Emulator(z, unit * left_out, center, unit, components, fits.grouped(surfaces))
    if len(rows) < n:
        tested = np.setdiff1d(np.arange(n), rows)
        emulator.left_out[tested] = y[tested] - emulator.values(z[tested])
    return emulator


def spread_rows(weights: Floats, most: int) -> NDArray[np.intp]:
    """Return at most so many runs: half are those of the largest weights, others are spread."""
    n = len(weights)
    if n <= most:
        return np.arange(n)
    order = np.argsort(-weights, kind="stable")
    n_important = min(most // 2, int((weights > weights.mean()).sum()))
    spread = np.linspace(n_important, n - 1, most - n_important).astype(int)
    # In the order of the runs, so that those of equal weights are spread over a sequence.
    rest = np.sort(order[n_important:])[spread - n_important]
    return np.sort(np.concatenate([order[:n_important], rest]))


class Competition:
    """Surfaces of several kernels through the same runs."""

    def __init__(
        self,
        z: Floats,
        scores: Floats,
        weights: Floats,
        tried: tuple[str, ...],
        start: Emulator | None,
    ) -> None:
        n, d = z.shape
        self.z, self.scores, self.weights, self.tried, self.start = z, scores, weights, tried, start
        spread = z.std(axis=0)
        self.spread = np.where(spread > 0, spread, 1.0)
        self.x = (z - z.mean(axis=0)) / self.spread
        self.units = np.sqrt((scores**2).mean(axis=0))
        self.units[self.units == 0] = 1.0
        self.tuning = spread_rows(weights, MOST_TUNED)
        linear = n >= 2 * (d + 1) and orthonormal(Polynomials.of(z, 1)(z)) is not None
        self.degree = 1 if linear else 0
        terms = Polynomials.of(z[self.tuning], self.degree)(z[self.tuning])
        self.basis = np.linalg.qr(terms.T)[0]
        self.quintic = self._quintic() if "quintic" in tried else None

    def _quintic(self) -> Kriging | None:
        """Return the quintic radial basis functions of all outputs, or None."""
        n, d = self.z.shape
        if n <= comb(d + 2, 2) or n > 1024:
            return None
        # Polynomials with at most a third as many terms as runs.
        degrees = [2, *(p for p in range(3, 17) if 3 * comb(d + p, d) <= n)]
        nuggets = [1e-16, 1e-14, 1e-12, 1e-10, 1e-8]
        if n > MOST_TUNED:  # what fewer runs determine, they select
            rows = self.tuning
            fewer = [p for p in degrees if 3 * comb(d + p, d) <= len(rows) or p == 2]
            weights = self.weights[rows] / self.weights[rows].sum()
            y = self.scores[rows] / self.units
            quick = fit_kriging(self.z[rows], y, weights, "quintic", self.spread, fewer, nuggets)
            selected = [] if quick is None else quick.degrees.tolist()
            degrees = sorted({*selected, *(set(degrees) - set(fewer))}) or [2]
        y = self.scores / self.units
        return fit_kriging(self.z, y, self.weights, "quintic", self.spread, degrees, nuggets)

    def best(self, k: int) -> Kriging:
        """Return the surface of an output with the smallest left-out error."""
        y = self.scores[:, k, None] / self.units[k]
        surfaces = []
        if self.quintic is not None:
            surfaces.append(self.quintic.selected(np.array([k])))
        surfaces += [
            surface
            for kernel in self.tried
            if kernel != "quintic" and (surface := self._process(kernel, k, y)) is not None
        ]
        if not surfaces:
            n, d = self.z.shape
            raise np.linalg.LinAlgError(
                f"interpolation: got {n} points that determine no surface of {d} inputs"
            )
        best = min(surfaces, key=lambda surface: float(surface.errors[0]))
        return scaled_surface(best, float(self.units[k]))

    def _process(self, kernel: str, k: int, y: Floats) -> Kriging | None:
        """Return a Gaussian process with the likeliest lengths."""
        d = self.z.shape[1]
        y_tuning = y[self.tuning, 0]
        contrasts = y_tuning - self.basis @ (self.basis.T @ y_tuning)
        lengths, nugget = np.full(d, 2 * np.sqrt(d)), 1e-10
        if np.sqrt((contrasts**2).mean()) > 1e-12 * np.abs(y).max():
            before = None if self.start is None else self.start.lengths_of(k)
            start = None if before is None else np.log([*(before / self.spread), 1e-7])
            *logs, log_nugget = likeliest(kernel, self.x[self.tuning], y_tuning, self.basis, start)
            lengths, nugget = np.exp(logs), float(np.exp(log_nugget))
        nuggets = sorted({1e-13, 1e-11, 1e-9, nugget}) if len(y) <= 500 else [1e-10, nugget]
        return fit_kriging(
            self.z, y, self.weights, kernel, lengths * self.spread, [self.degree], nuggets
        )

    def grouped(self, surfaces: list[Kriging]) -> tuple[tuple[NDArray[np.intp], Kriging], ...]:
        """Return surfaces with the outputs that they have; the quintic ones are one."""
        is_quintic = np.array([s.kernel == "quintic" for s in surfaces])
        parts = [(np.array([k]), s) for k, s in enumerate(surfaces) if not is_quintic[k]]
        if is_quintic.any():
            assert self.quintic is not None
            columns = np.flatnonzero(is_quintic)
            joint = self.quintic.selected(columns)
            parts.append((columns, scaled_surface(joint, self.units[columns])))
        return tuple(parts)


def scaled_surface(surface: Kriging, unit: Floats | float) -> Kriging:
    """Return a surface of outputs in another unit."""
    from dataclasses import replace

    return replace(
        surface,
        weights=surface.weights * unit,
        coefficients=surface.coefficients * unit,
        left_out=surface.left_out * unit,
        errors=surface.errors * unit,
        scales=surface.scales * np.square(unit),
    )
