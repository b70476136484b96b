"""Failure policies for responses that raise or are not a number."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from prbayes._validate import Floats, flag, positive_integer, wrong_value


class ResponseError(RuntimeError):
    """The user's response raised, or returned an invalid value."""


@dataclass(frozen=True, eq=False)
class Failure:
    """A point whose response failed."""

    inputs: Floats  # arguments of the response, one after the other, (columns,)
    reason: str


class OnFailure:
    """A policy for points whose response raises or is NaN; see `Abort`, `Replace`, `Retry`."""

    @property
    def tries(self) -> int:
        """Largest number of computations of a point."""
        return 1

    @property
    def final(self) -> OnFailure:
        """The policy after the last try."""
        return self


@dataclass(frozen=True)
class Abort(OnFailure):
    """Stop when a response raises, and optionally when one is NaN.

    Computed responses stay in the store.

    Parameters
    ----------
    on_nan : bool
        By default NaN is a result: a point that could not be computed keeps its weight, which is
        reported as lost mass.

    Raises
    ------
    TypeError
        If ``on_nan`` is not True or False.

    Examples
    --------
    >>> Abort(on_nan=True)
    Abort(on_nan=True)
    """

    on_nan: bool = False

    def __post_init__(self) -> None:
        flag(self.on_nan, "Abort: on_nan")


@dataclass(frozen=True)
class Replace(OnFailure):
    """Go on with a value in place of a response that raises or is NaN.

    Parameters
    ----------
    value : float
        NaN (lost mass), +inf (the specimen failed), or a number in units of the response.

    Raises
    ------
    TypeError, ValueError
        If the value is not a number, or is -inf.

    Examples
    --------
    >>> Replace(float("inf"))
    Replace(value=inf)
    """

    value: float = np.nan

    def __post_init__(self) -> None:
        number = isinstance(self.value, int | float | np.number)
        if isinstance(self.value, bool | complex) or not number:
            raise wrong_value(self.value, "Replace: value", "a number")
        if np.isneginf(self.value):
            raise ValueError(
                "Replace: value: got -inf, expected a number, NaN (no response) or +inf (the "
                "specimen failed); for specimens that fail at the low end calibrate minus the "
                "response against minus the data, with +inf"
            )


@dataclass(frozen=True)
class Retry(OnFailure):
    """Compute a response that raises or is NaN again, and then do something else.

    Parameters
    ----------
    retries : int
        Number of further tries.
    then : OnFailure
        `Abort` or `Replace`.

    Raises
    ------
    TypeError, ValueError
        If ``retries`` is not a positive integer, or ``then`` is no policy or another `Retry`.

    Examples
    --------
    >>> Retry(2, then=Replace())
    Retry(retries=2, then=Replace(value=nan))
    """

    retries: int = 1
    _: KW_ONLY
    then: OnFailure = Replace()

    def __post_init__(self) -> None:
        positive_integer(self.retries, "Retry: retries")
        if not isinstance(self.then, OnFailure) or self.then.final is not self.then:
            got = type(self.then).__name__
            raise TypeError(
                f"Retry: then: got {got}, expected prb.response.Abort() or prb.response.Replace()"
            )

    @property
    def tries(self) -> int:
        """One try more than ``retries``."""
        return 1 + self.retries

    @property
    def final(self) -> OnFailure:
        """The policy ``then``."""
        return self.then
