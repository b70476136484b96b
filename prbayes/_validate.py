"""Validation of arguments: samples, weights, numbers, seeds, paths.

Every message says what was got, what was expected, and what to do.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.intp]

# Largest number of values in memory if work is done in blocks: 32 MiB. A comment says so where the
# size of the blocks changes results.
AT_ONCE = 1 << 22

# Advice for problems without specimens, which need another package.
NO_POPULATION = (
    "for one time series, which is one specimen, or parameters common to all specimens, use "
    "pm.Simulator or a pm.Normal likelihood"
)
# Number of values that stay in the cache of a processor: 2 MiB.
IN_CACHE = 1 << 18
# Largest measured value, so that sums of squares stay finite.
_LARGEST = 1e152

# Number of the format of all files that this version writes and reads; release candidates have
# lower numbers, or none.
FORMAT = 10

Shape = tuple[int, ...]  # sizes of the axes of an array
Arrays = Sequence[Floats]  # arrays in a fixed order, such as one for each input
Labels = Mapping[str, str]  # labels, units or other texts by name
StrPath = str | os.PathLike[str]  # path of a file or folder
NamedArrays = dict[str, Floats]  # arrays by name
ArraysByName = Mapping[str, Floats]  # arrays by name, which are only read
NamedValues = Mapping[str, Any]  # values of any type by name, which are only read
Names = tuple[str, ...]  # names or other texts, in a fixed order
ArrayPair = tuple[Floats, Floats]  # two arrays, such as values and their weights
ArrayFunction = Callable[[Floats], Floats]
Function = Callable[..., Any]  # the user's response, or a part of it


def called(value: object) -> str:
    """Return type and value of an argument in one line, for a message."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    return f"{type(value).__name__} {' '.join(repr(value).split()):.60}"


def wrong_type(value: object, name: str, expected: str) -> TypeError:
    """Return the error for an argument of another type."""
    return TypeError(f"{name}: got {type(value).__name__}, expected {expected}")


def wrong_value(value: object, name: str, expected: str) -> TypeError:
    """Return the error for an argument of a wrong type, which shows the start of its value."""
    return TypeError(f"{name}: got {called(value)}, expected {expected}")


def require_format(got: object) -> None:
    """Raise a ValueError unless a file has the format of this version; ``got`` is its number."""
    if str(got) != str(FORMAT):
        raise ValueError(
            f"got a file of format {got!s:.20}, expected {FORMAT}; numbers below 10, or none, are "
            "those of release candidates: use the version that wrote it, or compute it again"
        )


# -- arrays ----------------------------------------------------------------------------------


def unmasked(values: Any) -> Any:
    """Return values with NaN in place of masked numbers, also of lists of masked arrays."""
    if isinstance(values, list | tuple):
        return [unmasked(value) for value in values]
    if not isinstance(values, np.ma.MaskedArray):
        return values
    if not np.ma.is_masked(values) or values.dtype.kind not in "biufcO":
        return np.ma.getdata(values)
    return np.ma.filled(values.astype(np.float64) if values.dtype.kind in "biu" else values, np.nan)


def complete_rows(values: Floats) -> Bools:
    """Return which rows of a matrix have finite numbers only, (n, m) -> (n,)."""
    is_complete: Bools = np.isfinite(values).all(axis=1)
    return is_complete


def finite_or_nan(values: Floats) -> Floats:
    """Return values with NaN in place of infinite ones."""
    return np.where(np.isfinite(values), values, np.nan)


def flat_rows[T: np.generic](values: NDArray[T]) -> NDArray[T]:
    """Return the values of each specimen, or other row, as a vector, (n, ...) -> (n, m)."""
    return values.reshape(len(values), -1)


def real_array(values: ArrayLike, name: str) -> Floats:
    """Return values as a float array, NaN where masked; a `TypeError` if they are not numbers."""
    try:
        array = np.asarray(unmasked(values))
    except ValueError as error:
        raise TypeError(
            f"{name}: got a ragged sequence, expected a regular array of numbers"
        ) from error
    if array.dtype.kind in "fiu":
        return np.asarray(array, dtype=np.float64)
    if array.dtype.kind == "c":
        raise TypeError(
            f"{name}: got complex numbers, expected real ones; pass the real part or the modulus"
        )
    # NumPy would convert texts to numbers, and None to NaN. A None inside a list is a missing
    # value.
    is_convertible = array.dtype.kind == "O" and values is not None
    if is_convertible and not any(isinstance(x, bool | np.bool_ | str | bytes) for x in array.flat):
        with suppress(TypeError, ValueError, OverflowError):
            return np.where(pd.isna(array), np.nan, array).astype(
                np.float64
            )  # isna finds pd.NA, too
    got = f"an array of dtype {array.dtype}" if array.ndim else called(values)
    text = first_text(array) if array.ndim else ""
    raise TypeError(f"{name}: got {got}, expected real numbers{text and '; '}{text}")


def first_text(array: NDArray[Any]) -> str:
    """Describe the first text of an array for a message, preferably one that is not numeric."""
    texts = [(i, x) for i, x in enumerate(array.flat) if isinstance(x, str | bytes)]
    for i, text in texts:
        try:
            float(text)
        except ValueError:
            return f"the value at index {i} is the text {str(text)!r:.60}"
    return f"the value at index {texts[0][0]} is the text {str(texts[0][1])!r:.60}" if texts else ""


def observed_sample(
    values: ArrayLike, name: str = "observed", *, minimum: int = 1, failures: bool = False
) -> Floats:
    """Return measured responses, (N,), finite or a failure (+inf) if allowed, or raise."""
    array = real_array(values, name)
    if array.ndim != 1:
        raise ValueError(
            f"{name}: got an array of shape {array.shape}, expected one dimension, (N,); for "
            "several outputs of a specimen, (N, m), use prb.Joint(metric), or one Simulator each; "
            f"{NO_POPULATION}"
        )
    n_failed = int(np.isposinf(array).sum())
    n_invalid = int((~np.isfinite(array)).sum()) - (n_failed if failures else 0)
    if n_invalid:
        advice = ""
        if failures:
            advice = ", and pass +inf for those that failed"
        elif n_failed:
            advice = "; for specimens that failed, +inf, use a metric that counts them"
        raise ValueError(
            f"{name}: got {n_invalid} NaN or infinite among {array.size} values, expected finite "
            f"ones; leave out missing specimens (NaN or masked){advice}"
        )
    refuse_huge(array, name)
    n_finite = array.size - n_failed
    if n_finite < minimum:
        got = {0: "no values", 1: "one value"}.get(n_finite, f"{n_finite} values")
        besides = f" besides {n_failed} of specimens that failed" if n_failed else ""
        raise ValueError(
            f"{name}: got {got}{besides}, expected at least {minimum} measured responses"
        )
    return array


def observed_outputs(values: ArrayLike) -> Floats:
    """Return measured responses of several outputs, shape (N, m), or raise.

    NaN, or a mask, is an output that was not measured; +inf a specimen that failed there. Every
    specimen needs an output, and every output a finite value.
    """
    array = real_array(values, "observed")
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(
            f"observed: got an array of shape {array.shape}, expected (N, m), a row for each "
            f"specimen and a column for each output; {NO_POPULATION}"
        )
    if np.isneginf(array).any():
        raise ValueError(
            "observed: got -inf, expected numbers; NaN is an output that was not measured, +inf a "
            "specimen that failed"
        )
    refuse_huge(array, "observed")
    missing = np.isnan(array)
    for empty, problem, line in (
        (missing.all(axis=1), "specimens without any output", "row"),
        (missing.all(axis=0), "outputs that no specimen has", "column"),
        (~np.isfinite(array).any(axis=0), "outputs in which every specimen failed", "column"),
    ):
        if empty.any():
            raise ValueError(
                f"observed: got {empty.sum()} {problem} ({line} {empty.argmax()} is one, counted "
                "from 0), expected a number in each; leave them out"
            )
    return array


def refuse_huge(array: Floats, name: str) -> None:
    """Raise if squares of values overflow, which is probably a mistake in the data."""
    largest = float(np.abs(array[np.isfinite(array)]).max(initial=0.0))
    if largest > _LARGEST:
        raise ValueError(
            f"{name}: got values of up to {largest:.3g}, expected at most {_LARGEST:g} in size; "
            "check them, or use another unit"
        )


def simulated_sample(values: ArrayLike, name: str = "simulated", *, event: Shape = ()) -> Floats:
    """Return simulated responses, (..., n, *event), or raise for NaN or -inf; +inf is a failure."""
    array = real_array(values, name)
    batch = array.shape[: max(0, array.ndim - len(event))]
    if not batch or batch[-1] == 0 or array.shape[len(batch) :] != event:
        expected = "".join(f", {size}" for size in event)
        raise ValueError(
            f"{name}: got shape {array.shape}, expected (..., n{expected}) with n >= 1"
        )
    if np.isnan(array).any() or np.isneginf(array).any():
        raise ValueError(
            f"{name}: got NaN or -inf, expected numbers; +inf is a specimen that failed; leave out "
            "other points with their weights"
        )
    return array


def sample_weights(weights: ArrayLike | None, n: int, name: str = "weights") -> Floats:
    """Return weights, shape (..., n), whose last axis sums to one; ``None`` is equal weights."""
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
    return array / total


def sample_labels(values: ArrayLike, n: int, name: str) -> NDArray[Any]:
    """Return labels of n specimens, shape (n,): texts or numbers, none of them missing."""
    # The dtype is object, because NumPy would turn a missing label into the text 'nan'.
    labels = np.asarray(values, dtype=object)
    if labels.shape != (n,):
        raise ValueError(
            f"{name}: got shape {labels.shape}, expected ({n},), one label per observation"
        )
    for label in labels:
        is_number = isinstance(label, int | float | np.number) and not isinstance(label, bool)
        if not (np.isfinite(label) if is_number else isinstance(label, str | np.datetime64)):
            raise ValueError(
                f"{name}: got {called(label)} as a label, expected texts or numbers; give each "
                "specimen without a label a new one"
            )
    return np.asarray(values)


def refuse_single_precision(caller: str, dtype: str) -> None:
    """Raise if hyperparameters are numbers of single precision."""
    if dtype in ("float16", "float32"):
        raise TypeError(
            f"{caller}: got hyperparameters of {dtype}, expected float64, without which "
            "differences between populations are lost in rounding; set "
            'pytensor.config.floatX = "float64" before the model is made, and leave out dtype='
        )


# -- numbers ---------------------------------------------------------------------------------


def number(
    value: object,
    name: str,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    closed: bool = True,
    whole: bool = False,
) -> float:
    """Return a finite number between two ends, which are allowed if ``closed``, or raise."""
    if whole:
        expected = f"an integer >= {low:g}"
    elif high < math.inf:
        expected = f"a number between {low:g} and {high:g}"
    else:
        expected = "a positive finite number" if low == 0 else "a finite number"
    kinds = int | np.integer if whole else int | float | np.integer | np.floating
    if isinstance(value, bool) or not isinstance(value, kinds):
        advice = "; pass a model as model=" if hasattr(value, "free_RVs") else ""
        raise wrong_value(value, name, f"{expected}{advice}")
    is_inside = low <= value <= high if closed else low < value < high
    if not is_inside or not (whole or np.isfinite(value)):
        raise ValueError(f"{name}: got {value!r}, expected {expected}")
    return int(value) if whole else float(value)


finite_number = number
positive_number = partial(number, low=0, closed=False)
share = partial(number, low=0, high=1, closed=False)


def positive_integer(value: object, name: str, *, minimum: int = 1) -> int:
    """Return ``value`` as an int, or raise if it is not an integer of at least ``minimum``."""
    return int(number(value, name, low=minimum, whole=True))


# Types that PyMC accepts as a seed.
type Seed = int | Sequence[int] | np.random.Generator | np.random.RandomState | None


def seed_number(random_seed: object, name: str = "random_seed") -> int:
    """Return an integer for any seed that PyMC accepts, a random one for None, or raise."""
    match random_seed:
        case None:
            return int(np.random.SeedSequence().generate_state(1)[0])
        case np.random.Generator():
            return int(random_seed.integers(2**32))
        case np.random.RandomState():
            return int(random_seed.randint(2**32, dtype=np.uint32))
        case list() | tuple() | np.ndarray() if np.size(random_seed) > 0:
            whole = [positive_integer(x, name, minimum=0) for x in np.ravel(random_seed)]
            # As in NumPy, a sequence of one number is the seed of this number.
            several = np.random.SeedSequence(whole).generate_state(1)[0]
            return int(several) if len(whole) > 1 else whole[0]
        case bool() | np.bool():
            pass
        case int() | np.integer():
            return positive_integer(random_seed, name, minimum=0)
    raise wrong_value(
        random_seed, name, "an integer >= 0, a sequence of them, a numpy.random.Generator or None"
    )


# -- flags, texts, paths, executors ----------------------------------------------------------


def flag(value: object, name: str) -> bool:
    """Return ``value``, or raise a `TypeError` if it is neither True nor False."""
    if not isinstance(value, bool | np.bool_):
        raise wrong_value(value, name, "True or False")
    return bool(value)


def plain_text(value: object, name: str, *, empty: bool = False) -> str:
    """Return ``value``, or raise if it is no text, or if it is blank and not allowed to be."""
    if not isinstance(value, str):
        raise wrong_value(value, name, "a text")
    if not empty and not value.strip():
        raise ValueError(f"{name}: got {value!r}, expected a text that is not empty")
    return value


def texts(value: object, name: str) -> None:
    """Raise if ``value`` is no mapping of texts to texts."""
    pairs = list(value.items()) if isinstance(value, Mapping) else [(value, None)]
    if not all(isinstance(text, str) for pair in pairs for text in pair):
        raise wrong_value(
            value, name, 'a mapping of names to texts, such as {"mu": "mean stiffness"}'
        )


def stated_path(value: object, name: str, kind: str) -> Path:
    """Return ``value`` as the path of a file or folder, or raise if it is none."""
    if not isinstance(value, str | os.PathLike) or isinstance(os.fspath(value), bytes):
        raise wrong_value(value, name, f"the path of a {kind}")
    if not os.fspath(value):
        raise ValueError(f"{name}: got {value!r}, expected the path of a {kind}")
    return Path(value)


def folder_path(value: object, name: str) -> Path:
    """Return the path of a folder that exists or can be made, or raise."""
    path = stated_path(value, name, "folder")
    if path.exists() and not path.is_dir():
        raise ValueError(f"{name}: got {path}, which is a file, expected a folder")
    return path


def file_path(value: object, name: str) -> Path:
    """Return the path of a file that exists or can be written, or raise."""
    path = stated_path(value, name, "file")
    if path.is_dir():
        raise ValueError(f"{name}: got {path}, which is a folder, expected a file")
    return path


def executes(value: object) -> None:
    """Raise if ``value`` is neither None nor an executor of futures of the standard library."""
    if value is None or isinstance(value, Executor):
        return
    # A Dask client has futures of another kind, but can return an executor.
    is_dask = hasattr(value, "get_executor") and not isinstance(value, type)
    advice = "its get_executor(pure=False)" if is_dask else "ProcessPoolExecutor(4)"
    raise wrong_value(value, "executor", f"a concurrent.futures.Executor, such as {advice}")
