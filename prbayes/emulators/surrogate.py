"""`Surrogate`: a surface through a few runs of a response, that knows its error and limits."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prbayes._finding import Finding, report
from prbayes._progress import shown
from prbayes._validate import (
    Floats,
    Seed,
    file_path,
    flag,
    plain_text,
    positive_integer,
    seed_number,
    share,
)
from prbayes.emulators.cross_validation import CrossValidation, cross_validated, points_needed
from prbayes.emulators.hashed_noise import hashed_rows
from prbayes.emulators.io import Kept, read, settings_of, shipped, write
from prbayes.emulators.multifidelity import Followed, Following, followed
from prbayes.emulators.ranges import Ranges, read_ranges
from prbayes.emulators.surfaces import Predict, RadialBasis, Surface, fitted
from prbayes.numerics.points import sobol
from prbayes.response.call import Points, compute
from prbayes.response.chunks import Calling, Tally, respond
from prbayes.response.failures import Abort, OnFailure, Replace, ResponseError
from prbayes.response.outputs import Outputs, lacking
from prbayes.response.response import refuse_calling, refuse_coarse, refuse_misfit
from prbayes.response.store import Store, StoreError

_log = logging.getLogger("prbayes")

# Times d + 1 is how many residuals are nearby: 8 or more of them tell an rms to a quarter or
# better, 1 / sqrt(2 k), and more of them are less near.
_NEIGHBOURS = 4
_DESIGNS = ("even", "predictive")


@dataclass(frozen=True, eq=False)
class Surrogate:
    """A surface through runs of an expensive response, to be called in its place.

    It is made by ``fit`` or ``load``.

    Called with arrays of any leading shape, like the response; can be given to `Simulator` and
    `predict`. Of several outputs each has a surface of its own, all through the same runs; they
    come back in the last axis, or as a mapping where the response returns one. Inside its ranges
    only: outside, and where the nearest design point failed, it gives what ``outside`` says, and
    says so.

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
        The coarse response that it follows. It is called wherever the surrogate is, and travels
        with it by pickle, if it can.

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

    domain: Ranges = field(repr=False)
    points: Floats = field(repr=False)
    responses: Floats = field(repr=False)
    model: Any
    outside: OnFailure
    n_runs: int
    error: CrossValidation
    noise: int | None = None
    coarse: Callable[..., Any] | None = None
    # Whether the coarse response is among the inputs of the surface, too.
    _joined: bool = field(repr=False, default=False)
    _predict: Predict = field(repr=False, default=cast(Predict, None))
    _followed: Followed = field(repr=False, default=cast(Followed, None))
    # Whether points outside were told of.
    _warned: list[bool] = field(repr=False, default_factory=list)
    # What the response's mapping calls its outputs; None where they have no names.
    _named: Outputs | None = field(repr=False, default=None)
    # Search trees of all points, and of those that did not fail.
    _trees: tuple[Any, Any] = field(repr=False, default=(None, None))

    @classmethod
    def fit(
        cls,
        response: Callable[..., Any],
        inputs: Mapping[str, Any] | Sequence[Any],
        n: int,
        *,
        model: Any = None,
        coarse: Callable[..., Any] | None = None,
        outside: OnFailure | None = None,
        points: str = "even",
        prob: float = 0.999,
        name: str = "surrogate",
        executor: Executor | None = None,
        store: str | PathLike[str] | None = None,
        version: str | None = None,
        on_failure: OnFailure | None = None,
        retry_failed: bool = False,
        random_seed: Seed = 0,
        progressbar: bool = True,
    ) -> Surrogate:
        """Compute the response on a scrambled Sobol design, and fit a surface.

        The populations of many inputs are far from nearly all corners of their ranges: the design
        is then better where they are, ``points="predictive"``, and the surface a process.

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
            scikit-learn; it gets inputs scaled to [0, 1] and responses
            of mean 0 and spread 1, and is left as it is.
        coarse : callable, optional
            A cheap response of the same inputs that is about the expensive one, such as that of a
            coarser mesh. The surrogate follows it if its cross-validated error is smaller then; it
            calls it wherever it is called. Where it raises, or is not finite, the surface goes on
            without it, and the log says so. For a response of one output; several follow one under
            ``prb.Reweighted(coarse=)``.
        outside : OnFailure, optional
            `Replace` (default): points outside the ranges give its value, NaN, with a warning in
            the log. A simulator with `Reweighted` reports them as lost mass, and refuses an answer
            that rests on them. `Abort`: they raise; take that with `Resimulated`.
        points : {"even", "predictive"}
            Where the design is: evenly in all ranges, or each input by its own prior predictive
            distribution, inside its range; those that are given as a range evenly.
        prob : float
        name : str
            For messages, and of the store.
        executor, store, version, on_failure, retry_failed
            As for `Reweighted`. A point that fails in the end is left out of the fit; the surrogate
            then fails where that is the nearest point.
        random_seed : int, sequence of int, numpy.random.Generator or None
        progressbar : bool
            Whether work of more than two seconds shows a bar on stderr.

        Raises
        ------
        TypeError, ValueError
            If an argument is not as described, or n is too small for the surface; before the
            response is computed.
        ResponseError
            If the response raises, or too few points remain.

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
        refuse_calling(executor, store, version, policy)
        flag(retry_failed, f"{name}: retry_failed")
        share(prob, f"{name}: prob")
        seed = seed_number(random_seed, f"{name}: random_seed")
        domain, predictive = read_ranges(name, inputs, prob, seed)
        refuse_misfit(name, response, lambda: [one.size for one in domain.inputs], None)
        needed = points_needed(model, domain.dimensions)
        positive_integer(n, f"{name}: n", minimum=needed)

        # Compute the responses.
        design = _designed(name, points, domain, predictive, sobol(n, domain.dimensions, seed))
        # First, as what is wrong with it then costs no run.
        beside = None if coarse is None else _first_coarse(name, coarse, domain, design)
        kept = (
            None if store is None else Store(store, name, columns=design.shape[1], version=version)
        )
        calling = Calling(name, response, executor, kept, policy, retry_failed, outputs=None)
        tally = Tally()
        at = Points(domain.arguments(design), domain.varying)
        with shown(progressbar):
            _learn_names(calling, at, tally)
            responses = respond(calling, at, tally)
        good = _usable(responses)
        _refuse_unfit(name, responses, needed, followed=coarse is not None)

        # Tell the error.
        unit = domain.scaled(design)
        residuals = np.full(responses.shape, np.nan)
        beside = None if beside is None else beside[good]
        residuals[good], joined = _best(model, unit[good], responses[good], beside, seed)
        if coarse is not None and joined is None:
            coarse = None
            _log.info("%s: the coarse response tells nothing more, and is not followed", name)
        error = CrossValidation(residuals, _spread(responses[good]))

        # Fit the surface; only then is the spread over the prior predictive distribution known.
        unfitted = cls(
            domain,
            design,
            responses,
            model,
            outside,
            tally.computed,
            error,
            coarse=coarse,
            _joined=bool(joined),
            _named=tally.named,
        )
        found = unfitted._completed()._over(predictive)
        _log.info(
            "%s: %d responses computed; cross-validated error %s", name, tally.computed, found.error
        )
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(one.name for one in self.domain.inputs)

    @property
    def ranges(self) -> dict[str, tuple[Any, Any]]:
        """Lowest and highest value of each input."""
        return {one.name: (one.low.tolist(), one.high.tolist()) for one in self.domain.inputs}

    def __call__(self, *inputs: ArrayLike) -> Any:
        """Return what the response would be about, (...) or (..., m), or a mapping of such.

        Parameters
        ----------
        *inputs : array_like, shapes (..., *event)
            One per input.
        """
        columns, batch = self.domain.columns(inputs)
        out = self.domain.outside(columns)
        bad = out.any(axis=1)
        values = np.full((len(columns), *self._event), np.nan)
        values[~bad] = self._at(columns[~bad])
        if bad.any():
            values[bad] = self._outside_value(columns, out)
        found = values.reshape((*batch, *self._event))
        return found if self._named is None else self._named.by_key(found)

    @property
    def _event(self) -> tuple[int, ...]:
        """Shape of one response: () or (m,)."""
        return self.responses.shape[1:]

    def _outside_value(self, columns: Floats, out: NDArray[np.bool_]) -> float:
        """Return what stands for the response outside the ranges, and say so, or raise."""
        text = f"surrogate: {self.domain.complaint(columns, out)}"
        if isinstance(self.outside, Abort):
            raise ValueError(
                f"{text}; fit it on wider ranges, or with outside=prb.response.Replace(), which "
                "gives NaN there"
            )
        value = cast(Replace, self.outside).value
        # Once: a sampler asks thousands of times, and a simulator tells of the mass it loses.
        level = logging.DEBUG if self._warned else logging.WARNING
        once = f"{text}; they give {value}; this is told once."
        report(Finding("outside-ranges", once), level=level)
        self._warned.append(True)
        del self._warned[1:]
        return value

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
        """
        columns, batch = self.domain.columns(inputs)
        near = self._nearby(self.domain.scaled(columns))
        rms = np.sqrt((near**2).mean(axis=1))
        return np.asarray(rms.reshape((*batch, *self._event)))

    def with_error(self, random_seed: Seed = 0) -> Surrogate:
        """Return the surrogate with its own error added.

        That is a cross-validation residual from nearby, with either sign. Which one is chosen as if
        at random, but is always the same for the same input, so that the answer does not change
        from call to call. Populations become wider by the surrogate's error where they live: for
        predictions that are not to be more certain than the surrogate, and for calibrations with
        `Reweighted`. The noise jumps from input to input, so that the discrepancy is no longer
        smooth under `Resimulated`.

        Parameters
        ----------
        random_seed : int, sequence of int, numpy.random.Generator or None

        Examples
        --------
        >>> import numpy as np, prbayes as prb
        >>> surrogate = prb.Surrogate.fit(lambda x: np.sin(9 * x), {"x": (0, 3)}, 24).with_error()
        >>> bool(surrogate(1.0) == surrogate(1.0))
        True
        """
        noise = seed_number(random_seed, "with_error: random_seed")
        return replace(self, noise=noise)

    def save(self, path: str | PathLike[str]) -> None:
        """Write design, responses and configuration as netCDF.

        Parameters
        ----------
        path : path-like
        """
        path = file_path(path, "path")
        if not path.absolute().parent.is_dir():
            raise ValueError(
                f"path: got {path}, whose folder does not exist, expected one that does"
            )
        kept = Kept(
            ranges=self.domain,
            points=self.points,
            responses=self.responses,
            error=self.error,
            kind=type(self.model).__name__,
            settings=settings_of(self.model),
            outside=self.outside,
            noise=self.noise,
            n_runs=self.n_runs,
            probes=self._probes(),
            joined=None if self.coarse is None else self._joined,
            outputs=self._named,
        )
        write(path, kept)

    @classmethod
    def load(
        cls,
        path: str | PathLike[str],
        *,
        model: Any = None,
        coarse: Callable[..., Any] | None = None,
    ) -> Surrogate:
        """Read what `save` wrote, and fit the surface anew.

        No response is computed, and nothing is unpickled.

        Parameters
        ----------
        path : path-like
        model : object, optional
            The surface or regressor, where it is not one that ships with prbayes: a file keeps its
            design, not its code.
        coarse : callable, optional
            The coarse response, where the surrogate follows one: for the same reason. It is called
            at the design. A surrogate that follows none needs none.

        Raises
        ------
        StoreError
            If the file cannot be read, or is no surrogate.
        TypeError, ValueError
            If a regressor is needed, or the surface is not that which was saved.
        """
        kept = read(file_path(path, "path"))
        if model is None:
            model = shipped(kept.kind, kept.settings)
        if model is None:
            raise TypeError(
                f"Surrogate.load: got no model, expected the {kept.kind} it was fitted with; "
                "pass model="
            )
        if kept.joined is not None and coarse is None:
            raise TypeError(
                "Surrogate.load: got no coarse response, expected the one that the surrogate "
                "follows: a file does not keep it; pass coarse="
            )
        unfitted = cls(
            domain=kept.ranges,
            points=kept.points,
            responses=kept.responses,
            model=model,
            outside=kept.outside,
            n_runs=kept.n_runs,
            error=kept.error,
            noise=kept.noise,
            coarse=None if kept.joined is None else coarse,
            _joined=bool(kept.joined),
            _named=kept.outputs,
        )
        found = unfitted._completed()
        spread = np.asarray(_spread(kept.responses[_usable(kept.responses)]))
        # Above what the linear algebra of another processor leaves, below what another setting
        # changes.
        size = np.where(spread > 0, spread, 1.0)
        now, then = found._probes() / size, kept.probes / size
        if not np.allclose(now, then, rtol=0, atol=1e-6, equal_nan=True):
            beside = "" if kept.joined is None else ", and the same coarse response"
            raise ValueError(
                f"Surrogate.load: got a {type(model).__name__} that gives other values than the "
                f"{kept.kind} that was saved in this file, expected the same one with the same "
                f"settings (and a fixed seed of its own){beside}"
            )
        return found

    def _completed(self) -> Surrogate:
        """Return this one with its surface and its search trees."""
        from scipy.spatial import cKDTree

        unit = self.domain.scaled(self.points)
        good = _usable(self.responses)
        surface = _surfaces(self.model, unit[good], self.responses[good])
        trees = cKDTree(unit), cKDTree(unit[good])
        found = replace(self, _predict=surface, _trees=trees)
        if self.coarse is None:
            return found
        coarse = _coarse_at("surrogate", self.coarse, self.domain, self.points)
        good &= np.isfinite(coarse)
        y = self.responses[good]
        beside = followed(self.model, unit[good], y, coarse[good], joined=self._joined)
        return replace(found, _followed=beside)

    def _over(self, predictive: Floats | None) -> Surrogate:
        """Return this one with the spread over the prior predictive distribution, if there is."""
        if predictive is None:
            return self
        values = self._at(predictive)
        spread = _spread(values[_usable(values)])
        return replace(self, error=CrossValidation(self.error.residuals, spread))

    def _at(self, columns: Floats) -> Floats:
        """Return values inside the ranges, shape (n,)."""
        if not len(columns):
            return np.empty((0, *self._event))
        # What lies outside by its rounding only is on the edge.
        unit = np.clip(self.domain.scaled(columns), 0.0, 1.0)
        values = self._surface(columns, unit)
        if self.noise is not None:
            values = values + self._noise_at(columns, unit, self.noise)
        failed = ~_usable(self.responses)
        if failed.any():
            # Nothing is known near a run that failed.
            all_points, _ = self._trees
            _, which = all_points.query(unit)
            near = failed[which]
            values[near] = self.responses[which[near]]
        return values

    def _surface(self, columns: Floats, unit: Floats) -> Floats:
        """Return values of the surface at rows, which are also given in the unit cube."""
        if self.coarse is None:
            return self._predict(unit)
        coarse = _coarse_at("surrogate", self.coarse, self.domain, columns)
        known = np.isfinite(coarse)
        values = np.empty(len(unit))
        values[known] = self._followed(unit[known], coarse[known])
        if not known.all():
            values[~known] = self._predict(unit[~known])
            lost = (~known).sum()
            report(
                Finding(
                    "coarse-without-number",
                    f"surrogate: coarse: got no number at {lost} of {known.size} points, where "
                    "the surface goes on without it.",
                )
            )
        return values

    def _noise_at(self, columns: Floats, unit: Floats, random_seed: int) -> Floats:
        """Return for each row residuals of one run nearby, with either sign, (n,) or (n, m)."""
        near = self._nearby(unit)
        n, k = near.shape[:2]
        number, sign = np.divmod(hashed_rows(columns, random_seed), np.uint64(2))
        which = (number % np.uint64(k)).astype(np.intp)
        chosen = near[np.arange(n), which]
        turned = np.where(sign == 0, 1.0, -1.0)
        return chosen * turned.reshape((n, *(1 for _ in self._event)))

    def _nearby(self, unit: Floats) -> Floats:
        """Return the residuals at the nearest design points that did not fail, (n, k, ...)."""
        residuals = self.error.residuals[_usable(self.responses)]
        dimensions = unit.shape[1]
        k = min(len(residuals), _NEIGHBOURS * (dimensions + 1))
        _, good_points = self._trees
        # What is not finite is outside, and has no neighbours: any will do.
        known = np.where(np.isfinite(unit), unit, 0.5)
        _, which = good_points.query(known, k=k)
        return np.asarray(residuals[which])

    def _probes(self) -> Floats:
        """Return values of the surface, without noise, at a few fixed points."""
        # More than surfaces that ship have coefficients, in few dimensions, so that another one
        # cannot agree at all of them.
        unit = sobol(64, self.domain.dimensions, 0)
        return self._surface(self.domain.at(unit), unit)


def _designed(
    name: str, points: str, domain: Ranges, predictive: Floats | None, unit: Floats
) -> Floats:
    """Return the design's rows for points of the unit cube: evenly, or as the prior has them."""
    if points == "even":
        return domain.at(unit)
    if predictive is None:
        raise ValueError(
            f"{name}: points: got 'predictive' for inputs that are ranges, expected a `.dist()` "
            "among them; leave points= out"
        )
    return domain.at(domain.like(predictive, unit))


def _usable(responses: Floats) -> NDArray[np.bool_]:
    """Return which runs have finite outputs, all of them, (n,)."""
    return ~lacking(np.where(np.isfinite(responses), responses, np.nan))


def _refuse_unfit(name: str, responses: Floats, needed: int, *, followed: bool) -> None:
    """Raise if too few runs have a response, or several outputs were to follow a coarse one."""
    good = _usable(responses).sum()
    if good < needed:
        raise ResponseError(
            f"{name}: got {good} numbers from {len(responses)} responses, too few for a surface"
        )
    if followed and responses.ndim > 1:
        raise ResponseError(
            f"{name}: coarse: got one number a point beside a response of {responses.shape[1]} "
            "outputs, expected a response of one; leave coarse= out, or use "
            "prb.Reweighted(n, coarse=)"
        )


def _spread(values: Floats) -> Any:
    """Return the standard deviation of responses, a number or one for each output."""
    found = values.std(axis=0)
    return float(found) if found.ndim == 0 else found


@dataclass(frozen=True, eq=False)
class _Together:
    """Surfaces of several outputs; a class, so that it can be pickled."""

    each: tuple[Predict, ...]

    def __call__(self, at: Floats) -> Floats:
        return np.stack([predict(at) for predict in self.each], axis=-1)


def _surfaces(model: Any, x: Floats, y: Floats) -> Predict:
    """Return a surface through responses, or one through each of several outputs."""
    if y.ndim == 1:
        return fitted(model, x, y)
    return _Together(tuple(fitted(model, x, own) for own in y.T))


def _learn_names(calling: Calling, points: Points, tally: Tally) -> None:
    """Learn what a mapping calls several outputs that are stored, before any other run.

    A store keeps numbers only: where a version is believed, one of its runs is computed again, and
    refused if its outputs have changed places.
    """
    store = calling.store
    if store is None or store.version is None:
        return
    keys, values = store.known()
    if values.ndim == 1:
        return
    usable = np.flatnonzero(_usable(values) & points.have_same_constants(keys))[:1]
    if not usable.size:
        return
    (again,) = respond(replace(calling, store=None), points.from_keys(keys[usable]), tally)
    (stored,) = values[usable]
    moved = np.allclose(np.sort(again), np.sort(stored)) and not np.allclose(again, stored)
    if tally.named is not None and moved:
        raise StoreError(
            f"{calling.name}: store: got a mapping with the keys {list(tally.named.names)}, whose "
            "numbers are stored in another order, expected the same one; pass another version="
        )


def _coarse_at(name: str, coarse: Callable[..., Any], domain: Ranges, columns: Floats) -> Floats:
    """Return a coarse response at rows, (n,); NaN where it raises."""
    points = Points(domain.arguments(columns), domain.varying)
    try:
        return compute(coarse, points, tolerant=True).values
    except ResponseError as error:
        raise ResponseError(f"{name}: coarse: {error}") from None


def _first_coarse(name: str, coarse: Callable[..., Any], domain: Ranges, columns: Floats) -> Floats:
    """Return the same at the design, or raise if it is no response of the inputs."""
    refuse_coarse(f"{name}: coarse", coarse)
    found = _coarse_at(name, coarse, domain, columns)
    if not np.isfinite(found).any():
        raise ResponseError(
            f"{name}: coarse: got no number at any of {len(columns)} points, expected a response "
            "of the same inputs; repair it, or leave coarse= out"
        )
    return found


def _best(
    model: Any, x: Floats, y: Floats, coarse: Floats | None, seed: int
) -> tuple[Floats, bool | None]:
    """Return the least cross-validated residuals, and how a coarse response is followed for them.

    None if it is not; else whether it is among the inputs of the surface, too.
    """
    least = cross_validated(model, x, y, seed)
    choice = None
    if coarse is None:
        return least, choice
    known = int(np.isfinite(coarse).sum())
    for joined in (False, True):
        if known < points_needed(model, x.shape[1] + joined):
            continue
        residuals = cross_validated(Following(model, model, joined), x, y, seed, coarse)
        if (residuals**2).sum() < (least**2).sum():
            least, choice = residuals, joined
    return least, choice


def _refuse_wrong(name: str, response: object, model: Any, outside: object, points: object) -> None:
    """Raise if an argument of `Surrogate.fit` is not of its kind."""
    if not callable(response):
        raise TypeError(
            f"{name}: response: got {type(response).__name__}, expected a function of the inputs"
        )
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
    if points not in _DESIGNS:
        raise ValueError(f"{name}: points: got {points!r:.60}, expected one of {_DESIGNS}")
