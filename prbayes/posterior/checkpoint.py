"""The state of a sampler on disk after every stage.

A run that was killed goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import Floats
from prbayes.model.fingerprint import Identity, Level, as_text, differences, from_text
from prbayes.response.store import StoreError

_FORMAT = 3  # of what is in a file; others are refused


class Checkpoint:
    """Arrays and a JSON note in one netCDF file, always whole: each save replaces the file at once.

    Parameters
    ----------
    path : path-like
    problem : Identity
        What is sampled.
    settings : dict
        What the draws depend on besides; a file of another problem, or with other settings, is
        refused.

    Raises
    ------
    StoreError
        If there is a file that cannot be read, or that belongs to another run; it is left as it is.
    """

    def __init__(
        self, path: str | os.PathLike[str], problem: Identity, settings: dict[str, Any]
    ) -> None:
        self.path = Path(path)
        self.problem = problem
        self.settings = _plain(settings)
        self.arrays: dict[str, Floats] = {}
        self.note: dict[str, Any] = {}
        if self.path.exists():
            self._read()
        elif not self.path.parent.is_dir():
            raise StoreError(
                f"checkpoint: got {self.path}, whose folder does not exist, expected one that does"
            )

    def save(self, arrays: dict[str, Floats], note: dict[str, Any]) -> None:
        """Replace what is on disk; it is safe there when this returns."""
        variables = {}
        for name, array in arrays.items():
            dims = [f"{name}_{i}" for i in range(np.ndim(array))]
            variables[name] = (dims, np.asarray(array))
        attributes = {
            "prbayes_checkpoint": _FORMAT,
            "problem": as_text(self.problem),
            "settings": json.dumps(self.settings),
            "note": json.dumps(note),
        }
        data = xr.Dataset(variables, attrs=attributes)
        # Written beside and then renamed, so that the file is whole whenever the process ends.
        part = self.path.with_name(self.path.name + ".part")
        # Made in memory: HDF5 may end the process where the disk is full.
        payload = _sealed(bytes(data.to_netcdf(engine="h5netcdf")))
        try:
            with part.open("wb") as file:
                file.write(payload)
                file.flush()
                os.fsync(file.fileno())
            part.replace(self.path)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise StoreError(
                f"checkpoint: got {self.path}, which cannot be written ({error}), expected space "
                "and the right to write there; the state of the stage before is kept: free some "
                "space and run again"
            ) from error
        self.arrays, self.note = arrays, note

    def _read(self) -> None:
        try:
            data = _loaded(self.path)
            written_in = int(data.attrs["prbayes_checkpoint"])
            problem = from_text(data.attrs["problem"])
            settings, note = (json.loads(data.attrs[key]) for key in ("settings", "note"))
        except _UnsealedError:
            reason = "is damaged, or no checkpoint of this version: it does not end with its digest"
            raise StoreError(self._refusal(reason)) from None
        except Exception as error:
            reason = f"cannot be read ({type(error).__name__}: {error})"
            raise StoreError(self._refusal(reason)) from error
        if written_in != _FORMAT:
            raise StoreError(self._refusal("was written by another version of prbayes"))
        other = differences(problem, self.problem, Level.RUN)
        for key in sorted({*settings, *self.settings}):
            got = settings.get(key)
            expected = self.settings.get(key)
            if got != expected:
                other.append(f"{key}: got {got}, expected {expected}")
        if other:
            raise StoreError(self._refusal(f"belongs to another run: {'; '.join(other)}"))
        self.arrays = {str(name): a.values for name, a in data.data_vars.items()}
        self.note = note

    def _refusal(self, what: str) -> str:
        return (
            f"checkpoint: {self.path} {what}; nothing was changed: move it away, "
            "or pass another path"
        )


def stored_settings(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the settings of a checkpoint's run; empty if there is none that can be read."""
    try:
        return dict(json.loads(_loaded(path).attrs["settings"]))
    except Exception:  # Checkpoint says what is wrong with it
        return {}


class _UnsealedError(ValueError):
    """A file that does not end with the digest of what comes before."""


def _sealed(payload: bytes) -> bytes:
    """Return a file's contents with their digest behind; netCDF allows of bytes behind its end."""
    return payload + hashlib.sha256(payload).digest()


def _loaded(path: str | os.PathLike[str]) -> xr.Dataset:
    """Return what is in a file; HDF5, which may hang on a damaged one, sees sound ones only."""
    content = Path(path).read_bytes()
    size = hashlib.sha256().digest_size
    payload = content[:-size]
    if _sealed(payload) != content:
        raise _UnsealedError
    with xr.open_dataset(io.BytesIO(payload), engine="h5netcdf") as data:
        return data.load()


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Return what JSON makes of values, so that they compare equal to those that were read."""
    return dict(json.loads(json.dumps(values)))
