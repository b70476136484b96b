"""Coercion and checks of samples, weights and shapes.

Every message says what was got, what was expected, and what to do.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

# Numbers held at a time where work is done in parts: 32 MiB. It bounds memory; where the parts
# leave a trace in an answer, that place says so.
AT_ONCE = 1 << 22
# Numbers of arrays that stay in the cache of a processor: 2 MiB.
IN_CACHE = 1 << 18


def real_array(values: ArrayLike, name: str) -> Floats:
    """Return ``values`` as a float array, or raise a `TypeError` that says what was got.

    Parameters
    ----------
    values : array_like of real numbers
    name : str
        How the message calls the argument.
    """
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise TypeError(
            f"{name}: got a ragged sequence, expected a regular array of numbers"
        ) from error
    if array.dtype.kind == "c":
        raise TypeError(
            f"{name}: got complex numbers, expected real ones; pass the real part or the modulus"
        )
    if array.dtype.kind not in "fiu":
        array = _numbers_in_objects(values, array, name)
    return np.asarray(array, dtype=np.float64)


def _numbers_in_objects(values: object, array: NDArray[Any], name: str) -> Floats:
    """Return the numbers that an array of Python objects holds, or raise for any other array."""
    # NumPy would read numbers out of texts, and NaN out of None; in a list that is one missing.
    lone = array.ndim == 0 and values is None
    if array.dtype.kind == "O" and not lone and not any(map(_is_no_number, array.flat)):
        try:
            return array.astype(np.float64)
        except (TypeError, ValueError, OverflowError):
            pass
    got = _describe(values, array)
    raise TypeError(f"{name}: got {got}, expected real numbers")


def _is_no_number(value: object) -> bool:
    return isinstance(value, bool | np.bool_ | str | bytes)


def _describe(values: object, array: NDArray[Any]) -> str:
    """Return what was passed, in words for a message."""
    if array.ndim == 0:
        return called(values)
    return f"an array of dtype {array.dtype}"


def called(value: object) -> str:
    """Return what an argument is, for a message: on one line, also of an array or a table."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    words = repr(value).split()
    on_one_line = " ".join(words)
    return f"{type(value).__name__} {on_one_line:.60}"


def observed_sample(
    values: ArrayLike, name: str = "observed", *, minimum: int = 1, failures: bool = False
) -> Floats:
    """Check measured responses: one-dimensional, at least ``minimum`` of them, and finite.

    Parameters
    ----------
    values : array_like, shape (N,)
    name : str
    minimum : int
    failures : bool
        Whether specimens may have failed, +inf, besides the minimum.

    Returns
    -------
    ndarray, shape (N,)

    Raises
    ------
    TypeError
        If the values are not real numbers.
    ValueError
        If they are not one-dimensional, too few, or not finite.
    """
    if np.ma.is_masked(values):
        raise ValueError(f"{name}: got masked values, expected none; leave missing specimens out")
    array = real_array(values, name)
    if array.ndim != 1:
        raise ValueError(
            f"{name}: got an array of shape {array.shape}, expected one dimension, (N,); "
            "several outputs of a specimen, (N, m), take prb.Joint(metric), or one Simulator each"
        )
    failed = np.isposinf(array)
    bad = int((~np.isfinite(array)).sum() - (failed.sum() if failures else 0))
    if bad:
        what = ""
        if failures:
            what = ", and give those that had failed as +inf"
        elif failed.any():
            what = "; a specimen that failed, +inf, takes a metric that counts it"
        raise ValueError(
            f"{name}: got {bad} NaN or infinite among {array.size} values, expected finite ones; "
            f"leave missing specimens out{what}"
        )
    _refuse_huge(array, name)
    number = array.size - int(failed.sum())
    if number < minimum:
        few = {0: "no values", 1: "one value"}.get(number, f"{number} values")
        besides = f" besides {failed.sum()} of specimens that failed" if failed.any() else ""
        raise ValueError(
            f"{name}: got {few}{besides}, expected at least {minimum} measured responses"
        )
    return array


def observed_outputs(values: ArrayLike, name: str = "observed") -> Floats:
    """Check measured responses of several outputs: (N, m), no row and no column without a number.

    Parameters
    ----------
    values : array_like, shape (N, m)
        NaN, or a mask, is an output that was not measured; +inf a specimen that failed there.
    name : str

    Returns
    -------
    ndarray, shape (N, m)

    Raises
    ------
    TypeError
        If the values are not real numbers.
    ValueError
        If they have another shape, or an output or a specimen has no value, or no finite one.
    """
    masked = np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else None
    array = real_array(np.ma.getdata(values) if masked is not None else values, name)
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(
            f"{name}: got an array of shape {array.shape}, expected (N, m), a row for each "
            "specimen and a column for each output"
        )
    if masked is not None:
        array = np.where(masked, np.nan, array)
    if np.isneginf(array).any():
        raise ValueError(
            f"{name}: got -inf, expected numbers; NaN is an output that was not measured, +inf a "
            "specimen that failed"
        )
    _refuse_huge(array, name)
    missing = np.isnan(array)
    _refuse_empty(missing.all(axis=1), name, "specimens", "row", "without any output")
    _refuse_empty(missing.all(axis=0), name, "outputs", "column", "that no specimen has")
    without = ~np.isfinite(array).any(axis=0)
    _refuse_empty(without, name, "outputs", "column", "in which every specimen failed")
    return array


# Squares of measured values, and sums of them, are numbers up to here.
_HUGE = 1e152


def _refuse_huge(array: Floats, name: str) -> None:
    """Raise if values are so large that their squares are none: rather a mistake than a unit."""
    largest = float(np.abs(array[np.isfinite(array)]).max(initial=0.0))
    if largest > _HUGE:
        raise ValueError(
            f"{name}: got values of up to {largest:.3g}, expected at most {_HUGE:g} in size; look "
            "at what they are, or take another unit"
        )


def _refuse_empty(empty: NDArray[np.bool_], name: str, what: str, place: str, without: str) -> None:
    """Raise if there are rows or columns that hold nothing."""
    where = np.flatnonzero(empty)
    if where.size:
        raise ValueError(
            f"{name}: got {where.size} {what} {without} ({place} {where[0]} is one, counted from "
            "0), expected a number in each; leave them out"
        )


def simulated_sample(
    values: ArrayLike, name: str = "simulated", *, event: tuple[int, ...] = ()
) -> Floats:
    """Check simulated responses, (..., n, *event): no NaN or -inf; +inf is a failed specimen."""
    array = real_array(values, name)
    before = array.shape[: max(0, array.ndim - len(event))]
    if not before or before[-1] == 0 or array.shape[len(before) :] != event:
        expected = "".join(f", {size}" for size in event)
        raise ValueError(
            f"{name}: got shape {array.shape}, expected (..., n{expected}) with n >= 1"
        )
    if np.isnan(array).any() or np.isneginf(array).any():
        raise ValueError(
            f"{name}: got NaN or -inf, expected numbers; a specimen that failed is +inf, "
            "other points are to be left out with weight"
        )
    return array


def sample_weights(weights: ArrayLike | None, n: int, name: str = "weights") -> Floats:
    """Return weights of the last axis that sum to one; ``None`` means equal weights.

    Parameters
    ----------
    weights : array_like, shape (..., n), or None
        Non-negative, finite, with a positive sum along the last axis.
    n : int
        Expected length of the last axis.
    name : str

    Returns
    -------
    ndarray, shape (..., n)
    """
    if weights is None:
        return np.full(n, 1.0 / n)
    array = real_array(weights, name)
    if array.ndim == 0 or array.shape[-1] != n:
        raise ValueError(
            f"{name}: got shape {array.shape}, expected (..., {n}), one weight per value"
        )
    if not np.isfinite(array).all() or (array < 0).any():
        raise ValueError(f"{name}: got negative or non-finite weights, expected weights >= 0")
    total = array.sum(axis=-1, keepdims=True)
    if (total <= 0).any():
        raise ValueError(f"{name}: got weights that sum to zero, expected a positive sum")
    return np.asarray(array / total)


def positive_number(value: object, name: str) -> float:
    """Return ``value`` as a float, or raise if it is not a positive finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise TypeError(
            f"{name}: got {type(value).__name__} {value!r:.60}, expected a positive number"
        )
    if not np.isfinite(value) or value <= 0:
        raise ValueError(f"{name}: got {value!r}, expected a positive finite number")
    return float(value)


def finite_number(value: object, name: str) -> float:
    """Return ``value`` as a float, or raise if it is not a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise TypeError(f"{name}: got {called(value)}, expected a number")
    if not np.isfinite(value):
        raise ValueError(f"{name}: got {value!r}, expected a finite number")
    return float(value)


def positive_integer(value: object, name: str, *, minimum: int = 1) -> int:
    """Return ``value`` as an int, or raise if it is not an integer of at least ``minimum``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(
            f"{name}: got {type(value).__name__} {value!r:.60}, expected an integer >= {minimum}"
        )
    if value < minimum:
        raise ValueError(f"{name}: got {value}, expected an integer >= {minimum}")
    return int(value)


# What PyMC takes for a seed.
type Seed = int | Sequence[int] | np.random.Generator | np.random.RandomState | None


def seed_number(random_seed: object, name: str = "random_seed") -> int:
    """Return a seed as an integer, of all that PyMC takes for one.

    An integer is itself. A generator is asked for its next number, a sequence of integers makes
    one, and None one that no other call has.

    Raises
    ------
    TypeError, ValueError
        If it is none of these, or a negative integer.
    """
    match random_seed:
        case None:
            return int(np.random.SeedSequence().generate_state(1)[0])
        case np.random.Generator():
            return int(random_seed.integers(2**32))
        case np.random.RandomState():
            return int(random_seed.randint(2**32, dtype=np.uint32))
        case list() | tuple() | np.ndarray() if np.size(random_seed) > 0:
            whole = [positive_integer(x, name, minimum=0) for x in np.ravel(random_seed)]
            return int(np.random.SeedSequence(whole).generate_state(1)[0])
        case bool() | np.bool():
            pass
        case int() | np.integer():
            return positive_integer(random_seed, name, minimum=0)
    raise TypeError(
        f"{name}: got {type(random_seed).__name__} {random_seed!r:.60}, expected an integer >= 0, "
        "a sequence of them, a numpy.random.Generator or None"
    )


def refuse_single_precision(caller: str, dtype: str) -> None:
    """Raise if hyperparameters are numbers of single precision."""
    if dtype in ("float16", "float32"):
        raise TypeError(
            f"{caller}: got hyperparameters of {dtype}, expected float64, without which "
            "differences between populations are lost in rounding; set "
            'pytensor.config.floatX = "float64" before the model is made, and leave out dtype='
        )


def share(value: object, name: str) -> float:
    """Return ``value`` as a float, or raise if it is no number between 0 and 1, ends excluded."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise TypeError(
            f"{name}: got {type(value).__name__} {value!r:.60}, expected a number between 0 and 1"
        )
    if not 0 < value < 1:
        raise ValueError(f"{name}: got {value!r}, expected a number between 0 and 1")
    return float(value)


def flag(value: object, name: str) -> bool:
    """Return ``value``, or raise a `TypeError` if it is neither True nor False."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name}: got {called(value)}, expected True or False")
    return bool(value)


def random_seed(value: object, name: str = "random_seed", *, optional: bool = False) -> None:
    """Raise if ``value`` is no seed: an integer >= 0, or, where it is optional, None."""
    if value is None and optional:
        return
    positive_integer(value, name, minimum=0)


def plain_text(value: object, name: str, *, empty: bool = False) -> str:
    """Return ``value``, or raise if it is no text, or one without a letter."""
    if not isinstance(value, str):
        raise TypeError(f"{name}: got {called(value)}, expected a text")
    if not empty and not value.strip():
        raise ValueError(f"{name}: got {value!r}, expected a text that is not empty")
    return value


def texts(value: object, name: str) -> None:
    """Raise if ``value`` is no mapping of texts to texts."""
    pairs = list(value.items()) if isinstance(value, Mapping) else [(value, None)]
    if not all(isinstance(one, str) for pair in pairs for one in pair):
        raise TypeError(
            f"{name}: got {called(value)}, expected a mapping of names to texts, such as "
            '{"mu": "mean stiffness"}'
        )


def stated_path(value: object, name: str, what: str) -> Path:
    """Return ``value`` as the path of a file or folder, or raise if it is none."""
    if not isinstance(value, str | os.PathLike) or isinstance(os.fspath(value), bytes):
        raise TypeError(f"{name}: got {called(value)}, expected the path of a {what}")
    if not os.fspath(value):
        raise ValueError(f"{name}: got {value!r}, expected the path of a {what}")
    return Path(value)


def folder_path(value: object, name: str) -> Path:
    """Return the path of a folder that is there or can be made, or raise."""
    path = stated_path(value, name, "folder")
    if path.exists() and not path.is_dir():
        raise ValueError(f"{name}: got {path}, which is a file, expected a folder")
    return path


def file_path(value: object, name: str) -> Path:
    """Return the path of a file that is there or can be written, or raise."""
    path = stated_path(value, name, "file")
    if path.is_dir():
        raise ValueError(f"{name}: got {path}, which is a folder, expected a file")
    return path


def executes(value: object, name: str) -> None:
    """Raise if ``value`` is neither None nor an executor."""
    known = callable(getattr(value, "submit", None)) and callable(getattr(value, "map", None))
    if value is not None and (isinstance(value, type) or not known):
        raise TypeError(
            f"{name}: got {called(value)}, expected a concurrent.futures.Executor, such as "
            "ProcessPoolExecutor(4)"
        )


def sample_labels(values: ArrayLike, n: int, name: str) -> NDArray[Any]:
    """Return labels of n specimens, shape (n,): texts or numbers, none of them missing."""
    # As objects: NumPy would make the text 'nan' of a label that is missing.
    labels = np.asarray(values, dtype=object)
    if labels.shape != (n,):
        raise ValueError(
            f"{name}: got shape {labels.shape}, expected ({n},), one label per observation"
        )
    for label in labels:
        if not _is_label(label):
            raise ValueError(
                f"{name}: got {called(label)} as a label, expected texts or numbers; give a "
                "specimen that has no label one of its own"
            )
    return np.asarray(values)


def _is_label(value: object) -> bool:
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if number:
        return bool(np.isfinite(value))  # type: ignore[call-overload]
    return isinstance(value, str | np.datetime64)
