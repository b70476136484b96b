"""Response surfaces: radial basis functions, polynomials, regressors of users, two fidelities.

A surface of two fidelities is a multiple of a coarse response, and a surface through the remainder.

References
----------
.. [1] Kennedy, M. C. and A. O'Hagan (2000), Predicting the output from a complex computer code when
   fast approximations are available, Biometrika 87, doi:10.1093/biomet/87.1.1.
.. [2] Perdikaris, P. et al. (2017), Nonlinear information fusion algorithms for data-efficient
   multi-fidelity modelling, Proc. R. Soc. A 473, doi:10.1098/rspa.2016.0751.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import partial
from itertools import product
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats, positive_integer

# The lowest degree with which a kernel is conditionally positive definite, and the interpolant
# unique: Wendland (2005), Scattered Data Approximation, ch. 8.
_LOWEST_DEGREE = {"linear": 0, "thin_plate_spline": 1, "cubic": 1, "quintic": 2}

Predict = Callable[[Floats], Floats]


class Surface(ABC):
    """A kind of response surface: `RadialBasis`, `Polynomial`, or one of your own.

    A surface of your own derives from it and defines ``terms`` and ``through``.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> from prbayes.surrogate import Surface
    >>> class Constant(Surface):
    ...     def terms(self, dimensions):
    ...         return 1
    ...
    ...     def through(self, x, y):
    ...         return lambda at: np.full(len(at), y.mean())
    >>> prb.Surrogate.fit(lambda x: 0 * x + 3, {"x": (0, 1)}, 8, model=Constant())(0.5)
    array(3.)
    """

    @abstractmethod
    def terms(self, dimensions: int) -> int:
        """Return the least number of points for inputs of so many dimensions."""

    @abstractmethod
    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the surface through points, or the least-squares surface.

        Parameters
        ----------
        x : ndarray, shape (n, d)
            In the unit cube.
        y : ndarray, shape (n,)
            Responses, of mean 0 and standard deviation 1.

        Returns
        -------
        callable
            From points, shape (k, d), to values, shape (k,).
        """

    def tuned(self, x: Floats, y: Floats) -> Surface:
        """Return the surface with settings that are estimated from the points."""
        return self

    def slope(self, x: Floats, y: Floats, along: Floats) -> float:
        """Return the slope of responses along another one, of spread 1, beside such a surface."""
        return least_squares(x, y, along)

    def without_each(self, x: Floats, y: Floats, lacking: NDArray[np.bool_]) -> Predict | None:
        """Return surfaces that each lack some of the points; None without a short way to them.

        Parameters
        ----------
        x : ndarray, shape (n, d)
        y : ndarray, shape (n,)
            In any unit.
        lacking : ndarray of bool, shape (B, n)

        Returns
        -------
        callable or None
            From points, shape (k, d), to values, shape (k, B).
        """
        return None


@dataclass(frozen=True)
class RadialBasis(Surface):
    """Radial basis functions with a polynomial, which pass through all points.

    Parameters
    ----------
    kernel : str
        Of `scipy.interpolate.RBFInterpolator`: linear, thin_plate_spline, cubic or quintic, which
        need no scale.
    degree : int, optional
        Of the polynomial; by default the lowest that the kernel needs.
    smoothing : float
        0 passes through the points; more smooths a response that is noisy.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Examples
    --------
    >>> RadialBasis(kernel="thin_plate_spline")
    RadialBasis(kernel='thin_plate_spline', degree=None, smoothing=0.0)
    """

    kernel: str = "cubic"
    _: KW_ONLY
    degree: int | None = None
    smoothing: float = 0.0

    def __post_init__(self) -> None:
        if self.kernel not in _LOWEST_DEGREE:
            kernels = list(_LOWEST_DEGREE)
            raise ValueError(f"RadialBasis: kernel: got {self.kernel!r}, expected one of {kernels}")
        if self.degree is not None:
            lowest = _LOWEST_DEGREE[self.kernel]
            positive_integer(self.degree, "RadialBasis: degree", minimum=lowest)
        is_number = isinstance(self.smoothing, int | float) and self.smoothing is not True
        if not is_number or not 0 <= self.smoothing < np.inf:
            raise ValueError(
                f"RadialBasis: smoothing: got {self.smoothing!r}, expected a number >= 0"
            )

    def terms(self, dimensions: int) -> int:
        """Return the number of terms of the polynomial."""
        return comb(dimensions + self._degree, self._degree)

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the interpolant."""
        from scipy.interpolate import RBFInterpolator as Interpolator  # takes long to import

        surface: Predict = Interpolator(
            x, y, smoothing=self.smoothing, kernel=self.kernel, degree=self._degree
        )
        return surface

    @property
    def _degree(self) -> int:
        return _LOWEST_DEGREE[self.kernel] if self.degree is None else self.degree


@dataclass(frozen=True)
class Polynomial(Surface):
    """A polynomial in all inputs, by least squares.

    Parameters
    ----------
    degree : int
        Total degree: 2 has squares and products of two inputs.

    Raises
    ------
    TypeError, ValueError
        If the degree is not a positive integer.

    Examples
    --------
    >>> Polynomial(degree=3).terms(2)
    10
    """

    degree: int = 2

    def __post_init__(self) -> None:
        positive_integer(self.degree, "Polynomial: degree")

    def terms(self, dimensions: int) -> int:
        """Return the number of coefficients."""
        return comb(dimensions + self.degree, self.degree)

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the polynomial of least squares."""
        coefficients = np.linalg.lstsq(self.basis(x), y, rcond=None)[0]
        return partial(self._values, coefficients)

    def _values(self, coefficients: Floats, at: Floats) -> Floats:
        """Return the polynomial with given coefficients at points."""
        values = np.empty(len(at))
        step = 4096  # the terms of so many points stay in the cache
        for start in range(0, len(at), step):
            rows = slice(start, start + step)
            values[rows] = self.basis(at[rows]) @ coefficients
        return values

    def basis(self, x: Floats) -> Floats:
        """Return products of Legendre polynomials at points of the unit cube, shape (n, terms)."""
        # Points last, so that the factors are contiguous: (d, degree + 1, n).
        single = np.polynomial.legendre.legvander(2 * x - 1, self.degree)
        single = np.ascontiguousarray(np.moveaxis(single, 0, -1))
        powers = product(range(self.degree + 1), repeat=x.shape[1])
        powers_of_terms = [p for p in powers if sum(p) <= self.degree]
        terms = np.ones((len(powers_of_terms), len(x)))
        for term, powers_of_term in zip(terms, powers_of_terms, strict=True):
            for polynomials, k in zip(single, powers_of_term, strict=True):
                if k:  # the polynomial of degree zero is one
                    term *= polynomials[k]
        return terms.T


def least_squares(x: Floats, y: Floats, along: Floats) -> float:
    """Return the slope of responses along another one, beside a plane."""
    columns = np.column_stack([np.ones(len(x)), x, along])
    return float(np.linalg.lstsq(columns, y, rcond=None)[0][-1])


def fitted(model: Any, x: Floats, y: Floats) -> Predict:
    """Return a surface, or a copy of a regressor, fitted to responses of unit spread.

    From points (n, d), in the unit cube or in units of their spread, and responses (n,) in any
    unit, to a function from points (k, d) to responses (k,).
    """
    center = y.mean()
    spread = y.std() or 1.0  # one for a constant response
    z = (y - center) / spread
    if isinstance(model, Surface):
        return partial(_in_units, model.through(x, z), center, spread)
    regressor = copy.deepcopy(model)
    regressor.fit(x, z)
    return partial(_in_units, regressor.predict, center, spread)


def _in_units(surface: Predict, center: float, spread: float, at: Floats) -> Floats:
    """Return a surface through responses of unit spread, in units of the response."""
    values = np.asarray(surface(at), dtype=np.float64)
    # Some regressors return a column.
    return np.asarray(center + spread * values.reshape(len(at)))


@dataclass(frozen=True)
class MultifidelityModel:
    """The model of an output that follows a coarse response."""

    model: Any  # of the remainder beside the coarse response
    otherwise: Any  # of the response itself, where there is no coarse one
    joined: bool  # whether the coarse response is also an input of the remainder


@dataclass(frozen=True, eq=False)
class MultifidelitySurface:
    """A response as rho times a coarse one and a surface, which can be pickled."""

    rho: float
    scaling: tuple[float, float] | None  # center and unit of a coarse response that is an input
    rest: Predict  # surface of the remainder
    otherwise: Predict | None  # surface of the response itself, where there is no coarse one

    def __call__(self, at: Floats, coarse: Floats) -> Floats:
        """Return responses, (k,), at points, (k, d), given the coarse ones."""
        follows = np.isfinite(coarse)
        values = np.empty(len(at))
        points, following = at[follows], coarse[follows]
        rest = self.rest(_points(points, following, self.scaling))
        values[follows] = self.rho * following + rest
        if self.otherwise is not None and not follows.all():
            values[~follows] = self.otherwise(at[~follows])
        return values


def fit_multifidelity(
    model: MultifidelityModel, x: Floats, y: Floats, coarse: Floats, *, all_follow: bool = False
) -> MultifidelitySurface:
    """Return a response (n,) at points (n, d) as a multiple of a coarse one, and a surface.

    Coarse responses that are not finite are left out. The surface without the coarse response is
    not fitted if ``all_follow``.
    """
    follows = np.isfinite(coarse)
    inputs, outputs, coarse = x[follows], y[follows], coarse[follows]
    scaling = _scaling(inputs, coarse) if model.joined else None
    points = _points(inputs, coarse, scaling)
    rho = _rho(model.model, points, outputs, coarse)
    rest = fitted(model.model, points, outputs - rho * coarse)
    return MultifidelitySurface(
        rho, scaling, rest, None if all_follow else fitted(model.otherwise, x, y)
    )


def tuned_for_remainder(model: Any, x: Floats, y: Floats, coarse: Floats, *, joined: bool) -> Any:
    """Return a model of a response with settings for the remainder beside a coarse one."""
    if not isinstance(model, Surface):
        return model
    points = _points(x, coarse, _scaling(x, coarse) if joined else None)
    # Settings for the response estimate rho from changes over short distances; a model with another
    # input has no settings yet.
    rest = y - _rho(None if joined else model, points, y, coarse) * coarse
    return model.tuned(points, (rest - rest.mean()) / (rest.std() or 1.0))


def predict(
    model: Any,
    x: Floats,
    y: Floats,
    at: Floats,
    coarse: Floats | None = None,
    coarse_at: Floats | None = None,
) -> Floats:
    """Return predictions at points, (k,), of a surface through runs (n, d), (n,).

    A `MultifidelityModel` needs the coarse response at the runs, (n,), and the points, (k,), which
    is not finite where there is none.
    """
    if not isinstance(model, MultifidelityModel):
        return fitted(model, x, y)(at)
    assert coarse is not None
    assert coarse_at is not None
    all_follow = bool(np.isfinite(coarse_at).all())
    return fit_multifidelity(model, x, y, coarse, all_follow=all_follow)(at, coarse_at)


def _rho(model: Any, x: Floats, y: Floats, coarse: Floats) -> float:
    """Return the factor of a coarse response in another one."""
    slope = model.slope if isinstance(model, Surface) else least_squares
    spread = coarse.std() or 1.0
    return float(slope(x, y, (coarse - coarse.mean()) / spread) / spread)


def _scaling(x: Floats, coarse: Floats) -> tuple[float, float]:
    """Return center and unit that give a coarse response the place and spread of the inputs."""
    spread = float(coarse.std() / x.std(axis=0).mean()) or 1.0
    return float(coarse.mean() - x.mean() * spread), spread


def _points(x: Floats, coarse: Floats, scaling: tuple[float, float] | None) -> Floats:
    """Return the inputs of a surface, with the coarse response if it is scaled."""
    if scaling is None:
        return x
    center, unit = scaling
    return np.column_stack([x, (coarse - center) / unit])
