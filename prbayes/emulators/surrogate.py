"""`Surrogate`: a surface through a few runs of a response, with its error and ranges."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prbayes._display import Shown, View, without_constructor
from prbayes._finding import Finding, report
from prbayes._progress import shown
from prbayes._stats import positive_scale
from prbayes._validate import (
    Bools,
    Floats,
    Function,
    Seed,
    Shape,
    StrPath,
    complete_rows,
    file_path,
    finite_or_nan,
    flag,
    plain_text,
    positive_integer,
    seed_number,
    share,
)
from prbayes.emulators.emulator import ROUGH_CANDIDATES, Emulator, fit_emulator, with_failures
from prbayes.emulators.following import Follower, fit_follower
from prbayes.emulators.io import read_surrogate, write_surrogate
from prbayes.emulators.radial_basis import RadialBasis
from prbayes.emulators.ranges import Ranges, read_ranges
from prbayes.emulators.selection import CrossValidation, points_needed
from prbayes.emulators.surfaces import Surface, as_surface
from prbayes.emulators.table import RunRecord, RunTable, read_table
from prbayes.numerics.points import sobol
from prbayes.response.call import CallSettings, Points, Tally, compute, respond
from prbayes.response.failures import Abort, OnFailure, Replace, ResponseError
from prbayes.response.outputs import Outputs, is_missing
from prbayes.response.response import (
    check_call_settings,
    refuse_misfit,
    refuse_other_runs,
    refuse_uncallable,
)
from prbayes.response.store import Store, StoreError

_log = logging.getLogger("prbayes")


@dataclass(frozen=True, eq=False)
class DesignSurface:
    """A surface through the usable runs of a design, or one for each output."""

    domain: Ranges
    unit: Floats  # (n, d): the design in the unit cube
    usable: Bools  # (n,): whether all outputs of a run are finite
    event: Shape  # shape of a response
    emulator: Emulator  # emulator, fitted in the unit cube
    # The coarse response that the surface follows, and the emulator that has it as an input.
    coarse: Function | None = None
    follower: Follower | None = None
    # Names of the outputs if the response returns a mapping, else None.
    outputs: Outputs | None = None

    @classmethod
    def of(
        cls,
        model: Any,
        domain: Ranges,
        points: Floats,
        responses: Floats,
        coarse: Function | None = None,
        coarse_values: Floats | None = None,
        seed: int = 0,
    ) -> DesignSurface:
        """Fit a surface to runs, which follows a coarse response, (n,), if errors are smaller."""
        unit, usable = domain.scaled(points), _usable(responses)
        x, y = unit[usable], responses[usable].reshape(int(usable.sum()), -1)
        # With a coarse response the folds of cross-validation are fixed, so that a surrogate read
        # from a file makes the same choice whether to follow it.
        seed = seed if coarse_values is None else 0
        surface = as_surface(model)
        emulator = fit_emulator(x, y, tried=[surface], seed=seed)
        fitted = cls(domain, unit, usable, responses.shape[1:], emulator)
        if coarse_values is None:
            return fitted
        left_out = emulator.left_out[:, 0]
        follower = fit_follower(x, y[:, 0], coarse_values[usable], left_out, surface)
        if follower is None:
            return fitted
        return replace(fitted, coarse=coarse, follower=follower)

    def __call__(self, columns: Floats) -> Floats:
        """Return values at rows inside the ranges, (n,) or (n, m)."""
        # Rounding may move a point at an edge out of the unit cube.
        unit = np.clip(self.domain.scaled(columns), 0.0, 1.0)
        values = self.emulator.values(unit).reshape(-1, *self.event)
        if self.coarse is None or self.follower is None:
            return values
        coarse = _coarse_at("surrogate", self.coarse, self.domain, columns)
        is_finite = np.isfinite(coarse)
        n_lost = (~is_finite).sum()
        if n_lost:
            report(
                Finding(
                    "coarse-without-number",
                    f"surrogate: coarse: got no number at {n_lost} of {len(unit)} points, where "
                    "the surface is used without it; repair the coarse response if there are "
                    "many.",
                )
            )
        values[is_finite] = self.follower.values(unit[is_finite], coarse[is_finite])
        return values

    @property
    def left_out(self) -> Floats:
        """Left-out errors, (n,) or (n, m); NaN without a response."""
        left_out = np.full((len(self.usable), *self.event), np.nan)
        errors = self.emulator.left_out.copy()
        if self.follower is not None:
            errors[self.follower.rows] = self.follower.emulator.left_out
        left_out[self.usable] = errors.reshape(-1, *self.event)
        return left_out

    def probes(self) -> Floats:
        """Return values at 64 fixed points, which identify the surface."""
        return self(self.domain.at(sobol(64, self.domain.dimensions, 0)))

    @cached_property
    def _tree(self) -> Any:
        """The k-d tree of the usable runs."""
        from scipy.spatial import cKDTree

        return cKDTree(self.unit[self.usable])

    def nearby(self, residuals: Floats, columns: Floats) -> Floats:
        """Return the residuals of the nearest usable runs, (n, k, ...)."""
        usable, unit = residuals[self.usable], self.domain.scaled(columns)
        # At least eight residuals determine their root mean square to a quarter, 1 / sqrt(2 k).
        k = min(len(usable), 4 * (unit.shape[1] + 1))
        # Points that are not finite count as outside, so that any neighbours will do.
        _, nearest = self._tree.query(np.where(np.isfinite(unit), unit, 0.5), k=k)
        return np.asarray(usable[nearest])


@without_constructor
@dataclass(frozen=True, eq=False, repr=False)
class Surrogate(RunRecord, Shown):
    """A surface through runs of an expensive response, to be called in its place.

    ``fit`` and ``load`` construct it. Like the response it takes arrays of any leading shape;
    `Simulator` and `predict` accept it. Each of several outputs has a surface, all through the same
    runs; they are the last axis of the result, or a mapping where the response returns one. Outside
    its ranges, and where the nearest design point failed, it returns what ``outside`` specifies,
    and logs a warning.

    Attributes
    ----------
    names : tuple of str
        Of the inputs.
    points : ndarray, shape (n, columns)
        The design.
    responses : ndarray, shape (n,) or (n, m)
        In its own units; NaN or +inf where it failed.
    model : object
        The kind of surface.
    outside : OnFailure
    n_runs : int
        Responses computed for the design; those found in a store are not counted.
    error : CrossValidation
    noise : int or None
        The seed of residual noise, see `with_error`.
    coarse : callable or None
        The coarse response that it follows, and calls; pickled with it, if possible.

    See Also
    --------
    prbayes.Reweighted : computes a few hundred responses once, and needs no surrogate.

    References
    ----------
    .. [1] Forrester, A., A. Sobester and A. Keane (2008), Engineering Design via Surrogate
       Modelling, Wiley.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> surrogate = prb.Surrogate.fit(lambda x, y: np.sin(x) * y, {"x": (0, 3), "y": (1, 2)}, 128)
    >>> surrogate(1.0, np.array([1.2, 1.5])).round(2)
    array([1.01, 1.26])
    >>> bool(surrogate.error.relative < 0.01)
    True
    """

    model: Any
    outside: OnFailure
    n_runs: int
    error: CrossValidation
    noise: int | None = None
    coarse: Function | None = None
    # A list that is empty until the first warning of points outside the ranges.
    _warned: list[bool] = field(repr=False, default_factory=list)
    _surface: DesignSurface = field(repr=False, kw_only=True)

    @classmethod
    def fit(
        cls,
        response: Function,
        inputs: Mapping[str, Any] | Sequence[Any],
        n: int,
        *,
        model: Any = None,
        coarse: Function | None = None,
        outside: OnFailure | None = None,
        points: str = "even",
        prob: float = 0.999,
        name: str = "surrogate",
        executor: Executor | None = None,
        store: StrPath | None = None,
        version: str | None = None,
        on_failure: OnFailure | None = None,
        retry_failed: bool = False,
        random_seed: Seed = 0,
        progressbar: bool = True,
    ) -> Surrogate:
        """Compute the response on a scrambled Sobol design, and fit a surface.

        With many inputs nearly all corners of the ranges are far from the populations: prefer
        ``points="predictive"`` and a `GaussianProcess`.

        Parameters
        ----------
        response : callable
            As for `Simulator`: one array per input, any leading shape; or in `scalar`. Several
            outputs of a run are in the last axis, or in a mapping.
        inputs : mapping or sequence
            One entry per argument of the response, in its order, by name if you like: ``(low,
            high)``, in the input's own units; a ``.dist()`` or a variable of the model on the
            context, which covers the central ``prob`` of its prior predictive distribution; or
            a number, which stays as it is.
        n : int
            Number of design points. With the same seed those of a smaller n are among them.
        model : object, optional
            `RadialBasis` (default), `Polynomial`, `GaussianProcess`, which is better with many
            inputs, or any regressor with ``fit(X, y)`` and ``predict(X)``, as those of
            scikit-learn. A copy is fitted to inputs in [0, 1], responses of mean 0 and spread 1.
        coarse : callable, optional
            A cheap approximation of a response of one output, such as that of a coarser mesh. The
            surrogate follows, and calls, it if that reduces the cross-validated error. Where it
            raises, or is not finite, the surface continues without it, with a warning.
        outside : OnFailure, optional
            `Replace` (default): points outside the ranges give its value, NaN, with a warning. A
            simulator with `Reweighted` reports them as lost mass, and refuses an answer that
            depends on them. `Abort`: they raise, for `Resimulated`.
        points : {"even", "predictive"}
            The design: even in all ranges, or with each random input distributed as its prior
            predictive distribution inside its range.
        prob : float
            The central probability that ranges of distributions cover.
        name : str
            For messages, and of the store.
        executor, store, version, on_failure, retry_failed
            As for `Reweighted`. A point that fails in the end is left out of the fit; the surrogate
            then fails where that is the nearest point.
        random_seed : int, sequence of int, numpy.random.Generator or None
        progressbar : bool
            Whether work of more than two seconds shows a bar on stderr.

        Returns
        -------
        Surrogate

        Raises
        ------
        TypeError, ValueError
            If an argument is not as described, or n is too small for the surface; before the
            response is computed.
        ResponseError
            If the response raises, too few points remain, or three to five runs that are computed
            again differ from the first ones.

        Examples
        --------
        >>> import numpy as np, pymc as pm, prbayes as prb
        >>> with pm.Model() as model:
        ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        ...     surrogate = prb.Surrogate.fit(np.square, [x], 32, model=prb.surrogate.Polynomial(2))
        ...     data = [0.5, 1.0, 4.0]
        ...     y = prb.Simulator("y", surrogate, x, metric=prb.AreaMetric(), observed=data)
        """
        plain_text(name, "Surrogate.fit: name")
        model = RadialBasis() if model is None else model
        outside = Replace() if outside is None else outside
        policy = Abort() if on_failure is None else on_failure
        _refuse_wrong(name, response, model, outside, points)
        check_call_settings(executor, store, version, policy)
        flag(retry_failed, f"{name}: retry_failed")
        share(prob, f"{name}: prob")
        seed = seed_number(random_seed, f"{name}: random_seed")
        domain, predictive = read_ranges(name, inputs, prob, seed)
        refuse_misfit(name, response, domain.sizes)
        n_needed = points_needed(model, domain.dimensions)
        positive_integer(n, f"{name}: n", minimum=n_needed)
        design = domain.at(_unit_points(name, domain, predictive, n, points, seed))

        # Compute the coarse responses first, because an error in them then costs no run.
        coarse_values = None if coarse is None else _first_coarse(name, coarse, domain, design)
        database = None
        if store is not None:
            database = Store(store, name, columns=design.shape[1], version=version)
        settings = CallSettings(
            name, response, executor, database, policy, retry_failed, outputs=None,
            columns=domain.column_names,
        )  # fmt: skip
        tally, runs = Tally(), Points(domain.arguments(design), domain.varying)
        with shown(progressbar):
            _learn_names(settings, runs, tally)
            responses = respond(settings, runs, tally)
            if tally.computed >= n:  # runs of a store are checked when they are read
                refuse_other_runs(settings, runs, responses, tally)
        _refuse_unfit(name, responses, n_needed, has_coarse=coarse is not None)

        # Fit the surface, and estimate its error.
        surface = DesignSurface.of(model, domain, design, responses, coarse, coarse_values, seed)
        if coarse is not None and surface.coarse is None:
            _log.info("%s: the coarse response does not improve the fit, and is not used", name)
        residuals = surface.left_out
        surrogate = cls(
            *(domain, design, responses, model, outside, tally.computed),
            error=CrossValidation(residuals, _spread(responses[surface.usable])),
            coarse=surface.coarse,
            _surface=replace(surface, outputs=tally.named),
        )
        if predictive is not None:
            values = values_inside(surrogate, predictive)
            error = CrossValidation(residuals, _spread(values[_usable(values)]))
            surrogate = replace(surrogate, error=error)
        _log.info(
            "%s: %d responses computed; cross-validated error %s",
            *(name, tally.computed, surrogate.error),
        )
        return surrogate

    @classmethod
    def from_runs(
        cls,
        inputs: Any,
        responses: Any,
        *,
        model: Any = None,
        outside: OnFailure | None = None,
        random_seed: Seed = 0,
    ) -> Surrogate:
        """Fit a surface to runs that were computed before; its ranges are those of the runs.

        Parameters
        ----------
        inputs, responses
            As for `Runs`.
        model : object, optional
            As for `fit`; by default the best one of two kinds of `GaussianProcess` and
            quintic splines.
        outside : OnFailure, optional
        random_seed : int, sequence of int, numpy.random.Generator or None
            Of the parts that cross-validation leaves out.

        Returns
        -------
        Surrogate

        Raises
        ------
        TypeError, ValueError
            As for `Runs`.

        Examples
        --------
        >>> import numpy as np, prbayes as prb
        >>> x = np.linspace(0, 3, 20)
        >>> prb.Surrogate.from_runs({"x": x}, np.sin(x))(1.0).round(3)
        np.float64(0.841)
        """
        name = "Surrogate.from_runs"
        table = read_table(name, inputs, responses)
        return cls.of_table(name, table, model, outside, random_seed)

    @classmethod
    def of_table(
        cls,
        name: str,
        table: RunTable,
        model: Any = None,
        outside: OnFailure | None = None,
        random_seed: Seed = 0,
    ) -> Surrogate:
        """Fit a surface to the runs of a table; arguments as for `from_runs`."""
        outside = Replace() if outside is None else outside
        domain, design, values = table.domain, table.points, table.responses
        seed = seed_number(random_seed, f"{name}: random_seed")
        models = ROUGH_CANDIDATES if model is None else (model,)
        for candidate in models:
            refuse_wrong_surface(name, candidate, outside)
        # Of several surfaces those that need more runs are left out.
        needed = [points_needed(m, design.shape[1]) for m in models]
        _refuse_unfit(name, values, min(needed))
        n_usable = _usable(values).sum()
        models = tuple(m for m, n in zip(models, needed, strict=True) if n <= n_usable)
        try:
            surfaces = [DesignSurface.of(m, domain, design, values, seed=seed) for m in models]
        except np.linalg.LinAlgError:
            counts = dict(
                zip(domain.column_names, [len(set(column)) for column in design.T], strict=True)
            )
            raise ValueError(
                f"{name}: inputs: got runs that determine no surface, with numbers of different "
                f"values {counts}, expected at least 3, and no input that follows from others; "
                "make a table for each value of an input with two, or leave the input out"
            ) from None
        spread = _spread(values[surfaces[0].usable])
        unit = np.where(np.asarray(spread) > 0, spread, 1.0)
        # The 90 % quantile is compared, because the largest residuals are those of the most extreme
        # runs.
        errors = [np.nanquantile(np.abs(s.left_out / unit), 0.9, axis=0).sum() for s in surfaces]
        best = int(np.argmin(errors))
        return cls(
            *(domain, design, values, models[best], outside, 0),
            error=CrossValidation(surfaces[best].left_out, spread),
            _surface=replace(surfaces[best], outputs=table.labels),
        )

    def to_dataframe(self) -> Any:
        """Return the runs as a DataFrame: a column for each number of the inputs and outputs."""
        import pandas as pd

        values = self.responses.reshape(len(self.points), -1)
        m = values.shape[1]
        labels = [f"response[{i}]" for i in range(m)] if m > 1 else ["response"]
        columns = [
            *self.domain.column_names,
            *(labels if self._surface.outputs is None else self._surface.outputs.names),
        ]
        return pd.DataFrame(np.concatenate([self.points, values], axis=1), columns=columns)

    def to_view(self) -> View:
        """Return what a reader sees."""
        values = self.responses.reshape(len(self.points), -1)
        n_failed = int((~complete_rows(values)).sum())
        ends = [*zip(self.domain.low, self.domain.high, strict=True)]
        finite = [column[np.isfinite(column)] for column in values.T]
        ends += [(column.min(), column.max()) for column in finite]
        errors = [("", "")] * len(self.domain.low)
        pairs = zip(np.atleast_1d(self.error.rms), np.atleast_1d(self.error.relative), strict=True)
        errors += [(f"{rms:.3g}", f"{relative:.2g} sd") for rms, relative in pairs]
        rows = [
            [name, f"{low:.6g}", f"{high:.6g}", *error]
            for name, (low, high), error in zip(self.to_dataframe(), ends, errors, strict=True)
        ]
        heading = (
            f"Surrogate: {self.model!r:.60} through {len(values)} runs, {n_failed} of them without "
            "response"
        )
        return View(heading, ["", "lowest", "highest", "left-out error", "relative"], rows)

    def __call__(self, *inputs: ArrayLike) -> Any:
        """Return predictions of the response, (...) or (..., m), or a mapping of them.

        Parameters
        ----------
        *inputs : array_like, shapes (..., *event)
            One per input.
        """
        columns, batch = self.domain.columns(inputs)
        is_outside = self.domain.outside(columns)
        bad = is_outside.any(axis=1)
        event = self.responses.shape[1:]
        values = np.full((len(columns), *event), np.nan)
        values[~bad] = values_inside(self, columns[~bad])
        if bad.any():
            text = f"surrogate: {self.domain.complaint(columns, is_outside)}"
            if isinstance(self.outside, Abort):
                raise ValueError(
                    f"{text}; fit it on wider ranges, or with outside=prb.response.Replace(), "
                    "which gives NaN there"
                )
            replacement = cast(Replace, self.outside).value
            values[bad] = replacement
            # The warning appears once, because a sampler calls the surrogate thousands of times,
            # and a simulator reports the lost mass itself.
            level = logging.DEBUG if self._warned else logging.WARNING
            once = f"{text}; they give {replacement}; this warning appears once."
            report(Finding("outside-ranges", once), level=level)
            self._warned[:] = [True]
        return with_output_labels(self, values, batch)

    def local_error(self, *inputs: ArrayLike) -> Floats:
        """Return the root mean square of the cross-validation residuals nearby.

        Parameters
        ----------
        *inputs : array_like
            One per input, of the shape of a batch, a multivariate one with its event axis last.

        Returns
        -------
        ndarray, shape (...) or (..., m)
            In units of the response.

        Raises
        ------
        TypeError, ValueError
            If the inputs are not those of the surrogate.
        """
        columns, batch = self.domain.columns(inputs)
        residuals = self._surface.nearby(self.error.residuals, columns)
        rms = np.sqrt((residuals**2).mean(axis=1))
        return rms.reshape((*batch, *self.responses.shape[1:]))

    def with_error(self, random_seed: Seed = 0) -> Surrogate:
        """Return the surrogate with its error added.

        The error is a cross-validation residual from nearby, with either sign, selected by a hash
        of the input, so that the same input has the same error in every call. Populations become
        wider by the surrogate's error: for predictions that are not to be more certain than the
        surrogate, and for calibrations with `Reweighted`. The noise jumps from input to input, so
        that the discrepancy is no longer smooth under `Resimulated`.

        Parameters
        ----------
        random_seed : int, sequence of int, numpy.random.Generator or None

        Returns
        -------
        Surrogate

        Raises
        ------
        TypeError, ValueError
            If the seed is none.

        Examples
        --------
        >>> import numpy as np, prbayes as prb
        >>> surrogate = prb.Surrogate.fit(lambda x: np.sin(9 * x), {"x": (0, 3)}, 24).with_error()
        >>> bool(surrogate(1.0) == surrogate(1.0))
        True
        """
        return replace(self, noise=seed_number(random_seed, "with_error: random_seed"))

    def save(self, path: StrPath) -> None:
        """Write design, responses and configuration as netCDF.

        Parameters
        ----------
        path : path-like

        Raises
        ------
        ValueError
            If the path is none, or its folder does not exist.
        OSError
            If the file cannot be written.
        """
        path = file_path(path, "path")
        if not path.absolute().parent.is_dir():
            raise ValueError(
                f"path: got {path}, whose folder does not exist, expected one that does"
            )
        write_surrogate(path, self, self._surface.probes())

    @classmethod
    def load(
        cls,
        path: StrPath,
        *,
        model: Any = None,
        coarse: Function | None = None,
    ) -> Surrogate:
        """Read what `save` wrote, and fit the surface again.

        No response is computed, and nothing is unpickled.

        Parameters
        ----------
        path : path-like
        model : object, optional
            The surface or regressor, where it is not one that ships with prbayes: a file contains
            its design, not its code.
        coarse : callable, optional
            The coarse response, where the surrogate follows one: for the same reason. It is called
            at the design. A surrogate that follows none needs none.

        Returns
        -------
        Surrogate

        Raises
        ------
        StoreError
            If the file cannot be read, is no surrogate, or has another format.
        TypeError, ValueError
            If a regressor is needed, or the surface is not that which was saved.
        """
        saved = read_surrogate(file_path(path, "path"))
        model = saved.model if model is None else model
        if model is None:
            raise TypeError(
                f"Surrogate.load: got no model, expected the {saved.kind} it was fitted with; "
                "pass model="
            )
        if saved.follows_coarse and coarse is None:
            raise TypeError(
                "Surrogate.load: got no coarse response, expected the one that the surrogate "
                "follows: a file does not keep it; pass coarse="
            )
        fields = saved.fields
        domain, points, responses = (fields[key] for key in ("domain", "points", "responses"))
        coarse = coarse if saved.follows_coarse else None
        coarse_values = None
        if coarse is not None:
            coarse_values = _coarse_at("Surrogate.load", coarse, domain, points)
        surface = DesignSurface.of(model, domain, points, responses, coarse, coarse_values)
        spread = np.asarray(_spread(responses[surface.usable]))
        size = positive_scale(spread)
        probes, expected = surface.probes() / size, saved.probes / size
        # The tolerance is above rounding errors of another processor, and below the effect of a
        # different setting.
        if not np.allclose(probes, expected, rtol=0, atol=1e-6, equal_nan=True):
            and_coarse = ", and the same coarse response" if coarse is not None else ""
            raise ValueError(
                f"Surrogate.load: got a {type(model).__name__} that gives other values than the "
                f"{saved.kind} that was saved in this file, expected the same one with the same "
                f"settings (and a fixed random seed){and_coarse}"
            )
        surface = replace(surface, outputs=saved.outputs)
        return cls(**fields, model=model, coarse=coarse, _surface=surface)


def values_inside(surrogate: Surrogate, columns: Floats) -> Floats:
    """Return the values of a surrogate at points inside its ranges, (n,) or (n, m)."""
    surface = surrogate._surface
    if not len(columns):
        return np.empty((0, *surface.event))
    values = surface(columns)
    if surrogate.noise is not None:
        # Add one of the k nearest residuals, with either sign, selected by a hash of the input.
        residuals = surface.nearby(surrogate.error.residuals, columns)
        n, k = residuals.shape[:2]
        number, sign = np.divmod(hashed_rows(columns, surrogate.noise), np.uint64(2))
        place = (number % np.uint64(k)).astype(np.intp)
        signs = np.where(sign == 0, 1.0, -1.0).reshape(n, *(1 for _ in residuals.shape[2:]))
        values = values + residuals[np.arange(n), place] * signs
    unit = surrogate.domain.scaled(columns)
    return with_failures(values, unit, surface.unit, surrogate.responses)


def with_output_labels(surrogate: Surrogate, values: Floats, batch: Shape) -> Any:
    """Return values of rows in the shape of a batch, with the labels of the outputs."""
    values = values.reshape((*batch, *surrogate.responses.shape[1:]))
    outputs = surrogate._surface.outputs
    return values if outputs is None else outputs.by_key(values)


def hashed_rows(x: Floats, random_seed: int) -> NDArray[np.uint64]:
    """Return a pseudo-random number for each row of x, (n, d) -> (n,), equal for equal rows.

    The bits of the rows go through the finalizer of splitmix64: Steele, Lea and Flood (2014), Fast
    splittable pseudorandom number generators, doi:10.1145/2660193.2660195.
    """
    h = np.full(len(x), random_seed, dtype=np.uint64)
    # Adding 0.0 turns -0.0 into 0.0, which is equal but has other bits.
    for column in np.ascontiguousarray(x.T + 0.0):
        h = (h ^ column.view(np.uint64)) + np.uint64(0x9E3779B97F4A7C15)
        h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        h = h ^ (h >> np.uint64(31))
    return h


def _usable(responses: Floats) -> Bools:
    """Return whether all outputs of each run are finite, (n,)."""
    return ~is_missing(finite_or_nan(responses))


def _spread(values: Floats) -> Any:
    """Return the standard deviation of responses: a number, or an array for several outputs."""
    sd = values.std(axis=0)
    return float(sd) if sd.ndim == 0 else sd


def _learn_names(settings: CallSettings, points: Points, tally: Tally) -> None:
    """Determine the names of several stored outputs before any other run.

    A store contains numbers only. With a version, one of its runs is computed again, and refused if
    its outputs have changed places.
    """
    store = settings.store
    if store is None or store.version is None:
        return
    keys, values = store.known()
    if values.ndim == 1:
        return
    stored_points, have_same_constants = points.read_keys(keys)
    usable = np.flatnonzero(_usable(values) & have_same_constants)[:1]
    if not usable.size:
        return
    (again,) = respond(replace(settings, store=None), stored_points.at(usable), tally)
    (stored,) = values[usable]
    moved = np.allclose(np.sort(again), np.sort(stored)) and not np.allclose(again, stored)
    if tally.named is not None and moved:
        raise StoreError(
            f"{settings.name}: store: got a mapping with the keys {list(tally.named.names)}, whose "
            "numbers are stored in another order, expected the same one; pass another version="
        )


def _refuse_unfit(name: str, responses: Floats, needed: int, *, has_coarse: bool = False) -> None:
    """Raise if too few runs have a response, or several outputs would follow a coarse one."""
    n_usable = _usable(responses).sum()
    if n_usable < needed:
        raise ResponseError(
            f"{name}: got {n_usable} numbers from {len(responses)} responses, too few for a surface"
        )
    if has_coarse and responses.ndim > 1:
        raise ResponseError(
            f"{name}: coarse: got one number a point beside a response of {responses.shape[1]} "
            "outputs, expected a response of one; leave coarse= out, or fit a surrogate to each "
            "output"
        )


def _coarse_at(name: str, coarse: Function, domain: Ranges, columns: Floats) -> Floats:
    """Return a coarse response at points, (n,); NaN where it raises an error."""
    points = Points(domain.arguments(columns), domain.varying)
    try:
        return compute(coarse, points, tolerant=True).values
    except ResponseError as error:
        raise ResponseError(f"{name}: coarse: {error}") from None


def _first_coarse(name: str, coarse: Function, domain: Ranges, columns: Floats) -> Floats:
    """Return a coarse response at the design; raise if it cannot be computed from the inputs."""
    refuse_uncallable(name, coarse, "coarse", "fit(response, inputs, n, coarse=...)")
    values = _coarse_at(name, coarse, domain, columns)
    if not np.isfinite(values).any():
        raise ResponseError(
            f"{name}: coarse: got no number at any of {len(columns)} points, expected a response "
            "of the same inputs; repair it, or leave coarse= out"
        )
    return values


def _unit_points(
    name: str, domain: Ranges, predictive: Any, n: int, points: str, seed: int
) -> Floats:
    """Return n points of the unit cube: uniform, or distributed as the prior predictive."""
    unit = sobol(n, domain.dimensions, seed)
    if points != "predictive":
        return unit
    if predictive is None:
        raise ValueError(
            f"{name}: points: got 'predictive' for inputs that are ranges, expected a `.dist()` "
            "among them; leave points= out"
        )
    return domain.like(predictive, unit)


def _refuse_wrong(name: str, response: object, model: Any, outside: object, points: object) -> None:
    """Raise if an argument of `Surrogate.fit` has a wrong type."""
    refuse_uncallable(name, response, order="fit(response, inputs, n)")
    refuse_wrong_surface(name, model, outside)
    designs = ("even", "predictive")
    if points not in designs:
        raise ValueError(f"{name}: points: got {points!r:.60}, expected one of {designs}")


def refuse_wrong_surface(name: str, model: Any, outside: object) -> None:
    """Raise if a model is no surface, or the policy outside the ranges is none."""
    is_regressor = hasattr(model, "fit") and hasattr(model, "predict")
    is_surface = isinstance(model, Surface) or is_regressor
    if isinstance(model, type) or not is_surface:
        raise TypeError(
            f"{name}: model: got {model!r:.60}, expected prb.surrogate.RadialBasis(), "
            "prb.surrogate.Polynomial(), or a regressor (an object, not a class) with fit(X, y) "
            "and predict(X)"
        )
    if not isinstance(outside, Abort | Replace):
        raise TypeError(
            f"{name}: outside: got {outside!r:.60}, expected prb.response.Replace() or "
            "prb.response.Abort()"
        )
