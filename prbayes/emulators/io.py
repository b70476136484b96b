"""Files of surrogates: the design, the responses and the settings of a surface, without code."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import FORMAT, Floats, Record, StrPath, require_format
from prbayes.emulators.gaussian_process import GaussianProcess
from prbayes.emulators.radial_basis import RadialBasis
from prbayes.emulators.ranges import Range, Ranges
from prbayes.emulators.selection import CrossValidation
from prbayes.emulators.surfaces import Polynomial, Surface
from prbayes.response.failures import Abort, Replace
from prbayes.response.outputs import Outputs, outputs_of_keys
from prbayes.response.store import StoreError, replace_files

_SHIPPED: tuple[Any, ...] = (RadialBasis, Polynomial, GaussianProcess)


@dataclass(frozen=True, eq=False)
class SavedSurrogate:
    """The contents of a file."""

    fields: Record  # fields of the `Surrogate`
    outputs: Outputs | None  # names of the outputs, if they have names
    kind: str  # name of the surface's class
    model: Surface | None  # the surface, if it ships with prbayes
    follows_coarse: bool  # whether the surface follows a coarse response
    probes: Floats  # (k,) or (k, m): values of the surface at fixed points, which identify it


def write_surrogate(path: StrPath, surrogate: Any, probes: Floats) -> None:
    """Write a surrogate and its values at fixed points as netCDF."""
    responses = surrogate.responses
    output = ["output"] if responses.ndim > 1 else []
    names = surrogate._surface.outputs
    model = surrogate.model
    settings = asdict(model) if isinstance(model, _SHIPPED) else {}
    configuration = {
        "inputs": [
            {"name": r.name, "shape": list(r.event), "constant": r.constant}
            for r in surrogate.domain.inputs
        ],
        "model": {"kind": type(model).__name__, **settings},
        # The value is stored as text, because JSON has no NaN.
        "outside": str(surrogate.outside.value) if hasattr(surrogate.outside, "value") else None,
        "noise": surrogate.noise,
        "n_runs": surrogate.n_runs,
        "joined": None if surrogate.coarse is None else True,
        "outputs": None if names is None else names.keys,
        "labels": None if names is None else [names.dim, *names.labels],
    }
    data = xr.Dataset(
        {
            "points": (["point", "column"], surrogate.points),
            "responses": (["point", *output], responses),
            "residuals": (["point", *output], surrogate.error.residuals),
            "low": ("column", surrogate.domain.low),
            "high": ("column", surrogate.domain.high),
            "population_sd": (output, surrogate.error.population_sd),
            "probes": (["probe", *output], probes),
        },
        attrs={"prbayes_format": FORMAT, "configuration": json.dumps(configuration)},
    )
    replace_files({Path(path): bytes(data.to_netcdf(engine="h5netcdf"))}, "Surrogate.save: path")


def read_surrogate(path: StrPath) -> SavedSurrogate:
    """Read a file of `write_surrogate`; raise a StoreError if it cannot be read, or is none."""
    try:
        with xr.open_dataset(path, engine="h5netcdf") as data:
            data.load()
        require_format(data.attrs.get("prbayes_format"))
        config = json.loads(data.attrs["configuration"])
        # JSON has turned tuples into lists.
        kind = config["model"].pop("kind")
        settings = {k: tuple(x) if isinstance(x, list) else x for k, x in config["model"].items()}
        model = next((cls(**settings) for cls in _SHIPPED if cls.__name__ == kind), None)
        sd = data["population_sd"].values
        outside = config["outside"]
        outputs = config.get("outputs")
        if outputs is not None:
            keys = [(str(key), None if size is None else int(size)) for key, size in outputs]
            outputs = outputs_of_keys(keys)
            if not keys:  # the labels are numbers
                dim, *labels = config["labels"]
                outputs = Outputs(tuple(labels), dim)
        fields = {
            "domain": _ranges(config["inputs"], data["low"].values, data["high"].values),
            "points": data["points"].values,
            "responses": data["responses"].values,
            "error": CrossValidation(data["residuals"].values, sd if sd.ndim else float(sd)),
            "outside": Abort() if outside is None else Replace(float(outside)),
            "noise": config["noise"],
            "n_runs": config["n_runs"],
        }
        follows_coarse = config.get("joined") is not None
        return SavedSurrogate(fields, outputs, kind, model, follows_coarse, data["probes"].values)
    # A damaged file may raise any error of the libraries that read it.
    except Exception as error:
        raise StoreError(
            f"Surrogate.load: path: got {path}, expected a file of Surrogate.save that can be "
            f"read ({type(error).__name__}: {error})"
        ) from error


def _ranges(inputs: list[Record], low: Floats, high: Floats) -> Ranges:
    """Return ranges from their lower and upper ends in columns."""
    ranges = []
    start = 0
    for entry in inputs:
        shape = entry["shape"]
        stop = start + int(np.prod(shape, dtype=int))
        ends = low[start:stop].reshape(shape), high[start:stop].reshape(shape)
        ranges.append(Range(entry["name"], *ends, entry["constant"]))
        start = stop
    return Ranges(tuple(ranges))
