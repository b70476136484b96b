"""Computed responses on disk, keyed by their inputs: none is computed twice, none is lost.

Responses are appended to a journal, and flushed to disk, as soon as they are known; from time to time, and at
the end, the journal is merged into one netCDF file, which is written beside the old one and then put in its
place. Whatever moment a run is killed at, what was computed before is found again.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from prbayes._checks import Floats

_MAGIC = b"prbayes1"
_HEADER = struct.Struct("<III")  # columns, rows, crc of the payload


class StoreError(RuntimeError):
    """A store that cannot be read, or belongs to something else; it is never overwritten."""


class Store:
    """The stored responses of one simulator: ``<folder>/<name>.nc`` and its journal.

    Parameters
    ----------
    folder : path-like
        Made if it does not exist.
    name : str
        Of the simulator.
    columns : int
        Number of values that the inputs of one point are made of.

    Raises
    ------
    StoreError
        If there is a file that cannot be read, or that was made for other inputs.
    """

    def __init__(self, folder: str | os.PathLike[str], name: str, columns: int) -> None:
        self.folder = Path(folder)
        if self.folder.exists() and not self.folder.is_dir():
            raise StoreError(f"{name}: store: got {self.folder}, which is a file, expected a folder")
        self.folder.mkdir(parents=True, exist_ok=True)
        self.name = name
        self.columns = columns
        safe = "".join(c if c.isalnum() or c in "-_." else f"%{ord(c):x}" for c in name)
        self.path = self.folder / f"{safe}.nc"
        self.journal = self.folder / f"{safe}.journal"
        self._known: dict[bytes, float] = {}
        self._rows: list[Floats] = []
        self._values: list[Floats] = []
        if self.path.exists():
            self._take(*self._read())
        self._merged = len(self._known)
        if self.journal.exists():
            for inputs, values in self._replay():
                self._take(inputs, values)

    def __len__(self) -> int:
        return len(self._known)

    def find(self, inputs: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Return stored responses of inputs (n, columns), and which of them were found, shapes (n,)."""
        found = [self._known.get(row.tobytes()) for row in np.ascontiguousarray(inputs)]
        known = np.array([v is not None for v in found], dtype=bool)
        return np.array([np.nan if v is None else v for v in found]), known

    def add(self, inputs: Floats, values: Floats) -> None:
        """Append responses to the journal, safe on disk when this returns."""
        payload = np.ascontiguousarray(np.column_stack([inputs, values]), dtype="<f8").tobytes()
        with self.journal.open("ab") as file:
            if not file.tell():
                file.write(_MAGIC)
            file.write(_HEADER.pack(self.columns, len(values), zlib.crc32(payload)) + payload)
            file.flush()
            os.fsync(file.fileno())
        self._take(inputs, values)

    def merge(self, *, always: bool = False) -> None:
        """Write everything into the netCDF file, and drop the journal, if that has grown to the file's size."""
        if not self.journal.exists() or (not always and 2 * self._merged > len(self._known)):
            return
        self._merged = len(self._known)
        data = xr.Dataset(
            {
                "inputs": (["point", "column"], np.concatenate(self._rows)),
                "response": ("point", np.concatenate(self._values)),
            },
            attrs={"prbayes_store": 1, "simulator": self.name},
        )
        data.attrs["digest"] = _digest(data)
        part = self.path.with_suffix(".part")
        data.to_netcdf(part, engine="h5netcdf")
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(self.path)
        self.journal.unlink()

    def _take(self, inputs: Floats, values: Floats) -> None:
        for row, value in zip(np.ascontiguousarray(inputs, dtype=np.float64), values, strict=True):
            self._known[row.tobytes()] = float(value)
        self._rows.append(np.array(inputs, dtype=np.float64))
        self._values.append(np.array(values, dtype=np.float64))

    def _read(self) -> tuple[Floats, Floats]:
        try:
            with xr.open_dataset(self.path, engine="h5netcdf") as data:
                data.load()
            inputs, values = data["inputs"].values, data["response"].values
            sound = data.attrs.get("digest") == _digest(data)
        except Exception as error:
            raise StoreError(self._refusal(f"cannot be read ({type(error).__name__}: {error})")) from error
        if not sound:
            raise StoreError(self._refusal("is damaged: its contents do not match their digest"))
        if inputs.ndim != 2 or inputs.shape[1] != self.columns or data.attrs.get("simulator") != self.name:
            what = f"holds inputs of {inputs.shape[-1]} values for simulator {data.attrs.get('simulator')!r}, expected "
            raise StoreError(self._refusal(f"{what}{self.columns} values for {self.name!r}"))
        return inputs, values

    def _replay(self) -> list[tuple[Floats, Floats]]:
        """Return the journal's records; the last may have been cut short by the end of a run."""
        text = self.journal.read_bytes()
        if text and not text.startswith(_MAGIC[: len(text)]):
            raise StoreError(self._refusal("has a journal that is no journal of prbayes"))
        if len(text) < len(_MAGIC):  # the run ended before the first record
            self.journal.unlink()
            return []
        records, at = [], len(_MAGIC)
        while at < len(text):
            head = text[at : at + _HEADER.size]
            columns, rows, crc = _HEADER.unpack(head) if len(head) == _HEADER.size else (self.columns, 0, -1)
            if columns != self.columns:
                raise StoreError(
                    self._refusal(f"has a journal for inputs of {columns} values, expected {self.columns}")
                )
            size = 8 * rows * (columns + 1)
            payload = text[at + _HEADER.size : at + _HEADER.size + size]
            if len(payload) < size or zlib.crc32(payload) != crc:
                if at + _HEADER.size + size < len(text):
                    raise StoreError(self._refusal("has a journal that is damaged in the middle"))
                with self.journal.open("r+b") as file:
                    file.truncate(at)
                break
            table = np.frombuffer(payload, dtype="<f8").reshape(rows, columns + 1)
            records.append((table[:, :-1], table[:, -1]))
            at += _HEADER.size + size
        return records

    def _refusal(self, what: str) -> str:
        return (
            f"{self.name}: store: {self.path} {what}; nothing was changed: move it and its journal away, or pass "
            "another folder"
        )


def _digest(data: xr.Dataset) -> str:
    """Return a digest of the stored numbers."""
    parts = [np.ascontiguousarray(data[key].values, dtype="<f8").tobytes() for key in ("inputs", "response")]
    return hashlib.sha256(b"".join(parts)).hexdigest()
