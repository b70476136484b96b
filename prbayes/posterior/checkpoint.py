"""The state of a sampler on disk after every stage, so that a run that was killed goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from prbayes._checks import Floats
from prbayes.response.store import StoreError


class Checkpoint:
    """Arrays and a JSON note in one netCDF file, always whole: each save replaces the file at once.

    Parameters
    ----------
    path : path-like
    identity : dict
        What a run depends on; a file of another run is refused.

    Raises
    ------
    StoreError
        If there is a file that cannot be read, or that belongs to another run; it is left as it is.
    """

    def __init__(self, path: str | os.PathLike[str], identity: dict[str, Any]) -> None:
        self.path = Path(path)
        self.identity = json.loads(json.dumps(identity))
        self.arrays: dict[str, Floats] = {}
        self.note: dict[str, Any] = {}
        if self.path.exists():
            self._read()
        elif not self.path.parent.is_dir():
            raise StoreError(f"checkpoint: got {self.path}, whose folder does not exist, expected one that does")

    def save(self, arrays: dict[str, Floats], note: dict[str, Any]) -> None:
        """Replace what is on disk; it is safe there when this returns."""
        data = xr.Dataset(
            {name: ([f"{name}_{i}" for i in range(np.ndim(a))], np.asarray(a)) for name, a in arrays.items()},
            attrs={"prbayes_checkpoint": 1, "identity": json.dumps(self.identity), "note": json.dumps(note)},
        )
        data.attrs["digest"] = _digest(data)
        part = self.path.with_name(self.path.name + ".part")
        data.to_netcdf(part, engine="h5netcdf")
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(self.path)
        self.arrays, self.note = arrays, note

    def _read(self) -> None:
        try:
            with xr.open_dataset(self.path, engine="h5netcdf") as data:
                data.load()
            identity, note = json.loads(data.attrs["identity"]), json.loads(data.attrs["note"])
            sound = data.attrs["digest"] == _digest(data)
        except Exception as error:
            raise StoreError(self._refusal(f"cannot be read ({type(error).__name__}: {error})")) from error
        if not sound:
            raise StoreError(self._refusal("is damaged: its contents do not match their digest"))
        other = sorted(k for k in {*identity, *self.identity} if identity.get(k) != self.identity.get(k))
        if other:
            raise StoreError(self._refusal(f"belongs to another run, which differs in {', '.join(other)}"))
        self.arrays = {str(name): a.values for name, a in data.data_vars.items()}
        self.note = note

    def _refusal(self, what: str) -> str:
        return f"checkpoint: {self.path} {what}; nothing was changed: move it away, or pass another path"


def stored_identity(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return what the run of a checkpoint depends on; empty if it cannot be read."""
    try:
        with xr.open_dataset(path, engine="h5netcdf") as data:
            return dict(json.loads(data.attrs["identity"]))
    except Exception:  # Checkpoint says what is wrong with it
        return {}


def _digest(data: xr.Dataset) -> str:
    total = hashlib.sha256((data.attrs["identity"] + data.attrs["note"]).encode())
    for name in sorted(map(str, data.data_vars)):
        total.update(name.encode() + np.ascontiguousarray(data[name].values, dtype="<f8").tobytes())
    return total.hexdigest()
