"""Measured data: shapes, values and sources."""

import csv
from importlib.resources import files

import numpy as np
import pytest

from prbayes import datasets


def test_every_csv_row_stands_at_its_specimen_and_cycle() -> None:
    crack = datasets.crack_growth()
    lengths = crack.crack_length_inch
    assert lengths.dims == ("specimen", "million_cycles")
    assert lengths.shape == (21, 13)
    np.testing.assert_array_equal(crack.specimen, np.arange(1, 22))
    np.testing.assert_allclose(crack.million_cycles, np.linspace(0, 0.12, 13), atol=1e-15)
    with files("prbayes.datasets").joinpath("crack_growth.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert int(lengths.notnull().sum()) == len(rows)
    for row in rows:
        specimen, cycles = int(row["specimen"]), float(row["million_cycles"])
        cell = lengths.sel(specimen=specimen, million_cycles=cycles)
        assert float(cell) == float(row["crack_length_inch"])
    assert crack.attrs["notch_inch"] == 0.90
    assert (lengths.sel(million_cycles=0) == 0.90).all()
    assert lengths.attrs["units"] == "inch"
    for text in ("Lu and W. Q. Meeker (1993)", "Bogdanoff and F. Kozin (1985)"):
        assert text in crack.attrs["source"]


def test_nan_only_after_the_reading_at_which_the_specimen_failed() -> None:
    for lengths in datasets.crack_growth().crack_length_inch.to_numpy():
        measured = lengths[np.isfinite(lengths)]
        assert np.isnan(lengths[measured.size :]).all()
        assert (np.diff(measured) > 0).all()
        assert (measured[:-1] < 1.60).all()
        assert measured.size == lengths.size or measured[-1] >= 1.60


def test_the_virkler_data_are_those_of_their_publications() -> None:
    data = datasets.virkler()
    lengths = data.half_crack_length_mm
    assert lengths.shape == (68, 12)
    assert np.isnan(lengths).sum(axis=0).values.tolist() == [0] * 10 + [12, 55]
    assert np.nanmax(lengths) < data.attrs["end_mm"]
    later = np.diff(lengths, axis=1)
    assert np.nanmin(later) > 0
    for kilocycles, mean, sd in ((100, 13.892, 0.671), (200, 27.61, 3.01)):
        column = lengths.sel(kilocycles=kilocycles)
        assert float(column.mean()) == pytest.approx(mean, abs=0.005)
        assert float(column.std(ddof=1)) == pytest.approx(sd, abs=0.005)


def test_each_subject_has_doses_and_times_of_its_own() -> None:
    drug = datasets.theophylline()
    assert drug.concentration_mg_per_l.shape == drug.time_h.shape == (12, 11)
    np.testing.assert_array_equal(drug.specimen, np.arange(1, 13))
    assert (drug.time_h.diff("sample") > 0).all()
    with files("prbayes.datasets").joinpath("theophylline.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        subject = drug.sel(specimen=int(row["subject"]))
        (place,) = np.flatnonzero(subject.time_h == float(row["time_h"]))
        value = float(subject.concentration_mg_per_l[place])
        assert value == float(row["concentration_mg_per_l"])
        dose = float(row["dose_mg_per_kg"]) * float(row["weight_kg"])
        assert float(subject.dose_mg) == pytest.approx(dose, rel=1e-12)
    assert "Boeckmann" in drug.attrs["source"]
