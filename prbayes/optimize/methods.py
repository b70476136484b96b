"""Minimisers of scipy, and their options for a standardised problem."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

# Scipy's minimisers that need no Hessian.
_GRADIENT_FREE = ("Nelder-Mead", "Powell", "COBYLA", "COBYQA")
_WITH_GRADIENT = ("BFGS", "CG", "L-BFGS-B", "Newton-CG", "SLSQP", "TNC", "trust-constr")


@dataclass(frozen=True)
class Method:
    """A minimiser of `scipy.optimize.minimize` with its options.

    Parameters
    ----------
    method : str or callable
        Scipy's name of a method that needs no Hessian, or a function that
        `scipy.optimize.minimize` accepts: ``method(fun, x0, args, jac=..., callback=...,
        **options) -> OptimizeResult``.
    options : mapping
        For scipy's ``options=``, in units of the standardised problem; they replace those of
        `settings`.

    Raises
    ------
    ValueError, TypeError
        If there is no such method or option.

    References
    ----------
    .. [1] Nocedal, J. and S. J. Wright (2006), Numerical Optimization,
           doi:10.1007/978-0-387-40065-5.

    Examples
    --------
    >>> Method("L-BFGS-B", {"maxcor": 5})
    Method(method='L-BFGS-B', options={'maxcor': 5})
    """

    method: str | Callable[..., Any] = "BFGS"
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = (*_WITH_GRADIENT, *_GRADIENT_FREE)
        if isinstance(self.method, str):
            if self.method.lower() not in {name.lower() for name in names}:
                raise ValueError(
                    f"method: got {self.method!r}, expected one of {', '.join(names)}, or a "
                    "function that scipy.optimize.minimize takes as its method"
                )
        elif not callable(self.method) or isinstance(self.method, type):
            raise TypeError(
                f"method: got {self.method!r:.60}, expected the name of a scipy method, or a "
                "function that scipy.optimize.minimize takes as its method"
            )
        if not isinstance(self.options, Mapping):
            raise TypeError(
                f"options: got {type(self.options).__name__}, expected a mapping of names to values"
            )
        if isinstance(self.method, str) and self.options:
            self._refuse_unknown_options(self.method)

    def _refuse_unknown_options(self, method: str) -> None:
        """Raise for options that scipy's method does not have, of which it only warns."""
        if not all(isinstance(name, str) for name in self.options):
            raise TypeError(f"options: got {list(self.options)} as names, expected texts")
        # Takes longer to import than the whole package.
        from scipy.optimize import OptimizeWarning
        from scipy.optimize import minimize as scipy_minimize

        # Scipy checks names when it runs: here from the minimum of a parabola. Bad values raise
        # later, on the problem itself.
        options = {name: value for name, value in self.options.items() if name != "disp"}
        with warnings.catch_warnings(record=True) as caught, suppress(Exception):
            warnings.simplefilter("always")
            scipy_minimize(
                lambda x: (x @ x, 2 * x), np.zeros(2), method=method, jac=True, options=options
            )
        for warning in caught:
            if issubclass(warning.category, OptimizeWarning):
                raise ValueError(
                    f"options: got {dict(self.options)}, expected options of scipy's {method}; "
                    f"scipy says: {warning.message}"
                )

    @classmethod
    def of(
        cls, method: str | Callable[..., Any] | None, options: Mapping[str, Any] | None
    ) -> Method:
        """Return the method of the arguments of `minimize`."""
        return cls("BFGS" if method is None else method, {} if options is None else options)

    @property
    def name(self) -> str:
        """The name in messages."""
        if isinstance(self.method, str):
            return self.method
        return str(getattr(self.method, "__name__", repr(self.method)))

    @property
    def gradient(self) -> bool:
        """Whether the method uses gradients."""
        gradient_free = {name.lower() for name in _GRADIENT_FREE}
        return not isinstance(self.method, str) or self.method.lower() not in gradient_free

    def settings(self, tolerance: float, size: int) -> dict[str, Any]:
        """Return scipy's options for a standardised problem of ``size`` parameters.

        The objective limits evaluations, so iterations are unlimited.
        """
        most = 10**9  # never reached
        # First step of methods without gradient, in spreads of the prior: larger than most standard
        # errors, and within the prior.
        step = 0.2
        simplex = np.vstack([np.zeros(size), step * np.eye(size)])
        defaults: dict[str, dict[str, Any]] = {
            "bfgs": {"gtol": tolerance, "maxiter": most},
            "cg": {"gtol": tolerance, "maxiter": most},
            "l-bfgs-b": {"gtol": tolerance, "ftol": tolerance**2, "maxfun": most, "maxiter": most},
            "newton-cg": {"xtol": tolerance, "maxiter": most},
            "slsqp": {"ftol": tolerance**2, "maxiter": most},
            "tnc": {"gtol": tolerance, "ftol": tolerance**2, "xtol": 0.0, "maxfun": most},
            "trust-constr": {"gtol": tolerance, "xtol": tolerance**2, "maxiter": most},
            "nelder-mead": {
                "xatol": tolerance,
                "fatol": tolerance / 100,
                "initial_simplex": simplex,
                "maxfev": most,
                "maxiter": most,
            },
            "powell": {"xtol": tolerance, "ftol": tolerance**2, "maxfev": most, "maxiter": most},
            "cobyla": {"tol": tolerance, "rhobeg": step, "maxiter": most},
            "cobyqa": {
                "final_tr_radius": tolerance,
                "initial_tr_radius": step,
                "maxfev": most,
                "maxiter": most,
            },
        }
        name = self.method.lower() if isinstance(self.method, str) else ""
        return {**defaults.get(name, {}), **self.options}
