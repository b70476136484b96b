"""What to do when a response raises, or is not a number."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from prbayes._checks import positive_integer


class OnFailure:
    """What to do with a point whose response raises or is NaN; see `Abort`, `Replace`, `Retry`."""


@dataclass(frozen=True)
class Abort(OnFailure):
    """Stop when a response raises, and, if asked for, when one is NaN; what was computed stays in the store.

    Parameters
    ----------
    on_nan : bool
        By default NaN is a result: a point that could not be computed keeps its weight, which is reported as
        lost mass.

    Examples
    --------
    >>> Abort(on_nan=True)
    Abort(on_nan=True)
    """

    on_nan: bool = False


@dataclass(frozen=True)
class Replace(OnFailure):
    """Go on with a value in place of a response that raises or is NaN.

    Parameters
    ----------
    value : float
        NaN (lost mass), +inf (the specimen failed), or a number in units of the response.

    Raises
    ------
    TypeError
        If the value is not a number.

    Examples
    --------
    >>> Replace(float("inf"))
    Replace(value=inf)
    """

    value: float = np.nan

    def __post_init__(self) -> None:
        if isinstance(self.value, bool) or not isinstance(self.value, int | float | np.floating):
            raise TypeError(f"Replace: value: got {type(self.value).__name__} {self.value!r:.60}, expected a number")


@dataclass(frozen=True)
class Retry(OnFailure):
    """Compute a response that raises or is NaN again, and then do something else.

    Parameters
    ----------
    times : int
    then : OnFailure
        `Abort` or `Replace`.

    Raises
    ------
    TypeError, ValueError
        If ``times`` is not a positive integer, or ``then`` is no policy or another `Retry`.

    Examples
    --------
    >>> Retry(2, then=Replace())
    Retry(times=2, then=Replace(value=nan))
    """

    times: int = 1
    then: OnFailure = field(default_factory=Replace)

    def __post_init__(self) -> None:
        positive_integer(self.times, "Retry: times")
        if not isinstance(self.then, Abort | Replace):
            raise TypeError(f"Retry: then: got {type(self.then).__name__}, expected prb.Abort() or prb.Replace()")
