"""The area test: whether measured responses agree with the calibrated population."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from prbayes._display import Shown, View, without_constructor
from prbayes._finding import Finding, counted, report
from prbayes._progress import shown
from prbayes._validate import Floats, Seed, share
from prbayes.model.description import versions
from prbayes.model.fingerprint import Identity, as_attributes
from prbayes.model.locking import locked
from prbayes.results.predict import array_digest, data_digest
from prbayes.validation.nulls import ExactModel, Null, PosteriorNull
from prbayes.validation.pit import DIRECTION, ByCondition, Case, Predicted, read_case


@without_constructor
@dataclass(frozen=True, eq=False, repr=False)
class ValidityTest(Shown):
    """The result of `area_test`.

    Attributes
    ----------
    statistic : float
        Area between the ECDF of the u-values and the identity, from 1/(4n) to 1/2.
    critical_value : float
        The largest area that is not rejected.
    p_value : float
        Probability of an area at least as large under the null hypothesis.
    alpha : float
        The significance level.
    null : str
        The null hypothesis.
    folded : bool
        Whether the area is that of ``|2u - 1|``.
    u_values : ndarray, shape (n,)
        Of all conditions, one after the other.
    envelope : ndarray, shape (2, n)
        Bounds of the sorted values that are tested; under the null all of them are between the
        bounds with probability 1 - ``alpha``.
    conditions, specimens : ndarray of str, shape (n,)
        The condition and the specimen of each u-value.
    identity : Identity or None
        Of the problem whose calibration is tested, if the predictions have it.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> test = prb.area_test([0.1, 0.4, 0.6, 0.9], np.linspace(0, 1, 401))
    >>> test.rejected, round(test.statistic, 3)
    (False, 0.065)
    """

    statistic: float
    critical_value: float
    p_value: float
    alpha: float
    null: str
    folded: bool
    u_values: Floats
    envelope: Floats
    conditions: NDArray[np.str_]
    specimens: NDArray[np.str_]
    identity: Identity | None = None

    @property
    def rejected(self) -> bool:
        """Whether the model is rejected at the significance level."""
        return self.p_value <= self.alpha

    @property
    def of_conditions(self) -> list[str]:
        """The tested conditions, in their order."""
        names = [name.split(DIRECTION)[0] for name in self.conditions.tolist()]
        return list(dict.fromkeys(names))

    def to_view(self) -> View:
        """Return what a reader sees."""
        verdict = "rejected" if self.rejected else "not rejected"
        area = "area of |2u - 1|" if self.folded else "area"
        n_specimens = np.unique(self.specimens).size
        n_conditions = len(self.of_conditions)
        conditions = counted(n_conditions, "condition")
        n_directions = np.unique(self.conditions).size
        directions = f", seen in {n_directions} directions" if n_directions > n_conditions else ""
        rows = [
            [area, f"{self.statistic:.4f}"],
            ["critical value", f"{self.critical_value:.4f}"],
            ["p-value", f"{self.p_value:.3g}"],
        ]
        sentences = [
            f"{counted(self.u_values.size, 'value')} of {counted(n_specimens, 'specimen')}, "
            f"{conditions}{directions}",
            f"null: {self.null}",
        ]
        return View(f"ValidityTest: {verdict} at level {self.alpha:g}", (), rows, sentences)

    def __repr__(self) -> str:
        shown = self.to_view()
        numbers = ", ".join(" ".join(row) for row in shown.rows)
        return "\n  ".join([shown.heading, numbers, *shown.sentences])

    def to_dataframe(self) -> Any:
        """Return the u-value of each measured response, with its condition and specimen."""
        return self.to_dataset()["u"].to_dataframe().set_index(["condition", "specimen"])

    def to_dataset(self) -> xr.Dataset:
        """Return the result as a Dataset; its dimension ``rank`` is that of the envelope."""
        return xr.Dataset(
            {
                "u": ("observation", self.u_values),
                "lower": ("rank", self.envelope[0]),
                "upper": ("rank", self.envelope[1]),
                "statistic": self.statistic,
                "critical_value": self.critical_value,
                "p_value": self.p_value,
                "rejected": self.rejected,
                "alpha": self.alpha,
                "folded": self.folded,
            },
            coords={
                "condition": ("observation", self.conditions),
                "specimen": ("observation", self.specimens),
            },
            attrs={"null": self.null, **as_attributes(self.identity), **versions()},
        )


@locked
def area_test(
    observed: ByCondition[ArrayLike],
    predicted: ByCondition[Predicted],
    *,
    alpha: float = 0.05,
    null: Null | None = None,
    specimens: ByCondition[ArrayLike | None] = None,
    folded: bool = False,
    randomize: bool = False,
    random_seed: Seed = 0,
    progressbar: bool = True,
) -> ValidityTest:
    r"""Test whether measured responses may come from the calibrated population.

    The statistic is the area between the ECDF of the u-values, of all conditions together, and the
    identity:

    .. math:: A = \int_0^1 |F_n(v) - v| \, dv

    It has much power against a wrong mean and little against a wrong spread, against which the area
    of ``|2u - 1|`` has power.

    Parameters
    ----------
    observed : array_like, shape (n,) or (n, m); or a mapping or list of such, by condition
        Measured on specimens that were not used in the calibration, except with `JointNull`. +inf
        is a specimen that had failed. Several outputs of a specimen, (n, m), are projected on
        directions of the whitened predicted ones. The statistic is the mean over these of the areas
        of u and ``|2u - 1|``: a wrong correlation is a wrong spread in some directions.
    predicted : DataArray from `predict`, or ndarray of shape (..., S); or a mapping or list of such
        Leading axes are draws of the posterior, the last one specimens, (..., S, m) with m outputs.
        NaN are left out. The values have to be like the observed ones: rounded, capped at the limit
        of the instrument, or with an error, as these are.
    alpha : float
        Probability of rejecting a right model.
    null : Null, optional
        `PosteriorNull` by default, with 999 replicates for more than 1000 values. With one
        population only, and one value per specimen, `ExactModel`. `JointNull` for the
        calibration's own specimens.
    specimens : as ``observed``, optional
        Labels. Values with the same label, also of several conditions, are of one specimen, and
        replicates of the null are equally dependent. Sample i of a draw must be the same specimen
        in all conditions, as in results of `predict` with the same seed. Without labels all values
        are of different specimens.
    folded : bool
        Whether to test ``|2u - 1|``, which a right model makes uniform as well: responses too far
        out, or too close to the middle. Two tests at ``alpha`` / 2 look at both mean and spread.
    randomize, random_seed
        As in `u_values`.
    progressbar : bool
        Whether work of more than two seconds shows a bar on stderr.

    Returns
    -------
    ValidityTest

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described; if the data, or labels, are those of the calibration and
        the null does not allow for it; if conditions share specimens but their predictions do not;
        if conditions were predicted by calibrations of different problems.

    References
    ----------
    .. [1] Ferson, S., W. L. Oberkampf and L. Ginzburg (2008), Model validation and predictive
       capability for the thermal challenge problem, Comput. Methods Appl. Mech. Eng. 197,
       2408-2430, doi:10.1016/j.cma.2007.07.030.

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
            f"null: got {type(null).__name__} {null!r:.60}, expected "
            "prb.validation.PosteriorNull(), prb.validation.ExactModel() or "
            "prb.validation.JointNull(optimum)"
        )
    alpha = share(alpha, "alpha")
    case = read_case(
        observed,
        predicted,
        specimens,
        folded=folded,
        randomize=randomize,
        random_seed=random_seed,
    )
    if null is None:
        is_exact = case.n_draws == 1 and not case.is_dependent
        null = ExactModel() if is_exact else PosteriorNull(9999 if case.size <= 1000 else 999)
    if not null.own_specimens:
        _refuse_calibration_specimens(case)
    if case.shares_specimens:
        _require_same_samples(case)
    report(*excluded_failures(case), *_findings_of_errors(predicted))
    u = case.u_values()
    statistic = float(case.statistic(u))
    with shown(progressbar):
        judgement = null.judge(case, statistic, alpha)
    names = [c.name for c in case.conditions]
    return ValidityTest(
        statistic=statistic,
        critical_value=judgement.critical_value,
        p_value=judgement.p_value,
        alpha=alpha,
        null=null.describe(case),
        u_values=u,
        folded=folded,
        envelope=np.array(judgement.envelope()),
        conditions=np.repeat(names, [c.observed.size for c in case.conditions]),
        specimens=np.array([label for c in case.conditions for label in c.specimens]),
        identity=case.identity,
    )


def _refuse_calibration_specimens(case: Case) -> None:
    """Raise if specimens of the test were used in the calibration."""
    for condition in case.conditions:
        attributes = condition.attributes
        calibrated = np.atleast_1d(attributes.get("calibration_specimens", [])).tolist()
        shared = set(condition.labels or ()) & set(calibrated)
        digests = np.atleast_1d(attributes.get("calibration_data", []))
        if shared:
            got = f"{len(shared)} specimens of the calibration, such as {min(shared)!r}"
        elif data_digest(condition.measured) in digests:
            got = "the data of the calibration"
        else:
            continue
        raise ValueError(
            f"{condition.name}: got {got}, expected specimens that it has not seen: a model is "
            "hardly ever rejected on those it was fitted to; test others, or pass "
            "prb.predict(optimum, ...) and null=prb.validation.JointNull(optimum)"
        )


def _findings_of_errors(predicted: Any) -> list[Finding]:
    """Return findings of predictions from which a known reading error was left out."""
    findings = []
    for prediction in predicted.values() if isinstance(predicted, Mapping) else [predicted]:
        digest = getattr(prediction, "attrs", {}).get("without_error")
        if digest is not None and digest == array_digest(np.asarray(prediction)):
            text = (
                f"{prediction.name}: got a prediction without the error of readings that the model "
                "has; readings with this error scatter more than is predicted; pass it to "
                "prb.predict as an input, or ignore this if the tested values are exact."
            )
            findings.append(
                Finding(
                    "error-left-out", text, "measurement_error.md#testing-readings-against-readings"
                )
            )
    return findings


def excluded_failures(case: Case) -> list[Finding]:
    """Return findings of conditions with measured failures but no predicted ones."""
    findings = []
    for condition in case.conditions:
        n_failed = int(np.isposinf(condition.observed).sum())
        if n_failed and condition.projection is None and not np.isposinf(condition.predicted).any():
            text = (
                f"{condition.name}: {n_failed} of {condition.observed.size} measured values are "
                "+inf, and no predicted one: the model excludes them, whatever the test says. Let "
                "the response return +inf where specimens fail."
            )
            findings.append(Finding("population-misfit", text, "choosing_metric.md#a-wrong-family"))
    return findings


def _require_same_samples(case: Case) -> None:
    """Raise unless sample i of a draw is the same specimen in all predictions."""
    shapes = [c.predicted.shape for c in case.conditions]
    attributes = [c.attributes for c in case.conditions]
    ids = {attrs["specimens_id"] for attrs in attributes if "specimens_id" in attrs}
    if len(set(shapes)) == 1 and len(ids) <= 1:
        return
    got = f"shapes {shapes}" if len(set(shapes)) > 1 else "different specimens"
    raise ValueError(
        f"specimens: got the same labels in several conditions, predicted with {got}, expected the "
        "same specimens in all; pass the same inputs, n_samples, n_draws and random_seed to "
        "prb.predict, and stored=False if designs differ"
    )
