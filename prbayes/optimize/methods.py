"""`Method`: which minimiser of scipy runs, and with which options."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

# Names of scipy's minimisers that need no Hessian.
_GRADIENT_FREE = ("Nelder-Mead", "Powell", "COBYLA", "COBYQA")
_WITH_GRADIENT = ("BFGS", "CG", "L-BFGS-B", "Newton-CG", "SLSQP", "TNC", "trust-constr")
# First step of methods without gradient, in spreads of the prior: larger than the standard errors
# of most problems, and within the prior. Half or twice changes no answer (docs/constants.md).
_FIRST_STEP = 0.2


@dataclass(frozen=True)
class Method:
    """A minimiser of `scipy.optimize.minimize`, with options of its own.

    Parameters
    ----------
    method : str or callable
        Scipy's name of a method that needs no Hessian, or a function as `scipy.optimize.minimize`
        takes it: ``method(fun, x0, args, jac=..., callback=..., **options) -> OptimizeResult``. It
        works on standardised parameters, that start at zero; ``jac`` is None under `Fresh`.
    options : mapping
        For scipy's ``options=``, in units of the standardised problem; they replace those that
        `minimize` would set.

    Raises
    ------
    ValueError, TypeError
        If there is no such method, or the options are no mapping.

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
        known = (*_WITH_GRADIENT, *_GRADIENT_FREE)
        if isinstance(self.method, str):
            if self.method.lower() not in {name.lower() for name in known}:
                raise ValueError(
                    f"method: got {self.method!r}, expected one of {', '.join(known)}, or a "
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
        self._refuse_unknown_options()

    def _refuse_unknown_options(self) -> None:
        """Raise if scipy's method does not know an option, which it would only warn of."""
        if not isinstance(self.method, str) or not self.options:
            return
        if not all(isinstance(name, str) for name in self.options):
            raise TypeError(f"options: got {list(self.options)} as names, expected texts")
        from scipy import optimize  # takes longer to import than the whole package

        # It knows its options only when it runs: here on a parabola, from its minimum.
        trial = {name: value for name, value in self.options.items() if name != "disp"}
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            # What is wrong with the value of an option, the user's problem tells.
            with suppress(Exception):
                optimize.minimize(
                    lambda x: (x @ x, 2 * x),
                    np.zeros(2),
                    method=self.method,
                    jac=True,
                    options=trial,
                )
        for found in caught:
            if issubclass(found.category, optimize.OptimizeWarning):
                raise ValueError(
                    f"options: got {dict(self.options)}, expected options of scipy's "
                    f"{self.method}; scipy says: {found.message}"
                )

    @classmethod
    def of(
        cls, method: str | Callable[..., Any] | None, options: Mapping[str, Any] | None
    ) -> Method:
        """Return what a user meant by ``method=`` and ``options=``."""
        return cls("BFGS" if method is None else method, {} if options is None else options)

    @property
    def name(self) -> str:
        """What messages call it."""
        if isinstance(self.method, str):
            return self.method
        return str(getattr(self.method, "__name__", repr(self.method)))

    @property
    def gradient(self) -> bool:
        """Whether the method is given gradients."""
        if not isinstance(self.method, str):
            return True
        return self.method.lower() not in {n.lower() for n in _GRADIENT_FREE}

    def settings(self, tolerance: float, size: int) -> dict[str, Any]:
        """Return scipy's options for a standardised problem.

        The budget of evaluations alone limits iterations.
        """
        most = 10**9  # never reached
        simplex = np.vstack([np.zeros(size), _FIRST_STEP * np.eye(size)])
        known: dict[str, dict[str, Any]] = {
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
            "cobyla": {"tol": tolerance, "rhobeg": _FIRST_STEP, "maxiter": most},
            "cobyqa": {
                "final_tr_radius": tolerance,
                "initial_tr_radius": _FIRST_STEP,
                "maxfev": most,
                "maxiter": most,
            },
        }
        name = self.method.lower() if isinstance(self.method, str) else ""
        return {**known.get(name, {}), **self.options}
