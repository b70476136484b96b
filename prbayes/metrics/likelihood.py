"""The negative mean log-likelihood, estimated from a kernel density or a histogram."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import numpy as np

from prbayes._validate import Floats, Indices, Names, Shape, flag, real_array
from prbayes.metrics.base import Discrepancy, Metric, Minimum
from prbayes.metrics.density import (
    CellwiseDiscrepancy,
    DensityEstimator,
    GaussianKDE,
    density_estimator,
    likelihood_bandwidth,
)
from prbayes.metrics.readings import Readings, with_values
from prbayes.readings import COUNTS
from prbayes.readings.base import Count, ReadingDistribution, as_tuples, fixed


@dataclass(frozen=True, kw_only=True, repr=False)
class LogLikelihood(Metric):
    r"""Log-likelihood of each specimen's record, or of a kernel density.

    Without ``density`` it is the log-likelihood by specimen, exact up to the error of an emulator,

    .. math:: \log L(\theta) = \sum_i \log \int p(y_i \mid f(x))\, p(x \mid \theta)\, dx,

    with all readings :math:`y_i` of specimen i, also of several simulators, and the response f. It
    needs a deterministic response and continuous inputs, has no epsilon, and serves every sampler
    of PyMC. It compares no two samples, so that it has no direct call.

    With ``density`` it is the negative mean log-likelihood
    :math:`-\frac{1}{N} \sum_i \log p(z_i)` of the observed values under a density estimate of the
    simulated ones (eq. 3 of [1]_). Only the simulated side is smoothed, which makes the fitted
    population narrower by about :math:`h^2/(2\sigma^2)`; the default bandwidth keeps that below a
    tenth of the sampling error of a normal population.

    Parameters
    ----------
    error : float, array_like, model variable or ReadingDistribution, optional
        Standard deviation of the normal error of a reading, in units of the output: one number, one
        for each output, (m,), or one for each reading, (N,) or (N, m). A variable of the model is
        estimated. Readings are exact by default. `prbayes.readings` has errors with two parts and
        counts.
    relative : bool
        Whether ``error`` is a share of the output.
    bias : float, array_like or model variable, optional
        Mean of the error, as for ``error``: a reading is the response plus this number plus a
        normal error. A variable needs an ``error``, and a prior that is narrower than the
        population of responses, from which data do not distinguish it.
    gross_errors : bool, float or model variable
        Share of specimens with a gross error, whose readings are uniform over twice the range of
        each output. True adds the variable ``{name}_gross_errors`` with a Beta(1, 9) prior.
    censored : tuple of (lower, upper), optional
        Limits of the readings, numbers or arrays as for ``error``, None for no limit: a value at or
        beyond a limit means only that the output is there.
    selected : tuple of (lower, upper), optional
        Limits within which a specimen was measured at all, such as those of a proof test: numbers,
        or one for each output, None for no limit. Specimens whose reading, error included, lies
        beyond a limit were never seen. It needs known errors, the same for all specimens.
    rounded : float or array_like, optional
        Width to which values were rounded, as for ``error``. Also the width of an interval whose
        middle is the reading.
    density : GaussianKDE or Histogram, optional
        Estimates the simulated density. A `GaussianKDE` without bandwidth has the default one.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, or measurement arguments are given beside ``density``;
        TypeError when called, or prepared against observed values, without a density.

    References
    ----------
    .. [1] Oh et al. (2019), eq. 3, doi:10.1007/s00158-019-02288-6.
    .. [2] Papadimas, N. and T. Dodwell (2021), A hierarchical Bayesian approach for calibration of
       stochastic material models, Data-Centric Engineering 2, e20, doi:10.1017/dce.2021.20.
    .. [3] Hogg, D. W., A. D. Myers and J. Bovy (2010), Inferring the eccentricity distribution,
       Astrophys. J. 725, 2166-2175, doi:10.1088/0004-637X/725/2/2166.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.stats import norm
    >>> simulated = norm.ppf((np.arange(4000) + 0.5) / 4000)
    >>> metric = LogLikelihood(density=GaussianKDE())
    >>> value = metric(simulated, [-1.0, 0.0, 1.0])
    >>> bool(np.isclose(value, -norm.logpdf([-1, 0, 1]).mean(), rtol=0.05))
    True
    """

    error: Any = None
    relative: bool = False
    bias: Any = None
    gross_errors: Any = False
    censored: tuple[Any, Any] | None = None
    selected: tuple[Any, Any] | None = None
    rounded: Any = None
    density: DensityEstimator | None = None
    minimum: ClassVar[Minimum] = Minimum.QUADRATIC
    counts_failures: ClassVar[bool] = True
    likelihood: ClassVar[bool] = True
    distance: ClassVar[bool] = False
    # Arguments with an index, which is compared with that of the observed values.
    _labelled: ClassVar[tuple[Any, ...]] = ()
    tail_responses: ClassVar[int] = 300  # enough for standard errors that are right to a tenth

    def __post_init__(self) -> None:
        flag(self.relative, "LogLikelihood: relative")
        limits = self.censored
        parts = [self.error, self.bias, self.rounded]
        parts += limits if isinstance(limits, tuple | list) else ()
        labelled = tuple(x for x in parts if hasattr(x, "iloc") or hasattr(x, "indexes"))
        labelled += getattr(self.error, "labelled", ())
        object.__setattr__(self, "_labelled", labelled)
        gross = self.gross_errors
        if isinstance(gross, int | float) and not isinstance(gross, bool) and not 0 < gross < 1:
            raise ValueError(
                f"LogLikelihood: gross_errors: got {gross!r}, expected True, a share in (0, 1) or "
                "a variable of the model"
            )
        measurement = {
            "error": fixed(self.error, "LogLikelihood: error"),
            "bias": fixed(self.bias, "LogLikelihood: bias", positive=False),
            "censored": _limits(limits, "censored"),
            "selected": _limits(self.selected, "selected"),
            "rounded": fixed(self.rounded, "LogLikelihood: rounded"),
        }
        for name, value in measurement.items():
            object.__setattr__(self, name, value)
        _refuse_conflicts(self)
        if self.density is None:
            return
        unused = [name for name, value in measurement.items() if value is not None]
        unused += ["gross_errors"] if gross is not False else []
        if unused:
            raise ValueError(
                f"LogLikelihood: got density= with {unused}, expected one of them: a kernel "
                "density has no single readings; leave density= out"
            )
        density = density_estimator(self.density, likelihood_bandwidth)
        object.__setattr__(self, "density", density)

    @property
    def count(self) -> Count | None:
        """Distribution of the readings if these are counts."""
        return self.error if isinstance(self.error, Count) else None

    @property
    def roles(self) -> dict[str, Any]:
        """Parameters of the readings' distribution by role: numbers, or variables of the model."""
        role = "relative" if self.relative else "error"
        is_plain = not isinstance(self.error, ReadingDistribution)
        roles = {role: self.error} if is_plain else self.error.roles
        return {key: x for key, x in (roles | {"bias": self.bias}).items() if x is not None}

    def __repr__(self) -> str:
        """Show the arguments that differ from their defaults."""
        changed = [f.name for f in fields(self) if getattr(self, f.name) != f.default]
        arguments = ", ".join(f"{name}={getattr(self, name)!r}" for name in changed)
        return f"LogLikelihood({arguments})"

    @property
    def by_specimen(self) -> bool:  # type: ignore[override]
        """Whether it is the log-likelihood by specimen, which compares no two samples."""
        return self.density is None

    def of_frequencies(self, rows: Indices, n: int) -> LogLikelihood:
        """Return the likelihood of data with frequencies: specimen i has row ``rows[i]`` of n.

        Arrays with an element for each row get one for each specimen.
        """

        def of_specimens(value: Any) -> Any:
            array = np.asarray(value, dtype=np.float64) if isinstance(value, tuple) else np.empty(0)
            return as_tuples(array[rows]) if len(array) == n else value

        return mapped_metric(self, of_specimens)

    def readings(
        self, values: Floats, unknown: Mapping[str, Any] | None = None, event: Shape = ()
    ) -> Readings:
        """Return measured outputs, (N, m), with their errors, limits and rounding.

        ``unknown`` has numbers for the `roles` that are model variables; without them an error is
        one, and a bias zero. ``event`` is () for one output without an axis, else (m,). Raises
        ValueError if an argument does not fit the shape of the values, or a count is impossible.
        """
        roles = self.roles | dict(unknown or {})

        def full(value: Any, name: str, default: float) -> Floats:
            if hasattr(value, "owner"):
                value = float(name != "bias")
            array = np.asarray(default if value is None else value, dtype=np.float64)
            # With one output an array with a number for each reading has the shape (N,).
            array = array[:, None] if not event and array.ndim == 1 else array
            try:
                return np.array(np.broadcast_to(array, values.shape))
            except ValueError:
                raise ValueError(
                    f"LogLikelihood: {name}: got shape {np.shape(value)}, expected a number, or "
                    f"shape {(len(values), *event)}, one for each reading"
                    + (f", or {event}, one for each output" if event else "")
                ) from None

        count = self.count
        sd = full(roles.get("error"), "error", 0.0)
        low, high = self.censored or (None, None)
        lowest = full(low, "censored", -np.inf)
        highest = full(high, "censored", np.inf)
        is_low = values <= lowest
        is_high = values >= highest
        bias = full(roles.get("bias"), "bias", 0.0)
        lower = np.where(is_high, highest, np.where(is_low, -np.inf, np.nan)) - bias
        upper = np.where(is_high, np.inf, np.where(is_low, lowest, np.nan)) - bias
        readings = Readings(
            values=np.where(is_low | is_high, np.nan, values - bias),
            error=np.where(np.isfinite(sd), sd, 0.0) if count is None else np.zeros(values.shape),
            relative=full(roles.get("relative"), "error", 0.0),
            step=full(self.rounded, "rounded", 0.0),
            lower=lower,
            upper=upper,
            bias=bias,
            family=np.full(values.shape, -1),
            size=full(None if count is None else count.size, "error", 1.0),
            parameter=np.ones(values.shape) if count is None else full(sd, "error", 1.0),
        )
        if count is None:
            return readings
        _refuse_impossible(values, count.highest(readings.size))
        code = COUNTS.index(type(count))
        return with_values(replace(readings, family=np.full(values.shape, code)), values)

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        if self.density is None:
            raise TypeError(
                "LogLikelihood: got density=None, expected prb.GaussianKDE() or prb.Histogram(): "
                "the log-likelihood by specimen compares no two samples; pass "
                "prb.LogLikelihood(density=prb.GaussianKDE())"
            )
        cells = self.density.cells(observed, weights)
        density = cells.density(observed, weights)
        reading = cells.reading(observed, weights)
        return LikelihoodDiscrepancy(self, observed, weights, cells, density, reading)


def mapped_metric(metric: LogLikelihood, function: Callable[[Any], Any]) -> LogLikelihood:
    """Return the likelihood with a function applied to the numbers that describe readings."""
    is_plain = not isinstance(metric.error, ReadingDistribution)
    return replace(
        metric,
        error=function(metric.error) if is_plain else metric.error.mapped(function),
        bias=function(metric.bias),
        rounded=function(metric.rounded),
        censored=metric.censored and tuple(map(function, metric.censored)),
    )


def _limits(limits: Any, name: str) -> tuple[Any, Any] | None:
    """Return a pair of limits, numbers or nested tuples; raise if it is none."""
    if limits is None:
        return None
    is_pair = isinstance(limits, tuple | list) and len(limits) == 2
    if not is_pair or all(x is None for x in limits):
        raise ValueError(
            f"LogLikelihood: {name}: got {limits!r}, expected (lower, upper), one of which may be "
            "None"
        )
    label = f"LogLikelihood: {name}"
    low, high = (x if x is None else as_tuples(real_array(x, label)) for x in limits)
    return low, high


def _refuse_conflicts(metric: LogLikelihood) -> None:
    """Raise if arguments do not describe one distribution of the readings."""
    arguments = {
        name: getattr(metric, name) for name in ("bias", "censored", "selected", "rounded")
    }
    has_gross_errors = metric.gross_errors is not False
    arguments |= {"relative": metric.relative or None, "gross_errors": has_gross_errors or None}
    labels = [f"{name}=" for name, value in arguments.items() if value is not None]
    refused = ", ".join(labels if metric.count is not None else ["relative="] * metric.relative)
    if isinstance(metric.error, ReadingDistribution) and refused:
        raise ValueError(
            f"LogLikelihood: got error={metric.error!r:.60} with {refused}, expected the "
            f"distribution alone; leave {refused} out"
        )
    variables = [x for x in (*metric.roles.values(), metric.gross_errors) if hasattr(x, "owner")]
    if metric.selected is not None and (variables or metric.gross_errors is True):
        raise ValueError(
            "LogLikelihood: selected: got an unknown error or gross errors beside it, expected "
            "known errors, with which the share of measured specimens is computed; pass numbers"
        )
    if hasattr(metric.bias, "owner") and metric.error is None:
        raise ValueError(
            "LogLikelihood: bias: got a variable without error=, expected both: exact readings "
            "with an unknown bias have no density; pass error= with the standard deviation"
        )


def _refuse_impossible(values: Floats, highest: Floats) -> None:
    """Raise if measured values, (N, m), are no counts up to the highest ones."""
    is_bad = (values < 0) | (values > highest) | (values != np.round(values))
    is_bad &= np.isfinite(values)
    if is_bad.any():
        row, column = np.argwhere(is_bad)[0].tolist()
        most = highest[row, column]
        limit = f" up to {most:g}" if np.isfinite(most) else ""
        raise ValueError(
            f"error: got the reading {values[row, column]:g} of specimen {row}, expected whole "
            f"numbers from 0{limit}, as counts are; pass counts and their exposure, not shares"
        )


@dataclass(frozen=True, eq=False)
class LikelihoodDiscrepancy(CellwiseDiscrepancy):
    """The mean log-likelihood of fixed observed values."""

    # Weights of the cells, (m,) or (..., m): ``reading @ g`` is the mean at the observed values of
    # a function g of the cells.
    reading: Floats
    _by_data_set: ClassVar[Names] = ("weights", "density", "reading")

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Self:
        """Return the same metric, on the same cells, against other values; for resampling."""
        target = super().with_observed(observed, weights)
        return replace(target, reading=self.cells.reading(target.observed, target.weights))

    @property
    def constants(self) -> tuple[Any, ...]:
        """The floor of the density, and the reading at the observed values."""
        return self.cells.floor, self.reading

    def terms(self, density: Any, constants: tuple[Any, ...], xp: Any) -> Any:
        """Return the terms of minus the weighted mean of log p at the observed values."""
        floor, reading = constants
        return -(xp.log(self.floored(density, floor)) * reading)


def kernel_width(target: Discrepancy) -> float:
    """Return the standard deviation of the kernel of a log-likelihood; zero if it has none."""
    if not isinstance(target, LikelihoodDiscrepancy):
        return 0.0
    return float(getattr(target.cells, "bandwidth", 0.0))


def with_narrower_kernel(target: Discrepancy) -> Discrepancy:
    """Return a log-likelihood with a kernel of half the width; others unchanged."""
    width = kernel_width(target)
    if not width:
        return target
    metric = LogLikelihood(density=GaussianKDE(0.5 * width))
    return metric.against(target.observed, target.weights)
