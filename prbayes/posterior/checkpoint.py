"""The state of a sampler on disk, from which a run that was killed goes on."""

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

_FORMAT = 4  # of the content of a file; files of other formats are refused


class Checkpoint:
    """Arrays and a JSON note in one netCDF file, which each save replaces at once.

    ``settings`` are what the draws depend on besides the problem. A file that cannot be read, or of
    another problem or settings, raises StoreError and remains as it is.
    """

    def __init__(
        self, path: str | os.PathLike[str], problem: Identity, settings: dict[str, Any]
    ) -> None:
        self.path = Path(path)
        self.problem = problem
        # As from JSON, so that settings equal those of a file.
        self.settings: dict[str, Any] = json.loads(json.dumps(settings))
        self.arrays: dict[str, Floats] = {}
        self.note: dict[str, Any] = {}
        if self.path.exists():
            self._read()
        elif not self.path.parent.is_dir():
            raise StoreError(
                f"checkpoint: got {self.path}, whose folder does not exist, expected one that does"
            )

    def arrays_of(self, prefix: str) -> dict[str, Floats]:
        """Return the arrays whose names begin with a prefix, by the rest of their names."""
        return {
            name.removeprefix(prefix): array
            for name, array in self.arrays.items()
            if name.startswith(prefix)
        }

    def save(self, arrays: dict[str, Floats], note: dict[str, Any]) -> None:
        """Replace the file; it is safe on disk when this returns."""
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
        # Written to another file and then renamed: the file is whole whenever the process ends.
        part = self.path.with_name(self.path.name + ".part")
        # Made in memory: HDF5 may end the process where the disk is full.
        content = _sealed(bytes(data.to_netcdf(engine="h5netcdf")))
        try:
            with part.open("wb") as file:
                file.write(content)
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
        reasons = differences(problem, self.problem, Level.RUN)
        for key in sorted({*settings, *self.settings}):
            got, expected = settings.get(key), self.settings.get(key)
            if got != expected:
                reasons.append(f"{key}: got {got}, expected {expected}")
        if reasons:
            raise StoreError(self._refusal(f"belongs to another run: {'; '.join(reasons)}"))
        self.arrays = {str(name): a.values for name, a in data.data_vars.items()}
        self.note = note

    def _refusal(self, reason: str) -> str:
        return (
            f"checkpoint: {self.path} {reason}; nothing was changed: move it away, "
            "or pass another path"
        )


def stored_settings(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the settings of a checkpoint's run; empty if there is none that can be read."""
    try:
        return dict(json.loads(_loaded(path).attrs["settings"]))
    except Exception:  # `Checkpoint` reports the reason
        return {}


class _UnsealedError(ValueError):
    """A file that does not end with the digest of its content."""


def _sealed(payload: bytes) -> bytes:
    """Return content followed by its digest; netCDF allows bytes after its end."""
    return payload + hashlib.sha256(payload).digest()


def _loaded(path: str | os.PathLike[str]) -> xr.Dataset:
    """Return a file's content; HDF5, which may hang on a damaged file, reads intact ones only."""
    content = Path(path).read_bytes()
    payload = content[: -hashlib.sha256().digest_size]
    if _sealed(payload) != content:
        raise _UnsealedError
    with xr.open_dataset(io.BytesIO(payload), engine="h5netcdf") as data:
        return data.load()
