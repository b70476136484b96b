"""Stores of the layout before SQLite, netCDF and a journal: read once, and converted."""

from __future__ import annotations

import hashlib
import struct
import zlib
from pathlib import Path

import numpy as np
import xarray as xr

from prbayes._checks import Floats

# What a journal began with, and what its records did: columns, rows, checksum of the numbers.
_MAGIC = b"prbayes1"
_HEADER = struct.Struct("<III")


def old_responses(folder: Path, name: str) -> Floats | None:
    """Return what an old store knows of a simulator: rows of inputs and then the response.

    Raises
    ------
    ValueError
        If its files are damaged; also what xarray raises for a file that is no netCDF.
    """
    safe = "".join(c if c.isalnum() or c in "-_." else f"%{ord(c):x}" for c in name)
    file, journal = folder / f"{safe}.nc", folder / f"{safe}.journal"
    tables = []
    if file.exists():
        tables.append(_of_file(file))
    if journal.exists():
        tables += _of_journal(journal)
    return np.concatenate(tables) if tables else None


def _of_file(path: Path) -> Floats:
    with xr.open_dataset(path, engine="h5netcdf") as data:
        data.load()
    inputs = np.ascontiguousarray(data["inputs"].values, dtype="<f8")
    values = np.ascontiguousarray(data["response"].values, dtype="<f8")
    digest = hashlib.sha256(inputs.tobytes() + values.tobytes()).hexdigest()
    if data.attrs.get("digest") != digest:
        raise ValueError(f"the contents of {path} do not match their digest")
    return np.column_stack([inputs, values])


def _of_journal(path: Path) -> list[Floats]:
    """Return a journal's records; the last may have been cut short by the end of a run."""
    text = path.read_bytes()
    if not text.startswith(_MAGIC[: len(text)]):
        raise ValueError(f"{path} is no journal of prbayes")
    tables: list[Floats] = []
    at = len(_MAGIC)
    while at + _HEADER.size <= len(text):
        columns, rows, crc = _HEADER.unpack_from(text, at)
        begin = at + _HEADER.size
        at = begin + 8 * rows * (columns + 1)
        numbers = text[begin:at]
        if zlib.crc32(numbers) == crc and begin + len(numbers) == at:
            tables.append(np.frombuffer(numbers, dtype="<f8").reshape(rows, columns + 1))
        elif at < len(text):
            raise ValueError(f"{path} is damaged in the middle")
    return tables
