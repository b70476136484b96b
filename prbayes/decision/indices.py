"""Sobol' indices and the derivative-based ones beside them, from values at matched points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._validate import Floats

# Sets of points, each scrambled by itself, whose spread tells the error: known to 18%.
REPLICATES = 16


@dataclass(frozen=True, eq=False)
class Indices:
    """Shares of a variance by factor, with standard errors: arrays of shape (d,)."""

    first: Floats
    total: Floats
    derivative: Floats
    first_error: Floats
    total_error: Floats
    derivative_error: Floats

    @classmethod
    def of(cls, first: Floats, total: Floats, derivative: Floats) -> Indices:
        """Return means over replicates, (r, d), and their errors."""
        means = [np.mean(each, axis=0) for each in (first, total, derivative)]
        errors = [np.std(each, axis=0, ddof=1) for each in (first, total, derivative)]
        root = np.sqrt(len(first))
        return cls(*means, *(error / root for error in errors))


def first_order(values: Floats, same: Floats) -> Floats:
    r"""Return the share of the variance that a factor explains by itself.

    .. math:: S_i = Var(E[Y | X_i]) / Var(Y) = Corr(Y, Y')

    Parameters
    ----------
    values, same : ndarray, shape (r, n)
        At points, and at others of the same value of that factor only. Those where one of the two
        is NaN are left out.

    Returns
    -------
    ndarray, shape (r,)

    References
    ----------
    .. [1] Janon, A., T. Klein, A. Lagnoux, M. Nodet and C. Prieur (2014), Asymptotic normality and
       efficiency of two Sobol index estimators, ESAIM: Probab. Stat. 18, 342-364,
       doi:10.1051/ps/2013040 (equation 6).
    """
    values, same = _both_known(values, same)
    mean = np.nanmean(values + same, axis=1, keepdims=True) / 2
    away = values - mean
    away_too = same - mean
    covariance = np.nanmean(away * away_too, axis=1)
    variance = np.nanmean(away**2 + away_too**2, axis=1) / 2
    return _share(covariance, variance)


def total_order(values: Floats, other: Floats) -> Floats:
    r"""Return the share of the variance that is left when all other factors are known.

    .. math:: T_i = E[Var(Y | X_{-i})] / Var(Y) = E[(Y - Y')^2] / (2 Var(Y))

    Parameters
    ----------
    values, other : ndarray, shape (r, n)
        At points, and at others where that factor alone has another value, given all others.

    Returns
    -------
    ndarray, shape (r,)

    References
    ----------
    .. [1] Jansen, M. J. W. (1999), Analysis of variance designs for model output, Comput. Phys.
       Commun. 117, 35-43, doi:10.1016/S0010-4655(98)00154-4.
    .. [2] Kucherenko, S., S. Tarantola and P. Annoni (2012), Estimation of global sensitivity
       indices for models with dependent variables, Comput. Phys. Commun. 183, 937-946,
       doi:10.1016/j.cpc.2011.12.020.
    """
    values, other = _both_known(values, other)
    apart = np.nanmean((values - other) ** 2, axis=1) / 2
    variance = (np.nanvar(values, axis=1) + np.nanvar(other, axis=1)) / 2
    return _share(apart, variance)


def derivative_bound(squares: Floats, values: Floats) -> Floats:
    r"""Return a bound of the total index from derivatives by a standard normal factor.

    .. math:: T_i <= E[(dY / dz_i)^2] / Var(Y)

    This is Poincaré's inequality, in which equality holds where Y is linear in z.

    Parameters
    ----------
    squares : ndarray, shape (r, n)
        Of the derivatives.
    values : ndarray, shape (r, n)

    Returns
    -------
    ndarray, shape (r,)

    References
    ----------
    .. [1] Sobol', I. M. and S. Kucherenko (2009), Derivative based global sensitivity measures and
       their link with global sensitivity indices, Math. Comput. Simul. 79, 3009-3017,
       doi:10.1016/j.matcom.2009.01.023.
    """
    return _share(np.nanmean(squares, axis=1), np.nanvar(values, axis=1))


def _both_known(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Return two arrays, NaN where one of them is."""
    known = np.isfinite(a) & np.isfinite(b)
    return np.where(known, a, np.nan), np.where(known, b, np.nan)


def _share(part: Floats, variance: Floats) -> Floats:
    """Return part over variance; NaN where nothing varies."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(variance > 0, part / variance, np.nan)
