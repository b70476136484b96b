"""Stores of the layout before SQLite are read once, and converted; damaged ones are refused."""

from __future__ import annotations

import hashlib
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from prbayes._checks import Floats
from prbayes.response.old_store import old_responses
from prbayes.response.store import Store, StoreError

KEYS = np.random.default_rng(1).normal(size=(30, 2))
VALUES = np.r_[np.nan, np.inf, KEYS[2:] @ [1.0, 10.0]]


def write_file(path: Path, keys: Floats, values: Floats) -> None:
    digest = hashlib.sha256(keys.tobytes() + values.tobytes()).hexdigest()
    xr.Dataset(
        {"inputs": (["point", "column"], keys), "response": ("point", values)},
        attrs={"prbayes_store": 1, "simulator": "y", "digest": digest},
    ).to_netcdf(path, engine="h5netcdf")


def write_journal(path: Path, keys: Floats, values: Floats) -> None:
    """One record for every ten rows."""
    text = b"prbayes1"
    for rows in np.split(np.arange(len(keys)), len(keys) // 10):
        table = np.column_stack([keys[rows], values[rows]]).tobytes()
        text += struct.pack("<III", keys.shape[1], 10, zlib.crc32(table)) + table
    path.write_bytes(text)


def test_file_and_journal_are_found_in_the_new_store(tmp_path: Path) -> None:
    write_file(tmp_path / "y%2f1.nc", KEYS[:10], VALUES[:10])
    write_journal(tmp_path / "y%2f1.journal", KEYS[10:], VALUES[10:])
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    store = Store(tmp_path, "y/1", 2)
    values, known = store.find(KEYS)
    assert known.all()
    np.testing.assert_array_equal(values, VALUES)
    assert len(store) == 30
    # Once: the old files stay as they are, and what happens to them later does not matter.
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
    (tmp_path / "y%2f1.nc").write_bytes(b"")
    again = Store(tmp_path, "y/1", 2)
    np.testing.assert_array_equal(again.find(KEYS)[0], VALUES)
    assert len(again) == 30
    assert len(Store(tmp_path, "z", 2)) == 0


def test_a_journal_that_was_cut_gives_its_whole_records(tmp_path: Path) -> None:
    path = tmp_path / "y.journal"
    write_journal(path, KEYS, VALUES)
    whole = path.read_bytes()
    record = (len(whole) - 8) // 3
    for size in (8, 9, 8 + record - 1, 8 + record, 8 + record + 13, len(whole) - 1, len(whole)):
        path.write_bytes(whole[:size])
        found = old_responses(tmp_path, "y")
        n = 10 * ((size - 8) // record)
        if n == 0:
            assert found is None
        else:
            np.testing.assert_array_equal(found, np.column_stack([KEYS, VALUES])[:n])


def test_damaged_old_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "y.journal"
    write_journal(path, KEYS, VALUES)
    text = bytearray(path.read_bytes())
    text[30] ^= 255
    path.write_bytes(text)
    with pytest.raises(
        StoreError, match=r"y: store: .*older version.*damaged in the middle.*nothing"
    ):
        Store(tmp_path, "y", 2)
    path.write_bytes(b"something else")
    with pytest.raises(StoreError, match=r"is no journal of prbayes"):
        Store(tmp_path, "y", 2)
    path.unlink()
    write_file(tmp_path / "y.nc", KEYS, VALUES)
    with xr.open_dataset(tmp_path / "y.nc") as data:
        data.load()
    data["response"][5] = 99.0
    data.to_netcdf(tmp_path / "y.nc", engine="h5netcdf", mode="w")
    with pytest.raises(StoreError, match=r"do not match their digest"):
        Store(tmp_path, "y", 2)
    (tmp_path / "y.nc").write_bytes(b"no netCDF")
    with pytest.raises(StoreError, match=r"files of an older version that cannot be read"):
        Store(tmp_path, "y", 2)


def test_an_old_store_of_other_inputs_is_refused(tmp_path: Path) -> None:
    write_file(tmp_path / "y.nc", KEYS, VALUES)
    with pytest.raises(StoreError, match=r"holds inputs of 2 values .* expected 3 values"):
        Store(tmp_path, "y", 3)
