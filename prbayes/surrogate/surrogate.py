"""`Surrogate`: a surface through a few runs of an expensive response, that knows its error and its limits."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from typing import Any, cast

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from prbayes._checks import Floats, positive_integer
from prbayes.propagation.points import sobol
from prbayes.response.calling import Calling, Points, ResponseError, Tally, respond
from prbayes.response.failures import Abort, OnFailure, Replace
from prbayes.response.store import Store, StoreError
from prbayes.surrogate.error import SurrogateError, cross_validated
from prbayes.surrogate.ranges import Input, Region, read_region
from prbayes.surrogate.surfaces import Polynomial, Predict, RadialBasis, Surface, fitted, required, scattered

_log = logging.getLogger("prbayes")
_SAME = 1e-6  # of the response's spread: within which a loaded surface must repeat what was saved
_PROBES = 64


@dataclass(frozen=True, eq=False)
class Surrogate:
    """A surface through runs of an expensive response, to be called in its place; made by ``fit`` or ``load``.

    Called with arrays of any leading shape, like the response; can be given to `Simulator` and `predict`. Inside its
    ranges only: outside, and where the nearest design point failed, it gives what ``outside`` says, and says so.

    Attributes
    ----------
    names : tuple of str
        Of the inputs.
    points : ndarray, shape (n, columns)
        The design.
    responses : ndarray, shape (n,)
        In its own units; NaN or +inf where it failed.
    model : object
        The kind of surface.
    outside : OnFailure
    n_runs : int
        Responses computed for the design; those found in a store are not counted.
    error : SurrogateError
    noise : int or None
        The seed of residual noise, see `with_error`.

    See Also
    --------
    prbayes.Reweighted : computes a few hundred responses once, and needs no surrogate.

    References
    ----------
    .. [1] Forrester, A., A. Sobester and A. Keane (2008), Engineering Design via Surrogate Modelling, Wiley.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> surrogate = prb.Surrogate.fit(lambda x, y: np.sin(x) * y, {"x": (0, 3), "y": (1, 2)}, 128)
    >>> surrogate(1.0, np.array([1.2, 1.5])).round(2)
    array([1.01, 1.26])
    >>> bool(surrogate.error.relative < 0.01)
    True
    """

    region: Region = field(repr=False)
    points: Floats = field(repr=False)
    responses: Floats = field(repr=False)
    model: Any
    outside: OnFailure
    n_runs: int
    error: SurrogateError
    noise: int | None = None
    _predict: Predict = field(repr=False, default=cast(Predict, None))
    _trees: tuple[Any, Any] = field(repr=False, default=(None, None))  # of all points, and of those that did not fail

    @classmethod
    def fit(
        cls,
        response: Callable[..., Any],
        inputs: Mapping[str, Any] | Sequence[Any],
        n: int,
        *,
        model: Any = None,
        outside: OnFailure | None = None,
        coverage: float = 0.999,
        executor: Executor | None = None,
        store: str | PathLike[str] | None = None,
        on_failure: OnFailure | None = None,
        name: str = "surrogate",
        seed: int = 0,
    ) -> Surrogate:
        """Compute the response on a scrambled Sobol design, and fit a surface.

        Parameters
        ----------
        response : callable
            As for `Simulator`: one array per input, any leading shape; or in `scalar`.
        inputs : mapping or sequence
            One entry per argument of the response, in its order, by name if you like: ``(low, high)``, in the input's
            own units; a ``.dist()`` or a variable of the model on the context, which covers the central ``coverage``
            of its prior predictive distribution; or a number, which stays as it is.
        n : int
            Number of design points. With the same seed those of a smaller n are among them.
        model : object, optional
            `RadialBasis` (default), `Polynomial`, or any regressor with ``fit(X, y)`` and ``predict(X)``, as those of
            scikit-learn; it gets inputs scaled to [0, 1] and responses of mean 0 and spread 1, and is left as it is.
        outside : OnFailure, optional
            `Replace` (default): points outside the ranges give its value, NaN, with a warning in the log. A simulator
            with `Reweighted` reports them as lost mass, and refuses an answer that rests on them. `Abort`: they raise;
            take that with `Resimulated`.
        coverage : float
        executor, store, on_failure
            As for `Reweighted`. A point that fails in the end is left out of the fit; the surrogate then fails where
            that is the nearest point.
        name : str
            For messages, and of the store.
        seed : int

        Raises
        ------
        TypeError, ValueError
            If an argument is not as described, or n is too small for the surface; before the response is computed.
        ResponseError
            If the response raises, or too few points remain.

        Examples
        --------
        >>> import numpy as np, pymc as pm, prbayes as prb
        >>> with pm.Model() as model:
        ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        ...     surrogate = prb.Surrogate.fit(np.square, [x], 32, model=prb.Polynomial(2))
        ...     y = prb.Simulator("y", surrogate, x, metric=prb.AreaMetric(), observed=[0.5, 1.0, 4.0])
        """
        model, outside = model or RadialBasis(), outside or Replace()
        _refuse_wrong(name, response, model, outside, store)
        positive_integer(seed, f"{name}: seed", minimum=0)
        if not isinstance(coverage, float) or not 0 < coverage < 1:
            raise ValueError(f"{name}: coverage: got {coverage!r}, expected a share between 0 and 1")
        region, predictive = read_region(name, inputs, coverage, seed)
        positive_integer(n, f"{name}: n", minimum=required(model, region.dimensions))
        points = region.at(sobol(n, region.dimensions, seed))
        kept = None if store is None else Store(store, name, points.shape[1])
        calling, tally = Calling(name, response, executor, kept, on_failure or Abort()), Tally()
        wanted = Points(region.arguments(points), [not e.constant for e in region.inputs])
        responses = respond(calling, wanted, tally)
        good = np.isfinite(responses)
        if good.sum() < required(model, region.dimensions):
            raise ResponseError(f"{name}: got {good.sum()} numbers from {n} responses, too few for a surface")
        residuals = np.full(n, np.nan)
        residuals[good] = cross_validated(model, region.scaled(points)[good], responses[good], seed)
        error = SurrogateError(residuals, float(responses[good].std()))
        found = cls(region, points, responses, model, outside, tally.computed, error)._completed()
        if predictive is not None:
            values = found._at(predictive)
            found = replace(found, error=SurrogateError(residuals, float(values[np.isfinite(values)].std())))
        _log.info("%s: %d responses computed; cross-validated error %s", name, tally.computed, found.error)
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(e.name for e in self.region.inputs)

    @property
    def ranges(self) -> dict[str, tuple[Any, Any]]:
        """Lowest and highest value of each input."""
        return {e.name: (e.low.tolist(), e.high.tolist()) for e in self.region.inputs}

    def __call__(self, *inputs: ArrayLike) -> Floats:
        """Return what the response would be about, shape (...), for arrays (..., *event), one per input."""
        columns, batch = self.region.columns(inputs)
        out = self.region.outside(columns)
        bad = out.any(axis=1)
        values = np.full(len(columns), np.nan)
        values[~bad] = self._at(columns[~bad])
        if bad.any():
            text = f"surrogate: {self.region.complaint(columns, out)}"
            if isinstance(self.outside, Abort):
                raise ValueError(
                    f"{text}; fit it on wider ranges, or with outside=prb.Replace(), which gives NaN there"
                )
            values[bad] = cast(Replace, self.outside).value
            _log.warning("%s; they give %s", text, cast(Replace, self.outside).value)
        return values.reshape(batch)

    def local_error(self, *inputs: ArrayLike) -> Floats:
        """Return the root mean square of the cross-validation residuals nearby, in units of the response.

        Parameters
        ----------
        *inputs : array_like
            One per input, of the shape of a batch, a multivariate one with its event axis last.

        Returns
        -------
        ndarray, shape (...)
        """
        columns, batch = self.region.columns(inputs)
        near = self._nearby(self.region.scaled(columns))
        return np.asarray(np.sqrt((near**2).mean(axis=1)).reshape(batch))

    def with_error(self, seed: int = 0) -> Surrogate:
        """Return the surrogate with its own error added: a cross-validation residual from nearby, with either sign.

        Which one is chosen as if at random, but is always the same for the same input, so that the answer does not
        change from call to call. Populations become wider by the surrogate's error where they live: for predictions
        that are not to be more certain than the surrogate, and for calibrations with `Reweighted`. The noise jumps from
        input to input, so that the discrepancy is no longer smooth under `Resimulated`.

        Parameters
        ----------
        seed : int

        Examples
        --------
        >>> import numpy as np, prbayes as prb
        >>> surrogate = prb.Surrogate.fit(lambda x: np.sin(9 * x), {"x": (0, 3)}, 24).with_error()
        >>> bool(surrogate(1.0) == surrogate(1.0))
        True
        """
        return replace(self, noise=positive_integer(seed, "with_error: seed", minimum=0))

    def save(self, path: str | PathLike[str]) -> None:
        """Write design, responses and configuration as netCDF.

        Parameters
        ----------
        path : path-like
        """
        probes = self._probes()
        settings = asdict(self.model) if isinstance(self.model, RadialBasis | Polynomial) else {}
        ranges = self.region.inputs
        config = {
            "inputs": [{"name": e.name, "shape": list(e.low.shape), "constant": e.constant} for e in ranges],
            "model": {"kind": type(self.model).__name__, **settings},
            "outside": None if isinstance(self.outside, Abort) else str(cast(Replace, self.outside).value),
            "noise": self.noise,
            "n_runs": self.n_runs,
        }
        xr.Dataset(
            {
                "points": (["point", "column"], self.points),
                "responses": ("point", self.responses),
                "residuals": ("point", self.error.residuals),
                "low": ("column", self.region.low),
                "high": ("column", self.region.high),
                "population_sd": self.error.population_sd,
                "probes": ("probe", probes),
            },
            attrs={"prbayes_surrogate": 1, "configuration": json.dumps(config)},
        ).to_netcdf(path, engine="h5netcdf")

    @classmethod
    def load(cls, path: str | PathLike[str], *, model: Any = None) -> Surrogate:
        """Read what `save` wrote, and fit the surface anew; no response is computed, and nothing is unpickled.

        Parameters
        ----------
        path : path-like
        model : object, optional
            The regressor, where it is not one that ships with prbayes: a file keeps its design, not its code.

        Raises
        ------
        StoreError
            If the file cannot be read, or is no surrogate.
        TypeError, ValueError
            If a regressor is needed, or the surface is not that which was saved.
        """
        try:
            with xr.open_dataset(path, engine="h5netcdf") as data:
                data.load()
            config = json.loads(data.attrs["configuration"])
            sizes = [int(np.prod(e["shape"], dtype=int)) for e in config["inputs"]]
            parts = [np.split(data[key].values, np.cumsum(sizes)[:-1]) for key in ("low", "high")]
            inputs = tuple(
                Input(e["name"], low.reshape(e["shape"]), high.reshape(e["shape"]), e["constant"])
                for e, low, high in zip(config["inputs"], *parts, strict=True)
            )
            points, responses, residuals = (data[key].values for key in ("points", "responses", "residuals"))
            error = SurrogateError(residuals, float(data["population_sd"]))
            kind = config["model"].pop("kind")
            outside = Abort() if config["outside"] is None else Replace(float(config["outside"]))
            probes = data["probes"].values
        except Exception as trouble:
            raise StoreError(
                f"Surrogate.load: {path} is no surrogate that can be read ({type(trouble).__name__}: {trouble})"
            ) from trouble
        ships = {"RadialBasis": RadialBasis, "Polynomial": Polynomial}
        if model is None and kind not in ships:
            raise TypeError(f"Surrogate.load: got no model, expected the {kind} it was fitted with; pass model=")
        model = ships[kind](**config["model"]) if model is None else model
        rest = (config["n_runs"], error, config["noise"])
        found = cls(Region(inputs), points, responses, model, outside, *rest)._completed()
        spread = float(np.nanstd(responses[np.isfinite(responses)])) or 1.0
        if not np.allclose(found._probes(), probes, rtol=0, atol=_SAME * spread, equal_nan=True):
            raise ValueError(
                f"Surrogate.load: got a {type(model).__name__} that gives other values than the {kind} that was saved "
                "in this file, expected the same one with the same settings (and a fixed seed of its own)"
            )
        return found

    def _completed(self) -> Surrogate:
        """Return this one with its surface and its search trees."""
        from scipy.spatial import cKDTree

        unit, good = self.region.scaled(self.points), np.isfinite(self.responses)
        surface = fitted(self.model, unit[good], self.responses[good])
        return replace(self, _predict=surface, _trees=(cKDTree(unit), cKDTree(unit[good])))

    def _at(self, columns: Floats) -> Floats:
        """Return values inside the ranges, shape (n,)."""
        if not len(columns):
            return np.empty(0)
        unit = np.clip(self.region.scaled(columns), 0.0, 1.0)
        values = self._predict(unit)
        if self.noise is not None:
            near = self._nearby(unit)
            which, sign = np.divmod(scattered(columns, self.noise), np.uint64(2))
            chosen = near[np.arange(len(near)), (which % np.uint64(near.shape[1])).astype(np.intp)]
            values = values + np.where(sign == 0, chosen, -chosen)
        if not np.isfinite(self.responses).all():
            nearest = self.responses[self._trees[0].query(unit)[1]]
            values = np.where(np.isfinite(nearest), values, nearest)
        return values

    def _nearby(self, unit: Floats) -> Floats:
        """Return the residuals at the nearest design points that did not fail, shape (n, k)."""
        residuals = self.error.residuals[np.isfinite(self.responses)]
        k = min(residuals.size, 4 * (unit.shape[1] + 1))
        return np.asarray(residuals[self._trees[1].query(np.where(np.isfinite(unit), unit, 0.5), k=k)[1]])

    def _probes(self) -> Floats:
        """Return values of the surface, without noise, at a few fixed points."""
        return self._predict(sobol(_PROBES, self.region.dimensions, 0))


def _refuse_wrong(name: str, response: object, model: Any, outside: object, store: object) -> None:
    if not callable(response):
        raise TypeError(f"{name}: response: got {type(response).__name__}, expected a function of the inputs")
    is_surface = isinstance(model, Surface) or (hasattr(model, "fit") and hasattr(model, "predict"))
    if isinstance(model, type) or not is_surface:
        raise TypeError(
            f"{name}: model: got {model!r:.60}, expected prb.RadialBasis(), prb.Polynomial(), or a regressor (an "
            "object, not a class) with fit(X, y) and predict(X)"
        )
    if not isinstance(outside, Abort | Replace):
        raise TypeError(f"{name}: outside: got {outside!r:.60}, expected prb.Replace() or prb.Abort()")
    if store is not None and not isinstance(store, str | PathLike):
        raise TypeError(f"{name}: store: got {type(store).__name__}, expected the path of a folder")
