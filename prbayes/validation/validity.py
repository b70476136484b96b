"""Validity: do measured responses agree with the calibrated population? u-values and the area test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from prbayes._checks import Floats, positive_integer, real_array
from prbayes._predict import data_digest, specimen_names
from prbayes.model.labels import versions
from prbayes.validation.nulls import Case, Condition, ExactModel, Null, PosteriorNull, area

Predicted = xr.DataArray | NDArray[Any]


@dataclass(frozen=True, eq=False, repr=False)
class ValidityTest:
    """The result of `area_test`.

    Attributes
    ----------
    statistic : float
        Area between the ECDF of the u-values and the identity, from 1/(4n) to 1/2.
    critical_value : float
        The largest area that is not rejected.
    p_value : float
    level : float
    null : str
        What was held to be true.
    folded : bool
        Whether the area is that of ``|2u - 1|``.
    u_values : ndarray, shape (n,)
        Of all conditions, one after the other.
    envelope : ndarray, shape (2, n)
        Bounds of the sorted values that are tested; under the null they hold all of them with probability
        1 - ``level``.
    conditions, specimens : ndarray of str, shape (n,)
        Where each u-value comes from.
    """

    statistic: float
    critical_value: float
    p_value: float
    level: float
    null: str
    folded: bool
    u_values: Floats
    envelope: Floats
    conditions: NDArray[np.str_]
    specimens: NDArray[np.str_]

    @property
    def rejected(self) -> bool:
        """Whether the model is rejected at the level."""
        return self.p_value <= self.level

    def __repr__(self) -> str:
        n, of = self.u_values.size, np.unique(self.specimens).size
        what = "area of |2u - 1|" if self.folded else "area"
        return (
            f"ValidityTest: {'rejected' if self.rejected else 'not rejected'} at level {self.level:g}\n"
            f"  {what} {self.statistic:.4f}, critical value {self.critical_value:.4f}, p-value {self.p_value:.3g}\n"
            f"  {n} values of {of} specimens, {np.unique(self.conditions).size} condition(s)\n"
            f"  null: {self.null}"
        )

    def to_dataset(self) -> xr.Dataset:
        """Return the result as a Dataset, which ``to_netcdf`` saves; ``rank`` is the dimension of the envelope."""
        return xr.Dataset(
            {
                "u": ("observation", self.u_values),
                "lower": ("rank", self.envelope[0]),
                "upper": ("rank", self.envelope[1]),
                "statistic": self.statistic,
                "critical_value": self.critical_value,
                "p_value": self.p_value,
                "rejected": self.rejected,
                "level": self.level,
                "folded": self.folded,
            },
            coords={"condition": ("observation", self.conditions), "specimen": ("observation", self.specimens)},
            attrs={"null": self.null, **versions()},
        )


def u_values(
    observed: ArrayLike | Mapping[str, ArrayLike] | Sequence[ArrayLike],
    predicted: Predicted | Mapping[str, Predicted] | Sequence[Predicted],
    *,
    random_seed: int | None = None,
) -> Floats:
    r"""Return where measured responses stand in the pooled predictive distribution (probability integral transform).

    .. math:: u_i = \tfrac12 \{ P(Y < y_i) + P(Y \le y_i) \}

    over all draws and samples of the prediction together. Several conditions pool their u-values.

    Parameters
    ----------
    observed : array_like, shape (n,); or a mapping or list of such, by condition
        +inf is a specimen that had failed.
    predicted : DataArray from `predict`, or ndarray of shape (..., S); or a mapping or list of such
        +inf counts as larger than every number; NaN are left out.
    random_seed : int, optional
        With a seed u is uniform between P(Y < y) and P(Y <= y), and not the middle: then u-values of ties, such as
        failed specimens or discrete responses, are uniform too if the model is right.

    Returns
    -------
    ndarray, shape (n,)
        In the order of ``observed``, one condition after the other.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Notes
    -----
    Measured values that are rounded have ties that predicted ones have not: round the predicted ones alike, as in
    ``u_values(observed, predicted.round(2))``.

    References
    ----------
    .. [1] Czado, C., T. Gneiting and L. Held (2009), Predictive model assessment for count data, Biometrics 65,
       1254-1261, doi:10.1111/j.1541-0420.2009.01191.x.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> prb.u_values([0.3, 1.5, 9.0], np.array([0.0, 1.0, 2.0, 3.0]))
    array([0.25, 0.5 , 1.  ])
    """
    return np.concatenate(_case(observed, predicted, None, random_seed)[0].u_values())


def area_test(
    observed: ArrayLike | Mapping[str, ArrayLike] | Sequence[ArrayLike],
    predicted: Predicted | Mapping[str, Predicted] | Sequence[Predicted],
    *,
    level: float = 0.05,
    null: Null | None = None,
    specimens: ArrayLike | Mapping[str, ArrayLike | None] | Sequence[ArrayLike | None] | None = None,
    folded: bool = False,
    random_seed: int | None = None,
) -> ValidityTest:
    r"""Test whether measured responses may come from the calibrated population.

    The statistic is the area between the ECDF of the u-values, of all conditions together, and the identity:

    .. math:: A = \int_0^1 |F_n(v) - v| \, dv

    It sees a wrong mean well and a wrong spread hardly; the area of ``|2u - 1|`` sees a wrong spread.

    Parameters
    ----------
    observed : array_like, shape (n,); or a mapping or list of such, by condition
        Measured on specimens that were not used in the calibration, but with `JointNull`. +inf is a specimen
        that had failed.
    predicted : DataArray from `predict`, or ndarray of shape (..., S); or a mapping or list of such
        Leading axes are draws of the posterior, the last one specimens. NaN are left out.
    level : float
        Probability of rejecting a right model.
    null : Null, optional
        `PosteriorNull` by default; with one population only, and one value per specimen, `ExactModel`.
        `JointNull` for the calibration's own specimens.
    specimens : as ``observed``, optional
        Labels. Values with the same label, also of several conditions, are of one specimen, and replicates of the
        null then are as dependent as they: sample i of a draw must be the same specimen in all conditions, as
        `predict` has it with the same seed. Without labels all values are of different specimens.
    folded : bool
        Whether to test ``|2u - 1|``, which a right model makes uniform as well: responses too far out, or too
        close to the middle. Two tests at ``level`` / 2 look at both mean and spread.
    random_seed : int, optional
        As in `u_values`.

    Returns
    -------
    ValidityTest

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described; if the data, or labels, are those of the calibration and the null does
        not allow for it; if specimens are shared by conditions that were not predicted for the same specimens.

    References
    ----------
    .. [1] Ferson, S., W. L. Oberkampf and L. Ginzburg (2008), Model validation and predictive capability for the
       thermal challenge problem, Comput. Methods Appl. Mech. Eng. 197, 2408-2430, doi:10.1016/j.cma.2007.07.030.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> rng = np.random.default_rng(1)
    >>> predicted = rng.normal(rng.normal(0, 0.2, (200, 1)), 1.0, (200, 500))
    >>> prb.area_test(rng.normal(0, 1, 20), predicted).rejected
    False
    >>> prb.area_test(rng.normal(2, 1, 20), predicted).rejected
    True
    """
    if null is not None and not isinstance(null, Null):
        raise TypeError(
            f"null: got {type(null).__name__} {null!r:.60}, expected prb.PosteriorNull(), prb.ExactModel() or "
            "prb.JointNull(optimum)"
        )
    if isinstance(level, bool) or not isinstance(level, int | float | np.floating) or not 0 < level < 1:
        raise ValueError(f"level: got {level!r:.60}, expected a probability between 0 and 1, such as 0.05")
    case, attributes = _case(observed, predicted, specimens, random_seed, folded)
    if case.draws > 1 or case.dependent:
        null = PosteriorNull() if null is None else null
    null = ExactModel() if null is None else null
    if not null.own_specimens:
        for c, attrs in zip(case.conditions, attributes, strict=True):
            _refuse_own(c, attrs)
    if case.shared:
        _refuse_unlike(case, attributes)
    u = np.concatenate(case.u_values())
    statistic = float(area(case.tested(u)))
    judged = null.judge(case, statistic, float(level))
    labels = [c.labels or tuple(f"{c.name}, {i}" for i in range(c.observed.size)) for c in case.conditions]
    return ValidityTest(
        statistic=statistic,
        critical_value=judged.critical_value,
        p_value=judged.p_value,
        level=float(level),
        null=null.describe(case),
        u_values=u,
        folded=folded,
        envelope=np.array([judged.lower, judged.upper]),
        conditions=np.array([c.name for c in case.conditions for _ in c.observed]),
        specimens=np.array([label for part in labels for label in part]),
    )


def _case(
    observed: Any, predicted: Any, specimens: Any, seed: int | None, folded: bool = False
) -> tuple[Case, list[dict[Any, Any]]]:
    """Return the conditions, checked, and the attributes of their predictions."""
    if seed is not None:
        positive_integer(seed, "random_seed", minimum=0)
    names, parts = _by_condition(observed, predicted, specimens)
    numbers: dict[object, int] = {}
    conditions, attributes = [], []
    for name, (measured, simulated, labels) in zip(names, parts, strict=True):
        y = _measured(name, measured)
        text = None
        if labels is not None:
            text = tuple(specimen_names(labels)) if np.ndim(labels) == 1 else ()
            if len(text) != y.size:
                raise ValueError(
                    f"{name}: specimens: got shape {np.shape(labels)}, expected ({y.size},), one label per observation"
                )
        keys: Sequence[object] = [(name, i) for i in range(y.size)] if text is None else text
        own = np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.intp)
        conditions.append(Condition(name, y, _simulated(name, simulated), text, own))
        attributes.append(dict(simulated.attrs) if isinstance(simulated, xr.DataArray) else {})
    draws = [len(c.predicted) for c in conditions]
    if len(set(draws)) > 1:
        raise ValueError(
            f"predicted: got {draws} draws for the conditions {names}, expected the same draws of one posterior in "
            "all; pass the same result and draws= to prb.predict"
        )
    distinct = sum(np.unique(c.numbers).size for c in conditions)
    return Case(tuple(conditions), len(numbers), distinct > len(numbers), seed, folded), attributes


def _by_condition(observed: Any, predicted: Any, specimens: Any) -> tuple[list[str], list[tuple[Any, Any, Any]]]:
    """Bring the arguments of one or several conditions into one form."""
    if isinstance(predicted, Mapping):
        names = [str(n) for n in predicted]
        for what, given in (("observed", observed), ("specimens", {} if specimens is None else specimens)):
            known = isinstance(given, Mapping)
            if not known or not set(given) <= set(predicted) or (what == "observed" and set(given) != set(predicted)):
                got = sorted(map(str, given)) if known else type(given).__name__
                raise ValueError(f"{what}: got {got}, expected a mapping with the conditions of predicted, {names}")
        labels = {} if specimens is None else specimens
        return names, [(observed[n], predicted[n], labels.get(n)) for n in predicted]
    if isinstance(predicted, list | tuple):
        names = [str(i) for i in range(len(predicted))]
        labels = [None] * len(predicted) if specimens is None else specimens
        for what, given in (("observed", observed), ("specimens", labels)):
            if not isinstance(given, list | tuple) or len(given) != len(predicted) or not predicted:
                got = f"{len(given)} conditions" if isinstance(given, list | tuple) else type(given).__name__
                raise ValueError(
                    f"{what}: got {got}, expected a list with the {len(predicted)} conditions of predicted; one "
                    "prediction alone is an array"
                )
        return names, list(zip(observed, predicted, labels, strict=True))
    if isinstance(observed, Mapping):
        raise ValueError(
            f"predicted: got {type(predicted).__name__}, expected a mapping with the conditions of observed"
        )
    name = getattr(predicted, "name", None)
    return [str(name) if name else "observed"], [(observed, predicted, specimens)]


def _measured(name: str, values: Any) -> Floats:
    y = real_array(values, f"{name}: observed")
    if y.ndim != 1 or y.size == 0:
        raise ValueError(f"{name}: observed: got shape {y.shape}, expected (n,) with n >= 1 measured responses")
    bad = int((np.isnan(y) | np.isneginf(y)).sum())
    if bad:
        raise ValueError(
            f"{name}: observed: got {bad} NaN or -inf among {y.size} values, expected numbers; leave missing "
            "specimens out, and give those that had failed as +inf"
        )
    return y


def _simulated(name: str, values: Any) -> Floats:
    """Return predicted values, shape (D, S)."""
    if isinstance(values, xr.DataArray):
        if set(values.dims) != {"chain", "draw", "sample"}:
            raise ValueError(
                f"{name}: predicted: got a DataArray with dims {values.dims}, expected (chain, draw, sample), as "
                "prb.predict returns"
            )
        values = values.transpose("chain", "draw", "sample").values
    y = real_array(values, f"{name}: predicted")
    if y.ndim == 0 or y.size == 0:
        raise ValueError(f"{name}: predicted: got shape {y.shape}, expected (..., S): specimens in the last axis")
    if np.isneginf(y).any() or np.isnan(y).all():
        raise ValueError(
            f"{name}: predicted: got -inf, or nothing but NaN, expected numbers; +inf is a failed specimen"
        )
    return np.asarray(y.reshape(-1, y.shape[-1]))


def _refuse_own(condition: Condition, attrs: dict[Any, Any]) -> None:
    """Raise if the model was calibrated on these specimens."""
    own = set(condition.labels or ()) & set(np.atleast_1d(attrs.get("calibration_specimens", [])).tolist())
    if own:
        got = f"{len(own)} specimens of the calibration, such as {min(own)!r}"
    elif data_digest(condition.observed) in np.atleast_1d(attrs.get("calibration_data", [])):
        got = "the very data of the calibration"
    else:
        return
    raise ValueError(
        f"{condition.name}: got {got}, expected specimens that it has not seen: a model is hardly ever rejected on "
        "those it was fitted to; test others, or pass prb.predict(optimum, ...) and null=prb.JointNull(optimum)"
    )


def _refuse_unlike(case: Case, attributes: list[dict[Any, Any]]) -> None:
    """Raise if conditions share specimens, but their predictions do not."""
    shapes = [c.predicted.shape for c in case.conditions]
    known = {attrs["specimens_id"] for attrs in attributes if "specimens_id" in attrs}
    if len(set(shapes)) > 1 or len(known) > 1:
        got = f"shapes {shapes}" if len(set(shapes)) > 1 else "different specimens"
        raise ValueError(
            f"specimens: got the same labels in several conditions, predicted with {got}, expected the same specimens "
            "in all; pass the same inputs, n_samples, draws and random_seed to prb.predict, and stored=False if "
            "designs differ"
        )
