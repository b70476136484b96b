"""Files of surrogates: what a surface is fitted to and how, without code."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from os import PathLike
from typing import Any, cast

import numpy as np
import xarray as xr

from prbayes._validate import Floats
from prbayes.emulators.cross_validation import CrossValidation
from prbayes.emulators.gaussian_process import GaussianProcess
from prbayes.emulators.ranges import Range, Ranges
from prbayes.emulators.surfaces import Polynomial, RadialBasis, Surface
from prbayes.response.failures import Abort, OnFailure, Replace
from prbayes.response.outputs import Outputs, outputs_of_keys
from prbayes.response.store import StoreError

# Those that a file can name, so that it is read without being handed the surface.
_SHIPPED: dict[str, type[Surface]] = {
    kind.__name__: kind for kind in (RadialBasis, Polynomial, GaussianProcess)
}


def settings_of(model: Any) -> dict[str, Any]:
    """Return what a file keeps of a surface that ships with prbayes; of any other one nothing."""
    if isinstance(model, RadialBasis | Polynomial | GaussianProcess):
        return asdict(model)
    return {}


def shipped(kind: str, settings: dict[str, Any]) -> Surface | None:
    """Return the surface with such settings, or None if no such kind ships with prbayes."""
    if kind not in _SHIPPED:
        return None
    # JSON has lists for tuples.
    known = {key: tuple(x) if isinstance(x, list) else x for key, x in settings.items()}
    return _SHIPPED[kind](**known)


@dataclass(frozen=True, eq=False)
class Kept:
    """What a file keeps of a surrogate."""

    ranges: Ranges
    points: Floats  # (n, columns)
    responses: Floats  # (n,) or (n, m)
    error: CrossValidation
    kind: str  # of the surface: the name of its class
    settings: dict[str, Any]  # of the surface, if it ships with prbayes
    outside: OnFailure
    noise: int | None
    n_runs: int
    # (k,) or (k, m): values of the surface at fixed points, by which another surface is known.
    probes: Floats
    joined: bool | None = None  # how a coarse response is followed; None if none is
    outputs: Outputs | None = None  # what a mapping calls them; None where they have no names


def write(path: str | PathLike[str], kept: Kept) -> None:
    """Write netCDF."""
    several = ["output"] if kept.responses.ndim > 1 else []
    data = xr.Dataset(
        {
            "points": (["point", "column"], kept.points),
            "responses": (["point", *several], kept.responses),
            "residuals": (["point", *several], kept.error.residuals),
            "low": ("column", kept.ranges.low),
            "high": ("column", kept.ranges.high),
            "population_sd": (several, kept.error.population_sd),
            "probes": (["probe", *several], kept.probes),
        },
        attrs={
            "prbayes_surrogate": 1,
            "configuration": json.dumps(_configuration(kept)),
        },
    )
    data.to_netcdf(path, engine="h5netcdf")


def read(path: str | PathLike[str]) -> Kept:
    """Read what `write` wrote.

    Raises
    ------
    StoreError
        If the file cannot be read, or is no surrogate.
    """
    try:
        with xr.open_dataset(path, engine="h5netcdf") as data:
            data.load()
        config = json.loads(data.attrs["configuration"])
        surface = config["model"]
        residuals = data["residuals"].values
        spread = data["population_sd"].values
        population_sd = spread if spread.ndim else float(spread)
        return Kept(
            ranges=_ranges(config["inputs"], data["low"].values, data["high"].values),
            points=data["points"].values,
            responses=data["responses"].values,
            error=CrossValidation(residuals, population_sd),
            kind=surface.pop("kind"),
            settings=surface,
            outside=_outside(config["outside"]),
            noise=config["noise"],
            n_runs=config["n_runs"],
            probes=data["probes"].values,
            joined=config.get("joined"),
            outputs=_outputs(config.get("outputs")),
        )
    # Damaged files raise whatever the library that meets the damage raises.
    except Exception as error:
        raise StoreError(
            f"Surrogate.load: path: got {path}, expected a file of Surrogate.save that can be "
            f"read ({type(error).__name__}: {error})"
        ) from error


def _configuration(kept: Kept) -> dict[str, Any]:
    """Return what JSON keeps."""
    inputs = []
    for one in kept.ranges.inputs:
        inputs.append({"name": one.name, "shape": list(one.event), "constant": one.constant})
    outside = None
    if not isinstance(kept.outside, Abort):
        # As text: JSON has no NaN.
        outside = str(cast(Replace, kept.outside).value)
    return {
        "inputs": inputs,
        "model": {"kind": kept.kind, **kept.settings},
        "outside": outside,
        "noise": kept.noise,
        "n_runs": kept.n_runs,
        "joined": kept.joined,
        "outputs": None if kept.outputs is None else kept.outputs.keys,
    }


def _outputs(keys: list[Any] | None) -> Outputs | None:
    """Return the outputs that a mapping has, from its keys and how many numbers each has."""
    if keys is None:
        return None
    return outputs_of_keys([(str(key), None if size is None else int(size)) for key, size in keys])


def _ranges(inputs: list[dict[str, Any]], low: Floats, high: Floats) -> Ranges:
    """Return ranges from their columns."""
    found = []
    start = 0
    for entry in inputs:
        shape = entry["shape"]
        where = slice(start, start + int(np.prod(shape, dtype=int)))
        found.append(
            Range(
                entry["name"],
                low[where].reshape(shape),
                high[where].reshape(shape),
                entry["constant"],
            )
        )
        start = where.stop
    return Ranges(tuple(found))


def _outside(value: str | None) -> OnFailure:
    """Return what happens outside the ranges: `Abort` for None."""
    return Abort() if value is None else Replace(float(value))
