"""A Gaussian process with a length for each input, and a nugget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
from math import comb
from typing import Any

import numpy as np

from prbayes._validate import Floats, positive_integer, positive_number
from prbayes.emulators.kriging import (
    MOST_TUNED,
    Kriging,
    Polynomials,
    determine,
    fit_kriging,
    likeliest,
    spread_of,
    spread_rows,
)
from prbayes.emulators.surfaces import Following, KernelSurface, Surface

_KERNELS = ["squared_exponential", "matern"]


@dataclass(frozen=True)
class GaussianProcess(KernelSurface):
    """A Gaussian process around a polynomial, with a length for each input and a nugget.

    Lengths and nugget maximise the likelihood, profiled over the variance and the polynomial. A
    polynomial needs twice as many points as it has coefficients.

    Parameters
    ----------
    kernel : str
        "squared_exponential", for responses without corners, or "matern", of smoothness 5/2.
    lengths : tuple of float, optional
        In the units of the points; estimated by default.
    nugget : float, optional
        Variance of the part that does not depend on the inputs, in that of the response. By default
        the likeliest one, or a smaller one if left-out errors are smaller with it.
    degree : int
        Highest degree of the polynomial, by default that of a plane. A degree above one is taken if
        it makes left-out errors smaller by a tenth.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, or only one of lengths and nugget is given.

    References
    ----------
    .. [1] Rasmussen, C. E. and C. K. I. Williams (2006), Gaussian Processes for Machine Learning,
       MIT Press, ch. 5.

    Examples
    --------
    >>> GaussianProcess("matern").terms(3)
    2
    """

    kernel: str = "squared_exponential"
    _: KW_ONLY
    lengths: tuple[float, ...] | None = None
    nugget: float | None = None
    degree: int = 1

    def __post_init__(self) -> None:
        if self.kernel not in _KERNELS:
            raise ValueError(
                f"GaussianProcess: kernel: got {self.kernel!r}, expected one of {_KERNELS}"
            )
        positive_integer(self.degree, "GaussianProcess: degree", minimum=1)
        if (self.lengths is None) != (self.nugget is None):
            raise ValueError(
                f"GaussianProcess: got lengths {self.lengths} and nugget {self.nugget}, expected "
                "both or neither; leave both out to estimate them"
            )
        if self.lengths is None:
            return
        for length in self.lengths:
            positive_number(length, "GaussianProcess: lengths")
        if self.nugget != 0:
            positive_number(self.nugget, "GaussianProcess: nugget")

    def terms(self, dimensions: int) -> int:
        """Return the least number of points."""
        return 2

    def following(self) -> Sequence[Surface]:
        """Return the same: with its plane it follows an input that has a great length."""
        return (self,) if self.lengths is None else (Following(self),)

    def fit(
        self, z: Floats, y: Floats, weights: Floats, start: Any = None, random_seed: int = 0
    ) -> Kriging | None:
        """Return the process given the runs; None if its matrix is singular."""
        n, d = z.shape
        if self.lengths is not None and len(self.lengths) != d:
            raise ValueError(
                f"GaussianProcess: lengths: got {len(self.lengths)}, expected one for each of "
                f"{d} inputs"
            )
        possible = [
            p
            for p in range(1, self.degree + 1)
            if n >= 2 * comb(d + p, p) and determine(Polynomials.of(z, p)(z))
        ]
        degrees = possible or [0]
        fit = partial(fit_kriging, z, y, weights, self.kernel)
        if self.lengths is not None and self.nugget is not None:
            # If the matrix is singular with the given nugget, larger ones are tried.
            nuggets = [self.nugget, *(x for x in (1e-13, 1e-11, 1e-9) if x > self.nugget)]
            lengths = np.array(self.lengths)
            fits = (fit(lengths, degrees, [nugget]) for nugget in nuggets)
            return next((surface for surface in fits if surface is not None), None)
        rows, spread = spread_rows(weights, MOST_TUNED), spread_of(z)
        x = (z[rows] - z.mean(axis=0)) / spread
        first = None
        if getattr(start, "kernel", "") == self.kernel:
            first = np.log([*(start.lengths / spread), 1e-7])
        numerical = [1e-13, 1e-11, 1e-9] if n <= 512 else [1e-10]
        best = None
        for degree in degrees:
            terms = Polynomials.of(z[rows], degree)(z[rows])
            *scaled, nugget = np.exp(likeliest(self.kernel, x, y[rows], terms, first)).tolist()
            surface = fit(spread * scaled, [degree], sorted({*numerical, nugget}))
            if surface is not None and (best is None or surface.error < 0.9 * best.error):
                best = surface
        return best
